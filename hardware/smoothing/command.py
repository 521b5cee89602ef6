"""`stillbed smooth`: its command line; what does the work is loaded when it is asked for."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

Commands = Any  # argparse's own type for this is private

FAILED = 1  # exit code where one of several sessions could not be smoothed


def add_smooth(commands: Commands) -> None:
    """Add the sub-command `smooth`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "smooth",
        help="the best estimate of recorded sessions, from all frame sets at once",
        description="Estimate all poses of a recorded session, its landmarks and its cameras' clocks at once, looking\n"
        "ahead as well as back. Tracks are those of the recording; where it has none, its images are tracked first.\n"
        "Writes smoothed.tum, smoothed.csv (covariances and twists), rig.toml (the cameras as corrected), map.ply,\n"
        "summary.json, report.html and, of an .mcap file, smoothed.mcap: a copy with the channel /smoothed.\n"
        "Of several sessions each gets a folder of its own; one that fails does not stop the others (exit code 1).\n"
        "What is done already is not done again.",
        epilog="example:\n  stillbed smooth out/calm/session.mcap -o out/smoothed --rate 1000",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("sessions", type=Path, nargs="+", metavar="SESSION", help="session folder or .mcap file")
    command.add_argument("-o", "--out", type=Path, required=True, help="folder to write to")
    command.add_argument("--rate", type=float, metavar="HZ", help="rows of smoothed.csv a second; default: the stamps")
    command.add_argument(
        "--refine-cameras",
        action="store_true",
        help="let the recording also correct the cameras' places and lenses, with their calibration as prior",
    )
    command.set_defaults(run=_smooth)


def _smooth(arguments: argparse.Namespace) -> int:
    from hardware.smoothing.run import Wishes, run_smooth

    a, failed = arguments, 0
    for text, good in run_smooth(a.sessions, a.out, Wishes(a.rate, a.refine_cameras)):
        print(text, flush=True)
        failed += not good
    return FAILED if failed else 0
