"""A camera by RTSP, served by GStreamer: its pictures, their stamps, and what happens when the server dies or hangs."""

from __future__ import annotations

import signal
import socket

import numpy as np
import pytest

from hardware.cameras.feed import CameraPlace
from hardware.cameras.live import LiveCameras
from hardware.cameras.sources import CameraSource, Identity, SourceKind
from perception.frames import FrameSet, Image
from tests.camera_streams import CLOCK
from tests.counterparts import rtsp_server, sets_until

PERIOD = 1 / 25
MAX_DELAY = 0.15  # s: an encoder's, a decoder's and the network's, which nothing here can tell from the exposure


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return int(found.getsockname()[1])


def shown_instant(image: Image) -> float:
    """The instant, s, that a picture shows as 32 bars."""
    bars = image[100:140].mean((0, 2)).reshape(32, -1)[:, 2:-2].mean(1) > 128
    return int("".join("01"[int(bar)] for bar in bars), 2) / 1000


def late(sets: list[FrameSet]) -> np.ndarray:
    """How much later each frame is stamped than it was taken, (N,) s."""
    return np.array([one.frames[0].stamp - shown_instant(one.frames[0].image) for one in sets])


@pytest.mark.slow
def test_an_rtsp_camera_is_stamped_but_for_a_constant_delay_and_opened_again() -> None:
    port = free_port()
    source = CameraSource(Identity(SourceKind.STREAM, f"rtsp://127.0.0.1:{port}/camera"))
    with LiveCameras([CameraPlace(0, "left", (320, 240))], [source], CLOCK) as live:
        with rtsp_server(port) as server:
            first = sets_until(live, CLOCK.now() + 10)
            healthy = live.health()
            server.kill()
            server.wait()
            sets_until(live, CLOCK.now() + 1)
            assert "left cannot be opened since" in live.health().trouble
        with rtsp_server(port) as server:
            second = sets_until(live, CLOCK.now() + 6)
            assert live.health().cameras[0].reopened == 1 and live.health().trouble == ""
            server.send_signal(signal.SIGSTOP)
            sets_until(live, CLOCK.now() + 1)
            assert "left delivers nothing since" in live.health().trouble
            sets_until(live, CLOCK.now() + 3)
            assert "left cannot be opened since" in live.health().trouble
            server.send_signal(signal.SIGCONT)
            third = sets_until(live, CLOCK.now() + 6)
            assert live.health().cameras[0].reopened == 2 and live.health().trouble == ""
    print(len(first), len(second), len(third), "pictures; late, ms:", 1e3 * np.percentile(late(first), [0, 50, 100]))
    assert healthy.trouble == "" and healthy.cameras[0].missed < 0.1 * len(first) and len(first) > 6 / PERIOD
    for sets in (first, second, third):
        off = late(sets)
        assert off.min() > 0 and off.max() < MAX_DELAY, off
        # FFmpeg mostly holds a picture back until the next one begins
        assert np.percentile(off, 95) - np.percentile(off, 5) < 1.25 * PERIOD and np.median(off) < 2 * PERIOD
    assert {one.frames[0].by for one in first} <= {"arrival", "stream"}
