"""Pictures: each material point is imaged where the rig's own projection puts it, at the middle of the exposure."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest

from estimation import se3
from estimation.rig import Camera, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST, arc_rig
from estimation.synthetic.motions import Motion
from hardware.simulator.bodies import Wound, body, with_wound
from hardware.simulator.deformation import Deformation
from hardware.simulator.instant import Instant
from hardware.simulator.look import Look, plain
from hardware.simulator.render import render
from hardware.simulator.scene.scene import Scene, rois
from hardware.simulator.scene.shape import cylinder, flat, shape_from_scan
from hardware.simulator.sensor import Sensor
from hardware.simulator.truth import Truth
from perception.frames import Image
from tests.slowly import slowly

TEXEL = 0.15  # mm
PATCH = (72.0, 54.0)  # mm
SIGMA = 0.45  # mm of a dot
BARE = Sensor(noise=0.0, vignetting=0.0, blur=0.45)
RIG = arc_rig()
MOVED = REST @ se3.exp(np.array([0.05, -0.08, 0.11, 3.3, -4.7, 6.1]))
STRETCHED = Deformation((0.04, -0.02), 3.0, 25.0)


def instant(pose: Array = REST, **more: Any) -> Instant:
    return Instant(0.0, **{"exposure": 0.01, "base_from_surface": pose, "twist": np.zeros(6), **more})


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
    scene = Scene(shape, plain(dots(centres()), TEXEL), deformation)
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


def projected(scene: Scene, camera: Camera, at: Instant) -> Array:
    """Pixels (N, 2) of the dots' centroids: their points projected, each weighted by its light and its imaged area.

    A dot has a size: on a curved surface in perspective its centroid is not its centre's picture, by up to 0.02 px.
    """
    step = SIGMA / 4
    spread = np.stack(np.meshgrid(*[np.arange(-16, 17) * step] * 2), -1)  # (33, 33, 2)
    points = (centres()[:, None, None] + spread).reshape(-1, 2)
    surface = scene.shape.points(points)
    truth = Truth(REST, Motion(()), scene.deformation, None, scene.shape.surface_from_grid)
    surface = surface + truth.displacement(surface, np.full(len(surface), at.strain))
    pixels, _ = pixels_from_points(camera, se3.transform_points(at.base_from_surface, surface))
    pixels = pixels.reshape(-1, *spread.shape)
    across, down = np.gradient(pixels, axis=2), np.gradient(pixels, axis=1)
    area = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]
    light = np.abs(area) * np.exp(-(spread**2).sum(-1) / (2 * SIGMA**2))
    return (light[..., None] * pixels).sum((1, 2)) / light.sum((1, 2))[:, None]


def errors(scene: Scene, at: Instant) -> Array:
    """Offsets (3, N, 2) px of where dots are imaged from where they project to."""
    images = render(scene, RIG.cameras, [at] * 3, BARE, [np.random.default_rng(0)] * 3)
    out = []
    for camera, image in zip(RIG.cameras, images, strict=True):
        pixels = projected(scene, camera, at)
        out.append(imaged(image, pixels) - pixels)
    return np.array(out)


@pytest.mark.parametrize("radius", [55.0, *slowly(np.inf)])
@pytest.mark.parametrize("strain", [0.0, 1.0, *slowly(-0.7)])
@pytest.mark.parametrize("pose", [MOVED, *slowly(REST)], ids=["moved", "rest"])
def test_points_are_imaged_where_the_rig_projects_them(radius: float, strain: float, pose: Array) -> None:
    off = errors(dotted(radius), instant(pose, strain=strain))
    length = np.linalg.norm(off, axis=-1)
    assert length.mean(1).max() < 0.004
    assert length.max() < 0.03


@pytest.mark.parametrize("twist", [(0.3, -0.2, 0.9, -25.0, 40.0, 50.0), *slowly((0.0, 0.0, 0.0, 60.0, 0.0, 0.0))])
def test_a_moving_point_is_smeared_about_the_middle_of_the_exposure(twist: tuple[float, ...]) -> None:
    scene, exposure = dotted(), 0.02
    moving, at_rest = instant(REST, twist=np.array(twist), exposure=exposure), instant(REST)
    images = render(scene, RIG.cameras, [moving] * 3, BARE, [np.random.default_rng(0)] * 3)
    sharp = render(scene, RIG.cameras, [at_rest] * 3, BARE, [np.random.default_rng(0)] * 3)
    for camera, image, still in zip(RIG.cameras, images, sharp, strict=True):
        here = projected(scene, camera, at_rest)
        assert np.linalg.norm(imaged(image, here) - here, axis=1).max() < 0.03
        opened, closed = (REST @ se3.exp(np.array(twist) * t) for t in (-exposure / 2, exposure / 2))
        smear = np.linalg.norm(
            projected(scene, camera, instant(closed)) - projected(scene, camera, instant(opened)), axis=1
        )
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
    return Scene(body("forearm", Wound(), 2), Look(texel=0.3), seed=2)


def taken(scene: Scene, at: Instant, sensor: Sensor = BARE, cameras: Sequence[Camera] = RIG.cameras) -> list[Image]:
    rngs = [np.random.default_rng(c) for c in range(len(cameras))]
    return render(scene, cameras, [at] * len(cameras), sensor, rngs)


def region(camera: Camera, xy: Array, pose: Array = REST) -> tuple[slice, slice]:
    """The pixels of the box round material points (N, 2) of `wounded`."""
    pixels, _ = pixels_from_points(camera, se3.transform_points(pose, wounded().shape.points(xy)))
    (x0, y0), (x1, y1) = np.rint(pixels.min(0)).astype(int), np.rint(pixels.max(0)).astype(int)
    return slice(y0, y1 + 1), slice(x0, x1 + 1)


def test_pictures_do_not_depend_on_the_number_of_threads() -> None:
    scene = wounded()
    at = [instant(MOVED, twist=np.full(6, 0.5 * c), base_from_nozzle=REST) for c in range(3)]
    rngs = [[np.random.default_rng(c) for c in range(3)] for _ in range(2)]
    one, four = (render(scene, RIG.cameras, at, Sensor(), r, threads=n) for n, r in zip((1, 4), rngs, strict=True))
    for a, b in zip(one, four, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_scene_built_again_gives_the_same_picture_and_another_seed_another() -> None:
    camera = RIG.cameras[1:2]
    again, other = (Scene(body("forearm", Wound(), s), Look(texel=0.3), seed=s) for s in (2, 3))
    first = taken(wounded(), instant(), cameras=camera)[0]
    np.testing.assert_array_equal(first, taken(again, instant(), cameras=camera)[0])
    assert np.abs(first.astype(int) - taken(other, instant(), cameras=camera)[0]).mean() > 3


@pytest.mark.slow
def test_a_view_does_not_remember_the_pictures_before() -> None:
    scene = Scene(body("forearm", Wound(), 2), Look(texel=0.3), seed=2)
    taken(scene, instant(MOVED))
    for a, b in zip(taken(scene, instant()), taken(wounded(), instant()), strict=True):
        np.testing.assert_array_equal(a, b)


def test_grain_is_as_strong_as_the_sensor_says_and_differs_from_image_to_image() -> None:
    clean, noisy = (taken(wounded(), instant(), s)[1].astype(float) for s in (BARE, Sensor(3.0, 0.0, 0.45)))
    assert (noisy - clean).std() == pytest.approx(3.0, rel=0.02)
    assert abs((noisy - clean).mean()) < 0.02
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
    nozzle = REST @ se3.make(np.eye(3), tip)
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
    nozzle = REST @ se3.make(se3.exp_rotation([np.pi, 0, 0]), [0, 0, -6.0])  # inside the arm, pointing up
    for camera, before, after in zip(
        RIG.cameras, taken(wounded(), instant()), taken(wounded(), instant(base_from_nozzle=nozzle)), strict=True
    ):
        rows, columns = region(camera, np.array([[-8.0, -5.0], [8.0, 5.0]]))
        assert (np.abs(after[rows, columns].astype(int) - before[rows, columns]).max(2) > 60).mean() < 0.01


def test_beads_are_seen_where_they_are_laid_and_nowhere_else() -> None:
    scene = Scene(body("forearm", Wound(), 2), Look(texel=0.2), seed=2)
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
    scenes = [Scene(body("chest", Wound(), 1), Look(texel=0.2), seed=1) for _ in range(2)]
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
    wet, dry = (Scene(body("forearm", Wound(), 2), Look(texel=0.2, wetness=w), seed=2) for w in (1.0, 0.0))
    xy = np.array([[-12.0, -8.0], [12.0, 8.0]])
    here = region(RIG.cameras[1], xy)
    glare, matt = (taken(s, instant(), cameras=RIG.cameras[1:2])[0][here].min(2) for s in (wet, dry))
    assert (glare > 150).mean() > 3 * (matt > 150).mean() + 0.002


def test_far_cloth_rests_while_cloth_by_the_wound_moves_with_it() -> None:
    still, moved = (
        taken(wounded(), instant(p))[1].astype(int) for p in (REST, REST @ se3.exp(np.array([0, 0, 0, 2.0, 1, 1])))
    )
    assert np.abs(moved - still)[:60, :60].max() <= 1
    assert np.abs(moved - still)[300:420, 400:880].mean() > 4


def test_regions_hold_the_wound_in_every_camera() -> None:
    regions = rois(wounded(), RIG, MOVED, 1.5)
    assert [r.camera for r in regions] == [0, 1, 2]
    middle = se3.transform_points(MOVED, wounded().shape.points([[0.0, 0.0], [15.0, 8.0]]))
    for roi in regions:
        pixels, _ = pixels_from_points(RIG.cameras[roi.camera], middle)
        for x, y in pixels:
            assert cv2.pointPolygonTest(roi.polygon.astype(np.float32), (float(x), float(y)), False) > 0
        assert roi.stamp == 1.5


def test_a_scan_is_drawn_in_its_own_frame() -> None:
    source = wounded().shape
    surface_from_scanner = se3.make(se3.exp_rotation([0.3, -0.2, 0.1]), [12.0, -7.0, 31.0])
    vertices, triangles = source.mesh(0.5)
    shape = with_wound(
        shape_from_scan(se3.transform_points(surface_from_scanner, vertices), triangles, 0.5), Wound(), 2
    )
    pose = REST @ se3.inverse(surface_from_scanner)
    scene = Scene(shape, Look(texel=0.4), seed=2, base_from_rest=pose)
    image = taken(scene, instant(pose), cameras=RIG.cameras[1:2])[0].astype(float)
    point = se3.transform_points(pose, shape.points([[0.0, 0.0]]))
    x, y = np.rint(pixels_from_points(RIG.cameras[1], point)[0][0]).astype(int)
    assert image[y - 6 : y + 6, x - 6 : x + 6, 2].mean() > 1.5 * image[y - 6 : y + 6, x - 6 : x + 6, 1].mean()


def test_a_surface_out_of_view_leaves_the_cloth() -> None:
    aside = se3.make(np.eye(3), [5000.0, 0, 0]) @ REST
    assert all(image.std() < 40 for image in taken(wounded(), instant(aside)))


def test_a_patch_is_built_quickly_enough_for_tests() -> None:
    scene = Scene(flat(PATCH), plain(dots(centres()), TEXEL))
    assert scene.layers.size == (360, 480)
    assert scene.opening == PATCH


@pytest.mark.parametrize("size", [(641, 483), *slowly((320, 240))])
def test_an_image_of_any_size_is_filled(size: tuple[int, int]) -> None:
    small = arc_rig(size=size, focal=500.0).cameras
    nozzle = REST @ se3.make(np.eye(3), [0.0, 0.0, 1.0])
    for image in taken(wounded(), instant(base_from_nozzle=nozzle), cameras=small):
        assert image.shape == (size[1], size[0], 3)
        assert image.reshape(-1, 3).max(1).min() > 5
