"""Dense measurement of the surface without the needle in view: heights on a lattice, before and after printing.

Before: dense matching, as in `scan_map`, averaged over several frame sets of a breathing surface. After: a bead is a
few pixels wide and its edges have the strongest texture, which dominates the patches around (foreground fattening: a
single bead was measured twice as large). The planned bead is known, so each piece of bead is swept: pictures are
resampled on the surface before plus 0, 1/4, ... 9/4 of the planned bead; the share with the highest correlation is the
result. Then every other bead is swept again beside the steep sides of its measured neighbours. With the right shape
there is no fattening. A node that a bead hides from a camera is not used in its picture.

Both use colour where there is enough: the mirror image of a lamp lies behind the surface. In grey pictures beds were
0.03 mm too low, of 0.36 mm mean layer height, and glossy gel at 0.75 to 0.85 (docs/simulator.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import ideal_pixels
from estimation.se3 import Array
from estimation.surface_map import SurfaceHeights
from perception.frames import FrameSet, Image
from perception.lens import Lenses
from perception.mapping import scan_map
from perception.mapping.features import grey
from perception.mapping.scan_map import Picture

FIRST_WIDTHS = (2.0, 2.0, 1.0, 1.0)  # widths of a node, in its finest size, from landmarks on (scan_map.NODE_WIDTHS)
NEXT_WIDTHS = (1.0, 1.0)  # in a further view, from the surface of the first
MATCH_FLOOR = 0.03  # mm: error of the mean of any number of frame sets (scan_map)
COARSE_SHARES = np.arange(-0.25, 2.26, 0.25)  # of the planned bead
FINE_SHARES = np.arange(-0.25, 0.251, 0.125)  # about the coarse result
EVENING = 1.0  # mm over which brightness is normalised in the sweep: about a bead
MIN_SWEEP_FACING = 0.35  # cosine of the viewing angle: a bead's steep side is not visible
HIDING_STRIDE = 2  # nodes between samples of a ray: a bead is eight wide
HIDING_REACH, HIDING_HEIGHT = 3.0, 0.03  # mm beside a node within which a bead hides it, and mm by which at least
MIN_CORRELATION = 0.35  # mean correlation at the best share, from which it is used
WIDTH_VIEWS = 1  # views that give the width
# Gain over matte pictures, which lack texture on healthy dry skin; grey ones err by reflections of lamps.
GREY_LIKENESS_GAIN, GREY_VISIBLE_GAIN = 0.1, 0.05  # of grey ones in correlation, and in share of the surface shown
NEIGHBOUR_WEIGHT = 0.5  # of the pieces before and after in one piece's correlation: alone it is too short
SHARE_FLOOR = 0.05  # of the planned bead: error of the sweep with any number of frame sets
# From errors on ten beds of three layers: 0.06 where pictures correlate to 0.98, 0.15 at 0.75, 0.26 at 0.42. On other
# layers steep sides hide each other, and an error in a layer is in the next as well.
UNLIKE_VARIANCE = 0.11  # of a share, times 1 minus the mean correlation
MIN_STATION_NODES = 20  # visible nodes of a piece of bead


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceView:
    """The pictures of one instant, and the pose of the surface."""

    images: dict[int, Image]  # (H, W) grey or (H, W, 3) BGR, by camera
    base_from_surface: Array  # (4, 4) mm

    @property
    def coloured(self) -> bool:
        """Whether all pictures have colours."""
        return all(image.ndim == 3 for image in self.images.values())

    def pictures(self, by_colour: bool) -> dict[int, Picture]:
        """Each camera's picture (H, W), matte or grey."""
        return {camera: matte(image) if by_colour else grey(image) for camera, image in self.images.items()}


def view_of(frames: FrameSet, base_from_surface: Array) -> SurfaceView:
    """A frame set as a view, its pictures copied."""
    return SurfaceView({f.camera: f.image.copy() for f in frames.frames}, base_from_surface)


def matte(image: Image) -> Picture:
    """A picture (H, W, 3) BGR without reflections of lamps on a wet or glossy surface: red less half of green and blue.

    A mirrored lamp has the lamp's colour, about white, and lies behind the surface that mirrors it; the difference
    has the surface's own colour (dichromatic reflection, Shafer 1985). A picture's values are assumed to be the square
    root of the light.
    """
    light = image.astype(np.float32) ** 2 / 255
    return np.asarray(light[..., 2] - 0.5 * (light[..., 0] + light[..., 1]), np.float32)


def first_heights(points: Array, low: Array, high: Array, step: float) -> SurfaceHeights:
    """The smooth surface through landmarks (N, 3) mm, surface frame, on a lattice from `low` to `high` (2,) mm."""
    flat = scan_map.lattice_nodes(low, high, step)
    coarse = scan_map.initial_heights(points, low, high)
    heights = np.asarray(cv2.resize(coarse, flat.shape[1::-1], interpolation=cv2.INTER_CUBIC), float)
    return SurfaceHeights(low, step, heights, np.full(heights.shape, 1.0))


def dense_heights(lenses: Lenses, views: Sequence[SurfaceView], start: SurfaceHeights) -> SurfaceHeights:
    """The surface by dense matching in each view, near `start`; NaN where no two cameras see it in most of them.

    By matte pictures, unless grey ones show clearly more of it.
    """
    finest = scan_map.node_size(lenses, sorted(views[0].images), views[0].base_from_surface[:3, 3])
    steps = [max(width * finest, start.step) for width in FIRST_WIDTHS]
    results = {k: _match_heights(lenses, views[0], k, start, start.heights, steps) for k in _picture_kinds(views)}
    best_share = max(float(valid.mean()) for _, valid in results.values())
    by_colour = next(k for k, (_, valid) in results.items() if valid.mean() > best_share - GREY_VISIBLE_GAIN)
    fields, steps = [results[by_colour]], [max(width * finest, start.step) for width in NEXT_WIDTHS]
    for view in views[1:]:
        fields.append(_match_heights(lenses, view, by_colour, start, fields[-1][0], steps))
    heights, sure = np.stack([h for h, _ in fields]), np.mean([s for _, s in fields], axis=0)
    spread = np.sqrt(heights.var(axis=0) / max(len(views) - 1, 1) + MATCH_FLOOR**2)
    return replace(start, heights=np.where(sure > 0.5, np.median(heights, axis=0), np.nan), sigma=spread)


def _picture_kinds(views: Sequence[SurfaceView]) -> tuple[bool, ...]:
    """Kinds of pictures (True: matte, False: grey) to measure by, the better first."""
    return (True, False) if all(view.coloured for view in views) else (False,)


def _match_heights(
    lenses: Lenses, view: SurfaceView, by_colour: bool, field: SurfaceHeights, heights: Array, steps: Sequence[float]
) -> tuple[Array, NDArray[np.bool_]]:
    """Heights (H, W) on the lattice of `field`, matched near `heights` on ones of `steps` mm; and which are valid."""
    pictures, valid = view.pictures(by_colour), np.zeros(heights.shape, bool)
    for step in steps:
        heights, valid = _match_once(lenses, view.base_from_surface, pictures, field, heights, step)
    return heights, valid


def _match_once(
    lenses: Lenses,
    base_from_surface: Array,
    pictures: dict[int, Picture],
    field: SurfaceHeights,
    heights: Array,
    step: float,
) -> tuple[Array, NDArray[np.bool_]]:
    shape = heights.shape
    high = field.low + field.step * (np.array(shape[::-1]) - 1)
    count = np.maximum(np.rint((high - field.low) / step).astype(int) + 1, 2)
    flat = np.stack(np.meshgrid(*(np.linspace(a, b, n) for a, b, n in zip(field.low, high, count, strict=True))), -1)
    nodes = np.dstack([flat, _resample(heights, flat.shape[:2])])
    reference = scan_map.middle_camera(lenses, sorted(pictures), base_from_surface[:3, 3])
    match = scan_map.match_near(lenses, pictures, scan_map.transformed_nodes(base_from_surface, nodes), reference)
    if match is None:
        return heights, np.zeros(shape, bool)
    inner = scan_map.transformed_nodes(se3.inverse(base_from_surface), match.points)
    corrected = scan_map.corrected_heights(nodes, inner, match.sure, step).astype(float)
    return _resample(corrected, shape), _resample(match.sure.astype(float), shape) > 0.5


@dataclass(frozen=True, slots=True, eq=False)
class BeadShares:
    """The measured share of each of S pieces of bead; NaN where there is none."""

    share: Array  # (S,) of the planned
    sigma: Array  # (S,)
    alike: Array  # (S,) mean correlation of the cameras' pictures at that share
    width: float  # of beads, by the planned


def sweep_beads(
    lenses: Lenses,
    views: Sequence[SurfaceView],
    before: SurfaceHeights,
    due_at: Callable[[float], Array],
    widths: Sequence[float],
    station: NDArray[np.int64],
    joined: NDArray[np.bool_],
) -> BeadShares:
    """The share of each piece of bead by sweeping, and the width of beads.

    due_at: the planned beads (H, W) mm on the lattice of `before`, of constant volume, at a width relative to the plan.
    widths: candidates, or the known one. station: (H, W) piece of bead that a node belongs to, -1 for none.
    joined: (S - 1,) whether the next piece is of the same bead.
    """
    if not np.isfinite(before.heights).any():
        unknown = np.full(len(joined) + 1, np.nan)
        return BeadShares(unknown, unknown, unknown, widths[len(widths) // 2])
    rows, columns = (_reach(np.flatnonzero((station >= 0).any(axis=axis)), before.step) for axis in (1, 0))
    box = (slice(*rows), slice(*columns))
    station, count = station[box], len(joined) + 1
    low = before.low + before.step * np.array([columns[0], rows[0]])
    before = replace(before, low=low, heights=before.heights[box], sigma=before.sigma[box])
    ground = np.where(np.isfinite(before.heights), before.heights, np.nanmedian(before.heights))
    lattice = _SweepLattice(replace(before, heights=ground), station, joined)
    by_colour = _by_colour(lenses, lattice, views, due_at(widths[len(widths) // 2])[box])
    ground_views = [lattice.views(lenses, view, by_colour) for view in views]
    scores = [_sweep(lattice, ground_views[:WIDTH_VIEWS], due_at(w)[box])[1].mean() for w in widths[len(widths) == 1 :]]
    width = widths[0] if len(widths) == 1 else _best_width(np.array(widths), np.array(scores))
    shares, alike = _sweep(lattice, ground_views, due_at(width)[box])
    inside = station >= 0
    nodes = np.bincount(station[inside], np.isfinite(before.heights[inside]), count)
    valid = (alike.mean(axis=0) > MIN_CORRELATION) & (nodes >= MIN_STATION_NODES)
    share = np.median(shares, axis=0)
    valid &= (share > COARSE_SHARES[0]) & (share < COARSE_SHARES[-1])
    mismatch = UNLIKE_VARIANCE * np.clip(1 - alike.mean(axis=0), 0.0, 1.0)
    sigma = np.sqrt(shares.var(axis=0) / max(len(views) - 1, 1) + SHARE_FLOOR**2 + mismatch)
    return BeadShares(np.where(valid, share, np.nan), sigma, alike.mean(axis=0), width)


def _by_colour(lenses: Lenses, lattice: _SweepLattice, views: Sequence[SurfaceView], due: Array) -> bool:
    """Whether to use matte pictures: unless grey ones correlate clearly better, with beads or without."""
    alike = []
    for by_colour in _picture_kinds(views):
        ground = lattice.views(lenses, views[0], by_colour)
        alike.append(max(lattice.alike_at(ground, share * due, [share * due]).mean() for share in (0.0, 1.0)))
    return len(alike) > 1 and bool(alike[0] > alike[1] - GREY_LIKENESS_GAIN)


def _best_width(widths: Array, alike: Array) -> float:
    """The width at which pictures are most alike, by the parabola through all: a step of width is a tenth of volume."""
    bend, slope, _ = np.polyfit(widths, alike, 2)
    best = -slope / (2 * bend) if bend < 0 else widths[int(alike.argmax())]
    return float(np.clip(best, widths[0], widths[-1]))


def heights_with_beads(
    before: SurfaceHeights, due: Array, station: NDArray[np.int64], shares: BeadShares
) -> SurfaceHeights:
    """The surface after: with the measured share where a bead is planned; elsewhere as before."""
    inside = station >= 0
    share, sigma = (
        np.where(inside, values[np.maximum(station, 0)], 0.0) if len(values) else np.zeros(station.shape)
        for values in (shares.share, shares.sigma)
    )
    return replace(before, heights=before.heights + share * due, sigma=np.abs(sigma) * due)


def _reach(index: NDArray[np.int64], step: float) -> tuple[int, int]:
    """First row or column of a sweep over those of `index` and one past its last, with the margin of `EVENING`."""
    margin = int(np.ceil(3 * EVENING / step))
    return (0, 0) if not len(index) else (max(int(index[0]) - margin, 0), int(index[-1]) + margin + 1)


@dataclass(frozen=True, slots=True, eq=False)
class _VisibleNodes:
    """The nodes of a lattice, H rows of W, visible to a camera on a surface; computed once for many heights."""

    nodes: NDArray[np.bool_]  # (H, W)
    weight: NDArray[np.float32]  # (H, W) of each in its surroundings' brightness,
    total: NDArray[np.float32]  # (H, W) and of all surroundings


@dataclass(frozen=True, slots=True, eq=False)
class _GroundView:
    """Projection of the nodes of a lattice, H rows of W, on the ground and above it, into one camera's picture."""

    image: Picture
    pixels: NDArray[np.float32]  # (H, W, 2) px of the ground,
    rise: NDArray[np.float32]  # (H, W, 2) px/mm, their derivative by height above the ground
    inside: NDArray[np.bool_]  # (H, W) whether they are in the picture
    towards: Array  # (H, W, 3) unit, to the camera, surface frame

    def even(self, heights: Array, evening: float, visible: _VisibleNodes) -> NDArray[np.float32]:
        """Grey levels (H, W) at `heights` (H, W) mm above the ground, normalised over `evening` nodes; about 0."""
        where = self.pixels + heights[..., None].astype(np.float32) * self.rise
        grey = np.asarray(cv2.remap(self.image, where[..., 0], where[..., 1], cv2.INTER_CUBIC), np.float32)
        centred = grey - cv2.GaussianBlur(visible.weight * grey, (0, 0), evening) / visible.total
        spread = np.sqrt(cv2.GaussianBlur(visible.weight * centred * centred, (0, 0), evening) / visible.total)
        return np.asarray(scan_map.EVENED_CONTRAST * centred / (spread + 2.0), np.float32)

    def visible_nodes(self, surface: Array, step: float, evening: float) -> _VisibleNodes:
        """The nodes that the camera sees of a surface (H, W) mm, whose nodes are `step` mm apart; evening: nodes."""
        down, right = np.gradient(surface, step)
        x, y, z = np.moveaxis(self.towards, -1, 0)
        facing = z - right * x - down * y > MIN_SWEEP_FACING * np.sqrt(1 + down**2 + right**2)
        nodes = self.inside & facing & self.in_line_of_sight(surface, step)
        weight = nodes.astype(np.float32) + 1e-3
        return _VisibleNodes(nodes, weight, np.asarray(cv2.GaussianBlur(weight, (0, 0), evening), np.float32))

    def in_line_of_sight(self, surface: Array, step: float) -> NDArray[np.bool_]:
        """Nodes (H, W) that no part of the surface (H, W) mm hides from the camera; step: mm, of nodes."""
        x, y, z = self.towards.mean(axis=(0, 1))
        horizontal = max(float(np.hypot(x, y)), 1e-6)
        rise, heights = step * max(z, 1e-6) / horizontal, surface.astype(np.float32)  # mm, of a ray from node to node
        clear = np.ones(surface.shape, bool)
        for k in range(1, min(int(np.ptp(surface) / rise), int(HIDING_REACH / step)) + 1, HIDING_STRIDE):
            shift = np.array([[1, 0, k * x / horizontal], [0, 1, k * y / horizontal]])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            nearer = cv2.warpAffine(heights, shift, heights.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
            clear &= nearer < heights + k * rise + HIDING_HEIGHT
        return clear


@dataclass(frozen=True, slots=True, eq=False)
class _SweepLattice:
    """The lattice of a sweep, and the nodes (N,) on it that belong to one of S pieces of bead."""

    ground: SurfaceHeights  # without holes
    station: NDArray[np.int64]  # (H, W)
    joined: NDArray[np.bool_]  # (S - 1,) whether the next piece is of the same bead

    def views(self, lenses: Lenses, view: SurfaceView, by_colour: bool) -> dict[int, _GroundView]:
        """Each camera's view of the ground, in matte pictures or grey ones."""
        ground_views = {}
        for camera, image in view.pictures(by_colour).items():
            lens, shape, where = lenses.rig.cameras[camera], self.station.shape, []
            for height in (0.0, 1.0):
                nodes = np.dstack([self.ground.nodes, self.ground.heights + height]).reshape(-1, 3)
                ideal, depth = ideal_pixels(lens, se3.transform_points(view.base_from_surface, nodes))
                pixels, in_lens = lenses.image(camera, ideal, depth)
                where.append(pixels.reshape(*shape, 2))
            inside = in_lens & ((pixels > 1) & (pixels < np.array(lens.size) - 2)).all(1)
            eye = (se3.inverse(view.base_from_surface) @ lens.base_from_camera)[:3, 3]
            towards = (eye - nodes).reshape(*shape, 3)
            towards /= np.linalg.norm(towards, axis=2, keepdims=True)
            ground, rise = where[0].astype(np.float32), (where[1] - where[0]).astype(np.float32)
            ground_views[camera] = _GroundView(image, ground, rise, inside.reshape(shape), towards)
        return ground_views

    def alike_at(self, views: dict[int, _GroundView], about: Array, candidates: Sequence[Array]) -> Array:
        """Mean correlations (K, S) at K `candidates` (H, W) mm, over the nodes visible at heights `about` (H, W) mm."""
        surface, step = self.ground.heights + about, self.ground.step
        visible = {camera: view.visible_nodes(surface, step, EVENING / step) for camera, view in views.items()}
        return np.stack([self._alike(views, visible, heights) for heights in candidates])

    def _alike(self, views: dict[int, _GroundView], visible: dict[int, _VisibleNodes], heights: Array) -> Array:
        """Mean correlation (S,) of the cameras' pictures, at `heights` (H, W) above the ground, over each piece."""
        inside, evening = self.station >= 0, EVENING / self.ground.step
        number, grey, masks = self.station[inside], {}, {}
        for camera, view in views.items():
            grey[camera] = view.even(heights, evening, visible[camera])[inside].astype(float)
            masks[camera] = visible[camera].nodes[inside]
        total, pairs = np.zeros(len(self.joined) + 1), np.zeros(len(self.joined) + 1)
        for pair in combinations(sorted(grey), 2):
            both = np.logical_and(*(masks[c] for c in pair)).astype(float)
            many = self._piece_sums(number, both)
            means = [self._piece_sums(number, both * grey[c]) / np.maximum(many, 1) for c in pair]
            a, b = (both * (grey[c] - mean[number]) for c, mean in zip(pair, means, strict=True))
            strength = self._piece_sums(number, a * a) * self._piece_sums(number, b * b)
            enough = many >= MIN_STATION_NODES
            total += np.where(enough, self._piece_sums(number, a * b), 0.0) / np.sqrt(strength + 1)
            pairs += enough
        return total / np.maximum(pairs, 1)

    def spread(self, values: Array) -> Array:
        """Values (S,) of pieces on their nodes (H, W), 0 elsewhere."""
        return np.where(self.station >= 0, values[np.maximum(self.station, 0)], 0.0)

    def _piece_sums(self, number: NDArray[np.int64], values: Array) -> Array:
        """Sums (S,) of values (N,) over the nodes of each piece, plus weighted sums of the pieces before and after."""
        sums = np.bincount(number, values, len(self.joined) + 1)
        weight = NEIGHBOUR_WEIGHT * self.joined
        sums[1:], sums[:-1] = sums[1:] + weight * sums[:-1], sums[:-1] + weight * sums[1:]
        return np.asarray(sums)


def _sweep(lattice: _SweepLattice, views: Sequence[dict[int, _GroundView]], due: Array) -> tuple[Array, Array]:
    """Share (V, S) of each piece of a planned bead with the highest correlation in each view, and its value."""
    first = _coarse(lattice, views, due, np.ones(len(lattice.joined) + 1), np.ones(len(lattice.joined) + 1, bool))
    bead = np.concatenate([[0], np.cumsum(~lattice.joined)])
    for parity in (0, 1):
        first = _coarse(lattice, views, due, first, bead % 2 == parity)
    candidates = [lattice.spread(first + change) * due for change in FINE_SHARES]
    fine = [np.concatenate([lattice.alike_at(view, heights, [heights]) for heights in candidates]) for view in views]
    change, alike = (np.stack(part) for part in zip(*(_peak(each, FINE_SHARES) for each in fine), strict=True))
    return first + change, alike


def _coarse(
    lattice: _SweepLattice, views: Sequence[dict[int, _GroundView]], due: Array, shares: Array, mask: NDArray[np.bool_]
) -> Array:
    """Shares (S,) with the highest correlation, for pieces in `mask` (S,), while others keep `shares` (S,).

    Visibility is computed once, by `shares`: three times as fast, and sufficient before the fine sweep.
    """
    about = lattice.spread(shares) * due
    candidates = [lattice.spread(np.where(mask, share, shares)) * due for share in COARSE_SHARES]
    alike = np.mean([lattice.alike_at(view, about, candidates) for view in views], axis=0)
    return np.where(mask, _peak(alike, COARSE_SHARES)[0], shares)


def _peak(alike: Array, shares: Array) -> tuple[Array, Array]:
    """Share (S,) at which correlations (K, S) are largest, by a parabola through the three about it; and that value."""
    top = np.clip(alike.argmax(axis=0), 1, len(shares) - 2)
    each, step = np.arange(alike.shape[1]), shares[1] - shares[0]
    low, middle, high = (alike[top + k, each] for k in (-1, 0, 1))
    bend = low - 2 * middle + high
    shift = np.where(bend < 0, 0.5 * (low - high) / np.where(bend < 0, bend, -1.0), 0.0)
    return shares[top] + step * np.clip(shift, -1.0, 1.0), np.maximum(np.maximum(low, middle), high)


def _resample(values: Array, shape: tuple[int, ...]) -> Array:
    """Values (H, W) on a lattice of the same rectangle with another number of nodes."""
    rows, columns = (np.linspace(0, n - 1, m).astype(np.float32) for n, m in zip(values.shape, shape, strict=True))
    u, v = np.meshgrid(columns, rows)
    resampled = cv2.remap(values.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(resampled, float)
