"""What is asked of a tracker in an outage: not lost in silence, flagged soon, back soon and well."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.pose import TrackState
from estimation.se3 import Array
from hardware.bench.outage_run import Watched

WRONG = 0.5  # mm: an error below is of no harm to a print with a nozzle of 0.4 mm
BEYOND = 3.0  # times the radius claimed for 95 %: of normal errors not one in a million lies there
GOOD = 0.2  # mm, within which a pose is back
QUARTER = 0.25  # of its tracks: a camera that keeps more still sees the surface


@dataclass(frozen=True, slots=True)
class Verdict:
    """One outage, judged.

    silent: TRACKING while wrong. beyond: off by more than it claims in any state but LOST. worst: mm, the largest error
    while TRACKING or DEGRADED. flagged: s from the first affected frame set until the state or its reason says so; nan
    where nothing had to be said. back: s from the view's return to TRACKING without a reservation, inf if never; after:
    mm, the error then, or worse afterwards.
    """

    silent: bool
    beyond: bool
    worst: float
    flagged: float
    back: float
    after: float


def judge(watched: Watched) -> Verdict:
    """The verdict on one outage."""
    stamps, outage = watched.stamps, watched.outage
    during = stamps >= outage.start - 1e-9
    after = stamps >= outage.end - 1e-9
    wrong = (watched.error > np.maximum(WRONG, BEYOND * watched.radius)) & during
    tracking = np.array([s is TrackState.TRACKING for s in watched.states])
    lost = np.array([s is TrackState.LOST for s in watched.states])
    measured = np.array([s.measured for s in watched.states])
    plain = tracking & np.array([not r for r in watched.reasons])
    back = np.flatnonzero(after & plain)
    return Verdict(
        silent=bool((wrong & tracking).any()),
        beyond=bool((wrong & ~lost).any()),
        worst=float(watched.error[during & measured].max(initial=0.0)),
        flagged=_flagged(watched, during & ~after, plain),
        back=float(stamps[back[0]] - outage.end) if len(back) else np.inf,
        after=float(watched.error[back[0] :][measured[back[0] :]].max()) if len(back) else np.inf,
    )


def _flagged(watched: Watched, during: NDArray[np.bool_], plain: NDArray[np.bool_]) -> float:
    """s from the first affected frame set to the first that says so; nan where the view is back before it must."""
    affected = np.flatnonzero(during & _affected(watched, during))
    if not len(affected):
        return np.nan
    first, last = int(affected[0]), int(np.flatnonzero(during)[-1])
    said = np.flatnonzero(~plain[first : last + 1])
    if len(said):
        return float(watched.stamps[first + said[0]] - watched.stamps[first])
    span = float(watched.stamps[last] - watched.stamps[first])
    return np.nan if span < 0.1 else np.inf


def _affected(watched: Watched, during: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Frame sets (K,) in which a struck camera is blind, has lost three quarters of its tracks, or the pose is off."""
    if watched.outage.kind.blinds:
        return np.ones(len(watched.stamps), bool)
    before: Array = np.median(watched.used[watched.stamps < watched.outage.start], axis=0)
    struck = list(watched.outage.cameras)
    fewer = (watched.used[:, struck] < QUARTER * before[struck]).any(1)
    return np.asarray(fewer | (watched.error > GOOD))
