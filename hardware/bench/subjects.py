"""What can be measured: one module each, imported when it is asked for."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module

from hardware.bench.figure import Figure


@dataclass(frozen=True, slots=True)
class Subject:
    """One thing to measure.

    module: has `add_options(parser)`, which adds its own options, and `run(options) -> list[Figure]`.
    summary: a line for the list of subjects.
    """

    module: str
    summary: str

    @property
    def add_options(self) -> Callable[[argparse.ArgumentParser], None]:
        """The module's `add_options`."""
        found: Callable[[argparse.ArgumentParser], None] = import_module(self.module).add_options
        return found

    @property
    def run(self) -> Callable[[argparse.Namespace], list[Figure]]:
        """The module's `run`."""
        found: Callable[[argparse.Namespace], list[Figure]] = import_module(self.module).run
        return found


Subjects = Mapping[str, Subject]

SUBJECTS: Subjects = {
    "arm-calibration": Subject(
        "hardware.bench.arm_calibration", "the arm's place, tool and latency from what cameras see of its tip"
    ),
    "bumps": Subject("hardware.bench.bumps", "cameras knocked and lenses turned by little: found, named, false alarms"),
    "calibration": Subject(
        "hardware.bench.calibration", "cameras calibrated from rendered boards, beside the exact rig"
    ),
    "cameras": Subject("hardware.bench.cameras", "frames of live cameras put into sets: complete, wrong, waited for"),
    "consistency": Subject("hardware.bench.consistency", "poses from pictures: are errors as large as is claimed?"),
    "estimator": Subject("hardware.bench.estimator", "the estimator on synthetic tracks: accuracy, honesty, time"),
    "faults": Subject("hardware.bench.faults", "prints in which everything goes wrong: said, harmless, back soon?"),
    "fill": Subject("hardware.bench.fill", "beads laid into contours and random wounds: coverage and time"),
    "fuzz": Subject("hardware.bench.fuzz", "every reader of what comes from outside, given what is nearly valid"),
    "growth": Subject("hardware.bench.growth", "how cost grows: with tracks, cameras, pixels, checkpoints, minutes"),
    "latency": Subject("hardware.bench.latency", "from three decoded frames to the pose, by wall clock and processor"),
    "link": Subject("hardware.bench.link", "the arm's line with everything going wrong; stops, jitter, the guard"),
    "live": Subject("hardware.bench.live", "whole runs in real time: frames to wire, stops, nozzle, kills"),
    "loop": Subject("hardware.bench.loop", "the closed loop at the nozzle, with and without prediction"),
    "map": Subject("hardware.bench.mapping", "landmarks off the true surface beside their claim, and the map's growth"),
    "outages": Subject("hardware.bench.outages", "cameras covered, dead, frozen, swapped, bumped: lost in silence?"),
    "plan": Subject("hardware.bench.plan", "a whole plan of a large wound: time, memory, coverage, ink"),
    "registration": Subject("hardware.bench.registration", "a scan laid into the first pictures: error and verdict"),
    "prediction": Subject("hardware.bench.prediction", "where a breathing chest will be, 100 to 500 ms ahead"),
    "planner": Subject("hardware.bench.planner", "random poses into planner and guard: limits kept, cost of a step"),
    "segmentation": Subject(
        "hardware.bench.segmentation", "finding the wound: Dice, silence, a half covered one, time"
    ),
    "smoothing": Subject("hardware.bench.smoothing", "smoothed poses beside causal ones, clocks, time by length"),
    "steps": Subject("hardware.bench.steps", "movements of 300 um and 0.1 degree: how soon flagged, how often falsely"),
    "tracks": Subject("hardware.bench.tracks", "scatter and creep of tracks before a surface that stands still"),
    "views": Subject("hardware.bench.views", "skin that deforms, grazing views with glare, a cube's edges"),
    "thesis": Subject("hardware.bench.thesis", "the thesis's estimator beside ours, on the same frame sets"),
}
