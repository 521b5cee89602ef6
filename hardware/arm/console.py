"""`stillbed arm DEVICE`: what answers on a line, and slow moves of the arm that an operator confirms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.device import ArmState, ArmStatus
from hardware.arm.driver import ArmDriver
from hardware.arm.link import Arm, shut_down
from hardware.arm.profile import AXIS_LETTERS, DISPLAY_UNITS, DRIVERS, ArmProfile, LinkSettings, find_arms
from hardware.process import checks
from hardware.process.clock import Clock

LISTEN_TIME = 1.0  # s before a move, in which an arm that answers has told where it stands ten times
REPORT_PERIOD = 0.5  # s between lines
SETTLE_TIME = 1.0  # s after a move, in which its end is answered


@dataclass(frozen=True, slots=True, eq=False)
class ArmRequest:
    """A request to an arm from the command line."""

    seconds: float = 5.0  # to listen, infinite until interrupted
    home: bool = False  # go there
    jog: Array | None = None  # (6,) mm and rad, to go by
    origin: Array | None = None  # (3,) mm, its work origin, set before a move
    stands: Array | None = None  # (6,) mm and rad, where it stands, for one that does not answer
    confirmed: bool = False  # by the operator: without it nothing is sent

    @property
    def moves(self) -> bool:
        """Whether anything is to be sent."""
        return self.home or self.jog is not None or self.origin is not None


def run_arm(
    driver: ArmDriver,
    profile: ArmProfile,
    request: ArmRequest,
    clock: Clock,
    say: Callable[[str], None] = print,
    settings: LinkSettings | None = None,
) -> ArmStatus:
    """Listen to an arm, move it if that was asked for and confirmed, and tell what it answered; its last status.

    However it ends, nothing is left under way: an arm that was armed is stopped or disarmed.
    """
    if not request.seconds > 0:
        raise InputError("command line", "--seconds", request.seconds, "above 0")
    if request.moves and not request.confirmed:
        raise InputError("arm", "--yes", "missing", "the confirmation that nobody is within the arm's reach")
    start, settings = clock.now(), LinkSettings() if settings is None else settings
    arm = Arm(driver, profile, start, settings)
    if arm.state is ArmState.UNPLUGGED and (request.moves or np.isfinite(request.seconds)):
        raise InputError("arm", "port", arm.reason, "a device that is there, or --watch to wait for it")
    console = _Console(arm, clock, say, start)
    try:
        if request.stands is not None:
            arm.stand(request.stands, clock.now())
        if request.moves:
            _move(console, request)
        else:
            console.watch(request.seconds)
    finally:
        shut_down(arm, "interrupted", clock, settings.poll)
        status = arm.status(clock.now())
        arm.close()
    say(findings(status, profile))
    return status


def findings(status: ArmStatus, profile: ArmProfile) -> str:
    """What is known of the arm, in a few lines."""
    answered = "nothing that is an answer" if not status.answers else f"{status.answer_rate:.1f} places a second"
    lines = [f"{status.state.value}: {status.reason}", f"it sent {answered} and {status.strays} stray bytes"]
    if status.answered is not None:
        lines.append(f"it stands at {_shown(status.answered)} by its answers, {status.off:.2f} mm off its way")
    if status.axes is not None:
        lines.append(f"it stands at {_shown(status.axes)} by what it was sent")
    if np.isfinite(status.lag):
        known = f"the profile's lag_s = {profile.lag:.3f}"
        lines.append(f"its lag is {1000 * status.lag:.0f} ms: lag_s = {status.lag + profile.frame_time:.3f}; {known}")
    return "\n".join(lines)


def drivers_text() -> str:
    """The drivers of arms, what each finds now, and how to install what it needs."""
    lines = []
    for kind in DRIVERS:
        lines.append(f"{kind.name}: {kind.example}")
        if not kind.installed:
            lines.append(f"  not installed: {kind.remedy}")
            continue
        found = find_arms(kind)
        lines += [f"  {address}  {words}" for address, words in found] or ["  none is found"]
    return "\n".join(lines)


def jog_from_text(texts: list[str]) -> Array:
    """How far to go (6,), mm and rad, from words such as X=+5 or B=-2.5 (degrees)."""
    jog = np.zeros(6)
    for text in texts:
        axis, _, amount = text.upper().partition("=")
        try:
            value = float(amount)
        except ValueError:
            value = float("nan")
        if axis not in AXIS_LETTERS or len(axis) != 1 or not np.isfinite(value):
            raise InputError("command line", "--jog", text, "such as X=+5 (mm) or B=-2.5 (degrees)")
        jog[AXIS_LETTERS.index(axis)] = value
    return np.asarray(jog / DISPLAY_UNITS)


def axes_from_text(text: str, home: Array) -> Array:
    """Axes (6,), mm and rad, from "home" or six numbers X,Y,Z,A,B,C in mm and degrees."""
    if text == "home":
        return home
    return np.asarray(_numbers("--stands", text, 6, "mm and degrees, or home") / DISPLAY_UNITS)


def origin_from_text(text: str) -> Array:
    """A work origin (3,), mm in machine axes, from X,Y,Z."""
    return _numbers("--origin", text, 3, "mm")


def _numbers(option: str, text: str, count: int, unit: str) -> Array:
    """So many finite numbers with commas between."""
    try:
        return checks.numbers("command line", option, [float(word) for word in text.split(",")], (count,), unit)
    except ValueError:
        raise InputError("command line", option, text, f"{count} finite numbers, {unit}") from None


class _Console:
    """Lets time pass for an arm, and says what it does."""

    def __init__(self, arm: Arm, clock: Clock, say: Callable[[str], None], start: float) -> None:
        self.arm, self.clock, self._say = arm, clock, say
        self._start = self._reported = start

    def watch(self, seconds: float, until: Callable[[float], bool] = lambda now: False) -> None:
        """Poll for so long, or until something is so."""
        end = self.clock.now() + seconds
        while (now := self.clock.now()) < end and not until(now):
            self.arm.poll(now)
            for event in self.arm.events():
                self._say(f"{event.stamp - self._start:.3f} s: {event.text}")
            if now >= self._reported + REPORT_PERIOD:
                self._reported = now
                self._say(_line(self.arm.status(now)))
            self.clock.wait_until(now + self.arm.settings.poll)


def _move(console: _Console, request: ArmRequest) -> None:
    arm, clock = console.arm, console.clock
    console.watch(LISTEN_TIME)
    target = arm.profile.arm.home
    reason = arm.arm(clock.now())
    if not reason and request.jog is not None:
        assert arm.target is not None
        target = arm.target + request.jog
    if not reason and request.origin is not None:
        reason = arm.set_origin(request.origin, clock.now())
        console.watch(SETTLE_TIME)
    if request.home or request.jog is not None:
        reason = reason or arm.go(target, clock.now(), lift=request.home)
    if reason:
        raise InputError("arm", "move", reason, "an arm that is armed, knows where it stands and may go there")
    console.watch(float("inf"), lambda now: arm.state is not ArmState.ARMED or arm.arrived(now))
    console.watch(SETTLE_TIME)
    if arm.state is ArmState.ARMED:
        arm.disarm(clock.now())


def _line(status: ArmStatus) -> str:
    place = "somewhere" if status.axes is None else _shown(status.axes)
    answered = "no answer" if status.answered is None else f"answers {_shown(status.answered)}, off {status.off:.2f} mm"
    return f"{status.state.value:<9} {place}  {answered}  {status.frames} frames, {status.strays} stray bytes"


def _shown(axes: Array) -> str:
    return " ".join(f"{name}{value:.2f}" for name, value in zip(AXIS_LETTERS, axes * DISPLAY_UNITS, strict=True))
