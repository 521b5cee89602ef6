"""Cameras that others wrote: Aravis's fake GigE Vision cameras, and GStreamer's RTSP server, each a process.

Several fake cameras need an address each, and packets are lost by the kernel's own rule and counted by it: both in a
network of the test's own, which only root may make.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from hardware.cameras import genicam
from hardware.cameras.capture import locked_exposure
from hardware.cameras.genicam import INSTALL, SYSTEM_PYTHON, GenicamCapture, aravis_python
from hardware.cameras.live import LiveCameras
from hardware.cameras.sources import GENICAM_PREFIX, CameraSource, Identity, SourceKind
from perception.frames import FrameSet
from tests.camera_streams import CLOCK

FAKE = "arv-fake-gv-camera-0.8"
GVCP_PORT = 3956
NEW_NETWORK = 0x40000000  # CLONE_NEWNET
RULE = """table netdev losses {{ chain out {{
 type filter hook egress device lo priority 0; policy accept;
 meta l4proto udp meta length > 1000 numgen inc mod {every} 0 counter drop
}}
}}
"""
RTSP_SERVER = Path(__file__).with_name("rtsp_server.py")
RTSP_PACKAGES = "python3-gi gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-good gstreamer1.0-plugins-ugly"


def need_fakes(several: bool = False) -> None:
    """Skip, and say why, where fake cameras cannot be had."""
    if shutil.which(FAKE) is None:
        pytest.skip("no fake GigE cameras; on Debian or Ubuntu: sudo apt-get install -y aravis-tools")
    if aravis_python() is None:
        pytest.skip(f"no Aravis; {INSTALL}")
    if several and (os.geteuid() != 0 or shutil.which("ip") is None):
        pytest.skip("several fake cameras need a network of their own: run as root, with iproute2 installed")


@contextmanager
def own_network(addresses: int) -> Iterator[None]:
    """Run in a network that holds but so many loopback addresses, 127.0.0.1 and on."""
    libc = ctypes.CDLL(None, use_errno=True)
    before = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    if libc.unshare(NEW_NETWORK):
        os.close(before)
        pytest.skip(f"no network of its own: {os.strerror(ctypes.get_errno())}")
    try:
        subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
        for i in range(1, addresses):
            subprocess.run(["ip", "addr", "add", f"127.0.0.{i + 1}/8", "dev", "lo"], check=True)
        yield
    finally:
        assert libc.setns(before, NEW_NETWORK) == 0
        os.close(before)


class PacketLoss:
    """Lets the kernel drop one in so many long packets, and reads how many it dropped."""

    def __init__(self, every: int) -> None:
        if shutil.which("nft") is None:
            pytest.skip("no packets are lost; on Debian or Ubuntu: sudo apt-get install -y nftables")
        done = subprocess.run(
            ["nft", "-f", "-"], input=RULE.format(every=every), text=True, capture_output=True, check=False
        )
        if done.returncode:
            pytest.skip(f"no packets are lost: {done.stderr.splitlines()[0]}")

    def dropped(self) -> int:
        """Packets dropped so far: by the rule, and by a socket that was full."""
        rules = subprocess.run(["nft", "list", "table", "netdev", "losses"], capture_output=True, text=True, check=True)
        found = re.search(r"counter packets (\d+)", rules.stdout)
        assert found is not None, rules.stdout
        names, values = (
            line.split()[1:]
            for line in Path("/proc/thread-self/net/snmp").read_text(encoding="ascii").splitlines()
            if line.startswith("Udp:")
        )
        return int(found[1]) + int(values[names.index("RcvbufErrors")])

    def end(self) -> None:
        """Drop nothing more; the count is gone."""
        subprocess.run(["nft", "delete", "table", "netdev", "losses"], check=True)


@dataclass
class FakeCamera:
    """One of Aravis's fake cameras. clock: how libfaketime sets its clock, "" for the machine's."""

    number: int
    clock: str = ""
    options: Sequence[str] = ()
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    @property
    def address(self) -> str:
        return f"127.0.0.{self.number + 1}"

    @property
    def name(self) -> str:
        return f"Aravis-Fake-C{self.number}"

    def source(self, **keys: object) -> CameraSource:
        return CameraSource(Identity(SourceKind.GENICAM, GENICAM_PREFIX + self.address), **keys)  # type: ignore[arg-type]

    def start(self) -> None:
        environment = dict(os.environ)
        if self.clock:
            found = sorted(Path("/usr/lib").glob("*/faketime/libfaketime.so.1"))
            if not found:
                pytest.skip("no clock that runs wrong; on Debian or Ubuntu: sudo apt-get install -y faketime")
            environment |= {"LD_PRELOAD": str(found[0]), "FAKETIME": self.clock, "DONT_FAKE_MONOTONIC": "1"}
        self.process = subprocess.Popen(
            [FAKE, "-i", self.address, "-s", f"C{self.number}", *self.options],
            env=environment,
            stdout=subprocess.DEVNULL,
        )
        end = CLOCK.now() + 10
        while not self._listens():
            assert CLOCK.now() < end and self.process.poll() is None, "the fake camera did not start"
            CLOCK.wait_until(CLOCK.now() + 0.02)

    def kill(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def _listens(self) -> bool:
        own = bytes(reversed([127, 0, 0, self.number + 1])).hex().upper()
        return f"{own}:{GVCP_PORT:04X}" in Path("/proc/thread-self/net/udp").read_text(encoding="ascii")


@contextmanager
def running(*cameras: FakeCamera) -> Iterator[None]:
    """Have fake cameras run."""
    try:
        for camera in cameras:
            camera.start()
        yield
    finally:
        for camera in cameras:
            if camera.process is not None and camera.process.poll() is None:
                camera.kill()


STAMPS: dict[float, int] = {}


class WatchedCapture(GenicamCapture):
    """The same, and what became of each device's stamp: by the frame's own, s, that of the device, ns, in STAMPS."""

    def position(self) -> float:
        own = super().position()
        STAMPS[own - locked_exposure(self.lock()) / 2] = self._frame["stamp"]
        return own


def watch_stamps(monkeypatch: pytest.MonkeyPatch) -> dict[float, int]:
    """Keep the device's stamp, ns, of each frame, by the stamp, s, that it is given."""
    STAMPS.clear()
    monkeypatch.setattr(genicam, "GenicamCapture", WatchedCapture)
    return STAMPS


def instant_of(stamp: int) -> float:
    """Our instant, s, of a stamp by the machine's time of day, ns."""
    tries = [(CLOCK.now(), time.time_ns(), CLOCK.now()) for _ in range(5)]
    before, today, after = min(tries, key=lambda one: one[2] - one[0])
    return (before + after) / 2 - (today - stamp) / 1e9


def sets_until(live: LiveCameras, end: float) -> list[FrameSet]:
    """All sets until an instant, s."""
    sets = []
    while (one := live.next_set(end)) is not None:
        sets.append(one)
    return sets


def is_wrong(stamps: Sequence[int], period: float) -> bool:
    """Whether the frames of a set, by their cameras' own stamps, ns, are of several triggers and not of one instant.

    Triggers are at the multiples of a period, s; a fake camera that did not get to run exposes late.
    """
    apart = bool(stamps) and (max(stamps) - min(stamps)) / 1e9 > period / 2
    return apart and len({instant_of(stamp) // period for stamp in stamps}) > 1


@contextmanager
def rtsp_server(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """GStreamer's RTSP server with one camera, rtsp://127.0.0.1:PORT/camera; skips where there is none."""
    process = subprocess.Popen([SYSTEM_PYTHON, RTSP_SERVER, str(port)], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        assert process.stdout is not None and process.stderr is not None
        if process.stdout.readline() != b"ready\n":
            why = process.stderr.read().decode().strip().splitlines() or ["no reason"]
            pytest.skip(f"no RTSP server ({why[-1]}); on Debian or Ubuntu: sudo apt-get install -y {RTSP_PACKAGES}")
        yield process
    finally:
        process.kill()
        process.wait()
        for pipe in (process.stdout, process.stderr):
            if pipe is not None:
                pipe.close()
