"""Depressions in heights: discs that lie under the quadric through the ring around them, at every place and scale.

A quadric is what skin is like over some centimetres, whatever limb it is on, so the roundness of a body is no
depression. The fits at all places are sums over discs and rings, which are convolutions of the heights' moments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.signal import fftconvolve

from estimation.se3 import Array
from planning.layers.grid import Grid, Mask, interpolate

DISC_RADII = (4.0, 6.0, 9.0, 13.0, 18.0, 25.0, 34.0)  # mm
RING_GAP, RING_SCALE, RING_WIDTH = 1.5, 1.5, 6.0  # mm outside the disc, to so many radii and mm more
COARSE_STEP = 1.5  # mm between nodes where they are looked for
MIN_RING_SHARE, MIN_DISC_SHARE = 0.6, 0.5  # of the ring and of the disc that must have been scanned
MIN_UNEVENNESS = 0.15  # mm, of the ring about its quadric: a smoother one is no surer
MAX_CONDITION = 1e9  # of a fit


@dataclass(frozen=True, slots=True)
class Depression:
    """A disc that lies under the skin around it, in the plane of the heights."""

    middle: tuple[float, float, float]  # mm, on the quadric
    slope: tuple[float, float]  # of the quadric there
    radius: float  # mm
    depth: float  # mm, mean of the disc under the quadric, along its normal
    clarity: float  # depth over the unevenness of the ring


def depressions(grid: Grid, heights: Array, known: Mask, most: int) -> Sequence[Depression]:
    """The clearest depressions of heights (H, W) where `known` (H, W), none in another's disc, the clearest first."""
    coarse = grid.coarser(max(COARSE_STEP, grid.step))
    nodes = coarse.nodes.reshape(-1, 2)
    values = interpolate(grid, heights, nodes).reshape(coarse.shape)
    valid = interpolate(grid, known.astype(float), nodes).reshape(coarse.shape) > 0.99
    if not valid.any():
        return []
    level = float(values[valid].mean())  # sums of squares keep their digits
    values = np.where(valid, values - level, 0.0)
    found = [each for radius in DISC_RADII for each in _at_scale(coarse, values, valid, radius, level)]
    chosen = list[Depression]()
    for each in sorted(found, key=lambda d: -d.clarity * np.sqrt(d.radius)):
        apart = [np.hypot(each.middle[0] - c.middle[0], each.middle[1] - c.middle[1]) for c in chosen]
        if all(far > max(c.radius, 0.7 * each.radius) for far, c in zip(apart, chosen, strict=True)):
            chosen.append(each)
        if len(chosen) == most:
            break
    return chosen


def _at_scale(grid: Grid, values: Array, valid: Mask, radius: float, level: float) -> Sequence[Depression]:
    """The local best discs of one radius (mm)."""
    reach = RING_SCALE * radius + RING_WIDTH
    half = int(np.ceil(reach / grid.step))
    if 2 * half + 1 > 2 * max(grid.shape):
        return []
    x, y = np.meshgrid(*[np.arange(-half, half + 1) * grid.step / reach] * 2)
    far = np.hypot(x, y) * reach
    ring, disc = ((far >= radius + RING_GAP) & (far <= reach)).astype(float), (far <= radius).astype(float)
    terms = [np.ones_like(x), x, y, x * x, x * y, y * y]
    there = valid.astype(float)
    around = [fftconvolve(there, _mirrored(ring), "same"), fftconvolve(there, _mirrored(disc), "same")]
    enough = (around[0] > MIN_RING_SHARE * ring.sum()) & (around[1] > MIN_DISC_SHARE * disc.sum())
    rows, columns = np.nonzero(enough)
    if not len(rows):
        return []

    def sums(field: Array, weight: Array) -> Array:
        return np.asarray(fftconvolve(field, _mirrored(weight), "same"))[rows, columns]

    normal = np.empty((len(rows), 6, 6))
    for i in range(6):
        for j in range(i, 6):
            normal[:, i, j] = normal[:, j, i] = sums(there, ring * terms[i] * terms[j])
    right = np.stack([sums(values, ring * term) for term in terms], axis=1)
    fit = np.linalg.solve(normal + 1e-9 * np.eye(6), right[..., None])[..., 0]
    spread = np.sqrt(np.maximum(sums(values**2, ring) - np.einsum("ni,ni->n", fit, right), 0) / normal[:, 0, 0])
    inside = np.stack([sums(there, disc * term) for term in terms], axis=1)
    slope = fit[:, 1:3] / reach
    cosine = 1 / np.sqrt(1 + (slope**2).sum(axis=1))
    depth = (np.einsum("ni,ni->n", fit, inside) - sums(values, disc)) / inside[:, 0] * cosine
    clarity = np.full(grid.shape, -np.inf)
    clarity[rows, columns] = depth / (spread * cosine + MIN_UNEVENNESS)
    size = 2 * max(1, round(radius / 2 / grid.step)) + 1
    best = (clarity == maximum_filter(clarity, size=size)) & (clarity > 0)
    return [
        Depression(
            (float(grid.x[columns[k]]), float(grid.y[rows[k]]), float(fit[k, 0] + level)),
            (float(slope[k, 0]), float(slope[k, 1])), radius, float(depth[k]), float(clarity[rows[k], columns[k]]),
        )
        for k in np.flatnonzero(best[rows, columns])
    ]  # fmt: skip


def _mirrored(weight: Array) -> Array:
    """The kernel whose convolution is the correlation with `weight`."""
    return np.asarray(weight[::-1, ::-1])
