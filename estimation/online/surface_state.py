"""The state of the surface's pose (TRACKING, DEGRADED, ...), and whether the surface moves or rests.

State: each threshold has two values. A fault lowers the state at once; it is raised only after a while without a
fault, so that it does not flicker.

Motion (thesis 1.3: 300 um or 0.1 degree): at rest the measured poses scatter about one place, the mean of the first
ones. A movement is a mean of the newest poses that lies farther from it than chance allows: a generalised likelihood
ratio over unknown size, direction and onset (Basseville and Nikiforov 1993, 2.4.3), for turns and for shifts apart. How
much chance allows is learned at rest, for each number of poses averaged: a covariance that is wrong by a factor, and
noise that lasts over frames, both show there. The place of rest stays fixed, so a slow drift adds up until it is seen.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from estimation import se3
from estimation.forecast.predictor import Predictor
from estimation.observations import NO_DISPLACED_PLACES, Observations
from estimation.online.deformation import WarpFilter
from estimation.online.fit import FrameFit
from estimation.online.local_motion import LocalMotion
from estimation.online.parted_texture import PartedTexture
from estimation.online.reported_covariance import CalibrationError, ReportedCovariance
from estimation.pose import MotionState, SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import LocalError, MapError, SurfaceMap

AVERAGED_POSES = (2, 4, 8)  # newest poses looked at together; one alone may be a glitch
POSES_BEFORE = 16  # before the newest ones, to which a step is compared too: lasting noise is alike in both
REST_POSES = 32  # a second of three cameras, whose mean is the place of rest
BLOCK_POSES = 8  # a part of them, whose mean must lie near that of all
MIN_SIGMA_SHARE = 0.01  # of what must be flagged: no pose is known better
ONSET_HISTORY = 4 * REST_POSES  # poses in which the onset is searched
# What counts as a movement: beyond chance it is flagged from half of these on, which leaves the other half for noise
MOVEMENT_MM, MOVEMENT_RAD = 0.3, float(np.deg2rad(0.1))  # thesis 1.3
FLAGGED_SHARE = 0.5
SETTLED_SHARE = 0.125  # the surface is at rest when a second's poses stay within that
MOTION_CHI2 = 31.0  # three degrees of freedom: 8e-7 a look, half a look an hour
MIN_HALF_SHARE = 0.4  # of their mean: so far both halves of the poses must have gone, or it was a glitch
NOISE_MEMORY_POSES = 1800.0  # a minute, over which the noise is learned
DRIFT_MEMORY_POSES = 300.0  # ten seconds: what is slower is no noise, but drift


class MotionDetector:
    """Watches the measured poses of one surface; one call a pose, about 0.2 ms."""

    def __init__(self, centre: Array) -> None:
        """centre: (3,) mm, surface frame, the place whose shift counts."""
        self._centre, self._at_centre = centre.copy(), np.hstack([-se3.hat(centre), np.eye(3)])
        self._movement = np.array([MOVEMENT_RAD, MOVEMENT_MM])
        self._floor = (MIN_SIGMA_SHARE * self._movement[:, None, None]) ** 2 * np.eye(3)
        self._anchor: Array | None = None  # the first base_from_surface, from which turns and shifts are counted
        self._stamps: deque[float] = deque(maxlen=ONSET_HISTORY)
        self._states: deque[Array] = deque(maxlen=ONSET_HISTORY)  # (2, 3) each: turn, rad, and shift, mm
        self._covariances: deque[Array] = deque(maxlen=REST_POSES)  # (2, 3, 3) each, of them
        self._rest_state: Array | None = None  # (2, 3)
        self._noise = _RestNoise()
        self.motion = MotionState()  # after the last pose

    def __call__(self, stamp: float, base_from_surface: Array, covariance: Array) -> MotionState:
        """The surface's motion after a measured pose (4, 4) with covariance (6, 6) at `stamp`, s.

        The pose is that of one frame set alone: a smoothed one follows a step too late. The covariance is that of the
        tracks' noise, without late cameras, whose part grows with the very speed that is to be detected.
        """
        if self._anchor is None:
            self._anchor = base_from_surface.copy()
        # turn and shift of the centre since the anchor, in the anchor's axes, and their covariances
        anchor, axes = self._anchor, self._anchor[:3, :3].T
        turn = se3.log(se3.inverse(anchor) @ base_from_surface)[:3]
        there, here = (t[:3, :3] @ self._centre + t[:3, 3] for t in (anchor, base_from_surface))
        turned = axes @ base_from_surface[:3, :3]
        both = np.stack([covariance[:3, :3], self._at_centre @ covariance @ self._at_centre.T])
        self._stamps.append(stamp)
        self._states.append(np.stack([turn, axes @ (here - there)]))
        self._covariances.append(turned @ both @ turned.T + self._floor)
        if self.motion.moving:
            self._settle()
        else:
            self._watch()
        return self.motion

    def _sizes(self, states: Array) -> Array:
        """Lengths (..., 2) of turns and shifts (..., 2, 3), in parts of what must be flagged."""
        return np.asarray(np.sqrt((states * states).sum(-1)) / self._movement)

    # -- moving: until it settles

    def _settle(self) -> None:
        """At rest again once the means of the last second's blocks stay together."""
        if len(self._covariances) < REST_POSES:
            return self._set_motion(moving=True, onset=self.motion.onset)
        newest = _newest(self._states, REST_POSES)
        covariance = np.array(self._covariances).mean(0)
        mean = newest.mean(0)
        deviation = newest.reshape(-1, BLOCK_POSES, 2, 3).mean(1) - mean
        white = self._noise.white(newest, covariance)
        spread = 3.5 * np.sqrt(white * np.trace(covariance, axis1=1, axis2=2) / BLOCK_POSES)
        allowed = np.maximum(SETTLED_SHARE, spread / self._movement)
        if (self._sizes(deviation).max(0) > allowed).any():
            return self._set_motion(moving=True, onset=self.motion.onset)
        self._rest_state = mean
        self._noise.begin(newest, covariance, white)
        return self._set_motion(moving=False, onset=self.motion.onset)

    # -- at rest: until it moves

    def _watch(self) -> None:
        assert self._rest_state is not None
        newest = _newest(self._states, REST_POSES)
        covariance = _newest(self._covariances, AVERAGED_POSES[0]).mean(0)
        shifted = self._sizes(newest[-AVERAGED_POSES[0] :].mean(0) - self._rest_state) > FLAGGED_SHARE
        comparisons = [(count, self._rest_state, self._noise.variance(count)) for count in AVERAGED_POSES]
        for count, since, variance in [*comparisons, (AVERAGED_POSES[0], _mean_before(newest), self._noise.step)]:
            part = newest[-count:] - since
            kind = self._moved(part, covariance, variance)
            if kind is not None and (since is self._rest_state or shifted[kind]):  # else those before hold a wrong pose
                self._covariances.clear()  # rest is a second of poses that are all later
                return self._set_motion(moving=True, onset=self._onset(since, part.mean(0), kind))
        self._noise.learn(newest, covariance)
        return self._set_motion(moving=False, onset=self.motion.onset)

    def _moved(self, part: Array, covariance: Array, variance: Array) -> int | None:
        """0 where the newest poses' mean has turned, 1 where it has shifted, None where it is at rest.

        part: (count, 2, 3) since rest, or since just before. covariance: (2, 3, 3) of one pose. variance: (2,) of their
        mean, in parts of it.
        """
        count, mean = len(part), part.mean(0)
        sizes = self._sizes(mean)
        for kind in np.flatnonzero(sizes > FLAGGED_SHARE):
            spread = covariance[kind] * variance[kind]
            halves = part[:, kind].reshape(2, -1, 3).sum(1) / (count / 2)
            along = halves @ mean[kind] / (mean[kind] @ mean[kind])
            min_along = min(MIN_HALF_SHARE, FLAGGED_SHARE / sizes[kind])
            if along.min() >= min_along and mean[kind] @ np.linalg.solve(spread, mean[kind]) > MOTION_CHI2:
                return int(kind)
        return None

    def _onset(self, since: Array, change: Array, kind: int) -> float:
        """Stamp of the first pose from which on all have gone a quarter of the way; the newest one's if it is back."""
        along = (np.array(self._states)[:, kind] - since[kind]) @ change[kind] / (change[kind] @ change[kind])
        before = np.flatnonzero(along < 0.25)
        return self._stamps[min(int(before[-1]) + 1, len(along) - 1) if len(before) else 0]

    def _set_motion(self, moving: bool, onset: float) -> None:
        since = np.zeros((2, 3)) if self._rest_state is None else self._rest_state
        newest = _newest(self._states, AVERAGED_POSES[0]).mean(0) - since
        turn, shift = np.linalg.norm(newest, axis=1).tolist()
        self.motion = MotionState(moving, onset, shift, turn)


def _mean_before(newest: Array) -> Array:
    """The mean (2, 3) of the poses just before the newest ones."""
    return np.asarray(newest[-POSES_BEFORE - AVERAGED_POSES[0] : -AVERAGED_POSES[0]].mean(0))


def _newest(rows: deque[Array], count: int) -> Array:
    """The last `count` (M, ...), or as many as there are."""
    return np.array(list(rows)[-count:])


class _RestNoise:
    """The variance of means of poses at rest, in parts of one pose's covariance; turn and shift apart."""

    POSE_COUNTS = (*AVERAGED_POSES, REST_POSES)
    FIRST_WEIGHT = 60.0  # poses that the first second's scatter is worth
    MIN_SHARE = 0.01  # of one pose's variance; no covariance is wider than that
    MAX_RISE = 4.0  # times the noise known: a movement that is not yet flagged must not pass for noise

    def __init__(self) -> None:
        self._sum = np.ones((len(self.POSE_COUNTS), 2)) / np.array(self.POSE_COUNTS)[:, None]
        self._step = np.full(2, 1 / AVERAGED_POSES[0] + 1 / POSES_BEFORE)  # of the newest poses' mean since just before
        self._weight = 0.0
        self._mean = np.zeros((2, 3))  # of the last seconds: noise is counted from here, not from the place of rest

    def white(self, states: Array, covariance: Array) -> Array:
        """Variance (2,) of single poses (N, 2, 3) by second differences, in parts of their covariance (2, 3, 3)."""
        second_differences = np.diff(states, 2, axis=0)
        return self._parts(second_differences, covariance) / 6

    def begin(self, states: Array, covariance: Array, white: Array) -> None:
        """The surface has come to rest: poses (REST_POSES, 2, 3) of it, and their white noise (2,)."""
        self._mean = states.mean(0)
        if self._weight:
            return
        noise = np.maximum(white, self._parts(states - self._mean, covariance))
        self._sum = np.maximum(noise, self.MIN_SHARE) / np.array(self.POSE_COUNTS)[:, None]
        self._step = np.maximum(noise, self.MIN_SHARE) * (1 / AVERAGED_POSES[0] + 1 / POSES_BEFORE)
        self._weight = self.FIRST_WEIGHT

    def learn(self, newest: Array, covariance: Array) -> None:
        """Take the newest poses (REST_POSES, 2, 3) at rest."""
        self._mean = self._mean + (newest[-1] - self._mean) / DRIFT_MEMORY_POSES
        deviation = np.stack([newest[-count:].sum(0) / count for count in self.POSE_COUNTS]) - self._mean
        square = np.einsum("nki,kij,nkj->nk", deviation, np.linalg.inv(covariance), deviation) / 3
        square = np.minimum(square, self.MAX_RISE * self._sum)
        self._weight = min(self._weight + 1, NOISE_MEMORY_POSES)
        self._sum = self._sum + (square - self._sum) / self._weight
        step = self._parts((newest[-AVERAGED_POSES[0] :].mean(0) - _mean_before(newest))[None], covariance)
        self._step = self._step + (np.minimum(step, self.MAX_RISE * self._step) - self._step) / self._weight

    def variance(self, count: int) -> Array:
        """(2,) of a mean of `count` poses against the place of rest, in parts of one pose's covariance."""
        return np.asarray(self._sum[self.POSE_COUNTS.index(count)] + self._sum[-1])

    @property
    def step(self) -> Array:
        """(2,) of the newest poses' mean since just before, likewise."""
        return self._step

    @staticmethod
    def _parts(deviation: Array, covariance: Array) -> Array:
        """Mean square (2,) of deviations (N, 2, 3) in parts of their covariance (2, 3, 3)."""
        square = np.einsum("nki,kij,nkj->k", deviation, np.linalg.inv(covariance), deviation)
        return np.asarray(square / (3 * len(deviation)))


@dataclass(frozen=True, slots=True)
class StateSettings:
    """Thresholds. `leave` ends TRACKING, `enter` begins it."""

    enter_cameras: int = 2  # that carry the pose: one alone hardly tells depth
    enter_tracks: int = 30
    leave_tracks: int = 20
    enter_sigma: float = 2.0  # mm, of the pose's position
    leave_sigma: float = 2.5
    enter_deformation: float = 0.2  # mm, RMS over the landmarks
    leave_deformation: float = 0.3  # a rigid pose alone is then off by half a bead in places
    averaged_poses: int = 4  # poses that are averaged before one is given out: what that is off by, all later ones are
    settle: float = 0.06  # s without a fault until TRACKING again: the second frame set of 30 a second
    coast: float = 0.5  # s without a measurement until LOST


Region = Literal["drawn", "found", "none"]  # who says what the surface is: an operator, a network, or nobody


@dataclass(frozen=True, slots=True)
class EstimatorSettings:
    """When a fit counts as a measurement."""

    min_tracks: int = 10  # six unknowns need three tracks; ten leave room to see an outlier
    min_inlier_share: float = 0.4  # of the tracks found: with fewer in agreement the surface is not what is seen
    min_camera_tracks: int = 6  # fewer say nothing of that camera,
    min_camera_share: float = 0.1  # nor does a smaller part of the map's landmarks: so many agree by chance
    max_incoherence: float = 3.0  # px, median, within a camera whatever its own pose: matches by chance, not a surface
    max_sigma: float = 50.0  # mm: a pose less certain than this is no measurement
    min_track_sigma: float = 0.1  # px: alignment states less on clean images, but interpolation and lens err by it
    states: StateSettings = field(default_factory=StateSettings)  # what a measured pose is called


@dataclass(frozen=True, slots=True)
class Measurement:
    """What a measured pose stands on."""

    cameras: tuple[str, ...]  # names of those that carry it
    tracks: int  # of all cameras
    sigma: float  # mm, of the position
    trouble: str = ""  # cameras that are missed, and why
    caveat: str = ""  # any other reservation
    deformation: float = 0.0  # mm, of the surface
    rebuilds: int = 0  # of the window after an exception of GTSAM, so far; 0: not now


class PoseStateMachine:
    """Remembers the state, and since when nothing spoke against TRACKING."""

    def __init__(self, settings: StateSettings | None = None) -> None:
        self.settings = settings or StateSettings()
        self.state = TrackState.INITIALISING
        self._bad_stamp = float("-inf")  # s, of the last pose with a fault
        self._measured_stamp = float("-inf")
        self._poses = 0  # measured since the first map

    def begin(self, stamp: float) -> tuple[TrackState, str]:
        """A first map, made at `stamp`."""
        self.state, self._bad_stamp, self._measured_stamp = TrackState.INITIALISING, float("-inf"), stamp
        self._poses = 0
        return self.state, "a first map, to be confirmed"

    def measured(self, stamp: float, basis: Measurement) -> tuple[TrackState, str]:
        """State and reason of a measured pose."""
        rebuilt = f"the window of poses failed and was rebuilt, {basis.rebuilds} so far" if basis.rebuilds else ""
        fault = "; ".join(filter(None, (self._fault(basis), rebuilt)))
        if fault:
            self._bad_stamp = stamp
        elif stamp - self._bad_stamp < self.settings.settle:
            fault = f"seen well again for {stamp - self._bad_stamp:.2f} s, {self.settings.settle:.2f} s wanted"
        self._measured_stamp = stamp
        self._poses += 1
        if self._poses < self.settings.averaged_poses:
            self.state = TrackState.INITIALISING
            return self.state, f"pose {self._poses} of {self.settings.averaged_poses} that are averaged into the first"
        self.state = TrackState.DEGRADED if fault else TrackState.TRACKING
        return self.state, fault

    def _fault(self, basis: Measurement) -> str:
        """What speaks against TRACKING, or ''."""
        s, inside = self.settings, self.state is TrackState.TRACKING
        if len(basis.cameras) < s.enter_cameras:
            single = f"one camera alone carries the pose: {', '.join(basis.cameras) or 'none clearly'}"
            return f"{single}; {basis.trouble}" if basis.trouble else single
        if basis.sigma > (s.leave_sigma if inside else s.enter_sigma):
            return f"the pose is uncertain to {basis.sigma:.1f} mm"
        if basis.tracks < (s.leave_tracks if inside else s.enter_tracks):
            return f"{basis.tracks} tracks carry the pose, {s.enter_tracks} wanted"
        if basis.trouble:
            return basis.trouble
        if basis.deformation > (s.leave_deformation if inside else s.enter_deformation):
            return f"the surface is deformed by {basis.deformation:.2f} mm"
        return basis.caveat

    def missed(self, stamp: float, why: str) -> tuple[TrackState, str]:
        """State and reason of a pose that is only predicted."""
        seconds = stamp - self._measured_stamp
        self._bad_stamp = stamp
        self.state = TrackState.LOST if seconds > self.settings.coast else TrackState.COASTING
        return self.state, f"{why}; {seconds:.2f} s since the last measurement"


class MappedSurface:
    """What is known of the surface since its first map; the next first map begins it anew."""

    pose: SurfacePose  # the last one, with the covariance that decisions are made by
    reported_pose: SurfacePose  # the same with the reported covariance
    measured_pose: SurfacePose  # the last one that was measured

    def __init__(self, surface_map: SurfaceMap, rig: Rig, region: Region, caveat: str) -> None:
        self.map, self.map_error, self.warp = surface_map, MapError(surface_map), WarpFilter(surface_map)
        self.caveat, self.first_view = caveat, len(surface_map)  # what is added later is not all seen at once
        self.detector, self.predictor = MotionDetector(surface_map.points.mean(0)), Predictor(surface_map.points)
        self.local_motion = LocalMotion(len(rig), region != "none")
        self.parted = PartedTexture(rig, len(surface_map), region == "drawn")
        self.reported_covariance, self.calibration_error = ReportedCovariance(len(rig)), CalibrationError()
        self.psd = np.zeros(6)  # of the acceleration from pose to pose
        self.first_covariance: Array | None = None  # (6, 6) of the first pose given out, in which the path is placed
        # the fit that cameras' errors are to be learned from, its tracks, s since the one before, whether clocks may
        self.pending_fit: tuple[FrameFit, Observations, float, bool] | None = None
        # poses measured since the first map; whether that is held against a deformation: then no clocks are learned
        self.fit_count, self.clocks_frozen = 0, False
        self.displaced = NO_DISPLACED_PLACES  # by their colours, in the last frame set that was measured

    @property
    def local_error(self) -> LocalError | None:
        """By how much single places may be off, by displaced landmarks, groups of them, and colours."""
        error = self.parted.local_error(self.local_motion.error, self.map.points)
        places = self.displaced
        return error and error.add_bells(places.centres, places.distances**2, places.reach)
