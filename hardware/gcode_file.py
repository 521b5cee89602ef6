"""A path as plain G-code text: X Y Z mm, A B C degrees, F mm/min, E mm^3 so far, in the frame of the path."""

from __future__ import annotations

import numpy as np

from estimation import se3
from planning.path import Path

HEAD = """; stillbed: {count} checkpoints, {layers} layers, {length:.1f} mm
; X Y Z mm and A B C degrees: the nozzle in the frame of the scan, R = Rz(C) Ry(B) Rx(A); F mm/min
; E mm^3 laid so far; T and M104 are told where they change; a surface that moves needs stillbed, not this file
G21 ; mm
G90 ; places are absolute
M82 ; so is E
G92 E0
"""


def gcode_text(path: Path) -> str:
    """The path as G-code: G0 where nothing is laid, G1 where ink flows, G4 for waits, a comment for each layer."""
    places = path.surface_from_nozzle[:, :3, 3]
    angles = np.rad2deg(se3.euler_from_rotation(path.surface_from_nozzle[:, :3, :3])) + 0.0
    columns = {name: path.extra[name].astype(float) for name in ("volume_mm3", "wait_s") if name in path.extra}
    laid = np.cumsum(columns.get("volume_mm3", np.zeros(len(path))))
    wait = columns.get("wait_s", np.zeros(len(path)))
    length = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    lines = [HEAD.format(count=len(path), layers=len(np.unique(path.layer)), length=length)]
    names = list(dict.fromkeys(path.material.tolist()))
    for i in range(len(path)):
        lines += _changes(path, i, names)
        (x, y, z), (a, b, c) = places[i], angles[i]
        if wait[i] > 0:
            lines.append(f"G4 P{1000 * wait[i]:.0f}\n")
        end = f" E{laid[i]:.4f}\n" if path.extrude[i] else "\n"
        way = f"G{int(path.extrude[i])} X{x:.3f} Y{y:.3f} Z{z:.3f} A{a:.3f} B{b:.3f} C{c:.3f}"
        lines.append(f"{way} F{60 * path.speed[i]:.0f}{end}")
    return "".join([*lines, "M2\n"])


def _changes(path: Path, i: int, names: list[object]) -> list[str]:
    """What begins at checkpoint i: a layer, a material, a temperature."""
    first, before = i == 0, max(i - 1, 0)
    lines = []
    if first or path.layer[i] != path.layer[before]:
        lines.append(f"; layer {path.layer[i]}\n")
    if first or path.material[i] != path.material[before]:
        lines.append(f"T{names.index(path.material[i])} ; material {path.material[i]}\n")
    if first or path.temperature[i] != path.temperature[before]:
        lines.append(f"M104 S{path.temperature[i]:g} ; degrees C\n")
    return lines
