"""`python -m tests.campaigns link`: the arm's line in virtual time with everything going wrong.

Runs of ten minutes take turns in what goes wrong. `stillbed bench link` is the same in real time.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm import protocol
from hardware.arm.device import BY_OPERATOR, ArmState
from hardware.arm.link import Arm
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.arm.protocol import FRAME_LENGTH, FRAME_TAILS, REPLY_LENGTH, REPLY_TAILS, FrameStream
from hardware.arm.s6h4d import S6H4D
from hardware.bench.figures import Figure, at_most, milliseconds, with_progress
from hardware.motion.loop import MotionLoop, Order, Tick
from hardware.process.clock import SimClock
from hardware.process.faults import Fault, FaultKind, FaultPart
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import Interval
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from planning.command import Command, Move, feed_for
from tests.faulty_port import FaultyDevice, PortFaults

RUN_SECONDS = 600.0  # of one run
MAX_STALL = 0.6  # s of a stall
DETECTABLE_STALL = 0.2  # s: the shortest stall that answers 50 ms apart show before it is over
REST_AFTER_FRAME = 0.055  # s after the last frame by which nothing may be under way: 50 ms, and a poll of the line
POLL_INTERVAL = 0.005  # s
MIN_WAIT = 1e-4  # s in which a host looks again where nothing is to be waited for
HOME_AXES = ArmProfile().arm.home
RECENT_FRAMES = 400  # frames and answers that may still arrive
OBEYING, STALLING, LOSSY = ANSWER_MODES = "obeying", "stalling", "losing frames"  # of the arm
AXIS_RATES = np.array([0.21, 0.34, 0.27, 0.11, 0.17, 0.13])  # Hz, that never meet
AXIS_SIZES = np.array([15.0, 12, 8, 0.08, 0.06, 0.1])  # mm and rad: up to 40 mm/s


@dataclass(slots=True)
class LinkCounts:
    """Counts, and times in s; a list holds one number for each occurrence."""

    seconds: float = 0.0
    ticks: int = 0
    frames: int = 0
    overflows: int = 0
    foreign: int = 0  # frames that the arm accepted and nobody sent
    forged: int = 0  # answers that the host accepted and the arm never gave
    refused: int = 0  # frames that are out of the arm's reach
    modelled: float = 0.0  # most under way by the link's model
    queued: dict[str, float] = field(default_factory=dict)  # most work held by the arm, by kind of run
    commands: dict[str, int] = field(default_factory=dict)  # most commands held by the arm, by kind of run
    after: dict[str, float] = field(default_factory=dict)  # most work held at the end of a detectable stall
    restless: int = 0  # polls at which the arm still had work long after the last frame
    underruns: int = 0
    stops: list[float] = field(default_factory=list)  # from the decision to the last byte on the wire
    blocked_stops: list[float] = field(default_factory=list)  # the same while the port took no bytes
    held: int = 0
    faults: int = 0  # stops that the link made itself
    unplugged: int = 0
    strays: int = 0


class _PortLogger:
    """Logs what was sent on the line, and counts what arrives and was not sent."""

    def __init__(self, counts: LinkCounts) -> None:
        self._counts = counts
        self._frames, self._answers = deque[bytes](maxlen=RECENT_FRAMES), deque[bytes](maxlen=RECENT_FRAMES)  # as sent
        self._host_bytes = self._arm_bytes = b""  # of a frame or answer that is not sent completely yet
        self._arriving = FrameStream(FRAME_LENGTH, FRAME_TAILS, self._checker(self._frames, protocol.decode))
        self._replies = FrameStream(REPLY_LENGTH, REPLY_TAILS, self._checker(self._answers, protocol.decode_reply))

    @staticmethod
    def _checker(sent: deque[bytes], decode: Callable[[bytes], object]) -> Callable[[bytes], bytes]:
        """A decoder that keeps the bytes of a frame or answer; what was not sent must be decodable."""

        def check(data: bytes) -> bytes:
            if data not in sent:
                decode(data)
            return data

        return check

    def opened(self) -> None:
        self._host_bytes = b""

    def from_host(self, data: bytes) -> None:
        self._host_bytes += data
        if len(self._host_bytes) >= FRAME_LENGTH:
            self._frames.append(self._host_bytes[:FRAME_LENGTH])
            self._host_bytes = self._host_bytes[FRAME_LENGTH:]

    def to_arm(self, data: bytes) -> None:
        self._counts.foreign += sum(frame not in self._frames for frame in self._arriving(data)[0])

    def to_host(self, sent: bytes, read: bytes) -> None:
        self._arm_bytes += sent
        while self._arm_bytes:
            if self._arm_bytes[0] not in REPLY_TAILS:  # a stray byte of the arm's own
                self._arm_bytes = self._arm_bytes[1:]
            elif len(self._arm_bytes) >= REPLY_LENGTH:
                self._answers.append(self._arm_bytes[:REPLY_LENGTH])
                self._arm_bytes = self._arm_bytes[REPLY_LENGTH:]
            else:
                break
        answers, strays = self._replies(read)
        self._counts.forged += sum(answer not in self._answers for answer in answers)
        self._counts.strays += len(strays)


def windows(rng: np.random.Generator, every: float, longest: float) -> list[Interval]:
    """Stretches of a run, one in `every` s on average, each up to `longest` s."""
    starts = np.cumsum(rng.exponential(every, int(3 * RUN_SECONDS / every) + 3))
    lengths = rng.uniform(0.02, longest, len(starts))
    return [(float(a), float(a + b)) for a, b in zip(starts, lengths, strict=True) if a < RUN_SECONDS]


def goal_at(phase: float) -> Array:
    """A motion of all axes about home that begins there at rest (6,)."""
    return HOME_AXES + AXIS_SIZES * np.sin(2 * np.pi * AXIS_RATES * phase) * min(phase, 1.0)


class LinkRun:
    """One run; its faults and the operator's actions follow from the seed. kind: of the arm's own faults."""

    def __init__(self, seed: int, counts: LinkCounts) -> None:
        rng = self._rng = np.random.default_rng(seed)
        self._counts = counts
        replies = ReplyMode.STREAM if seed % 2 else (ReplyMode.OFF, ReplyMode.STRAY)[rng.integers(2)]
        manner = ANSWER_MODES[seed // 2 % len(ANSWER_MODES)]
        self.kind = f"{manner}, {'answering' if seed % 2 else 'silent'}"
        faults: list[Fault] = []
        self._ends: deque[float] = deque()
        if manner == STALLING:
            stalls = windows(rng, 40.0, MAX_STALL)
            faults = [Fault(FaultPart.ARM, FaultKind.STALL, a, b - a) for a, b in stalls]
            self._ends = deque(b for a, b in stalls if b - a >= DETECTABLE_STALL)
        if manner == LOSSY:
            faults = [Fault(FaultPart.ARM, FaultKind.UNPLUG, a, b - a) for a, b in windows(rng, 150.0, 2.0)]
        profile = ArmProfile()
        settings = ArmSettings(replies=replies, seed=seed)
        self._clock = SimClock()
        self._virtual = VirtualArm(settings, profile.dialect, profile.arm.home, faults, profile.baud)
        port = PortFaults(windows(rng, 30.0, MAX_STALL), windows(rng, 100.0, 5.0), 0.1, 2.0, 0.005 * (manner == LOSSY))
        self._blocked = port.blocked
        device = FaultyDevice(self._virtual, self._clock, profile.baud, port, seed, _PortLogger(counts))
        self._stalls = windows(rng, 30.0, MAX_STALL)  # of the host's loop
        self._arm = Arm(S6H4D(device, profile), profile, 0.0, LinkSettings(poll=POLL_INTERVAL))
        self._phase, self._last_frame, self._frames, self._stops = 0.0, -1.0, 0, 0
        self._next_order, self._next_stop = 0.0, float(rng.exponential(10.0))  # s

    def run(self) -> None:
        """Let the time pass."""
        MotionLoop(self, self._arm, self, lambda: None, self._orders, self._report).run(RUN_SECONDS)
        self._count_run()

    # -- the loop's clock: the host's loop stalls now and then

    def now(self) -> float:
        """Instant, s."""
        return self._clock.now()

    def wait_until(self, instant: float) -> None:
        """Let the time pass until then, or for as long as the host stalls."""
        self._count(self.now())
        self._clock.wait_until(max(instant, self.now() + MIN_WAIT))
        if self._stalls and self.now() >= self._stalls[0][0]:
            self._clock.wait_until(self._stalls.pop(0)[1])

    # -- its motion, orders and report

    def __call__(self, pose: SurfacePose | None, now: float) -> Command:
        """The next piece of the motion; it goes on from where the last one led that was sent."""
        arm = self._arm
        assert arm.target is not None
        goal = goal_at(self._phase + arm.profile.tick)
        return Move(now, goal, min(feed_for(arm.target, goal, arm.profile.tick), 250.0), 0, False)

    def recalled(self, place: Array, stands: Array) -> None:
        """It goes on from where it stands."""

    def _report(self, tick: Tick) -> None:
        self._counts.ticks += 1
        self._counts.held += not tick.frame
        if tick.frame:
            self._phase += self._arm.profile.tick
            self._last_frame = self.now()

    def _orders(self) -> list[Order]:
        """An operator stops it now and then, says where the arm stands if it does not, and sends it back."""
        arm, now = self._arm, self.now()
        if now >= self._next_stop and arm.state is ArmState.ARMED and not arm.travels:
            self._next_stop = now + float(self._rng.exponential(10.0))
            return [Order.STOP]
        if now >= self._next_order and arm.state in (ArmState.STOPPED, ArmState.DISARMED):
            if arm.target is None and arm.status(now).answered is None:
                self._virtual.advance(now)
                arm.stand(self._virtual.axes_at(np.array([now]))[0], now)
            if arm.arm(now) == "":
                arm.go(goal_at(self._phase), now)
            self._next_order = now + 0.3
        return []

    def _count(self, now: float) -> None:
        arm, counts = self._arm, self._counts
        counts.modelled = max(counts.modelled, arm.in_flight(now))
        if arm.travels or arm.frames != self._frames:
            self._last_frame, self._frames = now, arm.frames
        if self.kind.startswith(OBEYING) and now - self._last_frame > REST_AFTER_FRAME:
            counts.restless += self._virtual.now >= now and self._virtual.in_flight > 0
        for decided, on_wire in list(arm.stops)[self._stops :]:
            blocked = any(a < on_wire and b > decided for a, b in self._blocked)
            (counts.blocked_stops if blocked else counts.stops).append(on_wire - decided)
        self._stops = len(arm.stops)
        if self._ends and self._virtual.now >= self._ends[0]:
            self._ends.popleft()
            counts.after[self.kind] = max(counts.after.get(self.kind, 0.0), self._virtual.queued_work)

    def _count_run(self) -> None:
        counts, virtual, events = self._counts, self._virtual, self._arm.events()
        counts.unplugged += sum(event.state is ArmState.UNPLUGGED for event in events)
        counts.faults += sum(
            event.state is ArmState.STOPPED and not event.text.endswith(BY_OPERATOR) for event in events
        )
        counts.frames += virtual.frames
        counts.overflows += len(virtual.ignored)
        counts.refused += len(virtual.refused)
        counts.underruns += len(virtual.underruns)
        counts.queued[self.kind] = max(counts.queued.get(self.kind, 0.0), virtual.peak_work)
        counts.commands[self.kind] = max(counts.commands.get(self.kind, 0), virtual.peak_commands)


ZERO = at_most(0)
FIFO_REFERENCE = "a full queue: 4000 ms"  # 200 commands of a tick; the thesis fills it
MANNER_TEXTS = {
    OBEYING: "faults of port and host only",
    STALLING: "the controller stalls up to 600 ms, each 40 s",
    LOSSY: "1 frame in 200 gets a stray byte, the wire is cut each 150 s",
}


def run_link(options: argparse.Namespace) -> list[Figure]:
    """The figures of all runs."""
    counts, runs = LinkCounts(), max(1, round(3600 * options.hours / RUN_SECONDS))
    for k in with_progress("link", "runs of 10 min", range(runs), runs):
        LinkRun(options.seed + k, counts).run()
        counts.seconds += RUN_SECONDS
    return soak_figures(counts)


def soak_figures(counts: LinkCounts) -> list[Figure]:
    """Figures of the virtual runs."""
    name = f"virtual {counts.seconds / 3600:.3g} h"
    noise = f"of {counts.strays} stray bytes; there is no check sum, and one answer alone is not believed"
    figures = [
        Figure(f"{name}: frames taken", counts.frames, "", note=f"of {counts.ticks} ticks; {counts.held} held"),
        Figure(f"{name}: commands that found the queue full", counts.overflows, "", ZERO),
        Figure(f"{name}: frames taken that nobody sent", counts.foreign, "", ZERO),
        Figure(f"{name}: noise that reads as an answer", counts.forged, "", None, "", noise),
        Figure(f"{name}: frames that the arm refused", counts.refused, "", ZERO),
        Figure(f"{name}: most under way, by the model", 1000 * counts.modelled, "ms", at_most(50), FIFO_REFERENCE),
        Figure(f"{name}: still moving 55 ms after the last frame", counts.restless, "", ZERO, note="an arm that obeys"),
    ]
    for kind, most in sorted(counts.queued.items()):
        manner = kind.split(",")[0]
        target = at_most(50) if manner == OBEYING else None
        note = f"{MANNER_TEXTS[manner]}; {counts.commands.get(kind, 0)} commands at most"
        figures.append(Figure(f"{name}: most queued, {kind}", 1000 * most, "ms", target, FIFO_REFERENCE, note))
    for kind, most in sorted(counts.after.items()):
        target = at_most(50) if kind.endswith("answering") else None
        what = f"{name}: most queued at the end of a stall, {kind}"
        figures.append(Figure(what, 1000 * most, "ms", target, "", f"of {1000 * DETECTABLE_STALL:.0f} ms or more"))
    what, returns = f"{name}: stop on the wire after its decision", f"the device went {counts.unplugged} times"
    note = f"{len(counts.stops)} stops, and {len(counts.blocked_stops)} before a port that took no bytes"
    stops = [
        Figure(f"{what}, median", milliseconds(counts.stops, 50), "ms"),
        Figure(f"{what}, 99 %", milliseconds(counts.stops, 99), "ms", at_most(10)),
        Figure(f"{what}, largest", 1000 * max(counts.stops, default=np.nan), "ms", note=note),
    ]
    return [
        *figures,
        *(stops if counts.stops else [Figure(what, float("nan"), "ms", at_most(10))]),
        Figure(f"{name}: underruns", counts.underruns, "", note="each ended at rest"),
        Figure(f"{name}: stops by the link itself", counts.faults, "", note=returns),
    ]
