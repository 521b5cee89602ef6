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
    alike = _agreement(network, written, pictures, looks)
    if alike < MIN_AGREEMENT_DICE:
        raise StillbedError(
            f"{file}: its masks agree with torch's at a Dice of {alike:.3f}, allowed {MIN_AGREEMENT_DICE:g} or more"
        )
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

    def kept(planes: NDArray[np.float32]) -> NDArray[np.float32]:
        seen.append(planes)
        return run(planes)

    for each in pictures:
        wound_logits(each.picture, kept, looks)
    return seen


def _agreement(network: nn.Module, written: WoundNetwork, pictures: Sequence[Labelled], looks: Looks) -> float:
    runs = as_function(network), written
    masks = [[wound_logits(each.picture, run, looks) > 0 for run in runs] for each in pictures]
    return float(np.mean([dice(ours, theirs) for ours, theirs in masks]))


def write_settings(file: Path, settings: Settings, sha256: str) -> None:
    """The settings as TOML, with the hash of the network they belong to."""
    plain = [f.name for f in fields(Settings) if f.name != "looks"]
    lines = [f'sha256 = "{sha256}"', *(f"{name} = {getattr(settings, name):.6g}" for name in plain), "", "[looks]"]
    lines += [f"{name} = {value:g}" for name, value in asdict(settings.looks).items()]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutFigures:
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
class NetworkOrigin:
    """How a network was made. schedule: in words. alike: mean Dice of its masks before and after whole numbers."""

    name: str
    parameters: int
    schedule: str
    alike: float


def write_card(
    file: Path, making: NetworkOrigin, data: Sequence[str], judged: HeldOutFigures, settings: Settings, sha256: str
) -> None:
    """The card as Markdown. data: what was trained on and judged by, in words."""
    lines = [*_head(making, sha256), *_data(making.schedule, data), *_figures(judged), *_limits(settings)]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _head(making: NetworkOrigin, sha256: str) -> list[str]:
    return [
        f"# {making.name}",
        "",
        "Finds open wounds in a colour picture; gives a logit for each pixel. Runs in `perception/wound/network.py`.",
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


def _figures(judged: HeldOutFigures) -> list[str]:
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
