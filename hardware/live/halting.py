"""Stops an arm whose motion process is gone: once the line is free, the frame that stops it goes out twice."""

from __future__ import annotations

from estimation.errors import InputError
from hardware.arm.port import Device, UnpluggedError
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import Pause, encode
from hardware.process.clock import WallClock

PATIENCE = 0.5  # s in which the kernel takes the line from a process that was killed
LOOK = 0.002  # s between tries
TWICE = 2  # the first one may complete a frame that was torn when the process died


def halt(url: str, profile: ArmProfile) -> tuple[float, str]:
    """Send the stop; when it was on the wire, s, and why it could not be sent, "" if it was."""
    clock, device = WallClock(), Device(url, profile.baud)
    until, reason = clock.now() + PATIENCE, ""
    try:
        while clock.now() < until:
            try:
                port = device()
            except (InputError, UnpluggedError) as error:
                reason = str(error)
                clock.wait_until(clock.now() + LOOK)
                continue
            for _ in range(TWICE):
                port.write(encode(Pause(), profile.dialect))
            sent = clock.now() + profile.frame_time
            clock.wait_until(sent + profile.frame_time)
            port.close()
            return sent, ""
    finally:
        device.release()
    return clock.now(), reason
