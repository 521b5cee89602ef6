"""The newest pose and the first one claim what is known now of cameras and tracks, and so does the twist."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation.online.camera_errors import CameraErrors
from estimation.online.fit import FitCovariance, FrameFit
from estimation.online.reported_covariance import NOISE_SHARE_OF_TWIST, ReportedCovariance, rescaling
from estimation.online.window import PRIOR_REVISION, WindowEstimate
from estimation.pose import Forecast, SurfacePose, TrackState
from estimation.pose_solver import PoseFit, SharedFit
from estimation.se3 import Array

CAMERAS = 3


def spread(seed: int, columns: int = 12) -> Array:
    root = np.random.default_rng(seed).normal(size=(6, columns))
    return root @ root.T / columns


def first_fit(cameras: CameraErrors) -> FrameFit:
    """A fit whose noise is that of tracks and of images as restless as `cameras` believe."""
    rng = np.random.default_rng(2)
    bias, late, tracks = rng.normal(size=(6, 2 * CAMERAS)), 20 * rng.normal(size=(6, CAMERAS)), 1e-3 * spread(3)
    noise = tracks + cameras.shift_variance * bias @ bias.T
    solution = PoseFit(np.eye(4), np.eye(6), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 6)), 1.0)
    zero, none = np.zeros((6, 6)), np.zeros(CAMERAS)
    counts, kept = np.zeros(CAMERAS, np.int64), np.zeros(0, bool)
    parts = FitCovariance(noise, zero, zero, 1.0, tracks, late, bias)
    return FrameFit(0.0, solution, parts, np.zeros(6), np.zeros(6), kept, counts, "", none, none)


def error(fit: FrameFit, window: float, cameras: CameraErrors) -> Array:
    """(6, 6) of a pose of which the window knew a part of what this fit did, before any clock was known."""
    parts = fit.parts
    return ReportedCovariance(CAMERAS).error(window * parts.noise, parts, np.zeros(CAMERAS), cameras)


def rested(quiet: float) -> CameraErrors:
    """Cameras that were seen to shift by `quiet` px from frame set to frame set, and to be late by nothing."""
    cameras, rng = CameraErrors(CAMERAS), np.random.default_rng(7)
    information = np.diag(np.repeat([1 / 1e-4**2, 1 / 1e-3**2], [CAMERAS, 2 * CAMERAS]))
    for _ in range(300):
        seen = np.r_[np.zeros(CAMERAS), quiet * rng.normal(size=2 * CAMERAS)]
        cameras.learn(SharedFit(information, information @ seen), 1 / 30)
    return cameras


@pytest.mark.parametrize("window", [0.3, 1.0])
def test_at_once_it_is_what_the_window_said_and_what_late_cameras_make_of_it(window: float) -> None:
    cameras = CameraErrors(CAMERAS)
    fit = first_fit(cameras)
    late = fit.parts.by_delay @ cameras.delays.covariance @ fit.parts.by_delay.T
    assert error(fit, window, cameras) == pytest.approx(window * fit.parts.noise + late, rel=1e-6)


def test_once_the_images_are_known_to_rest_it_is_what_the_tracks_make_of_it() -> None:
    fit, cameras = first_fit(CameraErrors(CAMERAS)), rested(0.005)
    late = fit.parts.by_delay @ cameras.delays.covariance @ fit.parts.by_delay.T
    expected = 0.5 * (fit.parts.tracks + cameras.shift_variance * fit.parts.by_shift @ fit.parts.by_shift.T) + late
    assert error(fit, 0.5, cameras) == pytest.approx(expected, rel=1e-6)
    assert cameras.shift_variance < 0.1 * CameraErrors(CAMERAS).shift_variance


def test_images_found_less_at_rest_than_was_believed_make_it_larger() -> None:
    fit = first_fit(CameraErrors(CAMERAS))
    restless, believed = error(fit, 0.5, rested(0.3)), error(fit, 0.5, rested(0.05))
    assert np.linalg.eigvalsh(restless - believed)[0] > -1e-12 and np.trace(restless) > 2 * np.trace(believed)


def test_an_offset_that_was_not_corrected_then_is_claimed_when_it_is_known() -> None:
    cameras = CameraErrors(CAMERAS)
    fit = first_fit(cameras)
    information = np.diag(np.repeat([1 / 1e-3**2, 1e-9], [CAMERAS, 2 * CAMERAS]))
    true = np.array([0.016, 0.0, -0.016])
    for _ in range(200):
        found = np.r_[true - cameras.offset, np.zeros(2 * CAMERAS)]
        cameras.learn(SharedFit(information, information @ found), 1 / 30)
    off = fit.parts.by_delay @ true
    assert off @ np.linalg.solve(error(fit, 0.5, cameras), off) < 2.0


BELIEVED = 0.04 * np.eye(6)  # of the first pose, before the images are known to rest
LITTLE = 1e-6 * np.eye(6)


def window_of(covariance: Array, revision: float = PRIOR_REVISION) -> WindowEstimate:
    one, unit = np.ones(6), np.eye(6)
    return WindowEstimate(0.0, np.eye(4), covariance, 0 * one, 4 * unit, one, revision * one)


WINDOW = window_of(LITTLE)


def fit_at(stamp: float, tracks: int = 300, scatter: float = 1.0) -> FrameFit:
    fit = first_fit(CameraErrors(CAMERAS))
    shared = SharedFit(np.diag(np.full(3 * CAMERAS, 1e4)), np.zeros(3 * CAMERAS))
    used = np.full(CAMERAS, tracks // CAMERAS)
    small = {"by_delay": 1e-3 * fit.parts.by_delay, "by_shift": 1e-3 * fit.parts.by_shift}
    parts = replace(fit.parts, scatter=scatter, noise=BELIEVED, tracks=LITTLE, **small)
    return replace(fit, stamp=stamp, solution=replace(fit.solution, shared=shared), used=used, parts=parts)


def pose_at(stamp: float, state: TrackState = TrackState.TRACKING, reason: str = "") -> SurfacePose:
    return SurfacePose(stamp, np.eye(4), BELIEVED + LITTLE, np.zeros(6), state, reason=reason)


def quiet(seconds: float) -> tuple[ReportedCovariance, Array]:
    """A claim after so long, and what it last claimed."""
    claim, cameras, believed = ReportedCovariance(CAMERAS), CameraErrors(CAMERAS), BELIEVED
    given = claim.measured(pose_at(0.0), fit_at(0.0), cameras, believed, WINDOW)
    for k in range(1, round(30 * seconds) + 1):
        given = claim.measured(pose_at(k / 30), fit_at(k / 30), rested(0.005) if k == 1 else cameras, believed, WINDOW)
        cameras = RESTED
    return claim, given.covariance


RESTED = rested(0.005)


def size(covariance: Array) -> float:
    return float(np.trace(covariance))


def test_the_first_pose_claims_what_the_window_says_and_the_next_the_first_ones_error_as_it_is_known() -> None:
    claim, believed = ReportedCovariance(CAMERAS), CameraErrors(CAMERAS)
    fit = fit_at(0.0)
    fit = replace(fit, parts=replace(fit.parts, noise=first_fit(believed).parts.noise))
    marginal = 0.5 * fit.parts.noise
    pose = replace(pose_at(0.0), covariance=marginal)
    alone = claim.measured(pose, fit, believed, marginal, window_of(marginal)).covariance
    pose = replace(pose, covariance=2 * marginal)  # with the first one's error, as the estimator gives it
    both = claim.measured(pose, fit, believed, marginal, window_of(marginal)).covariance
    assert both == pytest.approx(2 * alone, rel=1e-6)


def test_once_the_images_are_known_to_rest_less_is_claimed() -> None:
    _, claimed = quiet(0.1)
    assert size(claimed) < 0.5 * size(BELIEVED) and np.linalg.eigvalsh(claimed)[0] > 0


def test_a_pose_that_is_only_predicted_keeps_what_decisions_are_made_by() -> None:
    claim, _ = quiet(0.1)
    assert size(claim.missed(pose_at(2.0, TrackState.COASTING)).covariance) >= size(BELIEVED)


def test_of_tracks_that_scatter_less_than_they_claim_the_window_is_claimed_smaller() -> None:
    claim, _ = quiet(2.0)
    pose, wide = pose_at(2.03), 1e-2 * BELIEVED
    pose, fit = replace(pose, covariance=pose.covariance + wide), fit_at(2.03)
    fit = replace(fit, parts=replace(fit.parts, noise=wide, tracks=0.9 * wide))
    sizes = []
    for scatter in (1.0, 0.2):
        scattered = replace(fit, parts=replace(fit.parts, scatter=scatter))
        sizes.append(size(claim.measured(pose, scattered, RESTED, BELIEVED, window_of(wide)).covariance))
    assert sizes[0] - sizes[1] == pytest.approx(0.9 * 0.8 * size(wide), rel=1e-6)


def test_a_twist_is_claimed_by_its_noise_alone_once_hindsight_changes_nothing_of_it() -> None:
    claim, _ = quiet(2.0)
    fit = fit_at(2.03)
    alike = replace(fit, parts=replace(fit.parts, tracks=fit.parts.noise))
    claimed = [
        claim.measured(pose_at(2.03), alike, RESTED, BELIEVED, window_of(LITTLE, revision)).twist_covariance
        for revision in (0.0, PRIOR_REVISION, 2 * PRIOR_REVISION)
    ]
    assert claimed[0] == pytest.approx(NOISE_SHARE_OF_TWIST * 4 * np.eye(6), abs=1e-7)
    assert size(claimed[1]) == pytest.approx(size(4 * np.eye(6)), rel=0.1)  # as the window says
    assert size(claimed[2]) > 1.8 * size(claimed[1])


def test_a_twist_is_claimed_wider_where_the_cameras_expose_late() -> None:
    claim, _ = quiet(2.0)
    fit, late = fit_at(2.03), np.diag([0, 0, 0, 0, 0, 1.0])
    sharp = claim.measured(pose_at(2.03), fit, RESTED, BELIEVED, window_of(LITTLE, 0.0)).twist_covariance
    fit = replace(fit, parts=replace(fit.parts, smear=2 * fit.parts.noise * late))
    smeared = claim.measured(pose_at(2.03), fit, RESTED, BELIEVED, window_of(LITTLE, 0.0)).twist_covariance
    assert smeared - sharp == pytest.approx(NOISE_SHARE_OF_TWIST * 2 * 4 * late, abs=1e-7)


def test_a_forecast_is_claimed_as_its_pose_is() -> None:
    claim, _ = quiet(1.5)
    pose = pose_at(2.0)
    ahead = Forecast(np.array([0.1, 0.2]), np.zeros((2, 6)), np.stack([pose.covariance, 2 * pose.covariance]))
    given = claim.measured(replace(pose, forecast=ahead), fit_at(2.0), RESTED, BELIEVED, WINDOW)
    less = given.covariance - pose.covariance
    assert given.forecast.covariances == pytest.approx(ahead.covariances + less)


@pytest.mark.parametrize("scatter", [1.0, 0.1])
@pytest.mark.parametrize("rest", [1.0, 0.05])
def test_a_marginal_that_is_a_part_of_the_noise_stays_that_part(scatter: float, rest: float) -> None:
    cameras = CameraErrors(CAMERAS)
    parts = first_fit(cameras).parts
    known = scatter * parts.tracks + rest * cameras.shift_variance * parts.by_shift @ parts.by_shift.T
    rescaled = rescaling(parts.noise, known)
    assert rescaled @ (0.3 * parts.noise) @ rescaled.T == pytest.approx(0.3 * known, rel=1e-6)


def test_where_nothing_is_known_anew_a_marginal_stays_as_it_is() -> None:
    noise = first_fit(CameraErrors(CAMERAS)).parts.noise
    assert rescaling(noise, noise) == pytest.approx(np.eye(6), abs=1e-9)
