"""Subjects `estimator` and `consistency`: are errors near their lower bound, and as large as the covariance says?

`estimator` follows tracks of synthetic worlds, beside the Cramer-Rao bound and OpenCV's solvePnP, and soaks.
`consistency` follows pictures: loops of rendered scenes, shown with fresh noise each time round.
Its errors are those after the constant transform at the first TRACKING pose; nothing is fitted over the run.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from estimation.synthetic.follow import FollowResult, Mapping, follow, follow_steps
from estimation.synthetic.world import BASE_FROM_REST, World, arc_rig, synthetic_world
from hardware.bench.figures import CONSISTENT_NEES, Figure, Target, at_least, at_most, rms, with_progress
from hardware.process.clock import CpuClock
from hardware.simulator.scene.appearance import Appearance
from hardware.simulator.scene.scene import Scene, rois
from hardware.simulator.scene.shape import Wound, cylinder, with_wound
from perception.frames import Frame, FrameSet
from perception.tracking.step import TrackingStep
from tests.picture_loop import PictureLoop, closed_motion

HALF_PERIOD = 0.016  # s, half a frame period at 30 Hz: webcams are not synchronised


@dataclass(frozen=True, slots=True)
class TrackScene:
    """One world, except for its seed."""

    name: str
    movement: str
    conditions: dict[str, Any] = field(default_factory=dict)  # of `estimation.synthetic.world`
    error: Target | None = None  # mm
    rigid: bool = False  # whether all is as the model assumes, so that the error has to be near the bound
    surface: str = "patch"


SYNC_ERROR, ASYNC_ERROR = at_most(0.03), at_most(0.1)  # mm, with and without synchronised exposures
HALF_OFFSETS = {"offsets": (0.0, HALF_PERIOD, -HALF_PERIOD)}
INSIDE_95 = Target(0.93, 0.97)  # share of errors inside their 95 % intervals
CLEAN_MOVEMENTS = "still", "breathing", "irregular", "shaker", "steps", "turns", "sway", "lively"
TRACK_SCENES = (
    *(TrackScene(f"{movement}, clean", movement, {}, SYNC_ERROR, True) for movement in CLEAN_MOVEMENTS),
    TrackScene("breathing, noise 0.5 px", "breathing", {"noise": 0.5}, None, True),
    TrackScene("breathing, dropouts 15 %", "breathing", {"dropouts": 0.15}, SYNC_ERROR, True),
    TrackScene("breathing, churn 5 s", "breathing", {"churn": 5.0}, SYNC_ERROR, True),
    TrackScene("breathing, outage 0.4 s", "breathing", {"outages": ((4.0, 4.4),)}, SYNC_ERROR, True),
    TrackScene("breathing, outliers 10 %", "breathing", {"outliers": 0.1}, SYNC_ERROR, True),
    TrackScene("breathing, coherent 20 %", "breathing", {"coherent": 0.2}),
    TrackScene("breathing, correlated 0.6 px", "breathing", {"correlated": 0.6}),
    TrackScene("breathing, offsets 16 ms", "breathing", HALF_OFFSETS, ASYNC_ERROR),
    TrackScene("breathing, offsets 16, 4, 12 ms", "breathing", {"offsets": (HALF_PERIOD, -0.004, -0.012)}, ASYNC_ERROR),
    TrackScene("breathing, offsets 16 ms, lens 0.3 px", "breathing", {**HALF_OFFSETS, "calibration": 0.3}, ASYNC_ERROR),
    TrackScene("breathing, jitter 5 ms", "breathing", {"jitter": 0.005}, ASYNC_ERROR),
    TrackScene("lively, offsets 16 ms", "lively", HALF_OFFSETS, ASYNC_ERROR),
    TrackScene("breathing, cube", "breathing", rigid=True, surface="cube"),
)
MIN_PNP_TRACKS = 6  # for a pose
PNP_GATE_PX = 8.0  # px: OpenCV's own gate of an outlier


def best_camera(worlds: Sequence[World]) -> tuple[float, float]:
    """RMSE, mm and degrees over the three axes together, of the camera that is nearest to the truth by itself.

    Of the frame sets in which it has a pose. The landmarks are the world's own map, as in `follow(world, "told")`.
    """
    errors: dict[int, list[Array]] = {}  # of each camera, rad and mm
    for world in worlds:
        for tracks, true in zip(world, world.truth.base_from_surface, strict=True):
            points = world.map.points[tracks.track]
            for number, camera in enumerate(world.rig.cameras):
                own = tracks.camera == number
                pose = pnp_pose(camera, points[own], tracks.pixels[own])
                if pose is not None:
                    errors.setdefault(number, []).append(se3.log(se3.inverse(pose) @ true))
    arrays = [np.array(errors[number]) for number in sorted(errors)]  # (N, 6)
    squares = [np.array([(e[:, 3:] ** 2).sum(1).mean(), (e[:, :3] ** 2).sum(1).mean()]) for e in arrays]
    if not squares:
        return np.nan, np.nan
    place, turn = np.sqrt(min(squares, key=lambda square: float(square[0])))
    return float(place), float(np.degrees(turn))


def pnp_pose(camera: Camera, points: Array, pixels: Array) -> Array | None:
    """base_from_surface (4, 4) from points (N, 3) mm of the surface and their undistorted pixels (N, 2), or None."""
    if len(points) < MIN_PNP_TRACKS:
        return None
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        points, pixels, camera.matrix, None, reprojectionError=PNP_GATE_PX, flags=cv2.SOLVEPNP_SQPNP
    )
    if not ok or inliers is None or len(inliers) < MIN_PNP_TRACKS:
        return None
    rows = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(points[rows], pixels[rows], camera.matrix, None, turn, shift)
    return np.asarray(camera.base_from_camera @ se3.make(se3.exp_rotation(turn[:, 0]), shift[:, 0]))


SOAK_RATE = 30.0  # Hz
WARM_UP = 60.0  # s, after which memory counts: the key frames are full and the libraries warm


def soak_figures(hours: float, mapping: Mapping, of_map: str) -> list[Figure]:
    """Follow breathing for `hours` h of the surface's time."""
    world = synthetic_world(seconds=3600 * hours, rate=SOAK_RATE)
    count = len(world) - 1
    seconds, errors = np.ones(count), np.ones(count)  # written to, so that they count as memory from the start
    settled, before = min(count // 2, round(WARM_UP * SOAK_RATE)), np.nan
    run = follow_steps(world, mapping, CpuClock().now)
    first_pose = next(run).pose
    constant = se3.inverse(world.base_from_surface(np.array(first_pose.stamp))) @ first_pose.base_from_surface
    for k, step in enumerate(with_progress(f"soak, {of_map}", "frame sets", run, count)):
        true = world.base_from_surface(np.array(step.pose.stamp)) @ constant
        seconds[k], errors[k] = step.seconds, np.linalg.norm(step.pose.base_from_surface[:3, 3] - true[:3, 3])
        if k == settled:
            before = resident()
    tenth, minute, name = max(count // 10, 1), min(count, round(60 * SOAK_RATE)), f"soak {hours:g} h, {of_map}"
    slower = float(np.median(seconds[-tenth:]) / np.median(seconds[:tenth]))
    first, last, more = rms(errors[:minute]), rms(errors[-minute:]), resident() - before
    return [
        Figure(f"{name}: time per frame, last tenth by first", slower, "", at_most(1.02), "gtsam #1452", "CPU"),
        Figure(f"{name}: memory more", more, "MB", at_most(5.0), "gtsam #1935", "since its first minute"),
        Figure(f"{name}: error of the first minute", first, "mm", at_most(0.03)),
        Figure(f"{name}: error of the last minute", last, "mm", at_most(1.1 * first), "thesis chains frames"),
    ]


def resident() -> float:
    """Resident memory of this process, MB; nan where the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return math.nan
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


NORMAL_95 = 1.96  # standard deviations of 95 % of a normal error


@dataclass(frozen=True, slots=True)
class PooledErrors:
    """RMSE and RMS bounds of the measured poses, over the three axes together, and their consistency."""

    error_mm: float
    error_deg: float
    bound_mm: float  # of single frame sets
    bound_deg: float
    filtered_mm: float  # bound with the frame sets before, for motion that is white noise on acceleration
    filtered_deg: float
    nees: float  # mean over 6
    twist_nees: float
    inside: float  # share of the six axes' errors inside their 95 % intervals
    measured: float  # share of the frame sets


def pool_errors(runs: Sequence[FollowResult]) -> PooledErrors:
    """The figures of `runs`, at least one of which was measured somewhere."""

    def measured(values: Callable[[FollowResult], Array]) -> Array:
        return np.concatenate([values(run)[run.measured] for run in runs])

    errors, covariances = measured(lambda run: run.errors), measured(lambda run: run.covariances)
    bounds, filtered = measured(lambda run: run.bounds), measured(lambda run: run.filtered_bounds())
    twists, twist_covariances = measured(lambda run: run.twist_errors), measured(lambda run: run.twist_covariances)
    return PooledErrors(
        error_mm=_rms_length(errors[:, 3:]),
        error_deg=float(np.degrees(_rms_length(errors[:, :3]))),
        bound_mm=_rms_bound(bounds, 3),
        bound_deg=float(np.degrees(_rms_bound(bounds, 0))),
        filtered_mm=_rms_bound(filtered, 3),
        filtered_deg=float(np.degrees(_rms_bound(filtered, 0))),
        nees=float(nees(errors, covariances).mean() / 6),
        twist_nees=float(nees(twists, twist_covariances).mean() / 6),
        inside=_inside_95(errors, covariances),
        measured=float(np.concatenate([run.measured for run in runs]).mean()),
    )


def nees(errors: Array, covariances: Array) -> Array:
    """Normalised estimation errors squared (N,) of errors (N, 6) under covariances (N, 6, 6)."""
    return np.asarray(np.einsum("ni,nij,nj->n", errors, np.linalg.pinv(covariances, hermitian=True), errors))


def _inside_95(errors: Array, covariances: Array) -> float:
    """Share of the errors (N, 6) inside their 95 % intervals."""
    return float(np.mean(np.abs(errors) <= NORMAL_95 * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))))


def _rms_length(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(1).mean()))


def _rms_bound(covariances: Array, first: int) -> float:
    """Root mean square length that covariances (N, 6, 6) stand for along three axes from `first` on."""
    return float(np.sqrt(np.trace(covariances[:, first : first + 3, first : first + 3], axis1=1, axis2=2).mean()))


MAP_NAMES: dict[Mapping, str] = {"told": "exact map", "seen": "own map"}


def run_estimator(options: argparse.Namespace) -> list[Figure]:
    """All figures of the chosen scenes, or those of the soak."""
    if options.soak is not None:
        return [f for mapping in options.maps for f in soak_figures(options.soak, mapping, MAP_NAMES[mapping])]
    figures: list[Figure] = []
    runs: dict[Mapping, list[FollowResult]] = {mapping: [] for mapping in options.maps}
    scenes = [scene for scene in TRACK_SCENES if fnmatch(scene.name, options.only)]
    if not scenes:
        names = "; ".join(scene.name for scene in TRACK_SCENES)
        raise InputError("command line", "--only", options.only, f"a pattern of {names}")
    for scene in scenes:
        conditions = {"surface": scene.surface, **scene.conditions}
        usual = 24.0 if "offsets" in scene.conditions else 10.0  # s: offsets have to be known after 20 s
        seconds = usual if options.seconds is None else options.seconds
        worlds = [synthetic_world(scene.movement, seconds, seed=n, **conditions) for n in range(options.seeds)]
        pnp = best_camera(worlds)
        for mapping in options.maps:
            results = [follow(world, mapping, CpuClock().now) for world in worlds]
            figures += _scene_figures(scene, f"{scene.name}, {MAP_NAMES[mapping]}", results, pnp)
            runs[mapping] += results
    return figures + [f for mapping in options.maps for f in _work_figures(mapping, runs[mapping])]


def _scene_figures(
    scene: TrackScene, name: str, runs: Sequence[FollowResult], pnp: tuple[float, float]
) -> list[Figure]:
    """The figures of one scene with one kind of map. pnp: RMSE by solvePnP with the exact one, mm and degrees."""
    e = pool_errors(runs)
    by_bound, turn_by_bound = e.error_mm / e.bound_mm, e.error_deg / e.bound_deg
    text = (
        f"{e.error_mm:7.4f} mm x{by_bound:5.2f} {e.error_deg:7.4f} deg x{turn_by_bound:5.2f}  NEES/6 {e.nees:6.2f}"
        f"  twist {e.twist_nees:6.2f}  inside {e.inside:.3f}  measured {e.measured:.3f}"
    )
    print(f"{name:<48}{text}", file=sys.stderr, flush=True)
    rigid = scene.rigid and scene.error is not None
    near = at_most(1.3) if scene.rigid else None
    shift_bounds = f"bound {e.bound_mm:.4f}, filtered {e.filtered_mm:.4f}, solvePnP {pnp[0]:.3f}"
    turn_bounds = f"bound {e.bound_deg:.4f}, filtered {e.filtered_deg:.4f}, solvePnP {pnp[1]:.3f}"
    figures = [
        Figure(f"{name}: error", e.error_mm, "mm", scene.error, shift_bounds),
        Figure(f"{name}: turn", e.error_deg, "deg", at_most(0.05) if rigid else None, turn_bounds),
        Figure(f"{name}: error by bound", by_bound, "", near),
        Figure(f"{name}: turn by bound", turn_by_bound, "", near),
        Figure(f"{name}: NEES/6", e.nees, "", CONSISTENT_NEES),
        Figure(f"{name}: twist NEES/6", e.twist_nees, "", CONSISTENT_NEES),
        Figure(f"{name}: inside 95 %", e.inside, "", INSIDE_95),
    ]
    if "offsets" in scene.conditions:  # at the end; an offset that all clocks have in common cannot be observed
        true = np.array(scene.conditions["offsets"])
        errors = np.array([run.offsets - run.offsets.mean() for run in runs]) - true + true.mean()
        figures.append(Figure(f"{name}: offsets off by", 1000 * rms(errors), "ms", at_most(2.0), "thesis under 1 s"))
    return figures


def _work_figures(mapping: Mapping, runs: Sequence[FollowResult]) -> list[Figure]:
    """Time over all runs, and whether a world run twice gives the same bits."""
    if not runs:
        return []
    ms, name, note = 1000 * np.concatenate([run.seconds for run in runs]), MAP_NAMES[mapping], "CPU, tracks given"
    p50, p99 = np.percentile(ms, [50, 99]).tolist()
    twice = [follow(synthetic_world(seconds=3.0, offsets=(0.0, 0.01, 0.0)), mapping).poses for _ in range(2)]
    bits = [[b"".join(map(bytes, (p.base_from_surface, p.covariance, p.twist))) for p in poses] for poses in twice]
    differing = float(sum(first != second for first, second in zip(*bits, strict=True)))
    return [
        Figure(f"time, {name}: median", p50, "ms", None, "thesis 70 ms with flow", note),
        Figure(f"time, {name}: p99", p99, "ms", at_most(4.0), "", note),
        Figure(f"poses that differ run twice, {name}", differing, "", at_most(0), "open_vins #553"),
    ]


LOOP_SETS = 40  # frame sets of a loop
SETTLING_SETS = 32  # frame sets after the first TRACKING pose in which the covariance is the widest


@dataclass(frozen=True, slots=True, eq=False)
class SceneRun:
    """The measured poses of one scene after the first TRACKING one."""

    errors: Array  # (N, 6) rad and mm, surface frame
    covariances: Array  # (N, 6, 6) as reported
    twist_squares: Array  # (N,) NEES of the twists, over 6
    late: NDArray[np.int64]  # (N,) frame sets since the first TRACKING pose
    share: float  # of the frame sets that were measured


def run_consistency(options: argparse.Namespace) -> list[Figure]:
    """Figures over all scenes, and each scene's own."""
    runs, count = {}, round(options.seconds * FRAME_RATE_HZ)
    for seed in range(options.seed, options.seed + options.scenes):
        pictures = make_pictures(seed, LOOP_SETS)
        loop = pictures.near
        step = TrackingStep(pictures.rig, rois(pictures.scene, pictures.rig, loop.poses[0], 0.0))
        poses = []
        for number in range(count):
            stamp = number / FRAME_RATE_HZ
            frames = [Frame(c, stamp, loop.noisy(image)) for c, image in enumerate(loop.images(number))]
            poses.append(step(FrameSet(stamp, tuple(frames))))
            step.idle()
        runs[f"scene {seed}"] = scene_errors(poses, loop.poses[np.arange(count) % len(loop)])
    figures = consistency_figures("all", list(runs.values()))
    each = [f for name, run in runs.items() for f in consistency_figures(name, [run]) if "NEES/6" in f.what]
    return figures + each if len(runs) > 1 else figures


def scene_errors(poses: list[SurfacePose], truth: Array) -> SceneRun:
    """Errors of poses against truth (N, 4, 4), base_from_surface, after the transform at the first TRACKING one."""
    first = next((i for i, p in enumerate(poses) if p.state is TrackState.TRACKING), len(poses))
    rows = np.array([i for i in range(first + 1, len(poses) - 1) if poses[i].state.measured], np.int64)
    if not len(rows):
        return SceneRun(np.zeros((0, 6)), np.zeros((0, 6, 6)), np.zeros(0), rows, 0.0)
    expected = truth @ se3.inverse(truth[first]) @ poses[first].base_from_surface
    estimated = np.stack([poses[i].base_from_surface for i in rows])
    errors = se3.log(se3.inverse(estimated) @ expected[rows])
    twists = se3.log(se3.inverse(expected[rows - 1]) @ expected[rows + 1]) * (FRAME_RATE_HZ / 2)
    twist_errors = twists - np.stack([poses[i].twist for i in rows])
    twist_squares = nees(twist_errors, np.stack([poses[i].twist_covariance for i in rows])) / 6
    share = len(rows) / (len(poses) - first - 2)
    return SceneRun(errors, np.stack([poses[i].covariance for i in rows]), twist_squares, rows - first, share)


def consistency_figures(name: str, runs: list[SceneRun]) -> list[Figure]:
    """Of all poses but those of the first second, whose covariance is still that of unknown cameras."""
    errors, covariances = (np.concatenate([getattr(r, n) for r in runs]) for n in ("errors", "covariances"))
    twist_squares = np.concatenate([run.twist_squares for run in runs])
    settled = np.concatenate([run.late for run in runs]) > SETTLING_SETS
    if not settled.any():
        return [Figure(f"{name}: NEES/6", math.nan, "", CONSISTENT_NEES, note="not followed for longer than a second")]
    squares = nees(errors, covariances) / 6
    errors, covariances = errors[settled], covariances[settled]
    sigma = float(np.sqrt(np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2).mean() / 3))
    note = f"{len(errors)} poses; {squares[~settled].mean():.3f} in the first second" if (~settled).any() else ""
    return [
        Figure(f"{name}: NEES/6", float(squares[settled].mean()), "", CONSISTENT_NEES, "", note),
        Figure(f"{name}: twist NEES/6", float(twist_squares[settled].mean()), "", CONSISTENT_NEES),
        Figure(f"{name}: NEES/6, largest", float(squares[settled].max()), "", None, "", "of one pose"),
        Figure(f"{name}: inside 95 %", _inside_95(errors, covariances), "", INSIDE_95, "", "of six axes"),
        Figure(f"{name}: error of an axis", 1000 * rms(errors[:, 3:]), "um"),
        Figure(f"{name}: claim of an axis", 1000 * sigma, "um"),
        Figure(f"{name}: measured", 100 * float(np.mean([r.share for r in runs])), "%", at_least(99)),
    ]


FRAME_RATE_HZ = 30.0
MOTION_SETS = 96  # frame sets of the motion's loop: a breath of 3.2 s
LOOP_WOUND = Wound((40.0, 28.0))
FAR_POSE = se3.exp(np.array([0.08, -0.06, 0.2, 12.0, -9.0, 6.0]))


@dataclass(frozen=True, eq=False)
class ScenePictures:
    """The pictures of one scene for all stretches."""

    seed: int
    rig: Rig
    scene: Scene
    near: PictureLoop  # of the motion at one place

    @cached_property
    def far(self) -> PictureLoop:
        """And at another, rendered when it is needed first."""
        return PictureLoop(self.scene, self.rig, self.near.poses @ FAR_POSE, self.seed + 1)


def make_pictures(seed: int, period: int = MOTION_SETS, rig: Rig | None = None) -> ScenePictures:
    """Render the loop of one scene, `period` frame sets, some 10 s for the default."""
    rng = np.random.default_rng([seed, 61])
    rig = arc_rig(size=(640, 360), focal=560.0) if rig is None else rig
    shape = with_wound(cylinder((80.0, 60.0), float(rng.uniform(50, 120))), LOOP_WOUND, seed)
    scene = Scene(shape, Appearance(texel=0.2, wetness=0.3, drape=False), seed=seed)
    poses = closed_motion(period, BASE_FROM_REST, rng, lively=period / MOTION_SETS)  # of one speed for any period
    return ScenePictures(seed, rig, scene, PictureLoop(scene, rig, poses, seed))
