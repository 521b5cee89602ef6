"""A smooth warp of the surface: how far soft tissue departs from the rigid body that the pose describes.

The displacement is a sum of Gaussian bells about a dozen control points, so it is smooth, exact to differentiate and
dies away beside the mapped surface. Its rigid part over the landmarks is zero: pose and warp do not share a motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.se3 import Array

UNDONE = 4  # steps of the inverse: each leaves a share as large as the strain, a few hundredths


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """A displacement field in the surface frame.

    control: (K, 3) mm. coefficients: (K, 3) mm, of the bell about each control point. covariance: (3K, 3K) mm^2 of the
    coefficients, row by row, and growth: (3K, 3K) mm^2/s, by which it grows unseen. reach: mm, one sigma of a bell.
    deformation: mm, root mean square displacement of the landmarks; deformation_sigma: mm, one sigma of it.
    """

    control: Array
    coefficients: Array
    covariance: Array
    growth: Array
    reach: float
    deformation: float
    deformation_sigma: float

    def later(self, seconds: float) -> Warp:
        """The same shape, known as little as `seconds` s from its stamp, before or after."""
        return replace(self, covariance=self.covariance + abs(seconds) * self.growth)

    def displacement(self, points: Array) -> Array:
        """How far (N, 3) mm points (N, 3) of the undeformed surface are moved."""
        return np.asarray(bells(points, self.control, self.reach) @ self.coefficients)

    def apply(self, points: Array) -> Array:
        """Where points (N, 3) mm of the undeformed surface are."""
        return np.asarray(points + self.displacement(points))

    def undo(self, points: Array) -> Array:
        """Which points (N, 3) mm of the undeformed surface are at points (N, 3)."""
        rest = points
        for _ in range(UNDONE):
            rest = points - self.displacement(rest)
        return np.asarray(rest)

    def carry(self, transforms: Array) -> Array:
        """Poses (N, 4, 4) on the undeformed surface, moved and turned with the tissue.

        The turn is that of the displacement's gradient, half its curl: the polar decomposition to first order.
        """
        places = transforms[:, :3, 3]
        bell = bells(places, self.control, self.reach)
        slope = -bell[..., None] * (places[:, None] - self.control) / self.reach**2  # (N, K, 3)
        turn = 0.5 * se3.cross(slope, self.coefficients).sum(1)
        return se3.make(se3.exp_rotation(turn) @ transforms[:, :3, :3], places + bell @ self.coefficients)

    def uncarry(self, transforms: Array) -> Array:
        """Poses (N, 4, 4) on the undeformed surface that are carried to `transforms` (N, 4, 4)."""
        rest = se3.make(transforms[:, :3, :3], self.undo(transforms[:, :3, 3]))
        turned = self.carry(rest)[:, :3, :3] @ np.swapaxes(rest[:, :3, :3], -1, -2)
        return se3.make(np.swapaxes(turned, -1, -2) @ transforms[:, :3, :3], rest[:, :3, 3])

    def spread(self, points: Array) -> Array:
        """Covariance (N, 3, 3), mm^2, of the displacement of points (N, 3)."""
        bell = bells(points, self.control, self.reach)
        count = len(self.control)
        weighted = (bell @ self.covariance.reshape(count, -1)).reshape(-1, 3, count, 3)
        return np.asarray((bell[:, None, None] @ weighted)[:, :, 0])  # matrix products: einsum plans each call anew


def bells(points: Array, control: Array, reach: float) -> Array:
    """Value (N, K) at points (N, 3) of the bell about each control point (K, 3), of one sigma `reach`, mm."""
    square = ((points[:, None] - control) ** 2).sum(-1)
    return np.asarray(np.exp(-square / (2 * reach**2)))
