"""The legs of a print: in from where the nozzle is, along the path, and away from it again; all are curves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.se3 import Array
from planning.motion.curve import Curve, curve_through
from planning.motion.follow import LEAD
from planning.motion.retime import Timing
from planning.path import NEAREST, lengths
from planning.progress import Phase

CLEARANCE = 10.0  # mm above the surface, along the nozzle, on the way to and from the path
TRAVEL = 20.0  # mm/s on that way, slow enough for a person to step in
NEAR = 2.0  # mm: from here the nozzle goes straight to its place, without going up first
CORNER = 0.05  # mm by which corners are cut: an eighth of a thin bead
SWERVE = 8 * CORNER / LEAD  # mm/s: a change of velocity in less than LEAD is cut by LEAD / 8 of it, once more CORNER


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """A curve in the surface frame, and when the nozzle is where on it."""

    phase: Phase
    curve: Curve
    timing: Timing


def entry(surface_from_nozzle: Array, goal: Array, speed: float) -> Curve | None:
    """From the nozzle (4, 4) up, over and down to `goal` (4, 4), the last NEAR at `speed`, mm/s; None if there."""
    outwards, place = goal[:3, 2], surface_from_nozzle[:3, 3]
    lift = max(0.0, float((goal[:3, 3] + CLEARANCE * outwards - place) @ outwards))
    lifted = se3.make(surface_from_nozzle[:3, :3], place + lift * outwards)
    over, before = (se3.make(goal[:3, :3], goal[:3, 3] + height * outwards) for height in (CLEARANCE, NEAR))
    near = np.linalg.norm(place - goal[:3, 3]) < NEAR
    return _through([surface_from_nozzle, goal] if near else [surface_from_nozzle, lifted, over, before, goal], speed)


def above(surface_from_nozzle: Array) -> Array:
    """The nozzle (4, 4) straight above where it is now, where it touches nothing."""
    return se3.make(surface_from_nozzle[:3, :3], surface_from_nozzle[:3, 3] + CLEARANCE * surface_from_nozzle[:3, 2])


def straight(surface_from_nozzle: Array, goal: Array) -> Curve | None:
    """From the nozzle (4, 4) to `goal` (4, 4); None if there."""
    return _through([surface_from_nozzle, goal], TRAVEL)


def exit_from(surface_from_nozzle: Array) -> Curve:
    """From the nozzle (4, 4) straight up."""
    curve = straight(surface_from_nozzle, above(surface_from_nozzle))
    assert curve is not None
    return curve


def _through(poses: list[Array], last_speed: float) -> Curve | None:
    way = np.stack(poses)
    way = way[np.concatenate([lengths(way) >= NEAREST, [True]])]  # (K, 4, 4): of one place, the last
    if len(way) < 2:
        return None
    return curve_through(way, np.array([TRAVEL] * (len(way) - 2) + [min(last_speed, TRAVEL)]), CORNER, SWERVE)
