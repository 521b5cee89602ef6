"""Key frames, and the refined maps made of them, which come into force at a fixed frame set.

The adjustment may run in another process. Its map is taken over a fixed number of frame sets later, so poses do not
depend on how fast that process was; only where no pose may wait for it, as in a live run, a late one is taken later.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import replace
from typing import Any, Generic, TypeVar

import numpy as np

from estimation import se3
from estimation.mapping.bundle_adjustment import FREE_SIGMA_MM, AdjustedMap, Anchors, KeyFrame, adjust, single_fit
from estimation.observations import Observations
from estimation.online.camera_errors import Delays
from estimation.online.fit import FrameFit
from estimation.pose_solver import INLIER_WEIGHT
from estimation.rig import Rig
from estimation.runtime import trim_heap
from estimation.se3 import Array, Mask
from estimation.surface_map import SurfaceMap

T = TypeVar("T")

MIN_DELAY_SETS = 3  # frame sets from the submission of a job to its result, at least
READY_AFTER_S = 0.3  # that an adjustment may take (0.2 s of a core); what is not ready by then is waited for

MAX_KEYFRAMES = 20  # 40 improved the pose by nothing and cost four times as much
VIEW_TURN, VIEW_SHIFT = 0.07, 0.04  # rad, and parts of the distance to the cameras, by which a new view differs
SAME_VIEW_INTERVAL_S = 0.4  # between key frames of the same view, of which a few average the tracks' noise
MAX_SAME_VIEW = 6
READJUST_SIGMA_RATIO = 0.5  # of the doubt about the cameras' instants: then the same key frames tell more
MIN_TRACK_SIGMA_PX = 0.1
MIN_AGREEING_TRACKS = 12  # of a camera: fewer may agree by chance, and so may less than half of those found


def sets_until_ready(interval: float) -> int:
    """The frame sets, `interval` s apart, in which a job is done on a machine that has other things to do too."""
    return max(math.ceil(READY_AFTER_S / interval - 1e-6), MIN_DELAY_SETS) if interval > 0 else MIN_DELAY_SETS


class DelayedJob(Generic[T]):
    """One job at a time, in an executor or, without one, here when it is due: the results are the same."""

    def __init__(self, executor: Executor | None = None, delay: int = MIN_DELAY_SETS, waits: bool = True) -> None:
        """executor: it may die. delay: frame sets from the next submission until its result counts.

        waits: whether a result that is not ready when it is due is waited for; else it counts once it is there, and
            `late` counts it.
        """
        self._executor, self.delay, self._waits, self.late = executor, delay, waits, 0
        self._job: tuple[Callable[..., T | None], tuple[Any, ...]] | None = None
        self._future: Future[T | None] | None = None
        self._count = self._due = 0

    @property
    def busy(self) -> bool:
        """Whether a job is under way."""
        return self._job is not None

    def cancel(self) -> None:
        """The job under way is no longer wanted."""
        self._job = self._future = None

    def submit(self, function: Callable[..., T | None], *arguments: Any) -> None:
        """Begin a job; function and arguments must survive pickling. Only when not busy."""
        assert self._job is None
        self._job, self._due = (function, arguments), self._count + self.delay
        self._future = None if self._executor is None else self._executor.submit(function, *arguments)

    def poll(self) -> T | None:
        """The result that is due now, if any; to be called once a frame set."""
        self._count += 1
        if self._job is None or self._count < self._due:
            return None
        (function, arguments), future = self._job, self._future
        if not (self._waits or future is None or future.done()):
            self.late += self._count == self._due
            return None
        self.cancel()
        try:
            return function(*arguments) if future is None else future.result()
        except BrokenExecutor:  # slower here, but the same
            self._executor = None
            return function(*arguments)


class Refiner:
    """Keeps the key frames of one surface and asks for a new map when a new one is worth it."""

    def __init__(self, rig: Rig, executor: Executor | None = None, waits: bool = True) -> None:
        """executor, waits: of the adjustment, as `DelayedJob` takes them."""
        self._rig = rig
        self._work: DelayedJob[AdjustedMap] = DelayedJob(executor, waits=waits)
        self._frames: list[KeyFrame] = []
        self._stamps: list[float] = []
        self._map: SurfaceMap | None = None
        self._confirmed: AdjustedMap | None = None  # the map as it was when the surface had hardly moved
        self._anchors: Anchors | None = None
        self._due = self.took_keyframe = False
        self._offered: tuple[FrameFit, Observations, Array] | None = None
        self._before = np.nan  # s, of the frame set offered last
        self.interval = 0.0  # s between the last two, 0 before
        self._delays = Delays(np.zeros(len(rig)), np.zeros((len(rig),) * 2))  # as known now
        self._doubt = np.inf  # s, of them at the last adjustment

    @property
    def late(self) -> int:
        """How many refined maps were not ready when they were due."""
        return self._work.late

    def begin(self, surface_map: SurfaceMap, stamp: float, pose: Array, observations: Observations) -> None:
        """The first map and the frame set that it was made from, whose pose defines the surface frame."""
        self._map, self._frames, self._stamps, self._anchors = surface_map, [], [], None
        self._work.cancel()
        self._due, self._confirmed = False, None
        self._keep(stamp, pose, observations, np.zeros(6))

    def speed(self, fit: FrameFit) -> Array:
        """The twist (6,) from the first key frame's pose to a fit."""
        moved = se3.log(se3.inverse(self._frames[0].base_from_surface) @ fit.solution.base_from_surface)
        return np.asarray(moved / (fit.stamp - self._stamps[0]))

    def confirm(self, fit: FrameFit, observations: Observations, delays: Delays) -> AdjustedMap | None:
        """Correct the first map at once by the second frame set: motion between exposures had looked like depth."""
        assert self._map is not None
        first, pose, twist = self._frames[0], fit.solution.base_from_surface, self.speed(fit)
        second = KeyFrame(pose, _inliers(self._rig, self._map, pose, observations), twist)
        self._frames = [KeyFrame(first.base_from_surface, first.observations, twist), second]
        self._stamps = [self._stamps[0], fit.stamp]
        return self._at_once(delays)

    def rebuild(self, fit: FrameFit, observations: Observations, delays: Delays) -> AdjustedMap | None:
        """One more frame set before a pose is given out: what moves fast is mapped from all of them, on the spot."""
        self._keep(fit.stamp, fit.solution.base_from_surface, observations, fit.twist)
        return self._at_once(delays)

    def _at_once(self, delays: Delays) -> AdjustedMap | None:
        assert self._map is not None
        self._delays, self._doubt = delays, delays.sigma
        refined = adjust(self._rig, self._map, self._frames, delays, self._anchors)
        if refined is not None:
            self._map = refined.map
            self._confirmed = refined
        return refined

    def reframe(self, surface_map: SurfaceMap, new_from_old: Array, anchors: Anchors) -> None:
        """The surface frame is another from now on: new_from_old (4, 4). surface_map: in the new one, same rows."""
        turned = se3.adjoint(new_from_old)
        old_from_new = se3.inverse(new_from_old)
        self._map, self._anchors = surface_map, anchors
        self._confirmed = AdjustedMap(surface_map, np.ones(len(surface_map), bool))
        self._frames = [
            KeyFrame(f.base_from_surface @ old_from_new, f.observations, turned @ f.twist) for f in self._frames
        ]

    def offer(self, fit: FrameFit, observations: Observations, twist: Array, delays: Delays) -> None:
        """A measured frame set; `poll` keeps it if it shows the surface anew."""
        self.interval, self._before = max(float(np.nan_to_num(fit.stamp - self._before)), 0.0), fit.stamp
        self._offered, self._delays = (fit, observations, twist), delays

    def withdraw(self) -> None:
        """The last frame set offered is no key frame after all."""
        self._offered = None

    def freeze(self) -> AdjustedMap | None:
        """Instead of `poll` where the surface deforms: go back, once, to the map as it was confirmed.

        Key frames of different shapes would be averaged to one that never was. They are still chosen, for their other
        uses.
        """
        self._choose()
        self._due = False
        if self._confirmed is None or self._map is None:
            return None
        self._work.cancel()
        back, self._confirmed = self.with_new_rows(self._confirmed), None
        self._map = back.map
        return back

    def _choose(self) -> None:
        """Whether the last frame set offered becomes a key frame."""
        self.took_keyframe = False
        if self._offered is None or self._map is None:
            return
        fit, observations, twist = self._offered
        self._offered = None
        pose = fit.solution.base_from_surface
        alike = int(self._alike(pose).sum())
        again = alike < MAX_SAME_VIEW and fit.stamp - self._stamps[-1] > SAME_VIEW_INTERVAL_S
        self.took_keyframe = not alike or again
        if self.took_keyframe:
            self._keep(fit.stamp, pose, observations, twist)
            self._due = True

    def _alike(self, pose: Array) -> Mask:
        """Which key frames (K,) show about what is seen at `pose`."""
        poses = np.stack([f.base_from_surface for f in self._frames])
        turn = se3.angle_of(se3.inverse(poses) @ pose)
        shift = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
        centre = np.mean([c.base_from_camera[:3, 3] for c in self._rig.cameras], axis=0)
        far = VIEW_SHIFT * np.linalg.norm(pose[:3, 3] - centre)
        return np.asarray((turn < VIEW_TURN) & (shift < far))

    def _keep(self, stamp: float, pose: Array, observations: Observations, twist: Array) -> None:
        assert self._map is not None
        self._frames.append(KeyFrame(pose, _inliers(self._rig, self._map, pose, observations), twist))
        self._stamps.append(stamp)
        if len(self._frames) > MAX_KEYFRAMES:
            worst = self._most_alike()
            del self._frames[worst], self._stamps[worst]

    def _most_alike(self) -> int:
        """The most redundant key frame, never the first."""
        poses = np.stack([f.base_from_surface for f in self._frames])
        between = se3.log(se3.inverse(poses)[:, None] @ poses[None])
        size = np.linalg.norm(between[..., :3], axis=2) / VIEW_TURN + np.linalg.norm(between[..., 3:], axis=2) / 40.0
        size[np.diag_indices(len(poses))] = np.inf
        return 1 + int(np.argmin(np.sort(size[1:], axis=1)[:, :2].sum(1)))

    def extend(self, surface_map: SurfaceMap, level: Array | None = None) -> None:
        """The map has got more rows at its end; the others are as they were.

        level: (M,) mm, of the new rows: sigma across the surface by the landmarks around, inf where they do not tell.
        """
        first, count = 0 if self._anchors is None else len(self._anchors.sigma), len(surface_map)
        self._map = surface_map
        if level is None or not np.isfinite(level).any():
            return
        sigma = np.full(count - first, FREE_SIGMA_MM)
        sigma[len(sigma) - len(level) :] = np.minimum(level, FREE_SIGMA_MM)
        new = Anchors(surface_map.points[first:], surface_map.normals[first:], sigma, np.zeros((6, 6)))
        self._anchors = new if self._anchors is None else self._anchors.extended(new)

    def with_new_rows(self, adjusted: AdjustedMap) -> AdjustedMap:
        """What was adjusted, and the rows that the map has got since."""
        assert self._map is not None
        current, count = self._map, len(adjusted.map)
        if count == len(current):
            return adjusted
        covariance = current.covariance.copy()
        covariance[: 3 * count, : 3 * count] = adjusted.map.covariance
        points = np.concatenate([adjusted.map.points, current.points[count:]])
        normals = np.concatenate([adjusted.map.normals, current.normals[count:]])
        agrees = np.concatenate([adjusted.agrees, np.ones(len(current) - count, bool)])
        return AdjustedMap(SurfaceMap(points, normals, covariance), agrees)

    def poll(self) -> AdjustedMap | None:
        """A refined map that is due now, or None. Call it once a frame set, when its pose is handed over."""
        self._choose()
        self._due |= self._delays.sigma < READJUST_SIGMA_RATIO * self._doubt
        result = self._work.poll()
        if result is not None:
            result = self.with_new_rows(result)
            self._map = result.map
            trim_heap()  # 30 MB that went to and fro as messages, in 1 to 5 ms that no pose waits for
        if self._due and not self._work.busy and self._map is not None and len(self._frames) >= 3:
            self._due = False
            self._doubt = self._delays.sigma
            self._work.delay = sets_until_ready(self.interval)
            self._work.submit(adjust, self._rig, self._map, list(self._frames), self._delays, self._anchors)
        return result


def _inliers(rig: Rig, surface_map: SurfaceMap, near: Array, observations: Observations) -> Observations:
    """Tracks that agree with the rest of their camera: in the joint fit, room for late cameras hides wrong matches."""
    sigma = np.maximum(observations.sigma, MIN_TRACK_SIGMA_PX)
    seen = replace(observations, sigma=sigma)
    keep = np.zeros(len(seen), bool)
    for c in np.unique(seen.camera):
        mine = seen.camera == c
        agrees = single_fit(rig, surface_map.points, seen, int(c), near).weights > INLIER_WEIGHT
        if agrees.sum() >= max(MIN_AGREEING_TRACKS, 0.5 * mine.sum()):
            keep[mine] = agrees
    return seen.only(keep)
