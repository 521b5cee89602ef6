"""The rows of a PLY file's elements, from text or from binary."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from estimation.errors import InputError
from hardware.ply_header import WHOLE, Element
from hardware.raw_mesh import wrong_line

Numbers = np.ndarray[Any, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One property of all rows. counts: (R,) values of each row. values: all of them, one row behind the other."""

    counts: Numbers
    values: Numbers


class Rows(Protocol):
    """The rows that follow a header, element by element."""

    def columns(self, element: Element, wanted: list[int]) -> list[Column]:
        """The wanted properties of the next element, by their numbers; InputError where it is not whole."""

    def end(self) -> None:
        """InputError where more follows than the header tells of."""


@dataclass(slots=True)
class TextRows:
    """A line for each row. lines: numbers and words of those behind the header."""

    path: Path
    lines: Iterator[tuple[int, list[bytes]]]

    def columns(self, element: Element, wanted: list[int]) -> list[Column]:
        """As `Rows.columns`."""
        whole = [element.properties[k].letter in WHOLE for k in wanted]
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
        """As `Rows.end`."""
        for number, words in self.lines:
            raise wrong_line(self.path, number, words, "nothing behind the rows that the header tells of")


def _fields(element: Element, words: list[bytes]) -> list[list[bytes]]:
    """The words of each property of a row; ValueError or IndexError where there are too few, or too many."""
    found, at = [], 0
    for one in element.properties:
        count = 1
        if one.count:
            count = int(words[at])
            at += 1
        if not 0 <= count <= len(words) - at:
            raise ValueError
        found.append(words[at : at + count])
        at += count
    if at != len(words):
        raise ValueError
    return found


@dataclass(slots=True)
class BinaryRows:
    """Rows without anything between them. data: what is behind the header. order: of its bytes. at: the next one."""

    path: Path
    data: bytes
    order: str
    at: int = 0

    def columns(self, element: Element, wanted: list[int]) -> list[Column]:
        """As `Rows.columns`."""
        found = self._alike(element, wanted) if element.rows else None
        return self._one_by_one(element, wanted) if found is None else found

    def end(self) -> None:
        """As `Rows.end`."""
        if self.data[self.at :].strip():
            raise InputError(self.path, "bytes behind the header", len(self.data), f"{self.at}, as it tells")

    def _alike(self, element: Element, wanted: list[int]) -> list[Column] | None:
        """All rows at once, where their lists are as long as those of the first; None where they are not."""
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

    def _one_by_one(self, element: Element, wanted: list[int]) -> list[Column]:
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

    def _row(self, element: Element, row: int) -> list[tuple[int, int]]:
        """Where the values of each property of the next row begin, and how many there are."""
        found, at = [], self.at
        for one in element.properties:
            count, letter = 1, self.order + one.count
            if one.count:
                if at + struct.calcsize(letter) > len(self.data):
                    raise _cut_short(self.path, element, row)
                (count,) = struct.unpack_from(letter, self.data, at)
                at += struct.calcsize(letter)
            if count < 0:
                raise InputError(self.path, f"{element.name} {row}: length of {one.name}", count, "0 or more")
            found.append((at, count))
            at += count * struct.calcsize(self.order + one.letter)
            if at > len(self.data):
                raise _cut_short(self.path, element, row)
        return found


def _arrays(letters: list[str]) -> tuple[list[array[int]], list[array[Any]]]:
    return [array("q") for _ in letters], [array(letter) for letter in letters]


def _columns(counts: list[array[int]], values: list[array[Any]]) -> list[Column]:
    return [Column(np.array(c), np.array(v)) for c, v in zip(counts, values, strict=True)]


def _cut_short(path: Path, element: Element, rows: int) -> InputError:
    allowed = f"{element.rows}, as the file's own header says (is it cut short?)"
    return InputError(path, f"rows of {element.name}", rows, allowed)
