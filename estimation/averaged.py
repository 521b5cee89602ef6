"""The noise of one pose as the window has averaged it, resized by what is known of tracks and images later on.

The window reckons with tracks and images as they are believed to be at first. In the axes in which the tracks' noise
and that of shifted images are independent, its covariance is a part of the fit's, whatever the two are sized: each axis
is rescaled by itself.
"""

from __future__ import annotations

import numpy as np

from estimation.fit import Fit
from estimation.se3 import Array
from estimation.track_noise import TrackNoise


class Averaged:
    """The window's covariance of one pose, in axes in which tracks and images are apart."""

    def __init__(self, window: Array, fit: Fit, unrest: float) -> None:
        """window: (6, 6), with `fit` the newest of the fits averaged there. unrest: px^2, reckoned with in it."""
        root = np.linalg.cholesky((fit.noise + fit.noise.T) / 2)
        back = np.linalg.inv(root)
        whitened = back @ fit.tracks @ back.T
        share, axes = np.linalg.eigh((whitened + whitened.T) / 2)
        self._by_tracks = np.clip(share, 0.0, 1.0)  # (6,) of the fit's variance, axis by axis
        self._axes = root @ axes  # (6, 6) pose_from_axes
        inner = axes.T @ back @ window @ back.T @ axes
        self._window = (inner + inner.T) / 2
        self._scatter, self._unrest = fit.scatter, unrest

    def covariance(self, tracks: TrackNoise, unrest: float) -> Array:
        """(6, 6), by what is known of the tracks now, and of the images' unrest, px^2."""
        by_images = (1 - self._by_tracks) * (unrest / self._unrest)
        scaled = self._axes * np.sqrt(self._by_tracks * (tracks.anew * self._scatter) + by_images)
        return np.asarray(scaled @ self._window @ scaled.T)
