"""The arm on its line: armed by an operator only, fed no faster than it moves, stopped without waiting for its queue.

Nothing here waits and nothing knows the time: the loop that owns an Arm calls `poll` every few milliseconds and `send`
once a tick, with the instant. What the arm has yet to do is known by a model of its queue (arm_queue.py); what it
answers is compared with that (arm_echo.py) where it answers at all; both are kept beside its device (arm_device.py).
"""

from __future__ import annotations

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.device import ArmDevice
from hardware.arm.jog import OwnMoves
from hardware.arm.port import Opener, UnpluggedError
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import G1, G4, G54, Pause, decode, encode
from hardware.arm.queue import ArmQueue
from hardware.arm_line import ArmLine
from hardware.arm_pace import Pace
from hardware.arm_recall import Recall, Recalled
from hardware.arm_status import ArmState, ArmStatus
from hardware.link_settings import LinkSettings
from hardware.replies import Reply

DEFAULT = LinkSettings()
RECALLED = "what was queued is called back"
ORIGIN_ROUNDING = 0.11  # mm, twice half of what an answer counts


class Arm(ArmDevice):
    """One arm on one line. The methods that an operator's word calls for say why not, "" where it was done."""

    def __init__(self, opener: Opener, profile: ArmProfile, now: float, settings: LinkSettings = DEFAULT) -> None:
        """opener: opens the device, and opens it again when it was away. InputError where another program has it."""
        self._pace = Pace(profile, settings)
        self._own = OwnMoves(settings.speed, settings.turning, profile.tick)
        self._recall = Recall(self._pace.flight - profile.tick, settings.speed, profile.lag)
        self._doubt_since: float | None = None
        super().__init__(opener, profile, now, settings)

    # -- what an operator asks for

    def stand(self, axes: Array, now: float) -> str:
        """Take it that the arm stands at `axes` (6,), mm and rad; only while it is not armed."""
        if self.state is ArmState.ARMED:
            return "the arm is armed"
        if axes.shape != (6,) or not np.isfinite(axes).all():
            raise InputError("arm", "axes", axes.tolist(), "6 finite numbers X Y Z A B C, mm and rad")
        self._queue = ArmQueue(axes.tolist(), self.profile.frame_time, now)
        self._echo.restart()
        return ""

    def arm(self, now: float, goal: Array | None = None) -> str:
        """Let moves be sent. goal: (6,) where the motion left off; the arm goes there first, slowly, if it is near."""
        if self.state is ArmState.ARMED:
            return ""
        if self._line is None:
            return f"the arm is unplugged: {self.reason}"
        if self.in_flight(now) > 0 or not self._echo.still(now):
            return "the arm still moves"
        self._believe(now)
        if self._queue is None:
            return "nobody knows where the arm stands: it does not answer, and was not told"
        place = np.array(self._queue.target)
        if goal is not None and (away := float(np.linalg.norm((goal - place)[:3]))) > self.settings.lost:
            return f"the arm is {away:.1f} mm from where the motion left off, limit {self.settings.lost:g} mm"
        self._recall.resume(place)
        if goal is not None and not self._recall.undone:
            self._own.go(place, goal)
        self._echo.forgive()
        self._insistence.drop()
        self._doubt_since = None
        self._change(ArmState.ARMED, "by the operator", now)
        return ""

    def disarm(self, now: float) -> None:
        """Send nothing more but a stop that the arm has not heard; what is under way, 50 ms at most, is done."""
        if self.state in (ArmState.ARMED, ArmState.STOPPED) and self._line is not None:
            unheard = self.insists(now)
            self._halt()
            if unheard:
                self._call_back(self._line, now)
            if self._line is not None:
                self._change(ArmState.DISARMED, "by the operator", now)

    def stop(self, reason: str, now: float) -> None:
        """Stop at once: what waits is called back, and the control frame that stops the arm goes next."""
        if self._line is None:
            return
        self._halt()
        if self.settings.pause_frame:
            self._call_back(self._line, now)
        if self._line is not None:  # it was not lost over that
            self._change(ArmState.STOPPED, reason, now)

    def go(self, axes: Array, now: float, lift: bool = False) -> str:
        """Go to `axes` (6,), mm and rad, slowly and in steps. lift: up first and down last, never low across."""
        limits = self.profile.limits
        if self.state is not ArmState.ARMED or self._queue is None:
            return f"the arm is {self.state.value}: {self.reason}"
        if self._recall.goal is not None:
            return RECALLED
        if axes.shape != (6,) or not ((axes >= limits.low) & (axes <= limits.high)).all():
            return f"{axes.tolist()} is out of bounds"
        self._own.go(np.array(self._queue.target), axes, lift)
        return ""

    def home(self, now: float) -> str:
        """Go home: X202.5 Y225 Z113 A0 B0 C0, if the profile says nothing else (thesis 6.3)."""
        return self.go(self.profile.arm.home, now, lift=True)

    def set_origin(self, origin: Array, now: float) -> str:
        """Make `origin` (3,), mm in machine axes, the arm's (0, 0, 0) by G54; all else here stays in machine axes."""
        if self.state is not ArmState.ARMED or self._queue is None or self._queue.in_flight(now) > 0 or self.travels:
            return "an origin is set while the arm is armed and at rest"
        frame = G54(origin)
        encode(frame, self.profile.dialect)  # InputError for what no frame holds
        self._give(frame, now)
        self.origin = np.array(origin, float)
        return ""

    # -- what the loop does

    def poll(self, now: float) -> None:
        """Read, write what waited, look for a device that is gone, send its own moves; every few milliseconds."""
        if self._line is None:
            if now >= self._look:
                try:
                    self._open(now)
                except InputError as error:  # another program has taken it meanwhile
                    self._look, self.reason = now + self.settings.reopen, str(error)
            return
        try:
            for reply in self._read(self._line, now):
                self._check_origin(reply, now)
            if self._line is None:  # lost over what an answer called for
                return
            if (share := self._line.flush(now)) and self._queue is not None:
                self._queue.occupy(now, share)
        except UnpluggedError as error:
            self._unplugged(str(error), now)
            return
        self._insist(self._line, now)
        if self.state is ArmState.ARMED:
            self._judge(now)
        travels = self.state is ArmState.ARMED and self.travels
        if travels and self.in_flight(now) <= self.profile.tick and not self._wait(now):  # the step before nearly done
            self._give(self._own.take(), now)

    def hold(self, now: float) -> str:
        """Why no frame may be sent now, "" where one may."""
        if self.state is not ArmState.ARMED:
            return f"the arm is {self.state.value}: {self.reason}"
        if self.travels:
            return "the arm is on its way"
        return RECALLED if self._recall.goal is not None else self._wait(now)

    def send(self, frame: bytes, now: float) -> str:
        """Send the frame of a move or pause; why it was not sent, "" if it was. What cannot be sent stops the arm.

        InputError for bytes that are no G1 or G4 of the arm's dialect.
        """
        instruction = decode(frame, self.profile.dialect)
        if not isinstance(instruction, G1 | G4):
            raise InputError("arm", "frame", frame.hex(" "), "the frame of a G1 or G4")
        if reason := self.hold(now):
            return reason
        assert self._queue is not None
        if reason := self._pace.excess(instruction, self._queue, now):
            self.stop(reason, now)
            return reason
        self._own.last = None
        self._give(instruction, now, frame if not self.origin.any() else None)
        return ""

    def take_up(self) -> Recalled | None:
        """What was called back, once the arm obeys again: until somebody has taken note, nothing more is sent."""
        place, queue = self._recall.place, self._queue
        if not self._recall.obeys or place is None or queue is None:
            return None
        self._recall.drop()
        return Recalled(place, np.array(queue.target))

    @property
    def travels(self) -> bool:
        """Whether the arm makes a move of its own: home, or back to where it was stopped."""
        return self._own.step is not None

    def arrived(self, now: float) -> bool:
        """Whether it stands where it was sent: by dead reckoning, and by its answers where it answers."""
        if self._queue is None or self.travels or self._recall.goal is not None or self._queue.in_flight(now) > 0:
            return False
        answered = self._echo.axes(now)
        if answered is None:
            return self._echo.count == 0
        return self._echo.still(now) and not self._echo.doubt(now)

    def insists(self, now: float) -> bool:
        """Whether it was told to stop, and is not known to have heard it."""
        line, insistence = self._line, self._insistence
        return line is not None and insistence.active and (line.blocked or insistence.pending(self._echo, now))

    def status(self, now: float) -> ArmStatus:
        """All that is known."""
        queued = 0 if self._queue is None else self._queue.frames(now)
        echo = self._echo
        return ArmStatus(
            *(now, self.state, self.reason, self.reckoned(now), echo.axes(now), echo.off, echo.lag, echo.rate),
            *(self.in_flight(now), queued, self.frames, echo.count, self.strays),
        )

    # -- its own moves, and what stops them

    def _unplugged(self, reason: str, now: float) -> None:
        """The device is gone, and what was under way with it."""
        self._own.drop()
        self._recall.break_off()
        super()._unplugged(reason, now)

    def _check_origin(self, reply: Reply, now: float) -> None:
        if np.abs(reply.values - self.origin).max() > ORIGIN_ROUNDING and self.state is ArmState.ARMED:
            self.stop(f"the arm's origin is {reply.values.tolist()}, not {self.origin.tolist()}", now)

    def _halt(self) -> None:
        """Drop its own moves, and the frames of which nothing is on the wire."""
        if self._line is not None:
            self._line.recall()
        self._own.drop()
        self._recall.break_off()

    def _wait(self, now: float) -> str:
        """Why no frame of a tick may go out now."""
        assert self._line is not None and self._queue is not None
        return self._pace.full(self._line, self._queue, self.profile.tick, now) or self._echo.doubt(now)

    def _judge(self, now: float) -> None:
        """Stop the arm where a fault lasts, or is too large to wait."""
        assert self._line is not None
        if (blocked := self._line.blocked_for(now)) > self.settings.write_timeout:
            self.stop(f"the port took no bytes for {blocked:.2f} s, limit {self.settings.write_timeout:g} s", now)
        elif self._echo.off > self.settings.lost:
            self.stop(f"the arm is {self._echo.off:.1f} mm off its way, limit {self.settings.lost:g} mm", now)
        elif doubt := self._recall.why or self._echo.doubt(now):
            self._doubt_since = now if self._doubt_since is None else self._doubt_since
            if now - self._doubt_since > self.settings.patience:
                self.stop(f"{doubt}, for {self.settings.patience:g} s", now)
        else:
            self._doubt_since = None
        if self.state is ArmState.ARMED and self.settings.pause_frame:
            self._keep_up(now)

    def _keep_up(self, now: float) -> None:
        """Call back what an arm has queued that does not follow; once it rests, learn when it obeys again."""
        assert self._line is not None and self._queue is not None
        recall, echo = self._recall, self._echo
        if recall.goal is None and (doubt := echo.doubt(now)):
            recall.begin(f"{RECALLED}: {doubt}", np.array(self._queue.target), self._own.break_off(), now)
            self._note(recall.why, now)
            self._call_back(self._line, now)
        elif recall.goal is not None and not (recall.obeys or self._line.blocked or self._queue.in_flight(now) > 0):
            if recall.stepped is None and echo.settled(recall.since):
                self._believe(now)
            for following in recall.next(echo, np.array(self._queue.target), now):
                if isinstance(following, Pause):
                    if recall.stood is not None:  # the step is to be given again, from where it was
                        self._queue = ArmQueue(recall.stood.tolist(), self.profile.frame_time, now)
                    self._call_back(self._line, now)
                elif self._line is not None:  # it was not lost over the pause
                    self._give(following, now)
            if recall.obeys:
                self._insistence.drop()
                if recall.rest is not None:
                    self._own.go(np.array(self._queue.target), recall.goal, then=recall.rest)
                    recall.drop()

    def _insist(self, line: ArmLine, now: float) -> None:
        """Tell an arm that was told to stop, and does not, once more."""
        told = self.state is not ArmState.ARMED or self._recall.waits
        if told and not line.blocked and self._insistence.due(self._echo, now):
            self._give(Pause(), now)

    def _call_back(self, line: ArmLine, now: float) -> None:
        self._insistence.begin(now)
        line.recall()
        self._give(Pause(), now)
