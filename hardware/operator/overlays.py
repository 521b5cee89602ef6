"""What the operator's page draws over the pictures: the outline of the region, and the scan's lines and coarse mesh.

A scan's lines are its rim and those along which it lies equally deep under the smooth surface around: they run round a
wound and over every bump, so that a scan that lies wrong is seen to.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import Rig, ideal_pixels, pixels_from_points
from estimation.scans.scan import Scan, open_edges
from estimation.se3 import Array, transform_points
from hardware.operator.shared_state import MAX_TRIANGLES, ScanDrawing, coarser_mesh
from perception.frames import Roi
from perception.lens import undistort

MAX_LINES = 2500  # of all: 3 cameras draw them five times a second
DRAWN_TRIANGLES = 6000  # of which depth lines are made: 1 mm apart on a scan of 55 mm
DEPTH_LINES = 4  # between the deepest and the smooth surface around
MIN_DEPTH_MM = 0.8  # of anything around which lines are drawn
DEPTH_NEIGHBOURS = 3  # landmarks whose depth a corner of an outline is taken to have
FIT_ROUNDS = 12  # of the smooth surface; by then what lies deep has lost its weight


def scan_drawing(scan: Scan) -> ScanDrawing:
    """The lines and a coarse mesh of a scan, few enough for a browser."""
    rim = scan.vertices[open_edges(scan)]  # (E, 2, 3)
    points, triangles = scan.vertices, np.asarray(scan.triangles, np.int64)
    if len(triangles) > DRAWN_TRIANGLES:
        points, triangles = coarser_mesh(points, triangles, DRAWN_TRIANGLES)
    lines = np.concatenate([rim, depth_lines(points, triangles)])
    if len(triangles) > MAX_TRIANGLES:
        points, triangles = coarser_mesh(points, triangles, MAX_TRIANGLES)
    every = max(1, -(-len(lines) // MAX_LINES))
    return ScanDrawing(lines[::every], points, triangles)


def depth_lines(points: Array, triangles: NDArray[np.int64]) -> Array:
    """Lines (L, 2, 3) of equal depth under the smooth surface, on a mesh of points (V, 3), mm."""
    depth = _depths(points)
    low, high = np.percentile(depth, [0.5, 99.5])
    levels = [share * end for end in (low, high) if abs(end) > MIN_DEPTH_MM for share in _shares()]
    lines = [_crossings(points, triangles, depth - level) for level in levels]
    return np.concatenate([np.zeros((0, 2, 3)), *lines])


def _shares() -> list[float]:
    return [(k + 0.5) / DEPTH_LINES for k in range(DEPTH_LINES)]


def _depths(points: Array) -> Array:
    """Heights (V,) mm over a quadric through the points that most of them lie on."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2]
    x, y, z = transform_points(np.vstack([np.column_stack([axes, -axes @ centre]), [0, 0, 0, 1]]), points).T
    size = max(float(np.abs(np.stack([x, y])).max()), 1e-9)
    u, v = x / size, y / size
    design = np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])
    weight = np.ones(len(points))
    off = z
    for _ in range(FIT_ROUNDS):
        root = np.sqrt(weight)[:, None]
        off = z - design @ np.linalg.lstsq(design * root, z * root[:, 0], rcond=None)[0]
        scale = max(1.4826 * float(np.median(np.abs(off))), 0.1)
        weight = (1 + (off / scale) ** 2) ** -2
    return np.asarray(off)


def _crossings(points: Array, triangles: NDArray[np.int64], value: Array) -> Array:
    """Where a value (V,) at the corners is zero on the triangles: lines (L, 2, 3)."""
    value = np.where(value == 0, 1e-12, value)
    corner = value[triangles]  # (T, 3)
    crossed = (corner > 0).any(axis=1) & (corner < 0).any(axis=1)
    faces, corner = triangles[crossed], corner[crossed]
    alone = np.argmax((corner > 0) == ((corner > 0).sum(axis=1) == 1)[:, None], axis=1)  # the corner on its own side
    rows = np.arange(len(faces))
    ends = []
    for step in (1, 2):
        other = (alone + step) % 3
        a, b = corner[rows, alone], corner[rows, other]
        share = (a / (a - b))[:, None]
        ends.append((1 - share) * points[faces[rows, alone]] + share * points[faces[rows, other]])
    return np.stack(ends, axis=1)


class SurfaceOutline:
    """Each camera's region of interest as an outline on the surface, once it is placed there."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._corners: dict[int, Array] = {}  # (K, 3) mm, surface frame, by camera

    @property
    def on_surface(self) -> list[Array]:
        """The outlines that are placed, (K, 3) mm each, surface frame."""
        return list(self._corners.values())

    def place(self, rois: Sequence[Roi], points_surface: Array, base_from_surface: Array) -> None:
        """Put the regions onto a surface of landmarks (V, 3), mm; a region that is a whole picture is no outline."""
        points_base = se3.transform_points(base_from_surface, points_surface)
        surface_from_base = se3.inverse(base_from_surface)
        for roi in rois:
            camera = self._rig.cameras[roi.camera]
            inside = ((roi.polygon > 0) & (roi.polygon < np.array(camera.size) - 1)).all(axis=1)
            if len(points_base) < DEPTH_NEIGHBOURS or not inside.any():
                continue
            corners = undistort(camera, roi.polygon)  # (K, 2)
            pixels, depths = ideal_pixels(camera, points_base)
            distances = np.linalg.norm(corners[:, None] - pixels[None], axis=2)  # (K, V)
            nearest = np.argsort(distances, axis=1)[:, :DEPTH_NEIGHBOURS]
            rays = np.column_stack([corners, np.ones(len(corners))]) @ np.linalg.inv(camera.matrix).T
            corners_base = se3.transform_points(camera.base_from_camera, rays * depths[nearest].mean(axis=1)[:, None])
            self._corners[roi.camera] = se3.transform_points(surface_from_base, corners_base)

    def in_pixels(self, camera: int, base_from_surface: Array) -> tuple[Array, ...]:
        """A camera's outline in its picture, (K, 2) px as the lens images it; none if it is not known."""
        if camera not in self._corners:
            return ()
        points_base = se3.transform_points(base_from_surface, self._corners[camera])
        pixels, depth = pixels_from_points(self._rig.cameras[camera], points_base)
        return (pixels,) if (depth > 0).all() else ()
