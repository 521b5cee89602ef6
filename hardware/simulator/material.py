"""The dispensers of a simulated print, told over lines in virtual time; as late and as leaky as a scenario says.

[dispenser]                # left out: one that at once gives each bead what it needs while it is told to
on_dead_time_s = 0.08      # these are true of the device; hardware/simulator/dispenser.py says what they mean
on_lag_s = 0.04
off_dead_time_s = 0.08
off_lag_s = 0.04
ooze_mm3 = 0.5
ooze_lag_s = 0.5
watchdog_s = 0.1
flow_mm3_s = 5.0           # it is a valve that gives that much; left out: it gives the flow that it is told
given = 1.1                # of the flow it is told: 1.1 lays too much, 0.9 too little
led = true                 # whether the motion knows the four delays and leads them; false: it takes them for 0
file = "dispenser.toml"    # or what it takes the dispensers for, as in a dispenser file
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
ROUNDING = 1e-9  # s: what is shorter is the rounding of an instant
ANSWER_TIME = 0.01  # s after a line is whole again, within which it is looked at and told
PRESET = "arduino"
MAX_GIVEN = 3.0  # of the flow told: a pump that gives more is not the one that was calibrated


@dataclass(frozen=True, slots=True)
class SimulatedDispenser:
    """A table [dispenser] of a scenario."""

    truth: VirtualDispenserSettings  # what it does
    metered: bool = True  # whether it gives the flow that it is told
    led: bool = True  # whether the motion knows its delays
    believed: tuple[DispenserSettings, ...] = ()  # what the motion takes it for, of a file
    given: float = 1.0  # share of the flow it is told that it truly gives


def dispenser_from_table(where: object, table: checks.Table, folder: File) -> SimulatedDispenser | None:
    """The table of the scenario `where`, None for an empty one; InputError names the key that makes no sense."""
    if not table:
        return None
    if "led" in table and "file" in table:
        raise InputError(where, "dispenser.led", table["led"], "true or false, and left out where a file says it")
    keys: checks.Keys = {
        **TRUTH_KEYS,
        "led": ("led", checks.flag),
        "given": ("given", checks.within(0, MAX_GIVEN, "of the flow that it is told", open=True)),
        "file": ("believed", lambda where, key, value: _virtual(folder / checks.text(where, key, value))),
    }
    result = checks.record_from_table(where, "dispenser.", table, _simulated, keys)
    if not result.believed:
        _drivers(result, ("",), where)
    return result


def _simulated(
    led: bool = True, given: float = 1.0, believed: tuple[DispenserSettings, ...] = (), **truth: float
) -> SimulatedDispenser:
    """truth: fields that are not an ideal one's. InputError names one that makes no sense."""
    true = replace(IDEAL, **truth)  # type: ignore[arg-type]
    _profile(true, ("",), metered=True, led=True)
    return SimulatedDispenser(true, "flow" not in truth, led, believed, given)


def _virtual(file: File) -> tuple[DispenserSettings, ...]:
    """The dispensers of a file, each of which a virtual one can stand for; InputError where it cannot."""
    found = read_dispensers(file)
    for each in found:
        if each.preset not in DIALECTS:
            raise InputError(file, "dispenser.preset", each.preset, f"for a simulation one of {', '.join(DIALECTS)}")
        if each.profile.nozzle_offset.any():
            offset = each.profile.nozzle_offset.tolist()
            raise InputError(file, "dispenser.nozzle_offset_mm", offset, "left out: a simulation has one nozzle")
    outlets_from(found, file)
    return found


def _profile(truth: VirtualDispenserSettings, materials: tuple[str, ...], metered: bool, led: bool) -> DispenserProfile:
    names = ("on_dead_time", "on_lag", "off_dead_time", "off_lag") if led else ()
    delays = {name: getattr(truth, name) for name in names}
    return DispenserProfile("dispenser", materials, **delays, watchdog=truth.watchdog, metered=metered, flow=truth.flow)


def _drivers(of: SimulatedDispenser, materials: tuple[str, ...], where: object) -> tuple[DispenserSettings, ...]:
    """What the motion takes a dispenser for that carries all materials; InputError for delays too long to be led."""
    profile, line = _profile(of.truth, materials, of.metered, of.led), PRESETS[PRESET].line
    if of.metered:
        line = replace(line, messages=replace(line.messages, on=METERED_ON, flow=METERED_ON))
    settings = (
        DispenserSettings(profile, PRESET, replace(line, keepalive=min(line.keepalive, 0.4 * of.truth.watchdog))),
    )
    outlets_from(settings, where)
    return settings


class SimulatedDispensers:
    """Virtual dispensers, and the motion's hand on them.

    control: for the motion, to be polled every few milliseconds. outlets: for its planner. ideal: as without a table.
    """

    def __init__(
        self,
        path: Path,
        of: SimulatedDispenser | None,
        clock: Clock,
        faults: Sequence[Fault] = (),
        where: object = "path",
    ) -> None:
        """of: a scenario's; None: an ideal one. clock: of the virtual time. faults: those on a dispenser's line count.

        InputError (where) for a path with a material that none of them carries.
        """
        self.ideal, self._clock = of is None, clock
        self._clogs, self._given = faults_striking(faults, FaultPart.DISPENSER, FaultKind.CLOG), 1.0
        of = SimulatedDispenser(IDEAL, metered=False) if of is None else of
        self._given = of.given
        materials = tuple(dict.fromkeys(map(str, path.material.tolist())))
        drivers = of.believed or _drivers(of, materials, where)
        self.models = [DispenserModel(replace(of.truth, preset=each.preset), clock.now()) for each in drivers]
        self._ports = [DispenserPort(model, clock, faults) for model in self.models]
        lines = [
            LineDispenser(each.profile, replace(each.line, start=0.0), port)
            for each, port in zip(drivers, self._ports, strict=True)
            if each.line is not None
        ]
        dispensers = Dispensers(lines, where)
        if of.believed:
            check_path_materials(dispensers, path, where)
        self.outlets: Outlets = outlets_from(drivers, where)
        self.control = MaterialControl(dispensers, path)
        self._permits: list[tuple[float, float]] = []  # from, until, s: when material may be told to flow

    def cut(self) -> None:
        """Nobody speaks to them any more."""
        for port in self._ports:
            port.dead = True

    def advance(self, now: float) -> None:
        """Let their time pass until `now`, s."""
        for model in self.models:
            model.advance(now)

    # -- what was commanded, to hold what was told against

    def note(self, command: Command, tick: float) -> None:
        """A command was sent: a Move lets material flow until the next one, or in a tick in which it closes."""
        until = command.stamp
        if isinstance(command, Move) and (command.flow or command.flow_after):
            until = math.inf if command.flow else command.stamp + tick
        self._permits.append((command.stamp, until))

    def forbid(self, now: float) -> None:
        """The arm is not armed from `now`, s, until the next command."""
        last = self._permits[-1] if self._permits else (now, math.inf)
        if last[1] > now:
            self._permits.append((max(now, last[0]),) * 2)

    def told_outside(self, until: float, alone: Sequence[tuple[float, float]] = ()) -> float:
        """How long, s, until `until`, a device was open on its orders while none was to be: by no move that prints.

        alone: from, until, s: when nobody could tell it anything, and what it does is `open_after`.
        """
        begin = np.array([start for start, _ in self._permits])
        end = np.minimum([end for _, end in self._permits], np.append(begin[1:], until)[: len(begin)])
        outside = 0.0
        for model in self.models:
            stamps, flows = self._switches(model)
            edges = np.concatenate([stamps[1:], begin, end, np.ravel(alone), [until]])
            edges = np.unique(np.clip(edges, 0.0, until))
            middle = (edges[1:] + edges[:-1]) / 2
            last = np.searchsorted(begin, middle, "right") - 1
            excused = (last >= 0) & (middle < np.append(end, 0.0)[last])
            for left, back in alone:
                excused |= (middle >= left) & (middle < back + ANSWER_TIME)
            told = flows[np.searchsorted(stamps, middle, "right") - 1] > 0
            length = np.diff(edges)
            outside += float(length[told & ~excused & (length > ROUNDING)].sum())
        return outside

    def open_after(self, alone: Sequence[tuple[float, float]], until: float) -> float:
        """How long, s, a device stayed open at most from when nobody could tell it anything; alone: from, until, s."""
        longest = 0.0
        for stamps, flows in map(self._switches, self.models):
            for left, back in alone:
                if left < until and flows[np.searchsorted(stamps, left, "right") - 1] > 0:
                    closed = stamps[(stamps > left) & (flows == 0)]
                    longest = max(longest, min(closed[0] if len(closed) else until, back, until) - left)
        return longest

    def open_at(self, instants: Array) -> NDArray[np.bool_]:
        """Whether a device was told last to be open (N,), and had not closed itself, at instants (N,), s."""
        told = np.zeros(len(instants), bool)
        for stamps, flows in map(self._switches, self.models):
            told |= flows[np.searchsorted(stamps, instants, "right") - 1] > 0
        return told

    def flow(self, instants: Array, needed: Array) -> Array:
        """The true flow (N,), mm^3/s, at instants (N,), s. needed: (N,) mm^3/s, what the bead needs there."""
        leaves = self._leaves(instants)
        if self.ideal:
            return np.asarray(needed * self.open_at(instants) * leaves)
        return np.asarray(sum(model.flow_at(instants) for model in self.models) * leaves)

    def _leaves(self, instants: Array) -> Array:
        """Share (N,) of the flow that passes the needle at instants (N,), s."""
        share = np.full(len(instants), self._given)
        for fault in self._clogs:
            share[(instants >= fault.start) & (instants < fault.end)] *= 1 - fault.share
        return share

    def flowing(self, instants: Array) -> NDArray[np.bool_]:
        """Whether half of the flow that a device was told last leaves it (N,), at instants (N,), s."""
        flowing = np.zeros(len(instants), bool)
        for model in self.models:
            stamps, flows = self._switches(model)
            opened = flows > 0
            last = np.searchsorted(stamps[opened], instants, "right") - 1
            told = np.append(flows[opened], math.inf)[last]  # before the first there is none
            flowing |= model.flow_at(instants) * self._leaves(instants) > told / 2
        return flowing

    @staticmethod
    def _switches(model: DispenserModel) -> tuple[Array, Array]:
        """Instants (M,), s, rising, and flows (M,) that it obeyed from each on."""
        stamps, flows = np.array([(-math.inf, 0.0), *model.switches]).T
        return stamps, flows


BEAD_STEP = 0.01  # s between the ends of the pieces in which a bead is drawn
AREA_PIECES, MIN_WAY = 7, 0.05  # pieces whose cross-section is one; mm of each way at least: where it stands, a puddle


class BeadDrawing:
    """Draws into a scene what leaves the needle: as ink as wide as planned, or as gel, as much as the flow gives."""

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
        ends = np.arange(self._until + BEAD_STEP, until, BEAD_STEP)
        if not len(ends):
            return
        self._until = float(ends[-1])
        places = scene.shape.material(self._truth.material(ends, self._nozzle_at(ends)[:, :3, 3]))
        if self._gel:
            self._flow(scene, ends, places)
            return
        laid = self._log.extruding(ends) if self._dispensers.ideal else self._dispensers.flowing(ends)
        for place, there in zip(places, laid, strict=True):
            if there and self._end is not None:
                scene.ink.lay(self._end, place, self._width)
            self._end = place if there else None

    def _flow(self, scene: Scene, ends: Array, places: Array) -> None:
        volume = self._dispensers.flow(ends, self._log.needed(ends)) * BEAD_STEP
        start = np.concatenate([places[:1] if self._end is None else self._end[None], places[:-1]])
        self._end = places[-1]
        near, length = np.ones(min(AREA_PIECES, len(ends))), np.linalg.norm(places - start, axis=1)
        way = np.convolve(np.maximum(length, MIN_WAY * (length > 0)), near, "same")
        area = np.convolve(volume, near, "same") / np.maximum(way, MIN_WAY)
        scene.ink.flow(GelPieces(start, places, volume, area), float(ends[-1]))
