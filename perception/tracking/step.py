"""TrackingStep: one frame set in, one surface pose out; no I/O and no clock of its own.

The motion model predicts where each landmark is in the images; where it is too uncertain, optical flow from the last
images does. Alignment with the landmark's reference picture measures it, and the estimator fits the pose to all. A
camera with too few measured landmarks is relocalised by SIFT features.
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
MAX_PROBE_OFFSET_PX = 0.5  # by which a camera may stand off the pose: beyond, its own pose is asked for
PARALLEL_BYTES = 4e6  # of all pictures: smaller ones are grey sooner than another thread begins
FULL_SEARCH_INTERVAL = 10  # frame sets of an absent surface between searches at full size: a far one needs it


@dataclass(frozen=True, slots=True, eq=False)
class StepReport:
    """What one step did, for C cameras."""

    observations: Observations
    used: NDArray[np.int64]  # (C,) tracks that carry the pose
    seconds: Array  # (len(STAGES),) s, by the step's clock
    offsets: Array  # (C,) s, by which each camera was taken to expose later than stamped, against the mean of all
    offset_sigmas: Array  # (C,) s, one standard deviation, nan where nothing is learned of it


def report_without_offsets(observations: Observations, used: NDArray[np.int64], seconds: Array) -> StepReport:
    """The report of a step that takes every stamp for the instant of its exposure."""
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
        clock: fills `StepReport.seconds` and nothing else.
        executor: where the map is refined; in a process of its own GTSAM does not hold up the frames. Without one the
            map is refined in `idle`. Poses are the same either way.
        waits: whether `idle` waits for what is due; else it counts once it is there, and poses depend on when that is.
        scan: its frame is the surface frame; without one the first map defines it (origin at the landmarks' centroid, z
            out of the surface).
        tool: shape of the print head, masked where frame sets tell its pose.
        prefilter: applied to each grey picture first.
        """
        self.rig, self.roi, self._clock = rig, tuple(roi), clock
        self._lenses, self._prefilter = Lenses(rig), prefilter
        whole = of_whole_pictures(self.roi, [camera.size for camera in rig.cameras])
        found = any(roi.found for roi in self.roi)
        self._estimator = Estimator(rig, region="none" if whole else "found" if found else "drawn")
        self._is_new = DuplicateFilter()
        self._search, self._masks = Relocaliser(self._lenses), TrackingMasks(self._lenses, tool)
        how = executor, scan, waits
        self._mapping = Mapping(self._lenses, self.roi, self._search, self._estimator, self._masks, *how)
        self._matcher: Matcher | None = None
        self._forget_looks()
        self._unverified: TrackedSet | None = None  # by which the verification is to learn the surface
        self._images: dict[int, Image] = {}  # of the frame set, as they came,
        self._pictures: dict[int, Pyramid] = {}  # and of the last one
        self._searched: dict[int, Pyramid] = {}  # images of cameras that `idle` is to search for the surface
        self._relocalised: Array | None = None  # (4, 4), where the last search saw the surface
        self._absent = 0  # frame sets since the surface was last measured
        self._spent, self._lap = np.zeros(len(STAGES)), 0.0

    def _forget_looks(self) -> None:
        """Know nothing of how the surface looks, as before its map."""
        self._verification, self._grain = Verification(self._lenses, self._masks), Grain(self._lenses)
        self._colours = Colours(self._lenses, self._masks)

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp` from this frame set and the ones before."""
        self._spent, self._lap = np.zeros(len(STAGES)), self._clock()
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
        """How often a part of the map was not ready when it was due."""
        return self._mapping.late

    @property
    def window_graph(self) -> str:
        """The factor graph of the last poses in Graphviz's language."""
        return self._estimator.window_graph

    @property
    def registration(self) -> Registration | None:
        """Where the scan lies, as of the pictures that confirmed the first map; None before, and without a scan."""
        return self._mapping.registration

    def idle(self) -> None:
        """Work that no pose waits for: learning, mapping, relocalisation. Call it after each pose."""
        self._estimator.learn()
        if self._matcher is not None:
            self._mapping.update()
        if self._unverified is not None and self._estimator.map is not None:
            tracked, self._unverified = self._unverified, None
            poses = self._mapping.camera_poses(tracked)
            self._verification.begin(tracked.fit.stamp, tracked.pyramids, poses, self._estimator.map)
            carrying = {c: poses[c] for c in self._carrying_cameras(tracked) if c in poses}
            self._colours.begin(self._images, carrying, self._estimator.map)
        if self._mapping.look_for_hint(self._pictures, repeats=len(self._verification.aliases) > 0):
            self._matcher = self._unverified = None
        self._relocalise()

    def _report(self, observations: Observations, used: NDArray[np.int64]) -> StepReport:
        cameras = self._estimator.cameras
        return StepReport(observations, used, self._spent, cameras.offset, cameras.offset_sigma)

    def _check(self, frames: FrameSet) -> None:
        for frame in frames.frames:
            camera, (h, w) = self.rig.cameras[frame.camera], frame.image.shape[:2]
            if (w, h) != camera.size:
                raise InputError(f"camera {camera.name}", "image size", f"{w} x {h}", "{} x {} px".format(*camera.size))

    def _pyramids(self, frames: FrameSet) -> dict[int, Pyramid]:
        """The new pictures by camera; with a repeated one the surface would seem to stand still."""
        pictures, cameras = [f.image for f in frames.frames], [f.camera for f in frames.frames]
        alone = sum(image.size for image in pictures) < PARALLEL_BYTES and self._prefilter is unfiltered
        greys = [*map(grey, pictures)] if alone else parallel_map(lambda image: self._prefilter(grey(image)), pictures)
        fresh = {c: Pyramid(image) for c, image in zip(cameras, greys, strict=True) if self._is_new(c, image)}
        self._estimator.health.set_pictures(fresh, set(cameras) - fresh.keys())
        return fresh

    def _add_time(self, stage: str) -> None:
        now = self._clock()
        self._spent[STAGES.index(stage)] += now - self._lap
        self._lap = now

    # -- the first map

    def _initialise(self, frames: FrameSet, pyramids: dict[int, Pyramid]) -> _StepResult:
        started = self._mapping.start(frames, pyramids)
        self._add_time("search")
        if isinstance(started, str):
            none = np.zeros(len(self.rig), np.int64)
            return identity_pose(frames.stamp, started), no_observations(frames.stamp), none
        self._matcher, pose, tracked = started
        self._forget_looks()
        return pose, tracked.observations, tracked.fit.used

    # -- every frame set after it

    def _track(self, matcher: Matcher, stamp: float, pyramids: dict[int, Pyramid]) -> _StepResult:
        estimator = self._estimator
        assert estimator.map is not None
        expected = estimator.expected(stamp)
        if self._relocalised is not None:
            expected, self._relocalised = replace(expected, base_from_surface=self._relocalised), None

        # measurement and fit, from a second start where cameras lost the surface
        joint, observations, scales = self._measure(matcher, expected, pyramids)
        tracked = TrackedSet(estimator.fit(observations, joint, scales), observations, pyramids)
        self._add_time("pose")
        if not tracked.fit.measured or self._lost_cameras(tracked):
            tracked = self._second_try(tracked, expected.base_from_surface)
            self._add_time("search")

        # the map's confirmation, or its rebuilding on a fast surface; or else the pose's verification
        fit, aliases = tracked.fit, SURE.sizes
        if not estimator.confirmed:
            if len(self._carrying_cameras(tracked)) < 2:
                if self._mapping.expired(stamp):
                    self._matcher = None
                reason = f"the first map waits for a second look by two cameras ({fit.reason or 'one sees it'})"
                return estimator.hold(stamp, reason), tracked.observations, fit.used
            tracked = self._unverified = self._mapping.confirm(tracked)
        elif fit.measured and not fit.outliers and estimator.too_fast_for_map(fit):
            tracked = self._unverified = self._mapping.rebuild(tracked)
        elif fit.measured:
            tracked, aliases = self._verified(tracked)

        # the pose
        fit, observations = tracked.fit, tracked.observations
        if fit.measured:
            self._searched = {c: pyramids[c] for c in self._lost_cameras(tracked)}
            self._absent = 0
            exposed = estimator.as_exposed(fit.solution.base_from_surface, fit.twist)
            fit = replace(fit, shadowed=matcher.lit(pyramids, exposed, observations, ~fit.inlier))
            away = estimator.elsewhere(fit, observations)
            place = fit.solution.base_from_surface
            apart = None if away is None else matcher.align_at(stamp, pyramids, place, away.rows, away.points)
            there = {c: exposed[c] for c in self._carrying_cameras(tracked)}
            displaced = self._colours(self._images, there, estimator.expected(stamp).warp)
            pose = estimator.accept(fit, observations, apart, aliases, displaced)
            if not (fit.outliers or fit.rivals or len(aliases) or displaced.whole):
                self._mapping.offer(tracked, pose.twist)
            matcher.remember(pyramids, observations, fit.followed, fit.solution.base_from_surface)
        else:
            pose = estimator.coast(fit)
            self._absent += 1
            self._searched = pyramids
        self._add_time("pose")
        return pose, observations, fit.used

    def _verified(self, tracked: TrackedSet) -> tuple[TrackedSet, Array]:
        """The frame set at the alias that its pictures prefer, and how far (K,) mm away those are that they leave open.

        It is no measurement where the surface's grain contradicts its tracks.
        """
        poses, verdict = self._look(tracked)
        given, first, ruled_out = tracked, poses, list[int]()
        for number, moved in enumerate(verdict.alive[: verdict.rivals]):
            starts, pose = {c: pose @ moved for c, pose in first.items()}, given.fit.solution.base_from_surface
            again = self._mapping.align_and_fit(given.fit.stamp, given.pyramids, starts, pose @ moved)
            if not again.fit.measured:
                continue
            there, second = self._look(again)
            if second.likeness > verdict.likeness + BETTER_LIKENESS:
                tracked, poses, verdict = again, there, second
            elif second.likeness < verdict.likeness - WORSE_LIKENESS and tracked is given:
                ruled_out.append(number)
        aliases = np.delete(verdict.sizes, ruled_out) if tracked is given else verdict.sizes
        if tracked is not given:
            self._estimator.forget_motion()
        light = self._follows_light(tracked)
        if light:
            return replace(tracked, fit=replace(tracked.fit, reason=light)), aliases
        if not len(aliases):
            self._verification.take(tracked.fit.stamp, poses)
            self._grain.learn()
        return tracked, aliases

    def _follows_light(self, tracked: TrackedSet) -> str:
        """Why the tracks that carry a fit do not show the surface, or ''."""
        assert self._matcher is not None
        fit = tracked.fit
        tracks, pose = tracked.observations.only(fit.inlier), fit.solution.base_from_surface
        doubted = self._estimator.looks_unusual(fit)
        return self._grain(tracked.pyramids, tracks, pose, self._matcher.map, self._matcher.templates, doubted)

    def _look(self, tracked: TrackedSet) -> tuple[dict[int, Array], Verdict]:
        """Each trusted camera's own pose (4, 4) of a frame set, and what the pictures say of it."""
        if not len(self._verification.aliases):
            return {}, SURE
        fit = tracked.fit
        exposed = self._estimator.as_exposed(fit.solution.base_from_surface, fit.twist)
        apart = np.nanmax(fit.offsets, initial=0.0) > MAX_PROBE_OFFSET_PX
        poses = self._mapping.camera_poses(tracked) if apart else {c: exposed[c] for c in tracked.pyramids}
        trusted = {c: pose for c, pose in poses.items() if c not in fit.outliers}
        return trusted, self._verification(fit.stamp, tracked.pyramids, trusted)

    def _measure(
        self, matcher: Matcher, expected: SurfacePose, pyramids: dict[int, Pyramid]
    ) -> tuple[Array, Observations, tuple[float, ...]]:
        """A start for the fit (4, 4), the landmarks measured in the images, and the fit's scales, from coarse to fine.

        Alignment begins at the predicted pose where that is known to COARSE_REACH_PX, on the half-size images unless it
        is known to FINE_REACH_PX. Optical flow gives the start where the prediction is less certain, and where fewer
        landmarks are measured than in the last images.
        """
        stamp, predicted, observations = expected.stamp, expected.base_from_surface, None
        late = self._estimator.cameras.delays.sigma * expected.twist  # (6,) by which an exposure may be off
        sigma = matcher.image_sigma(predicted, expected.covariance + np.outer(late, late))
        if sigma < COARSE_REACH_PX:
            exposed = self._estimator.as_exposed(predicted, expected.twist)
            apart = self._estimator.health.rivals.own_poses(onwards=True)
            starts, coarse = {c: apart.get(c, exposed[c]) for c in pyramids}, sigma > FINE_REACH_PX
            observations = matcher.align(stamp, pyramids, starts, coarse=coarse, most=MAX_ALIGNED_LANDMARKS)
            self._add_time("align")
            if matcher.is_complete(observations, pyramids):
                return predicted, observations, ROUGH_START_SCALES if coarse else (1.0,)
        joint, single = matcher.flow(pyramids, predicted)
        self._add_time("flow")
        again = matcher.align(stamp, pyramids, single, most=MAX_ALIGNED_LANDMARKS)
        self._add_time("align")
        if observations is not None and len(observations) > len(again):
            return predicted, observations, ROUGH_START_SCALES
        return joint, again, ROUGH_START_SCALES

    def _lost_cameras(self, tracked: TrackedSet) -> list[int]:
        """Cameras that carried the last pose and now hardly see the surface."""
        assert self._matcher is not None
        apart = {c for rival in tracked.fit.rivals if rival.inlier.any() for c in rival.cameras}
        before = {c: self._matcher.last_count(c) for c in tracked.pyramids if c not in apart}
        return [c for c, n in before.items() if n >= 20 and tracked.fit.used[c] < 0.3 * n]

    def _second_try(self, tracked: TrackedSet, predicted: Array) -> TrackedSet:
        """The frame set aligned from a better start: the pose of the other cameras, or the predicted one (4, 4).

        Relocalisation by SIFT takes 50 ms a camera and would delay the pose, so it runs in `idle`. Only an unconfirmed
        first map does not wait for that: it is worth little until two cameras have seen it again.
        """
        tracked = self._realign(tracked, tracked.fit.solution.base_from_surface if tracked.fit.measured else predicted)
        unsure = not self._estimator.confirmed and len(self._carrying_cameras(tracked)) < min(2, len(tracked.pyramids))
        if unsure and (place := self._search.find(tracked.pyramids)) is not None:
            tracked = self._realign(tracked, place.base_from_surface, place.single)
        return tracked

    def _realign(self, tracked: TrackedSet, start: Array, single: dict[int, Array] | None = None) -> TrackedSet:
        """Align and fit again from a start (4, 4), or by camera from `single`; the better of both fits."""
        starts = {c: (single or {}).get(c, start) for c in tracked.pyramids}
        again = self._mapping.align_and_fit(tracked.fit.stamp, tracked.pyramids, starts, start)
        more = not tracked.fit.measured or again.fit.used.sum() > tracked.fit.used.sum()
        return again if again.fit.measured and more else tracked

    def _carrying_cameras(self, tracked: TrackedSet) -> list[int]:
        """The cameras that carry a fit as they carried the last one."""
        return sorted(set(self._estimator.carrying_cameras(tracked.fit).tolist()) - set(self._lost_cameras(tracked)))

    def _relocalise(self) -> None:
        """Search the last images by SIFT for cameras that have lost the surface, so that the next flow begins there."""
        pyramids, self._searched = self._searched, {}
        if not pyramids or self._matcher is None:
            return
        camera = sorted(pyramids)[self._absent % len(pyramids)]  # one a frame set: the next set comes soon
        place = self._search.find({camera: pyramids[camera]}, half=self._absent % FULL_SEARCH_INTERVAL != 0)
        if place is None:
            return
        pose = place.base_from_surface
        starts = {c: place.single.get(c, pose) for c in pyramids}
        again = self._mapping.align_and_fit(self.last.observations.stamp, pyramids, starts, pose)
        if again.fit.measured:
            pose = again.fit.solution.base_from_surface
            self._matcher.remember(pyramids, again.observations, again.fit.inlier, pose)
            self._relocalised = pose if self._absent else None
