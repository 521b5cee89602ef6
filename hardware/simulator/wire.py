"""A serial line, 8N1, in virtual time: bytes go one after the other, ten bits each."""

from __future__ import annotations

import math

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.profile import BITS_PER_BYTE


class Wire:
    """One direction of a line; remembers until when it is busy. baud: bits/s, infinite for a line without delay."""

    def __init__(self, baud: float) -> None:
        if not baud > 0:
            raise InputError("wire", "baud", baud, "> 0 bits/s")
        self._byte_time = BITS_PER_BYTE / baud
        self._free = -math.inf

    def send(self, data: bytes, now: float) -> Array:
        """Instants (N,), s, at which the bytes handed over at `now` have arrived; they wait for those before them."""
        arrivals = max(self._free, now) + self._byte_time * np.arange(1, len(data) + 1)
        if len(arrivals):
            self._free = float(arrivals[-1])
        return np.asarray(arrivals)

    @property
    def free(self) -> float:
        """Instant, s, at which the last byte sent so far has arrived; -inf before the first."""
        return self._free
