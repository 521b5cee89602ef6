"""Where the landmarks are in new images: optical flow gives the start, alignment with reference pictures measures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.observations import MissedLandmarks, Observations, no_observations
from estimation.pose_solver import PointTracks, project, solve_pose
from estimation.rig import ideal_pixels
from estimation.se3 import Array, Index
from estimation.surface_map import SurfaceMap
from perception.frames import Image, parallel_map
from perception.lens import Lenses, undistort
from perception.mapping.features import bounding_box
from perception.mapping.masks import TrackingMasks, near_bead, patch_reach
from perception.mapping.patches import (
    Projection,
    Pyramid,
    Templates,
    align_in,
    grain_of,
    join,
    project_into,
    project_tracks_into,
    sample_each,
)

FLOW_WINDOW_PX = 21
MIN_WINDOW_SPREAD = 2.0  # grey levels: a flatter window gives no gain
MIN_GAIN_WINDOWS = 8  # for a median
MIN_WINDOW_CORRELATION = 0.7  # of a window before and after, from which it counts as similar
MIN_SIMILAR_SHARE = 0.35  # of similar windows, from which the flow is believed
CHECKED_TRACKS = 40  # about
MIN_GAIN_CHANGE = 0.08  # of brightness; flow tolerates smaller ones
GAIN_RANGE = 0.4, 2.5  # beyond which it is another picture
MAX_RETURN_ERROR_PX = 1.0  # px from where a track began to where it ends when it is followed back
FLOW_MARGIN_PX = 48.0  # px around the tracks: flow sees that far beyond them


def optical_flow(
    previous: Image, current: Image, pixels: Array, guess: Array, levels: int = 4
) -> tuple[Array, NDArray[np.bool_]]:
    """Where pixels (N, 2) of the previous image stand in the current one (N, 2), and whether they were tracked (N,).

    guess: (N, 2) px, where to begin. Pyramidal Lucas-Kanade (thesis 4.4, Eq. 4.7-4.10) on the box around the tracks. It
    takes brightness as constant, and was measured to fail where that jumps by a quarter: where most windows look
    different afterwards, it is tried again with the jump taken back, and the better of the two is kept.
    A track that is followed backwards must end where it began (forward-backward error, Kalal et al. 2010).
    """
    first = _forward_backward(previous, current, pixels, guess, levels)
    similar = _similar_share(previous, current, pixels, *first)
    if similar >= MIN_SIMILAR_SHARE:
        return first
    gain, offset = _brightness(previous, current, pixels, guess)
    if not GAIN_RANGE[0] < gain < GAIN_RANGE[1] or (
        abs(gain - 1) < MIN_GAIN_CHANGE and abs(offset) < MIN_GAIN_CHANGE * 128
    ):
        return first
    relit = np.asarray(cv2.addWeighted(current, 1 / gain, current, 0.0, -offset / gain), np.uint8)
    second = _forward_backward(previous, relit, pixels, guess, levels)
    return second if _similar_share(previous, relit, pixels, *second) > similar else first


def _forward_backward(
    previous: Image, current: Image, pixels: Array, guess: Array, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    forward, tracked = _lucas_kanade(previous, current, pixels, guess, levels)
    forward[~tracked] = guess[~tracked]
    back, returned = _lucas_kanade(current, previous, forward, pixels + forward - guess, levels)
    return forward, tracked & returned & (np.linalg.norm(back - pixels, axis=1) < MAX_RETURN_ERROR_PX)


def _lucas_kanade(
    previous: Image, current: Image, pixels: Array, guess: Array, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    h, w = current.shape[:2]
    reach = np.concatenate([pixels, guess])
    x0, y0, x1, y1 = bounding_box(np.clip(reach, 0, [w, h]), (w, h), FLOW_MARGIN_PX)
    corner = np.array([x0, y0], float)
    begin = np.ascontiguousarray((guess - corner)[:, None], np.float32)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        np.ascontiguousarray(previous[y0:y1, x0:x1]),
        np.ascontiguousarray(current[y0:y1, x0:x1]),
        np.ascontiguousarray((pixels - corner)[:, None], np.float32),
        begin.copy(),
        winSize=(FLOW_WINDOW_PX, FLOW_WINDOW_PX),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.05),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    places = np.asarray(moved, np.float64)[:, 0]
    return places + corner, (np.asarray(status).ravel() > 0) & np.isfinite(places).all(1)


def _similar_share(previous: Image, current: Image, pixels: Array, moved: Array, tracked: NDArray[np.bool_]) -> float:
    """Share of the tracks, `tracked` (N,), whose window looks as it did before, whatever the brightness."""
    checked = np.arange(0, len(pixels), max(1, len(pixels) // CHECKED_TRACKS))  # a few dozen serve as well as all
    rows = checked[tracked[checked]]
    if not len(rows):
        return 0.0
    before, now = _windows(previous, pixels[rows]), _windows(current, moved[rows])
    before, now = before - before.mean(1, keepdims=True), now - now.mean(1, keepdims=True)
    product, squares = (before * now).sum(1), (before**2).sum(1) * (now**2).sum(1)
    return float(np.sum(product > MIN_WINDOW_CORRELATION * np.sqrt(squares)) / len(checked))


def _brightness(previous: Image, current: Image, pixels: Array, guess: Array) -> tuple[float, float]:
    """Gain and offset, grey levels, from the previous image to the current one: the median over the tracks' windows."""
    before, now = _windows(previous, pixels), _windows(current, guess)
    spread = before.std(1)
    textured = spread > MIN_WINDOW_SPREAD
    if textured.sum() < MIN_GAIN_WINDOWS:
        return 1.0, 0.0
    gain = float(np.median(now[textured].std(1) / spread[textured]))
    return gain, float(np.median(now.mean(1) - gain * before.mean(1)))


def _windows(image: Image, pixels: Array) -> Array:
    """Grey levels (N, K) at every third pixel of a window around each of pixels (N, 2)."""
    step = np.arange(-FLOW_WINDOW_PX // 2 + 2, FLOW_WINDOW_PX // 2, 3)
    h, w = image.shape[:2]
    x, y = np.rint(np.clip(pixels, 0, [w - 1, h - 1])).astype(int).T
    rows, columns = np.clip(y[:, None] + step, 0, h - 1), np.clip(x[:, None] + step, 0, w - 1)
    return np.asarray(image[rows[:, :, None], columns[:, None, :]].reshape(len(pixels), -1), float)


# information of one camera's own pose about the joint one: 0.02 rad and 5 mm, one sigma
CAMERA_POSE_PRIOR = np.diag([1 / 0.02**2] * 3 + [1 / 5.0**2] * 3)
MAX_FLOW_TRACKS = 80  # a camera: enough for a start, and flow is only that
UNCERTAINTY_LANDMARKS = 8  # landmarks of a camera by which the uncertainty of all is judged
MIN_SHOWN_GRAIN = 0.5  # correlation of a landmark's grain with its own: other skin has 0.1 by chance
COMPLETE_SHARE = 0.8  # of a camera's landmarks: where fewer are measured, the start may have been wrong
FLOW_POSE_TOLERANCE = 1e-3  # rad, mm: a start for the alignment need not be better


@dataclass(frozen=True, slots=True, eq=False)
class MatchedView:
    """What one camera last saw of the landmarks."""

    image: Image
    rows: NDArray[np.int64]  # (N,) of the map
    pixels: Array  # (N, 2) px, ideal, where the landmarks stood
    base_from_surface: Array  # (4, 4)


def spread_order(points: Array) -> NDArray[np.int64]:
    """Numbers (N,) of points (N, 3) in an order of which every beginning is spread over all of them.

    Each next one is the farthest from those before (Gonzalez 1985).
    """
    order, apart = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    chosen = int(np.argmin(((points - points.mean(0)) ** 2).sum(1))) if len(points) else 0
    for i in range(len(points)):
        order[i], apart[chosen] = chosen, -1.0
        apart = np.minimum(apart, ((points - points[chosen]) ** 2).sum(1))
        chosen = int(np.argmax(apart))
    return order


class Matcher:
    """Finds the landmarks of one map; remembers what each camera last saw of them."""

    def __init__(
        self, lenses: Lenses, surface_map: SurfaceMap, templates: Templates, masks: TrackingMasks | None = None
    ) -> None:
        """masks: what is not to be tracked in the frame set that is looked at."""
        self.lenses, self.rig = lenses, lenses.rig
        self.templates = templates
        self.map = surface_map
        self.agrees = np.ones(len(surface_map), bool)  # landmarks worth looking for
        self._views: dict[int, MatchedView] = {}
        self._gathered: tuple[NDArray[np.int64], Templates] | None = None
        self._order = spread_order(surface_map.points)
        self._inked = np.zeros(len(surface_map), bool)
        self._masks = masks or TrackingMasks(lenses)

    def take(self, surface_map: SurfaceMap, agrees: NDArray[np.bool_]) -> None:
        """A refined map, same rows, and which of them (N,) are worth looking for."""
        self.map, self.agrees = surface_map, agrees

    def extend(self, surface_map: SurfaceMap, templates: Templates) -> None:
        """The map with more rows at its end, and the reference pictures of those."""
        new = len(surface_map) - len(self.map)
        self._order = np.concatenate([self._order, len(self.map) + spread_order(surface_map.points[len(self.map) :])])
        self.map, self._gathered = surface_map, None
        self.templates = join([self.templates, templates])
        self.agrees = np.concatenate([self.agrees, np.ones(new, bool)])
        self._inked = np.concatenate([self._inked, np.zeros(new, bool)])

    def cover(self, bead: Array) -> None:
        """A bead (M, 3) mm, surface frame, lies on the surface: what it covers is not looked for any more."""
        self._inked |= near_bead(self.map.points, bead, patch_reach(self.templates.axes))

    def reframe(self, surface_map: SurfaceMap, new_from_old: Array) -> None:
        """The surface frame is another from now on: new_from_old (4, 4). surface_map: in the new one, same rows."""
        self.map, self._gathered = surface_map, None
        self.templates = replace(self.templates, axes=new_from_old[:3, :3] @ self.templates.axes)
        old_from_new = se3.inverse(new_from_old)
        self._views = {
            c: replace(view, base_from_surface=view.base_from_surface @ old_from_new) for c, view in self._views.items()
        }

    def last_count(self, camera: int) -> int:
        """How many landmarks a camera last saw."""
        return len(self._views[camera].rows) if camera in self._views else 0

    def in_view(self, cameras: Sequence[int], base_from_surface: Array) -> dict[int, int]:
        """How many landmarks each camera would see at a pose (4, 4) without occlusion."""
        rows = np.nonzero(self.agrees)[0]
        poses, axes = np.broadcast_to(base_from_surface, (len(cameras), 4, 4)), self.templates.axes[rows]
        where = project_into(self.lenses, cameras, poses, self.map.points[rows], self.map.normals[rows], axes)
        return dict(zip(cameras, where.visible.reshape(len(cameras), -1).sum(1).tolist(), strict=True))

    def image_sigma(self, base_from_surface: Array, covariance: Array) -> float:
        """Standard deviation, px, of where a pose with a covariance (6, 6) puts the landmarks in the images.

        The worst of a few landmarks of each camera; infinite where no camera has seen the surface.
        """
        ready = sorted(c for c in self._views if self.last_count(c) >= 6)
        if not ready:
            return np.inf
        some = [self._views[c].rows[:: 1 + self.last_count(c) // UNCERTAINTY_LANDMARKS] for c in ready]
        camera = np.repeat(ready, [len(rows) for rows in some])
        jacobian = project(self.rig, camera, base_from_surface, self.map.points[np.concatenate(some)])[2]
        return float(np.sqrt(((jacobian @ covariance) * jacobian).sum(2).max()))

    def is_complete(self, observations: Observations, cameras: Iterable[int]) -> bool:
        """Whether most landmarks that each camera last saw are measured again."""
        counts = np.bincount(observations.camera, minlength=len(self.rig))
        return all(counts[c] >= COMPLETE_SHARE * self.last_count(c) for c in cameras)

    def flow(self, pyramids: dict[int, Pyramid], guess: Array) -> tuple[Array, dict[int, Array]]:
        """The joint pose by optical flow, and each camera's own: cameras are seldom exposed at the same instant."""
        points = self.map.points
        ready = [c for c in pyramids if self.last_count(c) >= 6]
        flows = parallel_map(lambda c: self._flow_one(c, pyramids[c][0], guess), ready)
        moved = dict(zip(ready, flows, strict=True))
        single = dict.fromkeys(pyramids, guess)
        if sum(len(rows) for rows, _ in moved.values()) < 6:
            return guess, single
        camera = np.concatenate([np.full(len(rows), c) for c, (rows, _) in moved.items()])
        rows = np.concatenate([rows for rows, _ in moved.values()])
        pixels = np.concatenate([pixels for _, pixels in moved.values()])
        tracks = PointTracks(camera, points[rows], pixels, np.ones(len(rows)))
        fit = solve_pose(self.rig, tracks, guess, scales=(8.0, 1.5), iterations=4, tolerance=FLOW_POSE_TOLERANCE)
        good = fit.weights > 0.2
        for c in pyramids:
            mine = good & (camera == c)
            single[c] = fit.base_from_surface
            if mine.sum() < 8 <= (camera == c).sum():  # it contradicts the others, and is followed by itself
                own = solve_pose(self.rig, tracks.only(camera == c), guess, scales=(8.0, 1.5), prior=CAMERA_POSE_PRIOR)
                single[c] = own.base_from_surface
            if mine.sum() >= 8 and fit.scale > 1.2:  # else the cameras agree within the flow's own error
                own = solve_pose(
                    self.rig,
                    tracks.only(mine),
                    single[c],
                    prior=CAMERA_POSE_PRIOR,
                    iterations=2,
                    tolerance=FLOW_POSE_TOLERANCE,
                )
                single[c] = own.base_from_surface
        return fit.base_from_surface, single

    def _flow_one(self, camera: int, image: Image, guess: Array) -> tuple[NDArray[np.int64], Array]:
        view = self._views[camera]
        some = slice(None, None, 1 + len(view.rows) // MAX_FLOW_TRACKS)
        rows, ideal = view.rows[some], view.pixels[some]
        pixels, _ = self.lenses.image(camera, ideal, np.full(len(rows), np.inf))
        before = self._imaged(camera, view.base_from_surface, rows)
        after = self._imaged(camera, guess, rows)
        moved, tracked = optical_flow(view.image, image, pixels, pixels + after - before)
        return rows[tracked], undistort(self.rig.cameras[camera], moved[tracked])

    def _imaged(self, camera: int, base_from_surface: Array, rows: NDArray[np.int64]) -> Array:
        """Where landmarks (rows) fall in a camera's image, (N, 2) px."""
        points_base = se3.transform_points(base_from_surface, self.map.points[rows])
        return self.lenses.image(camera, *ideal_pixels(self.rig.cameras[camera], points_base))[0]

    def align(
        self,
        stamp: float,
        pyramids: dict[int, Pyramid],
        poses: dict[int, Array],
        coarse: bool = False,
        most: int | None = None,
    ) -> Observations:
        """Measure the landmarks in every camera, begun where the camera's own pose puts them.

        coarse: begin on the half-size images, which reaches farther. most: landmarks of a camera, spread over the
        surface and the same from frame set to frame set; all without.
        """
        cameras = [c for c in pyramids if c in poses]
        if not cameras:
            return no_observations(stamp)
        rows = np.nonzero(~self._inked)[0]
        surface_map, axes, worth = self.map, self.templates.axes[rows], self.agrees[rows]
        starts = np.stack([poses[c] for c in cameras])
        where = project_into(self.lenses, cameras, starts, surface_map.points[rows], surface_map.normals[rows], axes)
        centres = where.centre.reshape(len(cameras), -1, 2)
        hidden = np.concatenate([self._masks.hides(c, at) for c, at in zip(cameras, centres, strict=True)])
        visible = where.visible & ~hidden
        dropped = np.nonzero(visible & ~np.tile(worth, len(cameras)))[0]
        visible &= np.tile(worth, len(cameras))
        chosen = np.nonzero(visible if most is None else self._some(visible, rows, most))[0]
        position, row = np.divmod(chosen, len(rows))
        lacking, absent = np.divmod(dropped, len(rows))
        absent = rows[absent]
        where, row = where.take(chosen), rows[row]
        counts = np.bincount(position, minlength=len(cameras))
        images = [pyramids[c] for c in cameras]
        result = align_in(self._pictures(row), images, counts.tolist(), where, where.centre, coarse=coarse)
        fits, number = result.found, np.array(cameras, np.int64)
        camera = number[position[fits]]
        pixels = self._ideal(camera, result.pixels[fits])
        # what shows its grain, where it should be or where it was found, is there, though nothing measures it
        unmeasured = np.flatnonzero(~fits)
        spots, twice = np.concatenate([where.centre[unmeasured], result.pixels[unmeasured]]), np.tile(unmeasured, 2)
        shows = self._shows_grain(pyramids, number[position[twice]], where.take(twice), spots, row[twice])
        lost = unmeasured[~shows.reshape(2, -1).any(0)]
        # what the refinement has dropped is missed as well: the surface may have left the place that the map gives it
        missing = number[np.concatenate([position[lost], lacking])], np.concatenate([row[lost], absent])
        return Observations(stamp, camera, row[fits], pixels, result.sigma[fits], MissedLandmarks(*missing))

    def lit(
        self, pyramids: dict[int, Pyramid], poses: Array, tracks: Observations, outlier: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Which tracks (N,), of those that are outliers (N,), show their grain where poses (C, 4, 4) put them."""
        shown, mine = np.zeros(len(tracks), bool), np.flatnonzero(outlier & np.isin(tracks.camera, list(pyramids)))
        camera, rows = tracks.camera[mine], tracks.track[mine]
        squares = self.map.points[rows], self.map.normals[rows], self.templates.axes[rows]
        where = project_tracks_into(self.lenses, camera, poses, *squares)
        shown[mine] = self._shows_grain(pyramids, camera, where, where.centre, rows)
        return shown

    def _shows_grain(
        self, pyramids: dict[int, Pyramid], camera: Index, where: Projection, spots: Array, rows: Index
    ) -> NDArray[np.bool_]:
        """Which landmarks (rows, (M,)) show their grain at spots (M, 2) px of cameras (M,): shadows hide the rest."""
        if not len(rows):
            return np.zeros(0, bool)
        now = grain_of(sample_each(pyramids, camera, spots, where.per_sample))
        first = grain_of(self.templates.picture[rows])
        alike, sizes = (now * first).sum(1), (now * now).sum(1) * (first * first).sum(1)
        return np.asarray(alike > MIN_SHOWN_GRAIN * np.sqrt(sizes))

    def align_at(
        self, stamp: float, pyramids: dict[int, Pyramid], pose: Array, rows: NDArray[np.int64], points: Array
    ) -> Observations:
        """Measure landmarks (rows, (R,)) as if they lay at points (R, 3) mm of the surface at a pose (4, 4)."""
        cameras, some = list(pyramids), self.templates.take(rows)
        poses = np.broadcast_to(pose, (len(cameras), 4, 4))
        where = project_into(self.lenses, cameras, poses, points, self.map.normals[rows], some.axes)
        counts, number = [len(rows)] * len(cameras), np.repeat(cameras, len(rows))
        tiled, images = self.templates.take(np.tile(rows, len(cameras))), [pyramids[c] for c in cameras]
        result = align_in(tiled, images, counts, where, where.centre, coarse=True)
        fits, track = result.found, np.tile(rows, len(cameras))
        pixels = self._ideal(number[fits], result.pixels[fits])
        return Observations(stamp, number[fits], track[fits], pixels, result.sigma[fits])

    def _some(self, visible: NDArray[np.bool_], rows: NDArray[np.int64], most: int) -> NDArray[np.bool_]:
        """Of what is visible (C * N,), at most so many landmarks of each camera: the first in the order of spread."""
        rank = np.argsort(self._order)[rows]
        some = np.zeros_like(visible).reshape(-1, len(rows))
        for mine, chosen in zip(visible.reshape(some.shape), some, strict=True):
            index = np.nonzero(mine)[0]
            chosen[index[np.argsort(rank[index])[:most]]] = True
        return some.ravel()

    def _ideal(self, camera: NDArray[np.int64], pixels: Array) -> Array:
        """Undistorted pixels (N, 2) of imaged ones, by camera (N,), in ascending blocks."""
        ideal = np.empty((len(pixels), 2))
        for c in np.unique(camera):
            mine = camera == c
            ideal[mine] = undistort(self.rig.cameras[c], pixels[mine])
        return ideal

    def _pictures(self, rows: NDArray[np.int64]) -> Templates:
        """The templates of rows (N,): megabytes to gather, and mostly those of the last frame set."""
        if self._gathered is None or not np.array_equal(self._gathered[0], rows):
            self._gathered = rows, self.templates.take(rows)
        return self._gathered[1]

    def remember(
        self, pyramids: dict[int, Pyramid], observations: Observations, inlier: NDArray[np.bool_], pose: Array
    ) -> None:
        """Keep what the cameras saw: images, the tracks that agreed (inlier, (N,)), the surface's pose (4, 4)."""
        for c, images in pyramids.items():
            mine = inlier & (observations.camera == c)
            self._views[c] = MatchedView(images[0], observations.track[mine], observations.pixels[mine], pose)
