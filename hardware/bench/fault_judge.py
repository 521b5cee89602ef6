"""What is asked of a print in which something goes wrong: said soon, no harm, at rest where it holds, back soon."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from estimation.se3 import Array
from hardware.bench.fault_run import BEFORE, Ran, Rows, speeds
from hardware.process.faults import Fault, Kind, Part

WRONG = 1.0  # mm: the largest error that a print may have while it extrudes
USUAL = 1.5  # times the largest error of the same run before anything went wrong: what a scenario has anyway
SOON = 0.1  # s: an error that lasts for less is what detection may take
REST = 0.25  # s from the last move until the arm must rest: what is queued, its lag, and what an echo takes
STILL = 1.0  # mm/s
HELD = 0.4  # s of a hold that is looked at
AFTER = 1.2  # s after its beginning that must have been watched
LATE, SLOW = 0.1, 0.2  # s: targets of detection, and of going on once the cause is gone
FINAL = (Kind.KILL,)
SHOWN = (Part.CAMERA, Part.SURFACE)  # by pictures; the stamp of a pose tells nothing of an arm or a process


@dataclass(frozen=True, slots=True)
class Verdict:
    """One fault, judged; times in s, NaN where there is nothing to tell.

    detected: from its beginning until somebody said something: the motion, or the conducting process of one that is
    silent. seen: of what pictures show, until the exposure of the pose that said so; of all else, detected. worst: mm,
    the largest error while extruding from then on, 0 where nothing was. silent: too far off while extruding, and nobody
    said anything. restless: it held, and the arm moved. recovered: from the end of the cause until moves go out and
    nothing is to be said; inf where that never came. operator: whether an operator was needed.
    """

    fault: Fault
    detected: float
    seen: float
    worst: float
    silent: bool
    restless: bool
    recovered: float
    operator: bool


def judged(ran: Ran, fault: Fault, until: float) -> Verdict | None:
    """The verdict on one fault of a run, `until`, s, the next one begins; None where nothing was printed before it."""
    assert ran.log is not None
    spoken = sorted(ran.words + ran.missed, key=lambda word: word.stamp)
    log, stamps = ran.log, np.array([word.stamp for word in spoken])
    said = np.array([bool(word.said) for word in spoken])
    moving = np.array([word.moving for word in spoken])
    own = np.array([word.own for word in spoken])
    ready = (stamps >= fault.start - 0.3) & (stamps < fault.start)
    if not ready.any() or not moving[ready].all() or said[ready].any() or ran.ended < fault.start + AFTER:
        return None
    error = np.linalg.norm((log.base_from_nozzle - log.base_from_target)[:, :3, 3], axis=1)
    error[~log.extrude] = np.nan
    during, words = (log.stamps >= fault.start) & (log.stamps < until), (stamps >= fault.start) & (stamps < until)
    first = np.flatnonzero(words & said)
    detected = float(stamps[first[0]] - fault.start) if len(first) else np.nan
    return Verdict(
        fault=fault,
        detected=detected,
        seen=_seen(spoken[first[0]].seen, detected, fault) if len(first) else np.nan,
        worst=float(np.nanmax(np.append(error[during], 0.0))),
        silent=_silent(log.stamps, error, during, stamps[words & said], _usual(log.stamps, error)),
        restless=_restless(ran, stamps[words], (moving | own)[words], log.stamps),
        recovered=_recovered(stamps[words], said[words] | ~moving[words], fault),
        operator=any(fault.start <= stamp < until for stamp in ran.stopped),
    )


def _seen(stamp: float, detected: float, fault: Fault) -> float:
    """From the beginning until the exposure of a pose with this stamp; of what pictures do not show, until known."""
    return max(stamp - fault.start, 0.0) if fault.part in SHOWN else detected


def _usual(stamps: Array, error: Array) -> float:
    before = error[stamps < BEFORE]
    return float(np.nanmax(np.append(before, 0.0)))


def _silent(stamps: Array, error: Array, during: Rows, said: Array, usual: float) -> bool:
    """Whether the error was too large for longer than `SOON` with nothing said in that time or just before."""
    wrong = stamps[during & (error > max(WRONG, USUAL * usual))]
    if not len(wrong):
        return False
    breaks = np.flatnonzero(np.diff(wrong) > SOON / 2)
    for stretch in np.split(wrong, breaks + 1):
        told = ((said >= stretch[0] - SOON) & (said <= stretch[0] + SOON)).any()
        if stretch[-1] - stretch[0] > SOON and not told:
            return True
    return False


def _restless(ran: Ran, stamps: Array, moving: Rows, rows: Array) -> bool:
    """Whether the arm moved while no move was sent for so long that it must have come to rest."""
    assert ran.log is not None
    speed = speeds(ran.log)
    sent = stamps[moving]
    edges = np.concatenate([stamps[:1], sent, stamps[-1:]])
    for last, following in pairwise(edges.tolist()):
        if following - last > HELD:
            still = (rows > last + REST) & (rows < following - 0.02)
            if still.any() and speed[still].max() > STILL:
                return True
    return False


def _recovered(stamps: Array, disturbed: Rows, fault: Fault) -> float:
    """From the end of the cause until the first tick of 0.1 s without a word or a hold."""
    if fault.kind in FINAL or not np.isfinite(fault.duration) or fault.part is Part.CLOCK:
        return np.nan
    late = fault.amount if fault.kind is Kind.SLOW and fault.part is Part.CAMERA else 0.0  # what is on its way
    after = stamps >= fault.end + late
    quiet = [
        float(stamp - fault.end - late)
        for stamp in stamps[after & ~disturbed]
        if not disturbed[(stamps >= stamp) & (stamps < stamp + SOON)].any()
    ]
    return max(quiet[0], 0.0) if quiet else np.inf
