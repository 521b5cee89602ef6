"""Where the nozzle was and where it should have been, each on a clock that nobody in the loop can see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class NozzleLog:
    """One row a millisecond, all of it true, N rows.

    stamps: (N,) s. base_from_surface: (N, 4, 4) mm. base_from_nozzle: (N, 4, 4) mm, executed by the arm.
    base_from_target: (N, 4, 4) mm, the checkpoint on the true surface that was due at that instant; NaN where none was
    (before the first, on the way there). place: (N,) mm along the path of that checkpoint, NaN likewise. checkpoint:
    (N,) its number, -1 likewise. extrude: (N,) whether material leaves the nozzle. reason: (N,) why the arm holds, ""
    while it moves. surface_from_tip: (N, 3) mm, the nozzle's tip in the surface frame, deformation taken back.
    """

    stamps: Array
    base_from_surface: Array
    base_from_nozzle: Array
    base_from_target: Array
    place: Array
    checkpoint: NDArray[np.int64]
    extrude: NDArray[np.bool_]
    reason: NDArray[np.str_]
    surface_from_tip: Array

    def __len__(self) -> int:
        return len(self.stamps)


def row_step(log: NozzleLog) -> float:
    """How long a row lasts, s; 0 where there are not two."""
    return float(np.median(np.diff(log.stamps))) if len(log) > 1 else 0.0


def joined(logs: Sequence[NozzleLog]) -> NozzleLog:
    """One log of several that follow each other."""
    columns = (np.concatenate([getattr(log, f.name) for log in logs]) for f in fields(NozzleLog))
    return NozzleLog(*columns)
