"""What must not be tracked, as it moves otherwise than the surface: the print head, fresh ink, and highlights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimation import se3
from estimation.se3 import Array
from perception.frames import SYRINGE, Image, PrintHead, check_profile
from perception.lens import Lenses
from perception.mapping.alignment_kernels import PATCH_RADIUS
from perception.mapping.features import ImageMask

BEAD_REACH_MM = 1.0  # mm from the bead's middle: half of a wide bead, as it spreads
BEAD_STEP_MM = 0.5  # mm between the points that stand for a bead
GEL_TIME_S = 60.0  # s that gelling takes; what has set may carry landmarks of its own


class Ink:
    """The beads laid so far, in the surface frame."""

    def __init__(self) -> None:
        self._points: list[Array] = []
        self._stamps: list[float] = []
        self._tip: Array | None = None

    def __len__(self) -> int:
        return len(self._points)

    def lift(self) -> None:
        """The nozzle no longer extrudes: the next bead begins anew."""
        self._tip = None

    def lay(self, stamp: float, tip: Array) -> Array:
        """The bead goes on to the tip (3,) mm at `stamp`, s; the points (M, 3) that are new."""
        start = tip if self._tip is None else self._tip
        pieces = max(1, int(np.ceil(float(np.linalg.norm(tip - start)) / BEAD_STEP_MM)))
        new = start + (tip - start) * (np.arange(1, pieces + 1) / pieces)[:, None]
        self._points.extend(new)
        self._stamps.extend([stamp] * pieces)
        self._tip = tip.copy()
        return new

    def covers(self, points: Array, reach: Array, stamp: float) -> NDArray[np.bool_]:
        """Which points (N, 3) mm lie within their reach (N,) mm of ink that is still fresh at `stamp`, s."""
        fresh = np.searchsorted(self._stamps, stamp - GEL_TIME_S)
        if fresh == len(self._points):
            return np.zeros(len(points), bool)
        away, _ = cKDTree(np.array(self._points[fresh:])).query(points)
        return np.asarray(away < BEAD_REACH_MM + reach)


def near_bead(points: Array, bead: Array, reach: Array) -> NDArray[np.bool_]:
    """Which points (N, 3) lie within BEAD_REACH_MM and their own reach (N,) of a bead's points (M, 3), all mm."""
    return np.asarray(np.linalg.norm(points[:, None] - bead, axis=2).min(1) < BEAD_REACH_MM + reach)


RING_ANGLES = np.linspace(0, 2 * np.pi, 13)[:-1]
MIN_DRAWN_DEPTH_MM = 20.0  # mm: what is nearer to a lens than that is not drawn, as its picture has no bounds


@dataclass(frozen=True, slots=True, eq=False)
class Tool:
    """The print head's shape, round about the nozzle's z."""

    profile: Array  # (K, 2) mm, K > 1: height above the tip, rising, and radius there

    def __post_init__(self) -> None:
        check_profile("tool", "profile", self.profile)

    def silhouette(self, lenses: Lenses, camera: int, base_from_nozzle: Array, margin: float) -> list[Array]:
        """Convex polygons (M, 2) px, as imaged, that together cover the tool's picture; margin: mm around it.

        base_from_nozzle: (4, 4), z from the tip up into the head.
        """
        heights = self.profile[:, 0] + np.r_[-margin, np.zeros(len(self.profile) - 2), margin]
        radii = self.profile[:, 1] + margin
        ring = np.stack([np.cos(RING_ANGLES), np.sin(RING_ANGLES)], -1)
        levels = np.broadcast_to(heights[:, None, None], (len(radii), len(RING_ANGLES), 1))
        rings = np.concatenate([radii[:, None, None] * ring, levels], -1)
        camera_from_nozzle = lenses.rig.camera_from_base[camera] @ base_from_nozzle
        x, y, depth = np.moveaxis(se3.transform_points(camera_from_nozzle, rings.reshape(-1, 3)), -1, 0)
        safe = np.maximum(depth, MIN_DRAWN_DEPTH_MM)
        imaged, visible = lenses.bend(camera, x / safe, y / safe, depth)
        visible = (visible & (depth > MIN_DRAWN_DEPTH_MM)).reshape(len(radii), -1)
        spots = imaged.T.reshape(len(radii), -1, 2)
        drawn = [ring_spots[shown] for ring_spots, shown in zip(spots, visible, strict=True)]
        parts = (np.concatenate(pair) for pair in pairwise(drawn))
        return [cv2.convexHull(p.astype(np.float32))[:, 0].astype(float) for p in parts if len(p) >= 3]


MASK_SCALE = 0.25  # of the masks to the images: to a landmark's patch four pixels are nothing
PRINT_HEAD_MARGIN_MM = 1.5  # mm: to which an arm is registered to the cameras, and its lag known
HIGHLIGHT_GREY = 250  # grey levels, at which a pixel is taken for a highlight,
MAX_HIGHLIGHT_SHARE = 0.2  # of the region; where more is as bright, the tissue or paper is overexposed
HIGHLIGHT_HALO_PX = 5  # px around a highlight that still belong to it


class TrackingMasks:
    """Where in the newest frame set nothing may be tracked, and what the ink on the surface covers."""

    def __init__(self, lenses: Lenses, tool: Tool | None = None) -> None:
        self._lenses, self._tool = lenses, tool or Tool(SYRINGE)
        self.print_head: dict[int, ImageMask] = {}  # by camera, 255 on the head, MASK_SCALE times the image's size
        self.ink = Ink()

    def set_print_head(self, head: PrintHead | None, cameras: Iterable[int]) -> None:
        """Take where the print head is now; None where no arm is known."""
        self.print_head = {}
        if head is None:
            return
        border = 2 * int(np.ceil(PATCH_RADIUS * MASK_SCALE))  # of the mask: patches that overlap the head are left out
        for camera in cameras:
            w, h = self._lenses.rig.cameras[camera].size
            mask = np.zeros((int(np.ceil(h * MASK_SCALE)), int(np.ceil(w * MASK_SCALE))), np.uint8)
            for polygon in self._tool.silhouette(self._lenses, camera, head.base_from_nozzle, PRINT_HEAD_MARGIN_MM):
                outline = np.round(polygon * MASK_SCALE).astype(np.int32)
                cv2.fillConvexPoly(mask, outline, 255)
                cv2.polylines(mask, [outline], True, 255, border)
            if mask.any():
                self.print_head[camera] = mask

    def hides(self, camera: int, pixels: Array) -> NDArray[np.bool_]:
        """Which pixels (N, 2), as imaged, the print head may cover."""
        mask = self.print_head.get(camera)
        if mask is None:
            return np.zeros(len(pixels), bool)
        x, y = np.clip((pixels * MASK_SCALE).astype(int), 0, np.array(mask.shape[::-1]) - 1).T
        return np.asarray(mask[y, x] > 0)

    def lay_ink(self, head: PrintHead | None, stamp: float, base_from_surface: Array) -> Array | None:
        """Take what the head has laid until `stamp`, s, on a surface that is there: the new bead's points (M, 3), mm,
        surface frame."""
        if head is None or not head.extruding:
            self.ink.lift()
            return None
        return self.ink.lay(stamp, se3.transform_points(se3.inverse(base_from_surface), head.base_from_nozzle[:3, 3]))


def patch_reach(axes: Array) -> Array:
    """From the middle of patches with sides (N, 3, 2) mm per sample to their edges, (N,) mm."""
    return np.asarray(PATCH_RADIUS * np.linalg.norm(axes, axis=1).mean(1))


def trackable(image: Image, region: ImageMask, head: ImageMask | None) -> ImageMask:
    """The part (H, W) of a region of a grey image in which tracks may begin. head: as in `TrackingMasks.print_head`."""
    free = region & ~highlights(image, region)
    if head is not None:
        free &= ~np.asarray(cv2.resize(head, free.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
    return np.asarray(free, np.uint8)


def highlights(image: Image, region: ImageMask) -> ImageMask:
    """Mask (H, W), 255 where a grey image has highlights in a region (H, W); empty where much of it is that bright."""
    _, bright = cv2.threshold(image, HIGHLIGHT_GREY - 1, 255, cv2.THRESH_BINARY)
    bright = cv2.bitwise_and(bright, region)
    if cv2.countNonZero(bright) > MAX_HIGHLIGHT_SHARE * cv2.countNonZero(region):
        return np.zeros_like(region)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * HIGHLIGHT_HALO_PX + 1, 2 * HIGHLIGHT_HALO_PX + 1))
    return np.asarray(cv2.dilate(bright, around), np.uint8)
