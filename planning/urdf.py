"""Arms with more joints than six, or of another build: kinematics from a URDF file, by pinocchio.

The inverse is damped least squares (Nakamura and Hanafusa 1986) from the solution of the checkpoint before; what
freedom is left draws the joints towards a posture that the arm file names, so that a path is printed without a flip.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path as File

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from planning.path import Path, Reach, SurfaceMotion, joint_speed_share

MAX_STEPS = 100  # of one solution; from one checkpoint to the next three are usual
DAMPING = 1e-3  # rad or m a unit: below it a direction counts as lost
POSTURE_GAIN = 0.1  # share of what is left of the posture that a step goes back
PLACE_TOLERANCE, TURN_TOLERANCE = 0.01, 1e-4  # mm and rad
MAX_STEP = 0.2  # rad a step, so that a far start does not overshoot
MIN_MANIPULABILITY = 0.02  # Yoshikawa's, m^3; a FR3 has 0.1 where it stands well, 0 where it is singular
EXTRA = "stillbed with its extra: pip install 'stillbed[franka]'"


@dataclass(frozen=True, slots=True, eq=False)
class UrdfArm:
    """What an arm file says of an arm whose joints a URDF file describes."""

    name: str
    file: File
    flange: str  # link
    ready: Array  # (J,) rad, the posture that it keeps near
    text: str = ""  # of the file, where it came along; "": it is read where it is needed


class UrdfKinematics:
    """One arm's kinematics. InputError where the file does not fit, or pinocchio is not installed."""

    def __init__(self, arm: UrdfArm, flange_from_nozzle: Array) -> None:
        try:
            import pinocchio
        except ImportError as error:
            raise InputError(arm.file, "kinematics.urdf", "pinocchio is not installed", EXTRA) from error
        if not arm.text and not arm.file.is_file():
            raise InputError(arm.file, "kinematics.urdf", "no such file", "a URDF file beside the arm file")
        try:
            self._model = pinocchio.buildModelFromXML(arm.text or arm.file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(arm.file, "URDF", str(error).splitlines()[0], "a robot of one chain of joints") from error
        if not self._model.existFrame(arm.flange):
            names = ", ".join(frame.name for frame in self._model.frames)
            raise InputError(arm.file, "kinematics.flange", arm.flange, f"one of its links: {names}")
        if arm.ready.shape != (self._model.nq,):
            raise InputError(arm.file, "kinematics.ready_deg", arm.ready.tolist(), f"{self._model.nq} numbers, degrees")
        self._data, self._frame = self._model.createData(), self._model.getFrameId(arm.flange)
        self._forward = partial(pinocchio.framesForwardKinematics, self._model, self._data)
        self._frame_jacobian = partial(pinocchio.computeFrameJacobian, self._model, self._data)
        self._aligned = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        self.name, self.ready, self._flange_from_nozzle = arm.name, arm.ready, flange_from_nozzle
        self.low, self.high = (np.array(self._model.lowerPositionLimit), np.array(self._model.upperPositionLimit))
        self.speed = np.array(self._model.velocityLimit)  # (J,) rad/s

    def nozzle(self, joints: Array) -> Array:
        """arm_from_nozzle (4, 4), mm, at joints (J,), rad."""
        self._forward(joints)
        pose = np.array(self._data.oMf[self._frame].homogeneous)
        pose[:3, 3] *= 1000.0
        return np.asarray(pose @ self._flange_from_nozzle)

    def jacobian(self, joints: Array) -> Array:
        """Velocity (6, J) of the nozzle, turn and then tip, rad and mm, arm's frame, by the speed of each joint."""
        linear, turn = np.split(np.array(self._frame_jacobian(joints, self._frame, self._aligned)), 2)
        self._forward(joints)
        rotation = self._data.oMf[self._frame].rotation
        arm = rotation @ self._flange_from_nozzle[:3, 3]  # mm, from the flange to the tip
        return np.concatenate([turn, 1000.0 * linear + np.cross(turn.T, arm).T])

    def joints(self, arm_from_nozzle: Array, start: Array) -> Array:
        """Joints (J,), rad, that bring the nozzle to a pose (4, 4), mm, from `start` on; NaN where none are found."""
        at = start.copy()
        unit = np.repeat([1.0, 1e-3], 3)  # mm to m, so that turns and ways count alike
        for _ in range(MAX_STEPS):
            here, matrix = self.nozzle(at), self.jacobian(at) * unit[:, None]
            way, turn = arm_from_nozzle[:3, 3] - here[:3, 3], se3.log_rotation(arm_from_nozzle[:3, :3] @ here[:3, :3].T)
            if np.linalg.norm(way) <= PLACE_TOLERANCE and np.linalg.norm(turn) <= TURN_TOLERANCE:
                return at
            damped = matrix.T @ np.linalg.inv(matrix @ matrix.T + DAMPING**2 * np.eye(6))
            free = np.eye(len(at)) - damped @ matrix
            step = damped @ (np.concatenate([turn, way]) * unit) + free @ (POSTURE_GAIN * (self.ready - at))
            at = at + step * min(1.0, MAX_STEP / max(float(np.abs(step).max()), 1e-12))
        return np.full_like(at, np.nan)

    def manipulability(self, joints: Array) -> float:
        """Yoshikawa's, of the flange's turn and way in m; NaN at joints (J,) that are NaN."""
        if not np.isfinite(joints).all():
            return float("nan")
        matrix = self.jacobian(joints) * np.repeat([1.0, 1e-3], 3)[:, None]
        return float(np.sqrt(max(np.linalg.det(matrix @ matrix.T), 0.0)))


def urdf_reach(arm: UrdfKinematics, arm_from_surface: Array, path: Path, motion: SurfaceMotion) -> Reach:
    """The reach where the surface rests at arm_from_surface (4, 4); distances of a wrist, elbow or shoulder are NaN."""
    found = []
    for place in motion.places:
        start, row = arm.ready, []
        for pose in arm_from_surface @ place @ path.surface_from_nozzle:
            joints = arm.joints(pose, start)
            start = joints if np.isfinite(joints).all() else start
            row.append(joints)
        found.append(row)
    joints = np.array(found)  # (S, N, J)
    with np.errstate(invalid="ignore"):
        bound = np.minimum(joints - arm.low, arm.high - joints).min(axis=(0, 2))
    good = np.array([[arm.manipulability(each) for each in row] for row in joints]).min(axis=0)
    inverse = np.full((len(path), len(arm.ready), 6), np.nan)
    for i in np.flatnonzero(np.isfinite(joints[0]).all(axis=1)):
        inverse[i] = np.linalg.pinv(arm.jacobian(joints[0, i]))
    speed = joint_speed_share(inverse, arm.speed, arm_from_surface, path, motion)
    with np.errstate(invalid="ignore"):
        wrong = [~np.isfinite(joints).all(axis=(0, 2)), bound < 0, good < MIN_MANIPULABILITY, ~(speed <= 1)]
    reason = np.select(wrong, list(range(1, len(wrong) + 1)), 0)
    unknown = np.full(len(path), np.nan)
    return Reach(joints[0], bound, unknown, unknown, unknown, good, speed, reason.astype(np.int64), np.zeros(len(path)))
