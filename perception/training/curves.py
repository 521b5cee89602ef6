"""Loss and Dice over the training, as one picture."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from perception.training.loop import Curve


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
