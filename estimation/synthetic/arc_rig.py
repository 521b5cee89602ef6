"""The rig of thesis Fig. 4.3, and where the wound rests before it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation import se3
from estimation.rig import Camera, Rig

ANGLES_DEG = (0.0, 36.0, 84.0)  # about the wound, thesis Fig. 4.3
TARGET = np.array([180.0, 40.0, 60.0])  # mm, base frame: the middle of the room, where the wound rests
TILT = np.deg2rad(-38.0)  # of the wound, so that its normal stands amid the cameras and none of them grazes it
REST = se3.make(se3.exp_rotation([TILT, 0.0, 0.0]), TARGET)  # base_from_surface
DISTORTION = (-0.12, 0.06, 6e-4, -4e-4, 0.0)  # a plain webcam's


def arc_rig(
    angles_deg: Sequence[float] = ANGLES_DEG,
    distance: float = 400.0,
    focal: float = 1100.0,
    size: tuple[int, int] = (1280, 720),
    distortion: Sequence[float] = DISTORTION,
) -> Rig:
    """Cameras on an arc about TARGET, `angles_deg` from straight above, `distance` mm away, `focal` px."""
    cameras = []
    for i, angle in enumerate(np.deg2rad(angles_deg)):
        out = np.array([0.0, np.sin(angle), np.cos(angle)])  # from the wound to the camera
        right = np.array([1.0, 0.0, 0.0])
        rotation = np.stack([right, np.cross(-out, right), -out], axis=1)
        centre = np.array(
            [[focal * (1 + 0.01 * i), 0, size[0] / 2 - 3 + 5 * i], [0, focal, size[1] / 2 + 4 - 3 * i], [0, 0, 1]]
        )
        pose = se3.make(rotation, TARGET + distance * out)
        cameras.append(Camera(f"cam_{i}", size, centre, np.array(distortion, float), pose))
    return Rig(tuple(cameras))
