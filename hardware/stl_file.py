"""Meshes from STL files, binary and text."""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import BinaryIO

import numpy as np

from estimation.errors import InputError
from hardware.raw_mesh import RawMesh, text_rows, wrong_line

HEAD = 84  # bytes: eighty of anything, and the number of triangles
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
FACET = (b"facet", b"outer", b"vertex", b"vertex", b"vertex", b"endloop", b"endfacet")  # a triangle, line by line
MORE = {b"facet": " or endsolid", b"vertex": " and three numbers"}  # what belongs to these, or may stand there as well


def read_stl(path: Path) -> RawMesh:
    """The mesh in an STL file, three vertices of its own for each triangle. InputError says where it is none."""
    with path.open("rb") as file:
        size, head = path.stat().st_size, file.read(HEAD)
        told = int.from_bytes(head[80:], "little")
        if len(head) == HEAD and size == HEAD + TRIANGLE.itemsize * told:
            corners = np.fromfile(file, TRIANGLE)["corners"].astype(np.float64).reshape(-1, 3)
        elif head.lstrip()[:5].lower() == b"solid":
            file.seek(0)
            corners = np.array(_text_corners(file, path), np.float64).reshape(-1, 3)
        else:
            got = f"{size} bytes" + (f", {told} triangles by its header" if len(head) == HEAD else "")
            allowed = f"{HEAD} bytes and {TRIANGLE.itemsize} for each triangle (is it cut short?), or text"
            raise InputError(path, "scan", got, allowed)
    return RawMesh(corners, np.arange(len(corners)).reshape(-1, 3))


def _text_corners(file: BinaryIO, path: Path) -> array[float]:
    """Nine numbers for each triangle of a text STL file, of all its solids."""
    corners, step, solid = array("d"), 0, False
    for number, words in text_rows(file, path):
        word, expected = words[0].lower(), FACET[step]
        if step == 0 and word == (b"endsolid" if solid else b"solid"):
            solid = not solid
            continue
        try:
            if not solid or word != expected:
                raise ValueError
            if word == b"vertex":
                x, y, z = words[1:]
                corners.extend((float(x), float(y), float(z)))
        except ValueError:
            allowed = expected.decode() + MORE.get(expected, "") if solid else "solid"
            raise wrong_line(path, number, words, allowed) from None
        step = (step + 1) % len(FACET)
    if solid:
        raise InputError(path, "scan", "ends within a solid", "endsolid as its last line (is it cut short?)")
    return corners
