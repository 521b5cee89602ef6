"""Patches found to a fraction of a pixel, never creeping; flow tells what it lost; matching is the same all ways."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from perception.frames import Image
from perception.lens import BILATERAL_PREFILTER, NO_PREFILTER, PREFILTERS, Lenses
from perception.mapping import features
from perception.mapping.alignment_kernels import CONVERGED_STEP, median_of
from perception.mapping.features import grey, match, sift
from perception.mapping.matcher import optical_flow
from perception.mapping.patches import (
    RELIEF_PX,
    Alignment,
    Projection,
    Pyramid,
    Templates,
    align,
    align_in,
    coarse_score,
    cut_templates,
    join,
    normalise,
    project_into,
    project_squares,
)
from tests.rendered_sets import LOOK, WIDE, patch, pictures

RIG = arc_rig(size=(640, 480), focal=700.0)
LENSES = Lenses(RIG)
SCENE = patch(2, wound=WIDE, look=replace(LOOK, wetness=0.0))  # a highlight does not move with what it lies on
FLAT = SCENE.shape.grid(7.0, 0.7)
POINTS, NORMALS = SCENE.shape.points(FLAT), SCENE.shape.normals(FLAT)


def picture(pose: Array, camera: int = 0, seed: int = 0) -> Image:
    (image,) = pictures(SCENE, RIG.cameras[camera : camera + 1], pose, np.random.default_rng([seed, camera]))
    return grey(image)


def true_pixels(pose: Array, camera: int = 0) -> Array:
    return pixels_from_points(RIG.cameras[camera], se3.transform_points(pose, POINTS))[0]


@pytest.fixture(scope="module")
def templates() -> Templates:
    return cut_templates(LENSES, Pyramid(picture(BASE_FROM_REST)), 0, BASE_FROM_REST, POINTS, NORMALS)


def find(
    templates: Templates,
    image: Image,
    predicted: Array,
    camera: int = 0,
    begin: Array | None = None,
    coarse: bool = True,
) -> tuple[Alignment, Projection]:
    """Look for the patches in an image where the predicted pose puts them, or from `begin` (N, 2) px."""
    where = project_squares(LENSES, camera, predicted, POINTS, NORMALS, templates.axes)
    return align(templates, Pyramid(image), where, where.centre if begin is None else begin, coarse=coarse), where


def errors(found: Alignment, pose: Array, camera: int = 0) -> Array:
    """Distances (M,) px of the patches found from the truth."""
    return np.asarray(np.linalg.norm((found.pixels - true_pixels(pose, camera))[found.found], axis=1))


MOTIONS = {
    "still": np.zeros(6),
    "shifted": np.array([0, 0, 0, 6.3, -4.1, 2.0]),
    "rolled": np.array([0, 0, 0.6, 2, 0, 0]),
    "tilted": np.array([0.35, -0.3, 0, 0, 1, 0]),
    "nearer": np.array([0, 0, 0, 0, 0, 90.0]),
    "further": np.array([0, 0, 0, 0, 0, -80.0]),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_patches_are_found_to_a_fraction_of_a_pixel(templates: Templates, name: str) -> None:
    """The prediction is 0.6 mm and 0.6 degrees off, about 1.5 px."""
    pose = BASE_FROM_REST @ se3.exp(MOTIONS[name])
    predicted = pose @ se3.exp(np.array([0.006, -0.006, 0.006, 0.4, -0.4, 0.2]))
    found, where = find(templates, picture(pose, seed=1), predicted)
    away = errors(found, pose)
    assert found.found.sum() > 0.85 * where.visible.sum() > 20
    assert np.sqrt(np.mean(away**2)) < 0.15 and np.percentile(away, 95) < 0.3


@pytest.mark.parametrize(("gain", "offset"), [(0.5, 0.0), (0.7, 40.0), (1.0, -25.0), (1.1, 10.0)])
def test_brightness_and_contrast_do_not_matter(templates: Templates, gain: float, offset: float) -> None:
    pose = BASE_FROM_REST @ se3.exp(MOTIONS["shifted"])
    image = np.clip(np.rint(gain * picture(pose, seed=1).astype(float) + offset), 0, 255).astype(np.uint8)
    found, where = find(templates, image, pose)
    assert found.found.sum() > 0.85 * where.visible.sum()
    assert np.sqrt(np.mean(errors(found, pose) ** 2)) < 0.15


def test_another_camera_finds_the_same_spots(templates: Templates) -> None:
    found, where = find(templates, picture(BASE_FROM_REST, camera=1), BASE_FROM_REST, camera=1)
    assert found.found.sum() > 0.7 * where.visible.sum() > 15
    assert np.sqrt(np.mean(errors(found, BASE_FROM_REST, 1) ** 2)) < 0.25


def test_the_claimed_error_is_of_the_true_ones_size(templates: Templates) -> None:
    ratios = []
    for seed in range(4):
        pose = BASE_FROM_REST @ se3.exp(np.array([0, 0, 0.02, 0.37 * seed, 0.21 * seed, 0]))
        found, _ = find(templates, picture(pose, seed=seed + 3), pose)
        ratios.append(errors(found, pose) / (np.sqrt(2) * found.sigma[found.found]))
    assert 0.3 < np.sqrt(np.mean(np.concatenate(ratios) ** 2)) < 1.5


@pytest.mark.parametrize("coarse", [True, False])
def test_cameras_aligned_together_stand_where_each_does_alone(templates: Templates, coarse: bool) -> None:
    pose = BASE_FROM_REST @ se3.exp(np.array([0.004, 0, 0.004, 0.3, -0.2, 0]))
    images = [Pyramid(picture(BASE_FROM_REST, camera=c)) for c in range(3)]
    whole = project_into(LENSES, range(3), np.stack([pose] * 3), POINTS, NORMALS, templates.axes)
    count = [len(POINTS)] * 3
    together = align_in(join([templates] * 3), images, count, whole, whole.centre, coarse=coarse)
    for c in range(3):
        where = project_squares(LENSES, c, pose, POINTS, NORMALS, templates.axes)
        alone = align(templates, images[c], where, where.centre, coarse=coarse)
        part = slice(c * len(POINTS), (c + 1) * len(POINTS))
        assert np.allclose(whole.centre[part], where.centre, atol=1e-9)
        both = together.found[part] & alone.found
        assert both.sum() >= max(15, 0.95 * alone.found.sum())
        change = np.linalg.norm(together.pixels[part] - alone.pixels, axis=1)[both]
        assert change.max() < CONVERGED_STEP


def test_what_is_seen_from_the_side_claims_less(templates: Templates) -> None:
    claims = []
    for tilt in (0.3, 0.0, -0.5):  # ever further from facing the camera
        pose = BASE_FROM_REST @ se3.exp(np.array([tilt, 0, 0, 0, 0, 0]))
        found, where = find(templates, picture(pose, seed=6), pose)
        slope = np.sqrt(1 / where.facing[found.found] ** 2 - 1)
        assert (found.sigma[found.found] >= 0.999 * RELIEF_PX * slope).all() and found.found.sum() > 40
        claims.append(float(np.median(found.sigma[found.found])))
    assert claims[0] < claims[1] < claims[2]


def test_a_patch_that_had_not_arrived_says_how_far_it_had_to_go(templates: Templates) -> None:
    begin = true_pixels(BASE_FROM_REST) + [2.6, 2.3]
    found, _ = find(templates, picture(BASE_FROM_REST, seed=4), BASE_FROM_REST, begin=begin, coarse=False)
    away = np.linalg.norm(found.pixels - true_pixels(BASE_FROM_REST), axis=1)
    short = found.found & (away > 0.3)
    assert found.found.sum() > 30 and short.sum() > 5
    assert 0.5 < np.median(away[short] / found.sigma[short]) < 2


def test_the_coarse_image_reaches_five_pixels_from_any_side(templates: Templates) -> None:
    image = picture(BASE_FROM_REST, seed=4)
    for angle in range(6):
        begin = true_pixels(BASE_FROM_REST) + 5.0 * np.array([np.cos(angle), np.sin(angle)])
        far, near = (find(templates, image, BASE_FROM_REST, begin=begin, coarse=coarse)[0] for coarse in (True, False))
        assert (errors(far, BASE_FROM_REST) < 0.5).sum() > 0.85 * len(POINTS)
        assert (errors(near, BASE_FROM_REST) < 0.5).sum() < 0.6 * len(POINTS)


def test_tracks_of_a_still_scene_never_creep(templates: Templates) -> None:
    """Each frame begins where the last one ended; after 60 the tracks stand where they stood after the first."""
    begin, mean = true_pixels(BASE_FROM_REST), []
    for seed in range(60):
        found, _ = find(templates, picture(BASE_FROM_REST, seed=10 + seed), BASE_FROM_REST, begin=begin, coarse=False)
        begin = np.where(found.found[:, None], found.pixels, true_pixels(BASE_FROM_REST))
        mean.append(begin - true_pixels(BASE_FROM_REST))
    early, late = np.mean(mean[:10], axis=0), np.mean(mean[-10:], axis=0)
    assert np.linalg.norm(late - early, axis=1).max() < 0.05 and np.linalg.norm(late.mean(0)) < 0.02


def test_hidden_patches_are_not_found(templates: Templates) -> None:
    image, pixels = picture(BASE_FROM_REST, seed=5), true_pixels(BASE_FROM_REST)
    edge = round(float(np.median(pixels[:, 0])))
    cloth = np.random.default_rng(6).integers(60, 200, image.shape, np.uint8)
    image[:, edge:] = cloth[:, edge:]
    found, where = find(templates, image, BASE_FROM_REST)
    hidden, clear = pixels[:, 0] > edge + 12, pixels[:, 0] < edge - 12
    assert not found.found[hidden].any() and hidden.sum() > 15
    assert found.found[clear & where.visible].mean() > 0.9


@pytest.mark.parametrize("level", [0, 128, 255])
def test_nothing_is_found_in_an_even_image(templates: Templates, level: int) -> None:
    found, _ = find(templates, np.full((480, 640), level, np.uint8), BASE_FROM_REST)
    assert not found.found.any() and np.isfinite(found.score).all()


@pytest.mark.parametrize("by", [(np.pi, 0, 0, 0, 0, 0), (0, 0, 0, 300.0, 0, 0)], ids=["back", "outside"])
def test_what_turned_its_back_or_left_the_image_is_not_visible(templates: Templates, by: tuple[float, ...]) -> None:
    found, where = find(templates, picture(BASE_FROM_REST), BASE_FROM_REST @ se3.exp(np.array(by)))
    assert not where.visible.any() and not found.found.any() and (not by[0] or (where.facing < 0).all())


def test_a_square_is_about_a_pixel_a_sample_in_its_own_camera(templates: Templates) -> None:
    where = project_squares(LENSES, 0, BASE_FROM_REST, POINTS, NORMALS, templates.axes)
    assert np.allclose(where.centre, true_pixels(BASE_FROM_REST), atol=1e-6)
    lengths = np.linalg.norm(where.per_sample, axis=1)
    assert (lengths < 1.1).all() and (lengths > 0.5).all()


def test_a_template_is_its_own_best_match(templates: Templates) -> None:
    where = project_squares(LENSES, 0, BASE_FROM_REST, POINTS, NORMALS, templates.axes)
    images = Pyramid(picture(BASE_FROM_REST))
    itself = align(templates, images, where, where.centre, coarse=False)
    assert np.abs(itself.pixels - where.centre)[itself.found].max() < 0.05 and itself.score[itself.found].min() > 0.999
    here = coarse_score(templates, images, where, where.centre)
    beside = coarse_score(templates, images, where, where.centre + 9.0)
    assert here.min() > 0.999 and beside.max() < 0.95


def test_pictures_are_freed_of_mean_and_contrast() -> None:
    raw = np.random.default_rng(1).normal(100, 20, (5, 225)).astype(np.float32)
    normal, contrast = normalise(raw)
    assert np.allclose(normal.mean(1), 0, atol=1e-4) and np.allclose(normal.std(1), 1, atol=1e-4)
    again, twice = normalise(2 * raw - 30)
    assert np.allclose(again, normal, atol=1e-4) and np.allclose(twice, 2 * contrast, rtol=1e-5)


def test_templates_can_be_taken_apart_and_joined(templates: Templates) -> None:
    odd = np.arange(len(templates)) % 2 == 1
    again = join([templates.take(odd), templates.take(~odd)])
    order = np.argsort(np.r_[np.flatnonzero(odd), np.flatnonzero(~odd)])
    for name in Templates.__slots__:
        assert np.array_equal(getattr(again.take(order), name), getattr(templates, name))


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
    found, ok = optical_flow(before, shifted(before, by), pixels, pixels)
    assert ok.all()
    assert np.abs(found - pixels - by).max() < 0.2


def test_what_something_else_has_covered_does_not_come_back_and_is_not_found() -> None:
    before, pixels = texture(0), grid()
    after = shifted(before, (3.0, 2.0))
    after[:, 160:] = texture(1)[:, 160:]
    found, ok = optical_flow(before, after, pixels, pixels)
    covered = pixels[:, 0] > 180
    assert ok[pixels[:, 0] < 130].all() and ok[covered].mean() < 0.3
    assert np.abs((found - pixels - (3.0, 2.0))[ok & (pixels[:, 0] < 130)]).max() < 0.3


def test_a_guess_that_is_far_off_is_mended_where_the_pyramid_reaches() -> None:
    before, pixels = texture(0), grid()
    found, ok = optical_flow(before, shifted(before, (20.0, 0.0)), pixels, pixels + [8.0, 6.0])
    assert ok.mean() > 0.9 and np.abs(found - pixels - (20.0, 0.0))[ok].max() < 0.3


def blobs(rng: np.random.Generator) -> tuple[Image, Array]:
    """A picture of round spots, and their middles (N, 2), px."""
    middles = grid()[::2] + rng.uniform(-3, 3, (len(grid()[::2]), 2))
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    picture = np.full(x.shape, 60.0)
    for (right, down), radius in zip(middles, rng.uniform(2.0, 3.5, len(middles)), strict=True):
        picture += 140 * np.exp(-((x - right) ** 2 + (y - down) ** 2) / (2 * radius**2))
    return np.asarray(np.clip(np.round(picture), 0, 255), np.uint8), middles


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("window", [None, (37, 21)])
def test_sift_finds_the_middle_of_a_spot_to_a_tenth_of_a_pixel(seed: int, window: tuple[int, int] | None) -> None:
    picture, middles = blobs(np.random.default_rng(seed))
    mask = None
    if window is not None:
        mask = np.zeros_like(picture)
        mask[window[1] :, window[0] :] = 255
    pixels, _ = sift(picture, mask)
    apart = pixels[:, None] - middles  # (N, M, 2)
    nearest = np.linalg.norm(apart, axis=2).argmin(1)
    off = apart[np.arange(len(pixels)), nearest]
    of_spots = np.abs(off).max(1) < 2  # not between them
    assert len(np.unique(nearest[of_spots])) > 0.7 * len(middles)
    assert np.abs(off[of_spots]).max() < 0.1 and np.abs(off[of_spots].mean(0)).max() < 0.01


def descriptors(count: int, seed: int) -> NDArray[np.float32]:
    raw = np.random.default_rng(seed).normal(0, 1, (count, 128)) ** 2
    return np.round(512 * raw / np.linalg.norm(raw, axis=1, keepdims=True)).astype(np.float32)


def test_trees_give_nearly_the_pairs_of_all_distances_and_the_same_every_time(monkeypatch: pytest.MonkeyPatch) -> None:
    a = descriptors(800, 0)
    b = np.concatenate([a[:400] + np.random.default_rng(1).normal(0, 12, (400, 128)), descriptors(400, 2)])
    b = b.astype(np.float32)
    exact = match(a, b)
    monkeypatch.setattr(features, "MAX_BRUTE_FORCE_DISTANCES", 0)
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
    filtered = PREFILTERS[BILATERAL_PREFILTER](np.asarray(np.clip(image, 0, 255), np.uint8)).astype(float)
    assert filtered[:, 20:140].std() < 0.5 * image[:, 20:140].std()
    assert filtered[:, 164:].mean() - filtered[:, :156].mean() > 120
    same = texture(0)
    assert PREFILTERS[NO_PREFILTER](same) is same


@given(st.lists(st.tuples(st.floats(-5, 5) | st.just(np.nan), st.booleans()), min_size=1, max_size=40))
def test_the_median_for_loops_is_numpys_and_ends_whatever_it_is_given(
    drawn: list[tuple[float, bool]],
) -> None:
    values, chosen = np.array([v for v, _ in drawn]), np.array([c for _, c in drawn])
    chosen[0] = True
    kept, before = values[chosen], values.copy()
    found = median_of(values, chosen)
    np.testing.assert_array_equal(values, before)
    if not np.isnan(kept).any():
        assert found == np.partition(kept, len(kept) // 2)[len(kept) // 2]
