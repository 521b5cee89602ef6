"""A mesh as its file has it, and what the readers of the formats share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from estimation.errors import InputError

LONGEST = 1 << 16  # bytes of a line of text: a triangle takes some fifty


@dataclass(frozen=True, slots=True, eq=False)
class RawMesh:
    """A mesh as its file has it. vertices: (V, 3), in whatever unit. triangles: (T, 3) numbers of vertices."""

    vertices: np.ndarray[Any, Any]
    triangles: np.ndarray[Any, Any]


def text_rows(file: BinaryIO, path: Path, first: int = 1) -> Iterator[tuple[int, list[bytes]]]:
    """The number and the words of each line that has any. first: number of the next line of the file."""
    for number, line in enumerate(iter(partial(file.readline, LONGEST), b""), first):
        if len(line) == LONGEST and not line.endswith(b"\n"):
            raise InputError(path, f"line {number}", f"{LONGEST} bytes or more", f"fewer than {LONGEST}")
        words = line.split()
        if words:
            yield number, words


def wrong_line(path: Path, number: int, words: list[bytes], allowed: str) -> InputError:
    """The error about a line of a text file."""
    return InputError(path, f"line {number}", b" ".join(words).decode("utf-8", "replace"), allowed)


def fans(counts: np.ndarray[Any, Any], corners: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Triangles (T, 3) of convex polygons. counts: (P,) corners of each, 3 or more. corners: all of them in a row."""
    inner = counts - 2  # triangles of each polygon
    start = np.repeat(np.cumsum(counts) - counts, inner)
    number = np.arange(len(start)) - np.repeat(np.cumsum(inner) - inner, inner)
    return np.column_stack([corners[start], corners[start + number + 1], corners[start + number + 2]])
