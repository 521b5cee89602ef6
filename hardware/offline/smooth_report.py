"""report.html of a smoothed session: one page, in one file that needs no network."""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.batch.smoothed import Smoothed
from estimation.se3 import Array
from hardware.page import document, figures_table, legend, line_key, row_of_tiles, section, tile
from hardware.report.evaluation import spread
from hardware.report.page import Plot, spanning
from hardware.report.report import HALF, WIDTH, components, deviations
from hardware.report.summary import figure
from hardware.smoothing.judged import DELAYS, Judged
from hardware.smoothing.rhythms import Rhythms

PARTS = 4  # of the recording, whose residuals stand side by side: what a camera drifts by shows there
HIGHEST = 5.0  # Hz, of the spectrum shown


def lead(result: Smoothed, judged: Judged) -> str:
    """The verdict in words."""
    sigma = float(np.median(np.sqrt(np.trace(result.covariance[:, 3:6, 3:6], axis1=1, axis2=2) / 3)))
    words = [
        f"{len(result)} poses and {len(result.map)} landmarks over {result.stamps[-1] - result.stamps[0]:.1f} s; "
        f"an axis of a position is known to {figure(sigma)} mm (median, one sigma)."
    ]
    if judged.live is not None:
        words.append(f"The live run stood {figure(judged.live_rms)} mm off (RMS).")
    if judged.errors is not None:
        ours, live = (None if e is None else figure(spread(e.translation).rmse) for e in judged.errors)
        beside = "" if live is None else f", live {live} mm"
        words.append(f"Against the {_other(judged)}: {ours} mm{beside} (RMS, aligned).")
    for name, rate in (("Breathing", judged.rhythms.breathing), ("Pulse", judged.rhythms.pulse)):
        if np.isfinite(rate):
            words.append(f"{name}: {60 * rate:.1f} a minute.")
    return " ".join(words)


def page(title: str, words: str, result: Smoothed, judged: Judged) -> str:
    """The page as HTML text. words: the verdict."""
    body = [_tiles(result, judged), _trajectory(result, judged), _live(result, judged), _errors(judged)]
    body += [_residuals(result), _spectrum(judged.rhythms), _what_if(judged), _cameras(result)]
    footer = "Lengths in mm, time in s from the session's own clock; poses are base_from_surface."
    return document("stillbed smooth", title, words, [part for part in body if part], footer)


def _other(judged: Judged) -> str:
    return "exact truth" if judged.exact else "measured reference"


def _tiles(result: Smoothed, judged: Judged) -> str:
    sigma = np.sqrt(np.trace(result.covariance[:, 3:6, 3:6], axis1=1, axis2=2) / 3)
    tiles = [tile(figure(1000 * float(np.median(sigma))), "µm", "one sigma of an axis, median")]
    if judged.live is not None:
        tiles.append(tile(figure(1000 * judged.live_rms), "µm", "live against smoothed, RMS"))
    for name, rate in (("breaths a minute", judged.rhythms.breathing), ("beats a minute", judged.rhythms.pulse)):
        if np.isfinite(rate):
            tiles.append(tile(f"{60 * rate:.1f}", "", name))
    return row_of_tiles(tiles)


def _trajectory(result: Smoothed, judged: Judged) -> str:
    values = components(result.states.poses, result.states.poses[0])
    sigma = 2 * deviations(result.states.poses, result.covariance[:, :6, :6])
    span = float(result.stamps[0]), float(result.stamps[-1])
    names = ("x, mm", "y, mm", "z, mm", "turn about x, °", "turn about y, °", "turn about z, °")
    plots = []
    for i in (0, 3, 1, 4, 2, 5):
        plot = Plot(HALF, 165, span, spanning([values[:, i]], 0.12, 0.5), label=names[i])
        plot.band(result.stamps, values[:, i] - sigma[:, i], values[:, i] + sigma[:, i], "spread")
        plot.line(result.stamps, values[:, i], "estimate")
        plots.append(plot.svg())
    text = "Position of the surface's origin in base, and its rotation since the first pose. Time in s."
    keys = legend([line_key("estimate", "smoothed, with two standard deviations")])
    return section("Trajectory", text, f'{keys}<div class="two">{"".join(plots)}</div>')


def _live(result: Smoothed, judged: Judged) -> str:
    if judged.live is None:
        return ""
    apart = judged.live.apart
    stamps, span = result.stamps[judged.live.rows], (float(result.stamps[0]), float(result.stamps[-1]))
    distance = np.linalg.norm(apart[:, 3:], axis=1)
    turn = np.degrees(np.linalg.norm(apart[:, :3], axis=1))
    plots, rows = [], []
    for values, name, unit in ((1000 * distance, "distance, µm", "µm"), (turn, "angle, °", "°")):
        plot = Plot(WIDTH, 150, span, (0.0, max(float(values.max()) * 1.08, 1e-3)), label=name)
        plot.line(stamps, values, "estimate")
        plots.append(plot.svg())
        s = spread(values)
        rows.append([f"live from smoothed, {unit}", *(figure(v) for v in (s.median, s.rmse, s.p95, s.max))])
    table = figures_table(["", "median", "RMSE", "95 %", "max"], rows)
    text = "The causal run's measured poses, after the constant between the two surface frames that fits best."
    return section("Live against smoothed", text, "".join(plots) + table)


def _errors(judged: Judged) -> str:
    if judged.errors is None:
        return ""
    rows = []
    for name, errors in zip(("smoothed", "live"), judged.errors, strict=True):
        if errors is not None:
            for unit, values in (("mm", errors.translation), ("°", np.degrees(errors.rotation))):
                s = spread(values)
                rows.append([f"{name}, {unit}", *(figure(v) for v in (s.median, s.rmse, s.p95, s.max))])
    text = f"Against the {_other(judged)}, aligned: the best constant over the run."
    return section("Errors", text, figures_table(["", "median", "RMSE", "95 %", "max"], rows))


def _residuals(result: Smoothed) -> str:
    rms, span = result.fitted.rms, (float(result.stamps[0]), float(result.stamps[-1]))
    top = float(np.nanpercentile(rms, 99.5)) * 1.15 if np.isfinite(rms).any() else 1.0
    plot = Plot(WIDTH, 170, span, (0.0, max(top, 0.05)), label="residual, px RMS")
    keys, rows = [], []
    parts = np.array_split(np.arange(len(result)), PARTS)
    used, seen = result.fitted.used.sum(0), result.fitted.seen.sum(0)
    for i, camera in enumerate(result.rig.cameras):
        plot.line(result.stamps, rms[:, i], f"series c{i % 5}")
        keys.append(line_key(f"series c{i % 5}", camera.name))
        shares = [_mean(rms[part, i]) for part in parts]
        rows.append([camera.name, *(figure(v) for v in shares), f"{100 * used[i] / max(seen[i], 1):.1f} %"])
    head = ["camera, px RMS", *(f"quarter {k + 1}" for k in range(PARTS)), "tracks that agree"]
    text = "What is left of the pixels of the tracks that agree, camera by camera."
    return section("Residuals", text, legend(keys) + plot.svg() + figures_table(head, rows))


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def _spectrum(found: Rhythms) -> str:
    shown = (found.hertz > 0) & (found.hertz <= HIGHEST)
    if shown.sum() < 2:
        return ""
    amplitude = np.maximum(found.amplitude[shown], 1e-6)
    high = float(amplitude.max()) * 1.5
    span = 0.0, float(found.hertz[shown][-1])
    plot = Plot(WIDTH, 190, span, (max(high / 1e4, 1e-5), high), log_y=True, label="amplitude, mm")
    plot.line(found.hertz[shown], amplitude, "estimate")
    for name, rate in (("breathing", found.breathing), ("pulse", found.pulse)):
        if np.isfinite(rate):
            plot.mark(rate, f"{name} {60 * rate:.1f}/min", "median")
    along = ", ".join(f"{v:.2f}" for v in found.direction)
    text = f"Of the origin's motion along the direction in which it moves most, ({along}) in base; frequency in Hz."
    return section("Spectrum", text, plot.svg())


def _what_if(judged: Judged) -> str:
    rows = [
        [f"{1000 * delay:.0f} ms", *(figure(1000 * v) for v in row)]
        for delay, row in zip(DELAYS, judged.late, strict=True)
    ]
    head = ["delay", "held, µm RMS", "95 %", "carried on, µm RMS", "95 %"]
    text = (
        "How far the nozzle, over the middle of the map, would be off by the loop's delay alone, from exposure to "
        "arrival: were the last pose held, or carried on along its twist. The pose itself is taken as known."
    )
    return section("Had the loop been faster or slower", text, figures_table(head, rows))


def _cameras(result: Smoothed) -> str:
    rows = []
    for i, camera in enumerate(result.rig.cameras):
        before = result.calibrated.cameras[i]
        moved = se3.log(se3.inverse(before.base_from_camera) @ camera.base_from_camera)
        lens = camera.matrix - before.matrix
        values = [1000 * float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:])), lens[0, 0], lens[0, 2]]
        clock = f"{1000 * result.offsets[i]:.2f} ± {1000 * result.offset_sigma[i]:.2f}"
        rows.append([camera.name, clock, *(f"{v:.3f}" for v in (*values, lens[1, 2]))])
    head = ["camera", "exposes later, ms", "turned, mrad", "moved, mm", "fx, px", "cx, px", "cy, px"]
    text = (
        "How the cameras stand to their calibration, as this recording has it: clocks against the mean of all, with "
        f"one sigma; places and lenses only with --refine-cameras. Exposures jitter by "
        f"{1000 * result.fitted.jitter:.2f} ms, images by {result.fitted.unrest:.3f} px from frame set to frame set."
    )
    return section("Calibration drift", text, figures_table(head, rows))
