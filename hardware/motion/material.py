"""The motion's hand on the dispensers: opened only by a Move that the guard let pass and the arm was sent.

The motion loop calls `follow` once a tick with the command that went to the arm, `poll` every few milliseconds, and
`off` wherever the arm is stopped or not armed. Anything but a Move with a flow closes at once. A dispenser that is not
ready, fails or refuses is a `reason`, for which the nozzle leaves the surface and waits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from hardware.dispenser.dispenser import Dispenser, Dispensers, DispenserState, close_dispensers
from hardware.process.clock import Clock
from planning.command import Command, Move
from planning.path import Path

FLOW_STEP = 0.05  # share by which a metered flow changes before it is told anew: a line carries few words a tick
REPEAT_OFF = 0.25  # s between further offs while nothing is to flow: one that was lost on the line is made good


@dataclass(frozen=True, slots=True)
class DispenserRecord:
    """What a dispenser did, as it is recorded."""

    stamp: float  # s, when its line had taken it
    name: str
    text: str
    flow: float | None  # mm^3/s told from then on; None: as before


@dataclass(frozen=True, slots=True)
class MaterialStatus:
    """Whether material can flow, and what was told."""

    text: str  # for a person
    ready: bool
    failed: bool  # and an operator has to see to it


class MaterialControl:
    """The dispensers of a print. reason: why material cannot flow now, "" if it can."""

    def __init__(self, dispensers: Dispensers, path: Path) -> None:
        self._dispensers = dispensers
        self._materials = tuple(map(str, path.material.tolist()))
        self._temperatures = tuple(map(float, path.temperature.tolist()))
        self._extrude = tuple(map(bool, path.extrude.tolist()))
        self._current: Dispenser | None = None  # that carries what is printed now
        self._told = 0.0  # mm^3/s
        self._pending: tuple[float, float] | None = None  # s, when a flow is told, and the flow
        self._closed_at = -math.inf  # s, when the last off was sent
        self._refused = ""
        self._material = ""  # that is printed now, or comes next
        self._celsius: float | None = None  # degrees C that were asked for; None: the dispenser sets none

    @property
    def reason(self) -> str:
        """Why material cannot flow, "" if it can."""
        current = self._current
        if current is None:
            return ""
        status = current.status
        if status.state in (DispenserState.READY, DispenserState.ON):
            return self._refused
        return f"dispenser {current.profile.name} is {status.state.value}: {status.reason}"

    @property
    def status(self) -> MaterialStatus:
        """For reports."""
        current, reason = self._current, self.reason
        if current is None:
            return MaterialStatus("no material is needed", True, False)
        failed = bool(self._refused) or current.status.state in (DispenserState.FAILED, DispenserState.CLOSED)
        flow = f"{self._told:.3g} mm^3/s" if current.profile.metered else "on"
        text = f"{self._material} by {current.profile.name}: {flow if self._told else 'off'}"
        return MaterialStatus(reason or text, not reason, failed)

    def begin(self, place: float, now: float) -> None:
        """Make the dispenser ready whose material comes next at `place`, in checkpoints, and close the others."""
        ahead = next((i for i in range(math.floor(place) + 1, len(self._extrude)) if self._extrude[i]), None)
        if ahead is None:
            return
        self._refused, self._material = "", self._materials[ahead]
        wanted = self._dispensers.for_material(self._material)
        if self._current is not wanted:
            self.off(now)
        self._current = wanted
        if wanted is not None:
            sets = wanted.profile.temperature_range is not None
            self._celsius = self._temperatures[ahead] if sets else None
            wanted.prepare(now, self._celsius)

    def follow(self, command: Command, now: float) -> None:
        """Do what a command that the arm was sent asks for; a hold closes."""
        if not isinstance(command, Move):
            self.off(now)
            return
        if command.extrude:
            self._heat(self._temperatures[command.checkpoint], now)
        at = command.stamp + command.flow_after
        self._pending = (at, command.flow) if command.flow or self._told else None
        self._switch(now)

    def poll(self, now: float) -> None:
        """Switch what is due, repeat offs, and poll the dispensers."""
        self._switch(now)
        if not self._told and now > self._closed_at + REPEAT_OFF and self._current is not None:
            self._close(now)
        self._dispensers.poll(now)
        if self._told and self._current is not None and self._current.status.state is not DispenserState.ON:
            self._close(now)  # its line was lost: it is told anew once it is ready

    def off(self, now: float) -> None:
        """Close at once; what was pending is dropped."""
        self._pending = None
        if self._told:
            self._close(now)

    def records(self) -> list[DispenserRecord]:
        """What each did since the last call."""
        events = ((each.profile.name, event) for each in self._dispensers for event in each.events())
        return [DispenserRecord(event.stamp, name, event.text, event.flow) for name, event in events]

    def close(self, clock: Clock) -> list[str]:
        """Close all and let their lines go; of each that could not be switched off, why."""
        self.off(clock.now())
        return close_dispensers(self._dispensers, clock)

    def _heat(self, celsius: float, now: float) -> None:
        """Have the dispenser go to another temperature, if the path asks for one that it was not told."""
        if self._current is None or self._celsius is None or celsius == self._celsius:
            return
        self.off(now)
        self._celsius = celsius
        self._refused = self._current.set_temperature(celsius, now)

    def _switch(self, now: float) -> None:
        if self._pending is None or now < self._pending[0]:
            return
        flow, self._pending = self._pending[1], None
        current = self._current
        if not flow or current is None or self.reason:
            self.off(now)
            return
        low, high = current.profile.flow_range
        flow = min(max(flow, low), high)  # the path keeps its range; where the nozzle is slower than that, it does not
        same = self._told and (not current.profile.metered or abs(flow - self._told) <= FLOW_STEP * self._told)
        if same:
            return
        if refused := current.on(flow, now):
            self._refused = refused
            self._close(now)
        else:
            self._told = flow

    def _close(self, now: float) -> None:
        self._told, self._closed_at = 0.0, now
        self._dispensers.off(now)
