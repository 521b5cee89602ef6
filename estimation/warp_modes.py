"""The shapes that a deformation can take: smooth fields about a dozen control points, none of them a rigid motion.

A Gaussian process with a bell as covariance, known at the control points, spans the smooth fields; those that move or
turn the landmarks as a whole are taken out, and of the rest the strongest modes are kept, orthonormal over the
landmarks: the length of a mode vector is the root mean square displacement in mm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.warp import Warp, bells

CONTROL = 12  # points
MODES = 24  # of 3 * CONTROL - 6: with 15 the error left on the tissue was twice as large, 30 gained nothing
REACH = 1.5  # distances of neighbouring control points: bells that overlap this far add up to smooth fields
WELL_KNOWN = 0.1  # mm: better known landmarks all count alike
JITTER = 1e-6  # of a bell's height: keeps the covariance of near control points invertible


@dataclass(frozen=True, slots=True, eq=False)
class WarpModes:
    """control: (K, 3) mm, reach: mm, as in Warp. fields: (3K, M), coefficients of each mode.

    share: (M,) of the variance of a typical smooth field, sum 1. landmarks: (N, 3, M), displacement of each landmark by
    each mode. weights: (N,), how much each landmark counts, sum 1.
    """

    control: Array
    reach: float
    fields: Array
    share: Array
    landmarks: Array
    weights: Array

    def modes_of(self, moved: Array) -> Array:
        """The modes (M,) mm in displacements (N, 3) mm of the first N landmarks, which hold all that count."""
        count = len(moved)
        return np.asarray(np.einsum("nim,n,ni->m", self.landmarks[:count], self.weights[:count], moved))

    def extended(self, points: Array) -> WarpModes:
        """The same modes with further landmarks at `points` (N, 3): they are moved by them, but do not count."""
        further = _displacements(points, self.control, self.reach, self.fields)
        weights = np.concatenate([self.weights, np.zeros(len(points))])
        return replace(self, landmarks=np.concatenate([self.landmarks, further]), weights=weights)

    def warp(self, modes: Array, covariance: Array, liveliness: float) -> Warp:
        """The warp of a mode vector (M,) mm with covariance (M, M), which wanders by `liveliness`, mm^2/s in all."""
        size = float(np.linalg.norm(modes))
        along = modes / size if size else np.zeros(len(modes))
        sigma = float(np.sqrt(max(along @ covariance @ along if size else np.linalg.eigvalsh(covariance)[-1], 0.0)))
        coefficients = (self.fields @ modes).reshape(-1, 3)
        spread = self.fields @ covariance @ self.fields.T
        growth = liveliness * (self.fields * self.share) @ self.fields.T
        return Warp(self.control, coefficients, spread, growth, self.reach, size, sigma)


def modes_from_map(surface_map: SurfaceMap) -> WarpModes:
    """The modes of the surface that a map of twelve landmarks or more shows."""
    points = surface_map.points
    known = np.diag(surface_map.covariance).reshape(-1, 3).mean(1)
    weights = 1 / np.maximum(known, WELL_KNOWN**2)
    weights = weights / weights.sum()
    control = points[_spread_out(points, weights, CONTROL)]
    apart = np.linalg.norm(control[:, None] - control, axis=-1) + np.diag(np.full(len(control), np.inf))
    reach = REACH * float(apart.min(1).mean())
    own = bells(control, control, reach) + JITTER * np.eye(len(control))
    whiten = np.kron(np.linalg.inv(np.linalg.cholesky(own)).T, np.eye(3))  # coefficients of unit variance fields
    field = np.kron(bells(points, control, reach), np.eye(3)) @ whiten  # (3N, 3K)
    root = np.sqrt(np.repeat(weights, 3))[:, None]
    lever = np.concatenate([-se3.hat(points - weights @ points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], -1)
    rigid = (lever.reshape(-1, 6) * root).T @ (field * root)  # (6, 3K)
    free = np.linalg.svd(rigid)[2][6:].T  # (3K, 3K - 6)
    _, size, modes = np.linalg.svd(field * root @ free, full_matrices=False)
    fields = whiten @ free @ (modes[:MODES] / size[:MODES, None]).T
    landmarks = _displacements(points, control, reach, fields)
    share = size[:MODES] ** 2
    return WarpModes(control, reach, fields, share / share.sum(), landmarks, weights)


def _displacements(points: Array, control: Array, reach: float, fields: Array) -> Array:
    """How far (N, 3, M) mm each mode, coefficients (3K, M), moves points (N, 3)."""
    return np.asarray((np.kron(bells(points, control, reach), np.eye(3)) @ fields).reshape(len(points), 3, -1))


def _spread_out(points: Array, weights: Array, count: int) -> list[int]:
    """Rows of `count` points, each the farthest from those before, among the half that is known best."""
    rows = np.flatnonzero(weights >= np.median(weights))
    centre = weights @ points
    chosen = [int(rows[np.argmin(np.linalg.norm(points[rows] - centre, axis=1))])]
    distance = np.full(len(rows), np.inf)
    while len(chosen) < min(count, len(rows)):
        distance = np.minimum(distance, np.linalg.norm(points[rows] - points[chosen[-1]], axis=1))
        chosen.append(int(rows[np.argmax(distance)]))
    return chosen
