"""Rays meet a scan where geometry says: planes and spheres in closed form, any triangles by brute force."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.ray_cast import cast, points_on_scan
from estimation.scan import Scan, face_normals, open_edges, scan_from_triangles
from estimation.se3 import Array
from tests import scans

seeds = st.integers(0, 2**32 - 1)
DOWN = se3.make(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 400.0])  # surface_from_camera: straight above, looking down


def pixel_rays(rng: np.random.Generator, count: int, wide: float = 0.12) -> Array:
    return np.column_stack([rng.uniform(-wide, wide, (count, 2)), np.ones(count)]) * rng.uniform(0.5, 2, (count, 1))


def tilted(rng: np.random.Generator) -> Array:
    """surface_from_camera of a camera 400 mm away that looks at the origin from up to some 50 degrees aside."""
    turn = se3.make(se3.exp_rotation(np.r_[rng.uniform(-0.6, 0.6, 2), rng.uniform(-3, 3)]), np.zeros(3))
    return turn @ DOWN


@settings(max_examples=20)
@given(seeds)
def test_a_plane_is_met_where_the_ray_crosses_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    surface_from_camera, directions = tilted(rng), pixel_rays(rng, 200)
    points, hit = points_on_scan(scans.height_field(scans.plane, step=4.0), surface_from_camera, directions)
    origin, along = surface_from_camera[:3, 3], directions @ surface_from_camera[:3, :3].T
    wanted = origin - along * (origin[2] / along[:, 2])[:, None]
    inside = (np.abs(wanted[:, :2]) < [40, 30]).all(axis=1)
    assert (hit == inside).all() and 20 < hit.sum() < 200
    np.testing.assert_allclose(points[hit], wanted[hit], atol=1e-9)
    assert np.isnan(points[~hit]).all()


@settings(max_examples=10)
@given(seeds)
def test_a_ball_is_met_on_the_near_side(seed: int) -> None:
    rng = np.random.default_rng(seed)
    surface_from_camera, directions = tilted(rng), pixel_rays(rng, 150)
    hits = cast(scans.ball(30.0), surface_from_camera, directions)
    origin = surface_from_camera[:3, 3]
    along = directions @ surface_from_camera[:3, :3].T
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    nearest = np.linalg.norm(np.cross(along, origin), axis=1)  # of the ray to the centre
    clear = np.abs(nearest - 30) > 0.2  # at the outline the facets decide
    assert (hits.hit == (nearest < 30))[clear].all()
    wanted = origin - along * (along @ origin + np.sqrt(np.maximum(30**2 - nearest**2, 0)))[:, None]
    square = nearest < 25
    assert np.linalg.norm(hits.points - wanted, axis=1)[square].max() < 0.1
    assert np.einsum("ni,ni->n", hits.normals, wanted / 30)[square].min() > 0.999


def brute_force(scan: Scan, surface_from_camera: Array, directions: Array) -> Array:
    """Nearest points (N, 3) met, by solving for every ray and every triangle."""
    origin, out = surface_from_camera[:3, 3], np.full((len(directions), 3), np.nan)
    for n, along in enumerate(directions @ surface_from_camera[:3, :3].T):
        best = np.inf
        for a, b, c in scan.corners:
            matrix = np.column_stack([along, a - b, a - c])
            if abs(np.linalg.det(matrix)) > 1e-12:
                t, u, v = np.linalg.solve(matrix, a - origin)
                if 0 < t < best and u >= 0 and v >= 0 and u + v <= 1:
                    best, out[n] = t, origin + t * along
    return out


@settings(max_examples=15)
@given(seeds)
def test_any_triangles_large_small_and_behind(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sizes = 10 ** rng.uniform(0, 3, (40, 1, 1))
    corners = rng.normal(size=(40, 1, 3)) * 150 + rng.normal(size=(40, 3, 3)) * sizes
    scan = scan_from_triangles(corners.reshape(-1, 3), np.arange(120).reshape(-1, 3))
    surface_from_camera, directions = tilted(rng), pixel_rays(rng, 25, wide=0.5)
    points, hit = points_on_scan(scan, surface_from_camera, directions)
    wanted = brute_force(scan, surface_from_camera, directions)
    assert (hit == np.isfinite(wanted[:, 0])).all()
    np.testing.assert_allclose(points, wanted, atol=1e-6)


def test_no_ray_slips_through_between_triangles() -> None:
    scan = scans.height_field(scans.plane, step=5.0)
    targets = scan.vertices[(np.abs(scan.vertices[:, :2]) < [39, 29]).all(axis=1)]  # rays through inner vertices
    directions = se3.transform_points(se3.inverse(DOWN), targets)
    points, hit = points_on_scan(scan, DOWN, directions)
    assert hit.all()
    np.testing.assert_allclose(points, targets, atol=1e-9)


def test_no_rays_and_no_way_to_the_scan() -> None:
    scan = scans.height_field(scans.plane, step=5.0)
    points, hit = points_on_scan(scan, DOWN, np.zeros((0, 3)))
    assert points.shape == (0, 3) and hit.shape == (0,)
    away = se3.make(np.eye(3), [0.0, 0.0, 400.0])  # looks the other way
    assert not points_on_scan(scan, away, pixel_rays(np.random.default_rng(0), 20))[1].any()


def test_a_scan_merges_equal_vertices_and_drops_empty_triangles() -> None:
    ball = scans.ball(30.0, 12)
    soup = ball.corners.reshape(-1, 3)
    triangles = np.r_[np.arange(len(soup)).reshape(-1, 3), [[0, 0, 1]]]
    scan = scan_from_triangles(soup, triangles)
    assert len(scan.vertices) == len(ball.vertices) and len(scan.triangles) == len(ball.triangles)
    assert len(open_edges(scan)) == 0
    np.testing.assert_allclose(np.linalg.norm(scan.normals, axis=1), 1)
    assert np.einsum("ni,ni->n", scan.normals, scan.vertices / 30).min() > 0.98
    assert np.einsum("ni,ni->n", face_normals(scan), scan.corners.mean(axis=1)).min() > 0


def test_a_patch_is_open_along_its_rim() -> None:
    assert len(open_edges(scans.height_field(scans.plane, (80.0, 60.0), 1.0))) == 2 * (80 + 60)
