"""A tracker that a busy machine slows down: the nozzle waits and says why, and what is printed lies in its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.pose import SurfacePose
from hardware.arm.profile import ArmProfile
from hardware.motion.loop import MotionLoop, Order, Tick
from hardware.motion.step import MotionStep
from hardware.process.ticks import InStep
from planning.command import Hold, Move
from planning.kinematics import nozzle_from_axes
from tests.linked import linked
from tests.moving import breathing, pose_at, raster
from tests.slowly import slowly

CAMERA = 1 / 30  # s between frame sets
SLOW = 5.0  # s: it prints by then
LIVELY = np.array([1e-4] * 3 + [25.0] * 3)  # rad^2/s^3, mm^2/s^3: as an estimator finds of calm breathing


class SlowTracker:
    """Takes the newest frame set, and as long as it is told for each; the newest pose there is at an instant."""

    def __init__(self, rhythm: InStep, seed: int, slowest: float) -> None:
        self._rhythm, self._rng, self._slowest = rhythm, np.random.default_rng(seed), slowest
        self._pose: SurfacePose | None = None
        self._next: tuple[float, float] = (0.03, 0.0)  # when the next pose is there, and its stamp, s

    def __call__(self, now: float) -> SurfacePose | None:
        while now >= self._next[0]:
            done, stamp = self._next
            self._pose = replace(pose_at(breathing, stamp), acceleration_psd=LIVELY)
            self._rhythm.arrived(done)
            taken = np.floor(done / CAMERA) * CAMERA
            spent = self._rng.uniform(0.02, self._slowest if done > SLOW else 0.03)
            self._next = max(done, taken + 0.01) + spent, float(taken)
        return self._pose


def printed(slowest: float, seed: int) -> tuple[list[Tick], ArmProfile]:
    profile = replace(ArmProfile(), tick=0.0165)
    link = linked(stand=False, profile=profile)
    rhythm = InStep(profile.tick, link.arm.settings.ease, 0.0)
    tracker, ticks = SlowTracker(rhythm, seed, slowest), list[Tick]()
    orders = [(0.1, Order.ARM), (0.0, Order.AT_HOME)]

    def due() -> list[Order]:
        return [orders.pop()[1] for _ in range(len(orders)) if orders[-1][0] <= link.clock.now()]

    loop = MotionLoop(
        *(MotionStep(raster(speed=4.0), profile), link.arm, link.clock, lambda: tracker(link.clock.now()), due),
        tell=ticks.append,
        rhythm=rhythm,
    )
    loop.run(9.0)
    return ticks, profile


@pytest.mark.parametrize("seed", [0, *slowly(1)])
@pytest.mark.parametrize("slowest", [0.03, 0.2, 0.8])
def test_what_is_printed_lies_in_its_place_however_slow_the_tracker_is(slowest: float, seed: int) -> None:
    ticks, profile = printed(slowest, seed)
    moves = [t.command for t in ticks if isinstance(t.command, Move) and t.command.extrude]
    reached = np.array([move.stamp for move in moves]) + profile.tick + profile.lag
    nozzle = nozzle_from_axes(profile.arm, np.stack([move.axes for move in moves]))
    surface = np.stack([breathing(instant) for instant in reached])
    off = np.abs((se3.inverse(surface) @ nozzle)[:, 2, 3])  # the path lies in the surface's own plane
    assert len(moves) > 20 and off.max() < 1.0 and np.percentile(off, 95) < 0.5
    held = {t.command.reason for t in ticks if isinstance(t.command, Hold) and t.stamp > SLOW}
    if slowest == 0.03:
        assert not held and off.max() < 0.2
    if slowest == 0.8:
        assert any("old, limit 0.3 s" in reason or "is known to" in reason for reason in held)
