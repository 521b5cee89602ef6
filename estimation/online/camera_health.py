"""Health of the cameras: which deliver nothing new, see nothing, or disagree with the others, and outliers among them.

Single wrong tracks are rejected one by one. A camera that was bumped, swapped or frozen is wrong in all of its tracks
at once, and they agree with each other. So cameras are left out in turn: the outlier is the camera without which the
others agree with each other and with the motion until now. It stays left out until it agrees again. How far cameras
usually stand apart is learned, since no calibration is perfect.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from estimation.observations import Observations
from estimation.online.bump_detector import MIN_UNEQUAL_PX, BumpDetector, contradicts, spread_anchors
from estimation.online.camera_errors import RivalWatch
from estimation.online.deformation import camera_medians, own_residuals, squared_speeds
from estimation.online.fit import RivalPose, camera_numbers, motion_sigmas, picture_noise
from estimation.pose import SurfacePose, TrackState
from estimation.pose_solver import INLIER_WEIGHT, PointTracks, PoseFit, SharedErrors, project, solve_pose, solve_small
from estimation.rig import Rig
from estimation.runtime import contiguous, median
from estimation.se3 import Array, Index, Mask

MAX_OUTLIERS = 2  # cameras that may be wrong at once: exchanged cables
MIN_DISORDER_PX = 1.5  # median residual; below, it is not asked how much of it a camera's own motion explains
USUAL_LENGTH_SIGMAS = 1.18  # median length of a track's residual where it is noise alone, rounded up
MAX_MOTION_SIGMAS = 3.0  # beyond, a pose contradicts the motion; also by how much an outlier must be the clearest
MIN_SHIFT_PX = 0.25  # by which lens, map and extrinsics may move all tracks of a camera, at least
USUAL_MEMORY_S = 2.0  # over which it is learned what is usual for a camera
OUTLIER_RATIO = 4.0  # of the allowed offset: cameras that stand farther off are left out
READMIT_RATIO = 2.0  # and come back below this,
READMIT_SETS = 2  # in so many frame sets one after the other
MAX_GAP_S = 0.08  # and also two frame sets, that a camera may miss: drivers drop frames every day
MIN_USUAL_SHARE = 0.3  # of the tracks a camera usually has: with fewer it is missed
HIDDEN_SHARE = 0.15  # where no camera has as many, the few may be what covers the rest: no measurement
SHARP_SHARE = 0.8  # of all its usual tracks: of a blurred picture half of them are found
# of a camera's last own pose about its next, 0.03 rad and 10 mm: a patch has two (Schweighofer and Pinz 2006)
SINGLE_POSE_PRIOR = np.diag([1 / 0.03**2] * 3 + [1 / 10.0**2] * 3)
UNUSUAL_RATIO = 3.0  # times the usual offset, or the tracks' noise: beyond, cameras that carry a pose do not agree
CLEAR_SIGMAS = 2.0  # by which a camera's own pose must differ in its picture (six degrees of freedom: 6e-4 by chance)
FAST_TWIST_DECAY = 0.985  # of the fastest motion, from frame set to frame set: for two seconds
MIN_PICTURES = 2  # of a camera from which nothing of the map is seen: one may be covered or blurred
MAX_DELAY_SIGMAS = 6.0  # of the cameras' delays as they are known: beyond, a camera hangs or its pictures come late
RETURN_RATIO = 1.5  # times what is asked of a camera that counts is asked of one that is to count again


class CameraHealth:
    """Remembers of each camera when it last carried the pose and whether it is left out as an outlier."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self.bumps = BumpDetector(names)
        self._fresh = frozenset(range(len(self._names)))  # cameras with a new picture; all until `set_pictures`
        self._repeated: frozenset[int] = frozenset()
        self.begin(np.zeros((1, 3)))

    def begin(self, points: Array) -> None:
        """Forget everything, as for a new map with landmarks (N, 3), surface frame."""
        count = len(self._names)
        self.rivals = RivalWatch(spread_anchors(points))
        self.bumps.begin()
        self.left_out: frozenset[int] = frozenset()
        self._usual_offset, self._usual_tracks = np.zeros(count), np.zeros(count)  # px off, and tracks
        self._offsets = np.zeros(count)  # px, how far a camera that is left out stands off
        self._carried_stamp = np.full(count, np.nan)  # s, stamp; nan: never
        self._missed = np.zeros(count, np.int64)  # frame sets in a row
        self._agreed_sets = np.zeros(count, np.int64)
        self._is_off = np.zeros(count, bool)
        self._blurred = False  # all cameras stand off together
        self._stamp = np.nan
        self._pictures = np.zeros(count, np.int64)  # pictures
        self._blind: frozenset[int] = frozenset()  # cameras that show nothing of the map, though it is in their view
        self._hint = ""  # at their calibration
        self._fastest = np.zeros(6)  # fastest recent twist: at a turn the surface rests, cameras still stand apart

    @property
    def unseen(self) -> frozenset[int]:
        """Cameras that have given pictures, and have never carried the pose."""
        return camera_numbers(np.isnan(self._carried_stamp) & (self._pictures >= MIN_PICTURES))

    def set_unseen(self, cameras: frozenset[int], hint: str) -> None:
        """Cameras that show nothing of the map, though it is in their view, and a hint at the cause, or ''."""
        self._blind, self._hint = cameras, hint

    @property
    def contradictory(self) -> bool:
        """Whether cameras contradict each other, though none may be left out."""
        return bool(self.bumps.bumped or self.rivals.untrusted)

    def set_pictures(self, fresh: Collection[int], repeated: Collection[int]) -> None:
        """Which cameras delivered a new picture for the coming frame set, and which the last one again."""
        self._fresh, self._repeated = frozenset(fresh), frozenset(repeated)

    def offset_sigma(self, moved: Array) -> Array:
        """How far each camera may stand off, px, one sigma (C,). moved: (C,) px between the cameras' instants."""
        return np.asarray(np.hypot(np.maximum(self._usual_offset, MIN_SHIFT_PX), moved))

    def hidden(self, used: Index) -> bool:
        """Whether every camera has so many tracks less than usual that these (C,) prove nothing."""
        return bool((usual := self._usual_tracks).any() and (used < HIDDEN_SHARE * usual)[usual > 0].all())

    def has_usual_tracks(self, used: Index) -> bool:
        """Whether two cameras, or all that there are, carry a pose with these (C,) tracks about as they usually do."""
        known = self._usual_tracks > 0
        carrying = (used >= MIN_USUAL_SHARE * self._usual_tracks) & known
        return int(carrying.sum()) >= min(2, int(known.sum()))

    def blur_offsets(self, offsets: Array, allowed: Array, outliers: Collection[int]) -> Array:
        """How far, px, each camera (C,) stands off where all stand off together; else zeros.

        Blurred or covered images match at random near where they were searched, so no camera is the outlier and the
        number of tracks shows no error. offsets, allowed: (C,) px, nan in `offsets` where nothing is seen.
        """
        valid = np.isfinite(offsets) & ~np.isin(np.arange(len(offsets)), list(outliers))
        together = bool(valid.any() and (offsets > READMIT_RATIO * allowed)[valid].all())
        return np.where(valid & together, offsets, 0.0)

    def blurred(self, used: Index, offsets: Array, allowed: Array, outliers: Collection[int]) -> bool:
        """Whether all cameras stand off together, with fewer tracks than usual: a surface that bends keeps its tracks.

        used: (C,) tracks that carry the pose. The rest as for `blur_offsets`.
        """
        fewer = used.sum() < SHARP_SHARE * self._usual_tracks.sum()
        return bool(fewer and self.blur_offsets(offsets, allowed, outliers).any())

    def solve(
        self, tracks: FrameTracks, start: Array, scales: tuple[float, ...], allowed: Array, expected: SurfacePose | None
    ) -> tuple[PoseFit, frozenset[int], Array]:
        """The pose of the cameras that agree with each other, those left out, and offsets (C,), px, from the pose.

        allowed: (C,) px. expected: by the motion until now; None where no other camera is to be left out.
        """
        off = camera_numbers(self._offsets > READMIT_RATIO * allowed)  # else they come back at once
        outliers = self.left_out | (off & self.rivals.outliers(self.bumps.bumped))
        solution = tracks.fit(start, scales, outliers)
        offsets = tracks.offsets(solution)
        if expected is None:
            return solution, outliers, offsets
        limit = OUTLIER_RATIO * allowed
        any_off = any(offsets[c] > limit[c] for c in range(len(limit)) if c not in outliers)
        # a camera may have moved, though the others follow it
        if any_off or motion_sigmas(solution, expected) > MAX_MOTION_SIGMAS:
            min_cameras, max_sigmas = (1, np.inf) if any_off else (2, MAX_MOTION_SIGMAS)
            without = tracks.without_outliers(outliers, limit, expected, min_cameras, max_sigmas)
            if without is not None:
                outliers, solution = tracks.along_motion(*without, limit, expected) if any_off else without
                return solution, outliers, tracks.offsets(solution)
        return solution, outliers, offsets

    def rival_poses(
        self,
        tracks: FrameTracks,
        fit: PoseFit,
        outliers: frozenset[int],
        offsets: Array,
        allowed: Array,
        expected: SurfacePose | None,
    ) -> tuple[RivalPose, ...]:
        """Poses that contradict the fit: by the cameras left out; else by one that moves or stands unlike the others.

        offsets, allowed: (C,) px. expected: by the motion, a rival of a fit that contradicts it and lacks cameras.
        """
        moves = (tracks.shared.twist, FAST_TWIST_DECAY * self._fastest)
        self._fastest = max(moves, key=lambda twist: float(squared_speeds(contiguous(fit.jacobians), twist).sum()))
        if expected is None:
            return ()
        limit, smear = OUTLIER_RATIO * allowed, float(np.sqrt(np.mean(np.diag(tracks.shared.delay)))) * self._fastest
        farthest = frozenset([int(np.nanargmax(offsets / limit))] if (offsets > limit).any() else [])
        unequal = self.bumps.unequal_motion.outliers or frozenset(self.bumps.bumped)
        apart = outliers or unequal or tracks.out_of_step(fit) or farthest
        motion = expected if outliers and motion_sigmas(fit, expected) <= MAX_MOTION_SIGMAS else None
        usual, starts = UNUSUAL_RATIO * self._usual_offset, self.rivals.own_poses()
        rivals = tracks.rivals(fit, apart, limit, usual, smear, starts, motion) if apart else ()
        inlier_counts = np.bincount(tracks.observations.camera[fit.weights > INLIER_WEIGHT], minlength=len(self._names))
        fewer = (inlier_counts < MIN_USUAL_SHARE * self._usual_tracks) & (self._missed == 0)
        lost_now = camera_numbers(fewer) & self._fresh - outliers
        carriers = camera_numbers(inlier_counts > 0) - lost_now
        if rivals or not lost_now or not carriers or motion_sigmas(fit, expected) <= MAX_MOTION_SIGMAS:
            return rivals
        poses, nothing = (fit.base_from_surface, expected.base_from_surface), np.zeros(len(fit.weights), bool)
        return (RivalPose(lost_now, carriers, *poses, (0.0, 0.0), nothing),)

    def update(
        self, stamp: float, used: Index, min_tracks: float, offsets: Array, allowed: Array, outliers: Collection[int]
    ) -> None:
        """Take a frame set.

        used: (C,) tracks that carry the pose, zero where nothing was measured. min_tracks: fewer do not count. offsets:
        (C,) px of each from the pose of the others, nan where unseen. allowed: of `offset_sigma`. outliers: left out.
        """
        required = np.maximum(min_tracks, MIN_USUAL_SHARE * self._usual_tracks)
        carrying = used >= required * np.where(self._missed > 0, RETURN_RATIO, 1.0)
        self._missed = np.where(carrying, 0, self._missed + 1)
        self._pictures[list(self._fresh)] += 1
        self._carried_stamp[carrying] = stamp
        # running means of offset and tracks, of the cameras that carry the pose
        share = min(1.0, (stamp - self._stamp) / USUAL_MEMORY_S) if np.isfinite(self._stamp) else 1.0
        self._stamp = stamp
        settled = carrying & np.isfinite(offsets)
        settled &= not (outliers or self.rivals.untrusted)
        settled[list(self.bumps.bumped)] = False  # a camera that hangs before a slow motion stands off ever farther
        self._usual_offset[settled] += share * (np.minimum(offsets, 2 * allowed)[settled] - self._usual_offset[settled])
        self._usual_tracks[carrying] += share * (used[carrying] - self._usual_tracks[carrying])
        # which cameras stay left out
        agrees = offsets < READMIT_RATIO * allowed  # false where unknown
        self._agreed_sets = np.where(agrees, self._agreed_sets + 1, 0)
        self._is_off = offsets > OUTLIER_RATIO * allowed
        self._blurred = bool(self.blur_offsets(offsets, allowed, outliers).any())
        self._offsets = np.where(np.isfinite(offsets), offsets, self._offsets)
        self.left_out = frozenset(c for c in outliers if self._agreed_sets[c] < READMIT_SETS)

    def trouble(self, stamp: float, at_once: bool = False) -> str:
        """Which cameras are missed, or that all look odd, and why; or ''. at_once: also those that only just failed."""
        overdue = (self._missed >= 2) & (stamp - self._carried_stamp > MAX_GAP_S)
        failing = (self._missed > 0) & np.isfinite(self._carried_stamp) & (overdue | at_once)
        off = self.left_out | self.bumps.messages.keys() | self.rivals.outliers(self.bumps.bumped)
        doubted = {c for rival in self.rivals.untrusted for c in rival.cameras | rival.carriers}
        troubled = (c for c in range(len(self._names)) if failing[c] or c in off or self._is_off[c])
        reasons = [f"{self._names[c]} {self._why(c)}" for c in troubled if c not in doubted]
        blind = [f"{self._names[c]} shows nothing of the map" for c in sorted(self._blind & self.unseen)]
        blind += [self._hint] * bool(blind and self._hint)
        reasons = [*self.rivals.messages(self._names), *reasons, *blind]
        return ", ".join(reasons or ["no camera shows the surface as usual"] * self._blurred)

    def _why(self, camera: int) -> str:
        if camera in self._repeated:
            return "shows the same picture again"
        if camera not in self._fresh:
            return "delivers no picture"
        if text := self.rivals.fault_text(camera):
            return text
        if camera in self.bumps.messages:
            return self.bumps.messages[camera]
        if camera in self.left_out or self._is_off[camera]:
            return f"stands {self._offsets[camera]:.1f} px off the others"
        return "hardly sees the surface"


@dataclass(frozen=True, slots=True, eq=False)
class FrameTracks:
    """One frame set's tracks of the map, to be fitted with or without some of the cameras."""

    rig: Rig
    observations: Observations  # N tracks
    points: Array  # (N, 3) mm, surface frame
    shared: SharedErrors  # expected size of what all tracks of a camera are off by
    min_tracks: float  # with fewer, a camera says nothing

    def fit(self, start: Array, scales: tuple[float, ...], left_out: Collection[int]) -> PoseFit:
        """The pose of all cameras but `left_out`, whose tracks get residuals, but no weight; start: (4, 4)."""
        tracks = PointTracks.from_observations(self.observations, self.points)
        if not left_out:
            return solve_pose(self.rig, tracks, start, scales=scales, shared=self.shared)
        kept = ~np.isin(tracks.camera, list(left_out))
        alone = solve_pose(self.rig, tracks.select(kept), start, scales=scales, shared=self.shared)
        return self._with_rest(alone, kept)

    def _with_rest(self, fit: PoseFit, fitted: Mask) -> PoseFit:
        """A fit to the tracks `fitted` (N,) with the residuals of the others, which have no weight."""
        predicted, _, jacobians = project(self.rig, self.observations.camera, fit.base_from_surface, self.points)
        residuals, weights = predicted - self.observations.pixels, np.zeros(len(self.points))
        residuals[fitted], weights[fitted] = fit.residuals, fit.weights
        return PoseFit(fit.base_from_surface, fit.information, residuals, weights, jacobians, fit.scale, fit.shared)

    def offsets(self, fit: PoseFit) -> Array:
        """Offsets (C,) px of the cameras from a pose: median residual less its noise, nan below `min_tracks` tracks."""
        camera, sigmas = contiguous(self.observations.camera, np.int64), contiguous(self.observations.sigma)
        residuals, least = contiguous(fit.residuals), max(self.min_tracks, 1.0)
        lengths, sigma = camera_medians(len(self.rig), camera, residuals, sigmas, least)
        return np.asarray(np.sqrt(np.maximum(lengths**2 - (USUAL_LENGTH_SIGMAS * sigma) ** 2, 0.0)))

    def without_outliers(
        self, left_out: Collection[int], allowed: Array, expected: SurfacePose, least: int = 1, sigmas: float = np.inf
    ) -> tuple[frozenset[int], PoseFit] | None:
        """The cameras, one or else two, without which the others agree, and the fit without them; None where unclear.

        left_out: cameras that are so already. allowed: (C,) px by which each may stand off. expected: by the motion, at
        this stamp. least: cameras that must remain. sigmas: of the motion, by which their pose may be off.
        """
        present = [int(c) for c in np.unique(self.observations.camera) if c not in left_out]
        for size in range(1, min(MAX_OUTLIERS, len(present) - least) + 1):
            fits: list[tuple[float, frozenset[int], PoseFit]] = []
            for outliers in combinations(present, size):
                without = frozenset(left_out) | set(outliers)
                fit = self.fit(expected.base_from_surface, (4.0, 1.0), without)
                ratio = self.offsets(fit) / allowed
                others = [ratio[c] for c in present if c not in outliers and np.isfinite(ratio[c])]
                if others and max(others) <= 1.0 and all(ratio[c] > 1.0 for c in outliers):
                    fits.append((motion_sigmas(fit, expected), without, fit))
            fits.sort(key=lambda one: one[0])
            if fits:
                clearest = len(fits) == 1 or fits[1][0] > MAX_MOTION_SIGMAS * fits[0][0]
                return fits[0][1:] if clearest and fits[0][0] <= sigmas else None
        return None

    def along_motion(
        self, without: frozenset[int], fit: PoseFit, allowed: Array, expected: SurfacePose
    ) -> tuple[frozenset[int], PoseFit]:
        """Those left out and the fit, or one camera alone that continues the motion until now which the others leave.

        Cameras that hang, or come late together, agree with each other.
        """
        present = set(np.unique(self.observations.camera).tolist())
        apart = sorted(present & without)
        if motion_sigmas(fit, expected) <= MAX_MOTION_SIGMAS or len(apart) != 1:
            return without, fit
        others = frozenset(present - without) | (without - set(apart))
        single = self.fit(expected.base_from_surface, (4.0, 1.0), others)
        sound = (
            self.offsets(single)[apart[0]] <= allowed[apart[0]] and motion_sigmas(single, expected) <= MAX_MOTION_SIGMAS
        )
        return (others, single) if sound else (without, fit)

    def out_of_step(self, fit: PoseFit) -> frozenset[int]:
        """The camera whose exposure in this frame set is off by more than its clock can be, if any."""
        if fit.shared is None:
            return frozenset()
        prior, eye = self.shared.covariance(), np.eye(len(fit.shared.pull))
        effect = prior @ solve_small(eye + fit.shared.information @ prior, fit.shared.pull[:, None])[:, 0]
        delay, sigma = np.abs(effect[: len(self.rig)]), np.sqrt(np.mean(np.diag(self.shared.delay)))
        return frozenset([int(np.argmax(delay))] if delay.max() > MAX_DELAY_SIGMAS * sigma else [])

    def rivals(
        self,
        fit: PoseFit,
        apart: Collection[int],
        allowed: Array,
        usual: Array,
        smear: Array,
        starts: Mapping[int, Array],
        motion: SurfacePose | None,
    ) -> tuple[RivalPose, ...]:
        """Poses by cameras `apart` that clearly contradict the others': one where they agree, else one for each.

        allowed, usual: (C,) px by which cameras that agree may stand off, and do. smear: (6,) motion in one sigma of a
        camera's delay. starts: (4, 4) by camera, where it last saw the surface. motion: the pose expected, where the
        fit continues the motion until now.
        """
        counts = np.bincount(self.observations.camera, minlength=len(self.rig))
        visible = camera_numbers(counts >= self.min_tracks)
        cameras, carriers = sorted(visible & set(apart)), visible - set(apart)
        if not cameras or not carriers:
            return ()
        carrier_fit, noise = self._only(carriers, fit.base_from_surface)
        pose, rivals = carrier_fit.base_from_surface, list[RivalPose]()
        noisy = USUAL_LENGTH_SIGMAS * median(self.observations.sigma)
        united = bool((self.offsets(carrier_fit) <= np.maximum(usual, noisy))[sorted(carriers)].all())
        for group in ([cameras] if len(cameras) > 1 else []) + [[c] for c in cameras]:
            key, mine = frozenset(group), np.isin(self.observations.camera, group)
            own_fit, own_noise = self._only(key, starts.get(group[0], pose))
            inlier = (own_fit.weights > INLIER_WEIGHT) & mine
            jumped = motion is not None and motion_sigmas(own_fit, motion) > MAX_MOTION_SIGMAS
            poses, noises = (pose, own_fit.base_from_surface), (noise, own_noise)
            rival = RivalPose(key, carriers, *poses, noises, inlier, united, jumped)
            difference_px = float(np.sqrt(2 * np.mean((own_fit.jacobians[mine] @ rival.difference) ** 2)))
            clock_px = 2 * MAX_DELAY_SIGMAS * float(np.sqrt(np.mean((fit.jacobians @ smear) ** 2)))  # of both sides
            clear = difference_px > max(MIN_UNEQUAL_PX, clock_px, CLEAR_SIGMAS * np.sqrt(2) * own_noise)
            agrees = (self.offsets(own_fit)[group] <= allowed[group]).all()
            if clear and agrees and contradicts(self.observations, carrier_fit, rival):
                rivals.append(rival)
                if len(group) > 1:
                    break
        return tuple(rivals)

    def _only(self, cameras: frozenset[int], start: Array) -> tuple[PoseFit, float]:
        """The fit of these cameras' tracks alone, and its noise, px, in their pictures."""
        mine = np.isin(self.observations.camera, list(cameras))
        tracks = PointTracks.from_observations(self.observations, self.points).select(mine)
        prior = SINGLE_POSE_PRIOR if len(cameras) == 1 else None
        alone = solve_pose(self.rig, tracks, start, scales=(4.0, 1.0), prior=prior, shared=self.shared)
        return (fit := self._with_rest(alone, mine)), picture_noise(fit, mine)

    def weak_fit_reason(self, fit: PoseFit, outliers: Collection[int], sparse: bool, expected: SurfacePose) -> str:
        """Why a fit to few tracks or to one camera is rejected, or ''.

        outliers: cameras that are left out. sparse: whether few tracks remain, and these are off, too. Of a covered
        surface a tenth of the landmarks is matched by chance, anywhere within the search. The covariance of such tracks
        is so wide that no motion contradicts it: accepted, they set the pose 3.7 mm off, and its prediction 16 mm.
        """
        if sparse:
            return "few tracks, against each other"
        if not outliers:
            return ""
        outlier = np.isin(np.unique(self.observations.camera), list(outliers))
        single = bool(outlier.any() and (~outlier).sum() == 1)
        if not single or expected.state is TrackState.LOST or motion_sigmas(fit, expected) <= MAX_MOTION_SIGMAS:
            return ""
        return "one camera alone, against the others and the motion"

    def incoherent_residual(self, fit: PoseFit, inlier: Mask) -> float:
        """Median residual, px, of the inliers when each camera has a pose of its own: no rigid motion explains it."""
        lengths = np.linalg.norm(fit.residuals[inlier], axis=1)
        if not len(lengths) or median(lengths) < MIN_DISORDER_PX:
            return 0.0
        own = own_residuals(self.observations.camera, fit, inlier.astype(float))[inlier]
        return float(np.median(np.linalg.norm(own, axis=1)))
