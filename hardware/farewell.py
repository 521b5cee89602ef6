"""The end of a session: the frame that stops the arm goes out, and again where the arm did not hear it."""

from __future__ import annotations

from hardware.arm.link import Arm
from hardware.arm_status import ArmState
from hardware.process.clock import Clock

LEAST, MOST = 0.05, 1.0  # s in which a last frame goes out, and in which an arm that does not stop is told so again


def farewell(arm: Arm, reason: str, clock: Clock, look: float) -> None:
    """Stop an armed arm, and poll it every `look` s until it is known to have heard of its last stop, 1 s at most."""
    begun = clock.now()
    if arm.state is ArmState.ARMED:
        arm.stop(reason, begun)
    while (now := clock.now()) < begun + LEAST or (arm.insists(now) and now < begun + MOST):
        arm.poll(now)
        clock.wait_until(now + look)
