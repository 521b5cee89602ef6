"""The aliases of a surface: the motions in its tangent plane under which its picture matches itself.

On a periodic surface (a mesh, a board, a row of sutures) the tracks agree at every pose that is off by a period. The
picture is a frontal view of the surface without shading; its masked autocorrelation (Padfield 2012) has a peak at every
alias. A periodic surface may also match itself rotated by quarter turns: meshes and boards are square.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial import ConvexHull, Delaunay, cKDTree

from estimation import se3
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import SurfaceMap
from perception.lens import Lenses
from perception.mapping.patches import Pyramid

GRID_SIDE = 160  # cells of the surface's own picture along its longer side: half a millimetre on a palm
HEIGHT_NEIGHBOURS = 6  # landmarks between which the surface is interpolated
DETAIL_SIGMA_MM = 4.0  # coarser structure is shading, not texture: it is removed
MIN_OVERLAP = 0.25  # of the surface with itself, from which a correlation is used
# Correlation of the whole surface with itself, shifted; with less overlap it is divided by the root of the overlap, as
# chance correlation grows. Skin reaches 0.13 by chance.
MIN_REPEAT = 0.25
MIN_ALIAS_MM = 1.5  # smaller shifts only show that the surface is smooth
RIVAL_SHARE = 0.5  # of the strongest alias' correlation: a weaker one is a mark that occurs twice
MAX_ALIASES = 80  # the nearest: a mesh of 4 mm up to 20 mm
MAX_PER_QUARTER = 4  # aliases by each quarter turn, the likeliest


@dataclass(frozen=True, slots=True, eq=False)
class Aliases:
    """The motions under which a surface matches itself."""

    motions: Array  # (K, 4, 4) mm, of the surface in its own frame, nearest first
    sizes: Array  # (K,) mm, root mean square displacement of the surface

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
        distance, near = self._tree.query(places, k=min(HEIGHT_NEIGHBOURS, len(self.places)))
        weight = 1 / (distance + 1.0)
        weight /= weight.sum(1, keepdims=True)
        heights = (weight * self._heights[near]).sum(1)
        normals = np.einsum("nk,nki->ni", weight, self._normals[near])
        points = self.origin + places @ self.axes + heights[:, None] * self.normal
        return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def beside(self, places: Array) -> Array:
        """Distance (N,) mm of places (N, 2) from the nearest landmark."""
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
    """A frontal view (V, U) of the surface, normalised by its contrast, and the mask (V, U) of what is visible.

    Without shading: each value is relative to the mean within DETAIL_SIGMA_MM.
    """
    in_camera = se3.transform_points(lenses.rig.camera_from_base[camera] @ base_from_surface, grid.points)
    depth = np.where(in_camera[:, 2] > 1.0, in_camera[:, 2], 1.0)
    imaged, in_lens = lenses.bend(camera, in_camera[:, 0] / depth, in_camera[:, 1] / depth, in_camera[:, 2])
    across, down = imaged.astype(np.float32)
    width, height = lenses.rig.cameras[camera].size
    in_image = (across >= 0) & (across < width - 1) & (down >= 0) & (down < height - 1)
    visible = grid.inside & (in_lens & in_image).reshape(grid.inside.shape)
    levels = cv2.remap(images[0], across.reshape(visible.shape), down.reshape(visible.shape), cv2.INTER_LINEAR)
    picture = np.where(visible, levels.astype(float), 0.0)
    cells = DETAIL_SIGMA_MM / grid.step
    weight = gaussian_filter(visible.astype(float), cells) + 1e-6
    detail = np.where(visible, picture - gaussian_filter(picture, cells) / weight, 0.0)
    spread = np.sqrt(gaussian_filter(detail**2, cells) / weight)
    return np.where(visible, detail / (spread + 1.0), 0.0), visible


def self_correlation(picture: Array, visible: Mask, quarters: int = 0) -> tuple[Array, Array]:
    """Correlation of a picture (V, U) with itself at every shift, and the overlap there, 0 to 1.

    Both (2V - 1, 2U - 1); zero shift in the middle. quarters: turns by 90 degrees before the shift, if square.

    Masked by `visible` (V, U) (Padfield 2012, Eq. 14-19); 0 where the overlap is too small.
    """
    rows, columns = picture.shape
    shape = (next_fast_len(2 * rows - 1), next_fast_len(2 * columns - 1))
    rotated, rotated_visible = np.rot90(picture, quarters), np.rot90(visible, quarters).astype(float)
    mask, first, square = (rfft2(part, shape) for part in (rotated_visible, rotated, rotated**2))
    own_mask, own, own_square = (rfft2(part, shape) for part in (visible.astype(float), picture, picture**2))

    def both(a: Array, b: Array) -> Array:
        correlation = np.roll(irfft2(a * np.conj(b), shape), (rows - 1, columns - 1), (0, 1))
        return np.asarray(correlation[: 2 * rows - 1, : 2 * columns - 1])

    overlap = np.maximum(both(mask, own_mask), 0.5)
    sum_a, sum_b = both(first, own_mask), both(mask, own)
    product = both(first, own) - sum_a * sum_b / overlap
    spread_a, spread_b = both(square, own_mask) - sum_a**2 / overlap, both(mask, own_square) - sum_b**2 / overlap
    spread = np.sqrt(np.maximum(spread_a * spread_b, 1e-12))
    share = overlap / max(float(visible.sum()), 1.0)
    valid = (spread > 1e-3 * float((picture**2).sum())) & (share > MIN_OVERLAP)
    return np.where(valid, product / spread, 0.0), share


def find_aliases(picture: Array, visible: Mask, grid: SurfaceGrid) -> Aliases:
    """The motions under which a surface's picture (V, U) matches itself; visible: (V, U)."""
    shift, score = _peaks(*self_correlation(picture, visible), grid.step)
    distance = np.linalg.norm(shift, axis=1)
    rival = (distance > MIN_ALIAS_MM) & (score > RIVAL_SHARE * score[distance > MIN_ALIAS_MM].max(initial=0.0))
    if not rival.any():
        return NO_ALIASES
    order = np.flatnonzero(rival)[np.argsort(distance[rival], kind="stable")][:MAX_ALIASES]
    motions = [se3.make(np.eye(3), along) for along in shift[order] @ grid.axes]
    # rotated about the middle of a square that contains the picture
    side = max(picture.shape)
    border = [(0, side - n) for n in picture.shape]
    square, square_visible = np.pad(picture, border), np.pad(visible, border)
    middle = grid.first + grid.step * (side - 1) / 2 * grid.axes.sum(0)
    for quarters in (1, 2, 3):
        shift, likeness = _peaks(*self_correlation(square, square_visible, quarters), grid.step)
        best = np.argsort(-likeness, kind="stable")[:MAX_PER_QUARTER]
        turn = se3.exp_rotation(quarters * np.pi / 2 * grid.normal)
        about = se3.make(np.eye(3), middle) @ se3.make(turn, np.zeros(3))
        for along in shift[best[likeness[best] > RIVAL_SHARE * score[rival].max()]] @ grid.axes:
            motions.append(about @ se3.make(np.eye(3), along - middle))
    points = grid.points[grid.inside.ravel()]
    sizes = np.array([np.sqrt(((se3.transform_points(m, points) - points) ** 2).sum(1).mean()) for m in motions])
    nearest = np.argsort(sizes, kind="stable")
    return Aliases(np.stack(motions)[nearest], sizes[nearest])


def _peaks(likeness: Array, overlap: Array, step: float) -> tuple[Array, Array]:
    """Shifts (K, 2) mm of the significant peaks of a correlation (V, U), and their values (K,)."""
    middle, side = np.array(likeness.shape) // 2, 2 * int(MIN_ALIAS_MM / step / 2) + 1
    peak = (maximum_filter(likeness, max(3, side)) == likeness) & (likeness * np.sqrt(overlap) > MIN_REPEAT)
    peak[[0, -1], :], peak[:, [0, -1]] = False, False
    v, u = np.nonzero(peak)
    return step * (np.stack([v, u], -1) - middle + _vertex(likeness, v, u))[:, ::-1], likeness[peak]


def _vertex(likeness: Array, v: Index, u: Index) -> Array:
    """Subcell offsets (K, 2) of the peaks at rows v (K,) and columns u (K,), by parabolas."""
    value = likeness[v, u]
    below, above = likeness[v - 1, u], likeness[v + 1, u]
    left, right = likeness[v, u - 1], likeness[v, u + 1]
    ends = np.stack([above - below, right - left], -1) / 2
    bends = np.stack([2 * value - above - below, 2 * value - left - right], -1)
    return np.asarray(np.clip(ends / np.maximum(bends, 1e-9), -0.5, 0.5))
