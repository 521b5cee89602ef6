"""Things in front of a wound: bars like a nozzle, gloves, dressings, frames, and half planes that hide half of it."""

import cv2
import numpy as np
from numpy.typing import NDArray


def covered(
    picture: NDArray[np.uint8], wound: NDArray[np.uint8], texture: NDArray[np.uint8], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """One to three shapes drawn over the picture (H, W, 3); what they hide is no longer wound (H, W)."""
    picture, wound = picture.copy(), wound.copy()
    for _ in range(int(rng.integers(1, 4)) if rng.random() < 0.4 else 1):
        shape = _shape(wound, rng)
        edge = cv2.GaussianBlur(shape, (0, 0), rng.uniform(0.4, 1.2))
        opaque = edge[..., None].astype(np.float32) / 255
        picture = (picture + opaque * (_surface(picture.shape[0], texture, rng) - picture)).astype(np.uint8)
        wound[shape > 127] = 0
    return picture, wound


def _shape(wound: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W) 0/255: a bar, an ellipse, a polygon, or everything beyond a line through the wound."""
    side = wound.shape[0]
    drawn = np.zeros((side, side), np.uint8)
    rows, columns = np.nonzero(wound > 127)
    place = rng.uniform(0, side, 2)
    if len(rows) and rng.random() < 0.8:
        chosen = rng.integers(len(rows))
        place = np.array([columns[chosen], rows[chosen]], np.float64)
    angle = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    kind = rng.integers(4)
    if kind == 0:
        _fill(drawn, place + _rectangle(along, rng.uniform(0.3, 1.6) * side, rng.uniform(0.03, 0.2) * side, shift=True))
    elif kind == 1:
        axes = (int(rng.uniform(0.05, 0.3) * side), int(rng.uniform(0.05, 0.3) * side))
        cv2.ellipse(drawn, (int(place[0]), int(place[1])), axes, np.degrees(angle), 0, 360, 255, -1)
    elif kind == 2:
        turns = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 8))))
        radius = rng.uniform(0.06, 0.35, len(turns)) * side
        _fill(drawn, place + radius[:, None] * np.column_stack([np.cos(turns), np.sin(turns)]))
    else:
        depth = rng.uniform(0.1, 1.0) * side
        _fill(
            drawn, place + along[None] * depth / 2 + _rectangle(along, depth, rng.uniform(0.3, 2) * side, shift=False)
        )
    return drawn


def _rectangle(along: NDArray[np.float64], length: float, width: float, shift: bool) -> NDArray[np.float64]:
    """(4, 2) corners round the origin, or with one short side there."""
    across = np.array([-along[1], along[0]])
    ends = np.array([[0, -1], [1, -1], [1, 1], [0, 1]] if shift else [[-0.5, -1], [0.5, -1], [0.5, 1], [-0.5, 1]])
    return ends[:, :1] * length * along + ends[:, 1:] * width / 2 * across


def _fill(drawn: NDArray[np.uint8], corners: NDArray[np.float64]) -> None:
    cv2.fillPoly(drawn, [np.round(corners).astype(np.int32)], 255)


def _surface(side: int, texture: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.float32]:
    """(side, side, 3) what the thing looks like: one colour under a slope of light, or cut from another picture."""
    if rng.random() < 0.3 and min(texture.shape[:2]) > 32:
        length = int(rng.integers(24, min(texture.shape[:2])))
        top, left = (int(rng.integers(0, full - length + 1)) for full in texture.shape[:2])
        cut = texture[top : top + length, left : left + length]
        return cv2.resize(cut, (side, side), interpolation=cv2.INTER_LINEAR).astype(np.float32)
    grey = rng.uniform(0, 255)
    colour = np.full(3, grey) if rng.random() < 0.6 else rng.uniform(0, 255, 3)
    slope = np.linspace(-1, 1, side)[:, None] * rng.normal(0, 25) + np.linspace(-1, 1, side)[None] * rng.normal(0, 25)
    grain = rng.normal(0, rng.uniform(0, 8), (side, side))
    return np.clip(colour + (slope + grain)[..., None], 0, 255).astype(np.float32)
