"""`stillbed record`: live cameras recorded as a run records them, and shown on a page, without an arm or a path.

Pictures go through the feeds and the recorder process of a live run. Whatever ends it, what was written before is a
recording: Ctrl-C, the page, the end of the time, a disk that is full. A lost camera is left out until it is back.
"""

from __future__ import annotations

import signal
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING

from estimation.errors import InputError
from estimation.rig import Rig
from hardware.cameras.feed import CameraPhase, CameraState, FrameFault
from hardware.cameras.inspection import sharpness
from hardware.files.region_table import ANY_REGION, RegionSettings, check_region
from hardware.live.frame_source import LiveCameraSource, SourceEnded, TimedFrameSet
from hardware.live.ipc import ProcessGroup
from hardware.live.recorder_process import RecorderSender, record
from hardware.live.records import RecorderReport, SetEntry
from hardware.live.settings import LiveSettings
from hardware.offline.track import region_search
from hardware.operator.process import CameraShot, StatusPage
from hardware.operator.shared_state import Polygons, RecordingStage, RecordingView, scene_from
from hardware.operator.view import CameraView, CheckVerdict, Wish
from hardware.process.clock import Clock, WallClock
from hardware.process.progress import Progress
from hardware.process.system import SPAWN, SharedLatest, handled_signals
from perception.frames import FrameSet, region_since

if TYPE_CHECKING:  # who draws no region needs no tracker, which takes two seconds to load
    from perception.tracking.wound_step import FindRegion

FIRST_PICTURE_TIME = 10.0  # s in which cameras open; a recording of so many seconds counts from its first picture
READY_POLL = 0.05  # s between looks at a recorder that starts
PICTURE_WAIT = 0.1  # s of a wait for pictures, after which signals and the page are looked at
VIEW_PERIOD = 0.3  # s between views for the page
SHARPNESS_PERIOD = 1.0  # s between looks at the pictures' sharpness, which takes some ms each
WRITE_TIMEOUT = 30.0  # s in which the recorder writes what waits
BLUNT_SHARE = 0.6  # of the sharpest picture so far, below which a camera is perhaps out of focus
MEGABYTE = 1e6
RECORDER = "recorder"


@dataclass(frozen=True, slots=True)
class RecordOrder:
    """What is to be recorded."""

    rig: Path  # rig.toml of live cameras
    out: Path  # .mcap
    seconds: float | None = None  # None: until somebody ends it
    jpeg_quality: int = 90  # 1 to 100; 0: exact
    region: RegionSettings = ANY_REGION
    page: bool = True


def check_order(order: RecordOrder, force: bool) -> RecordOrder:
    """The order; InputError where it cannot be followed, or would overwrite a file and `force` is not set."""
    source = "command line"
    if order.out.suffix != ".mcap":
        raise InputError(source, "--out", order.out, "a file that ends in .mcap")
    if order.out.exists() and (order.out.is_dir() or not force):
        raise InputError(order.out, "--out", "a file that exists", "a new file, or --force")
    if not order.out.parent.is_dir():
        raise InputError(order.out, "--out", "no such folder", "a file in a folder that exists")
    if order.seconds is not None and not 0 < order.seconds < float("inf"):
        raise InputError(source, "--seconds", order.seconds, "above 0")
    if not 0 <= order.jpeg_quality <= 100:
        raise InputError(source, "--jpeg-quality", order.jpeg_quality, "1 to 100, 0: exact")
    if order.region.drawn and not order.page:
        raise InputError(source, "--no-page", "no corners", "a region with corners, or a page to draw them on")
    return order


class RecordingPage(StatusPage):
    """The page beside a recording."""

    def __init__(self, clock: Clock, rig: Rig) -> None:
        super().__init__(clock, "recording.html")
        self._names = [camera.name for camera in rig.cameras]
        self._view = RecordingView(clock.now(), 1, RecordingStage.RECORD, 0.0, 0, 0, 0)
        self.link.scene.put(scene_from(rig))

    def show(self, view: RecordingView) -> bool:
        """Show the state; its turn is filled in here. Returns whether the end was requested on the page."""
        previous = self._view
        turn = previous.turn + ((previous.stage, previous.draws) != (view.stage, view.draws))
        offers = (Wish.END,) if view.stage is RecordingStage.RECORD else ()
        self._view = replace(view, turn=turn, offers=offers)
        self.link.views.put(self._view)
        return bool(self.wishes(self._view))

    def pictures(self, frames: FrameSet) -> None:
        """Offer the pictures, where anybody has the page open."""
        if self.link.status.windows:
            shots = [CameraShot(self._names[frame.camera], frame.image) for frame in frames.frames]
            self.thumbnailer.offer(frames.stamp, shots)


@dataclass(slots=True)
class Sharpness:
    """How sharp a camera's pictures are, as compared with its sharpest so far."""

    newest: float = nan
    best: float = nan

    def add(self, value: float) -> None:
        """Take the sharpness of one picture."""
        self.newest, self.best = value, value if isnan(self.best) else max(self.best, value)

    @property
    def share(self) -> float:
        """0 to 1; NaN before the first picture."""
        return self.newest / self.best if self.best > 0 else nan


class CameraRecording:
    """One recording. Call it; then `words` has its outcome as a text, and `failed` whether it was cut short."""

    def __init__(self, order: RecordOrder) -> None:
        self.words, self.failed = "", False
        self._order, self._clock = order, WallClock()
        self._signal = 0
        self._processes, self._reports = ProcessGroup(), SharedLatest[RecorderReport]()
        self._start = self._clock.now()
        self._ready_time = self._start  # s, when the recorder had loaded, and pictures were taken
        self._first_stamp = self._last_stamp = nan
        self._sets = self._skipped = 0
        self._counts = Counter[int]()  # of pictures, by camera
        self._interrupted: dict[str, None] = {}  # cameras that were without pictures for a while
        self._view_time = self._sharpness_stamp = -1e9
        self._first_set_time = nan  # s, when the first set was there
        self._page: RecordingPage | None = None
        self._find_region: FindRegion | None = None

    def __call__(self) -> None:
        """Record until the time is over or somebody ends it."""
        with ExitStack() as stack:
            stack.enter_context(handled_signals(self.on_signal))
            self._source = LiveCameraSource(self._order.rig)
            stack.callback(self._source.close)
            rig = self._source.rig
            check_region(self._order.rig, self._order.region, rig)
            self._sharp = [Sharpness() for _ in rig.cameras]
            self._start_recorder(stack)
            self._sender.put(rig)
            if self._order.page:
                self._open_page(stack, rig)
            progress = stack.enter_context(Progress("record", "frame sets", self._clock.now))
            self._wait_for_recorder(progress)
            self._seek_region(stack, rig)
            reason = ""
            while not (reason := self._end_reason()):
                self._cycle(progress)
            self._finish(reason)

    def on_signal(self, number: int) -> None:
        """Handle a signal that asks the recording to end."""
        self._signal = number

    def _start_recorder(self, stack: ExitStack) -> None:
        settings = LiveSettings(record=self._order.out, jpeg_quality=self._order.jpeg_quality)
        theirs, ours = SPAWN.Pipe(duplex=False)
        stack.callback(self._processes.kill_all)
        self._processes.start(RECORDER, record, (settings, [theirs], self._reports), [theirs])
        self._sender = RecorderSender(ours)

    def _wait_for_recorder(self, progress: Progress) -> None:
        """Wait until the recorder is loaded, which takes seconds: its queue has room for few pictures."""
        progress.note = "the recorder starts"
        while self._reports.get() is None and not self._end_reason():
            self._clock.wait_until(self._clock.now() + READY_POLL)
            progress(0, 0)
            self._ready_time = self._clock.now()
        self._source.take(0.0)  # what came meanwhile

    def _open_page(self, stack: ExitStack, rig: Rig) -> None:
        self._page = RecordingPage(self._clock, rig)
        stack.callback(self._page.close)
        print(f"open {self._page.address} to see what is recorded", file=sys.stderr, flush=True)

    def _seek_region(self, stack: ExitStack, rig: Rig) -> None:
        """Record the region, or prepare to find it in the pictures."""
        for roi in self._order.region.rois(rig, self._start):
            self._sender.put(roi)
        drawn = SharedLatest[Polygons]() if self._page is None else self._page.link.regions
        search = region_search(rig, self._order.region, drawn)
        if search is not None:
            self._find_region = search(stack.enter_context(ThreadPoolExecutor(1)))

    def _end_reason(self) -> str:
        """Why it is over, "" while it is not."""
        now, report = self._clock.now(), self._reports.get()
        if self._signal:
            return f"ended by {signal.Signals(self._signal).name}"
        if report is not None and report.failed:
            self.failed = True
            return report.failed
        if not self._processes.alive(RECORDER):
            self.failed = True
            return f"the recorder {self._processes.ending(RECORDER)}; what was written before is kept"
        start = self._ready_time + FIRST_PICTURE_TIME if isnan(self._first_set_time) else self._first_set_time
        if self._order.seconds is not None and now - start >= self._order.seconds:
            return "the time is over"
        return self.words

    def _cycle(self, progress: Progress) -> None:
        try:
            timed_set = self._source.take(PICTURE_WAIT)
        except SourceEnded:
            self.words = "all cameras have ended"
            return
        if timed_set is not None:
            self._take(timed_set)
        now = self._clock.now()
        if now > self._view_time + VIEW_PERIOD:
            self._view_time = now
            self._show(RecordingStage.RECORD)
            progress.note = "; ".join([f"{self._size() / MEGABYTE:.1f} MB", *self._camera_troubles()])
        progress(self._sets, 0)

    def _take(self, timed_set: TimedFrameSet) -> None:
        frames = timed_set.frames
        if isnan(self._first_stamp):
            self._first_stamp, self._first_set_time = frames.stamp, self._clock.now()
        self._last_stamp, self._sets = frames.stamp, self._sets + 1
        self._counts.update(frame.camera for frame in frames.frames)
        self._skipped += timed_set.dropped
        self._sender.put(SetEntry({frame.camera: frame.stamp for frame in frames.frames}, {}, frames.frames))
        if self._page is not None:
            self._page.pictures(frames)
        if frames.stamp > self._sharpness_stamp + SHARPNESS_PERIOD:
            self._sharpness_stamp = frames.stamp
            for frame in frames.frames:
                self._sharp[frame.camera].add(sharpness(frame.image))
        if self._find_region is not None and not isinstance(region := self._find_region(frames), str):
            self._find_region = None
            for roi in region:
                self._sender.put(region_since(roi, roi.stamp))

    # -- what is said of it

    def _size(self) -> int:
        """Bytes on the disk."""
        report = self._reports.get()
        return 0 if report is None else report.written

    def _camera_troubles(self) -> list[str]:
        """The current troubles of cameras; those interrupted after their first picture are remembered for the end."""
        states = [state for state in self._source.health().cameras if state.trouble]
        interrupted = (state.name for state in states if state.given and state.phase is not CameraPhase.ENDED)
        self._interrupted |= dict.fromkeys(interrupted)
        return [state.trouble for state in states]

    def _show(self, stage: RecordingStage, words: str = "") -> None:
        """Show the page the state, and follow what it asks."""
        if self._page is None:
            return
        cameras = tuple(map(self._camera, self._source.health().cameras, self._sharp))
        seconds, dropped = self._clock.now() - self._start, self._sender.dropped
        draws = self._order.region.drawn and self._find_region is not None and stage is RecordingStage.RECORD
        view = RecordingView(
            self._clock.now(), 0, stage, seconds, self._size(), self._sets, dropped, cameras, words, draws=draws
        )
        if self._page.show(view):
            self.words = "ended on the page"

    def _camera(self, state: CameraState, sharp: Sharpness) -> CameraView:
        verdict = CheckVerdict.FAIL if state.trouble else CheckVerdict.PASS
        if not state.trouble and sharp.share < BLUNT_SHARE:
            verdict = CheckVerdict.WARN
        return CameraView(state.name, verdict, state.rate, 0, state.trouble, sharp.share)

    def _finish(self, reason: str) -> None:
        """Have everything written, and describe the recording in `words`."""
        self._sender.close(WRITE_TIMEOUT)
        self._processes.end(RECORDER, WRITE_TIMEOUT)
        report = self._reports.get()
        if report is not None and report.failed and not self.failed:  # the last of it found no place
            self.failed, reason = True, report.failed
        troubles = self._camera_troubles()
        names = [camera.name for camera in self._source.rig.cameras]
        counts = ", ".join(f"{name} {self._counts[k]}" for k, name in enumerate(names))
        lines = [reason, f"{self._order.out}: {self._sets} frame sets ({counts} pictures) {self._span()}"]
        if self._sender.dropped:
            lines.append(f"left out, as they found no room on their way to the disk: {self._sender.dropped}")
        if self._skipped:
            lines.append(f"frame sets left out, as a newer one was there: {self._skipped}")
        if self._interrupted:
            lines.append(f"without pictures for a while: {', '.join(self._interrupted)}")
        lines += filter(None, map(_losses, self._source.health().cameras))
        lines += [f"never came: {state.name}" for state in self._source.health().cameras if not state.given]
        if not self._sets:
            self.failed = True
            self._order.out.unlink(missing_ok=True)
            lines = [reason, "no pictures came, and no file is kept", *troubles]
        self.words = "\n".join(lines)
        self._show(RecordingStage.FAILED if self.failed else RecordingStage.ENDED, self.words)

    def _span(self) -> str:
        seconds = self._last_stamp - self._first_stamp
        return f"of {seconds:.1f} s, {self._size() / MEGABYTE:.1f} MB"


def _losses(state: CameraState) -> str:
    """How many pictures of a camera were left out, as parts of them were lost on the way; "" for none."""
    count, transport = state.faults.get(FrameFault.INCOMPLETE, 0), state.transport
    if transport is None or not (count or transport.frames_lost):
        return ""
    lost_text = f", and {transport.frames_lost} lost altogether" if transport.frames_lost else ""
    return f"{state.name}: {count} pictures left out, as packets were missing ({transport.lost}){lost_text}"
