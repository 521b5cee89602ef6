"""The dispensers of a simulated print, commanded over lines in virtual time; with a scenario's delays and ooze.

[dispenser]                # left out: one without delay that gives each bead its planned flow while it is open
on_dead_time_s = 0.08      # these are true of the device; hardware/simulator/dispenser.py says what they mean
on_lag_s = 0.04
off_dead_time_s = 0.08
off_lag_s = 0.04
ooze_mm3 = 0.5
ooze_lag_s = 0.5
watchdog_s = 0.1
flow_mm3_s = 5.0           # the flow of a valve; left out: it gives the flow that is commanded
given = 1.1                # true by commanded flow: 1.1 lays too much, 0.9 too little
led = true                 # whether the motion knows the four delays and leads them; false: it assumes 0
file = "dispenser.toml"    # or the dispenser file that the motion assumes
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as File

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.dispenser.dispenser import DispenserProfile, Dispensers, check_path_materials
from hardware.dispenser.line_dispenser import LineDispenser
from hardware.dispenser.messages import PRESETS
from hardware.files.dispenser_file import DispenserSettings, outlets_from, read_dispensers
from hardware.motion.loop import MaterialControl
from hardware.process import checks
from hardware.process.clock import Clock
from hardware.process.faults import Fault, FaultKind, FaultPart, faults_striking
from hardware.simulator.dispenser import DIALECTS, DispenserModel, DispenserPort, VirtualDispenserSettings
from hardware.simulator.scene.fields import GelPieces
from hardware.simulator.scene.scene import Scene
from hardware.simulator.truth import Truth, TruthLog
from planning.command import Command, Move
from planning.material import Outlets
from planning.path import Path

TRUTH_KEYS: checks.Keys = {  # in a table [dispenser]
    **{f"{name}_s": (name, checks.number) for name in ("on_dead_time", "on_lag", "off_dead_time", "off_lag")},
    **{f"{name}_s": (name, checks.number) for name in ("ooze_lag", "watchdog")},
    **{"ooze_mm3": ("ooze", checks.number), "flow_mm3_s": ("flow", checks.number)},
}
IDEAL = VirtualDispenserSettings(on_dead_time=0.0, on_lag=0.0, off_dead_time=0.0, off_lag=0.0)
METERED_ON = "ON {flow_mm3_s}"  # in the language of `arduino`
ROUNDING = 1e-9  # s: shorter intervals are rounding errors of instants
ANSWER_TIME = 0.01  # s from a line's return until the dispenser has been polled and commanded
PRESET = "arduino"
MAX_FLOW_SHARE = 3.0  # of the commanded flow: a pump that gives more is not the one that was calibrated


@dataclass(frozen=True, slots=True)
class SimulatedDispenser:
    """A table [dispenser] of a scenario."""

    truth: VirtualDispenserSettings  # of the device
    metered: bool = True  # whether it gives the flow that is commanded
    delays_known: bool = True  # whether the motion knows its delays
    assumed: tuple[DispenserSettings, ...] = ()  # of a file, by the motion
    flow_share: float = 1.0  # true flow by commanded flow


def dispenser_from_table(where: object, table: checks.Table, folder: File) -> SimulatedDispenser | None:
    """The table of the scenario `where`, None for an empty one; InputError names the key that makes no sense."""
    if not table:
        return None
    if "led" in table and "file" in table:
        raise InputError(where, "dispenser.led", table["led"], "true or false, and left out where a file says it")
    keys: checks.Keys = {
        **TRUTH_KEYS,
        "led": ("delays_known", checks.flag),
        "given": ("flow_share", checks.within(0, MAX_FLOW_SHARE, "of the flow that it is told", open=True)),
        "file": ("assumed", lambda where, key, value: _assumed(folder / checks.text(where, key, value))),
    }
    result = checks.record_from_table(where, "dispenser.", table, _simulated, keys)
    if not result.assumed:
        _drivers(result, ("",), where)
    return result


def _simulated(
    delays_known: bool = True, flow_share: float = 1.0, assumed: tuple[DispenserSettings, ...] = (), **truth: float
) -> SimulatedDispenser:
    """truth: fields other than an ideal one's. InputError names one that makes no sense."""
    true = replace(IDEAL, **truth)  # type: ignore[arg-type]
    _profile(true, ("",), metered=True, delays_known=True)
    return SimulatedDispenser(true, "flow" not in truth, delays_known, assumed, flow_share)


def _assumed(file: File) -> tuple[DispenserSettings, ...]:
    """The dispensers of a file, each of which a virtual one can stand for; InputError where it cannot."""
    dispensers = read_dispensers(file)
    for each in dispensers:
        if each.preset not in DIALECTS:
            raise InputError(file, "dispenser.preset", each.preset, f"for a simulation one of {', '.join(DIALECTS)}")
        if each.profile.nozzle_offset.any():
            offset = each.profile.nozzle_offset.tolist()
            raise InputError(file, "dispenser.nozzle_offset_mm", offset, "left out: a simulation has one nozzle")
    outlets_from(dispensers, file)
    return dispensers


def _profile(
    truth: VirtualDispenserSettings, materials: tuple[str, ...], metered: bool, delays_known: bool
) -> DispenserProfile:
    names = ("on_dead_time", "on_lag", "off_dead_time", "off_lag") if delays_known else ()
    delays = {name: getattr(truth, name) for name in names}
    return DispenserProfile("dispenser", materials, **delays, watchdog=truth.watchdog, metered=metered, flow=truth.flow)


def _drivers(device: SimulatedDispenser, materials: tuple[str, ...], where: object) -> tuple[DispenserSettings, ...]:
    """The motion's settings of a dispenser that carries all materials; InputError for delays too long to be led."""
    profile, line = _profile(device.truth, materials, device.metered, device.delays_known), PRESETS[PRESET].line
    if device.metered:
        line = replace(line, messages=replace(line.messages, on=METERED_ON, flow=METERED_ON))
    line = replace(line, keepalive=min(line.keepalive, 0.4 * device.truth.watchdog))
    settings = (DispenserSettings(profile, PRESET, line),)
    outlets_from(settings, where)
    return settings


class SimulatedDispensers:
    """Virtual dispensers, and their control by the motion.

    control: for the motion, to be polled every few milliseconds. outlets: for its planner. ideal: as without a table.
    """

    def __init__(
        self,
        path: Path,
        settings: SimulatedDispenser | None,
        clock: Clock,
        faults: Sequence[Fault] = (),
        where: object = "path",
    ) -> None:
        """settings: a scenario's; None: an ideal one. clock: of the virtual time. faults: those of dispensers count.

        InputError (where) for a path with a material that none of them carries.
        """
        self.ideal, self._clogs = settings is None, faults_striking(faults, FaultPart.DISPENSER, FaultKind.CLOG)
        settings = SimulatedDispenser(IDEAL, metered=False) if settings is None else settings
        self._flow_share = settings.flow_share
        materials = tuple(dict.fromkeys(map(str, path.material.tolist())))
        drivers = settings.assumed or _drivers(settings, materials, where)
        self.models = [DispenserModel(replace(settings.truth, preset=driver.preset), clock.now()) for driver in drivers]
        self._ports = [DispenserPort(model, clock, faults) for model in self.models]
        lines = [
            LineDispenser(driver.profile, replace(driver.line, start=0.0), port)
            for driver, port in zip(drivers, self._ports, strict=True)
            if driver.line is not None
        ]
        dispensers = Dispensers(lines, where)
        if settings.assumed:
            check_path_materials(dispensers, path, where)
        self.outlets: Outlets = outlets_from(drivers, where)
        self.control = MaterialControl(dispensers, path)
        self._permits: list[tuple[float, float]] = []  # from, until, s: when a dispenser may be open

    def disconnect(self) -> None:
        """From here on no command reaches them."""
        for port in self._ports:
            port.disconnected = True

    def advance(self, now: float) -> None:
        """Let their time pass until `now`, s."""
        for model in self.models:
            model.advance(now)

    # -- the moves that were sent, and the dispensers' state beside them

    def add_command(self, command: Command, tick: float) -> None:
        """A command was sent: a Move permits flow until the next one, or for the tick in which it closes."""
        until = command.stamp
        if isinstance(command, Move) and (command.flow or command.flow_after):
            until = math.inf if command.flow else command.stamp + tick
        self._permits.append((command.stamp, until))

    def forbid(self, now: float) -> None:
        """No flow is permitted from `now`, s, until the next command: the arm is not armed."""
        last = self._permits[-1] if self._permits else (now, math.inf)
        if last[1] > now:
            self._permits.append((max(now, last[0]),) * 2)

    def open_outside(self, until: float, unattended: Sequence[tuple[float, float]] = ()) -> float:
        """How long, s, until `until`, a device was commanded open while no move that prints was sent.

        unattended: from, until, s: when no command could reach it; that time does not count.
        """
        begin = np.array([start for start, _ in self._permits])
        end = np.minimum([end for _, end in self._permits], np.append(begin[1:], until)[: len(begin)])
        outside = 0.0
        for model in self.models:
            stamps, flows = self._switches(model)
            edges = np.concatenate([stamps[1:], begin, end, np.ravel(unattended), [until]])
            edges = np.unique(np.clip(edges, 0.0, until))
            middle = (edges[1:] + edges[:-1]) / 2
            last = np.searchsorted(begin, middle, "right") - 1
            allowed = (last >= 0) & (middle < np.append(end, 0.0)[last])
            for lost, restored in unattended:
                allowed |= (middle >= lost) & (middle < restored + ANSWER_TIME)
            open_now = flows[np.searchsorted(stamps, middle, "right") - 1] > 0
            length = np.diff(edges)
            outside += float(length[open_now & ~allowed & (length > ROUNDING)].sum())
        return outside

    def flow(self, instants: Array, planned: Array) -> Array:
        """The true flow (N,), mm^3/s, at instants (N,), s. planned: (N,) mm^3/s, what the bead needs."""
        share = self._passing_share(instants)
        if self.ideal:  # the planned one while a device is open by its last command, and has not closed itself
            switches = map(self._switches, self.models)
            is_open = [flows[np.searchsorted(stamps, instants, "right") - 1] > 0 for stamps, flows in switches]
            return np.asarray(planned * np.any(is_open, axis=0) * share)
        return np.asarray(sum(model.flow_at(instants) for model in self.models) * share)

    def _passing_share(self, instants: Array) -> Array:
        """Share (N,) of the flow that passes the needle at instants (N,), s."""
        share = np.full(len(instants), self._flow_share)
        for fault in self._clogs:
            share[(instants >= fault.start) & (instants < fault.end)] *= 1 - fault.share
        return share

    def flowing(self, instants: Array) -> NDArray[np.bool_]:
        """Whether half of the commanded flow or more leaves a device (N,), at instants (N,), s."""
        flowing = np.zeros(len(instants), bool)
        for model in self.models:
            stamps, flows = self._switches(model)
            opened = flows > 0
            last = np.searchsorted(stamps[opened], instants, "right") - 1
            flow = np.append(flows[opened], math.inf)[last]  # before the first there is none
            flowing |= model.flow_at(instants) * self._passing_share(instants) > flow / 2
        return flowing

    @staticmethod
    def _switches(model: DispenserModel) -> tuple[Array, Array]:
        """Instants (M,), s, rising, and the flow (M,) commanded from each on."""
        stamps, flows = np.array([(-math.inf, 0.0), *model.switches]).T
        return stamps, flows


BEAD_STEP = 0.01  # s between the ends of the pieces in which a bead is drawn
AREA_PIECES, MIN_LENGTH = 7, 0.05  # pieces with one cross-section; mm, least length of it: at rest, a puddle


def piece_ends(start: float, until: float) -> Array:
    """Instants (N,), s, at which pieces of beads end, after `start` and before `until`."""
    ends = np.arange(start + BEAD_STEP, until, BEAD_STEP)
    return ends[ends < until]  # numpy's own last one may be a rounding error beyond


class BeadDrawing:
    """Draws what leaves the needle into a scene: as ink of the planned width, or as gel of the true volume."""

    def __init__(
        self,
        gel: bool,
        width: float,
        truth: Truth,
        log: TruthLog,
        nozzle_at: Callable[[Array], Array],
        dispensers: SimulatedDispensers,
    ) -> None:
        """width: mm, of ink. nozzle_at: base_from_nozzle (N, 4, 4) truly at times (N,), s."""
        self._gel, self._width, self._truth, self._log = gel, width, truth, log
        self._nozzle_at, self._dispensers = nozzle_at, dispensers
        self._until = 0.0  # s
        self._end: Array | None = None  # (2,) mm, where the last piece ended

    def draw(self, scene: Scene, until: float) -> None:
        """Draw what has left the needle up to `until`, s."""
        ends = piece_ends(self._until, until)
        if not len(ends):
            return
        self._until = float(ends[-1])
        places = scene.shape.material(self._truth.material(ends, self._nozzle_at(ends)[:, :3, 3]))
        if self._gel:
            self._flow(scene, ends, places)
            return
        flowing = self._log.extruding(ends) if self._dispensers.ideal else self._dispensers.flowing(ends)
        for place, on in zip(places, flowing, strict=True):
            if on and self._end is not None:
                scene.ink.lay(self._end, place, self._width)
            self._end = place if on else None

    def _flow(self, scene: Scene, ends: Array, places: Array) -> None:
        volume = self._dispensers.flow(ends, self._log.planned_flow(ends)) * BEAD_STEP
        start = np.concatenate([places[:1] if self._end is None else self._end[None], places[:-1]])
        self._end = places[-1]
        window, length = np.ones(min(AREA_PIECES, len(ends))), np.linalg.norm(places - start, axis=1)
        moved = np.convolve(np.maximum(length, MIN_LENGTH * (length > 0)), window, "same")
        area = np.convolve(volume, window, "same") / np.maximum(moved, MIN_LENGTH)
        scene.ink.flow(GelPieces(start, places, volume, area), float(ends[-1]))
