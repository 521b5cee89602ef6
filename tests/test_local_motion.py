"""A part that moves by itself: folds are said soon and forgotten soon, and neither strays nor one camera make one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.observations import Observations
from estimation.online.estimator import Estimator
from estimation.online.local_motion import (
    BELL_SIGMA_MM,
    MAX_BELLS,
    LocalMotion,
    bell_centres,
    displacement_sums,
    solve_symmetric3,
)
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.world import arc_rig, observations, patch
from hardware.simulator.scene.shape import Deformation
from hardware.simulator.truth import FOLD_SIGMA
from tests.rendered_sets import breathing
from tests.slow_cases import slowly

RIG, RATE = arc_rig(), 30.0
LANDMARKS = patch(120, np.random.default_rng(3)).points
FOLD = Deformation(bulge=1.0, radius=FOLD_SIGMA)
MIDDLE = np.zeros((1, 3))
BEGINS = 30  # frame sets before anything happens
SOON, BACK = 3, 6  # frame sets: of a visible fold until it is said; of a flat surface until all is as before


def surface(points: Array) -> SurfaceMap:
    count = len(points)
    return SurfaceMap(points, np.tile([0.0, 0.0, 1.0], (count, 1)), np.zeros((3 * count, 3 * count)))


def look(number: int, height: float, seed: int, outliers: float = 0.02, points: Array = LANDMARKS) -> Observations:
    """A frame set of a breathing surface with a fold so high, mm."""
    stamp, draw = number / RATE, np.random.default_rng([seed, number])
    lifted = points + FOLD.displacement(points, height)
    return observations(RIG, lifted, breathing(stamp), stamp, draw, 0.3, outliers)


def begun() -> Estimator:
    estimator = Estimator(RIG)
    estimator.begin(0.0, breathing(0.0), surface(LANDMARKS))
    return estimator


def followed(heights: Array, seed: int) -> list[SurfacePose]:
    """Poses of frame sets 1, 2, ... in which the fold is so high (T,), mm."""
    estimator, poses = begun(), []
    for number, height in enumerate(heights.tolist(), 1):
        seen = look(number, height, seed)
        poses.append(estimator.accept(estimator.fit(seen, breathing(seen.stamp)), seen))
    return poses


def watched(tell: Callable[[int], Observations], count: int) -> list[float]:
    """What is found moving by itself, mm, in so many fits to what is told of each frame set."""
    estimator, local, found = begun(), LocalMotion(len(RIG)), []
    for number in range(1, count + 1):
        seen = tell(number)
        local(seen, estimator.fit(seen, breathing(seen.stamp)), seen.sigma, estimator.map, 0.0)
        found.append(local.size)
    return found


@given(height=st.floats(1.5, 5.0), seconds=st.floats(0.25, 0.6), late=st.floats(0.0, 1.0), seed=st.integers(0, 99))
@settings(max_examples=3)
def test_a_fold_is_said_soon_doubted_and_forgotten_soon(height: float, seconds: float, late: float, seed: int) -> None:
    """Lower ones are told later, or not at all: a track's noise is 0.23 mm here."""
    phase = np.clip((np.arange(BEGINS + round(0.6 * RATE) + 12) - BEGINS - late) / (RATE * seconds), 0.0, 1.0)
    heights = height * np.sin(np.pi * phase) ** 2
    poses = followed(heights, seed)
    said = np.array(["moves by itself" in pose.reason for pose in poses])
    assert not said[:BEGINS].any()
    wrong = int(np.flatnonzero(heights > 0.5)[0])
    assert said[: wrong + SOON + 1].any()
    claims = np.array([pose.error_at(MIDDLE)[0] for pose in poses])
    assert all(pose.state is TrackState.DEGRADED for pose in np.array(poses)[said])
    assert claims[said].min() > 0.5 > 5 * claims[BEGINS - 1]  # of mm that the guard allows
    over = int(np.ceil(BEGINS + late + RATE * seconds)) + BACK
    assert all(pose.state is TrackState.TRACKING for pose in poses[over:]) and claims[over:].max() < 0.1


@pytest.mark.parametrize("count", [300, *slowly(10_000)])
def test_strays_are_no_part_of_the_surface(count: int) -> None:
    assert not any(watched(lambda number: look(number, 0.0, 4, outliers=0.05), count))


def test_what_one_camera_alone_sees_moved_is_none() -> None:
    def tell(number: int) -> Observations:
        seen = look(number, 0.0, 5)
        struck = (seen.camera == 1) & (np.linalg.norm(LANDMARKS[seen.track, :2], axis=1) < 12.0) & (number > BEGINS)
        seen.pixels[struck] += [4.0, -3.0]
        return seen

    assert not any(watched(tell, BEGINS + 40))


def test_a_fold_that_stays_goes_on_being_said() -> None:
    found = watched(lambda number: look(number, 3.0 * (number > BEGINS), 6), BEGINS + 150)
    assert not any(found[:BEGINS]) and all(found[BEGINS:])


def test_a_map_that_was_wrong_from_the_beginning_is_none() -> None:
    assert not any(watched(lambda number: look(number, 1.5, 7), 60))


def test_what_the_map_takes_in_is_displaced_no_more() -> None:
    estimator, local, folded = begun(), LocalMotion(len(RIG)), LANDMARKS + FOLD.displacement(LANDMARKS, 2.0)
    for number in range(1, 60):
        seen = look(number, 2.0, 8)
        if number == 30:
            estimator.replace_map(surface(folded))  # as it is, which the pose of the one before was not
        local(seen, estimator.fit(seen, breathing(seen.stamp)), seen.sigma, estimator.map, 0.0)
        assert not local.active


@given(seed=st.integers(0, 999), count=st.integers(1, 80), further=st.integers(0, 80))
@settings(max_examples=20)
def test_every_point_has_a_bell_and_those_of_before_stay(seed: int, count: int, further: int) -> None:
    points = np.random.default_rng(seed).uniform(-30, 30, (count + further, 3))
    before = bell_centres(points[:count], np.zeros((0, 3)))
    after = bell_centres(points, before)
    assert (after[: len(before)] == before).all() and len(after) <= MAX_BELLS
    away = np.linalg.norm(points[:, None] - after, axis=2).min(1)
    assert len(after) == MAX_BELLS or away.max() <= BELL_SIGMA_MM


@given(seed=st.integers(0, 999), count=st.integers(1, 12))
@settings(max_examples=20)
def test_each_landmark_s_normal_equations_are_those_of_its_own_tracks(seed: int, count: int) -> None:
    draw = np.random.default_rng(seed)
    row, jacobian = draw.integers(0, 4, count), draw.normal(size=(count, 2, 6))
    residual, precision = draw.normal(size=(count, 2)), draw.uniform(0, 2, count) * (draw.random(count) > 0.3)
    normal, right, square, views = displacement_sums(4, row, jacobian, residual, precision)
    for i in range(4):
        a = (jacobian[row == i, :, 3:] * np.sqrt(precision[row == i])[:, None, None]).reshape(-1, 3)
        b = (-residual[row == i] * np.sqrt(precision[row == i])[:, None]).ravel()
        assert normal[i] == pytest.approx(a.T @ a) and right[i] == pytest.approx(a.T @ b)
        assert square[i] == pytest.approx(b @ b) and views[i] == (precision[row == i] > 0).sum()
    definite = normal + np.eye(3)
    assert solve_symmetric3(definite, right) == pytest.approx(np.linalg.solve(definite, right[..., None])[..., 0])
