"""What the wound network learns from: labelled pictures, groups that show one wound, samples and covers."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from perception.training.augmentation import Augmentation, pyramid, sample
from perception.training.dataset import Labelled, read_dataset
from perception.training.groups import groups, split
from perception.training.healthy import MARGIN, SIDES, healthy_pieces
from perception.training.judging import half_covered, half_covered_fall, scores, silent
from perception.training.light import relit
from perception.training.occluders import covered
from perception.wound.segmentation import Segmentation
from tests.test_segmentation import disc, picture


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
    assert only.name == "set/a.jpg"
    assert np.allclose(only.picture.shape[:2], (100, 120), atol=2)
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
    number = groups([first, stranger, mirrored, turned, shifted])
    assert len({number[k] for k in (0, 2, 3, 4)}) == 1
    assert number[1] != number[0]


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 12), min_size=1, max_size=60), st.integers(0, 40), st.integers(0, 99))
def test_a_split_never_parts_a_group_and_holds_out_enough(numbers: list[int], wanted: int, seed: int) -> None:
    group = np.array(numbers)
    held = split(group, wanted, np.random.default_rng(seed))
    assert held.sum() >= min(wanted, len(group))
    assert not set(group[held]) & set(group[~held])


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.booleans())
def test_a_sample_has_its_size_and_its_wound_stays_on_the_wound(seed: int, wounded: bool) -> None:
    source = pyramid(labelled(seed, wounded))
    how = Augmentation(cover=0.0)
    rng = np.random.default_rng(seed)
    seen, wound = sample(source, source, how, rng)
    assert seen.shape == (192, 192, 3) and wound.shape == (192, 192)
    if not wounded:
        assert not wound.any()
    inside = cv2.erode((wound == 255).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    outside = cv2.dilate((wound > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) == 0
    if inside.sum() > 50 and outside.sum() > 50:
        redness = seen[..., 0].astype(float) - seen[..., 1]
        if redness.std() > 8:  # else the sample lost its colour
            assert np.median(redness[inside]) > np.median(redness[outside])


def test_samples_are_the_same_for_the_same_seed() -> None:
    source = pyramid(labelled(5))
    first, second = (sample(source, source, Augmentation(), np.random.default_rng(9)) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_what_is_covered_is_no_wound_and_the_rest_is_left_alone() -> None:
    each = labelled(3, size=(192, 192))
    mask = each.wound.astype(np.uint8) * np.uint8(255)
    changed = 0
    for seed in range(20):
        seen, wound = covered(each.picture, mask, each.picture, np.random.default_rng(seed))
        assert not (wound > mask).any()
        gone = (mask > 0) & (wound == 0)
        changed += gone.any()
        if gone.sum() > 100:
            assert np.abs(seen[gone].astype(float) - each.picture[gone]).mean() > 3
    assert changed > 8


def test_light_changes_colours_and_not_places() -> None:
    each = labelled(4)
    means = [relit(each.picture, np.random.default_rng(seed)).mean() for seed in range(12)]
    assert np.std(means) > 5


def test_healthy_pieces_keep_away_from_the_wound() -> None:
    pictures = [labelled(seed) for seed in range(6)]
    pieces = healthy_pieces(pictures, np.random.default_rng(0), 4)
    assert 0 < len(pieces) <= 4
    for piece in pieces:
        assert SIDES[0] <= piece.shape[0] <= SIDES[1]
        redness = piece[..., 0].astype(int) - piece[..., 1]
        assert (redness > 120).mean() < 0.001, f"wound within {MARGIN} px"


@given(st.integers(0, 10**6))
@settings(max_examples=12, deadline=None)
def test_half_covered_hides_half_of_the_wound(seed: int) -> None:
    each = labelled(seed)
    _, cover = half_covered(each, np.random.default_rng(seed))
    assert (each.wound & cover).sum() / each.wound.sum() == pytest.approx(0.5, abs=0.12)


def test_a_segmenter_that_knows_the_truth_scores_one_and_one_that_sees_wounds_everywhere_nothing() -> None:
    pictures = [labelled(1), labelled(2, wounded=False)]

    def red(image: np.ndarray) -> Segmentation:
        return Segmentation(image[..., 2].astype(int) - image[..., 1] > 110, 1.0, 0.7)

    def everything(image: np.ndarray) -> Segmentation:
        return Segmentation(np.ones(image.shape[:2], bool), 1.0, 0.7)

    assert scores(red, pictures, lambda done, of: None) == pytest.approx([1, 1], abs=0.01)
    assert scores(everything, pictures, lambda done, of: None)[1] == 0
    assert silent(red, [pictures[1].picture]) == 1 and silent(everything, [pictures[1].picture]) == 0
    before, after = half_covered_fall(red, pictures, np.random.default_rng(0))
    assert before == pytest.approx(1, abs=0.01) and after == pytest.approx(1, abs=0.02)
