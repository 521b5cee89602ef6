"""One camera in virtual time: stamps, faults, reconnection; live cameras over local HTTP and video files."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.rig import Camera, Rig
from hardware.cameras.capture import Control
from hardware.cameras.feed import (
    MAX_BACK_OFF,
    MAX_DAMAGED_FRAMES,
    STALL_AFTER,
    Arrival,
    CameraPhase,
    CameraPlace,
    Feed,
    FrameFault,
    FrameWatch,
    LiveHealth,
    is_black,
)
from hardware.cameras.live import LiveCameras
from hardware.cameras.sources import CameraSource, Identity, SourceKind
from hardware.cameras.stamping import (
    DELAY_WINDOW,
    MAX_DRIVER_LAG,
    PERIOD_INSTANTS,
    PLL_BEATS,
    FrameStamper,
    PhaseLockedLoop,
)
from hardware.process.clock import Clock, SimClock, WallClock
from perception.frames import FrameSet
from tests.camera_streams import BLACK, CLOCK, SIZE, HttpCamera, ListedCapture, Shot, picture, served

PERIOD, LAG, EXPOSURE = 0.04, 0.03, 0.008
DEVICE = CameraSource(Identity(SourceKind.DEVICE, "usb:A1"), fps=1 / PERIOD)
LOCKED = (Control("exposure_s", EXPOSURE, EXPOSURE),)
PICTURES = [picture(number) for number in range(8)]


def shots(count: int, start: float = 1.0) -> list[Shot]:
    """Steady frames: exposed every PERIOD, stamped by the driver, here LAG later."""
    return [Shot(start + k * PERIOD + LAG, start + k * PERIOD, PICTURES[k % 8]) for k in range(count)]


def fed(
    *lives: Sequence[Shot] | None, clock: Clock | None = None, clocked: bool = True, steps: int | None = None
) -> tuple[Feed, list[Arrival]]:
    """A feed whose camera is opened once per list, None: in vain; stepped through all of them."""
    out: list[Arrival] = []
    clock, ways = clock or SimClock(), iter(lives)

    def opener(*_: object) -> ListedCapture | None:
        life = next(ways, None)
        return None if life is None else ListedCapture(life, clock, clocked, LOCKED)

    feed = Feed(CameraPlace(0, "cam", SIZE, 0.5), DEVICE, clock, out.append, opener)
    for _ in range(steps or sum(1 if life is None else len(life) + 2 for life in lives)):
        feed.step()
    return feed, out


def test_a_driver_stamps_the_middle_of_the_exposure_and_the_rigs_offset_is_added() -> None:
    feed, out = fed(shots(20))
    assert [a.frame.stamp for a in out] == pytest.approx([1 + k * PERIOD - EXPOSURE / 2 + 0.5 for k in range(20)])
    assert {a.frame.by for a in out} == {"driver"}
    state = feed.state()
    assert state.lag == pytest.approx(LAG + EXPOSURE / 2) and state.given == 20 and not state.faults
    assert state.rate == pytest.approx(1 / PERIOD, rel=1e-6) and state.jitter == pytest.approx(0, abs=1e-9)


def test_the_clock_may_be_the_machines_own() -> None:
    clock = WallClock()
    _, out = fed(shots(5, clock.now()), clock=clock)
    assert len(out) == 5 and {a.frame.by for a in out} == {"driver"}


@pytest.mark.parametrize("wrong", [-1e-3, MAX_DRIVER_LAG + 1e-3, 1e9, math.nan])
def test_a_stamp_of_another_clock_is_not_believed(wrong: float) -> None:
    taken = [Shot(s.arrival, s.arrival - wrong, s.image) for s in shots(20)]
    _, out = fed(taken)
    assert {a.frame.by for a in out} == {"arrival"}
    assert [a.frame.stamp for a in out] == pytest.approx([s.arrival - EXPOSURE / 2 + 0.5 for s in taken])


def test_faulty_frames_are_left_out_and_counted_by_reason() -> None:
    good = shots(30)
    bad = {3: None, 8: BLACK, 12: good[11].image, 17: picture(1)[:60]}
    taken = [Shot(s.arrival, s.position, bad.get(k, s.image)) for k, s in enumerate(good)]
    taken[20] = Shot(good[20].arrival, good[19].position, good[20].image)
    feed, out = fed(taken)
    counted = dict.fromkeys(
        (FrameFault.DAMAGED, FrameFault.BLACK, FrameFault.FROZEN, FrameFault.WRONG_SIZE, FrameFault.DUPLICATED), 1
    )
    assert feed.state().faults == counted and len(out) == 25
    assert feed.state().missed == 1  # the frame whose stamp was the last one's again


def test_frames_that_never_came_are_counted_by_the_gaps() -> None:
    feed, out = fed([s for k, s in enumerate(shots(40)) if k not in (15, 22, 23)])
    assert len(out) == 37 and feed.state().missed == 3


def test_a_camera_that_went_is_opened_again_with_a_back_off_and_named_meanwhile() -> None:
    clock = SimClock()
    feed, out = fed(shots(5), None, None, None, clock=clock, steps=5 + 2 + 3)
    state = feed.state()
    assert len(out) == 5 and state.phase is CameraPhase.GONE and "cam cannot be opened since" in state.trouble
    waited = clock.now() - (1 + 4 * PERIOD + LAG)
    assert waited == pytest.approx(0.1 + 0.2 + 0.4)
    feed, out = fed(shots(5), *[None] * 9, shots(5, 60.0))
    state = feed.state()
    assert len(out) == 10 and state.reopened == 1 and state.since < MAX_BACK_OFF


def test_a_camera_that_only_sends_damage_is_opened_anew() -> None:
    broken = [Shot(s.arrival, s.position, None) for s in shots(MAX_DAMAGED_FRAMES)]
    feed, out = fed(broken, shots(5, 60.0))
    assert len(out) == 5 and feed.state().reopened == 1


def test_a_camera_is_in_trouble_when_it_has_stalled_and_not_before() -> None:
    clock = SimClock()
    feed, _ = fed(shots(20), clock=clock, steps=21)
    clock.wait_until(clock.now() + STALL_AFTER)
    assert not feed.state().trouble
    clock.wait_until(clock.now() + 1e-6)
    assert "delivers nothing since" in feed.state().trouble


@given(seed=st.integers(0, 2**32 - 1), jitter=st.floats(0, 0.15), drop=st.floats(0, 0.1), told=st.booleans())
@settings(max_examples=30)
def test_the_loop_finds_the_beat_behind_jitter_and_skips(seed: int, jitter: float, drop: float, told: bool) -> None:
    rng = np.random.default_rng(seed)
    kept = np.flatnonzero(rng.random(200) >= drop)
    instants = 5 + kept * PERIOD + rng.uniform(-jitter, jitter, len(kept)) * PERIOD
    loop = PhaseLockedLoop(PERIOD if told else None)
    beats = [loop(float(instant)) for instant in instants]
    steady = np.array([beat.steady for beat in beats])
    assert (np.diff(steady) >= 0).all()
    first = PLL_BEATS + PERIOD_INSTANTS
    assert np.abs(steady - 5 - kept * PERIOD)[first:].max() <= max(0.75 * jitter * PERIOD, 1e-9)
    first = PLL_BEATS + PERIOD_INSTANTS
    assert [beat.count for beat in beats[first:]] == np.diff(kept)[first - 1 :].tolist()


def test_the_loop_takes_a_new_rate_over() -> None:
    loop = PhaseLockedLoop(1 / 30)
    for k in range(100):
        loop(k / 30)
    for k in range(30):
        loop(100 / 30 + k / 15)
    assert loop.period == pytest.approx(1 / 15, rel=0.01)


def stamped(arrivals: Sequence[float], position_of: Callable[[int], float]) -> tuple[list[float], set[str]]:
    stamping = FrameStamper(PERIOD)
    found = [stamping(arrival, position_of(k), False) for k, arrival in enumerate(arrivals)]
    return [s.stamp for s in found[DELAY_WINDOW:]], {s.by for s in found[DELAY_WINDOW:]}


def late_arrivals(count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Exposures and arrivals, most of them a little late and some very late."""
    exposed = 7 + np.arange(count) * PERIOD
    rng = np.random.default_rng(3)
    late = rng.exponential(0.004, count) + 0.1 * (rng.random(count) < 0.01)
    return exposed, np.maximum.accumulate(exposed + LAG + late)


def test_a_stream_whose_clock_runs_well_is_stamped_by_it() -> None:
    exposed, arrivals = late_arrivals()
    stamps, by = stamped(arrivals.tolist(), lambda k: 100 + k * PERIOD)
    assert by == {"stream"}
    off = np.array(stamps) - exposed[DELAY_WINDOW:] - LAG
    assert np.ptp(off) < 0.002 and abs(off.mean()) < 0.002


def test_a_stream_whose_clock_is_made_up_is_stamped_by_arrival_without_most_of_the_jitter() -> None:
    exposed, arrivals = late_arrivals()
    stamps, by = stamped(arrivals.tolist(), lambda k: k / 25.5)
    assert by == {"arrival"}
    off = np.array(stamps) - exposed[DELAY_WINDOW:] - LAG
    assert np.ptp(np.percentile(off, [1, 90])) < 0.004 and abs(np.median(off)) < 0.003
    assert (np.array(stamps) <= arrivals[DELAY_WINDOW:]).all()


def test_what_was_held_up_on_the_way_is_not_taken_for_new() -> None:
    arrivals = [k * PERIOD for k in range(40)]
    burst = [arrivals[-1] + 0.5 + 0.001 * k for k in range(10)]
    stamping = FrameStamper(PERIOD)
    fresh = [stamping(a, math.nan, False).fresh for a in [*arrivals, *burst, burst[-1] + PERIOD]]
    assert fresh == [*[True] * 41, *[False] * 9, True]


def test_black_is_told_from_dark() -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 19, (120, 160, 3)).astype(np.uint8)
    assert is_black(noise) and FrameWatch(SIZE).fault(noise) is FrameFault.BLACK
    noise[:40, :40] = 60
    assert not is_black(noise) and FrameWatch(SIZE).fault(noise) is None


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


def live_cameras_given(count: int) -> Callable[[LiveHealth], bool]:
    return lambda health: min(camera.given for camera in health.cameras) >= count


def all_open(health: LiveHealth) -> bool:
    """Whether every camera has delivered a good frame within the last half second."""
    return all(camera.phase is CameraPhase.OPEN and camera.age <= STALL_AFTER for camera in health.cameras)


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
        sets = list(sets_until(live, live_cameras_given(50)))
        health = live.health()
    stamps = [s.stamp for s in sets]
    assert stamps == sorted(set(stamps)) and {f.by for s in sets for f in s.frames} <= {"arrival", "stream"}
    for camera in health.cameras:
        assert camera.phase is CameraPhase.OPEN and 10 < camera.rate < 60  # a busy machine serves 40 Hz more slowly
        assert camera.newest is not None and camera.newest.shape == (SIZE[1], SIZE[0], 3)
    assert not health.trouble


def test_a_stream_that_is_cut_off_leaves_the_other_alone_and_comes_back(cameras: tuple[HttpCamera, HttpCamera]) -> None:
    with LiveCameras(rig_of(2), [c.source for c in cameras], CLOCK) as live:
        list(sets_until(live, live_cameras_given(5)))
        cameras[0].online = False
        gone = list(sets_until(live, lambda h: "cam0 cannot be opened" in h.trouble and h.cameras[0].age > 0.4))
        list(sets_until(live, lambda h: "cam1" not in h.trouble))
        assert sum(len(s.frames) == 1 and s.frames[0].camera == 1 for s in gone) >= 5
        assert cameras[0].url in live.health().trouble
        cameras[0].online = True
        list(sets_until(live, lambda h: all_open(h) and h.cameras[0].reopened == 1 and not h.trouble))


def test_a_stream_that_stalls_is_named_while_the_other_goes_on(cameras: tuple[HttpCamera, HttpCamera]) -> None:
    with LiveCameras(rig_of(2), [c.source for c in cameras], CLOCK) as live:
        list(sets_until(live, live_cameras_given(5)))
        cameras[0].stalled = True
        list(sets_until(live, lambda h: "cam0 delivers nothing since" in h.trouble and "cam1" not in h.trouble))
        cameras[0].stalled = False
        list(sets_until(live, all_open))


def test_frozen_and_black_pictures_are_left_out_and_told(cameras: tuple[HttpCamera, HttpCamera]) -> None:
    with LiveCameras(rig_of(2), [c.source for c in cameras], CLOCK) as live:
        list(sets_until(live, live_cameras_given(5)))
        cameras[0].picture_of, cameras[1].picture_of = lambda _: picture(7), lambda _: BLACK
        list(sets_until(live, lambda h: "again since" in h.trouble and "black since" in h.trouble))
        health = live.health()
        assert "cam0 shows the same picture again" in health.trouble and "cam1 shows black" in health.trouble
        assert health.cameras[0].faults[FrameFault.FROZEN] >= 5 and health.cameras[1].faults[FrameFault.BLACK] >= 5
        cameras[0].picture_of = cameras[1].picture_of = picture
        list(sets_until(live, all_open))


def test_a_camera_that_never_comes_is_named_and_one_of_another_size_too(cameras: tuple[HttpCamera, HttpCamera]) -> None:
    cameras[0].online = False
    cameras[1].picture_of = lambda n: np.repeat(picture(n), 2, axis=0)
    with LiveCameras(rig_of(2), [c.source for c in cameras], CLOCK) as live:
        assert not list(sets_until(live, lambda h: len(h.trouble.split("; ")) == 2 and h.cameras[1].age > 0.6))
        health = live.health()
        assert health.cameras[0].phase is CameraPhase.OPENING and "cam0 cannot be opened since" in health.trouble
        assert "cam1 sends pictures of another size" in live.health().trouble


def test_a_consumer_that_is_slow_gets_the_newest_set(cameras: tuple[HttpCamera, HttpCamera]) -> None:
    with LiveCameras(rig_of(2), [c.source for c in cameras], CLOCK) as live:
        list(sets_until(live, live_cameras_given(20)))
        for _ in range(4):
            start, before = CLOCK.now(), delivered(live)
            while delivered(live) < before + 12:
                CLOCK.wait_until(CLOCK.now() + 0.05)
            one = live.next_set()
            assert one is not None and one.stamp > start
        health = live.health()
        assert health.passed_over >= 4 and all(c.overrun >= 12 for c in health.cameras)


def test_closing_ends_whoever_waits() -> None:
    silent = CameraSource(Identity(SourceKind.STREAM, "http://127.0.0.1:9/none"))
    live = LiveCameras(rig_of(1), [silent], CLOCK)
    live.start()
    threading.Timer(0.2, live.close).start()
    assert list(live) == []


def written_video(path: Path, first: int, count: int) -> CameraSource:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50, SIZE)
    for number in range(first, first + count):
        writer.write(picture(number))
    writer.release()
    return CameraSource(Identity(SourceKind.FILE, str(path)))


def test_video_files_play_at_their_rate_and_end(tmp_path: Path) -> None:
    sources = [written_video(tmp_path / f"{i}.avi", 100 * i, 30) for i in range(2)]
    start = CLOCK.now()
    with LiveCameras(rig_of(2), sources, CLOCK) as live:
        sets = list(live)
    assert CLOCK.now() - start >= 29 / 50
    health = live.health()
    assert [c.phase for c in health.cameras] == [CameraPhase.ENDED, CameraPhase.ENDED]
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

    threading.Thread(target=write, daemon=True).start()
    source = CameraSource(Identity(SourceKind.FILE, str(pipe)))
    with LiveCameras(rig_of(1, size), [source], CLOCK) as live:
        assert list(sets_until(live, live_cameras_given(1)))


def test_every_camera_needs_a_source() -> None:
    with pytest.raises(InputError, match="one per camera of the rig, 2"):
        LiveCameras(rig_of(2), [], CLOCK)


def test_a_driver_that_raises_counts_as_gone_is_told_and_opened_again() -> None:
    """Its thread goes on: the picture comes with the third opening."""
    clock, out, ways = SimClock(), list[Arrival](), iter(range(3))

    class Raising(ListedCapture):
        def grab(self) -> bool:
            raise RuntimeError("driver bug")

    def opener(*_: object) -> ListedCapture:
        if next(ways) < 2:
            return Raising(shots(3), clock, True, LOCKED)
        feed.close()  # after the step that this is part of, and the next
        return ListedCapture(shots(3), clock, True, LOCKED)

    feed = Feed(CameraPlace(0, "cam", SIZE, 0.5), DEVICE, clock, out.append, opener)
    feed.run()
    assert "cannot be opened" in feed.state().trouble and feed.state().trouble.endswith("RuntimeError: driver bug")
    assert next(ways, None) is None
