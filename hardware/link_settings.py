"""What the thesis does not say of the arm's line: how much motion may be under way, how long to wait for what.

These are of the link, not of the arm: they hold for any arm that speaks the protocol.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from estimation.errors import InputError


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Limits of the link, in mm, rad and s. InputError names one that makes no sense.

    flight: of motion that may be under way, on the wire and in the arm's queue, and frames: that many at most.
    ease: share of a tick by which ticks are longer than the moves of one. poll: between looks at the line.
    write_timeout: that the port may take no bytes. off: mm, and off_turn: rad, that the arm may answer from beside its
    way. slack: that it may be later on its way than its lag, and six tenths of that twice in a row. lost: mm, beyond
    which it is not held but stopped. silence: without an answer, after some have come. patience: of a hold by the link
    before it is a stop.
    reopen: between looks for a device that is gone. speed: mm/s, and turning: rad/s, of the link's own moves.
    pause_frame: whether the arm understands the control frame that stops it at once.
    """

    flight: float = 0.05
    frames: int = 4
    ease: float = 0.005  # more than clocks differ by; what a stall of 0.6 s has piled up is gone in 120 s
    poll: float = 0.002  # half a frame on the wire
    write_timeout: float = 0.2  # ten ticks
    off: float = 1.0  # a bead's width; answers count 0.1 mm, and come some ms late
    off_turn: float = float(np.deg2rad(2.0))
    slack: float = 0.05  # two ticks and what scheduling does to the stamp of an answer
    lost: float = 10.0  # three times what one command may jump
    silence: float = 0.5  # ten answers of 27 bytes on the slowest line
    patience: float = 2.0  # three times the longest stall that is to be lived with
    reopen: float = 0.5
    speed: float = 20.0  # one public driver homes at 1000 mm/min, 17 mm/s
    turning: float = float(np.deg2rad(20.0))
    pause_frame: bool = True  # as the public driver sends it; the thesis knows none

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self) if f.name != "pause_frame"):
            value = getattr(self, name)
            if not (math.isfinite(value) and (value > 0 or (name == "ease" and value == 0))):
                raise InputError("link", name, value, "a finite number > 0")
        if self.ease > 0.1:
            raise InputError("link", "ease", self.ease, "0 to 0.1")
