"""Made-up six-axis arms for tests."""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.se3 import Array
from planning.robot.kinematics import ELBOWS, SHOULDERS, WRISTS, JointModel

FLIP = np.diag([1.0, -1, -1])  # the nozzle's z points back into the tool, the flange's out of it


def random_model(draw: np.random.Generator, lateral: float = 30.0) -> JointModel:
    """An elbow arm of any proportions, side and posture, on any foot, with any tool. lateral: mm of shoulder offset."""
    sides = draw.choice([-1.0, 1.0], 4)
    lengths = draw.uniform([-40, 150, -40], [60, 300, 40])
    shifts = draw.uniform([50, -lateral, -lateral, 100, 30], [250, lateral, lateral, 300, 90])
    alpha = np.pi / 2 * np.array([sides[0], 0, *sides[1:], 0])
    dh = np.stack([np.append(lengths, [0.0, 0, 0]), alpha, np.insert(shifts, 4, 0.0), draw.uniform(-3, 3, 6)], 1)
    return JointModel(
        "made up",
        dh,
        np.full(6, -np.pi),
        np.full(6, np.pi),
        np.full(6, 2.0),
        np.full(6, 10.0),
        se3.exp(draw.normal(size=6) * [0.3, 0.3, 0.3, 50, 50, 50]),
        se3.exp(draw.normal(size=6) * [0.3, 0.3, 0.3, 20, 20, 20]) @ se3.make(FLIP, [0, 0, 80.0]),
        tuple(str(draw.choice(words)) for words in (SHOULDERS, ELBOWS, WRISTS)),  # type: ignore[arg-type]
    )


def random_joints(draw: np.random.Generator, count: int) -> Array:
    """Joints (count, 6), rad, anywhere."""
    return np.asarray(draw.uniform(-np.pi, np.pi, (count, 6)))
