"""`stillbed calibrate cameras`: a recording or live cameras in; a rig, a report and a verdict out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimation.calibration.camera_rig import Calibration, calibrate, rebased
from estimation.errors import InputError
from estimation.rig import Rig
from hardware.calibration.corners import collect_corners, coverage_hints
from hardware.calibration.inputs import (
    CalibrationInput,
    camera_shifts,
    check_against,
    check_distance,
    check_table,
    open_source,
)
from hardware.calibration.live import WavingPage, devices_named, watch
from hardware.calibration.report import MAX_PREDICTED_ERROR, CalibrationVerdict, judge_rig, page, rig_json, rig_text
from hardware.cameras.live import LiveCameras
from hardware.files.rig_file import read_board, write_rig
from hardware.operator.shared_state import WavingStage
from hardware.process.clock import Clock
from hardware.process.progress import Progress, ProgressReport
from perception.boards.board import Board, CornerTable, thumbnail, undistort, usable_views

SURFACE_SPEED = 20.0  # mm/s, for the effect of clock errors: the peak of a deep breath
PICTURE_WIDTH = 640  # px, of a picture in the report


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """Options of a rig's calibration."""

    limit: float = MAX_PREDICTED_ERROR  # mm, of the predicted error
    distance: tuple[str, str, float] | None = None  # two cameras and the measured distance of their lenses, mm
    keep_lenses: bool = False  # whether the given lenses are used, within their sigma
    new_rig: bool = False  # whether the session's rig is ignored


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """A calibration and its verdict."""

    calibration: Calibration
    verdict: CalibrationVerdict
    text: str  # for the terminal
    damage: str = ""  # what was lost of the recording's file, "" if nothing


def run_calibration(
    session: Path, board_file: Path, out: Path, options: CalibrationOptions, report: ProgressReport
) -> CalibrationResult:
    """Calibrate the cameras of a session; writes `out` and beside it .report.html, .json and .corners.npz.

    InputError, Undetermined and Implausible say what is wrong; then only the corners are written.
    """
    board = _check_paths(board_file, out)
    recording, material = open_source(session)
    _check_options(material.names, material.calibrated, recording.path, options)
    table = collect_corners(recording, board, corners_of(out), report)
    return replace(finish(material, table, board, board_file, out, options), damage=recording.damage)


def run_live(
    which: Sequence[str],
    board_file: Path,
    out: Path,
    options: CalibrationOptions,
    seconds: float | None,
    clock: Clock,
    progress: Progress,
    open_page: Callable[[], AbstractContextManager[WavingPage | None]] = nullcontext,
) -> CalibrationResult:
    """Calibrate live cameras, named as for `stillbed cameras`, while a board is waved; writes the same files.

    seconds: at most, None until the coverage suffices. open_page: opens the page that shows where to hold the board,
    and the result. An interrupted run leaves its corners, and the next one goes on.
    """
    board = _check_paths(board_file, out)
    devices = devices_named(which)
    _check_options(devices.names, devices.rig is not None, "command line", options)
    with open_page() as shown:
        with LiveCameras(devices.places, devices.sources, clock) as live:
            material, table = watch(live, devices, board, corners_of(out), seconds, clock, progress, shown)
        if shown is not None:
            shown.enter(WavingStage.SOLVE)
        outcome = finish(material, table, board, board_file, out, options)
        if shown is not None:
            shown.enter(WavingStage.PASSED if outcome.verdict.passed else WavingStage.FAILED, *outcome.text.split("\n"))
    return outcome


def corners_of(out: Path) -> Path:
    """The file of the corners from which a rig.toml is calibrated."""
    return out.with_suffix(".corners.npz")


def _check_paths(board_file: Path, out: Path) -> Board:
    board = read_board(board_file)
    if out.suffix != ".toml":
        raise InputError(out, "--out", out.name, "a file that ends in .toml")
    out.parent.mkdir(parents=True, exist_ok=True)
    return board


def finish(
    material: CalibrationInput, table: CornerTable, board: Board, board_file: Path, out: Path,
    options: CalibrationOptions,
) -> CalibrationResult:  # fmt: skip
    """Calibrate from the corners, and write all files."""
    check_table(table, board, board_file, material.names, material.pictures)
    views, dropped = usable_views(table, board, material.names, tuple(c.size for c in material.rig.cameras))
    result = calibrate(views, known=material.lenses if options.keep_lenses else None)
    if options.distance is not None:
        check_distance(result.rig, *options.distance, board_file, board.square)
    if material.calibrated and not options.new_rig:
        check_against(result.rig, material.rig, board_file, board.square)
    error = result.predicted_error(result.working_volume(), SURFACE_SPEED)
    verdict = judge_rig(result, error, options.limit, coverage_hints(result))
    placed = rebased(result.rig, material.rig.cameras[0].base_from_camera if material.calibrated else np.eye(4))
    sigmas = [np.sqrt(np.diag(result.covariance_of(c))[:9]) for c in range(len(placed))]
    write_rig(out, placed, material.images, sigmas)
    out.with_suffix(".json").write_text(rig_json(result, error, verdict), encoding="utf-8")
    text = page(material.title, result, error, verdict, dropped, _pictures(material, result))
    out.with_suffix(".report.html").write_text(text, encoding="utf-8")
    lines = _shift_lines(placed, material.rig) if material.calibrated else []
    return CalibrationResult(replace(result, rig=placed), verdict, rig_text(result, verdict, dropped, out, lines))


def _shift_lines(rig: Rig, before: Rig) -> list[str]:
    apart = zip(rig.cameras[1:], camera_shifts(rig, before)[1:], strict=True)
    texts = [f"{camera.name} {millimetres:.1f} mm, {degrees:.2f} degrees" for camera, (millimetres, degrees) in apart]
    return [f"away from where the rig.toml had it: {'; '.join(texts)}"] if texts else []


def _check_options(names: Sequence[str], calibrated: bool, where: object, options: CalibrationOptions) -> None:
    if options.keep_lenses and not calibrated:
        raise InputError(where, "--keep-lenses", "a rig.toml without lenses", "one that has them")
    for name in options.distance[:2] if options.distance else ():
        if name not in names:
            raise InputError("--distance-mm", "camera", name, ", ".join(names))


def _pictures(material: CalibrationInput, result: Calibration) -> dict[str, bytes]:
    cameras = enumerate(result.rig.cameras)
    return {camera.name: thumbnail(undistort(camera, material.pictures(c)[-1]), PICTURE_WIDTH) for c, camera in cameras}
