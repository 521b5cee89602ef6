"""Rigs in other programs' files: OpenCV, ROS camera_info, Kalibr, aniposelib and caliscope."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from estimation.rig import Rig


@dataclass(frozen=True, slots=True)
class Format:
    """One kind of file. read: a path to a rig. write: a rig to a path. folder: whether it is a file per camera."""

    read: Callable[[Path], Rig]
    write: Callable[[Path, Rig], None]
    folder: bool


def formats() -> dict[str, Format]:
    """All kinds by name."""
    from hardware.calibration import rig_formats as per_camera
    from hardware.calibration.formats import anipose, kalibr

    return {
        "opencv": Format(per_camera.read_opencv, per_camera.write_opencv, True),
        "ros": Format(per_camera.read_ros, per_camera.write_ros, True),
        "kalibr": Format(kalibr.read, kalibr.write, False),
        "anipose": Format(anipose.read, anipose.write, False),
    }
