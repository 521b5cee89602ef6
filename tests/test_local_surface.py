"""Rays meet the surface through known points where it is, as surely as claimed; normals do not lean at its rim."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.mapping.local_surface import LEAST, Met, meet, smooth_normals
from estimation.se3 import Array
from estimation.surface_map import local_normals

NOISE = 0.04  # mm
EYE = np.array([0.0, 250.0, 300.0])  # mm, from where the rays come
EXACT = 1e-7  # rad


def cylinder(flat: Array, radius: float) -> Array:
    """Points (N, 3) over (N, 2), bent about x."""
    return np.column_stack([flat, np.sqrt(radius**2 - flat[:, 1] ** 2) - radius])


def outward(points: Array, radius: float) -> Array:
    """The true normals (N, 3) there."""
    return np.column_stack([0 * points[:, 0], points[:, 1], points[:, 2] + radius]) / radius


def met(seed: int, radius: float, beside: bool, rough: float = 0.0) -> tuple[Met, Array]:
    """Forty rays onto a cylinder known at 120 points, among them or up to 10 mm beside; and heights (M,) over it."""
    rng = np.random.default_rng(seed)
    points = cylinder(rng.uniform(-1, 1, (120, 2)) * [30, 18], radius)
    aims = np.column_stack([rng.uniform(-25, 25, 40), rng.uniform(18, 28, 40) if beside else rng.uniform(-15, 15, 40)])
    true = cylinder(aims, radius)
    true[:, 2] += rng.normal(0, rough, 40)
    points += rng.normal(0, NOISE, points.shape) + rng.normal(0, 1, (120, 1)) * rough * [0, 0, 1]
    directions = (true - EYE) / np.linalg.norm(true - EYE, axis=1, keepdims=True)
    found = meet(points, NOISE**2 * np.eye(360), np.tile(EYE, (40, 1)), directions, np.full(40, EXACT))
    return found, np.einsum("mi,mi->m", found.points - true, found.normals)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000), st.floats(40.0, 300.0), st.booleans())
def test_a_height_is_no_farther_off_than_claimed(seed: int, radius: float, beside: bool) -> None:
    found, off = met(seed, radius, beside)
    assert found.good.all() and found.sigma.max() < 3.0
    assert np.mean((off / found.sigma) ** 2) < 1.6
    assert np.median(np.abs(off)) < (0.3 if beside else 0.03)


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
    points = np.random.default_rng(0).normal(size=(LEAST - 1, 3))
    assert not meet(points, np.zeros((33, 33)), EYE[None], -EYE[None] / 400, np.array([EXACT])).good.any()


@pytest.mark.parametrize("tilt", [0.0, 0.05])
def test_a_ray_that_grazes_meets_nothing(tilt: float) -> None:
    flat = np.random.default_rng(0).uniform(-20, 20, (60, 2))
    points = np.column_stack([flat, 0 * flat[:, 0]])
    ray = np.array([[1.0, 0.0, -tilt]]) / np.hypot(1.0, tilt)
    assert not meet(points, np.zeros((180, 180)), -400 * ray, ray, np.array([EXACT])).good.any()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.floats(35.0, 200.0))
def test_normals_at_the_rim_do_not_lean_inwards(seed: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    points = cylinder(rng.uniform(-1, 1, (150, 2)) * [30, 24], radius)
    points += rng.normal(0, 0.02, points.shape)
    true, up = outward(points, radius), np.array([0.0, 0.0, 1.0])
    off = np.arccos(np.clip((smooth_normals(points, up) * true).sum(1), -1, 1))
    leaning = np.arccos(np.clip((local_normals(points, up) * true).sum(1), -1, 1))
    rim = np.abs(points[:, 1]) > 18
    assert np.degrees(off).max() < 4
    assert off[rim].mean() < 0.5 * leaning[rim].mean() + 0.005
