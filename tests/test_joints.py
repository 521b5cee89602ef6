"""Joints: forward and inverse in every posture, Jacobian by differences, singularities; an arm given by joints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path as Folder

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.files.arm_file import read_arm, write_arm
from planning.command import Hold, Move, Refusal, RefusalCode
from planning.kinematics import (
    ELBOWS,
    POSTURES,
    SHOULDERS,
    WRISTS,
    JointModel,
    axes_from_nozzle,
    jacobian,
    joint_distance,
    joints_from_axes,
    joints_from_nozzle,
    joints_from_tip,
    nozzle_from_axes,
    nozzle_from_joints,
)
from planning.motion.guard import Guard
from planning.motion.planner import Planner
from planning.path import PrintPhase
from tests.campaigns.planner import StreamTally, bench_arm, follow_stream
from tests.moving_surfaces import REST, breathing, pose_at, raster

SEEDS = st.integers(0, 100_000)
FLIP = np.diag([1.0, -1, -1])  # the nozzle's z points back into the tool, the flange's out of it


def random_model(draw: np.random.Generator, lateral: float = 30.0) -> JointModel:
    """An elbow arm of any proportions, side and posture, on any foot, with any tool. lateral: mm of shoulder offset."""
    sides = draw.choice([-1.0, 1.0], 4)
    lengths = draw.uniform([-40, 150, -40], [60, 300, 40])
    shifts = draw.uniform([50, -lateral, -lateral, 100, 30], [250, lateral, lateral, 300, 90])
    alpha = np.pi / 2 * np.array([sides[0], 0, *sides[1:], 0])
    dh = np.stack([np.append(lengths, [0.0, 0, 0]), alpha, np.insert(shifts, 4, 0.0), draw.uniform(-3, 3, 6)], 1)
    return JointModel(
        "made up",
        dh,
        np.full(6, -np.pi),
        np.full(6, np.pi),
        np.full(6, 2.0),
        np.full(6, 10.0),
        se3.exp(draw.normal(size=6) * [0.3, 0.3, 0.3, 50, 50, 50]),
        se3.exp(draw.normal(size=6) * [0.3, 0.3, 0.3, 20, 20, 20]) @ se3.make(FLIP, [0, 0, 80.0]),
        tuple(str(draw.choice(words)) for words in (SHOULDERS, ELBOWS, WRISTS)),
    )


def random_joints(draw: np.random.Generator, count: int) -> Array:
    """Joints (count, 6), rad, anywhere."""
    return np.asarray(draw.uniform(-np.pi, np.pi, (count, 6)))


def all_postures(model: JointModel, wanted: np.ndarray) -> np.ndarray:
    """Joints (8, ..., 6), rad, in each of POSTURES."""
    return np.stack([joints_from_nozzle(model, wanted, signs) for signs in POSTURES])


@given(SEEDS)
def test_every_posture_that_is_found_brings_the_nozzle_there(seed: int) -> None:
    draw = np.random.default_rng(seed)
    model = random_model(draw)
    wanted = nozzle_from_joints(model, random_joints(draw, 10))
    found = all_postures(model, wanted)
    reached = np.asarray(np.isfinite(found).all(axis=-1))
    got = nozzle_from_joints(model, np.where(reached[..., None], found, 0.0))
    assert np.abs(got - wanted).max((-1, -2))[reached].max() < 1e-6
    assert (reached.sum(axis=0) >= 2).all()  # a wrist has two solutions wherever it is reached


@given(SEEDS)
def test_the_joints_one_started_from_are_among_the_postures(seed: int) -> None:
    draw = np.random.default_rng(seed)
    model = random_model(draw)
    joints = random_joints(draw, 5)
    found = all_postures(model, nozzle_from_joints(model, joints))
    off = np.abs(np.exp(1j * found) - np.exp(1j * joints)).max(-1)
    assert (np.nanmin(off, axis=0) < 1e-5).all()


@given(SEEDS)
def test_tip_and_wrist_joints_give_the_whole_arm_back(seed: int) -> None:
    draw = np.random.default_rng(seed)
    model = random_model(draw)
    wanted = nozzle_from_joints(model, random_joints(draw, 20))
    joints = joints_from_nozzle(model, wanted)
    reached = np.isfinite(joints).all(axis=-1)
    back = joints_from_tip(model, wanted[:, :3, 3], joints[:, 3:])
    assert np.isfinite(back[reached]).all()
    got = nozzle_from_joints(model, back[reached])
    assert np.allclose(got[:, :3, 3], wanted[reached, :3, 3], atol=1e-6)
    assert np.allclose(back[reached, 3:], joints[reached, 3:], atol=1e-9)


@given(SEEDS)
def test_the_jacobian_is_the_derivative(seed: int) -> None:
    draw = np.random.default_rng(seed)
    model, joints, step = random_model(draw), random_joints(draw, 1)[0], 1e-6
    matrix = jacobian(model, joints)
    for i in range(6):
        before, after = (nozzle_from_joints(model, joints + h * np.eye(6)[i]) for h in (-step, step))
        turn = se3.log_rotation(after[:3, :3] @ before[:3, :3].T) / (2 * step)
        assert np.allclose(matrix[:3, i], turn, atol=1e-6)
        assert np.allclose(matrix[3:, i], (after - before)[:3, 3] / (2 * step), atol=1e-4)


@given(SEEDS)
def test_manipulability_vanishes_in_each_singularity_and_only_there(seed: int) -> None:
    draw = np.random.default_rng(seed)
    model, joints = random_model(draw, lateral=0.0), random_joints(draw, 1)[0]
    straight = joints.copy()
    straight[4] = -model.dh[4, 3]
    assert joint_distance(model, straight).wrist < 1e-9 and joint_distance(model, straight).manipulability < 1e-9
    stretched = joints.copy()
    a, alpha, d, theta = model.dh.T
    stretched[2] = -theta[2] - np.arctan2(-np.sign(alpha[2]) * d[3], a[2])
    assert joint_distance(model, stretched).elbow < 1e-9 and joint_distance(model, stretched).manipulability < 1e-9
    free = joint_distance(model, joints)
    if min(free.wrist, free.elbow) > 0.2 and free.shoulder > 50:
        assert free.manipulability > 1e-4


def test_continuous_poses_have_continuous_joints_in_one_posture() -> None:
    model = random_model(np.random.default_rng(3), lateral=0.0)
    start = np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7]) - model.dh[:, 3]
    line = nozzle_from_joints(model, start) @ se3.exp(np.linspace(0, 1, 200)[:, None] * np.array([0.1, 0, 0, 5, 5, 5]))
    for signs in POSTURES:
        joints = joints_from_nozzle(model, line, signs)
        if np.isfinite(joints).all():
            steps = np.abs(np.angle(np.exp(1j * np.diff(joints, axis=0))))
            assert steps.max() < 0.02


def test_what_is_too_far_is_nan_in_every_posture() -> None:
    model = random_model(np.random.default_rng(0))
    assert np.isnan(all_postures(model, se3.make(np.eye(3), [3000.0, 0, 0]))).any(axis=-1).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"low": np.full(6, 4.0)}, "below high"),
        ({"speed": np.zeros(6)}, "> 0"),
        ({"posture": ("front", "sideways", "positive")}, "up or down"),
        ({"dh": np.zeros((6, 4))}, "alpha"),
        ({"dh": np.zeros((5, 4))}, "finite numbers"),
        ({"flange_from_nozzle": np.zeros((4, 4))}, "rigid motion"),
    ],
)
def test_an_arm_that_makes_no_sense_is_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        replace(random_model(np.random.default_rng(0)), **change)


FILE = Folder(__file__).parents[1] / "data" / "arms" / "six_axis.toml"
TICK = 0.02


def profile() -> ArmProfile:
    return bench_arm(read_arm(FILE))


@given(st.integers(0, 10_000))
def test_axes_and_nozzle_are_one(seed: int) -> None:
    draw = np.random.default_rng(seed)
    arm = profile().arm
    nozzle = REST @ se3.exp(draw.normal(size=(5, 6)) * [0.1, 0.1, 0.3, 20, 20, 20])
    axes = axes_from_nozzle(arm, nozzle)
    assert np.allclose(axes[:, :3], nozzle[:, :3, 3])
    assert np.allclose(nozzle_from_axes(arm, axes), nozzle, atol=1e-8)


@pytest.mark.slow
def test_a_whole_print_keeps_the_joints_within_ranges_and_speeds() -> None:
    settings_ = profile()
    arm, model = settings_.arm, settings_.arm.joints
    path = raster(size=5, lines=2)
    planner, guard = Planner(path, settings_.limits, arm, TICK), Guard(settings_.limits, arm, TICK, path.zone)
    axes = [arm.home]
    for k in range(350):
        now, pose = 10 + k * TICK, pose_at(breathing, 10 + k * TICK)
        wanted = planner(pose, now)
        assert guard(wanted, pose, now) is wanted
        axes.append(wanted.axes if isinstance(wanted, Move) else axes[-1])
    assert planner.progress.phase is PrintPhase.FINISHED
    joints = joints_from_axes(model, np.array(axes))
    assert (joints > model.low).all() and (joints < model.high).all()
    assert (np.abs(np.diff(joints, axis=0)) / TICK <= model.speed).all()


@settings(max_examples=2)
@given(st.integers(0, 10_000))
def test_no_stream_of_poses_breaks_a_limit(seed: int) -> None:
    tally = StreamTally()
    follow_stream((seed, 1), tally, profile(), 100)
    assert tally.max_shares.max() <= 1 + 1e-6 and tally.errors == []


def test_beyond_a_joint_it_holds_and_says_which() -> None:
    settings_, turned = profile(), REST @ se3.exp([0, 0, -2.3, 0, 0, 0])
    planner = Planner(raster(), settings_.limits, settings_.arm, TICK)
    commands = (planner(pose_at(lambda t: turned, now), now) for now in 10 + TICK * np.arange(250))
    reasons = (command.reason for command in commands if isinstance(command, Hold))
    assert any("out of reach: J6" in reason or "C = " in reason for reason in reasons)


def test_the_guard_refuses_a_place_that_the_posture_does_not_reach() -> None:
    settings_ = profile()
    limits = replace(settings_.limits, jump=1e4, speed=np.full(6, 1e6))
    low, high = np.append([-2000.0] * 3, limits.low[3:]), np.append([2000.0] * 3, limits.high[3:])
    guard = Guard(replace(limits, low=low, high=high), settings_.arm, TICK)
    move = Move(10.0, settings_.arm.home + [900.0, 0, 0, 0, 0, 0], 10.0, 0, False)
    refused = guard(move, pose_at(breathing, 10.0), 10.0)
    assert isinstance(refused, Refusal) and "no posture" in refused.reason and refused.code is RefusalCode.POSTURE


def test_arm_files_with_a_table_of_joints_come_back_as_written(tmp_path: Folder) -> None:
    for file in sorted(FILE.parent.glob("*.toml")):
        if (first := read_arm(file)).urdf is not None:
            continue  # tests/test_urdf.py has it
        write_arm(tmp_path / "a.toml", first)
        again = read_arm(tmp_path / "a.toml")
        assert first.arm.angles is again.arm.angles and first.arm.max_lean == pytest.approx(again.arm.max_lean)
        assert (first.dead_time, first.flight) == (again.dead_time, again.flight)
        a, b = first.arm.joints, again.arm.joints
        if first.arm.max_lean is not None:
            continue  # it has no joints
        assert a is not None and b is not None and (a.name, a.posture, a.nominal) == (b.name, b.posture, b.nominal)
        for name in ("dh", "low", "high", "speed", "acceleration", "arm_from_foot", "flange_from_nozzle"):
            assert np.allclose(getattr(a, name), getattr(b, name), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('angles = "joints"', 'angles = "joint"', "did you mean 'joints'"),
        ("posture = [", "posture = [1, ", "three words"),
        ("[20, 90, 0, 0]", "[20, 80, 0, 0]", "alpha"),
        ("low_deg = [-170", "low_deg = [400", r"kinematics\.low_deg = \[400, .* below high"),
        ("speed_deg_s = [120", "speed_deg_s = [-120", r": kinematics\.speed_deg_s = \[-120, 120, .* allowed > 0"),
        ('posture = ["front"', 'posture = ["left"', r": kinematics\.posture = 'left', allowed front or"),
        ("nominal = true", "nominal = 1", "true or false"),
        ("175]\n\n[kin", "176]\n\n[kin", "limits.high of A B C"),
        ("[202.5, 225, 113", "[602.5, 225, 113", "posture reaches"),
        ("speed_deg_s", "speed_deg", "did you mean"),
    ],
)
def test_faults_are_told_by_file_and_key(tmp_path: Folder, old: str, new: str, words: str) -> None:
    text = FILE.read_text()
    assert old in text
    (tmp_path / "arm.toml").write_text(text.replace(old, new))
    with pytest.raises(InputError, match=words):
        read_arm(tmp_path / "arm.toml")
