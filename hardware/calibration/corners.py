"""Corners found in a recording, kept in a file so that they are looked for once, and go on where it was interrupted."""

from __future__ import annotations

import hashlib
import os
from dataclasses import fields
from pathlib import Path

import numpy as np

from hardware.files.session import Session
from perception.boards.board import Board
from perception.boards.collection import CornerTable

VERSION = 3  # of how corners are looked for: other ones are other corners
BLOCK = 1 << 20  # bytes read at once


def content_key(session: Session, board: Board) -> str:
    """What the corners depend on, as one word: the recording's bytes, the board, and how corners are looked for."""
    made = hashlib.sha256(f"{VERSION} {board}".encode())
    for path in _files(session.path):
        made.update(path.name.encode())
        with path.open("rb") as stream:
            while block := stream.read(BLOCK):
                made.update(block)
    return made.hexdigest()


def _files(path: Path) -> list[Path]:
    """The files that hold pictures and stamps."""
    if path.is_file():
        return [path]
    beside = {"roi.toml", "truth.tum", "reference.tum", "reference_async.tum", "rig.toml", "head.csv"}
    return sorted(p for p in path.rglob("*") if p.is_file() and p.name not in beside and p.suffix != ".npz")


def read_corners(path: Path, key: str) -> CornerTable | None:
    """The corners of exactly this recording and board, as far as they were found; None where the file has none."""
    names = [f.name for f in fields(CornerTable)]
    try:
        with np.load(path, allow_pickle=False) as stored:
            if str(stored["key"]) != key:
                return None
            parts = {name: stored[name] for name in names}
    except (OSError, ValueError, KeyError, EOFError, RuntimeError):  # the last: a flag that no zip of ours has
        return None
    except Exception as error:  # a cut zip raises zipfile's own, and zlib's
        if type(error).__module__ not in ("zipfile", "zlib"):
            raise
        return None
    return CornerTable(**{**parts, "done": int(parts["done"])})


def write_corners(path: Path, key: str, table: CornerTable) -> None:
    """Store the corners; the file is whole at every instant."""
    near = path.with_name(path.name + ".part")
    with near.open("wb") as stream:
        np.savez_compressed(stream, key=np.array(key), **{f.name: getattr(table, f.name) for f in fields(table)})
    os.replace(near, path)
