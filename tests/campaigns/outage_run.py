"""Tracking with one camera outage after the other, and the tracker's pose, state and reason in each frame set.

Outages change the images of one instant: each has a kind, the cameras it strikes, a time and a strength; everything
random is drawn once, with the outage.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from hardware.simulator.scene.render import draw_cover
from hardware.simulator.scene.scene import rois
from perception.frames import Frame, FrameSet, Image
from perception.lens import undistort
from perception.tracking.step import TrackingStep
from tests.campaigns.estimator import FRAME_RATE_HZ, ScenePictures

Map = NDArray[np.float32]  # (H, W)

MAX_OCCLUSION, MIN_OCCLUSION = 5.0, 0.2  # s, of an occlusion; other faults are over within 2 s
FLASH = (0.03, 0.2)  # s
BUMP_TURN, BUMP_SHIFT = np.deg2rad(0.5), 2.0  # rad, mm: the least bump; the hardest is twice that
HAND_SLIDE = 0.15  # s in which a hand comes and goes
RAY_SPACING = 8  # px between the rays that are traced for a bumped camera


def draw_glare(image: Image, box: tuple[Array, Array], share: float, rng: np.random.Generator) -> Image:
    """Soft saturated spots over about `share` of a box (low, high px)."""
    low, high = box
    light = np.zeros(image.shape, np.float32)
    for _ in range(3):
        centre = low + rng.uniform(0.1, 0.9, 2) * (high - low)
        radius = (high - low) * np.sqrt(share / 3 / np.pi) * rng.uniform(0.8, 1.2)
        middle, axes = (tuple(np.round(v).astype(int).tolist()) for v in (centre, radius))
        cv2.ellipse(light, middle, axes, 0, 0, 360, 400.0, -1)
    return np.asarray(np.clip(image + cv2.GaussianBlur(light, (0, 0), 3.0), 0, 255), np.uint8)


class OutageKind(Enum):
    """What goes wrong. The last five may leave a camera partly usable."""

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
        """Whether a struck camera is of no use at all."""
        return self in tuple(OutageKind)[:6]


@dataclass(frozen=True, slots=True, eq=False)
class Outage:
    """One outage."""

    kind: OutageKind
    cameras: tuple[int, ...]  # numbers in the rig
    start: float  # s
    end: float  # s; the view is free again then
    strength: float  # in [0, 1]
    bump: Array  # (4, 4), camera_from_bumped, mm
    seed: int  # of what else is drawn


def draw_outage(
    kind: OutageKind, rig: Rig, start: float, rng: np.random.Generator, longest: float = MAX_OCCLUSION
) -> Outage:
    """An outage of a kind that begins at `start`, s, and lasts `longest` s at most; uniform in the logarithm."""
    low, high = {
        OutageKind.OCCLUDED: (MIN_OCCLUSION, MAX_OCCLUSION),
        OutageKind.HAND: (MIN_OCCLUSION + 2 * HAND_SLIDE, MAX_OCCLUSION),
        OutageKind.FLASH: FLASH,
    }.get(kind, (MIN_OCCLUSION, 2.0))
    length = min(float(np.exp(rng.uniform(np.log(low), np.log(high)))), longest)
    counts = {OutageKind.SWAPPED: (2,), OutageKind.BUMPED: (1,)}.get(kind, (1, 1, 2, 3))
    count = min(int(rng.choice(counts)), len(rig))
    cameras = tuple(sorted(rng.choice(len(rig), count, replace=False).tolist()))

    def across() -> Array:  # pan and tilt show, roll hardly
        angle = rng.uniform(0, 2 * np.pi)
        return np.array([np.cos(angle), np.sin(angle), 0.3 * rng.normal()])

    axis, shift, size, turn = across(), across(), rng.uniform(1.0, 2.0), bool(rng.integers(2))
    xi = np.concatenate([axis * BUMP_TURN * size * turn, shift * BUMP_SHIFT * size * (not turn)])
    return Outage(kind, cameras, start, start + length, float(rng.random()), se3.exp(xi), int(rng.integers(2**31)))


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
        points = se3.transform_points(base_from_surface, self._extent)
        for c in outage.cameras:
            camera = self.rig.cameras[c]
            if outage.kind is OutageKind.FROZEN:
                spoilt[c] = last[c]
            elif outage.kind is OutageKind.SWAPPED:
                spoilt[c] = images[outage.cameras[1 - outage.cameras.index(c)]]
            elif outage.kind is OutageKind.BUMPED:
                # the surface's tangent plane in the bumped camera; what is nearer or farther shifts by far less
                if self._maps is None or self._maps[0] is not outage:
                    self._maps = outage, _bump_maps(camera, outage.bump, base_from_surface)
                moved = cv2.remap(images[c], *self._maps[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
                spoilt[c] = np.asarray(moved, np.uint8)
            else:
                pixels, _ = pixels_from_points(camera, points)
                draw = np.random.default_rng([outage.seed, c])
                spoilt[c] = _spoilt(outage, stamp, images[c], (pixels.min(0), pixels.max(0)), draw)
        return spoilt


def _spoilt(
    outage: Outage, stamp: float, image: Image, box: tuple[Array, Array], draw: np.random.Generator
) -> Image | None:
    """One image in an outage that needs no other. box: low and high corner (2,) px of the wound in it."""
    strength = outage.strength
    match outage.kind:
        case OutageKind.BLACK:
            return np.full_like(image, 2)
        case OutageKind.FLASH:
            return _relit(image, 3.0 + 5.0 * strength, 30.0)
        case OutageKind.EXPOSURE:
            return _relit(image, 0.35 + 0.35 * strength if strength < 0.5 else 0.9 + 1.4 * strength, 0.0)
        case OutageKind.BLUR:
            return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.5 + 6.0 * strength), np.uint8)
        case OutageKind.GLARE:
            return draw_glare(image, box, 0.25 + 0.5 * strength, draw)
        case OutageKind.OCCLUDED:
            return draw_cover(image, box, 0.0, draw)
        case OutageKind.HAND:
            away = min(stamp - outage.start, outage.end - stamp) / HAND_SLIDE
            reach = 0.6 if strength < 0.4 else 0.0  # two in five leave more than half of the wound free
            return draw_cover(image, box, max(reach, 1.0 - away), draw)
    return None


def _relit(image: Image, gain: float, offset: float) -> Image:
    return np.asarray(cv2.convertScaleAbs(image, alpha=gain, beta=offset), np.uint8)


def _bump_maps(camera: Camera, camera_from_bumped: Array, base_from_surface: Array) -> tuple[Map, Map]:
    """Where each pixel of the bumped camera lies in the camera's own image, x and y (H, W)."""
    w, h = camera.size
    across, down = (np.arange(-RAY_SPACING, n + 2 * RAY_SPACING, RAY_SPACING, dtype=float) for n in (w, h))
    grid = np.stack(np.meshgrid(across, down), -1)
    ideal = undistort(camera, grid.reshape(-1, 2))
    tangents = (ideal - camera.matrix[:2, 2]) / camera.matrix[[0, 1], [0, 1]]
    base_from_bumped = camera.base_from_camera @ camera_from_bumped
    rays = np.c_[tangents, np.ones(len(tangents))] @ base_from_bumped[:3, :3].T
    centre, plane = base_from_bumped[:3, 3], base_from_surface[:3, 2]
    reach = (base_from_surface[:3, 3] - centre) @ plane / (rays @ plane)
    source = pixels_from_points(camera, centre + reach[:, None] * rays)[0].reshape(grid.shape).astype(np.float32)
    x, y = np.meshgrid(*((np.arange(n) / RAY_SPACING + 1).astype(np.float32) for n in (w, h)))
    fine: Map = np.asarray(cv2.remap(source, x, y, cv2.INTER_LINEAR), np.float32)
    return np.ascontiguousarray(fine[..., 0]), np.ascontiguousarray(fine[..., 1])


WOUND_EXTENT = np.array([[x, y, 0.0] for x in (-24.0, 0.0, 24.0) for y in (-17.0, 0.0, 17.0)])  # mm, around the wound
JUDGED_POINTS = np.array([[0, 0, 0], [15.0, 0, 0], [-15.0, 0, 0], [0, 10.0, 0], [0, -10.0, 0]])  # mm: of the print
SPACE_95 = 2.8  # 95 % of a normal error in space lie within so many standard deviations
START_S, CALM_S, REST_S = 1.5, 0.5, 0.7  # s before the first outage, before each, and watched after each
HIDING_KINDS = OutageKind.OCCLUDED, OutageKind.DEAD, OutageKind.BLACK  # where they strike all cameras
JUMP_SHARE = 0.3  # of the outages that hide the surface, in which it moves elsewhere meanwhile


@dataclass(frozen=True, slots=True, eq=False)
class WatchedOutage:
    """Frame sets of one outage, from the calm before it to the rest after it."""

    outage: Outage
    stamps: Array  # (K,) s
    error: Array  # (K,) mm, the largest of the judged points
    radius: Array  # (K,) mm, within which 95 % of the errors there lie by the covariance
    states: tuple[TrackState, ...]  # K
    reasons: tuple[str, ...]  # K
    used: NDArray[np.int64]  # (K, C) tracks that carry the pose
    jumped: bool  # whether the surface came back elsewhere


class TrackedStretch:
    """One tracker, driven over the loop of pictures."""

    def __init__(
        self, pictures: ScenePictures, seed: int, step: Callable[[ScenePictures], TrackingStep] | None = None
    ) -> None:
        self._rng = np.random.default_rng([seed, 67])
        self._pictures = pictures
        self._loop, self._at = pictures.near, int(self._rng.integers(len(pictures.near)))
        self._count = 0
        self._spoiler = Spoiler(pictures.rig, WOUND_EXTENT)
        self._last: list[Image] = []
        roi = rois(pictures.scene, pictures.rig, self._loop.poses[self._at % len(self._loop)], 0.0)
        self._step = TrackingStep(pictures.rig, roi) if step is None else step(pictures)
        self._constant: Array | None = None
        self._rows: list[tuple[float, float, float, TrackState, str, NDArray[np.int64]]] = []

    def begin(self) -> bool:
        """Start up; whether the tracker then tracks. The transform between the two surface frames is measured here."""
        offsets = []
        for _ in range(round(START_S * FRAME_RATE_HZ)):
            truth, pose = self._frame(None)
            if pose.state is TrackState.TRACKING:
                offsets.append(se3.inverse(truth) @ pose.base_from_surface)
        if len(offsets) < START_S * FRAME_RATE_HZ / 2:
            return False
        middle = offsets[len(offsets) // 2]
        self._constant = middle @ se3.exp(se3.log(se3.inverse(middle) @ np.stack(offsets)).mean(0))
        self._rows.clear()
        return True

    def outage(self, kind: OutageKind, longest: float = MAX_OCCLUSION) -> WatchedOutage:
        """Calm, one outage of `longest` s at most, and the rest after it."""
        self._rows.clear()
        for _ in range(round(CALM_S * FRAME_RATE_HZ)):
            self._frame(None)
        outage = draw_outage(kind, self._pictures.rig, self._count / FRAME_RATE_HZ, self._rng, longest)
        hidden = len(outage.cameras) == len(self._pictures.rig) and kind in HIDING_KINDS
        before, jumps = self._loop, hidden and outage.end - outage.start > 1.0 and self._rng.random() < JUMP_SHARE
        while self._count / FRAME_RATE_HZ < outage.end - 1e-9:
            if jumps and self._count / FRAME_RATE_HZ > outage.start + 0.5:
                near = self._pictures.near
                jumps, self._loop = False, self._pictures.far if self._loop is near else near
            self._frame(outage)
        for _ in range(round(REST_S * FRAME_RATE_HZ)):
            self._frame(None)
        stamps, error, radius, states, reasons, used = zip(*self._rows, strict=True)
        numbers, jumped = (np.array(stamps), np.array(error), np.array(radius)), self._loop is not before
        return WatchedOutage(outage, *numbers, states, reasons, np.stack(used), jumped)

    def _frame(self, outage: Outage | None) -> tuple[Array, SurfacePose]:
        """One frame set through the tracker; the true pose and the tracker's."""
        stamp, truth = self._count / FRAME_RATE_HZ, self._loop.poses[self._at % len(self._loop)]
        images: list[Image | None] = list(self._loop.images(self._at))
        last = list(self._last)
        if outage is not None:
            images = self._spoiler(outage, stamp, self._loop.images(self._at), last, truth)
        frames = []
        for c, image in enumerate(images):
            if image is not None:
                same = bool(last) and image is last[c]
                noisy = image if same else self._loop.noisy(image)
                frames.append(Frame(c, stamp, noisy))
                if outage is None:
                    self._last = [*self._last[:c], noisy, *self._last[c + 1 :]]
        pose = self._step(FrameSet(stamp, tuple(frames)))
        self._step.idle()
        self._count, self._at = self._count + 1, self._at + 1
        error = radius = np.nan
        if self._constant is not None:
            expected = truth @ self._constant
            points = se3.transform_points(se3.inverse(self._constant), JUDGED_POINTS)
            gap = se3.transform_points(pose.base_from_surface, points) - se3.transform_points(expected, points)
            error = float(np.linalg.norm(gap, axis=1).max())
            radius = SPACE_95 * float(pose.error_at(points).max())
        self._rows.append((pose.stamp, error, radius, pose.state, pose.reason, self._step.last.used.copy()))
        return truth, pose


def run_stretch(pictures: ScenePictures, kinds: Sequence[OutageKind], seed: int, good: float) -> list[WatchedOutage]:
    """Outages of these kinds in this order. The tracker starts anew after one from which it has not recovered.

    good: mm, the largest error of the last five frame sets, which must be TRACKING, after a recovery.
    """
    done: list[WatchedOutage] = []
    stretch: TrackedStretch | None = None
    for k, kind in enumerate(kinds):
        if stretch is None:
            stretch = TrackedStretch(pictures, seed + 1000 * k)
            if not stretch.begin():
                raise RuntimeError(f"no start in scene of seed {seed}")
        done.append(watched := stretch.outage(kind))
        if any(s is not TrackState.TRACKING for s in watched.states[-5:]) or not float(watched.error[-5:].max()) < good:
            stretch = None
    return done
