"""`stillbed dispenser`: what a dispenser says, a short opening of it, and a virtual one. Imports lazily."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from estimation.errors import InputError
from hardware.cli.parser import FAILED, Commands, not_negative, positive, wrong_option
from hardware.process.clock import Clock, WallClock
from perception.package_data import named_path

if TYPE_CHECKING:
    from hardware.dispenser.dispenser import Dispenser, DispenserProfile
    from hardware.files.dispenser_file import DispenserSettings

VIRTUAL = "virtual"
MAX_OPEN = 60.0  # s: longer than any test of a nozzle
PREPARE_TIME = 600.0  # s to be ready: a heated syringe takes minutes
DISPENSER_POLL = 0.002  # s, as the motion loop
VIRTUAL_OPTIONS = ("preset", "log", "link", "delays", "ooze", "no_watchdog")
DEVICE_OPTIONS = ("name", "seconds", "on", "flow", "celsius", "yes")


def add_dispenser(commands: Commands) -> None:
    """Add the sub-command `dispenser`."""
    command = commands.add(
        "dispenser",
        _run_dispenser,
        "see what answers on a dispenser's line, open it for a moment; or serve a virtual one",
        "Listen on the line of each dispenser of a file and tell what it says; nothing is sent. With --on S and\n"
        "--yes, one of them is prepared, opened for S seconds and closed, whatever ends the command. With the word\n"
        "virtual instead of a file, serve a virtual dispenser on a pseudo-terminal; Ctrl-C ends it with a summary.\n"
        "Exit code 1 where a line is not there, or the dispenser fails.",
        "stillbed dispenser dispenser.toml",
        "stillbed dispenser dispenser.toml --name syringe --on 2 --yes",
        "stillbed dispenser virtual --link ./dispenser --log flow.csv",
    )
    command.add_argument("which", metavar="DISPENSER.toml", help="a dispenser file, or the word virtual")
    add = command.add_argument_group("dispensers of a file").add_argument
    add("--name", metavar="NAME", help="which of them, where there are several")
    add("--seconds", type=positive, metavar="S", help="to listen; default 5")
    add("--on", type=positive, metavar="S", help=f"let material out for so long, at most {MAX_OPEN:g} s")
    add("--flow", type=positive, metavar="MM3_S", help="of a metered one; default: the middle of its range")
    add("--celsius", type=float, metavar="C", help="its temperature before that")
    add("--yes", action="store_true", help="somebody sees where the material goes")
    add = command.add_argument_group("a virtual one").add_argument
    add("--preset", metavar="NAME", help="the language it speaks: arduino (the default), new_era or gcode_valve")
    add("--log", type=Path, metavar="FLOW.csv", help="write its true flow, a row a millisecond")
    add("--link", type=Path, metavar="LINK", help="a symbolic link to make to the device")
    add("--delays", type=not_negative, nargs=4, metavar="S", help="on dead time, on lag, off dead time, off lag")
    add("--ooze", type=not_negative, metavar="MM3", help="volume that follows after off")
    add("--no-watchdog", action="store_true", help="it stays on when nobody speaks to it any more")


def _run_dispenser(a: argparse.Namespace) -> int:
    virtual = a.which == VIRTUAL
    for name in DEVICE_OPTIONS if virtual else VIRTUAL_OPTIONS:
        if value := getattr(a, name):
            option, kind = f"--{name.replace('_', '-')}", "dispensers of a file" if virtual else "a virtual one"
            raise wrong_option(option, value, f"only for {kind}")
    return _serve(a) if virtual else _connect(a)


def _serve(a: argparse.Namespace) -> int:
    from hardware.dispenser.messages import PRESETS
    from hardware.process.checks import one_of_text
    from hardware.simulator.dispenser import DIALECTS, VirtualDispenserSettings, run_virtual_dispenser

    preset = a.preset or "arduino"
    if preset not in DIALECTS:
        raise wrong_option("--preset", preset, one_of_text(preset, list(DIALECTS)))
    watchdog = None if a.no_watchdog else PRESETS[preset].watchdog
    settings = VirtualDispenserSettings(preset, ooze=a.ooze or 0.0, watchdog=watchdog or float("inf"))
    if a.delays is not None:
        names = ("on_dead_time", "on_lag", "off_dead_time", "off_lag")
        settings = replace(settings, **dict(zip(names, a.delays, strict=True)))
    run_virtual_dispenser(settings, a.log, a.link)
    return 0


def _connect(a: argparse.Namespace) -> int:
    from hardware.files.dispenser_file import dispenser_from_settings, read_dispensers

    path = named_path(a.which)
    found = read_dispensers(path)
    if a.name is not None:
        names = [each.profile.name for each in found]
        found = tuple(each for each in found if each.profile.name == a.name)
        if not found:
            raise wrong_option("--name", a.name, f"one of {', '.join(names)}")
    if a.on is None:
        for option in ("flow", "celsius", "yes"):
            if getattr(a, option):
                raise wrong_option(f"--{option}", getattr(a, option), "only with --on S")
        return max(listen(each, a.seconds or 5.0, WallClock()) for each in found)
    if a.seconds is not None:
        raise wrong_option("--seconds", a.seconds, "only without --on S")
    if len(found) > 1:
        raise wrong_option("--name", "missing", f"one of {', '.join(each.profile.name for each in found)}")
    if a.on > MAX_OPEN:
        raise wrong_option("--on", a.on, f"at most {MAX_OPEN:g} s")
    if not a.yes:
        raise wrong_option("--yes", "missing", "given by whoever sees where the material goes")
    if found[0].line is None:
        raise wrong_option(
            "--on", found[0].profile.name, "a dispenser with a line of its own; the arm switches this one"
        )
    return open_for(dispenser_from_settings(found[0]), a.on, a.flow, a.celsius, WallClock())


def description(settings: DispenserSettings) -> str:
    """What a dispenser is by its file, in a few lines."""
    profile, line = settings.profile, settings.line
    where = "switched by the arm's frames" if line is None else f"at {line.port}"
    if profile.metered:
        flow = f"metered, {profile.flow_range[0]:g} to {profile.flow_range[1]:g} mm^3/s"
    else:
        flow = f"not metered, about {profile.flow:g} mm^3/s"
    return (
        f"{profile.name} ({settings.preset}, {where}): {', '.join(profile.materials)}; {flow}\n"
        f"  half its flow {1000 * profile.on_delay:.0f} ms after on, {1000 * profile.off_delay:.0f} ms after off\n"
        f"  {watchdog_text(profile)}"
    )


def watchdog_text(profile: DispenserProfile) -> str:
    """What becomes of it when nobody speaks to it any more."""
    if profile.watchdog:
        return f"switches itself off {1000 * profile.watchdog:.0f} ms after its last message"
    return "HAS NO WATCHDOG: it stays on when this machine or its cable fails; have a switch at hand"


def listen(settings: DispenserSettings, seconds: float, clock: Clock, say: Callable[[str], None] = print) -> int:
    """Tell what a device says by itself, and send nothing; exit code."""
    from hardware.dispenser.dispenser import DispenserState
    from hardware.dispenser.line_dispenser import LineDispenser

    say(description(settings))
    if settings.line is None:
        return 0
    dispenser = LineDispenser(settings.profile, settings.line)
    start = clock.now()
    dispenser.listen(start)
    while clock.now() < start + seconds and dispenser.status.state is DispenserState.CLOSED:
        dispenser.poll(clock.now())
        clock.wait_until(clock.now() + DISPENSER_POLL)
    status, heard = dispenser.status, list(dispenser.heard)
    dispenser.hang_up()
    if status.state is DispenserState.FAILED:
        say(f"  failed: {status.reason}")
        return FAILED
    say(f"  its line is open; it said {len(heard)} lines in {seconds:g} s, and was sent nothing")
    for stamp, text in heard:
        say(f"  {stamp - start:.3f} s: {text}")
    return 0


def open_for(
    dispenser: Dispenser,
    seconds: float,
    flow: float | None,
    celsius: float | None,
    clock: Clock,
    say: Callable[[str], None] = print,
) -> int:
    """Prepare a dispenser, let material out for so long, and close it however that ends; exit code."""
    from hardware.dispenser.dispenser import Dispensers, DispenserState, close_dispensers

    start, profile = clock.now(), dispenser.profile
    flow = sum(profile.flow_range) / 2 if flow is None else flow
    if reason := profile.wrong_flow(flow):
        raise InputError("command line", "--flow", flow, reason)
    if celsius is not None and (allowed := profile.wrong_temperature(celsius)):
        raise InputError("command line", "--celsius", celsius, allowed)

    def wait(end: float, state: DispenserState) -> bool:
        while (now := clock.now()) < end and dispenser.status.state is state:
            dispenser.poll(now)
            _tell(dispenser, start, say)
            clock.wait_until(now + DISPENSER_POLL)
        return dispenser.status.state is not DispenserState.FAILED

    say(watchdog_text(profile))
    try:
        dispenser.prepare(start, celsius)
        done = wait(start + PREPARE_TIME, DispenserState.PREPARING)
        if done and (reason := dispenser.on(flow, clock.now())):
            say(reason)
            done = False
        done = done and wait(clock.now() + seconds, DispenserState.ON)
    finally:
        left = close_dispensers(Dispensers([dispenser]), clock)
        _tell(dispenser, start, say)
    return 0 if done and not left else FAILED


def _tell(dispenser: Dispenser, start: float, say: Callable[[str], None]) -> None:
    for event in dispenser.events():
        say(f"{event.stamp - start:.3f} s: {event.text}")
