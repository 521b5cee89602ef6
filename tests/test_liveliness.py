"""The density of the acceleration is found from the poses alone, and follows when the motion changes."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.liveliness import Liveliness
from estimation.se3 import Array

DT = 1 / 30
NOISE = np.array([1e-3] * 3 + [0.02] * 3)  # rad, mm


def wander(psd: Array, count: int, seed: int) -> Array:
    """Positions (count, 6) of a body under white-noise acceleration of density `psd` (6,)."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]]))
    state, out = np.zeros((2, 6)), np.zeros((count, 6))
    for k in range(count):
        state = np.stack([state[0] + DT * state[1], state[1]]) + (root @ rng.normal(size=(2, 6))) * np.sqrt(psd)
        out[k] = state[0] + NOISE * rng.normal(size=6)
    return out


def follow(lively: Liveliness, positions: Array) -> Liveliness:
    for moved in np.diff(positions, axis=0):
        lively.add(moved, DT, NOISE**2)
    return lively


@pytest.mark.parametrize("rotation", [1e-4, 1e-2, 1.0])
@pytest.mark.parametrize("translation", [1.0, 100.0, 1e4])
def test_the_density_of_a_motion_is_found_to_a_factor_of_four(rotation: float, translation: float) -> None:
    true = np.array([rotation] * 3 + [translation] * 3)
    found = follow(Liveliness(), wander(true, 300, 1)).psd
    assert (np.abs(np.log(found / true)) < np.log(4)).all()


def test_a_surface_at_rest_is_found_to_be() -> None:
    found = follow(Liveliness(), wander(np.zeros(6), 300, 2)).psd
    assert (found[:3] < 1e-5).all() and (found[3:] < 0.3).all()


def test_it_follows_within_a_second_when_the_motion_becomes_lively() -> None:
    lively = follow(Liveliness(), wander(np.array([1e-4] * 3 + [1.0] * 3), 200, 3))
    before = lively.psd
    after = follow(lively, wander(np.array([1.0] * 3 + [1e4] * 3), 30, 4)).psd
    assert (after > 100 * before).all()


def test_a_single_jerk_does_not_make_a_motion_lively() -> None:
    lively = follow(Liveliness(), wander(np.array([1e-4] * 3 + [1.0] * 3), 200, 5))
    before = lively.psd
    lively.add(np.array([0.0, 0.0, 0.0, 5.0, 0.0, 0.0]), DT, NOISE**2)
    assert (lively.psd < 1e3 * before).all()
