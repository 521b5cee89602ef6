"""Points from pixels and their covariance; depth of one camera's landmarks; rays on a surface through points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimation import se3
from estimation.mapping.triangulation import (
    MIN_SURFACE_POINTS,
    RaySurfaceHits,
    epipolar_distance,
    intersect_rays_with_surface,
    rays,
    smooth_normals,
    triangulate,
    update_from_observations,
)
from estimation.pose_solver import project
from estimation.rig import ideal_pixels
from estimation.se3 import Array
from estimation.surface_map import UNCERTAIN_MM, MapError, SurfaceMap, local_normals
from estimation.synthetic.world import BASE_FROM_REST, WOUND_CENTRE, arc_rig, patch

RIG = arc_rig()
seeds = st.integers(0, 10_000)


def cloud(seed: int, count: int = 30, spread: float = 40.0) -> Array:
    """Points (N, 3), base frame, about where the patch rests."""
    return WOUND_CENTRE + np.random.default_rng(seed).uniform(-spread, spread, (count, 3))


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


CAMERA, DEPTH_SIGMA, PIXEL_SIGMA = 1, 2.0, 0.2  # mm, px
POSE = np.diag([1e-4**2] * 3 + [0.01**2] * 3)  # rad, mm


def guessed(seed: int, count: int = 20) -> tuple[Array, SurfaceMap]:
    """True points (N, 3), and a map of them that is off along the camera's rays."""
    rng = np.random.default_rng(seed)
    true = patch(count, rng).points
    eye = (se3.inverse(BASE_FROM_REST) @ RIG.cameras[CAMERA].base_from_camera)[:3, 3]
    along = (true - eye) / np.linalg.norm(true - eye, axis=1, keepdims=True)
    blocks = DEPTH_SIGMA**2 * along[:, :, None] * along[:, None] + 0.02**2 * np.eye(3)
    covariance = np.zeros((count, 3, count, 3))
    covariance[np.arange(count), :, np.arange(count)] = blocks
    points = true + along * rng.normal(0, DEPTH_SIGMA, (count, 1)) + rng.normal(0, 0.02, true.shape)
    return true, SurfaceMap(points, np.tile([0.0, 0, 1], (count, 1)), covariance.reshape(3 * count, -1))


def looked(
    seed: int, turns: list[float], known: SurfaceMap, true: Array, stray: int = 0
) -> tuple[SurfaceMap, NDArray[np.bool_]]:
    """Looks at the surface turned by so many rad, from poses that are off as claimed; the first `stray` go astray."""
    rng, rows = np.random.default_rng([seed, 1]), np.arange(len(true))
    camera, agrees = np.full(len(true), CAMERA), np.ones(len(true), bool)
    for turn in turns:
        pose = BASE_FROM_REST @ se3.exp([turn, 0, 0, 0, 0, 0])
        pixels = project(RIG, camera, pose, true)[0] + rng.normal(0, PIXEL_SIGMA, (len(true), 2))
        pixels[:stray, 0] += 30.0
        said = pose @ se3.exp(rng.normal(0, np.sqrt(np.diag(POSE))))
        predicted, _, jacobians = project(RIG, camera, said, known.points)
        sigma = np.full(len(true), PIXEL_SIGMA)
        known, agrees = update_from_observations(known, rows, predicted - pixels, jacobians, sigma, POSE)
    return known, agrees


@settings(max_examples=12)
@given(seeds)
def test_a_surface_that_turns_tells_the_depth_as_surely_as_claimed(seed: int) -> None:
    true, known = guessed(seed)
    after, agrees = looked(seed, [0.1, 0.2, 0.3], known, true)
    error = (after.points - true).ravel()
    assert agrees.mean() > 0.9
    assert np.median(np.linalg.norm(after.points - true, axis=1)) < 0.25 * DEPTH_SIGMA
    assert 0.4 < error @ np.linalg.solve(after.covariance, error) / len(error) < 2.0


@settings(max_examples=5)
@given(seeds)
def test_a_surface_that_does_not_turn_tells_nothing_of_the_depth(seed: int) -> None:
    true, known = guessed(seed)
    after, _ = looked(seed, [0.0, 0.0], known, true)
    before = np.trace(known.covariance)
    assert 0.9 * before < np.trace(after.covariance) <= before


def test_a_look_at_another_spot_is_left_out() -> None:
    true, known = guessed(5)
    after, agrees = looked(5, [0.2], known, true, stray=3)
    assert not agrees[:3].any() and agrees[3:].all()
    assert np.allclose(after.points[:3], known.points[:3], atol=0.3)


def test_no_look_changes_nothing() -> None:
    _, known = guessed(1)
    none = np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 2, 6)), np.zeros(0)
    after, agrees = update_from_observations(known, *none, POSE)
    assert after is known and len(agrees) == 0


def test_a_landmark_of_unknown_depth_counts_little_in_another_camera_and_fully_in_its_own() -> None:
    _, known = guessed(2)
    rows, sigma = np.arange(len(known)), np.full(len(known), PIXEL_SIGMA)
    wide = {}
    for camera in (CAMERA, 2):
        jacobians = project(RIG, np.full(len(known), camera), BASE_FROM_REST, known.points)[2]
        wide[camera] = MapError(known).inflate_sigmas(sigma, rows, jacobians)
    assert wide[CAMERA].max() < 1.3 * PIXEL_SIGMA and wide[2].min() > 5 * PIXEL_SIGMA


def test_landmarks_that_are_well_known_keep_their_sigmas() -> None:
    _, known = guessed(3)
    sure = SurfaceMap(known.points, known.normals, 0.9 * UNCERTAIN_MM**2 * np.eye(3 * len(known)))
    rows, sigma = np.arange(len(sure)), np.full(len(sure), PIXEL_SIGMA)
    jacobians = project(RIG, np.full(len(sure), 0), BASE_FROM_REST, sure.points)[2]
    assert MapError(sure).inflate_sigmas(sigma, rows, jacobians) is sigma


NOISE = 0.04  # mm
EYE = np.array([0.0, 250.0, 300.0])  # mm, from where the rays come
EXACT = 1e-7  # rad


def cylinder(flat: Array, radius: float) -> Array:
    """Points (N, 3) over (N, 2), bent about x."""
    return np.column_stack([flat, np.sqrt(radius**2 - flat[:, 1] ** 2) - radius])


def outward(points: Array, radius: float) -> Array:
    """The true normals (N, 3) there."""
    return np.column_stack([0 * points[:, 0], points[:, 1], points[:, 2] + radius]) / radius


def met(seed: int, radius: float, beside: bool, rough: float = 0.0) -> tuple[RaySurfaceHits, Array]:
    """Forty rays onto a cylinder known at 120 points, among them or up to 10 mm beside; and heights (M,) over it."""
    rng = np.random.default_rng(seed)
    points = cylinder(rng.uniform(-1, 1, (120, 2)) * [30, 18], radius)
    aims = np.column_stack([rng.uniform(-25, 25, 40), rng.uniform(18, 28, 40) if beside else rng.uniform(-15, 15, 40)])
    true = cylinder(aims, radius)
    true[:, 2] += rng.normal(0, rough, 40)
    points += rng.normal(0, NOISE, points.shape) + rng.normal(0, 1, (120, 1)) * rough * [0, 0, 1]
    directions = (true - EYE) / np.linalg.norm(true - EYE, axis=1, keepdims=True)
    found = intersect_rays_with_surface(
        points, NOISE**2 * np.eye(360), np.tile(EYE, (40, 1)), directions, np.full(40, EXACT)
    )
    return found, np.einsum("mi,mi->m", found.points - true, found.normals)


@settings(max_examples=12)
@given(st.integers(0, 10_000), st.floats(40.0, 300.0), st.booleans())
def test_a_height_is_no_farther_off_than_claimed(seed: int, radius: float, beside: bool) -> None:
    found, off = met(seed, radius, beside)
    assert found.good.all() and found.sigma.max() < 3.0
    assert np.mean((off / found.sigma) ** 2) < 1.6 and np.median(np.abs(off)) < (0.3 if beside else 0.03)


def test_on_skin_as_rough_as_its_landmarks_say_the_claim_is_the_error() -> None:
    runs = [met(seed, 60.0, beside=False, rough=0.1) for seed in range(10)]
    off, sigma = np.concatenate([off for _, off in runs]), np.concatenate([found.sigma for found, _ in runs])
    assert 0.8 < np.mean(off**2) / np.mean(sigma**2) < 1.25
    assert 0.7 < np.mean((off / sigma) ** 2) < 1.8


def test_beside_the_known_part_the_claim_grows_with_the_distance() -> None:
    found, _ = met(1, 60.0, beside=True)
    near = np.argsort(found.points[:, 1])
    assert found.sigma[near[-8:]].mean() > 3 * found.sigma[near[:8]].mean()


def test_neighbours_share_their_error_and_the_whole_covariance_is_one() -> None:
    found, _ = met(2, 60.0, beside=True)
    assert np.linalg.eigvalsh(found.covariance).min() > -1e-9
    sigma = np.sqrt(np.diag(found.covariance))
    alike = (found.covariance / np.outer(sigma, sigma)).reshape(40, 3, 40, 3)[:, 2, :, 2]
    apart = np.linalg.norm(found.points[:, None] - found.points, axis=2)
    assert alike[(apart > 0) & (apart < 4)].mean() > 0.5 > np.abs(alike[apart > 40]).mean()


def test_the_doubt_of_a_landmark_lies_along_its_ray() -> None:
    found, _ = met(3, 60.0, beside=True)
    blocks = np.einsum("ninj->nij", found.covariance.reshape(40, 3, 40, 3))
    along = found.points - EYE
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    left = np.trace(blocks, axis1=1, axis2=2) - np.einsum("ni,nij,nj->n", along, blocks, along)
    assert left.max() < 1e-6


def test_without_a_surface_nothing_is_met() -> None:
    points = np.random.default_rng(0).normal(size=(MIN_SURFACE_POINTS - 1, 3))
    assert not intersect_rays_with_surface(
        points, np.zeros((33, 33)), EYE[None], -EYE[None] / 400, np.array([EXACT])
    ).good.any()


@pytest.mark.parametrize("tilt", [0.0, 0.05])
def test_a_ray_that_grazes_meets_nothing(tilt: float) -> None:
    flat = np.random.default_rng(0).uniform(-20, 20, (60, 2))
    points = np.column_stack([flat, 0 * flat[:, 0]])
    ray = np.array([[1.0, 0.0, -tilt]]) / np.hypot(1.0, tilt)
    assert not intersect_rays_with_surface(points, np.zeros((180, 180)), -400 * ray, ray, np.array([EXACT])).good.any()


@settings(max_examples=10)
@given(st.integers(0, 10_000), st.floats(35.0, 200.0))
def test_normals_at_the_rim_do_not_lean_inwards(seed: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    points = cylinder(rng.uniform(-1, 1, (150, 2)) * [30, 24], radius)
    points += rng.normal(0, 0.02, points.shape)
    true, up = outward(points, radius), np.array([0.0, 0.0, 1.0])
    off = np.arccos(np.clip((smooth_normals(points, up) * true).sum(1), -1, 1))
    leaning = np.arccos(np.clip((local_normals(points, up) * true).sum(1), -1, 1))
    rim = np.abs(points[:, 1]) > 18
    assert np.degrees(off).max() < 4 and off[rim].mean() < 0.5 * leaning[rim].mean() + 0.005
