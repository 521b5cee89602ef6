"""What the header of a PLY file promises."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from hardware.raw_mesh import text_rows, wrong_line

LETTERS = {  # of the types: numpy and struct share them behind a byte order, and array has them too
    **{b"char": "b", b"uchar": "B", b"short": "h", b"ushort": "H", b"int": "i", b"uint": "I", b"float": "f"},
    **{b"int8": "b", b"uint8": "B", b"int16": "h", b"uint16": "H", b"int32": "i", b"uint32": "I", b"float32": "f"},
    **{b"double": "d", b"float64": "d"},
}
WHOLE = "bBhHiI"  # those of whole numbers
ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
DIGITS = 18  # of a count: fits 64 bits
LINES = "comment ..., element NAME COUNT, property TYPE NAME, property list TYPE TYPE NAME, or end_header"


@dataclass(frozen=True, slots=True)
class Property:
    """A value of each row, or a list of them. letter: of its type. count: of its length's type, "" for one value."""

    name: str
    letter: str
    count: str = ""


@dataclass(slots=True)
class Element:
    """A table of the file. rows: how many the header promises."""

    name: str
    rows: int
    properties: list[Property] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Header:
    """order: of bytes, "" where the rows are text. lines: how many the header has."""

    order: str
    elements: list[Element]
    lines: int


def read_header(file: BinaryIO, path: Path) -> Header:
    """The header of a PLY file, which then stands behind it; InputError names the line that is wrong or missing."""
    rows = text_rows(file, path)
    number, words = next(rows, (1, []))
    if words != [b"ply"]:
        raise wrong_line(path, number, words, "ply")
    order, elements = None, list[Element]()
    for number, words in rows:
        match words:
            case [b"comment" | b"obj_info", *_]:
                continue
            case [b"format", kind, b"1.0"] if order is None and kind in ORDERS:
                order = ORDERS[kind]
            case _ if order is None:
                raise wrong_line(path, number, words, f"format, one of {', '.join(map(bytes.decode, ORDERS))}, 1.0")
            case [b"element", name, count] if count.isdigit() and len(count) <= DIGITS:
                elements.append(Element(_name(name), int(count)))
            case [b"property", *rest] if elements and (found := _property(rest)):
                elements[-1].properties.append(found)
            case [b"end_header"]:
                _check(path, number, elements)
                return Header(order, elements, number)
            case _:
                raise wrong_line(path, number, words, LINES)
    raise wrong_line(path, number + 1, [], "end_header somewhere (is the file cut short?)")


def _property(words: list[bytes]) -> Property | None:
    """The property that the words behind `property` declare; None where they declare none."""
    match words:
        case [kind, name] if kind in LETTERS:
            return Property(_name(name), LETTERS[kind])
        case [b"list", count, kind, name] if kind in LETTERS and LETTERS.get(count, "f") in WHOLE:
            return Property(_name(name), LETTERS[kind], LETTERS[count])
    return None


def _name(word: bytes) -> str:
    return word.decode("utf-8", "backslashreplace")


def _check(path: Path, number: int, elements: list[Element]) -> None:
    """InputError where two of a kind have one name, or an element has no property."""
    own = [[one.name for one in element.properties] for element in elements]
    for names in ([element.name for element in elements], *own):
        if len(set(names)) < len(names) or not names:
            raise wrong_line(path, number, [b"end_header"], "it behind elements with properties, no name twice")
