"""Looks for the board in every picture of a recording."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hardware.calibration.corners import content_key, read_corners, write_corners
from hardware.files.session import FrameReader, FrameRef, Session
from hardware.process.progress import Report
from perception.boards.board import Board
from perception.boards.collection import CornerTable, empty_table
from perception.boards.corners import CornerFinder, Found

KEEP = 50  # frame sets between two savings: some seconds of work
THREADS = 2  # look at the pictures of one set at once


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """What was found in one picture. stamp: s, on the camera's own clock."""

    camera: int
    instant: int
    stamp: float
    found: Found


def collect(session: Session, board: Board, store: Path | None, report: Report) -> CornerTable:
    """The corners of all pictures. store: the file that keeps them, or None. InputError where a picture is missing."""
    key = content_key(session, board) if store is not None else ""
    known = None if store is None else read_corners(store, key)
    table = empty_table(board, len(session.rig)) if known is None else known
    reader = session.store.open()
    finders = [CornerFinder(board) for _ in session.rig.cameras]
    rows: list[Row] = []
    done = table.done
    try:
        with ThreadPoolExecutor(THREADS) as pool:
            for instant in range(table.done, len(session.sets)):
                rows += _look(pool, reader, finders, session.sets[instant], instant)
                done = instant + 1
                if done % KEEP == 0:
                    table, rows = _kept(store, key, joined(table, rows, done)), []
                report(done, len(session.sets))
    finally:  # Ctrl-C included
        table = _kept(store, key, joined(table, rows, done))
        reader.close()
    return table


def _kept(store: Path | None, key: str, table: CornerTable) -> CornerTable:
    if store is not None:
        write_corners(store, key, table)
    return table


def _look(
    pool: ThreadPoolExecutor,
    reader: FrameReader,
    finders: list[CornerFinder],
    refs: tuple[FrameRef, ...],
    instant: int,
) -> list[Row]:
    images = [reader.read(ref) for ref in refs]
    found = pool.map(lambda ref, image: finders[ref.camera](image), refs, images)
    return [Row(ref.camera, instant, ref.camera_stamp, f) for ref, f in zip(refs, found, strict=True)]


def joined(table: CornerTable, rows: list[Row], done: int) -> CornerTable:
    """The table with what was found in further pictures; done: instants looked at by now."""
    looked, shown = table.looked.copy(), [row for row in rows if row.found.count]
    np.add.at(looked, [row.camera for row in rows], 1)
    strangers = np.array([*table.strangers, *(i for r in rows for i in r.found.strangers)], np.int64)
    table = replace(table, looked=looked, strangers=strangers, done=done)
    if not shown:
        return table
    return replace(
        table,
        camera=np.append(table.camera, [r.camera for r in shown]).astype(np.int64),
        instant=np.append(table.instant, [r.instant for r in shown]).astype(np.int64),
        stamp=np.append(table.stamp, [r.stamp for r in shown]),
        pixels=np.concatenate([table.pixels, np.stack([r.found.pixels for r in shown])]),
        sigma=np.append(table.sigma, [r.found.sigma for r in shown]),
        blur=np.append(table.blur, [r.found.blur for r in shown]),
        marker=np.append(table.marker, [r.found.marker for r in shown]),
    )
