"""The laws of the error at the nozzle and of the deposited material: none for a perfect run, known for known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.se3 import Array
from hardware.simulator.deposit import (
    MAP_REACH,
    DepositFigures,
    DepositMap,
    NozzleLog,
    deposit_figures,
    deposit_map,
    join_logs,
    planned_line,
)
from hardware.simulator.nozzle_error import (
    MAX_LAG,
    NozzleFigures,
    RowErrors,
    group_holds,
    hold_spans,
    nozzle_errors,
    nozzle_figures,
    nozzle_lag,
)
from planning.path import Path
from tests.moving_surfaces import raster
from tests.nozzle_logs import breathing, dry, held, needed, nozzle_log, part, sliding, straight, through, without_target

FEW = settings(max_examples=10)
vectors = st.tuples(*[st.floats(-2, 2)] * 3).map(np.array)


def judged(log: NozzleLog, path: Path) -> tuple[RowErrors, NozzleFigures]:
    line = planned_line(path)
    errors = nozzle_errors(log, line)
    return errors, nozzle_figures(log, line, errors)


def test_a_perfect_run_has_no_error_and_full_duty() -> None:
    path = raster()
    _, figures = judged(nozzle_log(path, breathing), path)
    for spread in (figures.position, figures.along, figures.across, figures.normal, figures.path, figures.angle):
        assert spread.max < 1e-6
    assert (figures.duty, figures.near, figures.finished) == (1.0, 1.0, True)
    assert figures.holds == () and abs(figures.lag.seconds) < 1e-4


@FEW
@given(vectors)
def test_a_known_offset_comes_out_as_itself(offset: Array) -> None:
    path = raster()
    errors, figures = judged(nozzle_log(path, breathing, offset=offset), path)
    assert np.allclose(errors.vector, offset, atol=1e-9)
    assert np.allclose(figures.offset, offset, atol=1e-9)
    assert figures.position.rmse == pytest.approx(np.linalg.norm(offset), abs=1e-9)
    assert figures.position.median == pytest.approx(figures.position.max, abs=1e-9)


@FEW
@given(vectors, st.integers(0, 10_000))
def test_the_parts_of_the_error_are_the_whole_on_any_surface_and_path(offset: Array, seed: int) -> None:
    draw = np.random.default_rng(seed)
    tilted = se3.exp(np.concatenate([draw.normal(size=(6, 3)) * 0.3, draw.normal(size=(6, 3)) * 10], axis=1))
    path = replace(raster(), surface_from_nozzle=tilted)
    errors, _ = judged(nozzle_log(path, breathing, offset=offset, seconds=1.0), path)
    assert np.allclose(np.linalg.norm(errors.split, axis=1), errors.distance, atol=1e-9)


def test_ahead_left_and_up_are_positive() -> None:
    path = straight()
    for i, offset in enumerate(np.eye(3)):
        errors, _ = judged(nozzle_log(path, breathing, offset=offset), path)
        assert np.allclose(errors.split, np.eye(3)[i], atol=1e-9)


@FEW
@given(st.floats(1e-7, 1.0), st.floats(0, 6.28))
def test_a_tilt_of_the_nozzle_is_the_angle_and_a_turn_about_its_axis_is_none(tilt: float, about: float) -> None:
    path = straight()
    turn = tilt * np.array([np.cos(about), np.sin(about), 0])
    errors, _ = judged(nozzle_log(path, breathing, turn=turn, seconds=0.1), path)
    assert np.allclose(errors.angle, tilt, rtol=1e-6, atol=1e-10)
    errors, _ = judged(nozzle_log(path, breathing, turn=np.array([0, 0, tilt]), seconds=0.1), path)
    assert errors.angle.max() < 1e-9


@FEW
@given(st.floats(0.002, 0.2), vectors.filter(lambda v: np.linalg.norm(v) > 0.3))
def test_a_known_delay_of_a_surface_at_constant_speed_is_speed_times_delay(delay: float, direction: Array) -> None:
    velocity = 10 * direction
    path = straight(length=10.0, speed=2.0)
    _, figures = judged(part(nozzle_log(path, sliding(velocity), delay), slice(300, None)), path)
    relative = np.linalg.norm(velocity + [2.0, 0, 0])
    if relative > 2:
        assert figures.position.rmse == pytest.approx(relative * delay, rel=0.01)
        assert figures.lag.seconds == pytest.approx(delay, abs=1e-4)


@FEW
@given(st.floats(-0.2, 0.2))
def test_a_known_delay_of_a_breathing_surface_is_the_lag(delay: float) -> None:
    path = straight(length=30.0)
    figures = judged(part(nozzle_log(path, breathing, delay), slice(300, 5700)), path)[1]
    assert figures.lag.seconds == pytest.approx(delay, abs=1e-4)


def test_noise_does_not_move_the_lag_much() -> None:
    log = nozzle_log(straight(length=30.0), breathing, 0.0304)
    log.base_from_nozzle[:, :3, 3] += np.random.default_rng(3).normal(size=(len(log), 3)) * 0.05
    assert nozzle_lag(log).seconds == pytest.approx(0.0304, abs=1e-3)


def test_the_lag_of_what_hardly_moves_or_is_too_late_cannot_be_told() -> None:
    slow, quick = straight(length=5.0, speed=0.9), straight(length=30.0)
    assert np.isnan(nozzle_lag(nozzle_log(slow)).seconds)
    assert np.isfinite(nozzle_lag(nozzle_log(straight(length=5.0, speed=1.1))).seconds)
    assert np.isnan(nozzle_lag(part(nozzle_log(quick, delay=MAX_LAG + 0.05), slice(400, None))).seconds)
    assert np.isnan(nozzle_lag(nozzle_log(quick, seconds=2 * MAX_LAG - 0.01)).seconds)


def test_the_lag_is_not_measured_across_a_gap() -> None:
    path = straight(length=30.0)
    log = nozzle_log(path, breathing, 0.03)
    pieces = [part(log, slice(a, a + 450)) for a in range(0, 5000, 1000)]
    assert np.isnan(nozzle_lag(join_logs(pieces)).seconds)
    assert np.isnan(nozzle_lag(without_target(part(log, slice(0, 900)), slice(450, 451))).seconds)


@FEW
@given(st.integers(0, 10_000))
def test_the_distance_to_the_line_is_that_of_the_nearest_of_many_points_on_it(seed: int) -> None:
    draw = np.random.default_rng(seed)
    path = through(draw.normal(size=(7, 3)) * 10, extrude=np.array([0, 1, 0, 1, 1, 0, 1], bool))
    points = draw.normal(size=(40, 3)) * 15
    corners = path.surface_from_nozzle[:, :3, 3]
    share = np.linspace(0, 1, 2001)[:, None]
    ends = [i for i in np.flatnonzero(path.extrude) if i]
    dense = np.concatenate([(1 - share) * corners[i - 1] + share * corners[i] for i in ends])
    expected = np.linalg.norm(points[:, None] - dense, axis=2).min(axis=1)
    assert np.allclose(planned_line(path).distance(points), expected, atol=1e-3)


def test_being_late_is_no_distance_from_the_line() -> None:
    path = straight()
    _, figures = judged(part(nozzle_log(path, delay=0.1), slice(200, None)), path)
    assert figures.position.rmse == pytest.approx(0.5, abs=1e-6)
    assert figures.along.rmse == pytest.approx(0.5, abs=1e-6) and figures.path.max < 1e-9


def test_what_prints_nothing_has_no_figures() -> None:
    path = straight()
    log, bare = nozzle_log(path), replace(path, extrude=np.zeros(len(path), bool))
    none = judged(nozzle_log(bare), bare)[1]
    assert np.isnan([none.path.max, none.duty, none.position.max, none.near]).all()
    assert np.isnan(laid(nozzle_log(bare), bare)[1].coverage)
    empty = judged(part(log, slice(0, 0)), path)[1]
    assert np.isnan([empty.duty, empty.position.max, empty.lag.seconds]).all()
    dry(log, slice(None))
    nothing, gap = judged(log, path)[1], laid(log, path)[1]
    assert nothing.duty == 0.0 and np.isnan(nothing.position.rmse)
    assert (gap.coverage, gap.gaps, gap.outside, gap.material) == (0, 1, 0, 0)


def test_a_turn_on_the_spot_has_the_direction_of_the_piece_before() -> None:
    poses = se3.make(np.eye(3), np.array([[0.0, 0, 0], [0, 4, 0], [0, 4, 0], [3, 4, 0]]))
    poses[2:, :3, :3] = se3.exp_rotation([0, 0, 0.5])
    line = planned_line(replace(through(np.zeros((4, 3))), surface_from_nozzle=poses))
    assert np.allclose(line.direction(), [[0, 1, 0], [0, 1, 0], [1, 0, 0]])
    assert line.knots.tolist() == pytest.approx([0, 4, 9, 12])


def test_a_checkpoint_belongs_to_the_piece_that_leads_to_it() -> None:
    line = planned_line(through(np.array([[0.0, 0, 0], [2, 0, 0], [5, 0, 0]])))
    assert line.piece(np.array([-1.0, 0.0, 1e-9, 2.0, 2.0 + 1e-9, 5.0, 9.0])).tolist() == [0, 0, 0, 0, 1, 1, 1]


def test_a_hold_costs_duty_to_the_end_of_the_path_or_of_the_run() -> None:
    path = straight(length=20.0, speed=5.0)
    log = nozzle_log(path, breathing, seconds=8.0, reasons=held(1.0, 2.0))
    dry(log, slice(5000, None))  # the path is finished after 5 s
    log.reason[5001:] = "path finished"[: log.reason.itemsize // 4]
    _, figures = judged(log, path)
    assert figures.finished and figures.duty == pytest.approx(0.8, abs=1e-3)
    assert figures.extruding == pytest.approx(4.0, abs=2e-3)
    assert figures.printing == pytest.approx(5.0, abs=2e-2)
    assert [(h.reason, h.count) for h in figures.holds] == [("surface is LOST", 1)]
    assert figures.holds[0].seconds == pytest.approx(1.0) and figures.holds[0].first == pytest.approx(1.0)
    _, figures = judged(nozzle_log(path, seconds=4.0, reasons=held(1.0, 99.0)), path)
    assert not figures.finished and figures.duty == pytest.approx(0.25, abs=1e-3)


def test_travel_and_the_way_there_are_not_part_of_duty() -> None:
    corners = np.array([[0.0, 0, 0], [5, 0, 0], [5, 5, 0], [0, 5, 0]])
    path = through(corners, extrude=np.array([True, True, False, True]))
    log = nozzle_log(path)
    way = without_target(replace(log, extrude=np.zeros(len(log), bool)), slice(None))
    _, figures = judged(join_logs([replace(way, stamps=way.stamps - 10), log]), path)
    assert figures.duty == 1.0 and figures.printing == pytest.approx(2.0, abs=2e-3)


def test_a_place_that_is_not_known_is_the_last_one_that_was() -> None:
    corners = np.array([[0.0, 0, 0], [5, 0, 0], [5, 5, 0], [0, 5, 0]])
    path = through(corners, extrude=np.array([True, True, False, True]))
    log = nozzle_log(path)
    travelling = without_target(log, slice(1500, 1600))  # 1 to 2 s is travel
    assert judged(travelling, path)[1].duty == 1.0
    printing = without_target(log, slice(500, 600))
    dry(printing, slice(500, 600))
    assert judged(printing, path)[1].duty == pytest.approx(0.95, abs=1e-3)


def test_the_share_near_ends_at_half_a_millimetre_and_where_there_is_no_target() -> None:
    path = straight()
    for off, near in ((0.5 - 1e-9, 1.0), (0.5 + 1e-9, 0.0)):
        assert judged(nozzle_log(path, offset=np.array([0, off, 0])), path)[1].near == near
    log = without_target(nozzle_log(path), slice(1000, 1100))
    _, figures = judged(log, path)
    assert figures.without_target == pytest.approx(0.1) and figures.near == pytest.approx(1 - 100 / len(log))
    assert figures.position.max < 1e-9


def test_a_reason_whose_numbers_change_is_one_hold_and_a_gap_in_the_stamps_ends_it() -> None:
    reasons = ["", *["pose is 0.181 s old"] * 2, "pose is 0.201 s old", "", "LOST", "no pose"]
    spans = hold_spans(np.arange(len(reasons)) * 0.001, np.array(reasons), 0.001)
    assert [span.reason for span in spans] == ["pose is 0.181 s old", "LOST", "no pose"]
    assert [span.start for span in spans] == pytest.approx([0.001, 0.005, 0.006])
    assert [span.end for span in spans] == pytest.approx([0.004, 0.006, 0.007])
    stamps = np.array([0.0, 0.001, 0.5, 0.501])
    assert len(hold_spans(stamps, np.array(["a"] * 4), 0.001)) == 2
    assert hold_spans(stamps[:0], np.array([], "U1"), 0.001) == []


def test_holds_of_one_kind_keep_the_numbers_they_share() -> None:
    texts = ["", "cam2: -0.301 s old, limit 0.18 s", "", "cam2: 0.302 s old, limit 0.18 s", "cam3: 1 s old, limit 2 s"]
    found = group_holds(hold_spans(np.arange(5) * 0.001, np.array(texts), 0.001))
    assert [(h.reason, h.count) for h in found] == [("cam2: … s old, limit 0.18 s", 2), (texts[-1], 1)]
    assert found[0].longest == pytest.approx(0.001)


BEAD = 0.8


def laid(log: NozzleLog, path: Path, bead: float = BEAD) -> tuple[DepositMap, DepositFigures]:
    found = deposit_map(log, planned_line(path), bead)
    return found, deposit_figures(found)


@FEW
@given(st.integers(0, 10_000), st.floats(0.2, 2.0), st.floats(1.0, 30.0))
def test_what_is_laid_as_planned_is_the_plan_on_any_path_at_any_speed(seed: int, bead: float, speed: float) -> None:
    path = through(np.random.default_rng(seed).normal(size=(6, 3)) * 5, speed)
    _, figures = laid(nozzle_log(path, breathing), path, bead)
    assert figures.coverage == pytest.approx(1, abs=0.01)
    assert (figures.gaps, figures.overlap) == (0, 0)
    assert figures.outside == pytest.approx(0, abs=0.01) and figures.material == pytest.approx(1, abs=0.01)


def test_a_straight_bead_is_one_thick_over_its_whole_width() -> None:
    found, figures = laid(nozzle_log(straight()), straight())
    across = found.planned[0][:, found.planned.shape[2] // 2]
    middle = (np.arange(len(across)) + 0.5) * found.cell + found.low[1]
    assert across[np.abs(middle) < BEAD / 2 - found.cell] == pytest.approx(1, abs=0.05)
    assert across[np.abs(middle) > BEAD / 2 + 1.5 * found.cell] == pytest.approx(0, abs=1e-9)
    assert across.sum() * found.cell == pytest.approx(BEAD, rel=1e-6)
    assert figures.area == pytest.approx(20 * BEAD, rel=0.02)


@FEW
@given(st.floats(-0.6, 0.6), st.floats(0, 6.28))
def test_a_shift_across_lies_outside_by_shift_times_length(shift: float, heading: float) -> None:
    turn = se3.exp_rotation([0, 0, heading])
    path = through(np.array([[-10.0, 0, 0], [10, 0, 0]]) @ turn.T)
    found, figures = laid(nozzle_log(path, breathing, offset=turn @ [0, shift, 0]), path)
    assert figures.outside * figures.area == pytest.approx(20 * abs(shift), abs=20 * found.cell / 6)  # the edges' blur
    assert figures.coverage == pytest.approx(1 - abs(shift) / BEAD, abs=0.02)
    assert figures.material == pytest.approx(1, abs=1e-3)
    assert figures.gaps == pytest.approx(abs(shift) / BEAD, abs=0.14)  # by whole cells: an eighth of the bead


def test_a_piece_that_was_left_out_is_a_gap() -> None:
    path = straight()
    log = nozzle_log(path)
    dry(log, slice(1000, 2000))  # a quarter
    _, figures = laid(log, path)
    assert figures.gaps == pytest.approx(0.25, abs=0.03) and figures.coverage == pytest.approx(0.75, abs=0.01)
    assert figures.material == pytest.approx(0.75, abs=0.001)
    assert (figures.overlap, figures.outside) == (0, pytest.approx(0, abs=0.01))


def test_a_piece_that_was_laid_twice_is_an_overlap() -> None:
    path = straight()
    log = nozzle_log(path)
    again = part(log, slice(1000, 2001))
    _, figures = laid(join_logs([log, replace(again, stamps=again.stamps + 10)]), path)
    assert figures.overlap == pytest.approx(0.25, abs=0.03)
    assert figures.material == pytest.approx(1.25, abs=0.001)
    assert (figures.gaps, figures.outside) == (0, pytest.approx(0, abs=0.05))  # its blurred edge is wider


def test_a_nozzle_that_waits_lays_nothing_and_a_gap_in_the_stamps_neither() -> None:
    path = straight()
    log = nozzle_log(path, seconds=5.0, reasons=held(1.0, 2.0))
    log.extrude[:] = True
    log.flow[:] = needed(log.place, log.stamps)
    assert laid(log, path)[1].material == pytest.approx(1, abs=1e-3)
    ends = join_logs([part(log, slice(0, 501)), part(log, slice(4500, None))])
    assert laid(ends, path)[1].material == pytest.approx(0.25, abs=0.001)


def test_material_follows_the_path_and_not_the_nozzle() -> None:
    path = straight()
    log = nozzle_log(path)
    log.surface_from_tip[:, 0] *= 0.5  # the same bead on half of the length
    _, figures = laid(log, path)
    assert figures.material == pytest.approx(1, abs=1e-3) and figures.coverage == pytest.approx(0.5, abs=0.03)
    assert figures.overlap == pytest.approx(0.5, abs=0.03)


def test_each_layer_is_held_against_its_own_plan() -> None:
    corners = np.array([[-5.0, 0, 0], [5, 0, 0], [5, 0, 1], [-5, 0, 1]])
    path = through(corners, layer=np.array([0, 0, 1, 1]))
    log = nozzle_log(path)
    found, figures = laid(log, path)
    assert found.layers.tolist() == [0, 1]
    assert (figures.gaps, figures.overlap) == (0, 0)
    dry(log, log.place > 10.5)  # nothing of the second
    assert laid(log, path)[1].gaps == pytest.approx(0.5, abs=0.02)


def test_travel_is_not_planned_and_what_is_laid_on_it_is_outside() -> None:
    corners = np.array([[-5.0, 0, 0], [5, 0, 0], [5, 5, 0], [-5, 5, 0]])
    path = through(corners, extrude=np.array([True, True, False, True]))
    log = nozzle_log(path)
    assert laid(log, path)[1].outside == pytest.approx(0, abs=0.01)
    log.extrude[:] = True
    log.flow[:] = needed(log.place, log.stamps)
    assert laid(log, path)[1].outside == pytest.approx(5 / 20, abs=0.05)


def test_a_slope_is_no_thicker_than_the_flat() -> None:
    path = through(np.array([[-5.0, 0, 0], [5, 0, 10]]))
    found, figures = laid(nozzle_log(path), path)
    assert found.planned.max() == pytest.approx(1, abs=0.05)
    assert figures.coverage == pytest.approx(1, abs=0.01)


def test_material_far_away_does_not_make_the_map_endless() -> None:
    path = straight()
    found, figures = laid(nozzle_log(path, offset=np.array([0, 5000.0, 0])), path)
    assert found.planned.shape[1] * found.cell < MAP_REACH + 2
    assert (figures.coverage, figures.gaps) == (0, 1)
