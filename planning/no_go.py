"""Volumes in the base frame where the nozzle's tip must not be: below the printing base, around the patient."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class NoGo:
    """One convex volume: what is inside all its half-spaces and its cylinder, if it has one. Its surface is outside.

    normals: (K, 3) unit vectors, outwards, and offsets: (K,) mm, with normals @ p < offsets inside. axis: (2, 3) mm,
    two points of the cylinder's axis; radius: mm, infinite without a cylinder.
    """

    name: str
    normals: Array
    offsets: Array
    axis: Array = field(default_factory=lambda: np.array([[0.0, 0, 0], [0, 0, 1]]))
    radius: float = np.inf

    def __post_init__(self) -> None:
        ways = self.normals, self.offsets, self.axis
        good = self.normals.ndim == 2 and self.normals.shape[1:] == (3,) and self.axis.shape == (2, 3)
        if not good or self.offsets.shape != self.normals.shape[:1] or not all(np.isfinite(w).all() for w in ways):
            raise InputError("no-go zone", self.name, self.normals.tolist(), "K normals and offsets, finite")
        if np.abs(np.linalg.norm(self.normals, axis=1) - 1).max(initial=0.0) > 1e-9 or not self.radius > 0:
            raise InputError("no-go zone", self.name, self.radius, "unit normals, and a radius > 0")
        if not len(self.offsets) or np.array_equal(*self.axis):
            raise InputError("no-go zone", self.name, self.axis.tolist(), "one half-space or more, and an axis")

    def depth(self, place: Array) -> float:
        """How far inside a place (3,) is, mm; not above 0 outside and on the surface."""
        depth = float((self.offsets - self.normals @ place).min())
        if np.isinf(self.radius):
            return depth
        start, along = self._axis()
        return min(depth, self.radius - float(np.linalg.norm(np.cross(place - start, along))))

    def met(self, start: Array, end: Array) -> float:
        """How far inside the straight way between two places (3,) goes, mm: at its end, or amidst what is inside."""
        if (depth := self.depth(end)) > 0:
            return depth
        low, high = 0.0, 1.0
        for gap, more in zip(self.offsets - self.normals @ start, self.normals @ (end - start), strict=True):
            if more == 0 and gap <= 0:
                return 0.0
            low, high = (max(low, gap / more), high) if more < 0 else (low, min(high, gap / more) if more else high)
        if np.isfinite(self.radius):
            low, high = _within(*self._flat(start, end), self.radius, low, high)
        return max(self.depth(start + (low + high) / 2 * (end - start)), 0.0) if low < high else 0.0

    def _axis(self) -> tuple[Array, Array]:
        along = self.axis[1] - self.axis[0]
        return self.axis[0], along / np.linalg.norm(along)

    def _flat(self, start: Array, end: Array) -> tuple[Array, Array]:
        """Two places as seen along the cylinder's axis, from it (3,)."""
        origin, along = self._axis()
        return np.cross(start - origin, along), np.cross(end - origin, along)


def half_space(name: str, normal: Array, place: Array) -> NoGo:
    """All behind a plane through `place` (3,) mm, on the side that `normal` (3,) points away from."""
    if not np.linalg.norm(normal) > 0:
        raise InputError("no-go zone", name, normal.tolist(), "a normal that is not zero")
    unit = normal / np.linalg.norm(normal)
    return NoGo(name, unit[None], np.array([unit @ place]))


def box(name: str, low: Array, high: Array) -> NoGo:
    """A box along the base frame between two corners (3,), mm."""
    if not (low < high).all():
        raise InputError("no-go zone", name, [low.tolist(), high.tolist()], "a low corner below a high one")
    return NoGo(name, np.concatenate([np.eye(3), -np.eye(3)]), np.concatenate([high, -low]))


def cylinder(name: str, start: Array, end: Array, radius: float) -> NoGo:
    """A cylinder between the middles (3,) of its ends, mm."""
    if not np.linalg.norm(end - start) > 0:
        raise InputError("no-go zone", name, [start.tolist(), end.tolist()], "two ends apart")
    along = (end - start) / np.linalg.norm(end - start)
    return NoGo(
        name, np.stack([-along, along]), np.array([-along @ start, along @ end]), np.stack([start, end]), radius
    )


def _within(start: Array, end: Array, radius: float, low: float, high: float) -> tuple[float, float]:
    """The shares from `low` to `high` of a straight way (3,) that are within `radius` of 0; empty: (1, 0)."""
    way = end - start
    a, b, c = float(way @ way), float(start @ way), float(start @ start) - radius**2
    if a == 0:
        return (low, high) if c < 0 else (1.0, 0.0)
    if (root := b * b - a * c) <= 0:
        return 1.0, 0.0
    return max(low, (-b - root**0.5) / a), min(high, (-b + root**0.5) / a)
