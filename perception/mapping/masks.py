"""Masks of the print head, fresh ink and highlights, which are not tracked; and displacement of the tissue by colour.

Hairs, a film or gauze have more texture than the tissue under them, and tracks that follow them are consistent. The
tissue has its own colours: a wound, its rim, the edge of a cloth. Shadows and shading change all channels of a picture
by one factor, so ratios of channels are compared with those of the first pictures. All cameras together give the
displacement of the tissue that explains the difference (Lucas and Kanade 1981, on the surface, in three dimensions).
Uniform skin, grey cameras, and what a print head, ink or a highlight hides give no information.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import QhullError, cKDTree

from estimation import se3
from estimation.observations import NO_DISPLACED_PLACES, DisplacedPlaces
from estimation.online.fit import solve_symmetric3
from estimation.runtime import compiled, contiguous
from estimation.se3 import Array, Mask
from estimation.surface_map import SurfaceMap, Warp, bells
from perception.frames import SYRINGE, Image, PrintHead, check_profile
from perception.lens import Lenses, bend_one
from perception.mapping.aliases import TangentPlane
from perception.mapping.alignment_kernels import PATCH_RADIUS, median_of
from perception.mapping.features import ImageMask

BEAD_REACH_MM = 1.0  # mm from the bead's centre line: half a wide bead, which spreads
BEAD_STEP_MM = 0.5  # mm between the points of a bead
GEL_TIME_S = 60.0  # s; gelled ink may carry landmarks of its own


class Ink:
    """The beads printed so far, surface frame."""

    def __init__(self) -> None:
        self._points: list[Array] = []
        self._stamps: list[float] = []
        self._tip: Array | None = None

    def __len__(self) -> int:
        return len(self._points)

    def lift(self) -> None:
        """End the bead."""
        self._tip = None

    def lay(self, stamp: float, tip: Array) -> Array:
        """Extend the bead to the tip (3,) mm at `stamp`, s; gives the new points (M, 3)."""
        start = tip if self._tip is None else self._tip
        pieces = max(1, int(np.ceil(float(np.linalg.norm(tip - start)) / BEAD_STEP_MM)))
        new = start + (tip - start) * (np.arange(1, pieces + 1) / pieces)[:, None]
        self._points.extend(new)
        self._stamps.extend([stamp] * pieces)
        self._tip = tip.copy()
        return new

    def covers(self, points: Array, reach: Array, stamp: float) -> NDArray[np.bool_]:
        """Which points (N, 3) mm lie within their reach (N,) mm of ink that is still fresh at `stamp`, s."""
        fresh = np.searchsorted(self._stamps, stamp - GEL_TIME_S)
        if fresh == len(self._points):
            return np.zeros(len(points), bool)
        distance, _ = cKDTree(np.array(self._points[fresh:])).query(points)
        return np.asarray(distance < BEAD_REACH_MM + reach)


def near_bead(points: Array, bead: Array, reach: Array) -> NDArray[np.bool_]:
    """Which points (N, 3) lie within BEAD_REACH_MM and their own reach (N,) of a bead's points (M, 3), all mm."""
    return np.asarray(np.linalg.norm(points[:, None] - bead, axis=2).min(1) < BEAD_REACH_MM + reach)


RING_ANGLES = np.linspace(0, 2 * np.pi, 13)[:-1]
MIN_DEPTH_MM = 20.0  # mm from a lens: nearer points are not drawn, as their projection is unbounded


@dataclass(frozen=True, slots=True, eq=False)
class Tool:
    """The print head's shape, of revolution about the nozzle's z."""

    profile: Array  # (K, 2) mm, K > 1: height above the tip, rising, and radius there

    def __post_init__(self) -> None:
        check_profile("tool", "profile", self.profile)

    def silhouette(self, lenses: Lenses, camera: int, base_from_nozzle: Array, margin: float) -> list[Array]:
        """Convex polygons (M, 2) px, as imaged, that together cover the tool's picture; margin: mm around it.

        base_from_nozzle: (4, 4), z from the tip up into the head.
        """
        heights = self.profile[:, 0] + np.r_[-margin, np.zeros(len(self.profile) - 2), margin]
        radii = self.profile[:, 1] + margin
        ring = np.stack([np.cos(RING_ANGLES), np.sin(RING_ANGLES)], -1)
        levels = np.broadcast_to(heights[:, None, None], (len(radii), len(RING_ANGLES), 1))
        rings = np.concatenate([radii[:, None, None] * ring, levels], -1)
        camera_from_nozzle = lenses.rig.camera_from_base[camera] @ base_from_nozzle
        x, y, depth = np.moveaxis(se3.transform_points(camera_from_nozzle, rings.reshape(-1, 3)), -1, 0)
        safe_depth = np.maximum(depth, MIN_DEPTH_MM)
        imaged, visible = lenses.bend(camera, x / safe_depth, y / safe_depth, depth)
        visible = (visible & (depth > MIN_DEPTH_MM)).reshape(len(radii), -1)
        spots = imaged.T.reshape(len(radii), -1, 2)
        visible_spots = [ring_spots[mask] for ring_spots, mask in zip(spots, visible, strict=True)]
        parts = (np.concatenate(pair) for pair in pairwise(visible_spots))
        return [cv2.convexHull(p.astype(np.float32))[:, 0].astype(float) for p in parts if len(p) >= 3]


MASK_SCALE = 0.25  # of the masks to the images: four pixels are few for a landmark's patch
PRINT_HEAD_MARGIN_MM = 1.5  # mm: error of the arm's registration to the cameras, and of its lag
HIGHLIGHT_GREY = 250  # grey levels, from which a pixel is a highlight,
MAX_HIGHLIGHT_SHARE = 0.2  # of the region; with more, the tissue or paper is overexposed
HIGHLIGHT_HALO_PX = 5  # px around a highlight that are part of it


class TrackingMasks:
    """Masks of the newest frame set, and the ink on the surface: nothing is tracked there."""

    def __init__(self, lenses: Lenses, tool: Tool | None = None) -> None:
        self._lenses, self._tool = lenses, tool or Tool(SYRINGE)
        self.print_head: dict[int, ImageMask] = {}  # by camera, 255 on the head, MASK_SCALE times the image's size
        self.ink = Ink()

    def set_print_head(self, head: PrintHead | None, cameras: Iterable[int]) -> None:
        """Set the print head's masks; None: no arm."""
        self.print_head = {}
        if head is None:
            return
        border = 2 * int(np.ceil(PATCH_RADIUS * MASK_SCALE))  # of the mask: patches that overlap the head are left out
        for camera in cameras:
            w, h = self._lenses.rig.cameras[camera].size
            mask = np.zeros((int(np.ceil(h * MASK_SCALE)), int(np.ceil(w * MASK_SCALE))), np.uint8)
            for polygon in self._tool.silhouette(self._lenses, camera, head.base_from_nozzle, PRINT_HEAD_MARGIN_MM):
                outline = np.round(polygon * MASK_SCALE).astype(np.int32)
                cv2.fillConvexPoly(mask, outline, 255)
                cv2.polylines(mask, [outline], True, 255, border)
            if mask.any():
                self.print_head[camera] = mask

    def hides(self, camera: int, pixels: Array) -> NDArray[np.bool_]:
        """Which pixels (N, 2), as imaged, the print head may cover."""
        mask = self.print_head.get(camera)
        if mask is None:
            return np.zeros(len(pixels), bool)
        x, y = np.clip((pixels * MASK_SCALE).astype(int), 0, np.array(mask.shape[::-1]) - 1).T
        return np.asarray(mask[y, x] > 0)

    def lay_ink(self, head: PrintHead | None, stamp: float, base_from_surface: Array) -> Array | None:
        """Add the ink extruded until `stamp`, s; gives the bead's new points (M, 3) mm, surface frame."""
        if head is None or not head.extruding:
            self.ink.lift()
            return None
        return self.ink.lay(stamp, se3.transform_points(se3.inverse(base_from_surface), head.base_from_nozzle[:3, 3]))


def patch_reach(axes: Array) -> Array:
    """Distance (N,) mm from the centres of patches with axes (N, 3, 2) mm per sample to their edges."""
    return np.asarray(PATCH_RADIUS * np.linalg.norm(axes, axis=1).mean(1))


def trackable(image: Image, region: ImageMask, head: ImageMask | None) -> ImageMask:
    """The part (H, W) of a region of a grey image in which tracks may begin. head: as in `TrackingMasks.print_head`."""
    free = region & ~highlights(image, region)
    if head is not None:
        free &= ~np.asarray(cv2.resize(head, free.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
    return np.asarray(free, np.uint8)


def highlights(image: Image, region: ImageMask) -> ImageMask:
    """Mask (H, W), 255 where a grey image has highlights in a region (H, W); empty where much of it is that bright."""
    _, bright = cv2.threshold(image, HIGHLIGHT_GREY - 1, 255, cv2.THRESH_BINARY)
    bright = cv2.bitwise_and(bright, region)
    if cv2.countNonZero(bright) > MAX_HIGHLIGHT_SHARE * cv2.countNonZero(region):
        return np.zeros_like(region)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * HIGHLIGHT_HALO_PX + 1, 2 * HIGHLIGHT_HALO_PX + 1))
    return np.asarray(cv2.dilate(bright, around), np.uint8)


PLACE_STEP_MM = 2.0  # between the compared places: the width of a wound's rim
CELL_MM = 1.2  # of the surface, averaged to one value: against pixel noise and subsampled chroma
BELL_MM = 7.0  # one sigma of a bell, whose places move together, and spacing of bells
DARK_LEVELS = 8.0  # grey levels added to each channel: ratios of darker ones are noise
LIGHT_SIGMA = 0.5  # of the logarithm of a place's brightness (shadows, shading), by which those levels change a ratio
CLIPPING_GREY = 245.0  # grey level from which a channel may be clipped
MIN_NOISE = 0.01  # one sigma of a ratio's logarithm, at least: noise of the first picture, changes of light
FIRST_NOISE, NOISE_MEMORY_SETS = 0.03, 20.0  # of webcams; initial value and memory
SHIFT_PRIOR_MM = 3.0  # one sigma: beyond a wound's rim the difference stops growing with the displacement
MIN_SHIFT_MM = 0.6  # of a reported displacement: slightly more than the guard allows
MIN_EVIDENCE = 100.0  # squared sigmas that a displacement must explain,
MIN_EXPLAINED_SHARE = 0.6  # and their share of the energy beyond noise: small for a hand over a place
MIN_VISIBLE_SHARE = 0.5  # of a bell's places
MIN_SECOND_SHARE = 0.1  # of a second camera in what a displacement explains
MIN_BELLS, MIN_BELL_SHARE = 3, 0.03  # with a displacement: the edge of a hand can look like one in a few
MIN_COSINE = 0.7  # of the angle between one displacement and the sum of all
USUAL_RATIO = 1.5  # times the noise, below which colours are as usual again
OBSERVABLE_SIGMA_MM = 0.3  # along the surface, of a bell's displacement by colours: beyond, it is not observable
WHOLE_SHARE = 0.2  # of the observable bells: with more displaced, the tissue may be either of both
MIN_PLACES = 20  # of a camera, to compare its picture
NEIGHBOUR_OFFSETS = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]], float)
# of `Colours`' sums: normal equations, the places of their (3, 3); energy and number; three pulls of each camera
NORMAL_COLUMNS = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
ENERGY_COLUMN, COUNT_COLUMN, PULL_COLUMNS = 6, 7, 8
UNSEEN_PX = -1e6  # of a place that a camera cannot see: outside every picture


@dataclass(slots=True, eq=False)
class _FirstPicture:
    """P places in one camera's first picture."""

    scale: int  # px, side of an averaged cell
    ratios: Array  # (2, P) logarithms, red and blue to green
    slopes: Array  # (2, P, 3) 1/mm, by displacement of the surface along both tangents and the normal
    free: Mask  # (P,) places in view and not clipped
    noise: Array  # (2,) one sigma


@compiled("f8[:,::1](f8[:,::1], f8[:,::1], f8[::1], f8)")
def place_pixels(camera_from_surface: Array, points: Array, model: Array, radius: float) -> Array:
    """Where a camera images points (N, 3) mm, surface frame: (N, 2) px, UNSEEN_PX for those out of view.

    camera_from_surface: (4, 4). model (9,), radius: of the camera, as `Lenses` has them.
    """
    pixels, pose = np.empty((len(points), 2)), camera_from_surface
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        depth = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        x = (pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]) / max(depth, 1.0)
        y = (pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]) / max(depth, 1.0)
        pixels[n, 0], pixels[n, 1], visible = bend_one(x, y, depth, model, radius)
        if not visible:
            pixels[n, 0] = pixels[n, 1] = UNSEEN_PX
    return pixels


@compiled("Tuple((f8[:,::1], f8[:,::1], b1[::1]))(u1[:,:,::1], i8, f8[:,::1])")
def colour_ratios(image: Image, scale: int, pixels: Array) -> tuple[Array, Array, Mask]:
    """Logarithms (2, N) of red and blue to green at pixels (N, 2), averaged over cells of `scale` px; their derivatives
    (2, N) by the logarithm of the brightness, due to DARK_LEVELS; and which (N,) are in view and not clipped.

    Cells are on a grid, interpolated linearly. image: (H, W, 3) BGR.
    """
    right, low, area = image.shape[1] // scale - 1, image.shape[0] // scale - 1, float(scale * scale)
    ratios, dark = np.zeros((2, len(pixels))), np.zeros((2, len(pixels)))
    free, levels = np.zeros(len(pixels), np.bool_), np.empty(3)
    for n in range(len(pixels)):
        across, down = (pixels[n, 0] + 0.5) / scale - 0.5, (pixels[n, 1] + 0.5) / scale - 0.5
        if not (across >= 0 and across < right and down >= 0 and down < low):
            continue
        column, row = int(across), int(down)
        levels[:] = DARK_LEVELS
        for cell in range(4):
            i, j = cell % 2, cell // 2
            share = (across - column if i else 1 - (across - column)) * (down - row if j else 1 - (down - row)) / area
            for y in range((row + j) * scale, (row + j + 1) * scale):
                for x in range((column + i) * scale, (column + i + 1) * scale):
                    for channel in range(3):
                        levels[channel] += share * image[y, x, channel]
        blue, green, red = levels[0], levels[1], levels[2]
        ratios[0, n], ratios[1, n] = np.log(red / green), np.log(blue / green)
        dark[0, n], dark[1, n] = DARK_LEVELS * (1 / green - 1 / red), DARK_LEVELS * (1 / green - 1 / blue)
        free[n] = max(blue, green, red) < CLIPPING_GREY + DARK_LEVELS
    return ratios, dark, free


@compiled("void(f8[:,::1], i8, b1[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,:,::1], f8[::1])")
def add_equations(
    sums: Array, pull: int, free: Mask, current: Array, dark: Array, first: Array, slopes: Array, noise: Array
) -> None:
    """Add one camera's normal equations at P places to `sums`, in the columns of `Colours`; update its noise.

    pull: first of the camera's own three columns. free: (P,) places used. current, first: (2, P) logarithms, of this
    picture and the first. dark: (2, P) their derivatives by light. slopes: (2, P, 3), noise: (2,), of the first.
    """
    for k in range(2):
        difference = current[k] - first[k]
        difference -= median_of(difference, free)
        noise[k] += (1.4826 * median_of(np.abs(difference), free) - noise[k]) / NOISE_MEMORY_SETS
        variance = max(noise[k], MIN_NOISE) ** 2
        for p in range(len(difference)):
            if not free[p]:
                continue
            light = LIGHT_SIGMA * dark[k, p]
            precision, slope, column = 1 / (variance + light * light), slopes[k, p], 0
            pulls = precision * difference[p]
            for i in range(3):
                sums[p, pull + i] -= pulls * slope[i]
                for j in range(i, 3):
                    sums[p, column] += precision * (slope[i] * slope[j])
                    column += 1
            sums[p, ENERGY_COLUMN] += pulls * difference[p]
            sums[p, COUNT_COLUMN] += 1.0


class Colours:
    """Finds where the colours of one surface are displaced from its tracked texture."""

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
        self._bell_sizes = self._bells.sum(1)
        self._ink_mask = np.zeros(len(self._points), bool)
        self._sizes = np.zeros(len(self._centres))  # mm, each bell's largest displacement while it lasts; else 0
        for camera, image in images.items():
            if camera in poses and image.ndim == 3:
                self._first[camera] = self._picture(camera, image, poses[camera])

    def cover(self, bead: Array) -> None:
        """Exclude places under a bead (M, 3) mm, surface frame: the colours there are the ink's."""
        if self._first:
            self._ink_mask |= near_bead(self._points, bead, np.full(len(self._points), CELL_MM))

    def __call__(
        self, images: Mapping[int, Image], poses: Mapping[int, Array], warp: Warp | None = None
    ) -> DisplacedPlaces:
        """Where colours contradict a pose: `poses` (4, 4) at the exposures of the cameras that carry it."""
        if not self._first:
            return NO_DISPLACED_PLACES
        points = self._points if warp is None else warp.apply(self._points)
        cameras = [camera for camera in self._first if camera in images and camera in poses]
        sums, count = np.zeros((len(points), PULL_COLUMNS + 3 * len(cameras))), 0
        for camera in cameras:
            first, pixels = self._first[camera], self._pixels(camera, poses[camera], points)
            current, dark, free = colour_ratios(contiguous(images[camera], np.uint8), first.scale, pixels)
            free &= first.free & ~self._ink_mask & ~self._masks.hides(camera, pixels)
            if np.count_nonzero(free) < MIN_PLACES:
                continue
            pull, count = PULL_COLUMNS + 3 * count, count + 1
            add_equations(sums, pull, free, current, dark, first.ratios, first.slopes, first.noise)
        if not count:
            return NO_DISPLACED_PLACES
        bell_sums = self._bells @ sums
        pulls = bell_sums[:, PULL_COLUMNS : PULL_COLUMNS + 3 * count].reshape(-1, count, 3).swapaxes(0, 1)
        enough = bell_sums[:, COUNT_COLUMN] > MIN_VISIBLE_SHARE * 2 * count * self._bell_sizes
        expected_energy = np.where(enough, bell_sums[:, COUNT_COLUMN], np.inf)  # else a mask's edge looks displaced
        return self._judge(bell_sums[:, NORMAL_COLUMNS], pulls, bell_sums[:, ENERGY_COLUMN], expected_energy)

    def _judge(self, normal: Array, pulls: Array, energy: Array, expected_energy: Array) -> DisplacedPlaces:
        """From normal equations (K, 3, 3), (C, K, 3) of each camera and bell, energy and its expected value, (K,)."""
        pull = pulls.sum(0)
        shift = solve_symmetric3(contiguous(normal + np.eye(3) / SHIFT_PRIOR_MM**2), contiguous(pull))
        size, explained = np.linalg.norm(shift, axis=1), (shift * pull).sum(1)
        new = np.isfinite(expected_energy) & (size > MIN_SHIFT_MM) & (explained > MIN_EVIDENCE)
        if not (new.any() or self._sizes.any()):
            return NO_DISPLACED_PLACES
        new &= explained > MIN_EXPLAINED_SHARE * (energy - expected_energy)
        if len(pulls) > 1:  # else it may be one camera's error: a print head in its first picture
            new &= np.sort((pulls * shift).sum(-1), axis=0)[-2] > MIN_SECOND_SHARE * explained
        direction = (explained * new) @ shift  # tissue moves one way; highlights do not
        new &= shift @ direction > MIN_COSINE * size * np.linalg.norm(direction)
        new &= new.sum() >= max(MIN_BELLS, MIN_BELL_SHARE * len(new))
        lasting = (self._sizes > 0) & (np.isinf(expected_energy) | (energy > USUAL_RATIO * expected_energy))
        self._sizes = np.where(new | lasting, np.maximum(self._sizes, np.where(new, size, 0.0)), 0.0)
        displaced = self._sizes > 0
        if not displaced.any():
            return NO_DISPLACED_PLACES
        observable = np.linalg.eigvalsh(normal)[:, 1] > OBSERVABLE_SIGMA_MM**-2.0
        whole = int((displaced & observable).sum()) > WHOLE_SHARE * int(observable.sum())
        return DisplacedPlaces(self._centres[displaced], self._sizes[displaced], BELL_MM, whole)

    def _picture(self, camera: int, image: Image, pose: Array) -> _FirstPicture:
        image, pixels = contiguous(image, np.uint8), self._pixels(camera, pose, self._points)
        neighbours = self._pixels(camera, pose, self._points + self._axes[0])
        scale = max(1, round(CELL_MM * float(np.median(np.linalg.norm(neighbours - pixels, axis=1)))))
        ratios, _, free = colour_ratios(image, scale, pixels)
        places = (self._points + side * axis for axis in self._axes for side in (1, -1))
        ends = [colour_ratios(image, scale, self._pixels(camera, pose, at))[0] for at in places]
        slopes = np.stack([(ends[2 * i] - ends[2 * i + 1]) / 2 for i in range(3)], -1)
        for offset in 2 * scale * NEIGHBOUR_OFFSETS:  # pixels of averages and slopes must be of the surface too
            free &= ~self._masks.hides(camera, pixels + offset)
        return _FirstPicture(scale, ratios, slopes, free, np.full(2, FIRST_NOISE))

    def _pixels(self, camera: int, pose: Array, points: Array) -> Array:
        """Pixels (N, 2) of points (N, 3) mm of a surface at a pose (4, 4); UNSEEN_PX for those out of view."""
        camera_from_surface, lenses = self._lenses.rig.camera_from_base[camera] @ pose, self._lenses
        return place_pixels(camera_from_surface, contiguous(points), lenses.models[camera], lenses.radius[camera])


def _spread(plane: TangentPlane, step: float) -> Array:
    """Points (N, 3) mm of a surface, among its landmarks, a step, mm, apart."""
    cells = max(1, int(np.ptp(plane.places, axis=0).max() / step))
    flat = plane.grid(cells)[0].reshape(-1, 2)
    return plane.lift(flat[plane.inside(flat)])[0]
