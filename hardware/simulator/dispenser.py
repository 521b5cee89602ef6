"""A virtual dispenser: bytes in, the true flow at any instant out, in virtual time or on a pseudo-terminal.

A switch takes effect after a dead time; then the flow approaches its new value exponentially. After a switch-off a
volume oozes out, also exponentially. Without a message for the time of its watchdog it switches itself off.
"""

from __future__ import annotations

import math
import os
import re
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TextIO

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.driver import UnpluggedError
from hardware.process.clock import Clock, WallClock
from hardware.process.faults import Fault, FaultKind, FaultPart, faults_striking
from hardware.simulator.arm.ports import open_log, served_pty

DISPENSER_POLL = 0.001  # s between polls of the line
DISPENSER_LOG_STEP = 0.001  # s
DISPENSER_LOG_PERIOD = 0.1  # s between two writes of the log
MAX_LINE = 200  # bytes: a longer line is cut

ON, OFF, RATE, KEEPALIVE, HEAT, QUERY, SETUP = "on", "off", "rate", "keepalive", "heat", "query", "setup"


@dataclass(frozen=True, slots=True)
class DispenserDialect:
    """The language of a kind of device: patterns of lines in order, each with its action; the group is its number."""

    actions: tuple[tuple[str, str], ...]
    end: bytes = b"\n"
    unit: float = 1.0  # mm^3/s of a rate of 1
    acknowledgement: str = "ok"  # to a known line
    temperature_answer: str = "T {0:.2f}"  # to a query


NUMBER = r"(-?\d+\.?\d*)"
DIALECTS = {
    "arduino": DispenserDialect(
        ((rf"ON(?: {NUMBER})?", ON), ("OFF", OFF), ("K", KEEPALIVE), (rf"T {NUMBER}", HEAT), (r"T\?", QUERY))
    ),
    "new_era": DispenserDialect(
        ((rf"RAT ?{NUMBER} ?UM", RATE), ("RUN", ON), ("STP", OFF), ("DIR INF|VOL ?0|DIA.*", SETUP)),
        end=b"\r",
        unit=1 / 60,
        acknowledgement="\x0200{1}\x03",
    ),
    "gcode_valve": DispenserDialect(
        (("M106(?: S255)?", ON), ("M107", OFF), (rf"M104 S{NUMBER}", HEAT), ("M105", QUERY)),
        temperature_answer="ok T:{0:.2f} /{2:.2f}",
    ),
}


@dataclass(frozen=True, slots=True)
class VirtualDispenserSettings:
    """The true behaviour. InputError names a setting that makes no sense."""

    preset: str = "arduino"
    on_dead_time: float = 0.03  # s
    on_lag: float = 0.02  # s
    off_dead_time: float = 0.02  # s
    off_lag: float = 0.04  # s
    ooze: float = 0.0  # mm^3 after a switch-off
    ooze_lag: float = 0.5  # s, time constant
    flow: float = 1.0  # mm^3/s, unless commanded
    watchdog: float = 0.1  # s, infinite for none
    ambient: float = 22.0  # degrees C, at the start
    heat_lag: float = 5.0  # s, time constant of its temperature

    def __post_init__(self) -> None:
        if self.preset not in DIALECTS:
            raise InputError("virtual dispenser", "preset", self.preset, f"one of {', '.join(DIALECTS)}")
        for name in (f.name for f in fields(self) if f.name not in ("preset", "ambient")):
            value, positive = getattr(self, name), name in ("ooze_lag", "flow", "watchdog", "heat_lag")
            if not (value > 0 if positive else 0 <= value < math.inf):
                raise InputError("virtual dispenser", name, value, "above 0" if positive else "0 or more")


class DispenserModel:
    """One device from `start` s on; its time is its caller's, which never goes back.

    switches: (stamp, flow) of each change by a command or the watchdog: mm^3/s, 0 for off.
    watchdog_stops: instants, s, at which its watchdog switched it off.
    """

    def __init__(self, settings: VirtualDispenserSettings | None = None, start: float = 0.0) -> None:
        self.settings = VirtualDispenserSettings() if settings is None else settings
        self.now = start
        self.switches: list[tuple[float, float]] = []
        self.unknown_lines: list[bytes] = []
        self.watchdog_stops: list[float] = []
        self._dialect = DIALECTS[self.settings.preset]
        self._actions = [(re.compile(pattern), action) for pattern, action in self._dialect.actions]
        self._buffer, self._answers = b"", bytearray()
        self._rate, self._target_flow, self._last_message = self.settings.flow, 0.0, start
        self._knots: deque[tuple[float, float, float, float, float]] = deque([(start, 0.0, 0.0, 1.0, 0.0)])
        self._heating = (start, self.settings.ambient, self.settings.ambient)  # since, from, to

    @property
    def on(self) -> bool:
        """Whether it is open by its last command, and has not switched itself off."""
        return self._target_flow > 0

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that have arrived at `now`, s, in any split."""
        self.advance(now)
        *lines, partial_line = (self._buffer + data).split(self._dialect.end)
        self._buffer = partial_line[-MAX_LINE:]
        for line in lines:
            self._take(line.decode("ascii", "replace").strip())

    def advance(self, now: float) -> None:
        """Let time pass until `now`, s."""
        assert now >= self.now
        self.now = now
        if self._target_flow and now > self._last_message + self.settings.watchdog:
            self.watchdog_stops.append(self._last_message + self.settings.watchdog)
            self._switch(0.0, self.watchdog_stops[-1])

    def transmit(self, now: float) -> bytes:
        """Its answers since the last call."""
        self.advance(now)
        data, self._answers = bytes(self._answers), bytearray()
        return data

    def flow_at(self, instants: Array) -> Array:
        """The true flow (N,), mm^3/s, at instants (N,), s; after `now` it may still change."""
        knots = np.array(self._knots)
        knot = knots[np.maximum(np.searchsorted(knots[:, 0], instants, "right") - 1, 0)]
        since = np.maximum(instants - knot[:, 0], 0.0)
        lag, ooze_lag = knot[:, 3], self.settings.ooze_lag
        decay = np.where(lag > 0, np.exp(-since / np.where(lag > 0, lag, 1.0)), 0.0)
        flow = knot[:, 2] + (knot[:, 1] - knot[:, 2]) * decay
        return np.asarray(flow + knot[:, 4] / ooze_lag * np.exp(-since / ooze_lag))

    def temperature_at(self, instant: float) -> float:
        """Degrees C."""
        since, start, target = self._heating
        return target + (start - target) * math.exp(-(instant - since) / self.settings.heat_lag)

    def _take(self, line: str) -> None:
        for pattern, action in self._actions:
            if match := pattern.fullmatch(line):
                self._last_message = self.now
                self._do(action, float(match[1]) if pattern.groups and match[1] else None)
                return
        if line:
            self.unknown_lines.append(line.encode("ascii", "replace"))
            self._answer("?")

    def _do(self, action: str, number: float | None) -> None:
        dialect = self._dialect
        if action == RATE or (action == ON and number is not None):
            assert number is not None
            self._rate = number * dialect.unit
        if action == ON or (action == RATE and self._target_flow):
            self._switch(self._rate, self.now)
        elif action == OFF:
            self._switch(0.0, self.now)
        elif action == HEAT:
            assert number is not None
            self._heating = (self.now, self.temperature_at(self.now), number)
        self._answer(dialect.temperature_answer if action == QUERY else dialect.acknowledgement)

    def _answer(self, form: str) -> None:
        text = form.format(self.temperature_at(self.now), "I" if self._target_flow else "S", self._heating[2])
        self._answers += text.encode("ascii") + (b"" if text.endswith("\x03") else b"\n")

    def _switch(self, flow: float, instant: float) -> None:
        """A switch to `flow` at `instant`, effective a dead time later; it cancels switches effective after that."""
        if flow == self._target_flow:
            return
        settings, off = self.settings, flow == 0
        self._target_flow = flow
        self.switches.append((instant, flow))
        effect = instant + (settings.off_dead_time if off else settings.on_dead_time)
        while len(self._knots) > 1 and self._knots[-1][0] >= effect:
            self._knots.pop()
        flow_then, before = float(self.flow_at(np.array([effect]))[0]), self._knots[-1][2]
        ooze = settings.ooze * min(flow_then / before, 1.0) if off and before > 0 else 0.0
        self._knots.append((effect, flow_then, flow, settings.off_lag if off else settings.on_lag, ooze))


class DispenserPort:
    """A line to a model in virtual time; an opener of itself. disconnected: whether written bytes are lost."""

    def __init__(self, model: DispenserModel, clock: Clock, faults: Sequence[Fault] = ()) -> None:
        """faults: those of dispensers count."""
        self.model, self._clock, self.disconnected = model, clock, False
        self._faults = faults_striking(faults, FaultPart.DISPENSER)

    def __call__(self) -> DispenserPort:
        """Open it; UnpluggedError while it is away."""
        self._here()
        return self

    def _here(self) -> float:
        """The instant, s; UnpluggedError while it is away."""
        now = self._clock.now()
        if self._has_fault(FaultKind.UNPLUG, now):
            raise UnpluggedError("the device is gone")
        return now

    def _has_fault(self, kind: FaultKind, now: float) -> bool:
        return any(fault.kind is kind and fault.covers(now) for fault in self._faults)

    def release(self) -> None:
        """Nothing is held."""

    def write(self, data: bytes) -> int:
        """Hand bytes to the model at once, unless a fault stops them."""
        now = self._here()
        if self._has_fault(FaultKind.BLOCK, now):
            return 0
        if not (self.disconnected or self._has_fault(FaultKind.DROP, now)):
            self.model.receive(data, now)
        return len(data)

    def read(self) -> bytes:
        """The model's answers."""
        return self.model.transmit(self._here())

    def waiting(self) -> int:
        """Nothing is on the wire."""
        return 0

    def close(self) -> None:
        """The model goes on."""


_print_line = partial(print, flush=True)


def run_virtual_dispenser(
    settings: VirtualDispenserSettings,
    log: Path | None = None,
    link: Path | None = None,
    clock: Clock | None = None,
    stop: threading.Event | None = None,
    say: Callable[[str], None] = _print_line,
) -> DispenserModel:
    """Serve a virtual dispenser on a new pty until `stop` is set, Ctrl-C or SIGTERM; say its device, then a summary.

    log: a new CSV of the true flow, a row a millisecond, stamped by the machine's monotonic clock. link: a symbolic
    link to the device, removed at the end. InputError where either would overwrite something. Returns the device as it
    was at the end.
    """
    clock, stop = clock or WallClock(), stop or threading.Event()
    model = DispenserModel(settings, clock.now())
    header = "stamp_s,flow_mm3_s,switched\n"
    with open_log(log, header) as file, served_pty(link, stop, say) as port:
        _serve(port, model, clock, stop, file)
    say(summary_of(model))
    return model


def summary_of(model: DispenserModel) -> str:
    """Counts of its switches, watchdog stops and unknown lines, in a few lines."""
    switched_on = sum(flow > 0 for _, flow in model.switches)
    unknown = f", the first {model.unknown_lines[0]!r}" if model.unknown_lines else ""
    return (
        f"switched on or to another flow {switched_on} times, now {'on' if model.on else 'off'}\n"
        f"{len(model.watchdog_stops)} times its watchdog switched it off\n"
        f"{len(model.unknown_lines)} lines that it does not know{unknown}"
    )


def _serve(port: int, model: DispenserModel, clock: Clock, stop: threading.Event, file: TextIO | None) -> None:
    log_end = model.now
    while not stop.is_set():
        clock.wait_until(model.now + DISPENSER_POLL)
        data, now = b"", clock.now()
        with suppress(BlockingIOError):
            data = os.read(port, MAX_LINE)
        model.receive(data, now)
        with suppress(BlockingIOError):
            os.write(port, model.transmit(now))
        if file is not None and now >= log_end + DISPENSER_LOG_PERIOD:
            log_end = _log(file, model, log_end, now)
    if file is not None:
        _log(file, model, log_end, model.now)


def _log(file: TextIO, model: DispenserModel, start: float, end: float) -> float:
    """Write the rows from `start` on and before `end`; start of the next one. switched: 1 while on."""
    stamps = np.float64(start) + DISPENSER_LOG_STEP * np.arange(max(int((end - start) / DISPENSER_LOG_STEP), 0))
    flows = np.array([0.0, *(flow for _, flow in model.switches)])
    on = flows[np.searchsorted(np.array([stamp for stamp, _ in model.switches]), stamps, "right")] > 0
    np.savetxt(file, np.column_stack([stamps, model.flow_at(stamps), on]), ["%.6f", "%.6f", "%d"], delimiter=",")
    file.flush()
    return start + DISPENSER_LOG_STEP * len(stamps)
