"""The arm's commanded motion: six axes that follow a moving target under speed, acceleration and jerk limits.

Each axis aims at the state that the target will have LOOKAHEAD s from now, to reach it then. A time-optimal controller
that aims at the present state chatters between the limits (measured: 0.26 mm rms; this way 0.02 mm). If the quintic
from here to there keeps the limits, it is taken; otherwise the motion of Ruckig (Berscheid and Kroeger 2021), which
always keeps them. Ruckig alone is not enough: with a minimum duration its motions are not unique, and it was measured
to send an axis with nothing to do 0.17 mm away and back at full jerk (0.040 mm rms off a still path; this way 0.004).
"""

from __future__ import annotations

import numpy as np
from ruckig import ControlInterface, InputParameter, Ruckig, RuckigError, Synchronization, Trajectory

from estimation.se3 import Array
from planning.limits import MotionLimits

LOOKAHEAD = 0.1  # s; half of it doubled the error by chatter, twice of it by errors of the prediction
LIMIT_FRACTION = 0.999  # of each limit, so that rounding never breaks one


class AxisFollower:
    """Commanded position, velocity and acceleration of the axes (6,) each; a call moves them one tick."""

    def __init__(self, axes: Array, limits: MotionLimits, tick: float) -> None:
        self.position, self.velocity, self.acceleration = axes.copy(), np.zeros(6), np.zeros(6)
        self._speed = LIMIT_FRACTION * limits.per_tick(tick)
        self._acceleration, self._jerk = LIMIT_FRACTION * limits.acceleration, LIMIT_FRACTION * limits.jerk
        self._tick, self._ruckig = tick, Ruckig(6, tick)

    @property
    def at_rest(self) -> bool:
        """Whether no axis moves."""
        return not self.velocity.any() and not self.acceleration.any()

    def rest(self, axes: Array | None = None) -> None:
        """Set the motion to rest, at `axes` (6,) if given: the arm was stopped by others."""
        self.position = self.position if axes is None else axes.copy()
        self.velocity, self.acceleration = np.zeros(6), np.zeros(6)

    def aim(self, position: Array, velocity: Array, acceleration: Array) -> Array | str:
        """Move one tick towards the target's state (6,) each, LOOKAHEAD s from now; new axes (6,).

        A target faster than the limits is followed as fast as they allow. A str says why there is no such motion.
        """
        start = np.stack([self.position, self.velocity, self.acceleration])
        controls = _quintic(start, np.stack([position, velocity, acceleration]))
        limits = self._speed, self._acceleration, self._jerk
        within = [(np.abs(c) <= limit).all(axis=0) for c, limit in zip(controls[1:], limits, strict=True)]
        smooth = np.all(within, axis=0)  # (6,) axes whose quintic keeps the limits
        state = np.stack([_bezier(control, self._tick / LOOKAHEAD) for control in controls[:3]])
        if not smooth.all():
            request = self._request()
            request.target_position = position
            request.target_velocity = np.clip(velocity, -LIMIT_FRACTION * self._speed, LIMIT_FRACTION * self._speed)
            request.minimum_duration = LOOKAHEAD
            limited = self._solve(request)
            if isinstance(limited, str):  # the axes cannot share one duration: each as soon as it can
                request.synchronization, request.minimum_duration = Synchronization.No, None
                limited = self._solve(request)
            if isinstance(limited, str):
                return limited
            state = np.where(smooth, state, limited)
        return self._take(state)

    def brake(self) -> Array | str:
        """Move one tick towards rest as fast as the limits allow; new axes (6,), or why there is no such motion."""
        request = self._request()
        request.control_interface = ControlInterface.Velocity
        request.synchronization = Synchronization.No  # together, one brake in 30,000 ticks had no solution
        state = self._solve(request)
        return state if isinstance(state, str) else self._take(state)

    def _request(self) -> InputParameter:
        request = InputParameter(6)
        request.current_position, request.current_velocity = self.position, self.velocity
        request.current_acceleration = self.acceleration
        request.max_velocity, request.max_acceleration, request.max_jerk = self._speed, self._acceleration, self._jerk
        return request

    def _solve(self, request: InputParameter) -> Array | str:
        """Position, velocity and acceleration (3, 6) one tick on."""
        motion = Trajectory(6)  # not Ruckig.update: it keeps its last input, and answers an equal one with nothing
        try:
            self._ruckig.calculate(request, motion)
        except RuckigError as error:
            return f"no motion within the limits: {' '.join(str(error).split())[:80]}"
        state = np.array(motion.at_time(self._tick))
        return state if np.isfinite(state).all() else "no motion within the limits: its solution is not finite"

    def _take(self, state: Array) -> Array:
        self.position, self.velocity, self.acceleration = state
        if np.abs(self.velocity).max() < 1e-9 and np.abs(self.acceleration).max() < 1e-6:
            self.velocity, self.acceleration = np.zeros(6), np.zeros(6)
        return self.position.copy()


def _quintic(start: Array, end: Array) -> tuple[Array, Array, Array, Array]:
    """Bernstein control points (6 to 3, 6) of position, velocity, acceleration, jerk between states LOOKAHEAD s apart.

    start, end: (3, 6). A derivative stays between the least and the greatest of its control points.
    """
    (p0, v0, a0), (p1, v1, a1) = start, end
    fifth, twentieth = LOOKAHEAD / 5, LOOKAHEAD**2 / 20
    first_half = p0, p0 + fifth * v0, p0 + 2 * fifth * v0 + twentieth * a0
    position = np.stack([*first_half, p1 - 2 * fifth * v1 + twentieth * a1, p1 - fifth * v1, p1])
    velocity = 5 / LOOKAHEAD * np.diff(position, axis=0)
    acceleration = 4 / LOOKAHEAD * np.diff(velocity, axis=0)
    return position, velocity, acceleration, np.asarray(3 / LOOKAHEAD * np.diff(acceleration, axis=0))


def _bezier(control: Array, u: float) -> Array:
    """Value (6,) at u in 0..1 of the polynomial with control points (N, 6) (de Casteljau)."""
    while len(control) > 1:
        control = control[:-1] + u * (control[1:] - control[:-1])
    return np.asarray(control[0])
