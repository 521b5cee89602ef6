"""Single rendered pictures of skin with or without a wound, each with its exact mask: for teaching and judging the
segmentation, and for pictures that may be shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import Camera, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.simulator.bodies import BODIES, Wound, body
from hardware.simulator.instant import Instant
from hardware.simulator.look import Look
from hardware.simulator.render import render
from hardware.simulator.scene.scene import Scene
from hardware.simulator.scene.shape import Shape
from hardware.simulator.sensor import Sensor
from perception.frames import Image

TEXEL = 0.15  # mm: what a camera 350 mm away resolves; half the time of the simulator's own
FINER = 4  # samples a pixel and axis of the true mask
SIZES = ((1280, 720), (640, 480), (768, 576))  # px


@dataclass(frozen=True, slots=True, eq=False)
class WoundView:
    """image: (H, W, 3) BGR. wound: (H, W) bool, all False where the skin is healthy. camera: that took it.
    base_from_surface: (4, 4) mm. area: of the wound on the surface, mm^2."""

    image: Image
    wound: NDArray[np.bool_]
    camera: Camera
    base_from_surface: Array
    area: float


def wound_view(seed: int, wounded: bool = True) -> WoundView:
    """The picture of a seed: body, wound, tone, wetness, drape, lamps and camera are drawn from it."""
    rng = np.random.default_rng([seed, 41])
    wound = Wound((rng.uniform(12, 60), rng.uniform(10, 40)), rng.uniform(0.5, 4.0)) if wounded else None
    shape = body(rng.choice(list(BODIES)), wound, seed)
    scene = Scene(shape, _look(rng), seed=seed)
    camera = _camera(rng)
    pose = REST @ se3.make(se3.exp_rotation(rng.normal(0, [0.15, 0.15, 1.5])), rng.normal(0, [12, 12, 6]))
    instant = Instant(0.0, 0.004, pose, np.zeros(6), gain=float(np.exp(rng.normal(0, 0.15))))
    sensor = Sensor(noise=rng.uniform(0.5, 4), blur=rng.uniform(0.3, 1.2))
    image = render(scene, [camera], [instant], sensor, [rng], threads=1)[0]
    outlines = [
        pixels_from_points(camera, se3.transform_points(pose, shape.points(each)))[0] for each in _outlines(shape)
    ]
    return WoundView(image, inside(outlines, camera.size), camera, pose, _area(shape))


def inside(outlines: Sequence[Array], size: tuple[int, int]) -> NDArray[np.bool_]:
    """(H, W) pixels that lie for the most part inside closed outlines (N, 2) px, in an image of `size` (W, H).

    Drawn finer and shrunk: OpenCV fills the outline's own pixels too, which would add half a pixel all round.
    """
    fine = np.zeros((size[1] * FINER, size[0] * FINER), np.uint8)
    for outline in outlines:
        cv2.fillPoly(fine, [np.round((outline + 0.5) * FINER - 0.5).astype(np.int32)], 255)
    return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA) > 127)


def _look(rng: np.random.Generator) -> Look:
    ambient, key, fill = rng.uniform(0.2, 0.5), rng.uniform(0.35, 0.8), rng.uniform(0.05, 0.4)
    tone, wetness, hair = rng.uniform(0, 0.9), rng.uniform(0.1, 1), rng.uniform(0, 1.2)
    drape = bool(rng.random() < 0.6)
    return Look(TEXEL, tone, wetness, hair, drape, ambient=ambient, key=key, fill=fill)


def _camera(rng: np.random.Generator) -> Camera:
    size = SIZES[rng.integers(len(SIZES))]
    focal = size[0] * rng.uniform(0.7, 1.1)
    return arc_rig((rng.uniform(0, 75),), rng.uniform(220, 480), focal, size).cameras[0]


def _outlines(shape: Shape) -> list[Array]:
    """Material points (N, 2) mm of the wound's outlines."""
    if shape.inside is None:
        return []
    found, _ = cv2.findContours((shape.inside > 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    middle = (np.array(shape.inside.shape[::-1]) - 1) / 2
    return [(nodes.reshape(-1, 2) - middle) * shape.step for nodes in found]


def _area(shape: Shape) -> float:
    """mm^2 of the plane the wound lies over; its bed's own relief is not added."""
    return 0.0 if shape.inside is None else float((shape.inside > 0).sum()) * shape.step**2
