"""Offline smoothing: laws first, then against a causal run, GTSAM and the exact truth of synthetic worlds."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3, smooth
from estimation.batch.normal_equations import condense
from estimation.batch.smoothed import (
    REFINED_PRIOR,
    STATE_DOF,
    CalibrationPrior,
    Smoothed,
    States,
    jerk_covariance,
    prior_factors,
    transition,
)
from estimation.batch.solve import BlockTridiagonal, Elimination, NormalEquations, PassProgress
from estimation.errors import InputError
from estimation.observations import Observations, no_observations
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.follow import follow
from estimation.synthetic.world import World, synthetic_world
from tests.slow_cases import slowly

FEW = 40  # landmarks


@cache
def smoothed(movement: str, seconds: float = 1.2, seed: int = 0, **conditions: float) -> tuple[Smoothed, World]:
    world = synthetic_world(movement, seconds=seconds, count=FEW, seed=seed, **conditions)
    return smooth(world.rig, list(world)), world


def aligned(poses: Array, truth: Array) -> float:
    """RMS distance, mm, of the origin after the constant that fits best."""
    constant = se3.inverse(truth[0]) @ poses[0]
    for _ in range(4):
        constant = constant @ se3.exp(-se3.log(se3.inverse(poses) @ truth @ constant).mean(0))
    return float(np.sqrt((se3.log(se3.inverse(poses) @ truth @ constant)[:, 3:] ** 2).sum(1).mean()))


@given(st.integers(0, 100), st.integers(1, 7), st.integers(0, 5))
@settings(max_examples=12)
def test_a_chain_with_a_border_is_inverted_as_a_whole(seed: int, count: int, size: int) -> None:
    draw = np.random.default_rng(seed)
    n = STATE_DOF * count
    whole = np.zeros((n + size, n + size))
    for k in range(count):  # each factor touches two neighbours and the border
        rows = draw.normal(size=(3 * STATE_DOF, n + size))
        rows[:, : STATE_DOF * k] = rows[:, STATE_DOF * (k + 2) : n] = 0
        whole += rows.T @ rows
    right = draw.normal(size=n)
    blocks = whole[:n, :n].reshape(count, STATE_DOF, count, STATE_DOF)
    own = np.stack([blocks[k, :, k] for k in range(count)])
    ties = np.zeros_like(own)
    for k in range(count - 1):
        ties[k] = blocks[k, :, k + 1]
    border = whole[:n, n:].reshape(count, STATE_DOF, size)
    chain, gradient = BlockTridiagonal(count), right.reshape(count, STATE_DOF)
    cut = count // 2
    entry = np.zeros((0, 0))
    roots = [chain.eliminate_states(own[:cut], ties[:cut], border[:cut], gradient[:cut])] if cut else []
    entry = chain.carried_border if cut else entry
    roots.append(chain.eliminate_states(own[cut:], ties[cut:], border[cut:], gradient[cut:]))
    inverse = np.linalg.inv(whole[:n, :n])
    covariance, after = chain.covariances()
    expected = inverse.reshape(count, STATE_DOF, count, STATE_DOF)
    for k in range(count):
        assert np.allclose(covariance[k], expected[k, :, k], rtol=1e-6, atol=1e-9)
    for k in range(count - 1):
        assert np.allclose(after[k], expected[k, :, k + 1], rtol=1e-6, atol=1e-9)
    assert np.allclose(chain.steps().ravel(), -inverse @ right, rtol=1e-6, atol=1e-9)
    border_left = np.concatenate(roots)
    schur = border.reshape(n, size).T @ inverse @ border.reshape(n, size)
    assert np.allclose(border_left.T @ border_left, schur, rtol=1e-6, atol=1e-9)
    again = chain.roots_again((cut, count), border[cut:], entry)
    assert np.allclose(again, roots[-1])
    response = dict(chain.responses((cut, count), again, np.zeros((STATE_DOF, size))))
    for k, found in response.items():
        assert np.allclose(found, -(inverse @ border.reshape(n, size)).reshape(count, STATE_DOF, size)[k], atol=1e-7)


@given(st.integers(0, 1000))
@settings(max_examples=15)
def test_the_prior_is_differentiated_exactly(seed: int) -> None:
    draw = np.random.default_rng(seed)
    poses = se3.exp(draw.normal(size=(3, 6)) * [0.1, 0.1, 0.1, 5, 5, 5])
    states = States(poses, draw.normal(size=(3, 6)), draw.normal(size=(3, 6)))
    stamps = np.array([0.0, 0.04, 0.1])
    at = prior_factors(states, stamps)
    for k in range(STATE_DOF):
        step = np.zeros((3, STATE_DOF))
        step[1, k] = 1e-6
        change = (
            prior_factors(states.retract(step), stamps).residual - prior_factors(states.retract(-step), stamps).residual
        ) / 2e-6
        assert np.allclose(change[0], at.after[0, :, k], atol=2e-5)
        assert np.allclose(change[1], at.before[1, :, k], atol=2e-5)


def test_a_constant_twist_costs_nothing_and_time_may_be_cut_anywhere() -> None:
    twist = np.array([0.3, -0.2, 0.5, 20.0, -10.0, 5.0])
    stamps = np.array([0.0, 0.05, 0.2])
    states = States(se3.exp(twist * stamps[:, None]), np.tile(twist, (3, 1)), np.zeros((3, 6)))
    assert np.abs(prior_factors(states, stamps).residual).max() < 1e-9
    step = transition(np.array(0.3))
    both = step @ jerk_covariance(np.array(0.2)) @ step.T + jerk_covariance(np.array(0.3))
    assert np.allclose(both, jerk_covariance(np.array(0.5)))


def test_errors_are_as_large_as_is_claimed() -> None:
    """On a map with a known error: without one, all errors of a run hold those of its first pose, a single draw."""
    values = []
    for movement in ("still", "breathing", "lively"):
        for seed in range(2):
            world = synthetic_world(movement, seconds=1.0, count=FEW, seed=seed, map_error=0.03)
            result = smooth(world.rig, list(world), world.map)
            off = se3.log(se3.inverse(result.states.poses) @ world.truth.base_from_surface)
            values.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(result.covariance[:, :6, :6]), off).mean() / 6)
    assert 0.7 < np.mean(values) < 1.4


@pytest.mark.parametrize("movement", ["breathing", *slowly("steps", "still")])
def test_it_is_better_than_a_causal_run(movement: str) -> None:
    ours, causal = [], []
    for seed in range(2):
        result, world = smoothed(movement, 1.5, seed)
        run = follow(world, "seen")
        poses = np.stack([pose.base_from_surface for pose in run.poses])
        rows = np.searchsorted(world.stamps, [pose.stamp - 1e-6 for pose in run.poses])
        truth = world.truth.base_from_surface[rows]
        ours.append(aligned(result.states.poses[rows], truth))
        causal.append(aligned(poses, truth))
    assert np.mean(ours) < 0.9 * np.mean(causal)


def test_clocks_are_found_with_their_doubt() -> None:
    given = np.array([0.016, -0.006, -0.010])
    world = synthetic_world("lively", seconds=2.0, count=FEW, offsets=tuple(given), seed=2)
    result = smooth(world.rig, list(world))
    off = result.offsets - (given - given.mean())
    assert np.abs(off).max() < 5e-4 and np.abs(off / result.offset_sigma).max() < 4
    assert [c.clock_offset for c in result.rig.cameras] == pytest.approx(result.offsets.tolist())


def test_a_camera_without_tracks_is_told_no_clock_and_takes_no_part_in_the_mean() -> None:
    given = np.array([0.016, -0.006, 0.0])
    world = synthetic_world("lively", seconds=1.0, count=FEW, offsets=tuple(given), seed=2)
    result = smooth(world.rig, [seen.select(seen.camera != 2) for seen in world])
    off = result.offsets[:2] - (given[:2] - given[:2].mean())
    assert np.abs(off).max() < 1e-3 and result.offsets[2] == pytest.approx(0, abs=1e-6)
    assert result.offset_sigma[2] == pytest.approx(CalibrationPrior().clock, rel=1e-3)


def test_late_cameras_and_an_imperfect_calibration_cost_less_than_50_micrometres() -> None:
    world = synthetic_world("lively", seconds=3.0, offsets=(0.016, 0.0, -0.016), calibration=0.3, seed=4)
    result = smooth(world.rig, list(world), prior=REFINED_PRIOR)
    assert aligned(result.states.poses, world.truth.base_from_surface) < 0.05


@pytest.mark.parametrize(
    "conditions",
    [{"outliers": 0.2}, {"coherent": 0.1}, {"dropouts": 0.3}, {"outages": ((0.4, 0.8),)}, {"churn": 1.0}],
    ids=lambda c: next(iter(c)),
)
def test_what_goes_wrong_with_tracks_is_outlived(conditions: dict[str, float]) -> None:
    result, world = smoothed("breathing", **conditions)
    assert aligned(result.states.poses, world.truth.base_from_surface) < 0.06
    assert len(result) == len(world)


def test_time_may_run_backwards() -> None:
    world = synthetic_world("breathing", seconds=1.0, count=FEW, map_error=0.03, seed=3)
    seen = list(world)
    there = smooth(world.rig, seen, world.map)
    back = smooth(world.rig, [replace(s, stamp=-s.stamp) for s in reversed(seen)], world.map)
    apart = se3.log(se3.inverse(there.states.poses) @ back.states.poses[::-1])
    sigma = np.sqrt(np.diagonal(there.covariance[:, :6, :6], axis1=1, axis2=2))
    assert np.abs(apart / sigma).max() < 0.3  # of what cannot be known
    assert np.allclose(there.states.twists[5:-5], -back.states.twists[::-1][5:-5], atol=0.3)


@given(st.integers(0, 1000))
@settings(max_examples=1)
def test_another_base_gives_the_same_poses_in_it(seed: int) -> None:
    world = synthetic_world("breathing", seconds=0.6, count=FEW, seed=1)
    new_from_base = se3.exp(np.random.default_rng(seed).normal(size=6) * [1, 1, 1, 300, 300, 300])
    moved = Rig(tuple(replace(c, base_from_camera=new_from_base @ c.base_from_camera) for c in world.rig.cameras))
    seen = list(world)
    start = world.truth
    first = smooth(world.rig, seen, start=start)
    second = smooth(moved, seen, start=replace(start, base_from_surface=new_from_base @ start.base_from_surface))
    assert np.allclose(new_from_base @ first.states.poses, second.states.poses, atol=1e-4)
    assert np.allclose(first.covariance, second.covariance, rtol=0.02, atol=1e-6)


def test_the_same_observations_give_the_same_bits() -> None:
    world = synthetic_world("breathing", seconds=0.5, count=FEW)
    first, second = (smooth(world.rig, list(world)) for _ in range(2))
    assert (first.states.poses == second.states.poses).all() and (first.covariance == second.covariance).all()


def test_what_comes_before_the_first_track_and_after_the_last_changes_nothing() -> None:
    world = synthetic_world("lively", 1.0, count=30, seed=1)
    seen = list(world)
    before = [no_observations(seen[0].stamp - 0.17 * k) for k in range(70, 0, -1)]
    after = [no_observations(seen[-1].stamp + 0.17 * k) for k in range(1, 70)]
    within, whole = smooth(world.rig, seen), smooth(world.rig, [*before, *seen, *after])
    assert (whole.stamps == within.stamps).all()
    assert whole.states.poses.tobytes() == within.states.poses.tobytes()


def test_any_instant_between_is_told_as_well() -> None:
    result, world = smoothed("breathing", 2.0, 0)
    there = result.at(result.stamps)
    assert np.allclose(there.base_from_surface, result.states.poses, atol=1e-9)
    assert np.allclose(there.covariance, result.covariance[:, :6, :6], rtol=1e-4, atol=1e-10)
    assert np.allclose(there.twist, result.states.twists, atol=1e-7)
    times = np.linspace(result.stamps[0], result.stamps[-1], 501)
    between = result.at(times)
    truth = world.base_from_surface(times)
    assert aligned(between.base_from_surface, truth) < 1.3 * aligned(result.states.poses, world.truth.base_from_surface)
    off = between.twist - world.twists(times)
    sigma = np.sqrt(np.diagonal(between.twist_covariance, axis1=1, axis2=2))
    assert 0.5 < np.sqrt(np.mean((off / sigma) ** 2)) < 1.6
    with pytest.raises(InputError, match="times"):
        result.at(np.array([result.stamps[-1] + 0.1]))


def test_gtsam_finds_no_better_landmarks_for_these_poses() -> None:
    """Its own factors, robust loss and optimiser, from the result on: nothing moves by a tenth of a sigma."""
    result, world = smoothed("breathing", 0.6, 1)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    loss = gtsam.noiseModel.mEstimator.GemanMcClure.Create(3.0)
    rows = {int(track): row for row, track in enumerate(result.tracks)}
    for row, point in enumerate(result.map.points):
        values.insert(gtsam.symbol("l", row), point)
    lenses = [gtsam.Cal3_S2(m[0, 0], m[1, 1], 0, m[0, 2], m[1, 2]) for m in result.rig.matrices]
    late = result.offsets[:, None]
    for k, seen in enumerate(world):
        ahead = late * result.states.twists[k] + late**2 / 2 * result.states.accelerations[k]
        there = result.states.poses[k] @ se3.exp(ahead)
        for c, pose in enumerate(there):
            key = gtsam.symbol(chr(ord("a") + c), k)
            values.insert(key, gtsam.Pose3(se3.inverse(pose)))
            graph.add(gtsam.NonlinearEqualityPose3(key, values.atPose3(key)))
        for c, track, pixel, sigma in zip(seen.camera, seen.track, seen.pixels, seen.sigma, strict=True):
            noise = gtsam.noiseModel.Isotropic.Sigma(2, float(sigma * result.statistics.residual_scale[c]))
            graph.add(
                gtsam.GenericProjectionFactorCal3_S2(
                    pixel,
                    gtsam.noiseModel.Robust.Create(loss, noise),
                    gtsam.symbol(chr(ord("a") + c), k),
                    gtsam.symbol("l", rows[int(track)]),
                    lenses[c],
                    gtsam.Pose3(result.rig.cameras[c].base_from_camera),
                )
            )
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    found = np.stack([solved.atPoint3(gtsam.symbol("l", row)) for row in rows.values()])
    sigma = np.sqrt(np.diag(result.map.covariance)).reshape(-1, 3)
    assert np.abs((found - result.map.points) / sigma).max() < 0.1


def test_gtsam_solves_the_same_condensed_factors_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps and marginals of states, landmarks and clocks; its dense factors of the shared take too much memory."""
    passes: list[tuple[NormalEquations, Elimination]] = []

    class Kept(NormalEquations):
        def eliminate(self, progress: PassProgress, step: Array | None = None) -> Elimination:
            passes.append((self, super().eliminate(progress, step)))
            return passes[-1][1]

    monkeypatch.setattr("estimation.batch.smooth.NormalEquations", Kept)
    world = synthetic_world("breathing", seconds=0.5, count=12, offsets=(0.0, 0.01, -0.01))
    result = smooth(world.rig, list(world))
    equations, done = passes[-1]
    steps, shared = gtsam_solution(equations)
    count, key = len(result.stamps), len(result.stamps)
    found = steps.optimize()
    sigma = np.sqrt(np.diag(done.shared_covariance()))
    assert found.at(key) == pytest.approx(done.shared_step(), abs=1e-6 * float(sigma.min()))
    assert np.abs(steps.marginalCovariance(key) / np.outer(sigma, sigma) - shared / np.outer(sigma, sigma)).max() < 1e-6
    again = equations.eliminate(lambda done, total: None, done.shared_step()).factor.steps()
    for k in range(count):
        scale = np.sqrt(np.diag(result.covariance[k]))
        assert (np.abs(found.at(k) - again[k]) < 1e-6 * scale).all()
        off = steps.marginalCovariance(k) - result.covariance[k]
        assert np.abs(off / np.outer(scale, scale)).max() < 1e-6


def gtsam_solution(equations: NormalEquations) -> tuple[gtsam.GaussianBayesTree, Array]:
    """The states 0 to K - 1 and, as K, the shared unknowns; their covariance (S, S) by the banded solver."""
    problem, estimate, known = equations.problem, equations.estimate, equations.known
    part, links = condense(problem, 0, len(problem.data), estimate, equations.noise), equations._motion_prior
    count, q, size = len(problem.data), len(problem.free), problem.size
    equations._add_initial_priors(0, count, part.information, part.gradient)
    graph, none = gtsam.GaussianFactorGraph(), np.zeros((size, size))
    for k in range(count):
        own = part.information[k], part.cross[k], -part.gradient[k]
        graph.add(gtsam.HessianFactor(k, count, *own, none, np.zeros(size), 0.0))
    information, pull = part.shared - part.error_roots.T @ part.error_roots, part.shared_gradient.copy()
    information[:q, :q] += known.calibration[np.ix_(problem.free, problem.free)]
    information[q:, q:] += known.map
    pull[:q] += (known.calibration @ estimate.cameras.difference(known.cameras))[problem.free]
    pull[q:] += known.map @ (estimate.points - known.points).ravel()
    graph.add(gtsam.HessianFactor(count, information, -pull, 0.0))
    unit = gtsam.noiseModel.Unit.Create(STATE_DOF)
    for k, root in enumerate(np.linalg.cholesky(equations._information)):
        before, after, off = root.T @ links.before[k], root.T @ links.after[k], -root.T @ links.residual[k]
        graph.add(gtsam.JacobianFactor(k, before, k + 1, after, off, unit))
    ordering = gtsam.Ordering()
    for k in range(count + 1):
        ordering.push_back(k)
    shared = equations.eliminate(lambda done, total: None).shared_covariance()
    return graph.eliminateMultifrontal(ordering), shared


def test_what_cannot_be_smoothed_is_said() -> None:
    world = synthetic_world("still", seconds=0.2, count=FEW)
    seen = list(world)
    with pytest.raises(InputError, match="stamps"):
        smooth(world.rig, seen[::-1])
    with pytest.raises(InputError, match="frame sets"):
        smooth(world.rig, seen[:1])
    with pytest.raises(InputError, match="two cameras"):
        smooth(world.rig, [no_observations(s.stamp) for s in seen])
    with pytest.raises(InputError, match="camera"):
        smooth(Rig(world.rig.cameras[:2]), seen)
    wrong = [Observations(s.stamp, s.camera, s.track, s.pixels, 0 * s.sigma) for s in seen]
    with pytest.raises(InputError, match="sigma"):
        smooth(world.rig, wrong)


@given(st.floats(0.0, 1e7), st.integers(2, 6000), st.sampled_from([30.0, 50.0, 60.0, 1000.0]))
@settings(max_examples=300)
def test_times_at_a_rate_lie_within_the_recording_at_any_uptime(uptime: float, sets: int, rate: float) -> None:
    recorded = replace(smoothed("breathing")[0], stamps=np.array([uptime, uptime + sets / 30.0]))
    times, (first, last) = recorded.sample_times(rate), recorded.stamps
    assert first == times[0] and times[-1] < last <= times[-1] + 1 / rate + 1e-8
    assert np.abs(np.diff(times) - 1 / rate).max(initial=0.0) < 1e-8
