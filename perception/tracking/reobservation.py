"""Reobservation of a recording's landmarks, given map and motion: before they joined the map, in frame sets without
tracks, and where the surface was lost.

A landmark's template is cut at its first observation, and aligned wherever the landmark should be in view. Where the
motion is unknown, the surface is tracked backwards from the next frame set that has it. Observations do not change.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.batch.smoothed import Smoothed
from estimation.mapping.bundle_adjustment import fit_single_camera
from estimation.mapping.triangulation import smooth_normals
from estimation.observations import Observations, no_observations
from estimation.pose_solver import PointTracks, project, solve_pose
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.frames import DuplicateFilter, FrameSet, frame_period, pairing_tolerance
from perception.lens import Lenses
from perception.mapping.features import grey
from perception.mapping.first_map import on_rays
from perception.mapping.matcher import Matcher
from perception.mapping.patches import MIN_PATCH_CONTRAST, Pyramid, Templates, cut_templates, join
from perception.tracking.step import COARSE_REACH_PX, FINE_REACH_PX, ROUGH_START_SCALES

STAMP_TOLERANCE_S = 1e-6  # s: stamps of one frame set, as stored and as read again
MIN_OWN_TRACKS = 8  # landmarks of a camera that give the pose at its own exposure


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedSurface:
    """The surface at one instant."""

    base_from_surface: Array  # (4, 4)
    covariance: Array  # (6, 6)
    twist: Array  # (6,)
    camera_poses: Array  # (C, 4, 4), base_from_surface at each camera's exposure


class KnownMotion:
    """Map and poses of a recording, and its observations by frame set (K); their tracks are rows of `map`."""

    def __init__(self, rig: Rig, smoothed: Smoothed, observations: Sequence[Observations]) -> None:
        """rig: whose lenses undistorted the observations. observations: input of the smoother."""
        self.rig, self.smoothed = rig, smoothed
        points = smoothed.map.points
        eyes = np.mean([camera.base_from_camera[:3, 3] for camera in rig.cameras], axis=0)
        outward = se3.transform_points(se3.inverse(smoothed.states.poses[0]), eyes) - points.mean(0)
        self.map = SurfaceMap(points, smooth_normals(points, outward), smoothed.map.covariance)
        first, last = smoothed.stamps[[0, -1]]
        self.observations = [_with_map_rows(o, smoothed.tracks) for o in observations if first <= o.stamp <= last]
        self._blocks = np.einsum("ninj->nij", self.map.covariance.reshape(len(points), 3, len(points), 3))  # (L, 3, 3)
        self._covariance = smoothed.covariance[:, :6, :6]
        self._tolerance = pairing_tolerance(frame_period([smoothed.stamps]))

    def row(self, stamp: float) -> int | None:
        """Row of the frame set at `stamp`, s; None if it was not smoothed."""
        k = self._nearest(stamp)
        return k if abs(self.smoothed.stamps[k] - stamp) < STAMP_TOLERANCE_S else None

    def is_in_other_set(self, stamp: float) -> bool:
        """Whether the pictures of `stamp` are in frame sets of other stamps: a live run pairs them by arrival."""
        gap = abs(self.smoothed.stamps[self._nearest(stamp)] - stamp)
        return self.row(stamp) is None and bool(gap < self._tolerance)

    def observations_at(self, stamp: float) -> Observations:
        """The observations at `stamp`, s."""
        k = self.row(stamp)
        return no_observations(stamp) if k is None else self.observations[k]

    def unobserved(self, stamp: float) -> NDArray[np.bool_]:
        """(C, L), the landmarks that each camera does not observe at `stamp`, s."""
        out, tracks = np.ones((len(self.rig), len(self.map)), bool), self.observations_at(stamp)
        out[tracks.camera, tracks.track] = False
        return out

    def at(self, stamp: float) -> ExpectedSurface | None:
        """The surface at `stamp`, s; None outside the smoothed interval."""
        s, k = self.smoothed, self.row(stamp)
        if k is not None:
            return self._expected_surface(s.states.poses[k], self._covariance[k], s.states.twists[k])
        if not s.stamps[0] < stamp < s.stamps[-1]:
            return None
        state = s.at(np.array([stamp]))
        return self._expected_surface(state.base_from_surface[0], state.covariance[0], state.twist[0])

    def _nearest(self, stamp: float) -> int:
        return int(np.abs(self.smoothed.stamps - stamp).argmin())

    def _expected_surface(self, pose: Array, covariance: Array, twist: Array) -> ExpectedSurface:
        """The surface with its poses at each camera's exposure: by the smoothed rig, converted to the motion's."""
        exposed = pose @ se3.exp(self.smoothed.offsets[:, None] * twist)
        rigs = self.smoothed.rig, self.rig
        smoothed_poses, rig_poses = (np.stack([camera.base_from_camera for camera in rig.cameras]) for rig in rigs)
        return ExpectedSurface(pose, covariance, twist, rig_poses @ se3.inverse(smoothed_poses) @ exposed)

    def poses(self, expected: ExpectedSurface, tracks: Observations) -> Array:
        """(C, 4, 4), base_from_surface at each camera's exposure: by its own tracks where it has enough."""
        out = expected.camera_poses.copy()
        for c in range(len(out)):
            if (tracks.camera == c).sum() >= MIN_OWN_TRACKS:
                out[c] = fit_single_camera(self.rig, self.map.points, tracks, c, out[c]).base_from_surface
        return out

    def image_sigmas(self, expected: ExpectedSurface) -> tuple[Array, float]:
        """One sigma (C, L) px of each landmark's projection in each camera; and the median of the pose's share, px."""
        count, cameras = len(self.map), len(self.rig)
        camera, points = np.repeat(np.arange(cameras), count), np.tile(self.map.points, (cameras, 1))
        jacobian = project(self.rig, camera, expected.camera_poses, points)[2]
        by_pose = ((jacobian @ expected.covariance) * jacobian).sum(2).max(1)
        point_jacobian = jacobian[:, :, 3:]
        by_place = ((point_jacobian @ np.tile(self._blocks, (cameras, 1, 1))) * point_jacobian).sum(2).max(1)
        return np.sqrt(by_pose + by_place).reshape(cameras, count), float(np.sqrt(np.median(by_pose)))


def _with_map_rows(observations: Observations, ids: NDArray[np.int64]) -> Observations:
    """Observations with rows in place of ids (L,), rising; without landmarks that are not in the map."""
    row = np.minimum(np.searchsorted(ids, observations.track), len(ids) - 1)
    return replace(observations, track=row).select(ids[row] == observations.track)


MAX_RESIDUAL = 2.0  # px from the projection, plus as many sigmas: beyond, it is another spot
MIN_REOBSERVATION_SIGMA_PX = 0.1  # px: alignment reports less on clean images
MIN_VIEW_SHARE = 0.2  # of a camera's landmarks in view: on another surface 0.05 match by chance
MIN_POSE_LANDMARKS, MIN_AGREEING_SHARE = 10, 0.4  # of a pose, and share of those measured: as in a causal run
MAX_WAITING_SETS = 60  # frame sets tracked backwards, whose pictures are kept in memory


class ReferencePictures:
    """Templates of the landmarks; call `cut` with the frame sets of `stamps`."""

    def __init__(self, motion: KnownMotion) -> None:
        self.motion, self.lenses = motion, Lenses(motion.rig)
        self._first_views = _first_views(motion)
        self._templates: list[tuple[NDArray[np.int64], Templates]] = []

    @property
    def stamps(self) -> Array:
        """(M,) s, rising."""
        return self.motion.smoothed.stamps[sorted({k for k, _ in self._first_views})]

    def cut(self, frames: FrameSet) -> None:
        """Cut the templates of the landmarks whose first good observation is in this frame set."""
        motion, k, expected = self.motion, self.motion.row(frames.stamp), self.motion.at(frames.stamp)
        for frame in frames.frames if k is not None else ():
            view = self._first_views.get((k or 0, frame.camera))
            if view is None or expected is None:
                continue
            pose = motion.poses(expected, motion.observations_at(frames.stamp))[frame.camera]
            points = se3.transform_points(pose, motion.map.points[view.track])
            spots = on_rays(motion.rig, frame.camera, view.pixels, points)  # exactly those of the tracks
            points, normals = se3.transform_points(se3.inverse(pose), spots), motion.map.normals[view.track]
            templates = cut_templates(self.lenses, Pyramid(grey(frame.image)), frame.camera, pose, points, normals)
            sharp = templates.contrast > MIN_PATCH_CONTRAST
            self._templates.append((view.track[sharp], templates.take(sharp)))

    def matcher(self) -> tuple[NDArray[np.int64], Matcher] | None:
        """The rows (M,) of the landmarks with templates, and their matcher; None without any."""
        rows = np.concatenate([np.zeros(0, np.int64), *(rows for rows, _ in self._templates)])
        if not len(rows):
            return None
        surface_map, no_covariance = self.motion.map, np.zeros((0, 0))  # of their covariance
        subset = SurfaceMap(surface_map.points[rows], surface_map.normals[rows], no_covariance)
        return rows, Matcher(self.lenses, subset, join([part for _, part in self._templates]))


class Reobserver:
    """Finds a recording's landmarks in its frame sets, given in order of stamp."""

    def __init__(self, motion: KnownMotion, rows: NDArray[np.int64], matcher: Matcher) -> None:
        """rows: (M,) of the motion's map, those of the matcher's map."""
        self._motion, self._rows, self._matcher = motion, rows, matcher
        self._matcher_row = np.full(len(motion.map), -1)
        self._matcher_row[rows] = np.arange(len(rows))
        self._offset_sums = np.zeros((len(motion.rig), len(motion.map), 3))  # sums, px, from track to template; count
        self._is_new = DuplicateFilter()
        self._pending_sets: deque[tuple[float, dict[int, Pyramid]]] = deque(maxlen=MAX_WAITING_SETS)

    def __call__(self, frames: FrameSet) -> list[Observations]:
        """New observations of rows of the motion's map in this frame set and in pending ones before it; by stamp."""
        motion = self._motion
        stamp = motion.observations_at(frames.stamp).stamp  # to its last bit
        images = {f.camera: grey(f.image) for f in frames.frames}
        pyramids = {c: Pyramid(image) for c, image in images.items() if self._is_new(c, image)}
        if motion.is_in_other_set(stamp) or not pyramids:
            return []
        expected = motion.at(stamp)
        if expected is None or motion.image_sigmas(expected)[1] > COARSE_REACH_PX:
            self._pending_sets.append((stamp, pyramids))
            return []
        new = self._new_observations(stamp, pyramids, expected)
        out = self._track_backwards(stamp, pyramids, expected, joined_observations(motion.observations_at(stamp), new))
        return [part for part in (*out, new) if len(part)]

    def as_tracks(self, new: Observations) -> Observations:
        """New observations with the ids of the recording's tracks, corrected for the offset between both templates.

        A track follows the run's own template, which is centred slightly off the one cut here. The mean offset is taken
        from frame sets with both; without the correction a landmark would jump between track and new observation.
        """
        offsets = self._offset_sums[new.camera, new.track]
        pixels = new.pixels - offsets[:, :2] / np.maximum(offsets[:, 2:], 1.0)
        return replace(new, pixels=pixels, track=self._motion.smoothed.tracks[new.track])

    def _new_observations(self, stamp: float, pyramids: dict[int, Pyramid], expected: ExpectedSurface) -> Observations:
        """Of landmarks not observed in this frame set, whose projection is known to COARSE_REACH_PX."""
        motion, matcher = self._motion, self._matcher
        tracks, sigma = motion.observations_at(stamp), motion.image_sigmas(expected)[0]
        poses = motion.poses(expected, tracks)
        missing = (sigma < COARSE_REACH_PX) & motion.unobserved(stamp)
        missing[[c for c in range(len(missing)) if c not in pyramids]] = False
        coarse = bool(missing.any()) and float(np.median(sigma[missing])) > FINE_REACH_PX
        new = self._as_motion_rows(matcher.align(stamp, pyramids, {c: poses[c] for c in pyramids}, coarse=coarse))
        self._add_offsets(tracks, new)
        projected = project(motion.rig, new.camera, poses, motion.map.points[new.track])[0]
        near = np.linalg.norm(new.pixels - projected, axis=1) < MAX_RESIDUAL * (1 + sigma[new.camera, new.track])
        new = new.select(near & missing[new.camera, new.track])
        observations = joined_observations(self._as_matcher_rows(tracks), new)
        return new.select(
            np.isin(new.camera, self._showing_cameras(pyramids, expected.base_from_surface, observations))
        )

    def _add_offsets(self, tracks: Observations, new: Observations) -> None:
        """Add the offsets, px, of new observations from the tracks of the same frame set."""
        track_pixels = np.full(self._offset_sums.shape[:2] + (2,), np.nan)
        track_pixels[tracks.camera, tracks.track] = tracks.pixels
        offset = new.pixels - track_pixels[new.camera, new.track]
        close = np.linalg.norm(offset, axis=1) < MAX_RESIDUAL  # False for nan
        self._offset_sums[new.camera[close], new.track[close]] += np.c_[offset[close], np.ones(close.sum())]

    def _showing_cameras(self, pyramids: dict[int, Pyramid], pose: Array, observations: Observations) -> list[int]:
        """The cameras that observe at least MIN_VIEW_SHARE of the landmarks in view at a pose (4, 4)."""
        visible = self._matcher.in_view(list(pyramids), pose)
        counts = np.bincount(observations.camera, minlength=len(self._motion.rig))
        return [c for c, count in visible.items() if counts[c] >= MIN_VIEW_SHARE * count]

    def _track_backwards(
        self, stamp: float, pyramids: dict[int, Pyramid], expected: ExpectedSurface, observations: Observations
    ) -> list[Observations]:
        """New observations of the pending sets, tracked backwards from the set after them; by stamp.

        observations: of that set, at `stamp`, s.
        """
        matcher, rig = self._matcher, self._motion.rig
        pose, twist, out = expected.base_from_surface, expected.twist, list[Observations]()
        tracks = self._as_matcher_rows(observations)
        inlier = np.ones(len(tracks), bool)
        while self._pending_sets:
            matcher.remember(pyramids, tracks, inlier, pose)
            stamp_before, pyramids = self._pending_sets.pop()
            joint, single = matcher.flow(pyramids, pose @ se3.exp((stamp_before - stamp) * twist))
            tracks = matcher.align(stamp_before, pyramids, single, coarse=True)
            if len(tracks) < MIN_POSE_LANDMARKS:
                break
            sigma, points = np.maximum(tracks.sigma, MIN_REOBSERVATION_SIGMA_PX), matcher.map.points[tracks.track]
            point_tracks = PointTracks(tracks.camera, points, tracks.pixels, sigma)
            fit = solve_pose(rig, point_tracks, joint, scales=ROUGH_START_SCALES)
            inlier = fit.weights > 0.2
            cameras = self._showing_cameras(pyramids, fit.base_from_surface, tracks.select(inlier))
            inlier &= np.isin(tracks.camera, cameras)
            if inlier.sum() < max(MIN_POSE_LANDMARKS, MIN_AGREEING_SHARE * len(tracks)):
                break
            twist = se3.log(se3.inverse(fit.base_from_surface) @ pose) / (stamp - stamp_before)
            pose, stamp = fit.base_from_surface, stamp_before
            new = self._as_motion_rows(tracks.select(inlier))
            out.append(new.select(self._motion.unobserved(stamp_before)[new.camera, new.track]))
        self._pending_sets.clear()
        return out[::-1]

    def _as_motion_rows(self, observations: Observations) -> Observations:
        """Rows of the matcher's map as the motion's."""
        return replace(observations, track=self._rows[observations.track])

    def _as_matcher_rows(self, observations: Observations) -> Observations:
        """Rows of the motion's map as the matcher's; without landmarks that it lacks."""
        observations = observations.select(self._matcher_row[observations.track] >= 0)
        return replace(observations, track=self._matcher_row[observations.track])


def _first_views(motion: KnownMotion) -> dict[tuple[int, int], Observations]:
    """By frame set and camera, the observations at which templates are cut.

    Of each landmark: its first within MAX_RESIDUAL of the projection, in the camera that faces it most.
    """
    surface_map, out = motion.map, dict[tuple[int, int], Observations]()
    pending = np.ones(len(surface_map), bool)
    eyes = np.stack([camera.base_from_camera[:3, 3] for camera in motion.rig.cameras])
    for k, observations in enumerate(motion.observations):
        tracks = observations.select(pending[observations.track])
        expected = motion.at(tracks.stamp)
        if not len(tracks) or expected is None:
            continue
        poses = motion.poses(expected, observations)
        projected = project(motion.rig, tracks.camera, poses, surface_map.points[tracks.track])[0]
        tracks = tracks.select(np.linalg.norm(tracks.pixels - projected, axis=1) < MAX_RESIDUAL)
        towards = se3.transform_points(se3.inverse(expected.base_from_surface), eyes)[tracks.camera]
        towards = towards - surface_map.points[tracks.track]
        facing = (towards * surface_map.normals[tracks.track]).sum(1) / np.linalg.norm(towards, axis=1)
        order = np.lexsort((-facing, tracks.track))
        best = np.zeros(len(tracks), bool)
        best[order[np.unique(tracks.track[order], return_index=True)[1]]] = True
        out |= {(k, int(c)): tracks.select(best & (tracks.camera == c)) for c in np.unique(tracks.camera[best])}
        pending[tracks.track] = False
    return out


def joined_observations(first: Observations, second: Observations) -> Observations:
    """Both, at the first one's stamp."""
    names = ("camera", "track", "pixels", "sigma")
    arrays = [np.concatenate([getattr(o, name) for o in (first, second)]) for name in names]
    return Observations(first.stamp, arrays[0], arrays[1], arrays[2], arrays[3])
