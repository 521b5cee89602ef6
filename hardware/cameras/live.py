"""Live cameras as frame sets: a grab thread each, the newest set wins, and a camera that fails holds up no other."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from types import TracebackType

from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.cameras.capture import Opener, open_capture
from hardware.cameras.feed import Arrival, Feed, Place
from hardware.cameras.frame_sets import Gathering
from hardware.cameras.sources import CameraSource
from hardware.cameras.state import LiveHealth
from hardware.process.clock import Clock
from perception.frames import FrameSet
from perception.pairing import DEFAULT_PERIOD

WAITING = 4  # frames a camera that nobody fetched yet: what is older is no longer worth a look
LOOK = 0.005  # s between looks whether a set need not be waited for any longer
JOINED = 0.5  # s that a thread has to end; one that waits for a dead stream ends with the process


def places_of(rig: Rig) -> tuple[Place, ...]:
    """What live cameras need of a rig."""
    return tuple(Place(i, c.name, c.size, c.clock_offset) for i, c in enumerate(rig.cameras))


class LiveCameras:
    """The frame sets of a rig's cameras, newest first served: iterate, or ask with `next_set`.

    What is older than the newest set when it is asked for is passed over and counted. Stamps are the cameras' own, by
    `clock`, with the rig's clock offsets added; each frame tells by whom it was stamped. Cameras may come and go; files
    end, and with the last of them the iteration does. Use it as a context, or `start` and `close` it.
    """

    def __init__(
        self,
        rig: Rig | Sequence[Place],
        sources: Sequence[CameraSource],
        clock: Clock,
        offsets: Sequence[float] | Array | None = None,
        opener: Opener = open_capture,
    ) -> None:
        """rig: or the places of cameras that are not calibrated. sources: one per camera.

        offsets: (C,) s, as `set_offsets` takes them.
        """
        places = places_of(rig) if isinstance(rig, Rig) else tuple(rig)
        if len(sources) != len(places):
            raise InputError("live cameras", "sources", len(sources), f"one per camera of the rig, {len(places)}")
        self._clock, self._changed = clock, threading.Condition()
        self._waiting: deque[Arrival] = deque()
        self._overrun = [0] * len(places)
        self._sets = self._complete = self._passed_over = 0
        self._closed = False
        period = min((1 / source.fps for source in sources if source.fps), default=DEFAULT_PERIOD)
        self._gathering = Gathering(len(places), period, offsets)
        self._feeds = tuple(
            Feed(place, source, clock, self._deliver, opener) for place, source in zip(places, sources, strict=True)
        )
        names = [f"camera {feed.place.name}" for feed in self._feeds]
        self._threads = [
            threading.Thread(target=feed.run, name=name, daemon=True)
            for feed, name in zip(self._feeds, names, strict=True)
        ]

    def start(self) -> None:
        """Begin to open and grab; returns at once."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Give the cameras back; whoever waits for a set gets none."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for feed in self._feeds:
            feed.close()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(JOINED)

    def __enter__(self) -> LiveCameras:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def __iter__(self) -> Iterator[FrameSet]:
        """The newest set, again and again, until closed or all files have ended."""
        while (one := self.next_set()) is not None:
            yield one

    def next_set(self, until: float | None = None) -> FrameSet | None:
        """Wait for a set newer than the last one; None at the instant `until` (s, None: never), or at the end."""
        with self._changed:
            while True:
                ended = all(feed.ended for feed in self._feeds)  # asked first: what they delivered before is gathered
                found = None if self._closed else self._gather(ended)
                over = self._closed or ended or (until is not None and self._clock.now() >= until)
                if found is not None or over:
                    return found
                self._changed.wait(LOOK)

    def set_offsets(self, offsets: Sequence[float] | Array) -> None:
        """How much later than its own stamps each camera exposes beyond its rig's offset, (C,) s.

        Frames are paired by it from now on; their stamps stay as they are, so that whoever learns from them does not
        learn from itself.
        """
        with self._changed:
            self._gathering.set_offsets(offsets)

    def learn(self, learned: Sequence[float] | Array) -> None:
        """Pair by what the estimator has learned: how much later than its set's stamp each camera exposes, (C,) s."""
        with self._changed:
            self._gathering.learn(learned)

    def behind(self) -> Array:
        """How much later than its set's stamp each camera is stamped, (C,) s, usually: cameras may be out of step."""
        with self._changed:
            return self._gathering.behind

    def health(self) -> LiveHealth:
        """How every camera fares now."""
        with self._changed:
            overrun, late = list(self._overrun), self._gathering.late
            sets, complete, passed = self._sets, self._complete, self._passed_over
        states = tuple(feed.state(count) for feed, count in zip(self._feeds, overrun, strict=True))
        return LiveHealth(states, sets, complete, late, passed)

    def _deliver(self, arrival: Arrival) -> None:
        with self._changed:
            camera = arrival.frame.camera
            mine = [one for one in self._waiting if one.frame.camera == camera]
            if len(mine) >= WAITING:
                self._waiting.remove(mine[0])
                self._overrun[camera] += 1
            self._waiting.append(arrival)
            self._changed.notify_all()

    def _gather(self, ended: bool) -> FrameSet | None:
        """The newest set of what has come, None if there is none. ended: nothing more will come."""
        sets: list[FrameSet] = []
        while self._waiting:
            sets += self._gathering.add(self._waiting.popleft())
        sets += self._gathering.due(math.inf if ended else self._clock.now())
        if not sets:
            return None
        self._sets += 1
        self._complete += len(sets[-1].frames) == len(self._feeds)
        self._passed_over += len(sets) - 1
        return sets[-1]
