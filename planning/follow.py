"""The arm's commanded motion: six axes that follow a moving target under speed, acceleration and jerk limits.

Ruckig (Berscheid and Kroeger 2021) is aimed at the state that the target will have LEAD s ahead, with LEAD as the least
time to get there. Aimed at the present position and velocity it is a time-optimal controller and chatters between the
limits (measured: 0.26 mm rms at the full acceleration limit; this way 0.02 mm at a third of it).
"""

from __future__ import annotations

import numpy as np
from ruckig import ControlInterface, InputParameter, Ruckig, RuckigError, Trajectory

from estimation.se3 import Array
from planning.limits import Limits

LEAD = 0.1  # s; half of it doubled the error by chatter, twice of it by what the prediction lacks
WITHIN = 0.999  # of each limit, so that rounding never breaks one


class Follower:
    """Where the axes (6,) are commanded to be, and how they move there: one tick of motion a call."""

    def __init__(self, axes: Array, limits: Limits, tick: float) -> None:
        self.position, self.velocity, self.acceleration = axes.copy(), np.zeros(6), np.zeros(6)
        per_tick = np.repeat([limits.jump / 3**0.5, limits.turn], 3) / tick
        self._speed = WITHIN * np.minimum(limits.speed, per_tick)
        self._acceleration, self._jerk = WITHIN * limits.acceleration, WITHIN * limits.jerk
        self._tick, self._ruckig = tick, Ruckig(6, tick)

    @property
    def at_rest(self) -> bool:
        """Whether nothing moves any more."""
        return not self.velocity.any() and not self.acceleration.any()

    def rest(self, axes: Array | None = None) -> None:
        """Take it that the arm stands still, at `axes` (6,) where they are given: it was stopped by something else."""
        self.position = self.position if axes is None else axes.copy()
        self.velocity, self.acceleration = np.zeros(6), np.zeros(6)

    def aim(self, position: Array, velocity: Array) -> Array | str:
        """Move one tick towards a target that in LEAD s will be at `position` (6,) with `velocity` (6,); new axes (6,).

        A target faster than the limits is followed as fast as they allow. A str says why there is no such motion.
        """
        request = self._request()
        request.target_position = position
        request.target_velocity = np.clip(velocity, -WITHIN * self._speed, WITHIN * self._speed)
        request.minimum_duration = LEAD
        return self._step(request)

    def brake(self) -> Array | str:
        """Move one tick towards rest, as soon as the limits allow; new axes (6,)."""
        request = self._request()
        request.control_interface = ControlInterface.Velocity
        return self._step(request)

    def _request(self) -> InputParameter:
        request = InputParameter(6)
        request.current_position, request.current_velocity = self.position, self.velocity
        request.current_acceleration = self.acceleration
        request.max_velocity, request.max_acceleration, request.max_jerk = self._speed, self._acceleration, self._jerk
        return request

    def _step(self, request: InputParameter) -> Array | str:
        motion = Trajectory(6)
        try:
            self._ruckig.calculate(request, motion)
        except RuckigError as error:
            return f"no motion within the limits: {error}"
        state = np.array(motion.at_time(self._tick))  # (3, 6)
        if not np.isfinite(state).all():
            return "no motion within the limits: the solution is not finite"
        self.position, self.velocity, self.acceleration = state
        if np.abs(self.velocity).max() < 1e-9 and np.abs(self.acceleration).max() < 1e-6:
            self.velocity, self.acceleration = np.zeros(6), np.zeros(6)
        return self.position.copy()
