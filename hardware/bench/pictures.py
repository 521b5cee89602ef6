"""Finding the wound: Dice on pictures held out, silence where there is none, a wound half covered, time."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.bench.figures import Figure, at_least, at_most
from hardware.files.images import encode
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.simulator.wound_views import wound_view
from perception.contact_sheet import Shown, contact_sheet
from perception.dice import dice
from perception.training.dataset import Labelled, read_dataset
from perception.training.healthy import healthy_pieces
from perception.training.judging import bgr, half_covered_fall, scores, silent
from perception.wound.network import MODEL, REFERENCE, WoundNetwork, shipped
from perception.wound.segmentation import Mask, NetworkSegmenter
from perception.wound.shape_matching import ShapeModel, ShapeSegmenter, pattern_of, plain, read_shape_model
from perception.wound_candidates import Contour

PIECES = 200  # of healthy skin, real
SIZE_KNOWN = 0.2  # deviation of the logarithm of the area that a scan and the camera's distance tell
SHEET_QUALITY = 85  # JPEG
WARM = 5  # first pictures, not timed
NO_DATA = "no DATASET is named: figures of real pictures are left out (docs/segmentation.md says where there are some)"
PUBLISHED = "thesis U-Net 0.765; FUSeg winner 0.844 public, 0.888 hidden; two people 0.931"


def run(options: argparse.Namespace) -> list[Figure]:
    """All figures; those of real pictures only where a data set is named."""
    network = WoundNetwork(shipped() if options.model is None else options.model)
    segmenter = NetworkSegmenter(network, network.settings)
    pictures = [] if options.dataset is None else judged_by(read(options.dataset), options.dataset)
    wounds, healthy = ([_rendered(number, kind) for number in range(options.rendered)] for kind in (True, False))
    rng = np.random.default_rng(options.seed)
    if options.sheet is not None:
        judged = pictures or wounds
        options.sheet.write_bytes(encode(contact_sheet([_shown(segmenter, each) for each in judged]), SHEET_QUALITY)[1])
    found = [
        *_dice(segmenter, pictures),
        *_others(pictures, rng),
        *_silence(segmenter, healthy_pieces(pictures, rng, PIECES), healthy, wounds),
        *_covered(segmenter, pictures, rng),
        *_time(network, pictures or wounds),
    ]
    if pictures:
        return found
    print(NO_DATA, file=sys.stderr, flush=True)
    return [figure for figure in found if not math.isnan(figure.value)]


def read(folder: Path) -> list[Labelled]:
    """The labelled pictures of a folder."""
    with Progress(f"read {folder.name}", "pictures", WallClock().now) as said:
        return read_dataset(folder, said)


def judged_by(pictures: list[Labelled], folder: Path) -> list[Labelled]:
    """The pictures the network was not trained on: of its own data set those held out, of any other all."""
    names = set(shipped(f"{MODEL}_held_out", ".txt").read_text(encoding="utf-8").split())
    held_out = [each for each in pictures if each.name in names]
    if held_out and len(held_out) < len(names):
        raise InputError(folder, "pictures held out", len(held_out), f"all {len(names)}, or another data set")
    return held_out or pictures


def _dice(segmenter: NetworkSegmenter, pictures: Sequence[Labelled]) -> list[Figure]:
    asked = at_least(0.86)
    if not pictures:
        return []
    with Progress("network", "pictures", WallClock().now) as said:
        found = scores(segmenter, pictures, said)
    empty = np.array([not each.wound.any() for each in pictures])
    note = f"{len(found)} pictures, {empty.sum()} without a wound, {(found < 0.1).sum()} below 0.1"
    return [
        Figure("Dice of each picture, mean", float(found.mean()), "", asked, PUBLISHED, note),
        Figure("Dice of each picture, median", float(np.median(found))),
        Figure("Dice where there is a wound, mean", float(found[~empty].mean()) if (~empty).any() else math.nan),
    ]


def _others(pictures: Sequence[Labelled], rng: np.random.Generator) -> list[Figure]:
    """The thesis's U-Net where it comes along, and shape matching."""
    model = read_shape_model(shipped("shape", ".toml"))
    wounded = [each for each in pictures if each.wound.any()]
    areas = np.array([each.wound.sum() for each in wounded]) * np.exp(rng.normal(0, SIZE_KNOWN, len(wounded)))
    return [
        *_reference(pictures),
        Figure("shape matching: scan's outline and size", _shapes(model, wounded, areas), "", at_least(0.526),
               "thesis 0.48-0.526 on 50 chosen pictures", "size known to 20 %"),
        Figure("shape matching: usual outlines", _mean([_alike(ShapeSegmenter(model), p) for p in wounded])),
        Figure("shape matching: the thesis's own", _mean([dice(_plain(p), p.wound) for p in wounded])),
    ]  # fmt: skip


def _reference(pictures: Sequence[Labelled]) -> list[Figure]:
    try:
        network = WoundNetwork(shipped(REFERENCE))
    except InputError:
        return []
    with Progress("reference", "pictures", WallClock().now) as said:
        found = scores(NetworkSegmenter(network, network.settings), pictures, said)
    return [
        Figure("Dice of each picture, mean, thesis's U-Net", _mean(found.tolist()), "", None, "0.765 in the thesis")
    ]


def _shapes(model: ShapeModel, pictures: Sequence[Labelled], areas: Array) -> float:
    pairs = zip(pictures, areas.tolist(), strict=True)
    return _mean([_alike(ShapeSegmenter(model, _outline(each), area), each) for each, area in pairs])


def _alike(segmenter: ShapeSegmenter, labelled: Labelled) -> float:
    return dice(segmenter(bgr(labelled.picture)).mask, labelled.wound)


def _outline(labelled: Labelled) -> Contour:
    """What a scan of the wound would give."""
    outline = pattern_of(labelled.wound)
    assert outline is not None
    return outline


def _plain(labelled: Labelled) -> Mask:
    return plain(bgr(labelled.picture), _outline(labelled))


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _silence(
    segmenter: NetworkSegmenter,
    pieces: Sequence[NDArray[np.uint8]],
    healthy: Sequence[Labelled],
    wounds: Sequence[Labelled],
) -> list[Figure]:
    found = [dice(segmenter(bgr(each.picture)).mask, each.wound) for each in wounds]
    return [
        Figure("silent on healthy skin, real", silent(segmenter, pieces), "",
               at_least(0.95), "", f"{len(pieces)} pieces"),
        Figure("silent on healthy skin, rendered", silent(segmenter, [each.picture for each in healthy]), "",
               at_least(0.95), "", f"{len(wounds)} pictures"),
        Figure("Dice on rendered wounds, mean", _mean(found), "", None, "", f"{len(wounds)} pictures"),
    ]  # fmt: skip


def _covered(segmenter: NetworkSegmenter, pictures: Sequence[Labelled], rng: np.random.Generator) -> list[Figure]:
    before, after = half_covered_fall(segmenter, pictures, rng)
    note = f"from {before:.3f} to {after:.3f}"
    what = "half covered: fall of Dice on the open part"
    return [Figure(what, before - after, "", at_most(0.05), "thesis by eye", note)]


def _shown(segmenter: NetworkSegmenter, labelled: Labelled) -> Shown:
    image = bgr(labelled.picture)
    return Shown(image, segmenter(image), labelled.wound)


def _rendered(number: int, wounded: bool) -> Labelled:
    view = wound_view(number, wounded)
    return Labelled(f"rendered/{number}", np.ascontiguousarray(view.image[..., ::-1]), view.wound)


def _time(network: WoundNetwork, pictures: Sequence[Labelled]) -> list[Figure]:
    """By the wall, both looks, on the threads that it comes with; other work on the machine counts in."""
    clock, times, spent = WallClock(), list[float](), 0.0

    def timed(planes: NDArray[np.float32]) -> NDArray[np.float32]:
        nonlocal spent
        start = clock.now()
        logits = network(planes)
        spent += clock.now() - start
        return logits

    segmenter = NetworkSegmenter(timed, network.settings)
    for each in pictures:
        spent = 0.0
        segmenter(bgr(each.picture))
        times.append(1000 * spent)
    median, late = np.percentile(times[WARM:] or times, [50, 99])
    note = "all looks, wall, 2 threads"
    return [
        Figure("network, a picture: median", float(median), "ms", None, "thesis 9 ms on an RTX 3080 Ti", note),
        Figure("network, a picture: p99", float(late), "ms", at_most(20.0), "", note),
        Figure("parameters, at most", network.size / 1e6, "million", at_most(3.0), "", "a byte each in the file"),
    ]
