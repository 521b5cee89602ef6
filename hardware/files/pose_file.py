"""poses.tum and poses.csv: what a tracking run leaves behind, written line by line and read back.

`poses.tum` holds the measured poses only, as evo reads them: `stamp x y z qx qy qz qw`, s and mm. `poses.csv` holds one
line per frame set: stamp, frames given, pose, upper triangle of the covariance, twist, whether it moves, state, tracks
per camera, the cameras' clocks, milliseconds per stage, reason. Every line is flushed, so a killed run leaves whole
lines.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.process import checks
from perception.tracking.step import StepReport

TANGENT = ("rx", "ry", "rz", "tx", "ty", "tz")
_UPPER = np.triu_indices(6)
_POSE = ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
_COVARIANCE = tuple(f"cov_{TANGENT[i]}_{TANGENT[j]}" for i, j in zip(*_UPPER, strict=True))
_TWIST = ("wx_rad_s", "wy_rad_s", "wz_rad_s", "vx_mm_s", "vy_mm_s", "vz_mm_s")
_MOTION = ("moving", "onset_s", "moved_mm", "turned_deg")
_DEFORMATION = ("deformation_mm", "deformation_sigma_mm")
_HEAD = ("stamp_s", "frames", *_POSE, *_COVARIANCE, *_TWIST, *_MOTION, *_DEFORMATION, "state", "cameras")
_STATES = tuple(state.value for state in TrackState)


@dataclass(frozen=True, slots=True, eq=False)
class PoseTable:
    """A run as parallel arrays, one row per frame set.

    stamps: (N,) s. frames: (N,) images given. base_from_surface: (N, 4, 4) mm. covariance: (N, 6, 6) and twist:
    (N, 6) as in SurfacePose. moving: (N,), onset: (N,) s, NaN before the first, moved: (N,) mm and turned: (N,) rad, as
    in SurfaceMotion. deformation, deformation_sigma: (N,) mm, 0 where there is no warp. states: N of TrackState. used:
    (N, C) tracks that carry the pose, per camera. offsets, offset_sigmas: (N, C) s, as in StepReport.
    seconds: (N, S + 1) per stage and in all. reasons: N sentences. cameras: C names. stages: S + 1 names, the last
    "total".
    """

    stamps: Array
    frames: NDArray[np.int64]
    base_from_surface: Array
    covariance: Array
    twist: Array
    moving: NDArray[np.bool_]
    onset: Array
    moved: Array
    turned: Array
    deformation: Array
    deformation_sigma: Array
    states: tuple[TrackState, ...]
    used: NDArray[np.int64]
    offsets: Array
    offset_sigmas: Array
    seconds: Array
    reasons: tuple[str, ...]
    cameras: tuple[str, ...]
    stages: tuple[str, ...]

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
                *_HEAD,
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
    if tuple(head[: len(_HEAD)]) != _HEAD or head[-1:] != ["reason"]:
        raise InputError(path, "header", ",".join(head[:4]), f"{','.join(_HEAD[:4])}, ...")
    body = rows[1:]
    if body and len(body[-1]) != len(head):
        body = body[:-1]
    return _table(path, head, body)


def _table(path: Path, head: list[str], body: list[list[str]]) -> PoseTable:
    cameras = tuple(name.removeprefix("tracks_") for name in head if name.startswith("tracks_"))
    stages = tuple(name.removeprefix("ms_") for name in head if name.startswith("ms_"))
    learned = head[len(_HEAD) + len(cameras) : len(head) - 1 - len(stages)]
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
