"""Corners to start tracks, SIFT features, their matches, relocalisation by them, and a hint at calibration errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.mapping.triangulation import epipolar_distance, rays
from estimation.pose_solver import PointTracks, project, solve_pose
from estimation.rig import Rig, ideal_pixels
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.frames import Image
from perception.lens import Lenses, undistort
from perception.mapping.patches import Pyramid

ImageMask = NDArray[np.uint8]
Features = tuple[Array, NDArray[np.float32]]  # (N, 2) px and descriptors (N, 128)
SIFT_OFFSET_PX = 0.25  # cv2's SIFT doubles the image and does not correct the half-pixel shift (measured: 0.26)
MAX_BRUTE_FORCE_DISTANCES = 12_000_000  # above which FLANN's trees are quicker
SAME_SPOT_PX = 2.0  # px: features closer than this show one spot
FLANN_KD_TREE = 1  # OpenCV's number for that index
MAX_FEATURES = 5000  # strongest first: matching two images then takes 0.15 s and 100 MB


def grey(image: Image) -> Image:
    """The image as one grey channel (H, W)."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def polygon_mask(size: tuple[int, int], polygon: Array) -> ImageMask:
    """Mask (H, W), 255 inside a polygon (N, 2) px that may leave the image. size: (W, H)."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    cv2.fillPoly(mask, [np.round(np.clip(polygon, -30000, 30000)).astype(np.int32)], 255)
    return mask


def bounding_box(points: Array, size: tuple[int, int], margin: float) -> tuple[int, int, int, int]:
    """x0, y0, x1, y1 px of the points' box (N, 2) plus a margin, clipped to the image; never empty."""
    low = np.floor(points.min(0) - margin).astype(int)
    high = np.ceil(points.max(0) + margin).astype(int) + 1
    x0, y0 = np.clip(low, 0, np.array(size) - 8)
    x1, y1 = np.clip(high, (x0 + 8, y0 + 8), size)
    return int(x0), int(y0), int(x1), int(y1)


def corners(image: Image, mask: ImageMask, count: int, border: int = 16) -> Array:
    """Up to `count` Shi-Tomasi corners (N, 2) px, spread over the mask, best first, refined to sub-pixel."""
    inner = mask.copy()
    inner[:border], inner[-border:], inner[:, :border], inner[:, -border:] = 0, 0, 0, 0
    area = cv2.countNonZero(inner)
    if area == 0:
        return np.zeros((0, 2))
    spread = max(4.0, 0.55 * np.sqrt(area / count))
    places = cv2.goodFeaturesToTrack(image, count, 0.005, spread, mask=inner, blockSize=7)
    return np.zeros((0, 2)) if places is None else np.asarray(places, np.float64).reshape(-1, 2)


def sift(image: Image, mask: ImageMask | None = None, count: int = 1500, tilted: bool = False) -> Features:
    """SIFT keypoints (N, 2) px and descriptors (N, 128) inside a mask.

    tilted: also as the image would look from the side (affine SIFT, Morel and Yu 2009): 0.1 s and ten times the
    features, but cameras that stand 60 degrees apart then share hundreds of matches instead of ten.
    """
    x0, y0, x1, y1 = 0, 0, image.shape[1], image.shape[0]
    if mask is not None:
        if cv2.countNonZero(mask) == 0:
            return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        x, y, w, h = cv2.boundingRect(mask)
        x0, y0, x1, y1 = max(x - 16, 0), max(y - 16, 0), min(x + w + 16, x1), min(y + h + 16, y1)
        mask = np.ascontiguousarray(mask[y0:y1, x0:x1])
    detector: cv2.Feature2D = cv2.SIFT.create(nfeatures=count, contrastThreshold=0.02)
    if tilted:
        detector = cv2.AffineFeature.create(detector, maxTilt=3)
    keypoints, descriptors = detector.detectAndCompute(np.ascontiguousarray(image[y0:y1, x0:x1]), mask)
    if not keypoints:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    best = np.argsort([-k.response for k in keypoints], kind="stable")[:MAX_FEATURES]
    pixels = np.array([k.pt for k in keypoints]) + (x0 - SIFT_OFFSET_PX, y0 - SIFT_OFFSET_PX)
    return pixels[best], np.asarray(descriptors, np.float32)[best]


def match(a: NDArray[np.float32], b: NDArray[np.float32], ratio: float = 0.8) -> NDArray[np.int64]:
    """Pairs (M, 2) of rows of a and b that choose each other and pass Lowe's ratio test (thesis 4.4: 0.8).

    Up to MAX_BRUTE_FORCE_DISTANCES all distances are compared (numpy is four times faster than OpenCV's brute force);
    beyond, FLANN's trees, which miss one pair in 500 and are deterministic.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    nearest = _by_trees if len(a) * len(b) > MAX_BRUTE_FORCE_DISTANCES else _by_all_distances
    first, second, best, back = nearest(a, b)
    rows = np.arange(len(a))
    good = (first < ratio**2 * second) & (back[best] == rows)
    return np.stack([rows[good], best[good]], -1).astype(np.int64)


def matched_spots(a: Features, b: Features) -> tuple[Array, Array]:
    """Pixels (N, 2) of each of two images, as imaged, whose features match."""
    pairs = match(a[1], b[1], 0.85)
    both = np.concatenate([a[0][pairs[:, 0]], b[0][pairs[:, 1]]], 1)
    _, first = np.unique(np.round(both / SAME_SPOT_PX), axis=0, return_index=True)  # tilts may repeat a spot
    return both[first, :2], both[first, 2:]


NearestRows = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]


def _by_all_distances(a: NDArray[np.float32], b: NDArray[np.float32]) -> NearestRows:
    """Squared distances (N,) of a to the nearest and next row of b, which row is nearest, and the same back (M,)."""
    distance = np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * (a @ b.T), 0.0)
    best, back = np.argmin(distance, axis=1), np.argmin(distance, axis=0)
    rows = np.arange(len(a))
    first = distance[rows, best]
    distance[rows, best] = np.inf
    return first, distance.min(axis=1), best, back


def _by_trees(a: NDArray[np.float32], b: NDArray[np.float32]) -> NearestRows:
    """As `_by_all_distances`, nearly always."""
    cv2.setRNGSeed(0)  # of this thread; the trees are random
    trees: dict[str, bool | int | float | str] = {"algorithm": FLANN_KD_TREE, "trees": 4}
    checks: dict[str, bool | int | float | str] = {"checks": 32}
    rows, distances = cv2.flann.Index(b, trees).knnSearch(a, 2, params=checks)
    back = cv2.flann.Index(a, trees).knnSearch(b, 1, params=checks)[0][:, 0]
    nearest = np.asarray(distances, np.float32)
    return nearest[:, 0], nearest[:, 1], np.asarray(rows[:, 0], np.int64), np.asarray(back, np.int64)


MAX_DESCRIPTORS = 6000  # descriptors: matching 600 features against them takes 30 ms
MIN_MATCHES = 8


@dataclass(frozen=True, slots=True, eq=False)
class RelocalisedPose:
    """The pose of the surface by relocalisation."""

    base_from_surface: Array  # (4, 4), of all cameras together
    single: dict[int, Array]  # (4, 4) by camera, its own: cameras are seldom exposed together
    matches: int  # inliers


@dataclass(frozen=True, slots=True, eq=False)
class CameraMatches:
    """The features of one camera that match learned ones."""

    camera: int
    points: Array  # (N, 3) mm, surface frame
    pixels: Array  # (N, 2) px, ideal
    own_pose: Array | None  # (4, 4) base_from_surface by this camera only


class Relocaliser:
    """Descriptors of the surface; gives its pose in new images."""

    def __init__(self, lenses: Lenses) -> None:
        self.lenses = lenses
        self.descriptors = np.zeros((0, 128), np.float32)  # (N, 128) of the features kept
        self._points = np.zeros((0, 3))
        self._view = np.zeros(0, np.int64)  # (N,) which view each is from

    def learn(self, camera: int, image: Image, base_from_surface: Array, surface_map: SurfaceMap) -> None:
        """Add the features of one image with known pose of the surface, placed on the landmarks' surface."""
        lens = self.lenses.rig.cameras[camera]
        _, imaged, visible = self._landmark_pixels(camera, base_from_surface, surface_map)
        if visible.sum() < 8:
            return
        mask = np.zeros((lens.size[1], lens.size[0]), np.uint8)
        hull = cv2.convexHull(imaged[visible].astype(np.float32)).reshape(-1, 2)
        cv2.fillConvexPoly(mask, np.round(hull).astype(np.int32), 255)
        mask = np.asarray(cv2.dilate(mask, np.ones((9, 9), np.uint8)), np.uint8)
        self.add(camera, sift(image, mask, 500, tilted=True), base_from_surface, surface_map)

    def add(self, camera: int, features: Features, base_from_surface: Array, surface_map: SurfaceMap) -> None:
        """Add the features of one image, px as imaged, best first, with known pose of the surface.

        Of MAX_DESCRIPTORS each view keeps an equal share, its best, so that new views do not replace old ones.
        """
        ideal, _, visible = self._landmark_pixels(camera, base_from_surface, surface_map)
        keypoints, descriptors = features
        if not len(keypoints) or visible.sum() < 8:
            return
        pixels = undistort(self.lenses.rig.cameras[camera], keypoints)
        points = self._on_surface(camera, pixels, base_from_surface, surface_map, ideal, visible)
        near = np.isfinite(points).all(1)
        view = np.full(int(near.sum()), self._view.max(initial=-1) + 1)
        self._points = np.concatenate([self._points, points[near]])
        self.descriptors = np.concatenate([self.descriptors, descriptors[near]])
        self._view = np.concatenate([self._view, view])
        self._make_room()

    def _landmark_pixels(
        self, camera: int, base_from_surface: Array, surface_map: SurfaceMap
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Ideal and imaged pixels (N, 2) of the landmarks, and which are in the image (N,)."""
        lens = self.lenses.rig.cameras[camera]
        ideal, depth = ideal_pixels(lens, se3.transform_points(base_from_surface, surface_map.points))
        imaged, visible = self.lenses.image(camera, ideal, depth)
        return ideal, imaged, visible & ((imaged >= 0) & (imaged < lens.size)).all(1)

    def _make_room(self) -> None:
        counts = np.bincount(self._view)
        limit = int(counts.max(initial=0))
        while np.minimum(counts, limit).sum() > MAX_DESCRIPTORS:
            limit -= 1 + limit // 100
        rank = np.concatenate([np.arange(n) for n in counts]) if len(counts) else np.zeros(0, int)
        keep = rank < limit
        self._points, self.descriptors, self._view = self._points[keep], self.descriptors[keep], self._view[keep]

    def reframe(self, new_from_old: Array) -> None:
        """Change the surface frame: new_from_old (4, 4)."""
        self._points = se3.transform_points(new_from_old, self._points)

    def _on_surface(
        self,
        camera: int,
        pixels: Array,
        base_from_surface: Array,
        surface_map: SurfaceMap,
        landmark_pixels: Array,
        visible: NDArray[np.bool_],
    ) -> Array:
        """Points (N, 3), surface frame, where rays meet the mean plane of the six nearest landmarks; nan if steep."""
        index = np.nonzero(visible)[0]
        gap = ((pixels[:, None] - landmark_pixels[index]) ** 2).sum(2)
        near = index[np.argsort(gap, axis=1)[:, :6]]
        normal = surface_map.normals[near].mean(1)
        anchor = surface_map.points[near].mean(1)
        origins, directions = rays(self.lenses.rig, np.full(len(pixels), camera), pixels)
        surface_from_base = se3.inverse(base_from_surface)
        origins = se3.transform_points(surface_from_base, origins)
        directions = directions @ surface_from_base[:3, :3].T
        slope = np.einsum("ni,ni->n", directions, normal)
        steep = np.abs(slope) < 0.1
        reach = np.einsum("ni,ni->n", anchor - origins, normal) / np.where(steep, 1.0, slope)
        return np.asarray(np.where(steep[:, None], np.nan, origins + reach[:, None] * directions))

    def find(self, pyramids: dict[int, Pyramid], half: bool = True) -> RelocalisedPose | None:
        """The pose of the surface in images (by camera), searched everywhere, or None.

        half: in the half-size images, a quarter of the time (50 ms a camera); a far surface needs the whole size.
        """
        if len(self._points) < MIN_MATCHES:
            return None
        views = [self._match_view(c, images, half) for c, images in pyramids.items()]
        return self._joint_pose([view for view in views if view is not None])

    def _match_view(self, camera: int, images: Pyramid, half: bool) -> CameraMatches | None:
        lens = self.lenses.rig.cameras[camera]
        keypoints, descriptors = sift(images[1] if half else images[0], count=600 if half else 1500)
        if half:
            keypoints = 2 * keypoints
        pairs = match(descriptors, self.descriptors, 0.85)
        if len(pairs) < MIN_MATCHES:
            return None
        points, pixels = self._points[pairs[:, 1]], undistort(lens, keypoints[pairs[:, 0]])
        pose = _pnp(points, pixels, lens.matrix)
        return CameraMatches(camera, points, pixels, None if pose is None else lens.base_from_camera @ pose)

    def _joint_pose(self, views: list[CameraMatches]) -> RelocalisedPose | None:
        """The pose with most inliers, of those fitted from each camera's own; None with too few."""
        single = {view.camera: view.own_pose for view in views if view.own_pose is not None}
        if not single:
            return None
        rig = self.lenses.rig
        camera = np.concatenate([np.full(len(view.points), view.camera) for view in views])
        points = np.concatenate([view.points for view in views])
        pixels = np.concatenate([view.pixels for view in views])
        sigma = np.full(len(camera), 3.0)  # px: half-size images, cameras not exposed together
        tracks = PointTracks(camera, points, pixels, sigma)
        best, best_count = np.eye(4), MIN_MATCHES - 1
        for start in single.values():
            pose = solve_pose(rig, tracks, start, scales=(4.0, 2.0)).base_from_surface
            residual = np.linalg.norm(project(rig, camera, pose, points)[0] - pixels, axis=1)
            count = int((residual < 4 * sigma).sum())
            if count > best_count:
                best, best_count = pose, count
        if best_count < MIN_MATCHES:
            return None
        return RelocalisedPose(best, {c: pose for c, pose in single.items() if _same_surface(pose, best)}, best_count)


def _same_surface(a: Array, b: Array) -> bool:
    """Whether two poses could be one surface at two cameras' instants, given one camera's depth error."""
    difference = se3.inverse(a) @ b
    return bool(se3.angle_of(difference) < 0.35 and np.linalg.norm(difference[:3, 3]) < 60.0)


def _pnp(points: Array, pixels: Array, matrix: Array) -> Array | None:
    """camera_from_surface (4, 4) by RANSAC over points (N, 3) and ideal pixels (N, 2), or None; fixed seed."""
    try:
        ok, rotation, translation, inliers = cv2.solvePnPRansac(
            points, pixels, matrix, None, iterationsCount=400, reprojectionError=6.0, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:  # SQPNP asserts where points coincide or lie on a line, in whatever sample RANSAC draws
        return None
    if not ok or inliers is None or len(inliers) < MIN_MATCHES:
        return None
    return se3.make(cv2.Rodrigues(rotation)[0], np.asarray(translation).ravel())


HINT_FEATURES = 400  # SIFT features of a picture, before they are tilted
MAX_HINT_DISTANCE_PX = 3.0  # px from the epipolar line, of an inlier: only the right guess has many
MIN_HINT_SHARE = 0.5  # inliers of a guess among its matches (0.1 by chance),
MIN_HINT_MATCHES = 60  # and their number: unlike pictures have up to 65 matches, and few inliers
HINT_RATIO = 2.0  # and ratio of their number to that without a change
MIN_CONTRADICTING_MATCHES = 100  # about twice those of unlike pictures: more show the same spots,
CONTRADICTION_PX = 40.0  # and contradict the calibration so far from the epipolar line: no surface moves so far


@dataclass(frozen=True, slots=True)
class _Arrangement:
    """A guess at how the pictures belong to the rig's cameras."""

    text: str
    cameras: frozenset[int]  # that it concerns
    mirrored: frozenset[int] = frozenset()
    turned: frozenset[int] = frozenset()  # by half a turn
    exchanged: tuple[int, ...] = ()  # two cameras

    def camera(self, picture: int) -> int:
        """The camera that a picture is of."""
        return sum(self.exchanged) - picture if picture in self.exchanged else picture


def _arrangements(names: Sequence[str], suspects: frozenset[int]) -> list[_Arrangement]:
    """Guesses: each suspect alone or all of them mirrored or turned, and any two exchanged."""
    arrangements = []
    for group in [frozenset([c]) for c in sorted(suspects)] + [suspects] * (len(suspects) > 1):
        text = f"{names[min(group)]} looks" if len(group) == 1 else "all cameras look"
        arrangements.append(_Arrangement(f"{text} mirrored", group, mirrored=group))
        arrangements.append(_Arrangement(f"{text} upside down", group, turned=group))
    for a, b in combinations(sorted(suspects), 2):
        text = f"{names[a]} and {names[b]} look exchanged"
        arrangements.append(_Arrangement(text, frozenset([a, b]), exchanged=(a, b)))
    return arrangements


def calibration_hint(
    rig: Rig, images: dict[int, Image], polygons: dict[int, Array], suspects: frozenset[int]
) -> tuple[frozenset[int], str]:
    """Suspects whose pictures look mirrored, turned or exchanged, and a text; empty without evidence.

    images: by camera, as imaged. polygons: by camera, (N, 2) px, around the surface.
    """
    cameras = sorted(set(images) & set(polygons))
    suspects = suspects & frozenset(cameras)
    masks = {c: polygon_mask(rig.cameras[c].size, polygons[c]) for c in cameras}
    plain = {c: sift(images[c], masks[c], HINT_FEATURES, tilted=True) for c in cameras}
    flipped = {
        c: sift(np.ascontiguousarray(images[c][:, ::-1]), masks[c][:, ::-1].copy(), HINT_FEATURES, tilted=True)
        for c in cameras
    }
    last = {c: np.array(rig.cameras[c].size) - 1.0 for c in cameras}
    pairs = [(a, b) for a, b in combinations(cameras, 2) if suspects & {a, b}]
    plain_matches = {(a, b): matched_spots(plain[a], plain[b]) for a, b in pairs}
    flipped_matches = {(a, b): matched_spots(plain[a], flipped[b]) for a, b in pairs}

    def distances(a: int, b: int, guess: _Arrangement) -> Array:
        same = (a in guess.mirrored) == (b in guess.mirrored)
        spots = dict(zip((a, b), (plain_matches if same else flipped_matches)[a, b], strict=True))
        sides = {a: False, b: not same}  # whether the pixels are those of the flipped picture
        for c in (a, b):
            if sides[c] != (c in guess.mirrored):
                spots[c] = np.column_stack([last[c][0] - spots[c][:, 0], spots[c][:, 1]])
            spots[c] = last[c] - spots[c] if c in guess.turned else spots[c]
        pixels = {guess.camera(c): undistort(rig.cameras[guess.camera(c)], spots[c]) for c in (a, b)}
        first, second = guess.camera(a), guess.camera(b)
        return np.abs(epipolar_distance(rig, first, second, pixels[first], pixels[second]))

    def count_near(guess: _Arrangement) -> tuple[int, int]:
        distance = np.concatenate([distances(a, b, guess) for a, b in pairs])
        return int((distance < MAX_HINT_DISTANCE_PX).sum()), len(distance)

    if not pairs:
        return frozenset(), ""
    as_is = _Arrangement("", suspects)
    sizes = {rig.cameras[c].size for c in cameras}
    guesses = [g for g in _arrangements([c.name for c in rig.cameras], suspects) if not g.exchanged or len(sizes) == 1]
    best = max(guesses, key=count_near)
    count, total = count_near(best)
    if count >= max(MIN_HINT_MATCHES, MIN_HINT_SHARE * total, HINT_RATIO * count_near(as_is)[0]):
        return best.cameras, best.text
    errors = {c: np.concatenate([distances(a, b, as_is) for a, b in pairs if c in (a, b)]) for c in suspects}
    outliers = [c for c, e in errors.items() if len(e) >= MIN_CONTRADICTING_MATCHES and np.median(e) > CONTRADICTION_PX]
    names = ", ".join(rig.cameras[c].name for c in outliers)
    text = f"the matches of {names} contradict the calibration: calibrate again"
    return frozenset(outliers), text if outliers else ""
