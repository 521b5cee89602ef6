"""Input of smoothing: observations as arrays; initial poses and landmarks from the tracks or a run's poses."""

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

MIN_SIGMA_PX = 0.1  # alignment reports less on clean images; interpolation and lens model have this error
FIT_INTERVAL_S = 0.1  # between frame sets that are fitted one by one; poses between them are interpolated
MIN_FIT_LANDMARKS = 10  # of a fit
MIN_FIT_INLIERS = 5  # of a fit
MIN_RAY_FRAMES = 40  # frame sets whose rays are intersected, at least
MIN_RAY_ANGLE = 0.02  # rad between a landmark's rays, about a degree
MAX_TRIANGULATION_SIGMAS = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class TrackArrays:
    """The N observations of K frame sets, of L landmarks."""

    stamps: Array  # (K,) s, rising
    starts: Index  # (K + 1,) first row of each frame set's observations
    camera: Index  # (N,)
    landmark: Index  # (N,) row below L
    pixels: Array  # (N, 2) undistorted
    precision: Array  # (N,) px^-2
    tracks: Index  # (L,) id of each landmark's track

    def __len__(self) -> int:
        return len(self.stamps)

    def rows(self, first: int, last: int) -> slice:
        """Rows of the observations of frame sets first <= k < last."""
        return slice(int(self.starts[first]), int(self.starts[last]))

    def select_frames(self, frames: Index) -> TrackArrays:
        """The arrays of some frame sets (M,), rising."""
        counts = np.diff(self.starts)[frames]
        starts = np.concatenate([[0], np.cumsum(counts)])
        rows = np.repeat(self.starts[frames] - starts[:-1], counts) + np.arange(starts[-1])
        return replace(self._take(rows), stamps=self.stamps[frames], starts=starts)

    def select_landmarks(self, chosen: Mask) -> TrackArrays:
        """The arrays of some landmarks, a mask (L,)."""
        rows = chosen[self.landmark]
        counts = np.add.reduceat(np.append(rows, 0), self.starts)[:-1] * (np.diff(self.starts) > 0)
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        row = (np.cumsum(chosen) - 1)[self.landmark[rows]]
        return replace(self._take(rows), starts=starts, landmark=row, tracks=self.tracks[chosen])

    def _take(self, rows: Index | Mask) -> TrackArrays:
        observations = self.camera[rows], self.landmark[rows], self.pixels[rows], self.precision[rows]
        return TrackArrays(self.stamps, self.starts, *observations, self.tracks)


def pack_tracks(observations: Sequence[Observations], cameras: int) -> TrackArrays:
    """Observations as arrays; InputError unless stamps rise, cameras are the rig's, and values are finite."""
    where = "observations"
    stamps = np.array([frame.stamp for frame in observations], float)
    if len(stamps) < 2:
        raise InputError(where, "frame sets", len(stamps), "two or more")
    if not np.isfinite(stamps).all() or (np.diff(stamps) <= 0).any():
        raise InputError(where, "stamps", "not rising", "each finite and later than the one before, s")
    camera = np.concatenate([frame.camera for frame in observations]).astype(np.int64)
    if len(camera) and not 0 <= camera.min() <= camera.max() < cameras:
        raise InputError(where, "camera", f"{camera.min()}..{camera.max()}", f"0..{cameras - 1}, as the rig has")
    pixels = np.concatenate([frame.pixels for frame in observations])
    sigma = np.concatenate([frame.sigma for frame in observations])
    if not np.isfinite(pixels).all() or not (np.isfinite(sigma) & (sigma > 0)).all():
        raise InputError(where, "pixels and sigma", "not finite, or a sigma <= 0", "finite px, sigma > 0 px")
    tracks, landmark = np.unique(np.concatenate([frame.track for frame in observations]), return_inverse=True)
    starts = np.concatenate([[0], np.cumsum([len(frame) for frame in observations])]).astype(np.int64)
    precision = 1 / np.maximum(sigma, MIN_SIGMA_PX) ** 2
    return TrackArrays(stamps, starts, camera, landmark.astype(np.int64), pixels, precision, tracks.astype(np.int64))


def initial_estimate(
    rig: Rig, data: TrackArrays, known: SurfaceMap | None, start: Trajectory | None
) -> tuple[Array, Array]:
    """Initial poses (K, 4, 4) and landmarks (L, 3) mm, surface frame; nan where a landmark is not determined.

    known: the landmarks' map where there is one, whose rows the tracks count. start: poses of a run, at any stamps;
    without them the first frame set with enough landmarks defines the surface frame, in their middle.
    """
    points = np.full((len(data.tracks), 3), np.nan)
    if known is not None:
        if len(data.tracks) and not 0 <= data.tracks[0] <= data.tracks[-1] < len(known):
            raise InputError("observations", "track", int(data.tracks[-1]), f"a row of the map, 0..{len(known) - 1}")
        points = known.points[data.tracks].copy()
    poses = (
        _fit_frames(rig, data, points, known is not None) if start is None else interpolate_poses(start, data.stamps)
    )
    return poses, intersect_rays(rig, data, poses, points)


def interpolate_poses(trajectory: Trajectory, stamps: Array) -> Array:
    """Poses (K, 4, 4) of a trajectory at stamps (K,), s; beyond its ends the first or the last one."""
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


def _fit_frames(rig: Rig, data: TrackArrays, points: Array, mapped: bool) -> Array:
    """Poses (K, 4, 4) by fits to some frame sets, one after the other; new landmarks are added to `points`."""
    first, start = _first_pose(rig, data, points, mapped)
    stamps, poses = [data.stamps[first]], [start]
    due = stamps[0] + FIT_INTERVAL_S
    for frame in range(first + 1, len(data)):
        if data.stamps[frame] < due:
            continue
        pose = _fit_frame(rig, _frame_observations(data, frame), points, poses[-1])
        if pose is not None:
            stamps.append(float(data.stamps[frame]))
            poses.append(pose)
            due = stamps[-1] + FIT_INTERVAL_S
    return interpolate_poses(Trajectory(np.array(stamps), np.stack(poses), exact=False), data.stamps)


def _first_pose(rig: Rig, data: TrackArrays, points: Array, mapped: bool) -> tuple[int, Array]:
    """The first frame set with enough landmarks in two cameras, and its pose; adds its landmarks to `points`."""
    for frame in range(len(data)):
        frame_observations = _frame_observations(data, frame)
        if len(np.unique(frame_observations.camera)) < 2 or len(frame_observations) < 2 * MIN_FIT_LANDMARKS:
            continue
        try:
            triangulated = triangulated_map(rig, frame_observations)
        except InputError:  # they see other landmarks
            continue
        if len(triangulated.tracks) < MIN_FIT_LANDMARKS:
            continue
        if not mapped:
            points[triangulated.tracks] = triangulated.map.points
            return frame, triangulated.base_from_surface
        old_from_new = se3.rigid_from_points(points[triangulated.tracks], triangulated.map.points)
        start = triangulated.base_from_surface @ old_from_new
        fitted = _fit_frame(rig, frame_observations, points, start)
        return frame, start if fitted is None else fitted
    allowed = f"one in which two cameras see {MIN_FIT_LANDMARKS} landmarks alike"
    raise InputError("observations", "tracks", "no frame set", allowed)


def _fit_frame(rig: Rig, observations: Observations, points: Array, start: Array) -> Array | None:
    """The pose (4, 4) of a frame set by the landmarks so far, or None; adds its new landmarks to `points`."""
    usable = np.isfinite(points[observations.track, 0])
    if usable.sum() < MIN_FIT_LANDMARKS:
        return None
    known = observations.select(usable)
    fit = solve_pose(
        rig, PointTracks.from_observations(known, points[known.track]), start, scales=(8.0, 2.0), iterations=4
    )
    if (fit.weights > INLIER_WEIGHT).sum() < MIN_FIT_INLIERS or not np.isfinite(fit.base_from_surface).all():
        return None
    _add_landmarks(rig, observations, ~usable, points, fit.base_from_surface)
    return fit.base_from_surface


def _add_landmarks(rig: Rig, observations: Observations, new: Mask, points: Array, pose: Array) -> None:
    """Add the landmarks that two cameras see in this frame set for the first time to `points`."""
    _, index, count = np.unique(observations.track[new], return_inverse=True, return_counts=True)
    stereo = count[index] > 1
    if not stereo.any():
        return
    rows, index = np.unique(observations.track[new][stereo], return_inverse=True)
    sigma = observations.sigma[new][stereo]
    new_points, _, residual = triangulate(
        rig, index, observations.camera[new][stereo], observations.pixels[new][stereo], len(rows)
    )
    chi2 = np.bincount(index, ((residual / sigma[:, None]) ** 2).sum(1)) / np.bincount(index) / 2
    good = np.isfinite(new_points).all(1) & (chi2 < MAX_TRIANGULATION_SIGMAS**2)
    points[rows[good]] = se3.transform_points(se3.inverse(pose), new_points[good])


def intersect_rays(rig: Rig, data: TrackArrays, poses: Array, points: Array) -> Array:
    """Landmarks (L, 3): known ones, and others by intersection of rays; nan where the rays are nearly parallel."""
    missing = ~np.isfinite(points[:, 0])
    if not missing.any():
        return points
    frames = np.unique(np.linspace(0, len(data) - 1, max(MIN_RAY_FRAMES, int(len(data) ** 0.5) * 4)).astype(np.int64))
    subset = data.select_frames(frames)
    of_frame = np.repeat(frames, np.diff(subset.starts))
    rows = missing[subset.landmark]
    landmark, surface_from_base = subset.landmark[rows], se3.inverse(poses[of_frame[rows]])
    origins, directions = rays(rig, subset.camera[rows], subset.pixels[rows])
    origins = (surface_from_base[:, :3, :3] @ origins[..., None])[..., 0] + surface_from_base[:, :3, 3]
    directions = (surface_from_base[:, :3, :3] @ directions[..., None])[..., 0]
    out, count = points.copy(), len(points)
    weight = np.ones(len(landmark))
    projections = np.eye(3) - directions[:, :, None] * directions[:, None]
    for _ in range(4):  # robust weights: rays far from the intersection count less
        information, right_side = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(information, landmark, weight[:, None, None] * projections)
        np.add.at(right_side, landmark, weight[:, None] * (projections @ origins[..., None])[..., 0])
        min_eigenvalue = MIN_RAY_ANGLE**2 * np.maximum(np.trace(information, 0, 1, 2), 1e-12)
        determined = missing & (np.linalg.eigvalsh(information)[:, 0] > min_eigenvalue)
        out[determined] = np.linalg.solve(information[determined], right_side[determined][..., None])[..., 0]
        distance = np.linalg.norm((projections @ (out[landmark] - origins)[..., None])[..., 0], axis=1)
        distance = np.where(np.isfinite(distance), distance, np.inf)
        typical = max(float(np.median(distance[np.isfinite(distance)])) if np.isfinite(distance).any() else 1.0, 1e-3)
        weight = 1 / (1 + (distance / (3 * typical)) ** 2) ** 2
    return out
