"""Small bumps of a camera and turned lenses, detected in all of its tracks together, against the other cameras.

A single frame set hardly shows a bump of half a millimetre, and the pose absorbs a part of it. So four numbers are
estimated for each camera: shift (2), roll and scale of its picture, with the pose marginalised. They are averaged over
half a second and compared with their usual values. The camera that explains most of the change is the one. A shift or
roll is a bump. A change of scale is a turned lens; a push along the axis looks the same (4 mm of 400 are one percent).

The usual values are learned of all cameras together and subtracted from the residuals, so that they hold whichever
cameras see the surface. A camera whose usual values are not known yet is not judged, and does not judge others. A
number that the pose could absorb almost whole (two cameras of three, along the plane of their rays) cannot be told
from small errors of the map, and is held at zero.

A camera that hangs before a slow motion stands off by little for long, most of all where the motion is along its axis
or along that of the one that does not hang. So the way of each picture within seconds, by a pose of the camera's own,
is compared with the way by the pose of the others (`UnequalMotion`): lens and map err alike in so short a time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from estimation.observations import Observations
from estimation.online.deformation import displacement_sums
from estimation.online.fit import PICTURE_DOF, CameraEquations, RivalPose, camera_equations, solve_symmetric3
from estimation.pose_solver import INLIER_WEIGHT, PoseFit, project
from estimation.rig import Rig
from estimation.se3 import Array

MIN_OBSERVABLE_SHARE = 0.03  # of a number's information: where the pose leaves less of it, the number is held at zero
LOOK_INTERVAL_S = 0.06  # every other frame set of 30 a second; all of them while a camera is bumped
CHANGE_MEMORY_S = 0.4  # over which the change is averaged
USUAL_MEMORY_S = 20.0  # over which the usual values are learned
WARMUP_S = 3.0  # of a run, and of a camera's pictures, before it is judged; half of it before it is compared
MIN_BUMP_PX = 0.25  # root mean square over the tracks: the smallest bump,
USUAL_CHANGE_RATIO = 5.0  # and at least so many times the usual change
NEXT_CAMERA_RATIO = 1.2  # times what the next camera explains
BUMP_LASTS_S = 0.2  # that a change must last
BUMP_OVER_S = 0.06  # that single looks must be below half the limit until it is over
MIN_UNEQUAL_PX = 0.2  # by which ways of the anchors in a picture must differ: lens and map err by it,
UNEQUAL_SIGMAS = 3.0  # times the noise of both ways (of six degrees of freedom: one of 1e9 by chance),
UNEQUAL_SHARE = 0.3  # and such a part of the longer one: what does not follow at all is sought, not what errs a little
WAY_BLOCKS = (1, 4)  # looks that are averaged at both ends of a way
WAY_MEMORY_S = 2.0  # over which ways are compared: half a slow breath
WHOLE_SHARE, FEW_TRACKS = 0.8, 0.4  # of its usual tracks: a whole picture; so few that nothing usual is learned,
TRACKS_SHARE = 0.25  # of a look's number: a first map is looked for whole, later ones in part
PLACE_PRIOR = 1 / 5.0**2  # mm^-2, of a landmark's displacement: no tissue deforms further
MIN_CONTRADICTION = 0.5  # of what is expected must be shown by pictures of another instant,
CONTRADICTION_SIGMAS = 5.0  # and so many of the tracks' noise: lens and map err alike from landmark to landmark
MIN_UNEQUAL_LOOKS = 2  # one after the other
EQUAL_AGAIN_S = 0.5  # that ways must be alike until the camera is like the others again


@dataclass(frozen=True, slots=True, eq=False)
class ReducedEquations:
    """Normal equations of n numbers with the pose eliminated."""

    information: Array  # (n, n)
    pull: Array  # (n,)
    fixed: Array  # (n, n), information if the pose were known

    @staticmethod
    def nothing(count: int) -> ReducedEquations:
        """Of `count` numbers of which nothing is known."""
        square = np.zeros((count, count))
        return ReducedEquations(square, np.zeros(count), square)

    def mixed(self, newer: ReducedEquations, share: float) -> ReducedEquations:
        """The running mean, with a share of the newer one."""
        old, new = (self.information, self.pull, self.fixed), (newer.information, newer.pull, newer.fixed)
        return ReducedEquations(*(a + share * (b - a) for a, b in zip(old, new, strict=True)))

    def numbers(self) -> Array:
        """(n,) the solution; zero where the pose absorbs nearly all, and for cameras without tracks."""
        steady = MIN_OBSERVABLE_SHARE * self.fixed + 1e-9 * np.eye(len(self.pull))
        return np.asarray(np.linalg.solve(self.information + steady, self.pull))


class BumpDetector:
    """Remembers of each camera the usual and the recent shift, roll and scale of its picture."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self.begin()

    def begin(self) -> None:
        """Forget everything, as for a new map."""
        count = len(self._names)
        self.bumped: dict[int, str] = {}  # cameras, and the text about each
        self._quick = [ReducedEquations.nothing(PICTURE_DOF)] * count
        self._usual = ReducedEquations.nothing(PICTURE_DOF * count)
        self._spread, self._looks = np.zeros(count), np.zeros(count)  # px^2, usual mean square change; looks taken
        self._since = np.full(count, np.nan)  # s, since when a camera looks bumped, or well again
        self._learned = np.zeros(count)  # s in which a camera's usual values were learned
        self._first, self._stamp, self._count = np.nan, np.nan, 0
        self._outliers: frozenset[int] = frozenset()
        self.unequal = UnequalMotion()

    @property
    def messages(self) -> dict[int, str]:
        """The texts of bumped cameras, without those that the last look showed in place (`bumped` keeps these)."""
        return {c: text for c, text in self.bumped.items() if np.isnan(self._since[c])}

    def update(
        self,
        rig: Rig,
        observations: Observations,
        points: Array,
        exposed: Array,
        jacobians: Array,
        outliers: frozenset[int],
        smear: Array | None = None,
    ) -> None:
        """Take an accepted frame set.

        points: (N, 3) mm, surface, of the tracks. exposed: (C, 4, 4) base_from_surface when each camera exposed.
        jacobians: (N, 2, 6) px by the pose. outliers: cameras so far off that the pose is without them; their change is
        forgotten once they are back. smear: (6,) one sigma by which the surface moves in an exposure's delay.
        """
        if observations.stamp - self._stamp < LOOK_INTERVAL_S and not self.bumped:
            return
        self._forget(self._outliers - outliers)
        self._outliers = outliers
        parts = camera_equations(rig, observations, points, exposed, jacobians)
        self.unequal.update(rig, observations.stamp, points, exposed, parts, np.zeros(6) if smear is None else smear)
        if np.isnan(self._first):
            self._first = self._stamp = observations.stamp
        step, self._stamp = max(observations.stamp - self._stamp, 0.0), observations.stamp
        self._count += 1
        if young := observations.stamp - self._first < WARMUP_S:
            self._learn(parts, step, 1 / self._count)
        usual = self._usual.numbers().reshape(-1, PICTURE_DOF)
        known = {c: part.without(usual[c]) for c, part in parts.items() if self._learned[c] + step >= WARMUP_S / 2}
        self._judge(known, step, [c for c in known if not young and self._learned[c] + step >= WARMUP_S])
        if not (young or self.bumped or outliers):
            self._learn(parts, step, min(1.0, step / USUAL_MEMORY_S))

    def _learn(self, parts: dict[int, CameraEquations], step: float, share: float) -> None:
        """Mix what the cameras show into the usual values."""
        self._usual = self._usual.mixed(reduced_together(parts, len(self._names)), share)
        self._learned[list(parts)] += step

    def _judge(self, parts: dict[int, CameraEquations], step: float, ripe: Collection[int]) -> None:
        """Update each camera's recent change, and decide on the `ripe` ones: those known for long enough."""
        steady, now = parts.keys() - self.bumped.keys() - self._outliers, {}
        for camera in parts:
            reduced = reduced_alone(parts, camera, steady)
            self._quick[camera] = self._quick[camera].mixed(reduced, min(1.0, step / CHANGE_MEMORY_S))
            now[camera] = parts[camera].moved(reduced.numbers())
        changes = {c: self._quick[c].numbers() for c in parts}
        moved = {c: parts[c].moved(v) for c, v in changes.items()}
        gains = {c: float(v @ self._quick[c].pull) for c, v in changes.items()}
        for camera in ripe:
            others = [g for c, g in gains.items() if c != camera and c not in self.bumped]
            clear = gains[camera] > NEXT_CAMERA_RATIO * max(others, default=0.0)
            self._decide(camera, now[camera] if camera in self.bumped else moved[camera], clear)
            if camera in self.bumped:
                self.bumped[camera] = _bump_text(changes[camera], parts[camera], moved[camera])
        if not self.bumped:
            for camera in parts:
                self._looks[camera] += 1
                share = min(1.0, step / USUAL_MEMORY_S) if camera in ripe else 1 / self._looks[camera]
                self._spread[camera] += share * (moved[camera] ** 2 - self._spread[camera])

    def _forget(self, cameras: frozenset[int]) -> None:
        """These cameras show their usual picture again."""
        for camera in cameras:
            self.bumped.pop(camera, None)
            self._since[camera] = np.nan
            self._quick[camera] = replace(self._quick[camera], pull=np.zeros(PICTURE_DOF))

    def _decide(self, camera: int, moved: float, clear: bool) -> None:
        """Whether a camera counts as bumped from now on. moved: px. clear: whether it explains more than the others."""
        known = camera in self.bumped
        limit = max(MIN_BUMP_PX, USUAL_CHANGE_RATIO * float(np.sqrt(self._spread[camera])))
        off = moved > limit / 2 if known else moved > limit and clear
        if off == known:
            self._since[camera] = np.nan
        elif np.isnan(self._since[camera]):
            self._since[camera] = self._stamp
        lasted = self._stamp - self._since[camera]  # nan where nothing changes
        if off and not known and lasted >= BUMP_LASTS_S:
            self.bumped[camera] = ""
        elif known and not off and lasted >= BUMP_OVER_S:
            self._forget(frozenset([camera]))


@dataclass(frozen=True, slots=True, eq=False)
class _PictureLook:
    """One camera's picture in one look: what it says of its own pose, and where K anchors stand."""

    stamp: float  # s
    pixels: Array  # (2K,) px, of the anchors by the pose of all
    slopes: Array  # (2K, 6) px by the pose
    information: Array  # (6, 6) of the pose by this camera alone
    pulled: Array  # (6,)
    smear: float  # px, one sigma, by late exposures
    ways: dict[tuple[int, ...], tuple[Array, float]] = field(default_factory=dict)  # by cameras: computed once

    def way(self, by: Mapping[int, _PictureLook]) -> tuple[Array, float]:
        """Where the anchors stand (2K,), px, by the pose of these looks of the frame set, and the variance, px^2."""
        if tuple(by) not in self.ways:
            information = np.stack([look.information for look in by.values()]).sum(0)
            known = np.linalg.inv(information + (1e-9 * np.trace(information) + 1e-12) * np.eye(6))
            spread = float(np.einsum("ki,ij,kj->", self.slopes, known, self.slopes)) / len(self.slopes)
            step = known @ np.stack([look.pulled for look in by.values()]).sum(0)
            self.ways[tuple(by)] = self.pixels + self.slopes @ step, spread
        return self.ways[tuple(by)]


class _PictureWays:
    """How one camera's picture went, by its own pose and by that of others in the same frame sets: T looks."""

    def __init__(self, camera: int, sets: Sequence[Mapping[int, _PictureLook]] = ()) -> None:
        self._camera = camera
        self._own = self._others = np.zeros((0, 0))  # (T, 2K) px
        self._variance = np.zeros((0, 1))  # (T, 1) px^2 per axis, of their difference
        for looks in sets:
            self.add(looks, len(sets))

    def add(self, looks: Mapping[int, _PictureLook], most: int) -> None:
        """The looks of the next frame set; the last `most` are kept."""
        look = looks[self._camera]
        own, noise = look.way({self._camera: look})
        others, more = look.way({c: other for c, other in looks.items() if c != self._camera})
        variance = np.array([noise + more + look.smear**2])
        self._own, self._others = _longer(self._own, own, most), _longer(self._others, others, most)
        self._variance = _longer(self._variance, variance, most)

    def unequal(self) -> float:
        """By how many times what is allowed the ways differ that end now."""
        worst = 0.0
        for block in (block for block in WAY_BLOCKS if len(self._own) >= 2 * block):
            mine, theirs, spread = (_block_means(rows, block) for rows in (self._own, self._others, self._variance))
            apart = mine - theirs
            differ = _lengths(apart[-1] - apart[:-block])
            size = np.maximum(_lengths(mine[-1] - mine[:-block]), _lengths(theirs[-1] - theirs[:-block]))
            doubt = np.sqrt(2 * (spread[-1, 0] + spread[:-block, 0]) / block)
            allowed = np.maximum(np.maximum(MIN_UNEQUAL_PX, UNEQUAL_SIGMAS * doubt), UNEQUAL_SHARE * size)
            worst = max(worst, float((differ / allowed).max()))
        return worst


def _longer(rows: Array, row: Array, most: int) -> Array:
    """The last `most` of rows (T, K) and one more."""
    return row[None] if not len(rows) else np.concatenate([rows[max(0, len(rows) + 1 - most) :], row[None]])


class UnequalMotion:
    """Remembers how each camera's picture moved lately, and which camera does not move as the others do."""

    def __init__(self) -> None:
        self.apart: frozenset[int] = frozenset()  # the camera without which the others move alike, if one does not
        self._looks, self._since = 0, np.nan  # in which ways were unequal, in a row; s, stamp of the last
        self._tracks: dict[int, float] = {}  # usual number by camera
        self.forget()

    def forget(self) -> None:
        """Compare with no earlier picture, as after a change of the map."""
        self._past: deque[dict[int, _PictureLook]] = deque()
        self._ways: dict[int, _PictureWays] = {}
        self._anchors: Array | None = None  # (K, 3) mm, surface frame

    def update(
        self, rig: Rig, stamp: float, points: Array, exposed: Array, parts: dict[int, CameraEquations], smear: Array
    ) -> None:
        """Take a look. points: (N, 3) mm. exposed: (C, 4, 4). smear: (6,) mm and rad, of late exposures.

        Cameras with fewer tracks than usual do not count: what covers a picture or blurs it drags the rest along.
        """
        parts = {c: part for c, part in parts.items() if self._shows_usual(c, len(part.slopes))}
        if len(parts) < 2:
            return
        self._anchors = spread_anchors(points) if self._anchors is None else self._anchors
        now: dict[int, _PictureLook] = {}
        for c, part in parts.items():
            pixels, _, jacobian = project(rig, np.full(len(self._anchors), c), exposed[c], self._anchors)
            slopes = jacobian.reshape(-1, 6)
            late = float(np.sqrt(np.mean((slopes @ smear) ** 2)))
            now[c] = _PictureLook(stamp, pixels.ravel(), slopes, part.pose, part.pulled, late)
        if self._past and (now.keys() != self._past[-1].keys() or self._old(stamp)):
            self._forget_before(stamp, now.keys())
        self._past.append(now)
        for c in now:
            self._ways.setdefault(c, _PictureWays(c)).add(now, len(self._past))
        self._decide(stamp, {c: self._ways[c].unequal() for c in now})

    def _shows_usual(self, camera: int, tracks: int) -> bool:
        usual = self._tracks.setdefault(camera, float(tracks))
        if tracks > FEW_TRACKS * usual:
            self._tracks[camera] += TRACKS_SHARE * (tracks - usual)
        return tracks >= WHOLE_SHARE * usual

    def _old(self, stamp: float) -> bool:
        return next(iter(self._past[0].values())).stamp < stamp - WAY_MEMORY_S

    def _forget_before(self, stamp: float, cameras: Collection[int]) -> None:
        """Drop looks that are old, and all where other cameras see the surface now."""
        same = self._past[-1].keys() == set(cameras)
        while self._past and (not same or self._old(stamp)):
            self._past.popleft()

    def _decide(self, stamp: float, unequal: dict[int, float]) -> None:
        """Which camera is apart, by how unequal each one's ways are to those of the others."""
        if max(unequal.values()) > 1:
            self._looks, self._since = self._looks + 1, stamp
            if self._looks >= MIN_UNEQUAL_LOOKS:
                self.apart = frozenset([min(unequal, key=self._without)])
        else:
            self._looks = 0
            if stamp - self._since > EQUAL_AGAIN_S:
                self.apart = frozenset()

    def _without(self, camera: int) -> float:
        """How unequal the others' ways are among themselves without a camera."""
        rest = [{c: look for c, look in looks.items() if c != camera} for looks in self._past]
        return max(_PictureWays(c, rest).unequal() for c in rest[-1]) if len(rest[-1]) > 1 else 0.0


def _block_means(rows: Array, block: int) -> Array:
    """Means (T - block + 1, K) of `block` rows (T, K) that follow each other."""
    sums = np.cumsum(np.concatenate([np.zeros((1, rows.shape[1])), rows]), axis=0)
    return np.asarray((sums[block:] - sums[:-block]) / block)


def _lengths(ways: Array) -> Array:
    """Root mean square (T,), px, over the anchors of ways (T, 2K)."""
    return np.asarray(np.sqrt(2 * np.mean(ways**2, axis=1)))


def contradicts(seen: Observations, carried: PoseFit, rival: RivalPose) -> bool:
    """Whether a rival's pictures contradict those of the carriers, and not the shape of the map.

    seen: N tracks. carried: the carriers' fit. Where the surface deforms, each camera sees it at a pose of its own, but
    what two see of a landmark fits one place. What no places explain of both poses' difference, residuals must show.
    """
    count, camera, track = int(seen.track.max()) + 1, seen.camera, seen.track
    mine, theirs = rival.inlier, (carried.weights > INLIER_WEIGHT) & np.isin(camera, list(rival.carriers))
    both = (np.bincount(track[mine], minlength=count) > 0) & (np.bincount(track[theirs], minlength=count) > 0)
    rows = (mine | theirs) & both[track]
    jacobian, precision = np.ascontiguousarray(carried.jacobians[rows]), seen.sigma[rows] ** -2.0
    shown, landmark = np.ascontiguousarray(carried.residuals[rows]), np.ascontiguousarray(track[rows])
    expected = np.ascontiguousarray(mine[rows][:, None] * -(jacobian @ rival.difference))
    normal, by_shown = displacement_sums(count, landmark, jacobian, shown, precision)[:2]
    _, by_expected, square, _ = displacement_sums(count, landmark, jacobian, expected, precision)
    placed = solve_symmetric3(normal + PLACE_PRIOR * np.eye(3), by_expected)
    known = float((square - (placed * by_expected).sum(1)).sum())  # inverse variance of the part that is shown,
    part = float((precision[:, None] * shown * expected).sum() - (placed * by_shown).sum())
    return bool(part > max(MIN_CONTRADICTION * known, CONTRADICTION_SIGMAS * known**0.5))


def spread_anchors(points: Array) -> Array:
    """Of points (N, 3), the one in the middle and those that lie farthest out to four sides: (5, 3)."""
    away = points - points.mean(0)
    along = away @ np.linalg.svd(away, full_matrices=False)[2][:2].T
    rows = [int(np.argmin((away**2).sum(1))), *np.argmin(along, 0).tolist(), *np.argmax(along, 0).tolist()]
    return np.asarray(points[rows])


def reduced_alone(parts: dict[int, CameraEquations], camera: int, others: Collection[int]) -> ReducedEquations:
    """The equations of this camera's numbers, with the pose determined by it and by these others."""
    mine = parts[camera]
    share = _pose_share([mine, *(p for c, p in parts.items() if c in others and c != camera)], mine.cross)
    return ReducedEquations(mine.own - mine.cross @ share[:, :-1], mine.pull - mine.cross @ share[:, -1], mine.own)


def reduced_together(parts: dict[int, CameraEquations], count: int) -> ReducedEquations:
    """The equations of all cameras' numbers together, with the pose free; zero for cameras without tracks."""
    size = PICTURE_DOF * count
    fixed, cross, pull = np.zeros((size, size)), np.zeros((size, 6)), np.zeros(size)
    for camera, part in parts.items():
        at = slice(PICTURE_DOF * camera, PICTURE_DOF * (camera + 1))
        fixed[at, at], cross[at], pull[at] = part.own, part.cross, part.pull
    share = _pose_share(list(parts.values()), cross)
    return ReducedEquations(fixed - cross @ share[:, :-1], pull - cross @ share[:, -1], fixed)


def _pose_share(parts: Sequence[CameraEquations], cross: Array) -> Array:
    """(6, n + 1), what the pose by these cameras absorbs of n numbers (cross: (n, 6)) and of their pull."""
    pose, pulled = np.zeros((6, 6)), np.zeros(6)
    for part in parts:
        pose, pulled = pose + part.pose, pulled + part.pulled
    held = pose + (1e-9 * np.trace(pose) + 1e-12) * np.eye(6)
    return np.asarray(np.linalg.solve(held, np.column_stack([cross.T, pulled])))


def _bump_text(change: Array, part: CameraEquations, moved: float) -> str:
    if part.moved(change * [0, 0, 0, 1]) > part.moved(change * [1, 1, 1, 0]):  # by scale more than by shift and roll
        return f"shows all {100 * abs(change[3]):.1f} % {'larger' if change[3] > 0 else 'smaller'}: its lens was turned"
    return f"was bumped: its picture stands {moved:.1f} px off where it stood"
