"""The wound is found where it is, the skin over it restored as it was, and what cannot be a wound is refused."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.simulator.bodies import Wound as Carved
from hardware.simulator.bodies import body
from planning.layers.contour import region
from planning.layers.grid import Grid, at, grid_over, topmost
from planning.layers.repair import repaired
from planning.layers.wound import Wound, wound_in
from tests.slowly import slowly
from tests.wounds import scan_of, wound_of


def over_scan(wound: Wound, xy: Array) -> Array:
    """Points (N, 3), scan frame, on the restored skin over points (N, 2) in the plane."""
    return se3.transform_points(wound.surface_from_plane, np.column_stack([xy, at(wound.grid, wound.skin, xy)]))


@pytest.mark.parametrize("kind", ["forearm", *slowly("chest", "foot")])
@pytest.mark.parametrize(("size", "depth"), [((24.0, 16.0), 3.0), ((60.0, 40.0), 6.0)])
def test_outline_and_skin_are_those_of_the_body(kind: str, size: tuple[float, float], depth: float) -> None:
    wound = wound_of(kind, size, depth)
    true = body(kind, Carved(size, depth), 3, 0.5)
    assert true.inside is not None
    whole = body(kind, None, 3, 0.5)
    shape = region(Grid(true.step, -np.array(true.size) / 2, true.heights.shape), true.inside, 1.0, 0.02)
    found = shapely.transform(wound.outline, lambda xy: over_scan(wound, xy)[:, :2])
    assert shapely.intersection(found, shape).area > 0.9 * shapely.union(found, shape).area
    nodes = over_scan(wound, wound.grid.nodes.reshape(-1, 2))
    nodes = nodes[shapely.contains_xy(shape, nodes[:, 0], nodes[:, 1])]
    off = nodes[:, 2] - whole.heights_at(nodes[:, :2])  # the body's own unevenness under the wound cannot be known
    assert np.sqrt(np.mean(off**2)) < 0.55


@pytest.mark.parametrize("seed", range(3))
def test_however_the_scan_lies_the_wound_is_the_same(seed: int) -> None:
    turn, move = np.random.default_rng(seed).uniform(-1, 1, (2, 3)) * [[2.0], [200.0]]
    vertices, triangles = scan_of()
    wound = wound_of()
    placed = se3.transform_points(se3.make(se3.exp_rotation(turn), move), vertices)
    moved = wound_in(repaired(placed, triangles, "scan")[0], 0.4, "scan")
    assert moved.findings.area == pytest.approx(wound.findings.area, rel=0.05)
    assert moved.findings.volume == pytest.approx(wound.findings.volume, rel=0.08)
    assert moved.findings.depth == pytest.approx(wound.findings.depth, abs=0.15)


def test_an_outline_that_is_given_is_kept() -> None:
    vertices, triangles = scan_of()
    square = np.array([[-6.0, -5, 0], [6, -5, 0], [6, 5, 0], [-6, 5, 0]])
    wound = wound_in(repaired(vertices, triangles, "scan")[0], 0.4, "scan", square)
    assert wound.findings.given
    assert wound.outline.area == pytest.approx(120, rel=0.05)


def test_a_hole_in_the_wound_is_closed_and_told() -> None:
    vertices, triangles = scan_of()
    middle = vertices[triangles].mean(axis=1)
    open_scan = triangles[np.hypot(middle[:, 0], middle[:, 1]) > 2.5]
    wound = wound_in(repaired(vertices, open_scan, "scan")[0], 0.4, "scan")
    assert wound.findings.closed == pytest.approx(np.pi * 2.5**2, rel=0.3)
    assert any("not scanned" in note for note in wound.findings.notes)
    assert wound.findings.volume == pytest.approx(wound_of().findings.volume, rel=0.05)


def test_what_an_overhang_hides_is_told() -> None:
    vertices, triangles = scan_of()
    middle = np.abs(vertices[:, :2]).max(axis=1) < 12
    leaning = vertices.copy()
    leaning[:, 0] += np.where(middle, 3.0 * np.clip(-vertices[:, 2] - 1.0, 0, 2), 0.0)  # the bed under one wall
    undermined = wound_in(repaired(leaning, triangles, "scan")[0], 0.4, "scan").findings
    assert wound_of().findings.hidden < 1.0 and undermined.hidden > 10.0
    assert any("overhang" in note for note in undermined.notes)


def test_healthy_skin_has_no_wound() -> None:
    vertices, triangles = body("forearm", None, 3, 0.5).mesh(1.0)
    with pytest.raises(InputError, match="none found"):
        wound_in(repaired(vertices, triangles, "scan")[0], 0.4, "scan")


def test_a_scan_that_is_inside_out_is_refused_and_with_flip_it_is_not() -> None:
    vertices, triangles = scan_of(size=(60.0, 40.0), depth=6.0)
    outside_in = triangles[:, ::-1]
    with pytest.raises(InputError, match="if it was scanned inside out, say --flip"):
        wound_in(repaired(vertices, outside_in, "scan")[0], 0.5, "scan")
    wound = wound_in(repaired(vertices, outside_in, "scan", flip=True)[0], 0.5, "scan")
    assert wound.findings.area == pytest.approx(wound_of(size=(60.0, 40.0), depth=6.0).findings.area, rel=0.02)


def test_a_wound_at_the_rim_of_the_scan_is_refused() -> None:
    vertices, triangles = scan_of()
    cut = triangles[(vertices[triangles][:, :, 0] < 1.0).all(axis=1)]
    with pytest.raises(InputError, match=r"rim|none found"):
        wound_in(repaired(vertices, cut, "scan")[0], 0.4, "scan")


@given(st.integers(0, 10_000), st.floats(0.2, 3.0))
@settings(max_examples=15, deadline=None)
def test_regions_are_where_the_function_is_positive(seed: int, slope: float) -> None:
    rng = np.random.default_rng(seed)
    grid = Grid(0.5, np.array([-8.0, -6.0]), (25, 33))
    centre, radius = rng.uniform(-2, 2, 2), rng.uniform(1, 4)
    values = slope * (radius - np.linalg.norm(grid.nodes - centre, axis=-1))
    shape = region(grid, values, 0.1, 0.0)
    assert shape.is_valid and shape.area == pytest.approx(np.pi * radius**2, rel=0.05)
    nodes = grid.nodes.reshape(-1, 2)
    inside = shapely.contains_xy(shape, nodes[:, 0], nodes[:, 1])
    assert np.array_equal(inside, values.ravel() > 1e-9)


def test_a_region_may_have_holes_and_islands() -> None:
    grid = grid_over([-10, -10], [10, 10], 0.25)
    far = np.linalg.norm(grid.nodes, axis=-1)
    shape = region(grid, np.sin(far * np.pi / 3), 0.1, 0.001)  # rings: inside 3, between 6 and 9, and beyond 12
    assert sorted(len(part.interiors) for part in shape.geoms)[:2] == [0, 0] or len(shape.geoms) >= 2
    assert shapely.contains_xy(shape, 1.0, 1.0) and not shapely.contains_xy(shape, 4.5, 0.0)
    assert shapely.contains_xy(shape, 7.5, 0.0)


def test_of_two_triangles_the_upper_one_counts() -> None:
    points = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 2], [4, 0, 2], [0, 4, 2]])
    grid = Grid(1.0, np.zeros(2), (5, 5))
    heights = topmost(points, np.array([[0, 1, 2], [5, 4, 3]]), grid)
    x, y = grid.nodes[..., 0], grid.nodes[..., 1]
    assert np.array_equal(heights, np.where(x + y <= 4, 2.0, -np.inf))
