"""What perception hands to the estimator: where each track stands in each camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array, Index, Mask


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The tracks of one frame set, as parallel arrays.

    stamp: s. camera: (N,) number in the rig. track: (N,) id of the landmark. pixels: (N, 2) undistorted px of the
    camera's own matrix. sigma: (N,) px, one standard deviation per axis.
    """

    stamp: float
    camera: Index
    track: Index
    pixels: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.camera)

    def only(self, rows: Mask) -> Observations:
        """Those of the rows (N,)."""
        return Observations(self.stamp, self.camera[rows], self.track[rows], self.pixels[rows], self.sigma[rows])


def no_observations(stamp: float) -> Observations:
    """A frame set in which no track was found."""
    nothing = np.zeros(0, np.int64)
    return Observations(stamp, nothing, nothing, np.zeros((0, 2)), np.zeros(0))
