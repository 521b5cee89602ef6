"""`stillbed smooth`: its command line; what does the work is loaded when it is asked for."""

from __future__ import annotations

import argparse
from pathlib import Path

from hardware.cli.parser import Commands

FAILED = 1  # exit code where one of several sessions could not be smoothed


def add_smooth(commands: Commands) -> None:
    """Add the sub-command `smooth`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "smooth",
        help="the best estimate of recorded sessions, from all frame sets at once",
        description="Estimate all poses of a recorded session, its landmarks and its cameras' clocks at once, looking\n"
        "ahead as well as back. Tracks are those of the recording; where it has none, its images are tracked first.\n"
        "Then all images are searched for landmarks that the tracks do not have there, and all is smoothed again.\n"
        "Writes smoothed.tum, smoothed.csv (covariances and twists), rig.toml (the cameras as corrected), map.ply,\n"
        "summary.json, report.html and, of an .mcap file, smoothed.mcap: a copy with the channel /smoothed.\n"
        "Of several sessions, and of those in a folder of sessions, each gets a folder of its own; one that fails\n"
        "does not stop the others (exit code 1), and sessions.csv has a line for each. What is done already is not\n"
        "done again. With --scheduler they are smoothed on a Dask cluster, a task each.",
        epilog="examples:\n  stillbed smooth out/calm/session.mcap -o out/smoothed --rate 1000\n"
        "  stillbed smooth sessions/ -o out/all --scheduler local --workers 4",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument(
        "sessions", type=Path, nargs="+", metavar="SESSION", help="session folder, .mcap file, or a folder of such"
    )
    command.add_argument("-o", "--out", type=Path, required=True, help="folder to write to")
    command.add_argument("--rate", type=float, metavar="HZ", help="rows of smoothed.csv a second; default: the stamps")
    command.add_argument(
        "--refine-cameras",
        action="store_true",
        help="let the recording also correct the cameras' places and lenses, with their calibration as prior",
    )
    command.add_argument(
        "--no-relink",
        action="store_true",
        help="take the tracks as they are; without it, all images are searched for landmarks that the tracks do not "
        "say to be seen, such as before they joined the map",
    )
    command.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask scheduler, such as tcp://host:8786, whose workers reach sessions and OUT under the same paths; "
        "local: start one here; needs the extra [cluster]",
    )
    command.add_argument("--workers", type=int, metavar="N", help="processes of --scheduler local; default: the cores")
    command.set_defaults(run=_smooth)


def _smooth(arguments: argparse.Namespace) -> int:
    from estimation.errors import InputError
    from hardware.offline.smooth import Cluster, run_smooth
    from hardware.smoothing.run import Wishes

    a, failed = arguments, 0
    if a.workers is not None and a.scheduler != "local":
        raise InputError("command line", "--workers", a.workers, "with --scheduler local")
    cluster = None if a.scheduler is None else Cluster(a.scheduler, a.workers)
    wishes = Wishes(a.rate, a.refine_cameras, relink=not a.no_relink)
    for outcome in run_smooth(a.sessions, a.out, wishes, cluster):
        print(f"{outcome.job.session}: not smoothed: {outcome.text}" if outcome.failed else outcome.text, flush=True)
        failed += outcome.failed
    return FAILED if failed else 0
