"""How far shifts have strayed since the first pose, from those that a fit shows clearly."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.online.reported_covariance import ImageShiftDrift
from estimation.pose_solver import SharedFit
from estimation.se3 import Array

CAMERAS = 3


def told(sigmas: Array) -> SharedFit:
    """A fit that shows shifts (2C,) to `sigmas`, px, along axes of their own."""
    axes, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(6, 6)))
    information = np.zeros((9, 9))
    information[3:, 3:] = axes @ np.diag(sigmas**-2.0) @ axes.T
    return SharedFit(information, np.zeros(9))


def strayed(sigmas: Array, draws: int, size: float) -> float:
    """Its mean over surfaces whose shifts stray by `size`, px, as seen with the errors that `sigmas` stand for."""
    rng, found, fit = np.random.default_rng(9), [], told(sigmas)
    errors = np.linalg.cholesky(np.linalg.inv(fit.information[3:, 3:]))
    for _ in range(draws):
        straying = ImageShiftDrift()
        straying.start(fit, (errors @ rng.normal(size=6)).reshape(2, -1).T)
        now = size * rng.normal(size=6) + errors @ rng.normal(size=6)
        straying.learn(fit, now.reshape(2, -1).T, 1.0)
        found.append(straying.variance)
    return float(np.mean(found))


def test_before_there_is_a_first_pose_nothing_has_strayed() -> None:
    straying = ImageShiftDrift()
    straying.learn(told(np.full(6, 0.01)), np.ones((CAMERAS, 2)), 1.0)
    assert straying.variance == 0.0


@pytest.mark.parametrize("size", [0.05, 0.2])
def test_what_has_strayed_is_found_and_what_so_few_may_be_off_by_is_added(size: float) -> None:
    found = strayed(np.full(6, 0.005), 300, size) / size**2
    assert found == pytest.approx(1 + (2 / 6) ** 0.5, rel=0.1)


def test_shifts_that_a_fit_hardly_shows_do_not_count() -> None:
    clear, half = np.full(6, 0.005), np.array([0.005] * 3 + [0.5] * 3)
    few = (1 + (2 / 3) ** 0.5) / (1 + (2 / 6) ** 0.5)  # three tell less than six, so that more is added
    assert strayed(half, 300, 0.1) == pytest.approx(few * strayed(clear, 300, 0.1), rel=0.2)


def test_shifts_that_only_seem_to_have_changed_are_small() -> None:
    assert strayed(np.full(6, 0.01), 300, 0.0) < 2 * 0.01**2
