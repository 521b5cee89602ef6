"""Subjects `calibration` and `arm-calibration`: calibrations of known cameras and arms, compared with the truth.

`calibration`: rendered boards before three cameras; and corners drawn without pictures.
`arm-calibration`: an arm moved before rendered cameras, and fifty on drawn tips.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.calibration.arm_fit import ArmFit, ArmUnknowns, fit_arm
from estimation.calibration.arm_model import ArmParameters, Kinematics, SetPoint, Sightings, first_pose, predict
from estimation.calibration.camera_rig import Calibration, calibrate
from estimation.calibration.lens_model import (
    BoardViews,
    Implausible,
    Undetermined,
    lens_matrix,
    lens_parameters,
    project_lens,
)
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from hardware.bench.figures import CONSISTENT_NEES, Figure, at_most, relative_nees, rms
from hardware.calibration.arm_record import MoveOptions, plan_moves
from hardware.calibration.arm_run import record_in_virtual_time
from hardware.calibration.arm_solve import kinematics_of, solve_folder
from hardware.calibration.report import median_residual
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, no_progress
from hardware.simulator.scene.render import BoardView
from hardware.simulator.watched_arm import watched_arm
from perception.boards.board import Board, CornerFinder, CornerTable, empty_table, usable_views

BOARD = Board(squares=(8, 11), square=30.0)
PICTURE_SIZE = (1280, 720)
LENS_1 = [894.0, 896.0, 634.0, 361.0, -0.30, 0.10, 0.0, 0.0, 0.0]  # of the three true cameras
LENS_2 = [980.0, 979.0, 647.0, 368.0, -0.08, 0.0, 0.0, 0.0, 0.0]
LENS_3 = [861.0, 861.5, 629.0, 353.0, 0.0, 0.0, 0.0, 0.0, 0.0]
TRUE_LENSES = np.array([LENS_1, LENS_2, LENS_3])
BOARD_DISTANCE = 700.0  # mm
CAMERA_TURNS = (0.0, 0.0, 0.0), (4.0, -30.0, 2.0), (-5.0, 35.0, -3.0)  # degrees about a point at that distance
CAMERA_DELAYS = (-0.016, 0.004, 0.012)  # s
BOARD_RATE, BLUR_PX, GREY_NOISE = 10.0, 0.8, 1.5  # Hz; px; grey levels
CORNER_SIGMA = 0.15  # px, of the corners that are drawn without pictures
DRAWN_INSTANTS = 30  # of a run without pictures
LENS_SIGMA = np.array([0.003, 0.003, 0.1])  # of p1, p2 and k3 of the worst lens drawn: as webcams were measured
MIN_LENS_FACTOR = 0.01  # on LENS_SIGMA, of the best lens drawn
NO_REFERENCE, ERROR_BY_COVARIANCE = "none", "squared error, in parts of what is claimed"


def run_calibration(options: argparse.Namespace) -> list[Figure]:
    """Accuracy on rendered pictures, and whether the stated covariance is consistent."""
    figures = list(_rendered(options.instants))
    if options.runs:
        nees = float(np.mean([_nees(seed) for seed in range(options.runs)]))
        what = f"{options.runs} runs on drawn corners of {CORNER_SIGMA:g} px, {DRAWN_INSTANTS} instants"
        note = f"{what}, lenses bent more or less"
        figures.append(Figure(ERROR_BY_COVARIANCE, nees, "", CONSISTENT_NEES, NO_REFERENCE, note))
    return figures


def true_rig(lenses: Array = TRUE_LENSES) -> Rig:
    """Three cameras about the board, the first one the base; lenses: (3, 9)."""
    centre = np.array([0.0, 0.0, BOARD_DISTANCE])
    rotations = se3.exp_rotation(np.radians(CAMERA_TURNS))
    places = se3.make(rotations, centre - rotations @ centre)
    cameras = zip("abc", lenses, places, CAMERA_DELAYS, strict=True)
    return Rig(tuple(Camera(n, PICTURE_SIZE, lens_matrix(k), k[4:].copy(), place, s) for n, k, place, s in cameras))


def swaying_board(seed: int, speed: float = 1.0) -> Callable[[Array], Array]:
    """base_from_board (N, 4, 4) at stamps (N,), s, in a hand: three sines an axis. speed: times the usual."""
    rng = np.random.default_rng([seed, 61])
    rates = np.array([0.07, 0.17, 0.31])  # Hz
    sizes = np.array([0.4, 0.45, 0.6, 130.0, 80.0, 110.0])[:, None] * rng.uniform(0.5, 1.0, (6, 3)) / (1 + 6 * rates)
    rates, phases = rates * speed, rng.uniform(0, 2 * np.pi, (6, 3))

    def motion(stamps: Array) -> Array:
        displacement = (sizes * np.sin(2 * np.pi * rates * stamps[:, None, None] + phases)).sum(-1)  # (N, 6) rad and mm
        poses = se3.make(
            se3.exp_rotation(displacement[:, :3]), np.array([0.0, 0.0, BOARD_DISTANCE]) + displacement[:, 3:]
        )
        return np.asarray(poses @ se3.make(np.eye(3), -BOARD.corners.mean(0)))

    return motion


RENDERED_FIGURES = (  # of rendered boards: what, unit, target, note
    ("focal length", "%", at_most(0.1), "largest of three cameras"),
    ("place", "mm", at_most(0.05), ""),
    ("place, as claimed", "mm", None, ""),
    ("turn", "degrees", at_most(0.02), ""),
    ("clock offset", "ms", at_most(1.0), ""),
    ("3D error in the working volume", "mm", at_most(0.05), "RMS, shape only"),
    ("3D error as predicted", "mm", None, ""),
    ("corner residual, median", "px", None, ""),
    ("and in stretches held out", "px", None, ""),
    ("squared error, rendered, in parts of what is claimed", "", None, ""),
)


def _rendered(instants: int) -> Iterator[Figure]:
    """The figures of rendered boards; NaN, with the reason, where they show too little to calibrate from."""
    rig, missing = true_rig(), ""
    try:
        values = _rendered_values(rig, instants)
    except (Undetermined, Implausible) as error:
        values, missing = [float("nan")] * len(RENDERED_FIGURES), str(error)
    pictures = f"{instants} frame sets at {BOARD_RATE:g} Hz, {BOARD}, blur {BLUR_PX:g} px, noise {GREY_NOISE:g}"
    for number, (value, (what, unit, target, note)) in enumerate(zip(values, RENDERED_FIGURES, strict=True)):
        note_text = note if number else f"{pictures}; {note}"
        if missing:
            note_text = "not measured" if number else f"not measured: {missing}"
        yield Figure(what, value, unit, target, "" if number else NO_REFERENCE, note_text)


def _rendered_values(rig: Rig, instants: int) -> list[float]:
    """The values of RENDERED_FIGURES."""
    views, _ = usable_views(_corner_table(rig, instants), BOARD, tuple("abc"), (PICTURE_SIZE,) * 3)
    calibration = calibrate(views)
    error, points = _errors(calibration, rig), calibration.working_volume()
    covariances = (calibration.covariance_of(c)[12:15, 12:15] for c in range(len(rig)))
    return [
        100 * float(np.abs(error[:, 0] / TRUE_LENSES[:, 0]).max()),
        float(np.linalg.norm(error[:, 12:15], axis=1).max()),
        max(float(np.sqrt(np.trace(covariance))) for covariance in covariances),
        float(np.degrees(np.linalg.norm(error[:, 9:12], axis=1).max())),
        1e3 * float(np.abs(error[:, 15]).max()),
        rms(_triangulation_errors(calibration.rig, rig, points)),
        calibration.predicted_error(points).typical,
        median_residual(calibration),
        median_residual(calibration, held_out=True),
        _camera_nees(calibration, error),
    ]


def _corner_table(rig: Rig, instants: int) -> CornerTable:
    """The corners detected in rendered pictures."""
    rng, motion, finder = np.random.default_rng(62), swaying_board(0), CornerFinder(BOARD)
    renderers = [BoardView(camera, BOARD) for camera in rig.cameras]
    rows, detected = [], []
    for instant in range(instants):
        for c, camera in enumerate(rig.cameras):
            pose = motion(np.array([instant / BOARD_RATE + camera.clock_offset]))[0]
            corners = finder(renderers[c].picture(pose, BLUR_PX, GREY_NOISE, rng))
            if corners.count:
                rows.append((c, instant, instant / BOARD_RATE))
                detected.append(corners)
    cameras, numbers, stamps = (np.array(column) for column in zip(*rows, strict=True))
    sigma, blur, marker = (np.array([getattr(c, name) for c in detected]) for name in ("sigma", "blur", "marker"))
    picture_counts, strangers = np.full(len(rig), instants), empty_table(BOARD, len(rig)).strangers
    pixels = np.stack([c.pixels for c in detected])
    return CornerTable(cameras, numbers, stamps, pixels, sigma, blur, marker, picture_counts, strangers, instants)


def _errors(calibration: Calibration, rig: Rig) -> Array:
    """(C, 16) true less estimated: lens, place in the estimate's tangent space, offset."""
    errors = []
    for camera, true in zip(calibration.rig.cameras, rig.cameras, strict=True):
        place = se3.log(se3.inverse(camera.base_from_camera) @ true.base_from_camera)
        offset = true.clock_offset - camera.clock_offset
        errors.append(np.concatenate([lens_parameters(true) - lens_parameters(camera), place, [offset]]))
    return np.array(errors)


def _camera_nees(calibration: Calibration, error: Array) -> float:
    """Squared error by the stated covariance, per degree of freedom; the last offset follows from the others."""
    covariance = calibration.fit.covariance
    free = np.flatnonzero(np.diag(covariance) > 0)[:-1]
    return relative_nees(error.ravel()[free], covariance[np.ix_(free, free)])


def _triangulation_errors(rig: Rig, true: Rig, points: Array) -> Array:
    """Distances (N,), mm, of points from where a rig triangulates them, after the best rigid motion of all."""
    pixels = [pixels_from_points(camera, points)[0] for camera in true.cameras]
    estimated = points.copy()
    for _ in range(8):  # Gauss-Newton
        normal, gradient = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for camera, measured in zip(rig.cameras, pixels, strict=True):
            camera_from_base = se3.inverse(camera.base_from_camera)
            projected, _, by_point = project_lens(
                lens_parameters(camera), se3.transform_points(camera_from_base, estimated)
            )
            by_point = by_point @ camera_from_base[:3, :3]
            normal += np.swapaxes(by_point, 1, 2) @ by_point
            gradient += np.einsum("npi,np->ni", by_point, projected - measured)
        estimated = estimated - np.linalg.solve(normal, gradient[..., None])[..., 0]
    moved = se3.transform_points(se3.rigid_from_points(points, estimated), points)
    return np.asarray(np.linalg.norm(estimated - moved, axis=1))


def _nees(seed: int) -> float:
    """Of one run whose corners are drawn about their true places, without pictures."""
    rng = np.random.default_rng([seed, 63])
    lenses = TRUE_LENSES.copy()
    lenses[:, 6:] = rng.normal(0, LENS_SIGMA, (3, 3)) * MIN_LENS_FACTOR ** rng.uniform(0, 1, (3, 1))
    rig = true_rig(lenses)
    camera, instant = np.tile(np.arange(3), DRAWN_INSTANTS), np.repeat(np.arange(DRAWN_INSTANTS), 3)
    boards = swaying_board(seed, 2.0)(instant / BOARD_RATE + np.array(CAMERA_DELAYS)[camera])
    corners = BOARD.corners.reshape(10, 7, 3)[::3, ::3].reshape(-1, 3)
    poses = zip(camera, boards, strict=True)
    pixels = np.stack([pixels_from_points(rig.cameras[c], se3.transform_points(b, corners))[0] for c, b in poses])
    pixels += rng.normal(0, CORNER_SIGMA, pixels.shape)
    pixels[((pixels < 2) | (pixels > np.array(PICTURE_SIZE) - 3)).any(-1)] = np.nan
    stamps, sigma = instant / BOARD_RATE, np.full(len(camera), CORNER_SIGMA)
    views = BoardViews(tuple("abc"), (PICTURE_SIZE,) * 3, corners, camera, instant, stamps, pixels, sigma)
    calibration = calibrate(views.select(views.seen.sum(1) >= 6))
    return _camera_nees(calibration, _errors(calibration, rig))


REST_AFTER = 0.25  # s after which an arm rests


def set_point_of(targets: Array, tick: float) -> SetPoint:
    """Where targets (K, 6), a tick apart, send an arm that stands at the first of them at 0 s."""
    return SetPoint(tick * np.arange(len(targets), dtype=np.float64), np.ascontiguousarray(targets, float))


def sightings_of(
    state: ArmParameters,
    set_point: SetPoint,
    kinematics: Kinematics,
    rig: Rig,
    period: float,
    noise: float,
    outliers: float,
    rng: np.random.Generator,
) -> Sightings:
    """The tip in every camera each `period` s. noise: px, one sigma. outliers: share that is 40 px off, one sigma."""
    stamps = np.arange(set_point.instants[0] + period, set_point.instants[-1], period)
    camera = np.repeat(np.arange(len(rig)), len(stamps))
    stamp = np.tile(stamps, len(rig)) + 0.003 * camera
    pixels = predict(state, set_point, kinematics, rig, stamp, camera).pixels
    pixels = pixels + noise * rng.normal(size=pixels.shape)
    outlier = rng.random(len(stamp)) < outliers
    pixels[outlier] += 40 * rng.normal(size=(int(outlier.sum()), 2))
    sigma = np.full(len(stamp), max(noise, 1e-3))
    return Sightings(stamp, camera, pixels, sigma, set_point.places(stamp, REST_AFTER))


TIP_PERIOD, TIP_NOISE_PX, TIP_OUTLIERS = 0.1, 0.3, 0.05  # s, px and share, of drawn tips
NEEDLE_RADIUS = 0.3  # mm, radius of the drawn needle's end


def run_arm_calibration(options: argparse.Namespace) -> list[Figure]:
    """Errors on rendered pictures, and whether the stated covariance is consistent."""
    figures = [figure for number in range(options.rendered) for figure in _rendered_arm(options.seed + number)]
    if options.runs:
        nees, *errors = np.array([_drawn_arm(options.seed + number) for number in range(options.runs)]).T.copy()
        note = f"{options.runs} arms on drawn tips, {TIP_NOISE_PX:g} px, {100 * TIP_OUTLIERS:g} % of them astray"
        figures.append(Figure(ERROR_BY_COVARIANCE, nees.mean(), "", CONSISTENT_NEES, NO_REFERENCE, note))
        for error, what, unit in zip(errors, ("tip", "dead time", "lag"), ("mm", "ms", "ms"), strict=True):
            figures.append(Figure(f"{what}, drawn tips, RMS", rms(error), unit))
    return figures


def _rendered_arm(seed: int) -> Iterator[Figure]:
    watched = watched_arm(seed)
    with tempfile.TemporaryDirectory() as place, Progress("pictures", "frame sets", WallClock().now) as progress:
        truth = record_in_virtual_time(watched, Path(place), MoveOptions(), no_progress, progress)
        solution = solve_folder(Path(place), None, ArmUnknowns(), no_progress)
    fit, tips = solution.fit, solution.tips
    note = f"arm {seed}, {len(tips.sightings)} tips of {int(tips.looked.sum())} rendered pictures"
    true = ArmParameters(truth.base_from_arm, truth.tool, truth.late, truth.lag, fit.state.blunt)
    error = _arm_errors(fit, true)
    middle = solution.places.mean(0)
    change = fit.state.base_from_arm @ se3.inverse(true.base_from_arm)
    shift = float(np.linalg.norm(np.asarray(se3.transform_points(change, middle[None])[0] - middle)))
    frame_text = "base_from_camera in the arm's frame, in the middle of the places"
    yield Figure(f"{frame_text}, arm {seed}", shift, "mm", at_most(0.05), NO_REFERENCE, note)
    rotation_error = float(np.degrees(np.linalg.norm(error[:3])))
    yield Figure(f"base_from_camera in the arm's frame, arm {seed}", rotation_error, "degrees", at_most(0.02))
    at_rest = tips.sightings.stamp[tips.sightings.place >= 0]
    poses = kinematics_of(solution.profile.arm)(solution.set_point.lagged(at_rest, 0.0, 0.0))
    tip = _tip_error(fit.state, true, poses)
    yield Figure(f"tip where it is thought to be, arm {seed}", tip, "mm", at_most(0.1))
    yield Figure(f"dead time, arm {seed}", 1e3 * abs(float(error[9])), "ms", at_most(1.0))
    yield Figure(f"servo's lag, arm {seed}", 1e3 * abs(float(error[10])), "ms", at_most(3.0))
    yield Figure(f"held-out tips, median, arm {seed}", float(np.nanmedian(solution.held_px)), "px")
    nees = relative_nees(error[:11], fit.covariance[:11, :11])  # the truth does not state the needle's radius
    yield Figure(f"{ERROR_BY_COVARIANCE}, arm {seed}", nees)
    yield Figure(f"likewise, before the claim is widened, arm {seed}", nees * fit.widened_by)


def _arm_errors(fit: ArmFit, true: ArmParameters) -> Array:
    """Estimated less true (12,), in the order of the fit's covariance."""
    state = fit.state
    pose = se3.log(se3.inverse(true.base_from_arm) @ state.base_from_arm)
    rest = [state.dead_time - true.dead_time, state.lag - true.lag, state.blunt - true.blunt]
    return np.concatenate([pose, np.asarray(state.tool) - true.tool, rest])


def _tip_error(state: ArmParameters, true: ArmParameters, poses: Array) -> float:
    """Distance, mm RMS, of the tips at `poses` (N, 4, 4), arm_from_nozzle."""
    a, b = (se3.transform_points(x.base_from_arm @ poses, np.asarray(x.tool)[None])[:, 0] for x in (state, true))
    return float(np.sqrt(np.mean(((a - b) ** 2).sum(1))))


def _drawn_arm(seed: int) -> tuple[float, float, float, float]:
    """Squared error relative to the covariance, and errors of the tip, mm, dead time and lag, ms, of one arm."""
    watched, rng = watched_arm(seed), np.random.default_rng([seed, 97])
    profile, settings = watched.profile, watched.settings
    kinematics = kinematics_of(profile.arm)
    set_point = set_point_of(plan_moves(watched.begin, profile.limits, profile.tick, MoveOptions()), profile.tick)
    base_from_arm, tool = se3.inverse(watched.true.arm_from_base), watched.true.tool_offset
    true = ArmParameters(base_from_arm, tool, settings.dead_time, settings.servo_lag, NEEDLE_RADIUS)
    tips = sightings_of(true, set_point, kinematics, watched.rig, TIP_PERIOD, TIP_NOISE_PX, TIP_OUTLIERS, rng)
    pose, axes, _ = first_pose(tips, set_point, kinematics, watched.rig)
    fit = fit_arm(tips, set_point, kinematics, watched.rig, ArmParameters(pose, np.zeros(3), 0.01, 0.01, 0.5))
    error = _arm_errors(fit, true)
    tip = _tip_error(fit.state, true, kinematics(axes))
    return relative_nees(error, fit.covariance), tip, 1e3 * float(error[9]), 1e3 * float(error[10])
