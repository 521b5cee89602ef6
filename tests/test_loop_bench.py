"""The closed loop's bench: what the motion is told, how a print is judged, and its page."""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from hardware.bench.loop import OURS, WAYS, Print, StillBed, as_it_is, last_seen, loop_page, steady

TWIST = np.array([0.0, 0.0, 0.1, 5.0, 0.0, -2.0])


def pose(stamp: float, state: TrackState = TrackState.TRACKING) -> SurfacePose:
    return SurfacePose(stamp, se3.exp(TWIST * stamp), 1e-4 * np.eye(6), TWIST, state, 1e-2 * np.eye(6), np.ones(6))


def test_each_way_knows_of_the_future_what_it_says() -> None:
    seen = pose(1.0)
    then = seen.stamp + 0.1
    assert np.allclose(last_seen(seen).predict(then).base_from_surface, seen.base_from_surface)
    assert np.allclose(steady(seen).predict(then).base_from_surface, se3.exp(TWIST * then))
    assert as_it_is(seen) is seen
    for way in (last_seen, steady):
        assert way(seen).predict(then).error_at(np.zeros((1, 3)))[0] < 1e-9
        assert (way(seen).stamp, way(seen).state) == (seen.stamp, seen.state)


def test_a_still_bed_stays_at_the_first_measured_pose() -> None:
    told = StillBed()
    assert np.allclose(told(pose(0.5, TrackState.INITIALISING)).base_from_surface, pose(0.5).base_from_surface)
    told(pose(1.0))
    for stamp in (1.1, 7.0):
        assert np.allclose(told(pose(stamp)).predict(stamp + 1).base_from_surface, pose(1.0).base_from_surface)
        assert told(pose(stamp)).stamp == stamp


def test_a_print_counts_what_leaves_the_nozzle() -> None:
    error = np.array([np.nan, 0.1, 0.2, np.nan, 0.3, np.nan])
    one = Print(np.arange(6.0), error)
    assert (one.largest, one.duty) == (0.3, 0.75)
    nothing = Print(np.arange(6.0), np.full(6, np.nan))
    assert np.isnan(nothing.largest) and np.isnan(nothing.p95) and nothing.duty == 0.0


def test_the_page_shows_every_way_of_every_scenario() -> None:
    one = Print(np.arange(0, 1, 0.001), np.abs(np.sin(np.arange(0, 1, 0.001))))
    never = Print(one.stamps, np.full(1000, np.nan))
    page = loop_page({(name, way): one if way == OURS else never for name in ("a", "b") for way in WAYS})
    assert all(page.count(f">{way}: 95 %") == 2 for way in WAYS) and page.count("<h2>") == 2
