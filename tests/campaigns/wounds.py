"""Subject `wounds`: wounds carved into bodies, the skin before carving being the truth of what is found and restored.

Bodies are synthetic limbs and trunks, or meshes that are given: whole persons too, as the wound is carved anywhere on
them and a patch about it is cut out. Each scan has noise, holes, and any pose; some of the wounds have undercut rims.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import shapely
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from estimation import se3
from estimation.errors import StillbedError
from estimation.scans.scan import Scan, scan_from_triangles, vertex_normals
from estimation.se3 import Array, Index
from hardware.bench.figures import Figure, Target, at_least, at_most, with_progress
from hardware.files.mesh_file import read_raw_mesh
from planning.layers.checkpoints import ToolLimits, tilt_field, tool_rotations
from planning.layers.grid import as_multi, interpolate, nodes_within
from planning.layers.repair import repair_mesh
from planning.layers.wound import WoundVolume, find_wound

Rng = np.random.Generator
WOUND_SIZES, WOUND_DEPTHS = (10.0, 50.0), (3.0, 7.0)  # mm
WALL_WIDTHS = (0.8, 2.0)  # mm that the wall takes, seen from above
UNDERCUTS, UNDERCUT_SHARE = (0.3, 1.2), 1 / 3  # mm under the rim, and the share of wounds that have it
SKIN_AROUND = (25.0, 40.0)  # mm of skin that was scanned around the wound
SCAN_NOISE, SCAN_SPACING = 0.1, 1.2  # mm: deviation along the normal, and the longest edge
HOLES, HOLE_RADII = 4, (1.0, 3.0)  # of the scan, mm
MAX_TURN = np.deg2rad(75.0)  # of a patch's normals from that of its middle: a scanner from one side sees no more
PLATE_RING, PLATE_POINTS = (5.0, 20.0), 400  # mm of skin, and points of it, that the plain thin plate goes through
PLACE_TRIES = 400  # at a place for a wound
GRID_STEP = 0.3  # mm, of plans of a bead of half a millimetre
FOUND_IOU, WRONG_IOU = 0.9, 0.2  # from here on it is found; below, another place was planned


@dataclass(frozen=True, slots=True, eq=False)
class CarvedWound:
    """A scan with a wound, and what is true of it."""

    vertices: Array  # (V, 3) mm, scan frame
    triangles: Index  # (T, 3)
    rim: Array  # (N, 3) mm, the outline on the skin, scan frame
    skin: Array  # (M, 3) mm, points of the skin before carving inside the outline
    normals: Array  # (M, 3) unit, of that skin
    volume: float  # mm^3 between skin and bed, also under the rim
    size: float  # mm
    plate: float  # mm, rms error of a plain thin plate through the same scan's skin around
    undercut: float  # mm


@dataclass(frozen=True, slots=True)
class WoundScore:
    """How well one wound was found, or restored with its outline given."""

    iou: float  # of the outlines; nan where a person is asked
    skin: float  # mm, rms, of the restored skin
    volume: float  # over the true one
    tilt: float  # rad, median, of the tool from the true skin's normal
    inside: float  # share of the skin's errors within two of their deviations


def run_wounds(options: argparse.Namespace) -> list[Figure]:
    """Wounds found without help, and restored with their outline given."""
    bodies = [_mesh_body(path) for path in options.bodies] or [_limb(kind) for kind in LIMBS]
    carved, found, given, reasons = list[CarvedWound](), list[WoundScore](), list[WoundScore](), list[str]()
    for i in with_progress("carved wounds", "wounds", range(options.count), options.count):
        wound = carve(bodies[i % len(bodies)], np.random.default_rng([options.seed, i]))
        carved.append(wound)
        score, why = score_wound(wound, None)
        found.append(score)
        reasons += [f"{i}: {why}"] if why else []
        given.append(score_wound(wound, wound.rim)[0])
    return _figures(carved, found, given, reasons)


def _figures(
    carved: list[CarvedWound], found: list[WoundScore], given: list[WoundScore], reasons: list[str]
) -> list[Figure]:
    iou = np.array([s.iou for s in found])
    skin, volume, tilt, inside = (
        np.array([getattr(s, k) for s in given]) for k in ("skin", "volume", "tilt", "inside")
    )
    plate = np.array([c.plate for c in carved])
    note = f"{len(carved)} wounds; asked or refused: {len(reasons)}"
    return [
        Figure("found, IoU of 0.9 or more", 100 * float(np.mean(iou >= FOUND_IOU)), "%", at_least(95.0), "", note),
        Figure("planned in a wrong place", int(np.sum(iou < WRONG_IOU)), "", at_most(0), "", "; ".join(reasons)[:300]),
        Figure("IoU, median of the found", float(np.nanmedian(iou))),
        Figure("restored skin, rms, median", float(np.nanmedian(skin)), "mm", at_most(0.25), "", "outline given"),
        Figure("restored skin, rms, worst", float(np.nanmax(skin)), "mm"),
        Figure("a plain thin plate, rms, median", float(np.median(plate)), "mm"),
        Figure("skin over thin plate, of medians", float(np.nanmedian(skin) / np.median(plate)), "", at_most(0.8)),
        Figure("better than the thin plate", 100 * float(np.mean(skin < plate)), "%"),
        Figure("volume over the true one, median", float(np.nanmedian(volume)), "", Target(0.97, 1.03)),
        Figure("tool off the true normal, median", float(np.rad2deg(np.nanmedian(tilt))), "deg", at_most(3.0)),
        Figure("skin within two deviations, median", 100 * float(np.nanmedian(inside)), "%"),
    ]


def score_wound(wound: CarvedWound, outline: Array | None) -> tuple[WoundScore, str]:
    """How well it is planned, and why it is not where it is not. outline: (N, 3) mm, scan frame, or None."""
    try:
        scan, _ = repair_mesh(wound.vertices, wound.triangles, "scan")
        found = find_wound(scan, GRID_STEP, "scan", outline)
    except StillbedError as error:
        return WoundScore(*[float("nan")] * 5), str(error)
    return _score(wound, found), ""


def _score(true: CarvedWound, found: WoundVolume) -> WoundScore:
    plane_from_scan = se3.inverse(found.surface_from_plane)
    points = se3.transform_points(plane_from_scan, true.skin)
    normals = true.normals @ plane_from_scan[:3, :3].T
    off = (interpolate(found.grid, found.skin, points[:, :2]) - points[:, 2]) * normals[:, 2]
    shape = as_multi(shapely.make_valid(shapely.Polygon(se3.transform_points(plane_from_scan, true.rim)[:, :2])))
    iou = shapely.intersection(shape, found.outline).area / shapely.union(shape, found.outline).area
    inside = nodes_within(found.grid, found.outline)
    tilts = interpolate(found.grid, tilt_field(found.grid, found.skin, inside, ToolLimits()).values, points[:, :2])
    axes = tool_rotations(tilts, 0.0)[:, :, 2]
    tilt = float(np.median(np.arccos(np.clip(np.einsum("ni,ni->n", axes, normals), -1, 1))))
    within = float(np.mean(np.abs(off) < 2 * interpolate(found.grid, found.sigma, points[:, :2])))
    return WoundScore(iou, float(np.sqrt(np.mean(off**2))), found.findings.volume / true.volume, tilt, within)


def carve(body: Scan, rng: Rng) -> CarvedWound:
    """A wound somewhere on a body (vertices mm, normals outwards), scanned with noise and holes."""
    size = float(rng.uniform(*WOUND_SIZES))
    vertices, triangles, middle, normal = _patch(body, size / 2 + float(rng.uniform(*SKIN_AROUND)), rng)
    normals = vertex_normals(vertices, triangles)
    chart = _chart(vertices, middle, normal)
    edge = _edge_of(size, float(rng.uniform(0.5, 1.0)), rng)
    inside = _inside(chart, edge)
    depth, undercut = float(rng.uniform(*WOUND_DEPTHS)), 0.0
    if rng.random() < UNDERCUT_SHARE:
        undercut = float(rng.uniform(*UNDERCUTS))
    carved = _carved(vertices, normals, chart, inside, depth, undercut, rng)
    volume = _volume(vertices, triangles) - _volume(carved, triangles)
    angle = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    rim = _on_skin(np.column_stack([np.cos(angle), np.sin(angle)]) * edge(angle)[:, None], chart, vertices)
    within = np.flatnonzero(inside > 0)
    skin = vertices[within], normals[within]
    scanned = carved + normals * rng.normal(0, SCAN_NOISE, (len(carved), 1))
    plate = _plate_error(scanned, chart, inside, edge, *skin, np.column_stack([middle, normal]), rng)
    kept = np.ones(len(triangles), bool)
    for at in rng.choice(len(vertices), HOLES):
        far = np.linalg.norm(scanned[triangles].mean(axis=1) - scanned[at], axis=1)
        kept &= far > rng.uniform(*HOLE_RADII)
    pose = se3.make(se3.exp_rotation(rng.normal(0, 1.5, 3)), rng.uniform(-300, 300, 3))
    moved = [se3.transform_points(pose, each) for each in (scanned, rim, skin[0])]
    return CarvedWound(
        moved[0], triangles[kept], moved[1], moved[2], skin[1] @ pose[:3, :3].T, volume, size, plate, undercut
    )


def _patch(body: Scan, radius: float, rng: Rng) -> tuple[Array, Index, Array, Array]:
    """Vertices, triangles, middle (3,) and normal (3,) of a patch seen from one side, its edges about SCAN_SPACING."""
    for _ in range(PLACE_TRIES):
        at = int(rng.integers(len(body.vertices)))
        middle, normal = body.vertices[at], body.normals[at]
        near = np.linalg.norm(body.vertices - middle, axis=1) < radius
        if np.arccos(np.clip(body.normals[near] @ normal, -1, 1)).max() > MAX_TURN:
            continue
        faces = body.triangles[near[body.triangles].all(axis=1)]
        chart = _chart(body.vertices[np.unique(faces)], middle, normal)
        hull = shapely.convex_hull(shapely.multipoints(chart))
        if len(faces) < 50 or hull.area < 0.8 * np.pi * (0.85 * radius) ** 2 or not _round(chart, 0.85 * radius):
            continue
        return (*_subdivided(body.vertices, faces, SCAN_SPACING), middle, normal)
    raise StillbedError(f"no place for a wound in {PLACE_TRIES} tries: the body is too small, or bends too much")


def _round(chart: Array, radius: float) -> bool:
    """Whether points lie in every direction as far as `radius`."""
    sector = ((np.arctan2(chart[:, 1], chart[:, 0]) / np.pi + 1) * 8).astype(int) % 16
    far = np.hypot(*chart.T)
    return all(far[sector == k].max(initial=0.0) > radius for k in range(16))


def _subdivided(vertices: Array, faces: Index, longest: float) -> tuple[Array, Index]:
    """The mesh with each triangle parted in four until no edge is longer."""
    used, number = np.unique(faces, return_inverse=True)
    points, faces = vertices[used], number.reshape(-1, 3)
    while True:
        sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
        if np.median(np.linalg.norm(points[sides[..., 0]] - points[sides[..., 1]], axis=2)) <= longest:
            return points, faces
        edges, of = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
        ab, bc, ca = (of.reshape(-1, 3) + len(points)).T
        points = np.concatenate([points, points[edges].mean(axis=1)])
        a, b, c = faces.T
        quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        faces = np.concatenate([np.column_stack(quarter) for quarter in quarters])


def _chart(points: Array, middle: Array, normal: Array) -> Array:
    """Points (N, 3) as (N, 2) about the middle, as far from it as they are along a chord."""
    axes = np.linalg.svd(normal[None])[2][1:]
    away = points - middle
    flat = away @ axes.T
    return np.asarray(flat * (np.linalg.norm(away, axis=1) / np.maximum(np.linalg.norm(flat, axis=1), 1e-9))[:, None])


def _edge_of(size: float, aspect: float, rng: Rng) -> Callable[[Array], Array]:
    """Distance of an irregular oval's edge from its middle, mm, by angle."""
    turn, order = rng.uniform(0, 2 * np.pi), np.arange(2, 7)
    weight, phase = rng.normal(0, 0.1, 5) / order, rng.uniform(0, 2 * np.pi, 5)

    def edge(angle: Array) -> Array:
        oval = size / 2 / np.hypot(np.cos(angle - turn), np.sin(angle - turn) / aspect)
        return np.asarray(oval * (1 + (weight * np.cos(order * angle[:, None] + phase)).sum(axis=1)))

    return edge


def _inside(chart: Array, edge: Callable[[Array], Array]) -> Array:
    """Distance (N,), mm, of points (N, 2) from the edge, positive inside."""
    angle = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    line = np.column_stack([np.cos(angle), np.sin(angle)]) * edge(angle)[:, None]
    far, _ = cKDTree(line).query(chart)
    within = np.hypot(*chart.T) < edge(np.arctan2(chart[:, 1], chart[:, 0]))
    return np.asarray(np.where(within, far, -far))


def _carved(
    vertices: Array, normals: Array, chart: Array, inside: Array, depth: float, undercut: float, rng: Rng
) -> Array:
    """Vertices (V, 3) moved down to the bed, and outwards where the rim is undercut."""
    wall = float(rng.uniform(*WALL_WIDTHS))
    t = np.clip(inside / wall, 0, 1)
    sunk = t * t * (3 - 2 * t)
    waves, phase = rng.normal(0, 0.35, (4, 2)), rng.uniform(0, 2 * np.pi, 4)
    uneven = 0.1 * np.sin(chart @ waves.T + phase).sum(axis=1) * np.clip((inside - wall) / 3, 0, 1)
    moved = vertices - normals * (depth * sunk * (1 + np.clip(uneven, -0.35, 0.35)))[:, None]
    outward = vertices - vertices[np.argmin(np.hypot(*chart.T))]
    outward -= normals * np.einsum("ni,ni->n", outward, normals)[:, None]
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    fade = np.clip(1 - (inside - wall) / max(2.0, 0.6 * float(inside.max())), 0, 1)
    return np.asarray(moved + outward * ((wall + undercut) * (undercut > 0) * sunk * fade)[:, None])


def _volume(vertices: Array, triangles: Index) -> float:
    """Volume, mm^3, under a mesh as seen from the origin of its mean: differences of two with the same rim are true."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6)


def _on_skin(flat: Array, chart: Array, vertices: Array) -> Array:
    """Points (N, 3) of a skin at places (N, 2) of its chart."""
    far, near = cKDTree(chart).query(flat, k=4)
    weight = 1 / np.maximum(far, 1e-6)
    return np.asarray(np.einsum("nk,nki->ni", weight / weight.sum(axis=1, keepdims=True), vertices[near]))


def _plate_error(
    scanned: Array, chart: Array, inside: Array, edge: Callable[[Array], Array], skin: Array, normals: Array,
    place: Array, rng: Rng,
) -> float:  # fmt: skip
    """Rms error, mm, of a thin plate spline through the scanned skin from 5 to 20 mm off the outline."""
    ring = np.flatnonzero((inside < -PLATE_RING[0]) & (inside > -PLATE_RING[1]))
    ring = rng.choice(ring, min(PLATE_POINTS, len(ring)), replace=False)
    middle, normal = place.T
    axes = np.vstack([np.linalg.svd(normal[None])[2][1:], normal])
    flat, true = (scanned[ring] - middle) @ axes.T, (skin - middle) @ axes.T
    heights = RBFInterpolator(flat[:, :2], flat[:, 2], kernel="thin_plate_spline")(true[:, :2])
    return float(np.sqrt(np.mean(((heights - true[:, 2]) * (normals @ normal)) ** 2)))


def _mesh_body(path: Path) -> Scan:
    mesh = read_raw_mesh(path)
    return scan_from_triangles(mesh.vertices, mesh.triangles)


def tube(radius: Callable[[Array, Array], Array], length: float) -> Scan:
    """The outside of a body of `radius` (angle, height along it), mm, `length` mm long, open at both ends."""
    rows, columns = round(length / 3.0), 360
    height, angle = np.meshgrid(
        np.linspace(0, length, rows), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij"
    )
    r = radius(angle, height)
    points = np.stack([r * np.cos(angle), r * np.sin(angle), height], axis=-1).reshape(-1, 3)
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b = number[:-1], np.roll(number, -1, axis=1)[:-1]
    c, d = np.roll(number, -1, axis=1)[1:], number[1:]
    quads = [m.ravel() for m in (a, b, c, d)]
    triangles = np.concatenate([np.column_stack(quads[:3]), np.column_stack([quads[0], *quads[2:]])])
    return scan_from_triangles(points, triangles)


def _swell(angle: Array, height: Array, at: tuple[float, float], wide: tuple[float, float]) -> Array:
    turned = np.angle(np.exp(1j * (angle - at[0])))
    return np.asarray(np.exp(-((turned / wide[0]) ** 2) - ((height - at[1]) / wide[1]) ** 2))


def _calf(a: Array, h: Array) -> Array:
    return 38 + 0.05 * h + 11 * _swell(a, h, (1.2, 190), (0.9, 75)) + 8 * _swell(a, h, (2.2, 170), (0.8, 70))


def _thigh(a: Array, h: Array) -> Array:
    return np.asarray(62 + 0.08 * h + 7 * np.cos(2 * a + 0.4) + 6 * _swell(a, h, (0.0, 150), (0.9, 90)))


def _belly(a: Array, h: Array) -> Array:
    navel = 9 * _swell(a, h, (1.57, 150), (0.09, 9))
    return np.asarray(130 + 34 * np.cos(2 * a) + 28 * _swell(a, h, (1.57, 180), (0.9, 110)) - navel)


def _back(a: Array, h: Array) -> Array:
    spine, blades = 9 * _swell(a, h, (1.57, 200), (0.14, 400)), ((1.05, 290), (2.09, 290))
    return np.asarray(130 + 36 * np.cos(2 * a) - spine + 10 * sum(_swell(a, h, at, (0.25, 55)) for at in blades))


def _chest(a: Array, h: Array) -> Array:
    ribs, breasts = np.sin(2 * np.pi * (h + 18 * np.cos(a)) / 33), ((1.1, 260), (2.04, 260))
    return np.asarray(128 + 30 * np.cos(2 * a) + ribs + 14 * sum(_swell(a, h, at, (0.33, 55)) for at in breasts))


LIMBS: dict[str, tuple[Callable[[Array, Array], Array], float]] = {
    **{"calf": (_calf, 300.0), "thigh": (_thigh, 320.0), "belly": (_belly, 360.0)},
    **{"back": (_back, 400.0), "chest": (_chest, 360.0)},
}  # radius (mm) by angle and height, and length, of each


@cache
def _limb(kind: str) -> Scan:
    return tube(*LIMBS[kind])
