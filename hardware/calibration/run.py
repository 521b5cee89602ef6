"""`stillbed calibrate cameras`: a recording or live cameras in; a rig, a report and a verdict out."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimation.calibration.camera_rig import Calibration, calibrate, rebased
from estimation.calibration.lens_model import PARAMETERS
from estimation.calibration.validation import VolumeError, predicted_error, working_volume
from estimation.errors import InputError
from estimation.rig import Rig
from hardware.calibration.against_given import check_against, check_distance, elsewhere
from hardware.calibration.board_file import read_board
from hardware.calibration.collect import collect
from hardware.calibration.coverage import hints
from hardware.calibration.inputs import check_table
from hardware.calibration.live import devices_named, watch
from hardware.calibration.material import Material
from hardware.calibration.report import millimetres_per_pixel, page
from hardware.calibration.source import open_source
from hardware.calibration.verdict import LIMIT, Verdict, board_scatter, held_out, judge, residual
from hardware.calibration.waving_page import WavingPage
from hardware.cameras.live import LiveCameras
from hardware.files.rig_file import write_rig
from hardware.operator.waving import WavingStage
from hardware.process.clock import Clock
from hardware.process.progress import Progress, Report
from perception.boards.board import Board
from perception.boards.collection import usable
from perception.boards.undistorted import thumbnail, undistorted

SPEED = 20.0  # mm/s of the surface, at which late clocks are counted: a deep breath's most
PICTURE = 640  # px, width of a picture in the report


@dataclass(frozen=True, slots=True)
class Wishes:
    """What is asked of a calibration.

    limit: mm, of the predicted error. distance: two cameras and how far apart their lenses are, mm, if measured.
    keep_lenses: whether the session's own lenses are taken, within what they are said to be off by. new_rig: whether
    the session's rig is of no account.
    """

    limit: float = LIMIT
    distance: tuple[str, str, float] | None = None
    keep_lenses: bool = False
    new_rig: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A calibration, what it is worth, and the text for the terminal."""

    calibration: Calibration
    error: VolumeError
    verdict: Verdict
    text: str


def run_calibration(session: Path, board_file: Path, out: Path, wishes: Wishes, report: Report) -> Outcome:
    """Calibrate the cameras of a session; writes `out` and, beside it, .report.html, .json and the .corners.npz.

    InputError, Undetermined and Implausible say what is wrong; nothing but the corners is written then.
    """
    board = _begin(board_file, out)
    source = open_source(session)
    rig = source.session.rig
    _check_wishes(tuple(c.name for c in rig.cameras), source.given is not None, source.session.path, wishes)
    table = collect(source.session, board, corners_of(out), report)
    return finish(source.material(table), board, board_file, out, wishes)


def run_live(
    which: Sequence[str],
    board_file: Path,
    out: Path,
    wishes: Wishes,
    seconds: float | None,
    clock: Clock,
    progress: Progress,
    open_page: Callable[[], AbstractContextManager[WavingPage | None]] = nullcontext,
) -> Outcome:
    """Calibrate live cameras, named as `stillbed cameras` has them, while a board is waved; writes the same files.

    seconds: at most, None until enough was seen. open_page: gives the page that shows where to hold the board, and
    what came of it. Interrupted, it leaves the corners, and the next run goes on.
    """
    board = _begin(board_file, out)
    devices = devices_named(which)
    _check_wishes(devices.names, devices.rig is not None, "command line", wishes)
    with open_page() as shown:
        with LiveCameras(devices.places, devices.sources, clock) as live:
            material = watch(live, devices, board, corners_of(out), seconds, clock, progress, shown)
        if shown is not None:
            shown.tell(WavingStage.SOLVE)
        outcome = finish(material, board, board_file, out, wishes)
        if shown is not None:
            shown.tell(WavingStage.PASSED if outcome.verdict.passed else WavingStage.FAILED, *outcome.text.split("\n"))
    return outcome


def corners_of(out: Path) -> Path:
    """Where the corners are kept that a rig.toml is made from."""
    return out.with_suffix(".corners.npz")


def _begin(board_file: Path, out: Path) -> Board:
    board = read_board(board_file)
    if out.suffix != ".toml":
        raise InputError(out, "--out", out.name, "a file that ends in .toml")
    out.parent.mkdir(parents=True, exist_ok=True)
    return board


def finish(material: Material, board: Board, board_file: Path, out: Path, wishes: Wishes) -> Outcome:
    """Calibrate from the corners that were found, and write all files."""
    check_table(material.table, board, board_file, material.names, material.pictures)
    views, dropped = usable(material.table, board, material.names, tuple(c.size for c in material.rig.cameras))
    found = calibrate(views, known=material.lenses if wishes.keep_lenses else None)
    if wishes.distance is not None:
        check_distance(found.rig, *wishes.distance, board_file, board.square)
    if material.given and not wishes.new_rig:
        check_against(found.rig, material.rig, board_file, board.square)
    error = predicted_error(found, working_volume(found), SPEED)
    verdict = judge(found, error, wishes.limit, hints(found))
    placed = rebased(found.rig, material.rig.cameras[0].base_from_camera if material.given else np.eye(4))
    sigmas = [np.sqrt(np.diag(found.covariance_of(c))[:9]) for c in range(len(placed))]
    write_rig(out, placed, material.images, sigmas)
    out.with_suffix(".json").write_text(_json(found, error, verdict), encoding="utf-8")
    text = page(material.title, found, error, verdict, dropped, _pictures(material, found))
    out.with_suffix(".report.html").write_text(text, encoding="utf-8")
    lines = _beside(placed, material.rig) if material.given else []
    return Outcome(replace(found, rig=placed), error, verdict, _text(found, verdict, dropped, out, lines))


def _beside(found: Rig, given: Rig) -> list[str]:
    """Where the cameras stand beside the rig that was given."""
    apart = zip(found.cameras[1:], elsewhere(found, given)[1:], strict=True)
    words = [f"{camera.name} {millimetres:.1f} mm, {degrees:.2f} degrees" for camera, (millimetres, degrees) in apart]
    return [f"away from where the rig.toml had it: {'; '.join(words)}"] if words else []


def _check_wishes(names: Sequence[str], given: bool, where: object, wishes: Wishes) -> None:
    if wishes.keep_lenses and not given:
        raise InputError(where, "--keep-lenses", "a rig.toml without lenses", "one that has them")
    for name in wishes.distance[:2] if wishes.distance else ():
        if name not in names:
            raise InputError("--distance-mm", "camera", name, ", ".join(names))


def _pictures(material: Material, found: Calibration) -> dict[str, bytes]:
    """A picture of each camera without its distortion."""
    cameras = enumerate(found.rig.cameras)
    return {camera.name: thumbnail(undistorted(camera, material.pictures(c)[-1]), PICTURE) for c, camera in cameras}


def _json(found: Calibration, error: VolumeError, verdict: Verdict) -> str:
    """All figures with their doubts, mm, rad, s; the covariance is camera by camera in the order of `numbers`."""
    numbers = [*PARAMETERS, "rx", "ry", "rz", "tx", "ty", "tz", "clock_offset_s"]
    cameras = [
        {
            "name": c.name,
            "model": found.models[i],
            "sigma": dict(zip(numbers, np.sqrt(np.diag(found.covariance_of(i))).tolist(), strict=True)),
            "residual_median_px": residual(found, i),
            "residual_held_out_median_px": finite(held_out(found, i)),
            "lens_held_out_rms_px": {s.model: s.held_out for s in found.scores[i]},
            "mm_per_px": millimetres_per_pixel(found, i),
        }
        for i, c in enumerate(found.rig.cameras)
    ]
    table = {
        "passed": verdict.passed,
        "predicted_error_mm": {"typical": error.typical, "worst": error.worst},
        "residual_median_px": residual(found),
        "residual_held_out_median_px": finite(held_out(found)),
        "board_distances_rms_mm": board_scatter(found),
        "jitter_s": found.jitter,
        "numbers": numbers,
        "cameras": cameras,
        "covariance": found.fit.covariance.tolist(),
    }
    return json.dumps(table, indent=1, allow_nan=False) + "\n"


def finite(value: float) -> float | None:
    """A figure as JSON has it; None where it could not be measured."""
    return value if np.isfinite(value) else None


def _text(
    found: Calibration, verdict: Verdict, dropped: Mapping[tuple[str, str], int], out: Path, more: list[str]
) -> str:
    lines = ["PASS" if verdict.passed else "FAIL", *verdict.lines]
    for i, camera in enumerate(found.rig.cameras):
        sigma = np.sqrt(np.diag(found.covariance_of(i)))
        lines.append(
            f"{camera.name}: focal length {camera.matrix[0, 0]:.1f} ± {sigma[0]:.1f} px, distortion {found.models[i]}, "
            f"clock {1e3 * camera.clock_offset:+.2f} ± {1e3 * sigma[15]:.2f} ms, {residual(found, i):.2f} px, "
            f"{millimetres_per_pixel(found, i):.3f} mm/px"
        )
    lines.append(f"distances between corners: {board_scatter(found):.2f} mm RMS")
    lines += more
    lines += [f"{name}: {count} views left out, {reason}" for (name, reason), count in sorted(dropped.items())]
    lines += list(verdict.hints)
    lines.append(f"rig: {out}, report: {out.with_suffix('.report.html')}")
    return "\n".join(lines)
