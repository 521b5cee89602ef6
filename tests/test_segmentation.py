"""Finding the wound: two looks, thresholds, parts, confidence, silence, regions, areas, and belief over time."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.rig import pixels_from_points
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.simulator.scene.render import mask_from_outlines
from perception.frames import Frame, FrameSet
from perception.tracking.wound_step import MAX_MISSED_LOOKS, AsyncSegmentation, WoundFilter, overlap
from perception.wound.network import Looks, Settings, window, wound_logits
from perception.wound.segmentation import (
    NetworkSegmenter,
    Segmentation,
    area_on_plane,
    box_of,
    centroid,
    dice,
    largest_part,
    picture_box,
    region,
    segmentation_from_logits,
)

SETTINGS = Settings(trust=0.3)
SIDES = st.integers(8, 900)


def red_is_wound(planes: np.ndarray) -> np.ndarray:
    """A network that knows one thing."""
    redness = planes[:, :1] - planes[:, 1:2]
    return np.asarray(20 * (redness - 0.3), np.float32)


def picture(centre: tuple[int, int], radius: int, size: tuple[int, int] = (480, 640)) -> tuple[np.ndarray, np.ndarray]:
    """BGR picture of skin with a red disc, and where that is; size: (H, W)."""
    image, wound = np.full((*size, 3), (150, 170, 200), np.uint8), disc(size, centre, radius)
    image[wound] = (30, 30, 200)
    return image, wound


def disc(size: tuple[int, int], centre: tuple[int, int], radius: float) -> np.ndarray:
    rows, columns = np.mgrid[: size[0], : size[1]]
    return np.asarray((columns - centre[0]) ** 2 + (rows - centre[1]) ** 2 <= radius**2)


@given(st.data(), SIDES, SIDES)
def test_the_second_look_lies_in_the_picture_and_holds_the_wound(data: st.DataObject, rows: int, columns: int) -> None:
    top, left = data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, columns - 1))
    bottom, right = data.draw(st.integers(top + 1, rows)), data.draw(st.integers(left + 1, columns))
    down, across = window(np.array([top, left, bottom, right], float), (rows, columns), Looks())
    assert 0 <= down.start <= top and bottom <= down.stop <= rows
    assert 0 <= across.start <= left and right <= across.stop <= columns


@pytest.mark.parametrize("radius", [6, 12, 40, 150])
def test_a_wound_of_any_size_is_found_to_a_pixel(radius: int) -> None:
    image, truth = picture((400, 200), radius)
    found = NetworkSegmenter(red_is_wound, SETTINGS)(image)
    assert dice(found.mask, truth) > 1 - 1.2 / radius
    assert found.confidence > 0.9


def test_a_second_look_makes_a_small_wound_sharper() -> None:
    image, truth = picture((403, 203), 7)
    both, one = (NetworkSegmenter(red_is_wound, Settings(Looks(window=w), trust=0.3))(image) for w in (192, 0))
    assert dice(both.mask, truth) > dice(one.mask, truth)


def test_a_grey_picture_and_one_of_eight_pixels_are_looked_at_too() -> None:
    for image in (np.full((90, 120), 128, np.uint8), np.zeros((8, 8, 3), np.uint8)):
        found = NetworkSegmenter(red_is_wound, SETTINGS)(image)
        assert found.mask.shape == image.shape[:2] and not found.found


def test_padding_is_not_looked_at() -> None:
    image, truth = picture((150, 150), 30, (300, 300))
    padded = np.zeros((512, 512, 3), np.uint8)
    padded[:300, 100:400] = image
    seen: list[tuple[int, ...]] = []

    def network(planes: np.ndarray) -> np.ndarray:
        seen.append(planes.shape)
        return red_is_wound(planes)

    found = NetworkSegmenter(network, SETTINGS)(padded)
    assert seen[0] == (1, 3, 288, 288)
    assert dice(found.mask[:300, 100:400], truth) > 0.95


def test_a_picture_nearly_all_dark_is_kept_whole() -> None:
    image = np.zeros((100, 100, 3), np.uint8)
    image[40:50, 40:50] = 200
    assert picture_box(image) == (slice(0, 100), slice(0, 100))


@pytest.mark.parametrize(("probability", "threshold"), [(0.95, 0.7), (0.65, 0.6), (0.35, 0.3), (0.15, 0.1)])
def test_the_threshold_falls_from_seven_tenths_until_something_is_found(probability: float, threshold: float) -> None:
    logits = np.full((60, 60), -8.0, np.float32)
    logits[disc((60, 60), (30, 30), 12)] = np.log(probability / (1 - probability))
    found = segmentation_from_logits(logits, Settings(trust=0.0))
    assert found.threshold == pytest.approx(threshold)
    assert found.mask.sum() == disc((60, 60), (30, 30), 12).sum()


def test_below_a_tenth_and_where_it_fills_the_whole_picture_there_is_no_wound() -> None:
    assert not segmentation_from_logits(np.full((60, 60), np.log(0.09 / 0.91), np.float32), Settings(trust=0.0)).found
    assert not segmentation_from_logits(np.full((60, 60), 5.0, np.float32), SETTINGS).found


def test_an_unsure_wound_is_kept_silent_about_but_its_confidence_told() -> None:
    logits = np.full((60, 60), -8.0, np.float32)
    logits[20:30, 20:30] = 0.5
    unsure = segmentation_from_logits(logits, Settings(trust=0.9))
    assert not unsure.found and 0.5 < unsure.confidence < 0.9 and np.isnan(unsure.threshold)
    assert segmentation_from_logits(logits, Settings(trust=0.5)).found


def test_specks_are_dropped_and_a_second_wound_is_kept() -> None:
    logits = np.full((100, 100), -8.0, np.float32)
    large, second, speck = disc((100, 100), (30, 30), 15), disc((100, 100), (75, 75), 8), disc((100, 100), (90, 10), 2)
    logits[large | second | speck] = 4.0
    found = segmentation_from_logits(logits, Settings(trust=0.0, smallest=0.05)).mask
    assert np.array_equal(found, large | second)
    assert np.array_equal(largest_part(found), large)


def test_the_centroid_is_the_mean_of_the_pixels() -> None:
    assert np.allclose(centroid(disc((80, 90), (41, 33), 11)), (41, 33), atol=1e-9)
    assert np.isnan(centroid(np.zeros((5, 5), bool))).all()


def test_two_empty_masks_agree_and_an_empty_one_with_another_does_not() -> None:
    empty, full = np.zeros((4, 4), bool), np.ones((4, 4), bool)
    assert dice(empty, empty) == 1 and dice(empty, full) == 0 and dice(full, full) == 1


BOXES = st.tuples(st.integers(-50, 700), st.integers(-50, 500), st.integers(1, 300), st.integers(1, 300))


@given(BOXES, st.none() | BOXES, st.integers(0, 60), st.integers(1, 700), st.integers(1, 500))
def test_a_region_is_inside_the_picture_and_never_empty(
    now: tuple[int, int, int, int], before: tuple[int, int, int, int] | None, border: int, width: int, height: int
) -> None:
    def box(corner: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
        return corner[0], corner[1], corner[0] + corner[2], corner[1] + corner[3]

    x0, y0, x1, y1 = region(box(now), None if before is None else box(before), (width, height), border)
    assert 0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height


def test_a_region_holds_both_boxes_and_the_border_or_all_where_the_wound_is_unseen() -> None:
    assert region((100, 100, 150, 160), (80, 120, 130, 190), (640, 480), 5) == (75, 95, 155, 195)
    assert region(None, (80, 120, 130, 190), (640, 480)) == (0, 0, 640, 480)


@pytest.mark.parametrize("camera", [0, 1])
def test_the_area_on_the_surface_is_the_ellipse_that_was_put_there(camera: int) -> None:
    seen = arc_rig().cameras[camera]
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    rim = np.column_stack([20 * np.cos(angle), 14 * np.sin(angle), np.zeros(400)])
    pixels, _ = pixels_from_points(seen, se3.transform_points(BASE_FROM_REST, rim))
    mask = mask_from_outlines([pixels], seen.size)
    assert area_on_plane(mask, seen, BASE_FROM_REST) == pytest.approx(np.pi * 20 * 14, rel=0.01)


def test_an_area_on_a_plane_behind_the_camera_is_not_known() -> None:
    camera = arc_rig().cameras[0]
    mask = disc(camera.size[::-1], (640, 360), 40)
    behind = camera.base_from_camera @ se3.make(np.eye(3), [0, 0, -100])
    assert np.isnan(area_on_plane(mask, camera, behind))


def seen_at(centre: tuple[int, int] | None, size: tuple[int, int] = (640, 480)) -> Segmentation:
    mask = np.zeros(size[::-1], bool) if centre is None else disc(size[::-1], centre, 30)
    return Segmentation(mask, 0.9 if centre else 0.1, 0.7 if centre else np.nan)


def test_a_wound_that_jumps_is_believed_at_the_second_look() -> None:
    watch = WoundFilter((640, 480))
    watch.take(seen_at((100, 100)))
    once = watch.take(seen_at((400, 300)))
    assert once.box == box_of(disc((480, 640), (100, 100), 30)) and once.missed == 1 and once.roi == (0, 0, 640, 480)
    twice = watch.take(seen_at((400, 300)))
    assert twice.box == box_of(disc((480, 640), (400, 300), 30)) and twice.missed == 0


def test_a_wound_that_is_not_seen_stays_for_a_few_looks_only() -> None:
    watch = WoundFilter((640, 480))
    first = watch.take(seen_at((100, 100)))
    for _ in range(MAX_MISSED_LOOKS):
        assert watch.take(seen_at(None)).box == first.box
    assert watch.take(seen_at(None)).box is None and watch.take(seen_at((400, 300))).box is not None


def test_the_region_of_a_moving_wound_holds_where_it_was() -> None:
    watch = WoundFilter((640, 480))
    watch.take(seen_at((100, 100)))
    x0, _, x1, _ = watch.take(seen_at((110, 100))).roi
    assert x0 == 100 - 30 - 5 and x1 == 110 + 30 + 1 + 5


@given(BOXES)
def test_a_box_overlaps_itself_wholly(corner: tuple[int, int, int, int]) -> None:
    box = corner[0], corner[1], corner[0] + corner[2], corner[1] + corner[3]
    assert overlap(box, box) == 1
    assert overlap(box, (box[2], box[3], box[2] + 5, box[3] + 5)) == 0


def run_beside(executor: ThreadPoolExecutor | None, segmenter: Callable[[np.ndarray], Segmentation]) -> list[object]:
    rig = arc_rig(size=(64, 48), focal=55.0)
    beside = AsyncSegmentation(rig, segmenter, executor)
    out: list[object] = []
    for number in range(12):
        images = [Frame(c, number / 30, np.full((48, 64, 3), number, np.uint8)) for c in range(3)]
        due = beside(FrameSet(number / 30, tuple(images)))
        out.append(None if due is None else (round(due[0] * 30), {c: s.confidence for c, s in due[1].items()}))
    return out


def test_a_result_counts_three_frame_sets_later_in_a_thread_or_out_of_it() -> None:
    def segmenter(image: np.ndarray) -> Segmentation:
        return Segmentation(np.zeros(image.shape[:2], bool), float(image[0, 0, 0]), np.nan)

    alone = run_beside(None, segmenter)
    with ThreadPoolExecutor(1) as thread:
        assert run_beside(thread, segmenter) == alone
    told = [due for due in alone if due is not None]
    assert told == [(k, {0: k, 1: k, 2: k}) for k in (0, 3, 6)]
    assert [k for k, due in enumerate(alone) if due is not None] == [3, 6, 9]


def test_logits_are_of_the_pictures_own_size() -> None:
    for size in ((480, 640), (97, 301), (33, 32)):
        image, _ = picture((16, 16), 8, size)
        assert wound_logits(image[..., ::-1], red_is_wound, Looks()).shape == size
