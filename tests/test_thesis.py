"""The thesis's equations as laws: its Kalman filter, median, homography, scale, and whose axis is whose."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Camera, ideal_pixels, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.world import WOUND_CENTRE, arc_rig
from perception.frames import Image
from perception.thesis.camera import (
    REGION_BORDER_PX,
    Corners,
    Finder,
    FlatView,
    GaussianState,
    KeyPoints,
    Pairs,
    bounds_of,
    displacement,
    initial_velocity,
    predict,
    turn,
    union_box,
    update,
    update_velocity,
)
from perception.thesis.step import assign_axes, unmeasured

seeds = st.integers(0, 10_000)


def spd(rng: np.random.Generator, n: int) -> Array:
    root = rng.normal(size=(n, n))
    return root @ root.T + np.eye(n)


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=20), st.floats(0.1, 10))
def test_the_filter_of_a_constant_is_the_mean_and_its_variance_falls_by_the_count(seen: list[float], r: float) -> None:
    one, belief = np.eye(1), GaussianState(np.zeros(1), np.array([[1e9]]))
    for value in seen:
        belief = update(predict(belief, one, 0 * one), np.array([value]), one, r * one)
    assert belief.mean[0] == pytest.approx(np.mean(seen), abs=1e-4)
    assert belief.covariance[0, 0] == pytest.approx(r / len(seen), rel=1e-4)


@given(seeds)
def test_an_update_adds_the_measurements_information(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, h, r = GaussianState(rng.normal(size=4), spd(rng, 4)), rng.normal(size=(2, 4)), spd(rng, 2)
    measured = rng.normal(size=2)
    after = update(before, measured, h, r)
    information = np.linalg.inv(before.covariance) + h.T @ np.linalg.inv(r) @ h
    right = np.linalg.solve(before.covariance, before.mean) + h.T @ np.linalg.solve(r, measured)
    assert np.allclose(np.linalg.inv(after.covariance), information, rtol=1e-6)
    assert np.allclose(after.mean, np.linalg.solve(information, right), atol=1e-8)


def test_a_prediction_moves_the_mean_and_widens_by_the_noise() -> None:
    a, q = np.array([[1.0, 0.5], [0.0, 1.0]]), np.diag([0.1, 0.2])
    later = predict(GaussianState(np.array([1.0, 2.0]), np.eye(2)), a, q)
    assert np.allclose(later.mean, [2.0, 2.0]) and np.allclose(later.covariance, a @ a.T + q)


def test_a_steady_velocity_is_learned() -> None:
    belief, move = initial_velocity(), np.array([2.0, -1.0, 0.01])
    for _ in range(5):
        belief = update_velocity(belief, move, 0.05)
    assert np.allclose(belief.mean, move / 0.05, rtol=0.01)


@given(seeds, st.floats(-20, 20), st.floats(-20, 20))
def test_the_median_is_the_shift_while_less_than_half_the_pairs_are_wrong(seed: int, dx: float, dy: float) -> None:
    rng = np.random.default_rng(seed)
    source = rng.uniform(0, 200, (21, 2))
    destination = source + [dx, dy]
    destination[:10] += rng.uniform(-500, 500, (10, 2))
    assert np.allclose(displacement(Pairs(source, destination)), [dx, dy], atol=1e-9)


@given(seeds, st.floats(-1.0, 1.0))
@settings(max_examples=30)
def test_the_homographys_turn_is_the_pictures(seed: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    source = rng.uniform(0, 200, (60, 2))
    c, s = np.cos(angle), np.sin(angle)
    destination = source @ np.array([[c, -s], [s, c]]).T + rng.uniform(-30, 30, 2)
    destination[:15] = rng.uniform(0, 200, (15, 2))
    assert turn(Pairs(source, destination)) == pytest.approx(angle, abs=1e-3)


def test_three_pairs_tell_no_turn() -> None:
    points = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    assert turn(Pairs(points, points)) is None


def texture(shift: tuple[int, int]) -> Image:
    """A view of 320 x 240 px of one random texture, its content moved by `shift` px."""
    rough = cv2.GaussianBlur(np.random.default_rng(3).uniform(0, 255, (300, 400)), (0, 0), 2.5)
    spread = np.clip((rough - rough.mean()) * 4 + 128, 0, 255).astype(np.uint8)
    return np.ascontiguousarray(spread[30 - shift[1] : 270 - shift[1], 40 - shift[0] : 360 - shift[0]])


@pytest.mark.parametrize("kind", [KeyPoints, Corners])
def test_features_are_found_again_where_the_picture_went(kind: type[KeyPoints] | type[Corners]) -> None:
    finder: Finder = kind()
    box = (60, 40, 240, 200)
    assert len(finder.begin(texture((0, 0)), box)) >= 20
    pairs = finder.find(texture((4, -3)), box)
    assert len(pairs) >= 15
    assert np.allclose(displacement(pairs), [4, -3], atol=0.1)
    turned = turn(pairs)
    assert turned is not None and abs(turned) < 0.01


@pytest.mark.parametrize("kind", [KeyPoints, Corners])
def test_what_is_not_kept_is_measured_from_the_picture_before(kind: type[KeyPoints] | type[Corners]) -> None:
    finder: Finder = kind()
    box = (60, 40, 240, 200)
    finder.begin(texture((0, 0)), box)
    finder.find(texture((3, 0)), box)
    assert np.allclose(displacement(finder.find(texture((5, 2)), box)), [5, 2], atol=0.1)
    finder.keep()
    assert np.allclose(displacement(finder.find(texture((6, 2)), box)), [1, 0], atol=0.1)


@pytest.mark.parametrize("kind", [KeyPoints, Corners])
def test_a_picture_without_texture_gives_no_pairs(kind: type[KeyPoints] | type[Corners]) -> None:
    finder, grey = kind(), np.full((240, 320), 90, np.uint8)
    finder.begin(grey, (60, 40, 240, 200))
    assert len(finder.find(grey, (60, 40, 240, 200))) == 0


@given(seeds)
def test_the_united_box_holds_both_regions_and_stays_in_the_image(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = (320, 240)
    regions = [bounds_of(rng.uniform(-50, 400, (5, 2)), size) for _ in range(2)]
    x0, y0, x1, y1 = union_box(regions[0], regions[1], size)
    assert 0 <= x0 < x1 <= size[0] and 0 <= y0 < y1 <= size[1]
    both = np.concatenate(regions)
    assert (both >= [x0, y0]).all() and (both <= [x1, y1]).all()
    assert x0 <= max(both[:, 0].min() - REGION_BORDER_PX, 0)


def camera() -> Camera:
    return arc_rig().cameras[1]


@given(seeds)
@settings(max_examples=30)
def test_the_flat_view_is_a_pinhole_of_its_own_matrix(seed: int) -> None:
    points = WOUND_CENTRE + np.random.default_rng(seed).uniform(-40, 40, (20, 3))
    view = FlatView(camera())
    imaged, _ = pixels_from_points(camera(), points)
    ideal, _ = ideal_pixels(camera(), points)
    flat = view.pixels(imaged)
    assert np.allclose(view.ideal(flat), ideal, atol=1e-3)
    bearing = (ideal - camera().matrix[:2, 2]) / camera().matrix[[0, 1], [0, 1]]
    assert np.allclose(flat, bearing * view.matrix[[0, 1], [0, 1]] + view.matrix[:2, 2], atol=1e-3)


def test_the_flat_view_shows_a_spot_where_its_pixels_say() -> None:
    image = np.zeros((720, 1280), np.uint8)
    cv2.circle(image, (900, 180), 6, 255, -1)
    shown = FlatView(camera()).flatten(image).astype(float)
    rows, columns = np.mgrid[0:720, 0:1280]
    middle = [(shown * columns).sum() / shown.sum(), (shown * rows).sum() / shown.sum()]
    assert np.allclose(middle, FlatView(camera()).pixels(np.array([[900.0, 180.0]]))[0], atol=0.3)


def test_a_millimetre_at_the_surface_is_one_over_the_scale_in_pixels() -> None:
    view, rotation = FlatView(camera()), camera().base_from_camera[:3, :3]
    points = WOUND_CENTRE + np.stack([np.zeros(3), rotation[:, 0], rotation[:, 1]])
    flat = view.pixels(pixels_from_points(camera(), points)[0])
    moved = np.array([flat[1, 0] - flat[0, 0], flat[2, 1] - flat[0, 1]])
    assert np.allclose(moved * view.scale(WOUND_CENTRE), 1.0, rtol=1e-3)


def test_a_picture_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match=r"camera cam_1: image size = '640 x 480', allowed 1280 x 720 px"):
        FlatView(camera()).flatten(np.zeros((480, 640), np.uint8))


def seen(rotation: Array, twist: Array) -> Array:
    """What a camera of base_from_camera (3, 3) sees in its image of a small motion: mm, mm, rad."""
    return np.append((rotation.T @ twist[3:])[:2], (rotation.T @ twist[:3])[2])


def measured(rotations: dict[int, Array], twist: Array) -> Array:
    """What the cameras assigned to axes make of a small motion (6,) in base."""
    shares = assign_axes(rotations)
    return np.sum([share @ seen(rotations[c], twist) for c, share in shares.items()], axis=0)


def square(rng: np.random.Generator) -> dict[int, Array]:
    """Three cameras that look along three axes square to each other, each rolled as it likes."""
    world = se3.exp_rotation(rng.normal(size=3))
    cyclic = np.roll(np.eye(3), 1, axis=0)
    looks = [world, world @ cyclic, world @ cyclic @ cyclic]
    return {c: look @ se3.exp_rotation([0, 0, rng.uniform(-3, 3)]) for c, look in enumerate(looks)}


@given(seeds)
def test_cameras_square_to_each_other_measure_any_small_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    twist = rng.normal(size=6)
    rotations = square(rng)
    assert np.allclose(measured(rotations, twist), twist)
    assert unmeasured(assign_axes(rotations)) == ""


def test_on_the_thesis_rig_each_axis_has_its_camera() -> None:
    rotations = {c: camera.base_from_camera[:3, :3] for c, camera in enumerate(arc_rig().cameras)}
    shares = assign_axes(rotations)
    assert sorted(shares) == [0, 2]  # the side camera looks along no third axis
    assert "turns about it" in unmeasured(shares)
    for axis in (3, 4):  # X and Y: the top camera's image
        assert np.allclose(measured({0: rotations[0]}, np.eye(6)[axis]), np.eye(6)[axis])
    assert np.allclose(shares[2] @ seen(rotations[2], np.eye(6)[5]), [0, 0, 0, 0, 0, np.sin(np.deg2rad(84))])
    yaw, roll, pitch = (measured(rotations, np.eye(6)[axis])[:3] for axis in (2, 1, 0))
    assert np.allclose(yaw, [0, np.cos(np.deg2rad(84)), 1])  # 84 degrees are taken for 90
    assert np.allclose(roll, [0, np.sin(np.deg2rad(84)), 0])
    assert np.allclose(pitch, 0)


def test_without_a_camera_across_the_first_only_its_own_plane_is_measured() -> None:
    rotations = {c: camera.base_from_camera[:3, :3] for c, camera in enumerate(arc_rig((0.0, 30.0)).cameras)}
    assert sorted(assign_axes(rotations)) == [0]
    assert "no camera stands across" in unmeasured(assign_axes(rotations))
