"""Boards waved before synthetic cameras, with everything known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.calibration.lens_model import BoardViews, project_lens
from estimation.se3 import Array

SIZE = (1280, 720)
LENSES = np.array(
    [
        [894.0, 896.0, 634.0, 361.0, -0.30, 0.10, 0.0, 0.0, 0.0],
        [980.0, 979.0, 647.0, 368.0, -0.08, 0.0, 0.0, 0.0, 0.0],
        [861.0, 861.5, 629.0, 353.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)
MODELS = ("k1 k2", "k1", "none")


@dataclass(frozen=True)
class Truth:
    """lens (C, 9); base_from_camera (C, 4, 4), the first the base; offset (C,) s, mean 0; jitter (V,) s."""

    lens: Array
    base_from_camera: Array
    offset: Array


def corners(columns: int = 4, rows: int = 5, square: float = 54.0) -> Array:
    """(P, 3) mm: the inner corners of a board of so many squares."""
    x, y = np.meshgrid(np.arange(1, columns), np.arange(1, rows))
    return np.stack([x.ravel() * square, y.ravel() * square, np.zeros(x.size)], 1)


def places() -> Array:
    """(3, 4, 4): three cameras 0, 30 and -35 degrees about a point 700 mm in front of the first."""
    centre = np.array([0.0, 0.0, 700.0])
    turns = se3.exp_rotation(np.radians([[0.0, 0.0, 0.0], [4.0, -30.0, 2.0], [-5.0, 35.0, -3.0]]))
    return se3.make(turns, centre - turns @ np.array([0.0, 0.0, 700.0]))


def motion(stamps: Array, rng: np.random.Generator, middle: Array, speed: float = 1.0) -> Array:
    """base_from_board (N, 4, 4) of a hand's slow sway at stamps (N,), s."""
    out = np.zeros((len(stamps), 6))
    for axis, size in enumerate((0.3, 0.35, 0.5, 110.0, 70.0, 90.0)):
        for rate in (0.11, 0.23, 0.41):
            phase, part = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 1.0)
            out[:, axis] += size * part * np.sin(2 * np.pi * rate * speed * stamps + phase) / (1 + 6 * rate)
    turned = se3.make(se3.exp_rotation(out[:, :3]), np.array([0.0, 0.0, 700.0]) + out[:, 3:])
    return np.asarray(turned @ se3.make(np.eye(3), -middle))


def waved(
    rng: np.random.Generator,
    instants: int = 40,
    rate: float = 8.0,
    noise: float = 0.15,
    offsets: tuple[float, ...] = (-0.016, 0.004, 0.012),
    jitter: float = 0.0,
    speed: float = 1.0,
    lenses: Array = LENSES,
) -> tuple[BoardViews, Truth]:
    """Views of a board waved before three cameras, and the truth."""
    points, base_from_camera = corners(), places()
    stamp = np.repeat(np.arange(instants) / rate, 3)
    camera = np.tile(np.arange(3), instants)
    late = np.array(offsets)[camera] + (rng.normal(0, jitter, len(stamp)) if jitter else 0.0)
    seed = int(rng.integers(1 << 30))
    boards = motion(stamp + late, np.random.default_rng(seed), points.mean(0), speed)
    inside = se3.transform_points(se3.inverse(base_from_camera)[camera] @ boards, points)
    pixels = project_lens(lenses[camera][:, None], inside)[0] + rng.normal(0, noise, (len(stamp), len(points), 2))
    hidden = (pixels < 3).any(-1) | (pixels > np.array(SIZE) - 4).any(-1)
    pixels[hidden] = np.nan
    views = BoardViews(
        ("top", "side", "front"),
        (SIZE,) * 3,
        points,
        camera,
        np.repeat(np.arange(instants), 3),
        stamp,
        pixels,
        np.full(len(stamp), noise),
    )
    return views.select(views.seen.sum(1) >= 6), Truth(lenses, base_from_camera, np.array(offsets))
