"""`stillbed bench growth`: what a pose and a path cost, as tracks, cameras, pixels, checkpoints and minutes grow."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from estimation.se3 import Array
from estimation.synthetic.arc_rig import arc_rig
from estimation.synthetic.follow import steps
from estimation.synthetic.world import synthetic_world
from hardware.bench.figures import Figure
from hardware.bench.latency import timed
from hardware.bench.planner import carries
from hardware.bench.thesis_scenes import made
from hardware.page import document, legend, line_key, section
from hardware.process.clock import CpuClock, WallClock
from hardware.process.progress import Progress
from hardware.report.page import Plot, spanning

WARM = 10  # steps that fill the window and the caches
ANGLES_DEG = (0.0, 36.0, 84.0, -36.0, 60.0, -60.0)  # the thesis's three cameras, and three more on the same arc
SIZE, FOCAL = (1280, 720), 1100.0
SCENE = "chest, breathing"
CARRIES = 50
RATE = 30.0  # Hz
MINUTES = 0.25, 0.5, 1.0, 2.0  # of one world


@dataclass(frozen=True, slots=True)
class Axis:
    """One thing that grows. unit: of its values. what: costs, and in what. cost: (median, 99 %), ms, of one value."""

    name: str
    unit: str
    what: str
    values: tuple[float, ...]
    cost: Callable[[float], tuple[float, float]]


def run(options: argparse.Namespace) -> list[Figure]:
    """Costs along every axis, and how steeply they grow."""
    axes = [axis for axis in axes_for(options.seconds) if axis.name != "pixels" or not options.no_pictures]
    measured = []
    with Progress("growth", "points", WallClock().now) as progress:
        done, total = 0, sum(len(axis.values) for axis in axes)
        for axis in axes:
            costs = []
            for value in axis.values:
                costs.append(axis.cost(value))
                done += 1
                progress(done, total)
            measured.append((axis, np.array(costs)))
    if options.out is not None:
        drawn: Path = options.out / "growth.html"
        drawn.write_text(page(measured), encoding="utf-8")
        print(f"the curves: {drawn}\n")
    return [figure for axis, costs in measured for figure in figures(axis, costs)]


def axes_for(seconds: float) -> tuple[Axis, ...]:
    """All that grows."""
    pose, path = "a pose from its tracks, processor time", "a path carried to a new pose, processor time"
    return (
        Axis("tracks", "landmarks", pose, (25, 50, 100, 200, 400), lambda n: _estimator(seconds, count=round(n))),
        Axis("cameras", "cameras", pose, (2, 3, 4, 6), lambda n: _estimator(seconds, cameras=round(n))),
        Axis("minutes", "min behind", pose, MINUTES, lambda n: _behind(n, seconds)),
        Axis("checkpoints", "checkpoints", path, (1e3, 1e4, 5e4, 2e5), _carried),
        Axis("pixels", "Mpx a camera", "three decoded frames to the pose, by the clock", (0.23, 0.52, 0.92, 2.07),
             lambda n: _pictures(n, seconds)),
    )  # fmt: skip


def _estimator(seconds: float, count: int = 100, cameras: int = 3) -> tuple[float, float]:
    """ms a step in a breathing world."""
    return _two(_spent(seconds, count, cameras)[WARM:])


def _behind(minutes: float, last: float) -> tuple[float, float]:
    """ms a step in the `last` s before so many minutes of a breathing world have passed."""
    end = round(60 * minutes * RATE)
    return _two(_spent(60 * MINUTES[-1])[end - round(last * RATE) : end])


@lru_cache(maxsize=1)
def _spent(seconds: float, count: int = 100, cameras: int = 3) -> Array:
    """s of processor time of each step (N,) in a breathing world."""
    world = synthetic_world(seconds=seconds, rate=RATE, count=count, rig=arc_rig(ANGLES_DEG[:cameras]))
    return np.array([step.seconds for step in steps(world, "told", CpuClock().now)])


def _carried(checkpoints: float) -> tuple[float, float]:
    return _two(carries(round(checkpoints), CARRIES)[0])


def _pictures(megapixels: float, seconds: float) -> tuple[float, float]:
    scale = (megapixels * 1e6 / (SIZE[0] * SIZE[1])) ** 0.5
    size = (8 * round(scale * SIZE[0] / 8), 8 * round(scale * SIZE[1] / 8))
    wall, _ = timed(made(SCENE, seconds, arc_rig(size=size, focal=scale * FOCAL)))
    return _two(wall[:, 0]) if len(wall) else (float("nan"), float("nan"))


def _two(seconds: Array) -> tuple[float, float]:
    half, late = 1000 * np.percentile(seconds, [50, 99])
    return float(half), float(late)


def figures(axis: Axis, costs: Array) -> list[Figure]:
    """A figure for each value and the slope of the medians. costs: (N, 2) ms."""
    found = [
        Figure(
            f"{axis.name}: {value:g} {axis.unit}, median", float(half), "ms", note=f"99 %: {late:.2f} ms; {axis.what}"
        )
        for value, (half, late) in zip(axis.values, costs, strict=True)
    ]
    return [
        *found,
        Figure(
            f"{axis.name}: grows by the power",
            slope(axis.values, costs[:, 0]),
            "",
            note="0: not at all; 1: in proportion",
        ),
    ]


def slope(values: Sequence[float], costs: Array) -> float:
    """The exponent of the power law through costs (N,), by least squares over the logarithms."""
    usable = np.isfinite(costs) & (costs > 0)
    if usable.sum() < 2:
        return float("nan")
    return float(np.polyfit(np.log(np.array(values)[usable]), np.log(costs[usable]), 1)[0])


def page(measured: Sequence[tuple[Axis, Array]]) -> str:
    """All curves on one page."""
    keys = legend([line_key("estimate", "median"), line_key("truth", "99 %")])
    parts = [
        section(axis.name.capitalize(), f"{axis.what}, ms, over {axis.unit}.", _plot(axis, costs) + keys)
        for axis, costs in measured
    ]
    lead = "Each curve is one thing that grows while all else stays what it usually is."
    return document("Bench", "How cost grows", lead, parts, "Made by stillbed bench growth.")


def _plot(axis: Axis, costs: Array) -> str:
    x = np.array(axis.values, float)
    plot = Plot(1000, 220, spanning([x]), (0.0, 1.1 * float(np.nanmax(costs))), label=f"ms over {axis.unit}")
    for column, style in ((1, "truth"), (0, "estimate")):
        plot.line(x, costs[:, column], style)
        plot.dots(x, costs[:, column], style, 3)
    return plot.svg()
