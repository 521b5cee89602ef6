"""Sessions: what all kinds share, from an ordinary wound on ordinary skin to the region that an operator would draw."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from perception.frames import Roi
from tests.campaigns.deceit import looks
from tests.campaigns.deceit.looks import Texture, noise
from tests.campaigns.deceit.motions import Part, breathing, moving, smooth_step
from tests.campaigns.deceit.world import (
    RELIEF_SCALE,
    Motion,
    Relief,
    Sheet,
    View,
    World,
    local_places,
    on_tissue,
    relief,
)

TRICK = 28  # number of the set with which the trick begins: by then the map is confirmed and refined
SETS = 60
REST_HEIGHT = 30.0  # mm, of the tissue above the table
REGION_BEYOND = 22.0  # mm, by which the drawn region goes beyond the wound
BUMP_SHARE = 0.55  # of the radius of the wound: one sigma of the bump as which it rises
TABLE_SIDE = 900.0  # mm
FOCAL_WIDTHS = 1.25  # picture widths


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """One session: the world, what the tracker is told of it, and what the judge has to know."""

    kind: str
    index: int
    seed: int
    what: str  # its parameters, in words
    world: World
    told: Rig  # as the tracker is told
    stamps: Array  # (N,) s
    roi: tuple[Roi, ...]  # none: the tracker looks for the wound itself
    points: Array  # (M, 3) mm, of the tissue at rest: where poses are judged
    decidable: str = ""  # why no three cameras can decide it; "": they can
    honest: bool = False  # hard, but to be followed
    settled: float = -1.0  # s, from which the pictures are good again, so that the pose may be; below 0: always
    gone: float = math.inf  # s, from which on the mapped tissue is no longer there

    def truth(self, stamp: float) -> Array:
        """Where the judged places are, (M, 3) mm, base frame."""
        points = local_places(self.world.relief, self.points, stamp)
        return np.asarray(se3.transform_points(self.world.base_from_surface(stamp), points))


@dataclass(frozen=True, slots=True, eq=False)
class Draw:
    """What a kind draws its sessions from. variant: number of the session within its kind."""

    rng: np.random.Generator
    variant: int
    size: tuple[int, int]  # (W, H) px

    def pick(self, *options: object) -> object:
        """The options in turn, by variant."""
        return options[self.variant % len(options)]

    def uniform(self, low: float, high: float) -> float:
        """A number between two."""
        return float(self.rng.uniform(low, high))


def ordinary(
    draw: Draw,
    *parts: Part,
    fps: float = 30.0,
    sets: int = SETS,
    strength: float = 1.0,
    moles: int = 6,
    contrast: float = 1.0,
    region: bool = True,
    breath: float = 3.0,
    beyond: float = REGION_BEYOND,
) -> Session:
    """Ordinary skin with a wound, which breathes and moves by `parts`. strength, contrast: as skin and with_wound say.

    breath: mm; 0 is none. beyond: mm, by which the region goes beyond the wound.
    """
    rng = draw.rng
    radius = rng.uniform(13, 19)
    skin = looks.with_wound(rng, looks.skin(rng, strength, moles), radius, max(strength, 0.5), contrast)
    lie = tissue_relief(rng, radius)
    wave = (breathing(rng, breath),) if breath else ()
    motion = moving(rest_pose(rng), *wave, *parts)
    ring = [(r * math.cos(a), r * math.sin(a)) for r, n in ((0.45, 4), (0.8, 8)) for a in np.arange(n) * 2 * np.pi / n]
    points = on_tissue(lie, radius * np.array([(0, 0), *ring]))
    return session(draw, skin, looks.SKIN_SCALE, lie, motion, points, radius + beyond, fps, sets, region)


def flat(
    draw: Draw, texture: Texture, scale: float, *parts: Part, fps: float, sets: int, reach: float, breath: float
) -> Session:
    """A flat printed thing that moves as a whole. reach: mm, radius of the region."""
    half = (texture.shape[1] / scale / 2, texture.shape[0] / scale / 2)
    n = round(2 * max(half) * RELIEF_SCALE)
    lie = replace(relief(np.zeros((n, n), np.float32), half), round=False)
    wave = (breathing(draw.rng, breath, 0.5),) if breath else ()
    motion = moving(rest_pose(draw.rng), *wave, *parts)
    points = np.array([(x, y, 0) for x in (-16.0, 0, 16) for y in (-16.0, 0, 16)])
    return session(draw, texture, scale, lie, motion, points, reach, fps, sets, True)


def session(
    draw: Draw,
    texture: Texture,
    scale: float,
    lie: Relief,
    motion: Motion,
    points: Array,
    reach: float,
    fps: float,
    sets: int,
    region: bool,
) -> Session:
    """The session of a tissue under way over a table with a drape."""
    rng = draw.rng
    rig = draw_rig(rng, draw.size)
    views = tuple(View(offset=float(o)) for o in np.clip(rng.normal(0, 0.001, 3), -0.002, 0.002))
    table = looks.drape(rng, TABLE_SIDE, scale=looks.TABLE_SCALE)
    seed = int(rng.integers(1 << 31))
    world = World(rig, motion, lie, lambda _: texture, scale, table, looks.TABLE_SCALE, views=views, seed=seed)
    stamps = np.arange(sets) / fps
    made = Session("", 0, 0, "", world, rig, stamps, (), points)
    return replace(made, roi=drawn_region(made, reach)) if region else made


def draw_rig(rng: np.random.Generator, size: tuple[int, int]) -> Rig:
    """Three cameras, 30 to 50 degrees from one to the next, 330 to 380 mm from the tissue, each a little turned."""
    apart, width = rng.uniform(30, 48), size[0]
    cameras = []
    for name, across, along in (("left", -apart, 14.0), ("middle", 0.0, -10.0), ("right", apart, 14.0)):
        a, b = math.radians(across + rng.normal(0, 2)), math.radians(along + rng.normal(0, 3))
        back = np.array([math.tan(a), math.tan(b), 1.0])
        back /= np.linalg.norm(back)
        x = np.cross([0.0, 1.0, 0.0], back)
        x /= np.linalg.norm(x)
        axes = np.stack([x, np.cross(-back, x), -back], -1)  # x right, y down, z into the scene
        axes = axes @ se3.exp_rotation([0, 0, rng.normal(0, 0.1)])
        target = np.array([0, 0, REST_HEIGHT]) + rng.normal(0, 4, 3)
        focal = FOCAL_WIDTHS * width * rng.uniform(0.97, 1.03)
        middle = (np.array(size) - 1) / 2 + rng.normal(0, 0.01 * width, 2)
        matrix = np.array([[focal, 0, middle[0]], [0, focal * rng.uniform(0.998, 1.002), middle[1]], [0, 0, 1]])
        distortion = np.array([rng.uniform(-0.12, -0.02), rng.uniform(0, 0.05), *rng.normal(0, 5e-4, 2), 0.0])
        pose = se3.make(axes, target + back * rng.uniform(330, 380))
        cameras.append(Camera(name, size, matrix, distortion, pose))
    return Rig(tuple(cameras))


def rest_pose(rng: np.random.Generator) -> Array:
    """Where the tissue rests, (4, 4)."""
    turn = se3.exp_rotation([*rng.normal(0, 0.05, 2), 0]) @ se3.exp_rotation([0, 0, rng.uniform(-np.pi, np.pi)])
    return np.asarray(se3.make(turn, [*rng.normal(0, 5, 2), REST_HEIGHT]))


def tissue_relief(rng: np.random.Generator, radius: float) -> Relief:
    """A body's gentle relief with the wound's hollow in its middle. radius: mm, of the wound."""
    half = (rng.uniform(62, 78), rng.uniform(55, 68))
    n = round((2 * max(half) + 8) * RELIEF_SCALE)
    x, y = looks.grid((n, n), RELIEF_SCALE)
    heights = 1.6 * noise(rng, n, 22 * RELIEF_SCALE) + 0.15 * noise(rng, n, 4 * RELIEF_SCALE)
    heights -= 0.0016 * (x**2 + 1.4 * y**2) * rng.uniform(0.5, 1.2)  # it curves down to its sides
    heights -= rng.uniform(2, 4) * np.exp(-((np.hypot(x, y) / radius) ** 4))
    return replace(relief(heights - heights[n // 2, n // 2], half), sigma=BUMP_SHARE * radius)


def drawn_region(made: Session, reach: float) -> tuple[Roi, ...]:
    """The region that an operator draws in the first pictures: a round one. reach: mm, its radius."""
    half = made.world.relief.half
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    xy = np.clip(reach * np.stack([np.cos(angles), np.sin(angles)], -1), -0.97 * np.array(half), 0.97 * np.array(half))
    stamp = float(made.stamps[0])
    base = se3.transform_points(made.world.base_from_surface(stamp), on_tissue(made.world.relief, xy))
    rois = []
    for c, view in enumerate(made.world.views):
        camera = made.world.rig.cameras[c if view.shows is None else view.shows]
        pixels = pixels_from_points(camera, base)[0]
        last = np.array(camera.size) - 1.0
        pixels = last - pixels if view.flip == "turn" else pixels
        pixels[:, 0] = last[0] - pixels[:, 0] if view.flip == "mirror" else pixels[:, 0]
        rois.append(Roi(c, stamp, pixels))
    return tuple(rois)


def changed(made: Session, **changes: object) -> Session:
    """The session with changes of its world."""
    return replace(made, world=replace(made.world, **changes))


def seen_by(made: Session, views: dict[int, dict[str, object]]) -> Session:
    """The session with changes of how cameras show it, by camera."""
    new = [replace(view, **views.get(c, {})) for c, view in enumerate(made.world.views)]
    return changed(made, views=tuple(new))


def told_as(made: Session, what: str, **changes: object) -> Session:
    """The session with its parameters in words, and other changes."""
    return replace(made, what=what, **changes)


PASSING_S = 0.25  # that a sheet takes to come, and to go


def cloth(rng: np.random.Generator, start: float, end: float) -> Sheet:
    """A green cloth over the whole field from `start` to `end`, s."""
    texture = looks.drape(rng, 340)
    texture[..., :3] *= np.array((0.6, 1.2, 0.5), np.float32)
    return passing(texture, looks.DRAPE_SCALE, start, end)


def passing(
    texture: Texture, scale: float, start: float, end: float, height: float = 110.0, way: float = 420.0
) -> Sheet:
    """A sheet that comes in along x before `start`, rests over the field, and is gone some time after `end`, s."""

    def pose(t: float) -> Array:
        inside = smooth_step((t - start + PASSING_S) / PASSING_S) * (1 - smooth_step((t - end) / PASSING_S))
        return np.asarray(se3.make(np.eye(3), [way * (1 - inside), 0, height]))

    return Sheet(texture, scale, pose)
