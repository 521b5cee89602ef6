"""Where a session's print head was: a row for each frame set that was taken with an arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.se3 import Array
from perception.frames import PrintHead

TOLERANCE = 0.002  # s from a row to its frame set: what rounded stamps are off by, far below a frame's period


@dataclass(frozen=True, slots=True, eq=False)
class Heads:
    """Print heads in order of stamp, as they were stored.

    rows: (N, 8) stamp x y z qx qy qz qw of base_from_nozzle, s and mm. extruding: (N,), whether ink flowed.
    """

    rows: Array
    extruding: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.rows)

    def at(self, stamp: float) -> PrintHead | None:
        """The head of the frame set at `stamp`, s; None where there is no row within TOLERANCE."""
        if not len(self):
            return None
        after = int(np.searchsorted(self.rows[:, 0], stamp))
        near = min({max(after - 1, 0), min(after, len(self) - 1)}, key=lambda i: abs(float(self.rows[i, 0]) - stamp))
        if abs(self.rows[near, 0] - stamp) > TOLERANCE:
            return None
        return head_from_row(self.rows[near], bool(self.extruding[near]))


NO_HEADS = Heads(np.empty((0, 8)), np.empty(0, bool))


def head_from_row(row: Array | Sequence[float], extruding: bool) -> PrintHead:
    """The print head in a row (8,) of stamp x y z qx qy qz qw, s and mm."""
    return PrintHead(se3.make(se3.rotation_from_quaternion(row[4:]), row[1:4]), extruding)


def row_from_head(stamp: float, head: PrintHead) -> Array:
    """The row (8,) of stamp x y z qx qy qz qw, s and mm, that holds a print head."""
    nozzle = head.base_from_nozzle
    return np.array([stamp, *nozzle[:3, 3], *se3.quaternion_from_rotation(nozzle[:3, :3])])
