"""All observations of a recording as parallel arrays, frame set after frame set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.observations import Observations
from estimation.se3 import Array

LEAST_SIGMA = 0.1  # px: alignment claims less on clean images, interpolation and lens model do not allow it


@dataclass(frozen=True, slots=True, eq=False)
class Packed:
    """The tracks of K frame sets.

    stamps: (K,) s, rising. starts: (K + 1,), where each frame set's begin. camera: (N,). landmark: (N,) row below L.
    pixels: (N, 2) undistorted. precision: (N,) px^-2. tracks: (L,) the id that each landmark's observations bear.
    """

    stamps: Array
    starts: NDArray[np.int64]
    camera: NDArray[np.int64]
    landmark: NDArray[np.int64]
    pixels: Array
    precision: Array
    tracks: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.stamps)

    def of(self, frame: int) -> slice:
        """Where the observations of a frame set stand."""
        return slice(int(self.starts[frame]), int(self.starts[frame + 1]))

    def between(self, first: int, last: int) -> slice:
        """Where the observations of frame sets first <= k < last stand."""
        return slice(int(self.starts[first]), int(self.starts[last]))

    def only(self, frames: NDArray[np.int64]) -> Packed:
        """The same of some frame sets (M,), rising."""
        counts = np.diff(self.starts)[frames]
        starts = np.concatenate([[0], np.cumsum(counts)])
        rows = np.repeat(self.starts[frames] - starts[:-1], counts) + np.arange(starts[-1])
        return Packed(
            self.stamps[frames],
            starts,
            self.camera[rows],
            self.landmark[rows],
            self.pixels[rows],
            self.precision[rows],
            self.tracks,
        )

    def landmarks(self, kept: NDArray[np.bool_]) -> Packed:
        """The same of some landmarks (L,) only."""
        mine = kept[self.landmark]
        counts = np.add.reduceat(np.append(mine, 0), self.starts)[:-1] * (np.diff(self.starts) > 0)
        row = np.cumsum(kept) - 1
        return Packed(
            self.stamps,
            np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            self.camera[mine],
            row[self.landmark[mine]],
            self.pixels[mine],
            self.precision[mine],
            self.tracks[kept],
        )


def packed(observations: Sequence[Observations], cameras: int) -> Packed:
    """Observations in order of stamp; InputError where that does not rise or a camera is not the rig's."""
    where = "observations"
    stamps = np.array([seen.stamp for seen in observations], float)
    if len(stamps) < 2:
        raise InputError(where, "frame sets", len(stamps), "two or more")
    if not np.isfinite(stamps).all() or (np.diff(stamps) <= 0).any():
        raise InputError(where, "stamps", "not rising", "each finite and later than the one before, s")
    camera = np.concatenate([seen.camera for seen in observations]).astype(np.int64)
    if len(camera) and not 0 <= camera.min() <= camera.max() < cameras:
        raise InputError(where, "camera", f"{camera.min()}..{camera.max()}", f"0..{cameras - 1}, as the rig has")
    pixels = np.concatenate([seen.pixels for seen in observations])
    sigma = np.concatenate([seen.sigma for seen in observations])
    if not np.isfinite(pixels).all() or not (np.isfinite(sigma) & (sigma > 0)).all():
        raise InputError(where, "pixels and sigma", "not finite, or a sigma <= 0", "finite px, sigma > 0 px")
    tracks, landmark = np.unique(np.concatenate([seen.track for seen in observations]), return_inverse=True)
    starts = np.concatenate([[0], np.cumsum([len(seen) for seen in observations])]).astype(np.int64)
    precision = 1 / np.maximum(sigma, LEAST_SIGMA) ** 2
    return Packed(stamps, starts, camera, landmark.astype(np.int64), pixels, precision, tracks.astype(np.int64))
