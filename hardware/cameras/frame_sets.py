"""Frame sets from unsynchronised cameras: frames grouped by jitter-free stamps on a common clock, as they arrive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array
from hardware.cameras.feed import Arrival
from perception.frames import Frame, FrameSet
from perception.pairing import Pairing, frame_set

MAX_PERIOD_DIFFERENCE = 0.02  # relative, of cameras that stay in step for some seconds
MAX_SILENT_PERIODS = 5  # without a frame, after which a camera no longer counts
LEADER_HYSTERESIS = (
    2.0  # ratio to the present gap from which sets begin after another one: drifting phases do not toggle
)
MIN_STAMP_STEP = 1e-6  # s: steady stamps of one camera rise at least by this
LAG_GAIN = 0.1  # of the exponential mean of a camera's lag: a third of a second
RETIME_CHANGE = 0.1  # relative change of the fastest period from which pairing adopts it


@dataclass(frozen=True, slots=True)
class _CameraBeat:
    instant: float
    period: float


class FreeRunPhases:
    """Lag of each free-running camera behind the first of a set; there is one set per period.

    Sets begin after the longest gap between the cameras' phases, so that every set can hold all cameras with the least
    spread: up to two thirds of a period for three cameras. Cameras of another rate have no lag.
    """

    def __init__(self, cameras: int) -> None:
        self._beats: list[_CameraBeat | None] = [None] * cameras
        self._leader = 0

    def lead(self, camera: int, instant: float, period: float | None) -> float:
        """Lag, s, of a camera's frame at a steady `instant` (s) behind the first frame of its set."""
        self._beats[camera] = None if period is None else _CameraBeat(instant, period)
        own = self._beats[camera]
        if own is None:
            return 0.0
        fastest = min(beat.period for beat in self._beats if beat is not None)
        alive = [c for c, beat in enumerate(self._beats) if beat is not None and self._counts(beat, instant, fastest)]
        if camera not in alive:
            return 0.0
        gaps = self._gaps(alive, fastest)
        best = max(alive, key=lambda c: gaps[c])
        if gaps.get(self._leader, 0.0) * LEADER_HYSTERESIS < gaps[best]:
            self._leader = best
        return self._behind(self._leader, instant, fastest, gaps[self._leader])

    def _counts(self, beat: _CameraBeat, now: float, period: float) -> bool:
        in_step = abs(beat.period / period - 1) <= MAX_PERIOD_DIFFERENCE
        return in_step and now - beat.instant <= MAX_SILENT_PERIODS * period

    def _gaps(self, alive: list[int], period: float) -> dict[int, float]:
        """Gap, s, between each camera's frame and the one before it, of any camera."""
        first = self._instant(alive[0])
        phases = sorted(((self._instant(c) - first) % period, c) for c in alive)
        before = [phases[-1][0] - period, *(phase for phase, _ in phases[:-1])]
        return {c: phase - earlier for (phase, c), earlier in zip(phases, before, strict=True)}

    def _behind(self, leader: int, instant: float, period: float, gap: float) -> float:
        return (instant - self._instant(leader) + gap / 2) % period - gap / 2

    def _instant(self, camera: int) -> float:
        beat = self._beats[camera]
        assert beat is not None
        return beat.instant


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
        self._period, self._phases = period, FreeRunPhases(cameras)
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

    def learn(self, learned: Sequence[float] | Array) -> None:
        """Take over the estimator's exposure offsets after the set's stamp, (C,) s.

        The mean lag of each camera's stamps behind the set's is subtracted: counted twice, it would shift the sets.
        """
        self.set_offsets(np.asarray(learned, float) - self.behind)

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
