"""Drawing lines for a dispenser's calibration: what the arm is sent, and the dispenser told on the way, without a lead.

The nozzle begins over the sheet, as high as it prints. The sheet is photographed before and after, the arm away both
times. A recorded folder holds what `calibrate arm` records, and switches.csv: stamp_s,dispenser,flow_mm3_s,text.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.device import ArmState
from hardware.arm.driver import ArmDriver
from hardware.arm.link import Arm
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.arm.s6h4d import S6H4D
from hardware.calibration.arm_record import (
    ARM_FILE,
    COMMANDED_FILE,
    ArmDrive,
    CommandedFile,
    MoveOptions,
    arm_before_cameras,
    check_moves,
    read_commanded,
    straight_move,
)
from hardware.cameras.live import LiveCameras
from hardware.dispenser.dispenser import Dispenser, DispenserProfile, Dispensers, DispenserState, close_dispensers
from hardware.dispenser.line_dispenser import LineDispenser
from hardware.dispenser.messages import DispenserLine
from hardware.files.arm_file import write_arm
from hardware.process import checks
from hardware.process.clock import Clock, SimClock
from hardware.process.progress import ProgressReport, no_progress
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import VirtualDevice
from hardware.simulator.dispenser import DispenserModel, DispenserPort, VirtualDispenserSettings
from hardware.simulator.watched_arm import WatchedArm, paint_sheet
from planning.kinematics import nozzle_from_axes
from planning.material import MAX_DELAY

SWITCHES_FILE, SWITCH_COLUMNS = "switches.csv", ("stamp_s", "dispenser", "flow_mm3_s", "text")
RAMP, STEADY, TAIL = 0.3, 0.25, 0.8  # s: speeding up, on until the switch, and on after off
LOOK_TIME, LOOK_SETTLE = 2.5, 1.0  # s away, and of it before pictures are taken
LIFT = 5.0  # mm between lines
TRAVEL = MoveOptions(speed=60.0)  # between lines, and away
PREPARE_TIME = 600.0  # s to be ready: a heated syringe takes minutes
STALL = 0.15  # s without a set-point after which material is stopped
MIN_LINES = 4
MIN_LENGTH, MAX_OFF_TRACK = 5.0, 0.15  # mm from on to off; of the nozzle off a straight line at constant speed
DEPOSIT_STEP = 0.001  # s between the places of a virtual nozzle
VIRTUAL_DELAYS = (0.08, 0.04, 0.06, 0.05)  # s, of a virtual dispenser: on dead time, on lag, off dead time, off lag


@dataclass(frozen=True, slots=True)
class LineOptions:
    """The lines to draw; InputError for a value out of range."""

    speeds: tuple[float, ...] = (10.0, 20.0, 30.0)  # mm/s
    repeats: int = 4  # lines at each speed, to and fro in turn
    length: float = 40.0  # mm from on to off
    spacing: float = 6.0  # mm between lines
    height: float = 0.4  # mm of the nozzle above the sheet
    area: float = 0.4  # mm^2, cross-section of a metered one's bead

    def __post_init__(self) -> None:
        if not (len(set(self.speeds)) >= 2 and all(2 <= v <= 60 for v in self.speeds)):
            raise InputError("lines", "speeds", list(self.speeds), "two different ones or more, 2 to 60 mm/s")
        limits = {"repeats": (1, 20), "length": (10, 150), "spacing": (3, 20), "height": (0, 5), "area": (0.01, 10)}
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise InputError("lines", name, getattr(self, name), f"{low:g} to {high:g}")
        if self.length / max(self.speeds) < 1.0:
            raise InputError("lines", "length", self.length, "a second or more at the highest speed")


@dataclass(frozen=True, slots=True, eq=False)
class LinePlan:
    """What is sent, one set-point a tick; switches and looks by how many set-points were sent before."""

    targets: Array  # (K, 6) mm and rad
    switches: Mapping[int, float]  # the speed, mm/s, of the line that begins; 0: off
    looks: tuple[range, range]  # pictures are taken, before and after


def plan_lines(start: Array, away: Array, tick: float, options: LineOptions) -> LinePlan:
    """Lines along the arm's X about `start` (6,), where the nozzle is over the sheet; looks from `away` (6,)."""
    parts: list[Array] = []
    switches: dict[int, float] = {}
    looks, at = [], start

    def sent() -> int:
        return sum(map(len, parts))

    def go(*places: Array) -> None:
        nonlocal at
        for place in places:
            parts.extend(straight_move(at, place, tick, TRAVEL))
            at = place

    def look() -> None:
        parts.append(np.repeat(away[None], round(LOOK_TIME / tick), axis=0))
        looks.append(range(sent() - round((LOOK_TIME - LOOK_SETTLE) / tick), sent()))

    up = np.array([0, 0, LIFT, 0, 0, 0])
    go(start + up, away)
    look()
    count = len(options.speeds) * options.repeats
    for number in range(count):
        speed, forth = options.speeds[number % len(options.speeds)], (-1) ** (number // len(options.speeds))
        ramp, on = round(RAMP / tick), round((RAMP + STEADY) / tick)
        steady = on - ramp + round((options.length / speed + TAIL) / tick)
        pace = np.concatenate([np.linspace(0, 1, ramp + 1)[1:], np.ones(steady), np.linspace(1, 0, ramp + 1)[1:]])
        way = np.cumsum(pace) * speed * tick
        line = np.repeat(start[None], len(way), axis=0)
        line[:, 0] += forth * (way - way[on - 1] - options.length / 2)
        line[:, 1] += (number - (count - 1) / 2) * options.spacing
        first = line[0] - [forth * way[0], 0, 0, 0, 0, 0]
        go(first + up, first)
        switches |= {sent() + on: speed, sent() + on + round(options.length / speed / tick): 0.0}
        parts.append(line)
        at = line[-1]
        go(at + up)
    go(away)
    look()
    return LinePlan(np.concatenate(parts), switches, (looks[0], looks[1]))


class SwitchedDrawing:
    """A dispenser beside a moving arm: polled, switched by how many set-points were sent, and written down.

    Material stops where the arm is not armed, or is sent nothing for STALL.
    """

    def __init__(self, arm: Arm, dispenser: Dispenser, clock: Clock, path: Path) -> None:
        self._arm, self._dispenser, self._clock = arm, dispenser, clock
        self._file = path.open("w", encoding="utf-8", newline="")
        self._rows = csv.writer(self._file)
        self._rows.writerow(SWITCH_COLUMNS)
        self._on, self._sent_at = False, clock.now()

    def poll(self, now: float) -> None:
        """What is due; every few milliseconds."""
        stalled = now > self._sent_at + STALL or self._arm.state is not ArmState.ARMED
        if stalled and self._dispenser.status.state is DispenserState.ON:
            self._dispenser.off(now)
        self._dispenser.poll(now)
        self.note()

    def note(self) -> None:
        """Write down what the dispenser did."""
        for event in self._dispenser.events():
            flow = "" if event.flow is None else f"{event.flow:g}"
            self._rows.writerow([f"{event.stamp:.6f}", self._dispenser.profile.name, flow, event.text])
        self._file.flush()

    def sent(self, flow: float | None) -> None:
        """A set-point was sent, and the dispenser is due at `flow`, mm^3/s; None: as before. InputError: it is not."""
        self._sent_at = now = self._clock.now()
        if flow is None and self._on and self._dispenser.status.state is not DispenserState.ON:
            raise InputError("dispenser", "line", self._dispenser.status.reason, "one that stays on until it is told")
        if flow and (refusal := self._dispenser.on(flow, now)):
            raise InputError("dispenser", "on", refusal, "a dispenser that does what it is told")
        if flow == 0:
            self._dispenser.off(now)
        self._on = bool(flow) if flow is not None else self._on

    def close(self) -> None:
        """Let the file go."""
        self._file.close()


def draw_lines(
    arm: Arm,
    dispenser: Dispenser,
    clock: Clock,
    folder: Path,
    stands: Array | None,
    away: Array,
    options: LineOptions,
    celsius: float | None = None,
    look: Callable[[bool], None] = lambda wanted: None,
    report: ProgressReport = no_progress,
) -> None:
    """Draw the lines about where the nozzle stands; writes commanded.csv and switches.csv.

    look: told each tick whether pictures are wanted. However it ends, the dispenser is off and the arm at rest.
    InputError where the arm or the dispenser refuses, before the first move where that can be known.
    """
    for speed in options.speeds:
        if reason := dispenser.profile.wrong_flow(options.area * speed):
            raise InputError("lines", f"flow at {speed:g} mm/s", options.area * speed, reason)
    with (
        CommandedFile(folder / COMMANDED_FILE) as log,
        closing(SwitchedDrawing(arm, dispenser, clock, folder / SWITCHES_FILE)) as drawing,
    ):
        drive = ArmDrive(arm, clock, log, drawing.poll)
        try:
            start = drive.ready(stands)
            plan = plan_lines(start, away, arm.profile.tick, options)
            check_moves(arm.profile, start, plan.targets)
            dispenser.prepare(clock.now(), celsius)
            drive.wait(PREPARE_TIME, lambda: dispenser.status.state is not DispenserState.PREPARING)
            if dispenser.status.state is not DispenserState.READY:
                raise InputError("dispenser", "prepare", dispenser.status.reason, "a dispenser that gets ready")

            def sent(done: int, total: int) -> None:
                speed = plan.switches.get(done)
                drawing.sent(None if speed is None else options.area * speed)
                look(any(done in span for span in plan.looks))
                report(done, total)

            drive.follow(plan.targets, sent)
        finally:
            dispenser.off(clock.now())
            drive.halt("the calibration was ended") if arm.travels else arm.disarm(clock.now())
            left = close_dispensers(Dispensers([dispenser]), clock)
            drawing.note()
            log.note(arm, clock.now())
    if left:
        raise InputError("dispenser", "off", left[0], "a dispenser that closes")


@dataclass(frozen=True, slots=True, eq=False)
class DrawnLine:
    """One line as it was meant. wrong: why it cannot count, "" if it can."""

    speed: float  # mm/s
    length: float  # mm from on to off
    frame: Array  # (4, 4) mm, base_from_line: x along it from the nozzle's place at on, z up, on the sheet
    forth: float  # 1 along the first line, -1 against it
    wrong: str


def read_switches(path: Path, name: str) -> list[tuple[float, float]]:
    """When (on, off), s, each line began and ended; InputError where it was not dispenser `name` that was told so."""
    rows = checks.read_csv(path, f"a CSV file with {','.join(SWITCH_COLUMNS)}")
    if not rows or tuple(rows[0][1]) != SWITCH_COLUMNS:
        raise InputError(path, "line 1", ",".join(rows[0][1]) if rows else "nothing", ",".join(SWITCH_COLUMNS))
    lines, on_stamp = [], None
    for number, cells in rows[1:]:
        if len(cells) == len(SWITCH_COLUMNS) and not cells[2]:
            continue
        try:
            stamp, dispenser, flow, text = float(cells[0]), cells[1], float(cells[2]), ",".join(cells[3:])
        except (ValueError, IndexError):
            raise InputError(path, f"line {number}", ",".join(cells), ",".join(SWITCH_COLUMNS)) from None
        if dispenser != name:
            raise InputError(path, f"line {number}: dispenser", dispenser, f"{name!r}, which is calibrated")
        if flow > 0:
            on_stamp = stamp
        elif text != "off":
            raise InputError(path, f"line {number}", text, "a dispenser that goes off only where it is told")
        elif on_stamp is not None:
            lines.append((on_stamp, stamp))
            on_stamp = None
    if len(lines) < MIN_LINES:
        raise InputError(path, "lines", len(lines), f"{MIN_LINES} or more, each told on and off")
    return lines


def drawn_lines(
    folder: Path, profile: ArmProfile, offset: Array, switches: Sequence[tuple[float, float]], height: float
) -> list[DrawnLine]:
    """The lines as the arm drew them, `height` mm under the nozzle; offset: (3,) mm, its tip in the tool's frame."""
    set_point, lag = read_commanded(folder / COMMANDED_FILE), max(profile.lag - profile.frame_time, 0.0)
    lines: list[DrawnLine] = []
    first: Array | None = None
    for on, off in switches:
        stamps = np.linspace(on - STEADY / 2, off + 0.8 * TAIL, 200)
        poses = nozzle_from_axes(profile.arm, set_point.lagged(np.append(stamps, [on, off]), lag / 2, lag / 2))
        tips = se3.transform_points(poses, offset[None])[:, 0]
        direction, up = tips[-1] - tips[-2], poses[-2, :3, 2]
        length = float(np.linalg.norm(direction))
        if length < MIN_LENGTH:
            lines.append(DrawnLine(0.0, length, np.eye(4), 1.0, f"the nozzle moved by {length:.1f} mm from on to off"))
            continue
        axis, speed = direction / length, length / (off - on)
        deviation = np.linalg.norm(tips[:-2] - tips[-2] - np.outer((stamps - on) * speed, axis), axis=1).max()
        across = np.cross(up, axis) / np.linalg.norm(np.cross(up, axis))
        frame = se3.make(np.stack([axis, across, np.cross(axis, across)], 1), tips[-2] - height * up)
        first = axis if first is None else first
        forth = 1.0 if axis @ first > 0 else -1.0
        wrong = f"the nozzle was up to {deviation:.2f} mm off a straight way at constant speed"
        lines.append(DrawnLine(speed, length, frame, forth, wrong if deviation > MAX_OFF_TRACK else ""))
    return lines


def record_live(
    live: LiveCameras,
    rig: Rig,
    driver: ArmDriver,
    profile: ArmProfile,
    dispenser: Dispenser,
    clock: Clock,
    folder: Path,
    where: tuple[Array | None, Array],
    options: LineOptions,
    celsius: float | None,
    report: ProgressReport,
    link: LinkSettings,
) -> None:
    """Draw the lines before live cameras. where: as `stands` and `away` of `draw_lines`."""
    write_arm(folder / ARM_FILE, profile, "the arm as it was taken to be while a dispenser was calibrated")
    with arm_before_cameras(live, rig, driver, profile, clock, folder, link, keep=False) as (arm, writer):

        def look(wanted: bool) -> None:
            writer.check()
            writer.keep = wanted

        draw_lines(arm, dispenser, clock, folder, *where, options, celsius, look, report)


def record_virtual(
    watched: WatchedArm,
    profile: DispenserProfile,
    line: DispenserLine,
    true: VirtualDispenserSettings,
    folder: Path,
    options: LineOptions,
    report: ProgressReport = no_progress,
) -> DispenserModel:
    """Draw them in virtual time, and paint what the cameras see of the sheet; returns the virtual dispenser."""
    late = watched.profile.frame_time + watched.settings.dead_time + watched.settings.servo_lag
    own = replace(watched.profile, arm=watched.true, lag=late)
    write_arm(folder / ARM_FILE, own, "the virtual arm as it is")
    clock, model, looks = SimClock(), DispenserModel(true), []
    begin = np.concatenate([own.arm.home[:2], [50.0 + options.height], own.arm.home[3:]])
    virtual = VirtualArm(watched.settings, own.dialect, begin, (), own.baud)
    arm = Arm(S6H4D(VirtualDevice(virtual, clock, own.baud), own), own, 0.0)

    def look(wanted: bool) -> None:
        if wanted:
            looks.append(clock.now())

    dispenser = LineDispenser(profile, line, DispenserPort(model, clock))
    draw_lines(arm, dispenser, clock, folder, begin, own.arm.home, options, None, look, report)
    virtual.advance(clock.now())
    instants = np.arange(0.0, clock.now(), DEPOSIT_STEP)
    tips = nozzle_from_axes(own.arm, virtual.axes_at(instants))
    sheet = nozzle_from_axes(own.arm, begin) @ se3.make(np.eye(3), [0, 0, -options.height])
    places = se3.transform_points(se3.inverse(sheet), tips[:, :3, 3])
    speed = np.linalg.norm(np.gradient(places, DEPOSIT_STEP, axis=0), axis=1)
    width = model.flow_at(instants) / np.maximum(speed, 1.0) / max(options.height, 0.1)
    wet = (width > 0.01) & (np.abs(places[:, 2] - options.height) < 0.5)
    stamps = np.array(looks)
    half = np.flatnonzero(np.diff(stamps) > LOOK_SETTLE)[0] + 1
    paint_sheet(watched, sheet, places[wet, :2], width[wet] / 2, folder, (stamps[:half], stamps[half:]))
    return model


def delays_by_hand(lines: Sequence[tuple[float, float, float]], dispenser: DispenserProfile) -> DispenserProfile:
    """The profile with delays from lines measured with a ruler: (start mm, end mm, speed mm/s) each.

    start and end: from where the nozzle was when it was told to half the width. A ruler shows no lag: all is dead time.
    """
    start, end, speed = np.array(lines).T
    apart = len(set(speed.tolist())) > 1
    columns = np.stack([speed, np.ones_like(speed)], 1) if apart else speed[:, None]
    on, off = (float(np.linalg.lstsq(columns, places, rcond=None)[0][0]) for places in (start, end))
    for name, value in (("start", on), ("end", off)):
        if not 0 <= value <= MAX_DELAY:
            raise InputError(
                "command line", f"--measured: delay by the {name}", f"{value:.3f} s", f"0 to {MAX_DELAY:g} s"
            )
    return replace(dispenser, on_dead_time=on, on_lag=0.0, off_dead_time=off, off_lag=0.0)
