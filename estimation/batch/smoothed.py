"""What smoothing gives: every pose with its covariance, and the surface at any time between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.batch.priors import (
    STATE_DOF,
    States,
    in_tangent_space,
    inverse_right_jacobian,
    jerk_covariance,
    right_jacobian,
    small_adjoint,
    transition,
)
from estimation.errors import InputError
from estimation.pose import Trajectory
from estimation.rig import Rig
from estimation.se3 import Array, Index
from estimation.surface_map import SurfaceMap

TIMES_PER_CHUNK = 4096  # interpolated at once


@dataclass(frozen=True, slots=True, eq=False)
class Instants:
    """The surface at M times."""

    stamps: Array  # (M,) s
    base_from_surface: Array  # (M, 4, 4) mm
    covariance: Array  # (M, 6, 6) of its right perturbation
    twist: Array  # (M, 6) rad/s and mm/s
    twist_covariance: Array  # (M, 6, 6)


@dataclass(frozen=True, slots=True, eq=False)
class FitStatistics:
    """How the tracks agree with the result."""

    used: Index  # (K, C) tracks that agree
    seen: Index  # (K, C) all tracks
    rms: Array  # (K, C) px of those that agree, nan without any
    unit: Array  # (C,) size of the residuals in parts of what is claimed of them
    jitter: float  # s, of a camera's delay in one frame set
    unrest: float  # px, of an image's shift in one frame set
    cost: float  # half the squared sigmas of all, robust
    passes: int  # over all frame sets


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A whole recording's best estimate: K states, L landmarks, C cameras."""

    stamps: Array  # (K,) s
    states: States  # poses base_from_surface, twists and accelerations
    own: Array  # (K, 18, 18) covariance of them by the tracks' noise
    next: Array  # (K - 1, 18, 18) likewise of each with the one after
    share: Array  # (K, 18, 18) covariance by the doubt about landmarks and cameras
    psd: Array  # (K - 1, 6) density of the jerk
    map: SurfaceMap  # in the surface frame
    tracks: Index  # (L,) the id that each landmark bears among the observations
    rig: Rig  # the cameras as corrected, clock offsets included
    calibrated: Rig  # as given
    offsets: Array  # (C,) s, how much later than stamped each camera exposes, beside the mean of all
    offset_covariance: Array  # (C, C) s^2
    fitted: FitStatistics

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def covariance(self) -> Array:
        """(K, 18, 18) of the states."""
        return self.own + self.share

    @property
    def offset_sigma(self) -> Array:
        """(C,) s, one standard deviation of each offset."""
        return np.asarray(np.sqrt(np.diag(self.offset_covariance)))

    @property
    def trajectory(self) -> Trajectory:
        """The poses at the stamps."""
        return Trajectory(self.stamps, self.states.poses, exact=False)

    @property
    def instants(self) -> Instants:
        """The surface at the stamps."""
        pose, twist = slice(0, 6), slice(6, 12)
        covariances = (self.own[:, part, part] + self.share[:, part, part] for part in (pose, twist))
        by_pose, by_twist = covariances
        return Instants(self.stamps, self.states.poses, by_pose, self.states.twists, by_twist)

    def at(self, times: Array) -> Instants:
        """The surface at times (M,), s, within the recording, by the continuous-time prior (Barfoot 2017, 11.3).

        Between two states the process is Gaussian given both, so pose, twist and their covariances follow from theirs;
        what landmarks and cameras add changes slowly and in a straight line.
        """
        times = np.asarray(times, float)
        if len(times) and not (self.stamps[0] <= times.min() and times.max() <= self.stamps[-1]):
            span = f"{self.stamps[0]} .. {self.stamps[-1]} s, the recording's own"
            raise InputError("times", "s", f"{times.min()} .. {times.max()}", span)
        parts = [self._between(times[i : i + TIMES_PER_CHUNK]) for i in range(0, len(times), TIMES_PER_CHUNK)]
        names = ("base_from_surface", "covariance", "twist", "twist_covariance")
        return Instants(times, *(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def _between(self, times: Array) -> Instants:
        k = np.clip(np.searchsorted(self.stamps, times, side="right") - 1, 0, len(self) - 2)
        by_before, by_after, left = _weights(times - self.stamps[k], self.stamps[k + 1] - self.stamps[k])
        before, after = self.states[k], self.states[k + 1]
        there, moved = in_tangent_space(before, after)
        here = np.concatenate([np.zeros((len(k), 6)), before.twists, before.accelerations], axis=-1)
        early, late = (np.kron(weights, np.eye(6)) for weights in (by_before, by_after))
        on_the_way = (early @ here[..., None] + late @ there[..., None])[..., 0]
        late = late @ _carried(moved)
        mixed = early @ self.next[k] @ np.swapaxes(late, 1, 2)
        spread = early @ self.own[k] @ np.swapaxes(early, 1, 2) + mixed + np.swapaxes(mixed, 1, 2)
        spread = spread + late @ self.own[k + 1] @ np.swapaxes(late, 1, 2)
        axes = np.einsum("mij,ma,ab->miajb", left, self.psd[k], np.eye(6)).reshape(-1, STATE_DOF, STATE_DOF)
        bend = right_jacobian(on_the_way[:, :6])
        turned = np.swapaxes(bend, 1, 2)
        part = ((times - self.stamps[k]) / (self.stamps[k + 1] - self.stamps[k]))[:, None, None]
        share = (1 - part) * self.share[k] + part * self.share[k + 1]
        spread = spread + axes
        return Instants(
            times,
            before.poses @ se3.exp(on_the_way[:, :6]),
            bend @ spread[:, :6, :6] @ turned + share[:, :6, :6],
            (bend @ on_the_way[:, 6:12, None])[..., 0],
            bend @ spread[:, 6:12, 6:12] @ turned + share[:, 6:12, 6:12],
        )


def _weights(passed: Array, whole: Array) -> tuple[Array, Array, Array]:
    """What the states before and after count for, (M, 3, 3) each, `passed` s of `whole` s; what is left to chance."""
    rest = np.swapaxes(transition(whole - passed), 1, 2)
    after = jerk_covariance(passed) @ rest @ np.linalg.inv(jerk_covariance(whole))
    before = transition(passed) - after @ transition(whole)
    return before, after, jerk_covariance(passed) - after @ np.swapaxes(rest, 1, 2) @ jerk_covariance(passed)


def _carried(moved: Array) -> Array:
    """How the later state's own errors show in the earlier one's tangent space, (M, 18, 18)."""
    out = np.zeros((len(moved), STATE_DOF, STATE_DOF))
    out[:, :6, :6] = inverse_right_jacobian(moved)
    out[:, 6:12, 6:12] = out[:, 12:, 12:] = np.eye(6) + small_adjoint(moved) / 2
    return out
