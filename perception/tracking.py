"""TrackingStep: one frame set in, one surface pose out; no I/O and no clock of its own.

Flow from the last images predicts where each landmark is, alignment with the landmark's reference picture measures it,
the estimator fits the pose. When too little is found the surface is searched by its SIFT features. Cameras take turns:
a thread for each was measured to gain nothing (13.3 ms against 13.9, p99 16.6 against 30, three cameras, two cores),
since most of the work is short numpy calls that hold the interpreter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.adjustment import Adjusted, single_fit
from estimation.estimator import Estimator, Fit, identity_pose
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from estimation.pose_solver import solve_pose
from estimation.refiner import Refiner
from estimation.registration import register
from estimation.rig import Rig, ideal_pixels
from estimation.scan import Scan
from estimation.se3 import Array
from perception.features import grey
from perception.first_map import FirstMap, build_first_map, in_frame
from perception.flow import flow
from perception.frames import FrameSet, Image, Roi
from perception.lens import Lenses, undistort
from perception.patches import Alignment, Templates, align, project_squares, pyramid
from perception.relocalise import Relocaliser

STAGES = ("prepare", "flow", "align", "pose", "search")
Pyramid = tuple[Image, Image]
LOOSE = np.diag([1 / 0.02**2] * 3 + [1 / 5.0**2] * 3)  # how far one camera's own pose may stray from the joint one
FLOW_TRACKS = 80  # a camera: enough for a start, and flow is only that
LEAST_SCAN_SIGMA = 0.1  # mm: no handheld scan is better
FULL_SEARCH = 10  # frame sets of an absent surface between searches at full size, off the frame's path
ROUGH = 1e-3  # rad, mm: a start for the alignment need not be better


@dataclass(frozen=True, slots=True, eq=False)
class StepReport:
    """What one step did. used: (C,) tracks per camera that carry the pose. seconds: (len(STAGES),) by `clock`."""

    observations: Observations
    used: NDArray[np.int64]
    seconds: Array


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What one camera last saw: its image, where landmarks (rows) stood in it, and the pose then."""

    image: Image
    rows: NDArray[np.int64]
    pixels: Array
    base_from_surface: Array


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
    ) -> None:
        """Ready for the first frame set.

        roi: where the surface is when it first comes into view; without one, whatever two cameras see is the surface.
        clock: only to fill `StepReport.seconds`. executor: where the map is refined (a process of its own keeps GTSAM's
        hold on the interpreter away from the frames); without one it is done in `idle`. Poses are the same either way.
        scan: its frame is the surface frame; without one that is laid into the first map (origin at the landmarks'
        centroid, z out of the surface).
        """
        self.rig, self.roi, self._clock = rig, tuple(roi), clock
        self._refiner = Refiner(rig, executor)
        self._scan = scan
        self._lenses = Lenses(rig)
        self._estimator = Estimator(rig)
        self._search = Relocaliser(self._lenses)
        self._templates: Templates | None = None
        self._views: dict[int, View] = {}
        self._agrees = np.zeros(0, bool)
        self._lost: tuple[dict[int, Pyramid], list[int]] = {}, []
        self._absent = 0  # frame sets since the surface was last measured
        self._spent = np.zeros(len(STAGES))
        self._lap = 0.0

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp` from this frame set and the ones before."""
        self._spent = np.zeros(len(STAGES))
        self._lap = self._clock()
        pyramids = {f.camera: pyramid(grey(f.image)) for f in frames.frames}
        self._took("prepare")
        if self._templates is None:
            pose, observations, used = self._initialise(frames, pyramids)
        else:
            pose, observations, used = self._track(frames.stamp, pyramids)
        self.last = StepReport(observations, used, self._spent)
        return pose

    def idle(self) -> None:
        """Work that no pose waits for; the caller's loop calls it once a pose is handed over."""
        refined = self._refiner.poll()
        if refined is not None:
            self._take(refined)
        self._recover()

    def _took(self, stage: str) -> None:
        now = self._clock()
        self._spent[STAGES.index(stage)] += now - self._lap
        self._lap = now

    # -- the first map

    def _initialise(
        self, frames: FrameSet, pyramids: dict[int, Pyramid]
    ) -> tuple[SurfacePose, Observations, NDArray[np.int64]]:
        none = np.zeros(len(self.rig), np.int64)
        polygons = self._polygons(frames)
        if isinstance(polygons, str):
            return identity_pose(frames.stamp, polygons), _no_observations(frames.stamp), none
        first = build_first_map(self._lenses, pyramids, polygons)
        self._took("search")
        if isinstance(first, str):
            return identity_pose(frames.stamp, first), _no_observations(frames.stamp), none
        caveat = ""
        if self._scan is not None:
            first, caveat = self._on_scan(first, self._scan)
        self._templates = first.templates
        pose = self._estimator.begin(frames.stamp, first.base_from_surface, first.map, caveat)
        self._agrees = np.ones(len(first.map), bool)
        starts = dict.fromkeys(polygons, first.base_from_surface)
        observations = self._align(frames.stamp, pyramids, starts, coarse=True)
        fit = self._estimator.fit(observations, first.base_from_surface)
        self._refiner.begin(first.map, frames.stamp, first.base_from_surface, observations)
        self._remember(pyramids, observations, fit.inlier, first.base_from_surface)
        for camera in polygons:
            self._search.learn(camera, pyramids[camera][0], first.base_from_surface, first.map)
        self._took("search")
        return pose, observations, fit.used

    def _on_scan(self, first: FirstMap, scan: Scan) -> tuple[FirstMap, str]:
        """The first map in the scan's frame, and what the scan's shape leaves open, or ''."""
        points = se3.transform_points(first.base_from_surface, first.map.points)
        blocks = first.map.covariance.reshape(len(points), 3, len(points), 3)
        sigma = float(np.sqrt(np.median(np.einsum("nini->n", blocks))))
        found = register(points, max(sigma, LEAST_SCAN_SIGMA), scan, first.base_from_surface[:3, 2])
        return in_frame(
            first, found.base_from_surface
        ), "" if found.sure else f"the scan's place is open: {found.verdict}"

    def _polygons(self, frames: FrameSet) -> dict[int, Array] | str:
        """Where the surface is in these images, by camera, or why that is not known yet."""
        if not self.roi:
            return {
                f.camera: np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float) * self.rig.cameras[f.camera].size
                for f in frames.frames
            }
        start = max(r.stamp for r in self.roi)
        if frames.stamp < start - 0.1:
            return f"waiting for the region of interest at {start:.3f} s"
        return {r.camera: r.polygon for r in self.roi if any(f.camera == r.camera for f in frames.frames)}

    # -- every frame after it

    def _track(self, stamp: float, pyramids: dict[int, Pyramid]) -> tuple[SurfacePose, Observations, NDArray[np.int64]]:
        estimator = self._estimator
        assert estimator.map is not None and estimator.pose is not None
        guess = estimator.predict(stamp)
        joint, single = self._flow(pyramids, guess)
        self._took("flow")
        observations = self._align(stamp, pyramids, single)
        self._took("align")
        fit = estimator.fit(observations, joint)
        self._took("pose")
        if not fit.measured or self._missing(fit, pyramids):
            fit, observations = self._second_try(stamp, pyramids, fit, observations)
            self._took("search")
        if estimator.pose.state is TrackState.INITIALISING:
            if len(self._carried(fit, pyramids)) < 2:
                reason = f"the first map waits for a second look by two cameras ({fit.reason or 'one sees it'})"
                return estimator.wait(stamp, reason), observations, fit.used
            fit, observations = self._confirm(pyramids, fit, observations)
        if fit.measured:
            self._lost, self._absent = (pyramids, self._missing(fit, pyramids)), 0
            pose = estimator.accept(fit, observations)
            self._refiner.offer(fit, observations, pose.twist, estimator.skew.sigma)
            self._remember(pyramids, observations, fit.inlier, fit.solution.base_from_surface)
        else:
            pose = estimator.coast(stamp, fit.reason)
            self._absent += 1
            self._lost = pyramids, list(pyramids) if self._absent % FULL_SEARCH == 0 else []
        self._took("pose")
        return pose, observations, fit.used

    def _confirm(self, pyramids: dict[int, Pyramid], fit: Fit, observations: Observations) -> tuple[Fit, Observations]:
        """The first measured frame set after the first map: correct the map by it, look and fit again, twice."""
        for _ in range(2):
            refined = self._refiner.confirm(fit, observations, self._estimator.skew.sigma)
            if refined is None:
                break
            self._take(refined)
            pose, points = fit.solution.base_from_surface, refined.map.points
            fits = {c: single_fit(self.rig, points, observations, c, pose) for c in pyramids}
            starts = {c: own.base_from_surface for c, own in fits.items()}
            again = self._align(fit.stamp, pyramids, starts, coarse=True)
            refit = self._estimator.fit(again, pose)
            if not refit.measured:
                break
            fit, observations = refit, again
        return fit, observations

    def _take(self, refined: Adjusted) -> None:
        self._estimator.replace_map(refined.map)
        self._agrees = refined.agrees

    def _flow(self, pyramids: dict[int, Pyramid], guess: Array) -> tuple[Array, dict[int, Array]]:
        """The joint pose by optical flow, and each camera's own: cameras are seldom exposed at the same instant."""
        assert self._estimator.map is not None
        points = self._estimator.map.points
        ready = [c for c in pyramids if c in self._views and len(self._views[c].rows) >= 6]
        moved = {c: self._flow_one(c, pyramids[c][0], guess) for c in ready}
        single = dict.fromkeys(pyramids, guess)
        if sum(len(rows) for rows, _ in moved.values()) < 6:
            return guess, single
        camera = np.concatenate([np.full(len(rows), c) for c, (rows, _) in moved.items()])
        rows = np.concatenate([rows for rows, _ in moved.values()])
        pixels = np.concatenate([pixels for _, pixels in moved.values()])
        sigma = np.ones(len(rows))
        fit = solve_pose(
            self.rig, camera, points[rows], pixels, sigma, guess, scales=(8.0, 1.5), iterations=4, tolerance=ROUGH
        )
        good = fit.weights > 0.2
        for c in pyramids:
            mine = good & (camera == c)
            single[c] = fit.base_from_surface
            if mine.sum() >= 8 and fit.scale > 1.2:  # else the cameras agree within the flow's own error
                where = rows[mine]
                own = solve_pose(
                    self.rig,
                    camera[mine],
                    points[where],
                    pixels[mine],
                    sigma[mine],
                    single[c],
                    prior=LOOSE,
                    iterations=2,
                    tolerance=ROUGH,
                )
                single[c] = own.base_from_surface
        return fit.base_from_surface, single

    def _flow_one(self, camera: int, image: Image, guess: Array) -> tuple[NDArray[np.int64], Array]:
        view = self._views[camera]
        some = slice(None, None, 1 + len(view.rows) // FLOW_TRACKS)
        rows, pixels = view.rows[some], view.pixels[some]
        before = self._imaged(camera, view.base_from_surface, rows)
        after = self._imaged(camera, guess, rows)
        found, ok = flow(view.image, image, pixels, pixels + after - before)
        return rows[ok], undistort(self.rig.cameras[camera], found[ok])

    def _imaged(self, camera: int, base_from_surface: Array, rows: NDArray[np.int64]) -> Array:
        """Where landmarks (rows) fall in a camera's image, (N, 2) px."""
        assert self._estimator.map is not None
        points_base = se3.transform_points(base_from_surface, self._estimator.map.points[rows])
        return self._lenses.image(camera, *ideal_pixels(self.rig.cameras[camera], points_base))[0]

    def _align(
        self, stamp: float, pyramids: dict[int, Pyramid], poses: dict[int, Array], coarse: bool = False
    ) -> Observations:
        """Measure the landmarks in every camera, begun where the camera's own pose puts them; coarse: from afar."""
        rows = np.nonzero(self._agrees)[0]
        cameras = [c for c in pyramids if c in poses]
        results = [self._align_one(c, pyramids[c], poses[c], rows, coarse) for c in cameras]
        found = [rows[r.found] for r in results]
        pixels = [undistort(self.rig.cameras[c], r.pixels[r.found]) for c, r in zip(cameras, results, strict=True)]
        return Observations(
            stamp,
            np.concatenate([np.full(len(f), c, np.int64) for c, f in zip(cameras, found, strict=True)]),
            np.concatenate(found),
            np.concatenate(pixels),
            np.concatenate([r.sigma[r.found] for r in results]),
        )

    def _align_one(self, camera: int, images: Pyramid, pose: Array, rows: NDArray[np.int64], coarse: bool) -> Alignment:
        assert self._estimator.map is not None and self._templates is not None
        surface_map, templates = self._estimator.map, self._templates
        where = project_squares(
            self._lenses, camera, pose, surface_map.points[rows], surface_map.normals[rows], templates.axes[rows]
        )
        return align(templates.take(rows), images, where, where.centre, coarse=coarse)

    def _missing(self, fit: Fit, pyramids: dict[int, Pyramid]) -> list[int]:
        """Cameras that carried the last pose and now hardly see the surface."""
        before = {c: len(self._views[c].rows) if c in self._views else 0 for c in pyramids}
        return [c for c, n in before.items() if n >= 20 and fit.used[c] < 0.3 * n]

    def _second_try(
        self, stamp: float, pyramids: dict[int, Pyramid], fit: Fit, observations: Observations
    ) -> tuple[Fit, Observations]:
        """What a missing camera, or all of them, show from a better start: the other cameras' pose, or one by SIFT.

        The search takes 50-200 ms and holds the pose up, so it is made here only where two agreeing cameras lack.
        """
        if fit.measured:
            fit, observations = self._realign(stamp, pyramids, fit, observations, fit.solution.base_from_surface, {})
        if len(self._carried(fit, pyramids)) < min(2, len(pyramids)):
            found = self._search.find(pyramids)
            if found is not None:
                joint, single = found.base_from_surface, found.single
                fit, observations = self._realign(stamp, pyramids, fit, observations, joint, single)
        return fit, observations

    def _realign(
        self,
        stamp: float,
        pyramids: dict[int, Pyramid],
        fit: Fit,
        observations: Observations,
        start: Array,
        single: dict[int, Array],
    ) -> tuple[Fit, Observations]:
        """Align and fit again from another start, joint (4, 4) and by camera where it has its own; keep the better."""
        again = self._align(stamp, pyramids, {c: single.get(c, start) for c in pyramids}, coarse=True)
        refit = self._estimator.fit(again, start)
        better = refit.measured and (not fit.measured or refit.used.sum() > fit.used.sum())
        return (refit, again) if better else (fit, observations)

    def _carried(self, fit: Fit, pyramids: dict[int, Pyramid]) -> list[int]:
        """The cameras that carry a fit as they carried the last one."""
        return sorted(set(self._estimator.carriers(fit).tolist()) - set(self._missing(fit, pyramids)))

    def _recover(self) -> None:
        """Search the last images by SIFT for cameras that have lost the surface, so that the next flow begins there."""
        pyramids, missing = self._lost
        self._lost = {}, []
        if not missing:
            return
        found = self._search.find({c: pyramids[c] for c in missing}, half=self._absent % FULL_SEARCH != 0)
        if found is None:
            return
        pose = found.base_from_surface
        starts = {c: found.single.get(c, pose) for c in missing}
        again = self._align(0.0, {c: pyramids[c] for c in missing}, starts, coarse=True)
        fit = self._estimator.fit(again, pose)
        if fit.measured:
            self._remember({c: pyramids[c] for c in missing}, again, fit.inlier, fit.solution.base_from_surface)

    def _remember(
        self, pyramids: dict[int, Pyramid], observations: Observations, inlier: NDArray[np.bool_], pose: Array
    ) -> None:
        for c, images in pyramids.items():
            mine = inlier & (observations.camera == c)
            from_lens, _ = self._lenses.image(c, observations.pixels[mine], np.full(int(mine.sum()), 1e3))
            self._views[c] = View(images[0], observations.track[mine], from_lens, pose)


def _no_observations(stamp: float) -> Observations:
    nothing = np.zeros(0, np.int64)
    return Observations(stamp, nothing, nothing, np.zeros((0, 2)), np.zeros(0))
