"""What all reports share: one HTML page that needs no network, and charts as plain SVG text without a script."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from hardware.process.system import provenance


def document(kind: str, title: str, lead: str, body: Sequence[str], footer: str) -> str:
    """The whole page. kind: of report; lead: the verdict in words; body: parts as HTML; the rest is plain text.

    It ends with what made it: date, machine, version, inputs.
    """
    style = (files("hardware.report") / "report.css").read_text(encoding="utf-8")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(f"{title} · {kind}")}</title>'
        f'<meta name="viewport" content="width=device-width"><style>\n{style}</style></head><body><main>\n'
        f'<header><div class="kind">{escape(kind)}</div><h1>{escape(title)}</h1>'
        f'<p class="lead">{escape(lead)}</p></header>\n'
        f"{chr(10).join(body)}\n<footer><div>{escape(footer)}</div><div>{escape(provenance().sentence())}</div></footer></main></body></html>\n"
    )


def tile(value: str, unit: str, caption: str) -> str:
    """One figure, large."""
    return f'<div class="tile"><b>{escape(value)}<small>{escape(unit)}</small></b><span>{escape(caption)}</span></div>'


def row_of_tiles(tiles: Sequence[str]) -> str:
    """Tiles side by side."""
    return f'<div class="tiles">{"".join(tiles)}</div>'


def section(title: str, explanation: str, body: str) -> str:
    """A titled card; `body` is HTML."""
    return f"<section><h2>{escape(title)}</h2><p>{escape(explanation)}</p>{body}</section>"


def figures_table(head: Sequence[str], rows: Sequence[Sequence[str]], last_total: bool = False) -> str:
    """A table of plain text; last_total: whether its last row stands out."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = []
    for i, row in enumerate(rows):
        style = ' class="total"' if last_total and i == len(rows) - 1 else ""
        lines.append(f"<tr{style}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>")
    return f"<table><thead><tr>{top}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def line_key(style: str, text: str) -> str:
    """An entry of a legend: a line in a CSS class, and what it is."""
    return f'<span><svg viewBox="0 0 18 10"><path class="{style}" d="M0 5H18"/></svg>{escape(text)}</span>'


def dot_key(style: str, text: str) -> str:
    """An entry of a legend: a dot in a CSS class, and what it is."""
    return f'<span><svg viewBox="0 0 18 10"><circle class="{style}" cx="9" cy="5" r="4"/></svg>{escape(text)}</span>'


def area_key(style: str, text: str) -> str:
    """An entry of a legend: a patch in a CSS class, and what it is."""
    patch = f'<svg viewBox="0 0 18 10"><rect class="{style}" width="18" height="10" rx="2"/></svg>'
    return f"<span>{patch}{escape(text)}</span>"


def chart(width: float, height: float, label: str, inside: str) -> str:
    """A drawing of `width` x `height` px as one SVG element; it shrinks with the window, to MIN_SCALE at least."""
    box = f'viewBox="0 0 {width:g} {height:g}" style="min-width:{MIN_SCALE * width:.0f}px"'
    return f'<svg class="plot" {box} role="img" aria-label="{escape(label)}">{inside}</svg>'


def legend(keys: Sequence[str]) -> str:
    """The entries of a legend in a row."""
    return f'<div class="legend">{"".join(keys)}</div>'


NAMELESS = "chart, as the words above it say"  # for a screen reader, of a chart without a label
MIN_SCALE = 0.75  # of a chart, so that its words stay readable; in a narrower window the card scrolls
VIEW_WIDTH_PX, VIEW_HEIGHT_PX = 440, 300  # of one of two pictures that stand side by side
MAX_LINE_POINTS = 3000  # a line is thinned to its extremes beyond: no screen shows more
CURVE_SPACING = 2.0  # px between the points of a curve that is drawn


@dataclass(frozen=True, slots=True)
class Scale:
    """Values from `low` to `high` along `start` to `end` px, linearly or by their logarithm."""

    low: float
    high: float
    start: float
    end: float
    logarithmic: bool = False

    def __call__(self, values: Array) -> Array:
        """Positions (N,), px, of values (N,); outside values are moved to the border of what is drawn."""
        v = np.clip(np.asarray(values, float), self.low, self.high)
        low, high = self.low, self.high
        if self.logarithmic:
            v, low, high = np.log10(v), math.log10(low), math.log10(high)
        return np.asarray(self.start + (v - low) / (high - low) * (self.end - self.start))

    def ticks(self, count: int = 5) -> list[float]:
        """About `count` round values inside; on a logarithmic scale the powers of ten, or 1, 2 and 5 of each."""
        if self.logarithmic:
            first, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
            powers = [10.0**power for power in range(first, last + 1)]
            finer = [k * 10.0**power for power in range(first - 1, last + 1) for k in (1, 2, 5)]
            return powers if len(powers) > 2 else [v for v in finer if self.low <= v <= self.high]
        step = round_step((self.high - self.low) / count)
        first = math.ceil(self.low / step - 1e-9)
        last = math.floor(self.high / step + 1e-9)
        return [i * step for i in range(first, last + 1)]


def round_step(rough: float) -> float:
    """The smallest of 1, 2, 5, 10 times a power of ten that is at least `rough`."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= rough * (1 - 1e-9))


def spanning(values: Sequence[Array], margin: float = 0.06, min_span: float = 1e-3) -> tuple[float, float]:
    """Low and high that hold all finite `values` with a margin; a span under `min_span` is widened to it."""
    flat = np.concatenate([np.ravel(v) for v in values]) if values else np.empty(0)
    flat = flat[np.isfinite(flat)]
    if not len(flat):
        return 0.0, 1.0
    low, high = float(flat.min()), float(flat.max())
    if high - low < min_span:
        middle = (low + high) / 2
        low, high = middle - min_span / 2, middle + min_span / 2
    pad = margin * (high - low)
    return low - pad, high + pad


def thinned(y: Array, max_count: int = MAX_LINE_POINTS) -> NDArray[np.int64]:
    """Rows (M,) of y (N,) that keep the look of a line: all, or the extremes of each of most / 2 stretches."""
    if len(y) <= max_count:
        return np.arange(len(y))
    selected: list[int] = []
    for rows in np.array_split(np.arange(len(y)), max_count // 2):
        filled = np.where(np.isfinite(y[rows]), y[rows], 0.0)
        selected += sorted({int(rows[filled.argmin()]), int(rows[filled.argmax()])})
    return np.array(selected)


def stretches(usable: NDArray[np.bool_]) -> list[slice]:
    """Runs of neighbouring True in `usable` (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], usable, [False]]).astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


LARGE_TICK = 1e5  # from which six digits may be those that all ticks have in common: s of an uptime of days


def number(value: float) -> str:
    """A tick's label: short, without noise digits."""
    text = f"{value:.6g}" if abs(value) < LARGE_TICK else f"{value:.12g}"
    return "0" if text == "-0" else text.replace("-", "\N{MINUS SIGN}")


class Plot:
    """One chart of `width` x `height` px; things are drawn in the order of the calls."""

    left, right, top, bottom = 56, 14, 28, 26

    def __init__(
        self,
        width: int,
        height: int,
        x: tuple[float, float],
        y: tuple[float, float],
        log_y: bool = False,
        label: str = "",
        x_ticks: bool = True,
    ) -> None:
        self.width, self.height, self.label = width, height, label
        floor = height - (self.bottom if x_ticks else 10)
        self.x = Scale(*x, self.left, width - self.right)
        self.y = Scale(*y, floor, self.top, log_y)
        self._floor = floor
        self._parts: list[str] = []
        self._grid(x_ticks)

    def _grid(self, x_ticks: bool) -> None:
        right = self.width - self.right
        for value in self.y.ticks(max(2, int((self._floor - self.top) / 22))):
            position = self.y(np.array([value]))[0]
            self._parts.append(f'<path class="grid" d="M{self.left} {position:.1f}H{right}"/>')
            self._text(self.left - 8, position + 3.5, number(value), "end")
        for value in self.x.ticks(9) if x_ticks else ():
            position = self.x(np.array([value]))[0]
            self._parts.append(f'<path class="grid" d="M{position:.1f} {self._floor}v4"/>')
            self._text(position, self._floor + 17, number(value), "middle")

    def line(self, x: Array, y: Array, style: str) -> None:
        """A line through (N,) points, broken where y is not finite; a lone point becomes a dot. style: a CSS class."""
        for part in stretches(np.isfinite(y)):
            rows = thinned(y[part])
            points = self._points(x[part][rows], y[part][rows])
            if len(points) == 1:
                self.dots(x[part], y[part], f"{style} lone")
            else:
                self._parts.append(f'<path class="{style}" d="M{"L".join(points)}"/>')

    def way(self, x: Array, y: Array, style: str) -> None:
        """A curve through (N,) finite points that may turn back in x, of each APART px along it one point."""
        across, down = self.x(x), self.y(y)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(across), np.diff(down)))])
        rows = np.append(np.unique(along // CURVE_SPACING, return_index=True)[1], len(x) - 1)
        self._parts.append(f'<path class="{style}" d="M{"L".join(self._points(x[rows], y[rows]))}"/>')

    def band(self, x: Array, low: Array, high: Array, style: str) -> None:
        """The area between low and high (N,), broken where either is not finite."""
        for part in stretches(np.isfinite(low) & np.isfinite(high)):
            rows = thinned((high - low)[part])
            upper = self._points(x[part][rows], high[part][rows])
            lower = self._points(x[part][rows], low[part][rows])[::-1]
            self._parts.append(f'<path class="{style}" d="M{"L".join(upper + lower)}Z"/>')

    def dots(self, x: Array, y: Array, style: str, radius: float = 1.6) -> None:
        """A dot at each finite of (N,) points."""
        keep = np.flatnonzero(np.isfinite(y))
        keep = keep[thinned(y[keep])]
        for a, b in zip(self.x(x[keep]), self.y(y[keep]), strict=True):
            self._parts.append(f'<circle class="{style}" cx="{a:.1f}" cy="{b:.1f}" r="{radius}"/>')

    def bars(self, edges: Array, heights: Array, style: str) -> None:
        """Histogram bars of `heights` (B,) between `edges` (B + 1,)."""
        floor = float(self.y(np.array([self.y.low]))[0])
        for a, b, h in zip(self.x(edges[:-1]), self.x(edges[1:]), heights, strict=True):
            if h > 0:
                top = min(float(self.y(np.array([h]))[0]), floor - 1.5)  # one frame set must still be seen
                place = f'x="{a + 0.5:.1f}" y="{top:.1f}" width="{max(b - a - 1, 1):.1f}" height="{floor - top:.1f}"'
                self._parts.append(f'<rect class="{style}" {place} rx="1"/>')

    def shade(self, start: Array, end: Array, style: str, titles: Sequence[str] = ()) -> None:
        """The whole height between start and end (N,) along x; titles: N, told of each to whoever points at it."""
        for i, (a, b) in enumerate(zip(self.x(start), self.x(end), strict=True)):
            place = f'x="{a:.1f}" y="{self.top}" width="{max(b - a, 0.8):.1f}" height="{self._floor - self.top}"'
            title = f"<title>{escape(titles[i])}</title>" if titles else ""
            self._parts.append(f'<rect class="{style}" {place}>{title}</rect>')

    def mark(self, x: float, text: str, style: str) -> None:
        """A vertical line at x with a word beside it."""
        position = float(self.x(np.array([x]))[0])
        self._parts.append(f'<path class="{style}" d="M{position:.1f} {self.top}V{self._floor}"/>')
        self._text(position, self.top - 5, text, "middle")

    def level(self, y: float, text: str, style: str) -> None:
        """A horizontal line at y with a word at its right end, if y is inside."""
        if self.y.low <= y <= self.y.high:
            position = float(self.y(np.array([y]))[0])
            right = self.width - self.right
            self._parts.append(f'<path class="{style}" d="M{self.left} {position:.1f}H{right}"/>')
            self._text(right, position - 4, text, "end")

    def svg(self) -> str:
        """The chart as one SVG element."""
        name = f'<text class="label" x="{self.left}" y="{self.top - 12}">{escape(self.label)}</text>'
        return chart(self.width, self.height, self.label or NAMELESS, f"{''.join(self._parts)}{name}")

    def _text(self, x: float, y: float, text: str, anchor: str) -> None:
        attributes = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
        self._parts.append(f'<text class="tick" {attributes}>{escape(text)}</text>')

    def _points(self, x: Array, y: Array) -> list[str]:
        return [f"{a:.1f} {b:.1f}" for a, b in zip(self.x(x), self.y(y), strict=True)]


def ribbon(edges: Array, styles: Sequence[str], titles: Sequence[str], x: tuple[float, float], width: int) -> str:
    """A strip of coloured stretches: the i-th from edges[i] to edges[i + 1] (s), equal neighbours joined."""
    scale = Scale(*x, Plot.left, width - Plot.right)
    parts = []
    start = 0
    for i in range(1, len(styles) + 1):
        if i == len(styles) or styles[i] != styles[start]:
            a, b = scale(edges[[start, i]])
            parts.append(
                f'<rect class="{styles[start]}" x="{a:.1f}" y="2" width="{max(b - a, 1.2):.1f}" height="20">'
                f"<title>{escape(titles[start])}</title></rect>"
            )
            start = i
    return chart(width, 24, "states over time", "".join(parts))


def data_url(data: bytes) -> str:
    """A PNG or JPEG as an address that holds it."""
    kind = "png" if data.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def camera_pictures(pictures: Iterable[tuple[str, bytes]]) -> str:
    """Pictures side by side, each with its camera's name."""
    images = ((f'<img alt="{escape(name)}" src="{data_url(data)}"/>', name) for name, data in pictures)
    return figure_row(captioned(image, name) for image, name in images)


def captioned(drawing: str, caption: str) -> str:
    """A figure of a drawing, HTML, and its caption."""
    return f"<figure>{drawing}<figcaption>{escape(caption)}</figcaption></figure>"


def figure_row(figures: Iterable[str]) -> str:
    """Figures side by side."""
    return f'<div class="pictures">{"".join(figures)}</div>'


def two_views(curves: Sequence[tuple[Array, str]]) -> str:
    """Ways (N, 3), mm, each with its class, from the side that shows their farthest place, and from above."""
    every = np.concatenate([curve for curve, _ in curves])
    forward = every[np.argmax(np.hypot(every[:, 0], every[:, 1])), :2]
    forward = forward / max(float(np.hypot(*forward)), 1e-9)
    plots = []
    for label, axes in (
        ("from the side, mm", np.array([[*forward, 0.0], [0.0, 0.0, 1.0]])),
        ("from above, mm", np.eye(3)[:2]),
    ):
        x, y = axes @ every.T
        half = max(float(np.ptp(x)), 1.6 * float(np.ptp(y)), 1.0) * 0.55
        middle_x, middle_y = float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2
        wide, tall = VIEW_WIDTH_PX - Plot.left - Plot.right, VIEW_HEIGHT_PX - Plot.top - Plot.bottom
        high = half * tall / wide
        spans = (middle_x - half, middle_x + half), (middle_y - high, middle_y + high)
        plot = Plot(VIEW_WIDTH_PX, VIEW_HEIGHT_PX, *spans, label=label)
        for curve, style in curves:
            across, up = axes @ curve.T
            plot.way(across, up, style)
            plot.dots(across, up, style, 3.5)
        plots.append(plot.svg())
    return f'<div class="two">{"".join(plots)}</div>'


def open_in_browser(address: str) -> bool:
    """Open an address with what the system opens addresses with; whether there is such a thing. Waits for nothing."""
    import shutil
    import subprocess

    opener = shutil.which("xdg-open") or shutil.which("open")
    if opener is None:
        return False
    null = subprocess.DEVNULL
    subprocess.Popen([opener, address], stdin=null, stdout=null, stderr=null, start_new_session=True)
    return True
