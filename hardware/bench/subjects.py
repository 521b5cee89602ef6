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

from hardware.offline.track import THESIS_FLOW_METHOD, THESIS_METHOD
from planning.fill import PATTERN_KINDS

if TYPE_CHECKING:
    from hardware.bench.figures import Figure

BREATHING = ("breathing_calm", "breathing_deep", "breathing_irregular")  # scenarios
BREATHING_HELP = f"of {', '.join(BREATHING)} (default: all)"
MOVEMENTS = ("still", "breathing", "irregular", "steps", "turns", "sway", "lively")  # of synthetic worlds
RENDERED = (
    *("still", *BREATHING, "shaking_table_0_5_hz", "steps_300um"),
    *("turns", "hand", "camera_lost", "clock_offsets", "wet_glare", "deformation"),
)  # scenarios
BODIES = ("chest", "forearm", "foot")  # that the simulator has
MAPS = ("told", "seen")  # whose map the estimator has: the world's own, or one that it made
MADE = (
    "flat patch, shaking table",
    "flat patch, constant speed in six axes",
    "wet forearm, breathing",
    "chest, breathing",
)  # recordings that hardware/bench/recordings.py renders

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
    program: str = "stillbed bench"

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
SESSIONS = option("sessions", nargs="*", type=Path, metavar="SESSION", help="recorded sessions to show instead")

_SUBJECTS = (
    _subject("arm-calibration", "calibration", "the arm's place, tool and latency from what cameras see of its tip")(
        number("--rendered", 1, "N", "arms before rendered cameras; default 1"),
        number("--runs", 50, "N", "arms on drawn tips; default 50"),
        number("--seed", 0, None, "of the first arm; default 0"),
    ),
    _subject("beside", "live", "the wound network beside the tracker: its share of a core, what it costs a pose")(
        number("--seconds", 10.0, "S", "of the made recording; default 10"),
        option("--scene", choices=MADE, default=MADE[-1], metavar="NAME", help="; ".join(MADE)),
        option("--model", type=Path, metavar="X.onnx", help="another network than the one that comes along"),
    ),
    _subject("bumps", "detection", "cameras knocked and lenses turned by little: found, named, false alarms")(
        number("--count", 9, "N", "of each knock; default 9"),
        number("--minutes", 10.0, "M", "of calm; default 10"),
        number("--seed", 0, None, "of motions and noise; default 0"),
    ),
    _subject("calibration", "calibration", "cameras calibrated from rendered boards, beside the exact rig")(
        option("--instants", type=positive, default=60, metavar="N", help="frame sets, rendered; default 60"),
        number("--runs", 50, "N", "runs without pictures; default 50"),
    ),
    _subject("cameras", "detection", "frames of live cameras put into sets: complete, wrong, waited for")(
        number("--minutes", 10.0, None, "of three cameras at 30 fps; default 10"), SEED
    ),
    _subject("consistency", "estimator", "poses from pictures: are errors as large as is claimed?")(
        number("--scenes", 2, "N", "rendered first, some 10 s each; default 2"),
        number("--seed", 300, None, "of the first scene (default: 300)"),
        number("--seconds", 5.0, "S", "of each scene; default 5"),
    ),
    _subject("estimator", "estimator", "the estimator on synthetic tracks: accuracy, honesty, time")(
        option("--only", default="*", metavar="PATTERN", help="scenes by name, e.g. 'breathing, c*'"),
        option("--maps", nargs="+", choices=MAPS, default=MAPS, help="whose map"),
        number("--seeds", 3, "N", "worlds of each scene"),
        option("--seconds", type=float, metavar="S", help="length of each world; 10 s or more without"),
        number("--count", 100, "N", "landmarks"),
        number("--noise", 0.25, "PX", "white, where a scene has no own"),
        option("--soak", type=float, metavar="HOURS", help="instead: one long run of breathing"),
    ),
    _subject("fill", "fill", "beads laid into contours and random wounds: coverage and time")(
        option("contours", nargs="*", type=Path, metavar="CSV", help="x_mm,y_mm; two own without"),
        option("--kind", choices=PATTERN_KINDS, default="best", help="pattern; default best"),
        number("--contour-width", 0.8, "MM", "bead in contours; default 0.8"),
        number("--width", 0.4, "MM", "bead of the wounds; default 0.4"),
        number("--count", 1000, "N", "random wounds; default 1000"),
        SEED,
        option("--picture", type=Path, metavar="SVG", help="also draw all patterns side by side"),
    ),
    _subject("growth", "recordings", "how cost grows: with tracks, cameras, pixels, checkpoints, minutes")(
        number("--seconds", 4.0, "S", "of each world; default 4"),
        option("--no-pictures", action="store_true", help="leave out resolution, which has to be rendered"),
    ),
    _subject("latency", "recordings", "from three decoded frames to the pose, by wall clock and processor")(
        SESSIONS,
        number("--seconds", 5.0, "S", "of each made recording; default 5"),
        option("--scene", nargs="+", choices=MADE, default=[MADE[-1]], metavar="NAME", help="; ".join(MADE)),
    ),
    _subject("link", "link", "the motion process on a pty while cores are busy: jitter, stops, what arrives")(
        number("--minutes", 1.0, "M", "of real time; default 1"),
        number("--seed", 0, None, "of what is halted when"),
        number("--busy", 1, "N", "processes that saturate a core each; default 1"),
        option("--ordinary", action="store_true", help="do not ask for real-time priority"),
    ),
    _subject("live", "live", "whole runs in real time: frames to wire, stops, nozzle, kills")(
        number("--minutes", 1.0, "M", "of printing; 0: none; default 1"),
        number("--stops", 3, "N", "in a run of their own; default 3"),
        number("--kills", 0, "N", "of random processes; default none"),
        number("--busy", 0, "N", "processes beside it that saturate a core each; default none"),
        number("--seed", 0, None, "of what is killed when"),
        option("--pinned", action="store_true", help="motion and recorder on one core, tracking on the other"),
        option("--dispenser", type=Path, metavar="DISPENSER.toml", help="to tell, e.g. a virtual one; default none"),
        option(
            "--scenario", type=Path, default=Path("data/live/calm.toml"), metavar="SCENARIO.toml", help="which world"
        ),
    ),
    _subject("loop", "prediction", "the closed loop at the nozzle, with and without prediction")(
        option(
            "--scenario", nargs="+", default=list(BREATHING), choices=BREATHING, metavar="NAME", help=BREATHING_HELP
        ),
        number("--seed", 1, None, "of the tracks' noise (default: 1)"),
        number("--jobs", 1, None, "processes that share the prints (default: 1)"),
    ),
    _subject("look", "scan", "layers of gel, as a look between layers measures them; clogs found")(
        number("--layers", 36, "N", "on bare beds, every sixth with a clog; default 36"),
        number("--stacks", 8, "N", "of three layers each, three of four with a clog; default 8"),
    ),
    _subject("map", "mapping", "landmarks off the true surface beside their claim, and the map's growth")(
        number("--seconds", 3.0, "S", "of each still standing; default 3")
    ),
    _subject("plan", "fill", "a whole plan of a large wound: time, memory, coverage, ink")(
        option("--body", choices=BODIES, default="forearm", help="default forearm")
    ),
    _subject("registration", "mapping", "a scan laid into the first pictures: error and verdict")(
        number("--seeds", 2, "N", "bodies of each kind; default 2")
    ),
    _subject("scan", "scan", "what the cameras scan themselves, wet and dry, off the true surface")(
        option("--bodies", nargs="+", choices=BODIES, default=BODIES, metavar="NAME", help=f"of {', '.join(BODIES)}"),
        number("--sets", 6, "N", "frame sets that are fused; default 6"),
    ),
    _subject("prediction", "prediction", "where a breathing chest will be, 100 to 500 ms ahead")(
        option(
            "--traces",
            type=Path,
            metavar="DIR",
            help="folder of traces: breathing*.tum (default: the simulator's breathing)",
        ),
        option("--pattern", default="breathing*.tum", help="names of the traces in it"),
        number("--warm-up", 60.0, "S", "beginning that is not judged"),
        number("--seconds", 240.0, "S", "of the simulator's; default 240"),
    ),
    _subject("planner", "planner", "random poses into planner and guard: limits kept, cost of a step")(
        number("--updates", 10_000, "N", "in all; default 10000"),
        option("--arm", type=Path, metavar="ARM.toml", help="instead of the default arm"),
        number("--seed", 0, None, "of the streams; runs with other seeds may go side by side"),
    ),
    _subject("segmentation", "pictures", "finding the wound: Dice, silence, a half covered one, time, area")(
        option("dataset", type=Path, nargs="?", metavar="DATASET", help="folder with images/ and labels/"),
        option("--model", type=Path, metavar="X.onnx", help="another network than the one that comes along"),
        number("--rendered", 60, "N", "rendered pictures of each kind"),
        number("--areas", 40, "N", "rendered wounds before three cameras, for areas in mm^2; default 40"),
        option("--sheet", type=Path, metavar="X.jpg", help="also draw best, median and worst, 8 of each"),
        number("--seed", 1, "N", "of pieces, covers and sizes drawn"),
    ),
    _subject("smoothing", "smoothing", "smoothed poses beside causal ones, clocks, time by length")(
        option("--movements", nargs="*", choices=MOVEMENTS, default=MOVEMENTS, help="of the worlds; none: no worlds"),
        option("--scenarios", nargs="*", choices=RENDERED, default=RENDERED, help="rendered, tracked and smoothed"),
        number("--rendered", 8.0, "S", "of each scenario; kept rendered; default 8"),
        number("--seeds", 4, "N", "worlds of each movement; default 4"),
        number("--seconds", 6.0, "S", "of each world; default 6"),
        number("--count", 100, "N", "landmarks; default 100"),
        option("--minutes", type=float, nargs="*", default=[1.0, 3.0, 10.0], metavar="M", help="runs that are timed"),
        option("--landmarks", type=int, nargs="*", default=[200, 400], metavar="N", help="of more runs, a minute each"),
        number("--adjusted", 4.0, "S", "of the bundle adjustment beside Ceres's; default 4, 0: none"),
        number("--sessions", 40, "N", "smoothed by one and by two workers; default 40, 0: none"),
    ),
    _subject("steps", "detection", "movements of 300 um and 0.1 degree: how soon flagged, how often falsely")(
        number("--steps", 2000, None, "of each kind (default: %(default)s)"),
        number("--hours", 1.0, None, "at rest (default: %(default)s)"),
        number("--noise", 0.1, None, "px of a track in a frame (default: %(default)s)"),
        SEED,
    ),
    _subject("tracks", "mapping", "scatter and creep of tracks before a surface that stands still")(
        number("--minutes", 10.0, "M", "that are stood for; default 10"),
        number("--pictures", 240, "N", "evenly over them; default 240"),
    ),
    _subject("wounds", "wounds", "wounds carved into bodies: found, the skin restored, its volume and its normal")(
        option("bodies", nargs="*", type=Path, metavar="MESH", help="of persons or limbs, mm; five own without"),
        number("--count", 40, "N", "wounds; default 40"),
        SEED,
    ),
    _subject("views", "pictures", "skin that deforms, grazing views with glare, a cube's edges")(
        number("--seconds", 8.0, "S", "of each sequence; default 8")
    ),
    _subject("thesis", "recordings", "the thesis's estimator beside ours, on the same frame sets")(
        SESSIONS,
        number("--seconds", 4.0, "S", "of each made recording; default 4"),
        option(
            "--method",
            choices=(THESIS_METHOD, THESIS_FLOW_METHOD),
            default=THESIS_METHOD,
            help="which of the thesis's ways",
        ),
    ),
)
SUBJECTS: Subjects = dict(_SUBJECTS)
