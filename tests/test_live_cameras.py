"""Live cameras over a local HTTP stream and video files: they come, stall, go and come back, and are named."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation.errors import InputError
from estimation.rig import Camera, Rig
from hardware.cameras.identity import Identity, Kind
from hardware.cameras.live import LiveCameras
from hardware.cameras.sources import CameraSource
from hardware.cameras.state import LiveHealth, Phase
from hardware.cameras.watch import Fault
from perception.frames import FrameSet
from tests.streams import BLACK, CLOCK, SIZE, HttpCamera, picture, served

MATRIX, STRAIGHT = np.diag([100.0, 100.0, 1.0]), np.zeros(5)
SOON = 20.0  # s, by which even a busy machine does what takes a second


def rig_of(count: int, size: tuple[int, int] = SIZE) -> Rig:
    return Rig(tuple(Camera(f"cam{i}", size, MATRIX, STRAIGHT, np.eye(4)) for i in range(count)))


def sets_until(live: LiveCameras, holds: Callable[[LiveHealth], bool], seconds: float = SOON) -> Iterator[FrameSet]:
    """Sets until the health is as told, which it must be within `seconds`."""
    end = CLOCK.now() + seconds
    while not holds(live.health()):
        assert CLOCK.now() < end, live.health().trouble
        one = live.next_set(CLOCK.now() + 0.05)
        if one is not None:
            yield one


def given(count: int) -> Callable[[LiveHealth], bool]:
    return lambda health: min(camera.given for camera in health.cameras) >= count


def delivered(live: LiveCameras) -> int:
    """Good frames of the camera that delivered the fewest, fetched or not."""
    return min(camera.given + camera.overrun for camera in live.health().cameras)


@pytest.fixture
def cameras() -> Iterator[tuple[HttpCamera, HttpCamera]]:
    pair = HttpCamera(), HttpCamera()
    with served(*pair):
        yield pair


def test_streams_come_as_sets_that_rise_at_the_cameras_rate(cameras: tuple[HttpCamera, HttpCamera]) -> None:
    with LiveCameras(rig_of(2), [c.source for c in cameras], CLOCK) as live:
        sets = list(sets_until(live, given(50)))
        health = live.health()
    stamps = [s.stamp for s in sets]
    assert stamps == sorted(set(stamps))
    assert {f.by for s in sets for f in s.frames} <= {"arrival", "stream"}
    for camera in health.cameras:
        assert camera.phase is Phase.OPEN and 10 < camera.rate < 60  # a busy machine serves 40 Hz more slowly
        assert camera.newest is not None and camera.newest.shape == (SIZE[1], SIZE[0], 3)
    assert not health.trouble


def test_a_stream_that_is_cut_off_leaves_the_other_alone_and_comes_back(
    cameras: tuple[HttpCamera, HttpCamera],
) -> None:
    with LiveCameras(rig_of(2), [c.source for c in cameras], CLOCK) as live:
        list(sets_until(live, given(5)))
        cameras[0].online = False
        gone = list(sets_until(live, lambda h: "cam0 cannot be opened" in h.trouble and h.cameras[0].age > 0.4))
        list(sets_until(live, lambda h: "cam1" not in h.trouble))
        assert sum(len(s.frames) == 1 and s.frames[0].camera == 1 for s in gone) >= 5
        assert cameras[0].url in live.health().trouble
        cameras[0].online = True
        list(sets_until(live, lambda h: h.all_open and h.cameras[0].reopened == 1 and not h.trouble))


def test_a_stream_that_stalls_is_named_while_the_other_goes_on(cameras: tuple[HttpCamera, HttpCamera]) -> None:
    with LiveCameras(rig_of(2), [c.source for c in cameras], CLOCK) as live:
        list(sets_until(live, given(5)))
        cameras[0].stalled = True
        list(sets_until(live, lambda h: "cam0 delivers nothing since" in h.trouble and "cam1" not in h.trouble))
        cameras[0].stalled = False
        list(sets_until(live, lambda h: h.all_open))


def test_frozen_and_black_pictures_are_left_out_and_told(cameras: tuple[HttpCamera, HttpCamera]) -> None:
    with LiveCameras(rig_of(2), [c.source for c in cameras], CLOCK) as live:
        list(sets_until(live, given(5)))
        cameras[0].picture_of, cameras[1].picture_of = lambda _: picture(7), lambda _: BLACK
        list(sets_until(live, lambda h: "again since" in h.trouble and "black since" in h.trouble))
        health = live.health()
        assert "cam0 shows the same picture again" in health.trouble and "cam1 shows black" in health.trouble
        assert health.cameras[0].faults[Fault.FROZEN] >= 5 and health.cameras[1].faults[Fault.BLACK] >= 5
        cameras[0].picture_of = cameras[1].picture_of = picture
        list(sets_until(live, lambda h: h.all_open))


def test_a_camera_that_never_comes_is_named_and_one_of_another_size_too(
    cameras: tuple[HttpCamera, HttpCamera],
) -> None:
    cameras[0].online = False
    cameras[1].picture_of = lambda n: np.repeat(picture(n), 2, axis=0)
    with LiveCameras(rig_of(2), [c.source for c in cameras], CLOCK) as live:
        assert not list(sets_until(live, lambda h: len(h.trouble.split("; ")) == 2 and h.cameras[1].age > 0.6))
        assert "cam0 cannot be opened since" in live.health().trouble
        assert "cam1 sends pictures of another size" in live.health().trouble


def test_a_consumer_that_is_slow_gets_the_newest_set(cameras: tuple[HttpCamera, HttpCamera]) -> None:
    with LiveCameras(rig_of(2), [c.source for c in cameras], CLOCK) as live:
        list(sets_until(live, given(20)))
        for _ in range(4):
            start, before = CLOCK.now(), delivered(live)
            while delivered(live) < before + 12:
                CLOCK.wait_until(CLOCK.now() + 0.05)
            one = live.next_set()
            assert one is not None and one.stamp > start
        health = live.health()
        assert health.passed_over >= 4 and all(c.overrun >= 12 for c in health.cameras)


def test_closing_ends_whoever_waits() -> None:
    silent = CameraSource(Identity(Kind.STREAM, "http://127.0.0.1:9/none"))
    live = LiveCameras(rig_of(1), [silent], CLOCK)
    live.start()
    threading.Timer(0.2, live.close).start()
    assert list(live) == []


def written_video(path: Path, first: int, count: int) -> CameraSource:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50, SIZE)
    for number in range(first, first + count):
        writer.write(picture(number))
    writer.release()
    return CameraSource(Identity(Kind.FILE, str(path)))


def test_video_files_play_at_their_rate_and_end(tmp_path: Path) -> None:
    sources = [written_video(tmp_path / f"{i}.avi", 100 * i, 30) for i in range(2)]
    start = CLOCK.now()
    with LiveCameras(rig_of(2), sources, CLOCK) as live:
        sets = list(live)
    assert CLOCK.now() - start >= 29 / 50
    health = live.health()
    assert [c.phase for c in health.cameras] == [Phase.ENDED, Phase.ENDED]
    assert all(c.given + sum(c.faults.values()) + c.overrun == 30 for c in health.cameras)
    assert health.sets == len(sets) and health.sets + health.passed_over >= 25


def test_a_pipe_of_jpegs_is_a_camera(tmp_path: Path) -> None:
    pipe = tmp_path / "camera.mjpg"
    os.mkfifo(pipe)
    size = (800, 600)  # FFmpeg reads megabytes before it believes what a pipe holds

    def write() -> None:
        with suppress(BrokenPipeError), pipe.open("wb") as out:
            for number in range(25):
                image = np.random.default_rng(number).integers(60, 200, (*size[::-1], 3)).astype(np.uint8)
                out.write(cv2.imencode(".jpg", image)[1].tobytes())

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    source = CameraSource(Identity(Kind.FILE, str(pipe)))
    with LiveCameras(rig_of(1, size), [source], CLOCK) as live:
        assert list(sets_until(live, given(1)))


def test_every_camera_needs_a_source() -> None:
    with pytest.raises(InputError, match="one per camera of the rig, 2"):
        LiveCameras(rig_of(2), [], CLOCK)
