"""One camera: opened, locked, grabbed from, watched, and opened again when it comes back."""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from hardware.cameras.capture import Capture, Opener, open_capture
from hardware.cameras.controls import Control, locked_exposure
from hardware.cameras.sources import CameraSource
from hardware.cameras.stamping import Stamped, Stamping
from hardware.cameras.state import CameraState, Phase, rate
from hardware.cameras.watch import Fault, FrameWatch
from hardware.process.clock import Clock
from perception.frames import Frame, Image

BACK_OFF, LONGEST_BACK_OFF = 0.1, 2.0  # s: doubled from try to try, so that a camera plugged in again is soon back
BREATH = 0.1  # s, the longest wait before it is looked whether to end
BROKEN = 30  # frames in a row that cannot be decoded, after which a camera is opened anew


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """A frame that is fit to be used.

    steady: s, its stamp without jitter. period: s, of its camera, None before it is known. now: s, when it was ready.
    """

    frame: Frame
    steady: float
    period: float | None
    now: float


@dataclass(frozen=True, slots=True)
class Place:
    """A camera's place in the rig. number; name; size: (W, H) px, None: any; offset: s, added to its stamps."""

    number: int
    name: str
    size: tuple[int, int] | None
    offset: float = 0.0


class Feed:
    """Delivers one camera's good frames, a `step` at a time: in a thread of its own, or by hand in virtual time."""

    def __init__(
        self,
        place: Place,
        source: CameraSource,
        clock: Clock,
        deliver: Callable[[Arrival], None],
        opener: Opener = open_capture,
    ) -> None:
        self.place, self.source = place, source
        self._clock, self._deliver, self._opener = clock, deliver, opener
        self._lock = threading.Lock()
        self._capture: Capture | None = None
        self._closing = threading.Event()
        self._phase, self._since = Phase.OPENING, clock.now()
        self._good = self._since  # s, arrival of the last good frame
        self._back_off, self._opened, self._broken, self._missed = BACK_OFF, 0, 0, 0
        self._period = 1 / source.fps if source.fps else None  # s, as told
        self._faults: Counter[Fault] = Counter()
        self._fault: Fault | None = None
        self._given = 0
        self._controls: tuple[Control, ...] = ()
        self._stamped: Stamped | None = None
        self._newest: Image | None = None
        self._begin()

    def _begin(self) -> None:
        """Forget what held only for the camera as it was opened last."""
        self._stamping, self._watch = Stamping(self._period), FrameWatch(self.place.size)
        self._grabbed = 0

    def run(self) -> None:
        """Step until closed, or the file has ended."""
        while not self._closing.is_set() and self._phase is not Phase.ENDED:
            self.step()
        self._release()

    def close(self) -> None:
        """End `run` before its next step."""
        self._closing.set()

    @property
    def ended(self) -> bool:
        """Whether this is a file that has been played."""
        return self._phase is Phase.ENDED

    def step(self) -> None:
        """Grab a frame and deliver it if it is good; or try to open the camera, and wait where that fails."""
        if self._capture is None:
            self._open()
        elif self._capture.grab():
            self._take(self._capture)
        else:
            ended = self._capture.ends and self._grabbed > 0
            self._release()
            self._enter(Phase.ENDED if ended else Phase.GONE)

    def _open(self) -> None:
        capture = self._opener(self.source, self.place.size, self._clock)
        if capture is None:
            self._wait(self._back_off)
            self._back_off = min(2 * self._back_off, LONGEST_BACK_OFF)
            return
        self._begin()
        self._capture, self._broken = capture, 0

    def _take(self, capture: Capture) -> None:
        now, position = self._clock.now(), capture.position()
        if self._grabbed == 0:  # what a driver takes shows only once pictures flow
            self._first(capture)
        self._grabbed += 1
        if self._watch.repeats(position):
            self._leave_out(Fault.DUPLICATED)
            return
        missed = self._stamping.rhythm.missed
        stamped = self._stamping(now, position, capture.clocked)
        image = capture.retrieve()
        fault = self._watch.fault(image) or (None if stamped.fresh else Fault.BACKLOG)
        with self._lock:
            self._missed += max(0, self._stamping.rhythm.missed - missed)
            self._stamped = stamped
            self._newest = self._newest if image is None else image
        if fault is not None or image is None:
            self._leave_out(fault or Fault.DAMAGED)
            return
        self._give(stamped, image)

    def _first(self, capture: Capture) -> None:
        controls = capture.lock()
        self._stamping.exposure = locked_exposure(controls)
        with self._lock:
            self._controls = controls
            self._opened += 1
        self._back_off = BACK_OFF
        self._enter(Phase.OPEN)

    def _give(self, stamped: Stamped, image: Image) -> None:
        offset, now = self.place.offset, self._clock.now()
        frame = Frame(self.place.number, stamped.stamp + offset, image, stamped.by)
        with self._lock:
            self._fault, self._good, self._broken = None, now, 0
            self._given += 1
        self._deliver(Arrival(frame, stamped.steady + offset, self._stamping.rhythm.period, now))

    def _leave_out(self, fault: Fault) -> None:
        with self._lock:
            self._faults[fault] += 1
            self._fault = fault
        self._broken = self._broken + 1 if fault is Fault.DAMAGED else 0
        if self._broken >= BROKEN:
            self._release()
            self._enter(Phase.GONE)

    def _enter(self, phase: Phase) -> None:
        with self._lock:
            if phase is not self._phase:
                self._phase, self._since = phase, self._clock.now()

    def _release(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _wait(self, seconds: float) -> None:
        end = self._clock.now() + seconds
        while self._clock.now() < end and not self._closing.is_set():
            self._clock.wait_until(min(end, self._clock.now() + BREATH))

    def state(self, overrun: int = 0) -> CameraState:
        """This camera now; overrun: frames of it that nobody fetched in time."""
        with self._lock:
            now, rhythm, last = self._clock.now(), self._stamping.rhythm, self._stamped
            return CameraState(
                name=self.place.name,
                source=self.source.identity.shown,
                phase=self._phase,
                since=now - self._since,
                age=now - self._good,
                rate=rate(rhythm.period),
                jitter=rhythm.jitter if self._given > 1 else math.nan,
                lag=math.nan if last is None else last.lag,
                by="" if last is None else last.by,
                given=self._given - overrun,
                missed=self._missed,
                overrun=overrun,
                faults=dict(self._faults),
                fault=self._fault,
                reopened=max(0, self._opened - 1),
                controls=self._controls,
                newest=self._newest,
            )
