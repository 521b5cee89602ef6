"""Cameras that run freely: which of their frames, out of step by a constant, make a set."""

from __future__ import annotations

from dataclasses import dataclass

ALIKE = 0.02  # share by which two cameras' periods may differ and still keep step for some seconds
SILENT = 5  # periods without a frame, after which a camera no longer counts
KEEP = 2.0  # times longer another gap must be for sets to begin after it: phases that drift do not go to and fro


@dataclass(frozen=True, slots=True)
class _Beat:
    instant: float
    period: float


class Phases:
    """How far each camera is behind the first of a set, of which there is one a period.

    Sets begin after the longest gap between the cameras' phases: so every set can hold all cameras, and spreads as
    little as it can, by up to two thirds of a period with three cameras. Cameras of another rate are left as they are.
    """

    def __init__(self, cameras: int) -> None:
        self._beats: list[_Beat | None] = [None] * cameras
        self._leader = 0

    def lead(self, camera: int, instant: float, period: float | None) -> float:
        """How far, s, a camera is behind the first of the set that its frame at a steady `instant` (s) belongs to."""
        self._beats[camera] = None if period is None else _Beat(instant, period)
        own = self._beats[camera]
        if own is None:
            return 0.0
        fastest = min(beat.period for beat in self._beats if beat is not None)
        alive = [c for c, beat in enumerate(self._beats) if beat is not None and self._counts(beat, instant, fastest)]
        if camera not in alive:
            return 0.0
        gaps = self._gaps(alive, fastest)
        best = max(alive, key=lambda c: gaps[c])
        if gaps.get(self._leader, 0.0) * KEEP < gaps[best]:
            self._leader = best
        return self._behind(self._leader, instant, fastest, gaps[self._leader])

    def _counts(self, beat: _Beat, now: float, period: float) -> bool:
        return abs(beat.period / period - 1) <= ALIKE and now - beat.instant <= SILENT * period

    def _gaps(self, alive: list[int], period: float) -> dict[int, float]:
        """How long before each camera's frame the one before it, of any camera, is: s."""
        first = self._instant(alive[0])
        phases = sorted(((self._instant(c) - first) % period, c) for c in alive)
        before = [phases[-1][0] - period, *(phase for phase, _ in phases[:-1])]
        return {c: phase - earlier for (phase, c), earlier in zip(phases, before, strict=True)}

    def _behind(self, leader: int, instant: float, period: float, gap: float) -> float:
        """From half the gap before the leader's frame to half of it before its next one."""
        return (instant - self._instant(leader) + gap / 2) % period - gap / 2

    def _instant(self, camera: int) -> float:
        beat = self._beats[camera]
        assert beat is not None
        return beat.instant
