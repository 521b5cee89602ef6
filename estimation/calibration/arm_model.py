"""What the cameras should see of an arm's tip, from where the arm was sent.

    base_from_tip = base_from_arm @ arm_from_nozzle(axes) @ [tool, 1]

`arm_from_nozzle` is what the arm believes of its nozzle; `tool` is where the tip really is in that frame. A needle ends
bluntly: its picture's end is the rim's, so that each camera sees the end of the outline a little beyond the middle of
the tip; `blunt`, the radius, says by how much.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.arm_calibration.set_point import SetPoint
from estimation.calibration.lens_model import image, lens_of
from estimation.rig import Rig
from estimation.se3 import Array

Kinematics = Callable[[Array], Array]  # arm_from_nozzle (N, 4, 4) mm at axes (N, 6), as the arm believes

OWN = 16  # numbers of a camera: lens, place (a right perturbation), clock offset s
ROUND_END = np.pi / 4  # of the radius: mean height of half an ellipse over its axis, where the outline's end is found
NUDGE = 1e-4  # s, for slopes by time


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """The tip in pictures. stamp: (N,) s, on the cameras' common clock. camera: (N,). pixels: (N, 2) as imaged.

    sigma: (N,) px. place: (N,) number of the resting place it was seen at, -1 on the way: what is off alike there.
    """

    stamp: Array
    camera: NDArray[np.int64]
    pixels: Array
    sigma: Array
    place: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.stamp)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Sightings:
        """Some of them, by mask or number."""
        parts = self.stamp[rows], self.camera[rows], self.pixels[rows], self.sigma[rows], self.place[rows]
        return Sightings(*parts)


@dataclass(frozen=True, slots=True, eq=False)
class ArmState:
    """What is sought. base_from_arm: (4, 4) mm. tool: (3,) mm, tip in the nozzle frame that the arm believes in.

    dead_time, lag: s, from the set-point to the servo, and its time constant. blunt: mm, radius of the tip's end.
    """

    base_from_arm: Array
    tool: Array
    dead_time: float
    lag: float
    blunt: float


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """Pixels (N, 2) and their slopes: by base_from_arm (N, 2, 6), tool (N, 2, 3), dead time and lag (N, 2, 2), blunt
    (N, 2, 1), and by the numbers of the camera that sees it (N, 2, OWN)."""

    pixels: Array
    by_arm: Array
    by_tool: Array
    by_time: Array
    by_blunt: Array
    by_camera: Array


def tips(state: ArmState, set_point: SetPoint, kinematics: Kinematics, stamps: Array) -> Array:
    """Places (N, 3) mm, base, of the tip at stamps (N,), s."""
    axes = set_point.lagged(stamps, state.dead_time, state.lag)
    return se3.transform_points(state.base_from_arm @ kinematics(axes), state.tool[None])[:, 0]


def predict(
    state: ArmState, set_point: SetPoint, kinematics: Kinematics, rig: Rig, stamp: Array, camera: NDArray[np.int64]
) -> Predicted:
    """What cameras (N,) should see at stamps (N,), s, and how it changes with all that is not known exactly."""
    axes = set_point.lagged(stamp, state.dead_time, state.lag)
    arm_from_nozzle = kinematics(axes)
    in_arm = se3.transform_points(arm_from_nozzle, state.tool[None])[:, 0]
    rotation = state.base_from_arm[:3, :3]
    points = se3.transform_points(state.base_from_arm, in_arm)
    turned = rotation @ arm_from_nozzle[:, :3, :3]
    bases = np.stack([c.base_from_camera for c in rig.cameras])[camera]
    end = _end(points - bases[:, :3, 3], turned[:, :, 2])
    inside = np.einsum("nji,nj->ni", bases[:, :3, :3], points + state.blunt * end - bases[:, :3, 3])
    pixels, by_lens, by_inside = image(np.stack([lens_of(c) for c in rig.cameras])[camera], inside)
    by_point = by_inside @ np.swapaxes(bases[:, :3, :3], 1, 2)
    by_dead, by_lag = _by_time(state, set_point, kinematics, stamp)
    by_time = by_point @ np.stack([by_dead, by_lag], -1)
    by_place = np.concatenate([by_inside @ se3.hat(inside), -by_inside], -1)
    return Predicted(
        pixels,
        np.concatenate([by_point @ rotation @ -se3.hat(in_arm), by_point @ rotation], -1),
        by_point @ turned,
        by_time,
        by_point @ end[..., None],
        np.concatenate([by_lens, by_place, -by_time[..., :1]], -1),
    )


def _end(ray: Array, axis: Array) -> Array:
    """(N, 3) where the outline's end is, in radii from the tip's middle, for rays (N, 3) and the tool's axes (N, 3)."""
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    along = np.sum(ray * axis, 1, keepdims=True)
    across = ray - along * axis
    length = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    return np.asarray(ROUND_END * np.sign(along) * across / length)


def _by_time(state: ArmState, set_point: SetPoint, kinematics: Kinematics, stamp: Array) -> tuple[Array, Array]:
    """Slopes (N, 3), mm/s, of the tip by dead time and by lag."""
    least = min(state.lag, NUDGE)
    dead = [tips(replace(state, dead_time=state.dead_time + h), set_point, kinematics, stamp) for h in (-NUDGE, NUDGE)]
    lag = [tips(replace(state, lag=state.lag + h), set_point, kinematics, stamp) for h in (-least, NUDGE)]
    return (dead[1] - dead[0]) / (2 * NUDGE), (lag[1] - lag[0]) / (NUDGE + least)
