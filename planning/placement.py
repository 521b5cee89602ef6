"""Where a path lies on a surface: by a registered scan, by the region that is followed, or moved there by hand.

What is moved by hand stays on the surface: it slides along it and turns about its normal, and its middle keeps its
height over the mapped points. These are landmarks, few and noisy, so height and normal are those of a plane through the
points around, weighted by their distance. Its bias on a bent surface is nearly the same at both ends of a move.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from estimation import se3
from estimation.errors import StillbedError
from estimation.scans.registration import Registration
from estimation.se3 import Array
from planning.path import Path

MIN_REACH_MM, MAX_REACH_MM = (
    8.0,
    30.0,
)  # of the points that a plane is laid through, one sigma: landmarks are 5 mm apart
MIN_SURFACE_POINTS = 6  # within that reach; fewer are no surface that could be followed
MAX_GAP_MM = 10.0  # to the nearest mapped point: beyond, nobody knows where the surface goes on
FOOT_ROUNDS = 3  # of laying a plane and going to its foot: the third was seen to move by less than 1 um
SQUARE_RATIO = 1.1  # of a figure's two axes, below which it has no direction
MAX_FLAT_HEIGHT_MM = 20.0  # of a path over its own plane z = 0; a path that is higher was planned on a scan
MIN_PATH_POINTS = 2


class PlacedBy(StrEnum):
    """What a path was placed by."""

    SCAN = "scan"  # registered in the pictures
    REGION = "region"  # a guess: where the followed region lies
    TRUTH = "truth"  # of a simulated world
    EARLIER = "earlier run"  # that is resumed
    HAND = "hand"  # the operator has moved it


@dataclass(frozen=True, slots=True, eq=False)
class PathPlacement:
    """Where a path lies on the surface, and what is known of that."""

    surface_from_path: Array  # (4, 4) mm
    by: PlacedBy
    verdict: str  # in words: what it is worth, and what is not certain
    certain: bool  # found, unique and determined: may be printed without anybody's look
    usable: bool  # may be printed once somebody has moved it to where it belongs
    sigma: float = np.nan  # mm, one standard deviation of the path's middle along its worst direction
    turn_sigma: float = np.nan  # rad, of its turn about the worst axis
    outward: Array | None = None  # (3,) out of the surface, surface frame, roughly: towards the cameras


@dataclass(frozen=True, slots=True)
class SurfaceMove:
    """A move along the surface, in the frame of `tangent_frame`."""

    x: float  # mm
    y: float  # mm
    turn: float  # rad, about the normal through the path's middle


class NoSurfaceError(StillbedError):
    """There is no mapped surface where a path should go; the text says so to an operator."""


def path_middle(path: Path) -> Array:
    """The middle (3,) mm of what is extruded, path frame; of all checkpoints where nothing is."""
    points = path.surface_from_nozzle[:, :3, 3]
    extruded = points[path.extrude] if path.extrude.any() else points
    return np.asarray((extruded.min(axis=0) + extruded.max(axis=0)) / 2)


def path_reach(path: Path) -> float:
    """How far around its middle the surface counts for a path, mm: about half its size."""
    spread = path.surface_from_nozzle[:, :3, 3] - path_middle(path)
    return float(np.clip(np.sqrt(np.mean(np.sum(spread**2, axis=1))), MIN_REACH_MM, MAX_REACH_MM))


def placement_by_scan(place: Registration, middle: Array, outward: Array) -> PathPlacement:
    """The placement of a path in a scan's frame, which is the surface frame. middle: (3,) mm of the path."""
    jacobian = np.hstack([-se3.hat(middle), np.eye(3)])
    sigma = float(np.sqrt(np.linalg.eigvalsh(jacobian @ place.covariance @ jacobian.T)[-1]))
    turn = float(np.sqrt(np.linalg.eigvalsh(place.covariance[:3, :3])[-1]))
    if place.sure:
        verdict = f"placed by the scan, good to {sigma:.2f} mm and {np.rad2deg(turn):.2f} degrees ({place.verdict})"
    elif place.fits:
        verdict = f"the scan's place is not certain, move it: {place.verdict}"
    else:
        verdict = f"the scan was not found here: {place.verdict}"
    return PathPlacement(np.eye(4), PlacedBy.SCAN, verdict, place.sure, place.fits, sigma, turn, outward)


def placement_by_region(path: Path, outlines: list[Array], points: Array, outward: Array) -> PathPlacement:
    """A guess without a scan: the path's middle and long axis on those of the region, its plane z = 0 on the surface.

    outlines: of the region on the surface, (K, 3) mm each, surface frame; without any the mapped points (V, 3) count.
    Of the two ways along an axis the one nearer to the diagonal of the surface's own x and y is taken: a region along
    either axis comes out the same each time. NoSurfaceError: nothing is mapped.
    """
    weights, places = _along(outlines) if outlines else (np.ones(len(points)), points)
    if not len(places):
        raise NoSurfaceError("nothing of the surface is mapped yet")
    centre, spread = _moments(weights, places)
    reach = float(np.clip(np.sqrt(np.trace(spread)), MIN_REACH_MM, MAX_REACH_MM))
    foot, normal = local_plane(points, centre, reach, outward)
    surface_from_tangent = se3.make(_axes(normal, np.eye(3)), foot)
    flat = se3.transform_points(se3.inverse(surface_from_tangent), places)[:, :2]
    region_turn = _long_axis(_moments(weights, flat)[1])
    checkpoints = path.surface_from_nozzle[:, :3, 3]
    extruded = checkpoints[path.extrude] if path.extrude.sum() >= MIN_PATH_POINTS else checkpoints
    path_turn = _long_axis(_moments(np.ones(len(extruded)), extruded[:, :2])[1])
    known = region_turn is not None and path_turn is not None
    turn = 0.0
    if region_turn is not None and path_turn is not None:
        turn = (region_turn - path_turn + np.pi / 4) % np.pi - np.pi / 4
    middle = np.array([*path_middle(path)[:2], 0.0])
    turned = se3.make(se3.exp_rotation(np.array([0.0, 0.0, turn])), np.zeros(3))
    surface_from_path = surface_from_tangent @ turned @ se3.make(np.eye(3), -middle)
    how = "middle and long axis" if known else "middle"
    by = "region that is followed" if outlines else "mapped surface, as no region is known"
    verdict = f"placed by the region, move it: without a scan this is a guess, by the {how} of the {by}"
    high = float(np.abs(extruded[:, 2]).max())
    if high > MAX_FLAT_HEIGHT_MM:
        verdict = (
            f"the path lies {high:.0f} mm off its own plane z = 0: it was planned on a scan, give that as the scan"
        )
    usable = high <= MAX_FLAT_HEIGHT_MM
    return PathPlacement(surface_from_path, PlacedBy.REGION, verdict, False, usable, outward=outward)


def local_plane(points: Array, at: Array, reach: float, outward: Array) -> tuple[Array, Array]:
    """The foot (3,) mm under a place `at` (3,) of the surface through points (V, 3), and its unit normal (3,) there.

    reach: mm, one sigma of the points' weights. outward: (3,), the side of the normal. NoSurfaceError where too few
    points are near, or none within MAX_GAP_MM of the foot.
    """
    foot, normal = at, outward / np.linalg.norm(outward)
    for _ in range(FOOT_ROUNDS):
        squared = np.sum((points - foot) ** 2, axis=1)
        near = squared < (2.5 * reach) ** 2
        if near.sum() < MIN_SURFACE_POINTS:
            raise NoSurfaceError("nothing of the surface is mapped there")
        weight = np.exp(-squared[near] / (2 * reach**2))
        centre, spread = _moments(weight, points[near])
        axis = np.linalg.eigh(spread)[1][:, 0]
        normal = axis * (1.0 if axis @ outward >= 0 else -1.0)
        foot = at - normal * ((at - centre) @ normal)
    if np.min(np.sum((points - foot) ** 2, axis=1)) > MAX_GAP_MM**2:
        raise NoSurfaceError("nothing of the surface is mapped there")
    return foot, normal


def tangent_frame(surface_from_path: Array, middle: Array, reach: float, points: Array, outward: Array) -> Array:
    """surface_from_tangent (4, 4) mm, in which a move is meant: the path's middle, and z out of the surface there.

    x is the path's own as far as it lies along the surface. middle: (3,) mm, path frame. Errors as `local_plane`.
    """
    at = se3.transform_points(surface_from_path, middle[None])[0]
    _, normal = local_plane(points, at, reach, outward)
    return se3.make(_axes(normal, surface_from_path[:3, :3]), at)


def moved_path(
    surface_from_path: Array, middle: Array, reach: float, points: Array, outward: Array, move: SurfaceMove
) -> Array:
    """surface_from_path (4, 4) mm after a move along the surface; arguments as `tangent_frame` takes them.

    The path's middle keeps its height over the points (V, 3), and leans with their normal. NoSurfaceError where the
    surface is not mapped at either end.
    """
    frame = tangent_frame(surface_from_path, middle, reach, points, outward)
    start, normal = frame[:3, 3], frame[:3, 2]
    height = (start - local_plane(points, start, reach, outward)[0]) @ normal
    place, leaning = start + frame[:3, :2] @ np.array([move.x, move.y]), normal
    for _ in range(FOOT_ROUNDS):
        foot, leaning = local_plane(points, place, reach, normal)
        place = foot + height * leaning
    turn = se3.exp_rotation(move.turn * leaning) @ _shortest_turn(normal, leaning) @ surface_from_path[:3, :3]
    return se3.make(turn, place - turn @ middle)


def moved_along(placement: PathPlacement, path: Path, points: Array, move: SurfaceMove) -> Array:
    """surface_from_path (4, 4) mm of a path moved along the surface through points (V, 3); see `moved_path`."""
    return moved_path(placement.surface_from_path, path_middle(path), path_reach(path), points, _out(placement), move)


def tangent_of(placement: PathPlacement, path: Path, points: Array) -> Array | None:
    """surface_from_tangent (4, 4) mm of a placed path, see `tangent_frame`; None where the surface is not mapped."""
    middle, reach = path_middle(path), path_reach(path)
    try:
        return tangent_frame(placement.surface_from_path, middle, reach, points, _out(placement))
    except NoSurfaceError:
        return None


def _out(placement: PathPlacement) -> Array:
    """The side of the surface that the cameras see (3,); without word of it, the path's own z."""
    return placement.surface_from_path[:3, 2] if placement.outward is None else placement.outward


def _shortest_turn(a: Array, b: Array) -> Array:
    """The rotation (3, 3) by the smallest angle that takes a unit vector to another, not opposite one."""
    cross = se3.hat(np.cross(a, b))
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + float(a @ b)))


def _axes(normal: Array, turn: Array) -> Array:
    """Rotation (3, 3) with z along a unit normal (3,) and x as near as can be to the first column of `turn` (3, 3)."""
    x = turn[:, 0] if abs(float(turn[:, 0] @ normal)) < 0.9 else turn[:, 1]
    x = x - normal * (x @ normal)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(normal, x), normal])


def _along(outlines: list[Array]) -> tuple[Array, Array]:
    """Weights (N,) and middles (N, 3) of the sides of closed outlines; each outline weighs the same."""
    weights, middles = [], []
    for outline in outlines:
        after = np.roll(outline, -1, axis=0)
        length = np.linalg.norm(after - outline, axis=1)
        weights.append(length / max(float(length.sum()), 1e-12))
        middles.append((outline + after) / 2)
    return np.concatenate(weights), np.concatenate(middles)


def _moments(weights: Array, points: Array) -> tuple[Array, Array]:
    """Weighted middle (D,) and spread (D, D) of points (N, D)."""
    share = weights / weights.sum()
    centre = share @ points
    away = points - centre
    return centre, (away * share[:, None]).T @ away


def _long_axis(spread: Array) -> float | None:
    """Direction, rad, of the longer axis of a spread (2, 2), None where it has none."""
    values, vectors = np.linalg.eigh(spread)
    if values[1] <= SQUARE_RATIO**2 * max(float(values[0]), 0.0):
        return None
    return float(np.arctan2(vectors[1, 1], vectors[0, 1]))
