"""Pictures of a calibration board before a camera with a lens, blur and noise; every corner's place is exact."""

from __future__ import annotations

import cv2
import numpy as np

from estimation import se3
from estimation.rig import Camera, pixels_from_points
from estimation.se3 import Array
from hardware.simulator.field import Field
from hardware.simulator.view import rays_at
from perception.boards.board import Board, black
from perception.frames import Image

SAMPLES = 3  # per pixel and axis: edges lie true to a hundredth of a pixel
PAPER = 0.5  # of a square, white around the print
LIGHT, DARK, WALL = 205.0, 38.0, 120.0  # grey levels of paper, ink and what is behind
ROOM = 12  # px around the board that are drawn


class BoardView:
    """One camera before one board."""

    def __init__(self, camera: Camera, board: Board) -> None:
        self.camera, self._board = camera, board
        ink, self._cell = black(board)
        self._ink = np.where(ink, DARK, LIGHT).astype(np.float32)

    def picture(self, base_from_board: Array, blur: float, noise: float, rng: np.random.Generator) -> Image:
        """The image (H, W) grey of the board at a pose (4, 4); blur: px, noise: grey levels, one sigma each."""
        w, h = self.camera.size
        light = np.full((h, w), WALL, np.float32)
        box = self._box(base_from_board)
        if box is not None:
            x0, y0, x1, y1 = box
            light[y0:y1, x0:x1] = self._patch(base_from_board, box)
        if blur:
            light = np.asarray(cv2.GaussianBlur(light, (0, 0), blur), np.float32)
        grain = rng.standard_normal((h, w), np.float32)
        return np.clip(np.round(light + noise * grain), 0, 255).astype(np.uint8)

    def _box(self, base_from_board: Array) -> tuple[int, int, int, int] | None:
        """The part of the image that holds the paper: x0 y0 x1 y1."""
        rim = PAPER * self._board.square
        w, h = self._board.size
        x, y = np.meshgrid(np.linspace(-rim, w + rim, 5), np.linspace(-rim, h + rim, 5))
        outline = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
        pixels, depth = pixels_from_points(self.camera, se3.transform_points(base_from_board, outline))
        if (depth < 1).any():
            return None
        low = np.maximum(np.floor(pixels.min(0)).astype(int) - ROOM // 2, 0)
        high = np.minimum(np.ceil(pixels.max(0)).astype(int) + ROOM // 2, self.camera.size)
        return (int(low[0]), int(low[1]), int(high[0]), int(high[1])) if (high > low).all() else None

    def _patch(self, base_from_board: Array, box: tuple[int, int, int, int]) -> Field:
        x0, y0, x1, y1 = box
        x, y = ((np.arange((b - a) * SAMPLES) + 0.5) / SAMPLES - 0.5 + a for a, b in ((x0, x1), (y0, y1)))
        rays = np.moveaxis(rays_at(self.camera, x, y), 0, -1)
        camera_from_board = se3.inverse(self.camera.base_from_camera) @ base_from_board
        plane = np.linalg.inv(camera_from_board[:3, [0, 1, 3]])
        flat = np.concatenate([rays, np.ones_like(rays[..., :1])], -1) @ plane.T.astype(np.float32)
        board = flat[..., :2] / flat[..., 2:]
        light = self._seen(board)
        return np.asarray(cv2.resize(light, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA), np.float32)

    def _seen(self, board: Field) -> Field:
        """What is at places (H, W, 2), mm, of the board's plane."""
        rows, columns = self._ink.shape
        cell = np.floor(board / self._cell).astype(int)
        inside = (cell >= 0).all(-1) & (cell[..., 0] < columns) & (cell[..., 1] < rows)
        rim = PAPER * self._board.square
        paper = (board >= -rim).all(-1) & (board < np.array(self._board.size) + rim).all(-1)
        blank = DARK if self._board.inverted else LIGHT
        light = np.where(paper, blank, WALL).astype(np.float32)
        light[inside] = self._ink[cell[inside, 1], cell[inside, 0]]
        return light
