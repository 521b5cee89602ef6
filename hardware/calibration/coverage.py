"""Where the board was held, and where it should still be held: which camera, which part of its picture, which tilt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.camera_calibration.calibrate import Calibration
from estimation.camera_calibration.views import Views
from estimation.se3 import Array

GRID = (4, 3)  # parts of a picture, across and down
PARTS = (("left", "left of the middle", "right of the middle", "right"), ("top", "middle", "bottom"))
HELD = 20  # corners that a part should have
TILT = np.radians(15)  # beyond it a board counts as tilted; below, it tells no focal length
SHARE = 0.08  # of the views that each tilt should have
TILTS = ("its left side nearer", "its right side nearer", "its top nearer", "its bottom nearer")


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Of one camera. parts: (rows, columns) corners in each part. tilts: (4,) share of the views that tilt so."""

    parts: Array
    tilts: Array


def parts_of(views: Views, camera: int) -> Array:
    """(rows, columns) how many corners of one camera lie in each part of its picture."""
    pixels = views.pixels[views.camera == camera].reshape(-1, 2)
    pixels = pixels[np.isfinite(pixels[:, 0])]
    w, h = views.sizes[camera]
    counts = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=GRID[::-1], range=((0, h), (0, w)))[0]
    return np.asarray(counts)


def coverage(calibration: Calibration, camera: int) -> Coverage:
    """The coverage of one camera."""
    views, state = calibration.views, calibration.fit.state
    boards = state.base_from_board[views.instant[views.camera == camera]]
    away = boards[:, :3, 2] @ state.base_from_camera[camera][:3, :3]  # the board's back, in the camera
    across, up = np.arctan2(away[:, 0], away[:, 2]), np.arctan2(away[:, 1], away[:, 2])
    tilted = [across < -TILT, across > TILT, up < -TILT, up > TILT]
    return Coverage(parts_of(views, camera), np.array([t.mean() for t in tilted]))


def hints(calibration: Calibration) -> tuple[str, ...]:
    """What to do next, the worst camera first; nothing where all is covered."""
    said: list[tuple[float, str]] = []
    for c, name in enumerate(calibration.views.names):
        held = coverage(calibration, c)
        empty = np.argwhere(held.parts < HELD)
        if len(empty):
            places = [f"{PARTS[1][row]} {PARTS[0][column]}" for row, column in empty[:3]]
            more = f" and {len(empty) - 3} other parts" if len(empty) > 3 else ""
            said.append(
                (len(empty) / held.parts.size, f"{name}: hold the board in its picture's {', '.join(places)}{more}")
            )
        missing = [TILTS[k] for k in np.flatnonzero(held.tilts < SHARE)]
        if missing:
            said.append((len(missing) / 4, f"{name}: tilt the board by 30 degrees: {', '.join(missing)}"))
    return tuple(words for _, words in sorted(said, key=lambda one: -one[0]))
