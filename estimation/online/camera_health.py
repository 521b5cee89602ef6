"""Which cameras can be relied on: those that deliver nothing new, see nothing, or disagree with the others are named.

A camera whose tracks disagree as a whole with the pose of the others (bumped, swapped, frozen) is left out of the pose
until it agrees again. How far cameras usually stand apart is learned: a calibration is never perfect.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.online.bump_detector import BumpDetector
from estimation.se3 import Array


@dataclass(frozen=True, slots=True)
class HealthSettings:
    """Thresholds. `out` ends a camera's part in the pose, `back` begins it."""

    shift: float = 0.25  # px by which lens, map and extrinsics may move all tracks of a camera, at least
    memory: float = 2.0  # s over which it is learned what is usual for a camera
    out: float = 4.0  # of these and the clocks' share together: cameras that stand farther off are left out
    back: float = 2.0  # and come back below this,
    looks: int = 2  # in so many frame sets one after the other
    away: float = 0.08  # s, and also two frame sets, that a camera may miss: drivers drop frames every day
    leave_share: float = 0.3  # of the tracks a camera usually has: with fewer it is missed
    least_share: float = 0.15  # where no camera has as many, the few may be what covers the rest: no measurement
    whole_share: float = 0.8  # of all its usual tracks: of a blurred picture half of them are found
    enter_share: float = 1.5  # times what is asked of a camera that counts is asked of one that is to count again


class CameraHealth:
    """Remembers, per camera, when it last carried the pose and whether it is left out."""

    def __init__(self, names: Sequence[str], settings: HealthSettings | None = None) -> None:
        self.settings, self._names = settings or HealthSettings(), tuple(names)
        self.bumps = BumpDetector(names)
        self._pictures = frozenset(range(len(self._names)))  # until somebody says which
        self._repeated: frozenset[int] = frozenset()
        self.begin()

    def begin(self) -> None:
        """Forget everything, as for a new map."""
        count = len(self._names)
        self.bumps.begin()
        self.left_out: frozenset[int] = frozenset()
        self._usual, self._tracks = np.zeros(count), np.zeros(count)  # px off, and tracks
        self._off = np.zeros(count)  # px, how far a camera that is left out stands off
        self._carried = np.full(count, np.nan)  # s, stamp; nan: never
        self._missed = np.zeros(count, np.int64)  # frame sets in a row
        self._agreed = np.zeros(count, np.int64)
        self._apart = np.zeros(count, bool)
        self._blurred = False  # all cameras stand off together
        self._stamp = np.nan

    def pictures(self, fresh: Collection[int], repeated: Collection[int]) -> None:
        """Which cameras delivered a new picture for the coming frame set, and which the last one again."""
        self._pictures, self._repeated = frozenset(fresh), frozenset(repeated)

    def allowed(self, moved: Array) -> Array:
        """How far each camera may stand off, px, one sigma (C,). moved: (C,) px between the cameras' instants."""
        return np.asarray(np.hypot(np.maximum(self._usual, self.settings.shift), moved))

    def hidden(self, used: NDArray[np.int64]) -> bool:
        """Whether every camera shows so much less than usual that these (C,) tracks prove nothing."""
        return bool((used < self.settings.least_share * self._tracks)[self._tracks > 0].all() and self._tracks.any())

    def forgive(self) -> None:
        """No camera is left out any more."""
        self.left_out = frozenset()

    def clear(self, used: NDArray[np.int64]) -> bool:
        """Whether two cameras, or all that there are, carry a pose with these (C,) tracks about as they usually do."""
        known = self._tracks > 0
        clear = (used >= self.settings.leave_share * self._tracks) & known
        return int(clear.sum()) >= min(2, int(known.sum()))

    def doubted(self, off: Array, allowed: Array, odd: Collection[int]) -> Array:
        """How far, px, the image of each camera (C,) is to be doubted where all stand off together; else zeros.

        Blurred or covered images match here and there, near where they were looked for, so that no camera is odd and
        the tracks' number tells no error. off, allowed: (C,) px, nan in `off` where nothing is seen. odd: left out.
        """
        seen = np.isfinite(off) & ~np.isin(np.arange(len(off)), list(odd))
        together = bool(seen.any() and (off > self.settings.back * allowed)[seen].all())
        return np.where(seen & together, off, 0.0)

    def blurred(self, used: NDArray[np.int64], off: Array, allowed: Array, odd: Collection[int]) -> bool:
        """Whether all cameras stand off together, with fewer tracks than usual: a surface that bends keeps its tracks.

        used: (C,) tracks that carry the pose. The rest as for `doubted`.
        """
        fewer = used.sum() < self.settings.whole_share * self._tracks.sum()
        return bool(fewer and self.doubted(off, allowed, odd).any())

    def update(
        self, stamp: float, used: NDArray[np.int64], least: float, off: Array, allowed: Array, odd: Collection[int]
    ) -> None:
        """Take a frame set.

        used: (C,) tracks that carry the pose, all zero where nothing was measured. least: tracks below which a camera
        tells nothing. off: (C,) px by which each stands off the pose of the others, nan where it does not see the
        surface; allowed: as `allowed` gives. odd: cameras that were left out of this pose.
        """
        asked = np.maximum(least, self.settings.leave_share * self._tracks)
        carrying = used >= asked * np.where(self._missed > 0, self.settings.enter_share, 1.0)
        self._missed = np.where(carrying, 0, self._missed + 1)
        self._carried[carrying] = stamp
        share = min(1.0, (stamp - self._stamp) / self.settings.memory) if np.isfinite(self._stamp) else 1.0
        self._stamp = stamp
        known = carrying & np.isfinite(off)
        self._usual[known] += share * (np.minimum(off, 2 * allowed)[known] - self._usual[known])
        self._tracks[carrying] += share * (used[carrying] - self._tracks[carrying])
        self._choose(off, allowed, odd)

    def _choose(self, off: Array, allowed: Array, odd: Collection[int]) -> None:
        agrees = off < self.settings.back * allowed  # false where unknown
        self._agreed = np.where(agrees, self._agreed + 1, 0)
        self._apart = off > self.settings.out * allowed
        self._blurred = bool(self.doubted(off, allowed, odd).any())
        self._off = np.where(np.isfinite(off), off, self._off)
        self.left_out = frozenset(c for c in odd if self._agreed[c] < self.settings.looks)

    def trouble(self, stamp: float, at_once: bool = False) -> str:
        """Which cameras are missed, or that all look odd, and why; or ''. at_once: also those that only just failed."""
        said = [f"{self._names[c]} {self._why(c)}" for c in self._troubled(stamp, at_once)]
        return ", ".join(said or ["no camera shows the surface as usual"] * self._blurred)

    def _troubled(self, stamp: float, at_once: bool) -> list[int]:
        late = (self._missed >= 2) & (stamp - self._carried > self.settings.away)
        named = (self._missed > 0) & np.isfinite(self._carried) & (late | at_once)
        off = self.left_out | self.bumps.said.keys()
        return [c for c in range(len(self._names)) if named[c] or c in off or self._apart[c]]

    def _why(self, camera: int) -> str:
        if camera in self._repeated:
            return "shows the same picture again"
        if camera not in self._pictures:
            return "delivers no picture"
        if camera in self.bumps.said:
            return self.bumps.said[camera]
        if camera in self.left_out or self._apart[camera]:
            return f"stands {self._off[camera]:.1f} px off the others"
        return "hardly sees the surface"
