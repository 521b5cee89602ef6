"""A video whose decoder stumbles ends there, as one that is cut short does."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation.errors import InputError
from hardware.files.images import Video, count_by_decoding

WHOLE = 5  # frames


class Stumbling:
    """A decoder that raises, as OpenCV's own reader of AVI files does at some damage, from a frame on; -1: at once."""

    def __init__(self, at: int) -> None:
        self._at, self._next = at, 0

    def open(self, name: str) -> bool:
        self._step(-1)
        return True

    def isOpened(self) -> bool:
        return self._at >= 0

    def get(self, what: int) -> float:
        return WHOLE

    def set(self, what: int, value: float) -> bool:
        self._next = int(value)
        return True

    def grab(self) -> bool:
        self._step(self._next)
        self._next += 1
        return self._next <= WHOLE

    def read(self) -> tuple[bool, np.ndarray | None]:
        return (True, np.zeros((4, 4, 3), np.uint8)) if self.grab() else (False, None)

    def release(self) -> None:
        """Nothing is held."""

    def _step(self, frame: int) -> None:
        if frame >= self._at:
            raise cv2.error("Assertion failed")


@pytest.mark.parametrize("at", [-1, 0, 3, WHOLE])
def test_a_decoder_that_raises_ends_the_video_there(at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (file := tmp_path / "a.avi").write_bytes(b"RIFF")
    monkeypatch.setattr(cv2, "VideoCapture", lambda: Stumbling(at))
    if at < 0:
        with pytest.raises(InputError, match=r"a\.avi.*undecodable"):
            Video(file)
        return
    assert count_by_decoding(file) == at
    assert Video(file).reaches(WHOLE) == (at == WHOLE)
    video, read = Video(file), 0
    while video.read() is not None:
        read += 1
    assert read == video.next == at
