"""The estimator on a synthetic world's tracks, fed as the tracker feeds it: its errors beside the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.mapping.bundle_adjustment import AdjustedMap
from estimation.mapping.refiner import Refiner
from estimation.mapping.triangulation import TriangulatedMap, triangulated_map
from estimation.observations import Observations
from estimation.online.estimator import Estimator
from estimation.online.surface_state import StateSettings
from estimation.pose import SurfacePose, TrackState
from estimation.pose_solver import project
from estimation.rig import Rig
from estimation.se3 import Array, Mask
from estimation.synthetic.world import SYNTHETIC_WORLD, World

MIN_FRAME_SETS = StateSettings().averaged_poses + 3  # the map's, those averaged into the first pose, two to evaluate
Mapping = Literal["told", "seen"]  # the world's own map, or one triangulated from the first frame set and refined


def pose_information(rig: Rig, base_from_surface: Array, points: Array, observations: Observations) -> Array:
    """Fisher information (6, 6) of one frame set about the right perturbation of the true pose (4, 4), rad and mm.

    rig: the true cameras. points: (N, 3) mm, the true landmarks, whose rows the tracks count. Noise is taken as white.
    """
    _, _, jacobian = project(rig, observations.camera, base_from_surface, points[observations.track])
    return np.asarray(np.einsum("nki,n,nkj->ij", jacobian, observations.sigma**-2.0, jacobian))


def pose_bound(information: Array) -> Array:
    """The least covariance (..., 6, 6) that an unbiased estimate from one frame set can have."""
    return np.asarray(np.linalg.inv(information))


def filtered_bound(informations: Iterable[Array], dt: float, acceleration_psd: Array) -> Array:
    """The least covariance (K, 6, 6) of each pose from all frame sets up to it, `dt` s apart.

    The motion is white noise on acceleration with spectral density acceleration_psd (6,), rad^2/s^3 and mm^2/s^3
    (Barfoot 2017, 11.1): the posterior bound of Tichavsky et al., IEEE TSP 46:1386 (1998), linear between frames.
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
            known[6:, 6:] += 1e-9 * one  # the first velocity is nearly unknown
        bounds.append(np.asarray(np.linalg.inv(known)[:6, :6]))
    return np.array(bounds)


class Follower:
    """Follows one surface from its first frame set and map on."""

    def __init__(self, rig: Rig, first: Observations, start: TriangulatedMap, refine: bool) -> None:
        """first: the frame set of `start`. refine: whether key frames refine the map."""
        self.estimator = Estimator(rig)
        self.refiner = Refiner(rig) if refine else None
        self._row = np.full(int(start.tracks.max(initial=-1)) + 1, -1)
        self._row[start.tracks] = np.arange(len(start.tracks))
        self._agrees = np.ones(len(start.tracks), bool)
        self.estimator.begin(first.stamp, start.base_from_surface, start.map)
        if self.refiner is not None:
            self.refiner.begin(start.map, first.stamp, start.base_from_surface, self.of_map(first))

    def __call__(self, observations: Observations) -> SurfacePose:
        """The pose at the observations' stamp from this frame set and the ones before."""
        estimator, observations = self.estimator, self.of_map(observations)
        fit = estimator.fit(observations, estimator.predict(observations.stamp))
        refiner, refined = self.refiner, None
        if not estimator.confirmed:
            if len(estimator.carrying_cameras(fit)) < 2:
                return estimator.hold(observations.stamp, fit.reason or "one camera sees the surface")
            refined = None if refiner is None else refiner.confirm(fit, observations, estimator.cameras.delays)
            if refiner is not None and refined is not None:
                estimator.set_twist(refiner.speed(fit))
        elif refiner is not None and fit.measured and not fit.outliers and estimator.too_fast_for_map(fit):
            refined = refiner.rebuild(fit, observations, estimator.cameras.delays)
        if refined is not None:
            self._take(refined)
            refit = estimator.fit(observations, fit.solution.base_from_surface)
            fit = refit if refit.measured else fit
        if not fit.measured:
            return estimator.coast(fit)
        pose = estimator.accept(fit, observations)
        if refiner is not None:
            refiner.offer(fit, observations, pose.twist, estimator.cameras.delays)
        return pose

    def idle(self) -> None:
        """Take over a refined map that is ready; called between frame sets."""
        if self.refiner is not None and (refined := self.refiner.poll()) is not None:
            self._take(refined)

    def of_map(self, observations: Observations) -> Observations:
        """The observations of landmarks in the map that agree with it, numbered by the map's rows."""
        known = observations.track < len(self._row)
        row = np.where(known, self._row[np.where(known, observations.track, 0)], -1)
        keep = row >= 0
        keep[keep] = self._agrees[row[keep]]
        return Observations(
            observations.stamp,
            observations.camera[keep],
            row[keep],
            observations.pixels[keep],
            observations.sigma[keep],
        )

    def _take(self, refined: AdjustedMap) -> None:
        self.estimator.replace_map(refined.map)
        self._agrees = refined.agrees


@dataclass(frozen=True, slots=True, eq=False)
class FollowResult:
    """A run over a world and its truth, after the first measured pose.

    That pose defines the estimated surface frame. The truth is moved into this frame once and never fitted.
    """

    poses: tuple[SurfacePose, ...]  # K of them
    seconds: Array  # (K,) s: computing time of each pose
    expected: Array  # (K, 4, 4) true base_from_surface of the estimated surface frame
    twists: Array  # (K, 6) true body velocity, rad/s and mm/s
    informations: Array  # (K, 6, 6) Fisher information of each frame set, as if it had no outliers
    frame: Array  # (6, 6) bound of the pose that places the surface frame
    offsets: Array  # (C,) s: exposure offsets as estimated at the end

    @property
    def bounds(self) -> Array:
        """(K, 6, 6) least covariance of each error from one frame set alone; inf where nothing is seen."""
        bounds = np.full_like(self.informations, np.inf)
        seen = self.informations.any(axis=(1, 2))
        bounds[seen] = pose_bound(self.informations[seen]) + self.frame
        return bounds

    def filtered_bounds(self) -> Array:
        """(K, 6, 6) the same from all frame sets so far, for this run's mean acceleration."""
        dt = self.poses[1].stamp - self.poses[0].stamp
        drive = (np.diff(self.twists, axis=0) ** 2).mean(0) / dt
        psd = np.repeat([drive[:3].mean(), drive[3:].mean()], 3)
        return filtered_bound(self.informations, dt, psd) + self.frame

    @property
    def measured(self) -> Mask:
        """Which poses (K,) are TRACKING or DEGRADED."""
        return np.array([pose.state.measured for pose in self.poses])

    @property
    def states(self) -> tuple[TrackState, ...]:
        """The sequence of states, without repetitions."""
        states = [pose.state for pose in self.poses]
        return tuple(s for i, s in enumerate(states) if not i or s is not states[i - 1])

    @property
    def errors(self) -> Array:
        """(K, 6) right perturbations, rad and mm, that make the estimated poses true."""
        estimated = np.stack([pose.base_from_surface for pose in self.poses])
        return se3.log(se3.inverse(estimated) @ self.expected)

    @property
    def covariances(self) -> Array:
        """(K, 6, 6) as reported."""
        return np.stack([pose.covariance for pose in self.poses])

    @property
    def twist_errors(self) -> Array:
        """(K, 6) true twist less the estimated one, rad/s and mm/s."""
        return np.asarray(self.twists - np.stack([pose.twist for pose in self.poses]))

    @property
    def twist_covariances(self) -> Array:
        """(K, 6, 6) as reported."""
        return np.stack([pose.twist_covariance for pose in self.poses])


def first_map(world: World, first: Observations, mapping: Mapping) -> TriangulatedMap:
    """The first map and its pose in the world's first frame set."""
    if mapping == "seen":
        return triangulated_map(world.rig, first)
    pose = world.base_from_surface(np.array(first.stamp))
    return TriangulatedMap(world.map, pose, np.arange(len(world.map)))


@dataclass(frozen=True, slots=True, eq=False)
class FollowStep:
    """One frame set of a run."""

    pose: SurfacePose
    seen: Observations
    seconds: float  # computing time of the pose, without map refinement
    offsets: Array  # (C,) s: exposure offsets as estimated by then


def follow_steps(
    world: World, mapping: Mapping = "told", clock: Callable[[], float] = lambda: 0.0
) -> Iterator[FollowStep]:
    """Run the estimator through a world, step by step; the first step only initialises it."""
    seen = world.observations()
    first = next(seen)
    follower = Follower(world.rig, first, first_map(world, first, mapping), refine=mapping == "seen")
    assert follower.estimator.pose is not None
    yield FollowStep(follower.estimator.pose, first, 0.0, follower.estimator.cameras.offset)
    for observations in seen:
        follower.idle()
        start = clock()
        pose = follower(observations)
        yield FollowStep(pose, observations, clock() - start, follower.estimator.cameras.offset)


def follow(world: World, mapping: Mapping = "told", clock: Callable[[], float] = lambda: 0.0) -> FollowResult:
    """Run the estimator over the whole world; InputError if the world is too short."""
    if len(world) < MIN_FRAME_SETS:
        allowed = f"{MIN_FRAME_SETS} or more to be followed"
        raise InputError(SYNTHETIC_WORLD, "length", f"{len(world)} frame sets", allowed)
    every = list(follow_steps(world, mapping, clock))
    given = next((i for i, step in enumerate(every) if step.pose.state.measured), 0)
    begun, rest = every[given], every[given + 1 :]
    stamps = np.array([step.pose.stamp for step in rest])
    true_start = world.base_from_surface(np.array(begun.pose.stamp))
    true_from_estimated = se3.inverse(true_start) @ begun.pose.base_from_surface
    expected = world.base_from_surface(stamps) @ true_from_estimated
    points = se3.transform_points(se3.inverse(true_from_estimated), world.landmarks.points)
    poses = zip([true_start @ true_from_estimated, *expected], [begun, *rest], strict=True)
    first, *informations = (pose_information(world.true_rig, pose, points, step.seen) for pose, step in poses)
    return FollowResult(
        poses=tuple(step.pose for step in rest),
        seconds=np.array([step.seconds for step in rest]),
        expected=expected,
        twists=world.twists(stamps) @ se3.adjoint(se3.inverse(true_from_estimated)).T,
        informations=np.stack(informations),
        frame=pose_bound(first),
        offsets=rest[-1].offsets,
    )
