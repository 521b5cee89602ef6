"""The part of a picture to look at, and how large what is seen there is (thesis Fig. 3.4, 3.5 and `crop_ROI`)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import Camera
from estimation.se3 import Array
from perception.lens import undistort
from perception.wound.segmentation import Mask

Box = tuple[int, int, int, int]  # x0, y0, x1, y1 px, the last two excluded

BORDER = 5  # px round the box, Appendix A
LEAST_SIDE = 8  # px: less holds no patch that could be tracked


def box_of(mask: Mask) -> Box | None:
    """The box round a mask (H, W); None where it is empty."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return (x, y, x + width, y + height) if width and height else None


def region(now: Box | None, before: Box | None, size: tuple[int, int], border: float = BORDER) -> Box:
    """The box round where the wound is and where it was, `border` px wider, inside a picture of `size` (W, H).

    Never empty. The whole picture where the wound is not seen now: it may be anywhere.
    """
    if now is None:
        return 0, 0, *size
    boxes = np.array([now, now if before is None else before], float)
    low = np.clip(np.floor(boxes[:, :2].min(0) - border), 0, np.array(size) - min(LEAST_SIDE, *size))
    high = np.clip(np.ceil(boxes[:, 2:].max(0) + border), low + min(LEAST_SIDE, *size), size)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def polygon(box: Box) -> Array:
    """(4, 2) px corners of a box."""
    x0, y0, x1, y1 = box
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)


def area_on_plane(mask: Mask, camera: Camera, base_from_surface: Array) -> float:
    """mm^2 of a mask (H, W) laid through the lens onto the plane z = 0 of the surface; nan where rays miss it.

    base_from_surface: (4, 4) mm, z out of the surface, where the picture was taken. Holes in the mask count.
    """
    camera_from_surface = se3.inverse(camera.base_from_camera) @ base_from_surface
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    total = 0.0
    for each in contours:
        contour = np.asarray(each, np.int32)
        places = _on_plane(contour.reshape(-1, 2).astype(float), camera, camera_from_surface)
        if not np.isfinite(places).all():
            return float("nan")
        total += _enclosed(places) * _half_pixel(contour)
    return total


def _half_pixel(contour: NDArray[np.int32]) -> float:
    """What the outline through the outermost pixels' middles leaves out, as a factor: half a pixel all round."""
    inner = cv2.contourArea(contour)
    outer = inner + len(contour) / 2 + 1  # Pick's theorem: of a contour whose pixels are all listed
    return outer / inner if inner else 1.0


def _on_plane(pixels: Array, camera: Camera, camera_from_surface: Array) -> Array:
    """(N, 2) mm on the surface's plane that pixels (N, 2) show; nan behind the camera."""
    ideal = undistort(camera, pixels)
    rays = np.column_stack([ideal, np.ones(len(ideal))]) @ np.linalg.inv(camera.matrix).T
    surface_from_camera = se3.inverse(camera_from_surface)
    directions, origin = rays @ surface_from_camera[:3, :3].T, surface_from_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = -origin[2] / directions[:, 2]
    return np.where(reach[:, None] > 0, origin[:2] + reach[:, None] * directions[:, :2], np.nan)


def _enclosed(places: Array) -> float:
    """Area of a closed polygon (N, 2) (Gauss's formula)."""
    x, y = places.T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)
