"""The small tables of a session folder: frames.csv (stamps), head.csv (the print head), roi.toml (the surface)."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.files.session import FrameRef
from hardware.heads import Heads
from hardware.process import checks
from hardware.tum import checked_rows, row_from_words
from perception.frames import Roi

COLUMNS = ("camera", "frame", "stamp_s")
HEAD_COLUMNS = ("stamp_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw", "extruding")


def read_frames(path: Path, rig: Rig) -> list[Array]:
    """Stamps (N,), s, of each camera's frames 0..N-1 as its own clock gave them: finite, rising, none left out."""
    names = [c.name for c in rig.cameras]
    found: list[dict[int, float]] = [{} for _ in names]
    for line, row in _rows(path, COLUMNS):
        camera, frame, stamp = _frame_row(path, line, row, names)
        if frame in found[camera]:
            raise InputError(path, f"line {line}: camera,frame", f"{names[camera]},{frame}", "each frame once")
        found[camera][frame] = stamp
    stamps = [_camera_stamps(path, name, frames) for name, frames in zip(names, found, strict=True)]
    if not any(len(s) for s in stamps):
        raise InputError(path, "frames", "none", f"at least one line {','.join(COLUMNS)}")
    return stamps


def _rows(path: Path, columns: Sequence[str]) -> list[tuple[int, dict[str, str | None]]]:
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            header = [name.strip() for name in reader.fieldnames or []]
            reader.fieldnames = header
            rows = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, "file", checks.why(error), "a readable CSV file") from error
    for column in columns:
        if column not in header:
            raise InputError(path, "header", ",".join(header) or "empty", ",".join(columns))
    return rows


def _frame_row(path: Path, line: int, row: dict[str, str | None], names: Sequence[str]) -> tuple[int, int, float]:
    name, frame, stamp = ((row[c] or "").strip() for c in COLUMNS)
    if name not in names:
        raise InputError(path, f"line {line}: camera", name, f"a camera of rig.toml, {checks.meant(name, names)}")
    if not (frame.isascii() and frame.isdigit() and len(frame) < 10):
        raise InputError(path, f"line {line}: frame", frame, "a whole number >= 0")
    try:
        value = float(stamp)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(path, f"line {line}: stamp_s", stamp, "a finite number of seconds")
    return names.index(name), int(frame), value


def _camera_stamps(path: Path, name: str, frames: dict[int, float]) -> Array:
    for number, frame in enumerate(sorted(frames)):
        if frame != number:
            raise InputError(path, f"camera {name!r}: frame", f"{frame} after {number - 1}", "every frame from 0 on")
    stamps = np.array([frames[i] for i in range(len(frames))], float)
    back = np.flatnonzero(np.diff(stamps) <= 0)
    if len(back):
        i = int(back[0]) + 1
        allowed = f"later than frame {i - 1}, {stamps[i - 1]:g} s"
        raise InputError(path, f"camera {name!r}: stamp_s of frame {i}", float(stamps[i]), allowed)
    return stamps


def write_frames(path: Path, rig: Rig, refs: Iterable[FrameRef]) -> None:
    """Write frames.csv, camera by camera, every stamp with the digits that give the same float64 back."""
    with open(path, "w", encoding="utf-8") as file:
        file.write(",".join(COLUMNS) + "\n")
        for ref in sorted(refs, key=lambda r: (r.camera, r.number)):
            file.write(frame_line(rig, ref))


def frame_line(rig: Rig, ref: FrameRef) -> str:
    """One line of frames.csv."""
    return f"{rig.cameras[ref.camera].name},{ref.number},{ref.camera_stamp!r}\n"


def read_heads(path: Path) -> Heads:
    """The print heads of head.csv, base_from_nozzle; none is allowed, as where a run ended before the arm moved."""
    found = _rows(path, HEAD_COLUMNS)
    table = [(f"line {line}", [(row[c] or "").strip() for c in HEAD_COLUMNS]) for line, row in found]
    rows = checked_rows(path, ((line, row_from_words(path, line, words[:-1])) for line, words in table))
    return Heads(rows, np.array([_extruding(path, line, words[-1]) for line, words in table], bool))


def _extruding(path: Path, line: str, word: str) -> bool:
    if word not in ("0", "1"):
        raise InputError(path, f"{line}: extruding", word, "0 or 1")
    return word == "1"


def write_heads(path: Path, heads: Heads) -> None:
    """Write head.csv, every number with the digits that give the same float64 back."""
    with open(path, "w", encoding="utf-8") as file:
        file.write(",".join(HEAD_COLUMNS) + "\n")
        file.writelines(head_line(row, bool(flag)) for row, flag in zip(heads.rows, heads.extruding, strict=True))


def head_line(row: Array, extruding: bool) -> str:
    """One line of head.csv; row: (8,) stamp x y z qx qy qz qw, s and mm."""
    return ",".join(repr(float(value)) for value in row) + f",{int(extruding)}\n"


def read_roi(path: Path, rig: Rig, stamps: Sequence[Array]) -> tuple[Roi, ...]:
    """The polygons of roi.toml; stamps: (N,) per camera, s, of its frames on the common clock."""
    table = checks.read_toml(path)
    checks.check_keys(path, "", table, ["roi"])
    entries = checks.tables(path, "roi", table["roi"])
    rois = [_roi(path, f"roi[{i}].", entry, rig, stamps) for i, entry in enumerate(entries)]
    seen = [(r.camera, r.stamp) for r in rois]
    for i, key in enumerate(seen):
        if key in seen[:i]:
            got = f"{entries[i]['camera']}, frame {entries[i]['frame']}"
            raise InputError(path, f"roi[{i}]", got, "each frame once")
    return tuple(rois)


def _roi(path: Path, key: str, entry: checks.Table, rig: Rig, stamps: Sequence[Array]) -> Roi:
    checks.check_keys(path, key, entry, ["camera", "frame", "polygon"])
    name = checks.text(path, key + "camera", entry["camera"])
    names = [c.name for c in rig.cameras]
    if name not in names:
        raise InputError(path, key + "camera", name, f"a camera of rig.toml, {checks.meant(name, names)}")
    camera = names.index(name)
    frame = checks.integer(path, key + "frame", entry["frame"], 0)
    if frame >= len(stamps[camera]):
        raise InputError(path, key + "frame", frame, f"a frame of {name!r} in frames.csv, 0..{len(stamps[camera]) - 1}")
    polygon = checks.numbers(path, key + "polygon", entry["polygon"], (None, 2), "px")
    check_polygon(path, key + "polygon", polygon, rig.cameras[camera].size)
    return Roi(camera, float(stamps[camera][frame]), polygon)


def check_polygon(where: object, key: str, polygon: Array, size: tuple[int, int]) -> None:
    """InputError unless the polygon (N, 2), px, has three corners, an area, and a part of its box in the image."""
    if not np.isfinite(polygon).all():
        raise InputError(where, key, polygon.tolist(), "finite numbers, px")
    if len(polygon) < 3:
        raise InputError(where, key, f"{len(polygon)} points", "3 points or more, px")
    x, y = (polygon - polygon[0]).T
    if abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2 < 1:
        raise InputError(where, key, polygon.tolist(), "a polygon of at least 1 px^2, not a line")
    if (polygon.max(axis=0) < 0).any() or (polygon.min(axis=0) > size).any():
        allowed = f"a polygon that reaches into the image, {size[0]} x {size[1]} px"
        raise InputError(where, key, polygon.tolist(), allowed)


def write_roi(path: Path, rig: Rig, rois: Sequence[Roi], frames: Sequence[int]) -> None:
    """Write roi.toml; frames: the number, in its camera, of the frame that each polygon was drawn in."""
    blocks = ["# where the surface is: per camera a polygon in pixels of that frame\n"]
    for roi, frame in zip(rois, frames, strict=True):
        name = json.dumps(rig.cameras[roi.camera].name, ensure_ascii=False)
        polygon = checks.toml_numbers(roi.polygon)
        blocks.append(f"[[roi]]\ncamera = {name}\nframe = {frame}\npolygon = {polygon}\n")
    path.write_text("\n".join(blocks), encoding="utf-8")
