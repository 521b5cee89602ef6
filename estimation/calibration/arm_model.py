"""An arm's tip in pictures: its prediction from set-points, a first pose of the arm by RANSAC, and checks of the moves.

    base_from_tip = base_from_arm @ arm_from_nozzle(axes) @ [tool, 1]

`arm_from_nozzle` is the arm's own kinematics; `tool` is the true tip in that frame. A needle ends bluntly: the outline
ends at its rim, a little beyond the middle of the tip as each camera sees it. `blunt` is the radius of that rim.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.calibration.lens_model import lens_parameters, project_lens
from estimation.errors import InputError
from estimation.mapping.triangulation import triangulate
from estimation.rig import Rig, distort
from estimation.runtime import compiled
from estimation.se3 import Array, Index, Mask

Kinematics = Callable[[Array], Array]  # arm_from_nozzle (N, 4, 4) mm at axes (N, 6), by the arm's own model

MIN_LAG = 1e-9  # s: a smaller lag counts as none
OUTLINE_END = np.pi / 4  # of the radius: mean height of half an ellipse over its axis, where the outline ends
TIME_STEP = 1e-4  # s, for derivatives by time

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


@compiled("float64[:,::1](float64[::1], float64[:,::1], float64)")
def _lag_error(instants: Array, slopes: Array, lag: float) -> Array:
    """Error (K, 6) of a first-order lag at each knot of a polyline."""
    out = np.zeros_like(slopes)
    for knot in range(1, len(instants)):
        left = np.exp(-(instants[knot] - instants[knot - 1]) / lag)
        for axis in range(slopes.shape[1]):
            steady = slopes[knot - 1, axis] * lag
            out[knot, axis] = (out[knot - 1, axis] + steady) * left - steady
    return out


@dataclass(frozen=True, slots=True, eq=False)
class SetPoint:
    """The set-point over time: straight between knots, constant before and after them."""

    instants: Array  # (K,) s, rising
    axes: Array  # (K, 6) mm and rad

    @property
    def slopes(self) -> Array:
        """Speed (K, 6) after each knot, mm/s and rad/s; zero after the last."""
        ways = np.diff(self.axes, axis=0) / np.diff(self.instants)[:, None]
        return np.vstack([ways, np.zeros((1, self.axes.shape[1]))])

    def lagged(self, stamps: Array, dead_time: float, lag: float) -> Array:
        """Axes (N, 6) at stamps (N,), s, of servos with dead time and lag, s: exactly lag y' = u(t - dead) - y."""
        slopes, lag = self.slopes, max(lag, MIN_LAG)
        behind = _lag_error(np.ascontiguousarray(self.instants), np.ascontiguousarray(slopes), lag)
        when = stamps - dead_time
        knot = np.searchsorted(self.instants, when, "right") - 1
        since = np.where(knot >= 0, when - self.instants[np.maximum(knot, 0)], 0.0)
        knot = np.maximum(knot, 0)
        left = np.exp(-since / lag)[:, None]
        held = np.where((when >= self.instants[0])[:, None], slopes[knot], 0.0)
        return np.asarray(self.axes[knot] + held * since[:, None] + behind[knot] * left + held * lag * (left - 1))

    def places(self, stamps: Array, settle: float) -> Index:
        """Number (N,) of the place where the arm has rested for `settle` s at each stamp, s; -1 while it moves."""
        moves = np.abs(self.slopes).max(1) > 0
        ended = np.where(np.concatenate([[False], moves[:-1]]), self.instants, -np.inf)  # end of a move, at each knot
        ended = np.maximum.accumulate(ended)
        number = np.unique(ended, return_inverse=True)[1]
        knot = np.maximum(np.searchsorted(self.instants, stamps, "right") - 1, 0)
        rests = ~moves[knot] & (stamps - ended[knot] >= settle)
        return np.where(rests, number[knot], -1)


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """The tip in pictures: N pixels."""

    stamp: Array  # (N,) s, on the cameras' common clock
    camera: Index  # (N,)
    pixels: Array  # (N, 2) distorted
    sigma: Array  # (N,) px
    place: Index  # (N,) number of the resting place, whose errors are correlated; -1 while the arm moves

    def __len__(self) -> int:
        return len(self.stamp)

    def take(self, rows: Mask | Index) -> Sightings:
        """The given rows, by mask or number."""
        return Sightings(self.stamp[rows], self.camera[rows], self.pixels[rows], self.sigma[rows], self.place[rows])


@dataclass(frozen=True, slots=True, eq=False)
class ArmParameters:
    """The parameters of an arm that a calibration estimates."""

    base_from_arm: Array  # (4, 4) mm
    tool: Array  # (3,) mm, tip in the nozzle frame of the arm's own kinematics
    dead_time: float  # s, from the set-point to the servo
    lag: float  # s, time constant of the servo
    blunt: float  # mm, radius of the tip's end


@dataclass(frozen=True, slots=True, eq=False)
class TipPrediction:
    """Predicted pixels and their Jacobians."""

    pixels: Array  # (N, 2)
    by_arm: Array  # (N, 2, 6) right perturbation of base_from_arm
    by_tool: Array  # (N, 2, 3)
    by_time: Array  # (N, 2, 2) dead time and lag
    by_blunt: Array  # (N, 2, 1)
    by_camera: Array  # (N, 2, 16) parameters of the camera that sees it


def tip_positions(state: ArmParameters, set_point: SetPoint, kinematics: Kinematics, stamps: Array) -> Array:
    """Tip positions (N, 3) mm, base, at stamps (N,), s."""
    axes = set_point.lagged(stamps, state.dead_time, state.lag)
    return se3.transform_points(state.base_from_arm @ kinematics(axes), state.tool[None])[:, 0]


def predict(
    state: ArmParameters, set_point: SetPoint, kinematics: Kinematics, rig: Rig, stamp: Array, camera: Index
) -> TipPrediction:
    """Predicted pixels of the tip in cameras (N,) at stamps (N,), s, with their Jacobians."""
    axes = set_point.lagged(stamp, state.dead_time, state.lag)
    arm_from_nozzle = kinematics(axes)
    in_arm = se3.transform_points(arm_from_nozzle, state.tool[None])[:, 0]
    rotation = state.base_from_arm[:3, :3]
    points = se3.transform_points(state.base_from_arm, in_arm)
    turned = rotation @ arm_from_nozzle[:, :3, :3]
    bases = np.stack([c.base_from_camera for c in rig.cameras])[camera]
    end = _end(points - bases[:, :3, 3], turned[:, :, 2])
    inside = np.einsum("nji,nj->ni", bases[:, :3, :3], points + state.blunt * end - bases[:, :3, 3])
    pixels, by_lens, by_inside = project_lens(np.stack([lens_parameters(c) for c in rig.cameras])[camera], inside)
    by_point = by_inside @ np.swapaxes(bases[:, :3, :3], 1, 2)
    by_dead, by_lag = _by_time(state, set_point, kinematics, stamp)
    by_time = by_point @ np.stack([by_dead, by_lag], -1)
    by_place = np.concatenate([by_inside @ se3.hat(inside), -by_inside], -1)
    return TipPrediction(
        pixels,
        np.concatenate([by_point @ rotation @ -se3.hat(in_arm), by_point @ rotation], -1),
        by_point @ turned,
        by_time,
        by_point @ end[..., None],
        np.concatenate([by_lens, by_place, -by_time[..., :1]], -1),
    )


def _end(ray: Array, axis: Array) -> Array:
    """End of the outline (N, 3) from the tip's middle, in radii, for rays (N, 3) and tool axes (N, 3)."""
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    along = np.sum(ray * axis, 1, keepdims=True)
    across = ray - along * axis
    length = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    return np.asarray(OUTLINE_END * np.sign(along) * across / length)


def _by_time(state: ArmParameters, set_point: SetPoint, kinematics: Kinematics, stamp: Array) -> tuple[Array, Array]:
    """Derivatives (N, 3), mm/s, of the tip by dead time and by lag."""

    def tips(dead: float, lag: float) -> Array:
        moved = replace(state, dead_time=state.dead_time + dead, lag=state.lag + lag)
        return tip_positions(moved, set_point, kinematics, stamp)

    h, back = TIME_STEP, min(state.lag, TIME_STEP)  # the lag stays positive
    return (tips(h, 0) - tips(-h, 0)) / (2 * h), (tips(0, h) - tips(0, -back)) / (h + back)


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
        motion = se3.rigid_from_points(source[best], target[best])
        best = np.linalg.norm(se3.transform_points(motion, source) - target, axis=1) < near
    if best.sum() < MIN_PLACES:
        hint = "is the needle in view, the rig right, the scene still?"
        allowed = f"{MIN_PLACES} or more that agree to {near:g} mm: {hint}"
        raise InputError(ARM_CALIBRATION, "places at which arm and cameras agree", int(best.sum()), allowed)
    return se3.rigid_from_points(source[best], target[best]), best


def triangulated_places(sightings: Sightings, rig: Rig) -> tuple[Index, Array]:
    """Numbers (P,) and points (P, 3), mm, base, of places where two cameras or more agree on the tip."""
    points: dict[int, Array] = {}
    for number in np.unique(sightings.place[sightings.place >= 0]):
        mine = sightings.take(sightings.place == number)
        pixels = {c: np.median(mine.pixels[mine.camera == c], axis=0) for c in np.unique(mine.camera).tolist()}
        point = _consensus_point(rig, pixels)
        if point is not None:
            points[int(number)] = point
    return np.array(list(points), np.int64), np.array(list(points.values())).reshape(-1, 3)


def _consensus_point(rig: Rig, pixels: dict[int, Array]) -> Array | None:
    """The point (3,) that most cameras agree on, by pixels (2,) of each; None where no two agree."""
    best: tuple[int, float, Array] | None = None
    cameras = list(pixels)
    for first in cameras:
        others = [c for c in cameras if c != first] if len(cameras) > 2 else cameras
        for subset in ([cameras] if first == cameras[0] else []) + [others]:
            if len(subset) < 2:
                continue
            ideal = np.concatenate([_undistorted(rig, c, pixels[c]) for c in subset])
            point, _, residuals = triangulate(rig, np.zeros(len(subset), np.int64), np.array(subset), ideal, 1)
            off = float(np.linalg.norm(residuals, axis=1).max())
            if off < MAX_CAMERA_DISAGREEMENT and (best is None or (len(subset), -off) > (best[0], -best[1])):
                best = len(subset), off, point[0]
    return None if best is None else best[2]


def _undistorted(rig: Rig, camera: int, pixel: Array) -> Array:
    ideal = pixel[None].astype(float)
    for _ in range(UNDISTORT_ROUNDS):
        ideal = pixel[None] - (distort(rig.cameras[camera], ideal) - ideal)
    return np.asarray(ideal)


def first_pose(
    sightings: Sightings, set_point: SetPoint, kinematics: Kinematics, rig: Rig
) -> tuple[Array, Array, Index]:
    """base_from_arm (4, 4), axes (P, 6) of the places that agree, and their numbers; InputError where too few do."""
    numbers, points = triangulated_places(sightings, rig)
    if len(numbers) < MIN_PLACES:
        allowed = f"{MIN_PLACES} or more that two cameras see alike: is the needle in view of two cameras?"
        raise InputError(ARM_CALIBRATION, "places with a tip", len(numbers), allowed)
    stamps = np.array([sightings.stamp[sightings.place == n].max() for n in numbers])
    axes = set_point.lagged(stamps, 0.0, 0.0)
    arm_from_nozzle = kinematics(axes)
    # places with equal arm angles need no tool offset: the largest such group gives the pose, if it suffices
    alike = np.round(axes[:, 3:], 3)
    groups, which = np.unique(alike, axis=0, return_inverse=True)
    largest = which == np.bincount(which.ravel(), minlength=len(groups)).argmax()
    rng = np.random.default_rng([0, 83])
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
    """InputError unless the moves at stamps (N,), s, are fast and accelerated enough to tell dead time from lag."""
    # a steady move shows only their sum; an acceleration separates them, by lag^2 / 2 of it
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
