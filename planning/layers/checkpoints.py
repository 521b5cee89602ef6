"""From beads to the path: checkpoints along the lines, tool orientation, speeds and travels (thesis 5.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from estimation import se3
from estimation.se3 import Array
from planning.fill.bead import Bead
from planning.layers.grid import Chart, Grid, Mask, gradient, interpolate, smoothed
from planning.layers.slicing import LayerStack
from planning.path import MIN_SPACING, Path

Index = NDArray[np.int64]
MIN_SPACING_SHARE = 0.25  # of the spacing: nearer checkpoints than that are not set for the surface's sake
SMOOTHING_RADII = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # mm: by the first that holds the limit the normals are smoothed
TRAVEL_CLEARANCE = 1.0  # mm around the tip's way, over whose highest ground a travel goes: a fine nozzle's outer radius
TRAVEL_SPACING = 3.0  # mm between the checkpoints of a travel: follows a limb's roundness to 0.05 mm
MIN_LIFT = 0.3  # mm of lift even for the shortest travel: clears a bead just laid


@dataclass(frozen=True, slots=True, eq=False)
class BeadPoints:
    """Points of many beads, one after another."""

    points: Array  # (N, 2) mm
    width: Array  # (N,) mm
    bead: Index  # (N,) number of the bead, ascending

    @property
    def steps(self) -> Array:
        """Length (N,), mm, of the way to each point; 0 at the first of each bead."""
        return np.where(self.first, 0.0, np.r_[0.0, np.hypot(*np.diff(self.points, axis=0).T)])

    @property
    def first(self) -> NDArray[np.bool_]:
        """(N,) whether a bead begins there."""
        return np.asarray(np.r_[True, np.diff(self.bead) != 0])

    @property
    def last(self) -> NDArray[np.bool_]:
        """(N,) whether a bead ends there."""
        return np.asarray(np.r_[np.diff(self.bead) != 0, True])


def bead_points(beads: Sequence[Bead], chord: float) -> BeadPoints:
    """Beads without the points that neither the line nor the half width to its edges needs, to `chord` mm each."""
    count = np.array([len(bead.points) for bead in beads])
    points, width = np.concatenate([b.points for b in beads]), np.concatenate([b.width for b in beads])
    every = BeadPoints(points, width, np.repeat(np.arange(len(beads)), count))
    even = np.array([np.ptp(bead.width) < 1e-9 for bead in beads], bool)
    # points kept for the line cut the stretches found for the width, and the other way round: twice as far off at most
    within = np.where(even, chord, chord / 2)
    edge = np.column_stack([np.cumsum(every.steps), every.width / 2])
    needed = _needed(every.points, every.bead, within) | _needed(edge, every.bead, within)
    return _apart(BeadPoints(every.points[needed], every.width[needed], every.bead[needed]))


def _needed(points: Array, owner: Index, within: Array) -> NDArray[np.bool_]:
    """Which points (N, 2) of lines, each of one `owner` (N,), Douglas and Peucker keep to `within` (lines,)."""
    numbered = np.column_stack([points, np.arange(len(points))])
    simple = shapely.simplify(shapely.linestrings(numbered, indices=owner), within, preserve_topology=False)
    needed = np.zeros(len(points), bool)
    needed[shapely.get_coordinates(simple, include_z=True)[:, 2].astype(np.int64)] = True
    return needed


def _apart(runs: BeadPoints) -> BeadPoints:
    """Without points that stand on the one before: they have no direction between them."""
    keep = runs.first | (runs.steps > 2e-3)
    end = runs.last & ~keep  # the end of a bead stays, what stood before it goes
    keep[np.flatnonzero(end)] = True
    before = np.flatnonzero(end) - 1
    keep[before[~runs.first[before]]] = False
    return BeadPoints(runs.points[keep], runs.width[keep], runs.bead[keep])


def with_spacing(runs: BeadPoints, spacing: Array) -> BeadPoints:
    """With points between, so that none is more than spacing (N,) mm, of the way to it, from the one before."""
    count = np.maximum(np.ceil(runs.steps / spacing - 1e-9), 1).astype(np.int64)
    end = np.repeat(np.arange(len(count)), count)
    part = (np.arange(len(end)) - np.repeat(np.cumsum(count) - count, count) + 1) / count[end]
    start = np.maximum(end - 1, 0)
    part = np.where(runs.first[end], 1.0, part)
    points = runs.points[start] + part[:, None] * (runs.points[end] - runs.points[start])
    width = runs.width[start] + part * (runs.width[end] - runs.width[start])
    return BeadPoints(points, width, runs.bead[end])


def spacing_over(curvature: Array, spacing: float, chord: float) -> Array:
    """Spacing (N,), mm, at which a chord over a curvature (N,), 1/mm, departs from it by `chord` mm at most."""
    bent = np.sqrt(8 * chord / np.maximum(curvature, 1e-9))
    return np.asarray(np.clip(bent, MIN_SPACING_SHARE * spacing, spacing))


def bend_radii(runs: BeadPoints) -> Array:
    """Radius (N,), mm, of the line at each point: how far it goes for each radian it turns; inf at ends."""
    step = np.diff(runs.points, axis=0, append=runs.points[-1:])
    into = np.r_[step[:1], step[:-1]]
    turn = np.abs(np.arctan2(into[:, 0] * step[:, 1] - into[:, 1] * step[:, 0], (into * step).sum(axis=1)))
    reach = (np.hypot(*into.T) + np.hypot(*step.T)) / 2
    return np.where(runs.first | runs.last, np.inf, reach / np.maximum(turn, 1e-9))


@dataclass(frozen=True, slots=True)
class ToolLimits:
    """Limits of the tool's orientation."""

    tilt: float = np.deg2rad(30.0)  # rad from the plane's normal
    turning: float = np.deg2rad(5.0)  # rad per mm of way
    spin: float = 0.0  # rad about the tool's axis, free for a round nozzle; 0: its x is along the scan's


@dataclass(frozen=True, slots=True, eq=False)
class TiltField:
    """Tilts of a surface: how far its normal leans, towards where it rises."""

    values: Array  # (H, W, 2) rad
    radius: float  # mm that they were smoothed over
    departure: float  # rad, worst angle of the tool off the true normal inside the wound


def tilt_field(grid: Grid, heights: Array, inside: Mask, limits: ToolLimits) -> TiltField:
    """Tilts of a surface with heights (H, W) that keep the limits wherever the tool goes, not on one path only.

    A field that changes by at most `turning` a mm turns no tool faster on any way across it.
    """
    true = _tilts(gradient(grid, heights))
    chosen, used = true, 0.0
    for used in SMOOTHING_RADII:
        chosen = _tilts(gradient(grid, smoothed(grid, heights, used)))
        size = np.linalg.norm(chosen, axis=-1, keepdims=True)
        chosen = chosen * np.minimum(1.0, limits.tilt / np.maximum(size, 1e-12))
        rate = _rate(grid, chosen, inside)
        if rate <= limits.turning:
            break
    else:
        chosen = chosen * (limits.turning / rate)
    return TiltField(chosen, used, float(np.linalg.norm(true - chosen, axis=-1)[inside].max(initial=0.0)))


def _tilts(slopes: Array) -> Array:
    steep = np.linalg.norm(slopes, axis=-1, keepdims=True)
    return np.asarray(slopes * np.arctan(steep) / np.maximum(steep, 1e-12))


def _rate(grid: Grid, values: Array, inside: Mask) -> float:
    """The fastest change of tilts, rad per mm, in any direction, over the nodes inside."""
    parts = np.concatenate([gradient(grid, values[..., k])[inside] for k in range(2)], axis=1)  # (N, 4)
    a, b, c, d = parts.T
    squares, area = a * a + b * b + c * c + d * d, a * d - b * c
    return float(np.sqrt(np.max((squares + np.sqrt(np.maximum(squares**2 - 4 * area**2, 0))) / 2, initial=0.0)))


def tool_rotations(tilt: Array, spin: float) -> Array:
    """plane_from_nozzle rotations (N, 3, 3) of tilts (N, 2): the least turn from upright, after the spin."""
    turn = np.column_stack([tilt[:, 1], -tilt[:, 0], np.zeros(len(tilt))])
    return np.asarray(se3.exp_rotation(turn) @ se3.exp_rotation(np.array([0.0, 0.0, spin])))


@dataclass(frozen=True, slots=True)
class CheckpointSettings:
    """How checkpoints are set."""

    spacing: float = 1.0  # mm between them: the shortest length that the ink can be laid over
    chord: float = 0.02  # mm by which straight ways may depart from curved ones
    sideways: float = 200.0  # mm/s^2, lateral acceleration that bends are slowed down to
    slowest: float = 0.25  # share of the speed that is kept in them
    travel: float = 60.0  # mm/s between beads
    lift: float = 2.0  # mm along the tool's axis, for travels
    wait: float = 0.0  # s before each layer
    tool: ToolLimits = field(default_factory=ToolLimits)


@dataclass(frozen=True, slots=True, eq=False)
class TipSurface:
    """The surfaces that the tip follows."""

    stack: LayerStack
    chart: Chart
    surface_from_plane: Array  # (4, 4) mm
    low: TiltField  # of the stack's lowest surface
    high: TiltField  # of its highest
    curvature: Array  # (H, W, 2) 1/mm, of both
    ceiling: Array  # (H, W) mm, lowest height of travels

    def mixed(self, values: Array, xy: Array, share: Array) -> Array:
        """Values (H, W, 2, K) of both ends at points (N, 2) and shares (N,): (N, K)."""
        both = interpolate(self.stack.grid, values, xy)
        return np.asarray(both[:, 0] + share[:, None] * (both[:, 1] - both[:, 0]))


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoints:
    """The N checkpoints of a plan, in the plane's frame."""

    tip: Array  # (N, 3) mm
    tilt: Array  # (N, 2) rad
    speed: Array  # (N,) mm/s, on the way to each
    extrude: NDArray[np.bool_]  # (N,) on the way to each
    width: Array  # (N,) mm of the bead, 0 where none is laid
    height: Array  # (N,) mm of the bead, 0 where none is laid
    volume: Array  # (N,) mm^3, on the way to each
    layer: Index  # (N,)
    bead: Index  # (N,) counted from 0 over the whole plan
    wait: Array  # (N,) s


def curvature(grid: Grid, heights: Array, radius: float) -> Array:
    """About the greatest curvature (H, W), 1/mm, of a surface smoothed over `radius` mm."""
    slopes = gradient(grid, smoothed(grid, heights, radius))
    parts = [gradient(grid, slopes[..., k]) for k in range(2)]
    return np.asarray(np.linalg.norm(np.concatenate(parts, axis=-1), axis=-1))


def ceiling(grid: Grid, scan: Array) -> Array:
    """Heights (H, W) that a travel must stay over."""
    return np.asarray(maximum_filter(scan, size=2 * round(TRAVEL_CLEARANCE / grid.step) + 1))


def checkpoints_on(
    ground: TipSurface, beads: Sequence[Bead], layer_of: Index, way: CheckpointSettings
) -> tuple[BeadPoints, Checkpoints]:
    """The checkpoints of beads, in printing order, of the layers `layer_of` (B,) that they belong to; no travels yet.

    And the points of the beads, in the chart, that they are.
    """
    stack, shares = ground.stack, np.array([layer.share for layer in ground.stack.layers])
    runs = bead_points(beads, way.chord)
    share = shares[layer_of[runs.bead]]
    middle = ground.chart.to_plane(runs.points)
    bent = ground.mixed(ground.curvature[..., None], middle, share)[:, 0]
    runs = with_spacing(runs, spacing_over(np.maximum(bent, np.r_[bent[:1], bent[:-1]]), way.spacing, way.chord))
    layer = layer_of[runs.bead]
    xy = ground.chart.to_plane(runs.points)
    tip = np.column_stack([xy, stack.tops(xy, layer)])
    tilt = ground.mixed(np.stack([ground.low.values, ground.high.values], axis=2), xy, shares[layer])
    height = stack.bead_heights(xy, layer) * interpolate(ground.chart.grid, ground.chart.cosine, xy)
    area = (runs.width + np.r_[runs.width[:1], runs.width[:-1]]) / 2 * runs.steps
    volume = area * (height + np.r_[height[:1], height[:-1]]) / 2
    # the slower of what both ends of the way to each point allow
    full = np.array([s.slab.tissue.speed for s in stack.layers])[layer]
    allowed = np.maximum(np.minimum(full, np.sqrt(way.sideways * bend_radii(runs))), way.slowest * full)
    speed = np.where(runs.first, way.travel, np.minimum(allowed, np.r_[allowed[:1], allowed[:-1]]))
    wait = np.zeros(len(tip))
    return runs, Checkpoints(tip, tilt, speed, ~runs.first, runs.width, height, volume, layer, runs.bead, wait)


def with_travels(ground: TipSurface, printed: Checkpoints, runs: BeadPoints, way: CheckpointSettings) -> Checkpoints:
    """The beads with a travel before each: up along the tool, over what stands between, and down."""
    starts, ends = np.flatnonzero(runs.first), np.flatnonzero(runs.last)
    a, b = np.r_[starts[0], ends[:-1]], starts  # before the first bead there is only the way down
    hop = np.linalg.norm(printed.tip[b] - printed.tip[a], axis=1)
    new_layer = printed.layer[a] != printed.layer[b]
    new_layer[0] = True
    lift = np.where(new_layer, way.lift, np.clip(hop / 2, min(MIN_LIFT, way.lift), way.lift))
    between = np.where(hop > TRAVEL_SPACING, np.ceil(hop / TRAVEL_SPACING) - 1, 0).astype(np.int64)
    count = between + 2  # up and over
    count[0] = 1
    of = np.repeat(np.arange(len(count)), count)
    k = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    part = np.where(of == 0, 1.0, k / (count[of] - 1 + (of == 0)))
    tip, tilt = _over(ground, printed, a[of], b[of], part, lift[of])
    wait = np.where(new_layer[of] & (k == 1), way.wait, 0.0)  # lifted off the last bead
    none, zero = np.zeros(len(of), bool), np.zeros(len(of))
    layer, bead, speed = printed.layer[b[of]], printed.bead[b[of]], np.full(len(of), way.travel)
    travels = Checkpoints(tip, tilt, speed, none, zero, zero, zero, layer, bead, wait)
    # each travel before the checkpoint it leads to, and a last checkpoint, lifted off the last bead
    order = np.argsort(np.r_[b[of] - 0.5, np.arange(len(printed.speed))], kind="stable")
    up = printed.tip[-1:] + way.lift * tool_rotations(printed.tilt[-1:], 0.0)[:, :, 2]
    tilt, layer, bead = printed.tilt[-1:], printed.layer[-1:], printed.bead[-1:]
    zero, none, speed = np.zeros(1), np.zeros(1, bool), np.array([way.travel])
    last = Checkpoints(up, tilt, speed, none, zero, zero, zero, layer, bead, zero)
    columns = [[getattr(part, f.name) for part in (travels, printed, last)] for f in fields(Checkpoints)]
    return Checkpoints(*(np.concatenate([np.concatenate([a, b])[order], c]) for a, b, c in columns))


def _over(
    ground: TipSurface, printed: Checkpoints, a: Index, b: Index, part: Array, lift: Array
) -> tuple[Array, Array]:
    """Tips (M, 3) and tilts (M, 2) at a part (M,) of the way from checkpoint a (M,) to b (M,), `lift` (M,) mm up."""
    tilt = printed.tilt[a] + part[:, None] * (printed.tilt[b] - printed.tilt[a])
    foot = printed.tip[a] + part[:, None] * (printed.tip[b] - printed.tip[a])
    inner = (part > 0) & (part < 1)
    highest = interpolate(ground.stack.grid, ground.ceiling, foot[:, :2])
    top = np.maximum(highest, ground.stack.tops(foot[:, :2], printed.layer[b]))
    foot[inner, 2] = np.maximum(foot[inner, 2], top[inner])
    up = tool_rotations(tilt, 0.0)[:, :, 2]
    return foot + lift[:, None] * up, tilt


def path_from(points: Checkpoints, ground: TipSurface, spin: float) -> Path:
    """The path, in the scan's frame, with columns wait_s, width_mm, height_mm, volume_mm3 and run, the bead."""
    plane_from_nozzle = se3.make(tool_rotations(points.tilt, spin), points.tip)
    apart = np.r_[True, np.linalg.norm(np.diff(points.tip, axis=0), axis=1) >= 2 * MIN_SPACING]
    tissues = [layer.slab.tissue for layer in ground.stack.layers]
    layer = points.layer[apart]
    extra = [("wait_s", points.wait, 3), ("width_mm", points.width, 3), ("height_mm", points.height, 3)]
    extra += [("volume_mm3", points.volume, 4), ("run", points.bead.astype(float), 0)]
    return Path(
        surface_from_nozzle=ground.surface_from_plane @ plane_from_nozzle[apart],
        speed=points.speed[apart],
        material=_materials([t.material for t in tissues], layer),
        temperature=np.array([t.temperature for t in tissues])[layer],
        layer=layer,
        extrude=points.extrude[apart],
        extra={name: _number_texts(values[apart], digits) for name, values, digits in extra},
    )


def _materials(names: Sequence[str], layer: Index) -> NDArray[np.int64] | NDArray[np.str_]:
    if all(name.isascii() and name.isdecimal() and str(int(name)) == name for name in names):
        return np.array([int(name) for name in names], np.int64)[layer]
    return np.array(names)[layer]


def _number_texts(values: Array, digits: int) -> NDArray[np.str_]:
    """Numbers as text of so many digits; each different one is written once."""
    scale = 10**digits
    whole, number = np.unique(np.rint(values * scale).astype(np.int64), return_inverse=True)
    texts = [f"{v / scale:.{digits}f}".rstrip("0").rstrip(".") if digits else str(v) for v in whole.tolist()]
    return np.array(texts)[number]
