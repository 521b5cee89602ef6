"""Selection of key frames, and delayed bundle adjustment of the map over them.

The adjustment may run in another process. Its map comes into force a fixed number of frame sets later, so poses do not
depend on that process's speed. In a live run, where no pose may wait, a late map comes into force when it is ready.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import replace
from typing import Any, Generic, TypeVar

import numpy as np

from estimation import se3
from estimation.mapping.bundle_adjustment import (
    FREE_SIGMA_MM,
    AdjustedMap,
    Anchors,
    KeyFrame,
    adjust,
    fit_single_camera,
)
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
READY_AFTER_S = 0.3  # time limit of an adjustment (0.2 s of a core); a later result is waited for

MAX_KEYFRAMES = 20  # 40 improved the pose by nothing and cost four times as much
VIEW_ANGLE, VIEW_SHIFT = 0.07, 0.04  # rad, and ratio to the cameras' distance: a larger change is a new view
SAME_VIEW_INTERVAL_S = 0.4  # between key frames of one view: a few of them average the tracks' noise
MAX_SAME_VIEW_KEYFRAMES = 6
READJUST_DELAY_RATIO = 0.5  # fall of the delays' sigma after which the same key frames are adjusted again
MIN_TRACK_SIGMA_PX = 0.1
MIN_AGREEING_TRACKS = 12  # of a camera: fewer may agree by chance, or less than half of its tracks


def sets_until_ready(interval: float) -> int:
    """Number of frame sets, `interval` s apart, after which an adjustment's result comes into force."""
    return max(math.ceil(READY_AFTER_S / interval - 1e-6), MIN_DELAY_SETS) if interval > 0 else MIN_DELAY_SETS


class DelayedJob(Generic[T]):
    """One job at a time, in an executor or, without one, in `poll`; the results are the same."""

    def __init__(self, executor: Executor | None = None, delay: int = MIN_DELAY_SETS, waits: bool = True) -> None:
        """delay: frame sets from a submission until its result comes into force. executor: may break down.

        waits: whether `poll` waits for a result that is due but not ready. If not, the result comes later, and `late`
            counts it.
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
        """Discard the job under way."""
        self._job = self._future = None

    def submit(self, function: Callable[..., T | None], *arguments: Any) -> None:
        """Begin a job; function and arguments must survive pickling. Only when not busy."""
        assert self._job is None
        self._job, self._due = (function, arguments), self._count + self.delay
        self._future = None if self._executor is None else self._executor.submit(function, *arguments)

    def poll(self) -> T | None:
        """The result that is due now, or None. Call it once a frame set."""
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
    """Keeps the key frames of one surface, and starts an adjustment after each new one."""

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
        """Number of refined maps that were not ready when due."""
        return self._work.late

    def begin(self, surface_map: SurfaceMap, stamp: float, pose: Array, observations: Observations) -> None:
        """Start with the first map and its frame set, whose pose defines the surface frame."""
        self._map, self._frames, self._stamps, self._anchors = surface_map, [], [], None
        self._work.cancel()
        self._due, self._confirmed = False, None
        self._keep(stamp, pose, observations, np.zeros(6))

    def speed(self, fit: FrameFit) -> Array:
        """Mean twist (6,), rad/s and mm/s, from the first key frame's pose to a fit."""
        moved = se3.log(se3.inverse(self._frames[0].base_from_surface) @ fit.solution.base_from_surface)
        return np.asarray(moved / (fit.stamp - self._stamps[0]))

    def confirm(self, fit: FrameFit, observations: Observations, delays: Delays) -> AdjustedMap | None:
        """Correct the first map at once by the second frame set: motion between exposures looks like depth in one."""
        assert self._map is not None
        first, pose, twist = self._frames[0], fit.solution.base_from_surface, self.speed(fit)
        second = KeyFrame(pose, _inliers(self._rig, self._map, pose, observations), twist)
        self._frames = [KeyFrame(first.base_from_surface, first.observations, twist), second]
        self._stamps = [self._stamps[0], fit.stamp]
        return self._at_once(delays)

    def rebuild(self, fit: FrameFit, observations: Observations, delays: Delays) -> AdjustedMap | None:
        """Add a frame set and adjust at once, before its pose is reported: for a fast surface."""
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
        """Change the surface frame by new_from_old (4, 4). surface_map: in the new frame, same rows."""
        turned = se3.adjoint(new_from_old)
        old_from_new = se3.inverse(new_from_old)
        self._map, self._anchors = surface_map, anchors
        self._confirmed = AdjustedMap(surface_map, np.ones(len(surface_map), bool))
        self._frames = [
            KeyFrame(f.base_from_surface @ old_from_new, f.observations, turned @ f.twist) for f in self._frames
        ]

    def offer(self, fit: FrameFit, observations: Observations, twist: Array, delays: Delays) -> None:
        """Offer a measured frame set; `poll` keeps it if its view is new."""
        self.interval, self._before = max(float(np.nan_to_num(fit.stamp - self._before)), 0.0), fit.stamp
        self._offered, self._delays = (fit, observations, twist), delays

    def withdraw(self) -> None:
        """Withdraw the frame set offered last."""
        self._offered = None

    def freeze(self) -> AdjustedMap | None:
        """Call it instead of `poll` while the surface deforms: returns, once, to the confirmed map.

        An adjustment would average key frames of different shapes. Key frames are still selected, for their other
        uses.
        """
        self._choose()
        self._due = False
        if self._confirmed is None or self._map is None:
            return None
        self._work.cancel()
        back, self._confirmed = self.append_new_rows(self._confirmed), None
        self._map = back.map
        return back

    def _choose(self) -> None:
        """Decide whether the frame set offered last becomes a key frame."""
        self.took_keyframe = False
        if self._offered is None or self._map is None:
            return
        fit, observations, twist = self._offered
        self._offered = None
        pose = fit.solution.base_from_surface
        alike = int(self._alike(pose).sum())
        again = alike < MAX_SAME_VIEW_KEYFRAMES and fit.stamp - self._stamps[-1] > SAME_VIEW_INTERVAL_S
        self.took_keyframe = not alike or again
        if self.took_keyframe:
            self._keep(fit.stamp, pose, observations, twist)
            self._due = True

    def _alike(self, pose: Array) -> Mask:
        """Which key frames (K,) have about the same view as `pose` (4, 4)."""
        poses = np.stack([f.base_from_surface for f in self._frames])
        turn = se3.angle_of(se3.inverse(poses) @ pose)
        shift = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
        centre = np.mean([c.base_from_camera[:3, 3] for c in self._rig.cameras], axis=0)
        far = VIEW_SHIFT * np.linalg.norm(pose[:3, 3] - centre)
        return np.asarray((turn < VIEW_ANGLE) & (shift < far))

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
        size = np.linalg.norm(between[..., :3], axis=2) / VIEW_ANGLE + np.linalg.norm(between[..., 3:], axis=2) / 40.0
        size[np.diag_indices(len(poses))] = np.inf
        return 1 + int(np.argmin(np.sort(size[1:], axis=1)[:, :2].sum(1)))

    def extend(self, surface_map: SurfaceMap, level: Array | None = None) -> None:
        """Take over a map with more rows at its end.

        level: (M,) mm, of the new rows: sigma across the surface by the landmarks around, inf where unknown.
        """
        first, count = 0 if self._anchors is None else len(self._anchors.sigma), len(surface_map)
        self._map = surface_map
        if level is None or not np.isfinite(level).any():
            return
        sigma = np.full(count - first, FREE_SIGMA_MM)
        sigma[len(sigma) - len(level) :] = np.minimum(level, FREE_SIGMA_MM)
        new = Anchors(surface_map.points[first:], surface_map.normals[first:], sigma, np.zeros((6, 6)))
        self._anchors = new if self._anchors is None else self._anchors.extended(new)

    def append_new_rows(self, adjusted: AdjustedMap) -> AdjustedMap:
        """The adjusted map with the rows that were added to the map since."""
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
        """The refined map that is due now, or None. Call it once a frame set, after its pose."""
        self._choose()
        self._due |= self._delays.sigma < READJUST_DELAY_RATIO * self._doubt
        result = self._work.poll()
        if result is not None:
            result = self.append_new_rows(result)
            self._map = result.map
            trim_heap()  # of 30 MB of messages; takes 1 to 5 ms, for which no pose waits
        if self._due and not self._work.busy and self._map is not None and len(self._frames) >= 3:
            self._due = False
            self._doubt = self._delays.sigma
            self._work.delay = sets_until_ready(self.interval)
            self._work.submit(adjust, self._rig, self._map, list(self._frames), self._delays, self._anchors)
        return result


def _inliers(rig: Rig, surface_map: SurfaceMap, near: Array, observations: Observations) -> Observations:
    """Tracks that agree with the rest of their camera: the joint fit allows for delays, which hides wrong matches."""
    sigma = np.maximum(observations.sigma, MIN_TRACK_SIGMA_PX)
    seen = replace(observations, sigma=sigma)
    keep = np.zeros(len(seen), bool)
    for c in np.unique(seen.camera):
        mine = seen.camera == c
        agrees = fit_single_camera(rig, surface_map.points, seen, int(c), near).weights > INLIER_WEIGHT
        if agrees.sum() >= max(MIN_AGREEING_TRACKS, 0.5 * mine.sum()):
            keep[mine] = agrees
    return seen.select(keep)
