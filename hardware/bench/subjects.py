"""What `stillbed bench` can measure: each subject's function, options and summary.

Listing the subjects, or reading their options, loads nothing that they measure with.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perception.tracking import THESIS_FLOW_METHOD, THESIS_METHOD

if TYPE_CHECKING:
    from hardware.bench.figures import Figure

BREATHING = ("breathing_calm", "breathing_deep", "breathing_irregular")  # scenarios
BREATHING_HELP = f"scenarios, of {', '.join(BREATHING)} (default: all)"
MADE = (
    "flat patch, shaking table",
    "flat patch, constant speed in six axes",
    "wet forearm, breathing",
    "chest, breathing",
)  # recordings that hardware/bench/recordings.py renders

BENCH = "stillbed bench"

Option = tuple[tuple[str, ...], dict[str, Any]]  # arguments of add_argument


@dataclass(frozen=True, slots=True)
class Subject:
    """One thing to measure.

    function: "module:name" of a function that turns parsed options into a list of figures.
    add_options: adds the subject's own options to a parser.
    summary: a line for the list of subjects.
    program: what stands before its name on a command line.
    """

    function: str
    add_options: Callable[[argparse.ArgumentParser], None]
    summary: str
    program: str = BENCH

    @property
    def run(self) -> Callable[[argparse.Namespace], list[Figure]]:
        """The function itself; its module is loaded now."""
        module, _, name = self.function.partition(":")
        function: Callable[[argparse.Namespace], list[Figure]] = getattr(import_module(module), name)
        return function


Subjects = Mapping[str, Subject]


def add_options(options: tuple[Option, ...], parser: argparse.ArgumentParser) -> None:
    """Add options to a parser."""
    for names, settings in options:
        parser.add_argument(*names, **settings)


def _subject(name: str, module: str, summary: str) -> Callable[..., tuple[str, Subject]]:
    """The subject that `run_NAME` of a module of this folder measures; call the result with its options."""
    function = f"hardware.bench.{module}:run_{name.replace('-', '_')}"
    return lambda *options: (name, Subject(function, partial(add_options, options), summary))


def option(*names: str, **settings: Any) -> Option:
    """Arguments of add_argument."""
    return names, settings


def number(name: str, default: float, metavar: str | None, text: str) -> Option:
    """An option that takes a number of the default's type."""
    return option(name, type=type(default), default=default, metavar=metavar, help=text)


def positive(text: str) -> int:
    """A whole number from 1 on; ValueError for another."""
    if int(text) < 1:
        raise ValueError(text)
    return int(text)


SEED = option("--seed", type=int, default=0)
SESSIONS = option("sessions", nargs="*", type=Path, metavar="SESSION", help="recorded sessions to use instead")

_SUBJECTS = (
    _subject("arm-calibration", "calibration", "arm calibrated with the cameras: base pose, tool, latency")(
        number("--rendered", 1, "N", "arms with rendered cameras; default 1"),
        number("--runs", 50, "N", "arms with random tip observations; default 50"),
        number("--seed", 0, None, "seed of the first arm; default 0"),
    ),
    _subject("beside", "live", "wound network parallel to the tracker: its share of a core, delay of a pose")(
        number("--seconds", 10.0, "S", "duration of the rendered recording; default 10"),
        option("--scene", choices=MADE, default=MADE[-1], metavar="NAME", help="; ".join(MADE)),
        option("--model", type=Path, metavar="X.onnx", help="network instead of the shipped one"),
    ),
    _subject("calibration", "calibration", "cameras calibrated from rendered boards, compared with the exact rig")(
        option("--instants", type=positive, default=60, metavar="N", help="rendered frame sets; default 60"),
        number("--runs", 50, "N", "runs without pictures; default 50"),
    ),
    _subject("latency", "recordings", "time from three decoded frames to the pose: wall clock and processor")(
        SESSIONS,
        number("--seconds", 5.0, "S", "duration of each rendered recording; default 5"),
        option("--scene", nargs="+", choices=MADE, default=[MADE[-1]], metavar="NAME", help="; ".join(MADE)),
    ),
    _subject("link", "link", "the motion process on a pseudo-terminal with busy cores: jitter, stops, received bytes")(
        number("--minutes", 1.0, "M", "duration in real time; default 1"),
        number("--seed", 0, None, "seed of the halts"),
        number("--busy", 1, "N", "busy processes, a core each; default 1"),
    ),
    _subject("live", "live", "whole runs in real time: frames to wire, stops, nozzle, kills")(
        number("--minutes", 1.0, "M", "duration of printing; 0: none; default 1"),
        number("--stops", 3, "N", "stops, in a separate run; default 3"),
        number("--kills", 0, "N", "kills of random processes; default none"),
        number("--busy", 0, "N", "busy processes, a core each; default none"),
        number("--seed", 0, None, "seed of the kills"),
        option("--pinned", action="store_true", help="motion and recorder on one core, tracking on the other"),
        option("--scenario", type=Path, default=Path("data/live/calm.toml"), metavar="SCENARIO.toml", help="scenario"),
    ),
    _subject("loop", "prediction", "nozzle error of the closed loop, with and without prediction")(
        option(
            "--scenario", nargs="+", default=list(BREATHING), choices=BREATHING, metavar="NAME", help=BREATHING_HELP
        ),
        number("--seed", 1, None, "seed of the tracks' noise (default: 1)"),
        number("--jobs", 1, None, "parallel processes (default: 1)"),
    ),
    _subject("prediction", "prediction", "error of the predicted pose of a breathing chest, 100 to 500 ms ahead")(
        option(
            "--traces",
            type=Path,
            metavar="DIR",
            help="folder of traces: breathing*.tum (default: the simulator's breathing)",
        ),
        option("--pattern", default="breathing*.tum", help="file names of the traces in it"),
        number("--warm-up", 60.0, "S", "start of a trace, without figures"),
        number("--seconds", 240.0, "S", "duration of the simulated breathing; default 240"),
    ),
    _subject("segmentation", "pictures", "wound segmentation: Dice, false alarms, covered wounds, time, area")(
        option("dataset", type=Path, nargs="?", metavar="DATASET", help="folder with images/ and labels/"),
        option("--model", type=Path, metavar="X.onnx", help="network instead of the shipped one"),
        number("--rendered", 60, "N", "number of rendered pictures of each kind"),
        number("--areas", 40, "N", "rendered wounds, three cameras, for areas in mm^2; default 40"),
        option(
            "--sheet", type=Path, metavar="X.jpg", help="also write a contact sheet: best, median and worst, 8 of each"
        ),
        number("--seed", 1, "N", "seed of crops, covers and sizes"),
    ),
    _subject("thesis", "recordings", "the thesis's estimator compared with stillbed's, on the same frame sets")(
        SESSIONS,
        number("--seconds", 4.0, "S", "duration of each rendered recording; default 4"),
        option(
            "--method",
            choices=(THESIS_METHOD, THESIS_FLOW_METHOD),
            default=THESIS_METHOD,
            help="method of the thesis",
        ),
    ),
)
SUBJECTS: Subjects = dict(_SUBJECTS)


@dataclass(frozen=True, slots=True)
class BenchPart:
    """One subject as a part of a whole, and of the quick look at it."""

    subject: str
    options: tuple[str, ...] = ()
    quick: tuple[str, ...] | None = None  # None: left out of the quick look
    name: str = ""  # in the table and of its folder, where the subject has another part beside it
    program: str = BENCH  # what the subject is one of


@dataclass(frozen=True, slots=True)
class Whole:
    """All that one command measures, part by part.

    command: what it is called in tables.
    elsewhere: what is added where a subject is not known, e.g. where there are others.
    """

    command: str
    parts: tuple[BenchPart, ...]
    elsewhere: str = ""


BENCH_WHOLE = Whole(
    f"{BENCH} --all",
    (
        BenchPart("prediction", (), ("--seconds", "75")),
        BenchPart("latency", ("--seconds", "4")),
        BenchPart("thesis", ("--seconds", "2")),
        BenchPart("segmentation", ("--rendered", "30", "--areas", "20"), ("--rendered", "2", "--areas", "1")),
        BenchPart("link", ("--minutes", "1"), ("--minutes", "0.1")),
        BenchPart("loop", ("--jobs", "2"), ("--jobs", "2", "--scenario", "breathing_deep")),
    ),
    "; in a clone, `python -m tests.campaigns` lists what developers measure beside these",
)
