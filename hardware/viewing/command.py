"""`stillbed view`: its command line; what does the work is loaded when it is asked for."""

from __future__ import annotations

import argparse
from pathlib import Path

from hardware.cli.parser import Commands


def add_view(commands: Commands) -> None:
    """Add the sub-command `view`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "view",
        help="a recorded session in a browser, with a slider over its time",
        description="Show a recorded or smoothed session in a browser of this machine: the cameras' pictures with the\n"
        "tracks, the surface in three dimensions with cameras, trajectory, path and nozzle, and the state, at any of\n"
        "its instants. Prints the address to open; nothing is written. Ctrl-C ends it.",
        epilog="example:\n  stillbed view out/smoothed",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument(
        "session", type=Path, metavar="SESSION", help="session folder, .mcap file, or what stillbed smooth wrote of one"
    )
    command.add_argument("--poses", metavar="FILE", help="other poses than the recording's, as stillbed compare reads")
    command.add_argument("--path", type=Path, metavar="PATH.csv", help="the path, where the recording has none")
    command.add_argument("--port", type=int, default=0, metavar="N", help="of 127.0.0.1; default: whichever is free")
    command.set_defaults(run=_view)


def _view(arguments: argparse.Namespace) -> None:
    from hardware.viewing.run import run_view

    a = arguments
    run_view(a.session, a.poses, a.path, a.port)
