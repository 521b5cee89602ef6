"""`stillbed train`: labelled pictures in, a network with its settings, card and curves out."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError, StillbedError
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from perception.training.dataset import Labelled, read_dataset
from perception.training.groups import groups, split
from perception.training.healthy import healthy_pieces

if TYPE_CHECKING:
    from perception.training.card import Making

SPLIT_SEED = 2024  # fixed: figures of networks trained with other seeds are of the same pictures
CHOSEN_ON = 60  # pictures kept for choosing thresholds
OTHERS = 0.35  # how often a picture of a further data set is drawn, relative to the first: it is in there four times
HEALTHY = 200  # pieces of healthy skin, real, to judge by; a third as many rendered ones
DRAWS = 3  # pieces from each of the few pictures kept for choosing
RENDERED_SEED = 5000  # the seeds below are the bench's


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """The first data set in its three uses, and everything else that is trained on. groups: how many it falls into."""

    trained: Sequence[Labelled]
    chosen_on: Sequence[Labelled]
    held_out: Sequence[Labelled]
    others: Sequence[Labelled]
    groups: int


def run_train(options: argparse.Namespace) -> str:
    """Train, choose thresholds, export, judge; what it came to, in words."""
    out: Path = options.out
    _check(options)
    if options.network == "shape":
        return _shapes(_parts(options), out, options.seed)
    from perception.training.augmentation import pyramid
    from perception.training.card import Making
    from perception.training.choosing import chosen_settings
    from perception.training.curves import draw_curves
    from perception.training.export import export
    from perception.training.loop import THESIS, THESIS_SCHEDULE, Recipe, Schedule, Source, train
    from perception.training.networks import made, size_of

    parts = _parts(options)
    network = made(options.network, options.seed)
    recipe, usual = (THESIS, THESIS_SCHEDULE) if options.network == "thesis" else (Recipe(), Schedule())
    schedule = replace(usual, rounds=options.rounds or usual.rounds, seed=options.seed, threads=options.threads)
    weights = np.r_[np.ones(len(parts.trained)), np.full(len(parts.others), OTHERS)]
    source = Source([pyramid(each) for each in (*parts.trained, *parts.others)], weights)
    with _progress("train", "steps") as said:
        network, curve = train(network, source, parts.chosen_on, schedule, out.with_suffix(".ckpt"), said, recipe)
    draw_curves(out.with_name(f"{out.stem}_curves.png"), curve, schedule.steps)
    rng = np.random.default_rng(SPLIT_SEED)
    real = [piece for _ in range(DRAWS) for piece in healthy_pieces(parts.chosen_on, rng, HEALTHY)]
    healthy = [*real, *_healthy_rendered(RENDERED_SEED - HEALTHY, HEALTHY // 6)]
    alike = export(
        network,
        out,
        parts.chosen_on,
        recipe.looks,
        lambda written: chosen_settings(written, parts.chosen_on, healthy, recipe.looks),
    )
    (out.with_name(f"{out.stem}_held_out.txt")).write_text("".join(f"{p.name}\n" for p in parts.held_out), "utf-8")
    return finish(out, parts, Making(out.stem, size_of(network), str(schedule), alike))


def _shapes(parts: Parts, out: Path, seed: int) -> str:
    """Learn how outlines of wounds look; the same pictures as for a network, rendered ones apart."""
    from perception.training.metrics import fit_shapes, write_shape_model

    with _progress("fit", "pictures") as said:
        write_shape_model(out, fit_shapes(parts.trained, seed, said))
    return f"{out} is written; judge it with stillbed bench segmentation"


def finish(out: Path, parts: Parts, making: Making) -> str:
    """Judge the network in `out` on what was held out, and write its card."""
    from perception.training.card import Judged, write_card
    from perception.training.judging import half_covered_fall, scores, silent
    from perception.wound.network import WoundNetwork, hash_of
    from perception.wound.segmentation import NetworkSegmenter

    network = WoundNetwork(out)
    segmenter = NetworkSegmenter(network, network.settings)
    with _progress("judge", "pictures") as said:
        dice = scores(segmenter, parts.held_out, said)
    rng = np.random.default_rng(SPLIT_SEED)
    before, after = half_covered_fall(segmenter, parts.held_out, rng)
    real = silent(segmenter, healthy_pieces(parts.held_out, rng, HEALTHY))
    rendered = silent(segmenter, _healthy_rendered(0, HEALTHY // 3))
    empty = sum(not each.wound.any() for each in parts.held_out)
    judged = Judged(dice, empty, real, rendered, before, after)
    data = (
        f"{len(parts.trained)} pictures trained on, {len(parts.chosen_on)} for choosing thresholds,"
        f" {len(parts.held_out)} held out",
        f"{len(parts.others)} further pictures trained on, of other data sets and rendered ones",
        f"split by {parts.groups} groups of near-duplicates (small colour copies, mirrored and turned; SIFT), never at"
        " random",
    )
    write_card(out.with_suffix(".md"), making, data, judged, network.settings, hash_of(out))
    reached = f"mean Dice of {len(dice)} pictures held out: {dice.mean():.3f} (median {np.median(dice):.3f})"
    return f"{reached}\n{out}, its settings and its card are written"


def parts_of(pictures: Sequence[Labelled], others: Sequence[Labelled], held_out: int) -> Parts:
    """The three parts of a data set, split by groups, always the same."""
    group, rng = groups(pictures), np.random.default_rng(SPLIT_SEED)
    held = split(group, held_out, rng)
    rest = np.flatnonzero(~held)
    chosen = np.zeros(len(pictures), bool)
    chosen[rest[split(group[rest], CHOSEN_ON, rng)]] = True

    def those(mask: NDArray[np.bool_]) -> list[Labelled]:
        return [pictures[number] for number in np.flatnonzero(mask).tolist()]

    return Parts(those(~held & ~chosen), those(chosen), those(held), others, len(np.unique(group)))


def _parts(options: argparse.Namespace) -> Parts:
    read = []
    for folder in options.datasets:
        with _progress(f"read {folder.name}", "pictures") as said:
            read.append(read_dataset(folder, said))
    if len(read[0]) < options.hold_out + CHOSEN_ON + 1:
        needed = f"more than the {options.hold_out} held out and {CHOSEN_ON} for choosing"
        raise InputError(options.datasets[0], "pictures", len(read[0]), needed)
    others = [each for pictures in read[1:] for each in pictures] + _rendered(options.rendered)
    return parts_of(read[0], others, options.hold_out)


def _rendered(count: int) -> list[Labelled]:
    """Rendered pictures, every fourth of healthy skin: what the simulator shows is found as well."""
    from hardware.simulator.wound_views import wound_view

    found = []
    with _progress("render", "pictures") as said:
        for number in range(count):
            view = wound_view(RENDERED_SEED + number, number % 4 != 3)
            picture = np.ascontiguousarray(view.image[..., ::-1])
            found.append(Labelled(f"rendered/{RENDERED_SEED + number}", picture, view.wound))
            said(number + 1, count)
    return found


def _healthy_rendered(first: int, count: int) -> list[NDArray[np.uint8]]:
    from hardware.simulator.wound_views import wound_view

    return [np.ascontiguousarray(wound_view(first + number, False).image[..., ::-1]) for number in range(count)]


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


@contextmanager
def _progress(what: str, unit: str) -> Iterator[Progress]:
    with Progress(what, unit, WallClock().now) as progress:
        yield progress
