"""The body of the recorder's process: takes what the others give, writes it, and never makes anybody wait."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from selectors import EVENT_READ, BaseSelector, DefaultSelector

import numpy as np

from estimation.errors import StillbedError
from estimation.heap import keep_pages
from estimation.rig import Rig
from estimation.trajectory import Trajectory
from hardware.heads import row_from_head
from hardware.live.inbox import Inbox
from hardware.live.records import (
    Entry,
    EventEntry,
    LatencyEntry,
    PoseEntry,
    RecorderReport,
    RigEntry,
    RoiEntry,
    ScanEntry,
    SetEntry,
    UsedEntry,
    WireEntry,
)
from hardware.process.clock import ProcessorClock, WallClock
from hardware.process.shared_latest import Newest
from hardware.process.system import settle
from hardware.recorded_tick import RecordedTick
from hardware.recording.recorder import Recorder
from hardware.tum import rows_from_trajectory

QUIET = 0.2  # s without anything new after which what is there goes to the disk
GATHER = 0.08  # s that what comes may gather: woken for each entry, this process took twice as long for all of them
KEPT = 2**25  # bytes of free pages that are kept: some chunks, as glibc allows at most
NICE = 10  # below all that moves the arm


@dataclass(frozen=True, slots=True)
class RecorderPlan:
    """Where to write. jpeg_quality: 0 to 100 of pictures that come as arrays, None to keep them exactly."""

    file: Path
    jpeg_quality: int | None
    overwrite: bool
    cores: tuple[int, ...] = ()


def recorder_process(plan: RecorderPlan, senders: Sequence[Connection], reports: Newest[RecorderReport]) -> None:
    """Record until all senders have closed their end; a fault of the disk ends it, said in the last report."""
    settle("recorder", plan.cores, NICE)
    keep_pages(KEPT)
    writer = _Writer(plan, reports)
    try:
        writer.run([Inbox(sender) for sender in senders])
    except StillbedError as error:
        writer.tell(str(error))
    finally:
        try:
            writer.close()
        except StillbedError as error:
            writer.tell(str(error))


class _Writer:
    """Writes entries once the rig is known, and what came before it then."""

    def __init__(self, plan: RecorderPlan, reports: Newest[RecorderReport]) -> None:
        self._plan, self._reports = plan, reports
        self._clock, self._processor = WallClock(), ProcessorClock()
        self._begin = self._clock.now(), self._processor.now()
        self._recorder: Recorder | None = None
        self._early: list[Entry] = []
        self._failed = ""
        self._said = 0.0

    def run(self, senders: Sequence[Inbox]) -> None:
        """Take entries until nobody is left to give any."""
        with DefaultSelector() as left:
            for sender in senders:
                left.register(sender, EVENT_READ)
            crowded = False
            while left.get_map():
                if not left.select(QUIET) and self._recorder is not None:
                    self._recorder.flush()
                elif not crowded:
                    self._clock.wait_until(self._clock.now() + GATHER)
                crowded = any([self._take(key.fileobj, left) for key, _ in left.select(0)])
                if self._clock.now() > self._said + QUIET:
                    self.tell()

    def _take(self, sender: object, left: BaseSelector) -> bool:
        """Write what a sender has given, or know that it gives no more; whether it may be waiting to give more."""
        assert isinstance(sender, Inbox)
        for entry in sender.take():
            self.write(entry)
        if sender.ended:
            left.unregister(sender)
        return sender.crowded

    def write(self, entry: Entry) -> None:
        """Write one entry."""
        if isinstance(entry, RigEntry):
            self._open(entry.rig)
        elif self._recorder is None:
            self._early.append(entry)
        else:
            _write(self._recorder, entry)

    def _open(self, rig: Rig) -> None:
        plan = self._plan
        self._recorder = Recorder(plan.file, rig, plan.jpeg_quality, plan.overwrite, compress=False)
        early, self._early = self._early, []
        for entry in early:
            _write(self._recorder, entry)

    def tell(self, failed: str = "") -> None:
        """Say how it fares."""
        now, spent = self._clock.now(), self._processor.now()
        self._failed, self._said = self._failed or failed, now
        share = (spent - self._begin[1]) / max(now - self._begin[0], 1e-3)
        size = self._plan.file.stat().st_size if self._recorder is not None and self._plan.file.exists() else 0
        self._reports.put(RecorderReport(now, size, share, self._failed))

    def close(self) -> None:
        """Close the file, and say so."""
        if self._recorder is not None:
            self._recorder.close()
        self.tell()


def _write(recorder: Recorder, entry: Entry) -> None:
    if isinstance(entry, SetEntry):
        for camera, (kind, data) in entry.encoded.items():
            recorder.encoded_frame(camera, entry.stamps[camera], kind, data)
        for frame in entry.frames:
            recorder.frame(frame)
    elif isinstance(entry, PoseEntry):
        _write_pose(recorder, entry)
    elif isinstance(entry, RecordedTick):
        recorder.write(entry.command)
        recorder.write(entry)
    elif isinstance(entry, WireEntry):
        (recorder.sent if entry.sent else recorder.received)(entry.stamp, entry.data)
    elif isinstance(entry, EventEntry):
        recorder.event(entry.stamp, entry.text, entry.level, entry.name)
    elif isinstance(entry, LatencyEntry):
        recorder.latency(entry.stamp, entry.stage, entry.width, entry.counts, entry.most)
    elif isinstance(entry, UsedEntry):
        recorder.attach(entry.name, entry.text.encode())
    elif isinstance(entry, ScanEntry):
        recorder.surface(entry.file)
    elif isinstance(entry, RoiEntry):
        recorder.write(entry.roi)


def _write_pose(recorder: Recorder, entry: PoseEntry) -> None:
    stamp = entry.pose.stamp
    if entry.truth is not None:
        known = Trajectory(np.array([stamp]), entry.truth[None], exact=True)
        recorder.truth_row(rows_from_trajectory(known)[0], exact=True)
    if entry.head is not None:
        recorder.head_row(row_from_head(stamp, entry.head), entry.head.extruding)
    recorder.write(entry.observations)
    recorder.write(entry.pose)
