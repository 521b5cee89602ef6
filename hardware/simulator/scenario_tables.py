"""The tables of a scenario file, read key by key; and the scene and the sensor that two of them describe, in mm and px.

[scene]
body = "forearm"          # or "chest", "foot"; or scan = "file.ply", mm, whose own frame then is the surface frame
wound = true
wound_size_mm = [42, 31]
wound_depth_mm = 2.4      # of a body's wound; on a scan it is only painted
tone = 0.2                # of the skin, 0 fair to 1 dark
wetness = 0.6             # 0 dry to 1 dripping
hair = 0.5
drape = true
texel_mm = 0.1
nozzle = true             # whether pictures show it
beads = true              # and what it has printed
[scene.deformation]       # at amount 1, which a scenario's [strain] varies
stretch = [0.01, 0.005]   # a share of each length, along x and y
bulge_mm = 1.0
radius_mm = 40.0
[sensor]
jpeg_quality = 90         # 0: lossless pictures
noise = 1.5               # grey levels, one sigma
vignetting = 0.8          # 1: the cos^4 law
blur_px = 0.45            # of lens and colour filter, one sigma
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.files.mesh_file import read_mesh
from hardware.process import checks
from hardware.process.checks import Check, Table
from hardware.simulator.scene import shape as shapes
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.scene import Scene
from hardware.simulator.scene.shape import Deformation, Shape, Wound

MISSING = object()  # for the default of a key that must be there


@dataclass(slots=True)
class TableReader:
    """Takes values out of a table: a key without a default must be there, and `done` refuses every key not read."""

    where: object  # the file
    prefix: str  # in front of each key in an error ("motion[0].")
    table: Table
    known_keys: list[str] = field(default_factory=list)  # read so far, and whatever else may be there

    def has(self, key: str) -> bool:
        """Whether the table has a key."""
        self.known_keys.append(key)
        return key in self.table

    def take(self, key: str, check: Check, default: Any = MISSING) -> Any:
        """What a check makes of a key's value."""
        if self.has(key):
            return check(self.where, self.prefix + key, self.table[key])
        if default is MISSING:
            raise InputError(self.where, self.prefix + key, "missing", "this key")
        return default

    def number(
        self, key: str, default: float | None = None, low: float = -math.inf, high: float = math.inf, open: bool = False
    ) -> float:
        """A finite number from low (above it where `open`) to high."""
        check = checks.within(low, high, open=open)
        return float(self.take(key, check, MISSING if default is None else default))

    def vector(self, key: str, default: Sequence[float], low: float = -math.inf) -> Array:
        """Three finite numbers, each at least `low`."""
        value = np.asarray(self.take(key, checks.array((3,)), default), float)
        if (value < low).any():
            raise self.wrong(key, f"3 numbers >= {low:g}")
        return value

    def axis(self, key: str, default: Sequence[float]) -> Array:
        """A direction (3,), made to unit length."""
        value = self.vector(key, default)
        length = float(np.linalg.norm(value))
        if length < 1e-9:
            raise self.wrong(key, "3 numbers, not all 0")
        return np.asarray(value / length)

    def flag(self, key: str, default: bool) -> bool:
        """true or false."""
        return bool(self.take(key, checks.flag, default))

    def word(self, key: str, allowed: Sequence[str], default: object = MISSING) -> str:
        """One of several words."""
        return str(self.take(key, checks.word(allowed), default))

    def wrong(self, key: str, allowed: str) -> InputError:
        """The error that a key's value is not allowed."""
        return InputError(self.where, self.prefix + key, self.table.get(key, "missing"), allowed)

    def done(self) -> None:
        """InputError for a key that was not read."""
        checks.check_keys(self.where, self.prefix, self.table, (), self.known_keys)


SENSOR_KEYS: checks.Keys = {
    "noise": ("noise", checks.number),
    "vignetting": ("vignetting", checks.number),
    "blur_px": ("blur", checks.number),
}
DEFORMATION_KEYS: checks.Keys = {
    "stretch": ("stretch", checks.pair(*shapes.STRETCH_RANGE)),
    "bulge_mm": ("bulge", checks.number),
    "radius_mm": ("radius", checks.number),
}
TEXEL_RANGE = (0.05, 1.0)  # mm
WOUND_SIZE_RANGE = (5.0, 80.0)  # mm across
WOUND_DEPTH_RANGE = (0.0, 8.0)  # mm
MIN_DRAPE_OPENING = 20.0  # mm, the least that a drape leaves open
MAX_SCAN_SIZE = 400.0  # mm: a texture of 0.1 mm and rays for nodes 0.25 mm apart end there


def scene_from_table(where: object, table: Table, folder: Path, seed: int) -> Scene:
    """The scene that a [scene] table describes; files are relative to `folder`. InputError names the key."""
    return Scene(*bare_scene(where, table, folder, seed), seed)


def bare_scene(where: object, table: Table, folder: Path, seed: int) -> tuple[Shape, Appearance, Deformation]:
    """Shape, look and deformation of the scene, for those who need no pictures: painting it takes seconds."""
    keys, usual, usual_wound = TableReader(where, "scene.", table, ["nozzle", "beads"]), Appearance(), Wound()
    look = Appearance(
        texel=keys.number("texel_mm", usual.texel, *TEXEL_RANGE),
        tone=keys.number("tone", usual.tone, 0, 1),
        wetness=keys.number("wetness", usual.wetness, 0, 1),
        hair=keys.number("hair", usual.hair, 0, 4),
        drape=keys.flag("drape", usual.drape),
    )
    size = keys.take("wound_size_mm", checks.pair(*WOUND_SIZE_RANGE), usual_wound.size)
    depth = keys.number("wound_depth_mm", usual_wound.depth, *WOUND_DEPTH_RANGE)
    wound = Wound(size, depth) if keys.flag("wound", True) else None
    kind = keys.word("body", tuple(shapes.BODIES), "forearm")
    scan = keys.take("scan", checks.text, None)
    given = checks.table_at(where, "scene.", table, "deformation") if keys.has("deformation") else {}
    deformation = checks.record_from_table(where, "scene.deformation.", given, Deformation, DEFORMATION_KEYS)
    keys.done()
    if scan is None:
        shape = shapes.body(kind, wound, seed)
    elif keys.has("body"):
        raise InputError(where, "scene", "body and scan", "one of the two")
    else:
        shape = _scanned(folder / scan, wound, seed)
        if look.drape and min(shape.size) < 2 * shapes.DRAPE_MARGIN + MIN_DRAPE_OPENING:
            extent = f"{shape.size[0]:.1f} x {shape.size[1]:.1f} mm"
            allowed = f"false for a scan of {extent}: a drape needs {shapes.DRAPE_MARGIN:g} a side"
            raise InputError(where, "scene.drape", True, allowed)
    return shape, look, deformation


def sensor_from_table(where: object, table: Table) -> Sensor:
    """The sensor that a [sensor] table describes; InputError names the key."""
    return checks.record_from_table(where, "sensor.", table, Sensor, SENSOR_KEYS, also=("jpeg_quality",))


def _scanned(path: Path, wound: Wound | None, seed: int) -> Shape:
    scan = read_mesh(path)
    longest = float(np.ptp(scan.vertices, axis=0).max())
    if longest > MAX_SCAN_SIZE:
        raise InputError(path, "size of the scan", f"{longest:.4g} mm", f"at most {MAX_SCAN_SIZE:g} mm in a scene")
    try:
        shape = shapes.shape_from_scan(scan.vertices, scan.triangles)
    except InputError as error:
        raise InputError(path, error.what, error.got, error.allowed) from None
    return shape if wound is None else shapes.with_wound(shape, wound, seed)
