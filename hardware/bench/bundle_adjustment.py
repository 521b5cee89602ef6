"""The smoother's elimination beside Ceres, by pycolmap, on a problem that both can be given: a rig's bundle adjustment.

pycolmap has no motion prior and no clocks, so ours are taken away: what is left are the squared pixels of all landmarks
in all frame sets, cameras known, the first pose held (pycolmap's RigReprojErrorCost). Both begin at the same poses and
landmarks, on one core, and stop where a step lowers the cost by less than a millionth of a per cent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from estimation import se3
from estimation.batch.initialisation import begin
from estimation.batch.priors import States
from estimation.batch.smooth import FREE
from estimation.batch.solve import HELD, Equations, Estimate, Known, shared_step
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.smoothing.cameras import CalibrationPrior, cameras_of, prior_information, sigmas
from estimation.smoothing.measured import Noise, Problem
from estimation.smoothing.packed import Packed, packed
from estimation.synthetic.world import synthetic_world
from hardware.bench.figures import Figure, at_most
from hardware.process.clock import ProcessorClock

PLAIN = 1e4  # times the gate: no residual is that large, and all count by their squares
UNTIED = np.array([1e10] * 3 + [1e15] * 3)  # rad^2/s^5, mm^2/s^5: neighbouring poses know nothing of each other
EXACT = 1e-7, 1e-5  # s, px: exposures and images without a jitter
SETTLED, MOST = 1e-8, 50  # of the cost, and steps
MISSING = "pycolmap is not installed (the extra [bench]): not compared"


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """What a solver made of it. rms: px of all residuals. spent: s of one core. steps: how many it took."""

    rms: float
    spent: float
    steps: int


def ceres_figures(seconds: float, count: int) -> list[Figure]:
    """Cost and time of ours by Ceres's; where pycolmap is not installed, that it is not."""
    name = f"bundle adjustment, {seconds:g} s and {count} landmarks"
    try:
        import pycolmap
    except ImportError:
        missing = float("nan")
        return [
            Figure(f"{name}: {what}", missing, "", None, "", MISSING) for what in ("cost by Ceres's", "time by Ceres's")
        ]
    world = synthetic_world("breathing", seconds, count=count)
    data = packed(list(world), len(world.rig))
    poses, points = begin(world.rig, data, None, None)
    told = np.isfinite(points[:, 0])
    data, points = data.landmarks(told), points[told]
    own, theirs = adjusted(world.rig, data, poses, points), adjusted_by_ceres(pycolmap, world.rig, data, poses, points)
    costs = f"residuals of {own.rms:.6f} against {theirs.rms:.6f} px RMS"
    times = f"{own.spent:.2f} s in {own.steps} steps against {theirs.spent:.2f} s in {theirs.steps}, of one core"
    return [
        Figure(f"{name}: cost by Ceres's", (own.rms / theirs.rms) ** 2, "", at_most(1 + 1e-6), "", costs),
        Figure(f"{name}: time by Ceres's", own.spent / theirs.spent, "", None, "", times),
    ]


def adjusted(rig: Rig, data: Packed, poses: Array, points: Array) -> Adjusted:
    """By our own elimination."""
    clock = ProcessorClock()
    start = clock.now()
    cameras, rest = cameras_of(rig), np.zeros((len(poses), 6))
    none = sigmas(CalibrationPrior(clock=0.0), len(rig))
    known = Known(
        cameras,
        prior_information(none, len(rig)),
        points,
        np.eye(points.size) / FREE**2,
        poses[0],
        0,
        HELD,
        np.tile(UNTIED, (len(poses) - 1, 1)),
    )
    problem = Problem(data, np.zeros(0, np.int64))
    noise = Noise(np.ones(len(rig)), *EXACT, gate=PLAIN)
    estimate, costs = Estimate(States(poses, rest, rest), cameras, points), list[float]()
    while len(costs) < MOST:
        equations = Equations(problem, estimate, known, noise)
        whole = equations.whole(_silent)
        costs.append(whole.cost)
        if len(costs) > 1 and costs[-2] - costs[-1] < SETTLED * costs[-1]:
            break
        step = shared_step(whole)
        estimate = estimate.moved(equations.given(step, _silent).chain.steps(), step, problem.free)
    spent = clock.now() - start
    return Adjusted(residual_rms(rig, data, estimate.states.poses, estimate.points), spent, len(costs) - 1)


def adjusted_by_ceres(pycolmap: Any, rig: Rig, data: Packed, poses: Array, points: Array) -> Adjusted:
    """By pycolmap, whose world is the surface, whose rig stands in its first camera."""
    whole, first = pycolmap.Reconstruction(), rig.cameras[0].base_from_camera
    model = pycolmap.Rig(rig_id=1)
    for c, camera in enumerate(rig.cameras):
        m, (width, height) = camera.matrix, camera.size
        lens = [m[0, 0], m[1, 1], m[0, 2], m[1, 2]]
        made = pycolmap.Camera(camera_id=c + 1, model="PINHOLE", width=width, height=height, params=lens)
        whole.add_camera(made)
        if c == 0:
            model.add_ref_sensor(made.sensor_id)
        else:
            model.add_sensor(made.sensor_id, _rigid(pycolmap, se3.inverse(camera.base_from_camera) @ first))
    whole.add_rig(model)
    elements: list[list[Any]] = [[] for _ in points]
    for k, pose in enumerate(poses):
        _add_frame(pycolmap, whole, rig, data, k, se3.inverse(first) @ pose, elements)
    for place, track in zip(points, elements, strict=True):
        whole.add_point3D(place, pycolmap.Track(elements=track))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.refine_sensor_from_rig = False
    options.print_summary = False
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations, solver.function_tolerance = 1, MOST, SETTLED
    solver.gradient_tolerance = 0.0
    config = pycolmap.BundleAdjustmentConfig()
    for image in whole.images:
        config.add_image(image)
    config.set_constant_rig_from_world_pose(1)
    clock = ProcessorClock()
    start = clock.now()
    summary = pycolmap.create_default_ceres_bundle_adjuster(options, config, whole).solve()
    spent = clock.now() - start
    found = np.stack([first @ _matrix(whole.frame(k + 1).rig_from_world) for k in range(len(poses))])
    places = np.stack([whole.point3D(n + 1).xyz for n in range(len(points))])
    steps = summary.ceres_summary.num_successful_steps - 1  # the beginning counts as one
    return Adjusted(residual_rms(rig, data, found, places), spent, int(steps))


def _add_frame(
    pycolmap: Any, whole: Any, rig: Rig, data: Packed, k: int, camera_from_surface: Array, elements: list[list[Any]]
) -> None:
    """Frame set k with its images; what each landmark is seen in goes to its `elements`."""
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
    frame.rig_from_world = _rigid(pycolmap, camera_from_surface)
    whole.add_frame(frame)
    for image in images:
        whole.add_image(image)
    whole.register_frame(k + 1)


def residual_rms(rig: Rig, data: Packed, poses: Array, points: Array) -> float:
    """Px, of all residuals: the cost that both lower, by arithmetic of neither."""
    frame = np.repeat(np.arange(len(poses)), np.diff(data.starts))
    camera_from_base = se3.inverse(np.stack([camera.base_from_camera for camera in rig.cameras]))
    there = (camera_from_base[data.camera] @ poses[frame] @ _homogeneous(points[data.landmark])[..., None])[:, :3, 0]
    matrices = np.stack([camera.matrix for camera in rig.cameras])[data.camera]
    seen = (matrices @ (there / there[:, 2:])[..., None])[:, :2, 0]
    return float(np.sqrt(((seen - data.pixels) ** 2).mean()))


def _homogeneous(points: Array) -> Array:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def _rigid(pycolmap: Any, transform: Array) -> Any:
    return pycolmap.Rigid3d(np.ascontiguousarray(transform[:3]))


def _matrix(rigid: Any) -> Array:
    return np.concatenate([np.asarray(rigid.matrix(), float), [[0.0, 0.0, 0.0, 1.0]]])


def _silent(done: int, total: int) -> None:
    return None
