"""Subjects `scan` and `look`: what the cameras scan of a body that breathes, and what a look tells of layers of gel.

`scan`: off the true surface, beside the stated sigma.
`look`: layers on rendered beds and on each other, some with a clog, as looks between layers measure and judge them.
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
from hardware.live.surface_scan import ScanSource, scan_surface
from hardware.offline.looks import WIDTHS, look_at
from hardware.process.clock import WallClock
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.fields import Gel, GelPieces
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState, rois
from hardware.simulator.scene.shape import Wound, body
from perception.frames import Frame, FrameSet
from perception.lens import Lenses
from perception.mapping.surface_heights import SurfaceView, dense_heights, first_heights
from planning.laid_beads import BeadPieces, LaidBeads
from tests.campaigns.mapping import NORMAL_MEDIAN, breathing_pose, shape_of

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
STACK_SEED, STACK_HEIGHT = 120, 3  # of the first stack, and its layers
HALF_BEAD = 7.0  # mm: a clog of half an outer bead
LAYER_GAP = 60.0  # s from one layer to the next: gel comes to rest


@dataclass(frozen=True, slots=True)
class _Clog:
    """Where the needle gives nothing."""

    bead: int
    begin: float  # mm, x
    span: float  # mm

    @property
    def along(self) -> tuple[float, float]:
        """From, to, mm along the path."""
        return 16 * self.bead + self.begin + 7, 16 * self.bead + self.begin + 7 + self.span


def run_look(options: argparse.Namespace) -> list[Figure]:
    """First layers of four beads and stacks of such, every other bed while it breathes: those laid well, and clogs."""
    layers = [layer for bed in range(-(-options.layers // BED_LAYERS)) for layer in _first_layers(bed, options.layers)]
    layers += [layer for stack in range(options.stacks) for layer in _stack(stack)]
    area, _ = BEAD_SIZE
    crest = LOOK_GEL.aspect * float(np.sqrt(1.5 * area / LOOK_GEL.aspect))
    note = f"pieces of {layers[0].laid.stations.end[0]:.2g} mm; {1000 * LOOK_GEL.gloss:g} per mille of gloss"
    figures = list[Figure]()
    for name, moves, upper in (
        *(("at rest", False, False), ("breathing", True, False)),
        *(("upper layers, at rest", False, True), ("upper layers, breathing", True, True)),
    ):
        good = [x.laid for x in layers if x.moves == moves and (x.below > 0) == upper and not x.clog]
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
    found = sum(any(a < x.clog.along[1] and b > x.clog.along[0] for a, b in x.laid.clogs) for x in layers if x.clog)
    false = sum(len(x.laid.clogs) for x in others) + sum(max(len(x.laid.clogs) - 1, 0) for x in clogged)
    missed, above = f"clogs of {CLOG_SPAN:g} mm or more missed", sum(x.below > 0 for x in clogged)
    among = f"in {len(layers)} layers, {sum(x.below > 0 for x in layers)} of them on others"
    return [
        *figures,
        Figure(missed, len(clogged) - found, "", at_most(0), "", f"of {len(clogged)}, {above} of them in upper layers"),
        Figure("clogs found that were none", false, "", at_most(0), "", among),
        Figure("a look, judged in", float(np.median([x.seconds for x in layers])), "s", at_most(2.5), "", "median"),
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _LookedLayer:
    """What a look told of a layer, and what was true."""

    laid: LaidBeads
    clog: _Clog | None
    below: int  # layers that it lies on
    moves: bool
    seconds: float  # s that judging took


def _first_layers(bed: int, count: int) -> Iterator[_LookedLayer]:
    """Layers on one bed, each laid when the last one is taken off: its surface is measured once."""
    laid = _Bed(BED_SEED + bed, bed % 2 == 1)
    for layer in range(bed * BED_LAYERS, min((bed + 1) * BED_LAYERS, count)):
        laid.scene.ink.scrape()
        place = _Clog(int(laid.rng.integers(4)), laid.rng.uniform(-7.0, 7.0 - CLOG_SPAN), CLOG_SPAN)
        yield laid.look(layer, 0, place if layer % CLOG_EVERY == CLOG_EVERY - 1 else None)


def _stack(number: int) -> Iterator[_LookedLayer]:
    """Layers upon each other; of four stacks one has a clog in its third layer, one in its second, one at an edge."""
    laid = _Bed(STACK_SEED + number, number // 2 % 2 == 1)
    place = _Clog(int(laid.rng.integers(4)), laid.rng.uniform(-7.0, 7.0 - CLOG_SPAN), CLOG_SPAN)
    edge = _Clog(3 * int(laid.rng.integers(2)), float(laid.rng.choice([-7.0, 7.0 - HALF_BEAD])), HALF_BEAD)
    clogged, clog = ((2, place), (1, place), (2, edge), (-1, None))[number % 4]
    for layer in range(STACK_HEIGHT):
        yield laid.look(layer, layer, clog if layer == clogged else None)


class _Bed:
    """A body's wound that four beads are laid on, and how its surface was measured."""

    def __init__(self, seed: int, moves: bool) -> None:
        self.moves, self.rng = moves, np.random.default_rng([seed, 71])
        kind = ("chest", "forearm", "foot")[seed // 2 % 3]
        self.scene = Scene(body(kind, Wound(), seed), Appearance(wetness=0.0), seed=seed)
        self.scene.gel = LOOK_GEL
        self._rig = arc_rig(focal=LOOK_FOCAL, size=LOOK_SIZE)
        self._lenses, (area, width), rows = Lenses(self._rig), BEAD_SIZE, np.arange(4)
        start = np.array([[-7.0, width * (k - 1.5), 0.0] for k in rows])
        size, place = (np.full(4, area), np.full(4, width)), 16 * rows.astype(float)
        self._pieces = BeadPieces(start, start * [-1.0, 1.0, 1.0], *size, rows, 0 * rows, place)
        points = self.scene.shape.points(self.rng.uniform(-25.0, 25.0, (150, 2)))
        low, high = start[0, :2] - 10.0, self._pieces.end[-1, :2] + 10.0
        self._bare = dense_heights(self._lenses, self._views(), first_heights(points, low, high, 0.2))
        self._ground = self._bare
        self._widths: tuple[float, ...] = WIDTHS

    def look(self, number: int, below: int, clog: _Clog | None) -> _LookedLayer:
        """Lay the `number`-th layer of this bed, on so many others, and look at it."""
        area, clock = BEAD_SIZE[0], WallClock()
        for k, (a, b) in enumerate(zip(self._pieces.start[:, :2], self._pieces.end[:, :2], strict=True)):
            way = np.linspace(a, b, 141)
            flow = np.full(140, area)
            if clog is not None and clog.bead == k:
                middle = (way[1:, 0] + way[:-1, 0]) / 2 - clog.begin
                flow[(middle > 0) & (middle < clog.span)] = 0.0
            now = LAYER_GAP * number + k
            self.scene.ink.flow(GelPieces(way[:-1], way[1:], 0.1 * flow, np.maximum(flow, area)), now)
        none = way[:0]
        self.scene.ink.flow(GelPieces(none, none, flow[:0], flow[:0]), LAYER_GAP * (number + 1) - 10.0)
        ground, widths = (self._ground, self._widths) if below else (self._bare, WIDTHS)
        views, began = self._views(), clock.now()
        laid, self._ground, width = look_at(self._lenses, views, ground, self._pieces, widths)
        self._widths = (width,)
        return _LookedLayer(laid, clog, below, self.moves, clock.now() - began)

    def _views(self) -> list[SurfaceView]:
        """Four instants of a breath, 0.25 s apart; a body that moves turns and smears, and its poses have errors."""
        found, stamps = [], self.rng.uniform(0, 4) + 0.25 * np.arange(len(LOOK_RISES))
        for rise, stamp in zip(LOOK_RISES, stamps.tolist(), strict=True):
            pose, twist = BASE_FROM_REST @ se3.make(np.eye(3), np.array([0.0, 0.0, rise])), np.zeros(6)
            known = pose
            if self.moves:
                pose = breathing_pose(stamp)
                twist = se3.log(se3.inverse(pose) @ breathing_pose(stamp + 1e-3)) / 1e-3
                known = pose @ se3.exp(LOOK_POSE_SIGMA * self.rng.standard_normal(6))
            state, draws = WorldState(stamp, 0.004, pose, twist), self.rng.spawn(3)
            images = render(self.scene, self._rig.cameras, [state] * len(self._rig), Sensor(), draws)
            found.append(SurfaceView(dict(enumerate(images)), known))
        return found
