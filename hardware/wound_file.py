"""wound.csv of a run: what each camera saw of the wound, at the segmentation's own pace."""

from __future__ import annotations

import csv
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType

import numpy as np

from estimation.pose import SurfacePose
from estimation.rig import Rig
from perception.frames import FrameSet
from perception.tracking.step import StepReport
from perception.wound.segmentation import Segmenter
from perception.wound_beside import DELAY, WoundBeside
from perception.wound_region import area_on_plane
from perception.wound_watch import Sight

FILE = "wound.csv"
HEAD = (
    "stamp_s", "camera", "wound", "confidence", "missed", "area_px", "area_mm2", "centroid_x_px", "centroid_y_px",
    "roi_x0_px", "roi_y0_px", "roi_x1_px", "roi_y1_px",
)  # fmt: skip


class WoundFile:
    """Segments beside a run, in one thread, and writes what it finds; a sink of `hardware.offline.track.follow`."""

    def __init__(self, folder: Path, rig: Rig, segmenter: Segmenter) -> None:
        self._rig, self._thread = rig, ThreadPoolExecutor(1)
        self._beside = WoundBeside(rig, segmenter, self._thread)
        self._poses: deque[SurfacePose] = deque(maxlen=DELAY + 1)
        self._stream = (folder / FILE).open("w", newline="", encoding="utf-8")
        self._table = csv.writer(self._stream, lineterminator="\n")
        self._table.writerow(HEAD)

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

    def _row(self, stamp: float, camera: int, sight: Sight, pose: SurfacePose | None) -> list[str | int]:
        area = np.nan
        if pose is not None and sight.box is not None:
            area = area_on_plane(sight.mask, self._rig.cameras[camera], pose.base_from_surface)
        seen = sight.box is not None
        middle = [f"{value:.2f}" for value in sight.centroid] if seen else ["", ""]
        return [
            f"{stamp:.6f}", self._rig.cameras[camera].name, int(seen), f"{sight.confidence:.4f}", sight.missed,
            int(sight.mask.sum()), f"{area:.2f}" if np.isfinite(area) else "", *middle, *sight.roi,
        ]  # fmt: skip

    def __enter__(self) -> WoundFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._thread.shutdown(cancel_futures=True)
        self._stream.close()
