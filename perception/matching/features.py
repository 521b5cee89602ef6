"""Finding the surface again without knowing where it was: SIFT against what was learned from reference images."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.mapping.triangulation import rays
from estimation.online.pose_solver import project, solve_pose
from estimation.rig import ideal_pixels
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.features import match, sift
from perception.frames import Image
from perception.lens import Lenses, undistort
from perception.matching.patches import Pyramid

CAPACITY = 6000  # descriptors: matching 600 features against them takes 30 ms
LEAST_MATCHES = 8


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A relocalised pose. base_from_surface: (4, 4), of all cameras together. single: by camera, its own, since cameras
    are seldom exposed together. matches: how many features agree."""

    base_from_surface: Array
    single: dict[int, Array]
    matches: int


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Features of one camera: points (N, 3) in the surface frame, ideal pixels (N, 2), the pose they give alone."""

    camera: int
    points: Array
    pixels: Array
    alone: Array | None


class Relocaliser:
    """Descriptors of the surface, and the pose they give in new images."""

    def __init__(self, lenses: Lenses) -> None:
        self.lenses = lenses
        self._descriptors = np.zeros((0, 128), np.float32)
        self._points = np.zeros((0, 3))
        self._view = np.zeros(0, np.int64)  # (N,) which view each is from

    def learn(self, camera: int, image: Image, base_from_surface: Array, surface_map: SurfaceMap) -> None:
        """Add the features of one image in which the surface's pose is known: each is put on the landmarks' surface."""
        lens = self.lenses.rig.cameras[camera]
        points_base = se3.transform_points(base_from_surface, surface_map.points)
        ideal, depth = ideal_pixels(lens, points_base)
        imaged, seen = self.lenses.image(camera, ideal, depth)
        seen = seen & ((imaged >= 0) & (imaged < lens.size)).all(1)
        if seen.sum() < 8:
            return
        mask = np.zeros((lens.size[1], lens.size[0]), np.uint8)
        hull = cv2.convexHull(imaged[seen].astype(np.float32)).reshape(-1, 2)
        cv2.fillConvexPoly(mask, np.round(hull).astype(np.int32), 255)
        mask = np.asarray(cv2.dilate(mask, np.ones((9, 9), np.uint8)), np.uint8)
        self.add(camera, sift(image, mask, 500, tilted=True), base_from_surface, surface_map)

    def add(
        self,
        camera: int,
        features: tuple[Array, NDArray[np.float32]],
        base_from_surface: Array,
        surface_map: SurfaceMap,
    ) -> None:
        """Take the features of one image, (N, 2) px as imaged and (N, 128), best first, in which the pose is known.

        Each view keeps its best: an equal share of what there is room for, so that no new one drives out an old one.
        """
        lens = self.lenses.rig.cameras[camera]
        ideal, depth = ideal_pixels(lens, se3.transform_points(base_from_surface, surface_map.points))
        imaged, seen = self.lenses.image(camera, ideal, depth)
        seen = seen & ((imaged >= 0) & (imaged < lens.size)).all(1)
        keypoints, descriptors = features
        if not len(keypoints) or seen.sum() < 8:
            return
        points = self._on_surface(camera, undistort(lens, keypoints), base_from_surface, surface_map, ideal, seen)
        near = np.isfinite(points).all(1)
        view = np.full(int(near.sum()), self._view.max(initial=-1) + 1)
        self._points = np.concatenate([self._points, points[near]])
        self._descriptors = np.concatenate([self._descriptors, descriptors[near]])
        self._view = np.concatenate([self._view, view])
        self._make_room()

    def _make_room(self) -> None:
        counts = np.bincount(self._view)
        most = int(counts.max(initial=0))
        while np.minimum(counts, most).sum() > CAPACITY:
            most -= 1 + most // 100
        rank = np.concatenate([np.arange(n) for n in counts]) if len(counts) else np.zeros(0, int)
        kept = rank < most
        self._points, self._descriptors, self._view = self._points[kept], self._descriptors[kept], self._view[kept]

    @property
    def descriptors(self) -> NDArray[np.float32]:
        """Descriptors (N, 128) of what would be found again."""
        return self._descriptors

    def reframe(self, new_from_old: Array) -> None:
        """The surface frame is another from now on: new_from_old (4, 4)."""
        self._points = se3.transform_points(new_from_old, self._points)

    def _on_surface(
        self,
        camera: int,
        pixels: Array,
        base_from_surface: Array,
        surface_map: SurfaceMap,
        landmark_pixels: Array,
        seen: NDArray[np.bool_],
    ) -> Array:
        """Points (N, 3), surface frame, where rays meet the mean plane of the six nearest landmarks; nan if steep."""
        index = np.nonzero(seen)[0]
        gap = ((pixels[:, None] - landmark_pixels[index]) ** 2).sum(2)
        near = index[np.argsort(gap, axis=1)[:, :6]]
        normal = surface_map.normals[near].mean(1)
        anchor = surface_map.points[near].mean(1)
        origins, directions = rays(self.lenses.rig, np.full(len(pixels), camera), pixels)
        surface_from_base = se3.inverse(base_from_surface)
        origins = se3.transform_points(surface_from_base, origins)
        directions = directions @ surface_from_base[:3, :3].T
        slope = np.einsum("ni,ni->n", directions, normal)
        steep = np.abs(slope) < 0.1
        reach = np.einsum("ni,ni->n", anchor - origins, normal) / np.where(steep, 1.0, slope)
        return np.asarray(np.where(steep[:, None], np.nan, origins + reach[:, None] * directions))

    def find(self, pyramids: dict[int, Pyramid], half: bool = True) -> Found | None:
        """The pose of the surface in images (by camera), searched everywhere, or None.

        half: in the half-size images, a quarter of the time (50 ms a camera); a far surface needs the whole size.
        """
        if len(self._points) < LEAST_MATCHES:
            return None
        seen = [self._look(c, images, half) for c, images in pyramids.items()]
        return self._agree([s for s in seen if s is not None])

    def _look(self, camera: int, images: Pyramid, half: bool) -> Sighting | None:
        """What one camera shows of the surface, and the pose it gives alone."""
        lens = self.lenses.rig.cameras[camera]
        keypoints, descriptors = sift(images[1] if half else images[0], count=600 if half else 1500)
        if half:
            keypoints = 2 * keypoints
        pairs = match(descriptors, self._descriptors, 0.85)
        if len(pairs) < LEAST_MATCHES:
            return None
        points, pixels = self._points[pairs[:, 1]], undistort(lens, keypoints[pairs[:, 0]])
        alone = _pnp(points, pixels, lens.matrix)
        return Sighting(camera, points, pixels, None if alone is None else lens.base_from_camera @ alone)

    def _agree(self, seen: list[Sighting]) -> Found | None:
        """The camera's pose that most features of all cameras support, fitted to them."""
        if not any(s.alone is not None for s in seen):
            return None
        rig = self.lenses.rig
        camera = np.concatenate([np.full(len(s.points), s.camera) for s in seen])
        points = np.concatenate([s.points for s in seen])
        pixels = np.concatenate([s.pixels for s in seen])
        sigma = np.full(len(camera), 3.0)  # px: SIFT on half-size images, cameras not exposed together
        best: Found | None = None
        for start in (s.alone for s in seen if s.alone is not None):
            pose = solve_pose(rig, camera, points, pixels, sigma, start, scales=(4.0, 2.0)).base_from_surface
            away = np.linalg.norm(project(rig, camera, pose, points)[0] - pixels, axis=1)
            agreed = int((away < 4 * sigma).sum())
            if agreed >= LEAST_MATCHES and (best is None or agreed > best.matches):
                best = Found(pose, {}, agreed)
        if best is None:
            return None
        near = {s.camera: s.alone for s in seen if s.alone is not None and _alike(s.alone, best.base_from_surface)}
        return Found(best.base_from_surface, near, best.matches)


def _alike(a: Array, b: Array) -> bool:
    """Whether two poses could be one surface at two cameras' instants, one camera's depth being what it is."""
    apart = se3.inverse(a) @ b
    return bool(se3.angle_of(apart) < 0.35 and np.linalg.norm(apart[:3, 3]) < 60.0)


def _pnp(points: Array, pixels: Array, matrix: Array) -> Array | None:
    """camera_from_surface (4, 4) by RANSAC over points (N, 3) and ideal pixels (N, 2), or None; fixed seed."""
    ok, rotation, translation, inliers = cv2.solvePnPRansac(
        points, pixels, matrix, None, iterationsCount=400, reprojectionError=6.0, flags=cv2.SOLVEPNP_SQPNP
    )
    if not ok or inliers is None or len(inliers) < LEAST_MATCHES:
        return None
    return se3.make(cv2.Rodrigues(rotation)[0], np.asarray(translation).ravel())
