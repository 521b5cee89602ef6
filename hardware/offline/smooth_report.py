"""report.html of a smoothed session: errors against live run and truth, spectrum, errors by the loop's delay."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.batch.smoothed import Smoothed
from estimation.pose import Trajectory
from estimation.se3 import Array
from hardware.offline.smooth_tracks import Rhythm, SessionTracks, breathing_rhythm, pulse_rhythm
from hardware.report.evaluation import (
    PoseErrors,
    associate,
    best_constant,
    consistency_text,
    errors_under,
    figure,
    fixed_row,
    spread,
)
from hardware.report.page import Plot, document, figures_table, legend, line_key, row_of_tiles, section, tile
from hardware.report.report import COMPONENTS_TEXT, PAGE_CHART_WIDTH, component_plots, components, deviations

SPECTRUM_RATE_HZ = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class MotionSpectrum:
    """The spectrum of the motion along the direction in which the surface moves most, and the rhythms in the motion."""

    hertz: Array  # (F,)
    amplitude: Array  # (F,) mm
    direction: Array  # (3,) in base
    breathing: Rhythm
    pulse: Rhythm

    @property
    def rhythms(self) -> tuple[tuple[str, Rhythm], ...]:
        """Each rhythm that was looked for, with its name."""
        return ("breathing", self.breathing), ("pulse", self.pulse)


def motion_spectrum(smoothed: Smoothed) -> MotionSpectrum:
    """The spectrum (Hann window) of the origin's position, resampled at SPECTRUM_RATE_HZ."""
    times = smoothed.sample_times(SPECTRUM_RATE_HZ)
    positions = smoothed.at(times).base_from_surface[:, :3, 3]
    centred = positions - positions.mean(0)
    direction = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    component = centred @ direction
    component = component - np.polyval(np.polyfit(times - times[0], component, 1), times - times[0])
    window = np.hanning(len(component))
    hertz = np.asarray(np.fft.rfftfreq(len(component), 1 / SPECTRUM_RATE_HZ), float)
    amplitude = np.asarray(2 * np.abs(np.fft.rfft(component * window)) / max(window.sum(), 1e-9), float)
    breathing = breathing_rhythm(times, component)
    return MotionSpectrum(hertz, amplitude, direction, breathing, pulse_rhythm(times, positions, breathing))


LOOP_DELAYS_S = (0.02, 0.033, 0.05, 0.1, 0.15, 0.2, 0.3)  # s, from exposure to the nozzle's arrival
LOOP_RATE_HZ = 60.0  # Hz, of the instants at which a loop's error is taken


@dataclass(frozen=True, slots=True, eq=False)
class LiveErrors:
    """The live run's measured poses, after the constant between the surface frames that fits best; M poses."""

    rows: NDArray[np.int64]  # (M,) of the smoothed poses at the same instants
    poses: Array  # (M, 4, 4) mm, in the smoothed poses' surface frame
    errors: Array  # (M, 6) right perturbations of the smoothed poses, rad and mm


@dataclass(frozen=True, slots=True, eq=False)
class SmoothEvaluation:
    """A smoothed session beside its live run and its truth."""

    live: LiveErrors | None  # None without measured poses
    errors: tuple[PoseErrors, PoseErrors | None] | None  # smoothed and live, against truth or reference
    exact: bool  # whether that is an exact truth
    by_delay: Array  # (D, 4) mm, see `delay_errors`
    sigma: float  # mm, median over the poses of one standard deviation of an axis of the position
    spectrum: MotionSpectrum

    @property
    def live_rms(self) -> float:
        """RMS distance, mm, of live from smoothed poses; nan without a live run."""
        return float("nan") if self.live is None else float(np.sqrt((self.live.errors[:, 3:] ** 2).sum(1).mean()))

    @property
    def rmse(self) -> tuple[float | None, float | None]:
        """RMSE, mm, of the smoothed and of the live positions; None where they cannot be compared."""
        smoothed, live = (None if e is None else spread(e.translation).rmse for e in self.errors or (None, None))
        return smoothed, live


def evaluate_smoothed(smoothed: Smoothed, tracks: SessionTracks, truth: Trajectory | None) -> SmoothEvaluation:
    """Errors, spectrum and delays of a smoothed session."""
    live = _live_errors(smoothed, tracks)
    errors = None if truth is None else _reference_errors(smoothed, live, truth)
    exact = truth is not None and truth.exact
    sigmas = np.sqrt(np.trace(smoothed.covariance[:, 3:6, 3:6], axis1=1, axis2=2) / 3)
    by_delay, sigma = delay_errors(smoothed), float(np.median(sigmas))
    return SmoothEvaluation(live, errors, exact, by_delay, sigma, motion_spectrum(smoothed))


def _live_errors(smoothed: Smoothed, tracks: SessionTracks) -> LiveErrors | None:
    start = tracks.start
    if start is None:
        return None
    theirs, rows = associate(start.stamps, smoothed.stamps)
    if not len(rows):
        return None
    poses, ours = start.base_from_surface[theirs], smoothed.states.poses[rows]
    aligned = poses @ se3.inverse(best_constant(se3.inverse(ours) @ poses))
    return LiveErrors(rows, aligned, se3.log(se3.inverse(ours) @ aligned))


def _reference_errors(
    smoothed: Smoothed, live: LiveErrors | None, truth: Trajectory
) -> tuple[PoseErrors, PoseErrors | None] | None:
    rows, true_rows = associate(smoothed.stamps, truth.stamps)
    if not len(rows):
        return None
    covariance = smoothed.covariance[rows, :6, :6]
    poses, target = smoothed.states.poses[rows], truth.base_from_surface[true_rows]
    ours = _aligned_errors(poses, target, covariance)
    if (fixed := fixed_row(covariance)) is not None:  # the covariances are relative to that pose
        ours = replace(
            ours, nees=errors_under(se3.inverse(target[fixed]) @ poses[fixed], target, poses, covariance).nees
        )
    if live is None:
        return ours, None
    rows, true_rows = associate(smoothed.stamps[live.rows], truth.stamps)
    unknown = np.full((len(rows), 6, 6), np.nan)
    return ours, _aligned_errors(live.poses[rows], truth.base_from_surface[true_rows], unknown) if len(rows) else None


def _aligned_errors(poses: Array, truth: Array, covariance: Array) -> PoseErrors:
    return errors_under(best_constant(se3.inverse(truth) @ poses), truth, poses, covariance)


def delay_errors(smoothed: Smoothed) -> Array:
    """(D, 4) mm, for each of LOOP_DELAYS_S RMS and 95th percentile of the nozzle's error, with the last pose held and
    with it extrapolated by its twist. The nozzle stands over the middle of the map; smoothed poses are taken as exact.
    """
    middle = np.median(smoothed.map.points, axis=0)
    last = smoothed.stamps[-1]
    out = np.full((len(LOOP_DELAYS_S), 4), np.nan)
    times = smoothed.sample_times(LOOP_RATE_HZ)
    now = smoothed.at(times)
    for i, delay in enumerate(LOOP_DELAYS_S):
        inside = times + delay <= last
        if not inside.any():
            continue
        later = smoothed.at(times[inside] + delay).base_from_surface
        held = now.base_from_surface[inside]
        extrapolated = held @ se3.exp(now.twist[inside] * delay)
        true = se3.transform_points(later, middle[None])[:, 0]
        for j, predicted in enumerate((held, extrapolated)):
            error = np.linalg.norm(se3.transform_points(predicted, middle[None])[:, 0] - true, axis=1)
            out[i, 2 * j : 2 * j + 2] = np.sqrt(np.mean(error**2)), np.percentile(error, 95)
    return out


RESIDUAL_PARTS = 4  # parts of the recording whose residuals stand side by side: there a camera's drift shows
MAX_SPECTRUM_HZ = 5.0  # Hz, of the spectrum on the page
SPREAD_HEAD = ("", "median", "RMSE", "95 %", "max")


def smooth_verdict(result: Smoothed, evaluation: SmoothEvaluation) -> str:
    """The verdict in a few sentences."""
    texts = [
        f"{len(result)} poses and {len(result.map)} landmarks over {result.stamps[-1] - result.stamps[0]:.1f} s; "
        f"sigma of the position per axis: {figure(evaluation.sigma)} mm (median)."
    ]
    if evaluation.live is not None:
        texts.append(f"Difference of live and smoothed poses: {figure(evaluation.live_rms)} mm RMS.")
    if evaluation.errors is not None:
        ours, live = (None if rmse is None else figure(rmse) for rmse in evaluation.rmse)
        live_text = "" if live is None else f", live {live} mm"
        texts.append(f"Error against the {_reference_name(evaluation)}: smoothed {ours} mm{live_text} (RMS, aligned).")
        nees, fixed = evaluation.errors[0].mean_nees / 6, fixed_row(result.covariance[:, :6, :6]) is not None
        texts += [f"NEES/6: {figure(nees)}, {consistency_text(nees, fixed)}."] if np.isfinite(nees) else []
    if not result.statistics.converged:
        texts.append(
            f"Not converged: the last of {result.statistics.passes} passes moved cameras or landmarks by "
            f"{figure(result.statistics.last_step)} sigma; errors may be larger than reported."
        )
    texts += [rhythm.words(name) for name, rhythm in evaluation.spectrum.rhythms]
    return " ".join(texts)


def smooth_page(title: str, words: str, result: Smoothed, evaluation: SmoothEvaluation) -> str:
    """The page as HTML text. words: the verdict."""
    body = [_tiles(evaluation), _trajectory(result), _live(result, evaluation), _errors(evaluation)]
    body += [_residuals(result), _spectrum(evaluation.spectrum), _errors_by_delay(evaluation), _cameras(result)]
    footer = "Lengths in mm, time in s from the session's own clock; poses are base_from_surface."
    return document("stillbed smooth", title, words, [part for part in body if part], footer)


def _reference_name(evaluation: SmoothEvaluation) -> str:
    return "exact truth" if evaluation.exact else "measured reference"


def _tiles(evaluation: SmoothEvaluation) -> str:
    tiles = [tile(figure(1000 * evaluation.sigma), "µm", "sigma of the position per axis, median")]
    if evaluation.live is not None:
        tiles.append(tile(figure(1000 * evaluation.live_rms), "µm", "difference of live and smoothed, RMS"))
    labels = {"breathing": "breaths a minute", "pulse": "beats a minute"}
    found = [(name, rhythm) for name, rhythm in evaluation.spectrum.rhythms if not rhythm.why]
    tiles += [tile(rhythm.per_minute, "", labels[name]) for name, rhythm in found]
    return row_of_tiles(tiles)


def _trajectory(result: Smoothed) -> str:
    values = components(result.states.poses, result.states.poses[0])
    sigma = deviations(result.states.poses, result.covariance[:, :6, :6])
    plots = component_plots(_span(result), result.stamps, {"estimate": values}, sigma)
    keys = legend([line_key("estimate", "smoothed, with two standard deviations")])
    return section("Trajectory", COMPONENTS_TEXT, keys + plots)


def _span(result: Smoothed) -> tuple[float, float]:
    return float(result.stamps[0]), float(result.stamps[-1])


def _spread_row(name: str, values: Array) -> list[str]:
    s = spread(values)
    return [name, *(figure(v) for v in (s.median, s.rmse, s.p95, s.max))]


def _live(result: Smoothed, evaluation: SmoothEvaluation) -> str:
    if evaluation.live is None:
        return ""
    errors, stamps = evaluation.live.errors, result.stamps[evaluation.live.rows]
    distance = np.linalg.norm(errors[:, 3:], axis=1)
    turn = np.degrees(np.linalg.norm(errors[:, :3], axis=1))
    plots, rows = [], []
    for values, name, unit in ((1000 * distance, "distance, µm", "µm"), (turn, "angle, °", "°")):
        scale = 0.0, max(float(values.max()) * 1.08, 1e-3)
        plot = Plot(PAGE_CHART_WIDTH, 150, _span(result), scale, label=name)
        plot.line(stamps, values, "estimate")
        plots.append(plot.svg())
        rows.append(_spread_row(f"live minus smoothed, {unit}", values))
    table = figures_table(SPREAD_HEAD, rows)
    text = "Measured poses of the live run minus smoothed poses, in a common surface frame."
    return section("Live minus smoothed", text, "".join(plots) + table)


def _errors(evaluation: SmoothEvaluation) -> str:
    if evaluation.errors is None:
        return ""
    rows = []
    for name, errors in zip(("smoothed", "live"), evaluation.errors, strict=True):
        if errors is not None:
            rows.append(_spread_row(f"{name}, mm", errors.translation))
            rows.append(_spread_row(f"{name}, °", np.degrees(errors.rotation)))
    text = f"Errors against the {_reference_name(evaluation)}, aligned by the best constant transform of the run."
    return section("Errors", text, figures_table(SPREAD_HEAD, rows))


def _residuals(result: Smoothed) -> str:
    rms = result.statistics.rms
    top = float(np.nanpercentile(rms, 99.5)) * 1.15 if np.isfinite(rms).any() else 1.0
    plot = Plot(PAGE_CHART_WIDTH, 170, _span(result), (0.0, max(top, 0.05)), label="residual, px RMS")
    keys, rows = [], []
    parts = np.array_split(np.arange(len(result)), RESIDUAL_PARTS)
    used, seen = result.statistics.used.sum(0), result.statistics.observed.sum(0)
    for i, camera in enumerate(result.rig.cameras):
        plot.line(result.stamps, rms[:, i], f"series c{i % 5}")
        keys.append(line_key(f"series c{i % 5}", camera.name))
        by_part = [spread(rms[part, i][np.isfinite(rms[part, i])]).rmse for part in parts]
        rows.append([camera.name, *(figure(v) for v in by_part), f"{100 * used[i] / max(seen[i], 1):.1f} %"])
    head = ["camera, px RMS", *(f"quarter {k + 1}" for k in range(RESIDUAL_PARTS)), "inlier tracks"]
    text = "Reprojection error of the inlier tracks of each camera."
    return section("Residuals", text, legend(keys) + plot.svg() + figures_table(head, rows))


def _spectrum(spectrum: MotionSpectrum) -> str:
    shown = (spectrum.hertz > 0) & (spectrum.hertz <= MAX_SPECTRUM_HZ)
    if shown.sum() < 2:
        return ""
    amplitude = np.maximum(spectrum.amplitude[shown], 1e-6)
    high = float(amplitude.max()) * 1.5
    span = 0.0, float(spectrum.hertz[shown][-1])
    plot = Plot(PAGE_CHART_WIDTH, 190, span, (max(high / 1e4, 1e-5), high), log_y=True, label="amplitude, mm")
    plot.line(spectrum.hertz[shown], amplitude, "estimate")
    for name, rhythm in spectrum.rhythms:
        if not rhythm.why:
            plot.mark(rhythm.rate, f"{name} {rhythm.per_minute}/min", "median")
    along = ", ".join(f"{v:.2f}" for v in spectrum.direction)
    text = f"Spectrum of the origin's motion along its main direction, ({along}) in base; frequency in Hz. "
    text += " ".join(rhythm.words(name) for name, rhythm in spectrum.rhythms)
    return section("Spectrum", text, plot.svg())


def _errors_by_delay(evaluation: SmoothEvaluation) -> str:
    pairs = zip(LOOP_DELAYS_S, evaluation.by_delay, strict=True)
    rows = [[f"{1000 * delay:.0f} ms", *(figure(1000 * v) for v in row)] for delay, row in pairs]
    head = ["delay", "last pose, µm RMS", "95 %", "constant twist, µm RMS", "95 %"]
    text = (
        "Error of a nozzle over the middle of the map that the loop's delay alone would cause, from exposure to "
        "arrival: with the last pose, or with the pose extrapolated by its twist. The pose is assumed exact."
    )
    return section("Error by delay of the loop", text, figures_table(head, rows))


def _cameras(result: Smoothed) -> str:
    rows = []
    for i, camera in enumerate(result.rig.cameras):
        calibrated = result.calibrated_rig.cameras[i]
        shift = se3.log(se3.inverse(calibrated.base_from_camera) @ camera.base_from_camera)
        lens = camera.matrix - calibrated.matrix
        values = [1000 * float(np.linalg.norm(shift[:3])), float(np.linalg.norm(shift[3:])), lens[0, 0], lens[0, 2]]
        clock = f"{1000 * result.offsets[i]:.2f} ± {1000 * result.offset_sigma[i]:.2f}"
        rows.append([camera.name, clock, *(f"{v:.3f}" for v in (*values, lens[1, 2]))])
    head = ["camera", "clock offset, ms", "rotation, mrad", "shift, mm", "fx, px", "cx, px", "cy, px"]
    fit = result.statistics
    text = (
        "Cameras as estimated from this recording, minus their calibration: clock offsets relative to the mean, with "
        f"one sigma; poses and lenses only with --refine-cameras. Jitter of the exposures: "
        f"{1000 * fit.delay_sigma:.2f} ms; of the images: {fit.shift_sigma:.3f} px between frame sets."
    )
    return section("Calibration drift", text, figures_table(head, rows))
