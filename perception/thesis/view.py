"""A camera's picture without its lens, as the thesis works in (4.2)."""

from __future__ import annotations

import cv2
import numpy as np

from estimation.errors import InputError
from estimation.rig import Camera
from estimation.se3 import Array
from perception.features import grey
from perception.frames import Image
from perception.lens import undistort


class FlatView:
    """One camera's undistorted view: getOptimalNewCameraMatrix with alpha = 1, which retains all pixels, thesis 4.2.

    camera: what the pictures are of. matrix: (3, 3) px, the view's own. The maps are worked out once; OpenCV's
    undistort(), which the thesis calls, makes the same ones again for each picture.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        found, _ = cv2.getOptimalNewCameraMatrix(camera.matrix, camera.distortion, camera.size, 1)
        self.matrix = np.asarray(found, np.float64)
        self._maps = cv2.initUndistortRectifyMap(
            camera.matrix, camera.distortion, np.eye(3), self.matrix, camera.size, cv2.CV_16SC2
        )

    def flatten(self, image: Image) -> Image:
        """The whole picture, grey (H, W), as the view shows it; InputError where it is not of the camera's size."""
        (h, w), size = image.shape[:2], self.camera.size
        if (w, h) != size:
            raise InputError(f"camera {self.camera.name}", "image size", f"{w} x {h}", "{} x {} px".format(*size))
        return np.asarray(cv2.remap(grey(image), *self._maps, cv2.INTER_LINEAR), np.uint8)

    def pixels(self, imaged: Array) -> Array:
        """The view's pixels (N, 2) of pixels as the lens images them (N, 2)."""
        return self._between(self.camera.matrix, self.matrix, undistort(self.camera, imaged))

    def ideal(self, pixels: Array) -> Array:
        """Undistorted pixels (N, 2) of the camera's own matrix from the view's (N, 2)."""
        return self._between(self.matrix, self.camera.matrix, pixels)

    @staticmethod
    def _between(old: Array, new: Array, pixels: Array) -> Array:
        x = (pixels - old[:2, 2]) / old[[0, 1], [0, 1]]
        return np.asarray(x * new[[0, 1], [0, 1]] + new[:2, 2])

    def scale(self, point_base: Array) -> Array:
        """mm per px (2,), along the image's x and y, at the depth of a point (3,) mm, base frame.

        Thesis 4.2 divides the known size of a chessboard's squares by their size in pixels, the board held where the
        surface is; of a calibrated camera that is depth over focal length. One factor an axis instead of one a camera:
        the view's pixels are not square where alpha = 1 stretches them. As in the thesis it stays what it was at the
        start, however the depth changes.
        """
        depth = (self.camera.base_from_camera[:3, :3].T @ (point_base - self.camera.base_from_camera[:3, 3]))[2]
        return np.asarray(depth / self.matrix[[0, 1], [0, 1]])
