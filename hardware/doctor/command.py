"""`stillbed doctor`: what works on this machine, and what to do about the rest. Imports lazily."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hardware.cli.parser import Commands

if TYPE_CHECKING:
    from hardware.operator.view import Check

UNWELL = 1  # exit code where something failed


def add_doctor(commands: Commands) -> None:
    """Add the sub-command `doctor`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "doctor",
        help="what works on this machine, and what to do about the rest",
        description="Look at the processor, memory, disk, priority, libraries, cameras, serial ports and the shipped\n"
        "network, and say of each whether a live run can be made with it, and what to do where it cannot. Moves\n"
        "nothing and writes nothing. Exit code 1 where something fails; a warning does not.",
        epilog="example:\n  stillbed doctor",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("--folder", type=Path, default=Path(), metavar="DIR", help="where sessions will be recorded")
    command.add_argument("--json", action="store_true", help="print JSON")
    command.set_defaults(run=_doctor)


def _doctor(arguments: argparse.Namespace) -> int:
    import json
    from dataclasses import asdict

    from estimation.errors import InputError
    from hardware.doctor.libraries import library_checks
    from hardware.doctor.machine import machine_checks
    from hardware.live.checklist import table
    from hardware.operator.view import Verdict
    from hardware.process.clock import WallClock

    if not arguments.folder.is_dir():
        raise InputError("command line", "--folder", arguments.folder, "a folder that exists")
    libraries = library_checks()
    machine = machine_checks(arguments.folder, WallClock())
    broken = any(check.verdict is Verdict.FAIL for check in libraries)
    parts = {"machine": machine, "libraries": libraries, "devices": [] if broken else _devices()}
    checks = [check for part in parts.values() for check in part]
    if arguments.json:
        print(json.dumps({name: [asdict(check) for check in part] for name, part in parts.items()}, indent=2))
    else:
        print("\n\n".join(f"{name}\n{table(tuple(part))}" for name, part in parts.items() if part))
        print(f"\n{_word([check.verdict for check in checks], broken)}")
    return UNWELL if any(check.verdict is Verdict.FAIL for check in checks) else 0


def _devices() -> list[Check]:
    """Imported only where the libraries load: they are needed to look."""
    from hardware.cli.doctor import device_checks

    return device_checks()


def _word(verdicts: list[Any], broken: bool) -> str:
    failed, warned = (sum(v.value == word for v in verdicts) for word in ("fail", "warn"))
    if broken:
        return "libraries are missing; devices were not looked at. Mend these first, then ask again"
    if failed:
        return f"{failed} failed: stillbed does not work here until that is mended"
    if warned:
        return f"all that stillbed needs works; {warned} to look at before a live run"
    return "all works; try: make demo, or stillbed init FOLDER"
