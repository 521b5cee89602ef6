"""Whether cameras and the arm's line can be seen and opened by this user, and whether what is shipped is whole."""

from __future__ import annotations

import os
from pathlib import Path

from estimation.errors import StillbedError
from hardware.arm.port import serial_ports
from hardware.cameras.capture import reads_videos
from hardware.cameras.identity import Device, list_devices
from hardware.operator.view import Check, Verdict
from hardware.port_lock import lock_folder
from perception.wound.network import WoundNetwork, shipped

JOIN = "sudo usermod -aG {group} $USER, then log in anew"


def device_checks() -> list[Check]:
    """Cameras, arm, lock, videos, network."""
    return [
        camera_check(list_devices()),
        arm_check(serial_ports()),
        lock_check(lock_folder()),
        video_check(),
        network_check(),
    ]


def camera_check(devices: tuple[Device, ...]) -> Check:
    """What is plugged in, and whether this user may open it."""
    if not devices:
        return Check("cameras", Verdict.WARN, "none is plugged in", "plug them in; `stillbed cameras` says more")
    names = ", ".join(device.name or str(device.node) for device in devices)
    return _opened("cameras", [(str(device.node), names) for device in devices], names, "video")


def arm_check(ports: list[tuple[str, str]]) -> Check:
    """Serial ports, as (device, what calls itself so), and whether this user may open them."""
    if not ports:
        remedy = "plug in the arm's adapter; without one, `stillbed arm --virtual` answers as an arm does"
        return Check("arm", Verdict.WARN, "no serial port", remedy)
    return _opened("arm", ports, ", ".join(f"{device} ({name})" for device, name in ports), "dialout")


def lock_check(folder: Path) -> Check:
    """Where a port's lock is kept, so that two programs never write to one arm."""
    if os.access(folder, os.W_OK):
        return Check("port locks", Verdict.PASS, f"kept in {folder}")
    return Check("port locks", Verdict.FAIL, f"{folder} cannot be written to", f"let this user write to {folder}")


def video_check() -> Check:
    """Whether recorded videos can be read."""
    if reads_videos():
        return Check("videos", Verdict.PASS, "read by FFmpeg")
    return Check(
        "videos", Verdict.WARN, "this OpenCV has no FFmpeg", "pip install --force-reinstall opencv-python-headless"
    )


def network_check() -> Check:
    """Whether the network that finds the wound is there, whole and runs."""
    try:
        network = WoundNetwork(shipped())
    except StillbedError as error:
        return Check("wound network", Verdict.FAIL, str(error), "install stillbed anew, with its data")
    return Check("wound network", Verdict.PASS, f"{network.size / 1e6:.1f} MB, its hash is right")


def _opened(name: str, nodes: list[tuple[str, str]], told: str, group: str) -> Check:
    closed = [node for node, _ in nodes if not os.access(node, os.R_OK | os.W_OK)]
    if closed:
        return Check(
            name, Verdict.FAIL, f"{', '.join(closed)} may not be opened by this user", JOIN.format(group=group)
        )
    return Check(name, Verdict.PASS, told)
