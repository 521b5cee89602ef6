"""Rays against closed forms and brute force; a scan found in the pictures, and what its shape leaves open."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.rig import ideal_pixels
from estimation.scans.registration import Registration
from estimation.scans.scan import Hits, Scan, cast_rays, face_normals, open_edges, scan_from_triangles
from estimation.se3 import Array
from estimation.surface_map import transform_map
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.simulator.scene.scene import Scene, rois
from hardware.simulator.scene.shape import Shape, Wound, body, cylinder, flat, with_wound
from perception.frames import Image
from perception.lens import Lenses
from perception.mapping.features import grey
from perception.mapping.first_map import FirstMap, build_first_map, in_frame
from perception.mapping.patches import Pyramid
from perception.mapping.scan_map import (
    MIN_SCAN_SIGMA_MM,
    DenseMatch,
    ScanPlacing,
    as_at_one_instant,
    landmarks_on_scan,
    match_near,
)
from tests import scans
from tests.rendered_sets import LOOK, SCAN_FROM_SURFACE, WIDE, pictures
from tests.slow_cases import slowly

seeds = st.integers(0, 2**32 - 1)
DOWN = se3.make(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 400.0])  # surface_from_camera: straight above, looking down


def cast(scan: Scan, surface_from_camera: Array, directions: Array) -> Hits:
    """Rays (N, 3) of a camera, in its own frame."""
    return cast_rays(scan, surface_from_camera[:3, 3], directions @ surface_from_camera[:3, :3].T)


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
    hits = cast(scans.height_field(scans.plane, step=4.0), surface_from_camera, directions)
    points, hit = hits.points, hits.hit
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
    hits = cast(scan, surface_from_camera, directions)
    points, hit = hits.points, hits.hit
    wanted = brute_force(scan, surface_from_camera, directions)
    assert (hit == np.isfinite(wanted[:, 0])).all()
    np.testing.assert_allclose(points, wanted, atol=1e-6)


def test_no_ray_slips_through_between_triangles() -> None:
    scan = scans.height_field(scans.plane, step=5.0)
    targets = scan.vertices[(np.abs(scan.vertices[:, :2]) < [39, 29]).all(axis=1)]  # rays through inner vertices
    hits = cast(scan, DOWN, se3.transform_points(se3.inverse(DOWN), targets))
    points, hit = hits.points, hits.hit
    assert hit.all()
    np.testing.assert_allclose(points, targets, atol=1e-9)


def test_no_rays_and_no_way_to_the_scan() -> None:
    scan = scans.height_field(scans.plane, step=5.0)
    hits = cast(scan, DOWN, np.zeros((0, 3)))
    points, hit = hits.points, hits.hit
    assert points.shape == (0, 3) and hit.shape == (0,)
    away = se3.make(np.eye(3), [0.0, 0.0, 400.0])  # looks the other way
    assert not cast(scan, away, pixel_rays(np.random.default_rng(0), 20)).hit.any()


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


RIG = arc_rig(size=(640, 480), focal=560.0)  # 0.7 mm a pixel
LENSES = Lenses(RIG)
POSE = BASE_FROM_REST @ se3.exp([0.03, -0.02, 0.05, 2.0, -1.0, 3.0])
SHAPES = {
    "wound": lambda: body("forearm", Wound(), 1),
    "flat": lambda: with_wound(flat((80.0, 60.0)), WIDE, 1),
    "cylinder": lambda: with_wound(cylinder((80.0, 60.0), 50.0), WIDE, 1),
}


@cache
def shape(kind: str) -> Shape:
    return SHAPES[kind]()


@cache
def seen(kind: str) -> tuple[dict[int, Image], dict[int, Array]]:
    """Grey images and polygons by camera."""
    scene = Scene(shape(kind), LOOK, seed=1)
    images = pictures(scene, RIG.cameras, POSE, np.random.default_rng(1))
    return {c: grey(i) for c, i in enumerate(images)}, {r.camera: r.polygon for r in rois(scene, RIG, POSE, 0.0)}


@cache
def first(kind: str) -> FirstMap:
    images, polygons = seen(kind)
    found = build_first_map(LENSES, {c: Pyramid(i) for c, i in images.items()}, polygons)
    assert not isinstance(found, str), found
    return found


def scan(kind: str) -> Scan:
    """Of the shape, in a scanner's own frame."""
    vertices, triangles = shape(kind).mesh(1.0)
    return scan_from_triangles(se3.transform_points(SCAN_FROM_SURFACE, vertices), triangles)


@cache
def place(kind: str) -> Registration:
    return ScanPlacing(scan(kind)).search(LENSES, *_arguments(kind))


def _arguments(kind: str) -> tuple[dict[int, Image], FirstMap, dict[int, Array]]:
    images, polygons = seen(kind)
    return images, first(kind), polygons


def over_wound(kind: str, found: Registration) -> Array:
    """Errors (N, 3) mm, surface axes, of points of the wound."""
    body_shape = shape(kind)
    flat_places = body_shape.grid(body_shape.step)
    points = body_shape.points(flat_places[(body_shape.inside > 0).ravel()])
    off = se3.transform_points(found.base_from_surface @ SCAN_FROM_SURFACE, points) - se3.transform_points(POSE, points)
    return np.asarray(off @ POSE[:3, :3])


def nodes(lift: float = 0.0, step: float = 0.8) -> tuple[Array, Array]:
    """A lattice (H, W, 3) mm, base frame, on the forearm, `lift` mm above it, and its points in the surface frame."""
    x, y = np.meshgrid(np.arange(-24, 24, step), np.arange(-16, 16, step))
    xy = np.stack([x, y], -1).reshape(-1, 2)
    points = shape("wound").points(xy) + lift * shape("wound").normals(xy)
    return se3.transform_points(POSE, points).reshape(*x.shape, 3), points


def above(matched: DenseMatch) -> Array:
    """Heights (N,) mm of what was surely matched, over the true forearm."""
    points = se3.transform_points(se3.inverse(POSE), matched.points[matched.sure])
    xy = shape("wound").material(points)
    return np.asarray(np.einsum("ni,ni->n", points - shape("wound").points(xy), shape("wound").normals(xy)))


@pytest.mark.parametrize("lift", [0.6, *slowly(0.0, -0.6)])
def test_dense_points_lie_on_the_true_surface_whatever_they_began_on(lift: float) -> None:
    """A pixel is 0.7 mm here."""
    matched = match_near(LENSES, seen("wound")[0], nodes(lift)[0], 1)
    assert matched is not None and matched.sure.mean() > 0.6
    off = above(matched)
    assert abs(np.median(off)) < 0.03 + 0.1 * abs(lift) and np.percentile(np.abs(off), 80) < 0.12 + 0.2 * abs(lift)


def test_every_other_node_is_matched_as_among_all() -> None:
    lattice = nodes()[0]
    whole, some = (match_near(LENSES, seen("wound")[0], lattice, 1, every) for every in (1, 3))
    both = whole.sure[::3, ::3] & some.sure
    assert both.sum() > 0.8 * some.sure.sum()
    assert np.allclose(whole.points[::3, ::3][both], some.points[both], atol=1e-6)


def test_one_camera_or_blank_pictures_match_nothing() -> None:
    images = seen("wound")[0]
    assert match_near(LENSES, {1: images[1]}, nodes()[0], 1) is None
    blank = {c: np.full_like(image, 90) for c, image in images.items()}
    matched = match_near(LENSES, blank, nodes()[0], 1)
    assert matched is None or not matched.sure.any()


@pytest.mark.slow
def test_a_wound_is_found_on_its_scan_to_a_tenth_of_a_millimetre() -> None:
    found = place("wound")
    off = np.linalg.norm(over_wound("wound", found), axis=1)
    assert found.sure, found.verdict
    assert off.mean() < 0.1 and off.max() < 0.15


@pytest.mark.slow
def test_its_claimed_covariance_is_of_the_errors_size() -> None:
    found = place("wound")
    error = se3.log(se3.inverse(found.base_from_surface) @ POSE @ se3.inverse(SCAN_FROM_SURFACE))
    assert 0.05 < error @ np.linalg.solve(found.covariance, error) / 6 < 3.0


@pytest.mark.slow
def test_a_flat_scan_stays_open_along_itself() -> None:
    found = place("flat")
    assert not found.sure and found.verdict.count("slide along") == 2 and found.verdict.count("turn about") == 1
    assert np.abs(over_wound("flat", found)[:, 2]).max() < 0.05  # across it, it is held


@pytest.mark.slow
def test_a_cylinder_stays_open_along_and_about_its_axis() -> None:
    found = place("cylinder")
    assert not found.sure and found.free.shape == (2, 6)
    axis = SCAN_FROM_SURFACE[:3, 0]
    slide = found.free[np.argmin(np.linalg.norm(found.free[:, :3], axis=1)), 3:]
    assert abs(slide @ axis) > 0.99 * np.linalg.norm(slide)


@pytest.mark.slow
def test_the_scan_of_another_body_is_no_sure_fit() -> None:
    other = body("chest", Wound((24.0, 40.0)), 5)
    found = ScanPlacing(scan_from_triangles(*other.mesh(1.0))).search(LENSES, *_arguments("wound"))
    assert not found.sure and "poor fit" in found.verdict


@pytest.mark.slow
def test_two_searches_give_the_same_bits() -> None:
    again = ScanPlacing(scan("wound")).search(LENSES, *_arguments("wound"))
    assert again.base_from_surface.tobytes() == place("wound").base_from_surface.tobytes()
    assert again.verdict == place("wound").verdict


def test_cameras_that_saw_a_moving_surface_at_their_own_instants_agree_as_at_one() -> None:
    rng = np.random.default_rng(4)
    single = {c: POSE @ se3.exp(rng.normal(size=6) * [0.01, 0.01, 0.01, 1, 1, 1]) for c in range(3)}
    points = rng.uniform(-20, 20, (30, 3))
    moved = as_at_one_instant(RIG, POSE, single)
    for c in range(3):
        there = ideal_pixels(RIG.cameras[c], se3.transform_points(single[c], points))[0]
        assert np.allclose(ideal_pixels(moved.cameras[c], se3.transform_points(POSE, points))[0], there, atol=1e-8)
    assert np.array_equal(as_at_one_instant(RIG, POSE, {}).matrices, RIG.matrices)


def test_landmarks_are_put_where_their_rays_meet_the_scan() -> None:
    found = place("wound")
    there = in_frame(first("wound"), found.base_from_surface)
    laid, anchors = landmarks_on_scan(there.map, there.templates.camera, LENSES, scan("wound"), found)
    on = anchors.sigma < 1.0
    assert on.mean() > 0.9 and (anchors.sigma[on] >= MIN_SCAN_SIGMA_MM).all()

    def off(points: Array) -> Array:
        inner = se3.transform_points(se3.inverse(SCAN_FROM_SURFACE), points)
        return np.abs(inner[:, 2] - shape("wound").heights_at(shape("wound").material(inner)))

    assert off(laid.points[on]).max() < 0.1 < np.percentile(off(there.map.points[on]), 90)  # a scan's facets are 1 mm
    for c in range(3):  # along their rays
        mine = on & (there.templates.camera == c)
        pose = found.base_from_surface
        both = [se3.transform_points(pose, m.points[mine]) for m in (there.map, laid)]
        before, after = (ideal_pixels(RIG.cameras[c], points)[0] for points in both)
        assert np.abs(before - after).max() < 1e-6


@pytest.mark.slow
def test_what_the_scan_tells_of_landmarks_is_sharp_across_it_and_shared_in_its_place() -> None:
    found = place("wound")
    there = in_frame(first("wound"), found.base_from_surface)
    laid, anchors = landmarks_on_scan(there.map, there.templates.camera, LENSES, scan("wound"), found)
    i, j = np.flatnonzero(anchors.sigma < 1.0)[[0, 1]]
    assert np.linalg.eigvalsh(laid.covariance).min() > 0
    blocks = laid.covariance.reshape(len(laid), 3, len(laid), 3)
    for k in (i, j):
        own = laid.normals[k] @ blocks[k, :, k] @ laid.normals[k]
        assert anchors.sigma[k] ** 2 < own < anchors.sigma[k] ** 2 + 0.05**2
    assert np.abs(blocks[i, :, j]).max() > 0
    turned = transform_map(laid, SCAN_FROM_SURFACE)
    back = transform_map(turned, se3.inverse(SCAN_FROM_SURFACE))
    assert np.allclose(back.points, laid.points) and np.allclose(back.covariance, laid.covariance)
