"""aniposelib's and caliscope's TOML: a table per camera, camera_from_world as rotation vector and translation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.rig import Rig
from hardware.calibration.formats.build import Entry, array, pinhole, rig_of
from hardware.process import checks


def read(path: Path) -> Rig:
    """The rig; lengths are taken for mm, which aniposelib's are where its board was given in mm."""
    entries = []
    for key, table in checks.read_toml(path).items():
        if not isinstance(table, dict) or "matrix" not in table:
            continue  # metadata, and what else stands in caliscope's file
        turn, shift = (array(path, table, word, (3,)) for word in ("rotation", "translation"))
        place = se3.inverse(se3.make(se3.exp_rotation(turn), shift))
        focal = pinhole(path, array(path, table, "matrix", (3, 3)))
        size, bends = table.get("size", []), array(path, table, "distortions", (None,))
        offset = checks.number(path, f"{key}.clock_offset_s", table.get("clock_offset_s", 0.0))
        entries.append(Entry(str(table.get("name", key)), size, focal, bends, place, offset))
    return rig_of(path, entries)


def write(path: Path, rig: Rig) -> None:
    """Write the file, mm."""
    blocks = []
    for number, camera in enumerate(rig.cameras):
        camera_from_base = se3.inverse(camera.base_from_camera)
        lines = [f"[cam_{number}]", f"name = {json.dumps(camera.name)}", f"size = {list(camera.size)}"]
        lines.append(f"matrix = {checks.toml_numbers(camera.matrix)}")
        lines.append(f"distortions = {checks.toml_numbers(camera.distortion)}")
        lines.append(f"rotation = {checks.toml_numbers(se3.log_rotation(camera_from_base[:3, :3]))}")
        lines.append(f"translation = {checks.toml_numbers(np.asarray(camera_from_base[:3, 3]))}")
        lines.append(f"clock_offset_s = {float(camera.clock_offset)!r}")
        blocks.append("\n".join(lines) + "\n")
    blocks.append("[metadata]\nadjusted = true\n")
    path.write_text("\n".join(blocks), encoding="utf-8")
