"""A new calibration beside the rig that the session had: swapped, turned or wrongly scaled is told from moved."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array

SAME, OTHER = 6.0, 12.0  # degrees: up to which a rig is the same, from which it is another
SCALE = 0.08  # of the distances between the cameras: lenses found anew shift them by 3 %


def check_against(found: Rig, given: Rig, board_file: Path, square: float) -> None:
    """InputError where the found rig is the given one with cameras swapped, turned by a quarter, or of another size."""
    places = _rotations(given)
    if misfit(_rotations(found), places) > OTHER:
        for words, other in _mistakes(given, places):
            if misfit(_rotations(found), other) < SAME:
                raise InputError("the recording", "cameras", words, "as in its rig.toml (or --new-rig, if it is meant)")
        return
    ratio = _size(found) / _size(given)
    if abs(ratio - 1) > SCALE:
        allowed = f"about {square / ratio:.3g} mm by the distances between the cameras in rig.toml (or --new-rig)"
        raise InputError(board_file, "square_mm", f"{square:g} mm", allowed)


def elsewhere(found: Rig, given: Rig) -> tuple[tuple[float, float], ...]:
    """How far each camera stands, mm and degrees, from where it is given, the first one's places being the same."""
    same = given.cameras[0].base_from_camera @ se3.inverse(found.cameras[0].base_from_camera)
    off = [
        se3.log(se3.inverse(b.base_from_camera) @ same @ a.base_from_camera)
        for a, b in zip(found.cameras, given.cameras, strict=True)
    ]
    return tuple((float(np.linalg.norm(x[3:])), float(np.degrees(np.linalg.norm(x[:3])))) for x in off)


def check_distance(found: Rig, first: str, second: str, distance: float, board_file: Path, square: float) -> None:
    """InputError where two lenses are not as far apart as was measured, mm; scale cannot be told from a board alone."""
    ends = [found.cameras[found.index(name)].base_from_camera[:3, 3] for name in (first, second)]
    apart = float(np.linalg.norm(ends[0] - ends[1]))
    if abs(apart / distance - 1) > SCALE:
        got = f"{square:g} mm, which puts {first} and {second} {apart:.0f} mm apart"
        raise InputError(
            board_file, "square_mm", got, f"about {square * distance / apart:.3g} mm by the measured distance"
        )


def _rotations(rig: Rig) -> Array:
    return np.stack([c.base_from_camera[:3, :3] for c in rig.cameras])


def misfit(found: Array, given: Array) -> float:
    """Largest angle, degrees, between rotations (C, 3, 3) and (C, 3, 3) once the bases agree at best."""
    change = se3.nearest_rotation((found @ np.swapaxes(given, 1, 2)).sum(0))
    return float(np.degrees(se3.angle_of(np.swapaxes(found, 1, 2) @ change @ given)).max())


def _mistakes(given: Rig, places: Array) -> Iterator[tuple[str, Array]]:
    """What people do to cameras, in words, and the rotations that would then be found."""
    names = [c.name for c in given.cameras]
    for a, b in combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[a, b]] = b, a
        yield f"{names[a]} and {names[b]} are swapped", places[order]
    for c, name in enumerate(names):
        for quarter in (1, 2, 3):
            turned = places.copy()
            turned[c] = turned[c] @ se3.exp_rotation([0.0, 0.0, np.pi / 2 * quarter])
            yield f"the picture of {name} is turned by {90 * quarter} degrees", turned


def _size(rig: Rig) -> float:
    """Root mean square distance, mm, between the cameras."""
    at = np.stack([c.base_from_camera[:3, 3] for c in rig.cameras])
    return float(np.sqrt(((at[:, None] - at[None]) ** 2).sum(-1).mean()))
