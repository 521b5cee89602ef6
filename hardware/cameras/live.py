"""Live cameras as frame sets: one grab thread per camera, the newest set first; a failing camera delays no other."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.cameras.feed import Arrival, CameraPlace, Feed, LiveHealth
from hardware.cameras.sources import CameraSource, SourceKind, identity_from_text, read_live_rig
from hardware.process.clock import Clock
from perception.frames import DEFAULT_PERIOD, Frame, FrameSet, Pairing, frame_set

MAX_WAITING_FRAMES = 4  # per camera that nobody has fetched yet; older ones are dropped
SET_POLL = 0.005  # s between checks whether an incomplete set is due
JOIN_TIMEOUT = 0.5  # s for a thread to end; one that waits for a dead stream ends with the process
MAX_PERIOD_DIFFERENCE = 0.02  # relative, of cameras that stay in step for some seconds
MAX_SILENT_PERIODS = 5  # without a frame, after which a camera no longer counts
# ratio to the present gap from which sets begin after another one: drifting phases do not toggle
LEADER_HYSTERESIS = 2.0
MIN_STAMP_STEP = 1e-6  # s: steady stamps of one camera rise at least by this
LAG_GAIN = 0.1  # of the exponential mean of a camera's lag: a third of a second
RETIME_CHANGE = 0.1  # relative change of the fastest period from which pairing adopts it


class FreeRunPhases:
    """Lag of each free-running camera behind the first of a set; there is one set per period.

    Sets begin after the longest gap between the cameras' phases, so that every set can hold all cameras with the least
    spread: up to two thirds of a period for three cameras. Cameras of another rate have no lag.
    """

    def __init__(self) -> None:
        self._beats: dict[int, tuple[float, float]] = {}  # newest instant and period of each camera, s
        self._leader = 0

    def lead(self, camera: int, instant: float, period: float | None) -> float:
        """Lag, s, of a camera's frame at a steady `instant` (s) behind the first frame of its set."""
        if period is None:
            self._beats.pop(camera, None)
            return 0.0
        self._beats[camera] = instant, period
        fastest = min(own for _, own in self._beats.values())
        alive = [c for c in sorted(self._beats) if self._counts(c, instant, fastest)]
        if camera not in alive:
            return 0.0
        gaps = self._gaps(alive, fastest)
        latest = max(alive, key=lambda c: gaps[c])
        if gaps.get(self._leader, 0.0) * LEADER_HYSTERESIS < gaps[latest]:
            self._leader = latest
        gap = gaps[self._leader]
        return (instant - self._beats[self._leader][0] + gap / 2) % fastest - gap / 2

    def _counts(self, camera: int, now: float, fastest: float) -> bool:
        """Whether a camera is in step with the fastest one, and still delivers."""
        instant, period = self._beats[camera]
        in_step = abs(period / fastest - 1) <= MAX_PERIOD_DIFFERENCE
        return in_step and now - instant <= MAX_SILENT_PERIODS * fastest

    def _gaps(self, alive: list[int], period: float) -> dict[int, float]:
        """Gap, s, between each camera's frame and the one before it, of any camera."""
        first, _ = self._beats[alive[0]]
        phases = sorted(((self._beats[c][0] - first) % period, c) for c in alive)
        previous = [phases[-1][0] - period, *(phase for phase, _ in phases[:-1])]
        return {c: phase - earlier for (phase, c), earlier in zip(phases, previous, strict=True)}


@dataclass(frozen=True, slots=True, eq=False)
class _PairingFrame(Frame):
    """A frame at the stamp by which it is paired."""

    own: Frame | None = None


class FrameSetBuilder:
    """Pairs frames by stamps without jitter, plus each camera's exposure offset, less its free-run lag.

    A frame's own stamp stays as it is. With a jitter of a seventh of a period (sigma) one set in twenty would be torn
    apart; the jitter-free beat is known to a few percent of a period after a second.
    """

    def __init__(self, cameras: int, period: float, offsets: Sequence[float] | Array | None = None) -> None:
        self._pairing = Pairing(cameras, period)
        self._period, self._phases = period, FreeRunPhases()
        self._periods: list[float | None] = [None] * cameras  # s
        self._keys, self._stamp, self._now = [-math.inf] * cameras, -math.inf, -math.inf
        self._discarded = 0
        self.behind = np.zeros(cameras)  # s: mean lag of each camera's stamps behind the set's
        self.set_offsets(np.zeros(cameras) if offsets is None else offsets)

    @property
    def late(self) -> int:
        """Number of frames that came after their set and were left out."""
        return self._pairing.late + self._discarded

    def set_offsets(self, offsets: Sequence[float] | Array) -> None:
        """Set each camera's exposure offset after its own stamps, (C,) s, for the frames to come."""
        values = np.array(offsets, float)
        assert values.shape == (len(self._periods),) and np.isfinite(values).all(), offsets
        self._offsets = values

    def learn(self, offsets: Sequence[float] | Array) -> None:
        """Take over the estimator's exposure offsets after the set's stamp, (C,) s.

        The mean lag of each camera's stamps behind the set's is subtracted: counted twice, it would shift the sets.
        """
        self.set_offsets(np.asarray(offsets, float) - self.behind)

    def add(self, arrival: Arrival) -> list[FrameSet]:
        """Add a frame; the sets that are complete by it."""
        camera = arrival.frame.camera
        self._retime(camera, arrival.period)
        steady = arrival.steady + float(self._offsets[camera])
        key = max(steady - self._phases.lead(camera, steady, arrival.period), self._keys[camera] + MIN_STAMP_STEP)
        self._keys[camera] = key
        frame = arrival.frame
        self._now = max(self._now, arrival.now)  # threads may deliver in another order than they read the clock
        return self._own(self._pairing.add(_PairingFrame(camera, key, frame.image, frame.by, frame), self._now))

    def due(self, now: float) -> list[FrameSet]:
        """The incomplete sets that are due at `now`, s."""
        self._now = max(self._now, now)
        return self._own(self._pairing.due(self._now))

    def _own(self, sets: list[FrameSet]) -> list[FrameSet]:
        out = []
        for one in sets:
            own = frame_set([f.own for f in one.frames if isinstance(f, _PairingFrame) and f.own is not None])
            if own.stamp > self._stamp:
                self._stamp = own.stamp
                self._learn(own)
                out.append(own)
            else:  # stamps of sets always rise
                self._discarded += len(own.frames)
        return out

    def _learn(self, whole: FrameSet) -> None:
        if len(whole.frames) == len(self.behind):
            stamps = np.array([frame.stamp for frame in whole.frames])
            self.behind += LAG_GAIN * (stamps - whole.stamp - self.behind)

    def _retime(self, camera: int, period: float | None) -> None:
        """Pair by the fastest camera's period."""
        self._periods[camera] = period
        fastest = min((p for p in self._periods if p is not None), default=self._period)
        if abs(fastest / self._period - 1) > RETIME_CHANGE:
            self._period = fastest
            self._pairing.retime(fastest)


class LiveCameras:
    """The frame sets of a rig's cameras: iterate, or call `next_set`. Use it as a context, or `start` and `close` it.

    Only the newest set is served; older ones are skipped and counted. Stamps are exposure instants by `clock` with the
    rig's clock offsets added; each frame names the source of its stamp. Cameras may disconnect and come back. The
    iteration ends when all cameras are files that have ended.
    """

    def __init__(self, rig: Rig | Sequence[CameraPlace], sources: Sequence[CameraSource], clock: Clock) -> None:
        """rig: or the places of cameras that are not calibrated. sources: one per camera.

        InputError where the driver of one is not installed.
        """
        if isinstance(rig, Rig):
            rig = [CameraPlace(i, c.name, c.size, c.clock_offset) for i, c in enumerate(rig.cameras)]
        places = tuple(rig)
        if len(sources) != len(places):
            raise InputError("live cameras", "sources", len(sources), f"one per camera of the rig, {len(places)}")
        for place, source in zip(places, sources, strict=True):
            if source.identity.kind is SourceKind.GENICAM:
                from hardware.cameras.genicam import require_aravis

                require_aravis(place.name, source)
        self._clock, self._condition = clock, threading.Condition()
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
        with self._condition:
            self._closed = True
            self._condition.notify_all()
        for feed in self._feeds:
            feed.close()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(JOIN_TIMEOUT)

    def __enter__(self) -> LiveCameras:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[FrameSet]:
        while (one := self.next_set()) is not None:
            yield one

    def next_set(self, until: float | None = None) -> FrameSet | None:
        """Wait for a set newer than the last one; None at the instant `until` (s, None: never), or at the end."""
        with self._condition:
            while True:
                ended = all(feed.ended for feed in self._feeds)  # read first: what was delivered before is in the set
                newest = None if self._closed else self._newest_set(ended)
                over = self._closed or ended or (until is not None and self._clock.now() >= until)
                if newest is not None or over:
                    return newest
                self._condition.wait(SET_POLL)

    def learn(self, offsets: Sequence[float] | Array) -> None:
        """Pair frames by the exposure offsets that the estimator has learned: (C,) s, after the set's stamp.

        The frames' stamps stay as they are, so that the estimator does not learn from its own output.
        """
        with self._condition:
            self._builder.learn(offsets)

    def health(self) -> LiveHealth:
        """The state of every camera now."""
        with self._condition:
            overrun, late = list(self._overrun), self._builder.late
            sets, complete, passed = self._sets, self._complete, self._passed_over
        states = tuple(feed.state(count) for feed, count in zip(self._feeds, overrun, strict=True))
        return LiveHealth(states, sets, complete, late, passed)

    def _deliver(self, arrival: Arrival) -> None:
        camera = arrival.frame.camera
        with self._condition:
            mine = [one for one in self._waiting if one.frame.camera == camera]
            if len(mine) >= MAX_WAITING_FRAMES:
                self._waiting.remove(mine[0])
                self._overrun[camera] += 1
            self._waiting.append(arrival)
            self._condition.notify_all()

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
