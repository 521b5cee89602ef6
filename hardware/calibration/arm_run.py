"""`stillbed calibrate arm`: a recorded folder, touched points or a virtual arm in; an arm file and a report out.

Touched points are a TOML file:

[[point]]
arm_mm_deg = [202.5, 225, 50, 0, 0, 0]      # X Y Z A B C that the arm was sent to, the tip on the point
base_mm = [180, 40, 60]                     # the same point in the base frame,
[[point]]
arm_mm_deg = [240, 225, 52, 10, 0, 0]
pixels = {left = [612.5, 300.2], right = [655.0, 410.8]}   # or its pixels in two cameras or more
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.calibration.arm_fit import ArmUnknowns, TouchFit, fit_touches
from estimation.calibration.arm_model import SetPoint
from estimation.errors import InputError
from estimation.mapping.triangulation import triangulate
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.link import Arm
from hardware.arm.profile import AXIS_UNITS, ArmProfile, open_arm
from hardware.arm.s6h4d import S6H4D
from hardware.calibration.arm_record import ARM_FILE, COMMANDED_FILE, MoveOptions, move_arm, read_commanded
from hardware.calibration.arm_report import ArmTruth, arm_page, arm_text, judge_arm
from hardware.calibration.arm_solve import calibrated_profile, kinematics_of, numbers_text, solve_folder, tip_error
from hardware.calibration.report import CalibrationVerdict
from hardware.files.arm_file import write_arm
from hardware.files.rig_file import read_rig
from hardware.process import checks
from hardware.process.clock import Clock, SimClock
from hardware.process.progress import ProgressReport
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import VirtualDevice
from hardware.simulator.watched_arm import WatchedArm, serve_arm, take_pictures
from perception.lens import undistort

RIG_JSON = "rig.json"  # of a recorded calibration: the figures of the rig's own calibration
TOUCH_SIGMA = 0.2  # mm, one sigma of jogging by hand
CLICK_SIGMA = 1.0  # px, one sigma of a point marked in a picture
MAX_TOUCH_REPROJECTION = 10.0  # px, beyond which the cameras do not show the same point
MAX_TOUCH_SIGMAS = 4.0  # of a good point's residual
DEAD_TIME_RANGE, DEAD_TIME_STEP = 0.03, 1e-4  # s, of the search for a virtual arm's dead time about its own
COMPARISON_STEP = 0.005  # s between the instants compared


@dataclass(frozen=True, slots=True, eq=False)
class TouchPoints:
    """Points that the tip has touched."""

    axes: Array  # (N, 6) mm and rad
    points: Array  # (N, 3) mm, base
    sigma: Array  # (N,) mm, of both together


def read_touches(path: Path, rig: Rig) -> TouchPoints:
    """The points in a file; InputError names the one that is wrong."""
    table = checks.read_toml(path)
    checks.check_keys(path, "", table, ("point",), ())
    axes, points, sigma = [], [], []
    for number, entry in enumerate(checks.tables(path, "point", table["point"])):
        key = f"point[{number}]."
        checks.check_keys(path, key, entry, ("arm_mm_deg",), ("base_mm", "pixels"))
        if ("base_mm" in entry) == ("pixels" in entry):
            raise InputError(path, key + "base_mm, pixels", "both or neither", "one of the two")
        axes.append(checks.numbers(path, key + "arm_mm_deg", entry["arm_mm_deg"], (6,), "mm and degrees") * AXIS_UNITS)
        if "base_mm" in entry:
            points.append(checks.numbers(path, key + "base_mm", entry["base_mm"], (3,), "mm"))
            sigma.append(TOUCH_SIGMA)
        else:
            point, spread = _point_from_pixels(path, key + "pixels", entry["pixels"], rig)
            points.append(point)
            sigma.append(float(np.hypot(TOUCH_SIGMA, spread)))
    return TouchPoints(np.array(axes).reshape(-1, 6), np.array(points).reshape(-1, 3), np.array(sigma))


def _point_from_pixels(path: Path, key: str, value: object, rig: Rig) -> tuple[Array, float]:
    """The triangulated point (3,) mm, and its sigma, mm, per axis."""
    names = [camera.name for camera in rig.cameras]
    if not isinstance(value, dict) or len(value) < 2:
        raise InputError(path, key, value, f"pixels of two cameras or more of {', '.join(names)}")
    checks.check_keys(path, key + ".", value, (), names)
    cameras = np.array([names.index(name) for name in value])
    pixels = [checks.numbers(path, f"{key}.{name}", value[name], (2,), "px") for name in value]
    ideal = np.concatenate([undistort(rig.cameras[c], p[None]) for c, p in zip(cameras, pixels, strict=True)])
    point, covariance, residuals = triangulate(rig, np.zeros(len(cameras), np.int64), cameras, ideal, 1)
    off = float(np.linalg.norm(residuals, axis=1).max())
    if not off <= MAX_TOUCH_REPROJECTION:
        got = f"{off:.1f} px from the place where the cameras agree"
        raise InputError(path, key, got, f"{MAX_TOUCH_REPROJECTION:g} px or less")
    return point[0], CLICK_SIGMA * float(np.sqrt(np.trace(covariance[0]) / 3))


def check_out(out: Path) -> None:
    """InputError unless `out` can be an arm file."""
    if out.suffix != ".toml":
        raise InputError(out, "--out", out.name, "a file that ends in .toml")
    if not out.parent.is_dir():
        raise InputError(out, "--out", "no such folder", "a file in a folder that exists")


def check_record(folder: Path) -> None:
    """InputError unless a recording can begin in a folder."""
    if folder.exists() and any(folder.iterdir()) if folder.is_dir() else folder.exists():
        raise InputError(folder, "--record", "exists", "a new or empty folder")
    if not folder.parent.is_dir():
        raise InputError(folder, "--record", "no such folder", "a folder in one that exists")
    folder.mkdir(exist_ok=True)


def copy_rig_json(rig: Path, folder: Path) -> None:
    """Copy the .json of a rig's calibration into a recorded calibration, if there is one."""
    copy = rig.with_suffix(".json")
    if copy.is_file():
        shutil.copyfile(copy, folder / RIG_JSON)


def run_folder(
    folder: Path, out: Path, limit: float, unknowns: ArmUnknowns, report: ProgressReport, truth: ArmTruth | None = None
) -> tuple[CalibrationVerdict, str]:
    """Solve a recorded calibration; writes `out` and, beside it, .report.html and .json.

    limit: mm, one sigma of the tip. Returns the verdict, and the text for the terminal.
    """
    check_out(out)
    rig_json = folder / RIG_JSON
    result = solve_folder(folder, rig_json if rig_json.is_file() else None, unknowns, report)
    verdict = judge_arm(result, limit)
    profile = calibrated_profile(result.profile, result.fit.state, unknowns)
    against = () if truth is None else truth.rows(result)
    write_arm(out, profile, f"calibrated by what cameras saw of its tip\n{verdict.lines[0]}")
    out.with_suffix(".json").write_text(numbers_text(result), encoding="utf-8")
    text = arm_page(folder.resolve().name, result, verdict, against)
    out.with_suffix(".report.html").write_text(text, encoding="utf-8")
    return verdict, arm_text(result, verdict, against, out)


def calibrate_touched(
    points_file: Path, rig_file: Path, profile: ArmProfile, out: Path, keep_tool: bool
) -> tuple[CalibrationVerdict, str]:
    """Calibrate an arm's pose from points that its tip has touched; writes `out`. Returns as `run_folder`."""
    check_out(out)
    points = read_touches(points_file, read_rig(rig_file).rig)
    poses = kinematics_of(profile.arm)(points.axes)
    result = fit_touches(poses, points.points, points.sigma, profile.arm.tool_offset, not keep_tool)
    verdict = _judge_touches(result, points, poses)
    arm = replace(profile.arm, arm_from_base=se3.inverse(result.base_from_arm), tool_offset=result.tool)
    write_arm(out, replace(profile, arm=arm), f"calibrated by {len(points.points)} touched points\n{verdict.lines[0]}")
    text = ["PASS" if verdict.passed else "FAIL", *verdict.lines, *verdict.hints, f"arm file: {out}"]
    return verdict, "\n".join(text)


def _judge_touches(result: TouchFit, points: TouchPoints, poses: Array) -> CalibrationVerdict:
    away = np.linalg.norm(result.residuals, axis=1)
    worst = int((away / points.sigma).argmax())
    error = tip_error(result.base_from_arm, result.tool, result.covariance, poses)
    spare = 3 * len(away) - 6
    scatter = float(np.sqrt((away**2 / points.sigma**2).sum() / spare))
    is_outlier = away[worst] > MAX_TOUCH_SIGMAS * points.sigma[worst]
    typical, beside = (float(np.sqrt(np.mean(v**2))) for v in (error, away))
    lines = [
        f"the tip is where it is thought to be within {typical:.2f} mm (one sigma) at the points",
        f"the points lie {beside:.2f} mm beside where they should (RMS), point {worst + 1} the most, "
        f"{away[worst]:.2f} mm; {scatter:.1f} times what touching by hand leaves",
    ]
    hints = (f"touch point {worst + 1} again, or leave it out: was it the same one?",) if is_outlier else ()
    return CalibrationVerdict(not is_outlier, tuple(lines), hints)


def record_on_terminal(
    watched: WatchedArm, clock: Clock, folder: Path, options: MoveOptions, moves: ProgressReport, images: ProgressReport
) -> ArmTruth:
    """Move the arm over a pseudo-terminal in real time, then render the cameras' pictures; returns the arm's truth.

    Ctrl-C stops the arm; its moves until then are recorded before the interrupt goes on.
    """
    write_arm(folder / ARM_FILE, watched.profile, "the virtual arm as it is taken to be")
    with tempfile.TemporaryDirectory() as place, serve_arm(watched, Path(place) / "arm", clock) as device:
        driver = open_arm(device.device, watched.profile)
        arm, begun = Arm(driver, watched.profile, clock.now()), clock.now()
        failure: BaseException | None = None
        try:
            move_arm(arm, clock, folder, watched.begin, options, moves)
        except (KeyboardInterrupt, InputError) as error:
            failure = error
        finally:
            span = begun, clock.now()
            arm.close()
            driver.release()
    assert device.arm is not None
    take_pictures(watched, device.arm, device.begun, span, folder, images)
    if failure is not None:
        raise failure
    return _truth(watched, device.arm, device.begun, read_commanded(folder / COMMANDED_FILE))


def record_in_virtual_time(
    watched: WatchedArm, folder: Path, options: MoveOptions, moves: ProgressReport, images: ProgressReport
) -> ArmTruth:
    """The same in virtual time: exact and repeatable, whatever the machine's load."""
    write_arm(folder / ARM_FILE, watched.profile, "the virtual arm as it is taken to be")
    clock = SimClock()
    virtual = VirtualArm(watched.settings, watched.profile.dialect, watched.begin, (), watched.profile.baud)
    arm = Arm(S6H4D(VirtualDevice(virtual, clock, watched.profile.baud), watched.profile), watched.profile, 0.0)
    move_arm(arm, clock, folder, watched.begin, options, moves)
    virtual.advance(clock.now())
    take_pictures(watched, virtual, 0.0, (0.0, clock.now()), folder, images)
    return _truth(watched, virtual, 0.0, read_commanded(folder / COMMANDED_FILE))


def _truth(watched: WatchedArm, arm: VirtualArm, begun: float, set_point: SetPoint) -> ArmTruth:
    """The truth; the dead time is as executed, with the delay of threads and terminal."""
    stamps = np.arange(set_point.instants[0] + 0.2, min(set_point.instants[-1], begun + arm.now) - 0.2, COMPARISON_STEP)
    executed, lag = arm.axes_at(stamps - begun)[:, :3], watched.settings.servo_lag

    def best(dead_times: Array) -> int:
        gaps = [set_point.lagged(stamps, dead, lag)[:, :3] - executed for dead in dead_times]
        return int(np.argmin([float(np.mean(gap**2)) for gap in gaps]))

    grid = watched.settings.dead_time + np.arange(-DEAD_TIME_RANGE / 3, DEAD_TIME_RANGE, DEAD_TIME_STEP)
    coarse = 10 * best(grid[::10])
    near = grid[max(0, coarse - 10) : coarse + 11]
    dead = float(near[best(near)])
    return ArmTruth(se3.inverse(watched.true.arm_from_base), watched.true.tool_offset, dead, lag)
