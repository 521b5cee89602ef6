"""Subjects `live` and `beside`: whole runs in real time; the wound network beside the tracker and without it.

A run has pre-rendered cameras, the virtual arm, and all processes. Rendering takes ten times real time, so pictures are
rendered once and fed by a separate process.
Kills: random processes of a run are killed at random instants. Is the arm at rest? Does the next run resume there?
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from estimation.errors import InputError
from estimation.pose import SurfacePose
from estimation.se3 import Array
from hardware.bench.figures import Figure, append_rows, at_least, at_most, memory_figures, with_progress
from hardware.bench.link import burning
from hardware.bench.recordings import FRAME_RATE, beside_figures, packed_sets, rendered_recording, unpacked_set
from hardware.bench.whole import LiveSession
from hardware.files.path_file import read_path, write_path
from hardware.live.prepared import RunFiles
from hardware.live.prerender import NozzleErrors, nozzle_errors, prerender
from hardware.live.recorded_run import printed_range
from hardware.live.records import EXPOSURE_TO_WIRE_STAGE, FRAMES_TO_WIRE_STAGE, LATE_TICK_STAGE
from hardware.live.settings import LiveSettings, available_cores, settings_text
from hardware.offline.track import tracker
from hardware.process.checks import read_toml
from hardware.process.clock import CpuClock, WallClock, measure_evenness
from hardware.process.progress import cache_folder
from hardware.recording.session_reader import open_session
from perception.frames import Image
from perception.tracking.wound_step import AsyncSegmentation
from perception.wound.network import WoundNetwork, shipped_model
from perception.wound.segmentation import NetworkSegmenter, Segmentation
from planning.path import Path as Toolpath
from planning.path import way_lengths

WATCHED_PROCESSES = ("tracking", "motion", "recorder")  # by the main process; the cameras notice the feed's end
KILLED_PROCESSES = ("run", "tracking", "motion", "recorder", "feed")
PRINTED_TEXT = "the path is printed"
MAX_PRINTING = 3.0  # s of printing before a kill
MAX_REST_DELAY = 0.5  # s from a kill until the arm must rest: 0.1 of detection, 0.05 queued, its servo
MIN_REST = 0.05  # s, least rest at the end
REST_RADIUS = 0.05  # mm from the last place
END_TIMEOUT = 60.0  # s for the end of the others
EXECUTED_TIMEOUT = 30.0  # s for the virtual arm's file of executed axes


@dataclass(slots=True)
class Kills:
    """Measurements of all kills."""

    out: Path | None = None  # for a table, and for the files of runs whose arm did not rest; None: nothing is saved
    count: int = 0
    rest_delays: list[float] = field(default_factory=list)  # s after each kill until the arm rested
    stuck: list[str] = field(default_factory=list)  # last lines of runs that did not print
    omissions: list[float] = field(default_factory=list)  # checkpoints omitted by each resumed run
    repetitions: list[float] = field(default_factory=list)  # checkpoints printed twice
    losses: list[float] = field(default_factory=list)  # s of recording lost before each kill
    reports: list[float] = field(default_factory=list)  # s from a kill until the main process reported it

    def save(self, record: Path, victim: str, place: float) -> None:
        """Add the last kill to the table; where the arm moved on, copy the run's files."""
        if self.out is None:
            return
        row = (record.name, victim, f"{self.rest_delays[-1]:.3f}", f"{place:.3f}")
        append_rows(self.out / "kills.csv", ("record", "killed", "rests_s", "place"), [row])
        for file in record.parent.glob(f"{record.stem}.*") if self.rest_delays[-1] > MAX_REST_DELAY else ():
            shutil.copy(file, self.out)


def kill_figures(scenario: Path, folder: Path, path: Path, count: int, seed: int, out: Path | None) -> list[Figure]:
    """Kill `count` processes, each in a run that resumes the last one; a finished print is followed by a new one."""
    rng, kills = np.random.default_rng(seed), Kills(out)
    record: Path | None = None
    place = math.nan
    for number in with_progress("kills", "kills", range(count), count):
        if record is None:
            record = folder / f"kill{number}.mcap"
            place = _kill(LiveSession(_arguments(scenario, record, path)), record, kills, rng, None)
        else:
            arguments = ["--resume", str(record), "--no-page", "--yes"]
            record = RunFiles(record).next().record
            place = _kill(LiveSession(arguments), record, kills, rng, place)
        record = record if np.isfinite(place) else None
    name, latest_report = f"{kills.count} kills", 1000 * max(kills.reports, default=np.nan)
    late = sum(s > MAX_REST_DELAY for s in kills.rest_delays)
    return [
        Figure(f"{name}: arms not at rest after {MAX_REST_DELAY:g} s", late, "", at_most(0)),
        Figure(f"{name}: arm at rest after, median", 1000 * float(np.median(kills.rest_delays or np.nan)), "ms"),
        Figure(f"{name}: arm at rest after, most", 1000 * max(kills.rest_delays, default=np.nan), "ms"),
        Figure(f"{name}: runs that did not print again", len(kills.stuck), "", at_most(0), "", "; ".join(kills.stuck)),
        Figure(f"{name}: most left out", max(kills.omissions, default=np.nan), "checkpoints", at_most(1)),
        Figure(f"{name}: most printed twice", max(kills.repetitions, default=np.nan), "checkpoints", at_most(0)),
        Figure(f"{name}: death of a process noticed, median", 1000 * float(np.median(kills.reports or np.nan)), "ms"),
        Figure(f"{name}: death of a process noticed, most", latest_report, "ms", at_most(100)),
        Figure(f"{name}: recording ends before the kill, most", max(kills.losses, default=np.nan), "s", at_most(1)),
    ]


def _kill(run: LiveSession, record: Path, kills: Kills, rng: np.random.Generator, last_place: float | None) -> float:
    """Kill one process of a run; its last extruded place, NaN without a place to resume from."""
    clock = WallClock()
    try:
        if run.wait_for("\nprint\n") < 0:
            if PRINTED_TEXT not in run.output:  # nothing is left where the run before was killed on its way home
                kills.stuck.append(run.last_lines)
            return math.nan
        clock.wait_until(clock.now() + rng.uniform(0, MAX_PRINTING))
        victim = str(rng.choice(KILLED_PROCESSES))
        now = run.kill(victim)
        if victim in WATCHED_PROCESSES and run.wait_for("was killed", timeout=END_TIMEOUT) >= 0:
            kills.reports.append(clock.now() - now)
        run.end(END_TIMEOUT)
    finally:
        run.close()
    if not np.isfinite(now) or PRINTED_TEXT in run.output:
        return math.nan
    kills.count += 1
    file, until = RunFiles(record).executed, clock.now() + EXECUTED_TIMEOUT
    while not file.exists() and clock.now() < until:
        clock.wait_until(clock.now() + 0.1)
    clock.wait_until(clock.now() + 0.3)
    with np.load(file) as executed:
        kills.rest_delays.append(rest_delay(executed["stamps"], executed["axes"], now))
    first, last = printed_range(record)
    if last_place is not None and np.isfinite(first):
        kills.omissions.append(max(first - last_place, 0.0))
        kills.repetitions.append(max(last_place - first, 0.0))
    try:
        kills.losses.append(max(now - open_session(record).sets[-1][0].stamp, 0.0))
    except InputError:
        kills.losses.append(math.inf)
    if victim == "recorder":  # its recording ends before the arm did: only the progress file has the place
        last = float(read_toml(RunFiles(record).progress)["fraction"])
    kills.save(record, victim, last)
    return last if np.isfinite(last) else last_place if last_place is not None else math.nan


def rest_delay(stamps: Array, axes: Array, since: float) -> float:
    """Delay, s, from `since` until an arm with `axes` (N, 6) at `stamps` (N,), s, came to rest; inf: never.

    Rest: within `REST_RADIUS` of the last place, for the last `MIN_REST` at least.
    """
    moving = np.linalg.norm(axes[:, :3] - axes[-1, :3], axis=1) > REST_RADIUS
    if not moving.any():
        return 0.0
    last = float(stamps[moving][-1])
    return max(last - since, 0.0) if last < stamps[-1] - MIN_REST else math.inf


STOP_PERIOD = 8.0  # s between repeated stops of a run
PROBE_PIECES = 20000  # of work to measure the machine before a run: 10 s
MEMORY_PERIOD = 2.0  # s between measurements of the memory
HOMING_TEXT = "\nhoming\n"  # output of a run after its path
KILLED_PATH_S = 90.0  # s of a path for runs that are killed after some seconds each
SHOWN_STAGES = "frames wait for the tracker", "tracking", "frames handed over to pose"
STOP_STAGE = "stop decided to on the wire"


def run_live(options: argparse.Namespace) -> list[Figure]:
    """The figures of all runs that the options choose."""
    rendered = prerender(options.scenario, cache_folder())
    with tempfile.TemporaryDirectory(prefix="stillbed-live-") as name:
        folder, figures = Path(name), list[Figure]()
        long, killed = folder / "long.csv", folder / "killed.csv"
        write_path(long, _repeated(read_path(rendered.path), 60 * (options.minutes or 1.0)))
        with burning(options.busy):
            if options.minutes:
                figures = _print_figures(options, folder, long, rendered.arm)
            if options.stops:
                figures += _stop_figures(options, folder, long)
        if options.kills:
            write_path(killed, _repeated(read_path(rendered.path), KILLED_PATH_S))
            figures += kill_figures(options.scenario, folder, killed, options.kills, options.seed, options.out)
    return figures


def _repeated(path: Toolpath, seconds: float) -> Toolpath:
    """The path printed to and fro for `seconds` s."""
    duration = float(np.sum(way_lengths(path.surface_from_nozzle) / path.speed[1:]))
    count, indices = len(path), np.arange(len(path))
    order = list(indices)
    while len(order) < seconds / duration * count:
        order += list(indices[-2::-1] if order[-1] == count - 1 else indices[1:])
    index = np.array(order[: max(int(seconds / duration * count), 2)])
    names = "surface_from_nozzle", "speed", "material", "temperature", "layer"
    rows: dict[str, Any] = {name: getattr(path, name)[index] for name in names}
    return replace(path, **rows, extrude=path.extrude[np.maximum(index, 1)], extra={})


def _print_figures(options: argparse.Namespace, folder: Path, path: Path, arm: Path) -> list[Figure]:
    record, clock = folder / "print.mcap", WallClock()
    arguments, idle = _arguments(options.scenario, record, path), measure_evenness(clock, PROBE_PIECES)
    if options.pinned:  # each loop has a core of its own
        tracking_core, other_core = available_cores()[:1], available_cores()[1:2]
        settings = LiveSettings(cores_tracking=tracking_core, cores_motion=other_core, cores_recorder=other_core)
        (folder / "session.toml").write_text(settings_text(settings))
        arguments.insert(0, str(folder / "session.toml"))
    run = LiveSession(arguments)
    load = []
    try:
        printing = run.wait_for("\nprint\n")
        while printing >= 0 and run.process.poll() is None and run.output.find(HOMING_TEXT, printing) < 0:
            run.measure_memory()
            load.append(os.getloadavg()[0])
            clock.wait_until(clock.now() + MEMORY_PERIOD)
        run.end()
    finally:
        run.close()
    summary: dict[str, Any] = json.loads(RunFiles(record).summary.read_text(encoding="utf-8"))
    error = nozzle_errors(record, RunFiles(record).executed, path, arm)
    note = f"load {np.mean(load or [np.nan]):.1f} on {os.cpu_count()} cores"
    name = f"live {options.minutes:g} min" + (", pinned" if options.pinned else "")
    name += f", {options.busy} busy beside it" if options.busy else ""
    text = f"{1000 * idle.usual:.1f} ms usually; before the run, nothing else of it running: no run can be more even"
    return [
        *_latencies(name, summary["latency_ms"], note, TARGETS_BUSY if options.busy else TARGETS_ALONE),
        Figure(f"{name}: the machine alone, a piece of work at the worst", 1000 * idle.largest, "ms", note=text),
        Figure(f"{name}: the machine alone, time in which work is slow", 100 * idle.slow, "%", note="three times"),
        *_errors(name, summary, error),
        *_load(name, summary, run.memory),
    ]


TARGETS_ALONE, TARGETS_BUSY = (12.0, 20.0, 40.0), (20.0, 35.0, 60.0)  # ms of frames to wire: median, 99 %, largest
STOP_TARGETS = 5.0, 10.0  # ms, alone and busy, of which the frame is 4.2 on the line


def _latencies(name: str, times: dict[str, Any], note: str, targets: tuple[float, ...]) -> list[Figure]:
    stages = FRAMES_TO_WIRE_STAGE, EXPOSURE_TO_WIRE_STAGE, LATE_TICK_STAGE
    wire, exposure, late = (times.get(stage, {}) for stage in stages)
    return [
        Figure(f"{name}: frames to wire, median", _ms(wire, "p50"), "ms", at_most(targets[0]), "thesis: 180 ms", note),
        Figure(f"{name}: frames to wire, 99 %", _ms(wire, "p99"), "ms", at_most(targets[1])),
        Figure(f"{name}: frames to wire, largest", _ms(wire, "max"), "ms", at_most(targets[2])),
        Figure(f"{name}: exposure to wire, median", _ms(exposure, "p50"), "ms"),
        *(Figure(f"{name}: {stage}, median", _ms(times.get(stage, {}), "p50"), "ms") for stage in SHOWN_STAGES),
        Figure(f"{name}: tick late, 99 %", _ms(late, "p99"), "ms", at_most(3)),
    ]


def _errors(name: str, summary: dict[str, Any], error: NozzleErrors) -> list[Figure]:
    end_note, sets_note = f"ended: {summary['ended']}", f"of {summary['frame_sets']}"
    return [
        Figure(f"{name}: nozzle error, 95 %", error.figure(95), "mm", at_most(0.5), "", end_note),
        Figure(f"{name}: nozzle error, largest", error.figure(100), "mm", at_most(1.0)),
        Figure(f"{name}: duty", 100 * error.duty, "%", at_least(80)),
        Figure(f"{name}: holds", sum(hold["count"] for hold in summary["holds"]), "", None, "", _holds_text(summary)),
        Figure(f"{name}: most queued in the arm", 1000 * error.deepest, "ms", at_most(50)),
        Figure(f"{name}: virtual arm held up by the machine, longest", 1000 * error.held_up, "ms"),
        Figure(f"{name}: frame sets left out", summary["frame_sets_dropped"], "", None, "", sets_note),
    ]


def _holds_text(summary: dict[str, Any]) -> str:
    """Total of the holds, and reason of the longest kind."""
    holds = summary["holds"]
    longest = f", the longest: {holds[0]['reason']}" if holds else ""
    return f"{sum(hold['total_s'] for hold in holds):.1f} s{longest}"


def _load(name: str, summary: dict[str, Any], memory: Sequence[tuple[float, dict[str, float]]]) -> list[Figure]:
    recorder = 100 * (summary["recorder_share_of_core"] or np.nan) / 2
    return [
        Figure(f"{name}: recorder", recorder, "%", at_most(3), "", "of two cores, its start included"),
        Figure(f"{name}: not recorded", summary["unrecorded"], "", at_most(0)),
        *memory_figures(name, memory),
    ]


def _stop_figures(options: argparse.Namespace, folder: Path, path: Path) -> list[Figure]:
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
    delay = json.loads(RunFiles(record).summary.read_text(encoding="utf-8"))["latency_ms"].get(STOP_STAGE, {})
    target, note = at_most(STOP_TARGETS[options.busy > 0]), f"{delay.get('count', 0)} stops by the terminal"
    return [
        Figure("stop decided to on the wire, 99 %", _ms(delay, "p99"), "ms", target, note=note),
        Figure("stop decided to on the wire, largest", _ms(delay, "max"), "ms"),
    ]


def _arguments(scenario: Path, record: Path, path: Path) -> list[str]:
    return ["--simulated", str(scenario), "--record", str(record), "--path", str(path), "--no-page", "--yes"]


def _ms(span: dict[str, Any], key: str) -> float:
    return float(span[key]) if span.get(key) is not None else math.nan


BLOCK_SETS = 15  # half a second, tracked with the network and without it in turn, at the pace of live cameras


def run_beside(options: argparse.Namespace) -> list[Figure]:
    """Two trackers of the same pictures in turn, one with the network: its share of a core, and the time of a pose."""
    clock, cpu = WallClock(), CpuClock()
    looks, wall = list[float](), 0.0  # s of processor for each picture segmented; s of the blocks in which they were
    recording = rendered_recording(options.scene, options.seconds)
    packed = packed_sets(recording)
    network = WoundNetwork(shipped_model() if options.model is None else options.model, 1)
    segmenter = NetworkSegmenter(network, network.settings)
    poses = list[SurfacePose](), list[SurfacePose]()  # without the network, with it
    durations = list[float](), list[float](), list[float]()  # s to a pose likewise; s after it to hand pictures over

    def timed(image: Image) -> Segmentation:
        start = cpu.now()
        segmentation = segmenter(image)
        looks.append(cpu.now() - start)
        return segmentation

    track = partial(tracker, recording.rig, recording.roi, recording.surface)
    with track() as plain, track() as loaded, ThreadPoolExecutor(1) as thread:
        steps, beside = (plain, loaded), AsyncSegmentation(recording.rig, timed, thread)
        for block in range(0, len(packed), BLOCK_SETS):
            for index in (0, 1) if block % (2 * BLOCK_SETS) else (1, 0):
                start, sets = clock.now(), packed[block : block + BLOCK_SETS]
                for number, packed_set in enumerate(sets):
                    frames = unpacked_set(packed_set)
                    clock.wait_until(start + number / FRAME_RATE)
                    begin = clock.now()
                    poses[index].append(steps[index](frames))
                    end = clock.now()
                    durations[index].append(end - begin)
                    if index:
                        beside(frames)
                        durations[2].append(clock.now() - end)
                    steps[index].idle()
                clock.wait_until(start + len(sets) / FRAME_RATE)
                wall += index * (clock.now() - start)
                thread.submit(int).result()  # the network has ended before the other's turn
    pace = len(packed) / FRAME_RATE / wall  # of live cameras; below 1 the machine had no time for them
    share, note = f"{options.scene}: network's share of a core", f"{len(looks)} pictures in {wall:.1f} s, one thread"
    figures = [
        Figure(share, 100 * sum(looks) / wall, "%", None, "", f"{note}; the load was {os.getloadavg()[0]:.1f}"),
        Figure(f"{options.scene}: pace", 100 * pace, "%", at_least(95), "", "of 30 frame sets a second"),
        Figure(f"{options.scene}: network, a picture", 1000 * float(np.median(looks)), "ms", None, "", "processor"),
    ]
    return [*figures, *beside_figures(options.scene, *poses, np.array(durations))]
