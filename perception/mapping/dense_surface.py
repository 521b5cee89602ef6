"""The surface as calibrated cameras see it at several instants: a dense relief with its standard deviation and colour.

Poses are known, so all pictures are looked at on one lattice of nodes on the surface itself, each moved along its own
normal until the pictures agree there. Where to begin is found by sweeping the lattice up and down (plane sweep,
Collins 1996, on a smooth guess), the neighbours deciding where pictures leave it open (semi-global matching,
Hirschmueller 2008). Then all pictures of all instants are fitted at once by least squares, in windows that lie on the
surface as it is so far (slanted patches, Furukawa and Ponce 2010).

Pictures are compared by brightness and by red less green in linear light. The mirror image of a white lamp adds as much
to both (dichromatic reflection, Shafer 1985), so that it is not seen in their difference: on wet flesh errors of 95 %
of the nodes fell from 0.9 to 0.2 mm. Skin is known best by its brightness. Each counts by how well all pictures agree.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import Rig
from estimation.se3 import Array, Mask
from perception.frames import Image, parallel_map
from perception.lens import Lenses
from perception.mapping.features import polygon_mask

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class ScanView:
    """One picture of the surface."""

    camera: int  # number in the rig
    instant: int  # number of the frame set
    image: Image  # (H, W, 3) BGR or (H, W)
    surface_from_camera: Array  # (4, 4) mm


@dataclass(frozen=True, slots=True, eq=False)
class DenseSurface:
    """A lattice of nodes on the surface, surface frame."""

    points: Array  # (H, W, 3) mm; rows run along y and columns along x
    normals: Array  # (H, W, 3) unit, towards the cameras
    sigma: Array  # (H, W) mm along the normal, one standard deviation
    colours: NDArray[np.uint8]  # (H, W, 3) BGR
    seen: Mask  # (C, H, W) by which cameras
    wanted: Mask  # (H, W) inside the region
    sure: Mask  # (H, W) whether the surface was found there


@dataclass(frozen=True, slots=True)
class Sweep:
    """A search up and down the normals; lengths in finest nodes."""

    width: float  # of a node
    reach: float  # up and down
    step: float  # between heights
    instants: int  # whose pictures are used: more cost time and find the same


# All lengths are in finest nodes, which are a pixel of the sharpest camera: near cameras know a surface better.
# First how deep a wound is (8 mm before cameras 400 mm away), then its walls, in windows on what was found before:
SWEEPS = (Sweep(2.0, 22.0, 1.1, 2), Sweep(1.5, 4.4, 0.55, 2), Sweep(1.0, 2.2, 0.275, 2), Sweep(1.0, 1.65, 0.275, 2))
FIT_ROUNDS = 4  # of least squares: more move the surface by less than its error
SWEEP_WINDOW, FIT_WINDOW = 1.0, 1.3  # nodes, one sigma of the windows in which pictures are compared
EVEN_WINDOW = 3.0  # nodes over which brightness and contrast are evened out: they differ by camera
MIN_CONTRAST = 3.0  # grey levels added to the local contrast, against noise of plain patches
MIN_LIKENESS = 0.1  # added to the correlation's denominator: 0 on plain patches
TRUST_POWER = 4  # of the best correlation, in a channel's weight
BENDING_COST, MAX_BENDING_COST = 0.1, 0.6  # of a slope of 1 between neighbours, and the most: a rim may be steep
MIN_VIEW_FACING = 0.15  # cosine of the viewing angle below which a camera sees too little of a node
SATURATED_GREY = 250  # pixels above are not used
PROBE = 0.14  # nodes up and down, for derivatives by height: a tenth of a pixel
MAX_STEP = 0.8  # nodes, a round's: the windows lie on the surface to so much
WIDE_WINDOW, WIDE_SHARE = 4.0, 0.02  # nodes, and weight of a wider window, which decides without texture
OUTLIER_SIGMAS = 1.5  # of the pictures' scatter, from which a picture counts by its distance only
MIN_SCATTER = 0.05  # of evened pictures: sensors are not better
HIDDEN_NODES, HIDDEN_CELL_PX = 4.0, 4  # nodes behind another part of the surface in the same cell of a picture
DIRECTION_WINDOW = 8.0  # nodes over which normals are averaged that nodes move along
MAX_JUMP = 1.1  # nodes from the median around, beyond which a height is a wrong match
# By the errors on rendered bodies, wet and dry: windows overlap, so that noise is a part of what one says; where the
# surface bends within a window by so much, it is off by as much.
NOISE_SHARE, BEND_SHARE, BEND_WINDOW = 0.16, 1.0, 1.5  # share, share, nodes
MIN_SIGMA, MAX_SIGMA = 0.014, 1.1  # nodes: of poses and lenses at best; beyond, the surface is not known
MAX_NOISE = 0.3  # nodes: a plain patch, where the surface would float
MIN_SEEN_WEIGHT = 0.2  # of all a camera's pictures: it sees the node
RIM_NODES = 3  # beside which windows would reach beyond the lattice
MIN_PART, MIN_WIDTH_NODES = 0.05, 5  # of the largest connected part, and nodes: smaller and thinner ones float
LINEAR_LIGHT = (np.arange(256) ** 2 / 255).astype(np.float32)  # displays' values are about the square root of light


@dataclass(frozen=True, slots=True, eq=False)
class _Sums:
    """Least-squares sums over all pictures for the nodes (H, W)."""

    information: Float32  # 1 / mm^2, of one independent window
    slope: Float32  # 1 / mm
    weights: Float32  # (V, H, W) of each picture


class DenseFit:
    """Fits a lattice to pictures; its time grows with their number."""

    def __init__(
        self, lenses: Lenses, views: Sequence[ScanView], progress: Callable[[float], None] = lambda share: None
    ) -> None:
        """progress: called with the share done, 0 to 1."""
        self._lenses, self._views, self._progress = lenses, tuple(views), progress
        self._node = 1.0  # mm, of a finest one
        self._levels = [parallel_map(_channels, [view.image for view in views])]
        self._levels.append([np.asarray(cv2.pyrDown(each), np.float32) for each in self._levels[-1]])
        self._bright = parallel_map(_saturation_mask, [view.image for view in views])

    def __call__(
        self, low: Array, high: Array, step: float, guess: Callable[[Array], Array], within: Mapping[int, Array]
    ) -> DenseSurface:
        """The surface over the rectangle from low (2,) to high (2,), mm, with nodes `step` mm apart.

        guess: heights (N,) at (N, 2), mm, to begin with. within: polygon (N, 2) px by camera, of the region in
        pictures of the first instant.
        """
        self._node, points, rounds = step, np.zeros((0, 0, 3)), len(SWEEPS) + FIT_ROUNDS + 1
        for number, sweep in enumerate(SWEEPS):
            points = _resample(points, low, high, sweep.width * step, guess)
            points = self._sweep(points, sweep)
            self._progress((number + 1) / rounds)
        directions = _normals(points, DIRECTION_WINDOW)
        for number in range(FIT_ROUNDS):
            sums = self._sums(points, directions)
            most = MAX_STEP * step
            off = np.clip(-sums.slope / (sums.information + 1e-6), -most, most)
            points = _remove_spikes(points + off[..., None] * directions, directions, MAX_JUMP * step)
            self._progress((len(SWEEPS) + number + 1) / rounds)
        return self._result(points, directions, within)

    # -- sweeping

    def _sweep(self, points: Array, sweep: Sweep) -> Array:
        """The points (H, W, 3) moved along their normals to the best correlation of pictures."""
        directions, level = _normals(points, DIRECTION_WINDOW / sweep.width), int(sweep.width > 1)
        reach = sweep.reach * self._node
        heights = np.arange(-sweep.reach, sweep.reach + sweep.step / 2, sweep.step) * self._node
        instants = sorted({view.instant for view in self._views})
        number = np.linspace(0, len(instants) - 1, min(sweep.instants, len(instants))).astype(int)
        chosen = {instants[i] for i in number}
        views = [n for n, view in enumerate(self._views) if view.instant in chosen]
        pairs = [(a, b) for a, b in combinations(views, 2) if self._views[a].instant == self._views[b].instant]
        seen = {n: self._facing(n, points, directions) for n in views}
        paths = {n: [self._pixels(n, points + h * directions)[0] for h in (-reach, 0, reach)] for n in views}
        count = np.stack([seen[a] * seen[b] for a, b in pairs]).sum(0) + np.float32(1e-6)

        def score(height: float) -> Float32:
            even, power = {}, {}
            for n in views:
                look = self._look(n, _parabola(paths[n], height / reach), level)
                even[n] = _normalise(look, seen[n])[0] * (seen[n] > 0)[..., None]
                power[n] = _blur(even[n] * even[n], SWEEP_WINDOW)
            total = np.zeros_like(even[views[0]])
            for a, b in pairs:
                likeness = _blur(even[a] * even[b], SWEEP_WINDOW) / (np.sqrt(power[a] * power[b]) + MIN_LIKENESS)
                total += (seen[a] * seen[b])[..., None] * np.maximum(likeness, 0)
            return np.asarray(total / count[..., None])

        scores = np.stack(parallel_map(score, heights), 2)  # (H, W, D, K)
        trust = scores.max(2, keepdims=True) ** TRUST_POWER + 1e-6
        cost = 1 - (trust * scores).sum(3) / trust.sum(3)
        best = _best_height(_semi_global(cost, sweep.step / sweep.width), heights).astype(np.float32)
        return np.asarray(points + cv2.medianBlur(best, 5)[..., None] * directions)

    # -- fitting

    def _sums(self, points: Array, directions: Array) -> _Sums:
        normals = _normals(points, 1.0)
        probe = PROBE * self._node
        up, down = points + probe * directions, points - probe * directions

        def look(n: int) -> tuple[Float32, Float32, Float32]:
            weight = self._facing(n, points, normals)
            value, above, below = (self._look(n, self._pixels(n, nodes)[0]) for nodes in (points, up, down))
            even, contrast, sums = _normalise(value, weight)
            slope = (above - below) / np.float32(2 * probe)
            slope = (slope - _blur(weight[..., None] * slope, EVEN_WINDOW) / sums) / contrast
            return even, np.asarray(slope, np.float32), weight

        looks = parallel_map(look, range(len(self._views)))
        evens, slopes, seen = (np.stack(part) for part in zip(*looks, strict=True))  # (V, H, W, K) twice, (V, H, W)
        channels = [_channel_sums(evens[..., k], slopes[..., k], seen) for k in range(evens.shape[3])]
        information, slope = (np.asarray(sum(each[i] for each in channels), np.float32) for i in (0, 1))
        return _Sums(_smooth(information), _smooth(slope), channels[0][2])

    def _result(self, points: Array, directions: Array, within: Mapping[int, Array]) -> DenseSurface:
        sums = self._sums(points, directions)
        heights = np.einsum("hwi,hwi->hw", points, directions).astype(np.float32)
        bend = _blur((heights - _blur(heights, BEND_WINDOW)) ** 2, BEND_WINDOW)
        noise = NOISE_SHARE**2 / (sums.information + 1e-6)
        sigma = np.sqrt(noise + BEND_SHARE**2 * bend + (MIN_SIGMA * self._node) ** 2)
        camera = np.array([view.camera for view in self._views])
        seen = np.stack([sums.weights[camera == c].sum(0) > MIN_SEEN_WEIGHT for c in range(len(self._lenses.rig))])
        wanted = self._wanted(points, within)
        wanted[:RIM_NODES] = wanted[-RIM_NODES:] = wanted[:, :RIM_NODES] = wanted[:, -RIM_NODES:] = False
        known = (sigma < MAX_SIGMA * self._node) & (noise < (MAX_NOISE * self._node) ** 2)
        sure = _remove_floaters(known & (seen.sum(0) >= 2) & wanted)
        colours = self._colours(points, sums.weights)
        self._progress(1.0)
        return DenseSurface(points, _normals(points, 1.0), sigma, colours, seen, wanted, sure)

    def _wanted(self, points: Array, within: Mapping[int, Array]) -> Mask:
        """Which nodes (H, W) lie inside all polygons, as the first instant's pictures show them."""
        first, wanted = min(view.instant for view in self._views), np.ones(points.shape[:2], bool)
        for n, view in enumerate(self._views):
            if view.instant == first and view.camera in within:
                size = self._lenses.rig.cameras[view.camera].size
                mask = polygon_mask(size, within[view.camera])
                u, v = self._pixels(n, points)[0]
                wanted &= cv2.remap(mask, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 0
        return wanted

    def _colours(self, points: Array, weights: Float32) -> NDArray[np.uint8]:
        total = np.zeros((*points.shape[:2], 3), np.float32)
        for n, view in enumerate(self._views):
            image = view.image if view.image.ndim == 3 else cv2.cvtColor(view.image, cv2.COLOR_GRAY2BGR)
            u, v = self._pixels(n, points)[0]
            total += weights[n][..., None] * cv2.remap(image, u, v, cv2.INTER_LINEAR)
        return np.asarray(total / (weights.sum(0) + 1e-6)[..., None], np.uint8)

    # -- pictures

    def _pixels(self, n: int, nodes: Array) -> tuple[Float32, Mask]:
        """Pixels (2, H, W) of nodes (H, W, 3) in a picture, and which lie within the lens's range (H, W)."""
        view = self._views[n]
        inner = se3.inverse(view.surface_from_camera).astype(np.float32)
        x, y, z = inner[:3, :3] @ nodes.reshape(-1, 3).T.astype(np.float32) + inner[:3, 3:]
        depth = np.maximum(z, 1e-3)
        imaged, inside = self._lenses.bend(view.camera, x / depth, y / depth, z)
        return imaged.astype(np.float32).reshape(2, *nodes.shape[:2]), inside.reshape(nodes.shape[:2])

    def _look(self, n: int, pixels: Float32, level: int = 0) -> Float32:
        """A picture's channels (H, W, K) at pixels (2, H, W)."""
        u, v = pixels * np.float32(0.5**level)
        return np.asarray(cv2.remap(self._levels[level][n], u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))

    def _facing(self, n: int, points: Array, normals: Array) -> Float32:
        """Cosine (H, W) of the angle at which a picture shows nodes; 0 where hidden, saturated or outside."""
        view = self._views[n]
        away = view.surface_from_camera[:3, 3] - points
        distance = np.sqrt((away * away).sum(2))
        facing = (away * normals).sum(2) / distance
        (u, v), inside = self._pixels(n, points)
        w, h = self._lenses.rig.cameras[view.camera].size
        inside &= (u > 2) & (v > 2) & (u < w - 3) & (v < h - 3) & (facing > MIN_VIEW_FACING)
        cells = [(np.clip(p, 0, most - 1) // HIDDEN_CELL_PX).astype(int) for p, most in ((v, h), (u, w))]
        nearest = np.full((h // HIDDEN_CELL_PX + 1, w // HIDDEN_CELL_PX + 1), np.inf)
        np.minimum.at(nearest, tuple(cells), np.where(inside, distance, np.inf))
        inside &= distance < nearest[tuple(cells)] + HIDDEN_NODES * self._node
        bright = cv2.remap(self._bright[n], u, v, cv2.INTER_LINEAR)
        return np.where(inside & (bright == 0), facing, 0).astype(np.float32)


def _channels(image: Image) -> Float32:
    """(H, W, 2): brightness, and red less green in linear light."""
    if image.ndim == 2:
        return np.dstack([image, np.zeros_like(image)]).astype(np.float32)
    difference = LINEAR_LIGHT[image[..., 2]] - LINEAR_LIGHT[image[..., 1]]
    return np.dstack([cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32), difference])


def _saturation_mask(image: Image) -> NDArray[np.uint8]:
    bright = (image if image.ndim == 2 else image.max(2)) > SATURATED_GREY
    return np.asarray(cv2.dilate(bright.astype(np.uint8), np.ones((3, 3), np.uint8)))


def _parabola(path: Sequence[Float32], part: float) -> Float32:
    """Pixels on the parabola through those at -1, 0 and 1."""
    below, middle, above = path
    return np.asarray(middle + part * (above - below) / 2 + part**2 * ((above + below) / 2 - middle), np.float32)


def _blur(values: Float32, sigma: float) -> Float32:
    return np.asarray(cv2.GaussianBlur(np.ascontiguousarray(values, np.float32), (0, 0), sigma))


def _smooth(values: Float32) -> Float32:
    return np.asarray(_blur(values, FIT_WINDOW) + WIDE_SHARE * _blur(values, WIDE_WINDOW))


def _normalise(values: Float32, weight: Float32) -> tuple[Float32, Float32, Float32]:
    """Channels (H, W, K) with local mean 0 and contrast 1; that contrast; and the local sums of weights."""
    weights = weight[..., None]
    sums = (_blur(weight, EVEN_WINDOW) + np.float32(1e-3))[..., None]
    centred = values - _blur(weights * values, EVEN_WINDOW) / sums
    contrast = np.sqrt(_blur(weights * centred * centred, EVEN_WINDOW) / sums) + np.float32(MIN_CONTRAST)
    return centred / contrast, contrast, sums


def _channel_sums(even: Float32, slope: Float32, weight: Float32) -> tuple[Float32, Float32, Float32]:
    """Information and slope (H, W) of one channel of V pictures (V, H, W), and their weights without outliers."""
    off = even - np.median(even, axis=0)
    window = _blur(weight.sum(0), FIT_WINDOW) + np.float32(1e-3)
    scatter = np.sqrt(_blur((weight * off * off).sum(0), FIT_WINDOW) / window) + np.float32(MIN_SCATTER)
    aside = np.stack([np.maximum(_blur(each, 1.0), np.float32(1e-6)) for each in np.abs(off)])
    weight = weight * np.minimum(1, OUTLIER_SIGMAS * scatter / aside) ** 2
    total = weight.sum(0) + np.float32(1e-6)
    off, slope = even - (weight * even).sum(0) / total, slope - (weight * slope).sum(0) / total
    window = _blur(total, FIT_WINDOW)
    squares = _blur((weight * off * off).sum(0), FIT_WINDOW) / window + np.float32(MIN_SCATTER**2)
    scale = 1 / (squares * window)
    return scale * (weight * slope * slope).sum(0), scale * (weight * slope * off).sum(0), weight


def _semi_global(cost: Float32, slope: float) -> Float32:
    """Costs (H, W, D) aggregated along rows and columns, both ways (semi-global matching).

    slope: between heights that differ by one step at neighbours.
    """
    heights = np.arange(cost.shape[2])
    bend = np.minimum(BENDING_COST * slope * np.abs(heights[:, None] - heights), MAX_BENDING_COST).astype(np.float32)
    total = np.zeros_like(cost)
    for axis in (0, 1):
        lines, sums = np.moveaxis(cost, axis, 0), np.moveaxis(total, axis, 0)
        for order in (range(len(lines)), range(len(lines) - 1, -1, -1)):
            last = np.zeros_like(lines[0])
            for i in order:
                last = lines[i] + (last[:, :, None] + bend).min(1) - last.min(1)[:, None]
                sums[i] += last
    return total


def _best_height(cost: Float32, heights: Array) -> Array:
    """The height (H, W) of the lowest cost (H, W, D), between steps by a parabola."""
    best = np.clip(cost.argmin(2), 1, cost.shape[2] - 2)
    row, column = np.indices(best.shape)
    a, b, c = (cost[row, column, best + k].astype(float) for k in (-1, 0, 1))
    shift = np.clip((a - c) / (2 * np.maximum(a - 2 * b + c, 1e-6)), -0.5, 0.5)
    return np.asarray(heights[best] + shift * (heights[1] - heights[0]))


def _resample(points: Array, low: Array, high: Array, step: float, guess: Callable[[Array], Array]) -> Array:
    """The lattice with nodes about `step` mm apart, by the guess where there is none yet."""
    x, y = (np.linspace(a, b, int(np.ceil((b - a) / step)) + 1) for a, b in zip(low, high, strict=True))
    if not points.size:
        flat = np.stack(np.meshgrid(x, y), -1)
        return np.dstack([flat, guess(flat.reshape(-1, 2)).reshape(flat.shape[:2])])
    h, w = points.shape[:2]
    u, v = (m.astype(np.float32) for m in np.meshgrid(np.linspace(0, w - 1, len(x)), np.linspace(0, h - 1, len(y))))
    return np.asarray(cv2.remap(points, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


def _normals(points: Array, sigma: float) -> Array:
    """Unit normals (H, W, 3) of a lattice, averaged over `sigma` nodes."""
    down, right = np.gradient(points, axis=(0, 1))
    across = np.asarray(cv2.GaussianBlur(np.cross(right, down), (0, 0), sigma))
    return np.asarray(across / np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-12))


def _remove_spikes(points: Array, directions: Array, most: float) -> Array:
    height = points[..., 2].astype(np.float32)
    off = height - cv2.medianBlur(height, 5)
    off = np.where(np.abs(off) > most, off, 0) / np.maximum(directions[..., 2], 0.3)
    return np.asarray(points - off[..., None] * directions)


def _remove_floaters(sure: Mask) -> Mask:
    """The nodes without thin parts and small unconnected parts."""
    wide = cv2.morphologyEx(
        sure.astype(np.uint8), cv2.MORPH_OPEN, np.ones((MIN_WIDTH_NODES, MIN_WIDTH_NODES), np.uint8)
    )
    count, part, stats, _ = cv2.connectedComponentsWithStats(wide, connectivity=4)
    areas = stats[1:, cv2.CC_STAT_AREA]
    kept = 1 + np.flatnonzero(areas >= MIN_PART * areas.max(initial=0)) if count > 1 else np.zeros(0, int)
    return np.asarray(np.isin(part, kept))


MIN_APART_DEG = 20.0  # between two cameras: nearer ones tell little about depth
TILTS_DEG, TURNS = (0.0, 20.0, 40.0, 60.0), 12  # places of a camera that are tried, off the normal and round it


def camera_place(surface: DenseSurface, weak: Mask, pose: Array, rig: Rig) -> tuple[Array, int, float]:
    """Where (3,) mm, base frame, another camera as far away as the others sees nodes `weak` (H, W) best; which camera
    is nearest to it, and how far apart they stand as seen from the surface, degrees.

    pose: base_from_surface (4, 4).
    """
    points = se3.transform_points(pose, surface.points[weak])
    normals = surface.normals[weak] @ pose[:3, :3].T
    middle, stands = points.mean(0), np.stack([camera.base_from_camera[:3, 3] for camera in rig.cameras])
    distance = np.linalg.norm(stands - middle, axis=1)
    looks = (stands - middle) / distance[:, None]
    tilt, turn = np.meshgrid(np.radians(TILTS_DEG), np.linspace(0, 2 * np.pi, TURNS, endpoint=False))
    candidates = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], -1).reshape(-1, 3)
    candidates = candidates @ pose[:3, :3].T
    apart = np.degrees(np.arccos(np.clip(candidates @ looks.T, -1, 1)))
    worth = np.clip(candidates @ normals.T, 0, 1).mean(1) * np.minimum(1, apart.min(1) / MIN_APART_DEG)
    best = int(worth.argmax())
    return middle + float(np.median(distance)) * candidates[best], int(apart[best].argmin()), float(apart[best].min())
