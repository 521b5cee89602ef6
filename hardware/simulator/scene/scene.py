"""A scene: a shape, what is painted on it, the cloth round it, the lamps above it."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import cv2
import numpy as np

from estimation import se3
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST
from hardware.simulator import paint
from hardware.simulator.deformation import Deformation
from hardware.simulator.field import Field
from hardware.simulator.hits import Relief, relief_of
from hardware.simulator.layers import Layers
from hardware.simulator.look import Look
from hardware.simulator.scene import drape as sheet
from hardware.simulator.scene.appearance import Ink
from hardware.simulator.scene.drape import Sheet
from hardware.simulator.scene.rays import View
from hardware.simulator.scene.shape import Shape
from perception.frames import Roi

STILL = Deformation()


@dataclass(frozen=True, slots=True, eq=False)
class Painted:
    """What takes a second to make. bare: height in mm of the nodes, (H, W); relief: of these, at rest."""

    bare: Field
    relief: Relief
    layers: Layers
    sheet: Sheet
    ink: Ink


class Scene:
    """A body before the cameras; same arguments, same pictures. It is painted when somebody first looks.

    base_from_rest: (4, 4) mm, base_from_surface when nothing moves: there the far cloth lies and over it hang lamps.
    Only `ink` changes: pictures rendered after a bead was laid show it.
    """

    def __init__(
        self,
        shape: Shape,
        look: Look | None = None,
        deformation: Deformation = STILL,
        seed: int = 0,
        base_from_rest: Array = REST,
    ) -> None:
        self.shape, self.look, self.deformation = shape, look or Look(), deformation
        self.base_from_rest = base_from_rest @ shape.surface_from_grid  # of the grid
        self._seed = seed
        self._painted: Painted | None = None
        self._views: dict[Camera, View] = {}
        self._lock = threading.Lock()

    @property
    def layers(self) -> Layers:
        """What is painted on the shape."""
        return self._looked_at().layers

    @property
    def sheet(self) -> Sheet:
        """The cloth round it."""
        return self._looked_at().sheet

    @property
    def ink(self) -> Ink:
        """What was printed on it."""
        return self._looked_at().ink

    def _looked_at(self) -> Painted:
        with self._lock:
            if self._painted is None:
                self._painted = self._paint()
            return self._painted

    def _paint(self) -> Painted:
        shape, look, rng = self.shape, self.look, np.random.default_rng([self._seed, 23])
        half = paint.half_opening(shape) if look.drape else None
        bare = paint.relief(shape, half)
        layers = paint.paint(shape, bare, half, look, self._seed)
        cloth = sheet.bare(look, rng) if half is None else sheet.draped(shape, half, look, rng)
        return Painted(bare, relief_of(bare), layers, cloth, Ink(layers))

    def heights(self, amount: float) -> Relief:
        """Heights on the nodes of material points under `amount` of the deformation, the drape's hem among them."""
        painted = self._looked_at()
        if not amount * self.deformation.bulge:
            return painted.relief
        lift = self.deformation.lift(np.stack(sheet.axes(self.shape.size, self.shape.step), -1), amount)
        return relief_of(painted.bare + lift.astype(np.float32))

    @property
    def opening(self) -> tuple[float, float]:
        """Sides (x, y) mm of the part of the shape that no cloth covers."""
        if not self.look.drape:
            return self.shape.size
        half = paint.half_opening(self.shape)
        return 2 * half[0], 2 * half[1]

    def view(self, camera: Camera) -> View:
        """What stays the same between the pictures of one camera."""
        with self._lock:
            if camera not in self._views:
                self._views[camera] = View(camera, self.base_from_rest)
            return self._views[camera]


def rois(scene: Scene, rig: Rig, base_from_surface: Array, stamp: float, part: float = 0.8) -> tuple[Roi, ...]:
    """Polygons around what each camera sees of the ellipse that fills the central `part` of the opening."""
    half = part * np.array(scene.opening) / 2
    flat = scene.shape.grid(2.0)
    flat = flat[np.linalg.norm(flat / half, axis=1) <= 1]
    points = se3.transform_points(base_from_surface, scene.shape.points(flat))
    normals = scene.shape.normals(flat) @ base_from_surface[:3, :3].T
    found = []
    for number, camera in enumerate(rig.cameras):
        facing = np.einsum("ni,ni->n", normals, camera.base_from_camera[:3, 3] - points) > 0
        pixels, depth = pixels_from_points(camera, points)
        seen = pixels[facing & (depth > 1)].astype(np.float32)
        if len(seen) >= 3:
            found.append(Roi(number, stamp, cv2.convexHull(seen).reshape(-1, 2).astype(float)))
    return tuple(found)
