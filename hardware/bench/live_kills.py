"""Random processes of a run killed at random instants: is the arm at rest, and does the next run go on where it was?"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from hardware.bench.figure import Figure, at_most
from hardware.bench.live_session import LiveSession
from hardware.checks import read_toml
from hardware.clock import WallClock
from hardware.live.beside import Beside
from hardware.live.judge import printed
from hardware.progress import Progress
from hardware.session import open_session

NOTICED = ("tracking", "motion", "recorder")  # by the process that conducts; the feed's end is the cameras'
VICTIMS = ("run", "tracking", "motion", "recorder", "feed")
DONE = "the path is printed"
LONGEST = 3.0  # s of printing before a kill
WITHIN = 0.5  # s after a kill in which the arm must have come to rest: noticed in 0.1, queued for 0.05, its servo
SHORTEST = 0.05  # s of rest that are looked at
STILL = 0.05  # mm
ENDED = 60.0  # s in which the others must have ended
EXECUTED = 30.0  # s in which the virtual arm has written what it did


@dataclass(slots=True)
class Kills:
    """What came of them.

    restless: arms that moved on. stuck: last words of the runs that did not print. lost, doubled: in checkpoints, of
    each resumed run. unread: s before the kill from which the recording cannot be read. noticed: s until the
    conducting process said so.
    """

    count: int = 0
    restless: int = 0
    stuck: list[str] = field(default_factory=list)
    lost: list[float] = field(default_factory=list)
    doubled: list[float] = field(default_factory=list)
    unread: list[float] = field(default_factory=list)
    noticed: list[float] = field(default_factory=list)


def kill_figures(scenario: Path, folder: Path, path: Path, count: int, seed: int) -> list[Figure]:
    """Kill `count` processes, each in the run that resumes the one before; after a finished print a new one begins."""
    rng, clock, kills = np.random.default_rng(seed), WallClock(), Kills()
    record: Path | None = None
    place = float("nan")
    with Progress("kills", "kills", clock.now) as progress:
        for number in range(count):
            fresh = record is None
            if record is None:
                record, place = folder / f"kill{number}.mcap", float("nan")
                arguments = ["--simulated", str(scenario), "--path", str(path), "--record", str(record)]
            else:
                arguments = ["--resume", str(record)]
                record = Beside(record).next().record
            run = LiveSession([*arguments, "--no-page", "--yes"])
            place = _kill(run, record, kills, rng, None if fresh else place)
            record = record if np.isfinite(place) else None
            progress(number + 1, count)
    name = f"{kills.count} kills"
    return [
        Figure(f"{name}: arms not at rest after {WITHIN:g} s", kills.restless, "", at_most(0)),
        Figure(f"{name}: runs that did not print again", len(kills.stuck), "", at_most(0), "", "; ".join(kills.stuck)),
        Figure(f"{name}: most left out", max(kills.lost, default=np.nan), "checkpoints", at_most(1)),
        Figure(f"{name}: most printed twice", max(kills.doubled, default=np.nan), "checkpoints", at_most(0)),
        Figure(
            f"{name}: death of a process noticed, most", 1000 * max(kills.noticed, default=np.nan), "ms", at_most(100)
        ),
        Figure(f"{name}: recording ends before the kill, most", max(kills.unread, default=np.nan), "s", at_most(1)),
    ]


def _kill(run: LiveSession, record: Path, kills: Kills, rng: np.random.Generator, before: float | None) -> float:
    """Kill one process of a run; the last place that it extruded, NaN where there is none to go on from."""
    clock = WallClock()
    try:
        if run.wait_for("\nprint\n") < 0:
            if DONE not in run.said:  # nothing is left where the run before was killed on its way home
                kills.stuck.append(run.last_words)
            return float("nan")
        clock.wait_until(clock.now() + rng.uniform(0, LONGEST))
        victim = str(rng.choice(VICTIMS))
        now = run.kill(victim)
        if victim in NOTICED and run.wait_for("was killed", patience=ENDED) >= 0:
            kills.noticed.append(clock.now() - now)
        run.end(ENDED)
    finally:
        run.close()
    if not np.isfinite(now) or DONE in run.said:
        return float("nan")
    kills.count += 1
    kills.restless += not _rests(record, now)
    first, last = printed(record)
    if before is not None and np.isfinite(first):
        kills.lost.append(max(first - before, 0.0))
        kills.doubled.append(max(before - first, 0.0))
    try:
        kills.unread.append(max(now - open_session(record).sets[-1][0].stamp, 0.0))
    except InputError:
        kills.unread.append(float("inf"))
    if victim == "recorder":  # its recording ends before the arm did: what is kept of the place is all that is known
        last = float(read_toml(Beside(record).progress)["fraction"])
    return last if np.isfinite(last) else before if before is not None else float("nan")


def _rests(record: Path, killed: float) -> bool:
    """Whether the virtual arm stood still from WITHIN after the kill on."""
    clock, file = WallClock(), Beside(record).executed
    until = clock.now() + EXECUTED
    while not file.exists() and clock.now() < until:
        clock.wait_until(clock.now() + 0.1)
    clock.wait_until(clock.now() + 0.3)
    with np.load(file) as executed:
        stamps, axes = executed["stamps"], executed["axes"]
    after = axes[stamps > min(killed + WITHIN, stamps[-1] - SHORTEST)]  # a run may have ended all before
    return bool(np.ptp(after[:, :3], axis=0).max() < STILL)
