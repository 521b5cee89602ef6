"""A synthetic world: a moving surface with landmarks, the cameras that watch it, and what they find, with all truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.arc_rig import REST, arc_rig
from estimation.synthetic.calibration import miscalibrated, undistorting
from estimation.synthetic.conditions import WHERE, Conditions
from estimation.synthetic.look import gathered, imaged
from estimation.synthetic.movements import MOVEMENTS
from estimation.synthetic.surfaces import SURFACES, Landmarks, Surface
from estimation.synthetic.tracks import Errors, Found, Seen, lives
from estimation.trajectory import Trajectory

Displacement = Callable[[Array], Array]  # times (...), s -> rest_from_surface (..., 4, 4), mm

LEAST_SIGMA = 0.02  # px: no track is sharper, and none may claim to be exact
MOVING, LANDMARKS, CALIBRATION, MAPPING, TRACKS = range(5)  # each draws by itself, so that none shifts another


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """One world; iterate over it for the observations of each frame set.

    rig: the calibrated cameras, as an estimator is told. true_rig: what makes the pixels, undistorted.
    landmarks: the true ones; a track's id is its landmark's row. spans: (N, 2) s, from when to when each can be seen.
    map: of all landmarks, as an estimator is told. motion: rest_from_surface over time. rest: (4, 4) base_from_rest.
    stamps: (K,) s.
    """

    rig: Rig
    true_rig: Rig
    landmarks: Landmarks
    spans: Array
    map: SurfaceMap
    motion: Displacement
    rest: Array
    stamps: Array
    conditions: Conditions
    seed: int

    def base_from_surface(self, times: Array) -> Array:
        """The true pose (..., 4, 4), mm, at times (...), s."""
        return np.asarray(self.rest @ self.motion(times))

    def twists(self, times: Array, step: float = 1e-4) -> Array:
        """The true body velocity (..., 6), rad/s and mm/s, at times (...), s, by differences over `step` s."""
        times = np.asarray(times, float)
        before, after = (self.base_from_surface(times + s) for s in (-step, step))
        return np.asarray(se3.log(se3.inverse(before) @ after) / (2 * step))

    @property
    def truth(self) -> Trajectory:
        """The true poses at the stamps, which are camera 0's instants where no offset is given to it."""
        return Trajectory(self.stamps, self.base_from_surface(self.stamps), exact=True)

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> Iterator[Observations]:
        return self.observations()

    def observations(self) -> Iterator[Observations]:
        """What the cameras find at each stamp; the same bits each time it is asked for."""
        shape = (len(self.rig), len(self.landmarks))
        finding, erring, timing, sticking = np.random.default_rng([self.seed, TRACKS]).spawn(4)
        errors, found = Errors(self.conditions, shape, erring), Found(self.conditions, shape, finding)
        stuck = sticking.random(shape) < self.conditions.coherent
        first, _ = self.imaged(np.zeros(shape[0]))
        offsets = np.array(self.conditions.offsets or np.zeros(shape[0]))
        step = float(self.stamps[1] - self.stamps[0]) if len(self) > 1 else 0.0
        for stamp in self.stamps:
            instants = stamp + offsets + self.conditions.jitter * timing.standard_normal(shape[0])
            pixels, seen = self.imaged(instants)
            pixels = np.where(stuck[..., None], first, pixels) + errors(step)
            seen = seen & found(float(stamp), step) & self._there(float(stamp))
            yield gathered(float(stamp), pixels, seen, max(self.conditions.noise, LEAST_SIGMA))

    def imaged(self, instants: Array) -> tuple[Array, Seen]:
        """True pixels (C, N, 2) at each camera's own instant (C,), s, and which landmarks (C, N) it has in view."""
        return imaged(self.true_rig, self.landmarks.points, self.base_from_surface(instants), self.landmarks.normals)

    def _there(self, stamp: float) -> Seen:
        """Which landmarks (N,) are alive and uncovered at `stamp`, s."""
        alive = (self.spans[:, 0] <= stamp) & (stamp < self.spans[:, 1])
        if self.conditions.reveal is None:
            return np.asarray(alive)
        start, end = self.conditions.reveal
        x = self.landmarks.points[:, 0]
        shown = np.clip((stamp - start) / max(end - start, 1e-9), 0.0, 1.0)
        return np.asarray(alive & (x <= shown * x.max()))


def synthetic_world(
    movement: str | Displacement = "breathing",
    seconds: float = 4.0,
    rate: float = 30.0,
    count: int = 100,
    surface: str | Surface = "patch",
    seed: int = 0,
    rig: Rig | None = None,
    rest: Array = REST,
    **conditions: Any,
) -> World:
    """A world in one line: `synthetic_world("breathing", noise=0.25, outliers=0.05, offsets=(0, 8e-3, -5e-3), seed=3)`.

    movement: a name of `MOVEMENTS`, or rest_from_surface over time. seconds, rate: frame sets so long, at so many Hz.
    count: landmarks at a time. surface: a name of `SURFACES`, or what draws landmarks. rig: three cameras about the
    wound without one. rest: (4, 4) base_from_rest. conditions: the fields of `Conditions`. Raises InputError.
    """
    asked = Conditions(**conditions)
    rig = arc_rig() if rig is None else rig
    _check(asked, rig, seconds, rate, count)
    stamps = np.arange(max(1, round(seconds * rate))) / rate
    drawn = [np.random.default_rng([seed, stream]) for stream in range(TRACKS)]
    motion = _named(movement, MOVEMENTS, "movement")(drawn[MOVING]) if isinstance(movement, str) else movement
    spans = lives(count, float(stamps[-1]), asked.churn, drawn[LANDMARKS])
    landmarks = _named(surface, SURFACES, "surface")(len(spans), drawn[LANDMARKS])
    true_rig = undistorting(rig)
    if asked.calibration:
        points = se3.transform_points(rest, landmarks.points)
        true_rig = miscalibrated(true_rig, points, asked.calibration, drawn[CALIBRATION])
    known = _known(landmarks, asked.map_error, drawn[MAPPING])
    return World(rig, true_rig, landmarks, spans, known, motion, rest, stamps, asked, seed)


def _check(asked: Conditions, rig: Rig, seconds: float, rate: float, count: int) -> None:
    if asked.offsets and len(asked.offsets) != len(rig):
        raise InputError(WHERE, "offsets", asked.offsets, f"one for each of {len(rig)} cameras")
    for spell in asked.outages:
        if len(spell) == 3 and not 0 <= spell[2] < len(rig):
            raise InputError(WHERE, "outages", spell, f"a camera, 0 to {len(rig) - 1}")
    for name, value in (("seconds", seconds), ("rate", rate), ("count", count)):
        if not 0 < value < np.inf:
            raise InputError(WHERE, name, value, "a finite number > 0")


def _named(name: Any, table: dict[str, Any], what: str) -> Any:
    if not isinstance(name, str):
        return name
    if name not in table:
        raise InputError(WHERE, what, name, f"one of {', '.join(table)}")
    return table[name]


def _known(landmarks: Landmarks, error: float, rng: np.random.Generator) -> SurfaceMap:
    points = landmarks.points + error * rng.standard_normal(landmarks.points.shape)
    return SurfaceMap(points, landmarks.normals, error**2 * np.eye(3 * len(points)))
