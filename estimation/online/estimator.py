"""From observations to surface poses: robust fit to the map, honest covariance, sliding window, state.

The covariance of one fit has two parts. What is new in every frame set, the tracks' noise and shifts of whole images,
goes into the window and is averaged there. What stays from frame to frame, the map's joint error and the calibration's,
is not averaged by anything and is added to what the window says; so is what late exposures make of the motion, and the
error of the first pose that is given out, since the path is placed in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.fit import Fit, no_fit
from estimation.forecast.predictor import Predictor
from estimation.median import median
from estimation.observations import Observations
from estimation.odd_camera import SURER, contradiction, disorder, odd_ones, solve_with, standing_off, surprise
from estimation.online.camera_errors import CameraErrors, Clocks
from estimation.online.camera_health import CameraHealth, HealthSettings
from estimation.online.deformation import WarpFilter, landmarks
from estimation.online.fit import MapError, fit_covariance
from estimation.online.local_motion import LocalMotion
from estimation.online.pose_solver import PoseFit, Shared, project
from estimation.online.reported_covariance import Claim, widened
from estimation.online.surface_state import MotionDetector
from estimation.online.window import Measured, Smoother
from estimation.own_doubt import OwnDoubt
from estimation.pose import SurfacePose, TrackState, position_sigma
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.state_machine import Measurement, StateMachine, StateSettings
from estimation.surface_map import SurfaceMap

BEGINS = np.array([1e-4] * 3 + [1.0] * 3)  # rad^2/s^3, mm^2/s^3: what lies still may begin to breathe
SHARP = 0.1  # mm that cameras may see the surface apart: beyond, what is late cannot be told from what is bent
HASTY = 0.5  # mm, likewise: no print is better than that with a map so bent
PERSISTS = 0.2  # s: what breathes is accelerated alike for so long, which adds up to more than white noise does


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


class Estimator:
    """Owns the map, the window and the state of one surface."""

    def __init__(self, rig: Rig, settings: EstimatorSettings | None = None) -> None:
        self.rig = rig
        self.settings = settings or EstimatorSettings()
        self.map: SurfaceMap | None = None
        self.cameras = CameraErrors(len(rig))
        self._clocks, self._bends = Clocks(self.cameras), False  # whether the map is kept from being bent
        self.health = CameraHealth([camera.name for camera in rig.cameras], self.settings.health)
        self._states = StateMachine(self.settings.states)
        self._smoother = Smoother()
        self._detector = MotionDetector(np.zeros(3))
        self._warp: WarpFilter | None = None
        self._local = LocalMotion()
        self._map_error: MapError | None = None
        self._claim = Claim(len(rig))
        self._unlearned: tuple[Fit, Observations, float, bool] | None = None  # accepted, s since the last, and sound
        self._predictor = Predictor()
        self._pose: SurfacePose | None = None  # as decisions are made by it
        self._given: SurfacePose | None = None  # as it is claimed
        self._ahead: tuple[SurfacePose, SurfacePose] | None = None  # the pose, and as last predicted from it
        self._measured: SurfacePose | None = None  # the last one that was
        self._caveat = ""
        self._view = 0  # landmarks of the first view: what is added later is not all seen at once
        self._psd, self._step = np.zeros(6), 1.0  # of the acceleration from pose to pose; s, between them
        self._accepted = 0  # poses measured since the first map
        self._first: Array | None = None  # (6, 6) covariance of the first pose given out, in which the path is placed
        self._first_bias: Array | None = None

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

    def hasty(self, fit: Fit) -> bool:
        """Whether no pose is given out yet, and the surface moves too fast for its map to be trusted."""
        return self._first is None and self._smeared(fit) > HASTY

    def _smeared(self, fit: Fit) -> float:
        """How far, mm, the surface moves in the time by which a camera's exposure is unknown."""
        return float(np.linalg.norm(fit.twist[3:])) * self.cameras.delays.sigma

    def expected(self, stamp: float) -> SurfacePose:
        """The pose that is expected at `stamp`, as doubtful as it is searched for. Only after the first map."""
        assert self._pose is not None
        if self._ahead is None or self._ahead[0] is not self._pose or self._ahead[1].stamp != stamp:
            self._ahead = self._pose, self._pose.predict(stamp, onwards=False)
        return self._ahead[1]

    def predict(self, stamp: float) -> Array:
        """Where the surface is expected at `stamp`: (4, 4). Only after the first map."""
        return self.expected(stamp).base_from_surface

    def sigma(self) -> float:
        """Standard deviation, mm, of the last pose's position."""
        return np.inf if self._pose is None else position_sigma(self._pose.covariance)

    def fit(self, observations: Observations, start: Array, scales: tuple[float, ...] = (4.0, 1.0)) -> Fit:
        """Fit the pose to observations of the map's landmarks, from a rough pose `start` (4, 4); nothing is changed.

        observations.track counts rows of the map.
        """
        self.learn()
        assert self.map is not None and self._map_error is not None
        if len(observations) < self.settings.least_tracks:
            few = f"{len(observations)} tracks found, {self.settings.least_tracks} needed"
            return no_fit(observations, start, len(self.rig), few, self.health.left_out)
        points = landmarks(self.map, self._warp)[observations.track]
        twist, doubt = self._twist(observations.stamp, start)
        seen, moved = self._together(observations, points, start, twist)
        allowed = self.health.allowed(np.full(len(self.rig), moved))
        shared = self.cameras.shared(twist)
        solution, odd, off = self._solve(seen, points, start, scales, shared, allowed)
        inlier = solution.weights > 0.2
        used = np.bincount(seen.camera[inlier], minlength=len(self.rig))
        known = fit_covariance(seen, solution, shared, self._map_error, self._warp)
        found = int((~np.isin(seen.camera, list(odd))).sum())
        claimed = known.noise + known.smear + known.lasting
        reason = self._judge(found, used, claimed, disorder(seen, solution, inlier))
        apart = self.health.doubted(off, allowed, odd)
        if not reason and self._pose is not None:
            torn = bool(apart.any()) and not self.health.clear(used)
            reason = contradiction(seen, solution, odd, torn, self.expected(seen.stamp))
        doubted = known.bias * np.repeat(apart, 2)
        lasting = known.lasting + doubted @ doubted.T
        knowledge = known.noise, known.smear, lasting, twist, doubt, known.scatter, known.tracks, known.late, known.bias
        return Fit(seen.stamp, solution, *knowledge, inlier, used, reason, off, allowed, odd)

    def _solve(
        self,
        seen: Observations,
        points: Array,
        start: Array,
        scales: tuple[float, ...],
        shared: Shared,
        allowed: Array,
    ) -> tuple[PoseFit, frozenset[int], Array]:
        """The pose of all cameras that agree with each other, those left out of it, and how far, px, each is off it."""
        odd, least = self.health.left_out, self._camera_least()
        solution = solve_with(self.rig, seen, points, start, scales, odd, shared)
        off = standing_off(seen, solution, len(self.rig), least)
        if self._pose is None or not self.confirmed:  # a bent first map sets cameras apart
            return solution, odd, off
        most, expected = self.settings.health.out * allowed, self.expected(seen.stamp)
        apart = any(off[c] > most[c] for c in range(len(self.rig)) if c not in odd)
        if apart or surprise(solution, expected) > SURER:  # what moved may be a camera, though the others follow it
            left, within = (1, np.inf) if apart else (2, SURER)
            found = odd_ones(self.rig, seen, points, odd, most, least, expected, shared, left, within)
            if found is not None:
                return found[1], found[0], standing_off(seen, found[1], len(self.rig), least)
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

    def _together(
        self, observations: Observations, points: Array, start: Array, twist: Array
    ) -> tuple[Observations, float]:
        """The observations as cameras without offsets would have made them, with sigmas that can be believed.

        And how far, px, the surface moves in the time by which a camera's exposure is unknown.
        """
        sigma, camera = np.maximum(observations.sigma, self.settings.floor_sigma), observations.camera
        pixels = observations.pixels
        at_once, _, jacobians = project(self.rig, camera, start, points)
        sigma = self._own_doubt.widened(sigma, observations.track, jacobians)
        velocity = jacobians @ twist
        if self.cameras.offset.any():
            pixels = pixels + at_once - project(self.rig, camera, self.as_exposed(start, twist), points)[0]
        smear = self.cameras.delays.sigma * float(np.sqrt(median((velocity**2).sum(1))))
        return replace(observations, pixels=pixels, sigma=sigma), smear

    def as_exposed(self, base_from_surface: Array, twist: Array) -> Array:
        """Where the surface is (C, 4, 4) when each camera exposes, from its pose (4, 4) and twist (6,)."""
        return np.asarray(base_from_surface @ se3.exp(twist * self.cameras.offset[:, None]))

    def _judge(self, found: int, used: NDArray[np.int64], covariance: Array, among: float) -> str:
        s, agreed = self.settings, int(used.sum())
        if agreed < s.least_tracks:
            return f"{agreed} tracks agree, {s.least_tracks} needed"
        if agreed < s.least_share * found:
            return f"only {agreed} of {found} tracks agree"
        if used.max() < self._camera_least() or self.health.hidden(used):
            return f"no camera sees more than {used.max()} of {len(self.map or ())} landmarks"
        bent = not self.confirmed  # first maps of a moving surface are
        if among > s.disorder * (3.0 if bent else 1.0):
            return f"the tracks of a camera disagree among themselves by {among:.1f} px"
        spread = position_sigma(covariance)
        if not spread <= s.sigma_measured:
            return f"the pose is uncertain to {spread:.1f} mm"
        return ""

    def begin(self, stamp: float, base_from_surface: Array, surface_map: SurfaceMap, caveat: str = "") -> SurfacePose:
        """Take the first map, which defines the surface frame at `stamp`.

        caveat: what is not known of that frame's place on the tissue; as long as it stands no pose is TRACKING.
        """
        self.map, self._caveat, self._view = surface_map, caveat, len(surface_map)
        self._own_doubt, self._claim = OwnDoubt(surface_map), Claim(len(self.rig))
        self._map_error = MapError(surface_map)
        self._accepted, self._first, self._first_bias, self._bends, self._unlearned = 0, None, None, False, None
        self._smoother.reset()
        self._detector, self._warp = MotionDetector(surface_map.points.mean(0)), WarpFilter(surface_map)
        self._local = LocalMotion()
        self.health.begin()
        self._predictor = Predictor(surface_map.points)
        covariance = np.diag([1e-4**2] * 3 + [1e-3**2] * 3)  # exact by definition: the frame is what is seen here
        nothing = np.zeros((6, 6)), np.zeros((6, 6))
        return self._enter(stamp, base_from_surface, covariance, *nothing, *self._states.begin(stamp))

    def sound(self, fit: Fit) -> bool:
        """Whether map, warp and clocks may learn from a fit: what blurred or bumped cameras show would bend them."""
        blurred = self.health.blurred(fit.used, fit.off, fit.allowed, fit.odd)
        return not (fit.odd or self.health.bumps.bumped or blurred) and self.health.clear(fit.used)

    def carriers(self, fit: Fit) -> NDArray[np.int64]:
        """The cameras that carry a fit, by number."""
        return np.nonzero(fit.used >= self._camera_least())[0] if fit.measured else np.zeros(0, np.int64)

    def _camera_least(self) -> float:
        assert self.map is not None
        return max(self.settings.camera_tracks, self.settings.camera_share * self._view)

    def moving(self, twist: Array) -> None:
        """What is known of the velocity (6,) before the window can tell: the first pose's covariance needs it."""
        assert self._pose is not None
        self._pose = self._given = replace(self._pose, twist=twist)

    def wait(self, stamp: float, reason: str) -> SurfacePose:
        """The first map is not confirmed at `stamp`: the pose stands still and counts for nothing."""
        assert self._pose is not None
        self._pose = self._given = replace(self._pose, stamp=stamp, reason=reason)
        return self._given

    def learn(self) -> None:
        """Take what the last accepted fit tells of the cameras: no pose waits for it, but the next fit needs it."""
        if self._unlearned is not None:
            (fit, seen, seconds, sound), self._unlearned = self._unlearned, None
            assert fit.solution.shared is not None and self.map is not None
            exposed, on = self.as_exposed(fit.solution.base_from_surface, fit.twist), landmarks(self.map, self._warp)
            self.health.bumps.watch(self.rig, seen, on[seen.track], exposed, fit.solution.jacobians, fit.odd)
            if not sound:
                return
            if not self._bends or not self.deforms:
                self.cameras.learn(fit.solution.shared, seconds, fit.clear)
                self._clocks.keep(fit.stamp, self.cameras)
            sigma = np.maximum(seen.sigma, self.settings.floor_sigma)
            self._claim.learn(replace(seen, sigma=sigma), fit, self.cameras)

    def accept(self, fit: Fit, observations: Observations) -> SurfacePose:
        """Take a measured fit into the window and give the pose."""
        assert fit.measured and fit.solution.shared is not None and self.map is not None
        sigma = np.maximum(observations.sigma, self.settings.floor_sigma)
        if self._pose is not None:
            sound = self.sound(fit)
            self._unlearned = fit, observations, fit.stamp - self._pose.stamp, sound
            if self._warp is not None and sound and self._smeared(fit) < SHARP:
                self._warp.learn(observations, fit.solution, sigma, fit.twist, self.cameras.delays.sigma)
        self._accepted += 1
        self._detector(fit.stamp, fit.solution.base_from_surface, fit.noise)
        self._heed(fit)
        self._local(observations, fit, sigma, self.map, self._smeared(fit))
        lasting = fit.lasting + self._calibration(fit)
        seen = Measurement(
            tuple(self.rig.cameras[c].name for c in self.carriers(fit)),
            int(fit.used.sum()),
            position_sigma(fit.covariance + lasting),
            self.health.trouble(fit.stamp),
            self._local.said or self._caveat,
            0.0 if self._warp is None or self._warp.warp is None else self._warp.warp.deformation,
        )
        state, reason = self._states.measured(fit.stamp, seen)
        pose = self._enter(fit.stamp, fit.solution.base_from_surface, fit.noise, fit.smear, lasting, state, reason)
        assert self._smoother.newest is not None
        averaged = self._smoother.newest.covariance
        given = self._claim.measured(pose, fit, self.cameras, self._first, averaged)
        self._given = widened(given, self._local.covariance) if self._local.active else given
        return self._given

    def _calibration(self, fit: Fit) -> Array:
        """Covariance (6, 6) of what imperfect lenses do to the pose.

        The map was made through the same lenses, so at the start they do nothing: what counts is the change since then.
        """
        if self._first_bias is None:
            self._first_bias = fit.bias
        change = fit.bias - self._first_bias
        size = 2 * np.mean(self.cameras.shift**2)  # px^2: of six shifts of three cameras the pose takes up about half
        return np.asarray(size * change @ change.T)

    def _heed(self, fit: Fit) -> None:
        used = fit.used if fit.measured else np.zeros_like(fit.used)
        odd = fit.odd if fit.measured else fit.odd & self.health.left_out  # what is no measurement accuses nobody
        self.health.update(fit.stamp, used, self._camera_least(), fit.off, fit.allowed, odd)

    def _enter(
        self, stamp: float, pose: Array, noise: Array, smear: Array, lasting: Array, state: TrackState, reason: str
    ) -> SurfacePose:
        """Average a pose's noise in the window. What late exposures make of it is claimed whole.

        Their size is learned slowly and they err along the motion, as does an acceleration: as part of the window's
        noise they made it believe its prior, a third farther off a waved board than the fit alone.
        """
        self._step = 1.0 if self._measured is None else max(1e-3, stamp - self._measured.stamp)
        window = self._smoother.add(Measured(stamp, pose, noise))
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
            np.maximum(self._psd * max(1.0, PERSISTS / self._step), BEGINS),
            reason,
            self._detector.motion,
            None if self._warp is None else self._warp.warp,
        )
        entered = replace(entered, forecast=self._predictor.add(entered, lasting))
        self._pose = self._measured = self._given = entered
        return entered

    def coast(self, fit: Fit) -> SurfacePose:
        """No measurement at `fit.stamp`: predict from the last one, and say for how long already and why."""
        assert self._measured is not None
        self._heed(fit)
        trouble = self.health.trouble(fit.stamp, at_once=True)
        state, reason = self._states.missed(fit.stamp, f"{fit.reason}; {trouble}" if trouble else fit.reason)
        predicted, lost = self._measured.predict(fit.stamp), state is TrackState.LOST
        if lost:  # a velocity that old would carry the pose away, and which camera was wrong is as old
            self.health.forgive()
            stays = self._measured.predict(self._measured.stamp + self.settings.states.coast)
            predicted = replace(predicted, base_from_surface=stays.base_from_surface, twist=np.zeros(6), forecast=None)
        self._pose = replace(predicted, state=state, reason=reason)
        self._given = self._claim.missed(self._pose)
        return self._given

    def replace_map(self, surface_map: SurfaceMap, crooked: bool = False, bent: bool = False) -> None:
        """Take a refined or longer map of the same surface frame; rows keep their meaning.

        crooked: whether the one before was a first map, whose own error looked like a deformation. bent: whether it was
        bent by one, and this one is not: then what was learned of the clocks lately was the deformation too.
        """
        assert self.map is not None and len(surface_map) >= len(self.map)
        if crooked:
            self._warp = WarpFilter(surface_map)
        elif self._warp is not None:
            self._warp.replace_map(surface_map, right=bent)
        if bent:
            self.cameras, self._bends = self._clocks.before, True
        self.map, self._map_error, self._own_doubt = surface_map, MapError(surface_map), OwnDoubt(surface_map)
