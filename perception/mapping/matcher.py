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
MIN_SIMILAR_SHARE = 0.35  # of similar windows, from which the flow is trusted
SAMPLE_TRACKS = 40  # compared windows, about
MIN_GAIN_CHANGE = 0.08  # of brightness; flow tolerates smaller ones
GAIN_RANGE = 0.4, 2.5  # beyond which it is another picture
MAX_RETURN_ERROR_PX = 1.0  # px from where a track began to where it ends when it is followed back
FLOW_MARGIN_PX = 48.0  # px around the tracks: flow sees that far beyond them


def optical_flow(
    previous: Image, current: Image, pixels: Array, guess: Array, levels: int = 4
) -> tuple[Array, NDArray[np.bool_]]:
    """Where pixels (N, 2) of the previous image are in the current one (N, 2), and whether they were tracked (N,).

    guess: (N, 2) px, start. Pyramidal Lucas-Kanade (thesis 4.4, Eq. 4.7-4.10) on the bounding box of the tracks. It
    assumes constant brightness, and fails (measured) where that jumps by a quarter: where most windows differ
    afterwards, it is repeated with the jump removed, and the better of both results is used.
    Forward-backward check: a track followed backwards must end where it began (Kalal et al. 2010).
    """
    first = _forward_backward(previous, current, pixels, guess, levels)
    share = _similar_share(previous, current, pixels, *first)
    if share >= MIN_SIMILAR_SHARE:
        return first
    gain, offset = _brightness(previous, current, pixels, guess)
    if not GAIN_RANGE[0] < gain < GAIN_RANGE[1] or (
        abs(gain - 1) < MIN_GAIN_CHANGE and abs(offset) < MIN_GAIN_CHANGE * 128
    ):
        return first
    rescaled = np.asarray(cv2.addWeighted(current, 1 / gain, current, 0.0, -offset / gain), np.uint8)
    second = _forward_backward(previous, rescaled, pixels, guess, levels)
    return second if _similar_share(previous, rescaled, pixels, *second) > share else first


def _forward_backward(
    previous: Image, current: Image, pixels: Array, guess: Array, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    forward, tracked = _lucas_kanade(previous, current, pixels, guess, levels)
    forward[~tracked] = guess[~tracked]
    backward, tracked_back = _lucas_kanade(current, previous, forward, pixels + forward - guess, levels)
    return forward, tracked & tracked_back & (np.linalg.norm(backward - pixels, axis=1) < MAX_RETURN_ERROR_PX)


def _lucas_kanade(
    previous: Image, current: Image, pixels: Array, guess: Array, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    h, w = current.shape[:2]
    extent = np.concatenate([pixels, guess])
    x0, y0, x1, y1 = bounding_box(np.clip(extent, 0, [w, h]), (w, h), FLOW_MARGIN_PX)
    corner = np.array([x0, y0], float)
    begin = np.ascontiguousarray((guess - corner)[:, None], np.float32)
    result, status, _ = cv2.calcOpticalFlowPyrLK(
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
    places = np.asarray(result, np.float64)[:, 0]
    return places + corner, (np.asarray(status).ravel() > 0) & np.isfinite(places).all(1)


def _similar_share(previous: Image, current: Image, pixels: Array, ends: Array, tracked: NDArray[np.bool_]) -> float:
    """Share of the tracks, `tracked` (N,), whose window is similar before and after, at any brightness."""
    sample = np.arange(0, len(pixels), max(1, len(pixels) // SAMPLE_TRACKS))  # a few dozen serve as well as all
    rows = sample[tracked[sample]]
    if not len(rows):
        return 0.0
    old, new = _windows(previous, pixels[rows]), _windows(current, ends[rows])
    old, new = old - old.mean(1, keepdims=True), new - new.mean(1, keepdims=True)
    product, squares = (old * new).sum(1), (old**2).sum(1) * (new**2).sum(1)
    return float(np.sum(product > MIN_WINDOW_CORRELATION * np.sqrt(squares)) / len(sample))


def _brightness(previous: Image, current: Image, pixels: Array, guess: Array) -> tuple[float, float]:
    """Gain and offset, grey levels, from the previous image to the current one: the median over the tracks' windows."""
    old, new = _windows(previous, pixels), _windows(current, guess)
    spread = old.std(1)
    textured = spread > MIN_WINDOW_SPREAD
    if textured.sum() < MIN_GAIN_WINDOWS:
        return 1.0, 0.0
    gain = float(np.median(new[textured].std(1) / spread[textured]))
    return gain, float(np.median(new.mean(1) - gain * old.mean(1)))


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
UNCERTAINTY_LANDMARKS = 8  # of a camera, in which the uncertainty of all is evaluated
MIN_GRAIN_CORRELATION = 0.5  # correlation of a landmark's grain with its own: other skin has 0.1 by chance
COMPLETE_SHARE = 0.8  # of a camera's landmarks: where fewer are measured, the start may have been wrong
FLOW_POSE_TOLERANCE = 1e-3  # rad, mm: a start for the alignment need not be better


@dataclass(frozen=True, slots=True, eq=False)
class MatchedView:
    """What one camera last saw of the landmarks."""

    image: Image
    rows: NDArray[np.int64]  # (N,) of the map
    pixels: Array  # (N, 2) px, ideal, of the landmarks
    base_from_surface: Array  # (4, 4)


def spread_order(points: Array) -> NDArray[np.int64]:
    """Row numbers (N,) of points (N, 3) in farthest-first order: the first n are spread over all, for every n.

    Each next point is the farthest from those before (Gonzalez 1985).
    """
    order, distance = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    row = int(np.argmin(((points - points.mean(0)) ** 2).sum(1))) if len(points) else 0
    for i in range(len(points)):
        order[i], distance[row] = row, -1.0
        distance = np.minimum(distance, ((points - points[row]) ** 2).sum(1))
        row = int(np.argmax(distance))
    return order


class Matcher:
    """Finds the landmarks of one map; remembers what each camera last saw of them."""

    def __init__(
        self, lenses: Lenses, surface_map: SurfaceMap, templates: Templates, masks: TrackingMasks | None = None
    ) -> None:
        """masks: what is not to be tracked in the current frame set."""
        self.lenses, self.rig = lenses, lenses.rig
        self.templates = templates
        self.map = surface_map
        self.usable = np.ones(len(surface_map), bool)  # landmarks to be searched for
        self._views: dict[int, MatchedView] = {}
        self._template_cache: tuple[NDArray[np.int64], Templates] | None = None
        self._order = spread_order(surface_map.points)
        self._ink_mask = np.zeros(len(surface_map), bool)
        self._masks = masks or TrackingMasks(lenses)

    def update_map(self, surface_map: SurfaceMap, usable: NDArray[np.bool_]) -> None:
        """Take a refined map, same rows, and which of them (N,) are to be searched for."""
        self.map, self.usable = surface_map, usable

    def extend(self, surface_map: SurfaceMap, templates: Templates) -> None:
        """Take the map with rows appended, and their reference pictures."""
        new = len(surface_map) - len(self.map)
        self._order = np.concatenate([self._order, len(self.map) + spread_order(surface_map.points[len(self.map) :])])
        self.map, self._template_cache = surface_map, None
        self.templates = join([self.templates, templates])
        self.usable = np.concatenate([self.usable, np.ones(new, bool)])
        self._ink_mask = np.concatenate([self._ink_mask, np.zeros(new, bool)])

    def cover(self, bead: Array) -> None:
        """Stop searching for landmarks under a bead (M, 3) mm, surface frame."""
        self._ink_mask |= near_bead(self.map.points, bead, patch_reach(self.templates.axes))

    def reframe(self, surface_map: SurfaceMap, new_from_old: Array) -> None:
        """Change the surface frame: new_from_old (4, 4). surface_map: in the new frame, same rows."""
        self.map, self._template_cache = surface_map, None
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
        rows = np.nonzero(self.usable)[0]
        poses, axes = np.broadcast_to(base_from_surface, (len(cameras), 4, 4)), self.templates.axes[rows]
        where = project_into(self.lenses, cameras, poses, self.map.points[rows], self.map.normals[rows], axes)
        return dict(zip(cameras, where.visible.reshape(len(cameras), -1).sum(1).tolist(), strict=True))

    def image_sigma(self, base_from_surface: Array, covariance: Array) -> float:
        """Standard deviation, px, of where a pose with a covariance (6, 6) puts the landmarks in the images.

        The worst of a few landmarks of each camera; infinite where no camera has seen the surface.
        """
        cameras = sorted(c for c in self._views if self.last_count(c) >= 6)
        if not cameras:
            return np.inf
        samples = [self._views[c].rows[:: 1 + self.last_count(c) // UNCERTAINTY_LANDMARKS] for c in cameras]
        camera = np.repeat(cameras, [len(rows) for rows in samples])
        jacobian = project(self.rig, camera, base_from_surface, self.map.points[np.concatenate(samples)])[2]
        return float(np.sqrt(((jacobian @ covariance) * jacobian).sum(2).max()))

    def is_complete(self, observations: Observations, cameras: Iterable[int]) -> bool:
        """Whether most landmarks that each camera last saw are measured again."""
        counts = np.bincount(observations.camera, minlength=len(self.rig))
        return all(counts[c] >= COMPLETE_SHARE * self.last_count(c) for c in cameras)

    def flow(self, pyramids: dict[int, Pyramid], guess: Array) -> tuple[Array, dict[int, Array]]:
        """The joint pose by optical flow, and by camera its own: cameras are seldom exposed at the same instant."""
        points = self.map.points
        cameras = [c for c in pyramids if self.last_count(c) >= 6]
        flows = parallel_map(lambda c: self._flow_one(c, pyramids[c][0], guess), cameras)
        by_camera = dict(zip(cameras, flows, strict=True))
        single = dict.fromkeys(pyramids, guess)
        if sum(len(rows) for rows, _ in by_camera.values()) < 6:
            return guess, single
        camera = np.concatenate([np.full(len(rows), c) for c, (rows, _) in by_camera.items()])
        rows = np.concatenate([rows for rows, _ in by_camera.values()])
        pixels = np.concatenate([pixels for _, pixels in by_camera.values()])
        tracks = PointTracks(camera, points[rows], pixels, np.ones(len(rows)))
        fit = solve_pose(self.rig, tracks, guess, scales=(8.0, 1.5), iterations=4, tolerance=FLOW_POSE_TOLERANCE)
        good = fit.weights > 0.2
        for c in pyramids:
            of_camera = good & (camera == c)
            single[c] = fit.base_from_surface
            if of_camera.sum() < 8 <= (camera == c).sum():  # it contradicts the others: fit it alone
                own = solve_pose(
                    self.rig, tracks.select(camera == c), guess, scales=(8.0, 1.5), prior=CAMERA_POSE_PRIOR
                )
                single[c] = own.base_from_surface
            if of_camera.sum() >= 8 and fit.scale > 1.2:  # else the cameras agree within the flow's own error
                own = solve_pose(
                    self.rig,
                    tracks.select(of_camera),
                    single[c],
                    prior=CAMERA_POSE_PRIOR,
                    iterations=2,
                    tolerance=FLOW_POSE_TOLERANCE,
                )
                single[c] = own.base_from_surface
        return fit.base_from_surface, single

    def _flow_one(self, camera: int, image: Image, guess: Array) -> tuple[NDArray[np.int64], Array]:
        view = self._views[camera]
        stride = slice(None, None, 1 + len(view.rows) // MAX_FLOW_TRACKS)
        rows, ideal = view.rows[stride], view.pixels[stride]
        pixels, _ = self.lenses.image(camera, ideal, np.full(len(rows), np.inf))
        old_projection = self._image_pixels(camera, view.base_from_surface, rows)
        new_projection = self._image_pixels(camera, guess, rows)
        current, tracked = optical_flow(view.image, image, pixels, pixels + new_projection - old_projection)
        return rows[tracked], undistort(self.rig.cameras[camera], current[tracked])

    def _image_pixels(self, camera: int, base_from_surface: Array, rows: NDArray[np.int64]) -> Array:
        """Where landmarks (rows) fall in a camera's image, (N, 2) px."""
        points_base = se3.transform_points(base_from_surface, self.map.points[rows])
        return self.lenses.image(camera, *ideal_pixels(self.rig.cameras[camera], points_base))[0]

    def align(
        self,
        stamp: float,
        pyramids: dict[int, Pyramid],
        poses: dict[int, Array],
        coarse: bool = False,
        limit: int | None = None,
    ) -> Observations:
        """Measure the landmarks in every camera, starting from their projection by the camera's own pose.

        coarse: begin on the half-size images, which reaches farther. limit: landmarks of a camera, spread over the
        surface and the same from frame set to frame set; None: all.
        """
        cameras = [c for c in pyramids if c in poses]
        if not cameras:
            return no_observations(stamp)
        rows = np.nonzero(~self._ink_mask)[0]
        surface_map, axes, usable = self.map, self.templates.axes[rows], self.usable[rows]
        starts = np.stack([poses[c] for c in cameras])
        where = project_into(self.lenses, cameras, starts, surface_map.points[rows], surface_map.normals[rows], axes)
        centres = where.centre.reshape(len(cameras), -1, 2)
        hidden = np.concatenate([self._masks.hides(c, at) for c, at in zip(cameras, centres, strict=True)])
        visible = where.visible & ~hidden
        dropped = np.nonzero(visible & ~np.tile(usable, len(cameras)))[0]
        visible &= np.tile(usable, len(cameras))
        index = np.nonzero(visible if limit is None else self._spread_selection(visible, rows, limit))[0]
        position, row = np.divmod(index, len(rows))
        dropped_position, dropped_row = np.divmod(dropped, len(rows))
        dropped_row = rows[dropped_row]
        where, row = where.take(index), rows[row]
        counts = np.bincount(position, minlength=len(cameras))
        images = [pyramids[c] for c in cameras]
        result = align_in(self._gather_templates(row), images, counts.tolist(), where, where.centre, coarse=coarse)
        good, numbers = result.found, np.array(cameras, np.int64)
        camera = numbers[position[good]]
        pixels = self._ideal_pixels(camera, result.pixels[good])
        # a landmark that shows its grain, at the predicted or the aligned pixel, is visible though not measured
        unmeasured = np.flatnonzero(~good)
        spots, twice = np.concatenate([where.centre[unmeasured], result.pixels[unmeasured]]), np.tile(unmeasured, 2)
        shows = self._shows_grain(pyramids, numbers[position[twice]], where.take(twice), spots, row[twice])
        lost = unmeasured[~shows.reshape(2, -1).any(0)]
        # landmarks that the refinement dropped count as missed too: the surface may have left their mapped place
        camera_missed = numbers[np.concatenate([position[lost], dropped_position])]
        missed = MissedLandmarks(camera_missed, np.concatenate([row[lost], dropped_row]))
        return Observations(stamp, camera, row[good], pixels, result.sigma[good], missed)

    def shadowed_tracks(
        self, pyramids: dict[int, Pyramid], poses: Array, tracks: Observations, outlier: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Which tracks (N,), of the outliers (N,), show their grain where poses (C, 4, 4) project them."""
        shadowed, index = np.zeros(len(tracks), bool), np.flatnonzero(outlier & np.isin(tracks.camera, list(pyramids)))
        camera, rows = tracks.camera[index], tracks.track[index]
        points, normals, axes = self.map.points[rows], self.map.normals[rows], self.templates.axes[rows]
        where = project_tracks_into(self.lenses, camera, poses, points, normals, axes)
        shadowed[index] = self._shows_grain(pyramids, camera, where, where.centre, rows)
        return shadowed

    def _shows_grain(
        self, pyramids: dict[int, Pyramid], camera: Index, where: Projection, spots: Array, rows: Index
    ) -> NDArray[np.bool_]:
        """Which landmarks (rows, (M,)) show their grain at spots (M, 2) px of cameras (M,), even in shadow."""
        if not len(rows):
            return np.zeros(0, bool)
        grain = grain_of(sample_each(pyramids, camera, spots, where.per_sample))
        first = grain_of(self.templates.picture[rows])
        product, sizes = (grain * first).sum(1), (grain * grain).sum(1) * (first * first).sum(1)
        return np.asarray(product > MIN_GRAIN_CORRELATION * np.sqrt(sizes))

    def align_at(
        self, stamp: float, pyramids: dict[int, Pyramid], pose: Array, rows: NDArray[np.int64], points: Array
    ) -> Observations:
        """Measure landmarks (rows, (R,)) at other points (R, 3) mm of the surface, at a pose (4, 4)."""
        cameras, templates = list(pyramids), self.templates.take(rows)
        poses = np.broadcast_to(pose, (len(cameras), 4, 4))
        where = project_into(self.lenses, cameras, poses, points, self.map.normals[rows], templates.axes)
        counts, camera = [len(rows)] * len(cameras), np.repeat(cameras, len(rows))
        tiled, images = self.templates.take(np.tile(rows, len(cameras))), [pyramids[c] for c in cameras]
        result = align_in(tiled, images, counts, where, where.centre, coarse=True)
        good, track = result.found, np.tile(rows, len(cameras))
        pixels = self._ideal_pixels(camera[good], result.pixels[good])
        return Observations(stamp, camera[good], track[good], pixels, result.sigma[good])

    def _spread_selection(self, visible: NDArray[np.bool_], rows: NDArray[np.int64], limit: int) -> NDArray[np.bool_]:
        """Mask (C * N,) of at most `limit` visible landmarks of each camera, the first in spread order."""
        rank = np.argsort(self._order)[rows]
        selection = np.zeros_like(visible).reshape(-1, len(rows))
        for of_camera, mask in zip(visible.reshape(selection.shape), selection, strict=True):
            index = np.nonzero(of_camera)[0]
            mask[index[np.argsort(rank[index])[:limit]]] = True
        return selection.ravel()

    def _ideal_pixels(self, camera: NDArray[np.int64], pixels: Array) -> Array:
        """Undistorted pixels (N, 2) of imaged ones, by camera (N,), in ascending blocks."""
        ideal = np.empty((len(pixels), 2))
        for c in np.unique(camera):
            of_camera = camera == c
            ideal[of_camera] = undistort(self.rig.cameras[c], pixels[of_camera])
        return ideal

    def _gather_templates(self, rows: NDArray[np.int64]) -> Templates:
        """The templates of rows (N,), cached: megabytes, and mostly the same as for the last frame set."""
        if self._template_cache is None or not np.array_equal(self._template_cache[0], rows):
            self._template_cache = rows, self.templates.take(rows)
        return self._template_cache[1]

    def remember(
        self, pyramids: dict[int, Pyramid], observations: Observations, inlier: NDArray[np.bool_], pose: Array
    ) -> None:
        """Keep the images, the inlier tracks (inlier, (N,)) and the surface's pose (4, 4) for the next flow."""
        for c, images in pyramids.items():
            of_camera = inlier & (observations.camera == c)
            self._views[c] = MatchedView(images[0], observations.track[of_camera], observations.pixels[of_camera], pose)
