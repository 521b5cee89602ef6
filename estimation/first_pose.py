"""What the first pose given out is off by: the path is placed in it, so all later ones are off by the same.

When it is given out, the restlessness of the images and the cameras' instants are hardly known, and are believed to be
large. What that pose is off by was drawn once and stays; how large a draw it was is known better with every frame set.
"""

from __future__ import annotations

import numpy as np

from estimation.camera_errors import CameraErrors
from estimation.fit import Fit
from estimation.se3 import Array
from estimation.track_noise import TrackNoise


class FirstPose:
    """The error of one pose, claimed by what is known of the cameras later on."""

    def __init__(self, window: Array, fit: Fit, cameras: CameraErrors) -> None:
        """window: (6, 6), its covariance as the window gave it, with `fit` the newest of the fits averaged there.

        In the axes in which the tracks' noise and that of shifted images are independent, the window's covariance is a
        part of the fit's, whatever the two are sized: each axis is rescaled by itself.
        """
        root = np.linalg.cholesky((fit.noise + fit.noise.T) / 2)
        whitened = np.linalg.solve(root, np.linalg.solve(root, fit.tracks).T)
        share, axes = np.linalg.eigh((whitened + whitened.T) / 2)
        self._by_tracks = np.clip(share, 0.0, 1.0)  # (6,) of the fit's variance, axis by axis
        self._axes = root @ axes  # (6, 6) pose_from_axes
        inner = np.linalg.solve(self._axes, np.linalg.solve(self._axes, window).T)
        self._window = (inner + inner.T) / 2
        self._tracks, self._unrest = fit.scatter * fit.tracks, cameras.unrest
        self._scatter = fit.scatter
        self._late, self._corrected = fit.late, cameras.offset

    def covariance(self, cameras: CameraErrors, tracks: TrackNoise) -> Array:
        """(6, 6) of the error, by what is known of cameras and tracks now."""
        by_images = (1 - self._by_tracks) * (cameras.unrest / self._unrest)
        scale = self._by_tracks * (tracks.anew * self._scatter) + by_images
        scaled = self._axes * np.sqrt(scale)
        late = self._late @ cameras.beyond(self._corrected) @ self._late.T
        return np.asarray(scaled @ self._window @ scaled.T + tracks.lasting * self._tracks + late)
