"""New landmarks where the surface has come into view and the map knows little of it.

Found as the first map was, between two cameras, begun at the landmarks that both see, or where only one camera sees the
surface on its rays; kept on probation until a later frame set has shown that they move with the surface. A drape beside
a wound looks as good, but stays where it is.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.depth import looked_at
from estimation.mapping.bundle_adjustment import of_frame
from estimation.mapping.refiner import LEAST_SIGMA
from estimation.observations import Observations
from estimation.online.pose_solver import project
from estimation.rig import Rig, ideal_pixels
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap, joined_map
from estimation.warp import Warp
from perception.alone import find_alone
from perception.features import Mask, sift
from perception.frames import Image
from perception.lens import Lenses
from perception.mapping.first_map import Landmarks, Seeds, assemble, find_landmarks, find_seeds
from perception.mapping.scan_map import as_at_one_instant
from perception.matching.masks import trackable
from perception.matching.matcher import Matcher
from perception.matching.patches import Pyramid, Templates, join, pyramid

WANTED = 120  # landmarks that a camera should see at least
SHARE = 0.7  # of it, and of what the camera saw at first, below which more are looked for
BEYOND = 0.35  # of the known part's size in an image: how far beyond it new ones are sought
LEAST = 8  # new landmarks: fewer are not worth a change of the map
FEATURES = 300  # a camera, for the first matches on what nobody knows yet
AGREES = 2.0  # px between a new landmark and where the surface's motion puts it
TELLS = 4.0  # px by which the surface's motion must have moved it: then what stands still is told apart
AMID = 0.04  # of the distance to the cameras: what lies so near to known landmarks,
LEVEL = 0.004  # and so near to their surface, is part of it without such proof
GIVEN_UP = 4  # looks in which a new landmark was in view and not found


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One frame set in which the surface is known: where it stood, jointly and at each camera's own instant, and what
    agreed. images: grey, by camera. single: (4, 4) by camera. seen: the inliers. wanted: landmarks, by camera. heads:
    the print head's masks, by camera. warp: of the surface there and then."""

    images: dict[int, Image]
    base_from_surface: Array
    single: dict[int, Array]
    covariance: Array
    seen: Observations
    wanted: dict[int, int]
    heads: dict[int, Mask]
    warp: Warp | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """New landmarks, and the features (N, 2) px and (N, 128) of the part that they are in, by camera.

    level: (N,) mm, how well each is known to lie level with its neighbours, where it has its place from them; inf where
    two cameras see it.
    """

    look: Look
    map: SurfaceMap
    templates: Templates
    level: Array
    features: dict[int, tuple[Array, NDArray[np.float32]]]


def look_for_more(rig: Rig, look: Look, surface_map: SurfaceMap) -> Found | None:
    """Landmarks beside those seen, by two cameras or, where one alone sees the surface, on it; None if hardly any."""
    if look.warp is not None:  # as it is now
        surface_map = replace(surface_map, points=look.warp.apply(surface_map.points))
    lenses = Lenses(as_at_one_instant(rig, look.base_from_surface, look.single))
    pyramids = {c: pyramid(image) for c, image in look.images.items()}
    lacking = {c: look.wanted[c] - int((look.seen.camera == c).sum()) for c in sorted(pyramids)}
    masks = {c: trackable(pyramids[c][0], _unknown(lenses, c, look, surface_map), look.heads.get(c)) for c in lacking}
    features = {c: sift(pyramids[c][0], masks[c], FEATURES, tilted=True) for c in lacking}
    best: dict[int, Landmarks] = {}
    cameras = sorted(lacking)
    for i, a in enumerate(cameras):
        for b in cameras[i + 1 :]:
            seeds = _seeds(lenses, a, b, look, surface_map, features)
            for c in (a, b):
                if seeds is None or lacking[c] < LEAST:
                    continue
                part = find_landmarks(lenses, pyramids, masks[c], seeds, c, lacking[c])
                if part is not None and (c not in best or len(part.points) > len(best[c].points)):
                    best[c] = part
    parts = [best[c] for c in sorted(best)]
    found: list[tuple[SurfaceMap, Templates, Array]] = []
    if sum(len(p.points) for p in parts) >= LEAST:
        grown = assemble(lenses, pyramids, parts, look.base_from_surface)
        found.append((grown.map, grown.templates, np.full(len(grown.map), np.inf)))
    found += _alone(lenses, pyramids, look, surface_map, masks, lacking, parts)
    if sum(len(part) for part, _, _ in found) < LEAST:
        return None
    whole = reduce(joined_map, [part for part, _, _ in found])
    joint = whole.covariance + of_frame(whole.points, look.covariance)  # all share the pose they hang on
    templates, level = join([t for _, t, _ in found]), np.concatenate([sigma for _, _, sigma in found])
    points = whole.points if look.warp is None else look.warp.undo(whole.points)
    return Found(look, SurfaceMap(points, whole.normals, joint), templates, level, features)


def _alone(
    lenses: Lenses,
    pyramids: dict[int, Pyramid],
    look: Look,
    surface_map: SurfaceMap,
    masks: dict[int, Mask],
    lacking: dict[int, int],
    parts: list[Landmarks],
) -> list[tuple[SurfaceMap, Templates, Array]]:
    """Landmarks that one camera alone sees, each with its templates and how level it is, camera by camera."""
    sighted = [c for c in sorted(pyramids) if (look.seen.camera == c).sum() >= LEAST]
    matched = np.concatenate([np.zeros((0, 3)), *[p.points for p in parts]])
    found = []
    for c in sighted:
        rig, others = lenses.rig, [o for o in sighted if o != c]
        taken, _ = lenses.image(c, *ideal_pixels(rig.cameras[c], matched))
        inside = ((taken > 0) & (taken < rig.cameras[c].size)).all(1)
        more = lacking[c] - int(inside.sum())
        if more >= LEAST:
            place = look.base_from_surface
            part = find_alone(lenses, pyramids, c, others, masks[c], taken[inside], more, surface_map, place)
            if part is not None:
                found.append((part.map, part.templates, part.sigma))
    return found


def _unknown(lenses: Lenses, camera: int, look: Look, surface_map: SurfaceMap) -> Mask:
    """Where in an image the surface may go on without landmarks: around and between those seen."""
    size = lenses.rig.cameras[camera].size
    mask = np.zeros((size[1], size[0]), np.uint8)
    mine = look.seen.camera == camera
    if mine.sum() < 6:
        return mask
    imaged, _ = lenses.image(camera, look.seen.pixels[mine], np.full(int(mine.sum()), 1e3))
    spots = np.round(imaged).astype(np.int32)
    cv2.fillConvexPoly(mask, cv2.convexHull(spots), 255)
    across = float(np.sqrt(cv2.countNonZero(mask)))
    reach = 2 * int(BEYOND * across) + 1
    mask = np.asarray(cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))), np.uint8)
    for spot in spots:
        cv2.circle(mask, spot.tolist(), max(6, int(0.6 * across / np.sqrt(WANTED))), 0, -1)
    return mask


def _seeds(
    lenses: Lenses,
    a: int,
    b: int,
    look: Look,
    surface_map: SurfaceMap,
    features: dict[int, tuple[Array, NDArray[np.float32]]],
) -> Seeds | None:
    """What is known of the surface between two cameras: landmarks that both see, and matches in the unknown part."""
    fresh = find_seeds(lenses, a, b, features, np.random.default_rng(0))
    in_a, in_b = look.seen.camera == a, look.seen.camera == b
    rows, at_a, at_b = np.intersect1d(look.seen.track[in_a], look.seen.track[in_b], return_indices=True)
    known = Seeds(
        a,
        b,
        look.seen.pixels[in_a][at_a],
        look.seen.pixels[in_b][at_b],
        se3.transform_points(look.base_from_surface, surface_map.points[rows]),
    )
    if fresh is None:
        return known if len(rows) >= 6 else None
    return Seeds(
        a,
        b,
        np.concatenate([known.pixels_a, fresh.pixels_a]),
        np.concatenate([known.pixels_b, fresh.pixels_b]),
        np.concatenate([known.points, fresh.points]),
    )


@dataclass(slots=True, eq=False)
class Probation:
    """New landmarks that wait for proof. moved, missed: (N,) looks in which each was found where the surface's motion
    puts it, far from where it would be at rest; and in which it was not found. map: of them, as known by now."""

    found: Found
    amid: NDArray[np.bool_]
    map: SurfaceMap = field(init=False)
    moved: NDArray[np.int64] = field(init=False)
    stayed: NDArray[np.int64] = field(init=False)
    missed: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.map = self.found.map
        self.moved, self.stayed, self.missed = np.zeros((3, len(self.map)), np.int64)

    def look(
        self,
        lenses: Lenses,
        stamp: float,
        pyramids: dict[int, Pyramid],
        single: dict[int, Array],
        covariance: Array | None = None,
    ) -> None:
        """Look for them again at each camera's own pose of the surface, known to a covariance (6, 6).

        What one camera alone sees is known better by it: where the surface has turned, its depth.
        """
        matcher = Matcher(lenses, self.map, self.found.templates)
        seen = matcher.align(stamp, pyramids, single)
        where, rest = np.zeros((2, len(seen), 2))
        jacobians = np.zeros((len(seen), 2, 6))
        for c in np.unique(seen.camera):
            mine = seen.camera == c
            points = self.map.points[seen.track[mine]]
            before = self.found.look.single.get(int(c), self.found.look.base_from_surface)
            where[mine], _, jacobians[mine] = project(lenses.rig, seen.camera[mine], single[int(c)], points)
            rest[mine] = project(lenses.rig, seen.camera[mine], before, points)[0]
        good = np.linalg.norm(seen.pixels - where, axis=1) < AGREES
        lone = good & np.isfinite(self.found.level[seen.track])
        if covariance is not None and lone.any():
            sigma = np.maximum(seen.sigma[lone], LEAST_SIGMA)
            away = where[lone] - seen.pixels[lone]
            self.map, good[lone] = looked_at(self.map, seen.track[lone], away, jacobians[lone], sigma, covariance)
        told = np.linalg.norm(rest - where, axis=1) > TELLS
        np.add.at(self.moved, seen.track[good & told], 1)
        np.add.at(self.stayed, seen.track[good & ~told], 1)
        lacking = np.setdiff1d(np.arange(len(self.missed)), seen.track[good])
        self.missed[lacking] += 1

    @property
    def level(self) -> Array:
        """How well (N,) mm each is known across the surface that tells its place; inf where two cameras see it."""
        count, normals = len(self.map), self.map.normals
        blocks = np.einsum("ninj->nij", self.map.covariance.reshape(count, 3, count, 3))
        now = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", normals, blocks, normals), 0.0))
        return np.where(np.isfinite(self.found.level), now, np.inf)

    @property
    def proven(self) -> NDArray[np.bool_]:
        """Which (N,) belong to the surface."""
        enough = (self.moved >= 1) | (self.amid & (self.stayed >= 1))
        return np.asarray(enough & (self.moved + self.stayed > self.missed))

    @property
    def over(self) -> bool:
        """Whether no more is to be learned of them by waiting."""
        return bool((self.proven | (self.missed >= GIVEN_UP)).all())


def amid(found: Found, surface_map: SurfaceMap, distance: float) -> NDArray[np.bool_]:
    """Which new landmarks (N,) lie between known ones and on their surface. distance: mm to the cameras.

    None that was put there, since one camera alone sees it.
    """
    away = found.map.points[:, None] - surface_map.points
    gap = np.linalg.norm(away, axis=2)
    near = np.argsort(gap, axis=1)[:, :4]
    rows = np.arange(len(near))[:, None]
    height = np.abs(np.einsum("nki,nki->nk", away[rows, near], surface_map.normals[near])).min(1)
    there = (gap[rows, near].max(1) < AMID * distance) & (height < LEVEL * distance)
    return np.asarray(there & ~np.isfinite(found.level))
