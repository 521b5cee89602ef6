"""Flow finds where pixels went, and says which it lost; matching gives the same pairs whichever way it takes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from estimation.se3 import Array
from perception import features
from perception.features import match
from perception.flow import flow
from perception.frames import Image
from perception.prefilter import BILATERAL, NONE, PREFILTERS

SIZE = (320, 240)


def texture(seed: int) -> Image:
    noise = np.random.default_rng(seed).normal(0, 1, SIZE[::-1]).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.asarray(np.clip(120 + 50 * smooth / smooth.std(), 0, 255), np.uint8)


def shifted(image: Image, by: tuple[float, float]) -> Image:
    return np.asarray(cv2.warpAffine(image, np.array([[1, 0, by[0]], [0, 1, by[1]]], float), SIZE), np.uint8)


def grid() -> Array:
    x, y = np.meshgrid(np.arange(60.0, 261.0, 20.0), np.arange(60.0, 181.0, 20.0))
    return np.stack([x.ravel(), y.ravel()], -1)


@pytest.mark.parametrize("by", [(0.0, 0.0), (3.3, -2.1), (14.0, 9.0)])
def test_pixels_are_found_where_they_went(by: tuple[float, float]) -> None:
    before, pixels = texture(0), grid()
    found, ok = flow(before, shifted(before, by), pixels, pixels)
    assert ok.all()
    assert np.abs(found - pixels - by).max() < 0.2


def test_what_something_else_has_covered_does_not_come_back_and_is_not_found() -> None:
    before, pixels = texture(0), grid()
    after = shifted(before, (3.0, 2.0))
    after[:, 160:] = texture(1)[:, 160:]
    found, ok = flow(before, after, pixels, pixels)
    covered = pixels[:, 0] > 180
    assert ok[pixels[:, 0] < 130].all() and ok[covered].mean() < 0.3
    assert np.abs((found - pixels - (3.0, 2.0))[ok & (pixels[:, 0] < 130)]).max() < 0.3


def test_a_guess_that_is_far_off_is_mended_where_the_pyramid_reaches() -> None:
    before, pixels = texture(0), grid()
    found, ok = flow(before, shifted(before, (20.0, 0.0)), pixels, pixels + [8.0, 6.0])
    assert ok.mean() > 0.9 and np.abs(found - pixels - (20.0, 0.0))[ok].max() < 0.3


def descriptors(count: int, seed: int) -> NDArray[np.float32]:
    raw = np.random.default_rng(seed).normal(0, 1, (count, 128)) ** 2
    return np.round(512 * raw / np.linalg.norm(raw, axis=1, keepdims=True)).astype(np.float32)


def test_trees_give_nearly_the_pairs_of_all_distances_and_the_same_every_time(monkeypatch: pytest.MonkeyPatch) -> None:
    a = descriptors(800, 0)
    b = np.concatenate([a[:400] + np.random.default_rng(1).normal(0, 12, (400, 128)), descriptors(400, 2)])
    b = b.astype(np.float32)
    exact = match(a, b)
    monkeypatch.setattr(features, "MANY", 0)
    trees, again = match(a, b), match(a, b)
    assert len(exact) > 350 and (exact[:, 0] == exact[:, 1]).mean() > 0.99
    assert len(set(map(tuple, exact)) & set(map(tuple, trees))) > 0.97 * len(exact)
    assert np.array_equal(trees, again)


def test_two_of_a_kind_are_nobodys_match() -> None:
    a = descriptors(50, 0)
    assert not len(match(a, np.concatenate([a, a])))
    assert not len(match(a[:1], a)) and not len(match(a, a[:0]))


def test_the_bilateral_filter_keeps_an_edge_and_takes_the_noise() -> None:
    image = np.where(np.arange(320) < 160, 60, 190) + np.random.default_rng(0).normal(0, 6, (240, 320))
    filtered = PREFILTERS[BILATERAL](np.asarray(np.clip(image, 0, 255), np.uint8)).astype(float)
    assert filtered[:, 20:140].std() < 0.5 * image[:, 20:140].std()
    assert filtered[:, 164:].mean() - filtered[:, :156].mean() > 120
    same = texture(0)
    assert PREFILTERS[NONE](same) is same
