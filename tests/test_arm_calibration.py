"""The arm's place, tool and latency from sightings of its tip: laws, honesty, and sets of moves that cannot tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.calibration.arm_fit import ArmUnknowns, fit_arm, fit_touches, jackknife
from estimation.calibration.arm_model import (
    ArmParameters,
    SetPoint,
    Sightings,
    check_latency,
    check_places,
    check_turns,
    first_pose,
    predict,
)
from estimation.errors import InputError
from estimation.rig import Rig, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.arm.profile import ArmProfile, placed
from hardware.bench.calibration import set_point_of, sightings_of
from hardware.calibration.arm_record import MoveOptions, plan_moves
from hardware.calibration.arm_report import judge_arm
from hardware.calibration.arm_run import calibrate_touched
from hardware.calibration.arm_solve import (
    ArmCalibration,
    TipObservations,
    calibrated_profile,
    hidden_tips,
    kinematics_of,
    visible_needle,
)
from hardware.files.arm_file import read_arm
from hardware.files.rig_file import write_rig
from hardware.simulator.arm.controller import Polyline, Servo
from perception.frames import SYRINGE

RIG, TOLD = arc_rig(), placed(ArmProfile(), BASE_FROM_REST)
KINEMATICS = kinematics_of(TOLD.arm)
START = TOLD.arm.home
FEW = MoveOptions(places=9, dwell=0.4, swing=3.0)


def true_state(seed: int) -> ArmParameters:
    draw = np.random.default_rng(seed)
    pose = se3.inverse(TOLD.arm.arm_from_base) @ se3.exp(draw.normal(size=6) * [0.03, 0.03, 0.03, 5, 5, 5])
    return ArmParameters(pose, draw.normal(size=3) * 2, *draw.uniform(0.005, 0.03, 2), 0.3)


def sent(wishes: MoveOptions = FEW) -> SetPoint:
    return set_point_of(plan_moves(START, TOLD.limits, TOLD.tick, wishes), TOLD.tick)


def seen(
    state: ArmParameters, noise: float = 0.0, outliers: float = 0.0, rig: Rig = RIG, period: float = 0.2
) -> Sightings:
    return sightings_of(state, sent(), KINEMATICS, rig, period, noise, outliers, np.random.default_rng(7))


def start_from(sightings: Sightings, rig: Rig = RIG) -> ArmParameters:
    pose = first_pose(sightings, sent(), KINEMATICS, rig)[0]
    return ArmParameters(pose, np.zeros(3), 0.01, 0.01, 0.4)


@settings(max_examples=4)
@given(st.integers(0, 10_000))
def test_without_noise_the_truth_comes_back(seed: int) -> None:
    true = true_state(seed)
    sightings = seen(true, outliers=0.05)
    found = fit_arm(sightings, sent(), KINEMATICS, RIG, start_from(sightings)).state
    assert np.abs(se3.log(se3.inverse(true.base_from_arm) @ found.base_from_arm)).max() < 1e-3
    assert found.tool == pytest.approx(true.tool, abs=1e-3)
    assert (found.dead_time, found.lag) == pytest.approx((true.dead_time, true.lag), abs=2e-5)
    assert found.blunt == pytest.approx(true.blunt, abs=1e-3)


def test_a_moved_base_moves_the_answer_and_nothing_else() -> None:
    true, change = true_state(3), se3.exp([0.4, -0.3, 0.8, 120.0, -60.0, 30.0])
    moved = Rig(tuple(replace(c, base_from_camera=change @ c.base_from_camera) for c in RIG.cameras))
    sightings = seen(true, noise=0.2, outliers=0.03)
    here = fit_arm(sightings, sent(), KINEMATICS, RIG, start_from(sightings))
    there = fit_arm(sightings, sent(), KINEMATICS, moved, start_from(sightings, moved))
    assert np.allclose(there.state.base_from_arm, change @ here.state.base_from_arm, atol=1e-3)
    assert there.state.tool == pytest.approx(here.state.tool, abs=1e-4)
    assert there.state.dead_time == pytest.approx(here.state.dead_time, abs=1e-6)
    assert np.allclose(there.sigma, here.sigma, rtol=1e-3)


@pytest.mark.slow
def test_errors_are_as_large_as_is_claimed_and_blunders_are_left_out() -> None:
    squares = []
    for seed in range(4):
        true, draw = true_state(seed), np.random.default_rng(seed)
        sightings = sightings_of(true, sent(), KINEMATICS, RIG, 0.2, 0.3, 0.1, draw)
        found = fit_arm(sightings, sent(), KINEMATICS, RIG, start_from(sightings))
        gap = se3.log(se3.inverse(true.base_from_arm) @ found.state.base_from_arm)
        late = [found.state.dead_time - true.dead_time, found.state.lag - true.lag]
        off = np.concatenate([gap, found.state.tool - true.tool, late])
        squares.append(off @ np.linalg.solve(found.covariance[:11, :11], off) / 11)
        assert found.scatter == pytest.approx(1.0, abs=0.1) and 0.85 < found.used.mean() < 0.95
    assert 0.5 < np.mean(squares) < 1.7  # 99.8 % of chi^2 with 44


@pytest.mark.slow
def test_what_is_off_alike_at_a_place_is_in_the_doubt() -> None:
    plain, wide = [], []
    for seed in range(2):
        true, draw = true_state(seed), np.random.default_rng(seed)
        sightings = sightings_of(true, sent(), KINEMATICS, RIG, 0.2, 0.1, 0.0, draw)
        group = np.searchsorted(np.quantile(sightings.stamp, np.linspace(0, 1, 8)), sightings.stamp)
        alike = draw.normal(size=(9, len(RIG), 2)) * 0.4  # px, of each camera in each seventh of the time
        sightings = replace(sightings, pixels=sightings.pixels + alike[group, sightings.camera])
        found = fit_arm(sightings, sent(), KINEMATICS, RIG, start_from(sightings))
        left = [sightings.take(group != g) for g in range(1, 8)]
        states = [fit_arm(some, sent(), KINEMATICS, RIG, found.state).state for some in left]
        doubted = jackknife(found, states)
        assert doubted.widened_by > 2 and found.widened_by == 1
        gap = se3.log(se3.inverse(true.base_from_arm) @ found.state.base_from_arm)
        off = np.concatenate([gap, found.state.tool - true.tool])
        for out, fit in ((plain, found), (wide, doubted)):
            out.append(off @ np.linalg.solve(fit.covariance[:9, :9], off) / 9)
        assert np.allclose(jackknife(found, [found.state] * 3).covariance, found.covariance)
    assert np.mean(plain) > 2.5 and 0.3 < np.mean(wide) < 2.5


def test_what_the_rig_may_be_off_by_is_in_the_doubt() -> None:
    sightings = seen(true_state(8), noise=0.2)
    start = start_from(sightings)
    alone = fit_arm(sightings, sent(), KINEMATICS, RIG, start)
    doubt = np.diag(np.tile([1.0, 1.0, 1.0, 1.0, *[1e-4] * 5, *[2e-4] * 3, *[0.1] * 3, 1e-4], 3) ** 2)
    doubted = fit_arm(sightings, sent(), KINEMATICS, RIG, start, rig_covariance=doubt)
    assert (doubted.sigma[:6] > 1.3 * alone.sigma[:6]).all()


def test_what_is_not_asked_stays_as_it_was() -> None:
    true = true_state(9)
    start = replace(true, base_from_arm=true.base_from_arm @ se3.exp([0.01, 0, 0, 1, 1, 1]))
    found = fit_arm(seen(true), sent(), KINEMATICS, RIG, start, ArmUnknowns(False, False, False))
    assert (found.state.dead_time, found.state.lag, found.state.blunt) == (true.dead_time, true.lag, true.blunt)
    assert found.state.tool is true.tool and not found.covariance[6:].any()
    assert np.allclose(found.state.base_from_arm, true.base_from_arm, atol=1e-4)


@settings(max_examples=4)
@given(st.integers(0, 10_000))
def test_slopes_are_those_of_differences(seed: int) -> None:
    state, draw = replace(true_state(seed), blunt=0.0), np.random.default_rng(seed)  # the end's own are left out
    stamp, camera, point = draw.uniform(1.0, 20.0, 20), draw.integers(0, 3, 20), sent()

    def pixels(changed: ArmParameters) -> Array:
        return predict(changed, point, KINEMATICS, RIG, stamp, camera).pixels

    found, h = predict(state, point, KINEMATICS, RIG, stamp, camera), 1e-4
    for k in range(6):
        nudged = [replace(state, base_from_arm=state.base_from_arm @ se3.exp(s * h * np.eye(6)[k])) for s in (-1, 1)]
        numeric = (pixels(nudged[1]) - pixels(nudged[0])) / (2 * h)
        assert np.allclose(found.by_arm[..., k], numeric, rtol=1e-2, atol=0.5 if k < 3 else 5e-3)
    for k in range(3):
        nudged = [replace(state, tool=state.tool + s * h * np.eye(3)[k]) for s in (-1, 1)]
        assert np.allclose(found.by_tool[..., k], (pixels(nudged[1]) - pixels(nudged[0])) / (2 * h), atol=2e-2)


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.floats(0.0, 0.05), st.sampled_from([0.0, 1e-4, 0.01, 0.05]))
def test_a_lagged_set_point_is_where_the_simulated_servo_is(seed: int, dead: float, lag: float) -> None:
    draw = np.random.default_rng(seed)
    instants = np.cumsum(draw.uniform(0.005, 0.1, 30))
    axes = draw.normal(size=(30, 6)) * 20
    point = SetPoint(instants, axes)
    line = Polyline(float(instants[0]), axes[0])
    for instant, at, slope in zip(instants, axes, point.slopes, strict=True):
        line.append(float(instant), at, slope)
    stamps = np.sort(draw.uniform(instants[0], instants[-1] + 0.3, 200))
    now = float(instants[-1] + 0.4)
    assert np.allclose(point.lagged(stamps, dead, lag), Servo(line, dead, lag).at(stamps, now), atol=2e-5)


def test_places_are_where_the_set_point_has_rested_long_enough() -> None:
    axes = np.zeros((6, 6))
    axes[:, 0] = [0, 0, 10, 10, 20, 20]
    point = SetPoint(np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0]), axes)
    found = point.places(np.array([0.5, 1.5, 2.1, 2.9, 3.5, 4.5, 9.0]), 0.5)
    assert found.tolist() == [0, -1, -1, 1, -1, 2, 2]


def place_grid(columns: Array) -> Array:
    return np.random.default_rng(0).uniform(-40, 40, (10, 3)) * columns + START[:3]


@pytest.mark.parametrize(
    ("check", "words"),
    [
        (lambda: check_places(place_grid(np.ones(3))[:3]), ["places", "3", "4 or more"]),
        (lambda: check_places(place_grid(np.array([1.0, 0, 0]))), ["across a line"]),
        (lambda: check_places(place_grid(np.array([1.0, 1, 0]))), ["across a plane"]),
        (
            lambda: check_turns(np.broadcast_to(np.eye(4), (8, 4, 4))),
            ["turns of the tool", "0.0 degrees", "--keep-tool"],
        ),
        (
            lambda: check_turns(se3.exp(np.linspace(-0.4, 0.4, 8)[:, None] * np.eye(6)[1])),
            ["about y alone", "second axis"],
        ),
        (lambda: check_latency(sent(), KINEMATICS, np.zeros(0)), ["on its way", "--keep-latency"]),
        (
            lambda: check_latency(sent(replace(FEW, swing=0.0, speed=40.0)), KINEMATICS, np.arange(0.5, 20, 0.01)),
            ["changing its speed", "--keep-latency"],
        ),
    ],
)
def test_moves_that_cannot_tell_are_named(check: Callable[[], None], words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        check()
    assert all(word in str(caught.value) for word in words), caught.value


def test_moves_that_can_tell_pass() -> None:
    targets = plan_moves(START, TOLD.limits, TOLD.tick, FEW)
    check_places(targets[:, :3])
    check_turns(KINEMATICS(targets))
    check_latency(sent(), KINEMATICS, np.arange(0.5, sent().instants[-1], 0.05))


def test_a_tip_that_no_two_cameras_agree_on_is_named() -> None:
    sightings = seen(true_state(1))
    noise = np.random.default_rng(1).uniform(0, 600, sightings.pixels.shape)
    with pytest.raises(InputError, match="needle in view"):
        first_pose(replace(sightings, pixels=noise), sent(), KINEMATICS, RIG)


def test_the_profile_takes_over_what_was_found() -> None:
    state = true_state(2)
    profile = calibrated_profile(TOLD, state, ArmUnknowns())
    assert np.allclose(profile.arm.arm_from_base @ state.base_from_arm, np.eye(4), atol=1e-12)
    assert profile.lag == pytest.approx(profile.frame_time + state.dead_time + state.lag)
    assert calibrated_profile(TOLD, state, ArmUnknowns(latency=False)).lag == TOLD.lag


@given(st.floats(-1.0, 1.0))
def test_a_tool_hides_its_needle_from_who_looks_along_it(along: float) -> None:
    square = float(np.sqrt(1 - along**2))
    height, upper = np.arange(0, 12.8, 0.05), np.arange(12.85, 96, 0.05)
    beside = (upper - height[:, None]) * square  # times `along`, of the line of sight from the axis, where it is higher
    hit = (along > 0) & (beside < along * np.interp(upper, *SYRINGE.T)).any(1)
    free = height[: int(np.argmax(hit))] if hit.any() else height
    expected = square * float(free[-1]) if len(free) else 0.0
    assert float(visible_needle(SYRINGE, np.array([along]))[0]) == pytest.approx(expected, abs=0.1)


def test_where_the_tool_hides_its_tip_is_told_from_where_it_is_lost() -> None:
    state, point = true_state(4), sent()
    rested = np.unique(sightings_of(state, point, KINEMATICS, RIG, 0.2, 0.0, 0.0, np.random.default_rng(0)).stamp)[:6]
    ahead = state.base_from_arm @ KINEMATICS(point.lagged(rested, state.dead_time, state.lag))
    watcher = RIG.cameras[0]
    for turn, hides in ((0.0, True), (np.pi / 2, False)):
        view = ahead[0, :3, :3] @ se3.exp_rotation([0.0, turn + np.pi, 0.0])  # looks down the tool, or at its side
        place = ahead[0, :3, 3] + ahead[0, :3, :3] @ state.tool - 400 * view[:, 2]
        rig = Rig((replace(watcher, base_from_camera=se3.make(view, place)),))
        found = hidden_tips(state, SYRINGE, point, KINEMATICS, rig, rested[:1], np.zeros(1, np.int64))
        assert found.tolist() == [hides]


def test_the_verdict_says_how_well_the_lag_is_known_and_how_well_it_must_be() -> None:
    sightings = seen(true_state(2), noise=0.2)
    fit = fit_arm(sightings, sent(), KINEMATICS, RIG, start_from(sightings))
    counts, beside = np.full(len(RIG), 9), np.full(len(sightings.stamp), 0.1)
    look = TipObservations(sightings, counts, counts, (), (np.zeros(0), np.zeros(0, np.int64)))
    given = look, sent(), fit, np.zeros((9, 3)), np.full(9, 0.1), beside, beside, ArmUnknowns(), counts
    lines = judge_arm(ArmCalibration(RIG, TOLD, *given), 1.0).lines
    (line,) = [line for line in lines if "ms late" in line]
    assert "; both together are known to ± " in line and line.endswith(" ms, ± 5 ms is allowed")


def touched(count: int, seek: bool, sigma: float) -> tuple[ArmParameters, Array, Array]:
    draw, true = np.random.default_rng(count), true_state(11)
    axes = START + np.column_stack([draw.uniform(-60, 60, (count, 3)), draw.uniform(-0.4, 0.4, (count, 3)) * seek])
    tool = true.tool if seek else np.zeros(3)
    points = se3.transform_points(true.base_from_arm @ KINEMATICS(axes), tool[None])[:, 0]
    return replace(true, tool=tool), axes, points + sigma * draw.normal(size=points.shape)


@pytest.mark.parametrize("seek", [True, False])
def test_touched_points_tell_the_place(seek: bool) -> None:
    true, axes, points = touched(6, seek, 0.0)
    found = fit_touches(KINEMATICS(axes), points, np.full(6, 0.2), np.zeros(3), seek)
    assert np.allclose(found.base_from_arm, true.base_from_arm, atol=1e-3)
    assert found.tool == pytest.approx(true.tool, abs=1e-3) and np.abs(found.residuals).max() < 1e-3


def touched_file(tmp_path: Path, axes: Array, points: Array, pixels: bool) -> tuple[Path, Path]:
    file, rig = tmp_path / "points.toml", tmp_path / "rig.toml"
    write_rig(rig, RIG, [None] * 3)
    lines = []
    for row, point in zip(axes * [1, 1, 1, *np.rad2deg([1.0, 1, 1])], points, strict=True):
        lines += ["[[point]]", f"arm_mm_deg = {row.tolist()}"]
        if pixels:
            at = {c.name: pixels_from_points(c, point[None])[0][0].tolist() for c in RIG.cameras}
            lines.append("pixels = {" + ", ".join(f"{name} = {value}" for name, value in at.items()) + "}")
        else:
            lines.append(f"base_mm = {point.tolist()}")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file, rig


@pytest.mark.parametrize("pixels", [True, False])
def test_a_file_of_touched_points_makes_an_arm_file(tmp_path: Path, pixels: bool) -> None:
    true, axes, points = touched(6, True, 0.0)
    file, rig = touched_file(tmp_path, axes, points, pixels)
    verdict, _ = calibrate_touched(file, rig, TOLD, tmp_path / "arm.toml", keep_tool=False)
    assert verdict.passed
    arm = read_arm(tmp_path / "arm.toml").arm
    assert np.allclose(arm.arm_from_base @ true.base_from_arm, np.eye(4), atol=1e-2)
    assert arm.tool_offset == pytest.approx(true.tool, abs=1e-2)


def test_a_point_that_was_another_one_is_named(tmp_path: Path) -> None:
    _, axes, points = touched(8, False, 0.05)
    points[4] += [0.0, 4.0, 0.0]
    file = touched_file(tmp_path, axes, points, False)
    verdict, _ = calibrate_touched(*file, TOLD, tmp_path / "arm.toml", keep_tool=True)
    assert not verdict.passed and "touch point 5 again" in verdict.hints[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[point]]\narm_mm_deg = [1, 2, 3]\nbase_mm = [1, 2, 3]\n", ["point[0].arm_mm_deg"]),
        ("[[point]]\narm_mm_deg = [1, 2, 3, 0, 0, 0]\n", ["point[0].base_mm, pixels", "one of the two"]),
        ("[[point]]\narm_mm_deg = [1, 2, 3, 0, 0, 0]\npixels = {cam_0 = [1, 2]}\n", ["two cameras or more"]),
        ("[[point]]\narm_mm_deg = [1, 2, 3, 0, 0, 0]\npixels = {cam_0 = [1, 2], left = [1, 2]}\n", ["left"]),
        (
            "[[point]]\narm_mm_deg = [1, 2, 3, 0, 0, 0]\npixels = {cam_0 = [100, 100], cam_1 = [900, 700]}\n",
            ["px from the place where the cameras agree"],
        ),
    ],
)
def test_a_wrong_file_of_points_is_named(tmp_path: Path, text: str, words: list[str]) -> None:
    file, rig = tmp_path / "points.toml", tmp_path / "rig.toml"
    write_rig(rig, RIG, [None] * 3)
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        calibrate_touched(file, rig, TOLD, tmp_path / "arm.toml", keep_tool=True)
    assert all(word in str(caught.value) for word in [str(file), *words]), caught.value
