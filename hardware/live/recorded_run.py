"""A recorded run, examined afterwards: its motion replayed byte by byte, and its true error at the nozzle.

The true error is known where a scenario's pictures were shown to a virtual arm; nobody in the loop knows it. The
simulator's truth log compares what was commanded with what the arm did, millisecond by millisecond. The truth is that
of the pictures, which is part of the recording, interpolated between their instants.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path as File

import numpy as np

from estimation.errors import InputError
from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.protocol import frame_from_command
from hardware.files.arm_file import read_arm
from hardware.files.folder_tables import trajectory_from_rows
from hardware.files.path_file import read_path
from hardware.live.prepared import RunFiles
from hardware.motion.step import MotionStep
from hardware.offline.replay import CommandWriter
from hardware.process.progress import prepare_out
from hardware.recording.mcap_file import AttachedFile, ChunkMessages, Damage, damage_words, parse, walk
from hardware.recording.messages import (
    Message,
    bytes_from_message,
    flow_from_message,
    move_from_message,
    pose_from_message,
    row_from_message,
)
from hardware.recording.session_reader import PATH_ATTACHMENT, PrintInputs, inputs_from_texts
from hardware.simulator.deposit import NozzleLog, PlannedLine, join_logs, planned_line
from hardware.simulator.dispenser import VirtualDispenserSettings
from hardware.simulator.material import flow_from_told
from hardware.simulator.nozzle_error import MaterialFigures, material_figures
from hardware.simulator.nozzle_error import nozzle_errors as row_errors
from hardware.simulator.truth import Truth, TruthLog, row_instants
from planning.command import Command, Hold
from planning.material import FlowShares
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


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedTick:
    """One tick: s, what was decided anew, the frame of that, and the frame that the run gave."""

    stamp: float
    command: Command
    frame: bytes
    recorded: bytes


def replay_run(record: File) -> Iterator[ReplayedTick]:
    """Every tick of a recorded run in which planner and guard were asked, decided anew from the recorded poses."""
    run = _read_run(record, "/tick", "/pose")
    return _replay_ticks(run, inputs_from_texts(run.texts, record), record)


def _replay_ticks(run: _RecordedRun, inputs: PrintInputs, record: File) -> Iterator[ReplayedTick]:
    """Where the file is damaged, ticks are left out whose pose is lost; those behind it may come out another way."""
    ticks, poses = run.messages["/tick"], run.poses
    step, profile, shares = None, inputs.profile, list[FlowShares]()
    for tick in sorted(ticks, key=lambda tick: float(tick["stamp"])):
        if tick["begun"]:
            step = MotionStep(inputs.path, profile, float(tick["begun"][0]), inputs.outlets, inputs.tissue)
            for each in shares:
                step.adapt(each)
        if step is not None and (adapted := tick.get("adapted")):
            shares.append(flow_from_message(adapted))
            step.adapt(shares[-1])
        if step is not None and tick.get("lag"):
            step.lag = float(tick["lag"][0])
        if step is not None and tick.get("recalled"):
            step.recalled(*np.array(tick["recalled"], float).reshape(2, 6))
        if step is None or not tick["asked"]:
            continue
        stamp = tick["pose_stamp"]
        if stamp and stamp[0] not in poses:
            if run.damage:
                continue
            raise InputError(record, "/tick: pose_stamp", stamp[0], "a pose that is recorded")
        now = float(tick["stamp"])
        if tick.get("material_in"):
            step.material_in()
        step.paused, step.aside = bool(tick.get("paused")), bool(tick.get("aside"))
        command = step(poses[stamp[0]] if stamp else None, now)
        frame = frame_from_command(command, profile.dialect)
        yield ReplayedTick(now, command, frame, bytes_from_message({"data": tick["frame"]}))


def write_replay(record: File, out: File, force: bool = False) -> ReplayCount:
    """Replay a run into commands.csv and frames.bin of the folder `out`.

    InputError where the recording holds no run, or `out` holds something and `force` is not set; nothing is made then.
    """
    if record.is_dir():
        raise InputError(record, "recording", "a session folder", RUN_REQUIRED)
    run = _read_run(record, "/tick", "/pose")
    if PATH_ATTACHMENT not in run.texts:
        raise InputError(record, "recording", "no path", RUN_REQUIRED)
    inputs = inputs_from_texts(run.texts, record)
    prepare_out(out, force)
    frames = other = 0
    with CommandWriter(out) as writer:
        for tick in _replay_ticks(run, inputs, record):
            writer.write(tick.command)
            writer.send(tick.frame)
            frames += 1
            other += tick.frame != tick.recorded
    return ReplayCount(frames, other, run.damage)


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
    for tick in run.messages["/tick"]:
        truth_log.adapt(flow_from_message(tick["adapted"]) if tick.get("adapted") else None)
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
