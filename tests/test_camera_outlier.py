"""A camera that was bumped is told from a surface that moved, by the motion until then and by what the others see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.observations import Observations
from estimation.online.camera_health import MAX_MOTION_SIGMAS
from estimation.online.estimator import Estimator
from estimation.online.fit import motion_sigmas
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.world import observations
from tests.rendered_sets import breathing
from tests.slow_cases import slowly
from tests.test_estimator import LANDMARKS, RIG, begun, follow, joined, look

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
    return joined(NEXT, parts)


def followed() -> Estimator:
    estimator = begun(breathing)
    follow(estimator, breathing, SECONDS)
    return estimator


@pytest.mark.parametrize("camera", [0, *slowly(2)])
def test_a_bump_that_a_movement_could_explain_is_told_by_the_motion(camera: int) -> None:
    """Along the plane of two cameras rays still meet where a surface that moved in depth would stand."""
    draw, estimator = np.random.default_rng(camera), followed()
    for _ in range(12):
        shift = np.array([0.0, draw.choice([-1, 1]) * draw.uniform(0.6, 1.1), 0.1 * draw.normal()])
        seen = seen_by_bumped(camera, se3.exp(np.concatenate([np.zeros(3), shift])))
        fit = estimator.fit(seen, estimator.predict(NEXT))
        away = np.linalg.norm(fit.solution.base_from_surface[:3, 3] - breathing(NEXT)[:3, 3])
        assert fit.outliers == {camera} or away < 0.4


@pytest.mark.parametrize("size", [2.0, *slowly(0.3, 5.0)])
def test_a_jerk_of_the_surface_is_followed_by_all_cameras(size: float) -> None:
    draw, estimator = np.random.default_rng(3), followed()
    for _ in range(8):
        shift = draw.normal(size=3)
        jerked = breathing(NEXT) @ se3.exp(np.concatenate([np.zeros(3), size * shift / np.linalg.norm(shift)]))
        fit = estimator.fit(look(lambda stamp, pose=jerked: pose, NEXT, 1), estimator.predict(NEXT))
        assert fit.measured and not fit.outliers
        assert np.linalg.norm(fit.solution.base_from_surface[:3, 3] - jerked[:3, 3]) < 0.15


def test_one_camera_against_the_others_and_the_motion_is_no_measurement() -> None:
    """Matches by chance in one camera agree with each other; where the others contradict them, a pose is not more."""
    estimator = followed()
    estimator.health.left_out = frozenset({1, 2})
    far = breathing(NEXT) @ se3.exp(np.array([0, 0, 0, 6.0, -4.0, 0]))
    for cameras, there, measured in (((0, 1, 2), far, False), ((0,), far, True), ((0, 1, 2), breathing(NEXT), True)):
        seen = look(lambda stamp, pose=there: pose, NEXT, 1, cameras=cameras)
        assert estimator.fit(seen, there).measured is measured


def by_chance(share: float, reach: float) -> Observations:
    """A part of the next frame set's tracks, each found anywhere within `reach` px: a covered or blurred surface."""
    seen, draw = look(breathing, NEXT, 1), np.random.default_rng(5)
    kept = np.concatenate([np.flatnonzero(seen.camera == c)[:: round(1 / share)] for c in range(len(RIG))])
    pixels = seen.pixels[kept] + draw.uniform(-reach, reach, (len(kept), 2))
    return Observations(NEXT, seen.camera[kept], seen.track[kept], pixels, seen.sigma[kept])


@pytest.mark.parametrize(("reach", "measured"), [(0.0, True), (5.0, False)])
def test_few_tracks_that_stand_off_are_no_measurement_though_nothing_surprises(reach: float, measured: bool) -> None:
    estimator = followed()
    fit = estimator.fit(by_chance(0.2, reach), estimator.predict(NEXT))
    assert motion_sigmas(fit.solution, estimator.expected(NEXT)) < MAX_MOTION_SIGMAS
    assert fit.measured is measured


@pytest.mark.parametrize("tracks", [(0.5, 5.0, False), *slowly((0.5, 0.0, True), (1.0, 5.0, True))])
def test_shape_and_clocks_learn_nothing_where_half_the_tracks_are_off(tracks: tuple[float, float, bool]) -> None:
    share, reach, sound = tracks
    estimator = followed()
    assert estimator.may_learn(estimator.fit(by_chance(share, reach), estimator.predict(NEXT))) is sound
