"""Joints: forward and back again in every posture, the Jacobian by differences, singularities where they must be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from planning.inverse import POSTURES, joints_from_nozzle, joints_from_tip
from planning.robot.kinematics import JointModel, arm_from_nozzle, distance, jacobian
from tests.arms import random_joints, random_model

SEEDS = st.integers(0, 100_000)


def all_postures(model: JointModel, wanted: np.ndarray) -> np.ndarray:
    """Joints (8, ..., 6), rad, in each of POSTURES."""
    return np.stack([joints_from_nozzle(model, wanted, signs) for signs in POSTURES])


@given(SEEDS)
def test_every_posture_that_is_found_brings_the_nozzle_there(seed: int) -> None:
    draw = np.random.default_rng(seed)
    model = random_model(draw)
    wanted = arm_from_nozzle(model, random_joints(draw, 10))
    found = all_postures(model, wanted)
    reached = np.asarray(np.isfinite(found).all(axis=-1))
    got = arm_from_nozzle(model, np.where(reached[..., None], found, 0.0))
    off = np.abs(got - wanted).max((-1, -2))[reached]
    assert off.max() < 1e-6
    assert (reached.sum(axis=0) >= 2).all()  # a wrist has two solutions wherever it is reached


@given(SEEDS)
def test_the_joints_one_started_from_are_among_the_postures(seed: int) -> None:
    draw = np.random.default_rng(seed)
    model = random_model(draw)
    joints = random_joints(draw, 5)
    found = all_postures(model, arm_from_nozzle(model, joints))
    off = np.abs(np.exp(1j * found) - np.exp(1j * joints)).max(-1)
    assert (np.nanmin(off, axis=0) < 1e-5).all()


@given(SEEDS)
def test_tip_and_wrist_joints_give_the_whole_arm_back(seed: int) -> None:
    draw = np.random.default_rng(seed)
    model = random_model(draw)
    wanted = arm_from_nozzle(model, random_joints(draw, 20))
    joints = joints_from_nozzle(model, wanted)
    reached = np.isfinite(joints).all(axis=-1)
    back = joints_from_tip(model, wanted[:, :3, 3], joints[:, 3:])
    assert np.isfinite(back[reached]).all()
    got = arm_from_nozzle(model, back[reached])
    assert np.allclose(got[:, :3, 3], wanted[reached, :3, 3], atol=1e-6)
    assert np.allclose(back[reached, 3:], joints[reached, 3:], atol=1e-9)


@given(SEEDS)
def test_the_jacobian_is_the_derivative(seed: int) -> None:
    draw = np.random.default_rng(seed)
    model, joints, step = random_model(draw), random_joints(draw, 1)[0], 1e-6
    matrix = jacobian(model, joints)
    for i in range(6):
        before, after = (arm_from_nozzle(model, joints + h * np.eye(6)[i]) for h in (-step, step))
        turn = se3.log_rotation(after[:3, :3] @ before[:3, :3].T) / (2 * step)
        assert np.allclose(matrix[:3, i], turn, atol=1e-6)
        assert np.allclose(matrix[3:, i], (after - before)[:3, 3] / (2 * step), atol=1e-4)


@given(SEEDS)
def test_manipulability_vanishes_in_each_singularity_and_only_there(seed: int) -> None:
    draw = np.random.default_rng(seed)
    model, joints = random_model(draw, lateral=0.0), random_joints(draw, 1)[0]
    straight = joints.copy()
    straight[4] = -model.dh[4, 3]
    assert distance(model, straight).wrist < 1e-9
    assert distance(model, straight).manipulability < 1e-9
    stretched = joints.copy()
    a, alpha, d, theta = model.dh.T
    stretched[2] = -theta[2] - np.arctan2(-np.sign(alpha[2]) * d[3], a[2])
    assert distance(model, stretched).elbow < 1e-9
    assert distance(model, stretched).manipulability < 1e-9
    free = distance(model, joints)
    if min(free.wrist, free.elbow) > 0.2 and free.shoulder > 50:
        assert free.manipulability > 1e-4


def test_continuous_poses_have_continuous_joints_in_one_posture() -> None:
    draw = np.random.default_rng(3)
    model = random_model(draw, lateral=0.0)
    start = np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7]) - model.dh[:, 3]
    line = arm_from_nozzle(model, start) @ se3.exp(np.linspace(0, 1, 200)[:, None] * np.array([0.1, 0, 0, 5, 5, 5]))
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
        replace(random_model(np.random.default_rng(0)), **change)  # type: ignore[arg-type]
