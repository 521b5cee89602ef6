"""The driver of a machine that speaks Marlin's G-code, such as a bioprinter on a gantry: gcode:///dev/ttyACM0.

Each line has a number and a checksum; the firmware answers `ok` once a move is in its planner, or asks for it again. No
more than LINES are unanswered at a time, so that little but the motion in flight stands between a stop and rest. A
stop is M410, which a firmware with an emergency parser obeys ahead of all that waits: the axes halt and know where they
are. Where nobody is left to drive it, it is M112, which halts the firmware until it is reset.

M114 tells twice where the machine is: X Y Z, where its planner ends, and Count, the steps that its motors have made.
With Count and the steps per mm (M92) its place is known at each instant; a firmware that gives no Count in steps of X Y
Z is taken by its word, and its lag is then not what it tells. It does not turn: A B C stay where the arm file has them,
and X Y Z alone are sent. It is never homed from here, as G28 drives the needle down to where Z ends.

With an `Extruder`, its axis E goes with the moves of a bead, relative (M83): a line pushes what its own move is to lay,
so a machine that gets no lines, or is stopped, pushes nothing. After a bead E draws back, also in a pause. What that
takes is counted as lines go out, so that a move that is taken back changes nothing.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.driver import G1, G4, ByteListener, Pause, Reply, ReplyKind, Reported, Sent
from hardware.arm.port import Opener, PortOpener, serial_ports, write_last
from hardware.arm.profile import ArmProfile, Extruder
from hardware.arm.s6h4d import SerialDriver
from planning.command import TICK_FRACTION

SCHEME = "gcode://"
LINES = 2  # that may be unanswered: a move, and the question where it is
ASK_PERIOD = 0.05  # s between questions where it is
ANSWER_TIME = 0.08  # s after which a line or its answer counts as lost: a quick firmware takes 2 ms, a slow one 20
MAX_ANSWER_TIME = 1.0  # s, likewise of one that says nothing: it doubles with each line that was lost
GREETING_TIME = 1.0  # s between greetings of a machine that has said nothing yet: a board starts for as long
REMEMBERED = 64  # lines that may be asked for again: a second of them
MIN_STEPS_PER_MM = 1.0  # of an axis: fewer are no machine's that prints
PLACE_DIGITS, PUSH_DIGITS = 4, 5  # of mm, in a line: of X Y Z, and of E
MAX_LINE = 512  # bytes of a line from the machine: what is longer came at another baud rate
STOP = b"M410\n"  # without a number: it overtakes lines that have one
GREETING = "M115", "G21", "G90", "M92", "M400", "M114"  # who it is; mm; absolute; steps per mm; at rest, where is it?
RELATIVE_E = "M83"  # behind G90, which makes E absolute as well
FIRMWARE = re.compile(r"FIRMWARE_NAME: ?(.*?)(?= [A-Z_]+:|$)")
PLACE = re.compile(r"X: ?(-?[\d.]+) +Y: ?(-?[\d.]+) +Z: ?(-?[\d.]+)")
COUNT = re.compile(r"Count:? *X: ?(-?\d+) +Y: ?(-?\d+) +Z: ?(-?\d+)")
STEPS = re.compile(r"M92 X([\d.]+) Y([\d.]+) Z([\d.]+)")
RESEND = re.compile(r"(?:Resend|rs):? *N?:?(\d+)", re.IGNORECASE)
# in a line that tells of an error
HALTED = re.compile(r"halted|kill|fatal|(max|min)temp|thermal|stopped|^!!", re.IGNORECASE)
COLD = re.compile("cold extrusion", re.IGNORECASE)
KNOWN = "marlin"  # in the name of the firmware


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """What is given out as one line."""

    text: str  # "" of an instruction, which becomes a line as it goes out
    instruction: G1 | G4 | None = None
    anchor: bool = False  # of an M114: the machine rests, so that its planner and its steps are at one place


class GcodeMachine(SerialDriver):
    """Marlin, on a serial line; `state` greets it."""

    def __init__(self, address: str, opener: Opener, profile: ArmProfile, listener: ByteListener | None = None) -> None:
        """address: as the operator gave it. Otherwise as SerialDriver's."""
        self._address, self._turn = address, profile.arm.home[3:].copy()
        self._axis = None if profile.extruder is None else _PushedAxis(profile.extruder)
        self._greeting = GREETING if profile.extruder is None else (*GREETING, RELATIVE_E)
        self._spare = TICK_FRACTION * profile.tick / 2  # s that E has in any line: ticks may be half as long
        super().__init__(opener, listener)

    def _reset(self) -> None:
        self._waiting: deque[Line] = deque()  # to be given out
        self._wait_start = 0.0  # s, when the first of them was to go
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=REMEMBERED)  # number and bytes, to be asked for again
        self._resends: deque[bytes] = deque()  # that were asked for
        self._unanswered: deque[tuple[int, float]] = deque()  # number, and s when it went
        self._query: tuple[float, bool] | None = None  # s, when M114 went, and whether the machine rests
        self._stop_pending = False  # a stop is on its way out
        self._number, self._resend = 0, 0  # of the last line; from which to send again, 0: none
        self._rest, self._unwritten = b"", b""  # of a line from the machine, and to it
        self._firmware = self._fault = ""
        self._steps: Array | None = None  # (3,) per mm
        self._offset: Array | None = None  # (3,) mm, place less steps made
        self._query_time, self._greeting_time = 0.0, -np.inf  # s
        self._answer_timeout = ANSWER_TIME  # s, for an answer
        self._place_known = False  # whether it has said where it is
        self._last_place: Array | None = None  # (3,) mm, where the last line leads; None: not known

    # -- the machine's words

    def state(self, now: float) -> Reported:
        """Where it is, by what has come; greet it, ask it again, or send again what was lost."""
        assert self.port is not None
        *lines, rest = (self._rest + self.port.read()).split(b"\n")
        self._rest = rest[-MAX_LINE:]
        replies: list[Reply] = []
        stamp = now
        for line in lines:
            if (place := self._take(line.decode("ascii", "replace").strip(), now)) is not None:
                stamp, axes = place
                replies = [Reply(ReplyKind.PLACE, axes), Reply(ReplyKind.TOOL, self._turn)]
        self._maintain(now)
        return Reported(stamp, replies, b"", self._fault)

    def _take(self, line: str, now: float) -> tuple[float, Array] | None:
        """Take a line; the instant, s, and the place (3,) that it tells of, None where it tells of none."""
        place = PLACE.search(line)
        if line.startswith("ok"):
            self._count_answer()
        elif line == "start":
            if self._place_known:
                self._fault = "the machine has started anew and may not know where it is: home it, then arm"
            self._greet(now)
        elif match := RESEND.match(line):
            self._resend = int(match[1])
        elif (line.startswith(("Error", "echo:", "fatal", "!!"))) and HALTED.search(line):
            self._fault = f"the machine says: {line}; it has to be reset"
        elif COLD.search(line) and self._axis is not None:
            self._fault = f"the machine says: {line}; M302 P1 lets it push material that is cold"
        if match := FIRMWARE.search(line):
            self._firmware = match[1]
        if match := STEPS.search(line):
            steps = np.array(match.groups(), float)
            self._steps = steps if (steps >= MIN_STEPS_PER_MM).all() else None
        if place is None or self._query is None:
            return None
        (query_time, at_rest), self._query = self._query, None
        return (query_time + now) / 2, self._place(np.array(place.groups(), float), COUNT.search(line), at_rest)

    def _place(self, planned: Array, count: re.Match[str] | None, at_rest: bool) -> Array:
        """The place (3,), mm, from where the planner ends and the steps that were made."""
        self._place_known = True
        if self._steps is None or count is None:
            return planned
        travelled = np.array(count.groups(), float) / self._steps
        if at_rest or self._offset is None:
            self._offset = planned - travelled
        return np.asarray(travelled + self._offset)

    def _count_answer(self) -> None:
        self._answer_timeout = ANSWER_TIME
        if self._unanswered:
            self._unanswered.popleft()
        if self._resend and not self._unanswered:
            self._resends = deque(data for number, data in self._sent if number >= self._resend)
            self._resend = 0

    def _maintain(self, now: float) -> None:
        """Greet a machine that says nothing, send again what was lost, and ask where it is."""
        if not self._place_known and now > self._greeting_time + GREETING_TIME:
            self._greet(now)
        if self._place_known and self._unanswered and now > self._unanswered[0][1] + self._answer_timeout:
            first = self._unanswered[0][0]
            first, self._resend = min(first, self._resend or first), 0
            self._resends = deque(data for number, data in self._sent if number >= first)
            self._unanswered.clear()  # a line that it has had already, it answers by asking for the next one
            self._answer_timeout = min(2 * self._answer_timeout, MAX_ANSWER_TIME)
        if self._place_known and not self._waiting and now > self._query_time + ASK_PERIOD:
            self._waiting.append(Line("M114"))

    def _greet(self, now: float) -> None:
        """Count lines from 1, learn who it is, and where."""
        self._greeting_time, self._place_known, self._offset = now, False, None
        self._restart_numbering(self._greeting, now)

    def _restart_numbering(self, texts: Sequence[str], now: float) -> None:
        """Number lines from 0, with `texts` next; nothing that was given before is sent, or sent again."""
        for lines in (self._waiting, self._sent, self._resends, self._unanswered):
            lines.clear()
        self._number, self._resend, self._query, self._last_place = -1, 0, None, None
        self._waiting.extend(Line(text, anchor=text == "M114") for text in ("M110 N0", *texts))
        self._wait_start = now

    # -- what it is given

    def send(self, instruction: G1 | G4, now: float) -> Sequence[Sent]:
        """Give out a move; in a pause nothing is sent but what is left to be drawn back."""
        if isinstance(instruction, G4):
            pushed = self._axis is not None and self._axis.pressed
            return self._enqueue(Line("", instruction), now) if pushed else (Sent(instruction),)
        if np.abs(instruction.axes[3:] - self._turn).max() > 1e-6:
            got, allowed = np.rad2deg(instruction.axes[3:]).tolist(), f"{np.rad2deg(self._turn).tolist()} degrees"
            raise InputError("arm", "A B C", got, f"{allowed}: a G-code machine does not turn")
        return self._enqueue(Line("", instruction), now)

    def _line(self, order: G1 | G4) -> tuple[str, G1 | G4]:
        """The text of an instruction that goes out now, "" where nothing has to, and what the machine does by it."""
        if isinstance(order, G4):
            push = self._pushed(0.0, 0.0)
            return (f"G1{push.word} F{push.feed(push.seconds):.3f}", G4(push.seconds)) if push.word else ("", order)
        axes = np.concatenate([np.round(order.axes[:3], PLACE_DIGITS), self._turn])
        goal = "G1" + "".join(f" {name}{v:.{PLACE_DIGITS}f}" for name, v in zip("XYZ", axes[:3].tolist(), strict=True))
        previous, self._last_place = self._last_place, axes[:3]
        length = 0.0 if previous is None else float(np.linalg.norm(axes[:3] - previous))
        seconds = length / order.feed
        push = self._pushed(order.volume, seconds)
        if push.word and previous is not None:  # what it pushes takes its time
            seconds = max(seconds, push.seconds)
            if not length:  # the feed of such a line is E's
                return f"{goal}{push.word} F{push.feed(seconds):.3f}", G4(seconds)
            feed = max(np.floor(60_000 * length / seconds), 1) / 1000  # mm/min, down: E is at its speed's limit
            return f"{goal}{push.word} F{feed:.3f}", replace(order, axes=axes, feed=feed / 60)
        feed = max(round(60 * order.feed, 1), 0.1)  # mm/min
        return f"{goal}{push.word} F{feed:g}", replace(order, axes=axes, feed=feed / 60)

    def _pushed(self, volume: float, seconds: float) -> Push:
        """What E does in a line of `seconds` s of which `volume`, mm^3, is to leave."""
        return NO_PUSH if self._axis is None else self._axis.push(volume, max(seconds, self._spare))

    def stop(self, now: float) -> Sequence[Sent]:
        """Halt the axes; what it was given and has not read is not sent again."""
        assert self.port is not None
        self._unwritten += STOP
        self._restart_numbering(("M400", "M114") if self._place_known else self._greeting, now)
        self._stop_pending = True
        return self._write(now)

    def enable(self, now: float) -> str:
        """Whether it is a Marlin, has said where it is, and does not stand halted."""
        if self._fault:
            self._fault = ""
            self._greet(now)
            return "the machine is greeted again: see that it is homed, then arm once more"
        if not self._place_known:
            return (
                f"nothing at {self._address} answers as a G-code machine: is it on, and `baud` of the arm file its own?"
            )
        if KNOWN not in self._firmware.lower():
            return f"its firmware is {self._firmware or 'unnamed'}: only Marlin's stop, M410, is known here"
        return ""

    def flush(self, now: float) -> Sequence[Sent]:
        """Give out what waits."""
        return self._write(now)

    def recall(self) -> None:
        """Take back the moves of which no byte is out."""
        self._waiting = deque(line for line in self._waiting if line.instruction is None)

    def blocked_for(self, now: float) -> float | None:
        """Seconds that a move has waited."""
        blocked = self._stop_pending or any(line.instruction is not None for line in self._waiting)
        return now - self._wait_start if blocked else None

    def _enqueue(self, line: Line, now: float) -> Sequence[Sent]:
        if not self._waiting:
            self._wait_start = now
        self._waiting.append(line)
        return self._write(now)

    def _write(self, now: float) -> Sequence[Sent]:
        """Write what was asked for again, then what waits, while few lines are unanswered."""
        out: list[Sent] = []
        while self._write_rest(out) and len(self._unanswered) < LINES and not self._resend:
            if self._resends:
                self._unwritten = self._resends.popleft()
                self._unanswered.append((int(self._unwritten[1 : self._unwritten.index(b" ")]), now))
                continue
            is_query = bool(self._waiting) and self._waiting[0].text == "M114"
            if not self._waiting or (is_query and self._query is not None and now < self._query[0] + ANSWER_TIME):
                break
            line = self._waiting.popleft()
            text, executed = (line.text, None) if line.instruction is None else self._line(line.instruction)
            if executed is not None:
                out.append(Sent(executed))
            if not text:
                continue
            self._wait_start, self._number = now, self._number + 1
            self._unwritten = numbered(self._number, text)
            self._sent.append((self._number, self._unwritten))
            self._unanswered.append((self._number, now))
            if is_query:
                self._query, self._query_time = (now, line.anchor), now
        return out

    def _write_rest(self, out: list[Sent]) -> bool:
        """Write what is left of the last line, or of a stop; whether all of it is out."""
        assert self.port is not None
        if self._unwritten:
            self._unwritten = self._unwritten[self.port.write(self._unwritten) :]
        if self._stop_pending and not self._unwritten:
            self._stop_pending = False
            out.append(Sent(Pause()))
        return not self._unwritten


@dataclass(frozen=True, slots=True)
class Push:
    """What the axis E does in a line."""

    word: str  # "" where it rests
    way: float  # mm, however it goes
    seconds: float  # s that it takes at least

    def feed(self, seconds: float) -> float:
        """The feed of a line in which E alone moves, mm/min, if it is to take so long."""
        return max(60 * self.way / seconds, 0.001)


NO_PUSH = Push("", 0.0, 0.0)


class _PushedAxis:
    """The axis E: how much of its material is drawn back. Volumes in mm^3.

    pressed: whether material has left since it was drawn back.
    """

    def __init__(self, extruder: Extruder) -> None:
        self._extruder, self.pressed = extruder, False
        self._retracted = 0.0  # back by now
        self._rest = 0.0  # mm, what the last words were rounded by

    def push(self, volume: float, seconds: float) -> Push:
        """A line of `seconds` s in which `volume` is to leave; what was drawn back is pushed as well, bit by bit."""
        capacity, retract_volume = self._extruder.max_flow * seconds, self._extruder.retract_volume
        if volume > 0:
            returned, self.pressed = min(self._retracted, max(capacity - volume, 0.0)), True
            self._retracted -= returned
            return self._push(volume + returned)
        if not self.pressed:
            return NO_PUSH
        retracted = min(retract_volume - self._retracted, capacity)
        self._retracted, self.pressed = self._retracted + retracted, retracted == capacity > 0
        return self._push(-retracted)

    def _push(self, volume: float) -> Push:
        exact = volume / self._extruder.area + self._rest
        distance = round(exact, PUSH_DIGITS)
        self._rest = exact - distance
        word = f" E{distance:.{PUSH_DIGITS}f}" if distance else ""
        pushed_volume = max(abs(volume), abs(distance) * self._extruder.area)
        return Push(word, abs(distance), pushed_volume / self._extruder.max_flow)


def numbered(number: int, text: str) -> bytes:
    """A line with its number and its checksum, the exclusive or of all bytes before the asterisk (RepRap)."""
    line = f"N{number} {text}".encode("ascii")
    checksum = 0
    for byte in line:
        checksum ^= byte
    return line + f"*{checksum}\n".encode("ascii")


def open_arm(address: str, profile: ArmProfile, listener: ByteListener | None = None) -> GcodeMachine:
    """The machine at gcode://DEVICE."""
    device = address.removeprefix(SCHEME)
    if not device:
        raise InputError("arm", "address", address, f"{SCHEME}DEVICE, such as {SCHEME}/dev/ttyACM0")
    return GcodeMachine(address, PortOpener(device, profile.baud), profile, listener)


def find_arms() -> list[tuple[str, str]]:
    """The serial ports that the system shows: a machine may hang on each."""
    return [(f"{SCHEME}{device}", text) for device, text in serial_ports()]


def emergency_stop(address: str, profile: ArmProfile) -> tuple[float, str]:
    """Halt it for good, by M112, after the rest of a line that was torn: when that was out, s, and why it was not."""
    return write_last(address.removeprefix(SCHEME), profile.baud, b"\nM112\n", profile.frame_time)
