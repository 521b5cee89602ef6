"""Landmarks found again in the pictures of a recording whose map and motion are known: before they joined the map, in
frame sets that were not tracked, and where the surface was lost.

A landmark's picture is cut where it was first seen, and searched wherever it should be in view. Where the motion is not
known, the surface is followed backwards from where it is known, as a causal run follows it forwards. Earlier
observations stay as they are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.batch.smoothed import Smoothed
from estimation.mapping.bundle_adjustment import single_fit
from estimation.mapping.local_surface import smooth_normals
from estimation.observations import Observations, no_observations
from estimation.online.pose_solver import PointTracks, project, solve_pose
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.frames import DuplicateFilter, FrameSet
from perception.lens import Lenses
from perception.mapping.first_map import on_rays
from perception.matching.features import grey
from perception.matching.matcher import Matcher
from perception.matching.patches import MIN_PATCH_CONTRAST, Pyramid, Templates, cut_templates, join, pyramid
from perception.pairing import frame_period, pairing_tolerance
from perception.tracking.step import COARSE_REACH_PX, FINE_REACH_PX, ROUGH_START_SCALES

STAMP_TOLERANCE_S = 1e-6  # s: stamps of one frame set, as stored and as read again
MIN_OWN_TRACKS = 8  # landmarks that tell where the surface was at a camera's own instant


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedSurface:
    """The surface at one instant: base_from_surface (4, 4), its covariance (6, 6) and twist (6,), and where it is when
    each camera exposes, (C, 4, 4).
    """

    base_from_surface: Array
    covariance: Array
    twist: Array
    exposed: Array


class KnownMotion:
    """Map and poses of a recording, and what was seen of them; tracks of `seen` (K) count rows of `map`."""

    def __init__(self, rig: Rig, smoothed: Smoothed, observations: Sequence[Observations]) -> None:
        """rig: as it was told to whoever undistorted the observations. observations: those that were smoothed."""
        self.rig, self.smoothed = rig, smoothed
        points = smoothed.map.points
        eyes = np.mean([camera.base_from_camera[:3, 3] for camera in rig.cameras], axis=0)
        outward = se3.transform_points(se3.inverse(smoothed.states.poses[0]), eyes) - points.mean(0)
        self.map = SurfaceMap(points, smooth_normals(points, outward), smoothed.map.covariance)
        there = [seen for seen in observations if smoothed.stamps[0] <= seen.stamp <= smoothed.stamps[-1]]
        self.seen = [_with_map_rows(seen, smoothed.tracks) for seen in there]
        self._own = np.einsum("ninj->nij", self.map.covariance.reshape(len(points), 3, len(points), 3))  # (L, 3, 3)
        self._covariance = smoothed.covariance[:, :6, :6]
        self._apart = pairing_tolerance(frame_period([smoothed.stamps]))

    def row(self, stamp: float) -> int | None:
        """Of the frame set at `stamp`; None where none was smoothed."""
        k = self._nearest(stamp)
        return k if abs(self.smoothed.stamps[k] - stamp) < STAMP_TOLERANCE_S else None

    def is_in_other_set(self, stamp: float) -> bool:
        """Whether pictures of `stamp` were put into sets of other stamps: a live run pairs them as they come."""
        return self.row(stamp) is None and bool(abs(self.smoothed.stamps[self._nearest(stamp)] - stamp) < self._apart)

    def seen_at(self, stamp: float) -> Observations:
        """The observations at `stamp`, s."""
        k = self.row(stamp)
        return no_observations(stamp) if k is None else self.seen[k]

    def unseen(self, stamp: float) -> NDArray[np.bool_]:
        """(C, L), landmarks that each camera was not said to see then."""
        out, seen = np.ones((len(self.rig), len(self.map)), bool), self.seen_at(stamp)
        out[seen.camera, seen.track] = False
        return out

    def at(self, stamp: float) -> ExpectedSurface | None:
        """The surface then; None outside of what was smoothed."""
        s, k = self.smoothed, self.row(stamp)
        if k is not None:
            return self._exposed(s.states.poses[k], self._covariance[k], s.states.twists[k])
        if not s.stamps[0] < stamp < s.stamps[-1]:
            return None
        then = s.at(np.array([stamp]))
        return self._exposed(then.base_from_surface[0], then.covariance[0], then.twist[0])

    def _nearest(self, stamp: float) -> int:
        return int(np.abs(self.smoothed.stamps - stamp).argmin())

    def _exposed(self, pose: Array, covariance: Array, twist: Array) -> ExpectedSurface:
        """At each camera's exposure, with cameras as smoothing corrected them, for pixels of the given rig."""
        moved = pose @ se3.exp(self.smoothed.offsets[:, None] * twist)
        corrected = np.stack([camera.base_from_camera for camera in self.smoothed.rig.cameras])
        given = np.stack([camera.base_from_camera for camera in self.rig.cameras])
        return ExpectedSurface(pose, covariance, twist, given @ se3.inverse(corrected) @ moved)

    def poses(self, expected: ExpectedSurface, seen: Observations) -> Array:
        """(C, 4, 4), where the surface was at each camera's own instant: by its own tracks where it has enough."""
        out = expected.exposed.copy()
        for c in range(len(out)):
            if (seen.camera == c).sum() >= MIN_OWN_TRACKS:
                out[c] = single_fit(self.rig, self.map.points, seen, c, out[c]).base_from_surface
        return out

    def image_sigmas(self, expected: ExpectedSurface) -> tuple[Array, float]:
        """One sigma of where each landmark falls in each camera, (C, L) px; and the median of the pose's part of it."""
        count, cameras = len(self.map), len(self.rig)
        camera, points = np.repeat(np.arange(cameras), count), np.tile(self.map.points, (cameras, 1))
        jacobian = project(self.rig, camera, expected.exposed, points)[2]
        by_pose = ((jacobian @ expected.covariance) * jacobian).sum(2).max(1)
        across = jacobian[:, :, 3:]
        by_place = ((across @ np.tile(self._own, (cameras, 1, 1))) * across).sum(2).max(1)
        return np.sqrt(by_pose + by_place).reshape(cameras, count), float(np.sqrt(np.median(by_pose)))


def _with_map_rows(seen: Observations, tracks: NDArray[np.int64]) -> Observations:
    """With the landmarks' rows in place of the ids that they bear, tracks (L,) rising; without those that have none."""
    row = np.minimum(np.searchsorted(tracks, seen.track), len(tracks) - 1)
    return replace(seen, track=row).only(tracks[row] == seen.track)


MAX_RESIDUAL = 2.0  # px beside where the motion puts it, and as often in sigmas: what is farther off is another spot
MIN_REOBSERVATION_SIGMA_PX = 0.1  # px: alignment claims less on clean images
MIN_VIEW_SHARE = 0.2  # of a camera's landmarks in view: another surface has a twentieth by chance
MIN_POSE_LANDMARKS, MIN_AGREEING_SHARE = 10, 0.4  # of a pose, and of those found: as many as a causal run needs
MAX_WAITING_SETS = 60  # frame sets that are followed backwards: so many pictures are held


class ReferencePictures:
    """The landmarks' pictures: `cut` is to be given the frame sets of `stamps`."""

    def __init__(self, motion: KnownMotion) -> None:
        self.motion, self.lenses = motion, Lenses(motion.rig)
        self._first = _first_views(motion)
        self._cut: list[tuple[NDArray[np.int64], Templates]] = []

    @property
    def stamps(self) -> Array:
        """(M,) s, rising."""
        return self.motion.smoothed.stamps[sorted({k for k, _ in self._first})]

    def cut(self, frames: FrameSet) -> None:
        """Keep the pictures of the landmarks whose first good look is in this frame set."""
        motion, k, expected = self.motion, self.motion.row(frames.stamp), self.motion.at(frames.stamp)
        for frame in frames.frames if k is not None else ():
            first = self._first.get((k or 0, frame.camera))
            if first is None or expected is None:
                continue
            pose = motion.poses(expected, motion.seen_at(frames.stamp))[frame.camera]
            there = se3.transform_points(pose, motion.map.points[first.track])
            spots = on_rays(motion.rig, frame.camera, first.pixels, there)  # the very spots that the tracks are of
            points, normals = se3.transform_points(se3.inverse(pose), spots), motion.map.normals[first.track]
            found = cut_templates(self.lenses, pyramid(grey(frame.image)), frame.camera, pose, points, normals)
            sharp = found.contrast > MIN_PATCH_CONTRAST
            self._cut.append((first.track[sharp], found.take(sharp)))

    def matcher(self) -> tuple[NDArray[np.int64], Matcher] | None:
        """The rows (M,) of the landmarks whose pictures were cut, and what finds them; None without any."""
        rows = np.concatenate([np.zeros(0, np.int64), *(rows for rows, _ in self._cut)])
        if not len(rows):
            return None
        whole, nothing = self.motion.map, np.zeros((0, 0))  # of their covariance
        some = SurfaceMap(whole.points[rows], whole.normals[rows], nothing)
        return rows, Matcher(self.lenses, some, join([part for _, part in self._cut]))


class Reobserver:
    """Looks for a recording's landmarks in its frame sets, given one after the other."""

    def __init__(self, motion: KnownMotion, rows: NDArray[np.int64], matcher: Matcher) -> None:
        """rows: (M,) of the motion's map, which the matcher's map has."""
        self._motion, self._rows, self._matcher = motion, rows, matcher
        self._place_of = np.full(len(motion.map), -1)
        self._place_of[rows] = np.arange(len(rows))
        self._apart = np.zeros((len(motion.rig), len(motion.map), 3))  # px of pictures off tracks, summed; and looks
        self._is_new = DuplicateFilter()
        self._waiting: deque[tuple[float, dict[int, Pyramid]]] = deque(maxlen=MAX_WAITING_SETS)

    def __call__(self, frames: FrameSet) -> list[Observations]:
        """What is found anew in this frame set, and in those that waited for one where the surface is known; by stamp.

        Tracks count rows of the motion's map.
        """
        motion = self._motion
        stamp = motion.seen_at(frames.stamp).stamp  # to its last bit
        images = {f.camera: grey(f.image) for f in frames.frames}
        pyramids = {c: pyramid(image) for c, image in images.items() if self._is_new(c, image)}
        if motion.is_in_other_set(stamp) or not pyramids:
            return []
        expected = motion.at(stamp)
        if expected is None or motion.image_sigmas(expected)[1] > COARSE_REACH_PX:
            self._waiting.append((stamp, pyramids))
            return []
        found = self._unseen_landmarks(stamp, pyramids, expected)
        out = self._backwards(stamp, pyramids, expected, joined_observations(motion.seen_at(stamp), found))
        return [part for part in (*out, found) if len(part)]

    def as_tracks(self, found: Observations) -> Observations:
        """What was found, as looks at the very spots that the tracks are of, which bear the ids of the tracks.

        A track is of the picture that the run had. Where one and the same frame set has both, what lies between them
        is seen, and without it a landmark would jump where one takes over from the other.
        """
        apart = self._apart[found.camera, found.track]
        pixels = found.pixels - apart[:, :2] / np.maximum(apart[:, 2:], 1.0)
        return replace(found, pixels=pixels, track=self._motion.smoothed.tracks[found.track])

    def _unseen_landmarks(self, stamp: float, pyramids: dict[int, Pyramid], expected: ExpectedSurface) -> Observations:
        motion, matcher = self._motion, self._matcher
        seen, sigma = motion.seen_at(stamp), motion.image_sigmas(expected)[0]
        poses = motion.poses(expected, seen)
        wanted = (sigma < COARSE_REACH_PX) & motion.unseen(stamp)
        wanted[[c for c in range(len(wanted)) if c not in pyramids]] = False
        self._search(np.ones(len(self._rows), bool))
        coarse = bool(wanted.any()) and float(np.median(sigma[wanted])) > FINE_REACH_PX
        found = self._of_motion(matcher.align(stamp, pyramids, {c: poses[c] for c in pyramids}, coarse=coarse))
        self._compare(seen, found)
        put = project(motion.rig, found.camera, poses, motion.map.points[found.track])[0]
        near = np.linalg.norm(found.pixels - put, axis=1) < MAX_RESIDUAL * (1 + sigma[found.camera, found.track])
        found = found.only(near & wanted[found.camera, found.track])
        whole = joined_observations(self._of_matcher(seen), found)
        return found.only(np.isin(found.camera, self._showing_cameras(pyramids, expected.base_from_surface, whole)))

    def _compare(self, seen: Observations, found: Observations) -> None:
        """How far the pictures of landmarks are `found` from where the tracks have `seen` them."""
        known = np.full(self._apart.shape[:2] + (2,), np.nan)
        known[seen.camera, seen.track] = seen.pixels
        off = found.pixels - known[found.camera, found.track]
        both = np.linalg.norm(off, axis=1) < MAX_RESIDUAL  # not where one is unknown
        self._apart[found.camera[both], found.track[both]] += np.c_[off[both], np.ones(both.sum())]

    def _showing_cameras(self, pyramids: dict[int, Pyramid], pose: Array, seen: Observations) -> list[int]:
        """The cameras in which enough is `seen` of what is in view at a pose (4, 4) for the surface to be there."""
        self._search(np.ones(len(self._rows), bool))
        view = self._matcher.in_view(list(pyramids), pose)
        counts = np.bincount(seen.camera, minlength=len(self._motion.rig))
        return [c for c, count in view.items() if counts[c] >= MIN_VIEW_SHARE * count]

    def _search(self, rows: NDArray[np.bool_]) -> None:
        """Only these (M,) are looked for from now on."""
        self._matcher.take(self._matcher.map, rows)

    def _backwards(
        self, stamp: float, pyramids: dict[int, Pyramid], expected: ExpectedSurface, seen: Observations
    ) -> list[Observations]:
        """What those show that waited, followed from the frame set after them, of which `seen` is known; by stamp."""
        matcher, rig = self._matcher, self._motion.rig
        pose, twist, out = expected.base_from_surface, expected.twist, list[Observations]()
        seen = self._of_matcher(seen)
        agrees = np.ones(len(seen), bool)
        while self._waiting:
            matcher.remember(pyramids, seen, agrees, pose)
            before, pyramids = self._waiting.pop()
            joint, single = matcher.flow(pyramids, pose @ se3.exp((before - stamp) * twist))
            seen = matcher.align(before, pyramids, single, coarse=True)
            if len(seen) < MIN_POSE_LANDMARKS:
                break
            sigma, points = np.maximum(seen.sigma, MIN_REOBSERVATION_SIGMA_PX), matcher.map.points[seen.track]
            fit = solve_pose(
                rig, PointTracks(seen.camera, points, seen.pixels, sigma), joint, scales=ROUGH_START_SCALES
            )
            agrees = fit.weights > 0.2
            agrees &= np.isin(seen.camera, self._showing_cameras(pyramids, fit.base_from_surface, seen.only(agrees)))
            if agrees.sum() < max(MIN_POSE_LANDMARKS, MIN_AGREEING_SHARE * len(seen)):
                break
            twist = se3.log(se3.inverse(fit.base_from_surface) @ pose) / (stamp - before)
            pose, stamp = fit.base_from_surface, before
            new = self._of_motion(seen.only(agrees))
            out.append(new.only(self._motion.unseen(before)[new.camera, new.track]))
        self._waiting.clear()
        return out[::-1]

    def _of_motion(self, seen: Observations) -> Observations:
        """Rows of the matcher's map as the motion's."""
        return replace(seen, track=self._rows[seen.track])

    def _of_matcher(self, seen: Observations) -> Observations:
        """Rows of the motion's map as the matcher's, those that it has."""
        seen = seen.only(self._place_of[seen.track] >= 0)
        return replace(seen, track=self._place_of[seen.track])


def _first_views(motion: KnownMotion) -> dict[tuple[int, int], Observations]:
    """By frame set and camera, the looks at which landmarks' pictures are to be cut.

    Of each landmark it is the first that is where the motion puts it, in the camera that sees it most squarely.
    """
    whole, out = motion.map, dict[tuple[int, int], Observations]()
    open_ = np.ones(len(whole), bool)
    eyes = np.stack([camera.base_from_camera[:3, 3] for camera in motion.rig.cameras])
    for k, all_seen in enumerate(motion.seen):
        seen = all_seen.only(open_[all_seen.track])
        expected = motion.at(seen.stamp)
        if not len(seen) or expected is None:
            continue
        poses = motion.poses(expected, all_seen)
        put = project(motion.rig, seen.camera, poses, whole.points[seen.track])[0]
        seen = seen.only(np.linalg.norm(seen.pixels - put, axis=1) < MAX_RESIDUAL)
        away = se3.transform_points(se3.inverse(expected.base_from_surface), eyes)[seen.camera]
        away = away - whole.points[seen.track]
        squarely = (away * whole.normals[seen.track]).sum(1) / np.linalg.norm(away, axis=1)
        order = np.lexsort((-squarely, seen.track))
        best = np.zeros(len(seen), bool)
        best[order[np.unique(seen.track[order], return_index=True)[1]]] = True
        out |= {(k, int(c)): seen.only(best & (seen.camera == c)) for c in np.unique(seen.camera[best])}
        open_[seen.track] = False
    return out


def joined_observations(first: Observations, second: Observations) -> Observations:
    """Both, at the first one's stamp."""
    names = ("camera", "track", "pixels", "sigma")
    return Observations(first.stamp, *(np.concatenate([getattr(o, name) for o in (first, second)]) for name in names))
