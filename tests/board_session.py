"""A session folder of a rendered board that is waved before three small cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from estimation.calibration.lens_model import lens_matrix
from estimation.rig import Camera, Rig
from hardware.files.folder_tables import SessionFolderWriter
from hardware.files.images import encode
from hardware.simulator.scene.render import BoardView
from perception.boards.board import Board
from tests.boards import motion, places

BOARD = Board(squares=(4, 5), square=54.0)
RATE, OFFSETS = 8.0, (-0.016, 0.004, 0.012)
LENSES = np.array(
    [
        [430.0, 430.5, 316.0, 243.0, -0.20, 0.05, 0.0, 0.0, 0.0],
        [445.0, 445.0, 322.0, 236.0, -0.06, 0.0, 0.0, 0.0, 0.0],
        [425.0, 424.5, 325.0, 241.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)


def small_rig() -> Rig:
    """Three cameras of 640 x 480 px, the first one the base."""
    cameras = zip("abc", LENSES, places(), strict=True)
    return Rig(tuple(Camera(name, (640, 480), lens_matrix(lens), lens[4:], place) for name, lens, place in cameras))


def rendered(folder: Path, instants: int = 14, board: Board = BOARD) -> Path:
    """The folder, written; its rig.toml is the true one, without clock offsets."""
    rig, rng = small_rig(), np.random.default_rng(5)
    views = [BoardView(camera, board) for camera in rig.cameras]
    stamps = np.arange(instants) / RATE
    with SessionFolderWriter(folder, rig, ()) as session:
        for stamp in stamps:
            for c, view in enumerate(views):
                late = np.array([stamp + OFFSETS[c]])
                pose = motion(late, np.random.default_rng(11), board.corners.mean(0), 1.5)[0]
                session.picture(c, float(stamp), *encode(view.picture(pose, 0.6, 1.5, rng)))
    return folder
