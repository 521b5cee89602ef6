"""Which cameras can be relied on: those that deliver nothing new, see nothing, or disagree with the others are named.

Single wrong tracks are rejected one by one. A camera that was bumped, swapped or frozen is wrong in all of its tracks
at once, and they agree with each other. So cameras are left out in turn: the outlier is the camera without which the
others agree with each other and with the motion until now. It stays left out until it agrees again. How far cameras
usually stand apart is learned, since no calibration is perfect.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from estimation import se3
from estimation.observations import Observations
from estimation.online.bump_detector import BumpDetector
from estimation.online.pose_solver import PointTracks, PoseFit, SharedErrors, own_residuals, project, solve_pose
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.runtime import median
from estimation.se3 import Array, Index, Mask

MAX_OUTLIERS = 2  # cameras that may be wrong at once: exchanged cables
MIN_DISORDER_PX = 1.5  # median residual; below, it is not asked how much of it a camera's own motion explains
RAYLEIGH_MEDIAN = 1.18  # median length of a vector whose two entries are normal, in their sigmas
MAX_MOTION_SIGMAS = 3.0  # beyond, a pose contradicts the motion; also by how much an outlier must be the clearest


@dataclass(frozen=True, slots=True)
class HealthSettings:
    """Thresholds: `out_ratio` ends a camera's part in the pose, `back_ratio` begins it."""

    min_shift: float = 0.25  # px by which lens, map and extrinsics may move all tracks of a camera, at least
    memory: float = 2.0  # s over which it is learned what is usual for a camera
    out_ratio: float = 4.0  # of the allowed offset: cameras that stand farther off are left out
    back_ratio: float = 2.0  # and come back below this,
    back_looks: int = 2  # in so many frame sets one after the other
    max_gap: float = 0.08  # s, and also two frame sets, that a camera may miss: drivers drop frames every day
    leave_share: float = 0.3  # of the tracks a camera usually has: with fewer it is missed
    least_share: float = 0.15  # where no camera has as many, the few may be what covers the rest: no measurement
    whole_share: float = 0.8  # of all its usual tracks: of a blurred picture half of them are found
    enter_share: float = 1.5  # times what is asked of a camera that counts is asked of one that is to count again


class CameraHealth:
    """Remembers, per camera, when it last carried the pose and whether it is left out."""

    def __init__(self, names: Sequence[str], settings: HealthSettings | None = None) -> None:
        self.settings, self._names = settings or HealthSettings(), tuple(names)
        self.bumps = BumpDetector(names)
        self._fresh = frozenset(range(len(self._names)))  # cameras with a new picture; all until `set_pictures`
        self._repeated: frozenset[int] = frozenset()
        self.begin()

    def begin(self) -> None:
        """Forget everything, as for a new map."""
        count = len(self._names)
        self.bumps.begin()
        self.left_out: frozenset[int] = frozenset()
        self._usual, self._tracks = np.zeros(count), np.zeros(count)  # px off, and tracks
        self._off = np.zeros(count)  # px, how far a camera that is left out stands off
        self._carried = np.full(count, np.nan)  # s, stamp; nan: never
        self._missed = np.zeros(count, np.int64)  # frame sets in a row
        self._agreed = np.zeros(count, np.int64)
        self._apart = np.zeros(count, bool)
        self._blurred = False  # all cameras stand off together
        self._stamp = np.nan

    def set_pictures(self, fresh: Collection[int], repeated: Collection[int]) -> None:
        """Which cameras delivered a new picture for the coming frame set, and which the last one again."""
        self._fresh, self._repeated = frozenset(fresh), frozenset(repeated)

    def allowed(self, moved: Array) -> Array:
        """How far each camera may stand off, px, one sigma (C,). moved: (C,) px between the cameras' instants."""
        return np.asarray(np.hypot(np.maximum(self._usual, self.settings.min_shift), moved))

    def hidden(self, used: Index) -> bool:
        """Whether every camera shows so much less than usual that these (C,) tracks prove nothing."""
        return bool((used < self.settings.least_share * self._tracks)[self._tracks > 0].all() and self._tracks.any())

    def readmit_all(self) -> None:
        """No camera is left out any more."""
        self.left_out = frozenset()

    def clear(self, used: Index) -> bool:
        """Whether two cameras, or all that there are, carry a pose with these (C,) tracks about as they usually do."""
        known = self._tracks > 0
        clear = (used >= self.settings.leave_share * self._tracks) & known
        return int(clear.sum()) >= min(2, int(known.sum()))

    def blur_offsets(self, off: Array, allowed: Array, odd: Collection[int]) -> Array:
        """How far, px, each camera (C,) stands off where all stand off together; else zeros.

        Blurred or covered images match at random near where they were searched, so no camera is the outlier and the
        number of tracks shows no error. off, allowed: (C,) px, nan in `off` where nothing is seen. odd: left out.
        """
        seen = np.isfinite(off) & ~np.isin(np.arange(len(off)), list(odd))
        together = bool(seen.any() and (off > self.settings.back_ratio * allowed)[seen].all())
        return np.where(seen & together, off, 0.0)

    def blurred(self, used: Index, off: Array, allowed: Array, odd: Collection[int]) -> bool:
        """Whether all cameras stand off together, with fewer tracks than usual: a surface that bends keeps its tracks.

        used: (C,) tracks that carry the pose. The rest as for `blur_offsets`.
        """
        fewer = used.sum() < self.settings.whole_share * self._tracks.sum()
        return bool(fewer and self.blur_offsets(off, allowed, odd).any())

    def update(self, stamp: float, used: Index, least: float, off: Array, allowed: Array, odd: Collection[int]) -> None:
        """Take a frame set.

        used: (C,) tracks that carry the pose, zero where nothing was measured. least: tracks below which a camera says
        nothing. off: (C,) px of each from the pose of the others, nan where unseen. allowed: as `allowed` gives. odd:
        cameras that were left out of this pose.
        """
        required = np.maximum(least, self.settings.leave_share * self._tracks)
        carrying = used >= required * np.where(self._missed > 0, self.settings.enter_share, 1.0)
        self._missed = np.where(carrying, 0, self._missed + 1)
        self._carried[carrying] = stamp
        # running means of offset and tracks, of the cameras that carry the pose
        share = min(1.0, (stamp - self._stamp) / self.settings.memory) if np.isfinite(self._stamp) else 1.0
        self._stamp = stamp
        known = carrying & np.isfinite(off)
        self._usual[known] += share * (np.minimum(off, 2 * allowed)[known] - self._usual[known])
        self._tracks[carrying] += share * (used[carrying] - self._tracks[carrying])
        # which cameras stay left out
        agrees = off < self.settings.back_ratio * allowed  # false where unknown
        self._agreed = np.where(agrees, self._agreed + 1, 0)
        self._apart = off > self.settings.out_ratio * allowed
        self._blurred = bool(self.blur_offsets(off, allowed, odd).any())
        self._off = np.where(np.isfinite(off), off, self._off)
        self.left_out = frozenset(c for c in odd if self._agreed[c] < self.settings.back_looks)

    def trouble(self, stamp: float, at_once: bool = False) -> str:
        """Which cameras are missed, or that all look odd, and why; or ''. at_once: also those that only just failed."""
        reasons = [f"{self._names[c]} {self._why(c)}" for c in self._troubled(stamp, at_once)]
        return ", ".join(reasons or ["no camera shows the surface as usual"] * self._blurred)

    def _troubled(self, stamp: float, at_once: bool) -> list[int]:
        late = (self._missed >= 2) & (stamp - self._carried > self.settings.max_gap)
        named = (self._missed > 0) & np.isfinite(self._carried) & (late | at_once)
        off = self.left_out | self.bumps.messages.keys()
        return [c for c in range(len(self._names)) if named[c] or c in off or self._apart[c]]

    def _why(self, camera: int) -> str:
        if camera in self._repeated:
            return "shows the same picture again"
        if camera not in self._fresh:
            return "delivers no picture"
        if camera in self.bumps.messages:
            return self.bumps.messages[camera]
        if camera in self.left_out or self._apart[camera]:
            return f"stands {self._off[camera]:.1f} px off the others"
        return "hardly sees the surface"


@dataclass(frozen=True, slots=True, eq=False)
class FrameTracks:
    """One frame set's tracks of the map, to be fitted with or without some of the cameras."""

    rig: Rig
    seen: Observations  # N tracks
    points: Array  # (N, 3) mm, surface frame
    shared: SharedErrors  # expected size of what all tracks of a camera are off by
    min_tracks: float  # with fewer, a camera says nothing

    def fit(self, start: Array, scales: tuple[float, ...], left_out: Collection[int]) -> PoseFit:
        """The pose of all cameras but `left_out`, whose tracks get residuals, but no weight; start: (4, 4)."""
        tracks = PointTracks.of(self.seen, self.points)
        if not left_out:
            return solve_pose(self.rig, tracks, start, scales=scales, shared=self.shared)
        used = ~np.isin(tracks.camera, list(left_out))
        fit = solve_pose(self.rig, tracks.only(used), start, scales=scales, shared=self.shared)
        predicted, _, jacobians = project(self.rig, tracks.camera, fit.base_from_surface, self.points)
        residuals, weights = predicted - tracks.pixels, np.zeros(len(self.points))
        residuals[used], weights[used] = fit.residuals, fit.weights
        return PoseFit(fit.base_from_surface, fit.information, residuals, weights, jacobians, fit.scale, fit.shared)

    def offsets(self, fit: PoseFit) -> Array:
        """How far, px, each camera stands off a pose: (C,), nan with fewer tracks than `min_tracks`.

        That is the median of its tracks' residuals, less what their noise alone makes of it.
        """
        away = np.linalg.norm(fit.residuals, axis=1)
        off = np.full(len(self.rig), np.nan)
        for c in range(len(self.rig)):
            mine = self.seen.camera == c
            if np.count_nonzero(mine) >= self.min_tracks:
                noise = RAYLEIGH_MEDIAN * median(self.seen.sigma[mine])
                off[c] = np.sqrt(max(median(away[mine]) ** 2 - noise**2, 0.0))
        return off

    def without_outliers(
        self, left_out: Collection[int], allowed: Array, expected: SurfacePose, stay: int = 1, within: float = np.inf
    ) -> tuple[frozenset[int], PoseFit] | None:
        """The cameras, one or else two, without which the others agree, and the fit without them; None where unclear.

        left_out: cameras that are so already. allowed: (C,) px by which each may stand off. expected: by the motion, at
        this stamp. stay: cameras that must remain. within: sigmas of the motion that their pose may be off.
        """
        present = [int(c) for c in np.unique(self.seen.camera) if c not in left_out]
        for size in range(1, min(MAX_OUTLIERS, len(present) - stay) + 1):
            fits: list[tuple[float, frozenset[int], PoseFit]] = []
            for odd in combinations(present, size):
                without = frozenset(left_out) | set(odd)
                fit = self.fit(expected.base_from_surface, (4.0, 1.0), without)
                apart = self.offsets(fit) / allowed
                others = [apart[c] for c in present if c not in odd and np.isfinite(apart[c])]
                if others and max(others) <= 1.0 and all(apart[c] > 1.0 for c in odd):
                    fits.append((motion_sigmas(fit, expected), without, fit))
            fits.sort(key=lambda one: one[0])
            if fits:
                sure = len(fits) == 1 or fits[1][0] > MAX_MOTION_SIGMAS * fits[0][0]
                return fits[0][1:] if sure and fits[0][0] <= within else None
        return None

    def weak_fit_reason(self, fit: PoseFit, odd: Collection[int], torn: bool, expected: SurfacePose) -> str:
        """What speaks against a fit that stands on little, or ''.

        odd: cameras that are left out. torn: whether few tracks are left, and even they stand off. Of a covered surface
        a tenth of the landmarks is matched by chance, anywhere within the search. The covariance of such tracks is so
        wide that no motion contradicts it: accepted as a pose, they set it 3.7 mm off, and its prediction 16 mm.
        """
        if torn:
            return "few tracks, against each other"
        if not odd:
            return ""
        out = np.isin(np.unique(self.seen.camera), list(odd))
        alone = bool(out.any() and (~out).sum() == 1)
        if not alone or expected.state is TrackState.LOST or motion_sigmas(fit, expected) <= MAX_MOTION_SIGMAS:
            return ""
        return "one camera alone, against the others and the motion"

    def incoherent_residual(self, fit: PoseFit, inlier: Mask) -> float:
        """Median residual, px, of the inliers when each camera has a pose of its own: no rigid motion explains it."""
        whole = np.linalg.norm(fit.residuals[inlier], axis=1)
        if not len(whole) or median(whole) < MIN_DISORDER_PX:
            return 0.0
        left = own_residuals(self.seen.camera, fit, inlier.astype(float))[inlier]
        return float(np.median(np.linalg.norm(left, axis=1)))


def motion_sigmas(fit: PoseFit, expected: SurfacePose) -> float:
    """By how many sigmas a pose differs from the one expected by the motion, at least one."""
    off = se3.log(se3.inverse(expected.base_from_surface) @ fit.base_from_surface)
    damped = fit.information + (1e-9 * np.trace(fit.information) + 1e-12) * np.eye(6)  # without information: one
    spread = expected.covariance + np.linalg.inv(damped)
    return max(1.0, float(np.sqrt(off @ np.linalg.solve(spread, off) / 6)))
