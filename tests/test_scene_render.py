"""Pictures: each material point is imaged where the rig's own projection puts it, at the middle of the exposure."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from estimation import se3
from estimation.rig import Camera, pixels_from_points
from estimation.se3 import Array
from hardware.simulator.default_rig import REST, arc_rig
from hardware.simulator.deformation import Deformation
from hardware.simulator.instant import Instant
from hardware.simulator.look import plain
from hardware.simulator.render import render
from hardware.simulator.scene import Scene
from hardware.simulator.sensor import Sensor
from hardware.simulator.shape import cylinder, flat
from perception.frames import Image

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
    surface = scene.displaced(scene.shape.points(points), at.strain)
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


@pytest.mark.parametrize("radius", [np.inf, 55.0])
@pytest.mark.parametrize("strain", [0.0, 1.0, -0.7])
@pytest.mark.parametrize("pose", [REST, MOVED], ids=["rest", "moved"])
def test_points_are_imaged_where_the_rig_projects_them(radius: float, strain: float, pose: Array) -> None:
    off = errors(dotted(radius), instant(pose, strain=strain))
    length = np.linalg.norm(off, axis=-1)
    assert length.mean(1).max() < 0.004
    assert length.max() < 0.03


@pytest.mark.parametrize("twist", [(0.0, 0.0, 0.0, 60.0, 0.0, 0.0), (0.3, -0.2, 0.9, -25.0, 40.0, 50.0)])
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
