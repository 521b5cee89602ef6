"""Subjects `calibration` and `arm-calibration`: calibrations of known cameras and arms, beside the truth.

`calibration`: rendered boards before three cameras; and corners drawn without pictures.
`arm-calibration`: an arm moved before rendered cameras, and fifty on drawn tips.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.calibration.arm_fit import ArmFit, ArmUnknowns, fit_arm
from estimation.calibration.arm_model import ArmParameters, Kinematics, SetPoint, Sightings, first_pose, predict
from estimation.calibration.camera_rig import Calibration, calibrate
from estimation.calibration.lens_model import BoardViews, lens_of, matrix_of, project_lens
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from hardware.bench.figures import CONSISTENT_NEES, Figure, at_most, rms
from hardware.calibration.arm_record import MoveOptions, plan_moves
from hardware.calibration.arm_run import record_in_virtual_time
from hardware.calibration.arm_solve import ArmCalibration, kinematics_of, solve_folder
from hardware.calibration.report import held_out_residual, median_residual
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, no_progress
from hardware.simulator.scene.ground_truth_views import BoardView
from hardware.simulator.watched_arm import watched_arm
from perception.boards.board import Board
from perception.boards.corners import CornerFinder, CornerTable, empty_table, usable_views

BOARD = Board(squares=(8, 11), square=30.0)
PICTURE_SIZE = (1280, 720)
TRUE_LENSES = np.array(
    [
        [894.0, 896.0, 634.0, 361.0, -0.30, 0.10, 0.0, 0.0, 0.0],
        [980.0, 979.0, 647.0, 368.0, -0.08, 0.0, 0.0, 0.0, 0.0],
        [861.0, 861.5, 629.0, 353.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)
CAMERA_TURNS = (
    (0.0, 0.0, 0.0),
    (4.0, -30.0, 2.0),
    (-5.0, 35.0, -3.0),
)  # degrees about a point BOARD_DISTANCE before the first camera
BOARD_DISTANCE = 700.0  # mm
CAMERA_DELAYS = (-0.016, 0.004, 0.012)  # s
BOARD_RATE, BLUR_PX, GREY_NOISE = 10.0, 0.8, 1.5  # Hz; px; grey levels
CORNER_SIGMA = 0.15  # px, of the corners that are drawn without pictures
DRAWN_INSTANTS = 30  # instants of a run without pictures
# one sigma of p1, p2 and k3 of the worst lens drawn: as webcams were measured
LENS_BEND = np.array([0.003, 0.003, 0.1])
MIN_LENS_BEND = 0.01  # in parts of that, of the best one
NO_REFERENCE, CLAIMED = "none", "squared error, in parts of what is claimed"


@dataclass(frozen=True, slots=True)
class Sway:
    """A hand's slow motion: 6 axes times 3 sines."""

    sizes: Array  # (6, 3) rad and mm
    rates: Array  # (3,) Hz
    phases: Array  # (6, 3)

    def __call__(self, stamps: Array) -> Array:
        """base_from_board (N, 4, 4) at stamps (N,), s."""
        waves = np.sin(2 * np.pi * self.rates * stamps[:, None, None] + self.phases)
        way = (self.sizes * waves).sum(-1)
        turned = se3.make(se3.exp_rotation(way[:, :3]), np.array([0.0, 0.0, BOARD_DISTANCE]) + way[:, 3:])
        return np.asarray(turned @ se3.make(np.eye(3), -BOARD.corners.mean(0)))


def run_calibration(options: argparse.Namespace) -> list[Figure]:
    """Accuracy on rendered pictures, and whether the stated doubts are honest."""
    figures = list(_rendered(options.instants))
    if options.runs:
        nees = float(np.mean([_nees(seed) for seed in range(options.runs)]))
        what = f"{options.runs} runs on drawn corners of {CORNER_SIGMA:g} px, {DRAWN_INSTANTS} instants"
        note = f"{what}, lenses bent more or less"
        figures.append(Figure(CLAIMED, nees, "", CONSISTENT_NEES, NO_REFERENCE, note))
    return figures


def true_rig(lenses: Array = TRUE_LENSES) -> Rig:
    """Three cameras about the board, the first one the base; lenses: (3, 9)."""
    centre = np.array([0.0, 0.0, BOARD_DISTANCE])
    turns = se3.exp_rotation(np.radians(CAMERA_TURNS))
    places = se3.make(turns, centre - turns @ centre)
    cameras = zip("abc", lenses, places, CAMERA_DELAYS, strict=True)
    return Rig(
        tuple(Camera(n, PICTURE_SIZE, matrix_of(lens), lens[4:].copy(), p, late) for n, lens, p, late in cameras)
    )


def sway(seed: int, speed: float = 1.0) -> Sway:
    """A motion of its own for each seed; speed: times the usual."""
    rng = np.random.default_rng([seed, 61])
    rates = np.array([0.07, 0.17, 0.31])
    sizes = np.array([0.4, 0.45, 0.6, 130.0, 80.0, 110.0])[:, None] * rng.uniform(0.5, 1.0, (6, 3)) / (1 + 6 * rates)
    return Sway(sizes, rates * speed, rng.uniform(0, 2 * np.pi, (6, 3)))


def _rendered(instants: int) -> Iterator[Figure]:
    rig = true_rig()
    views, _ = usable_views(_looked_at(rig, instants), BOARD, tuple("abc"), (PICTURE_SIZE,) * 3)
    found = calibrate(views)
    error = errors(found, rig)
    pictures = f"{instants} frame sets at {BOARD_RATE:g} Hz, {BOARD}, blur {BLUR_PX:g} px, noise {GREY_NOISE:g}"
    note = f"{pictures}; largest of three cameras"
    focal = float(np.abs(error[:, 0] / [lens[0] for lens in TRUE_LENSES]).max())
    yield Figure("focal length", 100 * focal, "%", at_most(0.1), NO_REFERENCE, note)
    yield Figure("place", float(np.linalg.norm(error[:, 12:15], axis=1).max()), "mm", at_most(0.05))
    claimed = max(float(np.sqrt(np.trace(found.covariance_of(c)[12:15, 12:15]))) for c in range(len(rig)))
    yield Figure("place, as claimed", claimed, "mm")
    yield Figure("turn", float(np.degrees(np.linalg.norm(error[:, 9:12], axis=1).max())), "degrees", at_most(0.02))
    yield Figure("clock offset", 1e3 * float(np.abs(error[:, 15]).max()), "ms", at_most(1.0))
    points = found.working_volume()
    shape = rms(displaced(found.rig, rig, points))
    yield Figure("3D error in the working volume", shape, "mm", at_most(0.05), "", "RMS, shape only")
    yield Figure("3D error as predicted", found.predicted_error(points).typical, "mm")
    yield Figure("corner residual, median", median_residual(found), "px")
    yield Figure("and in stretches held out", held_out_residual(found), "px")
    yield Figure("squared error, rendered, in parts of what is claimed", consistency(found, error), "")


def _looked_at(rig: Rig, instants: int) -> CornerTable:
    """The corners that are found in rendered pictures."""
    rng, motion, finder = np.random.default_rng(62), sway(0), CornerFinder(BOARD)
    eyes = [BoardView(camera, BOARD) for camera in rig.cameras]
    rows = []
    for instant in range(instants):
        for c, camera in enumerate(rig.cameras):
            pose = motion(np.array([instant / BOARD_RATE + camera.clock_offset]))[0]
            found = finder(eyes[c].picture(pose, BLUR_PX, GREY_NOISE, rng))
            if found.count:
                rows.append((c, instant, instant / BOARD_RATE, found))
    cameras, instants_seen, stamps = (np.array([row[i] for row in rows]) for i in range(3))
    corners = [row[3] for row in rows]
    sigma, blur, marker = (np.array([getattr(c, name) for c in corners]) for name in ("sigma", "blur", "marker"))
    looked, strangers = np.full(len(rig), instants), empty_table(BOARD, len(rig)).strangers
    pixels = np.stack([c.pixels for c in corners])
    return CornerTable(cameras, instants_seen, stamps, pixels, sigma, blur, marker, looked, strangers, instants)


def errors(found: Calibration, rig: Rig) -> Array:
    """(C, 16) what the estimate lacks: lens, place in its own tangent space, offset."""
    out = []
    for camera, true in zip(found.rig.cameras, rig.cameras, strict=True):
        place = se3.log(se3.inverse(camera.base_from_camera) @ true.base_from_camera)
        offset = true.clock_offset - camera.clock_offset
        out.append(np.concatenate([lens_of(true) - lens_of(camera), place, [offset]]))
    return np.array(out)


def consistency(found: Calibration, error: Array) -> float:
    """Squared error by the stated covariance, per degree of freedom; the last offset follows from the others."""
    covariance = found.fit.covariance
    free = np.flatnonzero(np.diag(covariance) > 0)[:-1]
    e = error.ravel()[free]
    return float(e @ np.linalg.solve(covariance[np.ix_(free, free)], e)) / len(free)


def displaced(found: Rig, true: Rig, points: Array) -> Array:
    """Distances (N,), mm, of points from where the found rig sees them, after the best rigid motion of all."""
    seen = [pixels_from_points(camera, points)[0] for camera in true.cameras]
    at = points.copy()
    for _ in range(8):
        held, pull = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for camera, pixels in zip(found.cameras, seen, strict=True):
            camera_from_base = se3.inverse(camera.base_from_camera)
            there, _, by_point = project_lens(lens_of(camera), se3.transform_points(camera_from_base, at))
            by_point = by_point @ camera_from_base[:3, :3]
            held += np.swapaxes(by_point, 1, 2) @ by_point
            pull += np.einsum("npi,np->ni", by_point, there - pixels)
        at = at - np.linalg.solve(held, pull[..., None])[..., 0]
    carried = se3.transform_points(se3.rigid_from_points(points, at), points)
    return np.asarray(np.linalg.norm(at - carried, axis=1))


def _nees(seed: int) -> float:
    """Of one run whose corners are drawn about their true places, without pictures."""
    rng = np.random.default_rng([seed, 63])
    lenses = TRUE_LENSES.copy()
    lenses[:, 6:] = rng.normal(0, LENS_BEND, (3, 3)) * MIN_LENS_BEND ** rng.uniform(0, 1, (3, 1))
    rig = true_rig(lenses)
    camera, instant = np.tile(np.arange(3), DRAWN_INSTANTS), np.repeat(np.arange(DRAWN_INSTANTS), 3)
    boards = sway(seed, 2.0)(instant / BOARD_RATE + np.array(CAMERA_DELAYS)[camera])
    corners = BOARD.corners.reshape(10, 7, 3)[::3, ::3].reshape(-1, 3)
    poses = zip(camera, boards, strict=True)
    pixels = np.stack([pixels_from_points(rig.cameras[c], se3.transform_points(b, corners))[0] for c, b in poses])
    pixels += rng.normal(0, CORNER_SIGMA, pixels.shape)
    pixels[((pixels < 2) | (pixels > np.array(PICTURE_SIZE) - 3)).any(-1)] = np.nan
    stamps, sigma = instant / BOARD_RATE, np.full(len(camera), CORNER_SIGMA)
    views = BoardViews(tuple("abc"), (PICTURE_SIZE,) * 3, corners, camera, instant, stamps, pixels, sigma)
    found = calibrate(views.only(views.seen.sum(1) >= 6))
    return consistency(found, errors(found, rig))


REST_AFTER = 0.25  # s after which an arm rests


def set_point_of(targets: Array, tick: float, begin: float = 0.0) -> SetPoint:
    """Where targets (K, 6), a tick apart, send an arm that stands at the first of them at `begin`, s."""
    return SetPoint(begin + tick * np.arange(len(targets), dtype=np.float64), np.ascontiguousarray(targets, float))


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
    """The tip in every camera each `period` s. noise: px, one sigma. outliers: share that is anywhere near it."""
    stamps = np.arange(set_point.instants[0] + period, set_point.instants[-1], period)
    camera = np.repeat(np.arange(len(rig)), len(stamps))
    stamp = np.tile(stamps, len(rig)) + 0.003 * camera
    pixels = predict(state, set_point, kinematics, rig, stamp, camera).pixels
    pixels = pixels + noise * rng.normal(size=pixels.shape)
    astray = rng.random(len(stamp)) < outliers
    pixels[astray] += 40 * rng.normal(size=(int(astray.sum()), 2))
    sigma = np.full(len(stamp), max(noise, 1e-3))
    return Sightings(stamp, camera, pixels, sigma, set_point.places(stamp, REST_AFTER))


TIP_PERIOD, TIP_NOISE_PX, TIP_OUTLIERS = 0.1, 0.3, 0.05  # s, px and share, of drawn tips
NEEDLE_RADIUS = 0.3  # mm, radius of the drawn needle's end


def run_arm_calibration(options: argparse.Namespace) -> list[Figure]:
    """Errors on rendered pictures, and whether the stated doubts are honest."""
    figures: list[Figure] = []
    for number in range(options.rendered):
        figures += _rendered_arm(options.seed + number)
    if options.runs:
        rows = np.array([_drawn(options.seed + number) for number in range(options.runs)])
        note = f"{options.runs} arms on drawn tips, {TIP_NOISE_PX:g} px, {100 * TIP_OUTLIERS:g} % of them astray"
        nees = rows[:, 0].mean()
        figures.append(Figure(CLAIMED, nees, "", CONSISTENT_NEES, NO_REFERENCE, note))
        for column, (what, unit) in enumerate((("tip", "mm"), ("dead time", "ms"), ("lag", "ms")), 1):
            figures.append(Figure(f"{what}, drawn tips, RMS", rms(rows[:, column]), unit))
    return figures


def _rendered_arm(seed: int) -> Iterator[Figure]:
    watched = watched_arm(seed)
    with tempfile.TemporaryDirectory() as place, Progress("pictures", "frame sets", WallClock().now) as progress:
        truth = record_in_virtual_time(watched, Path(place), MoveOptions(), no_progress, progress)
        found = solve_folder(Path(place), None, ArmUnknowns(), no_progress)
    note = f"arm {seed}, {len(found.tips.sightings)} tips of {int(found.tips.looked.sum())} rendered pictures"
    true = ArmParameters(truth.base_from_arm, truth.tool, truth.late, truth.lag, found.fit.state.blunt)
    off = error_of(found.fit, true)
    base = float(np.linalg.norm(_at_places(found, true)))
    where = "base_from_camera in the arm's frame, in the middle of the places"
    yield Figure(f"{where}, arm {seed}", base, "mm", at_most(0.05), NO_REFERENCE, note)
    turn = float(np.degrees(np.linalg.norm(off[:3])))
    yield Figure(f"base_from_camera in the arm's frame, arm {seed}", turn, "degrees", at_most(0.02))
    yield Figure(f"tip where it is thought to be, arm {seed}", _tip(found, true), "mm", at_most(0.1))
    yield Figure(f"dead time, arm {seed}", 1e3 * abs(float(off[9])), "ms", at_most(1.0))
    yield Figure(f"servo's lag, arm {seed}", 1e3 * abs(float(off[10])), "ms", at_most(3.0))
    yield Figure(f"held-out tips, median, arm {seed}", float(np.nanmedian(found.held_px)), "px")
    parts = _parts(off[:11], found.fit.covariance[:11, :11])  # the needle's own end is none that the truth names
    yield Figure(f"{CLAIMED}, arm {seed}", parts)
    yield Figure(f"likewise, before the claim is widened, arm {seed}", parts * found.fit.widened_by)


def error_of(fit: ArmFit, true: ArmParameters) -> Array:
    """What a fit is off by (12,), in the order of its covariance."""
    state = fit.state
    pose = se3.log(se3.inverse(true.base_from_arm) @ state.base_from_arm)
    rest = [state.dead_time - true.dead_time, state.lag - true.lag, state.blunt - true.blunt]
    return np.concatenate([pose, np.asarray(state.tool) - true.tool, rest])


def _parts(off: Array, covariance: Array) -> float:
    """Squared error in parts of what a covariance claims, per number."""
    return float(off @ np.linalg.solve(covariance, off)) / len(off)


def _at_places(found: ArmCalibration, true: ArmParameters) -> Array:
    """How far (3,), mm, base_from_arm moves the middle of the places from where it is."""
    middle = found.places.mean(0)
    change = found.fit.state.base_from_arm @ se3.inverse(true.base_from_arm)
    return np.asarray(se3.transform_points(change, middle[None])[0] - middle)


def _tip(found: ArmCalibration, true: ArmParameters) -> float:
    """How far, mm RMS, the tip is from where it is thought to be at the resting places."""
    s, state = found.tips.sightings, found.fit.state
    axes = found.set_point.lagged(s.stamp[s.place >= 0], 0.0, 0.0)
    poses = kinematics_of(found.profile.arm)(axes)
    return _tip_rms(state, true, poses)


def _tip_rms(state: ArmParameters, true: ArmParameters, poses: Array) -> float:
    """Distance, mm RMS, of the tips at `poses` (N, 4, 4), arm_from_nozzle."""
    a, b = (se3.transform_points(x.base_from_arm @ poses, np.asarray(x.tool)[None])[:, 0] for x in (state, true))
    return float(np.sqrt(np.mean(((a - b) ** 2).sum(1))))


def _drawn(seed: int) -> tuple[float, float, float, float]:
    """Squared error in parts of what is claimed, and errors of the tip, mm, dead time and lag, ms, of one arm."""
    watched, rng = watched_arm(seed), np.random.default_rng([seed, 97])
    kinematics, told = kinematics_of(watched.profile.arm), watched.profile
    set_point = set_point_of(plan_moves(watched.begin, told.limits, told.tick, MoveOptions()), told.tick)
    settings, tool = watched.settings, watched.true.tool_offset
    base_from_arm = se3.inverse(watched.true.arm_from_base)
    true = ArmParameters(base_from_arm, tool, settings.dead_time, settings.servo_lag, NEEDLE_RADIUS)
    seen = sightings_of(true, set_point, kinematics, watched.rig, TIP_PERIOD, TIP_NOISE_PX, TIP_OUTLIERS, rng)
    pose, axes, _ = first_pose(seen, set_point, kinematics, watched.rig)
    fit = fit_arm(seen, set_point, kinematics, watched.rig, ArmParameters(pose, np.zeros(3), 0.01, 0.01, 0.5))
    off, poses = error_of(fit, true), kinematics(axes)
    nees = _parts(off, fit.covariance)
    return nees, _tip_rms(fit.state, true, poses), 1e3 * float(off[9]), 1e3 * float(off[10])
