"""TrackingStep: one frame set in, one surface pose out; no I/O and no clock of its own.

The motion model predicts where each landmark is in the images, or optical flow does where that is too uncertain.
Alignment with its reference picture measures a landmark; the estimator fits the pose to all of them. A camera with too
few measured landmarks is relocalised by SIFT features.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.observations import Observations, no_observations
from estimation.online.estimator import Estimator
from estimation.pose import SurfacePose, TrackState, identity_pose
from estimation.rig import Rig
from estimation.scans.registration import Registration
from estimation.scans.scan import Scan
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.frames import DuplicateFilter, FrameSet, Image, Roi, of_whole_pictures, parallel_map
from perception.lens import Lenses, unfiltered
from perception.mapping.features import Relocaliser, grey
from perception.mapping.mapping import Mapping, TrackedSet
from perception.mapping.masks import Colours, Tool, TrackingMasks
from perception.mapping.matcher import Matcher
from perception.mapping.patches import Pyramid
from perception.mapping.verification import (
    BETTER_LIKENESS,
    SURE,
    WORSE_LIKENESS,
    Grain,
    Verdict,
    Verification,
)

STAGES = ("prepare", "flow", "align", "pose", "search")
# Of a camera: at 0.2 px they give a pose to 0.01 mm, and more landmarks do not reduce the errors that they share.
MAX_ALIGNED_LANDMARKS = 120
ROUGH_START_SCALES = 4.0, 1.0  # of a fit whose start may be pixels off
# One sigma of the prediction, px: alignment reaches three of it, on the full image and on the half-size one.
FINE_REACH_PX, COARSE_REACH_PX = 0.8, 2.5
MAX_PROBE_OFFSET_PX = 0.5  # of a camera from the joint pose: beyond it the camera's own pose is fitted
PARALLEL_BYTES = 4e6  # of all pictures: below it, converting them to grey takes less time than starting a thread
FULL_SEARCH_INTERVAL = 10  # frame sets between full-size searches for a lost surface: a distant one needs full size


@dataclass(frozen=True, slots=True, eq=False)
class StepReport:
    """What one step did, for C cameras."""

    observations: Observations
    used: NDArray[np.int64]  # (C,) tracks that carry the pose
    seconds: Array  # (len(STAGES),) s, by the step's clock
    offsets: Array  # (C,) s, exposure offset of each camera from its stamp, relative to the mean of all
    offset_sigmas: Array  # (C,) s, one standard deviation, nan where none is estimated


def report_without_offsets(observations: Observations, used: NDArray[np.int64], seconds: Array) -> StepReport:
    """The report of a step that assumes zero exposure offsets."""
    return StepReport(observations, used, seconds, np.zeros(len(used)), np.full(len(used), np.nan))


def empty_report(stamp: float, cameras: int, seconds: Array) -> StepReport:
    """The report of a step that measured nothing."""
    return report_without_offsets(no_observations(stamp), np.zeros(cameras, np.int64), seconds)


_StepResult = tuple[SurfacePose, Observations, NDArray[np.int64]]  # pose, tracks, how many of each camera carry it (C,)


class TrackingStep:
    """Follows one surface through frame sets; deterministic, causal."""

    last: StepReport

    def __init__(
        self,
        rig: Rig,
        roi: Sequence[Roi] = (),
        clock: Callable[[], float] = lambda: 0.0,
        executor: Executor | None = None,
        scan: Scan | None = None,
        tool: Tool | None = None,
        prefilter: Callable[[Image], Image] = unfiltered,
        waits: bool = True,
    ) -> None:
        """Ready for the first frame set.

        roi: where the surface is when it first comes into view; without one, whatever two cameras see is the surface.
        clock: used for `StepReport.seconds` only.
        executor: refines the map; in a separate process GTSAM does not delay the frames. Without one the map is refined
            in `idle`. Poses are the same either way.
        waits: whether `idle` waits for results that are due; else poses depend on when results arrive.
        scan: its frame is the surface frame; without one the first map defines it (origin at the landmarks' centroid, z
            out of the surface).
        tool: shape of the print head, masked where frame sets contain its pose.
        prefilter: applied to each grey picture first.
        """
        self.rig, self.roi, self._clock = rig, tuple(roi), clock
        self._lenses, self._prefilter = Lenses(rig), prefilter
        whole = of_whole_pictures(self.roi, [camera.size for camera in rig.cameras])
        detected = any(roi.found for roi in self.roi)
        self._estimator = Estimator(rig, region="none" if whole else "found" if detected else "drawn")
        self._is_new = DuplicateFilter()
        self._search, self._masks = Relocaliser(self._lenses), TrackingMasks(self._lenses, tool)
        self._mapping = Mapping(self._lenses, roi, self._search, self._estimator, self._masks, executor, scan, waits)
        self._matcher: Matcher | None = None
        self._reset_appearance()
        # what the verification learns the surface from, and its pictures as received: `idle` may come frame sets later
        self._unverified_set: tuple[TrackedSet, dict[int, Image]] | None = None
        self._images: dict[int, Image] = {}  # of the frame set, as received
        self._pictures: dict[int, Pyramid] = {}  # of the last frame set
        self._search_pyramids: dict[int, Pyramid] = {}  # of cameras in which `idle` searches for the surface
        self._relocalised_pose: Array | None = None  # (4, 4), by the last search
        self._absent_sets = 0  # frame sets since the surface was last measured
        self._stage_seconds, self._stage_start = np.zeros(len(STAGES)), 0.0

    def _reset_appearance(self) -> None:
        """Discard what is learned of the surface's appearance."""
        self._verification, self._grain = Verification(self._lenses, self._masks), Grain(self._lenses)
        self._colours = Colours(self._lenses, self._masks)

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp` from this frame set and the ones before."""
        self._stage_seconds, self._stage_start = np.zeros(len(STAGES)), self._clock()
        last = self._estimator.pose
        if last is not None and frames.stamp <= last.stamp:  # the same instant again
            self.last = self._report(no_observations(frames.stamp), np.zeros(len(self.rig), np.int64))
            return last
        self._check(frames)
        pyramids = self._pyramids(frames)
        self._images = {f.camera: f.image for f in frames.frames if f.camera in pyramids}
        self._masks.set_print_head(frames.head, pyramids)
        self._add_time("prepare")
        if self._matcher is None:
            pose, observations, used = self._initialise(frames, pyramids)
        else:
            pose, observations, used = self._track(self._matcher, frames.stamp, pyramids)
            if pose.state.measured:
                bead = self._masks.lay_ink(frames.head, pose.stamp, pose.base_from_surface)
                if bead is not None:
                    self._matcher.cover(bead)
                    self._colours.cover(bead)
        self._pictures = pyramids
        self.last = self._report(observations, used)
        note = pose.reason or self._verification.message or self._grain.message
        return replace(pose, reason=note) if pose.state is TrackState.TRACKING else pose

    @property
    def map(self) -> SurfaceMap | None:
        """The map as it is now, in the surface frame; None before there is one."""
        return self._estimator.map

    @property
    def late(self) -> int:
        """How often a map update was not ready when due."""
        return self._mapping.late

    @property
    def window_graph(self) -> str:
        """The factor graph of the last poses in Graphviz's language."""
        return self._estimator.window_graph

    @property
    def registration(self) -> Registration | None:
        """Pose of the scan by the pictures that confirmed the first map; None before, and without a scan."""
        return self._mapping.registration

    def idle(self) -> None:
        """Work outside the pose's latency: learning, mapping, relocalisation. Call it after each pose."""
        self._estimator.learn()
        if self._matcher is not None:
            self._mapping.update()
        if self._unverified_set is not None and self._estimator.map is not None:
            (tracked, images), self._unverified_set = self._unverified_set, None
            poses = self._mapping.camera_poses(tracked)
            self._verification.begin(tracked.fit.stamp, tracked.pyramids, poses, self._estimator.map)
            self._estimator.periodic = len(self._verification.aliases) > 0
            carrier_poses = {c: poses[c] for c in self._carrying_cameras(tracked) if c in poses}
            self._colours.begin(images, carrier_poses, self._estimator.map)
        if self._mapping.look_for_hint(self._pictures, repeats=self._estimator.periodic):
            self._matcher = self._unverified_set = None
        self._relocalise()

    def _report(self, observations: Observations, used: NDArray[np.int64]) -> StepReport:
        cameras = self._estimator.cameras
        return StepReport(observations, used, self._stage_seconds, cameras.offset, cameras.offset_sigma)

    def _check(self, frames: FrameSet) -> None:
        for frame in frames.frames:
            camera, (h, w) = self.rig.cameras[frame.camera], frame.image.shape[:2]
            if (w, h) != camera.size:
                raise InputError(f"camera {camera.name}", "image size", f"{w} x {h}", "{} x {} px".format(*camera.size))

    def _pyramids(self, frames: FrameSet) -> dict[int, Pyramid]:
        """The new pictures by camera, without repeated ones, in which the surface would seem to stand still."""
        pictures, cameras = [f.image for f in frames.frames], [f.camera for f in frames.frames]
        small = sum(image.size for image in pictures) < PARALLEL_BYTES and self._prefilter is unfiltered
        greys = [*map(grey, pictures)] if small else parallel_map(lambda image: self._prefilter(grey(image)), pictures)
        pyramids = {c: Pyramid(image) for c, image in zip(cameras, greys, strict=True) if self._is_new(c, image)}
        self._estimator.health.set_pictures(pyramids, set(cameras) - pyramids.keys())
        return pyramids

    def _add_time(self, stage: str) -> None:
        now = self._clock()
        self._stage_seconds[STAGES.index(stage)] += now - self._stage_start
        self._stage_start = now

    # -- the first map

    def _initialise(self, frames: FrameSet, pyramids: dict[int, Pyramid]) -> _StepResult:
        start = self._mapping.start(frames, pyramids)
        self._add_time("search")
        if isinstance(start, str):
            return identity_pose(frames.stamp, start), no_observations(frames.stamp), np.zeros(len(self.rig), np.int64)
        self._matcher, pose, tracked = start
        self._reset_appearance()
        return pose, tracked.observations, tracked.fit.used

    # -- every frame set after it

    def _track(self, matcher: Matcher, stamp: float, pyramids: dict[int, Pyramid]) -> _StepResult:
        estimator = self._estimator
        assert estimator.map is not None
        expected = estimator.expected(stamp)
        if self._relocalised_pose is not None:
            expected, self._relocalised_pose = replace(expected, base_from_surface=self._relocalised_pose), None

        # measurement and fit, from a second start where cameras lost the surface
        joint, observations, scales = self._measure(matcher, expected, pyramids)
        tracked = TrackedSet(estimator.fit(observations, joint, scales), observations, pyramids)
        self._add_time("pose")
        if not tracked.fit.measured or self._lost_cameras(tracked):
            tracked = self._second_try(tracked, expected.base_from_surface)
            self._add_time("search")

        # confirm the map, rebuild it on a fast surface, or verify the pose
        fit, aliases = tracked.fit, SURE.sizes
        if not estimator.confirmed:
            if len(self._carrying_cameras(tracked)) < 2:
                if self._mapping.expired(stamp):
                    self._matcher = None
                reason = f"the first map waits for a second look by two cameras ({fit.reason or 'one sees it'})"
                return estimator.hold(stamp, reason), tracked.observations, fit.used
            tracked = self._mapping.confirm(tracked)
            self._unverified_set = tracked, self._images
        elif fit.measured and not fit.outliers and estimator.too_fast_for_map(fit):
            tracked = self._mapping.rebuild(tracked)
            self._unverified_set = tracked, self._images
        elif fit.measured:
            tracked, aliases = self._verify(tracked)

        # the pose
        fit, observations = tracked.fit, tracked.observations
        if fit.measured:
            self._search_pyramids = {c: pyramids[c] for c in self._lost_cameras(tracked)}
            self._absent_sets = 0
            exposed = estimator.as_exposed(fit.solution.base_from_surface, fit.twist)
            fit = replace(fit, shadowed=matcher.shadowed_tracks(pyramids, exposed, observations, ~fit.inlier))
            query, start = estimator.elsewhere(fit, observations), fit.solution.base_from_surface
            elsewhere = None if query is None else matcher.align_at(stamp, pyramids, start, query.rows, query.points)
            carrier_poses = {c: exposed[c] for c in self._carrying_cameras(tracked)}
            displaced = self._colours(self._images, carrier_poses, estimator.expected(stamp).warp)
            pose = estimator.accept(fit, observations, elsewhere, aliases, displaced)
            if not (fit.outliers or fit.rivals or len(aliases) or displaced.ambiguous):
                self._mapping.offer(tracked, pose.twist)
            matcher.remember(pyramids, observations, fit.followed, fit.solution.base_from_surface)
        else:
            pose = estimator.coast(fit)
            self._absent_sets += 1
            self._search_pyramids = pyramids
        self._add_time("pose")
        return pose, observations, fit.used

    def _verify(self, tracked: TrackedSet) -> tuple[TrackedSet, Array]:
        """The frame set fitted at the likeliest alias, and distances (K,) mm of the aliases that are not ruled out.

        The fit counts as no measurement where the surface's grain contradicts its tracks.
        """
        poses, verdict = self._verify_pose(tracked)
        original, original_poses, ruled_out = tracked, poses, list[int]()
        for number, motion in enumerate(verdict.motions[: verdict.rivals]):
            pose = original.fit.solution.base_from_surface
            starts = {c: own @ motion for c, own in original_poses.items()}
            retry = self._mapping.align_and_fit(original.fit.stamp, original.pyramids, starts, pose @ motion)
            if not retry.fit.measured:
                continue
            retry_poses, retry_verdict = self._verify_pose(retry)
            if retry_verdict.likeness > verdict.likeness + BETTER_LIKENESS:
                tracked, poses, verdict = retry, retry_poses, retry_verdict
            elif retry_verdict.likeness < verdict.likeness - WORSE_LIKENESS and tracked is original:
                ruled_out.append(number)
        aliases = np.delete(verdict.sizes, ruled_out) if tracked is original else verdict.sizes
        if tracked is not original:
            self._estimator.forget_motion()
        if reason := self._light_reason(tracked):
            return replace(tracked, fit=replace(tracked.fit, reason=reason)), aliases
        if not len(aliases):
            self._verification.confirm(tracked.fit.stamp, poses)
            self._grain.learn()
        return tracked, aliases

    def _light_reason(self, tracked: TrackedSet) -> str:
        """Why the tracks that carry a fit do not show the surface, or ''."""
        assert self._matcher is not None
        fit = tracked.fit
        tracks, pose = tracked.observations.select(fit.inlier), fit.solution.base_from_surface
        unusual = self._estimator.looks_unusual(fit)
        return self._grain(tracked.pyramids, tracks, pose, self._matcher.map, self._matcher.templates, unusual)

    def _verify_pose(self, tracked: TrackedSet) -> tuple[dict[int, Array], Verdict]:
        """Each trusted camera's own pose (4, 4) of a frame set, and the verdict on them by the pictures."""
        if not len(self._verification.aliases):
            return {}, SURE
        fit = tracked.fit
        exposed = self._estimator.as_exposed(fit.solution.base_from_surface, fit.twist)
        cameras_differ = np.nanmax(fit.offsets, initial=0.0) > MAX_PROBE_OFFSET_PX
        poses = self._mapping.camera_poses(tracked) if cameras_differ else {c: exposed[c] for c in tracked.pyramids}
        trusted = {c: pose for c, pose in poses.items() if c not in fit.outliers}
        return trusted, self._verification(fit.stamp, tracked.pyramids, trusted)

    def _measure(
        self, matcher: Matcher, expected: SurfacePose, pyramids: dict[int, Pyramid]
    ) -> tuple[Array, Observations, tuple[float, ...]]:
        """A start for the fit (4, 4), the landmarks measured in the images, and the fit's scales, from coarse to fine.

        Alignment starts at the predicted pose where its sigma is below COARSE_REACH_PX (on half-size images above
        FINE_REACH_PX); else, or where fewer landmarks are measured than in the last images, at that of optical flow.
        """
        stamp, predicted, observations = expected.stamp, expected.base_from_surface, None
        delay_error = self._estimator.cameras.delays.sigma * expected.twist  # (6,) one sigma, as pose
        sigma = matcher.image_sigma(predicted, expected.covariance + np.outer(delay_error, delay_error))
        if sigma < COARSE_REACH_PX:
            exposed = self._estimator.as_exposed(predicted, expected.twist)
            own_poses = self._estimator.health.rivals.own_poses(onwards=True)
            starts, coarse = {c: own_poses.get(c, exposed[c]) for c in pyramids}, sigma > FINE_REACH_PX
            observations = matcher.align(stamp, pyramids, starts, coarse=coarse, limit=MAX_ALIGNED_LANDMARKS)
            self._add_time("align")
            if matcher.is_complete(observations, pyramids):
                return predicted, observations, ROUGH_START_SCALES if coarse else (1.0,)
        joint, single = matcher.flow(pyramids, predicted)
        self._add_time("flow")
        retry = matcher.align(stamp, pyramids, single, limit=MAX_ALIGNED_LANDMARKS)
        self._add_time("align")
        if observations is not None and len(observations) > len(retry):
            return predicted, observations, ROUGH_START_SCALES
        return joint, retry, ROUGH_START_SCALES

    def _lost_cameras(self, tracked: TrackedSet) -> list[int]:
        """Cameras that carried the last pose and now measure few landmarks."""
        assert self._matcher is not None
        rivals = {c for rival in tracked.fit.rivals if rival.inlier.any() for c in rival.cameras}
        counts = {c: self._matcher.last_count(c) for c in tracked.pyramids if c not in rivals}
        return [c for c, n in counts.items() if n >= 20 and tracked.fit.used[c] < 0.3 * n]

    def _second_try(self, tracked: TrackedSet, predicted: Array) -> TrackedSet:
        """The frame set aligned from a better start: the pose of the other cameras, or the predicted one (4, 4).

        Relocalisation by SIFT takes 50 ms a camera and would delay the pose, so it runs in `idle`; but at once for an
        unconfirmed first map, which is of little use until two cameras have seen it again.
        """
        tracked = self._realign(tracked, tracked.fit.solution.base_from_surface if tracked.fit.measured else predicted)
        unsure = not self._estimator.confirmed and len(self._carrying_cameras(tracked)) < min(2, len(tracked.pyramids))
        if unsure and (place := self._search.find(tracked.pyramids)) is not None:
            tracked = self._realign(tracked, place.base_from_surface, place.single)
        return tracked

    def _realign(self, tracked: TrackedSet, start: Array, single: dict[int, Array] | None = None) -> TrackedSet:
        """Align and fit again from a start (4, 4), or by camera from `single`; the better of both fits."""
        starts = {c: (single or {}).get(c, start) for c in tracked.pyramids}
        retry = self._mapping.align_and_fit(tracked.fit.stamp, tracked.pyramids, starts, start)
        better = not tracked.fit.measured or retry.fit.used.sum() > tracked.fit.used.sum()
        return retry if retry.fit.measured and better else tracked

    def _carrying_cameras(self, tracked: TrackedSet) -> list[int]:
        """The cameras that carry a fit as they carried the last one."""
        return sorted(set(self._estimator.carrying_cameras(tracked.fit).tolist()) - set(self._lost_cameras(tracked)))

    def _relocalise(self) -> None:
        """Relocalise by SIFT, in the last images, a camera that lost the surface, for the start of the next flow."""
        pyramids, self._search_pyramids = self._search_pyramids, {}
        if not pyramids or self._matcher is None:
            return
        camera = sorted(pyramids)[self._absent_sets % len(pyramids)]  # one camera per frame set
        place = self._search.find({camera: pyramids[camera]}, half=self._absent_sets % FULL_SEARCH_INTERVAL != 0)
        if place is None:
            return
        pose = place.base_from_surface
        starts = {c: place.single.get(c, pose) for c in pyramids}
        retry = self._mapping.align_and_fit(self.last.observations.stamp, pyramids, starts, pose)
        if retry.fit.measured:
            pose = retry.fit.solution.base_from_surface
            self._matcher.remember(pyramids, retry.observations, retry.fit.inlier, pose)
            self._relocalised_pose = pose if self._absent_sets else None
