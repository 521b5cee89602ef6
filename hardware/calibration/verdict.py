"""Whether a calibration is good enough to print with, in words that a technician understands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.calibration.camera_rig import Calibration
from estimation.calibration.lens_model import image
from estimation.calibration.validation import VolumeError
from estimation.se3 import Array

LIMIT = 0.1  # mm: what printing needs of the rig in the working volume, one sigma in 3D
RESIDUAL = 0.5  # px, median of the corners


@dataclass(frozen=True, slots=True)
class Verdict:
    """passed, and why: one sentence per line, the decisive one first. hints: what to do, empty where it passed."""

    passed: bool
    lines: tuple[str, ...]
    hints: tuple[str, ...]


def residual(calibration: Calibration, camera: int | None = None) -> float:
    """Median distance, px, of corners from where the rig puts them; of one camera, or of all."""
    away = np.linalg.norm(calibration.fit.residuals, axis=-1)
    return float(np.nanmedian(away if camera is None else away[calibration.views.camera == camera]))


def held_out(calibration: Calibration, camera: int | None = None) -> float:
    """As `residual`, under a rig that was calibrated without the views' own stretch of the recording."""
    away = np.linalg.norm(calibration.held_out, axis=-1)
    away = away if camera is None else away[calibration.views.camera == camera]
    return float(np.nanmedian(away)) if np.isfinite(away).any() else float("nan")


def judge(calibration: Calibration, error: VolumeError, limit: float, hints: tuple[str, ...]) -> Verdict:
    """The verdict. limit: mm, of the predicted error in 19 of 20 points of the working volume."""
    off, spread = residual(calibration), error.worst
    good = [spread <= limit, off <= RESIDUAL]
    word = "good enough" if good[0] else "NOT good enough"
    lines = [
        f"{word} to print: points in the working volume are off by {error.typical:.3f} mm (one sigma), 19 of 20 by "
        f"less than {spread:.3f} mm; {limit:g} mm is allowed",
        f"corners lie {off:.2f} px from where they should (median); {RESIDUAL:g} px is allowed; "
        f"{held_out(calibration):.2f} px in stretches of the recording that were held out",
    ]
    if calibration.jitter:
        lines.append(f"pictures are late by {1e3 * calibration.jitter:.1f} ms each for itself: the cameras run free")
    return Verdict(all(good), tuple(lines), () if all(good) else hints)


def board_scatter(calibration: Calibration) -> float:
    """Root mean square error, mm, of distances between corners triangulated at instants that two cameras share.

    Neighbouring corners, each triangulated where the rig's own motion of the board puts the views.
    """
    views, state = calibration.views, calibration.fit.state
    rays = _triangulated(calibration)
    out = []
    for i in range(len(state.base_from_board)):
        known = np.isfinite(rays[i, :, 0])
        a, b = rays[i, known], views.points[known]
        if len(a) > 1:
            rows = np.triu_indices(len(a), 1)
            found, true = (np.linalg.norm(p[rows[0]] - p[rows[1]], axis=1) for p in (a, b))
            out.append(found - true)
    return float(np.sqrt(np.mean(np.concatenate(out) ** 2))) if out else float("nan")


def _triangulated(calibration: Calibration) -> Array:
    """Corners (S, P, 3) mm, base, nan where fewer than two cameras saw one, at their instant's own time."""
    views, fit = calibration.views, calibration.fit
    state, cameras = fit.state, len(views.names)
    corners = se3.transform_points(state.base_from_board, views.points)
    held = np.zeros((len(corners), views.pixels.shape[1], 3, 3))
    pull, count = np.zeros((*held.shape[:3],)), np.zeros(held.shape[:2])
    for c in range(cameras):
        rows = np.flatnonzero(views.camera == c)
        camera_from_base = se3.inverse(state.base_from_camera[c])
        at = corners[views.instant[rows]]
        by_point = image(state.lens[c], se3.transform_points(camera_from_base, at))[2] @ camera_from_base[:3, :3]
        seen = views.seen[rows]
        rest = np.where(seen[..., None], fit.residuals[rows], 0.0)
        by_point = np.where(seen[..., None, None], by_point, 0.0)
        np.add.at(held, views.instant[rows], np.swapaxes(by_point, -1, -2) @ by_point)
        np.add.at(pull, views.instant[rows], np.einsum("vpij,vpi->vpj", by_point, rest))
        np.add.at(count, views.instant[rows], seen)
    held = np.where((count >= 2)[..., None, None], held, np.eye(3))
    found = corners - np.linalg.solve(held, pull[..., None])[..., 0]
    return np.where((count >= 2)[..., None], found, np.nan)
