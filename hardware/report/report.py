"""report.html of `stillbed track`: one run on one page, in one file that needs no network."""

from __future__ import annotations

import math
from html import escape
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.pose import TrackState
from estimation.se3 import Array, Mask
from hardware.report import page
from hardware.report.evaluation import (
    MAX_TRACKING_ERROR_MM,
    NEES_BOUND,
    Comparison,
    Evaluation,
    clocks_learned,
    consistency_text,
    figure,
    measured_share,
    percent,
    spread,
    verdict,
)

PAGE_CHART_WIDTH = 1030  # px of a chart across the page
HALF_CHART_WIDTH = 480  # px of one of two
MAX_EVENT_ROWS = 40  # rows of the table of state changes


def write_report(path: Path, result: Evaluation) -> None:
    """Write the page to `path`."""
    path.write_text(track_page(result), encoding="utf-8")


def track_page(result: Evaluation) -> str:
    """The page as HTML text."""
    body = [_tiles(result), *sections(result)]
    footer = "Lengths in mm, time in s from the session's own clock; poses are base_from_surface."
    kind = f"stillbed track, method {result.method}" if result.method else "stillbed track"
    return page.document(kind, result.title or "a session", " ".join(verdict(result)), body, footer)


def sections(result: Evaluation) -> list[str]:
    """The parts of the page that follow its tiles, as HTML."""
    parts = _states, _trajectory, _motion, _errors, _tracks, _clocks, _latency
    return [html for part in parts if (html := part(result))]


def _tiles(result: Evaluation) -> str:
    tiles = [page.tile(percent(measured_share(result)).removesuffix(" %"), "%", "of the frame sets tracked")]
    if result.comparison is not None:
        start, aligned = result.comparison.start, result.comparison.aligned
        tiles.append(page.tile(figure(spread(start.translation).median), "mm", "median error, first pose's frame"))
        tiles.append(
            page.tile(figure(math.degrees(spread(start.rotation).median)), "°", "median error, first pose's frame")
        )
        tiles.append(page.tile(figure(spread(aligned.translation).rmse), "mm", "RMSE, aligned"))
    if len(result.latency.total):
        timings = result.latency
        tiles.append(page.tile(f"{timings.p50[-1]:.1f}", "ms", f"per pose; 99 % under {timings.p99[-1]:.1f} ms"))
    return page.row_of_tiles(tiles)


def time_range(stamps: Array) -> tuple[float, float]:
    """First and last of the stamps (s), never equal."""
    low, high = (float(stamps[0]), float(stamps[-1])) if len(stamps) else (0.0, 1.0)
    return low, high if high > low else low + 1.0


def _followed(result: Evaluation) -> tuple[float, float]:
    """First and last instant (s) from the first map on; of the whole run where there never was one."""
    stamps = result.table.stamps
    tracked = stamps[~result.table.is_state(TrackState.INITIALISING)]
    return time_range(tracked if len(tracked) else stamps)


def _states(result: Evaluation) -> str:
    table = result.table
    if not len(table):
        return page.section("States", "The session has no frame sets.", "")
    last = table.stamps[-1] + (np.median(np.diff(table.stamps)) if len(table) > 1 else 1.0)
    names = [state.value for state in table.states]
    titles = [f"{s:.2f} s: {n}. {why}" for s, n, why in zip(table.stamps, names, table.reasons, strict=True)]
    strip = page.ribbon(np.append(table.stamps, last), names, titles, time_range(table.stamps), PAGE_CHART_WIDTH)
    keys = [page.area_key(name, f"{name} {percent(share)}") for name, share in result.shares.items() if share > 0]
    text = "TRACKING and DEGRADED: measured pose. COASTING: predicted pose. LOST: no usable pose."
    if math.isfinite(result.since):
        text += f" Shares are counted from {round(result.since, 2) + 0.0:.2f} s, the instant of the region of interest."
    return page.section("States", text, strip + page.legend(keys) + _events(result))


def _events(result: Evaluation) -> str:
    """The state changes as a table, with the reason the tracker gave."""
    table = result.table
    changes = [i for i in range(len(table)) if i == 0 or table.states[i] is not table.states[i - 1]]
    rows = "".join(
        f"<tr><td>{table.stamps[i]:.2f} s</td><td class=words>{table.states[i].value}</td>"
        f"<td class=words>{escape(table.reasons[i])}</td></tr>"
        for i in changes[:MAX_EVENT_ROWS]
    )
    hidden_count = len(changes) - MAX_EVENT_ROWS
    rest = f"<p>and {hidden_count} more, all in poses.csv</p>" if hidden_count > 0 else ""
    return f"<details><summary>{len(changes)} states, with reasons</summary><table>{rows}</table>{rest}</details>"


def components(poses: Array, origin: Array) -> Array:
    """(N, 6): x y z in base, mm, and the rotation vector against `origin` (4, 4), degrees."""
    rotations = se3.log_rotation(origin[:3, :3].T @ poses[:, :3, :3])
    return np.concatenate([poses[:, :3, 3], np.degrees(rotations)], axis=-1)


def deviations(poses: Array, covariance: Array) -> Array:
    """(N, 6): one standard deviation of what `components` shows; rotations to first order."""
    rotations = poses[:, :3, :3]
    position = rotations @ covariance[:, 3:, 3:] @ np.swapaxes(rotations, -1, -2)
    blocks = np.stack([position, covariance[:, :3, :3]], axis=1)  # (N, 2, 3, 3)
    deviations = np.sqrt(np.maximum(np.diagonal(blocks, axis1=2, axis2=3), 0)).reshape(-1, 6)
    return np.asarray(deviations * np.repeat([1, 180 / np.pi], 3))


COMPONENT_NAMES = "x, mm", "y, mm", "z, mm", "rotation about x, °", "rotation about y, °", "rotation about z, °"
COMPONENTS_TEXT = "Position of the surface's origin in base, and rotation relative to the first pose. Time in s."


def component_plots(
    span: tuple[float, float], stamps: Array, curves: dict[str, Array], sigma: Array | None = None
) -> str:
    """Plots of curves (N, 6) of `components` at stamps (N,), s, by their style; position beside rotation.

    sigma: (N, 6) of the last one, about which a band of two is drawn.
    """
    *_, last = curves.values()
    plots = []
    for i in (0, 3, 1, 4, 2, 5):
        limits = page.spanning([curve[:, i] for curve in curves.values()], 0.12, 0.5)
        plot = page.Plot(HALF_CHART_WIDTH, 165, span, limits, label=COMPONENT_NAMES[i])
        if sigma is not None:
            plot.band(stamps, last[:, i] - 2 * sigma[:, i], last[:, i] + 2 * sigma[:, i], "spread")
        for style, curve in curves.items():
            plot.line(stamps, curve[:, i], style)
        plots.append(plot.svg())
    return f'<div class="two">{"".join(plots)}</div>'


def _trajectory(result: Evaluation) -> str:
    table, comparison = result.table, result.comparison
    hidden = table.is_state(TrackState.INITIALISING) | table.is_state(TrackState.LOST)  # no map yet, or no use
    if hidden.all():
        return ""
    origin = table.base_from_surface[int(np.argmin(hidden))]
    values = components(table.base_from_surface, origin)
    sigma = deviations(table.base_from_surface, table.covariance)
    values[hidden], sigma[hidden] = np.nan, np.nan
    truth = np.full((len(table), 6), np.nan)
    keys = [page.line_key("estimate", "estimate, with two standard deviations")]
    if comparison is not None:
        target = comparison.expected @ comparison.start.truth_surface_from_estimated_surface
        truth[comparison.rows] = components(target, origin)
        keys.append(page.line_key("truth", "truth" if comparison.exact else "reference"))
    plots = component_plots(_followed(result), table.stamps, {"truth": truth, "estimate": values}, sigma)
    return page.section("Trajectory", COMPONENTS_TEXT, page.legend(keys) + plots)


def _motion(result: Evaluation) -> str:
    """How far the surface was from its last place of rest, and where its movements began; "" without poses."""
    table = result.table
    if not len(table):
        return ""
    moved = np.where(table.measured, table.moved, np.nan)
    label = "distance from the last place of rest, mm"
    plot = page.Plot(PAGE_CHART_WIDTH, 150, _followed(result), page.spanning([moved], 0.1, 0.3), label=label)
    plot.line(table.stamps, moved, "estimate")
    onsets = np.unique(table.onset[np.isfinite(table.onset)])
    if len(onsets):
        plot.dots(onsets, np.zeros(len(onsets)), "off", 3)
    share = float(np.mean(table.moving[table.measured])) if table.measured.any() else float("nan")
    motion_text = "was never at rest" if share == 1 else f"moved in {100 * share:.0f} % of the measured frame sets"
    start_texts = {0: "no start of a movement was detected", 1: "one start of a movement was detected"}
    text = (
        f"The surface {motion_text}; {start_texts.get(len(onsets), f'{len(onsets)} movement starts were detected')}. "
        "A movement is 0.3 mm or 0.1°; a dot marks the first pose of each."
    )
    keys = [page.line_key("estimate", "middle of the surface, relative to its last place of rest")]
    return page.section("Motion", text, page.legend(keys) + plot.svg())


def _errors(result: Evaluation) -> str:
    comparison = result.comparison
    if comparison is None:
        missing = "The session has no truth.tum or reference.tum, or no measured pose at its instants."
        return page.section("Errors", missing, "")
    translation, rotation = comparison.start.translation, np.degrees(comparison.start.rotation)
    plots = _error_plot(result, comparison, translation, "distance, frame of the first pose, mm", MAX_TRACKING_ERROR_MM)
    plots += _error_plot(result, comparison, rotation, "angle, frame of the first pose, °")
    text = (
        f"Against the {'exact truth' if comparison.exact else 'measured reference, whose error is included'}, "
        f"at {len(comparison.rows)} measured poses. First pose's frame: the transform between the surface "
        "frames is that of the first TRACKING pose; nothing is fitted. Aligned: best constant transform of the run."
    )
    return page.section("Errors", text, plots + _error_table(comparison) + _consistency(comparison))


def _error_plot(result: Evaluation, comparison: Comparison, errors: Array, label: str, limit: float = np.inf) -> str:
    """Errors (M,) over time on a logarithmic scale; those of poses that are off get a dot, `limit` a line."""
    positive = errors[errors > 1e-9]
    high = max(float(positive.max()) * 1.5, 1e-2) if len(positive) else 1.0
    low = max(float(np.percentile(positive, 2)) / 2, high / 1e5) if len(positive) else 0.1
    plot = page.Plot(PAGE_CHART_WIDTH, 170, _followed(result), (min(low, high / 10), high), log_y=True, label=label)
    stamps, over_time = result.table.stamps, np.full(len(result.table), np.nan)
    over_time[comparison.rows] = errors
    plot.line(stamps, over_time, "estimate")
    plot.level(float(np.median(errors)), "median", "median")
    if math.isfinite(limit):
        plot.level(limit, f"{limit:.0f} mm", "limit")
        plot.dots(stamps[comparison.off], over_time[comparison.off], "off", 3)
    return plot.svg()


def _error_table(comparison: Comparison) -> str:
    rows = []
    for name, errors in (("first pose", comparison.start), ("aligned", comparison.aligned)):
        for unit, values in (("mm", errors.translation), ("°", np.degrees(errors.rotation))):
            s = spread(values)
            rows.append([f"{name}, {unit}", *(figure(v) for v in (s.median, s.rmse, s.p95, s.max))])
    return page.figures_table(["", "median", "RMSE", "95 %", "max"], rows)


def _consistency(comparison: Comparison) -> str:
    start, aligned = comparison.start, comparison.aligned
    inside = percent(aligned.nees_inside) if math.isfinite(aligned.nees_inside) else "–"
    text = (
        f"NEES / 6: {figure(start.mean_nees / 6)} in the frame of the first pose, whose error is in all poses, "
        f"and {figure(aligned.mean_nees / 6)} aligned. "
        f"{inside} of the aligned poses have a NEES under {NEES_BOUND:.1f}; expected: 95 %. "
    )
    if comparison.exact and math.isfinite(start.mean_nees):
        text += f"{consistency_text(start.mean_nees / 6, fixed=False).capitalize()}. "
    if not comparison.exact:
        text += "It is of little use here: it includes the error of the reference."
    return f'<p class="note">{escape(text)}</p>'


def _tracks(result: Evaluation) -> str:
    table = result.table
    if not len(table):
        return ""
    plot = page.Plot(PAGE_CHART_WIDTH, 170, _followed(result), (0.0, max(float(table.used.max(initial=0)) * 1.08, 1.0)))
    keys = []
    counted = ~table.is_state(TrackState.INITIALISING)
    for i, name in enumerate(table.cameras):
        plot.line(table.stamps, np.where(counted, table.used[:, i], np.nan), f"series c{i % 5}")
        middle = np.median(table.used[counted, i]) if counted.any() else 0
        keys.append(page.line_key(f"series c{i % 5}", f"{name}, median {middle:.0f}"))
    text = "Tracks used for the pose, per camera."
    return page.section("Tracks", text, page.legend(keys) + plot.svg())


def _clocks(result: Evaluation) -> str:
    """How much later than stamped each camera exposes, as it was learned; "" where it was not."""
    table = result.table
    if not clocks_learned(table):
        return ""
    known = np.where(table.is_state(TrackState.INITIALISING), np.nan, 1.0)
    offsets, sigmas = 1000 * table.offsets * known[:, None], 1000 * table.offset_sigmas
    limits, keys = page.spanning([offsets], 0.15, 2.0), []
    plot = page.Plot(PAGE_CHART_WIDTH, 150, _followed(result), limits, label="clock offset, ms")
    for i, name in enumerate(table.cameras):
        plot.line(table.stamps, offsets[:, i], f"series c{i % 5}")
        final = f"{name}, at the end {1000 * table.offsets[-1, i]:+.1f} ± {sigmas[-1, i]:.1f} ms"
        keys.append(page.line_key(f"series c{i % 5}", final))
    text = (
        "Clock offset of each camera (exposure minus stamp), relative to the mean of all, and one standard deviation. "
        "It is observable only while the surface moves, and is corrected once it is significant."
    )
    if not np.nan_to_num(offsets).any():
        text += " Here the offsets are not significant, and nothing was corrected."
        return page.section("Clocks", text, page.legend(keys))
    return page.section("Clocks", f"{text} Until then a line stays at zero.", page.legend(keys) + plot.svg())


def _latency(result: Evaluation) -> str:
    timings = result.latency
    text = (
        "From the decoded frames to the pose, without the map refinement, which runs in parallel. The first "
        f"{timings.initial_sets} frame sets, until the first map, took {timings.initialisation:.0f} ms; not counted."
    )
    if not len(timings.total):
        return page.section("Latency", text, "")
    rows = [
        [name, *(f"{v:.2f}" for v in values)]
        for name, *values in zip(timings.stages, timings.p50, timings.p95, timings.p99, timings.max, strict=True)
    ]
    figures = page.figures_table(["stage, ms", "median", "95 %", "99 %", "max"], rows, last_total=True)
    high = max(float(np.percentile(timings.total, 99.5)) * 1.25, 1.0)
    counts, edges = np.histogram(np.minimum(timings.total, high * (1 - 1e-9)), bins=40, range=(0, high))
    plot = page.Plot(HALF_CHART_WIDTH, 210, (0, high), (0, max(float(counts.max()) * 1.1, 1.0)))
    plot.bars(edges, counts.astype(float), "bar")
    plot.mark(float(timings.p50[-1]), "median", "median")
    plot.mark(float(timings.p99[-1]), "99 %", "median")
    caption = '<div class="caption">frame sets by total time, ms</div>'
    return page.section("Latency", text, f'<div class="two"><div>{figures}</div><div>{caption}{plot.svg()}</div></div>')


def error_timeline(error: Array, holds: Mask, width: float, limit: float) -> str:
    """The predicted error (N,), mm, NaN where nothing was extruded, in bins of `width` s, beside its limit, mm.

    held: (N,) bins in which the nozzle was held.
    """
    if not np.isfinite(error).any():
        return "<p>Nothing was extruded.</p>"
    stamps, end = np.asarray((np.arange(len(error)) + 0.5) * width, float), len(error) * width
    plot = page.Plot(900, 220, (0.0, end), page.spanning([error, np.array([0.0, limit])]), label="predicted error, mm")
    runs = np.array([(run.start, run.stop) for run in page.stretches(holds)], float).reshape(-1, 2) * width
    plot.shade(runs[:, 0], runs[:, 1], "holding")
    plot.level(limit, "limit", "limit")
    plot.line(stamps, error, "estimate")
    return page.legend([page.line_key("estimate", "predicted error"), page.area_key("holding", "held")]) + plot.svg()


BEAD_COLOURS = ("var(--grey)", "var(--green)", "var(--amber)", "var(--rose)")  # not printed, good, to the limit, beyond
GOOD_BEAD = 0.5  # of the limit


def bead_map(points: Array, extrude: Mask, errors: Array, limit: float) -> str:
    """A path from above, each bead in the colour of its largest error.

    points: (N, 3) mm of the checkpoints. extrude: (N,) whether on the way to each. errors: (S,) mm of as many stretches
    of equal checkpoints, NaN where nothing was printed. limit: mm.
    """
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    scale = min(PAGE_CHART_WIDTH / max(high[0] - low[0], 1e-6), 420 / max(high[1] - low[1], 1e-6)) * 0.96
    size = scale * (high - low) + 20
    places = np.column_stack([points[:, 0] - low[0], high[1] - points[:, 1]]) * scale + 10
    stretch = (np.arange(len(points)) / max(len(points) - 1, 1) * len(errors)).astype(int)
    begin, end = np.minimum(np.append(0, stretch[:-1]), len(errors) - 1), np.minimum(stretch, len(errors) - 1)
    bead_error = np.array([np.fmax.reduce(errors[a : b + 1]) for a, b in zip(begin, end, strict=True)])
    kind = np.where(
        np.isnan(bead_error), 0, np.where(bead_error <= GOOD_BEAD * limit, 1, np.where(bead_error <= limit, 2, 3))
    )
    parts = []
    for number, colour in enumerate(BEAD_COLOURS):  # the worst on top, as layers lie over each other
        segments = "".join(
            f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}"
            for a, b, cell, out in zip(places[:-1], places[1:], kind[1:], extrude[1:], strict=True)
            if out and cell == number
        )
        parts.append(f'<path style="fill:none;stroke:{colour};stroke-width:2;stroke-linecap:round" d="{segments}"/>')
    keys = f"good: to {GOOD_BEAD * limit:g} mm", f"to the limit of {limit:g} mm", "beyond", "not printed by this run"
    colours = (*BEAD_COLOURS[1:], BEAD_COLOURS[0])
    key_items = [
        f'<span><svg viewBox="0 0 18 10"><path style="stroke:{colour};stroke-width:3" d="M0 5H18"/></svg>{text}</span>'
        for text, colour in zip(keys, colours, strict=True)
    ]
    box = f'viewBox="0 0 {size[0]:.0f} {size[1]:.0f}" style="max-height:440px"'
    return (
        page.legend(key_items)
        + f'<svg class="plot" {box} role="img" aria-label="the beads from above">{"".join(parts)}</svg>'
    )


TRACK_HEIGHT = 420  # px


def track_map(track: Array, path: Array, extrude: Mask) -> str:
    """A way (N, 3) mm, rows of NaN between its pieces, over the beads of a path (M, 3), from above, equal scales."""
    points = np.concatenate([path, track[np.isfinite(track[:, 0])]])
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    wide = PAGE_CHART_WIDTH - page.Plot.left - page.Plot.right
    tall = TRACK_HEIGHT - page.Plot.top - page.Plot.bottom
    scale = 1.06 * max((high[0] - low[0]) / wide, (high[1] - low[1]) / tall, 1e-3)
    x, y = ((m - scale * n / 2, m + scale * n / 2) for m, n in zip((low + high) / 2, (wide, tall), strict=True))
    plot = page.Plot(PAGE_CHART_WIDTH, TRACK_HEIGHT, x, y, label="from above, mm")
    for curve, style in ((np.where(_beads(extrude)[:, None], path, np.nan), "aside"), (track, "estimate")):
        for part in page.stretches(np.isfinite(curve[:, 0])):
            plot.way(curve[part, 0], curve[part, 1], style)
    keys = [page.line_key("estimate", "the nozzle"), page.line_key("aside", "the path's beads")]
    return page.legend(keys) + plot.svg()


def _beads(extrude: Mask) -> Mask:
    """(N,) the checkpoints at which a bead is or begins."""
    return np.asarray(extrude | np.append(extrude[1:], False))
