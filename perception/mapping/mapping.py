"""The map of a surface: the first map, its confirmation, its refinement at key frames, and its growth."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.mapping.bundle_adjustment import AdjustedMap, single_fit
from estimation.mapping.refiner import DelayedJob, Refiner, sets_until_ready
from estimation.observations import Observations
from estimation.online.estimator import Estimator
from estimation.online.fit import FrameFit
from estimation.pose import SurfacePose
from estimation.scans.registration import Registration
from estimation.scans.scan import Scan
from estimation.se3 import Array, Index
from estimation.surface_map import SurfaceMap, joined_map, moved_map
from perception.frames import FrameSet, Image, Roi, region_polygons, whole_pictures
from perception.lens import Lenses
from perception.mapping.features import Relocaliser, calibration_hint
from perception.mapping.first_map import FEW_SPOTS, FirstMap, build_first_map, in_frame
from perception.mapping.growth import (
    GROWTH_SHARE,
    MIN_NEW_LANDMARKS,
    WANTED_PER_CAMERA,
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
MIN_SHOWN_SHARE = 0.5  # of the landmarks in a camera's view; fewer are measured where its image is blurred or covered
FIRST_MAP_REFINEMENTS = 6  # after these, two of them the confirmation, deformation is no error of the first map
MIN_SURE_VIEWS = 1.5  # cameras in which a landmark of a first map agrees, in the mean: of matches by chance it is one
CHECKED_S = 1.0  # s of a first map in which cameras that contradict each other have it checked
HINT_INTERVAL_SETS = 100  # frame sets without a map from one search for a hint to the next
CONFIRMATION_TIMEOUT_S = 2.0  # after which an unconfirmed first map is dropped, and the next images are tried


@dataclass(frozen=True, slots=True, eq=False)
class TrackedSet:
    """One frame set as it was tracked: the landmarks measured in its images, and the pose fitted to them."""

    fit: FrameFit
    observations: Observations  # tracks are rows of the map
    pyramids: dict[int, Pyramid]  # images by camera


class Mapping:
    """Makes and keeps the map of one surface; every change is handed to the matcher and the estimator.

    registration: where the scan lies in the pictures that confirmed the first map; None before, and without a scan.
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

        masks: where no landmark may begin. executor: where the map is refined. scan: its frame is the surface frame.
        waits: whether what the executor has not done when it is due is waited for.
        """
        self._lenses, self._roi, self._search = lenses, tuple(roi), search
        self._estimator, self._masks = estimator, masks
        self._placing = None if scan is None else ScanPlacing(scan)
        self._place: Registration | None = None  # of the scan at the first instant
        self.registration: Registration | None = None
        self._refiner = Refiner(lenses.rig, executor, waits)
        self._cameras = np.mean([c.base_from_camera[:3, 3] for c in lenses.rig.cameras], axis=0)
        self._tries, self._failure = 0, ""  # to make a first map, and why the last one failed
        self._mapped = 0.0  # s, stamp of the first map
        self._caveat = ""  # of every pose on this map, in words
        self._refinements = 0  # of this map
        self._seemed_bent = False  # whether the surface seemed to deform while the first map could be the cause
        self._hint: DelayedJob[tuple[frozenset[int], str]] = DelayedJob(executor, waits=waits)
        self._hint_due, self._hinted = 0, ""  # tries until the next search for a hint; the last one's words
        self._unmapped: tuple[dict[int, Image], dict[int, Array], frozenset[int]] | None = None  # to be looked into
        # whether a first map has been looked into, whether that is still open, and why there is none in the end
        self._checked, self._doubted, self._refuted = False, False, ""
        self._unseen: frozenset[int] = frozenset()  # cameras whose pictures show nothing of the map
        self._growth: DelayedJob[NewLandmarks] = DelayedJob(executor, waits=waits)
        self._probation: Probation | None = None
        self._offered: tuple[TrackedSet, bool] | None = None  # the last frame set, and whether the map may learn of it

    @property
    def late(self) -> int:
        """How often what the executor makes was not ready when it was due."""
        return self._refiner.late + self._growth.late

    def start(self, frames: FrameSet, pyramids: dict[int, Pyramid]) -> tuple[Matcher, SurfacePose, TrackedSet] | str:
        """Begin with a first map of these images (by camera): its matcher, its pose, and the frame set tracked with it.

        A str says why there is no map yet.
        """
        first = self._first_map(frames, pyramids)
        if isinstance(first, str):
            return first
        stamp, start = frames.stamp, first.base_from_surface
        self._mapped, self._masks.ink = stamp, Ink()
        self._matcher = Matcher(self._lenses, first.map, first.templates, self._masks)
        pose = self._estimator.begin(stamp, start, first.map, self._caveat)
        tracked = self.align_and_fit(stamp, pyramids, dict.fromkeys(pyramids, start), start)
        self._checked = False
        if int(tracked.fit.inlier.sum()) < MIN_SURE_VIEWS * len(first.map):
            self._doubt(pyramids)
        self._refiner.begin(first.map, stamp, start, tracked.observations)
        self._growth.cancel()
        self._probation = self._offered = None
        self._refinements, self._seemed_bent = 0, False
        self._matcher.remember(pyramids, tracked.observations, tracked.fit.inlier, start)
        for camera, images in pyramids.items():
            self._search.learn(camera, images[0], start, first.map)
        return self._matcher, pose, tracked

    def _first_map(self, frames: FrameSet, pyramids: dict[int, Pyramid]) -> FirstMap | str:
        polygons = region_polygons(self._roi, frames, [camera.size for camera in self._lenses.rig.cameras])
        if isinstance(polygons, str):
            return polygons
        self._tries += 1
        if self._refuted and self._tries < self._hint_due:
            return self._refuted
        if self._tries > EAGER_TRIES and self._tries % RETRY_INTERVAL_SETS:
            return self._why_none()
        first = build_first_map(self._lenses, pyramids, polygons, self._masks.print_head)
        if isinstance(first, str):
            self._failure = first
            if first == FEW_SPOTS and self._tries >= max(EAGER_TRIES, self._hint_due):
                self._look_into(pyramids, polygons, frozenset(set(pyramids) & set(polygons)))
            return self._why_none()
        self._caveat, self._hinted, self._refuted = "", "", ""
        self._unmapped = None
        if self._placing is None:
            return first
        images = {c: pyramids[c][0] for c in polygons}
        self._place = self._placing.search(self._lenses, images, first, polygons)
        self._set_caveat(self._place)
        return in_frame(first, self._place.base_from_surface)

    def _doubt(self, images: dict[int, Pyramid]) -> None:
        """Have a first map checked, of these images (by camera): it may be of matches by chance."""
        self._checked = self._doubted = True
        self._look_into(images, self._regions(), frozenset(images))

    def _regions(self) -> dict[int, Array]:
        sizes = [camera.size for camera in self._lenses.rig.cameras]
        return {r.camera: r.polygon for r in self._roi or whole_pictures(sizes, 0.0)}

    def _look_into(self, images: dict[int, Pyramid], polygons: dict[int, Array], suspects: frozenset[int]) -> None:
        """Have these pictures searched for what is wrong with the suspects' calibration."""
        self._hint_due = self._tries + HINT_INTERVAL_SETS
        cameras = sorted(set(images) & set(polygons))
        self._hint.cancel()
        self._unmapped = {c: images[c][0] for c in cameras}, polygons, suspects

    def _why_none(self) -> str:
        return f"{self._failure}; {self._hinted}" if self._hinted else self._failure

    def look_for_hint(self, images: dict[int, Pyramid], repeats: bool) -> bool:
        """Once a frame set, when no pose waits: search for what is wrong with cameras that show nothing of the map.

        images: of the last frame set, by camera. repeats: whether the surface looks like itself a period on, where
        matches contradict any calibration. True where the calibration turns out to be so wrong that a map of few
        landmarks is by chance.
        """
        health, pose = self._estimator.health, self._estimator.pose
        young = pose is not None and not self._checked and pose.stamp < self._mapped + CHECKED_S
        if young and (health.contradictory or health.left_out):
            self._doubt(images)
        unseen = frozenset(health.unseen & images.keys()) if self._estimator.confirmed else frozenset()
        if unseen and unseen != self._unseen and not self._doubted:
            assert pose is not None
            view = self._matcher.in_view(sorted(unseen), pose.base_from_surface)
            self._unseen = frozenset(c for c, count in view.items() if count >= MIN_NEW_LANDMARKS)
            if self._unseen:
                self._look_into(images, self._regions(), self._unseen)
                self._hinted = ""
        if self._unmapped is not None and not self._hint.busy:
            self._hint.submit(calibration_hint, self._lenses.rig, *self._unmapped)
            self._unmapped = None
        found = self._hint.poll()
        found = (frozenset(), "") if found is not None and repeats else found
        self._hinted = self._hinted if found is None else found[1]
        health.set_unseen(self._unseen & unseen, self._hinted)
        if found is None or not self._doubted:
            return False
        # without one camera the others may have made a good map
        self._doubted, self._refuted = False, self._hinted if len(found[0]) > 1 else ""
        return bool(self._refuted)

    def align_and_fit(
        self, stamp: float, pyramids: dict[int, Pyramid], poses: dict[int, Array], start: Array
    ) -> TrackedSet:
        """Align images (by camera), each begun at a pose (4, 4) of its own, coarsely first; fit from `start` (4, 4)."""
        observations = self._matcher.align(stamp, pyramids, poses, coarse=True)
        return TrackedSet(self._estimator.fit(observations, start), observations, pyramids)

    def expired(self, stamp: float) -> bool:
        """Whether a first map that is still not confirmed at `stamp` should be dropped."""
        return stamp - self._mapped > CONFIRMATION_TIMEOUT_S

    def confirm(self, tracked: TrackedSet) -> TrackedSet:
        """Correct the first map by the first measured frame set after it, align and fit that again, twice."""
        for _ in range(2):
            refined = self._refiner.confirm(tracked.fit, tracked.observations, self._estimator.cameras.delays)
            if refined is None:
                break
            self._take(refined)
            self._estimator.set_twist(self._refiner.speed(tracked.fit))
            tracked = self._realigned(tracked)
        return tracked if self._placing is None else self._put_on_scan(self._placing, tracked)

    def rebuild(self, tracked: TrackedSet) -> TrackedSet:
        """Make the map of a fast surface anew by a frame set after the confirmation, before any pose is given out.

        The map of its first instants is as bent as the cameras' exposure offsets are unknown. Later frame sets are
        calmer or, at least, others, and no path is laid yet that could jump.
        """
        refined = self._refiner.rebuild(tracked.fit, tracked.observations, self._estimator.cameras.delays)
        if refined is None:
            return tracked
        self._take(refined)
        return self._realigned(tracked)

    def _realigned(self, tracked: TrackedSet) -> TrackedSet:
        """The frame set aligned and fitted again with a corrected map; as it was where that is no measurement."""
        stamp, start = tracked.fit.stamp, tracked.fit.solution.base_from_surface
        again = self.align_and_fit(stamp, tracked.pyramids, self.camera_poses(tracked), start)
        return again if again.fit.measured else tracked

    def offer(self, tracked: TrackedSet, twist: Array) -> None:
        """A measured frame set, by which the map may be refined or grow. twist: (6,), the surface's."""
        self._refiner.offer(tracked.fit, tracked.observations, twist, self._estimator.cameras.delays)
        self._offered = tracked, self._estimator.may_learn(tracked.fit)

    def update(self) -> None:
        """Once a frame set, when no pose waits: put what is due into force, and start what comes next."""
        if self._offered is not None and not self._offered[1] and not self._enough_shown(self._offered[0]):
            self._refiner.withdraw()
            self._offered = None
        bends = self._estimator.deforms and (self._seemed_bent or self._refinements > FIRST_MAP_REFINEMENTS)
        refined = self._refiner.freeze() if bends else self._refiner.poll()
        if refined is not None:
            self._take(refined, bends)
        new = self._growth.poll()
        if new is not None:
            distance = float(np.linalg.norm(new.snapshot.base_from_surface[:3, 3] - self._cameras))
            self._probation = Probation(new, between_known(new, self._matcher.map, distance))
        if self._offered is None:
            return
        (tracked, _), self._offered = self._offered, None
        if not self._refiner.took_keyframe:
            return
        few = any(tracked.fit.used[c] < GROWTH_SHARE * WANTED_PER_CAMERA for c in tracked.pyramids)
        if self._probation is not None:
            self._prove(self._probation, tracked)
        elif few and not self._growth.busy and len(self._matcher.map) < MAX_LANDMARKS:
            self._growth.delay = sets_until_ready(self._refiner.interval)
            self._growth.submit(find_new_landmarks, self._lenses.rig, self._snapshot(tracked), self._matcher.map)

    def _enough_shown(self, tracked: TrackedSet) -> bool:
        """Whether a camera shows most of the landmarks in its view: where few are in view, few tracks are no fault."""
        view = self._matcher.in_view(list(tracked.pyramids), tracked.fit.solution.base_from_surface)
        least = {c: max(MIN_NEW_LANDMARKS, MIN_SHOWN_SHARE * min(n, WANTED_PER_CAMERA)) for c, n in view.items()}
        return any(tracked.fit.used[c] >= count for c, count in least.items())

    def _snapshot(self, tracked: TrackedSet) -> SurfaceSnapshot:
        fit, pose = tracked.fit, self._estimator.pose
        return SurfaceSnapshot(
            {c: images[0] for c, images in tracked.pyramids.items()},
            fit.solution.base_from_surface,
            self.camera_poses(tracked),
            fit.covariance + fit.parts.lasting,
            tracked.observations.only(fit.inlier),
            self._masks.print_head,
            None if pose is None else pose.warp,
        )

    def camera_poses(self, tracked: TrackedSet) -> dict[int, Array]:
        """Where the surface was (4, 4) at each camera's own exposure."""
        pose, points, rig = tracked.fit.solution.base_from_surface, self._matcher.map.points, self._lenses.rig
        tracks = tracked.observations
        return {c: single_fit(rig, points, tracks, c, pose).base_from_surface for c in tracked.pyramids}

    def _prove(self, waiting: Probation, tracked: TrackedSet) -> None:
        """Align the new landmarks again; those that move with the surface join the map."""
        fit, single = tracked.fit, self.camera_poses(tracked)
        waiting.look(self._lenses, fit.stamp, tracked.pyramids, single, fit.covariance + fit.parts.lasting)
        points, reach = waiting.map.points, patch_reach(waiting.new.templates.axes)
        proven = np.flatnonzero(waiting.proven & ~self._masks.ink.covers(points, reach, fit.stamp))
        if len(proven) >= MIN_NEW_LANDMARKS:
            self._join(waiting, proven[: MAX_LANDMARKS - len(self._matcher.map)])
        if len(proven) >= MIN_NEW_LANDMARKS or waiting.over:
            self._probation = None

    def _join(self, waiting: Probation, chosen: Index) -> None:
        """Add the chosen ones of new landmarks (by row) to the map, the matcher, the estimator and the search."""
        rows = (3 * chosen[:, None] + np.arange(3)).ravel()
        new, part = waiting.new, waiting.map
        part = SurfaceMap(part.points[chosen], part.normals[chosen], part.covariance[np.ix_(rows, rows)])
        longer = joined_map(self._matcher.map, part)
        self._matcher.extend(longer, new.templates.take(chosen))
        self._estimator.replace_map(longer)
        self._refiner.extend(longer, waiting.level[chosen])
        for c, features in new.features.items():
            pose = new.snapshot.single.get(c, new.snapshot.base_from_surface)
            self._search.add(c, features, pose, longer)

    def _set_caveat(self, place: Registration) -> None:
        self._caveat = "" if place.sure else f"the scan's place is open: {place.verdict}"

    def _put_on_scan(self, placing: ScanPlacing, tracked: TrackedSet) -> TrackedSet:
        """Place the scan anew now that each camera's own instant is known, and put the landmarks onto it."""
        estimator, matcher = self._estimator, self._matcher
        assert self._place is not None and estimator.pose is not None and estimator.map is not None
        pose = tracked.fit.solution.base_from_surface
        lenses = Lenses(as_at_one_instant(self._lenses.rig, pose, self.camera_poses(tracked)))
        images = {c: p[0] for c, p in tracked.pyramids.items()}
        place = placing.refine(lenses, images, replace(self._place, base_from_surface=pose))
        self.registration = place
        self._set_caveat(place)
        new_from_old = se3.inverse(place.base_from_surface) @ pose
        moved = moved_map(estimator.map, new_from_old)
        on_scan, anchors = landmarks_on_scan(moved, matcher.templates.camera, lenses, placing.scan, place)
        first = estimator.pose.base_from_surface @ se3.inverse(new_from_old)
        self._refiner.reframe(on_scan, new_from_old, anchors)
        matcher.reframe(on_scan, new_from_old)
        self._search.reframe(new_from_old)
        estimator.begin(estimator.pose.stamp, first, on_scan, self._caveat)
        estimator.set_twist(self._refiner.speed(estimator.fit(tracked.observations, place.base_from_surface)))
        return replace(tracked, fit=estimator.fit(tracked.observations, place.base_from_surface))

    def _take(self, refined: AdjustedMap, bends: bool = False) -> None:
        self._refinements += 1
        crooked = self._refinements <= FIRST_MAP_REFINEMENTS and not bends
        # deformation now may be an error of the first map; if it persists with a better map, it is the surface's
        self._seemed_bent |= crooked and self._estimator.deforms
        self._estimator.replace_map(refined.map, crooked, bends)
        self._matcher.take(refined.map, refined.agrees)
