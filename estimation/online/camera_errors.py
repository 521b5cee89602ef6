"""Errors of whole cameras, learned online: when each really exposes, and by how much its image is shifted.

Webcams run free. Each has an offset from its stamps that hardly changes (10 to 60 ms were seen), and a jitter from
frame to frame. Both show where the surface moves: a late camera sees it displaced along its motion. Lens, extrinsics
and grazing views shift all of a camera's tracks alike, moving or not; a part of the shift stays, a part varies.

One Kalman filter holds what stays, offsets and shifts together, so that a shifted lens is not taken for a late clock.
What varies is learned as two variances. A delay common to all cameras cannot be seen: the reference is their mean.
Only the offsets are corrected. The map is made through the same lenses, so a shift that stays is in the map too, and
correcting it would carry the pose away from the map (measured: 0.04 mm on a surface at rest that had no shift at all).

Pictures that hang, or suddenly come late, show an earlier place of the surface, and two cameras that hang agree. So the
cameras that carry the pose (carriers) are trusted against others (rivals) only once they have moved, and not along the
way that the rivals went before (`RivalWatch`): pictures are late, never early.
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
    """The variance of a quantity that is observed through noise of known size, by Fisher scoring.

    A value d with noise variance e is a draw from sigma^2 + e, so sigma^2 is the mean of d^2 - e under the weights
    (sigma^2 + e)^-2. Expectation maximisation needed ten times the frames where single values are uncertain. Values
    without information do not count, and forget nothing.
    """

    PRIOR_VALUES, RECENT = 3.0, 100  # values that the prior counts as; informative values over which it is forgotten

    def __init__(self, initial: float, smallest: float, best: float) -> None:
        """All one sigma. initial: the prior. smallest: lower bound. best: no value is measured better."""
        self._unit, self._smallest, self._best = initial**2, smallest**2, best**2
        self._weight = self.PRIOR_VALUES  # one exact value, against a variance of `initial`^2, has a weight of 1
        self._sum = self.PRIOR_VALUES * self._unit  # weighted, of d^2 - e

    @property
    def value(self) -> float:
        """The variance: its mean, and half of the mean's own standard error."""
        return float(max(self._sum / self._weight, self._smallest) + 0.5 * (2 / self._weight) ** 0.5 * self._unit)

    def take(self, value: float, variance: float) -> None:
        """One value, known to a variance."""
        current = self.value
        share = (self._unit / (current + variance)) ** 2
        limit = 2 * (self._unit / self._best) ** 2
        keep = min(1 - (current / (current + variance)) ** 2 / self.RECENT, limit / (self._weight + share))
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
        self._centering = np.eye(3 * n)  # takes out what all clocks have in common
        self._centering[:n, :n] -= 1 / n
        self._mean = np.zeros(3 * n)  # delays s, shifts right px, shifts down px
        start = np.diag(np.repeat([self.INITIAL_OFFSET_S**2, self.INITIAL_SHIFT_PX**2, self.INITIAL_SHIFT_PX**2], n))
        self._covariance = self._centering @ start @ self._centering
        # (C,) s, how much later than stamped each camera exposes; zero until offsets are clear: many cameras are
        # triggered together, and a correction by chance would only move the pose about
        self.offset = np.zeros(n)
        self._jitter = VarianceEstimate(0.005, 3e-4, 1e-3)  # s: USB cameras; no stamp is better
        self._shift_variance = VarianceEstimate(0.05, 0.005, 0.01)  # px, of a camera's shift from frame to frame
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
    def shift_variance(self) -> float:
        """Variance, px^2 per axis, of an image's shift from frame to frame."""
        return self._shift_variance.value

    def delay_moments(self, corrected: Array) -> Array:
        """Second moments (C, C), s^2, of the delays that are left after a correction by offsets (C,), s."""
        residual = self._mean[: self._count] - corrected
        return np.asarray(self.delays.covariance + np.outer(residual, residual))

    def shared_errors(self, twist: Array) -> SharedErrors:
        """Shared errors that the next fit has to expect beyond `offset`, at a velocity (6,)."""
        return SharedErrors(twist, self.delays.covariance, np.full(self._count, self.shift_variance))

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
        self._covariance = self._covariance + self._centering * drift
        self._learn_variances(fit)
        # Kalman update in information form, marginalised over this frame set's jitter and shifts
        new = np.repeat([self._jitter.value, self._shift_variance.value], [n, 2 * n])
        marginal = np.linalg.inv(eye + new[:, None] * fit.information)
        information = fit.information @ marginal / self.INFORMATION_DIVISOR
        gain = self._covariance @ np.linalg.inv(eye + information @ self._covariance)
        self._mean = self._centering @ (self._mean + gain @ (marginal.T @ fit.pull) / self.INFORMATION_DIVISOR)
        self._covariance = self._centering @ ((gain + gain.T) / 2) @ self._centering
        # the offsets as far as chance does not explain them
        mean, offset_information = self._mean[:n], np.linalg.pinv(self._covariance[:n, :n], hermitian=True)
        chi2 = float(mean @ offset_information @ mean) / max(1, n - 1)
        self.offset = mean * min(1.0, max(0.0, (chi2 - self.CHANCE_CHI2) / (self.CERTAIN_CHI2 - self.CHANCE_CHI2)))
        self.delays = self._expected_delays()

    def _learn_variances(self, fit: SharedFit) -> None:
        n = self._count
        delays, shifts = np.arange(n), np.arange(n, 3 * n)
        new = np.repeat([self._jitter.value, self._shift_variance.value], [n, 2 * n])
        for part, rest, variance, limit in (
            (delays, shifts, self._jitter, self.MAX_DELAY),
            (shifts, delays, self._shift_variance, np.inf),
        ):
            for value, noise in zip(*self._independent(fit, part, rest, new), strict=True):
                if noise < min(limit**2, 1e3 * variance.value):
                    variance.take(float(value), float(noise))

    def _independent(self, fit: SharedFit, part: Index, rest: Index, new: Array) -> tuple[Array, Array]:
        """Independent combinations (K,) of one part of the errors in this frame set, and their variances (K,)."""
        # the rest of the errors is marginalised
        prior = self._covariance[np.ix_(rest, rest)] + np.diag(new[rest])
        cross = fit.information[np.ix_(part, rest)]
        gain = cross @ prior @ np.linalg.inv(np.eye(len(rest)) + fit.information[np.ix_(rest, rest)] @ prior)
        information = fit.information[np.ix_(part, part)] - gain @ cross.T
        pull = fit.pull[part] - gain @ fit.pull[rest]
        # along the eigenvectors that are determined
        eigenvalues, eigenvectors = np.linalg.eigh((information + information.T) / 2)
        determined = eigenvalues > 1e-9 * eigenvalues[-1]
        eigenvalues, eigenvectors = eigenvalues[determined], eigenvectors[:, determined]
        prior_variance = np.einsum("ik,ij,jk->k", eigenvectors, self._covariance[np.ix_(part, part)], eigenvectors)
        return (eigenvectors.T @ pull) / eigenvalues, 1 / eigenvalues + prior_variance


class CameraErrorHistory:
    """Camera errors of some seconds ago: a deformation that begins is first mistaken for late cameras."""

    INTERVAL_S = 2.0  # a deformation is detected within one

    def __init__(self, cameras: CameraErrors) -> None:
        self._earlier, self._last, self._stamp = copy.deepcopy(cameras), copy.deepcopy(cameras), -np.inf

    def keep(self, stamp: float, cameras: CameraErrors) -> None:
        """Store the errors at `stamp`, s, every INTERVAL_S."""
        if stamp - self._stamp >= self.INTERVAL_S:
            self._earlier, self._last, self._stamp = self._last, copy.deepcopy(cameras), stamp

    @property
    def before(self) -> CameraErrors:
        """As known INTERVAL_S ago or earlier."""
        return copy.deepcopy(self._earlier)


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
    """The carriers compared with one rival."""

    rival: RivalPose  # the newest
    since: float  # s, when the carriers were last known to be right, or the rival first appeared
    last_stamp: float  # s, of `rival`
    trusted: bool = False  # whether the carriers are
    off_motion: bool = False  # whether the rival left the motion that the carriers continued: then they are not late
    rested: bool = False  # whether they have stood still while the rival moved
    widest: Array = field(default_factory=lambda: np.zeros(6))  # largest difference: a late side agrees at a turn
    hanging: frozenset[int] = frozenset()  # cameras that show no motion while the others move
    lagging: tuple[frozenset[int], float] = (frozenset(), 0.0)  # cameras that show what the others showed, and s before

    @property
    def undecided(self) -> bool:  # either side may be right, and the rival does not outnumber the carriers
        return not self.trusted and len(self.rival.cameras) <= len(self.rival.carriers)

    def remembered(self, stamp: float) -> bool:  # at `stamp`, s, without the rival
        return stamp - self.last_stamp <= (TRUST_MEMORY_S if self.trusted or self.lagging[0] else RIVAL_HOLD_S)


@dataclass(slots=True)
class RivalWatch:
    """Recent poses by carriers and by rivals, and which carriers can be trusted."""

    anchors: Array  # (K, 3) mm, surface frame: where motion is looked for
    _history: deque[tuple[float, Array, dict[frozenset[int], Array]]] = field(default_factory=deque)  # s, carried, own
    _verdicts: dict[frozenset[int], _Verdict] = field(default_factory=dict)

    def update(
        self, rig: Rig, stamp: float, base_from_surface: Array, rivals: Sequence[RivalPose], left_out: frozenset[int]
    ) -> None:
        """Take a frame set: pose (4, 4), poses that contradict it, and outliers, which stay rivals without a pose."""
        base_from_surface = rivals[0].carrier_pose if rivals else base_from_surface
        self._history.append((stamp, base_from_surface, {rival.cameras: rival.own_pose for rival in rivals}))
        while self._history[0][0] < stamp - RIVAL_MEMORY_S:
            self._history.popleft()
        for rival in rivals:
            verdict = self._verdicts.get(rival.cameras)
            if verdict is None or verdict.rival.carriers != rival.carriers:
                off = rival.off_motion
                verdict = self._verdicts[rival.cameras] = _Verdict(rival, stamp, stamp, off, off)
            verdict.rival, verdict.last_stamp = rival, stamp
            verdict.widest = max(verdict.widest, rival.difference, key=lambda apart: float(np.linalg.norm(apart[3:])))
            self._judge(rig, stamp, verdict)
        self._verdicts = {
            key: verdict
            for key, verdict in self._verdicts.items()
            if verdict.last_stamp == stamp or key & left_out or verdict.remembered(stamp)
        }

    @property
    def untrusted(self) -> list[RivalPose]:
        """Rivals against which the carriers are not trusted."""
        return [verdict.rival for verdict in self._verdicts.values() if not verdict.trusted]

    @property
    def covariance(self) -> Array:
        """(6, 6) that covers the poses of all rivals that may be right."""
        sides = [v.widest if v.lagging[0] else v.rival.difference for v in self._verdicts.values() if not v.trusted]
        return np.asarray(np.reshape(sides, (-1, 6)).T @ np.reshape(sides, (-1, 6)))

    def outliers(self, bumped: Collection[int]) -> frozenset[int]:
        """Rivals to be left out: a pose between both sides is wrong. bumped: may stay unless they hang."""
        sides = [key - set(bumped) if v.undecided else v.hanging | v.lagging[0] for key, v in self._verdicts.items()]
        return frozenset().union(*sides) & frozenset().union(*self._verdicts)

    def own_poses(self, onwards: bool = False) -> dict[int, Array]:
        """base_from_surface (4, 4) by each rival camera, the newest. onwards: extrapolated by its last motion."""
        last, before = (self._history[-n][2] if self._verdicts and len(self._history) >= n else {} for n in (1, 2))
        poses: dict[int, Array] = {}
        for cameras, own in last.items():
            moved = se3.inverse(before[cameras]) @ own if onwards and cameras in before else np.eye(4)
            poses.update(dict.fromkeys(cameras, own @ moved))
        return poses

    def fault_text(self, camera: int) -> str:
        """For the operator: whether a rival camera that is not trusted hangs or is late, or ''."""
        for cameras, verdict in self._verdicts.items():
            if camera in cameras and verdict.trusted:
                if camera in verdict.hanging:
                    return "shows no motion while the others move"
                if camera in verdict.lagging[0]:
                    return f"shows what the others showed {verdict.lagging[1]:.2f} s before"
        return ""

    def messages(self, names: Sequence[str]) -> list[str]:
        """Why the carriers are not trusted: a text for each rival. names: of all cameras."""
        newest = max((v.last_stamp for v in self._verdicts.values() if not v.trusted), default=0.0)
        return [_doubt_text(v, names) for v in self._verdicts.values() if not v.trusted and v.last_stamp == newest]

    def _judge(self, rig: Rig, stamp: float, verdict: _Verdict) -> None:
        """Which side has moved since the carriers were last known to be right, and whether one side lags the other."""
        key, carriers = verdict.rival.cameras, verdict.rival.carriers
        _, by_carriers, by_rival = _series([h for h in self._history if h[0] >= verdict.since and key in h[2]], key)
        (noise, own_noise), ways = verdict.rival.noise, (by_rival, by_carriers)
        carriers_px = max(_visible(self._pixels(rig, c, by_carriers), noise) for c in carriers)
        rivals_px, expected = (max(_visible(self._pixels(rig, c, way), own_noise) for c in key) for way in ways)
        lag = self._lag(rig, verdict) if carriers_px > HANGS_RATIO else 0.0  # at a turn one rests, the other trails
        lag = min(lag, 0.0) if verdict.off_motion else lag
        hang, both = carriers_px < 1 and rivals_px > HANGS_RATIO, min(carriers_px, rivals_px) > 1
        rival_hangs = rivals_px < 1 and expected > HANGS_RATIO and lag <= 0
        lag = 0.0 if rival_hangs or (lag < 0 and rivals_px < HANGS_RATIO) else lag
        if hang or rival_hangs or both or lag > 0:  # else as it was
            verdict.hanging = carriers if hang else key if rival_hangs else frozenset()
            verdict.lagging = (carriers, lag) if lag > 0 else (key, -lag) if lag < 0 else (frozenset(), 0.0)
        verdict.rested |= hang
        in_step = both and stamp - verdict.since >= LAG_WINDOW_S
        in_step = in_step and (not verdict.rested or self._steady(rig, min(key), by_carriers, by_rival))
        if hang or verdict.lagging[0] == carriers or len(key) > len(carriers) or not verdict.rival.carriers_agree:
            verdict.trusted = False
        elif rival_hangs or in_step:
            verdict.trusted = True
            verdict.since, verdict.rested = stamp, False

    def _pixels(self, rig: Rig, camera: int, poses: Array) -> Array:  # (T, 4, 4) -> (T, K, 2) px of the anchors
        points = self.anchors @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
        return ideal_pixels(rig.cameras[camera], points.reshape(-1, 3))[0].reshape(len(poses), -1, 2)

    def _newest(self, rig: Rig, verdict: _Verdict) -> tuple[int, Array, Array, Array]:
        """Count of newest entries, and stamps (T,) and anchors (T, 2K) px by carriers and by rival in its picture."""
        stamps, a, b = _series(self._history, verdict.rival.cameras)
        start, camera, key = stamps[-1] - LAG_WINDOW_S, min(verdict.rival.cameras), verdict.rival.cameras
        apart = [look[0] >= start and key in look[2] for look in reversed(self._history)]
        count = apart.index(False) if False in apart else len(apart)
        first, second = (self._pixels(rig, camera, poses).reshape(len(stamps), -1) for poses in (a, b))
        return count, stamps, first, second

    def _lag(self, rig: Rig, verdict: _Verdict) -> float:
        """Lag, s, of the carriers behind the rival; negative: the rival is late; 0: neither."""
        count, stamps, a, b = self._newest(rig, verdict)
        distance = _rms(a[-count:] - b[-count:])
        lags = np.arange(LAG_STEP_S, min(MAX_LAG_S, stamps[-count] - stamps[0]) + 1e-9, LAG_STEP_S)
        if not len(lags) or distance < MIN_VISIBLE_PX:
            return 0.0
        lagged = [_lagged(stamps, count, x, y, lags) for x, y in ((a, b), (b, a))]
        best = [int(np.argmin(residuals)) for residuals in lagged]
        carriers, rival = lagged[0][best[0]], lagged[1][best[1]]
        if min(carriers, rival) > LAG_SHARE * distance:
            return 0.0
        first = carriers < min(LAG_SHARE * distance, CLEAR_LAG_RATIO * rival)  # a way to and fro fits both: it is open
        return float(lags[best[0]] if first else -lags[best[1]])

    def _steady(self, rig: Rig, camera: int, a: Array, b: Array) -> bool:
        """Whether a rival's picture by poses b (T, 4, 4) keeps its distance from that by the moving carriers' a."""
        carrier_px, rival_px = (self._pixels(rig, camera, poses).reshape(len(poses), -1) for poses in (a, b))
        moved, apart = _rms(carrier_px - carrier_px.mean(0)), rival_px - carrier_px
        return moved > MIN_VISIBLE_PX / 2 and _rms(apart - apart.mean(0)) < STEADY_SHARE * moved


def _series(
    history: Sequence[tuple[float, Array, dict[frozenset[int], Array]]], key: frozenset[int]
) -> tuple[Array, Array, Array]:
    """Stamps (T,) and poses (T, 4, 4) by carriers and by rival; the same before they differed."""
    own = np.stack([entry[2].get(key, entry[1]) for entry in history])
    return np.array([entry[0] for entry in history]), np.stack([entry[1] for entry in history]), own


def _visible(pixels: Array, noise: float) -> float:  # way of anchors (T, K, 2) px, in parts of what is visible
    distance = np.sqrt(((pixels - pixels[0]) ** 2).sum(2).mean(1))
    return float(distance.max() / max(MIN_VISIBLE_PX, VISIBLE_SIGMAS * noise))


def _rms(difference: Array) -> float:  # length, px, of flat pixels (T, 2K)
    return float(np.sqrt(2 * np.mean(difference**2)))


def _lagged(stamps: Array, count: int, late: Array, early: Array, lags: Array) -> Array:
    """RMS difference (L,), px, of one side's newest `count` entries from the other's, for each lag (L,) s."""
    earlier = np.stack([np.interp(stamps[-count:] - lags[:, None], stamps, column) for column in early.T], -1)
    return np.asarray(np.sqrt(2 * ((late[-count:] - earlier) ** 2).mean((1, 2))))


def _doubt_text(verdict: _Verdict, names: Sequence[str]) -> str:
    carriers, key = verdict.rival.carriers, verdict.rival.cameras
    first = verdict.hanging or verdict.lagging[0] or key
    one, other = (", ".join(names[c] for c in sorted(side)) for side in (first, key if first == carriers else carriers))
    text = f"{one} against {other}"
    if verdict.hanging:
        text = f"no motion in {one} while {other} moved"
    elif verdict.lagging[0]:
        text = f"{one} late by {verdict.lagging[1]:.2f} s against {other}"
    return f"{text}: no majority can be trusted"
