"""What a camera is to the rest (`Capture`), and one opened by OpenCV: device, stream or file.

Its controls are locked and read back; what the driver did not accept is named.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # instead of FFmpeg's own lines on stderr come our messages
os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "2")  # s, as READ_TIMEOUT below; usually 10

import cv2
import numpy as np

from estimation.errors import StillbedError
from hardware.cameras.sources import CameraSource, Identity, SourceKind, device_node
from hardware.process.clock import Clock
from perception.frames import Image

READ_TIMEOUT = 2  # s: a camera or stream that sends nothing for longer is opened again
OPEN_TIMEOUT = 3  # s for a stream to answer
CATCH_UP = 0.75  # of the time between two stamps: RTSP pictures that come faster had been waiting
CATCH_UP_FRAMES = 5  # over which that is judged: FFmpeg reads a socket in pieces
MAX_BACKLOG = 300  # pictures that FFmpeg may have read before it gives the first: five seconds at 60 Hz
FILE_FPS = 30.0  # Hz, where neither the container nor rig.toml has a rate
EXPOSURE_UNIT = 1e-4  # s: V4L2 counts an absolute exposure in 100 us
MANUAL_EXPOSURE, AUTOMATIC_OFF = 1.0, 0.0  # V4L2_EXPOSURE_MANUAL; the other automatics are switches
CONTROL_TOLERANCE = 0.01  # relative: frame rates are fractions, white balance moves in steps of 10 K
UNSUPPORTED_CONTROL = -1.0  # OpenCV's V4L2 backend returns it for a control that the camera does not have

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # an unplugged camera has our own message


class ControlPort(Protocol):
    """Controls by number, as OpenCV's VideoCapture has them."""

    def set(self, control: int, value: float) -> bool:
        """Request a value; True does not mean that it was accepted."""

    def get(self, control: int) -> float:
        """The value now."""


@dataclass(frozen=True, slots=True)
class Control:
    """One control, in rig.toml's units."""

    name: str
    requested: float | str | None  # None for none
    actual: float | str | None  # read back, None if the camera does not have the control
    automatic: bool = False

    @property
    def accepted(self) -> bool:
        """Whether the camera accepted the request, or there was none."""
        if self.requested is None:
            return True
        if isinstance(self.requested, str) or isinstance(self.actual, str) or self.actual is None:
            return self.requested == self.actual
        step = EXPOSURE_UNIT if self.name == "exposure_s" else 0.0
        near = abs(self.actual - self.requested) <= max(CONTROL_TOLERANCE * abs(self.requested), step / 2)
        return near and not self.automatic

    def __str__(self) -> str:
        actual, requested = (f"{v:g}" if isinstance(v, float) else v for v in (self.actual, self.requested))
        text = f"{self.name} {'not there' if actual is None else actual}" + " (automatic)" * self.automatic
        return text if self.accepted else f"{text}, asked for {requested}"


@dataclass(frozen=True, slots=True)
class _Lockable:
    name: str
    number: int  # OpenCV's
    automatic: int | None = None  # OpenCV's number of the automatic
    off: float = AUTOMATIC_OFF  # value that ends the automatic
    unit: float = 1.0  # of V4L2, in rig.toml's


LOCKABLE_CONTROLS = (
    _Lockable("exposure_s", cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_EXPOSURE, EXPOSURE_UNIT),
    _Lockable("gain", cv2.CAP_PROP_GAIN),
    _Lockable("focus_abs", cv2.CAP_PROP_FOCUS, cv2.CAP_PROP_AUTOFOCUS),
    _Lockable("white_balance_k", cv2.CAP_PROP_WB_TEMPERATURE, cv2.CAP_PROP_AUTO_WB),
)


def request_picture(port: ControlPort, source: CameraSource, size: tuple[int, int] | None) -> None:
    """Request format, size (W, H) px and rate of a device: before the first frame, in this order."""
    if source.format is not None:
        port.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*source.format))
    if size is not None:
        port.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        port.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    if source.fps is not None:
        port.set(cv2.CAP_PROP_FPS, source.fps)


def lock_controls(port: ControlPort, source: CameraSource) -> None:
    """Request a device's controls, after switching their automatics off, which would undo it."""
    for one, requested in _requests(source):
        if requested is not None:
            if one.automatic is not None:
                port.set(one.automatic, one.off)
            port.set(one.number, requested / one.unit)


def read_controls(port: ControlPort, source: CameraSource) -> tuple[Control, ...]:
    """A device's format, rate and controls, read back."""
    code = int(port.get(cv2.CAP_PROP_FOURCC))
    picture_format = "".join(chr(code >> 8 * i & 0xFF) for i in range(4)) if code > 0 else None
    rate = port.get(cv2.CAP_PROP_FPS)
    controls = [_read_one(port, one, requested) for one, requested in _requests(source)]
    fps = Control("fps", source.fps, rate if rate > 0 else None)
    return (Control("format", source.format, picture_format), fps, *controls)


def ignored_controls(source: CameraSource) -> tuple[Control, ...]:
    """The controls requested of a stream or a file, which accepts none."""
    return tuple(Control(one.name, requested, None) for one, requested in _requests(source) if requested is not None)


def locked_exposure(controls: Sequence[Control]) -> float:
    """The exposure read back, s; 0 where it is not locked."""
    for control in controls:
        value = control.actual
        if control.name == "exposure_s" and control.accepted and not control.automatic and isinstance(value, float):
            return value
    return 0.0


def _read_one(port: ControlPort, one: _Lockable, requested: float | None) -> Control:
    value = port.get(one.number)
    if value == UNSUPPORTED_CONTROL:
        return Control(one.name, requested, None)
    automatic = one.automatic is not None and port.get(one.automatic) not in (one.off, UNSUPPORTED_CONTROL)
    return Control(one.name, requested, value * one.unit, automatic)


def _requests(source: CameraSource) -> Iterable[tuple[_Lockable, float | None]]:
    """Each lockable control with the value that is requested, None for none."""
    return zip(LOCKABLE_CONTROLS, (source.exposure, source.gain, source.focus, source.white_balance), strict=True)


def reads_videos() -> bool:
    """Whether this OpenCV was built with FFmpeg, which reads recorded videos and streams."""
    return bool(cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG))


class CameraError(StillbedError):
    """Why a camera cannot be opened, or was lost: one line."""


TRANSPORT_COUNTS = ("received", "lost", "resent", "frames_lost")


@dataclass(frozen=True, slots=True)
class Transport:
    """What a camera on a network or bus lost on the way, and how its clock runs."""

    received: int  # packets
    lost: int  # packets that never came, not even when asked for again
    resent: int  # packets that came when asked for again
    frames_lost: int  # of which no packet came, by the numbers that the camera gives its frames
    drift: float  # by how much our clock is faster than the camera's, of 1; nan before it is known
    doubt: float  # s, of the offset between both clocks; nan where the camera's clock cannot be read

    def after(self, earlier: Transport | None) -> Transport:
        """The same with what was counted before the camera was opened again."""
        if earlier is None:
            return self
        counts = {name: getattr(self, name) + getattr(earlier, name) for name in TRANSPORT_COUNTS}
        return replace(self, **counts)


class Capture(Protocol):
    """An open camera. What its methods raise says why it was lost."""

    ends: bool  # whether it can end, as a file does
    clocked: bool  # whether `position` may be by the machine's own clock
    exact: bool  # whether `position` is the instant itself, without the jitter of a machine that is busy

    @property
    def incomplete(self) -> bool:
        """Whether parts of the grabbed frame were lost on the way."""

    @property
    def transport(self) -> Transport | None:
        """What was lost so far; None where nothing is known of it."""

    def grab(self) -> bool | None:
        """Wait for the next frame; None where none came yet, False if the camera is gone or has ended."""

    def position(self) -> float:
        """The source's own time stamp of the grabbed frame, s; nan without one."""

    def retrieve(self) -> Image | None:
        """The grabbed frame (H, W) or (H, W, 3) BGR; None if it cannot be decoded."""

    def lock(self) -> tuple[Control, ...]:
        """Lock the source's controls again where necessary, and read them back."""

    def release(self) -> None:
        """Release the camera."""


CaptureOpener = Callable[[CameraSource, "tuple[int, int] | None", Clock], "Capture | None"]


def open_by_opencv(source: CameraSource, size: tuple[int, int] | None, clock: Clock) -> Capture | None:
    """Open a device, stream or file for pictures of `size` (W, H) px; None where that is not possible now."""
    if source.identity.kind is SourceKind.DEVICE:
        node = device_node(source.identity)
        capture = None if node is None else cv2.VideoCapture(str(node), cv2.CAP_V4L2)
    else:
        capture = _open_ffmpeg(source.identity)
    if capture is None or not capture.isOpened():
        return None
    if source.identity.kind is SourceKind.DEVICE:
        request_picture(capture, source, size)
        lock_controls(capture, source)
    return _OpenCapture(capture, source, clock)


def _open_ffmpeg(identity: Identity) -> cv2.VideoCapture:
    options = {
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: 1000 * OPEN_TIMEOUT,
        cv2.CAP_PROP_READ_TIMEOUT_MSEC: 1000 * READ_TIMEOUT,
        cv2.CAP_PROP_N_THREADS: 1,  # decoders of several threads hand each picture out that many frames later
    }
    return cv2.VideoCapture(identity.text, cv2.CAP_FFMPEG, [number for item in options.items() for number in item])


class _OpenCapture:
    """OpenCV's capture; a video file is played at its rate."""

    exact = incomplete = False
    transport: Transport | None = None

    def __init__(self, capture: cv2.VideoCapture, source: CameraSource, clock: Clock) -> None:
        self._capture, self._source, self._clock = capture, source, clock
        self.clocked = source.identity.kind is SourceKind.DEVICE
        self.ends = source.identity.kind is SourceKind.FILE and not Path(source.identity.text).is_fifo()
        rate = capture.get(cv2.CAP_PROP_FPS)
        self._period = 1 / (source.fps or (rate if rate > 0 else FILE_FPS))
        self._next_grab = clock.now()
        self._delayed = source.identity.text.startswith(("rtsp://", "rtsps://"))  # FFmpeg looks at these for a second

    def grab(self) -> bool:
        if self.ends:
            self._clock.wait_until(self._next_grab)
            self._next_grab = max(self._next_grab, self._clock.now() - self._period) + self._period
        start = self._clock.now()
        try:
            grabbed = self._catch_up() if self._delayed else bool(self._capture.grab())
        except cv2.error:
            return False
        # at the time's end a decoder gives the picture that it still holds, which is as old as that
        return grabbed and (self.ends or self._clock.now() - start < READ_TIMEOUT)

    def _catch_up(self) -> bool:
        """Grab the first picture that was not read before: the others come faster than they were taken."""
        grabs = deque[tuple[float, float]](maxlen=CATCH_UP_FRAMES)
        for _ in range(MAX_BACKLOG):
            if not self._capture.grab():
                return False
            now, position = self._clock.now(), self.position()
            grabs.append((now, position))
            if len(grabs) == CATCH_UP_FRAMES and now - grabs[0][0] >= CATCH_UP * (position - grabs[0][1]):
                break
        self._delayed = False
        return True

    def position(self) -> float:
        position = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        return position if position > 0 or not self.clocked else math.nan

    def retrieve(self) -> Image | None:
        try:
            ok, image = self._capture.retrieve()
        except cv2.error:
            return None
        return np.asarray(image, np.uint8) if ok else None

    def lock(self) -> tuple[Control, ...]:
        if not self.clocked:
            return ignored_controls(self._source)
        controls = read_controls(self._capture, self._source)
        if all(control.accepted for control in controls):
            return controls
        lock_controls(self._capture, self._source)  # some drivers take a control only once pictures flow
        return read_controls(self._capture, self._source)

    def release(self) -> None:
        self._capture.release()


BAYER_CODES = {  # by the first two pixels of the first row
    "RG": cv2.COLOR_BayerRGGB2BGR,
    "BG": cv2.COLOR_BayerBGGR2BGR,
    "GR": cv2.COLOR_BayerGRBG2BGR,
    "GB": cv2.COLOR_BayerGBRG2BGR,
}


def image_from_pixels(data: memoryview, size: tuple[int, int], pixel_format: str, padding: int = 0) -> Image | None:
    """The picture (H, W) or (H, W, 3) BGR in a camera's pixels, copied; None where they are too few.

    size: (W, H) px. pixel_format: of PIXEL_FORMATS; of more than 8 bits the highest 8 are kept. padding: bytes after
    each row.
    """
    width, height = size
    channels = 3 if pixel_format in ("RGB8", "BGR8") else 1
    depth = int("".join(c for c in pixel_format if c.isdigit()))
    unit = 1 if depth == 8 else 2
    row = width * channels * unit + padding
    if len(data) < height * row - padding or not width * height:
        return None
    raw = np.frombuffer(data, np.uint8, min(len(data), height * row))
    rows = np.lib.stride_tricks.as_strided(raw, (height, row - padding), (row, 1), writeable=False)
    if unit == 2:
        rows = (np.ascontiguousarray(rows).view("<u2") >> (depth - 8)).astype(np.uint8)
    if pixel_format.startswith("Bayer"):
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows), BAYER_CODES[pixel_format[5:7]]), np.uint8)
    if channels == 1:
        return np.array(rows)
    picture = rows.reshape(height, width, 3)
    return np.array(picture if pixel_format == "BGR8" else picture[..., ::-1])
