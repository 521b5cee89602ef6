"""Recordings made of sessions: `stillbed import` and `stillbed export` (folder to MCAP and back), and tracking runs.

Import and export lose nothing. Both write beside the target and rename at the end, so an interrupted run leaves nothing
that looks whole. Import stores a video's images as PNG (exact) and pictures as they are; export writes the stored
pictures as they are, so importing an export gives the same stamps, numbers and pixels again.
"""

from __future__ import annotations

import contextlib
import glob
import heapq
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from logging import INFO, WARNING
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from estimation.errors import InputError, StillbedError
from estimation.pose import SurfacePose, TrackState
from hardware.files.folder_tables import (
    PICTURE_SUFFIXES,
    read_rows,
    rows_from_trajectory,
    write_frames,
    write_heads,
    write_recorded,
    write_roi,
    write_rows,
)
from hardware.files.rig_file import ImageSource, write_rig
from hardware.files.session import HEAD_STAMP_TOLERANCE, FrameRef, Session
from hardware.files.session_folder import TRUTH_FILES, truth_file
from hardware.process.checks import error_text
from hardware.process.progress import ProgressReport, no_progress
from hardware.recording.recorder import NOT_KEPT, Recorder
from hardware.recording.session_reader import open_session, read_truth_rows
from perception.frames import Frame, FrameSet, Roi

if TYPE_CHECKING:  # who converts needs no tracker, which takes two seconds to load
    from perception.tracking.step import StepReport


def import_folder(
    folder: str | Path,
    mcap_path: str | Path,
    progress: ProgressReport = no_progress,
    overwrite: bool = False,
    jpeg_quality: int | None = None,
) -> None:
    """Turn a session folder into one .mcap file; `jpeg_quality` (0-100) stores images smaller and not exactly.

    progress: called with images done and images in all. InputError where the folder is wrong, or `mcap_path` exists and
    `overwrite` is not set.
    """
    folder, target = Path(folder), Path(mcap_path)
    if not folder.is_dir():
        got = "a file" if folder.exists() else "no such folder"
        raise InputError(folder, "session", got, "a session folder (with rig.toml, see docs/conventions.md)")
    if target.is_dir() or (target.exists() and not overwrite):
        raise InputError(target, "recording", "exists already", "a new file, or --force")
    if jpeg_quality is not None and not 0 <= jpeg_quality <= 100:
        raise InputError(target, "jpeg quality", jpeg_quality, "0 .. 100")
    session = open_session(folder)
    part = _part_name(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with Recorder(part, session.rig, jpeg_quality, overwrite=True, kept=False, began=session.began) as recorder:
            _record(session, folder, recorder, progress, jpeg_quality is None)
        os.replace(part, target)
    except (StillbedError, OSError) as error:
        if isinstance(error, InputError):
            raise
        why = error_text(error) if isinstance(error, OSError) else str(error).replace(f"{part}: ", "")
        raise StillbedError(f"{target}: cannot write: {why.removesuffix(NOT_KEPT)}{NOT_KEPT}") from error
    finally:
        with contextlib.suppress(OSError):  # it is renamed, or was never there
            part.unlink()


def export_recording(mcap_path: str | Path, folder: str | Path, progress: ProgressReport = no_progress) -> str:
    """Turn an .mcap file into a session folder with a picture per image; returns the damage of the file, "" if none.

    InputError unless `folder` is new or empty. Poses, commands and arm bytes of a run have no place in a session
    folder; they stay in the recording.
    """
    source, target = Path(mcap_path), Path(folder)
    if source.is_dir():
        raise InputError(source, "recording", "a folder", "an .mcap file")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(target, "folder", "exists and is not empty", "a new or empty folder")
    session = open_session(source)
    part = _part_name(target)
    try:
        part.mkdir(parents=True)
        _write_folder(session, part, progress)
        if target.exists():
            target.rmdir()  # empty, or this fails
        os.replace(part, target)
    except OSError as error:
        raise StillbedError(f"{target}: cannot write: {error_text(error)}{NOT_KEPT}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return session.damage


def _part_name(target: Path) -> Path:
    return target.parent / f".{target.name}.{os.getpid()}.part"


Entry = tuple[float, int, Callable[[], None]]  # stamp, s; rank among entries of one stamp; writes the entry


def _record(session: Session, folder: Path, recorder: Recorder, progress: ProgressReport, exact: bool) -> None:
    """Everything in order of stamp, so that viewers need not sort."""
    if session.surface is not None:
        recorder.surface(session.surface)
    reader, refs = session.open_reader(), _refs(session)

    def image(done: int, ref: FrameRef) -> None:
        encoded = reader.encoded(ref) if exact else None
        if encoded is None:
            recorder.frame(Frame(ref.camera, ref.stamp, reader.read(ref)), ref.camera_stamp)
        else:
            recorder.encoded_frame(ref.camera, ref.stamp, *encoded, ref.camera_stamp)
        progress(done, len(refs))

    truth = truth_file(folder)
    truth_rows, exact_truth = ((), False) if truth is None else (read_rows(truth[0]), truth[1])
    heads = zip(session.heads.rows, session.heads.extruding, strict=True)
    streams: list[Iterable[Entry]] = [
        ((roi.stamp, 0, partial(recorder.write, roi)) for roi in sorted(session.roi, key=lambda roi: roi.stamp)),
        ((float(row[0]), 1, partial(recorder.truth_row, row, exact_truth)) for row in truth_rows),
        ((float(row[0]), 2, partial(recorder.head_row, row, bool(extruding))) for row, extruding in heads),
        ((ref.stamp, 3, partial(image, done, ref)) for done, ref in enumerate(refs, 1)),
    ]
    try:
        for _, _, write in heapq.merge(*streams, key=lambda entry: entry[:2]):
            write()
    finally:
        reader.close()


def _refs(session: Session) -> list[FrameRef]:
    """Every stored image, in order of stamp and camera."""
    return sorted((ref for refs in session.sets for ref in refs), key=lambda ref: (ref.stamp, ref.camera))


def _write_folder(session: Session, folder: Path, progress: ProgressReport) -> None:
    rig, refs = session.rig, _renumbered(session)
    write_rig(folder / "rig.toml", rig, [ImageSource("images", f"{glob.escape(c.name)}/*") for c in rig.cameras])
    write_frames(folder / "frames.csv", rig, [new for _, new in refs])
    write_recorded(folder, session.began)
    if session.roi:
        numbers = [_frame_at(session, roi, refs) for roi in session.roi]
        write_roi(folder / "roi.toml", rig, session.roi, numbers)
    if session.truth is not None:
        name = next(name for name, exact in TRUTH_FILES if exact == session.truth.exact)
        write_rows(folder / name, read_truth_rows(session.path))
    if len(session.heads):
        write_heads(folder / "head.csv", session.heads)
    if session.surface is not None:
        shutil.copyfile(session.surface, folder / session.surface.name)
    _write_pictures(session, folder, refs, progress)


def _write_pictures(
    session: Session, folder: Path, refs: list[tuple[FrameRef, FrameRef]], progress: ProgressReport
) -> None:
    for camera in session.rig.cameras:
        (folder / camera.name).mkdir()
    reader = session.open_reader()
    try:
        for done, (ref, new) in enumerate(refs, 1):
            encoded = reader.encoded(ref)
            assert encoded is not None
            kind, data = encoded
            if kind not in PICTURE_SUFFIXES:
                raise InputError(session.path, "image format", kind, f"one of {', '.join(PICTURE_SUFFIXES)}")
            name = session.rig.cameras[ref.camera].name
            (folder / name / f"{new.number:06d}{PICTURE_SUFFIXES[kind]}").write_bytes(data)
            progress(done, len(refs))
    finally:
        reader.close()


def _renumbered(session: Session) -> list[tuple[FrameRef, FrameRef]]:
    """Every stored image beside itself with a new number, counted by stamp from 0 in each camera; in order of stamp."""
    counts = [0] * len(session.rig)
    pairs = []
    for ref in _refs(session):
        pairs.append((ref, FrameRef(ref.camera, counts[ref.camera], ref.camera_stamp, ref.stamp)))
        counts[ref.camera] += 1
    return pairs


def _frame_at(session: Session, roi: Roi, refs: list[tuple[FrameRef, FrameRef]]) -> int:
    """Number of the camera's image nearest to the polygon's stamp (its own, unless that image is lost)."""
    own = [new for _, new in refs if new.camera == roi.camera]
    if not own:
        name = session.rig.cameras[roi.camera].name
        raise InputError(session.path, "/roi", f"a polygon of {name!r}, which has no image", "a camera with an image")
    return own[int(np.argmin([abs(new.stamp - roi.stamp) for new in own]))].number


class TrackRecorder:
    """Records a tracking run: images, tracks, poses, state changes, and the session's truth, print heads and scan."""

    def __init__(self, path: Path, session: Session, overwrite: bool) -> None:
        """Create the file at `path`; InputError where it exists and `overwrite` is not set."""
        self._recorder = Recorder(path, session.rig, overwrite=overwrite, began=session.began)
        self._truth = deque(() if session.truth is None else rows_from_trajectory(session.truth))
        self._exact = session.truth is not None and session.truth.exact
        self._heads = deque(zip(session.heads.rows, session.heads.extruding, strict=True))
        self._state: TrackState | None = None
        if session.surface is not None:
            self._recorder.surface(session.surface)
        for roi in session.roi:
            self._recorder.write(roi)

    def write(self, frames: FrameSet, pose: SurfacePose, report: StepReport) -> None:
        """One frame set, its pose and tracks, and truth and print heads up to its stamp."""
        self._write_session_rows(frames.stamp)
        for frame in frames.frames:
            self._recorder.write(frame)
        self._recorder.write(report.observations)
        self._recorder.write(pose)
        if pose.state is not self._state:
            level = INFO if pose.state.measured else WARNING
            self._recorder.event(pose.stamp, f"{pose.state.value}: {pose.reason}", level, "tracking")
            self._state = pose.state

    def _write_session_rows(self, until: float) -> None:
        """Write truth and print heads, as the session stores them, up to those of a frame set at `until`, s."""
        while self._truth and self._truth[0][0] <= until:
            self._recorder.truth_row(self._truth.popleft(), self._exact)
        while self._heads and self._heads[0][0][0] <= until + HEAD_STAMP_TOLERANCE:
            row, extruding = self._heads.popleft()
            self._recorder.head_row(row, bool(extruding))

    def __enter__(self) -> TrackRecorder:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with self._recorder:
            if error is None:
                self._write_session_rows(np.inf)
