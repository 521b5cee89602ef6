"""Meshes as PLY files: written as text, which every viewer reads; read as text and as binary of either byte order.

The readers of all mesh formats use the raw mesh, the lines of words and the fans of triangles defined here.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array

MAX_LINE_BYTES = 1 << 16  # bytes of a line of text: a triangle takes some fifty
MAX_MESH_ROWS = 2_000_000  # vertices, and faces: a plan of so many takes 1 GB, and a minute or two
Numbers = np.ndarray[Any, Any]


@dataclass(frozen=True, slots=True, eq=False)
class RawMesh:
    """A mesh as its file has it."""

    vertices: Numbers  # (V, 3), in the file's unit
    triangles: Numbers  # (T, 3) numbers of vertices


def text_rows(file: BinaryIO, path: Path, first: int = 1) -> Iterator[tuple[int, list[bytes]]]:
    """The number and the words of each line that has any. first: number of the next line of the file."""
    for number, line in enumerate(iter(partial(file.readline, MAX_LINE_BYTES), b""), first):
        if len(line) == MAX_LINE_BYTES and not line.endswith(b"\n"):
            raise InputError(path, f"line {number}", f"{MAX_LINE_BYTES} bytes or more", f"fewer than {MAX_LINE_BYTES}")
        words = line.split()
        if words:
            yield number, words


def wrong_line(path: Path, number: int, words: list[bytes], allowed: str) -> InputError:
    """The error about a line of a text file."""
    return InputError(path, f"line {number}", b" ".join(words).decode("utf-8", "replace"), allowed)


def check_rows(path: Path, what: str, count: int) -> None:
    """InputError where a mesh has more vertices or faces, which is known before they are read, than can be used."""
    if count > MAX_MESH_ROWS:
        raise InputError(path, what, count, f"{MAX_MESH_ROWS} or fewer: make the mesh coarser")


def fans(counts: Numbers, corners: Numbers) -> Numbers:
    """Triangles (T, 3) of convex polygons. counts: (P,) corners of each, 3 or more. corners: all of them in a row."""
    inner = counts - 2  # triangles of each polygon
    start = np.repeat(np.cumsum(counts) - counts, inner)
    number = np.arange(len(start)) - np.repeat(np.cumsum(inner) - inner, inner)
    return np.column_stack([corners[start], corners[start + number + 1], corners[start + number + 2]])


PLY_TYPES = {  # letter of each type, which numpy and struct share behind a byte order, and array has too
    **{b"char": "b", b"uchar": "B", b"short": "h", b"ushort": "H", b"int": "i", b"uint": "I", b"float": "f"},
    **{b"int8": "b", b"uint8": "B", b"int16": "h", b"uint16": "H", b"int32": "i", b"uint32": "I", b"float32": "f"},
    **{b"double": "d", b"float64": "d"},
}
WHOLE_NUMBER_TYPES = "bBhHiI"  # those of whole numbers
BYTE_ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
MAX_COUNT_DIGITS = 18  # of a count: fits 64 bits
PLY_HEADER_LINES = "comment ..., element NAME COUNT, property TYPE NAME, property list TYPE TYPE NAME, or end_header"


@dataclass(frozen=True, slots=True)
class PlyProperty:
    """A value of each row, or a list of values."""

    name: str
    letter: str  # of its type
    count: str = ""  # letter of the type of a list's length; "": one value


@dataclass(slots=True)
class PlyElement:
    """A table of the file."""

    name: str
    rows: int  # by the header
    properties: list[PlyProperty] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """The header of a PLY file."""

    order: str  # of bytes, as numpy and struct write it; "": the rows are text
    elements: list[PlyElement]
    lines: int  # of the header


def read_header(file: BinaryIO, path: Path) -> PlyHeader:
    """Read the header of a PLY file and stop behind it; InputError names the line that is wrong or missing."""
    rows = text_rows(file, path)
    number, words = next(rows, (1, []))
    if words != [b"ply"]:
        raise wrong_line(path, number, words, "ply")
    order, elements = None, list[PlyElement]()
    for number, words in rows:
        match words:
            case [b"comment" | b"obj_info", *_]:
                continue
            case [b"format", kind, b"1.0"] if order is None and kind in BYTE_ORDERS:
                order = BYTE_ORDERS[kind]
            case _ if order is None:
                formats = ", ".join(map(bytes.decode, BYTE_ORDERS))
                raise wrong_line(path, number, words, f"format, one of {formats}, 1.0")
            case [b"element", name, count] if count.isdigit() and len(count) <= MAX_COUNT_DIGITS:
                elements.append(PlyElement(_name(name), int(count)))
            case [b"property", *rest] if elements and (declared := _property(rest)):
                elements[-1].properties.append(declared)
            case [b"end_header"]:
                _check(path, number, elements)
                for element in elements:
                    check_rows(path, f"rows of {element.name}", element.rows)
                return PlyHeader(order, elements, number)
            case _:
                raise wrong_line(path, number, words, PLY_HEADER_LINES)
    raise wrong_line(path, number + 1, [], "end_header somewhere (is the file cut short?)")


def _property(words: list[bytes]) -> PlyProperty | None:
    """The property that the words behind `property` declare; None where they declare none."""
    match words:
        case [kind, name] if kind in PLY_TYPES:
            return PlyProperty(_name(name), PLY_TYPES[kind])
        case [b"list", count, kind, name] if kind in PLY_TYPES and PLY_TYPES.get(count, "f") in WHOLE_NUMBER_TYPES:
            return PlyProperty(_name(name), PLY_TYPES[kind], PLY_TYPES[count])
    return None


def _name(word: bytes) -> str:
    return word.decode("utf-8", "backslashreplace")


def _check(path: Path, number: int, elements: list[PlyElement]) -> None:
    """InputError where two of a kind have one name, or an element has no property."""
    own = [[one.name for one in element.properties] for element in elements]
    for names in ([element.name for element in elements], *own):
        if len(set(names)) < len(names) or not names:
            raise wrong_line(path, number, [b"end_header"], "it behind elements with properties, no name twice")


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One property of all R rows."""

    counts: Numbers  # (R,) number of values in each row
    values: Numbers  # of all rows, one row behind the other


@dataclass(slots=True)
class TextRows:
    """The rows that follow a header as text, one a line, read element by element."""

    path: Path
    lines: Iterator[tuple[int, list[bytes]]]  # number and words of each line behind the header

    def columns(self, element: PlyElement, wanted: list[int]) -> list[Column]:
        """The wanted properties of the next element, by their numbers; InputError where the element is not whole."""
        whole = [element.properties[k].letter in WHOLE_NUMBER_TYPES for k in wanted]
        counts, values = _arrays(["q" if each else "d" for each in whole])
        places = [(k, counts[n], values[n], int if whole[n] else float) for n, k in enumerate(wanted)]
        for row in range(element.rows):
            number, words = next(self.lines, (0, []))
            if not words:
                raise _cut_short(self.path, element, row)
            try:
                fields = _fields(element, words)
                for k, lengths, numbers, read in places:
                    lengths.append(len(fields[k]))
                    numbers.extend(map(read, fields[k]))
            except (ValueError, IndexError, OverflowError):
                names = [f"COUNT {one.name}..." if one.count else one.name for one in element.properties]
                raise wrong_line(self.path, number, words, f"{' '.join(names)}, in numbers") from None
        return _columns(counts, values)

    def end(self) -> None:
        """InputError where more rows follow than the header announces."""
        for number, words in self.lines:
            raise wrong_line(self.path, number, words, "nothing behind the rows that the header tells of")


def _fields(element: PlyElement, words: list[bytes]) -> list[list[bytes]]:
    """The words of each property of a row; ValueError or IndexError where there are too few, or too many."""
    fields, at = [], 0
    for one in element.properties:
        count = 1
        if one.count:
            count = int(words[at])
            at += 1
        if not 0 <= count <= len(words) - at:
            raise ValueError
        fields.append(words[at : at + count])
        at += count
    if at != len(words):
        raise ValueError
    return fields


@dataclass(slots=True)
class BinaryRows:
    """The rows that follow a header as packed binary numbers, read element by element."""

    path: Path
    data: bytes  # behind the header
    order: str  # of bytes
    at: int = 0  # place of the next row in data

    def columns(self, element: PlyElement, wanted: list[int]) -> list[Column]:
        """The wanted properties of the next element, by their numbers; InputError where the element is not whole."""
        columns = self._alike(element, wanted) if element.rows else None
        return self._one_by_one(element, wanted) if columns is None else columns

    def end(self) -> None:
        """InputError where more bytes follow than the header announces."""
        if self.data[self.at :].strip():
            raise InputError(self.path, "bytes behind the header", len(self.data), f"{self.at}, as it tells")

    def _alike(self, element: PlyElement, wanted: list[int]) -> list[Column] | None:
        """All rows at once where every list has the same length in all of them, else None."""
        lengths = [count for _, count in self._row(element, 0)]
        kinds: list[tuple[Any, ...]] = []
        for k, (one, count) in enumerate(zip(element.properties, lengths, strict=True)):
            kinds += [(f"count{k}", self.order + one.count)] if one.count else []
            kinds += [(f"value{k}", self.order + one.letter, (count,))]
        kind = np.dtype(kinds)
        fit = (len(self.data) - self.at) // kind.itemsize
        lists = [k for k, one in enumerate(element.properties) if one.count]
        if fit < element.rows and not lists:
            raise _cut_short(self.path, element, fit)
        if fit < element.rows:
            return None
        table = np.frombuffer(self.data, kind, element.rows, self.at)
        if any((table[f"count{k}"] != lengths[k]).any() for k in lists):
            return None
        self.at += table.nbytes
        return [Column(np.full(len(table), lengths[k]), table[f"value{k}"].reshape(-1)) for k in wanted]

    def _one_by_one(self, element: PlyElement, wanted: list[int]) -> list[Column]:
        letters = [element.properties[k].letter for k in wanted]
        counts, values = _arrays(letters)
        for row in range(element.rows):
            places = self._row(element, row)
            for k, column in enumerate(wanted):
                start, count = places[column]
                counts[k].append(count)
                values[k].extend(struct.unpack_from(f"{self.order}{count}{letters[k]}", self.data, start))
            start, count = places[-1]
            self.at = start + count * struct.calcsize(self.order + element.properties[-1].letter)
        return _columns(counts, values)

    def _row(self, element: PlyElement, row: int) -> list[tuple[int, int]]:
        """Where the values of each property of the next row begin, and how many there are."""
        places, at = [], self.at
        for one in element.properties:
            count, letter = 1, self.order + one.count
            if one.count:
                if at + struct.calcsize(letter) > len(self.data):
                    raise _cut_short(self.path, element, row)
                (count,) = struct.unpack_from(letter, self.data, at)
                at += struct.calcsize(letter)
            if count < 0:
                raise InputError(self.path, f"{element.name} {row}: length of {one.name}", count, "0 or more")
            places.append((at, count))
            at += count * struct.calcsize(self.order + one.letter)
            if at > len(self.data):
                raise _cut_short(self.path, element, row)
        return places


def _arrays(letters: list[str]) -> tuple[list[array[int]], list[array[Any]]]:
    return [array("q") for _ in letters], [array(letter) for letter in letters]


def _columns(counts: list[array[int]], values: list[array[Any]]) -> list[Column]:
    return [Column(np.array(c), np.array(v)) for c, v in zip(counts, values, strict=True)]


def _cut_short(path: Path, element: PlyElement, rows: int) -> InputError:
    allowed = f"{element.rows}, as the file's own header says (is it cut short?)"
    return InputError(path, f"rows of {element.name}", rows, allowed)


FACE_LIST_NAMES = ("vertex_indices", "vertex_index")  # what programs call the list of a face's vertices


def write_ply(path: Path, vertices: Array, triangles: NDArray[np.int64]) -> None:
    """Write vertices (V, 3) mm and triangles (T, 3) as a PLY file, in text."""
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    head += [f"property double {axis}" for axis in "xyz"]
    head += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
    body = [" ".join(repr(float(v)) for v in p) for p in vertices] + [f"3 {a} {b} {c}" for a, b, c in triangles]
    path.write_text("\n".join(head + body) + "\n", encoding="ascii")


def read_ply(path: Path) -> RawMesh:
    """The mesh in a PLY file, polygons as fans of triangles; InputError says what is wrong or missing."""
    vertices, triangles = np.empty((0, 3)), np.empty((0, 3), np.int64)
    with path.open("rb") as file:
        header = read_header(file, path)
        rows: TextRows | BinaryRows = TextRows(path, text_rows(file, path, header.lines + 1))
        if header.order:
            rows = BinaryRows(path, file.read(), header.order)
        for element in header.elements:
            if element.name == "vertex":
                columns = rows.columns(element, _places(element, path))
                vertices = np.column_stack([column.values for column in columns]).astype(np.float64)
            elif element.name == "face":
                (corners,) = rows.columns(element, [_corners(element, path)])
                few = np.flatnonzero(corners.counts < 3)
                if len(few):
                    raise InputError(path, f"face {few[0]}", f"{corners.counts[few[0]]} vertices", "3 or more")
                triangles = fans(corners.counts, corners.values.astype(np.int64))
            else:
                rows.columns(element, [])
        rows.end()
    return RawMesh(vertices, triangles)


def _places(element: PlyElement, path: Path) -> list[int]:
    """Which properties are x, y and z."""
    names = [one.name for one in element.properties if not one.count]
    if not {"x", "y", "z"} <= set(names):
        raise InputError(path, "properties of vertex", ", ".join(names), "x, y and z among them, a number each")
    return [k for axis in "xyz" for k, one in enumerate(element.properties) if one.name == axis]


def _corners(element: PlyElement, path: Path) -> int:
    """Which property is the list of a face's vertices."""
    for k, one in enumerate(element.properties):
        if one.name in FACE_LIST_NAMES and one.count and one.letter in WHOLE_NUMBER_TYPES:
            return k
    names = ", ".join(one.name for one in element.properties)
    raise InputError(path, "properties of face", names, f"{FACE_LIST_NAMES[0]} among them, a list of whole numbers")
