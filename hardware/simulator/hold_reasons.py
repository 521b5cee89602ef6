"""Why the arm held: stretches with a reason, and those of one kind together."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array

_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")  # but not the 2 of a camera called cam2
_ANY = "…"


@dataclass(frozen=True, slots=True)
class Holds:
    """Holds of one kind. reason: what their reasons have in common, "…" for a number that differs among them.

    count: how many. seconds: in all. longest: s. first: s, the instant at which the first began.
    """

    reason: str
    count: int
    seconds: float
    longest: float
    first: float


@dataclass(frozen=True, slots=True)
class HoldSpan:
    """One hold: from `start` to `end`, s, and the reason that it began with."""

    start: float
    end: float
    reason: str


def hold_spans(stamps: Array, reason: NDArray[np.str_], step: float) -> list[HoldSpan]:
    """The holds in rows `stamps` (N,) s with `reason` (N,), "" where the arm moves; a row lasts `step` s.

    A reason that goes on with other numbers is the same hold; another one begins another.
    """
    if not len(reason):
        return []
    words, index = np.unique(reason, return_inverse=True)
    kinds = {kind: i for i, kind in enumerate(dict.fromkeys(_kind(str(word)) for word in words))}
    kind = np.array([kinds[_kind(str(word))] for word in words])[index]
    changed = (np.diff(kind) != 0) | (np.diff(stamps) > 1.5 * step)
    starts = np.concatenate([[0], np.flatnonzero(changed) + 1])
    ends = np.append(starts[1:], len(reason)) - 1
    return [
        HoldSpan(float(stamps[a]), float(stamps[b]) + step, str(reason[a]))
        for a, b in zip(starts, ends, strict=True)
        if reason[a]
    ]


def holds_of(spans: list[HoldSpan]) -> tuple[Holds, ...]:
    """Holds by kind, those that took longest in all first."""
    groups: dict[str, list[HoldSpan]] = {}
    for span in spans:
        groups.setdefault(_kind(span.reason), []).append(span)
    found = [_holds(group) for group in groups.values()]
    return tuple(sorted(found, key=lambda holds: (-holds.seconds, holds.first)))


def _holds(group: list[HoldSpan]) -> Holds:
    lasted = [span.end - span.start for span in group]
    reason = _common([span.reason for span in group])
    return Holds(reason, len(group), float(sum(lasted)), max(lasted), group[0].start)


def _kind(reason: str) -> str:
    return _NUMBER.sub(_ANY, reason)


def _common(reasons: list[str]) -> str:
    """Reasons of one kind as one, with the numbers on which all agree."""
    columns = zip(*(_NUMBER.findall(reason) for reason in reasons), strict=True)
    numbers = iter([column[0] if len(set(column)) == 1 else _ANY for column in columns])
    return _NUMBER.sub(lambda _: next(numbers), reasons[0])
