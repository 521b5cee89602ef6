"""How much may be given out now: what is on the wire, in the port and in the arm's queue, beside the link's limits."""

from __future__ import annotations

from dataclasses import dataclass

from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import G1, G4, LENGTH
from hardware.arm.queue import ArmQueue
from hardware.arm_line import ArmLine
from hardware.link_settings import LinkSettings

PASSED = 1e-3  # bytes: rounding


@dataclass(frozen=True, slots=True, eq=False)
class Pace:
    """The limits of one arm's link. Its questions are answered by why not, "" where nothing is against it."""

    profile: ArmProfile
    settings: LinkSettings

    @property
    def flight(self) -> float:
        """Seconds that may be under way, wire included: `flight`, or on a slow line one frame and the move in it.

        Either way no more than a tick is added to what the arm's queue holds, and a tick is 50 ms at most.
        """
        slow = self.profile.frame_time * (1 + PASSED / LENGTH) + self.profile.tick
        return max(self.settings.flight, slow)

    def full(self, line: ArmLine, queue: ArmQueue, more: float, now: float) -> str:
        """Why a frame of `more` s must wait."""
        if line.blocked:
            return f"the port has taken no bytes for {line.blocked_for(now):.3f} s"
        passing = max(queue.wire_free - now, 0.0) / self.profile.frame_time * LENGTH
        if passing > PASSED:
            return f"{passing:.0f} bytes are on the wire: a stop would wait for two frames"
        waiting = line.port.waiting() - passing
        if waiting > LENGTH:
            return f"{waiting:.0f} bytes wait in the port"
        if (count := queue.frames(now)) >= self.settings.frames:
            return f"{count} frames are under way, limit {self.settings.frames}"
        if queue.in_flight_with(more, now) > self.flight:
            return f"{1000 * queue.in_flight(now):.0f} ms are under way, limit {1000 * self.flight:g} ms"
        return ""

    def excess(self, instruction: G1 | G4, queue: ArmQueue, now: float) -> str:
        """Why the arm is stopped rather than sent this."""
        limit = self.profile.limits.feed
        if isinstance(instruction, G1) and instruction.feed > limit * (1 + 1e-6):
            return f"feed of {instruction.feed:g} mm/s, limit {limit:g}"
        flight = queue.in_flight_with(queue.duration(instruction), now)
        if flight > self.flight:
            return f"{1000 * flight:.1f} ms would be under way, limit {1000 * self.flight:g} ms"
        return ""
