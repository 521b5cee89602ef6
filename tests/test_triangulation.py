"""Points from pixels: the way back of the projection, and how sure it is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimation.mapping.triangulation import epipolar_distance, rays, triangulate
from estimation.rig import ideal_pixels
from estimation.se3 import Array
from estimation.synthetic.arc_rig import TARGET, arc_rig

RIG = arc_rig()
seeds = st.integers(0, 10_000)


def cloud(seed: int, count: int = 30, spread: float = 40.0) -> Array:
    """Points (N, 3), base frame, about where the patch rests."""
    return TARGET + np.random.default_rng(seed).uniform(-spread, spread, (count, 3))


def sightings(points: Array, cameras: list[int]) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """point, camera (M,) and undistorted pixels (M, 2) of all points in the cameras."""
    pixels = [ideal_pixels(RIG.cameras[c], points)[0] for c in cameras]
    return np.tile(np.arange(len(points)), len(cameras)), np.repeat(cameras, len(points)), np.concatenate(pixels)


@given(seeds)
def test_a_point_lies_on_the_ray_of_its_pixel(seed: int) -> None:
    points = cloud(seed)
    point, camera, pixels = sightings(points, [0, 1, 2])
    origins, directions = rays(RIG, camera, pixels)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1)
    reach = np.einsum("ni,ni->n", points[point] - origins, directions)
    assert (reach > 0).all() and np.allclose(origins + reach[:, None] * directions, points[point], atol=1e-8)


@pytest.mark.parametrize("cameras", [[0, 1], [1, 2], [0, 2], [0, 1, 2]])
@given(seed=seeds)
@settings(max_examples=20)
def test_triangulation_undoes_the_projection(cameras: list[int], seed: int) -> None:
    points = cloud(seed)
    found, covariance, residual = triangulate(RIG, *sightings(points, cameras), len(points))
    assert np.allclose(found, points, atol=1e-7) and np.abs(residual).max() < 1e-8
    assert np.linalg.eigvalsh(covariance).min() > 0


@given(seeds)
@settings(max_examples=20)
def test_the_order_of_the_sightings_does_not_matter(seed: int) -> None:
    points = cloud(seed)
    point, camera, pixels = sightings(points, [0, 1, 2])
    pixels = pixels + np.random.default_rng(seed).normal(size=pixels.shape)
    order = np.random.default_rng([seed, 1]).permutation(len(point))
    found, covariance, residual = triangulate(RIG, point, camera, pixels, len(points))
    again = triangulate(RIG, point[order], camera[order], pixels[order], len(points))
    assert np.allclose(found, again[0], atol=1e-8) and np.allclose(covariance, again[1])
    assert np.allclose(residual[order], again[2], atol=1e-8)


@pytest.mark.parametrize("cameras", [[0, 1], [0, 2], [0, 1, 2]])
def test_the_covariance_is_as_wide_as_the_errors(cameras: list[int]) -> None:
    points, draw = cloud(1, count=600), np.random.default_rng(2)
    point, camera, pixels = sightings(points, cameras)
    found, covariance, _ = triangulate(RIG, point, camera, pixels + draw.normal(size=pixels.shape), len(points))
    error = found - points
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error) / 3
    assert 0.9 < nees.mean() < 1.1  # 1800 squares: one standard deviation of the mean is 0.033


def test_no_small_step_of_a_point_fits_its_pixels_better() -> None:
    points, draw = cloud(4), np.random.default_rng(5)
    point, camera, pixels = sightings(points, [0, 1, 2])
    pixels = pixels + 3 * draw.normal(size=pixels.shape)
    found, _, residual = triangulate(RIG, point, camera, pixels, len(points))
    least = np.bincount(point, (residual**2).sum(1))
    for step in 0.01 * np.concatenate([np.eye(3), -np.eye(3)]):
        _, _, moved = sightings(found + step, [0, 1, 2])
        assert (np.bincount(point, ((moved - pixels) ** 2).sum(1)) > least).all()


def test_a_third_camera_makes_every_point_surer() -> None:
    points = cloud(3)
    two = triangulate(RIG, *sightings(points, [0, 1]), len(points))[1]
    three = triangulate(RIG, *sightings(points, [0, 1, 2]), len(points))[1]
    assert np.linalg.eigvalsh(two - three).min() > -1e-12  # nothing along its own ray, so two directions gain
    assert np.linalg.eigvalsh(two - three)[:, 1:].min() > 1e-4


@given(seeds)
@settings(max_examples=20)
def test_rays_that_meet_behind_the_cameras_give_a_depth_that_says_so(seed: int) -> None:
    """A pixel has no sign of depth: the point behind projects like one in front, and comes back where it is."""
    centre = np.mean([RIG.cameras[c].base_from_camera[:3, 3] for c in (0, 1)], axis=0)
    points = centre + 1.5 * (centre - cloud(seed))
    found = triangulate(RIG, *sightings(points, [0, 1]), len(points))[0]
    assert np.allclose(found, points, atol=1e-4)
    assert max(ideal_pixels(RIG.cameras[c], found)[1].max() for c in (0, 1)) < 0


@given(seeds)
def test_true_pairs_lie_on_each_others_epipolar_lines(seed: int) -> None:
    points = cloud(seed)
    seen = [ideal_pixels(c, points)[0] for c in RIG.cameras]
    for a, b in [(0, 1), (1, 0), (0, 2), (2, 1)]:
        assert np.abs(epipolar_distance(RIG, a, b, seen[a], seen[b])).max() < 1e-7


@given(seeds, st.floats(-30, 30))
@settings(max_examples=30)
def test_the_epipolar_distance_is_measured_in_pixels_across_the_line(seed: int, away: float) -> None:
    points = cloud(seed)
    a, b = ideal_pixels(RIG.cameras[0], points)[0], ideal_pixels(RIG.cameras[1], points)[0]
    further = points + 30 * rays(RIG, np.zeros(len(points), int), a)[1]  # the same pixels in camera 0
    along = ideal_pixels(RIG.cameras[1], further)[0] - b
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], -1)
    distance = epipolar_distance(RIG, 0, 1, a, b + away * across + 17.0 * along)
    assert np.allclose(np.abs(distance), abs(away), atol=1e-6)
    assert np.allclose(distance, distance[0], atol=1e-6)
