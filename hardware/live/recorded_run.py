"""A recorded run, examined afterwards: its loop played back and compared bit by bit, and its commands."""

from __future__ import annotations

import base64
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as File
from typing import Any, NoReturn

import numpy as np

from estimation.errors import InputError, StillbedError
from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.driver import G1, G4, G54, ArmDriver, Pause, Reply, ReplyKind, Reported, Sent, UnpluggedError
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.arm.protocol import encode
from hardware.files.arm_file import arm_from_text
from hardware.motion.loop import MaterialControl, Order, Tick
from hardware.motion.print_loop import LoopOrder, LoopSettings, PrintLoop
from hardware.motion.step import BeginPrint, PauseOrder, PoseHandover
from hardware.offline.replay import CommandWriter
from hardware.process.clock import SimClock
from hardware.process.progress import prepare_out
from hardware.recording.loop_record import LOOP_ARM_ATTACHMENT, REFUSED, START, UNPLUGGED
from hardware.recording.mcap_file import AttachedFile, ChunkMessages, Damage, damage_words, parse, walk
from hardware.recording.messages import (
    Message,
    move_from_message,
    pose_from_message,
)
from hardware.recording.session_reader import PATH_ATTACHMENT, inputs_from_texts
from planning.command import Command, Hold
from planning.material import FlowShares, Outlet, Outlets, SwitchDelay, flow_from_message
from planning.path import PrintPhase, PrintProgress

RUN_REQUIRED = "the recording of a run that began to print, or give --path"


@dataclass(slots=True)
class RecordedRun:
    """What a recording holds of a run."""

    texts: dict[str, str]  # of attached files, by name
    messages: dict[str, list[Message]]  # by topic, in the order of the file
    damage: str = ""  # what was lost of the file, "" if nothing

    @property
    def poses(self) -> dict[float, SurfacePose]:
        """By stamp, s."""
        return {pose.stamp: pose for pose in map(pose_from_message, self.messages["/pose"])}


def read_run(record: File, *topics: str) -> RecordedRun:
    """The attached files of a recording, and its messages of these topics."""
    run, damages = RecordedRun({}, {topic: [] for topic in topics}), list[Damage]()
    for part in walk(record):
        if isinstance(part, Damage):
            damages.append(part)
        elif isinstance(part, AttachedFile):
            run.texts[part.name] = part.data.decode("utf-8", "replace")
        elif isinstance(part, ChunkMessages):
            for stored in part.messages:
                if stored.topic in run.messages:
                    run.messages[stored.topic].append(parse(record, stored))
    run.damage = damage_words(damages)
    return run


class PartedError(StillbedError):
    """The loop does something else than it did."""


class PlayedOutError(StillbedError):
    """All that was recorded is played."""


@dataclass(frozen=True, slots=True)
class PlayedFrame:
    """What the arm's driver is given, as a frame of the S6H4D, beside what it was given then."""

    stamp: float  # s
    frame: bytes
    recorded: bytes


class PlayedSource:
    """Hands on what was noted. frames: what the driver was given so far. settings: with which the loop was begun."""

    material: MaterialControl | None = None

    def __init__(
        self,
        records: Iterable[Mapping[str, Any]],
        poses: Mapping[float, SurfacePose],
        begin: Callable[[float, Outlets], BeginPrint],
        profile: ArmProfile,
        taken: Callable[[PlayedFrame], None],
    ) -> None:
        """records: messages of LoopRecords, in order. poses: by stamp. begin: the order that began to print.

        profile: LOOP_ARM_ATTACHMENT's. taken: is given each frame. PartedError where the beginning is missing.
        """
        self._records, self._poses, self._begin, self._take_frame = iter(records), poses, begin, taken
        self._readings: deque[float] = deque()
        self._calls: deque[tuple[int, int, str, Any]] = deque()
        self._readings_used = self._count = self._number = 0  # readings of this record, calls since the last
        self._instant = 0.0
        self._handover: PoseHandover | None = None
        self._parted = ""  # why it parted first
        self._fill()
        start = self.answer(START)
        if not start:
            raise PartedError("the recording does not hold how the loop began")
        self.settings = LoopSettings(LinkSettings(**start["link"]), start.get("until"))
        self.driver: ArmDriver = _PlayedDriver(self, profile)

    def now(self) -> float:
        """The clock as it was read then, s."""
        if self._calls and not self._readings:
            self._missed()
        if not self._readings:
            self._fill()
        if self._calls and self._calls[0][0] <= self._readings_used:
            self._missed()
        self._readings_used, self._count = self._readings_used + 1, 0
        self._instant = self._readings.popleft()
        return self._instant

    def wait_until(self, instant: float) -> None:
        """The next reading says how long that took. PlayedOutError where the motion was ended meanwhile."""
        if error_name := self.answer("wait"):
            raise PlayedOutError(f"the motion was ended: {error_name}")

    def pose(self) -> PoseHandover | None:
        """The newest pose."""
        if answer := self.answer("pose"):
            stamp, sent = answer
            if stamp not in self._poses:
                self._part(f"the pose of {stamp:.3f} s is not in the recording, which has gaps")
            self._handover = PoseHandover(self._poses[stamp], sent, sent)
        return self._handover

    def orders(self) -> Sequence[LoopOrder]:
        """The orders since the last call."""
        return [self._order(text) for text in self.answer("orders") or ()]

    def dry(self) -> str:
        """Why material could not flow then."""
        return str(self.answer("dry") or "")

    def answer(self, kind: str) -> Any:
        """What a call was answered then; None: the usual."""
        self._count += 1
        if not self._calls and not self._readings:
            self._fill(optional=True)
        if not self._calls or self._calls[0][:2] != (self._readings_used, self._count):
            return None
        if self._calls[0][2] != kind:
            self._missed(kind)
        answer = self._calls.popleft()[3]
        raised = answer if isinstance(answer, dict) else {}
        if (message := raised.get(UNPLUGGED)) is not None:
            raise UnpluggedError(message)
        if (message := raised.get(REFUSED)) is not None:
            raise _RefusedError(message)
        return answer

    def flush(self) -> None:
        """Nothing is kept."""

    def take(self, frame: bytes, recorded: bytes) -> None:
        """The driver is given something."""
        self._take_frame(PlayedFrame(self._instant, frame, recorded))

    def _order(self, row: Sequence[Any]) -> LoopOrder:
        kind, *values = row
        if kind == "begin":
            outlets = {name: Outlet(SwitchDelay(**delay), tuple(at)) for name, delay, at in values[1]}
            return self._begin(values[0], outlets)
        if kind == "flow":
            return flow_from_message(values[0])
        return Order(values[0]) if kind == "arm" else PauseOrder(values[0])

    def _fill(self, optional: bool = False) -> None:
        """Go on to the next record. optional: of what may be the last one."""
        record = next(self._records, None)
        if record is None:
            if optional:
                return
            raise PlayedOutError("all is played")
        if record["number"] != self._number:
            self._part(f"after {self._instant:.3f} s a part of the recording is missing")
        self._number += 1
        self._readings.extend(record["readings"])
        self._calls.extend((row[0], row[1], row[2], row[3]) for row in record["calls"])
        self._readings_used = 0

    def _missed(self, kind: str = "the clock") -> NoReturn:
        expected = self._calls[0][2]
        self._part(f"after {self._instant:.3f} s the loop asked for {expected!r} then, and now for {kind!r}")

    def _part(self, words: str) -> NoReturn:
        """PartedError, whose words are those of the first one: the loop may go on after it for a while."""
        self._parted = self._parted or words
        raise PartedError(self._parted)


class _RefusedError(InputError):
    """What a driver refused, by its words."""

    def __init__(self, words: str) -> None:
        StillbedError.__init__(self, words)


class _PlayedDriver(ArmDriver):
    """A driver that answers as another did."""

    def __init__(self, source: PlayedSource, profile: ArmProfile) -> None:
        self._source, self._answer, self._dialect = source, source.answer, profile.dialect
        self.origin = np.zeros(3)

    def connect(self, now: float) -> None:
        self._answer("connect")

    def state(self, now: float) -> Reported:
        answer = self._answer("state")
        return _reported_from_list(answer) if answer else Reported(now)

    def send(self, instruction: G1 | G4, now: float) -> Sequence[Sent]:
        recorded, rows = self._given("send")
        self._source.take(encode(instruction, self._dialect), base64.b64decode(recorded))
        return _sent_from_rows(rows) if rows else (Sent(instruction),)

    def stop(self, now: float) -> Sequence[Sent]:
        _, rows = self._given("stop")
        frame = encode(Pause(), self._dialect)
        self._source.take(frame, frame)
        return _sent_from_rows(rows) if rows else (Sent(Pause()),)

    def set_origin(self, origin: Array, now: float) -> Sequence[Sent]:
        recorded, rows = self._given("set_origin")
        self._source.take(encode(G54(origin), self._dialect), encode(G54(np.array(recorded)), self._dialect))
        self.origin = np.array(origin, float)
        return _sent_from_rows(rows)

    def flush(self, now: float) -> Sequence[Sent]:
        return _sent_from_rows(self._answer("flush") or ())

    def enable(self, now: float) -> str:
        return str(self._answer("enable") or "")

    def home(self, now: float) -> bool:
        return bool(self._answer("home"))

    def blocked_for(self, now: float) -> float | None:
        answer = self._answer("blocked_for")
        return float(answer[0]) if answer else None

    def waiting(self) -> float:
        return float(self._answer("waiting") or 0.0)

    def close(self) -> None:
        self.origin = np.zeros(3)

    def _given(self, kind: str) -> Sequence[Any]:
        answer: Sequence[Any] | None = self._answer(kind)
        if answer is None:
            raise PartedError(f"the loop gives the arm {kind!r}, which it did not then")
        return answer


def _reported_from_list(row: Sequence[Any]) -> Reported:
    stamp, replies, strays, fault, busy = row
    parsed = tuple(Reply(ReplyKind(kind), np.array(values, float)) for kind, values in replies)
    return Reported(stamp, parsed, base64.b64decode(strays), fault, busy)


def _sent_from_rows(rows: Sequence[Any]) -> list[Sent]:
    constructors: dict[str, Callable[..., G1 | G4 | G54 | Pause | None]] = {
        "G1": lambda axes, feed, material: G1(np.array(axes, float), feed, material),
        "G4": G4,
        "G54": lambda origin: G54(np.array(origin, float)),
        "pause": Pause,
        "part": lambda: None,
    }
    return [Sent(constructors[row[1]](*row[2:]), row[0]) for row in rows if row != ["nothing"]]


@dataclass(frozen=True, slots=True)
class ReplayCount:
    """How many frames were replayed, how many of them not as recorded, and what was lost of the file, "" if nothing."""

    frames: int
    other: int
    damage: str
    parted: str  # where the loop did something else than it did then, "" if nowhere


def replay_run(record: File) -> list[PlayedFrame]:
    """Every frame that a recorded run gave its arm, decided anew; PartedError where the loop did something else."""
    run, frames = read_run(record, "/loop", "/pose"), list[PlayedFrame]()
    _play(run, record, frames.append, lambda tick: None)
    return frames


def _play(run: RecordedRun, record: File, take: Callable[[PlayedFrame], None], report: Callable[[Tick], None]) -> None:
    """The loop of a recorded run, once more, as far as it was recorded."""
    if LOOP_ARM_ATTACHMENT not in run.texts:
        raise InputError(record, "recording", "no /loop", "of a run that recorded what its loop was given")
    profile = arm_from_text(run.texts[LOOP_ARM_ATTACHMENT], record / LOOP_ARM_ATTACHMENT)

    def begin(start: float, outlets: Outlets) -> BeginPrint:
        inputs = inputs_from_texts(run.texts, record)
        return BeginPrint(inputs.path, inputs.profile, start, outlets, "", inputs.tissue)

    try:
        source = PlayedSource(run.messages["/loop"], run.poses, begin, profile, take)
        PrintLoop(source, profile, source.settings, SimClock(), report).run()
    except PlayedOutError:
        pass


def write_replay(record: File, out: File, force: bool = False) -> ReplayCount:
    """Replay a run into commands.csv and frames.bin of the folder `out`.

    InputError where the recording holds no run, or `out` holds something and `force` is not set; nothing is made then.
    """
    if record.is_dir():
        raise InputError(record, "recording", "a session folder", RUN_REQUIRED)
    run = read_run(record, "/loop", "/pose")
    if PATH_ATTACHMENT not in run.texts:
        raise InputError(record, "recording", "no path", RUN_REQUIRED)
    prepare_out(out, force)
    same, parting = list[bool](), ""
    with CommandWriter(out) as writer:

        def take(played: PlayedFrame) -> None:
            writer.send(played.frame)
            same.append(played.frame == played.recorded)

        try:
            _play(run, record, take, lambda tick: writer.write(tick.command))
        except PartedError as error:
            parting = str(error)
    return ReplayCount(len(same), same.count(False), run.damage, parting)


def asked_flows(run: RecordedRun) -> tuple[FlowShares, ...]:
    """The flows that a run's loop was asked for, in order, those of the run before it among them; of its /loop."""
    calls = [call for record in run.messages["/loop"] for call in record["calls"]]
    orders = [order for _, _, kind, answer in calls if kind == "orders" for order in answer]
    return tuple(flow_from_message(order[1]) for order in orders if order[0] == "flow")


def printed_range(record: File) -> tuple[float, float]:
    """First and last place, counted in checkpoints, at which a run extruded; NaN where it did not."""
    run = read_run(record, "/tick", "/move")
    extruding = {m["stamp"] for m in run.messages["/move"] if m["extrude"]}
    places = [float(m["fraction"]) for m in run.messages["/tick"] if m["stamp"] in extruding]
    return (min(places), max(places)) if places else (float("nan"), float("nan"))


def commands_in(run: RecordedRun) -> list[tuple[Command, PrintProgress]]:
    """Commands in order, with the place on the path."""
    ticks = {m["stamp"]: m for m in run.messages["/tick"]}
    moves = {m["stamp"]: move_from_message(m) for m in run.messages["/move"]}
    commands: list[tuple[Command, PrintProgress]] = []
    for stamp, tick in sorted(ticks.items()):
        fraction = float(tick["fraction"])
        progress = PrintProgress(PrintPhase(tick["phase"]), 0, 0, fraction, 0.0, fraction)
        commands.append((moves.get(stamp, Hold(stamp, 0.001, "held")), progress))
    return commands
