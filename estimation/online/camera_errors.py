"""Errors of whole cameras, learned online: when each really exposes, and by how much its image is shifted.

Webcams run free. Each has an offset from its stamps that hardly changes (10 to 60 ms were seen), and a jitter from
frame to frame. Both show where the surface moves: a late camera sees it displaced along its motion. Lens, extrinsics
and grazing views shift all of a camera's tracks alike, moving or not; a part of the shift stays, a part varies.

One Kalman filter holds what stays, offsets and shifts together, so that a shifted lens is not taken for a late clock.
What varies is learned as two variances. A delay common to all cameras cannot be seen: the reference is their mean.
Only the offsets are corrected. The map is made through the same lenses, so a shift that stays is in the map too, and
correcting it would carry the pose away from the map (measured: 0.04 mm on a surface at rest that had no shift at all).

Pictures that hang, or suddenly come late, show the surface where it once was, and two cameras that hang agree with each
other. So those that carry the pose are believed against others (`RivalWatch`) only once they have been seen to move,
and not along the way that the others went before: pictures are late, never early.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from estimation import se3
from estimation.online.fit import RivalPose
from estimation.pose_solver import SharedErrors, SharedFit
from estimation.rig import Rig, ideal_pixels
from estimation.se3 import Array, Index


@dataclass(frozen=True, slots=True, eq=False)
class Delays:
    """How much later than stamped the C cameras expose."""

    mean: Array  # (C,) s
    covariance: Array  # (C, C) s^2, of one frame set's

    @property
    def sigma(self) -> float:
        """One standard deviation, s, of a camera's delay from its mean."""
        return float(np.sqrt(np.mean(np.diag(self.covariance))))


class VarianceEstimate:
    """The variance of a quantity that is seen through noise of known size, by Fisher scoring.

    A value d known to a variance e is a draw from sigma^2 + e, so sigma^2 is the mean of d^2 - e under the weights
    (sigma^2 + e)^-2. Expectation maximisation needed ten times the frames where single values are uncertain. Values
    without information do not count, and nothing is forgotten over them.
    """

    PRIOR_VALUES, RECENT = 3.0, 100  # values that the initial belief is worth; known values over which it is forgotten

    def __init__(self, first: float, least: float, clearest: float) -> None:
        """All one sigma: first, the initial belief; least, the smallest; clearest, no value is known better."""
        self._unit, self._least, self._clearest = first**2, least**2, clearest**2
        self._weight = self.PRIOR_VALUES  # one value known exactly, against a variance of `first`, weighs 1
        self._sum = self.PRIOR_VALUES * self._unit  # weighted, of d^2 - e

    @property
    def value(self) -> float:
        """The variance: its mean, and a part of what that may be off by."""
        return float(max(self._sum / self._weight, self._least) + 0.5 * (2 / self._weight) ** 0.5 * self._unit)

    def take(self, value: float, variance: float) -> None:
        """One value, known to a variance."""
        now = self.value
        share = (self._unit / (now + variance)) ** 2
        most = 2 * (self._unit / self._clearest) ** 2
        keep = min(1 - (now / (now + variance)) ** 2 / self.RECENT, most / (self._weight + share))
        self._weight = keep * self._weight + share
        self._sum = keep * self._sum + share * (value**2 - variance)


class CameraErrors:
    """Offsets and shifts of all cameras, with their joint covariance."""

    INITIAL_OFFSET_S, INITIAL_SHIFT_PX = 0.01, 0.5  # one sigma: webcams, and a usual calibration
    CHANCE_CHI2, CERTAIN_CHI2 = 2.0, 8.0  # mean squared sigmas at which chance explains the offsets, or does not
    DRIFT_RATE = 2e-5, 5e-3  # s and px per root second: quartz differs by 50 ppm at most; lenses warm up
    INFORMATION_DIVISOR = 3.0  # unmodelled errors repeat from frame to frame: each fit counts so much less
    MIN_SIGNAL_SHARE = 0.8  # of the squared velocity: where more of it is noise, nothing is learned of delays
    MAX_DELAY = 0.1  # s: a longer one is a wrong pose

    def __init__(self, cameras: int) -> None:
        self._count = n = cameras
        self._free = np.eye(3 * n)  # takes out what all clocks have in common
        self._free[:n, :n] -= 1 / n
        self._mean = np.zeros(3 * n)  # delays s, shifts right px, shifts down px
        start = np.diag(np.repeat([self.INITIAL_OFFSET_S**2, self.INITIAL_SHIFT_PX**2, self.INITIAL_SHIFT_PX**2], n))
        self._covariance = self._free @ start @ self._free
        # (C,) s, how much later than stamped each camera exposes; zero until offsets are clear: many cameras are
        # triggered together, and a correction by chance would only move the pose about
        self.offset = np.zeros(n)
        self._jitter = VarianceEstimate(0.005, 3e-4, 1e-3)  # s: USB cameras; no stamp is better
        self._unrest = VarianceEstimate(0.05, 0.005, 0.01)  # px, of a camera's shift from frame to frame
        self.delays = self._expected_delays()  # of the next frame set

    @property
    def offset_sigma(self) -> Array:
        """One standard deviation (C,), s, of each offset."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self._covariance)[: self._count], 0.0)))

    @property
    def shift(self) -> Array:
        """Shift of each camera's image from where it should be (C, 2), px, without what the pose explains."""
        return self._mean[self._count :].reshape(2, -1).T.copy()

    def _expected_delays(self) -> Delays:
        n = self._count
        return Delays(self.offset, self._covariance[:n, :n] + self._jitter.value * np.eye(n))

    @property
    def unrest(self) -> float:
        """Variance, px^2 per axis, of an image's shift from frame to frame."""
        return self._unrest.value

    def beyond(self, corrected: Array) -> Array:
        """Second moments (C, C), s^2, of the delays that are left after a correction by offsets (C,), s."""
        left = self._mean[: self._count] - corrected
        return np.asarray(self.delays.covariance + np.outer(left, left))

    def shared(self, twist: Array) -> SharedErrors:
        """Shared errors that the next fit has to expect beyond `offset`, at a velocity (6,)."""
        return SharedErrors(twist, self.delays.covariance, np.full(self._count, self.unrest))

    def learn(self, fit: SharedFit, seconds: float, signal_share: float = 1.0) -> None:
        """Take a fit's shared errors, beyond the offsets that it was corrected by, `seconds` after the last one.

        signal_share: the part of the squared velocity that is not its own noise. Noise in a regressor makes the slope
        too small (errors in variables; Fuller 1987, 1.1), so delays are learned only where there is little of it.
        """
        n, eye = self._count, np.eye(3 * self._count)
        # about the known shifts and offsets; without information on delays where the velocity is not clear
        information, pull = fit.information.copy(), fit.pull.copy()
        pull -= information[:, n:] @ self._mean[n:] + information[:, :n] @ (self._mean[:n] - self.offset)
        if signal_share < self.MIN_SIGNAL_SHARE:
            information[:n] = information[:, :n] = pull[:n] = 0.0
        fit = SharedFit(information, pull)
        drift = np.repeat(self.DRIFT_RATE, [n, 2 * n]) ** 2 * seconds
        self._covariance = self._covariance + self._free * drift
        self._learn_variances(fit)
        # Kalman update in information form; the jitter and unrest of this frame set blur what stays
        new = np.repeat([self._jitter.value, self._unrest.value], [n, 2 * n])
        blurred = np.linalg.inv(eye + new[:, None] * fit.information)
        information = fit.information @ blurred / self.INFORMATION_DIVISOR
        gain = self._covariance @ np.linalg.inv(eye + information @ self._covariance)
        self._mean = self._free @ (self._mean + gain @ (blurred.T @ fit.pull) / self.INFORMATION_DIVISOR)
        self._covariance = self._free @ ((gain + gain.T) / 2) @ self._free
        # the offsets as far as chance does not explain them
        mean, known = self._mean[:n], np.linalg.pinv(self._covariance[:n, :n], hermitian=True)
        apart = float(mean @ known @ mean) / max(1, n - 1)
        self.offset = mean * min(1.0, max(0.0, (apart - self.CHANCE_CHI2) / (self.CERTAIN_CHI2 - self.CHANCE_CHI2)))
        self.delays = self._expected_delays()

    def _learn_variances(self, fit: SharedFit) -> None:
        n = self._count
        delays, shifts = np.arange(n), np.arange(n, 3 * n)
        new = np.repeat([self._jitter.value, self._unrest.value], [n, 2 * n])
        for part, rest, variance, far in (
            (delays, shifts, self._jitter, self.MAX_DELAY),
            (shifts, delays, self._unrest, np.inf),
        ):
            for value, doubt in zip(*self._independent(fit, part, rest, new), strict=True):
                if doubt < min(far**2, 1e3 * variance.value):
                    variance.take(float(value), float(doubt))

    def _independent(self, fit: SharedFit, part: Index, rest: Index, new: Array) -> tuple[Array, Array]:
        """Independent combinations (K,) of one part of the errors in this frame set, and their variances (K,)."""
        # the rest of the errors is marginalised
        prior = self._covariance[np.ix_(rest, rest)] + np.diag(new[rest])
        cross = fit.information[np.ix_(part, rest)]
        gain = cross @ prior @ np.linalg.inv(np.eye(len(rest)) + fit.information[np.ix_(rest, rest)] @ prior)
        information = fit.information[np.ix_(part, part)] - gain @ cross.T
        pull = fit.pull[part] - gain @ fit.pull[rest]
        # along the eigenvectors that are determined
        known, apart = np.linalg.eigh((information + information.T) / 2)
        sure = known > 1e-9 * known[-1]
        known, apart = known[sure], apart[:, sure]
        doubt = np.einsum("ik,ij,jk->k", apart, self._covariance[np.ix_(part, part)], apart)
        return (apart.T @ pull) / known, 1 / known + doubt


class CameraErrorHistory:
    """Camera errors as known some seconds ago: a deformation that begins is first taken for late cameras."""

    INTERVAL_S = 2.0  # a deformation is seen within one

    def __init__(self, cameras: CameraErrors) -> None:
        self._before, self._last, self._stamp = copy.deepcopy(cameras), copy.deepcopy(cameras), -np.inf

    def keep(self, stamp: float, cameras: CameraErrors) -> None:
        """Take the errors as known at `stamp`, s, every INTERVAL_S."""
        if stamp - self._stamp >= self.INTERVAL_S:
            self._before, self._last, self._stamp = self._last, copy.deepcopy(cameras), stamp

    @property
    def before(self) -> CameraErrors:
        """As known INTERVAL_S ago or earlier."""
        return copy.deepcopy(self._before)


MIN_VISIBLE_PX = 0.3  # root mean square over the anchors: more than lens and map change in a second,
VISIBLE_SIGMAS = 5.0  # and so many of the pose's own noise there
HANGS_RATIO = 2.0  # times what is visible that one side must move while the other does not
RIVAL_MEMORY_S = 2.0  # looked back for what has moved; half a slow breath
MAX_LAG_S, LAG_STEP_S = 0.5, 0.01  # by which pictures may come late, a dozen of them queued; and the step of its search
LAG_WINDOW_S = 0.25  # of the newest poses, which a lag must explain
CLEAR_LAG_RATIO = 3.0  # times what its own lag leaves must be left by the carriers' for a rival to be the late one
LAG_SHARE = 0.5  # of what they stand apart: a lag that leaves less explains it
STEADY_SHARE = 0.3  # of what the carriers moved: cameras that stand apart by a steadier distance move in step
RIVAL_HOLD_S, TRUST_MEMORY_S = 0.12, 1.0  # that doubt or trust stays after a rival is out of sight, or passes by


@dataclass(slots=True)
class _Verdict:
    """What is known of the carriers against one rival."""

    rival: RivalPose  # as last seen
    since: float  # s, when the carriers were last known to be right, or the rival was first seen
    seen: float  # s, when the rival was last seen
    trusted: bool = False  # whether the carriers are believed
    jumped: bool = False  # whether the rival left the motion that the carriers continued: then they are not late
    stood: bool = False  # whether they have stood still while the rival moved
    widest: Array = field(default_factory=lambda: np.zeros(6))  # the largest difference: who is late agrees at a turn
    still: frozenset[int] = frozenset()  # cameras that show no motion while the others move
    late: tuple[frozenset[int], float] = (frozenset(), 0.0)  # cameras that show what the others showed, and s before

    @property
    def open_to_both(self) -> bool:  # the rival may be right, and does not outnumber the carriers
        return not self.trusted and len(self.rival.cameras) <= len(self.rival.carriers)

    def remembered(self, stamp: float) -> bool:  # at `stamp`, s, though the rival is not seen
        return stamp - self.seen <= (TRUST_MEMORY_S if self.trusted or self.late[0] else RIVAL_HOLD_S)


@dataclass(slots=True)
class RivalWatch:
    """Remembers where carriers and rivals saw the surface lately, and which carriers may be believed."""

    anchors: Array  # (K, 3) mm, surface frame: where motion is looked for
    _looks: deque[tuple[float, Array, dict[frozenset[int], Array]]] = field(default_factory=deque)  # s, carried, own
    _verdicts: dict[frozenset[int], _Verdict] = field(default_factory=dict)

    def update(
        self, rig: Rig, stamp: float, carried: Array, rivals: Sequence[RivalPose], left_out: frozenset[int]
    ) -> None:
        """Take a frame set: pose (4, 4), those that contradict it, and those left out, which remain rivals unseen."""
        carried = rivals[0].carried if rivals else carried
        self._looks.append((stamp, carried, {rival.cameras: rival.own for rival in rivals}))
        while self._looks[0][0] < stamp - RIVAL_MEMORY_S:
            self._looks.popleft()
        for rival in rivals:
            verdict = self._verdicts.get(rival.cameras)
            if verdict is None or verdict.rival.carriers != rival.carriers:
                verdict = self._verdicts[rival.cameras] = _Verdict(rival, stamp, stamp, rival.jumped, rival.jumped)
            verdict.rival, verdict.seen = rival, stamp
            verdict.widest = max(verdict.widest, rival.difference, key=lambda apart: float(np.linalg.norm(apart[3:])))
            self._judge(rig, stamp, verdict)
        self._verdicts = {
            key: verdict
            for key, verdict in self._verdicts.items()
            if verdict.seen == stamp or key & left_out or verdict.remembered(stamp)
        }

    @property
    def doubted(self) -> list[RivalPose]:
        """Rivals against which the carriers are not believed."""
        return [verdict.rival for verdict in self._verdicts.values() if not verdict.trusted]

    @property
    def covariance(self) -> Array:
        """(6, 6) that covers the poses of all rivals that may be right."""
        sides = [v.widest if v.late[0] else v.rival.difference for v in self._verdicts.values() if not v.trusted]
        return np.asarray(np.reshape(sides, (-1, 6)).T @ np.reshape(sides, (-1, 6)))

    def outliers(self, bumped: Collection[int]) -> frozenset[int]:
        """Rivals without which the pose is to be: between both it is wrong. bumped: may stay unless they hang."""
        sides = [key - set(bumped) if v.open_to_both else v.still | v.late[0] for key, v in self._verdicts.items()]
        return frozenset().union(*sides) & frozenset().union(*self._verdicts)

    def own_poses(self, onwards: bool = False) -> dict[int, Array]:
        """Where each rival camera last saw the surface (4, 4). onwards: moved on as it moved from the look before."""
        last, before = (self._looks[-n][2] if self._verdicts and len(self._looks) >= n else {} for n in (1, 2))
        found: dict[int, Array] = {}
        for cameras, own in last.items():
            moved = se3.inverse(before[cameras]) @ own if onwards and cameras in before else np.eye(4)
            found.update(dict.fromkeys(cameras, own @ moved))
        return found

    def still_or_late(self, camera: int) -> str:
        """What a rival camera that is not believed does, or ''."""
        for cameras, verdict in self._verdicts.items():
            if camera in cameras and verdict.trusted:
                if camera in verdict.still:
                    return "shows no motion while the others move"
                if camera in verdict.late[0]:
                    return f"shows what the others showed {verdict.late[1]:.2f} s before"
        return ""

    def doubts(self, names: Sequence[str]) -> list[str]:
        """Why the carriers are not believed: a text for each rival. names: of all cameras."""
        newest = max((v.seen for v in self._verdicts.values() if not v.trusted), default=0.0)
        return [_doubt_text(v, names) for v in self._verdicts.values() if not v.trusted and v.seen == newest]

    def _judge(self, rig: Rig, stamp: float, verdict: _Verdict) -> None:
        """Who has moved since the carriers were last known to be right, and whether one side trails the other."""
        key, carriers = verdict.rival.cameras, verdict.rival.carriers
        looks = [look for look in self._looks if look[0] >= verdict.since and key in look[2]]
        _, a, b = _series(looks, key)
        noise, own_noise = verdict.rival.noise
        moved = max(_visible(self._pixels(rig, c, a), noise) for c in carriers)
        rival_moved, expected = (max(_visible(self._pixels(rig, c, x), own_noise) for c in key) for x in (b, a))
        lag = self._lag(rig, verdict) if moved > HANGS_RATIO else 0.0  # at a turn one side rests while the other trails
        lag = min(lag, 0.0) if verdict.jumped else lag
        hang, both = moved < 1 and rival_moved > HANGS_RATIO, min(moved, rival_moved) > 1
        rival_hangs = rival_moved < 1 and expected > HANGS_RATIO and lag <= 0
        lag = 0.0 if rival_hangs or (lag < 0 and rival_moved < HANGS_RATIO) else lag
        if hang or rival_hangs or both or lag > 0:  # else as it was
            verdict.still = carriers if hang else key if rival_hangs else frozenset()
            verdict.late = (carriers, lag) if lag > 0 else (key, -lag) if lag < 0 else (frozenset(), 0.0)
        verdict.stood |= hang
        in_step = both and stamp - verdict.since >= LAG_WINDOW_S
        in_step = in_step and (not verdict.stood or self._steady(rig, min(key), a, b))
        if hang or verdict.late[0] == carriers or len(key) > len(carriers) or not verdict.rival.united:
            verdict.trusted = False
        elif rival_hangs or in_step:
            verdict.trusted = True
            verdict.since, verdict.stood = stamp, False

    def _pixels(self, rig: Rig, camera: int, poses: Array) -> Array:  # (T, 4, 4) -> (T, K, 2) px of the anchors
        points = self.anchors @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
        return ideal_pixels(rig.cameras[camera], points.reshape(-1, 3))[0].reshape(len(poses), -1, 2)

    def _newest(self, rig: Rig, verdict: _Verdict) -> tuple[int, Array, Array, Array]:
        """Looks that count, and stamps (T,) and anchors (T, 2K) px by carriers and by rival in the rival's picture."""
        stamps, a, b = _series(self._looks, verdict.rival.cameras)
        start, camera, key = stamps[-1] - LAG_WINDOW_S, min(verdict.rival.cameras), verdict.rival.cameras
        parted = [look[0] >= start and key in look[2] for look in reversed(self._looks)]
        count = parted.index(False) if False in parted else len(parted)
        first, second = (self._pixels(rig, camera, poses).reshape(len(stamps), -1) for poses in (a, b))
        return count, stamps, first, second

    def _lag(self, rig: Rig, verdict: _Verdict) -> float:
        """By how much, s, the carriers show later what the rival shows; negative: the rival is late; 0: no lag."""
        count, stamps, a, b = self._newest(rig, verdict)
        apart = _rms(a[-count:] - b[-count:])
        lags = np.arange(LAG_STEP_S, min(MAX_LAG_S, stamps[-count] - stamps[0]) + 1e-9, LAG_STEP_S)
        if not len(lags) or apart < MIN_VISIBLE_PX:
            return 0.0
        behind = [_lagged(stamps, count, x, y, lags) for x, y in ((a, b), (b, a))]
        best = [int(np.argmin(left)) for left in behind]
        carriers, rival = behind[0][best[0]], behind[1][best[1]]
        if min(carriers, rival) > LAG_SHARE * apart:
            return 0.0
        first = carriers < min(LAG_SHARE * apart, CLEAR_LAG_RATIO * rival)  # a way to and fro fits both: it is open
        return float(lags[best[0]] if first else -lags[best[1]])

    def _steady(self, rig: Rig, camera: int, a: Array, b: Array) -> bool:
        """Whether a rival's picture by poses b (T, 4, 4) stands apart by the same while the carriers move as a."""
        way, own = (self._pixels(rig, camera, poses).reshape(len(poses), -1) for poses in (a, b))
        moved, apart = _rms(way - way.mean(0)), own - way
        return moved > MIN_VISIBLE_PX / 2 and _rms(apart - apart.mean(0)) < STEADY_SHARE * moved


def _series(
    looks: Sequence[tuple[float, Array, dict[frozenset[int], Array]]], key: frozenset[int]
) -> tuple[Array, Array, Array]:
    """Stamps (T,) and poses (T, 4, 4) by carriers and by rival; before they parted they were the same."""
    own = np.stack([look[2].get(key, look[1]) for look in looks])
    return np.array([look[0] for look in looks]), np.stack([look[1] for look in looks]), own


def _visible(pixels: Array, noise: float) -> float:  # way of anchors (T, K, 2) px, in parts of what is visible
    away = np.sqrt(((pixels - pixels[0]) ** 2).sum(2).mean(1))
    return float(away.max() / max(MIN_VISIBLE_PX, VISIBLE_SIGMAS * noise))


def _rms(away: Array) -> float:  # length, px, of flat pixels (T, 2K)
    return float(np.sqrt(2 * np.mean(away**2)))


def _lagged(stamps: Array, count: int, late: Array, early: Array, lags: Array) -> Array:
    """What is left (L,), px, of the newest `count` looks of one side against the other's so much earlier."""
    then = np.stack([np.interp(stamps[-count:] - lags[:, None], stamps, column) for column in early.T], -1)
    return np.asarray(np.sqrt(2 * ((late[-count:] - then) ** 2).mean((1, 2))))


def _doubt_text(verdict: _Verdict, names: Sequence[str]) -> str:
    carriers, key = verdict.rival.carriers, verdict.rival.cameras
    first = verdict.still or verdict.late[0] or key
    one, other = (", ".join(names[c] for c in sorted(side)) for side in (first, key if first == carriers else carriers))
    said = f"{one} against {other}"
    if verdict.still:
        said = f"no motion in {one} while {other} moved"
    elif verdict.late[0]:
        said = f"{one} late by {verdict.late[1]:.2f} s against {other}"
    return f"{said}: no majority can be trusted"
