"""`stillbed cameras`: what is plugged in, and how it fares. Imports lazily."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from hardware.cli.parser import Commands

if TYPE_CHECKING:
    from hardware.cameras.identity import Device
    from hardware.cameras.live import LiveCameras
    from hardware.process.clock import Clock


NOTHING_THERE = """no camera is plugged in, or this user may not see it
  plug one in: it appears in /dev/v4l/by-id, and `stillbed cameras` lists it
  in a container, hand it in (docker run --device /dev/video0 -v /dev/v4l:/dev/v4l); on Linux be in the group `video`
  a camera on the network is named by its URL: stillbed cameras rtsp://ADDRESS/PATH"""
SHEET_QUALITY = 90  # of JPEG: fine enough to judge focus by
FAULTY = 1  # exit code where a camera delivers nothing, or did not take what it was asked


def add_cameras(commands: Commands) -> None:
    """Add the sub-command `cameras`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "cameras",
        help="list cameras; show what they deliver, how steadily and how sharply",
        description="Without a name, list the cameras that are plugged in, by names that stay. With names, watch them\n"
        "for a few seconds and tell of each: rate, jitter, lag, offset, sharpness, brightness, the controls it\n"
        "took, and the frames that were missing, frozen or black. A camera is named by /dev/v4l/by-id/...,\n"
        "/dev/v4l/by-path/..., usb:SERIAL, a URL or a video file; RIG.toml stands for all cameras of a rig, set up\n"
        "as it says. Exit code 1 where a camera delivers nothing or refuses a control.",
        epilog="examples:\n  stillbed cameras\n  stillbed cameras rig.toml -o sheet.jpg\n"
        "  stillbed cameras rtsp://192.168.0.20/stream --seconds 10",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("which", nargs="*", metavar="DEVICE_OR_URL_OR_RIG.toml", help="cameras to watch; none: list")
    command.add_argument("--seconds", type=float, default=5.0, metavar="S", help="to watch; default 5")
    command.add_argument("-o", "--out", type=Path, metavar="SHEET.jpg", help="write their last pictures on one sheet")
    command.add_argument("--json", action="store_true", help="print JSON")
    command.set_defaults(run=_cameras)


def _cameras(arguments: argparse.Namespace) -> int:
    from hardware.cameras.identity import list_devices
    from hardware.process.clock import WallClock

    if not arguments.which:
        print(_list_json(list_devices()) if arguments.json else list_text(list_devices()))
        return 0
    _check(arguments)
    clock = WallClock()
    return _watch(arguments, cameras_named(arguments.which, clock), clock)


def _check(arguments: argparse.Namespace) -> None:
    from estimation.errors import InputError

    if not 0 < arguments.seconds <= 3600:
        raise InputError("command line", "--seconds", arguments.seconds, "0 < seconds <= 3600")
    if arguments.out is not None and arguments.out.suffix.lower() not in (".jpg", ".jpeg", ".png"):
        raise InputError("command line", "--out", arguments.out, "a file that ends in .jpg or .png")


def list_text(devices: tuple[Device, ...]) -> str:
    """A paragraph a camera, or what to do where there is none."""
    if not devices:
        return NOTHING_THERE
    lines = [
        f"{d.identity or 'no name that stays'}\n  {d.name or 'unnamed'}, now {d.node}"
        + (f", serial number {d.serial} (usb:{d.serial})" if d.serial else "")
        + (f"\n  this socket: {d.by_path}" if d.by_path and d.by_path != d.identity else "")
        for d in devices
    ]
    return "\n".join(lines)


def _list_json(devices: tuple[Device, ...]) -> str:
    import json

    keys = ("identity", "name", "serial", "by_id", "by_path")
    return json.dumps([{"node": str(d.node)} | {key: getattr(d, key) for key in keys} for d in devices], indent=2)


def cameras_named(which: list[str], clock: Clock) -> LiveCameras:
    """The cameras of a rig.toml, or those named one by one."""
    from hardware.cameras.live import LiveCameras
    from hardware.cameras.named import places_without_rig, sources_named

    rig, sources = sources_named(which)
    return LiveCameras(places_without_rig(len(which)) if rig is None else rig, sources, clock)


def _watch(arguments: argparse.Namespace, live: LiveCameras, clock: Clock) -> int:
    import json

    from hardware.cameras.inspection import inspect, inspection_sheet, inspection_table, inspection_text
    from hardware.files.images import encode

    with live:
        inspection = inspect(live, arguments.seconds, clock)
    print(json.dumps(inspection_table(inspection), indent=2) if arguments.json else inspection_text(inspection))
    if arguments.out is not None:
        jpeg = None if arguments.out.suffix.lower() == ".png" else SHEET_QUALITY
        arguments.out.write_bytes(encode(inspection_sheet(inspection), jpeg)[1])
        if not arguments.json:
            print(f"\ntheir last pictures are in {arguments.out}")
    return FAULTY if inspection.faulty else 0
