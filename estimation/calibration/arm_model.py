"""Predicted pixels of an arm's tip from the set-points that the arm was sent.

    base_from_tip = base_from_arm @ arm_from_nozzle(axes) @ [tool, 1]

`arm_from_nozzle` is the arm's own kinematics; `tool` is the true tip in that frame. A needle ends bluntly: the outline
ends at its rim, a little beyond the middle of the tip as each camera sees it. `blunt` is the radius of that rim.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.calibration.lens_model import lens_of, project_lens
from estimation.rig import Rig
from estimation.runtime import compiled
from estimation.se3 import Array, Index, Mask

Kinematics = Callable[[Array], Array]  # arm_from_nozzle (N, 4, 4) mm at axes (N, 6), by the arm's own model

MIN_LAG = 1e-9  # s: a smaller lag counts as none
OUTLINE_END = np.pi / 4  # of the radius: mean height of half an ellipse over its axis, where the outline ends
TIME_STEP = 1e-4  # s, for derivatives by time


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
        """Axes (N, 6) at stamps (N,), s, of servos with a dead time, s, and a first-order lag, s.

        Exact solution of lag y' = u - y, with the set-point u of `dead_time` ago.
        """
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
        parts = self.stamp[rows], self.camera[rows], self.pixels[rows], self.sigma[rows], self.place[rows]
        return Sightings(*parts)


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
    pixels, by_lens, by_inside = project_lens(np.stack([lens_of(c) for c in rig.cameras])[camera], inside)
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
