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

_Option = tuple[tuple[str, ...], dict[str, Any]]  # arguments of add_argument


@dataclass(frozen=True, slots=True)
class Subject:
    """One thing to measure.

    function: "module:name" of a function that turns parsed options into a list of figures.
    add_options: adds the subject's own options to a parser.
    summary: a line for the list of subjects.
    """

    function: str
    add_options: Callable[[argparse.ArgumentParser], None]
    summary: str

    @property
    def run(self) -> Callable[[argparse.Namespace], list[Figure]]:
        """The function itself; its module is loaded now."""
        module, _, name = self.function.partition(":")
        function: Callable[[argparse.Namespace], list[Figure]] = getattr(import_module(module), name)
        return function


Subjects = Mapping[str, Subject]


def _add_options(options: tuple[_Option, ...], parser: argparse.ArgumentParser) -> None:
    for names, settings in options:
        parser.add_argument(*names, **settings)


def _subject(name: str, module: str, summary: str) -> Callable[..., tuple[str, Subject]]:
    """The subject that `run_NAME` of a module of this folder measures; call the result with its options."""
    function = f"hardware.bench.{module}:run_{name.replace('-', '_')}"
    return lambda *options: (name, Subject(function, partial(_add_options, options), summary))


def _option(*names: str, **settings: Any) -> _Option:
    return names, settings


def _number(name: str, default: float, metavar: str | None, text: str) -> _Option:
    """An option that takes a number of the default's type."""
    return _option(name, type=type(default), default=default, metavar=metavar, help=text)


def _positive(text: str) -> int:
    if int(text) < 1:
        raise ValueError(text)
    return int(text)


SEED = _option("--seed", type=int, default=0)
SESSIONS = _option("sessions", nargs="*", type=Path, metavar="SESSION", help="recorded sessions to show instead")

_SUBJECTS = (
    _subject("arm-calibration", "calibration", "the arm's place, tool and latency from what cameras see of its tip")(
        _number("--rendered", 1, "N", "arms before rendered cameras; default 1"),
        _number("--runs", 50, "N", "arms on drawn tips; default 50"),
        _number("--seed", 0, None, "of the first arm; default 0"),
    ),
    _subject("beside", "live", "the wound network beside the tracker: its share of a core, what it costs a pose")(
        _number("--seconds", 10.0, "S", "of the made recording; default 10"),
        _option("--scene", choices=MADE, default=MADE[-1], metavar="NAME", help="; ".join(MADE)),
        _option("--model", type=Path, metavar="X.onnx", help="another network than the one that comes along"),
    ),
    _subject("bumps", "detection", "cameras knocked and lenses turned by little: found, named, false alarms")(
        _number("--count", 9, "N", "of each knock; default 9"),
        _number("--minutes", 10.0, "M", "of calm; default 10"),
        _number("--seed", 0, None, "of motions and noise; default 0"),
    ),
    _subject("calibration", "calibration", "cameras calibrated from rendered boards, beside the exact rig")(
        _option("--instants", type=_positive, default=60, metavar="N", help="frame sets, rendered; default 60"),
        _number("--runs", 50, "N", "runs without pictures; default 50"),
    ),
    _subject("cameras", "detection", "frames of live cameras put into sets: complete, wrong, waited for")(
        _number("--minutes", 10.0, None, "of three cameras at 30 fps; default 10"), SEED
    ),
    _subject("consistency", "estimator", "poses from pictures: are errors as large as is claimed?")(
        _number("--scenes", 2, "N", "rendered first, some 10 s each; default 2"),
        _number("--seed", 300, None, "of the first scene (default: 300)"),
        _number("--seconds", 5.0, "S", "of each scene; default 5"),
    ),
    _subject("estimator", "estimator", "the estimator on synthetic tracks: accuracy, honesty, time")(
        _option("--only", default="*", metavar="PATTERN", help="scenes by name, e.g. 'breathing, c*'"),
        _option("--maps", nargs="+", choices=MAPS, default=MAPS, help="whose map"),
        _number("--seeds", 3, "N", "worlds of each scene"),
        _option("--seconds", type=float, metavar="S", help="length of each world; 10 s or more without"),
        _number("--count", 100, "N", "landmarks"),
        _number("--noise", 0.25, "PX", "white, where a scene has no own"),
        _option("--soak", type=float, metavar="HOURS", help="instead: one long run of breathing"),
    ),
    _subject("faults", "campaigns.faults", "prints in which everything goes wrong: said, harmless, back soon?")(
        _number("--count", 60, None, "faults, of all kinds in turn (default: 60)"),
        _number("--seed", 1, None, "of all that chance decides (default: 1)"),
        _number("--jobs", 1, None, "processes that share the runs (default: 1)"),
        _option("--log", type=Path, metavar="X.csv", help="what came of each fault; runs in it are not repeated"),
        _option("--scenarios", type=Path, metavar="FOLDER", help="where the scenarios are (default: the shipped)"),
    ),
    _subject("fill", "fill", "beads laid into contours and random wounds: coverage and time")(
        _option("contours", nargs="*", type=Path, metavar="CSV", help="x_mm,y_mm; two own without"),
        _option("--kind", choices=PATTERN_KINDS, default="best", help="pattern; default best"),
        _number("--contour-width", 0.8, "MM", "bead in contours; default 0.8"),
        _number("--width", 0.4, "MM", "bead of the wounds; default 0.4"),
        _number("--count", 1000, "N", "random wounds; default 1000"),
        SEED,
        _option("--picture", type=Path, metavar="SVG", help="also draw all patterns side by side"),
    ),
    _subject("fuzz", "campaigns.fuzz", "every reader of what comes from outside, given what is nearly valid")(
        _number("--count", 20_000, None, "inputs, of all readers in equal shares (default: 20000)"),
        _number("--seed", 1, None, "of what is made wrong (default: 1)"),
        _option("--only", metavar="READER", help="one reader; see the table for their names"),
        _number("--jobs", 1, None, "readers at a time, a process each (default: 1)"),
        _option(
            "--log", type=Path, metavar="X.csv", help="how far each reader is, and what went wrong; goes on from there"
        ),
    ),
    _subject("growth", "recordings", "how cost grows: with tracks, cameras, pixels, checkpoints, minutes")(
        _number("--seconds", 4.0, "S", "of each world; default 4"),
        _option("--no-pictures", action="store_true", help="leave out resolution, which has to be rendered"),
    ),
    _subject("latency", "recordings", "from three decoded frames to the pose, by wall clock and processor")(
        SESSIONS,
        _number("--seconds", 5.0, "S", "of each made recording; default 5"),
        _option("--scene", nargs="+", choices=MADE, default=[MADE[-1]], metavar="NAME", help="; ".join(MADE)),
    ),
    _subject("link", "campaigns.link", "the arm's line with everything going wrong; stops, jitter, the guard")(
        _number("--hours", 1.0, "H", "of virtual time; default 1"),
        _number("--minutes", 0.0, "M", "of real time on a pty; default none"),
        _number("--commands", 100_000, "N", "random ones before the guard"),
        _number("--baud", 115_200, "B", "of the line in virtual time"),
        _option("--only", choices=("guard",), help="the guard alone"),
        _number("--seed", 0, None, "of the first run"),
        _number("--busy", 1, "N", "processes that saturate a core each; default 1"),
        _option("--ordinary", action="store_true", help="do not ask for real-time priority"),
    ),
    _subject("live", "live", "whole runs in real time: frames to wire, stops, nozzle, kills")(
        _number("--minutes", 1.0, "M", "of printing; 0: none; default 1"),
        _number("--stops", 3, "N", "in a run of their own; default 3"),
        _number("--kills", 0, "N", "of random processes; default none"),
        _number("--seed", 0, None, "of what is killed when"),
        _option("--pinned", action="store_true", help="motion and recorder on one core, tracking on the other"),
        _option("--dispenser", type=Path, metavar="DISPENSER.toml", help="to tell, e.g. a virtual one; default none"),
        _option(
            "--scenario", type=Path, default=Path("data/live/calm.toml"), metavar="SCENARIO.toml", help="which world"
        ),
    ),
    _subject("loop", "prediction", "the closed loop at the nozzle, with and without prediction")(
        _option(
            "--scenario", nargs="+", default=list(BREATHING), choices=BREATHING, metavar="NAME", help=BREATHING_HELP
        ),
        _number("--seed", 1, None, "of the tracks' noise (default: 1)"),
        _number("--jobs", 1, None, "processes that share the prints (default: 1)"),
    ),
    _subject("map", "mapping", "landmarks off the true surface beside their claim, and the map's growth")(
        _number("--seconds", 3.0, "S", "of each still standing; default 3")
    ),
    _subject("outages", "campaigns.outages", "cameras covered, dead, frozen, swapped, bumped: lost in silence?")(
        _option("--count", type=_positive, default=66, help="outages, of all kinds in turn (default: 66)"),
        _number("--seed", 0, None, "of scenes, motions and outages (default: 0)"),
        _option("--processes", type=_positive, default=2, help="that share the scenes (default: 2)"),
    ),
    _subject("plan", "fill", "a whole plan of a large wound: time, memory, coverage, ink")(
        _option("--body", choices=BODIES, default="forearm", help="default forearm")
    ),
    _subject("registration", "mapping", "a scan laid into the first pictures: error and verdict")(
        _number("--seeds", 2, "N", "bodies of each kind; default 2")
    ),
    _subject("scan", "mapping", "what the cameras scan themselves, wet and dry, off the true surface")(
        _option("--bodies", nargs="+", choices=BODIES, default=BODIES, metavar="NAME", help=f"of {', '.join(BODIES)}"),
        _number("--sets", 6, "N", "frame sets that are fused; default 6"),
    ),
    _subject("prediction", "prediction", "where a breathing chest will be, 100 to 500 ms ahead")(
        _option(
            "--traces",
            type=Path,
            metavar="DIR",
            help="folder of traces: breathing*.tum (default: the simulator's breathing)",
        ),
        _option("--pattern", default="breathing*.tum", help="names of the traces in it"),
        _number("--warm-up", 60.0, "S", "beginning that is not judged"),
        _number("--seconds", 240.0, "S", "of the simulator's; default 240"),
    ),
    _subject("planner", "planner", "random poses into planner and guard: limits kept, cost of a step")(
        _number("--updates", 10_000, "N", "in all; default 10000"),
        _option("--arm", type=Path, metavar="ARM.toml", help="instead of the default arm"),
        _number("--seed", 0, None, "of the streams; runs with other seeds may go side by side"),
    ),
    _subject("segmentation", "pictures", "finding the wound: Dice, silence, a half covered one, time, area")(
        _option("dataset", type=Path, nargs="?", metavar="DATASET", help="folder with images/ and labels/"),
        _option("--model", type=Path, metavar="X.onnx", help="another network than the one that comes along"),
        _number("--rendered", 60, "N", "rendered pictures of each kind"),
        _number("--areas", 40, "N", "rendered wounds before three cameras, for areas in mm^2; default 40"),
        _option("--sheet", type=Path, metavar="X.jpg", help="also draw best, median and worst, 8 of each"),
        _number("--seed", 1, "N", "of pieces, covers and sizes drawn"),
    ),
    _subject("smoothing", "smoothing", "smoothed poses beside causal ones, clocks, time by length")(
        _option("--movements", nargs="*", choices=MOVEMENTS, default=MOVEMENTS, help="of the worlds; none: no worlds"),
        _option("--scenarios", nargs="*", choices=RENDERED, default=RENDERED, help="rendered, tracked and smoothed"),
        _number("--rendered", 8.0, "S", "of each scenario; kept rendered; default 8"),
        _number("--seeds", 4, "N", "worlds of each movement; default 4"),
        _number("--seconds", 6.0, "S", "of each world; default 6"),
        _number("--count", 100, "N", "landmarks; default 100"),
        _option("--minutes", type=float, nargs="*", default=[1.0, 3.0, 10.0], metavar="M", help="runs that are timed"),
        _option(
            "--landmarks", type=int, nargs="*", default=[200, 400], metavar="N", help="of more runs, a minute each"
        ),
        _number("--adjusted", 4.0, "S", "of the bundle adjustment beside Ceres's; default 4, 0: none"),
        _number("--sessions", 40, "N", "smoothed by one and by two workers; default 40, 0: none"),
    ),
    _subject("steps", "detection", "movements of 300 um and 0.1 degree: how soon flagged, how often falsely")(
        _number("--steps", 2000, None, "of each kind (default: %(default)s)"),
        _number("--hours", 1.0, None, "at rest (default: %(default)s)"),
        _number("--noise", 0.1, None, "px of a track in a frame (default: %(default)s)"),
        SEED,
    ),
    _subject("tracks", "mapping", "scatter and creep of tracks before a surface that stands still")(
        _number("--minutes", 10.0, "M", "that are stood for; default 10"),
        _number("--pictures", 240, "N", "evenly over them; default 240"),
    ),
    _subject("wounds", "wounds", "wounds carved into bodies: found, the skin restored, its volume and its normal")(
        _option("bodies", nargs="*", type=Path, metavar="MESH", help="of persons or limbs, mm; five own without"),
        _number("--count", 40, "N", "wounds; default 40"),
        SEED,
    ),
    _subject("views", "pictures", "skin that deforms, grazing views with glare, a cube's edges")(
        _number("--seconds", 8.0, "S", "of each sequence; default 8")
    ),
    _subject("thesis", "recordings", "the thesis's estimator beside ours, on the same frame sets")(
        SESSIONS,
        _number("--seconds", 4.0, "S", "of each made recording; default 4"),
        _option(
            "--method",
            choices=(THESIS_METHOD, THESIS_FLOW_METHOD),
            default=THESIS_METHOD,
            help="which of the thesis's ways",
        ),
    ),
)
SUBJECTS: Subjects = dict(_SUBJECTS)
