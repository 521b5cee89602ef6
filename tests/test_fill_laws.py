"""What holds for every region that is filled; what every pattern keeps to, whatever the region."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import MultiPolygon, Polygon, box

from estimation.errors import InputError
from planning.fill.bead import (
    PATTERN_KINDS,
    ROUNDING_GRID,
    SHARP_TURN,
    Bead,
    Pattern,
    PatternKind,
    PrintPace,
    Region,
    even_bead,
    fill_coverage,
    print_cost,
    region_of,
    roughness,
    travel_length,
    turn_angles,
    union_of,
    without_bumps,
)
from planning.fill.fill import fill, settle_angle, smooth_corners
from planning.fill.spiral import order_runs
from tests.campaigns.fill import random_wound
from tests.slow_cases import slowly

PACE = PrintPace()
ROUND = region_of(np.stack([9 * np.cos(np.arange(60) * 2 * np.pi / 60), 6 * np.sin(np.arange(60) * 2 * np.pi / 60)], 1))
WOUNDS = st.integers(0, 10**6).map(lambda seed: random_wound(np.random.default_rng(seed))[1])
SMALL = WOUNDS.filter(lambda wound: wound.area < 250)
ANGLES: tuple[float | Literal["shorter"], ...] = 0.0, np.pi / 2, "shorter"
few = settings(max_examples=8)


@few
@given(WOUNDS, st.sampled_from([0.4, 0.8]))
def test_middle_lines_stay_inside_and_widths_within_what_the_nozzle_lays(wound: Region, width: float) -> None:
    pattern = Pattern(width=width)
    roomy = wound.buffer(1e-3 * width)
    for bead in fill(wound, pattern, PACE):
        assert roomy.contains(shapely.linestrings(bead.points))
        assert bead.width.min() >= 0.999 * pattern.narrowest * width
        assert bead.width.max() <= 1.001 * pattern.widest * width


@few
@given(SMALL)
def test_a_wound_is_covered_once_and_nothing_beside_it(wound: Region) -> None:
    found = fill_coverage(fill(wound, Pattern(), PACE), wound)
    assert found.covered > 0.985 and found.double < 0.05 and found.over < 0.003


@pytest.mark.parametrize("number", [571, *slowly(217, 759)])
def test_rough_narrow_wounds_are_covered_to_99_percent(number: int) -> None:
    wound = random_wound(np.random.default_rng([1, number]))[1]
    found = fill_coverage(fill(wound, Pattern(), PACE), wound)
    assert found.covered >= 0.99 and found.double <= 0.05 and found.over < 0.002


def test_gaps_of_a_rough_wound_are_not_closed_by_laying_more_than_5_percent_twice() -> None:
    wound = random_wound(np.random.default_rng([7, 379]))[1]
    assert fill_coverage(fill(wound, Pattern(), PACE), wound).double < 0.048


def test_a_rough_narrow_wound_is_covered_alike_however_it_is_turned() -> None:
    wound = random_wound(np.random.default_rng([1, 880]))[1]
    aside = shapely.affinity.rotate(wound, 40, origin=(0, 0))
    one, other = (fill_coverage(fill(w, Pattern(), PACE), w).covered for w in (wound, aside))
    assert abs(one - other) < 0.001


def test_a_contour_without_roughness_is_followed_by_beads_of_the_nominal_width() -> None:
    assert roughness(box(0, 0, 30, 20).buffer(2.0), 0.4) < 1e-4
    assert np.allclose(fill(box(0, 0, 30, 20).buffer(2.0), Pattern("contour"), PACE)[0].width, 0.4)


@settings(few, max_examples=2)
@given(SMALL, st.floats(0.1, 6.2))
def test_coverage_does_not_depend_on_how_a_wound_is_turned(wound: Region, angle: float) -> None:
    turned = shapely.affinity.rotate(wound, angle, use_radians=True)
    before, after = (fill_coverage(fill(region, Pattern(), PACE), region).covered for region in (wound, turned))
    assert abs(before - after) < 0.002


@few
@given(WOUNDS, st.sampled_from(PATTERN_KINDS))
def test_no_corner_within_a_bead_is_sharp(wound: Region, kind: PatternKind) -> None:
    turns = (turn_angles(bead.points).max(initial=0.0) for bead in fill(wound, Pattern(kind), PACE))
    assert max(turns, default=0.0) <= SHARP_TURN


@pytest.mark.parametrize("kind", PATTERN_KINDS)
@pytest.mark.parametrize(
    ("whole", "island"),
    [(box(-8, -6, 10, 9), box(2, 1, 6, 5)), (ROUND, Polygon([(-2, -2), (3, -1), (1, 2)]))],
    ids=["box", "ellipse"],
)
def test_an_island_of_healthy_skin_is_not_printed_on(kind: PatternKind, whole: Region, island: Region) -> None:
    region = whole.difference(island)
    for line in (shapely.linestrings(bead.points) for bead in fill(region, Pattern(kind), PACE)):
        assert region.buffer(1e-6).contains(line) and not line.intersects(island)


def test_bumps_are_gone_round_with_clearance() -> None:
    bump = box(0, 0, 3, 3)
    for bead in fill(without_bumps(box(-9, -6, 9, 6), bump, 1.0), Pattern(), PACE):
        assert shapely.distance(shapely.linestrings(bead.points), bump) >= 1.0


@pytest.mark.parametrize("kind", PATTERN_KINDS)
@pytest.mark.parametrize(
    "region",
    [
        MultiPolygon(),
        box(0, 0, 1e-5, 1e-5),
        box(0, 0, 10, 0.05),
        Polygon([(0, 0), (10, 0), (5, 1e-9)]),
        MultiPolygon([box(0, 0, 1, 1), box(3, 0, 3.01, 9)]),
    ],
)
def test_what_is_too_small_for_a_bead_is_left_open(kind: PatternKind, region: Region) -> None:
    beads = fill(region, Pattern(kind), PACE)
    assert all(region.buffer(1e-6).contains(shapely.linestrings(bead.points)) for bead in beads)


def test_a_slit_narrower_than_two_beads_gets_one_of_its_own_width() -> None:
    (bead,) = fill(box(0, 0, 10, 0.48), Pattern(), PACE)
    assert np.allclose(bead.width, 0.48, atol=0.02) and bead.length > 9


def test_of_a_slit_narrower_than_any_bead_the_gap_is_told() -> None:
    slit = box(0, 0, 10, 0.1)
    assert fill_coverage(fill(slit, Pattern(), PACE), slit).gaps.area == pytest.approx(slit.area)


def test_the_same_region_gives_the_same_bytes() -> None:
    wound = random_wound(np.random.default_rng(5))[1]
    first, second = ([b.points.tobytes() + b.width.tobytes() for b in fill(wound, Pattern(), PACE)] for _ in "ab")
    assert first == second


def test_printing_begins_at_the_top_left_and_seams_move() -> None:
    region = region_of(np.array([[0, 0], [20, 0], [20, 12], [0, 12]]))
    first, moved = (fill(region, Pattern("contour", seam=seam), PACE)[0].points[0] for seam in (0.0, 0.5))
    assert np.linalg.norm(first - [0, 12]) < 4 and np.linalg.norm(first - moved) > 4


@few
@given(WOUNDS)
def test_the_shorter_of_horizontal_and_vertical_lines_wins(wound: Region) -> None:
    ways = [fill(wound, Pattern("zigzag", angle=angle), PACE) for angle in ANGLES]
    across, along, found = (sum(bead.length for bead in beads) + travel_length(beads) for beads in ways)
    assert found == pytest.approx(min(across, along), rel=0.01)


LINES: tuple[PatternKind, ...] = "zigzag", "raster", "hybrid"


def small(wound: Region) -> Region:
    """The wound at a size of 60 mm2."""
    share = (60 / wound.area) ** 0.5
    return shapely.affinity.scale(wound, share, share)


@few
@given(WOUNDS.map(small), st.sampled_from(LINES), st.sampled_from([2, 3, 5]))
def test_of_all_angles_that_are_tried_none_is_faster_than_the_one_chosen(
    wound: Region, kind: PatternKind, count: int
) -> None:
    def seconds(pattern: Pattern) -> float:
        return print_cost(fill(wound, pattern, PACE), PACE).seconds

    fastest = Pattern(kind, angle="fastest", angles=count)
    each = [seconds(replace(fastest, angle=np.pi * k / count)) for k in range(count)]
    settled = settle_angle(wound, fastest, PACE)
    assert seconds(settled) == min(each) and settled.angle == np.pi * np.argmin(each) / count
    if kind != "hybrid":  # whose lines are chosen by themselves, without the way there from the rim
        assert seconds(fastest) == min(each)


@few
@given(st.floats(1, 5), st.floats(1, 5))
def test_of_closed_lines_and_a_spiral_the_faster_is_laid_where_both_fill_alike(width: float, height: float) -> None:
    ellipse = shapely.affinity.scale(shapely.Point(0, 0).buffer(1, 64), width, height)
    kinds: tuple[PatternKind, ...] = "best", "contour", "spiral"
    best, *others = (print_cost(fill(ellipse, Pattern(kind), PACE), PACE).seconds for kind in kinds)
    assert best == min(others)


def test_a_plain_bead_covers_its_length_times_width_and_both_ends() -> None:
    bead = even_bead(np.array([[0.0, 0.0], [10.0, 0.0]]), 1.0)
    found = fill_coverage([bead, bead], box(-5, -5, 15, 5))
    assert found.covered * 200 == pytest.approx(10 + np.pi / 4, rel=1e-3)
    assert found.double * 200 == pytest.approx(10 - np.pi / 4, rel=1e-2)


def test_time_counts_printing_travel_and_turns() -> None:
    corner = even_bead(np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]), 0.4)
    cost = print_cost([corner, corner], PrintPace(20, 60, 0.05))  # each has a corner, and the travel one at each end
    assert cost.turns == 4 and cost.seconds == pytest.approx(40 / 20 + np.hypot(10, 10) / 60 + 0.2)
    straight_on = even_bead(np.array([[10.0, 12.0], [10.0, 20.0]]), 0.4)
    assert print_cost([corner, straight_on], PrintPace(20, 60, 0.05)).turns == 1
    assert print_cost([], PACE).seconds == 0
    assert print_cost([smooth_corners(corner, 0.1)], PACE).turns == 0


@few
@given(st.integers(0, 10**6), st.integers(2, 25), st.sampled_from([0.0, 0.05]))
def test_ordering_keeps_every_run_and_is_never_slower_than_nearest_neighbour(
    seed: int, count: int, turn: float
) -> None:
    ends, corner = np.random.default_rng(seed).uniform(-20, 20, (count, 2, 2)), np.array([-20.0, 20.0])
    beads, pace = [even_bead(pair, 0.4) for pair in ends], PrintPace(20, 60, turn)
    found = order_runs([[bead] for bead in beads], corner, pace)
    assert sorted(b.length for b in found) == sorted(b.length for b in beads)
    assert _travel_s(found, corner, pace) <= _travel_s(_greedy(beads, corner, pace), corner, pace) + 1e-9


def _travel_s(beads: list[Bead], start: np.ndarray, pace: PrintPace) -> float:
    """Time, s, of all travels, the first from `start`, whose turn is not at the start."""
    lead = even_bead(np.stack([2 * start - beads[0].points[0], start]), 0.4)  # goes straight on to the first bead
    return print_cost([lead, *beads], pace).seconds - sum(bead.length for bead in [lead, *beads]) / pace.printing


def _greedy(beads: list[Bead], start: np.ndarray, pace: PrintPace) -> list[Bead]:
    order, free = list[Bead](), list(range(len(beads)))
    while free:
        ways = [(_travel_s([*order, one], start, pace), i, one) for i in free for one in (beads[i], beads[i].reversed)]
        _, i, nearest = min(ways, key=lambda way: way[0])
        order.append(nearest)
        free.remove(i)
    return order


def test_runs_are_ordered_by_turns_as_well_as_by_way() -> None:
    first = even_bead(np.array([[0.0, 0.0], [10.0, 0.0]]), 0.4)
    ahead, aside = np.array([[12.2, 0.0], [12.4, 0.0]]), np.array([[10.0, 2.0], [10.0, 0.8]])
    runs = [[first], [even_bead(aside, 0.4)], [even_bead(ahead, 0.4)]]
    by_way, by_time = (order_runs(runs, np.zeros(2), PrintPace(20, 60, turn)) for turn in (0.0, 0.05))
    assert by_way[1].points[0] == pytest.approx(aside[1]) and by_time[1].points[0] == pytest.approx(ahead[0])


def test_a_closed_bead_begins_anywhere_without_changing() -> None:
    ring = even_bead(np.array([[0.0, 0], [4, 0], [4, 3], [0, 3], [0, 0]]), 0.4)
    turned = ring.turned(5.5)
    assert turned.closed and turned.length == pytest.approx(14) and turned.points[0] == pytest.approx([4, 1.5])
    assert isinstance(turned.between(1.0, 2.0), Bead) and turned.between(1.0, 2.0).length == pytest.approx(1.0)


@pytest.mark.parametrize(("name", "value"), [("width", 0), ("overlap", 0.95), ("narrowest", 0), ("kind", "star")])
def test_a_pattern_that_cannot_be_laid_is_refused(name: str, value: object) -> None:
    with pytest.raises(InputError, match=name):
        Pattern(**{name: value})


BOXES = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(0.1, 4), st.floats(0.1, 4))


@given(st.lists(BOXES, min_size=1, max_size=8))
def test_where_exact_arithmetic_finds_no_union_a_grid_does(corners: list[tuple[float, float, float, float]]) -> None:
    shapes = [box(x, y, x + wide, y + high) for x, y, wide, high in corners]
    exact, union = union_of(shapes).area, shapely.union_all

    def finds_none(found: list[Region], grid_size: float | None = None) -> Region:
        if grid_size is None:
            raise shapely.GEOSException("TopologyException: Ring edge missing")
        return union(found, grid_size=grid_size)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shapely, "union_all", finds_none)
        edges = sum(shape.length for shape in shapes)
        assert abs(union_of(shapes).area - exact) <= edges * ROUNDING_GRID


@pytest.mark.parametrize("kind", PATTERN_KINDS)
def test_an_ellipse_is_covered_and_nothing_beside_it(kind: PatternKind) -> None:
    found = fill_coverage(fill(ROUND, Pattern(kind), PrintPace()), ROUND)
    least = 0.94 if kind in ("zigzag", "raster", "hybrid") else 0.995
    assert found.covered > least and found.over < 0.001 and abs(found.double) < 0.05


def test_a_contour_that_crosses_itself_is_refused_with_the_place() -> None:
    with pytest.raises(InputError, match=r"Self-intersection\[1 1\]"):
        region_of(np.array([[0, 0], [2, 2], [2, 0], [0, 2]]))
