"""Where the landmarks are in new images: flow from the last ones is the start, the fit to the reference the measure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.observations import Observations, no_observations
from estimation.online.pose_solver import project, solve_pose
from estimation.rig import ideal_pixels
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.alignment import align_in
from perception.flow import flow as optical_flow
from perception.frames import Image
from perception.ink import near_bead
from perception.lens import Lenses, undistort
from perception.matching.masks import KeepOut, patch_reach
from perception.matching.patches import Pyramid, Templates, join, project_into
from perception.side_by_side import side_by_side

LOOSE = np.diag([1 / 0.02**2] * 3 + [1 / 5.0**2] * 3)  # how far one camera's own pose may stray from the joint one
FLOW_TRACKS = 80  # a camera: enough for a start, and flow is only that
DOUBTED = 8  # landmarks of a camera that tell how uncertain all of them are
MOST = 0.8  # of a camera's landmarks: fewer found may be the fault of where they were sought
ROUGH = 1e-3  # rad, mm: a start for the alignment need not be better


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What one camera last saw: its image, where landmarks (rows) stood in it, ideal pixels, and the pose then."""

    image: Image
    rows: NDArray[np.int64]
    pixels: Array
    base_from_surface: Array


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
        self, lenses: Lenses, surface_map: SurfaceMap, templates: Templates, keep_out: KeepOut | None = None
    ) -> None:
        """keep_out: what is not to be tracked in the frame set that is looked at."""
        self.lenses, self.rig = lenses, lenses.rig
        self.templates = templates
        self.map = surface_map
        self.agrees = np.ones(len(surface_map), bool)  # landmarks worth looking for
        self._views: dict[int, View] = {}
        self._gathered: tuple[NDArray[np.int64], Templates] | None = None
        self._order = spread_order(surface_map.points)
        self._inked = np.zeros(len(surface_map), bool)
        self._keep_out = keep_out or KeepOut(lenses)

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

    def seen(self, camera: int) -> int:
        """How many landmarks a camera last saw."""
        return len(self._views[camera].rows) if camera in self._views else 0

    def in_view(self, cameras: Sequence[int], base_from_surface: Array) -> dict[int, int]:
        """How many landmarks each camera would see at a pose (4, 4), were nothing before them."""
        rows = np.nonzero(self.agrees)[0]
        poses, axes = np.broadcast_to(base_from_surface, (len(cameras), 4, 4)), self.templates.axes[rows]
        where = project_into(self.lenses, cameras, poses, self.map.points[rows], self.map.normals[rows], axes)
        return dict(zip(cameras, where.visible.reshape(len(cameras), -1).sum(1).tolist(), strict=True))

    def doubt(self, base_from_surface: Array, covariance: Array) -> float:
        """How far off, px, one standard deviation, a pose with a covariance (6, 6) puts the landmarks in the images.

        The worst of a few landmarks, a camera each in turn; infinite where no camera knows the surface.
        """
        ready = sorted(c for c in self._views if self.seen(c) >= 6)
        if not ready:
            return np.inf
        some = [self._views[c].rows[:: 1 + self.seen(c) // DOUBTED] for c in ready]
        camera = np.repeat(ready, [len(rows) for rows in some])
        jacobian = project(self.rig, camera, base_from_surface, self.map.points[np.concatenate(some)])[2]
        return float(np.sqrt(((jacobian @ covariance) * jacobian).sum(2).max()))

    def complete(self, observations: Observations, cameras: Iterable[int]) -> bool:
        """Whether each camera found most of what it last saw."""
        found = np.bincount(observations.camera, minlength=len(self.rig))
        return all(found[c] >= MOST * self.seen(c) for c in cameras)

    def flow(self, pyramids: dict[int, Pyramid], guess: Array) -> tuple[Array, dict[int, Array]]:
        """The joint pose by optical flow, and each camera's own: cameras are seldom exposed at the same instant."""
        points = self.map.points
        ready = [c for c in pyramids if self.seen(c) >= 6]
        found = side_by_side(lambda c: self._flow_one(c, pyramids[c][0], guess), ready)
        moved = dict(zip(ready, found, strict=True))
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
        rows, ideal = view.rows[some], view.pixels[some]
        pixels, _ = self.lenses.image(camera, ideal, np.full(len(rows), np.inf))
        before = self._imaged(camera, view.base_from_surface, rows)
        after = self._imaged(camera, guess, rows)
        found, ok = optical_flow(view.image, image, pixels, pixels + after - before)
        return rows[ok], undistort(self.rig.cameras[camera], found[ok])

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
        """Measure the landmarks in every camera, begun where the camera's own pose puts them; coarse: from afar.

        most: landmarks of a camera, spread over the surface and the same from frame set to frame set; all without.
        """
        cameras = [c for c in pyramids if c in poses]
        if not cameras:
            return no_observations(stamp)
        rows = np.nonzero(self.agrees & ~self._inked)[0]
        surface_map, axes = self.map, self.templates.axes[rows]
        starts = np.stack([poses[c] for c in cameras])
        where = project_into(self.lenses, cameras, starts, surface_map.points[rows], surface_map.normals[rows], axes)
        centres = where.centre.reshape(len(cameras), -1, 2)
        hidden = np.concatenate([self._keep_out.hides(c, at) for c, at in zip(cameras, centres, strict=True)])
        visible = where.visible & ~hidden
        seen = np.nonzero(visible if most is None else self._some(visible, rows, most))[0]
        position, row = np.divmod(seen, len(rows))
        where, row = where.take(seen), rows[row]
        counts = np.bincount(position, minlength=len(cameras))
        images = [pyramids[c] for c in cameras]
        result = align_in(self._pictures(row), images, counts.tolist(), where, where.centre, coarse=coarse)
        kept = result.found
        camera = np.array(cameras, np.int64)[position[kept]]
        pixels = self._ideal(camera, result.pixels[kept])
        return Observations(stamp, camera, row[kept], pixels, result.sigma[kept])

    def _some(self, visible: NDArray[np.bool_], rows: NDArray[np.int64], most: int) -> NDArray[np.bool_]:
        """Of what is visible (C * N,), at most so many landmarks of each camera: the first in the order of spread."""
        rank = np.argsort(self._order)[rows]
        some = np.zeros_like(visible).reshape(-1, len(rows))
        for mine, chosen in zip(visible.reshape(some.shape), some, strict=True):
            found = np.nonzero(mine)[0]
            chosen[found[np.argsort(rank[found])[:most]]] = True
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
            self._views[c] = View(images[0], observations.track[mine], observations.pixels[mine], pose)
