"""The map of a surface: the first map, its confirmation, its refinement at key frames, and its growth."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.mapping.bundle_adjustment import AdjustedMap, fit_single_camera
from estimation.mapping.refiner import DelayedJob, Refiner, sets_until_ready
from estimation.observations import Observations
from estimation.online.estimator import Estimator
from estimation.online.fit import FrameFit
from estimation.pose import SurfacePose
from estimation.scans.registration import Registration
from estimation.scans.scan import Scan
from estimation.se3 import Array, Index
from estimation.surface_map import SurfaceMap, merge_maps, transform_map
from perception.frames import FrameSet, Image, Roi, region_polygons, whole_pictures
from perception.lens import Lenses
from perception.mapping.features import Relocaliser, calibration_hint
from perception.mapping.first_map import FEW_SPOTS, FirstMap, build_first_map, in_frame
from perception.mapping.growth import (
    GROWTH_SHARE,
    MIN_NEW_LANDMARKS,
    TARGET_PER_CAMERA,
    NewLandmarks,
    Probation,
    SurfaceSnapshot,
    between_known,
    find_new_landmarks,
)
from perception.mapping.masks import Ink, TrackingMasks, patch_reach
from perception.mapping.matcher import Matcher
from perception.mapping.patches import Pyramid
from perception.mapping.scan_map import ScanPlacing, as_at_one_instant, landmarks_on_scan

EAGER_TRIES = 5  # tries for a first map, 0.5 s and more each, before only every tenth frame set is tried
RETRY_INTERVAL_SETS = 10  # frame sets from one try to the next after those
MAX_LANDMARKS = 600  # those out of view are kept, and cost little
MIN_TRACK_SHARE = 0.5  # of the landmarks in a camera's view; fewer are measured in a blurred or covered image
FIRST_MAP_REFINEMENTS = 6  # after these, two of them the confirmation, deformation is no error of the first map
MIN_SURE_VIEWS = 1.5  # mean number of cameras in which a first map's landmark is an inlier: 1 of matches by chance
CHECK_WINDOW_S = 1.0  # s from the first map in which it is checked where cameras contradict each other
HINT_INTERVAL_SETS = 100  # frame sets without a map from one search for a hint to the next
CONFIRMATION_TIMEOUT_S = 2.0  # after which an unconfirmed first map is dropped, and the next images are tried


@dataclass(frozen=True, slots=True, eq=False)
class TrackedSet:
    """One frame set as it was tracked: the landmarks measured in its images, and the pose fitted to them."""

    fit: FrameFit
    observations: Observations  # tracks are rows of the map
    pyramids: dict[int, Pyramid]  # images by camera


class Mapping:
    """Makes and updates the map of one surface, with the matcher and the estimator.

    registration: pose of the scan by the pictures that confirmed the first map; None before, and without a scan.
    """

    _matcher: Matcher  # of the map since the last `start`

    def __init__(
        self,
        lenses: Lenses,
        roi: Sequence[Roi],
        search: Relocaliser,
        estimator: Estimator,
        masks: TrackingMasks,
        executor: Executor | None = None,
        scan: Scan | None = None,
        waits: bool = True,
    ) -> None:
        """roi: where the surface is when it first comes into view. search: learns each view that is mapped.

        masks: where no landmark may begin. executor: refines the map. scan: its frame is the surface frame. waits:
        whether to wait for results of the executor that are due.
        """
        self._lenses, self._roi, self._search = lenses, tuple(roi), search
        self._estimator, self._masks = estimator, masks
        self._placing = None if scan is None else ScanPlacing(scan)
        self._first_registration: Registration | None = None  # of the scan, at the first instant
        self.registration: Registration | None = None
        self._refiner = Refiner(lenses.rig, executor, waits)
        self._camera_centre = np.mean([c.base_from_camera[:3, 3] for c in lenses.rig.cameras], axis=0)
        self._tries, self._failure = 0, ""  # to make a first map, and why the last one failed
        self._map_stamp = 0.0  # s, stamp of the first map
        self._caveat = ""  # of every pose on this map, in words
        self._refinements = 0  # of this map
        self._early_deformation = False  # the surface seemed to deform while the first map could be the cause
        self._hint: DelayedJob[tuple[frozenset[int], str]] = DelayedJob(executor, waits=waits)
        self._next_hint_try, self._hint_text = 0, ""  # number of tries, and the last hint's text
        self._hint_input: tuple[dict[int, Image], dict[int, Array], frozenset[int]] | None = None  # of the next search
        # of a first map: whether a check was begun, whether its result is open, and why it was dropped
        self._check_begun, self._check_open, self._refutation = False, False, ""
        self._unseen_cameras: frozenset[int] = frozenset()  # cameras whose pictures show nothing of the map
        self._growth: DelayedJob[NewLandmarks] = DelayedJob(executor, waits=waits)
        self._probation: Probation | None = None
        self._candidate: tuple[TrackedSet, bool] | None = None  # the last frame set, and whether the map may use it

    @property
    def late(self) -> int:
        """How often a result of the executor was not ready when due."""
        return self._refiner.late + self._growth.late

    def start(self, frames: FrameSet, pyramids: dict[int, Pyramid]) -> tuple[Matcher, SurfacePose, TrackedSet] | str:
        """Begin with a first map of these images (by camera): its matcher, its pose, and the frame set tracked with it.

        A str says why there is no map yet.
        """
        first = self._first_map(frames, pyramids)
        if isinstance(first, str):
            return first
        stamp, start = frames.stamp, first.base_from_surface
        self._map_stamp, self._masks.ink = stamp, Ink()
        self._matcher = Matcher(self._lenses, first.map, first.templates, self._masks)
        pose = self._estimator.begin(stamp, start, first.map, self._caveat)
        tracked = self.align_and_fit(stamp, pyramids, dict.fromkeys(pyramids, start), start)
        self._check_begun = False
        if int(tracked.fit.inlier.sum()) < MIN_SURE_VIEWS * len(first.map):
            self._begin_check(pyramids)
        self._refiner.begin(first.map, stamp, start, tracked.observations)
        self._growth.cancel()
        self._probation = self._candidate = None
        self._refinements, self._early_deformation = 0, False
        self._matcher.remember(pyramids, tracked.observations, tracked.fit.inlier, start)
        for camera, images in pyramids.items():
            self._search.learn(camera, images[0], start, first.map)
        return self._matcher, pose, tracked

    def _first_map(self, frames: FrameSet, pyramids: dict[int, Pyramid]) -> FirstMap | str:
        polygons = region_polygons(self._roi, frames, [camera.size for camera in self._lenses.rig.cameras])
        if isinstance(polygons, str):
            return polygons
        self._tries += 1
        if self._refutation and self._tries < self._next_hint_try:
            return self._refutation
        if self._tries > EAGER_TRIES and self._tries % RETRY_INTERVAL_SETS:
            return self._failure_text()
        first = build_first_map(self._lenses, pyramids, polygons, self._masks.print_head)
        if isinstance(first, str):
            self._failure = first
            if first == FEW_SPOTS and self._tries >= max(EAGER_TRIES, self._next_hint_try):
                self._request_hint(pyramids, polygons, frozenset(set(pyramids) & set(polygons)))
            return self._failure_text()
        self._caveat, self._hint_text, self._refutation = "", "", ""
        self._hint_input = None
        if self._placing is None:
            return first
        images = {c: pyramids[c][0] for c in polygons}
        self._first_registration = self._placing.search(self._lenses, images, first, polygons)
        self._set_caveat(self._first_registration)
        return in_frame(first, self._first_registration.base_from_surface)

    def _begin_check(self, images: dict[int, Pyramid]) -> None:
        """Begin a check of a first map by these images (by camera): its matches may be by chance."""
        self._check_begun = self._check_open = True
        self._request_hint(images, self._regions(), frozenset(images))

    def _regions(self) -> dict[int, Array]:
        sizes = [camera.size for camera in self._lenses.rig.cameras]
        return {r.camera: r.polygon for r in self._roi or whole_pictures(sizes, 0.0)}

    def _request_hint(self, images: dict[int, Pyramid], polygons: dict[int, Array], suspects: frozenset[int]) -> None:
        """Request a search of these pictures for errors in the suspects' calibration."""
        self._next_hint_try = self._tries + HINT_INTERVAL_SETS
        cameras = sorted(set(images) & set(polygons))
        self._hint.cancel()
        self._hint_input = {c: images[c][0] for c in cameras}, polygons, suspects

    def _failure_text(self) -> str:
        return f"{self._failure}; {self._hint_text}" if self._hint_text else self._failure

    def look_for_hint(self, images: dict[int, Pyramid], repeats: bool) -> bool:
        """Once a frame set, when no pose waits: search for calibration errors of cameras that see nothing of the map.

        images: of the last frame set, by camera. repeats: whether the surface's texture is periodic; its matches then
        contradict any calibration. True where the calibration is so wrong that a map of few landmarks is by chance.
        """
        health, pose = self._estimator.health, self._estimator.pose
        recent = pose is not None and not self._check_begun and pose.stamp < self._map_stamp + CHECK_WINDOW_S
        if recent and (health.contradictory or health.left_out):
            self._begin_check(images)
        unseen = frozenset(health.unseen & images.keys()) if self._estimator.confirmed else frozenset()
        if unseen and unseen != self._unseen_cameras and not self._check_open:
            assert pose is not None
            view = self._matcher.in_view(sorted(unseen), pose.base_from_surface)
            self._unseen_cameras = frozenset(c for c, count in view.items() if count >= MIN_NEW_LANDMARKS)
            if self._unseen_cameras:
                self._request_hint(images, self._regions(), self._unseen_cameras)
                self._hint_text = ""
        if self._hint_input is not None and not self._hint.busy:
            self._hint.submit(calibration_hint, self._lenses.rig, *self._hint_input)
            self._hint_input = None
        hint = self._hint.poll()
        hint = (frozenset(), "") if hint is not None and repeats else hint
        self._hint_text = self._hint_text if hint is None else hint[1]
        health.set_unseen(self._unseen_cameras & unseen, self._hint_text)
        if hint is None or not self._check_open:
            return False
        # with one camera wrong, the map of the others may be good
        self._check_open, self._refutation = False, self._hint_text if len(hint[0]) > 1 else ""
        return bool(self._refutation)

    def align_and_fit(
        self, stamp: float, pyramids: dict[int, Pyramid], poses: dict[int, Array], start: Array
    ) -> TrackedSet:
        """Align images (by camera), each from its own pose (4, 4), coarse to fine; fit from `start` (4, 4)."""
        observations = self._matcher.align(stamp, pyramids, poses, coarse=True)
        return TrackedSet(self._estimator.fit(observations, start), observations, pyramids)

    def expired(self, stamp: float) -> bool:
        """Whether a first map that is still not confirmed at `stamp` should be dropped."""
        return stamp - self._map_stamp > CONFIRMATION_TIMEOUT_S

    def confirm(self, tracked: TrackedSet) -> TrackedSet:
        """Correct the first map by the first measured frame set after it, align and fit that again, twice."""
        for _ in range(2):
            refined = self._refiner.confirm(tracked.fit, tracked.observations, self._estimator.cameras.delays)
            if refined is None:
                break
            self._apply(refined)
            self._estimator.set_twist(self._refiner.speed(tracked.fit))
            tracked = self._realign(tracked)
        return tracked if self._placing is None else self._put_on_scan(self._placing, tracked)

    def rebuild(self, tracked: TrackedSet) -> TrackedSet:
        """Rebuild the map of a fast surface by a frame set after the confirmation, before any pose is output.

        Unknown exposure offsets of the cameras bend the map of the first instants. Later frame sets have other motion,
        mostly slower, and there is no path yet that could jump.
        """
        refined = self._refiner.rebuild(tracked.fit, tracked.observations, self._estimator.cameras.delays)
        if refined is None:
            return tracked
        self._apply(refined)
        return self._realign(tracked)

    def _realign(self, tracked: TrackedSet) -> TrackedSet:
        """The frame set aligned and fitted with a corrected map; unchanged where that gives no measurement."""
        stamp, start = tracked.fit.stamp, tracked.fit.solution.base_from_surface
        retry = self.align_and_fit(stamp, tracked.pyramids, self.camera_poses(tracked), start)
        return retry if retry.fit.measured else tracked

    def offer(self, tracked: TrackedSet, twist: Array) -> None:
        """Offer a measured frame set to refine or extend the map. twist: (6,), the surface's."""
        self._refiner.offer(tracked.fit, tracked.observations, twist, self._estimator.cameras.delays)
        self._candidate = tracked, self._estimator.may_learn(tracked.fit)

    def update(self) -> None:
        """Once a frame set, when no pose waits: apply results that are due, and submit the next jobs."""
        if self._candidate is not None and not self._candidate[1] and not self._enough_tracks(self._candidate[0]):
            self._refiner.withdraw()
            self._candidate = None
        deformed = self._estimator.deforms and (self._early_deformation or self._refinements > FIRST_MAP_REFINEMENTS)
        refined = self._refiner.freeze() if deformed else self._refiner.poll()
        if refined is not None:
            self._apply(refined, deformed)
        new = self._growth.poll()
        if new is not None:
            distance = float(np.linalg.norm(new.snapshot.base_from_surface[:3, 3] - self._camera_centre))
            self._probation = Probation(new, between_known(new, self._matcher.map, distance))
        if self._candidate is None:
            return
        (tracked, _), self._candidate = self._candidate, None
        if not self._refiner.took_keyframe:
            return
        few = any(tracked.fit.used[c] < GROWTH_SHARE * TARGET_PER_CAMERA for c in tracked.pyramids)
        if self._probation is not None:
            self._prove(self._probation, tracked)
        elif few and not self._growth.busy and len(self._matcher.map) < MAX_LANDMARKS:
            self._growth.delay = sets_until_ready(self._refiner.interval)
            self._growth.submit(find_new_landmarks, self._lenses.rig, self._snapshot(tracked), self._matcher.map)

    def _enough_tracks(self, tracked: TrackedSet) -> bool:
        """Whether a camera measures most landmarks in its view; where few are in view, few tracks suffice."""
        view = self._matcher.in_view(list(tracked.pyramids), tracked.fit.solution.base_from_surface)
        limits = {c: max(MIN_NEW_LANDMARKS, MIN_TRACK_SHARE * min(n, TARGET_PER_CAMERA)) for c, n in view.items()}
        return any(tracked.fit.used[c] >= count for c, count in limits.items())

    def _snapshot(self, tracked: TrackedSet) -> SurfaceSnapshot:
        fit, pose = tracked.fit, self._estimator.pose
        return SurfaceSnapshot(
            {c: images[0] for c, images in tracked.pyramids.items()},
            fit.solution.base_from_surface,
            self.camera_poses(tracked),
            fit.covariance + fit.parts.lasting,
            tracked.observations.select(fit.inlier),
            self._masks.print_head,
            None if pose is None else pose.warp,
        )

    def camera_poses(self, tracked: TrackedSet) -> dict[int, Array]:
        """Where the surface was (4, 4) at each camera's own exposure."""
        pose, points, rig = tracked.fit.solution.base_from_surface, self._matcher.map.points, self._lenses.rig
        tracks = tracked.observations
        return {c: fit_single_camera(rig, points, tracks, c, pose).base_from_surface for c in tracked.pyramids}

    def _prove(self, probation: Probation, tracked: TrackedSet) -> None:
        """Align the new landmarks again; add those that move with the surface to the map."""
        fit, single = tracked.fit, self.camera_poses(tracked)
        probation.look(self._lenses, fit.stamp, tracked.pyramids, single, fit.covariance + fit.parts.lasting)
        points, reach = probation.map.points, patch_reach(probation.new.templates.axes)
        proven = np.flatnonzero(probation.proven & ~self._masks.ink.covers(points, reach, fit.stamp))
        if len(proven) >= MIN_NEW_LANDMARKS:
            self._join(probation, proven[: MAX_LANDMARKS - len(self._matcher.map)])
        if len(proven) >= MIN_NEW_LANDMARKS or probation.finished:
            self._probation = None

    def _join(self, probation: Probation, index: Index) -> None:
        """Add new landmarks (index: rows) to the map, the matcher, the estimator and the search."""
        rows = (3 * index[:, None] + np.arange(3)).ravel()
        new, part = probation.new, probation.map
        part = SurfaceMap(part.points[index], part.normals[index], part.covariance[np.ix_(rows, rows)])
        whole_map = merge_maps(self._matcher.map, part)
        self._matcher.extend(whole_map, new.templates.take(index))
        self._estimator.replace_map(whole_map)
        self._refiner.extend(whole_map, probation.level[index])
        for c, features in new.features.items():
            pose = new.snapshot.single.get(c, new.snapshot.base_from_surface)
            self._search.add(c, features, pose, whole_map)

    def _set_caveat(self, place: Registration) -> None:
        self._caveat = "" if place.sure else f"the scan's place is open: {place.verdict}"

    def _put_on_scan(self, placing: ScanPlacing, tracked: TrackedSet) -> TrackedSet:
        """Register the scan again with each camera's exposure offset known, and put the landmarks onto it."""
        estimator, matcher = self._estimator, self._matcher
        assert self._first_registration is not None and estimator.pose is not None and estimator.map is not None
        pose = tracked.fit.solution.base_from_surface
        lenses = Lenses(as_at_one_instant(self._lenses.rig, pose, self.camera_poses(tracked)))
        images = {c: p[0] for c, p in tracked.pyramids.items()}
        place = placing.refine(lenses, images, replace(self._first_registration, base_from_surface=pose))
        self.registration = place
        self._set_caveat(place)
        new_from_old = se3.inverse(place.base_from_surface) @ pose
        new_map = transform_map(estimator.map, new_from_old)
        on_scan, anchors = landmarks_on_scan(new_map, matcher.templates.camera, lenses, placing.scan, place)
        start = estimator.pose.base_from_surface @ se3.inverse(new_from_old)
        self._refiner.reframe(on_scan, new_from_old, anchors)
        matcher.reframe(on_scan, new_from_old)
        self._search.reframe(new_from_old)
        estimator.begin(estimator.pose.stamp, start, on_scan, self._caveat)
        estimator.set_twist(self._refiner.speed(estimator.fit(tracked.observations, place.base_from_surface)))
        return replace(tracked, fit=estimator.fit(tracked.observations, place.base_from_surface))

    def _apply(self, refined: AdjustedMap, deformed: bool = False) -> None:
        self._refinements += 1
        first = self._refinements <= FIRST_MAP_REFINEMENTS and not deformed
        # it may be an error of the first map; if it persists with a better map, the surface deforms
        self._early_deformation |= first and self._estimator.deforms
        self._estimator.replace_map(refined.map, first, deformed)
        self._matcher.update_map(refined.map, refined.agrees)
