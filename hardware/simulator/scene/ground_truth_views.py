"""Pictures of a calibration board before a camera with a lens, blur and noise; every corner's place is exact."""

from __future__ import annotations

import cv2
import numpy as np

from estimation import se3
from estimation.rig import Camera, pixels_from_points
from estimation.se3 import Array
from hardware.simulator.field import Field
from hardware.simulator.scene.rays import rays_at
from perception.boards.board import Board, black
from perception.frames import Image

SAMPLES = 3  # per pixel and axis: edges lie true to a hundredth of a pixel
PAPER = 0.5  # of a square, white around the print
LIGHT, DARK, WALL = 205.0, 38.0, 120.0  # grey levels of paper, ink and what is behind
FINER = 8  # parts of a cell along its edge; between two the light is interpolated, which keeps edges from stepping
ROOM = 12  # px around the board that are drawn


class BoardView:
    """One camera before one board."""

    def __init__(self, camera: Camera, board: Board) -> None:
        self.camera, self._board = camera, board
        ink, cell = black(board)
        rim = round(PAPER * board.square / cell * FINER)
        drawn = np.kron(np.where(ink, DARK, LIGHT), np.ones((FINER, FINER)))
        paper = DARK if board.inverted else LIGHT
        self._drawing = np.pad(drawn, rim, constant_values=paper).astype(np.float32)
        scale, shift = FINER / cell, rim - 0.5  # cells' middles are whole numbers
        self._drawing_from_board = np.array([[scale, 0.0, shift], [0.0, scale, shift], [0.0, 0.0, 1.0]])

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
        u, v = rays_at(self.camera, x, y)
        camera_from_board = se3.inverse(self.camera.base_from_camera) @ base_from_board
        drawing_from_ray = self._drawing_from_board @ np.linalg.inv(camera_from_board[:3, [0, 1, 3]])
        across, down, depth = (a * u + b * v + c for a, b, c in drawing_from_ray.astype(np.float32))
        light = cv2.remap(self._drawing, across / depth, down / depth, cv2.INTER_LINEAR, borderValue=WALL)
        return np.asarray(cv2.resize(light, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA), np.float32)
