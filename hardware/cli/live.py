"""`stillbed live`, `record`, `init`, `arm` and `cameras`: the commands on real or virtual devices. Imports lazily."""

from __future__ import annotations

import argparse
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

from estimation.errors import InputError
from hardware.cli.parser import (
    FAILED,
    MODEL_HELP,
    ROI_HELP,
    Commands,
    add_fault,
    arm_profile,
    option_error,
    positive,
    wall_clock,
)
from hardware.process.progress import check_new, write_atomically
from perception import named_path

if TYPE_CHECKING:
    from hardware.arm.profile import ArmProfile
    from hardware.cameras.genicam import IndustrialCamera
    from hardware.cameras.sources import CameraDevice

NO_CAMERA_TEXT = """no camera is connected, or this user may not see it
  connect one: it appears in /dev/v4l/by-id, and `stillbed cameras` lists it
  in a container, pass it (docker run --device /dev/video0 -v /dev/v4l:/dev/v4l); on Linux be in the group `video`
  a camera on the network is named by its URL: stillbed cameras rtsp://ADDRESS/PATH"""
NO_ARAVIS_TEXT = "industrial cameras (GigE Vision, USB3 Vision) were not searched: Aravis is not installed"
LIVE_ALLOWED = """a session.toml, of which `stillbed init FOLDER` writes one to begin with; or --rig and --path; or \
--simulated data/live/small.toml --record run.mcap, to see a run without any device"""
SHEET_JPEG_QUALITY = 90  # of JPEG: fine enough to check the focus


def add_live(commands: Commands) -> None:
    """Add the sub-command `live`."""
    command = commands.add(
        "live",
        _run_live,
        "print on a moving wound: track it, move the arm, record",
        "Print on a moving wound: checks, detection of the wound, placement of the path, approach, printing. Space or\n"
        "Enter in the terminal stops the arm at once; Ctrl-C stops it and ends the run. The recording is complete\n"
        "however the run ends, and --resume continues a run. Exit code 0: the path is printed, 1: the run ended\n"
        "earlier, 2: wrong input, 128 or more: a signal ended it.",
        "stillbed live session.toml",
        "stillbed live --simulated data/scenarios/breathing_calm.toml --record run.mcap --yes",
        "stillbed live --resume run.mcap",
        "stillbed live session.toml --page-address 0.0.0.0 --page-cert page.pem --page-key page.key --page-name lab",
    )
    command.add_argument("settings", nargs="?", type=Path, metavar="session.toml", help="settings; see stillbed init")
    add = command.add_argument_group("what to print, and where").add_argument
    add("--rig", type=Path, metavar="RIG", help="rig.toml of live cameras, or a session to play in real time")
    add("--simulated", type=named_path, metavar="SCENARIO.toml", help="scenario, rendered before the run")
    add("--model", type=Path, metavar="X.onnx", help=MODEL_HELP)
    add("--region", type=Path, metavar="FILE.toml", help=ROI_HELP)
    add("--path", type=named_path, metavar="PATH.csv", help="checkpoints on the surface")
    scan_help = 'scan of the surface, in the frame of the path; or "from the cameras": they scan it before the run'
    add("--scan", type=named_path, metavar="SCAN.ply", help=scan_help)
    add("--arm", metavar="DEVICE", help='port of the arm: a path, a URL of pyserial, or "virtual"')
    add("--profile", type=named_path, metavar="ARM.toml", help="arm file: base pose, limits, dialect, lag")
    add("--dispensers", type=named_path, metavar="DISPENSER.toml", help="dispenser file; default: no material")
    add("--record", type=Path, metavar="X.mcap", help="recording to write; the run's other files go beside it")
    add = add_how = command.add_argument_group("how to print").add_argument
    add("--resume", type=Path, metavar="X.mcap", help="recording of a run to continue")
    add("--dry-run", action="store_true", default=None, help="do not extrude; stay above the path")
    add("--look", metavar="WHEN", help='inspect the printed beads after each "layer", or after this number of beads')
    add("--adapt", action="store_true", default=None, help="with --look: adapt the flow to the layer below")
    add("--lift", type=float, metavar="MM", help="height above the path in a dry run; default 10")
    add("--yes", action="store_true", default=None, help="do not ask to confirm the path and the start")
    add("--stands-home", action="store_true", default=None, help="the arm is at home, if it does not answer")
    add("--jpeg-quality", type=int, metavar="Q", help="JPEG quality for raw pictures; 0: lossless")
    add("--operator", metavar="NAME", help="name of the operator, for recording and reports")
    port_help = "serve the run to Foxglove on this machine, at ws://127.0.0.1:PORT"
    add("--no-trace", action="store_true", help="do not record /trace, the time of each stage of each frame set")
    add("--foxglove", dest="foxglove_port", type=int, metavar="PORT", help=port_help)
    add("--trace", type=Path, metavar="X.json", help="write the recorded /trace for Perfetto; see stillbed trace")
    add_fault(add, 'a fault to inject into a simulated run, such as "tracking hang at 5s for 1s"; see docs/faults.md')
    add = command.add_argument_group("the operator's page (docs/operator.md)").add_argument
    add("--no-page", action="store_true", help="do not serve the page")
    add("--open", action="store_true", help="open the page in a browser")
    add("--page-address", metavar="ADDR", help="serve other machines too, at this address, with TLS only")
    add("--page-port", type=int, metavar="N", help="port of the page; default: any free port")
    add("--page-cert", dest="page_certificate", type=Path, metavar="PEM", help="certificate for TLS")
    add("--page-key", type=Path, metavar="PEM", help="key of the certificate, without a password")
    add("--page-name", action="append", metavar="NAME", help="host name of this machine in browsers; repeatable")
    add_how("--force", action="store_true", help="overwrite the recording")


def add_record(commands: Commands) -> None:
    """Add the sub-command `record`."""
    add = commands.add(
        "record",
        _run_record,
        "record live cameras without an arm",
        "Record the cameras of a rig.toml, or of a session.toml, as in a live run. A page shows their pictures, rates\n"
        "and sharpness. Ctrl-C, the page or --seconds ends it; the recording is kept in every case. Input for\n"
        "track, smooth, segment, plan --session and calibrate. Exit code 1 if no picture came, or if a fault ended\n"
        "the recording.",
        "stillbed record rig.toml -o try.mcap --seconds 20",
    ).add_argument
    add("which", type=Path, metavar="RIG.toml", help="rig; or a session.toml, with its rig, region and quality")
    add("-o", "--out", type=Path, required=True, metavar="X.mcap", help="output file")
    add("--seconds", type=positive, metavar="S", help="duration from the first picture; default: until Ctrl-C")
    add("--jpeg-quality", type=int, metavar="Q", help="JPEG quality, 1 to 100, default 90; 0: lossless")
    add("--region", type=Path, metavar="FILE.toml", help=ROI_HELP)
    add("--no-page", action="store_true", help="do not serve the page")
    add("--force", action="store_true", help="overwrite the file")


def _run_record(a: argparse.Namespace) -> int:
    from hardware.files.region_table import read_region
    from hardware.live.camera_recording import CameraRecording, RecordOrder, check_order
    from hardware.live.settings import LiveSettings, read_settings
    from hardware.process.checks import read_toml

    settings = LiveSettings(rig=a.which)
    if "camera" not in read_toml(a.which):
        settings = read_settings(a.which)
        if settings.rig is None or settings.rig.suffix != ".toml":
            raise InputError(a.which, "cameras.rig", settings.rig or "missing", "a rig.toml of live cameras")
    region = settings.region if a.region is None else read_region(a.region)
    quality = settings.jpeg_quality if a.jpeg_quality is None else a.jpeg_quality
    assert settings.rig is not None
    order = RecordOrder(settings.rig, a.out, a.seconds, quality, region, not a.no_page)
    recording = CameraRecording(check_order(order, a.force))
    recording()
    print(recording.words)
    return FAILED if recording.failed else 0


def add_init(commands: Commands) -> None:
    """Add the sub-command `init`."""
    add = commands.add(
        "init",
        _run_init,
        "write a commented session.toml",
        "Write FOLDER/session.toml with all settings of a live run, and a comment for each key.",
        "stillbed init monday",
    ).add_argument
    add("out", type=Path, metavar="FOLDER", help="output folder; created if it does not exist")


def _run_live(a: argparse.Namespace) -> int:
    from dataclasses import fields

    from hardware.cli.plan import scanned_settings
    from hardware.files.region_table import read_region
    from hardware.live.settings import LiveSettings, named_by_flag, override_settings, parse_host_names, read_settings
    from hardware.process.faults import faults_from_texts

    faults = faults_from_texts("command line", "--fault", a.fault)
    flags = {field.name: getattr(a, field.name, None) for field in fields(LiveSettings)}
    traces = False if a.no_trace else True if a.trace is not None else None
    flags |= {"unattended": a.yes, "page": False if a.no_page else None, "trace": traces}
    flags["region"] = None if a.region is None else read_region(a.region)
    if a.trace is not None and a.no_trace:
        raise option_error("--trace", a.trace, "left out beside --no-trace")
    if a.trace is not None and a.trace.exists() and not a.force:
        raise option_error("--trace", a.trace, "a new file, or --force")
    if a.page_name is not None:
        flags["page_names"] = parse_host_names("command line", "--page-name", a.page_name)
    if a.resume is not None and (a.settings is not None or a.record is not None):
        raise option_error("--resume", a.resume, "without session.toml and --record")
    if a.resume is None and a.settings is None and a.rig is None and a.simulated is None:
        raise option_error("session.toml", "missing", LIVE_ALLOWED)
    settings, where = LiveSettings() if a.settings is None else read_settings(a.settings), a.settings or "command line"
    from hardware.live.prepared import prepare, prepare_resumed  # slow imports: 1 s, and 2 s for the run
    from hardware.live.run import LiveRun
    from hardware.live.view import Console

    try:
        if a.resume is not None:
            prepared = prepare_resumed(a.resume, flags, faults)
        else:
            settings = scanned_settings(override_settings(settings, flags), where, a.force)
            prepared = prepare(settings, where, a.force, faults)
    except InputError as error:
        raise named_by_flag(error, [name for name, value in flags.items() if value is not None]) from None
    with Console(a.open) as console:
        outcome = LiveRun(prepared, console)()
        console.say(outcome.words)
    if a.trace is not None:
        from hardware.live.trace import write_trace

        print(write_trace(prepared.files.record, a.trace) or f"trace: {a.trace}")
    return outcome.code


def _run_init(a: argparse.Namespace) -> None:
    from hardware.live.settings import settings_text

    file = a.out / "session.toml"
    if a.out.exists() and not a.out.is_dir():
        raise InputError(a.out, "FOLDER", "a file", "a folder, new or without a session.toml")
    if file.exists():
        raise InputError(file, "FOLDER", "holds a session.toml already", "a folder without one")
    a.out.mkdir(parents=True, exist_ok=True)
    write_atomically(file, settings_text())
    print(f"edit {file}, then: stillbed live {quote(str(file))}")


def add_arm(commands: Commands) -> None:
    """Add the sub-command `arm`."""
    command = commands.add(
        "arm",
        _run_arm,
        "test the arm on a port, home it, jog it; or serve a virtual arm",
        "Listen to an arm and print its replies, their rate and its position. It moves only with --home or --jog, and\n"
        "these need --yes. Without DEVICE, list the drivers, the arms that each finds, and how to install missing\n"
        "drivers. With --virtual, serve a virtual SEED S6H4D on a pseudo-terminal instead, for any client that\n"
        "uses its protocol; Ctrl-C ends it with a summary.",
        "stillbed arm",
        "stillbed arm /dev/ttyUSB0",
        "stillbed arm /dev/ttyUSB0 --home --yes",
        "stillbed arm --virtual --link ./arm --replies stream --fault 'stall 600ms at 5s'",
    )
    target = command.add_mutually_exclusive_group()
    device_help = "path, URL of pyserial such as socket://, or address of another driver; none: list drivers and arms"
    target.add_argument("device", nargs="?", metavar="DEVICE", help=device_help)
    target.add_argument("--virtual", action="store_true", help="serve a virtual arm on a pseudo-terminal")
    command.add_argument("--arm", type=named_path, metavar="ARM.toml", help="home, limits, dialect, baud rate")
    add = command.add_argument_group("an arm on a port").add_argument
    add("--seconds", type=positive, default=5.0, metavar="S", help="listening time; default 5")
    add("--watch", action="store_true", help="listen until Ctrl-C")
    add("--home", action="store_true", help="move to home, slowly: up, across, down")
    add("--jog", nargs="+", metavar="AXIS=BY", help="move by mm or degrees: X=+5 B=-2.5")
    add("--stands", metavar="WHERE", help="position of an arm without replies: X,Y,Z,A,B,C or home")
    add("--origin", metavar="X,Y,Z", help="origin, mm in machine axes: send G54, and use it for the moves")
    add("--yes", action="store_true", help="confirm that nobody is within the arm's reach")
    add("--no-pause-frame", action="store_true", help="the controller does not support the pause frame")
    add = command.add_argument_group("a virtual arm").add_argument
    add("--link", type=Path, metavar="LINK", help="symbolic link to create to the device")
    add("--replies", choices=("off", "stream", "stray"), default="off", help="replies of the arm")
    add_fault(add, "a fault to inject, such as 'slow 80%% at 2s for 1s'")
    add("--log", type=Path, metavar="X.csv", help="at the end, write the executed motion, one row per millisecond")


def _run_arm(a: argparse.Namespace) -> int:
    from hardware.arm.profile import far_limits_text
    from hardware.files.arm_file import arm_for

    if not (a.device or a.virtual):
        from hardware.arm.console import drivers_text

        print(drivers_text())
        return 0
    profile = arm_for(a.device) if a.arm is None and a.device else arm_profile(a.arm)
    if text := far_limits_text(profile.limits):
        print(text, flush=True)
    return _serve_virtual_arm(a, profile) if a.virtual else _connect_arm(a, profile)


def _serve_virtual_arm(a: argparse.Namespace, profile: ArmProfile) -> int:
    from hardware.process.faults import FaultPart, FaultRunner, check_faults, faults_from_texts
    from hardware.simulator.arm.ports import run_virtual_arm
    from hardware.simulator.arm.settings import arm_settings_from_table

    settings = arm_settings_from_table("command line", {"replies": a.replies})
    faults = faults_from_texts("command line", "--fault", a.fault, FaultPart.ARM)
    check_faults(faults, FaultRunner.ARM, "command line", "--fault")
    run_virtual_arm(settings, profile, faults, a.link, a.log)
    return 0


def _connect_arm(a: argparse.Namespace, profile: ArmProfile) -> int:
    from hardware.arm.console import ArmRequest, axes_from_text, jog_from_text, origin_from_text, run_arm
    from hardware.arm.device import ArmState
    from hardware.arm.profile import LinkSettings, open_arm

    request = ArmRequest(
        seconds=float("inf") if a.watch else a.seconds,
        home=a.home,
        jog=None if a.jog is None else jog_from_text(a.jog),
        stands=None if a.stands is None else axes_from_text(a.stands, profile.arm.home),
        origin=None if a.origin is None else origin_from_text(a.origin),
        confirmed=a.yes,
    )
    driver, settings = open_arm(a.device, profile), LinkSettings(pause_frame=not a.no_pause_frame)
    try:
        status = run_arm(driver, profile, request, wall_clock(), settings=settings)
    finally:
        driver.release()
    return 0 if status.state is ArmState.DISARMED else 1


def add_cameras(commands: Commands) -> None:
    """Add the sub-command `cameras`."""
    add = commands.add(
        "cameras",
        _run_cameras,
        "list cameras; measure their rate, jitter and sharpness",
        "Without a name, list the cameras of each driver, by permanent names. With names, watch them for some seconds\n"
        "and print of each: rate, jitter, lag, offset, sharpness, brightness, accepted controls, and numbers of\n"
        "missing, frozen and black frames. Name of a camera: /dev/v4l/by-id/..., /dev/v4l/by-path/..., usb:SERIAL,\n"
        "genicam://ID, a URL or a video file; RIG.toml: all cameras of a rig, with its controls. Exit code 1 if a\n"
        "camera delivers nothing or refuses a control.",
        "stillbed cameras",
        "stillbed cameras rig.toml -o sheet.jpg",
        "stillbed cameras rtsp://192.168.0.20/stream --seconds 10",
    ).add_argument
    add("which", nargs="*", metavar="DEVICE_OR_URL_OR_RIG.toml", help="cameras to watch; none: list all")
    add("--seconds", type=float, default=5.0, metavar="S", help="duration; default 5")
    add("-o", "--out", type=Path, metavar="SHEET.jpg", help="write the last pictures on one sheet")
    add("--force", action="store_true", help="overwrite the sheet")
    add("--json", action="store_true", help="print JSON")


def _run_cameras(a: argparse.Namespace) -> int:
    import json

    from hardware.cameras.genicam import INSTALL, list_industrial
    from hardware.cameras.sources import list_devices

    if a.which:
        return _watch_cameras(a)
    devices, industrial = list_devices(), list_industrial()
    cameras = devices, industrial or ()
    print(json.dumps(_cameras_table(*cameras), indent=2) if a.json else list_text(*cameras))
    if industrial is None and not a.json:
        print(f"\n{NO_ARAVIS_TEXT}\n  {INSTALL}")
    return 0


def _cameras_table(devices: tuple[CameraDevice, ...], industrial: tuple[IndustrialCamera, ...]) -> list[dict[str, str]]:
    keys = ("identity", "name", "serial", "by_id", "by_path")
    return [
        *({"node": str(d.node), "address": ""} | {key: getattr(d, key) for key in keys} for d in devices),
        *(
            dict.fromkeys(("node", "by_id", "by_path"), "")
            | {"address": c.address, "identity": c.identity, "name": f"{c.maker} {c.model}", "serial": c.serial}
            for c in industrial
        ),
    ]


def list_text(devices: tuple[CameraDevice, ...], industrial: tuple[IndustrialCamera, ...] = ()) -> str:
    """A paragraph for each camera, or what to do without one."""
    if not devices and not industrial:
        return NO_CAMERA_TEXT
    lines = [
        f"{d.identity or 'no name that stays'}\n  {d.name or 'unnamed'}, now {d.node}"
        + (f", serial number {d.serial} (usb:{d.serial})" if d.serial else "")
        + (f"\n  this socket: {d.by_path}" if d.by_path and d.by_path != d.identity else "")
        for d in devices
    ]
    lines += [
        f"{c.identity}\n  {c.maker} {c.model}, serial number {c.serial}" + (f", at {c.address}" if c.address else "")
        for c in industrial
    ]
    return "\n".join(lines)


def _watch_cameras(a: argparse.Namespace) -> int:
    import json

    from hardware.cameras.inspection import inspect, inspection_sheet, inspection_table, inspection_text
    from hardware.cameras.live import LiveCameras, places_without_rig, sources_named
    from hardware.files.images import encode

    if not 0 < a.seconds <= 3600:
        raise option_error("--seconds", a.seconds, "0 < seconds <= 3600")
    if a.out is not None and a.out.suffix.lower() not in (".jpg", ".jpeg", ".png"):
        raise option_error("--out", a.out, "a file that ends in .jpg or .png")
    if a.out is not None:
        check_new(a.out, a.force)
    rig, sources = sources_named(a.which)
    clock = wall_clock()
    with LiveCameras(places_without_rig(len(a.which)) if rig is None else rig, sources, clock) as live:
        inspection = inspect(live, a.seconds, clock)
    print(json.dumps(inspection_table(inspection), indent=2) if a.json else inspection_text(inspection))
    if a.out is not None:
        sheet = encode(inspection_sheet(inspection), None if a.out.suffix.lower() == ".png" else SHEET_JPEG_QUALITY)[1]
        a.out.write_bytes(sheet)
        if not a.json:
            print(f"\ntheir last pictures are in {a.out}")
    return FAILED if inspection.faulty else 0
