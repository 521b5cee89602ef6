"""The rig's projection: OpenCV's, and undone by its own inverse."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.rig import Camera, Rig, distort, ideal_pixels, pixels_from_points


def camera(seed: int = 0, name: str = "left") -> Camera:
    draw = np.random.default_rng(seed)
    return Camera(
        name,
        (1280, 720),
        np.array([[draw.uniform(600, 1500), 0, 640], [0, draw.uniform(600, 1500), 360], [0, 0, 1.0]]),
        draw.uniform(-1, 1, 5) * [0.3, 0.1, 0.003, 0.003, 0.05],
        se3.exp(draw.normal(size=6) * [1, 1, 1, 200, 200, 200]),
    )


def points_in_view(cam: Camera, count: int, draw: np.random.Generator) -> np.ndarray:
    rays = np.column_stack([draw.uniform(-0.4, 0.4, count), draw.uniform(-0.25, 0.25, count), np.ones(count)])
    return se3.transform_points(cam.base_from_camera, rays * draw.uniform(100, 900, (count, 1)))


@given(st.integers(0, 10_000))
def test_projection_is_opencvs(seed: int) -> None:
    draw = np.random.default_rng(seed)
    cam = camera(seed)
    points = points_in_view(cam, 20, draw)
    camera_from_base = se3.inverse(cam.base_from_camera)
    rotation, _ = cv2.Rodrigues(camera_from_base[:3, :3])
    expected, _ = cv2.projectPoints(points, rotation, camera_from_base[:3, 3], cam.matrix, cam.distortion)
    pixels, depth = pixels_from_points(cam, points)
    assert np.abs(pixels - expected[:, 0]).max() < 1e-6
    assert (depth > 0).all()


@given(st.integers(0, 10_000))
def test_undistorting_as_opencv_does_gives_the_ideal_pixels_back(seed: int) -> None:
    cam = camera(seed)
    ideal, _ = ideal_pixels(cam, points_in_view(cam, 20, np.random.default_rng(seed)))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    distorted = distort(cam, ideal)[:, None]
    back = cv2.undistortPoints(distorted, cam.matrix, cam.distortion, P=cam.matrix, criteria=criteria)
    assert np.abs(back[:, 0] - ideal).max() < 1e-4


def test_a_pinhole_camera_by_hand() -> None:
    cam = Camera("one", (640, 480), np.array([[100.0, 0, 320], [0, 200, 240], [0, 0, 1]]), np.zeros(5), np.eye(4))
    pixels, depth = pixels_from_points(cam, [[1.0, 2, 10], [0, 0, 5]])
    assert np.array_equal(pixels, [[330, 280], [320, 240]])
    assert np.array_equal(depth, [10, 5])


def test_without_distortion_both_pixels_are_one() -> None:
    cam = camera(3)
    plain = Camera(cam.name, cam.size, cam.matrix, np.zeros(5), cam.base_from_camera)
    points = points_in_view(plain, 50, np.random.default_rng(3))
    assert np.abs(pixels_from_points(plain, points)[0] - ideal_pixels(plain, points)[0]).max() < 1e-9


def test_points_on_and_behind_the_camera_stay_finite_and_are_told_by_depth() -> None:
    cam = Camera("one", (640, 480), np.diag([500.0, 500, 1]), np.zeros(5), np.eye(4))
    pixels, depth = pixels_from_points(cam, [[0.0, 0, 0], [1, 1, 0], [0, 0, -10]])
    assert np.isfinite(pixels).all()
    assert (depth <= 0).all()


def test_moving_rig_and_point_together_changes_no_pixel() -> None:
    cam, draw = camera(7), np.random.default_rng(7)
    points = points_in_view(cam, 30, draw)
    move = se3.exp([0.3, -0.5, 0.2, 40, -10, 5])
    moved = Camera(cam.name, cam.size, cam.matrix, cam.distortion, move @ cam.base_from_camera)
    shifted, _ = pixels_from_points(moved, se3.transform_points(move, points))
    assert np.abs(shifted - pixels_from_points(cam, points)[0]).max() < 1e-7


def test_the_rig_numbers_and_stacks_its_cameras() -> None:
    rig = Rig((camera(0, "left"), camera(1, "right")))
    assert [len(rig), rig.index("left"), rig.index("right")] == [2, 0, 1]
    assert np.array_equal(rig.matrices[1], rig.cameras[1].matrix)
    assert np.abs(rig.camera_from_base[0] @ rig.cameras[0].base_from_camera - np.eye(4)).max() < 1e-12
    with pytest.raises(KeyError):
        rig.index("top")
