"""A scene, and its state at one instant."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import cv2
import numpy as np

from estimation import se3
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST
from hardware.simulator.scene.appearance import (
    Appearance,
    Drape,
    Lamp,
    backdrop,
    drape_over,
    lamps,
    node_axes,
)
from hardware.simulator.scene.fields import Field, Gel, Layers, PrintedBeads
from hardware.simulator.scene.nozzle import passing_light
from hardware.simulator.scene.rays import HeightField, RenderView, height_field
from hardware.simulator.scene.shape import Deformation, Shape
from hardware.simulator.scene.textures import draped_heights, half_opening, paint_layers
from perception.frames import Roi

UNDEFORMED = Deformation()


@dataclass(frozen=True, slots=True, eq=False)
class PaintedScene:
    """The parts of a scene that take a second to make."""

    node_heights: Field  # (H, W) mm, at rest
    relief: HeightField  # of these
    layers: Layers
    sheet: Drape
    ink: PrintedBeads


class Scene:
    """A body before the cameras; same arguments, same pictures. It is painted at its first use.

    base_from_rest: (4, 4) mm, base_from_surface at rest, for the far cloth and the lamps. Only `ink` changes: pictures
    rendered after a bead was laid show it. gel: of printed beads; None: as ink.
    """

    def __init__(
        self,
        shape: Shape,
        look: Appearance | None = None,
        deformation: Deformation = UNDEFORMED,
        seed: int = 0,
        base_from_rest: Array = BASE_FROM_REST,
        gel: Gel | None = None,
    ) -> None:
        self.gel = gel  # to be set before the first use
        self._bead_relief: tuple[int, HeightField] | None = None  # version of the beads, and the heights with them
        self.shape, self.look, self.deformation = shape, look or Appearance(), deformation
        self.base_from_rest = base_from_rest @ shape.surface_from_grid  # of the grid
        self._seed = seed
        self._painted: PaintedScene | None = None
        self._views: dict[Camera, RenderView] = {}
        self._lock = threading.Lock()

    @property
    def layers(self) -> Layers:
        """The textures of the shape."""
        return self._get_painted().layers

    @property
    def sheet(self) -> Drape:
        """The cloth about it."""
        return self._get_painted().sheet

    @property
    def ink(self) -> PrintedBeads:
        """The printed beads."""
        return self._get_painted().ink

    @property
    def bead_hash(self) -> bytes:
        """A hash of the printed beads, without painting the scene; empty before the first bead."""
        return b"" if self._painted is None else self._painted.ink.bead_hash

    def _get_painted(self) -> PaintedScene:
        with self._lock:
            if self._painted is None:
                shape, look, rng = self.shape, self.look, np.random.default_rng([self._seed, 23])
                half = half_opening(shape) if look.drape else None
                heights = draped_heights(shape, half)
                layers = paint_layers(shape, heights, half, look, self._seed)
                cloth = backdrop(look, rng) if half is None else drape_over(shape, half, look, rng)
                beads = PrintedBeads(layers, self.gel)
                self._painted = PaintedScene(heights, height_field(heights), layers, cloth, beads)
            return self._painted

    def heights(self, amount: float) -> HeightField:
        """Heights on the nodes of material points under `amount` of the deformation, including the drape's hem."""
        painted, shape = self._get_painted(), self.shape
        relief = self._with_beads(painted)
        if not amount * self.deformation.bulge:
            return relief
        lift = self.deformation.lift(np.stack(node_axes(shape.size, shape.step), -1), amount)
        return height_field(relief.height + lift.astype(np.float32))

    def _with_beads(self, painted: PaintedScene) -> HeightField:
        beads = painted.ink
        if beads.gel is None or not beads.version:
            return painted.relief
        if self._bead_relief is None or self._bead_relief[0] != beads.version:
            bead_heights = beads.heights(self.shape.size, self.shape.step)
            self._bead_relief = beads.version, height_field(painted.node_heights + bead_heights)
        return self._bead_relief[1]

    @property
    def opening(self) -> tuple[float, float]:
        """Sides (x, y) mm of the uncovered part of the shape."""
        if not self.look.drape:
            return self.shape.size
        half = half_opening(self.shape)
        return 2 * half[0], 2 * half[1]

    def view(self, camera: Camera) -> RenderView:
        """The constants of one camera's pictures."""
        with self._lock:
            if camera not in self._views:
                self._views[camera] = RenderView(camera, self.base_from_rest)
            return self._views[camera]


def rois(scene: Scene, rig: Rig, base_from_surface: Array, stamp: float, part: float = 0.8) -> tuple[Roi, ...]:
    """Outlines in each camera of the ellipse that fills the central `part` of the opening."""
    half = part * np.array(scene.opening) / 2
    flat = scene.shape.grid(2.0)
    flat = flat[np.linalg.norm(flat / half, axis=1) <= 1]
    points = se3.transform_points(base_from_surface, scene.shape.points(flat))
    normals = scene.shape.normals(flat) @ base_from_surface[:3, :3].T
    polygons = []
    for number, camera in enumerate(rig.cameras):
        facing = np.einsum("ni,ni->n", normals, camera.base_from_camera[:3, 3] - points) > 0
        pixels, depth = pixels_from_points(camera, points)
        visible = pixels[facing & (depth > 1)].astype(np.float32)
        if len(visible) >= 3:
            polygons.append(Roi(number, stamp, cv2.convexHull(visible).reshape(-1, 2).astype(float)))
    return tuple(polygons)


@dataclass(frozen=True, slots=True, eq=False)
class WorldState:
    """The world in the middle of one exposure: the interface from the simulated motion to its pictures."""

    stamp: float  # s, true time
    exposure: float  # s, duration, centred on it
    base_from_surface: Array  # (4, 4) mm
    twist: Array  # (6,) body velocity of the surface, rad/s and mm/s
    strain: float = 0.0  # amount of the scene's deformation, 1 as specified
    base_from_nozzle: Array | None = None  # (4, 4) mm, tip at the origin, z back into the tool
    gain: float = 1.0  # of the exposure, 1 is nominal, in linear light


SHADOW_STEP = 0.5  # mm: a needle's shadow is 0.7 mm wide


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """A scene at one instant, shared by all its cameras."""

    scene: Scene
    instant: WorldState
    base_from_grid: Array  # (4, 4) mm
    relief: HeightField  # deformed heights on the nodes of material points
    factors: tuple[float, float]  # stretch of material lengths x, y
    lamps: tuple[Lamp, Lamp]
    towards: Array  # (2, 3) the lamps' directions, grid frame
    shadow: Field | None  # (h, w, 4) share of each lamp's light, twice, nodes SHADOW_STEP apart; None without a nozzle


def scene_state(scene: Scene, instant: WorldState) -> SceneState:
    """The state of a scene at `instant`."""
    shape, lamp_pair = scene.shape, lamps(scene.look)
    base_from_grid = instant.base_from_surface @ shape.surface_from_grid
    rest_from_grid = se3.inverse(scene.base_from_rest) @ base_from_grid
    relief = scene.heights(instant.strain)
    towards = np.stack([lamp.towards for lamp in lamp_pair]) @ rest_from_grid[:3, :3]
    factors = scene.deformation.factors(instant.strain)
    shadow = None
    if instant.base_from_nozzle is not None:
        stride = max(1, round(SHADOW_STEP / shape.step))
        z = relief.height[::stride, ::stride]
        x = (np.arange(z.shape[1], dtype=np.float32) * stride * shape.step - shape.size[0] / 2) * factors[0]
        y = (np.arange(z.shape[0], dtype=np.float32) * stride * shape.step - shape.size[1] / 2) * factors[1]
        nozzle_from_base = se3.inverse(instant.base_from_nozzle)
        points = transform_fields(nozzle_from_base @ base_from_grid, x[None], y[:, None], z)
        nozzle_from_rest = nozzle_from_base @ scene.base_from_rest
        shares = [passing_light(points, nozzle_from_rest, lamp) for lamp in lamp_pair]
        shadow = np.dstack([*shares, *shares])
    return SceneState(scene, instant, base_from_grid, relief, factors, lamp_pair, towards, shadow)


def transform_fields(transform: Array, x: Field, y: Field, z: Field) -> tuple[Field, Field, Field]:
    """Points x, y, z (H, W) each, transformed by (4, 4)."""
    m = transform.astype(np.float32)
    a, b, c = (np.asarray(m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3], np.float32) for i in range(3))
    return a, b, c


def rotate_rays(rotation: Array, x: Field, y: Field) -> tuple[Field, Field, Field]:
    """Directions x, y, z (H, W) each, of rays (x, y, 1) rotated by (3, 3)."""
    m = rotation.astype(np.float32)
    a, b, c = (np.asarray(m[i, 0] * x + m[i, 1] * y + m[i, 2], np.float32) for i in range(3))
    return a, b, c
