"""Features found again: what every way of finding them hands on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from estimation.se3 import Array
from perception.frames import Image
from perception.thesis.region import Box


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The same features in two pictures: source (N, 2) px in the one before, destination (N, 2) px in this one.

    Both count from the corner of the box looked at. In Appendix A each counts from the corner of its own picture's
    box, so whenever the box changes its corner's move is taken for the surface's; that is a slip and not repeated.
    """

    source: Array
    destination: Array

    def __len__(self) -> int:
        return len(self.source)


class Finder(Protocol):
    """Remembers the features of one picture and finds them again in the next."""

    def begin(self, view: Image, box: Box) -> Array:
        """Remember the features in a box of a picture; their pixels (N, 2) there."""
        ...

    def find(self, view: Image, box: Box) -> Pairs:
        """The remembered features in the next picture, within `box`, which holds both places of the region."""
        ...

    def keep(self) -> None:
        """Remember the picture last looked at instead; not asked for where nothing was to be made of it."""
        ...


def no_pairs() -> Pairs:
    """Nothing was found again."""
    return Pairs(np.zeros((0, 2)), np.zeros((0, 2)))
