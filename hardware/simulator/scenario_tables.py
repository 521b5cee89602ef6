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

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.files.mesh_file import read_mesh
from hardware.process import checks
from hardware.process.checks import Table
from hardware.simulator.scene import shape as shapes
from hardware.simulator.scene.appearance import MAX_BLUR, MAX_NOISE, MAX_VIGNETTING, Appearance, Sensor
from hardware.simulator.scene.scene import Scene
from hardware.simulator.scene.shape import Deformation, Shape, Wound


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

    def number(
        self, key: str, default: float | None = None, low: float = -math.inf, high: float = math.inf, open: bool = False
    ) -> float:
        """A finite number from low (above it where `open`) to high."""
        if not self.has(key) and default is not None:
            return default
        value = checks.number(self.where, self.prefix + key, self._required(key))
        if not (low < value <= high or (value == low and not open)):
            raise self.wrong(key, _range(low, high, open))
        return value

    def whole(self, key: str, default: int, low: int) -> int:
        """A whole number from low."""
        return checks.integer(self.where, self.prefix + key, self.table[key], low) if self.has(key) else default

    def vector(self, key: str, default: Sequence[float], low: float = -math.inf) -> Array:
        """Three finite numbers, each at least `low`."""
        if not self.has(key):
            return np.array(default, float)
        value = checks.numbers(self.where, self.prefix + key, self.table[key], (3,))
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

    def band(self, key: str, default: tuple[float, float]) -> tuple[float, float]:
        """Two numbers, 0 < low < high."""
        low, high = self.pair(key, default)
        if not 0 < low < high:
            raise self.wrong(key, "[low, high], 0 < low < high")
        return low, high

    def pair(
        self, key: str, default: tuple[float, float], low: float = -math.inf, high: float = math.inf
    ) -> tuple[float, float]:
        """Two finite numbers from low to high."""
        if not self.has(key):
            return default
        first, second = checks.numbers(self.where, self.prefix + key, self.table[key], (2,))
        if not (low <= min(first, second) and max(first, second) <= high):
            raise self.wrong(key, f"2 numbers, each {_range(low, high, False)}")
        return float(first), float(second)

    def list_of_numbers(self, key: str, default: Sequence[float]) -> Array:
        """One finite number or more (N,)."""
        if not self.has(key):
            return np.array(default, float)
        value = checks.numbers(self.where, self.prefix + key, self.table[key], (None,))
        if not len(value):
            raise self.wrong(key, "one number or more")
        return value

    def flag(self, key: str, default: bool) -> bool:
        """true or false."""
        value = self.table[key] if self.has(key) else default
        if not isinstance(value, bool):
            raise self.wrong(key, "true or false")
        return value

    def word(self, key: str, allowed: Sequence[str], default: str | None = None) -> str:
        """One of several words."""
        if not self.has(key) and default is not None:
            return default
        value = self._required(key)
        if not isinstance(value, str) or value not in allowed:
            raise self.wrong(key, checks.one_of_text(str(value), allowed))
        return value

    def text(self, key: str) -> str:
        """A string that is not empty."""
        self.has(key)
        return checks.text(self.where, self.prefix + key, self._required(key))

    def wrong(self, key: str, allowed: str) -> InputError:
        """The error that a key's value is not allowed."""
        return InputError(self.where, self.prefix + key, self.table.get(key, "missing"), allowed)

    def done(self) -> None:
        """InputError for a key that was not read."""
        checks.check_keys(self.where, self.prefix, self.table, (), list(dict.fromkeys(self.known_keys)))

    def _required(self, key: str) -> object:
        if key not in self.table:
            raise InputError(self.where, self.prefix + key, "missing", "this key")
        return self.table[key]


def _range(low: float, high: float, open: bool) -> str:
    if math.isinf(low) and math.isinf(high):
        return "a finite number"
    if math.isinf(high):
        return f"{'>' if open else '>='} {low:g}"
    if math.isinf(low):
        return f"<= {high:g}"
    return f"{low:g} {'<' if open else '<='} it <= {high:g}"


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
    size = keys.pair("wound_size_mm", usual_wound.size, *WOUND_SIZE_RANGE)
    depth = keys.number("wound_depth_mm", usual_wound.depth, *WOUND_DEPTH_RANGE)
    wound = Wound(size, depth) if keys.flag("wound", True) else None
    deformation = _deformation(keys)
    kind = keys.word("body", tuple(shapes.BODIES), "forearm")
    scan = keys.text("scan") if keys.has("scan") else None
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
    keys, usual = TableReader(where, "sensor.", table, ["jpeg_quality"]), Sensor()
    sensor = Sensor(
        noise=keys.number("noise", usual.noise, 0, MAX_NOISE),
        vignetting=keys.number("vignetting", usual.vignetting, 0, MAX_VIGNETTING),
        blur=keys.number("blur_px", usual.blur, 0, MAX_BLUR),
    )
    keys.done()
    return sensor


def _deformation(scene: TableReader) -> Deformation:
    if not scene.has("deformation"):
        return Deformation()
    table, usual = scene.table["deformation"], Deformation()
    if not isinstance(table, dict):
        raise scene.wrong("deformation", "a table [scene.deformation]")
    keys = TableReader(scene.where, f"{scene.prefix}deformation.", table)
    deformation = Deformation(
        stretch=keys.pair("stretch", usual.stretch, *shapes.STRETCH_RANGE),
        bulge=keys.number("bulge_mm", usual.bulge, -shapes.MAX_BULGE, shapes.MAX_BULGE),
        radius=keys.number("radius_mm", usual.radius, *shapes.BULGE_RADIUS_RANGE),
    )
    keys.done()
    return deformation


def _scanned(path: Path, wound: Wound | None, seed: int) -> Shape:
    scan = read_mesh(path).scan
    longest = float(np.ptp(scan.vertices, axis=0).max())
    if longest > MAX_SCAN_SIZE:
        raise InputError(path, "size of the scan", f"{longest:.4g} mm", f"at most {MAX_SCAN_SIZE:g} mm in a scene")
    try:
        shape = shapes.shape_from_scan(scan.vertices, scan.triangles)
    except InputError as error:
        raise InputError(path, error.what, error.got, error.allowed) from None
    return shape if wound is None else shapes.with_wound(shape, wound, seed)
