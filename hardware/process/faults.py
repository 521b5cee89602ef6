"""What can go wrong, by name and in one syntax for all that can let it happen: "camera0 stuck at 5s for 2s".

    PART KIND [AMOUNT] [at TIME] [for TIME] [seed N]

PART is camera0 and so on (by its number in the rig), clock, tracking, motion, arm, disk, page, surface or dispenser;
FAULT_SPECS says what each can do, what its amount is, how long it lasts where nothing is said, and which commands can
let it happen. TIME is such as 2s or 600ms and counts from the beginning of a simulation, a recording, a virtual arm, or
of a live run's printing. `str` of a fault gives the text that is read back as the very same fault.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from estimation.errors import InputError
from hardware.process import checks

FAULT_EXAMPLES = 'such as "camera0 stuck at 5s for 2s" or "arm stall 600ms"'
MAX_FAULT_TIME = 86_400.0  # s: a day
MAX_CAMERAS = 8


class FaultPart(StrEnum):
    """What a fault strikes."""

    CAMERA = "camera"
    CLOCK = "clock"
    TRACKING = "tracking"
    MOTION = "motion"
    ARM = "arm"
    DISK = "disk"
    PAGE = "page"
    SURFACE = "surface"
    DISPENSER = "dispenser"


class FaultKind(StrEnum):
    """What happens to it."""

    OFF = "off"
    STUCK = "stuck"
    SLOW = "slow"
    GARBLE = "garble"
    SWAP = "swap"
    BUMP = "bump"
    BLACK = "black"
    FLASH = "flash"
    JUMP = "jump"
    KILL = "kill"
    HANG = "hang"
    STALL = "stall"
    DROP = "drop"
    UNPLUG = "unplug"
    FULL = "full"
    FLOOD = "flood"
    FAST = "fast"
    FOLD = "fold"
    COVER = "cover"
    BLOCK = "block"
    CLOG = "clog"


class FaultRunner(StrEnum):
    """The commands that can let faults happen."""

    SIMULATE = "simulate"
    REPLAY = "replay"
    LIVE = "live"
    ARM = "arm"


@dataclass(frozen=True, slots=True)
class FaultSpec:
    """One kind of fault on one part."""

    about: str  # what happens
    runners: tuple[FaultRunner, ...]  # who can inject it
    unit: str = ""  # of its amount; "" for none
    low: float = 0.0  # of the amount, as the next two
    high: float = 0.0
    usual: float | None = 0.0  # None where the amount must be given
    lasts: float | None = math.inf  # s, by default; None where it must be given


_SIMULATE, _REPLAY, _LIVE, _ARM = FaultRunner
_PICTURED = (_SIMULATE, _REPLAY, _LIVE)
_ON_LINE = (_SIMULATE, _ARM)
Part, Kind = FaultPart, FaultKind  # short, for the table
FAULT_SPECS: dict[tuple[FaultPart, FaultKind], FaultSpec] = {
    (Part.CAMERA, Kind.OFF): FaultSpec("delivers nothing", _PICTURED),
    (Part.CAMERA, Kind.STUCK): FaultSpec("delivers its last picture repeatedly, with new stamps", _PICTURED),
    (Part.CAMERA, Kind.SLOW): FaultSpec("its pictures arrive late by this delay", (_SIMULATE,), "s", 0.001, 10, 0.1),
    (Part.CAMERA, Kind.GARBLE): FaultSpec("its encoded pictures are corrupted in transit", (_SIMULATE,)),
    (Part.CAMERA, Kind.SWAP): FaultSpec("its cable is swapped with the next camera's", _PICTURED),
    (Part.CAMERA, Kind.BUMP): FaultSpec("is shifted by this distance", (_SIMULATE,), "mm", 0.01, 100, 2.0),
    (Part.CAMERA, Kind.BLACK): FaultSpec("its pictures are black", _PICTURED),
    (Part.CAMERA, Kind.FLASH): FaultSpec("its pictures are white", _PICTURED, lasts=0.1),
    (Part.CLOCK, Kind.JUMP): FaultSpec(
        "the stamps of all pictures jump by this time", (_SIMULATE,), "s", -3600, 3600, 1.0
    ),
    (Part.TRACKING, Kind.KILL): FaultSpec("the tracking process ends and is not restarted", _PICTURED),
    (Part.TRACKING, Kind.HANG): FaultSpec("the tracking process hangs", _PICTURED),
    (Part.TRACKING, Kind.SLOW): FaultSpec(
        "the tracking process runs at this share of its speed", (_SIMULATE, _LIVE), "%", 0.1, 100, 20.0
    ),
    (Part.MOTION, Kind.KILL): FaultSpec("the motion process ends and is not restarted", _PICTURED),
    (Part.MOTION, Kind.HANG): FaultSpec("the motion process hangs", _PICTURED),
    (Part.ARM, Kind.STALL): FaultSpec(
        "the controller executes nothing; received frames are queued", _ON_LINE, lasts=None
    ),
    (Part.ARM, Kind.DROP): FaultSpec(
        "one frame, or each frame during the fault, is lost on the line", _ON_LINE, lasts=0.0
    ),
    (Part.ARM, Kind.GARBLE): FaultSpec(
        "one to eight bits of one frame, or of each frame during the fault, flip on the line", _ON_LINE, lasts=0.0
    ),
    (Part.ARM, Kind.UNPLUG): FaultSpec("the line is disconnected", (*_ON_LINE, _LIVE)),
    (Part.ARM, Kind.SLOW): FaultSpec("moves run at this share of their feed", _ON_LINE, "%", 0.1, 100, None),
    (Part.DISK, Kind.FULL): FaultSpec("no more bytes can be written to the recording", (_LIVE,)),
    (Part.PAGE, Kind.FLOOD): FaultSpec(
        "more windows than allowed, each sending messages as fast as possible", (_LIVE,)
    ),
    (Part.SURFACE, Kind.FAST): FaultSpec(
        "the surface moves away and back, with this maximum speed", (_SIMULATE,), "mm/s", 1, 1000, 80.0, 1.0
    ),
    (Part.SURFACE, Kind.FOLD): FaultSpec(
        "a ridge of this height rises and falls", (_SIMULATE,), "mm", 0.1, 20, 3.0, 1.0
    ),
    (Part.SURFACE, Kind.COVER): FaultSpec("an object covers the wound for all cameras", (_SIMULATE,)),
    (Part.DISPENSER, Kind.UNPLUG): FaultSpec("its line is disconnected", (_SIMULATE,)),
    (Part.DISPENSER, Kind.BLOCK): FaultSpec("writes to its line block", (_SIMULATE,)),
    (Part.DISPENSER, Kind.DROP): FaultSpec("messages to it are lost on the line", (_SIMULATE,)),
    (Part.DISPENSER, Kind.CLOG): FaultSpec(
        "its needle is clogged: this share of the flow is lost", (_SIMULATE,), "%", 1, 100, 100.0
    ),
}

_NUMBER = r"-?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?"
_QUANTITY = re.compile(rf"({_NUMBER})(ms|s|mm/s|mm|%)")
_STALLING = (FaultPart.ARM, FaultKind.STALL)  # "stall 600ms" says for how long


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault."""

    part: FaultPart
    kind: FaultKind
    start: float = 0.0  # s
    duration: float = math.inf  # s; 0 is one frame of the arm's
    amount: float = 0.0  # in its spec's unit, 0 without
    number: int = 0  # of the camera in the rig
    seed: int = 0  # of its random numbers

    @property
    def spec(self) -> FaultSpec:
        """Of its kind."""
        return FAULT_SPECS[self.part, self.kind]

    @property
    def end(self) -> float:
        """Instant at which it is over, s."""
        return self.start + self.duration

    @property
    def share(self) -> float:
        """The amount as a share, where it is in %."""
        return self.amount / 100

    @property
    def name(self) -> str:
        """Part and kind: "camera0 stuck"."""
        return f"{self.part}{self.number if self.part is FaultPart.CAMERA else ''} {self.kind}"

    def covers(self, instant: float) -> bool:
        """Whether it lasts at `instant`, s."""
        return self.start <= instant < self.end

    def __str__(self) -> str:
        """The text that `fault_from_text` reads."""
        spec, parts = self.spec, [self.name]
        if spec.unit:
            parts.append(f"{_digits(self.amount)}{spec.unit}")
        if self.start:
            parts.append(f"at {_digits(self.start)}s")
        if self.duration != spec.lasts:
            parts.append(f"for {_digits(self.duration)}s")
        if self.seed:
            parts.append(f"seed {self.seed}")
        return " ".join(parts)


def _digits(value: float) -> str:
    return repr(float(value)).removesuffix(".0")


def fault_from_text(where: object, key: str, text: object, part: FaultPart | None = None) -> Fault:
    """The fault that a text describes; InputError (where, key) for any other text.

    part: of a text that names none.
    """
    tokens = text.split() if isinstance(text, str) else []
    if tokens and part is not None and tokens[0] != part:
        tokens.insert(0, part)
    if not tokens:
        raise InputError(where, key, text, FAULT_EXAMPLES)
    target, number = _part(where, key, text, tokens.pop(0))
    kind = _kind(where, key, text, target, tokens)
    spec = FAULT_SPECS[target, kind]
    amount = _amount(where, key, text, spec, tokens) if spec.unit else 0.0
    if (target, kind) == _STALLING and tokens and _QUANTITY.fullmatch(tokens[0]):
        tokens.insert(0, "for")
    options = _options(where, key, text, tokens)
    start, duration = options.get("at", 0.0), options.get("for", spec.lasts)
    if duration is None:
        raise InputError(where, key, text, f'how long: "{target} {kind} 600ms"')
    if "for" in options and (kind is FaultKind.KILL or not duration > 0):
        allowed = "no duration: what is killed stays so" if kind is FaultKind.KILL else "a duration above 0"
        raise InputError(where, key, text, allowed)
    return Fault(target, kind, start, duration, amount, number, int(options.get("seed", 0)))


def faults_from_texts(where: object, key: str, texts: object, part: FaultPart | None = None) -> tuple[Fault, ...]:
    """The faults that a list of texts describes; InputError as `fault_from_text`."""
    if not isinstance(texts, list):
        raise InputError(where, key, texts, f"a list of texts {FAULT_EXAMPLES}")
    return tuple(fault_from_text(where, f"{key}[{i}]", text, part) for i, text in enumerate(texts))


def _part(where: object, key: str, text: object, word: str) -> tuple[FaultPart, int]:
    part_names = [f"{p}0" if p is FaultPart.CAMERA else str(p) for p in dict.fromkeys(part for part, _ in FAULT_SPECS)]
    camera = re.fullmatch(r"camera(\d)", word)
    if camera and int(camera[1]) < MAX_CAMERAS:
        return FaultPart.CAMERA, int(camera[1])
    if word not in part_names:
        raise InputError(where, key, text, f"{FAULT_EXAMPLES}; the first word {checks.one_of_text(word, part_names)}")
    return FaultPart(word), 0


def _kind(where: object, key: str, text: object, part: FaultPart, tokens: list[str]) -> FaultKind:
    kind_names = [str(kind) for each, kind in FAULT_SPECS if each is part]
    if not tokens or tokens[0] not in kind_names:
        allowed = checks.one_of_text(tokens[0] if tokens else "", kind_names)
        raise InputError(where, key, text, f"{FAULT_EXAMPLES}; after {part} {allowed}")
    return FaultKind(tokens.pop(0))


def _amount(where: object, key: str, text: object, spec: FaultSpec, tokens: list[str]) -> float:
    allowed = f"an amount of {spec.low:g} to {spec.high:g} {spec.unit}"
    match = _QUANTITY.fullmatch(tokens[0]) if tokens else None
    if match is None:
        if spec.usual is None or (tokens and tokens[0] not in ("at", "for", "seed")):
            raise InputError(where, key, text, allowed)
        return spec.usual
    tokens.pop(0)
    value, unit = _seconds(match) if match[2] in ("ms", "s") else (float(match[1]), match[2])
    if unit != spec.unit or not spec.low <= value <= spec.high or value == 0:
        raise InputError(where, key, text, allowed)
    return value


def _seconds(match: re.Match[str]) -> tuple[float, str]:
    return float(match[1]) * (0.001 if match[2] == "ms" else 1.0), "s"


def _options(where: object, key: str, text: object, tokens: list[str]) -> dict[str, float]:
    """The values behind "at", "for" and "seed"."""
    options: dict[str, float] = {}
    allowed = f'{FAULT_EXAMPLES}; then "at TIME", "for TIME", "seed N", each once, times up to {MAX_FAULT_TIME:g}s'
    for name, value in zip(tokens[::2], [*tokens[1::2], ""], strict=False):
        match = _QUANTITY.fullmatch(value)
        if name in options or name not in ("at", "for", "seed"):
            raise InputError(where, key, text, allowed)
        if name == "seed" and re.fullmatch(r"\d{1,15}", value):
            options[name] = int(value)
        elif name != "seed" and match and match[2] in ("ms", "s") and 0 <= _seconds(match)[0] <= MAX_FAULT_TIME:
            options[name] = _seconds(match)[0]
        else:
            raise InputError(where, key, text, allowed)
    return options


def faults_striking(faults: Iterable[Fault], part: FaultPart, *kinds: FaultKind) -> list[Fault]:
    """Those of the faults on a part, of one of these kinds if any is named."""
    return [fault for fault in faults if fault.part is part and (not kinds or fault.kind in kinds)]


def check_faults(
    faults: Sequence[Fault], runner: FaultRunner, where: object, key: str, cameras: int = MAX_CAMERAS
) -> None:
    """InputError for a fault that the command cannot inject, or on a camera that is not there."""
    for fault in faults:
        if runner not in fault.spec.runners:
            known = ", ".join(f"{part} {kind}" for (part, kind), spec in FAULT_SPECS.items() if runner in spec.runners)
            others = " and ".join(fault.spec.runners)
            raise InputError(where, key, str(fault), f"what {runner} can do: {known}; {fault.name} is for {others}")
        if fault.part is FaultPart.CAMERA and fault.number >= cameras:
            raise InputError(where, key, str(fault), f"camera0 to camera{cameras - 1}")
        if fault.kind is FaultKind.SWAP and cameras < 2:
            raise InputError(where, key, str(fault), "two cameras or more")


def fault_rng(fault: Fault) -> np.random.Generator:
    """The random numbers of a fault."""
    return np.random.default_rng([fault.seed, list(FaultKind).index(fault.kind), fault.number])


# of one piece of work: begin and end of each stretch, s, and the share of its usual rate
WorkStretches = list[tuple[float, float, float]]
STALLED_KINDS = (FaultKind.STALL, FaultKind.HANG, FaultKind.KILL)


class WorkRates:
    """How fast work is done by what stands still or is slow for a while: the arm's controller, or the tracking."""

    def __init__(self, faults: Iterable[Fault]) -> None:
        """faults: of one part."""
        self._faults = [fault for fault in faults if fault.kind in (*STALLED_KINDS, FaultKind.SLOW)]
        self._edges = sorted({edge for fault in self._faults for edge in (fault.start, fault.end)} | {math.inf})

    def stretches(self, start: float, work: float, moving: bool = True) -> WorkStretches:
        """Work of `work` s at the usual rate, begun at `start`: stretches, each its begin, end and share of that rate.

        A stall stops pauses too; being slow, like a feed override, changes moves only.
        """
        stretches: WorkStretches = []
        for edge in (edge for edge in self._edges if edge > start):
            rate = self._rate(start, moving)
            end = min(edge, start + work / rate) if rate else edge
            stretches.append((start, end, rate))
            if end < edge:
                break
            work, start = max(work - rate * (end - start), 0.0), edge
        return stretches

    def done(self, start: float, work: float) -> float:
        """When work of `work` s, begun at `start`, s, is done; infinite where it never is."""
        return self.stretches(start, work)[-1][1]

    def _rate(self, instant: float, moving: bool) -> float:
        rate = 1.0
        for fault in self._faults:
            if fault.covers(instant) and (moving or fault.kind in STALLED_KINDS):
                rate *= 0.0 if fault.kind in STALLED_KINDS else fault.share
        return rate
