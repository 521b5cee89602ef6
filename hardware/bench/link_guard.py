"""Random commands before the guard, on and beside all its limits, judged by an oracle of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.bench.campaigns.guard import Log, Rules, judge
from hardware.bench.figures import Figure, at_most
from perception.package_data import shipped_file
from planning.command import Command, Hold, Move
from planning.kinematics import SimpleArm
from planning.limits import Limits
from planning.motion.guard import Guard
from planning.no_go import NoGo, box, cylinder, half_space

CHUNK = 10_000  # commands of one run
ZONE = np.array([[-20.0, -20, -1], [20, 20, 5]])
REST = se3.make(np.eye(3), [202.5, 225.0, 50.0])  # base_from_surface
TICK, LAG = 0.02, 0.024  # s
BOX = np.array([12.0, 12, 12, 0.15, 0.15, 0.15])  # mm and rad about home
OUTAGE = 0.01, 0.8  # share of the poses at which the surface is lost, and s for which at most
STATES = list(TrackState)


def guard_figures(commands: int, seed: int) -> list[Figure]:
    """How many random commands passed that break a limit, and the other way round."""
    arms = simple(), simple(), simple(), jointed()
    counts = np.zeros(4, int)
    for k in range(max(1, round(commands / CHUNK))):
        rules = arms[k % len(arms)]
        counts += judge(random_log(seed + k, min(CHUNK, commands), rules), rules)
    asked, passed, broken, refused = counts.tolist()
    what = "guard: random commands"
    return [
        Figure(what, asked, "", note=f"{passed} passed; one in four runs with an arm that is sent its joints"),
        Figure(f"{what} that break a limit and passed", broken, "", at_most(0), "", "by an independent oracle"),
        Figure(f"{what} that keep all and were refused", refused, "", at_most(0)),
    ]


def simple() -> Rules:
    """The thesis's arm, whose controller sees to its joints."""
    return Rules(SimpleArm(), boxed(Limits()), ZONE, TICK, LAG)


def jointed() -> Rules:
    """An arm that is sent its last three joints."""
    from hardware.files.arm_file import read_arm

    profile = read_arm(shipped_file("arms", "six_axis.toml"))
    return Rules(profile.arm, boxed(profile.limits), ZONE, TICK, LAG)


def boxed(limits: Limits) -> Limits:
    """The limits with bounds so near home that random steps meet them."""
    home = SimpleArm().home
    return replace(limits, low=home - BOX, high=home + BOX, zones=zones_about(home[:3]))


def zones_about(home: Array) -> tuple[NoGo, ...]:
    """One zone of each kind about a place (3,), mm, that steps there meet: a bed below, a block and a post."""
    return (
        half_space("bed", np.array([0.1, 0, 1.0]), home - [0, 0, 9]),
        box("block", home + [5, 4, 2], home + [9, 8, 9]),
        cylinder("post", home - [7, 6, 20], home - [7, 6, -20], 1.5),
    )


def random_log(seed: int, count: int, rules: Rules, guard: Guard | None = None) -> Log:
    """`count` commands near all limits, and what a guard, the real one if none is given, makes of them."""
    draw = np.random.default_rng(seed)
    arm, limits = rules.arm, rules.limits
    guard = Guard(limits, arm, rules.tick, rules.zone, rules.lag) if guard is None else guard
    rows, poses, now, lost_until = [], [], 0.0, 0.0
    for _ in range(count):
        now += draw.choice([TICK, 0.1, 0.0, -TICK], p=[0.9, 0.06, 0.02, 0.02])
        stamp = now if draw.random() < 0.98 else now + draw.choice([1e-9, -TICK, np.nan])
        if draw.random() < OUTAGE[0]:
            lost_until = now + draw.uniform(0, OUTAGE[1])
        pose = None if now < lost_until else random_pose(draw, now, rules)
        axes, feed = random_move(draw, guard.axes, rules)
        hold, extrude = draw.random() < 0.05, draw.random() < 0.5
        command: Command = Hold(stamp, 0.001, "") if hold else Move(stamp, axes, feed, 0, bool(extrude))
        passed = guard(command, pose, now) is command
        rows.append([stamp, now, *axes, feed, extrude, hold, passed])
        poses.append(pose)
    table = np.array(rows)
    flags = table[:, 9:].astype(bool)
    return Log(table[:, 0], table[:, 1], table[:, 2:8], table[:, 8], flags[:, 0], flags[:, 1], poses, flags[:, 2])


def random_move(draw: np.random.Generator, before: Array, rules: Rules) -> tuple[Array, float]:
    """Axes (6,) and feed: a step about home, often on a limit or a hair beyond it."""
    limits = rules.limits
    near = draw.choice([0.2, 0.5, 1.0, 1 + 1e-9, 1 - 1e-9, 1.5], p=[0.5, 0.38, 0.03, 0.03, 0.03, 0.03])
    near = near * draw.choice([1.0, 0.05])
    way = draw.normal(size=6) * limits.speed + draw.choice([0.0, 0.0, 3.0]) * (rules.arm.home - before)
    share = max(np.abs(way / limits.speed).max(), float(np.linalg.norm(way[:3])) * TICK / limits.jump)  # of the limits
    axes = before + near * TICK * way / share
    if draw.random() < 0.03:
        axis = draw.integers(6)
        low, high = limits.low[axis], limits.high[axis]
        axes[axis] = draw.choice([low, high, np.nan, np.inf, np.nextafter(high, np.inf), np.nextafter(low, -np.inf)])
    feed = limits.feed * draw.choice([0.3, 1.0, 1 + 1e-9, 0.0, -1.0, np.nan], p=[0.9, 0.05, 0.02, 0.01, 0.01, 0.01])
    return axes, float(feed)


def random_pose(draw: np.random.Generator, now: float, rules: Rules) -> SurfacePose | None:
    """A pose, mostly worth following, sometimes on or beyond one of its limits; now and then there is none."""
    limits = rules.limits
    if draw.random() < 0.02:
        return None
    age = limits.pose_age * draw.choice([0.1, 0.5, 0.999, 1.001, -0.01], p=[0.4, 0.52, 0.03, 0.03, 0.02])
    state = STATES[draw.choice(len(STATES), p=[0.02 if not s.measured else 0.47 for s in STATES])]
    known = limits.pose_error * draw.choice([0.1, 0.5, 0.99, 1.01], p=[0.5, 0.44, 0.03, 0.03])
    covariance = known**2 * np.diag([1e-6, 1e-6, 1e-6, 1.0, *draw.uniform(0.1, 1.0, 2)])
    turn, speed = draw.normal(size=3), draw.normal(size=3)
    turn *= limits.surface_turn * draw.choice([0.1, 0.9, 1.001], p=[0.85, 0.1, 0.05]) / np.linalg.norm(turn)
    speed *= limits.surface_speed * draw.choice([0.1, 0.7, 1.3], p=[0.85, 0.1, 0.05]) / np.linalg.norm(speed)
    twist = np.concatenate([turn, speed])
    if draw.random() < 0.01:
        twist[draw.integers(6)] = np.nan
    base = REST @ se3.exp(draw.normal(size=6) * [0.05, 0.05, 0.05, 3, 3, 3])
    drift, psd = (
        np.diag([0, 0, 0, 1.0, 1, 1]) * draw.choice([0.0, 1.0]),
        np.array([0, 0, 0, 1.0, 1, 1]) * draw.choice([0, 5]),
    )
    return SurfacePose(now - age, base, covariance, twist, state, drift, psd)
