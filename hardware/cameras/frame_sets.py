"""Frame sets from cameras that are not alike: grouped by steady stamps on a common clock, as frames arrive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array
from hardware.cameras.feed import Arrival
from hardware.cameras.phases import Phases
from perception.frames import Frame, FrameSet
from perception.pairing import Pairing, frame_set

STEP = 1e-6  # s: steady stamps of one camera rise by it at least
SHARE = 0.1  # of the newest set in what is usual for a camera: a third of a second
CHANGED = 0.1  # share by which the period differs from what is paired by, from which it is taken over


@dataclass(frozen=True, slots=True, eq=False)
class _Keyed(Frame):
    """A frame at the stamp that it is paired by."""

    own: Frame | None = None


class Gathering:
    """Pairs frames by stamps without jitter, plus each camera's offset where that is known, less its phase.

    Cameras that run freely are out of step by a constant: then the frames of one turn of all cameras make a set. A
    frame's own stamp stays as it is. A stamp's jitter of a seventh of a period (sigma) would tear one set in twenty
    apart; a camera's steady beat is known to a few percent of a period after a second.
    """

    def __init__(self, cameras: int, period: float, offsets: Sequence[float] | Array | None = None) -> None:
        self._pairing = Pairing(cameras, period)
        self._period, self._phases = period, Phases(cameras)
        self._periods: list[float | None] = [None] * cameras  # s
        self._keys, self._stamp, self._now = [-math.inf] * cameras, -math.inf, -math.inf
        self._discarded, self._behind = 0, np.zeros(cameras)
        self.set_offsets(np.zeros(cameras) if offsets is None else offsets)

    @property
    def late(self) -> int:
        """Frames that came after their set, and were left out."""
        return self._pairing.late + self._discarded

    def set_offsets(self, offsets: Sequence[float] | Array) -> None:
        """How much later than its own stamps each camera exposes, (C,) s, from the next frame on."""
        values = np.array(offsets, float)
        assert values.shape == (len(self._periods),) and np.isfinite(values).all(), offsets
        self._offsets = values

    def learn(self, learned: Sequence[float] | Array) -> None:
        """How much later than its set's stamp each camera exposes, (C,) s, as the estimator learns it.

        Cameras out of step are so by their stamps already: taken for an error of their clocks, that would count twice
        and shift the sets to and fro.
        """
        self.set_offsets(np.asarray(learned, float) - self._behind)

    @property
    def behind(self) -> Array:
        """How much later than its set's stamp each camera is stamped, (C,) s, usually."""
        return self._behind.copy()

    def add(self, arrival: Arrival) -> list[FrameSet]:
        """The sets that can be given out once a frame has come."""
        camera = arrival.frame.camera
        self._retime(camera, arrival.period)
        steady = arrival.steady + float(self._offsets[camera])
        key = max(steady - self._phases.lead(camera, steady, arrival.period), self._keys[camera] + STEP)
        self._keys[camera] = key
        frame = arrival.frame
        self._now = max(self._now, arrival.now)  # threads hand over in another order than they looked at the clock
        return self._own(self._pairing.add(_Keyed(camera, key, frame.image, frame.by, frame), self._now))

    def due(self, now: float) -> list[FrameSet]:
        """The sets that need not be waited for any longer at `now`, s."""
        self._now = max(self._now, now)
        return self._own(self._pairing.due(self._now))

    def _own(self, sets: list[FrameSet]) -> list[FrameSet]:
        out = []
        for one in sets:
            own = frame_set([f.own for f in one.frames if isinstance(f, _Keyed) and f.own is not None])
            if own.stamp > self._stamp:
                self._stamp = own.stamp
                self._learn(own)
                out.append(own)
            else:  # sets' stamps rise, whatever the frames' jitter
                self._discarded += len(own.frames)
        return out

    def _learn(self, whole: FrameSet) -> None:
        if len(whole.frames) == len(self._behind):
            stamps = np.array([frame.stamp for frame in whole.frames])
            self._behind += SHARE * (stamps - whole.stamp - self._behind)

    def _retime(self, camera: int, period: float | None) -> None:
        """Go by the fastest camera's period."""
        self._periods[camera] = period
        fastest = min((p for p in self._periods if p is not None), default=self._period)
        if abs(fastest / self._period - 1) > CHANGED:
            self._period = fastest
            self._pairing.retime(fastest)
