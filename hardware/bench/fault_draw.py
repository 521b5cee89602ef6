"""Faults of a campaign's runs: which, when, for how long, all from one seed."""

from __future__ import annotations

import numpy as np

from hardware.bench.fault_run import BEFORE
from hardware.process.faults import SPECS, Fault, Kind, Part, Runner

SLOT, PLACES = 2.6, 7  # s from one fault to the next, and faults of a run
SHORTEST, LONGEST = 0.15, 1.0  # s: long enough to be seen, short enough to be over before the next
AMOUNTS = {  # of what has one, uniform in the logarithm
    (Part.CAMERA, Kind.SLOW): (0.03, 0.3),  # s
    (Part.CAMERA, Kind.BUMP): (2.0, 10.0),  # mm: what is less is no harm to three cameras
    (Part.CLOCK, Kind.JUMP): (0.05, 5.0),  # s
    (Part.TRACKING, Kind.SLOW): (5.0, 60.0),  # %
    (Part.ARM, Kind.SLOW): (30.0, 90.0),  # %
    (Part.SURFACE, Kind.FAST): (30.0, 200.0),  # mm/s
    (Part.SURFACE, Kind.FOLD): (0.5, 5.0),  # mm
}
KINDS = [key for key, spec in SPECS.items() if Runner.SIMULATE in spec.runners]
LAST = [(part, kind) for part, kind in KINDS if kind is Kind.KILL]  # after which a run has nothing to go on with
PASSING = [key for key in KINDS if key not in LAST]


def drawn_faults(seed: int, number: int) -> list[Fault]:
    """The faults of a campaign's run; kinds take turns from run to run."""
    rng = np.random.default_rng([seed, number, 83])
    first = number * (PLACES - 1)
    keys = [PASSING[(first + i) % len(PASSING)] for i in range(PLACES - 1)]
    keys.append(LAST[number % len(LAST)])
    return [_fault(key, BEFORE + SLOT * place, rng) for place, key in enumerate(keys)]


def _fault(key: tuple[Part, Kind], slot: float, rng: np.random.Generator) -> Fault:
    start = round(slot + float(rng.uniform(0.0, 0.4)), 3)
    duration = round(_between(rng, SHORTEST, LONGEST), 3)
    amount = round(_between(rng, *AMOUNTS[key]), 3) if key in AMOUNTS else 0.0
    if key == (Part.CLOCK, Kind.JUMP):
        amount *= float(rng.choice([-1.0, 1.0]))
    if key[1] is Kind.KILL:
        duration = np.inf
    if key in ((Part.ARM, Kind.DROP), (Part.ARM, Kind.GARBLE)) and rng.random() < 0.5:
        duration = 0.0
    number = int(rng.integers(3)) if key[0] is Part.CAMERA else 0
    return Fault(*key, start, duration, amount, number, int(rng.integers(10**6)))


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
