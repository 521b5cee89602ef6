"""Optical flow from the last frame to this one and back: a predictor for the alignment, never a measurement."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from perception.features import bounding_box
from perception.frames import Image

WINDOW = 21  # px
FLAT, LEAST = 2.0, 8  # grey levels of spread below which a window tells nothing; windows for a median
LIKENESS, ENOUGH = 0.7, 0.35  # correlation of a window with itself; share of alike ones that is enough
ASKED = 40  # tracks, about
SMALL, MOST = 0.08, (0.4, 2.5)  # changes of brightness that flow bears; gains beyond which it is another picture
RETURNED = 1.0  # px from where a track began to where it ends when it is followed back
MARGIN = 48.0  # px around the tracks: flow sees that far beyond them


def flow(
    previous: Image, current: Image, pixels: Array, guess: Array, levels: int = 4
) -> tuple[Array, NDArray[np.bool_]]:
    """Where pixels (N, 2) of the previous image stand in the current one (N, 2), and whether they were found (N,).

    guess: (N, 2) px, where to begin. Pyramidal Lucas-Kanade (thesis 4.4, Eq. 4.7-4.10) on the box around the tracks. It
    takes brightness as constant, and was measured to fail where that jumps by a quarter: where most of what it finds
    does not look like what it sought, it is tried again with the jump taken back, and the better of the two is kept.
    What does not come back to where it began when it is followed the other way is not found (Kalal et al. 2010).
    """
    first = _there_and_back(previous, current, pixels, guess, levels)
    alike = _alike(previous, current, pixels, *first)
    if alike >= ENOUGH:
        return first
    gain, offset = _brightness(previous, current, pixels, guess)
    if not MOST[0] < gain < MOST[1] or (abs(gain - 1) < SMALL and abs(offset) < SMALL * 128):
        return first
    relit = np.asarray(cv2.addWeighted(current, 1 / gain, current, 0.0, -offset / gain), np.uint8)
    second = _there_and_back(previous, relit, pixels, guess, levels)
    return second if _alike(previous, relit, pixels, *second) > alike else first


def _there_and_back(
    previous: Image, current: Image, pixels: Array, guess: Array, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    there, found = _lucas_kanade(previous, current, pixels, guess, levels)
    there[~found] = guess[~found]
    back, returned = _lucas_kanade(current, previous, there, pixels + there - guess, levels)
    return there, found & returned & (np.linalg.norm(back - pixels, axis=1) < RETURNED)


def _lucas_kanade(
    previous: Image, current: Image, pixels: Array, guess: Array, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    h, w = current.shape[:2]
    reach = np.concatenate([pixels, guess])
    x0, y0, x1, y1 = bounding_box(np.clip(reach, 0, [w, h]), (w, h), MARGIN)
    corner = np.array([x0, y0], float)
    begin = np.ascontiguousarray((guess - corner)[:, None], np.float32)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        np.ascontiguousarray(previous[y0:y1, x0:x1]),
        np.ascontiguousarray(current[y0:y1, x0:x1]),
        np.ascontiguousarray((pixels - corner)[:, None], np.float32),
        begin.copy(),
        winSize=(WINDOW, WINDOW),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.05),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    moved = np.asarray(found, np.float64)[:, 0]
    return moved + corner, (np.asarray(status).ravel() > 0) & np.isfinite(moved).all(1)


def _alike(previous: Image, current: Image, pixels: Array, moved: Array, found: NDArray[np.bool_]) -> float:
    """Share of the tracks that look where they were found (N,) as they did before, whatever the brightness."""
    asked = np.arange(0, len(pixels), max(1, len(pixels) // ASKED))  # a few dozen tell it as well as all
    kept = asked[found[asked]]
    if not len(kept):
        return 0.0
    before, now = _around(previous, pixels[kept]), _around(current, moved[kept])
    before, now = before - before.mean(1, keepdims=True), now - now.mean(1, keepdims=True)
    product = (before * now).sum(1)
    return float(np.sum(product > LIKENESS * np.sqrt((before**2).sum(1) * (now**2).sum(1))) / len(asked))


def _brightness(previous: Image, current: Image, pixels: Array, guess: Array) -> tuple[float, float]:
    """Gain and offset, grey levels, from the previous image to the current one: the median over the tracks.

    Each track tells them by mean and spread of the few pixels around it, there and here.
    """
    before, now = _around(previous, pixels), _around(current, guess)
    spread = before.std(1)
    told = spread > FLAT
    if told.sum() < LEAST:
        return 1.0, 0.0
    gain = float(np.median(now[told].std(1) / spread[told]))
    return gain, float(np.median(now.mean(1) - gain * before.mean(1)))


def _around(image: Image, pixels: Array) -> Array:
    """Grey levels (N, K) at every third pixel of a window around each of pixels (N, 2)."""
    step = np.arange(-WINDOW // 2 + 2, WINDOW // 2, 3)
    h, w = image.shape[:2]
    x, y = np.rint(np.clip(pixels, 0, [w - 1, h - 1])).astype(int).T
    rows, columns = np.clip(y[:, None] + step, 0, h - 1), np.clip(x[:, None] + step, 0, w - 1)
    return np.asarray(image[rows[:, :, None], columns[:, None, :]].reshape(len(pixels), -1), float)
