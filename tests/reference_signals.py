"""What two outcomes of one recording say over time, where they part, and whether by more than rounding could do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.pose import TrackState
from estimation.se3 import Array
from hardware.report.report import components
from tests.reference_cases import TRACKS, Arrays

STATES = [state.value for state in TrackState]
DECISION = "decision"  # the unit of what is one of several things: no change of it is a small one
NEW = "was not there before"
FLIPS = 0.02  # share of the decisions that may fall otherwise where arithmetic is another one
FROM_TRACKS = {"mm": 1e-4, "°": 1e-4, "mm/s": 1e-2}  # measured 4e-13, 2e-13, 1e-11 (loops of 1 to 8 terms)
FROM_PICTURES = {"mm": 1e-2, "°": 1e-2, "mm/s": 0.5, "px": 0.05, "tracks": 5.0}  # measured 3e-6, 1e-6, 4e-5, 2e-4, 0


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One signal of two outcomes. stamps: (N,) s, that both have. before, after: (N,) in `unit`, NaN: there is none."""

    name: str
    unit: str
    stamps: Array
    before: Array
    after: Array

    @property
    def size(self) -> Array:
        """How far apart (N,); NaN where neither says anything, infinite where one of them does."""
        apart = np.abs(self.after - self.before)
        return np.where(np.isfinite(self.before) ^ np.isfinite(self.after), np.inf, apart)

    @property
    def rows(self) -> int:
        """How many of N differ."""
        return int((self.size > 0).sum())

    @property
    def most(self) -> float:
        """The largest finite difference; 0 where there is none."""
        size = self.size
        return float(size[np.isfinite(size)].max(initial=0.0))

    @property
    def first(self) -> float:
        """s, stamp of the first difference."""
        return float(self.stamps[np.flatnonzero(self.size > 0)[0]])

    def allowed(self, case: str) -> bool:
        """Whether another arithmetic may have made it."""
        size = self.size
        flips = int(np.isinf(size).sum()) if self.unit != DECISION else self.rows
        limits = FROM_TRACKS if case in TRACKS else FROM_PICTURES
        small = self.unit == DECISION or self.most <= limits[self.unit]
        return small and flips <= FLIPS * len(size)


def differing(before: Arrays, after: Arrays) -> dict[str, str]:
    """Names of the arrays that are not the same, byte by byte, with how they differ in words."""
    found = {}
    for name in dict.fromkeys([*before, *after]):
        a, b = before.get(name), after.get(name)
        if a is None or b is None:
            found[name] = NEW if a is None else "is no longer there"
        elif a.shape != b.shape or a.dtype.kind != b.dtype.kind:
            found[name] = f"{a.shape} became {b.shape}"
        elif a.tobytes() != b.astype(a.dtype).tobytes() or (a.dtype.kind == "U" and (a != b).any()):
            other = [x.tobytes() != y.tobytes() for x, y in zip(a, b, strict=True)]
            stamp = before[f"{name.split()[0]} stamp"][other.index(True)] if any(other) else np.nan
            found[name] = f"{sum(other)} of {len(a)} rows, from {stamp:.3f} s on"
    return found


def changes(before: Arrays, after: Arrays) -> list[Change]:
    """The signals that differ at stamps which both outcomes have, the ones of a kind beside each other."""
    found = []
    for kind, signals in (("pose", _pose_signals), ("tick", _tick_signals)):
        stamps, old, new = np.intersect1d(before[f"{kind} stamp"], after[f"{kind} stamp"], return_indices=True)
        values = zip(signals(before), signals(after), strict=True)
        found += [Change(name, unit, stamps, a[old], b[new]) for (name, unit, a), (_, _, b) in values]
    if "track pixels" in before and "track pixels" in after:
        found += _track_changes(before, after)
    return [each for each in found if each.rows]


Signals = list[tuple[str, str, Array]]  # name, unit, a value for each row


def _pose_signals(arrays: Arrays) -> Signals:
    poses, covariance = (np.asarray(arrays[f"pose {name}"], float) for name in ("base_from_surface", "covariance"))
    placed = components(poses, np.eye(4))
    sigma = np.sqrt(np.maximum(np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2), 0))
    names = ("x", "y", "z", "turn about x", "turn about y", "turn about z")
    return [
        *((name, "mm" if i < 3 else "°", placed[:, i]) for i, name in enumerate(names)),
        ("claimed uncertainty", "mm", sigma),
        ("speed", "mm/s", np.linalg.norm(np.asarray(arrays["pose twist"], float)[:, 3:], axis=1)),
        ("state", DECISION, np.array([STATES.index(str(name)) for name in arrays["pose state"]], float)),
    ]


def _tick_signals(arrays: Arrays) -> Signals:
    axes = np.asarray(arrays["tick axes"], float)
    shown = np.concatenate([axes[:, :3], np.degrees(axes[:, 3:])], 1)
    return [
        *((f"axis {name}", "mm" if i < 3 else "°", shown[:, i]) for i, name in enumerate("XYZABC")),
        ("feed", "mm/s", np.asarray(arrays["tick feed"], float)),
        ("checkpoint", DECISION, np.asarray(arrays["tick checkpoint"], float)),
        ("extruding", DECISION, np.asarray(arrays["tick extrude"], float)),
    ]


def _track_changes(before: Arrays, after: Arrays) -> list[Change]:
    """How many tracks each camera has, and how far those stand apart that both outcomes have (median)."""
    stamps = np.unique(np.concatenate([before["track stamp"], after["track stamp"]])).astype(float)
    found = []
    for camera in np.unique(before["track camera"]):
        counts = [_counts(arrays, camera, stamps) for arrays in (before, after)]
        found.append(Change(f"tracks of camera {camera}", "tracks", stamps, *counts))
    keys = [np.rec.fromarrays([a["track stamp"], a["track camera"], a["track id"]]) for a in (before, after)]
    both, old, new = np.intersect1d(*keys, return_indices=True)
    apart = np.linalg.norm(np.asarray(after["track pixels"][new] - before["track pixels"][old], float), axis=1)
    rows = [apart[both["f0"] == stamp] for stamp in stamps]
    medians = np.array([np.median(row) if len(row) else np.nan for row in rows])
    return [*found, Change("tracks apart (median)", "px", stamps, np.where(np.isnan(medians), np.nan, 0.0), medians)]


def _counts(arrays: Arrays, camera: np.generic, stamps: Array) -> Array:
    own = np.asarray(arrays["track stamp"][arrays["track camera"] == camera], float)
    return np.array([(own == stamp).sum() for stamp in stamps], float)
