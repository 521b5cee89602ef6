"""The virtual arm behind a pseudo-terminal, in real time: any client that speaks its protocol can use it."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

import numpy as np

from estimation.errors import InputError
from hardware.arm.profile import BITS_PER_BYTE, ArmProfile
from hardware.process.checks import why
from hardware.process.clock import Clock, WallClock
from hardware.process.faults import Fault
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.settings import ArmSettings
from hardware.simulator.pty_link import open_pty

HEADER = "stamp_s,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg"
PERIOD = 0.002  # s between looks at the line; a frame takes 4 ms
LOG_STEP = 0.001  # s
_ROWS = 10_000  # of the log at once


def _print(words: str) -> None:
    print(words, flush=True)


def run_virtual_arm(
    settings: ArmSettings,
    profile: ArmProfile | None = None,
    faults: Sequence[Fault] = (),
    link: Path | None = None,
    log: Path | None = None,
    clock: Clock | None = None,
    stop: threading.Event | None = None,
    say: Callable[[str], None] = _print,
) -> VirtualArm:
    """Serve a virtual arm on a new pty until `stop` is set, Ctrl-C or SIGTERM; say its device name, then a summary.

    profile: dialect, home and baud rate; bytes are taken no faster than that, whatever rate a client asks the pty for.
    link: a symbolic link to the device, which is removed at the end. log: a new CSV of the executed axes, each ms.
    InputError where `link` or `log` would overwrite something. Returns the arm as it was at the end.
    """
    profile = ArmProfile() if profile is None else profile
    clock, stop = clock or WallClock(), stop or threading.Event()
    arm = VirtualArm(settings, profile.dialect, profile.arm.home, faults, profile.baud)
    with _logged(log, arm):
        ours, theirs, device = open_pty()
        try:
            os.set_blocking(ours, False)
            with _linked(link, device), _ended_by_signals(stop):
                say(device)
                _serve(ours, arm, profile.baud / BITS_PER_BYTE, clock, stop)
        finally:
            os.close(theirs)
            os.close(ours)
    say(summary(arm))
    return arm


@contextmanager
def _logged(log: Path | None, arm: VirtualArm) -> Iterator[None]:
    """Write what the arm executed meanwhile into a new file; it is opened before anything moves."""
    if log is None:
        yield
        return
    try:
        file = log.open("x", encoding="utf-8")
    except OSError as error:
        raise InputError(log, "log", why(error), "a new file in a folder that can be written to") from error
    with file:
        try:
            yield
        finally:
            _write_motion(file, arm)


def _write_motion(file: TextIO, arm: VirtualArm) -> None:
    """Write the executed axes, a line each millisecond, as CSV."""
    units = np.array([1, 1, 1, *np.rad2deg([1.0, 1, 1])])
    size = int(arm.now / LOG_STEP + 1e-6) + 1  # a whole number of steps may come out just below it
    file.write(HEADER + "\n")
    for start in range(0, size, _ROWS):
        stamps = np.minimum(np.arange(start, min(start + _ROWS, size)) * LOG_STEP, arm.now)
        rows = np.column_stack([stamps, arm.axes_at(stamps) * units])
        np.savetxt(file, rows, ["%.3f"] + ["%.6f"] * 6, delimiter=",")


def summary(arm: VirtualArm) -> str:
    """What came over the line and what became of it, in a few lines."""
    stray = sum(len(data) for _, data in arm.garbage)
    lines = [
        f"{arm.frames} frames in {arm.now:.1f} s",
        f"{len(arm.ignored)} ignored, the queue was full",
        f"{len(arm.refused)} refused, out of reach",
        f"{len(arm.struck)} lost or garbled by a fault",
        f"{len(arm.underruns)} underruns" + (f", the first at {arm.underruns[0]:.3f} s" if arm.underruns else ""),
        f"{stray} bytes in no frame" + (f", the first {_shown(*arm.garbage[0])}" if stray else ""),
    ]
    return "\n".join(lines)


def _shown(now: float, data: bytes) -> str:
    return f"at {now:.3f} s: {data[:12].hex(' ')}" + (" ..." if len(data) > 12 else "")


def _serve(port: int, arm: VirtualArm, rate: float, clock: Clock, stop: threading.Event) -> None:
    """Carry bytes both ways, in at most `rate` a second; what no client reads is lost, as on a line."""
    start, allowed = clock.now(), 0.0
    while not stop.is_set():
        clock.wait_until(start + arm.now + PERIOD)
        now = clock.now() - start
        allowed = min(allowed, 1.0) + rate * (now - arm.now)
        data = b""
        with suppress(BlockingIOError):
            data = os.read(port, int(allowed))
        allowed -= len(data)
        for part, instant in _spread(data, arm.now, now):
            arm.receive(part, instant)
        with suppress(BlockingIOError):
            os.write(port, arm.transmit(now))


def _spread(data: bytes, before: float, now: float) -> Iterator[tuple[bytes, float]]:
    """Bytes with the instants, s, at which they came: evenly since the last look, where the machine held this one up.

    A controller has a core of its own; one that took them all at once now would be late with all that follows.
    """
    looks, size = max(round((now - before) / PERIOD), 1), len(data)
    for look in range(looks):
        instant = before + (now - before) * (look + 1) / looks
        yield data[size * look // looks : size * (look + 1) // looks], instant


@contextmanager
def _linked(link: Path | None, device: str) -> Iterator[None]:
    """Have `link` point at the device meanwhile; a link left behind by a run that is gone makes way."""
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
def _ended_by_signals(stop: threading.Event) -> Iterator[None]:
    """Set `stop` on Ctrl-C and SIGTERM; only the main thread may ask for signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
