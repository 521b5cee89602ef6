"""What the training minimises."""

import torch
from torch import Tensor
from torch.nn import functional

# Pixels added above and below the soft Dice, which keep it defined for a sample without a wound; about the area of
# the smallest wound in a sample.
SMOOTH = 20.0


def wound_loss(logits: Tensor, wound: Tensor) -> Tensor:
    """Binary cross-entropy plus one minus the soft Dice of every picture by itself, (N, 1, H, W) each.

    Dice is taken per picture because that is what is judged: over a batch, the large wounds would decide.
    """
    probability = torch.sigmoid(logits)
    both = (probability * wound).sum((1, 2, 3))
    total = probability.sum((1, 2, 3)) + wound.sum((1, 2, 3))
    dice = (2 * both + SMOOTH) / (total + SMOOTH)
    return functional.binary_cross_entropy_with_logits(logits, wound) + (1 - dice).mean()


def thesis_loss(logits: Tensor, wound: Tensor) -> Tensor:
    """Binary cross-entropy alone, as in thesis 3.3."""
    return functional.binary_cross_entropy_with_logits(logits, wound)
