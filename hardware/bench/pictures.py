"""Subject `segmentation`: finding the wound in pictures.

Dice on held-out pictures, no detection without a wound, a half covered wound, time; areas in mm^2.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from hardware.bench.figures import Figure, at_least, at_most, percentile, with_progress
from hardware.files.images import encode
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.simulator.scene.render import wound_set, wound_view
from perception.tracking.wound_area import RIG_SCALE_SIGMA, wound_area
from perception.training.dataset import Labelled, healthy_pieces, read_dataset
from perception.training.metrics import (
    area_residual,
    bgr,
    conformal_spread,
    dice_before_and_after_cover,
    dice_scores,
    silent_share,
)
from perception.wound.network import THESIS_MODEL, WoundNetwork, shipped_model
from perception.wound.segmentation import (
    EvaluatedPicture,
    NetworkSegmenter,
    Segmentation,
    WoundBand,
    contact_sheet,
    dice,
)
from perception.wound.shape_matching import ShapeSegmenter, largest_outline, read_shape_model, thesis_mask

HEALTHY_PIECES = 200  # of healthy skin, real
AREA_SIGMA = 0.2  # of the logarithm of the area by a scan and the camera's distance
SHEET_QUALITY = 85  # JPEG
UNTIMED_PICTURES = 5  # the first ones
NO_DATA = "no DATASET is named: figures of real pictures are left out (docs/segmentation.md says where there are some)"
PUBLISHED_DICE = "thesis U-Net 0.765; FUSeg winner 0.844 public, 0.888 hidden; two people 0.931"


def run_segmentation(options: argparse.Namespace) -> list[Figure]:
    """All figures; those of real pictures only where a data set is named."""
    model: Path = shipped_model() if options.model is None else options.model
    network = WoundNetwork(model)
    segmenter, dataset = NetworkSegmenter(network, network.settings), list[Labelled]()
    if options.dataset is not None:
        with Progress(f"read {options.dataset.name}", "pictures", WallClock().now) as progress:
            dataset = read_dataset(options.dataset, progress)
    pictures = new_to(dataset, model)
    if len(pictures) < len(dataset):
        learned = f"{len(dataset) - len(pictures)} of {len(dataset)} pictures were learned from and judge nothing"
        print(
            f"note: {learned}: {model.with_suffix('.md').name} says what the folds reach", file=sys.stderr, flush=True
        )
    wounds, healthy = ([_rendered(number, kind) for number in range(options.rendered)] for kind in (True, False))
    rng = np.random.default_rng(options.seed)
    if options.sheet is not None:
        images = [(bgr(each.picture), each.wound) for each in pictures or wounds]
        evaluated = [EvaluatedPicture(image, segmenter(image), wound) for image, wound in images]
        options.sheet.write_bytes(encode(contact_sheet(evaluated), SHEET_QUALITY)[1])
    shapes = shipped_model("shape", ".toml")
    figures = [*_dice(segmenter, pictures), *_reference_figures(pictures, new_to(dataset, shapes), shapes, rng)]
    pieces = healthy_pieces(pictures, rng, HEALTHY_PIECES)
    real, rendered = silent_share(segmenter, pieces), silent_share(segmenter, [each.picture for each in healthy])
    silence_target, note = at_least(0.95), f"{len(wounds)} pictures"
    mean = _mean([_dice_of(segmenter, each) for each in wounds])
    before, after = dice_before_and_after_cover(segmenter, pictures, rng)
    covered = "half covered: fall of Dice on the open part"
    figures += [
        Figure("silent on healthy skin, real", real, "", silence_target, "", f"{len(pieces)} pieces"),
        Figure("silent on healthy skin, rendered", rendered, "", silence_target, "", note),
        Figure("Dice on rendered wounds, mean", mean, "", None, "", note),
        Figure(covered, before - after, "", at_most(0.05), "thesis by eye", f"from {before:.3f} to {after:.3f}"),
        *_time(network, pictures or wounds),
        *spread_figures(segmenter, pictures),
        *area_figures(segmenter, options.areas),
    ]
    if options.dataset is None:
        print(NO_DATA, file=sys.stderr, flush=True)
    return [figure for figure in figures if not math.isnan(figure.value)]


def new_to(pictures: list[Labelled], model: Path) -> list[Labelled]:
    """The pictures that a model was not trained on, by the list of names beside it, if any."""
    names = model.with_name(f"{model.stem}_trained.txt")
    learned = set(names.read_text(encoding="utf-8").splitlines()) if names.is_file() else set()
    return [each for each in pictures if each.name not in learned]


def _dice(segmenter: NetworkSegmenter, pictures: Sequence[Labelled]) -> list[Figure]:
    if not pictures:
        return []
    with Progress("network", "pictures", WallClock().now) as progress:
        each = dice_scores(segmenter, pictures, progress)
    empty = np.array([not labelled.wound.any() for labelled in pictures])
    note = f"{len(each)} pictures, {empty.sum()} without a wound, {(each < 0.1).sum()} below 0.1"
    return [
        Figure("Dice of each picture, mean", float(each.mean()), "", at_least(0.87), PUBLISHED_DICE, note),
        Figure("Dice of each picture, median", float(np.median(each))),
        Figure("Dice where there is a wound, mean", _mean(each[~empty])),
    ]


def _reference_figures(
    pictures: Sequence[Labelled], new_to_shapes: Sequence[Labelled], shapes: Path, rng: np.random.Generator
) -> list[Figure]:
    """The thesis's U-Net, where it is installed, and shape matching."""
    figures = []
    try:
        network = WoundNetwork(shipped_model(THESIS_MODEL))
    except InputError:
        pass
    else:
        with Progress("reference", "pictures", WallClock().now) as progress:
            mean = _mean(dice_scores(NetworkSegmenter(network, network.settings), pictures, progress))
        figures = [Figure("Dice of each picture, mean, thesis's U-Net", mean, "", None, "0.765 in the thesis")]
    model = read_shape_model(shapes)
    wounded = [each for each in new_to_shapes if each.wound.any()]
    areas = np.array([each.wound.sum() for each in wounded]) * np.exp(rng.normal(0, AREA_SIGMA, len(wounded)))
    of_scan, usual, thesis = list[float](), list[float](), list[float]()
    for labelled, area in zip(wounded, areas.tolist(), strict=True):
        outline = largest_outline(labelled.wound)  # as a scan of the wound would give it
        assert outline is not None
        of_scan.append(_dice_of(ShapeSegmenter(model, outline, area), labelled))
        usual.append(_dice_of(ShapeSegmenter(model), labelled))
        thesis.append(dice(thesis_mask(bgr(labelled.picture), outline), labelled.wound))
    reference, note = "thesis 0.48-0.526 on 50 chosen pictures", "size known to 20 %"
    return [
        *figures,
        Figure("shape matching: scan's outline and size", _mean(of_scan), "", at_least(0.526), reference, note),
        Figure("shape matching: usual outlines", _mean(usual)),
        Figure("shape matching: the thesis's own", _mean(thesis)),
    ]


def _dice_of(segmenter: ShapeSegmenter | NetworkSegmenter, labelled: Labelled) -> float:
    return dice(segmenter(bgr(labelled.picture)).mask, labelled.wound)


def _mean(values: Sequence[float] | Array) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _rendered(number: int, wounded: bool) -> Labelled:
    view = wound_view(number, wounded)
    return Labelled(f"rendered/{number}", np.ascontiguousarray(view.image[..., ::-1]), view.wound)


def _time(network: WoundNetwork, pictures: Sequence[Labelled]) -> list[Figure]:
    """Wall time of both looks, with the network's own threads; includes other load of the machine."""
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
    counted, note = times[UNTIMED_PICTURES:] or times, "all looks, wall, 2 threads"
    reference = "thesis 9 ms on an RTX 3080 Ti"
    return [
        Figure("network, a picture: median", percentile(counted, 50), "ms", None, reference, note),
        Figure("network, a picture: p99", percentile(counted, 99), "ms", at_most(25.0), "", note),
        Figure("parameters, at most", network.size / 1e6, "million", at_most(6.0), "", "a byte each in the file"),
    ]


def spread_figures(segmenter: NetworkSegmenter, pictures: Sequence[Labelled]) -> list[Figure]:
    """Share of labels' areas inside a picture's interval, and the spread with 95 % of them inside."""
    found = [area_residual(segmenter.band(bgr(each.picture)), each.wound) for each in pictures]
    residuals = [each for each in found if each is not None]
    if not residuals:
        return []
    errors, spread = np.array(residuals), segmenter.settings.spread
    note = f"{len(errors)} pictures"
    if len(errors) > 1:
        halves = [float((errors[i::2] <= conformal_spread(errors[1 - i :: 2])).mean()) for i in (0, 1)]
        note += f"; by the spread of the other half {halves[0]:.3f} and {halves[1]:.3f}"
    inside, used = float((errors <= spread).mean()), f"used: {spread:g}; by 1 inside: {float((errors <= 1).mean()):.3f}"
    return [
        Figure("label's area inside the interval of one picture", inside, "", at_least(0.93), "", note),
        Figure("spread that holds 95 % of the labels", conformal_spread(errors), "half bands", None, "", used),
    ]


RIG_PLACE_SIGMA, RIG_TURN_SIGMA = 0.05, math.radians(0.02)  # mm and rad of a camera: the targets of its calibration


def miscalibrated(rig: Rig, rng: np.random.Generator) -> Rig:
    """A rig with calibration errors: of each camera's pose, and of the scale of all lengths."""
    scale, cameras = math.exp(rng.normal(0, RIG_SCALE_SIGMA)), list[Camera]()
    for camera in rig.cameras:
        offset = se3.make(se3.exp_rotation(rng.normal(0, RIG_TURN_SIGMA, 3)), rng.normal(0, RIG_PLACE_SIGMA, 3))
        pose = camera.base_from_camera @ offset
        pose[:3, 3] *= scale
        cameras.append(replace(camera, base_from_camera=pose))
    return Rig(tuple(cameras))


def area_figures(segmenter: NetworkSegmenter, count: int) -> list[Figure]:
    """Areas by three cameras of `count` rendered wounds beside the true ones: by the network, and by true outlines.

    The rig has the errors of a calibration.
    """
    results: dict[str, list[tuple[float, float, bool]]] = {"network": [], "true outlines": []}
    refused = dict.fromkeys(results, 0)
    for seed in with_progress("areas", "wounds", range(count), count):
        truth = wound_set(seed)
        rig = miscalibrated(truth.rig, np.random.default_rng([seed, 47]))
        images = dict(enumerate(truth.images))
        exact = {c: WoundBand(Segmentation(m, 1.0, 0.5), m, m, m) for c, m in enumerate(truth.wounds)}
        for kind, bands in (("network", {c: segmenter.band(i) for c, i in images.items()}), ("true outlines", exact)):
            area = wound_area(rig, images, bands, segmenter.settings.spread)
            if isinstance(area, str):
                refused[kind] += 1
            else:
                error, half = math.log(area.area / truth.area), math.log(area.high / max(area.low, 1e-9)) / 2
                results[kind].append((error, half, area.low <= truth.area <= area.high))
    figures = []
    for kind, rows in results.items():
        if rows:
            error, half, inside = np.array(rows).T
            what, note = f"area by three cameras, {kind}", f"{len(rows)} rendered wounds, {refused[kind]} not measured"
            figures += [
                Figure(f"{what}: inside the 95 % interval", float(inside.mean()), "", at_least(0.93), "", note),
                Figure(f"{what}: error, median of the absolute", 100 * float(np.median(np.abs(error))), "%"),
                Figure(f"{what}: error, mean", 100 * float(error.mean()), "%"),
                Figure(f"{what}: half the interval, median", 100 * float(np.median(half)), "%, of the logarithm"),
            ]
    return figures
