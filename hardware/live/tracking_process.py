"""The tracking process of a live run: frame sets in, poses out to the motion; both are recorded and reported.

It may stall or die at any instant: the motion's newest pose then grows too old, and the guard holds the arm.
"""

from __future__ import annotations

import signal
from collections import deque
from contextlib import ExitStack, suppress
from dataclasses import replace
from logging import INFO
from types import FrameType

import numpy as np

from estimation import se3
from estimation.errors import InputError, StillbedError
from estimation.pose import SurfacePose, TrackState
from estimation.runtime import use_one_arena
from estimation.se3 import Array
from hardware.files.mesh_file import read_mesh
from hardware.files.rig_file import agreed_scan
from hardware.files.session import Session, head_from_row, row_from_head
from hardware.live.frame_source import FrameSource, LiveCameraSource, RingSource, TimedFrameSet
from hardware.live.prepared import Prepared
from hardware.live.recorder_process import RecorderSender
from hardware.live.records import (
    CommandedHead,
    EventEntry,
    PoseEntry,
    ScanEntry,
    SearchOrder,
    SetEntry,
    StageHistograms,
    SurfaceEntry,
    TrackingChannels,
    TrackingReport,
)
from hardware.live.trace import QUEUE_STAGE, TRACKING_LANE, TraceLane, in_turn
from hardware.motion.step import PoseHandover
from hardware.offline.looks import LiveLooks, station_places
from hardware.offline.track import SETTLING_TIME, region_search, restore_map, tracker
from hardware.operator.overlays import OutlineSheet, SurfaceOutline, scan_drawing, sheet_from_rois, sheet_from_sight
from hardware.operator.process import CameraShot, Thumbnailer
from hardware.operator.shared_state import LaidDrawing, Polygons
from hardware.process.clock import WallClock, own_interval
from hardware.process.system import (
    TRACKING_PRIORITY,
    ask_for_real_time,
    pipe_closed,
    set_up_process,
    settle_memory,
    signal_at_parents_end,
)
from hardware.recording.session_reader import open_session
from perception.frames import FrameSet, Roi, region_since
from perception.tracking.step import STAGES, TrackingStep
from perception.tracking.wound_step import RegionTrackingStep
from planning.placement import (
    NoSurfaceError,
    PathPlacement,
    PlacedBy,
    path_middle,
    placement_by_region,
    placement_by_scan,
)

FRAME_WAIT = 0.1  # s of a wait for frames, after which the lifeline is looked at
MAP_REFRESH_SETS = 15  # sets between two looks at the map for the page
SHOWN_LANDMARKS = 300  # landmarks that the page shows, about
INTERVAL_WINDOW = 31  # intervals between sets from which that of the cameras is estimated: a second of them
HISTOGRAM_PERIOD = 30.0  # s between histograms in the recording
EXPOSURE_STAGE = "exposure to frames handed over"
TRACKING_STAGE, HANDED_TO_POSE_STAGE = "tracking", "frames handed over to pose"
AFTER_POSE_STAGE = "pose handed over to ready for frames"
MAP_LATE = "a part of the map is late: it counts once it is ready; stillbed track of this recording takes it when due"
TRUE_PLACE = "placed in the true frame of the simulated world"


def track(prepared: Prepared, channels: TrackingChannels) -> None:
    """The body of the process: track until the frames end or the lifeline does; the last report says why."""
    set_up_process("tracking", prepared.settings.cores_tracking)
    use_one_arena()
    if prepared.settings.real_time:  # the process of the map and the page's pictures step back behind it
        ask_for_real_time(TRACKING_PRIORITY)
    signal.signal(signal.SIGTERM, _terminate)
    signal_at_parents_end(signal.SIGTERM)
    sender = RecorderSender(channels.recorder)
    try:
        with ExitStack() as stack:
            run = _TrackingLoop(prepared, channels, sender, stack)
            try:
                run()
            except (StillbedError, OSError) as error:  # reported before files are closed: the arm is stopped for it
                channels.shared.tracking.put(replace(run.report, ended=str(error)))
            finally:
                run.close()
                for entry in run.times.entries(WallClock().now()):
                    sender.put(entry)
    except (StillbedError, OSError) as error:
        channels.shared.tracking.put(TrackingReport(WallClock().now(), ended=str(error)))
    except _Terminated:
        pass
    finally:
        sender.close()
        if (last := channels.shared.tracking.get()) is not None:
            channels.shared.tracking.put(replace(last, unrecorded=sender.dropped))


class _Terminated(BaseException):
    """SIGTERM has come."""


def _terminate(number: int, frame: FrameType | None) -> None:
    raise _Terminated


class _TrackingLoop:
    """Feeds frame sets to the tracking step, and hands its poses on. report: the last one."""

    def __init__(
        self, prepared: Prepared, channels: TrackingChannels, sender: RecorderSender, stack: ExitStack
    ) -> None:
        self._prepared, self._sender, self._lifeline = prepared, sender, channels.lifeline
        shared = self._shared = channels.shared
        self._clock, self.times = WallClock(), StageHistograms()
        self._commanded_head = CommandedHead(shared.motion, prepared.task.profile)
        self._histograms_recorded = -np.inf  # s
        self._lane = TraceLane(TRACKING_LANE, self._clock, sender.put) if prepared.settings.trace else None
        self._late = 0  # `TrackingStep.late` at the last set
        self._source: FrameSource
        self._step: TrackingStep | RegionTrackingStep
        self._outline: SurfaceOutline
        self._session: Session | None = None  # that is shown; held, as it may have unpacked the scan
        if prepared.live:
            self._source = LiveCameraSource(prepared.session)
            rig = self._source.rig
        else:
            self._session = open_session(prepared.session)
            self._source, rig = RingSource(shared.ring, channels.notices), self._session.rig
        stack.callback(self._source.close)
        session, placement = self._session, prepared.placement
        self._rig, self._truth = rig, None if session is None else session.truth
        self._surface = agreed_scan(prepared.scan, None if session is None else session.surface, prepared.session)
        self._thumbnailer = Thumbnailer(shared.link.pictures, shared.link.status)
        self.report = TrackingReport(self._clock.now(), tuple(camera.name for camera in rig.cameras))
        self._last_stamp, self._intervals = np.nan, deque[float](maxlen=INTERVAL_WINDOW)
        shared.tracking.put(self.report)
        self._earlier = None if placement is None else open_session(placement.map)
        source, region = session if self._earlier is None else self._earlier, prepared.settings.region
        rois = () if source is None else source.roi
        if self._earlier is None and region.by is not None:
            rois = region.rois(rig, self.report.stamp)
        sender.put(rig)
        self._scan = None if self._surface is None else read_mesh(self._surface)
        if self._surface is not None and self._scan is not None:
            sender.put(ScanEntry(self._surface))
            shared.link.scan.put(scan_drawing(self._scan))
        for roi in rois:
            sender.put(replace(roi, stamp=self.report.stamp))
        self._rois, self._region_drawn = rois, region.drawn and not rois
        self._sheet: OutlineSheet | None = None  # of this look, where a network looked
        task = prepared.task
        adapt = shared.shares.put if prepared.settings.adapt else None
        self._looks = LiveLooks(rig, task.path, stack, adapt, task.flows) if task.looks else None
        self._steps = stack.enter_context(ExitStack())
        self._look(SearchOrder(0, ()))

    def _look(self, order: SearchOrder) -> None:
        """Search for the surface with a new tracker; a run that resumes gives it the earlier map.

        An outline by the operator is the region, without the skin beside it.
        """
        outlined = self._outlined(order.outline)
        self._steps.close()
        self._outline = SurfaceOutline(self._rig)
        path_placement, placement, settings = None, self._prepared.placement, self._prepared.settings
        # the stamps of earlier pictures are to end a second ago: the clock may have begun anew since
        shift = 0.0 if placement is None else self._clock.now() - placement.until - SETTLING_TIME - 1.0
        starts = [-np.inf if self._earlier is None else roi.stamp + shift for roi in self._rois]
        timed = outlined or tuple(replace(roi, stamp=stamp) for roi, stamp in zip(self._rois, starts, strict=True))
        self._by_outline, self._region_recorded = bool(outlined), bool(self._rois) and not outlined
        find = region_search(self._rig, settings.region, self._shared.link.regions, settings.model)
        clock, tool = self._clock.now, self._prepared.task.profile.tool
        step = tracker(self._rig, timed, self._scan, clock, tool, model=settings.model, find=find, waits=False)
        self._step = self._steps.enter_context(step)
        if placement is not None and self._earlier is not None:
            new_from_old = restore_map(
                self._step, placement.map, placement.since, placement.until, self._earlier, shift
            )
            verdict = f"as the run before placed it: {placement.verdict}" if placement.verdict else "as the run before"
            surface_from_path = new_from_old @ placement.surface_from_path
            path_placement = PathPlacement(surface_from_path, PlacedBy.EARLIER, verdict, placement.certain, True)
        report = replace(self.report, placement=path_placement, registered=np.nan, surface=None, looks=order.looks)
        self.report = replace(report, since=np.nan, outlined=False)

    def _outlined(self, outline: Polygons) -> tuple[Roi, ...]:
        """The corrected outline, if there is one, moved with the wound; recorded with its pictures."""
        pose, sheet, self._sheet = self.report.pose, self._sheet, None
        if not outline or sheet is None:
            return ()
        for picture in sheet.recorded(outline, self._clock.now()):
            self._sender.put(picture)
        measured = pose is not None and pose.state.measured
        return sheet.rois(outline, pose.base_from_surface if measured and pose is not None else None)

    def _offer_outline(self, frames: FrameSet, pose: SurfacePose) -> None:
        """Give the page, once a look, pictures with the wound's outline, on which the operator can correct it."""
        step, settings = self._step, self._prepared.settings
        if self._sheet is None and settings.page and not settings.unattended:
            sheet, sight = None, step.sight if isinstance(step, RegionTrackingStep) else None
            if sight is not None:
                sheet = sheet_from_sight(self._rig, sight)
            elif self._by_outline:
                sheet = sheet_from_rois(self._rig, frames, step.roi)
            if sheet is not None:
                with suppress(InputError):  # larger than their place: nothing is offered then
                    self._shared.link.sheet.put(sheet.pictures())
                    self._sheet = sheet
        if self._sheet is not None and pose.state.measured and (surface_map := step.map) is not None:
            self._sheet.place(surface_map.points, pose.base_from_surface)

    def __call__(self) -> None:
        settle_memory()
        while not pipe_closed(self._lifeline):
            order = self._shared.search.get()
            if order is not None and order.looks != self.report.looks:
                self._look(order)
            timed_set = self._source.take(FRAME_WAIT)
            if timed_set is None:
                self.report = replace(self.report, stamp=self._clock.now())
                self._shared.tracking.put(self.report)
            else:
                self._track(timed_set)

    def close(self) -> None:
        """Hand over the rest of the trace."""
        if self._lane is not None:
            self._lane.close()

    def _track(self, timed_set: TimedFrameSet) -> None:
        frames = self._with_head(timed_set.frames)
        start = self._clock.now()
        pose = self._step(frames)
        sent = self._clock.now()
        self._shared.poses.put(PoseHandover(pose, timed_set.handed, sent))
        self._shared.bell.ring()
        self._count_times(timed_set, pose, start, sent)
        self._offer_outline(frames, pose)
        self._look_at_print(frames, pose)
        self._register(pose, timed_set)
        self._report(timed_set, pose)
        self._show(frames, pose)
        self._record_region(frames.stamp)
        self._record(timed_set, frames, pose)
        recorded = self._clock.now()
        self._step.idle()
        self._source.learn(self._step.last.offsets)
        ready = self._clock.now()
        self.times.add(AFTER_POSE_STAGE, ready - sent)
        if (late := self._step.late) != self._late:
            self._late = late
            self._sender.put(EventEntry(ready, MAP_LATE, INFO, "tracking"))
        if self._lane is not None:
            stages = in_turn(start, STAGES, self._step.last.seconds)
            after = ("page and record", sent, recorded), ("map and idle work", recorded, ready)
            self._lane.add(pose.stamp, [(QUEUE_STAGE, timed_set.handed, start), *stages, *after])

    def _look_at_print(self, frames: FrameSet, pose: SurfacePose) -> None:
        """Look at the print while the nozzle waits aside."""
        if self._looks is None:
            return
        motion, surface_map = self._shared.motion.get(), self._step.map
        progress, command = (None, None) if motion is None else (motion.progress, motion.tick.command)
        landmarks = None if surface_map is None else surface_map.points
        look = self._looks(progress, command, frames, pose, landmarks, self._shared.placed.get())
        if look is not None and self._looks.placed is not None:
            self._sender.put(look)
            self._shared.link.laid.put(LaidDrawing(station_places(look, self._looks.placed, 2), look.laid.share))

    def _with_head(self, frames: FrameSet) -> FrameSet:
        """The set with the print head's pose at its stamp, rounded as in a recording: a replay gets the same."""
        head = self._commanded_head.at(frames.stamp) if self._prepared.live else frames.head
        if head is not None:
            head = head_from_row(row_from_head(frames.stamp, head), head.extruding)
        return replace(frames, head=head)

    def _count_times(self, timed_set: TimedFrameSet, pose: SurfacePose, start: float, sent: float) -> None:
        (times := self.times).add(EXPOSURE_STAGE, timed_set.handed - pose.stamp)
        times.add(QUEUE_STAGE, start - timed_set.handed)
        for stage, seconds in zip(STAGES, self._step.last.seconds, strict=False):
            times.add(f"tracking: {stage}", float(seconds))
        times.add(TRACKING_STAGE, sent - start)
        times.add(HANDED_TO_POSE_STAGE, sent - timed_set.handed)

    def _register(self, pose: SurfacePose, timed_set: TimedFrameSet) -> None:
        """Place the path, once: by the scan, in the true frame of a simulated world, or by the region."""
        if np.isnan(self.report.since):
            self.report = replace(self.report, since=timed_set.frames.stamp)
        if self.report.placement is not None or not pose.state.measured:
            return
        scan, path_placement = self._step.registration, None
        if scan is None and pose.state is not TrackState.TRACKING:
            return
        middle, outward = path_middle(self._prepared.task.path), self._outward(pose)
        if scan is not None:
            path_placement = placement_by_scan(scan, middle, outward)
        elif self._prepared.again and self._truth is not None:
            surface_from_path = se3.inverse(pose.base_from_surface) @ self._truth.at(np.array([timed_set.source]))[0]
            path_placement = PathPlacement(surface_from_path, PlacedBy.TRUTH, TRUE_PLACE, True, True, 0.0, 0.0, outward)
        elif (surface_map := self._step.map) is not None:
            self._outline.place(self._step.roi, surface_map.points, pose.base_from_surface)
            with suppress(NoSurfaceError):  # the map grows
                outlines = self._outline.on_surface
                path_placement = placement_by_region(self._prepared.task.path, outlines, surface_map.points, outward)
        if path_placement is not None:
            self.report = replace(self.report, placement=path_placement, registered=pose.stamp)
            settle_memory()  # what was compiled since, as nothing moves yet

    def _outward(self, pose: SurfacePose) -> Array:
        """(3,) from the surface's middle to that of the cameras, surface frame."""
        cameras = np.mean([camera.base_from_camera[:3, 3] for camera in self._rig.cameras], axis=0)
        surface_map = self._step.map
        points = np.zeros((1, 3)) if surface_map is None else surface_map.points
        direction = se3.transform_points(se3.inverse(pose.base_from_surface), cameras[None])[0] - points.mean(axis=0)
        return np.asarray(direction / np.linalg.norm(direction))

    def _report(self, timed_set: TimedFrameSet, pose: SurfacePose) -> None:
        report = self.report
        self.report = replace(
            report,
            stamp=self._clock.now(),
            delivering=tuple(frame.camera for frame in timed_set.frames.frames),
            pose=pose,
            sets=report.sets + 1,
            dropped=report.dropped + timed_set.dropped,
            interval=self._interval(timed_set),
            unrecorded=self._sender.dropped,
            timings=self.times.timings(),
            used=tuple(int(n) for n in self._step.last.used),
            truth=None if self._truth is None else self._truth.at(np.array([timed_set.source]))[0],
            surface=self._landmarks(pose),
            draws=self._region_drawn and not self._step.roi,
            outlined=self._sheet is not None,
            looked=0 if self._looks is None else self._looks.count,
            look="" if self._looks is None else self._looks.text,
        )
        self._shared.tracking.put(self.report)

    def _landmarks(self, pose: SurfacePose) -> Array | None:
        """Landmarks (V, 3) for the page, taken anew now and then, as the map grows."""
        if self.report.sets % MAP_REFRESH_SETS or (surface_map := self._step.map) is None:
            return self.report.surface
        if not self._outline.on_surface and pose.state.measured:
            self._outline.place(self._step.roi, surface_map.points, pose.base_from_surface)
        landmarks = np.array(surface_map.points[:: max(len(surface_map) // SHOWN_LANDMARKS, 1)])
        self._sender.put(SurfaceEntry(pose.stamp, landmarks, tuple(self._outline.on_surface)))
        return landmarks

    def _interval(self, timed_set: TimedFrameSet) -> float:
        """The time between two sets, s, those that were dropped included; NaN before the second."""
        stamp = timed_set.frames.stamp
        if not np.isnan(self._last_stamp):
            self._intervals.append((stamp - self._last_stamp) / (1 + timed_set.dropped))
        self._last_stamp = stamp
        return own_interval(self._intervals)

    def _show(self, frames: FrameSet, pose: SurfacePose) -> None:
        """Offer the pictures to the page, if it is open in a browser."""
        if not self._shared.link.status.windows:
            return
        observations, names = self._step.last.observations, self.report.cameras
        base_from_surface = pose.base_from_surface if pose.state.measured else None
        shots = []
        for frame in frames.frames:
            outline = () if base_from_surface is None else self._outline.in_pixels(frame.camera, base_from_surface)
            tracks = observations.pixels[observations.camera == frame.camera]
            shots.append(CameraShot(names[frame.camera], frame.image, outline, tracks))
        self._thumbnailer.offer(frames.stamp, shots, base_from_surface)

    def _record_region(self, stamp: float) -> None:
        """Record a region that was found or drawn, so that tracking of the recording begins with the same frame set."""
        if self._region_recorded or not self._step.roi:
            return
        self._region_recorded, searched = True, isinstance(self._step, RegionTrackingStep)
        for roi in self._step.roi:
            self._sender.put(region_since(roi, roi.stamp if searched else stamp))

    def _record(self, timed_set: TimedFrameSet, frames: FrameSet, pose: SurfacePose) -> None:
        unencoded = tuple(frame for frame in frames.frames if frame.camera not in timed_set.encoded)
        self._sender.check()
        self._sender.put(SetEntry({f.camera: f.stamp for f in frames.frames}, timed_set.encoded, unencoded))
        self._sender.put(PoseEntry(pose, self._step.last.observations, frames.head, self.report.truth))
        if (now := self._clock.now()) > self._histograms_recorded + HISTOGRAM_PERIOD:
            self._histograms_recorded = now
            for entry in self.times.entries(now):
                self._sender.put(entry)
