"""Observations: what perception hands to the estimator, the pixels of each track in each camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array, Index, Mask

RAYLEIGH_MEDIAN = 1.1774  # sqrt(2 ln 2): median length of a vector whose two entries are normal, in their sigmas


@dataclass(frozen=True, slots=True, eq=False)
class MissedLandmarks:
    """Landmarks that were looked for, with nothing known to hide them, and not found: M parallel rows."""

    camera: Index  # (M,) number in the rig
    track: Index  # (M,) id of the landmark


NOTHING_MISSED = MissedLandmarks(np.zeros(0, np.int64), np.zeros(0, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class DisplacedPlaces:
    """Places of the surface whose colours do not stand where its tracks put them."""

    centres: Array  # (K, 3) mm, surface frame
    sizes: Array  # (K,) mm, by how much
    reach: float  # mm, one sigma about each centre
    whole: bool  # whether so many of the places that could tell are among them that the pose may be wrong

    @property
    def message(self) -> str:
        """For the operator, or ''."""
        if not len(self.sizes):
            return ""
        return f"colours stand {self.sizes.max():.1f} mm off the texture: something moves over the tissue, or under it"

    @property
    def covariance(self) -> Array:
        """(6, 6) of a pose that may be off by the largest of them, one sigma, along every direction."""
        return np.diag([0.0] * 3 + [float(self.sizes.max(initial=0.0)) ** 2] * 3)


NOTHING_DISPLACED = DisplacedPlaces(np.zeros((0, 3)), np.zeros(0), 1.0, False)


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The N tracks of one frame set, as parallel arrays."""

    stamp: float  # s
    camera: Index  # (N,) number in the rig
    track: Index  # (N,) id of the landmark
    pixels: Array  # (N, 2) undistorted px of the camera's own matrix
    sigma: Array  # (N,) px, one standard deviation per axis
    missed: MissedLandmarks = NOTHING_MISSED  # of the same frame set; not recorded

    def __repr__(self) -> str:
        return f"Observations({len(self)} tracks in {len(np.unique(self.camera))} cameras at {self.stamp:.3f} s)"

    def __len__(self) -> int:
        return len(self.camera)

    def only(self, rows: Mask) -> Observations:
        """The same of some rows (N,), without what was missed."""
        return Observations(self.stamp, self.camera[rows], self.track[rows], self.pixels[rows], self.sigma[rows])


def no_observations(stamp: float) -> Observations:
    """A frame set without a track."""
    none = np.zeros(0, np.int64)
    return Observations(stamp, none, none, np.zeros((0, 2)), np.zeros(0))
