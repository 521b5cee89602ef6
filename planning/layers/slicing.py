"""Layers between the wound's bed and the restored skin: horizontal as in the thesis (5.2), or along the surface.

All layers of a stack are mixtures of a lowest and a highest surface, so that each place in the stack is a height over
the plane, by a share from 0 to 1:

    horizontal   flat, from the deepest point of the bed to the highest of the skin
    skin         parallel to the restored skin
    conformal    the first follows the bed, the last is the restored skin, those between blend from one into the other
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import shapely
from shapely import MultiPolygon

from estimation.errors import InputError
from estimation.scan import Index
from estimation.se3 import Array
from planning.fill.region import around
from planning.layers.bumps import USUAL, Bumps, Passing, Step, bumps_in, within
from planning.layers.contour import as_multi, region
from planning.layers.grid import Grid, Mask, at, smoothed
from planning.layers.tissue import Slab, Tissue, slabs
from planning.layers.wound import SLACK, Wound, nodes_within

Mode = Literal["horizontal", "skin", "conformal"]
MODES: tuple[Mode, ...] = get_args(Mode)
THINNEST = 0.6  # of a layer's height: where blended layers would be thinner, every second one is left out
LOWEST = 0.75  # of the layers that one replaces: with fewer under it, it is left to the next
HEIGHTS = 0.2, 2.0  # of a layer's own height: what a bead on an uneven bed may have


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One printed layer. share: of its top between the stack's lowest and highest surface. region: in the plane, mm.

    number: from 0 at the bottom. bumps: what of the bed stands over it; the region holds the low ones.
    """

    number: int
    slab: Slab
    share: float
    region: MultiPolygon
    bumps: Bumps

    @property
    def height(self) -> float:
        """mm, of a bead on an even floor."""
        return self.slab.high - self.slab.low


@dataclass(frozen=True, slots=True, eq=False)
class Stack:
    """Layers, bottom up, and their surfaces over a grid in the plane.

    lowest, highest: (H, W) mm, heights at share 0 and 1. bed: (H, W) mm. missing: tissues the wound has no room for.
    """

    mode: Mode
    grid: Grid
    lowest: Array
    highest: Array
    bed: Array
    layers: tuple[Layer, ...]
    missing: tuple[str, ...]

    def tops(self, xy: Array, number: Index) -> Array:
        """Heights (N,) mm of the tip over points (N, 2) in the plane in layers `number` (N,): on top of the bead.

        On a bump that is gone over the tip is so far above the bed that the thinnest bead has room.
        """
        low, high, bed = self._surfaces(xy)
        share = np.array([layer.share for layer in self.layers])[number]
        return self._lifted(number, low + share * (high - low), bed, self._crossed(xy, number))

    def _surfaces(self, xy: Array) -> tuple[Array, Array, Array]:
        """Heights (N,) of the lowest and the highest surface and of the bed."""
        low, high, bed = at(self.grid, np.stack([self.lowest, self.highest, self.bed], axis=-1), xy).T
        return low, high, bed

    def _crossed(self, xy: Array, number: Index) -> Mask:
        """Which points (N, 2) lie on a bump that their layer (N,) goes over."""
        found = np.zeros(len(xy), bool)
        for layer in self.layers:
            if not layer.bumps.over.is_empty:
                own = np.flatnonzero(number == layer.number)
                found[own] = shapely.contains_xy(layer.bumps.over, *xy[own].T)
        return found

    def _lifted(self, number: Index, top: Array, bed: Array, crossed: Mask) -> Array:
        """Tops (N,) of layers `number` (N,), lifted over the bed where they cross a bump."""
        thinnest = HEIGHTS[0] * np.array([layer.height for layer in self.layers])[number]
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
        return np.asarray(np.clip(top - floor, HEIGHTS[0] * nominal, HEIGHTS[1] * nominal))

    def _below(self, number: Index, part: Array) -> Index:
        """The layer (N,) under each of layers (N,), where the wound has `part` (N,) of its greatest depth."""
        if self.mode != "conformal":
            return np.asarray(number - 1)
        stride = _stride(part)
        return np.where(number + 1 < (1 + LOWEST) * stride, -1, number - stride).astype(np.int64)


def stack_in(
    wound: Wound, tissues: Sequence[Tissue], mode: Mode, width: float, passing: Passing = USUAL
) -> Stack:  # fmt: skip
    """The layers of a wound. width: mm of a bead: what is smaller in the bed is not followed, nor laid.

    passing: how bumps of the bed are passed.
    """
    inside = nodes_within(wound.grid, wound.outline)
    lowest, highest = _ends(wound, inside, mode, width)
    whole = float((highest - lowest)[inside].max())
    cut = slabs(tissues, whole)
    hollow = within(wound.grid, wound.outline)
    layers = []
    for k, slab in enumerate(cut):
        shape = region(wound.grid, _presence(wound, lowest, highest, cut, k, mode), width**2, SLACK)
        height, rise = slab.high - slab.low, wound.bed - lowest - slab.high / whole * (highest - lowest)
        bumps = bumps_in(wound.grid, hollow, rise, Step(height, passing.limit(height), mode != "conformal"), SLACK)
        if not bumps.over.is_empty:
            shape = shape.union(bumps.over.buffer(SLACK))  # not edge upon edge: that leaves threads
        shape = around(shape.intersection(wound.outline), bumps.around, passing.clear(width))
        layers.append(Layer(k, slab, slab.high / whole, as_multi(shape, width**2), bumps))
    if not any(not layer.region.is_empty for layer in layers):
        raise InputError("plan", "layers", "none with room for a bead", f"a wound wider than {width:g} mm, finer beads")
    missing = tuple(t.name for t in tissues if all(slab.tissue is not t for slab in cut))
    return Stack(mode, wound.grid, lowest, highest, wound.bed, tuple(layers), missing)


def _ends(wound: Wound, inside: Mask, mode: Mode, width: float) -> tuple[Array, Array]:
    """The lowest and the highest surface (H, W) of the stack."""
    if mode == "horizontal":
        low, high = float(wound.bed[inside].min()), float(wound.skin[inside].max())
        return np.full(wound.grid.shape, low), np.full(wound.grid.shape, high)
    if mode == "skin":
        return wound.skin - float(wound.depth[inside].max()), wound.skin
    return np.minimum(smoothed(wound.grid, wound.bed, width / 2), wound.skin), wound.skin


def _presence(
    wound: Wound, lowest: Array, highest: Array, cut: Sequence[Slab], number: int, mode: Mode
) -> Array:  # fmt: skip
    """Positive (H, W) where a layer is laid: by its middle, which lies over the bed and under the skin."""
    slab = cut[number]
    if mode == "conformal":
        depth = highest - lowest
        return np.asarray(depth - _least_part(number, len(cut)) * slab.whole)
    middle = lowest + slab.middle / slab.whole * (highest - lowest)
    return np.asarray(np.minimum(middle - wound.bed, wound.skin - middle))


def _least_part(number: int, count: int) -> float:
    """From which part of the greatest depth on a blended layer is laid: of those over it, every second, fourth ..."""
    above = count - 1 - number
    doubled = (above & -above).bit_length() - 1 if above else 60
    doubled = min(doubled, int(np.floor(np.log2((number + 1) / LOWEST))))
    return float(THINNEST / 2**doubled)


def _stride(part: Array) -> Array:
    """How many blended layers one replaces, (N,), where the wound has `part` (N,) of its greatest depth."""
    return np.asarray(2.0 ** np.clip(np.ceil(np.log2(THINNEST / np.maximum(part, 1e-9)) - 1e-9), 0, 40))
