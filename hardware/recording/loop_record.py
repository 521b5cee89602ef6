"""What a print's loop was given, recorded, so that the same loop on a virtual clock sends the same bytes again.

A print has one loop (`hardware/motion/print_loop.py`). It reads no clock and no device: all that it cannot compute
comes through its `LoopSource`. A live run and a simulation give it theirs in a `RecordingSource`, which notes what it
hands on; a replay gives it a `PlayedSource` (`hardware/live/recorded_run.py`), which hands on what was noted. Whatever
stands behind the source is then neither needed nor asked: cameras, arm, operator, dispensers, the machine's clock.

A record holds the readings of the clock in order, and of all other calls those whose answer was not the usual one, each
by the number of readings before it and of calls since the last. What is given to the arm's driver is always noted.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path as File
from typing import Any, TypeVar

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.driver import G1, G4, G54, ArmDriver, Pause, Reported, Sent, UnpluggedError
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import encode
from hardware.motion.loop import MaterialControl, Order
from hardware.motion.print_loop import LoopOrder, LoopSettings
from hardware.motion.step import BeginPrint, PoseHandover
from hardware.process.clock import Clock
from planning.material import FlowShares, message_from_flow

LOOP_ARM_ATTACHMENT = "loop_arm.toml"  # the arm as it was known when the loop began
START = "start"  # kind of the first call: the settings
UNPLUGGED, REFUSED = "unplugged", "refused"  # keys of a call that raised: UnpluggedError, InputError
Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True, eq=False)
class LoopRecord:
    """A part of what a loop was given: what came from one tick to the next."""

    number: int  # from 0 on, so that one that is missing is noticed
    readings: tuple[float, ...]  # s, of the clock, in order
    calls: tuple[tuple[int, int, str, Any], ...]  # readings in this record before it, calls since, kind, answer

    @property
    def stamp(self) -> float:
        """The last reading, s; 0 without."""
        return self.readings[-1] if self.readings else 0.0

    @property
    def message(self) -> dict[str, Any]:
        """For the recording."""
        return {"stamp": self.stamp, "number": self.number, "readings": self.readings, "calls": self.calls}


def drop_record(record: LoopRecord) -> None:
    """Where nobody keeps them."""


class RecordingSource:
    """Hands on what a live run or a simulation gives, and notes it. Each record is put at `flush`."""

    def __init__(
        self,
        clock: Clock,
        driver: ArmDriver,
        pose: Callable[[], PoseHandover | None],
        orders: Callable[[], Sequence[LoopOrder]],
        put: Callable[[LoopRecord], None],
        profile: ArmProfile,
        material: MaterialControl | None = None,
        settings: LoopSettings | None = None,
    ) -> None:
        """profile: of the arm, as LOOP_ARM_ATTACHMENT has it. material: None where nothing flows."""
        self.material = material
        self._clock, self._pose_source, self._order_source, self._put_record = clock, pose, orders, put
        self._readings: list[float] = []
        self._calls: list[tuple[int, int, str, Any]] = []
        self._count = self._number = 0
        self._last_handover: PoseHandover | None = None
        settings = LoopSettings() if settings is None else settings
        start = {"link": asdict(settings.link)} | ({} if settings.until is None else {"until": settings.until})
        self.note(START, start)
        self.driver: ArmDriver = _NotedDriver(driver, self, profile)

    def now(self) -> float:
        """The clock, s."""
        instant = self._clock.now()
        self._readings.append(instant)
        self._count = 0
        return instant

    def wait_until(self, instant: float) -> None:
        """Wait until `instant`, s."""
        try:
            self._clock.wait_until(instant)
        except BaseException as error:  # of a simulated motion that is killed
            self.note("wait", type(error).__name__)
            raise
        self.note("wait", "")

    def pose(self) -> PoseHandover | None:
        """The newest pose."""
        handover = self._pose_source()
        is_new = handover is not self._last_handover and handover is not None
        self._last_handover = handover
        self.note("pose", [handover.pose.stamp, handover.sent] if is_new and handover is not None else [])
        return handover

    def orders(self) -> Sequence[LoopOrder]:
        """The orders since the last call."""
        orders = self._order_source()
        self.note("orders", [_text_from_order(order) for order in orders])
        return orders

    def dry(self) -> str:
        """Why material cannot flow now."""
        reason = "" if self.material is None else self.material.reason
        self.note("dry", reason)
        return reason

    def note(self, kind: str, answer: Any) -> None:
        """A call was answered; an empty answer is the usual one."""
        self._count += 1
        if answer:
            self._calls.append((len(self._readings), self._count, kind, answer))

    def flush(self) -> None:
        """Put what was noted since the last time."""
        if self._readings or self._calls:
            self._put_record(LoopRecord(self._number, tuple(self._readings), tuple(self._calls)))
            self._number += 1
            self._readings, self._calls = [], []


class _NotedDriver(ArmDriver):
    """A driver whose answers are noted."""

    def __init__(self, driver: ArmDriver, source: RecordingSource, profile: ArmProfile) -> None:
        self._driver, self._note, self._dialect = driver, source.note, profile.dialect

    @property
    def origin(self) -> Array:  # type: ignore[override]
        return self._driver.origin

    def close(self) -> None:
        self._driver.close()

    def release(self) -> None:
        self._driver.release()

    def connect(self, now: float) -> None:
        self._noted("connect", lambda: self._driver.connect(now), lambda nothing: "")

    def state(self, now: float) -> Reported:
        return self._noted("state", lambda: self._driver.state(now), _list_from_reported)

    def send(self, instruction: G1 | G4, now: float) -> Sequence[Sent]:
        frame = base64.b64encode(encode(instruction, self._dialect)).decode("ascii")
        usual = (Sent(instruction),)
        return self._noted(
            "send", lambda: self._driver.send(instruction, now), lambda sent: [frame, _rows(sent, usual)]
        )

    def stop(self, now: float) -> Sequence[Sent]:
        usual = (Sent(Pause()),)
        return self._noted("stop", lambda: self._driver.stop(now), lambda sent: ["", _rows(sent, usual)])

    def set_origin(self, origin: Array, now: float) -> Sequence[Sent]:
        call = lambda: self._driver.set_origin(origin, now)  # noqa: E731
        return self._noted("set_origin", call, lambda sent: [origin.tolist(), _rows(sent, ())])

    def flush(self, now: float) -> Sequence[Sent]:
        return self._noted("flush", lambda: self._driver.flush(now), lambda sent: _rows(sent, ()))

    def enable(self, now: float) -> str:
        return self._noted("enable", lambda: self._driver.enable(now), str)

    def home(self, now: float) -> bool:
        return self._noted("home", lambda: self._driver.home(now), bool)

    def recall(self) -> None:
        self._driver.recall()

    def blocked_for(self, now: float) -> float | None:
        return self._noted("blocked_for", lambda: self._driver.blocked_for(now), lambda s: [] if s is None else [s])

    def waiting(self) -> float:
        return self._noted("waiting", self._driver.waiting, float)

    def _noted(self, kind: str, call: Callable[[], Answer], encode_answer: Callable[[Answer], Any]) -> Answer:
        try:
            answer = call()
        except UnpluggedError as error:
            self._note(kind, {UNPLUGGED: str(error)})
            raise
        except InputError as error:
            self._note(kind, {REFUSED: str(error)})
            raise
        self._note(kind, encode_answer(answer))
        return answer


class LoopKeeper:
    """Keeps a loop in a recording: its arm, the order that began to print, and its records."""

    def __init__(self, attach: Callable[[str, bytes], None], write: Callable[[LoopRecord], None]) -> None:
        """attach: keeps a text in the recording, by its name."""
        self._attach, self.write = attach, write

    def arm(self, profile: ArmProfile) -> ArmProfile:
        """The arm as its recorded text has it, to the last digit."""
        text, recorded = recorded_arm(profile)
        self._attach(LOOP_ARM_ATTACHMENT, text.encode())
        return recorded

    def begun(self, order: BeginPrint) -> BeginPrint:
        """The order as its recorded texts have it, likewise."""
        texts, recorded = recorded_begin(order)
        for name, text in texts.items():
            self._attach(name, text.encode())
        return recorded


def recorded_arm(profile: ArmProfile) -> tuple[str, ArmProfile]:
    """The text of an arm, and the arm with what is read of that text; its extruder is in the dispensers' text."""
    from hardware.files.arm_file import arm_from_text, arm_text

    text = arm_text(profile, "as the loop of a print had it at first", whole=True)
    return text, replace(arm_from_text(text, LOOP_ARM_ATTACHMENT), extruder=profile.extruder)


def recorded_begin(order: BeginPrint, dispensers: str = "") -> tuple[dict[str, str], BeginPrint]:
    """Path, arm and dispensers of an order as texts for the recording, and the order with what is read of those texts.

    dispensers: text of their file, "" without one, where the order keeps its outlets.
    """
    from hardware.files.path_file import tissue_text
    from hardware.recording.session_reader import input_texts, inputs_from_texts  # loads what the motion must not

    tissue = "" if order.tissue is None else tissue_text(order.tissue)
    texts = input_texts(order.path, order.profile, dispensers, tissue)
    inputs = inputs_from_texts(texts, File("kept"))
    outlets = inputs.outlets if dispensers else order.outlets
    return texts, replace(order, path=inputs.path, profile=inputs.profile, outlets=outlets, tissue=inputs.tissue)


def _text_from_order(order: LoopOrder) -> list[Any]:
    if isinstance(order, BeginPrint):
        outlets = [[name, asdict(each.delay), list(each.offset)] for name, each in order.outlets.items()]
        return ["begin", order.start, outlets]
    if isinstance(order, FlowShares):
        return ["flow", message_from_flow(order)]
    return ["arm" if isinstance(order, Order) else "print", order.value]


def _list_from_reported(reported: Reported) -> list[Any]:
    if not (reported.replies or reported.strays or reported.fault or reported.busy):
        return []
    replies = [[int(reply.kind), reply.values.tolist()] for reply in reported.replies]
    return [reported.stamp, replies, base64.b64encode(reported.strays).decode("ascii"), reported.fault, reported.busy]


def _rows(sent: Sequence[Sent], usual: Sequence[Sent]) -> list[Any]:
    """What has gone out, each [share, kind, numbers]; nothing where it is the usual."""
    pairs = [(each.instruction, each.share) for each in sent]
    if pairs == [(each.instruction, each.share) for each in usual]:
        return []
    return [[share, *_words(instruction)] for instruction, share in pairs] or [["nothing"]]


def _words(instruction: G1 | G4 | G54 | Pause | None) -> list[Any]:
    if isinstance(instruction, G1):
        return ["G1", instruction.axes.tolist(), float(instruction.feed), bool(instruction.material)]
    if isinstance(instruction, G4):
        return ["G4", float(instruction.duration)]
    if isinstance(instruction, G54):
        return ["G54", instruction.origin.tolist()]
    return ["part" if instruction is None else "pause"]
