"""Making the map of a surface and keeping it: the first map, its confirmation, and its refinement at key frames."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.deferred import Deferred, sets_until_ready
from estimation.fit import Fit
from estimation.mapping.bundle_adjustment import Adjusted, single_fit
from estimation.mapping.refiner import Refiner
from estimation.observations import Observations
from estimation.online.estimator import Estimator
from estimation.pose import SurfacePose
from estimation.scan import Scan
from estimation.scans.registration import Registration
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap, joined_map, moved_map
from estimation.warp import Warp
from perception.frames import FrameSet, Roi
from perception.lens import Lenses
from perception.mapping.first_map import FirstMap, build_first_map, in_frame
from perception.mapping.growth import LEAST, SHARE, WANTED, Found, Look, Probation, amid, look_for_more
from perception.mapping.scan_map import ScanPlacing, as_at_one_instant
from perception.matching.features import Relocaliser
from perception.matching.masks import KeepOut, patch_reach
from perception.matching.matcher import Matcher
from perception.matching.patches import Pyramid
from perception.scanned_map import scanned

EAGER = 5  # tries for a first map, 0.5 s and more each, before only every tenth frame set is tried
RELAXED = 10  # frame sets from one try to the next after those
MOST = 600  # landmarks; those out of view are kept, and cost little
SHOWN = 0.5  # of the landmarks in a camera's view: fewer are found where it is blurred or covered
CROOKED = 6  # refinements, two of them the confirmation, until what looks bent is not the first map itself
PATIENCE = 2.0  # s: a first map that nobody confirms is dropped, and the next images are tried


class Mapping:
    """The map of one surface from its first look on; what it makes is handed to the matcher and the estimator."""

    def __init__(
        self,
        lenses: Lenses,
        roi: Sequence[Roi],
        search: Relocaliser,
        executor: Executor | None = None,
        scan: Scan | None = None,
        keep_out: KeepOut | None = None,
    ) -> None:
        """roi: where the surface is when it first comes into view. search: learns each view that is mapped.

        executor: where the map is refined. scan: its frame is the surface frame. keep_out: where no landmark may begin.
        """
        self._keep_out = keep_out or KeepOut(lenses)
        self._lenses, self._roi, self._search = lenses, tuple(roi), search
        self._placing = None if scan is None else ScanPlacing(scan)
        self._place: Registration | None = None  # of the scan at the first instant
        self._refiner = Refiner(lenses.rig, executor)
        self._cameras = np.mean([c.base_from_camera[:3, 3] for c in lenses.rig.cameras], axis=0)
        self._tries, self._why = 0, ""  # to make a first map, and why the last one failed
        self._mapped = 0.0  # s, stamp of the first map
        self._caveat = ""
        self._taken = 0  # refinements of this map
        self._bent = False  # whether its surface seemed to deform
        self._growth: Deferred[Found] = Deferred(executor)
        self._probation: Probation | None = None
        self._wanted: dict[int, int] = {}  # landmarks, by camera
        self._last: tuple[Fit, Observations, dict[int, Pyramid], bool] | None = None  # and whether it is sound

    def first_map(self, frames: FrameSet, pyramids: dict[int, Pyramid]) -> FirstMap | str:
        """A first map of what these images (by camera) show, or the reason why there is none yet."""
        polygons = self._polygons(frames)
        if isinstance(polygons, str):
            return polygons
        self._tries += 1
        if self._tries > EAGER and self._tries % RELAXED:
            return self._why
        first = build_first_map(self._lenses, pyramids, polygons, self._keep_out.masks)
        if isinstance(first, str):
            self._why = first
            return first
        self._caveat = ""
        if self._placing is None:
            return first
        images = {c: pyramids[c][0] for c in polygons}
        return self._on_scan(first, self._placing.search(self._lenses, images, first, polygons))

    def begin(
        self, stamp: float, first: FirstMap, matcher: Matcher, estimator: Estimator, pyramids: dict[int, Pyramid]
    ) -> tuple[SurfacePose, Observations, Fit]:
        """Take a first map into use: its pose, and what the images it was made of show of it."""
        start, self._mapped = first.base_from_surface, stamp
        pose = estimator.begin(stamp, start, first.map, self._caveat)
        observations = matcher.align(stamp, pyramids, dict.fromkeys(pyramids, start), coarse=True)
        fit = estimator.fit(observations, start)
        self._refiner.begin(first.map, stamp, start, observations)
        self._growth.forget()
        self._probation = self._last = None
        self._taken, self._bent = 0, False
        matcher.remember(pyramids, observations, fit.inlier, start)
        for camera, images in pyramids.items():
            self._search.learn(camera, images[0], start, first.map)
        return pose, observations, fit

    def expired(self, stamp: float) -> bool:
        """Whether a first map that is still not confirmed at `stamp` should be dropped."""
        return stamp - self._mapped > PATIENCE

    def confirm(
        self, matcher: Matcher, estimator: Estimator, pyramids: dict[int, Pyramid], fit: Fit, observations: Observations
    ) -> tuple[Fit, Observations]:
        """The first measured frame set after the first map: correct the map by it, look and fit again, twice."""
        for _ in range(2):
            refined = self._refiner.confirm(fit, observations, estimator.cameras.delays)
            if refined is None:
                break
            self._take(refined, matcher, estimator)
            estimator.moving(self._refiner.speed(fit))
            fit, observations = self._again(matcher, estimator, pyramids, fit, observations)
        self._wanted = dict.fromkeys(range(len(self._lenses.rig)), WANTED)
        if self._placing is not None:
            fit = self._lay_scan(self._placing, matcher, estimator, pyramids, fit, observations)
        return fit, observations

    def rebuild(
        self, matcher: Matcher, estimator: Estimator, pyramids: dict[int, Pyramid], fit: Fit, observations: Observations
    ) -> tuple[Fit, Observations]:
        """A frame set after the confirmation, before any pose is given out, of a surface that moves fast.

        The map of its first instants is as bent as the cameras' instants are unknown; later ones are calmer or, at
        least, others, and no path is laid yet that could jump.
        """
        refined = self._refiner.rebuild(fit, observations, estimator.cameras.delays)
        if refined is None:
            return fit, observations
        self._take(refined, matcher, estimator)
        return self._again(matcher, estimator, pyramids, fit, observations)

    def _again(
        self, matcher: Matcher, estimator: Estimator, pyramids: dict[int, Pyramid], fit: Fit, observations: Observations
    ) -> tuple[Fit, Observations]:
        """Look and fit again with a corrected map; what was there, where that is no measurement."""
        starts = self._single(matcher, fit, observations, pyramids)
        again = matcher.align(fit.stamp, pyramids, starts, coarse=True)
        refit = estimator.fit(again, fit.solution.base_from_surface)
        return (refit, again) if refit.measured else (fit, observations)

    def offer(
        self,
        fit: Fit,
        observations: Observations,
        twist: Array,
        estimator: Estimator,
        pyramids: dict[int, Pyramid],
    ) -> None:
        """A measured frame set, from which the map may be refined or grow. twist: (6,), the surface's."""
        self._refiner.offer(fit, observations, twist, estimator.cameras.delays)
        self._last = fit, observations, pyramids, estimator.sound(fit)

    def keep(self, matcher: Matcher, estimator: Estimator) -> None:
        """Once a frame set, when no pose waits: put what is due into force, ask for what comes next."""
        if self._last is not None:
            fit, _, pyramids, sound = self._last
            if not sound and not self._shown(matcher, fit, pyramids):
                self._refiner.withdraw()
                self._last = None
        bends = estimator.deforms and (self._bent or self._taken > CROOKED)
        refined = self._refiner.freeze() if bends else self._refiner.poll()
        if refined is not None:
            self._take(refined, matcher, estimator, bends)
        found = self._growth.poll()
        if found is not None:
            distance = float(np.linalg.norm(found.look.base_from_surface[:3, 3] - self._cameras))
            self._probation = Probation(found, amid(found, matcher.map, distance))
        if self._last is None:
            return
        (fit, observations, pyramids, _), self._last = self._last, None
        lacking = any(fit.used[c] < SHARE * self._wanted[c] for c in pyramids)
        if self._probation is not None and self._refiner.kept:
            self._prove(self._probation, matcher, estimator, fit, observations, pyramids)
        elif self._refiner.kept and lacking and not self._growth.busy and len(matcher.map) < MOST:
            warp = None if estimator.pose is None else estimator.pose.warp
            look = self._look(matcher, fit, observations, pyramids, warp)
            self._growth.delay = sets_until_ready(self._refiner.interval)
            self._growth.ask(look_for_more, self._lenses.rig, look, matcher.map)

    def _shown(self, matcher: Matcher, fit: Fit, pyramids: dict[int, Pyramid]) -> bool:
        """Whether a camera shows most of what it has in view: few tracks are no fault where little is to be seen."""
        view = matcher.in_view(list(pyramids), fit.solution.base_from_surface)
        return any(fit.used[c] >= max(LEAST, SHOWN * min(count, WANTED)) for c, count in view.items())

    def _look(
        self, matcher: Matcher, fit: Fit, observations: Observations, pyramids: dict[int, Pyramid], warp: Warp | None
    ) -> Look:
        seen, kept = observations, fit.inlier
        inliers = seen.only(kept)
        single = self._single(matcher, fit, observations, pyramids)
        images = {c: p[0] for c, p in pyramids.items()}
        heads, pose, doubt = self._keep_out.masks, fit.solution.base_from_surface, fit.covariance + fit.lasting
        return Look(images, pose, single, doubt, inliers, self._wanted, heads, warp)

    def _single(
        self, matcher: Matcher, fit: Fit, observations: Observations, pyramids: dict[int, Pyramid]
    ) -> dict[int, Array]:
        """Where the surface was at each camera's own instant."""
        pose, points, rig = fit.solution.base_from_surface, matcher.map.points, self._lenses.rig
        return {c: single_fit(rig, points, observations, c, pose).base_from_surface for c in pyramids}

    def _prove(
        self,
        waiting: Probation,
        matcher: Matcher,
        estimator: Estimator,
        fit: Fit,
        observations: Observations,
        pyramids: dict[int, Pyramid],
    ) -> None:
        """Look for the new landmarks again; those that move with the surface join the map."""
        single = self._single(matcher, fit, observations, pyramids)
        waiting.look(self._lenses, fit.stamp, pyramids, single, fit.covariance + fit.lasting)
        new, axes = waiting.map.points, waiting.found.templates.axes
        proven = waiting.proven & ~self._keep_out.ink.covers(new, patch_reach(axes), fit.stamp)
        if proven.sum() >= LEAST:
            self._join(waiting, proven, matcher, estimator)
        if proven.sum() >= LEAST or waiting.over:
            self._probation = None

    def _join(self, proven: Probation, which: NDArray[np.bool_], matcher: Matcher, estimator: Estimator) -> None:
        chosen = np.flatnonzero(which)[: MOST - len(matcher.map)]
        rows = (3 * chosen[:, None] + np.arange(3)).ravel()
        found, new = proven.found, proven.map
        points, normals = new.points[chosen], new.normals[chosen]
        longer = joined_map(matcher.map, SurfaceMap(points, normals, new.covariance[np.ix_(rows, rows)]))
        matcher.extend(longer, found.templates.take(chosen))
        estimator.replace_map(longer)
        self._refiner.extend(longer, proven.level[chosen])
        for c, features in found.features.items():
            pose = found.look.single.get(c, found.look.base_from_surface)
            self._search.add(c, features, pose, longer)

    def _on_scan(self, first: FirstMap, place: Registration) -> FirstMap:
        """The first map in the scan's frame; notes what the scan's shape leaves open."""
        self._place = place
        self._caveat = "" if place.sure else f"the scan's place is open: {place.verdict}"
        return in_frame(first, place.base_from_surface)

    def _lay_scan(
        self,
        placing: ScanPlacing,
        matcher: Matcher,
        estimator: Estimator,
        pyramids: dict[int, Pyramid],
        fit: Fit,
        observations: Observations,
    ) -> Fit:
        """Place the scan anew now that each camera's own instant is known, and put the landmarks onto it."""
        assert self._place is not None and estimator.pose is not None and estimator.map is not None
        rig, pose = self._lenses.rig, fit.solution.base_from_surface
        single = {c: single_fit(rig, matcher.map.points, observations, c, pose).base_from_surface for c in pyramids}
        lenses = Lenses(as_at_one_instant(rig, pose, single))
        images = {c: p[0] for c, p in pyramids.items()}
        place = placing.refine(lenses, images, replace(self._place, base_from_surface=pose))
        self._caveat = "" if place.sure else f"the scan's place is open: {place.verdict}"
        new_from_old = se3.inverse(place.base_from_surface) @ pose
        there = moved_map(estimator.map, new_from_old)
        laid, anchors = scanned(there, matcher.templates.camera, lenses, placing.scan, place)
        first = estimator.pose.base_from_surface @ se3.inverse(new_from_old)
        self._refiner.reframe(laid, new_from_old, anchors)
        matcher.reframe(laid, new_from_old)
        self._search.reframe(new_from_old)
        estimator.begin(estimator.pose.stamp, first, laid, self._caveat)
        fit = estimator.fit(observations, place.base_from_surface)
        estimator.moving(self._refiner.speed(fit))
        return estimator.fit(observations, place.base_from_surface)

    def _take(self, refined: Adjusted, matcher: Matcher, estimator: Estimator, bends: bool = False) -> None:
        self._taken += 1
        crooked = self._taken <= CROOKED and not bends
        self._bent |= (
            crooked and estimator.deforms
        )  # if it is seen again with a better map, that was no fault of the map
        estimator.replace_map(refined.map, crooked, bends)
        matcher.take(refined.map, refined.agrees)

    def _polygons(self, frames: FrameSet) -> dict[int, Array] | str:
        """Where the surface is in these images, by camera, or why that is not known yet."""
        if not self._roi:
            return {
                f.camera: np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float) * self._lenses.rig.cameras[f.camera].size
                for f in frames.frames
            }
        start = max(r.stamp for r in self._roi)
        if frames.stamp < start - 0.1:
            return f"waiting for the region of interest at {start:.3f} s"
        return {r.camera: r.polygon for r in self._roi if any(f.camera == r.camera for f in frames.frames)}
