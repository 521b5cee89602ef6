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

from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST
from hardware.files.mesh_file import read_mesh
from hardware.process.checks import Table
from hardware.simulator.bodies import BODIES, MARGIN, Wound, body, with_wound
from hardware.simulator.deformation import BULGE, RADIUS, STRETCH, Deformation
from hardware.simulator.look import Look
from hardware.simulator.scenario_tables import Keys
from hardware.simulator.scene.scene import Scene
from hardware.simulator.scene.shape import Shape, shape_from_scan
from hardware.simulator.sensor import BLUR, NOISE, VIGNETTING, Sensor

TEXEL = (0.05, 1.0)  # mm
WOUND = (5.0, 80.0)  # mm across
DEPTH = (0.0, 8.0)  # mm
OPENING = 20.0  # mm, the least that a drape leaves open
LARGEST_SCAN = 400.0  # mm: a texture of 0.1 mm and rays for nodes 0.25 mm apart end there
SCENARIO_KEYS = {"scene": ("nozzle", "beads"), "sensor": ("jpeg_quality",)}  # taken out by whoever reads the scenario


def scene_from_table(where: object, table: Table, folder: Path, seed: int, base_from_rest: Array = REST) -> Scene:
    """The scene that a [scene] table describes; files are relative to `folder`. InputError names the key."""
    return Scene(*bare_scene(where, table, folder, seed), seed, base_from_rest)


def bare_scene(where: object, table: Table, folder: Path, seed: int) -> tuple[Shape, Look, Deformation]:
    """Shape, look and deformation of the scene, for those who need no pictures: painting it takes seconds."""
    keys = _keys(where, "scene", table)
    look, wound, deformation = _look(keys), _wound(keys), _deformation(keys)
    kind = keys.word("body", tuple(BODIES), "forearm")
    scan = keys.text("scan") if keys.has("scan") else None
    keys.done()
    if scan is None:
        shape = body(kind, wound, seed)
    elif keys.has("body"):
        raise InputError(where, "scene", "body and scan", "one of the two")
    else:
        shape = _scanned(folder / scan, wound, seed)
        if look.drape and min(shape.size) < 2 * MARGIN + OPENING:
            allowed = (
                f"false for a scan of {shape.size[0]:.1f} x {shape.size[1]:.1f} mm: a drape needs {MARGIN:g} a side"
            )
            raise InputError(where, "scene.drape", True, allowed)
    return shape, look, deformation


def sensor_from_table(where: object, table: Table) -> Sensor:
    """The sensor that a [sensor] table describes; InputError names the key."""
    keys, usual = _keys(where, "sensor", table), Sensor()
    sensor = Sensor(
        noise=keys.number("noise", usual.noise, 0, NOISE),
        vignetting=keys.number("vignetting", usual.vignetting, 0, VIGNETTING),
        blur=keys.number("blur_px", usual.blur, 0, BLUR),
    )
    keys.done()
    return sensor


def _keys(where: object, name: str, table: Table) -> Keys:
    return Keys(where, f"{name}.", table, list(SCENARIO_KEYS[name]))


def _look(keys: Keys) -> Look:
    usual = Look()
    return Look(
        texel=keys.number("texel_mm", usual.texel, *TEXEL),
        tone=keys.number("tone", usual.tone, 0, 1),
        wetness=keys.number("wetness", usual.wetness, 0, 1),
        hair=keys.number("hair", usual.hair, 0, 4),
        drape=keys.flag("drape", usual.drape),
    )


def _wound(keys: Keys) -> Wound | None:
    usual = Wound()
    size = keys.pair("wound_size_mm", usual.size, *WOUND)
    depth = keys.number("wound_depth_mm", usual.depth, *DEPTH)
    return Wound(size, depth) if keys.flag("wound", True) else None


def _deformation(scene: Keys) -> Deformation:
    if not scene.has("deformation"):
        return Deformation()
    table, usual = scene.table["deformation"], Deformation()
    if not isinstance(table, dict):
        raise scene.wrong("deformation", "a table [scene.deformation]")
    keys = Keys(scene.where, f"{scene.prefix}deformation.", table)
    found = Deformation(
        stretch=keys.pair("stretch", usual.stretch, *STRETCH),
        bulge=keys.number("bulge_mm", usual.bulge, -BULGE, BULGE),
        radius=keys.number("radius_mm", usual.radius, *RADIUS),
    )
    keys.done()
    return found


def _scanned(path: Path, wound: Wound | None, seed: int) -> Shape:
    scan = read_mesh(path).scan
    longest = float(np.ptp(scan.vertices, axis=0).max())
    if longest > LARGEST_SCAN:
        raise InputError(path, "size of the scan", f"{longest:.4g} mm", f"at most {LARGEST_SCAN:g} mm in a scene")
    try:
        shape = shape_from_scan(scan.vertices, scan.triangles)
    except InputError as error:
        raise InputError(path, error.what, error.got, error.allowed) from None
    return shape if wound is None else with_wound(shape, wound, seed)
