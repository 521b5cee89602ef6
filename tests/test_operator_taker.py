"""Live pictures are taken while somebody looks, and cost whoever offers them nothing."""

from __future__ import annotations

import time

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hardware.files.images import decode
from hardware.operator.pictures import CAPACITY, Pictures
from hardware.operator.shared_state import RequestLine
from hardware.operator.taker import PERIOD, WIDTH, PictureTaker, Shot, crop_around
from hardware.process.shared_latest import Newest


def shot(width: int = 1280, height: int = 720) -> Shot:
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2] = (40, 60, 200)
    return Shot("camera0", image, (np.array([[1.0, 2.0], [3.0, 4.0]]),), np.array([[5.0, 6.0]]))


def taken(pictures: Newest[Pictures]) -> Pictures:
    end = time.monotonic() + 10
    while (found := pictures.get()) is None and time.monotonic() < end:
        time.sleep(0.005)
    assert found is not None
    return found


def test_a_picture_is_small_and_says_what_the_shot_said() -> None:
    pictures: Newest[Pictures] = Newest(CAPACITY)
    line = RequestLine()
    line.windows = 1
    taker = PictureTaker(pictures, line)
    assert taker.offer(3.5, [shot()], np.eye(4))
    found = taken(pictures)
    taker.close()
    (picture,) = found.pictures
    image = decode(picture.jpeg, "picture", "jpeg")
    assert image.shape == (360, WIDTH, 3) and found.stamp == 3.5
    assert np.abs(image[100, 100].astype(int) - [40, 60, 200]).max() < 12 and image[100, 600].max() < 12
    assert picture.camera == "camera0" and picture.outline[0][1, 1] == 4.0 and picture.tracks[0, 0] == 5.0


PLACES = st.tuples(st.floats(0, 1279), st.floats(0, 719), st.floats(1, 900))


@given(PLACES)
def test_the_near_picture_holds_what_was_found_lies_within_the_image_and_has_its_proportions(
    place: tuple[float, float, float],
) -> None:
    x, y, spread = place
    tracks = np.array([x, y]) + spread * np.random.default_rng(1).uniform(-0.5, 0.5, (200, 2))
    tracks = np.clip(tracks, 0, [1279, 719])
    image = np.zeros((720, 1280), np.uint8)
    crop = crop_around(Shot("camera0", image, tracks=tracks), None)
    left, top, width, height = crop or (0, 0, 1280, 720)
    assert min(left, top) >= 0 and left + width <= 1280 and top + height <= 720
    assert abs(width / height - 16 / 9) < 0.05 and width >= 1280 / 8
    inside = ((tracks >= [left, top]) & (tracks <= [left + width, top + height])).all(axis=1)
    assert inside.mean() > 0.9


def test_the_near_picture_rests_while_the_wound_breathes_and_follows_it_when_it_leaves() -> None:
    image = np.zeros((720, 1280), np.uint8)
    tracks = np.random.default_rng(1).uniform([500, 300], [700, 420], (100, 2))

    def around(shift: float, present: tuple[int, int, int, int] | None) -> tuple[int, int, int, int] | None:
        return crop_around(Shot("camera0", image, tracks=tracks + [shift, 0]), present)

    first = around(0, None)
    assert first is not None and around(20, first) == first and around(-20, first) == first
    moved = around(200, first)
    assert moved is not None and moved != first and moved[0] > first[0] + 150
    assert crop_around(Shot("camera0", image), first) == first


def test_nothing_is_taken_while_nobody_looks_nor_sooner_than_is_due() -> None:
    pictures: Newest[Pictures] = Newest(CAPACITY)
    line = RequestLine()
    taker = PictureTaker(pictures, line)
    assert not taker.offer(0.0, [shot()])
    line.windows = 1
    begun, accepted = time.monotonic(), 0
    while time.monotonic() < begun + 1.0:
        accepted += taker.offer(1.0, [shot()])
    taker.close()
    assert 1 <= accepted <= 1.0 / PERIOD + 2
    assert taker.made <= accepted


def test_offering_never_waits_for_the_pictures_to_be_made() -> None:
    pictures: Newest[Pictures] = Newest(CAPACITY)
    line = RequestLine()
    line.windows = 1
    taker = PictureTaker(pictures, line)
    large = [shot(3000, 2000)] * 3  # 60 ms of work
    spent = []
    for _ in range(200):
        begun = time.thread_time()
        taker.offer(1.0, large)
        spent.append(time.thread_time() - begun)
        time.sleep(0.003)
    taker.close()
    assert sorted(spent)[-3] < 0.002


def test_pictures_that_do_not_fit_are_dropped_and_the_next_ones_come() -> None:
    pictures: Newest[Pictures] = Newest(20_000)
    line = RequestLine()
    line.windows = 1
    taker = PictureTaker(pictures, line)
    noise = np.random.default_rng(1).integers(0, 255, (360, 640, 3)).astype(np.uint8)
    assert taker.offer(1.0, [Shot("camera0", noise)])
    time.sleep(PERIOD + 0.1)
    assert taker.offer(2.0, [shot()])
    assert taken(pictures).stamp == 2.0
    taker.close()
    assert (taker.made, taker.dropped) == (1, 1)
