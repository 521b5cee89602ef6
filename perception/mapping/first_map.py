"""The first map: landmarks by triangulation across the cameras that see the region of interest.

Cameras stand 36 to 84 degrees apart, so a corner looks different in each. SIFT seeds give the surface's rough shape;
every corner is projected onto that shape, and its patch warped into the other view and aligned there. Cameras are
seldom exposed together: the epipolar distances of a moving surface share an offset, estimated by consensus.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from estimation import se3
from estimation.mapping.triangulation import epipolar_distance, rays, smooth_normals, triangulate
from estimation.rig import Rig, ideal_pixels
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap, local_normals, surface_frame, transform_map
from perception.lens import Lenses, undistort
from perception.mapping.features import Features, ImageMask, corners, matched_spots, polygon_mask, sift
from perception.mapping.masks import trackable
from perception.mapping.patches import (
    MIN_PATCH_CONTRAST,
    Projection,
    Pyramid,
    Templates,
    align,
    coarse_score,
    cut_templates,
    join,
    project_squares,
)

MAX_EPIPOLAR_OFFSET_PX = 40.0  # px: 0.3 m/s at 60 ms between exposures, f 700 px, 400 mm away
MIN_SEEDS, MIN_LANDMARKS = 10, 20
FEW_SPOTS = f"fewer than {MIN_LANDMARKS} spots could be matched between two cameras"
TARGET_LANDMARKS = 240  # in all: more cost time and gain nothing (the map's own error stays)


@dataclass(frozen=True, slots=True, eq=False)
class FirstMap:
    """The map at the first instant."""

    base_from_surface: Array  # (4, 4)
    map: SurfaceMap  # surface frame
    templates: Templates  # reference pictures of its landmarks


def in_frame(first: FirstMap, base_from_new: Array) -> FirstMap:
    """The same map in another surface frame, as a scan's: base_from_new (4, 4)."""
    new_from_old = se3.inverse(base_from_new) @ first.base_from_surface
    templates = replace(first.templates, axes=new_from_old[:3, :3] @ first.templates.axes)
    return FirstMap(base_from_new, transform_map(first.map, new_from_old), templates)


@dataclass(frozen=True, slots=True, eq=False)
class Seeds:
    """Matches between cameras a and b."""

    a: int
    b: int
    pixels_a: Array  # (N, 2) px, ideal
    pixels_b: Array  # (N, 2) px, ideal
    points: Array  # (N, 3) mm, base frame


def consensus(
    position: Array, value: Array, reach: float, tolerance: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Inliers (N,) of a plane value ~ [1 x y] over positions (N, 2), by RANSAC among values within `reach` of zero."""
    scale = np.maximum(position.std(0), 1.0)
    design = np.c_[np.ones(len(position)), (position - position.mean(0)) / scale]
    candidates = np.nonzero(np.abs(value) < reach)[0]
    best = np.zeros(len(value), bool)
    if len(candidates) < 4:
        return best
    for trial in range(200):
        chosen = rng.choice(candidates, 3, replace=False) if trial % 2 else rng.choice(candidates, 1)
        model = np.array([value[chosen[0]], 0.0, 0.0])
        if len(chosen) == 3:
            try:
                model = np.linalg.solve(design[chosen], value[chosen])
            except np.linalg.LinAlgError:
                continue
        if abs(model[0]) > reach or np.abs(model[1:]).max() > reach / 2:
            continue
        inliers = np.abs(design @ model - value) < tolerance
        if inliers.sum() > best.sum():
            best = inliers
    return best


def _smooth(points: Array, neighbours: int = 8) -> NDArray[np.bool_]:
    """Which points (N, 3) lie near the surface of their neighbours: wrong matches do not."""
    keep = np.ones(len(points), bool)
    for _ in range(2):
        index = np.nonzero(keep)[0]
        if len(index) < neighbours + 2:
            return keep
        distance, near = cKDTree(points[index]).query(points[index], k=neighbours + 1)
        median = np.median(points[index][near[:, 1:]], axis=1)
        deviation = np.linalg.norm(points[index] - median, axis=1)
        limit = 3.0 * np.median(distance[:, -1]) + 1e-6
        keep[index[deviation > limit]] = False
    return keep


def find_seeds(lenses: Lenses, a: int, b: int, features: dict[int, Features], rng: np.random.Generator) -> Seeds | None:
    """SIFT matches between two cameras that agree on one epipolar offset and on a surface."""
    cameras = lenses.rig.cameras
    imaged_a, imaged_b = matched_spots(features[a], features[b])
    if len(imaged_a) < MIN_SEEDS:
        return None
    pixels_a, pixels_b = undistort(cameras[a], imaged_a), undistort(cameras[b], imaged_b)
    distance = epipolar_distance(lenses.rig, a, b, pixels_a, pixels_b)
    good = consensus(pixels_b, distance, MAX_EPIPOLAR_OFFSET_PX, 2.0, rng)
    points, _, _ = _pair_points(lenses.rig, a, b, pixels_a[good], pixels_b[good])
    depth_a, depth_b = (ideal_pixels(cameras[c], points)[1] for c in (a, b))
    plausible = (depth_a > 20) & (depth_b > 20) & np.isfinite(points).all(1)
    plausible[plausible] &= _smooth(points[plausible])
    if plausible.sum() < MIN_SEEDS:
        return None
    return Seeds(a, b, pixels_a[good][plausible], pixels_b[good][plausible], points[plausible])


def _pair_points(rig: Rig, a: int, b: int, pixels_a: Array, pixels_b: Array) -> tuple[Array, Array, Array]:
    """Triangulated points (N, 3), covariances (N, 3, 3) and residuals (2 N, 2), of pixels (N, 2) of two cameras."""
    n = len(pixels_a)
    point, camera = np.tile(np.arange(n), 2), np.repeat([a, b], n)
    return triangulate(rig, point, camera, np.concatenate([pixels_a, pixels_b]), n)


def _meet_seed_surface(
    rig: Rig, seeds: Seeds, camera: int, pixels: Array, outward: Array
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Intersections of rays of pixels (N, 2) with the seeds' surface: points (N, 3) and normals (N, 3), base frame.

    Also the mean offset (N, 2) px of nearby seeds in the other camera from the projection of their points on their own
    rays, and whether seeds are near (N,).
    """
    own, other = (seeds.pixels_a, seeds.pixels_b) if camera == seeds.a else (seeds.pixels_b, seeds.pixels_a)
    target = seeds.b if camera == seeds.a else seeds.a
    tree = cKDTree(own)
    gap, near = tree.query(pixels, k=min(6, len(own)))
    spacing = np.median(tree.query(own, k=min(4, len(own)))[0][:, -1])
    normals = local_normals(seeds.points, outward)[near].mean(1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    origins, directions = rays(rig, np.full(len(pixels), camera), pixels)
    anchor = seeds.points[near].mean(1)
    slope = np.einsum("ni,ni->n", directions, normals)
    divisor = np.where(np.abs(slope) < 0.05, -0.05, slope)
    reach = np.einsum("ni,ni->n", anchor - origins, normals) / divisor
    points = origins + reach[:, None] * directions
    on_ray = on_rays(rig, camera, own, seeds.points)
    offset = (other - ideal_pixels(rig.cameras[target], on_ray)[0])[near].mean(1)
    return points, normals, offset, (gap[:, 0] < 3 * spacing + 10) & (np.abs(slope) > 0.05)


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Candidates of one reference camera, each matched in another."""

    camera: int
    other: int
    pixels: Array  # (N, 2) px, ideal
    pixels_other: Array  # (N, 2) px, ideal, in the other camera
    points: Array  # (N, 3) mm, base frame
    normals: Array  # (N, 3), base frame


def find_landmarks(
    lenses: Lenses, pyramids: dict[int, Pyramid], mask: NDArray[np.uint8], seeds: Seeds, camera: int, count: int
) -> Landmarks | None:
    """Corners of one camera, matched in the other: first on the seeds' surface, then by a sweep along their rays."""
    rig = lenses.rig
    other = seeds.b if camera == seeds.a else seeds.a
    pair = _CameraPair(lenses, pyramids, camera, other)
    outward = rig.cameras[camera].base_from_camera[:3, 3] - seeds.points.mean(0)
    pixels = undistort(rig.cameras[camera], corners(pyramids[camera][0], mask, count))
    if len(pixels) < 4:
        return None

    # on the seeds' surface
    points, normals, offset, near = _meet_seed_surface(rig, seeds, camera, pixels, outward)
    matches, good = pair.align(points, normals, offset, min_score=0.8)
    good &= near
    if good.sum() >= 4:
        surface = _pair_points(rig, camera, other, pixels[good], matches[good])[0]
        normals[~good] = local_normals(np.concatenate([surface, seeds.points]), outward).mean(0)

    # where that fails, along the rays
    missing = np.nonzero(~good)[0]
    if len(missing):
        sweep_points, distinct = pair.sweep(pixels[missing], normals[missing], offset[missing], seeds)
        matches[missing], fit_good = pair.align(sweep_points, normals[missing], offset[missing], min_score=0.85)
        good[missing] = fit_good & distinct

    # twice without outliers, on the surface of the inliers
    for _ in range(2):
        pixels, matches = pixels[good], matches[good]
        if len(pixels) < 6:
            return None
        points, _, residual = _pair_points(rig, camera, other, pixels, matches)
        keep = _smooth(points) & _affine_consistent(pixels, residual.reshape(2, -1, 2)[1])
        pixels, matches, points = pixels[keep], matches[keep], points[keep]
        if len(pixels) < 6:
            return None
        normals = smooth_normals(points, outward)
        on_ray = on_rays(rig, camera, pixels, points)
        offset = matches - ideal_pixels(rig.cameras[other], on_ray)[0]
        matches, good = pair.align(on_ray, normals, offset, min_score=0.8)
    points = _pair_points(rig, camera, other, pixels[good], matches[good])[0]
    return Landmarks(camera, other, pixels[good], matches[good], points, normals[good])


def best_landmarks(
    lenses: Lenses,
    pyramids: dict[int, Pyramid],
    masks: dict[int, ImageMask],
    counts: dict[int, int],
    seeds_between: Callable[[int, int], Seeds | None],
) -> list[Landmarks]:
    """The landmarks of each reference camera, with the partner in which most of its corners are matched.

    counts: corners by camera, in ascending order of cameras; one with none is no reference.
    """
    best: dict[int, Landmarks] = {}
    for a, b in combinations(counts, 2):
        seeds = seeds_between(a, b)
        for c in (a, b):
            if seeds is None or counts[c] <= 0:
                continue
            part = find_landmarks(lenses, pyramids, masks[c], seeds, c, counts[c])
            if part is not None and (c not in best or len(part.points) > len(best[c].points)):
                best[c] = part
    return [best[c] for c in sorted(best)]


@dataclass(frozen=True, slots=True, eq=False)
class _CameraPair:
    """Images (by camera) of a reference camera, and of another one in which its patches are aligned."""

    lenses: Lenses
    pyramids: dict[int, Pyramid]
    camera: int
    other: int

    def _cut(self, points: Array, normals: Array) -> tuple[Templates, Projection]:
        """The patches of points (N, 3), base frame, and their projection into the other camera."""
        templates = cut_templates(self.lenses, self.pyramids[self.camera], self.camera, np.eye(4), points, normals)
        return templates, project_squares(self.lenses, self.other, np.eye(4), points, normals, templates.axes)

    def align(self, points: Array, normals: Array, offset: Array, min_score: float) -> tuple[Array, NDArray[np.bool_]]:
        """Ideal pixels (N, 2) in the other camera of the patches of points (N, 3), base frame; and which fit (N,)."""
        templates, where = self._cut(points, normals)
        start = where.centre + offset
        result = align(templates, self.pyramids[self.other], where, start, min_score)
        near = np.linalg.norm(result.pixels - start, axis=1) < 10
        good = result.found & near & (templates.contrast > MIN_PATCH_CONTRAST)
        return undistort(self.lenses.rig.cameras[self.other], result.pixels), good

    def sweep(
        self, pixels: Array, normals: Array, offset: Array, seeds: Seeds, steps: int = 48
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Points (N, 3), base frame, on the rays of pixels (N, 2) at the depth where the patch fits best, and whether
        one depth stands out (N,). Depths: the seeds' own range and a fifth more, even in inverse depth."""
        rig = self.lenses.rig
        origins, directions = rays(rig, np.full(len(pixels), self.camera), pixels)
        reach = np.linalg.norm(seeds.points - rig.cameras[self.camera].base_from_camera[:3, 3], axis=1)
        inverse = np.linspace(1 / (reach.max() * 1.2), 1 / (reach.min() * 0.8), steps)
        scores = np.full((len(pixels), steps), -1.0)
        for k, value in enumerate(inverse):
            templates, where = self._cut(origins + directions / value, normals)
            score = coarse_score(templates, self.pyramids[self.other], where, where.centre + offset)
            scores[:, k] = np.where(where.visible, score, -1.0)
        best = scores.argmax(1)
        neighbour = np.abs(np.arange(steps) - best[:, None]) <= 3
        rival = np.where(neighbour, -1.0, scores).max(1)
        peak = scores[np.arange(len(pixels)), best]
        return origins + directions / inverse[best][:, None], (peak > 0.7) & (rival < peak - 0.1)


def on_rays(rig: Rig, camera: int, pixels: Array, points: Array) -> Array:
    """The spots (N, 3) on the pixels' rays nearest to points: a landmark lies exactly on its camera's ray."""
    origins, directions = rays(rig, np.full(len(pixels), camera), pixels)
    return np.asarray(origins + np.einsum("ni,ni->n", points - origins, directions)[:, None] * directions)


def _affine_consistent(pixels: Array, residual: Array) -> NDArray[np.bool_]:
    """Whether each residual (N, 2) fits an affine field over the image, as by a common exposure offset."""
    design = np.c_[np.ones(len(pixels)), (pixels - pixels.mean(0)) / np.maximum(pixels.std(0), 1.0)]
    keep = np.ones(len(pixels), bool)
    for _ in range(4):
        model = np.linalg.lstsq(design[keep], residual[keep], rcond=None)[0]
        deviation = np.linalg.norm(residual - design @ model, axis=1)
        keep = deviation < max(3 * 1.48 * np.median(deviation[keep]), 0.6)
        if keep.sum() < 6:
            return np.zeros(len(pixels), bool)
    return keep


def build_first_map(
    lenses: Lenses, pyramids: dict[int, Pyramid], polygons: dict[int, Array], heads: dict[int, ImageMask] | None = None
) -> FirstMap | str:
    """The map of what lies inside the polygons at this instant, or the reason why there is none.

    pyramids: by camera, the images. polygons: by camera, (N, 2) px as imaged; at least two cameras. heads: by camera,
    the print head's masks.
    """
    rig, rng = lenses.rig, np.random.default_rng(0)
    cameras = sorted(set(pyramids) & set(polygons))
    if len(cameras) < 2:
        return "the surface must be seen by two cameras to be mapped"
    regions = {c: polygon_mask(rig.cameras[c].size, polygons[c]) for c in cameras}
    masks = {c: trackable(pyramids[c][0], regions[c], (heads or {}).get(c)) for c in cameras}
    features = {c: sift(pyramids[c][0], masks[c], 1000, tilted=True) for c in cameras}
    counts = dict.fromkeys(cameras, TARGET_LANDMARKS // len(cameras))
    parts = best_landmarks(lenses, pyramids, masks, counts, lambda a, b: find_seeds(lenses, a, b, features, rng))
    if sum(len(p.points) for p in parts) < MIN_LANDMARKS:
        return FEW_SPOTS
    points = np.concatenate([p.points for p in parts])
    centre = np.mean([rig.cameras[p.camera].base_from_camera[:3, 3] for p in parts], axis=0)
    frame = surface_frame(points, centre, rig.cameras[parts[0].camera].base_from_camera[:3, 0])
    return assemble(lenses, pyramids, parts, frame)


def assemble(
    lenses: Lenses, pyramids: dict[int, Pyramid], parts: list[Landmarks], base_from_surface: Array
) -> FirstMap:
    """Landmarks of several cameras as one map in the frame `base_from_surface` (4, 4), and their reference pictures."""
    rig = lenses.rig
    points_base = np.concatenate([p.points for p in parts])
    surface_from_base = se3.inverse(base_from_surface)
    points = se3.transform_points(surface_from_base, points_base)
    outward = np.mean([rig.cameras[p.camera].base_from_camera[:3, 3] for p in parts], axis=0) - points_base.mean(0)
    normals = smooth_normals(points, surface_from_base[:3, :3] @ outward)
    pictures, blocks = list[Templates](), list[Array]()
    for p, (i, j) in zip(parts, pairwise(np.cumsum([0, *(len(p.points) for p in parts)])), strict=True):
        images = pyramids[p.camera]
        pictures.append(cut_templates(lenses, images, p.camera, base_from_surface, points[i:j], normals[i:j]))
        covariances = _pair_points(rig, p.camera, p.other, p.pixels, p.pixels_other)[1]
        blocks.extend(surface_from_base[:3, :3] @ covariances @ surface_from_base[:3, :3].T * 0.2**2)
    templates, covariance = join(pictures), block_diag(*blocks)
    good = templates.contrast > MIN_PATCH_CONTRAST
    rows = np.repeat(good, 3)
    surface_map = SurfaceMap(points[good], normals[good], covariance[np.ix_(rows, rows)])
    return FirstMap(base_from_surface, surface_map, templates.take(good))
