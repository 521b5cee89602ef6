"""What could contradict a pose: where else the surface looks alike, and whether its colours are where the pose says.

Aliases are the motions along its tangent plane under which its own picture looks like itself. Where a surface repeats
(a mesh, a board, a row of sutures), its tracks agree on every pose that is off by a period. The picture is the surface
seen squarely, free of shading; its masked correlation with itself (Padfield 2012) has a top at every alias. One that
repeats may also look like itself turned, by quarters: meshes and boards are square.

Hairs, a film, gauze carry more texture than the tissue under them, and tracks that follow them agree with each
other. The tissue has its colours: a wound, its rim, the edge of a cloth. Shadows and shading change all channels of a
picture by one factor, so the ratios of channels are compared with those of the first pictures. All cameras together
tell by which displacement of the tissue the difference is explained (Lucas and Kanade 1981, on the surface, in three
dimensions). Uniform skin tells nothing, nor does what a print head, ink or a highlight hides; grey cameras neither.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from estimation import se3
from estimation.observations import NOTHING_DISPLACED, DisplacedPlaces
from estimation.runtime import median
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import SurfaceMap, Warp, bells
from perception.frames import Image
from perception.lens import Lenses
from perception.mapping.masks import TrackingMasks, near_bead
from perception.mapping.patches import Pyramid

GRID_SIDE = 160  # cells of the surface's own picture along its longer side: half a millimetre on a palm
HEIGHT_NEIGHBOURS = 6  # landmarks between which the surface is interpolated
DETAIL_SIGMA_MM = 4.0  # what is coarser than that is shading, not texture: it is divided out
MIN_OVERLAP = 0.25  # of the surface with itself, below which a correlation says nothing
# Correlation of the whole surface with itself, shifted; of a part of it, more by the root of that part, as chance makes
# of fewer spots. Skin reaches 0.13 by chance.
MIN_REPEAT = 0.25
MIN_ALIAS_MM = 1.5  # nearer to itself the surface only looks smooth
RIVAL_SHARE = 0.5  # of the strongest alias' correlation: what is weaker is a mark that stands somewhere twice
MAX_ALIASES = 80  # the nearest: a mesh of 4 mm up to 20 mm
MAX_TURNED = 4  # by each quarter of a turn, the likeliest


@dataclass(frozen=True, slots=True, eq=False)
class Aliases:
    """The motions under which a surface looks like itself."""

    motions: Array  # (K, 4, 4) mm, of the surface in its own frame, nearest first
    sizes: Array  # (K,) mm, root mean square, by which its landmarks move

    def __len__(self) -> int:
        return len(self.motions)


NO_ALIASES = Aliases(np.zeros((0, 4, 4)), np.zeros(0))


class TangentPlane:
    """The surface through a map's landmarks over their mean plane."""

    def __init__(self, surface_map: SurfaceMap) -> None:
        points = surface_map.points
        self.origin = points.mean(0)
        normal = surface_map.normals.mean(0)
        self.normal = normal / np.linalg.norm(normal)
        first = np.cross(self.normal, np.eye(3)[int(np.abs(self.normal).argmin())])
        first /= np.linalg.norm(first)
        self.axes = np.stack([first, np.cross(self.normal, first)])  # (2, 3)
        self.places = (points - self.origin) @ self.axes.T  # (N, 2)
        self._heights = (points - self.origin) @ self.normal
        self._normals = surface_map.normals
        self._tree = cKDTree(self.places)
        self._hull = Delaunay(self.places[ConvexHull(self.places).vertices])

    def inside(self, places: Array) -> Mask:
        """Which places (N, 2) mm lie among the landmarks."""
        return np.asarray(self._hull.find_simplex(places) >= 0)

    def lift(self, places: Array) -> tuple[Array, Array]:
        """Points (N, 3) mm of the surface over places (N, 2), and their unit normals (N, 3)."""
        away, near = self._tree.query(places, k=min(HEIGHT_NEIGHBOURS, len(self.places)))
        weight = 1 / (away + 1.0)
        weight /= weight.sum(1, keepdims=True)
        heights = (weight * self._heights[near]).sum(1)
        normals = np.einsum("nk,nki->ni", weight, self._normals[near])
        points = self.origin + places @ self.axes + heights[:, None] * self.normal
        return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def beside(self, places: Array) -> Array:
        """How far (N,) mm places (N, 2) are from the nearest landmark."""
        return np.asarray(self._tree.query(places)[0])

    def grid(self, side: int, border: float = 0.0) -> tuple[Array, float]:
        """Places (V, U, 2) mm of a grid over the landmarks and a border, mm, round them, and its step, mm.

        side: cells along the longer side.
        """
        low, high = self.places.min(0) - border, self.places.max(0) + border
        step = float((high - low).max()) / side
        counts = np.maximum(1, np.ceil((high - low) / step)).astype(int)
        u, v = np.meshgrid(*(low[i] + step * (np.arange(counts[i]) + 0.5) for i in range(2)))
        return np.stack([u, v], -1), step


class SurfaceGrid:
    """A fine grid of places (V, U) on the surface."""

    def __init__(self, plane: TangentPlane) -> None:
        places, self.step = plane.grid(GRID_SIDE)
        flat = places.reshape(-1, 2)
        self.axes, self.points = plane.axes, plane.lift(flat)[0]  # (2, 3); (V U, 3) mm
        self.normal, self.first = plane.normal, plane.origin + flat[0] @ plane.axes  # (3,); (3,) mm, of the first cell
        self.inside = plane.inside(flat).reshape(places.shape[:2])  # among the landmarks


def surface_picture(
    lenses: Lenses, camera: int, images: Pyramid, base_from_surface: Array, grid: SurfaceGrid
) -> tuple[Array, Mask]:
    """The surface (V, U) as seen squarely, in parts of its own contrast, and where it is seen (V, U).

    Shading is taken out: each place counts by how it stands out from what is DETAIL_SIGMA_MM around it.
    """
    in_camera = se3.transform_points(lenses.rig.camera_from_base[camera] @ base_from_surface, grid.points)
    depth = np.where(in_camera[:, 2] > 1.0, in_camera[:, 2], 1.0)
    imaged, in_lens = lenses.bend(camera, in_camera[:, 0] / depth, in_camera[:, 1] / depth, in_camera[:, 2])
    across, down = imaged.astype(np.float32)
    width, height = lenses.rig.cameras[camera].size
    in_image = (across >= 0) & (across < width - 1) & (down >= 0) & (down < height - 1)
    seen = grid.inside & (in_lens & in_image).reshape(grid.inside.shape)
    levels = cv2.remap(images[0], across.reshape(seen.shape), down.reshape(seen.shape), cv2.INTER_LINEAR)
    picture = np.where(seen, levels.astype(float), 0.0)
    cells = DETAIL_SIGMA_MM / grid.step
    weight = gaussian_filter(seen.astype(float), cells) + 1e-6
    away = np.where(seen, picture - gaussian_filter(picture, cells) / weight, 0.0)
    spread = np.sqrt(gaussian_filter(away**2, cells) / weight)
    return np.where(seen, away / (spread + 1.0), 0.0), seen


def self_correlation(picture: Array, seen: Mask, quarters: int = 0) -> tuple[Array, Array]:
    """Correlation of a picture (V, U) with itself at every shift, and how much of it overlaps there, 0 to 1.

    Both (2V - 1, 2U - 1); no shift is in the middle. quarters: of a turn before it is shifted; the picture is square.

    Only what is seen (V, U) counts (Padfield 2012, Eq. 14-19); 0 where too little of it overlaps.
    """
    rows, columns = picture.shape
    shape = (next_fast_len(2 * rows - 1), next_fast_len(2 * columns - 1))
    turned, visible = np.rot90(picture, quarters), np.rot90(seen, quarters).astype(float)
    mask, first, square = (rfft2(part, shape) for part in (visible, turned, turned**2))
    own_mask, own, own_square = (rfft2(part, shape) for part in (seen.astype(float), picture, picture**2))

    def both(a: Array, b: Array) -> Array:
        whole = np.roll(irfft2(a * np.conj(b), shape), (rows - 1, columns - 1), (0, 1))
        return np.asarray(whole[: 2 * rows - 1, : 2 * columns - 1])

    overlap = np.maximum(both(mask, own_mask), 0.5)
    sum_a, sum_b = both(first, own_mask), both(mask, own)
    product = both(first, own) - sum_a * sum_b / overlap
    spread_a, spread_b = both(square, own_mask) - sum_a**2 / overlap, both(mask, own_square) - sum_b**2 / overlap
    spread = np.sqrt(np.maximum(spread_a * spread_b, 1e-12))
    share = overlap / max(float(seen.sum()), 1.0)
    sound = (spread > 1e-3 * float((picture**2).sum())) & (share > MIN_OVERLAP)
    return np.where(sound, product / spread, 0.0), share


def find_aliases(picture: Array, seen: Mask, grid: SurfaceGrid) -> Aliases:
    """The motions under which a surface's picture (V, U) looks like itself; seen: (V, U)."""
    shift, score = _tops(*self_correlation(picture, seen), grid.step)
    away = np.linalg.norm(shift, axis=1)
    rival = (away > MIN_ALIAS_MM) & (score > RIVAL_SHARE * score[away > MIN_ALIAS_MM].max(initial=0.0))
    if not rival.any():
        return NO_ALIASES
    order = np.flatnonzero(rival)[np.argsort(away[rival], kind="stable")][:MAX_ALIASES]
    motions = [se3.make(np.eye(3), along) for along in shift[order] @ grid.axes]
    # turned about the middle of a square that holds the picture
    side = max(picture.shape)
    border = [(0, side - n) for n in picture.shape]
    square, visible = np.pad(picture, border), np.pad(seen, border)
    middle = grid.first + grid.step * (side - 1) / 2 * grid.axes.sum(0)
    for quarters in (1, 2, 3):
        shift, likeness = _tops(*self_correlation(square, visible, quarters), grid.step)
        best = np.argsort(-likeness, kind="stable")[:MAX_TURNED]
        turn = se3.exp_rotation(quarters * np.pi / 2 * grid.normal)
        about = se3.make(np.eye(3), middle) @ se3.make(turn, np.zeros(3))
        for along in shift[best[likeness[best] > RIVAL_SHARE * score[rival].max()]] @ grid.axes:
            motions.append(about @ se3.make(np.eye(3), along - middle))
    points = grid.points[grid.inside.ravel()]
    sizes = np.array([np.sqrt(((se3.transform_points(m, points) - points) ** 2).sum(1).mean()) for m in motions])
    nearest = np.argsort(sizes, kind="stable")
    return Aliases(np.stack(motions)[nearest], sizes[nearest])


def _tops(likeness: Array, overlap: Array, step: float) -> tuple[Array, Array]:
    """Shifts (K, 2) mm at which a correlation (V, U) has a top that chance does not explain, and its value (K,)."""
    middle, side = np.array(likeness.shape) // 2, 2 * int(MIN_ALIAS_MM / step / 2) + 1
    top = (maximum_filter(likeness, max(3, side)) == likeness) & (likeness * np.sqrt(overlap) > MIN_REPEAT)
    top[[0, -1], :], top[:, [0, -1]] = False, False
    v, u = np.nonzero(top)
    return step * (np.stack([v, u], -1) - middle + _vertex(likeness, v, u))[:, ::-1], likeness[top]


def _vertex(likeness: Array, v: Index, u: Index) -> Array:
    """Where between the cells (K, 2) the parabolas through the tops at rows v (K,) and columns u (K,) have theirs."""
    at = likeness[v, u]
    below, above = likeness[v - 1, u], likeness[v + 1, u]
    left, right = likeness[v, u - 1], likeness[v, u + 1]
    ends = np.stack([above - below, right - left], -1) / 2
    bends = np.stack([2 * at - above - below, 2 * at - left - right], -1)
    return np.asarray(np.clip(ends / np.maximum(bends, 1e-9), -0.5, 0.5))


PLACE_STEP_MM = 2.0  # between the places that are looked at: a wound's rim is as wide
CELL_MM = 1.2  # of the surface that one value averages: noise of the pixels, and chroma that cameras subsample
BELL_MM = 7.0  # one sigma: places that move together, and as far apart
DARK_LEVELS = 8.0  # grey levels added to each channel: ratios of darker ones are noise
LIGHT_SIGMA = 0.5  # of the logarithm of a place's brightness, by which those levels change a ratio: shadows, shading
CLIPPED = 245.0  # grey level at which a channel may be clipped: a highlight
MIN_NOISE = 0.01  # one sigma of a ratio's logarithm: the first picture's own, and light that is never quite the same
FIRST_NOISE, NOISE_MEMORY_SETS = 0.03, 20.0  # of webcams, until it is learned
SHIFT_PRIOR_MM = 3.0  # one sigma: beyond a wound's rim the difference no longer grows with the displacement
MIN_SHIFT_MM = 0.6  # that is told: a bit more than the guard allows
MIN_EVIDENCE = 100.0  # squared sigmas that a displacement must explain,
MIN_EXPLAINED = 0.6  # and of all that is there beyond noise: a hand over a place looks like no displacement
MIN_SEEN_SHARE = 0.5  # of a bell's places
MIN_SECOND_SHARE = 0.1  # of what a displacement explains, that is the share of a second camera
MIN_BELLS, MIN_BELL_SHARE = 3, 0.03  # that must tell a displacement: the edge of a hand can look like one here or there
MIN_COSINE = 0.7  # of the angle between one displacement and all
USUAL_RATIO = 1.5  # times the noise, below which colours are again what they were
MIN_TOLD_MM = 0.3  # one sigma along the surface, to which colours must tell a place for it to count
WHOLE_SHARE = 0.2  # of these places: with more of them displaced nobody knows which of both is the tissue
MIN_PLACES = 20  # of a camera, to compare its picture
AROUND = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]], float)
UNSEEN_PX = -1e6  # where a place is said to be that a camera cannot see: out of every picture


@dataclass(slots=True, eq=False)
class _FirstPicture:
    """How one camera first saw P places."""

    scale: int  # pixels of the picture to one of its averages
    ratios: Array  # (2, P) logarithms, red and blue to green
    slopes: Array  # (2, P, 3) by a displacement of the surface, 1/mm, along both tangents and the normal
    squares: Array  # (2, P, 9) outer products of the slopes
    free: Mask  # (P,) places that are seen, and not clipped
    noise: Array  # (2,) one sigma


class Colours:
    """Remembers the colours of one surface, and where they stand off its texture."""

    def __init__(self, lenses: Lenses, masks: TrackingMasks) -> None:
        """masks: where the print head hides the surface."""
        self._lenses, self._masks = lenses, masks
        self._first: dict[int, _FirstPicture] = {}

    def begin(self, images: Mapping[int, Image], poses: Mapping[int, Array], surface_map: SurfaceMap) -> None:
        """Learn a surface by pictures (by camera) in which it stands at `poses` (4, 4), each camera's own."""
        self._first = {}
        try:
            plane = TangentPlane(surface_map)
        except QhullError:  # landmarks on one line
            return
        self._axes = np.stack([*plane.axes, plane.normal])
        self._points, self._centres = (_spread(plane, step) for step in (PLACE_STEP_MM, BELL_MM))
        if not len(self._points) or not len(self._centres):
            return
        self._bells = bells(self._points, self._centres, BELL_MM).T
        self._inked = np.zeros(len(self._points), bool)
        self._sizes = np.zeros(len(self._centres))  # mm, of each bell while it is displaced, the largest since; else 0
        for camera, image in images.items():
            if camera in poses and image.ndim == 3:
                self._first[camera] = self._picture(camera, image, poses[camera])

    def cover(self, bead: Array) -> None:
        """A bead (M, 3) mm, surface frame, lies on the surface: the colours there are its own from now on."""
        if self._first:
            self._inked |= near_bead(self._points, bead, np.full(len(self._points), CELL_MM))

    def __call__(
        self, images: Mapping[int, Image], poses: Mapping[int, Array], warp: Warp | None = None
    ) -> DisplacedPlaces:
        """Where colours contradict a pose: `poses` (4, 4) at each camera's exposure, of those that carry it."""
        if not self._first:
            return NOTHING_DISPLACED
        points = self._points if warp is None else warp.apply(self._points)
        sums = np.zeros((len(points), 14))  # normal equations, energy and number, of all cameras
        pulls = list[Array]()  # (K, 3) of each
        for camera, first in self._first.items():
            if camera not in images or camera not in poses:
                continue
            pixels = self._pixels(camera, poses[camera], points)
            now, dark, free = _ratios(images[camera], first.scale, pixels)
            free &= first.free & ~self._inked & ~self._masks.hides(camera, pixels)
            if np.count_nonzero(free) < MIN_PLACES:
                continue
            before = sums[:, 9:12].copy()
            for k in range(2):
                away = now[k] - first.ratios[k]
                away -= median(away[free])
                first.noise[k] += (1.4826 * median(np.abs(away[free])) - first.noise[k]) / NOISE_MEMORY_SETS
                precision = free / (max(first.noise[k], MIN_NOISE) ** 2 + (LIGHT_SIGMA * dark[k]) ** 2)
                sums[:, :9] += precision[:, None] * first.squares[k]
                sums[:, 9:12] -= (precision * away)[:, None] * first.slopes[k]
                sums[:, 12] += precision * away * away
                sums[:, 13] += free
            pulls.append(self._bells @ (sums[:, 9:12] - before))
        if not pulls:
            return NOTHING_DISPLACED
        summed = self._bells @ sums
        whole = 2 * len(pulls) * self._bells.sum(1)
        known = np.where(summed[:, 13] > MIN_SEEN_SHARE * whole, summed[:, 13], np.inf)  # else its edge looks displaced
        return self._judge(summed[:, :9].reshape(-1, 3, 3), np.stack(pulls), summed[:, 12], known)

    def _judge(self, normal: Array, pulls: Array, energy: Array, known: Array) -> DisplacedPlaces:
        """By normal equations (K, 3, 3), (C, K, 3) of each camera and bell, squared sigmas and how many are usual."""
        pull = pulls.sum(0)
        shift = np.linalg.solve(normal + np.eye(3) / SHIFT_PRIOR_MM**2, pull[..., None])[..., 0]
        size, explained = np.linalg.norm(shift, axis=1), (shift * pull).sum(1)
        begins = np.isfinite(known) & (size > MIN_SHIFT_MM) & (explained > MIN_EVIDENCE)
        begins &= explained > MIN_EXPLAINED * (energy - known)
        if len(pulls) > 1:  # else it may be what one camera sees there: a print head that its first picture showed
            begins &= np.sort((pulls * shift).sum(-1), axis=0)[-2] > MIN_SECOND_SHARE * explained
        way = (explained * begins) @ shift  # what moves goes one way; highlights go theirs
        begins &= shift @ way > MIN_COSINE * size * np.linalg.norm(way)
        begins &= begins.sum() >= max(MIN_BELLS, MIN_BELL_SHARE * len(begins))
        lasts = (self._sizes > 0) & (np.isinf(known) | (energy > USUAL_RATIO * known))
        self._sizes = np.where(begins | lasts, np.maximum(self._sizes, np.where(begins, size, 0.0)), 0.0)
        apart = self._sizes > 0
        if not apart.any():
            return NOTHING_DISPLACED
        tells = np.linalg.eigvalsh(normal)[:, 1] > MIN_TOLD_MM**-2.0
        whole = int((apart & tells).sum()) > WHOLE_SHARE * int(tells.sum())
        return DisplacedPlaces(self._centres[apart], self._sizes[apart], BELL_MM, whole)

    def _picture(self, camera: int, image: Image, pose: Array) -> _FirstPicture:
        pixels = self._pixels(camera, pose, self._points)
        beside = self._pixels(camera, pose, self._points + self._axes[0])
        scale = max(1, round(CELL_MM * float(np.median(np.linalg.norm(beside - pixels, axis=1)))))
        ratios, _, free = _ratios(image, scale, pixels)
        ends = [
            _ratios(image, scale, self._pixels(camera, pose, self._points + side * axis))[0]
            for axis in self._axes
            for side in (1, -1)
        ]
        slopes = np.stack([(ends[2 * i] - ends[2 * i + 1]) / 2 for i in range(3)], -1)
        squares = (slopes[..., :, None] * slopes[..., None, :]).reshape(2, -1, 9)
        for around in 2 * scale * AROUND:  # what an average or a slope reaches must be the surface's as well
            free &= ~self._masks.hides(camera, pixels + around)
        return _FirstPicture(scale, ratios, slopes, squares, free, np.full(2, FIRST_NOISE))

    def _pixels(self, camera: int, pose: Array, points: Array) -> Array:
        """Where a camera images points (N, 3) mm of a surface at a pose (4, 4): (N, 2) px, far off for those unseen."""
        in_camera = se3.transform_points(self._lenses.rig.camera_from_base[camera] @ pose, points)
        depth = np.maximum(in_camera[:, 2], 1.0)
        imaged, seen = self._lenses.bend(camera, in_camera[:, 0] / depth, in_camera[:, 1] / depth, in_camera[:, 2])
        return np.asarray(np.where(seen, imaged, UNSEEN_PX).T)


def _spread(plane: TangentPlane, step: float) -> Array:
    """Points (N, 3) mm of a surface, among its landmarks, a step, mm, apart."""
    cells = max(1, int(np.ptp(plane.places, axis=0).max() / step))
    flat = plane.grid(cells)[0].reshape(-1, 2)
    return plane.lift(flat[plane.inside(flat)])[0]


def _ratios(image: Image, scale: int, pixels: Array) -> tuple[Array, Array, Mask]:
    """Logarithms (2, N) of red and blue to green at pixels (N, 2), averaged over `scale` of them; how fast each changes
    (2, N) with the logarithm of the brightness, where a channel is dark; and which (N,) are in view and not clipped."""
    size = np.array(image.shape[1::-1]) // scale
    low = np.clip(pixels.min(0) // scale - 2, 0, size - 1).astype(int)
    width, height = np.clip(pixels.max(0) // scale + 3, low + 1, size).astype(int) - low
    part = image[low[1] * scale : (low[1] + height) * scale, low[0] * scale : (low[0] + width) * scale]
    small = cv2.resize(part, (int(width), int(height)), interpolation=cv2.INTER_AREA)
    across, down = ((pixels + 0.5) / scale - 0.5 - low).astype(np.float32).T
    in_view = (across >= 0) & (across < width - 1) & (down >= 0) & (down < height - 1)
    levels = cv2.remap(small.astype(np.float32), across[None], down[None], cv2.INTER_LINEAR)[0]
    blue, green, red = (levels.astype(float) + DARK_LEVELS).T
    ratios = np.log(np.stack([red, blue]) / green)
    return ratios, DARK_LEVELS * (1 / green - 1 / np.stack([red, blue])), in_view & (levels.max(1) < CLIPPED)
