"""`stillbed bench thesis`: the thesis's estimator and ours, on the same frame sets in the same run."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hardware.bench.figures import Figure, Target, at_least
from hardware.bench.thesis_scenes import MADE, Shown, made, recorded
from hardware.files.pose_file import PoseWriter, read_poses
from hardware.methods import MAP, step_by
from hardware.process.clock import ProcessorClock, WallClock
from hardware.report.evaluation import Evaluation, evaluate, spread
from hardware.report.summary import measured_share, percent
from perception.tracking.step import STAGES

ACCURACY, SPEED = 10.0, 5.0  # times better than the thesis's, which ours is to be
REFERENCE_MM = "1.6, 4.0, 1.8 on other rendered sequences"
REFERENCE_MS = "70, thesis Fig. 4.17"


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What a method made of a recording. processor: ms (median) of all threads on a frame set after initialisation."""

    run: Evaluation
    processor: float

    @property
    def millimetres(self) -> float:
        """RMSE of the measured poses' place from the start; NaN without a truth."""
        comparison = self.run.comparison
        return float("nan") if comparison is None else spread(comparison.start.translation).rmse

    @property
    def degrees(self) -> float:
        """RMSE of the measured poses' rotation from the start; NaN without a truth."""
        comparison = self.run.comparison
        return float("nan") if comparison is None else float(np.degrees(spread(comparison.start.rotation).rmse))


def run(options: argparse.Namespace) -> list[Figure]:
    """Errors and latencies of both on each recording, and how many times ours are smaller."""
    shown = [recorded(path) for path in options.sessions] or [made(name, options.seconds) for name in MADE]
    figures = []
    for each in shown:
        ours, theirs = side_by_side(each, (MAP, options.method))
        figures += _figures(each.name, ours, theirs)
    return figures


def side_by_side(shown: Shown, methods: tuple[str, ...]) -> list[Judged]:
    """What each method makes of a recording; on each frame set they take turns, so the machine is the same to all."""
    now, processor = WallClock().now, ProcessorClock().now
    cameras = [camera.name for camera in shown.rig.cameras]
    with TemporaryDirectory() as folder, ExitStack() as stack:
        steps, writers, costs = {}, {}, {}
        for method in methods:
            (Path(folder) / method).mkdir()
            steps[method] = stack.enter_context(step_by(method, shown.rig, shown.roi, shown.surface, now))
            writers[method] = stack.enter_context(PoseWriter(Path(folder) / method, cameras, STAGES))
            costs[method] = list[float]()
        for frames in shown.frame_sets():
            for method, step in steps.items():
                start, cost = now(), processor()
                pose = step(frames)
                costs[method].append(processor() - cost)
                spent = now() - start
                writers[method].write(pose, len(frames.frames), step.last, spent)
                step.idle()
        return [_judged(shown, Path(folder) / m / "poses.csv", m, costs[m]) for m in methods]


def _judged(shown: Shown, file: Path, method: str, costs: list[float]) -> Judged:
    since = min((roi.stamp for roi in shown.roi), default=-np.inf)
    result = evaluate(read_poses(file), shown.truth, shown.name, since, method=method)
    later = costs[result.latency.initial_sets :]
    return Judged(result, 1000 * float(np.median(later)) if later else float("nan"))


def _figures(name: str, ours: Judged, theirs: Judged) -> list[Figure]:
    label = theirs.run.method
    shares = f"measured: {label} {percent(measured_share(theirs.run))}, ours {percent(measured_share(ours.run))}"
    late, their_late = ours.run.latency, theirs.run.latency
    return [
        *_pair(f"{name}: error", label, "mm RMSE", (ours.millimetres, theirs.millimetres), REFERENCE_MM, ACCURACY),
        *_pair(f"{name}: turn", label, "deg RMSE", (ours.degrees, theirs.degrees), "", ACCURACY, shares),
        *_pair(f"{name}: pose after", label, "ms, median", (late.p50[-1], their_late.p50[-1]), REFERENCE_MS, SPEED),
        *_pair(f"{name}: pose after, 99 %", label, "ms", (late.p99[-1], their_late.p99[-1])),
        *_pair(f"{name}: processor", label, "ms, median", (ours.processor, theirs.processor)),
    ]


def _pair(
    what: str,
    label: str,
    unit: str,
    values: tuple[float, float],
    reference: str = "",
    times: float | None = None,
    note: str = "",
) -> list[Figure]:
    """Ours, the thesis's and how many times ours is smaller, which should be at least `times`."""
    ours, theirs = map(float, values)
    target: Target | None = None if times is None else at_least(times)
    ratio = theirs / ours if ours > 0 else float("nan")
    return [
        Figure(f"{what}, ours", ours, unit, note=note),
        Figure(f"{what}, {label}", theirs, unit, reference=reference),
        Figure(f"{what}, {label} / ours", ratio, "times", target),
    ]
