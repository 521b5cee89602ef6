"""Scans from PLY, STL and OBJ files, through open3d, which is imported nowhere else and only once a scan is read."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimation.errors import InputError, StillbedError
from estimation.scan import Scan, open_edges, scan_from_triangles

SUFFIXES = (".ply", ".stl", ".obj")
SMALLEST, LARGEST = 1.0, 2000.0  # mm: the longest side of a scan; a hand in metres is 0.2, a leg in micrometres 1e6
WHOLE = "a whole PLY, STL or OBJ file with triangles"
APT_LINE = "sudo apt-get install -y libegl1 libgl1 libx11-6 libudev1 libusb-1.0-0 libidn2-0"


@dataclass(frozen=True, slots=True, eq=False)
class MeshFile:
    """A scan and how whole it is. open_edges: edges with one triangle only, the rim and the holes; 0 if closed."""

    scan: Scan
    open_edges: int


@dataclass(frozen=True, slots=True, eq=False)
class RawMesh:
    """A mesh as its file has it. vertices: (V, 3), in whatever unit. triangles: (T, 3) numbers of vertices."""

    vertices: np.ndarray[Any, Any]
    triangles: np.ndarray[Any, Any]


def read_raw_mesh(path: str | Path) -> RawMesh:
    """What a PLY, STL or OBJ file holds, unchecked but for being whole; InputError where it cannot be read."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(path, "scan", path.suffix or "no suffix", f"a file {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InputError(path, "scan", "no such file", f"a file {', '.join(SUFFIXES)}")
    vertices, triangles = _arrays(path)
    if not len(vertices):
        raise InputError(path, "scan", f"{path.stat().st_size} bytes, nothing that can be read", WHOLE)
    told = _told_faces(path)
    if len(triangles) < told:
        raise InputError(path, "faces", len(triangles), f"{told}, as the file's own header says (is it cut short?)")
    if not len(triangles):
        raise InputError(path, "scan", f"{len(vertices)} points and no triangles", WHOLE)
    return RawMesh(vertices, triangles)


def read_mesh(path: str | Path) -> MeshFile:
    """Read and check a scan, mm; InputError says what is wrong with the file, StillbedError what open3d lacks."""
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


def _check_size(path: Path, vertices: np.ndarray[Any, Any]) -> None:
    longest = float(np.ptp(vertices, axis=0).max())
    if SMALLEST <= longest <= LARGEST:
        return
    hint = ""
    if SMALLEST <= 1000 * longest <= LARGEST:
        hint = f"; this one looks like metres ({1000 * longest:.4g} mm): multiply it by 1000"
    got = f"{longest:.4g} mm along its longest side"
    raise InputError(path, "size of the scan", got, f"{SMALLEST:g} to {LARGEST:g} mm{hint}")


def _told_faces(path: Path) -> int:
    """How many faces a PLY header promises: open3d gives what it could read of a file that was cut short."""
    if path.suffix.lower() != ".ply":
        return 0
    with path.open("rb") as file:
        header = file.read(65536).split(b"end_header")[0]
    found = re.search(rb"^element\s+face\s+(\d+)\s*$", header, re.MULTILINE)
    return int(found[1]) if found else 0


def _arrays(path: Path) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Vertices (V, 3) and triangles (T, 3) as stored; none of either where open3d can read nothing."""
    open3d = _open3d(path)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        mesh = open3d.io.read_triangle_mesh(str(path))
    return np.array(mesh.vertices, np.float64).reshape(-1, 3), np.array(mesh.triangles, np.int64).reshape(-1, 3)


def _open3d(path: Path) -> Any:
    try:
        import open3d
    except ModuleNotFoundError as error:
        raise StillbedError(f"{path}: reading a scan needs open3d ({error}); run: pip install open3d-cpu") from error
    except (ImportError, OSError) as error:
        text = f"{path}: open3d, which reads scans, lacks a shared library ({error}); run: {APT_LINE}"
        raise StillbedError(text) from error
    return open3d
