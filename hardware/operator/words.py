"""What a window says: parsed with suspicion, and never faster than a hand."""

from __future__ import annotations

import json
from dataclasses import dataclass

from hardware.operator.shared_state import Wish

LARGEST = 2**53 - 1  # what a browser's numbers can count to


@dataclass(frozen=True, slots=True)
class Ask:
    """A wish. turn: of the view it was asked under. tag: the window's own number for it."""

    wish: Wish
    turn: int
    tag: int


@dataclass(frozen=True, slots=True)
class Shown:
    """The window has shown the bundle of that number."""

    bundle: int


def parsed(text: str) -> Ask | Shown | None:
    """What a message says; None where it makes no sense."""
    try:
        said = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(said, dict):
        return None
    if said.keys() == {"shown"}:
        return Shown(said["shown"]) if _count(said["shown"]) else None
    if said.keys() != {"ask", "turn", "tag"} or not (_count(said["turn"]) and _count(said["tag"])):
        return None
    known = isinstance(said["ask"], str) and said["ask"] in Wish.__members__.values()
    return Ask(Wish(said["ask"]), said["turn"], said["tag"]) if known else None


def _count(value: object) -> bool:
    return type(value) is int and 0 <= value <= LARGEST


class Allowance:
    """So many a second, and as many at once as a second's worth and ten."""

    def __init__(self, rate: float, now: float) -> None:
        self._rate, self._most = rate, rate + 10
        self._left, self._then = self._most, now

    def take(self, now: float) -> bool:
        """Whether one more is allowed at `now`, s."""
        self._left = min(self._most, self._left + self._rate * (now - self._then))
        self._then = now
        if self._left < 1:
            return False
        self._left -= 1
        return True
