"""python -m tests.campaigns NAME: developers' measurements and long campaigns; without a name, a list.

A campaign draws faults or inputs from a seed and checks the results, in larger numbers than the suite. Each prints a
table of figures with their targets and, with -o FOLDER, writes them and a page there. --all measures the figures of
docs/measured.md, which include the subjects of `stillbed bench`.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy, as the command line does

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from estimation.errors import StillbedError
from hardware.bench.subjects import (
    BENCH_WHOLE,
    BREATHING,
    SEED,
    BenchPart,
    Subject,
    Subjects,
    Whole,
    add_options,
    number,
    option,
    positive,
)
from hardware.cli.main import add_bench_options, run_bench
from hardware.cli.parser import Parser

PROGRAM = "python -m tests.campaigns"
DESCRIPTION = "Run a developers' measurement or a long campaign; print each figure with its target."
MOVEMENTS = ("still", "breathing", "irregular", "steps", "turns", "sway", "lively")  # of synthetic worlds
RENDERED = (
    *("still", *BREATHING, "shaking_table_0_5_hz", "steps_300um"),
    *("turns", "hand", "camera_lost", "clock_offsets", "wet_glare", "deformation"),
)  # scenarios
BODIES = ("chest", "forearm", "foot")  # that the simulator has
MAPS = ("told", "seen")  # map of the estimator: true map of the world, or map from its own frames


def _campaign(name: str, module: str, summary: str) -> Callable[..., tuple[str, Subject]]:
    function = f"tests.campaigns.{module}:run_{name}"
    return lambda *options: (name, Subject(function, partial(add_options, options), summary, PROGRAM))


CAMPAIGNS: Subjects = dict(
    (
        _campaign("bumps", "detection", "small shifts of cameras and lenses: detection, identification, false alarms")(
            number("--count", 9, "N", "shifts of each kind; default 9"),
            number("--minutes", 10.0, "M", "duration without shifts; default 10"),
            number("--seed", 0, None, "seed of motions and noise; default 0"),
        ),
        _campaign("cameras", "detection", "pairing of live frames into sets: complete sets, wrong sets, waiting time")(
            number("--minutes", 10.0, None, "duration of three cameras at 30 fps; default 10"), SEED
        ),
        _campaign("consistency", "estimator", "poses from pictures: errors against reported covariance (NEES)")(
            number("--scenes", 2, "N", "scenes, rendered first in some 10 s each; default 2"),
            number("--seed", 300, None, "seed of the first scene (default: 300)"),
            number("--seconds", 5.0, "S", "duration of each scene; default 5"),
        ),
        _campaign("deceit", "deceit.campaign", "sessions made to deceive the tracker: undetected errors, recovery")(
            number("--count", 200, "N", "sessions, of all kinds in turn; default 200"),
            number("--seed", 1, None, "seed of all random numbers; default 1"),
            number("--jobs", 1, None, "parallel processes; default 1"),
            option("--kind", action="append", metavar="NAME", help="only this kind; repeatable"),
            option("--index", type=int, action="append", metavar="N", help="only this session; repeatable"),
            option(
                "--size",
                type=int,
                nargs=2,
                default=(640, 480),
                metavar="PX",
                help="size of the pictures; default 640 480",
            ),
        ),
        _campaign("estimator", "estimator", "the estimator on synthetic tracks: accuracy, consistency, time")(
            option("--only", default="*", metavar="PATTERN", help="patterns of scene names, e.g. 'breathing, c*'"),
            option("--maps", nargs="+", choices=MAPS, default=MAPS, help="map: of the world, or from its own frames"),
            number("--seeds", 3, "N", "number of worlds of each scene"),
            option("--seconds", type=float, metavar="S", help="duration of each world; default: 10 s or more"),
            option("--soak", type=float, metavar="HOURS", help="instead of the scenes: one long run of breathing"),
        ),
        _campaign("faults", "faults", "prints with injected faults: detection, safety, recovery")(
            number("--count", 60, None, "faults, of all kinds in turn (default: 60)"),
            number("--seed", 1, None, "seed of all random numbers (default: 1)"),
            number("--jobs", 1, None, "parallel processes (default: 1)"),
            option(
                "--log", type=Path, metavar="X.csv", help="result of each fault; faults in this file are not repeated"
            ),
        ),
        _campaign("fill", "fill", "beads in contours and random wounds: coverage and time")(
            option(
                "contours", nargs="*", type=Path, metavar="CSV", help="contours, x_mm,y_mm; default: two built-in ones"
            ),
            number("--count", 1000, "N", "number of random wounds; default 1000"),
            SEED,
            option("--picture", type=Path, metavar="SVG", help="also write a picture of all patterns"),
        ),
        _campaign("fuzz", "fuzz", "nearly valid inputs for each reader of external data")(
            number("--count", 20_000, None, "inputs, in equal shares for all readers (default: 20000)"),
            number("--seed", 1, None, "seed of the errors (default: 1)"),
            option("--only", metavar="READER", help="only this reader; names as in the table"),
            number("--jobs", 1, None, "parallel processes, one reader each (default: 1)"),
            option(
                "--log",
                type=Path,
                metavar="X.csv",
                help="progress and failures of each reader; the campaign continues from this file",
            ),
        ),
        _campaign("growth", "growth", "processing time against tracks, cameras, pixels, checkpoints, minutes")(
            number("--seconds", 4.0, "S", "duration of each world; default 4"),
            option("--no-pictures", action="store_true", help="omit the resolution, which needs rendering"),
        ),
        _campaign("guard", "guard", "random commands at all limits of the guard")(
            number("--commands", 100_000, "N", "number of random commands (default: 100000)"), SEED
        ),
        _campaign("link", "link", "the arm's link in virtual time with injected faults")(
            number("--hours", 1.0, "H", "duration in virtual time; default 1"),
            SEED,
        ),
        _campaign("look", "scan", "layers of gel measured by the inspection between layers; clog detection")(
            number("--layers", 36, "N", "layers on empty beds, every sixth with a clog; default 36"),
            number("--stacks", 8, "N", "stacks of three layers, three of four with a clog; default 8"),
        ),
        _campaign(
            "map", "mapping", "landmarks: distance from the true surface against reported sigma; growth of the map"
        )(number("--seconds", 3.0, "S", "duration of each rest; default 3")),
        _campaign("outages", "outages", "cameras covered, dead, frozen, swapped, shifted: undetected loss, recovery")(
            option("--count", type=positive, default=66, help="outages, of all kinds in turn (default: 66)"),
            number("--seed", 0, None, "seed of scenes, motions and outages (default: 0)"),
            option("--processes", type=positive, default=2, help="parallel processes (default: 2)"),
        ),
        _campaign("plan", "fill", "complete plan of a large wound: time, memory, coverage, ink")(
            option("--body", choices=BODIES, default="forearm", help="body; default forearm")
        ),
        _campaign("planner", "planner", "random poses for planner and guard: limits, time of a step")(
            number("--updates", 10_000, "N", "total number of poses; default 10000"),
            number("--seed", 0, None, "seed of the streams; runs with other seeds can run in parallel"),
        ),
        _campaign("registration", "mapping", "registration of a scan to the first pictures: error and verdict")(
            number("--seeds", 2, "N", "number of bodies of each kind; default 2")
        ),
        _campaign("scan", "scan", "scans by the cameras, wet and dry: distance from the true surface")(
            option(
                "--bodies",
                nargs="+",
                choices=BODIES,
                default=BODIES,
                metavar="NAME",
                help=f"bodies, of {', '.join(BODIES)}",
            ),
            number("--sets", 6, "N", "fused frame sets; default 6"),
        ),
        _campaign("smoothing", "smoothing", "smoothed poses compared with causal poses; clock offsets; time")(
            option(
                "--movements",
                nargs="*",
                choices=MOVEMENTS,
                default=MOVEMENTS,
                help="movements of the worlds; none: no worlds",
            ),
            option(
                "--scenarios",
                nargs="*",
                choices=RENDERED,
                default=RENDERED,
                help="scenarios to render, track and smooth",
            ),
            number("--rendered", 8.0, "S", "duration of each scenario; renderings are cached; default 8"),
            number("--seeds", 4, "N", "number of worlds of each movement; default 4"),
            number("--seconds", 6.0, "S", "duration of each world; default 6"),
            number("--count", 100, "N", "number of landmarks; default 100"),
            option(
                "--minutes",
                type=float,
                nargs="*",
                default=[1.0, 3.0, 10.0],
                metavar="M",
                help="durations of timed runs",
            ),
            option(
                "--landmarks",
                type=int,
                nargs="*",
                default=[200, 400],
                metavar="N",
                help="numbers of landmarks of further runs, a minute each",
            ),
            number(
                "--adjusted", 4.0, "S", "duration of the comparison with Ceres's bundle adjustment; default 4, 0: none"
            ),
            number("--sessions", 40, "N", "sessions, smoothed by one and by two workers; default 40, 0: none"),
        ),
        _campaign("steps", "detection", "motion steps of 300 um and 0.1 degree: detection time, false alarms")(
            number("--steps", 2000, None, "steps of each kind (default: %(default)s)"),
            number("--hours", 1.0, None, "duration at rest (default: %(default)s)"),
            SEED,
        ),
        _campaign("views", "views", "deforming skin, grazing views with glare, edges of a cube")(
            number("--seconds", 8.0, "S", "duration of each sequence; default 8")
        ),
        _campaign("wounds", "wounds", "wounds in bodies: detection, restored skin, volume, normal")(
            option(
                "bodies",
                nargs="*",
                type=Path,
                metavar="MESH",
                help="meshes of bodies or limbs, mm; default: five built-in ones",
            ),
            number("--count", 40, "N", "number of wounds; default 40"),
            SEED,
        ),
    )
)


OWN_MAPS = "--maps", "seen", "--only"  # of several seeds: the frame's own error is one draw for a whole world


def _part(subject: str, *options: str, name: str = "", quick: tuple[str, ...] | None = None) -> BenchPart:
    return BenchPart(subject, options, quick, name, PROGRAM)


WHOLE = Whole(
    f"{PROGRAM} --all",
    (
        _part(
            "estimator", *OWN_MAPS, "breathing, [cno]*", "--seeds", "6", "--seconds", "4",
            quick=(*OWN_MAPS, "breathing, clean", "--seeds", "2", "--seconds", "4"),
        ),
        _part("consistency", "--scenes", "1"),
        _part("estimator", "--maps", "seen", "--soak", "0.05", name="memory"),
        _part("steps", "--steps", "500", "--hours", "0.2"),
        _part("plan"),
        _part("fill", "--count", "60", quick=("--count", "3")),
        _part("planner", "--updates", "20000", quick=("--updates", "2000")),
        *BENCH_WHOLE.parts,
        _part("registration", "--seeds", "1"),
        _part("growth", "--seconds", "2"),
    ),
)  # fmt: skip


def main(words: list[str]) -> int:
    """Run what the words of a command line ask for; the exit code."""
    parser = Parser(prog=PROGRAM, description=DESCRIPTION)
    add_bench_options(parser)
    try:
        run_bench(parser.parse_args(words), CAMPAIGNS, WHOLE)
    except StillbedError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
