"""What a calibration's doubt does to points in the working volume, in millimetres.

Points that two cameras or more see are triangulated; how far lens, place and clock may be off moves them. What moves
all of them as one rigid body is no error for printing: the surface is followed in the same frame that it is printed in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.calibration.camera_rig import Calibration
from estimation.calibration.lens_model import image, lens_of
from estimation.calibration.rig_fit import OWN
from estimation.rig import Rig
from estimation.se3 import Array

SIDE = 5  # points of the grid along each axis
REACH = 0.9  # share of the board's places, along each axis, that the working volume holds


@dataclass(frozen=True, slots=True, eq=False)
class VolumeError:
    """Predicted errors over a working volume. points: (N, 3) mm, base. error: (N,) mm, one sigma in 3D by calibration.

    pixel: (N,) mm by one pixel's noise per camera. seen: (N,) cameras that see the point; fewer than two: nan.
    """

    points: Array
    error: Array
    pixel: Array
    seen: Array

    @property
    def typical(self) -> float:
        """Root mean square of the error, mm; nan where no point is seen by two cameras."""
        known = self.error[np.isfinite(self.error)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")

    @property
    def worst(self) -> float:
        """The error, mm, that nineteen points in twenty stay below; nan likewise."""
        known = self.error[np.isfinite(self.error)]
        return float(np.percentile(known, 95)) if len(known) else float("nan")


def working_volume(calibration: Calibration, side: int = SIDE) -> Array:
    """Grid (side^3, 3) mm, base, over where the board's corners were, without the outermost."""
    boards = calibration.fit.state.base_from_board
    corners = se3.transform_points(boards, calibration.views.points).reshape(-1, 3)
    low, high = np.percentile(corners, [50 - 50 * REACH, 50 + 50 * REACH], axis=0)
    axes = [np.linspace(a, b, side) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def predicted_error(calibration: Calibration, points: Array, speed: float = 0.0) -> VolumeError:
    """The error at points (N, 3) mm, base, of a surface that moves at `speed`, mm/s, in any direction."""
    return volume_error(calibration.rig, calibration.fit.covariance, points, speed)


def volume_error(rig: Rig, covariance: Array, points: Array, speed: float = 0.0) -> VolumeError:
    """As `predicted_error`, of a rig with the covariance (16 C, 16 C) of its cameras' numbers."""
    count, cameras = len(points), len(rig)
    by_point, by_rig, seen = np.zeros((count, 2 * cameras, 3)), np.zeros((count, 2 * cameras, OWN * cameras)), []
    for c, camera in enumerate(rig.cameras):
        camera_from_base = se3.inverse(camera.base_from_camera)
        inside = se3.transform_points(camera_from_base, points)
        front = inside[:, 2] > 1.0
        inside[:, 2] = np.where(front, inside[:, 2], 1.0)
        pixels, by_lens, by_place = image(lens_of(camera), inside)
        visible = front & (pixels >= 0).all(1) & (pixels <= np.array(camera.size) - 1).all(1)
        rows, columns = slice(2 * c, 2 * c + 2), OWN * c
        by_point[:, rows] = np.where(visible[:, None, None], by_place @ camera_from_base[:3, :3], 0.0)
        own = np.concatenate([by_lens, by_place @ se3.hat(inside), -by_place], -1)
        by_rig[:, rows, columns : columns + 15] = np.where(visible[:, None, None], own, 0.0)
        seen.append(visible)
    number = np.sum(seen, axis=0)
    held = np.swapaxes(by_point, 1, 2) @ by_point
    held = np.where((number >= 2)[:, None, None], held, np.eye(3))
    spread = np.linalg.inv(held)
    moves = -spread @ np.swapaxes(by_point, 1, 2) @ by_rig  # (N, 3, 16 C)
    known = number >= 2
    error, pixel = np.full(count, np.nan), np.sqrt(np.trace(spread, axis1=1, axis2=2))
    if known.any():
        moved = _without_rigid(points[known], moves[known])
        late = _by_clock(covariance, spread[known], by_point[known], cameras, speed)
        variance = np.einsum("nia,ab,nib->n", moved, covariance, moved) + late
        error[known] = np.sqrt(np.maximum(variance, 0.0))
    return VolumeError(points, error, np.where(known, pixel, np.nan), number.astype(float))


def _without_rigid(points: Array, moves: Array) -> Array:
    """Moves (N, 3, K) of points less the rigid motion of all of them that comes nearest; a single point keeps none."""
    middle = points - points.mean(0)
    size = max(float(np.abs(middle).max()), 1.0)
    rigid = np.concatenate([-se3.hat(middle / size), np.broadcast_to(np.eye(3), (len(points), 3, 3))], -1)
    base = np.linalg.svd(rigid.reshape(-1, 6), full_matrices=False)
    basis = base[0][:, base[1] > 1e-9 * base[1][0]]
    flat = moves.reshape(-1, moves.shape[-1])
    return np.asarray((flat - basis @ (basis.T @ flat)).reshape(moves.shape))


def _by_clock(covariance: Array, spread: Array, by_point: Array, cameras: int, speed: float) -> Array:
    """Variance (N,), mm^2, by what the offsets may be off by, at `speed` mm/s, in the mean over all directions."""
    if not speed:
        return np.zeros(len(spread))
    offsets = covariance[15::OWN, 15::OWN]
    out = np.zeros(len(spread))
    for direction in np.eye(3):
        pulls = [
            spread
            @ np.swapaxes(by_point[:, 2 * c : 2 * c + 2], 1, 2)
            @ (by_point[:, 2 * c : 2 * c + 2] @ direction)[..., None]
            for c in range(cameras)
        ]
        by_offset = np.concatenate(pulls, -1) * speed  # (N, 3, C)
        out += np.einsum("nia,ab,nib->n", by_offset, offsets, by_offset) / 3
    return out
