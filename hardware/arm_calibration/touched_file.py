"""Points that the tip has touched, as a TOML file, and the arm's calibration from them.

[[point]]
arm_mm_deg = [202.5, 225, 50, 0, 0, 0]      # X Y Z A B C that the arm was sent to, the tip on the point
base_mm = [180, 40, 60]                     # the same point where the rig has it,
[[point]]
arm_mm_deg = [240, 225, 52, 10, 0, 0]
pixels = {left = [612.5, 300.2], right = [655.0, 410.8]}   # or where two cameras or more see it, px
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.mapping.triangulation import triangulate
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.process import checks
from perception.lens import undistort

TOUCH = 0.2  # mm, one sigma: what a hand on a jog button is good for
CLICK = 1.0  # px, one sigma, of a point that somebody has marked in a picture
APART = 10.0  # px between where cameras see a point and where they should, beyond which it is not the same one
_TO_RAD = np.array([1.0, 1, 1, *np.deg2rad([1.0, 1, 1])])


@dataclass(frozen=True, slots=True, eq=False)
class TouchedPoints:
    """axes: (N, 6) mm and rad. points: (N, 3) mm, base. sigma: (N,) mm, of both together."""

    axes: Array
    points: Array
    sigma: Array


def read_touched(path: Path, rig: Rig) -> TouchedPoints:
    """The points in a file; InputError names the one that is wrong."""
    table = checks.read_toml(path)
    checks.check_keys(path, "", table, ("point",), ())
    axes, points, sigma = [], [], []
    for number, entry in enumerate(checks.tables(path, "point", table["point"])):
        key = f"point[{number}]."
        checks.check_keys(path, key, entry, ("arm_mm_deg",), ("base_mm", "pixels"))
        if ("base_mm" in entry) == ("pixels" in entry):
            raise InputError(path, key + "base_mm, pixels", "both or neither", "one of the two")
        axes.append(checks.numbers(path, key + "arm_mm_deg", entry["arm_mm_deg"], (6,), "mm and degrees") * _TO_RAD)
        if "base_mm" in entry:
            points.append(checks.numbers(path, key + "base_mm", entry["base_mm"], (3,), "mm"))
            sigma.append(TOUCH)
        else:
            point, spread = _seen(path, key + "pixels", entry["pixels"], rig)
            points.append(point)
            sigma.append(float(np.hypot(TOUCH, spread)))
    return TouchedPoints(np.array(axes).reshape(-1, 6), np.array(points).reshape(-1, 3), np.array(sigma))


def _seen(path: Path, key: str, value: object, rig: Rig) -> tuple[Array, float]:
    """The point (3,) mm that cameras see, and its one sigma, mm, along each axis."""
    names = [camera.name for camera in rig.cameras]
    if not isinstance(value, dict) or len(value) < 2:
        raise InputError(path, key, value, f"pixels of two cameras or more of {', '.join(names)}")
    checks.check_keys(path, key + ".", value, (), names)
    cameras = np.array([names.index(name) for name in value])
    pixels = [checks.numbers(path, f"{key}.{name}", value[name], (2,), "px") for name in value]
    ideal = np.concatenate([undistort(rig.cameras[c], p[None]) for c, p in zip(cameras, pixels, strict=True)])
    point, covariance, left = triangulate(rig, np.zeros(len(cameras), np.int64), cameras, ideal, 1)
    off = float(np.linalg.norm(left, axis=1).max())
    if not off <= APART:
        raise InputError(path, key, f"{off:.1f} px from the place where the cameras agree", f"{APART:g} px or less")
    return point[0], CLICK * float(np.sqrt(np.trace(covariance[0]) / 3))
