"""The estimator on the tracks of a synthetic world, fed as the tracker feeds it, and how far off its poses are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.fit import Fit
from estimation.mapping.bundle_adjustment import Adjusted
from estimation.mapping.refiner import Refiner
from estimation.observations import Observations
from estimation.online.estimator import Estimator
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.state_machine import StateSettings
from estimation.synthetic.bound import filtered_bound, pose_bound, pose_information
from estimation.synthetic.world import World
from estimation.triangulated import Triangulated, triangulated

LEAST = StateSettings().first + 3  # frame sets: the map's, those averaged into the first pose, and two to be judged
Mapping = Literal["told", "seen"]  # the world's own map; or one that is triangulated from the first look and refined


class Follower:
    """One surface, followed by its tracks from the first frame set on, whose map it is given."""

    def __init__(self, rig: Rig, first: Observations, start: Triangulated, refine: bool) -> None:
        """first: the frame set in which `start` was seen. refine: whether key frames refine the map."""
        self.estimator = Estimator(rig)
        self.refiner = Refiner(rig) if refine else None
        self._row = np.full(int(start.tracks.max(initial=-1)) + 1, -1)
        self._row[start.tracks] = np.arange(len(start.tracks))
        self._agrees = np.ones(len(start.tracks), bool)
        self.estimator.begin(first.stamp, start.base_from_surface, start.map)
        if self.refiner is not None:
            self.refiner.begin(start.map, first.stamp, start.base_from_surface, self.of_map(first))

    def __call__(self, seen: Observations) -> SurfacePose:
        """The pose at `seen.stamp` from this frame set and the ones before."""
        estimator, seen = self.estimator, self.of_map(seen)
        fit = estimator.fit(seen, estimator.predict(seen.stamp))
        if not estimator.confirmed:
            if len(estimator.carriers(fit)) < 2:
                return estimator.wait(seen.stamp, fit.reason or "one camera sees the surface")
            refined = None if self.refiner is None else self.refiner.confirm(fit, seen, estimator.cameras.delays)
            if self.refiner is not None and refined is not None:
                self._take(refined)
                estimator.moving(self.refiner.speed(fit))
                fit = self._again(fit, seen)
        elif self.refiner is not None and fit.measured and not fit.odd and estimator.hasty(fit):
            refined = self.refiner.rebuild(fit, seen, estimator.cameras.delays)
            if refined is not None:
                self._take(refined)
                fit = self._again(fit, seen)
        if not fit.measured:
            return estimator.coast(fit)
        pose = estimator.accept(fit, seen)
        if self.refiner is not None:
            self.refiner.offer(fit, seen, pose.twist, estimator.cameras.delays)
        return pose

    def _again(self, fit: Fit, seen: Observations) -> Fit:
        """The fit to a corrected map, where that is a measurement."""
        refit = self.estimator.fit(seen, fit.solution.base_from_surface)
        return refit if refit.measured else fit

    def idle(self) -> None:
        """What no pose waits for: a refined map that is due."""
        refined = None if self.refiner is None else self.refiner.poll()
        if refined is not None:
            self._take(refined)

    @property
    def offsets(self) -> Array:
        """How much later than stamped each camera exposes (C,), s, as estimated."""
        return self.estimator.cameras.offset

    def of_map(self, seen: Observations) -> Observations:
        """The observations of landmarks that are in the map and agree with it, numbered by its rows."""
        known = seen.track < len(self._row)
        row = np.where(known, self._row[np.where(known, seen.track, 0)], -1)
        keep = row >= 0
        keep[keep] = self._agrees[row[keep]]
        return Observations(seen.stamp, seen.camera[keep], row[keep], seen.pixels[keep], seen.sigma[keep])

    def _take(self, refined: Adjusted) -> None:
        self.estimator.replace_map(refined.map)
        self._agrees = refined.agrees


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """A run over a world beside its truth, after the first pose that is given out, which places the surface frame.

    poses: K of them. seconds: (K,) by the clock. Of the estimated surface frame, into which the truth is carried at the
    start, and never fitted: expected: (K, 4, 4) true base_from_surface. twists: (K, 6) true ones. informations:
    (K, 6, 6), Fisher's, of each true pose from its own tracks, were all of them right. frame: (6, 6), the least
    covariance with which one frame set could tell the pose that places the surface frame. offsets: (C,) s, of the
    cameras' instants from their stamps, as estimated at the end; None where they are not.
    """

    poses: tuple[SurfacePose, ...]
    seconds: Array
    expected: Array
    twists: Array
    informations: Array
    frame: Array
    offsets: Array

    @property
    def bounds(self) -> Array:
        """(K, 6, 6), the least covariance of each error, one frame set by itself; inf where nothing was seen.

        An estimated frame was laid by a pose that is no better than the others, and its error is in all of them.
        """
        bounds = np.full_like(self.informations, np.inf)
        seen = self.informations.any(axis=(1, 2))
        bounds[seen] = pose_bound(self.informations[seen]) + self.frame
        return bounds

    def filtered_bounds(self) -> Array:
        """(K, 6, 6), the same with all frame sets before, for a motion as lively as this one was on the whole."""
        dt = self.poses[1].stamp - self.poses[0].stamp
        drive = (np.diff(self.twists, axis=0) ** 2).mean(0) / dt
        psd = np.repeat([drive[:3].mean(), drive[3:].mean()], 3)
        return filtered_bound(self.informations, dt, psd) + self.frame

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which poses (K,) are TRACKING or DEGRADED."""
        return np.array([pose.state.measured for pose in self.poses])

    @property
    def states(self) -> tuple[TrackState, ...]:
        """The states, one after the other, each once as long as it lasts."""
        states = [pose.state for pose in self.poses]
        return tuple(s for i, s in enumerate(states) if not i or s is not states[i - 1])

    @property
    def errors(self) -> Array:
        """(K, 6) right perturbations, rad and mm, that make the estimated poses true."""
        estimated = np.stack([pose.base_from_surface for pose in self.poses])
        return se3.log(se3.inverse(estimated) @ self.expected)

    @property
    def covariances(self) -> Array:
        """(K, 6, 6) as claimed."""
        return np.stack([pose.covariance for pose in self.poses])

    @property
    def twist_errors(self) -> Array:
        """(K, 6) true twist less the estimated one, rad/s and mm/s."""
        return np.asarray(self.twists - np.stack([pose.twist for pose in self.poses]))

    @property
    def twist_covariances(self) -> Array:
        """(K, 6, 6) as claimed."""
        return np.stack([pose.twist_covariance for pose in self.poses])


def beginning(world: World, first: Observations, mapping: Mapping) -> Triangulated:
    """The map to begin with and its place in the world's first frame set."""
    if mapping == "seen":
        return triangulated(world.rig, first)
    pose = world.base_from_surface(np.array(first.stamp))
    return Triangulated(world.map, pose, np.arange(len(world.map)))


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One frame set: the pose, what was seen, the s by a clock that the pose took, and the offsets then known.

    Refinement is not counted.
    """

    pose: SurfacePose
    seen: Observations
    seconds: float
    offsets: Array


def steps(world: World, mapping: Mapping = "told", clock: Callable[[], float] = lambda: 0.0) -> Iterator[Step]:
    """The estimator's way through a world, step by step; the first one only begins."""
    seen = world.observations()
    first = next(seen)
    follower = Follower(world.rig, first, beginning(world, first, mapping), refine=mapping == "seen")
    assert follower.estimator.pose is not None
    yield Step(follower.estimator.pose, first, 0.0, follower.offsets)
    for observations in seen:
        follower.idle()
        start = clock()
        pose = follower(observations)
        yield Step(pose, observations, clock() - start, follower.offsets)


def follow(world: World, mapping: Mapping = "told", clock: Callable[[], float] = lambda: 0.0) -> Followed:
    """Run the estimator over the whole world; InputError where that is too short to be judged."""
    if len(world) < LEAST:
        raise InputError("synthetic world", "length", f"{len(world)} frame sets", f"{LEAST} or more to be followed")
    every = list(steps(world, mapping, clock))
    given = next((i for i, step in enumerate(every) if step.pose.state.measured), 0)
    begun, rest = every[given], every[given + 1 :]
    stamps = np.array([step.pose.stamp for step in rest])
    true_start = world.base_from_surface(np.array(begun.pose.stamp))
    true_from_estimated = se3.inverse(true_start) @ begun.pose.base_from_surface
    expected = world.base_from_surface(stamps) @ true_from_estimated
    points = se3.transform_points(se3.inverse(true_from_estimated), world.landmarks.points)
    poses = zip([true_start @ true_from_estimated, *expected], [begun, *rest], strict=True)
    first, *informations = (pose_information(world.true_rig, pose, points, step.seen) for pose, step in poses)
    return Followed(
        poses=tuple(step.pose for step in rest),
        seconds=np.array([step.seconds for step in rest]),
        expected=expected,
        twists=world.twists(stamps) @ se3.adjoint(se3.inverse(true_from_estimated)).T,
        informations=np.stack(informations),
        frame=pose_bound(first),
        offsets=rest[-1].offsets,
    )
