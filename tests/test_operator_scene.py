"""What is handed to the page: small enough for a browser, and true."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from estimation.rig import Camera, Rig
from hardware.operator import scene as limits
from hardware.operator.link import OperatorLink
from hardware.operator.pictures import CameraPicture, Pictures
from hardware.operator.scene import PATH_POINTS, TRIANGLES, Scene, scene_from
from planning.path import Path

RIG = Rig((Camera("camera0", (640, 360), np.diag([500.0, 500.0, 1.0]), np.zeros(5), np.eye(4)),))


def printed_path(count: int) -> Path:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count) * 0.01
    extrude = np.arange(count) % 997 != 0
    plain = np.zeros(count)
    return Path(poses, plain + 5, plain.astype(int), plain + 20, plain.astype(int), extrude)


def dome(side: int) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(-40, 40, side), np.linspace(-30, 30, side))
    points = np.column_stack([x.ravel(), y.ravel(), 15 - (x**2 + y**2).ravel() / 150])
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    return points, np.concatenate([np.stack([a, a + 1, a + side], 1), np.stack([a + 1, a + side + 1, a + side], 1)])


@pytest.mark.parametrize("count", [2, 300, PATH_POINTS, 50_000])
def test_a_path_is_thinned_to_what_can_be_drawn_and_keeps_its_ends_and_its_gaps(count: int) -> None:
    path = printed_path(count)
    scene = scene_from(RIG, path)
    assert len(scene.path) <= 1.5 * PATH_POINTS
    assert scene.checkpoint[0] == 0 and scene.checkpoint[-1] == count - 1
    assert (np.diff(scene.checkpoint) > 0).all()
    assert np.array_equal(scene.path, path.surface_from_nozzle[scene.checkpoint, :3, 3])
    assert np.count_nonzero(~scene.extrude) == np.count_nonzero(~path.extrude)


def test_a_fine_surface_is_drawn_with_few_triangles_that_lie_on_it() -> None:
    points, triangles = dome(150)
    scene = scene_from(RIG, None, points, triangles)
    assert TRIANGLES / 4 < len(scene.triangles) <= TRIANGLES
    x, y, z = scene.surface.T
    assert np.abs(z - (15 - (x**2 + y**2) / 150)).max() < 0.3
    assert np.ptp(x) > 75 and np.ptp(y) > 55


def test_a_small_surface_stays_as_it_is() -> None:
    points, triangles = dome(10)
    scene = scene_from(RIG, None, points, triangles)
    assert np.array_equal(scene.surface, points) and np.array_equal(scene.triangles, triangles)


def test_points_without_triangles_are_thinned_too() -> None:
    assert len(scene_from(RIG, None, np.random.default_rng(1).normal(size=(90_000, 3))).surface) == TRIANGLES


def test_the_largest_scene_and_pictures_fit_their_places() -> None:
    link = OperatorLink()
    scene = scene_from(RIG, printed_path(50_000), *dome(150))
    assert len(pickle.dumps(scene)) < limits.CAPACITY
    link.scene.put(scene)
    link.pictures.put(Pictures(1.0, tuple(CameraPicture(f"camera{k}", bytes(200_000)) for k in range(3))))
    got = link.scene.get()
    assert isinstance(got, Scene) and np.array_equal(got.path, scene.path)
