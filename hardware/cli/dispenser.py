"""`stillbed dispenser` and `stillbed calibrate dispenser`: the command lines. Imports lazily."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from estimation.errors import InputError
from hardware.cli.parser import (
    FAILED,
    Commands,
    arm_profile,
    not_negative,
    option_error,
    positive,
    progress_bar,
    wall_clock,
)
from perception import named_path

if TYPE_CHECKING:
    from hardware.calibration.dispenser_record import LineOptions
    from hardware.dispenser.dispenser import Dispenser, DispenserProfile
    from hardware.files.dispenser_file import DispenserSettings
    from hardware.process.clock import Clock

VIRTUAL = "virtual"
MAX_OPEN = 60.0  # s: longer than any test of a nozzle
PREPARE_TIME = 600.0  # s to get ready: a heated syringe takes minutes
DISPENSER_POLL = 0.002  # s, as the motion loop
VIRTUAL_OPTIONS = ("preset", "log", "link", "delays", "ooze", "no_watchdog")
# sources of a dispenser's calibration, and the options that each needs
LINE_SOURCES = {"folder": (), "device": ("cameras", "arm", "record"), "virtual": ("record",), "measured": ()}
DEVICE_OPTIONS = ("name", "seconds", "on", "flow", "celsius", "yes")


def add_dispenser(commands: Commands) -> None:
    """Add the sub-command `dispenser`."""
    command = commands.add(
        "dispenser",
        _run_dispenser,
        "test a dispenser's line, open it for a moment; or serve a virtual dispenser",
        "Listen on the line of each dispenser of a file and print its messages; nothing is sent. With --on S and\n"
        "--yes, one dispenser is prepared, opened for S seconds and always closed, even after Ctrl-C. With the word\n"
        "`virtual` instead of a file, serve a virtual dispenser on a pseudo-terminal; Ctrl-C ends it with a summary.\n"
        "Exit code 1 if a line does not exist or a dispenser fails.",
        "stillbed dispenser dispenser.toml",
        "stillbed dispenser dispenser.toml --name syringe --on 2 --yes",
        "stillbed dispenser virtual --link ./dispenser --log flow.csv",
    )
    command.add_argument("which", metavar="DISPENSER.toml", help="dispenser file, or the word `virtual`")
    add = command.add_argument_group("dispensers of a file").add_argument
    add("--name", metavar="NAME", help="name of the dispenser, if the file has several")
    add("--seconds", type=positive, metavar="S", help="listening time; default 5")
    add("--on", type=positive, metavar="S", help=f"open time, at most {MAX_OPEN:g} s")
    add("--flow", type=positive, metavar="MM3_S", help="flow of a metered dispenser; default: middle of its range")
    add("--celsius", type=float, metavar="C", help="temperature to reach before it opens")
    add("--yes", action="store_true", help="confirm that somebody watches the material")
    add = command.add_argument_group("a virtual one").add_argument
    add("--preset", metavar="NAME", help="message format: arduino (the default), new_era or gcode_valve")
    add("--log", type=Path, metavar="FLOW.csv", help="write the true flow, one row per millisecond")
    add("--link", type=Path, metavar="LINK", help="symbolic link to create to the device")
    add("--delays", type=not_negative, nargs=4, metavar="S", help="on dead time, on lag, off dead time, off lag")
    add("--ooze", type=not_negative, metavar="MM3", help="volume that flows out after off")
    add("--no-watchdog", action="store_true", help="without watchdog: it stays on when its messages end")


def _run_dispenser(a: argparse.Namespace) -> int:
    virtual = a.which == VIRTUAL
    for name in DEVICE_OPTIONS if virtual else VIRTUAL_OPTIONS:
        if value := getattr(a, name):
            option, kind = f"--{name.replace('_', '-')}", "dispensers of a file" if virtual else "a virtual one"
            raise option_error(option, value, f"only for {kind}")
    return _serve(a) if virtual else _connect(a)


def _serve(a: argparse.Namespace) -> int:
    from dataclasses import replace

    from hardware.dispenser.messages import PRESETS
    from hardware.process.checks import one_of_text
    from hardware.simulator.dispenser import DIALECTS, VirtualDispenserSettings, run_virtual_dispenser

    preset = a.preset or "arduino"
    if preset not in DIALECTS:
        raise option_error("--preset", preset, one_of_text(preset, list(DIALECTS)))
    watchdog = None if a.no_watchdog else PRESETS[preset].watchdog
    settings = VirtualDispenserSettings(preset, ooze=a.ooze or 0.0, watchdog=watchdog or float("inf"))
    if a.delays is not None:
        names = ("on_dead_time", "on_lag", "off_dead_time", "off_lag")
        settings = replace(settings, **dict(zip(names, a.delays, strict=True)))
    run_virtual_dispenser(settings, a.log, a.link)
    return 0


def _connect(a: argparse.Namespace) -> int:
    from hardware.files.dispenser_file import dispenser_from_settings

    dispensers = _selected(named_path(a.which), a.name, single=a.on is not None)
    if a.on is None:
        for option in ("flow", "celsius", "yes"):
            if getattr(a, option):
                raise option_error(f"--{option}", getattr(a, option), "only with --on S")
        return max(listen(each, a.seconds or 5.0, wall_clock()) for each in dispensers)
    if a.seconds is not None:
        raise option_error("--seconds", a.seconds, "only without --on S")
    if a.on > MAX_OPEN:
        raise option_error("--on", a.on, f"at most {MAX_OPEN:g} s")
    if not a.yes:
        raise option_error("--yes", "missing", "the confirmation that somebody watches the material")
    if dispensers[0].line is None:
        raise option_error(
            "--on", dispensers[0].profile.name, "a dispenser with a line of its own; the arm switches this one"
        )
    return open_for(dispenser_from_settings(dispensers[0]), a.on, a.flow, a.celsius, wall_clock())


def description(settings: DispenserSettings) -> str:
    """A description of a dispenser from its file, in a few lines."""
    profile, line = settings.profile, settings.line
    by_arm = "switched by the arm's frames" if settings.extruder is None else "pushed by the arm's own axis"
    connection = by_arm if line is None else f"at {line.port}"
    watchdog = watchdog_text(profile) if settings.extruder is None else "flows in moves alone: without them it rests"
    if profile.metered:
        flow = f"metered, {profile.flow_range[0]:g} to {profile.flow_range[1]:g} mm^3/s"
    else:
        flow = f"not metered, about {profile.flow:g} mm^3/s"
    return (
        f"{profile.name} ({settings.preset}, {connection}): {', '.join(profile.materials)}; {flow}\n"
        f"  half its flow {1000 * profile.on_delay:.0f} ms after on, {1000 * profile.off_delay:.0f} ms after off\n"
        f"  {watchdog}"
    )


def watchdog_text(profile: DispenserProfile) -> str:
    """The behaviour of a dispenser when its messages end."""
    if profile.watchdog:
        return f"switches itself off {1000 * profile.watchdog:.0f} ms after its last message"
    return "HAS NO WATCHDOG: it stays on when this machine or its cable fails; have a switch at hand"


def listen(settings: DispenserSettings, seconds: float, clock: Clock) -> int:
    """Print the messages of a device, and send nothing; exit code."""
    from hardware.dispenser.dispenser import DispenserState
    from hardware.dispenser.line_dispenser import LineDispenser

    print(description(settings))
    if settings.line is None:
        return 0
    dispenser = LineDispenser(settings.profile, settings.line)
    start = clock.now()
    dispenser.listen(start)
    while clock.now() < start + seconds and dispenser.status.state is DispenserState.CLOSED:
        dispenser.poll(clock.now())
        clock.wait_until(clock.now() + DISPENSER_POLL)
    status, messages = dispenser.status, list(dispenser.heard)
    dispenser.hang_up()
    if status.state is DispenserState.FAILED:
        print(f"  failed: {status.reason}")
        return FAILED
    print(f"  its line is open; it said {len(messages)} lines in {seconds:g} s, and was sent nothing")
    for stamp, text in messages:
        print(f"  {stamp - start:.3f} s: {text}")
    return 0


def open_for(dispenser: Dispenser, seconds: float, flow: float | None, celsius: float | None, clock: Clock) -> int:
    """Prepare a dispenser, open it for `seconds` s, and close it in every case; exit code."""
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
            _tell(dispenser, start)
            clock.wait_until(now + DISPENSER_POLL)
        return dispenser.status.state is not DispenserState.FAILED

    print(watchdog_text(profile))
    try:
        dispenser.prepare(start, celsius)
        succeeded = wait(start + PREPARE_TIME, DispenserState.PREPARING)
        if succeeded and (reason := dispenser.on(flow, clock.now())):
            print(reason)
            succeeded = False
        succeeded = succeeded and wait(clock.now() + seconds, DispenserState.ON)
    finally:
        failure = close_dispensers(Dispensers([dispenser]), clock)
        _tell(dispenser, start)
    return 0 if succeeded and not failure else FAILED


def _tell(dispenser: Dispenser, start: float) -> None:
    for event in dispenser.events():
        print(f"{event.stamp - start:.3f} s: {event.text}")


def add_calibrate_dispenser(parts: Commands) -> None:
    """Add `dispenser` to the sub-commands of `calibrate`."""
    part = parts.add(
        "dispenser",
        _calibrate_dispenser,
        "calibrate a dispenser's delays with lines drawn before the cameras",
        "The arm draws straight lines at several speeds on a sheet of another colour; the cameras photograph them.\n"
        "Result: the dispenser's dead times and lags, with uncertainties, and a verdict. Start: the nozzle over the\n"
        "middle of the lines, at printing height. After PASS the delays are written to the file, except those of a\n"
        "virtual dispenser. Other sources: a recorded folder, or lengths measured with a ruler. Exit code 0: PASS;\n"
        "1: FAIL.",
        "stillbed calibrate dispenser dispenser.toml --device /dev/ttyUSB0 --arm arm.toml --cameras rig.toml "
        "--record lines --yes",
        "stillbed calibrate dispenser dispenser.toml --from lines",
        "stillbed calibrate dispenser dispenser.toml --virtual --record lines",
        "stillbed calibrate dispenser dispenser.toml --measured 1.1,0.9,10 --measured 3.2,2.8,30",
    )
    add = part.add_argument
    add("file", type=Path, metavar="DISPENSER.toml", help="dispenser file; the delays are written to it")
    add("--name", metavar="NAME", help="name of the dispenser, if the file has several")
    add("--from", dest="folder", type=Path, metavar="FOLDER", help="recorded lines; nothing moves")
    add("--device", metavar="DEVICE", help="port of the arm: a path, or a URL of pyserial")
    add("--virtual", action="store_true", help="simulated arm, dispenser and cameras; also prints the truth")
    ruler = "mm from the switch to half the line's width, at on and at off, and the speed in mm/s; once per line"
    add("--measured", type=_ruled_line, action="append", metavar="START,END,SPEED", help=ruler)
    add("--arm", type=Path, metavar="ARM.toml", help="the calibrated arm")
    add("--cameras", type=Path, metavar="RIG.toml", help="the calibrated cameras, with their sources")
    add("--record", type=Path, metavar="FOLDER", help="output folder for pictures, commands and switches, new")
    add("--celsius", type=float, metavar="C", help="temperature while it draws")
    add = part.add_argument_group("the lines").add_argument
    add("--speeds", type=_speeds, default=(10.0, 20.0, 30.0), metavar="A,B,C", help="speeds, mm/s; default 10,20,30")
    add("--lines", type=int, default=4, metavar="N", help="lines at each speed, to and fro in turn; default 4")
    add("--length-mm", type=positive, default=40.0, metavar="MM", help="length, along the arm's X; default 40")
    add("--spacing-mm", type=positive, default=6.0, metavar="MM", help="distance of the lines; default 6")
    add("--height-mm", type=not_negative, default=0.4, metavar="MM", help="nozzle's height over the sheet; default 0.4")
    add("--area-mm2", type=positive, default=0.4, metavar="MM2", help="bead's cross-section, if metered; default 0.4")
    add("--away", default="home", metavar="WHERE", help="position outside the pictures: X,Y,Z,A,B,C; default home")
    add("--stands", metavar="WHERE", help="position of an arm without replies: X,Y,Z,A,B,C or home")
    add("--yes", action="store_true", help="confirm: nobody is within reach, the material is watched")
    add("--no-pause-frame", action="store_true", help="the controller does not support the pause frame")


def _ruled_line(text: str) -> tuple[float, float, float]:
    start, end, speed = _numbers(text, 3, "START,END,SPEED, as 1.1,0.9,10")
    if not speed > 0:
        raise argparse.ArgumentTypeError(f"{text!r}, needed is a speed above 0")
    return start, end, speed


def _speeds(text: str) -> tuple[float, ...]:
    return _numbers(text, text.count(",") + 1, "speeds, as 10,20,30")


def _numbers(text: str, count: int, syntax: str) -> tuple[float, ...]:
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise argparse.ArgumentTypeError(f"{text!r}, needed is {syntax}")
    return numbers


def _calibrate_dispenser(a: argparse.Namespace) -> int:
    from hardware.calibration.arm_run import check_record
    from hardware.calibration.dispenser_lines import calibrate_lines
    from hardware.calibration.dispenser_record import LineOptions, delays_by_hand
    from hardware.files.dispenser_file import write_delays

    sources = [name for name in LINE_SOURCES if getattr(a, name)]
    if len(sources) != 1:
        got, allowed = " and ".join(sources) or "nothing", "one of --from, --device, --virtual or --measured"
        raise option_error("calibrate dispenser", got, allowed)
    for name in LINE_SOURCES[sources[0]]:
        if getattr(a, name) is None:
            raise option_error(f"--{name}", "missing", f"given with --{sources[0]}")
    options = LineOptions(a.speeds, a.lines, a.length_mm, a.spacing_mm, a.height_mm, a.area_mm2)
    (settings,) = _selected(a.file, a.name, single=True)
    if a.virtual:
        from dataclasses import replace

        # another name, so that `--from` does not use its delays for the real dispenser
        settings = replace(settings, profile=replace(settings.profile, name=VIRTUAL))
    if a.measured:
        delays = delays_by_hand(a.measured, settings.profile)
        write_delays(a.file, settings.profile.name, delays)
        delay_text = f"{1e3 * delays.on_delay:.0f} ms after on, {1e3 * delays.off_delay:.0f} ms after off"
        print(f"{a.file}: half the flow of {settings.profile.name} {delay_text}, was written")
        return 0
    if a.folder is None:
        if a.device is not None and not a.yes:
            raise option_error("--yes", "missing", "the confirmation that nobody is within reach")
        if settings.line is None:
            raise option_error("dispenser", settings.profile.name, "one with a line of its own; of others --measured")
        check_record(a.record)
        print(_draw_virtual(a, settings, options) if a.virtual else _draw(a, settings, options))
    verdict, text = calibrate_lines(a.folder or a.record, a.file, settings.profile, a.height_mm, not a.virtual)
    print(text)
    return 0 if verdict.passed else FAILED


def _selected(file: Path, name: str | None, single: bool) -> list[DispenserSettings]:
    """The dispensers of a file, or the one that --name selects. single: whether it has to be one."""
    from hardware.files.dispenser_file import read_dispensers

    dispensers = read_dispensers(file)
    selected = [each for each in dispensers if name in (None, each.profile.name)]
    if not selected or (single and len(selected) > 1):
        names = ", ".join(each.profile.name for each in dispensers)
        raise option_error("--name", name or "missing", f"one of {names}")
    return selected


def _draw_virtual(a: argparse.Namespace, settings: DispenserSettings, options: LineOptions) -> str:
    from hardware.calibration.dispenser_record import VIRTUAL_DELAYS, record_virtual
    from hardware.process.checks import one_of_text
    from hardware.simulator.dispenser import DIALECTS, VirtualDispenserSettings
    from hardware.simulator.watched_arm import watched_arm

    if settings.preset not in DIALECTS:
        raise option_error("--virtual", settings.preset, f"a preset {one_of_text(settings.preset, list(DIALECTS))}")
    flow = options.area * sum(options.speeds) / len(options.speeds)
    watchdog = settings.profile.watchdog or math.inf
    true = VirtualDispenserSettings(settings.preset, *VIRTUAL_DELAYS, flow=flow, watchdog=watchdog)
    assert settings.line is not None
    with progress_bar("lines", "ticks") as progress:
        record_virtual(watched_arm(0), settings.profile, settings.line, true, a.record, options, progress)
    names = ("on dead time", "on lag", "off dead time", "off lag")
    return "truth: " + ", ".join(f"{n} {1e3 * v:g} ms" for n, v in zip(names, VIRTUAL_DELAYS, strict=True))


def _draw(a: argparse.Namespace, settings: DispenserSettings, options: LineOptions) -> str:
    from hardware.arm.console import axes_from_text
    from hardware.arm.profile import LinkSettings, open_arm
    from hardware.calibration.dispenser_record import record_live
    from hardware.cameras.live import LiveCameras
    from hardware.cameras.sources import read_live_rig
    from hardware.files.dispenser_file import dispenser_from_settings

    clock, profile = wall_clock(), arm_profile(a.arm)
    start = None if a.stands is None else axes_from_text(a.stands, profile.arm.home)
    places = start, axes_from_text(a.away, profile.arm.home)
    rig, sources = read_live_rig(a.cameras)
    dispenser = dispenser_from_settings(settings)
    driver, link = open_arm(a.device, profile), LinkSettings(pause_frame=not a.no_pause_frame)
    with progress_bar("lines", "ticks") as progress:
        live = LiveCameras(rig, sources, clock)
        record_live(live, rig, driver, profile, dispenser, clock, a.record, places, options, a.celsius, progress, link)
    return watchdog_text(settings.profile)
