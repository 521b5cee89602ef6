"""Where a scan lies in the pictures: its relief against the surface's, then its own shape against their every pixel.

Laid onto the scan at the right place, the cameras' pictures look alike; where the scan lies wrong they part, by as much
as its relief rises or falls along the error. Matching them on the scan needs no guess at the relief, so that the last
steps are free of the error that flat patches make on a wound's walls.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimation import se3
from estimation.ray_cast import cast
from estimation.rig import Rig
from estimation.scan import Scan
from estimation.scans.registration import Registration, register, settle
from estimation.scans.scan import ScanIndex
from estimation.se3 import Array
from perception.frames import Image
from perception.lens import Lenses
from perception.mapping.dense_matching import match_on, middle_camera, node_size
from perception.mapping.first_map import FirstMap
from perception.relief import relief

RELIEF_SIGMA = 0.1  # mm: of matched relief across the surface; no handheld scan is better
ENOUGH = 400  # points for the search: more take longer and find the same
MATCH_SIGMA = 0.03  # mm, of points matched on the scan itself
SPREAD = 6  # nodes between points taken: half a matched patch, so neighbours share half their error,
SHARED = 2.5  # and their errors another part, as measured: each is worth a sixth of an independent one
ROUNDS = 4  # of matching and settling: the third was measured to move by 0.01 mm, the fourth by 0.002
FAR = 1e5  # mm: rays from there are parallel to 1e-3 rad over a body
MARGIN = 2.0  # mm around the part that was seen
REPEATED = 1.5  # a rival pose whose points stand off this much more is none


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
        points = relief(lenses, images, first, polygons)
        if not len(points):
            points = se3.transform_points(first.base_from_surface, first.map.points)
        outward = first.base_from_surface[:3, 2]
        found = register(points[:: max(1, len(points) // ENOUGH)], RELIEF_SIGMA, self.scan, outward)
        self._nodes = self._lattice(lenses, sorted(images), points, outward, found.base_from_surface)
        return self.refine(lenses, images, found)

    def refine(self, lenses: Lenses, images: dict[int, Image], near: Registration) -> Registration:
        """A place known to a millimetre, refined on pictures of one instant; what was ambiguous before stays so."""
        best = self._settled(lenses, images, near)
        if near.rival is None:
            return best
        other = self._settled(lenses, images, replace(near, base_from_surface=near.rival, rival=None))
        if other.rms > REPEATED * best.rms:
            return best
        if best.rms > REPEATED * other.rms:
            return other
        return replace(best, rival=near.rival, sure=False, verdict=f"{near.verdict}; {best.verdict}")

    def _settled(self, lenses: Lenses, images: dict[int, Image], near: Registration) -> Registration:
        found = near
        for _ in range(ROUNDS):
            pose = found.base_from_surface
            on_scan = np.isfinite(self._nodes[..., 0])
            nodes = se3.transform_points(pose, np.nan_to_num(self._nodes).reshape(-1, 3)).reshape(self._nodes.shape)
            reference = middle_camera(lenses, sorted(images), nodes[on_scan].mean(0)) if on_scan.any() else 0
            matched = match_on(lenses, images, nodes, reference, SPREAD) if on_scan.any() else None
            if matched is None:
                return replace(near, sure=False, verdict=f"{near.verdict}; no two cameras see the scan there")
            sure = matched.sure & on_scan[::SPREAD, ::SPREAD]
            found = settle(matched.points[sure], MATCH_SIGMA, SHARED, self._index, pose)
        return found

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
        low, high = flat.min(0) - MARGIN, flat.max(0) + MARGIN
        lines = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
        lattice = np.stack(np.meshgrid(*lines), -1)
        down = np.concatenate([lattice / FAR, -np.ones((*lattice.shape[:2], 1))], -1).reshape(-1, 3)
        apex = surface_from_plane @ se3.make(np.eye(3), [0.0, 0.0, FAR])
        return cast(self.scan, apex, down).points.reshape(*lattice.shape[:2], 3)


def as_at_one_instant(rig: Rig, pose: Array, single: dict[int, Array]) -> Rig:
    """The rig as it stands to a surface at `pose` (4, 4), where each camera saw it at its own pose `single[c]`.

    Cameras that are not exposed together see a moving surface at different places; moved by the difference they all
    look at the same one.
    """
    cameras = tuple(
        replace(camera, base_from_camera=pose @ se3.inverse(single.get(c, pose)) @ camera.base_from_camera)
        for c, camera in enumerate(rig.cameras)
    )
    return Rig(cameras)
