"""Texture that parts from the surface: landmarks that leave the pose together, and a second motion puts them in place.

A drape lies beside a wound, a dressing on the skin, or a field moves in a window of cloth at rest. While all of it
moves as one, no picture tells what is the surface. Once landmarks that had agreed are missing or outliers, they are
looked for at rest in the base frame, as when they last agreed, and then along their own motion. Where one rigid pose
holds most of them they are a group. Which of both groups is the surface, only the operator's region can say: without
one, or where the region holds too much of both, the reported covariance covers either.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.observations import Observations
from estimation.online.fit import FrameFit
from estimation.online.local_motion import MAX_UNSEEN_MM, MIN_VIEWS, NEAR_MM
from estimation.online.reported_covariance import widened
from estimation.pose import SurfacePose
from estimation.pose_solver import INLIER_WEIGHT, PointTracks, PoseFit, solve_pose
from estimation.rig import Rig
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import LocalError

MIN_GROUP_LANDMARKS = 6  # that part together: a rigid motion through fewer could be chance
MIN_GROUP_SETS = 5  # frame sets in which a landmark must have agreed before it can part
MIN_GROUP_SHARE = 0.5  # of the lost landmarks that are measured anywhere: others match by chance
MIN_GROUP_SIGMA_PX = 0.2  # one sigma of a track: patches on what slips are not what they were
MAX_GROUP_SCALE = 4.0  # of the residuals, in sigmas: worse ones share no motion
GROUP_SETS = 2  # frame sets in a row in which a group must be found
MIN_APART_MM = 0.5  # by which it must be apart to be told: what the guard allows
MAX_PARTED_SHARE = 0.2  # of the landmarks that say what the surface is: with more of them in a group, nobody knows
MAX_LOST_SHARE = 0.5  # likewise, with more of them lost: a hand may cover as many
GROUP_TIMEOUT_S = 0.5  # after which a motion no longer tells where a group is
PARTED_MEMORY_S = 10.0  # some breaths: groups that met again may part again
COMPANY_MM = 10.0  # within which a landmark that parted has another one: alone, a group's motion fits it by chance
PLACE_MM = 4.0  # reach of what it says about its place: landmarks stand that far apart
MAX_SOUGHT = 40  # landmarks that are looked for elsewhere
VANISHED = np.diag([0.0] * 3 + [MAX_UNSEEN_MM**2] * 3)  # (6, 6) while half of it is lost: that may be the surface
REGION_HINT = "the region holds both: draw it tighter"
PICTURE_HINT = "no region says which is the surface: draw one"


@dataclass(frozen=True, slots=True, eq=False)
class Elsewhere:
    """Landmarks that are to be looked for where another motion than the pose would have put them."""

    rows: Index  # (R,) of the map
    points: Array  # (R, 3) mm, where they would be in the surface frame of the pose


class PartedTexture:
    """Remembers landmarks that have left the others together: a second rigid motion, or rest, puts them in one place.

    A drape, a dressing or the field itself: which of both groups is the surface, only the operator's region can tell.
    """

    def __init__(self, rig: Rig, landmarks: int, region: bool) -> None:
        """landmarks: of the first map, which all lie in the region, if one is known: then those say what counts."""
        self._rig, self._core = rig, landmarks if region else 0
        self.message = ""  # for the operator; "" while all moves as one
        self._members = np.zeros(0, bool)  # (N,) landmarks that have parted,
        self._size = 0.0  # mm, by so much on average, when they were last seen to
        self._agreed, self._looks = np.zeros((0, 4, 4)), np.zeros(0, np.int64)  # last poses agreed with, and how often
        self._here = np.zeros(0, bool)  # (N,) landmarks that two cameras or more agree on
        self._lost: Index = np.zeros(0, np.int64)  # rows that have left
        self._found: tuple[float, Array, Array] | None = None  # s, base_from_group (4, 4), its twist (6,)
        self._sets = 0  # in a row in which the group was found
        self._torn = False  # whether what is lost was seen to move on as a group, and has not come back
        self._vanished = False  # whether so much is lost, and not found as a group, that it may have been the surface
        self._apart: tuple[float, Array] | None = None  # s, and covariance (6, 6) that held both groups then

    def covariance(self, stamp: float) -> Array | None:
        """(6, 6) to be added to that of a pose: either group may be the surface; None where that is known."""
        gone = VANISHED if self._vanished else None
        if self._apart is None:
            return gone
        since, known = self._apart
        left = known * float(np.exp(-2 * max(stamp - since, 0.0) / PARTED_MEMORY_S))
        return left if gone is None else left + gone

    def covering(self, pose: SurfacePose) -> SurfacePose:
        """The pose, reported so that its covariance holds where it would be by the other group, if there is one."""
        apart = self.covariance(pose.stamp)
        return pose if apart is None else widened(pose, apart)

    def at_its_places(self, error: LocalError | None, points: Array) -> LocalError | None:
        """The error of single places, larger where a group has parted; points: (N, 3) mm of the map.

        A bump no wider than a few landmarks is smaller than what `LocalMotion` averages over.
        """
        parted = points[self._members]
        near = ((parted[:, None] - parted) ** 2).sum(-1) < COMPANY_MM**2
        parted = parted[near.sum(1) > 1]
        if error is None or not len(parted):
            return error
        return error.with_bells(parted, max(self._size, MIN_APART_MM) ** 2, PLACE_MM)

    def sought(self, observations: Observations, fit: FrameFit, points: Array) -> Elsewhere | None:
        """What is to be looked for elsewhere in this frame set, too; None: nothing. points: (N, 3) of the map, mm."""
        pose, count = fit.solution.base_from_surface, len(points)
        if (more := count - len(self._looks)) > 0:
            self._agreed = np.concatenate([self._agreed, np.tile(pose, (more, 1, 1))])
            self._looks = np.append(self._looks, np.zeros(more, np.int64))
            self._members = np.append(self._members, np.zeros(more, bool))
        here = np.bincount(observations.track[fit.inlier], minlength=count)
        away = np.bincount(observations.track[self._off(fit)], minlength=count)
        away += np.bincount(observations.missed.track, minlength=count)
        agrees = self._here = here >= MIN_VIEWS
        self._agreed[agrees], self._members = pose, self._members & ~agrees
        self._looks += agrees
        gone = (here < MIN_VIEWS) & (away >= MIN_VIEWS) & (self._looks >= MIN_GROUP_SETS)
        self._lost = np.flatnonzero(gone | self._members)
        if len(self._lost) < MIN_GROUP_LANDMARKS:
            return None
        rows = self._lost[:: 1 + len(self._lost) // MAX_SOUGHT]
        there = self._expected(fit.stamp)
        group = self._agreed[rows] if there is None else np.broadcast_to(there, (len(rows), 4, 4))
        base = (group[:, :3, :3] @ points[rows, :, None])[..., 0] + group[:, :3, 3]
        moved = se3.transform_points(se3.inverse(pose), base)
        far = np.linalg.norm(moved - points[rows], axis=1) > NEAR_MM
        return Elsewhere(rows[far], moved[far]) if far.sum() >= MIN_GROUP_LANDMARKS else None

    def __call__(
        self, observations: Observations, fit: FrameFit, elsewhere: Observations | None, points: Array
    ) -> None:
        """Take the accepted fit that `sought` was asked with, and what was found elsewhere. points: (N, 3) mm."""
        if len(self._lost) < MIN_GROUP_LANDMARKS and not self.message:
            return
        beside = self._off(fit) & np.isin(observations.track, self._lost)
        parts = [observations.only(beside)] + ([] if elsewhere is None else [elsewhere])
        names = ("camera", "track", "pixels", "sigma")
        camera, track, pixels, sigma = (np.concatenate([getattr(p, name) for p in parts]) for name in names)
        group = None
        if len(self._lost) >= MIN_GROUP_LANDMARKS and len(track) >= 2 * MIN_GROUP_LANDMARKS:
            tracks = PointTracks(camera, points[track], pixels, np.maximum(sigma, MIN_GROUP_SIGMA_PX))
            group = self._group(tracks, track, fit, len(points))
        self._sets = 0 if group is None else self._sets + 1
        self._vanished = False
        if group is not None:
            self._take(group[0], group[1], fit, points)
        unsure = self._unsure(self._lost, MAX_LOST_SHARE)
        self._torn = unsure and (self._torn or group is not None)
        if unsure and self._sets < GROUP_SETS and (self._torn or not self._core):
            self._vanished = True
            side = self._side(points[self._lost].mean(0) - self._middle(points), fit.solution.base_from_surface)
            self.message = f"texture on the {side} no longer moves with the rest; {self._hint}"
        if group is None and self._found is not None and fit.stamp - self._found[0] > GROUP_TIMEOUT_S:
            self._found = None
        if self._apart is not None and fit.stamp - self._apart[0] > 2 * PARTED_MEMORY_S:
            self._apart = None
        if not self._members.any() and self._apart is None and not self._vanished:
            self.message = ""

    @staticmethod
    def _off(fit: FrameFit) -> Mask:
        """Tracks (N,) that are off the pose, and not by a shadow's edge."""
        return ~fit.inlier if fit.lit is None else ~fit.inlier & ~fit.lit

    def _expected(self, stamp: float) -> Array | None:
        if self._found is None:
            return None
        since, pose, twist = self._found
        return np.asarray(pose @ se3.exp(twist * (stamp - since)))

    def _group(self, tracks: PointTracks, track: Index, fit: FrameFit, count: int) -> tuple[Array, Mask] | None:
        """The pose (4, 4) that most of the lost landmarks share, and which (N,) they are; None: they share none."""
        there = self._expected(fit.stamp)
        middle = self._agreed[self._lost[len(self._lost) // 2]]
        starts = [there] if there is not None else [fit.solution.base_from_surface, middle]
        best: tuple[int, PoseFit, Mask] | None = None
        for start in starts:
            solution = solve_pose(self._rig, tracks, start, scales=(8.0, 1.0))
            rows = np.bincount(track[solution.weights > INLIER_WEIGHT], minlength=count) >= MIN_VIEWS
            if solution.scale < MAX_GROUP_SCALE and (best is None or rows.sum() > best[0]):
                best = int(rows.sum()), solution, rows
        measured = int((np.bincount(track, minlength=count) >= MIN_VIEWS).sum())
        if best is None or best[0] < max(MIN_GROUP_LANDMARKS, MIN_GROUP_SHARE * measured):
            return None
        return best[1].base_from_surface, best[2]

    def _take(self, pose: Array, rows: Mask, fit: FrameFit, points: Array) -> None:
        """A group of rows (N,) is at `pose` (4, 4)."""
        surface, before, own = fit.solution.base_from_surface, self._found, points[rows]
        twist = np.zeros(6) if before is None else se3.log(se3.inverse(before[1]) @ pose) / (fit.stamp - before[0])
        self._found = fit.stamp, pose, twist
        along = se3.log(se3.inverse(surface) @ pose)
        size = np.linalg.norm(se3.transform_points(se3.inverse(surface) @ pose, own) - own, axis=1).mean()
        if self._sets < GROUP_SETS or size < MIN_APART_MM:
            return
        self._members, self._size = self._members | rows, size
        side = self._side(own.mean(0) - self._middle(points), surface)
        self.message = f"texture on the {side} moves by itself, by {size:.1f} mm"
        if not self._core or self._unsure(np.flatnonzero(self._members), MAX_PARTED_SHARE):
            self.message = f"{self.message}; {self._hint}"
            self._hold(fit.stamp, np.outer(along, along))

    @property
    def _hint(self) -> str:
        return REGION_HINT if self._core else PICTURE_HINT

    def _unsure(self, rows: Index, share: float) -> bool:
        """Whether so many landmarks (rows, (R,)) have parted, of the others, that those need not be the surface."""
        count = self._core or len(self._here)
        return int((rows < count).sum()) >= share * max(int(self._here[:count].sum()), 1)

    def _hold(self, stamp: float, both: Array) -> None:
        """Take a covariance (6, 6) that holds both groups, unless the one from before says more."""
        known = self.covariance(stamp)
        if known is None or np.trace(both[3:, 3:]) >= np.trace(known[3:, 3:]):
            self._apart = stamp, both

    def _middle(self, points: Array) -> Array:
        """The middle (3,) mm of the landmarks (N, 3) that agree with the pose."""
        here = self._here & ~self._members
        return np.asarray(points[here].mean(0)) if here.any() else np.zeros(3)

    def _side(self, away: Array, base_from_surface: Array) -> str:
        """Where a direction (3,), surface frame, points in the first camera's picture, in words."""
        right, down, _ = (self._rig.camera_from_base[0] @ base_from_surface)[:3, :3] @ away
        if abs(right) > abs(down):
            return "right" if right > 0 else "left"
        return "near side" if down > 0 else "far side"
