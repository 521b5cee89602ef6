"""Steps and rest: how soon a movement of 300 um or 0.1 degree is flagged, and how often one that never was.

Noise is that of fits to synthetic tracks at rest, which is linear in them: a white part, and one that lasts. Poses are
drawn with it, so that an hour costs half a minute; the detector is the tracker's own.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.online.surface_state import MotionDetector
from estimation.se3 import Array
from estimation.synthetic.bound import pose_information
from estimation.synthetic.world import synthetic_world
from hardware.bench.figures import Figure, at_least, at_most

RATE = 30.0  # Hz
HOUR = 108_000  # frames
EVERY = 90  # frames between steps: 3 s, of which a second is spent until it counts as rest again
LASTING, SECONDS = 0.5, 2.0  # share of the white noise, and its time: what tracks drag along from frame to frame
SOON = 2  # frames
SIZES = np.array([np.deg2rad(0.1), 0.3])  # rad, mm


def run(options: argparse.Namespace) -> list[Figure]:
    """Measure steps, turns and rest."""
    rng = np.random.default_rng(options.seed)
    covariance = _covariance(options.noise)
    note = f"{options.noise:g} px, white, and {LASTING:.0%} of it over {SECONDS:g} s"
    figures = []
    for kind, name in enumerate(("turns of 0.1 degree", "steps of 300 um")):
        late = _lateness(kind, options.steps, covariance, rng)
        share = 100 * float(np.mean(late < SOON))
        figures.append(
            Figure(f"{name} flagged within {SOON} frames", share, "%", at_least(99.9), "thesis: asked", note)
        )
        figures.append(Figure(f"{name}, latest", float(late.max()) + 1, "frames", note=f"of {len(late)}"))
    false = _false_alarms(round(options.hours * HOUR), covariance, rng) / options.hours
    return [*figures, Figure("false alarms at rest", false, "1/h", at_most(1.0), note=f"{options.hours:g} h; {note}")]


def _covariance(noise: float) -> Array:
    """Of the pose (6, 6) from one frame set's tracks, by Fisher's information."""
    world = synthetic_world("still", seconds=0.1, noise=noise)
    pose = world.base_from_surface(np.array(0.0))
    information = pose_information(world.true_rig, pose, world.landmarks.points, next(iter(world)))
    return np.asarray(np.linalg.inv(information))


def _noise(count: int, covariance: Array, rng: np.random.Generator) -> Array:
    """Right perturbations (count, 6): white ones, and ones that last, LASTING times as large."""
    root = np.linalg.cholesky(covariance)
    keep = np.exp(-1 / (SECONDS * RATE))
    lasting = np.empty((count, 6))
    now = rng.normal(size=6)
    for k, drive in enumerate(np.sqrt(1 - keep**2) * rng.normal(size=(count, 6))):
        now = keep * now + drive
        lasting[k] = now
    return np.asarray((rng.normal(size=(count, 6)) + LASTING * lasting) @ root.T)


def _lateness(kind: int, steps: int, covariance: Array, rng: np.random.Generator) -> Array:
    """Frames (steps,) from the first pose of each movement, 0, to its flag; kind: 0 turns, 1 shifts."""
    first = EVERY * np.arange(1, steps + 1)
    places = np.zeros((EVERY * (steps + 2), 6))
    axes = rng.normal(size=(steps, 3))
    moved = SIZES[kind] * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    for k, (start, change) in enumerate(zip(first, moved, strict=True)):
        if k % 2:
            places[start:] = 0.0  # back, so that it stays near
        else:
            places[start:, 3 * kind : 3 * kind + 3] = change
    poses = se3.exp(places) @ se3.exp(_noise(len(places), covariance, rng))
    moving = _moving(poses, covariance)
    late = [
        int(np.argmax(moving[start : start + EVERY])) if moving[start : start + EVERY].any() else EVERY
        for start in first
    ]
    return np.where(moving[first - 1], EVERY, late)  # one that was not at rest before was not seen to begin


def _false_alarms(count: int, covariance: Array, rng: np.random.Generator) -> int:
    """Movements flagged in `count` frames at rest."""
    moving = _moving(se3.exp(_noise(count, covariance, rng)), covariance)
    return int(np.sum(moving[1:] & ~moving[:-1]))


def _moving(poses: Array, covariance: Array) -> NDArray[np.bool_]:
    """What the detector says (N,) of poses (N, 4, 4)."""
    detector = MotionDetector(np.zeros(3))
    return np.array([detector(k / RATE, pose, covariance).moving for k, pose in enumerate(poses)], bool)
