"""The virtual arm's settings and its serial line; the settings are a TOML table [arm], in mm, degrees and s.

fifo = 200
dead_time_s = 0.0
servo_lag_s = 0.02
top_speed_mm_s = 250
top_turn_deg_s = 180
low_mm_deg = [-1000, -1000, -500, -180, -180, -180]
high_mm_deg = [1000, 1000, 500, 180, 180, 180]
replies = "off"                # or "stream" or "stray"
reply_period_s = 0.05
seed = 0

The serial line is in virtual time: bytes on the wire, frames lost on the way in, and telemetry. What each fault
means stands in hardware/process/faults.py. Without a duration a drop or garble hits one frame, the first one from its
start on; with one, every frame that begins within it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.driver import Reply, ReplyKind
from hardware.arm.profile import AXIS_UNITS, BITS_PER_BYTE
from hardware.arm.protocol import FRAME_LENGTH, encode_reply
from hardware.process import checks
from hardware.process.faults import (
    Fault,
    FaultKind,
    FaultPart,
    FaultRunner,
    check_faults,
    faults_from_texts,
    faults_striking,
)

_REACH_LIMIT = np.array([1600.0] * 3 + [np.deg2rad(320.0)] * 3)  # a reply's int16 must hold a place less an origin


class ReplyMode(Enum):
    """The arm's replies."""

    OFF = "off"
    STREAM = "stream"  # place and angles every period, as a public driver reads them
    STRAY = "stray"  # single random bytes at random instants, as thesis 6.2 has it


def _six(x_y: float, z: float, angle_deg: float) -> Array:
    return np.array([x_y, x_y, z, *np.deg2rad([angle_deg] * 3)])


@dataclass(frozen=True, slots=True, eq=False)
class ArmSettings:
    """One virtual arm. InputError names a setting that makes no sense."""

    fifo: int = 200  # commands; thesis 6.2: 9600 bytes
    dead_time: float = 0.0  # s from set-point to servo; nobody has measured it
    servo_lag: float = 0.02  # s, time constant; nobody has measured it; usual for small position servos
    top_speed: float = 250.0  # mm/s along X Y Z; 15,000 mm/min in public drivers
    top_turn: float = float(np.pi)  # rad/s of each of A B C; unknown; above the planner's 120 degrees/s
    low: Array = field(default_factory=lambda: -_six(1000, 500, 180))  # X Y Z as in a public driver
    high: Array = field(default_factory=lambda: _six(1000, 500, 180))
    replies: ReplyMode = ReplyMode.OFF  # the thesis could read none
    reply_period: float = 0.05  # s, mean for stray bytes; 27 bytes take 28 ms at 9600 bits/s, a public driver's slowest
    seed: int = 0  # of the stray bytes and of faults

    def __post_init__(self) -> None:
        for name, low in (("fifo", 1), ("seed", 0)):
            checks.integer("arm", name, getattr(self, name), low)
        for name in ("dead_time", "servo_lag", "top_speed", "top_turn", "reply_period"):
            number, zero = getattr(self, name), name in ("dead_time", "servo_lag")
            if not (np.isfinite(number) and (number > 0 or (zero and number == 0))):
                raise InputError("arm", name, number, "a finite number >= 0" if zero else "a finite number > 0")
        for name in ("low", "high"):
            value = getattr(self, name)
            if np.shape(value) != (6,) or not (np.abs(value) <= _REACH_LIMIT).all():
                raise InputError("arm", name, np.asarray(value).tolist(), "6 numbers within 1600 mm and 320 degrees")
        if (self.low >= self.high).any():
            raise InputError("arm", "low", self.low.tolist(), f"below high, {self.high.tolist()}")


ARM_KEYS: checks.Keys = {  # in a table [arm]
    "fifo": ("fifo", checks.whole(1)),
    "dead_time_s": ("dead_time", checks.number),
    "servo_lag_s": ("servo_lag", checks.number),
    "top_speed_mm_s": ("top_speed", checks.number),
    "top_turn_deg_s": ("top_turn", checks.times(checks.number, float(np.deg2rad(1.0)))),
    "low_mm_deg": ("low", checks.times(checks.array((6,)), AXIS_UNITS)),
    "high_mm_deg": ("high", checks.times(checks.array((6,)), AXIS_UNITS)),
    "replies": ("replies", checks.member(ReplyMode)),
    "reply_period_s": ("reply_period", checks.number),
    "seed": ("seed", checks.whole(0)),
}


def arm_settings_from_table(where: object, table: checks.Table) -> ArmSettings:
    """The settings in a table [arm]; what it leaves out keeps its default. InputError names the key."""
    return checks.record_from_table(where, "arm.", table, ArmSettings, ARM_KEYS)


def write_virtual_arm(file: Path, settings: ArmSettings, faults: tuple[Fault, ...]) -> None:
    """Write settings and faults for `read_virtual_arm`."""
    values = {key: getattr(settings, name) for key, (name, _) in ARM_KEYS.items()}
    values |= {key: values[key] / AXIS_UNITS for key in ("low_mm_deg", "high_mm_deg")}
    values |= {"top_turn_deg_s": float(np.rad2deg(settings.top_turn)), "replies": settings.replies.value}
    lines = [*checks.toml_lines({"faults": [str(fault) for fault in faults]}), "[arm]", *checks.toml_lines(values)]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_virtual_arm(file: Path) -> tuple[ArmSettings, tuple[Fault, ...]]:
    """Settings and faults of a virtual arm; InputError names the key that is wrong."""
    table = checks.read_toml(file)
    checks.check_keys(file, "", table, ("faults", "arm"))
    faults = faults_from_texts(file, "faults", table["faults"], FaultPart.ARM)
    check_faults(faults, FaultRunner.ARM, file, "faults")
    return arm_settings_from_table(file, checks.table_at(file, "", table, "arm")), faults


class SerialWire:
    """One direction of a line. baud: bits/s, infinite for a line without delay."""

    def __init__(self, baud: float) -> None:
        if not baud > 0:
            raise InputError("wire", "baud", baud, "> 0 bits/s")
        self._byte_time = BITS_PER_BYTE / baud
        self.busy_until = -math.inf  # s, when the last byte sent so far has arrived; -inf before the first

    def send(self, data: bytes, now: float) -> Array:
        """Instants (N,), s, at which the bytes handed over at `now` have arrived; they wait for those before them."""
        arrivals = max(self.busy_until, now) + self._byte_time * np.arange(1, len(data) + 1)
        if len(arrivals):
            self.busy_until = float(arrivals[-1])
        return np.asarray(arrivals)


def unplugged(faults: Sequence[Fault], instant: float) -> bool:
    """Whether the line is cut at `instant`, s."""
    return any(fault.covers(instant) for fault in faults_striking(faults, FaultPart.ARM, FaultKind.UNPLUG))


class FaultyLine:
    """The line into the arm. Frames are counted as 48 bytes each from the first byte on.

    faulty_frames: instants, s, at which a frame began that was lost or garbled.
    """

    def __init__(self, faults: Sequence[Fault], rng: np.random.Generator) -> None:
        self._faults, self._rng = list(faults), rng
        self._position = 0
        self._mask: bytes | None = bytes(FRAME_LENGTH)  # bits of this frame that flip; None where it is lost
        self.faulty_frames: list[float] = []

    def __call__(self, data: bytes, now: float) -> bytes:
        """The bytes that pass of `data`, received at `now`, s."""
        output = bytearray()
        while data:
            if self._position == 0:
                self._begin(now)
            part, data = data[: FRAME_LENGTH - self._position], data[FRAME_LENGTH - self._position :]
            if self._mask is not None:
                output += bytes(a ^ b for a, b in zip(part, self._mask[self._position :], strict=False))
            self._position = (self._position + len(part)) % FRAME_LENGTH
        return b"" if unplugged(self._faults, now) else bytes(output)

    def _begin(self, now: float) -> None:
        self._mask = bytes(FRAME_LENGTH)
        for fault in faults_striking(self._faults, FaultPart.ARM, FaultKind.DROP, FaultKind.GARBLE):
            one_frame = fault.duration == 0
            if not (now >= fault.start if one_frame else fault.covers(now)):
                continue
            if one_frame:
                self._faults.remove(fault)
            if fault.kind is FaultKind.DROP or self._mask is None:
                self._mask = None
            else:
                bits = np.zeros(8 * FRAME_LENGTH, np.uint8)
                bits[self._rng.choice(len(bits), self._rng.integers(1, 9), replace=False)] = 1
                self._mask = np.packbits(bits).tobytes()
            self.faulty_frames.append(now)


class Telemetry:
    """Bytes on their way to the host.

    A stream begins one period after the start and gives place, tool and arm angles each period, as long as the line is
    free. The place is what a G1 would name, that is, from the work origin. J1 J2 J3 are sent as 0: they would need
    the arm's geometry.
    """

    def __init__(self, settings: ArmSettings, baud: float, faults: Sequence[Fault]) -> None:
        self._mode, self._period = settings.replies, settings.reply_period
        self._faults, self._wire = faults, SerialWire(baud)
        self._rng = np.random.default_rng([settings.seed, 0])
        self._in_transit: deque[tuple[float, int]] = deque()  # when each byte arrives
        self._count, self._next, self._stray = 0, 0.0, 0
        self._schedule()

    def advance(self, now: float, axes_at: Callable[[Array], Array], origin: Array) -> None:
        """Send the replies due up to `now`, s. axes_at: the executed axes (N, 6) at instants (N,). origin: (3,) mm."""
        instants: list[float] = []
        replies: list[bytes] = []
        while self._mode is not ReplyMode.OFF and self._next <= now:
            instants.append(self._next)
            replies.append(bytes([self._stray]))
            self._schedule()
        if instants and self._mode is ReplyMode.STREAM:
            kinds = ReplyKind.PLACE, ReplyKind.TOOL, ReplyKind.ARM
            replies = []
            for axes in axes_at(np.array(instants)):
                values = zip(kinds, (axes[:3] - origin, axes[3:], np.zeros(3)), strict=True)
                replies.append(b"".join(encode_reply(Reply(*each)) for each in values))
        for instant, data in zip(instants, replies, strict=True):
            if self._wire.busy_until <= instant and not unplugged(self._faults, instant):
                self._in_transit.extend(zip(self._wire.send(data, instant).tolist(), data, strict=True))

    def take(self, now: float) -> bytes:
        """The bytes that have reached the host by `now` since the last call."""
        output = bytearray()
        while self._in_transit and self._in_transit[0][0] <= now:
            output.append(self._in_transit.popleft()[1])
        return bytes(output)

    def _schedule(self) -> None:
        self._count += 1
        if self._mode is ReplyMode.STREAM:
            self._next = self._count * self._period
        elif self._mode is ReplyMode.STRAY:
            self._next += self._rng.exponential(self._period)
            self._stray = int(self._rng.integers(256))
