"""Motions of the tissue: sums of parts, each (6,) of turn, rad, and shift, mm, at an instant."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from estimation import se3
from estimation.se3 import Array
from tests.campaigns.deceit.world import Motion

Part = Callable[[float], Array]


def moving(rest: Array, *parts: Part) -> Motion:
    """About a rest pose (4, 4): turned about its origin and shifted along the base's axes by the sum of the parts."""

    def pose(t: float) -> Array:
        change = sum((part(t) for part in parts), np.zeros(6))
        return np.asarray(se3.make(se3.exp_rotation(change[:3]) @ rest[:3, :3], rest[:3, 3] + change[3:]))

    return pose


def breathing(rng: np.random.Generator, amplitude: float = 4.0, degrees: float | None = None) -> Part:
    """12 to 20 a minute; amplitude: mm from rest to the height of a breath."""
    rate, phase = rng.uniform(0.2, 0.333), rng.uniform(0, 2 * math.pi)
    way = np.r_[rng.normal(0, 1, 2), 0, rng.uniform(-0.4, 0.4, 2), 1.0]
    way[:3] *= math.radians(rng.uniform(1, 3) if degrees is None else degrees) / np.linalg.norm(way[:3])
    way[3:] *= amplitude / np.linalg.norm(way[3:])
    return lambda t: way * (0.5 - 0.5 * math.cos(2 * math.pi * rate * t + phase))


def sway(
    rng: np.random.Generator, amplitude: float, rate: float, start: float = -math.inf, degrees: float = 1.0
) -> Part:
    """To and fro in the table's plane. rate: Hz; from `start`, s, on."""
    angle = rng.uniform(0, 2 * math.pi)
    way = np.r_[0, 0, math.radians(degrees), amplitude * math.cos(angle), amplitude * math.sin(angle), 0]
    return lambda t: way * math.sin(2 * math.pi * rate * (t - max(start, 0.0))) * (t > start)


def jump(at: float, change: Sequence[float]) -> Part:
    """Elsewhere from an instant on. change: (6,)."""
    there = np.array(change, float)
    return lambda t: there * (t > at)


def glide(start: float, end: float, change: Sequence[float]) -> Part:
    """Smoothly elsewhere between two instants, s. change: (6,)."""
    there = np.array(change, float)
    return lambda t: there * smooth_step((t - start) / (end - start))


def smooth_step(u: float) -> float:
    """From 0 at 0 to 1 at 1, with no jerk that stands out."""
    u = min(max(u, 0.0), 1.0)
    return u * u * (3 - 2 * u)


def cough(rng: np.random.Generator, start: float, amplitude: float, quarter: float) -> Part:
    """Oscillations that die away. quarter: s, until the first height of `amplitude`, mm."""
    angle = rng.uniform(0, 2 * math.pi)
    way = np.r_[rng.normal(0, 0.01, 3), math.cos(angle), math.sin(angle), 0.3]
    way[3:] *= amplitude / np.linalg.norm(way[3:])

    def at(t: float) -> Array:
        since = max(t - start, 0.0)
        return np.asarray(way * math.exp(-since / (8 * quarter)) * math.sin(0.5 * math.pi * since / quarter))

    return at


def steps(stamps: Sequence[float], changes: Array) -> Part:
    """Another place from each stamp on. changes: (N, 6); before the first stamp nothing."""
    edges = np.array(stamps)

    def at(t: float) -> Array:
        k = int(np.searchsorted(edges, t)) - 1
        return np.zeros(6) if k < 0 else np.asarray(changes[k])

    return at
