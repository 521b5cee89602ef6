"""A live run without pictures: prints, stops, loses nothing, goes on; operated from its page alone."""

from __future__ import annotations

import base64
import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from hardware.arm.profile import ArmProfile
from hardware.files.path_file import read_path, read_progress
from hardware.live.prepared import RunFiles, read_placement
from hardware.live.recorded_run import replay_run
from hardware.operator.view import MoveRequest
from hardware.recording.session_reader import open_session, read_poses, used_inputs
from planning.kinematics import nozzle_from_axes
from planning.path import Path as PrintPath
from planning.placement import path_middle
from tests.browser import Browser, Page
from tests.live_runs import (
    CLOCK,
    Running,
    asks_to_move,
    closed,
    executed,
    light_runs,
    messages,
    printed_once,
    rests,
    summary,
)
from tests.pictureless_run import HOME, prepare_files
from tests.recording_samples import events
from tests.slow_cases import slowly
from tests.test_arm_port import serving

Start = Callable[..., Running]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    with light_runs(tmp_path) as starter:
        yield starter


def begun(start: Start, record: Path, *flags: str) -> Running:
    """A run that prints."""
    run = start(record, "--yes", *flags)
    run.wait_for(r"\nprint\n")
    CLOCK.wait_until(CLOCK.now() + 0.8)
    return run


def confirmed(run: Running) -> int:
    """Lead a run that asks to where it prints."""
    at = run.wait_for("confirm")
    run.press("y")
    at = run.wait_for("ready", at)
    run.press("s")
    return run.wait_for(r"\nprint\n", at)


EARLY = 5.0  # s: 1.1 to 1.6 s were seen beside seven busy processes, where 14 to 20 s were waited for libraries


@pytest.mark.parametrize("number", [signal.SIGINT, *slowly(signal.SIGTERM)])
def test_a_run_that_still_loads_ends_at_once(start: Start, tmp_path: Path, number: int) -> None:
    """Ctrl-C reaches all of its processes, SIGTERM only the first."""
    run = start(tmp_path / "run.mcap", "--page")
    run.wait_for("open http")
    (os.killpg if number == signal.SIGINT else os.kill)(run.process.pid, number)
    begun = CLOCK.now()
    assert run.end() == 128 + number and CLOCK.now() - begun < EARLY
    for words in ("Traceback", "is started again", "--resume", "leaked"):
        assert words not in run.said
    assert "nothing was recorded yet" in run.said and not (tmp_path / "run.mcap").exists()


@pytest.mark.slow
def test_before_a_path_is_begun_a_tracker_that_does_not_end_is_not_waited_for(start: Start, tmp_path: Path) -> None:
    run = start(tmp_path / "run.mcap", "--page", "--deaf")
    run.wait_for("confirm")
    page = run.page()
    assert os.getsid(page) == page  # Linux shares the processor among sessions
    run.process.send_signal(signal.SIGINT)
    begun = CLOCK.now()
    assert run.end() == 130 and CLOCK.now() - begun < EARLY  # 1.5 s were seen, beside ten busy processes
    assert not open_session(tmp_path / "run.mcap").damage and "ended: Ctrl-C" in run.said


def kept(record: Path, path: Path) -> float:
    """The place on the path that is kept for the next run."""
    return read_progress(RunFiles(record).progress, read_path(path))


def last_place(record: Path) -> float:
    """Where on the path the last recorded tick was."""
    return float(str(messages(record, "/tick")[-1]["fraction"]))


@pytest.mark.slow  # test_every_button stops, pauses and goes home; what the operator moves is resumed
def test_stopped_paused_home_and_without_its_page_a_run_goes_on_until_ctrl_c(start: Start, tmp_path: Path) -> None:
    record, second = tmp_path / "run.mcap", tmp_path / "run-2.mcap"
    run = start(record, "--page")
    at = confirmed(run)
    CLOCK.wait_until(CLOCK.now() + 0.5)
    run.press(" ")
    at = run.wait_for("stopped: by the operator", at)
    CLOCK.wait_until(CLOCK.now() + 0.5)
    run.press("r")
    at = run.wait_for(r"\nprint\n", at)
    os.kill(run.page(), signal.SIGKILL)
    at = run.wait_for("paused: the operator's page was lost", at)
    run.press("h")
    at = run.wait_for("stopped: at home", at)
    run.press("r")
    at = run.wait_for(r"\nprint\n", at)
    CLOCK.wait_until(CLOCK.now() + 0.5)
    run.process.send_signal(signal.SIGINT)
    assert run.end() == 128 + signal.SIGINT
    assert "ended: Ctrl-C" in run.said and "go on with: stillbed live --resume" in run.said
    stops = summary(record)["latency_ms"]["stop decided to on the wire"]
    assert stops["count"] >= 2
    resumed = begun(start, record, "--resume")
    now = CLOCK.now()
    os.kill(resumed.process.pid, signal.SIGHUP)  # what the kernel sends when a terminal goes
    os.close(resumed.keys)
    resumed.keys = -1
    assert resumed.end() == 128 + signal.SIGHUP and rests(second, now, 0.5) and not open_session(second).damage
    printed_once(record, second)
    for file in (record, second):
        sends_its_bytes_again(file)


def sends_its_bytes_again(record: Path) -> None:
    """That a recording replays frame by frame, and that its moves are what went to the arm."""
    ticks = list(replay_run(record))
    assert len(ticks) > 40 and all(tick.frame == tick.recorded for tick in ticks)
    wire = b"".join(base64.b64decode(str(m["data"])) for m in messages(record, "/arm/sent"))
    moves = [tick.frame for tick in ticks if tick.frame[1:2] == b"1"]
    assert np.mean([move in wire for move in moves]) > 0.95


@pytest.mark.parametrize("name", ["motion", *slowly("tracking", "recorder")])
def test_a_killed_process_is_noticed_the_arm_rests_the_place_is_kept(name: str, start: Start, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    run = begun(start, record)
    killed = run.kill(name)
    run.wait_for(f"the {name} process was killed by SIGKILL")
    assert run.end() == 1 and rests(record, killed, 0.5) and killed - open_session(record).sets[-1][0].stamp < 1.0
    place = kept(record, tmp_path / "path.csv")
    assert place >= last_place(record) - 1e-9
    if name != "recorder":  # what is recorded ends with the recorder
        assert place - last_place(record) < 1.0


def test_the_main_process_killed_leaves_an_arm_at_rest_and_a_whole_recording(start: Start, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    run = begun(start, record)
    killed = CLOCK.now()
    run.process.kill()
    assert rests(record, killed, 0.5) and killed - closed(record).sets[-1][0].stamp < 0.5
    assert kept(record, tmp_path / "path.csv") == pytest.approx(last_place(record), abs=0.2)
    again = start(record, "--resume")  # who resumes is asked, though the run before asked nobody
    again.wait_for("confirm")
    CLOCK.wait_until(CLOCK.now() + 0.5)
    again.press("q")
    assert again.end() == 1 and "\nready" not in again.said and "\nprint\n" not in again.said


def test_what_the_operator_moves_is_printed_there_recorded_and_resumed(start: Start, tmp_path: Path) -> None:
    record, path = tmp_path / "run.mcap", read_path(tmp_path / "path.csv")
    run = start(record, "--page")
    run.wait_for(r"\nconfirm: known")
    asks_to_move(run, MoveRequest(3.0, -2.0, 12.0))
    at = run.wait_for(r"confirm: moved by hand, move 1: x 3\.00 mm, y -2\.00 mm, turn 12\.00 degrees")
    for key, stage in (("y", "ready"), ("s", r"\nprint\n")):
        run.press(key)
        at = run.wait_for(stage, at)
    CLOCK.wait_until(CLOCK.now() + 0.6)
    run.press("q")
    assert run.end() == 1
    turn, middle = se3.exp_rotation([0.0, 0.0, np.deg2rad(12.0)]), path_middle(path)
    lies = se3.make(turn, middle + [3.0, -2.0, 0.0] - turn @ middle)
    placed = read_placement(RunFiles(record).surface)
    assert placed.surface_from_path == pytest.approx(lies, abs=1e-9) and placed.certain
    assert "moved by hand" in placed.verdict and placed.map == record.resolve()
    inputs = used_inputs(record)
    printed, profile = inputs.path, inputs.profile
    assert printed.surface_from_nozzle == pytest.approx(placed.surface_from_path @ path.surface_from_nozzle, abs=1e-6)
    assert any("moved by hand, move 1: x 3.00 mm" in event.text for event in events(record))
    nozzle_lies_on(record, printed, profile)
    sends_its_bytes_again(record)

    again = start(record, "--resume", "--yes")
    again.wait_for(r"\nprint\n")
    CLOCK.wait_until(CLOCK.now() + 0.6)
    again.press("q")
    again.end()
    second = RunFiles(record).next().record.with_name("run-2.mcap")
    printed_once(record, second)
    assert (used_inputs(second).path.surface_from_nozzle == printed.surface_from_nozzle).all()
    assert read_placement(RunFiles(second).surface).surface_from_path == pytest.approx(lies, abs=1e-9)


def nozzle_lies_on(record: Path, printed: PrintPath, profile: ArmProfile) -> None:
    """That what was extruded lies on the path where it was moved to, as the surface stood at the commands."""
    poses = {pose.stamp: pose for pose in read_poses(record)}
    stamps, points = np.array(sorted(poses)), printed.surface_from_nozzle[:, :3, 3]
    places = np.linspace(0, len(points) - 1, 50 * len(points))
    line = np.column_stack([np.interp(places, np.arange(len(points)), points[:, k]) for k in range(3)])
    off = []
    for move in messages(record, "/move"):
        if not move["extrude"]:
            continue
        due = float(str(move["stamp"])) + profile.tick + profile.lag
        pose = poses[stamps[np.argmin(np.abs(stamps - due))]]
        tip = se3.inverse(pose.base_from_surface) @ nozzle_from_axes(profile.arm, np.array(move["axes"]))
        off.append(np.linalg.norm(line - tip[:3, 3], axis=1).min())
    assert len(off) > 10 and np.median(off) < 0.3


@pytest.mark.slow  # what goes wrong on purpose ends a run by the same way
def test_a_path_that_cannot_be_kept_where_it_lies_ends_the_run_as_anything_does(start: Start, tmp_path: Path) -> None:
    run = start(tmp_path / "run.mcap", "--yes", "--unkept")
    assert run.end() == 1
    assert "failed: what lies on the surface cannot be printed: line 6: position = [1.0, 2.0, 3.0], allowed" in run.said
    assert (tmp_path / "run.report.html").exists() and not open_session(tmp_path / "run.mcap").damage


@pytest.mark.slow  # the bench of the link and test_arm_port_faults unplug it too
def test_an_arm_that_is_unplugged_is_waited_for_and_goes_on_from_home(start: Start, tmp_path: Path) -> None:
    record, link = tmp_path / "run.mcap", tmp_path / "arm"
    with serving(link):
        run = start(record, str(link))
        at = confirmed(run)
        CLOCK.wait_until(CLOCK.now() + 0.5)
    at = run.wait_for("stopped: the arm is unplugged", at)
    run.press("r")
    at = run.wait_for("stopped: the arm is unplugged", at)
    with serving(link):
        at = run.wait_for("the arm is back and does not say where it stands", at)
        run.press("h")
        at = run.wait_for("stopped: at home", at)
        run.press("r")
        at = run.wait_for(r"\nprint\n", at)
        run.press("q")
        assert run.end() == 1 and "finished by the operator" in run.said
    assert not open_session(record).damage


def test_what_goes_wrong_on_purpose_is_said_held_through_and_stops_the_arm(start: Start, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    hang, full = "tracking hang at 1s for 1s", "disk full at 4s"
    run = start(record, "--yes", "--burst", f"--fault={hang}", f"--fault={full}")
    run.wait_for("the recording has gaps: the disk or the processor was too slow for [0-9]+ entr")
    run.wait_for("on purpose: tracking hang")
    hung = CLOCK.now()
    run.wait_for("on purpose: disk full")
    struck = CLOCK.now()
    assert run.end() == 1 and "recording stopped" in run.said and "go on with: stillbed live --resume" in run.said
    gaps = run.said.rpartition("the recording has gaps: ")[2].partition("\n")[0]
    lost = json.loads(RunFiles(record).summary.read_text())["unrecorded"]
    assert 20 < lost < 5000 and f" {lost} entries" in gaps and gaps in RunFiles(record).report.read_text()
    assert any("has gaps" in event.text for event in events(record))
    holds = [m for m in messages(record, "/hold") if hung < float(str(m["stamp"])) < hung + 1.2]
    assert any("pose is" in str(m["reason"]) for m in holds)
    missed = [event for event in events(record) if "the tracking process has said nothing" in event.text]
    assert any(hung < event.stamp < hung + 1.2 for event in missed)
    went_on = [m for m in messages(record, "/move") if hung + 1.0 < float(str(m["stamp"])) < struck]
    assert len(went_on) > 20 and rests(record, struck, 1.0)
    assert kept(record, tmp_path / "path.csv") >= last_place(record) - 1e-9


@pytest.mark.slow  # test_wrong_input prints to the end, and test_live_stages ends in every stage
def test_a_run_that_is_ended_once_all_is_printed_is_not_to_be_resumed(start: Start, tmp_path: Path) -> None:
    prepare_files(tmp_path, lines=2, speed=10.0)
    run = start(tmp_path / "run.mcap", "--yes")
    run.wait_for(r"\nprint\nhoming\n")
    run.process.send_signal(signal.SIGINT)
    assert run.end() == 130 and run.said.count("ended: Ctrl-C") == 2 and "ended: ended" not in run.said
    assert "the path is printed; there is nothing to go on with" in run.said and "--resume" not in run.said


SETTLED = 0.3  # s after which what was sent before has been carried out
RETREATED = 2.0  # s after which the nozzle stands above the surface in a pause


@pytest.fixture
def run(start: Start, tmp_path: Path) -> Running:
    return start(tmp_path / "run.mcap", "--page")


def press(page: Page, wish: str, leads_to: str, sure: bool = False) -> float:
    """Press a button, and again if a busy machine let the page look old at that moment; when it was followed, s."""
    button = f'footer [data-wish="{wish}"]'
    for attempt in range(6):
        if attempt and page.js(f'{leads_to}.includes(document.body.dataset.stage + "")'):
            return CLOCK.now()
        page.until(f"document.querySelector('{button}') && !document.querySelector('{button}').disabled", timeout=60)
        page.js("new Promise((done) => setTimeout(done, 750))")
        page.click(button)
        if (sure or wish == "resume") and page.js('!document.getElementById("sure").hidden'):
            page.click("#sure-yes")
        try:
            page.until(f'{leads_to}.includes(document.body.dataset.stage + "")', timeout=4)
            return CLOCK.now()
        except AssertionError:
            continue
    raise AssertionError(f"{wish} led to nothing: {page.js('document.body.innerText')}")


def moves_sent(record: Path) -> np.ndarray:
    """Stamps (N,), s, of the moves that went to the arm."""
    sent = messages(record, "/arm/sent")
    return np.array([float(str(m["stamp"])) for m in sent if base64.b64decode(str(m["data"]))[1:2] == b"1"])


@pytest.mark.slow
def test_every_button_does_what_it_says_and_the_end_is_told(run: Running, browser: Browser, tmp_path: Path) -> None:
    end = run.wait_for(r"open http://\S+")
    page = browser.page(run.said[:end].rsplit(" ", 1)[1])
    confirmed = press(page, "confirm", '["ready"]')
    started = press(page, "start", '["homing", "approach", "print"]', sure=True)
    prints(page)
    paused = press(page, "pause", '["paused"]')
    pause_ends = later(RETREATED + 1.0)
    press(page, "resume", '["approach", "print"]')
    prints(page)
    homing = press(page, "home", '["homing", "stopped"]', sure=True)
    page.until('document.body.dataset.stage === "stopped"', timeout=60)
    home = CLOCK.now()
    home_ends = later(0.5)
    press(page, "resume", '["approach", "print"]', sure=True)
    prints(page)
    stopped = press(page, "stop", '["stopped"]')
    stop_ends = later(1.0)
    press(page, "resume", '["approach", "print"]', sure=True)
    prints(page)
    ended = press(page, "end", '["ended"]', sure=True)
    page.until('document.body.dataset.news === "gone"', timeout=60)
    assert page.text("#chip") == "Finished" and "by the operator" in page.text("#reason")
    assert run.end() == 1 and "\nfinished by the operator\n" in run.said
    record = tmp_path / "run.mcap"
    closed(record)
    moves = moves_sent(record)

    def between(begin: float, end: float) -> int:
        return int(((moves > begin) & (moves < end)).sum())

    assert between(0.0, confirmed) == 0 and between(started, paused) > 20
    assert between(paused + RETREATED, pause_ends) == 0 and between(pause_ends, homing) > 20
    assert between(homing, home) > 5 and between(home + SETTLED, home_ends) == 0
    assert between(home_ends, stopped) > 20 and between(stopped + SETTLED, stop_ends) == 0
    assert between(stop_ends, ended) > 20 and between(ended + SETTLED, np.inf) == 0
    stamps, axes = executed(record)
    for begin, end in ((stopped, stop_ends), (home, home_ends), (ended, np.inf)):
        still = axes[(stamps > begin + SETTLED) & (stamps < end)]
        assert not len(still) or np.ptp(still, axis=0).max() < 0.05
    waits = axes[(stamps > paused + RETREATED) & (stamps < pause_ends)]
    printing = axes[(stamps > paused - 0.3) & (stamps < paused)]
    assert waits[:, 2].min() > printing[:, 2].max() + 5.0
    at_home = axes[(stamps > home + SETTLED) & (stamps < home_ends)]
    assert np.abs(at_home[:, 2] - HOME).max() < 0.1
    sends_its_bytes_again(record)  # with stops, a pause and a way home in it


def prints(page: Page) -> None:
    page.until('document.body.dataset.stage === "print"', timeout=60)
    later(0.8)


def later(seconds: float) -> float:
    """Wait; the instant, s."""
    CLOCK.wait_until(CLOCK.now() + seconds)
    return CLOCK.now()
