"""Where the board was between the frame sets: a smooth motion through their poses, and its derivatives.

About each instant the motion is the exponential of the polynomial through the logarithms of up to four neighbours, two
on either side where there are two (Lagrange's, fourth order): nothing to be tuned, and a pose moves with its
neighbours' alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.se3 import Array

REACH = 0.5  # s to the next instant, beyond which a hand has done something else; the board is then taken to rest
SIDES = 2  # neighbours on either side
WIDTH = 2 * SIDES


@dataclass(frozen=True, slots=True, eq=False)
class Stencils:
    """Whom each instant's motion goes through.

    neighbours: (S, WIDTH) instants, its own number where there is none. times: (S, WIDTH) s after the own, or nan.
    """

    neighbours: NDArray[np.int64]
    times: Array

    @property
    def moving(self) -> NDArray[np.bool_]:
        """(S,) which instants have a neighbour at all."""
        return np.asarray(np.isfinite(self.times).any(1))


def stencils(stamps: Array) -> Stencils:
    """The neighbours of instants with the rising stamps (S,), s."""
    count = len(stamps)
    neighbours, times = np.repeat(np.arange(count)[:, None], WIDTH, 1), np.full((count, WIDTH), np.nan)
    for run in np.split(np.arange(count), np.flatnonzero(np.diff(stamps) > REACH) + 1):
        for k, i in enumerate(run):
            first = min(max(k - SIDES, 0), max(len(run) - WIDTH - 1, 0))  # at a run's ends more of the other side
            others = np.delete(run[first : first + WIDTH + 1], k - first)
            neighbours[i, : len(others)], times[i, : len(others)] = others, stamps[others] - stamps[i]
    return Stencils(neighbours, times)


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """The board at each view's instant. pose: (V, 4, 4).

    Its right perturbation by the delay: by_delay (V, 6), per s; by those of the own pose and the neighbours: by_pose
    (V, 6, 6 + 6 WIDTH), the own first.
    """

    pose: Array
    by_delay: Array
    by_pose: Array


def carried(poses: Array, who: Stencils, instant: NDArray[np.int64], delay: Array) -> Carried:
    """Poses of views that were exposed `delay` (V,), s, after their instants (V,); poses: (S, 4, 4)."""
    own, others, times = poses[instant], poses[who.neighbours[instant]], who.times[instant]
    way = se3.log(se3.inverse(own)[:, None] @ others)  # (V, WIDTH, 6)
    weight, slope = _lagrange(times, delay)
    xi, rate = np.einsum("vk,vki->vi", weight, way), np.einsum("vk,vki->vi", slope, way)
    right = _right(xi)
    by_pose = np.empty((len(own), 6, 6 + 6 * WIDTH))
    there = weight[..., None, None] * _right_inverse(way)
    here = (weight[..., None, None] * _right_inverse(-way)).sum(1)
    step = se3.exp(xi)
    by_pose[:, :, :6] = se3.adjoint(se3.inverse(step)) - right @ here
    by_pose[:, :, 6:] = (right[:, None] @ there).transpose(0, 2, 1, 3).reshape(-1, 6, 6 * WIDTH)
    return Carried(own @ step, (right @ rate[..., None])[..., 0], by_pose)


def _lagrange(times: Array, at: Array) -> tuple[Array, Array]:
    """Weights (V, WIDTH) of the neighbours at `at` (V,), and their slopes; the own node, at 0, has nothing to add."""
    there = np.isfinite(times)
    t = np.where(there, times, 0.0)
    safe = np.where(there, times, 1.0)
    weight, slope = at[:, None] / safe, 1 / safe
    for m in range(WIDTH):
        other = np.arange(WIDTH) != m
        used = there[:, m : m + 1] & other
        gap = np.where(used, t - t[:, m : m + 1], 1.0)
        factor = np.where(used, (at[:, None] - t[:, m : m + 1]) / gap, 1.0)
        slope = slope * factor + np.where(used, weight / gap, 0.0)
        weight = weight * factor
    return np.where(there, weight, 0.0), np.where(there, slope, 0.0)


def _ad(xi: Array) -> Array:
    out = np.zeros((*xi.shape[:-1], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = se3.hat(xi[..., :3])
    out[..., 3:, :3] = se3.hat(xi[..., 3:])
    return out


def _right(xi: Array) -> Array:
    """Right Jacobian (..., 6, 6): exact to 1e-6 up to 0.3 rad, which no hand turns in a twentieth of a second."""
    ad = _ad(xi)
    two = ad @ ad
    return np.asarray(np.eye(6) - ad / 2 + two / 6 - two @ ad / 24 + two @ two / 120)


def _right_inverse(xi: Array) -> Array:
    """Inverse of the right Jacobian (..., 6, 6), by its series."""
    ad = _ad(xi)
    two = ad @ ad
    return np.asarray(np.eye(6) + ad / 2 + two / 12 - two @ two / 720)
