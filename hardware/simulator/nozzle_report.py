"""report.html of a simulated print: the error at the nozzle on one page, in one file that needs no network."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path

import numpy as np

from estimation.se3 import Array
from hardware.page import area_key, document, figures_table, legend, line_key, row_of_tiles, section, tile
from hardware.report.page import Plot, stretches, thinned
from hardware.report.report import HALF, WIDTH, sections
from hardware.report.summary import figure
from hardware.simulator.lag import Lag
from hardware.simulator.nozzle_error import NEAR
from hardware.simulator.nozzle_log import row_step
from hardware.simulator.nozzle_run import NozzleResult
from hardware.simulator.nozzle_summary import (
    HEADS,
    PARTS,
    allowed_in_words,
    nozzle_verdict,
    reached_in_words,
    rows_of_errors,
    share,
)
from hardware.simulator.print_picture import KINDS, bead_picture, view_of, way_keys, way_picture

KIND = "stillbed simulate"
FOOTER = (
    "Lengths in mm, time in s of the simulation's own clock. The error is the nozzle's tip less the place on the true "
    "surface that was due at that instant, both known exactly; nothing in the loop sees either."
)
MOST_LAYERS = 6  # bead maps shown
MOST_ROWS = 12_000  # of a log drawn as one line
MOST_SHADES = 1500  # stretches shaded in a chart: finer ones cannot be told apart
WIDE = 2.2  # width over height of the print from which its pictures stand one below the other


def write_nozzle_report(path: Path, result: NozzleResult) -> None:
    """Write the page to `path`."""
    path.write_text(nozzle_page(result), encoding="utf-8")


def nozzle_page(result: NozzleResult) -> str:
    """The page as HTML text."""
    parts = [_badge(result), _tiles(result), _figures(result)]
    if len(result.run.log):
        parts += [_over_time(result), _parts(result), _spread(result), _pictures(result)]
    parts += [_holds(result), _seen(result), _tracking(result), _files(result)]
    lead = " ".join(nozzle_verdict(result))
    return document(KIND, result.run.title or "a print", lead, [part for part in parts if part], FOOTER)


def _badge(result: NozzleResult) -> str:
    if not result.verdicts:
        return ""
    style = "met" if result.met else "missed"
    words = "limits met" if result.met else "limits missed" if result.run.complete else "not complete"
    return f'<div class="badge {style}">{words}</div>'


def _tiles(result: NozzleResult) -> str:
    f = result.figures.nozzle
    return row_of_tiles(
        [
            tile(figure(f.position.p95), "mm", "error, 95 % of the time"),
            tile(figure(f.position.max), "mm", "error, at most"),
            tile(share(f.duty).removesuffix(" %"), "%", "duty: printed of the time it had"),
            tile(figure(np.degrees(f.angle.p95)), "°", "angle, 95 % of the time"),
            tile(figure(1000 * f.lag.seconds), "ms", "lag"),
            tile(share(result.figures.deposit.coverage).removesuffix(" %"), "%", "of the planned area covered"),
        ]
    )


# -- figures


def _figures(result: NozzleResult) -> str:
    rows = [
        [name, *(figure(getattr(spread, part) * scale) for part in PARTS)]
        for name, _, spread, scale in rows_of_errors(result)
    ]
    offset = ", ".join(figure(v) for v in result.figures.nozzle.offset)
    f = result.figures.nozzle
    more = (
        f"Within {NEAR:g} mm for {share(f.near)} of the {f.extruding:.2f} s it printed, of {f.printing:.2f} s it had; "
        f"mean error {offset} mm along x, y and z of the surface."
    )
    errors = figures_table(["", *HEADS], rows) + f'<p class="note">{escape(more)}</p>'
    text = "Over the milliseconds in which material left the nozzle; parts of the error are without their sign."
    if not result.verdicts:
        return section("Error while printing", text, errors)
    return section("Limits", "What the scenario asks of a run.", _limits(result)) + section(
        "Error while printing", text, errors
    )


def _limits(result: NozzleResult) -> str:
    rows = "".join(
        f"<tr><td>{escape(v.bound.words)}</td><td>{escape(reached_in_words(v))}</td>"
        f"<td>{escape(allowed_in_words(v))}</td><td>{_mark(v.met)}</td></tr>"
        for v in result.verdicts
    )
    head = "<tr><th></th><th>reached</th><th>allowed</th><th></th></tr>"
    return f"<table><thead>{head}</thead><tbody>{rows}</tbody></table>"


def _mark(met: bool) -> str:
    return f'<span class="{"met" if met else "missed"}">{"✓ met" if met else "✗ missed"}</span>'


# -- over time


def _span(stamps: Array) -> tuple[float, float]:
    low, high = float(stamps[0]), float(stamps[-1])
    return low, high if high > low else low + 1.0


def _shades(result: NozzleResult, plot: Plot) -> None:
    """Shade the extruding stretches, and the holds with their reasons."""
    log = result.run.log
    step = row_step(log)
    parts = stretches(log.extrude)
    start = np.array([log.stamps[part.start] for part in parts])
    end = np.array([log.stamps[part.stop - 1] + step for part in parts])
    kept = _longest(end - start)
    plot.shade(start[kept], end[kept], "extruding")
    spans = result.figures.nozzle.spans
    start, end = np.array([s.start for s in spans]), np.array([s.end for s in spans])
    kept = _longest(end - start)
    titles = [f"{spans[i].start:.3f} s, for {spans[i].end - spans[i].start:.3f} s: {spans[i].reason}" for i in kept]
    plot.shade(start[kept], end[kept], "holding", titles)


def _longest(lengths: Array) -> Array:
    """Indices of the MOST_SHADES longest, in their order."""
    return np.sort(np.argsort(-lengths, kind="stable")[:MOST_SHADES])


def _line(plot: Plot, stamps: Array, values: Array, style: str) -> None:
    """A line through (N,) rows, however many stretches it is broken into."""
    rows = thinned(values, MOST_ROWS)
    plot.line(stamps[rows], values[rows], style)


def _over_time(result: NozzleResult) -> str:
    log, distance = result.run.log, result.errors.distance
    top = result.figures.nozzle.position.max
    top = max(1.12 * top, 1.2 * NEAR) if np.isfinite(top) else 2 * NEAR
    plot = Plot(WIDTH, 260, _span(log.stamps), (0.0, top), label="error, mm")
    _shades(result, plot)
    _line(plot, log.stamps, np.where(log.extrude, np.nan, distance), "aside")
    plot.level(NEAR, f"{NEAR:g} mm", "limit")
    _line(plot, log.stamps, np.where(log.extrude, distance, np.nan), "estimate")
    keys = [
        line_key("estimate", "error while printing"),
        line_key("aside", "while not printing, where a place was due"),
        area_key("extruding", "printing"),
        area_key("holding", "holding; point at it for the reason"),
    ]
    text = "From the nozzle's tip to where it should have been, over time in s; what is higher is cut off."
    return section("Error over time", text, legend(keys) + plot.svg())


def _parts(result: NozzleResult) -> str:
    log, errors = result.run.log, result.errors
    printed = np.where(log.extrude, 1.0, np.nan)
    values = [*(errors.split.T * printed), np.degrees(errors.angle) * printed]
    told = np.abs(errors.split[log.extrude])
    most = max(float(np.nanmax(told)), 0.05) * 1.1 if np.isfinite(told).any() else 1.0
    angles = values[3][np.isfinite(values[3])]
    names = ("along the path, mm", "across the path, mm", "along the normal, mm", "angle, °")
    plots = []
    for i, (name, value) in enumerate(zip(names, values, strict=True)):
        y = (-most, most) if i < 3 else (0.0, max(float(angles.max(initial=0)) * 1.1, 0.05))
        plot = Plot(WIDTH, 156 if i == 3 else 140, _span(log.stamps), y, label=name, x_ticks=i == 3)
        _line(plot, log.stamps, value, f"series c{i}")
        plots.append(plot.svg())
    text = "Ahead, to the left and out of the surface are positive; the angle is that to the axis of the target."
    return section("Parts of the error", text, "".join(plots))


# -- spread and lag


def _spread(result: NozzleResult) -> str:
    log, f = result.run.log, result.figures.nozzle
    distance = result.errors.distance[log.extrude]
    distance = distance[np.isfinite(distance)]
    if not len(distance):
        return ""
    high = max(float(distance.max()) * 1.02, 1.1 * NEAR)
    counts, edges = np.histogram(distance, bins=48, range=(0, high))
    percents = 100 * counts / len(distance)
    bars = Plot(HALF, 230, (0, high), (0, float(percents.max()) * 1.15), label="")
    bars.bars(edges, percents, "bar")
    bars.mark(f.position.median, "median", "median")
    bars.mark(f.position.p95, "95 %", "median")
    caption = '<div class="caption">% of the time it printed, by error in mm</div>'
    drawn = f"<div>{caption}{bars.svg()}</div><div>{_lag(f.lag)}</div>"
    text = (
        "Left: how often the error was how large. Right: how far the nozzle is from the target (RMS) if one is shifted "
        "against the other in time; where that is least is the lag, positive when the nozzle is late."
    )
    return section("Spread and lag", text, f'<div class="two">{drawn}</div>')


def _lag(lag: Lag) -> str:
    if not len(lag.shifts):
        return '<div class="caption">The target moved too little, or not long enough, to tell a lag.</div>'
    milliseconds = 1000 * lag.shifts
    top = float(lag.distance.max()) * 1.1
    plot = Plot(HALF, 230, (float(milliseconds[0]), float(milliseconds[-1])), (0.0, max(top, 0.01)))
    plot.line(milliseconds, lag.distance, "estimate")
    if np.isfinite(lag.seconds):
        plot.mark(1000 * lag.seconds, f"{figure(1000 * lag.seconds)} ms", "limit")
    return f'<div class="caption">distance in mm, by shift in ms</div>{plot.svg()}'


# -- from above


def _pictures(result: NozzleResult) -> str:
    deposit, f = result.deposit, result.figures.deposit
    if not len(deposit.layers):
        return ""
    view = view_of(deposit, 1.0)
    wide = float((view.high - view.low)[0] / (view.high - view.low)[1]) > WIDE
    width = WIDTH if wide else HALF
    maps = "".join(
        (f'<div class="caption">layer {number}</div>' if len(deposit.layers) > 1 else "")
        + bead_picture(result, i, width)
        for i, number in enumerate(deposit.layers[:MOST_LAYERS])
    )
    kinds = legend([area_key(kind.replace(" ", "-"), kind) for kind in KINDS])
    colours = legend([line_key("plan", "planned"), *(line_key(style, words) for style, words in way_keys())])
    both = f"<div>{maps}{kinds}</div><div>{way_picture(result, width)}{colours}</div>"
    text = (
        f"The surface from above, x to the right. Beads are {result.run.bead:g} mm wide, {f.area:.0f} mm² are planned: "
        f"{share(f.coverage)} got their material, {share(f.gaps)} are gaps (half a bead or more is missing), "
        f"{share(f.overlap)} overlap (1.5 times the plan or more), and an area of {share(f.outside)} lies outside. "
        "Beside it, the way of the tip while it printed, coloured by the error."
    )
    more = len(deposit.layers) - MOST_LAYERS
    rest = f'<p class="note">and {more} more layers</p>' if more > 0 else ""
    return section("Deposited and planned", text, (both if wide else f'<div class="two">{both}</div>') + rest)


# -- the rest


def _holds(result: NozzleResult) -> str:
    holds = result.figures.nozzle.holds
    if not holds:
        return section("Holds", "The arm never held.", "")
    rows = "".join(
        f"<tr><td>{escape(h.reason)}</td><td>{h.count}</td><td>{h.seconds:.3f}</td><td>{h.longest:.3f}</td>"
        f"<td>{h.first:.3f}</td></tr>"
        for h in holds
    )
    head = "".join(f"<th>{cell}</th>" for cell in ("reason", "times", "in all, s", "longest, s", "first at, s"))
    text = "Why the arm stood still until the path was finished; … stands for a number that was not always the same."
    return section("Holds", text, f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>")


def _seen(result: NozzleResult) -> str:
    if not result.run.pictures:
        return ""
    figures = "".join(
        f'<figure><img alt="{escape(name)}" src="{_data(data)}"/><figcaption>{escape(name)}</figcaption></figure>'
        for name, data in result.run.pictures
    )
    return section("What the cameras saw", "One instant of the run.", f'<div class="pictures">{figures}</div>')


def _data(data: bytes) -> str:
    kind = "png" if data.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def _tracking(result: NozzleResult) -> str:
    if result.run.tracking is None:
        return ""
    return '<h2 class="part">Tracking</h2>' + "\n".join(sections(result.run.tracking))


def _files(result: NozzleResult) -> str:
    if not result.run.files:
        return ""
    links = "".join(
        f'<span><a href="{escape(name)}">{escape(name)}</a> {escape(words)}</span>' for name, words in result.run.files
    )
    return section("Files", "Beside this page.", f'<div class="files">{links}</div>')
