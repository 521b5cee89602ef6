"""The closed loop in virtual time: what it measures is right, it is the same each time, and no fault ends it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST as BASE_FROM_REST
from hardware.arm.driver import Pause
from hardware.arm.protocol import encode
from hardware.motion.loop import Tick
from hardware.process.clock import EASE_RANGE
from hardware.simulator.deposit import NozzleLog
from hardware.simulator.nozzle_error import nozzle_lag
from hardware.simulator.scenario import read_scenario
from hardware.simulator.scene.shape import Deformation
from hardware.simulator.world import FINISH_TAIL
from planning.command import TICK_FRACTION
from planning.path import PrintPhase, PrintProgress
from tests.simulated_worlds import HEADER, IDEAL, Heard, errors, heard, inner, world_of, write_path, write_scenario
from tests.slow_cases import slowly

VELOCITY = np.array([3.0, -2.0, 4.0])  # mm/s of the surface, in the rest frame
SPEED = 5.0  # mm/s along the path, which is x
STEADY = {"kind": "ramp", "speed_mm_s": VELOCITY.tolist(), "start_s": -0.2}  # constant from 0 s on
TURNING = {"kind": "ramp", "speed_mm_s": [0.0, 0.0, 3.0], "speed_deg_s": [4.0, -3.0, 5.0], "start_s": -0.2}


def difference(log: NozzleLog) -> Array:
    """Nozzle less target (N, 3), mm, in base."""
    return np.asarray((log.base_from_nozzle - log.base_from_target)[:, :3, 3])


UNEVEN = 0.0015  # s by which ticks are off even instants while they fall into step with the poses
EARLY = (1 - TICK_FRACTION) * 0.02  # s by which a move ends before the next begins, and the nozzle is ahead


@pytest.mark.parametrize("motion", [[TURNING], *slowly([], [STEADY])], ids=["turning", "still", "moving"])
def test_with_nothing_wrong_every_printed_row_is_within_7_um(motion: list[object], tmp_path: Path) -> None:
    write_path(tmp_path / "path.csv", [[-0.1, 0, 0], [0.1, 0, 0]], speed=0.2)  # no faster: starting is an error too
    file = write_scenario(tmp_path, IDEAL, motion=motion, seconds=9.5)
    log = heard(file).log
    assert log.extrude.sum() > 900
    assert errors(file, log).distance[log.extrude].max() < 0.007
    turning = np.linalg.norm([4.0, -3.0, 5.0]) if motion == [TURNING] else 0.0  # deg/s
    assert np.rad2deg(errors(file, log).angle[log.extrude].max()) < 0.001 + (EARLY + UNEVEN) * turning


@pytest.mark.parametrize("motion", [[TURNING], *slowly([], [STEADY])], ids=["turning", "still", "moving"])
def test_at_printing_speed_starting_and_stopping_cost_no_more_than_9_um(motion: list[object], tmp_path: Path) -> None:
    file = write_scenario(tmp_path, IDEAL, motion=motion, seconds=3.0)
    log = heard(file).log
    distance = errors(file, log).distance
    assert inner(log).sum() > 1000
    assert distance[inner(log)].max() < 0.005 and distance[log.extrude].max() < 0.009


def late_arm(arm: dict[str, object], **more: object) -> dict[str, object]:
    return {"motion": [STEADY], "seconds": 2.2, "arm": arm, **more}


@pytest.mark.parametrize(
    "late",
    [
        (late_arm({"dead_time_s": 0.02, "servo_lag_s": 0.02}), 0.04),
        (late_arm({"assumed_lag_s": 0.04}), -0.04),  # told of more than there is, it is early
        *slowly(
            (late_arm({"wire_baud": 115200}), 48 * 10 / 115200),
            (late_arm({"dead_time_s": 0.05}), 0.05),
            (late_arm({"servo_lag_s": 0.03}), 0.03),
            (late_arm({"dead_time_s": 0.05, "assumed_lag_s": 0.02}), 0.03),
        ),
    ],
)
def test_an_unknown_delay_costs_speed_times_delay(late: tuple[dict[str, object], float], tmp_path: Path) -> None:
    change, delay = late
    log = heard(write_scenario(tmp_path, IDEAL, change)).log
    velocity = BASE_FROM_REST[:3, :3] @ (VELOCITY + [SPEED, 0, 0])  # the surface's and, on it, the path's own
    off = difference(log)[inner(log)]
    assert len(off) > 800
    slack = 0.01 * abs(delay) + EARLY
    assert np.linalg.norm(off + velocity * delay, axis=1).max() < slack * np.linalg.norm(velocity)


@pytest.mark.parametrize(
    "change",
    [
        {"arm": {"dead_time_s": 0.05, "servo_lag_s": 0.02, "wire_baud": 115200, "assumed_lag_s": 0.07 + 480 / 115200}},
        *slowly({"cameras": {"transport_s": 0.08}, "tracking": {"processing_s": 0.05}}),
        {"cameras": {"exposure_s": 0.016}},
        {"cameras": {"phase_s": [0.0, 0.004, 0.008]}},
    ],
    ids=["arm", "transport and processing", "exposure", "shutters"],
)
def test_what_the_loop_knows_of_costs_nothing_at_constant_speed(change: dict[str, object], tmp_path: Path) -> None:
    log = heard(write_scenario(tmp_path, IDEAL, change, motion=[STEADY], seconds=5.0)).log
    assert np.linalg.norm(difference(log)[inner(log)], axis=1).max() < 0.007


@pytest.mark.parametrize("offset", [0.016, *slowly(-0.016)])
def test_a_hidden_clock_offset_costs_the_speed_of_the_surface_alone(offset: float, tmp_path: Path) -> None:
    cameras = {"offset_s": [offset] * 3, "transport_s": 0.03}  # no pose may come before its stamp
    log = heard(write_scenario(tmp_path, IDEAL, {"cameras": cameras}, motion=[STEADY], seconds=2.2)).log
    wanted = BASE_FROM_REST[:3, :3] @ VELOCITY * offset  # what is stamped t was seen at t + offset
    off = difference(log)[inner(log)]
    early = EARLY * np.linalg.norm(VELOCITY + [SPEED, 0, 0])
    assert np.linalg.norm(off - wanted, axis=1).max() < 0.01 * np.linalg.norm(wanted) + early


@pytest.mark.slow
@pytest.mark.parametrize("planted", ["rig_offset_mm", "arm_offset_mm"])
@pytest.mark.parametrize("motion", [[STEADY], *slowly([])], ids=["moving", "still"])
def test_a_planted_offset_comes_out_as_that_offset(planted: str, motion: list[object], tmp_path: Path) -> None:
    offset = [0.2, -0.1, 0.3]
    file = write_scenario(tmp_path, IDEAL, planted={planted: offset}, motion=motion, seconds=2.5)
    log = heard(file).log
    early = EARLY * np.linalg.norm((VELOCITY if motion else np.zeros(3)) + [SPEED, 0, 0])
    assert np.abs(difference(log)[inner(log)] - offset).max() < 1e-3 + early


def test_the_lag_that_is_reported_is_the_one_that_was_planted(tmp_path: Path) -> None:
    sine = {"kind": "sine", "rate_hz": 0.8, "amplitude_mm": 1.5, "direction": [0, 1, 0]}
    usual, late = (
        nozzle_lag(heard(write_scenario(tmp_path, IDEAL, {"arm": arm}, motion=[sine], seconds=2.5)).log).seconds
        for arm in ({}, {"dead_time_s": 0.06})
    )
    assert late - usual == pytest.approx(0.06, abs=0.001)
    assert abs(usual) < 0.004


def test_where_skin_stretches_a_rigid_pose_is_off_by_the_displacement(tmp_path: Path) -> None:
    deformation = Deformation((0.05, 0.02), bulge=0.4)
    strain = {"kind": "steps", "every_s": 50, "start_s": 0.0, "rise_s": 0.01}  # amount 1 from then on
    scenario = read_scenario(write_scenario(tmp_path, IDEAL, strain=strain, seconds=2.5))
    world_of(scenario, sink := Heard(), deformation=deformation).run()
    log = sink.log
    x = log.place - 4.0  # of the line from -4 to 4
    moved = deformation.displacement(np.column_stack([x, 0 * x, 0 * x]), 1.0) @ BASE_FROM_REST[:3, :3].T
    assert np.abs(difference(log) + moved)[inner(log)].max() < 0.005


def test_rows_lie_on_every_millisecond_until_the_very_end(tmp_path: Path) -> None:
    for seconds in (1.873, 0.1, 1.0005):
        log = heard(write_scenario(tmp_path, IDEAL, seconds=seconds)).log
        assert np.allclose(log.stamps, np.arange(1, len(log) + 1) / 1000, rtol=0, atol=1e-12)
        assert len(log) == int(seconds * 1000)


def test_a_run_ends_soon_after_the_path(tmp_path: Path) -> None:
    sink = heard(write_scenario(tmp_path, IDEAL, seconds=30.0))
    phases = zip(sink.commands, sink.progress, strict=True)
    finished = next(command.stamp for command, p in phases if p.phase is PrintPhase.FINISHED)
    assert sink.log.stamps[-1] == pytest.approx(finished + FINISH_TAIL, abs=1.1e-3)
    assert "path finished" in sink.reasons
    assert sink.log.place[-1] == pytest.approx(8.0) and not sink.log.extrude[sink.log.stamps > finished].any()


def test_the_same_scenario_is_the_same_run_and_another_seed_is_not(tmp_path: Path) -> None:
    chance = {"kind": "tremor", "rms_mm": [0.1, 0.1, 0.1]}
    runs = []
    for seed in (4, 4, 5):
        sink = heard(write_scenario(tmp_path, IDEAL, motion=[chance], seed=seed, seconds=1.0))
        runs.append((sink.sent, *(getattr(sink.log, name).tobytes() for name in NozzleLog.__slots__)))
    assert runs[0] == runs[1] and runs[0][0] != runs[2][0]
    assert runs[0][1] == runs[2][1]  # but for the stamps


def test_a_pose_is_known_no_sooner_than_exposure_transport_and_processing_allow(tmp_path: Path) -> None:
    cameras = {"start_s": 0.1, "exposure_s": 0.01, "transport_s": 0.1}
    sink = heard(write_scenario(tmp_path, IDEAL, {"cameras": cameras, "tracking": {"processing_s": 0.033}}))
    known = 0.1 + 0.005 + 0.1 + 0.033
    assert known <= sink.commands[0].stamp < known + 0.02
    assert np.diff([c.stamp for c in sink.commands]).mean() == pytest.approx(0.02, rel=EASE_RANGE[1])
    assert set(sink.log.reason[sink.log.stamps <= sink.commands[0].stamp]) == {"no surface is followed yet"}


def test_a_slow_tracker_takes_the_newest_frame_set_and_the_rest_is_counted(tmp_path: Path) -> None:
    change = {"cameras": {"fps": 50.0, "transport_s": 0.003}, "tracking": {"processing_s": 0.07}}
    world = world_of(read_scenario(write_scenario(tmp_path, IDEAL, change)), sink := Heard())
    world.run()
    taken = np.array([frames.stamp for frames in sink.frames])
    exposed = 0.1 + np.arange(95) / 50
    start = taken[0] + 0.003
    for stamp in taken[1:]:
        start += 0.07
        assert stamp == pytest.approx(exposed[exposed + 0.003 <= start + 1e-9][-1])
    assert world.pipeline.tracked == len(taken) == 28
    assert 28 + world.pipeline.skipped == pytest.approx(95, abs=2)  # what waits at the end is neither


def test_a_frame_set_that_is_left_out_has_a_print_head_all_the_same(tmp_path: Path) -> None:
    change = {"cameras": {"fps": 50.0, "transport_s": 0.003}, "tracking": {"processing_s": 0.07}}
    scenario = read_scenario(write_scenario(tmp_path, IDEAL, change))
    world_of(replace(scenario, nozzle=True), sink := Heard()).run()
    told = np.array([stamp for stamp, _ in sink.heads])
    assert np.diff(told) == pytest.approx(0.02)  # one by one, while the tracker takes every fourth
    with_head = [frames for frames in sink.frames if frames.head is not None]
    assert len(with_head) > 20
    assert {frames.stamp for frames in with_head} < set(told)


def test_measured_processing_times_come_from_the_clock(tmp_path: Path) -> None:
    scenario = read_scenario(write_scenario(tmp_path, IDEAL, {"tracking": {"processing_s": "measured"}}))
    assert scenario.tracking.processing is None
    world_of(scenario, sink := Heard()).run()  # on a clock that stands still, processing takes no time
    assert sink.sent == heard(write_scenario(tmp_path, IDEAL)).sent


def test_the_line_carries_every_frame_to_the_arm(tmp_path: Path) -> None:
    world = world_of(read_scenario(write_scenario(tmp_path, IDEAL)), sink := Heard())
    world.run()
    sent = [sink.sent[i : i + 48] for i in range(0, len(sink.sent), 48)]
    others = iter(sent)
    assert all(tick.frame in others for tick in sink.ticks if tick.frame)  # in their order
    assert world.arm.frames == len(sent) > 80 and sent[-1] == encode(Pause())  # it is stopped at the end


def test_what_the_arm_answers_reaches_the_sink(tmp_path: Path) -> None:
    sink = heard(write_scenario(tmp_path, IDEAL, {"arm": {"replies": "stream", "reply_period_s": 0.05}}))
    assert len(sink.received) == pytest.approx(27 * 2.1 / 0.05, abs=27 * 3)


def with_faults(folder: Path, *faults: str) -> tuple[Heard, NozzleLog]:
    sink = heard(write_scenario(folder, IDEAL, faults=list(faults), seconds=3.0))
    return sink, sink.log


def worked_off(since: Array) -> Array:
    """By how much less late, s, an arm is some time after a fault, s: moves leave a fiftieth of each tick free."""
    return np.asarray((1 / TICK_FRACTION - 1) * since)


def test_an_arm_that_stalls_is_late_by_as_much_and_works_it_off(tmp_path: Path) -> None:
    _, log = with_faults(tmp_path, "arm stall 300ms at 1s")
    distance = np.linalg.norm(difference(log), axis=1)
    steady = inner(log)
    assert distance[steady & (log.stamps < 1.0)].max() < 0.005
    after = steady & (log.stamps > 1.35)
    assert distance[after] == pytest.approx((0.3 - worked_off(log.stamps[after] - 1.3)) * SPEED, rel=0.01)


def test_a_slow_arm_falls_behind(tmp_path: Path) -> None:
    _, log = with_faults(tmp_path, "arm slow 50% at 1s for 0.4s")
    distance = np.linalg.norm(difference(log), axis=1)
    after = inner(log) & (log.stamps > 1.45)
    late = 0.4 - 0.5 * 0.4 / TICK_FRACTION - worked_off(log.stamps[after] - 1.4)
    assert distance[after] == pytest.approx(late * SPEED, rel=0.02)


def test_a_lost_frame_is_an_error_for_a_moment(tmp_path: Path) -> None:
    sink, log = with_faults(tmp_path, "arm drop at 1s")
    distance = np.linalg.norm(difference(log), axis=1)
    late = log.stamps[inner(log) & (distance > 0.05)]
    assert 1.0 <= late[0] < 1.1
    assert 0.05 < distance[inner(log)].max() < 0.25  # a tick of 5 mm/s is 0.1 mm
    assert all(len(tick.frame) == 48 for tick in sink.ticks[1:])  # the link cannot know


def test_a_garbled_frame_does_not_end_the_run(tmp_path: Path) -> None:
    for seed in range(2):
        change = {"arm": {"seed": seed}}
        sink = heard(write_scenario(tmp_path, IDEAL, change, faults=["arm garble at 1s"], seconds=2.0))
        assert len(sink.log) == 2000


def test_an_arm_that_is_unplugged_stands_and_its_target_goes_on(tmp_path: Path) -> None:
    _, log = with_faults(tmp_path, "arm unplug at 1s")
    after = log.stamps > 1.05
    assert np.ptp(log.base_from_nozzle[after, :3, 3], axis=0).max() < 1e-9
    assert np.linalg.norm(difference(log), axis=1)[log.extrude][-1] > 3.0


def test_without_a_new_pose_the_arm_holds_and_says_why(tmp_path: Path) -> None:
    names = ["cam_0", "cam_1", "cam_2"]
    off = {"cameras": {"off": [[name, 0.9, 1.5] for name in names]}}
    sink = heard(write_scenario(tmp_path, IDEAL, off, motion=[STEADY], seconds=3.5))
    log = sink.log
    held = (log.stamps > 1.35) & (log.stamps < 1.5)
    assert all("old, limit 0.3 s" in reason for reason in log.reason[held]) and not log.extrude[held].any()
    assert log.extrude[log.stamps > 1.8].any()
    assert sink.progress[-1].place == pytest.approx(8.0)  # nothing is left out


def test_one_camera_is_enough_for_frame_sets_to_go_on(tmp_path: Path) -> None:
    off = {"cameras": {"off": [["cam_0", 0.6, 9.0], ["cam_2", 0.9, 9.0]]}}
    sink = heard(write_scenario(tmp_path, IDEAL, off))
    seen = {tuple(f.camera for f in frames.frames) for frames in sink.frames}
    assert seen == {(0, 1, 2), (1, 2), (1,)}
    stamps = [frames.stamp for frames in sink.frames]
    assert np.diff(stamps).max() < 0.021


def test_lost_and_repeated_frames_change_sets_and_do_not_end_the_run(tmp_path: Path) -> None:
    sink = heard(write_scenario(tmp_path, IDEAL, {"cameras": {"drop": 0.2, "duplicate": 0.2}}, motion=[STEADY]))
    assert {len(frames.frames) for frames in sink.frames} == {1, 2, 3}
    assert sink.log.extrude.any()


def test_cut_short_the_rows_until_then_are_given_out(tmp_path: Path) -> None:
    world = world_of(read_scenario(write_scenario(tmp_path, IDEAL)), sink := Heard())

    def interrupt(done: int, total: int) -> None:
        assert total == 100
        if done == 33:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        world.run(interrupt)
    assert len(sink.frames) == 33 and sink.log.stamps[-1] == pytest.approx(sink.frames[-1].stamp, abs=0.021)
    assert np.allclose(np.diff(sink.log.stamps), 0.001)


def test_cut_short_within_a_tick_the_rows_until_then_are_given_out(tmp_path: Path) -> None:
    class Interrupting(Heard):
        def tick(self, tick: Tick, progress: PrintProgress | None) -> None:
            if len(self.commands) == 40:
                raise KeyboardInterrupt
            super().tick(tick, progress)

    scenario = replace(read_scenario(write_scenario(tmp_path, IDEAL)), seconds=2.0)
    world = world_of(scenario, sink := Interrupting())
    with pytest.raises(KeyboardInterrupt):
        world.run()
    assert sink.log.stamps[-1] == pytest.approx(sink.commands[-1].stamp + 0.02, abs=1.1e-3)


def test_an_arm_that_only_turns_keeps_pace(tmp_path: Path) -> None:
    """Its controller reads F of such a move as degrees a minute."""
    rows = ["0,0,0,0,0,0,5,1,20,0,0", "0,0,0,20,0,0,2,1,20,0,1", "3,0,0,20,0,0,2,1,20,0,1"]
    (tmp_path / "path.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    file = write_scenario(tmp_path, IDEAL, seconds=5.0)
    world = world_of(read_scenario(file), sink := Heard())
    world.run()
    assert world.arm.in_flight <= 0.021
    log = sink.log
    assert np.rad2deg(errors(file, log).angle[inner(log)].max()) < 0.5
    assert errors(file, log).distance[inner(log)].max() < 0.06
