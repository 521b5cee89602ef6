"""`stillbed segment`: a PNG mask for each picture, frame of a video or picture of a session, and a table of all.

Of a session, whose cameras are calibrated, also the wound's area in mm^2 with a 95 % interval.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from estimation.errors import InputError
from hardware.files.folder_tables import csv_table
from hardware.files.images import Video, decode, encode
from hardware.files.session import Session
from hardware.process.checks import read_bytes, read_csv
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, check_apart, count_text, prepare_out
from hardware.recording.session_reader import open_session
from perception.frames import Image, mean_stamp
from perception.tracking.wound_area import WoundArea, wound_area
from perception.wound.segmentation import (
    NetworkSegmenter,
    Segmentation,
    Segmenter,
    WoundBand,
    box_of,
    centroid,
    draw_overlay,
)

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg")
RECORDING_SUFFIXES = (".mcap",)
INPUT_SUFFIXES = PICTURE_SUFFIXES + VIDEO_SUFFIXES + RECORDING_SUFFIXES
SESSION_FILES = ("rig.toml", "frames.csv")  # a folder with both is a session
WOUND_TABLE, AREA_TABLE = "wounds.csv", "areas.csv"
MEASURED_SETS = 9  # of a session, evenly over it, of which areas are measured: each takes seconds
OVERLAY_FOLDER = "overlays"  # folder of the pictures with outlines
OVERLAY_QUALITY = 90  # of JPEG
WOUND_COLUMNS = (
    "name", "wound", "confidence", "threshold", "area_px", "area_mm2", "centroid_x_px", "centroid_y_px",
    "x0_px", "y0_px", "x1_px", "y1_px", "ms",
)  # fmt: skip
AREA_COLUMNS = ("session", "stamp_s", "cameras", "area_mm2", "low_mm2", "high_mm2", "reason")
UNCALIBRATED = "pictures alone have no scale; a session folder or a recording has calibrated cameras"
NO_BAND = "outlines by shape have no probabilities of which an interval could be made"


@dataclass(frozen=True, slots=True, eq=False)
class SegmentOptions:
    """What is written, and where."""

    overlay: bool = False  # pictures with outlines as well
    mm_per_px: float | None = None  # in the wound's plane; None: unknown
    force: bool = False  # into a folder that is not empty


@dataclass(slots=True, eq=False)
class MeasuredSet:
    """The pictures of one instant of a session, gathered until the last of them is segmented."""

    session: Session
    stamp: float  # s, mean of the pictures'
    count: int  # of its pictures
    images: dict[int, Image] = field(default_factory=dict)  # by camera
    bands: dict[int, WoundBand] = field(default_factory=dict)  # by camera


@dataclass(frozen=True, slots=True, eq=False)
class NamedPicture:
    """A picture to segment."""

    name: str  # of its mask
    image: Image  # (H, W) or (H, W, 3) BGR
    camera: int = -1  # of its session's rig; -1 without one
    instant: MeasuredSet | None = None  # where it belongs, if the wound's area is measured there


def run_segment(inputs: Sequence[Path], out: Path, segmenter: Segmenter, options: SegmentOptions) -> tuple[str, str]:
    """Segment pictures, folders of pictures, videos, session folders and recordings into `out`.

    Returns the result in lines of text, and what was lost of videos that are cut short and of damaged recordings, ""
    if nothing. A mask is NAME.png (a video's NAME_000000.png and so on, a session's NAME_CAMERA_000000.png), 0 or 255,
    of the picture's own size. InputError for files of which nothing can be read is raised at the end, when the masks of
    all others are written.
    """
    files = input_files(inputs)
    for file in files:
        check_apart("--out", _mask_file(out, _name(file)), file)
    prepare_out(out, options.force)
    _remove_earlier(out, files)
    if options.overlay:
        (out / OVERLAY_FOLDER).mkdir(exist_ok=True)
    clock, errors, lost = WallClock(), list[InputError](), list[str]()
    times, wounds = list[float](), 0  # times: ms of each picture
    with ExitStack() as stack:
        write_row = stack.enter_context(csv_table(out / WOUND_TABLE, WOUND_COLUMNS))
        areas = stack.enter_context(AreaLog(out, segmenter, [file for file in files if _is_session(file)]))
        progress = stack.enter_context(Progress("segment", "pictures", clock.now))
        total = sum(expected_count(file) for file in files)
        for picture in read_pictures(files, errors, lost):
            start = clock.now()
            result = areas.segmented(picture)
            times.append(1000 * (clock.now() - start))
            wounds += result.found
            _write(out, picture.name, picture.image, result, options)
            write_row(table_row(picture.name, result, options.mm_per_px, times[-1]))
            areas.measure(picture)
            progress(len(times), max(total, len(times)))
    _raise_errors(errors, len(times), out)
    median, p99 = np.percentile(times, [50, 99])
    took = f"{median:.1f} ms each (median), {p99:.1f} ms (p99)"
    text = f"{wounds} of {len(times)} pictures show a wound; {took}\nmasks and {WOUND_TABLE} are in {out}"
    return f"{text}\n{areas.text}", "; ".join(lost)


class AreaLog(ExitStack):
    """Measures areas of a session's wound, with areas.csv; of anything else it says why there is none."""

    def __init__(self, folder: Path, segmenter: Segmenter, sessions: Sequence[Path]) -> None:
        """sessions: those whose pictures are going to be segmented; without any, no table is written."""
        super().__init__()
        self._segmenter = segmenter
        self._banded = segmenter if isinstance(segmenter, NetworkSegmenter) else None
        self._areas: dict[Path, list[WoundArea | str]] = {path: [] for path in sessions}
        (folder / AREA_TABLE).unlink(missing_ok=True)  # of an earlier run
        self._write = self.enter_context(csv_table(folder / AREA_TABLE, AREA_COLUMNS)) if sessions else None

    def segmented(self, picture: NamedPicture) -> Segmentation:
        """The wound in a picture, kept for its area where that is measured."""
        instant = picture.instant
        if instant is None or self._banded is None:
            return self._segmenter(picture.image)
        instant.images[picture.camera] = picture.image
        instant.bands[picture.camera] = self._banded.band(picture.image)
        return instant.bands[picture.camera].found

    def measure(self, picture: NamedPicture) -> None:
        """The area, with the last picture of an instant."""
        instant = picture.instant
        if instant is None or self._banded is None or self._write is None or len(instant.bands) < instant.count:
            return
        area = wound_area(instant.session.rig, instant.images, instant.bands, self._banded.settings.spread)
        self._areas[instant.session.path].append(area)
        self._write(area_row(instant, area))

    @property
    def text(self) -> str:
        """The areas, a line for each session, or why there is none."""
        if not self._areas:
            return f"no area in mm^2: {UNCALIBRATED}"
        if self._banded is None:
            return f"no area in mm^2: {NO_BAND}"
        return "\n".join(f"{_name(path)}: {area_text(areas)}" for path, areas in self._areas.items())


def area_text(areas: Sequence[WoundArea | str]) -> str:
    """What the areas of one session's instants say of its wound: their median, and the medians of their limits."""
    known = [area for area in areas if not isinstance(area, str)]
    reasons = [area for area in areas if isinstance(area, str)]
    why = max(reasons, key=reasons.count) if reasons else "no two cameras have a picture of one instant"
    if not known:
        return f"no area in mm^2: {why}"
    area, low, high = np.median([[each.area, each.low, each.high] for each in known], axis=0)
    cameras = min(len(each.cameras) for each in known), max(len(each.cameras) for each in known)
    by = f"{cameras[0]}" if cameras[0] == cameras[1] else f"{cameras[0]} to {cameras[1]}"
    at = "" if len(areas) == 1 else f" at each of {len(known)} instants, of which these are the medians"
    missing = f"; at {len(reasons)} of {len(areas)} instants there is none: {why}" if reasons else ""
    return f"wound of {area:.4g} mm^2, 95 % interval {low:.4g} to {high:.4g} mm^2, by {by} cameras{at}{missing}"


def area_row(instant: MeasuredSet, area: WoundArea | str) -> list[str]:
    """One line of areas.csv; what is not known is empty."""
    head = [_name(instant.session.path), f"{instant.stamp:.6f}"]
    if isinstance(area, str):
        return [*head, "", "", "", "", area]
    cameras = " ".join(instant.session.rig.cameras[c].name for c in area.cameras)
    return [*head, cameras, f"{area.area:.2f}", f"{area.low:.2f}", f"{area.high:.2f}", ""]


def input_files(inputs: Sequence[Path]) -> list[Path]:
    """The files that inputs name, folders opened; InputError: none, unknown kind, two that would share a mask."""
    files = list[Path]()
    for path in inputs:
        if _is_session(path):
            files.append(path)
        elif path.is_dir():
            inside = [f for f in sorted(path.iterdir()) if f.suffix.lower() in PICTURE_SUFFIXES]
            if not inside:
                raise InputError(path, "pictures", "none", f"one at least, ending in {', '.join(PICTURE_SUFFIXES)}")
            files += inside
        elif not path.is_file():
            raise InputError(
                path, "input", "no such file or folder", "a picture, a folder of pictures, a video or a session"
            )
        elif path.suffix.lower() not in INPUT_SUFFIXES:
            raise InputError(path, "kind", path.suffix or "no suffix", ", ".join(INPUT_SUFFIXES))
        else:
            files.append(path)
    first: dict[str, Path] = {}
    for file in files:
        if first.setdefault(_name(file), file) is not file:
            allowed = f"another than that of {first[_name(file)]}: masks are named for it"
            raise InputError(file, "name", _name(file), allowed)
    return files


def _is_session(path: Path) -> bool:
    """Whether its pictures are of a calibrated rig: a recording, or a folder with a session's files."""
    if path.is_dir():
        return all((path / name).is_file() for name in SESSION_FILES)
    return path.suffix.lower() in RECORDING_SUFFIXES and path.is_file()


def _name(file: Path) -> str:
    """What masks and rows of an input are named for."""
    return file.resolve().name if file.is_dir() else file.stem


def expected_count(file: Path) -> int:
    """How many pictures a file holds by its own header; 0 if unreadable."""
    if file.suffix.lower() in PICTURE_SUFFIXES:
        return 1
    try:
        if _is_session(file):
            return sum(map(len, open_session(file).sets))
        video = Video(file)
    except InputError:
        return 0
    count = video.reported_count()
    video.close()
    return count


def read_pictures(files: Sequence[Path], errors: list[InputError], lost: list[str]) -> Iterator[NamedPicture]:
    """The pictures of all files, one after another.

    Adds what cannot be read to `errors`, and to `lost` what is missing of a video.
    """
    for file in files:
        try:
            if _is_session(file):
                yield from _recorded(file, lost)
            elif file.suffix.lower() in PICTURE_SUFFIXES:
                yield NamedPicture(_name(file), decode(read_bytes(file), file, "picture"))
            else:
                yield from _frames(file, lost)
        except InputError as error:
            errors.append(error)


def _recorded(file: Path, lost: list[str]) -> Iterator[NamedPicture]:
    """The pictures of a session in order of stamp; areas are measured at MEASURED_SETS instants of it at most."""
    session = open_session(file)
    shared = [i for i, refs in enumerate(session.sets) if len(refs) > 1]
    chosen = {shared[round(place)] for place in np.linspace(0, len(shared) - 1, MEASURED_SETS)} if shared else set()
    with closing(session.open_reader()) as reader:
        for number, refs in enumerate(session.sets):
            instant = MeasuredSet(session, mean_stamp(refs), len(refs)) if number in chosen else None
            for ref in refs:
                name = f"{_name(file)}_{session.rig.cameras[ref.camera].name}_{ref.number:06d}"
                yield NamedPicture(name, reader.read(ref), ref.camera, instant)
    if session.damage:
        lost.append(f"{file}: {session.damage}")


def _frames(file: Path, lost: list[str]) -> Iterator[NamedPicture]:
    video = Video(file)
    reported = video.reported_count()
    try:
        while (image := video.read()) is not None:
            yield NamedPicture(f"{_name(file)}_{video.next - 1:06d}", image)
        if not video.next:
            raise InputError(file, "frames", "none that decodes", f"{reported}, as the file says (is it cut short?)")
        if video.next < reported:
            lost.append(f"{file}: {video.next} of {reported} frames decode, those behind them are lost")
    finally:
        video.close()


def table_row(name: str, result: Segmentation, mm_per_px: float | None, ms: float) -> list[Any]:
    """One line of the table; what is not known is empty."""
    area, box = int(result.mask.sum()), box_of(result.mask)
    middle = [f"{value:.2f}" for value in centroid(result.mask)] if result.found else ["", ""]
    threshold = f"{result.threshold:.1f}" if np.isfinite(result.threshold) else ""
    return [
        name, int(result.found), f"{result.confidence:.4f}", threshold, area,
        "" if mm_per_px is None else f"{area * mm_per_px**2:.2f}", *middle, *(box or ("",) * 4), f"{ms:.2f}",
    ]  # fmt: skip


def _mask_file(out: Path, name: str) -> Path:
    return out / f"{name}.png"


def _overlay_file(out: Path, name: str) -> Path:
    return out / OVERLAY_FOLDER / f"{name}.jpg"


def _remove_earlier(out: Path, inputs: Sequence[Path]) -> None:
    """Remove an earlier run's masks and overlays, as its table names them; inputs stay.

    A table of other columns is not this command's: what it names may be somebody's own pictures.
    """
    rows = [row for _, row in read_csv(out / WOUND_TABLE)] if (out / WOUND_TABLE).exists() else []
    if not rows or tuple(rows[0]) != WOUND_COLUMNS:
        return
    read = {file.resolve() for file in inputs}
    names = [row[0] for row in rows[1:] if row and Path(row[0]).name == row[0]]
    for file in (path for name in names for path in (_mask_file(out, name), _overlay_file(out, name))):
        if file.resolve() not in read:
            file.unlink(missing_ok=True)


def _write(out: Path, name: str, image: Image, result: Segmentation, options: SegmentOptions) -> None:
    _mask_file(out, name).write_bytes(encode(result.mask.astype(np.uint8) * np.uint8(255))[1])
    if options.overlay:
        _overlay_file(out, name).write_bytes(encode(draw_overlay(image, result), OVERLAY_QUALITY)[1])


def _raise_errors(errors: list[InputError], done: int, out: Path) -> None:
    """Raise the first error; where some pictures were read it names the other files, and where those masks are.

    done: number of these.
    """
    if errors and not done:
        raise errors[0]
    if errors:
        first, others = errors[0], ", ".join(str(error.where) for error in errors[1:])
        got = f"{first.got}; also {others}" if others else first.got
        count = count_text(done, "other picture")
        raise InputError(first.where, first.what, got, f"{first.allowed}; the masks of {count} are in {out}")
