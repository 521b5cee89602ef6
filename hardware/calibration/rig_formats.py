"""Rigs in other programs' files: OpenCV, ROS camera_info, Kalibr, aniposelib and caliscope.

OpenCV and ROS: a YAML file per camera, with its pose as `base_from_camera`, mm. Kalibr: camchain.yaml, pinhole and
radtan, metres, each camera's pose from the one before it. aniposelib and caliscope: TOML, a table per camera,
camera_from_world as rotation vector and translation. What is read is checked as our own files are.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.files.rig_file import rig_from_table
from hardware.process import checks
from hardware.process.checks import Table

SHORT_FLOAT = re.compile(r"^[-+]?\d+[eE][-+]?\d+$")  # 1e-10, which YAML 1.1 takes for a text
YAML_SUFFIXES = (".yaml", ".yml")
MM_PER_M = 1000.0


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # yaml ships no types
    """A safe loader with OpenCV's matrices."""


def _nd_matrix(loader: _Loader, node: Any) -> Any:
    """A vector as OpenCV 5 writes it, with sizes instead of rows and cols."""
    table = loader.construct_mapping(node, deep=True)
    sizes = [1, *table.get("sizes", [])][-2:]
    return {"rows": sizes[0], "cols": sizes[1], "data": table.get("data")} if len(sizes) == 2 else table


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", SHORT_FLOAT, list("-+0123456789"))
_Loader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
)
_Loader.add_constructor("tag:yaml.org,2002:opencv-nd-matrix", _nd_matrix)


def read_yaml(path: Path) -> Table:
    """The file's table, OpenCV's dialect included; InputError where there is none."""
    text = checks.read_bytes(path).decode("utf-8", "replace")
    if text.startswith("%YAML"):  # OpenCV writes %YAML:1.0, which no YAML reader accepts
        text = text.partition("\n")[2]
    try:
        table = yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # the last: deeply nested brackets
        raise InputError(path, "file", " ".join(str(error).split())[:100], "a YAML file") from None
    if not isinstance(table, dict):
        raise InputError(path, "file", type(table).__name__, "a YAML table")
    return table


def _write_yaml(path: Path, table: Table) -> None:
    path.write_text(yaml.safe_dump(table, sort_keys=False, default_flow_style=None), encoding="utf-8")


def _camera_table(
    name: str, size: Sequence[object], focal: Array, distortion: Array, place: Array | None, offset: float
) -> Table:
    """A camera as in rig.toml, its distortion and place as they were read.

    focal: fx fy cx cy px. distortion: k1 k2 p1 p2, maybe k3. place: (4, 4) base_from_camera, mm, or None. offset: s.
    """
    fx, fy, cx, cy = focal.tolist()
    return {
        "name": name,
        "size": list(size),  # [W, H] px
        "matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "distortion": distortion.tolist(),
        "base_from_camera": None if place is None else place.tolist(),
        "clock_offset_s": offset,
    }


def _rig_of(path: Path, cameras: Sequence[Table]) -> Rig:
    """The rig; InputError where a camera is wrong, or several have no poses."""
    if len(cameras) > 1 and any(camera["base_from_camera"] is None for camera in cameras):
        raise InputError(path, "places of the cameras", "none", "base_from_camera of each: this file holds lenses only")
    for camera in cameras:
        if not 4 <= len(camera["distortion"]) <= 5:
            where = f"camera {camera['name']!r}: distortion"
            raise InputError(path, where, camera["distortion"], "k1 k2 p1 p2, or k1 k2 p1 p2 k3")
        camera["distortion"] = [*camera["distortion"], 0.0][:5]
        camera["base_from_camera"] = camera["base_from_camera"] or np.eye(4).tolist()
    return rig_from_table(path, {"camera": cameras})


def _numbers(path: Path, table: Table, key: str, shape: tuple[int | None, ...]) -> Array:
    word = key.rpartition(".")[2]
    if word not in table:
        raise InputError(path, key, "nothing", "numbers")
    return checks.numbers(path, key, table[word], shape)


def _matrix(path: Path, table: Table, key: str) -> Array:
    """A matrix of rows, cols and data, as OpenCV and ROS write it."""
    inner = table.get(key)
    if not isinstance(inner, dict) or not {"rows", "cols", "data"} <= set(inner):
        raise InputError(path, key, inner, "a matrix with rows, cols and data")
    rows, columns = (checks.integer(path, f"{key}.{k}", inner[k], 1) for k in ("rows", "cols"))
    return checks.numbers(path, f"{key}.data", inner["data"], (rows * columns,)).reshape(rows, columns)


def _pinhole(path: Path, m: Array) -> Array:
    """fx fy cx cy of a (3, 3) camera matrix without skew."""
    if m.shape != (3, 3) or m[0, 1] or m[1, 0] or (m[2] != [0, 0, 1]).any():
        raise InputError(path, "camera_matrix", m.tolist(), "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px")
    return m[[0, 1, 0, 1], [0, 1, 2, 2]]


def read_opencv(path: Path) -> Rig:
    """The rig in a folder of OpenCV's calibration files, or in one of them; each has its camera's name."""
    return _rig_of(path, [_yaml_camera(file, read_yaml(file), file.stem) for file in _camera_files(path)])


def write_opencv(path: Path, rig: Rig) -> None:
    """Write a folder of files that cv2.FileStorage reads."""
    path.mkdir(parents=True, exist_ok=True)
    for camera in rig.cameras:
        lines = ["%YAML:1.0", "---", f"image_width: {camera.size[0]}", f"image_height: {camera.size[1]}"]
        lines += _cv_matrix("camera_matrix", camera.matrix)
        lines += _cv_matrix("distortion_coefficients", camera.distortion[None])
        lines += _cv_matrix("base_from_camera", camera.base_from_camera)
        lines.append(f"clock_offset_s: {float(camera.clock_offset)!r}")
        (path / f"{camera.name}.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_ros(path: Path) -> Rig:
    """The rig in a folder of camera_info files, or in one of them."""
    return _rig_of(path, [_ros_camera(file) for file in _camera_files(path)])


def write_ros(path: Path, rig: Rig) -> None:
    """Write a folder of camera_info files, without rectification."""
    path.mkdir(parents=True, exist_ok=True)
    for camera in rig.cameras:
        table = {
            "image_width": camera.size[0],
            "image_height": camera.size[1],
            "camera_name": camera.name,
            "camera_matrix": _ros_matrix(camera.matrix),
            "distortion_model": "plumb_bob",
            "distortion_coefficients": _ros_matrix(camera.distortion[None]),
            "rectification_matrix": _ros_matrix(np.eye(3)),
            "projection_matrix": _ros_matrix(np.hstack([camera.matrix, np.zeros((3, 1))])),
            "base_from_camera": _ros_matrix(camera.base_from_camera),
            "clock_offset_s": float(camera.clock_offset),
        }
        _write_yaml(path / f"{camera.name}.yaml", table)


def _camera_files(path: Path) -> list[Path]:
    files = [path] if path.is_file() else sorted(p for p in path.glob("*") if p.suffix in YAML_SUFFIXES)
    if not files:
        raise InputError(path, "files", "none", "a .yaml file per camera")
    return files


def _cv_matrix(name: str, values: Array) -> list[str]:
    rows, columns = values.shape
    data = ", ".join(repr(float(v)) for v in values.ravel())
    return [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d", f"   data: [ {data} ]"]


def _yaml_camera(path: Path, table: Table, name: str) -> Table:
    focal = _pinhole(path, _matrix(path, table, "camera_matrix"))
    distortion = _matrix(path, table, "distortion_coefficients").ravel()
    width, height = (checks.integer(path, key, table.get(key), 1) for key in ("image_width", "image_height"))
    place = _matrix(path, table, "base_from_camera") if "base_from_camera" in table else None
    offset = checks.number(path, "clock_offset_s", table.get("clock_offset_s", 0.0))
    _refuse_fisheye(path, "fisheye_model", table)
    return _camera_table(name, (width, height), focal, distortion, place, offset)


def _refuse_fisheye(path: Path, key: str, table: Table) -> None:
    """InputError where a lens is a fisheye: its four numbers would be read as k1 k2 p1 p2."""
    if table.get(key.rpartition(".")[2]):
        raise InputError(path, key, "a fisheye lens", "none: calibrate with k1 k2 p1 p2 k3")


def _ros_camera(path: Path) -> Table:
    table = read_yaml(path)
    if table.get("distortion_model") != "plumb_bob":
        raise InputError(path, "distortion_model", table.get("distortion_model"), "plumb_bob")
    return _yaml_camera(path, table, checks.text(path, "camera_name", table.get("camera_name")))


def _ros_matrix(values: Array) -> Table:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}


def read_kalibr(path: Path) -> Rig:
    """The rig of a camchain; its base is the first camera.

    Cameras have the names of their topics' first words. Where two are equal, as in /camera/infra1 and /camera/infra2,
    or a camera has no topic, all are cam0, cam1.
    """
    chain = read_yaml(path)
    place, cameras = np.eye(4), []
    tables = [(key, table) for key, table in chain.items() if isinstance(table, dict)]
    names = {key: str(table.get("rostopic", "")).strip("/").split("/")[0] for key, table in tables}
    if not all(names.values()) or len(set(names.values())) < len(names):
        names = {key: str(key) for key in names}
    for number, key in enumerate(sorted(chain, key=lambda k: int(k[3:]) if str(k)[3:].isdigit() else -1)):
        table = chain[key]
        if not isinstance(table, dict) or key != f"cam{number}":
            raise InputError(path, str(key), type(table).__name__, f"cam{number}, a table")
        for word, known in (("camera_model", "pinhole"), ("distortion_model", "radtan")):
            if table.get(word) != known:
                raise InputError(path, f"{key}.{word}", table.get(word), known)
        if number:
            place = place @ se3.inverse(_scaled(_numbers(path, table, f"{key}.T_cn_cnm1", (4, 4)), MM_PER_M))
        size = _numbers(path, table, f"{key}.resolution", (2,)).astype(int).tolist()
        focal, distortion = (
            _numbers(path, table, f"{key}.{word}", (4,)) for word in ("intrinsics", "distortion_coeffs")
        )
        shift = checks.number(path, f"{key}.timeshift_cam_imu", table.get("timeshift_cam_imu", 0.0))
        cameras.append(_camera_table(names[key], size, focal, distortion, place, shift))
    return _rig_of(path, cameras)


def write_kalibr(path: Path, rig: Rig) -> None:
    """Write a camchain; InputError where a lens has a k3, which radtan does not have."""
    chain: Table = {}
    for number, camera in enumerate(rig.cameras):
        if camera.distortion[4]:
            where = f"camera {camera.name}"
            raise InputError(where, "k3", float(camera.distortion[4]), "0: Kalibr's radtan holds k1 k2 p1 p2 only")
        entry: Table = {}
        if number:
            before = rig.cameras[number - 1].base_from_camera
            entry["T_cn_cnm1"] = _scaled(se3.inverse(camera.base_from_camera) @ before, 1 / MM_PER_M).tolist()
        m = camera.matrix
        entry |= {
            "camera_model": "pinhole",
            "distortion_coeffs": camera.distortion[:4].tolist(),
            "distortion_model": "radtan",
            "intrinsics": [float(v) for v in (m[0, 0], m[1, 1], m[0, 2], m[1, 2])],
            "resolution": list(camera.size),
            "rostopic": f"/{camera.name}/image_raw",
            "timeshift_cam_imu": float(camera.clock_offset),
        }
        chain[f"cam{number}"] = entry
    _write_yaml(path, chain)


def _scaled(transform: Array, factor: float) -> Array:
    out = transform.copy()
    out[:3, 3] *= factor
    return out


def read_anipose(path: Path) -> Rig:
    """The rig; lengths are taken for mm, as aniposelib's are if its board was given in mm."""
    cameras = []
    for key, table in checks.read_toml(path).items():
        if not isinstance(table, dict) or "matrix" not in table:
            continue  # metadata and other tables of caliscope
        turn, shift = (_numbers(path, table, f"{key}.{word}", (3,)) for word in ("rotation", "translation"))
        place = se3.inverse(se3.make(se3.exp_rotation(turn), shift))
        _refuse_fisheye(path, f"{key}.fisheye", table)
        focal = _pinhole(path, _numbers(path, table, f"{key}.matrix", (3, 3)))
        distortion = _numbers(path, table, f"{key}.distortions", (None,))
        offset = checks.number(path, f"{key}.clock_offset_s", table.get("clock_offset_s", 0.0))
        name, size = str(table.get("name", key)), table.get("size", [])
        cameras.append(_camera_table(name, size, focal, distortion, place, offset))
    return _rig_of(path, cameras)


def write_anipose(path: Path, rig: Rig) -> None:
    """Write aniposelib's TOML, mm."""
    blocks = []
    for number, camera in enumerate(rig.cameras):
        camera_from_base = se3.inverse(camera.base_from_camera)
        blocks.append(
            f"[cam_{number}]\nname = {json.dumps(camera.name)}\nsize = {list(camera.size)}\n"
            f"matrix = {checks.toml_value(camera.matrix)}\ndistortions = {checks.toml_value(camera.distortion)}\n"
            f"rotation = {checks.toml_value(se3.log_rotation(camera_from_base[:3, :3]))}\n"
            f"translation = {checks.toml_value(np.asarray(camera_from_base[:3, 3]))}\n"
            f"clock_offset_s = {float(camera.clock_offset)!r}\n"
        )
    blocks.append("[metadata]\nadjusted = true\n")
    path.write_text("\n".join(blocks), encoding="utf-8")


@dataclass(frozen=True, slots=True)
class RigFormat:
    """One kind of file."""

    read: Callable[[Path], Rig]
    write: Callable[[Path, Rig], None]


FORMATS = {
    "opencv": RigFormat(read_opencv, write_opencv),
    "ros": RigFormat(read_ros, write_ros),
    "kalibr": RigFormat(read_kalibr, write_kalibr),
    "anipose": RigFormat(read_anipose, write_anipose),
}
