"""Patches found in images: each is shifted until its picture fits (inverse compositional Lucas-Kanade, Baker and
Matthews 2004, on pictures freed of brightness and contrast).

A track never creeps: it is compared with its reference picture, never with the frame before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimation.runtime import NEW
from estimation.se3 import Array
from perception.matching.alignment_kernels import SIDE, descend
from perception.matching.patches import FLAT, Projection, Pyramid, Templates, normalise, on_level, sample
from perception.side_by_side import side_by_side

LEAST_SIGMA = 0.05  # px
# Height of the surface over a patch's plane, px: seen from the side it shifts all that shows it, by the angle's
# tangent, and does so in every image, so no residual tells. Measured on simulated skin with a wound of 2.4 mm and on a
# roof's edge: 0.06 px seen squarely, 0.1 at 60 degrees, 0.2-0.3 at 70, 0.4-0.5 at 75; alignment alone claimed half.
RELIEF, SQUINT = 0.1, 0.1  # px; cosine beyond which nothing is visible anyway
COARSE_LOOKS, LOOKS = 4, 6  # at most, at the half-size image and at the full one; from near, three are the rule


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Where landmarks were found in one image: pixels (N, 2) as imaged, sigma (N,) px, score (N,) correlation in
    [-1, 1], found (N,)."""

    pixels: Array
    sigma: Array
    score: Array
    found: NDArray[np.bool_]


def align(
    templates: Templates,
    images: Pyramid,
    where: Projection,
    start: Array,
    least: float = 0.75,
    coarse: bool = True,
) -> Alignment:
    """Shift each template until it fits one image: `align_in` of one camera."""
    return align_in(templates, [images], [len(templates)], where, start, least, coarse)


def align_in(
    templates: Templates,
    images: Sequence[Pyramid],
    counts: Sequence[int],
    where: Projection,
    start: Array,
    least: float = 0.75,
    coarse: bool = True,
) -> Alignment:
    """Shift each template until it fits; the cameras side by side.

    counts: how many of the rows belong to each of the images, one after the other. start: (N, 2) px as imaged, where to
    begin. least: the correlation below which a landmark is not found. coarse: begin on the half-size images, which
    reaches twice as far (5 px surely, 8 mostly) and costs as much again.
    """
    begin, per_sample = np.require(start, float, NEW), np.require(where.per_sample, float, NEW)
    shift, ended = np.zeros((len(templates), 2)), np.zeros((len(templates), 3))  # shifts in samples of the template

    def in_one(images: Pyramid, mine: slice) -> None:
        t, steps, visible = templates, per_sample[mine], where.visible[mine]
        if coarse:
            picture, steepest, inverse = t.coarse_picture[mine], t.coarse_steepest[mine], t.coarse_inverse_hessian[mine]
            at = on_level(begin[mine], True)
            descend(images[1], at, steps, visible, picture, steepest, inverse, shift[mine], 0.5, 2.0, COARSE_LOOKS)
        picture, steepest, inverse = t.picture[mine], t.steepest[mine], t.inverse_hessian[mine]
        at = begin[mine]
        ended[mine] = descend(images[0], at, steps, visible, picture, steepest, inverse, shift[mine], 1.0, 1.0, LOOKS)

    ends = np.cumsum([0, *counts])
    parts = [slice(first, last) for first, last in pairwise(ends.tolist())]
    if len(parts) > 1:
        side_by_side(in_one, images, parts)
    else:
        in_one(images[0], parts[0])
    return _judge(templates, where, start, shift, ended, least)


def coarse_score(templates: Templates, images: Pyramid, where: Projection, centre: Array) -> Array:
    """Correlation (N,) in [-1, 1] of each template with the half-size image at centres (N, 2) px, without alignment."""
    current, _ = normalise(sample(images[1], centre, where.per_sample, 2.0, half=True))
    return np.asarray((current * templates.coarse_picture).mean(1), float)


def _judge(
    templates: Templates, where: Projection, start: Array, shift: Array, ended: Array, least: float
) -> Alignment:
    """ended: (N, 3), as `descend` says."""
    moved = (where.per_sample @ shift[..., None])[..., 0]
    pixels = start + moved
    score, contrast, rest = ended.T
    noise = 2 * (1 - np.clip(score, -1, 1)) * 2.0  # variance per sample; neighbours share noise, hence the two
    per_pixel = where.per_sample @ templates.inverse_hessian @ np.swapaxes(where.per_sample, 1, 2)
    sidelong = np.clip(where.facing, SQUINT, 1.0)
    bent = RELIEF**2 * (1 / sidelong**2 - 1)  # the tangent's square
    white = np.maximum(noise * (per_pixel[:, 0, 0] + per_pixel[:, 1, 1]) / 2, LEAST_SIGMA**2)
    sigma = np.sqrt(white + rest**2 + bent)
    reach = np.sqrt((moved * moved).sum(1))
    fits = (score > least) & (contrast > FLAT)
    found = where.visible & fits & (reach < 3 * SIDE) & np.isfinite(pixels).all(1)
    return Alignment(pixels, sigma, score, found)
