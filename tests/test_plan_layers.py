"""Layers fill the wound: all of it, none of it twice, bottom up, each tissue as thick as it was asked for."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from planning.layers.chart import unrolled
from planning.layers.grid import grid_over
from planning.layers.slicing import MODES, Mode, stack_in
from planning.layers.tissue import Tissue, slabs
from planning.layers.tool import ToolLimits, rotations, tilts
from planning.layers.wound import Wound
from tests.wounds import SKIN, wound_of


@given(
    st.lists(st.one_of(st.none(), st.floats(0.05, 5)), min_size=1, max_size=5).filter(lambda t: t.count(None) <= 1),
    st.floats(0.1, 12), st.floats(0.05, 2),
)  # fmt: skip
def test_layers_fill_the_whole_height_without_a_gap(
    thicknesses: list[float | None], whole: float, height: float
) -> None:
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


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", ["forearm", "foot"])
def test_the_beads_heights_add_up_to_the_wound(mode: Mode, kind: str) -> None:
    wound = wound_of(kind)
    stack = stack_in(wound, SKIN, mode, 0.4)
    nodes = wound.grid.nodes.reshape(-1, 2)
    volume = 0.0
    for layer in stack.layers:
        inside = nodes[shapely.contains_xy(layer.region, nodes[:, 0], nodes[:, 1])]
        heights = stack.bead_heights(inside, np.full(len(inside), layer.number))
        nominal = layer.slab.high - layer.slab.low
        assert heights.min(initial=nominal) >= 0.19 * nominal and heights.max(initial=nominal) <= 2.01 * nominal
        volume += heights.sum() * wound.grid.step**2
    assert volume == pytest.approx(wound.findings.volume, rel=0.025)


@pytest.mark.parametrize("mode", MODES)
def test_layers_lie_inside_the_outline_and_over_the_bed(mode: Mode) -> None:
    wound = wound_of()
    stack = stack_in(wound, SKIN, mode, 0.4)
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
        stack = stack_in(wound, SKIN, mode, 0.4)
        assert np.allclose(stack.highest[inside], wound.skin[inside])
    assert np.sqrt(np.mean((stack.lowest - wound.bed)[inside] ** 2)) < 0.05


def test_what_a_shallow_wound_has_no_room_for_is_named() -> None:
    assert stack_in(wound_of(), SKIN, "skin", 0.4).missing == ()
    deep = (Tissue("hypodermis", None, "1"), Tissue("dermis", 30.0, "2"))
    assert stack_in(wound_of(), deep, "skin", 0.4).missing == ("hypodermis",)


def test_layers_that_no_bead_fits_into_are_refused() -> None:
    with pytest.raises(InputError, match="room for a bead"):
        stack_in(wound_of(), SKIN, "skin", 60.0)
    with pytest.raises(InputError, match="400 at most"):
        stack_in(wound_of(), (Tissue("skin", None, "1", height=0.005),), "skin", 0.4)


@given(st.floats(20, 80), st.booleans())
@settings(max_examples=10, deadline=None)
def test_a_cylinder_is_unrolled_to_its_true_lengths(radius: float, along_y: bool) -> None:
    grid = grid_over([-12, -12], [12, 12], 0.25)
    across = grid.nodes[..., 0 if along_y else 1]
    chart = unrolled(grid, np.sqrt(radius**2 - across**2))
    a, b = np.array([[-10.0, 3.0], [8.0, 3.0]]) if along_y else np.array([[3.0, -10.0], [3.0, 8.0]])
    arc = radius * (np.arcsin(8 / radius) + np.arcsin(10 / radius))
    charted = chart.from_plane(np.stack([a, b]))
    assert np.linalg.norm(charted[1] - charted[0]) == pytest.approx(arc, rel=1e-3)


@given(st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_the_chart_and_back_is_where_one_was(seed: int) -> None:
    wound = wound_of("foot")
    chart = unrolled(wound.grid, wound.skin)
    low, high = np.array(wound.outline.bounds).reshape(2, 2)
    xy = np.random.default_rng(seed).uniform(low - 30, high + 30, (200, 2))
    assert np.abs(chart.to_plane(chart.from_plane(xy)) - xy).max() < 1e-5


def steep(wound: Wound) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.asarray(3.0 * wound.bed)


@given(st.floats(5, 60), st.floats(0.2, 20))
@settings(max_examples=10, deadline=None)
def test_the_tool_keeps_its_limits_on_any_way(tilt_deg: float, turning_deg: float) -> None:
    wound = wound_of()
    limits = ToolLimits(np.deg2rad(tilt_deg), np.deg2rad(turning_deg))
    inside = shapely.contains_xy(wound.outline, *np.moveaxis(wound.grid.nodes, -1, 0))
    found = tilts(wound.grid, steep(wound), inside, limits).values
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
    turned = rotations(np.array([[along, across]]), spin)[0]
    assert np.allclose(turned[:, 2], normal, atol=1e-9)
    assert np.allclose(turned @ turned.T, np.eye(3), atol=1e-12)
