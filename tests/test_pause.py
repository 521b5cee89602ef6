"""A pause: the nozzle leaves the surface, waits above it, and goes on at the very place where it left off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.pose import TrackState
from hardware.arm.profile import ArmProfile
from hardware.motion.step import MotionStep
from planning.command import Hold, Move, Refusal
from planning.kinematics import nozzle_from_axes
from planning.legs import CLEARANCE
from planning.progress import Phase
from tests.moving import Motion, breathing, pose_at, raster, still
from tests.slowly import slowly

PROFILE = ArmProfile()
AGE = 0.03  # s of a pose


class Paused:
    """A motion that is paused for a while; each tick with the nozzle's height over the surface, mm, and the place."""

    def __init__(
        self, motion: Motion, between: tuple[float, float], seconds: float, lost: Callable[[float], bool]
    ) -> None:
        step = MotionStep(raster(speed=4.0), PROFILE)
        self.stamps, self.commands, self.heights, self.places = [], [], [], []
        self.phases: list[Phase] = []
        axes = PROFILE.arm.home
        for now in np.arange(0.0, seconds, PROFILE.tick).tolist():
            step.paused = between[0] <= now < between[1]
            pose = pose_at(motion, now - AGE)
            step(replace(pose, state=TrackState.LOST) if lost(now) else pose, now)
            if isinstance(step.last, Move):
                axes = step.last.axes
            surface = motion(now + PROFILE.tick + PROFILE.lag)
            self.heights.append(float((se3.inverse(surface) @ nozzle_from_axes(PROFILE.arm, axes))[2, 3]))
            self.stamps.append(now)
            self.commands.append(step.last)
            self.places.append(step.progress.place)
            self.phases.append(step.progress.phase)


@pytest.mark.parametrize("motion", [breathing, *slowly(still)])
@pytest.mark.parametrize("gone", [(9.0, 9.0), (6.1, 6.3)])  # s: the surface is lost on the way up
def test_it_waits_above_the_surface_and_goes_on_where_it_left_off(motion: Motion, gone: tuple[float, float]) -> None:
    run = Paused(motion, (6.0, 9.0), 13.0, lambda now: gone[0] <= now < gone[1])
    stamps, heights, places = (np.array(x) for x in (run.stamps, run.heights, run.places))
    extrudes = np.array([isinstance(c, Move) and c.extrude for c in run.commands])
    assert not any(isinstance(c, Refusal) for c in run.commands if not gone[0] <= c.stamp < gone[1] + 0.3)
    waits = (stamps > 8.0) & (stamps < 9.0)
    sway = 5.0 if motion is breathing else 0.5  # mm: it stands, and the surface breathes below it
    assert heights[waits].min() > CLEARANCE - 2 * sway and heights[waits].max() < CLEARANCE + 2 * sway
    assert all(isinstance(c, Hold) for c, w in zip(run.commands, waits, strict=True) if w)
    pause = (stamps > 6.0) & (stamps < 9.0)
    assert not extrudes[pause].any() and np.ptp(places[pause]) == 0
    assert Phase.RETREATING in run.phases
    assert extrudes[stamps < 6.0].any() and extrudes[stamps > 9.0].any()
    again = np.flatnonzero(extrudes & (stamps > 9.0))[0]
    assert abs(heights[again]) < 0.1 and places[again] - places[pause][0] < 0.2
    assert (np.diff(places) >= 0).all()


def test_a_pause_that_ends_on_the_way_up_leads_back_to_the_path() -> None:
    run = Paused(breathing, (6.0, 6.2), 10.0, lambda now: False)
    assert max(run.heights[round(6.0 / PROFILE.tick) :]) < CLEARANCE + 1
    assert run.places[-1] > run.places[round(6.2 / PROFILE.tick)] + 2
