"""The motion of a recorded surface as smoothing has it, in the terms of its pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.batch.smoothed import Smoothed
from estimation.mapping.bundle_adjustment import single_fit
from estimation.mapping.local_surface import smooth_normals
from estimation.observations import Observations, no_observations
from estimation.online.pose_solver import project
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.pairing import frame_period, pairing_tolerance

SAME = 1e-6  # s: stamps of one frame set, as stored and as read again
OWN = 8  # landmarks that tell where the surface was at a camera's own instant


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
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
        self.seen = [_by_row(seen, smoothed.tracks) for seen in there]
        self._own = np.einsum("ninj->nij", self.map.covariance.reshape(len(points), 3, len(points), 3))  # (L, 3, 3)
        self._covariance = smoothed.covariance[:, :6, :6]
        self._apart = pairing_tolerance(frame_period([smoothed.stamps]))

    def row(self, stamp: float) -> int | None:
        """Of the frame set at `stamp`; None where none was smoothed."""
        k = self._nearest(stamp)
        return k if abs(self.smoothed.stamps[k] - stamp) < SAME else None

    def elsewhere(self, stamp: float) -> bool:
        """Whether pictures of `stamp` were put into sets of other stamps: a live run pairs them as they come."""
        return self.row(stamp) is None and bool(abs(self.smoothed.stamps[self._nearest(stamp)] - stamp) < self._apart)

    def seen_at(self, stamp: float) -> Observations:
        """What was seen then."""
        k = self.row(stamp)
        return no_observations(stamp) if k is None else self.seen[k]

    def unseen(self, stamp: float) -> NDArray[np.bool_]:
        """(C, L), landmarks that each camera was not said to see then."""
        out, seen = np.ones((len(self.rig), len(self.map)), bool), self.seen_at(stamp)
        out[seen.camera, seen.track] = False
        return out

    def at(self, stamp: float) -> Expected | None:
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

    def _exposed(self, pose: Array, covariance: Array, twist: Array) -> Expected:
        """With the cameras as corrected, in the terms of the rig that the pixels are of."""
        moved = pose @ se3.exp(self.smoothed.offsets[:, None] * twist)
        corrected = np.stack([camera.base_from_camera for camera in self.smoothed.rig.cameras])
        told = np.stack([camera.base_from_camera for camera in self.rig.cameras])
        return Expected(pose, covariance, twist, told @ se3.inverse(corrected) @ moved)

    def poses(self, expected: Expected, seen: Observations) -> Array:
        """(C, 4, 4), where the surface was at each camera's own instant: by its own tracks where it has enough."""
        out = expected.exposed.copy()
        for c in range(len(out)):
            if (seen.camera == c).sum() >= OWN:
                out[c] = single_fit(self.rig, self.map.points, seen, c, out[c]).base_from_surface
        return out

    def doubt(self, expected: Expected) -> tuple[Array, float]:
        """(C, L) px, how far off each landmark may be in each camera, one sigma; and by the pose alone, the median."""
        count, cameras = len(self.map), len(self.rig)
        camera, points = np.repeat(np.arange(cameras), count), np.tile(self.map.points, (cameras, 1))
        jacobian = project(self.rig, camera, expected.exposed, points)[2]
        by_pose = ((jacobian @ expected.covariance) * jacobian).sum(2).max(1)
        across = jacobian[:, :, 3:]
        by_place = ((across @ np.tile(self._own, (cameras, 1, 1))) * across).sum(2).max(1)
        return np.sqrt(by_pose + by_place).reshape(cameras, count), float(np.sqrt(np.median(by_pose)))


def _by_row(seen: Observations, tracks: NDArray[np.int64]) -> Observations:
    """With the landmarks' rows in place of the ids that they bear, tracks (L,) rising; without those that have none."""
    row = np.minimum(np.searchsorted(tracks, seen.track), len(tracks) - 1)
    return replace(seen, track=row).only(tracks[row] == seen.track)
