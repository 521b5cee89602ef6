"""What goes wrong in a synthetic world: each condition by itself, all of them 0 or empty in a perfect one."""

from __future__ import annotations

import math
from dataclasses import dataclass

from estimation.errors import InputError

Outage = tuple[float, float] | tuple[float, float, int]  # from, to, s; the camera, all without one

WHERE = "synthetic world"
SHARES = ("outliers", "coherent", "dropouts")
SIZES = ("noise", "dropout_seconds", "jitter", "calibration", "map_error", "correlated", "correlated_seconds", "churn")


@dataclass(frozen=True, slots=True)
class Conditions:
    """What the cameras' tracks suffer; InputError for a value out of its range.

    noise: px, white, one standard deviation an axis, and the sigma that observations claim.
    outliers: share of the observations, drawn anew in each, that stand up to 40 px anywhere else.
    coherent: share of the tracks that stick to the image where they stood at the start, as on a drape or a highlight.
    dropouts: share of the time for which a track is not found, in spells of `dropout_seconds` on average.
    outages: spells in which a camera, or all of them, find nothing.
    views: by how many cameras each landmark is ever found, at random; None: by all that see it.
    offsets: s, that each camera's true instant is later than its stamp, the rig's `clock_offset`, which is not told.
    jitter: s, one standard deviation of each camera's instant from frame to frame.
    calibration: px, RMS over the landmarks at rest, by which the rig that is told misses where the true one sees them.
    map_error: mm, one standard deviation an axis of the map's landmarks, which its covariance knows.
    correlated: px, one standard deviation of an error that each track drags along for `correlated_seconds`; not told.
    churn: s, after which a landmark is gone on average and another one seen; 0: never.
    reveal: s, from and to when the half of the surface with x > 0 comes into view; None: it always is.
    """

    noise: float = 0.25
    outliers: float = 0.0
    coherent: float = 0.0
    dropouts: float = 0.0
    dropout_seconds: float = 0.3
    outages: tuple[Outage, ...] = ()
    views: int | None = None
    offsets: tuple[float, ...] = ()
    jitter: float = 0.0
    calibration: float = 0.0
    map_error: float = 0.0
    correlated: float = 0.0
    correlated_seconds: float = 2.0
    churn: float = 0.0
    reveal: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name in SHARES:
            _check(name, getattr(self, name), 0 <= getattr(self, name) <= 1, "a share, 0 to 1")
        for name in SIZES:
            _check(name, getattr(self, name), 0 <= getattr(self, name) < math.inf, "a finite number >= 0")
        if self.dropouts:
            _check("dropout_seconds", self.dropout_seconds, self.dropout_seconds > 0, "> 0 s with dropouts")
        for spell in [*self.outages, *([self.reveal] if self.reveal else [])]:
            _check("spell", spell, spell[0] <= spell[1], "from <= to, s")
        _check("views", self.views, self.views is None or self.views >= 1, "None, or at least 1")


def _check(name: str, value: object, good: bool, allowed: str) -> None:
    if not good:
        raise InputError(WHERE, name, value, allowed)
