"""The body of the tracking process: frame sets in, poses out, and what is recorded and reported of them.

It may stall or die at any instant: the pose that the motion has grows old, and the guard holds the arm.
"""

from __future__ import annotations

import signal
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

import numpy as np

from estimation import se3
from estimation.errors import InputError, StillbedError
from estimation.heap import share_pages
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.trajectory import Trajectory
from hardware.arm.profile import ArmProfile
from hardware.commanded import Commanded
from hardware.files.session import Session, open_session
from hardware.heads import head_from_row, row_from_head
from hardware.live.arrived import Arrived, Source
from hardware.live.frame_source import FrameRing, RingSource
from hardware.live.histograms import Histograms
from hardware.live.outbox import Outbox
from hardware.live.outline import Outline
from hardware.live.records import (
    Handed,
    LiveMotionReport,
    PoseEntry,
    RigEntry,
    RoiEntry,
    ScanEntry,
    SetEntry,
    TrackingReport,
)
from hardware.live.remembered import remember, true_pose
from hardware.operator.link import OperatorLink
from hardware.operator.taker import PictureTaker, Shot
from hardware.priority import ask_to_go_first, settle_memory
from hardware.process.clock import WallClock
from hardware.process.shared_latest import Newest
from hardware.process.system import gone, settle
from hardware.process.ticks import own_interval
from hardware.tracker import tracker
from perception.frames import FrameSet, PrintHead, Roi
from perception.tracking.step import STAGES

RIG = ".toml"  # of a file that names live cameras
PATIENCE = 0.1  # s of a wait for frames, after which it looks who else is still there
WAITED, TRACKED, POSED = "frames wait for the tracker", "tracking", "frames handed over to pose"
EXPOSED, TIDIED = "exposure to frames handed over", "pose handed over to ready for frames"
REFRESH, LANDMARKS = 15, 300  # sets between two looks at the map, and how many of its landmarks are shown, about
INTERVALS = 31  # between sets, from which the cameras' own is told: a second of them
HISTOGRAMS = 30.0  # s between histograms in the recording


@dataclass(frozen=True, slots=True, eq=False)
class TrackingPlan:
    """What is tracked. session: whose pictures come through the ring, or whose rig stands before live cameras.

    truth: whether the path lies in the session's true surface frame rather than the tracker's own. sees_arm: whether
    the pictures show the arm, as those of live cameras do; profile: of it. earlier: a recording whose first frame sets,
    up to `until`, s, make the map; surface_from_path: (4, 4) as it was registered on that.
    """

    session: Path
    truth: bool
    sees_arm: bool
    profile: ArmProfile
    earlier: Path | None = None
    until: float = 0.0
    surface_from_path: Array | None = None
    cores: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class TrackingLines:
    """What the tracking process is joined by. Either ring and words, or live cameras, bring frames."""

    ring: FrameRing
    words: Connection
    poses: Newest[Handed]
    reports: Newest[TrackingReport]
    motion: Newest[LiveMotionReport]
    link: OperatorLink
    record: Connection
    lifeline: Connection


def tracking_process(plan: TrackingPlan, lines: TrackingLines) -> None:
    """Track until the frames end, or nobody conducts the run any more; the last report says why."""
    settle("tracking", plan.cores)
    share_pages()
    ask_to_go_first()  # the process of the map, which stands back behind this one, is then an ordinary one
    signal.signal(signal.SIGTERM, _ended)
    outbox = Outbox(lines.record)
    try:
        with ExitStack() as stack:
            run = _Tracking(plan, lines, outbox, stack)
            try:
                run()
            except (StillbedError, OSError) as error:  # told before anything is put away, as the arm is stopped for it
                lines.reports.put(replace(run.report, ended=str(error), wrong=isinstance(error, InputError)))
            finally:
                for entry in run.times.entries(WallClock().now()):
                    outbox.put(entry)
    except (StillbedError, OSError) as error:
        nothing = TrackingReport(WallClock().now())
        lines.reports.put(replace(nothing, ended=str(error), wrong=isinstance(error, InputError)))
    except _Ended:
        pass
    finally:
        outbox.close()


class _Ended(BaseException):
    """Somebody asked this process to end."""


def _ended(number: int, frame: FrameType | None) -> None:
    raise _Ended


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """What is known of the cameras and the surface before the first picture."""

    rig: Rig
    roi: tuple[Roi, ...] = ()
    surface: Path | None = None
    truth: Trajectory | None = None
    session: Session | None = None  # held, as it may have unpacked the scan


def _opened(plan: TrackingPlan, lines: TrackingLines) -> tuple[_Known, Source]:
    """The cameras, live or shown, and what is known of them."""
    if plan.session.suffix == RIG:
        from hardware.live.camera_source import CameraSource  # loads what only live cameras need

        source = CameraSource(plan.session)
        return _Known(source.rig), source
    session = open_session(plan.session)
    known = _Known(session.rig, session.roi, session.surface, session.truth, session)
    return known, RingSource(lines.ring, lines.words)


class _Tracking:
    """One run of the tracking step. report: the last one that was given."""

    def __init__(self, plan: TrackingPlan, lines: TrackingLines, outbox: Outbox, stack: ExitStack) -> None:
        self._plan, self._lines, self._outbox = plan, lines, outbox
        self._clock, self.times = WallClock(), Histograms()
        self._commanded = _Heads(lines.motion, plan.profile)
        self._told = -np.inf  # s, when histograms were last recorded
        known, self._source = _opened(plan, lines)
        stack.callback(self._source.close)
        self._known = known
        self._pictures = PictureTaker(lines.link.pictures, lines.link.requests)
        names = tuple(camera.name for camera in known.rig.cameras)
        self.report = TrackingReport(self._clock.now(), names)
        self._outline = Outline(known.rig)
        self._before, self._intervals = np.nan, deque[float](maxlen=INTERVALS)
        lines.reports.put(self.report)
        first = None if plan.earlier is None else open_session(plan.earlier)
        rois = known.roi if first is None else first.roi
        self._give(known, rois)
        at_once = tuple(replace(roi, stamp=-np.inf) for roi in rois)
        follows = tracker(known.rig, at_once, known.surface, self._clock.now, plan.profile.tool)
        self._step = stack.enter_context(follows)
        if first is not None and plan.earlier is not None and plan.surface_from_path is not None:
            moved = remember(self._step, plan.earlier, first, plan.until, self._clock.now())
            self.report = replace(self.report, surface_from_path=moved @ plan.surface_from_path)

    def _give(self, known: _Known, rois: Sequence[Roi]) -> None:
        """Tell the recorder what is known before the first picture."""
        self._outbox.put(RigEntry(known.rig))
        if known.surface is not None:
            self._outbox.put(ScanEntry(known.surface))
        for roi in rois:
            self._outbox.put(RoiEntry(replace(roi, stamp=self.report.stamp)))

    def __call__(self) -> None:
        settle_memory()
        while not gone(self._lines.lifeline):
            arrived = self._source.take(PATIENCE)
            if arrived is None:
                self.report = replace(self.report, stamp=self._clock.now())
                self._lines.reports.put(self.report)
            else:
                self._track(arrived)

    def _track(self, arrived: Arrived) -> None:
        frames = self._with_head(arrived.frames)
        start = self._clock.now()
        pose = self._step(frames)
        put = self._clock.now()
        self._lines.poses.put(Handed(pose, arrived.handed, put))
        self._count(arrived, pose, start, put)
        self._register(pose, arrived)
        self._report(arrived, pose)
        self._show(frames, pose)
        self._record(arrived, frames, pose)
        self._step.idle()
        self._source.learn(self._step.last.offsets)
        self.times.add(TIDIED, self._clock.now() - put)

    def _with_head(self, frames: FrameSet) -> FrameSet:
        """The print head where the pictures show it, rounded as a recording keeps it: a replay sees the same."""
        head = self._commanded.at(frames.stamp) if self._plan.sees_arm else frames.head
        if head is not None:
            head = head_from_row(row_from_head(frames.stamp, head), head.extruding)
        return replace(frames, head=head)

    def _count(self, arrived: Arrived, pose: SurfacePose, start: float, put: float) -> None:
        times = self.times
        times.add(EXPOSED, arrived.handed - pose.stamp)
        times.add(WAITED, start - arrived.handed)
        for stage, seconds in zip(STAGES, self._step.last.seconds, strict=False):
            times.add(f"tracking: {stage}", float(seconds))
        times.add(TRACKED, put - start)
        times.add(POSED, put - arrived.handed)

    def _register(self, pose: SurfacePose, arrived: Arrived) -> None:
        """Where the path lies: in the frame that the tracker has laid, or in the true one where that is known."""
        if self.report.surface_from_path is not None or pose.state is not TrackState.TRACKING:
            return
        known = np.eye(4)
        if self._plan.truth and self._known.truth is not None:
            known = se3.inverse(pose.base_from_surface) @ true_pose(self._known.truth, arrived.source)
        self.report = replace(self.report, surface_from_path=known, registered=pose.stamp)
        settle_memory()  # what was compiled since, as nothing moves yet

    def _report(self, arrived: Arrived, pose: SurfacePose) -> None:
        report, frames = self.report, arrived.frames
        self.report = replace(
            report,
            stamp=self._clock.now(),
            seen=tuple(frame.camera for frame in frames.frames),
            pose=pose,
            sets=report.sets + 1,
            dropped=report.dropped + arrived.dropped,
            interval=self._interval(arrived),
            unrecorded=self._outbox.dropped,
            spans=self.times.spans(),
            used=tuple(int(n) for n in self._step.last.used),
            truth=None if self._known.truth is None else true_pose(self._known.truth, arrived.source),
            surface=self._surface(pose),
        )
        self._lines.reports.put(self.report)

    def _surface(self, pose: SurfacePose) -> Array | None:
        """Landmarks for the page, now and then anew, as the map grows."""
        if self.report.sets % REFRESH or (found := self._step.map) is None:
            return self.report.surface
        if not self._outline.laid and pose.state.measured:
            self._outline.lay(self._step.roi, found.points, pose.base_from_surface)
        return np.array(found.points[:: max(len(found) // LANDMARKS, 1)])

    def _interval(self, arrived: Arrived) -> float:
        """The time between two sets, s, those that nobody took included; NaN before the second."""
        stamp = arrived.frames.stamp
        if not np.isnan(self._before):
            self._intervals.append((stamp - self._before) / (1 + arrived.dropped))
        self._before = stamp
        return own_interval(self._intervals)

    def _show(self, frames: FrameSet, pose: SurfacePose) -> None:
        """Offer the pictures to the page, where anybody has it open."""
        if not self._lines.link.requests.windows:
            return
        seen, names = self._step.last.observations, self.report.cameras
        there = pose.base_from_surface if pose.state.measured else None
        shots = []
        for frame in frames.frames:
            outline = () if there is None else self._outline.in_pixels(frame.camera, there)
            tracks = seen.pixels[seen.camera == frame.camera]
            shots.append(Shot(names[frame.camera], frame.image, outline, tracks))
        self._pictures.offer(frames.stamp, shots, there)

    def _record(self, arrived: Arrived, frames: FrameSet, pose: SurfacePose) -> None:
        stamps = {frame.camera: frame.stamp for frame in frames.frames}
        bare = tuple(frame for frame in frames.frames if frame.camera not in arrived.encoded)
        self._outbox.put(SetEntry(stamps, arrived.encoded, bare))
        self._outbox.put(PoseEntry(pose, self._step.last.observations, frames.head, self.report.truth))
        if (now := self._clock.now()) > self._told + HISTOGRAMS:
            self._told = now
            for entry in self.times.entries(now):
                self._outbox.put(entry)


class _Heads:
    """Where the print head should be, by the newest commands of the motion process."""

    def __init__(self, reports: Newest[LiveMotionReport], profile: ArmProfile) -> None:
        self._reports, self._commanded = reports, Commanded(profile)
        self._last = -np.inf

    def at(self, stamp: float) -> PrintHead | None:
        """The head at `stamp`, s; commands between two looks are on a straight line, 40 ms at most."""
        report = self._reports.get()
        if report is not None and report.tick.stamp > self._last and report.progress is not None:
            self._last = report.tick.stamp
            self._commanded.add(report.tick.command, self._last)
        return self._commanded.at(stamp)
