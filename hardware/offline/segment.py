"""`stillbed segment`: a PNG mask for each picture, frame of a video or picture of a recording, and a table of all."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimation.errors import InputError
from hardware.files.images import Video, decode, encode
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, prepare_out
from hardware.recording.session_reader import open_session
from perception.frames import Image
from perception.wound.segmentation import Segmentation, Segmenter, box_of, centroid, draw_overlay

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg")
RECORDING_SUFFIXES = (".mcap",)
INPUT_SUFFIXES = PICTURE_SUFFIXES + VIDEO_SUFFIXES + RECORDING_SUFFIXES
WOUND_TABLE = "wounds.csv"
OVERLAY_FOLDER = "overlays"  # folder of the pictures with outlines
OVERLAY_QUALITY = 90  # of JPEG
WOUND_COLUMNS = (
    "name", "wound", "confidence", "threshold", "area_px", "area_mm2", "centroid_x_px", "centroid_y_px",
    "x0_px", "y0_px", "x1_px", "y1_px", "ms",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class SegmentOptions:
    """What is written, and where."""

    overlay: bool = False  # pictures with outlines as well
    mm_per_px: float | None = None  # in the wound's plane; None: unknown
    force: bool = False  # into a folder that is not empty


def run_segment(inputs: Sequence[Path], out: Path, segmenter: Segmenter, options: SegmentOptions) -> tuple[str, str]:
    """Segment pictures, folders of pictures, videos and recordings into `out`.

    Returns the result in two lines of text, and what was lost of videos that are cut short and of damaged recordings,
    "" if nothing. A mask is NAME.png (a video's NAME_000000.png and so on, a recording's NAME_CAMERA_000000.png), 0 or
    255, of the picture's own size. InputError for files of which nothing can be read is raised at the end, when the
    masks of all others are written.
    """
    files = input_files(inputs)
    prepare_out(out, options.force)
    if options.overlay:
        (out / OVERLAY_FOLDER).mkdir(exist_ok=True)
    clock, errors, lost = WallClock(), list[InputError](), list[str]()
    times, wounds = list[float](), 0  # times: ms of each picture
    with (out / WOUND_TABLE).open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(WOUND_COLUMNS)
        with Progress("segment", "pictures", clock.now) as progress:
            total = sum(expected_count(file) for file in files)
            for name, image in read_pictures(files, errors, lost):
                start = clock.now()
                result = segmenter(image)
                times.append(1000 * (clock.now() - start))
                wounds += result.found
                _write(out, name, image, result, options)
                table.writerow(table_row(name, result, options.mm_per_px, times[-1]))
                stream.flush()
                progress(len(times), max(total, len(times)))
    _raise_errors(errors, len(times))
    median, p99 = np.percentile(times, [50, 99])
    took = f"{median:.1f} ms each (median), {p99:.1f} ms (p99)"
    text = f"{wounds} of {len(times)} pictures show a wound; {took}\nmasks and {WOUND_TABLE} are in {out}"
    return text, "; ".join(lost)


def input_files(inputs: Sequence[Path]) -> list[Path]:
    """The files that inputs name, folders opened; InputError: none, unknown kind, two that would share a mask."""
    files = list[Path]()
    for path in inputs:
        if path.is_dir():
            inside = [f for f in sorted(path.iterdir()) if f.suffix.lower() in PICTURE_SUFFIXES]
            if not inside:
                raise InputError(path, "pictures", "none", f"one at least, ending in {', '.join(PICTURE_SUFFIXES)}")
            files += inside
        elif not path.is_file():
            raise InputError(
                path, "input", "no such file or folder", "a picture, a folder of pictures, a video or a recording"
            )
        elif path.suffix.lower() not in INPUT_SUFFIXES:
            raise InputError(path, "kind", path.suffix or "no suffix", ", ".join(INPUT_SUFFIXES))
        else:
            files.append(path)
    first: dict[str, Path] = {}
    for file in files:
        if first.setdefault(file.stem, file) is not file:
            allowed = f"another than that of {first[file.stem]}: masks are named for it"
            raise InputError(file, "name", file.stem, allowed)
    return files


def expected_count(file: Path) -> int:
    """How many pictures a file holds by its own header; 0 if unreadable."""
    if file.suffix.lower() in PICTURE_SUFFIXES:
        return 1
    try:
        if file.suffix.lower() in RECORDING_SUFFIXES:
            return sum(map(len, open_session(file).sets))
        video = Video(file)
    except InputError:
        return 0
    count = video.reported_count()
    video.close()
    return count


def read_pictures(files: Sequence[Path], errors: list[InputError], lost: list[str]) -> Iterator[tuple[str, Image]]:
    """Name of the mask and picture (H, W) or (H, W, 3) BGR, one after another.

    Adds what cannot be read to `errors`, and to `lost` what is missing of a video.
    """
    for file in files:
        try:
            if file.suffix.lower() in PICTURE_SUFFIXES:
                yield file.stem, decode(file.read_bytes(), file, "picture")
            elif file.suffix.lower() in RECORDING_SUFFIXES:
                yield from _recorded(file, lost)
            else:
                yield from _frames(file, lost)
        except InputError as error:
            errors.append(error)


def _recorded(file: Path, lost: list[str]) -> Iterator[tuple[str, Image]]:
    session = open_session(file)
    with closing(session.open_reader()) as reader:
        for ref in (ref for refs in session.sets for ref in refs):
            yield f"{file.stem}_{session.rig.cameras[ref.camera].name}_{ref.number:06d}", reader.read(ref)
    if session.damage:
        lost.append(f"{file}: {session.damage}")


def _frames(file: Path, lost: list[str]) -> Iterator[tuple[str, Image]]:
    video = Video(file)
    reported = video.reported_count()
    try:
        while (image := video.read()) is not None:
            yield f"{file.stem}_{video.next - 1:06d}", image
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


def _write(out: Path, name: str, image: Image, result: Segmentation, options: SegmentOptions) -> None:
    (out / f"{name}.png").write_bytes(encode(result.mask.astype(np.uint8) * np.uint8(255))[1])
    if options.overlay:
        (out / OVERLAY_FOLDER / f"{name}.jpg").write_bytes(encode(draw_overlay(image, result), OVERLAY_QUALITY)[1])


def _raise_errors(errors: list[InputError], done: int) -> None:
    """Raise the first error; it names the other files where some pictures were read. done: number of those."""
    if len(errors) == 1 or (errors and not done):
        raise errors[0]
    if errors:
        others = ", ".join(str(error.where) for error in errors[1:])
        raise InputError(errors[0].where, errors[0].what, f"{errors[0].got}; also {others}", errors[0].allowed)
