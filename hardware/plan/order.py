"""What a plan is asked for on the command line, read and checked: tissues, pattern, the tool's way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal, cast, get_args

import numpy as np

from estimation.errors import InputError
from planning.fill.pattern import Kind, Pattern
from planning.layers.bumps import Passing
from planning.layers.checkpoints import Way
from planning.layers.plan import Order
from planning.layers.slicing import Mode
from planning.layers.tissue import Tissue
from planning.layers.tool import ToolLimits
from planning.path import COLDEST, FASTEST, HOTTEST

Settled = Literal["shorter", "fastest"]
WHERE = "command line"
SKIN = (("hypodermis", None), ("dermis", 1.6), ("epidermis", 0.4))  # mm, bottom up; the epidermis, in truth 0.1 mm,
# is one layer of the default bead
TISSUE = "NAME=THICKNESS:MATERIAL[:TEMPERATURE[:SPEED[:LAYER_HEIGHT]]], mm (or rest), degrees C, mm/s, mm"


@dataclass(frozen=True, slots=True)
class Wishes:
    """The command line's own words: lengths mm, speeds mm/s, angles degrees. angle: degrees, shorter or fastest."""

    material: str = "1,2,3"
    tissues: tuple[str, ...] = ()
    layers: str = "skin"
    layer_height: float | None = None
    pattern: str = "contour"
    angle: str = "fastest"
    parallel: bool = False
    bead: float = 0.4
    overlap_percent: float = 0.0
    inset: float = 0.0
    rims: int = 1
    speed: float = 20.0
    travel: float = 60.0
    temperature: float = 20.0
    spacing: float = 1.0
    chord: float = 0.02
    lift: float = 2.0
    wait: float = 0.0
    sideways: float = 200.0
    tilt_deg: float = 30.0
    turning_deg_mm: float = 5.0
    spin_deg: float = 0.0
    bump: float | None = None
    bump_clearance: float | None = None

    def rows(self) -> list[tuple[str, str]]:
        """Each setting and its value, as text."""
        return [(f.name.replace("_", " "), self._text(f.name)) for f in fields(self)]

    def _text(self, name: str) -> str:
        value = getattr(self, name)
        if value is None or value == ():
            return UNSAID[name]
        if isinstance(value, bool):
            return "yes" if value else "no"
        return (
            "; ".join(value) if isinstance(value, tuple) else f"{value:g}" if isinstance(value, float) else str(value)
        )


def order_of(wishes: Wishes, flat: bool) -> Order:
    """What is to be planned. flat: one layer of one tissue."""
    w = wishes
    for name, low, high in RANGES:
        value = getattr(w, name)
        if value is not None and not low <= value <= high:
            raise InputError(WHERE, "--" + name.replace("_", "-"), value, f"{low:g} to {high:g}")
    pattern = Pattern(
        kind=cast(Kind, w.pattern), width=w.bead, overlap=w.overlap_percent / 100, inset=w.inset, angle=_angle(w.angle),
        rims=w.rims,
    )  # fmt: skip
    tool = ToolLimits(*(math.radians(v) for v in (w.tilt_deg, w.turning_deg_mm, w.spin_deg)))
    way = Way(w.spacing, w.chord, w.sideways, travel=w.travel, lift=w.lift, wait=w.wait, tool=tool)
    mode: Mode = "skin" if flat else cast(Mode, w.layers)
    return Order(_tissues(w, flat), pattern, mode, way, not w.parallel, Passing(w.bump, w.bump_clearance))


UNSAID = {
    "tissues": "hypodermis=rest, dermis=1.6, epidermis=0.4", "layer_height": "as wide as a bead",
    "bump": "half a layer", "bump_clearance": "half a bead",
}  # fmt: skip
RANGES = (
    ("bead", 0.01, 20), ("inset", 0, 100), ("rims", 0, 100),
    ("layer_height", 0.02, 20), ("overlap_percent", 0, 90), ("speed", 0.1, FASTEST), ("travel", 0.1, FASTEST),
    ("temperature", COLDEST, HOTTEST), ("spacing", 0.05, 50), ("chord", 0.001, 1), ("lift", 0, 50), ("wait", 0, 3600),
    ("sideways", 1, 100_000), ("tilt_deg", 0, 60), ("turning_deg_mm", 0.01, 90), ("spin_deg", -360, 360),
    ("bump", 0, 20), ("bump_clearance", 0, 20),
)  # fmt: skip


def _angle(text: str) -> float | Settled:
    if text in get_args(Settled):
        return cast(Settled, text)
    try:
        return float(np.deg2rad(float(text)))
    except ValueError:
        raise InputError(WHERE, "--angle", text, "degrees, shorter or fastest") from None


def _tissues(wishes: Wishes, flat: bool) -> tuple[Tissue, ...]:
    height = wishes.layer_height if wishes.layer_height is not None else wishes.bead
    if wishes.tissues:
        found = tuple(_tissue(text, wishes, height) for text in wishes.tissues)
    else:
        names = _materials(wishes.material)
        found = tuple(
            Tissue(name, thickness, names[min(i, len(names) - 1)], wishes.temperature, wishes.speed, height)
            for i, (name, thickness) in enumerate(SKIN)
        )
    if len({t.name for t in found}) < len(found):
        raise InputError(WHERE, "--tissue", ", ".join(t.name for t in found), "each name once")
    if sum(t.thickness is None for t in found) > 1:
        raise InputError(WHERE, "--tissue", ", ".join(wishes.tissues), "at most one that takes the rest")
    if flat and len(wishes.tissues) > 1:
        raise InputError(WHERE, "--tissue", ", ".join(wishes.tissues), "one: a contour is one layer")
    if flat:
        first = found[0]
        name = first.name if wishes.tissues else "layer"
        return (Tissue(name, None, first.material, first.temperature, first.speed, first.height),)
    return found


def _materials(text: str) -> Sequence[str]:
    names = [name.strip() for name in text.split(",")]
    if not all(_fine(name) for name in names) or len(names) not in (1, len(SKIN)):
        raise InputError(
            WHERE, "--material", text, "one name, or three with commas between: hypodermis, dermis, epidermis"
        )
    return names


def _fine(name: str) -> bool:
    return bool(name) and name.isprintable() and not any(c in name for c in ',"\n')


def _tissue(text: str, wishes: Wishes, height: float) -> Tissue:
    name, _, rest = text.partition("=")
    words = [word.strip() for word in rest.split(":")]
    if not _fine(name.strip()) or not 2 <= len(words) <= 5 or not _fine(words[1]):
        raise InputError(WHERE, "--tissue", text, TISSUE)
    thickness = None if words[0] == "rest" else _number(text, words[0], 0.02, 100)
    limits = ((COLDEST, HOTTEST), (0.1, FASTEST), (0.02, 20.0))
    numbers = [_number(text, word, *limit) for word, limit in zip(words[2:], limits, strict=False)]
    values = numbers + [wishes.temperature, wishes.speed, height][len(numbers) :]
    return Tissue(name.strip(), thickness, words[1], *values)


def _number(text: str, word: str, low: float, high: float) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise InputError(WHERE, f"--tissue {text}: {word}", word, f"{low:g} to {high:g}; {TISSUE}")
    return value


def check_out(out: Path, gcode: Path | None, force: bool) -> None:
    """Make the folder of the file that is written; InputError where it stands there already and `force` is not set."""
    if out.suffix.lower() != ".csv":
        raise InputError(WHERE, "--out", out, "a file that ends in .csv")
    for file in (out, *([gcode] if gcode else [])):
        if file.is_dir() or (file.exists() and not force):
            raise InputError(
                file, "--out", "a folder" if file.is_dir() else "a file that exists", "a new one, or --force"
            )
        file.parent.mkdir(parents=True, exist_ok=True)
