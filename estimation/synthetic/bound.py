"""The Cramer-Rao bound: how well any unbiased estimator can know the pose from the tracks that there are."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from estimation.observations import Observations
from estimation.online.pose_solver import project
from estimation.rig import Rig
from estimation.se3 import Array


def pose_information(rig: Rig, base_from_surface: Array, points: Array, seen: Observations) -> Array:
    """Fisher information (6, 6) of the right perturbation of the true pose (4, 4), rad and mm, in one frame set.

    rig: the true cameras. points: (N, 3) mm, the true landmarks; seen.track counts them. seen.sigma: px, white.
    """
    _, _, jacobian = project(rig, seen.camera, base_from_surface, points[seen.track])
    return np.asarray(np.einsum("nki,n,nkj->ij", jacobian, seen.sigma**-2.0, jacobian))


def pose_bound(information: Array) -> Array:
    """The least covariance (..., 6, 6) that an unbiased estimate from one frame set can have."""
    return np.asarray(np.linalg.inv(information))


def filtered_bound(informations: Iterable[Array], dt: float, acceleration_psd: Array) -> Array:
    """The least covariance (K, 6, 6) of the newest pose from all frame sets up to it, `dt` s apart.

    It holds for a motion that is white noise on acceleration of the spectral density acceleration_psd (6,), rad^2/s^3
    and mm^2/s^3 (Barfoot 2017, 11.1): the posterior bound of Tichavsky et al., IEEE TSP 46:1386 (1998), linear between
    frames. Smoother motions can be known better, livelier ones worse.
    """
    psd, one = np.diag(acceleration_psd), np.eye(6)
    transition = np.block([[one, dt * one], [np.zeros((6, 6)), one]])
    drive = np.block([[psd * dt**3 / 3, psd * dt**2 / 2], [psd * dt**2 / 2, psd * dt]])
    known = np.zeros((12, 12))
    bounds: list[Array] = []
    for information in informations:
        if known.any():
            known = np.linalg.inv(transition @ np.linalg.inv(known) @ transition.T + drive)
        known[:6, :6] += information
        if not bounds:
            known[6:, 6:] += 1e-9 * one  # the velocity is open at first, but not without end
        bounds.append(np.asarray(np.linalg.inv(known)[:6, :6]))
    return np.array(bounds)


def position_and_turn(covariance: Array) -> tuple[Array, Array]:
    """RMS of the position (...), mm, and of the turn (...), rad, that covariances (..., 6, 6) stand for."""
    spread = np.diagonal(covariance, axis1=-2, axis2=-1)
    return np.sqrt(spread[..., 3:].sum(-1)), np.sqrt(spread[..., :3].sum(-1))
