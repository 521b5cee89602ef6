"""One table of a scenario, read key by key: each with its default and range, and what nobody asked for refused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process import checks
from hardware.process.checks import Table


@dataclass(slots=True)
class Keys:
    """Takes values out of a table. where: the file. prefix: in front of each key in an error ("motion[0].").

    A key without a default must be there. `done` is called last: it refuses every key that was not asked for.
    asked: so far, and whatever else may be there.
    """

    where: object
    prefix: str
    table: Table
    asked: list[str] = field(default_factory=list)

    def has(self, key: str) -> bool:
        """Whether the table has a key."""
        self.asked.append(key)
        return key in self.table

    def number(
        self, key: str, default: float | None = None, low: float = -math.inf, high: float = math.inf, open: bool = False
    ) -> float:
        """A finite number from low (above it where `open`) to high."""
        if not self._take(key, default is None):
            assert default is not None
            return default
        value = checks.number(self.where, self.prefix + key, self.table[key])
        if not (low < value <= high or (value == low and not open)):
            raise self.wrong(key, _range(low, high, open))
        return value

    def whole(self, key: str, default: int, low: int) -> int:
        """A whole number from low."""
        if not self._take(key, False):
            return default
        return checks.integer(self.where, self.prefix + key, self.table[key], low)

    def vector(self, key: str, default: Sequence[float] | None = None, low: float = -math.inf) -> Array:
        """Three finite numbers, each at least `low`."""
        if not self._take(key, default is None):
            return np.array(default, float)
        value = checks.numbers(self.where, self.prefix + key, self.table[key], (3,))
        if (value < low).any():
            raise self.wrong(key, f"3 numbers >= {low:g}")
        return value

    def axis(self, key: str, default: Sequence[float]) -> Array:
        """A direction (3,), made to unit length."""
        value = self.vector(key, default)
        length = float(np.linalg.norm(value))
        if length < 1e-9:
            raise self.wrong(key, "3 numbers, not all 0")
        return np.asarray(value / length)

    def band(self, key: str, default: tuple[float, float]) -> tuple[float, float]:
        """Two numbers, 0 < low < high."""
        low, high = self.pair(key, default)
        if not 0 < low < high:
            raise self.wrong(key, "[low, high], 0 < low < high")
        return low, high

    def pair(
        self, key: str, default: tuple[float, float], low: float = -math.inf, high: float = math.inf
    ) -> tuple[float, float]:
        """Two finite numbers from low to high."""
        if not self._take(key, False):
            return default
        first, second = checks.numbers(self.where, self.prefix + key, self.table[key], (2,))
        if not (low <= min(first, second) and max(first, second) <= high):
            raise self.wrong(key, f"2 numbers, each {_range(low, high, False)}")
        return float(first), float(second)

    def list_of_numbers(self, key: str, default: Sequence[float]) -> Array:
        """One finite number or more (N,)."""
        if not self._take(key, False):
            return np.array(default, float)
        value = checks.numbers(self.where, self.prefix + key, self.table[key], (None,))
        if not len(value):
            raise self.wrong(key, "one number or more")
        return value

    def flag(self, key: str, default: bool) -> bool:
        """true or false."""
        if not self._take(key, False):
            return default
        if not isinstance(self.table[key], bool):
            raise self.wrong(key, "true or false")
        return bool(self.table[key])

    def word(self, key: str, allowed: Sequence[str], default: str | None = None) -> str:
        """One of several words."""
        if not self._take(key, default is None):
            assert default is not None
            return default
        value = self.table[key]
        if not isinstance(value, str) or value not in allowed:
            raise self.wrong(key, checks.meant(str(value), allowed))
        return value

    def text(self, key: str) -> str:
        """A string that is not empty."""
        self._take(key, True)
        return checks.text(self.where, self.prefix + key, self.table[key])

    def wrong(self, key: str, allowed: str) -> InputError:
        """The error that a key's value is not allowed."""
        return InputError(self.where, self.prefix + key, self.table.get(key, "missing"), allowed)

    def done(self) -> None:
        """InputError for a key that nobody asked for."""
        checks.check_keys(self.where, self.prefix, self.table, (), list(dict.fromkeys(self.asked)))

    def _take(self, key: str, required: bool) -> bool:
        if self.has(key):
            return True
        if required:
            raise InputError(self.where, self.prefix + key, "missing", "this key")
        return False


def _range(low: float, high: float, open: bool) -> str:
    if math.isinf(low) and math.isinf(high):
        return "a finite number"
    if math.isinf(high):
        return f"{'>' if open else '>='} {low:g}"
    if math.isinf(low):
        return f"<= {high:g}"
    return f"{low:g} {'<' if open else '<='} it <= {high:g}"
