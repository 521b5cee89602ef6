"""A scene at one instant, in its grid frame: what the cameras of that instant share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.se3 import Array
from hardware.simulator import nozzle_shape
from hardware.simulator.field import Field
from hardware.simulator.hits import Relief
from hardware.simulator.instant import Instant
from hardware.simulator.lamps import Lamp, lamps
from hardware.simulator.scene.scene import Scene

SHADOW_STEP = 0.5  # mm: a needle's shadow is 0.7 mm wide


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """A scene at one instant.

    base_from_grid: (4, 4). rest_from_grid: (4, 4), where the grid stands against its rest. relief: deformed heights on
    the nodes of material points. factors: by which material lengths x, y are stretched. lamps: their directions in the
    grid frame. shadow: (h, w, 2) share of each lamp's light, nodes SHADOW_STEP apart; None without a nozzle.
    """

    scene: Scene
    instant: Instant
    base_from_grid: Array
    rest_from_grid: Array
    relief: Relief
    factors: tuple[float, float]
    lamps: tuple[Lamp, Lamp]
    towards: Array  # (2, 3)
    shadow: Field | None


def state(scene: Scene, instant: Instant) -> State:
    """Work out what the cameras of this instant share."""
    base_from_grid = instant.base_from_surface @ scene.shape.surface_from_grid
    rest_from_grid = se3.inverse(scene.base_from_rest) @ base_from_grid
    deformed = scene.heights(instant.strain)
    both = lamps(scene.look)
    towards = np.stack([lamp.towards for lamp in both]) @ rest_from_grid[:3, :3]
    factors = scene.deformation.factors(instant.strain)
    shadow = _shadow(scene, instant, base_from_grid, deformed, factors, both)
    return State(scene, instant, base_from_grid, rest_from_grid, deformed, factors, both, towards, shadow)


def _shadow(
    scene: Scene,
    instant: Instant,
    base_from_grid: Array,
    relief: Relief,
    factors: tuple[float, float],
    both: tuple[Lamp, Lamp],
) -> Field | None:
    if instant.base_from_nozzle is None:
        return None
    skip = max(1, round(SHADOW_STEP / scene.shape.step))
    z = relief.height[::skip, ::skip]
    x = (np.arange(z.shape[1], dtype=np.float32) * skip * scene.shape.step - scene.shape.size[0] / 2) * factors[0]
    y = (np.arange(z.shape[0], dtype=np.float32) * skip * scene.shape.step - scene.shape.size[1] / 2) * factors[1]
    nozzle_from_base = se3.inverse(instant.base_from_nozzle)
    points = moved(nozzle_from_base @ base_from_grid, x[None], y[:, None], z)
    nozzle_from_rest = nozzle_from_base @ scene.base_from_rest
    return np.dstack([nozzle_shape.lit(points, nozzle_from_rest, lamp) for lamp in both])


def moved(transform: Array, x: Field, y: Field, z: Field) -> tuple[Field, Field, Field]:
    """Points x, y, z (H, W) each, carried by a transform (4, 4)."""
    m = transform.astype(np.float32)
    a, b, c = (np.asarray(m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3], np.float32) for i in range(3))
    return a, b, c


def turned(rotation: Array, x: Field, y: Field) -> tuple[Field, Field, Field]:
    """Directions x, y, z (H, W) each, of rays (x, y, 1) carried by a rotation (3, 3)."""
    m = rotation.astype(np.float32)
    a, b, c = (np.asarray(m[i, 0] * x + m[i, 1] * y + m[i, 2], np.float32) for i in range(3))
    return a, b, c
