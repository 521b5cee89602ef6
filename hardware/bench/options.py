"""The options of each subject, apart from its module, so that reading them loads none of what it measures with."""

from __future__ import annotations

import argparse
from pathlib import Path

from hardware.methods import THESIS, THESIS_FLOW
from planning.fill.pattern import KINDS

BREATHING = ("breathing_calm", "breathing_deep", "breathing_irregular")  # scenarios
MOVEMENTS = ("still", "breathing", "irregular", "steps", "turns", "sway", "lively")  # of synthetic worlds
RENDERED = (
    *("still", *BREATHING, "shaking_table_0_5_hz", "steps_300um"),
    *("turns", "hand", "camera_lost", "clock_offsets", "wet_glare", "deformation"),
)  # scenarios
WHOSE = ("told", "seen")  # whose map the estimator has: the world's own, or one that it made
MADE = (
    "flat patch, shaking table",
    "flat patch, constant speed in six axes",
    "wet forearm, breathing",
    "chest, breathing",
)  # recordings that hardware/bench/thesis_scenes.py makes


def arm_calibration(parser: argparse.ArgumentParser) -> None:
    """How many arms of each kind."""
    parser.add_argument("--rendered", type=int, default=1, metavar="N", help="arms before rendered cameras; default 1")
    parser.add_argument("--runs", type=int, default=50, metavar="N", help="arms on drawn tips; default 50")
    parser.add_argument("--seed", type=int, default=0, help="of the first arm; default 0")


def bumps(parser: argparse.ArgumentParser) -> None:
    """How many knocks, and how long without any."""
    parser.add_argument("--count", type=int, default=9, metavar="N", help="of each knock; default 9")
    parser.add_argument("--minutes", type=float, default=10.0, metavar="M", help="of calm; default 10")
    parser.add_argument("--seed", type=int, default=0, help="of motions and noise; default 0")


def calibration(parser: argparse.ArgumentParser) -> None:
    """How long is waved, and how often without pictures."""
    parser.add_argument(
        "--instants", type=int, default=60, metavar="N", help="frame sets that are rendered; default 60"
    )
    parser.add_argument("--runs", type=int, default=50, metavar="N", help="runs without pictures; default 50")


def cameras(parser: argparse.ArgumentParser) -> None:
    """The options of `stillbed bench cameras`."""
    parser.add_argument("--minutes", type=float, default=10.0, help="of three cameras at 30 fps; default 10")
    parser.add_argument("--seed", type=int, default=0)


def consistency(parser: argparse.ArgumentParser) -> None:
    """How many scenes, and how long each is looked at."""
    parser.add_argument("--scenes", type=int, default=2, metavar="N", help="rendered first, some 10 s each; default 2")
    parser.add_argument("--seed", type=int, default=300, help="of the first scene (default: 300)")
    parser.add_argument("--seconds", type=float, default=5.0, metavar="S", help="of each scene; default 5")


def estimator(parser: argparse.ArgumentParser) -> None:
    """Which worlds, how long and how many of each."""
    parser.add_argument("--only", default="*", metavar="PATTERN", help="scenes by name, e.g. 'breathing, c*'")
    parser.add_argument("--maps", nargs="+", choices=WHOSE, default=WHOSE, help="whose map")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="worlds of each scene")
    parser.add_argument("--seconds", type=float, metavar="S", help="length of each world; 10 s or more without")
    parser.add_argument("--count", type=int, default=100, metavar="N", help="landmarks")
    parser.add_argument("--noise", type=float, default=0.25, metavar="PX", help="white, where a scene has no own")
    parser.add_argument("--soak", type=float, metavar="HOURS", help="instead: one long run of breathing")


def faults(parser: argparse.ArgumentParser) -> None:
    """The campaign's size."""
    parser.add_argument("--count", type=int, default=60, help="faults, of all kinds in turn (default: 60)")
    parser.add_argument("--seed", type=int, default=1, help="of all that chance decides (default: 1)")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share the runs (default: 1)")
    parser.add_argument(
        "--log", type=Path, metavar="X.csv", help="what came of each fault; runs in it are not repeated"
    )
    parser.add_argument(
        "--scenarios", type=Path, metavar="FOLDER", help="where the scenarios are (default: the shipped)"
    )


def fill(parser: argparse.ArgumentParser) -> None:
    """Which contours and how many wounds."""
    parser.add_argument("contours", nargs="*", type=Path, metavar="CSV", help="x_mm,y_mm; two own without")
    parser.add_argument("--kind", choices=KINDS, default="best", help="pattern; default best")
    parser.add_argument("--contour-width", type=float, default=0.8, metavar="MM", help="bead in contours; default 0.8")
    parser.add_argument("--width", type=float, default=0.4, metavar="MM", help="bead of the wounds; default 0.4")
    parser.add_argument("--count", type=int, default=1000, metavar="N", help="random wounds; default 1000")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path, metavar="SVG", help="also draw all patterns side by side")


def fuzz(parser: argparse.ArgumentParser) -> None:
    """How many inputs, and for whom."""
    parser.add_argument(
        "--count", type=int, default=20_000, help="inputs, of all readers in equal shares (default: 20000)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of what is made wrong (default: 1)")
    parser.add_argument("--only", metavar="READER", help="one reader; see the table for their names")
    parser.add_argument("--jobs", type=int, default=1, help="readers at a time, a process each (default: 1)")
    parser.add_argument(
        "--log", type=Path, metavar="X.csv", help="how far each reader is, and what went wrong; goes on from there"
    )


def growth(parser: argparse.ArgumentParser) -> None:
    """How long, and whether pictures are rendered."""
    parser.add_argument("--seconds", type=float, default=4.0, metavar="S", help="of each world; default 4")
    parser.add_argument("--no-pictures", action="store_true", help="leave out resolution, which has to be rendered")


def latency(parser: argparse.ArgumentParser) -> None:
    """Sessions to be shown instead of the made recordings, and how long those are."""
    parser.add_argument("sessions", nargs="*", type=Path, metavar="SESSION", help="recorded sessions to show instead")
    parser.add_argument("--seconds", type=float, default=5.0, metavar="S", help="of each made recording; default 5")
    parser.add_argument(
        "--scene", nargs="+", choices=MADE, default=["chest, breathing"], metavar="NAME", help="; ".join(MADE)
    )


def link(parser: argparse.ArgumentParser) -> None:
    """How long each part runs."""
    parser.add_argument("--hours", type=float, default=1.0, metavar="H", help="of virtual time; default 1")
    parser.add_argument("--minutes", type=float, default=0.0, metavar="M", help="of real time on a pty; default none")
    parser.add_argument("--commands", type=int, default=100_000, metavar="N", help="random ones before the guard")
    parser.add_argument("--baud", type=int, default=115_200, metavar="B", help="of the line in virtual time")
    parser.add_argument("--only", choices=("guard",), help="the guard alone")
    parser.add_argument("--seed", type=int, default=0, help="of the first run")
    parser.add_argument(
        "--busy", type=int, default=1, metavar="N", help="processes that saturate a core each; default 1"
    )
    parser.add_argument("--ordinary", action="store_true", help="do not ask for real-time priority")


def live(parser: argparse.ArgumentParser) -> None:
    """How long, how many, before what."""
    parser.add_argument("--minutes", type=float, default=1.0, metavar="M", help="of printing; 0: none; default 1")
    parser.add_argument("--stops", type=int, default=3, metavar="N", help="in a run of their own; default 3")
    parser.add_argument("--kills", type=int, default=0, metavar="N", help="of random processes; default none")
    parser.add_argument("--seed", type=int, default=0, help="of what is killed when")
    parser.add_argument("--pinned", action="store_true", help="motion and recorder on one core, tracking on the other")
    parser.add_argument(
        "--scenario", type=Path, default=Path("data/live/calm.toml"), metavar="SCENARIO.toml", help="which world"
    )


def loop(parser: argparse.ArgumentParser) -> None:
    """Which scenarios, and how chance falls."""
    parser.add_argument("--scenario", nargs="+", default=list(BREATHING), choices=BREATHING, metavar="NAME", help="of "
                        f"{', '.join(BREATHING)} (default: all)")  # fmt: skip
    parser.add_argument("--seed", type=int, default=1, help="of the tracks' noise (default: 1)")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share the prints (default: 1)")


def mapping(parser: argparse.ArgumentParser) -> None:
    """How long each surface is looked at."""
    parser.add_argument("--seconds", type=float, default=3.0, metavar="S", help="of each still standing; default 3")


def outages(parser: argparse.ArgumentParser) -> None:
    """The campaign's size."""
    parser.add_argument("--count", type=_positive, default=66, help="outages, of all kinds in turn (default: 66)")
    parser.add_argument("--seed", type=int, default=0, help="of scenes, motions and outages (default: 0)")
    parser.add_argument("--processes", type=_positive, default=2, help="that share the scenes (default: 2)")


def plan(parser: argparse.ArgumentParser) -> None:
    """Which body."""
    parser.add_argument("--body", choices=("forearm", "chest", "foot"), default="forearm", help="default forearm")


def planner(parser: argparse.ArgumentParser) -> None:
    """How many updates, and which."""
    parser.add_argument("--updates", type=int, default=10_000, metavar="N", help="in all; default 10000")
    parser.add_argument("--arm", type=Path, metavar="ARM.toml", help="instead of the default arm")
    parser.add_argument("--seed", type=int, default=0, help="of the streams; runs with other seeds may go side by side")


def prediction(parser: argparse.ArgumentParser) -> None:
    """Where the traces are, and how much of each is only learned from."""
    parser.add_argument("--traces", type=Path, metavar="DIR", help="folder of traces: breathing*.tum (default: the "
                        "simulator's breathing)")  # fmt: skip
    parser.add_argument("--pattern", default="breathing*.tum", help="names of the traces in it")
    parser.add_argument("--warm-up", type=float, default=60.0, metavar="S", help="beginning that is not judged")
    parser.add_argument("--seconds", type=float, default=240.0, metavar="S", help="of the simulator's; default 240")


def registration(parser: argparse.ArgumentParser) -> None:
    """How many different bodies of each kind."""
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="bodies of each kind; default 2")


def segmentation(parser: argparse.ArgumentParser) -> None:
    """Where the labelled pictures are, and how many rendered ones are looked at."""
    parser.add_argument("dataset", type=Path, nargs="?", metavar="DATASET", help="folder with images/ and labels/")
    parser.add_argument("--model", type=Path, metavar="X.onnx", help="another network than the one that comes along")
    parser.add_argument("--rendered", type=int, default=60, metavar="N", help="rendered pictures of each kind")
    parser.add_argument("--sheet", type=Path, metavar="X.jpg", help="also draw best, median and worst, 8 of each")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of pieces, covers and sizes drawn")


def smoothing(parser: argparse.ArgumentParser) -> None:
    """Which worlds, how many and how long; and the lengths of the runs that are timed."""
    parser.add_argument(
        "--movements", nargs="*", choices=MOVEMENTS, default=MOVEMENTS, help="of the worlds; none: no worlds"
    )
    parser.add_argument(
        "--scenarios", nargs="*", choices=RENDERED, default=RENDERED, help="rendered, tracked and smoothed"
    )
    parser.add_argument(
        "--rendered", type=float, default=8.0, metavar="S", help="of each scenario; kept rendered; default 8"
    )
    parser.add_argument("--seeds", type=int, default=4, metavar="N", help="worlds of each movement; default 4")
    parser.add_argument("--seconds", type=float, default=6.0, metavar="S", help="of each world; default 6")
    parser.add_argument("--count", type=int, default=100, metavar="N", help="landmarks; default 100")
    parser.add_argument(
        "--minutes", type=float, nargs="*", default=[1.0, 3.0, 10.0], metavar="M", help="runs that are timed"
    )
    parser.add_argument(
        "--landmarks", type=int, nargs="*", default=[200, 400], metavar="N", help="of more runs, a minute each"
    )
    parser.add_argument(
        "--adjusted",
        type=float,
        default=4.0,
        metavar="S",
        help="of the bundle adjustment beside Ceres's; default 4, 0: none",
    )
    parser.add_argument(
        "--sessions", type=int, default=40, metavar="N", help="smoothed by one and by two workers; default 40, 0: none"
    )


def steps(parser: argparse.ArgumentParser) -> None:
    """How many steps, and how many hours at rest."""
    parser.add_argument("--steps", type=int, default=2000, help="of each kind (default: %(default)s)")
    parser.add_argument("--hours", type=float, default=1.0, help="at rest (default: %(default)s)")
    parser.add_argument("--noise", type=float, default=0.1, help="px of a track in a frame (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)


def thesis(parser: argparse.ArgumentParser) -> None:
    """Sessions to be shown instead of the made recordings, and how long those are."""
    parser.add_argument("sessions", nargs="*", type=Path, metavar="SESSION", help="recorded sessions to show instead")
    parser.add_argument("--seconds", type=float, default=4.0, metavar="S", help="of each made recording; default 4")
    parser.add_argument("--method", choices=(THESIS, THESIS_FLOW), default=THESIS, help="which of the thesis's ways")


def tracks(parser: argparse.ArgumentParser) -> None:
    """How long, and how many pictures of it."""
    parser.add_argument("--minutes", type=float, default=10.0, metavar="M", help="that are stood for; default 10")
    parser.add_argument("--pictures", type=int, default=240, metavar="N", help="evenly over them; default 240")


def views(parser: argparse.ArgumentParser) -> None:
    """How long each is looked at."""
    parser.add_argument("--seconds", type=float, default=8.0, metavar="S", help="of each sequence; default 8")


def _positive(text: str) -> int:
    if int(text) < 1:
        raise ValueError(text)
    return int(text)
