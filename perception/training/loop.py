"""The networks, their losses, and the training loop: seeded, and resumable after every round."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from perception.training.dataset import Augmentation, Labelled, SamplePyramid, draw_sample
from perception.wound.network import Looks, wound_logits
from perception.wound.segmentation import dice

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
    """How long and how fast; an hour or two on one core with AVX-512, which has instructions for bfloat16."""

    rounds: int = 60
    steps: int = 250  # a round
    batch: int = 8  # more steps for the same time: that, not noise, is what is short
    rate: float = 1.5e-3  # the highest, after the warm-up; falls to nothing as half a cosine
    warm_up: float = 0.03  # share of all steps
    decay: float = 0.02  # AdamW's weight decay
    average: float = 0.999  # of the averaged weights that each step keeps
    small: float = 0.35  # share of the rounds, the first, on small samples: half the time each (Tan & Le, ICML 2021)
    small_side: int = 128  # px
    seed: int = 1
    threads: int = 1

    def __str__(self) -> str:
        """The schedule in words, for the model card."""
        return (
            f"Trained from nothing for {self.rounds * self.steps} steps of {self.batch} samples, AdamW, half a cosine"
            f" from {self.rate:g}, weights averaged, seed {self.seed}."
        )


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
# About an hour of one core; of so few steps, weights averaged over a thousand would hold the first ones.
THESIS_SCHEDULE = Schedule(rounds=29, steps=100, batch=12, rate=1e-3, average=0.99, small=0.0)


@dataclass(slots=True)
class Curve:
    """What each round reached."""

    loss: list[float] = field(default_factory=list)  # mean
    dice: list[float] = field(default_factory=list)  # mean of the averaged weights on the pictures kept for choosing


@dataclass(frozen=True, slots=True)
class Source:
    """Pictures to draw samples from."""

    pyramids: Sequence[SamplePyramid]
    weights: NDArray[np.float64]  # (N,) how often each is drawn relative to the others


def train(
    network: nn.Module,
    source: Source,
    chosen_on: Sequence[Labelled],
    schedule: Schedule,
    checkpoint: Path,
    report: Callable[[int, int], None],
    recipe: Recipe,
) -> tuple[nn.Module, Curve]:
    """The network with averaged weights, and its curve; continues from `checkpoint` where there is one.

    `report(done, of)` counts steps. Every round draws from its own generator, so that a run that was broken off and
    continued is the run that was not.
    """
    torch.manual_seed(schedule.seed)
    torch.set_num_threads(schedule.threads)
    network = network.to(memory_format=torch.channels_last)
    averaged = torch.optim.swa_utils.AveragedModel(network, avg_fn=_average(schedule.average), use_buffers=True)
    optimiser = torch.optim.AdamW(network.parameters(), lr=schedule.rate, weight_decay=schedule.decay)
    curve = _continued(checkpoint, network, averaged, optimiser)
    for number in range(len(curve.loss), schedule.rounds):
        rng = np.random.default_rng([schedule.seed, number])
        small = number < schedule.small * schedule.rounds
        how = replace(recipe.augmentation, side=schedule.small_side) if small else recipe.augmentation
        batches = (_batch(source, schedule.batch, how, rng) for _ in range(schedule.steps))
        steps = range(number * schedule.steps, (number + 1) * schedule.steps)
        losses = []
        network.train()
        for step, (pictures, wounds) in zip(steps, batches, strict=True):
            for group in optimiser.param_groups:
                group["lr"] = rate_at(step, schedule)
            losses.append(_step(network, optimiser, recipe.loss, pictures, wounds))
            averaged.update_parameters(network)
            report(step + 1, schedule.rounds * schedule.steps)
        curve.loss.append(float(np.mean(losses)))
        curve.dice.append(mean_dice(averaged.module, chosen_on, recipe.looks))
        parts = {"network": network, "averaged": averaged, "optimiser": optimiser}
        state = {name: part.state_dict() for name, part in parts.items()}
        torch.save(state | {"curve": asdict(curve)}, checkpoint.with_suffix(".new"))
        checkpoint.with_suffix(".new").replace(checkpoint)
    return averaged.module, curve


def rate_at(step: int, schedule: Schedule) -> float:
    """Learning rate of a step: a straight rise, then half a cosine down to zero."""
    total = schedule.rounds * schedule.steps
    rise = max(1, round(schedule.warm_up * total))
    if step < rise:
        return schedule.rate * (step + 1) / rise
    return schedule.rate * 0.5 * (1 + float(np.cos(np.pi * (step - rise) / max(1, total - rise))))


def mean_dice(network: nn.Module, pictures: Sequence[Labelled], looks: Looks) -> float:
    """Mean over the pictures of each one's Dice at a probability of one half; nan without pictures."""
    run = as_function(network)
    return float(np.mean([dice(wound_logits(each.picture, run, looks) > 0, each.wound) for each in pictures] or np.nan))


def as_function(network: nn.Module) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """The network on arrays instead of tensors, in evaluation mode."""
    network.eval()

    def run(planes: NDArray[np.float32]) -> NDArray[np.float32]:
        with torch.inference_mode():
            tensor = torch.from_numpy(planes).contiguous(memory_format=torch.channels_last)
            return np.asarray(network(tensor).numpy(), np.float32)

    return run


def _average(keeps: float) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """The step of an exponential average that forgets its first, untrained weights sooner than `keeps` would."""

    def step(average: Tensor, new: Tensor, count: Tensor) -> Tensor:
        if not average.is_floating_point():
            return new
        return average.lerp(new, max(1 - keeps, 9 / (10 + int(count))))

    return step


def _continued(checkpoint: Path, network: nn.Module, averaged: nn.Module, optimiser: torch.optim.Optimizer) -> Curve:
    if not checkpoint.exists():
        return Curve()
    state = torch.load(checkpoint, weights_only=True)
    network.load_state_dict(state["network"])
    averaged.load_state_dict(state["averaged"])
    optimiser.load_state_dict(state["optimiser"])
    return Curve(**state["curve"])


def _step(
    network: nn.Module,
    optimiser: torch.optim.Optimizer,
    minimised: Callable[[Tensor, Tensor], Tensor],
    pictures: Tensor,
    wounds: Tensor,
) -> float:
    """One step down the loss of one batch; the loss before it."""
    with torch.autocast("cpu", torch.bfloat16):  # half the time where the processor has it, the same result but noise
        logits = network(pictures)
    loss = minimised(logits.float(), wounds)
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), 5.0)
    optimiser.step()
    return float(loss.item())


def _batch(source: Source, count: int, augmentation: Augmentation, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """(N, 3, side, side) pictures and (N, 1, side, side) wounds, both 0..1."""
    drawn = rng.choice(len(source.pyramids), (2, count), p=source.weights / source.weights.sum())
    samples = [draw_sample(source.pyramids[a], source.pyramids[b], augmentation, rng) for a, b in drawn.T]
    pictures = torch.from_numpy(np.stack([picture for picture, _ in samples]))
    wounds = torch.from_numpy(np.stack([wound for _, wound in samples]))
    # NHWC bytes seen as NCHW are what "channels last" means: no copy in between
    return pictures.permute(0, 3, 1, 2).float() / 255, wounds[:, None].float() / 255


def draw_curves(file: Path, curve: Curve, steps: int) -> None:
    """A PNG: loss above, mean Dice on the pictures kept for choosing below, over steps (`steps` a round)."""
    figure = Figure(figsize=(8, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    at = [steps * (number + 1) for number in range(len(curve.loss))]
    above.plot(at, curve.loss)
    above.set_ylabel("loss of the samples")
    below.plot(at, curve.dice)
    below.set_ylabel("mean Dice, averaged weights")
    below.set_xlabel("steps")
    below.set_ylim(0, 1)
    for axes in (above, below):
        axes.grid(alpha=0.3)
    figure.savefig(file, dpi=110)


def _convolution(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    layer = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(outputs))


class ResidualBlock(nn.Module):
    """Residual block of two 3x3 convolutions (He et al., CVPR 2016). Depth-wise blocks of the same accuracy class
    have a third fewer multiplications but take 1.3 times as long to train on a CPU, where they wait for memory."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels)
        self.second = _convolution(channels, channels)

    def forward(self, features: Tensor) -> Tensor:
        """(N, C, H, W) -> the same shape."""
        return features + self.second(functional.relu(self.first(features)))


class Context(nn.Module):
    """Adds what the whole picture looks like to every place (squeeze and add)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mix = nn.Sequential(nn.Conv2d(channels, channels, 1), nn.ReLU(), nn.Conv2d(channels, channels, 1))

    def forward(self, features: Tensor) -> Tensor:
        """(N, C, H, W) -> the same shape."""
        return features + self.mix(features.mean((2, 3), keepdim=True))


def _up(features: Tensor) -> Tensor:
    return functional.interpolate(features, scale_factor=2.0, mode="nearest")


def build_network(name: str, seed: int) -> nn.Module:
    """A network by name, "wound" or "thesis", with its first weights drawn from the seed."""
    torch.manual_seed(seed)
    return WoundNet() if name == "wound" else ThesisUNet()


def parameter_count(network: nn.Module) -> int:
    """How many numbers were learned."""
    return sum(parameter.numel() for parameter in network.parameters())


class WoundNet(nn.Module):
    """Encoder of five levels and a light decoder; (N, 3, H, W) in 0..1, RGB -> (N, 1, H, W) logits.

    H and W are multiples of 32. The first two levels only halve the picture, the depth lies at strides 8 and 16,
    and the last step puts out four sub-pixel logits a place, so that no layer runs at full size.
    """

    def __init__(self, widths: Sequence[int] = (16, 32, 64, 128, 192), depths: Sequence[int] = (1, 2, 3, 1)) -> None:
        super().__init__()
        self.stem = nn.Sequential(_convolution(3, widths[0], stride=2), nn.ReLU())
        self.downs = nn.ModuleList(_convolution(a, b, stride=2) for a, b in pairwise(widths))
        self.stages = nn.ModuleList(
            nn.Sequential(*(ResidualBlock(width) for _ in range(depth)))
            for width, depth in zip(widths[1:], depths, strict=True)
        )
        self.context = Context(widths[-1])
        rising = list(reversed(widths))
        self.laterals = nn.ModuleList(_convolution(a, b, 1) for a, b in pairwise(rising))
        self.skips = nn.ModuleList(_convolution(width, width, 1) for width in rising[1:])
        self.merges = nn.ModuleList(ResidualBlock(width) for width in rising[1:-1])
        self.fine = nn.Sequential(_convolution(widths[0], widths[0]), nn.ReLU())
        self.head = nn.Conv2d(widths[0], 4, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Logits of "this pixel belongs to a wound"."""
        levels = [self.stem((pictures - 0.45) * 4.0)]
        for down, stage in zip(self.downs, self.stages, strict=True):
            levels.append(stage(down(levels[-1])))
        features = self.context(levels.pop())
        for index, (lateral, skip) in enumerate(zip(self.laterals, self.skips, strict=True)):
            features = functional.relu(_up(lateral(features)) + skip(levels.pop()))
            features = self.merges[index](features) if index < len(self.merges) else self.fine(features)
        return functional.pixel_shuffle(self.head(features), 2)


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
            features = pair(torch.cat([levels.pop(), _up(features)], 1))
        return self.head(features)


def _pair(inputs: int, outputs: int) -> nn.Sequential:
    """Two convolutions with ReLU, He-initialised as in Appendix A; no normalisation, as there."""
    layers = (nn.Conv2d(inputs, outputs, 3, padding=1), nn.Conv2d(outputs, outputs, 3, padding=1))
    for layer in layers:
        nn.init.kaiming_normal_(layer.weight)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU())
