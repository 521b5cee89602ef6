"""The input of smoothing: observations as arrays, and rough poses and landmarks from the tracks or a run's poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.mapping.triangulation import rays, triangulate, triangulated_map
from estimation.observations import Observations
from estimation.pose import Trajectory
from estimation.pose_solver import INLIER_WEIGHT, PointTracks, solve_pose
from estimation.rig import Rig
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import SurfaceMap

MIN_SIGMA_PX = 0.1  # alignment claims less on clean images, but interpolation and lens model err by it
FIT_INTERVAL_S = 0.1  # between frame sets that are fitted one by one; the joint solution finds the way between them
MIN_FIT_LANDMARKS = 10  # of a fit
MIN_FIT_INLIERS = 5  # of them
MIN_RAY_FRAMES = 40  # frame sets in which a landmark's rays are intersected
MIN_RAY_ANGLE = 0.02  # smallest eigenvalue of its rays' information, in parts of one ray's: a degree or so between them
MAX_TRIANGULATION_SIGMAS = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class TrackArrays:
    """The N observations of K frame sets, of L landmarks."""

    stamps: Array  # (K,) s, rising
    starts: Index  # (K + 1,) where each frame set's observations begin
    camera: Index  # (N,)
    landmark: Index  # (N,) row below L
    pixels: Array  # (N, 2) undistorted
    precision: Array  # (N,) px^-2
    tracks: Index  # (L,) the id that each landmark's observations bear

    def __len__(self) -> int:
        return len(self.stamps)

    def rows(self, first: int, last: int) -> slice:
        """Rows of the observations of frame sets first <= k < last."""
        return slice(int(self.starts[first]), int(self.starts[last]))

    def only(self, frames: Index) -> TrackArrays:
        """The same of some frame sets (M,), rising."""
        counts = np.diff(self.starts)[frames]
        starts = np.concatenate([[0], np.cumsum(counts)])
        rows = np.repeat(self.starts[frames] - starts[:-1], counts) + np.arange(starts[-1])
        return replace(self._take(rows), stamps=self.stamps[frames], starts=starts)

    def landmarks(self, chosen: Mask) -> TrackArrays:
        """The same of some landmarks (L,) only."""
        mine = chosen[self.landmark]
        counts = np.add.reduceat(np.append(mine, 0), self.starts)[:-1] * (np.diff(self.starts) > 0)
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        row = (np.cumsum(chosen) - 1)[self.landmark[mine]]
        return replace(self._take(mine), starts=starts, landmark=row, tracks=self.tracks[chosen])

    def _take(self, rows: Index | Mask) -> TrackArrays:
        observations = self.camera[rows], self.landmark[rows], self.pixels[rows], self.precision[rows]
        return TrackArrays(self.stamps, self.starts, *observations, self.tracks)


def pack_tracks(observations: Sequence[Observations], cameras: int) -> TrackArrays:
    """Observations in order of stamp; InputError where that does not rise or a camera is not the rig's."""
    where = "observations"
    stamps = np.array([seen.stamp for seen in observations], float)
    if len(stamps) < 2:
        raise InputError(where, "frame sets", len(stamps), "two or more")
    if not np.isfinite(stamps).all() or (np.diff(stamps) <= 0).any():
        raise InputError(where, "stamps", "not rising", "each finite and later than the one before, s")
    camera = np.concatenate([seen.camera for seen in observations]).astype(np.int64)
    if len(camera) and not 0 <= camera.min() <= camera.max() < cameras:
        raise InputError(where, "camera", f"{camera.min()}..{camera.max()}", f"0..{cameras - 1}, as the rig has")
    pixels = np.concatenate([seen.pixels for seen in observations])
    sigma = np.concatenate([seen.sigma for seen in observations])
    if not np.isfinite(pixels).all() or not (np.isfinite(sigma) & (sigma > 0)).all():
        raise InputError(where, "pixels and sigma", "not finite, or a sigma <= 0", "finite px, sigma > 0 px")
    tracks, landmark = np.unique(np.concatenate([seen.track for seen in observations]), return_inverse=True)
    starts = np.concatenate([[0], np.cumsum([len(seen) for seen in observations])]).astype(np.int64)
    precision = 1 / np.maximum(sigma, MIN_SIGMA_PX) ** 2
    return TrackArrays(stamps, starts, camera, landmark.astype(np.int64), pixels, precision, tracks.astype(np.int64))


def rough_start(rig: Rig, data: TrackArrays, known: SurfaceMap | None, start: Trajectory | None) -> tuple[Array, Array]:
    """Rough poses (K, 4, 4) and landmarks (L, 3) mm, surface frame; nan where a landmark is not seen well enough.

    known: the landmarks' map where there is one; tracks count its rows. start: poses of a run, at any stamps; without
    them the first frame set that shows enough lays the surface frame, in the middle of what it shows.
    """
    points = np.full((len(data.tracks), 3), np.nan)
    if known is not None:
        if len(data.tracks) and not 0 <= data.tracks[0] <= data.tracks[-1] < len(known):
            raise InputError("observations", "track", int(data.tracks[-1]), f"a row of the map, 0..{len(known) - 1}")
        points = known.points[data.tracks].copy()
    poses = _fitted(rig, data, points, known is not None) if start is None else at_stamps(start, data.stamps)
    return poses, intersected_landmarks(rig, data, poses, points)


def at_stamps(trajectory: Trajectory, stamps: Array) -> Array:
    """Poses (K, 4, 4) at stamps (K,), s: between the trajectory's along the geodesic, beyond its ends as they are."""
    times, poses = trajectory.stamps, trajectory.base_from_surface
    if len(times) < 2:
        return np.broadcast_to(poses[0], (len(stamps), 4, 4)).copy()
    k = np.clip(np.searchsorted(times, stamps, side="right") - 1, 0, len(times) - 2)
    share = np.clip((stamps - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0)
    return se3.interpolate(poses[k], poses[k + 1], share)


def _frame_observations(data: TrackArrays, frame: int) -> Observations:
    """One frame set's observations; tracks count landmarks."""
    part = data.rows(frame, frame + 1)
    sigma = data.precision[part] ** -0.5
    return Observations(float(data.stamps[frame]), data.camera[part], data.landmark[part], data.pixels[part], sigma)


def _fitted(rig: Rig, data: TrackArrays, points: Array, mapped: bool) -> Array:
    """Poses by fits to some frame sets, one after the other; landmarks are added to `points` as they are seen."""
    first, start = _first(rig, data, points, mapped)
    stamps, poses = [data.stamps[first]], [start]
    due = stamps[0] + FIT_INTERVAL_S
    for frame in range(first + 1, len(data)):
        if data.stamps[frame] < due:
            continue
        pose = _fit(rig, _frame_observations(data, frame), points, poses[-1])
        if pose is not None:
            stamps.append(float(data.stamps[frame]))
            poses.append(pose)
            due = stamps[-1] + FIT_INTERVAL_S
    return at_stamps(Trajectory(np.array(stamps), np.stack(poses), exact=False), data.stamps)


def _first(rig: Rig, data: TrackArrays, points: Array, mapped: bool) -> tuple[int, Array]:
    """The first frame set that two cameras see enough of, and its pose; its landmarks are laid into `points`."""
    for frame in range(len(data)):
        seen = _frame_observations(data, frame)
        if len(np.unique(seen.camera)) < 2 or len(seen) < 2 * MIN_FIT_LANDMARKS:
            continue
        try:
            laid = triangulated_map(rig, seen)
        except InputError:  # they see other landmarks
            continue
        if len(laid.tracks) < MIN_FIT_LANDMARKS:
            continue
        if not mapped:
            points[laid.tracks] = laid.map.points
            return frame, laid.base_from_surface
        mine = se3.rigid_from_points(points[laid.tracks], laid.map.points)
        start = laid.base_from_surface @ mine
        fitted = _fit(rig, seen, points, start)
        return frame, start if fitted is None else fitted
    allowed = f"one in which two cameras see {MIN_FIT_LANDMARKS} landmarks alike"
    raise InputError("observations", "tracks", "no frame set", allowed)


def _fit(rig: Rig, observations: Observations, points: Array, start: Array) -> Array | None:
    """The pose (4, 4) of a frame set by landmarks known so far, or None; what it shows anew is added to them."""
    usable = np.isfinite(points[observations.track, 0])
    if usable.sum() < MIN_FIT_LANDMARKS:
        return None
    known = observations.only(usable)
    fit = solve_pose(rig, PointTracks.of(known, points[known.track]), start, scales=(8.0, 2.0), iterations=4)
    if (fit.weights > INLIER_WEIGHT).sum() < MIN_FIT_INLIERS or not np.isfinite(fit.base_from_surface).all():
        return None
    _add(rig, observations, ~usable, points, fit.base_from_surface)
    return fit.base_from_surface


def _add(rig: Rig, observations: Observations, new: Mask, points: Array, pose: Array) -> None:
    """Landmarks that two cameras see in this frame set for the first time."""
    _, index, count = np.unique(observations.track[new], return_inverse=True, return_counts=True)
    both = count[index] > 1
    if not both.any():
        return
    rows, index = np.unique(observations.track[new][both], return_inverse=True)
    sigma = observations.sigma[new][both]
    new_points, _, residual = triangulate(
        rig, index, observations.camera[new][both], observations.pixels[new][both], len(rows)
    )
    off = np.bincount(index, ((residual / sigma[:, None]) ** 2).sum(1)) / np.bincount(index) / 2
    good = np.isfinite(new_points).all(1) & (off < MAX_TRIANGULATION_SIGMAS**2)
    points[rows[good]] = se3.transform_points(se3.inverse(pose), new_points[good])


def intersected_landmarks(rig: Rig, data: TrackArrays, poses: Array, points: Array) -> Array:
    """Landmarks (L, 3): the known ones; others where rays of some frame sets meet, nan where these are all parallel."""
    missing = ~np.isfinite(points[:, 0])
    if not missing.any():
        return points
    frames = np.unique(np.linspace(0, len(data) - 1, max(MIN_RAY_FRAMES, int(len(data) ** 0.5) * 4)).astype(np.int64))
    some = data.only(frames)
    of_frame = np.repeat(frames, np.diff(some.starts))
    mine = missing[some.landmark]
    landmark, surface_from_base = some.landmark[mine], se3.inverse(poses[of_frame[mine]])
    origins, directions = rays(rig, some.camera[mine], some.pixels[mine])
    origins = (surface_from_base[:, :3, :3] @ origins[..., None])[..., 0] + surface_from_base[:, :3, 3]
    directions = (surface_from_base[:, :3, :3] @ directions[..., None])[..., 0]
    out, count = points.copy(), len(points)
    weight = np.ones(len(landmark))
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    for _ in range(4):  # rays that pass far from where the others meet count less
        normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(normal, landmark, weight[:, None, None] * across)
        np.add.at(right, landmark, weight[:, None] * (across @ origins[..., None])[..., 0])
        least = MIN_RAY_ANGLE**2 * np.maximum(np.trace(normal, 0, 1, 2), 1e-12)
        known = missing & (np.linalg.eigvalsh(normal)[:, 0] > least)
        out[known] = np.linalg.solve(normal[known], right[known][..., None])[..., 0]
        away = np.linalg.norm((across @ (out[landmark] - origins)[..., None])[..., 0], axis=1)
        away = np.where(np.isfinite(away), away, np.inf)
        usual = max(float(np.median(away[np.isfinite(away)])) if np.isfinite(away).any() else 1.0, 1e-3)
        weight = 1 / (1 + (away / (3 * usual)) ** 2) ** 2
    return out
