"""poses.tum, poses.csv and wound.csv: what a tracking run leaves behind, written line by line and read back.

`poses.tum` holds the measured poses only, as evo reads them: `stamp x y z qx qy qz qw`, s and mm. `poses.csv` holds one
line per frame set: stamp, number of images, pose, upper triangle of the covariance, twist, motion, state, tracks per
camera, the cameras' clocks, milliseconds per stage, reason. Every line is flushed, so a killed run leaves whole lines.
`wound.csv` holds the wound as each camera shows it, at the segmentation's own pace.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.files.folder_tables import csv_table
from hardware.process import checks
from perception.frames import FrameSet

if TYPE_CHECKING:  # who only reads poses needs no tracker, which takes two seconds to load
    from perception.tracking.step import StepReport
    from perception.tracking.wound_step import WoundEstimate
    from perception.wound.segmentation import Segmenter

TANGENT_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
UPPER_TRIANGLE = np.triu_indices(6)
TRANSFORM_COLUMNS = ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
COVARIANCE_COLUMNS = tuple(f"cov_{TANGENT_NAMES[i]}_{TANGENT_NAMES[j]}" for i, j in zip(*UPPER_TRIANGLE, strict=True))
TWIST_COLUMNS = ("wx_rad_s", "wy_rad_s", "wz_rad_s", "vx_mm_s", "vy_mm_s", "vz_mm_s")
_MOTION = ("moving", "onset_s", "moved_mm", "turned_deg")
_DEFORMATION = ("deformation_mm", "deformation_sigma_mm")
_POSE_TABLE_COLUMNS = (
    *("stamp_s", "frames", *TRANSFORM_COLUMNS, *COVARIANCE_COLUMNS, *TWIST_COLUMNS),
    *(*_MOTION, *_DEFORMATION, "state", "cameras"),
)
_STATES = tuple(state.value for state in TrackState)


@dataclass(frozen=True, slots=True, eq=False)
class PoseTable:
    """A run as parallel arrays, one row per frame set: N frame sets, C cameras, S stages of the tracking step."""

    stamps: Array  # (N,) s
    frames: NDArray[np.int64]  # (N,) number of images
    base_from_surface: Array  # (N, 4, 4) mm
    covariance: Array  # (N, 6, 6), as in SurfacePose
    twist: Array  # (N, 6), as in SurfacePose
    moving: NDArray[np.bool_]  # (N,), as in MotionState like the next three
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


class PoseWriter(ExitStack):
    """Writes poses.csv and poses.tum into a folder, a flushed line at a time; closes them as a context manager."""

    def __init__(self, folder: Path, cameras: Sequence[str], stages: Sequence[str]) -> None:
        super().__init__()
        of_cameras = [*(f"tracks_{name}" for name in cameras), *_clock_names(cameras)]
        of_stages = [f"ms_{stage}" for stage in (*stages, "total")]
        table_columns = [*_POSE_TABLE_COLUMNS, *of_cameras, *of_stages, "reason"]
        self._write_row = self.enter_context(csv_table(folder / "poses.csv", table_columns))
        self._tum_file = self.enter_context((folder / "poses.tum").open("w", encoding="utf-8"))
        self._tum_file.write("# base_from_surface: stamp_s x y z qx qy qz qw (mm)\n")
        self._tum_file.flush()  # a run that is cut short before its first pose is read back, too

    def write(self, pose: SurfacePose, frames: int, report: StepReport, total: float) -> None:
        """Write one frame set. frames: number of its images. total: s that the whole step took."""
        quaternion = se3.quaternion_from_rotation(pose.base_from_surface[:3, :3])
        transform = [*(f"{v:.6f}" for v in pose.base_from_surface[:3, 3]), *(f"{v:.12f}" for v in quaternion)]
        covariance_and_twist = [f"{v:.9g}" for v in (*pose.covariance[UPPER_TRIANGLE], *pose.twist)]
        moved = [pose.motion.onset, pose.motion.distance, np.rad2deg(pose.motion.angle)]
        deformation = [0.0, 0.0] if pose.warp is None else [pose.warp.deformation, pose.warp.deformation_sigma]
        motion = [int(pose.motion.moving), *(f"{v:.6f}" for v in (*moved, *deformation))]
        tracks = [int(n) for n in report.used]
        in_ms = np.round(1000 * np.concatenate([report.offsets, report.offset_sigmas]), 4) + 0.0  # + 0.0: no -0.0000
        times = [f"{v:.4f}" for v in (*in_ms, *(1000 * s for s in (*report.seconds, total)))]
        state = [pose.state.value, int(np.count_nonzero(tracks)), *tracks]
        row = [f"{pose.stamp:.6f}", frames, *transform, *covariance_and_twist, *motion, *state, *times, pose.reason]
        self._write_row(row)
        if pose.state.measured:
            self._tum_file.write(f"{pose.stamp:.6f} {' '.join(transform)}\n")
            self._tum_file.flush()


def _clock_names(cameras: Sequence[str]) -> list[str]:
    return [f"{column}{name}" for column in ("offset_ms_", "offset_sigma_ms_") for name in cameras]


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
    clock_columns = head[len(_POSE_TABLE_COLUMNS) + len(cameras) : len(head) - 1 - len(stages)]
    if clock_columns not in ([], _clock_names(cameras)):
        raise InputError(path, "header", ",".join(clock_columns), ",".join(_clock_names(cameras)))
    state_column = head.index("state")
    for number, row in enumerate(body, start=2):
        if len(row) != len(head):
            raise InputError(path, f"line {number}", f"{len(row)} columns", f"{len(head)} columns")
        if row[state_column] not in _STATES:
            raise InputError(path, f"line {number}: state", row[state_column], ", ".join(_STATES))
    numbers = _numbers(path, head, [row[:state_column] + row[state_column + 1 : -1] for row in body])
    stamps, frames, positions, quaternions, upper, twist, motion, deformation, cameras_used, used, times = np.split(
        numbers, np.cumsum([1, 1, 3, 4, 21, 6, len(_MOTION), len(_DEFORMATION), 1, len(cameras)]), axis=1
    )
    del cameras_used  # it is np.count_nonzero(used, 1)
    clocks, milliseconds = np.split(times, [-len(stages)], axis=1)
    if not clock_columns:
        clocks = np.tile(np.repeat([0.0, np.nan], len(cameras)), (len(body), 1))
    offsets, offset_sigmas = np.split(clocks / 1000, [len(cameras)], axis=1)
    covariance = np.zeros((len(body), 6, 6))
    rows, columns = UPPER_TRIANGLE
    covariance[:, rows, columns] = covariance[:, columns, rows] = upper
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


class WoundFile(ExitStack):
    """Segments the wound in a thread of its own and writes wound.csv; a sink of `hardware.offline.track.follow`."""

    def __init__(self, folder: Path, rig: Rig, segmenter: Segmenter) -> None:
        from perception.tracking.wound_step import SEGMENTATION_DELAY_SETS, AsyncSegmentation  # loads onnxruntime

        super().__init__()
        self._rig, thread = rig, ThreadPoolExecutor(1)
        self._segmentation = AsyncSegmentation(rig, segmenter, thread)
        self._poses: deque[SurfacePose] = deque(maxlen=SEGMENTATION_DELAY_SETS + 1)
        self._write_row = self.enter_context(csv_table(folder / WOUND_FILE_NAME, WOUND_COLUMNS))
        self.callback(thread.shutdown, cancel_futures=True)

    def write(self, frames: FrameSet, pose: SurfacePose, report: StepReport) -> None:
        """One frame set and its pose; writes rows of earlier pictures once their segmentation is done."""
        self._poses.append(pose)
        done = self._segmentation(frames)
        if done is None:
            return
        stamp, estimates = done
        measured = next((p for p in self._poses if p.stamp == stamp and p.state.measured), None)
        for camera, estimate in estimates.items():
            self._write_row(self._row(stamp, camera, estimate, measured))

    def _row(self, stamp: float, camera: int, wound: WoundEstimate, pose: SurfacePose | None) -> list[str | int]:
        from perception.wound.segmentation import area_on_plane

        area, visible = np.nan, wound.box is not None
        if pose is not None and visible:
            area = area_on_plane(wound.mask, self._rig.cameras[camera], pose.base_from_surface)
        middle = [f"{value:.2f}" for value in wound.centroid] if visible else ["", ""]
        return [
            f"{stamp:.6f}", self._rig.cameras[camera].name, int(visible), f"{wound.confidence:.4f}", wound.missed,
            int(wound.mask.sum()), f"{area:.2f}" if np.isfinite(area) else "", *middle, *wound.roi,
        ]  # fmt: skip
