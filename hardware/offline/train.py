"""`stillbed train`: a segmentation network with its settings, card and curves, from labelled pictures."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError, StillbedError
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from perception.training.dataset import Labelled, healthy_pieces, hold_out_groups, picture_groups, read_dataset

if TYPE_CHECKING:
    from perception.training.export import NetworkOrigin

SPLIT_SEED = 2024  # fixed: figures of networks trained with other seeds are of the same pictures
VALIDATION_PICTURES = 60  # pictures kept for choosing thresholds
OTHER_SET_WEIGHT = 0.35  # of a picture of a further data set, relative to the first's: it is contained four times
HEALTHY_PIECES = 200  # pieces of real healthy skin for the evaluation; a third as many rendered ones
DRAWS_PER_PICTURE = 3  # pieces from each of the few pictures kept for choosing
RENDERED_SEED = 5000  # the first; the bench uses those below


class RenderedView(Protocol):
    """A rendered picture of skin. image: (H, W, 3) BGR. wound: (H, W) bool, all False of healthy skin."""

    @property
    def image(self) -> NDArray[np.uint8]: ...  # noqa: D102

    @property
    def wound(self) -> NDArray[np.bool_]: ...  # noqa: D102


RenderView = Callable[[int, bool], RenderedView]  # (seed, wounded): the simulator's renderer, given by the command line


@dataclass(frozen=True, slots=True, eq=False)
class DatasetParts:
    """The first data set split by use, and the other pictures for training."""

    trained: Sequence[Labelled]
    chosen_on: Sequence[Labelled]  # for choosing thresholds
    held_out: Sequence[Labelled]
    others: Sequence[Labelled]  # of further data sets and rendered, for training
    group_count: int  # groups of near-duplicates in the first data set


def run_train(options: argparse.Namespace, render_view: RenderView) -> str:
    """Train, choose thresholds, export and evaluate; returns the result in words."""
    out: Path = options.out
    _check(options)
    parts = _parts(options, render_view)
    if options.network == "shape":
        from perception.training.metrics import fit_shapes, write_shape_model

        with _progress("fit", "pictures") as progress:
            write_shape_model(out, fit_shapes(parts.trained, options.seed, progress))
        return f"{out} is written; judge it with stillbed bench segmentation"
    from perception.training import loop
    from perception.training.dataset import sample_pyramid
    from perception.training.export import NetworkOrigin, export
    from perception.training.metrics import chosen_settings

    network = loop.build_network(options.network, options.seed)
    recipe, schedule = loop.Recipe(), loop.Schedule()
    if options.network == "thesis":
        recipe, schedule = loop.THESIS_RECIPE, loop.THESIS_SCHEDULE
    rounds = options.rounds or schedule.rounds
    schedule = replace(schedule, rounds=rounds, seed=options.seed, threads=options.threads)
    weights = np.r_[np.ones(len(parts.trained)), np.full(len(parts.others), OTHER_SET_WEIGHT)]
    source = loop.Source([sample_pyramid(each) for each in (*parts.trained, *parts.others)], weights)
    checkpoint = out.with_suffix(".ckpt")
    with _progress("train", "steps") as progress:
        network, curve = loop.train(network, source, parts.chosen_on, schedule, checkpoint, progress, recipe)
    loop.draw_curves(out.with_name(f"{out.stem}_curves.png"), curve, schedule.steps)
    rng = np.random.default_rng(SPLIT_SEED)
    real = [piece for _ in range(DRAWS_PER_PICTURE) for piece in healthy_pieces(parts.chosen_on, rng, HEALTHY_PIECES)]
    healthy = [*real, *_healthy_rendered(render_view, RENDERED_SEED - HEALTHY_PIECES, HEALTHY_PIECES // 6)]
    choose = partial(chosen_settings, pictures=parts.chosen_on, healthy=healthy, looks=recipe.looks)
    alike = export(network, out, parts.chosen_on, recipe.looks, choose)
    (out.with_name(f"{out.stem}_held_out.txt")).write_text("".join(f"{p.name}\n" for p in parts.held_out), "utf-8")
    origin = NetworkOrigin(out.stem, loop.parameter_count(network), str(schedule), alike)
    return evaluate(out, parts, origin, render_view)


def evaluate(out: Path, parts: DatasetParts, origin: NetworkOrigin, render_view: RenderView) -> str:
    """Evaluate the network in `out` on the pictures held out, and write its card."""
    from perception.training.export import HeldOutFigures, write_card
    from perception.training.metrics import dice_before_and_after_cover, scores, silent_share
    from perception.wound.network import WoundNetwork, hash_of
    from perception.wound.segmentation import NetworkSegmenter

    network = WoundNetwork(out)
    segmenter = NetworkSegmenter(network, network.settings)
    with _progress("judge", "pictures") as progress:
        dice = scores(segmenter, parts.held_out, progress)
    rng = np.random.default_rng(SPLIT_SEED)
    before, after = dice_before_and_after_cover(segmenter, parts.held_out, rng)
    real = silent_share(segmenter, healthy_pieces(parts.held_out, rng, HEALTHY_PIECES))
    rendered = silent_share(segmenter, _healthy_rendered(render_view, 0, HEALTHY_PIECES // 3))
    empty = sum(not each.wound.any() for each in parts.held_out)
    figures = HeldOutFigures(dice, empty, real, rendered, before, after)
    data = (
        f"{len(parts.trained)} pictures trained on, {len(parts.chosen_on)} for choosing thresholds,"
        f" {len(parts.held_out)} held out",
        f"{len(parts.others)} further pictures trained on, of other data sets and rendered ones",
        f"split by {parts.group_count} groups of near-duplicates (small colour copies, mirrored and turned; SIFT),"
        " never at random",
    )
    write_card(out.with_suffix(".md"), origin, data, figures, network.settings, hash_of(out))
    result = f"mean Dice of {len(dice)} pictures held out: {dice.mean():.3f} (median {np.median(dice):.3f})"
    return f"{result}\n{out}, its settings and its card are written"


def _parts(options: argparse.Namespace, render_view: RenderView) -> DatasetParts:
    """The data sets read, and the first one split by groups, always the same way."""
    data_sets = []
    for folder in options.datasets:
        with _progress(f"read {folder.name}", "pictures") as progress:
            data_sets.append(read_dataset(folder, progress))
    pictures = data_sets[0]
    if len(pictures) < options.hold_out + VALIDATION_PICTURES + 1:
        needed = f"more than the {options.hold_out} held out and {VALIDATION_PICTURES} for choosing"
        raise InputError(options.datasets[0], "pictures", len(pictures), needed)
    others = [each for data_set in data_sets[1:] for each in data_set] + _rendered(render_view, options.rendered)
    group, rng = picture_groups(pictures), np.random.default_rng(SPLIT_SEED)
    held = hold_out_groups(group, options.hold_out, rng)
    rest = np.flatnonzero(~held)
    chosen = np.zeros(len(pictures), bool)
    chosen[rest[hold_out_groups(group[rest], VALIDATION_PICTURES, rng)]] = True
    uses = (~held & ~chosen, chosen, held)
    trained, chosen_on, held_out = ([pictures[i] for i in np.flatnonzero(mask).tolist()] for mask in uses)
    return DatasetParts(trained, chosen_on, held_out, others, len(np.unique(group)))


def _rendered(render_view: RenderView, count: int) -> list[Labelled]:
    """Rendered pictures, every fourth of healthy skin, so that the network segments the simulator's wounds as well."""
    pictures = []
    with _progress("render", "pictures") as progress:
        for number in range(count):
            view = render_view(RENDERED_SEED + number, number % 4 != 3)
            picture = np.ascontiguousarray(view.image[..., ::-1])
            pictures.append(Labelled(f"rendered/{RENDERED_SEED + number}", picture, view.wound))
            progress(number + 1, count)
    return pictures


def _healthy_rendered(render_view: RenderView, first: int, count: int) -> list[NDArray[np.uint8]]:
    return [np.ascontiguousarray(render_view(first + number, False).image[..., ::-1]) for number in range(count)]


def _check(options: argparse.Namespace) -> None:
    out: Path = options.out
    shapes = options.network == "shape"
    if not shapes and find_spec("torch") is None:
        raise StillbedError("train needs torch: pip install 'stillbed[train]'")
    if out.suffix != (".toml" if shapes else ".onnx"):
        raise InputError("command line", "--out", str(out), f"a name that ends in {'.toml' if shapes else '.onnx'}")
    if not out.parent.is_dir():
        raise InputError("command line", "--out", str(out), "a file in a folder that exists")
    if options.force:
        out.with_suffix(".ckpt").unlink(missing_ok=True)
    elif out.exists():
        raise InputError(out, "--out", "a file", "a new one, or --force")
    for name, value, least in (("--hold-out", options.hold_out, 1), ("--rendered", options.rendered, 0)):
        if value < least:
            raise InputError("command line", name, value, f"{least} or more")
    if options.rounds is not None and options.rounds < 1:
        raise InputError("command line", "--rounds", options.rounds, "1 or more")


def _progress(what: str, unit: str) -> Progress:
    return Progress(what, unit, WallClock().now)
