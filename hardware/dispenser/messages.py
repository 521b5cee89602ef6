"""What a dispenser is told, as templates: text lines, bytes in hex or HTTP requests, and presets for known devices.

A template is one line or several; `{name}` is replaced by a number, by default with four significant digits and no
exponent; a form after a colon, as in `{flow_ul_min:.1f}`, is Python's. A line that begins with `hex:` is sent as those
bytes, without a line end. 1 mm^3 is 1 ul.

Messages wait in one queue. One that is partly out is completed: torn, it would take bytes of the next one with it. An
urgent one goes before all others that wait.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from enum import Enum
from string import Formatter

import numpy as np

from estimation.errors import InputError
from hardware.arm.port import Port

HEX = "hex:"
PATTERNS = ("answer", "alarm")  # of DispenserMessages: regular expressions, not templates
_MINUTES, _HOURS = 60.0, 3600.0


@dataclass(frozen=True, slots=True)
class MessageValues:
    """The numbers that templates may name."""

    flow: float = 1.0  # mm^3/s
    celsius: float = 20.0
    volume: float = 0.0  # mm^3 of a prime or a retract
    step: float = 0.05  # s between two keepalives
    plunger: float | None = None  # mm^2, cross-section of what is pushed; without it, no lengths

    def table(self) -> dict[str, float]:
        """The numbers by their names."""
        flow, volume, step = self.flow, self.volume, self.flow * self.step
        table = {"flow_mm3_s": flow, "flow_ul_s": flow, "flow_ul_min": flow * _MINUTES, "flow_ul_h": flow * _HOURS}
        table |= {"flow_ml_min": flow * _MINUTES / 1000, "flow_ml_h": flow * _HOURS / 1000}
        table |= {"volume_ul": volume, "volume_ml": volume / 1000, "step_ul": step, "celsius": self.celsius}
        if self.plunger is not None:
            table |= {"flow_mm_s": flow / self.plunger, "flow_mm_min": flow * _MINUTES / self.plunger}
            table |= {"step_mm": step / self.plunger, "volume_mm": volume / self.plunger}
        return table


class _ShortNumber(float):
    """Four significant digits, no exponent, unless another form is asked for."""

    def __format__(self, form: str) -> str:
        if form:
            return super().__format__(form)
        return np.format_float_positional(self, precision=4, unique=False, fractional=False, trim="-")


def message_lines(template: str, end: str, values: MessageValues) -> list[bytes]:
    """The lines of a template as bytes. InputError ("messages") for a name or a form that there is not."""
    table = {name: _ShortNumber(value) for name, value in values.table().items()}
    try:
        for _, name, _, _ in Formatter().parse(template):
            if name is not None and name not in table:
                lengths = "" if values.plunger is not None else "; lengths in mm need plunger_mm2"
                raise InputError("messages", "", template, f"the names {', '.join(table)}{lengths}")
        lines = template.format_map(table).splitlines()
        return [bytes.fromhex(t.removeprefix(HEX)) if t.startswith(HEX) else (t + end).encode("ascii") for t in lines]
    except (ValueError, LookupError, UnicodeEncodeError) as error:
        raise InputError(
            "messages", "", template, f"ASCII text with names in braces, or hex: and bytes ({error})"
        ) from None


@dataclass(frozen=True, slots=True)
class DispenserMessages:
    """What a device is told for each call; "" where it is told nothing. InputError names what makes no sense."""

    on: str  # let material out
    off: str  # stop it
    prepare: str = ""  # after its line is opened; lets no material out
    flow: str | None = None  # another flow while it is on; None: as `on`; "": the next keepalive says it
    prime: str = ""  # before `on`, where material was drawn back before
    retract: str = ""  # after an `off` that ended a flow
    keepalive: str = ""  # again and again while it is on
    temperature: str = ""  # set it
    temperature_query: str = ""  # ask for it, each second
    answer: str = ""  # pattern of an answer whose group is the temperature, degrees C
    alarm: str = ""  # pattern of an answer by which the device says that it has failed
    end: str = "\n"  # of each line

    def __post_init__(self) -> None:
        for name in ("on", "off"):
            if not getattr(self, name):
                raise InputError("messages", name, "", "a line or more")
        for name in PATTERNS:
            try:
                groups = re.compile(getattr(self, name)).groups
            except re.error as error:
                raise InputError("messages", name, getattr(self, name), f"a regular expression ({error})") from None
            if name == "answer" and self.answer and groups != 1:
                raise InputError("messages", name, self.answer, "a regular expression with one group, the temperature")

    def check(self, values: MessageValues) -> None:
        """InputError for a template that names a number that there is not."""
        for name in (f.name for f in fields(self) if f.name not in (*PATTERNS, "end")):
            try:
                message_lines(getattr(self, name) or "", self.end, values)
            except InputError as error:
                raise InputError("messages", name, error.got, error.allowed) from None


@dataclass(frozen=True, slots=True)
class DispenserLine:
    """How a device is reached and what it is told; the port is a device's path, a URL of pyserial's, or http://."""

    messages: DispenserMessages
    port: str = ""
    baud: int = 9600  # bits/s, 8N1
    start: float = 0.0  # s after opening in which it takes in nothing but an off: it resets and starts
    gap: float = 0.0  # s between two lines, for a device that must answer one before the next; an off does not wait
    keepalive: float = 0.04  # s between two of them: two may be lost within a watchdog of 100 ms, and one may be late
    timeout: float = 0.05  # s; a line that takes nothing for twice that has failed; of an HTTP request
    plunger: float | None = None  # mm^2


class MessageKind(Enum):
    """What a message is for; an off drops what would let material out."""

    OFF = "off"
    RETRACT = "retract"
    SETUP = "setup"  # prepare, temperature and questions for it
    ON = "on"  # prime included
    FLOW = "flow"  # another one
    KEEPALIVE = "keepalive"


@dataclass(frozen=True, slots=True)
class Message:
    """One line on its way."""

    data: bytes
    kind: MessageKind
    taken: Callable[[float], None] | None = None  # told the instant, s, at which the line had it all
    urgent: bool = False  # waits for no gap


class MessageQueue:
    """Messages on their way to one port. sent: s, when it last had a whole line."""

    def __init__(self, gap: float) -> None:
        """gap: s between two lines, which an urgent one does not keep."""
        self._gap = gap
        self.restart(-math.inf)

    def restart(self, open_at: float) -> None:
        """Forget everything. open_at: s, until when only urgent messages are sent."""
        self._messages: deque[Message] = deque()
        self._done = 0  # bytes of the first message that are out
        self._open_at, self.sent = open_at, -math.inf
        self._refused = False  # whether the port took nothing when it was last asked
        self._blocked: float | None = None  # s, since when the line takes nothing

    def __len__(self) -> int:
        return len(self._messages)

    def __contains__(self, kind: MessageKind) -> bool:
        return any(message.kind is kind for message in self._messages)

    def waits(self, kind: MessageKind, urgent: bool = False) -> bool:
        """Whether there is one of this kind of which no byte is out. urgent: and that waits for no gap."""
        waiting = list(self._messages)[self._begun :]
        return any(message.kind is kind and message.urgent >= urgent for message in waiting)

    def put(self, messages: Iterable[Message]) -> None:
        """Queue messages."""
        self._messages.extend(messages)

    def put_first(self, messages: Iterable[Message], behind: MessageKind | None = None) -> None:
        """Put messages before all that wait, but for those of the kind `behind`."""
        queue = list(self._messages)
        at = next((i for i in range(len(queue), self._begun, -1) if queue[i - 1].kind is behind), self._begun)
        self._messages = deque([*queue[:at], *messages, *queue[at:]])

    def drop(self, *kinds: MessageKind) -> None:
        """Take back messages of these kinds of which no byte is out."""
        queue = list(self._messages)
        self._messages = deque(m for i, m in enumerate(queue) if i < self._begun or m.kind not in kinds)

    def send(self, port: Port, now: float) -> None:
        """Give the port what it takes. UnpluggedError of the port."""
        while self._messages:
            message = self._messages[0]
            if not (message.urgent or self._done) and now < max(self._open_at, self.sent + self._gap):
                return
            if message.data:
                free = port.waiting() == 0
                written = port.write(message.data[self._done :])
                self._done += written
                self._refused = not written
                if self._refused or not free:
                    self._blocked = now if self._blocked is None else self._blocked
                if self._refused:
                    return
                if self._done < len(message.data):
                    continue
                self.sent, self._blocked = now, None if free else self._blocked
            self._messages.popleft()
            self._done = 0
            if message.taken is not None:
                message.taken(now)

    def blocked_for(self, port: Port, now: float) -> float:
        """Seconds for which the port has taken nothing, or bytes have waited in the system; 0 where it is free."""
        if port.waiting() > 0:
            self._blocked = now if self._blocked is None else self._blocked
        elif not self._refused:
            self._blocked = None
        return 0.0 if self._blocked is None else now - self._blocked

    def idle(self, port: Port) -> bool:
        """Whether the port has all bytes of what was begun, and the wire has them."""
        return not self._done and port.waiting() == 0

    @property
    def _begun(self) -> int:
        return 1 if self._done else 0


@dataclass(frozen=True, slots=True)
class Preset:
    """A kind of device: its usual line, and what is true of each."""

    summary: str
    line: DispenserLine
    metered: bool = False
    watchdog: float | None = None  # s
    flow_range: tuple[float, float] = (0.001, 1000.0)  # mm^3/s that its messages can say
    settings: tuple[str, ...] = field(default=())  # keys that a file has to give for it


_STEP = "G1 E{step_mm:.5f} F{flow_mm_min:.3f}"
_HEAT = {
    "temperature": "M104 S{celsius}",
    "temperature_query": "M105",
    "answer": r"T:(-?\d+\.?\d*)",
    "alarm": r"^(?:Error|!!)",
}
PRESETS = {
    "arduino": Preset(
        "a sketch that reads ON, OFF, K (keepalive), T 37 and T? as lines, and switches itself off after 100 ms",
        DispenserLine(
            DispenserMessages(
                on="ON",
                off="OFF",
                keepalive="K",
                temperature="T {celsius}",
                temperature_query="T?",
                answer=r"^T ?(-?\d+\.?\d*)",
                alarm="^FAIL",
            ),
            baud=115_200,
            start=2.0,  # s, its boot loader
        ),
        watchdog=0.1,
    ),
    "new_era": Preset(
        "a New Era syringe pump, RS-232 basic mode; the syringe's diameter is set at the pump or in `prepare`",
        DispenserLine(
            DispenserMessages(
                prepare="DIR INF\nVOL 0",
                on="RAT {flow_ul_min} UM\nRUN",
                flow="RAT {flow_ul_min} UM",
                off="STP",
                alarm=r"A\?[RSTEO]|\?OOR",
                end="\r",
            ),
            baud=19_200,
            gap=0.05,
        ),
        metered=True,
        flow_range=(0.02, 160.0),  # four digits of ul/min
    ),
    "chemyx": Preset(
        "a Chemyx syringe pump; diameter and volume are set at the pump or in `prepare`",
        DispenserLine(
            DispenserMessages(
                prepare="set units 2",
                on="set rate {flow_ul_min}\nstart",
                flow="set rate {flow_ul_min}",
                off="stop",
                end="\r",
            ),
            baud=9600,
            gap=0.1,
        ),
        metered=True,
    ),
    "gcode_valve": Preset(
        "a valve at the fan output of a G-code controller",
        DispenserLine(DispenserMessages(on="M106 S255", off="M107", **_HEAT), baud=115_200, start=2.0),
    ),
    "gcode_extruder": Preset(
        "an extruder on a G-code controller, fed in steps that each last one keepalive; it stops when none comes",
        DispenserLine(
            DispenserMessages(
                prepare="M83",
                on=f"{_STEP}\n{_STEP}",
                flow="",
                keepalive=_STEP,
                off="M410",
                retract="G1 E-{volume_mm:.5f} F600",
                prime="G1 E{volume_mm:.5f} F600",
                **_HEAT,
            ),
            baud=115_200,
            start=2.0,
            keepalive=0.05,
        ),
        metered=True,
        watchdog=0.11,  # s, what two steps last, and rounding
        settings=("plunger_mm2",),
    ),
    "usb_relay": Preset(
        "channel 1 of an LCUS-1 USB relay, which switches a valve, a pump or a regulator",
        DispenserLine(DispenserMessages(on="hex:A0 01 01 A2", off="hex:A0 01 00 A1"), baud=9600),
    ),
    "http": Preset(
        "a device that is switched by HTTP requests",
        DispenserLine(DispenserMessages(on="GET /on", off="GET /off"), timeout=0.5),
    ),
}
