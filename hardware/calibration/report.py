"""Verdict and report of a rig's calibration: predicted error, residuals, cameras and the board's coverage."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.calibration.camera_rig import GRID_SIDE, Calibration
from estimation.calibration.lens_model import PARAMETERS, lens_parameters, project_lens
from estimation.calibration.validation import VolumeError
from estimation.se3 import Array
from hardware.calibration.corners import coverage
from hardware.report.evaluation import finite
from hardware.report.page import (
    camera_pictures,
    captioned,
    document,
    figure_row,
    figures_table,
    legend,
    row_of_tiles,
    section,
    tile,
)

MAX_PREDICTED_ERROR = 0.1  # mm: what printing needs of the rig in the working volume, one sigma in 3D
MAX_RESIDUAL = 0.5  # px, median of the corners
RESIDUAL_SCALE = 40  # enlargement of the residuals drawn
ERROR_COLOURS = ((0.05, "var(--green)"), (0.1, "#b3bf3a"), (0.2, "#eba53a"), (0.4, "#d0492f"))  # up to so many mm
WORST_COLOUR, UNSEEN_COLOUR = "var(--violet)", "var(--faint)"


@dataclass(frozen=True, slots=True)
class CalibrationVerdict:
    """Whether a calibration is good enough to print with."""

    passed: bool
    lines: tuple[str, ...]  # the reasons, the decisive one first
    hints: tuple[str, ...]  # what to do; empty if passed


def median_residual(calibration: Calibration, camera: int | None = None, held_out: bool = False) -> float:
    """Median reprojection error, px, of one camera or of all; NaN of no view.

    held_out: under rigs calibrated without the view's own stretch of the recording.
    """
    away = np.linalg.norm(calibration.held_out if held_out else calibration.fit.residuals, axis=-1)
    away = away if camera is None else away[calibration.views.camera == camera]
    return float(np.nanmedian(away)) if np.isfinite(away).any() else float("nan")


def judge_rig(calibration: Calibration, error: VolumeError, limit: float, hints: tuple[str, ...]) -> CalibrationVerdict:
    """The verdict. limit: mm, of the predicted error in 19 of 20 points of the working volume."""
    off, spread = median_residual(calibration), error.worst
    good = [spread <= limit, off <= MAX_RESIDUAL]
    word = "good enough" if good[0] else "NOT good enough"
    lines = [
        f"{word} to print: points in the working volume are off by {error.typical:.3f} mm (one sigma), 19 of 20 by "
        f"less than {spread:.3f} mm; {limit:g} mm is allowed",
        f"corners lie {off:.2f} px from where they should (median); {MAX_RESIDUAL:g} px is allowed; "
        f"{median_residual(calibration, held_out=True):.2f} px in stretches of the recording that were held out",
    ]
    if calibration.jitter:
        lines.append(f"pictures are late by {1e3 * calibration.jitter:.1f} ms each for itself: the cameras run free")
    return CalibrationVerdict(all(good), tuple(lines), () if all(good) else hints)


def board_scatter(calibration: Calibration) -> float:
    """RMS error, mm, of distances between triangulated corners, at instants that two cameras share."""
    errors = []
    for corners in _triangulated_corners(calibration):
        known = np.isfinite(corners[:, 0])
        first, second = np.triu_indices(int(known.sum()), 1)
        if len(first):
            pair = corners[known], calibration.views.points[known]
            measured, true = (np.linalg.norm(p[first] - p[second], axis=1) for p in pair)
            errors.append(measured - true)
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) if errors else float("nan")


def _triangulated_corners(calibration: Calibration) -> Array:
    """Corners (S, P, 3) mm, base, at their instant's time; nan where fewer than two cameras saw one.

    One Gauss-Newton step from the rig's own board poses, which also bring all views to one time.
    """
    views, fit = calibration.views, calibration.fit
    state, cameras = fit.state, len(views.names)
    corners = se3.transform_points(state.base_from_board, views.points)
    information = np.zeros((len(corners), views.pixels.shape[1], 3, 3))
    slope, count = np.zeros((*information.shape[:3],)), np.zeros(information.shape[:2])
    for c in range(cameras):
        rows = np.flatnonzero(views.camera == c)
        camera_from_base = se3.inverse(state.base_from_camera[c])
        at = corners[views.instant[rows]]
        by_point = project_lens(state.lens[c], se3.transform_points(camera_from_base, at))[2] @ camera_from_base[:3, :3]
        seen = views.seen[rows]
        residuals = np.where(seen[..., None], fit.residuals[rows], 0.0)
        by_point = np.where(seen[..., None, None], by_point, 0.0)
        np.add.at(information, views.instant[rows], np.swapaxes(by_point, -1, -2) @ by_point)
        np.add.at(slope, views.instant[rows], np.einsum("vpij,vpi->vpj", by_point, residuals))
        np.add.at(count, views.instant[rows], seen)
    information = np.where((count >= 2)[..., None, None], information, np.eye(3))
    points = corners - np.linalg.solve(information, slope[..., None])[..., 0]
    return np.where((count >= 2)[..., None], points, np.nan)


def bullets(lines: Iterable[str]) -> str:
    """A list in HTML."""
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def picture_frame(size: tuple[int, int], inside: str, label: str = "picture") -> str:
    """A frame as large as a picture (W, H) px, with what is drawn in it, in SVG."""
    w, h = size
    border = f'<rect class="frame" width="{w}" height="{h}" fill="none" stroke="var(--faint)" stroke-width="4"/>'
    return f'<svg class="plot" viewBox="0 0 {w} {h}" role="img" aria-label="{label}">{border}{inside}</svg>'


def page(
    title: str,
    result: Calibration,
    error: VolumeError,
    verdict: CalibrationVerdict,
    dropped: Mapping[tuple[str, str], int],
    pictures: Mapping[str, bytes],
) -> str:
    """The page as HTML. dropped: views by camera and reason. pictures: undistorted JPEGs by camera."""
    word = "passed" if verdict.passed else "failed"
    residuals = f"From each corner to where the rig puts it, {RESIDUAL_SCALE} times as long."
    tiles = [
        tile(f"{error.worst:.3f}", "mm", "predicted error, 19 of 20 points"),
        tile(f"{median_residual(result):.2f}", "px", "median corner residual"),
        tile(f"{board_scatter(result):.2f}", "mm", "RMS of distances between corners"),
        tile(str(len(result.views)), "", "views used"),
    ]
    body = [
        row_of_tiles(tiles),
        section("Verdict", ". ".join(verdict.lines) + ".", bullets(verdict.hints) if verdict.hints else ""),
        section("Cameras", "One sigma behind each figure.", _cameras(result) + _left_out(result, dropped)),
        section("Where the board was", "Every corner used, where the lens imaged it.", _each(result, _corners)),
        section("Residuals", residuals, _each(result, _residuals)),
        section("Predicted error", "mm, one sigma, over the working volume, layer by layer along z.", _volume(error)),
    ]
    if pictures:
        text = "Undistorted with getOptimalNewCameraMatrix, alpha = 1 (thesis, Figure 4.5)."
        body.append(section("Without distortion", text, camera_pictures(pictures.items())))
    footer = "Lengths in mm, base = the first camera's place. Distortion models were chosen by error on views held out."
    return document("stillbed calibrate cameras", title, f"Calibration {word}: {verdict.lines[0]}.", body, footer)


def millimetres_per_pixel(result: Calibration, camera: int) -> float:
    """mm that one pixel spans at the board's median distance (thesis 4.2 reports 0.508, 0.51 and 0.33)."""
    views, state = result.views, result.fit.state
    boards = state.base_from_board[views.instant[views.camera == camera]]
    middle = se3.transform_points(boards, views.points).mean(1)
    depth = se3.transform_points(se3.inverse(state.base_from_camera[camera]), middle)[:, 2]
    return float(np.median(depth) / np.sqrt(state.lens[camera, 0] * state.lens[camera, 1]))


def _cameras(result: Calibration) -> str:
    cameras = range(len(result.views.names))
    lone = [next((s.held_out for s in result.scores[c] if s.model == result.models[c]), np.nan) for c in cameras]
    lenses = [lens_parameters(camera) for camera in result.rig.cameras]
    sigmas = [np.sqrt(np.diag(result.covariance_of(c))) for c in cameras]
    held_out = [median_residual(result, c, held_out=True) for c in cameras]
    rows = [
        ["views", *(str(int((result.views.camera == c).sum())) for c in cameras)],
        ["distortion model", *result.models],
        ["residual, median px", *(f"{median_residual(result, c):.2f}" for c in cameras)],
        ["in stretches held out of the whole, median px", *(f"{v:.2f}" for v in held_out)],
        ["lens alone, on views held out, RMS px", *(f"{v:.3f}" if np.isfinite(v) else "–" for v in lone)],
    ]
    for i, name in enumerate(PARAMETERS):
        digits = 2 if i < 4 else 5
        rows.append([name, *(f"{lenses[c][i]:.{digits}f} ± {sigmas[c][i]:.{digits}f}" for c in cameras)])
    offsets = [f"{1e3 * result.rig.cameras[c].clock_offset:.2f} ± {1e3 * sigmas[c][15]:.2f}" for c in cameras]
    rows += [
        ["place known to, mm", *(f"{np.linalg.norm(s[12:15]):.3f}" for s in sigmas)],
        ["and degrees", *(f"{np.degrees(np.linalg.norm(s[9:12])):.4f}" for s in sigmas)],
        ["clock offset, ms", *offsets],
        ["mm per pixel at the board", *(f"{millimetres_per_pixel(result, c):.3f}" for c in cameras)],
    ]
    return figures_table(["", *result.views.names], rows)


def _left_out(result: Calibration, dropped: Mapping[tuple[str, str], int]) -> str:
    rows = [f"{name}: {count} views, {reason}" for (name, reason), count in sorted(dropped.items())]
    rows.append(f"{result.dropped} single corners lay apart from all others and were left out")
    return bullets(rows)


def _each(result: Calibration, draw: Callable[[Calibration, int], str]) -> str:
    cameras = zip(result.views.names, result.views.sizes, strict=True)
    return figure_row(captioned(picture_frame(s, draw(result, c)), name) for c, (name, s) in enumerate(cameras))


def _corners(result: Calibration, camera: int) -> str:
    pixels = result.views.pixels[result.views.camera == camera].reshape(-1, 2)
    pixels = pixels[np.isfinite(pixels[:, 0])]
    parts = coverage(result, camera).parts
    w, h = result.views.sizes[camera]
    rows, columns = parts.shape
    counts = "".join(
        f'<text x="{(x + 0.5) * w / columns:.0f}" y="{(y + 0.5) * h / rows:.0f}" text-anchor="middle" '
        f'style="font-size:34px">{int(count)}</text>'
        for (y, x), count in np.ndenumerate(parts)
    )
    dots = "".join(f'<circle class="estimate" cx="{x:.0f}" cy="{y:.0f}" r="4"/>' for x, y in pixels)
    return dots + counts


def _residuals(result: Calibration, camera: int) -> str:
    rows = result.views.camera == camera
    pixels, rest = result.views.pixels[rows].reshape(-1, 2), result.fit.residuals[rows].reshape(-1, 2)
    known = np.isfinite(pixels[:, 0])
    ends = pixels + RESIDUAL_SCALE * rest
    return "".join(
        f'<path class="truth" stroke-width="3" d="M{a:.0f} {b:.0f}L{c:.0f} {d:.0f}"/>'
        for (a, b), (c, d) in zip(pixels[known], ends[known], strict=True)
    )


def _volume(error: VolumeError) -> str:
    """Layers of the volume as squares, coloured by the error; x to the right, y down, as the first camera sees them."""
    at = error.points.reshape(GRID_SIDE, GRID_SIDE, GRID_SIDE, 3)
    values = error.error.reshape(GRID_SIDE, GRID_SIDE, GRID_SIDE)
    layers = [_layer(values[:, :, z], float(at[0, 0, z, 2])) for z in range(GRID_SIDE)]
    edges = ["0", *(f"{most:g}" for most, _ in ERROR_COLOURS)]
    keys = [f"{a} to {b} mm" for a, b in pairwise(edges)] + [f"more than {edges[-1]} mm"]
    styles = [style for _, style in ERROR_COLOURS] + [WORST_COLOUR]
    pairs = zip([*styles, ""], [*keys, "not seen by two"], strict=True)
    low, high = error.points.min(0), error.points.max(0)
    text = " x ".join(f"{b - a:.0f}" for a, b in zip(low, high, strict=True))
    return f'<p class="note">{text} mm</p>{figure_row(layers)}{legend([_key(*pair) for pair in pairs])}'


def _layer(values: Array, z: float) -> str:
    cells = []
    for (x, y), value in np.ndenumerate(values):
        colour = next((style for limit, style in ERROR_COLOURS if value <= limit), WORST_COLOUR)
        fill = colour if np.isfinite(value) else UNSEEN_COLOUR
        words = f"{value:.3f} mm" if np.isfinite(value) else "not seen by two cameras"
        place = f'x="{20 * x + 1}" y="{20 * y + 1}" width="18" height="18"'
        cells.append(f'<rect style="fill:{fill}" {place}><title>{words}</title></rect>')
    box = f'<svg class="plot heat" viewBox="0 0 {20 * GRID_SIDE} {20 * GRID_SIDE}">{"".join(cells)}</svg>'
    return captioned(box, f"z = {z:.0f} mm")


def _key(fill: str, words: str) -> str:
    patch = f'<svg viewBox="0 0 18 10"><rect style="fill:{fill}" width="18" height="10"/></svg>'
    return f"<span>{patch}{escape(words)}</span>"


def rig_json(result: Calibration, error: VolumeError, verdict: CalibrationVerdict) -> str:
    """All figures with their sigmas, mm, rad, s; the covariance is camera by camera in the order of `numbers`."""
    numbers = [*PARAMETERS, "rx", "ry", "rz", "tx", "ty", "tz", "clock_offset_s"]
    cameras = [
        {
            "name": c.name,
            "model": result.models[i],
            "sigma": dict(zip(numbers, np.sqrt(np.diag(result.covariance_of(i))).tolist(), strict=True)),
            "residual_median_px": median_residual(result, i),
            "residual_held_out_median_px": median_residual(result, i, held_out=True),
            "lens_held_out_rms_px": {s.model: s.held_out for s in result.scores[i]},
            "mm_per_px": millimetres_per_pixel(result, i),
        }
        for i, c in enumerate(result.rig.cameras)
    ]
    table = {
        "passed": verdict.passed,
        "predicted_error_mm": {"typical": error.typical, "worst": error.worst},
        "residual_median_px": median_residual(result),
        "residual_held_out_median_px": median_residual(result, held_out=True),
        "board_distances_rms_mm": board_scatter(result),
        "jitter_s": result.jitter,
        "numbers": numbers,
        "cameras": cameras,
        "covariance": result.fit.covariance.tolist(),
    }
    return json.dumps(finite(table), indent=1, allow_nan=False) + "\n"


def rig_text(
    result: Calibration, verdict: CalibrationVerdict, dropped: Mapping[tuple[str, str], int], out: Path, more: list[str]
) -> str:
    """What the terminal shows. dropped: views by camera and reason. more: further lines."""
    lines = ["PASS" if verdict.passed else "FAIL", *verdict.lines]
    for i, camera in enumerate(result.rig.cameras):
        model, sigma = result.models[i], np.sqrt(np.diag(result.covariance_of(i)))
        lines.append(
            f"{camera.name}: focal length {camera.matrix[0, 0]:.1f} ± {sigma[0]:.1f} px, distortion {model}, "
            f"clock {1e3 * camera.clock_offset:+.2f} ± {1e3 * sigma[15]:.2f} ms, {median_residual(result, i):.2f} px, "
            f"{millimetres_per_pixel(result, i):.3f} mm/px"
        )
    lines.append(f"distances between corners: {board_scatter(result):.2f} mm RMS")
    lines += more
    lines += [f"{name}: {count} views left out, {reason}" for (name, reason), count in sorted(dropped.items())]
    lines += list(verdict.hints)
    lines.append(f"rig: {out}, report: {out.with_suffix('.report.html')}")
    return "\n".join(lines)
