"""The closed loop at the nozzle, with and without prediction: the same prints by what is known of the surface's future.

Each print is one of a scenario in virtual time: exposure, way, pairing, the estimator on tracks, the motion of a live
run and the virtual arm, whose nozzle is compared with its true checkpoint every millisecond. What differs is only what
the motion is told of the surface: where it was at the first pose (a bed that stands still), where it was last seen,
that and its velocity, or the pose as it is. The first three claim to know it exactly: nothing but what they ask of the
arm keeps them from printing.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from estimation.errors import InputError
from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.bench.fault_run import FaultRun, Stage, stage
from hardware.bench.figures import Figure, at_least, at_most
from hardware.bench.workers import workers
from hardware.page import document, legend, line_key, section
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.report.page import Plot
from perception.frames import FrameSet
from perception.package_data import shipped_file

WIDTH, HEIGHT = 900, 150  # px
LEAST = 0.01  # mm, where the logarithmic axis begins
P95, LARGEST, DUTY = 0.5, 1.0, 0.8  # mm, mm, part of the time: asked of a live run

Told = Callable[[SurfacePose], SurfacePose]  # what the motion is told in the place of a pose


@dataclass(frozen=True, slots=True, eq=False)
class Print:
    """One print. stamps: (N,) s. error: (N,) mm at the nozzle, NaN where nothing leaves it."""

    stamps: Array
    error: Array

    @property
    def p95(self) -> float:
        """mm, while extruding."""
        return float(np.nanpercentile(self.error, 95)) if np.isfinite(self.error).any() else float("nan")

    @property
    def largest(self) -> float:
        """mm, while extruding."""
        return float(np.nanmax(self.error)) if np.isfinite(self.error).any() else float("nan")

    @property
    def duty(self) -> float:
        """Part of the time from the first material to the last in which it flows."""
        flows = np.flatnonzero(np.isfinite(self.error))
        return len(flows) / (flows[-1] - flows[0] + 1) if len(flows) else 0.0


class StillBed:
    """The surface is said to be where it was first seen, for ever."""

    def __init__(self) -> None:
        self._first: SurfacePose | None = None

    def __call__(self, pose: SurfacePose) -> SurfacePose:
        """The first measured pose, under every stamp."""
        if self._first is None and pose.state.measured:
            self._first = pose
        where = pose if self._first is None else self._first
        return replace(last_seen(pose), base_from_surface=where.base_from_surface)


def last_seen(pose: SurfacePose) -> SurfacePose:
    """The surface is said to stay where it was seen."""
    return replace(steady(pose), twist=np.zeros(6))


def steady(pose: SurfacePose) -> SurfacePose:
    """The surface is said to keep its velocity."""
    nothing = np.zeros((6, 6))
    return replace(pose, covariance=nothing, twist_covariance=nothing, acceleration_psd=np.zeros(6), forecast=None)


def as_it_is(pose: SurfacePose) -> SurfacePose:
    """What the estimator says, forecast and claim included."""
    return pose


WAYS: dict[str, Callable[[], Told]] = {
    "a bed that stands still": StillBed,
    "where it was last seen": lambda: last_seen,
    "constant velocity": lambda: steady,
    "forecast": lambda: as_it_is,
}
OURS = "forecast"


class LoopRun(FaultRun):
    """A print in which nothing goes wrong, and the motion is told something else than the pose."""

    def __init__(self, on: Stage, told: Told, seed: int) -> None:
        super().__init__(on, (), seed)
        self._told = told

    def _know(self, pose: SurfacePose, frames: FrameSet, seen: object) -> None:
        super()._know(self._told(pose), frames, seen)


def run(options: argparse.Namespace) -> list[Figure]:
    """Print every scenario in every way; with an output folder, the errors over time as a page."""
    if options.seed < 0:
        raise InputError("command line", "--seed", options.seed, ">= 0")
    if options.jobs < 1:
        raise InputError("command line", "--jobs", options.jobs, ">= 1")
    asked, done = [(name, way) for name in options.scenario for way in WAYS], list[Print]()
    with Progress("loop", "prints", WallClock().now) as progress, workers(options.jobs) as pool:
        for one in pool.map(partial(_one_print, options.seed), *zip(*asked, strict=True)):
            done.append(one)
            progress(len(done), len(asked))
    prints = dict(zip(asked, done, strict=True))
    if options.out is not None:
        page = options.out / "loop.html"
        page.write_text(loop_page(prints), encoding="utf-8")
        print(f"picture: {page}\n")
    return [figure for name in options.scenario for figure in _figures(name, prints)]


def _one_print(seed: int, scenario: str, way: str) -> Print:
    return printed(stage(shipped_file("scenarios", f"{scenario}.toml")), WAYS[way](), seed)


def printed(on: Stage, told: Told, seed: int) -> Print:
    """One print and its errors."""
    log = LoopRun(on, told, seed)().log
    assert log is not None
    error = np.linalg.norm((log.base_from_nozzle - log.base_from_target)[:, :3, 3], axis=1)
    return Print(log.stamps, np.where(log.extrude, error, np.nan))


def _figures(scenario: str, prints: dict[tuple[str, str], Print]) -> list[Figure]:
    ours = prints[scenario, OURS]
    others = ", ".join(
        f"{way} {one.p95:.2f}" for (name, way), one in prints.items() if name == scenario and way != OURS
    )
    return [
        Figure(f"{scenario}: error at the nozzle, 95 %", ours.p95, "mm", at_most(P95), others, "while extruding"),
        Figure(f"{scenario}: largest error", ours.largest, "mm", at_most(LARGEST)),
        Figure(f"{scenario}: duty", ours.duty, "", at_least(DUTY), "", "the arm holds where the forecast is not sure"),
    ]


def loop_page(prints: dict[tuple[str, str], Print]) -> str:
    """The error at the nozzle over time, a plot for each way, one scale for all of a scenario."""
    body = [_one(name, prints) for name in dict.fromkeys(name for name, _ in prints)]
    lead = "The same print, by what the motion is told of where the surface will be."
    return document(
        "bench", "closed loop", lead, body, "Virtual time, the virtual arm; the true error, every millisecond."
    )


def _one(scenario: str, prints: dict[tuple[str, str], Print]) -> str:
    ways = {way: one for (name, way), one in prints.items() if name == scenario}
    top = 1.3 * max(LARGEST, *(one.largest for one in ways.values() if np.isfinite(one.error).any()))
    span = 0.0, max(float(one.stamps[-1]) for one in ways.values())
    plots: Sequence[str] = [_plot(way, one, span, top) for way, one in ways.items()]
    keys = legend([line_key("estimate", "error while extruding, mm"), line_key("limit", f"{LARGEST:g} mm")])
    return section(scenario, "Over time, s; a gap: nothing leaves the nozzle.", keys + "".join(plots))


def _plot(way: str, one: Print, span: tuple[float, float], top: float) -> str:
    plot = Plot(
        WIDTH, HEIGHT, span, (LEAST, top), log_y=True, label=f"{way}: 95 % {one.p95:.2f}, at most {one.largest:.2f} mm"
    )
    plot.level(LARGEST, "", "limit")
    plot.line(one.stamps, np.maximum(one.error, LEAST), "estimate")
    return plot.svg()
