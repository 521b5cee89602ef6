"""The driver of every dispenser that is controlled by messages, over a serial line or by HTTP.

Messages wait in one queue. One that is partly sent is completed; an off goes before all others, and removes messages
that would let material flow. After a lost line, off is the first message sent, and the dispenser is CLOSED.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from estimation.errors import InputError
from hardware.arm.driver import UnpluggedError
from hardware.arm.port import HttpOpener, Port, PortOpener, is_http
from hardware.dispenser.dispenser import (
    CLOSE_TIME,
    DispenserEvent,
    DispenserProfile,
    DispenserState,
    DispenserStatus,
    EventLog,
)
from hardware.dispenser.messages import (
    DispenserLine,
    Message,
    MessageKind,
    MessageQueue,
    MessageValues,
    message_lines,
)

REOPEN_PERIOD = 0.5  # s between looks for a device that is gone
QUERY_PERIOD = 1.0  # s between questions for the temperature: a syringe's block takes minutes
NEAR_TARGET = 1.0  # degrees C from its target, at which a dispenser is ready
MAX_ANSWER = 256  # bytes of an answer; what is longer is none
ANSWER_END = re.compile(rb"[\r\n\x03]+")  # New Era's answers end in ETX
MAX_HEARD = 100  # answers kept for a person


class LineOpener(Protocol):
    """Opens the line to one device, and again when it was away."""

    def __call__(self) -> Port:
        """Open it; UnpluggedError where it is not there, InputError where another program has it."""
        ...

    def release(self) -> None:
        """Let others have it."""
        ...


def opener_for(line: DispenserLine) -> LineOpener:
    """What opens a line: HTTP or a serial port. InputError where the port's name makes no sense."""
    return HttpOpener(line.port, line.timeout) if is_http(line.port) else PortOpener(line.port, line.baud)


class LineDispenser:
    """One dispenser behind a line; see `Dispenser` for the calls.

    heard: the last answers with their instants, s, for a person.
    """

    def __init__(self, profile: DispenserProfile, line: DispenserLine, opener: LineOpener | None = None) -> None:
        """opener: by default, what the line's port says. InputError for messages that name what there is not."""
        line.messages.check(MessageValues(plunger=line.plunger))
        self.profile = profile
        self.heard: deque[tuple[float, str]] = deque(maxlen=MAX_HEARD)
        self._line, self._opener = line, opener_for(line) if opener is None else opener
        self._answer = re.compile(line.messages.answer)
        self._alarm = re.compile(line.messages.alarm) if line.messages.alarm else None
        self._state, self._reason, self._log = DispenserState.CLOSED, "not prepared yet", EventLog()
        self._flow = 0.0  # mm^3/s commanded
        self._temperature: float | None = None  # degrees C, answered
        self._target: float | None = None
        self._target_reached = True  # since it was set
        self._port: Port | None = None
        self._queue = MessageQueue(line.gap)
        self._partial = b""  # of an answer that is not complete
        self._last_sent = math.inf  # s, of the last message to the device's watchdog since on
        self._keepalive_at, self._query_at, self._reopen_at = math.inf, math.inf, math.inf  # s
        self._line_lost = False  # whether the line was lost and has accepted no off since
        self._retracted = False  # whether material is drawn back
        self._closing_since: float | None = None  # s
        self._is_closed = False

    @property
    def status(self) -> DispenserStatus:
        """As of the last call."""
        return DispenserStatus(self._state, self._reason, self._flow, self._temperature, self._target)

    def events(self) -> list[DispenserEvent]:
        """What happened since the last call."""
        return self._log.take()

    # -- orders

    def listen(self, now: float) -> None:
        """Open the line and send nothing; FAILED where it is not there."""
        if self._port is None:
            self._open(now)

    def hang_up(self) -> None:
        """Release the line and send nothing: for a dispenser that was only listened to."""
        self._release_line()

    def prepare(self, now: float, celsius: float | None = None) -> None:
        """Send off, then the set-up messages, then the temperature."""
        if self._state in (DispenserState.CLOSED, DispenserState.FAILED):
            self.listen(now)
            if self._port is None:
                return
            self._is_closed, self._closing_since, self._line_lost = False, None, False
            self._queue.drop(MessageKind.SETUP)
            self.off(now)
            if self._line.start:  # what was sent while it started is lost
                repeats = self._messages(MessageKind.OFF, self._line.messages.off)
                self._queue.put(replace(message, urgent=False) for message in repeats)
            self._queue.put(self._messages(MessageKind.SETUP, self._line.messages.prepare))
            self._query_at = now if self._line.messages.temperature_query else math.inf
            watchdog = self.profile.watchdog
            watchdog_text = f"switches itself off after {watchdog:g} s" if watchdog else "has no watchdog: it stays on"
            self._change(DispenserState.PREPARING, f"set up; without us it {watchdog_text}", now)
        if celsius is not None and (reason := self.set_temperature(celsius, now)):
            self._fail(reason, now)
        self.poll(now)

    def on(self, flow: float, now: float) -> str:
        """Prime if material is drawn back, then switch on; while on, only change the flow."""
        if self._closing_since is not None or self._state not in (DispenserState.READY, DispenserState.ON):
            return f"{self.profile.name} is {self._state.value}: {self._reason}"
        if reason := self.profile.wrong_flow(flow):
            return reason
        device_flow, messages = self.profile.flow_given(flow), self._line.messages
        if self._state is DispenserState.ON and device_flow == self._flow:
            return ""
        self._flow = device_flow

        def flowing(at: float) -> None:
            self._log.add(at, f"{device_flow:g} mm^3/s", device_flow)

        def switched(at: float) -> None:
            self._last_sent, self._keepalive_at = at, at + self._line.keepalive if messages.keepalive else math.inf
            self._log.add(at, f"on, {device_flow:g} mm^3/s", device_flow)

        if self._state is DispenserState.ON:
            self._queue.drop(MessageKind.FLOW)
            change = messages.on if messages.flow is None else messages.flow
            self._queue.put(self._messages(MessageKind.FLOW, change, flowing))
        else:
            if self._retracted:
                prime = self._messages(MessageKind.ON, messages.prime, volume=self.profile.prime_volume)
                self._queue.put(prime)
                self._retracted = False
            self._queue.put(self._messages(MessageKind.ON, messages.on, switched))
            self._change(DispenserState.ON, "on", now, quiet=True)
        self._send(now)
        return "" if self._state is DispenserState.ON else self._reason

    def off(self, now: float) -> None:
        """Switch off, before all messages that are not partly sent; then retract, if it was on."""
        if self._port is not None:
            was_on = self._state is DispenserState.ON
            retract = was_on or self._queue.waits(MessageKind.RETRACT)
            self._queue.drop(MessageKind.ON, MessageKind.FLOW, MessageKind.KEEPALIVE, MessageKind.RETRACT)
            if not self._queue.waits(MessageKind.OFF, urgent=True):
                self._queue_off(now, was_on)
            if retract:
                self._queue.put_first(self._retract_messages(), behind=MessageKind.OFF)
        self._stop(now)
        self._send(now)

    def retract(self, now: float) -> None:
        """Retract material, once."""
        if self._state in (DispenserState.READY, DispenserState.PREPARING) and not self._retracted:
            self._queue.put(self._retract_messages())
            self._send(now)

    def set_temperature(self, celsius: float, now: float) -> str:
        """Set the temperature; without a heater of its own it must already be the one at which material is kept."""
        if allowed := self.profile.wrong_temperature(celsius):
            return f"{celsius:g} degrees C, allowed {allowed}"
        if self.profile.temperature_range is None or celsius == self._target:
            return ""
        if self._state in (DispenserState.CLOSED, DispenserState.FAILED):
            return f"{self.profile.name} is {self._state.value}: {self._reason}"
        self._target, self._target_reached = celsius, not self._line.messages.temperature_query
        self._queue.put(self._messages(MessageKind.SETUP, self._line.messages.temperature))
        self._send(now)
        self._settle(now)
        return ""

    def close(self, now: float) -> bool:
        """Switch off, and wait until the line has sent it, for CLOSE_TIME at most."""
        if self._port is None and not self._line_lost:
            if self._state is not DispenserState.CLOSED and not self._is_closed:
                self._change(DispenserState.CLOSED, f"closed, never open: {self._reason}", now)
            self._release_line()
            return True
        if self._closing_since is None:
            self._closing_since = now
            self._queue.drop(MessageKind.OFF, MessageKind.SETUP)
            self.off(now)
        self.poll(now)
        port = self._port
        if port is not None and not self._line_lost and MessageKind.OFF not in self._queue and self._queue.idle(port):
            self._change(DispenserState.CLOSED, "closed, off", now)
        elif now < self._closing_since + CLOSE_TIME:
            return False
        else:
            limit = self.profile.watchdog
            hint = f"it does so itself within {limit:g} s" if limit else "IT MAY STILL BE ON: switch it off by hand"
            self._change(DispenserState.FAILED, f"could not be switched off ({self._reason}); {hint}", now)
        self._release_line()
        return True

    # -- the loop's call

    def poll(self, now: float) -> None:
        """Read, send, repeat the watchdog's keepalive, reopen a lost line; every few milliseconds."""
        if self._port is None:
            if self._line_lost and now >= self._reopen_at:
                self._open(now)
                self.off(now)
            return
        try:
            self._read(self._port.read(), now)
            self._watch(self._port, now)
        except UnpluggedError as error:
            self._unplugged(str(error), now)
            return
        if now >= self._query_at and MessageKind.SETUP not in self._queue:
            self._query_at = now + QUERY_PERIOD
            self._queue.put(self._messages(MessageKind.SETUP, self._line.messages.temperature_query))
        if now >= self._keepalive_at and not self._queue:
            overdue = now - self._keepalive_at > self._line.keepalive
            self._keepalive_at = (now if overdue else self._keepalive_at) + self._line.keepalive
            self._queue.put(self._messages(MessageKind.KEEPALIVE, self._line.messages.keepalive))
        self._send(now)
        self._settle(now)

    # -- the line

    def _open(self, now: float) -> None:
        try:
            self._port = self._opener()
        except (UnpluggedError, InputError) as error:
            self._reopen_at = now + REOPEN_PERIOD
            text = f"{error.what} {error.got}: needed is {error.allowed}" if isinstance(error, InputError) else error
            self._change(DispenserState.FAILED, str(text), now)
            return
        self._queue.restart(now + self._line.start)
        self._partial = b""

    def _send(self, now: float) -> None:
        if self._port is None:
            return
        sent_before = self._queue.sent
        try:
            self._queue.send(self._port, now)
        except UnpluggedError as error:
            self._unplugged(str(error), now)
        if self._queue.sent > sent_before and self._last_sent < math.inf:
            self._last_sent = now

    def _unplugged(self, reason: str, now: float) -> None:
        """The line is gone, and the waiting messages are dropped."""
        if self._port is not None:
            self._port.close()
        self._port, self._reopen_at = None, now + REOPEN_PERIOD
        self._queue.restart(now)
        self._line_lost = True
        self._fail(reason, now)

    def _fail(self, reason: str, now: float) -> None:
        flow = 0.0 if self._state is DispenserState.ON else None
        self._stop(now)
        self._target, self._target_reached, self._query_at = None, True, math.inf
        self._change(DispenserState.FAILED, reason, now, flow)
        self.off(now)

    def _release_line(self) -> None:
        if self._port is not None:
            self._port.close()
        self._opener.release()
        self._port, self._is_closed, self._line_lost, self._query_at = None, True, False, math.inf
        self._queue.restart(-math.inf)

    def _watch(self, port: Port, now: float) -> None:
        """Detect a blocked line, one that is back, and a device that was switched off by its watchdog."""
        watchdog = self.profile.watchdog
        if watchdog and now - self._last_sent > watchdog:
            reason = f"nothing was sent for {now - self._last_sent:.3f} s: its watchdog"
            self._log.add(self._last_sent + watchdog, f"off: {reason}", 0.0)
            self._change(DispenserState.READY, reason, now, quiet=True)
            self.off(now)
        blocked = self._queue.blocked_for(port, now)
        if blocked > 2 * self._line.timeout and self._state is not DispenserState.FAILED:
            self._line_lost = True
            self._fail(f"its line took nothing for {blocked:.2f} s", now)
        elif self._line_lost and MessageKind.OFF not in self._queue and self._queue.idle(port):
            self._line_lost = False
            self._change(DispenserState.CLOSED, "its line is back and it is off; it must be prepared", now)

    def _read(self, data: bytes, now: float) -> None:
        *answers, self._partial = ANSWER_END.split(self._partial + data)
        self._partial = self._partial[-MAX_ANSWER:]
        for answer in answers:
            text = answer[-MAX_ANSWER:].decode("ascii", "replace").strip("\x02 ")
            if not text:
                continue
            self.heard.append((now, text))
            self._take_temperature(text)
            active = self._state in (DispenserState.PREPARING, DispenserState.READY, DispenserState.ON)
            if active and self._alarm is not None and self._alarm.search(text):
                self._fail(f"it says {text!r}", now)

    def _take_temperature(self, text: str) -> None:
        match = self._answer.search(text) if self._line.messages.answer else None
        try:
            celsius = math.nan if match is None else float(match[1])
        except (TypeError, ValueError):  # the file's own pattern
            return
        if math.isfinite(celsius):
            self._temperature = celsius
            self._target_reached |= self._target is None or abs(celsius - self._target) <= NEAR_TARGET

    # -- messages

    def _messages(
        self, kind: MessageKind, template: str, taken: Callable[[float], None] | None = None, volume: float = 0.0
    ) -> list[Message]:
        """The lines of a template; the last of them tells `taken`, at once where there is none."""
        celsius = 0.0 if self._target is None else self._target
        values = MessageValues(self._flow, celsius, volume, self._line.keepalive, self._line.plunger)
        lines = message_lines(template, self._line.messages.end, values) or [b""]
        last, urgent = len(lines) - 1, kind is MessageKind.OFF
        return [Message(line, kind, taken if i == last else None, urgent) for i, line in enumerate(lines)]

    def _queue_off(self, now: float, flowed: bool) -> None:
        """Off at the front; again behind it where the device may still be busy with the line before."""

        def taken(at: float) -> None:
            self._log.add(at, "off", 0.0)

        messages = self._messages(MessageKind.OFF, self._line.messages.off, taken if flowed else None)
        if now < self._queue.sent + self._line.gap and not self._queue.waits(MessageKind.OFF):
            messages += [replace(m, taken=None, urgent=False) for m in messages]
        self._queue.put_first(messages)

    def _retract_messages(self) -> list[Message]:
        volume, template = self.profile.retract_volume, self._line.messages.retract
        if not template or not volume:
            return []
        self._retracted = True
        return self._messages(MessageKind.RETRACT, template, volume=volume)

    # -- states

    def _stop(self, now: float) -> None:
        """Set the state to off."""
        self._flow, self._last_sent, self._keepalive_at = 0.0, math.inf, math.inf
        if self._state is DispenserState.ON:
            self._change(DispenserState.READY, "off", now, quiet=True)
            self._settle(now)

    def _settle(self, now: float) -> None:
        """PREPARING until it is set up and was at its temperature; then READY."""
        if self._state not in (DispenserState.PREPARING, DispenserState.READY):
            return
        if not self._target_reached:
            answer_text = "it has not told its own" if self._temperature is None else f"it is at {self._temperature:g}"
            self._change(DispenserState.PREPARING, f"set to {self._target:g} degrees C, {answer_text}", now, quiet=True)
        elif self._state is DispenserState.PREPARING and MessageKind.SETUP not in self._queue:
            self._change(DispenserState.READY, "prepared", now)

    def _change(
        self, state: DispenserState, reason: str, now: float, flow: float | None = None, quiet: bool = False
    ) -> None:
        """quiet: log nothing, as another event has it, or it would be logged too often."""
        if (state, reason) != (self._state, self._reason) and not quiet:
            self._log.add(now, f"{state.value}: {reason}", flow)
        self._state, self._reason = state, reason
