"""A printed picture of skin on a table, before three cameras: the sheet is moved, the table stands still."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from estimation import se3
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from perception.frames import Frame, FrameSet, Image, Roi

SIZE, FOCAL = (480, 270), 560.0  # px
SHEET = np.array([90.0, 64.0])  # mm, with its frame
FRAME_WIDTH = 4.0  # mm, of the printed frame
FRAME_RGB = (0, 166, 81)  # as a printer gives "#00a651", before light and noise
PX_PER_MM = 4.0  # of the prints
TABLE = 420.0  # mm of its edges
FPS = 20.0


def rig() -> Rig:
    """Three cameras half a metre away, 35 degrees apart."""
    return Rig(tuple(_camera(f"camera{k}", np.radians(turn)) for k, turn in enumerate((-35, 0, 35))))


def _camera(name: str, turn: float) -> Camera:
    place = np.array([420 * np.sin(turn), -120.0, 420 * np.cos(turn)])
    ahead = -place / np.linalg.norm(place)
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([right, np.cross(ahead, right), ahead]), place
    matrix = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1.0]])
    return Camera(name, SIZE, matrix, np.zeros(5), pose)


def pose_at(stamp: float) -> Array:
    """base_from_sheet (4, 4) mm: a hand pushes it to and fro, and turns it a little."""
    turn = np.array([0.0, 0.0, 0.05 * np.sin(2 * np.pi * 0.3 * stamp)])
    shift = np.array([6 * np.sin(2 * np.pi * 0.25 * stamp), 4 * np.sin(2 * np.pi * 0.4 * stamp), 0.0])
    return se3.make(se3.exp_rotation(turn), shift)


def corners_at(stamp: float, camera: Camera, inset: float = 0.0) -> Array:
    """(4, 2) px: the sheet's corners, or those of a sheet smaller by `inset` mm on every side."""
    half = SHEET / 2 - inset
    points = np.column_stack([np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half, np.zeros(4)])
    return pixels_from_points(camera, se3.transform_points(pose_at(stamp), points))[0]


def region(stamp: float = 0.0) -> tuple[Roi, ...]:
    """The sheet without its edge in each camera."""
    return tuple(Roi(c, -np.inf, corners_at(stamp, camera, 2.0)) for c, camera in enumerate(rig().cameras))


def _grain(shape: tuple[int, int], colour: tuple[int, int, int], depth: float, seed: int) -> Image:
    """A print of grain of several sizes round a colour, RGB, as BGR."""
    draw, out = np.random.default_rng(seed), np.zeros(shape)
    for sigma in (1.5, 3.0, 8.0):
        layer = cv2.GaussianBlur(draw.normal(size=shape), (0, 0), sigma)
        out += layer / layer.std()
    tone = (1 + depth * out[..., None] / 3) * np.array(colour[::-1], float)
    return np.clip(tone, 0, 255).astype(np.uint8)


def prints() -> tuple[Image, Image]:
    """The sheet, skin in a green frame, and the table's wood, as BGR pictures."""
    height, width = np.round(SHEET[::-1] * PX_PER_MM).astype(int)
    sheet, edge = _grain((height, width), (212, 164, 142), 0.22, 1), round(FRAME_WIDTH * PX_PER_MM)
    framed = np.full_like(sheet, FRAME_RGB[::-1])
    framed[edge:-edge, edge:-edge] = sheet[edge:-edge, edge:-edge]
    side = round(TABLE * PX_PER_MM)
    return framed, _grain((side, side), (120, 92, 66), 0.35, 2)


def pictures(stamps: Array) -> Iterator[FrameSet]:
    """The frame sets at stamps (N,), s, with a sensor's noise."""
    cameras, (sheet, table), draw = rig().cameras, prints(), np.random.default_rng(7)
    backgrounds = [_seen(camera, np.eye(4), table)[0] for camera in cameras]
    for stamp in stamps.tolist():
        frames = []
        for c, camera in enumerate(cameras):
            seen, mask = _seen(camera, pose_at(stamp), sheet)
            image = np.where(mask[..., None] > 0, seen, backgrounds[c]) + draw.normal(0, 1.5, (*SIZE[::-1], 3))
            frames.append(Frame(c, stamp, np.clip(image, 0, 255).astype(np.uint8)))
        yield FrameSet(stamp, tuple(frames))


def _seen(camera: Camera, base_from_print: Array, picture: Image) -> tuple[Image, Image]:
    """A print, centred on its frame, as the camera sees it, and where it is in the picture."""
    camera_from_print = se3.inverse(camera.base_from_camera) @ base_from_print
    height, width = picture.shape[:2]
    flat = camera.matrix @ camera_from_print[:3][:, [0, 1, 3]]  # px from (x, y, 1) mm
    scale = np.array(
        [[1 / PX_PER_MM, 0, -(width - 1) / 2 / PX_PER_MM], [0, 1 / PX_PER_MM, -(height - 1) / 2 / PX_PER_MM], [0, 0, 1]]
    )
    mask = np.full((height, width), 255, np.uint8)
    warped = (cv2.warpPerspective(each, flat @ scale, SIZE, flags=cv2.INTER_AREA) for each in (picture, mask))
    seen, where = (np.asarray(each, np.uint8) for each in warped)
    return seen, where


def displacement_errors(stamps: Array, poses: Array) -> Array:
    """(N,) mm: how far the motion since the first of poses (N, 4, 4) is from the sheet's, in its middle."""
    true = np.stack([pose_at(float(stamp)) for stamp in stamps])
    moved, expected = poses @ se3.inverse(poses[0]), true @ se3.inverse(true[0])
    return np.linalg.norm((moved @ true[0] - expected @ true[0])[:, :3, 3], axis=1)
