"""The whole path carried along with the surface (thesis 5.4): Eq. 5.1 to 5.7 are one product of transforms.

    base_from_nozzle = base_from_surface @ surface_from_nozzle

The thesis turns about one axis after the other, about a point P_R (Eq. 5.4 to 5.6), and then shifts (Eq. 5.7); the
product does all of that at once for every checkpoint, turn of the tool included, and knows no special point.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose
from estimation.se3 import Array
from planning.kinematics import SimpleArm


class Update(Enum):
    """What became of the trajectory, the three answers of thesis Fig. 5.9."""

    CHANGED = 0  # new coordinates are there
    UNCHANGED = 1  # thesis code 1: the surface did not move, go on with those there are
    ERROR = -1  # the pose is not worth following: keep the last checkpoint in mind and do not move


class CarriedPath:
    """N checkpoints where the newest surface pose puts them; what they were carried to last is kept on an error.

    Inside, transforms are (4, 3, N) in memory: their columns, each of which one product of matrices carries. One for
    all four was measured to take half as long again, and now and then ten times as long.
    """

    def __init__(self, surface_from_nozzle: Array, arm: SimpleArm) -> None:
        """surface_from_nozzle: (N, 4, 4) mm."""
        self._path, self._arm = surface_from_nozzle, arm
        self._columns = self._columns_of(surface_from_nozzle)
        self._carried = np.full_like(self._columns, np.nan)
        self._arm_from_surface: Array | None = None

    def __call__(self, pose: SurfacePose | None) -> Update:
        """Carry all checkpoints to the pose, warp included."""
        if pose is None or not pose.state.measured or not np.isfinite(pose.base_from_surface).all():
            return Update.ERROR
        arm_from_surface = self._arm.arm_from_base @ pose.base_from_surface
        same = self._arm_from_surface is not None and np.array_equal(arm_from_surface, self._arm_from_surface)
        if same and pose.warp is None:
            return Update.UNCHANGED
        columns = self._columns if pose.warp is None else self._columns_of(pose.warp.carry(self._path))
        np.matmul(arm_from_surface[:3, :3], columns, out=self._carried)
        self._carried[3] += arm_from_surface[:3, 3:]
        self._arm_from_surface = None if pose.warp is not None else arm_from_surface
        return Update.CHANGED

    @property
    def base_from_nozzle(self) -> Array:
        """Where the nozzle shall be at each checkpoint (N, 4, 4)."""
        rows = self._carried.T
        turn = rows[..., :3] @ self._arm.arm_from_upright
        tip = rows[..., 3] + turn @ self._arm.tool_offset
        return np.asarray(se3.inverse(self._arm.arm_from_base) @ se3.make(turn, tip))

    @property
    def axes(self) -> Array:
        """Machine axes (6, N) in the simple mode, mm and rad."""
        (x, y, z, tip), axes = self._carried, np.empty((6, self._carried.shape[2]))
        axes[:3] = tip
        np.arctan2(y[2], z[2], out=axes[3])
        np.arctan2(-x[2], np.sqrt(x[0] ** 2 + x[1] ** 2), out=axes[4])
        np.arctan2(x[1], x[0], out=axes[5])
        return axes

    def _columns_of(self, transforms: Array) -> Array:
        """Transforms (N, 4, 4) as (4, 3, N), of where the arm believes the tip, upright at A = B = C = 0."""
        place = transforms[:, :3, 3] - transforms[:, :3, :3] @ self._arm.tool_offset
        turn = transforms[:, :3, :3] @ self._arm.arm_from_upright.T
        return np.ascontiguousarray(se3.make(turn, place)[:, :3].T)
