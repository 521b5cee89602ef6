"""Reading what a run recorded, one channel at a time, in the order of the file; a damaged file up to its damage."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np

from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.heads import head_from_row
from hardware.recording import messages
from hardware.recording.mcap_file import ChunkOf, parse, walk
from hardware.recording.messages import Message
from perception.frames import PrintHead
from planning.command import Command

T = TypeVar("T")


def read_poses(path: str | Path) -> Iterator[SurfacePose]:
    """Estimated poses."""
    return _read(path, {"/pose": messages.pose_from_message})


def read_smoothed(path: str | Path) -> Iterator[SurfacePose]:
    """Poses as `stillbed smooth` added them."""
    return _read(path, {"/smoothed": messages.pose_from_message})


def read_observations(path: str | Path) -> Iterator[Observations]:
    """Observations."""
    return _read(path, {"/observations": messages.observations_from_message})


def read_commands(path: str | Path) -> Iterator[Command]:
    """Moves and holds as they were decided."""
    return _read(path, {"/move": messages.move_from_message, "/hold": messages.hold_from_message})


def read_sent(path: str | Path) -> Iterator[tuple[float, bytes]]:
    """Stamps (s) and bytes of what went to the arm."""
    return _read(path, {"/arm/sent": _stamped_bytes})


def read_received(path: str | Path) -> Iterator[tuple[float, bytes]]:
    """Stamps (s) and bytes of what came from the arm."""
    return _read(path, {"/arm/received": _stamped_bytes})


def read_events(path: str | Path) -> Iterator[tuple[float, int, str]]:
    """Stamp (s), level and words of every event."""
    return _read(path, {"/events": lambda m: (m["stamp"], m["level"], m["message"])})


def read_truth_rows(path: str | Path) -> Array:
    """Truth or reference as stored, rows (N, 8) of stamp x y z qx qy qz qw, s and mm, in order of stamp."""
    return np.array(sorted(_read(path, {"/truth": messages.row_from_message})), float).reshape(-1, 8)


def read_heads(path: str | Path) -> Iterator[tuple[float, PrintHead]]:
    """Stamps (s) of frame sets, and the print head at each."""
    return _read(path, {"/head": _stamped_head})


def _stamped_head(message: Message) -> tuple[float, PrintHead]:
    row = messages.row_from_message(message)
    return row[0], head_from_row(row, message["extruding"])


def _stamped_bytes(message: Message) -> tuple[float, bytes]:
    return message["stamp"], messages.bytes_from_message(message)


def _read(path: str | Path, decoders: dict[str, Callable[[Message], T]]) -> Iterator[T]:
    path = Path(path)
    for part in walk(path):
        for stored in part.messages if isinstance(part, ChunkOf) else ():
            if stored.topic in decoders:
                message = parse(path, stored)
                try:
                    yield decoders[stored.topic](message)
                except (KeyError, TypeError, ValueError, OverflowError) as error:
                    raise InputError(path, stored.topic, repr(error), "a message of its schema") from error
