"""A board's corners in a picture: where they are, how well each is told, and how sharp the picture is there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from estimation.se3 import Array
from perception.boards.board import Board, charuco
from perception.frames import Image

LEAST = 4  # corners: fewer do not fix a plane
STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-4)
WINDOW = (2, 9)  # px, half: smaller holds no edge, larger meets the next corner of what is far away
ROOM = 0.35  # of the distance to the next corner, half of the window at most
CLEAR = 0.9  # of the white between a corner and the markers beside it: a marker in the window pulls by 0.1 px
FINEST = 0.02  # px
STEP = 2.5066  # sqrt(2 pi): a step blurred by one sigma rises by 1 / (2.5066 sigma) a pixel


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The corners of one picture.

    pixels: (P, 2), nan where not seen. sigma: px, one standard deviation per axis that the picture's noise and the
    edges' slopes make. blur: px, one sigma of the edges, the worse of the board's two directions. marker: measured
    edge of the markers in parts of a square's, nan without markers. strangers: ids of markers that the board has not.
    """

    pixels: Array
    sigma: float
    blur: float
    marker: float
    strangers: tuple[int, ...]

    @property
    def count(self) -> int:
        """How many corners were seen."""
        return int(np.isfinite(self.pixels[:, 0]).sum())


class CornerFinder:
    """Finds a board's corners; made once for many pictures, and not shared between threads."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self._charuco = cv2.aruco.CharucoDetector(charuco(board)) if board.kind == "charuco" else None

    def __call__(self, image: Image) -> Found:
        """The corners of a picture (H, W) grey or (H, W, 3) BGR."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if self.board.inverted:
            grey = 255 - grey
        grey = np.ascontiguousarray(grey, np.uint8)
        pixels, marker, strangers = self._with_markers(grey)
        if np.isfinite(pixels[:, 0]).sum() < LEAST:
            return Found(np.full_like(pixels, np.nan), 0.0, 0.0, marker, strangers)
        pixels, window = _refined(self.board, grey, pixels)
        sigma, blur = _quality(self.board, grey, pixels, window)
        return Found(pixels, sigma, blur, marker, strangers)

    def _with_markers(self, grey: Image) -> tuple[Array, float, tuple[int, ...]]:
        """Corners to a pixel, the markers' size, and strangers among them."""
        if self._charuco is None:
            return _chessboard(self.board, grey), float("nan"), ()
        at, number, squares, ids = self._charuco.detectBoard(grey)
        pixels = np.full((len(self.board.corners), 2), np.nan)
        if number is not None and len(number) >= LEAST:
            pixels[np.ravel(number)] = np.asarray(at, float).reshape(-1, 2)
        found = () if ids is None else tuple(sorted({int(i) for i in np.ravel(ids)}))
        strangers = tuple(i for i in found if i >= self.board.markers())
        return pixels, _marker_size(self.board, pixels, squares), strangers


def _marker_size(board: Board, pixels: Array, squares: object) -> float:
    """Median edge of the markers in the plane of the corners, in parts of a square's; nan where it is not told."""
    seen = np.isfinite(pixels[:, 0])
    if seen.sum() < 6 or squares is None or not len(squares):  # type: ignore[arg-type]
        return float("nan")
    plane, _ = cv2.findHomography(pixels[seen], board.corners[seen, :2] / board.square)
    if plane is None:
        return float("nan")
    corners = np.asarray(squares, float).reshape(-1, 4, 2)
    flat = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), plane).reshape(-1, 4, 2)
    return float(np.median(np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=-1)))


def _chessboard(board: Board, grey: Image) -> Array:
    """Corners (P, 2) of a chessboard without markers, or nan; counted from where the colours are as drawn."""
    columns, rows = board.squares[0] - 1, board.squares[1] - 1
    ok, found = cv2.findChessboardCornersSB(grey, (columns, rows), flags=cv2.CALIB_CB_ACCURACY)
    if not ok:
        return np.full((columns * rows, 2), np.nan)
    grid = np.asarray(found, float).reshape(rows, columns, 2)
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0:
        grid = grid[:, ::-1]  # no board is seen from behind
    if not _first_is_dark(grey, grid):
        grid = grid[::-1, ::-1]
    return grid.reshape(-1, 2)


def _first_is_dark(grey: Image, grid: Array) -> bool:
    """Whether the square right and below of the first inner corner is the darker one of the first two."""
    centres = np.stack([grid[:2, k : k + 2].mean((0, 1)) for k in (0, 1)])
    levels = [float(cv2.getRectSubPix(grey, (5, 5), tuple(map(float, c))).mean()) for c in centres]
    return levels[0] < levels[1]


def _refined(board: Board, grey: Image, pixels: Array) -> tuple[Array, int]:
    """The corners to fractions of a pixel, and half the window that was looked at, px."""
    seen = np.flatnonzero(np.isfinite(pixels[:, 0]))
    room = ROOM if board.kind == "chessboard" else CLEAR * (1 - board.marker) / 2
    window = int(np.clip(room * _spacing(board, pixels), *WINDOW))
    at = np.ascontiguousarray(pixels[seen], np.float32).reshape(-1, 1, 2)
    fine = cv2.cornerSubPix(grey, at.copy(), (window, window), (-1, -1), STEPS).reshape(-1, 2).astype(float)
    height, width = grey.shape
    near = np.linalg.norm(fine - pixels[seen], axis=1) < max(window / 2, 1.5)
    inside = (fine >= window + 1).all(1) & (fine <= np.array([width, height]) - window - 2).all(1)
    out = np.full_like(pixels, np.nan)
    out[seen[near & inside]] = fine[near & inside]
    return out, window


def _spacing(board: Board, pixels: Array) -> float:
    """Least distance, px, between neighbouring corners."""
    grid = pixels.reshape(board.squares[1] - 1, board.squares[0] - 1, 2)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    found = np.concatenate(steps)
    found = found[np.isfinite(found)]
    return float(found.min()) if len(found) else float(WINDOW[0]) / ROOM


def _quality(board: Board, grey: Image, pixels: Array, window: int) -> tuple[float, float]:
    """sigma and blur as `Found` has them."""
    seen = np.flatnonzero(np.isfinite(pixels[:, 0]))
    if not len(seen):
        return 0.0, 0.0
    axes = _axes(board, pixels)
    sigmas, blurs = [], []
    noise = _noise(grey, pixels[seen])
    for at in pixels[seen]:
        x, y = np.round(at).astype(int)
        part = grey[y - window - 1 : y + window + 2, x - window - 1 : x + window + 2].astype(np.float32)
        gx, gy = (part[1:-1, 2:] - part[1:-1, :-2]) / 2, (part[2:, 1:-1] - part[:-2, 1:-1]) / 2
        slopes = np.stack([gx.ravel(), gy.ravel()], 1)
        tensor = slopes.T @ slopes + np.eye(2)
        sigmas.append(noise * np.sqrt(np.trace(np.linalg.inv(tensor)) / 2))
        contrast = float(np.percentile(part, 95) - np.percentile(part, 5))
        steepest = min(float(np.percentile(np.abs(slopes @ axis), 98)) for axis in axes)
        blurs.append(contrast / max(steepest, 1e-3) / STEP)
    return max(float(np.median(sigmas)), FINEST), float(np.median(blurs))


def _axes(board: Board, pixels: Array) -> Array:
    """(2, 2) unit directions, in the picture, of what the edges along either side of the board are steepest in."""
    grid = pixels.reshape(board.squares[1] - 1, board.squares[0] - 1, 2)
    out = []
    for axis in (0, 1):
        steps = np.diff(grid, axis=axis).reshape(-1, 2)
        steps = steps[np.isfinite(steps[:, 0])]
        way = steps.sum(0) if len(steps) else np.eye(2)[axis]
        normal = np.array([-way[1], way[0]])
        out.append(normal / max(float(np.linalg.norm(normal)), 1e-9))
    return np.array(out)


def _noise(grey: Image, at: Array) -> float:
    """Grey levels, one sigma, about the board (Immerkaer 1996, by the median, which the edges do not pull)."""
    low = np.maximum(np.floor(at.min(0)).astype(int), 0)
    high = np.ceil(at.max(0)).astype(int) + 1
    part = grey[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    if min(part.shape) < 8:
        return 2.0
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    return max(float(np.median(np.abs(cv2.filter2D(part, -1, mask)[1:-1, 1:-1]))) / 0.6745 / 6, 0.5)
