"""A recorded motion of the surface: what a session knows of the truth, and what a run wrote."""

from __future__ import annotations

from dataclasses import dataclass

from estimation.se3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time. stamps: (N,) s, strictly increasing. base_from_surface: (N, 4, 4) mm.

    exact: True for a simulator's or an instrument's truth (`truth.tum`), False for a measured reference
    (`reference.tum`), whose own error the report must not hold against the tracker.
    """

    stamps: Array
    base_from_surface: Array
    exact: bool

    def __len__(self) -> int:
        return len(self.stamps)
