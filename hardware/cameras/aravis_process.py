"""One GenICam camera (GigE Vision, USB3 Vision) grabbed by Aravis: a program of its own, run by the system's Python.

Aravis's binding belongs to the system's Python, so nothing of stillbed and no numpy is imported here. Aravis puts the
packets of a picture together in memory that the other process sees as well, so no picture is copied on its way.

In: a line of JSON that says what is wanted; then a line for each buffer that may be filled again, until the end of the
input. Out: lines of JSON. {"ready": ...} once pictures flow, or {"error": text}; {"frame": ...} for each picture, whole
or not; {"latch": [sent s, received s, device ns]} where the camera's own clock can be read; {"alive": s} in between.
Instants are by the machine's monotonic clock, s; a device's stamps are by its own, ns.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import mmap
import os
import signal
import sys
import threading
import time
from typing import Any

import gi

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis, GLib  # noqa: E402  (the version must be named before)

SOCKET_PICTURES = 4  # that a socket is to hold: the kernel counts twice what a packet carries
MAX_SOCKET_BUFFER = 2**30  # bytes; the kernel takes less where net.core.rmem_max is less
PAGE_BYTES = mmap.PAGESIZE  # each buffer begins on a page
POP_TIMEOUT_US = 100_000  # us between looks whether anybody still listens
ALIVE_PERIOD = 0.5  # s between signs of life of a camera that sends nothing, as one that waits for its trigger
CLOCK_TRIES, CLOCK_APART = 5, 2e-5  # s between two readings, from which another process ran in between
MAX_TRIGGER_DELAY = 5e-3  # s: as long as a usual exposure
LATCH_PERIOD = 1.0  # s between looks at the device's clock
SOFTWARE = "Software"  # a trigger source's name in the standard (SFNC)
LATCHES = (("TimestampLatch", "TimestampLatchValue"), ("GevTimestampControlLatch", "GevTimestampValue"))
TICK_RATE = "GevTimestampTickFrequency"  # Hz, of the second kind
PTP_SWITCHES = ("PtpEnable", "GevIEEE1588")
PTP_STATES = ("PtpStatus", "GevIEEE1588Status")
UDP_OVERHEAD = 36  # bytes of IP, UDP and GVSP in each packet of the size that is set
ENVELOPE_PACKETS = 2  # leader and trailer of each frame
MAX_SHORT_ID = 65535  # after which a GigE Vision 1 frame number begins again at 1
REORDERED = 8  # frames after which one that is missing will not come any more
MAX_GAP = 10_000  # frames: a larger step is no loss, the camera has begun to count anew
_writing = threading.Lock()


def say(**line: Any) -> None:
    """Write one line; the reader's end is ours."""
    with _writing:
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def devices() -> list[dict[str, str]]:
    """All cameras that answer; the call takes a second on a network."""
    Aravis.update_device_list()
    keys = ("id", "address", "vendor", "model", "serial_nbr", "protocol")
    return [{key: getattr(Aravis, "get_device_" + key)(i) or "" for key in keys} for i in range(Aravis.get_n_devices())]


def opened(name: str) -> Any:
    """The camera of an Aravis identity, serial number, MAC or IP address; ValueError where there is none."""
    try:
        return Aravis.Camera.new(name)
    except GLib.Error as error:
        there = ", ".join(one["id"] for one in devices()) or "none"
        raise ValueError(f"no camera {name!r} ({reason(error)}); found: {there}") from None


def reason(error: Any) -> str:
    """A GLib error in words, without its domain."""
    return str(error.message).strip().splitlines()[0]


def feature(device: Any, names: tuple[str, ...]) -> str:
    """The first of the names that a device has; "" for none."""
    return next((name for name in names if device.is_feature_available(name)), "")


def set_up(camera: Any, order: dict[str, Any]) -> dict[str, Any]:
    """Set what is wanted, in an order in which nothing undoes another, and read all back. ValueError says what failed.

    order: `size` [W, H] px, `format`, `fps` Hz, `exposure_s`, `gain`, `trigger`, `ptp`; None: left as it is.
    """
    device = camera.get_device()
    choose_format(camera, order)
    if order["size"] is not None:
        attempt("size", camera.set_region, -1, -1, *order["size"])
    got(camera.clear_triggers)  # a camera without any refuses
    if order["exposure_s"] is not None:
        if camera.is_exposure_auto_available():
            attempt("exposure_s", camera.set_exposure_time_auto, Aravis.Auto.OFF)
        attempt("exposure_s", camera.set_exposure_time, 1e6 * order["exposure_s"])
    if order["gain"] is not None:
        if camera.is_gain_auto_available():
            attempt("gain", camera.set_gain_auto, Aravis.Auto.OFF)
        attempt("gain", camera.set_gain, order["gain"])
    if order["trigger"] is not None:
        if bounds := got(camera.get_frame_rate_bounds):  # or the camera's own beat holds triggers back
            got(camera.set_frame_rate, bounds[-1])
        attempt("trigger", camera.set_trigger, order["trigger"])
    elif order["fps"] is not None:
        attempt("fps", camera.set_frame_rate, order["fps"])
    switch = feature(device, PTP_SWITCHES)
    if order["ptp"] and switch:
        attempt("ptp", device.set_boolean_feature_value, switch, True)
    attempt("acquisition", camera.set_acquisition_mode, Aravis.AcquisitionMode.CONTINUOUS)
    return read_back(camera, order)


def choose_format(camera: Any, order: dict[str, Any]) -> None:
    """Set the pixel format that is wanted; ValueError where the camera has none that can be read."""
    offered = camera.dup_available_pixel_formats_as_strings()
    usable = [name for name in order["formats"] if name in offered]
    pixel_format = order["format"] or camera.get_pixel_format_as_string()
    if pixel_format not in usable:
        raise ValueError(f"format {pixel_format!r}: this camera has {', '.join(usable) or 'none that can be read'}")
    attempt("format", camera.set_pixel_format_from_string, pixel_format)


def attempt(key: str, call: Any, *values: Any) -> None:
    """Call; a refusal is a ValueError that names the key of rig.toml."""
    try:
        call(*values)
    except GLib.Error as error:
        raise ValueError(f"{key} {' '.join(map(str, values))}: {reason(error)}") from None


def read_back(camera: Any, order: dict[str, Any]) -> dict[str, Any]:
    """What the camera has now, by the keys of rig.toml; None where it has no such control."""
    device, triggered = camera.get_device(), order["trigger"] is not None
    exposure = got(camera.get_exposure_time)
    state = feature(device, PTP_STATES)
    own = {
        "format": got(camera.get_pixel_format_as_string),
        "fps": order["fps"] if triggered else got(camera.get_frame_rate),
        "exposure_s": None if exposure is None else exposure / 1e6,
        "gain": got(camera.get_gain),
        "trigger": got(camera.get_trigger_source) if triggered else None,
        "ptp": got(device.get_string_feature_value, state) if state else None,
    }
    automatic = [
        name
        for name, there, mode in (
            ("exposure_s", camera.is_exposure_auto_available, camera.get_exposure_time_auto),
            ("gain", camera.is_gain_auto_available, camera.get_gain_auto),
        )
        if there() and got(mode) not in (None, Aravis.Auto.OFF)
    ]
    return {"controls": own, "automatic": automatic}


def got(call: Any, *values: Any) -> Any:
    """What a call gives; None where the camera refuses."""
    try:
        return call(*values)
    except GLib.Error:
        return None


class Counters:
    """What was lost on the way, exactly: packets by those that should have come, frames by their numbers."""

    def __init__(self, camera: Any, stream: Any, payload: int) -> None:
        self._stream, self._per_frame = stream, 0
        if camera.is_gv_device():
            data = camera.gv_get_packet_size() - UDP_OVERHEAD
            self._per_frame = -(-payload // data) + ENVELOPE_PACKETS
        self._infos = {stream.get_info_name(i): i for i in range(stream.get_n_infos())}
        self._frame_count = self._last_number = self._turns = 0
        self._skipped: set[int] = set()  # numbers that may still come: an incomplete frame comes after whole ones
        self._missing = self.frames_lost = 0

    def _info(self, name: str) -> int:
        return int(self._stream.get_info_uint64(self._infos[name])) if name in self._infos else 0

    def add(self, number: int) -> dict[str, int]:
        """Count a frame that has ended, by its number (0: none); all counts so far.

        Packets of a frame under way only lower what seems to be missing, so the largest value that was seen is the
        right one. What comes after its frame has ended was not lost.
        """
        self._frame_count += 1
        if number:
            self._follow(number)
        ignored, received = self._info("n_ignored_packets"), self._info("n_received_packets")
        in_time = received - ignored - self._info("n_duplicated_packets")
        self._missing = max(self._missing, (self._frame_count + self.frames_lost) * self._per_frame - in_time)
        return {
            "received": received,
            "lost": max(0, self._missing - ignored),
            "resent": self._info("n_resent_packets"),
            "frames_lost": self.frames_lost,
        }

    def _follow(self, number: int) -> None:
        """Take a frame's number, which begins at 1 again after MAX_SHORT_ID."""
        extended = number + self._turns * MAX_SHORT_ID
        if self._last_number - extended > MAX_SHORT_ID // 2:
            self._turns, extended = self._turns + 1, extended + MAX_SHORT_ID
        if self._last_number and 0 < extended - self._last_number <= MAX_GAP:
            self._skipped.update(range(self._last_number + 1, extended))
        self._skipped.discard(extended)
        self._last_number = max(self._last_number, extended)
        expired = {one for one in self._skipped if one < self._last_number - REORDERED}
        self._skipped -= expired
        self.frames_lost += len(expired)


class Memory:
    """Buffers in memory that both processes see, each at a page's begin."""

    def __init__(self, descriptor: int, payload: int, count: int) -> None:
        self.stride = -(-payload // PAGE_BYTES) * PAGE_BYTES
        os.ftruncate(descriptor, count * self.stride)
        self._map = mmap.mmap(descriptor, count * self.stride)
        start = ctypes.addressof(ctypes.c_char.from_buffer(self._map))
        self.buffers = [Aravis.Buffer.new(payload, start + i * self.stride) for i in range(count)]


def capture(order: dict[str, Any], lines: Any) -> None:
    """Grab until the end of the input, or until the camera is lost; ValueError says why it could not begin."""
    camera = opened(order["id"])
    device = camera.get_device()
    ready = set_up(camera, order)
    if camera.is_gv_device():  # a packet socket, which only root gets, sees packets up to 5 ms later
        camera.gv_set_stream_options(Aravis.GvStreamOption.PACKET_SOCKET_DISABLED)
    try:
        stream, payload = camera.create_stream(None, None), camera.get_payload()
    except GLib.Error as error:
        raise ValueError(f"it does not stream, another program may hold it: {reason(error)}") from None
    if camera.is_gv_device():  # room for pictures that come while this process does not get to run; net.core.rmem_max
        stream.set_property("socket-buffer", Aravis.GvStreamSocketBuffer.FIXED)
        stream.set_property("socket-buffer-size", min(SOCKET_PICTURES * payload, MAX_SOCKET_BUFFER))
    memory = Memory(order["memory"], payload, order["buffers"])
    for buffer in memory.buffers:
        stream.push_buffer(buffer)
    lost = threading.Event()
    device.connect("control-lost", lambda *_: lost.set())
    ended = threading.Event()
    threading.Thread(target=refill, args=(lines, stream, memory, ended), daemon=True).start()
    attempt("acquisition", camera.start_acquisition)
    say(ready={**ready, "stride": memory.stride, "model": camera.get_model_name()})
    if order["trigger"] == SOFTWARE:
        threading.Thread(target=fire, args=(camera, 1 / order["fps"], ended), daemon=True).start()
    threading.Thread(target=read_clock, args=(device, ended), daemon=True).start()
    try:
        pump(stream, memory, Counters(camera, stream, payload), ended, lost)
    finally:
        ended.set()
        with contextlib.suppress(GLib.Error):
            camera.stop_acquisition()
        if camera.is_gv_device():  # else nobody else may take the camera until its heartbeat is missed
            with contextlib.suppress(GLib.Error):
                device.leave_control()


def refill(lines: Any, stream: Any, memory: Memory, ended: threading.Event) -> None:
    """Give each buffer back that the other process has read."""
    for line in lines:
        stream.push_buffer(memory.buffers[int(line)])
    ended.set()


def fire(camera: Any, period: float, ended: threading.Event) -> None:
    """Trigger at every multiple of the period of the machine's clock: all cameras of a rig at the same instants.

    Where this process gets to it too late, the camera misses that picture rather than to show another instant.
    """
    while not ended.is_set():
        now = time.monotonic()
        next_trigger = (now // period + 1) * period
        time.sleep(next_trigger - now)
        if time.monotonic() - next_trigger < MAX_TRIGGER_DELAY:
            got(camera.software_trigger)  # that a camera is gone is told by its heartbeat


def read_clock(device: Any, ended: threading.Event) -> None:
    """Read the device's clock now and then, where it can be read."""
    latch, value = next((pair for pair in LATCHES if all(map(device.is_feature_available, pair))), ("", ""))
    while latch and not ended.wait(LATCH_PERIOD):
        try:
            sent = time.monotonic()
            device.execute_command(latch)
            received, ticks = time.monotonic(), device.get_integer_feature_value(value)
            slow = latch != LATCHES[0][0] and device.is_feature_available(TICK_RATE)
            rate = device.get_integer_feature_value(TICK_RATE) if slow else 10**9
            say(latch=[sent, received, ticks * 10**9 // (rate or 10**9)])
        except GLib.Error:
            continue


def pump(stream: Any, memory: Memory, counters: Counters, ended: threading.Event, lost: threading.Event) -> None:
    """Tell of each frame as it ends."""
    last_report = time.monotonic()
    while not ended.is_set():
        buffer = stream.timeout_pop_buffer(POP_TIMEOUT_US)
        now, today = both_clocks()
        if lost.is_set():
            raise ValueError("the camera does not answer any more")
        if buffer is None:
            if now - last_report > ALIVE_PERIOD:
                last_report = now
                say(alive=now)
            continue
        last_report = now
        say(frame=frame_of(buffer, memory, counters, now, today))
        if buffer.get_status() != Aravis.BufferStatus.SUCCESS:
            stream.push_buffer(buffer)


def both_clocks() -> tuple[float, int]:
    """The monotonic clock, s, and the time of day, ns, of one instant, as near as a few tries come."""
    tries = []
    for _ in range(CLOCK_TRIES):
        before, today, after = time.monotonic(), time.time_ns(), time.monotonic()
        tries.append((after - before, (before + after) / 2, today))
        if after - before < CLOCK_APART:
            break
    return min(tries)[1:]


def frame_of(buffer: Any, memory: Memory, counters: Counters, now: float, today: int) -> dict[str, Any]:
    """A frame in words; `buffer` is None where packets are missing. arrival: of its first packet, s."""
    complete = buffer.get_status() == Aravis.BufferStatus.SUCCESS
    number, stamp = buffer.get_frame_id(), buffer.get_timestamp()
    behind = max(0, today - buffer.get_system_timestamp()) / 1e9
    frame: dict[str, Any] = {
        "status": buffer.get_status().value_nick,
        "stamp": stamp,
        "arrival": now - behind if behind < 1 else now,
        "counts": counters.add(number),
        "infos": {k: counters._info(k) for k in counters._infos if k.startswith("n_")},
        "buffer": None,
    }
    if complete:
        frame["buffer"] = next(i for i, one in enumerate(memory.buffers) if one == buffer)
        padding = buffer.get_image_padding()
        frame["size"] = [buffer.get_image_width(), buffer.get_image_height()]
        frame["padding"] = padding[0] if padding else 0
    return frame


def main() -> int:
    """List, or capture; 1 where that was not possible, with a line that says why."""
    if sys.argv[1:] == ["--list"]:
        say(devices=devices())
        return 0
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the other process's, which then ends the input
    order = json.loads(sys.stdin.readline())
    try:
        capture(order, sys.stdin)
    except ValueError as error:
        say(error=str(error))
        return 1
    except BrokenPipeError:  # nobody listens any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


if __name__ == "__main__":
    sys.exit(main())
