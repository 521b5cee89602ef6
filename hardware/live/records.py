"""What the processes of a live run hand to each other, and what they give to the recorder."""

from __future__ import annotations

from collections.abc import Mapping
from ctypes import c_double
from dataclasses import dataclass, field
from functools import partial
from math import nan
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawValue
from pathlib import Path as File

import numpy as np
from numpy.typing import NDArray

from estimation.observations import Observations
from estimation.pose import SurfacePose
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.device import ArmEvent
from hardware.arm.profile import ArmProfile
from hardware.live.frame_source import Encoded, FrameRing
from hardware.live.trace import TraceBatch
from hardware.motion.loop import CommandedPose, DispenserRecord, MaterialStatus, RecordedTick, Tick
from hardware.motion.step import PoseHandover
from hardware.operator.shared_state import OperatorLink, Polygons
from hardware.process.clock import Histogram
from hardware.process.system import Bell, SharedLatest
from hardware.recording.loop_record import LoopRecord
from perception.frames import Frame, OutlinedPicture, PrintHead, Roi
from planning.laid_beads import Look
from planning.material import FlowShares
from planning.path import PrintProgress
from planning.placement import PathPlacement

FRAMES_TO_WIRE_STAGE = "frames handed over to move on the wire"  # as it stands in reports and recordings
EXPOSURE_TO_WIRE_STAGE = "exposure to move on the wire"
LATE_TICK_STAGE = "tick late"
TROUBLE_BYTES, SHARES_BYTES = 4096, 2**22  # of the text about the arm's failure; of a layer's flows: 170,000 pieces


@dataclass(frozen=True, slots=True)
class StageTiming:
    """How long a stage of the processing took so far, s."""

    name: str
    count: int
    median: float
    p99: float
    largest: float


@dataclass(frozen=True, slots=True, eq=False)
class TrackingReport:
    """The report of the tracking process after each frame set."""

    stamp: float  # s, of the report
    cameras: tuple[str, ...] = ()  # names
    delivering: tuple[int, ...] = ()  # numbers of the cameras in the last set
    pose: SurfacePose | None = None  # the newest
    placement: PathPlacement | None = None  # of the path in the tracker's surface frame; None until it is known
    registered: float = nan  # s, stamp of the pose by which the path was placed
    sets: int = 0  # frame sets tracked
    dropped: int = 0  # frame sets left out, as a newer one was there
    interval: float = nan  # s between two sets
    unrecorded: int = 0  # entries for which the recorder had no room
    timings: tuple[StageTiming, ...] = ()
    used: tuple[int, ...] = ()  # tracks, by camera
    ended: str = ""  # why there will be no more, "" while there are
    truth: Array | None = None  # (4, 4) mm, true base_from_surface at the pose's stamp, of a simulated world
    surface: Array | None = None  # (V, 3) mm, landmarks in the surface frame
    draws: bool = False  # whether somebody has to draw the region first
    looks: int = 0  # how often the surface was looked for anew
    since: float = nan  # s, stamp of the first frame set since then
    outlined: bool = False  # whether the page was given pictures to correct the wound's outline on
    looked: int = 0  # how often what was laid was looked at
    look: str = ""  # what the last of these looks told


@dataclass(frozen=True, slots=True, eq=False)
class LiveMotionReport:
    """The report of the motion process after each tick."""

    tick: Tick  # the last one
    progress: PrintProgress | None  # None before a path was begun
    material: MaterialStatus | None  # None where nothing is extruded
    events: tuple[ArmEvent, ...]  # the last ones
    timings: tuple[StageTiming, ...]  # from frames to the wire, and how late ticks were
    skipped: int  # ticks that were not made
    stops: int  # how many stops were sent
    stop: tuple[float, float] | None  # the last one's decision and the end of its frame on the wire, s
    unrecorded: int  # entries for which the recorder had no room
    priority: str  # of the process, as granted
    pose_stamp: float = nan  # s, of the pose that the tick was made of; NaN of none
    lag: float = nan  # s, of the arm, as the motion has it; NaN before a path was begun


class CommandedHead:
    """Where the print head should be, by the newest commands of the motion process."""

    def __init__(self, reports: SharedLatest[LiveMotionReport], profile: ArmProfile) -> None:
        self._reports, self._commanded = reports, CommandedPose(profile)
        self._last_tick = -np.inf

    def at(self, stamp: float) -> PrintHead | None:
        """The head at `stamp`, s; commands between two looks are on a straight line, 40 ms at most."""
        report = self._reports.get()
        if report is not None and report.tick.stamp > self._last_tick and report.progress is not None:
            self._last_tick = report.tick.stamp
            self._commanded.add(report.tick.command, self._last_tick)
        return self._commanded.at(stamp)


@dataclass(frozen=True, slots=True, eq=False)
class RecorderReport:
    """The report of the recorder."""

    written: int  # bytes
    share: float  # of one core that it takes
    failed: str  # why it stopped, "" while it writes


@dataclass(slots=True)
class RunReports:
    """The newest reports."""

    tracking: TrackingReport | None = None
    motion: LiveMotionReport | None = None
    recorder: RecorderReport | None = None
    own_unrecorded: int = 0  # entries of the process that supervises, for which the recorder had no room

    @property
    def unrecorded(self) -> int:
        """Entries of all processes for which the recorder had no room: pictures first, then poses, ticks, messages."""
        reports = self.tracking, self.motion
        return self.own_unrecorded + sum(report.unrecorded for report in reports if report is not None)

    @property
    def gaps(self) -> tuple[str, ...]:
        """What is missing in the recording, in words; nothing where it is whole."""
        count = self.unrecorded
        what = "1 entry" if count == 1 else f"{count} entries"
        return (f"the recording has gaps: the disk or the processor was too slow for {what}",) if count else ()


# -- what is recorded


@dataclass(frozen=True, slots=True)
class ScanEntry:
    """The file of the scan that the tracker registers to."""

    file: File


@dataclass(frozen=True, slots=True, eq=False)
class SetEntry:
    """A frame set as the tracker took it."""

    stamps: Mapping[int, float]  # s, by camera
    encoded: Mapping[int, Encoded]  # pictures as the camera gave them, by camera
    frames: tuple[Frame, ...] = ()  # the others


@dataclass(frozen=True, slots=True, eq=False)
class PoseEntry:
    """A pose and what it is made of."""

    pose: SurfacePose
    observations: Observations
    head: PrintHead | None = None  # that was masked out
    truth: Array | None = None  # (4, 4) mm, true base_from_surface where it is known


@dataclass(frozen=True, slots=True, eq=False)
class UsedPoses:
    """The last poses that the motion process used: what the tracking process could not record before it died."""

    poses: tuple[SurfacePose, ...]  # by stamp


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceEntry:
    """What viewers are shown of the surface: landmarks (V, 3) and outlines of the region (K, 3), mm, in its frame."""

    stamp: float  # s
    landmarks: Array
    outlines: tuple[Array, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScanEntry:
    """The scan as viewers are shown it: vertices (N, 3), mm, where they lie in the surface frame."""

    stamp: float  # s
    points: Array


@dataclass(frozen=True, slots=True)
class WireEntry:
    """Bytes that passed the arm's port."""

    stamp: float  # s
    data: bytes
    sent: bool  # rather than received


@dataclass(frozen=True, slots=True)
class EventEntry:
    """A line of the recording's log."""

    stamp: float  # s
    text: str
    level: int  # of Python's logging
    name: str  # of whom it comes from


@dataclass(frozen=True, slots=True, eq=False)
class LatencyEntry:
    """How long a stage took so far."""

    stamp: float  # s
    stage: str
    width: float  # s of a bin
    counts: NDArray[np.int64]  # (N,) of each bin
    largest: float  # s


@dataclass(frozen=True, slots=True)
class UsedEntry:
    """A file that the run used, kept in the recording."""

    name: str
    text: str


# the rig comes first: nothing is written before the cameras are known
Record = Roi | OutlinedPicture | RecordedTick | LoopRecord | DispenserRecord
Shown = SurfaceEntry | PlacedScanEntry | EventEntry | LatencyEntry | TraceBatch | Look
Entry = Rig | ScanEntry | UsedEntry | SetEntry | PoseEntry | UsedPoses | Record | WireEntry | Shown


class StageHistograms:
    """How long each stage takes, as a histogram each: a run of any length costs the same memory."""

    def __init__(self) -> None:
        self._stages: dict[str, Histogram] = {}

    def add(self, stage: str, seconds: float) -> None:
        """Count one duration, s, of a stage."""
        self._stages.setdefault(stage, Histogram()).add(seconds)

    def timings(self) -> tuple[StageTiming, ...]:
        """The figures of each stage."""
        return tuple(
            StageTiming(name, h.count, h.percentile(50), h.percentile(99), h.most) for name, h in self._stages.items()
        )

    def entries(self, stamp: float) -> list[LatencyEntry]:
        """The histograms as they are at `stamp`, s, for the recording."""
        return [LatencyEntry(stamp, name, h.width, h.counts.copy(), h.most) for name, h in self._stages.items()]


@dataclass(frozen=True, slots=True)
class SearchOrder:
    """To look for the surface anew."""

    looks: int  # how often that was ordered
    outline: Polygons  # of the wound, to look inside it; none: the region is found as at first


@dataclass(frozen=True, slots=True, eq=False)
class SharedState:
    """What the processes of a run share in memory; each part has one process that writes it."""

    ring: FrameRing  # frames of a session that is shown; their notices come by a pipe
    tracking: SharedLatest[TrackingReport] = field(default_factory=SharedLatest)
    motion: SharedLatest[LiveMotionReport] = field(default_factory=SharedLatest)
    recorder: SharedLatest[RecorderReport] = field(default_factory=SharedLatest)
    poses: SharedLatest[PoseHandover] = field(default_factory=SharedLatest)  # from the tracking to the motion
    bell: Bell = field(default_factory=Bell)  # ends the motion's wait: rung once a pose or an order is there
    # place on the path, in checkpoints, NaN before it is begun; set before a command goes to the arm
    place: c_double = field(default_factory=partial(RawValue, c_double, nan))
    start: c_double = field(default_factory=partial(RawValue, c_double, nan))  # s, when printing began; NaN before
    search: SharedLatest[SearchOrder] = field(default_factory=SharedLatest)  # to the tracking
    placed: SharedLatest[Array] = field(default_factory=SharedLatest)  # (4, 4) mm surface_from_path, once it is begun
    # flows of the next layer, from the tracking to the motion, put before the order MATERIAL_IN
    shares: SharedLatest[FlowShares] = field(default_factory=partial(SharedLatest, SHARES_BYTES))
    trouble: SharedLatest[str] = field(default_factory=partial(SharedLatest, TROUBLE_BYTES))  # why the arm is no use
    link: OperatorLink = field(default_factory=OperatorLink)


@dataclass(frozen=True, slots=True, eq=False)
class TrackingChannels:
    """What joins the tracking process to the others."""

    shared: SharedState
    notices: Connection  # of the frames in the ring
    recorder: Connection
    lifeline: Connection  # its end says that the run is gone


@dataclass(frozen=True, slots=True, eq=False)
class MotionChannels:
    """What joins the motion process to the others."""

    shared: SharedState
    url: str  # of the arm's port
    orders: Connection
    recorder: Connection


TIMELINE_BINS = 600  # an even number: two bins become one
FIRST_BIN_WIDTH = 0.1  # s of a bin at first


class ErrorTimeline:
    """The predicted error over a run, in bins that become twice as long whenever all are full.

    width: s of each bin.
    error: (TIMELINE_BINS,) mm, the largest predicted in each while material left, NaN where none did.
    held: (TIMELINE_BINS,) s for which the nozzle was held.
    """

    def __init__(self) -> None:
        self.width = FIRST_BIN_WIDTH
        self.error = np.full(TIMELINE_BINS, np.nan)
        self.held = np.zeros(TIMELINE_BINS)
        self._start = nan
        self._last_bin = 0

    @property
    def stamps(self) -> Array:
        """(N,) s since the first tick, the middles of the bins so far."""
        return np.asarray((np.arange(self._last_bin + 1) + 0.5) * self.width, float)

    def add(self, stamp: float, error: float, held: float) -> None:
        """A tick at `stamp`, s, with its predicted error, mm or NaN, and the s for which it was held."""
        if np.isnan(self._start):
            self._start = stamp
        while (stamp - self._start) / self.width >= TIMELINE_BINS:
            half = np.full(TIMELINE_BINS // 2, np.nan), np.zeros(TIMELINE_BINS // 2)
            self.error = np.concatenate([np.fmax(self.error[::2], self.error[1::2]), half[0]])
            self.held = np.concatenate([self.held[::2] + self.held[1::2], half[1]])
            self.width *= 2
        self._last_bin = max(0, int((stamp - self._start) / self.width))
        self.error[self._last_bin] = np.fmax(self.error[self._last_bin], error)
        self.held[self._last_bin] += held


TRACK_STEP, TRACK_PLACES = 0.2, 8000  # mm between places at first, and how many are kept: an even number


class NozzleTrack:
    """Where the tip was on the surface while material left; when it is full every second place goes.

    It takes the same memory from the start on, however long the run and however many its beads.
    """

    def __init__(self) -> None:
        self._places, self._begins = np.full((TRACK_PLACES, 3), np.nan), np.zeros(TRACK_PLACES, bool)  # mm; of a bead
        self._count, self._step, self._lifted = 0, TRACK_STEP, True

    @property
    def places(self) -> Array:
        """(N, 3) mm, a row of NaN between two beads."""
        cuts = 1 + np.flatnonzero(self._begins[1 : self._count])
        return np.insert(self._places[: self._count], cuts, np.nan, axis=0)

    def add(self, place: Array) -> None:
        """The tip is at `place` (3,), mm, and material leaves."""
        if not self._lifted and float(np.linalg.norm(place - self._places[self._count - 1])) < self._step:
            return
        if self._count == TRACK_PLACES:
            self._thin()
        self._places[self._count], self._begins[self._count] = place, self._lifted
        self._count, self._lifted = self._count + 1, False

    def lift(self) -> None:
        """No material leaves."""
        self._lifted = True

    def _thin(self) -> None:
        """Drop every second place; the next one begins a bead where a dropped one did."""
        begins, self._count = self._begins, TRACK_PLACES // 2
        self._step, self._lifted = 2 * self._step, self._lifted or bool(begins[-1])
        self._places[: self._count] = self._places[::2]
        begins[1 : self._count] = begins[2::2] | begins[1:-1:2]
