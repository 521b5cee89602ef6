"""Landmarks of one camera get their depth as the surface turns under it; what does not fit is left out."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimation import se3
from estimation.depth import looked_at
from estimation.online.pose_solver import project
from estimation.own_doubt import VAGUE, OwnDoubt
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.arc_rig import REST, arc_rig
from estimation.synthetic.surfaces import patch

RIG = arc_rig()
CAMERA, DEPTH_SIGMA, PIXEL_SIGMA = 1, 2.0, 0.2  # mm, px
POSE = np.diag([1e-4**2] * 3 + [0.01**2] * 3)  # rad, mm
seeds = st.integers(0, 10_000)


def guessed(seed: int, count: int = 20) -> tuple[Array, SurfaceMap]:
    """True points (N, 3), and a map of them that is off along the camera's rays."""
    rng = np.random.default_rng(seed)
    true = patch(count, rng).points
    eye = (se3.inverse(REST) @ RIG.cameras[CAMERA].base_from_camera)[:3, 3]
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
        pose = REST @ se3.exp([turn, 0, 0, 0, 0, 0])
        pixels = project(RIG, camera, pose, true)[0] + rng.normal(0, PIXEL_SIGMA, (len(true), 2))
        pixels[:stray, 0] += 30.0
        said = pose @ se3.exp(rng.normal(0, np.sqrt(np.diag(POSE))))
        predicted, _, jacobians = project(RIG, camera, said, known.points)
        sigma = np.full(len(true), PIXEL_SIGMA)
        known, agrees = looked_at(known, rows, predicted - pixels, jacobians, sigma, POSE)
    return known, agrees


@settings(max_examples=12, deadline=None)
@given(seeds)
def test_a_surface_that_turns_tells_the_depth_as_surely_as_claimed(seed: int) -> None:
    true, known = guessed(seed)
    after, agrees = looked(seed, [0.1, 0.2, 0.3], known, true)
    error = (after.points - true).ravel()
    assert agrees.mean() > 0.9
    assert np.median(np.linalg.norm(after.points - true, axis=1)) < 0.25 * DEPTH_SIGMA
    assert 0.4 < error @ np.linalg.solve(after.covariance, error) / len(error) < 2.0


@settings(max_examples=5, deadline=None)
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
    after, agrees = looked_at(known, *none, POSE)
    assert after is known and len(agrees) == 0


def test_a_landmark_of_unknown_depth_counts_little_in_another_camera_and_fully_in_its_own() -> None:
    _, known = guessed(2)
    rows, sigma = np.arange(len(known)), np.full(len(known), PIXEL_SIGMA)
    wide = {}
    for camera in (CAMERA, 2):
        jacobians = project(RIG, np.full(len(known), camera), REST, known.points)[2]
        wide[camera] = OwnDoubt(known).widened(sigma, rows, jacobians)
    assert wide[CAMERA].max() < 1.3 * PIXEL_SIGMA and wide[2].min() > 5 * PIXEL_SIGMA


def test_landmarks_that_are_well_known_keep_their_sigmas() -> None:
    _, known = guessed(3)
    sure = SurfaceMap(known.points, known.normals, 0.9 * VAGUE**2 * np.eye(3 * len(known)))
    rows, sigma = np.arange(len(sure)), np.full(len(sure), PIXEL_SIGMA)
    jacobians = project(RIG, np.full(len(sure), 0), REST, sure.points)[2]
    assert OwnDoubt(sure).widened(sigma, rows, jacobians) is sigma
