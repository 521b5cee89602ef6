"""A world to show: three cameras over a wound that breathes, without an arm, a camera or an estimator."""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.rig import Camera, Rig, ideal_pixels
from estimation.se3 import Array
from hardware.operator.scene import Scene, scene_from
from hardware.operator.taker import Shot
from perception.frames import Image
from planning.path import Path

SIZE = (640, 360)  # px
BREATH = 4.0  # s
WOUND = np.array([21.0, 14.0])  # mm, half axes
SKIN, BED = np.array([150.0, 178.0, 216.0]), np.array([52.0, 44.0, 150.0])  # BGR
POINTS = 700  # checkpoints


def demo_rig() -> Rig:
    """Three cameras around the wound, half a metre away and above it."""
    return Rig(tuple(_camera(f"camera{k}", turn) for k, turn in enumerate((-1.2, 0.0, 1.2))))


def demo_path() -> Path:
    """A spiral over the wound, in two layers, upright."""
    share = np.linspace(0.0, 1.0, POINTS)
    angle, radius = 2 * np.pi * 18 * (share % 0.5), 1 - 1.9 * (share % 0.5)
    poses = np.tile(np.eye(4), (POINTS, 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = WOUND[0] * radius * np.cos(angle), WOUND[1] * radius * np.sin(angle)
    poses[:, 2, 3] = dome(poses[:, 0, 3], poses[:, 1, 3]) + 0.3 + 0.3 * (share >= 0.5)
    layer = (share >= 0.5).astype(np.int64)
    extrude = np.r_[False, np.diff(layer) == 0]
    return Path(poses, np.full(POINTS, 6.0), np.zeros(POINTS, np.int64), np.full(POINTS, 37.0), layer, extrude)


def dome(x: Array, y: Array) -> Array:
    """Height, mm, of the surface over places in mm."""
    return np.asarray(-(x**2 + 1.6 * y**2) / 400)


def demo_scene(side: int = 24) -> Scene:
    """Cameras, path and surface."""
    x, y = np.meshgrid(np.linspace(-45, 45, side), np.linspace(-32, 32, side))
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    halves = [[corner, corner + 1, corner + side], [corner + 1, corner + side + 1, corner + side]]
    triangles = np.concatenate([np.stack(half, axis=1) for half in halves])
    return scene_from(demo_rig(), demo_path(), np.column_stack([x.ravel(), y.ravel(), dome(x, y).ravel()]), triangles)


def surface_at(now: float) -> Array:
    """base_from_surface (4, 4) mm: it breathes."""
    breath = np.sin(2 * np.pi * now / BREATH)
    pose = se3.exp(np.array([0.05 * breath, 0.03 * breath, 0.1, 0.0, 0.0, 0.0]))
    pose[:3, 3] = [4.0 * breath, 1.5 * breath, 20.0 + 5.0 * breath]
    return np.asarray(pose)


def nozzle_at(base_from_surface: Array, path: Path, fraction: float, lift: float = 0.0) -> Array:
    """base_from_nozzle (4, 4) mm at a place on the path counted in checkpoints, `lift` mm above it."""
    i = int(np.clip(fraction, 0, len(path) - 2))
    share = np.clip(fraction - i, 0.0, 1.0)
    pose = path.surface_from_nozzle[i].copy()
    pose[:3, 3] += share * (path.surface_from_nozzle[i + 1, :3, 3] - pose[:3, 3]) + [0, 0, lift]
    return np.asarray(base_from_surface @ pose)


class Painter:
    """Paints what a camera sees of the surface, as if it were flat."""

    def __init__(self, rig: Rig, rng: np.random.Generator) -> None:
        self._rig = rig
        self._grain = rng.normal(0.0, 9.0, (SIZE[1], SIZE[0], 1))
        turn = np.linspace(0.0, 2 * np.pi, 48)
        self._edge = np.column_stack([WOUND[0] * np.cos(turn), WOUND[1] * np.sin(turn), 0 * turn])
        self._edge[:, 2] = dome(self._edge[:, 0], self._edge[:, 1])
        self._marks = rng.uniform([-40, -28, 0], [40, 28, 0], (60, 3))
        self._marks[:, 2] = dome(self._marks[:, 0], self._marks[:, 1])

    def shots(self, base_from_surface: Array) -> list[Shot]:
        """The pictures of all cameras, with outline and tracks."""
        return [self._shot(camera, base_from_surface) for camera in self._rig.cameras]

    def _shot(self, camera: Camera, base_from_surface: Array) -> Shot:
        edge, marks = (
            ideal_pixels(camera, se3.transform_points(base_from_surface, points))[0]
            for points in (self._edge, self._marks)
        )
        return Shot(camera.name, self._image(camera, base_from_surface), (edge,), marks)

    def _image(self, camera: Camera, base_from_surface: Array) -> Image:
        surface_from_camera = se3.inverse(base_from_surface) @ camera.base_from_camera
        u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera.matrix).T @ surface_from_camera[:3, :3].T
        far = -surface_from_camera[2, 3] / rays[..., 2]
        x, y = (surface_from_camera[k, 3] + far * rays[..., k] for k in range(2))
        inside = np.clip(6 * (1 - np.hypot(x / WOUND[0], y / WOUND[1])), 0, 1)[..., None]
        shade = 1 - 0.1 * np.clip(np.hypot(x, y) / 60, 0, 2)[..., None]
        painted = (SKIN + inside * (BED - SKIN)) * shade + self._grain
        return np.asarray(np.clip(painted, 0, 255), np.uint8)


def _camera(name: str, turn: float) -> Camera:
    place = np.array([320 * np.sin(turn), -320 * np.cos(turn), 330.0])
    ahead = np.array([0.0, 0.0, 20.0]) - place
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = place
    matrix = np.array([[2900.0, 0, 319.5], [0, 2900.0, 179.5], [0, 0, 1.0]])
    return Camera(name, SIZE, matrix, np.zeros(5), pose)
