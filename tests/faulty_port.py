"""A virtual arm's port with the faults of an adapter: it accepts a part of a write or nothing, and adds stray bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hardware.process.clock import Clock
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import Interval, VirtualDevice, VirtualPort


@dataclass(frozen=True, slots=True)
class PortFaults:
    """What goes wrong at the port."""

    blocked: Sequence[Interval] = ()  # when the port accepts nothing
    away: Sequence[Interval] = ()  # when the device is gone
    partial: float = 0.0  # share of writes that are accepted in part
    noise: float = 0.0  # stray bytes a second towards the host
    noise_out: float = 0.0  # share of writes that get a stray byte


class LineListener(Protocol):
    """An observer of the line."""

    def opened(self) -> None:
        """The host has opened the device."""

    def from_host(self, data: bytes) -> None:
        """The port has accepted bytes."""

    def to_arm(self, data: bytes) -> None:
        """Bytes have reached the arm."""

    def to_host(self, sent: bytes, read: bytes) -> None:
        """The arm's bytes, and the bytes that the host reads, with noise."""


class FaultyPort(VirtualPort):
    """One opening of a FaultyDevice."""

    def __init__(self, device: FaultyDevice) -> None:
        super().__init__(device)
        self._faulty, self._last_read = device, device.clock.now()
        if device.observer is not None:
            device.observer.opened()

    def write(self, data: bytes) -> int:
        """Accept all bytes, some or none; their count."""
        device, faults, rng, now = self._faulty, self._faulty.faults, self._faulty.rng, self._faulty.present()
        if any(start <= now < end for start, end in faults.blocked):
            return 0
        if faults.partial and rng.random() < faults.partial:
            data = data[: rng.integers(len(data))]
        count = len(data)
        if device.observer is not None:
            device.observer.from_host(data)
        if faults.noise_out and rng.random() < faults.noise_out:
            place = rng.integers(count + 1)
            data = data[:place] + rng.bytes(1) + data[place:]
        super().write(data)
        return count

    def read(self) -> bytes:
        """The arm's bytes, with noise."""
        device, now = self._faulty, self._faulty.present()
        data = super().read()
        noise = device.rng.poisson(device.faults.noise * (now - self._last_read)) if device.faults.noise else 0
        self._last_read = now
        read = data + device.rng.bytes(noise) if noise else data
        if device.observer is not None and read:
            device.observer.to_host(data, read)
        return read


class FaultyDevice(VirtualDevice):
    """Opens faulty ports to a VirtualArm."""

    def __init__(
        self,
        arm: VirtualArm,
        clock: Clock,
        baud: float = 115_200,
        faults: PortFaults | None = None,
        seed: int = 0,
        observer: LineListener | None = None,
    ) -> None:
        super().__init__(arm, clock, baud)
        self.faults = PortFaults() if faults is None else faults
        self.away, self.rng, self.observer = self.faults.away, np.random.default_rng(seed), observer

    def __call__(self) -> VirtualPort:
        self._port = FaultyPort(self)
        return self._port

    def receive(self, data: bytes, arrival: float) -> None:
        super().receive(data, arrival)
        if self.observer is not None:
            self.observer.to_arm(data)
