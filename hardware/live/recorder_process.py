"""The recorder of a live run: each process's queue of entries to it, and the process that writes them to the file.

A sender never waits: it queues a bounded number of bytes and counts the entries without space. Pixels are
copied twice, into the pipe and out of it. All processes of a run import this module; the modules that
write files are imported only in the recorder's process.
"""

from __future__ import annotations

import fcntl
import os
import pickle
import struct
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from copy import deepcopy
from functools import partial
from multiprocessing.connection import Connection
from selectors import EVENT_READ, BaseSelector, DefaultSelector
from typing import TYPE_CHECKING

import numpy as np

from estimation.errors import StillbedError
from estimation.pose import Trajectory
from estimation.rig import Rig
from estimation.runtime import retain_freed_pages
from hardware.live.records import (
    Entry,
    EventEntry,
    LatencyEntry,
    PlacedScanEntry,
    PoseEntry,
    RecorderReport,
    ScanEntry,
    SetEntry,
    SurfaceEntry,
    UsedEntry,
    UsedPoses,
    WireEntry,
)
from hardware.live.settings import LiveSettings, used_files
from hardware.live.trace import MIN_WRITE_S, RECORDER_LANE, TraceBatch, TraceLane
from hardware.motion.loop import DispenserRecord, RecordedTick
from hardware.process.clock import ProcessorClock, WallClock, utc_now
from hardware.process.system import SharedLatest, catch_up, set_up_process, state_inputs
from hardware.recording.loop_record import LoopRecord
from perception.frames import OutlinedPicture, Roi
from planning.laid_beads import Look

if TYPE_CHECKING:
    from hardware.recording.recorder import Recorder

ENTRY_HEAD = struct.Struct("=QQ")  # number of following bytes (sizes of the arrays, arrays, entry); number of arrays
ARRAY_SIZE = struct.Struct("=Q")  # bytes of an array outside its entry
PIPE_BYTES = 2**20  # capacity of a pipe: 0.1 s of three cameras' pictures, the most that Linux allows
CROWDED_SHARE = 0.9  # of the capacity: above it a sender may be waiting
QUEUE_BYTES = 48 * 2**20  # capacity of a sender's queue: 3 s of three cameras' encoded pictures
RESERVED_BYTES = 8 * 2**20  # of the queue, reserved for small entries
FLUSH_AFTER = 0.2  # s without new entries before a flush to the disk
GATHER_TIME = 0.08  # s to collect entries: one at a time took twice the processor time
FREE_PAGES_BYTES = 2**25  # bytes of free pages to retain: some chunks, glibc's maximum
RECORDER_NICENESS = 10  # below the processes that move the arm, unless senders wait


class RecorderSender:
    """One process's queue to the recorder.

    dropped: entries without room, after the recorder has ended, or not sent when this was closed.
    failed: the error that ended the sending thread, except the recorder's end; "" without an error. The owner of the
        sender checks it, and ends the run.
    """

    def __init__(self, connection: Connection) -> None:
        self.dropped, self.failed = 0, ""
        self._connection = connection
        self._waiting: deque[list[memoryview]] = deque()
        self._size, self._closed, self._ended = 0, False, False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def put(self, entry: Entry) -> None:
        """Queue an entry. Pixels are not copied: a picture must not be changed after this."""
        parts, pictures = packed(entry), isinstance(entry, SetEntry)
        size = sum(map(len, parts))
        with self._changed:
            if self._ended or self._size + size > QUEUE_BYTES - RESERVED_BYTES * pictures:
                self.dropped += 1
                return
            self._waiting.append(parts)
            self._size += size
            self._changed.notify()

    def close(self, patience: float = 5.0) -> None:
        """Send the queue, for `patience` s at most, and close the pipe. The rest is lost, and counted."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(patience)
        with self._changed:
            self._ended = True
            self.dropped += len(self._waiting) + self._thread.is_alive()
            self._waiting.clear()

    def _send(self) -> None:
        try:
            while (unsent := self._next()) is not None:
                while unsent:
                    sent = os.writev(self._connection.fileno(), unsent)
                    while unsent and sent >= len(unsent[0]):
                        sent -= len(unsent.pop(0))
                    unsent[:1] = [part[sent:] for part in unsent[:1]]
        except (OSError, ValueError):  # the recorder has ended
            pass
        except Exception as error:
            self.failed = f"{type(error).__name__}: {error}"
        finally:
            with self._changed:
                self._ended = True
                self.dropped += len(self._waiting)
                self._waiting.clear()
            self._connection.close()

    def check(self) -> None:
        """StillbedError if the sending thread has failed."""
        if self.failed:
            raise StillbedError(f"the recording has failed: {self.failed}")

    def _next(self) -> list[memoryview] | None:
        """Wait for the next entry's parts; None if this is closed and empty."""
        with self._changed:
            while not self._waiting:
                if self._closed:
                    return None
                self._changed.wait()
            parts = self._waiting.popleft()
            self._size -= sum(map(len, parts))
            return parts


def packed(entry: Entry) -> list[memoryview]:
    """The parts of an entry in the pipe: its head, its pictures' pixels, and the rest."""
    arrays = list[pickle.PickleBuffer]()
    rest = pickle.dumps(entry, 5, buffer_callback=arrays.append if isinstance(entry, SetEntry) else None)
    pixels = [array.raw() for array in arrays]
    sizes = b"".join(ARRAY_SIZE.pack(len(part)) for part in pixels)
    head = ENTRY_HEAD.pack(len(sizes) + sum(map(len, pixels)) + len(rest), len(pixels)) + sizes
    return [memoryview(head), *pixels, memoryview(rest)]


def unpacked(data: memoryview, arrays: int) -> Entry:
    """The entry in the data after its head. Its pixels are those in `data`, not copied."""
    begin, parts = ARRAY_SIZE.size * arrays, list[memoryview]()
    for (size,) in ARRAY_SIZE.iter_unpack(data[:begin]):
        parts.append(data[begin : begin + size])
        begin += size
    entry: Entry = pickle.loads(data[begin:], buffers=parts)
    return entry


class RecorderReceiver:
    """The recorder's end of a sender's pipe.

    ended: whether the sender has closed its end, and all its entries were returned or truncated.
    crowded: whether the pipe was nearly full at the last read.
    """

    def __init__(self, connection: Connection) -> None:
        self.ended, self.crowded = False, False
        self._connection = connection
        self._memory, self._filled = bytearray(2 * PIPE_BYTES), 0
        with suppress(OSError):  # a smaller pipe takes more turns
            fcntl.fcntl(connection.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._room = fcntl.fcntl(connection.fileno(), fcntl.F_GETPIPE_SZ)

    def fileno(self) -> int:
        """The file descriptor of the pipe, for a selector."""
        return self._connection.fileno()

    def take(self) -> Iterator[Entry]:
        """The complete entries since the last call; waits for the first one.

        An entry's pixels are valid until the next entry.
        """
        with memoryview(self._memory) as memory:
            count = os.readv(self._connection.fileno(), [memory[self._filled :]])
        self.ended, self.crowded = count == 0, count > CROWDED_SHARE * self._room
        self._filled += count
        begin, needed = 0, ENTRY_HEAD.size
        with memoryview(self._memory) as memory:
            while begin + ENTRY_HEAD.size <= self._filled:
                size, arrays = ENTRY_HEAD.unpack_from(memory, begin)
                needed = ENTRY_HEAD.size + size
                if begin + needed > self._filled:
                    break
                yield unpacked(memory[begin + ENTRY_HEAD.size : begin + needed], arrays)
                begin += needed
                needed = ENTRY_HEAD.size
            incomplete = memory[begin : self._filled]  # the part of the next entry
            if needed > len(memory):
                self._memory = bytearray(incomplete) + bytes(needed)
            elif begin:
                memory[: len(incomplete)] = incomplete
        self._filled -= begin


def record(settings: LiveSettings, senders: Sequence[Connection], reports: SharedLatest[RecorderReport]) -> None:
    """The body of the process: record until all senders have closed their end.

    A disk error ends it, and is in the last report.
    """
    set_up_process("recorder", settings.cores_recorder, RECORDER_NICENESS, outlives=True)
    state_inputs(used_files(settings), settings.operator)
    retain_freed_pages(FREE_PAGES_BYTES)
    try:
        writer = _EntryWriter(settings, reports)
    except StillbedError as error:
        reports.put(RecorderReport(0, 0.0, str(error)))
        return
    try:
        writer.run([RecorderReceiver(sender) for sender in senders])
    except StillbedError as error:
        writer.report(str(error))
    finally:
        try:
            writer.close()
        except StillbedError as error:
            writer.report(str(error))


class _EntryWriter:
    """Writes entries to the file, which is opened with the rig; earlier entries wait."""

    def __init__(self, settings: LiveSettings, reports: SharedLatest[RecorderReport]) -> None:
        from hardware.recording.recorder import Recorder  # a slow import, before pictures arrive

        assert settings.record is not None
        self._file, self._reports, quality = settings.record, reports, settings.jpeg_quality or None
        self._clock, self._processor = WallClock(), ProcessorClock()
        start_ns = round((utc_now() - self._clock.now()) * 1e9)
        self._server, listener = None, None
        if settings.foxglove_port:
            from hardware.operator.process import FoxgloveServer

            self._server = FoxgloveServer(settings.foxglove_port)
            listener = self._server.publish
        opened = partial(Recorder, self._file, jpeg_quality=quality, overwrite=True, compress=False)
        self._opened = partial(opened, began=start_ns, listener=listener)
        self._lane = TraceLane(RECORDER_LANE, self._clock, self._write) if settings.trace else None
        self._begin = self._clock.now(), self._processor.now()
        self._recorder: Recorder | None = None
        self._used, self._tracked = UsedPoses(()), -np.inf  # stamp, s, of the tracking process's last pose
        self._pending, self._failed, self._reported = list[Entry](), "", 0.0
        self._urgent = settings.real_time  # raise the priority when senders wait
        self.report()  # ready for pictures

    def run(self, senders: Sequence[RecorderReceiver]) -> None:
        """Write entries until all senders have ended."""
        with DefaultSelector() as selector:
            for sender in senders:
                selector.register(sender, EVENT_READ)
            crowded = False
            while selector.get_map():
                if not selector.select(FLUSH_AFTER) and self._recorder is not None:
                    self._recorder.flush()
                elif not crowded:
                    self._clock.wait_until(self._clock.now() + GATHER_TIME)
                start = self._clock.now()
                previous, crowded = crowded, any([self._take(key.fileobj, selector) for key, _ in selector.select(0)])
                if crowded != previous and self._urgent:
                    catch_up(crowded)
                if self._lane is not None and (now := self._clock.now()) > start + MIN_WRITE_S:
                    self._lane.add(now, (("a batch is written", start, now),))
                if self._clock.now() > self._reported + FLUSH_AFTER:
                    self.report()

    def _take(self, sender: object, selector: BaseSelector) -> bool:
        """Write the entries of a sender; whether it may be waiting to send more."""
        assert isinstance(sender, RecorderReceiver)
        for entry in sender.take():
            self._write(entry)
        if sender.ended:
            selector.unregister(sender)
        return sender.crowded

    def _write(self, entry: Entry) -> None:
        if isinstance(entry, Rig):
            self._recorder = self._opened(rig=entry)
            pending, self._pending = self._pending, []
            for each in pending:
                _write_entry(self._recorder, each)
        elif self._recorder is None:
            self._pending.append(deepcopy(entry))  # its pixels belong to the pipe
        elif isinstance(entry, UsedPoses):
            self._used = entry
        else:
            self._tracked = entry.pose.stamp if isinstance(entry, PoseEntry) else self._tracked
            _write_entry(self._recorder, entry)

    def report(self, failed: str = "") -> None:
        """Report the state. failed: the error that ended the recording."""
        now, cpu_time = self._clock.now(), self._processor.now()
        self._failed, self._reported = self._failed or failed, now
        share = (cpu_time - self._begin[1]) / max(now - self._begin[0], 1e-3)
        size = self._file.stat().st_size if self._recorder is not None and self._file.exists() else 0
        self._reports.put(RecorderReport(size, share, self._failed))

    def close(self) -> None:
        """Close the file, and report."""
        if self._server is not None:
            self._server.close()
        if self._lane is not None:
            self._lane.close()
        if self._recorder is not None:
            for pose in (each for each in self._used.poses if each.stamp > self._tracked):
                self._recorder.write(pose)
            self._recorder.close()
        self.report()


def _write_entry(recorder: Recorder, entry: Entry) -> None:
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
        recorder.latency(entry.stamp, entry.stage, entry.width, entry.counts, entry.largest)
    elif isinstance(entry, TraceBatch):
        recorder.trace(entry.entries[-1].stamp, entry.message)
    elif isinstance(entry, UsedEntry):
        _write_used(recorder, entry)
    elif isinstance(entry, SurfaceEntry):
        recorder.show_surface(entry.stamp, entry.landmarks, entry.outlines)
    elif isinstance(entry, PlacedScanEntry):
        recorder.show_scan(entry.stamp, entry.points)
    elif isinstance(entry, ScanEntry):
        recorder.surface(entry.file)
    elif isinstance(entry, Roi | OutlinedPicture | LoopRecord | DispenserRecord | Look):
        recorder.write(entry)


def _write_used(recorder: Recorder, entry: UsedEntry) -> None:
    """Attach the file; also show the path, now in the tracker's surface frame, and the arm's nozzle."""
    from hardware.files.arm_file import arm_from_text
    from hardware.files.path_file import path_from_text
    from hardware.recording.session_reader import ARM_ATTACHMENT, PATH_ATTACHMENT

    recorder.attach(entry.name, entry.text.encode())
    if entry.name == ARM_ATTACHMENT:
        recorder.show_arm(arm_from_text(entry.text, ARM_ATTACHMENT))
    if entry.name == PATH_ATTACHMENT:
        points = path_from_text(entry.text, PATH_ATTACHMENT).surface_from_nozzle[:, :3, 3]
        recorder.show_path(WallClock().now(), points, np.arange(len(points), dtype=float))


def _write_pose(recorder: Recorder, entry: PoseEntry) -> None:
    from hardware.files.folder_tables import rows_from_trajectory
    from hardware.files.session import row_from_head

    if entry.truth is not None:
        truth = Trajectory(np.array([entry.pose.stamp]), entry.truth[None], exact=True)
        recorder.truth_row(rows_from_trajectory(truth)[0], exact=True)
    if entry.head is not None:
        recorder.head_row(row_from_head(entry.pose.stamp, entry.head), entry.head.extruding, shown=False)
    recorder.write(entry.observations)
    recorder.write(entry.pose)
