"""The region of a run or recording: where the surface is in each camera's picture, or how it is found there.

[region]                   # of a session.toml
by = "polygon"             # the corners below, or those that the operator draws; network, colour, picture
left = [[210, 95], [430, 100], [425, 300]]    # a camera's name: corners, px
colour = "#00a651"         # by colour: of a printed frame or patch round what is followed
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from hardware.process import checks
from perception.frames import Roi, whole_pictures

MAX_CORNERS = 64  # of a polygon: more than a hand draws, and few enough to check against each other
MIN_AREA = 400.0  # px^2 of a polygon: a smaller one holds no landmarks
MIN_CAMERAS = 2  # with a polygon: a first map needs two views
PATCH_COLOUR = "#00a651"  # green, farthest from skin, blood and blue gloves
MIN_SATURATION = 0.3  # of a colour, below which it has no hue that a camera tells from grey
COLOUR = re.compile("#[0-9a-fA-F]{6}")
BY_KEY, COLOUR_KEY = "by", "colour"

Corners = tuple[tuple[float, float], ...]  # px, in turn


class RegionBy(StrEnum):
    """How the region is found."""

    POLYGON = "polygon"  # corners that are given or drawn
    NETWORK = "network"  # round the wound that the network sees; whole pictures where it sees none
    COLOUR = "colour"  # inside a printed frame or patch of one colour
    PICTURE = "picture"  # all that the cameras see


@dataclass(frozen=True, slots=True)
class RegionSettings:
    """The region as it is asked for. by: None, as the session has it, else by the network."""

    by: RegionBy | None = None
    polygons: tuple[tuple[str, Corners], ...] = ()  # by camera's name; none: they are drawn
    colour: str = PATCH_COLOUR  # "#rrggbb"

    @property
    def drawn(self) -> bool:
        """Whether somebody has to draw it."""
        return self.by is RegionBy.POLYGON and not self.polygons

    def rois(self, rig: Rig, stamp: float) -> tuple[Roi, ...]:
        """The region in each camera that has one, as far as it is known without a picture; stamp: s, from when on."""
        if self.by is RegionBy.PICTURE:
            return whole_pictures([camera.size for camera in rig.cameras], stamp)
        names = [camera.name for camera in rig.cameras]
        return tuple(Roi(names.index(name), stamp, np.array(corners, float)) for name, corners in self.polygons)


ANY_REGION = RegionSettings()  # nothing is asked for


def read_region(file: Path) -> RegionSettings:
    """The table [region] of a session.toml, or of a file with nothing else; InputError where there is none."""
    table = checks.read_toml(file)
    if "region" not in table:
        raise InputError(file, "region", "missing", "a table [region]")
    return region_from_table(file, table["region"])


def region_from_table(where: object, table: object) -> RegionSettings:
    """The region in a table [region]; InputError names the key that makes no sense."""
    if not isinstance(table, dict):
        raise InputError(where, "region", table, "a table [region]")
    polygons = tuple(
        (name, corners_from(where, f"region.{name}", value))
        for name, value in table.items()
        if name not in (BY_KEY, COLOUR_KEY)
    )
    colour = _colour(where, table[COLOUR_KEY]) if COLOUR_KEY in table else PATCH_COLOUR
    by = checks.member(RegionBy)(where, "region.by", table[BY_KEY]) if BY_KEY in table else None
    if by is None and (polygons or COLOUR_KEY in table):
        by = RegionBy.POLYGON if polygons else RegionBy.COLOUR
    if polygons and by is not RegionBy.POLYGON:
        raise InputError(where, f"region.{polygons[0][0]}", "corners", f'none of them with by = "{by}"')
    if COLOUR_KEY in table and by is not RegionBy.COLOUR:
        raise InputError(where, "region.colour", colour, f'none with by = "{by}"')
    return RegionSettings(by, polygons, colour)


def _colour(where: object, value: object) -> str:
    if not isinstance(value, str) or not COLOUR.fullmatch(value):
        raise InputError(where, "region.colour", value, f'"#rrggbb", such as "{PATCH_COLOUR}"')
    parts = [int(value[i : i + 2], 16) for i in (1, 3, 5)]
    if max(parts) - min(parts) < MIN_SATURATION * 255:
        raise InputError(where, "region.colour", value, f'a colour far from grey, such as "{PATCH_COLOUR}"')
    return value


def corners_from(where: object, key: str, value: object) -> Corners:
    """Corners that are a list of [x, y] in px, a polygon that does not cross itself; InputError."""
    points = checks.numbers(where, key, value, (None, 2), "px: a list of [x, y]")
    if not 3 <= len(points) <= MAX_CORNERS:
        raise InputError(where, key, f"{len(points)} corners", f"3 to {MAX_CORNERS} corners")
    x, y = (points - points[0]).T
    if abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2 < MIN_AREA:
        raise InputError(where, key, points.tolist(), f"a polygon of {MIN_AREA:g} px^2 or more")
    if crossing := crossing_edges(points):
        allowed = "edges that meet in their corners alone"
        raise InputError(where, key, f"the edges from corners {crossing[0]} and {crossing[1]} on meet", allowed)
    return tuple((float(px), float(py)) for px, py in points)


def check_inside(where: object, key: str, corners: Corners, camera: Camera) -> None:
    """InputError unless all corners lie in the camera's picture."""
    points, (width, height) = np.array(corners), camera.size
    outside = ((points < 0) | (points > [width - 1, height - 1])).any(axis=1)
    if outside.any():
        allowed = f"corners in the picture, 0..{width - 1} x 0..{height - 1} px"
        raise InputError(where, key, points[outside][0].tolist(), allowed)


def check_region(where: object, region: RegionSettings, rig: Rig) -> None:
    """InputError unless the polygons are of cameras of the rig, two or more, and lie in their pictures."""
    by_name = {camera.name: camera for camera in rig.cameras}
    for name, corners in region.polygons:
        if name not in by_name:
            allowed = f"a camera of the rig, {checks.one_of_text(name, list(by_name))}"
            raise InputError(where, f"region.{name}", "unknown camera", allowed)
        check_inside(where, f"region.{name}", corners, by_name[name])
    if region.polygons and len(region.polygons) < min(MIN_CAMERAS, len(rig)):
        allowed = f"corners in {MIN_CAMERAS} cameras or more"
        raise InputError(where, "region", f"corners in {region.polygons[0][0]!r} alone", allowed)


def crossing_edges(points: Array) -> tuple[int, int] | None:
    """Two edges of a polygon (N, 2) that meet elsewhere than in the corner they share, by their first corners' numbers.

    Edges that fold back onto the one before, or that have no length, count as meeting it.
    """
    count, next_points = len(points), np.roll(points, -1, axis=0)
    for i in range(count):
        for j in range(i + 1, count):
            a, b, c, d = points[i], next_points[i], points[j], next_points[j]
            shared = (b, a, d) if j == i + 1 else (a, b, c) if i == 0 and j == count - 1 else None
            if _folds(*shared) if shared is not None else _meet(a, b, c, d):
                return i, j
    return None


def _folds(corner: Array, before: Array, after: Array) -> bool:
    """Whether the edges from a corner to its neighbours lie on one another."""
    one, other = before - corner, after - corner
    return bool(one @ other >= np.sqrt((one @ one) * (other @ other)) * (1 - 1e-12))


def _meet(a: Array, b: Array, c: Array, d: Array) -> bool:
    """Whether the closed segments a b and c d have a point in common."""
    sides = [_side(a, b, c), _side(a, b, d), _side(c, d, a), _side(c, d, b)]
    if sides[0] != sides[1] and sides[2] != sides[3] and 0 not in sides:
        return True
    orientations = ((a, b, c), (a, b, d), (c, d, a), (c, d, b))
    return any(not side and _between(*end) for side, end in zip(sides, orientations, strict=True))


def _side(a: Array, b: Array, point: Array) -> int:
    (ux, uy), (vx, vy) = b - a, point - a
    return int(np.sign(ux * vy - uy * vx))


def _between(a: Array, b: Array, point: Array) -> bool:
    return bool((np.minimum(a, b) <= point).all() and (point <= np.maximum(a, b)).all())


def region_lines(region: RegionSettings) -> list[str]:
    """The table [region] as lines of TOML; of what is not set, examples."""
    words = "polygon: corners below, or drawn on the page; network; colour: a printed frame; picture: all that is seen"
    lines = ["[region]", f'# by = "polygon"  # {words}' if region.by is None else f'by = "{region.by}"  # {words}']
    patch = f'colour = "{region.colour}"  # of the printed frame or patch'
    lines.append(patch if region.by is RegionBy.COLOUR else f"# {patch}")
    if region.polygons:
        return lines + [
            f"{json.dumps(name, ensure_ascii=False)} = {[list(corner) for corner in corners]}"
            for name, corners in region.polygons
        ]
    return [*lines, "# left = [[210, 95], [430, 100], [425, 300], [205, 290]]  # a camera's name: corners, px"]
