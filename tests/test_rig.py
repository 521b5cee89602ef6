"""The rig's projection is OpenCV's and undone by its inverse, no further than the lens model holds."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.rig import Camera, Rig, distort, ideal_pixels, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from perception.lens import Lenses, imaged_radius, undistort


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


LENSES = [(0.0,) * 5, (-0.12, 0.06, 6e-4, -4e-4, 0.0), (-0.3, 0.12, 1e-3, -1e-3, -0.02), (0.15, -0.05, 0.0, 0.0, 0.01)]


def lens_camera(distortion: tuple[float, ...]) -> Camera:
    return replace(arc_rig().cameras[0], distortion=np.array(distortion))


FOLDING = replace(lens_camera((-0.9, 0.0, 0.0, 0.0, 0.0)), matrix=np.array([[400.0, 0, 640], [0, 400, 360], [0, 0, 1]]))


def spots(lens: Camera, seed: int, count: int = 50) -> Array:
    """Pixels (N, 2) anywhere in the image."""
    return np.random.default_rng(seed).uniform(0, 1, (count, 2)) * lens.size


@pytest.mark.parametrize("distortion", LENSES)
@given(seed=st.integers(0, 10_000))
@settings(max_examples=15)
def test_there_and_back_is_the_same_pixel(distortion: tuple[float, ...], seed: int) -> None:
    lens = lens_camera(distortion)
    pixels = spots(lens, seed)
    assert np.allclose(distort(lens, undistort(lens, pixels)), pixels, atol=1e-5)
    assert np.allclose(undistort(lens, distort(lens, undistort(lens, pixels))), undistort(lens, pixels), atol=1e-5)


@pytest.mark.parametrize("distortion", LENSES)
def test_a_points_pixel_undistorts_to_its_ideal_one(distortion: tuple[float, ...]) -> None:
    lens = lens_camera(distortion)
    points = BASE_FROM_REST[:3, 3] + np.random.default_rng(1).uniform(-60, 60, (80, 3))
    imaged, ideal = pixels_from_points(lens, points)[0], ideal_pixels(lens, points)[0]
    inside = ((imaged > 0) & (imaged < lens.size)).all(1)
    assert inside.sum() > 20 and np.allclose(undistort(lens, imaged[inside]), ideal[inside], atol=1e-5)


def test_without_distortion_nothing_changes() -> None:
    lens = lens_camera(LENSES[0])
    assert np.allclose(undistort(lens, spots(lens, 2)), spots(lens, 2), atol=1e-9)


def test_no_pixels_give_no_pixels() -> None:
    assert undistort(lens_camera(LENSES[1]), np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize("distortion", LENSES)
def test_all_that_a_lens_images_lies_within_its_field(distortion: tuple[float, ...]) -> None:
    lens = lens_camera(distortion)
    w, h = lens.size
    ideal = undistort(lens, np.array([[0, 0], [w, 0], [0, h], [w, h], [w / 2, 0], [w / 2, h / 2]], float))
    tangent = np.linalg.norm((ideal - lens.matrix[:2, 2]) / lens.matrix[[0, 1], [0, 1]], axis=1)
    assert tangent.max() < imaged_radius(lens)


def test_the_field_ends_where_the_lens_model_folds_back() -> None:
    radius = imaged_radius(FOLDING)
    fold = 1 / np.sqrt(3 * 0.9)  # where r (1 - 0.9 r^2) stops growing
    assert 0.9 * fold < radius <= fold
    r = np.linspace(0, radius, 100)
    imaged = distort(FOLDING, np.c_[640 + 400 * r, np.full(100, 360.0)])[:, 0]
    assert (np.diff(imaged) > 0).all()


def test_what_folds_back_into_the_image_is_not_seen() -> None:
    lenses = Lenses(Rig((FOLDING,)))
    ideal = np.array([[640 + 400 * r, 360.0] for r in (0.1, 0.4, 0.75, 1.0)])
    pixels, seen = lenses.image(0, ideal, np.full(4, 300.0))
    assert seen.tolist() == [True, True, False, False]
    assert (distort(FOLDING, ideal[2:])[:, 0] < 1280).all()  # the bare model would put them into the image
    assert np.allclose(pixels[:2], distort(FOLDING, ideal[:2]))


@given(st.integers(0, 10_000))
@settings(max_examples=20)
def test_lenses_image_points_as_the_rig_does(seed: int) -> None:
    cameras = arc_rig()
    lenses = Lenses(cameras)
    points = se3.transform_points(BASE_FROM_REST, np.random.default_rng(seed).uniform(-30, 30, (40, 3)))
    for number, lens in enumerate(cameras.cameras):
        pixels, seen = lenses.image(number, *ideal_pixels(lens, points))
        assert seen.all() and np.allclose(pixels, pixels_from_points(lens, points)[0], atol=1e-9)


def test_points_behind_the_camera_are_not_seen() -> None:
    cameras = arc_rig()
    behind = cameras.cameras[0].base_from_camera @ np.array([0.0, 0.0, -300.0, 1.0])
    ideal, depth = ideal_pixels(cameras.cameras[0], behind[None, :3])
    assert np.allclose(ideal, cameras.cameras[0].matrix[:2, 2])  # dead centre, but behind
    assert not Lenses(cameras).image(0, ideal, depth)[1].any()


def test_undistorting_agrees_with_opencvs_picture() -> None:
    """A straight line, bent by the lens, is straight again."""
    lens = lens_camera(LENSES[2])
    line = np.c_[np.linspace(50, 1200, 60), np.linspace(80, 650, 60)]
    k = np.linalg.inv(lens.matrix)
    rays = np.c_[line, np.ones(60)] @ k.T
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
    bent = pixels.reshape(-1, 2).astype(float)
    inside = ((bent > 0) & (bent < lens.size)).all(1)
    assert np.abs(bent - line).max() > 2 and np.allclose(undistort(lens, bent[inside]), line[inside], atol=1e-5)
