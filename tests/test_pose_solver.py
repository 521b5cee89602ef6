"""The robust multi-camera fit: exact on exact data, honest about its noise, hard to mislead."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimation import se3
from estimation.observations import Observations
from estimation.online.deformation import pose_pulls
from estimation.online.fit import delay_gain
from estimation.pose_solver import (
    EFFICIENCY,
    PointTracks,
    PoseFit,
    SharedErrors,
    project,
    solve_pose,
    solve_small,
)
from estimation.rig import ideal_pixels
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig, observations, patch
from tests.test_estimator import joined

RIG = arc_rig()
LANDMARKS = patch(60, np.random.default_rng(3)).points
seeds = st.integers(0, 10_000)


def seen(pose: Array, seed: int, noise: float = 0.3, outliers: float = 0.0) -> Observations:
    """What the cameras see of LANDMARKS with white noise (px); sigma is 0.3 px whatever the noise."""
    o = observations(RIG, LANDMARKS, pose, 0.0, np.random.default_rng(seed), noise, outliers)
    return Observations(o.stamp, o.camera, o.track, o.pixels, np.full(len(o), 0.3))


def fit(o: Observations, start: Array, scales: tuple[float, ...] = (4.0, 1.0), prior: Array | None = None) -> PoseFit:
    return solve_pose(RIG, PointTracks.from_observations(o, LANDMARKS[o.track]), start, scales=scales, prior=prior)


def away(fitted: PoseFit, truth: Array) -> Array:
    """Error (6,) of the fit as a right perturbation, rad and mm."""
    return se3.log(se3.inverse(fitted.base_from_surface) @ truth)


def anywhere(seed: int, degrees: float, mm: float) -> Array:
    """A motion of exactly that much turn and shift, in directions that the seed decides."""
    draw = np.random.default_rng(seed)
    turn, shift = (v / np.linalg.norm(v) for v in draw.normal(size=(2, 3)))
    return se3.exp(np.r_[np.deg2rad(degrees) * turn, mm * shift])


def mean_error(outliers: float, noise: float = 0.3, count: int = 20) -> float:
    """Mean position error, mm, over `count` draws, begun 5 mm and 2 degrees away."""
    errors = [
        away(fit(seen(BASE_FROM_REST, k, noise, outliers), BASE_FROM_REST @ anywhere(k, 2.0, 5.0)), BASE_FROM_REST)[3:]
        for k in range(100, 100 + count)
    ]
    return float(np.mean(np.linalg.norm(errors, axis=1)))


@given(seeds)
@settings(max_examples=40)
def test_exact_data_give_the_exact_pose_from_20_mm_and_10_degrees_away(seed: int) -> None:
    truth = BASE_FROM_REST @ anywhere(seed + 1, 8.0, 6.0)
    fitted = fit(seen(truth, seed, noise=0.0), truth @ anywhere(seed, 10.0, 20.0))
    assert np.abs(away(fitted, truth)).max() < 1e-6
    assert np.abs(fitted.residuals).max() < 1e-4 and fitted.weights.min() > 0.999 and fitted.scale == 1.0


@given(seeds)
def test_pixels_and_depths_are_those_of_the_rig(seed: int) -> None:
    pose = BASE_FROM_REST @ anywhere(seed, 20.0, 30.0)
    for number, camera in enumerate(RIG.cameras):
        pixels, depth, _ = project(RIG, np.full(len(LANDMARKS), number), pose, LANDMARKS)
        expected, expected_depth = ideal_pixels(camera, se3.transform_points(pose, LANDMARKS))
        assert np.allclose(pixels, expected, atol=1e-9) and np.allclose(depth, expected_depth, atol=1e-9)


@given(seeds)
@settings(max_examples=30)
def test_jacobians_are_the_slopes_of_the_projection(seed: int) -> None:
    pose, camera = BASE_FROM_REST @ anywhere(seed, 20.0, 30.0), np.arange(len(LANDMARKS)) % 3
    jacobian = project(RIG, camera, pose, LANDMARKS)[2]
    for axis, h in enumerate([1e-5] * 3 + [1e-3] * 3):
        step = se3.exp(h * np.eye(6)[axis])
        ahead = project(RIG, camera, pose @ step, LANDMARKS)[0]
        behind = project(RIG, camera, pose @ se3.inverse(step), LANDMARKS)[0]
        assert np.allclose((ahead - behind) / (2 * h), jacobian[:, :, axis], rtol=1e-5, atol=1e-4)


def test_the_information_of_perfect_tracks_is_the_sum_over_them() -> None:
    o = seen(BASE_FROM_REST, 1, noise=0.0)
    o = Observations(o.stamp, o.camera, o.track, o.pixels, np.random.default_rng(4).uniform(0.1, 1.0, len(o)))
    j = project(RIG, o.camera, BASE_FROM_REST, LANDMARKS[o.track])[2]
    expected = np.einsum("nki,n,nkj->ij", j, 1 / o.sigma**2, j)
    assert np.allclose(fit(o, BASE_FROM_REST).information, EFFICIENCY * expected, rtol=1e-9)


def test_a_track_twice_as_sure_counts_four_times() -> None:
    sure, unsure = seen(BASE_FROM_REST, 1, noise=0.0), seen(BASE_FROM_REST, 1, noise=0.0)
    sure = Observations(0.0, sure.camera, sure.track, sure.pixels, sure.sigma / 2)
    assert np.allclose(fit(sure, BASE_FROM_REST).information, 4 * fit(unsure, BASE_FROM_REST).information)


@pytest.mark.parametrize(("outliers", "worse"), [(0.05, 1.3), (0.3, 1.7), (0.4, 2.0)])
def test_scattered_outliers_barely_move_the_pose(outliers: float, worse: float) -> None:
    assert mean_error(outliers) < worse * mean_error(0.0)


def test_outliers_are_told_from_the_rest() -> None:
    o = seen(BASE_FROM_REST, 8, outliers=0.3)
    exact = project(RIG, o.camera, BASE_FROM_REST, LANDMARKS[o.track])[0]
    distance = np.linalg.norm(o.pixels - exact, axis=1)
    weights = fit(o, BASE_FROM_REST @ anywhere(8, 2.0, 5.0)).weights
    assert weights[distance > 6].max() < 0.2 < weights[distance < 0.9].min()


def stuck_error(share: float, mm: float, seed: int) -> float:
    """Position error, mm, where that share of the landmarks stays on a drape while the surface moves by `mm`.

    Begun where a prediction would: half a millimetre and a third of a degree off.
    """
    now = BASE_FROM_REST @ anywhere(seed, 1.0, mm)
    o, still = seen(now, seed), np.random.default_rng([seed, 1]).permutation(len(LANDMARKS)) < share * len(LANDMARKS)
    drape = project(RIG, o.camera, BASE_FROM_REST, LANDMARKS[o.track])[0]
    pixels = np.where(still[o.track][:, None], drape, o.pixels)
    start = now @ anywhere(seed + 1, 0.3, 0.5)
    return float(np.linalg.norm(away(fit(Observations(0.0, o.camera, o.track, pixels, o.sigma), start), now)[3:]))


@pytest.mark.parametrize("mm", [2.0, 6.0])
def test_tracks_that_stick_to_a_drape_barely_move_the_pose(mm: float) -> None:
    errors = [stuck_error(0.3, mm, seed) for seed in range(20)]
    assert np.mean(errors) < 0.05 and max(errors) < 0.2


@pytest.mark.parametrize("outliers", [0.0, 0.2])
def test_the_covariance_is_as_wide_as_the_errors(outliers: float) -> None:
    nees = []
    for k in range(150):
        fitted = fit(seen(BASE_FROM_REST, k, outliers=outliers), BASE_FROM_REST @ anywhere(k, 2.0, 5.0))
        e = away(fitted, BASE_FROM_REST)
        nees.append(e @ fitted.information @ e / 6)
    assert 0.6 < np.mean(nees) < 1.15  # the robust weights make the information a quarter small


def apart(mm: float, seed: int) -> tuple[Observations, Observations]:
    """Exact tracks of three cameras, each of which sees the surface `mm` further on, and of cameras in step."""
    along = np.random.default_rng(seed).normal(size=3)
    shift = np.r_[np.zeros(3), mm * along / np.linalg.norm(along)]
    parts = [seen(BASE_FROM_REST @ se3.exp(k * shift), seed, noise=0.0) for k in (-1, 0, 1)]
    return joined(0.0, [part.select(part.camera == c) for c, part in enumerate(parts)]), parts[1]


@pytest.mark.parametrize("mm", [0.3, 1.0, 3.0])
def test_cameras_at_different_instants_are_averaged_and_none_is_thrown_out(mm: float) -> None:
    off, least = [], []
    for seed in range(20):
        late, together = apart(mm, seed)
        fitted, ideal = fit(late, BASE_FROM_REST), fit(together, BASE_FROM_REST)
        off.append(np.linalg.norm(away(fitted, BASE_FROM_REST)[3:]) / mm)
        least.append(min(fitted.weights[late.camera == c].mean() for c in range(3)))
        expected = np.einsum("nki,n,nkj->ij", fitted.jacobians, fitted.weights / late.sigma**2, fitted.jacobians)
        assert np.allclose(np.diag(fitted.information), EFFICIENCY * np.diag(expected) / fitted.scale**2, rtol=0.1)
        assert fitted.scale >= 1 and np.linalg.eigvalsh(ideal.information - fitted.information).min() > 0
    assert np.mean(off) < 0.9 and max(off) < 1.0  # between the cameras' own instants
    assert np.median(least) > 0.5 and min(least) > 0.15


def test_points_behind_the_camera_have_no_say() -> None:
    o = seen(BASE_FROM_REST, 2)
    points = LANDMARKS[o.track].copy()
    back: NDArray[np.bool_] = np.arange(len(o)) % 10 == 0
    beyond = se3.transform_points(se3.inverse(BASE_FROM_REST), [c.base_from_camera[:3, 3] * 3 for c in RIG.cameras])
    points[back] = beyond[o.camera[back]]
    depth = project(RIG, o.camera, BASE_FROM_REST, points)[1]
    assert (depth[back] < 0).any()
    fitted = solve_pose(RIG, PointTracks.from_observations(o, points), BASE_FROM_REST, scales=(4.0, 1.0))
    assert (fitted.weights[depth < 0] == 0).all() and np.linalg.norm(away(fitted, BASE_FROM_REST)[3:]) < 0.1


def test_a_prior_holds_what_the_tracks_leave_open() -> None:
    o = seen(BASE_FROM_REST, 3, noise=0.0)
    few = np.flatnonzero(o.camera == 0)[:2]
    two = Observations(0.0, o.camera[few], o.track[few], o.pixels[few], o.sigma[few])
    start = BASE_FROM_REST @ anywhere(3, 1.0, 2.0)
    fitted = fit(two, start, prior=np.diag([1 / 0.02**2] * 3 + [1 / 5.0**2] * 3))
    assert np.abs(fitted.residuals).max() < 0.1
    assert np.linalg.norm(away(fitted, start)[3:]) < 10


TWIST = np.array([0.05, -0.03, 0.08, 30.0, -12.0, 15.0])  # rad/s and mm/s


def late(seed: int, delays: Array, noise: float = 0.1) -> tuple[PoseFit, SharedErrors, Observations]:
    """The fit to cameras that expose `delays` (C,) s late, what was expected of their errors, and their tracks."""
    parts = [seen(BASE_FROM_REST @ se3.exp(s * TWIST), seed + 1000 * c, noise) for c, s in enumerate(delays)]
    o = joined(0.0, [part.select(part.camera == c) for c, part in enumerate(parts)])
    expected = SharedErrors(TWIST, 0.01**2 * (np.eye(3) - 1 / 3), np.full(3, 0.005**2))
    tracks = PointTracks.from_observations(o, LANDMARKS[o.track])
    return solve_pose(RIG, tracks, BASE_FROM_REST, scales=(4.0, 1.0), shared=expected), expected, o


def without_delays(fitted: PoseFit, expected: SharedErrors, o: Observations, unknown: float = 0.0) -> Array:
    """(6,) from the fitted pose to the one without the delays. unknown: of TWIST, one sigma in parts of it."""
    weight = EFFICIENCY * fitted.weights / (o.sigma * fitted.scale) ** 2
    pulls = pose_pulls(3, 1, o.camera, np.zeros(len(o), np.int64), fitted.jacobians, weight, TWIST)[1]
    assert fitted.shared is not None
    delays = delay_gain(fitted, expected, (unknown * TWIST) ** 2) @ fitted.shared.pull
    return -np.linalg.solve(fitted.information, pulls[:, 0]) @ delays


@given(seeds)
@settings(max_examples=20)
def test_the_pose_without_delays_is_that_of_one_least_squares_over_pose_delays_and_shifts(seed: int) -> None:
    fitted, expected, o = late(seed, np.random.default_rng(seed).normal(size=3) * 0.004)
    weight = EFFICIENCY * fitted.weights / (o.sigma * fitted.scale) ** 2
    own = (o.camera[:, None] == np.arange(3))[:, None, :] * np.ones((1, 2, 1))
    shifts = (own[:, :, None, :] * np.eye(2)[None, :, :, None]).reshape(len(o), 2, 6)
    rows = np.concatenate([fitted.jacobians, own * (fitted.jacobians @ TWIST)[..., None], shifts], axis=2)
    residual = project(RIG, o.camera, fitted.base_from_surface, LANDMARKS[o.track])[0] - o.pixels
    root = np.sqrt(weight)[:, None]
    known = np.linalg.pinv(expected.covariance()[:3, :3] + 1e-6**2 * np.eye(3), hermitian=True)
    prior = np.zeros((15, 15))
    prior[6:9, 6:9], prior[9:, 9:] = known, np.eye(6) / 0.005**2
    tall, right = (rows * root[..., None]).reshape(-1, 15), (residual * root).ravel()
    solved = -np.linalg.solve(tall.T @ tall + prior, tall.T @ right)
    found, whole = without_delays(fitted, expected, o), solved[:6]
    taken = found @ whole / (whole @ whole)  # what chance may have made is left in the pose
    assert 0 <= taken < 1 and np.linalg.norm(found - taken * whole) < 0.02 * np.linalg.norm(whole)


def test_cameras_at_different_instants_are_brought_together_as_far_as_the_velocity_is_known() -> None:
    errors = []
    for seed in range(12):
        delays = np.random.default_rng(seed).normal(size=3) * 0.006
        fitted, expected, o = late(seed, delays - delays.mean())
        left = [fitted.base_from_surface @ se3.exp(without_delays(fitted, expected, o, u)) for u in (0.0, 0.03, 1.0)]
        errors.append(
            [np.linalg.norm(pose[:3, 3] - BASE_FROM_REST[:3, 3]) for pose in [fitted.base_from_surface, *left]]
        )
    plain, known, nearly, unknown = np.mean(errors, axis=0)
    assert plain > 0.04 and known < 0.5 * plain and nearly < 0.6 * plain and abs(unknown / plain - 1) < 0.02


def test_a_camera_later_than_clocks_are_is_left_to_those_who_find_odd_cameras() -> None:
    for seed in range(6):
        fitted, expected, o = late(seed, np.array([0.06, -0.03, -0.03]))
        still = without_delays(fitted, expected, o)
        assert np.linalg.norm(still[3:]) < 0.02 * np.linalg.norm(
            fitted.base_from_surface[:3, 3] - BASE_FROM_REST[:3, 3]
        )


def test_cameras_in_step_lose_next_to_nothing() -> None:
    errors = []
    for seed in range(60):
        fitted, expected, o = late(seed, np.zeros(3), noise=0.3)
        both = fitted.base_from_surface, fitted.base_from_surface @ se3.exp(without_delays(fitted, expected, o))
        errors.append([np.linalg.norm(pose[:3, 3] - BASE_FROM_REST[:3, 3]) for pose in both])
    plain, corrected = np.sqrt(np.mean(np.square(errors), axis=0))
    assert corrected < 1.02 * plain


@given(seeds, st.integers(1, 9), st.integers(1, 4))
def test_small_equations_are_solved_whatever_stands_on_their_diagonal(seed: int, rows: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    matrix, right = rng.normal(size=(rows, rows)), rng.normal(size=(rows, columns))
    matrix[np.diag_indices(rows)] *= rng.random(rows) < 0.5  # none may be a pivot as it stands
    kept = matrix.copy()
    size = np.linalg.cond(matrix)
    if size < 1e8:
        assert np.allclose(
            solve_small(matrix, right), np.linalg.solve(matrix, right), rtol=1e-15 * size, atol=1e-13 * size
        )
    assert (matrix == kept).all()
