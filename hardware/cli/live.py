"""`stillbed live`, `init`, `arm` and `cameras`: the commands on real or virtual devices. Imports lazily."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hardware.cli.parser import Commands, add_command, positive
from perception.package_data import named_path

if TYPE_CHECKING:
    from hardware.cameras.live import LiveCameras
    from hardware.cameras.sources import CameraDevice
    from hardware.process.clock import Clock

SETTINGS_FLAGS = (
    *("rig", "simulated", "path", "arm", "profile", "record"),
    *("dry_run", "lift", "stands_home", "jpeg_quality"),
    *("page_address", "page_port", "page_certificate", "page_key"),
)
NO_CAMERA_TEXT = """no camera is plugged in, or this user may not see it
  plug one in: it appears in /dev/v4l/by-id, and `stillbed cameras` lists it
  in a container, hand it in (docker run --device /dev/video0 -v /dev/v4l:/dev/v4l); on Linux be in the group `video`
  a camera on the network is named by its URL: stillbed cameras rtsp://ADDRESS/PATH"""
SHEET_JPEG_QUALITY = 90  # of JPEG: fine enough to judge focus by
CAMERA_FAULTY = 1  # exit code where a camera delivers nothing, or did not take what it was asked


def add_live(commands: Commands) -> None:
    """Add the sub-command `live`."""
    command = add_command(
        commands,
        "live",
        "print on a moving wound: track it, move the arm, record everything",
        "Print on a wound that moves: check, find it and lay the path on it, approach, print. Space or\n"
        "Enter in the terminal stops the arm at once, Ctrl-C stops it and ends the run. What was recorded is whole\n"
        "whatever ends the run, and --resume goes on where it stopped. Exit code 0 where the path is printed, 1 where\n"
        "the run ended before, 2 for wrong input, 128 and more where a signal ended it.",
        "stillbed live session.toml",
        "stillbed live --rig rig.toml --path path.csv --arm /dev/ttyUSB0 --record run.mcap",
        "stillbed live --simulated data/scenarios/breathing_calm.toml --record run.mcap --yes",
        "stillbed live --resume run.mcap",
        "stillbed live session.toml --page-address 0.0.0.0 --page-cert page.pem --page-key page.key --page-name lab",
    )
    command.add_argument("settings", nargs="?", type=Path, metavar="session.toml", help="see stillbed init")
    where = command.add_argument_group("what is printed where")
    where.add_argument("--rig", type=Path, metavar="RIG", help="rig.toml of cameras, or a session shown in real time")
    where.add_argument(
        "--simulated", type=named_path, metavar="SCENARIO.toml", help="a scenario, rendered before the run"
    )
    where.add_argument("--path", type=named_path, metavar="PATH.csv", help="checkpoints on the surface")
    where.add_argument("--arm", metavar="DEVICE", help='a path, a URL of pyserial\'s, or "virtual"')
    where.add_argument("--profile", type=named_path, metavar="ARM.toml", help="the arm's place, limits, dialect, lag")
    where.add_argument("--record", type=Path, metavar="X.mcap", help="the recording; other files stand beside it")
    how = command.add_argument_group("how")
    how.add_argument("--resume", type=Path, metavar="X.mcap", help="go on where the run recorded there stopped")
    how.add_argument("--dry-run", action="store_true", default=None, help="extrude nothing, stay above the path")
    how.add_argument("--lift", type=float, metavar="MM", help="how far above, in a dry run; default 10")
    how.add_argument("--yes", action="store_true", default=None, help="nobody confirms the path and the start")
    how.add_argument("--stands-home", action="store_true", default=None, help="an arm that does not answer stands so")
    how.add_argument("--jpeg-quality", type=int, metavar="Q", help="record unencoded pictures smaller and not exactly")
    how.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="FAULT",
        help='of a simulated run, what goes wrong, such as "tracking hang at 5s for 1s"; see docs/faults.md',
    )
    page = command.add_argument_group("the operator's page (docs/operator.md)")
    page.add_argument("--no-page", action="store_true", help="without it")
    page.add_argument("--page-address", metavar="ADDR", help="serve other machines too, at this address, by TLS alone")
    page.add_argument("--page-port", type=int, metavar="N", help="by default any that is free")
    page.add_argument("--page-cert", dest="page_certificate", type=Path, metavar="PEM", help="certificate for that")
    page.add_argument("--page-key", type=Path, metavar="PEM", help="the certificate's key, without a password")
    page.add_argument("--page-name", action="append", metavar="NAME", help="as browsers call this machine; repeatable")
    how.add_argument("--force", action="store_true", help="overwrite the recording")
    command.set_defaults(run=_run_live)


def add_init(commands: Commands) -> None:
    """Add the sub-command `init`."""
    command = add_command(
        commands,
        "init",
        "write a commented session.toml to begin with",
        "Write FOLDER/session.toml, which says everything that a live run is told, with a comment a key.",
        "stillbed init monday",
    )
    command.add_argument("folder", type=Path, metavar="FOLDER", help="made if it is not there")
    command.set_defaults(run=_run_init)


def _run_live(arguments: argparse.Namespace) -> int:
    from estimation.errors import InputError
    from hardware.live.prepared import add_faults, prepare, prepare_resumed
    from hardware.live.run import LiveRun
    from hardware.live.settings import LiveSettings, override_settings, parse_host_names, read_settings
    from hardware.live.view import Console
    from hardware.process.faults import faults_from_texts

    a = arguments
    faults = faults_from_texts("command line", "--fault", a.fault)
    flags = {name: getattr(a, name) for name in SETTINGS_FLAGS} | {
        "unattended": a.yes,
        "page": False if a.no_page else None,
    }
    if a.page_name is not None:
        flags["page_names"] = parse_host_names("command line", "--page-name", a.page_name)
    if a.resume is not None:
        if a.settings is not None or a.record is not None:
            raise InputError("command line", "--resume", a.resume, "without session.toml and --record")
        prepared = prepare_resumed(a.resume, flags)
    else:
        given = LiveSettings() if a.settings is None else read_settings(a.settings)
        prepared = prepare(override_settings(given, flags), a.settings or "command line", a.force)
    with Console() as console:
        outcome = LiveRun(add_faults(prepared, faults), console)()
        outcome.write()
        console.say(outcome.words)
    return outcome.code


def _run_init(arguments: argparse.Namespace) -> None:
    from estimation.errors import InputError
    from hardware.live.settings import settings_text

    file = arguments.folder / "session.toml"
    if arguments.folder.exists() and not arguments.folder.is_dir():
        raise InputError(arguments.folder, "FOLDER", "a file", "a folder, new or without a session.toml")
    if file.exists():
        raise InputError(file, "FOLDER", "holds a session.toml already", "a folder without one")
    arguments.folder.mkdir(parents=True, exist_ok=True)
    file.write_text(settings_text(), encoding="utf-8")
    print(f"edit {file}, then: stillbed live {file}")


def add_arm(commands: Commands) -> None:
    """Add the sub-command `arm`."""
    command = add_command(
        commands,
        "arm",
        "see what answers on the arm's port, home it; or serve a virtual one",
        "Listen on the port of a SEED S6H4D and tell what answers, how often and from where; nothing is\n"
        "sent unless a move is asked for, and a move needs --yes. With --virtual, serve a virtual arm on a\n"
        "pseudo-terminal instead, for any client that speaks its protocol; Ctrl-C ends it with a summary.",
        "stillbed arm /dev/ttyUSB0",
        "stillbed arm /dev/ttyUSB0 --home --yes",
        "stillbed arm --virtual --link ./arm --replies stream --fault 'stall 600ms at 5s'",
    )
    which = command.add_mutually_exclusive_group(required=True)
    which.add_argument("device", nargs="?", metavar="DEVICE", help="a path, or a URL of pyserial's such as socket://")
    which.add_argument("--virtual", action="store_true", help="serve a virtual arm on a pseudo-terminal")
    command.add_argument("--arm", type=named_path, metavar="ARM.toml", help="its home, limits, dialect and baud rate")
    real = command.add_argument_group("an arm on a port")
    real.add_argument("--seconds", type=positive, default=5.0, metavar="S", help="to listen; default 5")
    real.add_argument("--watch", action="store_true", help="listen until Ctrl-C")
    real.add_argument("--home", action="store_true", help="go home, slowly: up, across, down")
    real.add_argument("--jog", nargs="+", metavar="AXIS=BY", help="go by so many mm or degrees: X=+5 B=-2.5")
    real.add_argument("--stands", metavar="WHERE", help="where an arm that does not answer stands: X,Y,Z,A,B,C or home")
    real.add_argument("--origin", metavar="X,Y,Z", help="mm in machine axes: send G54, and what comes after from there")
    real.add_argument("--yes", action="store_true", help="somebody sees that nobody is within the arm's reach")
    real.add_argument("--no-pause-frame", action="store_true", help="its controller knows no frame that stops it")
    virtual = command.add_argument_group("a virtual arm")
    virtual.add_argument("--link", type=Path, metavar="LINK", help="a symbolic link to make to the device")
    virtual.add_argument("--replies", choices=("off", "stream", "stray"), default="off", help="what the arm sends")
    virtual.add_argument("--fault", action="append", default=[], metavar="FAULT", help="e.g. 'slow 80%% at 2s for 1s'")
    virtual.add_argument("--log", type=Path, metavar="X.csv", help="write the executed motion, a row a millisecond")
    command.set_defaults(run=_run_arm)


def _run_arm(arguments: argparse.Namespace) -> int | None:
    from hardware.arm.profile import ArmProfile
    from hardware.files.arm_file import read_arm

    profile = ArmProfile() if arguments.arm is None else read_arm(arguments.arm)
    if arguments.virtual:
        _serve_virtual_arm(arguments, profile)
        return None
    return _connect_arm(arguments, profile)


def _serve_virtual_arm(arguments: argparse.Namespace, profile: Any) -> None:
    from hardware.process.faults import FaultPart, FaultRunner, check_faults, faults_from_texts
    from hardware.simulator.arm.ports import run_virtual_arm
    from hardware.simulator.arm.settings import arm_settings_from_table

    settings = arm_settings_from_table("command line", {"replies": arguments.replies})
    faults = faults_from_texts("command line", "--fault", arguments.fault, FaultPart.ARM)
    check_faults(faults, FaultRunner.ARM, "command line", "--fault")
    run_virtual_arm(settings, profile, faults, arguments.link, arguments.log)


def _connect_arm(arguments: argparse.Namespace, profile: Any) -> int:
    from hardware.arm.console import ArmRequest, axes_from_text, jog_from_text, origin_from_text, run_arm
    from hardware.arm.device import ArmState
    from hardware.arm.port import PortOpener
    from hardware.arm.profile import LinkSettings
    from hardware.process.clock import WallClock

    request = ArmRequest(
        seconds=float("inf") if arguments.watch else arguments.seconds,
        home=arguments.home,
        jog=None if arguments.jog is None else jog_from_text(arguments.jog),
        stands=None if arguments.stands is None else axes_from_text(arguments.stands, profile.arm.home),
        origin=None if arguments.origin is None else origin_from_text(arguments.origin),
        confirmed=arguments.yes,
    )
    settings = LinkSettings(pause_frame=not arguments.no_pause_frame)
    device = PortOpener(arguments.device, profile.baud)
    try:
        status = run_arm(device, profile, request, WallClock(), settings=settings)
    finally:
        device.release()
    return 0 if status.state is ArmState.DISARMED else 1


def add_cameras(commands: Commands) -> None:
    """Add the sub-command `cameras`."""
    command = add_command(
        commands,
        "cameras",
        "list cameras; show what they deliver, how steadily and how sharply",
        "Without a name, list the cameras that are plugged in, by names that stay. With names, watch them\n"
        "for a few seconds and tell of each: rate, jitter, lag, offset, sharpness, brightness, the controls it\n"
        "took, and the frames that were missing, frozen or black. A camera is named by /dev/v4l/by-id/...,\n"
        "/dev/v4l/by-path/..., usb:SERIAL, a URL or a video file; RIG.toml stands for all cameras of a rig, set up\n"
        "as it says. Exit code 1 where a camera delivers nothing or refuses a control.",
        "stillbed cameras",
        "stillbed cameras rig.toml -o sheet.jpg",
        "stillbed cameras rtsp://192.168.0.20/stream --seconds 10",
    )
    add = command.add_argument
    add("which", nargs="*", metavar="DEVICE_OR_URL_OR_RIG.toml", help="cameras to watch; none: list")
    add("--seconds", type=float, default=5.0, metavar="S", help="to watch; default 5")
    add("-o", "--out", type=Path, metavar="SHEET.jpg", help="write their last pictures on one sheet")
    add("--json", action="store_true", help="print JSON")
    command.set_defaults(run=_run_cameras)


def _run_cameras(arguments: argparse.Namespace) -> int:
    from hardware.cameras.sources import list_devices
    from hardware.process.clock import WallClock

    if not arguments.which:
        print(_list_json(list_devices()) if arguments.json else list_text(list_devices()))
        return 0
    _check_watch(arguments)
    clock = WallClock()
    return _watch_cameras(arguments, cameras_named(arguments.which, clock), clock)


def _check_watch(arguments: argparse.Namespace) -> None:
    from estimation.errors import InputError

    if not 0 < arguments.seconds <= 3600:
        raise InputError("command line", "--seconds", arguments.seconds, "0 < seconds <= 3600")
    if arguments.out is not None and arguments.out.suffix.lower() not in (".jpg", ".jpeg", ".png"):
        raise InputError("command line", "--out", arguments.out, "a file that ends in .jpg or .png")


def list_text(devices: tuple[CameraDevice, ...]) -> str:
    """A paragraph a camera, or what to do where there is none."""
    if not devices:
        return NO_CAMERA_TEXT
    lines = [
        f"{d.identity or 'no name that stays'}\n  {d.name or 'unnamed'}, now {d.node}"
        + (f", serial number {d.serial} (usb:{d.serial})" if d.serial else "")
        + (f"\n  this socket: {d.by_path}" if d.by_path and d.by_path != d.identity else "")
        for d in devices
    ]
    return "\n".join(lines)


def _list_json(devices: tuple[CameraDevice, ...]) -> str:
    import json

    keys = ("identity", "name", "serial", "by_id", "by_path")
    return json.dumps([{"node": str(d.node)} | {key: getattr(d, key) for key in keys} for d in devices], indent=2)


def cameras_named(which: list[str], clock: Clock) -> LiveCameras:
    """The cameras of a rig.toml, or those named one by one."""
    from hardware.cameras.live import LiveCameras, places_without_rig, sources_named

    rig, sources = sources_named(which)
    return LiveCameras(places_without_rig(len(which)) if rig is None else rig, sources, clock)


def _watch_cameras(arguments: argparse.Namespace, live: LiveCameras, clock: Clock) -> int:
    import json

    from hardware.cameras.inspection import inspect, inspection_sheet, inspection_table, inspection_text
    from hardware.files.images import encode

    with live:
        inspection = inspect(live, arguments.seconds, clock)
    print(json.dumps(inspection_table(inspection), indent=2) if arguments.json else inspection_text(inspection))
    if arguments.out is not None:
        jpeg = None if arguments.out.suffix.lower() == ".png" else SHEET_JPEG_QUALITY
        arguments.out.write_bytes(encode(inspection_sheet(inspection), jpeg)[1])
        if not arguments.json:
            print(f"\ntheir last pictures are in {arguments.out}")
    return CAMERA_FAULTY if inspection.faulty else 0
