"""Bundle adjustment of the map over key frames (GTSAM; 20-300 ms, outside the latency of a pose).

The unknowns are the landmarks, the surface's pose at each key frame, and its pose at each camera's own exposure, since
cameras are seldom triggered together. A factor ties the latter to the key frame's pose by the motion in between. The
surface frame is kept: on average the refined poses of the key frames agree with the published ones, so the path does
not jump under the nozzle when a better map comes into force.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from estimation import se3
from estimation.mapping.triangulation import smooth_normals
from estimation.observations import Observations
from estimation.online.camera_errors import Delays
from estimation.pose_solver import PointTracks, PoseFit, project, solve_pose
from estimation.rig import Rig, ideal_pixels
from estimation.runtime import trim_heap
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import SurfaceMap

MIN_SIGHTINGS = 3
MIN_KEYFRAMES_TO_REJECT = 6  # fewer do not distinguish a stray landmark from a bent map; rejection is final
MAX_REPROJECTION_PX = 3.0  # rolling shutters and late cameras bend images that much
FREE_SIGMA_MM = 50.0  # prior of a landmark: keeps one with few sightings finite
CAUCHY_SIGMAS = 3.0
SINGLE_CAMERA_SIGMA_MM = 1.0  # of the depth by one camera
# rad, mm: motion between the exposures of two cameras
SINGLE_CAMERA_PRIOR = np.diag([1 / 0.05**2] * 3 + [1 / 10.0**2] * 3)
MIN_DRIFT = np.array([1e-5] * 3 + [1e-3] * 3)  # rad, mm: keeps the factor well conditioned


@dataclass(frozen=True, slots=True, eq=False)
class KeyFrame:
    """A frame set that the adjustment uses."""

    base_from_surface: Array  # (4, 4)
    observations: Observations  # tracks count rows of the map
    twist: Array  # (6,) rad/s and mm/s, for the motion between the cameras' exposures


@dataclass(frozen=True, slots=True, eq=False)
class Anchors:
    """Priors of landmarks by a scan or the surface around them: each lies near a plane."""

    points: Array  # (N, 3) mm, surface frame, on the plane
    normals: Array  # (N, 3) unit
    sigma: Array  # (N,) mm across the plane; FREE_SIGMA_MM where unknown
    frame: Array  # (6, 6) covariance of the scan's pose, right perturbation, rad and mm; zero without a scan

    def extended(self, new: Anchors) -> Anchors:
        """The anchors with those of further rows."""
        points, normals = np.concatenate([self.points, new.points]), np.concatenate([self.normals, new.normals])
        return Anchors(points, normals, np.concatenate([self.sigma, new.sigma]), self.frame)


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedMap:
    """The adjusted map: same rows, same surface frame."""

    map: SurfaceMap
    agrees: Mask  # (N,) landmarks that move with the rest


def adjust(
    rig: Rig, surface_map: SurfaceMap, keyframes: list[KeyFrame], delays: Delays, anchors: Anchors | None = None
) -> AdjustedMap | None:
    """The map that fits all key frames best; None if they do not determine one.

    delays: current estimate. anchors: of the map's first rows, where there is a scan or only one camera sees them.

    Base and surface swap roles (X = surface_from_base), so that GTSAM's stock projection factor with body_P_sensor =
    base_from_camera is the measurement.
    """
    adjusted = _adjusted(rig, surface_map, keyframes, delays, anchors)
    trim_heap()
    return adjusted


def _adjusted(
    rig: Rig, surface_map: SurfaceMap, keyframes: list[KeyFrame], delays: Delays, anchors: Anchors | None
) -> AdjustedMap | None:
    sightings = np.zeros(len(surface_map), int)
    for frame in keyframes:
        np.add.at(sightings, frame.observations.track, 1)
    rows = np.nonzero(sightings >= MIN_SIGHTINGS)[0]
    if len(rows) < 12 or len(keyframes) < 2:
        return None
    graph, values = _graph(rig, surface_map, keyframes, set(rows.tolist()), delays, anchors)
    try:
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        covariance = _joint_covariance(graph.linearize(solved), rows)
    except (RuntimeError, np.linalg.LinAlgError):
        return None
    points = surface_map.points.copy()
    points[rows] = [solved.atPoint3(gtsam.symbol("l", int(r))) for r in rows]
    if not np.isfinite(points).all() or not np.isfinite(covariance).all():
        return None
    whole = surface_map.covariance.copy()
    covariance = remove_rigid_motion(covariance, points[rows])
    place = (3 * rows[:, None] + np.arange(3)).ravel()
    whole[place] = whole[:, place] = 0.0
    if anchors is not None:
        covariance = covariance + rigid_motion_covariance(points[rows], anchors.frame)
    whole[np.ix_(place, place)] = covariance
    agrees = _agreement(rig, points, keyframes, solved)
    if agrees.sum() < 12:
        return None
    refined = np.stack([_fit(rig, points, frame) for frame in keyframes])
    points = se3.transform_points(frame_change(keyframes, refined, delays.sigma), points)
    normals = surface_map.normals.copy()
    normals[agrees] = smooth_normals(points[agrees], surface_map.normals[agrees])
    return AdjustedMap(SurfaceMap(points, normals, whole), agrees)


def remove_rigid_motion(covariance: Array, points: Array) -> Array:
    """Covariance (3N, 3N) of points (N, 3) without their common rigid motion, since they define the frame.

    Points are weighted by their own precision. With equal weights one point of a single camera, unknown by centimetres
    along its ray, was measured to add a tenth of a millimetre to each of two hundred others.
    """
    motion = se3.point_jacobians(points).reshape(-1, 6) * [0.01, 0.01, 0.01, 1, 1, 1]  # of about one size
    worth = 1 / np.maximum(np.repeat(np.diag(covariance).reshape(-1, 3).sum(1), 3), MIN_DRIFT[3] ** 2)
    weighted = motion.T * worth
    projection = motion @ np.linalg.solve(weighted @ motion, weighted)
    remaining = covariance - projection @ covariance
    return np.asarray(remaining - remaining @ projection.T)


def rigid_motion_covariance(points: Array, covariance: Array) -> Array:
    """Covariance (3N, 3N) of points (N, 3) that follows from the covariance (6, 6) of their frame's pose."""
    motion = se3.point_jacobians(points).reshape(-1, 6)
    return np.asarray(motion @ covariance @ motion.T)


def frame_change(keyframes: list[KeyFrame], refined: Array, skew: float) -> Array:
    """old_surface_from_new (4, 4): makes refined poses (K, 4, 4) agree with the published ones on average.

    Both are fits to the same pixels, with the old and the new map, so the exposure delays cancel. The weight of a key
    frame falls with the motion between its cameras' exposures; with one camera it is small, as the depth's error is
    many times the map's. skew: s, one sigma of the delays.
    """
    published = np.stack([f.base_from_surface for f in keyframes])
    drift = skew * np.array([np.linalg.norm(f.twist[3:]) for f in keyframes])
    alone = np.array([len(np.unique(f.observations.camera)) < 2 for f in keyframes])
    weight = 1 / (0.05**2 + drift**2 + np.where(alone, SINGLE_CAMERA_SIGMA_MM**2, 0.0))
    change = np.eye(4)
    for _ in range(3):
        rest = se3.log(se3.inverse(published) @ refined @ se3.inverse(change))
        change = se3.exp(weight @ rest / weight.sum()) @ change
    return change


MIN_OWN_TRACKS, MAX_OFFSET_PX = 20, 0.5  # of a camera with a pose of its own; px from the joint one that are allowed


def fit_single_camera(rig: Rig, points: Array, observations: Observations, camera: int, near: Array) -> PoseFit:
    """The fit to one camera's tracks, at its own exposure, with the pose `near` (4, 4) as a weak prior."""
    mine = observations.select(observations.camera == camera)
    tracks = PointTracks.from_observations(mine, points[mine.track])
    return solve_pose(rig, tracks, near, scales=(4.0, 1.0), prior=SINGLE_CAMERA_PRIOR)


def exposed_poses(rig: Rig, surface_map: SurfaceMap | None, tracks: Observations, joint: Array) -> dict[int, Array]:
    """base_from_surface (4, 4) by camera: the `joint` one, or the camera's own where its tracks contradict that one.

    Cameras that are not triggered together see a moving surface at different places. A pose by one camera is less
    accurate.
    """
    found = dict.fromkeys(range(len(rig)), joint)
    if surface_map is None:
        return found
    for c, camera in enumerate(rig.cameras):
        mine = tracks.track[tracks.camera == c]
        if len(mine) < MIN_OWN_TRACKS:
            continue
        own = fit_single_camera(rig, surface_map.points, tracks, c, joint).base_from_surface
        poses = np.stack([joint, own])
        here, there = ideal_pixels(camera, se3.transform_points(poses, surface_map.points[mine]))[0]
        if np.median(np.linalg.norm(here - there, axis=1)) > MAX_OFFSET_PX:
            found[c] = own
    return found


def _fit(rig: Rig, points: Array, frame: KeyFrame) -> Array:
    tracks = PointTracks.from_observations(frame.observations, points[frame.observations.track])
    return solve_pose(rig, tracks, frame.base_from_surface, scales=(4.0, 1.0)).base_from_surface


def _camera_key(camera: int, frame: int) -> int:
    return int(gtsam.symbol(chr(ord("A") + camera), frame))


def _graph(
    rig: Rig,
    surface_map: SurfaceMap,
    keyframes: list[KeyFrame],
    rows: set[int],
    delays: Delays,
    anchors: Anchors | None,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    lenses = [gtsam.Cal3_S2(m[0, 0], m[1, 1], 0.0, m[0, 2], m[1, 2]) for m in rig.matrices]
    sensors = [gtsam.Pose3(c.base_from_camera) for c in rig.cameras]
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY_SIGMAS)
    for i, frame in enumerate(keyframes):
        body = gtsam.symbol("x", i)
        start = gtsam.Pose3(se3.inverse(frame.base_from_surface))
        values.insert(body, start)
        # T exp(d) has the inverse X exp(-Ad(T) d): the drift in the base frame
        carry = se3.adjoint(frame.base_from_surface)
        drift = frame.twist * delays.sigma
        along = np.outer(drift, drift) + np.diag((0.3 * np.abs(drift) + MIN_DRIFT) ** 2)
        loose = gtsam.noiseModel.Gaussian.Covariance(carry @ along @ carry.T)
        seen = frame.observations
        for c in np.unique(seen.camera):
            own = fit_single_camera(rig, surface_map.points, seen, int(c), frame.base_from_surface).base_from_surface
            values.insert(_camera_key(int(c), i), gtsam.Pose3(se3.inverse(own)))
            late = se3.exp(-carry @ frame.twist * delays.mean[c])
            graph.add(gtsam.BetweenFactorPose3(body, _camera_key(int(c), i), gtsam.Pose3(late), loose))
        for c, row, pixel, sigma in zip(seen.camera, seen.track, seen.pixels, seen.sigma, strict=True):
            if int(row) in rows:
                noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(2, float(sigma)))
                keys = _camera_key(int(c), i), gtsam.symbol("l", int(row))
                graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel, noise, *keys, lenses[c], sensors[c]))
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    graph.add(gtsam.PriorFactorPose3(gtsam.symbol("x", 0), values.atPose3(gtsam.symbol("x", 0)), held))
    far = gtsam.noiseModel.Isotropic.Sigma(3, FREE_SIGMA_MM)
    for row in sorted(rows):
        key = gtsam.symbol("l", row)
        values.insert(key, surface_map.points[row])
        if anchors is None or row >= len(anchors.sigma):
            graph.add(gtsam.PriorFactorPoint3(key, surface_map.points[row], far))
            continue
        across = np.outer(anchors.normals[row], anchors.normals[row])
        loose = FREE_SIGMA_MM**2 * (np.eye(3) - across) + anchors.sigma[row] ** 2 * across
        graph.add(gtsam.PriorFactorPoint3(key, anchors.points[row], gtsam.noiseModel.Gaussian.Covariance(loose)))
    return graph, values


def _joint_covariance(linear: gtsam.GaussianFactorGraph, rows: Index) -> Array:
    """Joint covariance (3M, 3M) of the landmarks `rows`: inverse Schur complement, all poses eliminated."""
    ordering = gtsam.Ordering()
    landmarks = [gtsam.symbol("l", int(r)) for r in rows]
    known = set(landmarks)
    poses = [key for key in linear.keyVector() if key not in known]
    for key in landmarks + poses:
        ordering.push_back(key)
    information, _ = linear.hessian(ordering)
    n = 3 * len(rows)
    cross = information[:n, n:]
    schur = information[:n, :n] - cross @ np.linalg.solve(information[n:, n:], cross.T)
    return np.asarray(np.linalg.inv((schur + schur.T) / 2), float)


def _agreement(rig: Rig, points: Array, keyframes: list[KeyFrame], solved: gtsam.Values) -> Mask:
    """Which landmarks (N,) fit at least half of their sightings, unlike points that stand still in a moving scene."""
    fits, total = np.zeros(len(points)), np.zeros(len(points))
    if len(keyframes) < MIN_KEYFRAMES_TO_REJECT:
        return np.ones(len(points), bool)
    for i, frame in enumerate(keyframes):
        seen = frame.observations
        for c in np.unique(seen.camera):
            mine = seen.camera == c
            pose = se3.inverse(solved.atPose3(_camera_key(int(c), i)).matrix())
            predicted = project(rig, seen.camera[mine], pose, points[seen.track[mine]])[0]
            away = np.linalg.norm(predicted - seen.pixels[mine], axis=1)
            limit = np.maximum(4 * CAUCHY_SIGMAS * seen.sigma[mine], MAX_REPROJECTION_PX)
            np.add.at(fits, seen.track[mine], away < limit)
            np.add.at(total, seen.track[mine], 1)
    return np.asarray((total < MIN_SIGHTINGS) | (fits >= 0.5 * total))
