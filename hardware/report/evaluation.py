"""How good a run was: errors against truth or reference, consistency of the covariance, states, latency; and in words.

The tracker's surface frame is its own; the truth's is another. Both are rigidly attached to the surface, so
`truth_surface_from_estimated_surface` is constant. It is taken at the first TRACKING pose, or the first measured one
where none is ("start": nothing is fitted, and that pose's own error is in every other one), and, beside it, as the best
constant over the run ("aligned").
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.pose import TrackState, Trajectory
from estimation.se3 import Array
from hardware.files.pose_file import PoseTable
from hardware.files.session import damage_text
from hardware.process.system import provenance

MAX_TRACKING_ERROR_MM = 10.0  # of a pose in state TRACKING: above it the state itself is wrong
INCOMPLETE_TEXT = "The run is incomplete: it was interrupted. The figures describe its finished part."
NEES_BOUND = 12.592  # chi-square of 6 degrees of freedom, 95 %
CALIBRATED_NEES = (0.8, 1.25)  # of NEES/6: between them a covariance may be used as it is
SINGLE_DRAW_NEES = (0.2, 2.4)  # 95 % of a chi-square of 6 degrees of freedom, by 6
FIXED_POSE_SIGMA_MM = 1e-3  # mm, of all axes: only the pose that a smoothed run holds fixed has a smaller one


def consistency_text(nees: float, fixed: bool) -> str:
    """What the mean NEES/6 of one run, in the frame of one pose, says of the covariances.

    fixed: whether that pose is the one that smoothing holds fixed. Otherwise it has an error of its own, which is drawn
    once, is in all poses and in their covariances, and makes the mean of a run vary as one draw does.
    """
    low, high = CALIBRATED_NEES if fixed else SINGLE_DRAW_NEES
    if low <= nees <= high:
        return "consistent covariances" + (" (1 is ideal)" if fixed else f" (one run: {low:g} to {high:g} by chance)")
    return f"inconsistent covariances: errors are {nees**0.5:.2g} times the reported sigma"


def fixed_row(covariance: Array) -> int | None:
    """The row of the pose that a smoothed run holds fixed, by its tiny covariance (M, 6, 6); None without one."""
    size = np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2)
    return int(np.argmin(size)) if np.isfinite(size).all() and size.min() < FIXED_POSE_SIGMA_MM**2 else None


@dataclass(frozen=True, slots=True)
class Spread:
    """Median, root mean square, 95th and 99th percentile and maximum of errors; NaN where there are none."""

    median: float
    rmse: float
    p95: float
    p99: float
    max: float


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """Errors of the measured poses that have a true one beside them, under one constant surface transform."""

    truth_surface_from_estimated_surface: Array  # (4, 4)
    translation: Array  # (M,) mm, of the estimated surface's origin in base
    rotation: Array  # (M,) rad
    nees: Array  # (M,) normalised estimation error squared, mean 6 for an honest covariance; NaN without a finite one

    @property
    def mean_nees(self) -> float:
        """Mean NEES of the poses that have a covariance; NaN without any."""
        return float(self._finite_nees.mean()) if len(self._finite_nees) else float("nan")

    @property
    def nees_inside(self) -> float:
        """Share of those poses whose NEES is inside the 95 % bound; NaN without any."""
        return float(np.mean(self._finite_nees <= NEES_BOUND)) if len(self._finite_nees) else float("nan")

    @property
    def _finite_nees(self) -> Array:
        return self.nees[np.isfinite(self.nees)]


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A run beside a truth."""

    rows: NDArray[np.int64]  # (M,) of the run
    expected: Array  # (M, 4, 4) the truth's poses there
    start: PoseErrors
    aligned: PoseErrors
    exact: bool  # whether the truth is one (NEES means something) or a measured reference
    off: NDArray[np.int64]  # measured rows in state TRACKING whose start error passes MAX_TRACKING_ERROR_MM
    stamp_gap: float  # s, median distance of the associated stamps


def spread(errors: Array) -> Spread:
    """The figures of `errors` (M,), none below 0, in their own unit."""
    if not len(errors):
        return Spread(*[float("nan")] * 5)
    median, p95, p99, top = np.percentile(errors, [50, 95, 99, 100])
    return Spread(float(median), float(np.sqrt(np.mean(errors**2))), float(p95), float(p99), float(top))


def associate(stamps: Array, truth_stamps: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (M,) of `stamps` (N,) and of `truth_stamps` (K,) of one instant: the nearest, at most half a period off.

    The period is the smaller of the two median steps, so each row of the sparser one is matched once.
    """
    if not len(stamps) or not len(truth_stamps):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    steps = [np.median(np.diff(s)) for s in (stamps, truth_stamps) if len(s) > 1]
    tolerance = 0.5 * min(steps, default=0.0) + 1e-6
    right = np.clip(np.searchsorted(truth_stamps, stamps), 1, max(len(truth_stamps) - 1, 1))
    right = np.minimum(right, len(truth_stamps) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(stamps - truth_stamps[left] <= truth_stamps[right] - stamps, left, right)
    rows = np.flatnonzero(np.abs(truth_stamps[nearest] - stamps) <= tolerance)
    return rows, nearest[rows]


def compare(table: PoseTable, truth: Trajectory) -> Comparison | None:
    """The run's measured poses beside the truth; None where no measured pose has a true one beside it."""
    measured = np.flatnonzero(table.measured)
    own_rows, true_rows = associate(table.stamps[measured], truth.stamps)
    if not len(own_rows):
        return None
    rows = measured[own_rows]
    estimate, covariance = table.base_from_surface[rows], table.covariance[rows]
    expected = truth.base_from_surface[true_rows]
    changes = se3.inverse(expected) @ estimate  # (M, 4, 4)
    tracking = table.is_state(TrackState.TRACKING)[rows]
    first = int(np.argmax(tracking))  # 0 where none is
    start = errors_under(changes[first], expected, estimate, covariance)
    aligned = errors_under(best_constant(changes), expected, estimate, covariance)
    off = rows[tracking & (start.translation > MAX_TRACKING_ERROR_MM)]
    stamp_gap = float(np.median(np.abs(table.stamps[rows] - truth.stamps[true_rows])))
    return Comparison(rows, expected, start, aligned, truth.exact, off, stamp_gap)


def best_constant(changes: Array) -> Array:
    """The constant (4, 4) nearest to transforms (M, 4, 4): mean translation, chordal mean of the rotations.

    With changes = inverse(expected) @ estimate both parts are the exact least-squares answer for poses
    `expected @ constant`, since a rotation keeps lengths.
    """
    return se3.orthonormalise(changes.mean(axis=0))


def errors_under(constant: Array, expected: Array, estimate: Array, covariance: Array) -> PoseErrors:
    """Errors of `estimate` (M, 4, 4) against `expected @ constant`, with covariance (M, 6, 6) of the estimate."""
    target = expected @ constant
    difference = se3.log(se3.inverse(estimate) @ target)  # (M, 6) right perturbation of the estimate
    usable = np.isfinite(covariance).all(axis=(1, 2))
    nees = np.full(len(estimate), np.nan)
    information = np.linalg.pinv(covariance[usable], hermitian=True)
    nees[usable] = np.einsum("ni,nij,nj->n", difference[usable], information, difference[usable])
    translation = np.linalg.norm(estimate[:, :3, 3] - target[:, :3, 3], axis=-1)
    return PoseErrors(constant, translation, np.linalg.norm(difference[:, :3], axis=-1), nees)


@dataclass(frozen=True, slots=True, eq=False)
class Latency:
    """Milliseconds per stage."""

    stages: tuple[str, ...]  # S + 1 names, the last "total"
    p50: Array  # (S + 1,) after initialisation, like the next three
    p95: Array
    p99: Array
    max: Array
    initialisation: float  # ms of all frame sets up to and including the first that left INITIALISING
    initial_sets: int  # how many those are
    total: Array  # (N,) ms of each later frame set


def latency(table: PoseTable) -> Latency:
    """Latency percentiles of the frame sets after initialisation; NaN where there are none."""
    started = np.flatnonzero(~table.is_state(TrackState.INITIALISING))
    first = int(started[0]) + 1 if len(started) else len(table)
    milliseconds = 1000 * table.seconds[first:]
    percentiles = np.full((4, len(table.stages)), np.nan)
    if len(milliseconds):
        percentiles = np.percentile(milliseconds, [50, 95, 99, 100], axis=0)
    initial_ms = float(1000 * table.seconds[:first, -1].sum())
    p50, p95, p99, top = percentiles
    return Latency(table.stages, p50, p95, p99, top, initial_ms, first, milliseconds[:, -1])


def state_shares(table: PoseTable, since: float = -np.inf) -> dict[str, float]:
    """Share of the frame sets with stamp >= `since` (s) in each state, in TrackState's order; empty without any."""
    rows = np.flatnonzero(table.stamps >= since - 1e-6)
    if not len(rows):
        return {}
    return {state.value: float(np.mean(table.is_state(state)[rows])) for state in TrackState}


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """All that the report says about one run."""

    title: str  # the session's name
    table: PoseTable
    comparison: Comparison | None  # None without truth or reference
    latency: Latency
    shares: dict[str, float]  # per state, of the frame sets from `since` on
    since: float  # s
    complete: bool  # whether the session was run to its end
    damage: str  # what was lost of its file, "" if nothing
    method: str = ""  # a key of hardware.offline.track.TRACKING_METHODS or "truth", "" where it is not known


def evaluate(
    table: PoseTable,
    truth: Trajectory | None,
    title: str = "",
    since: float = -np.inf,
    complete: bool = True,
    damage: str = "",
    method: str = "",
) -> Evaluation:
    """Everything about one run; `since` (s) is the instant from which its states count."""
    comparison = None if truth is None else compare(table, truth)
    shares = state_shares(table, since)
    return Evaluation(title, table, comparison, latency(table), shares, since, complete, damage, method)


def measured_share(result: Evaluation) -> float:
    """Share of the frame sets that were TRACKING or DEGRADED; 0 where there are none."""
    return sum(share for name, share in result.shares.items() if TrackState(name).measured)


def verdict(result: Evaluation) -> list[str]:
    """The run in a few sentences."""
    counted = int(np.sum(result.table.stamps >= result.since - 1e-6))
    tracked = round(measured_share(result) * counted)
    sentences = [f"The surface was tracked in {tracked} of {counted} frame sets ({percent(measured_share(result))})."]
    if not result.complete:
        sentences.insert(0, INCOMPLETE_TEXT)
    if result.damage:
        sentences.insert(0, damage_text(result.damage))
    if result.comparison is not None:
        sentences += _judgement(result.comparison)
    if len(result.latency.total):
        middle, tail = result.latency.p50[-1], result.latency.p99[-1]
        sentences.append(f"Latency of a pose: {middle:.1f} ms median, {tail:.1f} ms at 99 %.")
    if clocks_learned(result.table):
        sentences.append(_clocks(result.table))
    return sentences


def clocks_learned(table: PoseTable) -> bool:
    """Whether the method learned when the cameras expose."""
    return len(table) > 0 and len(table.cameras) > 1 and bool(np.isfinite(table.offset_sigmas[-1]).all())


def _clocks(table: PoseTable) -> str:
    """What was known at the end of when the cameras expose."""
    offsets, sigmas = 1000 * table.offsets[-1], 1000 * table.offset_sigmas[-1]
    if not offsets.any():
        return f"No camera has a significant clock offset (one sigma: {sigmas.max():.1f} ms)."
    each = [f"{n} {o:+.1f} ± {s:.1f} ms" for n, o, s in zip(table.cameras, offsets, sigmas, strict=True)]
    return f"Clock offsets of the cameras, relative to their mean: {', '.join(each)}."


def _judgement(comparison: Comparison) -> list[str]:
    error = spread(comparison.start.translation)
    rotation = math.degrees(spread(comparison.start.rotation).median)
    against = "exact truth" if comparison.exact else "measured reference"
    sentences = [f"Error against the {against}: {figure(error.median)} mm and {figure(rotation)}° (median)."]
    subject = {0: "No pose had", 1: "One pose had"}.get(len(comparison.off), f"{len(comparison.off)} poses had")
    return [*sentences, f"{subject} an error above {MAX_TRACKING_ERROR_MM:.0f} mm in state TRACKING."]


def percent(share: float, digits: int = 1) -> str:
    """0.965 as 96.5 %, with `digits` decimals; a single one is omitted if it is zero."""
    return f"{100 * share:.{digits}f}".removesuffix(".0") + " %"


def figure(value: float) -> str:
    """Three significant digits, and a dash for what is not known."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:#.3g}" if abs(value) >= 0.001 else f"{value:.4f}"


def as_dict(result: Evaluation) -> dict[str, Any]:
    """The summary as plain values, ready for JSON; a figure that does not exist is None."""
    timings = result.latency
    percentiles = zip(timings.stages, timings.p50, timings.p95, timings.p99, timings.max, strict=True)
    summary: dict[str, Any] = {
        "session": result.title,
        "method": result.method,
        "complete": result.complete,
        "verdict": verdict(result),
        "frame_sets": len(result.table),
        "states_since_s": result.since,
        "states": result.shares,
        "measured_share": measured_share(result),
        "latency_ms": {name: {"p50": a, "p95": b, "p99": c, "max": d} for name, a, b, c, d in percentiles},
        "clocks_ms": None,
        "initialisation_ms": timings.initialisation,
        "initialisation_frame_sets": timings.initial_sets,
        "errors": None,
    }
    if clocks_learned(table := result.table):
        last = zip(table.cameras, 1000 * table.offsets[-1], 1000 * table.offset_sigmas[-1], strict=True)
        summary["clocks_ms"] = {name: {"offset": offset, "sigma": sigma} for name, offset, sigma in last}
    if (comparison := result.comparison) is not None:
        summary["errors"] = {
            "against": "truth" if comparison.exact else "reference",
            "poses": len(comparison.rows),
            "median_stamp_gap_s": comparison.stamp_gap,
            "off_by_more_than_10_mm_while_tracking": len(comparison.off),
            "start": _errors_dict(comparison.start),
            "aligned": _errors_dict(comparison.aligned),
        }
    cleaned: dict[str, Any] = finite(summary)
    return cleaned


def _errors_dict(errors: PoseErrors) -> dict[str, Any]:
    return {
        "translation_mm": asdict(spread(errors.translation)),
        "rotation_deg": asdict(spread(np.degrees(errors.rotation))),
        "nees_over_6": errors.mean_nees / 6,
        "nees_inside_95": errors.nees_inside,
        "truth_surface_from_estimated_surface": errors.truth_surface_from_estimated_surface.tolist(),
    }


def finite(value: Any) -> Any:
    """The same value with every number that JSON cannot hold as None, and numpy's floats as Python's."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value


def write_summary(path: Path, summary: dict[str, Any]) -> None:
    """Write summary.json: figures with the provenance of what made them; a number that does not exist is null."""
    whole = finite(summary | {"provenance": provenance().table()})
    path.write_text(json.dumps(whole, indent=2) + "\n", encoding="utf-8")


def summary_text(result: Evaluation) -> str:
    """The verdict and the error table, for a terminal."""
    return text_of(as_dict(result))


def text_of(summary: dict[str, Any]) -> str:
    """The same from a summary as `as_dict` gives it; KeyError where a figure is missing."""
    lines = list(summary["verdict"])
    if summary["errors"] is not None:
        lines += ["", f"{'error':<22}{'median':>9}{'RMSE':>9}{'95 %':>9}{'max':>9}"]
        for name, kind in (("first pose", "start"), ("aligned", "aligned")):
            for unit, key in (("mm", "translation_mm"), ("deg", "rotation_deg")):
                figures = summary["errors"][kind][key]
                cells = "".join(f"{figures[part]:>9.3f}" for part in ("median", "rmse", "p95", "max"))
                lines.append(f"{f'{name}, {unit}':<22}{cells}")
    return "\n".join(lines)
