"""The free spin about the tool's axis, chosen for a whole path at once: as reachable and as smooth as it can be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimation.se3 import Array
from planning.path import Path
from planning.robot.kinematics import JointModel
from planning.robot.reach import SPINS, Motion, Reach, reach_of, spun

UNREACHED = 1e3  # of cost: no smoothness is worth a checkpoint that cannot be printed
STEP = 1.0  # of cost, for a spin by one candidate from one checkpoint to the next: what a turn on the spot is worth
ROOM = 1.0  # of cost per rad that a joint is nearer than ENOUGH to the end of its range
ENOUGH = float(np.deg2rad(30))


def best_spin(model: JointModel, arm_from_surface: Array, path: Path, motion: Motion) -> Array:
    """Spin (N,), rad, at each checkpoint: dynamic programming over SPINS candidates (Viterbi 1967).

    From one checkpoint to the next the tool spins by one candidate at most. The way back takes the path that costs
    least over all checkpoints: those that cannot be reached first, then spins, then joints near their ends.
    """
    candidates = np.linspace(-np.pi, np.pi, SPINS, endpoint=False)
    cost = np.stack([_cost(at_spin(model, arm_from_surface, path, motion, s)) for s in candidates])  # (K, N)
    best, came = cost[:, 0] + 1e-3 * np.abs(candidates), np.zeros((len(path), SPINS), np.int64)
    for i in range(1, len(path)):
        options = np.stack([best, np.roll(best, 1) + STEP, np.roll(best, -1) + STEP])
        choice = options.argmin(axis=0)
        came[i] = (np.arange(SPINS) - np.array([0, 1, -1])[choice]) % SPINS
        best = options.min(axis=0) + cost[:, i]
    chosen = np.empty(len(path), np.int64)
    chosen[-1] = best.argmin()
    for i in range(len(path) - 1, 0, -1):
        chosen[i - 1] = came[i, chosen[i]]
    return np.unwrap(candidates[chosen])


def at_spin(model: JointModel, arm_from_surface: Array, path: Path, motion: Motion, spin: Array | float) -> Reach:
    """What the path asks with its tool turned by `spin`, rad, one for all or (N,)."""
    spins = np.broadcast_to(np.asarray(spin, float), len(path))
    turned = replace(path, surface_from_nozzle=spun(path, spins))
    return replace(reach_of(model, arm_from_surface, turned, motion), spin=spins)


def _cost(found: Reach) -> Array:
    return np.where(found.feasible, ROOM * np.maximum(ENOUGH - np.nan_to_num(found.bound), 0.0), UNREACHED)
