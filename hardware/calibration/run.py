"""`stillbed calibrate cameras`: a recording in; a rig, a report and a verdict out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimation.camera_calibration.calibrate import Calibration, calibrate, rebased
from estimation.camera_calibration.lens_model import PARAMETERS
from estimation.camera_calibration.rig_error import VolumeError, predicted_error, working_volume
from estimation.errors import InputError
from hardware.calibration.against_given import check_against, check_distance
from hardware.calibration.board_file import read_board
from hardware.calibration.collect import collect
from hardware.calibration.coverage import hints
from hardware.calibration.report import millimetres_per_pixel, page
from hardware.calibration.source import Source, open_source
from hardware.calibration.suspicion import check_table
from hardware.calibration.verdict import LIMIT, Verdict, board_scatter, held_out, judge, residual
from hardware.progress import Report
from hardware.rig_file import write_rig
from hardware.session import Session
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
    board = read_board(board_file)
    if out.suffix != ".toml":
        raise InputError(out, "--out", out.name, "a file that ends in .toml")
    source = open_source(session)
    _check_wishes(source, wishes)
    out.parent.mkdir(parents=True, exist_ok=True)
    table = collect(source.session, board, out.with_suffix(".corners.npz"), report)
    check_table(table, board, board_file, source.session)
    cameras = source.session.rig.cameras
    views, dropped = usable(table, board, tuple(c.name for c in cameras), tuple(c.size for c in cameras))
    found = calibrate(views, known=source.lenses if wishes.keep_lenses else None)
    if wishes.distance is not None:
        check_distance(found.rig, *wishes.distance, board_file, board.square)
    if source.given is not None and not wishes.new_rig:
        check_against(found.rig, source.given, board_file, board.square)
    error = predicted_error(found, working_volume(found), SPEED)
    verdict = judge(found, error, wishes.limit, hints(found))
    base = cameras[0].base_from_camera if source.given is not None else np.eye(4)
    placed = rebased(found.rig, base)
    sigmas = [np.sqrt(np.diag(found.covariance_of(c))[:9]) for c in range(len(cameras))]
    write_rig(out, placed, source.images, sigmas)
    out.with_suffix(".json").write_text(_json(found, error, verdict), encoding="utf-8")
    pictures = _pictures(source.session, found)
    text = page(session.name, found, error, verdict, dropped, pictures)
    out.with_suffix(".report.html").write_text(text, encoding="utf-8")
    return Outcome(replace(found, rig=placed), error, verdict, _text(found, verdict, dropped, out))


def _check_wishes(source: Source, wishes: Wishes) -> None:
    names = [c.name for c in source.session.rig.cameras]
    if wishes.keep_lenses and source.given is None:
        raise InputError(source.session.path, "--keep-lenses", "a rig.toml without lenses", "one that has them")
    for name in wishes.distance[:2] if wishes.distance else ():
        if name not in names:
            raise InputError("--distance-mm", "camera", name, ", ".join(names))


def _pictures(session: Session, found: Calibration) -> dict[str, bytes]:
    """A picture of each camera without its distortion."""
    reader, out = session.store.open(), {}
    try:
        for c, camera in enumerate(found.rig.cameras):
            ref = next(ref for refs in session.sets for ref in refs if ref.camera == c)
            out[camera.name] = thumbnail(undistorted(camera, reader.read(ref)), PICTURE)
    finally:
        reader.close()
    return out


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


def _text(found: Calibration, verdict: Verdict, dropped: Mapping[tuple[str, str], int], out: Path) -> str:
    lines = ["PASS" if verdict.passed else "FAIL", *verdict.lines]
    for i, camera in enumerate(found.rig.cameras):
        sigma = np.sqrt(np.diag(found.covariance_of(i)))
        lines.append(
            f"{camera.name}: focal length {camera.matrix[0, 0]:.1f} ± {sigma[0]:.1f} px, distortion {found.models[i]}, "
            f"clock {1e3 * camera.clock_offset:+.2f} ± {1e3 * sigma[15]:.2f} ms, {residual(found, i):.2f} px, "
            f"{millimetres_per_pixel(found, i):.3f} mm/px"
        )
    lines.append(f"distances between corners: {board_scatter(found):.2f} mm RMS")
    lines += [f"{name}: {count} views left out, {reason}" for (name, reason), count in sorted(dropped.items())]
    lines += list(verdict.hints)
    lines.append(f"rig: {out}, report: {out.with_suffix('.report.html')}")
    return "\n".join(lines)
