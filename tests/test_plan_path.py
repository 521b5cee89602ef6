"""Checkpoints: every bead laid, tool within limits, travels clear of the wound; the wound found where it is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.files.path_file import gcode_text, read_path, write_path
from hardware.simulator.scene.shape import Wound as Carved
from hardware.simulator.scene.shape import body
from planning.command import MotionLimits
from planning.fill.bead import Bead, Pattern, even_bead, fill_coverage
from planning.kinematics import SimpleArm
from planning.layers.checkpoints import CheckpointSettings, bead_points, spacing_over, with_spacing
from planning.layers.grid import Grid, grid_over, interpolate, positive_region, topmost
from planning.layers.plan import Plan, PlanOrder, figures_of, flat_wound, make_plan, total_of
from planning.layers.repair import repair_mesh
from planning.layers.slicing import LAYER_MODES, LayerMode, Tissue
from planning.layers.wound import WoundVolume, find_wound
from planning.motion.retime import run_times
from planning.path import check_path
from tests.slow_cases import slowly
from tests.wound_scans import SKIN, scan_of, wound_of

BLOB = np.array([[0.0, 0], [20, -3], [31, 6], [24, 17], [15, 12], [4, 18], [-6, 9]])


@cache
def plan_of(mode: LayerMode = "skin") -> Plan:
    return make_plan(wound_of(), PlanOrder(SKIN, Pattern("zigzag", 0.5, angle=0.3), mode))


@pytest.mark.parametrize("mode", LAYER_MODES)
def test_a_plan_is_a_path_that_can_be_printed_and_fills_the_wound(mode: LayerMode) -> None:
    plan = plan_of(mode)
    check_path(plan.path)
    assert (np.diff(plan.path.layer) >= 0).all() and not plan.path.extrude[0]
    assert plan.points.volume.sum() == pytest.approx(plan.wound.findings.volume, rel=0.05)
    assert total_of(figures_of(plan)).covered > 0.97


@pytest.mark.parametrize("mode", LAYER_MODES)
def test_where_ink_flows_the_tip_is_on_its_layer_inside_the_outline(mode: LayerMode) -> None:
    plan = plan_of(mode)
    laid = plan.points.extrude
    tip = plan.points.tip[laid]
    assert np.allclose(tip[:, 2], plan.stack.tops(tip[:, :2], plan.points.layer[laid]))
    assert shapely.contains_xy(shapely.buffer(plan.wound.outline, 0.05), tip[:, 0], tip[:, 1]).all()


def test_the_path_file_is_read_back_as_it_was_planned(tmp_path: Path) -> None:
    path = plan_of().path
    write_path(tmp_path / "path.csv", path)
    again = read_path(tmp_path / "path.csv")
    assert np.allclose(again.surface_from_nozzle, path.surface_from_nozzle, atol=1e-9)
    assert np.array_equal(again.extrude, path.extrude) and np.array_equal(again.material, path.material)
    assert list(again.extra) == ["wait_s", "width_mm", "height_mm", "volume_mm3", "run"]


def test_the_tool_keeps_its_limits_along_the_path() -> None:
    plan = plan_of("conformal")
    limits = plan.order.way.tool
    tool = plan.path.surface_from_nozzle[:, :3, 2]
    assert (tool @ plan.wound.surface_from_plane[:3, 2]).min() >= np.cos(limits.tilt) - 1e-9
    step = np.linalg.norm(np.diff(plan.path.surface_from_nozzle[:, :3, 3], axis=0), axis=1)
    turn = np.arccos(np.clip(np.einsum("ni,ni->n", tool[:-1], tool[1:]), -1, 1))
    laid = plan.path.extrude[1:]
    assert (turn[laid] <= 1.3 * limits.turning * step[laid] + 1e-6).all()


def test_the_spin_turns_the_tool_about_its_axis_only() -> None:
    plan = plan_of()
    way = replace(plan.order.way, tool=replace(plan.order.way.tool, spin=0.7))
    spun = make_plan(plan.wound, replace(plan.order, way=way)).path.surface_from_nozzle
    assert np.allclose(spun[:, :3, 2:], plan.path.surface_from_nozzle[:, :3, 2:])
    assert np.allclose(spun, plan.path.surface_from_nozzle @ se3.make(se3.exp_rotation([0, 0, 0.7]), np.zeros(3)))


@pytest.mark.parametrize("mode", LAYER_MODES)
def test_travels_keep_clear_of_the_scan(mode: LayerMode) -> None:
    plan = plan_of(mode)
    inner = ~plan.points.extrude
    inner[1:] &= ~plan.points.extrude[:-1]
    inner[:-1] &= ~plan.points.extrude[1:]  # neither rising from a bead nor coming down to one
    tip = plan.points.tip[inner]
    assert (tip[:, 2] - interpolate(plan.wound.grid, plan.wound.bed, tip[:, :2])).min() > 0.2


def test_further_layers_begin_with_their_wait_above_the_last_bead_and_time_adds_up() -> None:
    plan = plan_of()
    way = replace(plan.order.way, wait=30.0)
    waiting = make_plan(plan.wound, replace(plan.order, way=way))
    layers = sum(bool(layer.beads) for layer in plan.layers)
    taken, waited = (run_times(each.path, SimpleArm(), MotionLimits(), 0.02)[-1] for each in (plan, waiting))
    assert waited - taken == pytest.approx(30.0 * (layers - 1), rel=0.01)
    for i in np.flatnonzero(waiting.points.wait):
        rest, bead = waiting.points.tip[i - 1], waiting.points.tip[i - 2]  # where it waits, and where it left off
        assert waiting.points.extrude[i - 2] and not waiting.points.extrude[i - 1]
        assert np.linalg.norm(rest - bead) == pytest.approx(way.lift, abs=0.01)
    figures = figures_of(plan)
    assert sum(f.seconds for f in figures) == pytest.approx(taken, rel=1e-6)
    way_length = np.linalg.norm(np.diff(plan.points.tip, axis=0), axis=1)
    assert taken > (way_length / plan.points.speed[1:]).sum()
    assert sum(f.volume for f in figures) == pytest.approx(plan.points.volume.sum())


def test_bends_are_taken_slower_and_never_below_the_slowest() -> None:
    plan = plan_of()
    speed, full = plan.points.speed[plan.points.extrude], SKIN[0].speed
    assert speed.max() == full and speed.min() >= plan.order.way.slowest * full - 1e-9 and (speed < full).any()


def test_a_flat_contour_is_one_layer_covered_as_its_beads_cover_it() -> None:
    wound = flat_wound(BLOB, 0.8, "blob")
    plan = make_plan(wound, PlanOrder((Tissue("layer", None, "ink", height=0.8),), Pattern("zigzag", 0.8, angle=0.0)))
    assert len(plan.layers) == 1 and plan.layers[0].region.area == pytest.approx(wound.outline.area, rel=1e-4)
    assert np.allclose(plan.points.tip[plan.points.extrude, 2], 0.8)
    result = fill_coverage(plan.layers[0].beads, plan.layers[0].region)
    assert result.covered > 0.96 and result.over < 1e-3
    assert plan.points.volume.sum() == pytest.approx(0.8 * sum(b.area for b in plan.layers[0].beads), rel=1e-3)


def test_the_same_wound_gives_the_same_path() -> None:
    again = make_plan(wound_of(), plan_of().order).path
    assert np.array_equal(again.surface_from_nozzle, plan_of().path.surface_from_nozzle)


@given(st.integers(0, 1000), st.floats(0.1, 3.0), st.floats(0.005, 0.2))
@settings(max_examples=30)
def test_checkpoints_are_as_near_as_asked_and_on_the_bead(seed: int, spacing: float, chord: float) -> None:
    rng = np.random.default_rng(seed)
    lines = [even_bead(rng.uniform(0, 20, (rng.integers(2, 9), 2)), 0.4) for _ in range(4)]
    circle = np.linspace(0, 2 * np.pi, 300)
    points = 5 * np.column_stack([np.cos(circle), np.sin(circle)])
    lines.append(Bead(points, 0.4 + 0.1 * np.sin(circle)))
    runs = bead_points(lines, chord)
    dense = with_spacing(runs, np.full(len(runs.bead), spacing))
    assert dense.steps.max() <= spacing + 1e-9
    for i, line in enumerate(lines):
        own = dense.points[dense.bead == i]
        assert np.allclose(own[[0, -1]], line.points[[0, -1]])
        assert shapely.hausdorff_distance(shapely.linestrings(own), shapely.linestrings(line.points)) <= chord + 1e-9
        assert dense.width[dense.bead == i].min() >= line.width.min() - 1e-9


@given(st.floats(0.005, 0.2), st.floats(0.02, 0.15), st.integers(1, 6))
@settings(max_examples=30)
def test_points_that_go_leave_line_and_edges_where_they_were(chord: float, swing: float, waves: int) -> None:
    turn = np.linspace(0, 2 * np.pi, 600)
    line = Bead(5 * np.column_stack([np.cos(turn), np.sin(turn)]), 0.4 + swing * np.sin(waves * turn))
    runs = bead_points([line], chord)
    where = shapely.line_locate_point(shapely.linestrings(runs.points), shapely.points(line.points[1:-1]))
    width = np.interp(where, np.cumsum(runs.steps), runs.width)
    assert len(runs.points) < len(line.points)
    assert np.abs(width - line.width[1:-1]).max() / 2 <= 1.1 * chord  # the way along the cut line is a little shorter


@given(st.floats(1, 100), st.floats(0.002, 0.1))
def test_over_a_ball_a_chord_departs_by_what_is_allowed(radius: float, chord: float) -> None:
    spacing = float(spacing_over(np.array([1 / radius]), 5.0, chord)[0])
    assert spacing**2 / (8 * radius) <= chord * (1 + 1e-6) or spacing == 0.25 * 5.0
    assert spacing <= 5.0


def test_gcode_says_what_the_path_says() -> None:
    path = plan_of().path
    lines = gcode_text(path).splitlines()
    moves = [line.split() for line in lines if line.startswith(("G0 ", "G1 "))]
    assert len(moves) == len(path) and sum(move[0] == "G1" for move in moves) == path.extrude.sum()
    places = np.array([[float(word[1:]) for word in move[1:4]] for move in moves])
    assert np.abs(places - path.surface_from_nozzle[:, :3, 3]).max() < 6e-4
    laid = [float(move[-1][1:]) for move in moves if move[-1].startswith("E")]
    assert (np.diff(laid) >= 0).all()
    assert laid[-1] == pytest.approx(path.extra["volume_mm3"].astype(float).sum(), rel=1e-6)
    assert sum(line.startswith("; layer") for line in lines) == len(np.unique(path.layer))


def test_default_way_is_what_the_help_says() -> None:
    way = CheckpointSettings()
    assert (way.spacing, way.chord, way.travel, way.lift) == (1.0, 0.02, 60.0, 2.0)


def over_scan(wound: WoundVolume, xy: Array) -> Array:
    """Points (N, 3), scan frame, on the restored skin over points (N, 2) in the plane."""
    points = np.column_stack([xy, interpolate(wound.grid, wound.skin, xy)])
    return se3.transform_points(wound.surface_from_plane, points)


@pytest.mark.parametrize("kind", ["forearm", *slowly("chest", "foot")])
@pytest.mark.parametrize(("size", "depth"), [((24.0, 16.0), 3.0), ((60.0, 40.0), 6.0)])
def test_outline_and_skin_are_those_of_the_body(kind: str, size: tuple[float, float], depth: float) -> None:
    wound = wound_of(kind, size, depth)
    true = body(kind, Carved(size, depth), 3, 0.5)
    whole = body(kind, None, 3, 0.5)
    shape = positive_region(Grid(true.step, -np.array(true.size) / 2, true.heights.shape), true.inside, 1.0, 0.02)
    found = shapely.transform(wound.outline, lambda xy: over_scan(wound, xy)[:, :2])
    assert shapely.intersection(found, shape).area > 0.9 * shapely.union(found, shape).area
    nodes = over_scan(wound, wound.grid.nodes.reshape(-1, 2))
    nodes = nodes[shapely.contains_xy(shape, nodes[:, 0], nodes[:, 1])]
    off = nodes[:, 2] - whole.heights_at(nodes[:, :2])  # the body's own unevenness under the wound cannot be known
    assert np.sqrt(np.mean(off**2)) < 0.55


@pytest.mark.parametrize("seed", [0, *slowly(1, 2)])
def test_however_the_scan_lies_the_wound_is_the_same(seed: int) -> None:
    turn, move = np.random.default_rng(seed).uniform(-1, 1, (2, 3)) * [[2.0], [200.0]]
    vertices, triangles = scan_of()
    wound = wound_of()
    placed = se3.transform_points(se3.make(se3.exp_rotation(turn), move), vertices)
    moved = find_wound(repair_mesh(placed, triangles, "scan")[0], 0.4, "scan")
    assert moved.findings.area == pytest.approx(wound.findings.area, rel=0.05)
    assert moved.findings.volume == pytest.approx(wound.findings.volume, rel=0.08)
    assert moved.findings.depth == pytest.approx(wound.findings.depth, abs=0.15)


def test_an_outline_that_is_given_is_kept() -> None:
    vertices, triangles = scan_of()
    square = np.array([[-6.0, -5, 0], [6, -5, 0], [6, 5, 0], [-6, 5, 0]])
    wound = find_wound(repair_mesh(vertices, triangles, "scan")[0], 0.4, "scan", square)
    assert wound.findings.given and wound.outline.area == pytest.approx(120, rel=0.05)


def test_a_hole_in_the_wound_is_closed_and_told() -> None:
    vertices, triangles = scan_of()
    middle = vertices[triangles].mean(axis=1)
    open_scan = triangles[np.hypot(middle[:, 0], middle[:, 1]) > 2.5]
    wound = find_wound(repair_mesh(vertices, open_scan, "scan")[0], 0.4, "scan")
    assert wound.findings.closed == pytest.approx(np.pi * 2.5**2, rel=0.3)
    assert any("not scanned" in note for note in wound.findings.notes)
    assert wound.findings.volume == pytest.approx(wound_of().findings.volume, rel=0.05)


def test_what_an_overhang_hides_is_told() -> None:
    vertices, triangles = scan_of()
    middle = np.abs(vertices[:, :2]).max(axis=1) < 12
    leaning = vertices.copy()
    leaning[:, 0] += np.where(middle, 3.0 * np.clip(-vertices[:, 2] - 1.0, 0, 2), 0.0)  # the bed under one wall
    undermined = find_wound(repair_mesh(leaning, triangles, "scan")[0], 0.4, "scan").findings
    assert wound_of().findings.hidden < 1.0 and undermined.hidden > 10.0
    assert any("overhang" in note for note in undermined.notes)


def test_healthy_skin_has_no_wound() -> None:
    vertices, triangles = body("forearm", None, 3, 0.5).mesh(1.0)
    with pytest.raises(InputError, match="none found"):
        find_wound(repair_mesh(vertices, triangles, "scan")[0], 0.4, "scan")


@pytest.mark.slow  # test_plan_command turns one over too
def test_a_scan_that_is_inside_out_is_refused_and_with_flip_it_is_not() -> None:
    vertices, triangles = scan_of(size=(60.0, 40.0), depth=6.0)
    outside_in = triangles[:, ::-1]
    with pytest.raises(InputError, match="if it was scanned inside out, say --flip"):
        find_wound(repair_mesh(vertices, outside_in, "scan")[0], 0.5, "scan")
    wound = find_wound(repair_mesh(vertices, outside_in, "scan", flip=True)[0], 0.5, "scan")
    assert wound.findings.area == pytest.approx(wound_of(size=(60.0, 40.0), depth=6.0).findings.area, rel=0.02)


def test_a_wound_at_the_rim_of_the_scan_is_refused() -> None:
    vertices, triangles = scan_of()
    cut = triangles[(vertices[triangles][:, :, 0] < 1.0).all(axis=1)]
    with pytest.raises(InputError, match=r"rim|none found"):
        find_wound(repair_mesh(vertices, cut, "scan")[0], 0.4, "scan")


@given(st.integers(0, 10_000), st.floats(0.2, 3.0))
@settings(max_examples=15)
def test_regions_are_where_the_function_is_positive(seed: int, slope: float) -> None:
    rng = np.random.default_rng(seed)
    grid = Grid(0.5, np.array([-8.0, -6.0]), (25, 33))
    centre, radius = rng.uniform(-2, 2, 2), rng.uniform(1, 4)
    values = slope * (radius - np.linalg.norm(grid.nodes - centre, axis=-1))
    shape = positive_region(grid, values, 0.1, 0.0)
    assert shape.is_valid and shape.area == pytest.approx(np.pi * radius**2, rel=0.05)
    nodes = grid.nodes.reshape(-1, 2)
    inside = shapely.contains_xy(shape, nodes[:, 0], nodes[:, 1])
    assert np.array_equal(inside, values.ravel() > 1e-9)


def test_a_region_may_have_holes_and_islands() -> None:
    grid = grid_over([-10, -10], [10, 10], 0.25)
    waves = np.sin(np.linalg.norm(grid.nodes, axis=-1) * np.pi / 3)  # rings: inside 3, between 6 and 9, beyond 12
    shape = positive_region(grid, waves, 0.1, 0.001)
    assert sorted(len(part.interiors) for part in shape.geoms)[:2] == [0, 0] or len(shape.geoms) >= 2
    assert shapely.contains_xy(shape, 1.0, 1.0) and not shapely.contains_xy(shape, 4.5, 0.0)
    assert shapely.contains_xy(shape, 7.5, 0.0)


def test_of_two_triangles_the_upper_one_counts() -> None:
    points = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 2], [4, 0, 2], [0, 4, 2]])
    grid = Grid(1.0, np.zeros(2), (5, 5))
    heights = topmost(points, np.array([[0, 1, 2], [5, 4, 3]]), grid)
    x, y = grid.nodes[..., 0], grid.nodes[..., 1]
    assert np.array_equal(heights, np.where(x + y <= 4, 2.0, -np.inf))
