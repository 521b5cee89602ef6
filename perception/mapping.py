"""Making the map of a surface and keeping it: the first map, its confirmation, and its refinement at key frames."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np

from estimation import se3
from estimation.adjustment import Adjusted, single_fit
from estimation.estimator import Estimator, Fit
from estimation.observations import Observations
from estimation.pose import SurfacePose
from estimation.refiner import Refiner
from estimation.registration import register
from estimation.scan import Scan
from estimation.se3 import Array
from perception.first_map import FirstMap, build_first_map, in_frame
from perception.frames import FrameSet, Roi
from perception.lens import Lenses
from perception.matcher import Matcher
from perception.patches import Pyramid
from perception.relocalise import Relocaliser

LEAST_SCAN_SIGMA = 0.1  # mm: no handheld scan is better
EAGER = 5  # tries for a first map, 0.5 s and more each, before only every tenth frame set is tried
RELAXED = 10  # frame sets from one try to the next after those
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
    ) -> None:
        """roi: where the surface is when it first comes into view. search: learns each view that is mapped.

        executor: where the map is refined. scan: its frame is the surface frame.
        """
        self._lenses, self._roi, self._search, self._scan = lenses, tuple(roi), search, scan
        self._refiner = Refiner(lenses.rig, executor)
        self._tries, self._why = 0, ""  # to make a first map, and why the last one failed
        self._mapped = 0.0  # s, stamp of the first map
        self._caveat = ""

    def first_map(self, frames: FrameSet, pyramids: dict[int, Pyramid]) -> FirstMap | str:
        """A first map of what these images (by camera) show, or the reason why there is none yet."""
        polygons = self._polygons(frames)
        if isinstance(polygons, str):
            return polygons
        self._tries += 1
        if self._tries > EAGER and self._tries % RELAXED:
            return self._why
        first = build_first_map(self._lenses, pyramids, polygons)
        if isinstance(first, str):
            self._why = first
            return first
        self._caveat = ""
        return first if self._scan is None else self._on_scan(first, self._scan)

    def begin(
        self, stamp: float, first: FirstMap, matcher: Matcher, estimator: Estimator, pyramids: dict[int, Pyramid]
    ) -> tuple[SurfacePose, Observations, Fit]:
        """Take a first map into use: its pose, and what the images it was made of show of it."""
        start, self._mapped = first.base_from_surface, stamp
        pose = estimator.begin(stamp, start, first.map, self._caveat)
        observations = matcher.align(stamp, pyramids, dict.fromkeys(pyramids, start), coarse=True)
        fit = estimator.fit(observations, start)
        self._refiner.begin(first.map, stamp, start, observations)
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
            refined = self._refiner.confirm(fit, observations, estimator.skew.sigma)
            if refined is None:
                break
            _take(refined, matcher, estimator)
            estimator.moving(self._refiner.speed(fit))
            pose, points = fit.solution.base_from_surface, refined.map.points
            fits = {c: single_fit(self._lenses.rig, points, observations, c, pose) for c in pyramids}
            starts = {c: own.base_from_surface for c, own in fits.items()}
            again = matcher.align(fit.stamp, pyramids, starts, coarse=True)
            refit = estimator.fit(again, pose)
            if not refit.measured:
                break
            fit, observations = refit, again
        return fit, observations

    def offer(self, fit: Fit, observations: Observations, twist: Array, estimator: Estimator) -> None:
        """A measured frame set, from which the map may be refined. twist: (6,), the surface's."""
        self._refiner.offer(fit, observations, twist, estimator.skew.sigma)

    def keep(self, matcher: Matcher, estimator: Estimator) -> None:
        """Once a frame set, when no pose waits: put what is due into force, ask for what comes next."""
        refined = self._refiner.poll()
        if refined is not None:
            _take(refined, matcher, estimator)

    def _on_scan(self, first: FirstMap, scan: Scan) -> FirstMap:
        """The first map in the scan's frame; notes what the scan's shape leaves open."""
        points = se3.transform_points(first.base_from_surface, first.map.points)
        blocks = first.map.covariance.reshape(len(points), 3, len(points), 3)
        sigma = float(np.sqrt(np.median(np.einsum("nini->n", blocks))))
        found = register(points, max(sigma, LEAST_SCAN_SIGMA), scan, first.base_from_surface[:3, 2])
        self._caveat = "" if found.sure else f"the scan's place is open: {found.verdict}"
        return in_frame(first, found.base_from_surface)

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


def _take(refined: Adjusted, matcher: Matcher, estimator: Estimator) -> None:
    estimator.replace_map(refined.map)
    matcher.take(refined.map, refined.agrees)
