"""New landmarks where the surface has come into view with few landmarks.

Two cameras find them as the first map was found, with the landmarks in both as seeds. Cameras stand 36 to 84 degrees
apart, so one alone sees a steep side, or the surface while the others are covered: there landmarks are put where its
rays meet the known surface, extrapolated by the local fit (`estimation.mapping.triangulation`). The fit's depth error
is in the covariance; later views from other angles reduce it. All are on probation until a later frame set shows that
they move with the surface: a drape beside a wound matches as well, but does not move.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.mapping.bundle_adjustment import rigid_motion_covariance
from estimation.mapping.refiner import MIN_TRACK_SIGMA_PX
from estimation.mapping.triangulation import intersect_rays_with_surface, rays, update_from_observations
from estimation.observations import Observations
from estimation.pose_solver import project
from estimation.rig import Rig, ideal_pixels
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap, Warp, merge_maps
from perception.frames import Image
from perception.lens import Lenses, undistort
from perception.mapping.features import Features, ImageMask, corners, sift
from perception.mapping.first_map import Landmarks, Seeds, assemble, best_landmarks, find_seeds
from perception.mapping.masks import trackable
from perception.mapping.matcher import Matcher
from perception.mapping.patches import (
    MIN_PATCH_CONTRAST,
    Pyramid,
    Templates,
    cut_templates,
    join,
    project_squares,
    square_axes,
)
from perception.mapping.scan_map import REFERENCE_SIGMA_PX, as_at_one_instant

MIN_MATCHING_FACING = 0.35  # cosine of the viewing angle, from which two cameras can match
MIN_SPACING_PX = 8  # px between landmarks
MAX_PLACE_SIGMA_MM = 2.0  # mm across the surface: less certain places are dropped


TARGET_PER_CAMERA = 120  # landmarks, at least
GROWTH_SHARE = 0.7  # of it, and of the camera's first number, below which more are searched for
SEARCH_MARGIN_SHARE = 0.35  # of the mapped part's size in an image: search range beyond it
MIN_NEW_LANDMARKS = 8  # new landmarks: with fewer the map is not changed
GROWTH_FEATURES = 300  # a camera, for the first matches on the unmapped part
MAX_NEW_RESIDUAL_PX = 2.0  # px of a new landmark from its prediction by the surface's motion
MIN_PROOF_MOTION_PX = 4.0  # px of motion, which discriminates the surface from what stands still
MAX_GAP_SHARE = 0.04  # of the distance to the cameras: landmarks so near to known ones,
MAX_HEIGHT_SHARE = 0.004  # and so near to their surface, need no such proof
MAX_MISSES = 4  # looks with a new landmark in view but not measured


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSnapshot:
    """One frame set with known pose of the surface."""

    images: dict[int, Image]  # grey, by camera
    base_from_surface: Array  # (4, 4), of all cameras together
    single: dict[int, Array]  # (4, 4) at each camera's own exposure
    covariance: Array  # (6, 6) of base_from_surface
    tracks: Observations  # inliers
    heads: dict[int, ImageMask]  # the print head's masks by camera
    warp: Warp | None = None  # of the surface at that instant


@dataclass(frozen=True, slots=True, eq=False)
class NewLandmarks:
    """New landmarks of one frame set."""

    snapshot: SurfaceSnapshot
    map: SurfaceMap
    templates: Templates
    level: Array  # (N,) mm across the surface, of places by neighbours; inf: by two cameras
    features: dict[int, Features]  # by camera, around them


@dataclass(frozen=True, slots=True, eq=False)
class NewPart:
    """New landmarks by one method, surface frame."""

    map: SurfaceMap
    templates: Templates
    sigma: Array  # (N,) mm, as `NewLandmarks.level`


@dataclass(frozen=True, slots=True, eq=False)
class GrowthSearch:
    """Inputs of the search for new landmarks in one frame set."""

    lenses: Lenses  # of the rig relative to the surface at one instant
    snapshot: SurfaceSnapshot
    map: SurfaceMap  # so far, surface frame, with the warp applied
    pyramids: dict[int, Pyramid]  # images by camera
    masks: dict[int, ImageMask]  # (H, W) by camera, where new landmarks may be


def find_new_landmarks(rig: Rig, snapshot: SurfaceSnapshot, surface_map: SurfaceMap) -> NewLandmarks | None:
    """New landmarks: by two cameras, or on the extrapolated surface by one; None if too few."""
    if snapshot.warp is not None:
        surface_map = replace(surface_map, points=snapshot.warp.apply(surface_map.points))
    lenses = Lenses(as_at_one_instant(rig, snapshot.base_from_surface, snapshot.single))
    pyramids = {c: Pyramid(image) for c, image in snapshot.images.items()}
    missing = {c: TARGET_PER_CAMERA - int((snapshot.tracks.camera == c).sum()) for c in sorted(pyramids)}
    masks = {c: trackable(pyramids[c][0], _unmapped_mask(lenses, c, snapshot), snapshot.heads.get(c)) for c in missing}
    search = GrowthSearch(lenses, snapshot, surface_map, pyramids, masks)
    features = {c: sift(pyramids[c][0], masks[c], GROWTH_FEATURES, tilted=True) for c in missing}
    counts = {c: count if count >= MIN_NEW_LANDMARKS else 0 for c, count in missing.items()}
    parts = best_landmarks(lenses, pyramids, masks, counts, lambda a, b: _seeds(search, a, b, features))
    new = list[NewPart]()
    if sum(len(p.points) for p in parts) >= MIN_NEW_LANDMARKS:
        stereo = assemble(lenses, pyramids, parts, snapshot.base_from_surface)
        new.append(NewPart(stereo.map, stereo.templates, np.full(len(stereo.map), np.inf)))
    new += _monocular_parts(search, missing, parts)
    if sum(len(part.map) for part in new) < MIN_NEW_LANDMARKS:
        return None
    new_map = reduce(merge_maps, [part.map for part in new])
    covariance = new_map.covariance + rigid_motion_covariance(
        new_map.points, snapshot.covariance
    )  # all share the pose's error
    templates, level = join([part.templates for part in new]), np.concatenate([part.sigma for part in new])
    points = new_map.points if snapshot.warp is None else snapshot.warp.undo(new_map.points)
    return NewLandmarks(snapshot, SurfaceMap(points, new_map.normals, covariance), templates, level, features)


def _monocular_parts(search: GrowthSearch, missing: dict[int, int], parts: list[Landmarks]) -> list[NewPart]:
    """Landmarks that only one camera sees, by camera."""
    lenses, tracks = search.lenses, search.snapshot.tracks
    cameras = [c for c in sorted(search.pyramids) if (tracks.camera == c).sum() >= MIN_NEW_LANDMARKS]
    matched = np.concatenate([np.zeros((0, 3)), *[p.points for p in parts]])
    new = []
    for c in cameras:
        pixels, _ = lenses.image(c, *ideal_pixels(lenses.rig.cameras[c], matched))
        inside = ((pixels > 0) & (pixels < lenses.rig.cameras[c].size)).all(1)
        count = missing[c] - int(inside.sum())
        if count >= MIN_NEW_LANDMARKS:
            part = _monocular_landmarks(search, c, [o for o in cameras if o != c], pixels[inside], count)
            if part is not None:
                new.append(part)
    return new


def _monocular_landmarks(
    search: GrowthSearch, camera: int, others: list[int], occupied_pixels: Array, count: int
) -> NewPart | None:
    """Up to `count` corners of one camera that none of the `others` sees well, on the extrapolated surface.

    occupied_pixels: (N, 2) px as imaged, of new landmarks found before.
    """
    mask = search.masks[camera].copy()
    for spot in np.round(occupied_pixels).astype(np.int32):
        cv2.circle(mask, spot.tolist(), MIN_SPACING_PX, 0, -1)
    lenses, surface_map, pose = search.lenses, search.map, search.snapshot.base_from_surface
    lens, images = lenses.rig.cameras[camera], search.pyramids[camera]
    pixels = undistort(lens, corners(images[0], mask, count))
    origins, directions = rays(lenses.rig, np.full(len(pixels), camera), pixels)
    surface_from_base = se3.inverse(pose)
    origins, directions = se3.transform_points(surface_from_base, origins), directions @ surface_from_base[:3, :3].T
    angle = np.full(len(pixels), REFERENCE_SIGMA_PX / float(lens.matrix[0, 0]))
    hits = intersect_rays_with_surface(surface_map.points, surface_map.covariance, origins, directions, angle)
    good = np.flatnonzero(hits.good & (hits.sigma < MAX_PLACE_SIGMA_MM))
    good = good[~_visible_to_others(lenses, others, pose, camera, hits.points[good], hits.normals[good])]
    points, normals = hits.points[good], hits.normals[good]
    if not len(good):
        return None
    templates = cut_templates(lenses, images, camera, pose, points, normals)
    sharp = templates.contrast > MIN_PATCH_CONTRAST
    rows = (3 * good[sharp][:, None] + np.arange(3)).ravel()
    new = SurfaceMap(points[sharp], normals[sharp], hits.covariance[np.ix_(rows, rows)])
    return NewPart(new, templates.take(sharp), hits.sigma[good[sharp]])


def _visible_to_others(
    lenses: Lenses, others: list[int], base_from_surface: Array, camera: int, points: Array, normals: Array
) -> NDArray[np.bool_]:
    """Which points (N, 3) another camera sees well enough for a match."""
    visible = np.zeros(len(points), bool)
    axes = square_axes(lenses, camera, base_from_surface, points, normals)
    for other in others if len(points) else []:
        where = project_squares(lenses, other, base_from_surface, points, normals, axes)
        visible |= where.visible & (where.facing > MIN_MATCHING_FACING)
    return visible


def _unmapped_mask(lenses: Lenses, camera: int, snapshot: SurfaceSnapshot) -> ImageMask:
    """Mask (H, W) of an image around and between the tracked landmarks."""
    size = lenses.rig.cameras[camera].size
    mask = np.zeros((size[1], size[0]), np.uint8)
    of_camera = snapshot.tracks.camera == camera
    if of_camera.sum() < 6:
        return mask
    imaged, _ = lenses.image(camera, snapshot.tracks.pixels[of_camera], np.full(int(of_camera.sum()), 1e3))
    spots = np.round(imaged).astype(np.int32)
    cv2.fillConvexPoly(mask, cv2.convexHull(spots), 255)
    diameter = float(np.sqrt(cv2.countNonZero(mask)))
    reach = 2 * int(SEARCH_MARGIN_SHARE * diameter) + 1
    mask = np.asarray(cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))), np.uint8)
    for spot in spots:
        cv2.circle(mask, spot.tolist(), max(6, int(0.6 * diameter / np.sqrt(TARGET_PER_CAMERA))), 0, -1)
    return mask


def _seeds(search: GrowthSearch, a: int, b: int, features: dict[int, Features]) -> Seeds | None:
    """Seeds between two cameras: landmarks that both see, and matches on the unmapped part."""
    new_seeds = find_seeds(search.lenses, a, b, features, np.random.default_rng(0))
    tracks = search.snapshot.tracks
    in_a, in_b = tracks.select(tracks.camera == a), tracks.select(tracks.camera == b)
    rows, at_a, at_b = np.intersect1d(in_a.track, in_b.track, return_indices=True)
    pixels_a, pixels_b = in_a.pixels[at_a], in_b.pixels[at_b]
    points = se3.transform_points(search.snapshot.base_from_surface, search.map.points[rows])
    if new_seeds is None:
        return Seeds(a, b, pixels_a, pixels_b, points) if len(rows) >= 6 else None
    pixels_a, pixels_b = np.concatenate([pixels_a, new_seeds.pixels_a]), np.concatenate([pixels_b, new_seeds.pixels_b])
    return Seeds(a, b, pixels_a, pixels_b, np.concatenate([points, new_seeds.points]))


@dataclass(slots=True, eq=False)
class Probation:
    """New landmarks until they are proven to move with the surface; looks are counts (N,)."""

    new: NewLandmarks
    between_known: NDArray[np.bool_]  # (N,)
    map: SurfaceMap = field(init=False)  # of the new landmarks, updated
    moved_looks: NDArray[np.int64] = field(init=False)  # measured as the motion predicts, far from its rest place
    still_looks: NDArray[np.int64] = field(init=False)  # measured as the motion predicts, near its rest place
    missed_looks: NDArray[np.int64] = field(init=False)  # not measured there

    def __post_init__(self) -> None:
        self.map = self.new.map
        self.moved_looks, self.still_looks, self.missed_looks = np.zeros((3, len(self.map)), np.int64)

    def look(
        self,
        lenses: Lenses,
        stamp: float,
        pyramids: dict[int, Pyramid],
        single: dict[int, Array],
        covariance: Array | None = None,
    ) -> None:
        """Measure them again at each camera's own pose of the surface, with its covariance (6, 6).

        It updates landmarks of one camera alone: in depth where the surface has turned.
        """
        tracks = Matcher(lenses, self.map, self.new.templates).align(stamp, pyramids, single)
        projected, rest_pixels = np.zeros((2, len(tracks), 2))
        jacobians = np.zeros((len(tracks), 2, 6))
        for c in np.unique(tracks.camera):
            rows = tracks.camera == c
            points = self.map.points[tracks.track[rows]]
            rest_pose = self.new.snapshot.single.get(int(c), self.new.snapshot.base_from_surface)
            projected[rows], _, jacobians[rows] = project(lenses.rig, tracks.camera[rows], single[int(c)], points)
            rest_pixels[rows] = project(lenses.rig, tracks.camera[rows], rest_pose, points)[0]
        good = np.linalg.norm(tracks.pixels - projected, axis=1) < MAX_NEW_RESIDUAL_PX
        mono = good & np.isfinite(self.new.level[tracks.track])
        if covariance is not None and mono.any():
            looks, offsets = tracks.select(mono), projected[mono] - tracks.pixels[mono]
            sigma = np.maximum(looks.sigma, MIN_TRACK_SIGMA_PX)
            self.map, good[mono] = update_from_observations(
                self.map, looks.track, offsets, jacobians[mono], sigma, covariance
            )
        far = np.linalg.norm(rest_pixels - projected, axis=1) > MIN_PROOF_MOTION_PX
        np.add.at(self.moved_looks, tracks.track[good & far], 1)
        np.add.at(self.still_looks, tracks.track[good & ~far], 1)
        self.missed_looks[np.setdiff1d(np.arange(len(self.missed_looks)), tracks.track[good])] += 1

    @property
    def level(self) -> Array:
        """(N,) mm, one sigma across the surface of places by neighbours; inf: by two cameras."""
        count, normals = len(self.map), self.map.normals
        blocks = np.einsum("ninj->nij", self.map.covariance.reshape(count, 3, count, 3))
        sigma = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", normals, blocks, normals), 0.0))
        return np.where(np.isfinite(self.new.level), sigma, np.inf)

    @property
    def proven(self) -> NDArray[np.bool_]:
        """(N,), which belong to the surface."""
        enough = (self.moved_looks >= 1) | (self.between_known & (self.still_looks >= 1))
        return np.asarray(enough & (self.moved_looks + self.still_looks > self.missed_looks))

    @property
    def finished(self) -> bool:
        """Whether each is proven or missed MAX_MISSES times."""
        return bool((self.proven | (self.missed_looks >= MAX_MISSES)).all())


def between_known(new: NewLandmarks, surface_map: SurfaceMap, distance: float) -> NDArray[np.bool_]:
    """Which new landmarks (N,) lie between known ones and on their surface. distance: mm to the cameras.

    False for landmarks of one camera, which were put on that surface.
    """
    offsets = new.map.points[:, None] - surface_map.points
    gap = np.linalg.norm(offsets, axis=2)
    near = np.argsort(gap, axis=1)[:, :4]
    rows = np.arange(len(near))[:, None]
    height = np.abs(np.einsum("nki,nki->nk", offsets[rows, near], surface_map.normals[near])).min(1)
    between = (gap[rows, near].max(1) < MAX_GAP_SHARE * distance) & (height < MAX_HEIGHT_SHARE * distance)
    return np.asarray(between & ~np.isfinite(new.level))
