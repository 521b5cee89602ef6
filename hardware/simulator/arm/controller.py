"""The SEED S6H4D as seen from its serial line, in virtual time: bytes in, executed axes and bytes out.

What thesis and public drivers leave open is decided here, for the worse case of a host where there is one:

* A command keeps its place in the FIFO until it is done. What does not fit is ignored for good.
* A move begins and ends at rest or in the next move: straight from the last queued target, without look-ahead.
* F of a move that changes A B C alone counts degrees/min instead of mm/min, as is usual in G-code: an assumption.
* G54 names its origin in machine coordinates and holds for the moves that come after it; it takes no place in the FIFO.
* A pause frame stops the set-point where it is and drops what is queued: no driver sends a frame that would go on.
  A reset does the same; a controller reset also takes work origin and mode back. The next move starts from there.
* A mode is kept and changes nothing. A target or origin out of reach is ignored.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import partial

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm import protocol
from hardware.arm.driver import G1, G4, G54
from hardware.arm.protocol import ControllerReset, Dialect, Instruction, Mode
from hardware.process.faults import Fault, FaultPart, WorkRates, WorkStretches, faults_striking
from hardware.simulator.arm.settings import ArmSettings, FaultyLine, Telemetry
from planning.command import MIN_TRAVEL

AXIS_COUNT = 6


class Polyline:
    """Knots, each an instant, the axes (6,) there and their slope until the next knot; it is extended at its end.

    Before the first knot and, where the last slope is zero, after the last one, the axes rest.
    """

    def __init__(self, instant: float, axes: Array) -> None:
        self._knots = np.zeros((64, 1 + 2 * AXIS_COUNT))  # instant, axes, slope
        self._size = 0
        self.append(instant, axes, np.zeros(AXIS_COUNT))

    def __len__(self) -> int:
        return self._size

    @property
    def instants(self) -> Array:
        """Instants (N,) of the knots, s."""
        return self._knots[: self._size, 0]

    @property
    def axes(self) -> Array:
        """Axes (N, 6) at the knots, mm and rad."""
        return self._knots[: self._size, 1 : 1 + AXIS_COUNT]

    @property
    def slopes(self) -> Array:
        """Slopes (N, 6) after the knots, mm/s and rad/s."""
        return self._knots[: self._size, 1 + AXIS_COUNT :]

    def append(self, instant: float, axes: Array, slope: Array) -> None:
        """Continue from `axes` with `slope`; a knot at the instant of the last one replaces it."""
        if self._size and instant == self._knots[self._size - 1, 0]:
            self._size -= 1
        assert not self._size or instant > self._knots[self._size - 1, 0]
        if self._size == len(self._knots):
            self._knots = np.concatenate([self._knots, np.zeros_like(self._knots)])
        knot = self._knots[self._size]
        knot[0], knot[1 : 1 + AXIS_COUNT], knot[1 + AXIS_COUNT :] = instant, axes, slope
        self._size += 1

    def stop(self, instant: float) -> None:
        """Delete all after `instant`, and rest there."""
        axes = self.at(np.array([instant]))[0]
        self._size = int(np.searchsorted(self.instants, instant, "right"))
        self.append(instant, axes, np.zeros(AXIS_COUNT))

    def before(self, instants: Array) -> tuple[np.ndarray, Array]:
        """For instants (N,): the index of the knot at or before each, else of the first, and s since then."""
        index = np.maximum(np.searchsorted(self.instants, instants, "right") - 1, 0)
        return index, np.maximum(instants - self.instants[index], 0.0)

    def at(self, instants: Array) -> Array:
        """Axes (N, 6) at instants (N,), s."""
        index, since = self.before(instants)
        return np.asarray(self.axes[index] + self.slopes[index] * since[:, None])


class Servo:
    """The true axes y: tau y' = u - y, where u is the line `dead_time` s ago; y is u at its first knot."""

    def __init__(self, line: Polyline, dead_time: float, tau: float) -> None:
        self._line, self._dead_time, self._tau = line, dead_time, tau
        self._lag_axes = np.zeros((64, AXIS_COUNT))  # y - u at each knot
        self._size = 1

    def at(self, instants: Array, now: float) -> Array:
        """Axes (N, 6) at instants (N,) up to `now`, after which the line may still change."""
        self._settle(now)
        index, since = self._line.before(instants - self._dead_time)
        slopes = self._line.slopes[index]
        axes = self._line.axes[index] + slopes * since[:, None]
        if self._tau == 0:
            return np.asarray(axes)
        decay = np.exp(-since / self._tau)[:, None]
        return np.asarray(axes + (self._lag_axes[index] * decay + slopes * self._tau * (decay - 1)))

    def _settle(self, now: float) -> None:
        instants, slopes = self._line.instants, self._line.slopes
        size = int(np.searchsorted(instants, now, "right"))
        while len(self._lag_axes) < size:
            self._lag_axes = np.concatenate([self._lag_axes, np.zeros_like(self._lag_axes)])
        if self._tau == 0 or size <= self._size:
            return
        decays = np.exp(-np.diff(instants[self._size - 1 : size]) / self._tau).tolist()
        for knot, decay in zip(range(self._size, size), decays, strict=True):
            steady = slopes[knot - 1] * self._tau
            self._lag_axes[knot] = (self._lag_axes[knot - 1] + steady) * decay - steady
        self._size = size


CONTINUATION_GAP = 1e-5  # s: a move this late after the last one still follows it without a stop


class VirtualArm:
    """One arm from 0 s on; its time is its caller's, which never goes back."""

    def __init__(
        self,
        settings: ArmSettings,
        dialect: Dialect,
        home_axes: Array,
        faults: Sequence[Fault] = (),
        baud: float = 115_200,
    ) -> None:
        """home_axes: (6,) mm and rad, at first. faults: those of the arm count. baud: bits/s of replies, or inf."""
        if home_axes.shape != (AXIS_COUNT,) or not np.isfinite(home_axes).all():
            raise InputError("arm", "home", home_axes.tolist(), "6 finite numbers X Y Z A B C, mm and rad")
        self.frames, self.mode, self.now = 0, 0, 0.0  # instructions understood; the last mode set; s
        self.peak_work, self.peak_commands = 0.0, 0  # s of work without stalls, and commands: the most ever queued
        self.ignored: list[float] = []  # s, commands that found the FIFO full
        self.refused: list[float] = []  # s, targets and origins out of reach
        self.underruns: list[float] = []  # s, the queue was empty within a motion: the arm stopped before the next move
        self.garbage: list[tuple[float, bytes]] = []  # s, and bytes that belong to no frame of this dialect
        self._settings = settings
        decode = partial(protocol.decode, dialect=dialect)
        self._stream = protocol.FrameStream(protocol.FRAME_LENGTH, protocol.FRAME_TAILS, decode)
        self._input = FaultyLine(faults, np.random.default_rng([settings.seed, 1]))
        self.faulty_frames = self._input.faulty_frames  # s, frames that a fault lost or garbled
        self._rates = WorkRates(faults_striking(faults, FaultPart.ARM))
        self._telemetry = Telemetry(settings, baud, faults)
        self._setpoint = Polyline(0.0, home_axes)
        self._servo = Servo(self._setpoint, settings.dead_time, settings.servo_lag)
        self._target = home_axes.copy()  # machine coordinates, of the last command queued
        self.origin = np.zeros(3)  # of work, mm
        self._fifo: deque[WorkStretches] = deque()  # of the commands in it
        self._queue_end = 0.0  # s, end of the last one
        self._moving = False  # whether it is a move, which the next may follow without a stop

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that have arrived at `now`, s, in any split."""
        self.advance(now)
        instructions, garbage = self._stream(self._input(data, now))
        if garbage:
            self.garbage.append((now, garbage))
        for instruction in instructions:
            self.frames += 1
            self._execute(instruction)

    def advance(self, until: float) -> None:
        """Let time pass until `until`, s."""
        assert until >= self.now
        self.now = until
        while self._fifo and self._fifo[0][-1][1] <= until:
            self._fifo.popleft()
        self._telemetry.advance(until, self.axes_at, self.origin)

    def transmit(self, now: float) -> bytes:
        """The bytes that have reached the host by `now`, s, since the last call."""
        self.advance(now)
        return self._telemetry.take(now)

    def axes_at(self, instants: Array) -> Array:
        """Executed axes (N, 6), mm and rad, at instants (N,), s, that are not in the future."""
        assert (instants <= self.now).all()
        return self._servo.at(instants, self.now)

    @property
    def queued(self) -> int:
        """Commands in the FIFO, including the one in execution."""
        return len(self._fifo)

    @property
    def in_flight(self) -> float:
        """Seconds until the queue is done."""
        return max(self._queue_end - self.now, 0.0)

    @property
    def queued_work(self) -> float:
        """Seconds of work in the queue without stalls."""
        return sum(rate * max(end - max(start, self.now), 0.0) for item in self._fifo for start, end, rate in item)

    def _execute(self, instruction: Instruction) -> None:
        low, high = self._settings.low, self._settings.high
        match instruction:
            case G1() | G4() if self.queued >= self._settings.fifo:
                self.ignored.append(self.now)
            case G1():
                target = np.concatenate([instruction.axes[:3] + self.origin, instruction.axes[3:]])
                if (target < low).any() or (target > high).any():
                    self.refused.append(self.now)
                else:
                    self._queue(_duration(target - self._target, instruction.feed, self._settings), target)
            case G4():
                self._queue(instruction.duration, None)
            case G54() if (instruction.origin < low[:3]).any() or (instruction.origin > high[:3]).any():
                self.refused.append(self.now)
            case G54():
                self.origin = instruction.origin
            case Mode():
                self.mode = instruction.mode
            case _:
                self._setpoint.stop(self.now)
                self._target = self._setpoint.axes[-1].copy()
                self._fifo.clear()
                self._queue_end, self._moving = self.now, False
                if isinstance(instruction, ControllerReset):
                    self.origin, self.mode = np.zeros(3), 0

    def _queue(self, work: float, target: Array | None) -> None:
        """Append a command: `work` s of motion to `target` (6,), or of pause."""
        begin, moving = max(self.now, self._queue_end), target is not None and work > 0
        if moving and self._moving and self.now > self._queue_end + CONTINUATION_GAP:
            self.underruns.append(self._queue_end)
        self._moving = moving
        stretches = self._rates.stretches(begin, work, moving)
        self._queue_end = stretches[-1][1]
        self._fifo.append(stretches)
        self.peak_work, self.peak_commands = max(self.peak_work, self.queued_work), max(self.peak_commands, self.queued)
        if target is not None and self._queue_end > begin and moving:
            speed, axes = (target - self._target) / work, self._target
            for begin, end, rate in stretches:
                self._setpoint.append(begin, axes, rate * speed)
                axes = axes + rate * speed * (end - begin)
            self._setpoint.append(self._queue_end, target, np.zeros(AXIS_COUNT))
            self._target = target


def _duration(travel: Array, feed: float, settings: ArmSettings) -> float:
    """Seconds that a move along `way` (6,), mm and rad, takes at `feed` mm/s, or degrees/s if it only turns."""
    length, turns = float(np.linalg.norm(travel[:3])), np.abs(travel[3:])
    if length > MIN_TRAVEL or not turns.any():
        duration = length / min(feed, settings.top_speed)
    else:
        duration = max(float(np.linalg.norm(turns)) / float(np.deg2rad(feed)), length / settings.top_speed)
    return max(duration, float(turns.max()) / settings.top_turn)
