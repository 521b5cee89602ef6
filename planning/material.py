"""Material along a path: where it flows and how much, where the path rests, and how a dispenser's delay is led.

A dispenser that is told to open gives half of its flow `on` s later, and still gives half of it `off` s after it was
told to close. A bead begins and ends where it is planned if the dispenser is told that much earlier than the nozzle is
there. A path rests before a checkpoint with a waiting time (column `wait_s`), where another material begins, and after
a checkpoint whose column `look` is 1: there the needle steps aside until what was laid has been looked at.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array
from planning.path import LOOK, Path

MAX_DELAY = 0.4  # s: the path is timed for half a second at least, and a bead's end must be known before it is told
MAX_WAIT = 3600.0  # s before a checkpoint
UNIT_AREA = 1.0  # mm^2, of a path without volumes: a dispenser that only opens and closes does not ask
SWITCH_STEP = 0.001  # s: a switch is timed to that, 0.03 mm at 30 mm/s
MIN_FLOW_SPEED = 1.0  # mm/s: a metered dispenser is told no less of the bead while it is open
ROUNDING = 1e-6  # mm of a place on the path


@dataclass(frozen=True, slots=True)
class SwitchDelay:
    """A dispenser's delays, s, from a switch to half the flow. InputError beyond 0 to MAX_DELAY."""

    on: float = 0.0
    off: float = 0.0
    with_moves: bool = False  # the switch is a part of the arm's move: it takes effect where the arm carries that out

    def __post_init__(self) -> None:
        for name, value in (("on", self.on), ("off", self.off)):
            if not 0 <= value <= MAX_DELAY:
                raise InputError("dispenser", f"delay {name}", value, f"0 to {MAX_DELAY:g} s")

    def leads(self, lag: float) -> tuple[float, float]:
        """How long, s, before the planned instant a switch is due, where the arm is late by `lag` s; below 0: after."""
        late = 0.0 if self.with_moves else lag
        return self.on - late, self.off - late


NO_DELAY = SwitchDelay(with_moves=True)


@dataclass(frozen=True, slots=True)
class Outlet:
    """How late a material leaves, and where: its nozzle's tip (x, y, z), mm, in the frame of the tool's nozzle."""

    delay: SwitchDelay = NO_DELAY
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


Outlets = Mapping[str, Outlet]  # by material
OWN_OUTLET = Outlet()


@dataclass(frozen=True, slots=True)
class Rest:
    """A place at which the path comes to rest."""

    place: float  # mm of the path
    checkpoint: int  # to which it goes on
    wait: float  # s to rest there
    material: str  # that is wanted from there on, or LOOK; "": as before


@dataclass(frozen=True, slots=True, eq=False)
class FlowShares:
    """By how much the flow on M stretches of a path differs from the planned; elsewhere it does not."""

    begin: Array  # (M,) checkpoints, rising: where a stretch begins,
    end: Array  # (M,) and ends, before the next one begins
    share: Array  # (M,) of the planned flow

    def at(self, place: Array) -> Array:
        """Shares (N,) at places (N,), in checkpoints."""
        stretch = np.maximum(np.searchsorted(self.begin, place, "right") - 1, 0)
        inside = (place >= self.begin[stretch]) & (place < self.end[stretch])
        return np.asarray(np.where(inside, self.share[stretch], 1.0))

    def then(self, later: FlowShares) -> FlowShares:
        """These, and those of what is printed later; where both say something, the later ones count."""
        keep = self.end <= later.begin[0]
        own, other = (self.begin, self.end, self.share), (later.begin, later.end, later.share)
        return FlowShares(*(np.concatenate([a[keep], b]) for a, b in zip(own, other, strict=True)))

    @property
    def text(self) -> str:
        """In words."""
        return (
            f"the next layer flows at {100 * self.share.min():.0f} % to {100 * self.share.max():.0f} % of the planned"
        )


_FLOW = "begin", "end", "share"  # of FlowShares


def message_from_flow(flow: FlowShares) -> dict[str, list[float]]:
    """Changed flows as a part of a message."""
    return {name: getattr(flow, name).tolist() for name in _FLOW}


def flow_from_message(message: Mapping[str, list[float]]) -> FlowShares:
    """Changed flows from their part of a message."""
    return FlowShares(*(np.array(message[name], float) for name in _FLOW))


AS_PLANNED = FlowShares(np.zeros(1), np.zeros(1), np.ones(1))


@dataclass(frozen=True, slots=True, eq=False)
class MaterialPlan:
    """Material along a path whose checkpoints (N,) lie at `knots` (N,), mm."""

    begins: Array  # (B,) mm, where each bead begins, rising
    ends: Array  # (B,) mm
    knots: Array  # (N,) mm
    area: Array  # (N,) mm^2, cross-section of the bead on the way to each checkpoint
    rests: tuple[Rest, ...]  # by place
    materials: tuple[str, ...]  # (N,) on the way to each checkpoint

    def material_at(self, place: float) -> str:
        """The material on the way to the checkpoint that `place`, mm, leads to."""
        return self.materials[min(int(np.searchsorted(self.knots, place, "right")), len(self.knots) - 1)]

    def area_at(self, place: float) -> float:
        """Cross-section, mm^2, of the bead at `place`, mm."""
        return float(self.area[min(int(np.searchsorted(self.knots, place, "right")), len(self.knots) - 1)])

    def open(self, led_on: Array, led_off: Array, until: float) -> NDArray[np.bool_]:
        """Whether the dispenser is to be open (M,), on the way to a rest or the end at `until`, mm.

        led_on: (M,) mm, where the nozzle will be once an opening takes effect. led_off: (M,) mm, once a closing does.
        """
        begins = self.begins[self.begins < until - ROUNDING]
        if not len(begins):
            return np.zeros(len(led_on), bool)
        bead = np.searchsorted(begins, led_on + ROUNDING, "right") - 1
        return np.asarray((bead >= 0) & (led_off < self.ends[bead] - ROUNDING))


def material_plan(path: Path, knots: Array, where: object = "path") -> MaterialPlan:
    """The material along a path whose checkpoints lie at `knots` (N,), mm. InputError: a wait that is no time."""
    extrude = np.concatenate([path.extrude[1:], [False]])
    flips = np.diff(np.concatenate([[False], extrude]).astype(np.int8))
    begins, ends = knots[np.flatnonzero(flips > 0)], knots[np.flatnonzero(flips < 0)]
    materials = tuple(map(str, path.material.tolist()))
    rests = _rests(path, knots, materials, where)
    within = [rest.place for rest in rests if ((begins < rest.place) & (rest.place < ends)).any()]
    begins, ends = np.sort(np.append(begins, within)), np.sort(np.append(ends, within))  # a bead ends where it rests
    return MaterialPlan(begins, ends, knots, bead_areas(path, where), rests, materials)


def bead_areas(path: Path, where: object = "path") -> Array:
    """Cross-sections (N,), mm^2: volume_mm3 by the way's length, or width_mm times height_mm, or UNIT_AREA."""
    if is_metered(path):
        if "volume_mm3" in path.extra:
            ways = np.linalg.norm(np.diff(path.surface_from_nozzle[:, :3, 3], axis=0), axis=1)
            volume = _numbers(path, "volume_mm3", where)
            return np.concatenate([[0.0], volume[1:] / np.maximum(ways, 1e-9)])
        return _numbers(path, "width_mm", where) * _numbers(path, "height_mm", where)
    return np.full(len(path), UNIT_AREA)


def is_metered(path: Path) -> bool:
    """Whether the path says how much material it needs."""
    return "volume_mm3" in path.extra or {"width_mm", "height_mm"} <= set(path.extra)


def _rests(path: Path, knots: Array, materials: tuple[str, ...], where: object) -> tuple[Rest, ...]:
    wait = _numbers(path, "wait_s", where) if "wait_s" in path.extra else np.zeros(len(path))
    if (wrong := np.flatnonzero(~(wait <= MAX_WAIT))).size:
        raise InputError(where, f"checkpoint {wrong[0]}: wait_s", float(wait[wrong[0]]), f"0 to {MAX_WAIT:g} s")
    looks = _numbers(path, "look", where) if "look" in path.extra else np.zeros(len(path))
    rests = []
    for i in range(1, len(path)):
        if looks[i - 1]:
            rests.append(Rest(float(knots[i - 1]), i, 0.0, LOOK))
        changed = i > 1 and materials[i] != materials[i - 1]
        if changed or (wait[i] > 0 and i > 1):
            rests.append(Rest(float(knots[i - 1]), i, float(wait[i]), materials[i] if changed else ""))
    if looks[-1]:
        rests.append(Rest(float(knots[-1]), len(path) - 1, 0.0, LOOK))
    return tuple(rests)


def _numbers(path: Path, column: str, where: object) -> Array:
    values = np.empty(len(path))
    for i, text in enumerate(path.extra[column].tolist()):
        try:
            values[i] = float(text)
        except ValueError:
            values[i] = math.nan
        if not (math.isfinite(values[i]) and values[i] >= 0):
            raise InputError(where, f"checkpoint {i}: {column}", text, "a finite number, 0 or more")
    return values


FlowOrder = tuple[float, float]  # flow, mm^3/s, and when in the tick it is told, s


class RestsAhead:
    """Which rest of a path comes next, and how much of it is left."""

    def __init__(self, plan: MaterialPlan, place: float) -> None:
        """place: mm, where printing begins; a rest there is still to come."""
        self._plan = plan
        self._number = sum(rest.place < place - ROUNDING for rest in plan.rests)
        self._until = math.nan  # s, until when it lasts; NaN: it is not reached
        if (rest := self.next) is not None and rest.material == LOOK and rest.place <= place + ROUNDING:
            self._until = 0.0  # the needle need not go there first

    @property
    def next(self) -> Rest | None:
        """The rest that comes next or that it is at; None before the end."""
        return self._plan.rests[self._number] if self._number < len(self._plan.rests) else None

    @property
    def wanted(self) -> str:
        """Material that an operator has to put in before the print goes on, "" if none: once the rest is reached."""
        return "" if self.next is None or math.isnan(self._until) else self.next.material

    @property
    def end(self) -> float:
        """mm of the path until there."""
        return float(self._plan.knots[-1]) if self.next is None else self.next.place

    def left(self, place: float, now: float) -> float:
        """Seconds of the rest at `place`, mm, that are left at `now`, s; 0 where there is none. It begins here."""
        rest = self.next
        if rest is None or place < rest.place - ROUNDING:
            return 0.0
        if math.isnan(self._until):
            self._until = now + rest.wait
        return max(self._until - now, 0.0)

    def passed(self) -> None:
        """Go on to the next."""
        self._number, self._until = self._number + 1, math.nan


class PlaceTiming(Protocol):
    """When the nozzle is where on the path; `planning.motion.retime.Timing` is one."""

    @property
    def end(self) -> float:
        """The instant, s, at which it comes to rest."""
        ...

    def at(self, t: Array) -> Array:
        """Places (N,), mm, at instants (N,), s."""
        ...

    def speed_at(self, t: float) -> float:
        """Speed, mm/s, at the instant t, s; 0 outside."""
        ...


class FlowCommands:
    """The flow that the dispenser is told, tick by tick.

    begun: s, when the nozzle begins or began to print; nothing leaves sooner.
    """

    def __init__(self, plan: MaterialPlan, outlets: Outlets, lag: float, tick: float) -> None:
        """lag: s from one tick after a command until the arm is at its axes. tick: s between calls."""
        self._plan, self._outlets, self.lag = plan, outlets, lag
        self._shares = AS_PLANNED
        self._steps = np.arange(0.0, tick - SWITCH_STEP / 2, SWITCH_STEP)
        self._flow = 0.0  # mm^3/s last told
        self.begun = math.inf

    def adapt(self, shares: FlowShares) -> None:
        """Let other flows leave on some stretches: shares of what was planned there, whatever was asked before."""
        self._shares = self._shares.then(shares)

    def outlet(self, material: str) -> Outlet:
        """The outlet of a material."""
        return self._outlets.get(material, OWN_OUTLET)

    def lead_on(self, place: float) -> float:
        """How long, s, an opening has to be told before the nozzle moves off from `place`, mm."""
        return self.outlet(self._plan.material_at(place)).delay.leads(self.lag)[0]

    def closed(self) -> FlowOrder:
        """Tell the dispenser to close, at once."""
        self._flow = 0.0
        return 0.0, 0.0

    def __call__(self, timing: PlaceTiming, place: float, end: float, now: float) -> FlowOrder:
        """The flow, mm^3/s, that is told in the tick at `now`, s, and how far into the tick, s.

        timing: of the printing that the nozzle follows. place: mm, where it is. end: mm, of the next rest.
        """
        on, off = self.outlet(self._plan.material_at(place)).delay.leads(self.lag)
        times = now + self._steps
        led_on = timing.at(times + on)
        is_open = self._plan.open(led_on, timing.at(times + off), end)
        is_open &= (times + on >= self.begun) & (times + off < timing.end)  # a horizon that is not renewed ends at rest
        changes = np.flatnonzero(is_open != (self._flow > 0))
        at = int(changes[0]) if len(changes) else 0
        if (len(changes) > 0) == (self._flow > 0):  # it closes, or stays closed
            self._flow = 0.0
        else:
            speed = max(timing.speed_at(float(times[at]) + on), MIN_FLOW_SPEED)
            self._flow = self._plan.area_at(float(led_on[at])) * speed * self._share_at(float(led_on[at]))
        return self._flow, float(self._steps[at])

    def _share_at(self, place: float) -> float:
        if self._shares is AS_PLANNED:
            return 1.0
        knots = self._plan.knots
        way = min(max(int(np.searchsorted(knots, place, "right")), 1), len(knots) - 1)
        share = (place - knots[way - 1]) / max(knots[way] - knots[way - 1], ROUNDING)
        return float(self._shares.at(np.array([way - 1 + share]))[0])


def with_offsets(path: Path, outlets: Outlets) -> Path:
    """The path of the tool's nozzle, by which each material's own nozzle follows `path`.

    InputError: another nozzle's material begins in the middle of a bead, without a way on which nothing is extruded.
    """
    names = list(map(str, path.material.tolist()))
    offsets = np.array([outlets.get(name, OWN_OUTLET).offset for name in names])
    if not offsets.any():
        return path
    for i in range(2, len(path)):
        if path.extrude[i] and (offsets[i] != offsets[i - 1]).any():
            allowed = f"a way to the first place of {names[i]!r} with extrude = 0: its nozzle is another one"
            raise InputError("path", f"checkpoint {i}: extrude", 1, allowed)
    shift = np.tile(np.eye(4), (len(path), 1, 1))
    shift[:, :3, 3] = -offsets
    return replace(path, surface_from_nozzle=path.surface_from_nozzle @ shift)
