"""The estimator on the tracks of synthetic worlds: accuracy beside the Cramer-Rao bound, consistency, time, soak."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from fnmatch import fnmatch

import numpy as np

from estimation.errors import InputError
from estimation.synthetic.follow import Followed, Mapping, follow
from estimation.synthetic.world import World, synthetic_world
from hardware.bench.figures import Figure, Target, at_most
from hardware.bench.pooled import Pooled, pooled
from hardware.bench.scenes import SCENES, Scene
from hardware.bench.soak import soak_figures
from hardware.bench.solve_pnp import best_camera
from hardware.process.clock import CpuClock

CONSISTENT, INSIDE = Target(0.8, 1.25), Target(0.93, 0.97)
MAPS: dict[Mapping, str] = {"told": "exact map", "seen": "own map"}


def run(options: argparse.Namespace) -> list[Figure]:
    """All figures of the scenes asked for, or those of the soak."""
    if options.soak is not None:
        return [f for mapping in options.maps for f in soak_figures(options.soak, mapping, MAPS[mapping])]
    figures: list[Figure] = []
    runs: dict[Mapping, list[Followed]] = {mapping: [] for mapping in options.maps}
    for scene in _asked(options.only):
        worlds = [world_of(scene, seed, options) for seed in range(options.seeds)]
        beside = best_camera(worlds)
        for mapping in options.maps:
            followed = [follow(world, mapping, CpuClock().now) for world in worlds]
            found = pooled(followed)
            print(f"{scene.name + ', ' + MAPS[mapping]:<48}{found}", file=sys.stderr, flush=True)
            figures += scene_figures(scene, MAPS[mapping], found, beside)
            figures += _offset_figures(scene, MAPS[mapping], followed)
            runs[mapping] += followed
    return figures + [f for mapping in options.maps for f in _work_figures(mapping, runs[mapping])]


def _asked(pattern: str) -> list[Scene]:
    found = [scene for scene in SCENES if fnmatch(scene.name, pattern)]
    if not found:
        raise InputError("command line", "--only", pattern, f"a pattern of {'; '.join(s.name for s in SCENES)}")
    return found


def world_of(scene: Scene, seed: int, options: argparse.Namespace) -> World:
    """One world of a scene."""
    conditions = {"noise": options.noise, **scene.conditions}
    seconds = scene.seconds if options.seconds is None else options.seconds
    return synthetic_world(scene.movement, seconds, count=options.count, surface=scene.surface, seed=seed, **conditions)


def scene_figures(scene: Scene, of_map: str, found: Pooled, beside: tuple[float, float]) -> list[Figure]:
    """The figures of one scene with one kind of map. beside: RMSE by solvePnP with the exact one, mm and degrees."""
    name = f"{scene.name}, {of_map}"
    rigid = scene.rigid and scene.error is not None
    near = at_most(1.3) if scene.rigid else None
    moved = f"bound {found.bound_mm:.4f}, filtered {found.filtered_mm:.4f}, solvePnP {beside[0]:.3f}"
    turned = f"bound {found.bound_deg:.4f}, filtered {found.filtered_deg:.4f}, solvePnP {beside[1]:.3f}"
    return [
        Figure(f"{name}: error", found.error_mm, "mm", scene.error, moved),
        Figure(f"{name}: turn", found.error_deg, "deg", at_most(0.05) if rigid else None, turned),
        Figure(f"{name}: error by bound", found.error_mm / found.bound_mm, "", near),
        Figure(f"{name}: turn by bound", found.error_deg / found.bound_deg, "", near),
        Figure(f"{name}: NEES/6", found.nees, "", CONSISTENT),
        Figure(f"{name}: twist NEES/6", found.twist_nees, "", CONSISTENT),
        Figure(f"{name}: inside 95 %", found.inside, "", INSIDE),
    ]


def _offset_figures(scene: Scene, of_map: str, runs: Sequence[Followed]) -> list[Figure]:
    """How well the cameras' offsets are known at the end; what all clocks have in common cannot be seen."""
    if "offsets" not in scene.conditions:
        return []
    true = np.array(scene.conditions["offsets"])
    known = [run.offsets - run.offsets.mean() for run in runs]
    off = 1000 * float(np.sqrt(np.mean((np.array(known) - true + true.mean()) ** 2))) if known else float("nan")
    note = "" if known else "not estimated"
    return [Figure(f"{scene.name}, {of_map}: offsets off by", off, "ms", at_most(2.0), "thesis under 1 s", note)]


def _work_figures(mapping: Mapping, runs: Sequence[Followed]) -> list[Figure]:
    """Time over all runs, and whether a world run twice gives the same bits."""
    if not runs:
        return []
    milliseconds = 1000 * np.concatenate([run.seconds for run in runs])
    median, late = np.percentile(milliseconds, [50, 99])
    name = MAPS[mapping]
    return [
        Figure(f"time, {name}: median", float(median), "ms", None, "thesis 70 ms with flow", "CPU, tracks given"),
        Figure(f"time, {name}: p99", float(late), "ms", at_most(4.0), "", "CPU, tracks given"),
        Figure(f"poses that differ run twice, {name}", float(_differing(mapping)), "", at_most(0), "open_vins #553"),
    ]


def _differing(mapping: Mapping) -> int:
    first, second = (follow(synthetic_world(seconds=3.0, offsets=(0.0, 0.01, 0.0)), mapping) for _ in range(2))
    return sum(
        a.base_from_surface.tobytes() + a.covariance.tobytes() + a.twist.tobytes()
        != b.base_from_surface.tobytes() + b.covariance.tobytes() + b.twist.tobytes()
        for a, b in zip(first.poses, second.poses, strict=True)
    )
