"""Records a tracking run with the session it ran on, so that the recording is a session again."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import numpy as np

from estimation.pose import SurfacePose, TrackState
from hardware.files.session import Session
from hardware.heads import TOLERANCE
from hardware.recording.recorder import Recorder
from hardware.recording.schemas import INFO, WARNING
from hardware.tum import rows_from_trajectory
from perception.frames import FrameSet
from perception.tracking.step import StepReport


class TrackRecorder:
    """Writes images, tracks, poses and state changes as they pass, and beside them what the session knows."""

    def __init__(self, path: Path, session: Session, overwrite: bool) -> None:
        """Create the file at `path`; InputError where it exists and `overwrite` is not set."""
        self._recorder = Recorder(path, session.rig, overwrite=overwrite)
        self._truth = np.empty((0, 8)) if session.truth is None else rows_from_trajectory(session.truth)
        self._exact = session.truth is not None and session.truth.exact
        self._heads = session.heads
        self._next_truth, self._next_head = 0, 0
        self._state: TrackState | None = None
        if session.surface is not None:
            self._recorder.surface(session.surface)
        for roi in session.roi:
            self._recorder.write(roi)

    def write(self, frames: FrameSet, pose: SurfacePose, report: StepReport) -> None:
        """One frame set, its pose and tracks, and truth and print heads up to its stamp."""
        self._write_truth(frames.stamp)
        self._write_heads(frames.stamp + TOLERANCE)  # the row of this very frame set included
        for frame in frames.frames:
            self._recorder.write(frame)
        self._recorder.write(report.observations)
        self._recorder.write(pose)
        if pose.state is not self._state:
            level = INFO if pose.state.measured else WARNING
            self._recorder.event(pose.stamp, f"{pose.state.value}: {pose.reason}", level, "tracking")
            self._state = pose.state

    def _write_truth(self, until: float) -> None:
        while self._next_truth < len(self._truth) and self._truth[self._next_truth, 0] <= until:
            self._recorder.truth_row(self._truth[self._next_truth], self._exact)
            self._next_truth += 1

    def _write_heads(self, until: float) -> None:
        """As stored: what a frame set holds of a head has been turned into a matrix."""
        while self._next_head < len(self._heads) and self._heads.rows[self._next_head, 0] <= until:
            self._recorder.head_row(self._heads.rows[self._next_head], bool(self._heads.extruding[self._next_head]))
            self._next_head += 1

    def __enter__(self) -> TrackRecorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        with self._recorder:
            if error is None:
                self._write_truth(np.inf)
                self._write_heads(np.inf)
