"""Tests of what is said of cameras that stand off the pose."""

from __future__ import annotations

import numpy as np

from estimation.online.camera_health import CameraHealth

ALLOWED = np.full(3, 0.25)


def test_images_are_doubted_only_where_every_camera_that_counts_stands_off() -> None:
    health = CameraHealth(["a", "b", "c"])
    off = np.array([1.5, 1.0, 2.0])
    assert np.array_equal(health.doubted(off, ALLOWED, ()), off)
    assert not health.doubted(np.array([1.5, 0.1, 2.0]), ALLOWED, ()).any()
    assert np.array_equal(health.doubted(np.array([1.5, 0.1, np.nan]), ALLOWED, (1,)), [1.5, 0.0, 0.0])
    assert not health.doubted(np.full(3, np.nan), ALLOWED, ()).any()


def test_shape_and_clocks_are_learned_only_where_two_cameras_see_about_as_much_as_usual() -> None:
    health = CameraHealth(["a", "b", "c"])
    assert health.clear(np.array([0, 0, 0]))  # nothing is usual yet
    for k in range(10):
        health.update(0.03 * k, np.array([100, 90, 0]), 10, np.zeros(3), np.ones(3), ())
    assert health.clear(np.array([40, 30, 0])) and health.clear(np.array([100, 28, 0]))
    assert not health.clear(np.array([100, 20, 0])) and not health.clear(np.array([20, 20, 40]))
    alone = CameraHealth(["a"])
    alone.update(0.0, np.array([50]), 10, np.zeros(1), np.ones(1), ())
    assert alone.clear(np.array([20])) and not alone.clear(np.array([10]))


def test_images_that_all_stand_off_are_said_to() -> None:
    health = CameraHealth(["a", "b"])
    for off, said in ((np.array([0.1, 0.9]), ""), (np.array([0.9, 0.8]), "no camera shows the surface as usual")):
        health.update(0.0, np.array([50, 50]), 10, off, np.full(2, 0.25), ())
        assert health.trouble(0.0) == said


def test_a_lost_surface_forgives_all_cameras() -> None:
    health = CameraHealth(["a", "b"])
    health.update(0.0, np.array([50, 0]), 10, np.array([0.1, 5.0]), np.full(2, 0.25), {1})
    assert health.left_out == {1}
    health.forgive()
    assert not health.left_out
