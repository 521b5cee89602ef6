"""The whole path carried along: the same as transform by transform, in the arm's axes too, and its three answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.pose import TrackState
from estimation.warp import Warp
from planning.carry import CarriedPath, Update
from planning.kinematics import SimpleArm, axes_from_nozzle
from tests.moving import breathing, pose_at

BUMP = Warp(np.zeros((1, 3)), np.array([[0.3, -0.2, 1.0]]), 1e-4 * np.eye(3), np.zeros((3, 3)), 8.0, 0.4, 0.01)


@given(st.integers(0, 10_000), st.sampled_from([None, BUMP]))
def test_each_checkpoint_is_where_its_own_product_of_transforms_puts_it(seed: int, warp: Warp | None) -> None:
    draw = np.random.default_rng(seed)
    path = se3.exp(draw.normal(size=(20, 6)) * [0.3, 0.3, 0.3, 10, 10, 1])
    pose = se3.exp(draw.normal(size=6) * [0.2, 0.2, 0.2, 50, 50, 50])
    arm = SimpleArm(pose, se3.exp_rotation(draw.normal(size=3)), tool_offset=draw.normal(size=3) * 5)
    pose = replace(pose_at(breathing, draw.uniform(0, 4)), warp=warp)
    carried = CarriedPath(path, arm)
    assert carried(pose) is Update.CHANGED
    wanted = pose.base_from_surface @ (path if warp is None else warp.carry(path))
    assert np.allclose(carried.base_from_nozzle, wanted, atol=1e-9)
    assert np.allclose(carried.axes.T, axes_from_nozzle(arm, wanted), atol=1e-9)


def test_one_turn_about_a_point_and_a_shift_are_the_thesis_equations() -> None:
    """Eq. 5.4 to 5.7 for a yaw about P_R, then P_T."""
    draw = np.random.default_rng(0)
    points, pivot, shift, angle = draw.normal(size=(30, 3)), np.array([3.0, -2, 1]), np.array([5.0, 4, -3]), 0.3
    turn = se3.exp_rotation([0, 0, angle])
    thesis = (points - pivot) @ turn.T + pivot + shift
    pose = pose_at(lambda t: se3.make(turn, pivot - turn @ pivot + shift), 0.0)
    carried = CarriedPath(se3.make(np.eye(3), points), SimpleArm())
    carried(pose)
    assert np.allclose(carried.axes[:3].T, thesis)
    assert np.allclose(carried.axes[3:].T, [0, 0, angle])


def test_changed_unchanged_and_error_are_told_apart() -> None:
    carried = CarriedPath(se3.make(np.eye(3), np.eye(3)), SimpleArm())
    pose = pose_at(breathing, 1.0)
    assert carried(None) is Update.ERROR
    assert np.isnan(carried.axes).any()
    assert carried(pose) is Update.CHANGED
    kept = carried.axes
    assert carried(replace(pose, stamp=1.1)) is Update.UNCHANGED
    for bad in (replace(pose, state=TrackState.COASTING), replace(pose, base_from_surface=np.full((4, 4), np.nan))):
        assert carried(bad) is Update.ERROR
        assert np.array_equal(carried.axes, kept)
    assert carried(pose_at(breathing, 1.2)) is Update.CHANGED
    assert not np.array_equal(carried.axes, kept)
    assert pytest.approx(1) == Update.UNCHANGED.value  # thesis 6.3: "if it gets a 1 code"
