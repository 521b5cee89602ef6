"""A camera that was bumped is told from a surface that moved, by the motion until then and by what the others see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_estimator import LANDMARKS, RIG, begun, error, follow, look, step

from estimation import se3
from estimation.estimator import Estimator
from estimation.observations import Observations
from estimation.pose import TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.look import observations
from tests.synthetic import breathing

SECONDS, NEXT = 2.0, 2.0 + 1 / 30


def seen_by_bumped(camera: int, bump: Array) -> Observations:
    """The next frame set, in which one camera stands elsewhere: bump (4, 4) its old frame from the new one."""
    cameras = list(RIG.cameras)
    cameras[camera] = replace(cameras[camera], base_from_camera=cameras[camera].base_from_camera @ bump)
    only = np.zeros((len(RIG), len(LANDMARKS)), bool)
    only[camera] = True
    draw = np.random.default_rng(7)
    struck = observations(Rig(tuple(cameras)), LANDMARKS, breathing(NEXT), NEXT, draw, 0.3, visible=only)
    parts = [struck if c == camera else look(breathing, NEXT, 1, cameras=[c]) for c in range(len(RIG))]
    camera_, track, pixels, sigma = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("camera", "track", "pixels", "sigma")
    )
    return Observations(NEXT, camera_, track, pixels, sigma)


def followed() -> Estimator:
    estimator = begun(breathing)
    follow(estimator, breathing, SECONDS)
    return estimator


@pytest.mark.parametrize("camera", range(3))
def test_a_bump_is_never_taken_for_a_movement(camera: int) -> None:
    """Along the plane of two cameras their rays still meet, and by residuals alone a bump looks like a movement."""
    draw = np.random.default_rng(camera)
    for _ in range(4):
        shift = draw.normal(size=3) * [1, 1, 0.3]
        bump = se3.exp(np.concatenate([np.zeros(3), draw.uniform(2, 4) * shift / np.linalg.norm(shift)]))
        pose = step(followed(), seen_by_bumped(camera, bump))
        wrong = error(pose, breathing) > max(0.5, 3 * 2.8 * float(np.sqrt(np.trace(pose.covariance[3:, 3:]) / 3)))
        assert not wrong or pose.state is not TrackState.TRACKING


@pytest.mark.parametrize("size", [0.3, 2.0, 5.0])
def test_a_jerk_of_the_surface_is_followed_by_all_cameras(size: float) -> None:
    draw = np.random.default_rng(3)
    for _ in range(4):
        shift = draw.normal(size=3)
        jerk = se3.exp(np.concatenate([np.zeros(3), size * shift / np.linalg.norm(shift)]))
        estimator = followed()
        pose = step(estimator, look(lambda stamp, jerk=jerk: breathing(stamp) @ jerk, NEXT, 1))  # type: ignore[misc]
        assert not estimator.health.left_out
        assert np.linalg.norm(pose.base_from_surface[:3, 3] - (breathing(NEXT) @ jerk)[:3, 3]) < 0.15
