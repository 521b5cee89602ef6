"""What calibration starts from: the corners of one rigid board as the cameras saw them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """One row per picture that shows the board.

    names, sizes: of the C cameras; sizes (W, H) px. points: (P, 3) mm, the board's corners in its own frame. camera:
    (V,) number. instant: (V,) number of the frame set, from 0 in order of stamp. stamp: (V,) s, as the camera told it.
    pixels: (V, P, 2) px as imaged, nan where a corner was not seen. sigma: (V,) px, one standard deviation per axis.
    """

    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    points: Array
    camera: NDArray[np.int64]
    instant: NDArray[np.int64]
    stamp: Array
    pixels: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.camera)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(V, P) which corners were seen."""
        return np.isfinite(self.pixels[..., 0])

    def only(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Views:
        """The rows `kept`, a mask (V,) or numbers, with instants counted anew from 0."""
        instant = np.unique(self.instant[kept], return_inverse=True)[1]
        return Views(
            self.names,
            self.sizes,
            self.points,
            self.camera[kept],
            instant.astype(np.int64),
            self.stamp[kept],
            self.pixels[kept],
            self.sigma[kept],
        )

    def without(self, outliers: NDArray[np.bool_]) -> Views:
        """The same with the corners `outliers` (V, P) taken as not seen."""
        pixels = np.where(outliers[..., None], np.nan, self.pixels)
        return Views(self.names, self.sizes, self.points, self.camera, self.instant, self.stamp, pixels, self.sigma)
