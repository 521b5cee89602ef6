"""The training loop: seeded, resumable after every round, the same steps on every machine of one kind."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from perception.coarse_to_fine import Looks, wound_logits
from perception.dice import dice
from perception.training.augmentation import Augmentation, Pyramid, sample
from perception.training.dataset import Labelled
from perception.training.losses import thesis_loss, wound_loss


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
THESIS = Recipe(
    Augmentation(side=128, long_side=128.0, whole=0.35, away=0.1, cover=0.0), thesis_loss, Looks(128, window=0)
)
# About an hour of one core; of so few steps, weights averaged over a thousand would hold the first ones.
THESIS_SCHEDULE = Schedule(rounds=29, steps=100, batch=12, rate=1e-3, average=0.99, small=0.0)


@dataclass(slots=True)
class Curve:
    """What each round reached: mean loss, and mean Dice of the averaged weights on the pictures kept for choosing."""

    loss: list[float] = field(default_factory=list)
    dice: list[float] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Source:
    """Pictures to draw samples from, and how often each is drawn relative to the others (N,)."""

    pyramids: Sequence[Pyramid]
    weights: NDArray[np.float64]


def train(
    network: nn.Module,
    source: Source,
    chosen_on: Sequence[Labelled],
    schedule: Schedule,
    checkpoint: Path,
    said: Callable[[int, int], None],
    recipe: Recipe,
) -> tuple[nn.Module, Curve]:
    """The network with averaged weights, and its curve; continues from `checkpoint` where there is one.

    `said(done, of)` counts steps. Every round draws from its own generator, so that a run that was broken off and
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
            said(step + 1, schedule.rounds * schedule.steps)
        curve.loss.append(float(np.mean(losses)))
        curve.dice.append(mean_dice(averaged.module, chosen_on, recipe.looks))
        state = {
            "network": network.state_dict(),
            "averaged": averaged.state_dict(),
            "optimiser": optimiser.state_dict(),
        }
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
    samples = [sample(source.pyramids[a], source.pyramids[b], augmentation, rng) for a, b in drawn.T]
    pictures = torch.from_numpy(np.stack([picture for picture, _ in samples]))
    wounds = torch.from_numpy(np.stack([wound for _, wound in samples]))
    # NHWC bytes seen as NCHW are what "channels last" means: no copy in between
    return pictures.permute(0, 3, 1, 2).float() / 255, wounds[:, None].float() / 255
