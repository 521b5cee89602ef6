"""The tip of a needle in a picture, to fractions of a pixel, by background subtraction.

The tool is what differs from the background; the needle is the longest thin part attached to it. Its axis and end are
measured in linear light, where a pixel half covered is half as bright: the end is where the needle's area ends,
whatever the blur. A shadow or another moving thing may be taken for the tool in one camera; the other cameras
disagree, and it is left out later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from estimation.se3 import Array
from perception.frames import Image

Light = NDArray[np.float32]  # (H, W, 3), linear, 0 to 1
Mask = NDArray[np.uint8]

NOISE_RATIO, MIN_DIFFERENCE = 4.0, 8.0  # of the tool's pixels: to the median difference; grey levels
MIN_CONTRAST = 0.01  # of full light: a needle that adds or takes less cannot be measured
TIP_WINDOW = 48  # px around the rough tip
MIN_TOOL_AREA = 400  # px
MIN_NEEDLE_LENGTH = 9.0  # px: a shorter needle has no axis
AXIS_LENGTH = 24.0  # px of needle behind the end to which its axis is fitted, at most
END_BEYOND, END_INSIDE = 6.0, 4.0  # px on both sides of the end in its fit: farther in, a ground tip is wider
END_FIT_STEPS = 8
STRIP_HALF_WIDTH = 5.0  # px on either side of the axis
SAMPLE_STEP = 0.25  # px
MIN_COLOUR_CONTRAST = 0.3  # of the contrast, between needle and background: below, brightness is used
MAX_BRIGHTNESS_CHANGE = 0.35  # of the brightness along the needle, from a straight line: else it is no needle
_GREY = np.arange(256) / 255.0
# IEC 61966-2-1, which cameras' pictures follow
_TO_LIGHT = np.where(_GREY <= 0.04045, _GREY / 12.92, ((_GREY + 0.055) / 1.055) ** 2.4).astype(np.float32)
_WEAK_PRIOR = np.array([0.02, 1.0, 0.0, 0.02])  # information on level, taper and blur, in samples of the profile


@dataclass(frozen=True, slots=True)
class Tip:
    """A needle's tip in a picture."""

    pixel: tuple[float, float]  # distorted, where the needle's outline ends on its axis
    towards: tuple[float, float]  # unit vector along the axis to the tool
    sigma: float  # px, from noise
    width: float  # px, of the needle
    contrast: float  # of full light, between needle and background


def background(images: Sequence[Image]) -> Image:
    """The background (H, W, 3): the median of pictures of which most show the tool elsewhere."""
    assert len(images) >= 3
    return np.asarray(np.median(np.stack([_as_bgr(image) for image in images]), axis=0), np.uint8)


def _as_bgr(image: Image) -> Image:
    return image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)


class TipFinder:
    """Finds the tip in one camera's pictures before a constant background."""

    def __init__(self, behind: Image, radius: float) -> None:
        """behind: the background. radius: px, largest of the needle; thicker parts are the tool that holds it."""
        self._behind, self._radius = behind, max(2, round(radius))

    def __call__(self, image: Image) -> Tip | None:
        """The tip, or None where no whole needle is seen."""
        image = _as_bgr(image)
        mask = _tool_mask(image, self._behind)
        rough = None if mask is None else _thin_end(mask, self._radius)
        if rough is None:
            return None
        tip, towards = rough
        x0, y0 = (int(v) for v in np.maximum(tip - TIP_WINDOW, 0))
        part = slice(y0, int(tip[1]) + TIP_WINDOW), slice(x0, int(tip[0]) + TIP_WINDOW)
        behind = _in_light(self._behind[part])
        part_tip = _measure_tip(_in_light(image[part]) - behind, behind, tip - [x0, y0], towards)
        return None if part_tip is None else replace(part_tip, pixel=(part_tip.pixel[0] + x0, part_tip.pixel[1] + y0))


def _in_light(image: Image) -> Light:
    return np.asarray(cv2.LUT(image, _TO_LIGHT), np.float32)


def _tool_mask(image: Image, behind: Image) -> Mask | None:
    """The tool: the largest connected part that differs from the background; None where nothing does."""
    size = cv2.blur(cv2.absdiff(image, behind).max(axis=2), (3, 3))
    noise = float(np.median(size[::4, ::4]))
    mask = (size > max(NOISE_RATIO * noise, MIN_DIFFERENCE)).astype(np.uint8)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        return None
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    if stats[largest, cv2.CC_STAT_AREA] < MIN_TOOL_AREA:
        return None
    return np.asarray(labels == largest, np.uint8)


def _thin_end(mask: Mask, radius: int) -> tuple[Array, Array] | None:
    """Rough tip (2,) px and direction (2,) to the tool: the far end of the longest thin part attached to it."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    thick = cv2.morphologyEx(cv2.copyMakeBorder(mask, 1, 1, 1, 1, cv2.BORDER_REPLICATE), cv2.MORPH_OPEN, disc)
    thick = thick[1:-1, 1:-1]
    if not thick.any():
        return None
    near = cv2.dilate(thick, np.ones((3, 3), np.uint8))
    count, labels = cv2.connectedComponents(np.asarray((mask > 0) & (near == 0), np.uint8), connectivity=8)
    contact = cv2.dilate(near, np.ones((5, 5), np.uint8))
    best: tuple[float, Array, Array] | None = None
    for part in range(1, count):
        rows, columns = np.nonzero(labels == part)
        points = np.column_stack([columns, rows]).astype(float)
        joint = points[contact[rows, columns] > 0]
        if len(points) < MIN_NEEDLE_LENGTH or not len(joint):
            continue
        root = joint.mean(0)
        offsets = points - root
        tip = points[np.linalg.norm(offsets, axis=1).argmax()]
        length = float(np.linalg.norm(tip - root))
        if length >= MIN_NEEDLE_LENGTH and (best is None or length > best[0]):
            best = length, tip, (root - tip) / length
    low, high = END_BEYOND + STRIP_HALF_WIDTH, np.array(mask.shape[::-1]) - 1 - END_BEYOND - STRIP_HALF_WIDTH
    return best[1:] if best is not None and ((low <= best[1]) & (best[1] <= high)).all() else None


def _measure_tip(change: Light, behind: Light, tip: Array, towards: Array) -> Tip | None:
    """The needle's axis and end, from a rough tip (2,) and direction (2,)."""
    for _ in range(3):
        along, across, amount, contrast = _strip(change, behind, tip, towards)
        if contrast < MIN_CONTRAST:
            return None
        inner = (along >= 2.0) & (along <= _reach(amount, along))
        if inner.sum() * SAMPLE_STEP < MIN_NEEDLE_LENGTH - 3:
            return None
        core = np.clip(amount[inner], 0.0, None)
        weight = core.sum(1)
        middle = (core * across).sum(1) / np.maximum(weight, 1e-6)
        slope, offset = np.polyfit(along[inner], middle, 1, w=np.sqrt(np.maximum(weight, 1e-6)))
        side = np.array([-towards[1], towards[0]])
        end = _end(along, amount.sum(1) * SAMPLE_STEP, inner)
        if end is None or abs(end) > END_BEYOND:
            return None
        tip = tip + end * towards + (offset + slope * end) * side
        direction = towards + slope * side
        towards = direction / np.linalg.norm(direction)
    return _tip(along, across, amount, inner, tip, towards, contrast)


def _tip(
    along: Array, across: Array, amount: Array, inner: NDArray[np.bool_], tip: Array, towards: Array, contrast: float
) -> Tip | None:
    profile = amount.sum(1)[inner] * SAMPLE_STEP
    line = np.polyval(np.polyfit(along[inner], profile, 1), along[inner])
    width = float(np.median(profile))
    if width < 0.5 or np.std(profile - line) > MAX_BRIGHTNESS_CHANGE * width:
        return None
    outside = (np.abs(across) > STRIP_HALF_WIDTH - 1.5)[None, :] & (along[:, None] < 0)
    noise = float(np.std(amount[np.broadcast_to(outside, amount.shape)]))
    sigma = noise * np.sqrt((END_BEYOND + END_INSIDE) * 2 * STRIP_HALF_WIDTH) / width
    return Tip((float(tip[0]), float(tip[1])), (float(towards[0]), float(towards[1])), sigma, width, contrast)


def _strip(change: Light, behind: Light, tip: Array, towards: Array) -> tuple[Array, Array, Array, float]:
    """Samples along (S,) and across (W,), px, from the tip, share of needle (S, W) there, and the contrast.

    A round needle has one colour, but is bright on one side and dark on the other: its share is the loss of the
    background light that its own colour does not contain. Without a colour difference brightness is used.
    """
    along = np.arange(-END_BEYOND - 2, AXIS_LENGTH + SAMPLE_STEP, SAMPLE_STEP)
    across = np.arange(-STRIP_HALF_WIDTH, STRIP_HALF_WIDTH + SAMPLE_STEP, SAMPLE_STEP)
    side = np.array([-towards[1], towards[0]])
    at = tip + along[:, None, None] * towards + across[None, :, None] * side
    x, y = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
    patch, back = (
        cv2.remap(light, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
        for light in (change, behind)
    )
    added, colour = (
        np.median(light[(along > 2.5) & (along < 10.0)][:, np.abs(across) < 0.6].reshape(-1, 3), axis=0)
        for light in (patch, patch + back)
    )
    contrast = float(np.linalg.norm(added))
    colour = colour / max(float(np.linalg.norm(colour)), 1e-9)
    projector = np.eye(3) - np.outer(colour, colour)  # onto light that is not of the needle's colour
    foreign = back @ projector
    size = np.sum(foreign**2, axis=-1)
    usual = float(np.median(size))
    if usual < (MIN_COLOUR_CONTRAST * contrast) ** 2:
        return along, across, patch @ added / max(contrast**2, 1e-12), contrast
    return along, across, -np.sum(patch @ projector * foreign, axis=-1) / np.maximum(size, usual / 4), contrast


def _reach(amount: Array, along: Array) -> float:
    """Length, px, over which the needle's width stays constant from its end."""
    profile = amount.sum(1) * SAMPLE_STEP
    usual = float(np.median(profile[(along > 2.5) & (along < 8.0)]))
    outside = np.flatnonzero((along > 8.0) & (np.abs(profile - usual) > 0.5 * usual))
    return float(along[outside[0]]) - 1.5 if len(outside) else AXIS_LENGTH


def _end(along: Array, profile: Array, inner: NDArray[np.bool_]) -> float | None:
    """End of the needle along the axis, px: where the profile reaches half of the needle's own width there.

    Model of the profile: (a + b s) Phi((s - e) / w), by Gauss-Newton; w holds blur and a round end, b a taper.
    """
    level = float(np.median(profile[inner]))
    window = (along >= -END_BEYOND) & (along <= END_INSIDE)
    s, y = along[window], profile[window] / max(level, 1e-9)
    a, b, e, w = 1.0, 0.0, 0.0, 1.0
    for _ in range(END_FIT_STEPS):
        step, bell = ndtr((s - e) / w), np.exp(-0.5 * ((s - e) / w) ** 2) / np.sqrt(2 * np.pi)
        line = a + b * s
        slopes = np.column_stack([step, s * step, -line * bell / w, -line * bell * (s - e) / w**2])
        residual = y - line * step
        normal = slopes.T @ slopes + np.diag(_WEAK_PRIOR)
        change = np.linalg.solve(normal, slopes.T @ residual - _WEAK_PRIOR * np.array([a - 1.0, b, 0.0, w - 1.0]))
        a, b, e = a + change[0], b + change[1], e + float(np.clip(change[2], -1.0, 1.0))
        w = float(np.clip(w + change[3], 0.3, 3.0))
    return e if a > 0.3 and abs(e) <= END_BEYOND else None
