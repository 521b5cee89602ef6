"""The end of a needle in pictures that are drawn with known edges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.se3 import Array
from perception.boards.needle_tip import _TO_LIGHT, TipFinder, background
from perception.frames import Image

SIZE = (240, 320)  # px
FINE = 8  # samples across a pixel of what is drawn


def cloth(seed: int) -> Image:
    draw = np.random.default_rng(seed)
    rough = draw.normal(size=(SIZE[0] // 8, SIZE[1] // 8, 1)).astype(np.float32)
    shade = cv2.resize(rough, SIZE[::-1], interpolation=cv2.INTER_CUBIC)[..., None] * 6
    return np.clip(np.array([130, 118, 42]) + shade, 0, 255).astype(np.uint8)


def picture(
    behind: Image, tip: Array, angle: float, width: float, noise: float, seed: int, needle: bool = True, dark: float = 1
) -> Image:
    """A grey needle of `width` px from `tip`, 26 px long, on a thick red body, blurred by 0.6 px; half of it darker."""
    towards = np.array([np.cos(angle), np.sin(angle)])
    side = np.array([-towards[1], towards[0]])
    light = _TO_LIGHT[behind].astype(float)
    x, y = (((np.arange(n * FINE) + 0.5) / FINE - 0.5) for n in SIZE[::-1])
    along, across = (np.add.outer((y - tip[1]) * d[1], (x - tip[0]) * d[0]) for d in (towards, side))
    steel = np.array([0.2, 0.2, 0.21])
    parts = [(26, 80, 14, -1, np.array([0.03, 0.05, 0.3])), (0, 27, width, -1, steel), (0, 27, width, 0, dark * steel)]
    for start, end, wide, low, colour in parts[: 1 + 2 * needle]:
        inside = (along >= start) & (along <= end) & (across >= 0.5 * wide * low) & (across <= 0.5 * wide)
        share = cv2.resize(255.0 * inside, SIZE[::-1], interpolation=cv2.INTER_AREA)[..., None] / 255.0
        light = light * (1 - share) + colour * share
    shown = 255 * np.interp(cv2.GaussianBlur(light, (0, 0), 0.6), _TO_LIGHT, np.arange(256) / 255.0)
    shown = shown + noise * np.random.default_rng(seed).normal(size=shown.shape)
    return np.clip(np.round(shown), 0, 255).astype(np.uint8)


@settings(max_examples=12)
@given(st.integers(0, 10_000))
def test_the_end_is_found_to_a_fraction_of_a_pixel(seed: int) -> None:
    draw, behind = np.random.default_rng(seed), cloth(seed)
    tip, angle = np.array([160.0, 120.0]) + draw.uniform(-20, 20, 2), draw.uniform(0, 2 * np.pi)
    found = TipFinder(behind, 4.0)(picture(behind, tip, angle, draw.uniform(1.8, 4.0), 1.0, seed))
    assert found is not None
    assert np.linalg.norm(np.array(found.pixel) - tip) < 0.35  # 0.13 on average, and five times its scatter
    assert np.dot(found.towards, [np.cos(angle), np.sin(angle)]) > 0.999


def test_a_dark_side_does_not_move_the_tip(monkeypatch: pytest.MonkeyPatch) -> None:
    behind, tip, angle = cloth(5), np.array([158.3, 121.4]), 0.9
    even, shaded = (picture(behind, tip, angle, 3.0, 1.0, 0, dark=dark) for dark in (1.0, 0.2))

    def moved() -> float:
        before, after = TipFinder(behind, 4.0)(even), TipFinder(behind, 4.0)(shaded)
        assert before is not None and after is not None
        return float(abs((np.array(after.pixel) - before.pixel) @ [-np.sin(angle), np.cos(angle)]))

    assert moved() < 0.05
    monkeypatch.setattr("perception.boards.needle_tip.COLOURED", np.inf)  # by brightness alone
    assert moved() > 0.15


def test_noise_is_told() -> None:
    behind, off = cloth(1), []
    tip = np.array([150.3, 110.7])
    for seed in range(12):
        found = TipFinder(behind, 4.0)(picture(behind, tip, 0.7, 2.5, 2.0, seed))
        assert found is not None
        off.append(np.array(found.pixel) - tip)
    spread = float(np.std(off, axis=0).max())
    assert 0.3 < found.sigma / spread < 5.0


@pytest.mark.parametrize("grey", [True, False])
def test_the_background_is_what_stays(grey: bool) -> None:
    behind = cloth(2)
    places = [np.array([60.0 + 40 * k, 60.0 + 20 * k]) for k in range(6)]
    pictures = [picture(behind, place, 0.8, 3.0, 1.0, k) for k, place in enumerate(places)]
    if grey:
        pictures = [np.asarray(image[..., 2]) for image in pictures]
    found = TipFinder(background(pictures), 4.0)(pictures[2])
    assert found is not None and np.linalg.norm(np.array(found.pixel) - places[2]) < 0.3


def test_where_no_needle_is_none_is_found() -> None:
    behind = cloth(3)
    finder = TipFinder(behind, 4.0)
    assert finder(behind) is None
    assert finder(picture(behind, np.array([160.0, 120.0]), 0.4, 3.0, 1.0, 0, needle=False)) is None
    assert finder(picture(behind, np.array([4.0, 120.0]), 0.0, 3.0, 1.0, 0)) is None  # its end is not in the picture
