"""The true error at the nozzle of a run before pre-rendered pictures with the virtual arm: nobody in the loop knows it.

The same ledger as in the simulator sets what was commanded beside what the arm did, millisecond by millisecond; the
truth is that of the pictures, which goes along in the recording, between whose instants it runs evenly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path as File

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.files.arm_file import read_arm
from hardware.files.path_file import read_path
from hardware.live.beside import Beside
from hardware.live.kept import used_in
from hardware.recording.mcap_file import ChunkOf, parse, walk
from hardware.recording.messages import Message, move_from_message, row_from_message
from hardware.simulator.ledger import Ledger, executed_rows
from hardware.simulator.truth import Truth
from hardware.tum import trajectory_from_rows
from planning.command import Command, Hold
from planning.progress import Phase, Progress

BLOCK = 10.0  # s of rows judged at once
TOPICS = ("/tick", "/move", "/hold", "/truth")


@dataclass(frozen=True, slots=True, eq=False)
class TrueError:
    """distance: (N,) mm, nozzle to its place, of each extruding millisecond. duty: share of the time due in which
    material left; NaN where none was due. printed: (2,) the first and last place extruded, counted in checkpoints.
    deepest: s of motion that the arm ever had queued. held_up: s that a busy machine kept the virtual arm from its line
    at most.
    """

    distance: Array
    duty: float
    printed: tuple[float, float]
    deepest: float
    held_up: float

    def figure(self, share: float) -> float:
        """Error, mm, that `share` percent do not exceed; NaN of none."""
        return float(np.percentile(self.distance, share)) if len(self.distance) else float("nan")


class _Between:
    """A motion known at some instants."""

    def __init__(self, rows: Array) -> None:
        known = trajectory_from_rows(rows, True)
        self._stamps, self._poses = known.stamps, known.base_from_surface

    def __call__(self, times: Array) -> Array:
        """(N, 4, 4) at times (N,), s."""
        after = np.clip(np.searchsorted(self._stamps, times), 1, len(self._stamps) - 1)
        span = self._stamps[after] - self._stamps[after - 1]
        share = np.clip((times - self._stamps[after - 1]) / span, 0.0, 1.0)
        return se3.interpolate(self._poses[after - 1], self._poses[after], share)

    def twist(self, times: Array) -> Array:
        """Nobody asks for it here."""
        raise NotImplementedError


def judge_run(record: File, path: File, arm: File) -> TrueError:
    """path: checkpoints in the true surface frame; arm: the arm as it truly stands. InputError without ticks."""
    found = _read(record)
    if not found["/tick"] or len(found["/truth"]) < 2:
        raise InputError(record, "recording", "no ticks or no truth", "a run before pre-rendered pictures")
    true, profile = read_arm(arm), used_in(record)[1]  # ticks and lag are as the run took them
    truth = Truth(np.eye(4), _Between(_rising([row_from_message(m) for m in found["/truth"]])))
    ledger = Ledger(read_path(path), true.arm, truth, profile.tick, profile.lag)
    commands = _commands(found)
    for command, progress in commands:
        ledger.write(command, progress)
    with np.load(Beside(record).executed) as executed:
        stamps, axes = executed["stamps"], executed["axes"]
        deepest, held_up = float(executed["deepest"]), float(executed["held_up"])
    first, last = commands[0][0].stamp, min(ledger.known_until, float(stamps[-1]))

    def at(times: Array) -> Array:
        return np.stack([np.interp(times, stamps, axes[:, i]) for i in range(6)], axis=1)

    errors, extruding, due = list[Array](), 0, 0
    finished = _finished(commands)
    for start in np.arange(first, last, BLOCK):
        log = ledger.rows(executed_rows(start, min(start + BLOCK, last)), at)
        told = log.extrude & np.isfinite(log.place)
        off = log.base_from_nozzle[told, :3, 3] - log.base_from_target[told, :3, 3]
        errors.append(np.linalg.norm(off, axis=1))
        extruding += int(log.extrude.sum())
        due += int((np.isfinite(log.place) & (log.place > 0) & (log.stamps < finished)).sum())
    duty = extruding / due if due else float("nan")
    return TrueError(np.concatenate(errors), duty, printed(record), deepest, held_up)


def printed(record: File) -> tuple[float, float]:
    """First and last place, counted in checkpoints, at which a run extruded; NaN where it did not."""
    found = _read(record)
    extruding = {m["stamp"] for m in found["/move"] if m["extrude"]}
    places = [float(m["fraction"]) for m in found["/tick"] if m["stamp"] in extruding]
    return (min(places), max(places)) if places else (float("nan"), float("nan"))


def _read(record: File) -> dict[str, list[Message]]:
    found: dict[str, list[Message]] = {topic: [] for topic in TOPICS}
    for part in walk(record):
        if isinstance(part, ChunkOf):
            for stored in part.messages:
                if stored.topic in found:
                    found[stored.topic].append(parse(record, stored))
    return found


def _rising(rows: list[list[float]]) -> Array:
    unique: NDArray[np.float64] = np.unique(np.array(rows), axis=0)
    return np.asarray(unique[np.concatenate([[True], np.diff(unique[:, 0]) > 0])])


def _commands(found: dict[str, list[Message]]) -> list[tuple[Command, Progress]]:
    """What was commanded, in order, with the place on the path."""
    ticks = {m["stamp"]: m for m in found["/tick"]}
    moves = {m["stamp"]: m for m in found["/move"]}
    return list(_told(dict(sorted(ticks.items())), moves))


def _told(ticks: dict[float, Message], moves: dict[float, Message]) -> Iterator[tuple[Command, Progress]]:
    for stamp, tick in ticks.items():
        move, fraction, phase = moves.get(stamp), float(tick["fraction"]), Phase(tick["phase"])
        command: Command = Hold(stamp, 0.001, "held")
        if move is not None:
            command = move_from_message(move)
        yield command, Progress(phase, 0, 0, fraction, 0.0, fraction)


def _finished(commands: list[tuple[Command, Progress]]) -> float:
    """The instant, s, from which nothing is due any more."""
    ends = [command.stamp for command, progress in commands if progress.phase in (Phase.LEAVING, Phase.FINISHED)]
    return min(ends, default=float("inf"))
