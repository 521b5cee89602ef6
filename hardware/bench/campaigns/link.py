"""`stillbed bench link`: the arm's line with everything going wrong, in virtual and in real time, and the guard.

Virtual time passes in runs of ten minutes that take turns in what goes wrong.
"""

from __future__ import annotations

import argparse
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from estimation.se3 import Array
from hardware.arm.device import BY_OPERATOR, ArmState
from hardware.arm.link import Arm
from hardware.arm.profile import ArmProfile, LinkSettings, at_baud
from hardware.arm.protocol import (
    FRAME_LENGTH,
    FRAME_TAILS,
    REPLY_LENGTH,
    REPLY_TAILS,
    FrameStream,
    decode,
    decode_reply,
)
from hardware.bench.figures import Figure, Target, at_most, with_progress
from hardware.process.clock import SimClock
from hardware.process.faults import Fault, FaultKind, FaultPart
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import Interval, PortFaults, VirtualDevice
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from planning.command import Move, feed_for

RUN_SECONDS = 600.0  # of one run
MAX_STALL = 0.6  # s of a stall
NOTICED_STALL = 0.2  # s of a stall that answers 50 ms apart can tell before it is over
REST_AFTER_FRAME = 0.055  # s after the last frame by which nothing may be under way: 50 ms, and a look at the line
LINE_PERIOD = 0.005  # s between looks at the line
HOME_AXES = ArmProfile().arm.home
RECENT_FRAMES = 400  # frames and answers that may still arrive
OBEYING, STALLING, LOSSY = MANNERS = "obeying", "stalling", "losing frames"  # of the arm
AXIS_RATES = np.array([0.21, 0.34, 0.27, 0.11, 0.17, 0.13])  # Hz, that never meet
AXIS_SIZES = np.array([15.0, 12, 8, 0.08, 0.06, 0.1])  # mm and rad: up to 40 mm/s


@dataclass(slots=True)
class LinkCounts:
    """What happened. Times in s; a list holds one number of each occurrence."""

    seconds: float = 0.0
    ticks: int = 0
    frames: int = 0
    overflows: int = 0
    foreign: int = 0  # frames that the arm took and nobody sent
    forged: int = 0  # answers that the host took and the arm never gave
    refused: int = 0  # frames that the arm found out of reach
    modelled: float = 0.0  # most under way by the link's model
    queued: dict[str, float] = field(default_factory=dict)  # most work held by the arm, by kind of run
    commands: dict[str, int] = field(default_factory=dict)  # most commands held by the arm, by kind of run
    after: dict[str, float] = field(default_factory=dict)  # most work held at the end of a stall that could be noticed
    restless: int = 0  # looks at which the arm still had work long after the last frame
    underruns: int = 0
    stops: list[float] = field(default_factory=list)  # from the decision to the last byte on the wire
    blocked_stops: list[float] = field(default_factory=list)  # the same while the port took no bytes
    held: int = 0
    faults: int = 0  # stops that the link made itself
    unplugged: int = 0
    strays: int = 0


class _PortLogger:
    """Knows what was sent, and counts what arrives and was not."""

    def __init__(self, counts: LinkCounts) -> None:
        self._counts = counts
        self._sent: deque[bytes] = deque(maxlen=RECENT_FRAMES)
        self._given: deque[bytes] = deque(maxlen=RECENT_FRAMES)
        self._frames = FrameStream(FRAME_LENGTH, FRAME_TAILS, self._whole)
        self._begun = b""  # of a frame that the host has not given out whole
        self._clean = b""
        self._noisy = FrameStream(REPLY_LENGTH, REPLY_TAILS, self._answer)

    def opened(self) -> None:
        self._begun = b""

    def from_host(self, data: bytes) -> None:
        self._begun += data
        if len(self._begun) >= FRAME_LENGTH:
            self._sent.append(self._begun[:FRAME_LENGTH])
            self._begun = self._begun[FRAME_LENGTH:]

    def to_arm(self, data: bytes) -> None:
        self._counts.foreign += sum(frame not in self._sent for frame in self._frames(data)[0])

    def _whole(self, frame: bytes) -> bytes:
        """A frame itself, if it is one; what was sent is."""
        if frame not in self._sent:
            decode(frame)
        return frame

    def to_host(self, sent: bytes, read: bytes) -> None:
        self._clean += sent
        while self._clean:
            if self._clean[0] not in REPLY_TAILS:  # a stray byte of the arm's own
                self._clean = self._clean[1:]
            elif len(self._clean) >= REPLY_LENGTH:
                self._given.append(self._clean[:REPLY_LENGTH])
                self._clean = self._clean[REPLY_LENGTH:]
            else:
                break
        answers, strays = self._noisy(read)
        self._counts.forged += sum(answer not in self._given for answer in answers)
        self._counts.strays += len(strays)

    def _answer(self, frame: bytes) -> bytes:
        """An answer itself, if it is one; what was given is."""
        if frame not in self._given:
            decode_reply(frame)
        return frame


def windows(rng: np.random.Generator, every: float, longest: float) -> list[Interval]:
    """Stretches of a run, one in `every` s on average, each up to `longest` s."""
    starts = np.cumsum(rng.exponential(every, int(3 * RUN_SECONDS / every) + 3))
    lengths = rng.uniform(0.02, longest, len(starts))
    return [(float(a), float(a + b)) for a, b in zip(starts, lengths, strict=True) if a < RUN_SECONDS]


def goal_at(phase: float) -> Array:
    """A motion of all axes about home that begins there at rest (6,)."""
    return HOME_AXES + AXIS_SIZES * np.sin(2 * np.pi * AXIS_RATES * phase) * min(phase, 1.0)


class LinkRun:
    """One run; its faults and the operator's impatience follow from the seed. kind: of the arm's own faults."""

    def __init__(self, seed: int, counts: LinkCounts, baud: int = ArmProfile().baud) -> None:
        rng = self._rng = np.random.default_rng(seed)
        self._counts = counts
        replies = ReplyMode.STREAM if seed % 2 else (ReplyMode.OFF, ReplyMode.STRAY)[rng.integers(2)]
        manner = MANNERS[seed // 2 % len(MANNERS)]
        self.kind = f"{manner}, {'answering' if seed % 2 else 'silent'}"
        faults: list[Fault] = []
        self._ends: deque[float] = deque()
        if manner == STALLING:
            stalls = windows(rng, 40.0, MAX_STALL)
            faults = [Fault(FaultPart.ARM, FaultKind.STALL, a, b - a) for a, b in stalls]
            self._ends = deque(b for a, b in stalls if b - a >= NOTICED_STALL)
        if manner == LOSSY:
            faults = [Fault(FaultPart.ARM, FaultKind.UNPLUG, a, b - a) for a, b in windows(rng, 150.0, 2.0)]
        profile = at_baud(ArmProfile(), baud)
        settings = ArmSettings(replies=replies, seed=seed)
        self._clock = SimClock()
        self._virtual = VirtualArm(settings, profile.dialect, profile.arm.home, faults, profile.baud)
        port = PortFaults(windows(rng, 30.0, MAX_STALL), windows(rng, 100.0, 5.0), 0.1, 2.0, 0.005 * (manner == LOSSY))
        self._blocked = port.blocked
        device = VirtualDevice(self._virtual, self._clock, profile.baud, port, seed, _PortLogger(counts))
        self._stalls = windows(rng, 30.0, MAX_STALL)  # of the host's loop
        self._arm = Arm(device, profile, 0.0, LinkSettings(poll=LINE_PERIOD))
        self._phase, self._last, self._reached = 0.0, -1.0, 0.0
        self._seen_stops = 0

    def run(self) -> None:
        """Let the time pass."""
        arm, clock = self._arm, self._clock
        period = arm.profile.tick * (1 + arm.settings.ease)
        due, order, work = 0.0, 0.0, float(self._rng.exponential(10.0))
        while (now := clock.now()) < RUN_SECONDS:
            if self._stalls and now >= self._stalls[0][0]:
                clock.wait_until(self._stalls.pop(0)[1])
                now = clock.now()
            arm.poll(now)
            if now >= due:
                self._tick(now)
                due = max(due + period, now)
            if now >= work and arm.state is ArmState.ARMED and not arm.travels:
                arm.stop(BY_OPERATOR, now)
                work = now + float(self._rng.exponential(10.0))
            if now >= order and arm.state in (ArmState.STOPPED, ArmState.DISARMED):
                self._operate(now)
                order = now + 0.3
            self._look(now)
            clock.wait_until(min(max(due, now + 1e-4), now + LINE_PERIOD))
        self._close()

    def _tick(self, now: float) -> None:
        counts, arm = self._counts, self._arm
        counts.ticks += 1
        arm.take_up()  # it goes on from where it stands
        if arm.hold(now):
            counts.held += 1
            return
        assert arm.target is not None
        goal = goal_at(self._phase + arm.profile.tick)
        feed = min(feed_for(arm.target, goal, arm.profile.tick), 250.0)
        if not arm.send(Move(now, goal, feed, 0, False), now):
            self._phase += arm.profile.tick
            self._last = now

    def _operate(self, now: float) -> None:
        """What an operator does: says where the arm stands if it does not, arms it, lets it go back to the print."""
        arm = self._arm
        place = goal_at(self._phase)
        if arm.target is None and arm.status(now).answered is None:
            self._virtual.advance(now)
            arm.stand(self._virtual.axes_at(np.array([now]))[0], now)
        if arm.arm(now) == "":
            arm.go(place, now)

    def _look(self, now: float) -> None:
        arm, counts = self._arm, self._counts
        flight = arm.in_flight(now)
        counts.modelled = max(counts.modelled, flight)
        if arm.travels or arm.frames != self._reached:
            self._last, self._reached = now, arm.frames
        if self.kind.startswith(OBEYING) and now - self._last > REST_AFTER_FRAME:
            counts.restless += self._virtual.now >= now and self._virtual.in_flight > 0
        stops = len(arm.stops)
        for decided, on_wire in list(arm.stops)[self._seen_stops :]:
            blocked = any(a < on_wire and b > decided for a, b in self._blocked)
            (counts.blocked_stops if blocked else counts.stops).append(on_wire - decided)
        self._seen_stops = stops
        if self._ends and self._virtual.now >= self._ends[0]:
            self._ends.popleft()
            counts.after[self.kind] = max(counts.after.get(self.kind, 0.0), self._virtual.held)

    def _close(self) -> None:
        counts, virtual = self._counts, self._virtual
        events = self._arm.events()
        counts.unplugged += sum(event.state is ArmState.UNPLUGGED for event in events)
        counts.faults += sum(event.state is ArmState.STOPPED and not event.by_operator for event in events)
        counts.frames += virtual.frames
        counts.overflows += len(virtual.ignored)
        counts.refused += len(virtual.refused)
        counts.underruns += len(virtual.underruns)
        counts.queued[self.kind] = max(counts.queued.get(self.kind, 0.0), virtual.deepest)
        counts.commands[self.kind] = max(counts.commands.get(self.kind, 0), virtual.fullest)


ZERO = at_most(0)
FIFO_REFERENCE = "a full queue: 4000 ms"  # 200 commands of a tick; the thesis fills it
MANNER_TEXTS = {
    OBEYING: "faults of port and host only",
    STALLING: "the controller stalls up to 600 ms, each 40 s",
    LOSSY: "1 frame in 200 gets a stray byte, the wire is cut each 150 s",
}


def run_link(options: argparse.Namespace) -> list[Figure]:
    """The figures of all parts that were asked for."""
    figures: list[Figure] = []
    if options.only == "guard":
        options.hours = options.minutes = 0.0
    if options.hours > 0:
        figures += soak_figures(soaked(options.hours, options.seed, options.baud))
    if options.minutes > 0:
        from hardware.bench.campaigns.link_live import live_figures

        figures += live_figures(60 * options.minutes, options.seed, options.busy, not options.ordinary)
    if options.commands > 0:
        from hardware.bench.campaigns.guard import guard_figures

        figures += guard_figures(options.commands, options.seed)
    return figures


def soaked(hours: float, seed: int, baud: int = ArmProfile().baud) -> LinkCounts:
    """What happened in `hours` h of virtual time, in runs of ten minutes that take turns in what goes wrong."""
    counts, runs = LinkCounts(), max(1, round(3600 * hours / RUN_SECONDS))
    for k in with_progress("link", "runs of 10 min", range(runs), runs):
        LinkRun(seed + k, counts, baud).run()
        counts.seconds += RUN_SECONDS
    return counts


def soak_figures(counts: LinkCounts) -> list[Figure]:
    """Figures of the virtual runs."""
    hours = f"{counts.seconds / 3600:.3g} h"
    name = f"virtual {hours}"
    return [
        Figure(f"{name}: frames taken", counts.frames, "", note=f"of {counts.ticks} ticks; {counts.held} held"),
        Figure(f"{name}: commands that found the queue full", counts.overflows, "", ZERO),
        Figure(f"{name}: frames taken that nobody sent", counts.foreign, "", ZERO),
        Figure(f"{name}: noise that reads as an answer", counts.forged, "", None, "", _noise(counts)),
        Figure(f"{name}: frames that the arm refused", counts.refused, "", ZERO),
        Figure(f"{name}: most under way, by the model", 1000 * counts.modelled, "ms", at_most(50), FIFO_REFERENCE),
        Figure(f"{name}: still moving 55 ms after the last frame", counts.restless, "", ZERO, note="an arm that obeys"),
        *_queued(name, counts),
        *_stops(name, counts),
        Figure(f"{name}: underruns", counts.underruns, "", note="each ended at rest"),
        Figure(
            f"{name}: stops by the link itself", counts.faults, "", note=f"the device went {counts.unplugged} times"
        ),
    ]


def _noise(counts: LinkCounts) -> str:
    return f"of {counts.strays} stray bytes; there is no check sum, and one answer alone is not believed"


def _queued(name: str, counts: LinkCounts) -> list[Figure]:
    figures = []
    for kind, most in sorted(counts.queued.items()):
        manner = kind.split(",")[0]
        target = at_most(50) if manner == OBEYING else None
        note = f"{MANNER_TEXTS[manner]}; {counts.commands.get(kind, 0)} commands at most"
        figures.append(Figure(f"{name}: most queued, {kind}", 1000 * most, "ms", target, FIFO_REFERENCE, note))
    for kind, most in sorted(counts.after.items()):
        target = at_most(50) if kind.endswith("answering") else None
        note = f"of {1000 * NOTICED_STALL:.0f} ms or more"
        what = f"{name}: most queued at the end of a stall, {kind}"
        figures.append(Figure(what, 1000 * most, "ms", target, "", note))
    return figures


def _stops(name: str, counts: LinkCounts) -> list[Figure]:
    what = f"{name}: stop on the wire after its decision"
    if not counts.stops:
        return [Figure(what, float("nan"), "ms", at_most(10))]
    targets: tuple[tuple[str, float, Target | None], ...] = (("median", 50, None), ("99 %", 99, at_most(10)))
    figures = [
        Figure(f"{what}, {word}", 1000 * float(np.percentile(counts.stops, share)), "ms", target)
        for word, share, target in targets
    ]
    note = f"{len(counts.stops)} stops, and {len(counts.blocked_stops)} before a port that took no bytes"
    return [*figures, Figure(f"{what}, largest", 1000 * max(counts.stops), "ms", note=note)]
