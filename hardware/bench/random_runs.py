"""Random prints: paths of all kinds over surfaces that move anyhow, seen by poses that are late, wrong or missing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from estimation import se3
from estimation.forecast import Forecast
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from estimation.warp import Warp
from planning.path import NEAREST, Path, lengths

Draw = np.random.Generator
Tick = tuple[float, SurfacePose | None]  # now, s, and the newest pose

REST = se3.make(np.eye(3), [202.5, 225.0, 50.0])  # base_from_surface: under the default arm's home
TICK = 0.02  # s
START = 10.0  # s, of the first tick
LATEST = 0.1  # s from a pose's stamp until it is known
HEIGHTS = ((0.0, 0.0), (5.0, 0.05), (12.0, 0.2), (40.0, 0.6))  # mm and rad of the surface's swing
RATES = 0.1, 0.3, 0.8  # Hz
NOISES = 0.0, 0.0, 0.05, 0.3, 10.0  # mm, and a hundredth of it in rad
TROUBLES = 0.0, 0.005, 0.02, 0.3  # share of poses that are spoilt
DOUBTS = 0.0, 0.01, 0.1  # share of poses that claim a large error
STALL = 0.002  # share of ticks before which the caller stalls
WRONG = np.array([0.01] * 3 + [5.0] * 3)  # rad and mm of a jump
FAR = np.array([0.0, 0, 0, 800.0, 0, 0])  # mm: out of any reach
HORIZONS = np.array([0.1, 0.2, 0.3, 0.4, 0.5])  # s, of a forecast


@dataclass(frozen=True, slots=True)
class Swing:
    """A surface that swings about REST: height mm along its normal, tilt rad, rate Hz."""

    height: float
    tilt: float
    rate: float

    def at(self, t: Array | float) -> Array:
        """base_from_surface (..., 4, 4) at t (...), s."""
        phase = 2 * np.pi * self.rate * np.asarray(t)
        sine, none = np.sin(phase), np.zeros_like(phase)
        turn = [self.tilt * sine, 0.6 * self.tilt * np.cos(phase), none]
        return np.asarray(REST @ se3.exp(np.stack([*turn, none, none, self.height * sine], -1)))


def random_run(seed: tuple[int, int], ticks: int) -> tuple[Path, Iterator[Tick]]:
    """A path, and `ticks` ticks of poses; the same seed gives the same ones."""
    draw = np.random.default_rng(seed)
    return random_path(draw), _ticks(draw, ticks)


def random_path(draw: Draw) -> Path:
    """Checkpoints far apart or close together, straight, curved, tilted or turned on the spot; all may be printed."""
    points = [_scattered, _curved, _raster][draw.integers(3)](draw)
    turns = np.cumsum(draw.normal(size=points.shape), axis=0) * draw.choice([0.0, 0.005, 0.05])
    poses = se3.make(se3.exp_rotation(np.clip(turns, -0.3, 0.3)), points)
    poses = poses[np.concatenate([[True], lengths(poses) >= 2 * NEAREST])]
    count = len(poses)
    return Path(
        poses,
        draw.uniform(1.0, draw.choice([5.0, 40.0, 120.0]), count),
        np.ones(count, np.int64),
        np.full(count, 20.0),
        np.zeros(count, np.int64),
        draw.random(count) < 0.9,
    )


def _scattered(draw: Draw) -> Array:
    return np.asarray(draw.uniform(-8, 8, (int(draw.integers(2, 12)), 3)) * [1, 1, 0.2])


def _curved(draw: Draw) -> Array:
    """Checkpoints 0.05 to 0.5 mm apart, as a dense planner gives them."""
    angle = np.linspace(0, draw.uniform(1, 12), int(draw.integers(40, 400)))
    radius = draw.uniform(2, 15) * (1 - 0.05 * angle)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), draw.uniform(-1, 1) * np.sin(angle)], -1)


def _raster(draw: Draw) -> Array:
    across = np.arange(-4, 4, draw.uniform(0.3, 2.0))
    ends = [[x, y, 0.0] for i, y in enumerate(across) for x in np.array([-6.0, 6.0]) * (-1) ** i]
    return np.array(ends)


def _ticks(draw: Draw, ticks: int) -> Iterator[Tick]:
    swing = Swing(*HEIGHTS[draw.integers(4)], float(draw.choice(RATES)))
    noise, trouble, doubt, fps = (draw.choice(kinds) for kinds in (NOISES, TROUBLES, DOUBTS, [6, 30, 60]))
    foreseen, warped = draw.random() < 0.3, draw.random() < 0.2
    now, taken, pose, jump = START, -1, None, np.eye(4)
    for _ in range(ticks):
        if (frame := int((now - START) * fps)) > taken:
            taken = frame
            if draw.random() < trouble / 5:
                jump = jump @ se3.exp(draw.normal(size=6) * WRONG)
            made = _pose(swing, now - draw.uniform(0, LATEST), draw, foreseen)
            if draw.random() < doubt:
                made = replace(made, covariance=made.covariance * draw.choice([30.0, 200.0]) ** 2)
            wrong = jump @ se3.exp(draw.normal(size=6) * noise * np.array([0.01] * 3 + [1.0] * 3))
            made = replace(made, base_from_surface=made.base_from_surface @ wrong)
            made = replace(made, warp=_warp(draw)) if warped else made
            pose = _spoilt(made, draw) if draw.random() < trouble else made
        yield now, pose
        now += TICK * (1 if draw.random() > STALL else int(draw.integers(4, 60)))


def _pose(swing: Swing, stamp: float, draw: Draw, foreseen: bool) -> SurfacePose:
    """The exact pose and twist at `stamp`, s."""
    step = 1e-4
    before, here, after = swing.at(stamp + np.array([-step, 0, step]))
    twist = se3.log(se3.inverse(before) @ after) / (2 * step)
    covariance = np.diag([1e-6] * 3 + [1e-4] * 3)
    state = TrackState.DEGRADED if draw.random() < 0.1 else TrackState.TRACKING
    forecast = None
    if foreseen:
        increments = se3.log(se3.inverse(here) @ swing.at(stamp + HORIZONS)) * draw.normal(1.0, 0.05)
        forecast = Forecast(HORIZONS, increments, covariance + HORIZONS[:, None, None] * 0.01 * np.eye(6))
    return SurfacePose(stamp, here, covariance, twist, state, forecast=forecast)


def _warp(draw: Draw) -> Warp:
    control = draw.uniform(-8, 8, (6, 3)) * [1, 1, 0]
    return Warp(control, draw.normal(size=(6, 3)) * 0.2, 1e-4 * np.eye(18), np.zeros((18, 18)), 8.0, 0.2, 0.01)


def _spoilt(pose: SurfacePose, draw: Draw) -> SurfacePose | None:
    """The pose with one thing wrong: not there, not measured, not finite, too fast, too far, older or newer."""
    put = partial(replace, pose)
    match int(draw.integers(10)):
        case 0:
            return None
        case 1:
            return put(state=TrackState.COASTING)
        case 2:
            return put(base_from_surface=np.full((4, 4), np.nan))
        case 3:
            return put(twist=np.array([0, 0, 0, np.inf, 0, 0]))
        case 4:
            return put(twist=pose.twist + draw.normal(size=6) * [1, 1, 1, 100, 100, 100])
        case 5:
            return put(covariance=np.full((6, 6), np.nan))
        case 6:
            return put(stamp=draw.choice([np.nan, -np.inf, 0.0, pose.stamp + 1.0]))
        case 7:
            return put(covariance=-pose.covariance)
        case 8:
            return put(base_from_surface=pose.base_from_surface @ se3.exp([*draw.normal(size=3), 0, 0, 0]))
        case _:
            return put(base_from_surface=pose.base_from_surface @ se3.exp(FAR))
