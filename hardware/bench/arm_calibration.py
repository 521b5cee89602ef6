"""`stillbed bench arm-calibration`: an arm moved before rendered cameras, and fifty on drawn tips, beside the truth."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.arm_calibration.synthetic import set_point_of, sightings_of
from estimation.calibration.arm_fit import ArmFit, Asked, fit_arm
from estimation.calibration.arm_model import ArmState
from estimation.calibration.arm_start import first_pose
from estimation.se3 import Array
from hardware.arm_calibration.moves import MoveWishes, planned
from hardware.arm_calibration.virtual import record_in_virtual_time
from hardware.bench.figures import Figure, Target, at_most
from hardware.calibration.arm_solve import ArmCalibration, kinematics_of, solve_folder
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, silent
from hardware.simulator.watched_arm import watched_arm

PERIOD, NOISE, OUTLIERS = 0.1, 0.3, 0.05  # s, px and share, of drawn tips
END = 0.3  # mm, radius of the drawn needle's end
REFERENCE = "none"


def run(options: argparse.Namespace) -> list[Figure]:
    """Errors on rendered pictures, and whether the stated doubts are honest."""
    figures: list[Figure] = []
    for number in range(options.rendered):
        figures += _rendered(options.seed + number)
    if options.runs:
        rows = np.array([_drawn(options.seed + number) for number in range(options.runs)])
        note = f"{options.runs} arms on drawn tips, {NOISE:g} px, {100 * OUTLIERS:g} % of them astray"
        nees = Target(0.8, 1.25)
        figures.append(
            Figure("squared error, in parts of what is claimed", rows[:, 0].mean(), "", nees, REFERENCE, note)
        )
        for column, (what, unit) in enumerate((("tip", "mm"), ("dead time", "ms"), ("lag", "ms")), 1):
            figures.append(Figure(f"{what}, drawn tips, RMS", float(np.sqrt(np.mean(rows[:, column] ** 2))), unit))
    return figures


def _rendered(seed: int) -> Iterator[Figure]:
    watched = watched_arm(seed)
    with tempfile.TemporaryDirectory() as place, Progress("pictures", "frame sets", WallClock().now) as progress:
        truth = record_in_virtual_time(watched, Path(place), MoveWishes(), silent, progress)
        found = solve_folder(Path(place), None, Asked(), silent)
    note = f"arm {seed}, {len(found.look.sightings)} tips of {int(found.look.looked.sum())} rendered pictures"
    true = ArmState(truth.base_from_arm, truth.tool, truth.late, truth.lag, found.fit.state.blunt)
    off = error_of(found.fit, true)
    base = float(np.linalg.norm(_at_places(found, true)))
    where = "base_from_camera in the arm's frame, in the middle of the places"
    yield Figure(f"{where}, arm {seed}", base, "mm", at_most(0.05), REFERENCE, note)
    turn = float(np.degrees(np.linalg.norm(off[:3])))
    yield Figure(f"base_from_camera in the arm's frame, arm {seed}", turn, "degrees", at_most(0.02))
    yield Figure(f"tip where it is thought to be, arm {seed}", _tip(found, true), "mm", at_most(0.1))
    yield Figure(f"dead time, arm {seed}", 1e3 * abs(float(off[9])), "ms", at_most(1.0))
    yield Figure(f"servo's lag, arm {seed}", 1e3 * abs(float(off[10])), "ms", at_most(3.0))
    yield Figure(f"held-out tips, median, arm {seed}", float(np.nanmedian(found.held_px)), "px")
    parts = _parts(off[:11], found.fit.covariance[:11, :11])  # the needle's own end is none that the truth names
    yield Figure(f"squared error, in parts of what is claimed, arm {seed}", parts)
    yield Figure(f"likewise, before the claim is widened, arm {seed}", parts * found.fit.widened_by)


def error_of(fit: ArmFit, true: ArmState) -> Array:
    """What a fit is off by (12,), in the order of its covariance."""
    state = fit.state
    pose = se3.log(se3.inverse(true.base_from_arm) @ state.base_from_arm)
    rest = [state.dead_time - true.dead_time, state.lag - true.lag, state.blunt - true.blunt]
    return np.concatenate([pose, np.asarray(state.tool) - true.tool, rest])


def _parts(off: Array, covariance: Array) -> float:
    """Squared error in parts of what a covariance claims, per number."""
    return float(off @ np.linalg.solve(covariance, off)) / len(off)


def _at_places(found: ArmCalibration, true: ArmState) -> Array:
    """How far (3,), mm, base_from_arm moves the middle of the places from where it is."""
    middle = found.places.mean(0)
    change = found.fit.state.base_from_arm @ se3.inverse(true.base_from_arm)
    return np.asarray(se3.transform_points(change, middle[None])[0] - middle)


def _tip(found: ArmCalibration, true: ArmState) -> float:
    """How far, mm RMS, the tip is from where it is thought to be at the resting places."""
    s, state = found.look.sightings, found.fit.state
    axes = found.set_point.lagged(s.stamp[s.place >= 0], 0.0, 0.0)
    poses = kinematics_of(found.profile.arm)(axes)
    a, b = (se3.transform_points(x.base_from_arm @ poses, np.asarray(x.tool)[None])[:, 0] for x in (state, true))
    return float(np.sqrt(np.mean(((a - b) ** 2).sum(1))))


def _drawn(seed: int) -> tuple[float, float, float, float]:
    """Squared error in parts of what is claimed, and errors of the tip, mm, dead time and lag, ms, of one arm."""
    watched, rng = watched_arm(seed), np.random.default_rng([seed, 97])
    kinematics, told = kinematics_of(watched.told.arm), watched.told
    set_point = set_point_of(planned(watched.begin, told.limits, told.tick, MoveWishes()), told.tick)
    settings, tool = watched.settings, watched.true.tool_offset
    true = ArmState(se3.inverse(watched.true.arm_from_base), tool, settings.dead_time, settings.servo_lag, END)
    seen = sightings_of(true, set_point, kinematics, watched.rig, PERIOD, NOISE, OUTLIERS, rng)
    pose, axes, _ = first_pose(seen, set_point, kinematics, watched.rig)
    fit = fit_arm(seen, set_point, kinematics, watched.rig, ArmState(pose, np.zeros(3), 0.01, 0.01, 0.5))
    off, poses = error_of(fit, true), kinematics(axes)
    nees = _parts(off, fit.covariance)
    a, b = (se3.transform_points(x.base_from_arm @ poses, np.asarray(x.tool)[None])[:, 0] for x in (fit.state, true))
    return nees, float(np.sqrt(np.mean(((a - b) ** 2).sum(1)))), 1e3 * float(off[9]), 1e3 * float(off[10])
