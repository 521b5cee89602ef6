"""From torch to ONNX with 8-bit weights and activations, checked against torch; settings and model card beside it.

Eight bits take about a third of the time, and half the file, for a thousandth or two of Dice.
"""

from __future__ import annotations

import hashlib
import logging
import tempfile
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from torch import nn

from estimation.errors import StillbedError
from estimation.se3 import Array
from perception.training.dataset import Labelled
from perception.training.loop import as_function
from perception.wound.network import Looks, Settings, WoundNetwork, wound_logits
from perception.wound.segmentation import dice

Planes = NDArray[np.float32]  # (1, 3, H, W) RGB in 0..1


class _CalibrationInputs(CalibrationDataReader):
    """Hands what the network saw to onnxruntime, one input after the other."""

    def __init__(self, name: str, seen: Iterable[Planes]) -> None:
        self._name, self._seen = name, iter(seen)

    def get_next(self) -> dict[str, Planes] | None:
        """The next input by its name; None after the last."""
        planes = next(self._seen, None)
        return None if planes is None else {self._name: planes}


def quantise(file: Path, into: Path, name: str, seen: Iterable[Planes]) -> None:
    """Write the ONNX network of `file` in whole numbers to `into`. name: of its input. seen: what it usually sees.

    Ranges of activations are the widest that occur in `seen`; weights have a scale for each output channel and seven
    bits: products of eight overflow the 16-bit sums of processors that have no dot product of bytes.
    """
    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)  # it recommends a preparation that folds what torch has folded already
    try:
        quantize_static(
            str(file),
            str(into),
            _CalibrationInputs(name, seen),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
    finally:
        root.setLevel(level)


ONNX_OPSET = 17
TRACED_SHAPE = (1, 3, 256, 192)  # of the input that is traced; any other height and width in steps of 32 px will do
INPUT_NAME = "pictures"
CALIBRATION_PICTURES = 60  # pictures whose looks set the ranges of activations
MIN_AGREEMENT_DICE = 0.9  # mean Dice between masks of the two, from which they count as one network


def export(
    network: nn.Module,
    file: Path,
    pictures: Sequence[Labelled],
    looks: Looks,
    choose: Callable[[WoundNetwork], Settings],
) -> float:
    """Write the network to `file` (.onnx) and its settings beside it (.toml); mean Dice of its masks with torch's.

    pictures: that set the ranges of activations, and on which the two are compared. looks: how it is shown them.
    choose: gives the settings, by what is written and not by what it came from. StillbedError where the two see
    different wounds.
    """
    network.eval()
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.onnx"
        _write(network, plain)
        quantise(plain, file, INPUT_NAME, _network_inputs(network, pictures[:CALIBRATION_PICTURES], looks))
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    write_settings(file.with_suffix(".toml"), Settings(), digest)
    written = WoundNetwork(file)
    write_settings(file.with_suffix(".toml"), choose(written), digest)
    runs = as_function(network), written
    masks = [[wound_logits(each.picture, run, looks) > 0 for run in runs] for each in pictures]
    alike = float(np.mean([dice(before, after) for before, after in masks]))
    if alike < MIN_AGREEMENT_DICE:
        agreement = f"its masks agree with torch's at a Dice of {alike:.3f}"
        raise StillbedError(f"{file}: {agreement}, allowed {MIN_AGREEMENT_DICE:g} or more")
    return alike


def _write(network: nn.Module, file: Path) -> None:
    axes = {INPUT_NAME: {2: "height", 3: "width"}, "logits": {2: "height", 3: "width"}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter of old, kept for its plain graphs, announces its age
        torch.onnx.export(
            network.to(memory_format=torch.contiguous_format),
            (torch.zeros(TRACED_SHAPE),),
            str(file),
            input_names=[INPUT_NAME],
            output_names=["logits"],
            dynamic_axes=axes,
            opset_version=ONNX_OPSET,
            dynamo=False,
        )


def _network_inputs(network: nn.Module, pictures: Sequence[Labelled], looks: Looks) -> list[Planes]:
    run, seen = as_function(network), list[Planes]()

    def recorded(planes: NDArray[np.float32]) -> NDArray[np.float32]:
        seen.append(planes)
        return run(planes)

    for each in pictures:
        wound_logits(each.picture, recorded, looks)
    return seen


def write_settings(file: Path, settings: Settings, sha256: str) -> None:
    """The settings as TOML, with the hash of the network they belong to."""
    plain = [f.name for f in fields(Settings) if f.name != "looks"]
    lines = [f'sha256 = "{sha256}"', *(f"{name} = {getattr(settings, name):.6g}" for name in plain), "", "[looks]"]
    lines += [f"{name} = {value:g}" for name, value in asdict(settings.looks).items()]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutFigures:
    """What was measured on pictures held out."""

    dice: Array  # (N,) of each
    empty: int  # of them without a wound
    silent_real: float  # share of real pieces without a wound in which none is detected
    silent_rendered: float  # the same of rendered ones
    before: float  # mean Dice on the open half of a wound, uncovered
    after: float  # the same, half covered


@dataclass(frozen=True, slots=True)
class NetworkOrigin:
    """How a network was made."""

    name: str
    parameters: int
    schedule: str  # in words
    alike: float  # mean Dice of its masks before and after the rounding to 8 bits


def write_card(
    file: Path, origin: NetworkOrigin, data: Sequence[str], figures: HeldOutFigures, settings: Settings, sha256: str
) -> None:
    """The card as Markdown. data: what was trained on and evaluated by, in words."""
    dice = figures.dice
    quarter, median = np.percentile(dice, [25, 50])
    sources = "\n".join(f"- {line}" for line in data)
    card = f"""\
# {origin.name}

Finds open wounds in a colour picture; gives a logit for each pixel. Runs in `perception/wound/network.py`.

- {origin.parameters / 1e6:.2f} million parameters, in 8 bits as are the activations, ONNX opset 17, any size in steps\
 of 32 px
- sha256 `{sha256}`, checked whenever it is loaded
- its masks agree with those before the rounding to 8 bits at a mean Dice of {origin.alike:.3f}

## Data

{sources}

{origin.schedule} Thresholds were chosen on pictures that were neither trained on nor judged by.

## What it reaches, on pictures held out

| figure | value |
|---|---|
| pictures, of them without a wound | {len(dice)}, {figures.empty} |
| Dice of each picture: mean | {dice.mean():.3f} |
| median, lower quartile | {median:.3f}, {quarter:.3f} |
| pictures below 0.1 | {(dice < 0.1).sum()} |
| silent on pieces of healthy skin, real | {100 * figures.silent_real:.1f} % |
| silent on healthy skin, rendered | {100 * figures.silent_rendered:.1f} % |
| Dice on the open half: before it was half covered, after | {figures.before:.3f}, {figures.after:.3f} |

## Limits

- The pictures are of feet and lower legs, most of them taken in one clinic. Other places of the body, burns, fresh\
 surgical wounds and sutures are not among them.
- Views of one wound from quite other sides are not recognised as one group: the split is as strict as the measure of\
 likeness.
- Wounds smaller than about 6 px of a picture made {settings.looks.long_side} px large are missed; several wounds far\
 apart are seen less sharply, as the second look must hold them all.
- It says nothing where its confidence is below {settings.trust:.2f}. Confidence is calibrated on the same kind of\
 pictures, not on other ones.
- It is no medical device: it tells a tracker where to look, and no one what to treat.

## Licences

Foot Ulcer Segmentation Challenge 2021 (Wang et al., Sci Rep 10:21897): CC BY NC, as the challenge states. Medetec\
 pictures as published with the challenge's predecessor. The weights are derived from these and so are for research\
 that is not commercial; the code is Apache-2.0.
"""
    file.write_text(card, encoding="utf-8")
