"""Readers for a fuzzing that is itself tested: one ends its process. It loads little: processes begin with it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from tests.campaigns.fuzz_process import Reader


def deadly_readers() -> dict[str, Reader]:
    return {"deadly": Reader("x.txt", _make, _die), "fine": Reader("x.txt", _make, Path.read_bytes)}


def _make(folder: Path) -> None:
    (folder / "x.txt").write_bytes(b"valid")


def _die(path: Path) -> None:
    if path.read_bytes() != b"valid":
        os.kill(os.getpid(), signal.SIGSEGV)
