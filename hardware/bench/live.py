"""`stillbed bench live`: whole runs in real time before pre-rendered cameras with the virtual arm, all processes in it.

Rendering takes ten times as long as the pictures last, so they are rendered once and shown by a process of their own.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hardware.bench.figures import Figure, at_least, at_most
from hardware.bench.live_kills import kill_figures
from hardware.bench.live_session import LiveSession
from hardware.cache_folder import cache_folder
from hardware.evenness import Evenness, evenness
from hardware.files.path_file import read_path, write_path
from hardware.live.beside import Beside
from hardware.live.motion_names import EXPOSURE_TO_WIRE, FRAMES_TO_WIRE, LATE
from hardware.live.prerender import prerender
from hardware.live.recorded_run import TrueError, judge_run
from hardware.live.settings import LiveSettings, cores_there, settings_text
from hardware.process.clock import WallClock
from planning.path import Path as Toolpath
from planning.path import lengths

STOP_EVERY = 8.0  # s between stops of the run that is stopped again and again
PIECES = 20000  # of work that the machine is given before a run: ten seconds
WEIGH_EVERY = 2.0  # s between looks at the memory
SETTLED = 0.3  # share of a run after which its memory counts: key frames are full then
HOMING = "\nhoming\n"  # what a run says once its path is printed
KILLED = 90.0  # s of a path that is printed by runs which are killed after some seconds each
STAGES = "frames wait for the tracker", "tracking", "frames handed over to pose"
STOP = "stop decided to on the wire"


def run(options: argparse.Namespace) -> list[Figure]:
    """The figures of all runs that were asked for."""
    rendered = prerender(options.scenario, cache_folder())
    with tempfile.TemporaryDirectory(prefix="stillbed-live-") as name:
        folder, figures = Path(name), list[Figure]()
        long = folder / "long.csv"
        write_path(long, to_and_fro(read_path(rendered.path), 60 * (options.minutes or 1.0)))
        if options.minutes:
            figures = _printing(options, folder, long, rendered.arm)
        if options.stops:
            figures += _stopping(options, folder, long)
        if options.kills:
            killed = folder / "killed.csv"
            write_path(killed, to_and_fro(read_path(rendered.path), KILLED))
            figures += kill_figures(options.scenario, folder, killed, options.kills, options.seed, options.out)
    return figures


def to_and_fro(path: Toolpath, seconds: float) -> Toolpath:
    """The path printed again and again, there and back, for so long."""
    once = float(np.sum(lengths(path.surface_from_nozzle) / path.speed[1:]))
    count, there = len(path), np.arange(len(path))
    order = list(there)
    while len(order) < seconds / once * count:
        order += list(there[-2::-1] if order[-1] == count - 1 else there[1:])
    index = np.array(order[: max(int(seconds / once * count), 2)])
    return replace(
        path,
        surface_from_nozzle=path.surface_from_nozzle[index],
        speed=path.speed[index],
        material=path.material[index],
        temperature=path.temperature[index],
        layer=path.layer[index],
        extrude=path.extrude[np.maximum(index, 1)],
        extra={},
    )


def _printing(options: argparse.Namespace, folder: Path, path: Path, arm: Path) -> list[Figure]:
    record, clock = folder / "print.mcap", WallClock()
    told, alone = _arguments(options.scenario, record, path), evenness(clock, PIECES)
    run = LiveSession([*([str(_pinned(folder))] if options.pinned else []), *told])
    load = []
    try:
        begun = run.wait_for("\nprint\n")
        while begun >= 0 and run.process.poll() is None and run.said.find(HOMING, begun) < 0:
            run.weigh()
            load.append(os.getloadavg()[0])
            clock.wait_until(clock.now() + WEIGH_EVERY)
        run.end()
    finally:
        run.close()
    found: dict[str, Any] = json.loads(Beside(record).summary.read_text(encoding="utf-8"))
    error = judge_run(record, path, arm)
    note = f"load {np.mean(load or [np.nan]):.1f} on {os.cpu_count()} cores"
    name = f"live {options.minutes:g} min" + (", pinned" if options.pinned else "")
    return [
        *_latencies(name, found, note),
        *_machine(name, alone),
        *_errors(name, found, error),
        *_burden(name, found, run.memory),
    ]


def _latencies(name: str, found: dict[str, Any], note: str) -> list[Figure]:
    times = found["latency_ms"]
    wire, exposure, late = (times.get(stage, {}) for stage in (FRAMES_TO_WIRE, EXPOSURE_TO_WIRE, LATE))
    return [
        Figure(f"{name}: frames to wire, median", _of(wire, "p50"), "ms", at_most(20), "thesis: 180 ms", note),
        Figure(f"{name}: frames to wire, 99 %", _of(wire, "p99"), "ms", at_most(35)),
        Figure(f"{name}: frames to wire, largest", _of(wire, "max"), "ms", at_most(60)),
        Figure(f"{name}: exposure to wire, median", _of(exposure, "p50"), "ms"),
        *(Figure(f"{name}: {stage}, median", _of(times.get(stage, {}), "p50"), "ms") for stage in STAGES),
        Figure(f"{name}: tick late, 99 %", _of(late, "p99"), "ms", at_most(3)),
    ]


def _machine(name: str, alone: Evenness) -> list[Figure]:
    note = f"{1000 * alone.usual:.1f} ms usually; before the run, nothing else of it running: no run can be more even"
    return [
        Figure(f"{name}: the machine alone, a piece of work at the worst", 1000 * alone.largest, "ms", note=note),
        Figure(f"{name}: the machine alone, time in which work is slow", 100 * alone.slow, "%", note="three times"),
    ]


def _errors(name: str, found: dict[str, Any], error: TrueError) -> list[Figure]:
    done = f"ended: {found['ended']}"
    return [
        Figure(f"{name}: nozzle error, 95 %", error.figure(95), "mm", at_most(0.5), "", done),
        Figure(f"{name}: nozzle error, largest", error.figure(100), "mm", at_most(1.0)),
        Figure(f"{name}: duty", 100 * error.duty, "%", at_least(80)),
        Figure(f"{name}: most queued in the arm", 1000 * error.deepest, "ms", at_most(50)),
        Figure(f"{name}: virtual arm held up by the machine, longest", 1000 * error.held_up, "ms"),
        Figure(f"{name}: frame sets left out", found["frame_sets_dropped"], "", None, "", f"of {found['frame_sets']}"),
    ]


def growth(memory: Sequence[tuple[float, dict[str, float]]]) -> dict[str, tuple[float, float]]:
    """By process, from s and MB each: MB an hour by which it grows once it has settled, and MB in the end."""
    settled = memory[int(SETTLED * len(memory)) :]
    stamps = np.array([stamp for stamp, _ in settled])
    found = {}
    for name in settled[-1][1] if len(settled) > 5 else ():
        held = np.array([each.get(name, np.nan) for _, each in settled])
        there = np.isfinite(held)
        slope = np.polyfit(stamps[there] - stamps[0], held[there], 1)[0] if there.sum() > 5 else np.nan
        found[name] = float(3600 * slope), float(held[-1])
    return found


def _burden(name: str, found: dict[str, Any], memory: Sequence[tuple[float, dict[str, float]]]) -> list[Figure]:
    share, grown = found["recorder_share_of_core"], growth(memory)
    slope, size = (sum(each[k] for each in grown.values()) if grown else np.nan for k in (0, 1))
    told = ", ".join(f"{process} {by:+.0f}" for process, (by, _) in grown.items())
    return [
        Figure(
            f"{name}: recorder", 100 * (share or np.nan) / 2, "%", at_most(3), "", "of two cores, its start included"
        ),
        Figure(f"{name}: not recorded", found["unrecorded"], "", at_most(0)),
        Figure(f"{name}: memory grows", slope, "MB/h", at_most(5), "", f"{told}; a short run tells little"),
        Figure(f"{name}: memory", size, "MB"),
    ]


def _stopping(options: argparse.Namespace, folder: Path, path: Path) -> list[Figure]:
    record, clock = folder / "stop.mcap", WallClock()
    run = LiveSession(_arguments(options.scenario, record, path)[:-1])  # attended
    try:
        at = run.wait_for("confirm")
        run.press("y")
        at = run.wait_for("ready", at)
        run.press("s")
        for _ in range(options.stops):
            at = run.wait_for("\nprint\n", max(at, 0) - 1)
            clock.wait_until(clock.now() + STOP_EVERY / 4)
            run.press(" ")
            at = run.wait_for("stopped: by the operator\n", max(at, 0))
            clock.wait_until(clock.now() + STOP_EVERY / 8)
            run.press("r")
        run.press("q")
        run.end()
    finally:
        run.close()
    found = json.loads(Beside(record).summary.read_text(encoding="utf-8"))["latency_ms"].get(STOP, {})
    note = f"{found.get('count', 0)} stops by the terminal"
    return [
        Figure("stop decided to on the wire, 99 %", _of(found, "p99"), "ms", at_most(10), "", note),
        Figure("stop decided to on the wire, largest", _of(found, "max"), "ms"),
    ]


def _pinned(folder: Path) -> Path:
    """A session.toml that gives each loop a core of its own."""
    file = folder / "session.toml"
    one, other = cores_there()[:1], cores_there()[1:2]
    file.write_text(settings_text(LiveSettings(cores_tracking=one, cores_motion=other, cores_recorder=other)))
    return file


def _arguments(scenario: Path, record: Path, path: Path) -> list[str]:
    return ["--simulated", str(scenario), "--record", str(record), "--path", str(path), "--no-page", "--yes"]


def _of(span: dict[str, Any], key: str) -> float:
    return float(span[key]) if span.get(key) is not None else float("nan")
