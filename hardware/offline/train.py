"""`stillbed train`: a segmentation network with its settings, card and curves, from labelled pictures.

The recipe is evaluated by folds: for each, a network is trained without the groups of that fold. The network that is
written is trained on all pictures.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError, StillbedError
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.recording.session_reader import corrected_pictures, recording_damage
from perception.training.dataset import (
    Labelled,
    Samples,
    fold_numbers,
    healthy_pieces,
    picture_groups,
    read_dataset,
)
from perception.wound.network import TERMS_KEYS

if TYPE_CHECKING:
    from perception.training.loop import Recipe, Schedule, Trained
    from perception.training.metrics import HeldOutPredictions
    from perception.wound.network import WoundNetwork
    from perception.wound.segmentation import Segmenter

SPLIT_SEED = 2024  # fixed: figures of networks trained with other seeds are of the same folds
FURTHER_WEIGHT = 0.35  # of a picture of a further data set, relative to the first's: it is contained four times
PIECE_DRAWS = 2  # pieces of healthy skin from each picture, where it has any
RENDERED_SEED = 5000  # the first; the bench uses those below
RENDERED_HEALTHY = 60  # rendered pictures of healthy skin that the folds' networks are shown
ALL = "all"
COMPARED = 40  # pictures on which the network before and after the rounding to 8 bits are compared


class RenderedView(Protocol):
    """A rendered picture of skin. image: (H, W, 3) BGR. wound: (H, W) bool, all False of healthy skin."""

    @property
    def image(self) -> NDArray[np.uint8]: ...  # noqa: D102

    @property
    def wound(self) -> NDArray[np.bool_]: ...  # noqa: D102


RenderView = Callable[[int, bool], RenderedView]  # (seed, wounded): the simulator's renderer, given by the command line


@dataclass(frozen=True, slots=True, eq=False)
class TrainingPictures:
    """The pictures that the recipe is evaluated on, and further ones for training only."""

    primary: Sequence[Labelled]  # of the first data set, and corrected by operators
    fold: NDArray[np.intp]  # (N,) of each
    further: Sequence[Labelled]  # of other data sets, and rendered
    group_count: int  # groups of near-duplicates among the primary pictures

    def weights(self, count: int) -> NDArray[np.float64]:
        """(count + M,) relative frequency in the samples of `count` primary pictures and of all further ones."""
        return np.concatenate([np.ones(count), np.full(len(self.further), FURTHER_WEIGHT)])


def run_train(options: argparse.Namespace, render_view: RenderView) -> str:
    """Train, choose thresholds, export and evaluate; returns the result in words."""
    out: Path = options.out
    _check(options)
    pictures = _pictures(options, render_view)
    if options.network == "shape":
        return _fit_shapes(out, pictures, options.seed)
    from perception.training import export, loop

    recipe, schedule = loop.Recipe(), loop.Schedule()
    if options.network == "thesis":
        recipe, schedule = loop.THESIS_RECIPE, loop.THESIS_SCHEDULE
    run_settings = {"seed": options.seed, "threads": options.threads, "device": loop.torch_device(options.device)}
    schedule = replace(schedule, rounds=options.rounds or schedule.rounds, **run_settings)
    parts = [str(fold) for fold in range(options.folds)] + [ALL] if options.part is None else [options.part]
    trained = {part: _trained(options, part, pictures, recipe, schedule) for part in parts}
    if options.part is not None:
        return f"{_checkpoint(out, options.part)} is written; without --part, all are put together"
    curves = {"all folds" if part == ALL else f"without fold {part}": each.loss for part, each in trained.items()}
    export.draw_curves(out.with_name(f"{out.stem}_curves.png"), curves, schedule.steps)
    schedule = replace(schedule, device=trained[ALL].device)
    return _finish(options, trained, pictures, recipe, schedule, render_view)


def _trained(
    options: argparse.Namespace, part: str, pictures: TrainingPictures, recipe: Recipe, schedule: Schedule
) -> Trained:
    """The network of one part, from its checkpoint as far as that goes."""
    from perception.training import loop

    network = loop.build_network(options.network, schedule.seed)
    trained = [item for item, fold in zip(pictures.primary, pictures.fold.tolist(), strict=True) if str(fold) != part]
    learned = [*trained, *pictures.further]
    samples = Samples(learned, pictures.weights(len(trained)), recipe.augmentation, schedule.seed)
    fingerprint = _fingerprint(options.network, learned, schedule, recipe)
    title = "train on all" if part == ALL else f"train without fold {part}"
    with _progress(title, "steps") as progress:
        return loop.train(network, samples, schedule, _checkpoint(options.out, part), progress, recipe, fingerprint)


def _fingerprint(network: str, pictures: Sequence[Labelled], schedule: Schedule, recipe: Recipe) -> str:
    """Hash of a checkpoint's inputs: pictures with their labels, and all options but device and threads."""
    recipe_fields = network, replace(schedule, device="", threads=0), recipe.augmentation, FURTHER_WEIGHT
    digest = hashlib.sha256(repr(recipe_fields).encode())
    for picture in pictures:
        digest.update(picture.name.encode() + picture.picture.tobytes() + picture.wound.tobytes())
    return digest.hexdigest()


def _finish(
    options: argparse.Namespace,
    trained: dict[str, Trained],
    pictures: TrainingPictures,
    recipe: Recipe,
    schedule: Schedule,
    render_view: RenderView,
) -> str:
    """Judge by the folds, choose settings by them, write the network of all pictures, its card and its pictures.

    The network itself comes last: where it is, all is there.
    """
    from perception.training import export, loop, metrics
    from perception.wound.network import Settings, WoundNetwork
    from perception.wound.segmentation import NetworkSegmenter

    out: Path = options.out
    terms = {key: text for key in TERMS_KEYS if (text := getattr(options, key)) is not None}
    rng = np.random.default_rng(SPLIT_SEED)
    healthy = _pieces(pictures, rng)
    rendered = [each.picture for each in _rendered(render_view, [(n, False) for n in range(RENDERED_HEALTHY)])]
    with tempfile.TemporaryDirectory() as folder:
        rounded = []
        for part, each in trained.items():
            if part != ALL:
                export.export(each.network, Path(folder) / f"{part}.onnx", Settings(looks=recipe.looks, trust=0.0))
                rounded.append(WoundNetwork(Path(folder) / f"{part}.onnx"))
        with _progress("judge", "pictures") as progress:
            predictions = _predict_held_out(rounded, pictures, healthy, recipe, progress)
        with _progress("choose", "settings") as progress:
            settings, evaluation = metrics.evaluate_folds(predictions, recipe.looks, rng, progress)
        segmenters = [NetworkSegmenter(network, settings) for network in rounded]
        with _progress("cover", "pictures") as progress:
            before, after = _covered(segmenters, pictures, rng, progress)
        silent = [metrics.silent_share(each, rendered) for each in segmenters]
        exported = Path(folder) / out.name
        export.export(trained[ALL].network, exported, settings, terms)
        agreement = export.agreement(trained[ALL].network, exported, pictures.primary[:COMPARED], recipe.looks)
        folds = f"{len(pictures.primary)} pictures in {pictures.fold.max() + 1} folds"
        data = (
            f"{folds}, split by {pictures.group_count} groups of near-duplicates (small colour copies, mirrored and"
            " turned; SIFT), never at random",
            f"{len(pictures.further)} further pictures learned from and not judged by, of other data sets and rendered",
        )
        card = export.Card(
            name=out.stem,
            kind=options.network,
            parameters=loop.parameter_count(trained[ALL].network),
            data=data,
            schedule=str(schedule),
            agreement=agreement,
            network=WoundNetwork(exported),
            evaluation=evaluation,
            pictures=pictures.primary,
            pieces=len(healthy[0]),
            rendered=float(np.mean(silent)),
            before=before,
            after=after,
        )
        _write_names(out, [*pictures.primary, *pictures.further])
        export.draw_reliability(out.with_name(f"{out.stem}_reliability.png"), evaluation)
        export.write_card(out.with_suffix(".md"), card)
        for suffix in (".toml", ".onnx"):
            shutil.copy(exported.with_suffix(suffix), out.with_suffix(suffix))
    dice = evaluation.dice
    return (
        f"mean Dice of {len(dice)} pictures, each by a network that never saw its group: {dice.mean():.3f} (median"
        f" {np.median(dice):.3f})\n{out}, its settings, card, curves and reliability are written"
    )


def _pieces(pictures: TrainingPictures, rng: np.random.Generator) -> tuple[list[NDArray[np.uint8]], list[int]]:
    """Pieces of healthy skin, and the fold of each."""
    pieces, folds = list[NDArray[np.uint8]](), list[int]()
    for fold in range(int(pictures.fold.max()) + 1):
        inside = [pictures.primary[number] for number in np.flatnonzero(pictures.fold == fold).tolist()]
        fold_pieces = [piece for _ in range(PIECE_DRAWS) for piece in healthy_pieces(inside, rng, len(inside))]
        pieces += fold_pieces
        folds += [fold] * len(fold_pieces)
    return pieces, folds


def _predict_held_out(
    networks: Sequence[WoundNetwork],
    pictures: TrainingPictures,
    healthy: tuple[list[NDArray[np.uint8]], list[int]],
    recipe: Recipe,
    report: Callable[[int, int], None],
) -> HeldOutPredictions:
    """Each picture and each piece of healthy skin by the network that never saw its group."""
    from perception.training.metrics import HeldOutPredictions, bgr
    from perception.wound.network import Settings
    from perception.wound.segmentation import NetworkSegmenter

    segmenters = [NetworkSegmenter(each, Settings(looks=recipe.looks, trust=0.0)) for each in networks]
    samples = [(each.picture, each.wound) for each in pictures.primary]
    samples += [(is_piece, np.zeros(is_piece.shape[:2], bool)) for is_piece in healthy[0]]
    folds = np.array([*pictures.fold.tolist(), *healthy[1]], np.intp)
    logits = []
    for (picture, _), fold in zip(samples, folds.tolist(), strict=True):
        logits.append(segmenters[fold].logits(bgr(picture)).astype(np.float16))
        report(len(logits), len(samples))
    is_piece = np.arange(len(samples)) >= len(pictures.primary)
    return HeldOutPredictions(logits, [wound for _, wound in samples], folds, is_piece)


def _covered(
    segmenters: Sequence[Segmenter],
    pictures: TrainingPictures,
    rng: np.random.Generator,
    report: Callable[[int, int], None],
) -> tuple[float, float]:
    """Mean Dice on the open half of each wound, before its other half is covered and after."""
    from perception.training.metrics import dice_before_and_after_cover

    dices, counts = [], []
    for fold, segmenter in enumerate(segmenters):
        inside = [pictures.primary[number] for number in np.flatnonzero(pictures.fold == fold).tolist()]
        wounded = [each for each in inside if each.wound.any()]
        if wounded:
            dices.append(dice_before_and_after_cover(segmenter, wounded, rng))
            counts.append(len(wounded))
            report(sum(counts), len(pictures.primary))
    before, after = np.average(dices, axis=0, weights=counts)
    return float(before), float(after)


def _fit_shapes(out: Path, pictures: TrainingPictures, seed: int) -> str:
    """The shape model, of all folds but the first, by which the bench judges it."""
    from perception.wound.shape_matching import fit_shapes, write_shape_model

    training_pictures = [each for each, fold in zip(pictures.primary, pictures.fold.tolist(), strict=True) if fold != 0]
    with _progress("fit", "pictures") as progress:
        model = fit_shapes([(each.picture, each.wound) for each in training_pictures], seed, progress)
    write_shape_model(out, model)
    _write_names(out, training_pictures)
    return f"{out} is written; judge it with stillbed bench segmentation"


def _pictures(options: argparse.Namespace, render_view: RenderView) -> TrainingPictures:
    """The data sets read, and the first one parted into folds by groups, always the same way."""
    data_sets = []
    for folder in options.datasets:
        with _progress(f"read {folder.name}", "pictures") as progress:
            data_sets.append(read_dataset(folder, progress))
    primary = [*data_sets[0], *(each for recording in options.add for each in _corrected(recording))]
    group = picture_groups(primary)
    count = len(np.unique(group))
    if count < options.folds:
        raise InputError(options.datasets[0], "groups of pictures", count, f"{options.folds} or more, as --folds says")
    wounded = np.array([each.wound.any() for each in primary])
    if len(np.unique(group[wounded])) < 2:
        count_with_wound = len(np.unique(group[wounded]))
        raise InputError(options.datasets[0], "groups of pictures with a wound", count_with_wound, "two or more")
    # every fourth of healthy skin
    rendered = _rendered(render_view, [(RENDERED_SEED + number, number % 4 != 3) for number in range(options.rendered)])
    further = [each for data_set in data_sets[1:] for each in data_set] + rendered
    fold = fold_numbers(group, options.folds, np.random.default_rng(SPLIT_SEED))
    return TrainingPictures(primary, fold, further, count)


def _corrected(recording: Path) -> list[Labelled]:
    """What operators corrected in a recording; what is lost of it is told."""
    pictures = corrected_pictures(recording)
    if damage := recording_damage(recording):
        print(
            f"{recording} is damaged: {damage}; {len(pictures)} corrected pictures are left",
            file=sys.stderr,
            flush=True,
        )
    return pictures


def _rendered(render_view: RenderView, views: Sequence[tuple[int, bool]]) -> list[Labelled]:
    """Rendered pictures by their seeds, and whether there is a wound."""
    pictures = []
    with _progress("render", "pictures") as progress:
        for seed, wounded in views:
            view = render_view(seed, wounded)
            pictures.append(Labelled(f"rendered/{seed}", np.ascontiguousarray(view.image[..., ::-1]), view.wound))
            progress(len(pictures), len(views))
    return pictures


def _write_names(out: Path, pictures: Sequence[Labelled]) -> None:
    """What was learned from, beside the model: nothing of it can judge it."""
    out.with_name(f"{out.stem}_trained.txt").write_text("".join(f"{each.name}\n" for each in pictures), "utf-8")


def _checkpoint(out: Path, part: str) -> Path:
    return out.with_name(f"{out.stem}_{part}.ckpt")


def _check(options: argparse.Namespace) -> None:
    out: Path = options.out
    shapes = options.network == "shape"
    if not shapes and (find_spec("torch") is None or find_spec("efficientnet_lite_pytorch") is None):
        raise StillbedError("train needs torch and the weights it begins with: pip install 'stillbed[train]'")
    if out.suffix != (".toml" if shapes else ".onnx"):
        raise InputError("command line", "--out", str(out), f"a name that ends in {'.toml' if shapes else '.onnx'}")
    if not out.parent.is_dir():
        raise InputError("command line", "--out", str(out), "a file in a folder that exists")
    minima = {"--folds": (options.folds, 2), "--rendered": (options.rendered, 0), "--rounds": (options.rounds, 1)}
    minima |= {"--threads": (options.threads, 1), "--seed": (options.seed, 0)}
    for name, (value, low) in minima.items():
        if value is not None and value < low:
            raise InputError("command line", name, value, f"{low} or more")
    parts = [*map(str, range(options.folds)), ALL]
    if options.part is not None and (shapes or options.part not in parts):
        allowed = "nothing with --network shape" if shapes else f"one of {', '.join(parts)}"
        raise InputError("command line", "--part", options.part, allowed)
    if options.part is None and out.exists() and not options.force:
        raise InputError(out, "--out", "a file", "a new one, or --force")


def _progress(what: str, unit: str) -> Progress:
    return Progress(what, unit, WallClock().now)
