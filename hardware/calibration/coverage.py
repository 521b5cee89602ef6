"""Where the board was held, and where it should still be held: which camera, which part of its picture, which tilt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.calibration.camera_rig import Calibration
from estimation.se3 import Array

GRID = (4, 3)  # parts of a picture, across and down
PARTS = (("left", "left of the middle", "right of the middle", "right"), ("top", "middle", "bottom"))
HELD = 20  # corners that a part should have
TILT = np.radians(15)  # beyond it a board counts as tilted; below, it tells no focal length
SHARE = 0.08  # of the views that each tilt should have
TILTS = ("its left side nearer", "its right side nearer", "its top nearer", "its bottom nearer")
DEEP = 1.3  # times the near views' distance, that the far ones should have: focal lengths hang on depth
ENDS = (10, 90)  # percentiles of the distances that count as near and far


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Of one camera. parts: (rows, columns) corners in each part. tilts: (4,) share of the views that tilt so.

    depth: how many times as far away the far views are as the near ones, 1 without views.
    """

    parts: Array
    tilts: Array
    depth: float


def coverage_of(pixels: Array, size: tuple[int, int], camera_from_board: Array) -> Coverage:
    """Of views with corners (V, P, 2) px, nan where not seen, and poses (V, 4, 4); size: (W, H) px."""
    return covered(parts_of(pixels, size), looks_of(camera_from_board))


def covered(parts: Array, looks: Array) -> Coverage:
    """By the corners in each part (rows, columns) and how the board was held in each view (V, 3), as `looks_of`."""
    if not len(looks):
        return Coverage(parts, np.zeros(4), 1.0)
    across, up, depth = looks.T
    tilted = [across < -TILT, across > TILT, up < -TILT, up > TILT]
    near, far = np.percentile(depth, ENDS)
    return Coverage(parts, np.array([t.mean() for t in tilted]), float(far / near))


def looks_of(camera_from_board: Array) -> Array:
    """(V, 3) of poses (V, 4, 4): how far the board is turned across and up, rad, and its distance, mm."""
    back = camera_from_board[:, :3, 2]  # the board's, in the camera
    across, up = np.arctan2(back[:, 0], back[:, 2]), np.arctan2(back[:, 1], back[:, 2])
    return np.stack([across, up, camera_from_board[:, 2, 3]], 1)


def parts_of(pixels: Array, size: tuple[int, int]) -> Array:
    """(rows, columns) corners in each part of a picture of `size` (W, H) px; pixels (..., 2), nan where not seen."""
    at = pixels[np.isfinite(pixels[..., 0])]
    w, h = size
    return np.asarray(np.histogram2d(at[:, 1], at[:, 0], bins=GRID[::-1], range=((0, h), (0, w)))[0])


def coverage(calibration: Calibration, camera: int) -> Coverage:
    """The coverage of one camera."""
    views, state = calibration.views, calibration.fit.state
    rows = views.camera == camera
    camera_from_board = se3.inverse(state.base_from_camera[camera]) @ state.base_from_board[views.instant[rows]]
    return coverage_of(views.pixels[rows], views.sizes[camera], camera_from_board)


def lacking(name: str, held: Coverage) -> list[tuple[float, str]]:
    """What one camera still needs, in words, each with how much of it is missing, 0 to 1."""
    said: list[tuple[float, str]] = []
    empty = np.argwhere(held.parts < HELD)
    if len(empty):
        places = [f"{PARTS[1][row]} {PARTS[0][column]}" for row, column in empty[:3]]
        more = f" and {len(empty) - 3} other parts" if len(empty) > 3 else ""
        words = f"{name}: hold the board in its picture's {', '.join(places)}{more}"
        said.append((len(empty) / held.parts.size, words))
    missing = [TILTS[k] for k in np.flatnonzero(held.tilts < SHARE)]
    if missing:
        said.append((len(missing) / 4, f"{name}: tilt the board by 30 degrees: {', '.join(missing)}"))
    if held.depth < DEEP:
        said.append((1 - (held.depth - 1) / (DEEP - 1), f"{name}: hold the board nearer to it, and farther away"))
    return said


def hints(calibration: Calibration) -> tuple[str, ...]:
    """What to do next, the worst first; nothing where all is covered."""
    said = [one for c, name in enumerate(calibration.views.names) for one in lacking(name, coverage(calibration, c))]
    return tuple(words for _, words in sorted(said, key=lambda one: -one[0]))
