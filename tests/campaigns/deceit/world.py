"""The world and its pictures: a textured relief that moves over a table, what lies on it, the light, and the sensor.

Every pixel's ray is put into the surface's frame and meets the relief by fixed-point steps; textures are looked up
there. Nothing here is the simulator's. Frames: `base` (the table at z = 0, z up), `surface` (of the tissue, z out of
it), `camera`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numba import njit

from estimation import se3
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from perception.frames import Frame, FrameSet, Image
from tests.campaigns.deceit.looks import Field, Texture, noise

Motion = Callable[[float], Array]  # (4, 4) at an instant, s
Number = Callable[[float], float]
Shift = Callable[[float], tuple[float, float]]  # mm, at an instant
COMPILE = {"cache": True, "nogil": True, "error_model": "numpy"}

# Of the fixed point, from height 0 or from the pixels beside: each leaves 0.4 of the error at the steepest place
FAR_STEPS, NEAR_STEPS = 8, 2
RELIEF_SCALE = 2.0  # grid points a mm
SHUTTER_KNOTS = 9  # poses over the rows of a rolling shutter, straight lines between them
PSF = 0.55  # px, one sigma of lens and pixel
SHOT, READ = 1.0e-4, 2.0e-3  # of full scale: variance a unit of light, deviation in the dark: 1.2 grey levels
LAMP_HEIGHT = 900.0  # mm above the table
AMBIENT = 0.45  # share of the light that comes from everywhere
TO_LAMP = np.array([0.25, -0.3, 0.92])
NOISE = np.sqrt(SHOT * np.linspace(0, 1, 4096) + READ**2)  # of photons and of reading
GAMMA = np.array([round(255 * (i / 4095) ** (1 / 2.2)) for i in range(4096)], np.uint8)


def still(_: float) -> tuple[float, float]:
    """No shift."""
    return 0.0, 0.0


def steady(value: float) -> Number:
    """The same at every instant."""
    return lambda _: value


NOTHING, UNCHANGED, SHARP = steady(0.0), steady(1.0), steady(PSF)


@dataclass(frozen=True, slots=True, eq=False)
class Relief:
    """Heights of the tissue at rest over a square about its origin, and where it rises."""

    grid: Field  # (N, N, 3) mm and slopes along x and y, RELIEF_SCALE points a mm
    half: tuple[float, float]  # mm, half lengths of the outline, a rounded rectangle
    round: bool = True
    rise: Number = NOTHING  # mm, by which the middle of the bump has risen
    centre: tuple[float, float] = (0.0, 0.0)  # mm, of the bump
    sigma: float = 9.0  # mm, of the bump


def relief(heights: Field, half: tuple[float, float]) -> Relief:
    """The relief of heights (N, N), mm."""
    slopes = [np.gradient(heights, axis=axis) * RELIEF_SCALE for axis in (1, 0)]
    return Relief(np.ascontiguousarray(np.stack([heights, *slopes], -1), np.float32), half)


@dataclass(frozen=True, slots=True, eq=False)
class Decal:
    """What lies flat on the tissue."""

    texture: Texture
    scale: float  # texels a mm
    shift: Shift = still  # mm in the surface frame


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """A flat thing above: a hand, a cloth."""

    texture: Texture
    scale: float  # texels a mm
    base_from_sheet: Motion


@dataclass(frozen=True, slots=True, eq=False)
class Gloss:
    """A wet film that mirrors the lamp."""

    film: Field  # (N, N, 3) slopes and gloss, 4 texels a mm
    panel: Field  # (M, M) brightness of the lamp, 1 texel a mm
    shift: Shift = still  # of the film over the tissue, mm


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """How one camera shows the world."""

    time: Number = float  # s, of the world that it shows
    gain: Number = UNCHANGED
    blur: Number = SHARP  # px, one sigma
    flip: str = ""  # or "mirror", "turn"
    shows: int | None = None  # whose picture; None: its own
    offset: float = 0.0  # s, by which it exposes later than stamped


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """All that pictures are made of."""

    rig: Rig  # as it is
    base_from_surface: Motion
    relief: Relief
    skin: Callable[[float], Texture]  # SKIN_SCALE texels a mm
    skin_scale: float
    table: Texture
    table_scale: float
    decals: tuple[Decal, ...] = ()
    sheets: tuple[Sheet, ...] = ()
    light: Field = field(default_factory=lambda: np.ones((2, 2), np.float32))  # as it falls on the table; (2, 2): even
    light_scale: float = 1.0  # texels a mm
    light_shift: Shift = still
    gloss: Gloss | None = None
    views: tuple[View, ...] = (View(), View(), View())
    exposure: float = 0.004  # s
    samples: int = 1  # instants within the exposure
    readout: float = 0.0  # s, from the first row to the last
    shimmer: float = 0.0  # px, one sigma of the air's warp
    ripple: float = 0.0  # of a lamp on 50 Hz mains, seen in rows
    seed: int = 0


def local_places(relief: Relief, points: Array, stamp: float) -> Array:
    """Points (N, 3) of the surface frame that lie on the tissue at rest, where they are at `stamp`, s."""
    away = ((points[:, :2] - np.array(relief.centre)) ** 2).sum(-1)
    moved = points.copy()
    moved[:, 2] += relief.rise(stamp) * np.exp(-away / (2 * relief.sigma**2))
    return moved


def on_tissue(relief: Relief, xy: Array) -> Array:
    """Points (N, 3) of the tissue at rest at x and y (N, 2), mm, surface frame."""
    n = len(relief.grid)
    place = (xy * RELIEF_SCALE + (n - 1) / 2).astype(np.float32)
    heights = cv2.remap(relief.grid[..., 0], place[None, :, 0], place[None, :, 1], cv2.INTER_LINEAR)[0]
    return np.c_[xy, heights.astype(float)]


class Renderer:
    """Makes the pictures of one world; remembers what stays as it is."""

    def __init__(self, world: World) -> None:
        self.world = world
        self._rays = [_rays(camera) for camera in world.rig.cameras]
        self._tables = [self._table(camera, rays) for camera, rays in zip(world.rig.cameras, self._rays, strict=True)]

    def frame_set(self, number: int, stamp: float) -> FrameSet:
        """The pictures of the instant `stamp`, s, the set's number in the session."""
        frames = [Frame(c, stamp, self.picture(c, number, stamp)) for c in range(len(self.world.rig))]
        return FrameSet(stamp, tuple(frames))

    def picture(self, camera: int, number: int, stamp: float) -> Image:
        """What a camera gives at `stamp`, s: (H, W, 3) BGR."""
        world, view = self.world, self.world.views[camera]
        shown = camera if view.shows is None else view.shows
        moment = view.time(stamp) + view.offset
        light = self.radiance(shown, moment)
        light = cv2.GaussianBlur(light, (0, 0), view.blur(stamp))
        h = light.shape[0]
        rows = stamp + (np.arange(h) / h - 0.5) * max(world.readout, 0.015)
        gains = view.gain(stamp) * (1 + world.ripple * np.sin(2 * math.pi * 100 * rows))
        image = np.empty(light.shape, np.uint8)
        _sense(light, gains.astype(np.float32), NOISE, _hash(world.seed, camera, number), GAMMA, image)
        if view.flip:
            image = np.ascontiguousarray(image[:, ::-1] if view.flip == "mirror" else image[::-1, ::-1])
        return image

    def radiance(self, camera: int, moment: float) -> Field:
        """Light (H, W, 3) that falls on a camera's pixels about an instant, s, before lens and sensor."""
        world = self.world
        spread = (np.arange(world.samples) + 0.5) / world.samples - 0.5
        parts = [self._instant(camera, moment + world.exposure * float(s)) for s in spread]
        return parts[0] if len(parts) == 1 else np.mean(parts, axis=0, dtype=np.float32)

    def _instant(self, camera: int, t: float) -> Field:
        world, shape = self.world, self._rays[camera].shape[:2]
        rays = self._rays[camera] if world.shimmer == 0 else self._shimmering(camera, t)
        base_from_camera = world.rig.cameras[camera].base_from_camera
        base_from_surface = _by_rows(world.base_from_surface, t, world.readout, shape[0])
        surface_from_camera = np.ascontiguousarray((se3.inverse(base_from_surface) @ base_from_camera)[:, :3])
        hits = np.empty((*shape, 9), np.float32)
        lie = world.relief
        outline = np.array([*lie.half, float(lie.round)])
        bump = np.array([lie.rise(t), *lie.centre, lie.sigma])
        poses = np.ascontiguousarray(base_from_surface[:, :3])
        _trace(rays, base_from_camera[:3].copy(), surface_from_camera, poses, lie.grid, outline, bump, hits)
        image = self._tables[camera].copy()
        _lay(image, hits, world.skin(t), world.skin_scale, 0.0, 0.0)
        for decal in world.decals:
            _lay(image, hits, decal.texture, decal.scale, *decal.shift(t))
        place = base_from_camera[:3, 3].copy()
        lamp = TO_LAMP / np.linalg.norm(TO_LAMP)
        _shine(image, hits, world.light, world.light_scale, *world.light_shift(t), lamp, AMBIENT)
        if (gloss := world.gloss) is not None:
            _glisten(image, hits, gloss.film, *gloss.shift(t), gloss.panel, place, poses[len(poses) // 2].copy())
        for sheet in world.sheets:
            pose = sheet.base_from_sheet(t)
            _cover(image, rays, (se3.inverse(pose) @ base_from_camera)[:3].copy(), sheet.texture, sheet.scale)
        return image

    def _shimmering(self, camera: int, t: float) -> Field:
        """The rays through air of uneven heat: warped smoothly, anew every tenth of a second, and in between."""
        h, w = self._rays[camera].shape[:2]
        step, share = math.floor(t * 10), t * 10 - math.floor(t * 10)
        pixels = np.zeros((12, 12, 2), np.float32)
        for k, weight in ((step, math.cos(share * math.pi / 2)), (step + 1, math.sin(share * math.pi / 2))):
            rng = np.random.default_rng([self.world.seed, camera, k + 1000])
            pixels += np.float32(weight) * np.stack([noise(rng, 12, 1.0) for _ in range(2)], -1)
        warp = cv2.resize(pixels, (w, h), interpolation=cv2.INTER_CUBIC)
        focal = self.world.rig.cameras[camera].matrix[0, 0]
        return np.asarray(self._rays[camera] + np.float32(self.world.shimmer / focal) * warp, np.float32)

    def _table(self, camera: Camera, rays: Field) -> Field:
        image = np.zeros((*rays.shape[:2], 3), np.float32)
        _cover(image, rays, camera.base_from_camera[:3].copy(), self.world.table, self.world.table_scale)
        return image


def _hash(seed: int, camera: int, number: int) -> int:
    return int(np.random.SeedSequence([seed, camera, number]).generate_state(1)[0])


def _by_rows(motion: Motion, t: float, readout: float, rows: int) -> Array:
    """Poses (R, 4, 4): one for all rows, or one for each where they are read one after another."""
    if readout == 0:
        return motion(t)[None]
    knots = np.linspace(-0.5, 0.5, SHUTTER_KNOTS)
    poses = np.stack([motion(t + readout * float(k)) for k in knots])
    place = (np.arange(rows) + 0.5) / rows * (SHUTTER_KNOTS - 1)
    before = np.minimum(place.astype(int), SHUTTER_KNOTS - 2)
    share = (place - before)[:, None, None]
    return np.asarray((1 - share) * poses[before] + share * poses[before + 1])


def _rays(camera: Camera) -> Field:
    """Where each pixel looks, (H, W, 2) at depth 1: the lens undone by fixed-point steps."""
    w, h = camera.size
    x, y = np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float))
    xd, yd = (x - camera.matrix[0, 2]) / camera.matrix[0, 0], (y - camera.matrix[1, 2]) / camera.matrix[1, 1]
    k1, k2, p1, p2, k3 = camera.distortion
    u, v = xd.copy(), yd.copy()
    for _ in range(25):
        r2 = u * u + v * v
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u, v = (
            (xd - 2 * p1 * u * v - p2 * (r2 + 2 * u * u)) / radial,
            (yd - p1 * (r2 + 2 * v * v) - 2 * p2 * u * v) / radial,
        )
    return np.ascontiguousarray(np.stack([u, v], -1), np.float32)


@njit(**COMPILE)
def _trace(rays, camera, surface_from_camera, poses, grid, half, bump, hits):  # type: ignore[no-untyped-def]
    """Fill hits (H, W, 9): coverage, x and y on the tissue, the place met and the normal there in the base frame.

    camera: base_from_camera (3, 4). surface_from_camera, poses (base_from_surface): (R, 3, 4), R = 1 or H.
    """
    rows, columns = rays.shape[0], rays.shape[1]
    n = grid.shape[0]
    middle, top = (n - 1) / 2.0, n - 1.001
    for i in range(rows):
        m = surface_from_camera[i if surface_from_camera.shape[0] > 1 else 0]
        p = poses[i if poses.shape[0] > 1 else 0]
        near, z, before = False, 0.0, 0.0
        for j in range(columns):
            a, b = rays[i, j, 0], rays[i, j, 1]
            dx = m[0, 0] * a + m[0, 1] * b + m[0, 2]
            dy = m[1, 0] * a + m[1, 1] * b + m[1, 2]
            dz = m[2, 0] * a + m[2, 1] * b + m[2, 2]
            x, y, steps = 0.0, 0.0, NEAR_STEPS if near else FAR_STEPS
            last, z = z, (2.0 * z - before if near else 0.0)
            before = last if near else 0.0
            near = True
            for _ in range(steps):
                s = (z - m[2, 3]) / dz
                x, y = m[0, 3] + s * dx, m[1, 3] + s * dy
                if abs(x) > half[0] + 10 or abs(y) > half[1] + 10:
                    near = False
                    break
                u = min(max(x * RELIEF_SCALE + middle, 0.0), top)
                v = min(max(y * RELIEF_SCALE + middle, 0.0), top)
                k, q = int(u), int(v)
                fu, fv = u - k, v - q
                w00, w01, w10, w11 = (1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv
                z = w00 * grid[q, k, 0] + w01 * grid[q, k + 1, 0]
                z += w10 * grid[q + 1, k, 0] + w11 * grid[q + 1, k + 1, 0]
                if bump[0] != 0.0:
                    ox, oy = x - bump[1], y - bump[2]
                    z += bump[0] * math.exp(-(ox * ox + oy * oy) / (2 * bump[3] * bump[3]))
            ex, ey = (x / half[0]) ** 2, (y / half[1]) ** 2
            inside = 1.0 - math.sqrt(math.sqrt(ex * ex + ey * ey) if half[2] > 0.0 else max(ex, ey))
            cover = min(max(inside * half[0] / 0.4, 0.0), 1.0)
            hits[i, j, 0] = cover
            if cover <= 0.0:
                dx = camera[0, 0] * a + camera[0, 1] * b + camera[0, 2]
                dy = camera[1, 0] * a + camera[1, 1] * b + camera[1, 2]
                dz = camera[2, 0] * a + camera[2, 1] * b + camera[2, 2]
                s = -camera[2, 3] / dz
                hits[i, j, 1], hits[i, j, 2] = 1e6, 1e6
                hits[i, j, 3], hits[i, j, 4], hits[i, j, 5] = camera[0, 3] + s * dx, camera[1, 3] + s * dy, 0.0
                hits[i, j, 6], hits[i, j, 7], hits[i, j, 8] = 0.0, 0.0, 1.0
                continue
            sx = w00 * grid[q, k, 1] + w01 * grid[q, k + 1, 1] + w10 * grid[q + 1, k, 1] + w11 * grid[q + 1, k + 1, 1]
            sy = w00 * grid[q, k, 2] + w01 * grid[q, k + 1, 2] + w10 * grid[q + 1, k, 2] + w11 * grid[q + 1, k + 1, 2]
            if bump[0] != 0.0:
                ox, oy = x - bump[1], y - bump[2]
                g = bump[0] * math.exp(-(ox * ox + oy * oy) / (2 * bump[3] * bump[3])) / (bump[3] * bump[3])
                sx, sy = sx - ox * g, sy - oy * g
            length = math.sqrt(1 + sx * sx + sy * sy)
            hits[i, j, 1], hits[i, j, 2] = x, y
            for r in range(3):
                hits[i, j, 3 + r] = p[r, 0] * x + p[r, 1] * y + p[r, 2] * z + p[r, 3]
                hits[i, j, 6 + r] = (p[r, 2] - p[r, 0] * sx - p[r, 1] * sy) / length


@njit(**COMPILE)
def _lay(image, hits, texture, scale, shift_x, shift_y):  # type: ignore[no-untyped-def]
    """Lay a texture over what the pixels show of the tissue."""
    h, w = texture.shape[0], texture.shape[1]
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            cover = hits[i, j, 0]
            if cover <= 0.0:
                continue
            u = (hits[i, j, 1] - shift_x) * scale + (w - 1) / 2.0
            v = (hits[i, j, 2] - shift_y) * scale + (h - 1) / 2.0
            if not (0.0 <= u < w - 1 and 0.0 <= v < h - 1):
                continue
            _blend(image, i, j, texture, u, v, cover)


@njit(**COMPILE)
def _blend(image, i, j, texture, u, v, cover):  # type: ignore[no-untyped-def]
    k, q = int(u), int(v)
    fu, fv = np.float32(u - k), np.float32(v - q)
    one = np.float32(1.0)
    w00, w01, w10, w11 = (one - fu) * (one - fv), fu * (one - fv), (one - fu) * fv, fu * fv
    a = (
        w00 * texture[q, k, 3]
        + w01 * texture[q, k + 1, 3]
        + w10 * texture[q + 1, k, 3]
        + w11 * texture[q + 1, k + 1, 3]
    )
    a *= cover
    if a <= 0.0:
        return
    for c in range(3):
        value = w00 * texture[q, k, c] + w01 * texture[q, k + 1, c]
        value += w10 * texture[q + 1, k, c] + w11 * texture[q + 1, k + 1, c]
        image[i, j, c] += a * (value - image[i, j, c])


@njit(**COMPILE)
def _cover(image, rays, sheet_from_camera, texture, scale):  # type: ignore[no-untyped-def]
    """Draw a flat textured sheet over the picture. sheet_from_camera: (3, 4), the sheet lies at z = 0 of its frame."""
    h, w = texture.shape[0], texture.shape[1]
    m = sheet_from_camera
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            a, b = rays[i, j, 0], rays[i, j, 1]
            dz = m[2, 0] * a + m[2, 1] * b + m[2, 2]
            s = -m[2, 3] / dz
            if s <= 0:
                continue
            u = (m[0, 3] + s * (m[0, 0] * a + m[0, 1] * b + m[0, 2])) * scale + (w - 1) / 2.0
            v = (m[1, 3] + s * (m[1, 0] * a + m[1, 1] * b + m[1, 2])) * scale + (h - 1) / 2.0
            if 0.0 <= u < w - 1 and 0.0 <= v < h - 1:
                _blend(image, i, j, texture, u, v, np.float32(1.0))


@njit(**COMPILE)
def _shine(image, hits, light, scale, shift_x, shift_y, lamp, ambient):  # type: ignore[no-untyped-def]
    """Shade by the normal, and by the light's pattern, which lies on the table and falls along the lamp's direction."""
    h, w = light.shape[0], light.shape[1]
    even = h == 2
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            if even and hits[i, j, 0] <= 0.0:
                continue
            facing = hits[i, j, 6] * lamp[0] + hits[i, j, 7] * lamp[1] + hits[i, j, 8] * lamp[2]
            shade = ambient + (1.0 - ambient) * max(facing, 0.0) / lamp[2]
            if not even:
                z = hits[i, j, 5]
                u = (hits[i, j, 3] - z * lamp[0] / lamp[2] - shift_x) * scale + (w - 1) / 2.0
                v = (hits[i, j, 4] - z * lamp[1] / lamp[2] - shift_y) * scale + (h - 1) / 2.0
                u, v = min(max(u, 0.0), w - 1.001), min(max(v, 0.0), h - 1.001)
                k, q = int(u), int(v)
                fu, fv = u - k, v - q
                shade *= (1 - fv) * ((1 - fu) * light[q, k] + fu * light[q, k + 1]) + fv * (
                    (1 - fu) * light[q + 1, k] + fu * light[q + 1, k + 1]
                )
            for c in range(3):
                image[i, j, c] *= np.float32(shade)


@njit(**COMPILE)
def _glisten(image, hits, film, shift_x, shift_y, panel, camera, pose):  # type: ignore[no-untyped-def]
    """Add what a wet film mirrors of the lamp. camera: (3,) mm, base frame; pose: base_from_surface (3, 4)."""
    h, w = film.shape[0], film.shape[1]
    side = panel.shape[0]
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            if hits[i, j, 0] <= 0.0:
                continue
            k = int((hits[i, j, 1] - shift_x) * 4.0 + (w - 1) / 2.0)
            q = int((hits[i, j, 2] - shift_y) * 4.0 + (h - 1) / 2.0)
            if not (0 <= k < w and 0 <= q < h):
                continue
            sx, sy = film[q, k, 0], film[q, k, 1]
            nx = hits[i, j, 6] - sx * pose[0, 0] - sy * pose[0, 1]
            ny = hits[i, j, 7] - sx * pose[1, 0] - sy * pose[1, 1]
            nz = hits[i, j, 8] - sx * pose[2, 0] - sy * pose[2, 1]
            n2 = nx * nx + ny * ny + nz * nz
            vx, vy, vz = camera[0] - hits[i, j, 3], camera[1] - hits[i, j, 4], camera[2] - hits[i, j, 5]
            along = 2.0 * (nx * vx + ny * vy + nz * vz) / n2
            rx, ry, rz = along * nx - vx, along * ny - vy, along * nz - vz
            if rz <= 0.0:
                continue
            s = (LAMP_HEIGHT - hits[i, j, 5]) / rz
            u = int(hits[i, j, 3] + s * rx + (side - 1) / 2.0)
            v = int(hits[i, j, 4] + s * ry + (side - 1) / 2.0)
            if 0 <= u < side and 0 <= v < side:
                for c in range(3):
                    image[i, j, c] += hits[i, j, 0] * film[q, k, 2] * panel[v, u]


@njit(**COMPILE)
def _sense(light, gains, noise_of, seed, gamma, image):  # type: ignore[no-untyped-def]
    """Grey values (H, W, 3) of light. gains: (H,) by row; noise_of, gamma: (4096,) by light, 0 to 1."""
    state = np.uint64(seed) * np.uint64(2654435761) | np.uint64(1)
    mask = np.uint64(1023)
    for i in range(light.shape[0]):
        for j in range(light.shape[1]):
            state ^= state << np.uint64(13)
            state ^= state >> np.uint64(7)
            state ^= state << np.uint64(17)
            for c in range(3):
                two = ((state >> np.uint64(20 * c)) & mask) + ((state >> np.uint64(20 * c + 10)) & mask)
                normal = (float(two) - 1023.0) / 418.0  # the sum of two of 0 to 1023: mean 1023, deviation 418
                value = light[i, j, c] * gains[i]
                value += normal * noise_of[int(min(max(value, 0.0), 1.0) * 4095.0)]
                image[i, j, c] = gamma[int(min(max(value, 0.0), 1.0) * 4095.0)]
