"""What a planner tells the dispenser, each tick: its rests on the way, and the flow with the dispenser's delay led."""

from __future__ import annotations

import math

import numpy as np

from planning.material import OWN_OUTLET, ROUNDING, MaterialPlan, Outlet, Outlets, Rest
from planning.motion.retime import Timing

SWITCH_STEP = 0.001  # s: a switch is timed to that, 0.03 mm at 30 mm/s
MIN_FLOW_SPEED = 1.0  # mm/s: a metered dispenser is told no less of the bead while it is open


FlowOrder = tuple[float, float]  # flow, mm^3/s, and when in the tick it is told, s


class RestsAhead:
    """Which rest of a path comes next, and what it waits for.

    wanted: material that an operator has to put in before the print goes on; "" if none.
    """

    def __init__(self, plan: MaterialPlan, place: float) -> None:
        """place: mm, where printing begins; a rest there is still to come."""
        self._plan, self.wanted = plan, ""
        self._number = sum(rest.place < place - ROUNDING for rest in plan.rests)
        self._until = math.nan  # s, until when it lasts; NaN: it is not reached

    @property
    def next(self) -> Rest | None:
        """The rest that comes next or that it is at; None before the end."""
        return self._plan.rests[self._number] if self._number < len(self._plan.rests) else None

    @property
    def end(self) -> float:
        """mm of the path until there."""
        return float(self._plan.knots[-1]) if self.next is None else self.next.place

    def left(self, place: float, now: float) -> float:
        """Seconds of the rest at `place`, mm, that are left at `now`, s; 0 where there is none. It begins here."""
        rest = self.next
        if rest is None or place < rest.place - ROUNDING:
            return 0.0
        if rest.material:
            self.wanted = rest.material
        if math.isnan(self._until):
            self._until = now + rest.wait
        return max(self._until - now, 0.0)

    def passed(self) -> None:
        """Go on to the next."""
        self.wanted, self._number, self._until = "", self._number + 1, math.nan


class FlowCommands:
    """The flow that the dispenser is told, tick by tick.

    begun: s, when the nozzle begins or began to print; nothing leaves sooner.
    """

    def __init__(self, plan: MaterialPlan, outlets: Outlets, lag: float, tick: float) -> None:
        """lag: s from one tick after a command until the arm is at its axes. tick: s between calls."""
        self._plan, self._outlets, self.lag, self._tick = plan, outlets, lag, tick
        self._steps = np.arange(0.0, tick - SWITCH_STEP / 2, SWITCH_STEP)
        self._flow = 0.0  # mm^3/s last told
        self.begun = math.inf

    def outlet(self, material: str) -> Outlet:
        """The outlet of a material."""
        return self._outlets.get(material, OWN_OUTLET)

    def lead_on(self, place: float) -> float:
        """How long, s, an opening has to be told before the nozzle moves off from `place`, mm."""
        return self.outlet(self._plan.material_at(place)).delay.leads(self.lag)[0]

    def closed(self) -> FlowOrder:
        """Tell the dispenser to close, at once."""
        self._flow = 0.0
        return 0.0, 0.0

    def __call__(self, timing: Timing, place: float, end: float, now: float) -> FlowOrder:
        """The flow, mm^3/s, that is told in the tick at `now`, s, and how far into the tick, s.

        timing: of the printing that the nozzle follows. place: mm, where it is. end: mm, of the next rest.
        """
        on, off = self.outlet(self._plan.material_at(place)).delay.leads(self.lag)
        times = now + self._steps
        led_on = timing.at(times + on)
        is_open = self._plan.open(led_on, timing.at(times + off), end)
        is_open &= (times + on >= self.begun) & (times + off < timing.end)  # a horizon that is not renewed ends at rest
        changes = np.flatnonzero(is_open != (self._flow > 0))
        at = int(changes[0]) if len(changes) else 0
        if (len(changes) > 0) == (self._flow > 0):  # it closes, or stays closed
            self._flow = 0.0
        else:
            speed = max(timing.speed_at(float(times[at]) + on), MIN_FLOW_SPEED)
            self._flow = self._plan.area_at(float(led_on[at])) * speed
        return self._flow, float(self._steps[at])
