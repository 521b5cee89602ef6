"""Drives an arm through set-points over its link: guarded, a frame a tick, stopped by whatever goes wrong."""

from __future__ import annotations

from collections.abc import Callable

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.link import Arm
from hardware.arm.protocol import G1, encode
from hardware.arm_calibration.commanded import CommandedFile
from hardware.arm_calibration.moves import still, watchful
from hardware.arm_status import ArmState
from hardware.process.clock import Clock
from hardware.process.progress import Report, silent
from planning.command import Move, Refusal, feed_for

LISTEN = 1.0  # s before the first move, in which an arm that answers has told where it stands
REST = 0.5  # s after the last


class Drive:
    """One arm, its clock, and the file of what it was sent."""

    def __init__(self, arm: Arm, clock: Clock, log: CommandedFile) -> None:
        self.arm, self._clock, self._log = arm, clock, log

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Let time pass, looking at the line."""
        end = self._clock.now() + seconds
        while (now := self._clock.now()) < end and not until():
            self._look(now)
            self._clock.wait_until(now + self.arm.settings.poll)

    def ready(self, stands: Array | None) -> Array:
        """Arm it, and where it then stands (6,). stands: where an arm that does not answer stands, mm and rad."""
        if stands is not None:
            self.arm.stand(stands, self._clock.now())
        self.wait(LISTEN)
        reason = self.arm.arm(self._clock.now())
        if reason or self.arm.target is None:
            allowed = "an arm that answers from where it stands at rest, or --stands"
            raise InputError("arm", "ready", reason or "nobody knows where it stands", allowed)
        return self.arm.target

    def follow(self, targets: Array, report: Report = silent) -> None:
        """Send set-points (K, 6), one a tick; where the link asks to wait, all that follows comes later.

        InputError where the guard or the link ends it; the arm is at rest then. It is left armed, at the last of them.
        """
        assert self.arm.target is not None
        arm, at = self.arm, self.arm.target
        guard, due, number = watchful(arm.profile, at), self._clock.now(), 0
        try:
            while number < len(targets):
                now = self._clock.now()
                self._look(now)
                if arm.state is not ArmState.ARMED:
                    raise InputError("arm", "motion", arm.reason, "an arm that is left to move")
                if now >= due and not arm.hold(now):
                    target = targets[number]
                    if (target != at).any():
                        move = Move(now, target, feed_for(at, target, arm.profile.tick), 0, False)
                        answer = guard(move, still(now), now)
                        reason = answer.reason if isinstance(answer, Refusal) else self._send(move, now)
                        if reason:
                            raise InputError("arm", "motion", reason, "moves that guard and link let pass")
                        at = target
                    begun = max(due, now - arm.profile.tick)  # missed ticks are not made up
                    number, due = number + 1, begun + arm.profile.tick * (1 + arm.settings.ease)
                    report(number, len(targets))
                self._clock.wait_until(now + arm.settings.poll)
            self.wait(REST, lambda: arm.state is not ArmState.ARMED)
        except BaseException:
            self.halt("the calibration was ended")
            raise

    def halt(self, reason: str) -> None:
        """Bring it to rest at once, whatever it does."""
        if self.arm.state is ArmState.ARMED:
            self.arm.stop(reason, self._clock.now())
        self.wait(REST)

    def _send(self, move: Move, now: float) -> str:
        return self.arm.send(encode(G1(move.axes, move.feed), self.arm.profile.dialect), now)

    def _look(self, now: float) -> None:
        self.arm.poll(now)
        self._log.note(self.arm, now)
