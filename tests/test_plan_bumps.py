"""Bumps of the bed that stand over a layer: low ones are gone over, high ones round, and the wound's wall is none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import shapely

from estimation.se3 import Array
from hardware.cli.main import main
from hardware.ply_file import write_ply
from planning.fill.pattern import Pattern
from planning.layers.bumps import Passing, Step, bumps_in
from planning.layers.checkpoints import Way
from planning.layers.grid import grid_over
from planning.layers.plan import Order, Plan, make_plan
from planning.layers.tissue import Tissue
from planning.layers.wound import Wound, wound_in
from tests.scans import height_field

DEEP, FLOOR = 2.0, 9.0  # mm deep, and radius of the flat bed
LAYERS = (Tissue("dermis", None, "1", height=0.4),)  # five
PLACE = np.array([2.0, 1.0])  # of the bump
USUAL = Passing()


def pit(x: Array, y: Array, bump: float, radius: float, place: Array = PLACE) -> Array:
    """A round wound with steep walls and, on its flat bed, a bump with a flat top."""
    far = np.hypot(x, y)
    bed = -DEEP * np.clip((FLOOR + 2.0 - far) / 2.0, 0, 1)
    return np.asarray(bed + bump * np.clip((radius + 1.0 - np.hypot(x - place[0], y - place[1])) / 1.0, 0, 1))


def wound_with(bump: float, radius: float = 1.5, place: Array = PLACE) -> Wound:
    scan = height_field(lambda x, y: pit(x, y, bump, radius, place), (60.0, 60.0), 0.5)
    return wound_in(scan, 0.25, "scan")


def planned(wound: Wound, passing: Passing = USUAL) -> Plan:
    return make_plan(wound, Order(LAYERS, Pattern("contour", 0.4), way=Way(), passing=passing))


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
    over, around = planned(wound, Passing(0.15)), planned(wound, Passing(0.05))
    assert over.layers[0].around.is_empty and over_bump(over, 0).size
    assert around.layers[0].over.is_empty and around.layers[0].around.area > 5 and not over_bump(around, 0).size
    wider = planned(wound, Passing(0.05, 1.0))
    assert wider.layers[0].region.area < around.layers[0].region.area - 5


def test_a_spur_of_the_wall_is_no_bump() -> None:
    plan = planned(wound_with(1.4, 2.0, np.array([FLOOR, 0.0])))
    assert all(layer.over.is_empty and layer.around.is_empty for layer in plan.layers)


def test_a_bump_is_measured_from_the_layers_top() -> None:
    grid = grid_over([-5, -5], [5, 5], 0.25)
    x, y = np.moveaxis(grid.nodes, -1, 0)
    inside, peak = np.hypot(x, y) < 4.5, np.where(np.hypot(x, y) < 1.0, 0.3, -1.0)
    found = bumps_in(grid, inside, peak, Step(0.4, 0.29, True), 0.02)
    assert found.highest == pytest.approx(0.3) and found.over.is_empty
    assert found.around.area == pytest.approx(2.2, abs=0.7)
    found = bumps_in(grid, inside, peak, Step(0.4, 0.31, True), 0.02)
    assert found.around.is_empty and found.over.area == pytest.approx(3.1, abs=0.7)
    walled = bumps_in(grid, inside & (x < 0), peak, Step(0.4, 0.29, True), 0.02)
    assert walled.over.is_empty and walled.around.is_empty


def test_pictures_summary_and_report_show_the_bumps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = height_field(lambda x, y: pit(x, y, 1.4, 1.5), (60.0, 60.0), 1.0)
    write_ply(tmp_path / "scan.ply", scan.vertices, scan.triangles)
    out = tmp_path / "path.csv"
    line = ["plan", str(tmp_path / "scan.ply"), "-o", str(out), "--bead", "0.8", "--bump", "0.1"]
    assert main([*line, "--bump-clearance", "0.6"]) == 0
    assert "gone round with 0.60 mm between in layer" in capsys.readouterr().out
    facts = json.loads(out.with_suffix(".json").read_text())
    assert facts["bumps"]["clearance_mm"] == 0.6 and facts["bumps"]["layers"][0]["around_mm2"] > 5
    assert "--arm" in facts["feasible"] and "--arm" in out.with_suffix(".html").read_text()
    first = (tmp_path / "path_layers" / "layer_001.svg").read_text()
    assert 'class="around"' in first and "gone round" in first
    assert "bumps of the bed" in out.with_suffix(".html").read_text()
