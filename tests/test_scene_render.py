"""Pictures: points imaged by the rig's projection at mid-exposure; shapes as height fields; each picture its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Camera, pixels_from_points
from estimation.scans.scan import face_normals, scan_from_triangles
from estimation.se3 import Array
from estimation.synthetic.movements import ComposedMotion
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.files.images import decode, encode
from hardware.simulator import camera_pipeline
from hardware.simulator.camera_pipeline import PictureRenderer
from hardware.simulator.cameras import Fate, Shot, TrueCameras
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState
from hardware.simulator.scene.shape import (
    BODIES,
    Deformation,
    Wound,
    body,
    cylinder,
    flat,
    shape_from_function,
    shape_from_scan,
    with_wound,
)
from hardware.simulator.truth import Truth
from perception.frames import Image
from tests.slow_cases import slowly

TEXEL = 0.15  # mm
PATCH = (72.0, 54.0)  # mm
SIGMA = 0.45  # mm of a dot
BARE = Sensor(noise=0.0, vignetting=0.0, blur=0.45)
RIG = arc_rig()
MOVED = BASE_FROM_REST @ se3.exp(np.array([0.05, -0.08, 0.11, 3.3, -4.7, 6.1]))
STRETCHED = Deformation((0.04, -0.02), 3.0, 25.0)


def unlit(texture: Image) -> Appearance:
    """The look of a picture (H, W, 3) BGR that is imaged as it is."""
    return Appearance(texel=TEXEL, drape=False, texture=texture, lit=False)


def instant(pose: Array = BASE_FROM_REST, **more: Any) -> WorldState:
    return WorldState(0.0, **{"exposure": 0.01, "base_from_surface": pose, "twist": np.zeros(6), **more})


def dots(centres: Array) -> Image:
    """White Gaussian dots on black over PATCH; centres: (N, 2) mm."""
    x, y = ((np.arange(round(s / TEXEL)) + 0.5) * TEXEL - s / 2 for s in PATCH)
    wide = np.exp(-(((x - centres[:, :1]) / SIGMA) ** 2) / 4)  # the display's value is the square root of the light
    high = np.exp(-(((y - centres[:, 1:]) / SIGMA) ** 2) / 4)
    return np.repeat(np.rint(255 * np.clip(high.T @ wide, 0, 1)).astype(np.uint8)[..., None], 3, 2)


@cache
def centres() -> Array:
    """Dots 8 by 14 mm apart, each off its place by some part of a texel."""
    x, y = (np.arange(-n, n + 1) * d for n, d in ((4, 8.0), (1, 14.0)))
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return grid + np.random.default_rng(1).uniform(-0.4, 0.4, grid.shape)


def dotted(radius: float = 55.0, deformation: Deformation = STRETCHED) -> Scene:
    shape = flat(PATCH) if np.isinf(radius) else cylinder(PATCH, radius)
    scene = Scene(shape, unlit(dots(centres())), deformation)
    scene.sheet.picture[:] = 0  # a black room
    return scene


def imaged(image: Image, near: Array) -> Array:
    """Centroids (N, 2) px of the light about the pixels (N, 2)."""
    light = (image.mean(2) / 255) ** 2
    found = []
    for x, y in np.rint(near).astype(int):
        window = light[y - 6 : y + 7, x - 6 : x + 7]
        yy, xx = np.mgrid[y - 6 : y + 7, x - 6 : x + 7]
        found.append([(window * xx).sum() / window.sum(), (window * yy).sum() / window.sum()])
    return np.array(found)


def projected(scene: Scene, camera: Camera, at: WorldState) -> Array:
    """Pixels (N, 2) of the dots' centroids: their points projected, each weighted by its light and its imaged area.

    A dot has a size: on a curved surface in perspective its centroid is not its centre's picture, by up to 0.02 px.
    """
    step = SIGMA / 4
    spread = np.stack(np.meshgrid(*[np.arange(-16, 17) * step] * 2), -1)  # (33, 33, 2)
    points = (centres()[:, None, None] + spread).reshape(-1, 2)
    surface = scene.shape.points(points)
    truth = Truth(BASE_FROM_REST, ComposedMotion(()), scene.deformation, None, scene.shape.surface_from_grid)
    surface = surface + truth.displacement(surface, np.full(len(surface), at.strain))
    pixels, _ = pixels_from_points(camera, se3.transform_points(at.base_from_surface, surface))
    pixels = pixels.reshape(-1, *spread.shape)
    across, down = np.gradient(pixels, axis=2), np.gradient(pixels, axis=1)
    area = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]
    light = np.abs(area) * np.exp(-(spread**2).sum(-1) / (2 * SIGMA**2))
    return (light[..., None] * pixels).sum((1, 2)) / light.sum((1, 2))[:, None]


def errors(scene: Scene, at: WorldState) -> Array:
    """Offsets (3, N, 2) px of where dots are imaged from where they project to."""
    images = render(scene, RIG.cameras, [at] * 3, BARE, [np.random.default_rng(0)] * 3)
    out = []
    for camera, image in zip(RIG.cameras, images, strict=True):
        pixels = projected(scene, camera, at)
        out.append(imaged(image, pixels) - pixels)
    return np.array(out)


@pytest.mark.parametrize("radius", [55.0, *slowly(np.inf)])
@pytest.mark.parametrize("strain", [0.0, 1.0, *slowly(-0.7)])
@pytest.mark.parametrize("pose", [MOVED, *slowly(BASE_FROM_REST)], ids=["moved", "rest"])
def test_points_are_imaged_where_the_rig_projects_them(radius: float, strain: float, pose: Array) -> None:
    off = errors(dotted(radius), instant(pose, strain=strain))
    length = np.linalg.norm(off, axis=-1)
    assert length.mean(1).max() < 0.004 and length.max() < 0.03


@pytest.mark.parametrize("twist", [(0.3, -0.2, 0.9, -25.0, 40.0, 50.0), *slowly((0.0, 0.0, 0.0, 60.0, 0.0, 0.0))])
def test_a_moving_point_is_smeared_about_the_middle_of_the_exposure(twist: tuple[float, ...]) -> None:
    scene, exposure = dotted(), 0.02
    moving, at_rest = instant(BASE_FROM_REST, twist=np.array(twist), exposure=exposure), instant(BASE_FROM_REST)
    images = render(scene, RIG.cameras, [moving] * 3, BARE, [np.random.default_rng(0)] * 3)
    sharp = render(scene, RIG.cameras, [at_rest] * 3, BARE, [np.random.default_rng(0)] * 3)
    for camera, image, still in zip(RIG.cameras, images, sharp, strict=True):
        here = projected(scene, camera, at_rest)
        assert np.linalg.norm(imaged(image, here) - here, axis=1).max() < 0.03
        opened, closed = (BASE_FROM_REST @ se3.exp(np.array(twist) * t) for t in (-exposure / 2, exposure / 2))
        ends = [projected(scene, camera, instant(pose)) for pose in (opened, closed)]
        smear = np.linalg.norm(ends[1] - ends[0], axis=1)
        assert smear.max() > 1.5
        shape = spread(image, here) - spread(still, here)
        np.testing.assert_allclose(np.sqrt(12 * shape.clip(0)), smear, rtol=0.1, atol=0.1)


def spread(image: Image, near: Array) -> Array:
    """Variances (N,) px^2, both axes together, of the light about the pixels (N, 2)."""
    light = (image.mean(2) / 255) ** 2
    found = []
    for x, y in np.rint(near).astype(int):
        window = light[y - 7 : y + 8, x - 7 : x + 8]
        yy, xx = np.mgrid[y - 7 : y + 8, x - 7 : x + 8]
        mx, my = ((window * axis).sum() / window.sum() for axis in (xx, yy))
        found.append((window * ((xx - mx) ** 2 + (yy - my) ** 2)).sum() / window.sum())
    return np.array(found)


@cache
def wounded() -> Scene:
    """A forearm with a wound, coarsely painted; nothing may be printed on it."""
    return Scene(body("forearm", Wound(), 2), Appearance(texel=0.3), seed=2)


def taken(scene: Scene, at: WorldState, sensor: Sensor = BARE, cameras: Sequence[Camera] = RIG.cameras) -> list[Image]:
    rngs = [np.random.default_rng(c) for c in range(len(cameras))]
    return render(scene, cameras, [at] * len(cameras), sensor, rngs)


def region(camera: Camera, xy: Array, pose: Array = BASE_FROM_REST) -> tuple[slice, slice]:
    """The pixels of the box round material points (N, 2) of `wounded`."""
    pixels, _ = pixels_from_points(camera, se3.transform_points(pose, wounded().shape.points(xy)))
    (x0, y0), (x1, y1) = np.rint(pixels.min(0)).astype(int), np.rint(pixels.max(0)).astype(int)
    return slice(y0, y1 + 1), slice(x0, x1 + 1)


def test_pictures_do_not_depend_on_the_number_of_threads() -> None:
    scene = wounded()
    at = [instant(MOVED, twist=np.full(6, 0.5 * c), base_from_nozzle=BASE_FROM_REST) for c in range(3)]
    rngs = [[np.random.default_rng(c) for c in range(3)] for _ in range(2)]
    one, four = (render(scene, RIG.cameras, at, Sensor(), r, threads=n) for n, r in zip((1, 4), rngs, strict=True))
    for a, b in zip(one, four, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_scene_built_again_gives_the_same_picture_and_another_seed_another() -> None:
    camera = RIG.cameras[1:2]
    again, other = (Scene(body("forearm", Wound(), s), Appearance(texel=0.3), seed=s) for s in (2, 3))
    first = taken(wounded(), instant(), cameras=camera)[0]
    taken(again, instant(MOVED), cameras=camera)  # no picture is remembered
    np.testing.assert_array_equal(first, taken(again, instant(), cameras=camera)[0])
    assert np.abs(first.astype(int) - taken(other, instant(), cameras=camera)[0]).mean() > 3


def test_grain_is_as_strong_as_the_sensor_says_and_differs_from_image_to_image() -> None:
    clean, noisy = (taken(wounded(), instant(), s)[1].astype(float) for s in (BARE, Sensor(3.0, 0.0, 0.45)))
    assert (noisy - clean).std() == pytest.approx(3.0, rel=0.02) and abs((noisy - clean).mean()) < 0.02
    again = render(wounded(), RIG.cameras[1:2], [instant()], Sensor(3.0, 0.0, 0.45), [np.random.default_rng(9)])[0]
    assert np.corrcoef((noisy - clean).ravel(), (again - clean).ravel())[0, 1] < 0.03


def test_gain_scales_the_light_and_vignetting_darkens_the_corners() -> None:
    dim, bright = (taken(wounded(), instant(gain=g))[0].astype(float) for g in (0.5, 1.0))
    lit = (bright > 40) & (bright < 250)
    np.testing.assert_allclose((dim[lit] / bright[lit]) ** 2, 0.5, atol=0.03)
    fallen = taken(wounded(), instant(), Sensor(0.0, 1.0, 0.45))[0].astype(float)
    x, y = (1279 - RIG.cameras[0].matrix[0, 2]) / 1100, (719 - RIG.cameras[0].matrix[1, 2]) / 1100
    corner = (fallen[-40:, -40:].mean() / bright[-40:, -40:].mean()) ** 2
    assert corner == pytest.approx((1 + x * x + y * y) ** -2, rel=0.05)


def test_the_nozzle_hides_what_is_behind_it_and_casts_a_shadow() -> None:
    scene, place = wounded(), np.array([[4.0, 3.0]])
    tip = scene.shape.points(place)[0] + [0, 0, 0.5]
    nozzle = BASE_FROM_REST @ se3.make(np.eye(3), tip)
    plain_images, images = (taken(scene, instant(base_from_nozzle=n)) for n in (None, nozzle))
    for camera, before, after in zip(RIG.cameras, plain_images, images, strict=True):
        change = after.astype(int) - before
        axis = se3.transform_points(nozzle, [[0.0, 0, z] for z in (0.0, 30.0, 55.0)])
        pixels = np.rint(pixels_from_points(camera, axis)[0]).astype(int)
        for x, y in pixels:
            assert np.abs(change[y - 1 : y + 2, x - 1 : x + 2]).mean() > 8
        assert np.abs(change[:150, :300]).max() <= 1
    shaded = (images[0].astype(int) - plain_images[0]).mean(2)
    beside = region(RIG.cameras[0], np.array([[14.0, 5.0], [24.0, 12.0]]))  # away from the key lamp
    assert shaded[beside].mean() < -4


def test_a_nozzle_below_the_skin_is_not_seen() -> None:
    nozzle = BASE_FROM_REST @ se3.make(se3.exp_rotation([np.pi, 0, 0]), [0, 0, -6.0])  # inside the arm, pointing up
    for camera, before, after in zip(
        RIG.cameras, taken(wounded(), instant()), taken(wounded(), instant(base_from_nozzle=nozzle)), strict=True
    ):
        rows, columns = region(camera, np.array([[-8.0, -5.0], [8.0, 5.0]]))
        assert (np.abs(after[rows, columns].astype(int) - before[rows, columns]).max(2) > 60).mean() < 0.01


def test_beads_are_seen_where_they_are_laid_and_nowhere_else() -> None:
    scene = Scene(body("forearm", Wound(), 2), Appearance(texel=0.2), seed=2)
    bare = taken(scene, instant())
    scene.ink.lay([-8.0, 0.0], [8.0, 0.0], 1.2)
    printed = taken(scene, instant())
    for camera, before, after in zip(RIG.cameras, bare, printed, strict=True):
        change = np.abs(after.astype(int) - before).max(2)
        rows, columns = region(camera, np.array([[-8.8, -0.8], [8.8, 0.8]]))
        inner = region(camera, np.array([[-7.5, -0.05], [7.5, 0.05]]))
        assert np.median(change[inner]) > 15
        change[rows.start - 3 : rows.stop + 3, columns.start - 3 : columns.stop + 3] = 0
        assert not change.any()


@pytest.mark.slow
def test_a_bead_in_pieces_is_one_bead_and_laying_it_twice_changes_nothing() -> None:
    scenes = [Scene(body("chest", Wound(), 1), Appearance(texel=0.2), seed=1) for _ in range(2)]
    ends = np.column_stack([np.linspace(-6, 6, 41), np.linspace(2, -3, 41)])
    scenes[0].ink.lay(ends[0], ends[-1], 0.9)
    for _ in range(2):
        for a, b in pairwise(ends):
            scenes[1].ink.lay(a, b, 0.9)
    scenes[1].ink.lay([900.0, 0.0], [901.0, 0.0], 1.0)  # beside the texture
    for one, other in zip(scenes[0].layers.colour, scenes[1].layers.colour, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-4)
    coarse, fine = scenes[1].layers.relief[2], scenes[1].layers.relief[0]
    np.testing.assert_allclose(coarse, fine.reshape(coarse.shape[0], 4, coarse.shape[1], 4, 4).mean((1, 3)), atol=1e-5)


@pytest.mark.slow
def test_a_wet_wound_glares_and_a_dry_one_does_not() -> None:
    wet, dry = (Scene(body("forearm", Wound(), 2), Appearance(texel=0.2, wetness=w), seed=2) for w in (1.0, 0.0))
    xy = np.array([[-12.0, -8.0], [12.0, 8.0]])
    here = region(RIG.cameras[1], xy)
    glare, matt = (taken(s, instant(), cameras=RIG.cameras[1:2])[0][here].min(2) for s in (wet, dry))
    assert (glare > 150).mean() > 3 * (matt > 150).mean() + 0.002


def test_far_cloth_rests_while_cloth_by_the_wound_moves_with_it() -> None:
    still, moved = (
        taken(wounded(), instant(p))[1].astype(int)
        for p in (BASE_FROM_REST, BASE_FROM_REST @ se3.exp(np.array([0, 0, 0, 2.0, 1, 1])))
    )
    assert np.abs(moved - still)[:60, :60].max() <= 1 and np.abs(moved - still)[300:420, 400:880].mean() > 4


def test_a_scan_is_drawn_in_its_own_frame() -> None:
    source = wounded().shape
    surface_from_scanner = se3.make(se3.exp_rotation([0.3, -0.2, 0.1]), [12.0, -7.0, 31.0])
    vertices, triangles = source.mesh(0.5)
    scan = shape_from_scan(se3.transform_points(surface_from_scanner, vertices), triangles, 0.5)
    shape = with_wound(scan, Wound(), 2)
    pose = BASE_FROM_REST @ se3.inverse(surface_from_scanner)
    scene = Scene(shape, Appearance(texel=0.4), seed=2, base_from_rest=pose)
    image = taken(scene, instant(pose), cameras=RIG.cameras[1:2])[0].astype(float)
    point = se3.transform_points(pose, shape.points([[0.0, 0.0]]))
    x, y = np.rint(pixels_from_points(RIG.cameras[1], point)[0][0]).astype(int)
    assert image[y - 6 : y + 6, x - 6 : x + 6, 2].mean() > 1.5 * image[y - 6 : y + 6, x - 6 : x + 6, 1].mean()


def test_a_patch_is_built_quickly_enough_for_tests() -> None:
    scene = Scene(flat(PATCH), unlit(dots(centres())))
    assert scene.layers.size == (360, 480) and scene.opening == PATCH


@pytest.mark.parametrize("size", [(641, 483), *slowly((320, 240))])
def test_an_image_of_any_size_is_filled(size: tuple[int, int]) -> None:
    small = arc_rig(size=size, focal=500.0).cameras
    nozzle = BASE_FROM_REST @ se3.make(np.eye(3), [0.0, 0.0, 1.0])
    for image in taken(wounded(), instant(base_from_nozzle=nozzle), cameras=small):
        assert image.shape == (size[1], size[0], 3) and image.reshape(-1, 3).max(1).min() > 5


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
    assert errors[0] < 1.0 / (8 * 50) and errors[0] > 3.5 * errors[1] > 12 * errors[2]


@pytest.mark.parametrize("kind", sorted(BODIES))
def test_a_body_has_its_wound_in_the_middle_at_skin_level(kind: str) -> None:
    wound = Wound((40.0, 30.0), 2.5)
    shape, bare = body(kind, wound, 4), body(kind, None, 4)
    sunk = bare.heights - shape.heights
    assert abs(bare.heights_at([[0, 0]])[0]) < 0.8  # the body's own unevenness
    assert 1.5 < sunk[shape.inside > 4].mean() < 3.0
    assert np.abs(sunk[shape.inside < -8]).max() < 0.01
    columns, rows = (np.ptp(np.nonzero((shape.inside > 0).any(axis))[0]) * shape.step for axis in (0, 1))
    assert abs(columns - 40) < 9
    assert abs(rows - 30) < 8
    assert np.abs(np.stack(np.gradient(shape.heights, shape.step))).max() < 1.6


def test_a_body_is_made_by_its_seed() -> None:
    np.testing.assert_array_equal(body("foot", Wound(), 3).heights, body("foot", Wound(), 3).heights)
    assert np.abs(body("foot", Wound(), 3).heights - body("foot", Wound(), 4).heights).max() > 0.1


def test_the_mesh_lies_on_the_shape_and_faces_out() -> None:
    shape = body("chest", Wound(), 1)
    vertices, triangles = shape.mesh(2.0)
    np.testing.assert_allclose(shape.points(shape.material(vertices)), vertices, atol=1e-9)
    assert (face_normals(scan_from_triangles(vertices, triangles))[:, 2] > 0.4).all()
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
    assert shape.valid is not None and shape.valid.mean() > 0.97


def test_holes_of_a_scan_are_no_surface_and_overhangs_hide_what_is_below() -> None:
    source = flat((40.0, 30.0))
    vertices, triangles = source.mesh(1.0)
    middle = vertices[triangles].mean(1)
    kept = triangles[np.linalg.norm(middle[:, :2] - [8.0, 0.0], axis=1) > 4]
    roof = np.array([[-11.0, -3.0, 2.0], [-5.0, -3.0, 2.0], [-11.0, 3.0, 2.0]])
    over = len(vertices) + np.array([[0, 1, 2]])
    shape = shape_from_scan(np.concatenate([vertices, roof]), np.concatenate([kept, over]), 0.5)
    at = np.rint(shape.nodes(shape.material([[8.0, 0.0, 0.0], [0.0, 10.0, 0.0]]))).astype(int)
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
    assert shape.inside is not None and (shape.inside > 0).any()
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


SHAPE_RIG = arc_rig(size=(96, 64), focal=140.0)


@cache
def scene() -> Scene:
    return Scene(cylinder((60.0, 40.0), 45.0), Appearance(texel=1.0))


def pictures(seed: int = 3, quality: int | None = 90, threads: int = 1) -> PictureRenderer:
    return PictureRenderer(scene(), TrueCameras(SHAPE_RIG.cameras), Sensor(), quality, seed, threads)


def shot(camera: int, number: int, fate: Fate = Fate.DELIVERED) -> Shot:
    stamp = 0.1 + number / 30
    return Shot(camera, number, number, stamp, stamp, stamp + 0.03, 0.008, 1.0, fate)


def shape_instant(number: int) -> WorldState:
    pose = BASE_FROM_REST @ se3.exp([0.0, 0.0, 0.0, 0.5 * number, 0.0, 0.0])
    return WorldState(0.1 + number / 30, 0.008, pose, np.array([0.0, 0, 0, 15.0, 0, 0]))


def shape_taken(source: PictureRenderer, shots: list[Shot]) -> list[tuple[str, bytes]]:
    for one in shots:
        source.expose(one, shape_instant(one.picture))
    return encoded(source, shots)


def encoded(source: PictureRenderer, shots: list[Shot]) -> list[tuple[str, bytes]]:
    return [(picture.kind, picture.data) for picture in map(source.take, shots)]


ALL = [shot(camera, number) for number in range(2) for camera in range(3)]


def test_a_picture_does_not_depend_on_threads_or_on_what_else_waits() -> None:
    together = shape_taken(pictures(), ALL)
    assert together == shape_taken(pictures(threads=2), ALL)
    assert together == [shape_taken(pictures(), [one])[0] for one in ALL]
    assert together[::-1] == shape_taken(pictures(), ALL[::-1]) and len(set(together)) == len(ALL)


def test_noise_differs_by_seed_and_from_picture_to_picture_of_the_same_thing() -> None:
    def noisy(seed: int, number: int) -> Image:
        source = pictures(seed, None)
        source.expose(shot(0, number), shape_instant(0))
        picture = source.take(shot(0, number))
        assert isinstance(picture.image, np.ndarray) and (picture.image == decode(picture.data, "", "")).all()
        return picture.image.astype(int)

    first, other_seed, later = noisy(3, 0), noisy(4, 0), noisy(3, 1)
    assert 0 < np.abs(first - other_seed).mean() < 6 and 0 < np.abs(first - later).mean() < 6


def test_a_repeated_frame_is_the_same_and_a_damaged_one_has_the_header_of_the_whole() -> None:
    source = pictures()
    again = replace(shot(1, 1, Fate.DUPLICATED), picture=0, exposed=0.1)
    first, second = shape_taken(source, [shot(1, 0), again])
    assert first == second
    whole = shape_taken(pictures(), [shot(2, 0)])[0]
    damaged = shape_taken(pictures(), [shot(2, 0, Fate.GARBLED)])[0]
    assert damaged[1] != whole[1] and damaged[1][:100] == whole[1][:100]
    assert damaged == shape_taken(pictures(), [shot(2, 0, Fate.GARBLED)])[0]


def test_a_picture_that_cannot_be_decoded_says_whose_it_is() -> None:
    damaged = [shot(1, number, Fate.GARBLED) for number in range(12)]
    source, undecodable = pictures(quality=30), list[str]()
    for one in damaged:
        source.expose(one, shape_instant(0))
    for one in damaged:
        picture = source.take(one)
        if isinstance(picture.image, InputError):
            undecodable.append(str(picture.image))
            start = f"camera {SHAPE_RIG.cameras[1].name}: picture {one.number} = '{len(picture.data)} bytes"
            assert undecodable[-1].startswith(start)
    assert 0 < len(undecodable) < len(damaged)


def test_pictures_are_jpegs_or_lossless_as_asked() -> None:
    kinds = {quality: shape_taken(pictures(quality=quality), ALL[:1])[0] for quality in (90, 30, None)}
    assert [kinds[quality][0] for quality in (90, 30, None)] == ["jpeg", "jpeg", "png"]
    assert len(kinds[30][1]) < len(kinds[90][1]) < len(kinds[None][1])
    image = decode(kinds[None][1], "", "")
    assert image.shape == (64, 96, 3)
    assert 20 < image.mean() < 235


def test_each_picture_is_taken_once() -> None:
    source = pictures()
    shape_taken(source, ALL[:3])
    with pytest.raises((KeyError, ValueError)):
        source.take(ALL[0])


def test_what_is_printed_is_brought_up_to_the_first_exposure_that_waits() -> None:
    told = list[float]()
    source = PictureRenderer(scene(), TrueCameras(SHAPE_RIG.cameras), Sensor(), 90, 3, 1, told.append)
    for one in (shot(0, 1), shot(1, 0), shot(2, 1)):
        source.expose(one, shape_instant(one.number))
    source.take(shot(2, 1))
    source.take(shot(0, 1))
    assert told == [0.1]


def test_pictures_made_in_the_background_are_the_same_and_no_bead_is_laid_meanwhile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    making, laid = threading.Event(), list[bool]()

    def slow_encode(*arguments: Any) -> tuple[str, bytes]:
        making.set()
        time.sleep(0.05)
        result = encode(*arguments)
        making.clear()
        return result

    expected = shape_taken(pictures(), ALL)
    monkeypatch.setattr(camera_pipeline, "encode", slow_encode)

    def note(until: float) -> None:
        laid.append(making.is_set())

    source = PictureRenderer(scene(), TrueCameras(SHAPE_RIG.cameras), Sensor(), 90, 3, 1, note)
    for number in range(2):
        for one in ALL[3 * number : 3 * number + 3]:
            source.expose(one, shape_instant(one.picture))
        source.start()
    assert encoded(source, ALL) == expected
    assert laid == [False, False]
