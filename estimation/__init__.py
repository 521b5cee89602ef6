"""The centre: the vocabulary, SE(3), and the factor graph that follows the surface (floor 0).

Conventions, written once. Lengths mm, time s, angles rad, pixels px. A transform is a float64
(..., 4, 4) array and `a_from_b` carries coordinates in b to a, so neighbours match at the `@`.
Frames: `base` (fixed; the robot's once registered), `camera`, `surface`, `nozzle`. A tangent vector is
[rx ry rz tx ty tz] and perturbs on the right: `T @ exp(xi)`, which is GTSAM's own order and side.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimation.batch.smooth import smooth

__all__ = ["smooth"]


def __getattr__(name: str) -> Any:
    """`from estimation import smooth`: loaded when it is asked for, since planning needs nothing of it."""
    if name == "smooth":
        from estimation.batch.smooth import smooth

        return smooth
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
