"""The sliding window finds the motion, knows its error, outlives bad data; the acceleration's density is estimated."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.online.window import (
    PRIOR_REVISION,
    WINDOW_LAG_S,
    AccelerationPsd,
    MeasuredPose,
    Smoother,
    WindowEstimate,
)
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST
from tests.rendered_sets import Motion, breathing

NOISE = np.array([2e-3] * 3 + [0.03] * 3)  # rad, mm: what one frame set is worth
COVARIANCE = np.diag(NOISE**2)


def measure(motion: Motion, stamps: Array, seed: int, noise: Array = NOISE) -> list[MeasuredPose]:
    draw = np.random.default_rng(seed)
    return [MeasuredPose(float(t), motion(float(t)) @ se3.exp(noise * draw.normal(size=6)), COVARIANCE) for t in stamps]


def run(measured: list[MeasuredPose], smoother: Smoother | None = None) -> list[WindowEstimate]:
    smoother = smoother or Smoother()
    return [smoother.add(m) for m in measured]


def turning(twist: Array) -> Motion:
    return lambda stamp: BASE_FROM_REST @ se3.exp(twist * stamp)


def nees(windows: list[WindowEstimate], motion: Motion, skip: int = 15) -> float:
    """Mean normalised squared pose error, 1 for an honest covariance."""
    values = []
    for w in windows[skip:]:
        e = se3.log(se3.inverse(w.pose) @ motion(w.stamp))
        values.append(e @ np.linalg.solve(w.covariance, e) / 6)
    return float(np.mean(values))


@given(st.integers(0, 10_000))
@settings(max_examples=12)
def test_the_twist_of_a_constant_motion_is_found(seed: int) -> None:
    twist = np.random.default_rng(seed).normal(size=6) * [0.2, 0.2, 0.2, 15, 15, 15]
    motion = turning(twist)
    newest = run(measure(motion, np.arange(20) / 30, seed, 0 * NOISE))[-1]
    assert np.abs(newest.pose - motion(newest.stamp)).max() < 1e-3
    assert np.allclose(newest.twist, twist, atol=5e-3 * (1 + np.abs(twist)))


def test_the_twist_of_a_noisy_motion_is_found_within_what_it_claims() -> None:
    twist = np.array([0.1, -0.05, 0.2, 8.0, -3.0, 5.0])
    values = []
    for seed in range(12):
        newest = run(measure(turning(twist), np.arange(25) / 30, seed))[-1]
        e = newest.twist - twist
        values.append(e @ np.linalg.solve(newest.twist_covariance, e) / 6)
    assert np.mean(values) < 1.3


@pytest.mark.parametrize("rate", [6.0, 30.0])
def test_the_covariance_is_as_wide_as_the_errors(rate: float) -> None:
    values = [nees(run(measure(breathing, np.arange(90) / rate, s)), breathing) for s in range(6)]
    assert 0.7 < np.mean(values) < 1.3


def test_hindsight_revises_twists_as_they_claim_where_the_motion_is_as_the_prior_has_it() -> None:
    """Least where a surface at rest is taken for a livelier one, as `AccelerationPsd` does to be ready for a jerk."""

    def revision(positions: Array) -> float:
        stamps = np.arange(len(positions)) * DT
        spread = np.diag(LIVELINESS_NOISE**2)
        poses = (MeasuredPose(t, se3.exp(p), spread) for t, p in zip(stamps.tolist(), positions, strict=True))
        return float(np.mean(run(list(poses))[-1].revision))

    white = revision(wander(np.array([1e-3] * 3 + [10.0] * 3), 300, 1))
    assert 0.6 * PRIOR_REVISION < white < 1.4 * PRIOR_REVISION
    assert revision(wander(np.zeros(6), 300, 2)) < 0.6 * white


def test_smoothing_a_calm_motion_never_costs_accuracy() -> None:
    def error(poses: list[Array]) -> float:
        e = se3.log(se3.inverse(np.stack(poses)) @ np.stack([breathing(m.stamp) for m in measured]))
        return float(np.sqrt(np.mean((e[15:] / NOISE) ** 2)))

    for seed in range(4):
        measured = measure(breathing, np.arange(90) / 30, seed)
        assert error([w.pose for w in run(measured)]) < error([m.pose for m in measured])


def test_a_waving_hand_is_not_dragged() -> None:
    """Half a metre a second, turned round within one frame: the window may not lag by more than the frame's noise."""

    def waving(stamp: float) -> Array:
        return BASE_FROM_REST @ se3.exp(np.array([0, 0.3 * np.sin(8 * stamp), 0, 60 * np.sin(8 * stamp), 0, 0]))

    windows = run(measure(waving, np.arange(60) / 6, 3))
    off = [se3.log(se3.inverse(w.pose) @ waving(w.stamp)) / NOISE for w in windows]
    assert np.sqrt(np.mean(np.square(off))) < 1.3
    calm = run(measure(breathing, np.arange(60) / 6, 3))[-1].acceleration_psd
    livelier = windows[-1].acceleration_psd > 10 * calm
    assert livelier[:3].any() and livelier[3:].any()


@settings(max_examples=10)
@given(st.integers(0, 10_000), st.floats(np.log(20), np.log(2000)))
def test_however_far_a_surface_at_rest_jumps_the_window_is_with_it_at_once(seed: int, sigmas: float) -> None:
    way = np.random.default_rng(seed).normal(size=6)
    way *= np.exp(sigmas) * NOISE / np.linalg.norm(way)

    def jumping(stamp: float) -> Array:
        return BASE_FROM_REST @ se3.exp(way * (stamp > 0.99))

    windows = run(measure(jumping, np.arange(36) / 30, seed))
    off = [np.linalg.norm(se3.log(se3.inverse(w.pose) @ jumping(w.stamp)) / NOISE) for w in windows]
    assert max(off) < 8  # sigmas of one measurement, in six directions; measured 6.2, at rest 4


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_what_is_not_finite_never_reaches_the_window(wrong: float) -> None:
    smoother = Smoother()
    first = run(measure(breathing, np.arange(5) / 30, 1), smoother)[-1]
    for pose, covariance in [(BASE_FROM_REST + wrong, COVARIANCE), (BASE_FROM_REST, COVARIANCE + wrong)]:
        with pytest.raises(AssertionError):
            smoother.add(MeasuredPose(1.0, pose, covariance))
    assert smoother.newest is first and smoother.rebuilds == 0
    assert smoother.add(measure(breathing, np.array([6 / 30]), 1)[0]).stamp == 6 / 30


@pytest.mark.parametrize("value", [-1.0, 0.0])
def test_a_covariance_that_is_none_does_not_break_what_comes_after(value: float) -> None:
    smoother, measured = Smoother(), measure(breathing, np.arange(30) / 30, 1)
    run(measured[:10], smoother)
    smoother.add(MeasuredPose(measured[10].stamp, measured[10].pose, value * COVARIANCE))
    windows = run(measured[11:], smoother)
    assert np.abs(windows[-1].pose - run(measured)[-1].pose).max() < 0.02
    assert 0.5 < nees(windows, breathing, skip=0) < 2.0


def broken(smoother: Smoother) -> None:
    """Let GTSAM throw: its smoother cannot be used any more."""
    graph, nowhere = gtsam.NonlinearFactorGraph(), gtsam.Pose3(np.full((4, 4), np.nan))
    one = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
    graph.add(gtsam.PriorFactorPose3(gtsam.symbol("x", smoother._key - 1), nowhere, one))
    with pytest.raises(RuntimeError):
        smoother._window.update(graph, gtsam.Values(), {})


def test_a_window_that_has_thrown_is_rebuilt_where_it_was_and_counted() -> None:
    measured = measure(breathing, np.arange(40) / 30, 1)
    smoother, whole = Smoother(), run(measured)
    run(measured[:20], smoother)
    broken(smoother)
    after = run(measured[20:], smoother)
    assert smoother.rebuilds == 1
    assert np.abs(after[0].twist - whole[20].twist).max() < 0.7  # mm/s; it is 2.2
    assert np.diag(after[0].covariance).max() < 1.1 * np.diag(whole[20].covariance).max()
    assert np.abs(after[-1].pose - whole[-1].pose).max() < 5e-3
    broken(smoother)
    smoother.add(measure(breathing, np.array([41 / 30]), 1)[0])
    assert smoother.rebuilds == 2


def test_a_gap_longer_than_the_window_begins_a_new_one() -> None:
    smoother = Smoother()
    run(measure(breathing, np.arange(20) / 30, 1), smoother)
    after = measure(breathing, 19 / 30 + WINDOW_LAG_S + 0.5 + np.arange(20) / 30, 2)
    windows = run(after, smoother)
    alone = run(after)
    assert smoother.rebuilds == 0
    assert np.allclose(windows[0].pose, after[0].pose, atol=1e-9)
    assert np.allclose(windows[0].covariance, COVARIANCE, rtol=1e-3)
    assert np.abs(windows[-1].pose - alone[-1].pose).max() < 0.02


def test_a_gap_shorter_than_the_window_is_bridged() -> None:
    motion = turning(np.array([0, 0, 0.1, 5.0, 0, 0]))
    stamps, smoother = np.r_[np.arange(20), np.arange(32, 40)] / 30, Smoother()
    assert np.allclose(run(measure(motion, stamps, 5), smoother)[20].twist[3], 5.0, atol=0.5)
    assert smoother.rebuilds == 0


def test_after_a_reset_nothing_is_left() -> None:
    smoother = Smoother()
    run(measure(breathing, np.arange(20) / 30, 1), smoother)
    smoother.reset()
    assert smoother.newest is None
    later = measure(breathing, np.arange(3) / 30, 2)  # stamps that lie before the forgotten ones
    assert np.allclose(smoother.add(later[0]).pose, later[0].pose)


def test_two_runs_give_the_same_bits() -> None:
    measured = measure(breathing, np.arange(60) / 30, 7)
    for a, b in zip(run(measured), run(measured), strict=True):
        assert a.pose.tobytes() == b.pose.tobytes() and a.covariance.tobytes() == b.covariance.tobytes()
        assert a.twist.tobytes() == b.twist.tobytes() and a.twist_covariance.tobytes() == b.twist_covariance.tobytes()


def test_the_window_holds_as_much_after_15_seconds_as_after_one() -> None:
    smoother, sizes = Smoother(), []
    for m in measure(breathing, np.arange(450) / 30, 8):
        smoother.add(m)
        sizes.append((smoother._window.getFactors().size(), len(smoother._window.timestamps())))
    factors, keys = np.array(sizes).T
    assert factors[60:].max() <= factors[30:60].max() and keys[60:].max() <= keys[30:60].max()
    assert keys.max() <= 2 * (WINDOW_LAG_S * 30 + 2)
    assert smoother.rebuilds == 0


DT = 1 / 30
LIVELINESS_NOISE = np.array([1e-3] * 3 + [0.02] * 3)  # rad, mm


def wander(psd: Array, count: int, seed: int) -> Array:
    """Positions (count, 6) of a body under white-noise acceleration of density `psd` (6,)."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]]))
    state, out = np.zeros((2, 6)), np.zeros((count, 6))
    for k in range(count):
        state = np.stack([state[0] + DT * state[1], state[1]]) + (root @ rng.normal(size=(2, 6))) * np.sqrt(psd)
        out[k] = state[0] + LIVELINESS_NOISE * rng.normal(size=6)
    return out


def follow(lively: AccelerationPsd, positions: Array) -> AccelerationPsd:
    for moved in np.diff(positions, axis=0):
        lively.add(moved, DT, LIVELINESS_NOISE**2)
    return lively


@pytest.mark.parametrize("rotation", [1e-4, 1e-2, 1.0])
@pytest.mark.parametrize("translation", [1.0, 100.0, 1e4])
def test_the_density_of_a_motion_is_found_to_a_factor_of_four(rotation: float, translation: float) -> None:
    true = np.array([rotation] * 3 + [translation] * 3)
    found = follow(AccelerationPsd(), wander(true, 300, 1)).psd
    assert (np.abs(np.log(found / true)) < np.log(4)).all()


def test_a_surface_at_rest_is_found_to_be() -> None:
    found = follow(AccelerationPsd(), wander(np.zeros(6), 300, 2)).psd
    assert (found[:3] < 1e-5).all() and (found[3:] < 0.3).all()


def test_it_follows_within_a_second_when_the_motion_becomes_lively() -> None:
    lively = follow(AccelerationPsd(), wander(np.array([1e-4] * 3 + [1.0] * 3), 200, 3))
    before = lively.psd
    after = follow(lively, wander(np.array([1.0] * 3 + [1e4] * 3), 30, 4)).psd
    assert (after > 100 * before).all()


def test_a_single_jerk_does_not_make_a_motion_lively() -> None:
    lively = follow(AccelerationPsd(), wander(np.array([1e-4] * 3 + [1.0] * 3), 200, 5))
    before = lively.psd
    lively.add(np.array([0.0, 0.0, 0.0, 5.0, 0.0, 0.0]), DT, LIVELINESS_NOISE**2)
    assert (lively.psd < 1e3 * before).all()
