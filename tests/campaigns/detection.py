"""Subjects `cameras`, `bumps` and `steps`: frames paired, cameras that are knocked, a surface that moves by little.

`cameras`: frames that jitter, skip and carry offsets, put into sets as they arrive; what a frame costs.
`bumps`: cameras bumped and lenses turned by little before a breathing surface, and neither. Tracks are drawn, not
rendered: an hour of them passes in minutes. What bumps do in pictures, `python -m tests.campaigns outages` shows.
`steps`: how soon a movement of 300 um or 0.1 degree is flagged, and how often one that never was. Noise is that of fits
to synthetic tracks at rest, which is linear in them: a white part, and one that lasts. Poses are drawn with it, so that
an hour costs half a minute; the detector is the tracker's own.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.online.estimator import Estimator
from estimation.online.surface_state import MotionDetector
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.follow import pose_information
from estimation.synthetic.movements import irregular
from estimation.synthetic.world import BASE_FROM_REST, arc_rig, observations, patch, synthetic_world
from hardware.bench.figures import Figure, at_least, at_most, columns, with_progress
from hardware.cameras.feed import Arrival, FrameWatch
from hardware.cameras.live import FrameSetBuilder
from hardware.cameras.stamping import FrameStamper
from hardware.process.clock import CpuClock
from perception.frames import Frame, FrameSet, Image

FRAME_PERIOD = 1 / 30  # s
CAMERA_OFFSETS = np.array([0.0, 0.016, -0.016])  # s
OFFSET_SIGMA = 0.0005  # s, sigma of an offset as the estimator learns it
TRANSPORT_S, MEAN_DELAY = 0.025, 0.002  # s from exposure to arrival: always, and the mean of what is added at random
MAX_SET_WAIT = 1.5 * FRAME_PERIOD  # s that a set may be waited for
IMAGE = np.zeros((1, 1), np.uint8)


@dataclass(frozen=True, slots=True)
class SentFrame:
    """A frame on its way."""

    camera: int
    instant: int  # number of the exposure it belongs to
    stamp: float  # s
    arrival: float  # s


@dataclass(frozen=True, slots=True)
class CameraJitter:
    """How cameras that expose together are seen."""

    jitter: float = 0.005  # s, of stamps: the largest, or one sigma
    normal: bool = False
    drop: float = 0.02  # share lost


def sent_frames(
    rng: np.random.Generator, count: int, shaking: CameraJitter, offsets: Array = CAMERA_OFFSETS
) -> list[SentFrame]:
    """The frames of `count` instants in order of arrival; true instant = stamp + offset, a camera's stamps rise."""
    frames: list[SentFrame] = []
    exposed, rising = np.arange(count) * FRAME_PERIOD, 1e-9 * np.arange(count)
    for camera, offset in enumerate(offsets):
        noise = rng.standard_normal(count) if shaking.normal else rng.uniform(-1, 1, count)
        stamps = np.maximum.accumulate(exposed - offset + shaking.jitter * noise + rising)
        arrivals = np.maximum.accumulate(exposed + TRANSPORT_S + rng.exponential(MEAN_DELAY, count) + rising)
        delivered = np.flatnonzero(rng.random(count) >= shaking.drop)
        frames += [SentFrame(camera, int(k), float(stamps[k]), float(arrivals[k])) for k in delivered]
    return sorted(frames, key=lambda frame: frame.arrival)


@dataclass(frozen=True, slots=True)
class FramePairing:
    """How frames were put into sets."""

    complete: float  # share of the instants delivered by all cameras that came out as one set
    wrong: int  # sets that mix two instants
    sets: int  # in all
    wait: float  # s, the longest from the arrival of a set's first frame until the set was complete or overdue


def pair_frames(frames: Sequence[SentFrame], offsets: Array, period: float | None = FRAME_PERIOD) -> FramePairing:
    """Put frames into sets with these offsets (C,), s, looking every 5 ms as live cameras do."""
    cameras = len(offsets)
    builder, stampers = FrameSetBuilder(cameras, FRAME_PERIOD, offsets), [FrameStamper(period) for _ in range(cameras)]
    sent_of: dict[tuple[int, float], SentFrame] = {}
    sets: list[tuple[float, FrameSet]] = []
    for sent, following in pairwise([*frames, None]):
        assert sent is not None
        stamped = stampers[sent.camera](sent.arrival, sent.stamp, True)
        frame = Frame(sent.camera, stamped.stamp, IMAGE, stamped.by)
        sent_of[sent.camera, stamped.stamp] = sent
        arrival = Arrival(frame, stamped.steady, stampers[sent.camera].pll.period, sent.arrival)
        sets += [(sent.arrival, s) for s in builder.add(arrival)]
        until = sent.arrival + 1.0 if following is None else following.arrival
        for now in np.arange(sent.arrival + 0.005, until, 0.005):
            sets += [(float(now), s) for s in builder.due(float(now))]
    members = [[sent_of[f.camera, f.stamp] for f in s.frames] for _, s in sets]
    instants = [{sent.instant for sent in of_set} for of_set in members]
    delivered = np.bincount([sent.instant for sent in frames])
    whole = sum(len(i) == 1 and len(m) == cameras for i, m in zip(instants, members, strict=True))
    waits = [now - min(sent.arrival for sent in of_set) for (now, _), of_set in zip(sets, members, strict=True)]
    wrong = sum(len(i) > 1 for i in instants)
    return FramePairing(whole / int((delivered == cameras).sum()), wrong, len(sets), max(waits))


def run_cameras(options: argparse.Namespace) -> list[Figure]:
    """Pairing under the target's jitter, with a known and an unknown frame rate, and under a normal one; CPU time."""
    rng = np.random.default_rng(options.seed)
    count = round(60 * options.minutes / FRAME_PERIOD)
    learned = CAMERA_OFFSETS + OFFSET_SIGMA * rng.standard_normal(len(CAMERA_OFFSETS))
    at_target = pair_frames(sent_frames(rng, count, CameraJitter()), learned)
    normal = pair_frames(sent_frames(rng, count, CameraJitter(normal=True)), learned)
    no_rate = pair_frames(sent_frames(rng, count, CameraJitter()), learned, None)
    figures, longest = list[Figure](), at_most(1e3 * MAX_SET_WAIT)
    for how, pairing in (("+-5 ms", at_target), ("+-5 ms, rate not told", no_rate), ("5 ms sigma", normal)):
        name = f"offsets +-16 ms, 2 % drops, jitter {how}"
        figures += [
            Figure(f"{name}: complete sets not found", 100 * (1 - pairing.complete), "%", at_most(0.5)),
            Figure(f"{name}: wrong pairs", pairing.wrong, "", at_most(0), note=f"of {pairing.sets} sets"),
            Figure(f"{name}: longest wait", 1e3 * pairing.wait, "ms", longest, note="after its first frame"),
        ]
    images: list[Image] = [rng.integers(0, 255, (720, 1280, 3), np.uint8) for _ in range(2)]
    clock, watch, stamper, frames = CpuClock(), FrameWatch((1280, 720)), FrameStamper(FRAME_PERIOD), 200
    start = clock.now()
    for k in range(frames):
        stamper(k * FRAME_PERIOD, k * FRAME_PERIOD, True)
        watch.fault(images[k % 2])
    each = 1e3 * (clock.now() - start) / frames
    what = "a 1280x720 frame watched and stamped"
    return [*figures, Figure(what, each, "ms", at_most(1.0), note="CPU, without its decoding")]


BUMP_RATE = 30.0  # Hz
CALM_BEFORE, WATCHED_AFTER = 6.0, 4.0  # s before a bump, and after it
TRACK_NOISE_PX = 0.3
LANDMARKS = 60
NO_REFERENCE = "none"


@dataclass(frozen=True, slots=True)
class Knock:
    """One kind of knock, in a direction drawn across the view."""

    name: str
    shift: float = 0.0  # mm
    turn: float = 0.0  # degrees
    scale: float = 1.0  # of the focal length
    detectable: bool = True  # whether it must be flagged and named

    def knocked(self, rig: Rig, camera: int, rng: np.random.Generator) -> Rig:
        """The rig with one camera knocked."""
        own, angle = rig.cameras[camera], rng.uniform(0, 2 * np.pi)
        across = np.array([np.cos(angle), np.sin(angle), 0.0])
        moved = own.base_from_camera @ se3.exp(np.concatenate([across * np.deg2rad(self.turn), across * self.shift]))
        matrix = own.matrix * np.array([[self.scale, 1, 1], [1, self.scale, 1], [1, 1, 1]])
        cameras = list(rig.cameras)
        cameras[camera] = replace(own, base_from_camera=moved, matrix=matrix)
        return Rig(tuple(cameras))


KNOCKS = (
    Knock("0.25 mm", shift=0.25, detectable=False),
    Knock("0.5 mm", shift=0.5),
    Knock("1 mm", shift=1.0),
    Knock("2 mm", shift=2.0),
    Knock("0.2 degrees", turn=0.2),
    Knock("lens 0.5 %", scale=1.005, detectable=False),
    Knock("lens 1 %", scale=1.01),
    Knock("lens -1 %", scale=0.99),
)


def run_bumps(options: argparse.Namespace) -> list[Figure]:
    """Knocks flagged, named and how soon; and false alarms of a calm run."""
    cases = [(kind, number) for kind in range(len(KNOCKS)) for number in range(options.count)]
    results: list[list[KnockResult]] = [[] for _ in KNOCKS]
    for kind, number in with_progress("knocks", "runs", cases, len(cases)):
        results[kind].append(_knock_result(KNOCKS[kind], number % 3, options.seed + 1000 * kind + number))
    figures = [f for knock, of_kind in zip(KNOCKS, results, strict=True) for f in _knock_figures(knock, of_kind)]
    return [*figures, _calm(options.seed, options.minutes)] if options.minutes > 0 else figures


@dataclass(frozen=True, slots=True)
class KnockResult:
    """What came of one knock; inf: never."""

    flagged: float  # s until the state was no longer TRACKING
    named: float  # s until the right camera was named
    right: bool  # whether a shift was called a shift, and a turned lens a turned lens


def _knock_figures(knock: Knock, results: list[KnockResult]) -> Iterator[Figure]:
    flagged, named, right = columns(results, "flagged", "named", "right")
    target = at_least(1.0) if knock.detectable else None
    share = float(np.isfinite(flagged).mean())
    note = f"{len(results)} knocks, each camera in turn, {TRACK_NOISE_PX:g} px, {LANDMARKS} landmarks"
    yield Figure(f"{knock.name}: DEGRADED, share", share, "", target, NO_REFERENCE, note)
    longest = 1000 * float(max(flagged[np.isfinite(flagged)], default=np.nan))
    yield Figure(f"{knock.name}: time, largest", longest, "ms")
    known = np.isfinite(named)
    yield Figure(f"{knock.name}: camera named, share", float(known.mean()), "", target)
    yield Figure(f"{knock.name}: bump told from lens, share", float(right[known].mean()) if known.any() else np.nan)


class _BreathingTracks:
    """An estimator that is shown drawn tracks of a breathing surface."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rig, self._rng = arc_rig(), rng
        self._motion, self._landmarks = irregular(rng), patch(LANDMARKS, rng).points
        up, exact = np.tile([0.0, 0.0, 1.0], (LANDMARKS, 1)), np.zeros((3 * LANDMARKS,) * 2)
        self.estimator = Estimator(self.rig)
        self.estimator.begin(0.0, BASE_FROM_REST @ self._motion(0.0), SurfaceMap(self._landmarks, up, exact))

    def step(self, rig: Rig, stamp: float) -> SurfacePose:
        """The pose at `stamp`, s, from what the cameras of `rig` see."""
        truth = BASE_FROM_REST @ self._motion(stamp)
        tracks = observations(rig, self._landmarks, truth, stamp, self._rng, TRACK_NOISE_PX)
        fit = self.estimator.fit(tracks, self.estimator.predict(stamp))
        return self.estimator.accept(fit, tracks) if fit.measured else self.estimator.coast(fit)


def _knock_result(knock: Knock, camera: int, seed: int) -> KnockResult:
    rng = np.random.default_rng([seed, 101])
    tracks = _BreathingTracks(rng)
    rig, knocked = tracks.rig, knock.knocked(tracks.rig, camera, rng)
    flagged, named, right = np.inf, np.inf, False
    for number in range(1, round((CALM_BEFORE + WATCHED_AFTER) * BUMP_RATE)):
        stamp = number / BUMP_RATE
        pose = tracks.step(knocked if stamp >= CALM_BEFORE else rig, stamp)
        if stamp >= CALM_BEFORE and pose.state is not TrackState.TRACKING:
            flagged = min(flagged, stamp - CALM_BEFORE)
            if rig.cameras[camera].name in pose.reason:
                named = min(named, stamp - CALM_BEFORE)
                right = ("lens was turned" in pose.reason) == (knock.scale != 1.0)
    return KnockResult(flagged, named, right)


def _calm(seed: int, minutes: float) -> Figure:
    """Frame sets in which a camera is called bumped though none is, over several breathings of five minutes."""
    alarms, left = 0, minutes * 60.0
    for part in range(max(1, int(np.ceil(minutes / 5)))):
        tracks = _BreathingTracks(np.random.default_rng([seed, 103, part]))
        for number in range(1, round(min(left, 300.0) * BUMP_RATE)):
            tracks.step(tracks.rig, number / BUMP_RATE)
            alarms += bool(tracks.estimator.health.bumps.bumped)
        left -= 300.0
    note = f"{minutes:g} min of irregular breathing"
    return Figure("false alarms, frame sets", alarms, "", at_most(0), NO_REFERENCE, note)


STEP_RATE, STEP_NOISE_PX = 30.0, 0.1  # Hz; px of a track in a frame
FRAMES_AN_HOUR = 108_000
FRAMES_A_STEP = 90  # between steps: 3 s, of which the detector needs one until it takes the surface as at rest again
CORRELATED_NOISE = 0.5  # share of the white noise: errors that tracks carry from frame to frame
CORRELATION_TIME = 2.0  # s
MAX_FLAG_FRAMES = 2
STEP_SIZES = np.array([np.deg2rad(0.1), 0.3])  # rad, mm


def run_steps(options: argparse.Namespace) -> list[Figure]:
    """Measure steps, turns and rest."""
    rng = np.random.default_rng(options.seed)
    world = synthetic_world("still", seconds=0.1, noise=STEP_NOISE_PX)
    pose = world.base_from_surface(np.array(0.0))
    # of the pose from one frame set's tracks, by Fisher's information
    information = pose_information(world.true_rig, pose, world.landmarks.points, next(iter(world)))
    covariance = np.asarray(np.linalg.inv(information))
    note = f"{STEP_NOISE_PX:g} px, white, and {CORRELATED_NOISE:.0%} of it over {CORRELATION_TIME:g} s"
    figures, target = [], at_least(99.9)
    for kind, name in enumerate(("turns of 0.1 degree", "steps of 300 um")):
        delay = _flag_delays(kind, options.steps, covariance, rng)
        share = 100 * float(np.mean(delay < MAX_FLAG_FRAMES))
        what = f"{name} flagged within {MAX_FLAG_FRAMES} frames"
        figures.append(Figure(what, share, "%", target, "thesis: asked", note))
        figures.append(Figure(f"{name}, latest", float(delay.max()) + 1, "frames", note=f"of {len(delay)}"))
    moving = _moving(se3.exp(_noise(round(options.hours * FRAMES_AN_HOUR), covariance, rng)), covariance)
    false = int(np.sum(moving[1:] & ~moving[:-1])) / options.hours
    return [*figures, Figure("false alarms at rest", false, "1/h", at_most(1.0), note=f"{options.hours:g} h; {note}")]


def _noise(count: int, covariance: Array, rng: np.random.Generator) -> Array:
    """Right perturbations (count, 6): white noise, and CORRELATED_NOISE times as much Gauss-Markov noise."""
    root = np.linalg.cholesky(covariance)
    keep = np.exp(-1 / (CORRELATION_TIME * STEP_RATE))
    correlated = np.empty((count, 6))
    now = rng.normal(size=6)
    for k, drive in enumerate(np.sqrt(1 - keep**2) * rng.normal(size=(count, 6))):
        correlated[k] = now = keep * now + drive
    return np.asarray((rng.normal(size=(count, 6)) + CORRELATED_NOISE * correlated) @ root.T)


def _flag_delays(kind: int, steps: int, covariance: Array, rng: np.random.Generator) -> Array:
    """Frames (steps,) from the first pose of each movement, 0, to its flag; kind: 0 turns, 1 shifts."""
    first = FRAMES_A_STEP * np.arange(1, steps + 1)
    places = np.zeros((FRAMES_A_STEP * (steps + 2), 6))
    axes = rng.normal(size=(steps, 3))
    moved = STEP_SIZES[kind] * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    for k, (start, change) in enumerate(zip(first, moved, strict=True)):
        if k % 2:
            places[start:] = 0.0  # back, so that it stays near
        else:
            places[start:, 3 * kind : 3 * kind + 3] = change
    poses = se3.exp(places) @ se3.exp(_noise(len(places), covariance, rng))
    moving = _moving(poses, covariance)
    after = [moving[start : start + FRAMES_A_STEP] for start in first]
    delays = [int(np.argmax(flags)) if flags.any() else FRAMES_A_STEP for flags in after]
    return np.where(moving[first - 1], FRAMES_A_STEP, delays)  # not at rest just before: its beginning was missed


def _moving(poses: Array, covariance: Array) -> NDArray[np.bool_]:
    """Whether the detector takes the surface as moving (N,) at poses (N, 4, 4)."""
    detector = MotionDetector(np.zeros(3))
    return np.array([detector(k / STEP_RATE, pose, covariance).moving for k, pose in enumerate(poses)], bool)
