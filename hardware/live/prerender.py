"""Pictures of a scenario, rendered before a live run shows them in real time: small machines cannot do both at once.

A cache folder holds one session for each scenario: session.mcap with exact truth, path.csv as laid onto the true
surface, arm.toml as the motion knows the arm, virtual_arm.toml as it is, and scenario.toml. The nozzle and what it
prints are not in the pictures, as nobody knows beforehand where they will be.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.observations import no_observations
from estimation.pose import SurfacePose, Trajectory, identity_pose
from hardware.files.arm_file import write_arm
from hardware.files.folder_tables import rows_from_trajectory
from hardware.files.path_file import read_path, write_path
from hardware.process.clock import WallClock
from hardware.process.faults import FaultPart
from hardware.process.progress import UNFINISHED, Progress, cache_error, clear_unfinished, folder_size, size_text
from hardware.recording.recorder import Recorder
from hardware.simulator.arm.settings import write_virtual_arm
from hardware.simulator.cameras import Shot
from hardware.simulator.scenario import Scenario, read_scenario
from hardware.simulator.scenario_tables import scene_from_table
from hardware.simulator.simulate import regions
from hardware.simulator.truth import Truth, drape_path
from hardware.simulator.world import SimulatedWorld
from perception.frames import FrameSet
from perception.tracking.step import StepReport, report_without_offsets

CACHE_VERSION = "4"  # of what the cache holds: another one is rendered anew
STAMP_DIGITS = 9  # of a truth's stamp: exposures of one instant are one


class PrerenderedSession:
    """A pre-rendered session in its cache folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.session = folder / "session.mcap"  # pictures, with exact truth
        self.path = folder / "path.csv"  # checkpoints in the true surface frame
        self.arm = folder / "arm.toml"  # what the motion knows of the arm


def cached(file: Path, cache: Path, seconds: float | None = None) -> PrerenderedSession:
    """Where the session of a scenario lies or will lie; another text of it, or of what it names, is another folder.

    seconds: of its beginning, None for all of it.
    """
    text = file.read_bytes() + _named_bytes(file) + CACHE_VERSION.encode()
    text += b"" if seconds is None else f"{seconds:g} s".encode()
    return PrerenderedSession(cache / f"{file.stem}-{hashlib.sha256(text).hexdigest()[:12]}")


def _named_bytes(file: Path) -> bytes:
    """The bytes of the files that a scenario names: path, rig, arm, each after its length; none of a missing one."""
    import tomllib

    try:
        table = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return b""
    parts = [table.get(name) for name in ("rig", "arm")]
    named = [table.get("path"), *(part.get("file") for part in parts if isinstance(part, dict))]
    text = b""
    for name in named:
        with suppress(OSError):
            data = b"" if not isinstance(name, str) else (file.parent / name).read_bytes()
            text += f"{len(data)} ".encode() + data
    return text


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
        if (rendered.folder / "scenario").exists():
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


class _PictureSink:
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

    def _ignore(self, *arguments: object, **named: object) -> None:
        pass

    pose = given = tick = wire = head = rows = registered = look = event = _ignore
