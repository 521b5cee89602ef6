"""One camera: opened, locked, grabbed from, checked, and opened again after a failure; and its state in records."""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum

import numpy as np

from estimation.errors import StillbedError
from hardware.cameras.capture import Capture, CaptureOpener, Control, Transport, locked_exposure, open_by_opencv
from hardware.cameras.sources import CameraSource, SourceKind
from hardware.cameras.stamping import FrameStamp, FrameStamper
from hardware.process.clock import Clock
from perception.frames import DuplicateFilter, Frame, Image, StampedBy

SAMPLE_STRIDE = 8  # every eighth row and column is checked for black
BLACK_LEVEL = 20  # grey level: a covered sensor's noise stays below, and limited-range black is 16
MIN_LIT_SHARE = 0.01  # of brighter pixels, from which a picture is not black
STALL_AFTER = 0.5  # s without a frame, after which an open camera has stalled
BACK_OFF, MAX_BACK_OFF = 0.1, 2.0  # s between attempts to open, doubled each time
MAX_WAIT = 0.1  # s, longest wait before `close` is noticed
MAX_DAMAGED_FRAMES = 30  # in a row, after which a camera is opened again


class FrameFault(Enum):
    """Why a frame is left out; the text follows a camera's name."""

    INCOMPLETE = "sends pictures with packets missing"
    DAMAGED = "sends pictures that cannot be decoded"
    WRONG_SIZE = "sends pictures of another size"
    DUPLICATED = "sends the same stamp again"
    BACKLOG = "sends what had been held up"
    FROZEN = "shows the same picture again"
    BLACK = "shows black"


class FrameWatch:
    """Checks one camera's frames. size: required (W, H) px; None: any."""

    def __init__(self, size: tuple[int, int] | None) -> None:
        self._size, self._fresh, self._position = size, DuplicateFilter(), math.nan

    def repeats(self, position: float) -> bool:
        """Whether the source's time stamp (s; nan: none) is that of the last frame."""
        same, self._position = position == self._position, position
        return same

    def fault(self, image: Image | None) -> FrameFault | None:
        """The fault of an image (H, W) or (H, W, 3); black comes before frozen, as a covered lens is both."""
        if image is None or not image.size:
            return FrameFault.DAMAGED
        if self._size is not None and image.shape[1::-1] != self._size:
            return FrameFault.WRONG_SIZE
        is_new = self._fresh(0, image)
        if is_black(image):
            return FrameFault.BLACK
        return None if is_new else FrameFault.FROZEN


def is_black(image: Image) -> bool:
    """Whether an image (H, W) or (H, W, 3) is black."""
    sample = image[::SAMPLE_STRIDE, ::SAMPLE_STRIDE]
    return bool(np.count_nonzero(sample >= BLACK_LEVEL) <= MIN_LIT_SHARE * sample.size)


class CameraPhase(Enum):
    """Phase of a camera."""

    OPENING = "opening"
    OPEN = "open"
    GONE = "gone"
    ENDED = "ended"  # a file that has been played


@dataclass(frozen=True, slots=True, eq=False)
class CameraState:
    """State of one camera."""

    name: str
    source: str
    phase: CameraPhase
    since: float  # s, age of the phase
    age: float  # s since its last good frame, or since the start
    rate: float  # Hz; nan before frames come
    jitter: float  # s, RMS; nan before frames come
    lag: float  # s, from the middle of the exposure to arrival, by the stamps
    by: StampedBy  # source of the stamps
    given: int  # good frames that were not overrun
    missed: int  # frames that never came, by the gaps between stamps
    overrun: int  # frames that nobody fetched in time
    faults: Mapping[FrameFault, int]  # number of frames left out, by reason
    fault: FrameFault | None  # of the last frame
    reopened: int  # number of times the camera came back
    controls: tuple[Control, ...]
    newest: Image | None  # its last picture, faulty or not
    error: str = ""  # the last one that its driver raised
    transport: Transport | None = None  # what was lost on the way; None where nothing is known of it

    @property
    def trouble(self) -> str:
        """Why this camera delivers nothing, or which controls it refused; "" where all is well."""
        if self.phase is CameraPhase.ENDED:
            return f"{self.name} has been played to its end"
        if self.phase is not CameraPhase.OPEN:
            why = f": {self.error}" if self.error else ""
            return f"{self.name} cannot be opened since {self.since:.1f} s ({self.source}){why}"
        if self.age > STALL_AFTER:
            why = "delivers nothing" if self.fault is None else self.fault.value
            return f"{self.name} {why} since {self.age:.1f} s ({self.source})"
        refused = [str(control) for control in self.controls if not control.accepted]
        return f"{self.name} did not take {', '.join(refused)}" if refused else ""


@dataclass(frozen=True, slots=True, eq=False)
class LiveHealth:
    """State of all cameras and their frame sets."""

    cameras: tuple[CameraState, ...]  # in the rig's order
    sets: int  # served
    complete: int  # of these, with all cameras
    late: int  # frames that came after their set
    passed_over: int  # sets that were not served, as a newer one was there

    @property
    def trouble(self) -> str:
        """The cameras' troubles; "" without any."""
        return "; ".join(camera.trouble for camera in self.cameras if camera.trouble)


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """A good frame."""

    frame: Frame
    steady: float  # s, its stamp without jitter
    period: float | None  # s, of its camera; None before it is known, and of a triggered one, which has no phase
    now: float  # s, when it was ready


@dataclass(frozen=True, slots=True)
class CameraPlace:
    """A camera's place in the rig."""

    number: int
    name: str
    size: tuple[int, int] | None  # (W, H) px; None: any
    offset: float = 0.0  # s, added to its stamps


def open_capture(source: CameraSource, size: tuple[int, int] | None, clock: Clock) -> Capture | None:
    """Open a camera for pictures of `size` (W, H) px by the driver of its kind; None where that is not possible now."""
    if source.identity.kind is SourceKind.GENICAM:
        from hardware.cameras.genicam import open_genicam

        return open_genicam(source, size, clock)
    return open_by_opencv(source, size, clock)


class Feed:
    """Delivers one camera's good frames: in its own thread by `run`, or in virtual time by calls of `step`."""

    def __init__(
        self,
        place: CameraPlace,
        source: CameraSource,
        clock: Clock,
        deliver: Callable[[Arrival], None],
        opener: CaptureOpener = open_capture,
    ) -> None:
        self.place, self.source = place, source
        self._clock, self._deliver, self._opener = clock, deliver, opener
        self._lock = threading.Lock()
        self._capture: Capture | None = None
        self._closing = threading.Event()
        self._phase, self._phase_start = CameraPhase.OPENING, clock.now()
        self._last_good = self._phase_start  # s, arrival of the last good frame
        self._back_off, self._open_count, self._damaged_count, self._missed_count = BACK_OFF, 0, 0, 0
        self._period = 1 / source.fps if source.fps else None  # s, as told
        self._faults: Counter[FrameFault] = Counter()
        self._fault: FrameFault | None = None
        self._given_count = 0
        self._controls: tuple[Control, ...] = ()
        self._stamped: FrameStamp | None = None
        self._newest: Image | None = None
        self._error = ""
        self._transport: Transport | None = None
        self._earlier: Transport | None = None  # before the camera was opened last
        self._begin()

    def _begin(self) -> None:
        """Reset the state of the last connection."""
        self._stamping, self._watch = FrameStamper(self._period), FrameWatch(self.place.size)
        self._grabbed, self._earlier = 0, self._transport

    def run(self) -> None:
        """Step until closed, or the file has ended."""
        while not self._closing.is_set() and self._phase is not CameraPhase.ENDED:
            try:
                self.step()
            except Exception as error:  # of a driver: the camera counts as gone, and is opened again
                self._fail(error)
        self._release()

    def close(self) -> None:
        """End `run` before its next step."""
        self._closing.set()

    @property
    def ended(self) -> bool:
        """Whether this is a file that has ended."""
        return self._phase is CameraPhase.ENDED

    def step(self) -> None:
        """Grab a frame and deliver it if it is good; or try to open the camera, and wait if that fails."""
        if self._capture is None:
            self._open()
        elif grabbed := self._capture.grab():
            self._take(self._capture)
        elif grabbed is not None:
            file_ended = self._capture.ends and self._grabbed > 0
            self._release()
            self._enter(CameraPhase.ENDED if file_ended else CameraPhase.GONE)

    def _open(self) -> None:
        capture = self._opener(self.source, self.place.size, self._clock)
        if capture is None:
            self._pause()
            return
        self._begin()
        self._capture, self._damaged_count = capture, 0

    def _take(self, capture: Capture) -> None:
        now, position, transport = self._clock.now(), capture.position(), capture.transport
        with self._lock:
            self._transport = self._earlier if transport is None else transport.after(self._earlier)
        if self._grabbed == 0:  # accepted controls show only once pictures flow
            self._first(capture)
        self._grabbed += 1
        if self._watch.repeats(position):
            self._leave_out(FrameFault.DUPLICATED)
            return
        if capture.incomplete and math.isnan(position):  # its begin was lost: an arrival instead would move the beat
            self._leave_out(FrameFault.INCOMPLETE)
            return
        missed_before = self._stamping.pll.missed
        stamped = self._stamping(now, position, capture.clocked, capture.exact)
        image = capture.retrieve()
        fault = self._watch.fault(image) or (None if stamped.fresh else FrameFault.BACKLOG)
        fault = FrameFault.INCOMPLETE if capture.incomplete else fault
        with self._lock:
            self._missed_count += max(0, self._stamping.pll.missed - missed_before)
            self._stamped = stamped
            self._newest = self._newest if image is None else image
        if fault is not None or image is None:
            self._leave_out(fault or FrameFault.DAMAGED)
            return
        self._give(stamped, image)

    def _first(self, capture: Capture) -> None:
        controls = capture.lock()
        self._stamping.exposure = locked_exposure(controls)
        with self._lock:
            self._controls = controls
            self._open_count += 1
        self._back_off = BACK_OFF
        self._enter(CameraPhase.OPEN)

    def _give(self, stamped: FrameStamp, image: Image) -> None:
        offset, now = self.place.offset, self._clock.now()
        frame = Frame(self.place.number, stamped.stamp + offset, image, stamped.by)
        with self._lock:
            self._fault, self._last_good, self._damaged_count = None, now, 0
            self._given_count += 1
        period = None if self.source.trigger else self._stamping.pll.period
        self._deliver(Arrival(frame, stamped.steady + offset, period, now))

    def _leave_out(self, fault: FrameFault) -> None:
        with self._lock:
            self._faults[fault] += 1
            self._fault = fault
        self._damaged_count = self._damaged_count + 1 if fault in (FrameFault.DAMAGED, FrameFault.INCOMPLETE) else 0
        if self._damaged_count >= MAX_DAMAGED_FRAMES:
            self._release()
            self._enter(CameraPhase.GONE)

    def _fail(self, error: Exception) -> None:
        with suppress(Exception):
            self._release()
        self._capture = None
        with self._lock:
            self._error = str(error) if isinstance(error, StillbedError) else f"{type(error).__name__}: {error}"
        self._enter(CameraPhase.GONE)
        self._pause()

    def _enter(self, phase: CameraPhase) -> None:
        with self._lock:
            if phase is not self._phase:
                self._phase, self._phase_start = phase, self._clock.now()

    def _release(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _pause(self) -> None:
        self._wait(self._back_off)
        self._back_off = min(2 * self._back_off, MAX_BACK_OFF)

    def _wait(self, seconds: float) -> None:
        end = self._clock.now() + seconds
        while self._clock.now() < end and not self._closing.is_set():
            self._clock.wait_until(min(end, self._clock.now() + MAX_WAIT))

    def state(self, overrun: int = 0) -> CameraState:
        """The camera's state; overrun: number of its frames that nobody fetched in time."""
        with self._lock:
            now, pll, last = self._clock.now(), self._stamping.pll, self._stamped
            return CameraState(
                name=self.place.name,
                source=self.source.identity.shown,
                phase=self._phase,
                since=now - self._phase_start,
                age=now - self._last_good,
                rate=1 / pll.period if pll.period else math.nan,
                jitter=pll.jitter if self._given_count > 1 else math.nan,
                lag=math.nan if last is None else last.lag,
                by="" if last is None else last.by,
                given=self._given_count - overrun,
                missed=self._missed_count,
                overrun=overrun,
                faults=dict(self._faults),
                fault=self._fault,
                reopened=max(0, self._open_count - 1),
                controls=self._controls,
                newest=self._newest,
                error=self._error,
                transport=self._transport,
            )
