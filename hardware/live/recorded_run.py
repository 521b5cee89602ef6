"""A recorded run, examined afterwards: its motion replayed byte by byte, and its true error at the nozzle.

The true error is known where a scenario's pictures were shown to a virtual arm; nobody in the loop knows it. The
simulator's own ledger compares what was commanded with what the arm did, millisecond by millisecond. The truth is that
of the pictures, which is part of the recording, interpolated between their instants.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path as File

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import frame_from_command
from hardware.files.arm_file import read_arm
from hardware.files.folder_tables import trajectory_from_rows
from hardware.files.path_file import read_path
from hardware.live.prepared import RunFiles
from hardware.motion.step import MotionStep
from hardware.offline.replay import CommandWriter
from hardware.process.progress import prepare_out
from hardware.recording.mcap_file import AttachedFile, ChunkMessages, Damage, parse, walk
from hardware.recording.messages import (
    Message,
    bytes_from_message,
    move_from_message,
    pose_from_message,
    row_from_message,
)
from hardware.recording.session_reader import PATH_ATTACHMENT, inputs_from_texts, used_inputs
from hardware.simulator.truth import Truth, TruthLog, row_instants
from planning.command import Command, Hold
from planning.path import Path
from planning.progress import PrintPhase, PrintProgress

RUN_REQUIRED = "the recording of a run that began to print, or give --path"


@dataclass(slots=True)
class _RecordedMotion:
    """What a recording says of a run's motion."""

    texts: dict[str, str] = field(default_factory=dict)
    poses: dict[float, SurfacePose] = field(default_factory=dict)
    ticks: list[Message] = field(default_factory=list)
    damage: str = ""


@dataclass(frozen=True, slots=True)
class ReplayCount:
    """How many frames were replayed, how many of them not as recorded, and what was lost of the file, "" if nothing."""

    frames: int
    other: int
    damage: str


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedTick:
    """One tick: s, what was decided anew, the frame of that, and the frame that the run gave."""

    stamp: float
    command: Command
    frame: bytes
    recorded: bytes


def replay_run(record: File) -> Iterator[ReplayedTick]:
    """Every tick of a recorded run in which planner and guard were asked, decided anew from the recorded poses."""
    run = _read_motion(record)
    return _replay_ticks(run, *inputs_from_texts(run.texts, record), record)


def _replay_ticks(run: _RecordedMotion, path: Path, profile: ArmProfile, record: File) -> Iterator[ReplayedTick]:
    step: MotionStep | None = None
    for tick in sorted(run.ticks, key=lambda tick: float(tick["stamp"])):
        if tick["begun"]:
            step = MotionStep(path, profile, float(tick["begun"][0]))
        if step is not None and tick.get("recalled"):
            step.recalled(*np.array(tick["recalled"], float).reshape(2, 6))
        if step is None or not tick["asked"]:
            continue
        stamp = tick["pose_stamp"]
        if stamp and stamp[0] not in run.poses:
            raise InputError(record, "/tick: pose_stamp", stamp[0], "a pose that is recorded")
        now = float(tick["stamp"])
        step.paused = bool(tick.get("paused"))
        command = step(run.poses[stamp[0]] if stamp else None, now)
        frame = frame_from_command(command, profile.dialect)
        yield ReplayedTick(now, command, frame, bytes_from_message({"data": tick["frame"]}))


def _read_motion(record: File) -> _RecordedMotion:
    run = _RecordedMotion()
    for part in walk(record):
        if isinstance(part, Damage):
            run.damage = part.text
        elif isinstance(part, AttachedFile):
            run.texts[part.name] = part.data.decode("utf-8", "replace")
        elif isinstance(part, ChunkMessages):
            for stored in part.messages:
                if stored.topic == "/tick":
                    run.ticks.append(parse(record, stored))
                elif stored.topic == "/pose":
                    pose = pose_from_message(parse(record, stored))
                    run.poses[pose.stamp] = pose
    return run


def write_replay(record: File, out: File, force: bool = False) -> ReplayCount:
    """Replay a run into commands.csv and frames.bin of the folder `out`.

    InputError where the recording holds no run, or `out` holds something and `force` is not set; nothing is made then.
    """
    if record.is_dir():
        raise InputError(record, "recording", "a session folder", RUN_REQUIRED)
    run = _read_motion(record)
    if PATH_ATTACHMENT not in run.texts:
        raise InputError(record, "recording", "no path", RUN_REQUIRED)
    path, profile = inputs_from_texts(run.texts, record)
    prepare_out(out, force)
    frames = other = 0
    with CommandWriter(out) as writer:
        for tick in _replay_ticks(run, path, profile, record):
            writer.write(tick.command, tick.frame)
            frames += 1
            other += tick.frame != tick.recorded
    return ReplayCount(frames, other, run.damage)


BLOCK_SECONDS = 10.0  # s of rows judged at once
TRUTH_TOPICS = ("/tick", "/move", "/hold", "/truth")


@dataclass(frozen=True, slots=True, eq=False)
class NozzleErrors:
    """distance: (N,) mm, nozzle to its place, of each extruding millisecond. duty: share of the time due in which
    material left; NaN where none was due. printed: (2,) the first and last place extruded, counted in checkpoints.
    deepest: s of motion that the arm ever had queued. held_up: s that a busy machine kept the virtual arm from its line
    at most.
    """

    distance: Array
    duty: float
    printed_range: tuple[float, float]
    deepest: float
    held_up: float

    def figure(self, share: float) -> float:
        """Error, mm, that `share` percent do not exceed; NaN of none."""
        return float(np.percentile(self.distance, share)) if len(self.distance) else float("nan")


class _TrueMotion:
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


def nozzle_errors(record: File, path: File, arm: File) -> NozzleErrors:
    """path: checkpoints in the true surface frame; arm: the arm as it truly stands. InputError without ticks."""
    found = _read(record)
    if not found["/tick"] or len(found["/truth"]) < 2:
        raise InputError(record, "recording", "no ticks or no truth", "a run before pre-rendered pictures")
    true, profile = read_arm(arm), used_inputs(record)[1]  # ticks and lag are as the run took them
    truth = Truth(np.eye(4), _TrueMotion(_increasing_stamps([row_from_message(m) for m in found["/truth"]])))
    ledger = TruthLog(read_path(path), true.arm, truth, profile.tick, profile.lag)
    commands = _commands(found)
    for command, progress in commands:
        ledger.write(command, progress)
    with np.load(RunFiles(record).executed) as executed:
        stamps, axes = executed["stamps"], executed["axes"]
        deepest, held_up = float(executed["deepest"]), float(executed["held_up"])
    first, last = commands[0][0].stamp, min(ledger.known_until, float(stamps[-1]))

    def at(times: Array) -> Array:
        return np.stack([np.interp(times, stamps, axes[:, i]) for i in range(6)], axis=1)

    errors, extruding, due = list[Array](), 0, 0
    finished = _finish_instant(commands)
    for start in np.arange(first, last, BLOCK_SECONDS):
        log = ledger.rows(row_instants(start, min(start + BLOCK_SECONDS, last)), at)
        told = log.extrude & np.isfinite(log.place)
        off = log.base_from_nozzle[told, :3, 3] - log.base_from_target[told, :3, 3]
        errors.append(np.linalg.norm(off, axis=1))
        extruding += int(log.extrude.sum())
        due += int((np.isfinite(log.place) & (log.place > 0) & (log.stamps < finished)).sum())
    duty = extruding / due if due else float("nan")
    return NozzleErrors(np.concatenate(errors), duty, printed_range(record), deepest, held_up)


def printed_range(record: File) -> tuple[float, float]:
    """First and last place, counted in checkpoints, at which a run extruded; NaN where it did not."""
    found = _read(record)
    extruding = {m["stamp"] for m in found["/move"] if m["extrude"]}
    places = [float(m["fraction"]) for m in found["/tick"] if m["stamp"] in extruding]
    return (min(places), max(places)) if places else (float("nan"), float("nan"))


def _read(record: File) -> dict[str, list[Message]]:
    found: dict[str, list[Message]] = {topic: [] for topic in TRUTH_TOPICS}
    for part in walk(record):
        if isinstance(part, ChunkMessages):
            for stored in part.messages:
                if stored.topic in found:
                    found[stored.topic].append(parse(record, stored))
    return found


def _increasing_stamps(rows: list[list[float]]) -> Array:
    unique: NDArray[np.float64] = np.unique(np.array(rows), axis=0)
    return np.asarray(unique[np.concatenate([[True], np.diff(unique[:, 0]) > 0])])


def _commands(found: dict[str, list[Message]]) -> list[tuple[Command, PrintProgress]]:
    """What was commanded, in order, with the place on the path."""
    ticks = {m["stamp"]: m for m in found["/tick"]}
    moves = {m["stamp"]: m for m in found["/move"]}
    return list(_commands_in_order(dict(sorted(ticks.items())), moves))


def _commands_in_order(
    ticks: dict[float, Message], moves: dict[float, Message]
) -> Iterator[tuple[Command, PrintProgress]]:
    for stamp, tick in ticks.items():
        move, fraction, phase = moves.get(stamp), float(tick["fraction"]), PrintPhase(tick["phase"])
        command: Command = Hold(stamp, 0.001, "held")
        if move is not None:
            command = move_from_message(move)
        yield command, PrintProgress(phase, 0, 0, fraction, 0.0, fraction)


def _finish_instant(commands: list[tuple[Command, PrintProgress]]) -> float:
    """The instant, s, from which nothing is due any more."""
    ends = [
        command.stamp for command, progress in commands if progress.phase in (PrintPhase.LEAVING, PrintPhase.FINISHED)
    ]
    return min(ends, default=float("inf"))
