"""What can be measured: one module each, imported when it is to run."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module

from hardware.bench import options
from hardware.bench.figures import Figure


@dataclass(frozen=True, slots=True)
class Subject:
    """One thing to measure.

    module: has `run(options) -> list[Figure]`. add_options: adds the subject's own options to a parser. summary: a line
    for the list of subjects.
    """

    module: str
    add_options: Callable[[argparse.ArgumentParser], None]
    summary: str

    @property
    def run(self) -> Callable[[argparse.Namespace], list[Figure]]:
        """The module's `run`."""
        found: Callable[[argparse.Namespace], list[Figure]] = import_module(self.module).run
        return found


Subjects = Mapping[str, Subject]

SUBJECTS: Subjects = {
    "arm-calibration": Subject(
        "hardware.bench.arm_calibration",
        options.arm_calibration,
        "the arm's place, tool and latency from what cameras see of its tip",
    ),
    "bumps": Subject(
        "hardware.bench.bumps", options.bumps, "cameras knocked and lenses turned by little: found, named, false alarms"
    ),
    "calibration": Subject(
        "hardware.bench.calibration",
        options.calibration,
        "cameras calibrated from rendered boards, beside the exact rig",
    ),
    "cameras": Subject(
        "hardware.bench.cameras", options.cameras, "frames of live cameras put into sets: complete, wrong, waited for"
    ),
    "consistency": Subject(
        "hardware.bench.consistency", options.consistency, "poses from pictures: are errors as large as is claimed?"
    ),
    "estimator": Subject(
        "hardware.bench.estimator", options.estimator, "the estimator on synthetic tracks: accuracy, honesty, time"
    ),
    "faults": Subject(
        "hardware.bench.faults", options.faults, "prints in which everything goes wrong: said, harmless, back soon?"
    ),
    "fill": Subject(
        "hardware.bench.fill", options.fill, "beads laid into contours and random wounds: coverage and time"
    ),
    "fuzz": Subject(
        "hardware.bench.fuzz", options.fuzz, "every reader of what comes from outside, given what is nearly valid"
    ),
    "growth": Subject(
        "hardware.bench.growth", options.growth, "how cost grows: with tracks, cameras, pixels, checkpoints, minutes"
    ),
    "latency": Subject(
        "hardware.bench.latency", options.latency, "from three decoded frames to the pose, by wall clock and processor"
    ),
    "link": Subject(
        "hardware.bench.link", options.link, "the arm's line with everything going wrong; stops, jitter, the guard"
    ),
    "live": Subject(
        "hardware.bench.live", options.live, "whole runs in real time: frames to wire, stops, nozzle, kills"
    ),
    "loop": Subject("hardware.bench.loop", options.loop, "the closed loop at the nozzle, with and without prediction"),
    "map": Subject(
        "hardware.bench.mapping",
        options.mapping,
        "landmarks off the true surface beside their claim, and the map's growth",
    ),
    "outages": Subject(
        "hardware.bench.outages", options.outages, "cameras covered, dead, frozen, swapped, bumped: lost in silence?"
    ),
    "plan": Subject("hardware.bench.plan", options.plan, "a whole plan of a large wound: time, memory, coverage, ink"),
    "registration": Subject(
        "hardware.bench.registration", options.registration, "a scan laid into the first pictures: error and verdict"
    ),
    "prediction": Subject(
        "hardware.bench.prediction", options.prediction, "where a breathing chest will be, 100 to 500 ms ahead"
    ),
    "planner": Subject(
        "hardware.bench.planner", options.planner, "random poses into planner and guard: limits kept, cost of a step"
    ),
    "segmentation": Subject(
        "hardware.bench.pictures",
        options.segmentation,
        "finding the wound: Dice, silence, a half covered one, time",
    ),
    "smoothing": Subject(
        "hardware.bench.smoothing", options.smoothing, "smoothed poses beside causal ones, clocks, time by length"
    ),
    "steps": Subject(
        "hardware.bench.detection",
        options.steps,
        "movements of 300 um and 0.1 degree: how soon flagged, how often false",
    ),
    "tracks": Subject(
        "hardware.bench.tracks", options.tracks, "scatter and creep of tracks before a surface that stands still"
    ),
    "views": Subject(
        "hardware.bench.views", options.views, "skin that deforms, grazing views with glare, a cube's edges"
    ),
    "thesis": Subject(
        "hardware.bench.recordings", options.thesis, "the thesis's estimator beside ours, on the same frame sets"
    ),
}
