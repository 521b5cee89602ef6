"""One measured figure beside what it should be and what others reach."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Target:
    """What a figure should be: from `low` to `high`, both included, in the figure's unit."""

    low: float = -math.inf
    high: float = math.inf

    def met(self, value: float) -> bool:
        """Whether `value` lies within; what is not a number does not."""
        return self.low <= value <= self.high

    def __str__(self) -> str:
        """The target in words: <= 0.03, >= 0.93 or 0.8 to 1.25."""
        if math.isinf(self.low):
            return f"<= {self.high:g}"
        return f">= {self.low:g}" if math.isinf(self.high) else f"{self.low:g} to {self.high:g}"


def at_most(value: float) -> Target:
    """A target that is better from below."""
    return Target(high=value)


def at_least(value: float) -> Target:
    """A target that is better from above."""
    return Target(low=value)


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure.

    what: in words, unique within a subject. value: in `unit`, nan where it could not be measured. target: None for a
    figure that only informs. reference: what others reach, in words. note: how it was measured, or why it is missing.
    """

    what: str
    value: float
    unit: str = ""
    target: Target | None = None
    reference: str = ""
    note: str = ""

    @property
    def verdict(self) -> str:
        """met, MISSED, or nothing without a target."""
        if self.target is None:
            return ""
        return "met" if self.target.met(self.value) else "MISSED"
