"""Subjects `views` and `segmentation`: tracking and segmentation of pictures that make them hard.

`views`: rendered skin that deforms, grazing views with glare, edges. Everything is measured after the constant
transform at the first TRACKING pose; nothing is fitted over the run.
`segmentation`: Dice on held-out pictures, silence where there is no wound, a half covered wound, time; areas in mm^2.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.bench.figures import Figure, at_least, at_most, percentile, rms, with_progress
from hardware.bench.mapping import wound_points
from hardware.files.images import encode
from hardware.process.checks import Table
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.simulator.motion_table import motion_from_tables, waveform_from_table
from hardware.simulator.scenario_tables import scene_from_table
from hardware.simulator.scene.appearance import Sensor, unlit_texture
from hardware.simulator.scene.fields import smooth_noise
from hardware.simulator.scene.render import render, wound_set, wound_view
from hardware.simulator.scene.scene import Scene, WorldState, rois
from hardware.simulator.scene.shape import shape_from_function
from hardware.simulator.truth import Truth
from perception.frames import Frame, FrameSet
from perception.tracking.step import TrackingStep
from perception.tracking.wound_area import RIG_SCALE_SIGMA, wound_area
from perception.training.dataset import Labelled, healthy_pieces, read_dataset
from perception.training.metrics import (
    area_residual,
    bgr,
    conformal_spread,
    dice_before_and_after_cover,
    scores,
    silent_share,
)
from perception.wound.network import THESIS_MODEL, WoundNetwork, shipped_model
from perception.wound.segmentation import (
    JudgedPicture,
    NetworkSegmenter,
    Segmentation,
    WoundBand,
    contact_sheet,
    dice,
)
from perception.wound.shape_matching import ShapeSegmenter, largest_outline, read_shape_model, thesis_mask

VIEW_RATE, VIEW_EXPOSURE = 30.0, 0.005  # frame sets a second; s
VIEW_SOURCE = "stillbed bench views"
CUBE_FACE, CUBE_TEXEL = 60.0, 0.15  # mm, of the square that a cube's corner is seen in, and of its texture
POINT_STRIDE = 37  # nodes of the wound between points that are judged


@dataclass(frozen=True, slots=True)
class ViewSequence:
    """One sequence."""

    name: str
    body: Table | None  # a [scene] table, None for a cube that stands on a corner
    motion: tuple[Table, ...]
    seed: int
    target: float  # mm RMS over the points
    reference: str  # what others reached on sequences of this kind
    strain: Table | None = None  # over time, of a scene that deforms


BREATH: Table = {"kind": "breathing", "amplitude_mm": 6.0, "rate_hz": 0.25, "turn_deg": [2.0, 1.0, 0.0]}
ROLL_TABLE: Table = {
    **{"kind": "turn", "angles_deg": [22.0], "axis": [1.0, 0.0, 0.0]},
    **{"duration_s": 1.5, "hold_s": 1.5, "start_s": 1.0, "repeat": True},
}
BULGES: Table = {"stretch": [0.01, 0.005], "bulge_mm": 1.0, "radius_mm": 25.0}
BULGE_TABLE: Table = {"stretch": [0.015, 0.01], "bulge_mm": 1.5, "radius_mm": 20.0}
RIGID_REFERENCE = "thesis 1.8, ViSP 0.57, robust pose of each frame set 0.46"
VIEWS = (
    ViewSequence(
        "forearm that bulges as it breathes", {"body": "forearm", "deformation": BULGES}, (BREATH,), 1, 0.3,
        RIGID_REFERENCE, {"kind": "breathing", "rate_hz": 0.25},
    ),
    ViewSequence(
        "forearm that swells and sinks by 1.5 mm", {"body": "forearm", "deformation": BULGE_TABLE},
        ({**BREATH, "rate_hz": 0.3, "amplitude_mm": 8.0},), 2, 0.3,
        RIGID_REFERENCE, {"kind": "sine", "rate_hz": 0.3, "phase_deg": 90.0},
    ),
    ViewSequence(
        "wet forearm rolled until views graze", {"body": "forearm", "wetness": 1.0},
        ({**BREATH, "turn_deg": [12.0, 5.0, 3.0]}, ROLL_TABLE), 4, 0.05,
        "thesis 1.6, ViSP 0.127, robust pose of each frame set 0.10",
    ),
    ViewSequence(
        "cube on its corner", None, ({"kind": "constant", "unit_mm": 40.0},), 6, 0.018,
        "thesis 4.0, ViSP 0.019, robust pose of each frame set 0.025",
    ),
)  # fmt: skip


def run_views(options: argparse.Namespace) -> list[Figure]:
    """All sequences."""
    return [figure for view in VIEWS for figure in _figures(view, options.seconds)]


def _figures(view: ViewSequence, seconds: float) -> list[Figure]:
    strain = None
    if view.strain is not None:
        strain = waveform_from_table(VIEW_SOURCE, "strain", dict(view.strain), np.random.default_rng([view.seed, 11]))
    scene = _cube(view.seed) if view.body is None else scene_from_table(VIEW_SOURCE, dict(view.body), Path(), view.seed)
    motion = motion_from_tables(VIEW_SOURCE, [dict(part) for part in view.motion], Path(), view.seed)
    shape, stamps = scene.shape, np.arange(round(seconds * VIEW_RATE)) / VIEW_RATE
    truth = Truth(BASE_FROM_REST, motion, scene.deformation, strain, shape.surface_from_grid)
    poses = list(_tracked(scene, truth, arc_rig(), stamps))
    first, what = next((i for i, p in enumerate(poses) if p.state is TrackState.TRACKING), None), f"{view.name}: error"
    if first is None:
        return [Figure(what, math.nan, "mm", at_most(view.target), view.reference, "never TRACKING")]
    # (N, 3) mm, of the wound, or of the middle of a shape without one
    points = shape.points(shape.grid(3.0, 0.6)) if shape.inside is None else wound_points(shape)[::POINT_STRIDE]
    still = se3.make(np.eye(3), points)
    true = [truth.checkpoints(np.full(len(points), stamp), still)[:, :3, 3] for stamp in stamps]  # base frame
    start, rows = poses[first], [i for i in range(first + 1, len(poses)) if poses[i].state.measured]
    own = se3.transform_points(se3.inverse(start.base_from_surface), true[first])
    own = own if start.warp is None else start.warp.undo(own)
    warped = np.array([_error(poses[i], own if (w := poses[i].warp) is None else w.apply(own), true[i]) for i in rows])
    rigid = np.array([_error(poses[i], own, true[i]) for i in rows])
    deformed = max((p.warp.deformation for p in poses if p.warp is not None), default=0.0)
    measured, degraded = len(rows) / (len(poses) - first - 1), sum(p.state is TrackState.DEGRADED for p in poses)
    note = f"largest {warped.max():.3f}; deformation {deformed:.2f} mm at most, {degraded} of {len(poses)} DEGRADED"
    figures = [Figure(what, rms(warped), "mm", at_most(view.target), view.reference, note)]
    figures.append(Figure(f"{view.name}: measured", 100 * measured, "%", at_least(99)))
    return figures if view.strain is None else [*figures, Figure(f"{view.name}: without the warp", rms(rigid), "mm")]


def _cube(seed: int) -> Scene:
    """The three upper faces of a cube on its corner, textured by noise of several sizes, before a cloth at rest."""
    ways = np.pi / 2 + 2 * np.pi * np.arange(3) / 3

    def height(x: Array, y: Array) -> Array:
        return np.asarray(np.sqrt(2) * (CUBE_FACE / 6 - np.max([np.cos(a) * x + np.sin(a) * y for a in ways], axis=0)))

    side, rng = round(CUBE_FACE / CUBE_TEXEL), np.random.default_rng([seed, 83])
    grain = sum(smooth_noise((side, side), size, rng) for size in (1.0, 2.0, 4.0, 8.0, 16.0))
    texture = unlit_texture(np.dstack([np.clip(128 + 16 * grain, 0, 255).astype(np.uint8)] * 3), CUBE_TEXEL)
    return Scene(shape_from_function(height, (CUBE_FACE, CUBE_FACE)), texture, seed=seed)


def _tracked(scene: Scene, truth: Truth, rig: Rig, stamps: Array) -> Iterator[SurfacePose]:
    """The poses of the tracking step, frame set by frame set."""
    step = TrackingStep(rig, rois(scene, rig, truth.base_from_surface(stamps[:1])[0], 0.0))
    rng = np.random.default_rng(31)
    for stamp in stamps.tolist():
        now = np.array([stamp])
        at, amount = truth.base_from_surface(now)[0], float(truth.amount(now)[0])
        instant = WorldState(stamp, VIEW_EXPOSURE, at, truth.twist(now)[0], amount)
        images = render(scene, rig.cameras, [instant] * len(rig), Sensor(), rng.spawn(len(rig)))
        yield step(FrameSet(stamp, tuple(Frame(c, stamp, image) for c, image in enumerate(images))))
        step.idle()


def _error(pose: SurfacePose, points: Array, true: Array) -> float:
    """RMS distance, mm, of points (N, 3), surface frame, from their true places (N, 3), base frame."""
    return rms(np.linalg.norm(se3.transform_points(pose.base_from_surface, points) - true, axis=1))


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
    segmenter, given = NetworkSegmenter(network, network.settings), list[Labelled]()
    if options.dataset is not None:
        with Progress(f"read {options.dataset.name}", "pictures", WallClock().now) as progress:
            given = read_dataset(options.dataset, progress)
    pictures = new_to(given, model)
    if len(pictures) < len(given):
        learned = f"{len(given) - len(pictures)} of {len(given)} pictures were learned from and judge nothing"
        print(
            f"note: {learned}: {model.with_suffix('.md').name} says what the folds reach", file=sys.stderr, flush=True
        )
    wounds, healthy = ([_rendered(number, kind) for number in range(options.rendered)] for kind in (True, False))
    rng = np.random.default_rng(options.seed)
    if options.sheet is not None:
        images = [(bgr(each.picture), each.wound) for each in pictures or wounds]
        judged = [JudgedPicture(image, segmenter(image), wound) for image, wound in images]
        options.sheet.write_bytes(encode(contact_sheet(judged), SHEET_QUALITY)[1])
    shapes = shipped_model("shape", ".toml")
    figures = [*_dice(segmenter, pictures), *_others(pictures, new_to(given, shapes), shapes, rng)]
    pieces = healthy_pieces(pictures, rng, HEALTHY_PIECES)
    real, rendered = silent_share(segmenter, pieces), silent_share(segmenter, [each.picture for each in healthy])
    silent, note = at_least(0.95), f"{len(wounds)} pictures"
    mean = _mean([_dice_of(segmenter, each) for each in wounds])
    before, after = dice_before_and_after_cover(segmenter, pictures, rng)
    covered = "half covered: fall of Dice on the open part"
    figures += [
        Figure("silent on healthy skin, real", real, "", silent, "", f"{len(pieces)} pieces"),
        Figure("silent on healthy skin, rendered", rendered, "", silent, "", note),
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
    """The pictures that a model has not learned from, by the list of names that may lie beside it."""
    names = model.with_name(f"{model.stem}_trained.txt")
    learned = set(names.read_text(encoding="utf-8").splitlines()) if names.is_file() else set()
    return [each for each in pictures if each.name not in learned]


def _dice(segmenter: NetworkSegmenter, pictures: Sequence[Labelled]) -> list[Figure]:
    if not pictures:
        return []
    with Progress("network", "pictures", WallClock().now) as progress:
        each = scores(segmenter, pictures, progress)
    empty = np.array([not labelled.wound.any() for labelled in pictures])
    note = f"{len(each)} pictures, {empty.sum()} without a wound, {(each < 0.1).sum()} below 0.1"
    return [
        Figure("Dice of each picture, mean", float(each.mean()), "", at_least(0.87), PUBLISHED_DICE, note),
        Figure("Dice of each picture, median", float(np.median(each))),
        Figure("Dice where there is a wound, mean", _mean(each[~empty])),
    ]


def _others(
    pictures: Sequence[Labelled], new_to_shapes: Sequence[Labelled], shapes: Path, rng: np.random.Generator
) -> list[Figure]:
    """The thesis's U-Net where it comes along, and shape matching."""
    figures = []
    try:
        network = WoundNetwork(shipped_model(THESIS_MODEL))
    except InputError:
        pass
    else:
        with Progress("reference", "pictures", WallClock().now) as progress:
            mean = _mean(scores(NetworkSegmenter(network, network.settings), pictures, progress))
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
    counted, note = times[UNTIMED_PICTURES:] or times, "all looks, wall, 2 threads"
    reference = "thesis 9 ms on an RTX 3080 Ti"
    return [
        Figure("network, a picture: median", percentile(counted, 50), "ms", None, reference, note),
        Figure("network, a picture: p99", percentile(counted, 99), "ms", at_most(25.0), "", note),
        Figure("parameters, at most", network.size / 1e6, "million", at_most(6.0), "", "a byte each in the file"),
    ]


def spread_figures(segmenter: NetworkSegmenter, pictures: Sequence[Labelled]) -> list[Figure]:
    """How many labels' areas lie inside a picture's interval, and which spread would hold 95 % of them."""
    found = [area_residual(segmenter.band(bgr(each.picture)), each.wound) for each in pictures]
    residuals = [each for each in found if each is not None]
    if not residuals:
        return []
    off, spread = np.array(residuals), segmenter.settings.spread
    note = f"{len(off)} pictures"
    if len(off) > 1:
        halves = [float((off[i::2] <= conformal_spread(off[1 - i :: 2])).mean()) for i in (0, 1)]
        note += f"; by the spread of the other half {halves[0]:.3f} and {halves[1]:.3f}"
    inside, used = float((off <= spread).mean()), f"used: {spread:g}; by 1 inside: {float((off <= 1).mean()):.3f}"
    return [
        Figure("label's area inside the interval of one picture", inside, "", at_least(0.93), "", note),
        Figure("spread that holds 95 % of the labels", conformal_spread(off), "half bands", None, "", used),
    ]


RIG_PLACE_SIGMA, RIG_TURN_SIGMA = 0.05, math.radians(0.02)  # mm and rad of a camera: the targets of its calibration


def miscalibrated(rig: Rig, rng: np.random.Generator) -> Rig:
    """A rig as it is known: each camera a little aside, and all lengths by as much too long as a ruler is."""
    scale, cameras = math.exp(rng.normal(0, RIG_SCALE_SIGMA)), list[Camera]()
    for camera in rig.cameras:
        off = se3.make(se3.exp_rotation(rng.normal(0, RIG_TURN_SIGMA, 3)), rng.normal(0, RIG_PLACE_SIGMA, 3))
        pose = camera.base_from_camera @ off
        pose[:3, 3] *= scale
        cameras.append(replace(camera, base_from_camera=pose))
    return Rig(tuple(cameras))


def area_figures(segmenter: NetworkSegmenter, count: int) -> list[Figure]:
    """Areas by three cameras of `count` rendered wounds beside the true ones: by the network, and by true outlines.

    The rig is off by what calibration leaves.
    """
    judged: dict[str, list[tuple[float, float, bool]]] = {"network": [], "true outlines": []}
    refused = dict.fromkeys(judged, 0)
    for seed in with_progress("areas", "wounds", range(count), count):
        taken = wound_set(seed)
        rig = miscalibrated(taken.rig, np.random.default_rng([seed, 47]))
        images = dict(enumerate(taken.images))
        exact = {c: WoundBand(Segmentation(m, 1.0, 0.5), m, m, m) for c, m in enumerate(taken.wounds)}
        for kind, bands in (("network", {c: segmenter.band(i) for c, i in images.items()}), ("true outlines", exact)):
            area = wound_area(rig, images, bands, segmenter.settings.spread)
            if isinstance(area, str):
                refused[kind] += 1
            else:
                error, half = math.log(area.area / taken.area), math.log(area.high / max(area.low, 1e-9)) / 2
                judged[kind].append((error, half, area.low <= taken.area <= area.high))
    figures = []
    for kind, rows in judged.items():
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
