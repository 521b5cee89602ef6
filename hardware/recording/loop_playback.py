"""What was recorded of a print's loop, played back to the same loop: it is answered as it was, and compared."""

from __future__ import annotations

import base64
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimation.errors import InputError, StillbedError
from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.arm.driver import G1, G4, G54, ArmDriver, Pause, Reply, ReplyKind, Reported, Sent, UnpluggedError
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.arm.protocol import encode
from hardware.motion.loop import MaterialControl, Order
from hardware.motion.print_loop import LoopOrder, LoopSettings
from hardware.motion.step import BeginPrint, PauseOrder, PoseHandover
from hardware.recording.loop_record import REFUSED, START, UNPLUGGED
from planning.material import Outlet, Outlets, SwitchDelay


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
        self._records, self._poses, self._begin, self._taken = iter(records), poses, begin, taken
        self._readings: deque[float] = deque()
        self._calls: deque[tuple[int, int, str, Any]] = deque()
        self._passed = self._count = self._number = 0  # readings of this record, calls since the last
        self._instant = 0.0
        self._handover: PoseHandover | None = None
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
        if self._calls and self._calls[0][0] <= self._passed:
            self._missed()
        self._passed, self._count = self._passed + 1, 0
        self._instant = self._readings.popleft()
        return self._instant

    def wait_until(self, instant: float) -> None:
        """The next reading says how long that took. PlayedOutError where the motion was ended meanwhile."""
        if told := self.answer("wait"):
            raise PlayedOutError(f"the motion was ended: {told}")

    def pose(self) -> PoseHandover | None:
        """The newest pose."""
        if answer := self.answer("pose"):
            stamp, sent = answer
            if stamp not in self._poses:
                raise PartedError(f"the pose of {stamp:.3f} s is not in the recording")
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
        if not self._calls or self._calls[0][:2] != (self._passed, self._count):
            return None
        if self._calls[0][2] != kind:
            self._missed(kind)
        answer = self._calls.popleft()[3]
        if isinstance(answer, dict) and UNPLUGGED in answer:
            raise UnpluggedError(answer[UNPLUGGED])
        if isinstance(answer, dict) and REFUSED in answer:
            raise _RefusedError(answer[REFUSED])
        return answer

    def flush(self) -> None:
        """Nothing is kept."""

    def take(self, frame: bytes, recorded: bytes) -> None:
        """The driver is given something."""
        self._taken(PlayedFrame(self._instant, frame, recorded))

    def _order(self, told: Sequence[Any]) -> LoopOrder:
        kind, *rest = told
        if kind == "begin":
            outlets = {name: Outlet(SwitchDelay(**delay), tuple(at)) for name, delay, at in rest[1]}
            return self._begin(rest[0], outlets)
        return Order(rest[0]) if kind == "arm" else PauseOrder(rest[0])

    def _fill(self, optional: bool = False) -> None:
        """Go on to the next record. optional: of what may be the last one."""
        record = next(self._records, None)
        if record is None:
            if optional:
                return
            raise PlayedOutError("all is played")
        if record["number"] != self._number:
            raise PartedError(f"after {self._instant:.3f} s a part of the recording is missing")
        self._number += 1
        self._readings.extend(record["readings"])
        self._calls.extend((row[0], row[1], row[2], row[3]) for row in record["calls"])
        self._passed = 0

    def _missed(self, kind: str = "the clock") -> None:
        asked = self._calls[0][2]
        raise PartedError(f"after {self._instant:.3f} s the loop asked for {asked!r} then, and now for {kind!r}")


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


def _reported_from_list(told: Sequence[Any]) -> Reported:
    stamp, replies, strays, fault, busy = told
    known = tuple(Reply(ReplyKind(kind), np.array(values, float)) for kind, values in replies)
    return Reported(stamp, known, base64.b64decode(strays), fault, busy)


def _sent_from_rows(rows: Sequence[Any]) -> list[Sent]:
    known: dict[str, Callable[..., G1 | G4 | G54 | Pause | None]] = {
        "G1": lambda axes, feed, material: G1(np.array(axes, float), feed, material),
        "G4": G4,
        "G54": lambda origin: G54(np.array(origin, float)),
        "pause": Pause,
        "part": lambda: None,
    }
    return [Sent(known[row[1]](*row[2:]), row[0]) for row in rows if row != ["nothing"]]
