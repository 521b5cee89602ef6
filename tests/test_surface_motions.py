"""Motions of the surface: twist and pose agree, parts compose; the scenarios of data/scenarios can be printed."""

from __future__ import annotations

from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.synthetic.movements import MAX_DRAW_SIGMAS, ComposedMotion, shaking_amplitude
from hardware.files.path_file import read_path
from hardware.simulator.motion_table import motion_from_tables, waveform_from_table
from hardware.simulator.scenario import Scenario, read_scenario
from hardware.simulator.scene.shape import BODIES, Shape, Wound, body
from hardware.simulator.truth import drape_path
from planning.path import check_path

H = 1e-4  # s, half the step of a difference quotient
Spec = dict[str, Any]
SPECS: dict[str, Spec] = {
    "breathing": {"kind": "breathing", "amplitude_mm": 10.0, "turn_deg": [2, 1, 0], "sighs_per_min": 3.0},
    "pulse": {"kind": "pulse", "amplitude_mm": 0.15},
    "sine": {"kind": "sine", "amplitude_mm": 5.0, "rate_hz": 0.5, "direction": [1, 0, 0], "turn_deg": [0, 9, 9]},
    "steps": {"kind": "steps", "height_mm": 0.3, "every_s": 1.0, "rise_s": 0.2},
    "tremor": {"kind": "tremor", "rms_mm": [0.1, 0.2, 0.1], "rms_deg": [0.1, 0, 0]},
    "hand": {"kind": "hand", "rms_mm": [10, 10, 20], "rms_deg": [5, 10, 20], "pivot_mm": [0, -80, 10]},
    "drift": {"kind": "drift", "speed_mm_s": [0.01, 0, 0], "walk_mm": [1, 1, 1], "walk_deg": [1, 0, 0]},
    "ramp": {"kind": "ramp", "speed_mm_s": [3, 0, 0], "speed_deg_s": [0, 0, 9], "end_s": 2.0, "back": True},
    "constant": {"kind": "constant"},
    "turn": {"kind": "turn", "axis": [0, 1, 0], "pivot_mm": [100, 0, 0]},
}
KINDS = sorted(SPECS)
seeds = st.integers(0, 2**32 - 1)


def make(*specs: Spec, seed: int = 0) -> ComposedMotion:
    return motion_from_tables("scenario.toml", list(specs), Path(), seed)


@pytest.mark.parametrize("kind", [*KINDS, "all"])
@given(seed=seeds, start=st.floats(-20, 100))
@settings(max_examples=20)
def test_the_twist_is_the_velocity_of_the_pose(kind: str, seed: int, start: float) -> None:
    motion = make(*(SPECS.values() if kind == "all" else [SPECS[kind]]), seed=seed)
    times = start + np.linspace(0, 5, 26)
    poses = motion(times)
    quotient = se3.log(se3.inverse(motion(times - H)) @ motion(times + H)) / (2 * H)
    assert np.allclose(poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2), np.eye(3), atol=1e-12)
    error = np.abs(quotient - motion.twist(times))
    assert np.median(error) < 1e-6 * (1 + np.abs(quotient).max())
    assert error.max() < 1e-2 * (1 + np.abs(quotient).max())  # where a curvature jumps between the two samples


@given(seed=seeds, start=st.floats(0, 60))
@settings(max_examples=10)
def test_the_twist_integrates_to_the_pose(seed: int, start: float) -> None:
    motion, step = make(SPECS["hand"], SPECS["breathing"], seed=seed), 1e-3
    middles = start + step * (np.arange(1000) + 0.5)
    pose = motion(start)
    for increment in se3.exp(step * motion.twist(middles)):
        pose = pose @ increment
    assert np.abs(se3.log(se3.inverse(motion(start + 1.0)) @ pose)).max() < 1e-3


@given(first=st.sampled_from(KINDS), second=st.sampled_from(KINDS), start=st.floats(0, 60))
def test_parts_compose_in_order(first: str, second: str, start: float) -> None:
    times = start + np.linspace(0, 3, 7)
    both = make(SPECS[first], SPECS[second])
    one, two = ComposedMotion(both.parts[:1])(times), ComposedMotion(both.parts[1:])(times)
    assert np.allclose(both(times), one @ two, atol=1e-12)
    assert np.array_equal(one, make(SPECS[first])(times))  # a part draws by itself


def test_no_parts_are_a_surface_at_rest() -> None:
    assert np.array_equal(make()(np.zeros((2, 3))), np.broadcast_to(np.eye(4), (2, 3, 4, 4)))
    assert not make().twist(1.0).any()


def test_times_of_any_shape_give_the_same_bits() -> None:
    motion = make(*SPECS.values())
    times = np.linspace(-1, 20, 60).reshape(3, 4, 5)
    poses, twists = motion(times), motion.twist(times)
    assert (poses.shape, twists.shape) == ((3, 4, 5, 4, 4), (3, 4, 5, 6))
    assert poses[1, 2, 3].tobytes() == motion(times[1, 2, 3]).tobytes()
    assert twists[1, 2, 3].tobytes() == motion.twist(float(times[1, 2, 3])).tobytes()


@pytest.mark.parametrize("kind", ["breathing", "pulse", "tremor", "hand", "drift"])
def test_the_seed_alone_decides_what_is_drawn(kind: str) -> None:
    times = np.linspace(0, 60, 121)
    assert make(SPECS[kind], seed=3)(times).tobytes() == make(SPECS[kind], seed=3)(times).tobytes()
    assert not np.allclose(make(SPECS[kind], seed=3)(times), make(SPECS[kind], seed=4)(times))


@pytest.mark.parametrize("kind", [k for k in KINDS if k not in ("tremor", "pulse")])
def test_motions_begin_where_the_surface_rests(kind: str) -> None:
    assert np.allclose(make(SPECS[kind])(0.0), np.eye(4), atol=0.1)


def test_a_pivot_stays_where_it_is() -> None:
    pivot = np.array([[100.0, 0, 0]])
    motion = make(SPECS["turn"])
    for t in (1.3, 2.0, 5.5):
        assert np.abs(motion(t)[:3, 3]).max() > 1  # the origin moves
        assert np.allclose(se3.transform_points(motion(t), pivot), pivot, atol=1e-12)


@given(seed=seeds, amplitude=st.floats(0.1, 30), sigh=st.floats(1, 3))
@settings(max_examples=15)
def test_breathing_stays_within_its_amplitude_and_speed(seed: int, amplitude: float, sigh: float) -> None:
    spec = {"kind": "breathing", "amplitude_mm": amplitude, "sigh_factor": sigh, "sighs_per_min": 2.0}
    motion, times = make(spec, seed=seed), np.linspace(0, 300, 6001)
    z = motion(times)[:, 2, 3]
    most = amplitude * sigh * (1 + MAX_DRAW_SIGMAS * 0.15)
    assert z.min() >= -1e-9 and z.max() <= most + 1e-9
    steepest = 4 * (3 / 4) ** 1.5 / 2 * np.pi / 2 / 0.4  # of sin^4, in shares of its depth and length
    assert np.abs(motion.twist(times)[:, 5]).max() <= most * steepest / (4 * (1 - MAX_DRAW_SIGMAS * 0.1)) + 1e-9


def test_holding_irregular_breathing_of_ten_millimetres_for_180_ms_costs_one() -> None:
    motion, times = make({"kind": "breathing", "amplitude_mm": 10.0}), np.arange(0, 300, 0.01)
    held = motion(times + 0.18)[:, :3, 3] - motion(times)[:, :3, 3]
    assert 0.9 < np.sqrt(np.mean(np.sum(held**2, axis=1))) < 1.25


@pytest.mark.parametrize(("per_frame", "rate", "amplitude"), [(0.08, 0.1, 5.98), (0.47, 0.5, 7.03)])
def test_the_shaking_table_goes_as_far_as_the_thesis_says(per_frame: float, rate: float, amplitude: float) -> None:
    assert shaking_amplitude(per_frame, rate) == pytest.approx(amplitude, abs=0.005)
    motion = make({"kind": "sine", "mm_per_frame": per_frame, "rate_hz": rate, "direction": [1, 0, 0]})
    frames = np.arange(0, 100, 1 / 29.91)  # ten periods and more
    x = motion(frames)[:, :3, 3]
    assert np.mean(np.linalg.norm(np.diff(x, axis=0), axis=1)) == pytest.approx(per_frame, rel=0.01)
    assert np.ptp(x[:, 0]) == pytest.approx(2 * amplitude, rel=0.01)
    assert not x[:, 1:].any()  # one degree of freedom


def test_the_cube_goes_and_turns_at_a_constant_speed_in_all_six_degrees_of_freedom() -> None:
    motion = make({"kind": "constant", "unit_mm": 50.0})
    times = np.linspace(0, 20, 2001)
    corner = np.abs(np.mod(times, 2.0) - 1.0) <= 0.1
    speed = np.abs(motion.twist(times))[~corner]
    assert np.allclose(speed[:, :3], 0.3, atol=1e-9)  # rad/s
    coordinates = motion.parts[0].rates(times)
    assert np.allclose(np.abs(coordinates[~corner, 3:]), 0.3 * 50)
    assert np.abs(motion(times)[:, :3, 3]).max() <= 15.0 + 1e-9
    every_third = motion(np.arange(1, 57, 3) / 60)[:, :3, 3]  # 60 FPS, every third frame, up to the first corner
    assert np.allclose(np.diff(every_third[:17], axis=0), 15 / 20)


def test_turns_reach_25_and_minus_16_degrees_and_come_back() -> None:
    motion = make({"kind": "turn", "duration_s": 1.0, "hold_s": 1.0})
    angles = np.rad2deg(motion.parts[0].coordinates(np.array([0.0, 1, 2, 3, 4, 5, 6, 7, 8, 10])))[:, 2]
    assert np.allclose(angles, [0, 0, 25, 25, 0, 0, -16, -16, 0, 25])
    assert np.allclose(make({"kind": "turn", "repeat": False})(np.array([8.0, 10.0, 100.0])), np.eye(4))


def test_a_ramp_goes_at_its_speed_and_comes_back() -> None:
    motion = make(SPECS["ramp"])
    assert np.allclose(motion.twist(np.array([1.0, 3.0]))[:, 2], np.deg2rad([9, -9]))
    assert np.allclose(motion(np.array([1.0, 2.0, 9.0]))[:, 0, 3], [3.0, 6 - 2 * 3 * 0.2 * 3 / 32, 0.0])
    endless = make({"kind": "ramp", "speed_mm_s": [0, 0, 5]})
    assert np.allclose(endless(np.array([1.0, 50.0]))[:, 2, 3], [5.0, 250.0])


def test_steps_of_300_um_are_steps_of_300_um() -> None:
    z = make(SPECS["steps"])(np.array([0.9, 1.2, 1.9, 2.2, 3.2]))[:, 2, 3]
    assert np.allclose(z, [0, 0.3, 0.3, 0, 0.3])
    stairs = make({**SPECS["steps"], "pattern": "stairs"})
    assert np.allclose(stairs(np.array([1.2, 2.2, 3.2]))[:, 2, 3], [0.3, 0.6, 0.9])


def test_a_waveform_alone_has_unit_height() -> None:
    wave = waveform_from_table("s.toml", "scene.breathing", {"kind": "breathing"}, np.random.default_rng(0))
    values = wave(np.linspace(0, 60, 6001))
    assert values.min() >= 0
    assert 0.9 < np.median(values[1:-1][(values[1:-1] > values[:-2]) & (values[1:-1] > values[2:])]) < 1.1


@pytest.mark.parametrize(
    ("spec", "key", "allowed"),
    [
        ({"kind": "breething"}, "motion[0].kind", "did you mean 'breathing'"),
        ({}, "motion[0].kind", "this key"),
        ({"kind": 3}, "motion[0].kind", "breathing"),
        ({"kind": "breathing"}, "motion[0].amplitude_mm", "this key"),
        ({"kind": "breathing", "amplitude": 10}, "motion[0].amplitude_mm", "this key"),
        ({**SPECS["breathing"], "amplitud_mm": 10}, "motion[0].amplitud_mm", "did you mean 'amplitude_mm'"),
        ({**SPECS["breathing"], "rate_hz": 0.2, "period_s": 5}, "motion[0].rate_hz", "one of"),
        ({**SPECS["breathing"], "inspiration": 0.95}, "motion[0].inspiration", "0.1 to 0.9"),
        ({**SPECS["breathing"], "period_spread": 0.5}, "motion[0].period_spread", "0 to 0.36"),
        ({**SPECS["breathing"], "direction": [0, 0, 0]}, "motion[0].direction", "not all 0"),
        ({**SPECS["breathing"], "direction": [0, 1]}, "motion[0].direction", "3 finite numbers"),
        ({"kind": "sine", "amplitude_mm": 1}, "motion[0].rate_hz", "this key"),
        ({"kind": "sine", "amplitude_mm": 1, "rate_hz": 0}, "motion[0].rate_hz", "above 0"),
        ({"kind": "sine", "amplitude_mm": 1, "mm_per_frame": 1, "rate_hz": 1}, "motion[0].amplitude_mm", "none"),
        ({"kind": "steps", "height_mm": 0.3, "every_s": 1, "rise_s": 2}, "motion[0].rise_s", "to 1"),
        ({"kind": "steps", "amplitude_mm": 0.3}, "motion[0].height_mm", "this key"),
        ({"kind": "tremor"}, "motion[0].rms_mm", "rms_mm or rms_deg"),
        ({"kind": "tremor", "rms_mm": [1, -1, 0]}, "motion[0].rms_mm", ">= 0"),
        ({"kind": "hand", "rms_mm": [1, 1, 0], "band_hz": [3, 1]}, "motion[0].band_hz", "low < high"),
        ({"kind": "drift"}, "motion[0].speed_mm_s", "walk_mm"),
        ({"kind": "ramp", "speed_mm_s": [1, 0, 0], "back": True}, "motion[0].end_s", "back = true"),
        ({"kind": "ramp", "speed_mm_s": [1, 0, 0], "back": 1}, "motion[0].back", "true or false"),
        ({"kind": "turn", "angles_deg": []}, "motion[0].angles_deg", "one number or more"),
        ({"kind": "constant", "travel_s": 0}, "motion[0].travel_s", "0.001 or more"),
        ({"kind": "trace"}, "motion[0].file", "this key"),
    ],
)
def test_a_wrong_table_is_named(spec: Spec, key: str, allowed: str) -> None:
    with pytest.raises(InputError) as caught:
        make(spec)
    assert caught.value.where == "scenario.toml" and caught.value.what == key
    assert allowed in caught.value.allowed


def test_what_is_no_list_of_tables_is_refused() -> None:
    with pytest.raises(InputError, match="motion"):
        motion_from_tables("s.toml", {"kind": "sine"}, Path(), 0)
    with pytest.raises(InputError, match=r"scene\.breathing = 3"):
        waveform_from_table("s.toml", "scene.breathing", 3, np.random.default_rng(0))
    with pytest.raises(InputError, match=r"scene\.breathing\.amplitude_mm"):
        spec = {"kind": "breathing", "amplitude_mm": 1.0}
        waveform_from_table("s.toml", "scene.breathing", spec, np.random.default_rng(0))


FOLDER = Path(__file__).parents[1] / "data" / "scenarios"
FILES = sorted(FOLDER.glob("*.toml"))
SCENARIOS_KINDS = {  # what must be proved
    *("still", "shaking_table_0_1_hz", "shaking_table_0_5_hz", "thesis_cube", "turns", "hand", "steps_300um"),
    *("breathing_calm", "breathing_deep", "breathing_irregular", "nozzle_occlusion", "camera_lost", "clock_offsets"),
    *("printed_material", "wet_glare", "deformation"),
}


@cache
def scenario(file: Path) -> Scenario:
    return read_scenario(file)


@cache
def shape(kind: str, seed: int) -> Shape:
    return body(kind, Wound(), seed)


def test_there_is_one_for_each_thing_that_must_be_proved() -> None:
    assert {file.stem for file in FILES} >= SCENARIOS_KINDS
    assert len({scenario(file).title for file in FILES}) == len(FILES)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_scenario_says_above_its_title_what_it_proves_and_bounds_error_and_duty(file: Path) -> None:
    lines = file.read_text(encoding="utf-8").splitlines()
    comment = " ".join(line.removeprefix("# ") for line in takewhile(lambda line: line[:1] == "#", lines))
    assert "Proves" in comment
    assert comment.endswith(".")
    looks = scenario(file).looks is not None  # and stands aside meanwhile
    wanted = {"p95_mm", "max_mm" if looks else "duty"}
    assert wanted <= set(scenario(file).limits)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_path_lies_in_the_wound_and_can_be_printed_in_time(file: Path) -> None:
    asked = scenario(file)
    kind = asked.scene["body"]
    surface = shape(kind, asked.seed)
    path = read_path(asked.path)
    places = path.surface_from_nozzle[:, :3, 3]
    x, y = np.rint(surface.nodes(places)).astype(int).T
    assert surface.inside[y, x].min() > asked.bead / 2  # not even the bead's edge is on the rim
    assert (np.abs(places[:, :2]) < np.array(BODIES[kind][1]) / 2).all()
    fine = check_path(drape_path(path, surface, asked.clearance))
    length = np.linalg.norm(np.diff(fine.surface_from_nozzle[:, :3, 3], axis=0), axis=1)
    assert 5.0 + float(np.sum(length / fine.speed[1:])) < asked.seconds  # 5 s to see the surface and to get there


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_motion_stays_where_cameras_and_arm_reach(file: Path) -> None:
    asked = scenario(file)
    motion = asked.motion(np.linspace(0, asked.seconds, 400))
    assert np.linalg.norm(motion[:, :3, 3], axis=1).max() < 60.0
    moves = np.ptp(motion[:, :3, 3], axis=0).max() + np.ptp(motion[:, :3, :3], axis=0).max() * 50
    assert (moves > 0.1) == (file.stem not in ("still", "look"))
