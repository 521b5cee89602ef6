"""What is true of the surface: checkpoints ride on the deformed skin, and what lies on it is found again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST
from hardware.simulator.motion_table import motion_from_tables
from hardware.simulator.scene.shape import Deformation
from hardware.simulator.truth import Truth

MOTION = motion_from_tables(
    "test",
    [
        {"kind": "breathing", "amplitude_mm": 4.0, "turn_deg": [3.0, 1.0, 0.0]},
        {"kind": "ramp", "speed_mm_s": [1.0, 2.0, 0.0], "speed_deg_s": [0.0, 0.0, 4.0]},
    ],
    Path("."),
    3,
)
GRID = se3.make(se3.exp_rotation([0.2, -0.4, 1.1]), [5.0, -3.0, 12.0])  # surface_from_grid of a scan
SKIN = Deformation((0.05, -0.03), bulge=3.0, radius=15.0)
SMOOTH = {"motion": MOTION, "deformation": SKIN, "strain": lambda times: np.sin(2 * times)}

places = st.lists(st.floats(-30, 30), min_size=3, max_size=3).map(np.array)
instants = st.floats(0, 20)


def nozzles(points: Array) -> Array:
    """Nozzle poses (N, 4, 4) at points (N, 3), each turned another way."""
    turns = np.stack([[0.1 * i, 0.3 - 0.05 * i, 0.2] for i in range(len(points))])
    return se3.make(se3.exp_rotation(turns), points)


@given(places, instants, st.sampled_from([np.eye(4), GRID]))
def test_material_is_the_inverse_of_checkpoints(place: Array, instant: float, grid: Array) -> None:
    truth, times = Truth(BASE_FROM_REST, surface_from_grid=grid, **SMOOTH), np.array([instant])
    base_from_target = truth.checkpoints(times, nozzles(place[None]))
    assert truth.material(times, base_from_target[:, :3, 3]) == pytest.approx(place[None], abs=1e-8)


@given(places, instants, st.sampled_from([np.eye(4), GRID]))
def test_a_checkpoint_is_a_rigid_pose_where_the_displacement_says(place: Array, instant: float, grid: Array) -> None:
    truth, times = Truth(BASE_FROM_REST, surface_from_grid=grid, **SMOOTH), np.array([instant])
    (target,) = truth.checkpoints(times, nozzles(place[None]))
    assert se3.is_transform(target)
    amount = float(np.sin(2 * instant))
    on_grid = se3.transform_points(se3.inverse(grid), place[None])
    moved = se3.transform_points(grid, on_grid + SKIN.displacement(on_grid, amount))
    assert target[:3, 3] == pytest.approx(se3.transform_points(truth.base_from_surface(times)[0], moved)[0], abs=1e-9)


@given(places, instants)
def test_the_tool_turns_with_the_skin_under_it(place: Array, instant: float) -> None:
    """A polar rotation is the one nearest to the gradient: what is left of the gradient is symmetric."""
    truth = Truth(BASE_FROM_REST, **SMOOTH)
    times, amount = np.array([instant]), np.sin(2 * np.array([instant]))
    nozzle = nozzles(place[None])
    turned = se3.inverse(truth.base_from_surface(times)) @ truth.checkpoints(times, nozzle)
    turn = turned[0, :3, :3] @ nozzle[0, :3, :3].T
    step = 1e-3 * np.eye(3)
    gradient = np.eye(3) + np.stack(
        [(truth.displacement(place + s, amount) - truth.displacement(place - s, amount))[0] / 2e-3 for s in step], -1
    )
    left = turn.T @ gradient
    assert left == pytest.approx(left.T, abs=1e-5)
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_without_strain_a_checkpoint_is_carried_rigidly() -> None:
    times, nozzle = np.linspace(0, 5, 7), nozzles(np.arange(21.0).reshape(7, 3))
    for truth in (
        Truth(BASE_FROM_REST, MOTION),
        Truth(BASE_FROM_REST, MOTION, SKIN),
        Truth(BASE_FROM_REST, MOTION, SKIN, np.zeros_like),
    ):
        assert np.array_equal(truth.checkpoints(times, nozzle), truth.base_from_surface(times) @ nozzle)


def test_checkpoints_are_not_changed_by_asking() -> None:
    nozzle = nozzles(np.ones((3, 3)))
    before = nozzle.copy()
    Truth(BASE_FROM_REST, **SMOOTH).checkpoints(np.array([0.3, 0.6, 0.9]), nozzle)
    assert np.array_equal(nozzle, before)


def test_a_pure_stretch_turns_no_tool_and_a_bulge_leans_it_outwards() -> None:
    times, nozzle = np.zeros(1), se3.make(np.eye(3), np.array([[10.0, 0.0, 0.0]]))
    still = motion_from_tables("test", [], Path("."), 0)
    stretched = Truth(np.eye(4), still, Deformation((0.2, 0.1)), np.ones_like).checkpoints(times, nozzle)[0]
    assert stretched[:3, :3] == pytest.approx(np.eye(3))
    assert stretched[:3, 3] == pytest.approx([12.0, 0.0, 0.0])
    bulged = Truth(np.eye(4), still, Deformation(bulge=2.0, radius=10.0), np.ones_like).checkpoints(times, nozzle)[0]
    slope = 2.0 * np.exp(-0.5) / 10.0  # of the bulge there
    assert bulged[0, 2] == pytest.approx(np.sin(np.arctan(slope / 2)), rel=1e-2)  # half of it shears, half turns


def test_the_twist_is_the_derivative_of_the_pose() -> None:
    truth, times, h = Truth(BASE_FROM_REST, MOTION), np.linspace(0.5, 9.0, 20), 1e-5
    there, ahead, behind = (truth.base_from_surface(times + dt) for dt in (0, h, -h))
    assert truth.twist(times) == pytest.approx(se3.log(se3.inverse(behind) @ ahead) / (2 * h), abs=1e-4)
    assert there.shape == (20, 4, 4)
