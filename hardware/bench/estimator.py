"""Subjects `estimator` and `consistency`: are poses near what tracks allow, and errors as large as is reported?

`estimator` follows tracks of synthetic worlds, beside the Cramer-Rao bound and OpenCV's solvePnP, and soaks.
`consistency` follows pictures: loops of the outages' scenes (outage_run.py), shown with fresh noise each time round.
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
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Camera
from estimation.se3 import Array
from estimation.synthetic.follow import FollowResult, Mapping, follow, follow_steps
from estimation.synthetic.world import World, synthetic_world
from hardware.bench.figures import (
    CONSISTENT_NEES,
    INSIDE_95,
    Figure,
    Target,
    at_least,
    at_most,
    percentile,
    rms,
    with_progress,
)
from hardware.bench.outage_run import FPS, picture_loop
from hardware.process.clock import CpuClock
from hardware.simulator.scene.scene import rois
from perception.frames import Frame, FrameSet
from perception.tracking.step import TrackingStep

HALF_PERIOD = 0.016  # s, half a frame period at 30 Hz: webcams are not synchronised


@dataclass(frozen=True, slots=True)
class TrackScene:
    """One world, but for its seed."""

    name: str
    movement: str
    conditions: dict[str, Any] = field(default_factory=dict)  # of `estimation.synthetic.world`
    error: Target | None = None  # mm
    rigid: bool = False  # whether all is as the model says, so that the error is asked to be near the bound
    surface: str = "patch"

    @property
    def seconds(self) -> float:
        """How long it lasts: offsets are asked to be known after 20 s."""
        return 24.0 if "offsets" in self.conditions else 10.0


DISTURBANCES = tuple(
    TrackScene(f"breathing, {name}", "breathing", conditions, at_most(limit) if limit else None, rigid)
    for name, conditions, limit, rigid in (
        ("noise 0.5 px", {"noise": 0.5}, 0.0, True),
        ("dropouts 15 %", {"dropouts": 0.15}, 0.03, True),
        ("churn 5 s", {"churn": 5.0}, 0.03, True),
        ("outage 0.4 s", {"outages": ((4.0, 4.4),)}, 0.03, True),
        ("outliers 10 %", {"outliers": 0.1}, 0.03, True),
        ("coherent 20 %", {"coherent": 0.2}, 0.0, False),
        ("correlated 0.6 px", {"correlated": 0.6}, 0.0, False),
        ("offsets 16 ms", {"offsets": (0.0, HALF_PERIOD, -HALF_PERIOD)}, 0.1, False),
        ("offsets 16, 4, 12 ms", {"offsets": (HALF_PERIOD, -0.004, -0.012)}, 0.1, False),
        ("offsets 16 ms, lens 0.3 px", {"offsets": (0.0, HALF_PERIOD, -HALF_PERIOD), "calibration": 0.3}, 0.1, False),
        ("jitter 5 ms", {"jitter": 0.005}, 0.1, False),
    )
)

TRACK_SCENES = (
    *(
        TrackScene(f"{movement}, clean", movement, error=at_most(0.03), rigid=True)
        for movement in ("still", "breathing", "irregular", "shaker", "steps", "turns", "sway", "lively")
    ),
    *DISTURBANCES,
    TrackScene("lively, offsets 16 ms", "lively", {"offsets": (0.0, HALF_PERIOD, -HALF_PERIOD)}, at_most(0.1)),
    TrackScene("breathing, cube", "breathing", rigid=True, surface="cube"),
)


MIN_PNP_TRACKS = 6  # tracks that a pose is sought from
PNP_GATE_PX = 8.0  # px: OpenCV's own gate of an outlier


def best_camera(worlds: Sequence[World]) -> tuple[float, float]:
    """RMSE, mm and degrees over the three axes together, of the camera that is nearest to the truth by itself.

    Of the frame sets in which it finds a pose. The landmarks are the world's own map, as in `follow(world, "told")`.
    """
    errors = [np.concatenate(of_camera) for of_camera in zip(*map(_errors, worlds), strict=True)]
    squares = [np.array([(e[:, 3:] ** 2).sum(1).mean(), (e[:, :3] ** 2).sum(1).mean()]) for e in errors if len(e)]
    if not squares:
        return np.nan, np.nan
    place, turn = np.sqrt(min(squares, key=lambda square: float(square[0])))
    return float(place), float(np.degrees(turn))


def _errors(world: World) -> list[Array]:
    """Errors (N, 6), rad and mm, of each camera's poses in one world."""
    errors: list[list[Array]] = [[] for _ in world.rig.cameras]
    for seen, true in zip(world, world.truth.base_from_surface, strict=True):
        points = world.map.points[seen.track]
        for number, camera in enumerate(world.rig.cameras):
            own = seen.camera == number
            pose = pnp_pose(camera, points[own], seen.pixels[own])
            if pose is not None:
                errors[number].append(se3.log(se3.inverse(pose) @ true))
    return [np.reshape(of_camera, (-1, 6)) for of_camera in errors]


def pnp_pose(camera: Camera, points: Array, pixels: Array) -> Array | None:
    """base_from_surface (4, 4) from points (N, 3) mm of the surface and their undistorted pixels (N, 2), or None."""
    if len(points) < MIN_PNP_TRACKS:
        return None
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        points, pixels, camera.matrix, None, reprojectionError=PNP_GATE_PX, flags=cv2.SOLVEPNP_SQPNP
    )
    if not ok or inliers is None or len(inliers) < MIN_PNP_TRACKS:
        return None
    kept = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(points[kept], pixels[kept], camera.matrix, None, turn, shift)
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
    begun = next(run).pose
    constant = se3.inverse(world.base_from_surface(np.array(begun.stamp))) @ begun.base_from_surface
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
    """Memory that this process holds, MB; nan where the system does not tell."""
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
    measured: float  # share

    def __str__(self) -> str:
        """All of it in one line."""
        error, turn = self.error_mm / self.bound_mm, self.error_deg / self.bound_deg
        return (
            f"{self.error_mm:7.4f} mm x{error:5.2f} {self.error_deg:7.4f} deg x{turn:5.2f}  NEES/6 {self.nees:6.2f}"
            f"  twist {self.twist_nees:6.2f}  inside {self.inside:.3f}  measured {self.measured:.3f}"
        )


def pool_errors(runs: Sequence[FollowResult]) -> PooledErrors:
    """The figures of `runs`, at least one of which was measured somewhere."""

    def all_of(values: Callable[[FollowResult], Array]) -> Array:
        return np.concatenate([values(run)[run.measured] for run in runs])

    errors, covariances = all_of(lambda run: run.errors), all_of(lambda run: run.covariances)
    bounds, filtered = all_of(lambda run: run.bounds), all_of(lambda run: run.filtered_bounds())
    twist_nees = np.concatenate(
        [nees(run.twist_errors[run.measured], run.twist_covariances[run.measured]) for run in runs]
    )
    claimed = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return PooledErrors(
        error_mm=_rms_length(errors[:, 3:]),
        error_deg=float(np.degrees(_rms_length(errors[:, :3]))),
        bound_mm=_rms_bound(bounds, 3),
        bound_deg=float(np.degrees(_rms_bound(bounds, 0))),
        filtered_mm=_rms_bound(filtered, 3),
        filtered_deg=float(np.degrees(_rms_bound(filtered, 0))),
        nees=float(nees(errors, covariances).mean() / 6),
        twist_nees=float(twist_nees.mean() / 6),
        inside=float(np.mean(np.abs(errors) <= NORMAL_95 * claimed)),
        measured=float(np.concatenate([run.measured for run in runs]).mean()),
    )


def nees(errors: Array, covariances: Array) -> Array:
    """Normalised estimation errors squared (N,) of errors (N, 6) under covariances (N, 6, 6)."""
    return np.asarray(np.einsum("ni,nij,nj->n", errors, np.linalg.pinv(covariances, hermitian=True), errors))


def _rms_length(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(1).mean()))


def _rms_bound(covariances: Array, first: int) -> float:
    """Root mean square length that covariances (N, 6, 6) stand for along three axes from `first` on."""
    return float(np.sqrt(np.trace(covariances[:, first : first + 3, first : first + 3], axis1=1, axis2=2).mean()))


MAP_NAMES: dict[Mapping, str] = {"told": "exact map", "seen": "own map"}


def run_estimator(options: argparse.Namespace) -> list[Figure]:
    """All figures of the scenes asked for, or those of the soak."""
    if options.soak is not None:
        return [f for mapping in options.maps for f in soak_figures(options.soak, mapping, MAP_NAMES[mapping])]
    figures: list[Figure] = []
    runs: dict[Mapping, list[FollowResult]] = {mapping: [] for mapping in options.maps}
    scenes = [scene for scene in TRACK_SCENES if fnmatch(scene.name, options.only)]
    if not scenes:
        names = "; ".join(scene.name for scene in TRACK_SCENES)
        raise InputError("command line", "--only", options.only, f"a pattern of {names}")
    for scene in scenes:
        worlds = [_world(scene, seed, options) for seed in range(options.seeds)]
        pnp = best_camera(worlds)
        for mapping in options.maps:
            followed = [follow(world, mapping, CpuClock().now) for world in worlds]
            found = pool_errors(followed)
            print(f"{scene.name + ', ' + MAP_NAMES[mapping]:<48}{found}", file=sys.stderr, flush=True)
            figures += scene_figures(scene, MAP_NAMES[mapping], found, pnp)
            figures += _offset_figures(scene, MAP_NAMES[mapping], followed)
            runs[mapping] += followed
    return figures + [f for mapping in options.maps for f in _work_figures(mapping, runs[mapping])]


def _world(scene: TrackScene, seed: int, options: argparse.Namespace) -> World:
    conditions = {"noise": options.noise, **scene.conditions}
    seconds = scene.seconds if options.seconds is None else options.seconds
    return synthetic_world(scene.movement, seconds, count=options.count, surface=scene.surface, seed=seed, **conditions)


def scene_figures(scene: TrackScene, of_map: str, found: PooledErrors, pnp: tuple[float, float]) -> list[Figure]:
    """The figures of one scene with one kind of map. pnp: RMSE by solvePnP with the exact one, mm and degrees."""
    name = f"{scene.name}, {of_map}"
    rigid = scene.rigid and scene.error is not None
    near = at_most(1.3) if scene.rigid else None
    moved = f"bound {found.bound_mm:.4f}, filtered {found.filtered_mm:.4f}, solvePnP {pnp[0]:.3f}"
    turned = f"bound {found.bound_deg:.4f}, filtered {found.filtered_deg:.4f}, solvePnP {pnp[1]:.3f}"
    return [
        Figure(f"{name}: error", found.error_mm, "mm", scene.error, moved),
        Figure(f"{name}: turn", found.error_deg, "deg", at_most(0.05) if rigid else None, turned),
        Figure(f"{name}: error by bound", found.error_mm / found.bound_mm, "", near),
        Figure(f"{name}: turn by bound", found.error_deg / found.bound_deg, "", near),
        Figure(f"{name}: NEES/6", found.nees, "", CONSISTENT_NEES),
        Figure(f"{name}: twist NEES/6", found.twist_nees, "", CONSISTENT_NEES),
        Figure(f"{name}: inside 95 %", found.inside, "", INSIDE_95),
    ]


def _offset_figures(scene: TrackScene, of_map: str, runs: Sequence[FollowResult]) -> list[Figure]:
    """How well the cameras' offsets are known at the end; what all clocks have in common cannot be seen."""
    if "offsets" not in scene.conditions:
        return []
    true = np.array(scene.conditions["offsets"])
    known = np.array([run.offsets - run.offsets.mean() for run in runs])
    off, note = (1000 * rms(known - true + true.mean()), "") if len(known) else (math.nan, "not estimated")
    return [Figure(f"{scene.name}, {of_map}: offsets off by", off, "ms", at_most(2.0), "thesis under 1 s", note)]


def _work_figures(mapping: Mapping, runs: Sequence[FollowResult]) -> list[Figure]:
    """Time over all runs, and whether a world run twice gives the same bits."""
    if not runs:
        return []
    spent, name = 1000 * np.concatenate([run.seconds for run in runs]), MAP_NAMES[mapping]
    return [
        Figure(
            f"time, {name}: median", percentile(spent, 50), "ms", None, "thesis 70 ms with flow", "CPU, tracks given"
        ),
        Figure(f"time, {name}: p99", percentile(spent, 99), "ms", at_most(4.0), "", "CPU, tracks given"),
        Figure(f"poses that differ run twice, {name}", float(_differing(mapping)), "", at_most(0), "open_vins #553"),
    ]


def _differing(mapping: Mapping) -> int:
    first, second = (follow(synthetic_world(seconds=3.0, offsets=(0.0, 0.01, 0.0)), mapping) for _ in range(2))
    return sum(
        a.base_from_surface.tobytes() + a.covariance.tobytes() + a.twist.tobytes()
        != b.base_from_surface.tobytes() + b.covariance.tobytes() + b.twist.tobytes()
        for a, b in zip(first.poses, second.poses, strict=True)
    )


LOOP_SETS = 40  # frame sets of a loop
CLAIM_SETTLED_SETS = 32  # frame sets after the first TRACKING pose: until then the widest claim is given out


@dataclass(frozen=True, slots=True, eq=False)
class SceneRun:
    """The measured poses of one scene after the first TRACKING one."""

    errors: Array  # (N, 6) rad and mm, surface frame
    covariances: Array  # (N, 6, 6) as reported
    late: NDArray[np.int64]  # (N,) frame sets since the first
    share: float  # that was measured


def run_consistency(options: argparse.Namespace) -> list[Figure]:
    """Figures over all scenes, and each scene's own."""
    seeds = range(options.seed, options.seed + options.scenes)
    runs = {f"scene {seed}": track_scene(seed, round(options.seconds * FPS)) for seed in seeds}
    figures = consistency_figures("all", list(runs.values()))
    each = [f for name, run in runs.items() for f in consistency_figures(name, [run]) if "NEES/6" in f.what]
    return figures + each if len(runs) > 1 else figures


def track_scene(seed: int, count: int) -> SceneRun:
    """What the tracking step makes of `count` frame sets of one scene."""
    rig, scene, loop = picture_loop(seed, LOOP_SETS)
    step = TrackingStep(rig, rois(scene, rig, loop.poses[0], 0.0))
    poses = []
    for number in range(count):
        stamp = number / FPS
        frames = [Frame(c, stamp, loop.noisy(image)) for c, image in enumerate(loop.images(number))]
        poses.append(step(FrameSet(stamp, tuple(frames))))
        step.idle()
    return scene_errors(poses, loop.poses[np.arange(count) % len(loop)])


def scene_errors(poses: list[SurfacePose], truth: Array) -> SceneRun:
    """Errors of poses against truth (N, 4, 4), base_from_surface, after the transform at the first TRACKING one."""
    first = next((i for i, p in enumerate(poses) if p.state is TrackState.TRACKING), len(poses))
    rows = np.array([i for i in range(first + 1, len(poses)) if poses[i].state.measured], np.int64)
    if not len(rows):
        return SceneRun(np.zeros((0, 6)), np.zeros((0, 6, 6)), rows, 0.0)
    constant = se3.inverse(truth[first]) @ poses[first].base_from_surface
    found = np.stack([poses[i].base_from_surface for i in rows])
    errors = se3.log(se3.inverse(found) @ truth[rows] @ constant)
    share = len(rows) / (len(poses) - first - 1)
    return SceneRun(errors, np.stack([poses[i].covariance for i in rows]), rows - first, share)


def consistency_figures(name: str, runs: list[SceneRun]) -> list[Figure]:
    """Of all poses but those of the first second, when the claim is still that of unknown cameras."""
    errors, covariances = (np.concatenate([getattr(r, n) for r in runs]) for n in ("errors", "covariances"))
    late = np.concatenate([run.late for run in runs])
    kept = late > CLAIM_SETTLED_SETS
    if not kept.any():
        return [Figure(f"{name}: NEES/6", math.nan, "", CONSISTENT_NEES, note="not followed for longer than a second")]
    squares = nees(errors, covariances) / 6
    errors, covariances = errors[kept], covariances[kept]
    inside = np.abs(errors) <= NORMAL_95 * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    claim = float(np.sqrt(np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2).mean() / 3))
    note = f"{len(errors)} poses; {squares[~kept].mean():.3f} in the first second" if (~kept).any() else ""
    return [
        Figure(f"{name}: NEES/6", float(squares[kept].mean()), "", CONSISTENT_NEES, "", note),
        Figure(f"{name}: NEES/6, largest", float(squares[kept].max()), "", None, "", "of one pose"),
        Figure(f"{name}: inside 95 %", float(inside.mean()), "", INSIDE_95, "", "of six axes"),
        Figure(f"{name}: error of an axis", 1000 * rms(errors[:, 3:]), "um"),
        Figure(f"{name}: claim of an axis", 1000 * claim, "um"),
        Figure(f"{name}: measured", 100 * float(np.mean([r.share for r in runs])), "%", at_least(99)),
    ]
