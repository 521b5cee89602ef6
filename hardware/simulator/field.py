"""Fields: (H, W) or (H, W, C) float32 arrays, and how they are read between their places."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float32]
Size = tuple[int, int]  # H, W
Mask = NDArray[np.bool_]


def field(values: object) -> Field:
    """The values as float32."""
    return np.asarray(values, np.float32)


def looked_up(source: Field, u: Field, v: Field) -> Field:
    """The source at columns u and rows v (H, W), bilinear, beyond its edge as it is there."""
    return field(cv2.remap(source, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def painted(texture: Field, u: Field, v: Field) -> Field:
    """A texture (H, W, 4) at columns u and rows v, bilinear, nothing beyond its edge."""
    return field(cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0, 0, 0, 0)))


def enlarged(source: Field, size: Size) -> Field:
    """The source at `size` (H, W), bilinear; rim on rim."""
    return field(cv2.resize(source, size[::-1], interpolation=cv2.INTER_LINEAR))


def averaged(source: Field, size: Size) -> Field:
    """The source at `size` (H, W), a whole fraction of its own: the mean of each block."""
    return field(cv2.resize(source, size[::-1], interpolation=cv2.INTER_AREA))


def blurred(source: Field, sigma: float) -> Field:
    """The source under a Gaussian of `sigma` places."""
    return field(cv2.GaussianBlur(source, (0, 0), sigma))


def ramp(values: Field, low: float, high: float) -> Field:
    """0 up to `low`, 1 from `high`, smooth between (high may be below low)."""
    t = np.clip((values - np.float32(low)) / np.float32(high - low), 0, 1)
    return field(t * t * (3 - 2 * t))


def gradient(height: Field, spacing: float) -> tuple[Field, Field]:
    """Slopes along x and y of a height field whose nodes are `spacing` apart."""
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32) / np.float32(spacing)
    border = cv2.BORDER_REPLICATE
    x = cv2.filter2D(height, cv2.CV_32F, kernel, borderType=border)
    return field(x), field(cv2.filter2D(height, cv2.CV_32F, kernel.T, borderType=border))
