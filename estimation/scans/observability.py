"""What points on a surface determine of a pose, and along which slides and turns nothing changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.scans.scan import ScanIndex
from estimation.se3 import Array

FREE_STD = 0.3  # mm: a direction known no better is called free; three times the error that is wanted
FREE_SLOPE = 0.012  # mm of distance per mm of motion (0.7 degrees): below, errors of the scan's own shape decide
SLIDE_TURN_SHARE = 0.2  # of turning, below which a motion is called a slide


@dataclass(frozen=True, slots=True, eq=False)
class Observability:
    """Which motions are determined and which are free."""

    directions: Array  # (K, 6) free right perturbations, rad and mm, that move the points by about 1 mm
    names: tuple[str, ...]  # one each
    covariance: Array  # (6, 6), as wide as the scan along them
    weakest: float  # mm, one standard deviation of the worst direction that is determined


def observability_of(points: Array, normals: Array, sigma: float, index: ScanIndex) -> Observability:
    """What point-to-plane distances, `sigma` mm each, at points (N, 3) with normals (N, 3), surface frame, determine.

    Turns are counted about the points' centre and in mm at their rms radius, so that the six directions compare.
    """
    size = float(np.ptp(index.samples, axis=0).max())
    if not len(points):
        return Observability(np.eye(6), ("everything",), np.diag([np.pi**2] * 3 + [size**2] * 3), np.inf)
    centre, radius = _middle(points)
    slope, vectors = _slopes(points, normals)
    std = sigma / np.maximum(slope * np.sqrt(len(points)), 1e-12)
    free = (slope < FREE_SLOPE) | (std > FREE_STD)
    perturbation = _perturbation(centre, radius)
    spread = perturbation @ vectors @ np.diag(np.where(free, size, np.minimum(std, size)))
    motions = _slides_and_turns(vectors[:, free].T)
    names = tuple(_name(m, centre, radius) for m in motions)
    weakest = float(std[~free].max(initial=0.0))
    return Observability(motions @ perturbation.T, names, spread @ spread.T, weakest)


def without_free(points: Array, normals: Array, step: Array) -> Array:
    """A right perturbation (6,) without motions that hardly change the distances at points (N, 3), normals (N, 3).

    Both in the surface frame.
    """
    slope, vectors = _slopes(points, normals)
    held = vectors[:, slope >= FREE_SLOPE]
    perturbation = _perturbation(*_middle(points))
    return np.asarray(perturbation @ held @ held.T @ np.linalg.solve(perturbation, step))


def _middle(points: Array) -> tuple[Array, float]:
    centre = points.mean(0)
    return centre, max(float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1)))), 1e-6)


def _slopes(points: Array, normals: Array) -> tuple[Array, Array]:
    """Change of distance per mm of motion (6,), least first, along six motions (6, 6), in columns."""
    centre, radius = _middle(points)
    jacobian = np.concatenate([np.cross(points - centre, normals) / radius, normals], axis=1)
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian / len(points))
    return np.sqrt(np.maximum(values, 0)), vectors


def _perturbation(centre: Array, radius: float) -> Array:
    """Right perturbation, rad and mm, of a motion whose turns count about `centre` in mm at `radius`: (6, 6)."""
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = np.eye(3) / radius, np.eye(3)
    out[3:, :3] = se3.hat(centre) / radius
    return out


def _slides_and_turns(motions: Array) -> Array:
    """An orthonormal basis (K, 6) of the same motions, pure slides first as far as there are any."""
    if not len(motions):
        return motions
    mix, _, _ = np.linalg.svd(motions[:, :3])  # (K, K); columns by how much they turn, most first
    return np.asarray((mix.T @ motions)[::-1])


def _name(motion: Array, centre: Array, radius: float) -> str:
    turn, move = motion[:3] / radius, motion[3:]
    if np.linalg.norm(motion[:3]) < SLIDE_TURN_SHARE:
        return f"slide along {_vector(move / np.linalg.norm(move), 2)}"
    axis = turn / np.linalg.norm(turn)
    through = centre + np.cross(turn, move) / (turn @ turn)
    return f"turn about {_vector(axis, 2)} through {_vector(through, 1)} mm"


def _vector(v: Array, digits: int) -> str:
    v = v * (1 if v[np.argmax(np.abs(v))] > 0 or digits == 1 else -1)
    return "(" + " ".join(f"{x + 0.0:.{digits}f}" for x in np.round(v, digits)) + ")"
