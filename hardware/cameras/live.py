"""Live cameras as frame sets: one grab thread per camera, the newest set first; a failing camera delays no other."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType

from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.cameras.feed import Arrival, CameraPlace, Feed, LiveHealth
from hardware.cameras.frame_sets import FrameSetBuilder
from hardware.cameras.sources import CameraSource, identity_from_text, read_live_rig
from hardware.process.clock import Clock
from perception.frames import FrameSet
from perception.pairing import DEFAULT_PERIOD

MAX_WAITING_FRAMES = 4  # per camera that nobody has fetched yet; older ones are dropped
SET_POLL = 0.005  # s between checks whether an incomplete set is due
JOIN_TIMEOUT = 0.5  # s for a thread to end; one that waits for a dead stream ends with the process


class LiveCameras:
    """The frame sets of a rig's cameras: iterate, or call `next_set`. Use it as a context, or `start` and `close` it.

    Only the newest set is served; older ones are skipped and counted. Stamps are exposure instants by `clock` with the
    rig's clock offsets added; each frame names the source of its stamp. Cameras may disconnect and come back. The
    iteration ends when all cameras are files that have ended.
    """

    def __init__(
        self,
        rig: Rig | Sequence[CameraPlace],
        sources: Sequence[CameraSource],
        clock: Clock,
    ) -> None:
        """rig: or the places of cameras that are not calibrated. sources: one per camera."""
        if isinstance(rig, Rig):
            rig = [CameraPlace(i, c.name, c.size, c.clock_offset) for i, c in enumerate(rig.cameras)]
        places = tuple(rig)
        if len(sources) != len(places):
            raise InputError("live cameras", "sources", len(sources), f"one per camera of the rig, {len(places)}")
        self._clock, self._changed = clock, threading.Condition()
        self._waiting: deque[Arrival] = deque()
        self._overrun = [0] * len(places)
        self._sets = self._complete = self._passed_over = 0
        self._closed = False
        period = min((1 / source.fps for source in sources if source.fps), default=DEFAULT_PERIOD)
        self._builder = FrameSetBuilder(len(places), period)
        self._feeds = [Feed(p, source, clock, self._deliver) for p, source in zip(places, sources, strict=True)]
        self._threads = [
            threading.Thread(target=feed.run, name=f"camera {feed.place.name}", daemon=True) for feed in self._feeds
        ]

    def start(self) -> None:
        """Begin to open the cameras and to grab; returns at once."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Release the cameras; whoever waits for a set gets None."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for feed in self._feeds:
            feed.close()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(JOIN_TIMEOUT)

    def __enter__(self) -> LiveCameras:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def __iter__(self) -> Iterator[FrameSet]:
        while (one := self.next_set()) is not None:
            yield one

    def next_set(self, until: float | None = None) -> FrameSet | None:
        """Wait for a set newer than the last one; None at the instant `until` (s, None: never), or at the end."""
        with self._changed:
            while True:
                ended = all(feed.ended for feed in self._feeds)  # read first: what was delivered before is in the set
                newest = None if self._closed else self._newest_set(ended)
                over = self._closed or ended or (until is not None and self._clock.now() >= until)
                if newest is not None or over:
                    return newest
                self._changed.wait(SET_POLL)

    def learn(self, offsets: Sequence[float] | Array) -> None:
        """Pair frames by the exposure offsets that the estimator has learned: (C,) s, after the set's stamp.

        The frames' stamps stay as they are, so that the estimator does not learn from its own output.
        """
        with self._changed:
            self._builder.learn(offsets)

    def health(self) -> LiveHealth:
        """The state of every camera now."""
        with self._changed:
            overrun, late = list(self._overrun), self._builder.late
            sets, complete, passed = self._sets, self._complete, self._passed_over
        states = tuple(feed.state(count) for feed, count in zip(self._feeds, overrun, strict=True))
        return LiveHealth(states, sets, complete, late, passed)

    def _deliver(self, arrival: Arrival) -> None:
        with self._changed:
            camera = arrival.frame.camera
            mine = [one for one in self._waiting if one.frame.camera == camera]
            if len(mine) >= MAX_WAITING_FRAMES:
                self._waiting.remove(mine[0])
                self._overrun[camera] += 1
            self._waiting.append(arrival)
            self._changed.notify_all()

    def _newest_set(self, ended: bool) -> FrameSet | None:
        """The newest set of the waiting frames, or None. ended: no more frames will come."""
        sets: list[FrameSet] = []
        while self._waiting:
            sets += self._builder.add(self._waiting.popleft())
        sets += self._builder.due(math.inf if ended else self._clock.now())
        if not sets:
            return None
        self._sets += 1
        self._complete += len(sets[-1].frames) == len(self._feeds)
        self._passed_over += len(sets) - 1
        return sets[-1]


def sources_named(which: Sequence[str]) -> tuple[Rig | None, tuple[CameraSource, ...]]:
    """The rig and camera sources of one RIG.toml, or no rig and the sources named one by one; InputError."""
    rigs = [text for text in which if text.endswith(".toml")]
    if rigs and len(which) > 1:
        raise InputError("command line", "cameras", " ".join(which), "one RIG.toml alone, or cameras without one")
    if rigs:
        return read_live_rig(rigs[0])
    return None, tuple(CameraSource(identity_from_text("command line", "camera", text, Path.cwd())) for text in which)


def places_without_rig(count: int) -> tuple[CameraPlace, ...]:
    """Places of uncalibrated cameras, counted from 1."""
    return tuple(CameraPlace(i, f"camera {i + 1}", None) for i in range(count))
