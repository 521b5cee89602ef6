"""Kalibr's camchain.yaml: pinhole and radtan, metres, each camera's place from the one before it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.calibration.formats.build import Entry, array, rig_of
from hardware.calibration.formats.yaml_file import read_yaml, write_yaml
from hardware.process import checks
from hardware.process.checks import Table

METRE = 1000.0  # mm


def read(path: Path) -> Rig:
    """The rig of a camchain; its base is the first camera. Cameras are called by their topics, else cam0, cam1."""
    chain = read_yaml(path)
    place, entries = np.eye(4), []
    for number, key in enumerate(sorted(chain, key=lambda k: int(k[3:]) if str(k)[3:].isdigit() else -1)):
        table = chain[key]
        if not isinstance(table, dict) or key != f"cam{number}":
            raise InputError(path, str(key), type(table).__name__, f"cam{number}, a table")
        for word, known in (("camera_model", "pinhole"), ("distortion_model", "radtan")):
            if table.get(word) != known:
                raise InputError(path, f"{key}.{word}", table.get(word), known)
        if number:
            place = place @ se3.inverse(_metres(array(path, table, "T_cn_cnm1", (4, 4)), METRE))
        entries.append(_entry(path, str(key), table, place))
    return rig_of(path, entries)


def write(path: Path, rig: Rig) -> None:
    """Write a camchain; InputError where a lens has a k3, which radtan has no room for."""
    chain: Table = {}
    for number, camera in enumerate(rig.cameras):
        if camera.distortion[4]:
            where = f"camera {camera.name}"
            raise InputError(where, "k3", float(camera.distortion[4]), "0: Kalibr's radtan holds k1 k2 p1 p2 only")
        entry: Table = {}
        if number:
            before = rig.cameras[number - 1].base_from_camera
            entry["T_cn_cnm1"] = _metres(se3.inverse(camera.base_from_camera) @ before, 1 / METRE).tolist()
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
    write_yaml(path, chain)


def _entry(path: Path, key: str, table: Table, place: Array) -> Entry:
    topic = str(table.get("rostopic", "")).strip("/").split("/")[0]
    size = array(path, table, "resolution", (2,)).astype(int).tolist()
    focal, bends = array(path, table, "intrinsics", (4,)), array(path, table, "distortion_coeffs", (4,))
    shift = checks.number(path, f"{key}.timeshift_cam_imu", table.get("timeshift_cam_imu", 0.0))
    return Entry(topic or key, size, focal, bends, place, shift)


def _metres(transform: Array, factor: float) -> Array:
    out = transform.copy()
    out[:3, 3] *= factor
    return out
