"""A board's corners in a picture: where they are, how well each is told, and how sharp the picture is there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from perception.boards.board import Board, charuco
from perception.frames import Image

LEAST = 4  # corners: fewer do not fix a plane
STEPS, DONE = 10, 1e-3  # most steps of a corner's refinement; px that are not worth another one
WINDOW = (2, 9)  # px, half: smaller holds no edge, larger meets the next corner of what is far away
REACH = 0.4  # of a square, that is looked at along an edge: beyond half, the next corner's edges begin
HALVES = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])  # of a square, to both sides along both axes
FRINGE, NARROWEST = 2.0, 1.5  # px about an edge that its blur fills: between the window and the markers; in it
FINEST = 0.01  # px; rendered pictures without noise leave as much
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
    """The corners to fractions of a pixel, and half the window that was looked at, px.

    Where the gradients about a corner are all square to the way there (Foerstner and Guelch 1987), as OpenCV's
    cornerSubPix has it, but of the two edges alone: a window in the board's own axes keeps clear of the markers and is
    still long along the edges.
    """
    seen = np.flatnonzero(np.isfinite(pixels[:, 0]))
    half = int(np.clip(REACH * _spacing(board, pixels), *WINDOW))
    turn = _squares_from_pixels(board, pixels)
    out, known = np.full_like(pixels, np.nan), np.isfinite(turn).all((1, 2))
    seen, at, turn = seen[known], pixels[seen[known]], turn[known]
    size = np.array(grey.shape[::-1])
    for _ in range(STEPS):
        near = np.round(at).astype(int)
        inside = (near >= half + 1).all(1) & (near <= size - half - 2).all(1)
        seen, at, near, turn = seen[inside], at[inside], near[inside], turn[inside]
        if not len(seen):
            break
        slopes, places = _slopes(grey, near, half)
        weight = _weights(board, places - at[:, None], turn, half)
        tensor = np.einsum("np,npi,npj->nij", weight, slopes, slopes) + np.eye(2)
        pull = np.einsum("np,npi,np->ni", weight, slopes, (slopes * (places - at[:, None])).sum(-1))
        step = np.linalg.solve(tensor, pull[..., None])[..., 0]
        at = at + step
        kept = np.linalg.norm(at - pixels[seen], axis=1) < max(half / 2, 1.5)
        seen, at, turn, step = seen[kept], at[kept], turn[kept], step[kept]
        if np.abs(step).max(initial=0.0) < DONE:
            break
    out[seen] = at
    return out, half


def _slopes(grey: Image, near: NDArray[np.int64], half: int) -> tuple[Array, Array]:
    """Grey levels per pixel (N, K, 2) in windows about pixels (N, 2), and where they are (N, K, 2)."""
    y, x = np.mgrid[-half - 1 : half + 2, -half - 1 : half + 2]
    part = grey[near[:, 1, None, None] + y, near[:, 0, None, None] + x].astype(float)
    gx, gy = (part[:, 1:-1, 2:] - part[:, 1:-1, :-2]) / 2, (part[:, 2:, 1:-1] - part[:, :-2, 1:-1]) / 2
    places = np.stack([x[1:-1, 1:-1].ravel(), y[1:-1, 1:-1].ravel()], -1) + near[:, None].astype(float)
    return np.stack([gx, gy], -1).reshape(len(near), -1, 2), places


def _weights(board: Board, away: Array, squares_from_pixels: Array, half: int) -> Array:
    """(N, K) what gradients `away` (N, K, 2), px, from a corner are worth: those of its own edges, less far out."""
    along = np.abs(away @ np.swapaxes(squares_from_pixels, 1, 2))  # in squares, along the board's two axes
    per_pixel = np.linalg.norm(squares_from_pixels, axis=-1)[:, None]  # (N, 1, 2) squares, square to the edges
    white = (1 - board.marker) / 2 if board.kind == "charuco" else REACH
    room = np.maximum(white / per_pixel - FRINGE, NARROWEST)
    edges = (along / per_pixel < room).any(-1) & (along < REACH).all(-1)
    return np.where(edges, np.exp(-(away**2).sum(-1) / half**2), 0.0)


def _squares_from_pixels(board: Board, pixels: Array) -> Array:
    """(N, 2, 2) squares along the board's axes per pixel about each corner that is seen, by the plane of all of them.

    nan where they tell no plane.
    """
    seen = np.isfinite(pixels[:, 0])
    squares = board.corners[seen, :2] / board.square
    plane = cv2.findHomography(squares, pixels[seen])[0]
    if plane is None:
        return np.full((len(squares), 2, 2), np.nan)
    ends = [cv2.perspectiveTransform((squares + e)[:, None], plane)[:, 0] for e in HALVES]
    across = np.stack([ends[0] - ends[1], ends[2] - ends[3]], -1)
    flat = np.abs(np.linalg.det(across)) < 1.0  # px^2 of a square
    return np.where(flat[:, None, None], np.nan, np.linalg.inv(np.where(flat[:, None, None], np.eye(2), across)))


def _spacing(board: Board, pixels: Array) -> float:
    """Least distance, px, between neighbouring corners."""
    grid = pixels.reshape(board.squares[1] - 1, board.squares[0] - 1, 2)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    found = np.concatenate(steps)
    found = found[np.isfinite(found)]
    return float(found.min()) if len(found) else float(WINDOW[0]) / REACH


def _quality(board: Board, grey: Image, pixels: Array, half: int) -> tuple[float, float]:
    """sigma and blur as `Found` has them."""
    seen = np.flatnonzero(np.isfinite(pixels[:, 0]))
    if len(seen) < LEAST:
        return 0.0, 0.0
    at = pixels[seen]
    near = np.round(at).astype(int)
    slopes, places = _slopes(grey, near, half)
    weight = _weights(board, places - at[:, None], _squares_from_pixels(board, pixels), half)
    tensor, spread = (np.einsum("np,npi,npj->nij", w, slopes, slopes) for w in (weight, weight**2))
    inverse = np.linalg.inv(tensor + np.eye(2))
    sigma = _noise(grey, at) * np.sqrt(np.trace(inverse @ spread @ inverse, axis1=1, axis2=2) / 2)
    y, x = np.mgrid[-half - 1 : half + 2, -half - 1 : half + 2].reshape(2, -1)
    levels = np.percentile(grey[near[:, 1, None] + y, near[:, 0, None] + x], [5, 95], axis=1)
    steepest = np.percentile(np.abs(slopes @ _axes(board, pixels).T), 98, axis=1).min(1)
    blur = (levels[1] - levels[0]) / np.maximum(steepest, 1e-3) / STEP
    return max(float(np.median(sigma)), FINEST), float(np.median(blur))


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
