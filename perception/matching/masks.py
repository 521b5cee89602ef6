"""What must not be tracked: the print head, fresh ink, and highlights, which move otherwise than the surface does."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.se3 import Array
from perception.features import Mask
from perception.frames import Image, PrintHead
from perception.ink import Ink
from perception.lens import Lenses
from perception.matching.alignment_kernels import RADIUS
from perception.tool import Tool, draw
from perception.tool_profile import SYRINGE

SCALE = 0.25  # of the masks to the images: to a landmark's patch four pixels are nothing
MARGIN = 1.5  # mm: to which an arm is registered to the cameras, and its lag known
BRIGHT = 250  # grey levels, at which a pixel is taken for a highlight,
GLINTS = 0.2  # unless more of the region is as bright: then it is the tissue, or paper, that is overexposed
HALO = 5  # px around a highlight that still belong to it


class KeepOut:
    """Where in the newest frame set nothing may be tracked, and what the ink on the surface covers."""

    def __init__(self, lenses: Lenses, tool: Tool | None = None) -> None:
        self._lenses, self._tool = lenses, tool or Tool(SYRINGE)
        self.masks: dict[int, Mask] = {}  # by camera, SCALE times its image's size, 255 where the print head is
        self.ink = Ink()

    def look(self, head: PrintHead | None, cameras: Iterable[int]) -> None:
        """Take where the print head is now; None where no arm is known."""
        self.masks = {}
        if head is None:
            return
        for camera in cameras:
            polygons = self._tool.silhouette(self._lenses, camera, head.base_from_nozzle, MARGIN)
            w, h = self._lenses.rig.cameras[camera].size
            mask = np.zeros((int(np.ceil(h * SCALE)), int(np.ceil(w * SCALE))), np.uint8)
            draw(mask, polygons, SCALE, int(np.ceil(RADIUS * SCALE)))
            if mask.any():
                self.masks[camera] = mask

    def hides(self, camera: int, pixels: Array) -> NDArray[np.bool_]:
        """Which pixels (N, 2), as imaged, the print head may cover."""
        mask = self.masks.get(camera)
        if mask is None:
            return np.zeros(len(pixels), bool)
        x, y = np.clip((pixels * SCALE).astype(int), 0, np.array(mask.shape[::-1]) - 1).T
        return np.asarray(mask[y, x] > 0)

    def lay(self, head: PrintHead | None, stamp: float, base_from_surface: Array) -> Array | None:
        """Take what the head has laid until `stamp`, s, on a surface that is there: the new bead's points (M, 3), mm,
        surface frame."""
        if head is None or not head.extruding:
            self.ink.lift()
            return None
        return self.ink.lay(stamp, se3.transform_points(se3.inverse(base_from_surface), head.base_from_nozzle[:3, 3]))


def patch_reach(axes: Array) -> Array:
    """From the middle of patches with sides (N, 3, 2) mm per sample to their edges, (N,) mm."""
    return np.asarray(RADIUS * np.linalg.norm(axes, axis=1).mean(1))


def trackable(image: Image, region: Mask, head: Mask | None) -> Mask:
    """The part (H, W) of a region of a grey image in which tracks may begin. head: as in `KeepOut.masks`."""
    free = region & ~highlights(image, region)
    if head is not None:
        free &= ~np.asarray(cv2.resize(head, free.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
    return np.asarray(free, np.uint8)


def highlights(image: Image, region: Mask) -> Mask:
    """Mask (H, W), 255 where a grey image has highlights in a region (H, W); empty where much of it is that bright."""
    _, bright = cv2.threshold(image, BRIGHT - 1, 255, cv2.THRESH_BINARY)
    bright = cv2.bitwise_and(bright, region)
    if cv2.countNonZero(bright) > GLINTS * cv2.countNonZero(region):
        return np.zeros_like(region)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * HALO + 1, 2 * HALO + 1))
    return np.asarray(cv2.dilate(bright, around), np.uint8)
