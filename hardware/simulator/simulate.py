"""`stillbed simulate`: a scenario from its file to the report, and whether its own limits were met.

Besides the tracking step of a live run there are two trackers without pictures: one that returns the truth, and one
whose landmarks on the true surface are projected into the cameras. The latter omits rendering and detection, and with
them nearly all of the time of a simulated second; its estimator is that of a live run.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.forecast.predictor import Predictor
from estimation.mapping.triangulation import TriangulatedMap
from estimation.observations import Observations, no_observations
from estimation.pose import SurfacePose, TrackState, Trajectory, identity_pose
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.follow import Follower
from estimation.synthetic.world import project_landmarks, undistorting
from hardware.arm.profile import in_step
from hardware.files.mesh_file import write_ply
from hardware.files.path_file import read_path
from hardware.files.pose_file import read_poses
from hardware.offline.track import FrameSetStep, step_by
from hardware.process.clock import WallClock
from hardware.process.faults import Fault, FaultKind, FaultPart, FaultRunner, check_faults
from hardware.process.progress import Progress, prepare_out
from hardware.report.evaluation import Evaluation, as_dict, evaluate, write_summary
from hardware.report.page import open_in_browser
from hardware.report.report import write_report
from hardware.simulator.camera_pipeline import Exposures, PictureStore
from hardware.simulator.cameras import Fate, Shot, SimulatedCameras, TrueCameras
from hardware.simulator.deposit import join_logs, planned_line
from hardware.simulator.nozzle_report import nozzle_page
from hardware.simulator.nozzle_summary import NozzleRun, evaluate_run, nozzle_dict, nozzle_text
from hardware.simulator.run_folder import RunFolder, clear_run
from hardware.simulator.scenario import Scenario, read_scenario
from hardware.simulator.scenario_tables import scene_from_table
from hardware.simulator.scene.scene import UNDEFORMED, Scene, rois
from hardware.simulator.scene.shape import Shape
from hardware.simulator.truth import Truth, disturbed_motion, drape_path, fold_deformation
from hardware.simulator.world import SimulatedWorld
from perception.frames import FrameSet, Roi
from perception.tracking import MAP_METHOD
from perception.tracking.step import STAGES, TrackingStep, report_without_offsets
from planning.laid_beads import with_looks
from planning.material import is_metered
from planning.path import Path as Checkpoints

LANDMARK_COUNT, LANDMARK_AREA = 90, (56.0, 42.0)  # landmarks, and mm of the surface about the wound for them
DETECTED_SHARE = 0.85  # of landmarks, in a picture
DAMAGED_SHARE = 0.5  # of those, in a damaged picture
TRACK_SIGMA = 0.3  # px, of a track
STRAY_SHARE, STRAY_PX = 0.02, 30.0  # share of tracks with an error of up to so many px
USABLE_GAINS = 0.2, 4.0  # of a picture with visible landmarks
MIN_INITIAL_TRACKS = 30  # of the first pose


class LandmarkTracker(FrameSetStep):
    """A tracking step without pictures, from projected landmarks."""

    def __init__(
        self, true_rig: Rig, known_rig: Rig, truth: Truth, shape: Shape, shot: Callable[[int, float], Shot], seed: int
    ) -> None:
        """shot: of a camera's frame with a stamp, s."""
        rng = np.random.default_rng([seed, 81])
        places = rng.uniform(-0.5, 0.5, (LANDMARK_COUNT, 2)) * np.minimum(LANDMARK_AREA, shape.size)
        self._points, self._normals = shape.points(places), shape.normals(places)
        self._true_cameras, self._cameras = TrueCameras(undistorting(true_rig).cameras), len(true_rig)
        self._known_rig, self._truth, self._shot = known_rig, truth, shot
        self._rng = np.random.default_rng([seed, 82])
        self._follower: Follower | None = None

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp`."""
        views = [self._view(frame.camera, self._shot(frame.camera, frame.stamp)) for frame in frames.frames]
        observations = no_observations(frames.stamp)
        if any(len(track) for _, track, _ in views):
            camera, track, pixels = (np.concatenate(parts) for parts in zip(*views, strict=True))
            observations = Observations(frames.stamp, camera, track, pixels, np.full(len(track), TRACK_SIGMA))
        pose = self._pose(observations)
        used = np.bincount(observations.camera, minlength=self._cameras)
        self.last = report_without_offsets(observations, used, np.zeros(len(STAGES)))
        return pose

    def _pose(self, observations: Observations) -> SurfacePose:
        if self._follower is not None:
            return self._follower(observations)
        if len(observations) < MIN_INITIAL_TRACKS:
            return identity_pose(observations.stamp, f"{len(observations)} tracks found, {MIN_INITIAL_TRACKS} needed")
        exact = SurfaceMap(self._points, self._normals, np.zeros((3 * LANDMARK_COUNT, 3 * LANDMARK_COUNT)))
        base_from_surface = self._truth.base_from_surface(np.array([observations.stamp]))[0]
        start = TriangulatedMap(exact, base_from_surface, np.arange(LANDMARK_COUNT))
        self._follower = Follower(self._known_rig, observations, start, refine=False)
        assert self._follower.estimator.pose is not None
        return self._follower.estimator.pose

    def _view(self, camera: int, shot: Shot) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Camera (N,), track (N,) and pixels (N, 2) of the visible landmarks of one picture."""
        rng, instant = self._rng, np.array([shot.exposed])
        chance = rng.random(LANDMARK_COUNT)
        changed = shot.lens not in (None, camera) or shot.covered is not None  # appearances change
        no_tracks = changed or shot.fate is Fate.DUPLICATED or not USABLE_GAINS[0] <= shot.gain <= USABLE_GAINS[1]
        amount = np.broadcast_to(self._truth.amount(instant), LANDMARK_COUNT)
        points = self._points + self._truth.displacement(self._points, amount) if amount.any() else self._points
        pose = self._truth.base_from_surface(instant)
        pixels, inside = project_landmarks(Rig((self._true_cameras(shot),)), points, pose, self._normals)
        noisy = pixels[0] + TRACK_SIGMA * rng.standard_normal((LANDMARK_COUNT, 2))
        stray = rng.random(LANDMARK_COUNT) < STRAY_SHARE
        noisy[stray] += rng.uniform(-STRAY_PX, STRAY_PX, (int(stray.sum()), 2))
        share = 0.0 if no_tracks else DETECTED_SHARE * (DAMAGED_SHARE if shot.fate is Fate.GARBLED else 1.0)
        track = np.flatnonzero(inside[0] & (chance < share)).astype(np.int64)
        return np.full(len(track), camera), track, noisy[track]


EXACT_COVARIANCE = np.diag([1e-12] * 3 + [1e-8] * 3)  # rad^2, mm^2: exact, but invertible


class OracleTracker(FrameSetStep):
    """A tracking step without pictures, from the truth."""

    def __init__(self, truth: Truth, offset: Array, exposed: Callable[[int, float], float], cameras: int) -> None:
        """offset: (4, 4) known_base_from_base, by the errors of the known rig.

        exposed: the true instant, s, of a camera's frame with a stamp, s: errors of clocks remain.
        """
        self._predictor = Predictor()
        self._truth, self._offset, self._exposed, self._cameras = truth, offset, exposed, cameras

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at the mean of the true exposures, with the cameras' stamp."""
        instant = np.array([np.mean([self._exposed(f.camera, f.stamp) for f in frames.frames])])
        pose, twist = self._truth.base_from_surface(instant)[0], self._truth.twist(instant)[0]
        observations, counts = no_observations(frames.stamp), np.zeros(self._cameras, np.int64)
        self.last = report_without_offsets(observations, counts, np.zeros(len(STAGES)))
        surface_pose = SurfacePose(frames.stamp, self._offset @ pose, EXACT_COVARIANCE, twist, TrackState.TRACKING)
        return replace(surface_pose, forecast=self._predictor.add(surface_pose))


# faults that pictures show
PICTURE_FAULTS = (FaultKind.GARBLE, FaultKind.SWAP, FaultKind.BUMP, FaultKind.BLACK, FaultKind.FLASH, FaultKind.COVER)
SCAN_MESH_STEP = 1.0  # mm between the vertices of a scan, as handheld scanners give them
FILE_NOTES = (
    ("nozzle.csv", "where the nozzle was and should have been, every millisecond"),
    ("tracking/report.html", "the tracking alone: estimate against truth, states, latency"),
    ("tracking/poses.csv", "every pose with its covariance"),
    ("commands.csv", "what the motion decided; frames.bin holds the bytes"),
    ("session", "the session as a folder; session.mcap is the same for Foxglove and Rerun"),
    ("scenario.toml", "what was simulated"),
)


@dataclass(frozen=True, slots=True)
class SimulationOptions:
    """How to run a scenario."""

    trace: Path | None = None  # a recorded motion instead of the scenario's own
    faults: tuple[Fault, ...] = ()  # besides the scenario's own
    threads: int = 2  # that render
    force: bool = False  # write into a folder that is not empty
    open: bool = False  # open the page that shows it in a browser
    cache: Path | None = None  # of pictures of earlier runs and of this one


@dataclass(frozen=True, slots=True)
class SimulationResult:
    """The result of a run."""

    text: str  # for a terminal
    met: bool  # whether it ran to its end and met its scenario's limits


def run_simulation(file: Path, out: Path, options: SimulationOptions | None = None) -> SimulationResult:
    """Run the scenario in `file` into the folder `out`.

    An early end leaves all files of the run until then, report included. InputError for a bad scenario, path or scan.
    """
    options = options or SimulationOptions()
    if options.threads < 1:
        raise InputError("command line", "--threads", options.threads, ">= 1")
    scenario = read_scenario(file, options.trace)
    check_faults(options.faults, FaultRunner.SIMULATE, "command line", "--fault", len(scenario.rig))
    profile = in_step(scenario.profile, scenario.cameras.period)
    scenario = replace(scenario, faults=(*scenario.faults, *options.faults), profile=profile)
    path = read_path(scenario.path)
    scene = scene_from_table(scenario.file, scenario.scene, scenario.file.parent, scenario.seed)
    _check_pairs(scenario, scene)
    if scenario.clearance is not None:
        path = drape_path(path, scene.shape, scenario.clearance, scenario.path)
    if not is_metered(path) and (scenario.gel or scenario.looks is not None):
        allowed = "with [gel] or look, columns width_mm and height_mm, or volume_mm3"
        raise InputError(scenario.path, "columns", "no amounts of material", allowed)
    if scenario.looks is not None:
        path = with_looks(path, scenario.looks)
    if file.resolve().parent == out.resolve():
        raise InputError(out, "--out", "the folder that holds the scenario", "another one: files there are replaced")
    prepare_out(out, options.force)
    clear_run(out)
    truth = true_surface(scenario, scene)
    wound_rois, scan = regions(scenario, scene, truth), None
    if scenario.tracking.pictures and scenario.tracking.scan:
        scan = out / "session" / "surface.ply"
        scan.parent.mkdir(exist_ok=True)
        write_ply(scan, *scene.shape.mesh(SCAN_MESH_STEP))
    folder = RunFolder(out, scenario, planned_line(path), wound_rois, truth.base_from_surface, scan)
    complete, skipped, open_outside = False, 0, float("nan")
    try:
        with folder, ExitStack() as stack:
            exposures: Exposures = {}
            step = stack.enter_context(_tracking(scenario, truth, scene.shape, wound_rois, scan, exposures))
            if isinstance(step, TrackingStep):
                folder.show_tracker(step)
            progress = stack.enter_context(Progress("simulate", "frame sets", WallClock().now))
            folder.watch.begin()
            print(f"watch: {folder.watch.page.resolve().as_uri()}", file=sys.stderr)
            if options.open:
                open_in_browser(folder.watch.page.resolve().as_uri())
            cache = options.cache if scenario.tracking.pictures else None
            store = None if cache is None else stack.enter_context(closing(PictureStore(file, cache)))
            if (keeper := folder.keeper) is not None:
                scenario = replace(scenario, profile=keeper.arm(scenario.profile))
            world = SimulatedWorld(
                scenario, scene, path, truth, step, exposures, folder, WallClock(), options.threads, store, keeper
            )
            try:
                world.run(progress)
                if store is not None:
                    store.finish()
            finally:
                skipped = world.pipeline.skipped
                open_outside = world.open_outside
        complete = True
    finally:
        outcome = _write_results(scenario, path, truth, folder, wound_rois, complete, skipped, open_outside)
    return outcome


def true_surface(scenario: Scenario, scene: Scene) -> Truth:
    """The truth of a scenario's surface, its faults included; sets the scene's folds."""
    strain = scenario.strain
    if (fold := fold_deformation(scenario.file, scene.deformation, scenario.faults)) is not None:
        scene.deformation, strain = fold
    motion = disturbed_motion(scenario.motion, scenario.faults)
    return Truth(scenario.rest, motion, scene.deformation, strain, scene.shape.surface_from_grid)


def _check_pairs(scenario: Scenario, scene: Scene) -> None:
    if (scenario.strain is None) != (scene.deformation == UNDEFORMED):
        allowed = "both (how much over time, and of what) or neither"
        raise InputError(scenario.file, "strain, scene.deformation", "one of the two", allowed)
    by_pictures = scenario.tracking.pictures and scenario.tracking.method == MAP_METHOD
    if scenario.looks is not None and not by_pictures:
        raise InputError(scenario.file, "look", scenario.looks, 'with tracking.by = "pictures": cameras look')
    if scenario.tracking.scan and not by_pictures:
        allowed = 'with by = "pictures": nothing else registers to a scan'
        raise InputError(scenario.file, "tracking.register", "scan", allowed)
    if not (scenario.tracking.pictures or scenario.tracking.tracks):
        for fault in scenario.faults:
            if fault.kind in PICTURE_FAULTS and fault.part in (FaultPart.CAMERA, FaultPart.SURFACE):
                allowed = 'with tracking.by = "pictures" or "tracks": who knows the truth does not look'
                raise InputError(scenario.file, "faults", str(fault), allowed)


def _write_results(
    scenario: Scenario,
    path: Checkpoints,
    truth: Truth,
    folder: RunFolder,
    regions: Sequence[Roi],
    complete: bool,
    skipped: int,
    open_outside: float,
) -> SimulationResult:
    """Evaluate the run; writes both reports and summaries. skipped: frame sets that found the tracker busy.

    open_outside: s in which a dispenser was commanded open while no move printed.
    """
    out = folder.out
    if not folder.logs:
        return SimulationResult("nothing was simulated", False)
    tracking = _tracking_report(scenario, truth, out / "tracking", regions, complete)
    pictures = tuple((scenario.rig.cameras[c].name, data) for c, data in sorted(folder.pictures.items()))
    files = tuple(f for f in FILE_NOTES if scenario.tracking.pictures or f[0] != "session")
    log = join_logs(folder.logs)
    title, bead, limits, looks = scenario.title, scenario.bead, scenario.limits, tuple(folder.looks)
    run = NozzleRun(title, log, path, bead, limits, open_outside, tracking, complete, pictures, files, looks)
    result = evaluate_run(run)
    summary = nozzle_dict(result) | {"frame_sets_skipped": skipped, "faults": [str(f) for f in scenario.faults]}
    write_summary(out / "summary.json", summary)
    (out / "report.html").write_text(nozzle_page(result), encoding="utf-8")
    folder.watch.finish(summary["verdict"][0])
    busy = f"{skipped} frame sets found the tracker busy and were left out\n" if skipped else ""
    return SimulationResult(f"{nozzle_text(summary)}\n{busy}report: {out / 'report.html'}", result.met)


def _tracking_report(
    scenario: Scenario, truth: Truth, folder: Path, regions: Sequence[Roi], complete: bool
) -> Evaluation:
    table = read_poses(folder / "poses.csv")
    trajectory = Trajectory(table.stamps, truth.base_from_surface(table.stamps), exact=True) if len(table) else None
    start = min((roi.stamp for roi in regions), default=-np.inf)
    tracking = scenario.tracking
    method = tracking.method if tracking.pictures else "tracks" if tracking.tracks else "truth"
    result = evaluate(table, trajectory, scenario.title, start, complete, method=method)
    write_summary(folder / "summary.json", as_dict(result))
    write_report(folder / "report.html", result)
    return result


def regions(scenario: Scenario, scene: Scene, truth: Truth) -> tuple[Roi, ...]:
    """An operator's outline of the wound in each camera's first picture."""
    cameras = SimulatedCameras(scenario.cameras, scenario.seed, scenario.faults)
    polygons: list[Roi] = []
    for camera in range(len(scenario.rig)):
        shot = next((s for s in cameras.shots(camera, scenario.seconds) if s.fate is not Fate.DROPPED), None)
        if shot is not None:
            pose = truth.base_from_surface(np.array([shot.exposed]))[0]
            polygons += [r for r in rois(scene, scenario.rig, pose, shot.stamp) if r.camera == camera]
    return tuple(polygons)


@contextmanager
def _tracking(
    scenario: Scenario, truth: Truth, shape: Shape, regions: Sequence[Roi], scan: Path | None, exposures: Exposures
) -> Iterator[FrameSetStep]:
    if scenario.tracking.pictures:
        method, rig, tool = scenario.tracking.method, scenario.known_rig, scenario.profile.tool
        with step_by(method, rig, regions, scan, WallClock().now, tool) as step:
            yield step
        return
    if scenario.tracking.tracks:
        true_rig, known_rig, seed = scenario.rig, scenario.known_rig, scenario.seed
        yield LandmarkTracker(true_rig, known_rig, truth, shape, lambda camera, stamp: exposures[camera, stamp], seed)
        return
    known, true = scenario.known_rig.cameras[0], scenario.rig.cameras[0]
    offset = known.base_from_camera @ se3.inverse(true.base_from_camera)
    yield OracleTracker(truth, offset, lambda camera, stamp: exposures[camera, stamp].exposed, len(scenario.rig))
