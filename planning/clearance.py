"""The tool as a body, and its room: balls that cover it, and distances to the tissue on a grid.

Tool: needle, syringe, print head are parts in the nozzle frame, whose origin is the tip and whose z leads back into the
tool. Their surfaces are covered by balls, the finer the nearer to the tip; balls near each other have one around them
all, and where that one is clear they are not looked at. The needle counts as its axis: it is thicker than the bead that
it lays beside a wall, and presses soft tissue aside by its own radius.

Tissue: all that lies under a height map, so what an overhang hides counts as tissue. Its signed distance is taken on a
grid once, and interpolated: the motion asks for it in each tick, and needs no library for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
PartKind = Literal["box", "cylinder", "cone", "capsule", "mesh"]
PART_KINDS: tuple[PartKind, ...] = get_args(PartKind)
PROFILE_NAME, NEEDLE_NAME = "syringe", "needle"
MAX_PART_REACH = 1000.0  # mm from the tip: no arm here is longer
MIN_PART_SIZE = 0.1  # mm, across: less was typed in metres
SIDES = 16  # of what is round: a polygon around the circle, 2 % wider than that at its corners
CAP_STEPS = 4  # of a capsule's half ball
NEEDLE_WIDENING = 0.25  # mm wider than the tip: up to there it is the needle
NEEDLE_STEP = 1.0  # mm between the points of the needle's axis
BALL_SHARE, MIN_BALL, MAX_BALL = 0.08, 0.4, 8.0  # of the height over the tip, mm, mm: how much balls stand out at most
GROUP_SHARE, MIN_GROUP, MAX_GROUP = 0.3, 2.0, 12.0  # likewise of the balls around groups
BASE_MARGIN = 0.5  # mm that is always kept: how far off the guard lets the place under the nozzle be known
MAX_DEPTH = 6.0  # mm into the tissue to which distances are told apart


@dataclass(frozen=True, slots=True, eq=False)
class ToolPart:
    """One part of the tool. InputError where it makes no sense."""

    name: str
    kind: PartKind
    ends: Array  # (2, 3) mm, nozzle frame: a box's corners, the ends of the others' axis
    radii: Array  # (2,) mm at both ends; 0 of a box and a mesh
    file: str = ""  # of a mesh, mm, in the nozzle frame

    def __post_init__(self) -> None:
        size = np.ptp(self.ends, axis=0)
        across = {"box": float(size.min()), "mesh": np.inf}.get(self.kind, 2 * float(self.radii.max()))
        if not np.isfinite(self.ends).all() or np.abs(self.ends).max() > MAX_PART_REACH:
            raise InputError("tool", self.name, self.ends.tolist(), f"within {MAX_PART_REACH:g} mm of the tip")
        if not across >= MIN_PART_SIZE or (self.radii < 0).any() or not (self.radii <= MAX_PART_REACH).all():
            got = size.tolist() if self.kind == "box" else self.radii.tolist()
            raise InputError("tool", self.name, got, f"{MIN_PART_SIZE:g} mm across or more; the unit is mm, not m")
        if self.kind not in ("box", "mesh") and not np.linalg.norm(size) > 0:
            raise InputError("tool", self.name, self.ends.tolist(), "two ends apart")

    def triangles(self) -> Array:
        """Its surface as triangles (T, 3, 3), mm, nozzle frame; it is inside them. Not of a mesh, which is a file."""
        if self.kind == "box":
            corner = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
            sides = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
            box = np.take_along_axis(np.sort(self.ends, axis=0), corner, axis=0)[sides]
            return np.concatenate([box[:, [0, 1, 2]], box[:, [0, 2, 3]]])
        way = self.ends[1] - self.ends[0]
        length = float(np.linalg.norm(way))
        profile = np.column_stack([[0.0, length], self.radii])
        if self.kind == "capsule":
            angle = np.linspace(0, np.pi / 2, CAP_STEPS + 1)
            cap = self.radii[0] * np.column_stack([-np.cos(angle), np.sin(angle)]) / np.cos(angle[1] / 2)
            profile = np.concatenate([cap, [[length, 0.0]] + cap[::-1] * [-1, 1]])
        z = way / length
        x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
        axes = np.column_stack([x / np.linalg.norm(x), np.cross(z, x / np.linalg.norm(x)), z])
        return se3.transform_points(se3.make(axes, self.ends[0]), revolved(profile).reshape(-1, 3)).reshape(-1, 3, 3)


def revolved(profile: Array) -> Array:
    """Triangles (T, 3, 3) around what turns about z; its ends are closed. profile: (K, 2) of [height, radius], mm."""
    height, radius = np.concatenate([profile[:1] * [1, 0], profile, profile[-1:] * [1, 0]]).T
    angle = 2 * np.pi / SIDES * np.arange(SIDES + 1)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1) / np.cos(np.pi / SIDES)
    level = np.broadcast_to(height[:, None, None], (len(height), SIDES + 1, 1))
    rings = np.concatenate([radius[:, None, None] * around, level], axis=2)
    a, b, c, d = rings[:-1, :-1], rings[:-1, 1:], rings[1:, 1:], rings[1:, :-1]
    triangles = np.concatenate([np.stack([a, b, c], 2), np.stack([a, c, d], 2)]).reshape(-1, 3, 3)
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    return np.asarray(triangles[area > 0])


@dataclass(frozen=True, slots=True, eq=False)
class Balls:
    """Balls in the nozzle frame, each with the room that it must have."""

    centres: Array  # (B, 3) mm
    radii: Array  # (B,) mm
    keep: Array  # (B,) mm to the tissue; negative: so far it may be in it

    def around(self, rows: Index) -> tuple[Array, float]:
        """Centre (3,) and radius, mm, of a ball around some of them and what they must keep free."""
        low, high = self.centres[rows].min(axis=0), self.centres[rows].max(axis=0)
        middle = (low + high) / 2
        reach = np.linalg.norm(self.centres[rows] - middle, axis=1) + self.radii[rows] + self.keep[rows]
        return middle, float(reach.max())


@dataclass(frozen=True, slots=True, eq=False)
class ToolBody:
    """A tool covered by balls, and the balls around groups of them."""

    balls: Balls
    part: Index  # (B,) number of the part in `names`, of each ball
    names: tuple[str, ...]
    groups: Balls  # with what their balls must keep in their radii
    order: Index  # (B,) balls by group
    first: Index  # (G + 1,) where the balls of each group begin in `order`
    margin: float  # mm that all but the needle keeps from the tissue

    @property
    def reach(self) -> float:
        """The farthest that any ball of it looks, mm."""
        return float(self.groups.radii.max())


def tool_body(
    profile: Array,
    parts: Sequence[ToolPart] = (),
    margin: float = BASE_MARGIN,
    touch: float = 0.0,
    mesh: Callable[[str], Array] | None = None,
) -> ToolBody:
    """The tool of an arm: what turns about its axis, (K, 2) mm of [height, radius], and the parts beside that.

    margin: mm that all but the needle keeps from the tissue. touch: mm that the needle may be in it beyond its radius.
    mesh: reads the triangles (T, 3, 3), mm, in a part's file.
    """
    tip = float(profile[0, 1])
    along = np.linspace(profile[0, 0], profile[-1, 0], 1 + int(np.ptp(profile[:, 0]) / (NEEDLE_STEP / 4)))
    wide = np.interp(along, *profile.T) > tip + NEEDLE_WIDENING
    end = float(along[int(wide.argmax())]) if wide.any() else float(profile[-1, 0])
    needle = np.linspace(0.0, end, int(np.ceil(end / NEEDLE_STEP)) + 1)[:, None] * [0.0, 0.0, 1.0]
    centres, radii, keep = [needle], [np.zeros(len(needle))], [np.full(len(needle), -tip - touch)]
    names, solids = [NEEDLE_NAME], list[tuple[str, Array]]()
    if wide.any():
        rest = profile[profile[:, 0] > end]
        above = np.concatenate([[[end, np.interp(end, *profile.T)]], rest])
        solids.append((PROFILE_NAME, revolved(above)))
    for part in parts:
        if part.kind != "mesh":
            solids.append((part.name, part.triangles()))
        elif mesh is not None:
            solids.append((part.name, mesh(part.file)))
    for name, triangles in solids:
        if (low := float(triangles[..., 2].min())) < 0:
            raise InputError(
                "tool", name, f"{-low:g} mm below the tip", "at or above the tip: z leads back into the tool"
            )
        middle, radius = _covering(triangles)
        names.append(name)
        centres.append(middle)
        radii.append(radius)
        keep.append(np.full(len(radius), margin))
    part_of = np.repeat(np.arange(len(names)), [len(r) for r in radii])
    balls = Balls(np.concatenate(centres), np.concatenate(radii), np.concatenate(keep))
    rows = _groups(balls)
    around = [balls.around(each) for each in rows]
    groups = Balls(np.array([c for c, _ in around]), np.array([r for _, r in around]), np.zeros(len(rows)))
    return ToolBody(balls, part_of, tuple(names), groups, np.concatenate(rows), np.cumsum([0, *map(len, rows)]), margin)


def _covering(triangles: Array) -> tuple[Array, Array]:
    """Centres (B, 3) and radii (B,), mm, of balls that cover triangles (T, 3, 3), cut in halves until they are fine."""
    done = list[Array]()
    while len(triangles):
        sides = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)
        longest = sides.argmax(axis=1)
        turn = (longest[:, None] + np.arange(3)) % 3
        triangles = np.take_along_axis(triangles, turn[:, :, None], axis=1)  # the longest side first
        middle = (triangles[:, 0] + triangles[:, 1]) / 2
        radius = np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1)
        fine = radius <= np.clip(BALL_SHARE * middle[:, 2], MIN_BALL, MAX_BALL)
        done.append(np.column_stack([middle, radius])[fine])
        a, b, c = np.moveaxis(triangles[~fine], 1, 0)
        half = (a + b) / 2
        triangles = np.concatenate([np.stack([a, half, c], axis=1), np.stack([half, b, c], axis=1)])
    found = np.concatenate(done)
    _, kept = np.unique(np.round(found, 6), axis=0, return_index=True)  # neighbours share a side
    return found[kept, :3], found[kept, 3]


def _groups(balls: Balls) -> list[Index]:
    """Balls in groups, each halved along its longest side until the ball around it is small."""
    todo, done = [np.arange(len(balls.radii))], list[Index]()
    while todo:
        rows = todo.pop()
        middle, radius = balls.around(rows)
        own = radius - float((balls.radii + balls.keep)[rows].max())
        if len(rows) == 1 or own <= np.clip(GROUP_SHARE * middle[2], MIN_GROUP, MAX_GROUP):
            done.append(rows)
            continue
        axis = int(np.ptp(balls.centres[rows], axis=0).argmax())
        order = rows[np.argsort(balls.centres[rows, axis], kind="stable")]
        todo += [order[: len(order) // 2], order[len(order) // 2 :]]
    return done


@dataclass(frozen=True, slots=True, eq=False)
class Envelope:
    """The tissue's signed distance on a grid: positive outside, as far as `most` tells distances apart."""

    grid_from_surface: Array  # (4, 4) mm, z out of the tissue
    origin: Array  # (3,) mm, x y z of the first node
    step: float  # mm
    distance: NDArray[np.float32]  # (Z, H, W) mm
    top: float  # mm, the highest tissue, in the grid's frame

    @property
    def most(self) -> float:
        """Distances are told apart up to it, mm."""
        return float(self.distance.max())

    def at(self, points: Array) -> Array:
        """Signed distances (N,), mm, of points (N, 3) in the surface frame.

        Beside the grid the tissue goes on as at its edge; above and below it the distance is that of its last layer.
        """
        scaled, shape = self.nodes_from_surface, np.array(self.distance.shape)[:, None]
        nodes = np.ascontiguousarray(scaled[:3, :3] @ points.T + scaled[:3, 3:])
        # linear between nodes, as scipy's map_coordinates, which would load for half a second in the middle of a print
        np.minimum(np.maximum(nodes, 0.0, out=nodes), shape - 1, out=nodes)
        low = np.minimum(nodes.astype(np.intp), np.maximum(shape - 2, 0))
        nodes -= low
        values, strides = self.distance.ravel(), (self.distance[0].size, self.distance.shape[2], 1)
        steps = np.where(shape[:, 0] > 1, strides, 0)
        return _between(values, low[0] * strides[0] + low[1] * strides[1] + low[2], steps, nodes)

    @property
    def nodes_from_surface(self) -> Array:
        """(4, 4), to numbers of nodes along z, y, x."""
        nodes = self.grid_from_surface[[2, 1, 0, 3]].copy()
        nodes[:3, 3] -= self.origin[::-1]
        nodes[:3] /= self.step
        return nodes

    def moved(self, surface_from_path: Array) -> Envelope:
        """The same tissue where its own surface frame is moved by (4, 4)."""
        return replace(self, grid_from_surface=self.grid_from_surface @ se3.inverse(surface_from_path))


def _between(values: NDArray[np.float32], first: Index, steps: Index, shares: Array) -> Array:
    """Values (N,) at `shares` (D, N), 0 to 1, of the way from nodes `first` (N,) to those `steps` (D,) further on."""
    if not len(steps):
        return values.take(first).astype(float)
    here, there = (_between(values, first + on, steps[1:], shares[1:]) for on in (0, steps[0]))
    there -= here
    there *= shares[0]
    there += here
    return there


def envelope_over(grid_from_surface: Array, origin: Array, step: float, heights: Array, reach: float) -> Envelope:
    """The envelope of all that lies under heights (H, W), mm, at nodes `step` apart from `origin` (2,) on.

    reach: mm, to which distances are told apart. Each node stands for a column, and the nearest of columns is found
    along x, then along y, as squares of distances may be. Beside a wall a distance is off by at most a step.
    """
    low = float(heights.min()) - min(MAX_DEPTH, reach)
    z = low + step * np.arange(int(np.ceil((float(heights.max()) + reach - low) / step)) + 1)
    above = (z[:, None, None] - heights).astype(np.float32)
    outside = _nearest(np.maximum(above, 0) ** 2, step, reach)
    inside = _nearest(np.maximum(-above, 0) ** 2, step, min(MAX_DEPTH, reach))
    distance = np.minimum(np.sqrt(outside), np.float32(reach)) - np.minimum(np.sqrt(inside), np.float32(MAX_DEPTH))
    return Envelope(grid_from_surface, np.array([*origin, low]), step, distance, float(heights.max()))


def _nearest(squares: NDArray[np.float32], step: float, reach: float) -> NDArray[np.float32]:
    """The least of squares (Z, H, W) plus the square of the way to them along x and y, within `reach` mm."""
    for axis in (1, 2):
        found, source = squares.copy(), np.moveaxis(squares, axis, -1)
        target = np.moveaxis(found, axis, -1)
        for k in range(1, min(int(reach / step), source.shape[-1] - 1) + 1):
            way = np.float32((k * step) ** 2)
            np.minimum(target[..., k:], source[..., :-k] + way, out=target[..., k:])
            np.minimum(target[..., :-k], source[..., k:] + way, out=target[..., :-k])
        squares = found
    return squares


def rooms(
    body: ToolBody, envelope: Envelope, surface_from_nozzle: Array, resolved: float = 0.0, sign: bool = False
) -> tuple[Array, Index]:
    """The least room (N,), mm, that the tool has at poses (N, 4, 4) beyond what it must keep, and the part (N,) there.

    Below `resolved` mm it is exact to the balls; above, a lower bound, and the part is not known: -1. sign: only
    whether it is below `resolved` is asked for, and where it is, the room is that of some ball.
    """
    groups, count = body.groups, len(surface_from_nozzle)
    room, part = np.full(count, np.inf), np.full(count, -1)
    grid_from_nozzle = envelope.grid_from_surface @ surface_from_nozzle
    lean = float(np.arccos(np.clip(grid_from_nozzle[:, 2, 2].min(initial=1.0), -1, 1)))
    sideways = np.hypot(groups.centres[:, 0], groups.centres[:, 1])
    # of each group the lowest that it can be, by the lowest tip and the greatest lean; over all tissue it is clear
    lowest = np.cos(lean) * groups.centres[:, 2] - np.sin(lean) * sideways - groups.radii - envelope.top
    lowest += grid_from_nozzle[:, 2, 3].min(initial=np.inf)
    near = np.flatnonzero(lowest < max(resolved, 0.0))
    room[:] = np.delete(lowest, near).min(initial=np.inf)
    bound = _distances(envelope, surface_from_nozzle, groups.centres[near]) - groups.radii[near]
    room = np.minimum(room, np.where(bound < resolved, np.inf, bound).min(axis=1, initial=np.inf))
    for k, group in enumerate(near):
        rows = np.flatnonzero((bound[:, k] < resolved) & ~(sign & (room < resolved)))
        if not len(rows):
            continue
        own = body.order[body.first[group] : body.first[group + 1]]
        balls = _distances(envelope, surface_from_nozzle[rows], body.balls.centres[own])
        balls -= body.balls.radii[own] + body.balls.keep[own]
        least = balls.argmin(axis=1)
        value = balls[np.arange(len(rows)), least]
        closer = value < room[rows]
        part[rows[closer]] = body.part[own[least[closer]]]
        room[rows] = np.minimum(room[rows], value)
    return room, part


def _distances(envelope: Envelope, surface_from_nozzle: Array, places: Array) -> Array:
    """Signed distances (N, B), mm, of places (B, 3) of the tool at poses (N, 4, 4)."""
    rotation, tip = surface_from_nozzle[:, :3, :3], surface_from_nozzle[:, :3, 3]
    points = places @ np.swapaxes(rotation, 1, 2) + tip[:, None]
    return envelope.at(points.reshape(-1, 3)).reshape(len(tip), len(places))


GUARD_TOUCH = 1.0  # mm deeper than its radius that the needle may be in the tissue: what tracking and scan are off by


@dataclass(frozen=True, slots=True, eq=False)
class TissueGuard:
    """The tool and the tissue as a live run keeps them apart."""

    body: ToolBody
    envelope: Envelope  # in the surface frame
    _quick: tuple[Array, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        centres, distance = self.body.groups.centres, self.envelope.distance
        least = self.body.groups.radii + np.sqrt(0.75) * self.envelope.step  # farther than a place is from its node
        most, strides = np.array(distance.shape) - 1, np.array([distance[0].size, distance.shape[2], 1])
        quick = self.envelope.nodes_from_surface, centres, least, most, strides, distance.ravel()
        object.__setattr__(self, "_quick", quick)

    def clear(self, surface_from_nozzle: Array) -> bool:
        """Whether the tool surely has room at a pose (4, 4), by the nodes nearest to its groups: in 20 microseconds."""
        nodes_from_surface, centres, least, most, strides, distance = self._quick
        nodes_from_nozzle = nodes_from_surface @ surface_from_nozzle
        nodes = np.rint(centres @ nodes_from_nozzle[:3, :3].T + nodes_from_nozzle[:3, 3])
        near = np.minimum(np.maximum(nodes, 0.0), most)
        return not (distance[(near @ strides).astype(np.intp)] < least).any()

    def room(self, surface_from_nozzle: Array) -> tuple[float, str]:
        """The tool's least room, mm, at a pose (4, 4), and the part there: below 0 it is exact, above a lower bound."""
        room, part = rooms(self.body, self.envelope, surface_from_nozzle[None])
        return float(room[0]), self.body.names[part[0]] if part[0] >= 0 else "tool"

    def moved(self, surface_from_path: Array) -> TissueGuard:
        """The same where the path's own frame lies at (4, 4), mm, on the surface."""
        return replace(self, envelope=self.envelope.moved(surface_from_path))
