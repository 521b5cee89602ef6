"""Pictures of a scene: what each camera's image is at each instant, the nozzle in front of what is behind it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import Camera, pixels_from_points
from estimation.se3 import Array
from hardware.simulator.scene.appearance import Sensor, expose
from hardware.simulator.scene.fields import Field, upsample
from hardware.simulator.scene.rays import ImageBox, RenderView
from hardware.simulator.scene.scene import (
    NOZZLE_PARTS,
    XYZ,
    Frustum,
    Scene,
    SceneState,
    WorldState,
    part_hit,
    part_outline,
    rotate_rays,
    scene_state,
)
from hardware.simulator.scene.surface_picture import (
    DRAPE_LATTICE_PX,
    DrapePicture,
    SurfacePicture,
    drape_picture,
    surface_picture,
)
from perception.frames import Image

MIN_PART_DEPTH = 30.0  # mm before the lens: nearer, a part is not drawn
NOZZLE_LATTICE_PX = 4  # px between the rays that are looked up; straight between them, off by 1e-3 px


def part_boxes(state: SceneState, view: RenderView) -> list[tuple[Frustum, ImageBox]]:
    """The parts in view and the part of the image that each can touch."""
    if state.instant.base_from_nozzle is None:
        return []
    outlines = np.stack([part_outline(part) for part in NOZZLE_PARTS])
    points = se3.transform_points(state.instant.base_from_nozzle, outlines.reshape(-1, 3))
    pixels, depth = pixels_from_points(view.camera, points)
    pixels, depth = pixels.reshape(*outlines.shape[:2], 2), depth.reshape(outlines.shape[:2])
    boxes = (
        view.clip(p.min(0) - 2, p.max(0) + 3) if d.min() > MIN_PART_DEPTH else None
        for p, d in zip(pixels, depth, strict=True)
    )
    return [(part, box) for part, box in zip(NOZZLE_PARTS, boxes, strict=True) if box is not None]


def whole_box(boxes: list[tuple[Frustum, ImageBox]]) -> ImageBox:
    """The box that holds all of them."""
    corners = np.array([box for _, box in boxes])
    x0, y0 = (int(v) for v in corners[:, :2].min(0))
    x1, y1 = (int(v) for v in corners[:, 2:].max(0))
    return ImageBox(x0, y0, x1, y1)


def nozzle_picture(
    state: SceneState, view: RenderView, boxes: list[tuple[Frustum, ImageBox]], behind: Field
) -> NDArray[np.float32]:
    """Light (H, W, 4) of parts in their whole box: linear BGR times opacity, and opacity. behind: (2H, 2W) depth mm."""
    assert state.instant.base_from_nozzle is not None
    box = whole_box(boxes)
    nozzle_from_camera = se3.inverse(state.instant.base_from_nozzle) @ view.camera.base_from_camera
    coarse = (tangents[box.lattice(NOZZLE_LATTICE_PX)] for tangents in view.coarse(NOZZLE_LATTICE_PX))
    rays = rotate_rays(nozzle_from_camera[:3, :3], *(upsample(tangents, box.sample_size) for tangents in coarse))
    depth, which = behind.copy(), np.full(behind.shape, -1, np.int8)
    normal = [np.zeros(behind.shape, np.float32) for _ in range(3)]
    for part, inner in boxes:
        at = box.samples(inner)
        hit = part_hit(part, nozzle_from_camera[:3, 3], (rays[0][at], rays[1][at], rays[2][at]))
        nearer = hit.depth < depth[at]
        which[at][nearer] = NOZZLE_PARTS.index(part)
        for into, new in zip((depth, *normal), hit, strict=True):
            np.copyto(into[at], new, where=nearer)
    light = np.zeros((*behind.shape, 4), np.float32)
    visible = which >= 0
    nozzle_from_rest = se3.inverse(state.instant.base_from_nozzle) @ state.scene.base_from_rest
    x, y, z = (n[visible] for n in normal)
    dx, dy, dz = (r[visible] for r in rays)
    light[visible] = _shaded(state, which[visible], (x, y, z), (dx, dy, dz), nozzle_from_rest)
    return np.asarray(cv2.resize(light, box.size[::-1], interpolation=cv2.INTER_AREA), np.float32)


def _shaded(
    state: SceneState, part: NDArray[np.int8], normal: XYZ, rays: XYZ, nozzle_from_rest: Array
) -> NDArray[np.float32]:
    """Linear BGR and opacity (N, 4) of the nozzle; metal mirrors a room that is bright above and dark below."""
    colour = np.stack([p.colour for p in NOZZLE_PARTS]).astype(np.float32)[part]
    gloss = np.array([p.gloss for p in NOZZLE_PARTS], np.float32)[part]
    metal = np.array([p.metal for p in NOZZLE_PARTS])[part]
    length = np.sqrt(rays[0] ** 2 + rays[1] ** 2 + rays[2] ** 2)
    away = _dot(rays, normal) / length  # cosine, negative towards the eye
    x, y, z = (ray / length - 2 * away * across for ray, across in zip(rays, normal, strict=True))
    reflected, up = (x, y, z), nozzle_from_rest[:3, 2]
    height = _dot(reflected, up)
    room = np.clip(0.46 + 0.45 * height + 0.12 * np.sin(9 * height), 0.12, 1.0)
    light = np.float32(state.scene.look.ambient) * (0.6 + 0.4 * _dot(normal, up))
    glint = np.zeros_like(light)
    for lamp in state.lamps:
        towards = nozzle_from_rest[:3, :3] @ lamp.towards
        light = light + np.float32(lamp.strength) * np.maximum(_dot(normal, towards), 0)
        bright = np.exp(np.float32(12 / (0.06 + lamp.spread)) * (_dot(reflected, towards) - 1))
        glint = glint + np.float32(lamp.strength) * bright
    rim = 0.04 + 0.5 * (1 + np.minimum(away, 0)) ** 4
    own = np.where(metal, 0.75 * room + 0.25 * light, light)
    film = np.where(metal, 0.7 * glint * gloss, (rim * room + 0.5 * glint) * gloss)
    tint = np.where(metal[:, None], colour, 1)
    return np.column_stack([colour * own[:, None] + tint * film[:, None], np.ones_like(own)]).astype(np.float32)


def _dot(a: XYZ, b: XYZ | Array) -> Field:
    x, y, z = (np.asarray(v, np.float32) for v in b)
    return np.asarray(a[0] * x + a[1] * y + a[2] * z, np.float32)


def render(
    scene: Scene,
    cameras: Sequence[Camera],
    instants: Sequence[WorldState],
    sensor: Sensor,
    rngs: Sequence[Generator],
    threads: int = 2,
) -> list[Image]:
    """Images (H, W, 3) BGR, one per camera with its instant and its noise; the same for any number of threads."""
    shared = {key: scene_state(scene, instant) for key, instant in {id(i): i for i in instants}.items()}
    with ThreadPoolExecutor(threads) as pool:
        jobs = [(shared[id(i)], scene.view(c)) for c, i in zip(cameras, instants, strict=True)]
        skins = [pool.submit(surface_picture, s, v) for s, v in jobs]
        cloths = [pool.submit(drape_picture, s, v) for s, v in jobs]
        images = [
            pool.submit(_finished, s, v, skin.result(), cloth.result(), sensor, rng)
            for (s, v), skin, cloth, rng in zip(jobs, skins, cloths, rngs, strict=True)
        ]
        return [image.result() for image in images]


class StillScene:
    """Pictures of a scene that stands still, with a nozzle before it that casts no shadow: a tenth of the work."""

    def __init__(self, scene: Scene, cameras: Sequence[Camera], still: WorldState) -> None:
        """still: without a nozzle."""
        shared = scene_state(scene, still)
        self._scene, self._shared = scene, shared
        self._views = [scene.view(camera) for camera in cameras]
        self._behind = [(surface_picture(shared, view), drape_picture(shared, view)) for view in self._views]

    def __call__(self, camera: int, instant: WorldState, sensor: Sensor, rng: Generator) -> Image:
        """The image (H, W, 3) BGR of a camera by its number."""
        skin, cloth = self._behind[camera]
        now, fresh = replace(self._shared, instant=instant), replace(cloth, light=cloth.light.copy())
        return _finished(now, self._views[camera], skin, fresh, sensor, rng)


def _finished(
    now: SceneState, view: RenderView, skin: SurfacePicture | None, cloth: DrapePicture, sensor: Sensor, rng: Generator
) -> Image:
    light = cloth.light
    if skin is not None:
        _blend_over(light, skin.box, skin.light)
    boxes = part_boxes(now, view)
    if boxes:
        box = whole_box(boxes)
        _blend_over(light, box, nozzle_picture(now, view, boxes, _behind(box, skin, cloth)))
    return expose(light, sensor, view.fall(sensor), now.instant.gain, rng)


def _blend_over(light: NDArray[np.float32], box: ImageBox, layer: NDArray[np.float32]) -> None:
    below = light[box.y0 : box.y1, box.x0 : box.x1]
    layer = layer[: below.shape[0], : below.shape[1]]
    b, g, r, opacity = cv2.split(layer)
    np.multiply(below, cv2.merge([1 - opacity] * 3), out=below)
    np.add(below, cv2.merge([b, g, r]), out=below)


def _behind(box: ImageBox, skin: SurfacePicture | None, cloth: DrapePicture) -> NDArray[np.float32]:
    depth = upsample(cloth.depth[box.lattice(DRAPE_LATTICE_PX)], box.sample_size)
    if skin is None or skin.depth is None:
        return depth
    both = ImageBox(*np.maximum(box[:2], skin.box[:2]).tolist(), *np.minimum(box[2:], skin.box[2:]).tolist())
    if min(both.size) > 0:
        near = skin.depth[skin.box.samples(both)]
        np.copyto(depth[box.samples(both)], near, where=np.isfinite(near))
    return depth
