"""A first place of the arm before the cameras, that blunders do not spoil: from tips seen while the arm rested."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.arm_calibration.set_point import SetPoint
from estimation.calibration.arm_model import Kinematics, Sightings
from estimation.errors import InputError
from estimation.mapping.triangulation import triangulate
from estimation.rig import Rig, distort
from estimation.se3 import Array

FEWEST = 4  # places: three tell a pose, a fourth tells whether they can be believed
AGREED = 3.0  # px between where cameras see a tip, beyond which one of them sees something else
NEAR = 3.0  # mm between two ways to the same tip: a tool offset is not known yet
TRIES = 300  # of three places drawn
UNDISTORTED = 12  # rounds of fixed-point iteration: to 1e-4 px for plain webcams


def robust_rigid(
    source: Array, target: Array, near: float, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]]:
    """The motion that most points agree with, to `near` mm, and which (N,) those are (Fischler and Bolles 1981)."""
    best = np.zeros(len(source), bool)
    for _ in range(TRIES):
        three = rng.choice(len(source), 3, replace=False)
        spread = np.linalg.svd(source[three] - source[three].mean(0), compute_uv=False)[1]
        if spread > near:
            motion = se3.rigid_from_points(source[three], target[three])
            off = np.linalg.norm(se3.transform_points(motion, source) - target, axis=1)
            if (off < near).sum() > best.sum():
                best = off < near
    if best.sum() >= FEWEST:
        found = se3.rigid_from_points(source[best], target[best])
        best = np.linalg.norm(se3.transform_points(found, source) - target, axis=1) < near
    if best.sum() < FEWEST:
        allowed = f"{FEWEST} or more that agree to {near:g} mm: is the needle in view, the rig right, the scene still?"
        raise InputError("arm calibration", "places at which arm and cameras agree", int(best.sum()), allowed)
    return se3.rigid_from_points(source[best], target[best]), best


def seen_places(sightings: Sightings, rig: Rig) -> tuple[NDArray[np.int64], Array]:
    """Numbers (P,) and points (P, 3), mm, base, of places at which two cameras or more see the tip alike."""
    numbers, points = [], []
    for number in np.unique(sightings.place[sightings.place >= 0]):
        mine = sightings.take(sightings.place == number)
        found = [_middle(mine, c) for c in range(len(rig))]
        point = _agreed(rig, [c for c in range(len(rig)) if found[c] is not None], found)
        if point is not None:
            numbers.append(int(number))
            points.append(point)
    return np.array(numbers, np.int64), np.array(points).reshape(-1, 3)


def _middle(sightings: Sightings, camera: int) -> Array | None:
    mine = sightings.pixels[sightings.camera == camera]
    return np.asarray(np.median(mine, axis=0)) if len(mine) else None


def _agreed(rig: Rig, cameras: Sequence[int], found: Sequence[Array | None]) -> Array | None:
    """The point (3,) that most cameras agree on, or None."""
    best: tuple[int, float, Array] | None = None
    for first in cameras:
        others = [c for c in cameras if c != first] if len(cameras) > 2 else list(cameras)
        for subset in ([list(cameras)] if first == cameras[0] else []) + [others]:
            if len(subset) < 2:
                continue
            seen = np.stack([p for c in subset if (p := found[c]) is not None])
            ideal = np.concatenate([_ideal(rig, c, p) for c, p in zip(subset, seen, strict=True)])
            point, _, left = triangulate(rig, np.zeros(len(subset), np.int64), np.array(subset), ideal, 1)
            off = float(np.linalg.norm(left, axis=1).max())
            if off < AGREED and (best is None or (len(subset), -off) > (best[0], -best[1])):
                best = len(subset), off, point[0]
    return None if best is None else best[2]


def _ideal(rig: Rig, camera: int, pixel: Array) -> Array:
    """The undistorted pixel (1, 2) of an imaged one (2,)."""
    own = rig.cameras[camera]
    ideal = pixel[None].astype(float)
    for _ in range(UNDISTORTED):
        ideal = pixel[None] - (distort(own, ideal) - ideal)
    return np.asarray(ideal)


def first_pose(
    sightings: Sightings, set_point: SetPoint, kinematics: Kinematics, rig: Rig, seed: int = 0
) -> tuple[Array, Array, NDArray[np.int64]]:
    """base_from_arm (4, 4), axes (P, 6) of the places that agree, and their numbers. InputError where too few do.

    Places at which the arm's angles are alike need no tool offset: the largest such group is asked, if it suffices.
    """
    numbers, points = seen_places(sightings, rig)
    if len(numbers) < FEWEST:
        allowed = f"{FEWEST} or more that two cameras see alike: is the needle in view of two cameras?"
        raise InputError("arm calibration", "places with a tip", len(numbers), allowed)
    stamps = np.array([sightings.stamp[sightings.place == n].max() for n in numbers])
    axes = set_point.lagged(stamps, 0.0, 0.0)
    arm_from_nozzle = kinematics(axes)
    alike = np.round(axes[:, 3:], 3)
    groups, which = np.unique(alike, axis=0, return_inverse=True)
    largest = which == np.bincount(which.ravel(), minlength=len(groups)).argmax()
    rng = np.random.default_rng([seed, 83])
    try:
        pose, _ = robust_rigid(arm_from_nozzle[largest][:, :3, 3], points[largest], NEAR, rng)
    except (InputError, ValueError):  # too few, or in a line
        pose, _ = robust_rigid(arm_from_nozzle[:, :3, 3], points, 4 * NEAR, rng)
    off = np.linalg.norm(se3.transform_points(pose, arm_from_nozzle[:, :3, 3]) - points, axis=1)
    good = off < 12 * NEAR  # an unknown tool sets turned ones apart
    return pose, axes[good], numbers[good]
