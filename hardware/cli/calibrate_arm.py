"""`stillbed calibrate arm`: its command line. Imports lazily."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from hardware.cli.parser import INTERRUPTED, Commands, add_command, positive
from hardware.process.progress import left_files_text

NOT_GOOD_ENOUGH = 1  # exit code of a calibration that is not good enough
ARM_SOURCES = ("folder", "device", "virtual", "touched")


def add_calibrate_arm(parts: Commands) -> None:
    """Add the part `arm` of `stillbed calibrate`."""
    part = add_command(
        parts,
        "arm",
        "where the arm stands before the cameras, where its tip is, how late it is",
        "Let the arm move its needle before the calibrated cameras, find the tip in the pictures, and get\n"
        "the arm's place, the tool's offset, dead time and servo lag, each with its doubt, and a verdict. Or do\n"
        "that again from a recorded folder; or find the place alone from points that the tip has touched.\n"
        "Ctrl-C stops the arm and keeps what was recorded. Exit code 0: good enough to print with; 1: not.",
        "stillbed calibrate arm --virtual --record try -o arm.toml",
        "stillbed calibrate arm --device /dev/ttyUSB0 --cameras rig.toml --record moved --yes -o arm.toml",
        "stillbed calibrate arm moved -o arm.toml",
        "stillbed calibrate arm --touched points.toml --cameras rig.toml -o arm.toml",
    )
    add = part.add_argument
    add("folder", nargs="?", type=Path, metavar="FOLDER", help="a calibration that was recorded before")
    add("--device", metavar="DEVICE", help="the arm's port: a path, or a URL of pyserial's")
    add("--virtual", action="store_true", help="an arm and cameras that are simulated, with exact truth")
    add("--terminal", action="store_true", help="with --virtual: on a pseudo-terminal, in real time, as at a port")
    add("--touched", type=Path, metavar="POINTS.toml", help="four or more points that the tip has touched")
    add("-o", "--out", type=Path, required=True, metavar="ARM.toml", help="to write; report beside it")
    add("--cameras", type=Path, metavar="RIG.toml", help="the calibrated cameras, with their sources")
    add("--arm", type=Path, metavar="ARM.toml", help="its limits, home, dialect, lag as known so far")
    add("--record", type=Path, metavar="FOLDER", help="new folder for pictures and commands")
    add("--limit-mm", type=positive, default=0.1, metavar="MM", help="of the tip, to pass; default 0.1")
    add("--keep-tool", action="store_true", help="do not seek the tool's offset: nothing is turned")
    add("--keep-latency", action="store_true", help="do not seek dead time and lag")
    moves = part.add_argument_group("the moves")
    moves.add_argument("--places", type=int, default=20, metavar="N", help="to rest at; default 20")
    moves.add_argument("--reach-mm", type=float, default=50.0, metavar="MM", help="along X and Y; default 50")
    moves.add_argument("--up-mm", type=float, default=45.0, metavar="MM", help="above where it begins; default 45")
    moves.add_argument("--down-mm", type=float, default=20.0, metavar="MM", help="below it; default 20")
    moves.add_argument("--turn-deg", type=float, default=35.0, metavar="DEG", help="of A, B and C; default 35")
    moves.add_argument("--speed-mm-s", type=float, default=80.0, metavar="MM_S", help="at most; default 80")
    moves.add_argument("--dwell-s", type=float, default=0.6, metavar="S", help="at each place; default 0.6")
    moves.add_argument("--swing-s", type=float, default=8.0, metavar="S", help="a swing at the end; default 8")
    moves.add_argument("--stands", metavar="WHERE", help="where a silent arm stands: X,Y,Z,A,B,C or home")
    moves.add_argument("--yes", action="store_true", help="somebody sees that nobody is within the arm's reach")
    moves.add_argument("--no-pause-frame", action="store_true", help="its controller knows no frame that stops it")
    moves.add_argument("--seed", type=int, default=0, metavar="N", help="of the virtual arm's errors; default 0")
    part.set_defaults(run=_calibrate_arm)


def _calibrate_arm(arguments: argparse.Namespace) -> int:
    from estimation.errors import InputError

    a = arguments
    given = [name for name in ARM_SOURCES if getattr(a, name)]
    if len(given) != 1:
        raise InputError(
            "command line",
            "calibrate arm",
            " and ".join(given) or "nothing",
            "one of a recorded FOLDER, --device, --virtual or --touched",
        )
    if a.terminal and not a.virtual:
        raise InputError("command line", "--terminal", "given", "with --virtual: a --device is at its own port")
    needed = {"device": ("cameras", "record"), "virtual": ("record",), "touched": ("cameras",), "folder": ()}[given[0]]
    for name in needed:
        if getattr(a, name) is None:
            raise InputError("command line", f"--{name}", "missing", f"given with {given[0]}")
    try:
        outcome = {"device": _from_device, "virtual": _virtual, "touched": _touched, "folder": _folder}[given[0]](a)
    except KeyboardInterrupt:
        if "record" not in needed or not _holds(a.record):
            raise
        print(f"\nstillbed: interrupted; {left_files_text(a.record)}; {_resume_hint(a.record, a.out)}", file=sys.stderr)
        return INTERRUPTED
    print(outcome.text)
    return 0 if outcome.verdict.passed else NOT_GOOD_ENOUGH


def _holds(folder: Path) -> bool:
    return folder.is_dir() and any(folder.iterdir())


def _resume_hint(record: Path, out: Path) -> str:
    """What may be done with a recording that was interrupted."""
    anew = "to begin anew, name another --record or empty this one"
    if not (record / "frames.csv").exists():
        return anew
    return f"`stillbed calibrate arm {record} -o {out}` takes what is there; {anew}"


def _settings(a: argparse.Namespace) -> Any:
    import numpy as np

    from estimation.calibration.arm_fit import ArmUnknowns
    from hardware.calibration.arm_record import MoveOptions
    from hardware.calibration.arm_run import ArmCalibrationOptions

    turn = 0.0 if a.keep_tool else float(np.deg2rad(a.turn_deg))
    swing = 0.0 if a.keep_latency else a.swing_s
    lengths = a.places, a.reach_mm, a.up_mm, a.down_mm, turn, a.speed_mm_s
    return ArmCalibrationOptions(
        a.limit_mm,
        ArmUnknowns(tool=not a.keep_tool, latency=not a.keep_latency),
        MoveOptions(*lengths, a.dwell_s, swing),
    )


def _profile(a: argparse.Namespace) -> Any:
    from hardware.arm.profile import ArmProfile
    from hardware.files.arm_file import read_arm

    return ArmProfile() if a.arm is None else read_arm(a.arm)


def _folder(a: argparse.Namespace, truth: Any = None, folder: Path | None = None) -> Any:
    from hardware.calibration.arm_run import run_folder
    from hardware.process.clock import WallClock
    from hardware.process.progress import Progress

    with Progress("tips", "frame sets", WallClock().now) as progress:
        return run_folder(a.folder if folder is None else folder, a.out, _settings(a), progress, truth)


def _virtual(a: argparse.Namespace) -> Any:
    from hardware.calibration.arm_run import check_out, check_record, record_in_virtual_time, record_on_terminal
    from hardware.process.clock import WallClock
    from hardware.process.progress import Progress
    from hardware.simulator.watched_arm import watched_arm

    check_out(a.out)
    wishes, clock = _settings(a), WallClock()
    check_record(a.record)
    with Progress("moves", "ticks", clock.now) as moves, Progress("pictures", "frame sets", clock.now) as pictures:
        watched = watched_arm(a.seed)
        if a.terminal:
            truth = record_on_terminal(watched, clock, a.record, wishes.moves, moves, pictures)
        else:
            truth = record_in_virtual_time(watched, a.record, wishes.moves, moves, pictures)
    return _folder(a, truth, a.record)


def _from_device(a: argparse.Namespace) -> Any:
    from estimation.errors import InputError
    from hardware.arm.console import axes_from_text
    from hardware.arm.port import PortOpener
    from hardware.arm.profile import LinkSettings
    from hardware.calibration.arm_record import record_live
    from hardware.calibration.arm_run import check_out, check_record, copy_rig_json
    from hardware.cameras.live import LiveCameras
    from hardware.cameras.sources import read_live_rig
    from hardware.process.clock import WallClock
    from hardware.process.progress import Progress

    if not a.yes:
        raise InputError("arm", "--yes", "missing", "given by whoever sees that nobody is within the arm's reach")
    check_out(a.out)
    wishes, clock, profile = _settings(a), WallClock(), _profile(a)
    stands = None if a.stands is None else axes_from_text(a.stands, profile.arm.home)
    rig, sources = read_live_rig(a.cameras)
    check_record(a.record)
    copy_rig_json(a.cameras, a.record)
    device, link = PortOpener(a.device, profile.baud), LinkSettings(pause_frame=not a.no_pause_frame)
    try:
        with Progress("moves", "ticks", clock.now) as moves:
            live = LiveCameras(rig, sources, clock)
            record_live(live, rig, device, profile, clock, a.record, stands, wishes.moves, moves, link)
    finally:
        device.release()
    return _folder(a, None, a.record)


def _touched(a: argparse.Namespace) -> Any:
    from hardware.calibration.arm_run import calibrate_touched

    return calibrate_touched(a.touched, a.cameras, _profile(a), a.out, a.keep_tool)
