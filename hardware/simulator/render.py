"""Pictures of a scene: what each camera's image is at each instant."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.rig import Camera
from hardware.simulator.cloth_picture import LATTICE, ClothPicture, cloth_picture
from hardware.simulator.instant import Instant
from hardware.simulator.scene.rays import SAMPLES, Box, View
from hardware.simulator.scene.render import nozzle_picture, part_boxes, whole_box
from hardware.simulator.scene.scene import Scene
from hardware.simulator.scene.surface_picture import SkinPicture, skin_picture
from hardware.simulator.sensor import Sensor, expose
from hardware.simulator.state import State, state
from perception.frames import Image


def render(
    scene: Scene,
    cameras: Sequence[Camera],
    instants: Sequence[Instant],
    sensor: Sensor,
    rngs: Sequence[np.random.Generator],
    threads: int = 2,
) -> list[Image]:
    """Images (H, W, 3) BGR, one per camera with its instant and its noise; the same for any number of threads."""
    shared: dict[int, State] = {}
    for instant in instants:
        if id(instant) not in shared:
            shared[id(instant)] = state(scene, instant)
    with ThreadPoolExecutor(threads) as pool:
        jobs = [(shared[id(i)], scene.view(c)) for c, i in zip(cameras, instants, strict=True)]
        skins = [pool.submit(skin_picture, s, v) for s, v in jobs]
        cloths = [pool.submit(cloth_picture, s, v) for s, v in jobs]
        images = [
            pool.submit(_finished, s, v, skin.result(), cloth.result(), sensor, rng)
            for (s, v), skin, cloth, rng in zip(jobs, skins, cloths, rngs, strict=True)
        ]
        return [image.result() for image in images]


class StillScene:
    """Pictures of a scene that stands still, with a nozzle before it that casts no shadow: a tenth of the work."""

    def __init__(self, scene: Scene, cameras: Sequence[Camera], still: Instant) -> None:
        """still: without a nozzle."""
        shared = state(scene, still)
        self._scene, self._shared = scene, shared
        self._views = [scene.view(camera) for camera in cameras]
        self._behind = [(skin_picture(shared, view), cloth_picture(shared, view)) for view in self._views]

    def __call__(self, camera: int, instant: Instant, sensor: Sensor, rng: np.random.Generator) -> Image:
        """The image (H, W, 3) BGR of a camera by its number."""
        skin, cloth = self._behind[camera]
        now, fresh = replace(self._shared, instant=instant), replace(cloth, light=cloth.light.copy())
        return _finished(now, self._views[camera], skin, fresh, sensor, rng)


def _finished(
    state: State, view: View, skin: SkinPicture | None, cloth: ClothPicture, sensor: Sensor, rng: np.random.Generator
) -> Image:
    light = cloth.light
    if skin is not None:
        _over(light, skin.box, skin.light)
    boxes = part_boxes(state, view)
    if boxes:
        box = whole_box(boxes)
        _over(light, box, nozzle_picture(state, view, boxes, _behind(box, skin, cloth)))
    return expose(light, sensor, view.fall(sensor), state.instant.gain, rng)


def _over(light: NDArray[np.float32], box: Box, layer: NDArray[np.float32]) -> None:
    """Lay a layer (H, W, 4) of a box, BGR times opacity and opacity, over the light."""
    below = light[box.y0 : box.y1, box.x0 : box.x1]
    layer = layer[: below.shape[0], : below.shape[1]]
    b, g, r, opacity = cv2.split(layer)
    through = 1 - opacity
    np.multiply(below, cv2.merge([through, through, through]), out=below)
    np.add(below, cv2.merge([b, g, r]), out=below)


def _behind(box: Box, skin: SkinPicture | None, cloth: ClothPicture) -> NDArray[np.float32]:
    """Depth (2H, 2W) mm of a box's samples."""
    part = cloth.depth[box.y0 // LATTICE : box.y1 // LATTICE, box.x0 // LATTICE : box.x1 // LATTICE]
    size = (box.size[1] * SAMPLES, box.size[0] * SAMPLES)
    depth = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_LINEAR), np.float32)
    if skin is None or skin.depth is None:
        return depth
    x0, y0, x1, y1 = (
        max(box.x0, skin.box.x0),
        max(box.y0, skin.box.y0),
        min(box.x1, skin.box.x1),
        min(box.y1, skin.box.y1),
    )
    if x1 <= x0 or y1 <= y0:
        return depth
    inner, near = (
        a[(y0 - b.y0) * SAMPLES : (y1 - b.y0) * SAMPLES, (x0 - b.x0) * SAMPLES : (x1 - b.x0) * SAMPLES]
        for a, b in ((depth, box), (skin.depth, skin.box))
    )
    np.copyto(inner, near, where=np.isfinite(near))
    return depth
