"""Landmarks found again in the pictures of a recording whose map and motion are known: before they joined the map, in
frame sets that nobody tracked, and where the surface was lost.

A landmark's picture is cut where it was first seen, and sought wherever it should be in view. Where the motion is not
known, the surface is followed backwards from where it is, as a causal run follows it forwards. What was seen already
stays as it is.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.observations import Observations
from estimation.online.pose_solver import project, solve_pose
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.features import grey
from perception.frames import FrameSet
from perception.freshness import Freshness
from perception.known_motion import Expected, KnownMotion
from perception.lens import Lenses
from perception.mapping.first_map import on_rays
from perception.matching.matcher import Matcher
from perception.matching.patches import FLAT, Pyramid, Templates, join, pyramid, take_templates
from perception.tracking.step import AROUND, FAR, NEAR

AGREES = 2.0  # px beside where the motion puts it, and as often in sigmas: what is farther off is another spot
LEAST_SIGMA = 0.1  # px: alignment claims less on clean images
SHOWN = 0.2  # of a camera's landmarks in view: another surface has a twentieth by chance
LEAST, SHARE = 10, 0.4  # landmarks of a pose, and of those found: a causal run asks for as many
WAITING = 60  # frame sets that are followed backwards: so many pictures are held


class References:
    """The landmarks' pictures: `cut` is to be given the frame sets of `stamps`."""

    def __init__(self, motion: KnownMotion) -> None:
        self.motion, self.lenses = motion, Lenses(motion.rig)
        self._first = _first_looks(motion)
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
            found = take_templates(self.lenses, pyramid(grey(frame.image)), frame.camera, pose, points, normals)
            sharp = found.contrast > FLAT
            self._cut.append((first.track[sharp], found.take(sharp)))

    def matcher(self) -> tuple[NDArray[np.int64], Matcher] | None:
        """The rows (M,) of the landmarks whose pictures were cut, and what finds them; None without any."""
        rows = np.concatenate([np.zeros(0, np.int64), *(rows for rows, _ in self._cut)])
        if not len(rows):
            return None
        whole, nothing = self.motion.map, np.zeros((0, 0))  # of their covariance
        some = SurfaceMap(whole.points[rows], whole.normals[rows], nothing)
        return rows, Matcher(self.lenses, some, join([part for _, part in self._cut]))


class Relinker:
    """Looks for a recording's landmarks in its frame sets, given one after the other."""

    def __init__(self, motion: KnownMotion, rows: NDArray[np.int64], matcher: Matcher) -> None:
        """rows: (M,) of the motion's map, which the matcher's map has."""
        self._motion, self._rows, self._matcher = motion, rows, matcher
        self._place_of = np.full(len(motion.map), -1)
        self._place_of[rows] = np.arange(len(rows))
        self._apart = np.zeros((len(motion.rig), len(motion.map), 3))  # px of pictures off tracks, summed; and looks
        self._fresh = Freshness()
        self._waiting: deque[tuple[float, dict[int, Pyramid]]] = deque(maxlen=WAITING)

    def __call__(self, frames: FrameSet) -> list[Observations]:
        """What is found anew in this frame set, and in those that waited for one where the surface is known; by stamp.

        Tracks count rows of the motion's map.
        """
        motion = self._motion
        stamp = motion.seen_at(frames.stamp).stamp  # to its last bit
        images = {f.camera: grey(f.image) for f in frames.frames}
        pyramids = {c: pyramid(image) for c, image in images.items() if self._fresh(c, image)}
        if motion.elsewhere(stamp) or not pyramids:
            return []
        expected = motion.at(stamp)
        if expected is None or motion.doubt(expected)[1] > AROUND:
            self._waiting.append((stamp, pyramids))
            return []
        found = self._found(stamp, pyramids, expected)
        out = self._backwards(stamp, pyramids, expected, joined(motion.seen_at(stamp), found))
        return [part for part in (*out, found) if len(part)]

    def told(self, found: Observations) -> Observations:
        """What was found, as looks at the very spots that the tracks are of, which bear the ids of the tracks.

        A track is of the picture that the run had. Where one and the same frame set has both, what lies between them
        is seen, and without it a landmark would jump where one takes over from the other.
        """
        apart = self._apart[found.camera, found.track]
        pixels = found.pixels - apart[:, :2] / np.maximum(apart[:, 2:], 1.0)
        return replace(found, pixels=pixels, track=self._motion.smoothed.tracks[found.track])

    def _found(self, stamp: float, pyramids: dict[int, Pyramid], expected: Expected) -> Observations:
        """Landmarks that were not seen then."""
        motion, matcher = self._motion, self._matcher
        seen, doubt = motion.seen_at(stamp), motion.doubt(expected)[0]
        poses = motion.poses(expected, seen)
        wanted = (doubt < AROUND) & motion.unseen(stamp)
        wanted[[c for c in range(len(wanted)) if c not in pyramids]] = False
        self._search(np.ones(len(self._rows), bool))
        coarse = bool(wanted.any()) and float(np.median(doubt[wanted])) > NEAR
        found = self._of_motion(matcher.align(stamp, pyramids, {c: poses[c] for c in pyramids}, coarse=coarse))
        self._compare(seen, found)
        put = project(motion.rig, found.camera, poses, motion.map.points[found.track])[0]
        near = np.linalg.norm(found.pixels - put, axis=1) < AGREES * (1 + doubt[found.camera, found.track])
        found = found.only(near & wanted[found.camera, found.track])
        whole = joined(self._of_matcher(seen), found)
        return found.only(np.isin(found.camera, self._showing(pyramids, expected.base_from_surface, whole)))

    def _compare(self, seen: Observations, found: Observations) -> None:
        """How far the pictures of landmarks are `found` from where the tracks have `seen` them."""
        known = np.full(self._apart.shape[:2] + (2,), np.nan)
        known[seen.camera, seen.track] = seen.pixels
        off = found.pixels - known[found.camera, found.track]
        both = np.linalg.norm(off, axis=1) < AGREES  # not where one is unknown
        self._apart[found.camera[both], found.track[both]] += np.c_[off[both], np.ones(both.sum())]

    def _showing(self, pyramids: dict[int, Pyramid], pose: Array, seen: Observations) -> list[int]:
        """The cameras in which enough is `seen` of what is in view at a pose (4, 4) for the surface to be there."""
        self._search(np.ones(len(self._rows), bool))
        view = self._matcher.in_view(list(pyramids), pose)
        counts = np.bincount(seen.camera, minlength=len(self._motion.rig))
        return [c for c, count in view.items() if counts[c] >= SHOWN * count]

    def _search(self, rows: NDArray[np.bool_]) -> None:
        """Only these (M,) are looked for from now on."""
        self._matcher.take(self._matcher.map, rows)

    def _backwards(
        self, stamp: float, pyramids: dict[int, Pyramid], expected: Expected, seen: Observations
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
            if len(seen) < LEAST:
                break
            sigma, points = np.maximum(seen.sigma, LEAST_SIGMA), matcher.map.points[seen.track]
            fit = solve_pose(rig, seen.camera, points, seen.pixels, sigma, joint, scales=FAR)
            agrees = fit.weights > 0.2
            agrees &= np.isin(seen.camera, self._showing(pyramids, fit.base_from_surface, seen.only(agrees)))
            if agrees.sum() < max(LEAST, SHARE * len(seen)):
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


def _first_looks(motion: KnownMotion) -> dict[tuple[int, int], Observations]:
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
        seen = seen.only(np.linalg.norm(seen.pixels - put, axis=1) < AGREES)
        away = se3.transform_points(se3.inverse(expected.base_from_surface), eyes)[seen.camera]
        away = away - whole.points[seen.track]
        squarely = (away * whole.normals[seen.track]).sum(1) / np.linalg.norm(away, axis=1)
        order = np.lexsort((-squarely, seen.track))
        best = np.zeros(len(seen), bool)
        best[order[np.unique(seen.track[order], return_index=True)[1]]] = True
        out |= {(k, int(c)): seen.only(best & (seen.camera == c)) for c in np.unique(seen.camera[best])}
        open_[seen.track] = False
    return out


def joined(first: Observations, second: Observations) -> Observations:
    """Both, at the first one's stamp."""
    names = ("camera", "track", "pixels", "sigma")
    return Observations(first.stamp, *(np.concatenate([getattr(o, name) for o in (first, second)]) for name in names))
