"""Images in and out of files: videos frame by frame, and pictures (owns cv2)."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # silences FFmpeg's lines on stderr: our errors report instead

import cv2
import numpy as np

from estimation.errors import InputError
from perception.frames import Image

PNG_LEVEL = 1  # 0-9; a 1280x720 webcam image took 39 ms and 0.55 MB, at 6 86 ms and 0.48 MB, at 0 25 ms and 2.8 MB


class Video:
    """A video read forward, one frame at a time; frames are (H, W, 3) BGR. InputError where it cannot be decoded."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(path, "video", "no such file", "a video file that OpenCV decodes")
        self.path, self.next = path, 0
        self._capture = cv2.VideoCapture()
        with suppress(cv2.error):
            self._capture.open(str(path))
        if not self._capture.isOpened():
            raise InputError(path, "video", f"{path.stat().st_size} bytes, undecodable", "a video that OpenCV decodes")

    def reported_count(self) -> int:
        """Number of frames by the container; it may be wrong, or 0 where it gives none."""
        return max(0, int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)))

    def reaches(self, count: int) -> bool:
        """Whether the container reports `count` frames and the last one decodes; afterwards the video is used up.

        The jump to the end costs a few ms; it failed for every truncated avi, mkv and mp4 (index in front) tried.
        """
        if self.reported_count() != count:
            return False
        with suppress(cv2.error):
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, count - 1)
            return bool(self._capture.grab())
        return False

    def read(self) -> Image | None:
        """The next frame, None at the end (of the video, or of what can be decoded of it)."""
        ok, image = False, None
        with suppress(cv2.error):  # of a damaged container; as much as its end
            ok, image = self._capture.read()
        self.next += ok
        return np.asarray(image, np.uint8) if ok else None

    def skip(self) -> bool:
        """Step over the next frame; False at the end."""
        ok = False
        with suppress(cv2.error):
            ok = bool(self._capture.grab())
        self.next += ok
        return ok

    def close(self) -> None:
        """Release the decoder."""
        self._capture.release()


def count_by_decoding(path: Path) -> int:
    """Number of frames that can be decoded, by going through the whole video."""
    video = Video(path)
    while video.skip():
        pass
    video.close()
    return video.next


def encode(image: Image, jpeg_quality: int | None = None) -> tuple[str, bytes]:
    """Format ("png", exact, or "jpeg" at 0-100) and bytes of an (H, W) grey or (H, W, 3) BGR image."""
    if jpeg_quality is None:
        kind, suffix, options = "png", ".png", [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL]
    else:
        kind, suffix, options = "jpeg", ".jpg", [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    ok, data = cv2.imencode(suffix, image, options)
    assert ok
    return kind, data.tobytes()


def decode(data: bytes, where: object, what: str) -> Image:
    """Image (H, W) grey or (H, W, 3) BGR uint8 of an encoded picture; InputError (where, what) if it is none."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise InputError(where, what, f"{len(data)} bytes, undecodable", "a picture that OpenCV decodes")
    return np.asarray(image, np.uint8)


def check_size(image: Image, size: tuple[int, int], where: object, what: str) -> None:
    """InputError unless the image is `size` (W, H) px."""
    height, width = image.shape[:2]
    if (width, height) != size:
        raise InputError(where, what, f"{width} x {height} px", f"{size[0]} x {size[1]} px, the camera's `size`")


def small_jpeg(image: Image, width: int, quality: int) -> bytes:
    """JPEG, at a quality of 0-100, of an (H, W) grey or (H, W, 3) BGR image, at most `width` px wide."""
    height = round(image.shape[0] * width / image.shape[1])
    if width < image.shape[1]:
        image = np.asarray(cv2.resize(image, (width, max(height, 1)), interpolation=cv2.INTER_AREA), np.uint8)
    return encode(image, quality)[1]
