"""`stillbed compare`: its command line; what does the work is loaded when it is asked for."""

from __future__ import annotations

import argparse
from pathlib import Path

from hardware.cli.parser import Commands


def add_compare(commands: Commands) -> None:
    """Add the sub-command `compare`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "compare",
        help="one trajectory judged by another: APE, RPE, NEES",
        description="Judge poses by others of the same instants, in the numbers that evo gives: absolute and relative\n"
        "errors, translation and rotation, as they stand and aligned, without scale; and NEES where there are\n"
        "covariances. Each of the two is a TUM or CSV file, an .mcap file, or a folder that stillbed wrote; of an\n"
        ".mcap file FILE:smoothed, FILE:pose or FILE:truth. Writes report.html and compare.json with -o.",
        epilog="example:\n  stillbed compare out/smoothed out/calm/session/truth.tum -o out/compared",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("estimated", metavar="A", help="the poses that are judged")
    command.add_argument("reference", metavar="B", nargs="?", help="what they are judged by; default: the truth in A")
    command.add_argument(
        "--delta", type=int, default=1, metavar="N", help="poses over which relative errors are counted; default 1"
    )
    command.add_argument("-o", "--out", type=Path, help="folder to write report.html and compare.json to")
    command.set_defaults(run=_compare)


def _compare(arguments: argparse.Namespace) -> None:
    from hardware.comparing.run import run_compare

    a = arguments
    print(run_compare(a.estimated, a.reference, a.delta, a.out))
