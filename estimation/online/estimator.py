"""From observations to surface poses: robust fit to the map, sliding window, state, and reported covariance.

A fit's covariance has two parts. Errors that are new in every frame set (tracks, shifts of whole images) go into the
window and are averaged there. Errors that last (the map's joint error, the calibration's) are not averaged by anything
and are added to the window's marginal. Added whole are also the effect of late exposures on a moving surface, and the
error of the first pose that is given out, since the path is placed in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from estimation import se3
from estimation.forecast.predictor import Predictor
from estimation.observations import Observations
from estimation.online.camera_errors import CameraErrorHistory, CameraErrors
from estimation.online.camera_health import MAX_MOTION_SIGMAS, CameraHealth, FrameTracks, HealthSettings, motion_sigmas
from estimation.online.deformation import WarpFilter, warped_points
from estimation.online.fit import FrameFit, LandmarkUncertainty, MapError, failed_fit, fit_covariance
from estimation.online.local_motion import LocalMotion
from estimation.online.pose_solver import INLIER_WEIGHT, PoseFit, project
from estimation.online.reported_covariance import CalibrationError, ReportedCovariance, widened
from estimation.online.surface_state import Measurement, MotionDetector, PoseStateMachine, StateSettings
from estimation.online.window import MeasuredPose, Smoother
from estimation.pose import SurfacePose, TrackState, position_sigma
from estimation.rig import Rig
from estimation.runtime import median
from estimation.se3 import Array, Index
from estimation.surface_map import SurfaceMap

MIN_FORECAST_PSD = np.array([1e-4] * 3 + [1.0] * 3)  # rad^2/s^3, mm^2/s^3: what lies still may begin to breathe
MAX_LEARNING_SMEAR_MM = 0.1  # between the cameras' instants: beyond, a late camera cannot be told from a bent surface
MAX_MAP_SMEAR_MM = 0.5  # likewise: a map bent by more is no good for printing
ACCELERATION_PERSISTENCE_S = 0.2  # breathing accelerates alike for so long, which adds up to more than white noise does


@dataclass(frozen=True, slots=True)
class EstimatorSettings:
    """When a fit counts as a measurement."""

    least_tracks: int = 10  # six unknowns need three tracks; ten leave room to see an outlier
    least_share: float = 0.4  # of the tracks found: with fewer in agreement the surface is not what is seen
    camera_tracks: int = 6  # fewer say nothing of that camera,
    camera_share: float = 0.1  # nor does a smaller part of the map's landmarks: so many agree by chance
    disorder: float = 3.0  # px, median, within a camera whatever its own pose: matches by chance, not a surface
    sigma_measured: float = 50.0  # mm: a pose less certain than this is no measurement
    floor_sigma: float = 0.1  # px: alignment claims less on clean images, but interpolation and lens model err by it
    states: StateSettings = field(default_factory=StateSettings)  # what a measured pose is called
    health: HealthSettings = field(default_factory=HealthSettings)  # which cameras are trusted


@dataclass(frozen=True, slots=True, eq=False)
class _Unlearned:
    """An accepted fit of which the cameras' errors are still to be learned."""

    fit: FrameFit
    seen: Observations
    seconds: float  # since the fit before
    sound: bool


class Estimator:
    """Owns the map, the window and the state of one surface."""

    def __init__(self, rig: Rig, settings: EstimatorSettings | None = None) -> None:
        self.rig = rig
        self.settings = settings or EstimatorSettings()
        self.map: SurfaceMap | None = None
        self.cameras = CameraErrors(len(rig))
        self._earlier_cameras, self._map_held = CameraErrorHistory(self.cameras), False  # whether against deformation
        self.health = CameraHealth([camera.name for camera in rig.cameras], self.settings.health)
        self._states = PoseStateMachine(self.settings.states)
        self._smoother = Smoother()
        self._detector = MotionDetector(np.zeros(3))
        self._warp: WarpFilter | None = None
        self._local = LocalMotion()
        self._map_error: MapError | None = None
        self._reported, self._calibration = ReportedCovariance(len(rig)), CalibrationError()
        self._unlearned: _Unlearned | None = None
        self._predictor = Predictor()
        self._pose: SurfacePose | None = None  # with the covariance that decisions are made by
        self._given: SurfacePose | None = None  # with the reported covariance
        self._ahead: tuple[SurfacePose, SurfacePose] | None = None  # the pose, and as last predicted from it
        self._measured: SurfacePose | None = None  # the last one that was
        self._caveat = ""
        self._view = 0  # landmarks of the first view: what is added later is not all seen at once
        self._psd = np.zeros(6)  # of the acceleration from pose to pose
        self._accepted = 0  # poses measured since the first map
        self._first: Array | None = None  # (6, 6) covariance of the first pose given out, in which the path is placed

    @property
    def pose(self) -> SurfacePose | None:
        """The last pose given, or None before there is a map."""
        return self._given

    @property
    def confirmed(self) -> bool:
        """Whether a frame set after the one of the first map has been measured."""
        return self._accepted > 0

    @property
    def deforms(self) -> bool:
        """Whether the surface is seen to depart from the rigid."""
        return self._warp is not None and self._warp.liveliness > 0

    def too_fast_for_map(self, fit: FrameFit) -> bool:
        """Whether no pose is given out yet, and the surface moves too fast for its map to be trusted."""
        return self._first is None and self._smeared(fit) > MAX_MAP_SMEAR_MM

    def _smeared(self, fit: FrameFit) -> float:
        """How far, mm, the surface moves in the time by which a camera's exposure is unknown."""
        return float(np.linalg.norm(fit.twist[3:])) * self.cameras.delays.sigma

    def expected(self, stamp: float) -> SurfacePose:
        """The pose expected at `stamp`, with the covariance of its search. Only after the first map."""
        assert self._pose is not None
        if self._ahead is None or self._ahead[0] is not self._pose or self._ahead[1].stamp != stamp:
            self._ahead = self._pose, self._pose.predict(stamp, onwards=False)
        return self._ahead[1]

    def predict(self, stamp: float) -> Array:
        """Where the surface is expected at `stamp`: (4, 4). Only after the first map."""
        return self.expected(stamp).base_from_surface

    def sigma(self) -> float:
        """Standard deviation, mm, of the last pose's position, as decisions are made by it."""
        return np.inf if self._pose is None else position_sigma(self._pose.covariance)

    def fit(self, observations: Observations, start: Array, scales: tuple[float, ...] = (4.0, 1.0)) -> FrameFit:
        """Fit the pose to observations, whose tracks count rows of the map, from a rough pose `start` (4, 4)."""
        self.learn()
        assert self.map is not None and self._map_error is not None
        if len(observations) < self.settings.least_tracks:
            few = f"{len(observations)} tracks found, {self.settings.least_tracks} needed"
            return failed_fit(observations, start, len(self.rig), few, self.health.left_out)
        # pixels as cameras without offsets would have seen them; the robust fit; the parts of its covariance
        points = warped_points(self.map, self._warp)[observations.track]
        twist, twist_variance = self._twist(observations.stamp, start)
        seen, moved = self._synchronised(observations, points, start, twist)
        allowed = self.health.allowed(np.full(len(self.rig), moved))
        shared = self.cameras.shared(twist)
        tracks = FrameTracks(self.rig, seen, points, shared, self._camera_least())
        solution, odd, off = self._solve(tracks, start, scales, allowed)
        inlier = solution.weights > INLIER_WEIGHT
        used = np.bincount(seen.camera[inlier], minlength=len(self.rig))
        parts = fit_covariance(seen, solution, shared, self._map_error, self._warp)
        # is it a measurement?
        count, whole = int((~np.isin(seen.camera, list(odd))).sum()), parts.noise + parts.smear + parts.lasting
        reason = self._rejection(count, used, whole, tracks.incoherent_residual(solution, inlier))
        apart = self.health.blur_offsets(off, allowed, odd)
        if not reason and self._pose is not None:
            torn = bool(apart.any()) and not self.health.clear(used)
            reason = tracks.weak_fit_reason(solution, odd, torn, self.expected(seen.stamp))
        blurred = parts.bias * np.repeat(apart, 2)
        return FrameFit(
            stamp=seen.stamp,
            solution=solution,
            parts=replace(parts, lasting=parts.lasting + blurred @ blurred.T),
            twist=twist,
            twist_variance=twist_variance,
            inlier=inlier,
            used=used,
            reason=reason,
            off=off,
            allowed=allowed,
            odd=odd,
        )

    def _solve(
        self, tracks: FrameTracks, start: Array, scales: tuple[float, ...], allowed: Array
    ) -> tuple[PoseFit, frozenset[int], Array]:
        """The pose of all cameras that agree with each other, those left out of it, and how far, px, each is off it."""
        odd = self.health.left_out
        solution = tracks.fit(start, scales, odd)
        off = tracks.offsets(solution)
        if self._pose is None or not self.confirmed:  # a bent first map sets cameras apart
            return solution, odd, off
        limit, expected = self.settings.health.out_ratio * allowed, self.expected(tracks.seen.stamp)
        apart = any(off[c] > limit[c] for c in range(len(self.rig)) if c not in odd)
        # a camera may have moved, though the others follow it
        if apart or motion_sigmas(solution, expected) > MAX_MOTION_SIGMAS:
            stay, within = (1, np.inf) if apart else (2, MAX_MOTION_SIGMAS)
            better = tracks.without_outliers(odd, limit, expected, stay, within)
            if better is not None:
                return better[1], better[0], tracks.offsets(better[1])
        return solution, odd, off

    def _twist(self, stamp: float, start: Array) -> tuple[Array, Array]:
        """Velocity (6,) at `stamp` and its variance (6,): the window's and the chord's to `start`, as each is known."""
        last = self._pose
        if last is None or stamp <= last.stamp:
            return np.zeros(6), np.zeros(6)
        dt = stamp - last.stamp
        chord = se3.log(se3.inverse(last.base_from_surface) @ start) / dt
        ahead = np.diag(last.twist_covariance) + self._psd * dt
        behind = 2 * np.diag(last.covariance) / dt**2 + self._psd * dt / 3
        trust = np.repeat([group.mean() for group in (behind / (ahead + behind + 1e-30)).reshape(2, 3)], 3)
        return trust * last.twist + (1 - trust) * chord, trust**2 * ahead + (1 - trust) ** 2 * behind

    def _synchronised(
        self, observations: Observations, points: Array, start: Array, twist: Array
    ) -> tuple[Observations, float]:
        """The observations as cameras without offsets would have made them, with sigmas that can be believed.

        And the smear: how far, px, the surface moves in the time by which a camera's exposure is unknown.
        """
        sigma, camera = np.maximum(observations.sigma, self.settings.floor_sigma), observations.camera
        at_once, _, jacobians = project(self.rig, camera, start, points)
        sigma = self._landmark_uncertainty.widened(sigma, observations.track, jacobians)
        velocity = jacobians @ twist
        pixels = observations.pixels
        if self.cameras.offset.any():
            pixels = pixels + at_once - project(self.rig, camera, self.as_exposed(start, twist), points)[0]
        smear = self.cameras.delays.sigma * float(np.sqrt(median((velocity**2).sum(1))))
        return replace(observations, pixels=pixels, sigma=sigma), smear

    def as_exposed(self, base_from_surface: Array, twist: Array) -> Array:
        """Where the surface is (C, 4, 4) when each camera exposes, from its pose (4, 4) and twist (6,)."""
        return np.asarray(base_from_surface @ se3.exp(twist * self.cameras.offset[:, None]))

    def _rejection(self, count: int, used: Index, covariance: Array, incoherent: float) -> str:
        """Why a fit is no measurement, or ''. count: tracks. used: (C,) inliers. incoherent: px, median residual."""
        s, agreed = self.settings, int(used.sum())
        if agreed < s.least_tracks:
            return f"{agreed} tracks agree, {s.least_tracks} needed"
        if agreed < s.least_share * count:
            return f"only {agreed} of {count} tracks agree"
        if used.max() < self._camera_least() or self.health.hidden(used):
            return f"no camera sees more than {used.max()} of {len(self.map or ())} landmarks"
        bent = not self.confirmed  # first maps of a moving surface are
        if incoherent > s.disorder * (3.0 if bent else 1.0):
            return f"the tracks of a camera disagree among themselves by {incoherent:.1f} px"
        spread = position_sigma(covariance)
        if not spread <= s.sigma_measured:
            return f"the pose is uncertain to {spread:.1f} mm"
        return ""

    def begin(self, stamp: float, base_from_surface: Array, surface_map: SurfaceMap, caveat: str = "") -> SurfacePose:
        """Take the first map, which defines the surface frame at `stamp`.

        caveat: what is not known of that frame's place on the tissue; as long as it stands no pose is TRACKING.
        """
        self._set_map(surface_map)
        self._caveat, self._view = caveat, len(surface_map)
        self._reported, self._calibration = ReportedCovariance(len(self.rig)), CalibrationError()
        self._accepted, self._first, self._map_held, self._unlearned = 0, None, False, None
        self._smoother.reset()
        self._detector, self._warp = MotionDetector(surface_map.points.mean(0)), WarpFilter(surface_map)
        self._local = LocalMotion()
        self.health.begin()
        self._predictor = Predictor(surface_map.points)
        covariance = np.diag([1e-4**2] * 3 + [1e-3**2] * 3)  # exact by definition: the frame is what is seen here
        nothing = np.zeros((6, 6)), np.zeros((6, 6))
        return self._enter(stamp, base_from_surface, covariance, *nothing, *self._states.begin(stamp))

    def _set_map(self, surface_map: SurfaceMap) -> None:
        self.map, self._map_error = surface_map, MapError(surface_map)
        self._landmark_uncertainty = LandmarkUncertainty(surface_map)

    def may_learn(self, fit: FrameFit) -> bool:
        """Whether map, warp and clocks may learn from a fit: what blurred or bumped cameras show would bend them."""
        blurred = self.health.blurred(fit.used, fit.off, fit.allowed, fit.odd)
        return not (fit.odd or self.health.bumps.bumped or blurred) and self.health.clear(fit.used)

    def carrying_cameras(self, fit: FrameFit) -> Index:
        """The cameras that carry a fit, by number."""
        return np.nonzero(fit.used >= self._camera_least())[0] if fit.measured else np.zeros(0, np.int64)

    def _camera_least(self) -> float:
        """Tracks below which a camera says nothing."""
        return max(self.settings.camera_tracks, self.settings.camera_share * self._view)

    def set_twist(self, twist: Array) -> None:
        """The velocity (6,) as known before the window can tell it: the first pose's covariance needs it."""
        assert self._pose is not None
        self._pose = self._given = replace(self._pose, twist=twist)

    def hold(self, stamp: float, reason: str) -> SurfacePose:
        """The first map is not confirmed at `stamp`: the pose stands still and counts for nothing."""
        assert self._pose is not None
        self._pose = self._given = replace(self._pose, stamp=stamp, reason=reason)
        return self._given

    def learn(self) -> None:
        """Take what the last accepted fit tells of the cameras: no pose waits for it, but the next fit needs it."""
        if self._unlearned is None:
            return
        last, self._unlearned = self._unlearned, None
        fit, seen = last.fit, last.seen
        assert fit.solution.shared is not None and self.map is not None
        exposed = self.as_exposed(fit.solution.base_from_surface, fit.twist)
        points = warped_points(self.map, self._warp)[seen.track]
        self.health.bumps.update(self.rig, seen, points, exposed, fit.solution.jacobians, fit.odd)
        if not last.sound:
            return
        if not self._map_held or not self.deforms:
            self.cameras.learn(fit.solution.shared, last.seconds, fit.clear)
            self._earlier_cameras.keep(fit.stamp, self.cameras)
        sigma = np.maximum(seen.sigma, self.settings.floor_sigma)
        self._reported.learn(replace(seen, sigma=sigma), fit, self.cameras)

    def accept(self, fit: FrameFit, observations: Observations) -> SurfacePose:
        """Take a measured fit into the window and give the pose."""
        assert fit.measured and self.map is not None
        sigma = np.maximum(observations.sigma, self.settings.floor_sigma)
        if self._pose is not None:
            sound = self.may_learn(fit)
            self._unlearned = _Unlearned(fit, observations, fit.stamp - self._pose.stamp, sound)
            if self._warp is not None and sound and self._smeared(fit) < MAX_LEARNING_SMEAR_MM:
                self._warp.learn(observations, fit.solution, sigma, fit.twist, self.cameras.delays.sigma)
        self._accepted += 1
        self._detector(fit.stamp, fit.solution.base_from_surface, fit.parts.noise)
        self._update_health(fit)
        self._local(observations, fit, sigma, self.map, self._smeared(fit))
        lasting = fit.parts.lasting + self._calibration.covariance(fit, self.cameras)
        quality = Measurement(
            cameras=tuple(self.rig.cameras[c].name for c in self.carrying_cameras(fit)),
            tracks=int(fit.used.sum()),
            sigma=position_sigma(fit.covariance + lasting),
            trouble=self.health.trouble(fit.stamp),
            caveat=self._local.message or self._caveat,
            deformation=0.0 if self._warp is None or self._warp.warp is None else self._warp.warp.deformation,
        )
        state = self._states.measured(fit.stamp, quality)
        pose = self._enter(fit.stamp, fit.solution.base_from_surface, fit.parts.noise, fit.parts.smear, lasting, *state)
        assert self._smoother.newest is not None
        given = self._reported.measured(pose, fit, self.cameras, self._first, self._smoother.newest.covariance)
        self._given = widened(given, self._local.covariance) if self._local.active else given
        return self._given

    def _update_health(self, fit: FrameFit) -> None:
        used = fit.used if fit.measured else np.zeros_like(fit.used)
        odd = fit.odd if fit.measured else fit.odd & self.health.left_out  # a rejected fit makes no new outliers
        self.health.update(fit.stamp, used, self._camera_least(), fit.off, fit.allowed, odd)

    def _enter(
        self, stamp: float, pose: Array, noise: Array, smear: Array, lasting: Array, state: TrackState, reason: str
    ) -> SurfacePose:
        """Average a pose's noise in the window; its covariance is the window's marginal + smear + lasting errors.

        The smear (late exposures) is not averaged: its size is learned slowly, and it errs along the motion. As part of
        the noise it made the window believe its prior: a third farther off a waved board than the fit alone.
        """
        step = 1.0 if self._measured is None else max(1e-3, stamp - self._measured.stamp)
        window = self._smoother.add(MeasuredPose(stamp, pose, noise))
        self._psd = window.acceleration_psd
        if self._first is not None:
            lasting = lasting + self._first
        elif state.measured:
            self._first = window.covariance + smear
        entered = SurfacePose(
            stamp,
            window.pose,
            window.covariance + smear + (lasting + lasting.T) / 2,
            window.twist,
            state,
            window.twist_covariance,
            np.maximum(self._psd * max(1.0, ACCELERATION_PERSISTENCE_S / step), MIN_FORECAST_PSD),
            reason,
            self._detector.motion,
            None if self._warp is None else self._warp.warp,
        )
        entered = replace(entered, forecast=self._predictor.add(entered, lasting))
        self._pose = self._measured = self._given = entered
        return entered

    def coast(self, fit: FrameFit) -> SurfacePose:
        """No measurement at `fit.stamp`: predict from the last one; the reason tells for how long already, and why."""
        assert self._measured is not None
        self._update_health(fit)
        trouble = self.health.trouble(fit.stamp, at_once=True)
        state, reason = self._states.missed(fit.stamp, f"{fit.reason}; {trouble}" if trouble else fit.reason)
        predicted = self._measured.predict(fit.stamp)
        if state is TrackState.LOST:  # so old a velocity would carry the pose away; which camera was wrong is as old
            self.health.readmit_all()
            stays = self._measured.predict(self._measured.stamp + self.settings.states.coast)
            predicted = replace(predicted, base_from_surface=stays.base_from_surface, twist=np.zeros(6), forecast=None)
        self._pose = replace(predicted, state=state, reason=reason)
        self._given = self._reported.missed(self._pose)
        return self._given

    def replace_map(self, surface_map: SurfaceMap, crooked: bool = False, bent: bool = False) -> None:
        """Take a refined or longer map of the same surface frame; rows keep their meaning.

        crooked: the map before was a first map, whose own error looked like a deformation. bent: it was bent by a
        deformation, and this one is not: then what was lately learned of the clocks was the deformation too.
        """
        assert self.map is not None and len(surface_map) >= len(self.map)
        if crooked:
            self._warp = WarpFilter(surface_map)
        elif self._warp is not None:
            self._warp.replace_map(surface_map, right=bent)
        if bent:
            self.cameras, self._map_held = self._earlier_cameras.before, True
        self._set_map(surface_map)
