"""A scan is found where it lies in the pictures, landmarks lie on it, and what its shape leaves open is said."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from estimation import se3
from estimation.rig import ideal_pixels
from estimation.scan import Scan, scan_from_triangles
from estimation.scans.registration import Registration
from estimation.se3 import Array
from estimation.surface_map import moved_map
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.simulator.bodies import Wound, body, with_wound
from hardware.simulator.scene.scene import Scene, rois
from hardware.simulator.scene.shape import Shape, cylinder, flat
from perception.features import grey
from perception.frames import Image
from perception.lens import Lenses
from perception.mapping.dense_matching import Matched, match_on
from perception.mapping.first_map import FirstMap, build_first_map, in_frame
from perception.mapping.scan_map import ScanPlacing, as_at_one_instant
from perception.matching.patches import pyramid
from perception.scanned_map import LEAST_SIGMA, scanned
from tests.synthetic import LOOK, SCAN_FROM_SURFACE, WIDE, pictures

RIG = arc_rig(size=(640, 480), focal=560.0)  # 0.7 mm a pixel
LENSES = Lenses(RIG)
POSE = REST @ se3.exp([0.03, -0.02, 0.05, 2.0, -1.0, 3.0])
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
    found = build_first_map(LENSES, {c: pyramid(i) for c, i in images.items()}, polygons)
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
    assert body_shape.inside is not None
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


def above(matched: Matched) -> Array:
    """Heights (N,) mm of what was surely matched, over the true forearm."""
    points = se3.transform_points(se3.inverse(POSE), matched.points[matched.sure])
    xy = shape("wound").material(points)
    return np.asarray(np.einsum("ni,ni->n", points - shape("wound").points(xy), shape("wound").normals(xy)))


@pytest.mark.parametrize("lift", [0.0, 0.6, -0.6])
def test_dense_points_lie_on_the_true_surface_whatever_they_began_on(lift: float) -> None:
    """A pixel is 0.7 mm here."""
    matched = match_on(LENSES, seen("wound")[0], nodes(lift)[0], 1)
    assert matched is not None and matched.sure.mean() > 0.6
    off = above(matched)
    assert abs(np.median(off)) < 0.03 + 0.1 * abs(lift) and np.percentile(np.abs(off), 80) < 0.12 + 0.2 * abs(lift)


def test_every_other_node_is_matched_as_among_all() -> None:
    lattice = nodes()[0]
    whole, some = (match_on(LENSES, seen("wound")[0], lattice, 1, every) for every in (1, 3))
    assert whole is not None and some is not None
    both = whole.sure[::3, ::3] & some.sure
    assert both.sum() > 0.8 * some.sure.sum()
    assert np.allclose(whole.points[::3, ::3][both], some.points[both], atol=1e-6)


def test_one_camera_or_blank_pictures_match_nothing() -> None:
    images = seen("wound")[0]
    assert match_on(LENSES, {1: images[1]}, nodes()[0], 1) is None
    blank = {c: np.full_like(image, 90) for c, image in images.items()}
    matched = match_on(LENSES, blank, nodes()[0], 1)
    assert matched is None or not matched.sure.any()


def test_a_wound_is_found_on_its_scan_to_a_tenth_of_a_millimetre() -> None:
    found = place("wound")
    off = np.linalg.norm(over_wound("wound", found), axis=1)
    assert found.sure, found.verdict
    assert off.mean() < 0.1 and off.max() < 0.15


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
    laid, anchors = scanned(there.map, there.templates.camera, LENSES, scan("wound"), found)
    on = anchors.sigma < 1.0
    assert on.mean() > 0.9 and (anchors.sigma[on] >= LEAST_SIGMA).all()

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
    laid, anchors = scanned(there.map, there.templates.camera, LENSES, scan("wound"), found)
    i, j = np.flatnonzero(anchors.sigma < 1.0)[[0, 1]]
    assert np.linalg.eigvalsh(laid.covariance).min() > 0
    blocks = laid.covariance.reshape(len(laid), 3, len(laid), 3)
    for k in (i, j):
        own = laid.normals[k] @ blocks[k, :, k] @ laid.normals[k]
        assert anchors.sigma[k] ** 2 < own < anchors.sigma[k] ** 2 + 0.05**2
    assert np.abs(blocks[i, :, j]).max() > 0
    turned = moved_map(laid, SCAN_FROM_SURFACE)
    back = moved_map(turned, se3.inverse(SCAN_FROM_SURFACE))
    assert np.allclose(back.points, laid.points) and np.allclose(back.covariance, laid.covariance)
