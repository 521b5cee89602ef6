"""A scan as the operator's page draws it: the lines by which its place in a picture can be judged, and a coarse mesh.

The lines are its rim and those along which it lies equally deep under the smooth surface around: they run round a wound
and over every bump, so that a scan that lies wrong is seen to.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.scans.scan import Scan, open_edges
from estimation.se3 import Array, transform_points
from hardware.operator.shared_state import MAX_TRIANGLES, ScanDrawing, coarser_mesh

MAX_LINES = 2500  # of all: 3 cameras draw them five times a second
DRAWN_TRIANGLES = 6000  # of which depth lines are made: 1 mm apart on a scan of 55 mm
DEPTH_LINES = 4  # between the deepest and the smooth surface around
MIN_DEPTH_MM = 0.8  # of anything around which lines are drawn
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
