"""What the window has averaged is resized, axis by axis, by what is known of tracks and images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_first_pose import CAMERAS, first

from estimation.averaged import Averaged
from estimation.online.camera_errors import CameraErrors
from estimation.track_noise import TrackNoise

CAMERA_ERRORS = CameraErrors(CAMERAS)


@pytest.mark.parametrize("scatter", [1.0, 0.1])
@pytest.mark.parametrize("rest", [1.0, 0.05])
def test_each_part_of_the_noise_is_resized_by_itself(scatter: float, rest: float) -> None:
    _, fit = first(1.0, CAMERA_ERRORS)
    unrest = CAMERA_ERRORS.unrest
    averaged = Averaged(0.3 * fit.noise, replace(fit, scatter=scatter), unrest)
    expected = 0.3 * (scatter * fit.tracks + rest * unrest * fit.bias @ fit.bias.T)
    assert averaged.covariance(TrackNoise(CAMERAS), rest * unrest) == pytest.approx(expected, rel=1e-6)


def test_a_window_that_knows_some_axes_better_keeps_its_shape_where_nothing_is_resized() -> None:
    _, fit = first(1.0, CAMERA_ERRORS)
    window = np.linalg.inv(np.linalg.inv(fit.noise) + np.diag([1e3, 0, 1e5, 0, 1e4, 0]))
    found = Averaged(window, fit, CAMERA_ERRORS.unrest).covariance(TrackNoise(CAMERAS), CAMERA_ERRORS.unrest)
    assert found == pytest.approx(window, rel=1e-6)
