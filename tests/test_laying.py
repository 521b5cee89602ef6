"""Laying a path onto a surface: at its height, in short pieces, and nothing else changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from hardware.simulator.laying import divided, laid
from hardware.simulator.scene.shape import Shape, cylinder, flat
from planning.path import check_path, lengths
from tests.moving import path_through, raster


@given(st.lists(st.tuples(st.floats(-20, 20), st.floats(-20, 20)), min_size=2, max_size=6, unique=True))
def test_a_divided_path_is_the_same_line_in_pieces_of_a_millimetre(xy: list[tuple[float, float]]) -> None:
    points = np.column_stack([xy, np.linspace(0, 1, len(xy))])
    path = path_through(points)
    fine = divided(path, 1.0)
    step = lengths(fine.surface_from_nozzle)
    assert step.max() <= 1.0 + 1e-9
    assert step.sum() == pytest.approx(lengths(path.surface_from_nozzle).sum())
    distance = np.linalg.norm(fine.surface_from_nozzle[:, None, :3, 3] - points, axis=-1)
    assert distance.min(axis=0).max() < 1e-9  # every checkpoint is still there


def test_a_new_checkpoint_takes_after_the_next_of_the_old_ones() -> None:
    path = replace(
        path_through(np.array([[0.0, 0, 0], [3, 0, 0], [3, 2.5, 0]])),
        speed=np.array([1.0, 2, 3]),
        extrude=np.array([False, True, False]),
        layer=np.array([0, 1, 2]),
        extra={"note": np.array(["a", "b", "c"])},
    )
    fine = divided(path, 1.0)
    assert fine.speed.tolist() == [1, 2, 2, 2, 3, 3, 3]
    assert fine.extrude.tolist() == [False, True, True, True, False, False, False]
    assert fine.layer.tolist() == [0, 1, 1, 1, 2, 2, 2]
    assert fine.extra["note"].tolist() == list("abbbccc")
    assert fine.surface_from_nozzle[:, 0, 3] == pytest.approx([0, 1, 2, 3, 3, 3, 3])
    check_path(fine)


def test_a_stretch_on_which_the_tool_turns_is_left_whole() -> None:
    path = path_through(np.array([[0.0, 0, 0], [5, 0, 0], [9, 0, 0]]))
    path.surface_from_nozzle[1:, :3, :3] = se3.exp_rotation([0.0, 0.2, 0.0])
    assert len(divided(path, 1.0)) == 1 + 1 + 4


@pytest.mark.parametrize("shape", [flat((40, 40)), cylinder((40, 40), 45.0)], ids=["flat", "cylinder"])
def test_a_laid_path_stands_at_its_clearance_above_the_surface(shape: Shape) -> None:
    path = laid(raster(20.0), shape, 0.4)
    places = path.surface_from_nozzle[:, :3, 3]
    assert places[:, 2] - shape.heights_at(places[:, :2]) == pytest.approx(0.4)
    assert np.array_equal(path.surface_from_nozzle[:, :3, :3], np.broadcast_to(np.eye(3), (len(path), 3, 3)))


def test_on_a_scan_whose_frame_is_tilted_the_clearance_is_along_the_frames_own_z() -> None:
    bent = cylinder((60, 60), 45.0)
    tilted = replace(bent, surface_from_grid=se3.make(se3.exp_rotation([0.3, -0.4, 0.2]), [3.0, -2.0, 40.0]))
    path = raster(10.0)
    places = laid(path, tilted, 0.4).surface_from_nozzle[:, :3, 3]
    below = places - [0, 0, 0.4]
    assert tilted.points(tilted.material(below)) == pytest.approx(below, abs=1e-4)
    assert np.array_equal(places[:, :2], divided(path, 1.0).surface_from_nozzle[:, :2, 3])


@pytest.mark.parametrize("side", [10.1, -10.1])
def test_a_path_that_leaves_the_surface_is_refused(side: float) -> None:
    shape = flat((40, 20))
    path = path_through(np.array([[0.0, 0, 0], [0, np.sign(side) * 10, 0]]))
    laid(path, shape, 0.4)
    with pytest.raises(InputError, match=r"x\.csv: a place on the path.*40 x 20 mm"):
        laid(path_through(np.array([[0.0, 0, 0], [0, side, 0]])), shape, 0.4, "x.csv")


def test_a_path_over_a_hole_of_a_scan_is_refused() -> None:
    shape = flat((40, 20))
    valid = np.ones(shape.heights.shape, bool)
    valid[10, 20] = False  # the node in the middle
    holed = replace(shape, valid=valid)
    laid(path_through(np.array([[-5.0, 1, 0], [5, 1, 0]])), holed, 0.4)
    with pytest.raises(InputError, match=r"x = 0\.00, y = 0\.00 mm"):
        laid(path_through(np.array([[-5.0, 0, 0], [5, 0, 0]])), holed, 0.4)


def test_the_layers_of_a_path_stay_above_each_other() -> None:
    low = raster(20.0).surface_from_nozzle[:, :3, 3]
    both = path_through(np.concatenate([low, low[::-1] + [0, 0, 0.7]]))
    shape = cylinder((40, 40), 45.0)
    places = laid(both, shape, 0.4).surface_from_nozzle[:, :3, 3]
    above = places[:, 2] - shape.heights_at(places[:, :2])
    half = len(above) // 2
    assert above[: half - 1] == pytest.approx(0.4)
    assert above[half + 1 :] == pytest.approx(1.1)
