"""Path files: the thesis's 9-vector checkpoints as CSV, whose header states the units (thesis 5.2).

    x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg,speed_mm_s,material,temperature_c,layer,extrude

Position and angles (Rz(gamma) Ry(beta) Rx(alpha)) are those of the nozzle in the surface frame; 0 0 0 is upright.
`layer` (0) and `extrude` (1) may be left out, `speed_mm_min` may stand for `speed_mm_s`, any further column is kept.

Beside them: a path as plain G-code; contours of wounds as CSV, x_mm,y_mm or x_mm,y_mm,z_mm; and progress.toml, how far
a print is, which outlives the run:

    path = "3f0c..."      # fingerprint of the path's places, speeds, materials, temperatures, layers and extrusion
    fraction = 12.35      # place on it, counted in checkpoints
    printed = 12          # the last checkpoint that is done, for people
"""

from __future__ import annotations

import base64
import csv
import difflib
import io
import json
import math
import os
import threading
import zlib
from collections.abc import Sequence
from ctypes import c_double
from functools import partial
from pathlib import Path as File
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process import checks
from planning.clearance import Balls, Envelope, TissueGuard, ToolBody
from planning.path import Column, Path, PrintProgress, ProgressMark, check_path, fingerprint, resume_fraction

POSE_COLUMNS = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
SPEED_COLUMNS = {"speed_mm_s": 1.0, "speed_mm_min": 1 / 60}  # column: mm/s of its unit
PRINT_COLUMNS = ("material", "temperature_c")
OPTIONAL_COLUMNS = ("layer", "extrude")
PATH_HEADER = (*POSE_COLUMNS, "speed_mm_s", *PRINT_COLUMNS, *OPTIONAL_COLUMNS)
COLUMN_STEMS = {name.split("_")[0]: name for name in ("temperature_c", *POSE_COLUMNS)}  # x, alpha: they need units
COLUMN_STEMS["speed"] = " or ".join(SPEED_COLUMNS)
MIN_PATH_SPAN = 0.1  # mm, corner to corner: less than any wound, and as much as a tenth of a metre has in metres
PROGRESS_PERIOD = 0.05  # s between looks at the place: a tenth of a checkpoint's time, or less


def read_path(file: str | File) -> Path:
    """The path in a CSV file; InputError names line and column of whatever cannot be printed."""
    return _path_from_rows(File(file), checks.read_csv(File(file)))


def path_from_text(text: str, where: str | File) -> Path:
    """The path in the text of a path file; InputError (where) as `read_path`."""
    return _path_from_rows(File(where), checks.read_csv(File(where), text=text))


def _path_from_rows(file: File, rows: list[checks.CsvRow]) -> Path:
    lines, cells = _columns(file, rows)
    speed_column = next(name for name in SPEED_COLUMNS if name in cells)
    number_columns = (*POSE_COLUMNS, speed_column, "temperature_c")
    numbers = {name: checks.csv_numbers(file, lines, name, cells[name]) for name in number_columns}
    pose = np.stack([numbers[name] for name in POSE_COLUMNS], axis=1)
    path = Path(
        surface_from_nozzle=se3.make(se3.rotation_from_euler(np.deg2rad(pose[:, 3:])), pose[:, :3]),
        speed=numbers[speed_column] * SPEED_COLUMNS[speed_column],
        material=_material(file, lines, cells["material"]),
        temperature=numbers["temperature_c"],
        layer=_ints(file, lines, "layer", cells.get("layer", ["0"] * len(lines))),
        extrude=_ints(file, lines, "extrude", cells.get("extrude", ["1"] * len(lines)), flags=True) == 1,
        extra={name: _further(cells[name]) for name in cells if name not in (*PATH_HEADER, *SPEED_COLUMNS)},
    )
    named = {"speed": speed_column, "temperature": "temperature_c"}
    check_path(path, file, lines, {value: (column, cells[column]) for value, column in named.items()})
    span = float(np.linalg.norm(np.ptp(pose[:, :3], axis=0)))
    if span < MIN_PATH_SPAN:
        allowed = f"{MIN_PATH_SPAN:g} mm or more from corner to corner: are they in metres?"
        raise InputError(file, "positions", f"{span:.3g} mm from corner to corner", allowed)
    return path


def write_path(file: str | File, path: Path) -> None:
    """Write a path, every number with the digits that give the same float64 back (angles: to rounding)."""
    File(file).write_text(path_text(path), encoding="utf-8", newline="")


def path_text(path: Path) -> str:
    """The text of a path file, as `write_path` writes it."""
    angles_deg = np.rad2deg(se3.euler_from_rotation(path.surface_from_nozzle[:, :3, :3])) + 0.0  # no -0
    numbers = np.column_stack([path.surface_from_nozzle[:, :3, 3], angles_deg, path.speed])
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*PATH_HEADER, *path.extra])
    further = [_cells(column) for column in path.extra.values()]
    for i, row in enumerate(numbers):
        rest = [path.material[i], repr(float(path.temperature[i])), path.layer[i], int(path.extrude[i])]
        writer.writerow([*(repr(float(v)) for v in row), *rest, *(column[i] for column in further)])
    return stream.getvalue()


def _further(cells: list[str]) -> Column:
    """A further column: whole numbers, numbers, or text where any word is none."""
    try:
        whole = np.array([int(word) for word in cells], np.int64)
        if [str(number) for number in whole.tolist()] == cells:
            return whole
    except (ValueError, OverflowError):
        pass
    try:
        numbers = np.array([float(word) for word in cells])
    except ValueError:
        return np.array(cells)
    return numbers if np.isfinite(numbers).all() else np.array(cells)


def _cells(column: Column) -> list[str]:
    """The cells of a further column, every number with the digits that give it back."""
    if column.dtype.kind == "f":
        return [repr(number).removesuffix(".0") for number in column.tolist()]
    return [str(value) for value in column.tolist()]


def _columns(file: File, rows: list[checks.CsvRow]) -> tuple[list[int], dict[str, list[str]]]:
    """Line numbers of the checkpoints, and the cells of each column."""
    contents = f"a header {','.join(PATH_HEADER)} and 2 checkpoints or more"
    lines, cells = checks.csv_columns(file, rows, contents, partial(_check_header, file))
    if len(lines) < 2:
        raise InputError(file, "checkpoints", len(lines), "2 or more")
    return lines, cells


def _check_header(file: File, header: Sequence[str]) -> None:
    if len(header) == 1 and ";" in header[0]:
        raise InputError(file, "header", header[0], "names with commas between them, not semicolons")
    for i, name in enumerate(header):
        if not name or name in header[:i]:
            raise InputError(file, f"header, column {i + 1}", name, "a name, and each once")
        if name in (*PATH_HEADER, *SPEED_COLUMNS):
            continue
        if (stem := name.split("_")[0]) in COLUMN_STEMS:
            raise InputError(file, f"header, column {i + 1}", name, f"{COLUMN_STEMS[stem]}, in this unit")
        if difflib.get_close_matches(name, PATH_HEADER, 1):
            raise InputError(file, f"header, column {i + 1}", name, checks.one_of_text(name, PATH_HEADER))
    for name in (*POSE_COLUMNS, *PRINT_COLUMNS):
        if name not in header:
            raise InputError(file, "header", f"no {name}", ",".join(PATH_HEADER))
    if sum(name in header for name in SPEED_COLUMNS) != 1:
        raise InputError(file, "header", ",".join(header), f"one of {', '.join(SPEED_COLUMNS)}")


def _ints(file: File, lines: Sequence[int], name: str, cells: Sequence[str], flags: bool = False) -> NDArray[np.int64]:
    for line, word in zip(lines, cells, strict=True):
        is_integer = word.removeprefix("-").isdecimal() and word.isascii() and len(word) < 19
        if not is_integer or (flags and int(word) not in (0, 1)):
            raise InputError(file, f"line {line}: {name}", word, "0 or 1" if flags else "a whole number")
    return np.array([int(word) for word in cells], np.int64)


def _material(file: File, lines: Sequence[int], cells: Sequence[str]) -> NDArray[np.int64] | NDArray[np.str_]:
    """Whole numbers where all are, else names."""
    if "" in cells:
        raise InputError(file, f"line {lines[cells.index('')]}: material", "", "a name or a whole number")
    if all(word.isascii() and word.isdecimal() and len(word) < 19 and str(int(word)) == word for word in cells):
        return np.array([int(word) for word in cells], np.int64)
    return np.array(cells)


GCODE_HEADER = """; stillbed: {count} checkpoints, {layers} layers, {length:.1f} mm
; X Y Z mm and A B C degrees: the nozzle in the frame of the scan, R = Rz(C) Ry(B) Rx(A); F mm/min
; E mm^3 laid so far; T and M104 are told where they change; a surface that moves needs stillbed, not this file
G21 ; mm
G90 ; places are absolute
M82 ; so is E
G92 E0
"""


def gcode_text(path: Path) -> str:
    """The path as G-code: G0 without ink, G1 where ink flows, G4 for waits, a comment for each layer."""
    places = path.surface_from_nozzle[:, :3, 3]
    angles = np.rad2deg(se3.euler_from_rotation(path.surface_from_nozzle[:, :3, :3])) + 0.0
    columns = {name: path.extra[name].astype(float) for name in ("volume_mm3", "wait_s") if name in path.extra}
    volume = np.cumsum(columns.get("volume_mm3", np.zeros(len(path))))
    wait = columns.get("wait_s", np.zeros(len(path)))
    length = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    lines = [GCODE_HEADER.format(count=len(path), layers=len(np.unique(path.layer)), length=length)]
    names = list(dict.fromkeys(path.material.tolist()))
    for i in range(len(path)):
        lines += _changes(path, i, names)
        (x, y, z), (a, b, c) = places[i], angles[i]
        if wait[i] > 0:
            lines.append(f"G4 P{1000 * wait[i]:.0f}\n")
        end = f" E{volume[i]:.4f}\n" if path.extrude[i] else "\n"
        line = f"G{int(path.extrude[i])} X{x:.3f} Y{y:.3f} Z{z:.3f} A{a:.3f} B{b:.3f} C{c:.3f}"
        lines.append(f"{line} F{60 * path.speed[i]:.0f}{end}")
    return "".join([*lines, "M2\n"])


def _changes(path: Path, i: int, names: list[object]) -> list[str]:
    """The lines for a layer, a material or a temperature that begins at checkpoint i."""
    first, before = i == 0, max(i - 1, 0)
    lines = []
    if first or path.layer[i] != path.layer[before]:
        lines.append(f"; layer {path.layer[i]}\n")
    if first or path.material[i] != path.material[before]:
        lines.append(f"T{names.index(path.material[i])} ; material {path.material[i]}\n")
    if first or path.temperature[i] != path.temperature[before]:
        lines.append(f"M104 S{path.temperature[i]:g} ; degrees C\n")
    return lines


CONTOUR_COLUMNS = ("x_mm", "y_mm", "z_mm")


def read_contour(file: str | File) -> Array:
    """Points (N, 2) or (N, 3), mm, in order around a contour, the first not repeated at the end; N >= 3."""
    file = File(file)
    allowed = "x_mm,y_mm or x_mm,y_mm,z_mm"

    def check(header: list[str]) -> None:
        if tuple(header) not in (CONTOUR_COLUMNS[:2], CONTOUR_COLUMNS):
            raise InputError(file, "header", ",".join(header), allowed)

    contents = f"a header {allowed} and 3 points or more"
    lines, cells = checks.csv_columns(file, checks.read_csv(file), contents, check)
    points = np.stack([checks.csv_numbers(file, lines, *column) for column in cells.items()], axis=1)
    if len(points):
        points = points[np.r_[True, (np.diff(points, axis=0) != 0).any(axis=1)]]  # no point twice in a row
    if len(points) > 1 and np.array_equal(points[0], points[-1]):
        points = points[:-1]
    if len(points) < 3:
        raise InputError(file, "points", len(points), "3 or more, each at another place")
    return points


KEYS = ("path", "fraction", "printed")


class ProgressFile:
    """Keeps progress.toml up to date, tick by tick; the file is whole at every instant, however the run ends."""

    def __init__(self, file: File, path: Path) -> None:
        self._file, self._path = file, fingerprint(path)
        self._fraction = -1.0

    def write(self, progress: PrintProgress) -> None:
        """Write how far the print is, if that has changed."""
        if progress.fraction != self._fraction:
            self._fraction = progress.fraction
            _replace(self._file, ProgressMark(self._path, progress.fraction), progress.printed)


def write_progress_durably(file: File, fingerprint: str, fraction: float) -> None:
    """Write how far a print is and wait for the disk, so that it outlives a power cut as well."""
    _replace(file, ProgressMark(fingerprint, fraction), math.floor(fraction), durable=True)


def read_progress(file: File, path: Path) -> float:
    """Where a print of `path` continues, counted in checkpoints; InputError if the file is of another path or wrong."""
    table = checks.read_toml(file)
    checks.check_keys(file, "", table, KEYS)
    mark = ProgressMark(checks.text(file, "path", table["path"]), checks.number(file, "fraction", table["fraction"]))
    return resume_fraction(path, mark, file)


def _replace(file: File, mark: ProgressMark, printed: int, durable: bool = False) -> None:
    """Write beside the file and rename, so that a whole file is there always. durable: wait for the disk.

    Without a `Path` of the new name: it would be interned each time, and Python's table of such names grows by 2 MB
    in one step after some 15,000 writes.
    """
    text = f'path = "{mark.path}"\nfraction = {checks.toml_value(mark.fraction)}\nprinted = {printed}\n'
    temporary = f"{file}.new"
    with open(temporary, "w", encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        if durable:
            os.fsync(stream.fileno())
    os.replace(temporary, file)


class ProgressWriter:
    """Writes progress.toml in a thread whenever the place has changed, as the disk may take its time.

    failed: the error of the disk, or what ended the thread; "" if there is none.
    """

    def __init__(self, file: File, fingerprint: str, place: c_double) -> None:
        """fingerprint: of the path; "" for a dry run, of which no place is kept. place: on the path, in checkpoints."""
        self.failed = ""
        self._file, self._fingerprint, self._place = file, fingerprint, place
        self._written_fraction = math.nan
        self._close_event = threading.Event()
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Write the last place, and end."""
        self._close_event.set()
        self._thread.join()

    def _keep(self) -> None:
        try:
            while not self._close_event.wait(PROGRESS_PERIOD):
                self._write()
            self._write()
        except Exception as error:  # whatever ends this thread ends the run
            self.failed = f"{self._file}: {type(error).__name__}: {error}"

    def _write(self) -> None:
        fraction = self._place.value
        if not self._fingerprint or math.isnan(fraction) or fraction == self._written_fraction:
            return
        try:
            write_progress_durably(self._file, self._fingerprint, fraction)
            self._written_fraction, self.failed = fraction, ""
        except OSError as error:
            self.failed = f"{self._file}: {error.strerror or error}"


def tissue_text(tissue: TissueGuard) -> str:
    """What a run keeps its tool out of, as JSON for its recording: arrays as base64 of their compressed bytes."""
    parts = {"balls": tissue.body.balls, "groups": tissue.body.groups, "body": tissue.body, "envelope": tissue.envelope}
    return json.dumps({name: _packed(part) for name, part in parts.items()})


def tissue_from_text(text: str, where: object) -> TissueGuard:
    """The same again, to the bit; InputError where the text is damaged."""
    try:
        tables = {name: _unpacked(table) for name, table in json.loads(text).items()}
        balls, groups = Balls(**tables["balls"]), Balls(**tables["groups"])
        body = ToolBody(balls=balls, groups=groups, **(tables["body"] | {"names": tuple(tables["body"]["names"])}))
        return TissueGuard(body, Envelope(**tables["envelope"]))
    except (ValueError, TypeError, KeyError, AttributeError, zlib.error) as error:
        raise InputError(where, "tissue", checks.error_text(error), "what a live run wrote") from None


def _packed(part: object) -> dict[str, object]:
    """The fields of a record but for further records in it."""
    values = {name: getattr(part, name) for name in getattr(part, "__slots__")}  # noqa: B009
    arrays = {
        name: [value.dtype.str, value.shape, base64.b64encode(zlib.compress(value.tobytes(), 1)).decode("ascii")]
        for name, value in values.items()
        if isinstance(value, np.ndarray)
    }
    return arrays | {name: value for name, value in values.items() if isinstance(value, float | tuple)}


def _unpacked(table: dict[str, object]) -> dict[str, Any]:
    def value(packed: Any) -> Any:
        if not isinstance(packed, list) or len(packed) != 3 or not isinstance(packed[1], list):
            return packed
        kind, shape, data = packed
        return np.frombuffer(zlib.decompress(base64.b64decode(data)), np.dtype(kind)).reshape(shape).copy()

    return {name: value(packed) for name, packed in table.items()}
