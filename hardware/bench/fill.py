"""Filling regions: contours beside what other planners lay into them, random wounds, and the time it takes."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from hardware.bench.figures import Figure, at_least, at_most
from hardware.bench.fill_picture import picture
from hardware.bench.wounds import mapped, outline, random_wound
from hardware.process.clock import CpuClock, WallClock
from hardware.process.progress import Progress
from planning.fill.coverage import Coverage, coverage
from planning.fill.fill import fill
from planning.fill.pace import Pace, spent
from planning.fill.pattern import Kind, Pattern
from planning.fill.region import Region, region_of

TURNED = 0.7  # rad: by which each tenth wound is laid again, at no multiple of anything
THESIS = 3995.5, 3.0  # px2 and px: the largest contour of thesis 5.3, and its lines' spacing
PEERS = {  # what other planners reach at PEER_WIDTH and Pace(): covered %, s
    "blob": "contour-parallel by shapely 99.40 % in 48.3 s, PrusaSlicer concentric 98.82 % in 48.6 s",
    "crescent": "contour-parallel by shapely 97.32 % in 15.0 s, PrusaSlicer concentric 95.37 % in 15.4 s",
}
WANTED = {"blob": (99.4, 47.0), "crescent": (98.5, 15.0)}  # covered %, s


def run(options: argparse.Namespace) -> list[Figure]:
    """Figures of the contours, of the random wounds and of time."""
    regions = {path.stem: contour(path) for path in options.contours}
    if not regions:
        regions = {name: outline(name) for name in ("oval", "bow")}
    if options.picture is not None:
        options.picture.write_text(picture(), encoding="utf-8")
    figures = []
    for name, region in regions.items():
        figures += _of_contour(name, region, Pattern(options.kind, options.contour_width))
    if options.count:
        figures += _of_wounds(Pattern(options.kind, options.width), options.count, options.seed)
    return figures + _times(options.kind)


def contour(path: Path) -> Region:
    """The region inside a contour of a file with the columns x_mm,y_mm."""
    try:
        points = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 1), ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(path, "contour", str(error), "a file of lines x_mm,y_mm under a header") from error
    return region_of(points, path)


def _of_contour(name: str, region: Region, pattern: Pattern) -> list[Figure]:
    pace = Pace()
    beads = fill(region, pattern, pace)
    found, cost = coverage(beads, region), spent(beads, pace)
    wanted = WANTED.get(name)
    least, most = (at_least(wanted[0]), at_most(wanted[1])) if wanted else (None, None)
    laid = f"{cost.printed:.0f} mm printed, {cost.travelled:.0f} mm travelled, {cost.turns} turns, {len(beads)} beads"
    return [
        Figure(
            f"{name}: covered",
            100 * found.covered,
            "%",
            least,
            PEERS.get(name, ""),
        ),
        Figure(f"{name}: over", 100 * found.over, "%", at_most(0.05)),
        Figure(f"{name}: double", 100 * found.double, "%", at_most(3.0)),
        Figure(f"{name}: time", cost.seconds, "s", most, PEERS.get(name, ""), laid),
    ]


def _of_wounds(pattern: Pattern, count: int, seed: int) -> list[Figure]:
    found: list[Coverage] = []
    crashes, turned, worst = 0, 0.0, ""
    with Progress("random wounds", "wounds", WallClock().now) as progress:
        for i in range(count):
            kind, region = random_wound(np.random.default_rng([seed, i]))
            try:
                one = coverage(fill(region, pattern, Pace()), region)
                if i % 10 == 0:
                    turned = max(turned, abs(one.covered - _again(region, pattern).covered))
            except Exception:  # whatever it is, it is counted
                crashes += 1
                continue
            if not found or one.covered < min(f.covered for f in found):
                worst = f"worst: number {i}, {kind}"
            found.append(one)
            progress(i + 1, count)
    covered, double = (100 * np.array([getattr(f, name) for f in found]) for name in ("covered", "double"))
    note = f"{count} of seed {seed}, bead {pattern.width:g} mm"
    return [
        Figure("wounds: crashes", crashes, "", at_most(0), "", note),
        Figure("wounds: covered, least", float(covered.min()), "%", at_least(99.0), "none published", worst),
        Figure("wounds: covered, median", float(np.median(covered)), "%"),
        Figure("wounds: covered below 99 %", float(np.mean(covered < 99) * 100), "%", None, "", "share of the wounds"),
        Figure("wounds: double, most", float(double.max()), "%", at_most(5.0), "none published"),
        Figure("wounds: over, most", 100 * max(f.over for f in found), "%"),
        Figure("wounds: covered when turned, change", 100 * turned, "%", at_most(0.2), "", "each tenth, by 40 degrees"),
    ]


def _again(region: Region, pattern: Pattern) -> Coverage:
    c, s = np.cos(TURNED), np.sin(TURNED)
    turned = mapped(region, lambda points: points @ np.array([[c, s], [-s, c]]))
    return coverage(fill(turned, pattern, Pace()), turned)


def _times(kind: Kind) -> list[Figure]:
    area, spacing = THESIS
    wound = outline("oval")
    large = mapped(wound, lambda points: points * np.sqrt(area / wound.area))
    wide = outline("oval")
    low, high = np.array(wide.bounds).reshape(2, 2)
    wide = mapped(wide, lambda points: (points - low) * [60.0, 40.0] / (high - low))
    both = _median_ms(lambda: fill(large, Pattern("zigzag", spacing, angle="shorter"), Pace()), 200)
    whole = _median_ms(lambda: fill(wide, Pattern(kind, 0.4), Pace()), 5)
    return [
        Figure("two orientations of 4,000 px2", both, "ms", at_most(1.0), "thesis 3 ms", "median of 200, CPU"),
        Figure("layer of 60 x 40 mm, bead 0.4 mm", whole, "ms", at_most(130.0), "", "median of 5, CPU; 15 in 2 s"),
    ]


def _median_ms(work: Callable[[], object], count: int) -> float:
    clock, taken = CpuClock(), []
    for _ in range(count):
        begun = clock.now()
        work()
        taken.append(1e3 * (clock.now() - begun))
    return float(np.median(taken))
