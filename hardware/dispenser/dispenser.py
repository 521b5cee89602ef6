"""The contract of a dispenser: what switches material on and off, how late it does so, and which one carries what.

Nothing here or in a driver waits: the caller is a real-time loop that polls every few milliseconds. An error of the
line is a state, never an exception. A dispenser is off unless the last of `on` and `off` was `on`, and it is ON only
between a `prepare` that was done and the first fault.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process import checks
from hardware.process.clock import Clock
from planning.command import MAX_FLOW
from planning.material import bead_areas, is_metered
from planning.path import MAX_TEMPERATURE, MIN_TEMPERATURE, Path

MAX_DISPENSER_DELAY = 5.0  # s, of a dead time or a lag: what is slower cannot start a bead where it begins
MAX_DRAWN_BACK = 100.0  # mm^3: more than any nozzle and needle hold
MAX_NOZZLE_OFFSET = 200.0  # mm: what hangs on the same tool is no farther away
KEPT_WITHIN = 1.0  # degrees C by which a path's temperature may differ from one that is kept elsewhere
CLOSE_TIME = 1.0  # s for which a close insists that the line takes the off
CLOSE_POLL = 0.002  # s between looks meanwhile
MAX_DISPENSER_EVENTS = 1000  # kept until they are asked for


class DispenserState(Enum):
    """What a dispenser does. Only `prepare` leads out of CLOSED, and out of FAILED once its line is back."""

    CLOSED = "closed"  # off; nothing is sent but offs
    PREPARING = "preparing"  # off; its line is opened, set up, or it is not at its temperature yet
    READY = "ready"  # off, and may be switched on
    ON = "on"  # material flows
    FAILED = "failed"  # its line or it itself has failed; off is sent when the line is back


@dataclass(frozen=True, slots=True, eq=False)
class DispenserProfile:
    """One dispenser. InputError names a setting that makes no sense.

    A switch acts in two steps: nothing happens for a dead time, and then the flow goes to its new value exponentially,
    with a lag as time constant.
    """

    name: str
    materials: tuple[str, ...]  # that it carries, as a path's column `material` names them
    on_dead_time: float = 0.0  # s from the line taking `on` until material begins to flow
    on_lag: float = 0.0  # s, time constant with which the flow rises
    off_dead_time: float = 0.0  # s from the line taking `off` until the flow begins to fall
    off_lag: float = 0.0  # s, time constant with which it falls
    nozzle_offset: Array = field(default_factory=lambda: np.zeros(3))  # (3,) mm, its tip in the tool's nozzle frame
    watchdog: float | None = None  # s without a message after which the device switches itself off; None: never
    metered: bool = False  # whether it gives the flow that it is told
    flow_range: tuple[float, float] = (0.001, MAX_FLOW)  # mm^3/s that a metered one can give
    flow: float = 1.0  # mm^3/s that an unmetered one gives while it is on, as far as known: for records
    temperature_range: tuple[float, float] | None = None  # degrees C that it can set; None: it cannot
    kept_at: float | None = None  # degrees C at which something else keeps the material
    prime_volume: float = 0.0  # mm^3 pushed before `on` to undo a retract
    retract_volume: float = 0.0  # mm^3 drawn back after `off`

    def __post_init__(self) -> None:
        if not self.materials:
            raise InputError("dispenser", "materials", list(self.materials), "one name or more")
        for name in ("on_dead_time", "on_lag", "off_dead_time", "off_lag"):
            checks.within(0.0, MAX_DISPENSER_DELAY, "s")("dispenser", name, getattr(self, name))
        if self.nozzle_offset.shape != (3,) or not (np.abs(self.nozzle_offset) <= MAX_NOZZLE_OFFSET).all():
            allowed = f"3 numbers X Y Z, within {MAX_NOZZLE_OFFSET:g} mm"
            raise InputError("dispenser", "nozzle_offset", self.nozzle_offset.tolist(), allowed)
        if self.watchdog is not None:
            checks.within(0.02, 60.0, "s")("dispenser", "watchdog", self.watchdog)
        low, high = self.flow_range
        if not 0 < low < high <= MAX_FLOW:
            raise InputError("dispenser", "flow_range", [low, high], f"0 < low < high <= {MAX_FLOW:g} mm^3/s")
        checks.within(1e-6, MAX_FLOW, "mm^3/s")("dispenser", "flow", self.flow)
        for number in (*(self.temperature_range or ()), *(() if self.kept_at is None else (self.kept_at,))):
            name = "kept_at" if self.temperature_range is None else "temperature_range"
            checks.within(MIN_TEMPERATURE, MAX_TEMPERATURE, "degrees C")("dispenser", name, number)
        if self.temperature_range is not None and not self.temperature_range[0] < self.temperature_range[1]:
            raise InputError("dispenser", "temperature_range", list(self.temperature_range), "low < high, degrees C")
        if self.temperature_range is not None and self.kept_at is not None:
            raise InputError("dispenser", "kept_at", self.kept_at, "left out where temperature_range is given")
        for name in ("prime_volume", "retract_volume"):
            checks.within(0.0, MAX_DRAWN_BACK, "mm^3")("dispenser", name, getattr(self, name))

    @property
    def on_delay(self) -> float:
        """Seconds from `on` to half the flow: the dead time, then 1 - exp(-t / lag) = 1/2 at t = lag ln 2.

        A switch moved earlier by this lays its half-flow point on the place that was meant.
        """
        return self.on_dead_time + math.log(2.0) * self.on_lag

    @property
    def off_delay(self) -> float:
        """Seconds from `off` to half the flow: the dead time, then exp(-t / lag) = 1/2 at t = lag ln 2."""
        return self.off_dead_time + math.log(2.0) * self.off_lag

    def flow_given(self, flow: float) -> float:
        """The flow, mm^3/s, while it is on and was told `flow`."""
        return float(flow) if self.metered else self.flow

    def wrong_flow(self, flow: float) -> str:
        """Why it cannot give `flow`, mm^3/s; "" where it can. One that is not metered gives what it gives."""
        low, high = self.flow_range
        if not self.metered or low * (1 - 1e-9) <= flow <= high * (1 + 1e-9):  # NaN fails the comparison
            return ""
        return f"{self.name} cannot give {flow:g} mm^3/s, only {low:g} to {high:g}"

    def wrong_temperature(self, celsius: float) -> str:
        """Why its material cannot be at `celsius`, degrees C; "" where it can."""
        if self.temperature_range is not None:
            low, high = self.temperature_range
            return "" if low <= celsius <= high else f"{low:g} to {high:g} degrees C, which {self.name} can set"
        if self.kept_at is None:
            return f"none, as {self.name} sets no temperature; kept_at_c in its file says what is kept by other means"
        if abs(celsius - self.kept_at) <= KEPT_WITHIN:
            return ""
        return f"{self.kept_at:g} degrees C within {KEPT_WITHIN:g}, at which {self.name} is kept"


@dataclass(frozen=True, slots=True)
class DispenserEvent:
    """What a dispenser did, for records and for a person."""

    stamp: float  # s, when the line had taken it
    text: str
    flow: float | None = None  # mm^3/s commanded from here on, 0 for off; None where that stays as it was


@dataclass(frozen=True, slots=True)
class DispenserStatus:
    """A dispenser at one instant."""

    state: DispenserState
    reason: str  # of the state, for a person
    flow: float  # mm^3/s commanded, 0 unless ON
    temperature: float | None  # degrees C, its last answer; None without
    target: float | None  # degrees C that it was last told; None where it was told none


class Dispenser(Protocol):
    """What the motion loop needs of a dispenser. Every call returns at once; none raises for a fault of the line."""

    @property
    def profile(self) -> DispenserProfile:
        """What it is."""
        ...

    @property
    def status(self) -> DispenserStatus:
        """As of the last call."""
        ...

    def prepare(self, now: float, celsius: float | None = None) -> None:
        """Open its line, set it up and its temperature; READY some polls later, FAILED where that cannot be done."""
        ...

    def on(self, flow: float, now: float) -> str:
        """Let `flow`, mm^3/s, of material out; why that was refused, "" where not. The same flow again sends nothing.

        Refused are a dispenser that is not READY or ON, and a flow that a metered one cannot give: it stays as it was.
        """
        ...

    def off(self, now: float) -> None:
        """Stop the material, before anything else that waits, and draw it back where it does so. Sent at every call."""
        ...

    def retract(self, now: float) -> None:
        """Draw material back, where it can and is off."""
        ...

    def set_temperature(self, celsius: float, now: float) -> str:
        """Set the temperature; why that was refused, "" where not. Off and not near it, it is PREPARING."""
        ...

    def poll(self, now: float) -> None:
        """Send what waits and what keeps the device's watchdog calm, read answers, look for a line that is gone."""
        ...

    def events(self) -> list[DispenserEvent]:
        """What happened since the last call."""
        ...

    def close(self, now: float) -> bool:
        """Off, then let the line go; whether that is done. To be called until it is, as `close_dispensers` does.

        It insists for CLOSE_TIME that the line takes the off; where it does not, an event and the reason say so.
        """
        ...


class EventLog:
    """The events of one dispenser until they are asked for."""

    def __init__(self) -> None:
        self._events: deque[DispenserEvent] = deque(maxlen=MAX_DISPENSER_EVENTS)

    def add(self, now: float, text: str, flow: float | None = None) -> None:
        """Something happened at `now`, s."""
        self._events.append(DispenserEvent(now, text, flow))

    def take(self) -> list[DispenserEvent]:
        """What happened since the last call."""
        events = list(self._events)
        self._events.clear()
        return events


class SwitchedDispenser:
    """A dispenser without a line, such as a valve on a pin; see `Dispenser` for the calls."""

    def __init__(self, profile: DispenserProfile, switch: Callable[[bool], str]) -> None:
        """switch: lets material out (True) or stops it, at once; why it could not, "" where it could."""
        self.profile, self._switch = profile, switch
        self._state, self._reason, self._log = DispenserState.CLOSED, "not prepared yet", EventLog()
        self._flow = profile.flow  # mm^3/s while it is on

    @property
    def status(self) -> DispenserStatus:
        """As of the last call."""
        flow = self._flow if self._state is DispenserState.ON else 0.0
        return DispenserStatus(self._state, self._reason, flow, None, None)

    def prepare(self, now: float, celsius: float | None = None) -> None:
        """Off, and READY at once; FAILED where it is not kept at that temperature."""
        if self._state in (DispenserState.CLOSED, DispenserState.FAILED):
            self._go(DispenserState.READY, "prepared", now)
        if celsius is not None and (reason := self.set_temperature(celsius, now)):
            self._go(DispenserState.FAILED, reason, now)

    def on(self, flow: float, now: float) -> str:
        """Switch it on; it gives what it gives."""
        if self._state is DispenserState.READY:
            self._go(DispenserState.ON, "on", now)
        return "" if self._state is DispenserState.ON else f"{self.profile.name} is {self._state.value}: {self._reason}"

    def off(self, now: float) -> None:
        """Switch it off."""
        was_on = self._state is DispenserState.ON
        self._go(DispenserState.READY if was_on else self._state, "off" if was_on else self._reason, now)

    def retract(self, now: float) -> None:
        """It cannot."""

    def set_temperature(self, celsius: float, now: float) -> str:
        """Refused unless it is kept there."""
        allowed = self.profile.wrong_temperature(celsius)
        return f"{celsius:g} degrees C, allowed {allowed}" if allowed else ""

    def poll(self, now: float) -> None:
        """Nothing waits here."""

    def events(self) -> list[DispenserEvent]:
        """What happened since the last call."""
        return self._log.take()

    def close(self, now: float) -> bool:
        """Off until it is prepared again."""
        self._go(DispenserState.CLOSED, "closed, off", now)
        return True

    def _go(self, state: DispenserState, reason: str, now: float) -> None:
        """Switch it as the state says; FAILED where that cannot be done."""
        was_on, on = self._state is DispenserState.ON, state is DispenserState.ON
        if error := self._switch(on):
            state, reason, on = DispenserState.FAILED, error, False
        if (state, reason) != (self._state, self._reason):
            self._log.add(now, f"{state.value}: {reason}", self._flow * on if on != was_on else None)
        self._state, self._reason = state, reason


class ArmPwmDispenser(SwitchedDispenser):
    """Material switched by the arm's own frames: it only holds the number that a G1 frame is to carry.

    pwm: that number, bytes 27 to 30 of the frame; whoever sends the frames reads it.
    """

    def __init__(self, profile: DispenserProfile, pwm_on: float, pwm_off: float) -> None:
        super().__init__(profile, self._hold)
        self._numbers = {True: pwm_on, False: pwm_off}
        self.pwm = pwm_off

    def _hold(self, on: bool) -> str:
        self.pwm = self._numbers[on]
        return ""


class ArmAxisDispenser(SwitchedDispenser):
    """Material that an axis of the arm pushes as a part of its moves: here is only kept what that is told."""

    def __init__(self, profile: DispenserProfile) -> None:
        super().__init__(profile, lambda on: "")

    def on(self, flow: float, now: float) -> str:
        """Let another flow leave."""
        if reason := self.profile.wrong_flow(flow):
            return reason
        was, self._flow = self.status.flow, flow
        if not (reason := super().on(flow, now)) and was and was != flow:
            self._log.add(now, f"{flow:g} mm^3/s", flow)
        return reason


class Dispensers:
    """The dispensers of one tool, by the materials that they carry. InputError where two carry one."""

    def __init__(self, dispensers: Sequence[Dispenser], where: object = "dispensers") -> None:
        self._all = tuple(dispensers)
        self._by_material: dict[str, Dispenser] = {}
        for dispenser in self._all:
            for material in dispenser.profile.materials:
                if material in self._by_material:
                    other = self._by_material[material].profile.name
                    raise InputError(where, "materials", material, f"in one dispenser; {other!r} carries it as well")
                self._by_material[material] = dispenser

    def __iter__(self) -> Iterator[Dispenser]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)

    @property
    def materials(self) -> tuple[str, ...]:
        """What they carry."""
        return tuple(self._by_material)

    def for_material(self, name: object) -> Dispenser | None:
        """The one that carries a material, named as in a path (a text or a whole number); None where none does."""
        return self._by_material.get(str(name))

    def poll(self, now: float) -> None:
        """Poll each."""
        for dispenser in self._all:
            dispenser.poll(now)

    def off(self, now: float) -> None:
        """Switch each off."""
        for dispenser in self._all:
            dispenser.off(now)


def close_dispensers(dispensers: Dispensers, clock: Clock) -> list[str]:
    """Close all and wait until it is done, CLOSE_TIME at most; of each that could not be switched off, why."""
    open_ones = list(dispensers)
    while open_ones := [each for each in open_ones if not each.close(clock.now())]:
        clock.wait_until(clock.now() + CLOSE_POLL)
    return [f"{d.profile.name}: {d.status.reason}" for d in dispensers if d.status.state is DispenserState.FAILED]


def switch_off(dispensers: Dispensers, clock: Clock) -> list[str]:
    """Switch off what another process has opened that is gone; of each that could not be, why."""
    for each in dispensers:
        each.prepare(clock.now())  # opens the line; an off goes out before what sets it up
        each.off(clock.now())
    return close_dispensers(dispensers, clock)


def check_path_materials(dispensers: Dispensers, path: Path, file: object) -> None:
    """InputError (file) where a material that the path extrudes has no dispenser, or one that cannot do it.

    Refused are a temperature that its dispenser can neither set nor is kept at; and for a metered one a path that does
    not say how much is to flow (in volume_mm3, or in width_mm and height_mm), or needs a flow that it cannot give.
    """
    for material in dict.fromkeys(path.material[path.extrude].tolist()):
        dispenser = dispensers.for_material(material)
        if dispenser is None:
            allowed = f"what a dispenser carries: {', '.join(dispensers.materials)}"
            raise InputError(file, "material", material, allowed)
        printed = path.extrude & (path.material == material)
        for celsius in np.unique(path.temperature[printed]).tolist():
            if allowed := dispenser.profile.wrong_temperature(celsius):
                raise InputError(file, f"temperature_c of material {material}", celsius, allowed)
        if not dispenser.profile.metered:
            continue
        name = dispenser.profile.name
        if not is_metered(path):
            allowed = f"volume_mm3, or width_mm and height_mm, as {name} meters its flow"
            raise InputError(file, "columns", ", ".join(path.extra) or "no further column", allowed)
        low, high = dispenser.profile.flow_range
        flows = bead_areas(path, file) * path.speed
        outside = np.flatnonzero(printed & ~((flows >= low) & (flows <= high)))
        if len(outside):
            allowed = f"{low:g} to {high:g} mm^3/s, what {name} can give: another speed, width or height"
            raise InputError(file, f"checkpoint {outside[0]}: flow", f"{flows[outside[0]]:.3g} mm^3/s", allowed)
