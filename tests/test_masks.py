"""The print head, fresh ink and highlights are not tracked; nothing else is given up for it."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from estimation import se3
from estimation.errors import InputError
from estimation.runtime import median
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from perception.frames import SYRINGE, PrintHead
from perception.lens import Lenses
from perception.mapping.masks import (
    BEAD_REACH_MM,
    BEAD_STEP_MM,
    CLIPPING_GREY,
    DARK_LEVELS,
    GEL_TIME_S,
    LIGHT_SIGMA,
    MIN_NOISE,
    NOISE_MEMORY_SETS,
    NORMAL_COLUMNS,
    PRINT_HEAD_MARGIN_MM,
    UNSEEN_PX,
    Ink,
    Tool,
    TrackingMasks,
    add_equations,
    colour_ratios,
    highlights,
    near_bead,
    place_pixels,
    trackable,
)

LENSES = Lenses(arc_rig(size=(640, 480), focal=700.0))
ABOVE = BASE_FROM_REST @ se3.make(np.eye(3), [4.0, -3.0, 1.0])  # a tip a millimetre above the surface, upright


def on_tool(rng: np.random.Generator, base_from_nozzle: Array, count: int = 300) -> Array:
    """Points (N, 3) mm, base frame, on the syringe."""
    z = rng.uniform(0, SYRINGE[-1, 0], count)
    angle = rng.uniform(0, 2 * np.pi, count)
    radius = np.interp(z, *SYRINGE.T)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)
    return np.asarray(se3.transform_points(base_from_nozzle, points))


def imaged(camera: int, points_base: Array) -> Array:
    """Where points (N, 3) fall in a camera's image: those inside, (M, 2) px."""
    x, y, depth = se3.transform_points(LENSES.rig.camera_from_base[camera], points_base).T
    pixels, seen = LENSES.bend(camera, x / depth, y / depth, depth)
    inside = seen & ((pixels.T >= 0) & (LENSES.sizes[camera] > pixels.T)).all(1)
    return np.asarray(pixels.T[inside])


@settings(max_examples=30)
@given(
    st.tuples(*[st.floats(-20, 20)] * 3), st.tuples(*[st.floats(-0.6, 0.6)] * 3), st.integers(0, 2), st.integers(0, 99)
)
def test_only_the_head_is_hidden(shift: tuple[float, ...], turn: tuple[float, ...], camera: int, seed: int) -> None:
    nozzle = ABOVE @ se3.exp(np.array([*turn, *shift]))
    masks = TrackingMasks(LENSES)
    masks.set_print_head(PrintHead(nozzle, False), range(3))
    spots = imaged(camera, on_tool(np.random.default_rng(seed), nozzle))
    assert masks.hides(camera, spots).all()
    everywhere = np.random.default_rng(seed).uniform(0, 1, (400, 2)) * LENSES.sizes[camera]
    head = imaged(camera, on_tool(np.random.default_rng(seed + 1), nozzle, 4000))
    if len(head) > 1000:
        away = cKDTree(head).query(everywhere)[0]
        assert not masks.hides(camera, everywhere[away > 40]).any()


def test_without_a_head_nothing_is_hidden() -> None:
    masks = TrackingMasks(LENSES)
    masks.set_print_head(PrintHead(ABOVE, False), range(3))
    assert masks.print_head
    masks.set_print_head(None, range(3))
    assert not masks.print_head and not masks.hides(0, np.full((5, 2), 200.0)).any()


@pytest.mark.parametrize(
    "profile",
    [
        [[0.0, 1.0]],
        [[0.0, 1.0], [0.0, 2.0]],
        [[0.0, -1.0], [5.0, 1.0]],
        [[0.0, np.nan], [5.0, 1.0]],
        [[0.0, 1.0, 2.0]] * 2,
    ],
)
def test_a_tool_that_is_none_is_refused(profile: list[list[float]]) -> None:
    with pytest.raises(InputError, match="height"):
        Tool(np.array(profile))


def test_the_tool_is_drawn_a_little_too_large() -> None:
    def area(margin: float) -> float:
        spots = np.concatenate(Tool(SYRINGE).silhouette(LENSES, 1, ABOVE, margin))
        return float(np.prod(np.ptp(spots, axis=0)))

    assert area(0.0) < area(PRINT_HEAD_MARGIN_MM) < area(5.0)


@given(st.lists(st.tuples(st.floats(-15, 15), st.floats(-15, 15)), min_size=2, max_size=8))
def test_a_bead_has_no_gaps(corners: list[tuple[float, float]]) -> None:
    ink = Ink()
    tips = [np.array([x, y, 0.0]) for x, y in corners]
    for i, tip in enumerate(tips):
        ink.lay(0.1 * i, tip)
    for a, b in pairwise(tips):
        along = a + np.linspace(0, 1, 50)[:, None] * (b - a)
        assert ink.covers(along, np.zeros(50), 1.0).all()


def test_only_what_the_bead_reaches_is_covered_and_only_while_it_is_fresh() -> None:
    ink, points = (
        Ink(),
        np.array([[5.0, 0.0, 0.0], [5.0, BEAD_REACH_MM + 0.5, 0.0], [5.0, BEAD_REACH_MM + BEAD_STEP_MM + 2.0, 0.0]]),
    )
    ink.lay(0.0, np.zeros(3))
    bead = ink.lay(1.0, np.array([10.0, 0.0, 0.0]))
    assert ink.covers(points, np.full(3, 1.0), 2.0).tolist() == [True, True, False]
    assert near_bead(points, bead, np.full(3, 1.0)).tolist() == [True, True, False]
    assert not ink.covers(points, np.full(3, 1.0), 1.5 + GEL_TIME_S).any()


def test_a_lifted_nozzle_draws_no_line_to_where_it_is_set_down() -> None:
    ink = Ink()
    ink.lay(0.0, np.zeros(3))
    ink.lift()
    ink.lay(1.0, np.array([20.0, 0.0, 0.0]))
    assert not ink.covers(np.array([[10.0, 0.0, 0.0]]), np.zeros(1), 1.0).any()


def test_ink_lies_on_the_surface_not_where_the_surface_was() -> None:
    masks = TrackingMasks(LENSES)
    moved = BASE_FROM_REST @ se3.exp(np.array([0.0, 0, 0.2, 8.0, 0, 3.0]))
    tip = se3.make(np.eye(3), [1.0, 2.0, 0.0])
    first = masks.lay_ink(PrintHead(BASE_FROM_REST @ tip, True), 0.0, BASE_FROM_REST)
    second = masks.lay_ink(PrintHead(moved @ tip, True), 0.1, moved)
    np.testing.assert_allclose(second[-1], first[-1], atol=1e-9)
    assert masks.lay_ink(PrintHead(moved @ tip, False), 0.2, moved) is None


def test_small_bright_spots_are_highlights_and_an_overexposed_picture_has_none() -> None:
    image, region = np.full((120, 160), 90, np.uint8), np.full((120, 160), 255, np.uint8)
    image[40:46, 50:58] = 255
    found = highlights(image, region)
    assert found[43, 54] and found[38, 54] and not found[80, 100]
    assert not trackable(image, region, None)[43, 54] and trackable(image, region, None)[80, 100]
    image[:, :80] = 255
    assert not highlights(image, region).any()


def test_tracks_begin_neither_outside_the_region_nor_behind_the_head() -> None:
    image, region = np.full((480, 640), 90, np.uint8), np.zeros((480, 640), np.uint8)
    region[:, 200:] = 255
    masks = TrackingMasks(LENSES)
    masks.set_print_head(PrintHead(ABOVE, False), [0])
    free = trackable(image, region, masks.print_head[0])
    assert not free[:, :199].any() and free.any()
    y, x = np.nonzero(free)
    assert not masks.hides(0, np.stack([x, y], -1).astype(float)).any()


@given(st.integers(0, 10**6))
def test_compiled_lenses_and_equations_are_those_of_the_formula(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, depth = rng.uniform(-1.0, 1.0, (3, 40)) * [[1.5], [1.5], [900.0]]
    camera = int(rng.integers(3))
    k1, k2, p1, p2, k3, fx, fy, cx, cy = LENSES.models[camera]
    r2 = x * x + y * y
    seen = (depth > 1.0) & (r2 < LENSES.radius[camera] ** 2)
    u, v = x * seen, y * seen
    r2 = u * u + v * v
    radial, uv = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 2 * u * v
    across = (u * radial + p1 * uv + p2 * (r2 + 2 * u * u)) * fx + cx
    down = (v * radial + p1 * (r2 + 2 * v * v) + p2 * uv) * fy + cy
    for which in (camera, np.full(40, camera), np.array([camera])):
        imaged, visible = LENSES.bend(which, x, y, depth)
        assert (imaged.reshape(2, -1) == [across, down]).all() and (visible.ravel() == seen).all()


@given(st.integers(0, 10**6))
def test_compiled_colours_are_those_of_the_formula(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera, pose, points = int(rng.integers(3)), se3.exp(rng.normal(0, 0.2, 6)), rng.normal(0, 60.0, (80, 3))
    in_camera = se3.transform_points(LENSES.rig.camera_from_base[camera] @ pose, points)
    depth = np.maximum(in_camera[:, 2], 1.0)
    imaged, seen = LENSES.bend(camera, in_camera[:, 0] / depth, in_camera[:, 1] / depth, in_camera[:, 2])
    lens = LENSES.models[camera], LENSES.radius[camera]
    pixels = place_pixels(LENSES.rig.camera_from_base[camera] @ pose, points, *lens)
    assert np.allclose(pixels, np.where(seen, imaged, UNSEEN_PX).T, rtol=0, atol=1e-9)
    # averages of whole cells, between which OpenCV interpolates
    scale, image = int(rng.integers(1, 4)), rng.integers(0, 256, (47, 61, 3)).astype(np.uint8)
    height, width = 47 // scale, 61 // scale
    cells = image[: height * scale, : width * scale].reshape(height, scale, width, scale, 3).mean((1, 3))
    at = rng.uniform(-8, 64, (80, 2))
    x, y = ((at + 0.5) / scale - 0.5).T
    inside = (x >= 0) & (x < width - 1) & (y >= 0) & (y < height - 1)
    maps = np.float32(x)[None], np.float32(y)[None]
    levels = cv2.remap(cells.astype(np.float32), *maps, cv2.INTER_LINEAR)[0].T.astype(float) * inside
    blue, green, red = levels + DARK_LEVELS
    now, dark, free = colour_ratios(image, scale, at)
    assert np.allclose(now, np.log([red / green, blue / green]), rtol=0, atol=1e-4)
    assert np.allclose(dark, DARK_LEVELS * (1 / green - 1 / np.stack([red, blue])), rtol=0, atol=1e-4)
    clear = np.abs(levels.max(0) - CLIPPING_GREY) > 1e-3
    assert (free == (inside & (levels.max(0) < CLIPPING_GREY)))[clear].all()
    # normal equations
    sums, free = rng.normal(size=(80, 14)), rng.uniform(size=80) < 0.7
    before, slopes, noise = rng.normal(size=(2, 80)), rng.normal(size=(2, 80, 3)), np.array([0.02, 0.002])
    added, learned = sums.copy(), noise.copy()
    add_equations(added, 11, free, now, dark, before, slopes, learned)
    for k in range(2):
        away = now[k] - before[k]
        away -= median(away[free])
        noise[k] += (1.4826 * median(np.abs(away[free])) - noise[k]) / NOISE_MEMORY_SETS
        precision = free / (max(noise[k], MIN_NOISE) ** 2 + (LIGHT_SIGMA * dark[k]) ** 2)
        rows, columns = np.triu_indices(3)
        sums[:, :6] += precision[:, None] * (slopes[k][:, rows] * slopes[k][:, columns])
        sums[:, 6:8] += np.stack([precision * away * away, free], -1)
        sums[:, 11:14] -= (precision * away)[:, None] * slopes[k]
    assert (added == sums).all() and (learned == noise).all()
    assert (NORMAL_COLUMNS[rows, columns] == np.arange(6)).all() and (NORMAL_COLUMNS == NORMAL_COLUMNS.T).all()
