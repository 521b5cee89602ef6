"""Registration finds where a scan lies, says what its shape leaves open, and rays meet the scan where they should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.scans.registration import MIN_REGISTRATION_POINTS, Registration, register, resolve_ambiguity
from estimation.scans.scan import Scan, ScanIndex, scan_from_triangles
from estimation.se3 import Array
from tests import scans

BODY = scans.height_field(scans.body)
MIDDLE = np.array([[-23.0, 29.0], [-21.0, 17.0]])  # points cover a part of the scan only
seeds = st.integers(0, 2**32 - 1)


def found(
    scan: Scan, seed: int, noise: float = 0.0, count: int = 250, wrong: float = 0.0
) -> tuple[Registration, Array]:
    """What is found from points on the scan at a random pose, and how far (N,), mm, it lays them from the truth."""
    rng = np.random.default_rng(seed)
    base_from_surface = se3.exp(np.r_[rng.uniform(-1.8, 1.8, 3), rng.normal(size=3) * 200])
    points = scans.points_on(scan, count, rng, MIDDLE)
    clean = se3.transform_points(base_from_surface, points)
    seen = clean + noise * rng.standard_normal(clean.shape)
    stray = rng.random(count) < wrong
    seen[stray] += rng.uniform(-15, 15, (int(stray.sum()), 3))
    outward = base_from_surface[:3, :3] @ (rng.normal(size=3) * 0.3 + [0, 0, 1])
    result = register(seen, max(noise, 0.02), scan, outward)
    return result, np.linalg.norm(se3.transform_points(result.base_from_surface, points) - clean, axis=1)


@settings(max_examples=4)
@given(seeds)
def test_a_curved_scan_is_found_exactly_from_exact_points(seed: int) -> None:
    result, error = found(BODY, seed)
    assert error.max() < 1e-3 and result.rms < 1e-3
    assert result.sure and result.verdict.startswith("found") and len(result.free) == 0


@pytest.mark.slow
@settings(max_examples=4)
@given(seeds)
def test_noise_costs_accuracy_as_the_covariance_says(seed: int) -> None:
    fine, fine_error = found(BODY, seed, noise=0.05)
    coarse, coarse_error = found(BODY, seed, noise=0.3)
    assert fine_error.mean() < 0.2 and coarse_error.mean() < 1.5
    assert fine.rms == pytest.approx(0.05, rel=0.25) and coarse.rms == pytest.approx(0.3, rel=0.25)
    assert np.linalg.det(coarse.covariance) > np.linalg.det(fine.covariance)


@pytest.mark.slow
def test_errors_and_covariance_agree() -> None:
    squared = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        points = scans.points_on(BODY, 250, rng, MIDDLE)
        truth = se3.exp([0.4, -0.8, 1.1, 100, -50, 400])
        seen = se3.transform_points(truth, points) + 0.05 * rng.standard_normal(points.shape)
        result = register(seen, 0.05, BODY, truth[:3, 2])
        error = se3.log(se3.inverse(result.base_from_surface) @ truth)
        squared.append(error @ np.linalg.solve(result.covariance, error) / 6)
    assert 0.4 < np.mean(squared) < 2.0  # 30 degrees of freedom: 0.46 to 1.79 in 99 %


@pytest.mark.slow
def test_wrong_points_do_not_pull() -> None:
    _, error = found(BODY, 3, noise=0.05, wrong=0.2)
    assert error.mean() < 0.2


def test_a_scan_is_found_from_a_small_part_of_it() -> None:
    large = scans.height_field(lambda x, y: 2 * scans.body(x / 2, y / 2), (160.0, 120.0), 2.0)
    result, error = found(large, 5)
    assert error.max() < 0.1 and result.sure


def slides(result: Registration) -> Array:
    """Of the free directions, those without any turn to speak of (K, 3)."""
    return result.free[np.linalg.norm(result.free[:, :3], axis=1) < 1e-3][:, 3:]


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_plane_slides_and_spins(noise: float) -> None:
    result, _ = found(scans.height_field(scans.plane), 1, noise)
    assert not result.sure and result.free.shape == (3, 6)
    np.testing.assert_allclose(slides(result)[:, 2], 0, atol=0.02)
    turn = result.free[np.argmax(np.linalg.norm(result.free[:, :3], axis=1)), :3]
    assert abs(turn[2]) > 0.999 * np.linalg.norm(turn)
    assert result.verdict.count("slide along") == 2 and result.verdict.count("turn about (0.00 0.00 1.00)") == 1


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_cylinder_slides_along_and_turns_about_its_axis(noise: float) -> None:
    result, _ = found(scans.cylinder(), 2, noise)
    assert not result.sure and result.free.shape == (2, 6)
    assert abs(slides(result)[0, 0]) > 0.999
    turn = result.free[np.argmax(np.linalg.norm(result.free[:, :3], axis=1))]
    axis = turn[:3] / np.linalg.norm(turn[:3])
    assert abs(axis[0]) > 0.999
    through = np.cross(turn[:3], turn[3:]) / (turn[:3] @ turn[:3])
    assert through[2] == pytest.approx(-70, abs=1.0)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_sphere_turns_about_its_centre(noise: float) -> None:
    result, _ = found(scans.height_field(scans.sphere), 3, noise)
    assert not result.sure and result.free.shape == (3, 6) and result.verdict.count("turn about") == 3
    for turn in result.free:  # its centre stays where it is
        assert np.linalg.norm(np.cross(turn[:3], [0, 0, -70.0]) + turn[3:]) < 0.05 * np.linalg.norm(turn[3:]) + 0.02


def test_the_covariance_is_wide_along_what_is_free_and_narrow_across() -> None:
    result, _ = found(scans.height_field(scans.plane), 4, noise=0.05)
    assert (np.sqrt(np.diag(result.covariance))[3:5] > 30).all()
    normal = np.array([0.0, 0, 0, 0, 0, 1])
    assert np.sqrt(normal @ result.covariance @ normal) < 0.05


def test_a_shape_with_two_sides_alike_is_called_ambiguous() -> None:
    result, _ = found(scans.height_field(scans.twofold), 6, noise=0.02, count=400)
    assert not result.sure and "ambiguous" in result.verdict and len(result.free) == 0


def refined(x: float, rms: float) -> Registration:
    pose = se3.make(np.eye(3), np.array([x, 0.0, 0.0]))
    return Registration(pose, rms, np.eye(6), np.zeros((0, 6)), True, f"found: {rms} mm rms")


def test_an_ambiguous_place_is_settled_by_better_points_only_where_these_tell_its_rival_from_it() -> None:
    ambiguous = replace(refined(0.0, 0.07), sure=False, verdict="ambiguous", rival=refined(3.0, 0.07).base_from_surface)
    points = np.random.default_rng(0).uniform(-20, 20, (50, 3))
    here, there = refined(0.0, 0.025), refined(3.0, 0.027)
    asked = resolve_ambiguity(ambiguous, here, there, points)
    assert not asked.sure and "ambiguous" in asked.verdict and asked.rival is ambiguous.rival
    assert resolve_ambiguity(ambiguous, here, refined(3.0, 0.05), points) is here
    poor = refined(0.0, 0.05)
    assert resolve_ambiguity(ambiguous, poor, there, points) is there
    assert (
        resolve_ambiguity(ambiguous, here, refined(0.05, 0.027), points) is here
    )  # the rival has come to the same place
    turned = replace(there, base_from_surface=se3.exp(np.array([0, 0, 0.05, 0, 0, 0.0])))  # far at the rim
    assert not resolve_ambiguity(ambiguous, here, turned, points).sure
    assert not resolve_ambiguity(ambiguous, here, there, np.zeros((0, 3))).sure


def test_points_of_another_surface_are_called_a_poor_fit() -> None:
    rng = np.random.default_rng(7)
    x, y = rng.uniform(-20, 20, (2, 250))
    waves = np.column_stack([x, y, 3 * np.sin(x / 2.5) * np.cos(y / 2.5)])
    result = register(waves, 0.05, BODY, np.array([0.0, 0, 1]))
    assert not result.sure and "poor fit" in result.verdict


def test_too_few_points_hold_nothing() -> None:
    result = register(np.zeros((MIN_REGISTRATION_POINTS - 1, 3)), 0.1, BODY, np.array([0.0, 0, 1]))
    assert not result.sure and len(result.free) == 6 and f"{MIN_REGISTRATION_POINTS} needed" in result.verdict


@pytest.mark.slow
def test_registration_is_deterministic() -> None:
    (a, _), (b, _) = found(BODY, 9, 0.05), found(BODY, 9, 0.05)
    np.testing.assert_array_equal(a.base_from_surface, b.base_from_surface)
    assert a.verdict == b.verdict


@settings(max_examples=20)
@given(seeds)
def test_no_other_point_of_a_scan_is_nearer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scan = scan_from_triangles(rng.normal(size=(30, 3)), np.arange(30).reshape(-1, 3))
    points = 2 * rng.normal(size=(30, 3))
    near = ScanIndex(scan).closest(points)
    best = np.linalg.norm(near.points - points, axis=1)
    for _ in range(200):
        others = np.einsum("tk,tki->ti", rng.dirichlet([0.5, 0.5, 0.5], len(scan.triangles)), scan.corners)
        assert (np.linalg.norm(others[:, None] - points, axis=2) >= best - 1e-6).all()


def test_nearest_points_of_a_ball_lie_towards_its_centre() -> None:
    index, rng = ScanIndex(scans.ball(30.0)), np.random.default_rng(1)
    outside = rng.normal(size=(200, 3))
    outside *= rng.uniform(25, 40, (200, 1)) / np.linalg.norm(outside, axis=1, keepdims=True)
    near = index.closest(outside)
    wanted = 30 * outside / np.linalg.norm(outside, axis=1, keepdims=True)
    assert np.linalg.norm(near.points - wanted, axis=1).max() < 0.4  # facets of 1.6 mm
    assert np.einsum("ni,ni->n", near.normals, wanted / 30).min() > 0.999
    assert not near.rim.any()


def test_points_beside_a_scan_are_nearest_to_its_rim() -> None:
    near = ScanIndex(scans.height_field(scans.plane)).closest(np.array([[45.0, 3.3, 1.0], [12.2, 3.1, 1.0]]))
    assert near.rim.tolist() == [True, False]
    np.testing.assert_allclose(near.points, [[40, 3.3, 0], [12.2, 3.1, 0]], atol=1e-5)  # float32
