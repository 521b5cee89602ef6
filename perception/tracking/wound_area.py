"""The wound's area in mm^2 with a 95 % interval, from pictures of one instant by calibrated cameras.

Two cameras or more match the skin round the wound densely, a smooth surface is fitted to it, and each camera's outline
is laid on that surface through the lens. So the area is that of the skin as it would go on over the wound, as by a
film laid over it: a deeper bed is no larger wound.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import stdtrit

from estimation import se3
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from perception.frames import Image
from perception.lens import Lenses, undistort
from perception.mapping.features import grey
from perception.mapping.first_map import build_first_map
from perception.mapping.patches import Pyramid
from perception.mapping.scan_map import FLOW_PATCH_NODES, relief_points
from perception.tracking.wound_step import SKIN_MARGIN_SHARE
from perception.wound.segmentation import WoundBand, WoundMask, box_of, polygon, region

MIN_SKIN_MARGIN_PX = 60  # px round a wound in which its skin is matched: round a small one 0.6 of it hold too few spots
RELIEF_STEP_NODES = 2  # from one matched point to the next
SKIN_SHARE = 0.7  # of the wound's mean radius, outside its outline: the skin to which the surface is fitted
MIN_SKIN_POINTS = 30  # five for each number of the surface
FIT_ROUNDS = 5  # of the fit, without what lies beyond three standard deviations
MIN_FIT_SIGMA_MM = 0.02  # no matched point is better
MAX_CENTRE_SHARE = 0.5  # of the wound's mean radius that a camera's outline may lie off the others' middle
RIG_SCALE_SIGMA = 0.005  # of lengths: a calibration board's square is as long as a ruler says, 0.5 mm in 100
NORMAL_95 = 1.96  # standard deviations of half a 95 % interval

ONE_VIEW = "only one camera shows the whole wound, two are needed"
NO_VIEW = "no camera shows the whole wound"
FEW_POINTS = "the skin round the wound could not be matched between the cameras"
OFF_SURFACE = "an outline runs beyond the surface that the cameras see"
ELSEWHERE = "the cameras' outlines lie at different places: they do not show the same wound"


@dataclass(frozen=True, slots=True, eq=False)
class WoundArea:
    """The area of one wound at one instant."""

    area: float  # mm^2, geometric mean of the cameras'
    low: float  # mm^2, 95 % interval; 0 where the network is sure of no pixel
    high: float  # mm^2
    cameras: tuple[int, ...]  # numbers of those whose outlines count
    each: Array  # (K,) mm^2 by those cameras
    outline: tuple[float, float]  # half interval of the logarithm down and up, of the outlines alone
    disagreement: float  # of the logarithm, half interval: cameras against each other
    geometry: float  # of the logarithm, half interval: matching and the rig's scale


@dataclass(frozen=True, slots=True, eq=False)
class SkinSurface:
    """z = c0 + c1 x + c2 y + c3 x^2 + c4 x y + c5 y^2, mm, in a frame that touches the skin."""

    base_from_skin: Array  # (4, 4) mm, z out of the skin
    coefficients: Array  # (6,)
    covariance: Array  # (6, 6) of these, by the scatter of the matched points

    def points(self, camera: Camera, pixels: Array) -> Array:
        """Points (N, 3) mm, skin frame, that imaged pixels (N, 2) show; nan where a ray misses."""
        ideal = undistort(camera, pixels)
        rays = np.column_stack([ideal, np.ones(len(ideal))]) @ np.linalg.inv(camera.matrix).T
        skin_from_camera = se3.inverse(self.base_from_skin) @ camera.base_from_camera
        directions, origin = rays @ skin_from_camera[:3, :3].T, skin_from_camera[:3, 3]
        x, y, z = directions.T
        _, c1, c2, c3, c4, c5 = self.coefficients
        with np.errstate(divide="ignore", invalid="ignore"):
            # from where the ray meets z = 0 on, the nearer root of a s^2 + b s + c = 0
            start = -origin[2] / z
            near = origin + start[:, None] * directions
            a = -(c3 * x * x + c4 * x * y + c5 * y * y)
            b = z - (c1 + 2 * c3 * near[:, 0] + c4 * near[:, 1]) * x - (c2 + c4 * near[:, 0] + 2 * c5 * near[:, 1]) * y
            c = near[:, 2] - quadric(near[:, :2]) @ self.coefficients
            reach = start - 2 * c / (b + np.copysign(np.sqrt(b * b - 4 * a * c), b))
        return np.where(reach[:, None] > 0, origin + reach[:, None] * directions, np.nan)


def quadric(xy: Array) -> Array:
    """(N, 6) terms of a surface of second order at places (N, 2) mm."""
    x, y = xy.T
    return np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])


def wound_area(rig: Rig, images: Mapping[int, Image], bands: Mapping[int, WoundBand], spread: float) -> WoundArea | str:
    """The wound's area, or why there is none, in words.

    images: (H, W, 3) BGR or (H, W) grey, by camera, of one instant. bands: of the same cameras' pictures. spread: the
    network's `Settings.spread`. The interval holds half of each of these, as independent parts of the logarithm:
    - the outline: the mean of the cameras' bands times `spread`, as the cameras' errors are alike;
    - disagreement: Student's interval of the mean of the cameras' areas;
    - geometry: the surface's scatter, and RIG_SCALE_SIGMA, twice in an area.
    """
    seen = {c: band for c, band in sorted(bands.items()) if band.outline.any() and band.whole}
    if len(seen) < 2:
        return ONE_VIEW if seen else NO_VIEW
    skin = skin_surface(rig, {c: images[c] for c in seen}, {c: band.outline for c, band in seen.items()})
    if isinstance(skin, str):
        return skin
    return area_on_surface(rig, skin, seen, spread)


def area_on_surface(rig: Rig, skin: SkinSurface, bands: Mapping[int, WoundBand], spread: float) -> WoundArea | str:
    """As `wound_area`, of two whole outlines or more, laid on a surface; one that runs beyond it does not count."""
    used, rows, centres = [], [], []  # cameras; mm^2 of outline, inner and outer; (3,) mm
    for c, band in bands.items():
        box = box_of(band.outer)
        assert box is not None
        patches, middles = pixel_patches(rig.cameras[c], skin, box)
        outline, inner, outer = (m[box[1] : box[3], box[0] : box[2]] for m in (band.outline, band.inner, band.outer))
        if not np.isfinite(patches[outer]).all():
            continue
        used.append(c)
        rows.append([patches[mask].sum() for mask in (outline, inner, outer)])
        centres.append(np.average(middles[outline], axis=0, weights=patches[outline]))
    if len(used) < 2:
        return OFF_SURFACE
    areas, aside = np.array(rows), np.array(centres) - np.mean(centres, axis=0)
    with np.errstate(divide="ignore"):
        log, low, high = np.log(areas).T
    mean = float(log.mean())
    if np.linalg.norm(aside, axis=1).max() > MAX_CENTRE_SHARE * np.sqrt(np.exp(mean) / np.pi):
        return ELSEWHERE
    down, up = spread * float((log - low).mean()), spread * float((high - log).mean())
    count = len(log)
    apart = float(stdtrit(count - 1, 0.975) * log.std(ddof=1) / np.sqrt(count))
    fitted = surface_sigma(skin, rig.cameras[used[0]], bands[used[0]].outline)
    geometry = NORMAL_95 * float(np.hypot(fitted, 2 * RIG_SCALE_SIGMA))
    lower, upper = (np.sqrt(half**2 + apart**2 + geometry**2) for half in (down, up))
    low_area, high_area = float(np.exp(mean - lower)), float(np.exp(mean + upper))
    area = float(np.exp(mean))
    return WoundArea(area, low_area, high_area, tuple(used), areas[:, 0], (down, up), apart, geometry)


def pixel_patches(camera: Camera, skin: SkinSurface, box: tuple[int, int, int, int]) -> tuple[Array, Array]:
    """What each pixel (H, W) of a box shows of the surface: its area in mm^2 (H, W) and middle (H, W, 3) mm."""
    x0, y0, x1, y1 = box
    x, y = np.meshgrid(np.arange(x0, x1 + 1) - 0.5, np.arange(y0, y1 + 1) - 0.5)
    corners = skin.points(camera, np.column_stack([x.ravel(), y.ravel()])).reshape(*x.shape, 3)
    diagonals = corners[1:, 1:] - corners[:-1, :-1], corners[1:, :-1] - corners[:-1, 1:]
    areas = np.linalg.norm(np.cross(*diagonals), axis=2) / 2
    return areas, (corners[1:, 1:] + corners[:-1, :-1]) / 2


def skin_surface(rig: Rig, images: Mapping[int, Image], outlines: Mapping[int, WoundMask]) -> SkinSurface | str:
    """The skin round a wound, from pictures and outlines (H, W) of two cameras or more, or why there is none."""
    lenses, polygons = Lenses(rig), dict[int, Array]()
    for c, outline in outlines.items():
        box = box_of(outline)
        assert box is not None
        margin = max(SKIN_MARGIN_SHARE * max(box[2] - box[0], box[3] - box[1]), MIN_SKIN_MARGIN_PX)
        polygons[c] = polygon(region(box, None, rig.cameras[c].size, margin))
    greys = {c: grey(image) for c, image in images.items()}
    first = build_first_map(lenses, {c: Pyramid(image) for c, image in greys.items()}, polygons)
    if isinstance(first, str):
        return f"{FEW_POINTS} ({first})"
    matched = relief_points(lenses, greys, first, polygons, RELIEF_STEP_NODES)
    if len(matched) < MIN_SKIN_POINTS:
        return FEW_POINTS
    points = se3.transform_points(se3.inverse(first.base_from_surface), matched)
    skin = _fitted(first.base_from_surface, points)
    largest = max(outlines, key=lambda c: int(outlines[c].sum()))
    for _ in range(2):  # first of all that was matched, then of the skin round the outline alone
        rim = skin.points(rig.cameras[largest], _rim(outlines[largest]))[:, :2].astype(np.float32)
        if not np.isfinite(rim).all():
            return OFF_SURFACE
        radius = np.sqrt(cv2.contourArea(rim) / np.pi)
        outside = np.array([-cv2.pointPolygonTest(rim, (float(x), float(y)), True) for x, y in points[:, :2]])
        beside = (outside > 0) & (outside < SKIN_SHARE * radius)
        if beside.sum() < MIN_SKIN_POINTS:
            return FEW_POINTS
        skin = _fitted(first.base_from_surface, points[beside])
    return skin


def surface_sigma(skin: SkinSurface, camera: Camera, outline: WoundMask) -> float:
    """Standard deviation of the logarithm of the area of an outline (H, W), by the surface's covariance."""
    rim, slopes = _rim(outline), []
    for k, sigma in enumerate(np.sqrt(np.diag(skin.covariance))):
        step = sigma * np.eye(6)[k]
        pair = [
            cv2.contourArea(_moved(skin, side * step).points(camera, rim)[:, :2].astype(np.float32)) for side in (1, -1)
        ]
        slopes.append(np.log(pair[0] / pair[1]) / (2 * sigma) if sigma > 0 and min(pair) > 0 else 0.0)
    return float(np.sqrt(np.array(slopes) @ skin.covariance @ np.array(slopes)))


def _moved(skin: SkinSurface, step: Array) -> SkinSurface:
    return SkinSurface(skin.base_from_skin, skin.coefficients + step, skin.covariance)


def _rim(outline: WoundMask) -> Array:
    """(N, 2) px of the middles of a mask's outermost pixels, in order, of the longest outline."""
    contours, _ = cv2.findContours(outline.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return max(contours, key=len).reshape(-1, 2).astype(float)


def _fitted(base_from_skin: Array, points: Array) -> SkinSurface:
    """Least squares over points (N, 3) mm, skin frame, without outliers. Neighbours share a matched patch."""
    terms, keep = quadric(points[:, :2]), np.ones(len(points), bool)
    sigma, coefficients = 0.0, np.zeros(6)
    for _ in range(FIT_ROUNDS):
        coefficients = np.linalg.lstsq(terms[keep], points[keep, 2], rcond=None)[0]
        off = np.abs(points[:, 2] - terms @ coefficients)
        sigma = max(1.4826 * float(np.median(off[keep])), MIN_FIT_SIGMA_MM)
        keep = off < 3 * sigma
    shared = (FLOW_PATCH_NODES / RELIEF_STEP_NODES) ** 2
    covariance = sigma**2 * shared * np.linalg.pinv(terms[keep].T @ terms[keep])
    return SkinSurface(base_from_skin, coefficients, np.asarray(covariance))
