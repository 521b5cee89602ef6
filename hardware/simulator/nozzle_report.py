"""report.html of a simulated print: errors, holds, deposit and path of the nozzle, in one self-contained file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from hardware.offline.looks import looks_section
from hardware.report import page
from hardware.report.evaluation import figure
from hardware.report.report import HALF_CHART_WIDTH, PAGE_CHART_WIDTH, sections, time_range
from hardware.simulator.deposit import HALF_BEAD, DepositMap, gaps_and_overlaps, row_step
from hardware.simulator.nozzle_error import NEAR_ERROR, BeadEnds, NozzleLag, profile_edges
from hardware.simulator.nozzle_summary import SPREAD_COLUMNS, NozzleResult, nozzle_verdict, rows_of_errors, share

PAGE_FOOTER = (
    "Lengths in mm, time in s of the simulation's clock. Nozzle error: position of the tip minus its target on "
    "the true surface at that instant. Both are exact, and unknown to the closed loop."
)
MET_MARKS = {True: '<span class="met">✓ met</span>', False: '<span class="missed">✗ missed</span>'}
MAX_LAYERS = 6  # bead maps shown
MAX_LINE_POINTS = 12_000  # of a log drawn as one line
MAX_SHADED_SPANS = 1500  # in a chart: finer ones cannot be distinguished
WIDE_ASPECT = 2.2  # width over height of the print above which its pictures are one below the other
CELL_KINDS = ("as planned", "missing", "double", "outside")  # of cells, in this order; report.css has them as classes
CELL_COLOURS = (0x5C, 0x97, 0xBD), (0xD0, 0x56, 0x3E), (0xE3, 0xA5, 0x3C), (0x84, 0x66, 0xB8)  # red, green, blue
MIN_PICTURE_PX = 1000  # px across a picture's longer side, at least: cells are drawn with smooth edges
ERROR_STEPS = (0.1, 0.25, 0.5, 1.0)  # mm: the error's colours change here
MAX_WAY_PIECES = 4000  # of the tip's path: more cannot be seen
SCALE_HEIGHT_PX = 34  # px below a picture for its scale
MIN_PICTURE_HEIGHT = 40.0  # px, the least height of a picture


@dataclass(frozen=True, slots=True, eq=False)
class TopView:
    """A window onto the surface from above, y up."""

    low: Array  # (2,) mm, its corner of least x and y
    high: Array  # (2,) mm, the opposite corner
    width: float  # px

    @property
    def scale(self) -> float:
        """px per mm."""
        return float(self.width / (self.high[0] - self.low[0]))

    @property
    def height(self) -> float:
        """px."""
        return max(float(self.scale * (self.high[1] - self.low[1])), MIN_PICTURE_HEIGHT)

    def pixels(self, points: Array) -> Array:
        """(N, 2) px of points (N, 2) or (N, 3) in the surface frame, mm; x right, y down."""
        return np.stack([points[:, 0] - self.low[0], self.high[1] - points[:, 1]], axis=1) * self.scale

    def svg(self, body: str, name: str) -> str:
        """The picture with its scale below."""
        length = page.round_step((self.high[0] - self.low[0]) / 6)
        bar = f'<path class="scale" d="M2 {self.height + 10:.1f}v6h{length * self.scale:.1f}v-6"/>'
        bar += f'<text x="2" y="{self.height + 29:.1f}">{length:g} mm</text>'
        return page.chart(self.width, self.height + SCALE_HEIGHT_PX, name, body + bar)


def whole_map_view(deposit: DepositMap, width: float) -> TopView:
    """The whole map."""
    shape = np.array(deposit.planned.shape[:0:-1])  # (W, H)
    return TopView(deposit.low, deposit.low + deposit.cell * shape, width)


def bead_picture(result: NozzleResult, layer: int, width: float) -> str:
    """One layer's beads, planned and laid, by CELL_KINDS, with the planned path. layer: its index in the map."""
    deposit, line = result.deposit, result.line
    view = whole_map_view(deposit, width)
    planned, deposited = deposit.planned[layer], deposit.deposited[layer]
    times = max(1, -(-MIN_PICTURE_PX // max(planned.shape)))
    size = (planned.shape[1] * times, planned.shape[0] * times)
    planned, deposited = (cv2.resize(m, size, interpolation=cv2.INTER_LINEAR) for m in (planned, deposited))
    data = page.data_url(_png(cell_kinds(planned, deposited), np.maximum(planned, deposited)))
    box = f'width="{view.width:g}" height="{view.scale * (view.high[1] - view.low[1]):.1f}"'
    plan = view.pixels(line.points)
    pieces = np.flatnonzero(line.printed & (line.layer == deposit.layers[layer]))
    seams = "".join(_polyline("seam", plan[i : i + 2]) for i in pieces)
    image = f'<image {box} preserveAspectRatio="none" href="{data}"/>'
    return view.svg(image + seams, f"beads of layer {deposit.layers[layer]}")


def cell_kinds(planned: Array, deposited: Array) -> NDArray[np.uint8]:
    """Index in CELL_KINDS (H, W) of each cell, by the bounds of DepositFigures; empty cells count as 0."""
    kind = np.zeros(planned.shape, np.uint8)
    for number, cells in enumerate(gaps_and_overlaps(planned, deposited), 1):
        kind[cells] = number
    kind[(planned < HALF_BEAD) & (deposited >= HALF_BEAD)] = 3
    return kind


def _png(kind: NDArray[np.uint8], thickness: Array) -> bytes:
    """A PNG (H, W) coloured by kind and transparent elsewhere; the first row of the map is at its bottom."""
    picture = np.empty((*kind.shape, 4), np.uint8)
    picture[..., :3] = np.array(CELL_COLOURS, np.uint8)[kind][..., ::-1]
    picture[..., 3] = np.round(255 * np.clip(4 * thickness - 1.5, 0, 1)).astype(np.uint8)  # half a bead is its edge
    encoded, data = cv2.imencode(".png", picture[::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert encoded
    return data.tobytes()


def nozzle_path_picture(result: NozzleResult, width: float) -> str:
    """The planned path, dashed, and the printing tip's path, coloured by the error."""
    view = whole_map_view(result.deposit, width)
    plan = view.pixels(result.line.points)
    lines = [_polyline("plan", plan[i : i + 2]) for i in np.flatnonzero(result.line.printed)]
    log, distance = result.run.log, result.errors.distance
    tip = view.pixels(log.surface_from_tip)
    stride = max(1, int(np.ceil(log.extrude.sum() / MAX_WAY_PIECES)))
    for part in page.stretches(log.extrude & np.isfinite(tip[:, 0])):
        rows = np.append(np.arange(part.start, part.stop - 1, stride), part.stop - 1)
        worst = np.fmax.reduceat(distance, rows)[:-1] if len(rows) > 1 else np.empty(0)
        colour = np.searchsorted(ERROR_STEPS, np.nan_to_num(worst, nan=np.inf))
        for start, end in pairwise(np.append(np.flatnonzero(np.diff(colour, prepend=-1)), len(colour))):
            lines.append(_polyline(f"e{colour[start]}", tip[rows[start : end + 1]]))
    return view.svg("".join(lines), "path of the nozzle, coloured by its error")


def error_legend() -> list[tuple[str, str]]:
    """Class and words of each colour in `nozzle_path_picture`."""
    lows = ("", *(f"{step:g}" for step in ERROR_STEPS))
    between = (f"{a} to {b:g} mm" for a, b in zip(lows[1:], ERROR_STEPS[1:], strict=False))
    words = [f"under {ERROR_STEPS[0]:g} mm", *between, f"over {ERROR_STEPS[-1]:g} mm"]
    return [(f"e{i}", text) for i, text in enumerate(words)]


def _polyline(style: str, points: Array) -> str:
    return f'<path class="{style}" d="M{"L".join(f"{x:.1f} {y:.1f}" for x, y in points)}"/>'


def nozzle_page(result: NozzleResult) -> str:
    """The page as HTML text."""
    parts = [_tiles(result), _figures(result)]
    if result.verdicts:
        text = "limits met" if result.met else "limits missed" if result.run.complete else "not complete"
        parts.insert(0, f'<div class="badge {"met" if result.met else "missed"}">{text}</div>')
    if len(result.run.log):
        parts += [_over_time(result), _parts(result), _spread(result), _pictures(result), _ends(result)]
        parts.append(looks_section(result.run.looks, result.run.path))
    parts += [_holds(result), _camera_pictures(result)]
    if result.run.tracking is not None:
        parts.append('<h2 class="part">Tracking</h2>' + "\n".join(sections(result.run.tracking)))
    if result.run.files:
        links = (f'<a href="{escape(name)}">{escape(name)}</a> {escape(note)}' for name, note in result.run.files)
        files = "".join(f"<span>{link}</span>" for link in links)
        parts.append(page.section("Files", "Beside this page.", f'<div class="files">{files}</div>'))
    lead = " ".join(nozzle_verdict(result))
    title, body = result.run.title or "a print", [part for part in parts if part]
    return page.document("stillbed simulate", title, lead, body, PAGE_FOOTER)


def _tiles(result: NozzleResult) -> str:
    f = result.figures.nozzle
    tiles = (
        (figure(f.position.p95), "mm", "nozzle error, 95 %"),
        (figure(f.position.max), "mm", "nozzle error, largest"),
        (share(f.duty).removesuffix(" %"), "%", "duty cycle"),
        (figure(np.degrees(f.angle.p95)), "°", "angle error, 95 %"),
        (figure(1000 * f.lag.seconds), "ms", "lag"),
        (share(result.figures.deposit.coverage).removesuffix(" %"), "%", "of the planned area covered"),
    )
    return page.row_of_tiles([page.tile(*each) for each in tiles])


def _figures(result: NozzleResult) -> str:
    rows = [
        [name, *(figure(getattr(spread, part) * scale) for part in SPREAD_COLUMNS)]
        for name, _, spread, scale in rows_of_errors(result)
    ]
    offset = ", ".join(figure(v) for v in result.figures.nozzle.offset)
    f = result.figures.nozzle
    time = f"of {f.extruding:.2f} s of printing (planned printing time: {f.printing:.2f} s)"
    within = f"Within {NEAR_ERROR:g} mm for {share(f.near)} {time}"
    more = f"{within}. Mean error along x, y and z of the surface: {offset} mm."
    errors = page.figures_table(["", *SPREAD_COLUMNS.values()], rows) + f'<p class="note">{escape(more)}</p>'
    text = "Over all milliseconds with extrusion. Components of the error are absolute values."
    limits = page.section("Limits", "Limits of the scenario.", _limits(result)) if result.verdicts else ""
    return limits + page.section("Error while printing", text, errors)


def _limits(result: NozzleResult) -> str:
    rows = "".join(
        f"<tr><td>{escape(v.bound.label)}</td><td>{escape(v.value_text)}</td>"
        f"<td>{escape(v.limit_text)}</td><td>{MET_MARKS[v.met]}</td></tr>"
        for v in result.verdicts
    )
    head = "<thead><tr><th></th><th>reached</th><th>allowed</th><th></th></tr></thead>"
    return f"<table>{head}<tbody>{rows}</tbody></table>"


def _shades(result: NozzleResult, plot: page.Plot) -> None:
    log, spans = result.run.log, result.figures.nozzle.spans
    step = row_step(log)
    printing = [(log.stamps[part.start], log.stamps[part.stop - 1] + step) for part in page.stretches(log.extrude)]
    _shade_longest(plot, "extruding", printing)
    titles = [f"{span.start:.3f} s, for {span.end - span.start:.3f} s: {span.reason}" for span in spans]
    _shade_longest(plot, "holding", [(span.start, span.end) for span in spans], titles)


def _shade_longest(plot: page.Plot, style: str, spans: list[tuple[float, float]], titles: Sequence[str] = ()) -> None:
    start, end = np.array(spans).reshape(-1, 2).T
    longest = np.sort(np.argsort(start - end, kind="stable")[:MAX_SHADED_SPANS])
    plot.shade(start[longest], end[longest], style, [titles[i] for i in longest] if titles else ())


def _draw_line(plot: page.Plot, stamps: Array, values: Array, style: str) -> None:
    rows = page.thinned(values, MAX_LINE_POINTS)
    plot.line(stamps[rows], values[rows], style)


def _over_time(result: NozzleResult) -> str:
    log, distance = result.run.log, result.errors.distance
    top = result.figures.nozzle.position.max
    top = max(1.12 * top, 1.2 * NEAR_ERROR) if np.isfinite(top) else 2 * NEAR_ERROR
    plot = page.Plot(PAGE_CHART_WIDTH, 260, time_range(log.stamps), (0.0, top), label="error, mm")
    _shades(result, plot)
    _draw_line(plot, log.stamps, np.where(log.extrude, np.nan, distance), "aside")
    plot.level(NEAR_ERROR, f"{NEAR_ERROR:g} mm", "limit")
    _draw_line(plot, log.stamps, np.where(log.extrude, distance, np.nan), "estimate")
    keys = [
        page.line_key("estimate", "error while printing"),
        page.line_key("aside", "error while not printing, if there is a target"),
        page.area_key("extruding", "printing"),
        page.area_key("holding", "hold; point at it for the reason"),
    ]
    text = "Distance of the nozzle's tip from its target, over time in s. Higher values are cut off."
    return page.section("Error over time", text, page.legend(keys) + plot.svg())


def _parts(result: NozzleResult) -> str:
    log, errors = result.run.log, result.errors
    printed = np.where(log.extrude, 1.0, np.nan)
    values = [*(errors.split.T * printed), np.degrees(errors.angle) * printed]
    split = np.abs(errors.split[log.extrude])
    limit = max(float(np.nanmax(split)), 0.05) * 1.1 if np.isfinite(split).any() else 1.0
    angles = values[3][np.isfinite(values[3])]
    names = ("along the path, mm", "across the path, mm", "along the normal, mm", "angle, °")
    plots = []
    for i, (name, value) in enumerate(zip(names, values, strict=True)):
        y = (-limit, limit) if i < 3 else (0.0, max(float(angles.max(initial=0)) * 1.1, 0.05))
        height = 156 if i == 3 else 140
        plot = page.Plot(PAGE_CHART_WIDTH, height, time_range(log.stamps), y, label=name, x_ticks=i == 3)
        _draw_line(plot, log.stamps, value, f"series c{i}")
        plots.append(plot.svg())
    text = "Positive: ahead, to the left, out of the surface. Angle: between the axes of nozzle and target."
    return page.section("Components of the error", text, "".join(plots))


def _spread(result: NozzleResult) -> str:
    log, f = result.run.log, result.figures.nozzle
    distance = result.errors.distance[log.extrude]
    distance = distance[np.isfinite(distance)]
    if not len(distance):
        return ""
    high = max(float(distance.max()) * 1.02, 1.1 * NEAR_ERROR)
    counts, edges = np.histogram(distance, bins=48, range=(0, high))
    percents = 100 * counts / len(distance)
    bars = page.Plot(HALF_CHART_WIDTH, 230, (0, high), (0, float(percents.max()) * 1.15), label="")
    bars.bars(edges, percents, "bar")
    bars.mark(f.position.median, "median", "median")
    bars.mark(f.position.p95, "95 %", "median")
    caption = '<div class="caption">share of the printing time in %, by error in mm</div>'
    charts = f"<div>{caption}{bars.svg()}</div><div>{_lag(f.lag)}</div>"
    text = (
        "Left: distribution of the error. Right: RMS distance of nozzle and target, with one of them shifted in time. "
        "The shift with the least distance is the lag; positive: the nozzle is late."
    )
    return page.section("Distribution and lag", text, f'<div class="two">{charts}</div>')


def _lag(lag: NozzleLag) -> str:
    if not len(lag.shifts):
        return '<div class="caption">No lag: the motion of the target is too small or too short.</div>'
    milliseconds = 1000 * lag.shifts
    top = float(lag.distance.max()) * 1.1
    plot = page.Plot(HALF_CHART_WIDTH, 230, (float(milliseconds[0]), float(milliseconds[-1])), (0.0, max(top, 0.01)))
    plot.line(milliseconds, lag.distance, "estimate")
    if np.isfinite(lag.seconds):
        plot.mark(1000 * lag.seconds, f"{figure(1000 * lag.seconds)} ms", "limit")
    return f'<div class="caption">distance in mm, by shift in ms</div>{plot.svg()}'


def _pictures(result: NozzleResult) -> str:
    deposit, f = result.deposit, result.figures.deposit
    if not len(deposit.layers):
        return ""
    view = whole_map_view(deposit, 1.0)
    extent = view.high - view.low
    wide = float(extent[0] / extent[1]) > WIDE_ASPECT
    width = PAGE_CHART_WIDTH if wide else HALF_CHART_WIDTH
    maps = "".join(
        (f'<div class="caption">layer {number}</div>' if len(deposit.layers) > 1 else "")
        + bead_picture(result, i, width)
        for i, number in enumerate(deposit.layers[:MAX_LAYERS])
    )
    kinds = page.legend([page.area_key(kind.replace(" ", "-"), kind) for kind in CELL_KINDS])
    colours = page.legend([page.line_key(*entry) for entry in (("plan", "planned"), *error_legend())])
    both = f"<div>{maps}{kinds}</div><div>{nozzle_path_picture(result, width)}{colours}</div>"
    text = (
        f"The surface from above, x to the right. Beads are {result.run.bead:g} mm wide, {f.area:.0f} mm² are planned: "
        f"{share(f.coverage)} are covered, {share(f.gaps)} are gaps (half a bead or more is missing), "
        f"{share(f.overlap)} overlap (1.5 times the plan or more), and an area of {share(f.outside)} lies outside. "
        "The other picture shows the path of the tip while printing, coloured by the error."
    )
    more = len(deposit.layers) - MAX_LAYERS
    rest = f'<p class="note">and {more} more layers</p>' if more > 0 else ""
    return page.section("Deposited and planned", text, (both if wide else f'<div class="two">{both}</div>') + rest)


MAX_DRAWN_ENDS = 200  # beads in a chart: more cannot be distinguished


def _ends(result: NozzleResult) -> str:
    """Beginnings and ends of beads: a table, and profiles of the material about them."""
    m = result.figures.material
    if not len(m.beginnings.error):
        return ""
    rows, charts = [], []
    for name, ends in (("start", m.beginnings), ("end", m.ends)):
        missing, excess = int(np.isnan(ends.error).sum()), float(ends.excess.mean()) if len(ends.excess) else np.nan
        values = ends.median, ends.size.p95, ends.size.max, excess, ends.blob
        rows.append([f"{name}: {len(ends.error)}, {missing} not printed", *map(figure, values)])
        charts.append(f"<div>{ends_chart(ends, f'around the {name} of beads', HALF_CHART_WIDTH)}</div>")
    head = ("", "median, mm", "95 %, mm", "max, mm", "excess, mean, mm³", "excess, max, mm³")
    open_text = "not known" if np.isnan(m.open_outside) else f"{1000 * m.open_outside:.0f} ms"
    note = (
        f"Deposit: {m.volume:.1f} of {m.planned_volume:.1f} mm³, {figure(m.ooze)} mm³ outside beads. Flow outside "
        f"of printing moves: {1000 * m.flow_outside:.0f} ms; dispenser commanded open outside of them: "
        f"{open_text}."
    )
    text = (
        "Errors along the path: above 0, material starts or ends later than planned. Excess: material within 1 mm of a "
        "bead's end minus the plan. Charts: deposited / planned material around each start and end, by mm of the path."
    )
    body = page.figures_table(head, rows) + f'<p class="note">{escape(note)}</p>'
    return page.section("Starts and ends of beads", text, body + f'<div class="two">{"".join(charts)}</div>')


def ends_chart(ends: BeadEnds, label: str, width: int) -> str:
    """Profile of laid by planned material about each bead's beginning or end, by mm of the path; and the median."""
    edges = profile_edges()
    at = (edges[1:] + edges[:-1]) / 2
    top = max(1.5, float(ends.profile.max(initial=0.0)) * 1.1)
    plot = page.Plot(width, 230, (float(edges[0]), float(edges[-1])), (0.0, min(top, 4.0)))
    plot.level(1.0, "as planned", "limit")
    for each in ends.profile[:MAX_DRAWN_ENDS]:
        plot.line(at, np.minimum(each, min(top, 4.0)), "aside")
    if len(ends.profile):
        plot.line(at, np.median(ends.profile, axis=0), "estimate")
    plot.mark(0.0, "planned", "median")
    return f'<div class="caption">{escape(label)}</div>{plot.svg()}'


def _holds(result: NozzleResult) -> str:
    holds = result.figures.nozzle.holds
    if not holds:
        return page.section("Holds", "No holds.", "")
    rows = [(h.reason, str(h.count), *(f"{v:.3f}" for v in (h.seconds, h.longest, h.first))) for h in holds]
    text = "Reasons for holds until the end of the path. … stands for a varying number."
    head = ("reason", "count", "total, s", "longest, s", "first at, s")
    return page.section("Holds", text, page.figures_table(head, rows))


def _camera_pictures(result: NozzleResult) -> str:
    if not result.run.pictures:
        return ""
    return page.section("Camera pictures", "One instant of the run.", page.camera_pictures(result.run.pictures))
