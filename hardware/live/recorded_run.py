"""A recorded run, examined afterwards: its motion replayed byte by byte, and its true error at the nozzle.

The true error is known where a scenario's pictures were shown to a virtual arm; nobody in the loop knows it. The
simulator's truth log compares what was commanded with what the arm did, millisecond by millisecond. The truth is that
of the pictures, which is part of the recording, interpolated between their instants.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path as File

import numpy as np

from estimation.errors import InputError
from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.files.arm_file import arm_from_text, read_arm
from hardware.files.folder_tables import trajectory_from_rows
from hardware.files.path_file import read_path
from hardware.live.prepared import RunFiles
from hardware.motion.loop import Tick
from hardware.motion.print_loop import PrintLoop
from hardware.motion.step import BeginPrint
from hardware.offline.replay import CommandWriter
from hardware.process.clock import SimClock
from hardware.process.progress import prepare_out
from hardware.recording.loop_playback import PartedError, PlayedFrame, PlayedOutError, PlayedSource
from hardware.recording.loop_record import LOOP_ARM_ATTACHMENT
from hardware.recording.mcap_file import AttachedFile, ChunkMessages, Damage, damage_words, parse, walk
from hardware.recording.messages import (
    Message,
    move_from_message,
    pose_from_message,
    row_from_message,
)
from hardware.recording.session_reader import PATH_ATTACHMENT, inputs_from_texts
from hardware.simulator.deposit import NozzleLog, PlannedLine, join_logs, planned_line
from hardware.simulator.dispenser import VirtualDispenserSettings
from hardware.simulator.material import flow_from_told
from hardware.simulator.nozzle_error import MaterialFigures, material_figures
from hardware.simulator.nozzle_error import nozzle_errors as row_errors
from hardware.simulator.truth import Truth, TruthLog, row_instants
from planning.command import Command, Hold
from planning.material import Outlets
from planning.path import PrintPhase, PrintProgress

RUN_REQUIRED = "the recording of a run that began to print, or give --path"


@dataclass(slots=True)
class _RecordedRun:
    """What a recording holds of a run."""

    texts: dict[str, str]  # of attached files, by name
    messages: dict[str, list[Message]]  # by topic, in the order of the file
    damage: str = ""  # what was lost of the file, "" if nothing

    @property
    def poses(self) -> dict[float, SurfacePose]:
        """By stamp, s."""
        return {pose.stamp: pose for pose in map(pose_from_message, self.messages["/pose"])}


def _read_run(record: File, *topics: str) -> _RecordedRun:
    run, damages = _RecordedRun({}, {topic: [] for topic in topics}), list[Damage]()
    for part in walk(record):
        if isinstance(part, Damage):
            damages.append(part)
        elif isinstance(part, AttachedFile):
            run.texts[part.name] = part.data.decode("utf-8", "replace")
        elif isinstance(part, ChunkMessages):
            for stored in part.messages:
                if stored.topic in run.messages:
                    run.messages[stored.topic].append(parse(record, stored))
    run.damage = damage_words(damages)
    return run


@dataclass(frozen=True, slots=True)
class ReplayCount:
    """How many frames were replayed, how many of them not as recorded, and what was lost of the file, "" if nothing."""

    frames: int
    other: int
    damage: str
    parted: str  # where the loop did something else than it did then, "" if nowhere


def replay_run(record: File) -> list[PlayedFrame]:
    """Every frame that a recorded run gave its arm, decided anew; PartedError where the loop did something else."""
    run, frames = _read_run(record, "/loop", "/pose"), list[PlayedFrame]()
    _play(run, record, frames.append, lambda tick: None)
    return frames


def _play(
    run: _RecordedRun, record: File, taken: Callable[[PlayedFrame], None], report: Callable[[Tick], None]
) -> None:
    """The loop of a recorded run, once more, as far as it was recorded."""
    if LOOP_ARM_ATTACHMENT not in run.texts:
        raise InputError(record, "recording", "no /loop", "of a run that recorded what its loop was given")
    profile = arm_from_text(run.texts[LOOP_ARM_ATTACHMENT], record / LOOP_ARM_ATTACHMENT)

    def begin(start: float, outlets: Outlets) -> BeginPrint:
        inputs = inputs_from_texts(run.texts, record)
        return BeginPrint(inputs.path, inputs.profile, start, outlets, "", inputs.tissue)

    try:
        source = PlayedSource(run.messages["/loop"], run.poses, begin, profile, taken)
        PrintLoop(source, profile, source.settings, SimClock(), report).run()
    except PlayedOutError:
        pass


def write_replay(record: File, out: File, force: bool = False) -> ReplayCount:
    """Replay a run into commands.csv and frames.bin of the folder `out`.

    InputError where the recording holds no run, or `out` holds something and `force` is not set; nothing is made then.
    """
    if record.is_dir():
        raise InputError(record, "recording", "a session folder", RUN_REQUIRED)
    run = _read_run(record, "/loop", "/pose")
    if PATH_ATTACHMENT not in run.texts:
        raise InputError(record, "recording", "no path", RUN_REQUIRED)
    prepare_out(out, force)
    same, parted = list[bool](), ""
    with CommandWriter(out) as writer:

        def take(played: PlayedFrame) -> None:
            writer.send(played.frame)
            same.append(played.frame == played.recorded)

        try:
            _play(run, record, take, lambda tick: writer.write(tick.command))
        except PartedError as error:
            parted = str(error)
    return ReplayCount(len(same), same.count(False), run.damage, parted)


BEAD_WIDTH = 1.0  # mm
BLOCK_SECONDS = 10.0  # s of rows compared at once


@dataclass(frozen=True, slots=True, eq=False)
class NozzleErrors:
    """The true error at the nozzle of a run before pre-rendered pictures."""

    distance: Array  # (N,) mm, nozzle to its place, of each extruding millisecond
    duty: float  # share of the time due in which material left; NaN where none was due
    deepest: float  # s of motion that the arm ever had queued
    held_up: float  # s that a busy machine kept the virtual arm from its line at most
    material: MaterialFigures | None = None  # of what a dispenser was told; None of a run without one

    def figure(self, share: float) -> float:
        """Error, mm, that `share` percent do not exceed; NaN of none."""
        return float(np.percentile(self.distance, share)) if len(self.distance) else float("nan")


class _TrueMotion:
    """A motion known at some instants."""

    def __init__(self, rows: Array) -> None:
        self._known = trajectory_from_rows(rows, True)

    def __call__(self, times: Array) -> Array:
        """(N, 4, 4) at times (N,), s."""
        return self._known.at(times)

    def twist(self, times: Array) -> Array:
        """Nobody asks for it here."""
        raise NotImplementedError


def nozzle_errors(
    record: File, path: File, arm: File, dispenser: VirtualDispenserSettings | None = None
) -> NozzleErrors:
    """path: checkpoints in the true surface frame; arm: the arm as it truly stands. InputError without ticks.

    dispenser: what the one that was told truly does; None: it gives each bead what it needs, at once.
    """
    run = _read_run(record, "/tick", "/move", "/truth", "/dispenser")
    if not run.messages["/tick"] or len(run.messages["/truth"]) < 2:
        raise InputError(record, "recording", "no ticks or no truth", "a run before pre-rendered pictures")
    true, profile = read_arm(arm), inputs_from_texts(run.texts, record).profile  # tick and lag as the run took them
    rows = np.unique(np.array([row_from_message(message) for message in run.messages["/truth"]]), axis=0)
    rising = np.concatenate([[True], np.diff(rows[:, 0]) > 0])
    truth = Truth(np.eye(4), _TrueMotion(rows[rising]))
    checkpoints = read_path(path)
    truth_log = TruthLog(checkpoints, true.arm, truth, profile.tick, profile.lag)
    told = sorted((float(m["stamp"]), float(m["flow"][0])) for m in run.messages["/dispenser"] if m["flow"])
    flow, logs = flow_from_told(told, dispenser), list[NozzleLog]()
    commands = _commands(run)
    for command, progress in commands:
        truth_log.write(command, progress)
    with np.load(RunFiles(record).executed) as executed:
        stamps, axes = executed["stamps"], executed["axes"]
        deepest, held_up = float(executed["deepest"]), float(executed["held_up"])
    first, last = commands[0][0].stamp, min(truth_log.known_until, float(stamps[-1]))

    def axes_at(times: Array) -> Array:
        return np.stack([np.interp(times, stamps, axes[:, i]) for i in range(6)], axis=1)

    errors, extruding, due = list[Array](), 0, 0
    printed = PrintPhase.LEAVING, PrintPhase.FINISHED  # nothing is due any more
    finished = min((command.stamp for command, progress in commands if progress.phase in printed), default=np.inf)
    for start in np.arange(first, last, BLOCK_SECONDS):
        log = truth_log.rows(row_instants(start, min(start + BLOCK_SECONDS, last)), axes_at, flow)
        if told:
            logs.append(log)
        known = log.extrude & np.isfinite(log.place)
        off = log.base_from_nozzle[known, :3, 3] - log.base_from_target[known, :3, 3]
        errors.append(np.linalg.norm(off, axis=1))
        extruding += int(log.extrude.sum())
        due += int((np.isfinite(log.place) & (log.place > 0) & (log.stamps < finished)).sum())
    duty = extruding / due if due else float("nan")
    material = _material(join_logs(logs), planned_line(checkpoints)) if logs else None
    return NozzleErrors(np.concatenate(errors), duty, deepest, held_up, material)


def _material(log: NozzleLog, line: PlannedLine) -> MaterialFigures:
    """The width of beads is not recorded: it is taken as that of UNIT_AREA, 1 mm."""
    return material_figures(log, line, row_errors(log, line), BEAD_WIDTH, float("nan"))


def printed_range(record: File) -> tuple[float, float]:
    """First and last place, counted in checkpoints, at which a run extruded; NaN where it did not."""
    run = _read_run(record, "/tick", "/move")
    extruding = {m["stamp"] for m in run.messages["/move"] if m["extrude"]}
    places = [float(m["fraction"]) for m in run.messages["/tick"] if m["stamp"] in extruding]
    return (min(places), max(places)) if places else (float("nan"), float("nan"))


def commands_of(record: File) -> list[tuple[Command, PrintProgress]]:
    """A recorded run's commands in order, with the place on the path."""
    return _commands(_read_run(record, "/tick", "/move"))


def _commands(run: _RecordedRun) -> list[tuple[Command, PrintProgress]]:
    """Commands in order, with the place on the path."""
    ticks = {m["stamp"]: m for m in run.messages["/tick"]}
    moves = {m["stamp"]: move_from_message(m) for m in run.messages["/move"]}
    commands: list[tuple[Command, PrintProgress]] = []
    for stamp, tick in sorted(ticks.items()):
        fraction = float(tick["fraction"])
        progress = PrintProgress(PrintPhase(tick["phase"]), 0, 0, fraction, 0.0, fraction)
        commands.append((moves.get(stamp, Hold(stamp, 0.001, "held")), progress))
    return commands
