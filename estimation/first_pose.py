"""What the first pose given out is off by: the path is placed in it, so all later ones are off by the same.

When it is given out, the restlessness of the images and the cameras' instants are hardly known, and are believed to be
large. What that pose is off by was drawn once and stays; how large a draw it was is known better with every frame set.
"""

from __future__ import annotations

import numpy as np

from estimation.averaged import Averaged
from estimation.fit import Fit
from estimation.online.camera_errors import CameraErrors
from estimation.se3 import Array
from estimation.track_noise import TrackNoise


class FirstPose:
    """The error of one pose, claimed by what is known of the cameras later on."""

    def __init__(self, window: Array, fit: Fit, cameras: CameraErrors) -> None:
        """window: (6, 6), its covariance as the window gave it, with `fit` the newest of the fits averaged there."""
        self._averaged = Averaged(window, fit, cameras.unrest)
        self._tracks = fit.scatter * fit.tracks
        self._late, self._corrected = fit.late, cameras.offset

    def covariance(self, cameras: CameraErrors, tracks: TrackNoise) -> Array:
        """(6, 6) of the error, by what is known of cameras and tracks now."""
        late = self._late @ cameras.beyond(self._corrected) @ self._late.T
        averaged = self._averaged.covariance(tracks, cameras.unrest)
        return np.asarray(averaged + tracks.lasting * self._tracks + late)
