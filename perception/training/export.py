"""From torch to ONNX in whole numbers, checked: both must see the same wounds."""

from __future__ import annotations

import hashlib
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from estimation.errors import StillbedError
from perception.coarse_to_fine import Looks, wound_logits
from perception.dice import dice
from perception.training.dataset import Labelled
from perception.training.loop import as_function
from perception.training.quantise import Planes, quantise
from perception.wound.network import Settings, WoundNetwork

OPSET = 17
SHAPE = (1, 3, 256, 192)  # of the input that is traced; any other height and width in steps of 32 px will do
INPUT = "pictures"
CALIBRATED = 60  # pictures whose looks set the ranges of activations
ALIKE = 0.9  # mean Dice between masks of the two, from which they count as one network


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
        quantise(plain, file, INPUT, _seen(network, pictures[:CALIBRATED], looks))
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    write_settings(file.with_suffix(".toml"), Settings(), digest)
    written = WoundNetwork(file)
    write_settings(file.with_suffix(".toml"), choose(written), digest)
    alike = _alike(network, written, pictures, looks)
    if alike < ALIKE:
        raise StillbedError(f"{file}: its masks agree with torch's at a Dice of {alike:.3f}, allowed {ALIKE:g} or more")
    return alike


def _write(network: nn.Module, file: Path) -> None:
    axes = {INPUT: {2: "height", 3: "width"}, "logits": {2: "height", 3: "width"}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter of old, kept for its plain graphs, announces its age
        torch.onnx.export(
            network.to(memory_format=torch.contiguous_format),
            (torch.zeros(SHAPE),),
            str(file),
            input_names=[INPUT],
            output_names=["logits"],
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
        )


def _seen(network: nn.Module, pictures: Sequence[Labelled], looks: Looks) -> list[Planes]:
    """What the network is shown when it looks at the pictures."""
    run, seen = as_function(network), list[Planes]()

    def kept(planes: NDArray[np.float32]) -> NDArray[np.float32]:
        seen.append(planes)
        return run(planes)

    for each in pictures:
        wound_logits(each.picture, kept, looks)
    return seen


def _alike(network: nn.Module, written: WoundNetwork, pictures: Sequence[Labelled], looks: Looks) -> float:
    runs = as_function(network), written
    masks = [[wound_logits(each.picture, run, looks) > 0 for run in runs] for each in pictures]
    return float(np.mean([dice(ours, theirs) for ours, theirs in masks]))


def write_settings(file: Path, settings: Settings, sha256: str) -> None:
    """The settings as TOML, with the hash of the network they belong to."""
    plain = [f.name for f in fields(Settings) if f.name != "looks"]
    lines = [f'sha256 = "{sha256}"', *(f"{name} = {getattr(settings, name):.6g}" for name in plain), "", "[looks]"]
    lines += [f"{name} = {value:g}" for name, value in asdict(settings.looks).items()]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
