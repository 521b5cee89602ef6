"""A printed calibration board, and its corners in pictures.

A chessboard, with markers in its white squares (ChArUco) or without; each corner with its sigma and its blur; tables of
a recording's corners for calibration. Also undistorted pictures for reports (thesis 4.2): with every pixel, black where
there is none.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.calibration.lens_fit import MIN_VIEW_CORNERS
from estimation.calibration.lens_model import BoardViews
from estimation.rig import Camera
from estimation.se3 import Array
from perception.frames import Image

BOARD_KINDS = ("charuco", "chessboard")
_NAMES = [f"{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)]
DICTIONARIES = {name: getattr(cv2.aruco, f"DICT_{name}") for name in _NAMES}  # OpenCV's names without DICT_
THUMBNAIL_QUALITY = 80  # of the JPEG, 0 to 100


@dataclass(frozen=True, slots=True)
class Board:
    """A board's pattern. A chessboard has no markers: `marker`, `dictionary` and `legacy` do not matter."""

    kind: str = "charuco"
    squares: tuple[int, int] = (7, 10)  # columns and rows
    square: float = 25.0  # mm, edge
    marker: float = 0.75  # ratio of a marker's edge to a square's
    dictionary: str = "4X4_50"  # a key of DICTIONARIES
    inverted: bool = False  # printed with black and white exchanged
    legacy: bool = False  # the layout of OpenCV before 4.6, which differs for an even number of rows

    @property
    def corners(self) -> Array:
        """(P, 3) mm: the inner corners row by row, x along the columns, y down the rows, z away from the viewer."""
        x, y = np.meshgrid(np.arange(1, self.squares[0]), np.arange(1, self.squares[1]))
        return np.stack([x.ravel() * self.square, y.ravel() * self.square, np.zeros(x.size)], 1)

    @property
    def size(self) -> tuple[float, float]:
        """(W, H) mm of the printed pattern."""
        return self.squares[0] * self.square, self.squares[1] * self.square

    def markers(self) -> int:
        """Number of markers."""
        return 0 if self.kind == "chessboard" else self.squares[0] * self.squares[1] // 2

    def __str__(self) -> str:
        columns, rows = self.squares
        text = f"{self.kind} of {columns} x {rows} squares of {self.square:g} mm"
        if self.kind == "charuco":
            text += f", markers {self.marker:g} of a square, {self.dictionary}"
        return text + (", inverted" if self.inverted else "") + (", legacy layout" if self.legacy else "")


def charuco_board(board: Board) -> cv2.aruco.CharucoBoard:
    """OpenCV's own record of a ChArUco board."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[board.dictionary])
    charuco = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker * board.square, dictionary)
    charuco.setLegacyPattern(board.legacy)
    return charuco


def ink_cells(board: Board) -> tuple[NDArray[np.bool_], float]:
    """The print as a grid of cells (see `cells_per_square`), True where there is ink (H, W), and a cell's edge, mm."""
    per_square = cells_per_square(board)
    columns, rows = board.squares
    y, x = np.indices((rows, columns))
    dark = (x + y) % 2 == (1 if board.legacy and rows % 2 == 0 else 0)
    ink = np.kron(dark, np.ones((per_square, per_square))).astype(bool)
    if board.kind == "charuco":
        _add_markers(board, ink, per_square)
    return (~ink if board.inverted else ink), board.square / per_square


def cells_per_square(board: Board) -> int:
    """Cells along a square's edge so that squares, markers and their bits all fall on cells; 0 if impossible."""
    if board.kind == "chessboard":
        return 1
    bits = int(board.dictionary[0]) + 2
    for count in range(bits, 201):
        side = board.marker * count
        whole = abs(side - round(side)) < 1e-6 and round(side) % bits == 0
        if whole and (count - round(side)) % 2 == 0:
            return count
    return 0


def _add_markers(board: Board, ink: NDArray[np.bool_], per_square: int) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[board.dictionary])
    bits = int(board.dictionary[0]) + 2
    cell = round(board.marker * per_square) // bits
    margin = (per_square - cell * bits) // 2
    white_squares = np.argwhere(~ink[::per_square, ::per_square])  # row by row, as the markers are counted
    for number, (row, column) in enumerate(white_squares):
        picture = cv2.aruco.generateImageMarker(dictionary, number, bits)
        y, x = row * per_square + margin, column * per_square + margin
        ink[y : y + cell * bits, x : x + cell * bits] = np.kron(picture == 0, np.ones((cell, cell))).astype(bool)


def whole_view(camera: Camera) -> Array:
    """Camera matrix (3, 3) of an undistorted picture of the same size with every pixel (thesis: alpha = 1)."""
    return np.asarray(cv2.getOptimalNewCameraMatrix(camera.matrix, camera.distortion, camera.size, 1.0)[0])


def undistort(camera: Camera, image: Image) -> Image:
    """The picture without distortion, with every pixel."""
    return np.asarray(cv2.undistort(image, camera.matrix, camera.distortion, None, whole_view(camera)), np.uint8)


def thumbnail(image: Image, width: int) -> bytes:
    """The picture as JPEG, `width` px wide."""
    height = round(image.shape[0] * width / image.shape[1])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, THUMBNAIL_QUALITY])
    assert ok
    return data.tobytes()


MIN_CORNERS = 4  # that determine a homography
REFINE_STEPS, REFINE_TOLERANCE = 10, 1e-3  # iterations; px of the last step
HALF_WINDOWS = (2, 9)  # px, half the window: smaller contains no edge, larger the next corner of a far board
EDGE_REACH = 0.4  # of a square, used along an edge: beyond half, the next corner's edges begin
HALF_SQUARES = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])  # to both sides along both axes
BLUR_FRINGE, MIN_EDGE_BAND = 2.0, 1.5  # px: excluded blurred rim of a marker; least width of an edge's band
MIN_CORNER_SIGMA = 0.01  # px: as in rendered pictures without noise
BLURRED_STEP_SLOPE = 2.5066  # sqrt(2 pi): a step blurred by sigma has a slope of 1 / (2.5066 sigma) per pixel
MAX_BLUR = 4.0  # px, one sigma of an edge: beyond it the edges of two corners overlap
MAX_BLUR_RATIO, MIN_BLUR_LIMIT = 2.5, 1.5  # a view is blurred beyond so many times the camera's median, and so many px
MIN_CORNER_SPREAD = 0.02  # ratio of the corners' spread across and along: collinear ones determine no plane
MAX_INSTANTS = 250  # evenly from longer recordings: more take minutes without gain


@dataclass(frozen=True, slots=True, eq=False)
class BoardCorners:
    """The corners of one picture."""

    pixels: Array  # (P, 2), nan where not seen
    sigma: float  # px, one standard deviation per axis, from the image noise and the edges' gradients
    blur: float  # px, one sigma of the edges, the worse of the board's two directions
    marker: float  # measured ratio of a marker's edge to a square's, nan without markers
    strangers: tuple[int, ...]  # ids of markers that are not on the board

    @property
    def count(self) -> int:
        """Number of corners seen."""
        return int(np.isfinite(self.pixels[:, 0]).sum())


class CornerFinder:
    """Finds a board's corners in many pictures; not to be shared between threads."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self._charuco = cv2.aruco.CharucoDetector(charuco_board(board)) if board.kind == "charuco" else None

    def __call__(self, image: Image) -> BoardCorners:
        """The corners of a picture (H, W) grey or (H, W, 3) BGR."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if self.board.inverted:
            grey = 255 - grey
        grey = np.ascontiguousarray(grey, np.uint8)
        pixels, marker, strangers = self._with_markers(grey)
        if np.isfinite(pixels[:, 0]).sum() < MIN_CORNERS:
            return BoardCorners(np.full_like(pixels, np.nan), 0.0, 0.0, marker, strangers)
        pixels, window = _refine(self.board, grey, pixels)
        sigma, blur = _quality(self.board, grey, pixels, window)
        return BoardCorners(pixels, sigma, blur, marker, strangers)

    def _with_markers(self, grey: Image) -> tuple[Array, float, tuple[int, ...]]:
        """Corners to a pixel, the markers' size ratio, and unknown markers."""
        if self._charuco is None:
            return _chessboard(self.board, grey), float("nan"), ()
        corners, numbers, squares, ids = self._charuco.detectBoard(grey)
        pixels = np.full((len(self.board.corners), 2), np.nan)
        if numbers is not None and len(numbers) >= MIN_CORNERS:
            pixels[np.ravel(numbers)] = np.asarray(corners, float).reshape(-1, 2)
        count = self.board.markers()
        strangers = () if ids is None else tuple(sorted({int(i) for i in np.ravel(ids) if i >= count}))
        return pixels, _marker_size(self.board, pixels, squares), strangers


def _marker_size(board: Board, pixels: Array, squares: object) -> float:
    """Median edge of the markers in the plane of the corners, relative to a square's; nan if undetermined."""
    visible = np.isfinite(pixels[:, 0])
    if visible.sum() < 6 or squares is None or not len(squares):  # type: ignore[arg-type]
        return float("nan")
    plane, _ = cv2.findHomography(pixels[visible], board.corners[visible, :2] / board.square)
    if plane is None:
        return float("nan")
    corners = np.asarray(squares, float).reshape(-1, 4, 2)
    flat = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), plane).reshape(-1, 4, 2)
    return float(np.median(np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=-1)))


def _chessboard(board: Board, grey: Image) -> Array:
    """Corners (P, 2) of a chessboard without markers, or nan; numbered by the colours of the squares."""
    columns, rows = board.squares[0] - 1, board.squares[1] - 1
    ok, corners = cv2.findChessboardCornersSB(grey, (columns, rows), flags=cv2.CALIB_CB_ACCURACY)
    if not ok:
        return np.full((columns * rows, 2), np.nan)
    grid = np.asarray(corners, float).reshape(rows, columns, 2)
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0:
        grid = grid[:, ::-1]  # a board is never seen from behind
    # the square right and below of the first inner corner is darker than the next one
    centres = [grid[:2, k : k + 2].mean((0, 1)) for k in (0, 1)]
    first, second = (float(cv2.getRectSubPix(grey, (5, 5), tuple(map(float, c))).mean()) for c in centres)
    return (grid if first < second else grid[::-1, ::-1]).reshape(-1, 2)


def _refine(board: Board, grey: Image, pixels: Array) -> tuple[Array, int]:
    """The corners to fractions of a pixel, and half the window, px.

    All gradients about a corner are perpendicular to the vector from it (Foerstner and Guelch 1987), as in OpenCV's
    cornerSubPix, but only gradients of the two edges are used: a window along the board's axes avoids the markers.
    """
    rows = np.flatnonzero(np.isfinite(pixels[:, 0]))
    half = int(np.clip(EDGE_REACH * _spacing(board, pixels), *HALF_WINDOWS))
    turn = _squares_from_pixels(board, pixels)
    out, valid = np.full_like(pixels, np.nan), np.isfinite(turn).all((1, 2))
    rows, at, turn = rows[valid], pixels[rows[valid]], turn[valid]
    size = np.array(grey.shape[::-1])
    for _ in range(REFINE_STEPS):
        near = np.round(at).astype(int)
        inside = (near >= half + 1).all(1) & (near <= size - half - 2).all(1)
        rows, at, near, turn = rows[inside], at[inside], near[inside], turn[inside]
        if not len(rows):
            break
        slopes, places = _slopes(grey, near, half)
        weight = _weights(board, places - at[:, None], turn, half)
        tensor = np.einsum("np,npi,npj->nij", weight, slopes, slopes) + np.eye(2)
        pull = np.einsum("np,npi,np->ni", weight, slopes, (slopes * (places - at[:, None])).sum(-1))
        step = np.linalg.solve(tensor, pull[..., None])[..., 0]
        at = at + step
        near_start = np.linalg.norm(at - pixels[rows], axis=1) < max(half / 2, 1.5)
        rows, at, turn, step = rows[near_start], at[near_start], turn[near_start], step[near_start]
        if np.abs(step).max(initial=0.0) < REFINE_TOLERANCE:
            break
    out[rows] = at
    return out, half


def _slopes(grey: Image, near: NDArray[np.int64], half: int) -> tuple[Array, Array]:
    """Gradients (N, K, 2), grey levels per pixel, in windows about pixels (N, 2), and their places (N, K, 2)."""
    y, x = np.mgrid[-half - 1 : half + 2, -half - 1 : half + 2]
    part = grey[near[:, 1, None, None] + y, near[:, 0, None, None] + x].astype(float)
    gx, gy = (part[:, 1:-1, 2:] - part[:, 1:-1, :-2]) / 2, (part[:, 2:, 1:-1] - part[:, :-2, 1:-1]) / 2
    places = np.stack([x[1:-1, 1:-1].ravel(), y[1:-1, 1:-1].ravel()], -1) + near[:, None].astype(float)
    return np.stack([gx, gy], -1).reshape(len(near), -1, 2), places


def _weights(board: Board, offsets: Array, squares_from_pixels: Array, half: int) -> Array:
    """Weights (N, K) of gradients at offsets (N, K, 2), px, from a corner: of its own edges, decreasing outwards."""
    along = np.abs(offsets @ np.swapaxes(squares_from_pixels, 1, 2))  # in squares, along the board's two axes
    per_pixel = np.linalg.norm(squares_from_pixels, axis=-1)[:, None]  # (N, 1, 2) squares, square to the edges
    white = (1 - board.marker) / 2 if board.kind == "charuco" else EDGE_REACH
    band = np.maximum(white / per_pixel - BLUR_FRINGE, MIN_EDGE_BAND)
    edges = (along / per_pixel < band).any(-1) & (along < EDGE_REACH).all(-1)
    return np.where(edges, np.exp(-(offsets**2).sum(-1) / half**2), 0.0)


def _squares_from_pixels(board: Board, pixels: Array) -> Array:
    """Squares along the board's axes per pixel (N, 2, 2) at each visible corner, by a homography; nan without one."""
    visible = np.isfinite(pixels[:, 0])
    squares = board.corners[visible, :2] / board.square
    plane = cv2.findHomography(squares, pixels[visible])[0]
    if plane is None:
        return np.full((len(squares), 2, 2), np.nan)
    ends = [cv2.perspectiveTransform((squares + e)[:, None], plane)[:, 0] for e in HALF_SQUARES]
    across = np.stack([ends[0] - ends[1], ends[2] - ends[3]], -1)
    flat = np.abs(np.linalg.det(across)) < 1.0  # px^2 of a square
    return np.where(flat[:, None, None], np.nan, np.linalg.inv(np.where(flat[:, None, None], np.eye(2), across)))


def _spacing(board: Board, pixels: Array) -> float:
    """Least distance, px, between neighbouring corners."""
    grid = pixels.reshape(board.squares[1] - 1, board.squares[0] - 1, 2)
    lengths = np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)])
    lengths = lengths[np.isfinite(lengths)]
    return float(lengths.min()) if len(lengths) else float(HALF_WINDOWS[0]) / EDGE_REACH


def _quality(board: Board, grey: Image, pixels: Array, half: int) -> tuple[float, float]:
    """sigma and blur as `BoardCorners` has them."""
    rows = np.flatnonzero(np.isfinite(pixels[:, 0]))
    if len(rows) < MIN_CORNERS:
        return 0.0, 0.0
    at = pixels[rows]
    near = np.round(at).astype(int)
    slopes, places = _slopes(grey, near, half)
    weight = _weights(board, places - at[:, None], _squares_from_pixels(board, pixels), half)
    tensor, spread = (np.einsum("np,npi,npj->nij", w, slopes, slopes) for w in (weight, weight**2))
    inverse = np.linalg.inv(tensor + np.eye(2))
    sigma = _noise(grey, at) * np.sqrt(np.trace(inverse @ spread @ inverse, axis1=1, axis2=2) / 2)
    y, x = np.mgrid[-half - 1 : half + 2, -half - 1 : half + 2].reshape(2, -1)
    levels = np.percentile(grey[near[:, 1, None] + y, near[:, 0, None] + x], [5, 95], axis=1)
    steepest = np.percentile(np.abs(slopes @ _axes(board, pixels).T), 98, axis=1).min(1)
    blur = (levels[1] - levels[0]) / np.maximum(steepest, 1e-3) / BLURRED_STEP_SLOPE
    return max(float(np.median(sigma)), MIN_CORNER_SIGMA), float(np.median(blur))


def _axes(board: Board, pixels: Array) -> Array:
    """Unit normals (2, 2), in the picture, of the edges along either side of the board."""
    grid = pixels.reshape(board.squares[1] - 1, board.squares[0] - 1, 2)
    out = []
    for axis in (0, 1):
        steps = np.diff(grid, axis=axis).reshape(-1, 2)
        steps = steps[np.isfinite(steps[:, 0])]
        direction = steps.sum(0) if len(steps) else np.eye(2)[axis]
        normal = np.array([-direction[1], direction[0]])
        out.append(normal / max(float(np.linalg.norm(normal)), 1e-9))
    return np.array(out)


def _noise(grey: Image, at: Array) -> float:
    """Image noise about the board, one sigma of grey levels (Immerkaer 1996, with a median against the edges)."""
    low = np.maximum(np.floor(at.min(0)).astype(int), 0)
    high = np.ceil(at.max(0)).astype(int) + 1
    part = grey[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    if min(part.shape) < 8:
        return 2.0
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    return max(float(np.median(np.abs(cv2.filter2D(part, -1, mask)[1:-1, 1:-1]))) / 0.6745 / 6, 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class CornerTable:
    """The corners of a recording: one row per picture that shows the board."""

    camera: NDArray[np.int64]  # (V,) number of the camera
    instant: NDArray[np.int64]  # (V,) number of the frame set
    stamp: Array  # (V,) s, by the camera's own clock
    pixels: Array  # (V, P, 2), nan where not seen
    sigma: Array  # (V,) px
    blur: Array  # (V,) px
    marker: Array  # (V,) measured ratio of a marker's edge to a square's
    looked: NDArray[np.int64]  # (C,) number of pictures searched
    strangers: NDArray[np.int64]  # ids of markers that are not on the board, one for each time seen
    done: int  # number of instants searched

    def __len__(self) -> int:
        return len(self.camera)


def empty_table(board: Board, cameras: int) -> CornerTable:
    """The table of a recording that has not been searched yet."""
    none, index = np.zeros(0), np.zeros(0, np.int64)
    pixels = np.zeros((0, len(board.corners), 2))
    return CornerTable(index, index, none, pixels, none, none, none, np.zeros(cameras, np.int64), index, 0)


def usable_views(
    table: CornerTable, board: Board, names: tuple[str, ...], sizes: tuple[tuple[int, int], ...]
) -> tuple[BoardViews, Counter[tuple[str, str]]]:
    """The usable views, and the number of others by camera and reason."""
    reasons = [_reason(table, row) for row in range(len(table))]
    usable = np.array([not reason for reason in reasons], bool)
    dropped = Counter((names[c], reason) for c, reason in zip(table.camera, reasons, strict=True) if reason)
    rows = thin_instants(table.instant, usable)
    dropped.update((names[c], "more than are needed") for c in table.camera[usable & ~rows])
    points, sigma = board.corners, np.maximum(table.sigma, 1e-3)
    views = BoardViews(names, sizes, points, table.camera, table.instant, table.stamp, table.pixels, sigma)
    return views.select(rows), dropped


def _reason(table: CornerTable, row: int) -> str:
    """Why a view is not usable, or ''."""
    pixels = table.pixels[row]
    pixels = pixels[np.isfinite(pixels[:, 0])]
    if len(pixels) < MIN_VIEW_CORNERS:
        return f"fewer than {MIN_VIEW_CORNERS} corners"
    spread = np.linalg.svd(pixels - pixels.mean(0), compute_uv=False)
    if spread[1] < MIN_CORNER_SPREAD * spread[0]:
        return "corners nearly in one line"
    usual = float(np.median(table.blur[table.camera == table.camera[row]]))
    if table.blur[row] > max(min(MAX_BLUR_RATIO * usual, MAX_BLUR), MIN_BLUR_LIMIT):
        return "blurred"
    return ""


def thin_instants(instant: NDArray[np.int64], usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(V,) the rows of at most MAX_INSTANTS usable instants, in runs of neighbours, which show the motion."""
    instants = np.unique(instant[usable])
    if len(instants) <= MAX_INSTANTS:
        return usable
    selection = np.concatenate([run[:10] for run in np.array_split(instants, MAX_INSTANTS // 10)])
    return np.asarray(usable & np.isin(instant, selection))
