"""Subjects `scan` and `look`: what the cameras scan of a body that breathes, and what a look tells of layers of gel.

`scan`: off the true surface, beside the stated sigma.
`look`: layers on rendered beds, some with a clog, as a look between layers measures and judges them.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.rig import Rig
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.bench.figures import Figure, Target, at_least, at_most, rms
from hardware.bench.mapping import NORMAL_MEDIAN, breathing_pose, shape_of
from hardware.live.surface_scan import ScanSource, scan_surface
from hardware.offline.looks import look_at
from hardware.process.clock import WallClock
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.fields import Gel, GelPieces
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState, rois
from hardware.simulator.scene.shape import Wound, body
from perception.frames import Frame, FrameSet
from perception.lens import Lenses
from perception.mapping.features import grey
from perception.mapping.surface_heights import SurfaceView, dense_heights, first_heights
from planning.laid_beads import BeadPieces, LaidBeads

SCAN_WETNESS = {"dry": 0.0, "wet": 1.0}
SCAN_SPAN, FUSED_SCAN_RATE = (
    4.0,
    7.5,
)  # s, a breath; Hz: tracking makes its map of the first sets, and the rest are far apart
SKIN_LIMITS, WOUND_LIMITS = (0.05, 0.15), (0.10, 0.30)  # mm, median and 95 %
STATED_RATIO = Target(0.6, 1.5)  # of errors by their standard deviations, median by a normal distribution's


def run_scan(options: argparse.Namespace) -> list[Figure]:
    """Scans of bodies, wet and dry, fused from pictures over a breath; poses by the tracker."""
    return [f for body in options.bodies for look in SCAN_WETNESS for f in scan_figures(body, look, options.sets)]


def scan_figures(kind: str, look: str, sets: int, rig: Rig | None = None) -> list[Figure]:
    """A body's scan: errors across the true surface on skin and in the wound, share of the area, honesty, time."""
    shape, rig = shape_of(kind, 1), rig or arc_rig()
    scene = Scene(shape, Appearance(wetness=SCAN_WETNESS[look]), seed=1)
    pictures, name = _sets(scene, rig), f"{kind}, {look}"
    source = ScanSource(rig, rois(scene, rig, breathing_pose(0.0), 0.0), pictures)
    scanned = scan_surface(source, sets, SCAN_SPAN)
    true_from_scanned = se3.inverse(breathing_pose(scanned.first.stamp)) @ scanned.first.base_from_surface
    points = se3.transform_points(true_from_scanned, scanned.scan.vertices)
    place = shape.material(points)
    error = np.abs(np.einsum("ni,ni->n", points - shape.points(place), shape.normals(place)))
    assert shape.inside is not None
    x, y = np.rint(shape.nodes(place)).astype(int).T
    wound, figures = shape.inside[y, x] > 0, list[Figure]()
    for part, mine, limits in (("skin", ~wound, SKIN_LIMITS), ("wound", wound, WOUND_LIMITS)):
        middle, high = np.percentile(error[mine], [50, 95])
        ratio = float(np.median(error[mine] / scanned.sigma[mine]) / NORMAL_MEDIAN)
        figures += [
            Figure(f"{name}: off the {part}, median", float(middle), "mm", at_most(limits[0])),
            Figure(f"{name}: off the {part}, 95 %", float(high), "mm", at_most(limits[1])),
            Figure(f"{name}: errors on the {part}, of what is stated", ratio, "", STATED_RATIO),
        ]
    share = f"{scanned.area / 100:.1f} cm^2 of {scanned.sets} frame sets"
    return [
        *figures,
        Figure(f"{name}: scanned of the region", 100 * scanned.coverage, "%", at_least(95), "", share),
        Figure(f"{name}: time to fuse", scanned.seconds, "s", at_most(10)),
    ]


def _sets(scene: Scene, rig: Rig) -> Iterator[FrameSet]:
    rng = np.random.default_rng([1, 41])
    for stamp in np.arange(round((SCAN_SPAN + 1) * FUSED_SCAN_RATE)) / FUSED_SCAN_RATE:
        state = WorldState(stamp, 0.0, breathing_pose(stamp), np.zeros(6))
        images = render(scene, rig.cameras, [state] * len(rig), Sensor(), rng.spawn(len(rig)))
        yield FrameSet(float(stamp), tuple(Frame(c, float(stamp), image) for c, image in enumerate(images)))


LOOK_FOCAL, LOOK_SIZE = 2200.0, (400, 300)  # px: 0.18 mm a pixel, about the beads
LOOK_GEL = Gel(gloss=0.05)  # matt, as behind crossed polarisers
LOOK_RISES = (0.0, 0.9, 1.7, 1.1)  # mm of breath at the frame sets of a look at a body that does not turn
LOOK_POSE_SIGMA = np.array([1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.01])  # rad, mm: of poses while a body breathes
BEAD_SIZE = 0.64, 1.6  # mm^2 and mm, as planned
BED_LAYERS, BED_SEED = 10, 20  # layers on one bed, from which the gel is taken off again; of the first bed
CLOG_EVERY, CLOG_SPAN = 6, 5.2  # layers from one with a clog to the next, and mm of bead that it lasts


def run_look(options: argparse.Namespace) -> list[Figure]:
    """Layers of four beads, on every other bed while it breathes: those laid well, clogs found, and false ones."""
    layers = [layer for bed in range(-(-options.layers // BED_LAYERS)) for layer in _laid_layers(bed, options.layers)]
    area, _ = BEAD_SIZE
    crest = LOOK_GEL.aspect * float(np.sqrt(1.5 * area / LOOK_GEL.aspect))
    note = f"pieces of {layers[0].laid.stations.end[0]:.2g} mm; {1000 * LOOK_GEL.gloss:g} per mille of gloss"
    figures = []
    for name, moves in (("at rest", False), ("breathing", True)):
        good = [layer.laid for layer in layers if layer.moves == moves and not layer.clog]
        if not good:
            continue
        off = np.array([100 * abs(laid.total[0] / laid.total[1] - 1) for laid in good])
        height = np.concatenate([laid.height for laid in good]) - crest
        figures += [
            Figure(f"{name}: height of a piece, RMS", rms(height[np.isfinite(height)]), "mm", at_most(0.05), "", note),
            Figure(f"{name}: volume of a layer, median", float(np.median(off)), "%", at_most(5.0)),
            Figure(f"{name}: volume of a layer, worst", float(off.max()), "%", None, "", f"of {len(good)} layers"),
        ]
    clogged, others = [x for x in layers if x.clog], [x for x in layers if not x.clog]
    found = sum(any(a < x.clog[1] and b > x.clog[0] for a, b in x.laid.clogs) for x in layers if x.clog)
    false = sum(len(x.laid.clogs) for x in others) + sum(max(len(x.laid.clogs) - 1, 0) for x in clogged)
    missed = f"clogs of {CLOG_SPAN:g} mm missed"
    return [
        *figures,
        Figure(missed, len(clogged) - found, "", at_most(0), "", f"of {len(clogged)}"),
        Figure("clogs found that were none", false, "", at_most(0), "", f"in {len(layers)} layers"),
        Figure("a look, judged in", float(np.median([x.seconds for x in layers])), "s", at_most(2.5), "", "median"),
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _LookedLayer:
    """What a look told of a layer, and what was true."""

    laid: LaidBeads
    clog: tuple[float, float] | None  # from, to, mm along the path
    moves: bool
    seconds: float  # s that judging took


def _laid_layers(bed: int, count: int) -> Iterator[_LookedLayer]:
    """The layers of one bed: its surface is measured once."""
    seed, moves, clock = BED_SEED + bed, bed % 2 == 1, WallClock()
    rng, kind = np.random.default_rng([seed, 71]), ("chest", "forearm", "foot")[bed // 2 % 3]
    scene = Scene(body(kind, Wound(), seed), Appearance(wetness=0.0), seed=seed)
    scene.gel = LOOK_GEL
    rig = arc_rig(focal=LOOK_FOCAL, size=LOOK_SIZE)
    lenses, (area, width), rows = Lenses(rig), BEAD_SIZE, np.arange(4)
    start = np.array([[-7.0, width * (k - 1.5), 0.0] for k in rows])
    end = start * [-1.0, 1.0, 1.0]
    pieces = BeadPieces(start, end, np.full(4, area), np.full(4, width), rows, 0 * rows, 16 * rows.astype(float))
    points = scene.shape.points(rng.uniform(-25.0, 25.0, (150, 2)))
    low, high = start[0, :2] - 10.0, end[-1, :2] + 10.0
    before = dense_heights(lenses, _look_views(scene, rig, rng, moves), first_heights(points, low, high, 0.2))
    for layer in range(bed * BED_LAYERS, min((bed + 1) * BED_LAYERS, count)):
        scene.ink.scrape()
        closed, begin = int(rng.integers(4)), rng.uniform(-7.0, 7.0 - CLOG_SPAN)
        clog = layer % CLOG_EVERY == CLOG_EVERY - 1
        for k in rows.tolist():
            way = np.linspace(start[k, :2], end[k, :2], 141)
            middle = (way[1:, 0] + way[:-1, 0]) / 2
            flow = np.where(clog & (k == closed) & (middle > begin) & (middle < begin + CLOG_SPAN), 0.0, area)
            scene.ink.flow(GelPieces(way[:-1], way[1:], 0.1 * flow, np.maximum(flow, area)), 60.0 * layer + k)
        scene.ink.flow(GelPieces(way[:0], way[:0], flow[:0], flow[:0]), 60.0 * layer + 50)
        views, place = _look_views(scene, rig, rng, moves), 16 * closed + begin + 7
        began = clock.now()
        laid, _, _ = look_at(lenses, views, before, pieces)
        yield _LookedLayer(laid, (place, place + CLOG_SPAN) if clog else None, moves, clock.now() - began)


def _look_views(scene: Scene, rig: Rig, rng: np.random.Generator, moves: bool) -> list[SurfaceView]:
    """Four instants of a breath, 0.25 s apart; a body that moves turns and smears, and its poses have errors."""
    found, stamps = [], rng.uniform(0, 4) + 0.25 * np.arange(len(LOOK_RISES))
    for rise, stamp in zip(LOOK_RISES, stamps.tolist(), strict=True):
        pose, twist = BASE_FROM_REST @ se3.make(np.eye(3), np.array([0.0, 0.0, rise])), np.zeros(6)
        known = pose
        if moves:
            pose = breathing_pose(stamp)
            twist = se3.log(se3.inverse(pose) @ breathing_pose(stamp + 1e-3)) / 1e-3
            known = pose @ se3.exp(LOOK_POSE_SIGMA * rng.standard_normal(6))
        images = render(scene, rig.cameras, [WorldState(stamp, 0.004, pose, twist)] * len(rig), Sensor(), rng.spawn(3))
        found.append(SurfaceView({camera: grey(image) for camera, image in enumerate(images)}, known))
    return found
