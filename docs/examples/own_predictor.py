"""Write a predictor and see whether it is worth it: python docs/examples/own_predictor.py [SECONDS]

This one damps the newest velocity by what would have been best until now, for each time ahead.
"""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.forecast.predictor import Predictor
from estimation.pose import Forecast, SurfacePose
from estimation.synthetic.follow import follow
from estimation.synthetic.world import synthetic_world
from hardware.cli.parser import run_script

AHEAD = np.array([0.1, 0.2, 0.3, 0.5])  # s


class Damped:
    """A share of constant velocity, learned by least squares; its error so far is what it claims."""

    def __init__(self) -> None:
        self._past: list[SurfacePose] = []
        self._sums = np.full((3, len(AHEAD)), 1e-9)  # of velocity by motion, velocity squared, error squared

    def add(self, pose: SurfacePose) -> Forecast:
        """Learn from a measured pose, and forecast from it."""
        self._past.append(pose)
        for k, ahead in enumerate(AHEAD):
            then = next((p for p in reversed(self._past) if p.stamp <= pose.stamp - ahead), None)
            if then is not None:
                came = se3.log(se3.inverse(then.base_from_surface) @ pose.base_from_surface)[3:]
                said = ahead * then.twist[3:]
                error = came - self._sums[0, k] / self._sums[1, k] * said
                self._sums[:, k] = 0.995 * self._sums[:, k] + [came @ said, said @ said, error @ error]
        share, variance = self._sums[0] / self._sums[1], 0.005 * self._sums[2]
        units = np.diag([1e-6, 1e-6, 1e-6, 1, 1, 1])
        return Forecast(AHEAD, (share * AHEAD)[:, None] * pose.twist, variance[:, None, None] * units)


def main(seconds: float = 40.0) -> None:
    """RMS error, mm, of the origin in the last 40 % of a breathing world: hold, this predictor, stillbed's own."""
    world = synthetic_world("breathing", seconds=float(seconds), seed=4)
    poses, mine, ours, errors = follow(world, "told").poses, Damped(), Predictor(), []
    for pose in poses:
        moves = [np.zeros((len(AHEAD), 6))]
        moves += [moves[0] if f is None else f.at(AHEAD)[0] for f in (mine.add(pose), ours.add(pose))]
        true = world.base_from_surface(pose.stamp + AHEAD)[:, :3, 3]
        errors.append([(pose.base_from_surface @ se3.exp(move))[:, :3, 3] - true for move in moves])
    late = np.linalg.norm(np.array(errors)[int(0.6 * len(poses)) :], axis=-1)  # (T, 3, H)
    for ahead, (hold, own, built) in zip(AHEAD, np.sqrt((late**2).mean(axis=0)).T, strict=True):
        print(f"{1000 * ahead:.0f} ms: hold {hold:.3f}, damped velocity {own:.3f}, built in {built:.3f} mm")


if __name__ == "__main__":
    run_script(main, __doc__)
