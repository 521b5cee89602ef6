"""Subjects `thesis` and `latency`: tracking methods on short rendered recordings, or on recorded sessions.

`thesis`: the thesis's estimator and ours, on the same frame sets in the same run.
`latency`: from three decoded frames to the pose, flow included, by wall clock and by processor.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from estimation.pose import SurfacePose, TrackState, Trajectory
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.bench.figures import Figure, Target, at_least, at_most, milliseconds
from hardware.files.images import decode, encode
from hardware.files.pose_file import PoseWriter, read_poses
from hardware.offline.track import step_by, tracker
from hardware.process.checks import Table
from hardware.process.clock import ProcessorClock, WallClock
from hardware.recording.session_reader import open_session
from hardware.report.evaluation import Evaluation, evaluate, measured_share, percent, spread
from hardware.simulator.motion_table import motion_from_tables
from hardware.simulator.scenario_tables import scene_from_table
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState, rois
from hardware.simulator.scene.shape import Wound, flat, with_wound
from hardware.simulator.truth import Truth
from perception.frames import Frame, FrameSet, Roi
from perception.tracking import MAP_METHOD
from perception.tracking.step import STAGES

FRAME_RATE = 30.0  # frame sets a second
SCENE_SEED = 1
TABLE_SOURCE = "stillbed bench thesis"
PATCH_SIZE = (80.0, 60.0)  # mm, flat and textured: what the thesis's method is best at
SLIDING: Table = {"kind": "sine", "rate_hz": 0.5, "mm_per_frame": 0.47, "direction": [1.0, 0.0, 0.0]}
CUBE: Table = {"kind": "constant", "unit_mm": 50.0}
TURNING: Table = {"kind": "breathing", "amplitude_mm": 4.0, "rate_hz": 0.25, "turn_deg": [4.0, 2.0, 0.0]}
CALM_BREATHING: Table = {"kind": "breathing", "amplitude_mm": 4.0, "rate_hz": 0.25, "turn_deg": [1.0, 0.4, 0.0]}
MADE_RECORDINGS: dict[str, tuple[Table | None, Table]] = {
    "flat patch, shaking table": (None, SLIDING),
    "flat patch, constant speed in six axes": (None, CUBE),
    "wet forearm, breathing": ({"body": "forearm", "wetness": 1.0}, TURNING),
    "chest, breathing": ({"body": "chest"}, CALM_BREATHING),
}  # body, None for the patch, and motion: thesis 4.6's two experiments, and two of the wounds it is meant for


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """One recording."""

    name: str
    rig: Rig
    roi: tuple[Roi, ...]  # where the surface is at the start
    truth: Trajectory | None  # None where nothing is known of it
    frame_sets: Callable[[], Iterator[FrameSet]]  # in order of stamp, the same ones each time
    surface: Path | None = None


def rendered_recording(name: str, seconds: float, rig: Rig | None = None) -> Recording:
    """The recording `name` of MADE; rig: three cameras as in the thesis, if no other."""
    table, motion = MADE_RECORDINGS[name]
    if table is None:
        shape = with_wound(flat(PATCH_SIZE), Wound((26.0, 18.0)), SCENE_SEED)
        scene = Scene(shape, Appearance(texel=0.2, wetness=0.3, drape=False), seed=SCENE_SEED)
    else:
        scene = scene_from_table(TABLE_SOURCE, dict(table), Path(), SCENE_SEED)
    rig = rig or arc_rig()
    cameras = rig.cameras
    truth = Truth(BASE_FROM_REST, motion_from_tables(TABLE_SOURCE, [dict(motion)], Path(), SCENE_SEED))
    stamps = np.arange(round(seconds * FRAME_RATE)) / FRAME_RATE
    poses = truth.base_from_surface(stamps)

    def rendered() -> Iterator[FrameSet]:
        rng = np.random.default_rng([SCENE_SEED, 31])
        for stamp in stamps.tolist():
            times = np.array([stamp])
            instant = WorldState(stamp, 0.0, truth.base_from_surface(times)[0], truth.twist(times)[0])
            images = render(scene, cameras, [instant] * len(cameras), Sensor(), rng.spawn(len(cameras)))
            yield FrameSet(stamp, tuple(Frame(c, stamp, image) for c, image in enumerate(images)))

    return Recording(name, rig, rois(scene, rig, poses[0], 0.0), Trajectory(stamps, poses, exact=True), rendered)


def chosen_recordings(options: argparse.Namespace, names: Iterable[str]) -> list[Recording]:
    """The recorded sessions that the options name, or rendered recordings of these names."""
    sessions = [(path.name, open_session(path)) for path in options.sessions]
    recordings = [Recording(name, s.rig, s.roi, s.truth, s.frame_sets, s.surface) for name, s in sessions]
    return recordings or [rendered_recording(name, options.seconds) for name in names]


MIN_ACCURACY_RATIO, MIN_SPEED_RATIO = 10.0, 5.0  # times better than the thesis's, which ours is to be
REFERENCE_MM = "1.6, 4.0, 1.8 on other rendered sequences"
REFERENCE_MS = "70, thesis Fig. 4.17"


@dataclass(frozen=True, slots=True, eq=False)
class MethodResult:
    """How well and how fast a method tracks a recording."""

    run: Evaluation
    millimetres: float  # RMSE of the measured poses' place from the start; NaN without a truth
    degrees: float  # RMSE of the measured poses' rotation from the start; NaN without a truth
    processor: float  # ms, median of all threads on a frame set after initialisation


def run_thesis(options: argparse.Namespace) -> list[Figure]:
    """Errors and latencies of both on each recording, and how many times ours are smaller."""
    figures = []
    for recording in chosen_recordings(options, MADE_RECORDINGS):
        figures += _figures(recording.name, *_compare_methods(recording, (MAP_METHOD, options.method)))
    return figures


def _compare_methods(recording: Recording, methods: tuple[str, ...]) -> list[MethodResult]:
    """Track a recording by each method; they take turns on each frame set, so that the machine is the same for all."""
    now, processor = WallClock().now, ProcessorClock().now
    cameras = [camera.name for camera in recording.rig.cameras]
    with TemporaryDirectory() as folder, ExitStack() as stack:
        steps, writers, costs = {}, {}, {}
        for method in methods:
            (Path(folder) / method).mkdir()
            steps[method] = stack.enter_context(step_by(method, recording.rig, recording.roi, recording.surface, now))
            writers[method] = stack.enter_context(PoseWriter(Path(folder) / method, cameras, STAGES))
            costs[method] = list[float]()
        for frames in recording.frame_sets():
            for method, step in steps.items():
                start, cost = now(), processor()
                pose = step(frames)
                costs[method].append(processor() - cost)
                duration = now() - start
                writers[method].write(pose, len(frames.frames), step.last, duration)
                step.idle()
        return [_method_result(recording, Path(folder) / m / "poses.csv", m, costs[m]) for m in methods]


def _method_result(recording: Recording, file: Path, method: str, costs: list[float]) -> MethodResult:
    since = min((roi.stamp for roi in recording.roi), default=-np.inf)
    result = evaluate(read_poses(file), recording.truth, recording.name, since, method=method)
    later, position_error, rotation_error = costs[result.latency.initial_sets :], math.nan, math.nan
    if result.comparison is not None:
        start = result.comparison.start
        position_error, rotation_error = spread(start.translation).rmse, float(np.degrees(spread(start.rotation).rmse))
    return MethodResult(result, position_error, rotation_error, 1000 * float(np.median(later)) if later else math.nan)


def _figures(name: str, ours: MethodResult, reference_result: MethodResult) -> list[Figure]:
    """Ours, the thesis's and how many times ours is smaller, with the least ratio where one is a target."""
    label, figures = reference_result.run.method, list[Figure]()
    shares = (
        f"measured: {label} {percent(measured_share(reference_result.run))}, ours {percent(measured_share(ours.run))}"
    )
    accuracy, speed = at_least(MIN_ACCURACY_RATIO), at_least(MIN_SPEED_RATIO)
    latency, reference_latency = ours.run.latency, reference_result.run.latency
    for what, unit, own, other, reference, target, note in (
        ("error", "mm RMSE", ours.millimetres, reference_result.millimetres, REFERENCE_MM, accuracy, ""),
        ("turn", "deg RMSE", ours.degrees, reference_result.degrees, "", accuracy, shares),
        ("pose after", "ms, median", latency.p50[-1], reference_latency.p50[-1], REFERENCE_MS, speed, ""),
        ("pose after, 99 %", "ms", latency.p99[-1], reference_latency.p99[-1], "", None, ""),
        ("processor", "ms, median", ours.processor, reference_result.processor, "", None, ""),
    ):
        ratio = float(other) / float(own) if own > 0 else math.nan
        figures += [
            Figure(f"{name}: {what}, ours", float(own), unit, note=note),
            Figure(f"{name}: {what}, {label}", float(other), unit, reference=reference),
            Figure(f"{name}: {what}, {label} / ours", ratio, "times", target),
        ]
    return figures


LATENCY_REFERENCE = "thesis 70"
LATENCY_TARGETS = ("median", 50, at_most(8)), ("99 %", 99, at_most(16)), ("largest", 100, at_most(33))
TRACK_TARGETS = ("median", 50, at_most(5)), ("99 %", 99, at_most(10))  # 120 a camera
ESTIMATION_TARGET = at_most(4)  # ms, 99 %
JPEG_QUALITY = 95  # of the pictures that wait in memory
WARM_UP_STEPS = 10  # frame sets after the first map that only fill caches and the window


def run_latency(options: argparse.Namespace) -> list[Figure]:
    """Latencies on each recording."""
    recordings = chosen_recordings(options, options.scene)
    return [figure for each in recordings for figure in latency_figures(each.name, *time_steps(each))]


def time_steps(recording: Recording) -> tuple[Array, Array]:
    """Wall time (N, 1 + len(STAGES)) s, in all and by stage, and processor time (N,), s, of each tracked frame set."""
    now, processor = WallClock().now, ProcessorClock().now
    rows, costs, initialised = [], [], 0
    packed = packed_sets(recording)
    with tracker(recording.rig, recording.roi, recording.surface, now) as step:
        for each in packed:
            frames = unpacked_set(each)
            start, cost = now(), processor()
            pose = step(frames)
            cost, duration = processor() - cost, now() - start
            step.idle()
            initialised += pose.state is not TrackState.INITIALISING
            if initialised > WARM_UP_STEPS:
                rows.append([duration, *step.last.seconds])
                costs.append(cost)
    return np.array(rows).reshape(-1, 1 + len(STAGES)), np.array(costs)


PackedSet = tuple[float, list[tuple[int, float, bytes]]]  # stamp, s; of each picture camera, stamp, s, and JPEG


def packed_sets(recording: Recording) -> list[PackedSet]:
    """A recording's pictures, small enough to wait in memory: all are rendered before the first is tracked."""
    return [
        (frames.stamp, [(f.camera, f.stamp, encode(f.image, JPEG_QUALITY)[1]) for f in frames.frames])
        for frames in recording.frame_sets()
    ]


def unpacked_set(packed: PackedSet) -> FrameSet:
    """The frame set, decoded anew."""
    stamp, pictures = packed
    return FrameSet(stamp, tuple(Frame(c, t, decode(data, "bench", "picture")) for c, t, data in pictures))


def latency_figures(name: str, wall: Array, processor: Array) -> list[Figure]:
    """Figures in ms of wall times (N, 1 + len(STAGES)) s and processor times (N,) s."""
    if not len(wall):
        return [Figure(f"{name}: pose after", math.nan, "ms", note="no surface was followed for long enough")]

    def figure(what: str, seconds: Array, word: str, share: float, target: Target | None = None, *words: str) -> Figure:
        return Figure(f"{name}: {what}, {word}", milliseconds(seconds, share), "ms", target, *words)

    note = f"{len(wall)} frame sets; the machine's load was {os.getloadavg()[0]:.1f}"
    stages = dict(zip(STAGES, wall[:, 1:].T, strict=True))
    tracking, flow = stages["flow"] + stages["align"], float(np.mean(stages["flow"] > 0))
    return [
        *(figure("pose after", wall[:, 0], *target, LATENCY_REFERENCE, note) for target in LATENCY_TARGETS),
        figure("processor", processor, "median", 50, None, "", "all threads"),
        *(figure(stage, seconds, "median", 50) for stage, seconds in stages.items()),
        *(figure("tracks of all cameras", tracking, *target) for target in TRACK_TARGETS),
        figure("estimation alone", stages["pose"], "99 %", 99, ESTIMATION_TARGET),
        Figure(f"{name}: frame sets that asked for flow", 100 * flow, "%"),
    ]


def beside_figures(
    name: str, without: Sequence[SurfacePose], along: Sequence[SurfacePose], spent: Array
) -> list[Figure]:
    """What the network beside the tracker costs the N poses of the same pictures.

    without, along: N poses each. spent: (3, N) s, to each of them, and after the latter to hand the pictures over.
    """
    tracked = np.cumsum([pose.state is not TrackState.INITIALISING for pose in without]) > WARM_UP_STEPS
    if not tracked.any():
        return [Figure(f"{name}: pose after", math.nan, "ms", note="no surface was followed for long enough")]
    pairs, figures = list(zip(without, along, strict=True)), list[Figure]()
    lost_count = sum(a.state.measured and not b.state.measured for a, b in pairs)
    different_count = sum(pose_bytes(a) != pose_bytes(b) for a, b in pairs)
    for word, share in (("median", 50), ("99 %", 99)):
        plain_ms, loaded_ms, handover_ms = (milliseconds(seconds[tracked], share) for seconds in spent)
        figures += [
            Figure(f"{name}: pose after, without the network, {word}", plain_ms, "ms", note=f"{tracked.sum()} each"),
            Figure(f"{name}: pose after, with it, {word}", loaded_ms, "ms"),
            Figure(f"{name}: with / without, {word}", loaded_ms / plain_ms, "times"),
            Figure(f"{name}: pictures handed over, after the pose, {word}", handover_ms, "ms"),
        ]
    late_without, late_with = (int((seconds[tracked] > 1 / FRAME_RATE).sum()) for seconds in spent[:2])
    return [
        *figures,
        Figure(f"{name}: poses later than the next pictures", late_with, note=f"without the network {late_without}"),
        Figure(f"{name}: poses lost with the network alone", lost_count, "", at_most(0), "", f"of {len(pairs)}"),
        Figure(f"{name}: poses that differ in a bit", different_count, "", at_most(0), "", f"of {len(pairs)}"),
    ]


def pose_bytes(pose: SurfacePose) -> tuple[object, ...]:
    """All of a pose, to the last bit."""
    numbers = [np.ravel(values) for values in (pose.stamp, pose.base_from_surface, pose.covariance, pose.twist)]
    return pose.state, pose.reason, np.concatenate(numbers).tobytes()
