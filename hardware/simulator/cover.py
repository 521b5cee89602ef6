"""What comes between a camera and the wound: a textured cover, and glare."""

from __future__ import annotations

import cv2
import numpy as np

from estimation import se3
from estimation.rig import Camera, pixels_from_points
from estimation.se3 import Array
from hardware.process.faults import Fault, drawn
from perception.frames import Image

EXTENT = np.array([[x, y, 0.0] for x in (-26.0, 26.0) for y in (-19.0, 19.0)])  # mm, round a usual wound
ROOM = 1.35  # a cover that lies over all of the wound is larger than it by this


def covered(image: Image, box: tuple[Array, Array], aside: float, rng: np.random.Generator) -> Image:
    """A blotchy, skin-toned cover over a box (low, high px); aside: by which part of its width it is drawn away."""
    low, high = box
    angle = rng.uniform(0, 2 * np.pi)
    half = ROOM * (high - low) / 2
    away = np.array([np.cos(angle), np.sin(angle)]) * (half + (high - low) / 2) * min(aside, 1.0)
    middle = (low + high) / 2 + away * 1.45  # wholly beside the box at one, whatever the angle
    if aside >= 1.0:
        return image
    h, w = image.shape
    small = rng.normal(150, 28, (14, 18)).astype(np.float32)
    size = tuple(np.maximum(np.round(2 * half), 8).astype(int).tolist())
    cloth = cv2.resize(small, size, interpolation=cv2.INTER_CUBIC) + rng.normal(0, 6, size[::-1])
    corner = np.round(middle - half).astype(int)
    x0, y0 = np.clip(corner, 0, (w, h))
    x1, y1 = np.clip(corner + size, 0, (w, h))
    out = image.copy()
    if x1 > x0 and y1 > y0:
        part = cloth[y0 - corner[1] : y1 - corner[1], x0 - corner[0] : x1 - corner[0]]
        out[y0:y1, x0:x1] = np.clip(part, 0, 255).astype(np.uint8)
    return out


def laid_over(image: Image, camera: Camera, base_from_surface: Array, fault: Fault) -> Image:
    """An image (H, W, 3) of a camera with a cover over the wound; base_from_surface: (4, 4) mm then."""
    pixels, _ = pixels_from_points(camera, se3.transform_points(base_from_surface, EXTENT))
    box = pixels.min(0), pixels.max(0)
    return np.stack([covered(image[..., k], box, 0.0, drawn(fault)) for k in range(image.shape[2])], -1)


def glared(image: Image, box: tuple[Array, Array], share: float, rng: np.random.Generator) -> Image:
    """Soft saturated spots over about `share` of a box (low, high px)."""
    low, high = box
    light = np.zeros(image.shape, np.float32)
    for _ in range(3):
        centre = low + rng.uniform(0.1, 0.9, 2) * (high - low)
        radius = (high - low) * np.sqrt(share / 3 / np.pi) * rng.uniform(0.8, 1.2)
        cv2.ellipse(
            light,
            tuple(np.round(centre).astype(int).tolist()),
            tuple(np.round(radius).astype(int).tolist()),
            0,
            0,
            360,
            400.0,
            -1,
        )
    soft = cv2.GaussianBlur(light, (0, 0), 3.0)
    return np.asarray(np.clip(image + soft, 0, 255), np.uint8)
