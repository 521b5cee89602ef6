"""What a print's loop was given is recorded, and gives the same bytes again: also after stops, recalls and faults."""

from __future__ import annotations

import base64
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from estimation.errors import InputError
from estimation.synthetic.world import arc_rig
from hardware.arm.protocol import FRAME_LENGTH
from hardware.cli.main import main
from hardware.live.recorded_run import PartedError, asked_flows, read_run, replay_run
from hardware.motion.loop import Order
from hardware.motion.step import PauseOrder
from hardware.recording.loop_record import LoopKeeper, LoopRecord
from hardware.recording.recorder import Recorder
from hardware.simulator.scenario import read_scenario
from planning.command import Move
from planning.material import FlowShares
from planning.motion.planner import Planner
from tests.fault_run import every
from tests.live_runs import CLOCK, Running, light_runs, messages
from tests.simulated_worlds import Heard, world_of, write_scenario

ROOT = Path(__file__).parents[1]
BREATHING = [{"kind": "breathing", "amplitude_mm": 4.0, "rate_hz": 0.25}]
ANSWERING = {"arm": {"file": "arm.toml", "replies": "stream"}}
SECONDS = 3.0
FAULTS = {  # name: faults of the run, and what its events or holds say of them
    "stopped and resumed": ([], "by the operator"),
    "a recall": (["arm stall 400ms at 1.5s"], "called back"),
    "a silent arm": (["arm unplug at 1.5s for 0.6s"], "has not answered"),  # its line is dead
    "an unplugged arm": ([], "unplugged"),
    "a lost camera": (["camera0 off at 1.2s for 1s"], ""),
    "a hung motion": (["motion hang at 1.5s for 0.3s"], ""),
    "a killed motion": (["motion kill at 2s"], ""),
    "a dispenser that is gone": (["dispenser unplug at 1.2s for 0.8s"], "dispenser dispenser is"),
}


class Recorded(Heard):
    """Keeps poses and the loop's records of a run without pictures, as `stillbed simulate` does."""

    def __init__(self, recorder: Recorder) -> None:
        super().__init__()
        self.recorder, self.records = recorder, list[LoopRecord]()
        self.keeper = LoopKeeper(recorder.attach, self._keep)

    def _keep(self, record: LoopRecord) -> None:
        self.records.append(record)
        self.recorder.write(record)

    def pose(self, frames, pose, report, spent) -> None:  # type: ignore[no-untyped-def]
        super().pose(frames, pose, report, spent)
        self.recorder.write(pose)


def simulated(
    folder: Path, faults: list[str], stops: bool = False, away: tuple[tuple[float, float], ...] = ()
) -> tuple[Path, Recorded]:
    """The recording of a run with faults, and all that was heard of it.

    stops: the flow changes, the operator stops, arms again, pauses and resumes. away: when the arm's device is, s.
    """
    folder.mkdir()
    by = "tracks" if any("camera" in fault for fault in faults) else "truth"
    dispenser = {"dispenser": {"flow_mm3_s": 5.0}} if any("dispenser" in fault for fault in faults) else {}
    scenario = read_scenario(
        write_scenario(
            folder, ANSWERING, {"tracking": {"by": by}, **dispenser}, seconds=SECONDS, motion=BREATHING, faults=faults
        )
    )
    file = folder / "run.mcap"
    with Recorder(file, scenario.known_rig) as recorder:
        sink = Recorded(recorder)
        scenario = replace(scenario, profile=sink.keeper.arm(scenario.profile))
        world = world_of(scenario, sink, keeper=sink.keeper)
        if stops:
            flow = FlowShares(np.array([0.2]), np.array([2.5]), np.array([1.3]))
            told = iter([(1.4, flow), (1.5, Order.STOP), (2.2, PauseOrder.PAUSE), (2.6, PauseOrder.RESUME)])
            later = next(told)

            def order(now: float) -> None:
                nonlocal later
                if now >= later[0]:
                    world.order(later[1])
                    later = next(told, (float("inf"), PauseOrder.PAUSE))

            every(world, 0.01, order)
        world._device.away = away
        world.run()
    return file, sink


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Recorded]]:
    folder = tmp_path_factory.mktemp("recordings")
    return {
        name: simulated(
            folder / name.replace(" ", "_"), faults, "stop" in name, ((1.5, 2.1),) if "unplugged" in name else ()
        )
        for name, (faults, _) in FAULTS.items()
    }


replayed = cache(replay_run)


@pytest.mark.parametrize("name", FAULTS)
def test_a_simulated_run_replays_bit_by_bit(recordings: dict[str, tuple[Path, Recorded]], name: str) -> None:
    file, sink = recordings[name]
    played = replayed(file)
    assert len(played) > 40 and all(each.frame == each.recorded for each in played)
    wire = b"".join(each.frame for each in played)
    assert wire == sink.sent or "kill" in name or "unplug" in name  # where the port is gone nothing passes
    assert wire.startswith(sink.sent[: 40 * FRAME_LENGTH])
    said = " ".join([*(text for _, text in sink.events), *sink.reasons])
    assert FAULTS[name][1] in said, said
    flows = [text for record in sink.records for *_, kind, given in record.calls if kind == "orders" for text in given]
    assert ("flow" in [text[0] for text in flows]) == ("stopped" in name)
    asked = [shares.share.tolist() for shares in asked_flows(read_run(file, "/loop"))]
    assert asked == ([[1.3]] if "stopped" in name else [])  # with which a run that resumes this one begins


def test_the_same_in_another_process_with_two_threads(recordings: dict[str, tuple[Path, Recorded]]) -> None:
    files = [recordings[name][0] for name in ("stopped and resumed", "a recall", "a lost camera")]
    code = "import sys; from pathlib import Path; from hardware.live.recorded_run import replay_run\n"
    code += "for file in sys.argv[1:]:\n print(''.join(p.frame.hex() for p in replay_run(Path(file))))"
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2", "PYTHONHASHSEED": "3"}
    how = {"cwd": ROOT, "env": environment, "capture_output": True, "text": True, "check": True}
    lines = subprocess.run([sys.executable, "-c", code, *files], **how).stdout.split()  # type: ignore[call-overload]
    for file, line in zip(files, lines, strict=True):
        assert line == "".join(each.recorded.hex() for each in replayed(file))


def test_the_command_replays_a_simulated_session(
    recordings: dict[str, tuple[Path, Recorded]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, sink = recordings["a recall"]
    assert main(["replay", str(file), "-o", str(tmp_path / "out")]) == 0
    assert "all equal to the recorded ones" in capsys.readouterr().out
    assert (tmp_path / "out" / "frames.bin").read_bytes() == sink.sent
    assert "called back" in (tmp_path / "out" / "commands.csv").read_text(encoding="utf-8")


def test_a_planner_that_decides_otherwise_is_found(
    recordings: dict[str, tuple[Path, Recorded]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    decides = Planner.__call__

    def other(self: Planner, pose: object, now: float) -> object:
        proposal = decides(self, pose, now)  # type: ignore[arg-type]
        return replace(proposal, feed=proposal.feed * 1.0001) if isinstance(proposal, Move) else proposal

    monkeypatch.setattr(Planner, "__call__", other)
    played = replay_run(recordings["a hung motion"][0])
    assert any(each.frame != each.recorded for each in played)
    assert main(["replay", str(recordings["a hung motion"][0]), "-o", str(tmp_path / "out")]) == 1


@pytest.mark.parametrize(
    ("name", "where", "value"),
    [
        ("a silent arm", "hardware.arm.feedback.MAX_MISSED_ANSWERS", 5),
        ("a recall", "hardware.arm.jog.MIN_TRIAL_STEP", 1.0),
        ("stopped and resumed", "hardware.arm.link.MIN_SHUTDOWN_TIME", 0.5),
        ("an unplugged arm", "hardware.arm.feedback.REST_TIME", 0.6),
        ("stopped and resumed", "hardware.motion.step.PrintMotion.resume", lambda motion: None),
        ("a dispenser that is gone", "hardware.live.recorded_run.PlayedSource.dry", lambda source: ""),
    ],
)
def test_a_link_or_motion_that_does_otherwise_is_found(
    recordings: dict[str, tuple[Path, Recorded]], monkeypatch: pytest.MonkeyPatch, name: str, where: str, value: object
) -> None:
    monkeypatch.setattr(where, value)
    try:
        same = all(each.frame == each.recorded for each in replay_run(recordings[name][0]))
    except PartedError:
        same = False
    print(name, where, same)
    assert not same


@pytest.mark.parametrize("what", ["stop", "pose", "reading", "gap", "start"])
def test_what_is_missing_or_other_is_noticed(
    recordings: dict[str, tuple[Path, Recorded]], tmp_path: Path, what: str
) -> None:
    file, sink = recordings["stopped and resumed"]
    records = list(sink.records)
    middle = next(k for k, r in enumerate(records) if any(call[2] == "stop" for call in r.calls))
    each = records[middle]
    if what == "stop":
        records[middle] = replace(each, calls=tuple(call for call in each.calls if call[2] != "stop"))
    elif what == "reading":
        records[middle] = replace(each, readings=(*each.readings[:1], *each.readings))
    elif what == "gap":
        del records[middle]
    elif what == "start":
        records[0] = replace(records[0], calls=records[0].calls[1:])
    with Recorder(tmp_path / "other.mcap", arc_rig()) as recorder:
        for name, text in attached(file).items():
            recorder.attach(name, text)
        for record in records:
            recorder.write(record)
        for pose in sink.poses[:: 2 if what == "pose" else 1]:
            recorder.write(pose)
    words = {"pose": "is not in the recording, which has gaps", "gap": "a part of the recording is missing"}
    with pytest.raises(PartedError, match=words.get(what, "the loop asked for|how the loop began|gives the arm")):
        replay_run(tmp_path / "other.mcap")


def attached(file: Path) -> dict[str, bytes]:
    """The files that a recording keeps, by name."""
    from hardware.recording.mcap_file import AttachedFile, walk

    return {part.name: part.data for part in walk(file) if isinstance(part, AttachedFile)}


def test_a_recording_without_a_loop_is_refused(tmp_path: Path) -> None:
    with Recorder(tmp_path / "old.mcap", arc_rig()):
        pass
    with pytest.raises(InputError, match="/loop"):
        replay_run(tmp_path / "old.mcap")


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Running]]:
    with light_runs(tmp_path, "--yes", lines=3, speed=8.0) as starter:
        yield starter


@pytest.mark.slow
def test_a_live_run_with_a_stop_replays_bit_by_bit(start: Callable[..., Running], tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    run = start(record)
    run.wait_for(r"\nprint\n")
    CLOCK.wait_until(CLOCK.now() + 2.0)
    run.press(" ")
    assert run.end() == 1 and "stopped: by the operator" in run.said
    played = replay_run(record)
    assert len(played) > 50 and all(each.frame == each.recorded for each in played)
    wire = b"".join(base64.b64decode(str(message["data"])) for message in messages(record, "/arm/sent"))
    assert b"".join(each.frame for each in played) == wire
