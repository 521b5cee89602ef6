"""`stillbed compare`: absolute and relative pose errors (APE, RPE, NEES) as evo counts them, as text, JSON and page.

The metrics are those of Sturm et al. (IROS 2012) and Zhang and Scaramuzza (IROS 2018). evo needs pandas, matplotlib and
seaborn for a page of arithmetic; a test compares our figures with its own. Scale is never fitted: lengths are
calibrated mm.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.offline.trajectory_files import PoseSeries, read_pose_series, read_truth_series
from hardware.process.progress import prepare_out
from hardware.report.evaluation import (
    NEES_BOUND,
    PoseErrors,
    associate,
    best_constant,
    consistency_text,
    errors_under,
    figure,
    fixed_row,
    percent,
    write_summary,
)
from hardware.report.page import Plot, document, figures_table, legend, line_key, row_of_tiles, section, tile
from hardware.report.report import COMPONENTS_TEXT, PAGE_CHART_WIDTH, component_plots, components

ALIGNMENTS = ("as they stand", "aligned, SE(3)", "one surface frame", "laid at one pose")  # keys of compare.json
ALIGNMENT_LABELS = dict(
    zip(ALIGNMENTS, ("unaligned", "aligned, SE(3)", "common surface frame", "frame of one pose"), strict=True)
)
UNFITTED_ALIGNMENTS = ALIGNMENTS[0], ALIGNMENTS[3]  # those that covariances can be checked under: nothing is fitted
RowNumbers = NDArray[np.int64]
MIN_PAIRS = 3  # pairs of poses: fewer are aligned without a residual


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """evo's statistics of errors, in their own unit (sse: its square); NaN where there are no errors."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float


@dataclass(frozen=True, slots=True, eq=False)
class RelativeErrors:
    """Errors of the change from a pose to the one `delta` poses later, P changes."""

    rows: RowNumbers  # (P,) of the poses at which each change ends
    translation: Array  # (P,) mm
    rotation: Array  # (P,) rad


@dataclass(frozen=True, slots=True, eq=False)
class AlignedErrors:
    """The errors of M poses under one alignment."""

    name: str  # of ALIGNMENTS
    estimated: Array  # (M, 4, 4) mm, aligned
    reference: Array  # (M, 4, 4) mm
    absolute: PoseErrors  # APE and NEES
    relative: RelativeErrors  # RPE

    @property
    def label(self) -> str:
        """The alignment in texts."""
        return ALIGNMENT_LABELS[self.name]


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryComparison:
    """Estimated poses and the reference's at the same instants, M pairs."""

    estimated: PoseSeries
    reference: PoseSeries
    stamps: Array  # (M,) s, of the estimated poses
    gap: float  # s, median difference of the two stamps of a pair
    delta: int  # poses between the two of a relative error
    alignments: tuple[AlignedErrors, ...]  # in order; without SE(3) where the positions do not determine it
    fixed: bool  # whether the one pose of the last alignment is the one that smoothing holds fixed

    def of(self, name: str) -> AlignedErrors | None:
        """The errors under the alignment of that name, None where it is left out."""
        return next((each for each in self.alignments if each.name == name), None)

    @property
    def fitted(self) -> AlignedErrors:
        """In one surface frame, the one that fits best."""
        return self.alignments[-2]

    @property
    def at_one_pose(self) -> AlignedErrors:
        """In the surface frame of one pose."""
        return self.alignments[-1]

    @property
    def span(self) -> tuple[float, float]:
        """First and last stamp, s."""
        return float(self.stamps[0]), float(self.stamps[-1])


def error_statistics(errors: Array) -> ErrorStatistics:
    """The statistics of errors (M,)."""
    if not len(errors):
        return ErrorStatistics(*[float("nan")] * 7)
    square = errors**2
    values = np.sqrt(square.mean()), errors.mean(), np.median(errors), errors.std(), errors.min(), errors.max()
    return ErrorStatistics(*map(float, (*values, square.sum())))


def compare(estimated: PoseSeries, reference: PoseSeries, delta: int = 1) -> TrajectoryComparison:
    """The estimated poses evaluated against the reference, under each alignment.

    "As they stand": evo without options.
    "Aligned, SE(3)": `evo_ape -a`, the rigid motion of the base that fits the positions best (Umeyama 1991); left out
        where they lie on a line and do not determine it.
    "One surface frame": the constant transform between the two runs' surface frames that fits the poses best.
    "Laid at one pose": that constant by one pose, whose error then is in all others. A run's covariances are relative
        to such a pose: its first one defines the surface frame, and smoothing holds the pose that did so fixed.
    delta: poses between the two of a relative error; the pairs follow one another, as evo's do.
    InputError where fewer than MIN_PAIRS poses belong together.
    """
    stamps, their_stamps = estimated.trajectory.stamps, reference.trajectory.stamps
    rows, theirs = _one_to_one(*associate(stamps, their_stamps), stamps, their_stamps)
    if len(rows) < max(MIN_PAIRS, delta + 1):
        need = f"{max(MIN_PAIRS, delta + 1)} or more: are both of the same recording, with the same clock?"
        raise InputError(estimated.name, f"poses at instants of {reference.name}", len(rows), need)
    ours, covariance = estimated.trajectory.base_from_surface[rows], estimated.covariance[rows]
    target = reference.trajectory.base_from_surface[theirs]
    pairs = [(ALIGNMENTS[0], ours, target)]
    if _rotation_determined(ours[:, :3, 3], target[:, :3, 3]):
        motion = se3.rigid_from_points(ours[:, :3, 3], target[:, :3, 3])
        pairs.append((ALIGNMENTS[1], motion @ ours, target))
    changes = se3.inverse(target) @ ours
    pairs.append((ALIGNMENTS[2], ours, target @ best_constant(changes)))
    fixed = fixed_row(covariance)
    pairs.append((ALIGNMENTS[3], ours, target @ changes[fixed or 0]))
    alignments = tuple(
        AlignedErrors(name, a, b, errors_under(np.eye(4), b, a, covariance), relative_errors(a, b, delta))
        for name, a, b in pairs
    )
    gap = float(np.median(np.abs(stamps[rows] - their_stamps[theirs])))
    return TrajectoryComparison(estimated, reference, stamps[rows], gap, delta, alignments, fixed is not None)


def relative_errors(estimated: Array, reference: Array, delta: int) -> RelativeErrors:
    """Errors of the change from each pose (M, 4, 4) to the one `delta` later, the pairs end to end."""
    samples = np.arange(0, len(estimated), delta, dtype=np.int64)
    change, expected = (se3.inverse(p[samples[:-1]]) @ p[samples[1:]] for p in (estimated, reference))
    off = se3.inverse(expected) @ change
    return RelativeErrors(samples[1:], np.linalg.norm(off[:, :3, 3], axis=-1), se3.angle_of(off[:, :3, :3]))


def _one_to_one(
    rows: RowNumbers, theirs: RowNumbers, stamps: Array, their_stamps: Array
) -> tuple[RowNumbers, RowNumbers]:
    """The pairs in which each row of the reference is used once, with the nearest of the rows associated with it."""
    order = np.lexsort((np.abs(stamps[rows] - their_stamps[theirs]), theirs))
    _, first = np.unique(theirs[order], return_index=True)
    nearest = np.sort(order[first])
    return rows[nearest], theirs[nearest]


def _rotation_determined(a: Array, b: Array) -> bool:
    """Whether positions (M, 3) determine the rotation between them: evo's condition."""
    sizes = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)) / len(a), compute_uv=False)
    return bool((sizes > np.finfo(float).eps).sum() >= 2)


TABLE_HEAD = ("", "RMSE", "mean", "median", "std", "max")
ALIGNMENT_STYLES = dict(
    zip(ALIGNMENT_LABELS.values(), ("series c3", "series c1", "series c0", "series c2"), strict=True)
)
ALIGNMENT_TEXT = (
    "Unaligned: nothing is fitted. Aligned, SE(3): rigid motion of the base that fits the positions best "
    "(Umeyama, without scale; evo_ape -a). Common surface frame: the best constant transform between the two runs' "
    "surface frames is removed. Frame of one pose: that transform is computed from one pose."
)


Errors = PoseErrors | RelativeErrors
ErrorLine = tuple[str, Array, Errors]  # label of the alignment, stamps (M,) s, errors (M,)


def comparison_verdict(comparison: TrajectoryComparison) -> str:
    """The verdict in a few sentences."""
    fit = [error_statistics(values).rmse for _, values in _by_unit(comparison.fitted.absolute)]
    paired = f"over {len(comparison.stamps)} of {len(comparison.estimated)} poses"
    frame = f"in a common surface frame, against {comparison.reference.name}"
    texts = [f"RMSE: {figure(fit[0])} mm and {figure(fit[1])}° {paired}, {frame}."]
    if comparison.gap > 1e-6:
        texts.append(f"Difference of the stamps: {figure(1000 * comparison.gap)} ms (median).")
    for aligned in comparison.alignments[:-1]:
        off = [error_statistics(values).rmse for _, values in _by_unit(aligned.absolute)]
        if aligned is not comparison.fitted:
            label = aligned.label.capitalize().replace("se(3)", "SE(3)")
            texts.append(f"{label}: {figure(off[0])} mm, {figure(off[1])}°.")
    if comparison.of(ALIGNMENTS[1]) is None:
        texts.append("No SE(3) alignment: the positions lie on a line.")
    nees = comparison.at_one_pose.absolute.mean_nees / 6
    if np.isfinite(nees):
        texts.append(f"NEES/6: {figure(nees)} in the frame of one pose, {consistency_text(nees, comparison.fixed)}.")
    return " ".join(texts)


def comparison_text(comparison: TrajectoryComparison) -> str:
    """The verdict and the tables, for a terminal."""
    lines = [comparison_verdict(comparison), ""]
    relative = f"RPE over {_poses(comparison.delta)}"
    for title, rows in (("APE", _error_rows(comparison, "absolute")), (relative, _error_rows(comparison, "relative"))):
        lines.append(f"{title:<34}" + "".join(f"{name:>10}" for name in TABLE_HEAD[1:]))
        lines += [f"  {row[0]:<32}" + "".join(f"{cell:>10}" for cell in row[1:]) for row in rows]
    return "\n".join(lines)


def comparison_figures(comparison: TrajectoryComparison) -> dict[str, Any]:
    """All figures by alignment: mm and degrees."""
    out: dict[str, Any] = {
        "estimated": comparison.estimated.name,
        "reference": comparison.reference.name,
        "reference_is_exact": comparison.reference.trajectory.exact,
        "pairs": len(comparison.stamps),
        "stamp_gap_s": comparison.gap,
        "delta_poses": comparison.delta,
    }
    for aligned in comparison.alignments:
        out[aligned.name] = {
            "ape": _statistics(aligned.absolute),
            "rpe": _statistics(aligned.relative),
            "nees_over_6": aligned.absolute.mean_nees / 6,
            "nees_inside_95": aligned.absolute.nees_inside,
        }
    return out


def comparison_page(comparison: TrajectoryComparison) -> str:
    """The page as HTML text."""
    parts = _tiles, _trajectory, _absolute, _relative, _consistency
    body = [html for part in parts if (html := part(comparison))]
    title = f"{_short(comparison.estimated.name)} by {_short(comparison.reference.name)}"
    footer = "Lengths in mm, time in s from the session's own clock; poses are base_from_surface. Scale is not fitted."
    return document("stillbed compare", title, comparison_verdict(comparison), body, footer)


def _by_unit(errors: Errors) -> tuple[tuple[str, Array], ...]:
    return ("mm", errors.translation), ("°", np.degrees(errors.rotation))


def _statistics(errors: Errors) -> dict[str, Any]:
    names = ("translation_mm", "rotation_deg")
    return {name: asdict(error_statistics(values)) for name, (_, values) in zip(names, _by_unit(errors), strict=True)}


def _tiles(comparison: TrajectoryComparison) -> str:
    tiles = [tile(str(len(comparison.stamps)), "", "pairs of poses")]
    for aligned in comparison.alignments[:-1]:
        rmse = error_statistics(aligned.absolute.translation).rmse
        tiles.append(tile(figure(1000 * rmse), "µm", f"APE {aligned.label}, RMSE"))
    nees = comparison.at_one_pose.absolute.mean_nees / 6
    if np.isfinite(nees):
        tiles.append(tile(figure(nees), "", f"NEES / 6, {comparison.at_one_pose.label}"))
    return row_of_tiles(tiles)


def _trajectory(comparison: TrajectoryComparison) -> str:
    fitted = comparison.fitted
    values, expected = (components(poses, fitted.reference[0]) for poses in (fitted.estimated, fitted.reference))
    plots = component_plots(comparison.span, comparison.stamps, {"truth": expected, "estimate": values})
    sources = ("estimate", comparison.estimated), ("truth", comparison.reference)
    keys = legend([line_key(style, _short(series.name)) for style, series in sources])
    return section("Trajectories", COMPONENTS_TEXT, keys + plots)


def _absolute(comparison: TrajectoryComparison) -> str:
    plots = _error_plots(comparison, [(j.label, comparison.stamps, j.absolute) for j in comparison.alignments])
    table = figures_table(TABLE_HEAD, _error_rows(comparison, "absolute"))
    return section("Absolute pose error (APE)", ALIGNMENT_TEXT, plots + table)


def _relative(comparison: TrajectoryComparison) -> str:
    label, errors = comparison.fitted.label, comparison.fitted.relative
    plots = _error_plots(comparison, [(label, comparison.stamps[errors.rows], errors)])
    over, table = _poses(comparison.delta), figures_table(TABLE_HEAD, _error_rows(comparison, "relative"))
    words = f"Error of the pose change over {over}. An alignment of the base does not affect it."
    return section("Relative pose error (RPE)", words, plots + table)


def _error_plots(comparison: TrajectoryComparison, lines: list[ErrorLine]) -> str:
    plots = [legend([line_key(ALIGNMENT_STYLES[name], name) for name, _, _ in lines])]
    for unit, label in enumerate(("distance, mm", "angle, °")):
        values = [_by_unit(errors)[unit][1] for _, _, errors in lines]
        positive = np.concatenate([v[v > 1e-9] for v in values])
        high = max(float(positive.max(initial=0.0)) * 1.5, 1e-4)
        low = max(float(np.percentile(positive, 1)) / 2, high / 1e5) if len(positive) else high / 10
        plot = Plot(PAGE_CHART_WIDTH, 170, comparison.span, (min(low, high / 10), high), log_y=True, label=label)
        for (name, stamps, _), errors in zip(lines, values, strict=True):
            plot.line(stamps, errors, ALIGNMENT_STYLES[name])
        plots.append(plot.svg())
    return "".join(plots)


def _consistency(comparison: TrajectoryComparison) -> str:
    nees = comparison.at_one_pose.absolute.nees
    shown = np.isfinite(nees) & (nees > 1e-6)  # that of the one pose is zero by definition
    if not shown.any():
        return ""
    high = max(float(nees[shown].max()) * 1.3, 2 * NEES_BOUND)
    low = max(float(np.percentile(nees[shown], 1)) / 2, 1e-2)
    label = f"NEES, {comparison.at_one_pose.label}"
    plot = Plot(PAGE_CHART_WIDTH, 170, comparison.span, (min(low, 1.0), high), log_y=True, label=label)
    plot.line(comparison.stamps[shown], nees[shown], "estimate")
    plot.level(NEES_BOUND, "95 %", "limit")
    plot.level(6.0, "6", "median")
    unfitted = [aligned for aligned in comparison.alignments if aligned.name in UNFITTED_ALIGNMENTS]
    rows = [[j.label, figure(j.absolute.mean_nees / 6), percent(j.absolute.nees_inside)] for j in unfitted]
    words = "Squared errors relative to the reported covariance. Mean of a consistent covariance: 6."
    if not comparison.reference.trajectory.exact:
        words += " The reference is not exact: its error is included."
    table = figures_table(["", "NEES / 6", f"under {NEES_BOUND:.1f} (expected: 95 %)"], rows)
    return section("Consistency (NEES)", words, plot.svg() + table)


def _error_rows(comparison: TrajectoryComparison, kind: Literal["absolute", "relative"]) -> list[list[str]]:
    """The rows of TABLE_HEAD: two for each alignment."""
    rows = []
    for aligned in comparison.alignments:
        for unit, values in _by_unit(aligned.absolute if kind == "absolute" else aligned.relative):
            s = error_statistics(values)
            rows.append([f"{aligned.label}, {unit}", *(figure(v) for v in (s.rmse, s.mean, s.median, s.std, s.max))])
    return rows


def _poses(count: int) -> str:
    return "one pose" if count == 1 else f"{count} poses"


def _short(name: str) -> str:
    return "/".join(Path(name).parts[-2:])


def run_compare(estimated: str, reference: str | None, delta: int, out: Path | None) -> str:
    """Compare `estimated` with `reference`, by default with the truth beside it; the figures as text."""
    if delta < 1:
        raise InputError("command line", "--delta", delta, "1 or more poses")
    ours = read_pose_series(estimated)
    theirs = read_truth_series(estimated) if reference is None else read_pose_series(reference, reference=True)
    if theirs.name == ours.name:
        raise InputError(ours.name, "poses", "the same as the reference", "two different trajectories")
    comparison = compare(ours, theirs, delta)
    report = comparison_text(comparison)
    if out is None:
        return report
    if (out / "summary.json").exists():
        raise InputError(out, "--out", "with another command's report", "a new folder, or one of stillbed compare")
    prepare_out(out, force=True)
    write_summary(out / "compare.json", comparison_figures(comparison))
    (out / "report.html").write_text(comparison_page(comparison), encoding="utf-8")
    return f"{report}\nreport: {out / 'report.html'}"
