"""The virtual arm behind a port in virtual time, and what can go wrong with the port between host and arm.

Bytes take their time on a wire each way. The port's own faults are those of an adapter: it takes a part of a write or
nothing for a while, it is gone for a while, and stray bytes get in between. What goes wrong in the arm itself is in
arm_faults.py.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from estimation.errors import InputError
from hardware.arm.port import UnpluggedError
from hardware.arm.profile import BITS_PER_BYTE
from hardware.process.clock import Clock
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.wire import Wire

Window = tuple[float, float]  # from, until, s


@dataclass(frozen=True, slots=True)
class PortFaults:
    """blocked: when the port takes nothing. away: when the device is not there. partial: share of writes of which only
    a part is taken. noise: stray bytes a second towards the host. noise_out: share of writes that get a stray byte.
    """

    blocked: Sequence[Window] = ()
    away: Sequence[Window] = ()
    partial: float = 0.0
    noise: float = 0.0
    noise_out: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.partial < 1 and self.noise >= 0 and 0 <= self.noise_out <= 1):
            allowed = "shares below 1, and a rate >= 0"
            raise InputError("port", "faults", (self.partial, self.noise, self.noise_out), allowed)


class Tap(Protocol):
    """Who listens on the line."""

    def opened(self) -> None:
        """The host has opened the device."""
        ...

    def from_host(self, data: bytes) -> None:
        """The port has taken bytes."""
        ...

    def to_arm(self, data: bytes) -> None:
        """Bytes have reached the arm."""
        ...

    def to_host(self, sent: bytes, read: bytes) -> None:
        """What the arm has sent, and what the host reads with the noise."""
        ...


class VirtualPort:
    """One opening of the device before a VirtualArm."""

    def __init__(self, device: VirtualDevice) -> None:
        self._device = device
        self._wire = Wire(device.baud)
        self._under_way: deque[tuple[float, bytes]] = deque()
        self._looked = device.here()
        if device.tap is not None:
            device.tap.opened()

    def write(self, data: bytes) -> int:
        """Take bytes, or some of them, or none."""
        device, now = self._device, self._device.here()
        faults, rng = device.faults, device.rng
        if any(start <= now < end for start, end in faults.blocked):
            return 0
        if faults.partial and rng.random() < faults.partial:
            data = data[: rng.integers(len(data))]
        taken = len(data)
        if device.tap is not None:
            device.tap.from_host(data)
        if faults.noise_out and rng.random() < faults.noise_out:
            place = rng.integers(taken + 1)
            data = data[:place] + rng.bytes(1) + data[place:]
        if data:
            self._under_way.append((float(self._wire.send(data, now)[-1]), data))
        return taken

    def read(self) -> bytes:
        """What the arm has sent, and noise."""
        device, now = self._device, self._device.here()
        self._deliver(now)
        data = device.arm.transmit(now)
        noise = device.rng.poisson(device.faults.noise * (now - self._looked)) if device.faults.noise else 0
        self._looked = now
        read = data + device.rng.bytes(noise) if noise else data
        if device.tap is not None and read:
            device.tap.to_host(data, read)
        return read

    def waiting(self) -> int:
        """Bytes that are not through the wire yet."""
        left = (self._wire.free - self._device.clock.now()) * self._device.baud / BITS_PER_BYTE
        return int(left) if left > 0 else 0

    def close(self) -> None:
        """Let go; what is not through the wire is lost."""
        self._deliver(self._device.clock.now())
        self._under_way.clear()

    def _deliver(self, now: float) -> None:
        while self._under_way and self._under_way[0][0] <= now:
            arrival, data = self._under_way.popleft()
            self._device.receive(data, arrival)


class VirtualDevice:
    """What opens ports to a VirtualArm; an Opener."""

    def __init__(
        self,
        arm: VirtualArm,
        clock: Clock,
        baud: float = 115_200,
        faults: PortFaults | None = None,
        seed: int = 0,
        tap: Tap | None = None,
    ) -> None:
        """tap: is told all that passes."""
        self.arm, self.clock, self.baud = arm, clock, baud
        self.faults = PortFaults() if faults is None else faults
        self.rng = np.random.default_rng(seed)
        self.tap = tap

    def __call__(self) -> VirtualPort:
        """Open it; UnpluggedError while it is away."""
        return VirtualPort(self)

    def here(self) -> float:
        """The instant, s; UnpluggedError while the device is away."""
        now = self.clock.now()
        if any(start <= now < end for start, end in self.faults.away):
            raise UnpluggedError("the device is gone")
        return now

    def receive(self, data: bytes, arrival: float) -> None:
        """Bytes reach the arm at `arrival`, s."""
        self.arm.receive(data, max(arrival, self.arm.now))
        if self.tap is not None:
            self.tap.to_arm(data)
