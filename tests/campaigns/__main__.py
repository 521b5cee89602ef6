"""python -m tests.campaigns NAME: what developers measure, and long campaigns; without a name, a list.

A campaign draws from a seed what goes wrong and judges what came of it, which the suite can only touch. Each prints a
table of figures beside their targets and, with -o FOLDER, writes them and a page there. --all measures what
docs/measured.md tells, the subjects of `stillbed bench` among it.
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
DESCRIPTION = "Measure what developers ask of stillbed, or run a long campaign; print each figure beside its target."
MOVEMENTS = ("still", "breathing", "irregular", "steps", "turns", "sway", "lively")  # of synthetic worlds
RENDERED = (
    *("still", *BREATHING, "shaking_table_0_5_hz", "steps_300um"),
    *("turns", "hand", "camera_lost", "clock_offsets", "wet_glare", "deformation"),
)  # scenarios
BODIES = ("chest", "forearm", "foot")  # that the simulator has
MAPS = ("told", "seen")  # whose map the estimator has: the world's own, or one that it made


def _campaign(name: str, module: str, summary: str) -> Callable[..., tuple[str, Subject]]:
    function = f"tests.campaigns.{module}:run_{name}"
    return lambda *options: (name, Subject(function, partial(add_options, options), summary, PROGRAM))


CAMPAIGNS: Subjects = dict(
    (
        _campaign("bumps", "detection", "cameras knocked and lenses turned by little: found, named, false alarms")(
            number("--count", 9, "N", "of each knock; default 9"),
            number("--minutes", 10.0, "M", "of calm; default 10"),
            number("--seed", 0, None, "of motions and noise; default 0"),
        ),
        _campaign("cameras", "detection", "frames of live cameras put into sets: complete, wrong, waited for")(
            number("--minutes", 10.0, None, "of three cameras at 30 fps; default 10"), SEED
        ),
        _campaign("consistency", "estimator", "poses from pictures: are errors as large as is claimed?")(
            number("--scenes", 2, "N", "rendered first, some 10 s each; default 2"),
            number("--seed", 300, None, "of the first scene (default: 300)"),
            number("--seconds", 5.0, "S", "of each scene; default 5"),
        ),
        _campaign(
            "deceit", "deceit.campaign", "sessions made to fool the tracker: silently wrong, and back again after"
        )(
            number("--count", 200, "N", "sessions, of all kinds in turn; default 200"),
            number("--seed", 1, None, "of all that is drawn; default 1"),
            number("--jobs", 1, None, "processes that share the sessions; default 1"),
            option("--kind", action="append", metavar="NAME", help="only this kind; may be given again"),
            option("--index", type=int, action="append", metavar="N", help="only this session; may be given again"),
            option("--size", type=int, nargs=2, default=(640, 480), metavar="PX", help="of pictures; default 640 480"),
        ),
        _campaign("estimator", "estimator", "the estimator on synthetic tracks: accuracy, honesty, time")(
            option("--only", default="*", metavar="PATTERN", help="scenes by name, e.g. 'breathing, c*'"),
            option("--maps", nargs="+", choices=MAPS, default=MAPS, help="whose map"),
            number("--seeds", 3, "N", "worlds of each scene"),
            option("--seconds", type=float, metavar="S", help="length of each world; 10 s or more without"),
            option("--soak", type=float, metavar="HOURS", help="instead: one long run of breathing"),
        ),
        _campaign("faults", "faults", "prints in which everything goes wrong: said, harmless, back soon?")(
            number("--count", 60, None, "faults, of all kinds in turn (default: 60)"),
            number("--seed", 1, None, "of all that chance decides (default: 1)"),
            number("--jobs", 1, None, "processes that share the runs (default: 1)"),
            option("--log", type=Path, metavar="X.csv", help="what came of each fault; runs in it are not repeated"),
        ),
        _campaign("fill", "fill", "beads laid into contours and random wounds: coverage and time")(
            option("contours", nargs="*", type=Path, metavar="CSV", help="x_mm,y_mm; two own without"),
            number("--count", 1000, "N", "random wounds; default 1000"),
            SEED,
            option("--picture", type=Path, metavar="SVG", help="also draw all patterns side by side"),
        ),
        _campaign("fuzz", "fuzz", "every reader of what comes from outside, given what is nearly valid")(
            number("--count", 20_000, None, "inputs, of all readers in equal shares (default: 20000)"),
            number("--seed", 1, None, "of what is made wrong (default: 1)"),
            option("--only", metavar="READER", help="one reader; see the table for their names"),
            number("--jobs", 1, None, "readers at a time, a process each (default: 1)"),
            option(
                "--log",
                type=Path,
                metavar="X.csv",
                help="how far each reader is, and what went wrong; goes on from there",
            ),
        ),
        _campaign("growth", "growth", "how cost grows: with tracks, cameras, pixels, checkpoints, minutes")(
            number("--seconds", 4.0, "S", "of each world; default 4"),
            option("--no-pictures", action="store_true", help="leave out resolution, which has to be rendered"),
        ),
        _campaign("guard", "guard", "random commands on and beside all limits before the guard")(
            number("--commands", 100_000, "N", "random ones (default: 100000)"), SEED
        ),
        _campaign("link", "link", "the arm's line in virtual time with everything going wrong")(
            number("--hours", 1.0, "H", "of virtual time; default 1"),
            SEED,
        ),
        _campaign("look", "scan", "layers of gel, as a look between layers measures them; clogs found")(
            number("--layers", 36, "N", "on bare beds, every sixth with a clog; default 36"),
            number("--stacks", 8, "N", "of three layers each, three of four with a clog; default 8"),
        ),
        _campaign("map", "mapping", "landmarks off the true surface beside their claim, and the map's growth")(
            number("--seconds", 3.0, "S", "of each still standing; default 3")
        ),
        _campaign("outages", "outages", "cameras covered, dead, frozen, swapped, bumped: lost in silence?")(
            option("--count", type=positive, default=66, help="outages, of all kinds in turn (default: 66)"),
            number("--seed", 0, None, "of scenes, motions and outages (default: 0)"),
            option("--processes", type=positive, default=2, help="that share the scenes (default: 2)"),
        ),
        _campaign("plan", "fill", "a whole plan of a large wound: time, memory, coverage, ink")(
            option("--body", choices=BODIES, default="forearm", help="default forearm")
        ),
        _campaign("planner", "planner", "random poses into planner and guard: limits kept, cost of a step")(
            number("--updates", 10_000, "N", "in all; default 10000"),
            number("--seed", 0, None, "of the streams; runs with other seeds may go side by side"),
        ),
        _campaign("registration", "mapping", "a scan laid into the first pictures: error and verdict")(
            number("--seeds", 2, "N", "bodies of each kind; default 2")
        ),
        _campaign("scan", "scan", "what the cameras scan themselves, wet and dry, off the true surface")(
            option(
                "--bodies", nargs="+", choices=BODIES, default=BODIES, metavar="NAME", help=f"of {', '.join(BODIES)}"
            ),
            number("--sets", 6, "N", "frame sets that are fused; default 6"),
        ),
        _campaign("smoothing", "smoothing", "smoothed poses beside causal ones, clocks, time by length")(
            option(
                "--movements", nargs="*", choices=MOVEMENTS, default=MOVEMENTS, help="of the worlds; none: no worlds"
            ),
            option("--scenarios", nargs="*", choices=RENDERED, default=RENDERED, help="rendered, tracked and smoothed"),
            number("--rendered", 8.0, "S", "of each scenario; kept rendered; default 8"),
            number("--seeds", 4, "N", "worlds of each movement; default 4"),
            number("--seconds", 6.0, "S", "of each world; default 6"),
            number("--count", 100, "N", "landmarks; default 100"),
            option(
                "--minutes", type=float, nargs="*", default=[1.0, 3.0, 10.0], metavar="M", help="runs that are timed"
            ),
            option(
                "--landmarks", type=int, nargs="*", default=[200, 400], metavar="N", help="of more runs, a minute each"
            ),
            number("--adjusted", 4.0, "S", "of the bundle adjustment beside Ceres's; default 4, 0: none"),
            number("--sessions", 40, "N", "smoothed by one and by two workers; default 40, 0: none"),
        ),
        _campaign("steps", "detection", "movements of 300 um and 0.1 degree: how soon flagged, how often falsely")(
            number("--steps", 2000, None, "of each kind (default: %(default)s)"),
            number("--hours", 1.0, None, "at rest (default: %(default)s)"),
            SEED,
        ),
        _campaign("views", "views", "skin that deforms, grazing views with glare, a cube's edges")(
            number("--seconds", 8.0, "S", "of each sequence; default 8")
        ),
        _campaign("wounds", "wounds", "wounds carved into bodies: found, the skin restored, its volume and its normal")(
            option("bodies", nargs="*", type=Path, metavar="MESH", help="of persons or limbs, mm; five own without"),
            number("--count", 40, "N", "wounds; default 40"),
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
