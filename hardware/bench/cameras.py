"""Live cameras: frames that jitter, skip and carry offsets, put into sets as they arrive; what a frame costs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from estimation.se3 import Array
from hardware.bench.figures import Figure, at_most
from hardware.cameras.feed import Arrival
from hardware.cameras.frame_sets import Gathering
from hardware.cameras.stamping import Stamping
from hardware.cameras.watch import FrameWatch
from hardware.process.clock import CpuClock
from perception.frames import Frame, FrameSet, Image

PERIOD = 1 / 30  # s
OFFSETS = np.array([0.0, 0.016, -0.016])  # s
LEARNED = 0.0005  # s, sigma of an offset as the estimator learns it
TRANSPORT, WAY = 0.025, 0.002  # s, on the way to arrival; mean of what comes on top
LONGEST = 1.5 * PERIOD  # s that a set may be waited for
IMAGE = np.zeros((1, 1), np.uint8)


@dataclass(frozen=True, slots=True)
class Shown:
    """A frame on its way. instant: number of the exposure it belongs to. stamp, arrival: s."""

    camera: int
    instant: int
    stamp: float
    arrival: float


@dataclass(frozen=True, slots=True)
class Shaking:
    """How cameras that expose together are seen. jitter: s, of stamps, the most or one sigma. drop: share lost."""

    jitter: float = 0.005
    normal: bool = False
    drop: float = 0.02


def shown(rng: np.random.Generator, count: int, shaking: Shaking, offsets: Array = OFFSETS) -> list[Shown]:
    """The frames of `count` instants in order of arrival; true instant = stamp + offset, a camera's stamps rise."""
    out: list[Shown] = []
    for camera, offset in enumerate(offsets):
        exposed = np.arange(count) * PERIOD
        noise = rng.standard_normal(count) if shaking.normal else rng.uniform(-1, 1, count)
        stamps = np.maximum.accumulate(exposed - offset + shaking.jitter * noise + 1e-9 * np.arange(count))
        arrivals = np.maximum.accumulate(exposed + TRANSPORT + rng.exponential(WAY, count) + 1e-9 * np.arange(count))
        kept = np.flatnonzero(rng.random(count) >= shaking.drop)
        out += [Shown(camera, int(k), float(stamps[k]), float(arrivals[k])) for k in kept]
    return sorted(out, key=lambda one: one.arrival)


@dataclass(frozen=True, slots=True)
class Paired:
    """complete: share of the instants that all cameras delivered, found as one set. wrong: sets of two instants.

    sets: given out. wait: s, the longest from the arrival of a set's first frame until it was given out.
    """

    complete: float
    wrong: int
    sets: int
    wait: float


def paired(frames: Sequence[Shown], offsets: Array, period: float | None = PERIOD) -> Paired:
    """Put frames into sets with these offsets (C,), s, looking every 5 ms as live cameras do."""
    cameras = len(offsets)
    gathering, stampings = Gathering(cameras, PERIOD, offsets), [Stamping(period) for _ in range(cameras)]
    instant_of: dict[tuple[int, float], Shown] = {}
    sets: list[tuple[float, FrameSet]] = []
    for one, following in pairwise([*frames, None]):
        assert one is not None
        stamped = stampings[one.camera](one.arrival, one.stamp, True)
        frame = Frame(one.camera, stamped.stamp, IMAGE, stamped.by)
        instant_of[one.camera, stamped.stamp] = one
        arrival = Arrival(frame, stamped.steady, stampings[one.camera].rhythm.period, one.arrival)
        sets += [(one.arrival, s) for s in gathering.add(arrival)]
        until = one.arrival + 1.0 if following is None else following.arrival
        for look in np.arange(one.arrival + 0.005, until, 0.005):
            sets += [(float(look), s) for s in gathering.due(float(look))]
    return _judged(frames, [(now, [instant_of[f.camera, f.stamp] for f in s.frames]) for now, s in sets], cameras)


def _judged(frames: Sequence[Shown], sets: Sequence[tuple[float, list[Shown]]], cameras: int) -> Paired:
    delivered = np.bincount([one.instant for one in frames])
    instants = [{one.instant for one in members} for _, members in sets]
    whole = sum(len(i) == 1 and len(m) == cameras for i, (_, m) in zip(instants, sets, strict=True))
    return Paired(
        complete=whole / int((delivered == cameras).sum()),
        wrong=sum(len(i) > 1 for i in instants),
        sets=len(sets),
        wait=max(now - min(one.arrival for one in members) for now, members in sets),
    )


def run(options: argparse.Namespace) -> list[Figure]:
    """Pairing under the target's jitter, with the rate told and not, and under a normal one; what a frame costs."""
    rng = np.random.default_rng(options.seed)
    count = round(60 * options.minutes / PERIOD)
    learned = OFFSETS + LEARNED * rng.standard_normal(len(OFFSETS))
    at_target = paired(shown(rng, count, Shaking()), learned)
    normal = paired(shown(rng, count, Shaking(normal=True)), learned)
    untold = paired(shown(rng, count, Shaking()), learned, None)
    return [
        *_figures("jitter +-5 ms", at_target),
        *_figures("jitter +-5 ms, rate not told", untold),
        *_figures("jitter 5 ms sigma", normal),
        *_cost(rng),
    ]


def _figures(how: str, found: Paired) -> list[Figure]:
    name = f"offsets +-16 ms, 2 % drops, {how}"
    return [
        Figure(f"{name}: complete sets not found", 100 * (1 - found.complete), "%", at_most(0.5)),
        Figure(f"{name}: wrong pairs", found.wrong, "", at_most(0), note=f"of {found.sets} sets"),
        Figure(f"{name}: longest wait", 1e3 * found.wait, "ms", at_most(1e3 * LONGEST), note="after its first frame"),
    ]


def _cost(rng: np.random.Generator) -> list[Figure]:
    images: list[Image] = [rng.integers(0, 255, (720, 1280, 3), np.uint8) for _ in range(2)]
    clock, watch, stamping, frames = CpuClock(), FrameWatch((1280, 720)), Stamping(PERIOD), 200
    start = clock.now()
    for k in range(frames):
        stamping(k * PERIOD, k * PERIOD, True)
        watch.fault(images[k % 2])
    each = 1e3 * (clock.now() - start) / frames
    return [Figure("a 1280x720 frame watched and stamped", each, "ms", at_most(1.0), note="CPU, without its decoding")]
