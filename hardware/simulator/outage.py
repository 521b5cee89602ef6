"""Outages of cameras at picture level: what becomes of the images of one instant while something is wrong.

Each is a kind, the cameras it strikes, when, and how hard; all chance is drawn once, when the outage is.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from hardware.simulator.cover import covered, glared
from perception.frames import Image
from perception.lens import undistort

Map = NDArray[np.float32]  # (H, W)

LONGEST, SHORTEST = 5.0, 0.2  # s, of an occlusion; other faults are over within 2 s
FLASH = (0.03, 0.2)  # s
BUMP_TURN, BUMP_SHIFT = np.deg2rad(0.5), 2.0  # rad, mm: the least bump; the hardest is twice that
SLIDE = 0.15  # s in which a hand comes and goes
LATTICE = 8  # px between the rays that are traced for a bumped camera


class Kind(Enum):
    """What goes wrong. The last five may leave a camera of some use."""

    OCCLUDED = "occluded"  # something lies over the whole wound, from one frame to the next
    DEAD = "dead"  # no picture comes
    BLACK = "black"  # the picture is black
    FROZEN = "frozen"  # the same picture again and again
    SWAPPED = "swapped"  # two cables exchanged
    BUMPED = "bumped"  # the camera stands and looks a little differently
    HAND = "hand"  # slides in, covers the wound wholly or in part, slides out
    GLARE = "glare"
    FLASH = "flash"
    EXPOSURE = "exposure"
    BLUR = "blur"

    @property
    def blinds(self) -> bool:
        """Whether a camera struck by it is of no use at all."""
        return self in tuple(Kind)[:6]


@dataclass(frozen=True, slots=True, eq=False)
class Outage:
    """One outage. cameras: numbers in the rig. start, end: s; the view is free again at `end`. strength: in [0, 1].
    bump: (4, 4), camera_from_bumped, mm. seed: of what else is drawn."""

    kind: Kind
    cameras: tuple[int, ...]
    start: float
    end: float
    strength: float
    bump: Array
    seed: int


def draw_outage(kind: Kind, rig: Rig, start: float, rng: np.random.Generator, longest: float = LONGEST) -> Outage:
    """An outage of a kind that begins at `start`, s, and lasts `longest` s at most; uniform in the logarithm."""
    low, high = {
        Kind.OCCLUDED: (SHORTEST, LONGEST),
        Kind.HAND: (SHORTEST + 2 * SLIDE, LONGEST),
        Kind.FLASH: FLASH,
    }.get(kind, (SHORTEST, 2.0))
    length = min(float(np.exp(rng.uniform(np.log(low), np.log(high)))), longest)
    most = {Kind.SWAPPED: (2,), Kind.BUMPED: (1,)}.get(kind, (1, 1, 2, 3))
    count = min(int(rng.choice(most)), len(rig))
    cameras = tuple(sorted(rng.choice(len(rig), count, replace=False).tolist()))
    across = np.array([*_unit(rng), 0.3 * rng.normal()])  # pan and tilt show, roll hardly
    shift = np.array([*_unit(rng), 0.3 * rng.normal()])
    hard = rng.uniform(1.0, 2.0)
    turn = bool(rng.integers(2))
    xi = np.concatenate([across * BUMP_TURN * hard * turn, shift * BUMP_SHIFT * hard * (not turn)])
    return Outage(kind, cameras, start, start + length, float(rng.random()), se3.exp(xi), int(rng.integers(2**31)))


def _unit(rng: np.random.Generator) -> Array:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


class Spoiler:
    """Applies outages to the images of one rig, in order of time."""

    def __init__(self, rig: Rig, extent: Array) -> None:
        """extent: (N, 3) mm, surface frame, points around what is to be covered."""
        self.rig, self._extent = rig, extent
        self._maps: tuple[Outage, tuple[Map, Map]] | None = None

    def __call__(
        self, outage: Outage, stamp: float, images: list[Image], last: list[Image], base_from_surface: Array
    ) -> list[Image | None]:
        """What the cameras deliver at `stamp` instead of `images` (grey); last: what they did before the outage."""
        spoilt: list[Image | None] = list(images)
        for c in outage.cameras:
            spoilt[c] = self._one(outage, stamp, c, images, last, base_from_surface)
        return spoilt

    def _one(
        self, outage: Outage, stamp: float, c: int, images: list[Image], last: list[Image], base_from_surface: Array
    ) -> Image | None:
        image, hard = images[c], outage.strength
        draw = np.random.default_rng([outage.seed, c])
        match outage.kind:
            case Kind.DEAD:
                return None
            case Kind.BLACK:
                return np.full_like(image, 2)
            case Kind.FROZEN:
                return last[c]
            case Kind.SWAPPED:
                return images[outage.cameras[1 - outage.cameras.index(c)]]
            case Kind.BUMPED:
                return self._bumped(outage, c, image, base_from_surface)
            case Kind.FLASH:
                return _relit(image, 3.0 + 5.0 * hard, 30.0)
            case Kind.EXPOSURE:
                return _relit(image, 0.35 + 0.35 * hard if hard < 0.5 else 0.9 + 1.4 * hard, 0.0)
            case Kind.BLUR:
                return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.5 + 6.0 * hard), np.uint8)
            case Kind.GLARE:
                return glared(image, self._box(c, base_from_surface), 0.25 + 0.5 * hard, draw)
            case Kind.OCCLUDED:
                return covered(image, self._box(c, base_from_surface), 0.0, draw)
            case Kind.HAND:
                away = min(stamp - outage.start, outage.end - stamp) / SLIDE
                reach = 0.6 if hard < 0.4 else 0.0  # two in five leave more than half of the wound free
                return covered(image, self._box(c, base_from_surface), max(reach, 1.0 - away), draw)

    def _box(self, camera: int, base_from_surface: Array) -> tuple[Array, Array]:
        """Low and high corner (2,) px of the wound in a camera's image."""
        pixels, _ = pixels_from_points(self.rig.cameras[camera], se3.transform_points(base_from_surface, self._extent))
        return pixels.min(0), pixels.max(0)

    def _bumped(self, outage: Outage, camera: int, image: Image, base_from_surface: Array) -> Image:
        """As the bumped camera sees the surface's tangent plane; what is nearer or farther shifts by far less."""
        if self._maps is None or self._maps[0] is not outage:
            self._maps = outage, _bump_maps(self.rig.cameras[camera], outage.bump, base_from_surface)
        return np.asarray(cv2.remap(image, *self._maps[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _relit(image: Image, gain: float, offset: float) -> Image:
    return np.asarray(cv2.convertScaleAbs(image, alpha=gain, beta=offset), np.uint8)


def _bump_maps(camera: Camera, camera_from_bumped: Array, base_from_surface: Array) -> tuple[Map, Map]:
    """Where each pixel of the bumped camera lies in the camera's own image, x and y (H, W)."""
    w, h = camera.size
    across, down = (np.arange(-LATTICE, n + 2 * LATTICE, LATTICE, dtype=float) for n in (w, h))
    grid = np.stack(np.meshgrid(across, down), -1)
    ideal = undistort(camera, grid.reshape(-1, 2))
    tangents = (ideal - camera.matrix[:2, 2]) / camera.matrix[[0, 1], [0, 1]]
    base_from_bumped = camera.base_from_camera @ camera_from_bumped
    rays = np.c_[tangents, np.ones(len(tangents))] @ base_from_bumped[:3, :3].T
    centre, plane = base_from_bumped[:3, 3], base_from_surface[:3, 2]
    reach = (base_from_surface[:3, 3] - centre) @ plane / (rays @ plane)
    source = pixels_from_points(camera, centre + reach[:, None] * rays)[0].reshape(grid.shape)
    x, y = np.meshgrid((np.arange(w) / LATTICE + 1), (np.arange(h) / LATTICE + 1))
    fine: Map = np.asarray(
        cv2.remap(source.astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR), np.float32
    )
    return np.ascontiguousarray(fine[..., 0]), np.ascontiguousarray(fine[..., 1])
