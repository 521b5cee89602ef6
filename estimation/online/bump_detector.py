"""Whether a camera has moved a little, or its lens was turned: seen in all of its tracks together, against the others.

Single frame sets hardly show a bump of half a millimetre, and the pose takes up a part of it. What is asked of each
camera is by how much its picture stands shifted, turned and scaled about its axis, once the pose is free to take up
whatever it can of that; averaged over half a second, and compared with what was usual before. The camera that explains
most of what has changed is the one. A shift is a bump, a change of scale a turned lens; a camera that was pushed along
its axis looks like the latter, as 4 mm of 400 are one percent.

What is usual is learned of all cameras together and taken off the residuals, so that it holds whichever of them see the
surface; a camera of which it is not known yet is not judged, and tells nothing of the others. A number that the pose
could take up nearly whole (two cameras of three, along the plane of their rays) is not told from a map's small errors,
and stays where it is.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.median import median
from estimation.observations import Observations
from estimation.online.pose_solver import project
from estimation.rig import Rig
from estimation.se3 import Array

NUMBERS = 4  # of a camera's picture: shift right and down, px; roll, rad; scale
FEWEST = 8  # tracks of a camera that tell its four numbers
TAKEN = 0.03  # of what a camera's tracks tell of a number: where the pose leaves less of it, it stays where it is
EVERY = 0.06  # s: every other frame set of 30 a second is plenty for what stays; all are looked at while one is off
BLUNDER = 6.0  # px beside the median of its camera at which a track counts for nothing


@dataclass(frozen=True, slots=True)
class BumpSettings:
    """When a change is a bump. quick: s over which it is averaged; usual: s over which it is learned what is usual.

    warm: s after a beginning, and of what a camera showed, in which nothing is said; in their second half it is learned
    how far it usually wanders. limit: px, root mean square over the tracks, that they may move by at least, and spread:
    times what is usual of that. sure: times what the next camera explains. lasts: s that it must be so, calm: s that
    single looks must show half of the limit at most for it to be so no more.
    """

    quick: float = 0.4
    usual: float = 20.0
    warm: float = 3.0
    limit: float = 0.25
    spread: float = 5.0
    sure: float = 1.2
    lasts: float = 0.2
    calm: float = 0.06


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """Information (n, n) and pull (n,) of n numbers once the pose has taken up what it can; fixed: (n, n), information
    with the pose known."""

    information: Array
    pull: Array
    fixed: Array

    @staticmethod
    def nothing(count: int) -> Told:
        """Of so many numbers."""
        square = np.zeros((count, count))
        return Told(square, np.zeros(count), square)

    def mixed(self, newer: Told, share: float) -> Told:
        """As it fades by a share that is newer."""
        old, new = (self.information, self.pull, self.fixed), (newer.information, newer.pull, newer.fixed)
        return Told(*(a + share * (b - a) for a, b in zip(old, new, strict=True)))

    def numbers(self) -> Array:
        """(n,) what explains it; where the pose takes up nearly all, and of cameras that nobody saw, zeros."""
        steady = TAKEN * self.fixed + 1e-9 * np.eye(len(self.pull))
        return np.asarray(np.linalg.solve(self.information + steady, self.pull))


class BumpDetector:
    """Remembers of each camera what is usual of its picture, and what it lately was."""

    def __init__(self, names: Sequence[str], settings: BumpSettings | None = None) -> None:
        self.settings, self._names = settings or BumpSettings(), tuple(names)
        self.begin()

    def begin(self) -> None:
        """Forget everything, as for a new map."""
        count = len(self._names)
        self.bumped: dict[int, str] = {}  # cameras, and what there is to say of them
        self._quick, self._usual = [Told.nothing(NUMBERS)] * count, Told.nothing(NUMBERS * count)
        self._spread, self._looks = np.zeros(count), np.zeros(count)  # px^2, usual square of what is off; of how many
        self._since = np.full(count, np.nan)  # s, since when a camera is off, or on again
        self._seen = np.zeros(count)  # s in which it was learned what is usual of a camera
        self._first, self._stamp, self._count = np.nan, np.nan, 0
        self._odd: frozenset[int] = frozenset()

    @property
    def said(self) -> dict[int, str]:
        """Cameras, and what is said of them: no more of one whose last look showed it where it stood.

        Nothing is learned before it has stood there for as long as is asked; what a pose is worth waits by itself.
        """
        return {c: words for c, words in self.bumped.items() if np.isnan(self._since[c])}

    def watch(
        self, rig: Rig, seen: Observations, points: Array, exposed: Array, jacobians: Array, odd: frozenset[int]
    ) -> None:
        """Take an accepted frame set.

        points: (N, 3) mm, surface, of the tracks. exposed: (C, 4, 4) base_from_surface when each camera exposed.
        jacobians: (N, 2, 6) px of the pose. odd: cameras so far off that the pose is without them: what they
        showed is forgotten once they are back.
        """
        if seen.stamp - self._stamp < EVERY and not self.bumped:
            return
        self._forget(self._odd - odd)
        self._odd = odd
        parts = picture_parts(rig, seen, points, exposed, jacobians)
        if np.isnan(self._first):
            self._first = self._stamp = seen.stamp
        step, self._stamp = max(seen.stamp - self._stamp, 0.0), seen.stamp
        self._count += 1
        warm = self.settings.warm
        if young := seen.stamp - self._first < warm:
            self._learn(parts, step, 1 / self._count)
        usual = self._usual.numbers().reshape(-1, NUMBERS)
        known = {c: part.without(usual[c]) for c, part in parts.items() if self._seen[c] + step >= warm / 2}
        self._judge(known, step, [c for c in known if not young and self._seen[c] + step >= warm])
        if not (young or self.bumped or odd):
            self._learn(parts, step, min(1.0, step / self.settings.usual))

    def _learn(self, parts: dict[int, PicturePart], step: float, share: float) -> None:
        """Take it that what cameras show is usual, by a share that is newer."""
        self._usual = self._usual.mixed(together(parts, len(self._names)), share)
        self._seen[list(parts)] += step

    def _judge(self, parts: dict[int, PicturePart], step: float, ripe: Collection[int]) -> None:
        """Take what each camera is off by beside what is usual, and decide on those of which enough is known."""
        steady, now = parts.keys() - self.bumped.keys() - self._odd, {}
        for camera in parts:
            told = alone(parts, camera, steady)
            self._quick[camera] = self._quick[camera].mixed(told, min(1.0, step / self.settings.quick))
            now[camera] = parts[camera].moved(told.numbers())
        changes = {c: self._quick[c].numbers() for c in parts}
        moved = {c: parts[c].moved(v) for c, v in changes.items()}
        gains = {c: float(v @ self._quick[c].pull) for c, v in changes.items()}
        for camera in ripe:
            others = [g for c, g in gains.items() if c != camera and c not in self.bumped]
            clear = gains[camera] > self.settings.sure * max(others, default=0.0)
            self._decide(camera, now[camera] if camera in self.bumped else moved[camera], clear)
            if camera in self.bumped:
                self.bumped[camera] = _words(changes[camera], parts[camera], moved[camera])
        if not self.bumped:
            for camera in parts:
                self._looks[camera] += 1
                share = min(1.0, step / self.settings.usual) if camera in ripe else 1 / self._looks[camera]
                self._spread[camera] += share * (moved[camera] ** 2 - self._spread[camera])

    def _forget(self, cameras: frozenset[int]) -> None:
        """Take it that cameras show again what is usual of them."""
        for camera in cameras:
            self.bumped.pop(camera, None)
            self._since[camera] = np.nan
            self._quick[camera] = replace(self._quick[camera], pull=np.zeros(NUMBERS))

    def _decide(self, camera: int, moved: float, clear: bool) -> None:
        """Whether a camera counts as bumped from now on. moved: px. clear: whether it explains more than the others."""
        s, known = self.settings, camera in self.bumped
        limit = max(s.limit, s.spread * float(np.sqrt(self._spread[camera])))
        off = moved > limit / 2 if known else moved > limit and clear
        if off == known:
            self._since[camera] = np.nan
        elif np.isnan(self._since[camera]):
            self._since[camera] = self._stamp
        lasted = self._stamp - self._since[camera]  # nan where nothing changes
        if off and not known and lasted >= s.lasts:
            self.bumped[camera] = ""
        elif known and not off and lasted >= s.calm:
            self._forget(frozenset([camera]))


@dataclass(frozen=True, slots=True, eq=False)
class PicturePart:
    """The normal equations of one camera in one frame set: of its numbers (4, 4) and (4,), of the pose (6, 6) and (6,),
    and across (4, 6). slopes: (N, 2, 4) px, of its tracks by the numbers."""

    own: Array
    pull: Array
    pose: Array
    pulled: Array
    cross: Array
    slopes: Array

    def without(self, numbers: Array) -> PicturePart:
        """As it would be, were the picture not off by these numbers (4,)."""
        return replace(self, pull=self.pull - self.own @ numbers, pulled=self.pulled - numbers @ self.cross)

    def moved(self, numbers: Array) -> float:
        """By how much these numbers (4,) move its tracks: px, root mean square."""
        return float(np.sqrt(np.mean(((self.slopes @ numbers) ** 2).sum(-1))))


def picture_parts(
    rig: Rig, seen: Observations, points: Array, exposed: Array, jacobians: Array
) -> dict[int, PicturePart]:
    """What each camera with enough tracks tells of its own numbers and of the pose, by camera number."""
    parts: dict[int, PicturePart] = {}
    for camera in range(len(rig)):
        mine = np.flatnonzero(seen.camera == camera)
        if len(mine) < FEWEST:
            continue
        pixels = seen.pixels[mine]
        left = pixels - project(rig, seen.camera[mine], exposed[camera], points[mine])[0]
        middle = np.array([median(left[:, 0]), median(left[:, 1])])
        beside = ((left - middle) ** 2).sum(1) / BLUNDER**2
        weights = np.repeat((np.maximum(1 - beside, 0.0) / np.maximum(seen.sigma[mine], 0.1)) ** 2, 2)[:, None]
        rows, slopes = jacobians[mine].reshape(-1, 6), _slopes(rig, camera, pixels)
        flat, gap = slopes.reshape(-1, NUMBERS), left.ravel()
        posed, own = (rows * weights).T, (flat * weights).T
        parts[camera] = PicturePart(own @ flat, own @ gap, posed @ rows, posed @ gap, own @ rows, slopes)
    return parts


def alone(parts: dict[int, PicturePart], camera: int, others: Collection[int]) -> Told:
    """What this camera alone would have to be off by, with the pose free and told by it and these others."""
    mine = parts[camera]
    taken = _taken([mine, *(p for c, p in parts.items() if c in others and c != camera)], mine.cross)
    return Told(mine.own - mine.cross @ taken[:, :-1], mine.pull - mine.cross @ taken[:, -1], mine.own)


def together(parts: dict[int, PicturePart], count: int) -> Told:
    """What all of `count` cameras together would have to be off by, with the pose free; of those not seen, nothing."""
    size = NUMBERS * count
    fixed, cross, pull = np.zeros((size, size)), np.zeros((size, 6)), np.zeros(size)
    for camera, part in parts.items():
        at = slice(NUMBERS * camera, NUMBERS * (camera + 1))
        fixed[at, at], cross[at], pull[at] = part.own, part.cross, part.pull
    taken = _taken(list(parts.values()), cross)
    return Told(fixed - cross @ taken[:, :-1], pull - cross @ taken[:, -1], fixed)


def _taken(parts: Sequence[PicturePart], cross: Array) -> Array:
    """(6, n + 1) what the pose, told by these, takes up of n numbers (cross: (n, 6)) and of what they are pulled by."""
    pose, pulled = np.zeros((6, 6)), np.zeros(6)
    for part in parts:
        pose, pulled = pose + part.pose, pulled + part.pulled
    held = pose + (1e-9 * np.trace(pose) + 1e-12) * np.eye(6)
    return np.asarray(np.linalg.solve(held, np.column_stack([cross.T, pulled])))


def _slopes(rig: Rig, camera: int, pixels: Array) -> Array:
    """(N, 2, 4) how pixels (N, 2) move with shift, roll and scale about the camera's axis."""
    across, down = (pixels - rig.matrices[camera][:2, 2]).T
    zero, one = np.zeros_like(across), np.ones_like(across)
    return np.stack([np.stack([one, zero, -down, across], -1), np.stack([zero, one, across, down], -1)], 1)


def _words(change: Array, part: PicturePart, moved: float) -> str:
    by_scale = float(np.sqrt(np.mean(((part.slopes[..., 3] * change[3]) ** 2).sum(-1))))
    rest = np.append(change[:3], 0.0)
    by_rest = float(np.sqrt(np.mean(((part.slopes @ rest) ** 2).sum(-1))))
    if by_scale > by_rest:
        return f"shows all {100 * abs(change[3]):.1f} % {'larger' if change[3] > 0 else 'smaller'}: its lens was turned"
    return f"was bumped: its picture stands {moved:.1f} px off where it stood"
