"""Labelled pictures, groups and folds, and how networks are judged; segmentation by shape; tracking by the wound's
place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.pose import TrackState
from estimation.scans.scan import scan_from_triangles
from perception.frames import FrameSet, Image, Roi
from perception.mapping.features import polygon_mask
from perception.tracking.step import TrackingStep
from perception.tracking.wound_step import MAX_EMPTY_LOOKS, RegionSearch, RegionTrackingStep
from perception.training.dataset import (
    PIECE_SIDES_PX,
    WOUND_MARGIN_PX,
    Augmentation,
    Labelled,
    Samples,
    fold_numbers,
    healthy_pieces,
    picture_groups,
    read_dataset,
)
from perception.training.metrics import (
    HeldOutPredictions,
    calibration_error,
    cover_half,
    dice_before_and_after_cover,
    dice_scores,
    evaluate_folds,
    silent_share,
)
from perception.wound.network import Looks, shipped_model
from perception.wound.segmentation import (
    SHEET_CELL_PX,
    SHEET_COLUMNS,
    EvaluatedPicture,
    Segmentation,
    contact_sheet,
    dice,
)
from perception.wound.shape_matching import (
    COLOUR_TERMS,
    OUTLINE_FEATURES,
    RANK_TERMS,
    ShapeSegmenter,
    find_outlines,
    largest_outline,
    outline_features,
    products,
    read_shape_model,
    refine_outline,
    scan_outline,
    small_picture,
    thesis_mask,
)
from tests.test_segmentation import disc, picture
from tests.test_tracking import RIG, ROIS, run, same, shot


def labelled(seed: int, wounded: bool = True, size: tuple[int, int] = (240, 320)) -> Labelled:
    """A grey room of its own, skin in the middle, a red disc on it."""
    rng = np.random.default_rng(seed)
    grey = cv2.resize(rng.integers(30, 200, (6, 8), np.uint8), size[::-1], interpolation=cv2.INTER_CUBIC)
    room = np.dstack([grey, grey, grey])
    room[disc(size, (size[1] // 2, size[0] // 2), 110)] = (205, 160, 140)
    centre = int(rng.integers(110, 210)), int(rng.integers(90, 150))
    wound = disc(size, centre, int(rng.integers(10, 25))) & wounded
    room[wound] = (200, 30, 30)
    noise = rng.normal(0, 3, room.shape)
    return Labelled(f"made/{seed}", np.clip(room + noise, 0, 255).astype(np.uint8), wound)


def write(folder: Path, name: str, picture: np.ndarray, mask: np.ndarray | None) -> None:
    for part in ("images", "labels"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "images" / f"{name}.jpg"), picture)
    if mask is not None:
        cv2.imwrite(str(folder / "labels" / f"{name}.png"), mask)


@pytest.mark.parametrize("white", [1, 255])
def test_masks_of_ones_and_of_255_read_alike_and_padding_is_cut_off_both(tmp_path: Path, white: int) -> None:
    image, truth = picture((60, 50), 20, (100, 120))
    padded, mask = np.zeros((160, 160, 3), np.uint8), np.zeros((160, 160), np.uint8)
    padded[:100, 20:140], mask[:100, 20:140] = image, truth * white
    write(tmp_path / "set", "a", padded, mask)
    (only,) = read_dataset(tmp_path / "set")
    assert only.name == "set/a.jpg" and np.allclose(only.picture.shape[:2], (100, 120), atol=2)
    assert only.wound.sum() == truth.sum()


def test_what_is_wrong_with_a_data_set_is_told_by_the_file(tmp_path: Path) -> None:
    image, truth = picture((60, 50), 20, (100, 120))
    with pytest.raises(InputError, match="no such folder"):
        read_dataset(tmp_path / "gone")
    (tmp_path / "set/images").mkdir(parents=True)
    with pytest.raises(InputError, match="pictures = 'none'"):
        read_dataset(tmp_path / "set")
    write(tmp_path / "set", "a", image, None)
    with pytest.raises(InputError, match=r"a\.jpg: mask"):
        read_dataset(tmp_path / "set")
    write(tmp_path / "set", "a", image, truth[:50].astype(np.uint8))
    with pytest.raises(InputError, match="size"):
        read_dataset(tmp_path / "set")
    (tmp_path / "set/images/a.jpg").write_bytes(b"nothing")
    with pytest.raises(InputError, match="unreadable"):
        read_dataset(tmp_path / "set")


def test_copies_mirror_images_and_shifted_views_are_one_group_and_strangers_are_not() -> None:
    first, stranger = labelled(1), labelled(2)
    mirrored = Labelled("m", np.ascontiguousarray(first.picture[:, ::-1]), first.wound[:, ::-1])
    turned = Labelled("t", np.ascontiguousarray(np.rot90(first.picture)), np.rot90(first.wound))
    shifted = Labelled("s", np.roll(first.picture, 6, 1), np.roll(first.wound, 6, 1))
    number = picture_groups([first, stranger, mirrored, turned, shifted])
    assert len({number[k] for k in (0, 2, 3, 4)}) == 1
    assert number[1] != number[0]


@settings(max_examples=40)
@given(st.lists(st.integers(0, 12), min_size=1, max_size=60), st.integers(2, 6), st.integers(0, 99))
def test_folds_never_part_a_group_and_are_as_full_as_groups_allow(numbers: list[int], folds: int, seed: int) -> None:
    group = np.array(numbers)
    fold = fold_numbers(group, folds, np.random.default_rng(seed))
    assert all(len(set(fold[group == each])) == 1 for each in group)
    filled = np.bincount(fold, minlength=folds)
    assert len(filled) == folds and filled.max() - filled.min() <= np.bincount(group).max()


def test_healthy_pieces_keep_away_from_the_wound() -> None:
    pictures = [labelled(seed) for seed in range(6)]
    pieces = healthy_pieces(pictures, np.random.default_rng(0), 4)
    assert 0 < len(pieces) <= 4
    for piece in pieces:
        assert PIECE_SIDES_PX[0] <= piece.shape[0] <= PIECE_SIDES_PX[1]
        redness = piece[..., 0].astype(int) - piece[..., 1]
        assert (redness > 120).mean() < 0.001, f"wound within {WOUND_MARGIN_PX} px"


def drawn(pictures: Sequence[Labelled], count: int, how: Augmentation, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Pictures (N, 3, side, side) and wounds (N, side, side) of the first `count` samples."""
    samples = Samples(pictures, np.ones(len(pictures)), how, seed)
    pairs = [samples[number] for number in range(count)]
    return np.stack([shown for shown, _ in pairs]), np.stack([wound[0] for _, wound in pairs])


@pytest.mark.parametrize("wounded", [True, False])
@pytest.mark.parametrize("seed", range(6))
def test_a_sample_has_its_size_and_its_wound_stays_on_the_wound(seed: int, wounded: bool) -> None:
    pictures, wounds = drawn([labelled(seed, wounded)], 6, Augmentation(side=192, cover=0.0), seed)
    assert pictures.shape == (6, 3, 192, 192) and wounds.shape == (6, 192, 192)
    assert pictures.dtype == wounds.dtype == np.float32
    assert pictures.min() >= 0 and pictures.max() <= 1
    if not wounded:
        assert not wounds.any()
    for shown, wound in zip(pictures, wounds, strict=True):
        inside = cv2.erode((wound > 0.99).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        outside = cv2.dilate((wound > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) == 0
        redness = shown[0] - shown[1]
        if inside.sum() > 50 and outside.sum() > 50 and redness.std() > 0.03:  # else the sample lost its colour
            assert np.median(redness[inside]) > np.median(redness[outside])


def test_a_sample_is_the_same_for_the_same_seed_and_number_and_none_like_another() -> None:
    pictures = [labelled(seed) for seed in range(4)]
    first, second = (Samples(pictures, np.ones(4), Augmentation(side=64), 9) for _ in range(2))
    backwards = [second[number] for number in (3, 2, 1, 0)][::-1]
    for number, again in enumerate(backwards):
        assert all(np.array_equal(a, b) for a, b in zip(first[number], again, strict=True))
    other = Samples(pictures, np.ones(4), Augmentation(side=64), 10)
    assert len({float(each[k][0].mean()) for each in (first, other) for k in range(4)}) == 8


def test_what_covers_a_wound_hides_it_or_brings_its_own() -> None:
    """The same views with and without covers: where a cover's own wound is not, less is labelled."""
    pictures = [labelled(seed) for seed in range(4)]
    bare, covered = (
        drawn(pictures, 32, Augmentation(side=96, whole=0.0, away=0.0, cover=share), 4)[1] for share in (0.0, 1.0)
    )
    hidden = ((bare > 0.5) & (covered < 0.5)).any((1, 2))
    brought = ((bare < 0.5) & (covered > 0.5)).any((1, 2))
    assert hidden.mean() > 0.4 and 0 < brought.mean() < hidden.mean()
    assert covered.sum() / bare.sum() < 0.9


def test_beyond_the_edge_of_a_picture_a_sample_is_a_mirror_or_black_with_no_fringe() -> None:
    each = labelled(0)
    all_wound = Labelled(each.name, each.picture, np.ones_like(each.wound))
    wounds = drawn([all_wound], 24, Augmentation(side=96, long_side=96.0, whole=1.0, away=0.0, cover=0.0), 2)[1]
    assert ((wounds < 1e-4) | (wounds > 1 - 1e-4)).all()
    black = (wounds < 0.5).mean((1, 2)) > 0
    assert 4 < black.sum() < 20


def test_the_scale_of_a_sample_is_that_of_the_look_it_stands_for() -> None:
    """A whole picture is about as long as the first look's; a wound takes the second look's share of the window."""
    each = labelled(0, size=(480, 640))
    whole = drawn([each], 60, Augmentation(side=384, whole=1.0, away=0.0, cover=0.0, stretch=0.0), 1)[1]
    parts = [cv2.connectedComponentsWithStats((wound > 0.5).astype(np.uint8))[2][1:, 4] for wound in whole]
    seen = [areas.max() for areas in parts if len(areas)]  # alone: the picture's edge as a mirror shows it twice
    assert np.median(seen) == pytest.approx(each.wound.sum() * (320 / 640) ** 2, rel=0.2)
    part = np.s_[40:200, 60:260]  # three times as large, so that the largest scale limits nothing
    large = [plane[part].repeat(3, 0).repeat(3, 1) for plane in (labelled(0).picture, labelled(0).wound)]
    near = drawn([Labelled("large", *large)], 60, Augmentation(whole=0.0, away=0.0, cover=0.0, stretch=0.0), 1)[1]
    shares = 2 * (near.sum((1, 2)) / np.pi) ** 0.5 / 256
    assert np.quantile(shares, 0.1) > 0.15 and np.quantile(shares, 0.9) < 0.95 and shares.std() > 0.1


@given(st.integers(0, 10**6))
@settings(max_examples=12)
def test_half_covered_hides_half_of_the_wound(seed: int) -> None:
    each = labelled(seed)
    _, cover = cover_half(each, np.random.default_rng(seed))
    assert (each.wound & cover).sum() / each.wound.sum() == pytest.approx(0.5, abs=0.12)


def predictions(seed: int, sureness: float, pieces: int = 40) -> HeldOutPredictions:
    """Pictures of a disc, found at logits near `sureness`, and of nothing, of which some is faintly taken for one."""
    rng = np.random.default_rng(seed)
    logits, wounds, piece = [], [], []
    for number in range(60 + pieces):
        wound = disc((48, 64), (int(rng.integers(16, 48)), 24), int(rng.integers(6, 12)))
        seen = np.where(wound, rng.normal(sureness, 1), -6.0) + rng.normal(0, 0.3, wound.shape)
        kind = number % 12 if number < 60 else 11
        if kind == 11:  # nothing there, and now and then something faint is taken for it
            wound = np.zeros_like(wound)
            faint = disc((48, 64), (32, 24), 5) if rng.random() < 0.2 else wound
            seen = np.where(faint, 1.0, -6.0)
        logits.append(seen.astype(np.float16))
        wounds.append(wound)
        piece.append(number >= 60)
    return HeldOutPredictions(logits, wounds, np.arange(60 + pieces) % 3, np.array(piece))


def test_judged_by_folds_faint_masks_of_nothing_are_kept_silent_about_and_wounds_are_not() -> None:
    settings, judged = evaluate_folds(predictions(1, 5.0), Looks(), np.random.default_rng(0))
    assert 0 < settings.trust < 1 and settings.slope > 0 and judged.silent_share == 1
    assert len(judged.dice) == 60 and judged.dice.mean() > 0.95
    assert judged.confidence[judged.correct].min() > judged.confidence[~judged.correct].max()
    assert calibration_error(judged.confidence, judged.correct) < 0.1


def test_a_fold_is_judged_by_settings_that_never_saw_it() -> None:
    """Wounds of one fold are as faint as what other folds have taught to keep silent about."""
    seen = predictions(2, 5.0)
    parts = zip(seen.logits, seen.wounds, seen.fold, strict=True)
    faint = [np.where(wound, 1.0, -6.0).astype(np.float16) if fold == 0 else each for each, wound, fold in parts]
    _, judged = evaluate_folds(
        HeldOutPredictions(faint, seen.wounds, seen.fold, seen.healthy), Looks(), np.random.default_rng(0)
    )
    wounded = np.array([wound.any() for wound in seen.wounds])[~seen.healthy]
    assert judged.dice[wounded & (seen.fold[~seen.healthy] == 0)].max() == 0
    assert judged.dice[seen.fold[~seen.healthy] != 0].mean() > 0.6


@given(st.integers(0, 10**6))
@settings(max_examples=20)
def test_the_calibration_error_is_nothing_for_the_honest_and_the_gap_for_the_boastful(seed: int) -> None:
    rng = np.random.default_rng(seed)
    said = rng.uniform(0, 1, 20_000)
    assert calibration_error(said, rng.random(len(said)) < said) < 0.03
    boast = np.full(len(said), 0.95)
    assert calibration_error(boast, rng.random(len(said)) < 0.6) == pytest.approx(0.35, abs=0.02)


def test_pixels_that_boast_are_brought_to_how_often_they_are_right() -> None:
    rng = np.random.default_rng(3)
    honest = predictions(4, 3.0)
    noisy = [
        np.where(rng.random(w.shape) < 0.15, -each, each) for each, w in zip(honest.logits, honest.wounds, strict=True)
    ]
    settings, judged = evaluate_folds(
        HeldOutPredictions(noisy, honest.wounds, honest.fold, honest.healthy), Looks(), rng
    )
    assert settings.pixel_slope < 0.8
    assert calibration_error(judged.pixel_probability, judged.pixel_wound) < 0.05


def test_a_segmenter_that_knows_the_truth_scores_one_and_one_that_sees_wounds_everywhere_nothing() -> None:
    pictures = [labelled(1), labelled(2, wounded=False)]

    def red(image: np.ndarray) -> Segmentation:
        return Segmentation(image[..., 2].astype(int) - image[..., 1] > 110, 1.0, 0.7)

    def everything(image: np.ndarray) -> Segmentation:
        return Segmentation(np.ones(image.shape[:2], bool), 1.0, 0.7)

    assert dice_scores(red, pictures, lambda done, of: None) == pytest.approx([1, 1], abs=0.01)
    assert dice_scores(everything, pictures, lambda done, of: None)[1] == 0
    assert silent_share(red, [pictures[1].picture]) == 1 and silent_share(everything, [pictures[1].picture]) == 0
    before, after = dice_before_and_after_cover(red, pictures, np.random.default_rng(0))
    assert before == pytest.approx(1, abs=0.01) and after == pytest.approx(1, abs=0.02)


def ellipse(size: tuple[int, int], centre: tuple[int, int], axes: tuple[int, int], angle: float = 0) -> np.ndarray:
    mask = np.zeros(size, np.uint8)
    cv2.ellipse(mask, centre, axes, angle, 0, 360, 1, -1)
    return mask > 0


def test_the_thesis_method_finds_the_drawn_shape_among_others() -> None:
    image = np.full((300, 400), 200, np.uint8)
    wanted, other = ellipse((300, 400), (100, 150), (60, 20)), ellipse((300, 400), (280, 150), (45, 40))
    image[wanted | other] = 90
    found = thesis_mask(image, largest_outline(ellipse((200, 200), (100, 100), (90, 30), 40)))
    assert dice(found, wanted) > 0.85
    assert dice(thesis_mask(image, largest_outline(ellipse((200, 200), (100, 100), (90, 80)))), other) > 0.85


def test_the_outlines_of_a_coloured_disc_hold_the_disc_itself() -> None:
    model = read_shape_model(shipped_model("shape", ".toml"))
    image, truth = picture((120, 90), 30, (200, 256))
    scene = small_picture(np.ascontiguousarray(image[..., ::-1]), model.colour)
    best = 0.0
    for outline in find_outlines(scene):
        mask = np.zeros(truth.shape, np.uint8)
        cv2.drawContours(mask, [outline], -1, 1, -1)
        best = max(best, dice(mask > 0, truth))
        assert outline_features(scene, outline, list(model.patterns), None).shape == (OUTLINE_FEATURES,)
    assert best > 0.95


def test_a_description_does_not_depend_on_the_patterns_scale_or_turn() -> None:
    image, _ = picture((120, 90), 30, (200, 256))
    model = read_shape_model(shipped_model("shape", ".toml"))
    scene = small_picture(np.ascontiguousarray(image[..., ::-1]), model.colour)
    outline = find_outlines(scene)[0]
    small, large = (largest_outline(ellipse((400, 400), (200, 200), (20 * k, 8 * k), 30 * k)) for k in (2, 5))
    little, much = (outline_features(scene, outline, [pattern], None) for pattern in (small, large))
    assert np.allclose(little, much, atol=0.1)


def test_an_edge_that_was_drawn_too_wide_settles_where_the_colours_part() -> None:
    image, truth = picture((120, 90), 30, (200, 256))
    lab = cv2.cvtColor(image, cv2.COLOR_BGR2LAB).astype(np.float32)
    wide = largest_outline(disc((200, 256), (120, 90), 33))
    assert dice(refine_outline(lab, wide), truth) > dice(disc((200, 256), (120, 90), 33), truth)


def test_the_segmenter_answers_with_a_mask_of_the_pictures_size_and_the_same_twice() -> None:
    segmenter = ShapeSegmenter(read_shape_model(shipped_model("shape", ".toml")))
    image, _ = picture((300, 200), 60)
    first, second = segmenter(image), segmenter(image)
    assert first.mask.shape == (480, 640)
    assert np.array_equal(first.mask, second.mask) and first.confidence == second.confidence


def test_a_picture_of_one_colour_shows_no_wound() -> None:
    found = ShapeSegmenter(read_shape_model(shipped_model("shape", ".toml")))(np.full((90, 120, 3), 128, np.uint8))
    assert not found.found


def test_the_outline_of_a_scan_is_its_topmost_layers() -> None:
    """The thesis's own simulated scan: elliptic, radii (0.25, 0.8) on top and (0.1, 0.15) below, 0.3 deep."""
    angle, depth = np.meshgrid(np.linspace(0, 2 * np.pi, 60, endpoint=False), np.linspace(0, 1, 40))
    wide, long = 0.25 - 0.15 * depth, 0.8 - 0.65 * depth
    points = np.stack([wide * np.cos(angle), long * np.sin(angle), -0.3 * depth], -1).reshape(-1, 3) * 40
    triangles = [(i, i + 1, i + 60) for i in range(len(points) - 61)]
    pattern, area = scan_outline(scan_from_triangles(points, np.array(triangles)))
    _, _, width, height = cv2.boundingRect(pattern)
    assert width / height == pytest.approx(0.25 / 0.8, rel=0.1)
    assert area == pytest.approx(np.pi * 10 * 32, rel=0.05)


def test_a_model_that_is_none_or_whose_numbers_are_not_finite_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "shape.toml"
    for text in ("", "colour = 3", "colour = [1.0]\nrank = [1.0]\nrank_usual = [1.0]\ntrust = 0.4\npatterns = []"):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match="shape model"):
            read_shape_model(file)
    file.write_text(model_text(), encoding="utf-8")
    assert len(read_shape_model(file).patterns) == 1
    wrong = [{key: word} for key in ("trust", "colour", "corner") for word in ("inf", "nan", "9" * 400)]
    for each in [*wrong, {"corner": "9" * 30}]:
        file.write_text(model_text(**each), encoding="utf-8")
        with pytest.raises(InputError, match="shape model"):
            read_shape_model(file)


def model_text(trust: str = "0.4", colour: str = "1.0", corner: str = "1") -> str:
    rank = ", ".join(["1.0"] * RANK_TERMS)
    lists = f"colour = [{', '.join([colour] * COLOUR_TERMS)}]\nrank = [{rank}]\nrank_usual = [{rank}]\n"
    return f"trust = {trust}\n{lists}patterns = [[[{corner}, 1], [2, 2], [3, 1]]]\n"


def test_products_are_all_pairs_and_begin_with_one() -> None:
    assert np.array_equal(products(np.array([[2.0, 3.0]])), [[1, 2, 3, 4, 6, 9]])


class Sees:
    """A segmenter that knows where the surface is; `cameras` are those in which it finds it."""

    def __init__(self, sets: Sequence[FrameSet], cameras: Sequence[int]) -> None:
        self._camera = {id(f.image): f.camera for frames in sets for f in frames.frames}
        self._cameras = cameras

    def __call__(self, image: Image) -> Segmentation:
        camera = self._camera[id(image)]
        mask = polygon_mask(RIG.cameras[camera].size, ROIS[camera].polygon) > 0
        found = camera in self._cameras
        return Segmentation(mask & found, float(found), 0.7 if found else np.nan)


def first_step(sets: Sequence[FrameSet], cameras: Sequence[int]) -> tuple[RegionTrackingStep, list[tuple[Roi, ...]]]:
    asked: list[tuple[Roi, ...]] = []

    def made(rois: Sequence[Roi]) -> TrackingStep:
        asked.append(tuple(rois))
        return TrackingStep(RIG, rois)

    return RegionTrackingStep(RIG, made, RegionSearch(RIG, Sees(sets, cameras))), asked


@pytest.mark.slow
def test_the_surface_is_tracked_where_the_wound_was_seen() -> None:
    sets = shot(stamps=np.arange(9) / 10)
    step, asked = first_step(sets, (0, 1, 2))
    poses = []
    for frames in sets:
        poses.append(step(frames))
        step.idle()
    assert [p.state for p in poses[:3]] == [TrackState.INITIALISING] * 3
    assert "looked for" in poses[0].reason
    assert poses[-1].state is TrackState.TRACKING
    (rois,) = asked
    for roi, told in zip(rois, ROIS, strict=True):
        size = np.array(RIG.cameras[roi.camera].size)
        inside = np.clip(told.polygon, 0, size - 1)
        assert (roi.polygon.min(0) <= inside.min(0)).all() and (roi.polygon.max(0) >= inside.max(0)).all()
    begun = [sets[0], *sets[3:]]  # with the pictures in which the wound was seen
    assert all(same(a, b) for a, b in zip(poses[3:], run(begun, rois)[1:], strict=True))


@pytest.mark.slow
def test_without_a_wound_in_two_cameras_the_whole_pictures_are_taken() -> None:
    sets = shot(stamps=np.arange(3 * MAX_EMPTY_LOOKS + 1) / 10)
    step, asked = first_step(sets, (1,))
    for frames in sets:
        step(frames)
    (rois,) = asked
    for roi, camera in zip(rois, RIG.cameras, strict=True):
        assert np.ptp(roi.polygon, axis=0).tolist() == list(camera.size)


@pytest.mark.slow
def test_a_camera_that_does_not_see_the_wound_is_searched_whole() -> None:
    sets = shot(stamps=np.arange(4) / 10)
    step, asked = first_step(sets, (0, 2))
    for frames in sets:
        step(frames)
    ((first, second, third),) = asked
    assert np.array_equal(second.polygon.max(0), RIG.cameras[1].size)
    assert (third.polygon.max(0) < RIG.cameras[2].size).any() and first.stamp == sets[0].stamp


def test_a_contact_sheet_has_three_rows_however_few_pictures_there_are() -> None:
    image, truth = picture((60, 50), 20, (100, 120))
    shown = [EvaluatedPicture(image, Segmentation(disc((100, 120), (60, 50), r), 0.9, 0.7), truth) for r in (20, 10, 4)]
    assert contact_sheet(shown).shape == (3 * SHEET_CELL_PX, SHEET_COLUMNS * SHEET_CELL_PX, 3)
    nothing = EvaluatedPicture(image, Segmentation(truth & False, 0.0, np.nan), truth & False)
    assert contact_sheet([nothing]).dtype == np.uint8
