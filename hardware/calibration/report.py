"""The calibration's report: one page with the verdict, the cameras, where the board was, and what is left over."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape
from itertools import pairwise

import numpy as np

from estimation import se3
from estimation.calibration.camera_rig import Calibration
from estimation.calibration.lens_model import PARAMETERS, lens_of
from estimation.calibration.validation import SIDE, VolumeError
from estimation.se3 import Array
from hardware.calibration.coverage import coverage
from hardware.calibration.verdict import Verdict, board_scatter, held_out, residual
from hardware.page import document, figures_table, row_of_tiles, section, tile

WIDTH = 460  # px of one camera's picture
STRETCH = 40  # times, residuals are drawn
SCALE = ((0.05, "var(--green)"), (0.1, "#b3bf3a"), (0.2, "#eba53a"), (0.4, "#d0492f"))  # mm up to which, and the colour
BEYOND, UNSEEN = "var(--violet)", "var(--faint)"


def page(
    title: str,
    found: Calibration,
    error: VolumeError,
    verdict: Verdict,
    dropped: Mapping[tuple[str, str], int],
    pictures: Mapping[str, bytes],
) -> str:
    """The page as HTML. dropped: views by camera and reason. pictures: undistorted JPEGs by camera, as far as there."""
    word = "passed" if verdict.passed else "failed"
    body = [
        _tiles(found, error),
        section("Verdict", ". ".join(verdict.lines) + ".", _hints(verdict)),
        section("Cameras", "One sigma behind each figure.", _cameras(found) + _left_out(found, dropped)),
        section("Where the board was", "Every corner used, where the lens imaged it.", _each(found, _corners)),
        section(
            "Residuals", f"From each corner to where the rig puts it, {STRETCH} times as long.", _each(found, _rest)
        ),
        section("Predicted error", "mm, one sigma, over the working volume, layer by layer along z.", _volume(error)),
    ]
    if pictures:
        text = "Undistorted with getOptimalNewCameraMatrix, alpha = 1 (thesis, Figure 4.5)."
        body.append(section("Without distortion", text, _pictures(pictures)))
    footer = "Lengths in mm, base = the first camera's place. Distortion models were chosen by error on views held out."
    return document("stillbed calibrate cameras", title, f"Calibration {word}: {verdict.lines[0]}.", body, footer)


def millimetres_per_pixel(found: Calibration, camera: int) -> float:
    """mm that one pixel spans at the board's median distance (thesis 4.2 reports 0.508, 0.51 and 0.33)."""
    views, state = found.views, found.fit.state
    boards = state.base_from_board[views.instant[views.camera == camera]]
    middle = se3.transform_points(boards, views.points).mean(1)
    depth = se3.transform_points(se3.inverse(state.base_from_camera[camera]), middle)[:, 2]
    return float(np.median(depth) / np.sqrt(state.lens[camera, 0] * state.lens[camera, 1]))


def _tiles(found: Calibration, error: VolumeError) -> str:
    return row_of_tiles(
        [
            tile(f"{error.worst:.3f}", "mm", "predicted error, 19 of 20 points"),
            tile(f"{residual(found):.2f}", "px", "median corner residual"),
            tile(f"{board_scatter(found):.2f}", "mm", "RMS of distances between corners"),
            tile(str(len(found.views)), "", "views used"),
        ]
    )


def _hints(verdict: Verdict) -> str:
    return "<ul>" + "".join(f"<li>{escape(h)}</li>" for h in verdict.hints) + "</ul>" if verdict.hints else ""


def _cameras(found: Calibration) -> str:
    head = ["", *found.views.names]
    rows: list[list[str]] = [["views", *(str(int((found.views.camera == c).sum())) for c in _all(found))]]
    rows.append(["distortion model", *found.models])
    lone = [next((s.held_out for s in found.scores[c] if s.model == found.models[c]), np.nan) for c in _all(found)]
    rows.append(["residual, median px", *(f"{residual(found, c):.2f}" for c in _all(found))])
    rows.append(["in stretches held out of the whole, median px", *(f"{held_out(found, c):.2f}" for c in _all(found))])
    rows.append(["lens alone, on views held out, RMS px", *(f"{v:.3f}" if np.isfinite(v) else "–" for v in lone)])
    lenses = [lens_of(camera) for camera in found.rig.cameras]
    sigmas = [np.sqrt(np.diag(found.covariance_of(c))) for c in _all(found)]
    for i, name in enumerate(PARAMETERS):
        digits = 2 if i < 4 else 5
        rows.append([name, *(f"{lenses[c][i]:.{digits}f} ± {sigmas[c][i]:.{digits}f}" for c in _all(found))])
    rows.append(["place known to, mm", *(f"{np.linalg.norm(sigmas[c][12:15]):.3f}" for c in _all(found))])
    turns = [np.degrees(np.linalg.norm(sigmas[c][9:12])) for c in _all(found)]
    rows.append(["and degrees", *(f"{t:.4f}" for t in turns)])
    offsets = [f"{1e3 * found.rig.cameras[c].clock_offset:.2f} ± {1e3 * sigmas[c][15]:.2f}" for c in _all(found)]
    rows.append(["clock offset, ms", *offsets])
    rows.append(["mm per pixel at the board", *(f"{millimetres_per_pixel(found, c):.3f}" for c in _all(found))])
    return figures_table(head, rows)


def _all(found: Calibration) -> range:
    return range(len(found.views.names))


def _left_out(found: Calibration, dropped: Mapping[tuple[str, str], int]) -> str:
    rows = [f"{name}: {count} views, {reason}" for (name, reason), count in sorted(dropped.items())]
    rows.append(f"{found.dropped} single corners lay apart from all others and were left out")
    return "<ul>" + "".join(f"<li>{escape(row)}</li>" for row in rows) + "</ul>"


def _each(found: Calibration, draw: object) -> str:
    assert callable(draw)
    figures = [
        f"<figure>{draw(found, c)}<figcaption>{escape(found.views.names[c])}</figcaption></figure>" for c in _all(found)
    ]
    return f'<div class="pictures">{"".join(figures)}</div>'


def _frame(found: Calibration, camera: int, inside: str) -> str:
    w, h = found.views.sizes[camera]
    border = f'<rect class="frame" width="{w}" height="{h}" fill="none" stroke="var(--faint)" stroke-width="4"/>'
    return f'<svg class="plot" viewBox="0 0 {w} {h}" role="img" aria-label="picture">{border}{inside}</svg>'


def _corners(found: Calibration, camera: int) -> str:
    pixels = found.views.pixels[found.views.camera == camera].reshape(-1, 2)
    pixels = pixels[np.isfinite(pixels[:, 0])]
    held = coverage(found, camera).parts
    w, h = found.views.sizes[camera]
    rows, columns = held.shape
    words = "".join(
        f'<text x="{(x + 0.5) * w / columns:.0f}" y="{(y + 0.5) * h / rows:.0f}" text-anchor="middle" '
        f'style="font-size:34px">{int(held[y, x])}</text>'
        for y in range(rows)
        for x in range(columns)
    )
    dots = "".join(f'<circle class="estimate" cx="{x:.0f}" cy="{y:.0f}" r="4"/>' for x, y in pixels)
    return _frame(found, camera, dots + words)


def _rest(found: Calibration, camera: int) -> str:
    rows = found.views.camera == camera
    pixels, rest = found.views.pixels[rows].reshape(-1, 2), found.fit.residuals[rows].reshape(-1, 2)
    known = np.isfinite(pixels[:, 0])
    ends = pixels + STRETCH * rest
    lines = "".join(
        f'<path class="truth" stroke-width="3" d="M{a:.0f} {b:.0f}L{c:.0f} {d:.0f}"/>'
        for (a, b), (c, d) in zip(pixels[known], ends[known], strict=True)
    )
    return _frame(found, camera, lines)


def _colour(value: float) -> str:
    return next((style for most, style in SCALE if value <= most), BEYOND)


def _volume(error: VolumeError) -> str:
    """Layers of the volume as squares, coloured by the error; x to the right, y down, as the first camera sees them."""
    at = error.points.reshape(SIDE, SIDE, SIDE, 3)
    values = error.error.reshape(SIDE, SIDE, SIDE)
    layers = [_layer(values[:, :, z], float(at[0, 0, z, 2])) for z in range(SIDE)]
    edges = ["0", *(f"{most:g}" for most, _ in SCALE)]
    keys = [f"{a} to {b} mm" for a, b in pairwise(edges)] + [f"more than {edges[-1]} mm"]
    styles = [style for _, style in SCALE] + [BEYOND]
    legend = "".join(_key(style, words) for style, words in zip(styles, keys, strict=True)) + _key(
        "", "not seen by two"
    )
    low, high = error.points.min(0), error.points.max(0)
    text = " x ".join(f"{b - a:.0f}" for a, b in zip(low, high, strict=True))
    return (
        f'<p class="note">{text} mm</p><div class="pictures">{"".join(layers)}</div><div class="legend">{legend}</div>'
    )


def _layer(values: Array, z: float) -> str:
    cells = []
    for x in range(SIDE):
        for y in range(SIDE):
            value = values[x, y]
            fill = _colour(value) if np.isfinite(value) else UNSEEN
            words = f"{value:.3f} mm" if np.isfinite(value) else "not seen by two cameras"
            place = f'x="{20 * x + 1}" y="{20 * y + 1}" width="18" height="18"'
            cells.append(f'<rect style="fill:{fill}" {place}><title>{words}</title></rect>')
    box = f'<svg class="plot heat" viewBox="0 0 {20 * SIDE} {20 * SIDE}">{"".join(cells)}</svg>'
    return f"<figure>{box}<figcaption>z = {z:.0f} mm</figcaption></figure>"


def _key(fill: str, words: str) -> str:
    patch = f'<svg viewBox="0 0 18 10"><rect style="fill:{fill}" width="18" height="10"/></svg>'
    return f"<span>{patch}{escape(words)}</span>"


def _pictures(pictures: Mapping[str, bytes]) -> str:
    figures = []
    for name, data in pictures.items():
        text = base64.b64encode(data).decode()
        image = f'<img alt="{escape(name)}" src="data:image/jpeg;base64,{text}"/>'
        figures.append(f"<figure>{image}<figcaption>{escape(name)}</figcaption></figure>")
    return f'<div class="pictures">{"".join(figures)}</div>'
