"""The light and the camera of a training sample: colour, exposure, shading, blur, noise and compression."""

import cv2
import numpy as np
from numpy.typing import NDArray


def relit(picture: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W, 3) RGB as another camera might have taken it."""
    seen = np.asarray(_shaded(_coloured(picture, rng), rng))
    if rng.random() < 0.2:
        seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), rng.uniform(0.4, 1.6)), np.float32)
    if rng.random() < 0.25:
        seen = seen + rng.normal(0, rng.uniform(2, 10), seen.shape).astype(np.float32)
    exposed = np.clip(seen, 0, 255).astype(np.uint8)
    return _compressed(exposed, int(rng.integers(25, 80))) if rng.random() < 0.1 else exposed


def _coloured(picture: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.float32]:
    """White balance, gamma, brightness, saturation and a small turn of the hue; now and then no colour at all."""
    levels = np.arange(256, dtype=np.float32) / 255
    gamma, gain = np.exp(rng.normal(0, 0.25)), np.exp(rng.normal(0, 0.15))
    balance = np.exp(rng.normal(0, 0.08, 3))
    tables = np.clip(255 * gain * balance[None] * levels[:, None] ** gamma, 0, 255).astype(np.uint8)
    seen = cv2.LUT(picture, np.ascontiguousarray(tables[None]))
    if rng.random() < 0.3:
        turned = cv2.cvtColor(seen, cv2.COLOR_RGB2HSV)
        turned[..., 0] = (turned[..., 0].astype(np.int16) + int(rng.integers(-7, 8))) % 180
        seen = cv2.cvtColor(turned, cv2.COLOR_HSV2RGB)
    saturation = 0.0 if rng.random() < 0.04 else rng.uniform(0.5, 1.4)
    grey = cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY).astype(np.float32)[..., None]
    return np.asarray(grey + np.float32(saturation) * (seen - grey), np.float32)


def _shaded(picture: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Light that falls off to one side, a third of the time."""
    if rng.random() > 0.33:
        return picture
    height, width = picture.shape[:2]
    across, down = rng.normal(0, 0.25, 2)
    slope = 1 + down * np.linspace(-1, 1, height)[:, None] + across * np.linspace(-1, 1, width)[None]
    return picture * np.clip(slope, 0.2, 2).astype(np.float32)[..., None]


def _compressed(picture: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    written, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert written
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
