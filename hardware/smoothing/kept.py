"""Tracks that took long to make: a recording beside the results, which bears what it was made of."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from estimation.errors import InputError
from estimation.rig import Rig
from hardware.recording.mcap_file import Attached, ChunkOf, walk
from hardware.recording.recorder import Recorder

MADE_OF = "made_of.txt"  # attached to the recording, before all else in it


def made_of(path: Path) -> str:
    """What `keeping` was told that the recording is made of; "" where there is none, or none of its own."""
    try:
        for part in walk(path):
            if isinstance(part, Attached) and part.name == MADE_OF:
                return part.data.decode()
            if isinstance(part, ChunkOf):
                break
    except InputError:  # it is made anew
        pass
    return ""


def part_of(target: Path) -> Path:
    """What is there of it while it is made, and where that was interrupted."""
    return target.with_suffix(".part.mcap")


@contextmanager
def keeping(target: Path, rig: Rig, contents: str) -> Iterator[Recorder]:
    """A recorder for what is made of `contents`, a hash; the file has its name once it is whole."""
    part = part_of(target)
    with Recorder(part, rig, overwrite=True) as recorder:
        recorder.attach(MADE_OF, contents.encode())
        yield recorder
    os.replace(part, target)
