"""Meshes as PLY files: written as text, which every viewer reads; read as text and as binary of either byte order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.files.ply_file import BinaryRows, Column, Rows, TextRows
from hardware.ply_header import WHOLE, Element, read_header
from hardware.raw_mesh import RawMesh, fans, text_rows

CORNERS = ("vertex_indices", "vertex_index")  # what programs call the list of a face's vertices


def write_ply(path: Path, vertices: Array, triangles: NDArray[np.int64]) -> None:
    """Write vertices (V, 3) mm and triangles (T, 3) as a PLY file, in text."""
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    head += [f"property double {axis}" for axis in "xyz"]
    head += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
    body = [" ".join(repr(float(v)) for v in p) for p in vertices] + [f"3 {a} {b} {c}" for a, b, c in triangles]
    path.write_text("\n".join(head + body) + "\n", encoding="ascii")


def read_ply(path: Path) -> RawMesh:
    """The mesh in a PLY file, polygons as fans of triangles; InputError says what of it is wrong, or too little."""
    vertices, triangles = np.empty((0, 3)), np.empty((0, 3), np.int64)
    with path.open("rb") as file:
        header = read_header(file, path)
        rows: Rows = TextRows(path, text_rows(file, path, header.lines + 1))
        if header.order:
            rows = BinaryRows(path, file.read(), header.order)
        for element in header.elements:
            if element.name == "vertex":
                columns = rows.columns(element, _places(element, path))
                vertices = np.column_stack([column.values for column in columns]).astype(np.float64)
            elif element.name == "face":
                triangles = _triangles(rows.columns(element, [_corners(element, path)])[0], path)
            else:
                rows.columns(element, [])
        rows.end()
    return RawMesh(vertices, triangles)


def _places(element: Element, path: Path) -> list[int]:
    """Which properties are x, y and z."""
    names = [one.name for one in element.properties if not one.count]
    if not {"x", "y", "z"} <= set(names):
        raise InputError(path, "properties of vertex", ", ".join(names), "x, y and z among them, a number each")
    return [k for axis in "xyz" for k, one in enumerate(element.properties) if one.name == axis]


def _corners(element: Element, path: Path) -> int:
    """Which property is the list of a face's vertices."""
    for k, one in enumerate(element.properties):
        if one.name in CORNERS and one.count and one.letter in WHOLE:
            return k
    names = ", ".join(one.name for one in element.properties)
    raise InputError(path, "properties of face", names, f"{CORNERS[0]} among them, a list of whole numbers")


def _triangles(corners: Column, path: Path) -> NDArray[np.int64]:
    few = np.flatnonzero(corners.counts < 3)
    if len(few):
        raise InputError(path, f"face {few[0]}", f"{corners.counts[few[0]]} vertices", "3 or more")
    return fans(corners.counts, corners.values.astype(np.int64))
