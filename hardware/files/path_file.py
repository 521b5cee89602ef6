"""Path files: the thesis's 9-vector checkpoints as CSV, whose header states the units (thesis 5.2).

    x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg,speed_mm_s,material,temperature_c,layer,extrude

Position and angles (Rz(gamma) Ry(beta) Rx(alpha)) are those of the nozzle in the surface frame; 0 0 0 is upright.
`layer` (0) and `extrude` (1) may be left out, `speed_mm_min` may stand for `speed_mm_s`, any further column is kept.
"""

from __future__ import annotations

import csv
import difflib
import math
from collections.abc import Sequence
from pathlib import Path as File

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from hardware.process import checks
from planning.path import Path, check_path

POSE = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
SPEEDS = {"speed_mm_s": 1.0, "speed_mm_min": 1 / 60}  # column: mm/s of its unit
REST = ("material", "temperature_c")
OPTIONAL = ("layer", "extrude")
HEADER = (*POSE, "speed_mm_s", *REST, *OPTIONAL)
STEMS = {name.split("_")[0]: name for name in ("temperature_c", *POSE)}  # x, alpha: they need units
STEMS["speed"] = " or ".join(SPEEDS)
SMALLEST = 0.1  # mm, corner to corner: less than any wound, and as much as a tenth of a metre has in metres
Words = dict[str, list[str]]


def read_path(file: str | File) -> Path:
    """The path in a CSV file; InputError names line and column of whatever cannot be printed."""
    file = File(file)
    lines, words = _columns(file)
    speed_column = next(name for name in SPEEDS if name in words)
    numbers = {name: _numbers(file, lines, name, words[name]) for name in (*POSE, speed_column, "temperature_c")}
    pose = np.stack([numbers[name] for name in POSE], axis=1)
    path = Path(
        surface_from_nozzle=se3.make(se3.rotation_from_euler(np.deg2rad(pose[:, 3:])), pose[:, :3]),
        speed=numbers[speed_column] * SPEEDS[speed_column],
        material=_material(file, lines, words["material"]),
        temperature=numbers["temperature_c"],
        layer=_whole(file, lines, "layer", words.get("layer", ["0"] * len(lines)), None),
        extrude=_whole(file, lines, "extrude", words.get("extrude", ["1"] * len(lines)), (0, 1)) == 1,
        extra={name: np.array(words[name]) for name in words if name not in (*HEADER, *SPEEDS)},
    )
    try:
        check_path(path, file, lines)
    except InputError as error:
        line, _, value = error.what.rpartition(": ")
        if (column := {"speed": speed_column, "temperature": "temperature_c"}.get(value)) is None:
            raise
        word = words[column][lines.index(int(line.removeprefix("line ")))]
        raise InputError(file, f"{line}: {column}", word, error.allowed) from None
    span = float(np.linalg.norm(np.ptp(pose[:, :3], axis=0)))
    if span < SMALLEST:
        allowed = f"{SMALLEST:g} mm or more from corner to corner: are they in metres?"
        raise InputError(file, "positions", f"{span:.3g} mm from corner to corner", allowed)
    return path


def write_path(file: str | File, path: Path) -> None:
    """Write a path, every number with the digits that give the same float64 back (angles: to rounding)."""
    angles_deg = np.rad2deg(se3.euler_from_rotation(path.surface_from_nozzle[:, :3, :3])) + 0.0  # no -0
    numbers = np.column_stack([path.surface_from_nozzle[:, :3, 3], angles_deg, path.speed])
    with open(file, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*HEADER, *path.extra])
        for i, row in enumerate(numbers):
            rest = [path.material[i], repr(float(path.temperature[i])), path.layer[i], int(path.extrude[i])]
            writer.writerow([*(repr(float(v)) for v in row), *rest, *(column[i] for column in path.extra.values())])


def _columns(file: File) -> tuple[list[int], Words]:
    """Line numbers of the checkpoints, and the words of each column."""
    rows = [(n, [word.strip() for word in row]) for n, row in checks.read_csv(file) if any(map(str.strip, row))]
    if not rows:
        raise InputError(file, "file", "empty", f"a header {','.join(HEADER)} and 2 checkpoints or more")
    (_, header), body = rows[0], rows[1:]
    _check_header(file, header)
    for line, row in body:
        if len(row) != len(header):
            raise InputError(file, f"line {line}", f"{len(row)} values", f"{len(header)}, as in the header")
    if len(body) < 2:
        raise InputError(file, "checkpoints", len(body), "2 or more")
    return [line for line, _ in body], {name: [row[i] for _, row in body] for i, name in enumerate(header)}


def _check_header(file: File, header: Sequence[str]) -> None:
    if len(header) == 1 and ";" in header[0]:
        raise InputError(file, "header", header[0], "names with commas between them, not semicolons")
    for i, name in enumerate(header):
        if not name or name in header[:i]:
            raise InputError(file, f"header, column {i + 1}", name, "a name, and each once")
        if name in (*HEADER, *SPEEDS):
            continue
        if (stem := name.split("_")[0]) in STEMS:
            raise InputError(file, f"header, column {i + 1}", name, f"{STEMS[stem]}, in this unit")
        if difflib.get_close_matches(name, HEADER, 1):
            raise InputError(file, f"header, column {i + 1}", name, checks.meant(name, HEADER))
    for name in (*POSE, *REST):
        if name not in header:
            raise InputError(file, "header", f"no {name}", ",".join(HEADER))
    if sum(name in header for name in SPEEDS) != 1:
        raise InputError(file, "header", ",".join(header), f"one of {', '.join(SPEEDS)}")


def _numbers(file: File, lines: Sequence[int], name: str, words: Sequence[str]) -> NDArray[np.float64]:
    numbers = np.array([_number(word) for word in words])
    wrong = np.flatnonzero(~np.isfinite(numbers))
    if len(wrong):
        raise InputError(file, f"line {lines[wrong[0]]}: {name}", words[wrong[0]], "a finite number")
    return numbers


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


def _whole(
    file: File, lines: Sequence[int], name: str, words: Sequence[str], allowed: tuple[int, ...] | None
) -> NDArray[np.int64]:
    for line, word in zip(lines, words, strict=True):
        whole = word.removeprefix("-").isdecimal() and word.isascii() and len(word) < 19
        if not whole or (allowed is not None and int(word) not in allowed):
            raise InputError(file, f"line {line}: {name}", word, "a whole number" if allowed is None else "0 or 1")
    return np.array([int(word) for word in words], np.int64)


def _material(file: File, lines: Sequence[int], words: Sequence[str]) -> NDArray[np.int64] | NDArray[np.str_]:
    """Whole numbers where all are, else names."""
    if "" in words:
        raise InputError(file, f"line {lines[words.index('')]}: material", "", "a name or a whole number")
    if all(word.isascii() and word.isdecimal() and len(word) < 19 and str(int(word)) == word for word in words):
        return np.array([int(word) for word in words], np.int64)
    return np.array(words)
