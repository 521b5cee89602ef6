"""Synthetic worlds for tests: a moving surface with landmarks, cameras, their observations, and the whole truth.

`synthetic_world` makes one in a line; `Conditions` says what may go wrong in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import Trajectory
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array, Mask
from estimation.surface_map import SurfaceMap
from estimation.synthetic.movements import MOVEMENTS

Displacement = Callable[[Array], Array]  # times (...), s -> rest_from_surface (..., 4, 4), mm
Outage = tuple[float, float] | tuple[float, float, int]  # from, to, s; the camera, all cameras without one

SYNTHETIC_WORLD = "synthetic world"  # where an InputError says it comes from
SHARE_FIELDS = ("outliers", "coherent", "dropouts")
SIZE_FIELDS = (
    *("noise", "dropout_seconds", "jitter", "calibration", "map_error", "correlated", "correlated_seconds", "churn"),
)
MAX_OUTLIER = 40.0  # px: largest shift of an outlier along an axis
MIN_TRACK_SIGMA = 0.02  # px: of a track
MIN_FACING_COSINE = 0.17  # at 80 degrees to the normal a patch of skin is a line
MIN_CAMERA_DEPTH = 1.0  # mm
MOTION_STREAM, LANDMARK_STREAM, CALIBRATION_STREAM, MAP_STREAM, TRACK_STREAM = range(5)  # each has its own generator

ARC_ANGLES_DEG = (0.0, 36.0, 84.0)  # of the cameras about the wound, thesis Fig. 4.3
WOUND_CENTRE = np.array([180.0, 40.0, 60.0])  # mm, base frame: the middle of the room, where the wound rests
WOUND_TILT = np.deg2rad(-38.0)  # of the wound, so that its normal stands amid the cameras and none of them grazes it
BASE_FROM_REST = se3.make(se3.exp_rotation([WOUND_TILT, 0.0, 0.0]), WOUND_CENTRE)  # base_from_surface at rest
WEBCAM_DISTORTION = (-0.12, 0.06, 6e-4, -4e-4, 0.0)  # a plain webcam's

PATCH_SIZE, PATCH_RADIUS = (60.0, 45.0), 70.0  # mm: a wound's surroundings on an arm
CUBE_EDGE = 40.0  # mm

# Proportions of the errors that a calibration with a board leaves, before they are scaled to the wanted RMS
DISTORTION_ERROR = np.array([2e-3, 4e-3, 2e-4, 2e-4, 0.0])  # k1 k2 p1 p2 k3
FOCAL_ERROR, CENTRE_ERROR = 1.0, 1.0  # px
ROTATION_ERROR, POSITION_ERROR = 1e-3, 0.2  # rad, mm


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceLandmarks:
    """Landmarks on a surface, in the surface frame."""

    points: Array  # (N, 3) mm
    normals: Array  # (N, 3) unit, outwards

    def __len__(self) -> int:
        return len(self.points)


Surface = Callable[[int, np.random.Generator], SurfaceLandmarks]


def patch(count: int, rng: np.random.Generator) -> SurfaceLandmarks:
    """`count` random landmarks on a patch of 60 x 45 mm, bent about its x axis to a radius of 70 mm."""
    x, y = (rng.uniform(-0.5, 0.5, (count, 2)) * PATCH_SIZE).T
    up = np.sqrt(PATCH_RADIUS**2 - y**2)
    return SurfaceLandmarks(np.stack([x, y, up - PATCH_RADIUS], -1), np.stack([0 * x, y, up], -1) / PATCH_RADIUS)


def cube(count: int, rng: np.random.Generator) -> SurfaceLandmarks:
    """`count` random landmarks on a cube of 40 mm without its bottom; the origin is the middle of its top."""
    outward = np.array([[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    normals = outward[rng.integers(0, len(outward), count)]
    points = rng.uniform(-CUBE_EDGE / 2, CUBE_EDGE / 2, (count, 3))
    points = np.where(normals != 0, normals * CUBE_EDGE / 2, points)
    return SurfaceLandmarks(points - [0, 0, CUBE_EDGE / 2], normals)


SURFACES: dict[str, Surface] = {draw.__name__: draw for draw in (patch, cube)}


@dataclass(frozen=True, slots=True)
class Conditions:
    """Degradations of the cameras' tracks; only noise is on by default. InputError for a value out of range."""

    noise: float = 0.25  # px: standard deviation per axis of white noise, and the sigma that observations state
    outliers: float = 0.0  # share of the observations that are shifted by up to 40 px, drawn anew in each frame
    coherent: float = 0.0  # share of the tracks that stay where they were in the image, as on a drape or a highlight
    dropouts: float = 0.0  # share of the time in which a track is missing
    dropout_seconds: float = 0.3  # s: mean length of a dropout
    outages: tuple[Outage, ...] = ()  # periods without tracks in one camera, or in all of them
    views: int | None = None  # number of cameras with tracks of a landmark, at random; None: all that see it
    offsets: tuple[float, ...] = ()  # s: delay of each camera's true instant after its stamp; not in the rig
    jitter: float = 0.0  # s: standard deviation of each camera's instant from frame to frame
    calibration: float = 0.0  # px: RMS distance of the landmarks' images by the given rig from the true ones, at rest
    map_error: float = 0.0  # mm: standard deviation per axis of the map's landmarks; the map's covariance states it
    correlated: float = 0.0  # px: standard deviation of an error that lasts for `correlated_seconds`; not stated
    correlated_seconds: float = 2.0  # s: time constant of that error
    churn: float = 0.0  # s: mean life of a landmark before another one replaces it; 0: for ever
    reveal: tuple[float, float] | None = None  # s: begin and end of uncovering the half with x > 0; None: uncovered

    def __post_init__(self) -> None:
        for name in SHARE_FIELDS:
            _check_condition(name, getattr(self, name), 0 <= getattr(self, name) <= 1, "a share, 0 to 1")
        for name in SIZE_FIELDS:
            _check_condition(name, getattr(self, name), 0 <= getattr(self, name) < math.inf, "a finite number >= 0")
        if self.dropouts:
            _check_condition("dropout_seconds", self.dropout_seconds, self.dropout_seconds > 0, "> 0 s with dropouts")
        for spell in [*self.outages, *([self.reveal] if self.reveal else [])]:
            _check_condition("spell", spell, spell[0] <= spell[1], "from <= to, s")
        _check_condition("views", self.views, self.views is None or self.views >= 1, "None, or at least 1")


def _check_condition(name: str, value: object, good: bool, allowed: str) -> None:
    if not good:
        raise InputError(SYNTHETIC_WORLD, name, value, allowed)


def arc_rig(
    angles_deg: Sequence[float] = ARC_ANGLES_DEG,
    distance: float = 400.0,
    focal: float = 1100.0,
    size: tuple[int, int] = (1280, 720),
    distortion: Sequence[float] = WEBCAM_DISTORTION,
) -> Rig:
    """Cameras on an arc about WOUND_CENTRE, `angles_deg` from straight above, `distance` mm away, `focal` px."""
    cameras = []
    for i, angle in enumerate(np.deg2rad(angles_deg)):
        out = np.array([0.0, np.sin(angle), np.cos(angle)])  # from the wound to the camera
        right = np.array([1.0, 0.0, 0.0])
        rotation = np.stack([right, np.cross(-out, right), -out], axis=1)
        cx, cy = size[0] / 2 - 3 + 5 * i, size[1] / 2 + 4 - 3 * i
        matrix = np.array([[focal * (1 + 0.01 * i), 0, cx], [0, focal, cy], [0, 0, 1]])
        pose = se3.make(rotation, WOUND_CENTRE + distance * out)
        cameras.append(Camera(f"cam_{i}", size, matrix, np.array(distortion, float), pose))
    return Rig(tuple(cameras))


def undistorting(rig: Rig) -> Rig:
    """The same cameras without distortion: observations hold undistorted pixels."""
    return Rig(tuple(replace(c, distortion=np.zeros(5)) for c in rig.cameras))


def _miscalibrated(camera: Camera, points_base: Array, rms: float, rng: np.random.Generator) -> Camera:
    """The camera with lens and pose so far off that points (N, 3) mm are imaged `rms` px per axis away from before."""
    draw = rng.standard_normal(14)
    size = 1.0
    for _ in range(6):  # nearly linear in the size
        moved = _perturbed(camera, size * draw)
        away = pixels_from_points(moved, points_base)[0] - pixels_from_points(camera, points_base)[0]
        size *= rms / float(np.sqrt((away**2).sum(1).mean() / 2))  # per axis, as the noise is
    return _perturbed(camera, size * draw)


def _perturbed(camera: Camera, draw: Array) -> Camera:
    matrix, distortion = camera.matrix.copy(), camera.distortion + DISTORTION_ERROR * draw[9:14]
    matrix[[0, 1], [0, 1]] += FOCAL_ERROR * draw[0]
    matrix[:2, 2] += CENTRE_ERROR * draw[1:3]
    pose = camera.base_from_camera @ se3.exp(np.r_[ROTATION_ERROR * draw[3:6], POSITION_ERROR * draw[6:9]])
    return replace(camera, matrix=matrix, distortion=distortion, base_from_camera=pose)


def project_landmarks(rig: Rig, points: Array, poses: Array, normals: Array | None = None) -> tuple[Array, Mask]:
    """Pixels (C, N, 2) of points (N, 3), surface frame, and which (C, N) each camera has in view.

    rig: without distortion for the pixels of Observations. poses: (C, 4, 4) base_from_surface at each camera's instant.
    normals: (N, 3); without them all points face all cameras.
    """
    pixels, seen = np.empty((len(poses), len(points), 2)), np.empty((len(poses), len(points)), bool)
    for c, pose in enumerate(poses):
        camera, points_base = rig.cameras[c], se3.transform_points(pose, points)
        pixels[c], depth = pixels_from_points(camera, points_base)
        seen[c] = (depth > MIN_CAMERA_DEPTH) & ((pixels[c] > 0) & (pixels[c] < np.array(camera.size) - 1)).all(1)
        if normals is not None:
            to_camera = camera.base_from_camera[:3, 3] - points_base
            facing = ((normals @ pose[:3, :3].T) * to_camera).sum(1)
            seen[c] &= facing > MIN_FACING_COSINE * np.linalg.norm(to_camera, axis=1)
    return pixels, seen


def _observations(stamp: float, pixels: Array, seen: Mask, sigma: float) -> Observations:
    """Observations of pixels (C, N, 2) where seen (C, N), all of `sigma` px; a track's id is its column."""
    camera, track = np.nonzero(seen)
    return Observations(stamp, camera, track, pixels[camera, track], np.full(len(camera), sigma))


def observations(
    rig: Rig,
    points: Array,
    base_from_surface: Array,
    stamp: float,
    rng: np.random.Generator,
    sigma: float = 0.3,
    outliers: float = 0.0,
    visible: Mask | None = None,
) -> Observations:
    """Observations of points (N, 3), surface frame, by all cameras at one instant, with white noise of `sigma` px.

    outliers: share of the observations that are shifted by up to 40 px instead. visible: (C, N) which may be seen.
    """
    pixels, seen = project_landmarks(undistorting(rig), points, np.broadcast_to(base_from_surface, (len(rig), 4, 4)))
    error = sigma * rng.standard_normal(pixels.shape)
    wrong = rng.random(seen.shape) < outliers
    error[wrong] = rng.uniform(-MAX_OUTLIER, MAX_OUTLIER, (int(wrong.sum()), 2))
    return _observations(stamp, pixels + error, seen if visible is None else seen & visible, sigma)


class _TrackErrors:
    """Pixel errors (C, N, 2) of all tracks, frame by frame: white noise, correlated noise and outliers.

    Every frame draws the same amount whatever is seen, so worlds that differ in one condition share all other draws.
    """

    def __init__(self, conditions: Conditions, shape: tuple[int, int], rng: np.random.Generator) -> None:
        self._conditions, self._shape, self._rng = conditions, shape, rng
        self._correlated = rng.standard_normal((*shape, 2))

    def __call__(self, dt: float) -> Array:
        c, rng = self._conditions, self._rng
        white, fresh = rng.standard_normal((2, *self._shape, 2))
        keep = np.exp(-dt / c.correlated_seconds) if c.correlated_seconds else 0.0
        self._correlated = keep * self._correlated + np.sqrt(1 - keep**2) * fresh  # Gauss-Markov, first order
        error = c.noise * white + c.correlated * self._correlated
        wrong, shift = rng.random(self._shape), rng.uniform(-MAX_OUTLIER, MAX_OUTLIER, (*self._shape, 2))
        return np.where((wrong < c.outliers)[..., None], shift, error)


class _TrackVisibility:
    """Which landmarks in view (C, N) have tracks, frame by frame."""

    def __init__(self, conditions: Conditions, shape: tuple[int, int], rng: np.random.Generator) -> None:
        self._conditions, self._shape, self._rng = conditions, shape, rng
        views = shape[0] if conditions.views is None else conditions.views
        self._ever = rng.random(shape).argsort(axis=0).argsort(axis=0) < views
        self._dropped = rng.random(shape) < conditions.dropouts

    def __call__(self, stamp: float, dt: float) -> Mask:
        self._dropped = self._rng.random(self._shape) < np.where(self._dropped, *self._dropout_chances(dt))
        visible = self._ever & ~self._dropped
        for start, end, *camera in self._conditions.outages:
            if start <= stamp < end:
                visible[camera or slice(None)] = False
        return visible

    def _dropout_chances(self, dt: float) -> tuple[float, float]:
        """Chance that a dropped track stays dropped, and that another one is dropped: a two-state Markov chain."""
        share = self._conditions.dropouts
        if share in (0.0, 1.0):
            return share, share
        end = -np.expm1(-dt / self._conditions.dropout_seconds)
        return 1 - end, min(end * share / (1 - share), 1.0)


def _life_spans(count: int, seconds: float, life: float, rng: np.random.Generator) -> Array:
    """First and last instant (N, 2), s, of landmarks: `count` at a time, each for `life` s on average, 0: for ever."""
    if not life:
        return np.tile([-np.inf, np.inf], (count, 1))
    spans = []
    for _ in range(count):
        start = -np.inf
        while start < seconds:
            end = max(start, 0.0) + rng.exponential(life)
            spans.append((start, end))
            start = end
    return np.array(sorted(spans))


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """One world. Iterate over it for the observations of each frame set; a track's id is its landmark's row."""

    rig: Rig  # the calibrated cameras that an estimator is given
    true_rig: Rig  # the cameras that make the pixels, without distortion
    landmarks: SurfaceLandmarks  # the true ones
    spans: Array  # (N, 2) s: from when to when each landmark can be seen
    map: SurfaceMap  # of all landmarks, as an estimator is given it
    motion: Displacement  # rest_from_surface over time
    rest: Array  # (4, 4) base_from_rest, mm
    stamps: Array  # (K,) s
    conditions: Conditions
    seed: int

    def base_from_surface(self, times: Array) -> Array:
        """The true pose (..., 4, 4), mm, at times (...), s."""
        return np.asarray(self.rest @ self.motion(times))

    def twists(self, times: Array) -> Array:
        """The true body velocity (..., 6), rad/s and mm/s, at times (...), s, by differences over 0.2 ms."""
        times, step = np.asarray(times, float), 1e-4
        before, after = (self.base_from_surface(times + s) for s in (-step, step))
        return np.asarray(se3.log(se3.inverse(before) @ after) / (2 * step))

    @property
    def truth(self) -> Trajectory:
        """The true poses at the stamps, which are the exposure instants of cameras without an offset."""
        return Trajectory(self.stamps, self.base_from_surface(self.stamps), exact=True)

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> Iterator[Observations]:
        return self.observations()

    def observations(self) -> Iterator[Observations]:
        """The observations at each stamp; every iteration gives the same bits."""
        c, shape = self.conditions, (len(self.rig), len(self.landmarks))
        visibility_rng, error_rng, timing_rng, coherent_rng = np.random.default_rng([self.seed, TRACK_STREAM]).spawn(4)
        errors, visibility = _TrackErrors(c, shape, error_rng), _TrackVisibility(c, shape, visibility_rng)
        stuck = coherent_rng.random(shape) < c.coherent
        first, _ = self.pixels_at(np.zeros(shape[0]))
        offsets = np.array(c.offsets or np.zeros(shape[0]))
        step = float(self.stamps[1] - self.stamps[0]) if len(self) > 1 else 0.0
        for stamp in map(float, self.stamps):
            pixels, seen = self.pixels_at(stamp + offsets + c.jitter * timing_rng.standard_normal(shape[0]))
            pixels = np.where(stuck[..., None], first, pixels) + errors(step)
            seen = seen & visibility(stamp, step) & self._uncovered(stamp)
            yield _observations(stamp, pixels, seen, max(c.noise, MIN_TRACK_SIGMA))

    def pixels_at(self, instants: Array) -> tuple[Array, Mask]:
        """True pixels (C, N, 2) at each camera's own instant (C,), s, and which landmarks (C, N) it has in view."""
        poses = self.base_from_surface(instants)
        return project_landmarks(self.true_rig, self.landmarks.points, poses, self.landmarks.normals)

    def _uncovered(self, stamp: float) -> Mask:
        """Which landmarks (N,) are alive and uncovered at `stamp`, s."""
        alive = (self.spans[:, 0] <= stamp) & (stamp < self.spans[:, 1])
        if self.conditions.reveal is None:
            return np.asarray(alive)
        start, end = self.conditions.reveal
        x = self.landmarks.points[:, 0]
        share = np.clip((stamp - start) / max(end - start, 1e-9), 0.0, 1.0)
        return np.asarray(alive & (x <= share * x.max()))


def synthetic_world(
    movement: str | Displacement = "breathing",
    seconds: float = 4.0,
    rate: float = 30.0,
    count: int = 100,
    surface: str | Surface = "patch",
    seed: int = 0,
    rig: Rig | None = None,
    rest: Array = BASE_FROM_REST,
    **conditions: Any,
) -> World:
    """A world in one line: `synthetic_world("breathing", noise=0.25, outliers=0.05, offsets=(0, 8e-3, -5e-3), seed=3)`.

    movement: a name in `MOVEMENTS`, or rest_from_surface over time. seconds, rate: duration, and frame sets per second.
    count: landmarks at a time. surface: a name in `SURFACES`, or a function that draws landmarks. rig: None for three
    cameras about the wound. rest: (4, 4) base_from_rest. conditions: the fields of `Conditions`. Raises InputError.
    """
    given = Conditions(**conditions)
    rig = arc_rig() if rig is None else rig
    _check_world(given, rig, seconds, rate, count)
    stamps = np.arange(max(1, round(seconds * rate))) / rate
    streams = [np.random.default_rng([seed, stream]) for stream in range(TRACK_STREAM)]
    motion = movement
    if isinstance(motion, str):
        motion = _by_name(motion, MOVEMENTS, "movement")(streams[MOTION_STREAM])
    spans = _life_spans(count, float(stamps[-1]), given.churn, streams[LANDMARK_STREAM])
    landmarks = _by_name(surface, SURFACES, "surface")(len(spans), streams[LANDMARK_STREAM])
    true_rig = undistorting(rig)
    if given.calibration:
        points, rng = se3.transform_points(rest, landmarks.points), streams[CALIBRATION_STREAM]
        true_rig = Rig(tuple(_miscalibrated(c, points, given.calibration, rng) for c in true_rig.cameras))
    mapped = landmarks.points + given.map_error * streams[MAP_STREAM].standard_normal(landmarks.points.shape)
    surface_map = SurfaceMap(mapped, landmarks.normals, given.map_error**2 * np.eye(3 * len(mapped)))
    return World(rig, true_rig, landmarks, spans, surface_map, motion, rest, stamps, given, seed)


def _check_world(given: Conditions, rig: Rig, seconds: float, rate: float, count: int) -> None:
    if given.offsets and len(given.offsets) != len(rig):
        raise InputError(SYNTHETIC_WORLD, "offsets", given.offsets, f"one for each of {len(rig)} cameras")
    for spell in given.outages:
        if len(spell) == 3 and not 0 <= spell[2] < len(rig):
            raise InputError(SYNTHETIC_WORLD, "outages", spell, f"a camera, 0 to {len(rig) - 1}")
    for name, value in (("seconds", seconds), ("rate", rate), ("count", count)):
        if not 0 < value < np.inf:
            raise InputError(SYNTHETIC_WORLD, name, value, "a finite number > 0")


def _by_name(name: Any, table: dict[str, Any], what: str) -> Any:
    if not isinstance(name, str):
        return name
    if name not in table:
        raise InputError(SYNTHETIC_WORLD, what, name, f"one of {', '.join(table)}")
    return table[name]
