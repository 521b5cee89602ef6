"""The model card: what a network was made of, what it reaches, and what it must not be used for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation.se3 import Array
from perception.wound.network import Settings


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What was measured on pictures held out. dice: (N,) of each. empty: of them without a wound. silent_real,
    silent_rendered: shares of pieces without a wound in which none is found. before, after: mean Dice on the open half
    of a wound, uncovered and half covered."""

    dice: Array
    empty: int
    silent_real: float
    silent_rendered: float
    before: float
    after: float


@dataclass(frozen=True, slots=True)
class Making:
    """How a network was made. schedule: in words. alike: mean Dice of its masks before and after whole numbers."""

    name: str
    parameters: int
    schedule: str
    alike: float


def write_card(
    file: Path, making: Making, data: Sequence[str], judged: Judged, settings: Settings, sha256: str
) -> None:
    """The card as Markdown. data: what was trained on and judged by, in words."""
    lines = [*_head(making, sha256), *_data(making.schedule, data), *_figures(judged), *_limits(settings)]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _head(making: Making, sha256: str) -> list[str]:
    return [
        f"# {making.name}",
        "",
        "Finds open wounds in a colour picture; gives a logit for each pixel. Runs in `perception/wound_network.py`.",
        "",
        f"- {making.parameters / 1e6:.2f} million parameters, in 8 bits as are the activations, ONNX opset 17, any size"
        " in steps of 32 px",
        f"- sha256 `{sha256}`, checked whenever it is loaded",
        f"- its masks agree with those before the rounding to 8 bits at a mean Dice of {making.alike:.3f}",
        "",
    ]


def _data(schedule: str, data: Sequence[str]) -> list[str]:
    return [
        "## Data",
        "",
        *(f"- {line}" for line in data),
        "",
        f"{schedule} Thresholds were chosen on pictures that were neither trained on nor judged by.",
        "",
    ]


def _figures(judged: Judged) -> list[str]:
    dice = judged.dice
    quarter, median = np.percentile(dice, [25, 50])
    return [
        "## What it reaches, on pictures held out",
        "",
        "| figure | value |",
        "|---|---|",
        f"| pictures, of them without a wound | {len(dice)}, {judged.empty} |",
        f"| Dice of each picture: mean | {dice.mean():.3f} |",
        f"| median, lower quartile | {median:.3f}, {quarter:.3f} |",
        f"| pictures below 0.1 | {(dice < 0.1).sum()} |",
        f"| silent on pieces of healthy skin, real | {100 * judged.silent_real:.1f} % |",
        f"| silent on healthy skin, rendered | {100 * judged.silent_rendered:.1f} % |",
        f"| Dice on the open half: before it was half covered, after | {judged.before:.3f}, {judged.after:.3f} |",
        "",
    ]


def _limits(settings: Settings) -> list[str]:
    return [
        "## Limits",
        "",
        "- The pictures are of feet and lower legs, most of them taken in one clinic. Other places of the body, burns,"
        " fresh surgical wounds and sutures are not among them.",
        "- Views of one wound from quite other sides are not recognised as one group: the split is as strict as the"
        " measure of likeness.",
        f"- Wounds smaller than about 6 px of a picture made {settings.looks.long_side} px large are missed; several"
        " wounds far apart are seen less sharply, as the second look must hold them all.",
        f"- It says nothing where its confidence is below {settings.trust:.2f}. Confidence is calibrated on the same"
        " kind of pictures, not on other ones.",
        "- It is no medical device: it tells a tracker where to look, and no one what to treat.",
        "",
        "## Licences",
        "",
        "Foot Ulcer Segmentation Challenge 2021 (Wang et al., Sci Rep 10:21897): CC BY NC, as the challenge states."
        " Medetec pictures as published with the challenge's predecessor. The weights are derived from these and so are"
        " for research that is not commercial; the code is Apache-2.0.",
    ]
