"""A path laid on a surface: by a scan, by the region, moved by hand; it stays on the surface, and guesses say so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.scans.registration import register
from estimation.se3 import Array
from planning.placement import (
    NoSurfaceError,
    PathPlacement,
    PlacedBy,
    SurfaceMove,
    local_plane,
    moved_path,
    path_middle,
    path_reach,
    placement_by_region,
    placement_by_scan,
    tangent_frame,
)
from tests import scans
from tests.moving_surfaces import path_through, raster

UP = np.array([0.0, 0.0, 1.0])
SIDE = np.linspace(-60, 60, 33)
X, Y = (part.ravel() for part in np.meshgrid(SIDE, SIDE))
TILTED = se3.make(se3.exp_rotation([0.4, -0.3, 1.1]), [30.0, -12.0, 240.0])
RADIUS = 60.0
FLAT = np.column_stack([X, Y, 0 * X])
BENT = np.column_stack([X, Y, np.sqrt(RADIUS**2 + 1 - Y**2 * 0.5) - RADIUS])  # an arch along y
PATH = raster(20.0)
MOVES = st.builds(SurfaceMove, st.floats(-25, 25), st.floats(-25, 25), st.floats(-3, 3))


def moved(lies: Array, points: Array, move: SurfaceMove, outward: Array = UP) -> Array:
    return moved_path(lies, path_middle(PATH), path_reach(PATH), points, outward, move)


def middle_of(lies: Array) -> Array:
    return se3.transform_points(lies, path_middle(PATH)[None])[0]


@given(MOVES)
def test_on_a_plane_a_move_is_the_move_that_was_asked_for(move: SurfaceMove) -> None:
    points, out = se3.transform_points(TILTED, FLAT), TILTED[:3, 2]
    lies = moved(TILTED, points, move, out)
    middle = path_middle(PATH)
    about = se3.make(np.eye(3), middle) @ se3.make(se3.exp_rotation(move.turn * UP), np.zeros(3))
    expected = TILTED @ se3.make(np.eye(3), [move.x, move.y, 0.0]) @ about @ se3.make(np.eye(3), -middle)
    assert lies == pytest.approx(expected, abs=1e-9)
    assert se3.is_transform(lies)


@given(MOVES)
def test_moved_there_and_back_a_path_lies_where_it_lay(move: SurfaceMove) -> None:
    there = moved(np.eye(4), BENT, move)
    turn = se3.exp_rotation(-move.turn * UP)[:2, :2]
    x, y = turn @ [-move.x, -move.y]
    back = moved(there, BENT, SurfaceMove(float(x), float(y), -move.turn))
    far = np.hypot(move.x, move.y)
    assert np.linalg.norm(middle_of(back) - middle_of(np.eye(4))) < 0.02 * far + 1e-6  # along two arcs, not lines
    assert np.linalg.norm(se3.log(back)[:3]) < 0.02


@given(MOVES)
def test_a_moved_path_keeps_its_height_and_leans_with_the_surface(move: SurfaceMove) -> None:
    reach = path_reach(PATH)
    lies = moved(np.eye(4), BENT, move)
    heights, normals = [], []
    for pose in (np.eye(4), lies):
        foot, normal = local_plane(BENT, middle_of(pose), reach, UP)
        heights.append(float((middle_of(pose) - foot) @ normal))
        normals.append(normal)
    assert heights[1] == pytest.approx(heights[0], abs=1e-3)
    assert lies[:3, :3] @ normals[0] == pytest.approx(normals[1], abs=1e-4)


def test_a_bent_surface_is_followed_to_a_tenth_of_a_millimetre() -> None:
    """The true height of the path's middle over a cylinder, not that over the points' planes."""
    radius, angle = 50.0, np.linspace(-1.0, 1.0, 41)
    along, around = (part.ravel() for part in np.meshgrid(SIDE, angle))
    points = np.column_stack([along, radius * np.sin(around), radius * (np.cos(around) - 1)])
    lies = moved(np.eye(4), points, SurfaceMove(4.0, 12.0, 0.3))
    centre = np.array([0.0, 0.0, -radius])
    before, after = (np.linalg.norm((middle_of(pose) - centre)[1:]) for pose in (np.eye(4), lies))
    assert after == pytest.approx(before, abs=0.1)


def test_where_nothing_is_mapped_nothing_is_moved_to() -> None:
    near = FLAT[np.abs(X) < 20]
    moved(np.eye(4), near, SurfaceMove(15.0, 0.0, 0.0))
    with pytest.raises(NoSurfaceError, match="nothing of the surface is mapped there"):
        moved(np.eye(4), near, SurfaceMove(40.0, 0.0, 0.0))
    with pytest.raises(NoSurfaceError):
        tangent_frame(np.eye(4), path_middle(PATH), path_reach(PATH), FLAT[:4], UP)


@given(st.floats(-1.4, 1.4), st.floats(-10, 10), st.floats(-10, 10))
def test_without_a_scan_middle_and_long_axis_of_the_path_are_laid_on_those_of_the_region(
    turn: float, x: float, y: float
) -> None:
    """The long axis of the path along that of the region, the nearer way round; z = 0 on the surface; a guess."""
    path = path_through(np.array([[-20.0, -4, 0.3], [20, -4, 0.3], [20, 4, 0.3], [-20, 4, 0.3]]) + [3.0, 8.0, 0.0])
    angle = np.linspace(0, 2 * np.pi, 80, endpoint=False)
    ellipse = np.column_stack([18 * np.cos(angle), 7 * np.sin(angle), 0 * angle])
    region_flat = se3.make(se3.exp_rotation(turn * UP), [x, y, 0.0])
    points, outline = (se3.transform_points(TILTED, p) for p in (FLAT, se3.transform_points(region_flat, ellipse)))
    placed = placement_by_region(path, [outline, outline], points, TILTED[:3, 2])
    assert placed.by is PlacedBy.REGION and not placed.certain and placed.usable and "move it" in placed.verdict
    laid = se3.inverse(TILTED) @ placed.surface_from_path
    assert laid @ [3, 8, 0, 1] == pytest.approx([x, y, 0, 1], abs=1e-6)
    assert laid[:3, 2] == pytest.approx(UP, abs=1e-9)
    along = laid[:3, 0]
    assert abs(along @ [np.cos(turn), np.sin(turn), 0]) == pytest.approx(1, abs=1e-6)


def test_a_region_without_a_direction_turns_nothing_and_a_path_of_a_scan_is_not_guessed() -> None:
    square = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    placed = placement_by_region(PATH, [square], FLAT, UP)
    assert placed.surface_from_path[:3, :3] == pytest.approx(np.eye(3))
    assert "mapped surface" in placement_by_region(PATH, [], FLAT, UP).verdict
    high = replace(PATH, surface_from_nozzle=se3.make(np.eye(3), [0.0, 0.0, 60.0]) @ PATH.surface_from_nozzle)
    far = placement_by_region(high, [square], FLAT, UP)
    assert not far.usable and "planned on a scan" in far.verdict


def registered(shape: scans.Shape, tested: scans.Shape | None = None) -> PathPlacement:
    scan = scans.height_field(shape)
    seen = scans.points_on(scans.height_field(tested or shape), 900, np.random.default_rng(4))
    noisy = se3.transform_points(TILTED, seen + np.random.default_rng(5).normal(0, 0.05, seen.shape))
    return placement_by_scan(register(noisy, 0.1, scan, TILTED[:3, 2]), np.zeros(3), UP)


def test_a_scan_that_holds_is_certain_and_says_how_well() -> None:
    placed = registered(scans.body)
    assert placed.certain and placed.usable and placed.sigma < 0.3 and placed.turn_sigma < 0.02
    assert f"good to {placed.sigma:.2f} mm" in placed.verdict


@pytest.mark.parametrize("shape", [scans.plane, scans.sphere, scans.twofold], ids=["flat", "round", "twofold"])
def test_a_scan_that_may_lie_elsewhere_is_not_certain_and_names_what_is_open(shape: scans.Shape) -> None:
    placed = registered(shape)
    assert not placed.certain and placed.usable and "not certain, move it" in placed.verdict
    assert "free: " in placed.verdict or "ambiguous" in placed.verdict


def test_the_scan_of_something_else_cannot_be_used_at_all() -> None:
    placed = registered(scans.body, lambda x, y: 4 * np.sin(x / 5) * np.cos(y / 4))
    assert not placed.certain and not placed.usable and "not found" in placed.verdict
