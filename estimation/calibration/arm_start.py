"""A first pose of the arm by RANSAC from tips seen while it rested, and checks that refuse degenerate moves."""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.calibration.arm_model import Kinematics, SetPoint, Sightings
from estimation.errors import InputError
from estimation.mapping.triangulation import triangulate
from estimation.rig import Rig, distort
from estimation.se3 import Array, Index, Mask

ARM_CALIBRATION = "arm calibration"  # where an InputError says it comes from
MIN_PLACES = 4  # three give a pose, a fourth checks it
MAX_CAMERA_DISAGREEMENT = 3.0  # px, reprojection error beyond which a camera sees something else than the tip
MAX_PLACE_ERROR = 3.0  # mm between arm and cameras: the tool offset is not known yet
RANSAC_TRIES = 300  # of three places drawn
UNDISTORT_ROUNDS = 12  # of fixed-point iteration: to 1e-4 px for plain webcams
MIN_LINE_SPREAD, MIN_PLANE_SPREAD = 10.0, 5.0  # mm RMS of the places across the best line, and the best plane
MIN_TURN = float(np.deg2rad(3.0))  # RMS turn about the second axis
MIN_MOVING_PICTURES = 20  # fast enough, and again accelerated enough, to show latency:
MIN_SPEED, MIN_ACCELERATION = 10.0, 400.0  # mm/s, mm/s^2


def robust_rigid(source: Array, target: Array, near: float, rng: np.random.Generator) -> tuple[Array, Mask]:
    """The rigid motion that most points agree with to `near` mm, and its inliers (N,) (Fischler and Bolles 1981)."""
    best = np.zeros(len(source), bool)
    for _ in range(RANSAC_TRIES):
        three = rng.choice(len(source), 3, replace=False)
        spread = np.linalg.svd(source[three] - source[three].mean(0), compute_uv=False)[1]
        if spread > near:
            motion = se3.rigid_from_points(source[three], target[three])
            off = np.linalg.norm(se3.transform_points(motion, source) - target, axis=1)
            if (off < near).sum() > best.sum():
                best = off < near
    if best.sum() >= MIN_PLACES:
        found = se3.rigid_from_points(source[best], target[best])
        best = np.linalg.norm(se3.transform_points(found, source) - target, axis=1) < near
    if best.sum() < MIN_PLACES:
        hint = "is the needle in view, the rig right, the scene still?"
        allowed = f"{MIN_PLACES} or more that agree to {near:g} mm: {hint}"
        raise InputError(ARM_CALIBRATION, "places at which arm and cameras agree", int(best.sum()), allowed)
    return se3.rigid_from_points(source[best], target[best]), best


def triangulated_places(sightings: Sightings, rig: Rig) -> tuple[Index, Array]:
    """Numbers (P,) and points (P, 3), mm, base, of places where two cameras or more agree on the tip."""
    numbers, points = [], []
    for number in np.unique(sightings.place[sightings.place >= 0]):
        mine = sightings.take(sightings.place == number)
        pixels = {c: np.median(mine.pixels[mine.camera == c], axis=0) for c in np.unique(mine.camera).tolist()}
        point = _consensus_point(rig, pixels)
        if point is not None:
            numbers.append(int(number))
            points.append(point)
    return np.array(numbers, np.int64), np.array(points).reshape(-1, 3)


def _consensus_point(rig: Rig, pixels: dict[int, Array]) -> Array | None:
    """The point (3,) that most cameras agree on, by pixels (2,) of each; None where no two agree."""
    best: tuple[int, float, Array] | None = None
    cameras = list(pixels)
    for first in cameras:
        others = [c for c in cameras if c != first] if len(cameras) > 2 else list(cameras)
        for subset in ([list(cameras)] if first == cameras[0] else []) + [others]:
            if len(subset) < 2:
                continue
            ideal = np.concatenate([_undistorted(rig, c, pixels[c]) for c in subset])
            point, _, residuals = triangulate(rig, np.zeros(len(subset), np.int64), np.array(subset), ideal, 1)
            off = float(np.linalg.norm(residuals, axis=1).max())
            if off < MAX_CAMERA_DISAGREEMENT and (best is None or (len(subset), -off) > (best[0], -best[1])):
                best = len(subset), off, point[0]
    return None if best is None else best[2]


def _undistorted(rig: Rig, camera: int, pixel: Array) -> Array:
    own = rig.cameras[camera]
    ideal = pixel[None].astype(float)
    for _ in range(UNDISTORT_ROUNDS):
        ideal = pixel[None] - (distort(own, ideal) - ideal)
    return np.asarray(ideal)


def first_pose(
    sightings: Sightings, set_point: SetPoint, kinematics: Kinematics, rig: Rig, seed: int = 0
) -> tuple[Array, Array, Index]:
    """base_from_arm (4, 4), axes (P, 6) of the places that agree, and their numbers; InputError where too few do.

    Places with equal arm angles need no tool offset: the largest such group gives the pose, if it suffices.
    """
    numbers, points = triangulated_places(sightings, rig)
    if len(numbers) < MIN_PLACES:
        allowed = f"{MIN_PLACES} or more that two cameras see alike: is the needle in view of two cameras?"
        raise InputError(ARM_CALIBRATION, "places with a tip", len(numbers), allowed)
    stamps = np.array([sightings.stamp[sightings.place == n].max() for n in numbers])
    axes = set_point.lagged(stamps, 0.0, 0.0)
    arm_from_nozzle = kinematics(axes)
    alike = np.round(axes[:, 3:], 3)
    groups, which = np.unique(alike, axis=0, return_inverse=True)
    largest = which == np.bincount(which.ravel(), minlength=len(groups)).argmax()
    rng = np.random.default_rng([seed, 83])
    try:
        pose, _ = robust_rigid(arm_from_nozzle[largest][:, :3, 3], points[largest], MAX_PLACE_ERROR, rng)
    except (InputError, ValueError):  # too few, or in a line
        pose, _ = robust_rigid(arm_from_nozzle[:, :3, 3], points, 4 * MAX_PLACE_ERROR, rng)
    off = np.linalg.norm(se3.transform_points(pose, arm_from_nozzle[:, :3, 3]) - points, axis=1)
    good = off < 12 * MAX_PLACE_ERROR  # an unknown tool moves turned places
    return pose, axes[good], numbers[good]


def check_places(points: Array) -> None:
    """InputError unless places (N, 3), mm, determine the arm's pose."""
    if len(points) < MIN_PLACES:
        raise InputError(ARM_CALIBRATION, "places", len(points), f"{MIN_PLACES} or more")
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False) / np.sqrt(len(points))
    if spread[1] < MIN_LINE_SPREAD:
        allowed = f"{MIN_LINE_SPREAD:g} mm or more: places on one line leave the turn about it open"
        raise InputError(ARM_CALIBRATION, "spread of the places across a line", f"{spread[1]:.1f} mm", allowed)
    if spread[2] < MIN_PLANE_SPREAD:
        allowed = f"{MIN_PLANE_SPREAD:g} mm or more: places in one plane do not show what the arm's axis across it does"
        raise InputError(ARM_CALIBRATION, "spread of the places across a plane", f"{spread[2]:.1f} mm", allowed)


def check_turns(arm_from_nozzle: Array) -> None:
    """InputError unless the nozzle poses (N, 4, 4) turn about two axes, which the tool offset needs."""
    first = arm_from_nozzle[0, :3, :3].T
    turns = se3.log_rotation(first @ arm_from_nozzle[:, :3, :3])
    spread = np.linalg.svd(turns - turns.mean(0), compute_uv=False) / np.sqrt(len(turns))
    spread = np.concatenate([spread, np.zeros(3)])[:3]
    if spread[0] < MIN_TURN:
        allowed = "moves that turn A, B and C by 10 degrees and more, or --keep-tool: without, the tip's place is open"
        raise InputError(ARM_CALIBRATION, "turns of the tool", f"{np.rad2deg(spread[0]):.1f} degrees", allowed)
    if spread[1] < MIN_TURN:
        axis = "xyz"[int(np.abs(np.linalg.svd(turns - turns.mean(0))[2][0]).argmax())]
        allowed = f"turns about a second axis too, or --keep-tool: along {axis} the tip is open"
        raise InputError(ARM_CALIBRATION, "turns of the tool", f"about {axis} alone", allowed)


def check_latency(set_point: SetPoint, kinematics: Kinematics, stamps: Array) -> None:
    """InputError unless the moves at stamps (N,), s, are fast and accelerated enough to tell dead time from lag.

    A steady move shows only their sum; an acceleration separates them, by lag^2 / 2 of it.
    """
    step = 0.01
    around = [kinematics(set_point.lagged(stamps + h, 0.0, step))[:, :3, 3] for h in (-step, 0.0, step)]
    speed = np.linalg.norm(around[2] - around[0], axis=1) / (2 * step)
    acceleration = np.linalg.norm(around[2] - 2 * around[1] + around[0], axis=1) / step**2
    moving = int((speed > MIN_SPEED).sum())
    swung = int((acceleration > MIN_ACCELERATION).sum())
    if moving < MIN_MOVING_PICTURES:
        allowed = f"{MIN_MOVING_PICTURES} or more at over {MIN_SPEED:g} mm/s, or --keep-latency: "
        allowed += "how late it is shows on the way alone"
        raise InputError(ARM_CALIBRATION, "pictures of the arm on its way", moving, allowed)
    if swung < MIN_MOVING_PICTURES:
        allowed = f"{MIN_MOVING_PICTURES} or more at over {MIN_ACCELERATION:g} mm/s^2, or --keep-latency: "
        allowed += "steady moves show their sum alone"
        raise InputError(ARM_CALIBRATION, "pictures of the arm changing its speed", swung, allowed)
