"""The trace of a live run: what is found of a way is what was put there, and what a viewer reads."""

from __future__ import annotations

import gc
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.live.trace import (
    GARBAGE,
    MOTION_LANE,
    ON_WIRE,
    QUEUE_STAGE,
    RUN_QUEUE,
    TRACKING_LANE,
    RunTrace,
    TraceBatch,
    TraceEntry,
    TraceLane,
    causes,
    chrome_trace,
    in_turn,
    read_trace,
    slowest_sets,
    trace_page,
    trace_text,
    write_trace,
)
from hardware.process.clock import CpuClock, SimClock, WallClock
from hardware.recording.recorder import Recorder
from tests.session_files import rig

PERIOD, TRACKED, WIRED = 0.033, 0.010, 0.002  # s


def entries(late: dict[int, float], count: int = 200) -> list[TraceEntry]:
    """Of sets that come evenly; the idle work after some takes longer, s, and the next waits for it."""
    made, ready = [], 0.0
    for number in range(count):
        handed = 1.0 + number * PERIOD
        start = max(handed, ready)
        sent, ready = start + TRACKED, start + TRACKED + late.get(number, 0.001)
        spans = [(QUEUE_STAGE, handed, start), *in_turn(start, ("align", "solve"), np.array([0.6, 0.4]) * TRACKED)]
        made.append(TraceEntry(TRACKING_LANE, handed, (*spans, ("idle", sent, ready))))
        made.append(TraceEntry(MOTION_LANE, handed, (("handed over", sent, sent), (ON_WIRE, sent, sent + WIRED))))
    return made


@given(st.dictionaries(st.integers(0, 198), st.floats(0.03, 0.2), max_size=3))
def test_ways_are_as_long_as_they_were_made(late: dict[int, float]) -> None:
    ways = RunTrace(entries(late)).ways
    assert len(ways) == 200 and min(way.wired - way.handed for way in ways) == pytest.approx(TRACKED + WIRED)
    slow = slowest_sets(ways)
    assert len(slow) == 2 and slow[0].wired - slow[0].handed == max(way.wired - way.handed for way in ways)


def test_what_the_slowest_waited_for_comes_first() -> None:
    trace = RunTrace(entries({50: 0.06, 120: 0.07}))
    first = causes(trace)[0]
    assert first.name == f"{TRACKING_LANE}: idle"  # of the set before
    assert first.slowest == pytest.approx(0.065 + TRACKED - PERIOD, abs=2e-3) and first.usual < 0.002
    named = {cause.name: cause for cause in causes(trace)}
    assert named["tracking: align"].usual == pytest.approx(0.6 * TRACKED, rel=0.05)
    assert "tracking: idle" in trace_text(trace)


def test_time_in_the_run_queue_is_shared_over_an_entry() -> None:
    entry = TraceEntry(TRACKING_LANE, 0.0, (("work", 0.0, 1.0),), queued=0.4)
    assert RunTrace([entry]).during(0.5, 2.0) == pytest.approx({"tracking: work": 0.5, f"tracking: {RUN_QUEUE}": 0.2})


def test_the_collector_is_seen_at_work() -> None:
    batches = list[TraceBatch]()
    lane = TraceLane("here", WallClock(), batches.append)
    try:
        gc.collect()
        lane.add(0.0, [("a", 0.0, 1.0)])
        lane.add(1.0, [])
    finally:
        lane.close()
    first, second = (entry for batch in batches for entry in batch.entries)
    assert [span[0] for span in first.spans] == ["a", GARBAGE] and not second.spans
    assert first.spans[1][2] >= first.spans[1][1] and first.queued >= 0.0 <= second.faults


def test_a_second_of_entries_is_one_message_and_an_entry_costs_little() -> None:
    clock, batches, cpu = SimClock(), list[TraceBatch](), CpuClock()
    lane = TraceLane("here", clock, batches.append)
    spans = in_turn(0.0, ("a", "b", "c", "d", "e", "f"), np.full(6, 0.001))
    begun = cpu.now()
    for number in range(900):
        lane.add(clock.now(), spans)
        clock.wait_until((number + 1) / 30)
    spent = (cpu.now() - begun) / 900
    lane.close()
    assert 28 <= len(batches) <= 31 and sum(len(batch.entries) for batch in batches) == 900
    assert spent < 0.3e-3  # s: what may be on without being asked for


def test_it_comes_back_from_a_recording_and_a_viewer_reads_it(tmp_path: Path) -> None:
    made = entries({7: 0.05}, 20)
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        for lane in (TRACKING_LANE, MOTION_LANE):
            batch = TraceBatch(tuple(entry for entry in made if entry.lane == lane))
            recorder.trace(batch.entries[-1].stamp, batch.message)
    trace = read_trace(tmp_path / "x.mcap")
    assert trace.entries == [*made[::2], *made[1::2]]
    events = json.loads(chrome_trace(trace))["traceEvents"]
    names = {event["args"]["name"] for event in events if event["ph"] == "M"}
    spans = [event for event in events if event["ph"] == "X"]
    assert names == {TRACKING_LANE, MOTION_LANE} and len(spans) == sum(len(entry.spans) for entry in made)
    assert min(event["ts"] for event in spans) == 0.0 <= min(event["dur"] for event in spans)
    page = trace_page(trace, "x")
    assert page.count("<svg role") + page.count("<svg view") >= 12 and "tracking: idle" in page
    assert page.count(">-20</text>") == page.count(">0</text>") == page.count("<svg role") + page.count("<svg view")


def test_a_run_that_left_none_keeps_its_own_end_and_says_why(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        recorder.event(0.0, "ended in the check")
    assert "no trace" in write_trace(tmp_path / "x.mcap", tmp_path / "x.json")
    assert not (tmp_path / "x.json").exists()


def test_a_recording_without_one_says_so(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        recorder.event(0.0, "nothing")
    with pytest.raises(InputError, match=r"record\.trace"):
        read_trace(tmp_path / "x.mcap")


def test_without_any_move_there_is_a_page_all_the_same() -> None:
    trace = RunTrace([TraceEntry(TRACKING_LANE, 0.0, (("wait", 0.0, 0.1),))])
    assert not causes(trace) and "no move" in trace_text(trace) and "no move" in trace_page(trace, "x")
