"""Industrial cameras (GigE Vision, USB3 Vision): each grabbed by a process with the system's Python and its Aravis.

The process puts pictures together in memory that both see (`aravis_process.py`, which also says what is written back
and forth). Here they are read, stamped by the camera's clock as mapped to ours, and given back to be filled again.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import select
import subprocess
import sys
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from estimation.errors import InputError
from hardware.cameras.capture import READ_TIMEOUT, CameraError, Control, Transport, image_from_pixels
from hardware.cameras.sources import GENICAM_PREFIX, PIXEL_FORMATS, SOFTWARE_TRIGGER, CameraSource
from hardware.cameras.stamping import DeviceClock
from hardware.process.clock import Clock
from perception.frames import Image

SYSTEM_PYTHON = "/usr/bin/python3"  # which Debian installs bindings for
PACKAGES = "gir1.2-aravis-0.8 python3-gi"  # Debian's and Ubuntu's
INSTALL = f"on Debian or Ubuntu: sudo apt-get install -y {PACKAGES}"
PROBE = 'import gi; gi.require_version("Aravis", "0.8"); from gi.repository import Aravis'
PROGRAM = Path(__file__).with_name("aravis_process.py")
BUFFERS = 8  # pictures in shared memory: a quarter of a second at 30 Hz, as a busy tracker may be late
LIST_TIMEOUT = 20.0  # s; a network is searched for one
OPEN_TIMEOUT = 15.0  # s: a camera that is found by name takes one, one that does not answer five
END_TIMEOUT = 1.0  # s for the process to stop the camera, after which it is ended
GRAB_PERIOD = 0.1  # s
GOOD_PTP = ("Slave", "Master")  # states in which the clocks of a network agree


@dataclass(frozen=True, slots=True)
class IndustrialCamera:
    """A camera that answers now."""

    name: str  # by Aravis
    address: str  # IP address, "" on a bus
    maker: str
    model: str
    serial: str

    @property
    def identity(self) -> str:
        """What to write in rig.toml."""
        return GENICAM_PREFIX + self.name


@cache
def aravis_python() -> str | None:
    """The Python that has Aravis's binding, or None: this one, else the system's."""
    for python in (sys.executable, SYSTEM_PYTHON):
        with suppress(OSError, subprocess.TimeoutExpired):
            probe = subprocess.run([python, "-c", PROBE], capture_output=True, timeout=LIST_TIMEOUT, check=False)
            if probe.returncode == 0:
                return python
    return None


def list_industrial() -> tuple[IndustrialCamera, ...] | None:
    """The cameras that answer, in Aravis's order; None where Aravis is not installed. It takes a second."""
    python = aravis_python()
    if python is None:
        return None
    try:
        run = subprocess.run([python, "-I", PROGRAM, "--list"], capture_output=True, timeout=LIST_TIMEOUT, check=True)
        devices = json.loads(run.stdout)["devices"]
    except (OSError, subprocess.SubprocessError, ValueError, KeyError):
        return ()
    keys = ("id", "address", "vendor", "model", "serial_nbr")
    return tuple(IndustrialCamera(*(one[key] for key in keys)) for one in devices)


def exposure_end(clock: DeviceClock, stamp: int, exposure: float, arrival: float) -> float:
    """Our instant, s, of the end of an exposure of so many s; nan before the camera's clock is known.

    stamp: the camera's, ns. arrival: s, of the first packet. By arrivals, a stamp is mapped to the earliest arrival,
    which follows the exposure. By readings of the camera's clock it is mapped to itself: the exposure's begin (SFNC).
    """
    instant = clock(stamp)
    return instant if math.isnan(clock.doubt) else min(instant + exposure, arrival)


def controls_of(source: CameraSource, own: dict[str, Any], automatic: Collection[str]) -> tuple[Control, ...]:
    """What was requested of a camera, and what it has by `own`, by the keys of rig.toml. automatic: names of some."""
    requests = {"format": source.format, "fps": source.fps, "exposure_s": source.exposure, "gain": source.gain}
    requests |= {} if source.trigger is None else {"trigger": source.trigger}
    controls = [Control(name, wish, own[name], name in automatic) for name, wish in requests.items()]
    if source.ptp:
        controls.append(Control("ptp", "on", "on" if own["ptp"] in GOOD_PTP else own["ptp"]))
    others = {"focus_abs": source.focus, "white_balance_k": source.white_balance}
    return (*controls, *(Control(name, wish, None) for name, wish in others.items() if wish is not None))


def open_genicam(source: CameraSource, size: tuple[int, int] | None, clock: Clock) -> GenicamCapture:
    """Open a camera and let pictures flow; CameraError says why that is not possible."""
    python = aravis_python()
    if python is None:
        raise CameraError(f"Aravis is not installed; {INSTALL}")
    return GenicamCapture(python, source, size, clock)


class GenicamCapture:
    """A camera, and the process that grabs it."""

    ends, clocked, exact = False, True, True

    def __init__(self, python: str, source: CameraSource, size: tuple[int, int] | None, clock: Clock) -> None:
        """CameraError where it cannot be opened. size: (W, H) px; None: as the camera is set."""
        self._source, self._now, self._frame = source, clock.now, dict[str, Any]()
        self._clock = DeviceClock()
        self.transport: Transport | None = None
        memory = os.memfd_create("stillbed camera")
        try:
            command, pipe = [python, "-I", str(PROGRAM)], subprocess.PIPE
            self._process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, pass_fds=(memory,)
            )
            self._unread = b""
            try:
                self._ready = self._open(memory, size)
                self._memory = mmap.mmap(memory, BUFFERS * self._ready["stride"])
            except BaseException:
                self._end()
                raise
        finally:
            os.close(memory)
        self._last_message = self._last_frame = clock.now()  # s, when the process said anything, and when a frame came

    def _open(self, memory: int, size: tuple[int, int] | None) -> dict[str, Any]:
        source = self._source
        order = {
            "id": source.identity.text.removeprefix(GENICAM_PREFIX),
            "size": size,
            "format": source.format,
            "formats": PIXEL_FORMATS,
            "fps": source.fps,
            "exposure_s": source.exposure,
            "gain": source.gain,
            "trigger": source.trigger,
            "ptp": source.ptp,
            "memory": memory,
            "buffers": BUFFERS,
        }
        self._write(json.dumps(order))
        line = self._line(OPEN_TIMEOUT)
        if line is None:
            raise CameraError(f"it did not answer within {OPEN_TIMEOUT:g} s")
        ready: dict[str, Any] = line["ready"]
        return ready

    @property
    def incomplete(self) -> bool:
        """Whether packets of the grabbed frame are missing."""
        return bool(self._frame) and self._frame["status"] != "success"

    def grab(self) -> bool | None:
        """Wait for the next frame, whole or not; None where none came yet, False if the camera is gone.

        It is gone where none came for READ_TIMEOUT; a camera that waits for its line must give signs of life only.
        """
        self._give_back()
        line = self._line(GRAB_PERIOD)
        now = self._now()
        if line is not None:
            self._last_message = now
            if "latch" in line:
                sent, received, device = line["latch"]
                self._clock.latched(device, sent, received)
            if "frame" in line:
                self._last_frame = now
                self._take(line["frame"])
                return True
        hardware_triggered = self._source.trigger not in (None, SOFTWARE_TRIGGER)
        return False if now - (self._last_message if hardware_triggered else self._last_frame) > READ_TIMEOUT else None

    def _take(self, frame: dict[str, Any]) -> None:
        self._frame = frame
        if frame["stamp"]:
            self._clock.arrived(frame["stamp"], frame["arrival"])
        counts: dict[str, int] = frame["counts"]
        self.transport = Transport(**counts, drift=self._clock.drift, doubt=self._clock.doubt)

    def position(self) -> float:
        """The end of the exposure on our clock, s, as far as it is known; nan where the frame's begin was lost."""
        if not self._frame.get("stamp"):
            return math.nan
        exposure = float(self._ready["controls"]["exposure_s"] or 0.0)
        return exposure_end(self._clock, self._frame["stamp"], exposure, self._frame["arrival"])

    def retrieve(self) -> Image | None:
        """The grabbed frame (H, W) or (H, W, 3) BGR; None where packets are missing."""
        number = self._frame.get("buffer")
        if number is None:
            return None
        start = number * self._ready["stride"]
        width, height = self._frame["size"]
        with memoryview(self._memory)[start : start + self._ready["stride"]] as data:
            return image_from_pixels(data, (width, height), self._ready["controls"]["format"], self._frame["padding"])

    def lock(self) -> tuple[Control, ...]:
        """The controls as the camera has them."""
        return controls_of(self._source, self._ready["controls"], self._ready["automatic"])

    def release(self) -> None:
        """Stop the camera and let others have it."""
        self._end()
        with suppress(BufferError):  # a picture that is being read
            self._memory.close()

    def _give_back(self) -> None:
        number = self._frame.get("buffer")
        self._frame = {}
        if number is not None:
            self._write(str(number))

    def _write(self, text: str) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(text.encode() + b"\n")
            self._process.stdin.flush()
        except OSError:
            raise CameraError("the process that grabs it has ended") from None

    def _line(self, timeout: float) -> dict[str, Any] | None:
        """The next line of the process; None where none came in so many s. CameraError where it says why it ended."""
        assert self._process.stdout is not None
        source = self._process.stdout.fileno()
        while b"\n" not in self._unread:
            if not select.select([source], [], [], timeout)[0]:
                return None
            data = os.read(source, 1 << 16)
            if not data:
                raise CameraError("the process that grabs it has ended")
            self._unread += data
        text, _, self._unread = self._unread.partition(b"\n")
        line: dict[str, Any] = json.loads(text)
        if "error" in line:
            raise CameraError(line["error"])
        return line

    def _end(self) -> None:
        """End the process: by the end of its input, else by force."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()
        try:
            self._process.wait(END_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def require_aravis(name: str, source: CameraSource) -> None:
    """InputError where there is no Aravis for a camera, by its name in the rig."""
    if aravis_python() is None:
        key, allowed = f"camera {name!r}: source", f"once Aravis is there; {INSTALL}"
        raise InputError("live cameras", key, source.identity.shown, allowed)
