"""Finding the surface again: anywhere in the image, and not where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from estimation import se3
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.simulator.scene.scene import Scene
from perception.features import grey
from perception.frames import Image
from perception.lens import Lenses
from perception.matching.features import Relocaliser
from perception.matching.patches import pyramid
from tests.synthetic import AWAY, WIDE, patch, pictures

RIG = arc_rig()
SCENE = patch(1, wound=WIDE)
FLAT = SCENE.shape.grid(6.0, 0.8)
MAP = SurfaceMap(SCENE.shape.points(FLAT), SCENE.shape.normals(FLAT), np.zeros((3 * len(FLAT),) * 2))


def look(pose: Array, scene: Scene = SCENE, seed: int = 0) -> dict[int, tuple[Image, Image]]:
    images = pictures(scene, RIG.cameras, pose, np.random.default_rng(seed))
    return {c: pyramid(grey(image)) for c, image in enumerate(images)}


def learned(cameras: Rig = RIG) -> Relocaliser:
    search = Relocaliser(Lenses(cameras))
    for camera, images in look(REST).items():
        search.learn(camera, images[0], REST, MAP)
    return search


@pytest.fixture(scope="module")
def search() -> Relocaliser:
    return learned()


def off(found: Array, pose: Array) -> tuple[float, float]:
    """Error in mm and degrees."""
    change = se3.inverse(found) @ pose
    return float(np.linalg.norm(change[:3, 3])), float(np.degrees(se3.angle_of(change)))


@pytest.mark.parametrize(
    "motion",
    [
        np.zeros(6),
        np.array([0, 0, 0.5, 40.0, -25.0, 10.0]),
        np.array([0.3, -0.2, 0, -30.0, 20.0, -40.0]),
        np.array([0, 0, np.pi / 2, 0, 30.0, 20.0]),
    ],
)
def test_the_surface_is_found_wherever_it_went(search: Relocaliser, motion: Array) -> None:
    pose = REST @ se3.exp(motion)
    found = search.find(look(pose, seed=1))
    assert found is not None and found.matches > 30
    mm, degrees = off(found.base_from_surface, pose)
    assert mm < 1.0 and degrees < 1.5  # a start for the alignment, which reaches 5 px or 2 mm


@pytest.mark.parametrize("camera", [0, 1, 2])
def test_one_camera_is_enough_for_a_start(search: Relocaliser, camera: int) -> None:
    pose = REST @ se3.exp(np.array([0, 0, 0.4, 20.0, -15.0, 5.0]))
    found = search.find({camera: look(pose, seed=2)[camera]})
    assert found is not None and set(found.single) <= {camera}
    mm, degrees = off(found.base_from_surface, pose)
    assert mm < 4.0 and degrees < 5.0


def test_each_camera_finds_its_own_instant(search: Relocaliser) -> None:
    """Camera 2 was exposed when the surface was 15 mm further on."""
    here, there = REST, REST @ se3.exp(np.array([0, 0, 0, 15.0, 0, 0]))
    found = search.find({**look(here, seed=3), 2: look(there, seed=3)[2]})
    assert found is not None and set(found.single) == {0, 1, 2}
    for camera, pose in [(0, here), (1, here), (2, there)]:
        assert off(found.single[camera], pose)[0] < 4.0


def test_the_room_is_not_the_surface(search: Relocaliser) -> None:
    assert search.find(look(AWAY)) is None


def test_another_surface_is_not_this_one(search: Relocaliser) -> None:
    assert search.find(look(REST, patch(7, wound=WIDE))) is None


@pytest.mark.parametrize("level", [0, 128])
def test_nothing_is_found_in_even_images(search: Relocaliser, level: int) -> None:
    blank = pyramid(np.full((720, 1280), level, np.uint8))
    assert search.find(dict.fromkeys(range(3), blank)) is None
    assert search.find({}) is None


def test_a_blind_camera_does_not_hide_what_the_others_see(search: Relocaliser) -> None:
    images = {**look(REST, seed=4), 1: pyramid(np.zeros((720, 1280), np.uint8))}
    found = search.find(images)
    assert found is not None and 1 not in found.single and off(found.base_from_surface, REST)[0] < 1.5


def test_before_anything_is_learned_nothing_is_found() -> None:
    assert Relocaliser(Lenses(RIG)).find(look(REST)) is None


def test_a_surface_out_of_view_teaches_nothing() -> None:
    search = Relocaliser(Lenses(RIG))
    aside = REST @ se3.exp(np.array([0, 0, 0, 2000.0, 0, 0]))
    search.learn(0, look(REST)[0][0], aside, MAP)
    assert search.find(look(REST)) is None


def test_two_runs_give_the_same_bits(search: Relocaliser) -> None:
    pose = REST @ se3.exp(np.array([0, 0, 0.3, 10.0, 0, 0]))
    a, b = search.find(look(pose)), learned().find(look(pose))
    assert a is not None and b is not None and a.base_from_surface.tobytes() == b.base_from_surface.tobytes()
