"""Subject `smoothing`: smoothed poses beside causal ones, from tracks and from pictures; clocks, Ceres, time.

Pictures: the simulator's scenarios, rendered and tracked as a live run would, and smoothed.
Many small sessions: smoothed by one worker and by two, and by two of which one is killed.
Ceres, by pycolmap, and the smoother's elimination solve the same bundle adjustment of a rig. pycolmap has no motion
prior and no clocks, so ours are switched off: squared reprojection errors of all landmarks in all frame sets, cameras
known, the first pose fixed (pycolmap's RigReprojErrorCost). Both begin at the same poses and landmarks, on one core,
and stop where a step lowers the cost by less than a millionth of a per cent.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import shutil
import signal
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimation import se3, smooth
from estimation.batch import smoothed
from estimation.batch.initialisation import TrackArrays, initial_estimate, pack_tracks
from estimation.batch.normal_equations import BatchProblem, Estimate, NoiseModel
from estimation.batch.smooth import FREE_LANDMARK_MM
from estimation.batch.smoothed import Smoothed
from estimation.batch.solve import HELD_POSE_SIGMA, NormalEquations, Priors
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.follow import follow
from estimation.synthetic.world import synthetic_world
from hardware.bench.figures import CONSISTENT_NEES, Figure, at_least, at_most, columns, rms
from hardware.files.session import Session
from hardware.live.prerender import prerender
from hardware.offline.smooth import Cluster, SmoothOptions, local_cluster, run_smooth
from hardware.offline.smooth_report import evaluate_smoothed
from hardware.offline.smooth_tracks import ReobservedTracks, SessionTracks, reobserve, tracks_of
from hardware.process.clock import CpuClock, ProcessorClock, WallClock
from hardware.process.progress import cache_folder, no_progress
from hardware.process.system import file_hash
from hardware.recording.recorder import Recorder
from hardware.recording.session_reader import open_session
from hardware.report.evaluation import best_constant, spread
from perception import shipped_file
from perception.frames import Frame
from tests.campaigns.estimator import nees

SESSION_SETTINGS = 5.0, 30.0, 60  # s, Hz, landmarks
MIN_SPEED_UP = 1.8


def cluster_figures(count: int) -> list[Figure]:
    """The gain of a second worker, and how many of so many equal sessions are smoothed where one worker is killed."""
    names = f"{count} sessions: two workers by one", f"{count} sessions, a worker killed: smoothed"
    with tempfile.TemporaryDirectory() as folder:
        sessions = Path(folder) / "sessions"
        sessions.mkdir()
        world = synthetic_world("breathing", *SESSION_SETTINGS)
        blank = np.full((720, 1280), 90, np.uint8)
        with Recorder(sessions / "s000.mcap", world.rig) as recorder:
            for k, tracks in enumerate(world):
                for camera in range(3 if k == 0 else 1):
                    recorder.frame(Frame(camera, tracks.stamp, blank))
                recorder.write(tracks)
        for k in range(1, count):
            shutil.copy(sessions / "s000.mcap", sessions / f"s{k:03}.mcap")
        try:
            spent = [_smooth_all(sessions, Path(folder) / f"by{workers}", workers)[0] for workers in (1, 2)]
        except InputError as missing:
            return [Figure(name, math.nan, "", None, "", str(missing)) for name in names]
        _, done = _smooth_all(sessions, Path(folder) / "killed", 2, kill=True)
    note = f"{spent[0]:.1f} s and {spent[1]:.1f} s by the clock, at a load of {os.getloadavg()[0]:.1f}"
    return [
        Figure(names[0], spent[0] / spent[1], "", at_least(MIN_SPEED_UP), "", note),
        Figure(names[1], float(done), "", at_least(count), "", "after the first session was done"),
    ]


def _smooth_all(sessions: Path, out: Path, workers: int, kill: bool = False) -> tuple[float, int]:
    """Seconds by the clock, once the workers run, and sessions done. kill: one worker, after the first session."""
    clock, done = WallClock(), 0
    with local_cluster(workers) as cluster:
        start = clock.now()
        for outcome in run_smooth([sessions], out, SmoothOptions(), Cluster(cluster.scheduler_address)):
            done += not outcome.failed
            if kill:
                kill = False
                os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
        return clock.now() - start, done


@dataclass(frozen=True, slots=True, eq=False)
class RenderedErrors:
    """RMS distances from the truth, mm, each after the constant that fits it best."""

    causal: float
    tracked: float  # smoothed by the run's own tracks
    smoothed: float  # smoothed by reobserved tracks, too
    reobserved: ReobservedTracks


def rendered_figures(names: Sequence[str], seconds: float) -> list[Figure]:
    """A figure for each scenario, and the worst of them."""
    figures = []
    for name in names:
        session = prerender(shipped_file("scenarios", f"{name}.toml"), cache_folder(), seconds=seconds).session
        figures.append(figure := rendered_figure(name, smooth_rendered(session)))
        print(f"{name}: {figure.value:.2f} of the causal error; {figure.note}", file=sys.stderr, flush=True)
    if figures:
        worst = max(figures, key=lambda figure: figure.value)
        figures.append(Figure("pictures: worst of them", worst.value, "", at_most(1.0), "", worst.what))
    return figures


def rendered_figure(name: str, errors: RenderedErrors) -> Figure:
    """Smoothed by causal error of one scenario."""
    tracks, tracked = errors.reobserved, 1000 * errors.tracked
    note = (
        f"{1000 * errors.smoothed:.1f} against {1000 * errors.causal:.1f} um RMS, aligned; {tracked:.1f} um "
        f"without {tracks.looks} looks found besides, {tracks.early} of them before their landmarks joined"
    )
    what = f"pictures, {name}: error by the causal one's"
    return Figure(what, errors.smoothed / errors.causal, "", at_most(0.6), "", note)


def smooth_rendered(path: Path) -> RenderedErrors:
    """A session of pictures with its truth, tracked and smoothed."""
    session = open_session(path)
    with tempfile.TemporaryDirectory() as folder:
        contents, out = file_hash(path), Path(folder)
        tracks = tracks_of(session, out, contents)
        before = smooth(session.rig, tracks.observations, start=tracks.start)
        again = reobserve(session, tracks, before, out, contents)
    after = smooth(session.rig, again.tracks.observations, start=tracks.start) if again.looks else before
    (tracked, causal), (smoothed, _) = (_errors(session, result, tracks) for result in (before, after))
    return RenderedErrors(causal, tracked, smoothed, again)


def _errors(session: Session, result: Smoothed, tracks: SessionTracks) -> tuple[float, float]:
    """RMS distances, mm, of smoothed and of causal poses."""
    errors = evaluate_smoothed(result, tracks, session.truth).errors
    if errors is None or errors[1] is None:
        raise InputError(session.path, "poses beside a truth", "none", "a rendered session that the tracker follows")
    return spread(errors[0].translation).rmse, spread(errors[1].translation).rmse


NO_GATE = 1e4  # times the gate: no residual is that large, and all count by their squares
NO_MOTION_PRIOR = np.array([1e10] * 3 + [1e15] * 3)  # rad^2/s^5, mm^2/s^5: neighbouring poses are independent
NO_JITTER = 1e-7, 1e-5  # s, px: exposures and images without a jitter
COST_TOLERANCE, MAX_STEPS = 1e-8, 50  # of the cost; solver steps
PYCOLMAP_MISSING = "pycolmap is not installed (the extra [counterparts]): not compared"


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedBundle:
    """The result of one solver."""

    rms: float  # px, of all residuals
    spent: float  # s of one core
    steps: int


def ceres_figures(seconds: float, count: int) -> list[Figure]:
    """Cost and time of ours by Ceres's; a note where pycolmap is not installed."""
    name = f"bundle adjustment, {seconds:g} s and {count} landmarks"
    try:
        import pycolmap
    except ImportError:
        whats = f"{name}: cost by Ceres's", f"{name}: time by Ceres's"
        return [Figure(what, math.nan, "", None, "", PYCOLMAP_MISSING) for what in whats]
    world = synthetic_world("breathing", seconds, count=count)
    data = pack_tracks(list(world), len(world.rig))
    poses, points = initial_estimate(world.rig, data, None, None)
    known = np.isfinite(points[:, 0])
    data, points = data.select_landmarks(known), points[known]
    own, theirs = adjust_ours(world.rig, data, poses, points), adjust_by_ceres(pycolmap, world.rig, data, poses, points)
    costs = f"residuals of {own.rms:.6f} against {theirs.rms:.6f} px RMS"
    times = f"{own.spent:.2f} s in {own.steps} steps against {theirs.spent:.2f} s in {theirs.steps}, of one core"
    return [
        Figure(f"{name}: cost by Ceres's", (own.rms / theirs.rms) ** 2, "", at_most(1 + 1e-6), "", costs),
        Figure(f"{name}: time by Ceres's", own.spent / theirs.spent, "", None, "", times),
    ]


def adjust_ours(rig: Rig, data: TrackArrays, poses: Array, points: Array) -> AdjustedBundle:
    """By our own elimination."""
    clock = ProcessorClock()
    start = clock.now()
    cameras, rest = smoothed.cameras_from_rig(rig), np.zeros((len(poses), 6))
    sigmas = smoothed.correction_sigmas(smoothed.CalibrationPrior(clock=0.0), len(rig))
    calibration = smoothed.prior_information(sigmas, np.ones(len(rig), bool))
    known = Priors(
        cameras, calibration, points, np.eye(points.size) / FREE_LANDMARK_MM**2, poses[0],
        0, HELD_POSE_SIGMA, np.tile(NO_MOTION_PRIOR, (len(poses) - 1, 1)),
    )  # fmt: skip
    problem = BatchProblem(data, np.zeros(0, np.int64))
    noise = NoiseModel(np.ones(len(rig)), *NO_JITTER, gate=NO_GATE)
    estimate, costs = Estimate(smoothed.States(poses, rest, rest), cameras, points), list[float]()
    while len(costs) < MAX_STEPS:
        equations = NormalEquations(problem, estimate, known, noise)
        whole = equations.eliminate(no_progress)
        costs.append(whole.cost)
        if len(costs) > 1 and costs[-2] - costs[-1] < COST_TOLERANCE * costs[-1]:
            break
        step = whole.shared_step()
        estimate = estimate.retract(equations.eliminate(no_progress, step).factor.steps(), step, problem.free)
    spent = clock.now() - start
    return AdjustedBundle(residual_rms(rig, data, estimate.states.poses, estimate.points), spent, len(costs) - 1)


def adjust_by_ceres(pycolmap: Any, rig: Rig, data: TrackArrays, poses: Array, points: Array) -> AdjustedBundle:
    """By pycolmap, whose world frame is the surface, and whose rig frame is the first camera."""

    def rigid(transform: Array) -> Any:
        return pycolmap.Rigid3d(np.ascontiguousarray(transform[:3]))

    whole, first = pycolmap.Reconstruction(), rig.cameras[0].base_from_camera
    model = pycolmap.Rig(rig_id=1)
    for c, camera in enumerate(rig.cameras):
        m, (width, height) = camera.matrix, camera.size
        lens = [m[0, 0], m[1, 1], m[0, 2], m[1, 2]]
        pinhole = pycolmap.Camera(camera_id=c + 1, model="PINHOLE", width=width, height=height, params=lens)
        whole.add_camera(pinhole)
        if c == 0:
            model.add_ref_sensor(pinhole.sensor_id)
        else:
            model.add_sensor(pinhole.sensor_id, rigid(se3.inverse(camera.base_from_camera) @ first))
    whole.add_rig(model)
    elements: list[list[Any]] = [[] for _ in points]  # the images of each landmark
    for k, pose in enumerate(poses):
        frame = pycolmap.Frame(frame_id=k + 1, rig_id=1)
        part, images = slice(data.starts[k], data.starts[k + 1]), []
        for c in range(len(rig)):
            rows = np.flatnonzero(data.camera[part] == c) + data.starts[k]
            number = k * len(rig) + c + 1
            for i, row in enumerate(rows):
                elements[data.landmark[row]].append(pycolmap.TrackElement(number, i))
            image = pycolmap.Image(name=str(number), keypoints=data.pixels[rows], camera_id=c + 1, image_id=number)
            image.frame_id = k + 1
            frame.add_data_id(image.data_id)
            images.append(image)
        frame.rig_from_world = rigid(se3.inverse(first) @ pose)
        whole.add_frame(frame)
        for image in images:
            whole.add_image(image)
        whole.register_frame(k + 1)
    for place, track in zip(points, elements, strict=True):
        whole.add_point3D(place, pycolmap.Track(elements=track))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.refine_sensor_from_rig = False
    options.print_summary = False
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations, solver.function_tolerance = 1, MAX_STEPS, COST_TOLERANCE
    solver.gradient_tolerance = 0.0
    config = pycolmap.BundleAdjustmentConfig()
    for image in whole.images:
        config.add_image(image)
    config.set_constant_rig_from_world_pose(1)
    clock = ProcessorClock()
    start = clock.now()
    summary = pycolmap.create_default_ceres_bundle_adjuster(options, config, whole).solve()
    spent = clock.now() - start
    matrices = np.stack([whole.frame(k + 1).rig_from_world.matrix() for k in range(len(poses))])
    adjusted = first @ se3.make(matrices[:, :, :3], matrices[:, :, 3])
    places = np.stack([whole.point3D(n + 1).xyz for n in range(len(points))])
    steps = summary.ceres_summary.num_successful_steps - 1  # the initial evaluation counts as one
    return AdjustedBundle(residual_rms(rig, data, adjusted, places), spent, int(steps))


def residual_rms(rig: Rig, data: TrackArrays, poses: Array, points: Array) -> float:
    """Reprojection error, px RMS, by arithmetic of neither solver."""
    frame = np.repeat(np.arange(len(poses)), np.diff(data.starts))
    camera_from_base = se3.inverse(np.stack([camera.base_from_camera for camera in rig.cameras]))
    landmarks = np.insert(points, 3, 1.0, axis=1)[data.landmark][..., None]
    in_camera = (camera_from_base[data.camera] @ poses[frame] @ landmarks)[:, :3, 0]
    matrices = np.stack([camera.matrix for camera in rig.cameras])[data.camera]
    pixels = (matrices @ (in_camera / in_camera[:, 2:])[..., None])[:, :2, 0]
    return float(np.sqrt(((pixels - data.pixels) ** 2).mean()))


CAMERA_OFFSETS = (0.016, 0.0, -0.016)  # s
MAX_SECONDS, MAX_GIGABYTES, TARGET_MINUTES = 60.0, 2.0, 10.0


@dataclass(frozen=True, slots=True)
class MovementErrors:
    """One world: mean squared error, mm^2, of smoothed and causal poses, aligned; NEES/6 of the smoothed."""

    smoothed: float
    causal: float
    nees: float  # of the poses
    twist_nees: float


def run_smoothing(options: argparse.Namespace) -> list[Figure]:
    """All figures."""
    figures: list[Figure] = []
    for movement in options.movements:
        of_movement = pair_figures(movement, [_movement_errors(movement, k, options) for k in range(options.seeds)])
        print(f"{movement}: {of_movement[0].value:.2f} of the causal error", file=sys.stderr, flush=True)
        figures += of_movement
    if options.movements:
        figures += _offset_figures(options)
    figures += rendered_figures(options.scenarios, options.rendered)
    if options.adjusted:
        figures += ceres_figures(options.adjusted, options.count)
    if options.sessions:
        figures += cluster_figures(options.sessions)
    figures += [figure for minutes in options.minutes for figure in _timed(minutes, options.count)]
    return figures + [_timed(1.0, count)[0] for count in options.landmarks]  # less memory than the longest run took


def pair_figures(movement: str, pairs: list[MovementErrors]) -> list[Figure]:
    """The figures of one movement, over all its worlds."""
    means = columns(pairs, "smoothed", "causal", "nees", "twist_nees")
    smoothed, causal, consistency, twist_consistency = (float(values.mean()) for values in means)
    ours, theirs = (1000 * float(np.sqrt(square)) for square in (smoothed, causal))
    note = f"{ours:.1f} against {theirs:.1f} um RMS, aligned"
    return [
        Figure(f"{movement}: error by the causal one's", ours / theirs, "", at_most(0.6), "", note),
        Figure(f"{movement}: NEES/6", consistency, "", CONSISTENT_NEES, "", "from the first pose"),
        Figure(f"{movement}: twist NEES/6", twist_consistency, "", CONSISTENT_NEES),
    ]


def _movement_errors(movement: str, seed: int, options: argparse.Namespace) -> MovementErrors:
    world = synthetic_world(movement, options.seconds, count=options.count, seed=seed)
    result = smooth(world.rig, list(world))
    causal = [pose for pose in follow(world, "seen").poses if pose.state.measured]
    rows = np.searchsorted(world.stamps, [pose.stamp - 1e-6 for pose in causal])
    poses, truth = result.states.poses, world.truth.base_from_surface
    theirs = np.stack([pose.base_from_surface for pose in causal])
    # the first pose is aligned with the truth, as smoothing aligns its frame
    true_from_smoothed = se3.inverse(truth[0]) @ poses[0]
    error = se3.log(se3.inverse(poses) @ truth @ true_from_smoothed)[1:]
    twist_error = world.twists(world.stamps) @ se3.adjoint(se3.inverse(true_from_smoothed)).T - result.states.twists
    return MovementErrors(
        _squared_error(poses[rows], truth[rows]),
        _squared_error(theirs, truth[rows]),
        float(nees(error, result.covariance[1:, :6, :6]).mean() / 6),
        float(nees(twist_error, result.covariance[:, 6:12, 6:12]).mean() / 6),
    )


def _squared_error(poses: Array, truth: Array) -> float:
    """Mean squared distance, mm^2, of the origin after the constant that fits best."""
    constant = best_constant(se3.inverse(truth) @ poses)
    return float(((poses[:, :3, 3] - (truth @ constant)[:, :3, 3]) ** 2).sum(1).mean())


def _offset_figures(options: argparse.Namespace) -> list[Figure]:
    """With exposure offsets and an imperfect calibration, which the recording corrects."""
    errors, offsets = [], []
    for seed in range(options.seeds):
        conditions: dict[str, Any] = {"seed": seed, "offsets": CAMERA_OFFSETS, "calibration": 0.3}
        world = synthetic_world("lively", options.seconds, count=options.count, **conditions)
        result = smooth(world.rig, list(world), prior=smoothed.REFINED_PRIOR)
        errors.append(_squared_error(result.states.poses, world.truth.base_from_surface))
        offsets.append(result.offsets - np.array(CAMERA_OFFSETS))
    name = "lively, cameras 16 ms apart, calibrated to 0.3 px"
    return [
        Figure(f"{name}: error", float(np.sqrt(np.mean(errors))), "mm", at_most(0.05), "", "RMS, aligned"),
        Figure(f"{name}: offsets off by", 1000 * rms(np.array(offsets)), "ms"),
    ]


def _timed(minutes: float, count: int) -> list[Figure]:
    world = synthetic_world("breathing", 60 * minutes, count=count)
    tracks, clock = list(world), CpuClock()
    start = clock.now()
    smooth(world.rig, tracks)
    spent = clock.now() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    name = f"{minutes:g} min, {len(world)} poses, {count} landmarks"
    time, memory = (at_most(MAX_SECONDS), at_most(MAX_GIGABYTES)) if minutes == TARGET_MINUTES else (None, None)
    return [
        Figure(f"{name}: time", spent, "s", time, "", "of one core"),
        Figure(f"{name}: memory", peak, "GB", memory, "", "peak, tracks included"),
    ]
