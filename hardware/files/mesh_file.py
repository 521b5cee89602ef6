"""Scans from PLY, STL and OBJ files, read strictly: whatever is wrong, missing or unknown in the file is an error.

An arm moves along the scan, and the libraries for these files read damaged ones in part and without an error (trimesh
5.2: text that ends early, vertex 0 of an OBJ file), or end the process (open3d 0.20).
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from estimation.errors import InputError
from estimation.scans.scan import Scan, open_edges, scan_from_triangles
from estimation.se3 import Array
from hardware.files.ply_file import RawMesh, check_rows, fans, read_ply, text_rows, wrong_line

STL_HEADER_BYTES = 84  # bytes: eighty of anything, and the number of triangles
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
STL_FACET = (b"facet", b"outer", b"vertex", b"vertex", b"vertex", b"endloop", b"endfacet")  # a triangle, line by line
STL_FACET_REST = {b"facet": " or endsolid", b"vertex": " and three numbers"}  # what may follow, or stand there instead


def read_stl(path: Path) -> RawMesh:
    """The mesh in an STL file, three vertices of its own for each triangle. InputError says where it is none."""
    with path.open("rb") as file:
        size, head = path.stat().st_size, file.read(STL_HEADER_BYTES)
        count = int.from_bytes(head[80:], "little")
        if len(head) == STL_HEADER_BYTES and size == STL_HEADER_BYTES + STL_TRIANGLE.itemsize * count:
            check_rows(path, "triangles", count)
            corners = np.fromfile(file, STL_TRIANGLE)["corners"].astype(np.float64).reshape(-1, 3)
        elif head.lstrip()[:5].lower() == b"solid":
            file.seek(0)
            corners = np.array(_text_corners(file, path), np.float64).reshape(-1, 3)
        else:
            got = f"{size} bytes" + (f", {count} triangles by its header" if len(head) == STL_HEADER_BYTES else "")
            sizes = f"{STL_HEADER_BYTES} bytes and {STL_TRIANGLE.itemsize} for each triangle"
            raise InputError(path, "scan", got, f"{sizes} (is it cut short?), or text")
    return RawMesh(corners, np.arange(len(corners)).reshape(-1, 3))


def _text_corners(file: BinaryIO, path: Path) -> array[float]:
    """Nine numbers for each triangle of a text STL file, of all its solids."""
    corners, step, solid = array("d"), 0, False
    for number, words in text_rows(file, path):
        word, expected = words[0].lower(), STL_FACET[step]
        if step == 0 and word == (b"endsolid" if solid else b"solid"):
            solid = not solid
            continue
        try:
            if not solid or word != expected:
                raise ValueError
            if word == b"vertex":
                x, y, z = words[1:]
                corners.extend((float(x), float(y), float(z)))
                check_rows(path, "triangles", len(corners) // 9)
        except ValueError:
            allowed = expected.decode() + STL_FACET_REST.get(expected, "") if solid else "solid"
            raise wrong_line(path, number, words, allowed) from None
        step = (step + 1) % len(STL_FACET)
    if solid:
        raise InputError(path, "scan", "ends within a solid", "endsolid as its last line (is it cut short?)")
    return corners


OBJ_VERTEX, OBJ_FACE = "v and the three numbers of a place", "f and three or more numbers of vertices, counted from 1"
IGNORED_OBJ_WORDS = frozenset(
    b"vt vn vp g o s mg l p usemtl mtllib usemap maplib bevel c_interp d_interp lod shadow_obj trace_obj".split()
)


def read_obj(path: Path) -> RawMesh:
    """The mesh in an OBJ file, polygons as fans of triangles. InputError names the line that is no line of one."""
    places, counts, corners = array("d"), array("q"), array("q")
    with path.open("rb") as file:
        for number, words in text_rows(file, path):
            word = words[0]
            if word not in (b"v", b"f"):
                if word in IGNORED_OBJ_WORDS or word.startswith(b"#"):
                    continue
                raise wrong_line(path, number, words, f"{OBJ_VERTEX}, or {OBJ_FACE}")
            try:
                if word == b"v":
                    x, y, z = words[1:4]
                    places.extend((float(x), float(y), float(z)))
                    check_rows(path, "vertices", len(places) // 3)
                else:
                    face = _face(words[1:], len(places) // 3)
                    counts.append(len(face))
                    corners.extend(face)
                    check_rows(path, "faces", len(counts))
            except (ValueError, OverflowError):
                raise wrong_line(path, number, words, OBJ_VERTEX if word == b"v" else OBJ_FACE) from None
    triangles = fans(np.array(counts, np.int64), np.array(corners, np.int64))
    return RawMesh(np.array(places, np.float64).reshape(-1, 3), triangles)


def _face(words: list[bytes], vertices: int) -> list[int]:
    """Numbers, from 0, of the corners that the words i, i/t, i//n or i/t/n name. vertices: how many have come so far.

    ValueError: they are no face.
    """
    if b"#" in words:
        words = words[: words.index(b"#")]
    corners = [int(word.partition(b"/")[0]) for word in words]
    if len(corners) < 3 or 0 in corners or min(corners) < -vertices:
        raise ValueError
    return [one - 1 if one > 0 else vertices + one for one in corners]


MESH_READERS = {".ply": read_ply, ".stl": read_stl, ".obj": read_obj}
MAX_MESH_FILE_BYTES = 1 << 30  # bytes: a million triangles take 50 MB as binary, and up to 300 MB as an STL file's text
MIN_SCAN_SIZE, MAX_SCAN_SIZE = 1.0, 2000.0  # mm, longest side: a hand in metres is 0.2, a leg in micrometres 1e6
WHOLE_MESH = "a whole PLY, STL or OBJ file with triangles"


@dataclass(frozen=True, slots=True, eq=False)
class MeshFile:
    """A scan, and how far from closed it is."""

    scan: Scan
    open_edges: int  # edges with one triangle only, of the rim and of holes; 0 if closed


def read_raw_mesh(path: str | Path) -> RawMesh:
    """The mesh in a PLY, STL or OBJ file, checked only for being whole; InputError where it cannot be read."""
    path = Path(path)
    if path.suffix.lower() not in MESH_READERS:
        raise InputError(path, "scan", path.suffix or "no suffix", f"a file {', '.join(MESH_READERS)}")
    if not path.is_file():
        raise InputError(path, "scan", "no such file", f"a file {', '.join(MESH_READERS)}")
    size = path.stat().st_size
    if size > MAX_MESH_FILE_BYTES:
        raise InputError(path, "size of the file", f"{size} bytes", f"{MAX_MESH_FILE_BYTES} or fewer")
    mesh = MESH_READERS[path.suffix.lower()](path)
    if not len(mesh.vertices):
        raise InputError(path, "scan", f"{size} bytes, no vertex in them", WHOLE_MESH)
    if not len(mesh.triangles):
        raise InputError(path, "scan", f"{len(mesh.vertices)} points and no triangles", WHOLE_MESH)
    return mesh


def read_mesh(path: str | Path) -> MeshFile:
    """Read and check a scan, mm; InputError says what is wrong with the file."""
    path = Path(path)
    raw = read_raw_mesh(path)
    vertices, triangles = raw.vertices, raw.triangles
    if not np.isfinite(vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise InputError(path, f"vertex {bad}", vertices[bad].tolist(), "three finite numbers, mm")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        bad = int(np.flatnonzero(((triangles < 0) | (triangles >= len(vertices))).any(axis=1))[0])
        raise InputError(path, f"triangle {bad}", triangles[bad].tolist(), f"vertices 0..{len(vertices) - 1}")
    _check_size(path, vertices[np.unique(triangles)])
    scan = scan_from_triangles(vertices, triangles)
    if not len(scan.triangles):
        raise InputError(path, "scan", f"{len(triangles)} triangles, all of them without area", WHOLE_MESH)
    return MeshFile(scan, len(open_edges(scan)))


def _check_size(path: Path, vertices: Array) -> None:
    longest = float(np.ptp(vertices, axis=0).max())
    if MIN_SCAN_SIZE <= longest <= MAX_SCAN_SIZE:
        return
    metres = MIN_SCAN_SIZE <= 1000 * longest <= MAX_SCAN_SIZE
    hint = f"; this one looks like metres ({1000 * longest:.4g} mm): multiply it by 1000" if metres else ""
    got = f"{longest:.4g} mm along its longest side"
    raise InputError(path, "size of the scan", got, f"{MIN_SCAN_SIZE:g} to {MAX_SCAN_SIZE:g} mm{hint}")


SCAN_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}  # mm of each
MAX_COORDINATE = 1e6  # mm: a kilometre; beyond it a scan has lost the hundredth of a millimetre, and sums overflow
MIN_SCAN_WITH_SKIN, MAX_SCAN_WITH_SKIN = 20.0, 1000.0  # mm, longest side: from a finger to a leg


def in_mm(vertices: Array, triangles: Array, unit: str, where: object) -> Array:
    """Vertices (V, 3) in mm; InputError where the scan is too small or too large, with the units that would fit."""
    used = vertices[np.unique(np.clip(triangles, 0, len(vertices) - 1))]
    used = used[np.isfinite(used).all(axis=1)]
    if not len(used):
        raise InputError(where, "vertices", "none that is finite", "a scan with finite coordinates")
    away = (np.abs(vertices) > MAX_COORDINATE / SCAN_UNITS[unit]).any(axis=1) & np.isfinite(vertices).all(axis=1)
    far = np.flatnonzero(away)
    if len(far):
        allowed = f"coordinates within {MAX_COORDINATE:g} mm, or not finite ones, which are left out"
        raise InputError(where, f"vertex {far[0]}", vertices[far[0]].tolist(), allowed)
    low, high = np.percentile(used, [1, 99], axis=0)  # without stray vertices
    longest = float((high - low).max())
    size = longest * SCAN_UNITS[unit]
    if MIN_SCAN_WITH_SKIN <= size <= MAX_SCAN_WITH_SKIN:
        return np.asarray(vertices * SCAN_UNITS[unit])
    fitting = [name for name, mm in SCAN_UNITS.items() if MIN_SCAN_WITH_SKIN <= longest * mm <= MAX_SCAN_WITH_SKIN]
    units = " or ".join(f"--unit {name} ({longest * SCAN_UNITS[name]:.0f} mm)" for name in fitting)
    hint = f"; its numbers look like another unit: say {units}" if units else ""
    allowed = f"{MIN_SCAN_WITH_SKIN:g} to {MAX_SCAN_WITH_SKIN:g} mm{hint}"
    raise InputError(where, "size of the scan", f"{size:.4g} mm along its longest side, read as {unit}", allowed)
