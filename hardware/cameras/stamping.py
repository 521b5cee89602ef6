"""When a frame was exposed: by its driver's time stamp, by its stream's, or by when it came."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from hardware.cameras.rhythm import Rhythm
from perception.frames import StampedBy

OLDEST = 1.0  # s: four buffers of 4 Hz; a driver's stamp beyond is of another clock
WINDOW = 60  # frames whose least delay is taken for the way's own: two seconds of a webcam
LEAST = (
    10  # one in so many frames comes sooner than what is taken for the way's own delay, where a beat is all there is
)
AGREE = 0.01  # s, that the least delays of both halves of the window may differ by: a stream whose clock runs as ours


@dataclass(frozen=True, slots=True)
class Stamped:
    """When a frame was exposed. stamp: s, middle of the exposure. steady: s, the same without jitter, for pairing.

    lag: s, from stamp to arrival. fresh: False for what is only now worked off of a backlog, so that its instant is
    unknown.
    """

    stamp: float
    steady: float
    by: StampedBy
    lag: float
    fresh: bool


class Stamping:
    """Remembers one camera's delays. period: s, None where it is not told. exposure: s, 0 where it is not known."""

    def __init__(self, period: float | None = None, exposure: float = 0.0) -> None:
        self.exposure = exposure
        self._by: StampedBy = "arrival"
        self._delays: deque[float] = deque(maxlen=WINDOW)  # s, behind the stream's clock
        self._late: deque[float] = deque(maxlen=WINDOW)  # s, behind the steady beat
        self.rhythm = Rhythm(period)

    def __call__(self, arrival: float, position: float, clocked: bool) -> Stamped:
        """Stamp the frame that arrived at `arrival` (s).

        position: s, as the source tells it (nan: it tells none). clocked: that may be the machine's own clock.
        """
        by, instant = self._source(arrival, position, clocked)
        if by != self._by:
            self._by, self.rhythm = by, Rhythm(self.rhythm.period)
        beat = self.rhythm(instant)
        if by == "arrival":
            self._late.append(arrival - beat.steady)
            instant = min(arrival, beat.steady + sorted(self._late)[len(self._late) // LEAST])
        middle = self.exposure / 2
        fresh = by != "arrival" or beat.count > 0
        steady = instant if by == "arrival" else beat.steady
        return Stamped(instant - middle, steady - middle, by, arrival - instant + middle, fresh)

    def _source(self, arrival: float, position: float, clocked: bool) -> tuple[StampedBy, float]:
        if clocked and 0 <= arrival - position <= OLDEST:
            return "driver", position
        if clocked or math.isnan(position):
            return "arrival", arrival
        self._delays.append(arrival - position)
        return ("stream", position + min(self._delays)) if self._keeps_time() else ("arrival", arrival)

    def _keeps_time(self) -> bool:
        """Whether the stream's stamps run as the clock does: its least delay is the same now as before."""
        delays, half = list(self._delays), WINDOW // 2
        return len(delays) == WINDOW and abs(min(delays[:half]) - min(delays[half:])) <= AGREE
