"""Where rays meet a height field: z = Z(x, y), in nodes, one unknown height per ray."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from hardware.simulator.field import Field, Mask, field, gradient, looked_up

STEPS = 56  # of the search downwards through all heights
LOCAL_STEPS = 24  # of a search between near bounds
ROUNDS = 2  # of Newton's method
FLAT = 0.3  # rays that meet the surface more grazing than this (1: head on) are searched for one by one
CLOSE = 2e-3  # mm that is left over where Newton's method did not come to rest
REACH = 7  # rays round a grazing one that are searched too: it may hide the surface from them
WIDTH = 256  # rays


class Bundle(NamedTuple):
    """Rays as lines over the height: at height z mm they stand over node (u + z du, v + z dv). All of one shape."""

    u: Field
    v: Field
    du: Field
    dv: Field


class Relief(NamedTuple):
    """A height field (H, W) mm, its slopes a node along u and v, and the heights it keeps within, mm."""

    height: Field
    slopes: Field  # (H, W, 2)
    low: float
    high: float


def relief_of(height: Field) -> Relief:
    """A height field with its slopes."""
    return Relief(height, field(np.dstack(gradient(height, 1.0))), float(height.min()) - 0.1, float(height.max()) + 0.1)


def meet(relief: Relief, rays: Bundle, start: Field, odd: Mask, bounds: tuple[Field, Field]) -> Field:
    """Height z (H, W) mm where each ray first meets the field, which goes on beyond its edge as it is there.

    start: (H, W) mm, near it. odd: (H, W) which rays are searched alone, because the surface there grazes them or hides
    itself; so are those that turn out to graze it or do not come to rest. Newton's method ends within 1e-4 mm of it.
    bounds: (h, w) mm below and above which the search need not look, of squares of rays.
    """
    z, rest, facing = _newton(relief, rays, start)
    grazed = facing < FLAT
    if grazed.any():
        grazed = np.asarray(cv2.dilate(grazed.astype(np.uint8), np.ones((REACH, REACH), np.uint8)), bool)
    doubt = odd | grazed | ~(np.abs(rest) < CLOSE)
    if doubt.any():
        doubt &= near(relief, rays, start)
    place = np.nonzero(doubt)
    if len(place[0]):
        alone = Bundle(*(block(part[place]) for part in rays))
        times = z.shape[0] // bounds[0].shape[0]
        low, high = (block(b[place[0] // times, place[1] // times]) for b in bounds)
        searched, _ = search(relief, alone, low, high, LOCAL_STEPS)
        better, left, _ = _newton(relief, alone, searched)
        z[place] = np.where(np.abs(left) < 10 * CLOSE, better, searched).reshape(-1)[: len(place[0])]
    return z


def block(values: Field) -> Field:
    """Values (N,) as rows of WIDTH, the last one filled up: OpenCV looks up no more than 32767 rows."""
    rows = -(-len(values) // WIDTH)
    return field(np.pad(values, (0, rows * WIDTH - len(values)), mode="edge").reshape(rows, WIDTH))


def near(relief: Relief, rays: Bundle, z: Field, margin: float = 4.0) -> Mask:
    """Whether rays stand over the field, or within `margin` nodes of it, at height z."""
    rows, columns = relief.height.shape
    u, v = rays.u + z * rays.du, rays.v + z * rays.dv
    over: Mask = (u > -margin) & (u < columns + margin) & (v > -margin) & (v < rows + margin)
    return over


def _heights(relief: Relief, rays: Bundle, z: Field) -> Field:
    u, v = rays.u + z * rays.du, rays.v + z * rays.dv
    return looked_up(relief.height, u, v)


def _newton(relief: Relief, rays: Bundle, z: Field) -> tuple[Field, Field, Field]:
    """Heights nearer to the surface than z, what was left over before the last round, mm, and how much rays face it.

    The slope at the start serves all rounds.
    """
    u, v = rays.u + z * rays.du, rays.v + z * rays.dv
    slopes = looked_up(relief.slopes, u, v)
    facing = 1 - slopes[..., 0] * rays.du - slopes[..., 1] * rays.dv
    step = 1 / np.maximum(facing, 0.15)
    for _ in range(ROUNDS):
        z = field(z - (z - _heights(relief, rays, z)) * step)
    rest = z - _heights(relief, rays, z)
    return field(z - rest * step), rest, facing


def search(relief: Relief, rays: Bundle, low: Field, high: Field, steps: int) -> tuple[Field, Field]:
    """Heights where rays first meet the field, by steps from high to low, and how much it faces them (1: head on)."""
    step = (high - low) / np.float32(steps - 1)
    z, above = low, step
    facing = np.ones(z.shape, np.float32)
    open_way = np.ones(z.shape, bool)
    for k in range(steps):
        level = high - np.float32(k) * step
        left = level - _heights(relief, rays, level)
        new = (left <= 0) & open_way
        fall = np.maximum(above - left, 1e-6)
        z = field(np.where(new, level - step * left / fall, z))
        facing = field(np.where(new, fall / step, facing))
        open_way &= ~new
        if not open_way.any():
            break
        above = left
    return z, facing
