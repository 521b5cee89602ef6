"""Where the wound is in one picture, and how sure that is; by the network, or by anything that answers like it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from perception.coarse_to_fine import Network, wound_logits
from perception.frames import Image
from perception.padding import picture_box
from perception.wound.network import Settings

HIGHEST, LOWEST, STEP = 0.7, 0.1, 0.1  # thresholds tried in turn, `find_wound` of Appendix A
LEAST_PIXELS = 12  # of a part at the picture's own size: fewer have no shape
LARGEST_SHARE = 0.9  # of the picture: a wound that fills it shows no skin, and none was taught so

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Segmentation:
    """mask: (H, W) bool; all False where no wound was found. confidence: 0..1, that the mask is a wound; also where it
    was too low for one. threshold: probability at which it was found, nan without."""

    mask: Mask
    confidence: float
    threshold: float

    @property
    def found(self) -> bool:
        """Whether there is a wound."""
        return bool(self.mask.any())


class Segmenter(Protocol):
    """Finds the wound in a picture; deterministic."""

    def __call__(self, image: Image) -> Segmentation:
        """image: (H, W, 3) BGR or (H, W) grey."""
        ...


class NetworkSegmenter:
    """Finds wounds by a trained network."""

    def __init__(self, network: Network, settings: Settings) -> None:
        """network: logits of pictures. settings: chosen with it."""
        self._network, self._settings = network, settings

    def __call__(self, image: Image) -> Segmentation:
        """Looks twice (`coarse_to_fine`), lowers the threshold until something is found, and drops what is unlikely."""
        return judged(self.logits(image), self._settings)

    def logits(self, image: Image) -> NDArray[np.float32]:
        """(H, W) logits of "wound"; very low in the picture's black padding."""
        colour = rgb(image)
        box = picture_box(colour)
        out = np.full(image.shape[:2], -20.0, np.float32)
        out[box] = wound_logits(colour[box], self._network, self._settings.looks)
        return out


def judged(logits: NDArray[np.float32], settings: Settings) -> Segmentation:
    """The mask that (H, W) logits amount to.

    Where a threshold of 0.7, 0.6, ... 0.1 is first passed there is a wound, and it reaches as far as the probability
    stays above `settings.edge` (or that threshold, if lower): the seed tells that there is one, not how large it is.
    """
    for threshold in np.arange(HIGHEST, LOWEST - STEP / 2, -STEP).tolist():
        seeds = logits > _logit(threshold)
        if not seeds.any():
            continue
        mask = parts(logits > _logit(min(threshold, settings.edge)), seeds, settings.smallest)
        if not mask.any():
            continue
        confidence = confidence_of(logits, mask, settings)
        kept = confidence >= settings.trust and mask.mean() <= LARGEST_SHARE
        return Segmentation(mask if kept else np.zeros_like(mask), confidence, threshold if kept else np.nan)
    return Segmentation(np.zeros(logits.shape, bool), 0.0, np.nan)


def parts(mask: Mask, seeds: Mask, smallest: float) -> Mask:
    """The connected parts of a mask (H, W) that hold a seed and are no specks: at least `smallest` of the largest."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    seeded = np.bincount(labels[seeds], minlength=count) > 0
    seeded[0] = False
    if not seeded.any():
        return np.zeros_like(mask)
    kept = seeded & (area >= max(LEAST_PIXELS, smallest * area[seeded].max()))
    return np.asarray(kept[labels])


def largest_part(mask: Mask) -> Mask:
    """The largest connected part of a mask (H, W)."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return mask if count < 3 else np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def confidence_of(logits: NDArray[np.float32], mask: Mask, settings: Settings) -> float:
    """0..1, that a mask is a wound: a logistic of its mean logit, fitted to pictures with and without one."""
    mean = float(logits[mask].mean())
    return float(1 / (1 + np.exp(-(settings.slope * mean + settings.offset))))


def centroid(mask: Mask) -> Array:
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
