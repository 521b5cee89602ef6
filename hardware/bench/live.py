"""Subject `live`: whole runs in real time before pre-rendered cameras with the virtual arm, all processes in it.

Rendering takes ten times as long as the pictures last, so they are rendered once and shown by a process of their own.
Kills: random processes of a run end at random instants. Is the arm at rest? Does the next run go on where it was?
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.bench.figures import Figure, append_rows, at_least, at_most, with_progress
from hardware.bench.whole import LiveSession
from hardware.files.path_file import read_path, write_path
from hardware.live.prepared import RunFiles
from hardware.live.prerender import prerender
from hardware.live.recorded_run import NozzleErrors, nozzle_errors, printed_range
from hardware.live.records import EXPOSURE_TO_WIRE_STAGE, FRAMES_TO_WIRE_STAGE, LATE_TICK_STAGE
from hardware.live.settings import LiveSettings, available_cores, settings_text
from hardware.process.checks import read_toml
from hardware.process.clock import WallClock
from hardware.process.progress import cache_folder
from hardware.process.ticks import Evenness, measure_evenness
from hardware.recording.session_reader import open_session
from planning.path import Path as Toolpath
from planning.path import way_lengths

WATCHED_PROCESSES = ("tracking", "motion", "recorder")  # by the process that conducts; the feed's end is the cameras'
VICTIMS = ("run", "tracking", "motion", "recorder", "feed")
PRINTED_TEXT = "the path is printed"
MAX_PRINTING = 3.0  # s of printing before a kill
# s after a kill in which the arm must have come to rest: noticed in 0.1, queued for 0.05, its servo
MAX_REST_DELAY = 0.5
MIN_REST = 0.05  # s of rest that are looked at
REST_RADIUS = 0.05  # mm from where it ended
END_PATIENCE = 60.0  # s in which the others must have ended
EXECUTED_PATIENCE = 30.0  # s in which the virtual arm has written what it did


@dataclass(slots=True)
class Kills:
    """What came of them."""

    out: Path | None = None  # for a table, and for what is left of runs whose arm moved on; None: nothing is kept
    count: int = 0
    rests: list[float] = field(default_factory=list)  # s after each kill until the arm rested
    stuck: list[str] = field(default_factory=list)  # last words of the runs that did not print
    lost: list[float] = field(default_factory=list)  # checkpoints, of each resumed run
    doubled: list[float] = field(default_factory=list)  # likewise
    unread: list[float] = field(default_factory=list)  # s before the kill from which the recording cannot be read
    noticed: list[float] = field(default_factory=list)  # s until the conducting process said so

    def keep(self, record: Path, victim: str, place: float) -> None:
        """Add the last kill to the table; where the arm moved on, keep all that the run has left."""
        if self.out is None:
            return
        row = (record.name, victim, f"{self.rests[-1]:.3f}", f"{place:.3f}")
        append_rows(self.out / "kills.csv", ("record", "killed", "rests_s", "place"), [row])
        for left in record.parent.glob(f"{record.stem}.*") if self.rests[-1] > MAX_REST_DELAY else ():
            shutil.copy(left, self.out)


def kill_figures(scenario: Path, folder: Path, path: Path, count: int, seed: int, out: Path | None) -> list[Figure]:
    """Kill `count` processes, each in the run that resumes the one before; after a finished print a new one begins."""
    rng, kills = np.random.default_rng(seed), Kills(out)
    record: Path | None = None
    place = math.nan
    for number in with_progress("kills", "kills", range(count), count):
        fresh = record is None
        if record is None:
            record, place = folder / f"kill{number}.mcap", math.nan
            arguments = ["--simulated", str(scenario), "--path", str(path), "--record", str(record)]
        else:
            arguments = ["--resume", str(record)]
            record = RunFiles(record).next().record
        run = LiveSession([*arguments, "--no-page", "--yes"])
        place = _kill(run, record, kills, rng, None if fresh else place)
        record = record if np.isfinite(place) else None
    name = f"{kills.count} kills"
    late = sum(s > MAX_REST_DELAY for s in kills.rests)
    most_noticed = 1000 * max(kills.noticed, default=np.nan)
    return [
        Figure(f"{name}: arms not at rest after {MAX_REST_DELAY:g} s", late, "", at_most(0)),
        Figure(f"{name}: arm at rest after, median", 1000 * float(np.median(kills.rests or np.nan)), "ms"),
        Figure(f"{name}: arm at rest after, most", 1000 * max(kills.rests, default=np.nan), "ms"),
        Figure(f"{name}: runs that did not print again", len(kills.stuck), "", at_most(0), "", "; ".join(kills.stuck)),
        Figure(f"{name}: most left out", max(kills.lost, default=np.nan), "checkpoints", at_most(1)),
        Figure(f"{name}: most printed twice", max(kills.doubled, default=np.nan), "checkpoints", at_most(0)),
        Figure(f"{name}: death of a process noticed, median", 1000 * float(np.median(kills.noticed or np.nan)), "ms"),
        Figure(f"{name}: death of a process noticed, most", most_noticed, "ms", at_most(100)),
        Figure(f"{name}: recording ends before the kill, most", max(kills.unread, default=np.nan), "s", at_most(1)),
    ]


def _kill(run: LiveSession, record: Path, kills: Kills, rng: np.random.Generator, before: float | None) -> float:
    """Kill one process of a run; the last place that it extruded, NaN where there is none to go on from."""
    clock = WallClock()
    try:
        if run.wait_for("\nprint\n") < 0:
            if PRINTED_TEXT not in run.said:  # nothing is left where the run before was killed on its way home
                kills.stuck.append(run.last_words)
            return math.nan
        clock.wait_until(clock.now() + rng.uniform(0, MAX_PRINTING))
        victim = str(rng.choice(VICTIMS))
        now = run.kill(victim)
        if victim in WATCHED_PROCESSES and run.wait_for("was killed", patience=END_PATIENCE) >= 0:
            kills.noticed.append(clock.now() - now)
        run.end(END_PATIENCE)
    finally:
        run.close()
    if not np.isfinite(now) or PRINTED_TEXT in run.said:
        return math.nan
    kills.count += 1
    kills.rests.append(_rest(record, now))
    first, last = printed_range(record)
    if before is not None and np.isfinite(first):
        kills.lost.append(max(first - before, 0.0))
        kills.doubled.append(max(before - first, 0.0))
    try:
        kills.unread.append(max(now - open_session(record).sets[-1][0].stamp, 0.0))
    except InputError:
        kills.unread.append(math.inf)
    if victim == "recorder":  # its recording ends before the arm did: what is kept of the place is all that is known
        last = float(read_toml(RunFiles(record).progress)["fraction"])
    kills.keep(record, victim, last)
    return last if np.isfinite(last) else before if before is not None else math.nan


def _rest(record: Path, killed: float) -> float:
    """How long, s, after the kill the virtual arm came to where it ended; inf where it ended in motion."""
    clock, file = WallClock(), RunFiles(record).executed
    until = clock.now() + EXECUTED_PATIENCE
    while not file.exists() and clock.now() < until:
        clock.wait_until(clock.now() + 0.1)
    clock.wait_until(clock.now() + 0.3)
    with np.load(file) as executed:
        stamps, axes = executed["stamps"], executed["axes"]
    return rest_delay(stamps, axes, killed)


def rest_delay(stamps: Array, axes: Array, since: float) -> float:
    """How long, s, after `since` an arm that was at `axes` (N, 6) at `stamps` (N,), s, came to rest; inf: never.

    Rest is to stay within `REST_RADIUS` of where it ended, for the last `MIN_REST` at least.
    """
    away = np.linalg.norm(axes[:, :3] - axes[-1, :3], axis=1) > REST_RADIUS
    if not away.any():
        return 0.0
    last = float(stamps[away][-1])
    return max(last - since, 0.0) if last < stamps[-1] - MIN_REST else math.inf


STOP_PERIOD = 8.0  # s between stops of the run that is stopped again and again
PROBE_PIECES = 20000  # of work that the machine is given before a run: ten seconds
MEMORY_PERIOD = 2.0  # s between looks at the memory
WARM_UP_SHARE = 0.3  # share of a run after which its memory counts: key frames are full then
HOMING_TEXT = "\nhoming\n"  # what a run says once its path is printed
KILLED_PATH_S = 90.0  # s of a path that is printed by runs which are killed after some seconds each
SHOWN_STAGES = "frames wait for the tracker", "tracking", "frames handed over to pose"
STOP_STAGE = "stop decided to on the wire"


def run_live(options: argparse.Namespace) -> list[Figure]:
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
            write_path(killed, to_and_fro(read_path(rendered.path), KILLED_PATH_S))
            figures += kill_figures(options.scenario, folder, killed, options.kills, options.seed, options.out)
    return figures


def to_and_fro(path: Toolpath, seconds: float) -> Toolpath:
    """The path printed again and again, there and back, for so long."""
    once = float(np.sum(way_lengths(path.surface_from_nozzle) / path.speed[1:]))
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
    told, alone = _arguments(options.scenario, record, path), measure_evenness(clock, PROBE_PIECES)
    run = LiveSession([*([str(_pinned(folder))] if options.pinned else []), *told])
    load = []
    try:
        begun = run.wait_for("\nprint\n")
        while begun >= 0 and run.process.poll() is None and run.said.find(HOMING_TEXT, begun) < 0:
            run.weigh()
            load.append(os.getloadavg()[0])
            clock.wait_until(clock.now() + MEMORY_PERIOD)
        run.end()
    finally:
        run.close()
    found: dict[str, Any] = json.loads(RunFiles(record).summary.read_text(encoding="utf-8"))
    error = nozzle_errors(record, path, arm)
    note = f"load {np.mean(load or [np.nan]):.1f} on {os.cpu_count()} cores"
    name = f"live {options.minutes:g} min" + (", pinned" if options.pinned else "")
    figures = [*_latencies(name, found, note), *_machine(name, alone)]
    return [*figures, *_errors(name, found, error), *_burden(name, found, run.memory)]


def _latencies(name: str, found: dict[str, Any], note: str) -> list[Figure]:
    times = found["latency_ms"]
    wire, exposure, late = (
        times.get(stage, {}) for stage in (FRAMES_TO_WIRE_STAGE, EXPOSURE_TO_WIRE_STAGE, LATE_TICK_STAGE)
    )
    return [
        Figure(f"{name}: frames to wire, median", _of(wire, "p50"), "ms", at_most(20), "thesis: 180 ms", note),
        Figure(f"{name}: frames to wire, 99 %", _of(wire, "p99"), "ms", at_most(35)),
        Figure(f"{name}: frames to wire, largest", _of(wire, "max"), "ms", at_most(60)),
        Figure(f"{name}: exposure to wire, median", _of(exposure, "p50"), "ms"),
        *(Figure(f"{name}: {stage}, median", _of(times.get(stage, {}), "p50"), "ms") for stage in SHOWN_STAGES),
        Figure(f"{name}: tick late, 99 %", _of(late, "p99"), "ms", at_most(3)),
    ]


def _machine(name: str, alone: Evenness) -> list[Figure]:
    note = f"{1000 * alone.usual:.1f} ms usually; before the run, nothing else of it running: no run can be more even"
    return [
        Figure(f"{name}: the machine alone, a piece of work at the worst", 1000 * alone.largest, "ms", note=note),
        Figure(f"{name}: the machine alone, time in which work is slow", 100 * alone.slow, "%", note="three times"),
    ]


def _errors(name: str, found: dict[str, Any], error: NozzleErrors) -> list[Figure]:
    done = f"ended: {found['ended']}"
    return [
        Figure(f"{name}: nozzle error, 95 %", error.figure(95), "mm", at_most(0.5), "", done),
        Figure(f"{name}: nozzle error, largest", error.figure(100), "mm", at_most(1.0)),
        Figure(f"{name}: duty", 100 * error.duty, "%", at_least(80)),
        Figure(f"{name}: most queued in the arm", 1000 * error.deepest, "ms", at_most(50)),
        Figure(f"{name}: virtual arm held up by the machine, longest", 1000 * error.held_up, "ms"),
        Figure(f"{name}: frame sets left out", found["frame_sets_dropped"], "", None, "", f"of {found['frame_sets']}"),
    ]


def memory_growth(memory: Sequence[tuple[float, dict[str, float]]]) -> dict[str, tuple[float, float]]:
    """By process, from s and MB each: MB an hour by which it grows once it has settled, and MB in the end."""
    settled = memory[int(WARM_UP_SHARE * len(memory)) :]
    stamps = np.array([stamp for stamp, _ in settled])
    found = {}
    for name in settled[-1][1] if len(settled) > 5 else ():
        held = np.array([each.get(name, np.nan) for _, each in settled])
        there = np.isfinite(held)
        slope = np.polyfit(stamps[there] - stamps[0], held[there], 1)[0] if there.sum() > 5 else np.nan
        found[name] = float(3600 * slope), float(held[-1])
    return found


def _burden(name: str, found: dict[str, Any], memory: Sequence[tuple[float, dict[str, float]]]) -> list[Figure]:
    share, grown = found["recorder_share_of_core"], memory_growth(memory)
    slope, size = (sum(each[k] for each in grown.values()) if grown else np.nan for k in (0, 1))
    told = ", ".join(f"{process} {by:+.0f}" for process, (by, _) in grown.items())
    recorder = 100 * (share or np.nan) / 2
    return [
        Figure(f"{name}: recorder", recorder, "%", at_most(3), "", "of two cores, its start included"),
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
            clock.wait_until(clock.now() + STOP_PERIOD / 4)
            run.press(" ")
            at = run.wait_for("stopped: by the operator\n", max(at, 0))
            clock.wait_until(clock.now() + STOP_PERIOD / 8)
            run.press("r")
        run.press("q")
        run.end()
    finally:
        run.close()
    found = json.loads(RunFiles(record).summary.read_text(encoding="utf-8"))["latency_ms"].get(STOP_STAGE, {})
    note = f"{found.get('count', 0)} stops by the terminal"
    return [
        Figure("stop decided to on the wire, 99 %", _of(found, "p99"), "ms", at_most(10), "", note),
        Figure("stop decided to on the wire, largest", _of(found, "max"), "ms"),
    ]


def _pinned(folder: Path) -> Path:
    """A session.toml that gives each loop a core of its own."""
    file = folder / "session.toml"
    one, other = available_cores()[:1], available_cores()[1:2]
    file.write_text(settings_text(LiveSettings(cores_tracking=one, cores_motion=other, cores_recorder=other)))
    return file


def _arguments(scenario: Path, record: Path, path: Path) -> list[str]:
    return ["--simulated", str(scenario), "--record", str(record), "--path", str(path), "--no-page", "--yes"]


def _of(span: dict[str, Any], key: str) -> float:
    return float(span[key]) if span.get(key) is not None else math.nan
