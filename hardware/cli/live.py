"""The command line of the live run: `stillbed live` and `stillbed init`. Imports lazily."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.package_data import named_path

FLAGS = (
    *("rig", "simulated", "path", "arm", "profile", "record"),
    *("dry_run", "lift", "stands_home", "jpeg_quality"),
    *("page_address", "page_port", "page_certificate", "page_key"),
)
Commands = Any  # argparse's own type for this is private


def add_live(commands: Commands) -> None:
    """Add the sub-command `live`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "live",
        help="print on a moving wound: track it, move the arm, record everything",
        description="Print on a wound that moves: check, find it and lay the path on it, approach, print. Space or\n"
        "Enter in the terminal stops the arm at once, Ctrl-C stops it and ends the run. What was recorded is whole\n"
        "whatever ends the run, and --resume goes on where it stopped. Exit code 0 where the path is printed, 1 where\n"
        "the run ended before, 2 for wrong input, 128 and more where a signal ended it.",
        epilog="examples:\n  stillbed live session.toml\n"
        "  stillbed live --rig rig.toml --path path.csv --arm /dev/ttyUSB0 --record run.mcap\n"
        "  stillbed live --simulated data/scenarios/breathing_calm.toml --record run.mcap --yes\n"
        "  stillbed live --resume run.mcap\n"
        "  stillbed live session.toml --page-address 0.0.0.0 --page-cert page.pem --page-key page.key --page-name lab",
        formatter_class=argparse.RawDescriptionHelpFormatter,
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
    command.set_defaults(run=_live)


def add_init(commands: Commands) -> None:
    """Add the sub-command `init`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "init",
        help="write a commented session.toml to begin with",
        description="Write FOLDER/session.toml, which says everything that a live run is told, with a comment a key.",
        epilog="example:\n  stillbed init monday",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("folder", type=Path, metavar="FOLDER", help="made if it is not there")
    command.set_defaults(run=_init)


def _live(arguments: argparse.Namespace) -> int:
    from estimation.errors import InputError
    from hardware.live.console import Console
    from hardware.live.prepared import prepare, prepare_again, with_faults
    from hardware.live.run import LiveRun
    from hardware.live.settings import LiveSettings, names_given, overridden, read_settings
    from hardware.process.faults import faults_from_texts

    a = arguments
    faults = faults_from_texts("command line", "--fault", a.fault)
    flags = {name: getattr(a, name) for name in FLAGS} | {"unattended": a.yes, "page": False if a.no_page else None}
    if a.page_name is not None:
        flags["page_names"] = names_given("command line", "--page-name", a.page_name)
    if a.resume is not None:
        if a.settings is not None or a.record is not None:
            raise InputError("command line", "--resume", a.resume, "without session.toml and --record")
        prepared = prepare_again(a.resume, flags)
    else:
        given = LiveSettings() if a.settings is None else read_settings(a.settings)
        prepared = prepare(overridden(given, flags), a.settings or "command line", a.force)
    with Console() as console:
        outcome = LiveRun(with_faults(prepared, faults), console)()
        outcome.write()
        console.say(outcome.words)
    return outcome.code


def _init(arguments: argparse.Namespace) -> None:
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
