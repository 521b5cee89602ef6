"""Live pictures are taken while somebody looks, and cost whoever offers them nothing."""

from __future__ import annotations

import time

import numpy as np

from hardware.images import decode
from hardware.newest import Newest
from hardware.operator.pictures import CAPACITY, Pictures
from hardware.operator.request import RequestLine
from hardware.operator.taker import PERIOD, WIDTH, PictureTaker, Shot


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
