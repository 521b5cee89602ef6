"""The laws of the deposited material: the plan laid is the plan, and what is off is off by its own area."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from hardware.simulator.deposit import FAR, DepositFigures, DepositMap, deposit_figures, deposit_map
from hardware.simulator.nozzle_log import NozzleLog, joined
from hardware.simulator.planned_line import planned_line
from planning.path import Path
from tests.moving import raster
from tests.nozzle_logs import breathing, held, nozzle_log, part, straight, through

FEW = settings(max_examples=10, deadline=None)
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
    assert figures.outside == pytest.approx(0, abs=0.01)
    assert figures.material == pytest.approx(1, abs=0.01)


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
    log.extrude[1000:2000] = False  # a quarter
    _, figures = laid(log, path)
    assert figures.gaps == pytest.approx(0.25, abs=0.03)
    assert figures.coverage == pytest.approx(0.75, abs=0.01)
    assert figures.material == pytest.approx(0.75, abs=0.001)
    assert (figures.overlap, figures.outside) == (0, pytest.approx(0, abs=0.01))


def test_a_piece_that_was_laid_twice_is_an_overlap() -> None:
    path = straight()
    log = nozzle_log(path)
    again = part(log, slice(1000, 2001))
    _, figures = laid(joined([log, replace(again, stamps=again.stamps + 10)]), path)
    assert figures.overlap == pytest.approx(0.25, abs=0.03)
    assert figures.material == pytest.approx(1.25, abs=0.001)
    assert (figures.gaps, figures.outside) == (0, pytest.approx(0, abs=0.05))  # its blurred edge is wider


def test_a_nozzle_that_waits_lays_nothing_and_a_gap_in_the_stamps_neither() -> None:
    path = straight()
    log = nozzle_log(path, seconds=5.0, reasons=held(1.0, 2.0))
    log.extrude[:] = True
    assert laid(log, path)[1].material == pytest.approx(1, abs=1e-3)
    ends = joined([part(log, slice(0, 501)), part(log, slice(4500, None))])
    assert laid(ends, path)[1].material == pytest.approx(0.25, abs=0.001)


def test_material_follows_the_path_and_not_the_nozzle() -> None:
    path = straight()
    log = nozzle_log(path)
    log.surface_from_tip[:, 0] *= 0.5  # the same bead on half of the length
    _, figures = laid(log, path)
    assert figures.material == pytest.approx(1, abs=1e-3)
    assert figures.coverage == pytest.approx(0.5, abs=0.03)
    assert figures.overlap == pytest.approx(0.5, abs=0.03)


def test_each_layer_is_held_against_its_own_plan() -> None:
    corners = np.array([[-5.0, 0, 0], [5, 0, 0], [5, 0, 1], [-5, 0, 1]])
    path = through(corners, layer=np.array([0, 0, 1, 1]))
    log = nozzle_log(path)
    found, figures = laid(log, path)
    assert found.layers.tolist() == [0, 1]
    assert (figures.gaps, figures.overlap) == (0, 0)
    log.extrude[log.place > 10.5] = False  # nothing of the second
    assert laid(log, path)[1].gaps == pytest.approx(0.5, abs=0.02)


def test_travel_is_not_planned_and_what_is_laid_on_it_is_outside() -> None:
    corners = np.array([[-5.0, 0, 0], [5, 0, 0], [5, 5, 0], [-5, 5, 0]])
    path = through(corners, extrude=np.array([True, True, False, True]))
    log = nozzle_log(path)
    assert laid(log, path)[1].outside == pytest.approx(0, abs=0.01)
    log.extrude[:] = True
    assert laid(log, path)[1].outside == pytest.approx(5 / 20, abs=0.05)


def test_a_slope_is_no_thicker_than_the_flat() -> None:
    path = through(np.array([[-5.0, 0, 0], [5, 0, 10]]))
    found, figures = laid(nozzle_log(path), path)
    assert found.planned.max() == pytest.approx(1, abs=0.05)
    assert figures.coverage == pytest.approx(1, abs=0.01)


def test_material_far_away_does_not_make_the_map_endless() -> None:
    path = straight()
    found, figures = laid(nozzle_log(path, offset=np.array([0, 5000.0, 0])), path)
    assert found.planned.shape[1] * found.cell < FAR + 2
    assert (figures.coverage, figures.gaps) == (0, 1)


def test_nothing_laid_is_all_gap_and_nothing_planned_has_no_figures() -> None:
    path = raster()
    log = nozzle_log(path)
    log.extrude[:] = False
    _, figures = laid(log, path)
    assert (figures.coverage, figures.gaps, figures.outside, figures.material) == (0, 1, 0, 0)
    empty = replace(path, extrude=np.zeros(len(path), bool))
    assert np.isnan(laid(nozzle_log(empty), empty)[1].coverage)
