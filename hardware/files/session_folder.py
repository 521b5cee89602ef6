"""A session as a plain folder that a person can write by hand: rig.toml, frames.csv, videos or pictures, and more.

Optional beside them: roi.toml, head.csv, truth.tum (exact) or reference.tum (measured; truth wins), surface.ply, .stl
or .obj, recorded.toml (when it was recorded).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.pose import Trajectory
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from hardware.files.folder_tables import read_frames, read_heads, read_recorded, read_roi, read_tum
from hardware.files.images import Video, check_size, count_by_decoding, decode
from hardware.files.rig_file import ImageSource, RigFile, read_rig, surface_of_folder
from hardware.files.session import NO_PRINT_HEADS, FrameRef, Session, common_stamps, frame_refs
from hardware.process import checks
from perception.frames import Image

MAX_FRAME_STEP = 10.0  # s, median of a camera's frames: 100 fps in ms, and less in anything finer, are above
MAX_APART = 60.0  # s between the pictures of two cameras that never overlap: one has another zero, as an epoch has
TRUTH_FILES = (("truth.tum", True), ("reference.tum", False))  # the first that is there counts


@dataclass(frozen=True, slots=True)
class CameraFiles:
    """The files of one camera's images."""

    camera: Camera
    video: Path | None
    pictures: tuple[Path, ...]  # one per frame, where there is no video


class FolderReader:
    """Decodes the images of a folder; videos only go forward."""

    def __init__(self, cameras: Sequence[CameraFiles]) -> None:
        self._cameras = cameras
        self._videos: dict[int, Video] = {}

    def read(self, ref: FrameRef) -> Image:
        """The image; InputError where it is missing, undecodable or not of the camera's size."""
        files = self._cameras[ref.camera]
        if files.video is None:
            path = files.pictures[ref.number]
            image = decode(checks.read_bytes(path), path, "picture")
            check_size(image, files.camera.size, path, "size")
            return image
        frame = self._video(ref.camera, files.video, ref.number).read()
        if frame is None:
            allowed = "a video that decodes as far as frames.csv names frames"
            raise InputError(files.video, f"frame {ref.number}", "cannot be decoded; the video ends early", allowed)
        check_size(frame, files.camera.size, files.video, f"size of frame {ref.number}")
        return frame

    def _video(self, camera: int, path: Path, number: int) -> Video:
        if camera not in self._videos:
            self._videos[camera] = Video(path)
        video = self._videos[camera]
        assert video.next <= number
        while video.next < number and video.skip():
            pass
        return video

    def encoded(self, ref: FrameRef) -> tuple[str, bytes] | None:
        """Format and bytes of a PNG or JPEG picture as stored, None for anything else."""
        files = self._cameras[ref.camera]
        if files.video is not None:
            return None
        kind = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}.get(files.pictures[ref.number].suffix.lower())
        return None if kind is None else (kind, checks.read_bytes(files.pictures[ref.number]))

    def close(self) -> None:
        """Release the decoders."""
        for video in self._videos.values():
            video.close()


def open_folder(folder: Path, rig_file: RigFile | None = None) -> Session:
    """Open a session folder; InputError says which file of it is wrong, and how.

    rig_file: instead of what its rig.toml says, where that is not calibrated yet.
    """
    still = rig_file is not None  # pictures to calibrate by, which may be minutes apart
    rig_file = read_rig(folder / "rig.toml") if rig_file is None else rig_file
    rig = rig_file.rig
    cameras = tuple(_files(folder, c, s) for c, s in zip(rig.cameras, rig_file.sources, strict=True))
    stamps = read_frames(folder / "frames.csv", rig)
    _check_clocks(folder / "frames.csv", rig, stamps, math.inf if still else MAX_FRAME_STEP)
    for files, times in zip(cameras, stamps, strict=True):
        _check_count(folder / "frames.csv", files, len(times))
        _check_first_image(files)
    roi = folder / "roi.toml"
    rois = read_roi(roi, rig, common_stamps(rig, stamps)) if roi.exists() else ()
    head = folder / "head.csv"
    heads = read_heads(head) if head.exists() else NO_PRINT_HEADS
    sets, open_reader = frame_refs(rig, stamps), partial(FolderReader, cameras)
    surface = surface_of_folder(folder, rig_file)
    truth, began = truth_of(folder), read_recorded(folder)
    return Session(folder, rig, rois, surface, truth, sets, open_reader, heads=heads, began=began)


def truth_of(folder: Path) -> Trajectory | None:
    """The trajectory in truth.tum, else in reference.tum, else None."""
    files = truth_file(folder)
    return None if files is None else read_tum(*files)


def truth_file(folder: Path) -> tuple[Path, bool] | None:
    """The trajectory file that counts, and whether it is exact."""
    return next(((folder / name, exact) for name, exact in TRUTH_FILES if (folder / name).exists()), None)


def _files(folder: Path, camera: Camera, source: ImageSource | None) -> CameraFiles:
    if source is None:
        where, allowed = folder / "rig.toml", "`video = ` file or `images = ` glob"
        raise InputError(where, f"camera {camera.name!r}", "neither video nor images", allowed)
    if source.kind == "video":
        return CameraFiles(camera, folder / source.pattern, ())
    try:
        files = [p for p in folder.glob(source.pattern) if p.is_file() and not p.name.startswith(".")]
    except (ValueError, NotImplementedError):
        where, what = folder / "rig.toml", f"camera {camera.name!r}: images"
        raise InputError(where, what, source.pattern, "a glob relative to the folder, as cam_0/*.png") from None
    return CameraFiles(camera, None, tuple(sorted(files, key=lambda p: _natural(p.as_posix()))))


def _natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts frame10 behind frame9."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if i % 2 else (0, part) for i, part in enumerate(parts)]


def _check_count(frames_csv: Path, files: CameraFiles, expected: int) -> None:
    """InputError unless frames.csv names as many images as there are; a video is decoded to count them if in doubt."""
    if files.video is None:
        there, what = len(files.pictures), "pictures"
    else:
        video = Video(files.video)
        complete, what = video.reaches(expected), f"frames that decode in {files.video.name}"
        video.close()
        there = expected if complete else count_by_decoding(files.video)
    if there != expected:
        key = f"number of frames of camera {files.camera.name!r}"
        raise InputError(frames_csv, key, expected, f"{there}, as many as there are {what}")


def _check_clocks(frames_csv: Path, rig: Rig, stamps: Sequence[Array], max_step: float) -> None:
    """InputError where stamps (N,) of the cameras are no seconds, or those of two cameras have no common zero."""
    common = [(c.name, s) for c, s in zip(rig.cameras, common_stamps(rig, stamps), strict=True) if len(s)]
    for name, times in common:
        step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        if step > max_step:
            got, allowed = f"{step:g} s between frames", f"{max_step:g} s or less: seconds, not ms or ns"
            raise InputError(frames_csv, f"camera {name!r}: stamp_s", got, allowed)
    first, ended = min(common, key=lambda one: one[1][-1])
    late, times = max(common, key=lambda one: one[1][0])
    if times[0] - ended[-1] > MAX_APART:
        got = f"from {times[0]:.10g} s on, when those of {first!r} ended at {ended[-1]:.10g} s"
        allowed = "one clock for all cameras, or clock_offset_s in rig.toml"
        raise InputError(frames_csv, f"camera {late!r}: stamp_s", got, allowed)


def _check_first_image(files: CameraFiles) -> None:
    if files.video is None and not files.pictures:
        return  # a camera that gave nothing; frames.csv names no frame of it either
    reader = FolderReader((files,))
    reader.read(FrameRef(0, 0, 0.0, 0.0))
    reader.close()
