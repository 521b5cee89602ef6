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
from estimation.observations import NOTHING_DISPLACED, DisplacedPlaces, Observations
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
MAX_DELAY_SIGMA_S, MOST_DELAY_SIGMAS = 0.02, 3.0
MAX_LEARNING_SMEAR_MM = 0.1  # between the cameras' instants: beyond, a late camera cannot be told from a bent surface
MAX_MAP_SMEAR_MM = 0.5  # likewise: a map bent by more is no good for printing
ACCELERATION_PERSISTENCE_S = 0.2  # breathing accelerates alike for so long, which adds up to more than white noise does


class Estimator:
    """Owns the map, the window and the state of one surface.

    `begin` takes the first map. Before it only `map`, `pose`, `confirmed`, `deforms`, `sigma` and `learn` may be used.
    """

    def __init__(self, rig: Rig, settings: EstimatorSettings | None = None, region: Region = "drawn") -> None:
        """region: who says what the surface is, on which all landmarks of the first map lie."""
        self.rig, self._region = rig, region
        self.settings, self.cameras = settings or EstimatorSettings(), CameraErrors(len(rig))
        self.health = CameraHealth([camera.name for camera in rig.cameras])
        self._earlier_cameras = CameraErrorHistory(self.cameras)
        self._states, self._smoother = PoseStateMachine(self.settings.states), Smoother()
        self._mapped: MappedSurface | None = None
        self._measured_stamp = -np.inf  # s, of the last pose that was measured, by whatever map
        self._ahead: tuple[SurfacePose, SurfacePose] | None = None  # the pose, and as last predicted from it

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
        return self._mapped is not None and self._mapped.accepted > 0

    @property
    def deforms(self) -> bool:
        """Whether the surface departs from a rigid body."""
        return self._mapped is not None and self._mapped.warp.liveliness > 0

    def too_fast_for_map(self, fit: FrameFit) -> bool:
        """Whether no pose is given out yet, and the surface moves too fast for its map to be trusted."""
        return self._surface.first is None and self._smear(fit) > MAX_MAP_SMEAR_MM

    def _smear(self, fit: FrameFit) -> float:
        """How far, mm, the surface moves in the time by which a camera's exposure is unknown."""
        return float(np.linalg.norm(fit.twist[3:])) * self.cameras.delays.sigma

    def expected(self, stamp: float) -> SurfacePose:
        """The pose expected at `stamp`, with the covariance of its search."""
        pose = self._surface.pose
        if self._ahead is None or self._ahead[0] is not pose or self._ahead[1].stamp != stamp:
            self._ahead = pose, pose.predict(stamp, onwards=False)
        return self._ahead[1]

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
        if len(observations) < self.settings.least_tracks:
            few = f"{len(observations)} tracks found, {self.settings.least_tracks} needed"
            return failed_fit(observations, start, len(self.rig), few, self.health.left_out)
        # pixels as cameras without offsets would have seen them; the robust fit; the parts of its covariance
        points = surface.warp.points(surface.map)[observations.track]
        twist, twist_variance = self._twist(observations.stamp, start)
        seen, smear = self._synchronised(observations, points, start, twist)
        allowed = self.health.allowed(np.full(len(self.rig), smear))
        shared = self.cameras.shared(twist)
        tracks = FrameTracks(self.rig, seen, points, shared, self._min_camera_tracks())
        expected = self.expected(seen.stamp) if self.confirmed else None  # a bent first map sets cameras apart
        solution, outliers, offsets = self.health.solve(tracks, start, scales, allowed, expected)
        inlier = solution.weights > INLIER_WEIGHT
        used = np.bincount(seen.camera[inlier], minlength=len(self.rig))
        parts = fit_covariance(seen, solution, shared, surface.map_error, surface.warp, twist_variance)
        # is it a measurement?
        count, whole = int((~np.isin(seen.camera, list(outliers))).sum()), parts.noise + parts.smear + parts.lasting
        reason = self._rejection(count, used, whole, tracks.incoherent_residual(solution, inlier))
        apart = self.health.blur_offsets(offsets, allowed, outliers)
        if not reason:
            torn = bool(apart.any()) and not self.health.has_usual_tracks(used)
            reason = tracks.weak_fit_reason(solution, outliers, torn, self.expected(seen.stamp))
        blurred = parts.by_shift * np.repeat(apart, 2)
        return FrameFit(
            stamp=seen.stamp,
            solution=solution,
            parts=replace(parts, lasting=parts.lasting + blurred @ blurred.T),
            twist=twist,
            twist_variance=twist_variance,
            inlier=inlier,
            used=used,
            reason=reason,
            offsets=offsets,
            allowed=allowed,
            outliers=outliers,
            rivals=self.health.rival_poses(tracks, solution, outliers, offsets, allowed, expected),
        )

    def _twist(self, stamp: float, start: Array) -> tuple[Array, Array]:
        """Velocity (6,) at `stamp` and its variance (6,): the window's and the chord's to `start`, as each is known."""
        last, psd = self._surface.pose, self._surface.psd
        if stamp <= last.stamp:
            return np.zeros(6), np.zeros(6)
        dt = stamp - last.stamp
        chord = se3.log(se3.inverse(last.base_from_surface) @ start) / dt
        ahead = np.diag(last.twist_covariance) + psd * dt
        behind = 2 * np.diag(last.covariance) / dt**2 + psd * dt / 3
        trust = np.repeat([group.mean() for group in (behind / (ahead + behind + 1e-30)).reshape(2, 3)], 3)
        return trust * last.twist + (1 - trust) * chord, trust**2 * ahead + (1 - trust) ** 2 * behind

    def _synchronised(
        self, observations: Observations, points: Array, start: Array, twist: Array
    ) -> tuple[Observations, float]:
        """The observations as by cameras without offsets, with realistic sigmas; and the smear, px, of the images."""
        sigma, camera = np.maximum(observations.sigma, self.settings.floor_sigma), observations.camera
        at_once, _, jacobians = project(self.rig, camera, start, points)
        sigma = self._surface.map_error.widened(sigma, observations.track, jacobians)
        pixels = observations.pixels
        if self.cameras.offset.any():
            pixels = pixels + at_once - project(self.rig, camera, self.as_exposed(start, twist), points)[0]
        # how far the images move in the time by which a camera's exposure is unknown
        smear = self.cameras.delays.sigma * float(np.sqrt(median(squared_speeds(jacobians, twist))))
        return replace(observations, pixels=pixels, sigma=sigma), smear

    def as_exposed(self, base_from_surface: Array, twist: Array) -> Array:
        """Where the surface is (C, 4, 4) when each camera exposes, from its pose (4, 4) and twist (6,)."""
        off = twist * self.cameras.offset[:, None]
        return np.asarray(base_from_surface @ se3.exp(off)) if off.any() else np.stack([base_from_surface] * len(off))

    def _rejection(self, count: int, used: Index, covariance: Array, incoherent: float) -> str:
        """Why a fit is no measurement, or ''. count: tracks. used: (C,) inliers. incoherent: px, median residual."""
        s, agreed = self.settings, int(used.sum())
        if agreed < s.least_tracks:
            return f"{agreed} tracks agree, {s.least_tracks} needed"
        if agreed < s.least_share * count:
            return f"only {agreed} of {count} tracks agree"
        if used.max() < self._min_camera_tracks() or self.health.hidden(used):
            return f"no camera sees more than {used.max()} of {len(self._surface.map)} landmarks"
        if incoherent > s.disorder * (1.0 if self.confirmed else 3.0):  # first maps of a moving surface are bent
            return f"the tracks of a camera disagree among themselves by {incoherent:.1f} px"
        spread = position_sigma(covariance)
        if not spread <= s.sigma_measured:
            return f"the pose is uncertain to {spread:.1f} mm"
        return ""

    def begin(self, stamp: float, base_from_surface: Array, surface_map: SurfaceMap, caveat: str = "") -> SurfacePose:
        """Take the first map, which defines the surface frame at `stamp`.

        caveat: what is not known of that frame's place on the tissue; as long as it stands no pose is TRACKING.
        """
        self._mapped = MappedSurface(surface_map, self.rig, self._region, caveat)
        self._smoother.reset()
        self.health.begin(surface_map.points)
        covariance = np.diag([1e-4**2] * 3 + [1e-3**2] * 3)  # exact by definition: the frame is what is seen here
        zero, window = np.zeros((6, 6)), self._smoother.add(MeasuredPose(stamp, base_from_surface, covariance))
        return self._enter(window, zero, zero, *self._states.begin(stamp))

    def may_learn(self, fit: FrameFit) -> bool:
        """Whether map, warp and clocks may learn from a fit: what blurred or bumped cameras show would bend them."""
        fine = not (fit.outliers or self.health.at_odds or self.looks_unusual(fit))
        return fine and self.health.has_usual_tracks(fit.used)

    def looks_unusual(self, fit: FrameFit) -> bool:
        """Whether all cameras stand off a fit together, with fewer tracks than usual: blurred, covered, or deceived."""
        return self.health.blurred(fit.used, fit.offsets, fit.allowed, fit.outliers)

    def carrying_cameras(self, fit: FrameFit) -> Index:
        """The cameras that carry a fit, by number."""
        return np.nonzero(fit.used >= self._min_camera_tracks())[0] if fit.measured else np.zeros(0, np.int64)

    def _min_camera_tracks(self) -> float:
        """Tracks below which a camera says nothing."""
        return max(self.settings.camera_tracks, self.settings.camera_share * self._surface.first_view)

    def set_twist(self, twist: Array) -> None:
        """Take the velocity (6,) before the window can estimate it: the first pose's covariance needs it."""
        surface = self._surface
        surface.pose = surface.reported_pose = replace(surface.pose, twist=twist)

    def forget_motion(self) -> None:
        """The next fit is elsewhere than the last pose was followed to: between both lies no motion to be learned."""
        self._smoother.reset()

    def hold(self, stamp: float, reason: str) -> SurfacePose:
        """The first map is not confirmed at `stamp`: the pose stands still and counts for nothing."""
        surface = self._surface
        surface.pose = surface.reported_pose = replace(surface.pose, stamp=stamp, reason=reason)
        return surface.reported_pose

    def learn(self) -> None:
        """Learn the cameras' errors from the last accepted fit: no pose waits for it, but the next fit needs it."""
        if (surface := self._mapped) is None or surface.unlearned is None:
            return
        (fit, seen, seconds, sound), surface.unlearned = surface.unlearned, None
        assert fit.solution.shared is not None
        exposed = self.as_exposed(fit.solution.base_from_surface, fit.twist)
        points, smear = surface.warp.points(surface.map)[seen.track], self.cameras.delays.sigma * fit.twist
        self.health.bumps.update(self.rig, seen, points, exposed, fit.solution.jacobians, fit.outliers, smear)
        if not sound:
            return
        if not surface.map_held or not self.deforms:
            self.cameras.learn(fit.solution.shared, seconds, fit.signal_share)
            self._earlier_cameras.keep(fit.stamp, self.cameras)
        seen = replace(seen, sigma=np.maximum(seen.sigma, self.settings.floor_sigma))
        surface.reported.learn(seen, fit, self.cameras)

    def elsewhere(self, fit: FrameFit, observations: Observations) -> Elsewhere | None:
        """Landmarks to be looked for away from a measured fit, for `accept`; None: all are where it puts them."""
        return self._surface.parted.sought(observations, fit, self._surface.warp.points(self._surface.map))

    def accept(
        self,
        fit: FrameFit,
        observations: Observations,
        elsewhere: Observations | None = None,
        aliases: Array = NO_ALIASES,
        displaced: DisplacedPlaces = NOTHING_DISPLACED,
    ) -> SurfacePose:
        """Take a measured fit into the window and give the pose.

        elsewhere: what was found of `elsewhere`. aliases: (K,) mm, how far away the surface may as well be.
        """
        assert fit.measured
        surface, sigma = self._surface, np.maximum(observations.sigma, self.settings.floor_sigma)
        sound = self.may_learn(fit) and not len(aliases) and not displaced.whole
        surface.displaced = displaced
        surface.unlearned = fit, observations, fit.stamp - surface.pose.stamp, sound
        if sound and self._smear(fit) < MAX_LEARNING_SMEAR_MM:
            surface.warp.learn(observations, fit.solution, sigma, fit.twist, self.cameras.delays.sigma)
        surface.accepted += 1
        surface.detector(fit.stamp, fit.solution.base_from_surface, fit.parts.noise)
        self._update_health(fit)
        self.health.rivals.update(self.rig, fit.stamp, fit.solution.base_from_surface, fit.rivals, fit.outliers)
        surface.local(observations, fit, sigma, surface.map, self._smear(fit))
        surface.parted(observations, fit, elsewhere, surface.warp.points(surface.map))
        lasting = fit.parts.lasting + surface.calibration.covariance(fit, self.cameras)
        rebuilds = self._smoother.rebuilds
        place = fit.solution.base_from_surface @ se3.exp(fit.parts.step)
        window = self._smoother.add(MeasuredPose(fit.stamp, place, fit.parts.noise))
        late = self.cameras.delays.sigma
        unsteady = f"the cameras expose {late:.3f} s apart, now more, now less" if late > MAX_DELAY_SIGMA_S else ""
        quality = Measurement(
            cameras=tuple(self.rig.cameras[c].name for c in self.carrying_cameras(fit)),
            tracks=int(fit.used.sum()),
            sigma=position_sigma(fit.covariance + lasting),
            trouble=self.health.trouble(fit.stamp),
            caveat=alias_message(aliases)
            or displaced.message
            or surface.parted.message
            or surface.local.message
            or surface.caveat
            or unsteady,
            deformation=0.0 if surface.warp.warp is None else surface.warp.warp.deformation,
            rebuilds=self._smoother.rebuilds if self._smoother.rebuilds > rebuilds else 0,
        )
        pose = self._enter(window, fit.parts.smear, lasting, *self._states.measured(fit.stamp, quality))
        given = surface.reported.measured(pose, fit, self.cameras, surface.first, window)
        given = widened(given, alias_covariance(aliases)) if len(aliases) else given
        given = widened(given, displaced.covariance) if displaced.whole else given
        if self.health.rivals.doubted or unsteady:
            way = bool(unsteady) * MOST_DELAY_SIGMAS * late * fit.twist
            given = widened(given, self.health.rivals.covariance + np.outer(way, way))
        surface.reported_pose = surface.parted.covering(given)
        return surface.reported_pose

    def _update_health(self, fit: FrameFit) -> None:
        used = fit.used if fit.measured else np.zeros_like(fit.used)
        # a rejected fit makes no new outliers
        outliers = fit.outliers if fit.measured else fit.outliers & self.health.left_out
        self.health.update(fit.stamp, used, self._min_camera_tracks(), fit.offsets, fit.allowed, outliers)

    def _enter(
        self, window: WindowEstimate, smear: Array, lasting: Array, state: TrackState, reason: str
    ) -> SurfacePose:
        """The pose that the window gives; its covariance is the window's marginal + smear + lasting errors.

        The smear (late exposures) is not averaged: its size is learned slowly, and it errs along the motion. As part of
        the noise it made the window believe its prior: a third farther off a waved board than the fit alone.
        """
        surface, stamp = self._surface, window.stamp
        step = max(1e-3, stamp - self._measured_stamp)
        self._measured_stamp, surface.psd = stamp, window.acceleration_psd
        if surface.first is not None:
            lasting = lasting + surface.first
        elif state.measured:
            surface.first = window.covariance + smear
        entered = SurfacePose(
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
        entered = replace(entered, forecast=surface.predictor.add(entered, lasting))
        surface.pose = surface.measured = surface.reported_pose = entered
        return entered

    def coast(self, fit: FrameFit) -> SurfacePose:
        """No measurement at `fit.stamp`: predict from the last one. The pose's reason tells why, and since when."""
        surface = self._surface
        self._update_health(fit)
        why = "; ".join(filter(None, (fit.reason, self.health.trouble(fit.stamp, at_once=True))))
        state, reason = self._states.missed(fit.stamp, why)
        predicted = surface.measured.predict(fit.stamp)
        if state is TrackState.LOST:  # so old a velocity would carry the pose away; which camera was wrong is as old
            self.health.left_out = frozenset()
            stays = surface.measured.predict(surface.measured.stamp + self.settings.states.coast)
            predicted = replace(predicted, base_from_surface=stays.base_from_surface, twist=np.zeros(6), forecast=None)
        surface.pose = replace(predicted, state=state, reason=reason)
        surface.reported_pose = surface.parted.covering(surface.reported.missed(surface.pose))
        return surface.reported_pose

    def replace_map(self, surface_map: SurfaceMap, crooked: bool = False, bent: bool = False) -> None:
        """Take a refined or longer map of the same surface frame; rows keep their meaning.

        crooked: the map before was a first map, whose own error looked like a deformation. bent: it was bent by a
        deformation, and this one is not: then what was lately learned of the clocks was the deformation too.
        """
        surface = self._surface
        assert len(surface_map) >= len(surface.map)
        if crooked:
            surface.warp = WarpFilter(surface_map)
        else:
            surface.warp.replace_map(surface_map, right=bent)
        if bent:
            self.cameras, surface.map_held = self._earlier_cameras.before, True
        surface.map, surface.map_error = surface_map, MapError(surface_map)
        self.health.bumps.unequal.forget()
