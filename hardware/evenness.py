"""How evenly a machine works: the same small work, timed again and again.

A machine that shares its memory with others, as a virtual one does, may for some tens of milliseconds take ten times as
long for the same, with nothing else running on it. No process waits then, so neither load nor priority tells of it, and
no priority helps. A loop that is late by 50 ms every other second may owe that to nothing but its machine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array
from hardware.process.clock import Clock

CALLS = 20  # of each kind in a piece of work: a quarter of a millisecond, a fraction of a tick of the motion
SLOW = 3.0  # times the usual


@dataclass(frozen=True, slots=True)
class Evenness:
    """usual, largest: s that a piece of work took. slow: share of the time in pieces that took over SLOW usual ones."""

    usual: float
    largest: float
    slow: float

    def __str__(self) -> str:
        """In words."""
        usual, largest = 1000 * self.usual, 1000 * self.largest
        return f"{usual:.2f} ms of work took {largest:.0f} ms at the worst; {self.slow:.1%} of the time work was slow"


def evenness(clock: Clock, pieces: int) -> Evenness:
    """Do so many pieces of work, one after the other. The process should have nothing else to do."""
    rng = np.random.default_rng(0)
    small, many = rng.random((6, 6)) + 6 * np.eye(6), rng.random((50, 4, 4))
    spent = np.empty(pieces)
    for k in range(pieces):
        begun = clock.now()
        for _ in range(CALLS):
            np.linalg.inv(small)
            many @ many
            np.concatenate([small, small])
        spent[k] = clock.now() - begun
    return judged(spent)


def judged(spent: Array) -> Evenness:
    """Of pieces that took spent (N,), s."""
    usual, whole = float(np.median(spent)), float(spent.sum())
    slow = float(spent[spent > SLOW * usual].sum())
    return Evenness(usual, float(spent.max()), slow / whole if whole > 0 else 0.0)
