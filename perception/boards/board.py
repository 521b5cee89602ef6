"""A printed calibration board: a chessboard, with markers in its white squares (ChArUco) or without.

And undistorted pictures for reports (thesis 4.2): every pixel kept, black where there is none.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

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
    whites = np.argwhere(~ink[::per_square, ::per_square])  # row by row, as the markers are counted
    for number, (row, column) in enumerate(whites):
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
