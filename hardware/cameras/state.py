"""How live cameras fare, in records and in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from hardware.cameras.controls import Control
from hardware.cameras.watch import Fault
from perception.frames import Image, StampedBy

STALLED = 0.5  # s without a frame, after which a camera that is open is said to have stalled


class Phase(Enum):
    """Where a camera stands."""

    OPENING = "opening"
    OPEN = "open"
    GONE = "gone"
    ENDED = "ended"  # a file that has been played


@dataclass(frozen=True, slots=True, eq=False)
class CameraState:
    """One camera now.

    since: s, how long its phase has lasted. age: s since its last good frame, or since the start. rate: Hz; jitter: s,
    rms; nan before frames come. lag: s, from the middle of the exposure to arrival, as far as the stamps tell. given:
    good frames that were not overrun. missed: frames that never came, by the gaps between stamps. overrun: that nobody
    fetched in time. faults: left out, by reason. fault: that of the last frame. reopened: times that it came back.
    newest: its last picture, whatever is wrong with it.
    """

    name: str
    source: str
    phase: Phase
    since: float
    age: float
    rate: float
    jitter: float
    lag: float
    by: StampedBy
    given: int
    missed: int
    overrun: int
    faults: Mapping[Fault, int]
    fault: Fault | None
    reopened: int
    controls: tuple[Control, ...]
    newest: Image | None

    @property
    def trouble(self) -> str:
        """Why this camera delivers nothing, or what it did not take; "" where all is well."""
        if self.phase is Phase.ENDED:
            return f"{self.name} has been played to its end"
        if self.phase is not Phase.OPEN:
            return f"{self.name} cannot be opened since {self.since:.1f} s ({self.source})"
        if self.age > STALLED:
            why = "delivers nothing" if self.fault is None else self.fault.value
            return f"{self.name} {why} since {self.age:.1f} s ({self.source})"
        refused = [str(control) for control in self.controls if not control.taken]
        return f"{self.name} did not take {', '.join(refused)}" if refused else ""


@dataclass(frozen=True, slots=True, eq=False)
class LiveHealth:
    """All cameras, in the rig's order. sets: given out; complete: of these, with all cameras. late: frames that came
    after their set. passed_over: sets for which a newer one was there when somebody asked."""

    cameras: tuple[CameraState, ...]
    sets: int
    complete: int
    late: int
    passed_over: int

    @property
    def trouble(self) -> str:
        """What is wrong, camera by camera; "" where nothing is."""
        return "; ".join(camera.trouble for camera in self.cameras if camera.trouble)

    @property
    def all_open(self) -> bool:
        """Whether every camera has delivered a good frame within the last half second."""
        return all(c.phase is Phase.OPEN and c.age <= STALLED for c in self.cameras)


def rate(period: float | None) -> float:
    """Hz of a period, s; nan before it is known."""
    return 1 / period if period else float(np.nan)
