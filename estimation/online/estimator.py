"""From observations to surface poses: robust fit to the map, sliding window, state, and reported covariance.

A fit's covariance has two parts. Errors that are new in every frame set (tracks, shifts of whole images) enter the
window and are averaged there. Errors that last (map, calibration) are not averaged: they are added to the window's
marginal. Added whole, too: the effect of late exposures on a moving surface, and the error of the first pose that is
given out, since the path is placed in it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimation import se3
from estimation.observations import NO_DISPLACED_PLACES, DisplacedPlaces, Observations
from estimation.online.camera_errors import CameraErrorHistory, CameraErrors
from estimation.online.camera_health import CameraHealth, FrameTracks
from estimation.online.deformation import WarpFilter, squared_speeds
from estimation.online.fit import FrameFit, failed_fit, fit_covariance
from estimation.online.parted_texture import Elsewhere
from estimation.online.reported_covariance import (
    NO_ALIASES,
    alias_covariance,
    alias_message,
    widened,
)
from estimation.online.surface_state import (
    EstimatorSettings,
    MappedSurface,
    Measurement,
    PoseStateMachine,
    Region,
)
from estimation.online.window import MeasuredPose, Smoother, WindowEstimate
from estimation.pose import SurfacePose, TrackState, position_sigma
from estimation.pose_solver import INLIER_WEIGHT, project
from estimation.rig import Rig
from estimation.runtime import median
from estimation.se3 import Array, Index
from estimation.surface_map import MapError, SurfaceMap

MIN_FORECAST_PSD = np.array([1e-4] * 3 + [1.0] * 3)  # rad^2/s^3, mm^2/s^3: what lies still may begin to breathe
# s, of the cameras' instants: more than of webcams at first. They then come late, or hang, now and then, and the pose
# may be so many sigmas late or early.
MAX_DELAY_SIGMA_S, DELAY_SIGMAS = 0.02, 3.0
MAX_LEARNING_SMEAR_MM = 0.1  # between the cameras' instants: beyond, a late camera cannot be told from a bent surface
MAX_MAP_SMEAR_MM = 0.5  # likewise: a map bent by more is no good for printing
ACCELERATION_PERSISTENCE_S = 0.2  # breathing accelerates alike for so long, which adds up to more than white noise does


class Estimator:
    """Owns the map, the window and the state of one surface.

    `begin` takes the first map. Before it only `map`, `pose`, `confirmed`, `deforms`, `sigma` and `learn` may be used.
    """

    def __init__(self, rig: Rig, settings: EstimatorSettings | None = None, region: Region = "drawn") -> None:
        """region: who says what the surface is, on which all landmarks of the first map lie."""
        self.rig, self._region, self.periodic = rig, region, False  # periodic: whether the surface's texture repeats
        self.settings, self.cameras = settings or EstimatorSettings(), CameraErrors(len(rig))
        self.health = CameraHealth([camera.name for camera in rig.cameras])
        self._earlier_cameras = CameraErrorHistory(self.cameras)
        self._states, self._smoother = PoseStateMachine(self.settings.states), Smoother()
        self._mapped: MappedSurface | None = None
        self._measured_stamp = -np.inf  # s, of the last pose that was measured, by whatever map
        self._prediction: tuple[SurfacePose, SurfacePose] | None = None  # the pose, and as last predicted from it

    @property
    def _surface(self) -> MappedSurface:
        assert self._mapped is not None, "only after the first map"
        return self._mapped

    @property
    def map(self) -> SurfaceMap | None:
        """The map as it is now, or None before there is one."""
        return None if self._mapped is None else self._mapped.map

    @property
    def pose(self) -> SurfacePose | None:
        """The last pose given, or None before there is a map."""
        return None if self._mapped is None else self._mapped.reported_pose

    @property
    def window_graph(self) -> str:
        """The window's factors and variables as `Smoother.graph`."""
        return self._smoother.graph

    @property
    def confirmed(self) -> bool:
        """Whether a frame set after the one of the first map has been measured."""
        return self._mapped is not None and self._mapped.fit_count > 0

    @property
    def deforms(self) -> bool:
        """Whether the surface departs from a rigid body."""
        return self._mapped is not None and self._mapped.warp.liveliness > 0

    def too_fast_for_map(self, fit: FrameFit) -> bool:
        """Whether no pose is given out yet, and the surface moves too fast for its map to be trusted."""
        return self._surface.first_covariance is None and self._smear(fit) > MAX_MAP_SMEAR_MM

    def _smear(self, fit: FrameFit) -> float:
        """How far, mm, the surface moves in one sigma of a camera's exposure delay."""
        return float(np.linalg.norm(fit.twist[3:])) * self.cameras.delays.sigma

    def expected(self, stamp: float) -> SurfacePose:
        """The pose expected at `stamp`, with the covariance of its search."""
        pose = self._surface.pose
        if self._prediction is None or self._prediction[0] is not pose or self._prediction[1].stamp != stamp:
            self._prediction = pose, pose.predict(stamp, keep_forecast=False)
        return self._prediction[1]

    def predict(self, stamp: float) -> Array:
        """base_from_surface (4, 4) expected at `stamp`."""
        return self.expected(stamp).base_from_surface

    def sigma(self) -> float:
        """Standard deviation, mm, of the last pose's position, as decisions are made by it; inf before there is one."""
        return np.inf if self._mapped is None else position_sigma(self._mapped.pose.covariance)

    def fit(self, observations: Observations, start: Array, scales: tuple[float, ...] = (4.0, 1.0)) -> FrameFit:
        """Fit the pose to observations, whose tracks count rows of the map, from a rough pose `start` (4, 4)."""
        self.learn()
        surface = self._surface
        if len(observations) < self.settings.min_tracks:
            reason = f"{len(observations)} tracks found, {self.settings.min_tracks} needed"
            return failed_fit(observations, start, len(self.rig), reason, self.health.left_out)
        # pixels as cameras without offsets would have seen them; the robust fit; the parts of its covariance
        points = surface.warp.points(surface.map)[observations.track]
        twist, twist_variance = self._twist(observations.stamp, start)
        aligned, smear = self._synchronised(observations, points, start, twist)
        allowed = self.health.offset_sigma(np.full(len(self.rig), smear))
        shared = self.cameras.shared_errors(twist)
        tracks = FrameTracks(self.rig, aligned, points, shared, self._min_camera_tracks())
        expected = self.expected(aligned.stamp) if self.confirmed else None  # a bent first map sets cameras apart
        solution, outliers, offsets = self.health.solve(tracks, start, scales, allowed, expected)
        inlier = solution.weights > INLIER_WEIGHT
        inlier_counts = np.bincount(aligned.camera[inlier], minlength=len(self.rig))
        parts = fit_covariance(aligned, solution, shared, surface.map_error, surface.warp, twist_variance)
        count, total = int((~np.isin(aligned.camera, list(outliers))).sum()), parts.noise + parts.smear + parts.lasting
        reason = self._rejection(count, inlier_counts, total, tracks.incoherent_residual(solution, inlier))
        blur = self.health.blur_offsets(offsets, allowed, outliers)
        if not reason:
            sparse = bool(blur.any()) and not self.health.has_usual_tracks(inlier_counts)
            reason = tracks.weak_fit_reason(solution, outliers, sparse, self.expected(aligned.stamp))
        blur_effect = parts.by_shift * np.repeat(blur, 2)
        return FrameFit(
            stamp=aligned.stamp,
            solution=solution,
            parts=replace(parts, lasting=parts.lasting + blur_effect @ blur_effect.T),
            twist=twist,
            twist_variance=twist_variance,
            inlier=inlier,
            used=inlier_counts,
            reason=reason,
            offsets=offsets,
            offset_sigma=allowed,
            outliers=outliers,
            rivals=self.health.rival_poses(tracks, solution, outliers, offsets, allowed, expected),
        )

    def _twist(self, stamp: float, start: Array) -> tuple[Array, Array]:
        """Velocity (6,) at `stamp` and its variance (6,): the window's and the chord's to `start`, weighted."""
        last, psd = self._surface.pose, self._surface.psd
        if stamp <= last.stamp:
            return np.zeros(6), np.zeros(6)
        dt = stamp - last.stamp
        chord = se3.log(se3.inverse(last.base_from_surface) @ start) / dt
        ahead_variance = np.diag(last.twist_covariance) + psd * dt
        chord_variance = 2 * np.diag(last.covariance) / dt**2 + psd * dt / 3
        share = chord_variance / (ahead_variance + chord_variance + 1e-30)
        trust = np.repeat([group.mean() for group in share.reshape(2, 3)], 3)
        return trust * last.twist + (1 - trust) * chord, trust**2 * ahead_variance + (1 - trust) ** 2 * chord_variance

    def _synchronised(
        self, observations: Observations, points: Array, start: Array, twist: Array
    ) -> tuple[Observations, float]:
        """The observations as by cameras without offsets, with realistic sigmas; and the smear, px, of the images."""
        sigma, camera = np.maximum(observations.sigma, self.settings.min_track_sigma), observations.camera
        simultaneous, _, jacobians = project(self.rig, camera, start, points)
        sigma = self._surface.map_error.inflate_sigmas(sigma, observations.track, jacobians)
        pixels = observations.pixels
        if self.cameras.offset.any():
            pixels = pixels + simultaneous - project(self.rig, camera, self.as_exposed(start, twist), points)[0]
        # how far the images move in one sigma of a camera's exposure delay
        smear = self.cameras.delays.sigma * float(np.sqrt(median(squared_speeds(jacobians, twist))))
        return replace(observations, pixels=pixels, sigma=sigma), smear

    def as_exposed(self, base_from_surface: Array, twist: Array) -> Array:
        """base_from_surface (C, 4, 4) when each camera exposes, from the pose (4, 4) and twist (6,) at the stamp."""
        motion = twist * self.cameras.offset[:, None]
        exposed = [base_from_surface] * len(motion) if not motion.any() else base_from_surface @ se3.exp(motion)
        return np.array(exposed)

    def _rejection(self, count: int, inlier_counts: Index, covariance: Array, incoherent: float) -> str:
        """Why a fit is no measurement, or ''. count: tracks. inlier_counts: (C,). incoherent: px, median residual."""
        s, inliers = self.settings, int(inlier_counts.sum())
        if inliers < s.min_tracks:
            return f"{inliers} tracks agree, {s.min_tracks} needed"
        if inliers < s.min_inlier_share * count:
            return f"only {inliers} of {count} tracks agree"
        if inlier_counts.max() < self._min_camera_tracks() or self.health.hidden(inlier_counts):
            return f"no camera sees more than {inlier_counts.max()} of {len(self._surface.map)} landmarks"
        if incoherent > s.max_incoherence * (1.0 if self.confirmed else 3.0):  # first maps of a moving surface are bent
            return f"the tracks of a camera disagree among themselves by {incoherent:.1f} px"
        spread = position_sigma(covariance)
        if not spread <= s.max_sigma:
            return f"the pose is uncertain to {spread:.1f} mm"
        return ""

    def begin(self, stamp: float, base_from_surface: Array, surface_map: SurfaceMap, caveat: str = "") -> SurfacePose:
        """Take the first map, which defines the surface frame at `stamp`.

        caveat: what is not known of that frame's place on the tissue; while it is not empty no pose is TRACKING.
        """
        self._mapped = MappedSurface(surface_map, self.rig, self._region, caveat)
        self._smoother.reset()
        self.health.begin(surface_map.points)
        covariance = np.diag([1e-4**2] * 3 + [1e-3**2] * 3)  # exact by definition: the frame is what is seen here
        zero, window = np.zeros((6, 6)), self._smoother.add(MeasuredPose(stamp, base_from_surface, covariance))
        return self._enter(window, zero, zero, *self._states.begin(stamp))

    def may_learn(self, fit: FrameFit) -> bool:
        """Whether map, warp and clocks may learn from a fit: blurred or bumped cameras would distort them."""
        fine = not (fit.outliers or self.health.contradictory or self.looks_unusual(fit))
        return fine and self.health.has_usual_tracks(fit.used)

    def looks_unusual(self, fit: FrameFit) -> bool:
        """Whether all cameras are off a fit together, with fewer tracks than usual: blurred, covered or mismatched."""
        return self.health.blurred(fit.used, fit.offsets, fit.offset_sigma, fit.outliers)

    def carrying_cameras(self, fit: FrameFit) -> Index:
        """The cameras that carry a fit, by number."""
        return np.nonzero(fit.used >= self._min_camera_tracks())[0] if fit.measured else np.zeros(0, np.int64)

    def _min_camera_tracks(self) -> float:
        """Tracks below which a camera says nothing."""
        return max(self.settings.min_camera_tracks, self.settings.min_camera_share * self._surface.first_view)

    def set_twist(self, twist: Array) -> None:
        """Take the velocity (6,) before the window can estimate it: the first pose's covariance needs it."""
        surface = self._surface
        surface.pose = surface.reported_pose = replace(surface.pose, twist=twist)

    def forget_motion(self) -> None:
        """Restart the window: between the last pose and the next fit lies no motion that may be learned."""
        self._smoother.reset()

    def hold(self, stamp: float, reason: str) -> SurfacePose:
        """The first map is not confirmed at `stamp`: the pose is kept, and is no measurement."""
        surface = self._surface
        surface.pose = surface.reported_pose = replace(surface.pose, stamp=stamp, reason=reason)
        return surface.reported_pose

    def learn(self) -> None:
        """Learn the cameras' errors from the last accepted fit: no pose waits for it, but the next fit needs it."""
        if (surface := self._mapped) is None or surface.pending_fit is None:
            return
        (fit, observations, seconds, clear), surface.pending_fit = surface.pending_fit, None
        assert fit.solution.shared is not None
        exposed = self.as_exposed(fit.solution.base_from_surface, fit.twist)
        points, smear = surface.warp.points(surface.map)[observations.track], self.cameras.delays.sigma * fit.twist
        self.health.bumps.update(self.rig, observations, points, exposed, fit.solution.jacobians, fit.outliers, smear)
        if not clear:
            return
        if not surface.clocks_frozen or not self.deforms:
            self.cameras.learn(fit.solution.shared, seconds, fit.signal_share)
            self._earlier_cameras.keep(fit.stamp, self.cameras)
        observations = replace(observations, sigma=np.maximum(observations.sigma, self.settings.min_track_sigma))
        surface.reported_covariance.learn(observations, fit, self.cameras)

    def elsewhere(self, fit: FrameFit, observations: Observations) -> Elsewhere | None:
        """Landmarks to be looked for away from a measured fit, for `accept`; None: all are where it puts them."""
        return self._surface.parted.search(observations, fit, self._surface.warp.points(self._surface.map))

    def accept(
        self,
        fit: FrameFit,
        observations: Observations,
        elsewhere: Observations | None = None,
        aliases: Array = NO_ALIASES,
        displaced: DisplacedPlaces = NO_DISPLACED_PLACES,
    ) -> SurfacePose:
        """Take a measured fit into the window and give the pose.

        elsewhere: observations of what `elsewhere` asked for. aliases: (K,) mm, distances at which the texture repeats.
        """
        assert fit.measured
        surface, sigma = self._surface, np.maximum(observations.sigma, self.settings.min_track_sigma)
        clear = self.may_learn(fit) and not len(aliases) and not displaced.ambiguous
        surface.displaced = displaced
        surface.pending_fit = fit, observations, fit.stamp - surface.pose.stamp, clear
        if clear and self._smear(fit) < MAX_LEARNING_SMEAR_MM:
            surface.warp.learn(observations, fit.solution, sigma, fit.twist, self.cameras.delays.sigma)
        surface.fit_count += 1
        surface.detector(fit.stamp, fit.solution.base_from_surface, fit.parts.noise)
        self._update_health(fit)
        self.health.rivals.update(self.rig, fit.stamp, fit.solution.base_from_surface, fit.rivals, fit.outliers)
        moved = surface.local_motion(observations, fit, sigma, surface.map, self._smear(fit))
        surface.parted(observations, fit, elsewhere, surface.warp.points(surface.map), self.periodic, moved)
        lasting = fit.parts.lasting + surface.calibration_error.covariance(fit, self.cameras)
        rebuilds = self._smoother.rebuilds
        base_from_surface = fit.solution.base_from_surface @ se3.exp(fit.parts.step)
        window = self._smoother.add(MeasuredPose(fit.stamp, base_from_surface, fit.parts.noise))
        sigma_s, steady = self.cameras.delays.sigma, self.cameras.delays.sigma <= MAX_DELAY_SIGMA_S
        clock_caveat = "" if steady else f"the cameras expose {sigma_s:.3f} s apart, now more, now less"
        measurement = Measurement(
            cameras=tuple(self.rig.cameras[c].name for c in self.carrying_cameras(fit)),
            tracks=int(fit.used.sum()),
            sigma=position_sigma(fit.covariance + lasting),
            trouble=self.health.trouble(fit.stamp),
            caveat=alias_message(aliases)
            or displaced.message
            or surface.parted.message
            or surface.local_motion.message
            or surface.caveat
            or clock_caveat,
            deformation=0.0 if surface.warp.warp is None else surface.warp.warp.deformation,
            rebuilds=self._smoother.rebuilds if self._smoother.rebuilds > rebuilds else 0,
        )
        pose = self._enter(window, fit.parts.smear, lasting, *self._states.measured(fit.stamp, measurement))
        reported = surface.reported_covariance.measured(pose, fit, self.cameras, surface.first_covariance, window)
        reported = widened(reported, alias_covariance(aliases)) if len(aliases) else reported
        reported = widened(reported, displaced.covariance) if displaced.ambiguous else reported
        if self.health.rivals.untrusted or clock_caveat:
            delay_error = bool(clock_caveat) * DELAY_SIGMAS * sigma_s * fit.twist
            reported = widened(reported, self.health.rivals.covariance + np.outer(delay_error, delay_error))
        surface.reported_pose = surface.parted.widened(reported)
        return surface.reported_pose

    def _update_health(self, fit: FrameFit) -> None:
        inlier_counts = fit.used if fit.measured else np.zeros_like(fit.used)
        # a rejected fit makes no new outliers
        outliers = fit.outliers if fit.measured else fit.outliers & self.health.left_out
        self.health.update(fit.stamp, inlier_counts, self._min_camera_tracks(), fit.offsets, fit.offset_sigma, outliers)

    def _enter(
        self, window: WindowEstimate, smear: Array, lasting: Array, state: TrackState, reason: str
    ) -> SurfacePose:
        """The window's pose; covariance: the window's marginal + smear + lasting errors.

        The smear (late exposures) is not averaged: its size is learned slowly, and its error lies along the motion. As
        part of the noise it made the window trust its prior: on a waved board a third worse than the fit alone.
        """
        surface, stamp = self._surface, window.stamp
        step = max(1e-3, stamp - self._measured_stamp)
        self._measured_stamp, surface.psd = stamp, window.acceleration_psd
        if surface.first_covariance is not None:
            lasting = lasting + surface.first_covariance
        elif state.measured:
            surface.first_covariance = window.covariance + smear
        pose = SurfacePose(
            stamp,
            window.pose,
            window.covariance + smear + (lasting + lasting.T) / 2,
            window.twist,
            state,
            window.twist_covariance,
            np.maximum(surface.psd * max(1.0, ACCELERATION_PERSISTENCE_S / step), MIN_FORECAST_PSD),
            reason,
            surface.detector.motion,
            surface.warp.warp,
            local=surface.local_error,
        )
        pose = replace(pose, forecast=surface.predictor.add(pose, lasting))
        surface.pose = surface.measured_pose = surface.reported_pose = pose
        return pose

    def coast(self, fit: FrameFit) -> SurfacePose:
        """No measurement at `fit.stamp`: predict from the last one. The pose's reason tells why, and since when."""
        surface = self._surface
        self._update_health(fit)
        reasons = "; ".join(filter(None, (fit.reason, self.health.trouble(fit.stamp, at_once=True))))
        state, reason = self._states.missed(fit.stamp, reasons)
        predicted = surface.measured_pose.predict(fit.stamp)
        if state is TrackState.LOST:  # so old a velocity would carry the pose away; which camera was wrong is as old
            self.health.left_out = frozenset()
            rest = surface.measured_pose.predict(surface.measured_pose.stamp + self.settings.states.coast)
            predicted = replace(predicted, base_from_surface=rest.base_from_surface, twist=np.zeros(6), forecast=None)
        surface.pose = replace(predicted, state=state, reason=reason)
        surface.reported_pose = surface.parted.widened(surface.reported_covariance.missed(surface.pose))
        return surface.reported_pose

    def replace_map(self, surface_map: SurfaceMap, first: bool = False, deformed: bool = False) -> None:
        """Take a refined or longer map of the same surface frame; rows keep their meaning.

        first: the map before was a first map, whose own error looked like a deformation. deformed: it was bent by a
        deformation, and this one is not: what the clocks have learned since the deformation began is undone.
        """
        surface = self._surface
        assert len(surface_map) >= len(surface.map)
        if first:
            surface.warp = WarpFilter(surface_map)
        else:
            surface.warp.replace_map(surface_map, undeformed=deformed)
        if deformed:
            self.cameras, surface.clocks_frozen = self._earlier_cameras.before, True
        surface.map, surface.map_error = surface_map, MapError(surface_map)
        self.health.bumps.unequal_motion.forget()
