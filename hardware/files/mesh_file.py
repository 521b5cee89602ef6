"""Scans from meshes and point clouds: read by open3d apart (`mesh_reader`), counted against the file, and checked.

An arm moves along the scan, and the libraries for these files read damaged ones in part and without an error. So the
header, or the lines of a format without one, tells what must come; whatever is wrong, missing or too much is an error.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.scans.scan import Scan, scan_from_triangles
from estimation.se3 import Array
from hardware.files.mesh_reader import (
    PLAIN_READERS,
    MeshReader,
    MeshReaderError,
    RawMesh,
    check_rows,
    text_rows,
    wrong_line,
)


@dataclass(frozen=True, slots=True)
class Announcement:
    """What a file says it holds."""

    vertices: int | None = None  # None: it does not say
    faces: int | None = None  # 0: a cloud
    triangles: int | None = None  # where it says how many corners faces have
    check: Callable[[int], None] = lambda triangles: None  # of the file's length, once the triangles are known


PLY_TYPES = {  # bytes of each
    **{b"char": 1, b"uchar": 1, b"short": 2, b"ushort": 2, b"int": 4, b"uint": 4, b"float": 4, b"double": 8},
    **{b"int8": 1, b"uint8": 1, b"int16": 2, b"uint16": 2, b"int32": 4, b"uint32": 4, b"float32": 4, b"float64": 8},
}
BROKEN_NUMBERS = (b"float", b"float32", b"double", b"float64")  # types that count and name nothing
PLY_FORMATS = (b"ascii", b"binary_little_endian", b"binary_big_endian")
FACE_LIST_NAMES = (b"vertex_indices", b"vertex_index")  # what programs call the list of a face's vertices
MAX_COUNT_DIGITS = 18  # of a count: fits 64 bits
PLY_HEADER_LINES = "comment ..., element NAME COUNT, property TYPE NAME, property list TYPE TYPE NAME, or end_header"


@dataclass(slots=True)
class PlyElement:
    """A table of a PLY file."""

    rows: int  # by the header
    names: list[bytes] = field(default_factory=list)  # of its properties
    row_bytes: int = 0  # of a row without lists
    lists: dict[bytes, tuple[int, int]] = field(default_factory=dict)  # bytes of a count and of an entry, by name

    def whole(self, tokens: list[bytes]) -> bool:
        """Whether the tokens of a line are a number for each property, and a face has three corners or more."""
        at = 0
        for name in self.names:
            count = tokens[at] if name in self.lists and at < len(tokens) else b"0"
            if not count.isdigit() or len(count) > MAX_COUNT_DIGITS or (name in FACE_LIST_NAMES and int(count) < 3):
                return False
            at += 1 + int(count)
        return at == len(tokens)


def announced_by_ply(path: Path) -> Announcement:
    """What the header of a PLY file says; InputError names the line that is wrong or missing."""
    with path.open("rb") as file:
        kind, elements, lines = _ply_header(file, path)
        begin = file.tell()
    vertex, face = elements.get(b"vertex", PlyElement(0)), elements.get(b"face", PlyElement(0))
    for name, element in elements.items():
        check_rows(path, f"rows of {name.decode('utf-8', 'replace')}", element.rows)
    if [name for name in vertex.names if name in (b"x", b"y", b"z") and name not in vertex.lists] != [b"x", b"y", b"z"]:
        allowed = "x, y and z among them in this order, a number each"
        raise InputError(path, "properties of vertex", _joined(vertex.names), allowed)
    corners = [name for name in face.lists if name in FACE_LIST_NAMES]
    if face.rows and not corners:
        allowed = f"{FACE_LIST_NAMES[0].decode()} among them, a list of whole numbers"
        raise InputError(path, "properties of face", _joined(face.names), allowed)
    if kind == b"ascii":
        _check_lines(path, lines, elements)
    unsupported = sum(len(element.lists) for element in elements.values()) > 1 or len(corners) < len(face.lists)

    def check(triangles: int) -> None:
        if unsupported or kind == b"ascii":  # lists of any length: that of the file follows from nothing
            return
        count = triangles + 2 * face.rows  # of corners: a polygon of n has n - 2 triangles
        size = sum(e.rows * (e.row_bytes + sum(counted for counted, _ in e.lists.values())) for e in elements.values())
        size += count * face.lists[corners[0]][1] if corners else 0
        with path.open("rb") as file:
            file.seek(begin + size)
            rest = file.read(2)
        if rest.strip() or path.stat().st_size < begin + size:
            _check_length(path, "bytes behind the header", path.stat().st_size - begin, size)

    return Announcement(vertex.rows, face.rows, check=check)


def _joined(names: list[bytes]) -> str:
    return b", ".join(names).decode("utf-8", "replace")


def _check_length(path: Path, what: str, got: int, expected: int) -> None:
    if got != expected:
        raise InputError(path, what, got, f"{expected}, as it tells (is it cut short, or was more appended?)")


def _check_lines(path: Path, header_lines: int, elements: dict[bytes, PlyElement]) -> None:
    """InputError where rows of text are incomplete: rply, which reads them, takes any next tokens."""
    owners = (element for element in elements.values() for _ in range(element.rows))
    with path.open("rb") as file:
        for number, tokens in text_rows(file, path):
            if number <= header_lines:
                continue
            owner = next(owners, None)
            if owner is None:
                raise wrong_line(path, number, tokens, "nothing behind the rows that the header tells of")
            if not owner.whole(tokens):
                names = b" ".join(b"COUNT " + n + b"..." if n in owner.lists else n for n in owner.names)
                raise wrong_line(path, number, tokens, f"{names.decode('utf-8', 'replace')}, in numbers")
    if missing := sum(1 for _ in owners):
        raise InputError(path, "rows that are missing", missing, "none (is the file cut short?)")


def _ply_header(file: BinaryIO, path: Path) -> tuple[bytes, dict[bytes, PlyElement], int]:
    """Format, elements and number of lines of a PLY file's header, behind which the file is left."""
    rows = text_rows(file, path)
    number, tokens = next(rows, (1, []))
    if tokens != [b"ply"]:
        raise wrong_line(path, number, tokens, "ply")
    kind, elements, last = None, dict[bytes, PlyElement](), None
    for number, tokens in rows:
        match tokens:
            case [b"comment" | b"obj_info", *_]:
                continue
            case [b"format", form, b"1.0"] if kind is None and form in PLY_FORMATS:
                kind = form
            case _ if kind is None:
                formats = ", ".join(map(bytes.decode, PLY_FORMATS))
                raise wrong_line(path, number, tokens, f"format, one of {formats}, 1.0")
            case [b"element", name, count] if (
                count.isdigit() and len(count) <= MAX_COUNT_DIGITS and name not in elements
            ):
                elements[name] = last = PlyElement(int(count))
            case [b"property", b"list", count, each, name] if last and _countable(count) and each in PLY_TYPES:
                whole = name not in FACE_LIST_NAMES or _countable(each)
                if not whole or name in last.names:
                    raise wrong_line(path, number, tokens, "a list of whole numbers, no name twice")
                last.names.append(name)
                last.lists[name] = PLY_TYPES[count], PLY_TYPES[each]
            case [b"property", each, name] if last and each in PLY_TYPES and name not in last.names:
                last.names.append(name)
                last.row_bytes += PLY_TYPES[each]
            case [b"end_header"] if all(element.names for element in elements.values()):
                return kind, elements, number
            case _:
                raise wrong_line(path, number, tokens, f"{PLY_HEADER_LINES}; no name twice, no element without any")
    raise wrong_line(path, number + 1, [], "end_header somewhere (is the file cut short?)")


def _countable(kind: bytes) -> bool:
    return kind in PLY_TYPES and kind not in BROKEN_NUMBERS


def announced_by_off(path: Path) -> Announcement:
    """The first numbers of an OFF file."""
    with path.open("rb") as file:
        rows = ((n, tokens) for n, tokens in text_rows(file, path) if not tokens[0].startswith(b"#"))
        number, tokens = next(rows, (1, []))
        if not tokens or not tokens[0].endswith(b"OFF"):
            raise wrong_line(path, number, tokens, "OFF")
        if len(tokens) == 1:
            number, tokens = next(rows, (number + 1, []))
    counts = tokens[-3:]
    if len(counts) < 3 or not all(count.isdigit() and len(count) <= MAX_COUNT_DIGITS for count in counts):
        raise wrong_line(path, number, tokens, "the numbers of vertices, faces and edges")
    for what, count in zip(("vertices", "faces"), counts, strict=False):
        check_rows(path, what, int(count))
    return Announcement(int(counts[0]), int(counts[1]))


def announced_by_pcd(path: Path) -> Announcement:
    """The points that the header of a PCD file tells of."""
    with path.open("rb") as file:
        for _, cells in text_rows(file, path):
            if cells[0] == b"POINTS" and len(cells) == 2 and cells[1].isdigit() and len(cells[1]) <= MAX_COUNT_DIGITS:
                check_rows(path, "points", int(cells[1]))
                return Announcement(int(cells[1]), 0)
            if cells[0] == b"DATA":
                break
    raise InputError(path, "header", "no line POINTS before DATA", "POINTS and how many there are")


# open3d takes what begins like a number for one
NUMBER = rb"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|nan|inf)"
THREE_NUMBERS = rb"(?: " + NUMBER + rb"){3}"
XYZ_LINE = re.compile(THREE_NUMBERS + rb"(?: " + NUMBER + rb")*", re.IGNORECASE)


def announced_by_xyz(path: Path) -> Announcement:
    """The lines of an XYZ file, a point each."""
    count = 0
    with path.open("rb") as file:
        for number, tokens in text_rows(file, path):
            if tokens[0].startswith(b"#"):
                continue
            if not XYZ_LINE.fullmatch(b" " + b" ".join(tokens)):
                raise wrong_line(path, number, tokens, "three numbers, or more")
            count += 1
            check_rows(path, "points", count)
    return Announcement(count, 0)


GLB_HEADER = 20  # bytes before the JSON of a GLB file


def announced_by_gltf(path: Path) -> Announcement:
    """The triangles that the primitives of a glTF or GLB file tell of."""
    try:
        with path.open("rb") as file:
            head = file.read(GLB_HEADER)
            if head[:4] == b"glTF":
                length = int.from_bytes(head[8:12], "little")
                _check_length(path, "bytes", path.stat().st_size, length)
                tree = json.loads(file.read(int.from_bytes(head[12:16], "little")))
            else:
                tree = json.loads(head + file.read())
        primitives = [primitive for mesh in tree["meshes"] for primitive in mesh["primitives"]]
        accessor = [primitive.get("indices", primitive["attributes"]["POSITION"]) for primitive in primitives]
        count = sum(tree["accessors"][each]["count"] // 3 for each in accessor)
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(path, "scan", f"{type(error).__name__} in its JSON", "a glTF file with meshes") from None
    check_rows(path, "triangles", count)
    return Announcement(faces=count, triangles=count)


ANNOUNCED: dict[str, Callable[[Path], Announcement]] = {  # formats that are read apart
    **{".ply": announced_by_ply, ".off": announced_by_off, ".gltf": announced_by_gltf, ".glb": announced_by_gltf},
    **{".pcd": announced_by_pcd, ".xyz": announced_by_xyz},
}
MESH_FORMATS = (".ply", *PLAIN_READERS, *(suffix for suffix in ANNOUNCED if suffix != ".ply"))
MAX_MESH_FILE_BYTES = 1 << 30  # bytes: a million triangles take 50 MB as binary, and up to 300 MB as an STL file's text
MIN_SCAN_SIZE, MAX_SCAN_SIZE = 1.0, 2000.0  # mm, longest side: a hand in metres is 0.2, a leg in micrometres 1e6
WHOLE_MESH = "a whole file of a mesh with triangles, or of a cloud of points"


def read_raw_mesh(path: str | Path, reader: MeshReader | None = None) -> RawMesh:
    """The mesh in a file, or the surface through its points, checked only for being whole.

    reader: a process that is kept, for many files. InputError where it cannot be read, or not as a whole.
    """
    path = Path(path)
    formats = ", ".join(MESH_FORMATS)
    if path.suffix.lower() not in MESH_FORMATS:
        raise InputError(path, "scan", path.suffix or "no suffix", f"a file {formats}")
    if not path.is_file():
        raise InputError(path, "scan", "no such file", f"a file {formats}")
    stat_before = path.stat()
    if stat_before.st_size > MAX_MESH_FILE_BYTES:
        raise InputError(path, "size of the file", f"{stat_before.st_size} bytes", f"{MAX_MESH_FILE_BYTES} or fewer")
    if not stat_before.st_size:
        raise InputError(path, "scan", "0 bytes", WHOLE_MESH)
    suffix = path.suffix.lower()
    plain = PLAIN_READERS.get(suffix)
    mesh = _read_in_process(path, ANNOUNCED[suffix](path), reader) if plain is None else plain(path)
    stat_after = path.stat()
    if (stat_after.st_size, stat_after.st_mtime_ns) != (stat_before.st_size, stat_before.st_mtime_ns):
        raise InputError(path, "scan", "a file that changed while it was read", "one that is finished")
    if not len(mesh.triangles) or not len(mesh.vertices):
        got = f"{stat_before.st_size} bytes, {len(mesh.vertices)} points, {len(mesh.triangles)} triangles"
        raise InputError(path, "scan", got, WHOLE_MESH)
    return mesh


def _read_in_process(path: Path, announcement: Announcement, reader_process: MeshReader | None) -> RawMesh:
    """What another process reads of a file, InputError where that is not what the file tells of."""
    if not announcement.faces and not announcement.vertices:
        raise InputError(path, "scan", f"{path.stat().st_size} bytes, no vertex in them", WHOLE_MESH)
    try:
        with nullcontext(reader_process) if reader_process is not None else MeshReader() as reader:
            arrays = reader.read(path, not announcement.faces)
    except MeshReaderError as error:
        raise InputError(path, "scan", str(error), WHOLE_MESH) from None
    vertices, triangles = int(arrays["count"]), len(arrays["triangles"])
    hint = "as the file itself says (is it cut short, or damaged?)"
    if announcement.vertices is not None and vertices != announcement.vertices:
        raise InputError(path, "vertices that could be read", vertices, f"{announcement.vertices}, {hint}")
    if announcement.triangles is not None and triangles != announcement.triangles:
        raise InputError(path, "triangles that could be read", triangles, f"{announcement.triangles}, {hint}")
    if announcement.faces and triangles < announcement.faces:
        raise InputError(path, "faces that could be read", triangles, f"{announcement.faces}, {hint}")
    announcement.check(triangles if announcement.faces else 0)
    return RawMesh(arrays["vertices"], arrays["triangles"], arrays.get("colours"))


def read_mesh(path: str | Path, reader: MeshReader | None = None) -> Scan:
    """Read and check a scan, mm; InputError says what is wrong with the file. reader: see `read_raw_mesh`."""
    path = Path(path)
    raw = read_raw_mesh(path, reader)
    vertices, triangles = raw.vertices, raw.triangles
    if not np.isfinite(vertices).all():
        index = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise InputError(path, f"vertex {index}", vertices[index].tolist(), "three finite numbers, mm")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        index = int(np.flatnonzero(((triangles < 0) | (triangles >= len(vertices))).any(axis=1))[0])
        raise InputError(path, f"triangle {index}", triangles[index].tolist(), f"vertices 0..{len(vertices) - 1}")
    _check_size(path, vertices[np.unique(triangles)])
    scan = scan_from_triangles(vertices, triangles)
    if not len(scan.triangles):
        raise InputError(path, "scan", f"{len(triangles)} triangles, all of them without area", WHOLE_MESH)
    return scan


def _check_size(path: Path, vertices: Array) -> None:
    longest = float(np.ptp(vertices, axis=0).max())
    if MIN_SCAN_SIZE <= longest <= MAX_SCAN_SIZE:
        return
    metres = MIN_SCAN_SIZE <= 1000 * longest <= MAX_SCAN_SIZE
    hint = f"; this one looks like metres ({1000 * longest:.4g} mm): multiply it by 1000" if metres else ""
    got = f"{longest:.4g} mm along its longest side"
    raise InputError(path, "size of the scan", got, f"{MIN_SCAN_SIZE:g} to {MAX_SCAN_SIZE:g} mm{hint}")


def write_ply(path: Path, vertices: Array, triangles: NDArray[np.int64]) -> None:
    """Write vertices (V, 3) mm and triangles (T, 3) as a PLY file, in text."""
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    head += [f"property double {axis}" for axis in "xyz"]
    head += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
    body = [" ".join(repr(float(v)) for v in p) for p in vertices] + [f"3 {a} {b} {c}" for a, b, c in triangles]
    path.write_text("\n".join(head + body) + "\n", encoding="ascii")


def write_scan(
    path: Path, vertices: Array, triangles: NDArray[np.int64], colours: NDArray[np.uint8], sigma: Array
) -> None:
    """Write a scan as a binary PLY file: vertices (V, 3) mm, colours (V, 3) RGB, sigma (V,) mm, triangles (T, 3)."""
    head = ["ply", "format binary_little_endian 1.0", "comment mm; sigma: one standard deviation across the surface"]
    head += [f"element vertex {len(vertices)}", *(f"property float {axis}" for axis in "xyz")]
    head += [*(f"property uchar {name}" for name in ("red", "green", "blue")), "property float sigma"]
    head += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
    vertex = np.zeros(len(vertices), np.dtype([("at", "<f4", 3), ("rgb", "u1", 3), ("sigma", "<f4")]))
    vertex["at"], vertex["rgb"], vertex["sigma"] = vertices, colours, sigma
    face = np.zeros(len(triangles), np.dtype([("count", "u1"), ("corner", "<i4", 3)]))
    face["count"], face["corner"] = 3, triangles
    path.write_bytes(("\n".join(head) + "\n").encode("ascii") + vertex.tobytes() + face.tobytes())
