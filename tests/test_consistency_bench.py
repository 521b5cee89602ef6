"""The consistency bench: errors as large as is claimed have NEES/6 of one, whatever the two surface frames are."""

from __future__ import annotations

import numpy as np
import pytest

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.bench.consistency import SETTLED, consistency_figures, errors_of

COUNT = 600
SIGMA = np.array([1e-4, 2e-4, 1e-4, 0.01, 0.01, 0.02])  # rad, mm
OTHER = se3.exp(np.array([0.3, -0.2, 0.5, 12.0, -7.0, 3.0]))  # true_from_own, of the surface frames


def poses(claimed: float, truth: Array, waiting: int = 5) -> list[SurfacePose]:
    """Poses with noise of SIGMA in their own surface frame, claimed `claimed` times as wide, TRACKING after a while."""
    draw, covariance = np.random.default_rng(3), np.diag((claimed * SIGMA) ** 2)
    made = []
    for k, pose in enumerate(truth):
        noise = np.zeros(6) if k <= waiting else SIGMA * draw.normal(size=6)
        state = TrackState.TRACKING if k >= waiting else TrackState.INITIALISING
        made.append(SurfacePose(k / 30, pose @ OTHER @ se3.exp(noise), covariance, np.zeros(6), state))
    return made


def figures(claimed: float, count: int = COUNT, waiting: int = 5) -> dict[str, float]:
    phase = np.arange(count)[:, None] / 20
    truth = se3.exp(np.sin(phase) * np.array([0.02, 0.01, 0.0, 1.0, 2.0, 3.0]))
    run = errors_of(poses(claimed, truth, waiting), truth)
    return {f.what: f.value for f in consistency_figures("x", [run])}


@pytest.mark.parametrize(("claimed", "inside"), [(0.5, 0.67), (1.0, 0.95), (3.0, 1.0)])
def test_the_claim_is_held_against_the_error(claimed: float, inside: float) -> None:
    found = figures(claimed)
    assert found["x: NEES/6"] == pytest.approx(1 / claimed**2, rel=0.1)
    assert found["x: inside 95 %"] == pytest.approx(inside, abs=0.02)
    assert found["x: claim of an axis"] / found["x: error of an axis"] == pytest.approx(claimed, rel=0.1)
    assert found["x: measured"] == 100.0


def test_a_surface_that_is_hardly_followed_has_no_consistency() -> None:
    for count, waiting in ((SETTLED, 5), (20, 20)):
        assert np.isnan(figures(1.0, count, waiting)["x: NEES/6"])
