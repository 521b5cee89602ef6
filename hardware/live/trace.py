"""Where the time of each frame set went: spans by process, in the recording, and what they say about the slowest sets.

Each process notes when it took a set over and handed it on, on the machine's monotonic clock, and what held it up: the
collector of Python's garbage, the scheduler (the kernel's run-queue delay of the thread), page faults. It keeps that
and hands it to the recorder once a second: the topic /trace holds a message a second and process. A set's way goes from
its pixels in memory to the first move on the wire that was made of it; what the processes did meanwhile is what it
waited for.
"""

from __future__ import annotations

import gc
import json
import math
import os
import resource
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from html import escape
from itertools import islice, takewhile
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process.clock import Clock

TRACKING_LANE, MOTION_LANE, RECORDER_LANE = "tracking", "motion", "recorder"
QUEUE_STAGE = "frames wait for the tracker"  # what for is seen in the other spans
ON_WIRE = "planned and written"  # the last span of a set's way
GARBAGE, RUN_QUEUE = "collecting garbage", "ready, but not running"
MIN_WRITE_S = 0.005  # s of a batch of the recorder, from which it is in the trace
SLOWEST_SHARE = 0.01  # of all sets
DRAWN_SETS = 12  # of the slowest, in the picture
DRAWN_BEFORE_S, LANE_PX, CHART_PX = 0.03, 16, 900  # s drawn before a set is handed over
TICK_S = 0.01  # s between ticks of a lane's time
BATCH_S = 1.0  # s of entries that are handed to the recorder as one: what a set's entry costs is then 0.03 ms
SCHEDULER_FILE = Path("/proc/thread-self/schedstat")  # ns run, ns in the run queue, time slices: Linux
TOPIC = "/trace"

Span = tuple[str, float, float]  # what, from, until: s


@dataclass(frozen=True, slots=True)
class TraceEntry:
    """What one process did of one frame set; of the recorder, a batch that it wrote."""

    lane: str
    stamp: float  # s, of the set
    spans: tuple[Span, ...]
    queued: float = 0.0  # s for which its thread was ready and did not run
    faults: int = 0  # page faults of its thread


@dataclass(frozen=True, slots=True)
class TraceBatch:
    """What one process did of the frame sets of a second."""

    entries: tuple[TraceEntry, ...]

    @property
    def message(self) -> dict[str, object]:
        """As it is recorded."""
        entries = [[e.stamp, e.queued, e.faults, e.spans] for e in self.entries]
        return {"lane": self.entries[0].lane, "entries": entries}


class _RunQueue:
    """How long the thread that made it was ready and did not run."""

    def __init__(self) -> None:
        self._file: int | None = None
        with suppress(OSError):  # the system does not say
            self._file = os.open(SCHEDULER_FILE, os.O_RDONLY | os.O_CLOEXEC)

    def delay(self) -> float:
        """Seconds so far; 0 where the system does not say."""
        if self._file is None:
            return 0.0
        return int(os.pread(self._file, 100, 0).split()[1]) * 1e-9

    def close(self) -> None:
        """Ask no more."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


class TraceLane:
    """Spans of the thread that made it for each set, with its waits in the run queue and its page faults."""

    def __init__(self, name: str, clock: Clock, put: Callable[[TraceBatch], None]) -> None:
        """put: hands a batch to the recorder."""
        self._name, self._clock, self._put_batch = name, clock, put
        self._garbage: list[Span] = []
        self._entries: list[TraceEntry] = []
        self._collecting, self._batch_due = 0.0, clock.now() + BATCH_S
        self._queue = _RunQueue()
        self._last_counts = self._counts()
        gc.callbacks.append(self._on_garbage)

    def add(self, stamp: float, spans: Iterable[Span]) -> None:
        """Enter the spans of the set at `stamp`, s; entries are handed over once a second."""
        delay, faults = self._counts()
        queued, new_faults = delay - self._last_counts[0], faults - self._last_counts[1]
        self._last_counts = delay, faults
        garbage, self._garbage = self._garbage, []
        self._entries.append(TraceEntry(self._name, stamp, (*spans, *garbage), queued, new_faults))
        if self._clock.now() > self._batch_due:
            self._hand_over()

    def close(self) -> None:
        """Hand over the last entries, and stop counting."""
        self._hand_over()
        gc.callbacks.remove(self._on_garbage)
        self._queue.close()

    def _hand_over(self) -> None:
        entries, self._entries, self._batch_due = self._entries, [], self._clock.now() + BATCH_S
        if entries:
            self._put_batch(TraceBatch(tuple(entries)))

    def _counts(self) -> tuple[float, int]:
        usage = resource.getrusage(resource.RUSAGE_THREAD)
        return self._queue.delay(), usage.ru_minflt + usage.ru_majflt

    def _on_garbage(self, phase: str, information: Mapping[str, int]) -> None:
        now = self._clock.now()
        if phase == "start":
            self._collecting = now
        else:
            self._garbage.append((GARBAGE, self._collecting, now))


def in_turn(begin: float, names: Sequence[str], seconds: Array) -> list[Span]:
    """Spans of stages that follow each other from `begin`, s, on; seconds: (N,) of each."""
    stops = begin + np.cumsum(seconds)
    return [(name, float(stop - time), float(stop)) for name, time, stop in zip(names, seconds, stops, strict=False)]


@dataclass(frozen=True, slots=True)
class SetWay:
    """The instants of one frame set, from its pixels to the wire."""

    stamp: float  # s
    handed: float  # s, its pixels are in memory
    wired: float  # s, the first move computed from it is on the wire


@dataclass(slots=True)
class RunTrace:
    """The trace of a run; no entry may be added after the first call of `during`."""

    entries: list[TraceEntry] = field(default_factory=list)
    _by_start: list[tuple[float, float, TraceEntry]] | None = None
    _longest: float = 0.0  # s

    @property
    def ways(self) -> list[SetWay]:
        """The sets from which a move was computed, in order of stamp."""
        wired = {
            entry.stamp: end
            for entry in self.entries
            if entry.lane == MOTION_LANE
            for name, _, end in entry.spans
            if name == ON_WIRE
        }
        begun = {e.stamp: e.spans[0][1] for e in self.entries if e.lane == TRACKING_LANE and e.spans}
        return [SetWay(s, begun[s], wired[s]) for s in sorted(begun.keys() & wired.keys())]

    def during(self, begin: float, end: float) -> dict[str, float]:
        """Seconds of each kind of span between two instants, s; of the run queue its share in proportion."""
        sums: dict[str, float] = {}
        if self._by_start is None:  # by when they begin, and the longest of them
            entries = [(e.spans[0][1], max(span[2] for span in e.spans), e) for e in self.entries if e.spans]
            self._by_start = sorted(entries, key=lambda item: item[0])
            self._longest = max((last - first for first, last, _ in entries), default=0.0)
        begin_index = bisect_left(self._by_start, begin - self._longest, key=lambda item: item[0])
        for first, last, entry in takewhile(lambda item: item[0] < end, islice(self._by_start, begin_index, None)):
            if last <= begin:
                continue
            for name, start, stop in entry.spans:
                if name != QUEUE_STAGE and (overlap := min(stop, end) - max(start, begin)) > 0:
                    key = f"{entry.lane}: {name}"
                    sums[key] = sums.get(key, 0.0) + overlap
            if entry.queued > 0 and last > first:
                key, share = f"{entry.lane}: {RUN_QUEUE}", (min(last, end) - max(first, begin)) / (last - first)
                sums[key] = sums.get(key, 0.0) + entry.queued * share
        return sums


def read_trace(record: Path) -> RunTrace:
    """The trace in a recording; InputError where it holds none."""
    from hardware.recording.mcap_file import ChunkMessages, parse, walk

    trace = RunTrace()
    for record_part in walk(record):
        for stored in record_part.messages if isinstance(record_part, ChunkMessages) else ():
            if stored.topic == TOPIC:
                message = parse(record, stored)
                lane = str(message["lane"])
                for stamp, queued, faults, spans in message["entries"]:
                    rows = tuple((str(name), float(begin), float(end)) for name, begin, end in spans)
                    trace.entries.append(TraceEntry(lane, float(stamp), rows, float(queued), int(faults)))
    if not trace.entries:
        raise InputError(record, TOPIC, "no trace", "the recording of a live run without record.trace = false")
    return trace


@dataclass(frozen=True, slots=True)
class Cause:
    """A cause of latency, s a set: the average of all sets, and of the slowest ones."""

    name: str
    usual: float
    slowest: float


def slowest_sets(ways: Sequence[SetWay], share: float = SLOWEST_SHARE) -> list[SetWay]:
    """The slowest share of sets, one at least, the slowest first."""
    by_duration = sorted(ways, key=lambda way: way.handed - way.wired)
    return by_duration[: max(round(share * len(by_duration)), 1)]


def causes(trace: RunTrace) -> list[Cause]:
    """The causes of latency, sorted by the excess of the slowest sets over all sets, largest first."""
    ways = trace.ways
    slow = {way.stamp for way in slowest_sets(ways)} if ways else set()
    usual, slowest = dict[str, float](), dict[str, float]()
    for way in ways:
        for name, seconds in trace.during(way.handed, way.wired).items():
            usual[name] = usual.get(name, 0.0) + seconds / len(ways)
            if way.stamp in slow:
                slowest[name] = slowest.get(name, 0.0) + seconds / len(slow)
    all_causes = [Cause(name, mean, slowest.get(name, 0.0)) for name, mean in usual.items()]
    return sorted(all_causes, key=lambda cause: cause.usual - cause.slowest)


def trace_text(trace: RunTrace) -> str:
    """The percentiles of the ways and the causes of the slowest, as a table for a terminal."""
    ways = trace.ways
    if not ways:
        return "no move was made of any frame set"
    durations = 1000 * np.array([way.wired - way.handed for way in ways])
    median, p99, largest = np.percentile(durations, [50, 99, 100])
    all_causes = causes(trace)
    lines = [f"frames to wire, {len(ways)} sets: {median:.1f} / {p99:.1f} / {largest:.1f} ms (median, 99 %, largest)"]
    width = max(len(cause.name) for cause in all_causes)
    lines.append(f"{'what was done meanwhile, ms a set':<{width}}  {'all':>7}  slowest {100 * SLOWEST_SHARE:.0f} %")
    lines += [f"{c.name:<{width}}  {1000 * c.usual:7.2f}  {1000 * c.slowest:7.2f}" for c in all_causes]
    return "\n".join(lines)


def chrome_trace(trace: RunTrace) -> str:
    """The trace for Perfetto (ui.perfetto.dev) or chrome://tracing: a process a lane, instants in microseconds."""
    lanes = sorted({entry.lane for entry in trace.entries})
    first = min((span[1] for entry in trace.entries for span in entry.spans), default=0.0)
    events: list[dict[str, object]] = [
        {"ph": "M", "name": "process_name", "pid": number, "tid": 0, "args": {"name": lane}}
        for number, lane in enumerate(lanes)
    ]
    for entry in trace.entries:
        details = {"stamp": entry.stamp, "ready, but not running, ms": 1000 * entry.queued, "page faults": entry.faults}
        for name, begin, end in entry.spans:
            place = {"pid": lanes.index(entry.lane), "tid": int(name == GARBAGE)}
            timing = {"ts": round(1e6 * (begin - first), 1), "dur": round(1e6 * (end - begin), 1)}
            events.append({"ph": "X", "name": name, **place, **timing, "args": details})
    return json.dumps({"displayTimeUnit": "ms", "traceEvents": events})


def write_trace(record: Path, file: Path) -> str:
    """Write the trace in a recording for such a viewer; the reason where it is not written, else ""."""
    try:
        file.write_text(chrome_trace(read_trace(record)), encoding="utf-8")
    except (InputError, OSError) as error:
        return f"{file} is not written: {error}"
    return ""


def trace_page(trace: RunTrace, title: str) -> str:
    """A page with the causes, and what each process did on the ways of the slowest sets."""
    from hardware.report.page import document, figures_table, section

    ways = trace.ways
    lead = trace_text(trace).splitlines()[0]
    rows = [[c.name, f"{1000 * c.usual:.2f}", f"{1000 * c.slowest:.2f}"] for c in causes(trace)] if ways else []
    charts = "".join(_lanes(trace, way) for way in slowest_sets(ways, DRAWN_SETS / len(ways))) if ways else ""
    body = [
        section(
            "What was done meanwhile",
            "Milliseconds a set, from its pixels in memory to the first move on the wire; processes work side by side.",
            figures_table(("what", "all sets", f"slowest {100 * SLOWEST_SHARE:.0f} %"), rows),
        ),
        section(
            "The slowest sets",
            "Each lane is a process; the grey band is the set's way. Time in ms since its pixels were in memory.",
            _legend(trace) + charts,
        ),
    ]
    return document("trace", title, lead, body, "stillbed")


COLOURS = (
    *("#3d7edb", "#e07b39", "#3aa37b", "#b65fc4", "#c9a227", "#d1495b", "#5aa9c7", "#8d8d8d"),
    *("#7a5c3e", "#1f4e8c", "#9bc53d", "#f19cbb", "#5f4bb6", "#00798c"),
)


def _colours(trace: RunTrace) -> dict[str, str]:
    names = sorted({span[0] for entry in trace.entries for span in entry.spans})
    return {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(names)}


def _legend(trace: RunTrace) -> str:
    keys = (f'<span style="color:{c}">■</span> {escape(name)}' for name, c in _colours(trace).items())
    return f"<p>{', '.join(keys)}</p>"


def _lanes(trace: RunTrace, way: SetWay) -> str:
    """What each process did on the way of one set, as SVG."""
    begin, end = way.handed - DRAWN_BEFORE_S, way.wired
    scale, lanes = CHART_PX / (end - begin), (TRACKING_LANE, MOTION_LANE, RECORDER_LANE)
    band = f'<rect x="{DRAWN_BEFORE_S * scale:.1f}" y="0" width="{(end - way.handed) * scale:.1f}" '
    parts = [f'{band}height="{LANE_PX * len(lanes)}" fill="#8883"/>']
    colours = _colours(trace)
    for entry in trace.entries:
        for name, start, stop in entry.spans:
            if stop <= begin or start >= end:
                continue
            left, width = (max(start, begin) - begin) * scale, (min(stop, end) - max(start, begin)) * scale
            row = lanes.index(entry.lane)
            text = escape(f"{entry.lane}: {name}, {1000 * (stop - start):.1f} ms")
            place = f'x="{left:.1f}" y="{row * LANE_PX + 1}" width="{max(width, 0.5):.1f}" height="{LANE_PX - 2}"'
            parts.append(f'<rect {place} fill="{colours[name]}"><title>{text}</title></rect>')
    low = LANE_PX * len(lanes)
    for tick in range(math.ceil((begin - way.handed) / TICK_S), math.floor((end - way.handed) / TICK_S) + 1):
        x = (tick * TICK_S + way.handed - begin) * scale
        label = f'<text x="{x:.1f}" y="{low + 11}" font-size="10" fill="currentColor">{1000 * tick * TICK_S:.0f}</text>'
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{low + 3}" stroke="#8888"/>{label}')
    text = f"stamp {way.stamp:.3f} s: {1000 * (way.wired - way.handed):.1f} ms; from above: {', '.join(lanes)}"
    size = f'viewBox="0 0 {CHART_PX} {low + 13}" width="100%"'
    return f'<p>{escape(text)}</p><svg {size} role="img" aria-label="{escape(text)}">{"".join(parts)}</svg>'
