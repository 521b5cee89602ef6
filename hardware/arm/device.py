"""One arm's device, opened, read and written, and what is known of the arm by what was sent and what was answered.

Nothing here waits and nothing knows the time, and nothing here decides what is sent: that is `hardware/arm.py`.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from estimation.se3 import Array
from hardware.arm.feedback import ArmEcho
from hardware.arm.port import Opener, UnpluggedError
from hardware.arm.profile import BITS_PER_BYTE, ArmProfile
from hardware.arm.protocol import G1, G4, Instruction, Pause, encode
from hardware.arm.queue import ArmQueue, Stretch
from hardware.arm_insistence import Insistence
from hardware.arm_line import ArmLine
from hardware.arm_status import ArmEvent, ArmState, told
from hardware.link_settings import LinkSettings
from hardware.replies import REPLY_LENGTH, Reply, ReplyKind

REMEMBERED = 1000  # events and stray bytes that are kept until somebody takes them


class ArmDevice:
    """What an arm is connected by, and its queue and answers as they are known.

    state, reason: and why it is so, for a person. frames: sent. strays: bytes that were in no answer, stray_bytes the
    last of them with their instants, s. origin: (3,) mm in machine axes, from which the arm counts. stops: when each
    was decided, and when it was on the wire, s.
    """

    def __init__(self, opener: Opener, profile: ArmProfile, now: float, settings: LinkSettings) -> None:
        """opener: opens the device, and opens it again when it was away. InputError where another program has it."""
        self.profile, self.settings = profile, settings
        self.state, self.reason = ArmState.UNPLUGGED, "not opened yet"
        self.frames, self.strays = 0, 0
        self.stray_bytes: deque[tuple[float, bytes]] = deque(maxlen=REMEMBERED)
        self.origin = np.zeros(3)
        self._events: deque[ArmEvent] = deque(maxlen=REMEMBERED)
        self._opener = opener
        self._line: ArmLine | None = None
        self._queue: ArmQueue | None = None  # None while nobody knows where the arm stands
        self._echo, self._insistence = ArmEcho(settings, profile.lag), Insistence()
        self.stops = self._insistence.stops
        self._look = now  # when the device is looked for next
        self._open(now)

    @property
    def target(self) -> Array | None:
        """Where the arm was last sent (6,), mm and rad; None where nobody knows."""
        return None if self._queue is None else np.array(self._queue.target)

    def in_flight(self, now: float) -> float:
        """Seconds of motion that was sent and not done, wire included."""
        return 0.0 if self._queue is None else self._queue.in_flight(now)

    def reckoned(self, instant: float) -> Array | None:
        """Where the arm is at `instant`, s, by what was sent (6,), the servo's lag included; None if not known."""
        late = self.profile.lag - self.profile.frame_time
        return None if self._queue is None else np.array(self._queue.at(instant - max(late, 0.0)))

    def ways(self, since: float) -> list[Stretch]:
        """The ways of the set-point that end after `since`, s, as far as they are known."""
        return [] if self._queue is None else self._queue.ways(since)

    def events(self) -> list[ArmEvent]:
        """What happened since the last call."""
        taken = list(self._events)
        self._events.clear()
        return taken

    def close(self) -> None:
        """Let the device go, without a word to the arm."""
        if self._line is not None:
            self._line.port.close()
        self._line, self.state, self.reason = None, ArmState.UNPLUGGED, "closed"
        self._look = float("inf")

    def _open(self, now: float) -> None:
        try:
            self._line = ArmLine(self._opener())
        except UnpluggedError as error:
            self._look, self.reason = now + self.settings.reopen, str(error)
            return
        self._echo.restart()
        self._change(ArmState.DISARMED, "connected; the operator has not armed it", now)

    def _unplugged(self, reason: str, now: float) -> None:
        """The device is gone: where the arm stands when it comes back, nobody knows."""
        if self._line is not None:
            self._line.port.close()
        self._line, self._queue = None, None
        self._insistence.drop()
        self.origin = np.zeros(3)
        self._look = now + self.settings.reopen
        self._change(ArmState.UNPLUGGED, reason, now)

    def _read(self, line: ArmLine, now: float) -> list[Reply]:
        """Take what has come; of the answers those about the arm's origin."""
        replies, strays = line.receive()
        now -= REPLY_LENGTH * BITS_PER_BYTE / self.profile.baud  # that an answer took on the wire
        if strays:
            self.strays += len(strays)
            self.stray_bytes.append((now, strays))
        places = [reply for reply in replies if reply.kind is not ReplyKind.ORIGIN]
        for reply in places:
            if self._queue is not None:
                self._echo.take(reply, self._queue, self.origin, now)
            else:
                self._find(reply, now)
        return [reply for reply in replies if reply.kind is ReplyKind.ORIGIN]

    def _find(self, reply: Reply, now: float) -> None:
        """While nobody knows where the arm stands, its answers say so; they are believed when it is armed."""
        place = [*reply.values, 0, 0, 0] if reply.kind is ReplyKind.PLACE else [0, 0, 0, *reply.values]
        self._echo.take(reply, ArmQueue(place, self.profile.frame_time, now), np.zeros(3), now)

    def _give(self, instruction: Instruction, now: float, frame: bytes | None = None) -> None:
        """Put a frame on the line. Machine axes are told from the arm's origin."""
        assert self._line is not None
        if frame is None:
            told = instruction
            if isinstance(instruction, G1) and self.origin.any():
                told = G1(instruction.axes - np.concatenate([self.origin, np.zeros(3)]), instruction.feed)
            frame = encode(told, self.profile.dialect)

        def sent(at: float, share: float) -> None:
            self.frames += 1
            self._book(instruction, at, share)

        try:
            share = self._line.send(frame, sent, now)
            if share and self._queue is not None:
                self._queue.occupy(now, share)
        except UnpluggedError as error:
            self._unplugged(str(error), now)

    def _book(self, instruction: Instruction, now: float, share: float) -> None:
        """The last byte of a frame is gone: what the arm will do because of it."""
        if isinstance(instruction, G1 | G4):
            assert self._queue is not None
            self._queue.add(instruction, now, share)
        elif self._queue is not None:
            self._queue.occupy(now, share)
        if isinstance(instruction, Pause):
            if self._queue is not None:
                self._queue.stop()
            on_wire = now + share * self.profile.frame_time if self._queue is None else self._queue.wire_free
            self._insistence.heard(on_wire)

    def _believe(self, now: float) -> None:
        """Where the arm stands is for its answers to say, as far as their rounding tells it from what was known."""
        known = self.target
        stands = self._echo.stands(known, now)
        if stands is not None and (known is None or (stands != known).any()):
            self._queue = ArmQueue(stands.tolist(), self.profile.frame_time, now)
            self._note(f"stands at {told(stands)} by its own answer", now)

    def _change(self, state: ArmState, reason: str, now: float) -> None:
        if (state, reason) != (self.state, self.reason):
            self._note(f"{state.value}: {reason}", now)
        self.state, self.reason = state, reason

    def _note(self, text: str, now: float) -> None:
        self._events.append(ArmEvent(now, text))
