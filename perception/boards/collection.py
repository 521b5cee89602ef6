"""The corners of a whole recording, and which of its pictures are worth calibrating from."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.camera_calibration.lens_fit import LEAST_CORNERS
from estimation.camera_calibration.views import Views
from estimation.se3 import Array
from perception.boards.board import Board

BLURRED = 4.0  # px, one sigma of an edge: beyond it corners of two squares run into each other
SHAKEN = 2.5  # times the camera's usual blur, and
SHARP = 1.5  # px at least: what is dropped must be blurred, not only less sharp
THIN = 0.02  # least spread of the corners across, in parts of that along: in a line they fix no plane
MOST_INSTANTS = 250  # taken evenly from longer recordings: more would cost minutes and add nothing that is new


@dataclass(frozen=True, slots=True, eq=False)
class CornerTable:
    """One row per picture that shows the board.

    camera, instant: (V,) numbers. stamp: (V,) s, as the camera told it. pixels: (V, P, 2), nan where not seen. sigma,
    blur: (V,) px. marker: (V,) measured edge of the markers in parts of a square's. looked: (C,) pictures looked at.
    strangers: ids of markers that the board has not, each as often as it was seen. done: instants looked at.
    """

    camera: NDArray[np.int64]
    instant: NDArray[np.int64]
    stamp: Array
    pixels: Array
    sigma: Array
    blur: Array
    marker: Array
    looked: NDArray[np.int64]
    strangers: NDArray[np.int64]
    done: int

    def __len__(self) -> int:
        return len(self.camera)


def empty_table(board: Board, cameras: int) -> CornerTable:
    """Of a recording that nobody looked at yet."""
    none, whole = np.zeros(0), np.zeros(0, np.int64)
    pixels = np.zeros((0, len(board.corners), 2))
    return CornerTable(whole, whole, none, pixels, none, none, none, np.zeros(cameras, np.int64), whole, 0)


def usable(
    table: CornerTable, board: Board, names: tuple[str, ...], sizes: tuple[tuple[int, int], ...]
) -> tuple[Views, Counter[tuple[str, str]]]:
    """The views that are worth using, and how many others each camera had, by camera and reason."""
    reasons = [_reason(table, row) for row in range(len(table))]
    kept = np.array([not reason for reason in reasons], bool)
    dropped = Counter((names[c], reason) for c, reason in zip(table.camera, reasons, strict=True) if reason)
    chosen = thinned(table.instant, kept)
    dropped.update((names[c], "more than are needed") for c in table.camera[kept & ~chosen])
    points, sigma = board.corners, np.maximum(table.sigma, 1e-3)
    views = Views(names, sizes, points, table.camera, table.instant, table.stamp, table.pixels, sigma)
    return views.only(chosen), dropped


def _reason(table: CornerTable, row: int) -> str:
    """Why a view is of no use, or ''."""
    pixels = table.pixels[row]
    pixels = pixels[np.isfinite(pixels[:, 0])]
    if len(pixels) < LEAST_CORNERS:
        return f"fewer than {LEAST_CORNERS} corners"
    spread = np.linalg.svd(pixels - pixels.mean(0), compute_uv=False)
    if spread[1] < THIN * spread[0]:
        return "corners nearly in one line"
    usual = float(np.median(table.blur[table.camera == table.camera[row]]))
    if table.blur[row] > max(min(SHAKEN * usual, BLURRED), SHARP):
        return "blurred"
    return ""


def thinned(instant: NDArray[np.int64], kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(V,) the rows of at most MOST_INSTANTS of the instants that are kept: runs of neighbours, spread over all.

    Neighbours are kept together since the motion between the instants is told by them.
    """
    there = np.unique(instant[kept])
    if len(there) <= MOST_INSTANTS:
        return kept
    runs = np.array_split(there, MOST_INSTANTS // 10)
    chosen = np.concatenate([run[:10] for run in runs])
    return np.asarray(kept & np.isin(instant, chosen))
