"""Healthy skin restored over a wound, from the skin around it, with its deviation; and depressions under such skin.

The skin is a base bent like the body there, and a departure from it along the base's normal: a quadric and a Gaussian
process over places on the base (universal kriging, Matheron 1969). So a limb may turn away by any angle that is seen.
With Matern's covariance of order 5/2 the surface has continuous curvature; of order 3/2 and long reach it is nearly a
thin plate. Kernel, reach and smoothing are chosen by cross-validation: discs of skin as large as the gap, as far as
there are such, are predicted from the rest (Rasmussen and Williams 2006, 5.4.2), and the deviation is scaled by how far
those predictions were off.

A depression is a disc that lies under the quadric through the ring around it, at any place and scale. A quadric is what
skin is like over some centimetres, whatever limb it is on, so the roundness of a body is none. The fits at all places
are sums over discs and rings, which are convolutions of the heights' moments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from estimation.se3 import Array, Index, Mask
from planning.layers.grid import Grid, interpolate

MAX_CELLS = 260  # that the surface is held by: means of the points in squares
MIN_CELL = 2.0  # mm, side of such a square: skin bends over centimetres
MIN_CELLS = 12  # of skin, of which a quadric can be told
REACHES = (12.0, 25.0, 50.0, 100.0)  # mm over which a departure from the quadric fades
MIDDLE_NOISE = 3e-3  # variance of a cell by itself over that of the departures, while the reach is chosen
NOISE_SHARES = (1e-4, 3e-4, 1e-3, 1e-2, 3e-2, 0.2)  # those that are tried then
MAX_BLOCK = 16.0  # mm, radius of the discs left out: larger ones leave too little around them
BLOCKS = 24  # discs left out in turn
BASE_ROUNDS = 3  # of bending the base: each takes what the last has left
MAX_CURVATURE = 1 / 15.0  # 1/mm, of the base: a finger
FLAT_CURVATURE = 1e-5  # 1/mm: a plane is a ball of 100 m
HEIGHT_ROUNDS, HEIGHT_TOLERANCE = 10, 1e-3  # of Newton's method from the plane to a surface over the base; mm
SKIN_HEIGHT_ROUNDS = 2  # of reading the skin's height over the base: it changes little where the place moves
MIN_FACING = 0.25  # cosine: where the skin turns further from the plane it has no height over it


@dataclass(frozen=True, slots=True, eq=False)
class BentBase:
    """A torus patch through the plane's origin: its principal curvatures there are those of the skin."""

    turn: Array  # (2, 2) plane's x and y from principal directions
    curvature: Array  # (2,) 1/mm along them, positive where the body is convex

    def places(self, points: Array) -> tuple[Array, Array]:
        """Arc lengths (N, 2) along the principal directions, and heights (N,) over the base, of points (N, 3), mm."""
        flat = points[:, :2] @ self.turn
        near, far = (1 / k for k in self.curvature)
        v, z = _unbent(flat[:, 1], points[:, 2], far)
        u, height = _unbent(flat[:, 0], z, near)
        return np.column_stack([u, v]), height

    def heights_over(self, flat: Array, z: Array, targets: Array) -> tuple[Array, Array, Mask]:
        """Heights (N,) over the plane at places (N, 2) of it whose points are `targets` (N,) mm over the base.

        z: (N,) to begin with. Also the points' places (N, 2) on the base, and whether there is such a point at all.
        """
        places, reachable = flat, np.ones(len(flat), bool)
        for _ in range(HEIGHT_ROUNDS):
            places, height = self.places(np.column_stack([flat, z]))
            facing = (self.places(np.column_stack([flat, z + 1e-3]))[1] - height) / 1e-3
            error = targets - height
            z = z + error / np.maximum(facing, MIN_FACING)
            reachable = (facing > MIN_FACING) & (np.abs(error) < 10 * HEIGHT_TOLERANCE)
            if np.percentile(np.abs(error), 95) < HEIGHT_TOLERANCE:  # the others have turned away
                break
        return z, places, reachable


def _unbent(x: Array, z: Array, radius: float) -> tuple[Array, Array]:
    """Arc length along a circle that touches z = 0 at 0 from below (radius > 0) or above, and height over it."""
    side = np.sign(radius)
    up = side * (z + radius)
    return radius * np.arctan2(x, up) * side, side * np.hypot(x, up) - radius


def bent_base(points: Array) -> BentBase:
    """The base that points (N, 3) of skin, mm, in a plane that nearly touches it at the origin, are bent like."""
    base = BentBase(np.eye(2), np.full(2, FLAT_CURVATURE))
    bend = np.zeros((2, 2))
    for _ in range(BASE_ROUNDS):
        places, height = base.places(points)
        flat = places @ base.turn.T
        fit = np.linalg.lstsq(_quadric(flat, 1.0), height, rcond=None)[0]
        bend = bend - np.array([[2 * fit[3], fit[4]], [fit[4], 2 * fit[5]]])
        values, axes = np.linalg.eigh(bend)
        values = np.clip(values, -MAX_CURVATURE, MAX_CURVATURE)
        values = np.where(np.abs(values) < FLAT_CURVATURE, FLAT_CURVATURE, values)
        base = BentBase(axes, values)
    return base


def _quadric(places: Array, size: float) -> Array:
    """The six terms (N, 6) of a quadric at places (N, 2), scaled by `size` mm."""
    x, y = places.T / size
    return np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])


def _matern(far: Array, reach: float, smooth: bool) -> Array:
    """Matern's correlation at distances `far`, mm: of order 5/2 where smooth, else 3/2."""
    t = far * (np.sqrt(5.0 if smooth else 3.0) / reach)
    fading = np.exp(-t)
    return np.asarray((1 + t * (1 + t / 3)) * fading if smooth else (1 + t) * fading)


@dataclass(frozen=True, slots=True)
class SkinKernel:
    """What skin departs from its quadric like."""

    smooth: bool  # Matern 5/2, else 3/2
    reach: float  # mm
    noise: float  # variance of a cell by itself, over `variance`
    variance: float  # mm^2, of the departures, as cross-validation scales them
    left_out: float  # mm, rms error of skin that was left out


USUAL_KERNEL = SkinKernel(True, 25.0, MIDDLE_NOISE, 0.5, 0.1)  # of most bodies: enough while a wound is looked for


@dataclass(frozen=True, slots=True, eq=False)
class RestoredSkin:
    """The skin over a wound, in the plane's frame."""

    base: BentBase
    kernel: SkinKernel
    cells: Array  # (N, 2) mm, places on the base
    size: float  # mm, by which places are scaled
    factor: tuple[Array, bool]  # of the cells' correlation
    drift: Array  # (6,) of the quadric
    weights: Array  # (N,) of the cells
    bound: Array  # (6, 6) covariance of the drift, over the variance
    solved: Array  # (N, 6) correlation's inverse times the quadric's terms

    def at(self, places: Array) -> Array:
        """Heights (M,) over the base at places (M, 2) on it, mm."""
        return np.asarray(self._correlation(places) @ self.weights + _quadric(places, self.size) @ self.drift)

    def covariance(self, places: Array) -> Array:
        """Covariance (M, M), mm^2, of the heights at places (M, 2)."""
        near, terms = self._correlation(places), _quadric(places, self.size)
        residual_terms = terms - near @ self.solved
        conditional = _matern(cdist(places, places), self.kernel.reach, self.kernel.smooth) - near @ cho_solve(
            self.factor, near.T
        )
        return np.asarray(self.kernel.variance * (conditional + residual_terms @ self.bound @ residual_terms.T))

    def deviation(self, places: Array) -> Array:
        """Standard deviation (M,), mm, of the heights at places (M, 2)."""
        near, terms = self._correlation(places), _quadric(places, self.size)
        residual_terms = terms - near @ self.solved
        conditional = 1 - np.einsum("mn,nm->m", near, cho_solve(self.factor, near.T))
        squares = conditional + np.einsum("mi,ij,mj->m", residual_terms, self.bound, residual_terms)
        return np.asarray(np.sqrt(self.kernel.variance * np.maximum(squares, 0)))

    def over(self, grid: Grid) -> tuple[Array, Array]:
        """Places (H, W, 2) on the base and heights (H, W) over the plane of the skin at the nodes of a grid.

        Heights are NaN where the skin has turned away from the plane.
        """
        flat = grid.nodes.reshape(-1, 2)
        z, targets, places, reachable = np.zeros(len(flat)), np.zeros(len(flat)), flat, np.ones(len(flat), bool)
        for _ in range(SKIN_HEIGHT_ROUNDS):
            z, places, reachable = self.base.heights_over(flat, z, targets)
            targets = self.at(places)
        z, places, reachable = self.base.heights_over(flat, z, targets)
        z = np.where(reachable, z, np.nan)
        return places.reshape(*grid.shape, 2), z.reshape(grid.shape)

    def _correlation(self, places: Array) -> Array:
        return _matern(cdist(places, self.cells), self.kernel.reach, self.kernel.smooth)


@dataclass(frozen=True, slots=True, eq=False)
class SkinCells:
    """Points of skin on a base, averaged in squares."""

    base: BentBase
    places: Array  # (N, 2) mm, on the base
    heights: Array  # (N,) mm over it
    weights: Array  # (N,) how many points, about 1


def restored_skin(cells: SkinCells, gap: float, kernel: SkinKernel | None = None) -> RestoredSkin:
    """The surface through cells of skin, over a gap of about `gap` mm radius.

    kernel: what skin departs like, in place of what cross-validation finds.
    """
    places, values, weights = cells.places, cells.heights, cells.weights
    size = float(np.ptp(places, axis=0).max())
    distances, terms = cdist(places, places), _quadric(places, size)
    if kernel is None:
        kernel = _validated(distances, terms, values, weights, _blocks(places, gap))
    correlation = _matern(distances, kernel.reach, kernel.smooth) + np.diag(kernel.noise / weights)
    factor = cho_factor(correlation, lower=True)
    solved = cho_solve(factor, terms)
    bound = np.linalg.inv(terms.T @ solved)
    drift = bound @ (solved.T @ values)
    mixed = cho_solve(factor, values - terms @ drift)
    return RestoredSkin(cells.base, kernel, places, size, factor, drift, mixed, bound, solved)


def _validated(distances: Array, terms: Array, values: Array, weights: Array, blocks: list[Index]) -> SkinKernel:
    """The kernel by which blocks of cells that are left out are predicted best: first its shape, then its noise."""
    scores = dict[tuple[bool, float, float], tuple[float, float]]()

    def best(choices: list[tuple[bool, float, float]]) -> tuple[bool, float, float]:
        for smooth, reach, noise in choices:
            correlation = _matern(distances, reach, smooth) + np.diag(noise / weights)
            scores[smooth, reach, noise] = _left_out(correlation, terms, values, blocks)
        return min(scores, key=lambda choice: scores[choice][0])

    smooth, reach, _ = best([(smooth, reach, MIDDLE_NOISE) for smooth in (True, False) for reach in REACHES])
    chosen = best([(smooth, reach, noise) for noise in NOISE_SHARES])
    return SkinKernel(*chosen, scores[chosen][1], scores[chosen][0])


def skin_cells(base: BentBase, points: Array) -> SkinCells:
    """Points (P, 3) mm, plane frame, averaged in squares as small as leave MAX_CELLS of them."""
    places, heights = base.places(points)
    side = MIN_CELL
    while True:
        square = np.floor(places / side).astype(np.int64)
        square -= square.min(axis=0)
        key = square[:, 0] * (int(square[:, 1].max()) + 1) + square[:, 1]
        _, number, count = np.unique(key, return_inverse=True, return_counts=True)
        if len(count) <= MAX_CELLS:
            break
        side *= max(1.05, np.sqrt(len(count) / MAX_CELLS))
    means = [np.bincount(number, values) / count for values in (*places.T, heights)]
    return SkinCells(base, np.column_stack(means[:2]), means[2], count / count.mean())


def _blocks(cells: Array, radius: float) -> list[Index]:
    """Numbers of the cells within `radius` of middles that are spread over all."""
    middles = [int(np.argmin(np.linalg.norm(cells - cells.mean(axis=0), axis=1)))]
    distances = np.linalg.norm(cells - cells[middles[0]], axis=1)
    while len(middles) < min(BLOCKS, len(cells)):
        middles.append(int(np.argmax(distances)))
        distances = np.minimum(distances, np.linalg.norm(cells - cells[middles[-1]], axis=1))
    lists = cKDTree(cells).query_ball_point(cells[middles], min(radius, MAX_BLOCK))
    return [np.array(each) for each in lists if len(each) < len(cells) / 3]


def _left_out(correlation: Array, terms: Array, values: Array, blocks: list[Index]) -> tuple[float, float]:
    """Rms error of the blocks predicted from the rest, and its square over the variance predicted for 1."""
    inverse = cho_solve(cho_factor(correlation, lower=True), np.eye(len(correlation)))
    solved = inverse @ terms
    inverse = inverse - solved @ np.linalg.solve(terms.T @ solved, solved.T)
    weights = inverse @ values
    squares, ratios, count = 0.0, 0.0, 0
    for block in blocks:
        precision = inverse[np.ix_(block, block)]
        errors = np.linalg.solve(precision, weights[block])
        squares += float(errors @ errors)
        ratios += float(errors @ precision @ errors)  # whitened by the block's predicted covariance
        count += len(block)
    return float(np.sqrt(squares / max(count, 1))), ratios / max(count, 1)


DISC_RADII = (4.0, 6.0, 9.0, 13.0, 18.0, 25.0, 34.0)  # mm
RING_GAP, RING_SCALE, RING_WIDTH = 1.5, 1.5, 6.0  # mm outside the disc, to so many radii and mm more
DISC_STEP = 1.5  # mm between nodes where they are looked for
MIN_RING_SHARE, MIN_DISC_SHARE = 0.6, 0.5  # of the ring and of the disc that must have been scanned
QUADRIC = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # powers of x and y in its terms
MIN_UNEVENNESS = 0.15  # mm, of the ring about its quadric: a smoother one is no surer


@dataclass(frozen=True, slots=True)
class Depression:
    """A disc that lies under the skin around it, in the plane of the heights."""

    middle: tuple[float, float, float]  # mm, on the quadric
    slope: tuple[float, float]  # of the quadric there
    radius: float  # mm
    depth: float  # mm, mean of the disc under the quadric, along its normal
    clarity: float  # depth over the unevenness of the ring


def depressions(
    grid: Grid, heights: Array, known: Mask, count: int
) -> tuple[Sequence[Depression], Sequence[Depression]]:
    """The clearest depressions of heights (H, W) where `known` (H, W), none in another's disc, the clearest first.

    And as many bulges, which are the depressions of the same heights turned over.
    """
    coarse = grid.coarser(max(DISC_STEP, grid.step))
    nodes = coarse.nodes.reshape(-1, 2)
    values = interpolate(grid, heights, nodes).reshape(coarse.shape)
    valid = interpolate(grid, known.astype(float), nodes).reshape(coarse.shape) > 0.99
    if not valid.any():
        return [], []
    level = float(values[valid].mean())  # sums of squares keep their digits
    values = np.where(valid, values - level, 0.0)
    by_scale = [_at_scale(coarse, values, valid, radius, level) for radius in DISC_RADII]
    hollows, bulges = (_clearest([each for scale in by_scale for each in scale[k]], count) for k in range(2))
    return hollows, bulges


def _clearest(candidates: Sequence[Depression], count: int) -> Sequence[Depression]:
    clearest = list[Depression]()
    for each in sorted(candidates, key=lambda d: -d.clarity * np.sqrt(d.radius)):
        distances = [np.hypot(each.middle[0] - c.middle[0], each.middle[1] - c.middle[1]) for c in clearest]
        if all(distance > max(c.radius, 0.7 * each.radius) for distance, c in zip(distances, clearest, strict=True)):
            clearest.append(each)
        if len(clearest) == count:
            break
    return clearest


def _at_scale(
    grid: Grid, values: Array, valid: Mask, radius: float, level: float
) -> tuple[Sequence[Depression], Sequence[Depression]]:
    """The local best discs of one radius (mm), hollow and bulging.

    values: (H, W) mm over `level`, 0 where not valid.
    """
    reach = RING_SCALE * radius + RING_WIDTH
    half = int(np.ceil(reach / grid.step))
    if 2 * half + 1 > 2 * max(grid.shape):
        return [], []
    x, y = np.meshgrid(*[np.arange(-half, half + 1) * grid.step / reach] * 2)
    radii = np.hypot(x, y) * reach
    ring, disc = ((radii >= radius + RING_GAP) & (radii <= reach)).astype(float), (radii <= radius).astype(float)
    size = tuple(next_fast_len(n + 2 * half, real=True) for n in grid.shape)

    def spectrum(field: Array) -> Array:
        return np.asarray(rfft2(field, size))

    def sums(field: Array, weight: Array) -> Array:  # (H, W) of a field's spectrum times a weight's around each node
        return np.asarray(irfft2(field * weight.conj(), size)[: grid.shape[0], : grid.shape[1]])

    known, height, square = (spectrum(np.pad(f, half)) for f in (valid.astype(float), values, values**2))
    rings = {(a, b): spectrum(ring * x**a * y**b) for a in range(5) for b in range(5 - a)}
    discs = {powers: spectrum(disc * x ** powers[0] * y ** powers[1]) for powers in QUADRIC}
    scanned = sums(known, rings[0, 0]) > MIN_RING_SHARE * ring.sum()
    scanned &= sums(known, discs[0, 0]) > MIN_DISC_SHARE * disc.sum()
    rows, columns = np.nonzero(scanned)
    if not len(rows):
        return [], []
    moments = {powers: sums(known, weight)[rows, columns] for powers, weight in rings.items()}
    normal = np.stack([np.stack([moments[a + c, b + d] for c, d in QUADRIC], axis=1) for a, b in QUADRIC], axis=1)
    right = np.stack([sums(height, rings[powers])[rows, columns] for powers in QUADRIC], axis=1)
    fit = np.linalg.solve(normal + 1e-9 * np.eye(6), right[..., None])[..., 0]
    residual = sums(square, rings[0, 0])[rows, columns] - np.einsum("ni,ni->n", fit, right)
    spread = np.sqrt(np.maximum(residual, 0) / normal[:, 0, 0])
    inside = np.stack([sums(known, discs[powers])[rows, columns] for powers in QUADRIC], axis=1)
    slope = fit[:, 1:3] / reach
    cosine = 1 / np.sqrt(1 + (slope**2).sum(axis=1))
    disc_sum = sums(height, discs[0, 0])[rows, columns]
    depth = (np.einsum("ni,ni->n", fit, inside) - disc_sum) / inside[:, 0] * cosine
    clarity = np.full(grid.shape, -np.inf)
    clarity[rows, columns] = depth / (spread * cosine + MIN_UNEVENNESS)
    across = 2 * max(1, round(radius / 2 / grid.step)) + 1

    def best(side: float) -> Sequence[Depression]:
        clear = np.where(np.isfinite(clarity), side * clarity, -np.inf)
        chosen = (clear == maximum_filter(clear, size=across)) & (clear > 0)
        return [
            Depression(
                (float(grid.x[columns[k]]), float(grid.y[rows[k]]), float(side * (fit[k, 0] + level))),
                (float(side * slope[k, 0]), float(side * slope[k, 1])),
                radius, float(side * depth[k]), float(clear[rows[k], columns[k]]),
            )
            for k in np.flatnonzero(chosen[rows, columns])
        ]  # fmt: skip

    return best(1.0), best(-1.0)
