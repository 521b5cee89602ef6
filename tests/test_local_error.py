"""The claim of a place follows from the landmarks around it: a bump there is claimed soon, and elsewhere nothing is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from estimation.observations import MissedLandmarks
from estimation.online.estimator import Estimator
from estimation.pose import SurfacePose
from estimation.se3 import Array, Mask
from estimation.surface_map import SurfaceMap
from estimation.synthetic.world import arc_rig, observations, project_landmarks, undistorting
from hardware.simulator.scene.shape import Deformation
from tests.synthetic import breathing, still

RIG = arc_rig()
REACH_PX = 2.5  # of the alignment, as TrackingStep's FINE_REACH_PX
LIMIT_MM = 0.5  # sigma from which the guard refuses
MIDDLE = np.zeros((1, 3))
BEGINS_S = 2.0
BUMP_MM = 10.0  # one sigma
Motion = Callable[[float], Array]


def field(size: tuple[float, float], count: int, seed: int = 1) -> Array:
    """Landmarks (N, 3) mm of a flat surface about the needle's place."""
    across = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 2)) * size
    return np.column_stack([across, np.zeros(count)])


DENSE, SPARSE = field((100.0, 70.0), 250), field((200.0, 140.0), 250)


class Followed:
    """An estimator on a surface of which only what lies within the alignment's reach is found."""

    def __init__(self, points: Array, rate: float, motion: Motion, seed: int = 0) -> None:
        self.points, self.rate, self.motion, self.seed = points, rate, motion, seed
        self.estimator, self.number = Estimator(RIG), 0
        count = len(points)
        surface = SurfaceMap(points, np.tile([0.0, 0.0, 1.0], (count, 1)), 0.02**2 * np.eye(3 * count))
        self.estimator.begin(0.0, motion(0.0), surface)

    def __call__(self, displaced: Array, hidden: Mask | None = None, masked: Mask | None = None) -> SurfacePose:
        """One frame set in which the landmarks are displaced (N, 3) mm; hidden, masked: (C, N) of the cameras.

        What is hidden is missed; what is masked is not looked for.
        """
        self.number += 1
        stamp, shape = self.number / self.rate, (len(RIG), len(self.points))
        draw, pose = np.random.default_rng([self.seed, self.number]), self.motion(stamp)
        hidden = np.zeros(shape, bool) if hidden is None else hidden
        sought = np.ones(shape, bool) if masked is None else ~masked
        poses = np.tile(pose, (len(RIG), 1, 1))
        expected, seen = project_landmarks(undistorting(RIG), self.points, poses)
        there = project_landmarks(undistorting(RIG), self.points + displaced, poses)[0]
        within = np.linalg.norm(there - expected, axis=2) < REACH_PX
        found = within & ~hidden & (draw.random(shape) > 0.02)
        tracks = observations(RIG, self.points + displaced, pose, stamp, draw, 0.15, 0.02, found & sought)
        missed = MissedLandmarks(*np.nonzero(seen & sought & ~found))
        tracks = replace(tracks, missed=missed)
        return self.estimator.accept(self.estimator.fit(tracks, pose), tracks)


def rise(height: float, seconds: float) -> Callable[[float], float]:
    return lambda stamp: height * float(np.clip((stamp - BEGINS_S + 1e-9) / max(seconds, 1e-9), 0.0, 1.0))


def risen(points: Array, rate: float, motion: Motion, height: Callable[[float], float], until: float) -> list[tuple]:
    """(height, pose) of each frame set of a bump in the middle."""
    follow, bump, out = Followed(points, rate, motion), Deformation(bulge=1.0, radius=BUMP_MM), []
    for number in range(1, int(until * rate)):
        high = height(number / rate)
        out.append((high, follow(bump.displacement(points, high))))
    return out


CASES = [
    (DENSE, 30.0, 2.0, 0.0, still),
    (DENSE, 13.0, 2.0, 1.0, breathing),
    (DENSE, 13.0, 2.0, 8.0, still),
    (DENSE, 30.0, 3.0, 6.0, breathing),
    (SPARSE, 30.0, 6.0, 2.3, breathing),
    (SPARSE, 13.0, 2.0, 0.0, breathing),
    (SPARSE, 13.0, 3.0, 12.0, still),
]


@pytest.mark.parametrize(("points", "rate", "height", "seconds", "motion"), CASES)
def test_a_bump_under_the_needle_is_claimed_before_it_is_two_frame_sets_old(
    points: Array, rate: float, height: float, seconds: float, motion: Motion
) -> None:
    """Of 2 mm and more, at once or slowly, on a surface with dense landmarks and on whole pictures."""
    seen = risen(points, rate, motion, rise(height, seconds), BEGINS_S + seconds + 1.0)
    high = np.array([h for h, _ in seen])
    claims = np.array([pose.error_at(MIDDLE)[0] for _, pose in seen])
    rim = np.array([pose.error_at(0.45 * np.ptp(points, axis=0)[None])[0] for _, pose in seen])
    assert claims[high == 0].max() < LIMIT_MM / 2
    two = int(np.flatnonzero(high >= 2.0 - 1e-9)[0])
    assert claims[two + 2 :].min() > LIMIT_MM, (two, claims[two - 3 :].round(2).tolist())
    assert rim.max() < LIMIT_MM
