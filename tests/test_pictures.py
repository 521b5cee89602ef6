"""Pictures as cameras deliver them: each its own, whenever it is asked for and whoever else is rendered with it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from estimation import se3
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.files.images import decode
from hardware.simulator.cameras import Fate, Shot
from hardware.simulator.instant import Instant
from hardware.simulator.lenses import Lenses
from hardware.simulator.look import Look
from hardware.simulator.pictures import Pictures
from hardware.simulator.scene.scene import Scene
from hardware.simulator.scene.shape import cylinder
from hardware.simulator.sensor import Sensor

RIG = arc_rig(size=(96, 64), focal=140.0)


@cache
def scene() -> Scene:
    return Scene(cylinder((60.0, 40.0), 45.0), Look(texel=1.0))


def pictures(seed: int = 3, quality: int | None = 90, threads: int = 1) -> Pictures:
    return Pictures(scene(), Lenses(RIG.cameras), Sensor(), quality, seed, threads)


def shot(camera: int, number: int, fate: Fate = Fate.DELIVERED) -> Shot:
    stamp = 0.1 + number / 30
    return Shot(camera, number, number, stamp, stamp, stamp + 0.03, 0.008, 1.0, fate)


def instant(number: int) -> Instant:
    pose = REST @ se3.exp([0.0, 0.0, 0.0, 0.5 * number, 0.0, 0.0])
    return Instant(0.1 + number / 30, 0.008, pose, np.array([0.0, 0, 0, 15.0, 0, 0]))


def taken(source: Pictures, shots: list[Shot]) -> list[tuple[str, bytes]]:
    for one in shots:
        source.expose(one, instant(one.picture))
    return [source.take(one) for one in shots]


ALL = [shot(camera, number) for number in range(2) for camera in range(3)]


def test_a_picture_does_not_depend_on_threads_or_on_what_else_waits() -> None:
    together = taken(pictures(), ALL)
    assert together == taken(pictures(threads=2), ALL)
    assert together == [taken(pictures(), [one])[0] for one in ALL]
    assert together[::-1] == taken(pictures(), ALL[::-1])
    assert len(set(together)) == len(ALL)


def test_another_seed_is_another_noise() -> None:
    one, other = (decode(taken(pictures(seed, None), ALL[:1])[0][1], "", "").astype(int) for seed in (3, 4))
    assert 0 < np.abs(one - other).mean() < 6


def test_the_noise_of_two_pictures_of_the_same_thing_differs() -> None:
    still = instant(0)
    source = pictures(quality=None)
    for number in range(2):
        source.expose(shot(0, number), still)
    first, second = (decode(source.take(shot(0, number))[1], "", "").astype(int) for number in range(2))
    assert 0 < np.abs(first - second).mean() < 6


def test_a_repeated_frame_is_the_same_picture() -> None:
    source = pictures()
    again = replace(shot(1, 1, Fate.DUPLICATED), picture=0, exposed=0.1)
    first, second = taken(source, [shot(1, 0), again])
    assert first == second


def test_a_damaged_frame_has_the_header_of_the_whole_one() -> None:
    whole = taken(pictures(), [shot(2, 0)])[0]
    damaged = taken(pictures(), [shot(2, 0, Fate.GARBLED)])[0]
    assert damaged[1] != whole[1]
    assert damaged[1][:100] == whole[1][:100]
    assert damaged == taken(pictures(), [shot(2, 0, Fate.GARBLED)])[0]


def test_pictures_are_jpegs_or_lossless_as_asked() -> None:
    kinds = {quality: taken(pictures(quality=quality), ALL[:1])[0] for quality in (90, 30, None)}
    assert [kinds[quality][0] for quality in (90, 30, None)] == ["jpeg", "jpeg", "png"]
    assert len(kinds[30][1]) < len(kinds[90][1]) < len(kinds[None][1])
    image = decode(kinds[None][1], "", "")
    assert image.shape == (64, 96, 3)
    assert 20 < image.mean() < 235


def test_each_picture_is_taken_once() -> None:
    source = pictures()
    taken(source, ALL[:3])
    with pytest.raises((KeyError, ValueError)):
        source.take(ALL[0])


def test_what_is_printed_is_brought_up_to_the_first_exposure_that_waits() -> None:
    told = list[float]()
    source = Pictures(scene(), Lenses(RIG.cameras), Sensor(), 90, 3, 1, told.append)
    for one in (shot(0, 1), shot(1, 0), shot(2, 1)):
        source.expose(one, instant(one.number))
    source.take(shot(2, 1))
    source.take(shot(0, 1))
    assert told == [0.1]
