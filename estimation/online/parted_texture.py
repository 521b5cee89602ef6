"""Texture that separates from the surface: a group of landmarks with a second rigid motion (motion segmentation).

A drape lies beside a wound, a dressing on the skin, or a wound moves in a window of resting cloth. While all of it
moves as one body, no picture shows which part is the surface. Once landmarks that were inliers are missing or outliers,
they are searched at rest in the base frame, where they were last inliers, and then along their own motion. If one rigid
pose fits most of them they are a group. Which of both groups is the surface, only the operator's region decides:
without one, or if the region contains too much of both, the reported covariance covers either. It also does where the
texture is periodic: cloth is, tissue is not, so what moves by itself may be the tissue, however few landmarks it has.
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
SHIFTED = np.diag([0.0] * 3 + [1.0] * 3)  # (6, 6) mm^2
VANISHED = MAX_UNSEEN_MM**2 * SHIFTED  # while half of it is lost: that may be the surface
REGION_HINT = "the region holds both: draw it tighter"
CLOTH_HINT = "the rest repeats, as cloth does, so that may be the surface"
PICTURE_HINT = "no region says which is the surface: draw one"


@dataclass(frozen=True, slots=True, eq=False)
class Elsewhere:
    """Landmarks to be searched where another motion than the pose's would have moved them."""

    rows: Index  # (R,) of the map
    points: Array  # (R, 3) mm, where they would be in the surface frame of the pose


class PartedTexture:
    """Detects landmarks that leave the others together, by a second rigid motion or by resting in the base frame.

    A drape, a dressing or the wound itself: which of both groups is the surface, only the operator's region decides.
    """

    def __init__(self, rig: Rig, landmarks: int, region: bool) -> None:
        """landmarks: number of the first map; with a region they all lie in it, and only they define the surface."""
        self._rig, self._core = rig, landmarks if region else 0
        self.message = ""  # for the operator; "" while all moves as one
        self._members = np.zeros(0, bool)  # (N,) landmarks that have parted,
        self._size = 0.0  # mm, their mean displacement at the last detection
        # of each landmark: the last pose that it agreed with, and in how many frame sets it agreed
        self._last_poses, self._agreed_counts = np.zeros((0, 4, 4)), np.zeros(0, np.int64)
        self._agreeing = np.zeros(0, bool)  # (N,) landmarks that two cameras or more agree on
        self._lost_rows: Index = np.zeros(0, np.int64)  # rows that have left
        self._group: tuple[float, Array, Array] | None = None  # s, base_from_group (4, 4), its twist (6,)
        self._sets = 0  # in a row in which the group was found
        self._group_lost = False  # whether the lost landmarks once moved as a group, and have not come back
        self._vanished = False  # whether so many are lost, without being a group, that they may be the surface
        self._ambiguity: tuple[float, Array] | None = None  # s, and covariance (6, 6) that held both groups then
        self._moved = 0.0  # mm, by which a part of a periodic texture moves without being a group

    def covariance(self, stamp: float) -> Array | None:
        """(6, 6) to be added to that of a pose: either group may be the surface; None where that is decided."""
        parts = [VANISHED] if self._vanished else []
        if self._moved:
            parts.append(self._moved**2 * SHIFTED)
        if self._ambiguity is not None:
            since, covariance = self._ambiguity
            parts.append(covariance * float(np.exp(-2 * max(stamp - since, 0.0) / PARTED_MEMORY_S)))
        return np.sum(parts, axis=0) if parts else None

    def widened(self, pose: SurfacePose) -> SurfacePose:
        """The pose with a covariance that also covers its place by the other group, if there is one."""
        more = self.covariance(pose.stamp)
        return pose if more is None else widened(pose, more)

    def local_error(self, error: LocalError | None, points: Array) -> LocalError | None:
        """The error of single places, larger where a group has parted; points: (N, 3) mm of the map.

        A bump no wider than a few landmarks is smaller than what `LocalMotion` averages over.
        """
        places = points[self._members]
        near = ((places[:, None] - places) ** 2).sum(-1) < COMPANY_MM**2
        places = places[near.sum(1) > 1]
        if error is None or not len(places):
            return error
        return error.add_bells(places, max(self._size, MIN_APART_MM) ** 2, PLACE_MM)

    def search(self, observations: Observations, fit: FrameFit, points: Array) -> Elsewhere | None:
        """Landmarks to be searched elsewhere in this frame set, too; None: none. points: (N, 3) of the map, mm."""
        pose, count = fit.solution.base_from_surface, len(points)
        if (further := count - len(self._agreed_counts)) > 0:
            self._last_poses = np.concatenate([self._last_poses, np.tile(pose, (further, 1, 1))])
            self._agreed_counts = np.append(self._agreed_counts, np.zeros(further, np.int64))
            self._members = np.append(self._members, np.zeros(further, bool))
        views = np.bincount(observations.track[fit.inlier], minlength=count)
        misses = np.bincount(observations.track[self._off(fit)], minlength=count)
        misses += np.bincount(observations.missed.track, minlength=count)
        agrees = self._agreeing = views >= MIN_VIEWS
        self._last_poses[agrees], self._members = pose, self._members & ~agrees
        self._agreed_counts += agrees
        lost = (views < MIN_VIEWS) & (misses >= MIN_VIEWS) & (self._agreed_counts >= MIN_GROUP_SETS)
        self._lost_rows = np.flatnonzero(lost | self._members)
        if len(self._lost_rows) < MIN_GROUP_LANDMARKS:
            return None
        rows = self._lost_rows[:: 1 + len(self._lost_rows) // MAX_SOUGHT]
        expected = self._expected(fit.stamp)
        group = self._last_poses[rows] if expected is None else np.broadcast_to(expected, (len(rows), 4, 4))
        in_base = (group[:, :3, :3] @ points[rows, :, None])[..., 0] + group[:, :3, 3]
        expected_points = se3.transform_points(se3.inverse(pose), in_base)
        far = np.linalg.norm(expected_points - points[rows], axis=1) > NEAR_MM
        return Elsewhere(rows[far], expected_points[far]) if far.sum() >= MIN_GROUP_LANDMARKS else None

    def __call__(
        self,
        observations: Observations,
        fit: FrameFit,
        elsewhere: Observations | None,
        points: Array,
        periodic: bool,
        moved: float,
    ) -> None:
        """Take the accepted fit that `search` was called with, and observations elsewhere. points: (N, 3) mm.

        periodic: whether the texture repeats. moved: mm, by which a part of the surface moves by itself (LocalMotion).
        """
        self._moved = moved if periodic else 0.0
        if len(self._lost_rows) < MIN_GROUP_LANDMARKS and not self.message:
            return
        off = self._off(fit) & np.isin(observations.track, self._lost_rows)
        parts = [observations.select(off)] + ([] if elsewhere is None else [elsewhere])
        names = ("camera", "track", "pixels", "sigma")
        camera, track, pixels, sigma = (np.concatenate([getattr(p, name) for p in parts]) for name in names)
        group = None
        if len(self._lost_rows) >= MIN_GROUP_LANDMARKS and len(track) >= 2 * MIN_GROUP_LANDMARKS:
            tracks = PointTracks(camera, points[track], pixels, np.maximum(sigma, MIN_GROUP_SIGMA_PX))
            group = self._solve_group(tracks, track, fit, len(points))
        self._sets = 0 if group is None else self._sets + 1
        self._vanished = False
        if group is not None:
            self._take(group[0], group[1], fit, points, periodic)
        ambiguous = self._ambiguous(self._lost_rows, MAX_LOST_SHARE)
        self._group_lost = ambiguous and (self._group_lost or group is not None)
        if ambiguous and self._sets < GROUP_SETS and (self._group_lost or not self._core):
            self._vanished = True
            side = self._side(points[self._lost_rows].mean(0) - self._middle(points), fit.solution.base_from_surface)
            self.message = f"texture on the {side} no longer moves with the rest; {self._hint}"
        if group is None and self._group is not None and fit.stamp - self._group[0] > GROUP_TIMEOUT_S:
            self._group = None
        if self._ambiguity is not None and fit.stamp - self._ambiguity[0] > 2 * PARTED_MEMORY_S:
            self._ambiguity = None
        if not self._members.any() and self._ambiguity is None and not self._vanished:
            self.message = ""

    @staticmethod
    def _off(fit: FrameFit) -> Mask:
        """Tracks (N,) that are off the pose, and not by a shadow's edge."""
        return ~fit.inlier if fit.shadowed is None else ~fit.inlier & ~fit.shadowed

    def _expected(self, stamp: float) -> Array | None:
        if self._group is None:
            return None
        since, pose, twist = self._group
        return np.asarray(pose @ se3.exp(twist * (stamp - since)))

    def _solve_group(self, tracks: PointTracks, track: Index, fit: FrameFit, count: int) -> tuple[Array, Mask] | None:
        """The pose (4, 4) that fits most of the lost landmarks, and which (N,) it fits; None: there is none."""
        expected = self._expected(fit.stamp)
        middle = self._last_poses[self._lost_rows[len(self._lost_rows) // 2]]
        starts = [expected] if expected is not None else [fit.solution.base_from_surface, middle]
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

    def _take(self, pose: Array, rows: Mask, fit: FrameFit, points: Array, periodic: bool) -> None:
        """A group of rows (N,) is at `pose` (4, 4)."""
        surface, last, members = fit.solution.base_from_surface, self._group, points[rows]
        twist = np.zeros(6) if last is None else se3.log(se3.inverse(last[1]) @ pose) / (fit.stamp - last[0])
        self._group = fit.stamp, pose, twist
        difference = se3.log(se3.inverse(surface) @ pose)
        size = np.linalg.norm(se3.transform_points(se3.inverse(surface) @ pose, members) - members, axis=1).mean()
        if self._sets < GROUP_SETS or size < MIN_APART_MM:
            return
        self._members, self._size = self._members | rows, size
        side = self._side(members.mean(0) - self._middle(points), surface)
        self.message = f"texture on the {side} moves by itself, by {size:.1f} mm"
        if periodic or not self._core or self._ambiguous(np.flatnonzero(self._members), MAX_PARTED_SHARE):
            self.message = f"{self.message}; {CLOTH_HINT if periodic else self._hint}"
            self._hold(fit.stamp, np.outer(difference, difference))

    @property
    def _hint(self) -> str:
        return REGION_HINT if self._core else PICTURE_HINT

    def _ambiguous(self, rows: Index, share: float) -> bool:
        """Whether rows (R,) are so large a share of the landmarks that the others need not be the surface."""
        count = self._core or len(self._agreeing)
        return int((rows < count).sum()) >= share * max(int(self._agreeing[:count].sum()), 1)

    def _hold(self, stamp: float, covariance: Array) -> None:
        """Take a covariance (6, 6) that covers both groups, unless the one in force is larger."""
        current = self.covariance(stamp)
        if current is None or np.trace(covariance[3:, 3:]) >= np.trace(current[3:, 3:]):
            self._ambiguity = stamp, covariance

    def _middle(self, points: Array) -> Array:
        """The middle (3,) mm of the landmarks (N, 3) that agree with the pose."""
        inside = self._agreeing & ~self._members
        return np.asarray(points[inside].mean(0)) if inside.any() else np.zeros(3)

    def _side(self, direction: Array, base_from_surface: Array) -> str:
        """A direction (3,), surface frame, in the first camera's picture, in words."""
        right, down, _ = (self._rig.camera_from_base[0] @ base_from_surface)[:3, :3] @ direction
        if abs(right) > abs(down):
            return "right" if right > 0 else "left"
        return "near side" if down > 0 else "far side"
