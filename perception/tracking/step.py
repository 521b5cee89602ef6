"""TrackingStep: one frame set in, one surface pose out; no I/O and no clock of its own.

The motion model, or where that is not sure enough flow from the last images, predicts where each landmark is, alignment
with the landmark's reference picture measures it, the estimator fits the pose. When too little is found the surface is
searched by its SIFT features.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.fit import Fit
from estimation.observations import Observations, no_observations
from estimation.online.estimator import Estimator
from estimation.pose import SurfacePose, identity_pose
from estimation.rig import Rig
from estimation.scan import Scan
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.features import grey
from perception.frames import FrameSet, Image, Roi
from perception.freshness import Freshness
from perception.ink import Ink
from perception.lens import Lenses
from perception.mapping.mapping import Mapping
from perception.matching.features import Relocaliser
from perception.matching.masks import KeepOut
from perception.matching.matcher import Matcher
from perception.matching.patches import Pyramid, pyramid
from perception.prefilter import untouched
from perception.side_by_side import side_by_side
from perception.tool import Tool

STAGES = ("prepare", "flow", "align", "pose", "search")
ENOUGH = 120  # landmarks of a camera: at 0.2 px they tell a pose to 0.01 mm, and what they share is not told by more
FAR = 4.0, 1.0  # scales of a fit whose start may be pixels off
NEAR, AROUND = 0.8, 2.5  # px, one sigma: three of it are what alignment reaches on the full image, and on the half one
FULL_SEARCH = 10  # frame sets of an absent surface between searches at full size: a far one needs it


@dataclass(frozen=True, slots=True, eq=False)
class StepReport:
    """What one step did.

    used: (C,) tracks per camera that carry the pose. seconds: (len(STAGES),) by `clock`. offsets: (C,) s, how much
    later than stamped each camera was taken to expose, against the mean of all; offset_sigmas: (C,) s, one standard
    deviation, nan where nothing is learned of it.
    """

    observations: Observations
    used: NDArray[np.int64]
    seconds: Array
    offsets: Array
    offset_sigmas: Array


def trusting_report(observations: Observations, used: NDArray[np.int64], seconds: Array) -> StepReport:
    """Of a step that takes every stamp for the instant of its exposure."""
    return StepReport(observations, used, seconds, np.zeros(len(used)), np.full(len(used), np.nan))


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
        prefilter: Callable[[Image], Image] = untouched,
    ) -> None:
        """Ready for the first frame set.

        roi: where the surface is when it first comes into view; without one, whatever two cameras see is the surface.
        clock: only to fill `StepReport.seconds`. executor: where the map is refined (a process of its own keeps GTSAM's
        hold on the interpreter away from the frames); without one it is done in `idle`. Poses are the same either way.
        scan: its frame is the surface frame; without one that is laid into the first map (origin at the landmarks'
        centroid, z out of the surface). tool: what hangs on the arm, where frame sets tell of a print head.
        prefilter: done to each grey picture before anything is looked for in it.
        """
        self.rig, self.roi, self._clock = rig, tuple(roi), clock
        self._lenses, self._prefilter = Lenses(rig), prefilter
        self._estimator = Estimator(rig)
        self._fresh = Freshness()
        self._search = Relocaliser(self._lenses)
        self._keep_out = KeepOut(self._lenses, tool)
        self._mapping = Mapping(self._lenses, self.roi, self._search, executor, scan, self._keep_out)
        self._matcher: Matcher | None = None
        self._lost: dict[int, Pyramid] = {}  # images of cameras that are to be searched once the pose is handed over
        self._found: Array | None = None  # (4, 4), where the last search saw the surface
        self._absent = 0  # frame sets since the surface was last measured
        self._spent = np.zeros(len(STAGES))
        self._lap = 0.0

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp` from this frame set and the ones before."""
        self._spent = np.zeros(len(STAGES))
        self._lap = self._clock()
        last = self._estimator.pose
        if last is not None and frames.stamp <= last.stamp:  # the same instant again tells nothing new
            self.last = self._report(no_observations(frames.stamp), np.zeros(len(self.rig), np.int64))
            return last
        self._check(frames)
        pyramids = self._pyramids(frames)
        self._keep_out.look(frames.head, pyramids)
        self._took("prepare")
        if self._matcher is None:
            pose, observations, used = self._initialise(frames, pyramids)
        else:
            pose, observations, used = self._track(self._matcher, frames.stamp, pyramids)
            if pose.state.measured:
                bead = self._keep_out.lay(frames.head, pose.stamp, pose.base_from_surface)
                if bead is not None:
                    self._matcher.cover(bead)
        self.last = self._report(observations, used)
        return pose

    @property
    def map(self) -> SurfaceMap | None:
        """The map as it is now, in the surface frame; None before there is one."""
        return self._estimator.map

    def idle(self) -> None:
        """Work that no pose waits for; the caller's loop calls it once a pose is handed over."""
        self._estimator.learn()
        if self._matcher is not None:
            self._mapping.keep(self._matcher, self._estimator)
        self._recover()

    def _report(self, observations: Observations, used: NDArray[np.int64]) -> StepReport:
        cameras = self._estimator.cameras
        return StepReport(observations, used, self._spent, cameras.offset, cameras.offset_sigma)

    def _check(self, frames: FrameSet) -> None:
        for frame in frames.frames:
            camera, (h, w) = self.rig.cameras[frame.camera], frame.image.shape[:2]
            if (w, h) != camera.size:
                raise InputError(f"camera {camera.name}", "image size", f"{w} x {h}", "{} x {} px".format(*camera.size))

    def _pyramids(self, frames: FrameSet) -> dict[int, Pyramid]:
        """The new pictures, by camera; one that was there before would say that the surface stands still."""
        greys = side_by_side(lambda image: self._prefilter(grey(image)), [f.image for f in frames.frames])
        images = {f.camera: image for f, image in zip(frames.frames, greys, strict=True)}
        fresh = {c: pyramid(image) for c, image in images.items() if self._fresh(c, image)}
        self._estimator.health.pictures(fresh, images.keys() - fresh.keys())
        return fresh

    def _took(self, stage: str) -> None:
        now = self._clock()
        self._spent[STAGES.index(stage)] += now - self._lap
        self._lap = now

    # -- the first map

    def _initialise(
        self, frames: FrameSet, pyramids: dict[int, Pyramid]
    ) -> tuple[SurfacePose, Observations, NDArray[np.int64]]:
        none = np.zeros(len(self.rig), np.int64)
        first = self._mapping.first_map(frames, pyramids)
        self._took("search")
        if isinstance(first, str):
            return identity_pose(frames.stamp, first), no_observations(frames.stamp), none
        matcher = self._matcher = Matcher(self._lenses, first.map, first.templates, self._keep_out)
        self._keep_out.ink = Ink()
        pose, observations, fit = self._mapping.begin(frames.stamp, first, matcher, self._estimator, pyramids)
        self._took("search")
        return pose, observations, fit.used

    # -- every frame after it

    def _track(
        self, matcher: Matcher, stamp: float, pyramids: dict[int, Pyramid]
    ) -> tuple[SurfacePose, Observations, NDArray[np.int64]]:
        estimator = self._estimator
        assert estimator.map is not None
        expected = estimator.expected(stamp)
        if self._found is not None:
            expected, self._found = replace(expected, base_from_surface=self._found), None
        joint, observations, scales = self._measure(matcher, expected, pyramids)
        fit = estimator.fit(observations, joint, scales)
        self._took("pose")
        if not fit.measured or self._missing(fit, pyramids):
            fit, observations = self._second_try(matcher, pyramids, fit, observations, expected.base_from_surface)
            self._took("search")
        if not estimator.confirmed:
            if len(self._carried(fit, pyramids)) < 2:
                if self._mapping.expired(stamp):
                    self._matcher = None
                reason = f"the first map waits for a second look by two cameras ({fit.reason or 'one sees it'})"
                return estimator.wait(stamp, reason), observations, fit.used
            fit, observations = self._mapping.confirm(matcher, estimator, pyramids, fit, observations)
        elif fit.measured and not fit.odd and estimator.hasty(fit):
            fit, observations = self._mapping.rebuild(matcher, estimator, pyramids, fit, observations)
        if fit.measured:
            self._lost = {c: pyramids[c] for c in self._missing(fit, pyramids)}
            self._absent = 0
            pose = estimator.accept(fit, observations)
            if not fit.odd:
                self._mapping.offer(fit, observations, pose.twist, estimator, pyramids)
            matcher.remember(pyramids, observations, fit.inlier, fit.solution.base_from_surface)
        else:
            pose = estimator.coast(fit)
            self._absent += 1
            self._lost = pyramids
        self._took("pose")
        return pose, observations, fit.used

    def _measure(
        self, matcher: Matcher, expected: SurfacePose, pyramids: dict[int, Pyramid]
    ) -> tuple[Array, Observations, tuple[float, ...]]:
        """A rough joint pose, the landmarks found in the images, and the scales at which a fit should begin and end.

        Alignment begins where the motion puts the surface, if that is known to some pixels, on the half-size images if
        not to one. Flow is asked where it is not, and where alignment finds fewer landmarks than the last images had.
        """
        stamp, guess, observations = expected.stamp, expected.base_from_surface, None
        late = self._estimator.cameras.delays.sigma * expected.twist
        seen = self._estimator.as_exposed(guess, expected.twist)
        doubt = matcher.doubt(guess, expected.covariance + np.outer(late, late))
        if doubt < AROUND:
            starts = {c: seen[c] for c in pyramids}
            observations = matcher.align(stamp, pyramids, starts, coarse=doubt > NEAR, most=ENOUGH)
            self._took("align")
            if matcher.complete(observations, pyramids):
                return guess, observations, FAR if doubt > NEAR else (1.0,)
        joint, single = matcher.flow(pyramids, guess)
        self._took("flow")
        again = matcher.align(stamp, pyramids, single, most=ENOUGH)
        self._took("align")
        if observations is not None and len(observations) > len(again):
            return guess, observations, FAR
        return joint, again, FAR

    def _missing(self, fit: Fit, pyramids: dict[int, Pyramid]) -> list[int]:
        """Cameras that carried the last pose and now hardly see the surface."""
        assert self._matcher is not None
        before = {c: self._matcher.seen(c) for c in pyramids}
        return [c for c, n in before.items() if n >= 20 and fit.used[c] < 0.3 * n]

    def _second_try(
        self, matcher: Matcher, pyramids: dict[int, Pyramid], fit: Fit, observations: Observations, expected: Array
    ) -> tuple[Fit, Observations]:
        """What a missing camera, or all of them, show from a better start: the other cameras' pose, or the motion's.

        expected: (4, 4), by the motion. The search by SIFT takes 50 ms a camera and would hold the pose up: it is made
        in `idle`, but for a first map, which is not worth much until two cameras have seen it again.
        """
        start = fit.solution.base_from_surface if fit.measured else expected
        fit, observations = self._realign(matcher, pyramids, fit, observations, start, {})
        if not self._estimator.confirmed and len(self._carried(fit, pyramids)) < min(2, len(pyramids)):
            found = self._search.find(pyramids)
            if found is not None:
                joint, single = found.base_from_surface, found.single
                fit, observations = self._realign(matcher, pyramids, fit, observations, joint, single)
        return fit, observations

    def _realign(
        self,
        matcher: Matcher,
        pyramids: dict[int, Pyramid],
        fit: Fit,
        observations: Observations,
        start: Array,
        single: dict[int, Array],
    ) -> tuple[Fit, Observations]:
        """Align and fit again from another start, joint (4, 4) and by camera where it has its own; keep the better."""
        again = matcher.align(fit.stamp, pyramids, {c: single.get(c, start) for c in pyramids}, coarse=True)
        refit = self._estimator.fit(again, start)
        better = refit.measured and (not fit.measured or refit.used.sum() > fit.used.sum())
        return (refit, again) if better else (fit, observations)

    def _carried(self, fit: Fit, pyramids: dict[int, Pyramid]) -> list[int]:
        """The cameras that carry a fit as they carried the last one."""
        return sorted(set(self._estimator.carriers(fit).tolist()) - set(self._missing(fit, pyramids)))

    def _recover(self) -> None:
        """Search the last images by SIFT for cameras that have lost the surface, so that the next flow begins there."""
        pyramids, self._lost = self._lost, {}
        if not pyramids or self._matcher is None:
            return
        turn = sorted(pyramids)[self._absent % len(pyramids)]  # one camera a frame set: the next is soon there
        found = self._search.find({turn: pyramids[turn]}, half=self._absent % FULL_SEARCH != 0)
        if found is None:
            return
        pose = found.base_from_surface
        starts = {c: found.single.get(c, pose) for c in pyramids}
        again = self._matcher.align(self.last.observations.stamp, pyramids, starts, coarse=True)
        fit = self._estimator.fit(again, pose)
        if fit.measured:
            self._matcher.remember(pyramids, again, fit.inlier, fit.solution.base_from_surface)
            self._found = fit.solution.base_from_surface if self._absent else None
