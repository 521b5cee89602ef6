"""What a live run says of the error at its nozzle holds 95 % of the true errors, as short simulated runs show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.pose import SurfacePose, radius
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.live.outcome import RunStatistics
from hardware.live.records import LiveMotionReport, RunReports, TrackingReport
from hardware.motion.loop import Tick
from hardware.motion.step import PredictedError, PrintMotion, predicted_error
from hardware.operator.view import RunStage
from hardware.simulator.scenario import read_scenario
from planning.command import Move
from planning.kinematics import axes_from_nozzle
from planning.path import PrintProgress
from tests.moving_surfaces import breathing, pose_at, raster
from tests.simulated_worlds import Heard, world_of, write_path, write_scenario

TICK = ArmProfile().tick
BREATHING = {"kind": "breathing", "amplitude_mm": 4.0, "rate_hz": 0.25, "turn_deg": [1.0, 0.4, 0.0]}
IRREGULAR = BREATHING | {"amplitude_mm": 6.0, "period_spread": 0.1, "depth_spread": 0.15, "sighs_per_min": 2.0}
MOTIONS = {
    "calm": [BREATHING, {"kind": "pulse", "amplitude_mm": 0.15}],
    "deep": [BREATHING | {"amplitude_mm": 10.0, "turn_deg": [2.5, 1.0, 0.0]}],
    "fast": [BREATHING | {"amplitude_mm": 2.0, "rate_hz": 0.4}],
    "irregular": [IRREGULAR],
}
LINE = [[x, y, 0.0] for y in np.arange(-4.0, 5.0, 2.0) for x in ((-8, 8) if y % 4 else (8, -8))]


class Claims(Heard):
    """Tells the statistics of a live run what its reports would; keeps what they say of each tick."""

    def __init__(self) -> None:
        super().__init__()
        self.statistics, self.said = RunStatistics(), list[tuple[float, float]]()
        self._reports = RunReports()
        self.motion: PrintMotion | None = None

    def pose_delivery(self, pose: SurfacePose) -> None:
        sets = 1 if self._reports.tracking is None else self._reports.tracking.sets + 1
        self._reports.tracking = TrackingReport(pose.stamp, ("a",), pose=pose, sets=sets)

    def tick(self, tick: Tick, progress: PrintProgress | None) -> None:
        super().tick(tick, progress)
        if progress is None or self._reports.tracking is None or self._reports.tracking.pose is None:
            return
        assert self.motion is not None
        made = self._reports.tracking.pose.stamp, self.motion.arm_lag
        motion = LiveMotionReport(tick, progress, None, (), (), 0, 0, None, 0, "", *made)
        self._reports.motion = motion
        self.statistics.update(tick.stamp, RunStage.PRINT, self._reports)
        self.said.append((tick.stamp + TICK + self.motion.arm_lag, self.statistics.claim))


def claimed(folder: Path, motion: str, seconds: float) -> tuple[RunStatistics, Array, Array]:
    """The statistics of a run, what they claim of each instant at which material left, and the true errors: (N,) mm."""
    write_path(folder / "path.csv", LINE)
    scenario = read_scenario(
        write_scenario(
            folder, {"tracking": {"by": "tracks"}, "arm": {"file": "arm.toml"}}, seconds=seconds, motion=MOTIONS[motion]
        )
    )
    sink = Claims()
    world = world_of(scenario, sink)
    sink.motion, begin = world.motion, world.motion.begin
    world.motion.begin = lambda path, profile, *more: (
        sink.statistics.begin(path, profile),
        begin(path, profile, *more),
    )
    world.run()
    log = sink.log
    dues, claims = np.array(sink.said).T
    rows = np.minimum(np.searchsorted(log.stamps, dues), len(log) - 1)
    counts = np.isfinite(claims) & log.extrude[rows] & (dues <= log.stamps[-1])
    errors = np.linalg.norm(log.base_from_nozzle[rows, :3, 3] - log.base_from_target[rows, :3, 3], axis=1)
    return sink.statistics, claims[counts], errors[counts]


@pytest.mark.slow
@pytest.mark.parametrize("motion", list(MOTIONS))
def test_a_claim_of_95_percent_holds_90_to_99_percent(tmp_path: Path, motion: str) -> None:
    statistics, claims, errors = claimed(tmp_path, motion, 22.0)
    assert len(errors) > 400
    assert 0.90 <= np.mean(errors <= claims) <= 0.99
    assert 0.7 < statistics.predicted["p95"] / np.percentile(errors, 95) < 1.5
    assert np.isfinite(statistics.stretches).any() and np.nanmax(statistics.stretches) == statistics.largest


def test_a_ball_about_another_place_than_the_mean_holds_its_share() -> None:
    rng = np.random.default_rng(5)
    for size in (0.0, 0.5, 2.0, 6.0):
        half = rng.normal(size=(3, 3)) * np.array([0.05, 0.1, 0.3])
        offset = size * 0.1 * rng.normal(size=3)
        errors = offset + rng.normal(size=(20_000, 3)) @ half.T
        held = np.linalg.norm(errors, axis=1) <= radius(half @ half.T, 0.95, offset)
        assert 0.93 < np.mean(held) < 0.97


def test_a_claim_is_of_the_instant_at_which_the_arm_is_there_and_has_in_it_what_the_move_misses() -> None:
    profile, path, pose = ArmProfile(), raster(), replace(pose_at(breathing, 0.0), acceleration_psd=np.full(6, 20.0))
    place = path.surface_from_nozzle[1]

    def said(ahead: float, off: float) -> PredictedError:
        led = breathing(ahead) @ place @ se3.make(np.eye(3), [0.0, 0.0, off])
        move = Move(0.0, axes_from_nozzle(profile.arm, led[None])[0], 5.0, 1, True)
        return predicted_error(move, ahead, pose, profile, path, 1.0)

    near, far, missed = said(0.05, 0.0), said(0.1, 0.0), said(0.05, 1.0)
    assert 0 < near.within < far.within and 0 < near.sigma < far.sigma
    assert near.sigma * 1.9 < near.within < near.sigma * 2.9
    assert missed.sigma == pytest.approx(near.sigma, rel=0.05) and 1.0 < missed.within < 1.0 + 2.9 * near.sigma
    assert (np.diff(missed.radii) > 0).all() and missed.radii[-1] == pytest.approx(missed.within)
