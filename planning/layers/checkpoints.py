"""From beads to the path: where the tip is, how the tool stands, how fast it goes and how it travels (thesis 5.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from estimation import se3
from estimation.se3 import Array
from planning.fill.bead import Bead
from planning.layers.chart import Chart
from planning.layers.grid import Grid, at, gradient, smoothed
from planning.layers.runs import Runs, bends, runs_of, spaced, spacing_over
from planning.layers.slicing import Stack
from planning.layers.tool import Tilts, ToolLimits, rotations
from planning.path import NEAREST, Path

Index = NDArray[np.int64]
CLEAR = 1.0  # mm around the way of the tip that a travel looks for higher ground: a fine nozzle's outer radius
HOP = 3.0  # mm between the checkpoints of a travel: follows a limb's roundness to 0.05 mm
LOWEST_HOP = 0.3  # mm of lift even for the shortest travel: clears a bead just laid


@dataclass(frozen=True, slots=True)
class Way:
    """How checkpoints are set.

    spacing: mm between them, the shortest length the ink can be laid over. chord: mm that straight ways may depart
    from curved ones. sideways: mm/s^2, by which a bend is slowed down to; slowest: share of the speed that is kept.
    travel: mm/s between beads. lift: mm along the tool's axis. wait: s before each layer. tool: its limits.
    """

    spacing: float = 1.0
    chord: float = 0.02
    sideways: float = 200.0
    slowest: float = 0.25
    travel: float = 60.0
    lift: float = 2.0
    wait: float = 0.0
    tool: ToolLimits = field(default_factory=ToolLimits)


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """What the tip goes over.

    low, high: tilts of the stack's two ends. curvature: (H, W, 2) 1/mm, of both. ceiling: (H, W) mm, for travels.
    """

    stack: Stack
    chart: Chart
    surface_from_plane: Array
    low: Tilts
    high: Tilts
    curvature: Array  # (H, W, 2)
    ceiling: Array  # (H, W)

    def mixed(self, values: Array, xy: Array, share: Array) -> Array:
        """Values (H, W, 2, K) of both ends at points (N, 2) and shares (N,): (N, K)."""
        both = at(self.stack.grid, values, xy)
        return np.asarray(both[:, 0] + share[:, None] * (both[:, 1] - both[:, 0]))


@dataclass(frozen=True, slots=True, eq=False)
class Laid:
    """The checkpoints of a plan, each column (N,) or (N, ...), in the plane's frame.

    tip: (N, 3) mm. tilt: (N, 2) rad. extrude: on the way to each. width, height: mm of the bead, 0 where none is laid.
    volume: mm^3 laid on the way to each. layer, bead: numbers; bead counts from 0 over the whole plan.
    """

    tip: Array
    tilt: Array
    speed: Array
    extrude: NDArray[np.bool_]
    width: Array
    height: Array
    volume: Array
    layer: Index
    bead: Index
    wait: Array


def curvature(grid: Grid, heights: Array, radius: float) -> Array:
    """About the greatest curvature (H, W), 1/mm, of a surface smoothed over `radius` mm."""
    slopes = gradient(grid, smoothed(grid, heights, radius))
    parts = [gradient(grid, slopes[..., k]) for k in range(2)]
    return np.asarray(np.linalg.norm(np.concatenate(parts, axis=-1), axis=-1))


def ceiling(grid: Grid, scan: Array) -> Array:
    """Heights (H, W) that a travel must stay over."""
    return np.asarray(maximum_filter(scan, size=2 * round(CLEAR / grid.step) + 1))


def laid(ground: Ground, beads: Sequence[Bead], layer_of: Index, way: Way) -> Laid:
    """The checkpoints of beads, in printing order, of the layers `layer_of` (B,) that they belong to."""
    stack, shares = ground.stack, np.array([layer.share for layer in ground.stack.layers])
    runs = runs_of(beads, way.chord)
    share = shares[layer_of[runs.bead]]
    middle = ground.chart.to_plane(runs.points)
    bent = ground.mixed(ground.curvature[..., None], middle, share)[:, 0]
    runs = spaced(runs, spacing_over(np.maximum(bent, np.r_[bent[:1], bent[:-1]]), way.spacing, way.chord))
    layer = layer_of[runs.bead]
    xy = ground.chart.to_plane(runs.points)
    tip = np.column_stack([xy, stack.tops(xy, layer)])
    tilt = ground.mixed(np.stack([ground.low.values, ground.high.values], axis=2), xy, shares[layer])
    height = stack.bead_heights(xy, layer) * at(ground.chart.grid, ground.chart.cosine, xy)
    area = (runs.width + np.r_[runs.width[:1], runs.width[:-1]]) / 2 * runs.steps
    volume = area * (height + np.r_[height[:1], height[:-1]]) / 2
    speed = _speeds(runs, np.array([s.slab.tissue.speed for s in stack.layers])[layer], way)
    wait = np.zeros(len(tip))
    printed = Laid(tip, tilt, speed, ~runs.first, runs.width, height, volume, layer, runs.bead, wait)
    return _with_travels(ground, printed, runs, way)


def _speeds(runs: Runs, full: Array, way: Way) -> Array:
    """mm/s (N,) of the way to each point: the slower of what its two ends allow."""
    allowed = np.minimum(full, np.sqrt(way.sideways * bends(runs)))
    allowed = np.maximum(allowed, way.slowest * full)
    before = np.r_[allowed[:1], allowed[:-1]]
    return np.where(runs.first, way.travel, np.minimum(allowed, before))


def _with_travels(ground: Ground, printed: Laid, runs: Runs, way: Way) -> Laid:
    """The beads with a travel before each: up along the tool, over what stands between, and down."""
    starts, ends = np.flatnonzero(runs.first), np.flatnonzero(runs.last)
    a, b = np.r_[starts[0], ends[:-1]], starts  # before the first bead there is only the way down
    hop = np.linalg.norm(printed.tip[b] - printed.tip[a], axis=1)
    new_layer = printed.layer[a] != printed.layer[b]
    new_layer[0] = True
    lift = np.where(new_layer, way.lift, np.clip(hop / 2, min(LOWEST_HOP, way.lift), way.lift))
    between = np.where(hop > HOP, np.ceil(hop / HOP) - 1, 0).astype(np.int64)
    count = between + 2  # up and over
    count[0] = 1
    of = np.repeat(np.arange(len(count)), count)
    k = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    part = np.where(of == 0, 1.0, k / (count[of] - 1 + (of == 0)))
    tip, tilt = _over(ground, printed, a[of], b[of], part, lift[of])
    wait = np.where(new_layer[of] & (k == 0), way.wait, 0.0)
    none, zero = np.zeros(len(of), bool), np.zeros(len(of))
    travels = Laid(
        tip, tilt, np.full(len(of), way.travel), none, zero, zero, zero, printed.layer[b[of]], printed.bead[b[of]], wait
    )
    return _leaving(_merged(travels, b[of], printed), way)


def _over(ground: Ground, printed: Laid, a: Index, b: Index, part: Array, lift: Array) -> tuple[Array, Array]:
    """Tips (M, 3) and tilts (M, 2) at a part (M,) of the way from checkpoint a (M,) to b (M,), `lift` (M,) mm up."""
    tilt = printed.tilt[a] + part[:, None] * (printed.tilt[b] - printed.tilt[a])
    foot = printed.tip[a] + part[:, None] * (printed.tip[b] - printed.tip[a])
    inner = (part > 0) & (part < 1)
    top = np.maximum(
        at(ground.stack.grid, ground.ceiling, foot[:, :2]), ground.stack.tops(foot[:, :2], printed.layer[b])
    )
    foot[inner, 2] = np.maximum(foot[inner, 2], top[inner])
    up = rotations(tilt, 0.0)[:, :, 2]
    return foot + lift[:, None] * up, tilt


def _merged(travels: Laid, before: Index, printed: Laid) -> Laid:
    """Both in order: each travel before the checkpoint (M,) it leads to."""
    order = np.argsort(np.r_[before - 0.5, np.arange(len(printed.speed))], kind="stable")
    return Laid(*(np.concatenate([getattr(travels, n), getattr(printed, n)])[order] for n in Laid.__dataclass_fields__))


def _leaving(all_of: Laid, way: Way) -> Laid:
    """With a last checkpoint, lifted off the last bead."""
    up = all_of.tip[-1:] + way.lift * rotations(all_of.tilt[-1:], 0.0)[:, :, 2]
    zero, none = np.zeros(1), np.zeros(1, bool)
    last = Laid(
        up, all_of.tilt[-1:], np.array([way.travel]), none, zero, zero, zero, all_of.layer[-1:], all_of.bead[-1:], zero
    )
    return Laid(*(np.concatenate([getattr(all_of, n), getattr(last, n)]) for n in Laid.__dataclass_fields__))


def path_of(points: Laid, ground: Ground, spin: float) -> Path:
    """The path, in the scan's frame, with columns wait_s, width_mm, height_mm, volume_mm3 and run, the bead."""
    plane_from_nozzle = se3.make(rotations(points.tilt, spin), points.tip)
    apart = np.r_[True, np.linalg.norm(np.diff(points.tip, axis=0), axis=1) >= 2 * NEAREST]
    tissues = [layer.slab.tissue for layer in ground.stack.layers]
    layer = points.layer[apart]
    return Path(
        surface_from_nozzle=ground.surface_from_plane @ plane_from_nozzle[apart],
        speed=points.speed[apart],
        material=_materials([t.material for t in tissues], layer),
        temperature=np.array([t.temperature for t in tissues])[layer],
        layer=layer,
        extrude=points.extrude[apart],
        extra={
            "wait_s": _words(points.wait[apart]),
            "width_mm": _words(points.width[apart]),
            "height_mm": _words(points.height[apart]),
            "volume_mm3": _words(points.volume[apart], 4),
            "run": _words(points.bead[apart].astype(float), 0),
        },
    )


def _materials(names: Sequence[str], layer: Index) -> NDArray[np.int64] | NDArray[np.str_]:
    if all(name.isascii() and name.isdecimal() and str(int(name)) == name for name in names):
        return np.array([int(name) for name in names], np.int64)[layer]
    return np.array(names)[layer]


def _words(values: Array, digits: int = 3) -> NDArray[np.str_]:
    """Numbers as text of so many digits; each different one is written once."""
    scale = 10**digits
    whole, number = np.unique(np.rint(values * scale).astype(np.int64), return_inverse=True)
    return np.array([f"{v / scale:.{digits}f}".rstrip("0").rstrip(".") if digits else str(v) for v in whole.tolist()])[
        number
    ]
