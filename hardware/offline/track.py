"""`stillbed track`: the tracking step over a recorded session, its poses written as they come, and the report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.files.pose_file import PoseWriter, read_poses
from hardware.files.session import Session, open_session
from hardware.methods import MAP, step_by
from hardware.out_folder import prepare_out
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, Report
from hardware.report.evaluation import evaluate
from hardware.report.report import write_report
from hardware.report.summary import summary_text, write_summary
from hardware.track_recorder import TrackRecorder
from perception.frames import FrameSet
from perception.tracking.step import STAGES, StepReport

if TYPE_CHECKING:
    from hardware.wound_file import WoundFile


class Step(Protocol):
    """What is driven: perception.tracking.step.TrackingStep, or anything that answers like it."""

    last: StepReport

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp`."""
        ...

    def idle(self) -> None:
        """Work that no pose waits for."""
        ...


Sink = Callable[[FrameSet, SurfacePose, StepReport], None]  # what else is done with each pose, e.g. recording it


def follow(
    frame_sets: Iterable[FrameSet],
    step: Step,
    writer: PoseWriter,
    now: Callable[[], float],
    progress: Report,
    total: int,
    sinks: Sequence[Sink] = (),
) -> int:
    """Drive `step` over the frame sets, each pose written before the next is asked for; how many there were.

    `total` is for the progress only. The step's own time is measured by `now` and ends before anything is written.
    """
    done = 0
    for frames in frame_sets:
        start = now()
        pose = step(frames)
        spent = now() - start
        writer.write(pose, len(frames.frames), step.last, spent)
        for sink in sinks:
            sink(frames, pose, step.last)
        step.idle()
        done += 1
        progress(done, total)
    return done


def finish(out: Path, session: Session, complete: bool, method: str = MAP) -> str:
    """Judge what poses.csv in `out` holds; writes report.html and summary.json there and returns the summary as text.

    complete: whether the session was run to its end. method: by which it was tracked.
    """
    since = min((roi.stamp for roi in session.roi), default=-np.inf)
    table = read_poses(out / "poses.csv")
    result = evaluate(table, session.truth, session.path.name, since, complete, session.damage, method)
    write_summary(out / "summary.json", result)
    write_report(out / "report.html", result)
    return summary_text(result)


def _wound_file(out: Path, session: Session) -> WoundFile:
    from hardware.wound_file import WoundFile  # loads onnxruntime
    from perception.wound.network import WoundNetwork, shipped
    from perception.wound.segmentation import NetworkSegmenter

    network = WoundNetwork(shipped(), threads=1)  # the other core is the tracker's
    return WoundFile(out, session.rig, NetworkSegmenter(network, network.settings))


def run_track(
    path: Path,
    out: Path,
    record: Path | None = None,
    force: bool = False,
    method: str = MAP,
    tool: Array | None = None,
    prefilter: str = "none",
    wound: bool = False,
) -> str:
    """Track the session at `path` into the folder `out`; returns the summary as text.

    method: a key of METHODS. tool: (K, 2) mm, profile of what hangs on the session's arm, as `ArmProfile.tool`; None
    for the usual one. prefilter: a key of perception.prefilter.PREFILTERS. wound: whether the wound is segmented
    beside it, into wound.csv. Whatever ends the run early, a fault of the input or Ctrl-C, leaves poses and a report of
    all frame sets until then.
    """
    session = open_session(path)
    prepare_out(out, force)
    clock = WallClock()
    cameras = [camera.name for camera in session.rig.cameras]
    complete = False
    with ExitStack() as stack:
        follows = step_by(method, session.rig, session.roi, session.surface, clock.now, tool, prefilter)
        step = stack.enter_context(follows)
        sinks = [] if record is None else [stack.enter_context(TrackRecorder(record, session, force)).write]
        if wound:
            sinks.append(stack.enter_context(_wound_file(out, session)).write)
        writer = stack.enter_context(PoseWriter(out, cameras, STAGES))
        progress = stack.enter_context(Progress("track", "frame sets", clock.now))
        try:
            follow(session.frame_sets(), step, writer, clock.now, progress, len(session), sinks)
            complete = True
        finally:
            text = finish(out, session, complete, method)
    return f"{text}\nreport: {out / 'report.html'}"
