"""What the page shows while a board is waved before live cameras: where to hold it next, and what is still needed."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from hardware.operator.shared_state import Wish
from hardware.operator.view import Answer


class WavingStage(StrEnum):
    """Where a calibration is."""

    WAVE = "wave"  # the board is looked for
    SOLVE = "solve"  # enough was seen: lenses and places are computed
    PASSED = "passed"
    FAILED = "failed"  # not good enough, or not to be calibrated from this
    STOPPED = "stopped"  # the corners are kept


@dataclass(frozen=True, slots=True)
class WavingCamera:
    """What one camera has seen of the board.

    size: (W, H) px of its picture. corners: in the newest one. parts: of the picture, row by row, 0 to 1 of the
    corners that each should have. tilts: 0 to 1 of the views that should be tilted so: left, right, top, bottom
    nearer. depth: 0 to 1 of how much nearer than the far views the near ones should be.
    """

    name: str
    size: tuple[int, int]
    corners: int
    parts: tuple[tuple[float, ...], ...]
    tilts: tuple[float, ...]
    depth: float


@dataclass(frozen=True, slots=True)
class WavingView:
    """The calibration now. stamp: s. hints: what to do next, the most needed first. together: 0 to 1 of the frame sets
    in which two cameras should have seen the board. looked: frame sets looked at. words: what came of it.
    """

    stamp: float
    turn: int
    stage: WavingStage
    hints: tuple[str, ...] = ()
    cameras: tuple[WavingCamera, ...] = ()
    together: float = 0.0
    looked: int = 0
    words: tuple[str, ...] = ()
    offers: tuple[Wish, ...] = ()
    answer: Answer | None = None
