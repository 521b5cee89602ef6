"""What a simulated print lays: what its dispenser was told over its line, as late and as leaky as that is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path as File
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.signal import fftconvolve

from estimation.errors import InputError
from hardware.arm.driver import UnpluggedError
from hardware.files.path_file import read_path
from hardware.process.clock import SimClock
from hardware.process.faults import fault_from_text
from hardware.simulator.deposit import _disc, _spread, deposit_figures, deposit_map, planned_line, row_volumes
from hardware.simulator.dispenser import DispenserModel, DispenserPort
from hardware.simulator.material import BEAD_STEP, IDEAL, SimulatedDispensers, piece_ends
from hardware.simulator.nozzle_error import MaterialFigures, material_figures, nozzle_errors
from hardware.simulator.scenario import read_scenario
from hardware.simulator.truth import divide_path
from hardware.simulator.world import SimulatedWorld
from planning.command import Command, Hold, Move
from planning.material import bead_areas
from tests import simulated_worlds
from tests.fault_run import open_unattended
from tests.moving_surfaces import path_through
from tests.nozzle_logs import nozzle_log, straight

TICK, SPEED, BEAD = 0.02, 10.0, 1.0  # s, mm/s, mm
LATE = {"on_dead_time_s": 0.1, "off_dead_time_s": 0.06}
OOZING = {"ooze_mm3": 0.5, "ooze_lag_s": 0.1}
PLACES = (-9.0, -4.0, -1.0, 4.0)  # mm: two beads of 5 mm and a gap of 3


@cache
def printed(
    dispenser: tuple[tuple[str, object], ...] = (), faults: Sequence[str] = ()
) -> tuple[SimulatedWorld, simulated_worlds.Heard]:
    """A print of two beads on a surface at rest that nothing delays but the dispenser."""
    with TemporaryDirectory() as name:
        rows = [f"{x},0,0,0,0,0,{SPEED},1,20,0,{i % 2}" for i, x in enumerate(PLACES)]
        (File(name) / "path.csv").write_text("\n".join([simulated_worlds.HEADER, *rows]) + "\n")
        tables = [simulated_worlds.IDEAL, *([{"dispenser": dict(dispenser)}] if dispenser else [])]
        top = {"faults": list(faults)} if faults else {}
        scenario = read_scenario(
            simulated_worlds.write_scenario(File(name), *tables, seconds=5.0 if faults else 2.6, **top)
        )
        world = simulated_worlds.world_of(scenario, sink := simulated_worlds.Heard())
    world.run()
    return world, sink


@pytest.mark.parametrize(("rows", "columns", "width"), [(40, 31, 7), (2, 90, 1), (5, 4, 23)])
def test_a_map_spread_by_a_disc_is_the_convolution(rows: int, columns: int, width: int) -> None:
    values, disc = np.zeros((rows + 2, columns + 2)), _disc(width)
    values[1:-1, 1:-1] = np.random.default_rng(width).random((rows, columns))
    y, x = np.nonzero(values)
    spread = _spread(np.column_stack([x, y]) + 0.5, values[y, x], values.shape, disc)
    assert np.abs(spread - fftconvolve(values, disc, "same")).max() < 2e-9


def figures(**dispenser: object) -> MaterialFigures:
    world, sink = printed(tuple(dispenser.items()))
    line, log = planned_line(world._path), sink.log
    return material_figures(log, line, nozzle_errors(log, line), BEAD, world.open_outside)


def test_without_a_table_beads_lie_where_the_motion_prints() -> None:
    world, sink = printed()
    line, log = planned_line(world._path), sink.log
    due = np.maximum(np.diff(log.place, prepend=np.nan), 0.0) / 1e-3
    commanded = replace(log, flow=np.nan_to_num(due) * log.extrude)
    told, before = (deposit_figures(deposit_map(each, line, BEAD)) for each in (log, commanded))
    for name in ("coverage", "gaps", "overlap", "outside", "material"):
        assert getattr(told, name) == pytest.approx(getattr(before, name), abs=0.005)
    found = figures()
    assert np.abs([*found.beginnings.error, *found.ends.error]).max() < 0.05 and len(found.ends.error) == 2
    assert found.open_outside == found.ooze == 0.0 and found.volume == pytest.approx(found.planned_volume, rel=0.01)


def test_what_is_laid_is_the_integral_of_the_true_flow() -> None:
    world, sink = printed(tuple((LATE | OOZING).items()))
    times = np.arange(0.0005, sink.log.stamps[-1], 1e-3)
    flown = float(world.dispensers.flow(times, np.zeros(len(times))).sum()) * 1e-3
    assert figures(**LATE, **OOZING).volume == pytest.approx(flown, rel=2e-3) and flown > 10.0


@given(st.lists(st.integers(1, 4000), min_size=1, max_size=30).map(sorted))
@example([1795])  # whose last instant numpy puts a rounding error beyond
def test_pieces_of_beads_end_in_equal_steps_and_never_in_the_future(counts: list[int]) -> None:
    start = 0.0
    for until in (count * BEAD_STEP for count in counts):
        ends = piece_ends(start, until)
        assert (ends < until).all() and np.allclose(np.diff([start, *ends]), BEAD_STEP)
        start = float(ends[-1]) if len(ends) else start
        assert until - start <= 1.001 * BEAD_STEP  # nothing that has left the needle waits longer


@given(st.lists(st.floats(0, 9), min_size=5, max_size=5))
@settings(max_examples=5)
def test_the_map_holds_what_left_the_nozzle(flows: list[float]) -> None:
    path = straight()
    log = nozzle_log(path)
    log.flow[:] = np.repeat(flows, len(log) // 5 + 1)[: len(log)]
    found = deposit_map(log, planned_line(path), BEAD)
    assert found.deposited.sum() * found.cell**2 == pytest.approx(row_volumes(log).sum() * BEAD, rel=1e-6, abs=1e-6)


def test_a_delay_that_nobody_knows_of_shifts_beads_by_its_way_and_one_that_is_known_does_not() -> None:
    shifted, led = figures(**LATE, led=False), figures(**LATE)
    assert shifted.beginnings.error[1] == pytest.approx(0.1 * SPEED, abs=0.1)
    assert shifted.ends.error[0] == pytest.approx(0.06 * SPEED, abs=0.1)
    assert np.abs([*led.beginnings.error, *led.ends.error]).max() < 0.15
    assert shifted.beginnings.blob < -0.5 < led.beginnings.excess.min()  # mm^3: what is late is missing there
    assert shifted.open_outside == led.open_outside == 0.0 and shifted.flow_outside > 0.04


def test_a_lag_is_led_to_half_of_the_flow() -> None:
    led = figures(on_lag_s=0.05, off_lag_s=0.05)
    assert np.abs([led.beginnings.error[1], led.ends.error[0]]).max() < 0.15


def test_ooze_is_a_blob_behind_the_bead_and_lies_beside_the_path() -> None:
    tight, leaky = figures(led=True), figures(**OOZING)
    assert leaky.ends.excess.min() > tight.ends.excess.max() + 0.1
    assert leaky.ooze > 0.05 and leaky.volume - tight.volume == pytest.approx(0.9, abs=0.15)  # the rest comes later


def test_a_valve_gives_what_it_gives() -> None:
    assert figures(flow_mm3_s=5.0).volume == pytest.approx(figures().planned_volume * 5.0 / SPEED, rel=0.15)


def test_a_line_that_takes_nothing_stops_the_print_and_it_goes_on() -> None:
    world, sink = printed(tuple(LATE.items()), ("dispenser block at 0.65s for 1.5s",))
    model = world.dispensers.models[0]
    assert len(model.watchdog_stops) == 1 and 0.65 < model.watchdog_stops[0] < 0.8
    reasons = {command.reason for command in sink.commands}
    assert any("dispenser is failed: its line took nothing" in reason for reason in reasons)
    assert sink.progress[-1].fraction == 3.0 and sink.log.flow[sink.log.stamps > 2.5].max() > 5.0


def test_a_hold_in_the_middle_of_a_bead_closes_at_once() -> None:
    world, sink = printed((), ("tracking hang at 0.4s for 0.6s",))
    held = [command.stamp for command in sink.commands if isinstance(command, Hold) and "old" in command.reason]
    assert held and world.open_outside == 0.0 and not world.dispensers.models[0].watchdog_stops
    assert not sink.log.flow[(sink.log.stamps > held[0] + 0.002) & (sink.log.stamps < held[-1])].any()
    assert sink.progress[-1].fraction == 3.0


def test_a_line_loses_what_its_faults_say() -> None:
    clock, model = SimClock(), DispenserModel(IDEAL)
    texts = "dispenser drop at 1s for 1s", "dispenser block at 2s for 1s", "dispenser unplug at 3s for 1s"
    port = DispenserPort(model, clock, [fault_from_text("x", "y", text) for text in texts])
    for now, taken, is_open in ((0.5, 3, True), (1.5, 4, False), (2.5, 0, False)):
        clock.wait_until(now)
        assert port.write(b"ON\n" if now < 1 else b"OFF\n") == taken
        model.advance(now + 0.05)
        assert model.on == is_open
    clock.wait_until(3.5)
    for call in (port, port.read, lambda: port.write(b"ON\n")):
        with pytest.raises(UnpluggedError):
            call()
    clock.wait_until(4.0)
    assert port() is port


def moves(flow: float, after: float = 0.0, stamp: float = 0.0) -> Move:
    return Move(stamp, np.zeros(6), 1.0, 1, flow > 0, flow=flow, flow_after=after)


@pytest.mark.parametrize(
    ("following", "outside"),
    [
        (moves(5.0, stamp=0.02), 0.0),
        (moves(0.0, 0.012, 0.02), 0.04),
        (Hold(0.02, 0.02, "x"), 0.06),
        (moves(0.0, stamp=0.02), 0.06),
    ],
)
def test_told_on_counts_where_the_last_command_does_not_print(following: Command, outside: float) -> None:
    clock = SimClock()
    dispensers = SimulatedDispensers(path_through(np.array([[0.0, 0, 0], [9, 0, 0]])), None, clock)
    dispensers.control.begin(0.0, 0.0)
    dispensers.add_command(moves(5.0), TICK)
    dispensers.control.follow(moves(5.0), 0.0)
    dispensers.add_command(following, TICK)  # and it is not followed
    assert dispensers.open_outside(0.08) == pytest.approx(outside)
    assert dispensers.open_outside(0.08, [(0.0, 1.0)]) == 0.0
    assert open_unattended(dispensers, [(0.01, 1.0)], 0.08) == pytest.approx(0.07)
    dispensers.forbid(0.03)
    assert dispensers.open_outside(0.08) == pytest.approx(max(outside, 0.05))


@pytest.mark.parametrize(
    ("table", "key"),
    [
        ({"on_dead_time_s": -1.0}, "on_dead_time_s"),
        ({"on_dead_time_s": 0.5}, "dispenser: delay on"),
        ({"off_lag_s": math.inf}, "off_lag_s"),
        ({"watchdog_s": 0.001}, "watchdog_s"),
        ({"led": 1}, "led"),
        ({"ooz_mm3": 1.0}, "ooz_mm3"),
        ({"file": "none.toml"}, "none.toml"),
        ({"file": "pwm.toml"}, "dispenser.preset"),
    ],
)
def test_a_table_that_makes_no_sense_is_refused_by_its_key(tmp_path: File, table: dict[str, object], key: str) -> None:
    text = '[[dispenser]]\nname = "a"\nmaterials = [1]\npreset = "arm_pwm"\npwm_on = 1\npwm_off = 0\n'
    (tmp_path / "pwm.toml").write_text(text)
    with pytest.raises(InputError, match=key):
        read_scenario(simulated_worlds.write_scenario(tmp_path, simulated_worlds.IDEAL, dispenser=table))


def test_a_file_says_what_the_motion_takes_the_dispenser_for(tmp_path: File) -> None:
    text = '[[dispenser]]\nname = "a"\nmaterials = [1]\npreset = "arduino"\nport = "/dev/x"\non_dead_time_s = 0.03\n'
    (tmp_path / "own.toml").write_text(text + "kept_at_c = 20\n")
    file = simulated_worlds.write_scenario(
        tmp_path, simulated_worlds.IDEAL, dispenser={"on_dead_time_s": 0.1, "file": "own.toml"}
    )
    scenario = read_scenario(file)
    assert scenario.dispenser is not None and scenario.dispenser.truth.on_dead_time == 0.1
    found = SimulatedDispensers(read_path(scenario.path), scenario.dispenser, SimClock())
    assert found.outlets["1"].delay.on == 0.03
    (tmp_path / "own.toml").write_text(text.replace("[1]", "[2]"))
    with pytest.raises(InputError, match="material"):
        SimulatedDispensers(read_path(scenario.path), read_scenario(file).dispenser, SimClock())


def test_pieces_of_a_way_share_its_volume_and_the_first_has_its_rest() -> None:
    path = path_through(np.array([[0.0, 0, 0], [4, 0, 0], [4, 6, 0]]))
    extra = {"volume_mm3": np.array([0, 2, 6]), "wait_s": np.array([0.0, 0.0, 3.0])}
    fine = divide_path(replace(path, extra=extra), 1.0)
    assert fine.extra["volume_mm3"].sum() == pytest.approx(8.0)
    assert bead_areas(fine)[1:].tolist() == pytest.approx([0.5] * 4 + [1.0] * 6)
    assert fine.extra["wait_s"].tolist() == [*[0.0] * 5, 3.0, *[0.0] * 5]
