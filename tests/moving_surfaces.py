"""Moving surfaces and short paths: what planner, guard, motion and replay are tested on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from planning.path import Path

REST = se3.make(np.eye(3), [202.5, 225.0, 50.0])  # base_from_surface: under the arm's home
Motion = Callable[[float], Array]  # stamp, s -> base_from_surface (4, 4)


def breathing(t: float, height: float = 5.0, tilt: float = 0.03, rate: float = 0.25) -> Array:
    """10 mm up and down and 3 degrees of tilt, 15 times a minute."""
    phase = 2 * np.pi * rate * t
    return REST @ se3.exp(np.array([tilt * np.sin(phase), 0.6 * tilt * np.cos(phase), 0, 0, 0, height * np.sin(phase)]))


def still(t: float) -> Array:
    """A surface that does not move."""
    del t
    return REST


def pose_at(motion: Motion, stamp: float, error: float = 0.01) -> SurfacePose:
    """The exact pose and twist of a moving surface; error: mm, claimed."""
    h = 1e-4
    twist = se3.log(se3.inverse(motion(stamp - h)) @ motion(stamp + h)) / (2 * h)
    covariance = np.diag([1e-6] * 3 + [error**2] * 3)
    return SurfacePose(stamp, motion(stamp), covariance, twist, TrackState.TRACKING)


def poses(motion: Motion, seconds: float, rate: float = 30.0, start: float = 10.0) -> Iterator[SurfacePose]:
    """Exact poses of `seconds` s at `rate` Hz; one in 100 is lost."""
    for k in range(round(seconds * rate)):
        pose = pose_at(motion, start + k / rate)
        yield replace(pose, state=TrackState.COASTING, reason="blinded") if k % 100 == 99 else pose


def raster(size: float = 10.0, lines: int = 3, speed: float = 5.0) -> Path:
    """Lines of `size` mm there and back over a square of that size, upright, all of them printed."""
    across = np.linspace(-size / 2, size / 2, lines)
    xy = [[x, y] for i, y in enumerate(across) for x in np.array([-size / 2, size / 2]) * (-1) ** i]
    return path_through(np.column_stack([xy, np.zeros(len(xy))]), speed)


def path_through(points: Array, speed: float = 5.0) -> Path:
    """An upright path through points (N, 3), mm."""
    count = len(points)
    return Path(
        se3.make(np.eye(3), points),
        np.full(count, speed),
        np.ones(count, np.int64),
        np.full(count, 20.0),
        np.zeros(count, np.int64),
        np.ones(count, bool),
    )
