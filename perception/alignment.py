"""Patches found in images: each is shifted until its picture fits (inverse compositional Lucas-Kanade, Baker and
Matthews 2004, on pictures freed of brightness and contrast).

A track never creeps: it is compared with its reference picture, never with the frame before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from perception.frames import Image
from perception.patches import (
    FLAT,
    GRID_SIZE,
    SIDE,
    Float32,
    Projection,
    Pyramid,
    Templates,
    grid_offsets,
    look_up,
    normalise,
    on_level,
    sample,
)

MEAN = np.full(GRID_SIZE, 1 / GRID_SIZE, np.float32)
FAINT = 1e-6  # grey levels squared: no contrast at all
ARRIVED = 0.03  # samples: a last step; what is left after it is a tenth of that
LEAST_SIGMA = 0.05  # px
# Height of the surface over a patch's plane, px: seen from the side it shifts all that shows it, by the angle's
# tangent, and does so in every image, so no residual tells. Measured on simulated skin with a wound of 2.4 mm and on a
# roof's edge: 0.06 px seen squarely, 0.1 at 60 degrees, 0.2-0.3 at 70, 0.4-0.5 at 75; alignment alone claimed half.
RELIEF, SQUINT = 0.1, 0.1  # px; cosine beyond which nothing is visible anyway
UNSEEN = 0.3  # samples: the longest step taken without a look at where it leads
MOSTLY = 0.6  # of the tracks still under way
HURRIED = 4  # looks at the full image from a near start; a tenth of the tracks, the worst, would like more


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
    """Shift each template until it fits; all cameras at once, since short calls cost more than what they do.

    counts: how many of the rows belong to each of the images, one after the other. start: (N, 2) px as imaged, where to
    begin. least: the correlation below which a landmark is not found. coarse: begin on the half-size images, which
    reaches twice as far (5 px surely, 8 mostly) and costs as much again.
    """
    shift = np.zeros((len(templates), 2))  # in samples of the template
    ends = np.cumsum([0, *counts])
    if coarse:
        halves = _Sampler([i[1] for i in images], ends, where.per_sample, 2.0, half=True)
        pieces = templates.coarse_picture, templates.coarse_steepest, templates.coarse_inverse_hessian
        _descend(pieces, halves, where, start, shift, 2.0, 4)
    full = _Sampler([i[0] for i in images], ends, where.per_sample)
    pieces = templates.picture, templates.steepest, templates.inverse_hessian
    ended = _descend(pieces, full, where, start, shift, 1.0, 6 if coarse else HURRIED)
    return _judge(templates, where, start, shift, ended, least)


class _Sampler:
    """Grey levels on the templates' grids in several images; its arrays are megabytes, so they are made once."""

    def __init__(
        self,
        images: Sequence[Image],
        ends: NDArray[np.int64],
        per_sample: Array,
        spacing: float = 1.0,
        half: bool = False,
    ) -> None:
        self._images, self._ends, self._half = images, ends, half
        self._offsets = grid_offsets(per_sample, spacing, half)
        self._places = np.empty((2, len(per_sample), GRID_SIZE), np.float32)
        self._seen = np.empty((len(per_sample), GRID_SIZE), np.float32)

    def __call__(self, rows: NDArray[np.int64], centre: Array) -> Float32:
        """Grey levels (M, S) of some rows (M,), ascending, with their centres (M, 2) px; good until the next call."""
        whole, count = len(rows) == len(self._offsets), len(rows)
        offsets = self._offsets if whole else self._offsets[rows]
        ends = self._ends if whole else np.searchsorted(rows, self._ends)
        start = on_level(centre, self._half)
        x, y = (np.add(offsets[:, k], start[:, k : k + 1], out=self._places[k, :count]) for k in (0, 1))
        for image, first, last in zip(self._images, ends[:-1], ends[1:], strict=True):
            if last > first:
                self._seen[first:last] = look_up(image, x[first:last], y[first:last])
        return self._seen[:count]


@dataclass(frozen=True, slots=True, eq=False)
class _Ended:
    """How each descent ended: score (N,) and contrast (N,), grey levels, at the place looked at last, and rest (N,),
    samples, what it would still have moved."""

    score: Array
    contrast: Array
    rest: Array


def _descend(
    pieces: tuple[Float32, Float32, Array],
    grey_levels: _Sampler,
    where: Projection,
    start: Array,
    shift: Array,
    spacing: float,
    rounds: int,
) -> _Ended:
    """Gauss-Newton on the shifts (N, 2), in place, of those in view; who has arrived is left alone.

    The steepest descent pictures are free of brightness and contrast, so the images need not be.
    """
    picture, steepest, inverse = pieces
    score, contrast, rest = np.zeros((3, len(shift)))
    busy, everyone, all_in_view = np.nonzero(where.visible)[0], np.arange(len(shift)), bool(where.visible.all())
    for last in range(rounds - 1, -1, -1):
        if not len(busy):
            break
        if len(busy) > MOSTLY * len(shift) and all_in_view:  # to leave a few out costs more than another look at them
            busy = everyone
        some = slice(None) if len(busy) == len(shift) else busy
        per_sample = where.per_sample[some]
        seen = grey_levels(busy, start[some] + (per_sample @ shift[some, :, None])[..., 0])
        spread = np.sqrt(np.maximum(np.vecdot(seen, seen) / GRID_SIZE - (seen @ MEAN) ** 2, FAINT)).astype(float)
        contrast[some] = spread
        score[some] = np.vecdot(picture[some], seen) / (GRID_SIZE * spread)
        gradient = np.vecdot(steepest[some], seen[:, None]) / spread[:, None]
        step = -(inverse[some] @ gradient[..., None])[..., 0]
        length = np.sqrt((step * step).sum(1))
        if spacing == 1 and not last:
            step[length > UNSEEN] = 0.0
        shift[some] += step * (spacing * np.minimum(1.0, 3.0 / np.maximum(length, 1e-9)))[:, None]
        arrived = length < ARRIVED
        rest[some] = np.where(arrived, 0.0, length)
        busy = busy[~arrived]
    return _Ended(score, contrast, rest)


def coarse_score(templates: Templates, images: Pyramid, where: Projection, centre: Array) -> Array:
    """Correlation (N,) in [-1, 1] of each template with the half-size image at centres (N, 2) px, without alignment."""
    current, _ = normalise(sample(images[1], centre, where.per_sample, 2.0, half=True))
    return np.asarray((current * templates.coarse_picture).mean(1), float)


def _judge(
    templates: Templates, where: Projection, start: Array, shift: Array, ended: _Ended, least: float
) -> Alignment:
    moved = (where.per_sample @ shift[..., None])[..., 0]
    pixels = start + moved
    noise = 2 * (1 - np.clip(ended.score, -1, 1)) * 2.0  # variance per sample; neighbours share noise, hence the two
    per_pixel = where.per_sample @ templates.inverse_hessian @ np.swapaxes(where.per_sample, 1, 2)
    sidelong = np.clip(where.facing, SQUINT, 1.0)
    bent = RELIEF**2 * (1 / sidelong**2 - 1)  # the tangent's square
    white = np.maximum(noise * (per_pixel[:, 0, 0] + per_pixel[:, 1, 1]) / 2, LEAST_SIGMA**2)
    sigma = np.sqrt(white + ended.rest**2 + bent)
    reach = np.sqrt((moved * moved).sum(1))
    fits = (ended.score > least) & (ended.contrast > FLAT)
    found = where.visible & fits & (reach < 3 * SIDE) & np.isfinite(pixels).all(1)
    return Alignment(pixels, sigma, ended.score, found)
