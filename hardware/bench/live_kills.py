"""Random processes of a run killed at random instants: is the arm at rest, and does the next run go on where it was?"""

from __future__ import annotations

import csv
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.bench.figures import Figure, at_most
from hardware.bench.live_session import LiveSession
from hardware.files.session import open_session
from hardware.live.beside import Beside
from hardware.live.recorded_run import printed
from hardware.process.checks import read_toml
from hardware.process.clock import WallClock
from hardware.process.progress import Progress

NOTICED = ("tracking", "motion", "recorder")  # by the process that conducts; the feed's end is the cameras'
VICTIMS = ("run", "tracking", "motion", "recorder", "feed")
DONE = "the path is printed"
LONGEST = 3.0  # s of printing before a kill
WITHIN = 0.5  # s after a kill in which the arm must have come to rest: noticed in 0.1, queued for 0.05, its servo
SHORTEST = 0.05  # s of rest that are looked at
STILL = 0.05  # mm from where it ended
ENDED = 60.0  # s in which the others must have ended
EXECUTED = 30.0  # s in which the virtual arm has written what it did


@dataclass(slots=True)
class Kills:
    """What came of them.

    out: folder for a table of them, and for what is left of runs whose arm moved on; None: nothing is kept. rests: s
    after each kill until the arm rested. stuck: last words of the runs that did not print. lost, doubled: in
    checkpoints, of each resumed run. unread: s before the kill from which the recording cannot be read. noticed: s
    until the conducting process said so.
    """

    out: Path | None = None
    count: int = 0
    rests: list[float] = field(default_factory=list)
    stuck: list[str] = field(default_factory=list)
    lost: list[float] = field(default_factory=list)
    doubled: list[float] = field(default_factory=list)
    unread: list[float] = field(default_factory=list)
    noticed: list[float] = field(default_factory=list)

    def keep(self, record: Path, victim: str, place: float) -> None:
        """Add the last kill to the table; where the arm moved on, keep all that the run has left."""
        if self.out is None:
            return
        file, late = self.out / "kills.csv", self.rests[-1] > WITHIN
        new = not file.exists()
        with file.open("a", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            if new:
                writer.writerow(("record", "killed", "rests_s", "place"))
            writer.writerow((record.name, victim, f"{self.rests[-1]:.3f}", f"{place:.3f}"))
        for left in record.parent.glob(f"{record.stem}.*") if late else ():
            shutil.copy(left, self.out)


def kill_figures(scenario: Path, folder: Path, path: Path, count: int, seed: int, out: Path | None) -> list[Figure]:
    """Kill `count` processes, each in the run that resumes the one before; after a finished print a new one begins."""
    rng, clock, kills = np.random.default_rng(seed), WallClock(), Kills(out)
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
        Figure(f"{name}: arms not at rest after {WITHIN:g} s", sum(s > WITHIN for s in kills.rests), "", at_most(0)),
        Figure(f"{name}: arm at rest after, median", 1000 * float(np.median(kills.rests or np.nan)), "ms"),
        Figure(f"{name}: arm at rest after, most", 1000 * max(kills.rests, default=np.nan), "ms"),
        Figure(f"{name}: runs that did not print again", len(kills.stuck), "", at_most(0), "", "; ".join(kills.stuck)),
        Figure(f"{name}: most left out", max(kills.lost, default=np.nan), "checkpoints", at_most(1)),
        Figure(f"{name}: most printed twice", max(kills.doubled, default=np.nan), "checkpoints", at_most(0)),
        Figure(f"{name}: death of a process noticed, median", 1000 * float(np.median(kills.noticed or np.nan)), "ms"),
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
    kills.rests.append(_rest(record, now))
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
    kills.keep(record, victim, last)
    return last if np.isfinite(last) else before if before is not None else float("nan")


def _rest(record: Path, killed: float) -> float:
    """How long, s, after the kill the virtual arm came to where it ended; inf where it ended in motion."""
    clock, file = WallClock(), Beside(record).executed
    until = clock.now() + EXECUTED
    while not file.exists() and clock.now() < until:
        clock.wait_until(clock.now() + 0.1)
    clock.wait_until(clock.now() + 0.3)
    with np.load(file) as executed:
        stamps, axes = executed["stamps"], executed["axes"]
    return rest(stamps, axes, killed)


def rest(stamps: Array, axes: Array, since: float) -> float:
    """How long, s, after `since` an arm that was at `axes` (N, 6) at `stamps` (N,), s, came to rest; inf: never.

    Rest is to stay within `STILL` of where it ended, for the last `SHORTEST` at least.
    """
    away = np.linalg.norm(axes[:, :3] - axes[-1, :3], axis=1) > STILL
    if not away.any():
        return 0.0
    last = float(stamps[away][-1])
    return max(last - since, 0.0) if last < stamps[-1] - SHORTEST else float("inf")
