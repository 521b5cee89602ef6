"""Pictures as an ideal lens would have taken them (thesis 4.2): nothing cut off, black where nothing is."""

from __future__ import annotations

import cv2
import numpy as np

from estimation.rig import Camera
from estimation.se3 import Array
from perception.frames import Image

QUALITY = 80  # of the JPEG, 0 to 100


def whole_view(camera: Camera) -> Array:
    """Camera matrix (3, 3) of an undistorted picture of the same size that keeps every pixel (thesis: alpha = 1)."""
    return np.asarray(cv2.getOptimalNewCameraMatrix(camera.matrix, camera.distortion, camera.size, 1.0)[0])


def undistorted(camera: Camera, image: Image) -> Image:
    """The picture without distortion, every pixel of it kept."""
    return np.asarray(cv2.undistort(image, camera.matrix, camera.distortion, None, whole_view(camera)), np.uint8)


def thumbnail(image: Image, width: int) -> bytes:
    """The picture as JPEG, `width` px wide."""
    height = round(image.shape[0] * width / image.shape[1])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert ok
    return data.tobytes()
