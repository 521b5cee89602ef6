"""`stillbed replay`: tracking and motion in one process under a simulated clock, merged by stamp.

The motion gets a pose POSE_DELAY_S after its stamp. That fixed delay stands for transport and processing in place of
the measured time, so that the same input gives the same bytes on every machine.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain, count
from pathlib import Path as File

import numpy as np

from estimation.errors import InputError
from estimation.pose import SurfacePose
from estimation.rig import Rig
from hardware.arm.profile import ArmProfile, placed
from hardware.arm.protocol import frame_from_command
from hardware.files.arm_file import write_arm
from hardware.files.path_file import ProgressFile, read_path, read_progress
from hardware.files.session import Session
from hardware.motion.step import MotionStep
from hardware.process.faults import Fault, FaultKind, FaultPart, FaultRunner, check_faults, faults_striking
from hardware.process.progress import ProgressReport, no_progress
from perception.frames import Frame, FrameSet, Image
from planning.command import Command, Move


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


def replay(
    poses: Iterable[SurfacePose], motion: MotionStep, delay: float = POSE_DELAY_S, hangs: Sequence[Fault] = ()
) -> Iterator[tuple[float, Command]]:
    """Every tick's instant (s) and command, from the first pose's stamp until the motion has the last pose.

    poses: in order of stamp, taken only when they are due. delay: s, from a pose's stamp until the motion has it.
    hangs: faults during which there is no tick, s from the first tick.
    """
    coming = iter(poses)
    pose, following = None, next(coming, None)
    if following is None:
        return
    start = following.stamp
    for tick in count():
        now = start + tick * motion.profile.tick
        while following is not None and following.stamp + delay <= now:
            pose, following = following, next(coming, None)
            if following is not None and not following.stamp > pose.stamp:
                raise InputError("poses", "stamp", following.stamp, f"after the one before, {pose.stamp} s")
        if not any(fault.covers(now - start) for fault in hangs):
            yield now, motion(pose, now)
        if following is None:
            return


class CommandWriter(ExitStack):
    """Writes commands.csv and frames.bin into a folder, tick by tick; closes them as a context manager.

    commands.csv is for people, in degrees and mm/min; frames.bin holds the frames as sent, one after the other.
    """

    def __init__(self, folder: File) -> None:
        super().__init__()
        self._table = self.enter_context((folder / "commands.csv").open("w", newline="", encoding="utf-8"))
        self._frames = self.enter_context((folder / "frames.bin").open("wb"))
        self._csv = csv.writer(self._table, lineterminator="\n")
        self._csv.writerow(COMMAND_COLUMNS)

    def write(self, command: Command) -> None:
        """Write what one tick commanded."""
        self._csv.writerow(_row(command))
        self._table.flush()

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
        motion, saved = MotionStep(checkpoints, profile, start), ProgressFile(out / "progress.toml", checkpoints)
        moves = ticks = 0
        for _, command in replay(poses, motion, hangs=faults_striking(faults, FaultPart.MOTION)):
            writer.write(command)
            writer.send(frame_from_command(command, profile.dialect))
            moves, ticks = moves + isinstance(command, Move), ticks + 1
            saved.write(motion.progress)
    return moves, ticks - moves


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
