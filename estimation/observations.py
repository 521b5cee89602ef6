"""Observations: what perception hands to the estimator, the pixels of each track in each camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array, Index, Mask

RAYLEIGH_MEDIAN = 1.1774  # sqrt(2 ln 2): median length of a vector whose two entries are normal, in their sigmas


@dataclass(frozen=True, slots=True, eq=False)
class MissedLandmarks:
    """Landmarks that were searched and not found although nothing known hides them: M parallel rows."""

    camera: Index  # (M,) number in the rig
    track: Index  # (M,) id of the landmark


NO_MISSED_LANDMARKS = MissedLandmarks(np.zeros(0, np.int64), np.zeros(0, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class DisplacedPlaces:
    """Places of the surface where colours and texture disagree about the position."""

    centres: Array  # (K, 3) mm, surface frame
    distances: Array  # (K,) mm, between colours and texture
    reach: float  # mm, one sigma about each centre
    ambiguous: bool  # whether they are so many of the checked places that the pose itself may be wrong

    @property
    def message(self) -> str:
        """For the operator, or ''."""
        if not len(self.distances):
            return ""
        return (
            f"colours stand {self.distances.max():.1f} mm off the texture: something moves over the tissue, or under it"
        )

    @property
    def covariance(self) -> Array:
        """Pose covariance (6, 6) for an error of the largest distance, one sigma, along every direction."""
        return np.diag([0.0] * 3 + [float(self.distances.max(initial=0.0)) ** 2] * 3)


NO_DISPLACED_PLACES = DisplacedPlaces(np.zeros((0, 3)), np.zeros(0), 1.0, False)


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The N tracks of one frame set, as parallel arrays."""

    stamp: float  # s
    camera: Index  # (N,) number in the rig
    track: Index  # (N,) id of the landmark
    pixels: Array  # (N, 2) undistorted px of the camera's own matrix
    sigma: Array  # (N,) px, one standard deviation per axis
    missed: MissedLandmarks = NO_MISSED_LANDMARKS  # of the same frame set; not recorded

    def __repr__(self) -> str:
        return f"Observations({len(self)} tracks in {len(np.unique(self.camera))} cameras at {self.stamp:.3f} s)"

    def __len__(self) -> int:
        return len(self.camera)

    def select(self, rows: Mask) -> Observations:
        """The observations of some rows, a mask (N,), without the missed landmarks."""
        return Observations(self.stamp, self.camera[rows], self.track[rows], self.pixels[rows], self.sigma[rows])


def no_observations(stamp: float) -> Observations:
    """A frame set without a track."""
    empty = np.zeros(0, np.int64)
    return Observations(stamp, empty, empty, np.zeros((0, 2)), np.zeros(0))
