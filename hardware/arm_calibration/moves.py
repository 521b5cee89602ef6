"""The moves that a calibration makes: to places all over the room before the cameras, turned and not, and a swing.

Each is a set-point a tick, smooth enough for the arm's own limits, and all are put before the guard before the first of
them is sent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from planning.command import Move, Refusal, feed_for
from planning.limits import MARGIN, Limits
from planning.motion.guard import Guard

PEAK = 1.875  # times its mean speed that the quickest part of a jerk-free way has (10 s^3 - 15 s^4 + 6 s^5)
BASES = (2, 3, 5, 7, 11, 13)  # of the Halton sequence: even, however many places
UPRIGHT = 3  # one place in so many is gone to without turning
SWINGS = np.array([6.0, 5.0, 4.0]), np.array([2.2, 1.7, 1.3])  # mm and Hz of X Y Z
SOFT = 0.6  # of the acceleration limit that a swing takes
STILL = 1e-6  # mm^2 and rad^2, of a surface that nobody follows


@dataclass(frozen=True, slots=True)
class MoveWishes:
    """places: to rest at. reach: mm about the start along X and Y; up: mm above it; down: mm below. turn: rad of A, B
    and C at most. speed: mm/s at most, on the way. dwell: s at each place. swing: s at the end.
    """

    places: int = 20
    reach: float = 50.0
    up: float = 45.0
    down: float = 20.0
    turn: float = float(np.deg2rad(35.0))  # as far as a needle is still seen: less, and tool and arm look alike
    speed: float = 80.0
    dwell: float = 0.6
    swing: float = 8.0

    def __post_init__(self) -> None:
        most = {"places": 200, "reach": 300, "up": 300, "down": 300, "turn": np.pi / 3, "speed": 120, "swing": 60}
        for name, high in {**most, "dwell": 10.0}.items():
            value = getattr(self, name)
            low = 4 if name == "places" else 0.3 if name == "dwell" else 0.0
            if not (low <= value <= high):
                raise InputError("moves", name, value, f"{low:g} to {high:g}")


def planned(start: Array, limits: Limits, tick: float, wishes: MoveWishes) -> Array:
    """Set-points (K, 6), mm and rad, a tick apart, from and back to `start` (6,); those of a dwell repeat."""
    parts, at = [], start
    for place in places(start, limits, wishes):
        parts += list(_way(at, place, tick, wishes))
        parts.append(np.repeat(place[None], round(wishes.dwell / tick), axis=0))
        at = place
    parts += list(_way(at, start, tick, wishes))
    parts.append(np.repeat(start[None], round(wishes.dwell / tick), axis=0))
    parts.append(_swing(start, limits, tick, wishes))
    parts.append(np.repeat(start[None], round(wishes.dwell / tick), axis=0))
    return np.concatenate(parts)


def places(start: Array, limits: Limits, wishes: MoveWishes) -> Array:
    """Places (P, 6), mm and rad, spread evenly about the start, within the arm's bounds."""
    spread = np.array([[_halton(i + 1, base) for base in BASES] for i in range(wishes.places)])
    half = np.array([wishes.reach, wishes.reach, (wishes.up + wishes.down) / 2, *[wishes.turn] * 3])
    middle = start + np.array([0, 0, (wishes.up - wishes.down) / 2, 0, 0, 0])
    out = middle + (2 * spread - 1) * half
    out[::UPRIGHT, 3:] = start[3:]
    return np.asarray(np.clip(out, limits.low + MARGIN, limits.high - MARGIN))


def _halton(index: int, base: int) -> float:
    out, share = 0.0, 1.0
    while index:
        share /= base
        index, digit = divmod(index, base)
        out += share * digit
    return out


def _way(start: Array, goal: Array, tick: float, wishes: MoveWishes) -> Iterator[Array]:
    """Straight from one place to another, both left and reached without a jerk."""
    way = goal - start
    length = max(float(np.linalg.norm(way[:3])), 60.0 * float(np.linalg.norm(way[3:])))  # 1 rad/s at 60 mm/s
    if length > 0:
        count = max(5, int(np.ceil(PEAK * length / (wishes.speed * tick))))
        s = np.linspace(0, 1, count + 1)[1:, None]
        yield start + (10 * s**3 - 15 * s**4 + 6 * s**5) * way


def _swing(middle: Array, limits: Limits, tick: float, wishes: MoveWishes) -> Array:
    """Three sines at once, let in and out softly: what tells dead time from lag is acceleration."""
    t = np.arange(1, round(wishes.swing / tick) + 1)[:, None] * tick
    size, rate = SWINGS
    fast = 2 * np.pi * rate
    size = np.minimum(size, np.minimum(SOFT * limits.acceleration[:3] / fast**2, SOFT * limits.speed[:3] / fast))
    out = np.repeat(middle[None], len(t), axis=0)
    out[:, :3] += np.sin(np.pi * t / max(wishes.swing, tick)) ** 2 * size * np.sin(fast * t)
    return out


def still(now: float) -> SurfacePose:
    """A surface that stands still at the base's origin: a calibration follows none, and the guard asks for one."""
    return SurfacePose(now, np.eye(4), STILL * np.eye(6), np.zeros(6), TrackState.TRACKING)


def watchful(profile: ArmProfile, at: Array) -> Guard:
    """A guard for an arm that stands at `at` (6,)."""
    return Guard(profile.limits, replace(profile.arm, home=at), profile.tick, lag=profile.lag)


def check_moves(profile: ArmProfile, start: Array, targets: Array) -> None:
    """InputError with the guard's words unless it lets all set-points (K, 6) pass, a tick apart."""
    guard, at = watchful(profile, start), start
    for number, target in enumerate(targets):
        if (target == at).all():
            continue
        now = (number + 1) * profile.tick
        answer = guard(Move(now, target, feed_for(at, target, profile.tick), 0, False), still(now), now)
        if isinstance(answer, Refusal):
            allowed = "moves that the arm's limits and no-go zones allow: less --reach-mm, --turn-deg or --speed-mm-s"
            raise InputError("moves", f"{number * profile.tick:.1f} s after their begin", answer.reason, allowed)
        at = target
