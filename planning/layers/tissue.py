"""Tissues of the skin, bottom up, and what each is printed with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from estimation.errors import InputError

MOST_LAYERS = 400  # a wound of 40 mm in layers of 0.1 mm


@dataclass(frozen=True, slots=True)
class Tissue:
    """One tissue. thickness: mm, None for what the others leave of the wound's depth. material: as the path names it.
    temperature: degrees C. speed: mm/s of printing. height: mm of a layer, about."""

    name: str
    thickness: float | None
    material: str
    temperature: float = 20.0
    speed: float = 20.0
    height: float = 0.4


@dataclass(frozen=True, slots=True)
class Slab:
    """One printed layer of the stack: from `low` to `high`, mm above the bottom of a stack `whole` mm high."""

    tissue: Tissue
    low: float
    high: float
    whole: float

    @property
    def middle(self) -> float:
        """mm above the bottom."""
        return (self.low + self.high) / 2


def slabs(tissues: Sequence[Tissue], whole: float) -> list[Slab]:
    """The layers of a stack `whole` mm high, bottom up, each tissue cut into equal ones near its layer height.

    A tissue without a thickness takes what the others leave: those over it then lie at their thickness under the skin.
    Where all have one, they are laid from the bottom and the last one goes on to the top. What a shallow wound has no
    room for is left out.
    """
    thicknesses = _fitted(tissues, whole)
    found, low = [], 0.0
    for tissue, thickness in zip(tissues, thicknesses, strict=True):
        count = max(1, round(thickness / tissue.height)) if thickness > 1e-6 else 0
        for k in range(count):
            found.append(Slab(tissue, low + thickness * k / count, low + thickness * (k + 1) / count, whole))
        low += thickness
    if len(found) > MOST_LAYERS:
        raise InputError("plan", "layers", len(found), f"{MOST_LAYERS} at most: thicker layers")
    return found


def _fitted(tissues: Sequence[Tissue], whole: float) -> list[float]:
    rest = next((i for i, t in enumerate(tissues) if t.thickness is None), None)
    below, above = (tissues, []) if rest is None else (tissues[:rest], tissues[rest + 1 :])
    room, top, bottom = whole, list[float](), list[float]()
    for tissue in reversed(above):
        top.append(min(tissue.thickness or 0.0, room))
        room -= top[-1]
    for tissue in below:
        bottom.append(min(tissue.thickness or 0.0, room))
        room -= bottom[-1]
    if rest is None:
        bottom[-1] += room
        return bottom
    return [*bottom, room, *reversed(top)]
