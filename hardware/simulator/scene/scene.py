"""A scene, its state at one instant, and the print head in it.

The print head is a needle, its hub, a cartridge and its holder: frustums about one axis.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from estimation import se3
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST
from hardware.simulator.scene import ray_kernels
from hardware.simulator.scene.appearance import (
    Appearance,
    Drape,
    Lamp,
    backdrop,
    drape_over,
    lamps,
    node_axes,
)
from hardware.simulator.scene.fields import Field, Gel, Layers, PrintedBeads, as_field, linear_light
from hardware.simulator.scene.rays import HeightField, RenderView, height_field
from hardware.simulator.scene.shape import Deformation, Shape
from hardware.simulator.scene.textures import draped_heights, half_opening, paint_layers
from perception.frames import Roi

UNDEFORMED = Deformation()


@dataclass(frozen=True, slots=True, eq=False)
class PaintedScene:
    """What takes a second to make."""

    node_heights: Field  # (H, W) mm, at rest
    relief: HeightField  # of these
    layers: Layers
    sheet: Drape
    ink: PrintedBeads


class Scene:
    """A body before the cameras; same arguments, same pictures. It is painted when somebody first looks.

    base_from_rest: (4, 4) mm, base_from_surface when nothing moves: there the far cloth lies and over it hang lamps.
    Only `ink` changes: pictures rendered after a bead was laid show it. gel: how what is printed lies; None: as ink.
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
        self.gel = gel  # to be set before somebody looks
        self._raised: tuple[int, HeightField] | None = None  # version of the beads, and the heights with them
        self.shape, self.look, self.deformation = shape, look or Appearance(), deformation
        self.base_from_rest = base_from_rest @ shape.surface_from_grid  # of the grid
        self._seed = seed
        self._painted: PaintedScene | None = None
        self._views: dict[Camera, RenderView] = {}
        self._lock = threading.Lock()

    @property
    def layers(self) -> Layers:
        """What is painted on the shape."""
        return self._get_painted().layers

    @property
    def sheet(self) -> Drape:
        """The cloth round it."""
        return self._get_painted().sheet

    @property
    def ink(self) -> PrintedBeads:
        """What was printed on it."""
        return self._get_painted().ink

    @property
    def laid(self) -> bytes:
        """A hash of what was printed on it, without painting it; empty before the first bead."""
        return b"" if self._painted is None else self._painted.ink.laid

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
        """Heights on the nodes of material points under `amount` of the deformation, the drape's hem among them."""
        painted, shape = self._get_painted(), self.shape
        still = self._with_beads(painted)
        if not amount * self.deformation.bulge:
            return still
        lift = self.deformation.lift(np.stack(node_axes(shape.size, shape.step), -1), amount)
        return height_field(still.height + lift.astype(np.float32))

    def _with_beads(self, painted: PaintedScene) -> HeightField:
        beads = painted.ink
        if beads.gel is None or not beads.version:
            return painted.relief
        if self._raised is None or self._raised[0] != beads.version:
            laid = beads.heights(self.shape.size, self.shape.step)
            self._raised = beads.version, height_field(painted.node_heights + laid)
        return self._raised[1]

    @property
    def opening(self) -> tuple[float, float]:
        """Sides (x, y) mm of the part of the shape that no cloth covers."""
        if not self.look.drape:
            return self.shape.size
        half = half_opening(self.shape)
        return 2 * half[0], 2 * half[1]

    def view(self, camera: Camera) -> RenderView:
        """What stays the same between the pictures of one camera."""
        with self._lock:
            if camera not in self._views:
                self._views[camera] = RenderView(camera, self.base_from_rest)
            return self._views[camera]


def rois(scene: Scene, rig: Rig, base_from_surface: Array, stamp: float, part: float = 0.8) -> tuple[Roi, ...]:
    """Polygons around what each camera sees of the ellipse that fills the central `part` of the opening."""
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
    """The world in the middle of one exposure: the seam between the simulated motion and the pictures taken of it."""

    stamp: float  # s, true time
    exposure: float  # s, how long the shutter is open about it
    base_from_surface: Array  # (4, 4) mm
    twist: Array  # (6,) body velocity of the surface, rad/s and mm/s
    strain: float = 0.0  # amount of the scene's deformation, 1 as specified
    base_from_nozzle: Array | None = None  # (4, 4) mm, tip at the origin, z back into the tool
    gain: float = 1.0  # of the exposure, 1 is nominal, in linear light


@dataclass(frozen=True, slots=True, eq=False)
class Frustum:
    """One part of the print head."""

    z0: float  # mm above the tip
    z1: float  # mm
    r0: float  # mm, radius at z0
    r1: float  # mm
    colour: Field  # linear BGR
    gloss: float  # 0..1
    metal: bool  # mirrors the room in its own colour


STEEL, PLASTIC, CARTRIDGE, LUER, RING, CAP = (
    linear_light(bgr)
    for bgr in ([176, 178, 180], [190, 198, 198], [136, 176, 204], [62, 92, 196], [104, 106, 110], [150, 112, 62])
)
NOZZLE_PARTS = (
    Frustum(0.0, 2.0, 0.32, 0.42, STEEL, 0.8, True),
    Frustum(2.0, 12.7, 0.42, 0.42, STEEL, 0.8, True),
    Frustum(12.7, 13.6, 0.5, 1.5, LUER, 0.5, False),
    Frustum(13.6, 21.0, 1.5, 2.5, LUER, 0.5, False),
    Frustum(21.0, 23.0, 3.6, 3.6, LUER, 0.5, False),
    Frustum(23.0, 27.0, 2.4, 4.6, PLASTIC, 0.6, False),
    Frustum(27.0, 50.0, 4.6, 4.6, CARTRIDGE, 0.65, False),
    Frustum(50.0, 58.0, 4.6, 4.6, PLASTIC, 0.6, False),
    Frustum(58.0, 76.0, 8.0, 8.0, RING, 0.5, True),
    Frustum(76.0, 78.0, 8.0, 7.0, RING, 0.5, True),
    Frustum(78.0, 88.0, 5.6, 5.2, CAP, 0.4, False),
    Frustum(88.0, 96.0, 2.2, 2.2, STEEL, 0.6, True),
)
NOZZLE_LENGTH = NOZZLE_PARTS[-1].z1
NOZZLE_OUTLINE = np.array(  # heights and radii mm; the steps are bridged
    [(part.z0, part.r0) for part in NOZZLE_PARTS] + [(NOZZLE_LENGTH, NOZZLE_PARTS[-1].r1)], np.float32
)

XYZ = tuple[Field, Field, Field]  # x, y, z


class PartHit(NamedTuple):
    """What rays see of one part, each of their shape."""

    depth: Field  # in lengths of the ray, inf: nothing
    x: Field  # of the normal, like y and z
    y: Field
    z: Field


def part_outline(part: Frustum) -> Array:
    """Points (N, 3) mm, nozzle frame, whose pictures hold the part's."""
    rings = ((part.z0, 1.02 * part.r0), (part.z1, 1.02 * part.r1))
    angles = np.linspace(0, 2 * np.pi, 17)[:-1]
    return np.array([[r * np.cos(a), r * np.sin(a), z] for z, r in rings for a in angles])


def part_hit(part: Frustum, origin: Array, rays: XYZ) -> PartHit:
    """Where rays from `origin` (3,), nozzle frame, meet a part: its side or one of its flat ends."""
    ox, oy, oz = (np.float32(v) for v in origin)
    dx, dy, dz = rays
    k = np.float32((part.r1 - part.r0) / (part.z1 - part.z0))
    r = np.float32(part.r0 + k * (oz - part.z0))
    a = dx * dx + dy * dy - (k * k) * dz * dz
    b = dx * ox + dy * oy - (k * r) * dz
    c = ox * ox + oy * oy - r * r
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = (-b - np.sqrt(b * b - a * c)) / a
        z = oz + depth * dz
        depth = as_field(np.where((depth > 0) & (z >= part.z0) & (z <= part.z1), depth, np.inf))
        x, y = ox + depth * dx, oy + depth * dy
        slant = np.float32(np.hypot(1, k))
        inverse = 1 / (np.hypot(x, y) * slant)
        side_hit = PartHit(depth, x * inverse, y * inverse, np.full_like(x, -k / slant))
        side, height, radius = (1, part.z1, part.r1) if oz > part.z1 else (-1, part.z0, part.r0)
        if part.z0 <= oz <= part.z1:
            return side_hit
        end = (np.float32(height) - oz) / dz
        x, y = ox + end * dx, oy + end * dy
        hit = (end > 0) & (x * x + y * y <= radius * radius) & (end < depth)
    zero = np.zeros_like(end)
    flat_end = end, zero, zero, np.full_like(end, side)
    return PartHit(*(as_field(np.where(hit, a, b)) for a, b in zip(flat_end, side_hit, strict=True)))


def passing_light(points: XYZ, nozzle_from_rest: Array, lamp: Lamp) -> Field:
    """Share of the lamp's light that passes the nozzle, at points given by x, y, z (H, W) mm, nozzle frame.

    The lamp is a disc: the shadow's edge softens with the distance between the nozzle and what it falls on.
    """
    share = np.empty_like(points[2])
    towards = as_field(nozzle_from_rest[:3, :3] @ lamp.towards)
    ray_kernels.pass_nozzle(*points, towards, np.float32(lamp.spread), NOZZLE_OUTLINE, share)
    return share


SHADOW_STEP = 0.5  # mm: a needle's shadow is 0.7 mm wide


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """A scene at one instant, as all its cameras share it."""

    scene: Scene
    instant: WorldState
    base_from_grid: Array  # (4, 4) mm
    rest_from_grid: Array  # (4, 4) mm, against the grid at rest
    relief: HeightField  # deformed heights on the nodes of material points
    factors: tuple[float, float]  # by which material lengths x, y are stretched
    lamps: tuple[Lamp, Lamp]
    towards: Array  # (2, 3) the lamps' directions, grid frame
    shadow: Field | None  # (h, w, 4) share of each lamp's light, twice, nodes SHADOW_STEP apart; None without a nozzle


def scene_state(scene: Scene, instant: WorldState) -> SceneState:
    """Work out what the cameras of this instant share."""
    shape, both = scene.shape, lamps(scene.look)
    base_from_grid = instant.base_from_surface @ shape.surface_from_grid
    rest_from_grid = se3.inverse(scene.base_from_rest) @ base_from_grid
    relief = scene.heights(instant.strain)
    towards = np.stack([lamp.towards for lamp in both]) @ rest_from_grid[:3, :3]
    factors = scene.deformation.factors(instant.strain)
    shadow = None
    if instant.base_from_nozzle is not None:
        skip = max(1, round(SHADOW_STEP / shape.step))
        z = relief.height[::skip, ::skip]
        x = (np.arange(z.shape[1], dtype=np.float32) * skip * shape.step - shape.size[0] / 2) * factors[0]
        y = (np.arange(z.shape[0], dtype=np.float32) * skip * shape.step - shape.size[1] / 2) * factors[1]
        nozzle_from_base = se3.inverse(instant.base_from_nozzle)
        points = transform_fields(nozzle_from_base @ base_from_grid, x[None], y[:, None], z)
        nozzle_from_rest = nozzle_from_base @ scene.base_from_rest
        passed = [passing_light(points, nozzle_from_rest, lamp) for lamp in both]
        shadow = np.dstack([*passed, *passed])
    return SceneState(scene, instant, base_from_grid, rest_from_grid, relief, factors, both, towards, shadow)


def transform_fields(transform: Array, x: Field, y: Field, z: Field) -> tuple[Field, Field, Field]:
    """Points x, y, z (H, W) each, carried by a transform (4, 4)."""
    m = transform.astype(np.float32)
    a, b, c = (np.asarray(m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3], np.float32) for i in range(3))
    return a, b, c


def rotate_rays(rotation: Array, x: Field, y: Field) -> tuple[Field, Field, Field]:
    """Directions x, y, z (H, W) each, of rays (x, y, 1) carried by a rotation (3, 3)."""
    m = rotation.astype(np.float32)
    a, b, c = (np.asarray(m[i, 0] * x + m[i, 1] * y + m[i, 2], np.float32) for i in range(3))
    return a, b, c
