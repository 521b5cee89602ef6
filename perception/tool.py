"""The print head as the cameras see it: a body turned about the nozzle's axis, drawn from where the arm says it is."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from estimation import se3
from estimation.se3 import Array
from perception.features import Mask
from perception.lens import Lenses
from perception.tool_profile import check_profile

AROUND = np.linspace(0, 2 * np.pi, 13)[:-1]
NEAR = 20.0  # mm: what is nearer to a lens than that is not drawn, as its picture has no bounds


@dataclass(frozen=True, slots=True, eq=False)
class Tool:
    """profile: (K, 2) mm, K > 1, height above the tip along the nozzle's z, rising, and radius there."""

    profile: Array

    def __post_init__(self) -> None:
        check_profile("tool", "profile", self.profile)

    def silhouette(self, lenses: Lenses, camera: int, base_from_nozzle: Array, margin: float) -> list[Array]:
        """Convex polygons (M, 2) px, as imaged, that together cover the tool's picture; margin: mm around it.

        base_from_nozzle: (4, 4), z from the tip up into the head.
        """
        heights = self.profile[:, 0] + np.r_[-margin, np.zeros(len(self.profile) - 2), margin]
        radii = self.profile[:, 1] + margin
        ring = np.stack([np.cos(AROUND), np.sin(AROUND)], -1)
        rings = np.concatenate(
            [radii[:, None, None] * ring, np.broadcast_to(heights[:, None, None], (len(radii), len(AROUND), 1))], -1
        )
        camera_from_nozzle = lenses.rig.camera_from_base[camera] @ base_from_nozzle
        x, y, depth = np.moveaxis(se3.transform_points(camera_from_nozzle, rings.reshape(-1, 3)), -1, 0)
        safe = np.maximum(depth, NEAR)
        imaged, seen = lenses.bend(camera, x / safe, y / safe, depth)
        seen = (seen & (depth > NEAR)).reshape(len(radii), -1)
        spots = imaged.T.reshape(len(radii), -1, 2)
        parts = (np.concatenate([spots[i][seen[i]], spots[i + 1][seen[i + 1]]]) for i in range(len(radii) - 1))
        return [cv2.convexHull(p.astype(np.float32))[:, 0].astype(float) for p in parts if len(p) >= 3]


def draw(mask: Mask, polygons: list[Array], scale: float, border: int) -> None:
    """Set a mask, `scale` times the image's size, to 255 inside polygons (M, 2) px of the image and `border` px around.

    border: of the mask.
    """
    for polygon in polygons:
        outline = np.round(polygon * scale).astype(np.int32)
        cv2.fillConvexPoly(mask, outline, 255)
        if border:
            cv2.polylines(mask, [outline], True, 255, 2 * border)
