"""Where a scan lies in the pictures, and the landmarks on it.

First the scan is registered to the surface's depth map. Then the pictures are matched densely on the scan itself: where
it lies right they look alike, where it lies wrong they differ, by as much as its relief rises or falls along the error.
That needs no estimate of the relief, so the last steps are free of the error that flat patches make on a wound's walls.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.mapping.bundle_adjustment import FREE_SIGMA_MM, Anchors, of_frame
from estimation.rig import Rig
from estimation.scans.registration import Registration, register, register_near
from estimation.scans.scan import Scan, ScanIndex, cast_rays, foot_jacobians
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.frames import Image
from perception.lens import Lenses
from perception.mapping.dense_matching import match_near, middle_camera, node_size, relief_points
from perception.mapping.first_map import FirstMap

RELIEF_SIGMA_MM = 0.1  # mm: of matched relief across the surface; no handheld scan is better
SEARCH_POINTS = 400  # points for the search: more take longer and find the same
MATCH_SIGMA_MM = 0.03  # mm, of points matched on the scan itself
MATCH_SPACING_NODES = 6  # nodes between points taken: half a matched patch, so neighbours share half their error,
SHARED_ERROR_FACTOR = 2.5  # and their errors another part, as measured: each is worth a sixth of an independent one
REFINEMENT_ROUNDS = 4  # of matching and settling: the third was measured to move by 0.01 mm, the fourth by 0.002
APEX_DISTANCE_MM = 1e5  # mm: rays from there are parallel to 1e-3 rad over a body
SCAN_MARGIN_MM = 2.0  # mm around the part that was seen
RIVAL_RMS_RATIO = 1.5  # a rival pose whose points stand off this much more is none


class ScanPlacing:
    """Finds one scan in pictures."""

    def __init__(self, scan: Scan) -> None:
        self.scan, self._index = scan, ScanIndex(scan)
        self._nodes = np.zeros((0, 0, 3))

    def search(
        self, lenses: Lenses, images: dict[int, Image], first: FirstMap, polygons: dict[int, Array]
    ) -> Registration:
        """Where the scan lies, from pictures (grey, by camera) of one instant, without knowing where.

        polygons: (N, 2) px as imaged, by camera: the part of the surface that is matched with the scan.
        """
        points = relief_points(lenses, images, first, polygons)
        if not len(points):
            points = se3.transform_points(first.base_from_surface, first.map.points)
        outward = first.base_from_surface[:3, 2]
        place = register(points[:: max(1, len(points) // SEARCH_POINTS)], RELIEF_SIGMA_MM, self.scan, outward)
        self._nodes = self._lattice(lenses, sorted(images), points, outward, place.base_from_surface)
        return self.refine(lenses, images, place)

    def refine(self, lenses: Lenses, images: dict[int, Image], near: Registration) -> Registration:
        """A place known to a millimetre, refined on pictures of one instant; what was ambiguous before stays so."""
        best = self._settled(lenses, images, near)
        if near.rival is None:
            return best
        other = self._settled(lenses, images, replace(near, base_from_surface=near.rival, rival=None))
        if other.rms > RIVAL_RMS_RATIO * best.rms:
            return best
        if best.rms > RIVAL_RMS_RATIO * other.rms:
            return other
        return replace(best, rival=near.rival, sure=False, verdict=f"{near.verdict}; {best.verdict}")

    def _settled(self, lenses: Lenses, images: dict[int, Image], near: Registration) -> Registration:
        """Matched on the scan where it lies, and registered again, repeatedly."""
        place, on_scan = near, np.isfinite(self._nodes[..., 0])
        for _ in range(REFINEMENT_ROUNDS):
            pose = place.base_from_surface
            nodes = se3.transform_points(pose, np.nan_to_num(self._nodes).reshape(-1, 3)).reshape(self._nodes.shape)
            reference = middle_camera(lenses, sorted(images), nodes[on_scan].mean(0)) if on_scan.any() else 0
            matched = match_near(lenses, images, nodes, reference, MATCH_SPACING_NODES) if on_scan.any() else None
            if matched is None:
                return replace(near, sure=False, verdict=f"{near.verdict}; no two cameras see the scan there")
            sure = matched.sure & on_scan[::MATCH_SPACING_NODES, ::MATCH_SPACING_NODES]
            place = register_near(matched.points[sure], MATCH_SIGMA_MM, SHARED_ERROR_FACTOR, self._index, pose)
        return place

    def _lattice(self, lenses: Lenses, cameras: list[int], points: Array, outward: Array, pose: Array) -> Array:
        """Nodes (H, W, 3), surface frame, on the part of the scan under points (N, 3), base frame; NaN beside it."""
        surface_from_base = se3.inverse(pose)
        z = surface_from_base[:3, :3] @ outward
        x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
        x /= np.linalg.norm(x)
        turn = np.column_stack([x, np.cross(z, x), z])
        inner = se3.transform_points(surface_from_base, points)
        surface_from_plane = se3.make(turn, inner.mean(0))
        flat = se3.transform_points(se3.inverse(surface_from_plane), inner)[:, :2]
        step = node_size(lenses, cameras, points.mean(0))
        low, high = flat.min(0) - SCAN_MARGIN_MM, flat.max(0) + SCAN_MARGIN_MM
        lines = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
        lattice = np.stack(np.meshgrid(*lines), -1)
        down = np.concatenate([lattice / APEX_DISTANCE_MM, -np.ones((*lattice.shape[:2], 1))], -1).reshape(-1, 3)
        apex = surface_from_plane @ se3.make(np.eye(3), [0.0, 0.0, APEX_DISTANCE_MM])
        return cast_rays(self.scan, apex, down).points.reshape(*lattice.shape[:2], 3)


def as_at_one_instant(rig: Rig, pose: Array, single: dict[int, Array]) -> Rig:
    """The rig as it stands to a surface at `pose` (4, 4), where each camera saw it at its own pose `single[c]`.

    Cameras that are not exposed together see a moving surface at different places; moved by the difference they all
    look at the same one.
    """
    moved = [pose @ se3.inverse(single.get(c, pose)) @ lens.base_from_camera for c, lens in enumerate(rig.cameras)]
    return Rig(tuple(replace(lens, base_from_camera=m) for lens, m in zip(rig.cameras, moved, strict=True)))


REFERENCE_SIGMA_PX = 0.2  # px, of a landmark's place in its reference picture
MIN_SCAN_SIGMA_MM = 0.03  # mm across the surface: no scan and no match is better
MAX_SCAN_DISTANCE_SIGMAS = 5.0  # of landmark and scan; beyond, it does not lie on the scan: a drape, a hair, a mistake


def landmarks_on_scan(
    surface_map: SurfaceMap, camera: NDArray[np.int64], lenses: Lenses, scan: Scan, place: Registration
) -> tuple[SurfaceMap, Anchors]:
    """The map with its landmarks on the scan, and what holds them there.

    surface_map: in the scan's frame. camera: (N,) whose picture each landmark was taken from. place: of the scan where
    the cameras of `lenses` see it. Depth is the scan's, sideways the pixel's; the place's own error is in all alike,
    unless the shape leaves it open: that is no matter of millimetres.
    """
    points, normals = surface_map.points.copy(), surface_map.normals.copy()
    blocks = np.einsum("ninj->nij", surface_map.covariance.reshape(len(points), 3, len(points), 3)).copy()
    across = max(place.rms, MIN_SCAN_SIGMA_MM)
    frame = place.covariance if place.sure else np.zeros((6, 6))
    sigma = np.full(len(points), FREE_SIGMA_MM)
    for c in np.unique(camera):
        mine = np.flatnonzero(camera == c)
        lens = lenses.rig.cameras[c]
        surface_from_camera = se3.inverse(place.base_from_surface) @ lens.base_from_camera
        inner = se3.transform_points(se3.inverse(surface_from_camera), points[mine])
        hits = cast_rays(scan, surface_from_camera, inner)
        off = np.einsum("ni,ni->n", hits.points - points[mine], hits.normals)
        own = np.einsum("ni,nij,nj->n", hits.normals, blocks[mine], hits.normals)
        on = hits.hit & (np.abs(off) < MAX_SCAN_DISTANCE_SIGMAS * np.sqrt(own + across**2))
        mine, rays = mine[on], inner[on] @ surface_from_camera[:3, :3].T
        points[mine], normals[mine], sigma[mine] = hits.points[on], hits.normals[on], across
        angle = REFERENCE_SIGMA_PX / float(lens.matrix[0, 0])
        blocks[mine] = _intersection_covariances(rays, hits.normals[on], across, angle)
    covariance = np.zeros((len(points), 3, len(points), 3))
    covariance[np.arange(len(points)), :, np.arange(len(points))] = blocks
    whole = covariance.reshape(3 * len(points), -1) + of_frame(points, frame)
    return SurfaceMap(points, normals, whole), Anchors(points, normals, sigma, frame)


def _intersection_covariances(rays: Array, normals: Array, across: float, angle: float) -> Array:
    """Covariances (N, 3, 3) mm^2 of where rays (N, 3), from the camera, each known to `angle` rad, meet planes with
    `normals` (N, 3), each known to `across` mm."""
    shift, depth = foot_jacobians(rays, normals)
    sideways = (np.linalg.norm(rays, axis=1) * angle)[:, None, None] ** 2 * shift @ np.swapaxes(shift, 1, 2)
    return np.asarray(sideways + across**2 * depth[:, :, None] * depth[:, None])
