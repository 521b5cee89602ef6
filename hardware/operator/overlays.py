"""What the operator's page draws over the pictures: outlines of region and wound, the scan's lines and coarse mesh.

A scan's lines are its rim and those along which it lies equally deep under the smooth surface around: they run round a
wound and over every bump, so that a scan that lies wrong is seen to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Rig, ideal_pixels, pixels_from_points
from estimation.scans.scan import Scan, open_edges
from estimation.se3 import Array, transform_points
from hardware.files.folder_tables import check_polygon
from hardware.files.images import small_jpeg
from hardware.files.region_table import MAX_CORNERS, Corners, crossing_edges
from hardware.operator.shared_state import (
    MAX_TRIANGLES,
    CameraPicture,
    PagePictures,
    Polygons,
    ScanDrawing,
    coarser_mesh,
)
from perception.frames import FrameSet, OutlinedPicture, Roi
from perception.lens import undistort
from perception.mapping.features import polygon_mask

if TYPE_CHECKING:
    from perception.tracking.wound_step import WoundSight
from perception.wound.segmentation import WoundMask, dice, hull_of, largest_part, outline_of

MAX_LINES = 2500  # of all: 3 cameras draw them five times a second
DRAWN_TRIANGLES = 6000  # of which depth lines are made: 1 mm apart on a scan of 55 mm
DEPTH_LINES = 4  # between the deepest and the smooth surface around
MIN_DEPTH_MM = 0.8  # of anything around which lines are drawn
DEPTH_NEIGHBOURS = 3  # landmarks whose depth a corner of an outline is taken to have
OUTLINE_TOLERANCES = (0.004, 0.006, 0.01, 0.015, 0.025, 0.04)  # of its length, by which a wound's outline is simplified
MAX_OUTLINE_CORNERS = 24  # of a wound's outline as it is shown: more are no easier to put right by hand
MIN_OUTLINE_DICE = 0.9  # of the polygon and what was found: below, it would be drawn anew
SHEET_WIDTH, SHEET_QUALITY = 1280, 85  # px and JPEG of pictures on which an outline is corrected
OPERATOR = "operator"  # who says so, in a recording
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


def wound_corners(mask: WoundMask) -> Corners:
    """A polygon of few corners, px, round the largest part of a mask (H, W), without crossing edges.

    The convex hull where no such polygon covers that part well; () of an empty mask.
    """
    if not mask.any():
        return ()
    part, (height, width) = largest_part(mask), mask.shape
    for tolerance in OUTLINE_TOLERANCES:
        corners = outline_of(part, tolerance)
        if not 3 <= len(corners) <= MAX_OUTLINE_CORNERS or crossing_edges(corners) is not None:
            continue
        if dice(polygon_mask((width, height), corners) > 0, part) > MIN_OUTLINE_DICE:
            return _corners(corners)
    hull = hull_of(part)
    return _corners(hull) if 3 <= len(hull) <= MAX_CORNERS else ()


def _corners(points: Array) -> Corners:
    return tuple((float(x), float(y)) for x, y in points)


class OutlineSheet:
    """The pictures of one instant, and the wound's outline in them, which an operator may correct there."""

    def __init__(self, rig: Rig, frames: FrameSet, polygons: Mapping[int, Corners]) -> None:
        """polygons: the outline by camera, px; none of a camera that sees no wound."""
        self._rig, self._frames, self._polygons = rig, frames, polygons
        self._placed: tuple[Array, Array] | None = None

    def pictures(self) -> PagePictures:
        """For the page: each picture whole, with its outline."""
        pictures = []
        for frame in self._frames.frames:
            camera, corners = self._rig.cameras[frame.camera], self._polygons.get(frame.camera, ())
            outline = (np.clip(corners, 0, np.array(camera.size) - 1.0),) if corners else ()
            jpeg = small_jpeg(frame.image, SHEET_WIDTH, SHEET_QUALITY)
            pictures.append(CameraPicture(camera.name, jpeg, outline))
        return PagePictures(self._frames.stamp, tuple(pictures))

    def place(self, points_surface: Array, base_from_surface: Array) -> None:
        """Take where the surface, mapped by landmarks (V, 3) mm, was in these pictures; the first place counts."""
        self._placed = self._placed or (points_surface, base_from_surface)

    def recorded(self, polygons: Polygons, stamp: float) -> list[OutlinedPicture]:
        """What is recorded of an outline that an operator says at `stamp`, s: a picture of each camera that has one."""
        said, frames = self._by_number(polygons), {frame.camera: frame for frame in self._frames.frames}
        return [
            OutlinedPicture(number, stamp, frames[number].stamp, frames[number].image, corners, OPERATOR)
            for number, corners in said.items()
            if number in frames
        ]

    def rois(self, polygons: Polygons, base_from_surface: Array | None) -> tuple[Roi, ...]:
        """An operator's outline as a region from now on, carried to where the surface is now as any region is.

        base_from_surface: (4, 4) mm; None where that is not known. The region is then where it was drawn, as it is in a
        camera that would not see it any more.
        """
        drawn = tuple(Roi(number, -np.inf, corners) for number, corners in self._by_number(polygons).items())
        if self._placed is None or base_from_surface is None:
            return drawn
        outline = SurfaceOutline(self._rig)
        outline.place(drawn, *self._placed)
        return tuple(self._seen(roi, outline.in_pixels(roi.camera, base_from_surface)) for roi in drawn)

    def _seen(self, drawn: Roi, carried: tuple[Array, ...]) -> Roi:
        """The region as it was carried along, where that is one in the camera's picture; else as it was drawn."""
        for polygon in carried:
            with suppress(InputError):
                check_polygon("the page", "outline", polygon, self._rig.cameras[drawn.camera].size)
                return replace(drawn, polygon=polygon)
        return drawn

    def _by_number(self, polygons: Polygons) -> dict[int, Array]:
        """Corners (N, 2) px by the camera's number in the rig."""
        names = [camera.name for camera in self._rig.cameras]
        return {names.index(name): np.array(corners, float) for name, corners in polygons}


def sheet_from_sight(rig: Rig, sight: WoundSight) -> OutlineSheet:
    """The pictures in which a network looked for the wound, with the outline that it found."""
    return OutlineSheet(rig, sight.frames, {camera: wound_corners(mask) for camera, mask in sight.masks.items()})


def sheet_from_rois(rig: Rig, frames: FrameSet, rois: Sequence[Roi]) -> OutlineSheet:
    """The first pictures that were followed inside an operator's outline, with that outline."""
    return OutlineSheet(rig, frames, {roi.camera: _corners(np.round(roi.polygon, 1)) for roi in rois})
