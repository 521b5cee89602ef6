"""From torch to ONNX, checked: both must answer alike, at more than one size."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from torch import nn

from estimation.errors import StillbedError
from perception.training.loop import as_function
from perception.wound_network import Settings, WoundNetwork

OPSET = 17
SIZES = ((256, 192), (192, 192), (160, 256))  # px the two are compared at
ALIKE = 0.05  # of logits, which reach ten: weights are stored with eleven bits
LARGE = 512  # numbers from which a weight is worth storing in half


def export(network: nn.Module, file: Path, settings: Settings) -> float:
    """Write the network to `file` (.onnx) and its settings beside it (.toml); the largest difference of logits.

    Weights are stored in 16 bits and widened when the file is loaded; it is run in 32. StillbedError where onnxruntime
    answers otherwise than torch.
    """
    network.eval()
    axes = {"pictures": {2: "height", 3: "width"}, "logits": {2: "height", 3: "width"}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter of old, kept for its plain graphs, announces its age
        torch.onnx.export(
            network.to(memory_format=torch.contiguous_format),
            (torch.zeros(1, 3, *SIZES[0]),),
            str(file),
            input_names=["pictures"],
            output_names=["logits"],
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
        )
    _halve(file)
    write_settings(file.with_suffix(".toml"), settings, hashlib.sha256(file.read_bytes()).hexdigest())
    return _difference(network, file)


def _halve(file: Path) -> None:
    """Store the large weights of an ONNX file as float16, each behind a cast that onnxruntime folds away."""
    model = onnx.load(str(file))
    graph = model.graph
    for weight in list(graph.initializer):
        values: NDArray[np.float32] = numpy_helper.to_array(weight)
        if values.dtype != np.float32 or values.size < LARGE:
            continue
        name = weight.name
        graph.initializer.remove(weight)
        graph.initializer.append(numpy_helper.from_array(values.astype(np.float16), f"{name}_half"))
        graph.node.insert(0, helper.make_node("Cast", [f"{name}_half"], [name], to=onnx.TensorProto.FLOAT))
    onnx.checker.check_model(model)
    onnx.save(model, str(file))


def _difference(network: nn.Module, file: Path) -> float:
    run, check = as_function(network), WoundNetwork(file, 1)
    rng, largest = np.random.default_rng(0), 0.0
    for height, width in SIZES:
        planes = rng.random((1, 3, height, width), np.float32)
        largest = max(largest, float(np.abs(run(planes) - check(planes)).max()))
    if largest > ALIKE:
        raise StillbedError(f"{file}: onnxruntime's logits are off torch's by {largest:.2g}, allowed {ALIKE:g}")
    return largest


def write_settings(file: Path, settings: Settings, sha256: str) -> None:
    """The settings as TOML, with the hash of the network they belong to."""
    plain = [f.name for f in fields(Settings) if f.name != "looks"]
    lines = [f'sha256 = "{sha256}"', *(f"{name} = {getattr(settings, name):.6g}" for name in plain), "", "[looks]"]
    lines += [f"{name} = {value:g}" for name, value in asdict(settings.looks).items()]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
