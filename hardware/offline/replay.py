"""`stillbed replay`: tracking and motion in one process under a simulated clock, merged by stamp.

A pose becomes known to the motion a fixed DELAY after its stamp, which stands for transport and processing: never the
time that was measured, so the same input gives the same bytes on every machine.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path as File
from types import TracebackType

import numpy as np

from estimation.errors import InputError
from estimation.pose import SurfacePose
from hardware.arm.profile import ArmProfile, placed
from hardware.bookmark_file import BookmarkFile, read_start
from hardware.files.arm_file import write_arm
from hardware.files.path_file import read_path
from hardware.files.session import Session
from hardware.motion.step import MotionStep
from hardware.process.clock import SimClock
from hardware.process.faults import Fault, Part, Runner, check_faults, struck
from hardware.process.progress import Report, silent
from planning.command import Command, Move

DELAY = 0.05  # s: 20 ms from exposure to decoded image, 15 ms of tracking, 15 ms of spread (30 Hz cameras, USB)
COLUMNS = (
    *("stamp_s", "kind", "x_mm", "y_mm", "z_mm", "a_deg", "b_deg", "c_deg"),
    *("feed_mm_min", "checkpoint", "extrude", "hold_ms", "reason"),
)


def replay(
    poses: Iterable[SurfacePose], motion: MotionStep, delay: float = DELAY, hangs: Sequence[Fault] = ()
) -> Iterator[tuple[float, Command, bytes]]:
    """Every tick's instant (s), command and frame, from the first pose's stamp until the last pose is known.

    poses: in order of stamp, asked for only when they are due. delay: s, from a pose's stamp until the motion knows it.
    hangs: when no tick is made, s from the first.
    """
    coming = iter(poses)
    pose, ahead = None, next(coming, None)
    if ahead is None:
        return
    clock, start, tick = SimClock(ahead.stamp), ahead.stamp, 0
    while True:
        while ahead is not None and ahead.stamp + delay <= clock.now():
            pose, after = ahead, next(coming, None)
            _check_order(ahead, after)
            ahead = after
        now = clock.now()
        if not any(fault.covers(now - start) for fault in hangs):
            frame = motion(pose, now)
            yield now, motion.last, frame
        if ahead is None:
            return
        tick += 1
        clock.wait_until(start + tick * motion.profile.tick)


def _check_order(before: SurfacePose, after: SurfacePose | None) -> None:
    if after is not None and not after.stamp > before.stamp:
        raise InputError("poses", "stamp", after.stamp, f"after the one before, {before.stamp} s")


class CommandWriter:
    """Writes commands.csv and frames.bin into a folder, tick by tick; closes them as a context manager.

    commands.csv is for people, in degrees and mm/min; frames.bin holds the frames as sent, one after the other.
    """

    def __init__(self, folder: File) -> None:
        self._table = (folder / "commands.csv").open("w", newline="", encoding="utf-8")
        self._frames = (folder / "frames.bin").open("wb")
        self._csv = csv.writer(self._table, lineterminator="\n")
        self._csv.writerow(COLUMNS)

    def write(self, command: Command, frame: bytes) -> None:
        """One tick; on the disk, as far as this process can see to it, when it returns."""
        self._csv.writerow(_row(command))
        self._frames.write(frame)
        self._table.flush()
        self._frames.flush()

    def close(self) -> None:
        """Close both files; a second call does nothing."""
        self._table.close()
        self._frames.close()

    def __enter__(self) -> CommandWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


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
    progress: Report = silent,
    profile: ArmProfile | None = None,
    resume: File | None = None,
    faults: Sequence[Fault] = (),
) -> None:
    """Replay a session with the path at `path` (CSV) into `out`: commands.csv, frames.bin, arm.toml, progress.toml.

    A recording knows no arm. Without a profile the default arm is placed so that the first measured surface lies on its
    bench, level and below home; arm.toml says where that is. What was written before an error stays readable.
    resume: progress.toml of an earlier run, to go on where that stopped. faults: of cameras, tracking and motion.
    """
    from hardware.frame_faults import tracked_sets
    from hardware.tracker import tracker  # loads cv2: the motion must not

    check_faults(faults, Runner.REPLAY, "command line", "--fault", len(session.rig))
    checkpoints = read_path(path)
    start = 0.0 if resume is None else read_start(resume, checkpoints)
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
        write_arm(out / "arm.toml", profile, f"what this replay assumed; poses were known {DELAY} s after their stamps")
        motion, keeper = MotionStep(checkpoints, profile, start), BookmarkFile(out / "progress.toml", checkpoints)
        for _, command, frame in replay(poses, motion, hangs=struck(faults, Part.MOTION)):
            writer.write(command, frame)
            keeper.write(motion.progress)


def placed_by(poses: Iterable[SurfacePose]) -> tuple[Iterator[SurfacePose], ArmProfile]:
    """The same poses, and the default arm placed by the first of them that is measured.

    Before that pose the motion only holds, so nothing is known earlier than it would be live.
    """
    coming, waiting = iter(poses), list[SurfacePose]()
    for pose in coming:
        waiting.append(pose)
        if pose.state.measured:
            return chain(waiting, coming), placed(ArmProfile(), pose.base_from_surface)
    return iter(waiting), ArmProfile()
