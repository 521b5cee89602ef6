"""Where to begin: rough poses of all frame sets and rough landmarks, from the tracks alone or from a run's poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.mapping.triangulation import rays, triangulate
from estimation.observations import Observations
from estimation.online.pose_solver import solve_pose
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.smoothing.packed import Packed
from estimation.surface_map import SurfaceMap
from estimation.trajectory import Trajectory
from estimation.triangulated import triangulated

STRIDE = 0.1  # s between frame sets that are fitted one by one; the joint solution finds the way between them
LEAST = 10  # landmarks of a fit
AGREED = 5  # of them with the rest
LOOKS = 40  # frame sets in which a landmark's rays are met
APART = 0.02  # smallest eigenvalue of its rays' information, in parts of one ray's: a degree or so between them
ASTRAY = 6.0  # sigmas


def begin(rig: Rig, data: Packed, known: SurfaceMap | None, start: Trajectory | None) -> tuple[Array, Array]:
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
    return poses, met(rig, data, poses, points)


def at_stamps(trajectory: Trajectory, stamps: Array) -> Array:
    """Poses (K, 4, 4) at stamps (K,), s: between the trajectory's along the geodesic, beyond its ends as they are."""
    times, poses = trajectory.stamps, trajectory.base_from_surface
    if len(times) < 2:
        return np.broadcast_to(poses[0], (len(stamps), 4, 4)).copy()
    k = np.clip(np.searchsorted(times, stamps, side="right") - 1, 0, len(times) - 2)
    share = np.clip((stamps - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0)
    return se3.interpolate(poses[k], poses[k + 1], share)


def _seen(data: Packed, frame: int) -> Observations:
    """One frame set's observations; tracks count landmarks."""
    part = data.of(frame)
    sigma = data.precision[part] ** -0.5
    return Observations(float(data.stamps[frame]), data.camera[part], data.landmark[part], data.pixels[part], sigma)


def _fitted(rig: Rig, data: Packed, points: Array, told: bool) -> Array:
    """Poses by fits to some frame sets, one after the other; landmarks are added to `points` as they are seen."""
    first, pose = _first(rig, data, points, told)
    stamps, poses = [data.stamps[first]], [pose]
    due = stamps[0] + STRIDE
    for frame in range(first + 1, len(data)):
        if data.stamps[frame] < due:
            continue
        found = _fit(rig, _seen(data, frame), points, poses[-1])
        if found is not None:
            stamps.append(float(data.stamps[frame]))
            poses.append(found)
            due = stamps[-1] + STRIDE
    return at_stamps(Trajectory(np.array(stamps), np.stack(poses), exact=False), data.stamps)


def _first(rig: Rig, data: Packed, points: Array, told: bool) -> tuple[int, Array]:
    """The first frame set that two cameras see enough of, and its pose; its landmarks are laid into `points`."""
    for frame in range(len(data)):
        seen = _seen(data, frame)
        if len(np.unique(seen.camera)) < 2 or len(seen) < 2 * LEAST:
            continue
        laid = triangulated(rig, seen)
        if len(laid.tracks) < LEAST:
            continue
        if not told:
            points[laid.tracks] = laid.map.points
            return frame, laid.base_from_surface
        mine = se3.rigid_from_points(points[laid.tracks], laid.map.points)
        start = laid.base_from_surface @ mine
        found = _fit(rig, seen, points, start)
        return frame, start if found is None else found
    raise InputError("observations", "tracks", "no frame set", f"one in which two cameras see {LEAST} landmarks alike")


def _fit(rig: Rig, seen: Observations, points: Array, start: Array) -> Array | None:
    """The pose (4, 4) of a frame set by landmarks known so far, or None; what it shows anew is added to them."""
    usable = np.isfinite(points[seen.track, 0])
    if usable.sum() < LEAST:
        return None
    known = seen.only(usable)
    fit = solve_pose(
        rig, known.camera, points[known.track], known.pixels, known.sigma, start, scales=(8.0, 2.0), iterations=4
    )
    if (fit.weights > 0.2).sum() < AGREED or not np.isfinite(fit.base_from_surface).all():
        return None
    _add(rig, seen, ~usable, points, fit.base_from_surface)
    return fit.base_from_surface


def _add(rig: Rig, seen: Observations, new: NDArray[np.bool_], points: Array, pose: Array) -> None:
    """Landmarks that two cameras see in this frame set for the first time."""
    if not new.any():
        return
    rows, index, count = np.unique(seen.track[new], return_inverse=True, return_counts=True)
    both = count[index] > 1
    if not both.any():
        return
    rows, index = np.unique(seen.track[new][both], return_inverse=True)
    sigma = seen.sigma[new][both]
    found, _, residual = triangulate(rig, index, seen.camera[new][both], seen.pixels[new][both], len(rows))
    off = np.bincount(index, ((residual / sigma[:, None]) ** 2).sum(1)) / np.bincount(index) / 2
    good = np.isfinite(found).all(1) & (off < ASTRAY**2)
    points[rows[good]] = se3.transform_points(se3.inverse(pose), found[good])


def met(rig: Rig, data: Packed, poses: Array, points: Array) -> Array:
    """Landmarks (L, 3): those known (L, 3) as they are, others where the rays of some frame sets come nearest.

    Of a landmark whose rays are nearly parallel, nothing can be said: nan.
    """
    missing = ~np.isfinite(points[:, 0])
    if not missing.any():
        return points
    frames = np.unique(np.linspace(0, len(data) - 1, max(LOOKS, int(len(data) ** 0.5) * 4)).astype(np.int64))
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
        told = missing & (np.linalg.eigvalsh(normal)[:, 0] > APART**2 * np.maximum(np.trace(normal, 0, 1, 2), 1e-12))
        out[told] = np.linalg.solve(normal[told], right[told][..., None])[..., 0]
        away = np.linalg.norm((across @ (out[landmark] - origins)[..., None])[..., 0], axis=1)
        away = np.where(np.isfinite(away), away, np.inf)
        usual = max(float(np.median(away[np.isfinite(away)])) if np.isfinite(away).any() else 1.0, 1e-3)
        weight = 1 / (1 + (away / (3 * usual)) ** 2) ** 2
    return out
