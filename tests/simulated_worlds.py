"""Small simulated worlds: scenario files with one thing changed, runs of them, and a sink that remembers all of it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from logging import WARNING
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.files.path_file import read_path
from hardware.motion.loop import Tick
from hardware.offline.track import FrameSetStep
from hardware.process.clock import SimClock
from hardware.recording.loop_record import LoopKeeper
from hardware.simulator.camera_pipeline import Exposures
from hardware.simulator.cameras import Shot
from hardware.simulator.deposit import NozzleLog, join_logs, planned_line
from hardware.simulator.nozzle_error import RowErrors, nozzle_errors
from hardware.simulator.scenario import Scenario, read_scenario
from hardware.simulator.scene.appearance import Appearance
from hardware.simulator.scene.scene import UNDEFORMED, Scene
from hardware.simulator.scene.shape import Deformation, flat
from hardware.simulator.simulate import LandmarkTracker, OracleTracker
from hardware.simulator.truth import Truth
from hardware.simulator.world import SimulatedWorld, WorldSink
from perception.frames import FrameSet, PrintHead
from perception.tracking.step import StepReport
from planning.command import Command, Hold
from planning.laid_beads import Look
from planning.path import PrintProgress

HEADER = "x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg,speed_mm_s,material,temperature_c,layer,extrude"
IDEAL = {  # nothing takes time
    "scene": {"wound": False, "texel_mm": 1.0},
    "cameras": {"fps": 50.0, "exposure_s": 0.0, "transport_s": 0.0},
    "tracking": {"by": "truth", "processing_s": 0},
    "arm": {"file": "arm.toml", "servo_lag_s": 0, "wire_baud": float("inf"), "assumed_lag_s": 0},
}
SMALL = {  # pictures of a ninth of the usual size, half as often
    "scene": {"wound": False, "texel_mm": 0.3},
    "rig": {"size": [480, 270], "focal_px": 420},
    "cameras": {"fps": 15.0},
    "arm": {"file": "arm.toml"},
}


class Heard(WorldSink):
    """A sink that remembers everything it is told."""

    def __init__(self) -> None:
        self.pictures: list[tuple[Shot, str, bytes]] = []
        self.frames: list[FrameSet] = []
        self.poses: list[SurfacePose] = []
        self.ticks: list[Tick] = []
        self.commands: list[Command] = []
        self.progress: list[PrintProgress] = []
        self.heads: list[tuple[float, PrintHead]] = []
        self.sent, self.received = b"", b""
        self.logs: list[NozzleLog] = []
        self.looks: list[Look] = []
        self.changes: list[Array] = []
        self.events: list[tuple[float, str]] = []

    def picture(self, shot: Shot, kind: str, data: bytes) -> None:
        self.pictures.append((shot, kind, data))

    def head(self, stamp: float, head: PrintHead) -> None:
        self.heads.append((stamp, head))

    def pose(self, frames: FrameSet, pose: SurfacePose, report: StepReport, spent: float) -> None:
        self.frames.append(frames)
        self.poses.append(pose)

    def tick(self, tick: Tick, progress: PrintProgress | None) -> None:
        if progress is not None:
            self.ticks.append(tick)
            self.commands.append(tick.command)
            self.progress.append(progress)

    def wire(self, stamp: float, data: bytes, sent: bool) -> None:
        if sent:
            self.sent += data
        else:
            self.received += data

    def rows(self, log: NozzleLog) -> None:
        self.logs.append(log)

    def registration(self, truth_from_estimate: Array) -> None:
        self.changes.append(truth_from_estimate)

    def look(self, look: Look) -> None:
        self.looks.append(look)

    def event(self, stamp: float, text: str, level: int = WARNING) -> None:
        self.events.append((stamp, text))

    @property
    def log(self) -> NozzleLog:
        """All rows so far."""
        return join_logs(self.logs)

    @property
    def reasons(self) -> set[str]:
        """Why the motion held."""
        return {command.reason for command in self.commands if isinstance(command, Hold)}


def write_path(file: Path, points: Sequence[Sequence[float]], speed: float = 5.0) -> Path:
    """An upright path through points (N, 3), mm, as a file; all but the way to the first is printed."""
    rows = [f"{x},{y},{z},0,0,0,{speed},1,20,0,{int(i > 0)}" for i, (x, y, z) in enumerate(points)]
    file.write_text("\n".join([HEADER, *rows]) + "\n")
    return file


def write_scenario(folder: Path, *tables: Mapping[str, object], name: str = "scenario.toml", **top: object) -> Path:
    """A scenario of an 8 mm line in `folder`, tables put over each other in order, keys of the top level over those.

    The arm's home is just above the start of the line, so that printing begins at once.
    """
    if not (folder / "path.csv").exists():
        write_path(folder / "path.csv", [[-4, 0, 0], [4, 0, 0]])
    x, y, z = read_path(folder / "path.csv").surface_from_nozzle[0, :3, 3]
    (folder / "arm.toml").write_text(f"home_mm_deg = [{202.5 + x}, {225.0 + y}, {50.3 + z}, 0, 0, 0]\n")
    whole: dict[str, object] = {"title": "A test", "seconds": 2.0, "path": "path.csv"}
    for table in [*tables, top]:
        for key, value in table.items():
            old = whole.get(key)
            whole[key] = {**old, **value} if isinstance(old, dict) and isinstance(value, dict) else value
    (folder / name).write_text("\n".join(f"{key} = {_toml(value)}" for key, value in whole.items()) + "\n")
    return folder / name


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value) if isinstance(value, float) else json.dumps(value)


@cache
def patch(deformation: Deformation = UNDEFORMED) -> Scene:
    """A flat scene that costs next to nothing, for runs that take no pictures."""
    return Scene(flat((40.0, 30.0)), Appearance(texel=1.0, drape=False), deformation)


def world_of(
    scenario: Scenario,
    sink: Heard,
    deformation: Deformation = UNDEFORMED,
    keeper: LoopKeeper | None = None,
) -> SimulatedWorld:
    """A world without pictures, as `stillbed simulate` builds it, on a flat surface; its tracker knows the truth or is
    given tracks, as the scenario has it."""
    assert not scenario.tracking.pictures
    exposures: Exposures = {}
    scene = patch(deformation)
    truth = Truth(scenario.rest, scenario.motion, deformation, scenario.strain, scene.shape.surface_from_grid)
    offset = scenario.known_rig.cameras[0].base_from_camera @ se3.inverse(scenario.rig.cameras[0].base_from_camera)
    step: FrameSetStep = OracleTracker(
        truth, offset, lambda camera, stamp: exposures[camera, stamp].exposed, len(scenario.rig)
    )
    if scenario.tracking.tracks:
        rigs = scenario.rig, scenario.known_rig
        step = LandmarkTracker(*rigs, truth, scene.shape, lambda camera, stamp: exposures[camera, stamp], scenario.seed)
    path = read_path(scenario.path)
    return SimulatedWorld(scenario, scene, path, truth, step, exposures, sink, SimClock(), keeper=keeper)


def heard(file: Path) -> Heard:
    """All that passes in the scenario in `file`, poses being true."""
    sink = Heard()
    world_of(read_scenario(file), sink).run()
    return sink


def errors(file: Path, log: NozzleLog) -> RowErrors:
    """The errors of a run of the scenario in `file`."""
    return nozzle_errors(log, planned_line(read_path(read_scenario(file).path)))


def inner(log: NozzleLog, before: float = 0.3, after: float = 0.2) -> NDArray[np.bool_]:
    """(N,) rows that extrude, the first `before` and the last `after` s of that left out: there the path speeds up."""
    rows = np.flatnonzero(log.extrude)
    start, end = log.stamps[rows[0]] + before, log.stamps[rows[-1]] - after
    return np.asarray(log.extrude & (log.stamps > start) & (log.stamps < end))
