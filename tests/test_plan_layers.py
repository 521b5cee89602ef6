"""Layers fill the wound: all of it, none twice, bottom up; bumps of the bed; faults of a scan mended or refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.scans.scan import face_normals
from estimation.se3 import Array
from hardware.cli.main import main
from hardware.files.mesh_file import write_ply
from planning.fill.bead import Pattern
from planning.layers.checkpoints import CheckpointSettings, ToolLimits, tilt_field, tool_rotations
from planning.layers.grid import grid_over, unroll
from planning.layers.plan import Plan, PlanOrder, make_plan
from planning.layers.repair import repair_mesh
from planning.layers.slicing import LAYER_MODES, BumpLayer, BumpPassing, LayerMode, Tissue, bumps_in, layer_stack, slabs
from planning.layers.wound import WoundVolume, find_wound
from tests.scans import height_field
from tests.wound_scans import SKIN, scan_of, sheet, wound_of


@given(
    st.lists(st.one_of(st.none(), st.floats(0.05, 5)), min_size=1, max_size=5).filter(lambda t: t.count(None) <= 1),
    st.floats(0.1, 12), st.floats(0.05, 2),
)  # fmt: skip
def test_layers_fill_the_height_without_a_gap(thicknesses: list[float | None], whole: float, height: float) -> None:
    tissues = [Tissue(str(i), t, "1", height=height) for i, t in enumerate(thicknesses)]
    cut = slabs(tissues, whole)
    assert cut[0].low == pytest.approx(0, abs=1e-5) and cut[-1].high == pytest.approx(whole, abs=1e-5)
    assert np.allclose([a.high for a in cut[:-1]], [b.low for b in cut[1:]], atol=1e-5)
    assert [int(slab.tissue.name) for slab in cut] == sorted(int(slab.tissue.name) for slab in cut)
    if None in thicknesses:
        return
    for tissue in tissues[:-1]:
        own = [slab for slab in cut if slab.tissue is tissue]
        assert not own or own[-1].high - own[0].low <= (tissue.thickness or 0) + 1e-9


def test_tissues_over_the_rest_keep_their_thickness_under_the_skin() -> None:
    cut = slabs(SKIN, 5.0)
    dermis = [slab for slab in cut if slab.tissue.name == "dermis"]
    assert dermis[0].low == pytest.approx(3.0) and dermis[-1].high == pytest.approx(4.6) and len(dermis) == 4
    assert [slab.tissue.name for slab in slabs(SKIN, 1.2)] == ["dermis", "dermis", "epidermis"]


@pytest.mark.parametrize("mode", LAYER_MODES)
@pytest.mark.parametrize("kind", ["forearm", "foot"])
def test_the_beads_heights_add_up_to_the_wound(mode: LayerMode, kind: str) -> None:
    wound = wound_of(kind)
    stack = layer_stack(wound, SKIN, mode, 0.4)
    nodes = wound.grid.nodes.reshape(-1, 2)
    volume = 0.0
    for layer in stack.layers:
        inside = nodes[shapely.contains_xy(layer.region, nodes[:, 0], nodes[:, 1])]
        heights = stack.bead_heights(inside, np.full(len(inside), layer.number))
        nominal = layer.slab.high - layer.slab.low
        assert heights.min(initial=nominal) >= 0.19 * nominal and heights.max(initial=nominal) <= 2.01 * nominal
        volume += heights.sum() * wound.grid.step**2
    assert volume == pytest.approx(wound.findings.volume, rel=0.025)


@pytest.mark.parametrize("mode", LAYER_MODES)
def test_layers_lie_inside_the_outline_and_over_the_bed(mode: LayerMode) -> None:
    wound = wound_of()
    stack = layer_stack(wound, SKIN, mode, 0.4)
    nodes = wound.grid.nodes.reshape(-1, 2)
    within = shapely.contains_xy(wound.outline, nodes[:, 0], nodes[:, 1])
    below = np.full(len(nodes), -np.inf)
    for layer in stack.layers:
        assert layer.region.difference(shapely.buffer(wound.outline, 1e-6)).area < 1e-6
        top = stack.tops(nodes, np.full(len(nodes), layer.number))
        assert (top > below)[within].all()
        below = top
        inside = shapely.contains_xy(layer.region, nodes[:, 0], nodes[:, 1])
        assert (top - wound.bed.ravel())[inside].min(initial=1.0) > 0


def test_the_last_layer_is_the_restored_skin_and_the_first_follows_the_bed() -> None:
    wound = wound_of()
    inside = shapely.contains_xy(wound.outline, *np.moveaxis(wound.grid.nodes, -1, 0))
    for mode in ("skin", "conformal"):
        stack = layer_stack(wound, SKIN, mode, 0.4)
        assert np.allclose(stack.highest[inside], wound.skin[inside])
    assert np.sqrt(np.mean((stack.lowest - wound.bed)[inside] ** 2)) < 0.05


def test_what_a_shallow_wound_has_no_room_for_is_named() -> None:
    assert layer_stack(wound_of(), SKIN, "skin", 0.4).missing == ()
    deep = (Tissue("hypodermis", None, "1"), Tissue("dermis", 30.0, "2"))
    assert layer_stack(wound_of(), deep, "skin", 0.4).missing == ("hypodermis",)


def test_layers_that_no_bead_fits_into_are_refused() -> None:
    with pytest.raises(InputError, match="room for a bead"):
        layer_stack(wound_of(), SKIN, "skin", 60.0)
    with pytest.raises(InputError, match="400 at most"):
        layer_stack(wound_of(), (Tissue("skin", None, "1", height=0.005),), "skin", 0.4)


@given(st.floats(20, 80), st.booleans())
@settings(max_examples=10)
def test_a_cylinder_is_unrolled_to_its_true_lengths(radius: float, along_y: bool) -> None:
    grid = grid_over([-12, -12], [12, 12], 0.25)
    chart = unroll(grid, np.sqrt(radius**2 - grid.nodes[..., 0 if along_y else 1] ** 2))
    a, b = np.array([[-10.0, 3.0], [8.0, 3.0]]) if along_y else np.array([[3.0, -10.0], [3.0, 8.0]])
    arc = radius * (np.arcsin(8 / radius) + np.arcsin(10 / radius))
    charted = chart.from_plane(np.stack([a, b]))
    assert np.linalg.norm(charted[1] - charted[0]) == pytest.approx(arc, rel=1e-3)


@given(st.integers(0, 1000))
@settings(max_examples=10)
def test_the_chart_and_back_is_where_one_was(seed: int) -> None:
    wound = wound_of("foot")
    chart = unroll(wound.grid, wound.skin)
    low, high = np.array(wound.outline.bounds).reshape(2, 2)
    xy = np.random.default_rng(seed).uniform(low - 30, high + 30, (200, 2))
    assert np.abs(chart.to_plane(chart.from_plane(xy)) - xy).max() < 1e-5


def steep(wound: WoundVolume) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.asarray(3.0 * wound.bed)


@given(st.floats(5, 60), st.floats(0.2, 20))
@settings(max_examples=10)
def test_the_tool_keeps_its_limits_on_any_way(tilt_deg: float, turning_deg: float) -> None:
    wound = wound_of()
    limits = ToolLimits(np.deg2rad(tilt_deg), np.deg2rad(turning_deg))
    inside = shapely.contains_xy(wound.outline, *np.moveaxis(wound.grid.nodes, -1, 0))
    found = tilt_field(wound.grid, steep(wound), inside, limits).values
    assert np.linalg.norm(found, axis=-1).max() <= limits.tilt + 1e-9
    for axis in (0, 1):
        pairs = np.minimum(inside, np.roll(inside, -1, axis)) & True
        change = np.linalg.norm(np.roll(found, -1, axis) - found, axis=-1)[pairs] / wound.grid.step
        assert change.max() <= 1.5 * limits.turning  # a difference over one step, the limit over two


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3, 3))
def test_the_tool_stands_along_the_normal_whatever_its_spin(along: float, across: float, spin: float) -> None:
    steepness = np.hypot(along, across)
    slope = np.array([along, across]) * (np.tan(steepness) / steepness if steepness > 1e-9 else 1.0)
    normal = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1 + slope @ slope)
    turned = tool_rotations(np.array([[along, across]]), spin)[0]
    assert np.allclose(turned[:, 2], normal, atol=1e-9)
    assert np.allclose(turned @ turned.T, np.eye(3), atol=1e-12)


DEEP, FLOOR = 2.0, 9.0  # mm deep, and radius of the flat bed
LAYERS = (Tissue("dermis", None, "1", height=0.4),)  # five
PLACE = np.array([2.0, 1.0])  # of the bump
USUAL = BumpPassing()


def pit(x: Array, y: Array, bump: float, radius: float, place: Array = PLACE) -> Array:
    """A round wound with steep walls and, on its flat bed, a bump with a flat top."""
    far = np.hypot(x, y)
    bed = -DEEP * np.clip((FLOOR + 2.0 - far) / 2.0, 0, 1)
    return np.asarray(bed + bump * np.clip((radius + 1.0 - np.hypot(x - place[0], y - place[1])) / 1.0, 0, 1))


def wound_with(bump: float, radius: float = 1.5, place: Array = PLACE) -> WoundVolume:
    scan = height_field(lambda x, y: pit(x, y, bump, radius, place), (60.0, 60.0), 0.5)
    return find_wound(scan, 0.25, "scan")


def planned(wound: WoundVolume, passing: BumpPassing = USUAL) -> Plan:
    return make_plan(wound, PlanOrder(LAYERS, Pattern("contour", 0.4), way=CheckpointSettings(), passing=passing))


def over_bump(plan: Plan, number: int, radius: float = 1.0) -> Array:
    """Heights (N,) mm over the plane of the tips that extrude in a layer, on top of the bump."""
    points = plan.points
    middle = plan.wound.outline.centroid.coords[0]
    far = np.hypot(*(points.tip[:, :2] - middle - PLACE).T)
    return np.asarray(points.tip[(points.layer == number) & points.extrude & (far < radius), 2])


def test_a_high_bump_is_gone_round_with_clearance_until_a_layer_lies_over_it() -> None:
    plan = planned(wound_with(1.3))
    for layer in plan.layers[:2]:
        bump, beads = layer.around, [shapely.linestrings(bead.points) for bead in layer.beads]
        assert bump.area > 5 and not over_bump(plan, layer.layer.number).size
        assert shapely.distance(shapely.multilinestrings(beads), bump) > 0.2 + 0.2 - 0.05
        assert layer.coverage.covered > 0.985
    assert over_bump(plan, 3).size and plan.layers[3].around.is_empty


def test_a_low_bump_is_gone_over_and_the_tip_stays_above_it() -> None:
    wound = wound_with(0.5)  # a quarter of a layer above the first
    plan = planned(wound)
    assert plan.layers[0].around.is_empty and plan.layers[0].over.area > 5
    tips = over_bump(plan, 0)
    bed = -DEEP + 0.5
    assert tips.size and (tips > bed + 0.05).all() and (over_bump(plan, 1) > tips.max()).all()
    assert plan.points.volume.sum() == pytest.approx(wound.findings.volume, rel=0.03)


def test_the_threshold_decides_between_over_and_round() -> None:
    wound = wound_with(0.5)
    over, around = planned(wound, BumpPassing(0.15)), planned(wound, BumpPassing(0.05))
    assert over.layers[0].around.is_empty and over_bump(over, 0).size
    assert around.layers[0].over.is_empty and around.layers[0].around.area > 5 and not over_bump(around, 0).size
    wider = planned(wound, BumpPassing(0.05, 1.0))
    assert wider.layers[0].region.area < around.layers[0].region.area - 5


def test_a_spur_of_the_wall_is_no_bump() -> None:
    plan = planned(wound_with(1.4, 2.0, np.array([FLOOR, 0.0])))
    assert all(layer.over.is_empty and layer.around.is_empty for layer in plan.layers)


def test_a_bump_is_measured_from_the_layers_top() -> None:
    grid = grid_over([-5, -5], [5, 5], 0.25)
    x, y = np.moveaxis(grid.nodes, -1, 0)
    inside, peak = np.hypot(x, y) < 4.5, np.where(np.hypot(x, y) < 1.0, 0.3, -1.0)
    found = bumps_in(grid, inside, peak, BumpLayer(0.4, 0.29, True), 0.02)
    assert found.highest == pytest.approx(0.3) and found.over.is_empty
    assert found.around.area == pytest.approx(2.2, abs=0.7)
    found = bumps_in(grid, inside, peak, BumpLayer(0.4, 0.31, True), 0.02)
    assert found.around.is_empty and found.over.area == pytest.approx(3.1, abs=0.7)
    walled = bumps_in(grid, inside & (x < 0), peak, BumpLayer(0.4, 0.29, True), 0.02)
    assert walled.over.is_empty and walled.around.is_empty


def test_pictures_summary_and_report_show_the_bumps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = height_field(lambda x, y: pit(x, y, 1.4, 1.5), (60.0, 60.0), 1.0)
    write_ply(tmp_path / "scan.ply", scan.vertices, scan.triangles)
    out = tmp_path / "path.csv"
    line = ["plan", str(tmp_path / "scan.ply"), "-o", str(out), "--bead", "0.8", "--bump", "0.1"]
    assert main([*line, "--bump-clearance", "0.6"]) == 0
    assert "avoided with a clearance of 0.60 mm in layer" in capsys.readouterr().out
    facts = json.loads(out.with_suffix(".json").read_text())
    assert facts["bumps"]["clearance_mm"] == 0.6 and facts["bumps"]["layers"][0]["around_mm2"] > 5
    assert "--arm" in facts["feasible"] and "--arm" in out.with_suffix(".html").read_text()
    first = (tmp_path / "path_layers" / "layer_001.svg").read_text()
    assert 'class="around"' in first and "avoided bump" in first
    assert "bumps of the bed" in out.with_suffix(".html").read_text()


def test_a_whole_scan_is_left_as_it_is() -> None:
    vertices, triangles = sheet()
    scan, done = repair_mesh(vertices, triangles, "scan")
    assert [count for _, count in done.rows()[2:]] == [0] * 10
    assert len(scan.vertices) == len(vertices) and len(scan.triangles) == len(triangles)


def test_vertices_that_every_triangle_has_for_itself_are_merged() -> None:
    vertices, triangles = sheet()
    scan, done = repair_mesh(vertices[triangles].reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3), "scan")
    assert done.merged == triangles.size - len(vertices)
    assert len(scan.vertices) == len(vertices) and done.holes == 0


@given(st.integers(0, 1000))
@settings(max_examples=20)
def test_triangles_that_face_against_the_most_are_turned_over(seed: int) -> None:
    vertices, triangles = sheet()
    against = np.random.default_rng(seed).random(len(triangles)) < 0.4
    mixed = np.where(against[:, None], triangles[:, ::-1], triangles)
    scan, done = repair_mesh(vertices, mixed, "scan")
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
    scan, done = repair_mesh(strip.reshape(-1, 3), triangles, "scan")
    assert 2 * n - 4 <= len(scan.triangles) <= 2 * n and done.turned == 0


def test_each_kind_of_damage_is_counted() -> None:
    vertices, triangles = sheet()
    far = vertices.max(axis=0) + 50
    vertices = np.concatenate([vertices, [far, far + [1, 0, 0], far + [0, 1, 0], [np.nan, 0, 0], [0, 0, 9]]])
    v = len(vertices)
    inner = len(triangles) // 4
    third = [*triangles[inner, :2], v - 1]
    extra = [[v - 5, v - 4, v - 3], [0, 1, v - 2], [0, 1, v + 7], [3, 3, 4], triangles[7], third]
    scan, done = repair_mesh(vertices, np.concatenate([np.delete(triangles, 400, axis=0), extra]), "scan")
    assert (done.islands, done.island_triangles) == (1, 1)
    assert (done.broken, done.empty, done.double, done.crowded, done.holes) == (2, 1, 1, 1, 1)
    assert len(scan.triangles) == len(triangles) - 1 - 1 + 1  # a hole, and of three at an edge the smallest goes


def test_lone_spikes_are_levelled_and_steps_are_not() -> None:
    vertices, triangles = sheet()
    vertices[:, 2] = np.where(vertices[:, 0] > 0.5, 3.0, 0.0)
    spiked = vertices.copy()
    spiked[[200, 430, 700], 2] += [6.0, -6.0, 6.0]
    scan, done = repair_mesh(spiked, triangles, "scan")
    assert done.spikes == 3
    order = np.lexsort(scan.vertices[:, :2].T)
    off = scan.vertices[order] - vertices[np.lexsort(vertices[:, :2].T)]
    assert np.abs(off).max() < 0.7  # moved along the mean normal, which the step tilts


@pytest.mark.parametrize("count", [0, 3, 40])
def test_too_little_to_be_a_surface_is_refused(count: int) -> None:
    vertices, triangles = sheet()
    with pytest.raises(InputError, match="50 or more"):
        repair_mesh(vertices, triangles[:count], "scan")


@pytest.mark.slow
@given(
    seed=st.integers(0, 10_000), gone=st.floats(0, 0.6), turned=st.floats(0, 0.6), noise=st.floats(0, 1.0),
    spikes=st.integers(0, 60), nan=st.integers(0, 20), double=st.floats(0, 0.3), wild=st.integers(0, 30),
    scale=st.sampled_from([1e-6, 0.001, 0.1, 1.0, 1.0, 1.0, 1.0, 3.0]),
)  # fmt: skip
@example(seed=0, gone=0, turned=0, noise=0, spikes=0, nan=0, double=0, wild=0, scale=0.001)
@example(seed=0, gone=0, turned=0, noise=0, spikes=0, nan=0, double=0, wild=2, scale=0.001)
@settings(max_examples=6)
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
        wound = find_wound(repair_mesh(vertices, triangles, "scan")[0], 0.5, "scan")
    except InputError as error:
        assert "\n" not in str(error)
        return
    assert wound.outline.is_valid and wound.outline.area > 0
    assert np.isfinite(wound.bed).all() and np.isfinite(wound.skin).all()


def test_of_two_shells_the_upper_one_is_planned_with_a_note_and_back_to_back_they_are_refused() -> None:
    vertices, triangles = scan_of()
    both = np.concatenate([vertices, vertices - [0.0, 0.0, 3.0]])
    alike = np.concatenate([triangles, triangles + len(vertices)])
    alone = find_wound(repair_mesh(vertices, triangles, "scan")[0], 0.5, "scan").findings
    doubled = find_wound(repair_mesh(both, alike, "scan")[0], 0.5, "scan").findings
    assert doubled.area == pytest.approx(alone.area, rel=0.01) and any("overhangs" in note for note in doubled.notes)
    back = np.concatenate([triangles, triangles[:, ::-1] + len(vertices)])
    with pytest.raises(InputError, match="length of the mean normal"):
        find_wound(repair_mesh(both, back, "scan")[0], 0.5, "scan")


def test_a_heap_of_noise_is_one_error() -> None:
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 60, (20_000, 1, 3)) + rng.normal(0, 1, (20_000, 3, 3))
    with pytest.raises(InputError, match="triangles that can be used of 20000"):
        repair_mesh(corners.reshape(-1, 3), np.arange(60_000).reshape(-1, 3), "scan")
