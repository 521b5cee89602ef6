"""The command line of the arm: the one on a port, or a virtual one to play with. Imports lazily."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hardware.cli.parser import Commands, positive
from perception.package_data import named_path


def add_arm(commands: Commands) -> None:
    """Add the sub-command `arm`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "arm",
        help="see what answers on the arm's port, home it; or serve a virtual one",
        description="Listen on the port of a SEED S6H4D and tell what answers, how often and from where; nothing is\n"
        "sent unless a move is asked for, and a move needs --yes. With --virtual, serve a virtual arm on a\n"
        "pseudo-terminal instead, for any client that speaks its protocol; Ctrl-C ends it with a summary.",
        epilog="examples:\n  stillbed arm /dev/ttyUSB0\n  stillbed arm /dev/ttyUSB0 --home --yes\n"
        "  stillbed arm --virtual --link ./arm --replies stream --fault 'stall 600ms at 5s'",
        formatter_class=argparse.RawDescriptionHelpFormatter,
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
    command.set_defaults(run=_arm)


def _arm(arguments: argparse.Namespace) -> int | None:
    from hardware.arm.profile import ArmProfile
    from hardware.files.arm_file import read_arm

    profile = ArmProfile() if arguments.arm is None else read_arm(arguments.arm)
    if arguments.virtual:
        _serve(arguments, profile)
        return None
    return _connect(arguments, profile)


def _serve(arguments: argparse.Namespace, profile: Any) -> None:
    from hardware.process.faults import Part, Runner, check_faults, faults_from_texts
    from hardware.simulator.arm.settings import arm_settings_from_table
    from hardware.simulator.port import run_virtual_arm

    settings = arm_settings_from_table("command line", {"replies": arguments.replies})
    faults = faults_from_texts("command line", "--fault", arguments.fault, Part.ARM)
    check_faults(faults, Runner.ARM, "command line", "--fault")
    run_virtual_arm(settings, profile, faults, arguments.link, arguments.log)


def _connect(arguments: argparse.Namespace, profile: Any) -> int:
    from hardware.arm.console import Request, axes_from_text, jog_from_text, origin_from_text, run_arm
    from hardware.arm.port import Device
    from hardware.arm_status import ArmState
    from hardware.link_settings import LinkSettings
    from hardware.process.clock import WallClock

    request = Request(
        seconds=float("inf") if arguments.watch else arguments.seconds,
        home=arguments.home,
        jog=None if arguments.jog is None else jog_from_text(arguments.jog),
        stands=None if arguments.stands is None else axes_from_text(arguments.stands, profile.arm.home),
        origin=None if arguments.origin is None else origin_from_text(arguments.origin),
        confirmed=arguments.yes,
    )
    settings = LinkSettings(pause_frame=not arguments.no_pause_frame)
    device = Device(arguments.device, profile.baud)
    try:
        status = run_arm(device, profile, request, WallClock(), settings=settings)
    finally:
        device.release()
    return 0 if status.state is ArmState.DISARMED else 1
