"""An arm whose A B C are its joints: planned, guarded and read from a file as any other."""

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
from hardware.bench.planner import Tally, bench_arm, follow
from hardware.files.arm_file import read_arm, write_arm
from planning.command import Code, Hold, Move, Refusal
from planning.kinematics import axes_from_nozzle, joints_from_axes, nozzle_from_axes
from planning.motion.guard import Guard
from planning.motion.planner import Planner
from planning.path import Path
from planning.progress import Phase
from tests.moving import REST, breathing, pose_at, raster

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


def test_a_whole_print_keeps_the_joints_within_ranges_and_speeds() -> None:
    settings_ = profile()
    arm, model = settings_.arm, settings_.arm.joints
    assert model is not None
    path = raster(size=5, lines=2)
    planner, guard = _planner(path, settings_), _guard(path, settings_)
    axes = [arm.home]
    for k in range(350):
        now, pose = 10 + k * TICK, pose_at(breathing, 10 + k * TICK)
        wanted = planner(pose, now)
        assert guard(wanted, pose, now) is wanted
        axes.append(wanted.axes if isinstance(wanted, Move) else axes[-1])
    assert planner.progress.phase is Phase.FINISHED
    joints = joints_from_axes(model, np.array(axes))
    assert (joints > model.low).all() and (joints < model.high).all()
    assert (np.abs(np.diff(joints, axis=0)) / TICK <= model.speed).all()


@settings(max_examples=2)
@given(st.integers(0, 10_000))
def test_no_stream_of_poses_breaks_a_limit(seed: int) -> None:
    tally = Tally()
    follow((seed, 1), tally, profile(), 100)
    assert tally.worst.max() <= 1 + 1e-6
    assert tally.errors == []


def test_beyond_a_joint_it_holds_and_says_which() -> None:
    settings_ = profile()
    path = raster()

    def turned(t: float) -> Array:
        del t
        return np.asarray(REST @ se3.exp([0, 0, -2.3, 0, 0, 0]))

    planner = _planner(path, settings_)
    reasons = {
        c.reason for k in range(250) if isinstance(c := planner(pose_at(turned, 10 + k * TICK), 10 + k * TICK), Hold)
    }
    assert any("out of reach: J6" in r or "C = " in r for r in reasons), reasons


def test_the_guard_refuses_a_place_that_the_posture_does_not_reach() -> None:
    settings_ = profile()
    limits = replace(settings_.limits, jump=1e4, speed=np.full(6, 1e6))
    low, high = np.append([-2000.0] * 3, limits.low[3:]), np.append([2000.0] * 3, limits.high[3:])
    guard = Guard(replace(limits, low=low, high=high), settings_.arm, TICK)
    move = Move(10.0, settings_.arm.home + [900.0, 0, 0, 0, 0, 0], 10.0, 0, False)
    refused = guard(move, pose_at(breathing, 10.0), 10.0)
    assert isinstance(refused, Refusal) and "no posture" in refused.reason and refused.code is Code.POSTURE


def test_the_guard_knows_each_joints_own_speed() -> None:
    settings_ = profile()
    model = settings_.arm.joints
    assert model is not None
    slow = replace(settings_.arm, joints=replace(model, speed=np.append([0.05] * 3, model.speed[3:])))
    guard = Guard(settings_.limits, slow, TICK)
    refused = guard(Move(10.0, slow.home + [1.0, 0, 0, 0, 0, 0], 50.0, 0, False), pose_at(breathing, 10.0), 10.0)
    assert isinstance(refused, Refusal) and refused.reason.startswith("refused: J")
    assert refused.code is Code.JOINT_SPEED and refused.got > refused.limit == 0.05


def test_both_arm_files_come_back_as_written(tmp_path: Folder) -> None:
    for file in sorted(FILE.parent.glob("*.toml")):
        first = read_arm(file)
        write_arm(tmp_path / "a.toml", first)
        again = read_arm(tmp_path / "a.toml")
        assert first.arm.angles is again.arm.angles
        a, b = first.arm.joints, again.arm.joints
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


def _planner(path: Path, settings_: ArmProfile) -> Planner:
    return Planner(path, settings_.limits, settings_.arm, TICK)


def _guard(path: Path, settings_: ArmProfile) -> Guard:
    return Guard(settings_.limits, settings_.arm, TICK, path.zone)
