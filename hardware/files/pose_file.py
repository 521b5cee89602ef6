"""poses.tum, poses.csv and wound.csv: what a tracking run leaves behind, written line by line and read back.

`poses.tum` holds the measured poses only, as evo reads them: `stamp x y z qx qy qz qw`, s and mm. `poses.csv` holds one
line per frame set: stamp, images given, pose, upper triangle of the covariance, twist, motion, state, tracks per
camera, the cameras' clocks, milliseconds per stage, reason. Every line is flushed, so a killed run leaves whole lines.
`wound.csv` holds what each camera saw of the wound, at the segmentation's own pace.
"""

from __future__ import annotations

import csv
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.process import checks
from perception.frames import FrameSet
from perception.tracking.step import StepReport

if TYPE_CHECKING:
    from perception.tracking.wound_step import WoundEstimate
    from perception.wound.segmentation import Segmenter

TANGENT_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
_UPPER = np.triu_indices(6)
_POSE = ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
_COVARIANCE = tuple(f"cov_{TANGENT_NAMES[i]}_{TANGENT_NAMES[j]}" for i, j in zip(*_UPPER, strict=True))
_TWIST = ("wx_rad_s", "wy_rad_s", "wz_rad_s", "vx_mm_s", "vy_mm_s", "vz_mm_s")
_MOTION = ("moving", "onset_s", "moved_mm", "turned_deg")
_DEFORMATION = ("deformation_mm", "deformation_sigma_mm")
_POSE_TABLE_COLUMNS = ("stamp_s", "frames", *_POSE, *_COVARIANCE, *_TWIST, *_MOTION, *_DEFORMATION, "state", "cameras")
_STATES = tuple(state.value for state in TrackState)


@dataclass(frozen=True, slots=True, eq=False)
class PoseTable:
    """A run as parallel arrays, one row per frame set; N frame sets, C cameras, S stages."""

    stamps: Array  # (N,) s
    frames: NDArray[np.int64]  # (N,) images given
    base_from_surface: Array  # (N, 4, 4) mm
    covariance: Array  # (N, 6, 6), as in SurfacePose
    twist: Array  # (N, 6), as in SurfacePose
    moving: NDArray[np.bool_]  # (N,), as in SurfaceMotion like the next three
    onset: Array  # (N,) s, NaN before the first
    moved: Array  # (N,) mm
    turned: Array  # (N,) rad
    deformation: Array  # (N,) mm, 0 where there is no warp
    deformation_sigma: Array  # (N,) mm, 0 where there is no warp
    states: tuple[TrackState, ...]  # N
    used: NDArray[np.int64]  # (N, C) tracks that carry the pose
    offsets: Array  # (N, C) s, as in StepReport
    offset_sigmas: Array  # (N, C) s
    seconds: Array  # (N, S + 1), of each stage and in all
    reasons: tuple[str, ...]  # N
    cameras: tuple[str, ...]  # C names
    stages: tuple[str, ...]  # S + 1 names, the last one "total"

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(N,) rows whose newest images took part in the pose."""
        return np.array([state.measured for state in self.states], bool)

    def is_state(self, state: TrackState) -> NDArray[np.bool_]:
        """(N,) rows in `state`."""
        return np.array([s is state for s in self.states], bool)


class PoseWriter:
    """Writes poses.csv and poses.tum into a folder, a flushed line at a time; closes them as a context manager."""

    def __init__(self, folder: Path, cameras: Sequence[str], stages: Sequence[str]) -> None:
        self._csv_file = (folder / "poses.csv").open("w", newline="", encoding="utf-8")
        self._tum_file = (folder / "poses.tum").open("w", encoding="utf-8")
        self._csv = csv.writer(self._csv_file, lineterminator="\n")
        self._csv.writerow(
            [
                *_POSE_TABLE_COLUMNS,
                *_names("tracks_", cameras),
                *_clock_names(cameras),
                *(f"ms_{s}" for s in (*stages, "total")),
                "reason",
            ]
        )
        self._tum_file.write("# base_from_surface: stamp_s x y z qx qy qz qw (mm)\n")
        for file in (self._csv_file, self._tum_file):
            file.flush()  # a run that is cut short before its first pose is read back, too

    def write(self, pose: SurfacePose, frames: int, report: StepReport, total: float) -> None:
        """One frame set: its pose, images given, what the step did, and the `total` s that it took."""
        numbers = _pose_numbers(pose.base_from_surface)
        upper = pose.covariance[_UPPER]
        tracks = [int(n) for n in report.used]
        in_ms = np.round(1000 * np.concatenate([report.offsets, report.offset_sigmas]), 4)
        clocks = [f"{v:.4f}" for v in in_ms + 0.0]  # + 0.0: no -0.0000
        milliseconds = [f"{1000 * s:.4f}" for s in (*report.seconds, total)]
        motion = pose.motion
        moved = [int(motion.moving), f"{motion.onset:.6f}", f"{motion.moved:.6f}", f"{np.rad2deg(motion.turned):.6f}"]
        bent = [0.0, 0.0] if pose.warp is None else [pose.warp.deformation, pose.warp.deformation_sigma]
        self._csv.writerow(
            [
                f"{pose.stamp:.6f}",
                frames,
                *numbers,
                *(f"{v:.9g}" for v in (*upper, *pose.twist)),
                *moved,
                *(f"{v:.6f}" for v in bent),
            ]
            + [pose.state.value, int(np.count_nonzero(tracks)), *tracks, *clocks, *milliseconds, pose.reason]
        )
        self._csv_file.flush()
        if pose.state.measured:
            self._tum_file.write(f"{pose.stamp:.6f} {' '.join(numbers)}\n")
            self._tum_file.flush()

    def close(self) -> None:
        """Close both files; a second call does nothing."""
        self._csv_file.close()
        self._tum_file.close()

    def __enter__(self) -> PoseWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


def _names(column: str, cameras: Sequence[str]) -> list[str]:
    return [f"{column}{name}" for name in cameras]


def _clock_names(cameras: Sequence[str]) -> list[str]:
    return [*_names("offset_ms_", cameras), *_names("offset_sigma_ms_", cameras)]


def _pose_numbers(transform: Array) -> list[str]:
    quaternion = se3.quaternion_from_rotation(transform[:3, :3])
    return [*(f"{v:.6f}" for v in transform[:3, 3]), *(f"{v:.12f}" for v in quaternion)]


def read_poses(path: Path) -> PoseTable:
    """The table that a PoseWriter wrote to `path`; a last line cut short by a kill is left out.

    Of files from before the cameras' clocks were learned, offsets are 0 and their sigmas nan.
    Raises InputError naming file, line and column for anything else that PoseWriter would not have written.
    """
    rows = [row for _, row in checks.read_csv(path, "a poses.csv of stillbed track")]
    head = rows[0] if rows else []
    if tuple(head[: len(_POSE_TABLE_COLUMNS)]) != _POSE_TABLE_COLUMNS or head[-1:] != ["reason"]:
        raise InputError(path, "header", ",".join(head[:4]), f"{','.join(_POSE_TABLE_COLUMNS[:4])}, ...")
    body = rows[1:]
    if body and len(body[-1]) != len(head):
        body = body[:-1]
    return _table(path, head, body)


def _table(path: Path, head: list[str], body: list[list[str]]) -> PoseTable:
    cameras = tuple(name.removeprefix("tracks_") for name in head if name.startswith("tracks_"))
    stages = tuple(name.removeprefix("ms_") for name in head if name.startswith("ms_"))
    learned = head[len(_POSE_TABLE_COLUMNS) + len(cameras) : len(head) - 1 - len(stages)]
    if learned not in ([], _clock_names(cameras)):
        raise InputError(path, "header", ",".join(learned), ",".join(_clock_names(cameras)))
    state_column = head.index("state")
    for number, row in enumerate(body, start=2):
        if len(row) != len(head):
            raise InputError(path, f"line {number}", f"{len(row)} columns", f"{len(head)} columns")
        if row[state_column] not in _STATES:
            raise InputError(path, f"line {number}: state", row[state_column], ", ".join(_STATES))
    numbers = _numbers(path, head, [row[:state_column] + row[state_column + 1 : -1] for row in body])
    stamps, frames, positions, quaternions, upper, twist, motion, deformation, cameras_used, used, rest = np.split(
        numbers, np.cumsum([1, 1, 3, 4, 21, 6, len(_MOTION), len(_DEFORMATION), 1, len(cameras)]), axis=1
    )
    del cameras_used  # it is np.count_nonzero(used, 1)
    clocks, milliseconds = np.split(rest, [-len(stages)], axis=1)
    if not learned:
        clocks = np.tile(np.repeat([0.0, np.nan], len(cameras)), (len(body), 1))
    offsets, offset_sigmas = np.split(clocks / 1000, [len(cameras)], axis=1)
    covariance = np.zeros((len(body), 6, 6))
    covariance[:, _UPPER[0], _UPPER[1]] = covariance[:, _UPPER[1], _UPPER[0]] = upper
    return PoseTable(
        stamps=stamps[:, 0],
        frames=frames[:, 0].astype(np.int64),
        base_from_surface=se3.make(se3.rotation_from_quaternion(quaternions), positions),
        covariance=covariance,
        twist=twist,
        moving=motion[:, 0] != 0,
        onset=motion[:, 1],
        moved=motion[:, 2],
        turned=np.deg2rad(motion[:, 3]),
        deformation=deformation[:, 0],
        deformation_sigma=deformation[:, 1],
        states=tuple(TrackState(row[state_column]) for row in body),
        used=used.astype(np.int64),
        offsets=offsets,
        offset_sigmas=offset_sigmas,
        seconds=milliseconds / 1000,
        reasons=tuple(row[-1] for row in body),
        cameras=cameras,
        stages=stages,
    )


def _numbers(path: Path, head: list[str], cells: list[list[str]]) -> Array:
    """The numeric cells (N, M); `head` is the whole header, whose text columns are `state` and the last."""
    names = [name for name in head[:-1] if name != "state"]
    out = np.empty((len(cells), len(names)))
    for i, row in enumerate(cells):
        for j, cell in enumerate(row):
            try:
                out[i, j] = float(cell)
            except ValueError:
                raise InputError(path, f"line {i + 2}: {names[j]}", cell, "a number") from None
    return out


WOUND_FILE_NAME = "wound.csv"
WOUND_COLUMNS = (
    "stamp_s", "camera", "wound", "confidence", "missed", "area_px", "area_mm2", "centroid_x_px", "centroid_y_px",
    "roi_x0_px", "roi_y0_px", "roi_x1_px", "roi_y1_px",
)  # fmt: skip


class WoundFile:
    """Segments beside a run, in one thread, and writes what it finds; a sink of `hardware.offline.track.follow`."""

    def __init__(self, folder: Path, rig: Rig, segmenter: Segmenter) -> None:
        from perception.tracking.wound_step import SEGMENTATION_DELAY_SETS, AsyncSegmentation  # loads onnxruntime

        self._rig, self._thread = rig, ThreadPoolExecutor(1)
        self._beside = AsyncSegmentation(rig, segmenter, self._thread)
        self._poses: deque[SurfacePose] = deque(maxlen=SEGMENTATION_DELAY_SETS + 1)
        self._stream = (folder / WOUND_FILE_NAME).open("w", newline="", encoding="utf-8")
        self._table = csv.writer(self._stream, lineterminator="\n")
        self._table.writerow(WOUND_COLUMNS)

    def write(self, frames: FrameSet, pose: SurfacePose, report: StepReport) -> None:
        """One frame set and its pose; rows of earlier pictures where a look at them is done."""
        self._poses.append(pose)
        due = self._beside(frames)
        if due is None:
            return
        stamp, sights = due
        measured = [p for p in self._poses if p.stamp == stamp and p.state.measured]
        for camera, sight in sights.items():
            self._table.writerow(self._row(stamp, camera, sight, measured[0] if measured else None))
        self._stream.flush()

    def _row(self, stamp: float, camera: int, sight: WoundEstimate, pose: SurfacePose | None) -> list[str | int]:
        from perception.wound.segmentation import area_on_plane

        area = np.nan
        if pose is not None and sight.box is not None:
            area = area_on_plane(sight.mask, self._rig.cameras[camera], pose.base_from_surface)
        visible = sight.box is not None
        middle = [f"{value:.2f}" for value in sight.centroid] if visible else ["", ""]
        return [
            f"{stamp:.6f}", self._rig.cameras[camera].name, int(visible), f"{sight.confidence:.4f}", sight.missed,
            int(sight.mask.sum()), f"{area:.2f}" if np.isfinite(area) else "", *middle, *sight.roi,
        ]  # fmt: skip

    def __enter__(self) -> WoundFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._thread.shutdown(cancel_futures=True)
        self._stream.close()
