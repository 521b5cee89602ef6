"""`python -m tests.campaigns growth`: what a pose and a path cost, as tracks, cameras, pixels and so on grow."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from estimation.se3 import Array
from estimation.synthetic.follow import follow_steps
from estimation.synthetic.world import arc_rig, synthetic_world
from hardware.bench.figures import Figure, milliseconds, with_progress
from hardware.bench.recordings import FRAME_RATE, WARM_UP_STEPS, rendered_recording, time_steps
from hardware.process.clock import CpuClock
from tests.campaigns.planner import carries

ANGLES_DEG = (0.0, 36.0, 84.0, -36.0, 60.0, -60.0)  # the thesis's three cameras, and three more on the same arc
PICTURE_SIZE, PICTURE_FOCAL = (1280, 720), 1100.0
GROWTH_RECORDING = "chest, breathing"
MOVED_PATHS = 50
WORLD_MINUTES = 0.25, 0.5, 1.0, 2.0  # of one world


@dataclass(frozen=True, slots=True)
class CostAxis:
    """One thing that grows."""

    name: str
    unit: str  # of its values
    what: str  # costs, and in what
    values: tuple[float, ...]
    cost: Callable[[float], tuple[float, float]]  # (median, 99 %), ms, of one value


def run_growth(options: argparse.Namespace) -> list[Figure]:
    """Costs along every axis, and how steeply they grow."""
    axes = [axis for axis in axes_for(options.seconds) if axis.name != "pixels" or not options.no_pictures]
    points = [(axis, value) for axis in axes for value in axis.values]
    costs: dict[str, list[tuple[float, float]]] = {axis.name: [] for axis in axes}
    for axis, value in with_progress("growth", "points", points, len(points)):
        costs[axis.name].append(axis.cost(value))
    return [figure for axis in axes for figure in growth_figures(axis, np.array(costs[axis.name]))]


def axes_for(seconds: float) -> tuple[CostAxis, ...]:
    """All that grows."""
    pose, path = "a pose from its tracks, processor time", "a path carried to a new pose, processor time"
    frames = "three decoded frames to the pose, by the clock"

    def tracked(count: int = 100, cameras: int = 3) -> tuple[float, float]:
        return _two(_spent(seconds, count, cameras)[WARM_UP_STEPS:])

    def moved(checkpoints: float) -> tuple[float, float]:
        return _two(carries(round(checkpoints), MOVED_PATHS)[0])

    def pictures(megapixels: float) -> tuple[float, float]:
        scale = (megapixels * 1e6 / (PICTURE_SIZE[0] * PICTURE_SIZE[1])) ** 0.5
        width, height = (8 * round(scale * n / 8) for n in PICTURE_SIZE)
        rig = arc_rig(size=(width, height), focal=scale * PICTURE_FOCAL)
        return _two(time_steps(rendered_recording(GROWTH_RECORDING, seconds, rig))[0][:, 0])

    def late(minutes: float) -> tuple[float, float]:
        end = round(60 * minutes * FRAME_RATE)
        return _two(_spent(60 * WORLD_MINUTES[-1])[end - round(seconds * FRAME_RATE) : end])

    return (
        CostAxis("tracks", "landmarks", pose, (25, 50, 100, 200, 400), lambda n: tracked(count=round(n))),
        CostAxis("cameras", "cameras", pose, (2, 3, 4, 6), lambda n: tracked(cameras=round(n))),
        CostAxis("minutes", "min behind", pose, WORLD_MINUTES, late),
        CostAxis("checkpoints", "checkpoints", path, (1e3, 1e4, 5e4, 2e5), moved),
        CostAxis("pixels", "Mpx a camera", frames, (0.23, 0.52, 0.92, 2.07), pictures),
    )


@lru_cache(maxsize=1)
def _spent(seconds: float, count: int = 100, cameras: int = 3) -> Array:
    """s of processor time of each step (N,) in a breathing world."""
    world = synthetic_world(seconds=seconds, rate=FRAME_RATE, count=count, rig=arc_rig(ANGLES_DEG[:cameras]))
    return np.array([step.seconds for step in follow_steps(world, "told", CpuClock().now)])


def _two(seconds: Array) -> tuple[float, float]:
    return milliseconds(seconds, 50), milliseconds(seconds, 99)


def growth_figures(axis: CostAxis, costs: Array) -> list[Figure]:
    """A figure for each value and the slope of the medians. costs: (N, 2) ms."""
    points = [
        Figure(f"{axis.name}: {value:g} {axis.unit}, median", half, "ms", note=f"99 %: {late:.2f} ms; {axis.what}")
        for value, (half, late) in zip(axis.values, costs.tolist(), strict=True)
    ]
    power, note = slope(axis.values, costs[:, 0]), "0: not at all; 1: in proportion"
    return [*points, Figure(f"{axis.name}: grows by the power", power, "", note=note)]


def slope(values: Sequence[float], costs: Array) -> float:
    """The exponent of the power law through costs (N,), by least squares over the logarithms."""
    usable = np.isfinite(costs) & (costs > 0)
    if usable.sum() < 2:
        return math.nan
    return float(np.polyfit(np.log(np.array(values)[usable]), np.log(costs[usable]), 1)[0])
