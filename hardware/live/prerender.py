"""Pictures of a scenario, rendered before a live run shows them in real time: small machines cannot do both at once.

A cache folder holds one session for each scenario: session.mcap with exact truth, path.csv as laid onto the true
surface, arm.toml as the motion knows the arm, virtual_arm.toml as it is, and scenario.toml. The nozzle and what it
prints are not in the pictures, as nobody knows beforehand where they will be.

A run before them has a true error at the nozzle, which nobody in the loop knows (`nozzle_errors`): the simulator's
truth log compares what was commanded with what the arm did, millisecond by millisecond. The truth is that of the
pictures, which is part of the recording, interpolated between their instants.
"""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.observations import no_observations
from estimation.pose import SurfacePose, Trajectory, identity_pose
from estimation.se3 import Array
from hardware.files.arm_file import read_arm, write_arm
from hardware.files.folder_tables import rows_from_trajectory, trajectory_from_rows
from hardware.files.path_file import read_path, write_path
from hardware.live.recorded_run import asked_flows, commands_in, read_run
from hardware.process.clock import WallClock
from hardware.process.faults import FaultPart
from hardware.process.progress import (
    UNFINISHED,
    PrerenderedSession,
    Progress,
    cache_error,
    cached,
    clear_unfinished,
    folder_size,
    size_text,
)
from hardware.recording.messages import row_from_message
from hardware.recording.recorder import Recorder
from hardware.recording.session_reader import inputs_from_texts
from hardware.simulator.arm.settings import write_virtual_arm
from hardware.simulator.cameras import Shot
from hardware.simulator.scenario import Scenario, read_scenario
from hardware.simulator.scenario_tables import scene_from_table
from hardware.simulator.simulate import regions
from hardware.simulator.truth import Truth, TruthLog, drape_path, row_instants
from hardware.simulator.world import SimulatedWorld, WorldSink
from perception.frames import FrameSet
from perception.tracking.step import StepReport, report_without_offsets
from planning.path import PrintPhase

STAMP_DIGITS = 9  # of a truth's stamp: exposures of one instant are one


def prerender(file: Path, cache: Path, threads: int = 2, seconds: float | None = None) -> PrerenderedSession:
    """The session of the scenario in `file`, rendered unless it is there; a run cut short leaves nothing in its place.

    seconds: only so much of its beginning. InputError for a scenario that makes no sense, or a cache that cannot be
    written.
    """
    scenario = read_scenario(file)
    if seconds is not None:
        scenario = replace(scenario, seconds=min(seconds, scenario.seconds))
    if others := [fault for fault in scenario.faults if fault.part is not FaultPart.ARM]:
        raise InputError(file, "faults", str(others[0]), "faults of the arm; a live run takes others as --fault")
    rendered = cached(file, cache, seconds)
    beside = rendered.folder.with_name(f"{rendered.folder.name}{UNFINISHED}{os.getpid()}")
    try:
        if rendered.ready:
            return rendered
        clear_unfinished(cache)
        beside.mkdir(parents=True)
    except OSError as error:
        raise cache_error(cache, error) from None
    try:
        _render(replace(scenario, nozzle=False, beads=False), beside, threads)
        (beside / "scenario").write_text(str(file.resolve()), encoding="utf-8")
        shutil.rmtree(rendered.folder, ignore_errors=True)
        beside.rename(rendered.folder)
        print(f"kept in {rendered.folder}: {size_text(folder_size(rendered.folder))}", file=sys.stderr)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return rendered


def _render(scenario: Scenario, out: Path, threads: int) -> None:
    scene = scene_from_table(scenario.file, scenario.scene, scenario.file.parent, scenario.seed)
    path = read_path(scenario.path)
    if scenario.clearance is not None:
        path = drape_path(path, scene.shape, scenario.clearance, scenario.path)
    truth = Truth(scenario.rest, scenario.motion, scene.deformation, scenario.strain, scene.shape.surface_from_grid)
    write_path(out / "path.csv", path)
    write_virtual_arm(out / "virtual_arm.toml", scenario.arm, scenario.faults)
    write_arm(out / "arm.toml", scenario.profile, "what the motion knew of the arm")
    shutil.copyfile(scenario.file, out / "scenario.toml")
    with (
        Recorder(out / "session.mcap", scenario.known_rig) as recorder,
        Progress("pre-render", "frame sets", WallClock().now) as progress,
    ):
        for roi in regions(scenario, scene, truth):
            recorder.write(roi)
        sink = _PictureSink(recorder, truth)
        SimulatedWorld(
            scenario, scene, path, truth, _NullTracker(len(scenario.rig)), {}, sink, WallClock(), threads
        ).run(progress)
        sink.finish()


class _NullTracker:
    """Sees no surface: nothing is tracked, so nothing is printed."""

    def __init__(self, cameras: int) -> None:
        self._cameras = cameras
        self.last: StepReport

    def __call__(self, frames: FrameSet) -> SurfacePose:
        none = np.zeros(self._cameras, np.int64)
        self.last = report_without_offsets(no_observations(frames.stamp), none, np.zeros(0))
        return identity_pose(frames.stamp, "nobody looks")

    def idle(self) -> None:
        """Nothing to do."""


class _PictureSink(WorldSink):
    """Records pictures and the truth at their exposures; of all else that happens, nothing."""

    def __init__(self, recorder: Recorder, truth: Truth) -> None:
        self._recorder, self._truth = recorder, truth
        self._exposed: list[float] = []

    def picture(self, shot: Shot, kind: str, data: bytes) -> None:
        """A picture has arrived."""
        self._recorder.encoded_frame(shot.camera, shot.stamp, kind, data)
        self._exposed.append(shot.exposed)

    def finish(self) -> None:
        """Write the truth, now that its instants can be put in order."""
        stamps = np.unique(np.round(self._exposed, STAMP_DIGITS))
        trajectory = Trajectory(stamps, self._truth.base_from_surface(stamps), exact=True)
        for row in rows_from_trajectory(trajectory):
            self._recorder.truth_row(row, exact=True)


BLOCK_SECONDS = 10.0  # s of rows compared at once


@dataclass(frozen=True, slots=True, eq=False)
class NozzleErrors:
    """The true error at the nozzle of a run before pre-rendered pictures."""

    distance: Array  # (N,) mm, nozzle to its place, of each extruding millisecond
    duty: float  # share of the time due in which material left; NaN where none was due
    deepest: float  # s of motion that the arm ever had queued
    held_up: float  # s that a busy machine kept the virtual arm from its line at most

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


def nozzle_errors(record: Path, executed: Path, path: Path, arm: Path) -> NozzleErrors:
    """executed: what the arm did, as a live run leaves it. path: checkpoints in the true surface frame.

    arm: as it truly stands. InputError without ticks.
    """
    run = read_run(record, "/tick", "/move", "/truth", "/loop")
    if not run.messages["/tick"] or len(run.messages["/truth"]) < 2:
        raise InputError(record, "recording", "no ticks or no truth", "a run before pre-rendered pictures")
    true, profile = read_arm(arm), inputs_from_texts(run.texts, record).profile  # tick and lag as the run took them
    rows = np.unique(np.array([row_from_message(message) for message in run.messages["/truth"]]), axis=0)
    rising = np.concatenate([[True], np.diff(rows[:, 0]) > 0])
    truth = Truth(np.eye(4), _TrueMotion(rows[rising]))
    checkpoints = read_path(path)
    truth_log = TruthLog(checkpoints, true.arm, truth, profile.tick, profile.lag)
    commands = commands_in(run)
    for command, progress in commands:
        truth_log.write(command, progress)
    for shares in asked_flows(run):
        truth_log.adapt(shares)
    with np.load(executed) as done:
        stamps, axes = done["stamps"], done["axes"]
        deepest, held_up = float(done["deepest"]), float(done["held_up"])
    first, last = commands[0][0].stamp, min(truth_log.last_due, float(stamps[-1]))

    def axes_at(times: Array) -> Array:
        return np.stack([np.interp(times, stamps, axes[:, i]) for i in range(6)], axis=1)

    errors, extruding, due = list[Array](), 0, 0
    printed = PrintPhase.LEAVING, PrintPhase.FINISHED  # nothing is due any more
    finished = min((command.stamp for command, progress in commands if progress.phase in printed), default=np.inf)
    for start in np.arange(first, last, BLOCK_SECONDS):
        log = truth_log.rows(row_instants(start, min(start + BLOCK_SECONDS, last)), axes_at)
        known = log.extrude & np.isfinite(log.place)
        off = log.base_from_nozzle[known, :3, 3] - log.base_from_target[known, :3, 3]
        errors.append(np.linalg.norm(off, axis=1))
        extruding += int(log.extrude.sum())
        due += int((np.isfinite(log.place) & (log.place > 0) & (log.stamps < finished)).sum())
    duty = extruding / due if due else float("nan")
    return NozzleErrors(np.concatenate(errors), duty, deepest, held_up)
