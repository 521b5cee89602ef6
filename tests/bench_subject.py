"""A subject of the bench that measures nothing: one figure of each kind."""

from __future__ import annotations

import argparse
import math

from hardware.bench.figures import Figure, Target, at_least, at_most


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--error", type=float, default=0.02)


def run(options: argparse.Namespace) -> list[Figure]:
    return [
        Figure("error", options.error, "mm", at_most(0.03), "thesis 0.5 % of the edge"),
        Figure("consistency", 1.0, "", Target(0.8, 1.25)),
        Figure("inside", 0.9, "", at_least(0.93)),
        Figure("tracks", 300.0),
        Figure("missing", math.nan, "s", at_most(1.0), note="not here"),
    ]
