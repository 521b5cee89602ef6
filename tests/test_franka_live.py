"""Live runs with a Franka in MuJoCo: `make counterparts`. Where its nozzle was, the simulator's own flange says."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.files.arm_file import arm_over, read_arm, write_arm
from hardware.files.path_file import read_path
from hardware.live.prepared import RunFiles
from hardware.live.prerender import nozzle_errors as nozzle_errors_from_pictures
from hardware.live.prerender import prerender
from hardware.live.recorded_run import commands_in, read_run, replay_run
from hardware.simulator.truth import Truth, TruthLog, row_instants
from planning.path import PrintPhase
from tests import octoprint_bench
from tests.arm_benches import closing_bench
from tests.franka_bench import HOST, MISSING, FrankaBench, FrankaServer, installed
from tests.live_runs import CLOCK, PATH, SCENARIO, Running, messages
from tests.moving_surfaces import breathing
from tests.octoprint_bench import ROOT, OctoPrintServer
from tests.pictureless_run import HOME, TILT, prepare_files
from tests.test_arm_laws import straight
from tests.test_live_run import confirmed

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not installed(), reason=MISSING)]
ADDRESS = f"franka://{HOST}"
# pictures that leave a core to MuJoCo, which must keep real time, and breaths of 4 mm
PICTURES = SCENARIO.replace("seconds = 2.7", "seconds = 4.3").replace("fps = 20.0", "fps = 15.0")
PICTURES = PICTURES.replace("amplitude_mm = 2.0", "amplitude_mm = 4.0").replace("rate_hz = 0.4", "rate_hz = 0.25")
HEIGHT = 2.0  # mm up and 2 mm down: breaths of 4 mm
PLUNGER_MM2 = 78.5  # of data/dispensers/arm_axis.toml
STANDSTILL = 0.05  # mm from where it comes to rest


class Live:
    """An arm that others imitate and the runs that print with it. serve: starts it in a folder, with its home (6,)."""

    def __init__(
        self,
        folder: Path,
        serve: Callable[[Path, Array], FrankaServer | OctoPrintServer] = lambda folder, home: FrankaServer(folder),
        address: str = ADDRESS,
    ) -> None:
        self.folder, self.address, self.runs = folder, address, list[Running]()
        prepare_files(folder, lines=12, speed=5.0)
        profile = arm_over(ArmProfile(), address)
        home = profile.arm.home.copy()
        home[2] += HOME - ArmProfile().arm.home[2]
        self.profile = replace(profile, arm=replace(profile.arm, home=home))
        write_arm(folder / "arm.toml", self.profile, "near the surface")
        self.server = serve(folder, home)

    def start(self, record: Path, *flags: str) -> Running:
        program = "tests.pictureless_run", str(self.folder), str(record), *flags
        self.runs.append(Running(self.address, f"--height={HEIGHT}", cache=self.folder, program=program))
        return self.runs[-1]

    def close(self) -> None:
        for run in self.runs:
            run.close()
        if self.server.process is not None:
            self.server.end(signal.SIGKILL)


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    made = Live(tmp_path)
    try:
        yield made
    finally:
        made.close()


class _Breathing:
    """The true motion of the surface."""

    def __call__(self, times: Array) -> Array:
        return np.stack([breathing(t, height=HEIGHT, tilt=TILT) for t in times])

    def twist(self, times: Array) -> Array:
        raise NotImplementedError


def nozzle_errors(record: Path, path: Path, profile: ArmProfile, stamps: Array, axes: Array) -> tuple[Array, float]:
    """Error (N,), mm, of each extruding millisecond by the true nozzle, and the duty."""
    commands = commands_in(read_run(record, "/tick", "/move"))
    log = TruthLog(read_path(path), profile.arm, Truth(np.eye(4), _Breathing()), profile.tick, profile.lag)
    for command, progress in commands:
        log.write(command, progress)
    printed = PrintPhase.LEAVING, PrintPhase.FINISHED
    end = min([c.stamp for c, p in commands if p.phase in printed], default=np.inf)
    last = min(log.last_due, float(stamps[-1]), end)

    def axes_at(times: Array) -> Array:
        return np.stack([np.interp(times, stamps, axes[:, i]) for i in range(6)], axis=1)

    rows = log.rows(row_instants(commands[0][0].stamp, last), axes_at, None)
    known = rows.extrude & np.isfinite(rows.place)
    off = rows.base_from_nozzle[known, :3, 3] - rows.base_from_target[known, :3, 3]
    due = int((np.isfinite(rows.place) & (rows.place > 0)).sum())
    return np.linalg.norm(off, axis=1), int(rows.extrude.sum()) / due


def test_a_breathing_surface_is_printed_and_the_true_flange_says_how_well(live: Live) -> None:
    record = live.folder / "run.mcap"
    run = live.start(record, "--yes", "--until-printed")
    run.wait_for(r"\nprint\n")
    run.wait_for("done|finished|ended")
    code = run.end()
    assert isinstance(live.server, FrankaServer)
    stamps, axes = live.server.truth(live.profile)
    errors, duty = nozzle_errors(record, live.folder / "path.csv", live.profile, stamps, axes)
    p95, most, load = float(np.percentile(errors, 95)), float(errors.max()), os.getloadavg()[0]
    rate = len(stamps) / (stamps[-1] - stamps[0]) / 1000
    words = (
        f"P95 {p95:.2f} mm, max {most:.2f} mm, duty {100 * duty:.0f} %, load {load:.1f}, physics at {rate:.2f} of time"
    )
    print(words)
    assert code == 0, run.said
    ticks = replay_run(record)
    assert len(ticks) > 200 and all(tick.frame == tick.recorded for tick in ticks)
    assert p95 <= 0.5 and most <= 1.0 and duty >= 0.8, words


def test_from_pictures_the_true_flange_says_how_well_a_franka_prints(tmp_path: Path) -> None:
    server = FrankaServer(tmp_path)
    try:
        print_from_pictures(tmp_path, ADDRESS, server.truth)
    finally:
        server.end(signal.SIGKILL)


@pytest.mark.skipif(not octoprint_bench.installed(), reason=octoprint_bench.MISSING)
def test_from_pictures_octoprint_s_printer_says_how_well_it_prints(tmp_path: Path) -> None:
    address = f"gcode://{tmp_path / 'printer'}"
    server = OctoPrintServer(tmp_path, arm_over(ArmProfile(), address).arm.home)
    head, *rows = PATH.split()
    metered = "\n".join([f"{head},volume_mm3", *(f"{row},0.4" for row in rows)]) + "\n"
    given = "--dispensers", str(ROOT / "data/dispensers/arm_axis.toml")
    try:
        print_from_pictures(tmp_path, address, lambda profile: server.places(), metered, *given)
    finally:
        server.end(signal.SIGKILL)
    pushed = float(np.ptp(np.loadtxt(server.log)[:, 4])) * PLUNGER_MM2
    assert pushed == pytest.approx(0.4 * sum(row.endswith(",1") for row in rows), rel=0.01)


def print_from_pictures(
    folder: Path, address: str, truth: Callable[[ArmProfile], tuple[Array, Array]], path: str = PATH, *given: str
) -> None:
    """Print a scenario, all tracking included, and compare the nozzle with its place on the true surface.

    given: options of the command. truth: ends the arm; stamps (N,), s, and axes (N, 6), where it truly was.
    """
    scenario, record = folder / "scenario.toml", folder / "run.mcap"
    scenario.write_text(PICTURES, encoding="utf-8")
    (folder / "path.csv").write_text(path, encoding="utf-8")
    rendered = prerender(scenario, folder / "cache" / "stillbed").folder
    profile = arm_over(read_arm(rendered / "arm.toml"), address)
    write_arm(folder / "arm.toml", profile, "where a simulated run puts it")
    what = "--simulated", str(scenario), "--arm", address, "--yes", "--no-page", "--record", str(record)
    run = Running(*what, *given, cache=folder / "cache")
    try:
        run.wait_for(r"\nprint\n")
        run.wait_for("done|finished|stopped|failed")
        code = run.end()
    finally:
        run.close()
    stamps, axes = truth(profile)
    executed = RunFiles(record).executed
    np.savez(executed, stamps=stamps, axes=axes, deepest=np.nan, held_up=np.nan)
    error = nozzle_errors_from_pictures(record, executed, rendered / "path.csv", folder / "arm.toml")
    p95, most, load = error.figure(95), error.figure(100), os.getloadavg()[0]
    steps = np.diff(stamps)
    pace = f"places every {1000 * np.median(steps):.1f} ms, at most {1000 * steps.max():.0f} ms apart"
    words = f"P95 {p95:.2f} mm, max {most:.2f} mm, duty {100 * error.duty:.0f} %, load {load:.1f}, {pace}"
    print(words)
    assert code == 0, run.said
    assert p95 <= 0.5 and most <= 1.0 and error.duty >= 0.8, words


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "hung"])
def test_a_robot_that_is_gone_is_held_in_time_and_printing_goes_on_where_it_was(
    live: Live, number: signal.Signals
) -> None:
    record = live.folder / "run.mcap"
    run = live.start(record, "--until-printed")
    at = confirmed(run)
    CLOCK.wait_until(CLOCK.now() + 4.0)
    assert live.server.process is not None
    gone = CLOCK.now()
    live.server.process.send_signal(number)
    at = run.wait_for("stopped: the arm is unplugged", at)
    live.server.end(signal.SIGKILL)
    live.server.start()
    at = run.wait_for("the arm is back", at)
    run.press("h")
    at = run.wait_for("stopped: at home", at)
    run.press("r")
    at = run.wait_for(r"\nprint\n", at)
    run.wait_for("done", at)
    assert run.end() == 0, run.said
    moves = sorted(float(str(m["stamp"])) for m in messages(record, "/move"))
    last = max(stamp for stamp in moves if stamp < gone + 1.0)
    print(f"last move {1000 * (last - gone):.0f} ms after it was {number.name}, load {os.getloadavg()[0]:.1f}")
    assert last - gone <= 0.1
    extruding = {m["stamp"]: m["extrude"] for m in messages(record, "/move")}
    ticks = [tick for tick in messages(record, "/tick") if extruding.get(tick["stamp"])]
    stamps, places = np.array(sorted((float(str(tick["stamp"])), float(str(tick["fraction"]))) for tick in ticks)).T
    again = np.searchsorted(stamps, gone + 1.0)
    print(f"printed to {places[:again].max():.3f}, then from {places[again]:.3f} on")
    done = places[stamps <= gone - live.profile.tick - live.profile.lag].max()  # what the robot had surely done
    slack = 0.02  # checkpoints, two ticks
    assert done <= places[again] <= places[:again].max() + slack  # nothing is printed twice, and nothing left out
    assert (np.diff(places[again:]) >= -1e-9).all()


def test_a_motion_process_that_is_killed_leaves_the_robot_at_rest(live: Live) -> None:
    run = live.start(live.folder / "run.mcap", "--yes")
    run.wait_for(r"\nprint\n")
    CLOCK.wait_until(CLOCK.now() + 3.0)
    killed = run.kill("motion")
    run.wait_for("the motion process was killed by SIGKILL")
    assert run.end() == 1
    CLOCK.wait_until(killed + 2.0)
    assert isinstance(live.server, FrankaServer)
    stamps, axes = live.server.truth(live.profile)
    before, after = axes[(stamps > killed - 0.5) & (stamps < killed)], axes[stamps > killed + 0.3]
    assert np.ptp(before[:, :3], axis=0).max() > 0.5 and np.ptp(after[:, :3], axis=0).max() < 0.2


def test_fifty_stops_are_short_in_time_and_way(tmp_path: Path) -> None:
    with closing_bench(FrankaBench(tmp_path)) as bench:
        bench.begin()
        decided, sign = [], 1.0
        for number in range(50):
            target = bench.arm.target
            bench.follow(straight(target, sign * 20.0), 0.5 + 0.013 * (number % 7))
            decided.append(bench.clock.now())
            bench.arm.stop("to measure it", decided[-1])
            bench.run(0.5)
            assert bench.arm.arm(bench.clock.now()) == ""
            sign = -sign
        stamps, axes = bench.truth()
    times, ways = [], []
    for since in decided:
        begin, end = np.searchsorted(stamps, [since, since + 0.45])
        left = np.linalg.norm(axes[begin:end, :3] - axes[end, :3], axis=1)
        moving = np.flatnonzero(left > STANDSTILL)
        times.append(stamps[begin + moving[-1]] - since if len(moving) else 0.0)
        ways.append(left[0])
    time, way = np.percentile(times, 99), np.percentile(ways, 99)
    print(f"99 % of 50 stops: {1000 * time:.0f} ms, {way:.2f} mm, load {os.getloadavg()[0]:.1f}")
    assert time <= 0.15 and way <= 1.0
