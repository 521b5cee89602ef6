"""Patterns side by side as one SVG: beads as wide as they are laid, their middle lines, and travels between them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from estimation.se3 import Array
from hardware.bench.wounds import outline
from planning.fill.bead import Bead
from planning.fill.coverage import coverage
from planning.fill.fill import fill
from planning.fill.pace import Pace, spent
from planning.fill.pattern import KINDS, Pattern

SCALE, MARGIN, CAPTION = 9.0, 12.0, 34.0  # px a mm; px around each drawing; px for two lines under it
COLUMNS = 3
WIDTH = 0.8  # mm, of the beads drawn
COARSE = 0.05  # mm: steps in which widths are drawn


def picture() -> str:
    """An SVG of all patterns in one outline with a hole."""
    region = outline("oval").difference(outline("oval").buffer(-10.5))
    left, low, right, high = region.bounds
    wide, tall = SCALE * (right - left) + 2 * MARGIN, SCALE * (high - low) + 2 * MARGIN + CAPTION
    parts = []
    for i, kind in enumerate(KINDS):
        beads = fill(region, Pattern(kind, WIDTH), Pace())
        found, cost = coverage(beads, region), spent(beads, Pace())
        x, y = wide * (i % COLUMNS), tall * (i // COLUMNS)
        told = f"{100 * found.covered:.1f} % covered, {100 * found.double:.1f} % twice, {cost.seconds:.1f} s"
        parts.append(
            f'<g transform="translate({x + MARGIN:.0f} {y + MARGIN:.0f})">{_drawn(beads, left, high)}'
            f'<text y="{tall - CAPTION:.0f}" font-weight="bold">{kind}</text>'
            f'<text y="{tall - CAPTION + 15:.0f}">{told}</text></g>'
        )
    rows = -(-len(KINDS) // COLUMNS)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {COLUMNS * wide:.0f} {rows * tall:.0f}" '
        'font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="#fff"/>'
        + "".join(parts)
        + "</svg>\n"
    )


def _drawn(beads: Sequence[Bead], left: float, high: float) -> str:
    def path(points: Array) -> str:
        x, y = SCALE * (points[:, 0] - left), SCALE * (high - points[:, 1])
        return "M" + " ".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))

    laid = "".join(
        f'<path d="{path(points)}" stroke-width="{SCALE * width:.1f}"/>'
        for bead in beads
        for points, width in _even(bead)
    )
    middles = "".join(f'<path d="{path(bead.points)}"/>' for bead in beads)
    hops = "".join(f'<path d="{path(np.stack([a.points[-1], b.points[0]]))}"/>' for a, b in pairwise(beads))
    return (
        f'<g fill="none" stroke-linecap="round" stroke-linejoin="round"><g stroke="#e9a5a5">{laid}</g>'
        f'<g stroke="#7a1f2b" stroke-width="1">{middles}</g>'
        f'<g stroke="#2457a6" stroke-width="1" stroke-dasharray="3 3">{hops}</g></g>'
    )


def _even(bead: Bead) -> list[tuple[Array, float]]:
    """A bead as stretches (N, 2) of about one width each, mm."""
    width = np.round((bead.width[1:] + bead.width[:-1]) / 2 / COARSE) * COARSE
    ends = [0, *(np.flatnonzero(np.diff(width)) + 1).tolist(), len(width)]
    return [(bead.points[a : b + 1], float(width[a])) for a, b in pairwise(ends)]
