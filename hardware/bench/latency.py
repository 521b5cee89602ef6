"""`stillbed bench latency`: from three decoded frames to the pose, flow included, by wall clock and by processor."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Iterator

import numpy as np

from estimation.pose import TrackState
from estimation.se3 import Array
from hardware.bench.figures import Figure, Target, at_most
from hardware.bench.thesis_scenes import Shown, made, recorded
from hardware.files.images import decode, encode
from hardware.process.clock import ProcessorClock, WallClock
from hardware.tracker import tracker
from perception.frames import Frame, FrameSet
from perception.tracking.step import STAGES

REFERENCE = "thesis 70; OpenVINS stereo 26 / 41 / 98 (median / 99 % / largest)"
TARGETS = ("median", 50, at_most(8)), ("99 %", 99, at_most(16)), ("largest", 100, at_most(33))
TRACKS = ("median", 50, at_most(5)), ("99 %", 99, at_most(10))  # 120 a camera
ESTIMATION = at_most(4)  # ms, 99 %
QUALITY = 95  # of JPEG: what is held in memory until it is shown
WARM = 10  # frame sets after the first map that only fill caches and the window


def run(options: argparse.Namespace) -> list[Figure]:
    """Latencies on each recording."""
    shown = [recorded(path) for path in options.sessions]
    shown = shown or [made(name, options.seconds) for name in options.scene]
    return [figure for each in shown for figure in latency_figures(each.name, *timed(each))]


def timed(shown: Shown) -> tuple[Array, Array]:
    """Wall time (N, 1 + len(STAGES)) s, in all and by stage, and processor time (N,), s, of each tracked frame set."""
    now, processor = WallClock().now, ProcessorClock().now
    rows, costs, known = [], [], 0
    with tracker(shown.rig, shown.roi, shown.surface, now) as step:
        for frames in _held(shown.frame_sets()):
            start, cost = now(), processor()
            pose = step(frames)
            cost, spent = processor() - cost, now() - start
            step.idle()
            known += pose.state is not TrackState.INITIALISING
            if known > WARM:
                rows.append([spent, *step.last.seconds])
                costs.append(cost)
    return np.array(rows).reshape(-1, 1 + len(STAGES)), np.array(costs)


def _held(frame_sets: Iterable[FrameSet]) -> Iterator[FrameSet]:
    """All frame sets, made before the first is given out: whatever renders them is done by then."""
    packed = [
        (frames.stamp, [(f.camera, f.stamp, encode(f.image, QUALITY)[1]) for f in frames.frames])
        for frames in frame_sets
    ]
    for stamp, frames in packed:
        yield FrameSet(stamp, tuple(Frame(c, t, decode(data, "bench", "picture")) for c, t, data in frames))


def latency_figures(name: str, wall: Array, processor: Array) -> list[Figure]:
    """Figures in ms of wall times (N, 1 + len(STAGES)) s and processor times (N,) s."""
    if not len(wall):
        return [Figure(f"{name}: pose after", float("nan"), "ms", note="no surface was followed for long enough")]
    note = f"{len(wall)} frame sets; the machine's load was {os.getloadavg()[0]:.1f}"
    figures = [_figure(f"{name}: pose after", wall[:, 0], *target, REFERENCE, note) for target in TARGETS]
    figures.append(_figure(f"{name}: processor", processor, "median", 50, note="all threads"))
    for stage, column in zip(STAGES, wall[:, 1:].T, strict=True):
        figures.append(_figure(f"{name}: {stage}", column, "median", 50))
    tracking = wall[:, 1 + STAGES.index("flow")] + wall[:, 1 + STAGES.index("align")]
    for word, percentile, target in TRACKS:
        figures.append(_figure(f"{name}: tracks of all cameras", tracking, word, percentile, target))
    estimation = wall[:, 1 + STAGES.index("pose")]
    figures.append(_figure(f"{name}: estimation alone", estimation, "99 %", 99, ESTIMATION))
    asked = float(np.mean(wall[:, 1 + STAGES.index("flow")] > 0))
    return [*figures, Figure(f"{name}: frame sets that asked for flow", 100 * asked, "%")]


def _figure(
    what: str,
    seconds: Array,
    word: str,
    percentile: float,
    target: Target | None = None,
    reference: str = "",
    note: str = "",
) -> Figure:
    return Figure(f"{what}, {word}", 1000 * float(np.percentile(seconds, percentile)), "ms", target, reference, note)
