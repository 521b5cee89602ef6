"""`stillbed calibrate`: its command line. Imports lazily."""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hardware.cli.calibrate_arm import add_calibrate_arm
from hardware.cli.parser import INTERRUPTED, Commands, add_command, positive

if TYPE_CHECKING:
    from hardware.calibration.live import WavingPage
    from hardware.process.clock import Clock


RIG_FORMATS = {
    "opencv": "a YAML per camera",
    "ros": "camera_info, a YAML per camera",
    "kalibr": "camchain.yaml",
    "anipose": "aniposelib's and caliscope's TOML, mm",
}
NOT_GOOD_ENOUGH = 1  # exit code of a calibration that is not good enough


def add_calibrate(commands: Commands) -> None:
    """Add the sub-command `calibrate`."""
    command = add_command(
        commands,
        "calibrate",
        "calibrate cameras from a printed board, and the arm: board, cameras, arm, import, export",
        "Print a board, wave it before the cameras, and get a rig that says how far it can be trusted.",
        "stillbed calibrate cameras sessions/board --board board.toml -o rig.toml",
    )
    parts = command.add_subparsers(metavar="WHAT", required=True)
    _add_board(parts)
    _add_cameras(parts)
    add_calibrate_arm(parts)
    _add_import(parts)
    _add_export(parts)


def _add_board(parts: Commands) -> None:
    part = add_command(
        parts,
        "board",
        "a printable board at true scale, with a ruler to check the print by",
        "Draw a calibration board at true scale, and write the board.toml that describes it beside it. Print it at\n"
        "100 %, measure the ruler and a square, and mount the sheet on something flat.",
        "stillbed calibrate board -o board.pdf",
        "stillbed calibrate board -o board.svg --page A3 --square-mm 30 --squares 8x11",
    )
    add = part.add_argument
    add("-o", "--out", type=Path, required=True, metavar="X.pdf", help=".pdf or .svg; board.toml beside it")
    add("--kind", choices=("charuco", "chessboard"), default="charuco", help="default charuco")
    add("--squares", type=_pair, metavar="CxR", help="columns x rows; default: as many as fit the page")
    add("--square-mm", type=positive, default=25.0, metavar="MM", help="edge of a square; default 25")
    add("--marker", type=float, default=0.75, metavar="SHARE", help="of a square's edge; default 0.75")
    add("--dictionary", default="4X4_50", metavar="NAME", help="of the markers; default 4X4_50")
    add("--inverted", action="store_true", help="exchange black and white")
    add("--page", default="A4", metavar="SIZE", help="A5, A4, A3, A2, letter, or WxH in mm; default A4")
    add("--force", action="store_true", help="overwrite X.pdf and the board.toml beside it")
    part.set_defaults(run=_board)


def _add_cameras(parts: Commands) -> None:
    part = add_command(
        parts,
        "cameras",
        "lenses, places and clock offsets from a waved board, recorded or live",
        "From a recording, or from live cameras while the board is being waved: it then says where to\n"
        "hold the board next, here and on a page in the browser, and ends once enough was seen. Ctrl-C keeps the\n"
        "corners; the same command goes on.",
        "stillbed calibrate cameras sessions/board --board board.toml -o rig.toml",
        "stillbed calibrate cameras /dev/v4l/by-id/CAMERA_A /dev/v4l/by-id/CAMERA_B --board board.toml -o rig.toml",
    )
    add = part.add_argument
    add(
        "which",
        nargs="+",
        metavar="SESSION_OR_CAMERA",
        help="session folder or .mcap (its rig may lack lenses); or live cameras as `stillbed cameras` names them, "
        "or RIG.toml for all of a rig",
    )
    add("--seconds", type=float, metavar="S", help="watch live cameras so long at most; default: until enough was seen")
    add("--no-page", action="store_true", help="with live cameras: without the page in the browser")
    add("--board", type=Path, required=True, metavar="board.toml", help="the board as it was printed")
    add("-o", "--out", type=Path, required=True, metavar="rig.toml", help="file to write; report beside it")
    add("--limit-mm", type=positive, default=0.1, metavar="MM", help="predicted error to pass; default 0.1")
    add(
        "--distance-mm", type=_distance, metavar="A,B,MM", help="two cameras and how far apart they are, to check scale"
    )
    add(
        "--keep-lenses",
        action="store_true",
        help="take the session's lenses, within their lens_sigma; seek places and clocks",
    )
    add("--new-rig", action="store_true", help="do not compare with the session's own rig")
    add("--force", action="store_true", help="overwrite rig.toml and what stands beside it")
    part.set_defaults(run=_cameras)


def _add_import(parts: Commands) -> None:
    part = add_command(
        parts,
        "import",
        "a rig.toml from another program's calibration",
        "Turn another program's calibration into a rig.toml. Where each camera's images are is to be added to it.",
        "stillbed calibrate import camchain.yaml --format kalibr -o rig.toml",
    )
    add = part.add_argument
    add("file", type=Path, metavar="FILE", help="its file, or folder of a file per camera")
    add("--format", choices=RIG_FORMATS, required=True, help="; ".join(f"{k}: {v}" for k, v in RIG_FORMATS.items()))
    add("-o", "--out", type=Path, required=True, metavar="rig.toml", help="file to write")
    add("--force", action="store_true", help="overwrite the file")
    part.set_defaults(run=_import)


def _add_export(parts: Commands) -> None:
    part = add_command(
        parts,
        "export",
        "a rig.toml in another program's format",
        "Write a rig.toml as another program reads it: lenses and places, and what else its format can hold.",
        "stillbed calibrate export rig.toml --format kalibr -o camchain.yaml",
    )
    add = part.add_argument
    add("rig", type=Path, metavar="rig.toml", help="a calibrated rig")
    add("--format", choices=RIG_FORMATS, required=True, help="; ".join(f"{k}: {v}" for k, v in RIG_FORMATS.items()))
    add("-o", "--out", type=Path, required=True, metavar="OUT", help="file, or folder, to write")
    add("--force", action="store_true", help="overwrite the file, or write into a folder that is not empty")
    part.set_defaults(run=_export)


def _pair(text: str) -> tuple[int, int]:
    columns, _, rows = text.lower().partition("x")
    try:
        return int(columns), int(rows)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}, needed is COLUMNSxROWS, as 7x10") from None


def _distance(text: str) -> tuple[str, str, float]:
    try:
        one, other, distance = text.split(",")
        return one, other, float(distance)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}, needed is CAMERA,CAMERA,MM") from None


def _board(arguments: argparse.Namespace) -> int:
    from hardware.calibration.board_print import PrintOptions, write_print

    a = arguments
    wish = PrintOptions(a.kind, a.squares, a.square_mm, a.marker, a.dictionary, a.inverted, a.page)
    print(write_print(a.out, wish, a.force))
    return 0


def _cameras(arguments: argparse.Namespace) -> int:
    from hardware.calibration.run import CalibrationOptions, corners_of, run_calibration, run_live
    from hardware.process.clock import WallClock
    from hardware.process.progress import Progress, check_new

    a, clock = arguments, WallClock()
    check_new(a.out, a.force)
    recorded = _recorded(a.which)
    wishes = CalibrationOptions(a.limit_mm, a.distance_mm, a.keep_lenses, a.new_rig)
    _check_seconds(a.seconds, recorded)
    try:
        with Progress("corners", "frame sets", clock.now) as progress:
            if recorded is not None:
                outcome = run_calibration(recorded, a.board, a.out, wishes, progress)
            else:
                open_page = nullcontext if a.no_page else partial(_opened_page, clock)
                outcome = run_live(a.which, a.board, a.out, wishes, a.seconds, clock, progress, open_page)
    except KeyboardInterrupt:
        kept = f"the corners so far are in {corners_of(a.out)}; the same command goes on from there"
        print(f"\nstillbed: interrupted; {kept}", file=sys.stderr)
        return INTERRUPTED
    print(outcome.text)
    return 0 if outcome.verdict.passed else NOT_GOOD_ENOUGH


def _opened_page(clock: Clock) -> WavingPage:
    """The page, and where it is."""
    from hardware.calibration.live import WavingPage

    page = WavingPage(clock)
    print(f"open {page.address} to see where to hold the board", file=sys.stderr, flush=True)
    return page


def _recorded(which: list[str]) -> Path | None:
    """The one recording that is named, None where live cameras are."""
    path = Path(which[0])
    named = path.is_dir() or path.suffix == ".mcap"
    return path if named and len(which) == 1 else None


def _check_seconds(seconds: float | None, recorded: Path | None) -> None:
    from estimation.errors import InputError

    if seconds is not None and (recorded is not None or not seconds >= 0):
        raise InputError("command line", "--seconds", seconds, "0 or more, with live cameras")


def _import(arguments: argparse.Namespace) -> int:
    from hardware.calibration.rig_formats import FORMATS
    from hardware.files.rig_file import write_rig
    from hardware.process.progress import check_new

    check_new(arguments.out, arguments.force)
    rig = FORMATS[arguments.format].read(arguments.file)
    write_rig(arguments.out, rig, [None] * len(rig))
    print(f"{arguments.out}: {', '.join(c.name for c in rig.cameras)}; where their images are is to be added")
    return 0


def _export(arguments: argparse.Namespace) -> int:
    from hardware.calibration.rig_formats import FORMATS
    from hardware.files.rig_file import read_rig
    from hardware.process.progress import check_new

    check_new(arguments.out, arguments.force)
    rig = read_rig(arguments.rig).rig
    FORMATS[arguments.format].write(arguments.out, rig)
    print(f"{arguments.out}: {', '.join(c.name for c in rig.cameras)}")
    return 0
