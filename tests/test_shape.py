"""Shapes: a height field that is exact between its nodes, from a law, a body or a scan."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.scan import face_normals, scan_from_triangles
from hardware.simulator.bodies import BODIES, Wound, body, with_wound
from hardware.simulator.deformation import Deformation
from hardware.simulator.scene.shape import cylinder, flat, shape_from_function, shape_from_scan

NUMBERS = st.floats(-1.0, 1.0)
SCAN_FROM_OURS = se3.make(se3.exp_rotation([0.3, -0.2, 0.6]), [12.0, -7.0, 31.0])


@given(st.tuples(NUMBERS, NUMBERS, NUMBERS), st.tuples(NUMBERS, NUMBERS))
def test_a_plane_comes_back_between_the_nodes(law: tuple[float, ...], place: tuple[float, float]) -> None:
    a, b, c = law
    shape = shape_from_function(lambda x, y: a * x + b * y + c, (30.0, 20.0), 0.5)
    xy = np.array([place]) * np.array(shape.size) / 2
    np.testing.assert_allclose(shape.points(xy), [[*xy[0], a * xy[0, 0] + b * xy[0, 1] + c]], atol=1e-9)
    np.testing.assert_allclose(shape.normals(xy), [np.array([-a, -b, 1]) / np.linalg.norm([a, b, 1])], atol=1e-9)


def test_a_curved_law_is_met_to_the_square_of_the_step() -> None:
    xy = np.random.default_rng(0).uniform(-10, 10, (500, 2))
    truth = np.sqrt(55.0**2 - xy[:, 1] ** 2) - 55.0
    errors = [np.abs(cylinder((24.0, 24.0), 55.0, step).heights_at(xy) - truth).max() for step in (1.0, 0.5, 0.25)]
    assert errors[0] < 1.0 / (8 * 50)
    assert errors[0] > 3.5 * errors[1] > 12 * errors[2]


@pytest.mark.parametrize("kind", sorted(BODIES))
def test_a_body_has_its_wound_in_the_middle_at_skin_level(kind: str) -> None:
    wound = Wound((40.0, 30.0), 2.5)
    shape, bare = body(kind, wound, 4), body(kind, None, 4)
    assert shape.inside is not None
    sunk = bare.heights - shape.heights
    assert abs(bare.heights_at([[0, 0]])[0]) < 0.8  # the body's own unevenness
    assert 1.5 < sunk[shape.inside > 4].mean() < 3.0
    assert np.abs(sunk[shape.inside < -8]).max() < 0.01
    columns, rows = (np.ptp(np.nonzero((shape.inside > 0).any(axis))[0]) * shape.step for axis in (0, 1))
    assert abs(columns - 40) < 9
    assert abs(rows - 30) < 8
    slopes = np.stack(np.gradient(shape.heights, shape.step))
    assert np.abs(slopes).max() < 1.6


def test_a_body_is_made_by_its_seed() -> None:
    np.testing.assert_array_equal(body("foot", Wound(), 3).heights, body("foot", Wound(), 3).heights)
    assert np.abs(body("foot", Wound(), 3).heights - body("foot", Wound(), 4).heights).max() > 0.1


def test_the_mesh_lies_on_the_shape_and_faces_out() -> None:
    shape = body("chest", Wound(), 1)
    vertices, triangles = shape.mesh(2.0)
    np.testing.assert_allclose(shape.points(shape.material(vertices)), vertices, atol=1e-9)
    scan = scan_from_triangles(vertices, triangles)
    assert (face_normals(scan)[:, 2] > 0.4).all()
    area = np.ptp(vertices[:, 0]) * np.ptp(vertices[:, 1])
    assert len(triangles) == pytest.approx(2 * area / 2.0**2, rel=0.05)


def test_a_scan_gives_its_surface_back_in_its_own_frame() -> None:
    source = body("forearm", Wound(), 2)
    vertices, triangles = source.mesh(0.5)
    scanned = se3.transform_points(SCAN_FROM_OURS, vertices)
    shape = shape_from_scan(scanned, triangles, 0.5)
    inner = source.grid(3.0, 0.8)
    points = se3.transform_points(SCAN_FROM_OURS, source.points(inner))
    again = shape.points(shape.material(points))
    off = np.einsum("ni,ni->n", again - points, shape.normals(shape.material(points)))
    assert np.abs(off).max() < 0.1  # a mesh of 0.5 mm, taken anew every 0.5 mm: its creases are rounded
    assert np.abs(off).mean() < 0.004
    assert shape.valid is not None
    assert shape.valid.mean() > 0.97


def test_holes_of_a_scan_are_no_surface_and_overhangs_hide_what_is_below() -> None:
    source = flat((40.0, 30.0))
    vertices, triangles = source.mesh(1.0)
    middle = vertices[triangles].mean(1)
    kept = triangles[np.linalg.norm(middle[:, :2] - [8.0, 0.0], axis=1) > 4]
    roof = np.array([[-11.0, -3.0, 2.0], [-5.0, -3.0, 2.0], [-11.0, 3.0, 2.0]])
    over = len(vertices) + np.array([[0, 1, 2]])
    shape = shape_from_scan(np.concatenate([vertices, roof]), np.concatenate([kept, over]), 0.5)
    assert shape.valid is not None
    at = np.rint(shape._nodes(shape.material([[8.0, 0.0, 0.0], [0.0, 10.0, 0.0]]))).astype(int)
    assert shape.valid[at[:, 1], at[:, 0]].tolist() == [False, True]
    under, beside = shape.points(shape.material([[-10.0, -2.0, 0.0], [0.0, 10.0, 0.0]]))
    assert under[2] == pytest.approx(2.0, abs=0.05)
    assert beside[2] == pytest.approx(0.0, abs=0.05)
    mesh = shape.mesh(1.0)
    centres = mesh[0][mesh[1]].mean(1)
    assert np.linalg.norm(centres[:, :2] - [8.0, 0.0], axis=1).min() > 2.5


def test_a_wound_on_a_scan_is_painted_not_carved() -> None:
    source = flat((60.0, 50.0))
    shape = with_wound(source, Wound(), 1)
    assert shape.inside is not None
    assert (shape.inside > 0).any()
    np.testing.assert_array_equal(shape.heights, source.heights)


AMOUNTS = st.floats(-1.5, 1.5)


@given(st.tuples(NUMBERS, NUMBERS, NUMBERS), AMOUNTS, st.floats(-0.05, 0.05), st.floats(-4, 4))
def test_a_deformation_is_undone(place: tuple[float, ...], amount: float, stretch: float, bulge: float) -> None:
    deformation = Deformation((stretch, -0.5 * stretch), bulge, 30.0)
    points = np.array([place]) * [50.0, 40.0, 5.0]
    moved = points + deformation.displacement(points, amount)
    np.testing.assert_allclose(deformation.undo(moved, amount), points, atol=1e-9)
    np.testing.assert_array_equal(deformation.displacement(points, 0.0), np.zeros((1, 3)))


def test_a_deformation_lifts_its_middle_by_the_bulge_and_stretches_lengths() -> None:
    moved = Deformation((0.02, 0.01), 3.0, 30.0).displacement([[0.0, 0, 0], [30, 0, 0], [0, 30, 0]], 0.5)
    np.testing.assert_allclose(moved[0], [0, 0, 1.5])
    np.testing.assert_allclose(moved[1], [0.3, 0, 1.5 * np.exp(-0.5)])
    np.testing.assert_allclose(moved[2], [0, 0.15, 1.5 * np.exp(-0.5)])
