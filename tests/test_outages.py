"""Cameras fail in every way: never wrong in silence, and back again; offsets and shifts of whole cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.online.camera_errors import CameraErrorHistory, CameraErrors, VarianceEstimate
from estimation.online.camera_health import CameraHealth
from estimation.pose import TrackState
from estimation.pose_solver import SharedFit
from estimation.se3 import Array
from estimation.synthetic.follow import Follower, first_map
from estimation.synthetic.world import BASE_FROM_REST, arc_rig, synthetic_world
from perception.frames import Image
from tests.campaigns.estimator import FRAME_RATE_HZ, make_pictures
from tests.campaigns.outage_run import (
    Outage,
    OutageKind,
    Spoiler,
    TrackedStretch,
    WatchedOutage,
    draw_outage,
)
from tests.campaigns.outages import judge_outage, outage_figures, outage_table, scene_jobs
from tests.slow_cases import slowly
from tests.test_estimator import begun, lively, look, run_skewed, stamps, step

RIG = arc_rig(size=(320, 180), focal=280.0)
EXTENT = np.array([[x, y, 0.0] for x in (-24.0, 24.0) for y in (-17.0, 17.0)])
TRACKING, DEGRADED, COASTING = TrackState.TRACKING, TrackState.DEGRADED, TrackState.COASTING
# Like those beside them, in part hidden or too bright; and what test_faults does to a camera in a print.
LIKE = (OutageKind.HAND, OutageKind.GLARE, OutageKind.EXPOSURE, OutageKind.BUMPED, OutageKind.SWAPPED)


def watched(kind: OutageKind = OutageKind.DEAD, start: int = 10, end: int = 20, count: int = 40) -> WatchedOutage:
    """A tracker that says at once what is wrong and is back at once."""
    outage = Outage(kind, (0,), start / FRAME_RATE_HZ, end / FRAME_RATE_HZ, 0.5, np.eye(4), 0)
    struck = [start <= k < end for k in range(count)]
    used = np.array([[0 if s else 90, 90, 90] for s in struck])
    states = tuple(DEGRADED if s else TRACKING for s in struck)
    reasons = tuple("cam_0" if s else "" for s in struck)
    return WatchedOutage(
        outage,
        np.arange(count) / FRAME_RATE_HZ,
        np.full(count, 0.02),
        np.full(count, 0.05),
        states,
        reasons,
        used,
        False,
    )


def test_what_is_said_at_once_is_no_loss() -> None:
    verdict = judge_outage(watched())
    assert (verdict.silent, verdict.beyond, verdict.flagged, verdict.back) == (False, False, 0.0, 0.0)
    assert verdict.after == verdict.worst == 0.02


@pytest.mark.parametrize(("error", "radius", "silent"), [(0.51, 0.1, True), (0.49, 0.1, False), (0.51, 0.18, False)])
def test_a_loss_is_silent_when_off_by_more_than_harmless_and_claimed(error: float, radius: float, silent: bool) -> None:
    seen = watched()
    off = np.where(np.arange(40) == 15, error, 0.02)
    said = replace(seen, error=off, radius=np.full(40, radius))
    assert not judge_outage(said).silent and judge_outage(said).beyond == silent
    assert judge_outage(replace(said, states=(TRACKING,) * 40)).silent == silent


def test_what_was_wrong_before_the_outage_does_not_count() -> None:
    assert not judge_outage(replace(watched(), error=np.where(np.arange(40) == 5, 3.0, 0.02))).beyond


@pytest.mark.parametrize("late", [1, 4])
def test_the_flag_is_timed_from_the_first_blind_frame(late: int) -> None:
    seen = watched()
    quiet = range(10, 10 + late)
    states = tuple(TRACKING if k in quiet else s for k, s in enumerate(seen.states))
    reasons = tuple("" if k in quiet else r for k, r in enumerate(seen.reasons))
    assert judge_outage(replace(seen, states=states, reasons=reasons)).flagged == pytest.approx(late / FRAME_RATE_HZ)


def test_an_outage_that_nobody_mentions_is_never_flagged() -> None:
    seen = watched()
    assert judge_outage(replace(seen, states=(TRACKING,) * 40, reasons=("",) * 40)).flagged == np.inf
    short = watched(end=12)
    assert np.isnan(judge_outage(replace(short, states=(TRACKING,) * 40, reasons=("",) * 40)).flagged)


def test_a_fault_that_costs_nothing_need_not_be_mentioned() -> None:
    seen = replace(watched(OutageKind.EXPOSURE), states=(TRACKING,) * 40, reasons=("",) * 40, used=np.full((40, 3), 80))
    assert np.isnan(judge_outage(seen).flagged)
    assert judge_outage(replace(seen, error=np.where(np.arange(40) >= 12, 0.3, 0.02))).flagged == np.inf


def test_back_is_the_first_pose_without_a_reservation_and_its_error_the_worst_from_then_on() -> None:
    seen = watched()
    states = tuple(COASTING if 10 <= k < 23 else s for k, s in enumerate(seen.states))
    error = np.where(np.arange(40) == 25, 0.4, 0.02)
    verdict = judge_outage(replace(seen, states=states, error=error))
    assert verdict.back == pytest.approx(3 / FRAME_RATE_HZ) and verdict.after == 0.4
    assert judge_outage(replace(seen, states=(*seen.states[:10], *(COASTING,) * 30))).back == np.inf


def test_the_table_has_a_line_for_each_kind_and_the_figures_count_what_is_late() -> None:
    good = judge_outage(watched())
    bad = replace(good, flagged=0.15, back=np.inf, after=np.inf, silent=True)
    lines = outage_table([(OutageKind.DEAD, good), (OutageKind.BLUR, bad)]).splitlines()
    assert [line.split()[0] for line in lines] == ["kind", "dead", "blur", "all"]
    values = {f.what: f.value for f in outage_figures([good, bad])}
    late = ("silent losses", "flagged after more than 100 ms", "back after more than 200 ms")
    assert [values[name] for name in late] == [1, 1, 1]


def test_every_outage_falls_to_one_scene_and_seeds_differ() -> None:
    jobs = scene_jobs(200, 2, 3)
    assert sum(len(kinds) for _, kinds in jobs) == 200 and len({seed for seed, _ in jobs}) == len(jobs) == 4
    counts = [sum(kinds.count(k) for _, kinds in jobs) for k in OutageKind]
    assert max(counts) - min(counts) <= 1


def picture(seed: int) -> Image:
    return np.asarray(np.random.default_rng(seed).integers(20, 200, (180, 320)), np.uint8)


def spoilt(kind: OutageKind, cameras: tuple[int, ...] = (1,), bump: np.ndarray | None = None) -> list[Image | None]:
    outage = Outage(kind, cameras, 1.0, 3.0, 0.7, np.eye(4) if bump is None else bump, 5)
    images, last = [picture(c) for c in range(3)], [picture(10 + c) for c in range(3)]
    return Spoiler(RIG, EXTENT)(outage, 2.0, images, last, BASE_FROM_REST)


@pytest.mark.parametrize("kind", list(OutageKind))
def test_only_the_cameras_struck_change(kind: OutageKind) -> None:
    cameras = (0, 2) if kind is OutageKind.SWAPPED else (1,)
    bump = se3.exp(np.array([0.01, 0, 0, 0, 0, 0]))
    for c, image in enumerate(spoilt(kind, cameras, bump)):
        same = image is not None and np.array_equal(image, picture(c))
        assert same == (c not in cameras)


def test_frozen_swapped_and_dead_cameras_deliver_what_their_names_say() -> None:
    frozen, dead, swapped = spoilt(OutageKind.FROZEN)[1], spoilt(OutageKind.DEAD)[1], spoilt(OutageKind.SWAPPED, (0, 1))
    assert dead is None and frozen is not None and np.array_equal(frozen, picture(11))
    assert all(i is not None and np.array_equal(i, picture(c)) for i, c in zip(swapped, (1, 0, 2), strict=True))


def test_a_camera_that_was_not_bumped_sees_the_same() -> None:
    image = spoilt(OutageKind.BUMPED)[1]
    assert image is not None and np.abs(image.astype(int) - picture(1)).max() <= 2


def test_a_turned_camera_sees_all_shifted_by_focal_length_times_angle() -> None:
    images = [np.zeros((180, 320), np.uint8) for _ in range(3)]
    images[1][88:93, 158:163] = 200
    outage = Outage(OutageKind.BUMPED, (1,), 1.0, 3.0, 0.7, se3.exp(np.array([0, 0.05, 0, 0, 0, 0])), 5)
    moved = Spoiler(RIG, EXTENT)(outage, 2.0, images, images, BASE_FROM_REST)[1]
    columns = np.arange(320) @ moved.sum(0) / moved.sum()
    assert columns - 160 == pytest.approx(-0.05 * 280 * 1.01, abs=0.3)


def test_draws_are_the_same_again_and_within_their_limits() -> None:
    for kind in OutageKind:
        for seed in range(20):
            a, b = (draw_outage(kind, RIG, 1.0, np.random.default_rng(seed)) for _ in range(2))
            assert (a.cameras, a.end, a.strength, a.seed) == (b.cameras, b.end, b.strength, b.seed)
            assert 0 < a.end - a.start <= 5 and 1 <= len(a.cameras) <= 3 and set(a.cameras) <= {0, 1, 2}


@pytest.fixture(scope="module")
def stretch() -> TrackedStretch:
    begun = TrackedStretch(make_pictures(3, 24, arc_rig(size=(480, 270), focal=420.0)), 3)
    assert begun.begin()
    return begun


@pytest.mark.parametrize("kind", [*(kind for kind in OutageKind if kind not in LIKE), *slowly(*LIKE)])
def test_the_tracker_is_never_lost_in_silence_and_comes_back(stretch: TrackedStretch, kind: OutageKind) -> None:
    seen = stretch.outage(kind, longest=0.6)
    verdict = judge_outage(seen)
    assert not verdict.silent and not verdict.beyond
    assert np.isnan(verdict.flagged) or verdict.flagged <= 0.1
    assert verdict.back <= 0.2 and verdict.after < 0.2
    if kind.blinds:
        named = " ".join(seen.reasons)
        assert any(f"cam_{c}" in named for c in seen.outage.cameras)


def learned(offsets: tuple[float, float, float], seconds: float) -> CameraErrors:
    """After following a world whose cameras are `offsets` late, s."""
    return run_skewed(offsets, seconds).cameras


@pytest.mark.parametrize("offsets", [(0.016, 0.0, -0.016), *slowly((0.0, 0.0, 0.0), (0.002, -0.009, 0.013))])
def test_offsets_are_found_to_two_milliseconds_in_two_seconds(offsets: tuple[float, float, float]) -> None:
    cameras = learned(offsets, 2.0)
    apart = cameras.offset - (np.array(offsets) - np.mean(offsets))
    assert (np.abs(apart) < 2e-3).all() and (np.abs(apart) < 4 * cameras.offset_sigma).all()


def test_cameras_in_step_with_a_steady_clock_are_known_to_be() -> None:
    assert learned((0, 0, 0), 4.0).delays.sigma < 0.002


def test_a_surface_at_rest_teaches_nothing_of_the_offsets() -> None:
    estimator = begun(lambda stamp: lively(0.0))
    before = estimator.cameras.offset_sigma
    for t in stamps(2.0):
        step(estimator, look(lambda stamp: lively(0.0), float(t), 6, delays=(0.016, 0.0, -0.016)))
    assert (estimator.cameras.offset_sigma > 0.99 * before).all()
    assert (estimator.cameras.offset == 0).all()


def noisy_fit(rng: np.random.Generator, effects: Array, sigma: float) -> SharedFit:
    """A fit that shows effects (9,) as they are but for noise, the delays known to `sigma` s and shifts to 0.03 px."""
    root = (np.eye(9) + 0.3 * rng.normal(size=(9, 9))) / np.repeat([sigma, 0.03], [3, 6])[:, None]
    information = root @ root.T
    return SharedFit(information, information @ effects + np.linalg.cholesky(information) @ rng.normal(size=9))


def offsets_learned(seed: int, offsets: Array, sigma: float, signal_share: float) -> CameraErrors:
    """After 40 fits of cameras that are `offsets` (3,) late, s, and a millisecond of jitter."""
    rng, cameras = np.random.default_rng(seed), CameraErrors(3)
    for _ in range(40):
        late = offsets - cameras.offset + rng.normal(0, 1e-3, 3)
        fit = noisy_fit(rng, np.concatenate([late, rng.normal(0, 0.02, 6)]), sigma)
        cameras.learn(fit, 1 / 30, signal_share)
    return cameras


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.79), st.floats(5e-4, 0.05))
def test_of_a_velocity_that_is_noise_nothing_is_learned_of_the_clocks(seed: int, share: float, sigma: float) -> None:
    cameras, before = offsets_learned(seed, np.array([0.02, -0.03, 0.01]), sigma, share), CameraErrors(3)
    assert (cameras.offset == 0).all() and (cameras.offset_sigma >= before.offset_sigma).all()


@pytest.mark.parametrize("sigma", [0.002, 0.01])
def test_what_chance_explains_moves_no_clock_and_what_it_does_not_is_found(sigma: float) -> None:
    none, late = np.zeros(3), np.array([0.02, -0.03, 0.01])
    chance = np.array(
        [np.abs(c.offset / c.offset_sigma) for c in (offsets_learned(s, none, sigma, 1) for s in range(20))]
    )
    assert (chance == 0).mean() > 0.7 and chance.mean() < 0.2
    for cameras in (offsets_learned(seed, late, sigma, 1) for seed in range(5)):
        assert (np.abs(cameras.offset - late) < 4 * cameras.offset_sigma).all()
        assert (cameras.offset_sigma < 0.5 * CameraErrors(3).offset_sigma).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_lens_that_is_off_is_not_taken_for_a_late_clock(seed: int) -> None:
    offsets = (0.0, 0.016, -0.016)
    world = synthetic_world("breathing", 20.0, offsets=offsets, calibration=0.3, seed=seed)
    seen = world.observations()
    first = next(seen)
    follower = Follower(world.rig, first, first_map(world, first, "seen"), refine=True)
    for observations in seen:
        follower.idle()
        follower(observations)
    assert (np.abs(follower.estimator.cameras.offset - offsets) < 2e-3).all()


def test_what_all_clocks_have_in_common_is_never_made_up() -> None:
    cameras = learned((0.01, 0.01, 0.01), 2.0)
    assert abs(cameras.offset.sum()) < 1e-12 and (np.abs(cameras.offset) < 1e-3).all()


@given(st.integers(0, 1000))
def test_offsets_do_not_depend_on_the_order_of_the_cameras(seed: int) -> None:
    rng = np.random.default_rng(seed)
    order = rng.permutation(3)
    place = np.concatenate([order, 3 + order, 6 + order])
    root = rng.normal(size=(9, 9)) * 30
    information, pull = root @ root.T, rng.normal(size=9)
    one, other = CameraErrors(3), CameraErrors(3)
    one.learn(SharedFit(information, pull), 0.03)
    other.learn(SharedFit(information[np.ix_(place, place)], pull[place]), 0.03)
    np.testing.assert_allclose(one.offset[order], other.offset, atol=1e-9)


@pytest.mark.parametrize("sigma", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("noise", [0.1, 1.0])
def test_a_variance_is_learned_through_noise(sigma: float, noise: float) -> None:
    rng, variance = np.random.default_rng(1), VarianceEstimate(1.0, 0.01, 0.05)
    for _ in range(2000):
        variance.take(sigma * rng.normal() + noise * rng.normal(), noise**2)
    assert 0.6 * sigma < np.sqrt(variance.value) < 1.6 * sigma


def test_values_that_tell_nothing_change_nothing() -> None:
    variance = VarianceEstimate(1.0, 0.01, 0.05)
    before = variance.value
    for _ in range(100):
        variance.take(3.0, 1e9)
    assert variance.value == pytest.approx(before, rel=1e-3)


def test_clocks_go_back_to_what_was_known_some_seconds_ago() -> None:
    early, late = learned((0.0, 0.01, -0.01), 1.0), learned((0.0, 0.05, -0.05), 1.0)
    clocks = CameraErrorHistory(early)
    clocks.keep(0.0, early)
    clocks.keep(1.0, late)  # what a deformation is taken for
    assert np.array_equal(clocks.before.offset, early.offset)
    clocks.keep(2.5, late)
    assert np.array_equal(clocks.before.offset, early.offset)
    clocks.keep(5.0, late)
    assert np.array_equal(clocks.before.offset, late.offset)


ALLOWED = np.full(3, 0.25)


def test_images_are_doubted_only_where_every_camera_that_counts_stands_off() -> None:
    health = CameraHealth(["a", "b", "c"])
    off = np.array([1.5, 1.0, 2.0])
    assert np.array_equal(health.blur_offsets(off, ALLOWED, ()), off)
    assert not health.blur_offsets(np.array([1.5, 0.1, 2.0]), ALLOWED, ()).any()
    assert np.array_equal(health.blur_offsets(np.array([1.5, 0.1, np.nan]), ALLOWED, (1,)), [1.5, 0.0, 0.0])
    assert not health.blur_offsets(np.full(3, np.nan), ALLOWED, ()).any()


def test_shape_and_clocks_are_learned_only_where_two_cameras_see_about_as_much_as_usual() -> None:
    health = CameraHealth(["a", "b", "c"])
    assert health.has_usual_tracks(np.array([0, 0, 0]))  # nothing is usual yet
    for k in range(10):
        health.update(0.03 * k, np.array([100, 90, 0]), 10, np.zeros(3), np.ones(3), ())
    assert health.has_usual_tracks(np.array([40, 30, 0])) and health.has_usual_tracks(np.array([100, 28, 0]))
    assert not health.has_usual_tracks(np.array([100, 20, 0])) and not health.has_usual_tracks(np.array([20, 20, 40]))
    alone = CameraHealth(["a"])
    alone.update(0.0, np.array([50]), 10, np.zeros(1), np.ones(1), ())
    assert alone.has_usual_tracks(np.array([20])) and not alone.has_usual_tracks(np.array([10]))


def test_images_that_all_stand_off_are_said_to() -> None:
    health = CameraHealth(["a", "b"])
    for off, said in ((np.array([0.1, 0.9]), ""), (np.array([0.9, 0.8]), "no camera shows the surface as usual")):
        health.update(0.0, np.array([50, 50]), 10, off, np.full(2, 0.25), ())
        assert health.trouble(0.0) == said


def test_a_lost_surface_forgives_all_cameras() -> None:
    health = CameraHealth(["a", "b"])
    health.update(0.0, np.array([50, 0]), 10, np.array([0.1, 5.0]), np.full(2, 0.25), {1})
    assert health.left_out == {1}
    health.left_out = frozenset()
    assert not health.left_out
