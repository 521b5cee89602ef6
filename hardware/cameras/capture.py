"""A camera opened by OpenCV: a device, a stream or a file, one frame after the other (owns cv2.VideoCapture)."""

from __future__ import annotations

import math
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # FFmpeg's own lines on stderr: our words say it instead
os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "2")  # s, as SILENT below; usually 10

import cv2
import numpy as np

from hardware.cameras.controls import Control, ask_picture, lock, read_back, untaken
from hardware.cameras.identity import Identity, Kind, device_node
from hardware.cameras.sources import CameraSource
from hardware.process.clock import Clock
from perception.frames import Image

SILENT = 2  # s: a camera or stream that sends nothing for longer is opened anew
OPEN_TIMEOUT = 3  # s until a stream that does not answer is given up
FILE_FPS = 30.0  # Hz, where neither the container nor rig.toml tells a rate

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # an unplugged camera is told in our words


def reads_videos() -> bool:
    """Whether this OpenCV was built with FFmpeg, which reads recorded videos and streams."""
    return bool(cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG))


class Capture(Protocol):
    """An open camera. ends: whether it comes to an end, as a file does. clocked: `position` may be the machine's."""

    ends: bool
    clocked: bool

    def grab(self) -> bool:
        """Wait for the next frame; False where the camera has gone, or ended."""
        ...

    def position(self) -> float:
        """The grabbed frame's instant as the source tells it, s on a clock of its own; nan where it tells none."""
        ...

    def retrieve(self) -> Image | None:
        """The grabbed frame (H, W) or (H, W, 3) BGR; None where it cannot be decoded."""
        ...

    def lock(self) -> tuple[Control, ...]:
        """Ask for the source's controls once more where need be, and read them back."""
        ...

    def release(self) -> None:
        """Give the camera back."""
        ...


Opener = Callable[[CameraSource, "tuple[int, int] | None", Clock], "Capture | None"]


def open_capture(source: CameraSource, size: tuple[int, int] | None, clock: Clock) -> Capture | None:
    """Open a camera, asked for pictures of `size` (W, H) px; None where that is not possible now."""
    if source.identity.kind is Kind.DEVICE:
        node = device_node(source.identity)
        found = None if node is None else cv2.VideoCapture(str(node), cv2.CAP_V4L2)
    else:
        found = _open_ffmpeg(source.identity)
    if found is None or not found.isOpened():
        return None
    if source.identity.kind is Kind.DEVICE:
        ask_picture(found, source, size)
        lock(found, source)
    return _OpenCapture(found, source, clock)


def _open_ffmpeg(identity: Identity) -> cv2.VideoCapture:
    options = {
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: 1000 * OPEN_TIMEOUT,
        cv2.CAP_PROP_READ_TIMEOUT_MSEC: 1000 * SILENT,
        cv2.CAP_PROP_N_THREADS: 1,  # decoders of several threads hand each picture out that many frames later
    }
    return cv2.VideoCapture(identity.text, cv2.CAP_FFMPEG, [number for item in options.items() for number in item])


class _OpenCapture:
    """OpenCV's capture; a video file is played at its rate."""

    def __init__(self, capture: cv2.VideoCapture, source: CameraSource, clock: Clock) -> None:
        self._capture, self._source, self._clock = capture, source, clock
        self.clocked = source.identity.kind is Kind.DEVICE
        self.ends = source.identity.kind is Kind.FILE and not _is_pipe(Path(source.identity.text))
        told = capture.get(cv2.CAP_PROP_FPS)
        self._period = 1 / (source.fps or (told if told > 0 else FILE_FPS))
        self._next = clock.now()

    def grab(self) -> bool:
        if self.ends:
            self._clock.wait_until(self._next)
            self._next = max(self._next, self._clock.now() - self._period) + self._period
        try:
            return bool(self._capture.grab())
        except cv2.error:
            return False

    def position(self) -> float:
        told = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        return told if told > 0 or not self.clocked else math.nan

    def retrieve(self) -> Image | None:
        try:
            ok, image = self._capture.retrieve()
        except cv2.error:
            return None
        return np.asarray(image, np.uint8) if ok else None

    def lock(self) -> tuple[Control, ...]:
        if not self.clocked:
            return untaken(self._source)
        controls = read_back(self._capture, self._source)
        if all(control.taken for control in controls):
            return controls
        lock(self._capture, self._source)  # some drivers take a control only once pictures flow
        return read_back(self._capture, self._source)

    def release(self) -> None:
        self._capture.release()


def _is_pipe(path: Path) -> bool:
    try:
        return stat.S_ISFIFO(path.stat().st_mode)
    except OSError:
        return False
