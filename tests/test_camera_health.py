"""Tests of what is said of cameras that stand off the pose."""

from __future__ import annotations

import numpy as np

from estimation.camera_health import CameraHealth

ALLOWED = np.full(3, 0.25)


def test_images_are_doubted_only_where_every_camera_that_counts_stands_off() -> None:
    health = CameraHealth(["a", "b", "c"])
    off = np.array([1.5, 1.0, 2.0])
    assert np.array_equal(health.doubted(off, ALLOWED, ()), off)
    assert not health.doubted(np.array([1.5, 0.1, 2.0]), ALLOWED, ()).any()
    assert np.array_equal(health.doubted(np.array([1.5, 0.1, np.nan]), ALLOWED, (1,)), [1.5, 0.0, 0.0])
    assert not health.doubted(np.full(3, np.nan), ALLOWED, ()).any()
