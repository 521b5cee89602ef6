"""A calibration board as it was printed: a chessboard, with markers in its white squares (ChArUco) or without."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array

KINDS = ("charuco", "chessboard")
DICTIONARIES = {
    f"{n}X{n}_{count}": getattr(cv2.aruco, f"DICT_{n}X{n}_{count}")
    for n in (4, 5, 6, 7)
    for count in (50, 100, 250, 1000)
}  # names as OpenCV has them, without DICT_


@dataclass(frozen=True, slots=True)
class Board:
    """What is on the board.

    squares: columns and rows. square: mm, edge of one. marker: edge of a marker in parts of a square's. dictionary: a
    key of DICTIONARIES. inverted: black and white exchanged in print. legacy: the layout of OpenCV before 4.6, which
    differs where the rows are even. A chessboard has no use for the last four but `inverted`.
    """

    kind: str = "charuco"
    squares: tuple[int, int] = (7, 10)
    square: float = 25.0
    marker: float = 0.75
    dictionary: str = "4X4_50"
    inverted: bool = False
    legacy: bool = False

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
        """How many markers it holds."""
        return 0 if self.kind == "chessboard" else self.squares[0] * self.squares[1] // 2

    def __str__(self) -> str:
        """As a person would name it."""
        columns, rows = self.squares
        text = f"{self.kind} of {columns} x {rows} squares of {self.square:g} mm"
        if self.kind == "charuco":
            text += f", markers {self.marker:g} of a square, {self.dictionary}"
        return text + (", inverted" if self.inverted else "") + (", legacy layout" if self.legacy else "")


def charuco(board: Board) -> cv2.aruco.CharucoBoard:
    """OpenCV's own record of a ChArUco board."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[board.dictionary])
    made = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker * board.square, dictionary)
    made.setLegacyPattern(board.legacy)
    return made


def black(board: Board) -> tuple[NDArray[np.bool_], float]:
    """The print as a grid of cells, True where there is ink (H, W), and the edge of a cell, mm.

    The grid is as coarse as squares and markers allow, as `grid_of` tells.
    """
    per_square = grid_of(board)
    columns, rows = board.squares
    y, x = np.indices((rows, columns))
    dark = (x + y) % 2 == (1 if board.legacy and rows % 2 == 0 else 0)
    ink = np.kron(dark, np.ones((per_square, per_square))).astype(bool)
    if board.kind == "charuco":
        _add_markers(board, ink, per_square)
    return (~ink if board.inverted else ink), board.square / per_square


def grid_of(board: Board) -> int:
    """Cells along a square's edge so that squares, markers and their bits all fall on cells; 0 where none will do."""
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
