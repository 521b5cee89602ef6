"""A print in virtual time: the live run's motion loop and link, its estimator on tracks, a virtual arm.

Before the arm is all that a live run has there but for the processes and the pictures: the pairing of frames, the
estimator, planner, guard, the arm's link with its model of the queue. An operator arms the arm again after a stop.

For the subject `loop`, the gain by the planner's compensation of a late dispenser: a print in which the dispenser is
commanded over a line in virtual time, and material lies where its true flow left the true nozzle. Once the motion knows
the dispenser's delays, and once it assumes none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path as File

import numpy as np

from estimation.pose import SurfacePose
from hardware.arm.profile import in_step
from hardware.bench.figures import Figure, at_most
from hardware.files.path_file import read_path
from hardware.offline.track import FrameSetStep
from hardware.process.clock import SimClock
from hardware.simulator.arm.settings import ReplyMode
from hardware.simulator.camera_pipeline import Exposures
from hardware.simulator.cameras import Shot
from hardware.simulator.deposit import NozzleLog, join_logs, planned_line
from hardware.simulator.material import SimulatedDispenser
from hardware.simulator.nozzle_error import BeadEnds, MaterialFigures, material_figures, nozzle_errors
from hardware.simulator.scenario import Scenario, TrackingSettings, read_scenario
from hardware.simulator.scenario_tables import bare_scene
from hardware.simulator.scene.shape import Shape
from hardware.simulator.simulate import LandmarkTracker
from hardware.simulator.truth import Truth, drape_path
from hardware.simulator.world import SimulatedWorld, WorldSink
from perception import shipped_file
from perception.frames import FrameSet
from perception.tracking.step import StepReport
from planning.kinematics import axes_from_nozzle
from planning.path import Path

START_HEIGHT = 3.0  # mm of the nozzle's start over the first checkpoint
MAX_RUN_S = 30.0  # of a run at most


@dataclass(frozen=True, slots=True, eq=False)
class PreparedScenario:
    """What all runs of one scenario share."""

    scenario: Scenario
    shape: Shape
    truth: Truth
    path: Path  # surface frame, draped on the shape


def prepare_scenario(file: File) -> PreparedScenario:
    """A scenario made ready for runs without pictures; its own arm answers."""
    scenario = read_scenario(file)
    shape, _, deformation = bare_scene(file, scenario.scene, file.parent, scenario.seed)
    path = read_path(scenario.path)
    if scenario.clearance is not None:
        path = drape_path(path, shape, scenario.clearance, scenario.path)
    truth = Truth(scenario.rest, scenario.motion, deformation, scenario.strain, shape.surface_from_grid)
    tracking = TrackingSettings(pictures=False, tracks=True)
    arm = replace(scenario.arm, replies=ReplyMode.STREAM)
    profile = in_step(scenario.profile, scenario.cameras.period)
    plain = replace(scenario, tracking=tracking, arm=arm, known_rig=scenario.rig, profile=profile)
    return PreparedScenario(replace(plain, seconds=MAX_RUN_S, nozzle=False, beads=False, faults=()), shape, truth, path)


class LoopRun(WorldSink):
    """One print, from the first frame until the path is printed, the motion is killed, or `MAX_RUN_S`."""

    def __init__(
        self,
        prepared: PreparedScenario,
        seed: int,
        dispenser: SimulatedDispenser | None = None,
        change: Callable[[SurfacePose], SurfacePose] | None = None,
    ) -> None:
        """dispenser: instead of the scenario's own. change: applied to each pose before the motion gets it."""
        truth, scenario = prepared.truth, replace(prepared.scenario, seed=seed)
        # home is over the first checkpoint: the approach is not judged
        start = prepared.path.surface_from_nozzle[:1].copy()
        start[:, :3, 3] += START_HEIGHT * start[:, :3, 2]
        arm = scenario.profile.arm
        home = axes_from_nozzle(arm, truth.base_from_surface(np.zeros(1)) @ start)[0]
        profile = replace(scenario.profile, arm=replace(arm, home=home))
        scenario = replace(scenario, profile=profile, dispenser=dispenser or scenario.dispenser)
        shots: Exposures = {}

        def shot(camera: int, stamp: float) -> Shot:
            return shots[camera, stamp]

        step: FrameSetStep = LandmarkTracker(scenario.rig, scenario.known_rig, truth, prepared.shape, shot, seed)
        if change is not None:
            step = _ChangedStep(step, change)
        self.world = SimulatedWorld(scenario, None, prepared.path, truth, step, shots, self, SimClock())
        self._logs: list[NozzleLog] = []

    def __call__(self) -> NozzleLog:
        """Run it; the log of nozzle and target."""
        self.world.run()
        return join_logs(self._logs)

    def rows(self, log: NozzleLog) -> None:
        """The next rows of the truth at the nozzle."""
        self._logs.append(log)


class _ChangedStep:
    """A tracking step whose poses are changed."""

    def __init__(self, step: FrameSetStep, change: Callable[[SurfacePose], SurfacePose]) -> None:
        self._step, self._change = step, change
        self.last: StepReport

    def __call__(self, frames: FrameSet) -> SurfacePose:
        pose = self._change(self._step(frames))
        self.last = self._step.last
        return pose

    def idle(self) -> None:
        self._step.idle()


LATE_DISPENSER = "dispenser_late"  # a scenario
DELAYS_KNOWN, DELAYS_ZERO = "delays known", "delays taken for 0"
MAX_END_ERROR = 0.5  # mm along the path, 95 %


@dataclass(frozen=True, slots=True, eq=False)
class BeadsPrint:
    """The result of a print."""

    material: MaterialFigures
    delay: float  # s, from a switch to half the flow


def print_beads(seed: int, delays: str) -> BeadsPrint:
    """Print the scenario once; delays: DELAYS_KNOWN or DELAYS_ZERO."""
    prepared = prepare_scenario(shipped_file("scenarios", f"{LATE_DISPENSER}.toml"))
    dispenser = prepared.scenario.dispenser
    assert dispenser is not None
    run = LoopRun(prepared, seed, replace(dispenser, delays_known=delays == DELAYS_KNOWN))
    log, line, truth = run(), planned_line(prepared.path), dispenser.truth
    errors = nozzle_errors(log, line)
    material = material_figures(log, line, errors, prepared.scenario.bead, run.world.open_outside)
    return BeadsPrint(material, truth.on_dead_time + float(np.log(2)) * truth.on_lag)


def bead_figures(prints: Mapping[str, BeadsPrint]) -> list[Figure]:
    """The figures of both prints, by DELAYS_KNOWN and DELAYS_ZERO."""
    known, zero, figures = prints[DELAYS_KNOWN].material, prints[DELAYS_ZERO].material, list[Figure]()
    for end, ours, other in (("begin", known.beginnings, zero.beginnings), ("end", known.ends, zero.ends)):
        reference, note = f"{DELAYS_ZERO}: {other.size.p95:.2f}", f"of {len(ours.error)}, by speed {_by_speed(ours)}"
        name = f"{LATE_DISPENSER}: beads {end} off the plan, 95 %"
        figures.append(Figure(name, ours.size.p95, "mm", at_most(MAX_END_ERROR), reference, note))
        other_note = f"{other.median:.2f} mm at the median; by speed {_by_speed(other)}"
        figures.append(Figure(f"{name}, {DELAYS_ZERO}", other.size.p95, "mm", None, "", other_note))
    open_ms = 1000 * max(known.open_outside, zero.open_outside)
    figures.append(Figure(f"{LATE_DISPENSER}: told to flow while not printing", open_ms, "ms", at_most(0)))
    return figures


def _by_speed(ends: BeadEnds) -> str:
    """The mean error at each speed, in whole mm/s."""
    laid = np.isfinite(ends.error)
    speeds, error = np.round(ends.speed[laid]), ends.error[laid]
    texts = (f"{speed:g} mm/s {error[speeds == speed].mean():+.2f}" for speed in np.unique(speeds))
    return ", ".join(texts)
