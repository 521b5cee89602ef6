"""The tables of a session folder: TUM trajectories, frames.csv, head.csv, roi.toml; and the writer of such folders.

A TUM file has one `stamp x y z qx qy qz qw` a line, s and mm: base_from_surface. frames.csv has the stamp of every
image, head.csv the print head at each frame set, roi.toml polygons around the surface.
"""

from __future__ import annotations

import csv
import glob
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.pose import Trajectory
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.files.rig_file import ImageSource, write_rig
from hardware.files.session import NO_PRINT_HEADS, FrameRef, PrintHeadLog
from hardware.process import checks
from hardware.process.system import provenance
from perception.frames import Roi

TUM_HEADER = "# stamp_s x y z qx qy qz qw (mm, base_from_surface)\n"
TUM_ROW = "8 numbers: stamp x y z qx qy qz qw"


def read_tum(path: str | Path, exact: bool) -> Trajectory:
    """The trajectory in a TUM file (s, mm); InputError names the line that is wrong."""
    return trajectory_from_rows(read_rows(path), exact)


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory as a TUM file, every number with the digits that give the same float64 back."""
    write_rows(path, rows_from_trajectory(trajectory))


def trajectory_from_rows(rows: Array, exact: bool) -> Trajectory:
    """Poses from rows (N, 8) of stamp x y z qx qy qz qw, s and mm."""
    return Trajectory(rows[:, 0], se3.make(se3.rotation_from_quaternion(rows[:, 4:]), rows[:, 1:4]), exact)


def rows_from_trajectory(trajectory: Trajectory) -> Array:
    """Rows (N, 8) of stamp x y z qx qy qz qw, s and mm."""
    transforms = trajectory.base_from_surface
    quaternions = se3.quaternion_from_rotation(transforms[:, :3, :3])
    return np.concatenate([trajectory.stamps[:, None], transforms[:, :3, 3], quaternions], axis=1)


def write_rows(path: str | Path, rows: Array) -> None:
    """Write rows (N, 8) of stamp x y z qx qy qz qw as a TUM file, shortest digits that round-trip."""
    with open(path, "w", encoding="utf-8") as file:
        file.write(TUM_HEADER)
        file.writelines(" ".join(repr(float(v)) for v in row) + "\n" for row in rows)


def read_rows(path: str | Path) -> Array:
    """Rows (N, 8) of a TUM file, N >= 1: finite, stamps rising, quaternions of unit length to 1 %."""
    path = Path(path)
    lines = ((f"line {number}", line.replace(",", " ").split()) for number, line in _lines(path))
    rows = checked_rows(path, ((what, row_from_words(path, what, cells)) for what, cells in lines))
    if not len(rows):
        raise InputError(path, "poses", "none", "at least one line `stamp x y z qx qy qz qw`")
    return rows


def checked_rows(where: object, rows: Iterable[tuple[str, Sequence[float]]]) -> Array:
    """Rows (N, 8) of stamp x y z qx qy qz qw, N >= 0, from rows with their names in error messages, such as "line 3".

    InputError (where, name) unless they are finite, stamps rise and quaternions are of unit length to 1 %.
    """
    checked: list[Sequence[float]] = []
    for what, row in rows:
        if len(row) != 8:
            raise InputError(where, what, f"{len(row)} numbers", TUM_ROW)
        if not all(map(math.isfinite, row)):
            raise InputError(where, what, " ".join(map(str, row)), "finite numbers")
        norm = math.hypot(*row[4:])
        if not 0.99 < norm < 1.01:
            raise InputError(where, f"{what}: length of qx qy qz qw", norm, "1 +- 0.01 (a unit quaternion)")
        if checked and row[0] <= checked[-1][0]:
            raise InputError(where, f"{what}: stamp", row[0], f"later than the one before, {checked[-1][0]} s")
        checked.append(row)
    return np.array(checked, float).reshape(-1, 8)


def row_from_words(where: object, what: str, cells: Sequence[str], allowed: str = TUM_ROW) -> list[float]:
    """The numbers in `cells`; InputError (where, what, with `allowed`) unless they are numbers."""
    try:
        return [float(word) for word in cells]
    except ValueError:
        raise InputError(where, what, " ".join(cells), allowed) from None


def _lines(path: Path) -> list[tuple[int, str]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "file", checks.error_text(error), "a readable text file") from error
    numbered = ((i, line.strip()) for i, line in enumerate(text.splitlines(), 1))
    return [(i, line) for i, line in numbered if line and not line.startswith("#")]


@contextmanager
def csv_table(file: Path, columns: Sequence[str]) -> Iterator[Callable[[Iterable[object]], None]]:
    """Gives what writes a row of a new CSV file, below its header; each row is in the file when the call returns."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream, lineterminator="\n")

        def write(row: Iterable[object]) -> None:
            table.writerow(row)
            stream.flush()

        write(columns)
        yield write


FRAME_COLUMNS = ("camera", "frame", "stamp_s")
HEAD_COLUMNS = ("stamp_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw", "extruding")


def read_frames(path: Path, rig: Rig) -> list[Array]:
    """Stamps (N,), s, of each camera's frames 0..N-1 as its own clock gave them: finite, rising, none left out."""
    names = [c.name for c in rig.cameras]
    numbered: list[dict[int, float]] = [{} for _ in names]
    for line, cells in _rows(path, FRAME_COLUMNS):
        camera, frame, stamp = _frame_row(path, line, cells, names)
        if frame in numbered[camera]:
            raise InputError(path, f"line {line}: camera,frame", f"{names[camera]},{frame}", "each frame once")
        numbered[camera][frame] = stamp
    stamps = [_camera_stamps(path, name, frames) for name, frames in zip(names, numbered, strict=True)]
    if not any(len(s) for s in stamps):
        raise InputError(path, "frames", "none", f"at least one line {','.join(FRAME_COLUMNS)}")
    return stamps


def _rows(path: Path, columns: Sequence[str]) -> list[tuple[int, list[str]]]:
    """Line number and the cells of these columns of each row; what a short row lacks is empty."""
    (_, first), *body = checks.read_csv(path) or [(1, [])]
    header = [name.strip() for name in first]
    for column in columns:
        if column not in header:
            raise InputError(path, "header", ",".join(header) or "empty", ",".join(columns))
    by_name = ((line, dict(zip(header, cells, strict=False))) for line, cells in body if cells)
    return [(line, [row.get(column, "").strip() for column in columns]) for line, row in by_name]


def _frame_row(path: Path, line: int, cells: list[str], names: Sequence[str]) -> tuple[int, int, float]:
    name, frame, stamp = cells
    if name not in names:
        raise InputError(path, f"line {line}: camera", name, f"a camera of rig.toml, {checks.one_of_text(name, names)}")
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
        file.write(",".join(FRAME_COLUMNS) + "\n")
        file.writelines(frame_line(rig, ref) for ref in sorted(refs, key=lambda r: (r.camera, r.number)))


def frame_line(rig: Rig, ref: FrameRef) -> str:
    """One line of frames.csv."""
    return f"{rig.cameras[ref.camera].name},{ref.number},{ref.camera_stamp!r}\n"


def read_heads(path: Path) -> PrintHeadLog:
    """The print heads of head.csv, base_from_nozzle; none is allowed, as where a run ended before the arm moved."""
    table = [(f"line {line}", cells) for line, cells in _rows(path, HEAD_COLUMNS)]
    rows = checked_rows(path, ((line, row_from_words(path, line, cells[:-1])) for line, cells in table))
    for line, cells in table:
        if cells[-1] not in ("0", "1"):
            raise InputError(path, f"{line}: extruding", cells[-1], "0 or 1")
    return PrintHeadLog(rows, np.array([cells[-1] == "1" for _, cells in table], bool))


def write_heads(path: Path, heads: PrintHeadLog) -> None:
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
    keys = [(r.camera, r.stamp) for r in rois]
    for i, key in enumerate(keys):
        if key in keys[:i]:
            got = f"{entries[i]['camera']}, frame {entries[i]['frame']}"
            raise InputError(path, f"roi[{i}]", got, "each frame once")
    return tuple(rois)


def _roi(path: Path, key: str, entry: checks.Table, rig: Rig, stamps: Sequence[Array]) -> Roi:
    checks.check_keys(path, key, entry, ["camera", "frame", "polygon"])
    name = checks.text(path, key + "camera", entry["camera"])
    names = [c.name for c in rig.cameras]
    if name not in names:
        raise InputError(path, key + "camera", name, f"a camera of rig.toml, {checks.one_of_text(name, names)}")
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
        polygon = checks.toml_value(roi.polygon)
        blocks.append(f"[[roi]]\ncamera = {name}\nframe = {frame}\npolygon = {polygon}\n")
    path.write_text("\n".join(blocks), encoding="utf-8")


PICTURE_SUFFIXES = {"png": ".png", "jpeg": ".jpg"}


RECORDED_FILE = "recorded.toml"


def write_recorded(folder: Path, began: int | None) -> None:
    """recorded.toml: when a session was recorded, and by what. began: UTC at stamp 0, ns since 1970."""
    table = provenance().texts() | ({} if began is None else {"began_utc_ns": str(began)})
    lines = [f"{json.dumps(key)} = {json.dumps(value, ensure_ascii=False)}" for key, value in table.items()]
    (folder / RECORDED_FILE).write_text("\n".join([*lines, ""]), encoding="utf-8")


def read_recorded(folder: Path) -> int | None:
    """UTC at stamp 0, ns since 1970, by recorded.toml; None without it. InputError where it is none."""
    file = folder / RECORDED_FILE
    if not file.exists():
        return None
    began = checks.read_toml(file).get("began_utc_ns")
    if began is None:
        return None
    if not isinstance(began, str) or not began.removeprefix("-").isdecimal():
        raise InputError(file, "began_utc_ns", began, 'whole ns since 1970 in quotes, as "1764150000000000000"')
    return int(began)


class SessionFolderWriter(ExitStack):
    """Writes a session folder: readable after every picture, and once the context has ended, also by an interrupt."""

    def __init__(self, folder: Path, rig: Rig, rois: Sequence[Roi], began: int | None = None) -> None:
        """folder: made if it is not there. rois: where the surface is in the first picture of each camera.

        began: UTC at stamp 0, ns since 1970.
        """
        super().__init__()
        self.folder, self._rig = folder, rig
        self._counts = [0] * len(rig)
        self._heads: TextIO | None = None  # a session without an arm has no such file
        for camera in rig.cameras:
            (folder / camera.name).mkdir(parents=True, exist_ok=True)
        write_rig(folder / "rig.toml", rig, [ImageSource("images", f"{glob.escape(c.name)}/*") for c in rig.cameras])
        if rois:
            write_roi(folder / "roi.toml", rig, rois, [0] * len(rois))
        write_frames(folder / "frames.csv", rig, [])
        write_recorded(folder, began)
        self.callback(self._remove_unlisted)
        self._frames = self.enter_context((folder / "frames.csv").open("a", encoding="utf-8"))

    def picture(self, camera: int, stamp: float, kind: str, data: bytes) -> None:
        """An encoded picture ("png" or "jpeg") of a camera at `stamp`, s; stamps of a camera rise."""
        number, name = self._counts[camera], self._rig.cameras[camera].name
        (self.folder / name / f"{number:06d}{PICTURE_SUFFIXES[kind]}").write_bytes(data)
        self._frames.write(frame_line(self._rig, FrameRef(camera, number, stamp, stamp)))
        self._frames.flush()
        self._counts[camera] += 1

    def _remove_unlisted(self) -> None:
        """Remove the picture that an interrupt left without its line in frames.csv."""
        lines = (self.folder / "frames.csv").read_text(encoding="utf-8").splitlines()
        listed = Counter(line.split(",")[0] for line in lines[1:])
        for camera in self._rig.cameras:
            for suffix in PICTURE_SUFFIXES.values():
                (self.folder / camera.name / f"{listed[camera.name]:06d}{suffix}").unlink(missing_ok=True)

    def head_row(self, row: Array, extruding: bool) -> None:
        """Where the print head was at a frame set: (8,) stamp x y z qx qy qz qw, s and mm; stamps rise."""
        if self._heads is None:
            write_heads(self.folder / "head.csv", NO_PRINT_HEADS)
            self._heads = self.enter_context((self.folder / "head.csv").open("a", encoding="utf-8"))
        self._heads.write(head_line(row, extruding))
        self._heads.flush()

    def truth(self, trajectory: Trajectory) -> None:
        """The exact poses, written when the folder is closed."""
        self.callback(write_tum, self.folder / "truth.tum", trajectory)
