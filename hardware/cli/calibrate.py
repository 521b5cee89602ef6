"""`stillbed calibrate`: its command line. Imports lazily."""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

from estimation.errors import InputError
from hardware.cli.dispenser import add_calibrate_dispenser
from hardware.cli.parser import (
    FAILED,
    INTERRUPTED,
    Commands,
    arm_profile,
    damage_code,
    option_error,
    positive,
    progress_bar,
    wall_clock,
)
from hardware.process.progress import check_new, left_files_text

if TYPE_CHECKING:
    from hardware.calibration.arm_record import MoveOptions
    from hardware.calibration.arm_report import ArmTruth
    from hardware.calibration.live import WavingPage
    from hardware.calibration.report import CalibrationVerdict
    from hardware.process.clock import Clock

RIG_FORMATS = {
    "opencv": "a YAML per camera",
    "ros": "camera_info, a YAML per camera",
    "kalibr": "camchain.yaml",
    "anipose": "aniposelib's and caliscope's TOML, mm",
}
RIG_FORMATS_TEXT = "; ".join(f"{name}: {text}" for name, text in RIG_FORMATS.items())
# sources of an arm's calibration, and the options that each needs
ARM_SOURCES = {"folder": (), "device": ("cameras", "record"), "virtual": ("record",), "touched": ("cameras",)}


def add_calibrate(commands: Commands) -> None:
    """Add the sub-command `calibrate`."""
    command = commands.add(
        "calibrate",
        None,
        "calibrate cameras with a printed board, the arm, a dispenser; import or export calibrations",
        "Calibrate cameras with a printed board, then the arm and the dispensers. Each result has an uncertainty.",
        "stillbed calibrate cameras sessions/board --board board.toml -o rig.toml",
    )
    parts = Commands(command, "WHAT")
    _add_board(parts)
    _add_cameras(parts)
    _add_arm(parts)
    add_calibrate_dispenser(parts)
    _add_import(parts)
    _add_export(parts)


def _add_board(parts: Commands) -> None:
    add = parts.add(
        "board",
        _board,
        "draw a calibration board to print, with a ruler to check its scale",
        "Draw a calibration board at true scale, and write its description, board.toml, to the same folder. Print at\n"
        "100 %, measure the ruler and a square, and mount the sheet on a flat plate.",
        "stillbed calibrate board -o board.pdf",
        "stillbed calibrate board -o board.svg --page A3 --square-mm 30 --squares 8x11",
    ).add_argument
    add("-o", "--out", type=Path, required=True, metavar="X.pdf", help="output, .pdf or .svg; board.toml beside it")
    add("--kind", choices=("charuco", "chessboard"), default="charuco", help="type of the board; default charuco")
    add("--squares", type=_pair, metavar="CxR", help="columns x rows; default: as many as fit the page")
    add("--square-mm", type=positive, default=25.0, metavar="MM", help="edge length of a square; default 25")
    add("--marker", type=float, default=0.75, metavar="SHARE", help="edge of a marker / edge of a square; default 0.75")
    add("--dictionary", default="4X4_50", metavar="NAME", help="dictionary of the markers; default 4X4_50")
    add("--inverted", action="store_true", help="exchange black and white")
    add("--page", default="A4", metavar="SIZE", help="page: A5, A4, A3, A2, letter, or WxH in mm; default A4")
    add("--force", action="store_true", help="overwrite X.pdf and board.toml")


def _add_cameras(parts: Commands) -> None:
    add = parts.add(
        "cameras",
        _cameras,
        "calibrate lenses, camera poses and clock offsets with a moving board",
        "Calibrate cameras from a recording of the moving board, or from live cameras. With live cameras, the\n"
        "terminal and a page in the browser show where to hold the board next; the command ends when the coverage\n"
        "is sufficient. Ctrl-C keeps the corners; the same command continues.",
        "stillbed calibrate cameras sessions/board --board board.toml -o rig.toml",
        "stillbed calibrate cameras /dev/v4l/by-id/CAMERA_A /dev/v4l/by-id/CAMERA_B --board board.toml -o rig.toml",
    ).add_argument
    which = (
        "session folder or .mcap file (its rig may lack lenses); or live cameras as named by `stillbed cameras`, "
        "or RIG.toml for all cameras of a rig"
    )
    add("which", nargs="+", metavar="SESSION_OR_CAMERA", help=which)
    add("--seconds", type=float, metavar="S", help="maximum time; default: until coverage is sufficient")
    add("--no-page", action="store_true", help="with live cameras: do not serve the page in the browser")
    add("--board", type=Path, required=True, metavar="board.toml", help="description of the printed board")
    add("-o", "--out", type=Path, required=True, metavar="rig.toml", help="output file; report beside it")
    add("--limit-mm", type=positive, default=0.1, metavar="MM", help="maximum predicted error for PASS; default 0.1")
    distance = "two cameras and their measured distance, to check the scale"
    add("--distance-mm", type=_distance, metavar="A,B,MM", help=distance)
    lenses = "keep the session's lenses, within their lens_sigma; estimate camera poses and clock offsets"
    add("--keep-lenses", action="store_true", help=lenses)
    add("--new-rig", action="store_true", help="do not compare with the session's own rig")
    add("--force", action="store_true", help="overwrite rig.toml and its report")


def _add_import(parts: Commands) -> None:
    add = parts.add(
        "import",
        _import,
        "convert another program's calibration to a rig.toml",
        "Convert another program's calibration to a rig.toml. Add the image source of each camera to it by hand.",
        "stillbed calibrate import camchain.yaml --format kalibr -o rig.toml",
    ).add_argument
    add("file", type=Path, metavar="FILE", help="calibration file, or folder with a file per camera")
    add("--format", choices=RIG_FORMATS, required=True, help=RIG_FORMATS_TEXT)
    add("-o", "--out", type=Path, required=True, metavar="rig.toml", help="output file")
    add("--force", action="store_true", help="overwrite the file")


def _add_export(parts: Commands) -> None:
    add = parts.add(
        "export",
        _export,
        "convert a rig.toml to another program's format",
        "Convert a rig.toml to another program's format: lenses, camera poses, and what else the format can store.",
        "stillbed calibrate export rig.toml --format kalibr -o camchain.yaml",
    ).add_argument
    add("rig", type=Path, metavar="rig.toml", help="a calibrated rig")
    add("--format", choices=RIG_FORMATS, required=True, help=RIG_FORMATS_TEXT)
    add("-o", "--out", type=Path, required=True, metavar="OUT", help="output file or folder")
    add("--force", action="store_true", help="overwrite the file, or write into a folder that is not empty")


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


def _board(a: argparse.Namespace) -> int:
    from hardware.calibration.run import PrintOptions, write_print

    options = PrintOptions(a.kind, a.squares, a.square_mm, a.marker, a.dictionary, a.inverted, a.page)
    print(write_print(a.out, options, a.force))
    return 0


def _cameras(a: argparse.Namespace) -> int:
    from hardware.calibration.run import CalibrationOptions, corners_of, run_calibration, run_live

    clock = wall_clock()
    check_new(a.out, a.force)
    path = Path(a.which[0])  # a recording, or a live camera
    recorded = path if len(a.which) == 1 and (path.is_dir() or path.suffix == ".mcap") else None
    options = CalibrationOptions(a.limit_mm, a.distance_mm, a.keep_lenses, a.new_rig)
    if a.seconds is not None and (recorded is not None or not a.seconds >= 0):
        raise option_error("--seconds", a.seconds, "0 or more, with live cameras")
    try:
        with progress_bar("corners", "frame sets") as progress:
            if recorded is not None:
                outcome = run_calibration(recorded, a.board, a.out, options, progress)
            else:
                open_page = nullcontext if a.no_page else partial(_open_waving_page, clock)
                outcome = run_live(a.which, a.board, a.out, options, a.seconds, clock, progress, open_page)
    except KeyboardInterrupt:
        message = f"the corners so far are in {corners_of(a.out)}; the same command goes on from there"
        print(f"\nstillbed: interrupted; {message}", file=sys.stderr)
        return INTERRUPTED
    print(outcome.text)
    code = damage_code(outcome.damage)
    return code if outcome.verdict.passed else FAILED


def _open_waving_page(clock: Clock) -> WavingPage:
    """The page; its address is printed."""
    from hardware.calibration.live import WavingPage

    page = WavingPage(clock)
    print(f"open {page.address} to see where to hold the board", file=sys.stderr, flush=True)
    return page


def _import(a: argparse.Namespace) -> int:
    from hardware.calibration.rig_formats import FORMATS
    from hardware.files.rig_file import write_rig

    check_new(a.out, a.force)
    rig = FORMATS[a.format].read(a.file)
    write_rig(a.out, rig, [None] * len(rig))
    print(f"{a.out}: {', '.join(c.name for c in rig.cameras)}; where their images are is to be added")
    return 0


def _export(a: argparse.Namespace) -> int:
    from hardware.calibration.rig_formats import FORMATS
    from hardware.files.rig_file import read_rig

    check_new(a.out, a.force)
    rig = read_rig(a.rig).rig
    FORMATS[a.format].write(a.out, rig)
    print(f"{a.out}: {', '.join(c.name for c in rig.cameras)}")
    return 0


def _add_arm(parts: Commands) -> None:
    part = parts.add(
        "arm",
        _calibrate_arm,
        "calibrate the arm's base pose, tool offset and latency with the cameras",
        "The arm moves its needle in view of the calibrated cameras; the tip is detected in the pictures. Result:\n"
        "base pose of the arm, tool offset, dead time and servo lag, each with its uncertainty, and a verdict.\n"
        "Other sources: a recorded folder; or, for the base pose alone, points touched by the tip.\n"
        "Ctrl-C stops the arm and keeps the recording. Exit code 0: PASS, 1: FAIL.",
        "stillbed calibrate arm --virtual --record try -o arm.toml",
        "stillbed calibrate arm --device /dev/ttyUSB0 --cameras rig.toml --record moved --yes -o arm.toml",
        "stillbed calibrate arm moved -o arm.toml",
        "stillbed calibrate arm --touched points.toml --cameras rig.toml -o arm.toml",
    )
    add = part.add_argument
    add("folder", nargs="?", type=Path, metavar="FOLDER", help="recording of an earlier calibration")
    add("--device", metavar="DEVICE", help="port of the arm: a path, or a URL of pyserial")
    add("--virtual", action="store_true", help="simulated arm and cameras, with the exact truth")
    add("--terminal", action="store_true", help="with --virtual: in real time, on a pseudo-terminal instead of a port")
    add("--touched", type=Path, metavar="POINTS.toml", help="four or more points touched by the tip")
    add("-o", "--out", type=Path, required=True, metavar="ARM.toml", help="output file; report beside it")
    add("--cameras", type=Path, metavar="RIG.toml", help="the calibrated cameras, with their sources")
    add("--arm", type=Path, metavar="ARM.toml", help="arm file with limits, home, dialect and, if known, lag")
    add("--record", type=Path, metavar="FOLDER", help="output folder for pictures and commands, new")
    limit_help = "maximum error of the tip for PASS; default 0.1"
    add("--limit-mm", type=positive, default=0.1, metavar="MM", help=limit_help)  # a fourth of a bead
    add("--keep-tool", action="store_true", help="do not estimate the tool offset: no rotations")
    add("--keep-latency", action="store_true", help="do not estimate dead time and lag")
    add = part.add_argument_group("the moves").add_argument
    add("--places", type=int, default=20, metavar="N", help="number of places where the arm rests; default 20")
    add("--reach-mm", type=float, default=50.0, metavar="MM", help="range along X and Y; default 50")
    add("--up-mm", type=float, default=45.0, metavar="MM", help="range above the start; default 45")
    add("--down-mm", type=float, default=20.0, metavar="MM", help="range below the start; default 20")
    add("--turn-deg", type=float, default=35.0, metavar="DEG", help="range of A, B and C; default 35")
    add("--speed-mm-s", type=float, default=80.0, metavar="MM_S", help="maximum speed; default 80")
    add("--dwell-s", type=float, default=0.6, metavar="S", help="rest time at each place; default 0.6")
    add("--swing-s", type=float, default=8.0, metavar="S", help="duration of the swing at the end; default 8")
    add("--stands", metavar="WHERE", help="position of an arm without replies: X,Y,Z,A,B,C or home")
    add("--yes", action="store_true", help="confirm that nobody is within the arm's reach")
    add("--no-pause-frame", action="store_true", help="the controller does not support the pause frame")
    add("--seed", type=int, default=0, metavar="N", help="seed of the virtual arm's errors; default 0")


def _calibrate_arm(a: argparse.Namespace) -> int:
    sources = [name for name in ARM_SOURCES if getattr(a, name)]
    if len(sources) != 1:
        allowed = "one of a recorded FOLDER, --device, --virtual or --touched"
        raise option_error("calibrate arm", " and ".join(sources) or "nothing", allowed)
    if a.terminal and not a.virtual:
        raise option_error("--terminal", "given", "with --virtual: a --device is at its own port")
    source = sources[0]
    for name in ARM_SOURCES[source]:
        if getattr(a, name) is None:
            raise option_error(f"--{name}", "missing", f"given with {source}")
    try:
        verdict, text = {"device": _from_device, "virtual": _virtual, "touched": _touched, "folder": _folder}[source](a)
    except KeyboardInterrupt:
        if "record" not in ARM_SOURCES[source] or not (a.record.is_dir() and any(a.record.iterdir())):
            raise
        hint = "to begin anew, name another --record or empty this one"
        if (a.record / "frames.csv").exists():
            hint = f"`stillbed calibrate arm {quote(str(a.record))} -o {quote(str(a.out))}` takes what is there; {hint}"
        print(f"\nstillbed: interrupted; {left_files_text(a.record)}; {hint}", file=sys.stderr)
        return INTERRUPTED
    print(text)
    return 0 if verdict.passed else FAILED


def _moves(a: argparse.Namespace) -> MoveOptions:
    import numpy as np

    from hardware.calibration.arm_record import MoveOptions

    max_rotation = 0.0 if a.keep_tool else float(np.deg2rad(a.turn_deg))
    swing = 0.0 if a.keep_latency else a.swing_s
    return MoveOptions(a.places, a.reach_mm, a.up_mm, a.down_mm, max_rotation, a.speed_mm_s, a.dwell_s, swing)


def _folder(a: argparse.Namespace, truth: ArmTruth | None = None) -> tuple[CalibrationVerdict, str]:
    """Solve the named folder, or the one that was just recorded. truth: of a virtual arm."""
    from estimation.calibration.arm_fit import ArmUnknowns
    from hardware.calibration.arm_run import run_folder

    unknowns = ArmUnknowns(tool=not a.keep_tool, latency=not a.keep_latency)
    with progress_bar("tips", "frame sets") as progress:
        return run_folder(a.folder or a.record, a.out, a.limit_mm, unknowns, progress, truth)


def _virtual(a: argparse.Namespace) -> tuple[CalibrationVerdict, str]:
    from hardware.calibration.arm_run import check_out, check_record, record_in_virtual_time, record_on_terminal
    from hardware.simulator.watched_arm import watched_arm

    check_out(a.out)
    options = _moves(a)
    check_record(a.record)
    with progress_bar("moves", "ticks") as moves, progress_bar("pictures", "frame sets") as pictures:
        watched = watched_arm(a.seed)
        if a.terminal:
            truth = record_on_terminal(watched, wall_clock(), a.record, options, moves, pictures)
        else:
            truth = record_in_virtual_time(watched, a.record, options, moves, pictures)
    return _folder(a, truth)


def _from_device(a: argparse.Namespace) -> tuple[CalibrationVerdict, str]:
    from hardware.arm.console import axes_from_text
    from hardware.arm.profile import LinkSettings, open_arm
    from hardware.calibration.arm_record import record_live
    from hardware.calibration.arm_run import check_out, check_record, copy_rig_json
    from hardware.cameras.live import LiveCameras
    from hardware.cameras.sources import read_live_rig

    if not a.yes:
        raise InputError("arm", "--yes", "missing", "the confirmation that nobody is within the arm's reach")
    check_out(a.out)
    options, clock, profile = _moves(a), wall_clock(), arm_profile(a.arm)
    position = None if a.stands is None else axes_from_text(a.stands, profile.arm.home)
    rig, sources = read_live_rig(a.cameras)
    check_record(a.record)
    copy_rig_json(a.cameras, a.record)
    driver, link = open_arm(a.device, profile), LinkSettings(pause_frame=not a.no_pause_frame)
    with progress_bar("moves", "ticks") as moves:
        live = LiveCameras(rig, sources, clock)
        record_live(live, rig, driver, profile, clock, a.record, position, options, moves, link)
    return _folder(a)


def _touched(a: argparse.Namespace) -> tuple[CalibrationVerdict, str]:
    from hardware.calibration.arm_run import calibrate_touched

    return calibrate_touched(a.touched, a.cameras, arm_profile(a.arm), a.out, a.keep_tool)
