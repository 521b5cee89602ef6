"""Made-up nozzle logs whose error is known: what the error, the deposit, their file and their page are tested on."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path as File

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.se3 import Array
from hardware.simulator.deposit import NozzleLog, planned_line
from hardware.simulator.run_folder import NOZZLE_HEADER
from planning.path import Path
from tests.moving_surfaces import REST, path_through

Motion = Callable[[Array], Array]  # stamps (N,) s -> base_from_surface (N, 4, 4)


def still(stamps: Array) -> Array:
    """A surface that does not move."""
    return np.broadcast_to(REST, (len(stamps), 4, 4)).copy()


def breathing(stamps: Array) -> Array:
    """10 mm up and down and 3 degrees of tilt, 15 times a minute."""
    phase = 2 * np.pi * 0.25 * stamps
    none = np.zeros_like(phase)
    xi = np.stack([0.03 * np.sin(phase), 0.02 * np.cos(phase), none, none, none, 5 * np.sin(phase)], axis=-1)
    return np.asarray(REST @ se3.exp(xi))


def sliding(velocity: Array) -> Motion:
    """A surface at constant velocity (3,), mm/s."""

    def motion(stamps: Array) -> Array:
        return se3.make(REST[:3, :3], REST[:3, 3] + stamps[:, None] * velocity)

    return motion


def due_place(path: Path, stamps: Array) -> Array:
    """Place (N,) on the path, mm, at the speeds of its checkpoints, from 0 s on; it stays at the end."""
    line = planned_line(path)
    due = np.concatenate([[0.0], np.cumsum(np.diff(line.knots) / path.speed[1:])])
    return np.interp(stamps, due, line.knots)


def duration(path: Path) -> float:
    """How long the path takes, s."""
    return float(np.sum(np.diff(planned_line(path).knots) / path.speed[1:]))


def on_path(path: Path, place: Array) -> Array:
    """surface_from_nozzle (N, 4, 4) at places (N,), mm: straight from checkpoint to checkpoint."""
    line, poses = planned_line(path), path.surface_from_nozzle
    piece = line.piece(place)
    share = (place - line.knots[piece]) / np.diff(line.knots)[piece]
    return se3.interpolate(poses[piece], poses[piece + 1], share)


def nozzle_log(
    path: Path,
    motion: Motion = still,
    delay: float = 0.0,
    offset: Array | None = None,
    turn: Array | None = None,
    seconds: float | None = None,
    reasons: Callable[[Array], NDArray[np.str_]] | None = None,
) -> NozzleLog:
    """A nozzle that is where the target was `delay` s ago, off by `offset` (3,) mm in the surface frame.

    turn: (3,) rad, of the nozzle in its own frame. seconds: s, all of the path by default. reasons: (N,) of the rows
    by stamp, "" where it prints; held rows do not extrude, and the path does not go on in them.
    """
    stamps = np.arange(round((duration(path) if seconds is None else seconds) * 1000) + 1) / 1000
    reason = np.zeros(len(stamps), "U1") if reasons is None else reasons(stamps)
    moving = reason == ""
    clock = np.concatenate([[0.0], np.cumsum(moving[1:] * 1e-3)])

    def due(t: Array) -> Array:
        return due_place(path, np.interp(t, stamps, clock))

    surface, place = motion(stamps), due(stamps)
    late = motion(stamps - delay) @ on_path(path, due(stamps - delay))
    nozzle = late @ se3.exp([*(np.zeros(3) if turn is None else turn), 0, 0, 0])
    if offset is not None:
        nozzle[:, :3, 3] += surface[:, :3, :3] @ offset
    line = planned_line(path)
    piece = line.piece(place)
    extrude = line.printed[piece] & moving
    return NozzleLog(
        stamps=stamps,
        base_from_surface=surface,
        base_from_nozzle=nozzle,
        base_from_target=surface @ on_path(path, place),
        place=place,
        checkpoint=piece + 1,
        extrude=extrude,
        reason=reason,
        surface_from_tip=(se3.inverse(surface) @ nozzle)[:, :3, 3],
        flow=needed(place, stamps) * extrude,
    )


def needed(place: Array, stamps: Array) -> Array:
    """What a bead of 1 mm^2 needs (N,), mm^3/s, at places (N,), mm, at stamps (N,), s."""
    return np.asarray(np.diff(place, prepend=place[:1]) / np.diff(stamps, prepend=stamps[0] - 1e-3))


def dry(log: NozzleLog, rows: slice | NDArray[np.bool_]) -> None:
    """Let nothing be printed in some rows of a log."""
    log.extrude[rows] = False
    log.flow[rows] = 0.0


def held(start: float, end: float, reason: str = "surface is LOST") -> Callable[[Array], NDArray[np.str_]]:
    """A hold from `start` to `end`, s."""
    return lambda stamps: np.where((stamps >= start - 1e-9) & (stamps < end - 1e-9), reason, "")


def straight(length: float = 20.0, speed: float = 5.0) -> Path:
    """One upright line of `length` mm along x through the surface's origin."""
    return through(np.array([[-length / 2, 0, 0], [length / 2, 0, 0]]), speed)


def through(points: Array, speed: float = 5.0, extrude: Array | None = None, layer: Array | None = None) -> Path:
    """An upright path through points (N, 3), mm."""
    given = {name: row for name, row in (("extrude", extrude), ("layer", layer)) if row is not None}
    return replace(path_through(points, speed), **given)


def part(log: NozzleLog, rows: slice) -> NozzleLog:
    """Some rows of a log."""
    return NozzleLog(**{name: getattr(log, name)[rows] for name in NozzleLog.__slots__})


def without_target(log: NozzleLog, rows: slice) -> NozzleLog:
    """The log with no target in some rows."""
    target, place = log.base_from_target.copy(), log.place.copy()
    target[rows] = np.nan
    place[rows] = np.nan
    checkpoint = log.checkpoint.copy()
    checkpoint[rows] = -1
    return replace(log, base_from_target=target, place=place, checkpoint=checkpoint)


@dataclass(frozen=True, slots=True, eq=False)
class NozzleTable:
    """nozzle.csv as parallel arrays of N rows; NaN, and checkpoint -1, where there was no target."""

    stamps: Array
    extrude: NDArray[np.bool_]
    flow: Array
    nozzle: Array
    target: Array
    distance: Array
    vector: Array
    angle: Array
    path: Array
    place: Array
    checkpoint: NDArray[np.int64]
    reason: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.stamps)


def read_nozzle(file: File) -> NozzleTable:
    """The table that a NozzleWriter wrote; a last line cut short by a kill is left out."""
    with file.open(newline="", encoding="utf-8") as stream:
        header, *rows = csv.reader(stream)
    assert tuple(header) == NOZZLE_HEADER
    rows = [row for row in rows if len(row) == len(header)]
    numbers = np.array([[float(cell or "nan") for cell in row[:-1]] for row in rows]).reshape(-1, len(header) - 1)
    stamps, extrude, flow, distance, angle, path, place, checkpoint = numbers[:, [0, 1, 2, 9, 13, 14, 15, 16]].T
    return NozzleTable(
        stamps=stamps,
        extrude=extrude == 1,
        flow=flow,
        nozzle=numbers[:, 3:6],
        target=numbers[:, 6:9],
        distance=distance,
        vector=numbers[:, 10:13],
        angle=np.radians(angle),
        path=path,
        place=place,
        checkpoint=checkpoint.astype(np.int64),
        reason=np.array([row[-1] for row in rows], np.str_),
    )
