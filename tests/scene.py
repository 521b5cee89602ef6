"""A textured patch, cylindrical or flat, and its exact picture in any camera.

Every pixel is traced back: through the lens, onto the surface (in closed form), into the texture.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import Camera, pixels_from_points
from estimation.se3 import Array
from perception.frames import Image
from perception.lens import undistort
from tests import skin
from tests.skin import Picture

Box = tuple[int, int, int, int]  # x0, y0, x1, y1 px, the last two not included

TARGET = np.array([180.0, 40.0, 60.0])  # mm, base frame: the middle of the room, where the patch rests
LIGHT = np.array([0.35, 0.35, 0.87])  # unit, base frame, towards the lamp
ROOM = 900.0  # mm: the background is a sphere of cloth about the patch
CLOTH_TEXEL = 1.2  # mm
SAMPLES = 2  # per pixel and axis
MARGIN = 4  # texels of nothing around the patch, so that its edge is blended like any other detail


def patch_points(flat: Array, radius: float) -> Array:
    """Points (N, 3) mm, surface frame, at (x, arc) (N, 2) mm of a patch bent to `radius` mm (inf: flat)."""
    if np.isinf(radius):
        return np.column_stack([flat, np.zeros(len(flat))])
    angle = flat[:, 1] / radius
    return np.column_stack([flat[:, 0], radius * np.sin(angle), radius * (np.cos(angle) - 1)])


class Scene:
    """A patch of `size` (x, y) mm, bent about its x axis to `radius` mm (inf: flat), its z out of the surface.

    Its points are named by (x, arc) in mm from the middle of the patch. texture: (H, W, 3) BGR over the whole patch,
    skin with a wound by default. noise: grey levels, one standard deviation. Same seed, same pictures.
    """

    def __init__(
        self,
        seed: int = 0,
        size: tuple[float, float] = (80.0, 60.0),
        radius: float = 70.0,
        texture: Image | None = None,
        texel: float = 0.15,
        noise: float = 1.5,
        colour: bool = True,
    ) -> None:
        rng = np.random.default_rng([seed, 7])
        self.size, self.radius, self.texel, self.colour = size, radius, texel, colour
        texture = skin.skin(size, texel, rng) if texture is None else texture
        opaque = np.full(texture.shape[:2], 255, np.uint8)
        layers = np.dstack([texture if colour else cv2.cvtColor(texture, cv2.COLOR_BGR2GRAY), opaque])
        self._layers = cv2.copyMakeBorder(layers, *[MARGIN] * 4, cv2.BORDER_CONSTANT, value=0)  # colours, opacity
        self._cloth = skin.cloth(1024, rng)
        self._noise, self._seed = noise, seed
        self._grain: dict[tuple[int, int], NDArray[np.int16]] = {}
        self._views: dict[Camera, View] = {}

    def points(self, flat: Array) -> Array:
        """Points (N, 3) mm, surface frame, at (x, arc) (N, 2) mm."""
        return patch_points(flat, self.radius)

    def normals(self, flat: Array) -> Array:
        """Unit normals (N, 3), surface frame, out of the surface, at (x, arc) (N, 2) mm."""
        angle = flat[:, 1] / self.radius
        return np.column_stack([np.zeros(len(flat)), np.sin(angle), np.cos(angle)])

    def grid(self, step: float, part: float = 1.0) -> Array:
        """(x, arc) (N, 2) mm, row by row, over the central `part` of the patch, about `step` mm apart."""
        x, y = (np.linspace(-0.5, 0.5, round(part * s / step) + 1) * part * s for s in self.size)
        return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)

    def intersect(self, origin: Array, directions: Array) -> Array:
        """(x, arc) (..., 2) mm where rays from `origin` (3,) along (..., 3), surface frame, meet it first; else NaN."""
        dx, dy, dz = directions[..., 0], directions[..., 1], directions[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            if np.isinf(self.radius):
                t = np.where(dz < 0, -origin[2] / dz, np.nan)
                return np.stack([origin[0] + t * dx, origin[1] + t * dy], -1)
            y, z = origin[1], origin[2] + self.radius
            a, b, c = dy * dy + dz * dz, y * dy + z * dz, y * y + z * z - self.radius**2
            t = (-b - np.sqrt(b * b - a * c)) / a
        return np.stack([origin[0] + t * dx, self.radius * np.arctan2(y + t * dy, z + t * dz)], -1)

    def colours(self, flat: Array) -> Picture:
        """Colours and opacity, 0..255, (H, W, 4) or (H, W, 2), at (x, arc) (H, W, 2) mm; 0 off the patch."""
        texels = (flat + np.array(self.size) / 2) / self.texel + MARGIN - 0.5
        texels = np.nan_to_num(texels, nan=-1e4).astype(np.float32)
        return np.asarray(cv2.remap(self._layers, texels, None, cv2.INTER_LINEAR), np.float32)

    def view(self, camera: Camera) -> View:
        """What stays the same between the pictures of one camera."""
        if camera not in self._views:
            self._views[camera] = View(camera, self._background(camera))
        return self._views[camera]

    def _background(self, camera: Camera) -> Image:
        """The room as this camera sees it, (H, W, 3) or (H, W)."""
        rays = _rays(camera, (0, 0, *camera.size), 1) @ camera.base_from_camera[:3, :3].T
        origin = camera.base_from_camera[:3, 3] - TARGET
        b, a = rays @ origin, np.einsum("...i,...i->...", rays, rays)
        t = (-b + np.sqrt(b * b - a * (origin @ origin - ROOM**2))) / a
        hit = (origin + t[..., None] * rays) / ROOM
        angles = np.stack([np.arctan2(hit[..., 1], -hit[..., 2]), np.arcsin(np.clip(hit[..., 0], -1, 1))], -1)
        texels = np.mod(ROOM / CLOTH_TEXEL * angles, len(self._cloth)).astype(np.float32)
        image = cv2.remap(cv2.copyMakeBorder(self._cloth, 0, 1, 0, 1, cv2.BORDER_WRAP), texels, None, cv2.INTER_LINEAR)
        return np.asarray(image if self.colour else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)

    def add_grain(self, image: Image, rng: np.random.Generator) -> Image:
        """The image with sensor noise: a cut at random from one large field (drawing anew is ten times slower)."""
        if not self._noise:
            return image
        h, w = image.shape[:2]
        if (h, w) not in self._grain:
            rng_of_field = np.random.default_rng([self._seed, h, w])
            field = rng_of_field.standard_normal((h + 256, w + 256, *image.shape[2:]), np.float32)
            self._grain[h, w] = np.rint(self._noise * field).astype(np.int16)
        y, x = rng.integers(0, 256, 2)
        return np.asarray(cv2.add(image, self._grain[h, w][y : y + h, x : x + w], dtype=cv2.CV_8U), np.uint8)


class View:
    """One camera's background, and the rays through the part of its image that was last needed."""

    def __init__(self, camera: Camera, background: Image) -> None:
        self.camera, self.background = camera, background
        self._box, self._directions = (0, 0, 0, 0), np.zeros((0, 0, 3))

    def rays(self, box: Box) -> tuple[Box, Array]:
        """A box that holds `box`, and the rays (H, W, 3) of its samples in the camera frame."""
        held = self._box
        if not (held[0] <= box[0] and held[1] <= box[1] and held[2] >= box[2] and held[3] >= box[3]):
            w, h = self.camera.size
            self._box = (max(0, box[0] - 24), max(0, box[1] - 24), min(w, box[2] + 24), min(h, box[3] + 24))
            self._directions = _rays(self.camera, self._box, SAMPLES)
        return self._box, self._directions


def _rays(camera: Camera, box: Box, samples: int) -> Array:
    """Directions (H, W, 3), camera frame, of `samples` a pixel and axis over the box."""
    x, y = (np.arange((b - a) * samples) / samples + a - 0.5 + 0.5 / samples for a, b in (box[::2], box[1::2]))
    pixels = np.stack(np.meshgrid(x, y), -1)
    ideal = undistort(camera, pixels.reshape(-1, 2)).reshape(pixels.shape)
    return np.dstack([(ideal - camera.matrix[:2, 2]) / camera.matrix[[0, 1], [0, 1]], np.ones(pixels.shape[:2])])


def _box(scene: Scene, camera: Camera, base_from_surface: Array) -> Box | None:
    """The part of the image that the patch can touch, None if it is out of view."""
    points = se3.transform_points(base_from_surface, scene.points(scene.grid(4.0)))
    pixels, depth = pixels_from_points(camera, points)
    if (depth < 1).any():
        return None
    low = np.clip(np.floor(pixels.min(0)) - 3, 0, camera.size).astype(int)
    high = np.clip(np.ceil(pixels.max(0)) + 4, 0, camera.size).astype(int)
    return (int(low[0]), int(low[1]), int(high[0]), int(high[1])) if (high > low).all() else None


def render_one(scene: Scene, camera: Camera, base_from_surface: Array) -> Image:
    """One camera's image without sensor noise, (H, W, 3) BGR or (H, W) grey."""
    view = scene.view(camera)
    image = view.background.copy()
    needed = _box(scene, camera, base_from_surface)
    if needed is None:
        return image
    (x0, y0, x1, y1), rays = view.rays(needed)
    surface_from_camera = se3.inverse(base_from_surface) @ camera.base_from_camera
    flat = scene.intersect(surface_from_camera[:3, 3], rays @ surface_from_camera[:3, :3].T)
    layers = scene.colours(flat)
    light = base_from_surface[:3, :3].T @ LIGHT
    bend = np.nan_to_num(flat[..., 1] / scene.radius)
    shade = 0.45 + 0.55 * np.clip(light[1] * np.sin(bend) + light[2] * np.cos(bend), 0, None)
    layers[..., :-1] *= shade[..., None].astype(np.float32)
    layers = cv2.resize(layers, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)  # the mean of each pixel's samples
    behind = image[y0:y1, x0:x1].reshape(y1 - y0, x1 - x0, -1)
    mixed = layers[..., :-1] + (1 - layers[..., -1:] / 255) * behind
    image[y0:y1, x0:x1] = np.clip(np.rint(mixed), 0, 255).reshape(image[y0:y1, x0:x1].shape)
    return image
