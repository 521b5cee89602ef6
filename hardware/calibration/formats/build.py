"""A rig from what another program's file says, checked as our own files are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.files.rig_file import rig_from_table
from hardware.process import checks
from hardware.process.checks import Table


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """One camera. size: [W, H]. focal: fx fy cx cy. bends: k1 k2 p1 p2, maybe k3. place: (4, 4) mm or None."""

    name: str
    size: Sequence[object]
    focal: Array
    bends: Array
    place: Array | None
    offset: float = 0.0


def rig_of(path: Path, entries: Sequence[Entry]) -> Rig:
    """The rig; InputError where a camera is wrong, or several lack their places."""
    if len(entries) > 1 and any(entry.place is None for entry in entries):
        raise InputError(path, "places of the cameras", "none", "base_from_camera of each: this file holds lenses only")
    return rig_from_table(path, {"camera": [_table(path, entry) for entry in entries]})


def _table(path: Path, entry: Entry) -> Table:
    fx, fy, cx, cy = entry.focal.tolist()
    if not 4 <= len(entry.bends) <= 5:
        allowed = "k1 k2 p1 p2, or k1 k2 p1 p2 k3"
        raise InputError(path, f"camera {entry.name!r}: distortion", entry.bends.tolist(), allowed)
    bends = [*entry.bends.tolist(), 0.0][:5]
    return {
        "name": entry.name,
        "size": list(entry.size),
        "matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "distortion": bends,
        "base_from_camera": (np.eye(4) if entry.place is None else entry.place).tolist(),
        "clock_offset_s": entry.offset,
    }


def array(path: Path, table: Table, key: str, shape: tuple[int | None, ...]) -> Array:
    """The numbers of a key that has to be there."""
    if key not in table:
        raise InputError(path, key, "nothing", "numbers")
    return checks.numbers(path, key, table[key], shape)


def matrix(path: Path, table: Table, key: str) -> Array:
    """A matrix written as rows, cols and data, as OpenCV and ROS do."""
    inner = table.get(key)
    if not isinstance(inner, dict) or not {"rows", "cols", "data"} <= set(inner):
        raise InputError(path, key, inner, "a matrix with rows, cols and data")
    rows, columns = (checks.integer(path, f"{key}.{k}", inner[k], 1) for k in ("rows", "cols"))
    return checks.numbers(path, f"{key}.data", inner["data"], (rows * columns,)).reshape(rows, columns)


def pinhole(path: Path, found: Array) -> Array:
    """fx fy cx cy of a (3, 3) camera matrix without skew."""
    if found.shape != (3, 3) or found[0, 1] or found[1, 0] or (found[2] != [0, 0, 1]).any():
        raise InputError(path, "camera_matrix", found.tolist(), "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px")
    return found[[0, 1, 0, 1], [0, 1, 2, 2]]
