"""What is claimed of a pose that is given out: wide at once and after trouble, by what was learned otherwise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation.fit import Fit
from estimation.forecast import Forecast
from estimation.online.camera_errors import CameraErrors
from estimation.online.pose_solver import SharedFit
from estimation.online.reported_covariance import WARY, Claim
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from tests.test_first_pose import CAMERAS, first, rested

BELIEVED = 0.04 * np.eye(6)  # of the first pose, before the images are known to rest
LITTLE = 1e-6 * np.eye(6)


def fit_at(stamp: float, tracks: int = 300, scatter: float = 1.0) -> Fit:
    _, fit = first(0.5, CameraErrors(CAMERAS))
    shared = SharedFit(np.diag(np.full(3 * CAMERAS, 1e4)), np.zeros(3 * CAMERAS))
    used = np.full(CAMERAS, tracks // CAMERAS)
    small = 1e-3 * fit.late, 1e-3 * fit.bias
    return replace(
        fit,
        stamp=stamp,
        solution=replace(fit.solution, shared=shared),
        used=used,
        scatter=scatter,
        late=small[0],
        bias=small[1],
        noise=BELIEVED,
        tracks=LITTLE,
    )


def pose_at(stamp: float, state: TrackState = TrackState.TRACKING, reason: str = "") -> SurfacePose:
    return SurfacePose(stamp, np.eye(4), BELIEVED + LITTLE, np.zeros(6), state, reason=reason)


def quiet(seconds: float) -> tuple[Claim, Array]:
    """A claim after so long without trouble, and what it last claimed."""
    claim, cameras, believed = Claim(CAMERAS), CameraErrors(CAMERAS), BELIEVED
    given = claim.measured(pose_at(0.0), fit_at(0.0), cameras, believed, LITTLE)
    for k in range(1, round(30 * seconds) + 1):
        given = claim.measured(pose_at(k / 30), fit_at(k / 30), rested(0.005) if k == 1 else cameras, believed, LITTLE)
        cameras = RESTED
    return claim, given.covariance


RESTED = rested(0.005)


def size(covariance: Array) -> float:
    return float(np.trace(covariance))


def test_for_a_second_all_that_was_believed_is_claimed() -> None:
    _, claimed = quiet(0.8 * WARY)
    assert size(claimed) >= size(BELIEVED)


def test_once_the_images_are_known_to_rest_less_is_claimed() -> None:
    _, claimed = quiet(1.2 * WARY)
    assert size(claimed) < 0.5 * size(BELIEVED) and np.linalg.eigvalsh(claimed)[0] > 0


@pytest.mark.parametrize(
    ("pose", "fit"),
    [
        (pose_at(2.0, TrackState.DEGRADED, "one camera alone"), fit_at(2.0)),
        (pose_at(2.0, reason="just back"), fit_at(2.0)),
        (pose_at(2.0), fit_at(2.0, tracks=200)),
        (pose_at(2.0), fit_at(2.0, scatter=3.0)),
    ],
    ids=["degraded", "reserved", "fewer tracks", "worse tracks"],
)
def test_whatever_is_unlike_before_brings_the_wide_claim_back_for_a_second(pose: SurfacePose, fit: Fit) -> None:
    claim, narrow = quiet(1.5 * WARY)
    assert size(narrow) < 0.5 * size(BELIEVED) <= size(claim.measured(pose, fit, RESTED, BELIEVED, LITTLE).covariance)
    for later in (0.1, 0.9):
        stamp = 2.0 + later * WARY
        assert size(claim.measured(pose_at(stamp), fit_at(stamp), RESTED, BELIEVED, LITTLE).covariance) >= size(
            BELIEVED
        )


def test_a_pose_that_is_only_predicted_keeps_its_wide_claim_and_so_does_the_next() -> None:
    claim, _ = quiet(1.5 * WARY)
    assert size(claim.missed(pose_at(2.0, TrackState.COASTING)).covariance) >= size(BELIEVED)
    assert size(claim.measured(pose_at(2.1), fit_at(2.1), RESTED, BELIEVED, LITTLE).covariance) >= size(BELIEVED)


def test_of_tracks_that_scatter_less_than_they_claim_the_window_is_claimed_smaller() -> None:
    claim, _ = quiet(2.0)
    pose, wide = pose_at(2.03), 1e-2 * BELIEVED
    pose, fit = replace(pose, covariance=pose.covariance + wide), replace(fit_at(2.03), noise=wide, tracks=0.9 * wide)
    sizes = [
        size(claim.measured(pose, replace(fit, scatter=scatter), RESTED, BELIEVED, wide).covariance)
        for scatter in (1.0, 0.2)
    ]
    assert sizes[0] - sizes[1] == pytest.approx(0.9 * 0.8 * size(wide), rel=1e-6)


def test_a_forecast_is_claimed_as_its_pose_is() -> None:
    claim, _ = quiet(1.5 * WARY)
    pose = pose_at(2.0)
    ahead = Forecast(np.array([0.1, 0.2]), np.zeros((2, 6)), np.stack([pose.covariance, 2 * pose.covariance]))
    given = claim.measured(replace(pose, forecast=ahead), fit_at(2.0), RESTED, BELIEVED, LITTLE)
    assert given.forecast is not None
    less = given.covariance - pose.covariance
    assert given.forecast.covariances == pytest.approx(ahead.covariances + less)
