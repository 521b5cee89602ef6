"""Where the wound is in one picture and how sure that is; the region round it, its area, Dice, and overlays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import Camera
from estimation.se3 import Array
from perception.frames import Image
from perception.lens import undistort
from perception.wound.network import Network, Settings, wound_logits

# A padded row is black but for what JPEG smears over its edge; a dark room still has sensor noise in most pixels.
MAX_PADDING_GREY, MIN_LIT_SHARE = 12, 0.02
MIN_PICTURE_SHARE = 0.3  # that must be left


def picture_box(picture: NDArray[np.uint8]) -> tuple[slice, slice]:
    """Rows and columns of (H, W, 3) or (H, W) that are not padding; all of them where hardly anything would be left."""
    lit = (picture.max(2) if picture.ndim == 3 else picture) > MAX_PADDING_GREY
    rows, columns = (_span(lit.mean(axis)) for axis in (1, 0))
    left = (rows.stop - rows.start) * (columns.stop - columns.start)
    if left < MIN_PICTURE_SHARE * lit.size:
        return slice(0, lit.shape[0]), slice(0, lit.shape[1])
    return rows, columns


def _span(lit_share: NDArray[np.float64]) -> slice:
    inside = np.flatnonzero(lit_share > MIN_LIT_SHARE)
    return slice(int(inside[0]), int(inside[-1]) + 1) if len(inside) else slice(0, 0)


MAX_THRESHOLD, MIN_THRESHOLD, THRESHOLD_STEP = 0.7, 0.1, 0.1  # thresholds tried in turn, `find_wound` of Appendix A
MIN_PART_PIXELS = 12  # of a part at the picture's own size: fewer have no shape
MAX_WOUND_SHARE = 0.9  # of the picture: a wound that fills it shows no skin, and none was taught so

WoundMask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Segmentation:
    """The wound in one picture."""

    mask: WoundMask  # (H, W), all False where there is no wound
    confidence: float  # 0..1, that the mask is a wound; also where it was too low for one
    threshold: float  # probability by which it was segmented, nan without

    @property
    def found(self) -> bool:
        """Whether there is a wound."""
        return bool(self.mask.any())


BAND_PROBABILITY = 0.975  # above it surely wound, below its complement surely none: the level sets of `WoundBand`


@dataclass(frozen=True, slots=True, eq=False)
class WoundBand:
    """The largest part of a wound in one picture, filled, and between which outlines its own may lie.

    Were the network's probabilities right, and its error the same all round the wound, the true outline would be that
    of some probability, each as likely (the Vorob'ev quantiles of a random set; Molchanov, Theory of Random Sets), and
    its area in 95 of 100 pictures between those of `inner` and `outer`. `Settings.spread` says how right they are.
    """

    found: Segmentation  # with all its parts
    outline: WoundMask  # (H, W), all False where there is no wound
    inner: WoundMask  # (H, W) of the outline's part: probability above BAND_PROBABILITY
    outer: WoundMask  # (H, W): above 1 - BAND_PROBABILITY

    @property
    def whole(self) -> bool:
        """Whether the outline is inside the picture: a part that reaches its border may go on beyond."""
        rim = self.outline.copy()
        rim[1:-1, 1:-1] = False
        return not rim.any()


class Segmenter(Protocol):
    """Finds the wound in a picture; deterministic."""

    def __call__(self, image: Image) -> Segmentation:
        """image: (H, W, 3) BGR or (H, W) grey."""


class NetworkSegmenter:
    """Finds wounds by a trained network."""

    def __init__(self, network: Network, settings: Settings) -> None:
        """network: logits of pictures. settings: chosen with it."""
        self._network, self.settings = network, settings

    def __call__(self, image: Image) -> Segmentation:
        """Looks twice (`coarse_to_fine`), lowers the threshold until something is found, and drops what is unlikely."""
        return segmentation_from_logits(self.logits(image), self.settings)

    def band(self, image: Image) -> WoundBand:
        """The same, and how far it may reach."""
        return band_from_logits(self.logits(image), self.settings)

    def logits(self, image: Image) -> NDArray[np.float32]:
        """(H, W) logits of "wound"; very low in the picture's black padding."""
        colour = rgb(image)
        box = picture_box(colour)
        out = np.full(image.shape[:2], -20.0, np.float32)
        out[box] = wound_logits(colour[box], self._network, self.settings.looks)
        return out


HUE_REACH = 18  # of OpenCV's 180: cameras and printers shift a hue by some 30 degrees
MIN_PATCH_SATURATION, MIN_PATCH_VALUE = 70, 40  # of 255: paler is paper, darker is shade
MIN_PATCH_SHARE = 5e-4  # of the picture: a smaller part is no frame round anything


class ColourSegmenter:
    """Finds a printed frame or patch by its hue: the largest part of that colour, with all that it encloses."""

    def __init__(self, colour: tuple[int, int, int]) -> None:
        """colour: red, green and blue, 0..255, as printed; its hue alone counts."""
        self._hue = int(cv2.cvtColor(np.array([[colour]], np.uint8), cv2.COLOR_RGB2HSV)[0, 0, 0])

    def __call__(self, image: Image) -> Segmentation:
        """The frame and its inside, hull and all: what lies over it hides no part of the region."""
        hsv = cv2.cvtColor(rgb(image), cv2.COLOR_RGB2HSV).astype(np.int16)
        off = np.abs((hsv[..., 0] - self._hue + 90) % 180 - 90)
        coloured = (off <= HUE_REACH) & (hsv[..., 1] >= MIN_PATCH_SATURATION) & (hsv[..., 2] >= MIN_PATCH_VALUE)
        mask = largest_part(coloured)
        found = mask.mean() >= MIN_PATCH_SHARE
        inside = np.zeros(mask.shape, np.uint8)
        if found:
            cv2.fillConvexPoly(inside, hull_of(mask).astype(np.int32), 1)
        return Segmentation(inside > 0, float(found), float("nan"))


def hull_of(mask: WoundMask) -> Array:
    """(N, 2) px corners of the convex hull round a mask (H, W) that is not empty, to half a percent of its length."""
    rows, columns = np.nonzero(mask)
    hull = cv2.convexHull(np.column_stack([columns, rows]).astype(np.int32))
    even = cv2.approxPolyDP(hull, 0.005 * cv2.arcLength(hull, True), True)
    return np.asarray(even.reshape(-1, 2), float)


def outline_of(mask: WoundMask, tolerance: float) -> Array:
    """(N, 2) px corners of the outline of a mask's (H, W) largest part, holes filled, to `tolerance` of its length.

    It runs through the middles of the outermost pixels. None, (0, 2), of an empty mask.
    """
    contours, _ = cv2.findContours(largest_part(mask).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return np.zeros((0, 2))
    even = cv2.approxPolyDP(contours[0], tolerance * cv2.arcLength(contours[0], True), True)
    return np.asarray(even.reshape(-1, 2), float)


def segmentation_from_logits(logits: NDArray[np.float32], settings: Settings) -> Segmentation:
    """The wound by (H, W) logits.

    Where a threshold of 0.7, 0.6, ... 0.1 is first passed there is a wound, and it reaches as far as the probability
    stays above `settings.edge` (or that threshold, if lower): the seed says that there is one, not how large it is.
    """
    for threshold in np.arange(MAX_THRESHOLD, MIN_THRESHOLD - THRESHOLD_STEP / 2, -THRESHOLD_STEP).tolist():
        seeds = logits > _logit(threshold)
        if not seeds.any():
            continue
        mask = seeded_parts(logits > _logit(min(threshold, settings.edge)), seeds, settings.smallest)
        if not mask.any():
            continue
        # a logistic of the mask's mean logit, fitted to pictures with and without a wound
        mean = float(logits[mask].mean())
        confidence = float(1 / (1 + np.exp(-(settings.slope * mean + settings.offset))))
        accepted = confidence >= settings.trust and mask.mean() <= MAX_WOUND_SHARE
        return Segmentation(mask if accepted else np.zeros_like(mask), confidence, threshold if accepted else np.nan)
    return Segmentation(np.zeros(logits.shape, bool), 0.0, np.nan)


def band_from_logits(logits: NDArray[np.float32], settings: Settings) -> WoundBand:
    """The wound by (H, W) logits, and how far it may reach."""
    found = segmentation_from_logits(logits, settings)
    outline = filled(largest_part(found.mask))
    inner, outer = (
        filled(seeded_parts(logits > _logit(level), outline, 0.0)) if found.found else np.zeros_like(found.mask)
        for level in (BAND_PROBABILITY, 1 - BAND_PROBABILITY)
    )
    return WoundBand(found, outline, inner & outline, outer | outline)


def seeded_parts(mask: WoundMask, seeds: WoundMask, smallest: float) -> WoundMask:
    """The connected parts of a mask (H, W) that hold a seed and are no specks: at least `smallest` of the largest."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    seeded = np.bincount(labels[seeds], minlength=count) > 0
    seeded[0] = False
    if not seeded.any():
        return np.zeros_like(mask)
    large = seeded & (area >= max(MIN_PART_PIXELS, smallest * area[seeded].max()))
    return np.asarray(large[labels])


def largest_part(mask: WoundMask) -> WoundMask:
    """The largest connected part of a mask (H, W)."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return mask if count < 3 else np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def filled(mask: WoundMask) -> WoundMask:
    """A mask (H, W) without holes: all that its outer outlines enclose."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    out = np.zeros(mask.shape, np.uint8)
    cv2.drawContours(out, contours, -1, 1, cv2.FILLED)
    return np.asarray(out > 0)


def centroid(mask: WoundMask) -> Array:
    """(2,) px of a mask's middle, by its image moments (thesis 5.2); nan without a wound."""
    moments = cv2.moments(mask.astype(np.uint8), binaryImage=True)
    if not moments["m00"]:
        return np.full(2, np.nan)
    return np.array([moments["m10"], moments["m01"]]) / moments["m00"]


def rgb(image: Image) -> NDArray[np.uint8]:
    """(H, W, 3) RGB of an image (H, W) grey or (H, W, 3) BGR."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB), np.uint8)


def _logit(probability: float) -> float:
    return float(np.log(probability / (1 - probability)))


def dice(mask: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    """2 |A and B| / (|A| + |B|) of two masks (H, W); two empty masks agree: 1."""
    total = int(mask.sum()) + int(truth.sum())
    return 2 * int((mask & truth).sum()) / total if total else 1.0


FOUND_COLOUR, TRUTH_COLOUR = (60, 220, 60), (255, 160, 40)  # BGR of the outlines
TINT_SHARE = 0.25  # of the outline's colour inside it


def draw_overlay(image: Image, wound: Segmentation, truth: WoundMask | None = None, captioned: bool = True) -> Image:
    """(H, W, 3) BGR: the wound's outline, the true outline where there is one, and a caption with the confidence."""
    drawn = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
    inside = wound.mask
    drawn[inside] = ((1 - TINT_SHARE) * drawn[inside] + TINT_SHARE * np.array(FOUND_COLOUR)).astype(np.uint8)
    width = max(1, round(max(image.shape[:2]) / 500))
    for mask, colour in ((truth, TRUTH_COLOUR), (wound.mask, FOUND_COLOUR)):
        if mask is not None:
            outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(drawn, outlines, -1, colour, width)
    if captioned:
        text = f"{'wound' if wound.found else 'no wound'} {wound.confidence:.2f}"
        scale = max(image.shape[:2]) / 1000
        place, weight = (8, int(8 + 28 * scale)), max(1, round(2 * scale))
        cv2.putText(drawn, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, FOUND_COLOUR, weight)
    return np.asarray(drawn, np.uint8)


Box = tuple[int, int, int, int]  # x0, y0, x1, y1 px, the last two excluded

REGION_BORDER_PX = 5  # px round the box, Appendix A
MIN_REGION_SIDE_PX = 8  # px: less holds no patch that could be tracked


def box_of(mask: WoundMask) -> Box | None:
    """The box round a mask (H, W); None where it is empty."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return (x, y, x + width, y + height) if width and height else None


def region(now: Box | None, before: Box | None, size: tuple[int, int], border: float = REGION_BORDER_PX) -> Box:
    """The box round where the wound is and where it was, `border` px wider, inside a picture of `size` (W, H).

    Never empty. The whole picture where the wound is not seen now: it may be anywhere.
    """
    if now is None:
        return 0, 0, *size
    boxes = np.array([now, now if before is None else before], float)
    low = np.clip(np.floor(boxes[:, :2].min(0) - border), 0, np.array(size) - min(MIN_REGION_SIDE_PX, *size))
    high = np.clip(np.ceil(boxes[:, 2:].max(0) + border), low + min(MIN_REGION_SIDE_PX, *size), size)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def polygon(box: Box) -> Array:
    """(4, 2) px corners of a box."""
    x0, y0, x1, y1 = box
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)


def area_on_plane(mask: WoundMask, camera: Camera, base_from_surface: Array) -> float:
    """mm^2 of a mask (H, W) laid through the lens onto the plane z = 0 of the surface; nan where rays miss it.

    base_from_surface: (4, 4) mm, z out of the surface, where the picture was taken. Holes in the mask count.
    """
    camera_from_surface = se3.inverse(camera.base_from_camera) @ base_from_surface
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    total = 0.0
    for each in contours:
        contour = np.asarray(each, np.int32)
        places = _on_plane(contour.reshape(-1, 2).astype(float), camera, camera_from_surface)
        if not np.isfinite(places).all():
            return float("nan")
        # the outline runs through the middles of the outermost pixels and leaves out half a pixel all round:
        # by Pick's theorem, of a contour whose pixels are all listed, so much of its area
        inner = cv2.contourArea(contour)
        outer = inner + len(contour) / 2 + 1
        x, y = places.T
        area = float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)  # Gauss's formula
        total += area * (outer / inner if inner else 1.0)
    return total


def _on_plane(pixels: Array, camera: Camera, camera_from_surface: Array) -> Array:
    """(N, 2) mm on the surface's plane that pixels (N, 2) show; nan behind the camera."""
    ideal = undistort(camera, pixels)
    rays = np.column_stack([ideal, np.ones(len(ideal))]) @ np.linalg.inv(camera.matrix).T
    surface_from_camera = se3.inverse(camera_from_surface)
    directions, origin = rays @ surface_from_camera[:3, :3].T, surface_from_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = -origin[2] / directions[:, 2]
    return np.where(reach[:, None] > 0, origin[:2] + reach[:, None] * directions[:, :2], np.nan)


SHEET_COLUMNS = 8  # pictures a row; a row each of the best, the median and the worst
SHEET_CELL_PX = 240  # px, side of a picture on the sheet
SHEET_MARGIN_SHARE = 1.5  # of the wound's longer side that is shown beyond it on every side


@dataclass(frozen=True, slots=True, eq=False)
class EvaluatedPicture:
    """A picture, the wound segmented in it and the true one."""

    image: Image  # (H, W, 3) BGR
    found: Segmentation
    truth: WoundMask  # (H, W)

    @property
    def dice(self) -> float:
        """How well the two agree."""
        return dice(self.found.mask, self.truth)


def contact_sheet(shown: Sequence[EvaluatedPicture]) -> Image:
    """(H, W, 3) BGR of three rows: best, median, worst; truth in blue, found in green, Dice below each."""
    order = sorted(shown, key=lambda each: -each.dice)
    middle = max(0, (len(order) - SHEET_COLUMNS) // 2)
    rows = (order[:SHEET_COLUMNS], order[middle : middle + SHEET_COLUMNS], order[-SHEET_COLUMNS:])
    padded = [[*row, *[row[-1]] * (SHEET_COLUMNS - len(row))] for row in rows]
    return np.vstack([np.hstack([_cell(each) for each in row]) for row in padded])


def _cell(shown: EvaluatedPicture) -> Image:
    rows, columns = _square(shown.truth | shown.found.mask)
    part = Segmentation(shown.found.mask[rows, columns], shown.found.confidence, shown.found.threshold)
    drawn = draw_overlay(np.ascontiguousarray(shown.image[rows, columns]), part, shown.truth[rows, columns], False)
    cell = np.asarray(cv2.resize(drawn, (SHEET_CELL_PX, SHEET_CELL_PX), interpolation=cv2.INTER_AREA), np.uint8)
    cv2.putText(cell, f"{shown.dice:.2f}", (6, SHEET_CELL_PX - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2)
    return cell


def _square(mask: WoundMask) -> tuple[slice, slice]:
    """Rows and columns of a square round a mask, inside the picture; of its middle where the mask is empty."""
    rows, columns = np.nonzero(mask)
    if not len(rows):
        rows, columns, extent = np.array([mask.shape[0] // 2]), np.array([mask.shape[1] // 2]), min(mask.shape)
    else:
        extent = max(int(np.ptp(rows)), int(np.ptp(columns)), 16)
    side = min(*mask.shape, int((1 + 2 * SHEET_MARGIN_SHARE) * extent))
    spans = []
    for places, full in ((rows, mask.shape[0]), (columns, mask.shape[1])):
        start = int(np.clip((places.min() + places.max()) // 2 - side // 2, 0, full - side))
        spans.append(slice(start, start + side))
    return spans[0], spans[1]
