"""States and cameras of a recording, their priors, and the smoothed result, which gives the surface at any instant.

A state is a pose, its body twist and its acceleration: 18 numbers of right perturbations. Between two states stands a
Gaussian process whose third derivative is white noise, in the tangent space of each pose (Tang, Yoon and Barfoot, IEEE
RA-L 4:594, 2019; Barfoot 2017, 11.1 and 3.4). A chest is far smoother than white noise on acceleration, the only such
prior that GTSAM ships: at 30 Hz that averages a breathing axis over less than two frame sets, this one over five.

The cameras' clocks, places and lenses have their calibration as prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.pose import Trajectory
from estimation.rig import Rig
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import SurfaceMap

COMMON_CLOCK_SIGMA_S = 1e-6  # what all clocks have in common cannot be seen; their mean is the reference
LENS_DOF = 4  # fx fy cx cy
STATE_DOF = 18  # of a pose, its twist and its acceleration
TIMES_PER_CHUNK = 4096  # interpolated at once


@dataclass(frozen=True, slots=True)
class CalibrationPrior:
    """What the recording may correct of the cameras, one sigma each, 0 to keep it. Distortion is always kept."""

    clock: float = 0.02  # s, of a camera's instant from its stamp: webcams were seen 10 to 60 ms apart
    turn: float = 0.0  # rad, of a camera's place
    shift: float = 0.0  # mm, of a camera's place
    focal: float = 0.0  # px
    centre: float = 0.0  # px


REFINED_PRIOR = CalibrationPrior(turn=1e-3, shift=0.3, focal=1.5, centre=1.5)  # what a calibration with a board leaves


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedCameras:
    """C cameras as far as a recording corrects them."""

    base_from_camera: Array  # (C, 4, 4) mm
    matrices: Array  # (C, 3, 3) px
    offsets: Array  # (C,) s, later than stamped

    def __len__(self) -> int:
        return len(self.offsets)

    def moved(self, step: Array) -> CorrectedCameras:
        """The same after a step (11 C,): offsets, places, lenses."""
        n = len(self)
        lens = step[7 * n :].reshape(n, LENS_DOF)
        matrices = self.matrices.copy()
        matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]] += lens
        places = self.base_from_camera @ se3.exp(step[n : 7 * n].reshape(n, 6))
        return CorrectedCameras(places, matrices, self.offsets + step[:n])

    def since(self, before: CorrectedCameras) -> Array:
        """The step (11 C,) that made these of those `before`."""
        places = se3.log(se3.inverse(before.base_from_camera) @ self.base_from_camera)
        lens = (self.matrices - before.matrices)[:, [0, 1, 0, 1], [0, 1, 2, 2]]
        return np.concatenate([self.offsets - before.offsets, places.ravel(), lens.ravel()])

    def rig(self, rig: Rig) -> Rig:
        """The rig with these corrections."""
        parts = zip(rig.cameras, self.matrices, self.base_from_camera, (float(s) for s in self.offsets), strict=True)
        return Rig(
            tuple(replace(c, matrix=m, base_from_camera=p, clock_offset=c.clock_offset + s) for c, m, p, s in parts)
        )


def cameras_of(rig: Rig) -> CorrectedCameras:
    """The cameras as they were calibrated, each exposed when it is stamped."""
    places = np.stack([camera.base_from_camera for camera in rig.cameras])
    return CorrectedCameras(places, rig.matrices.copy(), np.zeros(len(rig)))


def correction_sigmas(prior: CalibrationPrior, cameras: int) -> Array:
    """(11 C,) standard deviations of `CorrectedCameras.moved`'s step, 0 for what is held."""
    place = [prior.turn] * 3 + [prior.shift] * 3
    lens = [prior.focal] * 2 + [prior.centre] * 2
    return np.array([prior.clock] * cameras + place * cameras + lens * cameras)


def prior_information(sigma: Array, seeing: Mask) -> Array:
    """(11 C, 11 C) information of that step about the calibration; of what is held, zero.

    seeing: (C,) cameras with tracks. The clocks of these are told by their mean: a blind one would take what they have
    in common, which nothing shows, with the other sign.
    """
    known = np.divide(1.0, sigma**2, out=np.zeros_like(sigma), where=sigma > 0)
    out, cameras = np.diag(known), len(seeing)
    common = np.where(sigma[0] > 0, 1 / (COMMON_CLOCK_SIGMA_S * max(int(seeing.sum()), 1)) ** 2, 0.0)
    out[:cameras, :cameras] += common * np.outer(seeing, seeing)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """K states."""

    poses: Array  # (K, 4, 4) base_from_surface
    twists: Array  # (K, 6) rad/s, mm/s
    accelerations: Array  # (K, 6) rad/s^2, mm/s^2

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, rows: slice | Index) -> States:
        return States(self.poses[rows], self.twists[rows], self.accelerations[rows])

    def moved(self, step: Array) -> States:
        """The same after a step (K, 18)."""
        return States(self.poses @ se3.exp(step[:, :6]), self.twists + step[:, 6:12], self.accelerations + step[:, 12:])


@dataclass(frozen=True, slots=True, eq=False)
class PriorFactors:
    """The prior between neighbours, linearised: off + before @ step[k] + after @ step[k + 1]."""

    off: Array  # (K - 1, 18)
    before: Array  # (K - 1, 18, 18)
    after: Array  # (K - 1, 18, 18)
    spread: Array  # (K - 1, 3, 3) its covariance, of each axis, per unit of density

    def information(self, psd: Array) -> Array:
        """Inverse covariances (K - 1, 18, 18) for densities (K - 1, 6), rad^2/s^5 and mm^2/s^5."""
        inverse = np.linalg.inv(self.spread)  # (K - 1, 3, 3)
        out = np.zeros((len(psd), 3, 6, 3, 6))
        each = np.arange(6)
        out[:, :, each, :, each] = inverse[None] / psd.T[:, :, None, None]  # axes first, by numpy's rule
        return out.reshape(-1, STATE_DOF, STATE_DOF)


def transition(seconds: Array) -> Array:
    """(..., 3, 3) of position, velocity and acceleration of an axis over seconds (...)."""
    t = np.asarray(seconds, float)
    out = np.zeros((*t.shape, 3, 3))
    out[...] = np.eye(3)
    out[..., 0, 1] = out[..., 1, 2] = t
    out[..., 0, 2] = t**2 / 2
    return out


def jerk_covariance(seconds: Array) -> Array:
    """Covariance (..., 3, 3) that a unit density of white jerk adds over seconds (...)."""
    t = np.asarray(seconds, float)
    out = np.zeros((*t.shape, 3, 3))
    out[..., 0, 0], out[..., 1, 1], out[..., 2, 2] = t**5 / 20, t**3 / 3, t
    out[..., 0, 1] = out[..., 1, 0] = t**4 / 8
    out[..., 0, 2] = out[..., 2, 0] = t**3 / 6
    out[..., 1, 2] = out[..., 2, 1] = t**2 / 2
    return out


def in_tangent_space(before: States, after: States) -> tuple[Array, Array]:
    """The later states (M, 18) in the tangent spaces of the earlier ones, and the moves (M, 6) between the poses."""
    moved = se3.log(se3.inverse(before.poses) @ after.poses)
    bent = np.eye(6) + se3.small_adjoint(moved) / 2
    velocity = (bent @ after.twists[..., None])[..., 0]
    acceleration = (bent @ after.accelerations[..., None])[..., 0]
    return np.concatenate([moved, velocity, acceleration], axis=-1), moved


def prior_factors(states: States, stamps: Array) -> PriorFactors:
    """The prior at `states`, with exact derivatives; stamps: (K,) s."""
    seconds, before, after = np.diff(stamps), states[:-1], states[1:]
    there, moved = in_tangent_space(before, after)
    here = np.concatenate([np.zeros_like(moved), before.twists, before.accelerations], axis=-1)
    forward = np.asarray(np.kron(transition(seconds), np.eye(6)), float)
    by_after, by_before = se3.inverse_right_jacobian(moved), -se3.inverse_right_jacobian(-moved)
    bent = np.eye(6) + se3.small_adjoint(moved) / 2
    later, earlier = np.zeros((len(moved), STATE_DOF, STATE_DOF)), -forward
    later[:, :6, :6], later[:, 6:12, 6:12], later[:, 12:, 12:] = by_after, bent, bent
    earlier[:, :6, :6] = by_before
    for rows, rate in ((slice(6, 12), after.twists), (slice(12, 18), after.accelerations)):
        turned = -se3.small_adjoint(rate) / 2  # of the move
        later[:, rows, :6], earlier[:, rows, :6] = turned @ by_after, turned @ by_before
    off = there - (forward @ here[..., None])[..., 0]
    return PriorFactors(np.asarray(off), earlier, later, jerk_covariance(seconds))


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
    offsets: Array  # (C,) s, how much later than stamped each camera exposes, beside the mean of those with tracks
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
        by_pose, by_twist = (self.own[:, part, part] + self.share[:, part, part] for part in (slice(6), slice(6, 12)))
        return Instants(self.stamps, self.states.poses, by_pose, self.states.twists, by_twist)

    def times(self, rate: float) -> Array:
        """Times (M,), s, 1 / rate apart from the first stamp on, all before the last one.

        Not `np.arange(first, last, step)`: its step is a difference of two large stamps, so that its last time may lie
        beyond the recording after a few minutes of uptime.
        """
        first, last = self.stamps[[0, -1]]
        times = first + np.arange(np.ceil((last - first) * rate) + 1) / rate
        return np.asarray(times[times < last])

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
        # how the later state's own errors show in the earlier one's tangent space, (M, 18, 18)
        carried = np.zeros((len(moved), STATE_DOF, STATE_DOF))
        carried[:, :6, :6] = se3.inverse_right_jacobian(moved)
        carried[:, 6:12, 6:12] = carried[:, 12:, 12:] = np.eye(6) + se3.small_adjoint(moved) / 2
        late = late @ carried
        mixed = early @ self.next[k] @ np.swapaxes(late, 1, 2)
        spread = early @ self.own[k] @ np.swapaxes(early, 1, 2) + mixed + np.swapaxes(mixed, 1, 2)
        spread = spread + late @ self.own[k + 1] @ np.swapaxes(late, 1, 2)
        axes = np.einsum("mij,ma,ab->miajb", left, self.psd[k], np.eye(6)).reshape(-1, STATE_DOF, STATE_DOF)
        bend = se3.right_jacobian(on_the_way[:, :6])
        turned = np.swapaxes(bend, 1, 2)
        part = ((times - self.stamps[k]) / (self.stamps[k + 1] - self.stamps[k]))[:, None, None]
        share, spread = (1 - part) * self.share[k] + part * self.share[k + 1], spread + axes
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
