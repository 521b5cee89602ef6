"""Random outlines of wounds: round, angular, bent, narrow, necked, with islands of healthy skin, in several parts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import shapely
import shapely.affinity
from shapely.geometry import LineString, MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from estimation.se3 import Array
from planning.fill.region import Region, areas, only_areas

Rng = np.random.Generator
ROUGHEST = 0.2  # mm: noise of the points of a contour, as segmentation leaves it
SPECK = 4.0  # mm2: smaller parts and holes are noise of the segmentation, not wound


def random_wound(rng: Rng) -> tuple[str, Region]:
    """What kind of wound it is, and its valid region, mm, somewhere near the origin at any rotation."""
    name = str(rng.choice(list(MAKERS)))
    region = shapely.affinity.rotate(MAKERS[name](rng), rng.uniform(0, 360), origin=(0, 0))
    if rng.random() < 0.5:
        region = _rough(region, rng)
    moved = shapely.affinity.translate(region, *rng.uniform(-50, 50, 2))
    return name, _without_specks(moved)


def mapped(region: Region, change: Callable[[Array], Array]) -> Region:
    """A region with its points (N, 2) changed."""
    return shapely.transform(region, change)


def outline(name: str) -> Polygon:
    """One of two fixed outlines: an `oval` with bays, a `bow` with four corners; both with points every millimetre."""
    t = np.linspace(0, 2 * np.pi, 160, endpoint=False)
    if name == "oval":
        r = 14 * (1 + 0.12 * np.cos(2 * t + 0.4) + 0.07 * np.cos(3 * t + 2) + 0.03 * np.cos(5 * t))
        return Polygon(_xy(r * np.cos(t), r * np.sin(t)))
    t = np.linspace(-1.3, 1.3, 60)
    half = 2.8 + 0.7 * np.sin(3 * t + 1)
    sides = [_xy((16 + way * half) * np.cos(t), (16 + way * half) * np.sin(t)) for way in (1, -1)]
    return Polygon(np.concatenate([sides[0], sides[1][::-1]]))


def _round(rng: Rng, radius: tuple[float, float] = (6.0, 18.0), strength: float = 0.25) -> Polygon:
    """A radius with harmonics, each weaker than the one before."""
    angle = np.linspace(0, 2 * np.pi, int(rng.integers(60, 300)), endpoint=False)
    order = np.arange(2, 9)[:, None]
    size = strength * rng.normal(size=order.shape) / order
    wave = (size * np.cos(order * angle + rng.uniform(0, 2 * np.pi, order.shape))).sum(axis=0)
    r = rng.uniform(*radius) * np.maximum(1 + wave, 0.3)
    return Polygon(np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1))


def _star(rng: Rng) -> Polygon:
    return _round(rng, (10.0, 18.0), 0.6)


def _angular(rng: Rng) -> Polygon:
    """A few straight edges, as of a cut or a flap."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(4, 10))))
    r = rng.uniform(6, 18, len(angle))
    return Polygon(np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1))


def _bent(rng: Rng) -> Region:
    """A band along an arc, of varying thickness."""
    t = np.linspace(0, 1, 90)
    turn, radius = rng.uniform(0.5, 4.5) * (t - 0.5), rng.uniform(10, 25)
    half = rng.uniform(1.5, 4) * (1 + 0.3 * np.sin(rng.uniform(2, 9) * t + rng.uniform(0, 6)))
    half *= np.sqrt(np.maximum(1 - (2 * t - 1) ** 2, 0.05)) if rng.random() < 0.5 else 1.0
    sides = [np.stack([(radius + s * half) * np.cos(turn), (radius + s * half) * np.sin(turn)], 1) for s in (1, -1)]
    return Polygon(np.concatenate([sides[0], sides[1][::-1]]))


def _slit(rng: Rng) -> Polygon:
    """A cut: long, narrow and pointed."""
    t = np.linspace(-1, 1, 60)
    length, half = rng.uniform(8, 25), rng.uniform(1.0, 4.0)
    bow = rng.uniform(-3, 3) * (1 - t**2)
    return Polygon(
        np.concatenate([_xy(t * length, bow + half * (1 - t**2)), _xy(t * length, bow - half * (1 - t**2))[-2:0:-1]])
    )


def _necked(rng: Rng) -> Region:
    """Two wounds that run into each other."""
    apart = rng.uniform(14, 30)
    neck = LineString([(-apart / 2, 0), (apart / 2, rng.uniform(-3, 3))]).buffer(rng.uniform(0.4, 3))
    ends = [shapely.affinity.translate(_round(rng, (5.0, 11.0)), s * apart / 2) for s in (-1, 1)]
    return only_areas(shapely.union_all([neck, *ends]))


def _holed(rng: Rng) -> Region:
    """Islands of healthy skin within."""
    whole = _round(rng, (12.0, 20.0))
    holes = [
        shapely.affinity.translate(_round(rng, (1.5, 4.0)), *rng.uniform(-9, 9, 2)) for _ in range(rng.integers(1, 4))
    ]
    return only_areas(shapely.difference(whole, shapely.union_all(holes)))


def _parted(rng: Rng) -> Region:
    """Several wounds beside one another."""
    parts = [
        shapely.affinity.translate(_round(rng, (3.0, 9.0)), *rng.uniform(-20, 20, 2)) for _ in range(rng.integers(2, 6))
    ]
    return only_areas(shapely.union_all(parts))


def _xy(x: Array, y: Array) -> Array:
    return np.stack([x, y], axis=1)


def _rough(region: Region, rng: Rng) -> Region:
    """The same with noise on every point of its contours."""
    sigma = rng.uniform(0, ROUGHEST) / 2

    def ring(line: BaseGeometry) -> Array:
        points = shapely.get_coordinates(line.segmentize(0.5))[:-1]
        return np.asarray(points + rng.normal(0, sigma, points.shape).clip(-2 * sigma, 2 * sigma))

    parts = [Polygon(ring(p.exterior), [ring(h) for h in p.interiors]) for p in areas(region)]
    return only_areas(shapely.union_all([shapely.make_valid(p, method="structure") for p in parts]))


def _without_specks(region: Region) -> Region:
    kept = [p for p in areas(only_areas(shapely.make_valid(region, method="structure"))) if p.area > SPECK]
    return MultiPolygon([Polygon(p.exterior, [h for h in p.interiors if Polygon(h).area > SPECK]) for p in kept])


MAKERS: dict[str, Callable[[Rng], Region]] = {
    "round": _round,
    "star": _star,
    "angular": _angular,
    "bent": _bent,
    "slit": _slit,
    "necked": _necked,
    "holed": _holed,
    "parted": _parted,
}
