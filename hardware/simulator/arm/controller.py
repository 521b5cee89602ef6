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

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.protocol import (
    G1,
    G4,
    G54,
    LENGTH,
    TAILS,
    ControllerReset,
    Dialect,
    FrameStream,
    Instruction,
    Mode,
    decode,
)
from hardware.process.faults import Fault, Part, struck
from hardware.rates import Rates, Stretches
from hardware.simulator.arm.serial_line import Answers
from hardware.simulator.arm.settings import ArmSettings
from hardware.simulator.arm_faults import FaultyLine
from hardware.simulator.polyline import AXES, Polyline
from hardware.simulator.servo import Servo
from planning.command import TURNING

NEXT = 1e-5  # s: a move that comes this late after the last one still follows it without a stop


class VirtualArm:
    """One arm from 0 s on; it knows the time from its caller alone, which never goes back.

    frames: instructions understood. ignored: instants, s, of commands that found the FIFO full. refused: of targets and
    origins out of reach. garbage: instants and bytes that belong to no frame of this dialect. underruns: instants at
    which the queue ran dry within a motion, so that the arm stopped before the next move came. mode: the last one set.
    deepest: s of work that the queue ever held, however long a stall let it wait; fullest: commands.
    """

    def __init__(
        self,
        settings: ArmSettings,
        dialect: Dialect,
        home_axes: Array,
        faults: Sequence[Fault] = (),
        baud: float = 115_200,
    ) -> None:
        """home_axes: (6,) mm and rad, where it stands at first. baud: bits/s of what it sends, inf for no delay.

        faults: those of the arm count.
        """
        if home_axes.shape != (AXES,) or not np.isfinite(home_axes).all():
            raise InputError("arm", "home", home_axes.tolist(), "6 finite numbers X Y Z A B C, mm and rad")
        self.frames, self.mode, self.now = 0, 0, 0.0
        self.deepest, self.fullest = 0.0, 0
        self.ignored: list[float] = []
        self.refused: list[float] = []
        self.underruns: list[float] = []
        self.garbage: list[tuple[float, bytes]] = []
        self._settings = settings
        self._stream = FrameStream(LENGTH, TAILS, lambda frame: decode(frame, dialect))
        self._line_in = FaultyLine(faults, np.random.default_rng([settings.seed, 1]))
        self._rates = Rates(struck(faults, Part.ARM))
        self._answers = Answers(settings, baud, faults)
        self._setpoint = Polyline(0.0, home_axes)
        self._servo = Servo(self._setpoint, settings.dead_time, settings.servo_lag, _most(settings))
        self._target = home_axes.copy()  # machine coordinates, of the last command queued
        self._origin = np.zeros(3)
        self._fifo: deque[Stretches] = deque()  # of the commands in it
        self._free = 0.0  # when the last one ends
        self._flowing = False  # it is a move, and the next one may follow without a stop

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that have arrived at `now`, s, in any split."""
        self.advance(now)
        instructions, garbage = self._stream(self._line_in(data, now))
        if garbage:
            self.garbage.append((now, garbage))
        for instruction in instructions:
            self.frames += 1
            self._take(instruction)

    def advance(self, until: float) -> None:
        """Let time pass until `until`, s."""
        assert until >= self.now
        self.now = until
        while self._fifo and self._fifo[0][-1][1] <= until:
            self._fifo.popleft()
        self._answers.advance(until, self.axes_at, self._origin)

    def transmit(self, now: float) -> bytes:
        """The bytes that have reached the host by `now`, s, since the last call."""
        self.advance(now)
        return self._answers.take(now)

    def axes_at(self, instants: Array) -> Array:
        """Executed axes (N, 6), mm and rad, at instants (N,), s, that are not in the future."""
        assert (instants <= self.now).all()
        return self._servo.at(instants, self.now)

    @property
    def queued(self) -> int:
        """Commands in the FIFO, the one being done included."""
        return len(self._fifo)

    @property
    def in_flight(self) -> float:
        """Seconds until the queue is done."""
        return max(self._free - self.now, 0.0)

    @property
    def held(self) -> float:
        """Seconds of work in the queue: what it would take if nothing stalled."""
        return sum(rate * max(end - max(begin, self.now), 0.0) for each in self._fifo for begin, end, rate in each)

    @property
    def origin(self) -> Array:
        """The work origin (3,), mm."""
        return self._origin

    @property
    def struck(self) -> list[float]:
        """Instants, s, of frames that a fault lost or garbled."""
        return self._line_in.struck

    def _take(self, instruction: Instruction) -> None:
        if isinstance(instruction, G1 | G4):
            if self.queued >= self._settings.fifo:
                self.ignored.append(self.now)
            elif isinstance(instruction, G1):
                self._move(instruction)
            else:
                self._queue(instruction.duration, None)
        elif isinstance(instruction, G54):
            self._set_origin(instruction.origin)
        elif isinstance(instruction, Mode):
            self.mode = instruction.mode
        else:
            self._stop()
            if isinstance(instruction, ControllerReset):
                self._origin, self.mode = np.zeros(3), 0

    def _move(self, move: G1) -> None:
        target = np.concatenate([move.axes[:3] + self._origin, move.axes[3:]])
        if (target < self._settings.low).any() or (target > self._settings.high).any():
            self.refused.append(self.now)
            return
        self._queue(_duration(target - self._target, move.feed, self._settings), target)

    def _queue(self, work: float, target: Array | None) -> None:
        """Put a command behind the others: `work` s of motion to `target` (6,), or of pause."""
        begin, moving = max(self.now, self._free), target is not None and work > 0
        if moving and self._flowing and self.now > self._free + NEXT:
            self.underruns.append(self._free)
        self._flowing = moving
        stretches = self._rates.stretches(begin, work, moving)
        self._free = stretches[-1][1]
        self._fifo.append(stretches)
        self.deepest, self.fullest = max(self.deepest, self.held), max(self.fullest, self.queued)
        if target is not None and self._free > begin and moving:
            self._interpolate(stretches, (target - self._target) / work)
            self._setpoint.append(self._free, target, np.zeros(AXES))
            self._target = target

    def _interpolate(self, stretches: Stretches, speed: Array) -> None:
        axes = self._target
        for begin, end, rate in stretches:
            self._setpoint.append(begin, axes, rate * speed)
            axes = axes + rate * speed * (end - begin)

    def _set_origin(self, origin: Array) -> None:
        if (origin < self._settings.low[:3]).any() or (origin > self._settings.high[:3]).any():
            self.refused.append(self.now)
        else:
            self._origin = origin

    def _stop(self) -> None:
        """Rest where the set-point is, with nothing queued."""
        self._setpoint.stop(self.now)
        self._target = self._setpoint.axes[-1].copy()
        self._fifo.clear()
        self._free, self._flowing = self.now, False


def _duration(way: Array, feed: float, settings: ArmSettings) -> float:
    """Seconds that a move along `way` (6,), mm and rad, takes at `feed` mm/s, or degrees/s if it only turns."""
    length, turns = float(np.linalg.norm(way[:3])), np.abs(way[3:])
    if length > TURNING or not turns.any():
        asked = length / min(feed, settings.top_speed)
    else:
        asked = max(float(np.linalg.norm(turns)) / float(np.deg2rad(feed)), length / settings.top_speed)
    return max(asked, float(turns.max()) / settings.top_turn)


def _most(settings: ArmSettings) -> Array | None:
    if settings.acceleration is None:
        return None
    return settings.acceleration * np.array([1.0, settings.top_turn / settings.top_speed])
