"""report.html of a comparison, and the same in words and figures."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimation.se3 import Array
from hardware.comparing.metrics import ALIGNMENTS, CLAIMED, Compared, statistics
from hardware.page import document, figures_table, legend, line_key, row_of_tiles, section, tile
from hardware.report.evaluation import NEES_BOUND
from hardware.report.page import Plot, spanning
from hardware.report.report import HALF, WIDTH, components
from hardware.report.summary import figure, percent

HEAD = ("", "RMSE", "mean", "median", "std", "max")
STYLES = dict(zip(ALIGNMENTS, ("series c3", "series c1", "series c0", "series c2"), strict=True))
EXPLAINED = (
    "As they stand: nothing is fitted. Aligned, SE(3): the base of the first is moved until the positions lie nearest "
    "(Umeyama, without scale; evo_ape -a). One surface frame: the two runs' surface frames differ by a constant, the "
    "one that fits best is taken out, or the one that one pose tells."
)


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """Errors over time, of the alignment `name`. stamps: (M,) s. translation: (M,) mm. rotation: (M,) rad."""

    name: str
    stamps: Array
    translation: Array
    rotation: Array


def lead(compared: Compared) -> str:
    """The verdict in words."""
    words = [f"{len(compared.stamps)} of {len(compared.estimated)} poses have one beside them in the reference."]
    if compared.gap > 1e-6:
        words.append(f"Their stamps lie {figure(1000 * compared.gap)} ms apart (median).")
    for judged in compared.judged[:-1]:
        off = statistics(judged.absolute.translation).rmse, statistics(np.degrees(judged.absolute.rotation)).rmse
        words.append(f"{judged.name.capitalize().replace('se(3)', 'SE(3)')}: {figure(off[0])} mm, {figure(off[1])}°.")
    if compared.of(ALIGNMENTS[1]) is None:
        words.append("The positions lie on a line and determine no SE(3) alignment.")
    nees = compared.laid.absolute.mean_nees / 6
    if np.isfinite(nees):
        words.append(f"NEES/6: {figure(nees)} laid at one pose, 1 where covariances are honest.")
    return " ".join(words)


def text(compared: Compared) -> str:
    """The verdict and the tables, for a terminal."""
    lines = [lead(compared), ""]
    for title, rows in (("APE", _absolute_rows(compared)), (_relative_title(compared), _relative_rows(compared))):
        lines.append(f"{title:<34}" + "".join(f"{name:>10}" for name in HEAD[1:]))
        lines += [f"  {row[0]:<32}" + "".join(f"{cell:>10}" for cell in row[1:]) for row in rows]
    return "\n".join(lines)


def as_dict(compared: Compared) -> dict[str, Any]:
    """All figures by alignment: mm and degrees."""
    out: dict[str, Any] = {
        "estimated": compared.estimated.name,
        "reference": compared.reference.name,
        "reference_is_exact": compared.reference.trajectory.exact,
        "pairs": len(compared.stamps),
        "stamp_gap_s": compared.gap,
        "delta_poses": compared.delta,
    }
    for judged in compared.judged:
        out[judged.name] = {
            "ape": _both(judged.absolute.translation, judged.absolute.rotation),
            "rpe": _both(judged.relative.translation, judged.relative.rotation),
            "nees_over_6": judged.absolute.mean_nees / 6,
            "nees_inside_95": judged.absolute.nees_inside,
        }
    return out


def page(compared: Compared) -> str:
    """The page as HTML text."""
    body = [_tiles(compared), _trajectory(compared), _absolute(compared), _relative(compared), _consistency(compared)]
    title = f"{_short(compared.estimated.name)} by {_short(compared.reference.name)}"
    footer = "Lengths in mm, time in s from the session's own clock; poses are base_from_surface. Scale is not fitted."
    return document("stillbed compare", title, lead(compared), [part for part in body if part], footer)


def _both(translation: Array, rotation: Array) -> dict[str, Any]:
    return {
        "translation_mm": asdict(statistics(translation)),
        "rotation_deg": asdict(statistics(np.degrees(rotation))),
    }


def _tiles(compared: Compared) -> str:
    tiles = [tile(str(len(compared.stamps)), "", "pairs of poses")]
    for judged in compared.judged[:-1]:
        rmse = statistics(judged.absolute.translation).rmse
        tiles.append(tile(figure(1000 * rmse), "µm", f"APE {judged.name}, RMSE"))
    nees = compared.laid.absolute.mean_nees / 6
    if np.isfinite(nees):
        tiles.append(tile(figure(nees), "", f"NEES / 6, {compared.laid.name}"))
    return row_of_tiles(tiles)


def _trajectory(compared: Compared) -> str:
    judged = compared.fitted
    values, expected = (components(poses, judged.reference[0]) for poses in (judged.estimated, judged.reference))
    plots = []
    for i in (0, 3, 1, 4, 2, 5):
        name = ("x, mm", "y, mm", "z, mm", "turn about x, °", "turn about y, °", "turn about z, °")[i]
        plot = Plot(HALF, 165, _span(compared), spanning([values[:, i], expected[:, i]], 0.12, 0.5), label=name)
        plot.line(compared.stamps, expected[:, i], "truth")
        plot.line(compared.stamps, values[:, i], "estimate")
        plots.append(plot.svg())
    keys = legend(
        [line_key("estimate", _short(compared.estimated.name)), line_key("truth", _short(compared.reference.name))]
    )
    words = "The surface's origin in base and its rotation since the first pose, in one surface frame. Time in s."
    return section("Trajectories", words, f'{keys}<div class="two">{"".join(plots)}</div>')


def _absolute(compared: Compared) -> str:
    lines = [Line(j.name, compared.stamps, j.absolute.translation, j.absolute.rotation) for j in compared.judged]
    table = figures_table(HEAD, _absolute_rows(compared))
    return section("Absolute pose error (APE)", EXPLAINED, _error_plots(compared, lines) + table)


def _relative(compared: Compared) -> str:
    last = compared.fitted
    line = Line(last.name, compared.stamps[last.relative.rows], last.relative.translation, last.relative.rotation)
    over = _poses(compared.delta)
    words = f"How far the change over {over} is off; an alignment of the base alone changes none of it."
    table = figures_table(HEAD, _relative_rows(compared))
    return section("Relative pose error (RPE)", words, _error_plots(compared, [line]) + table)


def _error_plots(compared: Compared, lines: list[Line]) -> str:
    keys = legend([line_key(STYLES[line.name], line.name) for line in lines])
    plots = [
        _error_plot(compared, lines, [line.translation for line in lines], "distance, mm"),
        _error_plot(compared, lines, [np.degrees(line.rotation) for line in lines], "angle, °"),
    ]
    return keys + "".join(plots)


def _error_plot(compared: Compared, lines: list[Line], values: list[Array], label: str) -> str:
    positive = np.concatenate([v[v > 1e-9] for v in values])
    high = max(float(positive.max(initial=0.0)) * 1.5, 1e-4)
    low = max(float(np.percentile(positive, 1)) / 2, high / 1e5) if len(positive) else high / 10
    plot = Plot(WIDTH, 170, _span(compared), (min(low, high / 10), high), log_y=True, label=label)
    for line, errors in zip(lines, values, strict=True):
        plot.line(line.stamps, errors, STYLES[line.name])
    return plot.svg()


def _consistency(compared: Compared) -> str:
    nees = compared.laid.absolute.nees
    shown = np.isfinite(nees) & (nees > 1e-6)  # the first pose's is nothing by definition
    if not shown.any():
        return ""
    high = max(float(nees[shown].max()) * 1.3, 2 * NEES_BOUND)
    low = max(float(np.percentile(nees[shown], 1)) / 2, 1e-2)
    plot = Plot(WIDTH, 170, _span(compared), (min(low, 1.0), high), log_y=True, label=f"NEES, {compared.laid.name}")
    plot.line(compared.stamps[shown], nees[shown], "estimate")
    plot.level(NEES_BOUND, "95 %", "limit")
    plot.level(6.0, "6", "median")
    claimed = [judged.absolute for judged in compared.judged if judged.name in CLAIMED]
    rows = [
        [name, figure(each.mean_nees / 6), percent(each.nees_inside)]
        for name, each in zip(CLAIMED, claimed, strict=True)
    ]
    words = "Squared errors in parts of the covariance that is claimed; six on average where that is honest."
    if not compared.reference.trajectory.exact:
        words += " The reference is no exact truth: its own error counts as well."
    table = figures_table(["", "NEES / 6", f"under {NEES_BOUND:.1f}, where 95 % should be"], rows)
    return section("Consistency (NEES)", words, plot.svg() + table)


def _absolute_rows(compared: Compared) -> list[list[str]]:
    return [
        row for j in compared.judged for row in _rows(j.name, j.absolute.translation, np.degrees(j.absolute.rotation))
    ]


def _relative_rows(compared: Compared) -> list[list[str]]:
    return [
        row for j in compared.judged for row in _rows(j.name, j.relative.translation, np.degrees(j.relative.rotation))
    ]


def _rows(name: str, translation: Array, rotation: Array) -> list[list[str]]:
    rows = []
    for unit, values in (("mm", translation), ("°", rotation)):
        s = statistics(values)
        rows.append([f"{name}, {unit}", *(figure(v) for v in (s.rmse, s.mean, s.median, s.std, s.max))])
    return rows


def _relative_title(compared: Compared) -> str:
    return f"RPE over {_poses(compared.delta)}"


def _poses(count: int) -> str:
    return "one pose" if count == 1 else f"{count} poses"


def _short(name: str) -> str:
    """A path's last two parts: whose file it is, and which."""
    return "/".join(Path(name).parts[-2:])


def _span(compared: Compared) -> tuple[float, float]:
    return float(compared.stamps[0]), float(compared.stamps[-1])
