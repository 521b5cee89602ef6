"""What can go wrong, by name and in one syntax for all that can let it happen: "camera0 stuck at 5s for 2s".

    PART KIND [AMOUNT] [at TIME] [for TIME] [seed N]

PART is camera0 and so on (by its number in the rig), clock, tracking, motion, arm, disk, page or surface; SPECS says
what each can do, what its amount is, how long it lasts where nothing is said, and which commands can let it happen.
TIME is such as 2s or 600ms and counts from the beginning of a simulation, a recording, a virtual arm, or of a live
run's printing. `str` of a fault gives the text that is read back as the very same fault.
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

SPELLING = 'such as "camera0 stuck at 5s for 2s" or "arm stall 600ms"'
LONGEST = 86_400.0  # s: a day
CAMERAS = 8


class Part(StrEnum):
    """What a fault strikes."""

    CAMERA = "camera"
    CLOCK = "clock"
    TRACKING = "tracking"
    MOTION = "motion"
    ARM = "arm"
    DISK = "disk"
    PAGE = "page"
    SURFACE = "surface"


class Kind(StrEnum):
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


class Runner(StrEnum):
    """The commands that can let faults happen."""

    SIMULATE = "simulate"
    REPLAY = "replay"
    LIVE = "live"
    ARM = "arm"


@dataclass(frozen=True, slots=True)
class Spec:
    """One fault that can be named. about: what happens. runners: who can let it happen.

    unit: of its amount, "" for none; low, high, usual: of the amount, no usual one where it must be said. lasts: s,
    where nothing is said; None where it must be.
    """

    about: str
    runners: tuple[Runner, ...]
    unit: str = ""
    low: float = 0.0
    high: float = 0.0
    usual: float | None = 0.0
    lasts: float | None = math.inf


_SIMULATE, _REPLAY, _LIVE, _ARM = Runner
_SEEN = (_SIMULATE, _REPLAY, _LIVE)
_MADE = (_SIMULATE, _ARM)

SPECS: dict[tuple[Part, Kind], Spec] = {
    (Part.CAMERA, Kind.OFF): Spec("delivers nothing", _SEEN),
    (Part.CAMERA, Kind.STUCK): Spec("delivers its last picture again and again, with new stamps", _SEEN),
    (Part.CAMERA, Kind.SLOW): Spec("its pictures arrive later by that much", (_SIMULATE,), "s", 0.001, 10, 0.1),
    (Part.CAMERA, Kind.GARBLE): Spec("its encoded pictures are damaged on the way", (_SIMULATE,)),
    (Part.CAMERA, Kind.SWAP): Spec("its cable is exchanged with that of the next camera", _SEEN),
    (Part.CAMERA, Kind.BUMP): Spec("stands aside by that much", (_SIMULATE,), "mm", 0.01, 100, 2.0),
    (Part.CAMERA, Kind.BLACK): Spec("its pictures are black", _SEEN),
    (Part.CAMERA, Kind.FLASH): Spec("its pictures are white", _SEEN, lasts=0.1),
    (Part.CLOCK, Kind.JUMP): Spec("the stamps of all pictures jump by that much", (_SIMULATE,), "s", -3600, 3600, 1.0),
    (Part.TRACKING, Kind.KILL): Spec("the tracking ends and does not come back", _SEEN),
    (Part.TRACKING, Kind.HANG): Spec("the tracking stands still", _SEEN),
    (Part.TRACKING, Kind.SLOW): Spec(
        "the tracking has that share of its speed", (_SIMULATE, _LIVE), "%", 0.1, 100, 20.0
    ),
    (Part.MOTION, Kind.KILL): Spec("the motion ends and does not come back", _SEEN),
    (Part.MOTION, Kind.HANG): Spec("the motion stands still", _SEEN),
    (Part.ARM, Kind.STALL): Spec("the controller does nothing; what comes in is queued", _MADE, lasts=None),
    (Part.ARM, Kind.DROP): Spec("a frame, or each of that time, is lost on the line", _MADE, lasts=0.0),
    (Part.ARM, Kind.GARBLE): Spec("one to eight bits of a frame, or of each, flip on the line", _MADE, lasts=0.0),
    (Part.ARM, Kind.UNPLUG): Spec("nothing goes in or out", (*_MADE, _LIVE)),
    (Part.ARM, Kind.SLOW): Spec("moves go at that share of their feed", _MADE, "%", 0.1, 100, None),
    (Part.DISK, Kind.FULL): Spec("the recording's file can grow no more", (_LIVE,)),
    (Part.PAGE, Kind.FLOOD): Spec("more windows than may be, each saying as much as it can", (_LIVE,)),
    (Part.SURFACE, Kind.FAST): Spec(
        "the surface runs away and comes back, that fast at most", (_SIMULATE,), "mm/s", 1, 1000, 80.0, 1.0
    ),
    (Part.SURFACE, Kind.FOLD): Spec("a ridge that high rises and falls", (_SIMULATE,), "mm", 0.1, 20, 3.0, 1.0),
    (Part.SURFACE, Kind.COVER): Spec("something lies over the wound, before all cameras", (_SIMULATE,)),
}

_NUMBER = r"-?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?"
_QUANTITY = re.compile(rf"({_NUMBER})(ms|s|mm/s|mm|%)")
_STALLING = (Part.ARM, Kind.STALL)  # "stall 600ms" says for how long


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault. start, duration: s; a duration of 0 is one frame of the arm's. amount: in its Spec's unit, 0 without.

    number: of the camera in the rig. seed: of what chance decides.
    """

    part: Part
    kind: Kind
    start: float = 0.0
    duration: float = math.inf
    amount: float = 0.0
    number: int = 0
    seed: int = 0

    @property
    def spec(self) -> Spec:
        """What is known of its kind."""
        return SPECS[self.part, self.kind]

    @property
    def end(self) -> float:
        """Instant at which it is over, s."""
        return self.start + self.duration

    @property
    def share(self) -> float:
        """Of a rate: an amount in %."""
        return self.amount / 100

    @property
    def name(self) -> str:
        """What is struck, and how: "camera0 stuck"."""
        return f"{self.part}{self.number if self.part is Part.CAMERA else ''} {self.kind}"

    def covers(self, instant: float) -> bool:
        """Whether it goes on at `instant`, s."""
        return self.start <= instant < self.end

    def __str__(self) -> str:
        """The text that names it."""
        spec, words = self.spec, [self.name]
        if spec.unit:
            words.append(f"{_digits(self.amount)}{spec.unit}")
        if self.start:
            words.append(f"at {_digits(self.start)}s")
        if self.duration != spec.lasts:
            words.append(f"for {_digits(self.duration)}s")
        if self.seed:
            words.append(f"seed {self.seed}")
        return " ".join(words)


def _digits(value: float) -> str:
    return repr(float(value)).removesuffix(".0")


def fault_from_text(where: object, key: str, text: object, part: Part | None = None) -> Fault:
    """The fault that a text names; InputError with `where` and `key` for one that none does.

    part: what a text strikes that does not say so.
    """
    words = text.split() if isinstance(text, str) else []
    if words and part is not None and words[0] != part:
        words.insert(0, part)
    if not words:
        raise InputError(where, key, text, SPELLING)
    struck, number = _part(where, key, text, words.pop(0))
    kind = _kind(where, key, text, struck, words)
    spec = SPECS[struck, kind]
    amount = _amount(where, key, text, spec, words) if spec.unit else 0.0
    if (struck, kind) == _STALLING and words and _QUANTITY.fullmatch(words[0]):
        words.insert(0, "for")
    said = _said(where, key, text, words)
    start, duration = said.get("at", 0.0), said.get("for", spec.lasts)
    if duration is None:
        raise InputError(where, key, text, f'how long: "{struck} {kind} 600ms"')
    if "for" in said and (kind is Kind.KILL or not duration > 0):
        allowed = "no duration: what is killed stays so" if kind is Kind.KILL else "a duration above 0"
        raise InputError(where, key, text, allowed)
    return Fault(struck, kind, start, duration, amount, number, int(said.get("seed", 0)))


def faults_from_texts(where: object, key: str, texts: object, part: Part | None = None) -> tuple[Fault, ...]:
    """The faults that a list of texts names; InputError as `fault_from_text`."""
    if not isinstance(texts, list):
        raise InputError(where, key, texts, f"a list of texts {SPELLING}")
    return tuple(fault_from_text(where, f"{key}[{i}]", text, part) for i, text in enumerate(texts))


def _part(where: object, key: str, text: object, word: str) -> tuple[Part, int]:
    known = [f"{p}0" if p is Part.CAMERA else str(p) for p in dict.fromkeys(part for part, _ in SPECS)]
    camera = re.fullmatch(r"camera(\d)", word)
    if camera and int(camera[1]) < CAMERAS:
        return Part.CAMERA, int(camera[1])
    if word not in known:
        raise InputError(where, key, text, f"{SPELLING}; the first word {checks.meant(word, known)}")
    return Part(word), 0


def _kind(where: object, key: str, text: object, part: Part, words: list[str]) -> Kind:
    known = [str(kind) for struck, kind in SPECS if struck is part]
    if not words or words[0] not in known:
        allowed = checks.meant(words[0] if words else "", known)
        raise InputError(where, key, text, f"{SPELLING}; after {part} {allowed}")
    return Kind(words.pop(0))


def _amount(where: object, key: str, text: object, spec: Spec, words: list[str]) -> float:
    allowed = f"an amount of {spec.low:g} to {spec.high:g} {spec.unit}"
    found = _QUANTITY.fullmatch(words[0]) if words else None
    if found is None:
        if spec.usual is None or (words and words[0] not in ("at", "for", "seed")):
            raise InputError(where, key, text, allowed)
        return spec.usual
    words.pop(0)
    value, unit = _seconds(found) if found[2] in ("ms", "s") else (float(found[1]), found[2])
    if unit != spec.unit or not spec.low <= value <= spec.high or value == 0:
        raise InputError(where, key, text, allowed)
    return value


def _seconds(found: re.Match[str]) -> tuple[float, str]:
    return float(found[1]) * (0.001 if found[2] == "ms" else 1.0), "s"


def _said(where: object, key: str, text: object, words: list[str]) -> dict[str, float]:
    """What "at", "for" and "seed" say."""
    said: dict[str, float] = {}
    allowed = f'{SPELLING}; then "at TIME", "for TIME", "seed N", each once, times up to {LONGEST:g}s'
    for name, value in zip(words[::2], [*words[1::2], ""], strict=False):
        found = _QUANTITY.fullmatch(value)
        if name in said or name not in ("at", "for", "seed"):
            raise InputError(where, key, text, allowed)
        if name == "seed" and re.fullmatch(r"\d{1,15}", value):
            said[name] = int(value)
        elif name != "seed" and found and found[2] in ("ms", "s") and 0 <= _seconds(found)[0] <= LONGEST:
            said[name] = _seconds(found)[0]
        else:
            raise InputError(where, key, text, allowed)
    return said


def struck(faults: Iterable[Fault], part: Part, *kinds: Kind) -> list[Fault]:
    """Those of the faults that strike a part, in one of these kinds if any is named."""
    return [fault for fault in faults if fault.part is part and (not kinds or fault.kind in kinds)]


def check_faults(faults: Sequence[Fault], runner: Runner, where: object, key: str, cameras: int = CAMERAS) -> None:
    """InputError for a fault that a command cannot let happen, or that strikes a camera which is not there."""
    for fault in faults:
        if runner not in fault.spec.runners:
            able = ", ".join(f"{part} {kind}" for (part, kind), spec in SPECS.items() if runner in spec.runners)
            others = " and ".join(fault.spec.runners)
            raise InputError(where, key, str(fault), f"what {runner} can do: {able}; {fault.name} is for {others}")
        if fault.part is Part.CAMERA and fault.number >= cameras:
            raise InputError(where, key, str(fault), f"camera0 to camera{cameras - 1}")
        if fault.kind is Kind.SWAP and cameras < 2:
            raise InputError(where, key, str(fault), "two cameras or more")


def drawn(fault: Fault) -> np.random.Generator:
    """The random numbers of a fault."""
    return np.random.default_rng([fault.seed, list(Kind).index(fault.kind), fault.number])
