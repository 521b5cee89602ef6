"""The surface measured densely where the needle stands aside: heights on a lattice, before anything is laid and after.

Before: dense matching, as `scan_map` does it, from several frame sets of a surface that breathes, whose mean is taken.
After: a bead is a few pixels wide and its edges have the strongest texture, which patches take for that of all around
(foreground fattening: a single bead was measured twice as large). What is planned there is known, though. So each piece
of bead is swept: the pictures are laid on the surface before plus 0, 1/4, ... 9/4 of the planned bead, and the share at
which they look most alike is how much lies there. Where the shape is right, a patch has nothing to fatten.

On matt gel, seen 9 pixels wide, this was measured right to 5 %; on glossy gel it lies low, as a mirrored lamp stands
behind the surface that mirrors it (docs/looks.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.se3 import Array
from estimation.surface_map import SurfaceHeights
from perception.frames import FrameSet, Image
from perception.lens import Lenses
from perception.mapping import scan_map

FIRST_WIDTHS = (2.0, 2.0, 1.0, 1.0)  # widths of a node, in its finest size, from landmarks on (scan_map.NODE_WIDTHS)
NEXT_WIDTHS = (1.0, 1.0)  # in a further view, from the surface of the first
MATCH_FLOOR = 0.03  # mm: what the mean of any number of frame sets is off by (scan_map)
COARSE_SHARES = np.arange(-0.25, 2.26, 0.25)  # of the planned bead
FINE_SHARES = np.arange(-0.25, 0.251, 0.125)  # about what the coarse sweep found
EVENING = 1.0  # mm over which brightness is evened out in the sweep: about a bead
MIN_SWEEP_FACING = 0.35  # cosine of the viewing angle: a bead's steep side hides itself
MIN_ALIKE = 0.35  # mean correlation at the best share below which nothing is said
WIDTH_VIEWS = 1  # views by which the width is found
AS_ALIKE = 0.02  # of the correlation: of widths as good as the best the narrowest is taken, as a pixel blurs outwards
COARSE_VIEWS = 2  # views by which the coarse sweep is made: one alone may have a lamp's image on the bead
BESIDE_WEIGHT = 0.5  # of the pieces before and after in one piece's correlation: alone it is too short to be sure
SHARE_FLOOR = 0.05  # of the planned bead: what the sweep is off by however many frame sets there are
MIN_STATION_NODES = 20  # nodes of a piece of bead that are seen


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceView:
    """The pictures of one instant, and where the surface was."""

    images: dict[int, Image]  # grey, by camera
    base_from_surface: Array  # (4, 4) mm


def view_of(frames: FrameSet, base_from_surface: Array) -> SurfaceView:
    """A frame set as a view."""
    grey = {
        f.camera: f.image if f.image.ndim == 2 else cv2.cvtColor(f.image, cv2.COLOR_BGR2GRAY) for f in frames.frames
    }
    return SurfaceView({camera: np.asarray(image) for camera, image in grey.items()}, base_from_surface)


def first_heights(points: Array, low: Array, high: Array, step: float) -> SurfaceHeights:
    """The smooth surface through landmarks (N, 3) mm, surface frame, on a lattice from `low` to `high` (2,) mm."""
    flat = scan_map.lattice_nodes(low, high, step)
    coarse = scan_map.initial_heights(points, low, high)
    heights = np.asarray(cv2.resize(coarse, flat.shape[1::-1], interpolation=cv2.INTER_CUBIC), float)
    return SurfaceHeights(low, step, heights, np.full(heights.shape, 1.0))


def dense_heights(lenses: Lenses, views: Sequence[SurfaceView], start: SurfaceHeights) -> SurfaceHeights:
    """The surface by dense matching in each view, near `start`; NaN where no two cameras see it in most of them."""
    finest = scan_map.node_size(lenses, sorted(views[0].images), views[0].base_from_surface[:3, 3])
    heights, seen, found = start.heights, np.zeros(start.heights.shape, bool), list[tuple[Array, NDArray[np.bool_]]]()
    for view in views:
        for width in NEXT_WIDTHS if found else FIRST_WIDTHS:
            heights, seen = _matched_heights(lenses, view, start, heights, max(width * finest, start.step))
        found.append((heights, seen))
    each, sure = np.stack([h for h, _ in found]), np.mean([s for _, s in found], axis=0)
    spread = np.sqrt(each.var(axis=0) / max(len(views) - 1, 1) + MATCH_FLOOR**2)
    return replace(start, heights=np.where(sure > 0.5, np.median(each, axis=0), np.nan), sigma=spread)


def _matched_heights(
    lenses: Lenses, view: SurfaceView, field: SurfaceHeights, heights: Array, step: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Heights (H, W) on the lattice of `field`, matched near `heights` on one of `step` mm, and where they are sure."""
    shape = heights.shape
    high = field.low + field.step * (np.array(shape[::-1]) - 1)
    count = np.maximum(np.rint((high - field.low) / step).astype(int) + 1, 2)
    flat = np.stack(np.meshgrid(*(np.linspace(a, b, n) for a, b, n in zip(field.low, high, count, strict=True))), -1)
    nodes = np.dstack([flat, _resampled(heights, flat.shape[:2])])
    reference = scan_map.middle_camera(lenses, sorted(view.images), view.base_from_surface[:3, 3])
    match = scan_map.match_near(
        lenses, view.images, scan_map.transformed_nodes(view.base_from_surface, nodes), reference
    )
    if match is None:
        return heights, np.zeros(shape, bool)
    inner = scan_map.transformed_nodes(se3.inverse(view.base_from_surface), match.points)
    corrected = scan_map.corrected_heights(nodes, inner, match.sure, step).astype(float)
    return _resampled(corrected, shape), _resampled(match.sure.astype(float), shape) > 0.5


@dataclass(frozen=True, slots=True, eq=False)
class BeadShares:
    """How much of each of S pieces of bead lies there; NaN where it could not be told."""

    share: Array  # (S,) of the planned
    sigma: Array  # (S,)
    alike: Array  # (S,) mean correlation of the cameras' pictures at that share
    width: int  # which of the widths that were tried fits


def sweep_beads(
    lenses: Lenses,
    views: Sequence[SurfaceView],
    before: SurfaceHeights,
    dues: Sequence[Array],
    station: NDArray[np.int64],
    joined: NDArray[np.bool_],
) -> BeadShares:
    """The share of each piece of bead by sweeping, and how wide beads are.

    dues: (H, W) mm each, the planned beads on the lattice of `before`, of one volume and rising widths. station: (H, W)
    piece of bead that a node belongs to, -1 for none. joined: (S - 1,) whether the next piece is of the same bead.
    """
    count = len(joined) + 1
    ground = np.where(np.isfinite(before.heights), before.heights, np.nanmedian(before.heights))
    lattice = _SweepLattice(lenses, before, ground, station, joined)
    tried = np.array([_swept(lattice, views[:WIDTH_VIEWS], due)[1].mean() for due in dues]) if len(dues) > 1 else None
    width = 0 if tried is None else int(np.flatnonzero(tried >= tried.max() - AS_ALIKE)[0])
    shares, alike = _swept(lattice, views, dues[width])
    inside = station >= 0
    nodes = np.bincount(station[inside], np.isfinite(before.heights[inside]), count)
    known = (alike.mean(axis=0) > MIN_ALIKE) & (nodes >= MIN_STATION_NODES)
    share = np.median(shares, axis=0)
    known &= (share > COARSE_SHARES[0]) & (share < COARSE_SHARES[-1])
    sigma = np.sqrt(shares.var(axis=0) / max(len(views) - 1, 1) + SHARE_FLOOR**2)
    return BeadShares(np.where(known, share, np.nan), sigma, alike.mean(axis=0), width)


def heights_with_beads(
    before: SurfaceHeights, due: Array, station: NDArray[np.int64], swept: BeadShares
) -> SurfaceHeights:
    """The surface after: where a bead is planned, what was found of it; elsewhere as before, as nothing was due."""
    inside = station >= 0
    share, sigma = (
        np.where(inside, values[np.maximum(station, 0)], 0.0) if len(values) else np.zeros(station.shape)
        for values in (swept.share, swept.sigma)
    )
    return replace(before, heights=before.heights + share * due, sigma=np.abs(sigma) * due)


@dataclass(frozen=True, slots=True, eq=False)
class _SweepLattice:
    """The lattice of a sweep, and the nodes (N,) on it that belong to one of S pieces of bead."""

    lenses: Lenses
    before: SurfaceHeights
    ground: Array  # (H, W) mm, without holes
    station: NDArray[np.int64]  # (H, W)
    joined: NDArray[np.bool_]  # (S - 1,) whether the next piece is of the same bead

    def alike(self, view: SurfaceView, heights: Array) -> Array:
        """Mean correlation (S,) of the cameras' pictures, laid on `heights` (H, W), over each piece of bead."""
        nodes = scan_map.transformed_nodes(view.base_from_surface, np.dstack([self.before.nodes, heights]))
        normals, inside = scan_map.lattice_normals(nodes), self.station >= 0
        number, evening = self.station[inside], EVENING / self.before.step
        grey, visible = {}, {}
        for camera, image in view.images.items():
            towards = self.lenses.rig.cameras[camera].base_from_camera[:3, 3] - nodes
            facing = np.einsum("hwi,hwi->hw", towards, normals) / np.linalg.norm(towards, axis=2)
            laid = scan_map.lattice_image(self.lenses, camera, image, nodes, normals, evening)
            grey[camera] = laid.even.astype(float)[inside] - 128
            visible[camera] = (laid.visible & (facing > MIN_SWEEP_FACING))[inside]
        total, pairs = np.zeros(len(self.joined) + 1), np.zeros(len(self.joined) + 1)
        for pair in combinations(sorted(grey), 2):
            both = np.logical_and(*(visible[c] for c in pair)).astype(float)
            seen = self._summed(number, both)
            means = [self._summed(number, both * grey[c]) / np.maximum(seen, 1) for c in pair]
            a, b = (both * (grey[c] - mean[number]) for c, mean in zip(pair, means, strict=True))
            strength = self._summed(number, a * a) * self._summed(number, b * b)
            enough = seen >= MIN_STATION_NODES
            total += np.where(enough, self._summed(number, a * b), 0.0) / np.sqrt(strength + 1)
            pairs += enough
        return total / np.maximum(pairs, 1)

    def _summed(self, number: NDArray[np.int64], values: Array) -> Array:
        """Sums (S,) of values (N,) over the nodes of each piece, and with less weight of those before and after it."""
        own = np.bincount(number, values, len(self.joined) + 1)
        beside = BESIDE_WEIGHT * self.joined
        own[1:], own[:-1] = own[1:] + beside * own[:-1], own[:-1] + beside * own[1:]
        return np.asarray(own)


def _swept(lattice: _SweepLattice, views: Sequence[SurfaceView], due: Array) -> tuple[Array, Array]:
    """Share (V, S) of each piece of a planned bead at which each view's pictures are most alike, and how much so."""
    inside = lattice.station >= 0
    coarse = [lattice.alike(v, lattice.ground + s * due) for v in views[:COARSE_VIEWS] for s in COARSE_SHARES]
    first, _ = _peak(np.stack(coarse).reshape(-1, len(COARSE_SHARES), len(coarse[0])).mean(axis=0), COARSE_SHARES)
    own = lattice.ground + np.where(inside, first[np.maximum(lattice.station, 0)], 0.0) * due
    fine = (_peak(np.stack([lattice.alike(v, own + s * due) for s in FINE_SHARES]), FINE_SHARES) for v in views)
    change, alike = (np.stack(part) for part in zip(*fine, strict=True))
    return first + change, alike


def _peak(alike: Array, shares: Array) -> tuple[Array, Array]:
    """Share (S,) at which correlations (K, S) are largest, by a parabola through the three about it; and that value."""
    top = np.clip(alike.argmax(axis=0), 1, len(shares) - 2)
    each, step = np.arange(alike.shape[1]), shares[1] - shares[0]
    low, middle, high = (alike[top + k, each] for k in (-1, 0, 1))
    bend = low - 2 * middle + high
    shift = np.where(bend < 0, 0.5 * (low - high) / np.where(bend < 0, bend, -1.0), 0.0)
    return shares[top] + step * np.clip(shift, -1.0, 1.0), np.maximum(np.maximum(low, middle), high)


def _resampled(values: Array, shape: tuple[int, ...]) -> Array:
    """Values (H, W) on a lattice of the same rectangle with another number of nodes."""
    rows, columns = (np.linspace(0, n - 1, m).astype(np.float32) for n, m in zip(values.shape, shape, strict=True))
    u, v = np.meshgrid(columns, rows)
    laid = cv2.remap(values.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(laid, float)
