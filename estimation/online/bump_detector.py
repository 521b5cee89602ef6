"""Small bumps of a camera and turned lenses, detected in all of its tracks together, against the other cameras.

A single frame set hardly shows a bump of half a millimetre, and the pose absorbs a part of it. So four numbers are
estimated for each camera: shift (2), roll and scale of its picture, with the pose marginalised. They are averaged over
half a second and compared with their usual values. The camera that explains most of the change is the one. A shift or
roll is a bump. A change of scale is a turned lens; a push along the axis looks the same (4 mm of 400 are one percent).

The usual values are learned of all cameras together and subtracted from the residuals, so that they hold whichever
cameras see the surface. A camera whose usual values are not known yet is not judged, and does not judge others. A
number that the pose could absorb almost whole (two cameras of three, along the plane of their rays) cannot be told
from small errors of the map, and is held at zero.

A camera that hangs before a slow motion is off by little for long, most of all where the motion is along its axis or
along that of the one that does not hang. So the motion of each picture within seconds, by the camera's own pose, is
compared with the motion by the others' pose (`UnequalMotion`): in so short a time errors of lens and map are constant.
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
WHOLE_SHARE, FEW_TRACKS_SHARE = 0.8, 0.4  # of its usual tracks: a whole picture; so few that nothing usual is learned,
TRACKS_SHARE = 0.25  # of a look's number: a first map is looked for whole, later ones in part
PLACE_PRIOR = 1 / 5.0**2  # mm^-2, of a landmark's displacement: no tissue deforms further
MIN_CONTRADICTION = 0.5  # of what is expected must be shown by pictures of another instant,
CONTRADICTION_SIGMAS = 5.0  # and so many of the tracks' noise: lens and map err alike from landmark to landmark
MIN_UNEQUAL_SETS = 2  # one after the other
EQUAL_HOLD_S = 0.5  # that ways must be alike until the camera is like the others again


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
        self._spread, self._counts = np.zeros(count), np.zeros(count)  # px^2, usual mean square change; looks taken
        self._since = np.full(count, np.nan)  # s, since when a camera looks bumped, or well again
        self._learned = np.zeros(count)  # s in which a camera's usual values were learned
        self._first, self._stamp, self._count = np.nan, np.nan, 0
        self._outliers: frozenset[int] = frozenset()
        self.unequal_motion = UnequalMotion()

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
        smear = np.zeros(6) if smear is None else smear
        self.unequal_motion.update(rig, observations.stamp, points, exposed, parts, smear)
        if np.isnan(self._first):
            self._first = self._stamp = observations.stamp
        step, self._stamp = max(observations.stamp - self._stamp, 0.0), observations.stamp
        self._count += 1
        if warming_up := observations.stamp - self._first < WARMUP_S:
            self._learn(parts, step, 1 / self._count)
        usual = self._usual.numbers().reshape(-1, PICTURE_DOF)
        relative = {c: part.without(usual[c]) for c, part in parts.items() if self._learned[c] + step >= WARMUP_S / 2}
        self._judge(relative, step, [c for c in relative if not warming_up and self._learned[c] + step >= WARMUP_S])
        if not (warming_up or self.bumped or outliers):
            self._learn(parts, step, min(1.0, step / USUAL_MEMORY_S))

    def _learn(self, parts: dict[int, CameraEquations], step: float, share: float) -> None:
        """Mix what the cameras show into the usual values."""
        self._usual = self._usual.mixed(reduced_together(parts, len(self._names)), share)
        self._learned[list(parts)] += step

    def _judge(self, parts: dict[int, CameraEquations], step: float, ready: Collection[int]) -> None:
        """Update each camera's recent change, and decide on the `ready` ones: those known for long enough."""
        steady, current = parts.keys() - self.bumped.keys() - self._outliers, {}
        for camera in parts:
            reduced = reduced_alone(parts, camera, steady)
            self._quick[camera] = self._quick[camera].mixed(reduced, min(1.0, step / CHANGE_MEMORY_S))
            current[camera] = parts[camera].moved(reduced.numbers())
        changes = {c: self._quick[c].numbers() for c in parts}
        moved = {c: parts[c].moved(v) for c, v in changes.items()}
        gains = {c: float(v @ self._quick[c].pull) for c, v in changes.items()}
        for camera in ready:
            others = [g for c, g in gains.items() if c != camera and c not in self.bumped]
            clear = gains[camera] > NEXT_CAMERA_RATIO * max(others, default=0.0)
            self._decide(camera, current[camera] if camera in self.bumped else moved[camera], clear)
            if camera in self.bumped:
                self.bumped[camera] = _bump_text(changes[camera], parts[camera], moved[camera])
        if not self.bumped:
            for camera in parts:
                self._counts[camera] += 1
                share = min(1.0, step / USUAL_MEMORY_S) if camera in ready else 1 / self._counts[camera]
                self._spread[camera] += share * (moved[camera] ** 2 - self._spread[camera])

    def _forget(self, cameras: frozenset[int]) -> None:
        """These cameras show their usual picture again."""
        for camera in cameras:
            self.bumped.pop(camera, None)
            self._since[camera] = np.nan
            self._quick[camera] = replace(self._quick[camera], pull=np.zeros(PICTURE_DOF))

    def _decide(self, camera: int, change_px: float, clear: bool) -> None:
        """Whether a camera counts as bumped from now on. clear: whether it explains more than the others."""
        bumped = camera in self.bumped
        limit = max(MIN_BUMP_PX, USUAL_CHANGE_RATIO * float(np.sqrt(self._spread[camera])))
        off = change_px > limit / 2 if bumped else change_px > limit and clear
        if off == bumped:
            self._since[camera] = np.nan
        elif np.isnan(self._since[camera]):
            self._since[camera] = self._stamp
        lasted = self._stamp - self._since[camera]  # nan where nothing changes
        if off and not bumped and lasted >= BUMP_LASTS_S:
            self.bumped[camera] = ""
        elif bumped and not off and lasted >= BUMP_OVER_S:
            self._forget(frozenset([camera]))


@dataclass(frozen=True, slots=True, eq=False)
class _PictureLook:
    """One camera's picture in one frame set: its equations of the pose, and the pixels of K anchors."""

    stamp: float  # s
    pixels: Array  # (2K,) px, of the anchors by the pose of all
    jacobian: Array  # (2K, 6) px by the pose
    information: Array  # (6, 6) of the pose by this camera alone
    pull: Array  # (6,)
    smear: float  # px, one sigma, by late exposures
    ways: dict[tuple[int, ...], tuple[Array, float]] = field(default_factory=dict)  # by cameras: computed once

    def way(self, by: Mapping[int, _PictureLook]) -> tuple[Array, float]:
        """Where the anchors stand (2K,), px, by the pose of these looks of the frame set, and the variance, px^2."""
        if tuple(by) not in self.ways:
            information = np.stack([look.information for look in by.values()]).sum(0)
            covariance = np.linalg.inv(information + (1e-9 * np.trace(information) + 1e-12) * np.eye(6))
            spread = float(np.einsum("ki,ij,kj->", self.jacobian, covariance, self.jacobian)) / len(self.jacobian)
            step = covariance @ np.stack([look.pull for look in by.values()]).sum(0)
            self.ways[tuple(by)] = self.pixels + self.jacobian @ step, spread
        return self.ways[tuple(by)]


class _PictureWays:
    """How one camera's picture went, by its own pose and by that of others in the same frame sets: T looks."""

    def __init__(self, camera: int, sets: Sequence[Mapping[int, _PictureLook]] = ()) -> None:
        self._camera = camera
        self._own_ways = self._other_ways = np.zeros((0, 0))  # (T, 2K) px
        self._variance = np.zeros((0, 1))  # (T, 1) px^2 per axis, of their difference
        for looks in sets:
            self.add(looks, len(sets))

    def add(self, looks: Mapping[int, _PictureLook], limit: int) -> None:
        """The looks of the next frame set; the last `limit` are kept."""
        look = looks[self._camera]
        own, noise = look.way({self._camera: look})
        others, other_noise = look.way({c: other for c, other in looks.items() if c != self._camera})
        variance = np.array([noise + other_noise + look.smear**2])
        self._own_ways, self._other_ways = _longer(self._own_ways, own, limit), _longer(self._other_ways, others, limit)
        self._variance = _longer(self._variance, variance, limit)

    def unequal(self) -> float:
        """Largest difference of the ways that end now, over its limit."""
        worst = 0.0
        for block in (block for block in WAY_BLOCKS if len(self._own_ways) >= 2 * block):
            ways = self._own_ways, self._other_ways, self._variance
            own, others, spread = (_block_means(rows, block) for rows in ways)
            difference = own - others
            change = _lengths(difference[-1] - difference[:-block])
            size = np.maximum(_lengths(own[-1] - own[:-block]), _lengths(others[-1] - others[:-block]))
            sigma = np.sqrt(2 * (spread[-1, 0] + spread[:-block, 0]) / block)
            allowed = np.maximum(np.maximum(MIN_UNEQUAL_PX, UNEQUAL_SIGMAS * sigma), UNEQUAL_SHARE * size)
            worst = max(worst, float((change / allowed).max()))
        return worst


def _longer(rows: Array, row: Array, limit: int) -> Array:
    """The last `limit` of rows (T, K) and one more."""
    return row[None] if not len(rows) else np.concatenate([rows[max(0, len(rows) + 1 - limit) :], row[None]])


class UnequalMotion:
    """Each camera's recent picture motion, and which camera does not move as the others do."""

    def __init__(self) -> None:
        self.outliers: frozenset[int] = frozenset()  # the camera without which the others move alike, if one does not
        self._sets, self._since = 0, np.nan  # in which ways were unequal, in a row; s, stamp of the last
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

        Cameras with fewer tracks than usual do not count: an occluder or blur drags the other tracks along.
        """
        parts = {c: part for c, part in parts.items() if self._shows_usual(c, len(part.jacobian))}
        if len(parts) < 2:
            return
        self._anchors = spread_anchors(points) if self._anchors is None else self._anchors
        looks: dict[int, _PictureLook] = {}
        for c, part in parts.items():
            pixels, _, jacobian = project(rig, np.full(len(self._anchors), c), exposed[c], self._anchors)
            slopes = jacobian.reshape(-1, 6)
            smear_px = float(np.sqrt(np.mean((slopes @ smear) ** 2)))
            looks[c] = _PictureLook(stamp, pixels.ravel(), slopes, part.pose_information, part.pose_pull, smear_px)
        if self._past and (looks.keys() != self._past[-1].keys() or self._old(stamp)):
            self._forget_before(stamp, looks.keys())
        self._past.append(looks)
        for c in looks:
            self._ways.setdefault(c, _PictureWays(c)).add(looks, len(self._past))
        self._decide(stamp, {c: self._ways[c].unequal() for c in looks})

    def _shows_usual(self, camera: int, tracks: int) -> bool:
        usual = self._tracks.setdefault(camera, float(tracks))
        if tracks > FEW_TRACKS_SHARE * usual:
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
            self._sets, self._since = self._sets + 1, stamp
            if self._sets >= MIN_UNEQUAL_SETS:
                self.outliers = frozenset([min(unequal, key=self._without)])
        else:
            self._sets = 0
            if stamp - self._since > EQUAL_HOLD_S:
                self.outliers = frozenset()

    def _without(self, camera: int) -> float:
        """How unequal the others' ways are among themselves without a camera."""
        remaining = [{c: look for c, look in looks.items() if c != camera} for looks in self._past]
        return max(_PictureWays(c, remaining).unequal() for c in remaining[-1]) if len(remaining[-1]) > 1 else 0.0


def _block_means(rows: Array, block: int) -> Array:
    """Means (T - block + 1, K) of `block` rows (T, K) that follow each other."""
    sums = np.cumsum(np.concatenate([np.zeros((1, rows.shape[1])), rows]), axis=0)
    return np.asarray((sums[block:] - sums[:-block]) / block)


def _lengths(ways: Array) -> Array:
    """Root mean square (T,), px, over the anchors of ways (T, 2K)."""
    return np.asarray(np.sqrt(2 * np.mean(ways**2, axis=1)))


def contradicts(observations: Observations, carrier_fit: PoseFit, rival: RivalPose) -> bool:
    """Whether a rival's pictures contradict those of the carriers (`carrier_fit`), and not the shape of the map.

    observations: N tracks. Where the surface deforms, each camera sees it at a pose of its own, but two cameras' tracks
    of a landmark fit one place. The residuals must show the part of the poses' difference that no place explains.
    """
    count, camera, track = int(observations.track.max()) + 1, observations.camera, observations.track
    own, others = rival.inlier, (carrier_fit.weights > INLIER_WEIGHT) & np.isin(camera, list(rival.carriers))
    both = (np.bincount(track[own], minlength=count) > 0) & (np.bincount(track[others], minlength=count) > 0)
    rows = (own | others) & both[track]
    jacobian, precision = np.ascontiguousarray(carrier_fit.jacobians[rows]), observations.sigma[rows] ** -2.0
    residual, landmark = np.ascontiguousarray(carrier_fit.residuals[rows]), np.ascontiguousarray(track[rows])
    expected = np.ascontiguousarray(own[rows][:, None] * -(jacobian @ rival.difference))
    normal, by_residual = displacement_sums(count, landmark, jacobian, residual, precision)[:2]
    _, by_expected, square, _ = displacement_sums(count, landmark, jacobian, expected, precision)
    displaced = solve_symmetric3(normal + PLACE_PRIOR * np.eye(3), by_expected)
    information = float((square - (displaced * by_expected).sum(1)).sum())  # of the part that residuals show
    projection = float((precision[:, None] * residual * expected).sum() - (displaced * by_residual).sum())
    return bool(projection > max(MIN_CONTRADICTION * information, CONTRADICTION_SIGMAS * information**0.5))


def spread_anchors(points: Array) -> Array:
    """Of points (N, 3), the one in the middle and those that lie farthest out to four sides: (5, 3)."""
    offsets = points - points.mean(0)
    along = offsets @ np.linalg.svd(offsets, full_matrices=False)[2][:2].T
    rows = [int(np.argmin((offsets**2).sum(1))), *np.argmin(along, 0).tolist(), *np.argmax(along, 0).tolist()]
    return np.asarray(points[rows])


def reduced_alone(parts: dict[int, CameraEquations], camera: int, others: Collection[int]) -> ReducedEquations:
    """The equations of this camera's numbers, with the pose determined by it and by these others."""
    own, cross = parts[camera], parts[camera].cross
    share = _pose_share([own, *(p for c, p in parts.items() if c in others and c != camera)], cross)
    return ReducedEquations(own.information - cross @ share[:, :-1], own.pull - cross @ share[:, -1], own.information)


def reduced_together(parts: dict[int, CameraEquations], count: int) -> ReducedEquations:
    """The equations of all cameras' numbers together, with the pose free; zero for cameras without tracks."""
    size = PICTURE_DOF * count
    fixed, cross, pull = np.zeros((size, size)), np.zeros((size, 6)), np.zeros(size)
    for camera, part in parts.items():
        at = slice(PICTURE_DOF * camera, PICTURE_DOF * (camera + 1))
        fixed[at, at], cross[at], pull[at] = part.information, part.cross, part.pull
    share = _pose_share(list(parts.values()), cross)
    return ReducedEquations(fixed - cross @ share[:, :-1], pull - cross @ share[:, -1], fixed)


def _pose_share(parts: Sequence[CameraEquations], cross: Array) -> Array:
    """(6, n + 1), what the pose by these cameras absorbs of n numbers (cross: (n, 6)) and of their pull."""
    pose, pull = np.zeros((6, 6)), np.zeros(6)
    for part in parts:
        pose, pull = pose + part.pose_information, pull + part.pose_pull
    damped = pose + (1e-9 * np.trace(pose) + 1e-12) * np.eye(6)
    return np.asarray(np.linalg.solve(damped, np.column_stack([cross.T, pull])))


def _bump_text(change: Array, part: CameraEquations, change_px: float) -> str:
    if part.moved(change * [0, 0, 0, 1]) > part.moved(change * [1, 1, 1, 0]):  # by scale more than by shift and roll
        return f"shows all {100 * abs(change[3]):.1f} % {'larger' if change[3] > 0 else 'smaller'}: its lens was turned"
    return f"was bumped: its picture stands {change_px:.1f} px off where it stood"
