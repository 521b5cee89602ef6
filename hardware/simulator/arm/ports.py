"""Two ways to a virtual arm: a port in virtual time, and a pseudo-terminal in real time."""

from __future__ import annotations

import os
import pty
import signal
import threading
import tty
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TextIO

import numpy as np

from estimation.errors import InputError
from hardware.arm.driver import UnpluggedError
from hardware.arm.profile import BITS_PER_BYTE, ArmProfile
from hardware.process.checks import error_text
from hardware.process.clock import Clock, WallClock
from hardware.process.faults import Fault
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.settings import ArmSettings, SerialWire

Interval = tuple[float, float]  # from, until, s


ByteListener = Callable[[bytes, bool], None]  # of bytes at the port: accepted from the host, else read by it


class VirtualPort:
    """One opening of the device before a VirtualArm."""

    def __init__(self, device: VirtualDevice) -> None:
        self._device = device
        self._wire = SerialWire(device.baud)
        self._in_transit: deque[tuple[float, bytes]] = deque()
        device.present()

    def write(self, data: bytes) -> int:
        """Accept all bytes; their count."""
        now = self._device.present()
        self._device.listener(data, True)
        if data:
            self._in_transit.append((float(self._wire.send(data, now)[-1]), data))
        return len(data)

    def read(self) -> bytes:
        """The arm's bytes."""
        now = self._device.present()
        self.deliver(now)
        data = self._device.arm.transmit(now)
        if data:
            self._device.listener(data, False)
        return data

    def waiting(self) -> int:
        """Count of bytes still on the wire."""
        count = (self._wire.busy_until - self._device.clock.now()) * self._device.baud / BITS_PER_BYTE
        return int(count) if count > 0 else 0

    def close(self) -> None:
        """Close it; bytes still on the wire are lost."""
        self.deliver(self._device.clock.now())
        self._in_transit.clear()

    def deliver(self, now: float) -> None:
        """Hand the arm the bytes that have passed the wire by `now`, s."""
        while self._in_transit and self._in_transit[0][0] <= now:
            arrival, data = self._in_transit.popleft()
            self._device.receive(data, arrival)


class VirtualDevice:
    """Opens ports to a VirtualArm; an Opener. away: from, until, s: when the device is gone."""

    def __init__(
        self, arm: VirtualArm, clock: Clock, baud: float = 115_200, listener: ByteListener = lambda data, sent: None
    ) -> None:
        self.arm, self.clock, self.baud, self.listener = arm, clock, baud, listener
        self.away: Sequence[Interval] = ()
        self._port: VirtualPort | None = None  # the last one opened

    def __call__(self) -> VirtualPort:
        """Open it; UnpluggedError while it is away."""
        self._port = VirtualPort(self)
        return self._port

    def advance(self, now: float) -> None:
        """Advance wire and arm to `now`, s."""
        if self._port is not None:
            self._port.deliver(now)
        self.arm.advance(max(now, self.arm.now))

    def present(self) -> float:
        """The instant, s; UnpluggedError while the device is away."""
        now = self.clock.now()
        if any(start <= now < end for start, end in self.away):
            raise UnpluggedError("the device is gone")
        return now

    def receive(self, data: bytes, arrival: float) -> None:
        """Bytes reach the arm at `arrival`, s."""
        self.arm.receive(data, max(arrival, self.arm.now))


def open_pty() -> tuple[int, int, str]:
    """A raw pty: descriptors of the arm's side and of the host's, and the host's device name.

    As long as the host's descriptor stays open here, clients may come and go.
    """
    arm_side, host_side = pty.openpty()
    tty.setraw(host_side)
    return arm_side, host_side, os.ttyname(host_side)


_print_line = partial(print, flush=True)
POLL_PERIOD = 0.002  # s between looks at the line; a frame takes 4 ms
LOG_STEP = 0.001  # s
_ROWS_AT_ONCE = 10_000  # of the log at once


def run_virtual_arm(
    settings: ArmSettings,
    profile: ArmProfile | None = None,
    faults: Sequence[Fault] = (),
    link: Path | None = None,
    log: Path | None = None,
    clock: Clock | None = None,
    stop: threading.Event | None = None,
    say: Callable[[str], None] = _print_line,
) -> VirtualArm:
    """Serve a virtual arm on a new pty until `stop` is set, Ctrl-C or SIGTERM; say its device name, then a summary.

    profile: dialect, home and baud rate; bytes are taken no faster than that, whatever rate a client asks the pty for.
    link: a symbolic link to the device, which is removed at the end. log: a new CSV of the executed axes, each ms,
    stamped by the machine's monotonic clock. InputError where `link` or `log` would overwrite something. Returns the
    arm as it was at the end.
    """
    profile = ArmProfile() if profile is None else profile
    clock, stop = clock or WallClock(), stop or threading.Event()
    arm, start = VirtualArm(settings, profile.dialect, profile.arm.home, faults, profile.baud), clock.now()
    with open_log(log, "stamp_s,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg\n") as file:
        try:
            with served_pty(link, stop, say) as port:
                _serve(port, arm, start, profile.baud / BITS_PER_BYTE, clock, stop)
        finally:
            if file is not None:
                _log_motion(file, arm, start)
    say(run_summary(arm))
    return arm


@contextmanager
def served_pty(link: Path | None, stop: threading.Event, say: Callable[[str], None]) -> Iterator[int]:
    """A new pty until the block ends, its device printed and linked: the device's side, which does not block.

    Ctrl-C and SIGTERM set `stop`. InputError where `link` would overwrite something.
    """
    arm_side, host_side, device = open_pty()
    try:
        os.set_blocking(arm_side, False)
        with device_link(link, device), stop_on_signals(stop):
            say(device)
            yield arm_side
    finally:
        os.close(host_side)
        os.close(arm_side)


@contextmanager
def open_log(log: Path | None, header: str) -> Iterator[TextIO | None]:
    """A new log with its header, None where none is asked for; InputError where it would overwrite something."""
    if log is None:
        yield None
        return
    try:
        file = log.open("x", encoding="utf-8")
    except OSError as error:
        raise InputError(log, "log", error_text(error), "a new file in a folder that can be written to") from error
    with file:
        file.write(header)
        yield file


def _log_motion(file: TextIO, arm: VirtualArm, origin: float) -> None:
    size = int(arm.now / LOG_STEP + 1e-6) + 1  # a whole number of steps may come out just below it
    for start in range(0, size, _ROWS_AT_ONCE):
        stamps = np.minimum(np.arange(start, min(start + _ROWS_AT_ONCE, size)) * LOG_STEP, arm.now)
        axes = arm.axes_at(stamps) * [1, 1, 1, *np.rad2deg([1.0, 1, 1])]
        np.savetxt(file, np.column_stack([stamps + origin, axes]), "%.6f", delimiter=",")


def run_summary(arm: VirtualArm) -> str:
    """Counts of frames and faults of the line, in a few lines."""
    underruns = f", the first at {arm.underruns[0]:.3f} s" if arm.underruns else ""
    stray = ""
    if arm.garbage:
        now, data = arm.garbage[0]
        stray = f", the first at {now:.3f} s: {data[:12].hex(' ')}" + (" ..." if len(data) > 12 else "")
    return (
        f"{arm.frames} frames in {arm.now:.1f} s\n"
        f"{len(arm.ignored)} ignored, the queue was full\n"
        f"{len(arm.refused)} refused, out of reach\n"
        f"{len(arm.faulty_frames)} lost or garbled by a fault\n"
        f"{len(arm.underruns)} underruns{underruns}\n"
        f"{sum(len(data) for _, data in arm.garbage)} bytes in no frame{stray}"
    )


def _serve(port: int, arm: VirtualArm, start: float, rate: float, clock: Clock, stop: threading.Event) -> None:
    """Transfer bytes both ways, in at most `rate` a second; bytes that no client reads are lost, as on a line.

    start: s, when the arm's own time begins.
    """
    budget = 0.0
    while not stop.is_set():
        clock.wait_until(start + arm.now + POLL_PERIOD)
        now = clock.now() - start
        budget = min(budget, 1.0) + rate * (now - arm.now)
        data = b""
        with suppress(BlockingIOError):
            data = os.read(port, int(budget))
        budget -= len(data)
        for part, instant in _arrivals(data, arm.now, now):
            arm.receive(part, instant)
        with suppress(BlockingIOError):
            os.write(port, arm.transmit(now))


def _arrivals(data: bytes, last: float, now: float) -> Iterator[tuple[bytes, float]]:
    """Bytes with their instants of arrival, s: spread evenly since the last poll, for polls that the machine delayed.

    A controller has a core of its own; handling all bytes only now would delay all that follows.
    """
    parts, size = max(round((now - last) / POLL_PERIOD), 1), len(data)
    for i in range(parts):
        instant = last + (now - last) * (i + 1) / parts
        yield data[size * i // parts : size * (i + 1) // parts], instant


@contextmanager
def device_link(link: Path | None, device: str) -> Iterator[None]:
    """A link to the device until the block ends; it replaces a stale link of an earlier run."""
    if link is None:
        yield
        return
    if link.is_symlink() and (not link.exists() or os.readlink(link) == device):
        link.unlink()
    if link.is_symlink() or link.exists():
        raise InputError(link, "link", "exists", "a new name, or a link left behind that leads nowhere")
    link.symlink_to(device)
    try:
        yield
    finally:
        if link.is_symlink() and os.readlink(link) == device:
            link.unlink()


@contextmanager
def stop_on_signals(stop: threading.Event) -> Iterator[None]:
    """Ctrl-C and SIGTERM set `stop` until the block ends, in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, handlers, strict=True):
            signal.signal(number, handler)
