"""The replay of a recorded run's motion: planner and guard decide anew, and give the same bytes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path as File

import numpy as np

from estimation.errors import InputError
from estimation.pose import SurfacePose
from hardware.arm.profile import ArmProfile
from hardware.live.kept import PATH, used
from hardware.motion.step import MotionStep
from hardware.offline.replay import CommandWriter
from hardware.out_folder import prepare_out
from hardware.recording.mcap_file import Attached, ChunkOf, Damage, parse, walk
from hardware.recording.messages import Message, bytes_from_message, pose_from_message
from planning.command import Command
from planning.path import Path

RUN = "the recording of a run that began to print, or give --path"


@dataclass(slots=True)
class _Run:
    """What a recording says of a run's motion."""

    texts: dict[str, str] = field(default_factory=dict)
    poses: dict[float, SurfacePose] = field(default_factory=dict)
    ticks: list[Message] = field(default_factory=list)
    damage: str = ""


@dataclass(frozen=True, slots=True)
class Count:
    """How many frames were replayed, how many of them not as recorded, and what was lost of the file, "" if nothing."""

    frames: int
    other: int
    damage: str


@dataclass(frozen=True, slots=True, eq=False)
class Replayed:
    """One tick: s, what was decided anew, the frame of that, and the frame that the run gave."""

    stamp: float
    command: Command
    frame: bytes
    recorded: bytes


def replay_run(record: File) -> Iterator[Replayed]:
    """Every tick of a recorded run in which planner and guard were asked, decided anew from the recorded poses."""
    run = _read(record)
    return _decided(run, *used(run.texts, record), record)


def _decided(run: _Run, path: Path, profile: ArmProfile, record: File) -> Iterator[Replayed]:
    step: MotionStep | None = None
    for tick in sorted(run.ticks, key=lambda tick: float(tick["stamp"])):
        if tick["begun"]:
            step = MotionStep(path, profile, float(tick["begun"][0]))
        if step is not None and tick.get("recalled"):
            step.recalled(*np.array(tick["recalled"], float).reshape(2, 6))
        if step is None or not tick["asked"]:
            continue
        stamp = tick["pose_stamp"]
        if stamp and stamp[0] not in run.poses:
            raise InputError(record, "/tick: pose_stamp", stamp[0], "a pose that is recorded")
        now = float(tick["stamp"])
        step.paused = bool(tick.get("paused"))
        frame = step(run.poses[stamp[0]] if stamp else None, now)
        yield Replayed(now, step.last, frame, bytes_from_message({"data": tick["frame"]}))


def _read(record: File) -> _Run:
    run = _Run()
    for part in walk(record):
        if isinstance(part, Damage):
            run.damage = part.text
        elif isinstance(part, Attached):
            run.texts[part.name] = part.data.decode("utf-8", "replace")
        elif isinstance(part, ChunkOf):
            for stored in part.messages:
                if stored.topic == "/tick":
                    run.ticks.append(parse(record, stored))
                elif stored.topic == "/pose":
                    pose = pose_from_message(parse(record, stored))
                    run.poses[pose.stamp] = pose
    return run


def write_replay(record: File, out: File, force: bool = False) -> Count:
    """Replay a run into commands.csv and frames.bin of the folder `out`.

    InputError where the recording holds no run, or `out` holds something and `force` is not set; nothing is made then.
    """
    if record.is_dir():
        raise InputError(record, "recording", "a session folder", RUN)
    run = _read(record)
    if PATH not in run.texts:
        raise InputError(record, "recording", "no path", RUN)
    path, profile = used(run.texts, record)
    prepare_out(out, force)
    frames = other = 0
    with CommandWriter(out) as writer:
        for tick in _decided(run, path, profile, record):
            writer.write(tick.command, tick.frame)
            frames += 1
            other += tick.frame != tick.recorded
    return Count(frames, other, run.damage)
