"""A YAML file per camera: OpenCV's FileStorage and ROS's camera_info. Places go with them as `base_from_camera`, mm."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from hardware.calibration.formats.build import Entry, matrix, pinhole, rig_of
from hardware.calibration.formats.yaml_file import read_yaml, write_yaml
from hardware.process import checks
from hardware.process.checks import Table

SUFFIXES = (".yaml", ".yml")


def read_opencv(path: Path) -> Rig:
    """The rig in a folder of OpenCV's calibration files, or in one of them; each is named for its camera."""
    return rig_of(path, [_opencv(p) for p in _files(path)])


def write_opencv(path: Path, rig: Rig) -> None:
    """Write a folder of files that cv2.FileStorage reads."""
    path.mkdir(parents=True, exist_ok=True)
    for camera in rig.cameras:
        w, h = camera.size
        lines = ["%YAML:1.0", "---", f"image_width: {w}", f"image_height: {h}"]
        lines += _cv_matrix("camera_matrix", camera.matrix)
        lines += _cv_matrix("distortion_coefficients", camera.distortion[None])
        lines += _cv_matrix("base_from_camera", camera.base_from_camera)
        lines.append(f"clock_offset_s: {float(camera.clock_offset)!r}")
        (path / f"{camera.name}.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_ros(path: Path) -> Rig:
    """The rig in a folder of camera_info files, or in one of them."""
    return rig_of(path, [_ros(p) for p in _files(path)])


def write_ros(path: Path, rig: Rig) -> None:
    """Write a folder of camera_info files; rectification is none, since these are no stereo pairs."""
    path.mkdir(parents=True, exist_ok=True)
    for camera in rig.cameras:
        write_yaml(path / f"{camera.name}.yaml", _ros_table(camera))


def _files(path: Path) -> list[Path]:
    found = [path] if path.is_file() else sorted(p for p in path.glob("*") if p.suffix in SUFFIXES)
    if not found:
        raise InputError(path, "files", "none", "a .yaml file per camera")
    return found


def _cv_matrix(name: str, values: Array) -> list[str]:
    rows, columns = values.shape
    data = ", ".join(repr(float(v)) for v in values.ravel())
    return [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d", f"   data: [ {data} ]"]


def _opencv(path: Path) -> Entry:
    table = read_yaml(path)
    focal = pinhole(path, matrix(path, table, "camera_matrix"))
    bends = matrix(path, table, "distortion_coefficients").ravel()
    return Entry(path.stem, _size(path, table), focal, bends, _place(path, table), _offset(path, table))


def _ros(path: Path) -> Entry:
    table = read_yaml(path)
    if table.get("distortion_model") != "plumb_bob":
        raise InputError(path, "distortion_model", table.get("distortion_model"), "plumb_bob")
    name = checks.text(path, "camera_name", table.get("camera_name"))
    focal = pinhole(path, matrix(path, table, "camera_matrix"))
    bends = matrix(path, table, "distortion_coefficients").ravel()
    return Entry(name, _size(path, table), focal, bends, _place(path, table), _offset(path, table))


def _ros_table(camera: Camera) -> Table:
    projection = np.hstack([camera.matrix, np.zeros((3, 1))])
    return {
        "image_width": camera.size[0],
        "image_height": camera.size[1],
        "camera_name": camera.name,
        "camera_matrix": _rows(camera.matrix),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": _rows(camera.distortion[None]),
        "rectification_matrix": _rows(np.eye(3)),
        "projection_matrix": _rows(projection),
        "base_from_camera": _rows(camera.base_from_camera),
        "clock_offset_s": float(camera.clock_offset),
    }


def _rows(values: Array) -> Table:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}


def _size(path: Path, table: Table) -> tuple[int, int]:
    width, height = (checks.integer(path, key, table.get(key), 1) for key in ("image_width", "image_height"))
    return width, height


def _place(path: Path, table: Table) -> Array | None:
    return matrix(path, table, "base_from_camera") if "base_from_camera" in table else None


def _offset(path: Path, table: Table) -> float:
    return checks.number(path, "clock_offset_s", table.get("clock_offset_s", 0.0))
