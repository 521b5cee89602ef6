"""What is wrong with a scan is put right and counted; what cannot be used is refused in one line."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.scan import face_normals
from planning.layers.repair import repaired
from planning.layers.wound import wound_in
from tests.wounds import scan_of, sheet


def test_a_whole_scan_is_left_as_it_is() -> None:
    vertices, triangles = sheet()
    scan, done = repaired(vertices, triangles, "scan")
    assert [count for _, count in done.rows()[2:]] == [0] * 10
    assert len(scan.vertices) == len(vertices) and len(scan.triangles) == len(triangles)


def test_vertices_that_every_triangle_has_for_itself_are_merged() -> None:
    vertices, triangles = sheet()
    scan, done = repaired(vertices[triangles].reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3), "scan")
    assert done.merged == triangles.size - len(vertices)
    assert len(scan.vertices) == len(vertices) and done.holes == 0


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_triangles_that_face_against_the_most_are_turned_over(seed: int) -> None:
    vertices, triangles = sheet()
    against = np.random.default_rng(seed).random(len(triangles)) < 0.4
    mixed = np.where(against[:, None], triangles[:, ::-1], triangles)
    scan, done = repaired(vertices, mixed, "scan")
    assert done.turned == against.sum()
    assert np.allclose(face_normals(scan), [0, 0, 1])


def test_a_strip_that_has_but_one_side_is_no_trouble() -> None:
    n = 200
    around = np.linspace(0, 2 * np.pi, n, endpoint=False)
    across = np.array([-8.0, 8.0])
    turn = around[:, None] / 2
    radius = 40 + across * np.cos(turn)
    strip = np.stack([radius * np.cos(around)[:, None], radius * np.sin(around)[:, None], across * np.sin(turn)], -1)
    number = np.arange(2 * n).reshape(n, 2)
    following = np.concatenate([number[1:], number[:1, ::-1]])
    a, b, c, d = number[:, 0], number[:, 1], following[:, 1], following[:, 0]
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    scan, done = repaired(strip.reshape(-1, 3), triangles, "scan")
    assert 2 * n - 4 <= len(scan.triangles) <= 2 * n and done.turned == 0


def test_each_kind_of_damage_is_counted() -> None:
    vertices, triangles = sheet()
    far = vertices.max(axis=0) + 50
    vertices = np.concatenate([vertices, [far, far + [1, 0, 0], far + [0, 1, 0], [np.nan, 0, 0], [0, 0, 9]]])
    v = len(vertices)
    inner = len(triangles) // 4
    third = [*triangles[inner, :2], v - 1]
    extra = [[v - 5, v - 4, v - 3], [0, 1, v - 2], [0, 1, v + 7], [3, 3, 4], triangles[7], third]
    scan, done = repaired(vertices, np.concatenate([np.delete(triangles, 400, axis=0), extra]), "scan")
    assert (done.islands, done.island_triangles) == (1, 1)
    assert (done.broken, done.empty, done.double, done.crowded, done.holes) == (2, 1, 1, 1, 1)
    assert len(scan.triangles) == len(triangles) - 1 - 1 + 1  # a hole, and of three at an edge the smallest goes


def test_lone_spikes_are_levelled_and_steps_are_not() -> None:
    vertices, triangles = sheet()
    vertices[:, 2] = np.where(vertices[:, 0] > 0.5, 3.0, 0.0)
    spiked = vertices.copy()
    spiked[[200, 430, 700], 2] += [6.0, -6.0, 6.0]
    scan, done = repaired(spiked, triangles, "scan")
    assert done.spikes == 3
    order = np.lexsort(scan.vertices[:, :2].T)
    off = scan.vertices[order] - vertices[np.lexsort(vertices[:, :2].T)]
    assert np.abs(off).max() < 0.7  # moved along the mean normal, which the step tilts


@pytest.mark.parametrize("count", [0, 3, 40])
def test_too_little_to_be_a_surface_is_refused(count: int) -> None:
    vertices, triangles = sheet()
    with pytest.raises(InputError, match="50 or more"):
        repaired(vertices, triangles[:count], "scan")


@given(
    seed=st.integers(0, 10_000), gone=st.floats(0, 0.6), turned=st.floats(0, 0.6), noise=st.floats(0, 1.0),
    spikes=st.integers(0, 60), nan=st.integers(0, 20), double=st.floats(0, 0.3), wild=st.integers(0, 30),
    scale=st.sampled_from([1e-6, 0.001, 0.1, 1.0, 1.0, 1.0, 1.0, 3.0]),
)  # fmt: skip
@example(seed=0, gone=0, turned=0, noise=0, spikes=0, nan=0, double=0, wild=0, scale=0.001)
@example(seed=0, gone=0, turned=0, noise=0, spikes=0, nan=0, double=0, wild=2, scale=0.001)
@settings(max_examples=12, deadline=None)
def test_a_damaged_scan_gives_a_wound_or_one_clear_error(
    seed: int, gone: float, turned: float, noise: float, spikes: int, nan: int, double: float, wild: int, scale: float
) -> None:
    rng = np.random.default_rng(seed)
    vertices, triangles = scan_of()
    vertices = (vertices + rng.normal(0, noise, vertices.shape)) * scale
    vertices[rng.integers(0, len(vertices), spikes)] += rng.normal(0, 10 * scale, (spikes, 3))
    vertices[rng.integers(0, len(vertices), nan), rng.integers(0, 3, nan)] = rng.choice([np.nan, np.inf], nan)
    triangles = triangles[rng.random(len(triangles)) >= gone]
    triangles = np.where((rng.random(len(triangles)) < turned)[:, None], triangles[:, ::-1], triangles)
    triangles = np.concatenate([triangles, triangles[rng.random(len(triangles)) < double]])
    triangles = np.concatenate([triangles, rng.integers(-5, len(vertices) + 5, (wild, 3))])
    try:
        wound = wound_in(repaired(vertices, triangles, "scan")[0], 0.5, "scan")
    except InputError as error:
        assert "\n" not in str(error)
        return
    assert wound.outline.is_valid and wound.outline.area > 0
    assert np.isfinite(wound.bed).all() and np.isfinite(wound.skin).all()
