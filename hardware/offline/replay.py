"""`stillbed replay`: tracking and the loop of a print in one process on a virtual clock, merged by stamp.

The motion gets a pose POSE_DELAY_S after its stamp. That fixed delay stands for transport and processing in place of
the measured time, so that the same input gives the same bytes on every machine. The loop, its pacing and the arm's link
are those of a live run; the arm is one that takes all and never answers, so the link knows its place by dead reckoning.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain
from pathlib import Path as File

import numpy as np

from estimation.errors import InputError
from estimation.pose import SurfacePose
from estimation.rig import Rig
from hardware.arm.driver import ArmDriver
from hardware.arm.port import Port
from hardware.arm.profile import ArmProfile, placed
from hardware.arm.s6h4d import S6H4D
from hardware.files.arm_file import write_arm
from hardware.files.folder_tables import csv_table
from hardware.files.path_file import ProgressFile, read_path, read_progress
from hardware.files.session import Session
from hardware.motion.loop import MaterialControl, Order, Tick
from hardware.motion.print_loop import LoopOrder, LoopSettings, PrintLoop
from hardware.motion.step import BeginPrint, PoseHandover
from hardware.process.clock import SimClock
from hardware.process.faults import Fault, FaultKind, FaultPart, FaultRunner, check_faults, faults_striking
from hardware.process.progress import ProgressReport, no_progress
from perception.frames import Frame, FrameSet, Image
from planning.command import Command, Move
from planning.path import PrintProgress


class FrameFaults:
    """Applies the faults of cameras to one frame set after the other, in order."""

    def __init__(self, faults: Sequence[Fault], rig: Rig, where: object) -> None:
        """InputError where cables are exchanged between cameras whose pictures differ in size."""
        self._faults, self._count = faults_striking(faults, FaultPart.CAMERA), len(rig)
        self._last: dict[int, Image] = {}  # of each camera, its last picture before it stuck
        for fault in faults_striking(self._faults, FaultPart.CAMERA, FaultKind.SWAP):
            sizes = [rig.cameras[camera].size for camera in self._pair(fault)]
            if sizes[0] != sizes[1]:
                raise InputError(where, "--fault", str(fault), "cameras whose pictures are of one size")

    def __call__(self, frames: FrameSet, instant: float) -> FrameSet:
        """The frame set as the cameras deliver it at `instant`, s; frames may be missing."""
        images = {frame.camera: frame.image for frame in frames.frames}
        for fault in self._faults:
            if fault.kind is FaultKind.SWAP and fault.covers(instant):
                one, other = self._pair(fault)
                if one in images and other in images:
                    images[one], images[other] = images[other], images[one]
        delivered = (self._frame(frame, images[frame.camera], instant) for frame in frames.frames)
        return replace(frames, frames=tuple(frame for frame in delivered if frame is not None))

    def _pair(self, fault: Fault) -> tuple[int, int]:
        return fault.number, (fault.number + 1) % self._count

    def _frame(self, frame: Frame, image: Image, instant: float) -> Frame | None:
        kinds = {fault.kind for fault in self._faults if fault.number == frame.camera and fault.covers(instant)}
        if FaultKind.OFF in kinds:
            return None
        if FaultKind.STUCK in kinds:
            return replace(frame, image=self._last.setdefault(frame.camera, image))
        self._last[frame.camera] = image
        if FaultKind.BLACK in kinds:
            image = np.zeros_like(image)
        elif FaultKind.FLASH in kinds:
            image = np.full_like(image, 255)
        return frame if image is frame.image else replace(frame, image=image)


def tracked_sets(sets: Iterable[FrameSet], faults: Sequence[Fault], rig: Rig, where: object) -> Iterator[FrameSet]:
    """The frame sets that tracking gets under faults of cameras and tracking, whose times count from the first set."""
    with_faults, pauses, start = FrameFaults(faults, rig, where), faults_striking(faults, FaultPart.TRACKING), None
    for frames in sets:
        start = frames.stamp if start is None else start
        delivered = with_faults(frames, frames.stamp - start)
        if delivered.frames and not any(fault.covers(frames.stamp - start) for fault in pauses):
            yield delivered


POSE_DELAY_S = 0.05  # s: 20 ms from exposure to decoded image, 15 ms of tracking, 15 ms of spread (30 Hz cameras, USB)
COMMAND_COLUMNS = (
    *("stamp_s", "kind", "x_mm", "y_mm", "z_mm", "a_deg", "b_deg", "c_deg"),
    *("feed_mm_min", "checkpoint", "extrude", "hold_ms", "reason"),
)


class ReplaySource(SimClock):
    """Poses that are known a fixed delay after their stamps, for a print's loop in virtual time; it is the clock.

    The arm never answers. An operator says that it stands at home, and arms it; it is disarmed once all poses were
    given. driver: of the arm.
    """

    material: MaterialControl | None = None

    def __init__(
        self,
        poses: Iterable[SurfacePose],
        order: BeginPrint,
        port: Port,
        delay: float = POSE_DELAY_S,
        hangs: Sequence[Fault] = (),
    ) -> None:
        """poses: in order of stamp, taken only when they are due. port: takes what is sent to the arm.

        delay: s, from a pose's stamp until the motion has it. hangs: faults during which the motion stands still, s
        from the first pose's stamp on, at which the clock begins. InputError where no pose comes.
        """
        self._coming, self._delay, self._hangs = iter(poses), delay, hangs
        self._handover: PoseHandover | None = None
        self._next = next(self._coming, None)
        super().__init__(0.0 if self._next is None else self._next.stamp)
        self._begin = self.now()
        self._first_orders: list[LoopOrder] = [order, Order.AT_HOME, Order.ARM]
        self.driver: ArmDriver = S6H4D(lambda: port, order.profile)

    def wait_until(self, instant: float) -> None:
        """Go on to `instant`, s, or to the end of a hang."""
        ends = [self._begin + fault.end for fault in self._hangs if fault.covers(instant - self._begin)]
        super().wait_until(max([instant, *ends]))

    def pose(self) -> PoseHandover | None:
        """The newest pose that is due; InputError for one whose stamp is not after the one before."""
        while self._next is not None and self._next.stamp + self._delay <= self.now():
            new = self._next
            self._handover, self._next = PoseHandover(new, new.stamp, new.stamp + self._delay), next(self._coming, None)
            if self._next is not None and not self._next.stamp > new.stamp:
                raise InputError("poses", "stamp", self._next.stamp, f"after the one before, {new.stamp} s")
        return self._handover

    def orders(self) -> Sequence[LoopOrder]:
        """At first to print; at the end to end."""
        orders: list[LoopOrder] = self._first_orders
        self._first_orders = []
        return [Order.QUIT] if self._next is None else orders

    def dry(self) -> str:
        """Nothing needs material."""
        return ""

    def flush(self) -> None:
        """Nothing is kept."""


class SilentPort:
    """A port whose arm never answers."""

    def __init__(self, taken: Callable[[bytes], None]) -> None:
        """taken: is given what is sent."""
        self._take_bytes = taken

    def write(self, data: bytes) -> int:
        """All is taken."""
        self._take_bytes(data)
        return len(data)

    def read(self) -> bytes:
        """Nothing comes."""
        return b""

    def waiting(self) -> int:
        """Nothing waits."""
        return 0

    def close(self) -> None:
        """There is nothing to close."""


def replay(
    poses: Iterable[SurfacePose],
    order: BeginPrint,
    report: Callable[[Tick, PrintProgress], None],
    taken: Callable[[bytes], None] = lambda data: None,
    delay: float = POSE_DELAY_S,
    hangs: Sequence[Fault] = (),
) -> None:
    """Print in virtual time on a surface of which only its poses are known, until the motion has the last of them.

    report: of each tick, and how far the print is by it. taken: is given the bytes that go to the arm. As ReplaySource.
    """

    def send(data: bytes) -> None:
        if math.isfinite(source.now()):  # a motion that was killed sends no stop
            taken(data)

    source = ReplaySource(poses, order, SilentPort(send), delay, hangs)

    def told(tick: Tick) -> None:
        if (progress := loop.motion.progress) is not None:
            report(tick, progress)

    loop = PrintLoop(source, order.profile, LoopSettings(), source, told)
    loop.run()


class CommandWriter(ExitStack):
    """Writes commands.csv and frames.bin into a folder, tick by tick; closes them as a context manager.

    commands.csv is for people, in degrees and mm/min; frames.bin holds the frames as sent, one after the other.
    """

    def __init__(self, folder: File) -> None:
        super().__init__()
        self._write_row = self.enter_context(csv_table(folder / "commands.csv", COMMAND_COLUMNS))
        self._frames = self.enter_context((folder / "frames.bin").open("wb"))

    def write(self, command: Command) -> None:
        """Write what one tick commanded."""
        self._write_row(_row(command))

    def send(self, data: bytes) -> None:
        """Write bytes that went to the arm."""
        self._frames.write(data)
        self._frames.flush()


def _row(command: Command) -> list[str]:
    if isinstance(command, Move):
        axes = [*command.axes[:3], *np.rad2deg(command.axes[3:])]
        numbers = [f"{value:.6f}" for value in axes] + [f"{command.feed * 60:.4f}"]
        return [f"{command.stamp:.6f}", "move", *numbers, str(command.checkpoint), str(int(command.extrude)), "", ""]
    return [f"{command.stamp:.6f}", "hold", *[""] * 9, f"{command.duration * 1000:g}", command.reason]


def replay_session(
    session: Session,
    path: File,
    out: File,
    progress: ProgressReport = no_progress,
    profile: ArmProfile | None = None,
    resume: File | None = None,
    faults: Sequence[Fault] = (),
) -> tuple[int, int]:
    """Replay a session with the path at `path` (CSV) into `out`: commands.csv, frames.bin, arm.toml, progress.toml.

    profile: the arm; a session has none. By default the default arm, placed so that the first measured surface lies on
    its bench, level and below home; arm.toml says where that is. resume: progress.toml of an earlier run, to continue
    it. faults: of cameras, tracking and motion. Returns the numbers of moves and of holds written. Whatever was written
    before an error stays readable.
    """
    from hardware.offline.track import tracker  # loads cv2: the motion must not

    check_faults(faults, FaultRunner.REPLAY, "command line", "--fault", len(session.rig))
    checkpoints = read_path(path)
    start = 0.0 if resume is None else read_progress(resume, checkpoints)
    tool = None if profile is None else profile.tool
    with tracker(session.rig, session.roi, session.surface, tool=tool) as step, CommandWriter(out) as writer:

        def track() -> Iterator[SurfacePose]:
            sets = tracked_sets(session.frame_sets(), faults, session.rig, "command line")
            for done, frames in enumerate(sets, 1):
                yield step(frames)
                step.idle()
                progress(done, len(session))

        poses: Iterable[SurfacePose] = track()
        if profile is None:
            poses, profile = placed_by(poses)
        remark = f"what this replay assumed; poses were known {POSE_DELAY_S} s after their stamps"
        write_arm(out / "arm.toml", profile, remark)
        saved, moves = ProgressFile(out / "progress.toml", checkpoints), list[bool]()

        def report(tick: Tick, reached: PrintProgress) -> None:
            writer.write(tick.command)
            moves.append(isinstance(tick.command, Move))
            saved.write(reached)

        order, hangs = BeginPrint(checkpoints, profile, start, {}, ""), faults_striking(faults, FaultPart.MOTION)
        replay(poses, order, report, writer.send, hangs=hangs)
    return moves.count(True), moves.count(False)


def placed_by(poses: Iterable[SurfacePose]) -> tuple[Iterator[SurfacePose], ArmProfile]:
    """The same poses, and the default arm placed under the surface by the first measured pose.

    Before that pose the motion only holds, so that no command depends on a later pose.
    """
    coming, waiting = iter(poses), list[SurfacePose]()
    for pose in coming:
        waiting.append(pose)
        if pose.state.measured:
            return chain(waiting, coming), placed(ArmProfile(), pose.base_from_surface)
    return iter(waiting), ArmProfile()
