"""Tissues and layers between the wound's bed and the restored skin: horizontal (thesis 5.2) or along the surface.

All layers of a stack are mixtures of a lowest and a highest surface: a place in the stack is a height over the plane,
by a share from 0 to 1.

    horizontal   flat, from the deepest point of the bed to the highest of the skin
    skin         parallel to the restored skin
    conformal    the first follows the bed, the last is the restored skin, those between blend from one into the other

Bumps of the scanned bed that stand over a layer: low ones are gone over, high ones round (thesis 5.2, Fig. 5.5). What
joins the skin around the wound is its wall and no bump: a layer ends there anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import shapely
from scipy.ndimage import label
from shapely import MultiPolygon

from estimation.errors import InputError
from estimation.se3 import Array, Index
from planning.fill.bead import without_bumps
from planning.layers.grid import Grid, Mask, as_multi, interpolate, nodes_within, positive_region, smoothed
from planning.layers.outline import OUTLINE_TOLERANCE
from planning.layers.wound import WoundVolume

EIGHT_NEIGHBOURS = np.ones((3, 3), int)  # nodes joined across corners too, so that no outline runs between them
# of a layer's height that a bump may stand over its top: the layer over it keeps three tenths of its own there,
# at most: a fifth, the thinnest bead
DEFAULT_BUMP_LIMIT, MAX_BUMP_LIMIT = 0.5, 0.6
DEFAULT_CLEARANCE = 0.5  # of a bead's width: a needle is about twice as thick as its bead (22 G: 0.41 in, 0.72 mm out)


@dataclass(frozen=True, slots=True)
class BumpPassing:
    """How bumps are passed."""

    over: float | None = None  # mm above a layer's top up to which one is gone over; None: DEFAULT_BUMP_LIMIT
    clearance: float | None = None  # mm kept around a higher one; None: DEFAULT_CLEARANCE

    def limit(self, height: float) -> float:
        """mm above the top of a layer `height` mm high."""
        return DEFAULT_BUMP_LIMIT * height if self.over is None else min(self.over, MAX_BUMP_LIMIT * height)

    def clear(self, width: float) -> float:
        """mm around bumps, for beads `width` mm wide."""
        return DEFAULT_CLEARANCE * width if self.clearance is None else self.clearance


@dataclass(frozen=True, slots=True, eq=False)
class Bumps:
    """The bumps of one layer, in the plane, mm."""

    over: MultiPolygon  # where the bed is over the layer's middle and gone over
    around: MultiPolygon  # where it stands too high above the layer's top
    highest: float  # mm above the top, of all; 0 where there is none


@dataclass(frozen=True, slots=True)
class BumpLayer:
    """A layer that bumps may stand over."""

    height: float  # mm
    limit: float  # mm above its top up to which a bump is gone over
    level: bool  # it does not follow the bed by itself


DEFAULT_PASSING = BumpPassing()
NO_BUMPS = Bumps(MultiPolygon(), MultiPolygon(), 0.0)


def bumps_in(grid: Grid, inside: Mask, rise: Array, step: BumpLayer, slack: float) -> Bumps:
    """The bumps of a layer over whose top the bed rises by `rise` (H, W) mm.

    inside: where bumps are looked for. slack: mm, of outlines.
    """
    grid, inside, rise = _window(grid, inside, rise)
    low, peaks = _bumps(rise > -step.height / 2, inside, rise, step.limit if step.level else -np.inf)
    high, tops = _bumps(rise > step.limit, inside, rise, np.inf)
    if not len(peaks) and not len(tops):
        return NO_BUMPS
    over = _shapes(grid, low, rise + step.height / 2, slack)
    return Bumps(over, _shapes(grid, high, rise - step.limit, slack), float(np.concatenate([peaks, tops]).max()))


def _window(grid: Grid, inside: Mask, values: Array) -> tuple[Grid, Mask, Array]:
    """The part of a grid that holds all nodes inside and one more around."""
    rows, columns = (np.flatnonzero(inside.any(axis=k)) for k in (1, 0))
    top, left = max(rows[0] - 1, 0), max(columns[0] - 1, 0)
    part = slice(top, rows[-1] + 2), slice(left, columns[-1] + 2)
    inside, values = inside[part], values[part]
    return Grid(grid.step, grid.origin + grid.step * np.array([left, top]), inside.shape), inside, values


def _bumps(raised: Mask, inside: Mask, rise: Array, limit: float) -> tuple[Mask, Array]:
    """The nodes (H, W) of joined raised ones that stay in the wound and rise to `limit` at most; the peaks (K,)."""
    if not (raised & inside).any():
        return np.zeros_like(raised), np.empty(0)
    pieces, count = label(raised, EIGHT_NEIGHBOURS)
    walls = np.zeros(count + 1, bool)
    walls[pieces[~inside]] = True
    peaks = np.full(count + 1, -np.inf)
    np.maximum.at(peaks, pieces.ravel(), rise.ravel())
    chosen = (peaks <= limit) & ~walls
    chosen[0] = False  # what is not raised
    return chosen[pieces], peaks[chosen]


def _shapes(grid: Grid, own: Mask, values: Array, slack: float) -> MultiPolygon:
    """Where values (H, W) are positive at the nodes `own` and beside them."""
    if not own.any():
        return MultiPolygon()
    shape = positive_region(grid, np.where(own | (values <= 0), values, -np.abs(values)), 0.0, slack)
    shapely.prepare(shape)
    return shape


MAX_LAYERS = 400  # a wound of 40 mm in layers of 0.1 mm
MIN_BLENDED_HEIGHT = 0.6  # of a layer's height: where blended layers would be thinner, every second one is left out
MIN_REPLACED = 0.75  # of the layers that one replaces: with fewer under it, it is left to the next
BEAD_HEIGHT_RANGE = 0.2, 2.0  # of a layer's own height: what a bead on an uneven bed may have


@dataclass(frozen=True, slots=True)
class Tissue:
    """One tissue and what it is printed with."""

    name: str
    thickness: float | None  # mm; None: what the others leave of the wound's depth
    material: str  # as the path names it
    temperature: float = 20.0  # degrees C
    speed: float = 20.0  # mm/s of printing
    height: float = 0.4  # mm of a layer, about


@dataclass(frozen=True, slots=True)
class Slab:
    """One printed layer of the stack: from `low` to `high`, mm above the bottom of a stack `whole` mm high."""

    tissue: Tissue
    low: float
    high: float
    whole: float

    @property
    def middle(self) -> float:
        """mm above the bottom."""
        return (self.low + self.high) / 2


def slabs(tissues: Sequence[Tissue], whole: float) -> list[Slab]:
    """The layers of a stack `whole` mm high, bottom up, each tissue cut into equal ones near its layer height.

    A tissue without a thickness takes what the others leave: those over it then lie at their thickness under the skin.
    Where all have one, they are laid from the bottom and the last one goes on to the top. What a shallow wound has no
    room for is left out.
    """
    thicknesses = _fitted(tissues, whole)
    layers, low = [], 0.0
    for tissue, thickness in zip(tissues, thicknesses, strict=True):
        count = max(1, round(thickness / tissue.height)) if thickness > 1e-6 else 0
        for k in range(count):
            layers.append(Slab(tissue, low + thickness * k / count, low + thickness * (k + 1) / count, whole))
        low += thickness
    if len(layers) > MAX_LAYERS:
        raise InputError("plan", "layers", len(layers), f"{MAX_LAYERS} at most: thicker layers")
    return layers


def _fitted(tissues: Sequence[Tissue], whole: float) -> list[float]:
    rest = next((i for i, t in enumerate(tissues) if t.thickness is None), None)
    below, above = (tissues, []) if rest is None else (tissues[:rest], tissues[rest + 1 :])
    room, top, bottom = whole, list[float](), list[float]()
    for tissue in reversed(above):
        top.append(min(tissue.thickness or 0.0, room))
        room -= top[-1]
    for tissue in below:
        bottom.append(min(tissue.thickness or 0.0, room))
        room -= bottom[-1]
    if rest is None:
        bottom[-1] += room
        return bottom
    return [*bottom, room, *reversed(top)]


LayerMode = Literal["horizontal", "skin", "conformal"]
LAYER_MODES: tuple[LayerMode, ...] = get_args(LayerMode)


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One printed layer."""

    number: int  # from 0 at the bottom
    slab: Slab
    share: float  # of its top between the stack's lowest and highest surface
    region: MultiPolygon  # in the plane, mm; with the low bumps
    bumps: Bumps  # of the bed, that stand over it

    @property
    def height(self) -> float:
        """mm, of a bead on an even floor."""
        return self.slab.high - self.slab.low


@dataclass(frozen=True, slots=True, eq=False)
class LayerStack:
    """Layers, bottom up, and their surfaces over a grid in the plane."""

    mode: LayerMode
    grid: Grid
    lowest: Array  # (H, W) mm, heights at share 0
    highest: Array  # (H, W) mm, heights at share 1
    bed: Array  # (H, W) mm
    layers: tuple[Layer, ...]
    missing: tuple[str, ...]  # tissues that the wound has no room for

    def tops(self, xy: Array, number: Index) -> Array:
        """Heights (N,) mm of the tip over points (N, 2) in the plane in layers `number` (N,): on top of the bead.

        On a bump that is gone over the tip is so far above the bed that the thinnest bead has room.
        """
        low, high, bed = self._surfaces(xy)
        share = np.array([layer.share for layer in self.layers])[number]
        return self._lifted(number, low + share * (high - low), bed, self._crossed(xy, number))

    def _surfaces(self, xy: Array) -> tuple[Array, Array, Array]:
        """Heights (N,) of the lowest and the highest surface and of the bed."""
        low, high, bed = interpolate(self.grid, np.stack([self.lowest, self.highest, self.bed], axis=-1), xy).T
        return low, high, bed

    def _crossed(self, xy: Array, number: Index) -> Mask:
        """Which points (N, 2) lie on a bump that their layer (N,) goes over."""
        crossed = np.zeros(len(xy), bool)
        for layer in self.layers:
            if not layer.bumps.over.is_empty:
                own = np.flatnonzero(number == layer.number)
                crossed[own] = shapely.contains_xy(layer.bumps.over, *xy[own].T)
        return crossed

    def _lifted(self, number: Index, top: Array, bed: Array, crossed: Mask) -> Array:
        """Tops (N,) of layers `number` (N,), lifted over the bed where they cross a bump."""
        thinnest = BEAD_HEIGHT_RANGE[0] * np.array([layer.height for layer in self.layers])[number]
        return np.where(crossed, np.maximum(top, bed + thinnest), top)

    def bead_heights(self, xy: Array, number: Index) -> Array:
        """How high a bead of layer `number` (N,) is at points (N, 2), mm, along the plane's normal.

        Down to the layer below, or to the bed where that is not there.
        """
        low, high, bed = self._surfaces(xy)
        shares = np.array([layer.share for layer in self.layers])
        nominal = np.array([layer.height for layer in self.layers])[number]
        top = self._lifted(number, low + shares[number] * (high - low), bed, self._crossed(xy, number))
        below = self._below(number, (high - bed) / max(float(self.layers[0].slab.whole), 1e-9))
        under = np.where(below < 0, 0.0, shares[np.maximum(below, 0)])
        floor = low + under * (high - low)
        if self.mode != "conformal":
            middles = np.array([layer.slab.middle / layer.slab.whole for layer in self.layers])
            there = (below >= 0) & (low + middles[np.maximum(below, 0)] * (high - low) >= bed)
            crossed = self._crossed(xy, below)
            floor = np.where(there | crossed, self._lifted(below, floor, bed, crossed), bed)
        return np.asarray(np.clip(top - floor, BEAD_HEIGHT_RANGE[0] * nominal, BEAD_HEIGHT_RANGE[1] * nominal))

    def _below(self, number: Index, part: Array) -> Index:
        """The layer (N,) under each of layers (N,), where the wound has `part` (N,) of its greatest depth."""
        if self.mode != "conformal":
            return np.asarray(number - 1)
        # how many blended layers one replaces (N,)
        stride = 2.0 ** np.clip(np.ceil(np.log2(MIN_BLENDED_HEIGHT / np.maximum(part, 1e-9)) - 1e-9), 0, 40)
        return np.where(number + 1 < (1 + MIN_REPLACED) * stride, -1, number - stride).astype(np.int64)


def layer_stack(
    wound: WoundVolume, tissues: Sequence[Tissue], mode: LayerMode, width: float, passing: BumpPassing = DEFAULT_PASSING
) -> LayerStack:
    """The layers of a wound. width: mm of a bead: what is smaller in the bed is not followed, nor laid."""
    inside = nodes_within(wound.grid, wound.outline)
    lowest, highest = _ends(wound, inside, mode, width)
    whole = float((highest - lowest)[inside].max())
    cut = slabs(tissues, whole)
    hull = shapely.union_all([shapely.Polygon(part.exterior) for part in wound.outline.geoms])  # islands of skin too
    shapely.prepare(hull)
    hollow: Mask = shapely.contains_xy(hull, wound.grid.nodes[..., 0], wound.grid.nodes[..., 1])
    layers = []
    for k, slab in enumerate(cut):
        presence = _presence(wound, lowest, highest, cut, k, mode)
        shape = positive_region(wound.grid, presence, width**2, OUTLINE_TOLERANCE)
        height, rise = slab.high - slab.low, wound.bed - lowest - slab.high / whole * (highest - lowest)
        step = BumpLayer(height, passing.limit(height), mode != "conformal")
        bumps = bumps_in(wound.grid, hollow, rise, step, OUTLINE_TOLERANCE)
        if not bumps.over.is_empty:
            shape = shape.union(bumps.over.buffer(OUTLINE_TOLERANCE))  # not edge upon edge: that leaves threads
        shape = without_bumps(shape.intersection(wound.outline), bumps.around, passing.clear(width))
        layers.append(Layer(k, slab, slab.high / whole, as_multi(shape, width**2), bumps))
    if all(layer.region.is_empty for layer in layers):
        raise InputError("plan", "layers", "none with room for a bead", f"a wound wider than {width:g} mm, finer beads")
    missing = tuple(t.name for t in tissues if all(slab.tissue is not t for slab in cut))
    return LayerStack(mode, wound.grid, lowest, highest, wound.bed, tuple(layers), missing)


def _ends(wound: WoundVolume, inside: Mask, mode: LayerMode, width: float) -> tuple[Array, Array]:
    """The lowest and the highest surface (H, W) of the stack."""
    if mode == "horizontal":
        low, high = float(wound.bed[inside].min()), float(wound.skin[inside].max())
        return np.full(wound.grid.shape, low), np.full(wound.grid.shape, high)
    if mode == "skin":
        return wound.skin - float(wound.depth[inside].max()), wound.skin
    return np.minimum(smoothed(wound.grid, wound.bed, width / 2), wound.skin), wound.skin


def _presence(
    wound: WoundVolume, lowest: Array, highest: Array, cut: Sequence[Slab], number: int, mode: LayerMode
) -> Array:
    """Positive (H, W) where a layer is laid: by its middle, which lies over the bed and under the skin."""
    slab = cut[number]
    if mode == "conformal":
        # from a part of the greatest depth on; of the layers over it, every second, fourth ...
        above = len(cut) - 1 - number
        doubled = (above & -above).bit_length() - 1 if above else 60
        doubled = min(doubled, int(np.floor(np.log2((number + 1) / MIN_REPLACED))))
        return np.asarray(highest - lowest - float(MIN_BLENDED_HEIGHT / 2**doubled) * slab.whole)
    middle = lowest + slab.middle / slab.whole * (highest - lowest)
    return np.asarray(np.minimum(middle - wound.bed, wound.skin - middle))
