"""Scans from PLY, STL and OBJ files, read strictly: what is wrong, missing or too much is said, and nothing left out.

An arm moves along what was read, and the libraries for these files read damaged ones too, in part and without a word
(trimesh 5.2: text that ends early, vertex 0 of an OBJ file), or end the process (open3d 0.20).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.scan import Scan, open_edges, scan_from_triangles
from estimation.se3 import Array
from hardware.obj_file import read_obj
from hardware.ply_file import read_ply
from hardware.raw_mesh import RawMesh
from hardware.stl_file import read_stl

READERS = {".ply": read_ply, ".stl": read_stl, ".obj": read_obj}
LARGEST_FILE = 1 << 30  # bytes: a million triangles take 50 MB as binary, and up to 300 MB as an STL file's text
SMALLEST, LARGEST = 1.0, 2000.0  # mm: the longest side of a scan; a hand in metres is 0.2, a leg in micrometres 1e6
WHOLE = "a whole PLY, STL or OBJ file with triangles"


@dataclass(frozen=True, slots=True, eq=False)
class MeshFile:
    """A scan and how whole it is. open_edges: edges with one triangle only, the rim and the holes; 0 if closed."""

    scan: Scan
    open_edges: int


def read_raw_mesh(path: str | Path) -> RawMesh:
    """What a PLY, STL or OBJ file holds, unchecked but for being whole; InputError where it cannot be read."""
    path = Path(path)
    if path.suffix.lower() not in READERS:
        raise InputError(path, "scan", path.suffix or "no suffix", f"a file {', '.join(READERS)}")
    if not path.is_file():
        raise InputError(path, "scan", "no such file", f"a file {', '.join(READERS)}")
    size = path.stat().st_size
    if size > LARGEST_FILE:
        raise InputError(path, "size of the file", f"{size} bytes", f"{LARGEST_FILE} or fewer")
    mesh = READERS[path.suffix.lower()](path)
    if not len(mesh.vertices):
        raise InputError(path, "scan", f"{size} bytes, no vertex in them", WHOLE)
    if not len(mesh.triangles):
        raise InputError(path, "scan", f"{len(mesh.vertices)} points and no triangles", WHOLE)
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
        raise InputError(path, "scan", f"{len(triangles)} triangles, all of them without area", WHOLE)
    return MeshFile(scan, len(open_edges(scan)))


def _check_size(path: Path, vertices: Array) -> None:
    longest = float(np.ptp(vertices, axis=0).max())
    if SMALLEST <= longest <= LARGEST:
        return
    hint = ""
    if SMALLEST <= 1000 * longest <= LARGEST:
        hint = f"; this one looks like metres ({1000 * longest:.4g} mm): multiply it by 1000"
    got = f"{longest:.4g} mm along its longest side"
    raise InputError(path, "size of the scan", got, f"{SMALLEST:g} to {LARGEST:g} mm{hint}")
