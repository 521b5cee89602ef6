"""nozzle.csv: where the nozzle was and should have been, a row a millisecond, written as the run goes and read back.

x_mm y_mm z_mm is the nozzle's tip in base, target_ the same of what was due, error_x_mm error_y_mm error_z_mm the
first less the second in the surface frame. What is not known is an empty cell. Every call's rows are flushed together,
so a killed run leaves whole lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path as File
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process import checks
from hardware.simulator.nozzle_error import NozzleErrors, nozzle_errors
from hardware.simulator.nozzle_log import NozzleLog
from hardware.simulator.planned_line import PlannedLine

_NOZZLE = ("x_mm", "y_mm", "z_mm")
_TARGET = ("target_x_mm", "target_y_mm", "target_z_mm")
_ERROR = ("error_mm", "error_x_mm", "error_y_mm", "error_z_mm", "angle_deg", "path_error_mm")
HEADER = ("stamp_s", "extrude", *_NOZZLE, *_TARGET, *_ERROR, "place_mm", "checkpoint", "reason")
_ROW = "%.6f,%d" + ",%.6f" * 13 + ",%d,"


@dataclass(frozen=True, slots=True, eq=False)
class NozzleTable:
    """nozzle.csv as parallel arrays of N rows; NaN, and checkpoint -1, where there was no target.

    stamps: (N,) s. extrude: (N,). nozzle, target: (N, 3) mm in base. distance: (N,) mm, length of vector (N, 3) mm in
    the surface frame. angle: (N,) rad. path: (N,) mm from the printed line. place: (N,) mm. checkpoint: (N,). reason:
    (N,) why the arm holds, "" while it moves.
    """

    stamps: Array
    extrude: NDArray[np.bool_]
    nozzle: Array
    target: Array
    distance: Array
    vector: Array
    angle: Array
    path: Array
    place: Array
    checkpoint: NDArray[np.int64]
    reason: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.stamps)


class NozzleWriter:
    """Writes nozzle.csv, some rows at a time; closes it as a context manager."""

    def __init__(self, file: File, line: PlannedLine) -> None:
        self._file = file.open("w", newline="", encoding="utf-8")
        self._file.write(",".join(HEADER) + "\n")
        self._line = line

    def write(self, log: NozzleLog) -> None:
        """The rows that came since the last call."""
        rows = _numbers(log, nozzle_errors(log, self._line)).tolist()
        reasons = {word: _quoted(word) for word in np.unique(log.reason).tolist()}
        for row, word in zip(rows, log.reason.tolist(), strict=True):
            self._file.write((_ROW % tuple(row)).replace("nan", "") + reasons[word])
        self._file.flush()

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._file.close()

    def __enter__(self) -> NozzleWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


def _numbers(log: NozzleLog, errors: NozzleErrors) -> Array:
    """The numeric cells (N, 16), in the order of the header."""
    nozzle, target = log.base_from_nozzle[:, :3, 3], log.base_from_target[:, :3, 3]
    error = [errors.distance, errors.vector, np.degrees(errors.angle), errors.path]
    return np.column_stack([log.stamps, log.extrude, nozzle, target, *error, log.place, log.checkpoint])


def _quoted(word: str) -> str:
    """A last cell and its end of line, as csv.writer writes them; a line break becomes a blank."""
    text = " ".join(word.split("\n"))
    return ('"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\r') else text) + "\n"


def read_nozzle(file: File) -> NozzleTable:
    """The table that a NozzleWriter wrote to `file`; a last line cut short by a kill is left out.

    Raises InputError naming file, line and column for anything else that NozzleWriter would not have written.
    """
    rows = [row for _, row in checks.read_csv(file, "a nozzle.csv of stillbed simulate")]
    if not rows or tuple(rows[0]) != HEADER:
        raise InputError(file, "header", ",".join(rows[0][:4]) if rows else "", ",".join(HEADER))
    body = rows[1:]
    if body and len(body[-1]) != len(HEADER):
        body = body[:-1]
    for number, row in enumerate(body, start=2):
        if len(row) != len(HEADER):
            raise InputError(file, f"line {number}", f"{len(row)} columns", f"{len(HEADER)} columns")
    return _table(_floats(file, body), np.array([row[-1] for row in body], np.str_))


def _table(numbers: Array, reason: NDArray[np.str_]) -> NozzleTable:
    stamps, extrude, nozzle, target, distance, vector, angle, path, place, checkpoint = np.split(
        numbers, np.cumsum([1, 1, 3, 3, 1, 3, 1, 1, 1]), axis=1
    )
    return NozzleTable(
        stamps=stamps[:, 0],
        extrude=extrude[:, 0] == 1,
        nozzle=nozzle,
        target=target,
        distance=distance[:, 0],
        vector=vector,
        angle=np.radians(angle[:, 0]),
        path=path[:, 0],
        place=place[:, 0],
        checkpoint=checkpoint[:, 0].astype(np.int64),
        reason=reason,
    )


def _floats(file: File, body: list[list[str]]) -> Array:
    """The numeric cells (N, 16), NaN for an empty one."""
    out = np.empty((len(body), len(HEADER) - 1))
    for i, row in enumerate(body):
        try:
            out[i] = [float(cell or "nan") for cell in row[:-1]]
        except ValueError:
            raise _fault(file, i + 2, row) from None
        if np.isnan(out[i, [0, 1, -1]]).any():
            raise InputError(file, f"line {i + 2}", ",".join(row[:2]), "a number for stamp_s, extrude and checkpoint")
    return out


def _fault(file: File, line: int, row: list[str]) -> InputError:
    for name, cell in zip(HEADER, row, strict=True):
        try:
            float(cell or "nan")
        except ValueError:
            return InputError(file, f"line {line}: {name}", cell, "a number, or nothing")
    raise AssertionError("every cell is a number")
