"""Scenes and sensors from the tables of a scenario file, in mm and px.

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
[scene.deformation]       # at amount 1, which a scenario's [strain] varies
stretch = [0.01, 0.005]   # a share of each length, along x and y
bulge_mm = 1.0
radius_mm = 40.0
[sensor]
noise = 1.5               # grey levels, one sigma
vignetting = 0.8          # 1: the cos^4 law
blur_px = 0.45            # of lens and colour filter, one sigma
"""

from __future__ import annotations

from pathlib import Path

from estimation.errors import InputError
from estimation.se3 import Array
from hardware import checks
from hardware.checks import Table
from hardware.simulator.bodies import BODIES, Wound, body, with_wound
from hardware.simulator.default_rig import REST
from hardware.simulator.deformation import Deformation
from hardware.simulator.look import Look
from hardware.simulator.scene import Scene
from hardware.simulator.sensor import Sensor
from hardware.simulator.shape import Shape, shape_from_scan

LOOK = ("tone", "wetness", "hair", "drape", "texel_mm")
KEYS = ("body", "scan", "wound", "wound_size_mm", "wound_depth_mm", "deformation", *LOOK)
TEXEL = (0.05, 1.0)  # mm
WOUND = (5.0, 80.0)  # mm across
DEPTH = (0.0, 8.0)  # mm
LARGEST_SCAN = 400.0  # mm: a texture of 0.1 mm and rays for nodes 0.25 mm apart end there


def scene_from_table(where: object, table: Table, folder: Path, seed: int, base_from_rest: Array = REST) -> Scene:
    """The scene that a [scene] table describes; files are relative to `folder`. InputError names the key."""
    checks.check_keys(where, "scene.", table, (), KEYS)
    wound = _wound(where, table)
    shape = _shape(where, table, folder, wound, seed)
    return Scene(shape, _look(where, table), _deformation(where, table.get("deformation", {})), seed, base_from_rest)


def sensor_from_table(where: object, table: Table) -> Sensor:
    """The sensor that a [sensor] table describes; InputError names the key."""
    keys = {"noise": "noise", "vignetting": "vignetting", "blur_px": "blur"}
    checks.check_keys(where, "sensor.", table, (), keys)
    try:
        return Sensor(**{keys[k]: checks.number(where, f"sensor.{k}", v) for k, v in table.items()})
    except InputError as error:
        raise _placed(where, error) from error


def _look(where: object, table: Table) -> Look:
    default = Look()
    return Look(
        texel=_within(where, "scene.texel_mm", table.get("texel_mm", default.texel), *TEXEL, "mm"),
        tone=_within(where, "scene.tone", table.get("tone", default.tone), 0, 1, "fair to dark"),
        wetness=_within(where, "scene.wetness", table.get("wetness", default.wetness), 0, 1, "dry to dripping"),
        hair=_within(where, "scene.hair", table.get("hair", default.hair), 0, 4, "none to dense"),
        drape=_switch(where, "scene.drape", table.get("drape", default.drape)),
    )


def _wound(where: object, table: Table) -> Wound | None:
    default = Wound()
    size = checks.numbers(where, "scene.wound_size_mm", table.get("wound_size_mm", list(default.size)), (2,), "mm")
    for side in size:
        _within(where, "scene.wound_size_mm", float(side), *WOUND, "mm")
    depth = _within(where, "scene.wound_depth_mm", table.get("wound_depth_mm", default.depth), *DEPTH, "mm")
    return (
        Wound((float(size[0]), float(size[1])), depth)
        if _switch(where, "scene.wound", table.get("wound", True))
        else None
    )


def _shape(where: object, table: Table, folder: Path, wound: Wound | None, seed: int) -> Shape:
    if "scan" not in table:
        kind = checks.text(where, "scene.body", table.get("body", "forearm"))
        if kind not in BODIES:
            raise InputError(where, "scene.body", kind, checks.meant(kind, tuple(BODIES)))
        return body(kind, wound, seed)
    if "body" in table:
        raise InputError(where, "scene", "body and scan", "one of the two")
    from hardware.mesh_file import read_mesh  # a scenario without a scan needs no open3d

    path = folder / checks.text(where, "scene.scan", table["scan"])
    scan = read_mesh(path).scan
    longest = float((scan.vertices.max(0) - scan.vertices.min(0)).max())
    if longest > LARGEST_SCAN:
        raise InputError(path, "size of the scan", f"{longest:.4g} mm", f"at most {LARGEST_SCAN:g} mm in a scene")
    shape = shape_from_scan(scan.vertices, scan.triangles)
    return shape if wound is None else with_wound(shape, wound, seed)


def _deformation(where: object, table: object) -> Deformation:
    if not isinstance(table, dict):
        raise InputError(where, "scene.deformation", table, "a table [scene.deformation]")
    keys = ("stretch", "bulge_mm", "radius_mm")
    checks.check_keys(where, "scene.deformation.", table, (), keys)
    default = Deformation()
    stretch = checks.numbers(where, "scene.deformation.stretch", table.get("stretch", list(default.stretch)), (2,))
    try:
        return Deformation(
            (float(stretch[0]), float(stretch[1])),
            checks.number(where, "scene.deformation.bulge_mm", table.get("bulge_mm", default.bulge)),
            checks.number(where, "scene.deformation.radius_mm", table.get("radius_mm", default.radius)),
        )
    except InputError as error:
        raise _placed(where, error) from error


def _placed(where: object, error: InputError) -> InputError:
    """An error of a record's own check, in the file it was read from; an error that is there already as it is."""
    return (
        error
        if error.where == str(where)
        else InputError(where, f"{error.where}.{error.what}", error.got, error.allowed)
    )


def _within(where: object, key: str, value: object, low: float, high: float, unit: str) -> float:
    number = checks.number(where, key, value)
    if not low <= number <= high:
        raise InputError(where, key, number, f"{low:g} to {high:g}, {unit}")
    return number


def _switch(where: object, key: str, value: object) -> bool:
    if not isinstance(value, bool):
        raise InputError(where, key, value, "true or false")
    return value
