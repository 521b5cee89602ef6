"""One arm's device: frames and answers pass here, and the model of the arm's queue and its answers are kept.

Nothing here waits, reads a clock or decides what is sent; `hardware/arm/link.py` decides.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from math import degrees

import numpy as np

from estimation.se3 import Array
from hardware.arm.driver import G1, G4, ArmDriver, Pause, Reply, ReplyKind, Sent, UnpluggedError
from hardware.arm.feedback import ArmFeedback
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.arm.queue import ArmQueue, QueuedCommand

RESEND_AFTER = 0.09  # s: a frame on the wire, the lag, the way to rest, and the slowest answer of a public driver
MAX_REMEMBERED = 1000  # stops, events and stray reads
BLIND_RESENDS = 3  # times, to an arm that does not answer


class ArmState(Enum):
    """Whether the arm may be moved. Only an operator's order leads to ARMED."""

    DISARMED = "disarmed"  # connected, and listened to; nothing is sent
    ARMED = "armed"  # moves are sent
    STOPPED = "stopped"  # by an order or a fault; nothing is sent until it is armed again
    UNPLUGGED = "unplugged"  # the device is gone; it is looked for, and disarmed when it is back


class LinkCode(Enum):
    """Why the link does not do what it is asked, for code to decide by; the words are a Reason's."""

    DISARMED = "disarmed"
    STOPPED = "stopped"
    UNPLUGGED = "unplugged"
    ARMED = "armed"  # what is asked is done before the arm is armed
    OPERATOR = "operator"  # of a stop: the operator asked for it
    MOVING = "moving"  # the arm still moves
    UNKNOWN_PLACE = "unknown_place"  # nobody knows where the arm stands
    FAR_FROM_PATH = "far_from_path"  # too far from where the motion left off
    OUT_OF_BOUNDS = "out_of_bounds"
    OWN_MOVE = "own_move"  # the link makes a move of its own
    RECALLED = "recalled"  # what was queued is called back
    FLOW_CONTROL = "flow_control"  # enough is under way
    FEEDBACK = "feedback"  # the arm's answers are late, missing or off its way
    LIMIT = "limit"  # the command breaks a limit of the link
    ARM_FAULT = "arm_fault"  # the arm has stopped by itself, and is not ready again


class Reason(str):
    """Why the link does not do what it is asked: words for a person, with a code beside them; empty where it does."""

    code: LinkCode | None

    def __new__(cls, words: str = "", code: LinkCode | None = None) -> Reason:  # noqa: D102
        reason = super().__new__(cls, words)
        reason.code = code if words else None
        return reason


DONE = Reason()
BY_OPERATOR = Reason("by the operator", LinkCode.OPERATOR)


@dataclass(frozen=True, slots=True, eq=False)
class ArmStatus:
    """The arm at one instant."""

    stamp: float  # s
    state: ArmState
    reason: str  # of the state
    axes: Array | None  # (6,) mm and rad, by dead reckoning; None where nobody knows
    answered: Array | None  # (6,) mm and rad, by its last answers; None without
    off: float  # mm, distance of its answers from its way
    lag: float  # s, measured, from set-point to answer; NaN until known
    answer_rate: float  # Hz, NaN without
    in_flight: float  # s of motion under way
    queued: int  # commands under way
    frames: int  # sent
    answers: int  # received
    strays: int  # bytes that belong to no answer


@dataclass(frozen=True, slots=True)
class ArmEvent:
    """Something that a person should be able to read afterwards."""

    stamp: float  # s
    text: str
    state: ArmState | None = None  # the new state; None where it stayed


def axes_text(axes: Array) -> str:
    """Axes (6,), mm and rad, for a person: mm and degrees."""
    return ", ".join([*(f"{v:.1f}" for v in axes[:3]), *(f"{degrees(v):.2f}" for v in axes[3:])])


class StopRetry:
    """When the frame that stops the arm is to be sent again, as it may be lost or garbled on the line.

    stops: instants, s, at which each stop was decided, and at which it was on the wire.
    active: whether a stop was decided since the arm was last known to obey.
    """

    def __init__(self) -> None:
        self.stops: deque[tuple[float, float]] = deque(maxlen=MAX_REMEMBERED)
        self._sent, self._blind = -math.inf, 0  # s, the last time; times left without an answer
        self._decided: float | None = None
        self.active = False

    def begin(self, now: float) -> None:
        """A stop is decided at `now`, s, unless an earlier one has yet to go out, and its frame is sent."""
        self._sent, self._blind, self.active = now, BLIND_RESENDS, True
        self._decided = now if self._decided is None else self._decided

    def on_wire(self, instant: float) -> None:
        """A frame that stops the arm is on the wire at `instant`, s."""
        if self._decided is not None:
            self.stops.append((self._decided, instant))
        self._decided = None

    def drop(self) -> None:
        """The arm obeys again, or the device is gone."""
        self._decided, self.active = None, False

    def pending(self, feedback: ArmFeedback, now: float) -> bool:
        """Whether the arm may not have read it: it is too soon to say, the arm moves, or blind retries are left."""
        too_soon, blind = now - self._sent < RESEND_AFTER, feedback.axes(now) is None and self._blind > 0
        return self.active and (too_soon or blind or not feedback.still(now))

    def due(self, feedback: ArmFeedback, now: float) -> bool:
        """Whether to send it again: RESEND_AFTER later the arm still moves by its answers, or gives none."""
        if not self.active or now - self._sent < RESEND_AFTER:
            return False
        if not feedback.restless(self._sent + RESEND_AFTER):
            if feedback.axes(now) is not None or self._blind == 0:
                return False
            self._blind -= 1
        self._sent = now
        return True


class ArmDevice:
    """The line to an arm by its driver, and its queue and answers as far as they are known.

    state, reason: whether the arm may be moved, and why, for a person.
    frames: sent.
    strays: bytes that were in no answer; stray_bytes: the last of them with their instants, s.
    fault: why the arm has stopped by itself, "" where it has not. busy: whether it makes a move of its own.
    stops: of each stop the instants, s, of its decision and of its frame on the wire.
    """

    def __init__(self, driver: ArmDriver, profile: ArmProfile, now: float, settings: LinkSettings) -> None:
        """driver: of the arm, not connected yet. InputError where another program has it."""
        self.driver = driver
        self.profile, self.settings = profile, settings
        self.state, self.reason = ArmState.UNPLUGGED, "not opened yet"
        self.frames, self.strays = 0, 0
        self.fault, self.busy = "", False
        self.stray_bytes: deque[tuple[float, bytes]] = deque(maxlen=MAX_REMEMBERED)
        self._online = False  # whether the driver is connected
        self._events: deque[ArmEvent] = deque(maxlen=MAX_REMEMBERED)
        self._queue: ArmQueue | None = None  # None while nobody knows where the arm stands
        self._feedback, self._stop_retry = ArmFeedback(settings, profile.lag), StopRetry()
        self.stops = self._stop_retry.stops
        self._reopen_at = now  # s
        self._open(now)

    @property
    def target(self) -> Array | None:
        """Where the arm was last sent (6,), mm and rad; None where nobody knows."""
        return None if self._queue is None else np.array(self._queue.target)

    def in_flight(self, now: float) -> float:
        """Seconds of motion that was sent and not done, wire included."""
        return 0.0 if self._queue is None else self._queue.in_flight(now)

    def reckoned(self, instant: float) -> Array | None:
        """Axes (6,) at `instant`, s, by dead reckoning, the servo's lag included; None where nobody knows."""
        servo_lag = self.profile.lag - self.profile.frame_time
        return None if self._queue is None else np.array(self._queue.at(instant - max(servo_lag, 0.0)))

    def ways(self, since: float) -> list[QueuedCommand]:
        """The ways of the set-point that end after `since`, s, as far as they are known."""
        return [] if self._queue is None else self._queue.ways(since)

    def events(self) -> list[ArmEvent]:
        """What happened since the last call."""
        events = list(self._events)
        self._events.clear()
        return events

    def close(self) -> None:
        """Close the device; the arm is sent nothing."""
        if self._online:
            self.driver.close()
        self._online, self.state, self.reason = False, ArmState.UNPLUGGED, "closed"
        self._reopen_at = float("inf")

    def _open(self, now: float) -> None:
        try:
            self.driver.connect(now)
        except UnpluggedError as error:
            self._reopen_at, self.reason = now + self.settings.reopen, str(error)
            return
        self._online = True
        self._feedback.restart()
        self._change(ArmState.DISARMED, "connected; the operator has not armed it", now)

    def _unplugged(self, reason: str, now: float) -> None:
        """The device is gone: nobody knows where the arm will stand when it comes back."""
        if self._online:
            self.driver.close()
        self._online, self._queue = False, None
        self.fault, self.busy = "", False
        self._stop_retry.drop()
        self._reopen_at = now + self.settings.reopen
        self._change(ArmState.UNPLUGGED, reason, now)

    def _read(self, now: float) -> list[Reply]:
        """Take the answers that have come; gives those about the arm's origin."""
        reported = self.driver.state(now)
        stamp, self.fault, self.busy = reported.stamp, reported.fault, reported.busy
        if reported.strays:
            self.strays += len(reported.strays)
            self.stray_bytes.append((stamp, reported.strays))
        for reply in reported.replies:
            if reply.kind is ReplyKind.ORIGIN:
                continue
            queue = self._queue
            if queue is None:  # nobody knows where the arm stands; its answers are believed when it is armed
                place = [*reply.values, 0, 0, 0] if reply.kind is ReplyKind.PLACE else [0, 0, 0, *reply.values]
                queue = ArmQueue(place, self.profile.frame_time, stamp)
            self._feedback.take(reply, queue, stamp)
        return [reply for reply in reported.replies if reply.kind is ReplyKind.ORIGIN]

    def _give(self, instruction: G1 | G4 | Pause, now: float) -> None:
        """Give an instruction in machine axes to the driver."""
        try:
            if isinstance(instruction, Pause):
                self._book(self.driver.stop(now), now)
            else:
                self._book(self.driver.send(instruction, now), now)
        except UnpluggedError as error:
            self._unplugged(str(error), now)

    def _book(self, sent: Sequence[Sent], now: float) -> None:
        """Enter what the arm will do because of what has gone out."""
        for part in sent:
            self.frames += part.instruction is not None
            if isinstance(part.instruction, G1 | G4):
                assert self._queue is not None
                self._queue.add(part.instruction, now, part.share)
            elif self._queue is not None:
                self._queue.occupy(now, part.share)
            if isinstance(part.instruction, Pause):
                on_wire = now + part.share * self.profile.frame_time
                if self._queue is not None:
                    self._queue.stop()
                    on_wire = self._queue.wire_free
                self._stop_retry.on_wire(on_wire)

    def _adopt_answers(self, now: float) -> None:
        """Take it that the arm stands where its answers say, unless their rounding allows what was known before."""
        known = self.target
        rest_axes = self._feedback.stands(known, now)
        if rest_axes is not None and (known is None or (rest_axes != known).any()):
            self._queue = ArmQueue(rest_axes.tolist(), self.profile.frame_time, now)
            self._note(f"stands at {axes_text(rest_axes)} by its own answer", now)

    def _change(self, state: ArmState, reason: str, now: float) -> None:
        if (state, reason) != (self.state, self.reason):
            self._events.append(ArmEvent(now, f"{state.value}: {reason}", state))
        self.state, self.reason = state, reason

    def _note(self, text: str, now: float) -> None:
        self._events.append(ArmEvent(now, text))
