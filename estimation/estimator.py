"""From observations to surface poses: robust fit to the map, honest covariance, sliding window, state.

The covariance of one fit has three parts: the tracks' noise, the map's joint error, and the cameras' capture instants.
The last is a common shift of all tracks of one camera along their image velocity, so it does not average out over
tracks; its size (`skew`) is learned from how far the cameras disagree while the surface moves.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.camera_health import CameraHealth, HealthSettings
from estimation.motion_detector import MotionDetector
from estimation.observations import Observations
from estimation.odd_camera import disorder, odd_ones, solve_with, standing_off
from estimation.pose import SurfacePose, TrackState
from estimation.pose_solver import PoseFit, project
from estimation.predictor import Predictor
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.smoother import Measured, Smoother
from estimation.state_machine import Measurement, StateMachine, StateSettings
from estimation.surface_map import SurfaceMap
from estimation.warp_filter import WarpFilter


@dataclass(frozen=True, slots=True)
class EstimatorSettings:
    """When a fit counts as a measurement. states: what it is then called. health: which cameras are trusted."""

    least_tracks: int = 10  # six unknowns need three tracks; ten leave room to see an outlier
    least_share: float = 0.4  # of the tracks found: with fewer in agreement the surface is not what is seen
    camera_tracks: int = 6  # fewer say nothing of that camera,
    camera_share: float = 0.1  # nor does a smaller part of the map's landmarks: so many agree by chance
    disorder: float = 3.0  # px, median, within a camera whatever its own pose: matches by chance, not a surface
    sigma_measured: float = 50.0  # mm: a pose less certain than this is no measurement
    floor_sigma: float = 0.1  # px: alignment claims less on clean images, interpolation and lens model do not allow it
    states: StateSettings = field(default_factory=StateSettings)
    health: HealthSettings = field(default_factory=HealthSettings)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fit to one frame set, judged.

    used: (C,) inliers per camera. reason: why it is no measurement, or ''. off: (C,) px by which each camera stands off
    the pose, nan where it does not see the surface; allowed: (C,) px, one sigma. odd: cameras that were left out.
    """

    stamp: float
    solution: PoseFit
    covariance: Array
    inlier: NDArray[np.bool_]
    used: NDArray[np.int64]
    reason: str
    off: Array
    allowed: Array
    odd: frozenset[int] = frozenset()

    @property
    def measured(self) -> bool:
        """Whether the fit may enter the window."""
        return not self.reason


class Skew:
    """How far apart the cameras' capture instants lie, s, learned from their disagreement along the motion.

    One delay per camera and frame set is solved for beside the pose, and taken apart into independent combinations: a
    delay d known to a variance e is a draw from sigma^2 + e, so sigma^2 is the mean of d^2 - e under the weights
    (sigma^2 + e)^-2. That is Fisher scoring; expectation maximisation was measured to need ten times the frames where
    single delays are uncertain. Lens and map shift whole cameras too: how much is learned across the motion, where a
    delay shows nothing. Frames in which nothing moves teach nothing of delays, and nothing is forgotten over them.
    """

    PRIOR, TRUST = 0.02, 3.0  # s, webcams stand 10 to 60 ms apart; delays that this belief is worth
    RECENT = 100  # delays, known better than sigma, over which the rest is forgotten
    CLEAREST = 2e-3  # s: what sigma is never known better than, so that a clock that begins to slip is noticed
    LEAST, MOST = 5e-4, 0.1  # s: no camera's stamp is better; a longer delay is a wrong pose
    SHARED, LEAST_SHARED = 0.2, 0.02  # px: what lens and map may shift all tracks of a camera by, at first and at least
    SEEN, SETTLE = 3.0, 30.0  # of such a shift the pose takes most up; frame sets until it is known

    def __init__(self) -> None:
        self._weight = self.TRUST  # of all delays taken, one known exactly against a sigma of PRIOR weighing 1
        self._shared = self.SHARED**2  # px^2
        self._sum = self.TRUST * (1 - (2 / self.TRUST) ** 0.5) * self.PRIOR**2  # weighted, of d^2 - e, s^2

    @property
    def sigma(self) -> float:
        """One standard deviation, s: the mean square and one standard error of it.

        A mean below zero says that delays are known better than is claimed, and by how much it can be trusted.
        """
        square = abs(self._sum / self._weight) + (2 / self._weight) ** 0.5 * self.PRIOR**2
        return float(np.sqrt(np.clip(square, self.LEAST**2, self.MOST**2)))

    def learn(self, camera: NDArray[np.int64], residual: Array, jacobian: Array, twist: Array, sigma: Array) -> None:
        """Take a joint fit's inliers: residuals (N, 2) px, jacobians (N, 2, 6), twist (6,) per s, sigma (N,) px."""
        cameras, index, count = np.unique(camera, return_inverse=True, return_counts=True)
        if len(cameras) < 2 or count.min() < 6:
            return
        velocity = jacobian @ twist
        self._settle(index, count, residual, velocity)
        weight = 1 / (sigma**2 + count[index] * max(self._shared, self.LEAST_SHARED**2))
        information = np.einsum("nki,n,nkj->ij", jacobian, weight, jacobian)
        pull, own, right = np.zeros((len(cameras), 6)), np.zeros(len(cameras)), np.zeros(len(cameras))
        np.add.at(pull, index, np.einsum("nki,n,nk->ni", jacobian, weight, velocity))
        np.add.at(own, index, weight * (velocity**2).sum(1))
        np.add.at(right, index, weight * (velocity * residual).sum(1))
        gradient = np.einsum("nki,n,nk->i", jacobian, weight, residual)
        solved = np.linalg.solve(information + 1e-9 * np.trace(information) * np.eye(6), np.c_[pull.T, gradient])
        told, apart = np.linalg.eigh(np.diag(own) - pull @ solved[:, :-1])
        right = apart.T @ (right - pull @ solved[:, -1])
        for known, product in zip(told, right, strict=True):
            if known > 1 / self.MOST**2:
                self._take(min(abs(product / known), self.MOST), 1 / known)

    def _settle(self, index: NDArray[np.int64], count: NDArray[np.int64], residual: Array, velocity: Array) -> None:
        """Follow the shift of whole cameras by its part across the motion."""
        shift, moved = np.zeros((len(count), 2)), np.zeros((len(count), 2))
        np.add.at(shift, index, residual / count[index, None])
        np.add.at(moved, index, velocity)
        across = (shift[:, 0] * moved[:, 1] - shift[:, 1] * moved[:, 0]) / np.maximum(np.hypot(*moved.T), 1e-12)
        self._shared += (self.SEEN * float((across**2).mean()) - self._shared) / self.SETTLE

    def _take(self, delay: float, variance: float) -> None:
        """One delay, s, known to a variance, s^2."""
        square = self.sigma**2
        share = (self.PRIOR**2 / (square + variance)) ** 2
        most = 2 * (self.PRIOR / self.CLEAREST) ** 4
        keep = min(1 - (square / (square + variance)) ** 2 / self.RECENT, most / (self._weight + share))
        self._weight = keep * self._weight + share
        self._sum = keep * self._sum + share * (delay**2 - variance)


class Estimator:
    """Owns the map, the window and the state of one surface."""

    def __init__(self, rig: Rig, settings: EstimatorSettings | None = None) -> None:
        self.rig = rig
        self.settings = settings or EstimatorSettings()
        self.map: SurfaceMap | None = None
        self.skew = Skew()
        self.health = CameraHealth([camera.name for camera in rig.cameras], self.settings.health)
        self._states = StateMachine(self.settings.states)
        self._smoother = Smoother()
        self._detector = MotionDetector(np.zeros(3))
        self._warp: WarpFilter | None = None
        self._predictor = Predictor()
        self._pose: SurfacePose | None = None
        self._measured: SurfacePose | None = None  # the last one that was
        self._caveat = ""
        self._view = 0  # landmarks of the first view: what is added later is not all seen at once

    @property
    def pose(self) -> SurfacePose | None:
        """The last pose given, or None before there is a map."""
        return self._pose

    def predict(self, stamp: float) -> Array:
        """Where the surface is expected at `stamp`: (4, 4). Only after the first map."""
        assert self._pose is not None
        return self._pose.predict(stamp).base_from_surface

    def sigma(self) -> float:
        """Standard deviation, mm, of the last pose's position."""
        return np.inf if self._pose is None else _position_sigma(self._pose.covariance)

    def fit(self, observations: Observations, start: Array, scales: tuple[float, ...] = (4.0, 1.0)) -> Fit:
        """Fit the pose to observations of the map's landmarks, from a rough pose `start` (4, 4); nothing is changed.

        observations.track counts rows of the map.
        """
        assert self.map is not None
        count, settings = len(self.rig), self.settings
        used = np.zeros(count, np.int64)
        off = np.full(count, np.nan)
        if len(observations) < settings.least_tracks:
            nothing = PoseFit(start, np.zeros((6, 6)), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 6)), 1.0)
            reason = f"{len(observations)} tracks found, {settings.least_tracks} needed"
            none, odd = np.zeros(len(observations), bool), self.health.left_out
            return Fit(observations.stamp, nothing, np.full((6, 6), np.inf), none, used, reason, off, off, odd)
        warped = self.map.points if self._warp is None else self._warp.points(self.map)
        points = warped[observations.track]
        smear = self._smear(observations, points, start)
        sigma = np.hypot(np.maximum(observations.sigma, settings.floor_sigma), smear)
        allowed = self.health.allowed(np.full(count, smear))
        solution, odd = self._solve(observations, points, sigma, start, scales, allowed)
        inlier = solution.weights > 0.2
        used = np.bincount(observations.camera[inlier], minlength=count)
        covariance = self._covariance(observations, solution, sigma)
        among = disorder(observations, solution, inlier)
        found = int((~np.isin(observations.camera, list(odd))).sum())
        reason = self._judge(found, used, covariance, among)
        off = standing_off(observations, solution, count, self._camera_least())
        return Fit(observations.stamp, solution, covariance, inlier, used, reason, off, allowed, odd)

    def _solve(
        self,
        observations: Observations,
        points: Array,
        sigma: Array,
        start: Array,
        scales: tuple[float, ...],
        allowed: Array,
    ) -> tuple[PoseFit, frozenset[int]]:
        """The pose of all cameras that agree with each other, and those that are left out of it."""
        odd, least = self.health.left_out, self._camera_least()
        solution = solve_with(self.rig, observations, points, sigma, start, scales, odd)
        if self._pose is None or self._pose.state is TrackState.INITIALISING:  # a bent first map sets cameras apart
            return solution, odd
        most = self.settings.health.out * allowed
        off = standing_off(observations, solution, len(self.rig), least)
        if any(off[c] > most[c] for c in range(len(self.rig)) if c not in odd):
            expected = self._pose.predict(observations.stamp)
            found = odd_ones(self.rig, observations, points, sigma, odd, most, least, expected)
            if found is not None:
                return found[1], found[0]
        return solution, odd

    def _smear(self, observations: Observations, points: Array, start: Array) -> float:
        """How far, px, the surface moves between the cameras' instants: beside that, sharper tracks count no more."""
        if self._pose is None or not self._pose.twist.any():
            return 0.0
        velocity = project(self.rig, observations.camera, start, points)[2] @ self._pose.twist
        return self.skew.sigma * float(np.median(np.linalg.norm(velocity, axis=1)))

    def _judge(self, found: int, used: NDArray[np.int64], covariance: Array, among: float) -> str:
        s, agreed = self.settings, int(used.sum())
        if agreed < s.least_tracks:
            return f"{agreed} tracks agree, {s.least_tracks} needed"
        if agreed < s.least_share * found:
            return f"only {agreed} of {found} tracks agree"
        if used.max() < self._camera_least() or self.health.hidden(used):
            return f"no camera sees more than {used.max()} of {len(self.map or ())} landmarks"
        bent = (
            self._pose is not None and self._pose.state is TrackState.INITIALISING
        )  # first maps of a moving surface are
        if among > s.disorder * (3.0 if bent else 1.0):
            return f"the tracks of a camera disagree among themselves by {among:.1f} px"
        spread = _position_sigma(covariance)
        if not spread <= s.sigma_measured:
            return f"the pose is uncertain to {spread:.1f} mm"
        return ""

    def _covariance(self, observations: Observations, solution: PoseFit, sigma: Array) -> Array:
        assert self.map is not None
        information = solution.information + 1e-9 * np.eye(6) * np.trace(solution.information)
        noise = np.linalg.pinv(information, hermitian=True)
        weight = solution.weights / (sigma * solution.scale) ** 2
        weighted = solution.jacobians * weight[:, None, None]
        by_point = np.einsum("nki,nkj->nij", weighted, solution.jacobians[:, :, 3:])  # (N, 6, 3)
        spread = np.zeros((len(self.map), 6, 3))
        np.add.at(spread, observations.track, by_point)
        shift = spread.transpose(1, 0, 2).reshape(6, -1)
        total = noise + noise @ (shift @ self.map.covariance @ shift.T) @ noise
        twist = self._pose.twist if self._pose is not None else np.zeros(6)
        velocity = solution.jacobians @ twist  # (N, 2)
        pull = np.zeros((len(self.rig), 6))
        np.add.at(pull, observations.camera, np.einsum("nki,nk->ni", weighted, velocity))
        late = noise @ pull.T
        total = total + self.skew.sigma**2 * late @ late.T
        if self._warp is not None:
            bent = self._warp.pull(observations.track, weighted, solution.jacobians[:, :, 3:])
            total = total + noise @ bent @ noise
        return np.asarray((total + total.T) / 2)

    def begin(self, stamp: float, base_from_surface: Array, surface_map: SurfaceMap, caveat: str = "") -> SurfacePose:
        """Take the first map, which defines the surface frame at `stamp`.

        caveat: what is not known of that frame's place on the tissue; as long as it stands no pose is TRACKING.
        """
        self.map, self._caveat, self._view = surface_map, caveat, len(surface_map)
        self._smoother.reset()
        self._detector, self._warp = MotionDetector(surface_map.points.mean(0)), WarpFilter(surface_map)
        self.health.begin()
        self._predictor = Predictor(surface_map.points)
        covariance = np.diag([1e-4**2] * 3 + [1e-3**2] * 3)  # exact by definition: the frame is what is seen here
        return self._enter(stamp, base_from_surface, covariance, *self._states.begin(stamp))

    def carriers(self, fit: Fit) -> NDArray[np.int64]:
        """The cameras that carry a fit, by number."""
        return np.nonzero(fit.used >= self._camera_least())[0] if fit.measured else np.zeros(0, np.int64)

    def _camera_least(self) -> float:
        assert self.map is not None
        return max(self.settings.camera_tracks, self.settings.camera_share * self._view)

    def moving(self, twist: Array) -> None:
        """What is known of the velocity (6,) before the window can tell: the first pose's covariance needs it."""
        assert self._pose is not None
        self._pose = replace(self._pose, twist=twist)

    def wait(self, stamp: float, reason: str) -> SurfacePose:
        """The first map is not confirmed at `stamp`: the pose stands still and counts for nothing."""
        assert self._pose is not None
        self._pose = replace(self._pose, stamp=stamp, reason=reason)
        return self._pose

    def accept(self, fit: Fit, observations: Observations) -> SurfacePose:
        """Take a measured fit into the window and give the pose."""
        assert fit.measured
        if self._pose is not None:
            moved = se3.log(se3.inverse(self._pose.base_from_surface) @ fit.solution.base_from_surface)
            twist, keep = moved / (fit.stamp - self._pose.stamp), fit.inlier
            sigma = np.maximum(observations.sigma, self.settings.floor_sigma)
            self.skew.learn(
                observations.camera[keep],
                fit.solution.residuals[keep],
                fit.solution.jacobians[keep],
                twist,
                sigma[keep],
            )
            if self._warp is not None:
                self._warp.learn(observations, fit.solution, sigma, twist, self.skew.sigma)
        noise = np.asarray(np.linalg.pinv(fit.solution.information, hermitian=True))  # map and clocks: the same at rest
        self._detector(fit.stamp, fit.solution.base_from_surface, noise)
        self._heed(fit)
        seen = Measurement(
            tuple(self.rig.cameras[c].name for c in self.carriers(fit)),
            int(fit.used.sum()),
            _position_sigma(fit.covariance),
            self.health.trouble(fit.stamp),
            self._caveat,
            0.0 if self._warp is None or self._warp.warp is None else self._warp.warp.deformation,
        )
        state, reason = self._states.measured(fit.stamp, seen)
        return self._enter(fit.stamp, fit.solution.base_from_surface, fit.covariance, state, reason)

    def _heed(self, fit: Fit) -> None:
        used = fit.used if fit.measured else np.zeros_like(fit.used)
        self.health.update(fit.stamp, used, self._camera_least(), fit.off, fit.allowed, fit.odd)

    def _enter(self, stamp: float, pose: Array, covariance: Array, state: TrackState, reason: str) -> SurfacePose:
        window = self._smoother.add(Measured(stamp, pose, covariance))
        entered = SurfacePose(
            stamp,
            window.pose,
            window.covariance,
            window.twist,
            state,
            window.twist_covariance,
            window.acceleration_psd,
            reason,
            self._detector.motion,
            None if self._warp is None else self._warp.warp,
        )
        self._pose = self._measured = replace(entered, forecast=self._predictor.add(entered))
        return self._pose

    def coast(self, fit: Fit) -> SurfacePose:
        """No measurement at `fit.stamp`: predict from the last one, and say for how long already and why."""
        assert self._measured is not None
        self._heed(fit)
        trouble = self.health.trouble(fit.stamp, at_once=True)
        state, reason = self._states.missed(fit.stamp, f"{fit.reason}; {trouble}" if trouble else fit.reason)
        predicted, lost = self._measured.predict(fit.stamp), state is TrackState.LOST
        if lost:  # a velocity that old would carry the pose away
            stays = self._measured.predict(self._measured.stamp + self.settings.states.coast)
            predicted = replace(predicted, base_from_surface=stays.base_from_surface, twist=np.zeros(6), forecast=None)
        self._pose = replace(predicted, state=state, reason=reason)
        return self._pose

    def replace_map(self, surface_map: SurfaceMap, crooked: bool = False) -> None:
        """Take a refined or longer map of the same surface frame; rows keep their meaning.

        crooked: whether the one before was a first map, whose own error looked like a deformation.
        """
        assert self.map is not None and len(surface_map) >= len(self.map)
        if crooked:
            self._warp = WarpFilter(surface_map)
        elif self._warp is not None:
            self._warp.replace_map(surface_map)
        self.map = surface_map


def _position_sigma(covariance: Array) -> float:
    block = covariance[3:, 3:]
    return float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0))) if np.isfinite(block).all() else float("inf")


def identity_pose(stamp: float, reason: str) -> SurfacePose:
    """The pose before there is any: INITIALISING, at the base's origin, without any certainty."""
    return SurfacePose(
        stamp, np.eye(4), np.diag([np.pi**2] * 3 + [1e6] * 3), np.zeros(6), TrackState.INITIALISING, reason=reason
    )
