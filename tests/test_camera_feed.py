"""One camera in virtual time: stamps, faults, going away and coming back, without a thread or a camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.cameras.controls import Control
from hardware.cameras.feed import BROKEN, LONGEST_BACK_OFF, Arrival, Feed, Place
from hardware.cameras.identity import Identity, Kind
from hardware.cameras.rhythm import MEMORY, SEEN, Rhythm
from hardware.cameras.sources import CameraSource
from hardware.cameras.stamping import OLDEST, WINDOW, Stamping
from hardware.cameras.state import STALLED, Phase
from hardware.cameras.watch import Fault, FrameWatch, is_black
from hardware.process.clock import Clock, SimClock, WallClock
from tests.streams import BLACK, SIZE, ListedCapture, Shot, picture

PERIOD, LAG, EXPOSURE = 0.04, 0.03, 0.008
DEVICE = CameraSource(Identity(Kind.DEVICE, "usb:A1"), fps=1 / PERIOD)
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

    feed = Feed(Place(0, "cam", SIZE, 0.5), DEVICE, clock, out.append, opener)
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


@pytest.mark.parametrize("wrong", [-1e-3, OLDEST + 1e-3, 1e9, math.nan])
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
    counted = dict.fromkeys((Fault.DAMAGED, Fault.BLACK, Fault.FROZEN, Fault.WRONG_SIZE, Fault.DUPLICATED), 1)
    assert feed.state().faults == counted and len(out) == 25
    assert feed.state().missed == 1  # the frame whose stamp was the last one's again


def test_frames_that_never_came_are_counted_by_the_gaps() -> None:
    feed, out = fed([s for k, s in enumerate(shots(40)) if k not in (15, 22, 23)])
    assert len(out) == 37 and feed.state().missed == 3


def test_a_camera_that_went_is_opened_again_with_a_back_off_and_named_meanwhile() -> None:
    clock = SimClock()
    feed, out = fed(shots(5), None, None, None, clock=clock, steps=5 + 2 + 3)
    state = feed.state()
    assert len(out) == 5 and state.phase is Phase.GONE and "cam cannot be opened since" in state.trouble
    waited = clock.now() - (1 + 4 * PERIOD + LAG)
    assert waited == pytest.approx(0.1 + 0.2 + 0.4)
    feed, out = fed(shots(5), *[None] * 9, shots(5, 60.0))
    state = feed.state()
    assert len(out) == 10 and state.reopened == 1 and state.since < LONGEST_BACK_OFF


def test_a_camera_that_never_came_is_named() -> None:
    feed, _ = fed(*[None] * 6)
    assert feed.state().phase is Phase.OPENING and "cam cannot be opened since" in feed.state().trouble


def test_a_camera_that_only_sends_damage_is_opened_anew() -> None:
    broken = [Shot(s.arrival, s.position, None) for s in shots(BROKEN)]
    feed, out = fed(broken, shots(5, 60.0))
    assert len(out) == 5 and feed.state().reopened == 1


def test_a_camera_is_in_trouble_when_it_has_stalled_and_not_before() -> None:
    clock = SimClock()
    feed, _ = fed(shots(20), clock=clock, steps=21)
    clock.wait_until(clock.now() + STALLED)
    assert not feed.state().trouble
    clock.wait_until(clock.now() + 1e-6)
    assert "delivers nothing since" in feed.state().trouble


@given(seed=st.integers(0, 2**32 - 1), jitter=st.floats(0, 0.15), drop=st.floats(0, 0.1), told=st.booleans())
@settings(max_examples=30)
def test_a_rhythm_finds_the_beat_behind_jitter_and_skips(seed: int, jitter: float, drop: float, told: bool) -> None:
    rng = np.random.default_rng(seed)
    kept = np.flatnonzero(rng.random(200) >= drop)
    instants = 5 + kept * PERIOD + rng.uniform(-jitter, jitter, len(kept)) * PERIOD
    rhythm = Rhythm(PERIOD if told else None)
    beats = [rhythm(float(instant)) for instant in instants]
    steady = np.array([beat.steady for beat in beats])
    assert (np.diff(steady) >= 0).all()
    settled = slice(MEMORY + SEEN, None)
    assert np.abs(steady - 5 - kept * PERIOD)[settled].max() <= max(0.75 * jitter * PERIOD, 1e-9)
    assert [beat.count for beat in beats[MEMORY + SEEN :]] == np.diff(kept)[MEMORY + SEEN - 1 :].tolist()


def test_a_rhythm_takes_a_new_rate_over() -> None:
    rhythm = Rhythm(1 / 30)
    for k in range(100):
        rhythm(k / 30)
    for k in range(30):
        rhythm(100 / 30 + k / 15)
    assert rhythm.period == pytest.approx(1 / 15, rel=0.01)


def stamped(arrivals: Sequence[float], position_of: Callable[[int], float]) -> tuple[list[float], set[str]]:
    stamping = Stamping(PERIOD)
    found = [stamping(arrival, position_of(k), False) for k, arrival in enumerate(arrivals)]
    return [s.stamp for s in found[WINDOW:]], {s.by for s in found[WINDOW:]}


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
    off = np.array(stamps) - exposed[WINDOW:] - LAG
    assert np.ptp(off) < 0.002 and abs(off.mean()) < 0.002


def test_a_stream_whose_clock_is_made_up_is_stamped_by_arrival_without_most_of_the_jitter() -> None:
    exposed, arrivals = late_arrivals()
    stamps, by = stamped(arrivals.tolist(), lambda k: k / 25.5)
    assert by == {"arrival"}
    off = np.array(stamps) - exposed[WINDOW:] - LAG
    assert np.ptp(np.percentile(off, [1, 90])) < 0.004 and abs(np.median(off)) < 0.003
    assert (np.array(stamps) <= arrivals[WINDOW:]).all()


def test_what_was_held_up_on_the_way_is_not_taken_for_new() -> None:
    arrivals = [k * PERIOD for k in range(40)]
    burst = [arrivals[-1] + 0.5 + 0.001 * k for k in range(10)]
    stamping = Stamping(PERIOD)
    fresh = [stamping(a, math.nan, False).fresh for a in [*arrivals, *burst, burst[-1] + PERIOD]]
    assert fresh == [*[True] * 41, *[False] * 9, True]


def test_black_is_told_from_dark() -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 19, (120, 160, 3)).astype(np.uint8)
    assert is_black(noise) and FrameWatch(SIZE).fault(noise) is Fault.BLACK
    noise[:40, :40] = 60
    assert not is_black(noise) and FrameWatch(SIZE).fault(noise) is None
