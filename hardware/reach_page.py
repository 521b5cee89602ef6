"""The page of `stillbed reach`: the path from above, what cannot be printed in another colour, and why."""

from __future__ import annotations

from html import escape

import numpy as np

from estimation.se3 import Array
from hardware.page import document, dot_key, figures_table, legend, line_key, section
from hardware.report.page import MOST_POINTS, Plot, spanning
from planning.path import Path
from planning.robot.reach import REASONS, Reach

WIDTH = 900  # px
GOOD, BAD, WAY = "estimate", "off", "aside"  # classes of report.css


def reach_page(path_name: str, arm: str, text: str, path: Path, found: Reach) -> str:
    """The whole page as HTML. text: the answer as the terminal has it."""
    good, count = int(found.feasible.sum()), len(found.reason)
    rows = [[name, str(int((found.reason == i).sum()))] for i, name in enumerate(REASONS)]
    body = [
        section("From above", "The checkpoints in the surface frame, mm.", _above(path, found)),
        section("Along the path", "The worst over where the surface may be; by checkpoint.", _along(found)),
        section("Why", "Checkpoints by what the arm lacks there.", figures_table(("", "checkpoints"), rows)),
        section("In words", "As in the terminal.", f"<pre>{escape(text)}</pre>"),
    ]
    return document("reach", path_name, f"{arm}: {good} of {count} checkpoints can be printed.", body, "stillbed reach")


def _above(path: Path, found: Reach) -> str:
    """The path seen against the surface's normal; equal scales."""
    places = path.surface_from_nozzle[:, :2, 3]
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    half = max(float(np.ptp(places, axis=0).max()) / 2, 1.0) * 1.08
    box = [(float(m - half), float(m + half)) for m in middle]
    plot = Plot(WIDTH, WIDTH * 2 // 3, (box[0][0] - half / 2, box[0][1] + half / 2), box[1], label="y, mm")
    many = len(places) > MOST_POINTS  # no dot could be told from the next
    plot.way(places[:, 0], places[:, 1], GOOD if many else WAY)
    for style, rows, radius in ((GOOD, found.feasible & (not many), 1.6), (BAD, ~found.feasible, 4.0)):
        plot.dots(places[rows, 0], places[rows, 1], style, radius)
    good = [line_key(GOOD, "can be printed")] if many else [dot_key(GOOD, "can be printed"), line_key(WAY, "path")]
    return legend([*good, dot_key(BAD, "cannot")]) + plot.svg()


def _along(found: Reach) -> str:
    degrees = np.rad2deg([found.bound, found.wrist, found.elbow])
    plots = [
        _plot("to the end of a joint's range, degrees", degrees[0]),
        _plot("to a singular wrist, degrees", degrees[1]),
        _plot("to a singular elbow, degrees", degrees[2]),
        _plot("of a joint's speed, %", 100 * found.speed),
    ]
    return "".join(plots)


def _plot(label: str, values: Array) -> str:
    plot = Plot(WIDTH, 130, (0.0, float(max(len(values) - 1, 1))), spanning([values, np.zeros(1)]), label=label)
    plot.line(np.arange(len(values), dtype=float), values, GOOD)
    return plot.svg()
