"""`stillbed simulate`: a scenario from its file to the report, and whether its own limits were met."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.trajectory import Trajectory
from hardware.files.path_file import read_path
from hardware.files.pose_file import read_poses
from hardware.methods import MAP, step_by
from hardware.offline.track import Step
from hardware.out_folder import prepare_out
from hardware.ply_file import write_ply
from hardware.process.clock import WallClock
from hardware.process.faults import Fault, Kind, Part, Runner, check_faults
from hardware.process.progress import Progress
from hardware.report.evaluation import Evaluation, evaluate
from hardware.report.report import write_report
from hardware.report.summary import write_summary
from hardware.simulator.camera_pipeline import Exposures
from hardware.simulator.cameras import Fate, SimulatedCameras
from hardware.simulator.laying import laid
from hardware.simulator.nozzle_log import joined
from hardware.simulator.nozzle_report import write_nozzle_report
from hardware.simulator.nozzle_run import NozzleRun, judge
from hardware.simulator.nozzle_summary import nozzle_dict, nozzle_text
from hardware.simulator.perfect import PerfectTracker
from hardware.simulator.planned_line import planned_line
from hardware.simulator.pty_link import PtyLink
from hardware.simulator.run_folder import RunFolder, clear
from hardware.simulator.scenario import Scenario
from hardware.simulator.scenario_file import read_scenario
from hardware.simulator.scene.scene import STILL, Scene, rois
from hardware.simulator.scene.shape import Shape
from hardware.simulator.scene_table import scene_from_table
from hardware.simulator.struck_surface import folded, struck_motion
from hardware.simulator.track_tracker import TrackTracker
from hardware.simulator.truth import Truth
from hardware.simulator.world import World
from perception.frames import Roi
from planning.path import Path as Checkpoints

SEEN = (Kind.GARBLE, Kind.SWAP, Kind.BUMP, Kind.BLACK, Kind.FLASH, Kind.COVER)  # faults that pictures show
SCAN_STEP = 1.0  # mm between the vertices of a scan, as handheld scanners give them
FILES = (
    ("nozzle.csv", "where the nozzle was and should have been, every millisecond"),
    ("tracking/report.html", "the tracking alone: estimate against truth, states, latency"),
    ("tracking/poses.csv", "every pose with its covariance"),
    ("commands.csv", "what the motion decided; frames.bin holds the bytes"),
    ("session", "the session as a folder; session.mcap is the same for Foxglove and Rerun"),
    ("scenario.toml", "what was simulated"),
)


@dataclass(frozen=True, slots=True)
class Options:
    """How to run a scenario.

    trace: a recorded motion instead of the scenario's own. faults: besides the scenario's own. threads: that render.
    pty: whether the arm's bytes pass a pseudo-terminal. force: whether to write into a folder that is not empty.
    """

    trace: Path | None = None
    faults: tuple[Fault, ...] = ()
    threads: int = 2
    pty: bool = False
    force: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a run came to. text: for a terminal. met: whether it ran to its end and met its scenario's limits."""

    text: str
    met: bool


def run_simulation(file: Path, out: Path, options: Options | None = None) -> Outcome:
    """Run the scenario in `file` into the folder `out`.

    Whatever ends the run early leaves all files of what was simulated until then, report included. InputError for a
    scenario, path or scan that makes no sense.
    """
    options = options or Options()
    if options.threads < 1:
        raise InputError("command line", "--threads", options.threads, ">= 1")
    scenario = read_scenario(file, options.trace)
    check_faults(options.faults, Runner.SIMULATE, "command line", "--fault", len(scenario.rig))
    scenario = replace(scenario, faults=(*scenario.faults, *options.faults))
    path = read_path(scenario.path)
    scene = scene_from_table(scenario.file, scenario.scene, scenario.file.parent, scenario.seed)
    _check_pairs(scenario, scene)
    if scenario.clearance is not None:
        path = laid(path, scene.shape, scenario.clearance, scenario.path)
    if file.resolve().parent == out.resolve():
        raise InputError(out, "--out", "the folder that holds the scenario", "another one: files there are replaced")
    prepare_out(out, options.force)
    clear(out)
    truth = true_surface(scenario, scene)
    around, scan = regions(scenario, scene, truth), _scan(scenario, scene, out)
    folder = RunFolder(out, scenario, planned_line(path), around, truth.base_from_surface, scan)
    complete, skipped = False, 0
    try:
        with folder, ExitStack() as stack:
            exposures: Exposures = {}
            step = stack.enter_context(_tracking(scenario, truth, scene.shape, around, scan, exposures))
            line = stack.enter_context(PtyLink()).transfer if options.pty else bytes
            progress = stack.enter_context(Progress("simulate", "frame sets", WallClock().now))
            print(f"watch: {folder.watch.page.resolve().as_uri()}", file=sys.stderr)
            world = World(scenario, scene, path, truth, step, exposures, folder, WallClock(), options.threads, line)
            try:
                world.run(progress)
            finally:
                skipped = world.skipped
        complete = True
    finally:
        outcome = _finish(scenario, path, truth, folder, around, complete, skipped)
    return outcome


def true_surface(scenario: Scenario, scene: Scene) -> Truth:
    """The truth of a scenario's surface, its faults included; the scene is told how it folds."""
    strain = scenario.strain
    if (fold := folded(scenario.file, scene.deformation, scenario.faults)) is not None:
        scene.deformation, strain = fold
    motion = struck_motion(scenario.motion, scenario.faults)
    return Truth(scenario.rest, motion, scene.deformation, strain, scene.shape.surface_from_grid)


def _check_pairs(scenario: Scenario, scene: Scene) -> None:
    """InputError for what was read and would have no effect."""
    if (scenario.strain is None) != (scene.deformation == STILL):
        allowed = "both (how much over time, and of what) or neither"
        raise InputError(scenario.file, "strain, scene.deformation", "one of the two", allowed)
    if scenario.tracking.scan and not (scenario.tracking.pictures and scenario.tracking.method == MAP):
        allowed = 'with by = "pictures": nothing else registers to a scan'
        raise InputError(scenario.file, "tracking.register", "scan", allowed)
    if not (scenario.tracking.pictures or scenario.tracking.tracks):
        for fault in scenario.faults:
            if fault.kind in SEEN and fault.part in (Part.CAMERA, Part.SURFACE):
                allowed = 'with tracking.by = "pictures" or "tracks": who knows the truth does not look'
                raise InputError(scenario.file, "faults", str(fault), allowed)


def _finish(
    scenario: Scenario,
    path: Checkpoints,
    truth: Truth,
    folder: RunFolder,
    regions: Sequence[Roi],
    complete: bool,
    skipped: int,
) -> Outcome:
    """Judge what was simulated; writes both reports and summaries. skipped: frame sets that found the tracker busy."""
    out = folder.out
    if not folder.logs:
        return Outcome("nothing was simulated", False)
    tracking = _tracking_report(scenario, truth, out / "tracking", regions, complete)
    run = NozzleRun(
        title=scenario.title,
        log=joined(folder.logs),
        path=path,
        bead=scenario.bead,
        limits=scenario.limits,
        tracking=tracking,
        complete=complete,
        pictures=tuple((scenario.rig.cameras[c].name, data) for c, data in sorted(folder.pictures.items())),
        files=FILES if scenario.tracking.pictures else tuple(f for f in FILES if f[0] != "session"),
    )
    result = judge(run)
    summary = nozzle_dict(result) | {"frame_sets_skipped": skipped, "faults": [str(f) for f in scenario.faults]}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    write_nozzle_report(out / "report.html", result)
    folder.watch.finish(summary["verdict"][0])
    busy = f"{skipped} frame sets found the tracker busy and were left out\n" if skipped else ""
    return Outcome(f"{nozzle_text(summary)}\n{busy}report: {out / 'report.html'}", result.met)


def _tracking_report(
    scenario: Scenario, truth: Truth, folder: Path, regions: Sequence[Roi], complete: bool
) -> Evaluation:
    """Judge the poses against the truth at their very stamps, as `stillbed track` would."""
    table = read_poses(folder / "poses.csv")
    exact = Trajectory(table.stamps, truth.base_from_surface(table.stamps), exact=True) if len(table) else None
    since = min((roi.stamp for roi in regions), default=-np.inf)
    tracking = scenario.tracking
    method = tracking.method if tracking.pictures else "tracks" if tracking.tracks else "truth"
    result = evaluate(table, exact, scenario.title, since, complete, method=method)
    write_summary(folder / "summary.json", result)
    write_report(folder / "report.html", result)
    return result


def regions(scenario: Scenario, scene: Scene, truth: Truth) -> tuple[Roi, ...]:
    """What an operator would draw around the wound in each camera's first picture."""
    start = SimulatedCameras(scenario.cameras, scenario.seed, scenario.faults)
    found: list[Roi] = []
    for camera in range(len(scenario.rig)):
        shot = next((s for s in start.shots(camera, scenario.seconds) if s.fate is not Fate.DROPPED), None)
        if shot is not None:
            pose = truth.base_from_surface(np.array([shot.exposed]))[0]
            found += [r for r in rois(scene, scenario.rig, pose, shot.stamp) if r.camera == camera]
    return tuple(found)


def _scan(scenario: Scenario, scene: Scene, out: Path) -> Path | None:
    """The scan's file where the scenario has the tracker register to one."""
    if not (scenario.tracking.pictures and scenario.tracking.scan):
        return None
    (out / "session").mkdir(exist_ok=True)
    write_ply(out / "session" / "surface.ply", *scene.shape.mesh(SCAN_STEP))
    return out / "session" / "surface.ply"


@contextmanager
def _tracking(
    scenario: Scenario, truth: Truth, shape: Shape, regions: Sequence[Roi], scan: Path | None, exposures: Exposures
) -> Iterator[Step]:
    """The tracking step of the scenario: that of a live run, its estimator alone, or one that knows the truth."""
    if scenario.tracking.pictures:
        method, rig, tool = scenario.tracking.method, scenario.told_rig, scenario.profile.tool
        with step_by(method, rig, regions, scan, WallClock().now, tool) as step:
            yield step
        return
    if scenario.tracking.tracks:
        rigs = scenario.rig, scenario.told_rig
        yield TrackTracker(*rigs, truth, shape, lambda camera, stamp: exposures[camera, stamp], scenario.seed)
        return
    told, true = scenario.told_rig.cameras[0], scenario.rig.cameras[0]
    offset = told.base_from_camera @ se3.inverse(true.base_from_camera)
    yield PerfectTracker(truth, offset, lambda camera, stamp: exposures[camera, stamp].exposed, len(scenario.rig))
