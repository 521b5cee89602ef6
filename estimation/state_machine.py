"""The state of a surface pose: what makes it change, with two thresholds each, and what is said of it.

The way down is taken at once; up goes only what has been good for a while, so that the state does not flicker.
"""

from __future__ import annotations

from dataclasses import dataclass

from estimation.pose import TrackState


@dataclass(frozen=True, slots=True)
class StateSettings:
    """Thresholds. `leave` ends TRACKING, `enter` begins it."""

    enter_cameras: int = 2  # that carry the pose: one alone hardly tells depth
    enter_tracks: int = 30
    leave_tracks: int = 20
    enter_sigma: float = 2.0  # mm, of the pose's position
    leave_sigma: float = 2.5
    enter_deformation: float = 0.2  # mm, RMS over the landmarks
    leave_deformation: float = 0.3  # a rigid pose alone is then off by half a bead in places
    first: int = 4  # poses that are averaged before one is given out: what that is off by, all later ones are
    settle: float = 0.06  # s without a fault until TRACKING again: the second frame set of 30 a second
    coast: float = 0.5  # s without a measurement until LOST


@dataclass(frozen=True, slots=True)
class Measurement:
    """What a measured pose stands on.

    cameras: names of those that carry it. tracks: in all. sigma: mm, of the position. trouble: cameras that are missed
    and why, or ''. caveat: what else is to be said, or ''. deformation: mm, of the surface.
    """

    cameras: tuple[str, ...]
    tracks: int
    sigma: float
    trouble: str = ""
    caveat: str = ""
    deformation: float = 0.0


class StateMachine:
    """Remembers the state, and since when nothing spoke against TRACKING."""

    def __init__(self, settings: StateSettings | None = None) -> None:
        self.settings = settings or StateSettings()
        self.state = TrackState.INITIALISING
        self._bad_stamp = float("-inf")  # s, of the last pose with a fault
        self._measured_stamp = float("-inf")
        self._poses = 0  # measured since the first map

    def begin(self, stamp: float) -> tuple[TrackState, str]:
        """A first map, made at `stamp`."""
        self.state, self._bad_stamp, self._measured_stamp = TrackState.INITIALISING, float("-inf"), stamp
        self._poses = 0
        return self.state, "a first map, to be confirmed"

    def measured(self, stamp: float, seen: Measurement) -> tuple[TrackState, str]:
        """State and reason of a measured pose."""
        fault = self._fault(seen)
        if fault:
            self._bad_stamp = stamp
        elif stamp - self._bad_stamp < self.settings.settle:
            fault = f"seen well again for {stamp - self._bad_stamp:.2f} s, {self.settings.settle:.2f} s wanted"
        self._measured_stamp = stamp
        self._poses += 1
        if self._poses < self.settings.first:
            self.state = TrackState.INITIALISING
            return self.state, f"pose {self._poses} of {self.settings.first} that are averaged into the first"
        self.state = TrackState.DEGRADED if fault else TrackState.TRACKING
        return self.state, fault

    def _fault(self, seen: Measurement) -> str:
        """What speaks against TRACKING, or ''."""
        s, inside = self.settings, self.state is TrackState.TRACKING
        if len(seen.cameras) < s.enter_cameras:
            alone = f"one camera alone carries the pose: {', '.join(seen.cameras) or 'none clearly'}"
            return f"{alone}; {seen.trouble}" if seen.trouble else alone
        if seen.sigma > (s.leave_sigma if inside else s.enter_sigma):
            return f"the pose is uncertain to {seen.sigma:.1f} mm"
        if seen.tracks < (s.leave_tracks if inside else s.enter_tracks):
            return f"{seen.tracks} tracks carry the pose, {s.enter_tracks} wanted"
        if seen.trouble:
            return seen.trouble
        if seen.deformation > (s.leave_deformation if inside else s.enter_deformation):
            return f"the surface is deformed by {seen.deformation:.2f} mm"
        return seen.caveat

    def missed(self, stamp: float, why: str) -> tuple[TrackState, str]:
        """State and reason of a pose that is only predicted."""
        away = stamp - self._measured_stamp
        self._bad_stamp = stamp
        self.state = TrackState.LOST if away > self.settings.coast else TrackState.COASTING
        return self.state, f"{why}; {away:.2f} s since the last measurement"
