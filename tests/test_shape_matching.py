"""Segmentation by shape: the thesis's own method, and the one that ranks outlines by colour and shape."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation.errors import InputError
from estimation.scan import scan_from_triangles
from perception.dice import dice
from perception.wound.network import shipped
from perception.wound.shape_matching import (
    TERMS,
    ShapeSegmenter,
    pattern_of,
    pattern_of_scan,
    plain,
    products,
    read_shape_model,
    settled,
)
from perception.wound_candidates import COLOUR_TERMS, FEATURES, described, outlines, scene_of
from tests.test_segmentation import disc, picture


def ellipse(size: tuple[int, int], centre: tuple[int, int], axes: tuple[int, int], angle: float = 0) -> np.ndarray:
    mask = np.zeros(size, np.uint8)
    cv2.ellipse(mask, centre, axes, angle, 0, 360, 1, -1)
    return mask > 0


def test_the_thesis_method_finds_the_drawn_shape_among_others() -> None:
    image = np.full((300, 400), 200, np.uint8)
    wanted, other = ellipse((300, 400), (100, 150), (60, 20)), ellipse((300, 400), (280, 150), (45, 40))
    image[wanted | other] = 90
    found = plain(image, pattern_of(ellipse((200, 200), (100, 100), (90, 30), 40)))
    assert dice(found, wanted) > 0.85
    assert dice(plain(image, pattern_of(ellipse((200, 200), (100, 100), (90, 80)))), other) > 0.85


def test_the_outlines_of_a_coloured_disc_hold_the_disc_itself() -> None:
    model = read_shape_model(shipped("shape", ".toml"))
    image, truth = picture((120, 90), 30, (200, 256))
    scene = scene_of(np.ascontiguousarray(image[..., ::-1]), model.colour)
    best = 0.0
    for outline in outlines(scene):
        mask = np.zeros(truth.shape, np.uint8)
        cv2.drawContours(mask, [outline], -1, 1, -1)
        best = max(best, dice(mask > 0, truth))
        assert described(scene, outline, list(model.patterns), None).shape == (FEATURES,)
    assert best > 0.95


def test_a_description_does_not_depend_on_the_patterns_scale_or_turn() -> None:
    image, _ = picture((120, 90), 30, (200, 256))
    scene = scene_of(np.ascontiguousarray(image[..., ::-1]), read_shape_model(shipped("shape", ".toml")).colour)
    outline = outlines(scene)[0]
    small, large = (pattern_of(ellipse((400, 400), (200, 200), (20 * k, 8 * k), 30 * k)) for k in (2, 5))
    assert np.allclose(described(scene, outline, [small], None), described(scene, outline, [large], None), atol=0.1)


def test_an_edge_that_was_drawn_too_wide_settles_where_the_colours_part() -> None:
    image, truth = picture((120, 90), 30, (200, 256))
    lab = cv2.cvtColor(image, cv2.COLOR_BGR2LAB).astype(np.float32)
    wide = pattern_of(disc((200, 256), (120, 90), 33))
    assert dice(settled(lab, wide), truth) > dice(disc((200, 256), (120, 90), 33), truth)


def test_the_segmenter_answers_with_a_mask_of_the_pictures_size_and_the_same_twice() -> None:
    segmenter = ShapeSegmenter(read_shape_model(shipped("shape", ".toml")))
    image, _ = picture((300, 200), 60)
    first, second = segmenter(image), segmenter(image)
    assert first.mask.shape == (480, 640)
    assert np.array_equal(first.mask, second.mask) and first.confidence == second.confidence


def test_a_picture_of_one_colour_shows_no_wound() -> None:
    found = ShapeSegmenter(read_shape_model(shipped("shape", ".toml")))(np.full((90, 120, 3), 128, np.uint8))
    assert not found.found


def test_the_outline_of_a_scan_is_its_topmost_layers() -> None:
    """The thesis's own simulated scan: elliptic, radii (0.25, 0.8) on top and (0.1, 0.15) below, 0.3 deep."""
    angle, depth = np.meshgrid(np.linspace(0, 2 * np.pi, 60, endpoint=False), np.linspace(0, 1, 40))
    wide, long = 0.25 - 0.15 * depth, 0.8 - 0.65 * depth
    points = np.stack([wide * np.cos(angle), long * np.sin(angle), -0.3 * depth], -1).reshape(-1, 3) * 40
    triangles = [(i, i + 1, i + 60) for i in range(len(points) - 61)]
    pattern, area = pattern_of_scan(scan_from_triangles(points, np.array(triangles)))
    _, _, width, height = cv2.boundingRect(pattern)
    assert width / height == pytest.approx(0.25 / 0.8, rel=0.1)
    assert area == pytest.approx(np.pi * 10 * 32, rel=0.05)


def test_a_model_that_is_none_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "shape.toml"
    for text in ("", "colour = 3", "colour = [1.0]\nrank = [1.0]\nrank_usual = [1.0]\ntrust = 0.4\npatterns = []"):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match="shape model"):
            read_shape_model(file)


def model_text(trust: str = "0.4", colour: str = "1.0", corner: str = "1") -> str:
    rank = ", ".join(["1.0"] * TERMS)
    lists = f"colour = [{', '.join([colour] * COLOUR_TERMS)}]\nrank = [{rank}]\nrank_usual = [{rank}]\n"
    return f"trust = {trust}\n{lists}patterns = [[[{corner}, 1], [2, 2], [3, 1]]]\n"


def test_a_model_with_a_number_that_is_not_finite_or_too_large_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "shape.toml"
    file.write_text(model_text(), encoding="utf-8")
    assert len(read_shape_model(file).patterns) == 1
    wrong = [{key: word} for key in ("trust", "colour", "corner") for word in ("inf", "nan", "9" * 400)]
    for each in [*wrong, {"corner": "9" * 30}]:
        file.write_text(model_text(**each), encoding="utf-8")
        with pytest.raises(InputError, match="shape model"):
            read_shape_model(file)


def test_products_are_all_pairs_and_begin_with_one() -> None:
    assert np.array_equal(products(np.array([[2.0, 3.0]])), [[1, 2, 3, 4, 6, 9]])
