"""Small valid scans in every form that is read, for the fuzzing of their readers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hardware.files.mesh_file import read_raw_mesh
from hardware.ply_file import write_ply
from hardware.scan_units import in_mm
from hardware.stl_file import TRIANGLE
from planning.layers.repair import repaired

VERTICES = np.array([[0.0, 0, 0], [20, 0, 1], [20, 20, 0], [0, 20, 2], [10, 10, 3]])
TRIANGLES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
STEPS = 6  # of the scan that is planned on: more than its repair's fewest triangles


def make_ply(folder: Path) -> None:
    """x.ply, in text."""
    write_ply(folder / "x.ply", VERTICES, TRIANGLES)


def make_binary_ply(folder: Path) -> None:
    """x.ply, big-endian, with a colour, and with a polygon of four corners among the triangles."""
    head = f"""ply
format binary_big_endian 1.0
element vertex {len(VERTICES)}
property float x
property float y
property float z
property uchar red
element face {len(TRIANGLES) + 1}
property list uchar uint vertex_indices
end_header
"""
    body = b"".join(np.array(place, ">f4").tobytes() + b"\x7f" for place in VERTICES)
    faces = b"".join(bytes([len(face)]) + np.array(face, ">u4").tobytes() for face in [*TRIANGLES, [0, 3, 2, 1]])
    (folder / "x.ply").write_bytes(head.encode() + body + faces)


def make_stl(folder: Path) -> None:
    """x.stl, in text."""
    corner = "vertex 0 0 0\nvertex 20 0 0\nvertex 0 20 0\n"
    facet = f"facet normal 0 0 1\nouter loop\n{corner}endloop\nendfacet\n"
    (folder / "x.stl").write_text(f"solid x\n{facet}{facet.replace('20', '30')}endsolid x\n")


def make_binary_stl(folder: Path) -> None:
    """x.stl, binary."""
    table = np.zeros(len(TRIANGLES), TRIANGLE)
    table["corners"] = VERTICES[TRIANGLES]
    (folder / "x.stl").write_bytes(bytes(80) + np.uint32(len(table)).tobytes() + table.tobytes())


def make_obj(folder: Path) -> None:
    """x.obj."""
    (folder / "x.obj").write_text("v 0 0 0\nv 20 0 0\nv 0 20 0\nv 20 20 1\nvn 0 0 1\nf 1 2 3\nf 2//1 4//1 -2//1\n")


def make_skin(folder: Path) -> None:
    """x.ply: a curved square with enough triangles to be planned on."""
    x, y = (each.ravel() for each in np.meshgrid(*2 * [np.linspace(0, 60, STEPS)]))
    corner = (np.arange(STEPS - 1)[:, None] * STEPS + np.arange(STEPS - 1)).ravel()
    low = np.column_stack([corner, corner + 1, corner + STEPS])
    high = np.column_stack([corner + 1, corner + STEPS + 1, corner + STEPS])
    write_ply(folder / "x.ply", np.column_stack([x, y, 3 + x * y / 1000]), np.concatenate([low, high]))


def skin(path: Path) -> object:
    """A scan as `stillbed plan` reads it: its unit checked, and repaired."""
    raw = read_raw_mesh(path)
    return repaired(in_mm(raw.vertices, raw.triangles, "mm", path), raw.triangles, path)
