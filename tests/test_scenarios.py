"""The scenarios of data/scenarios: each can be read, says what it proves, and asks for what can be printed."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hardware.files.path_file import read_path
from hardware.simulator.bodies import BODIES, Wound, body
from hardware.simulator.laying import laid
from hardware.simulator.scenario import Scenario
from hardware.simulator.scenario_file import read_scenario
from hardware.simulator.scene.shape import Shape
from planning.path import check_path

FOLDER = Path(__file__).parents[1] / "data" / "scenarios"
FILES = sorted(FOLDER.glob("*.toml"))
KINDS = {  # what must be proved
    *("still", "shaking_table_0_1_hz", "shaking_table_0_5_hz", "thesis_cube", "turns", "hand", "steps_300um"),
    *("breathing_calm", "breathing_deep", "breathing_irregular", "nozzle_occlusion", "camera_lost", "clock_offsets"),
    *("printed_material", "wet_glare", "deformation"),
}


@cache
def scenario(file: Path) -> Scenario:
    return read_scenario(file)


@cache
def shape(kind: str, seed: int) -> Shape:
    return body(kind, Wound(), seed)


def test_there_is_one_for_each_thing_that_must_be_proved() -> None:
    assert {file.stem for file in FILES} >= KINDS
    assert len({scenario(file).title for file in FILES}) == len(FILES)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_scenario_says_above_its_title_what_it_proves(file: Path) -> None:
    lines = file.read_text(encoding="utf-8").splitlines()
    comment = " ".join(
        line.removeprefix("# ") for line in lines[: next(i for i, x in enumerate(lines) if x[:1] != "#")]
    )
    assert "Proves" in comment
    assert comment.endswith(".")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_scenario_bounds_error_and_duty(file: Path) -> None:
    assert {"p95_mm", "duty"} <= set(scenario(file).limits.names)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_path_lies_in_the_wound_and_can_be_printed_in_time(file: Path) -> None:
    asked = scenario(file)
    kind = asked.scene["body"]
    surface = shape(kind, asked.seed)
    path = read_path(asked.path)
    places = path.surface_from_nozzle[:, :3, 3]
    assert surface.inside is not None
    x, y = np.rint(surface._nodes(places)).astype(int).T
    assert surface.inside[y, x].min() > asked.bead / 2  # not even the bead's edge is on the rim
    assert (np.abs(places[:, :2]) < np.array(BODIES[kind][1]) / 2).all()
    assert asked.clearance is not None
    fine = check_path(laid(path, surface, asked.clearance))
    length = np.linalg.norm(np.diff(fine.surface_from_nozzle[:, :3, 3], axis=0), axis=1)
    assert 5.0 + float(np.sum(length / fine.speed[1:])) < asked.seconds  # 5 s to see the surface and to get there


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_motion_stays_where_cameras_and_arm_reach(file: Path) -> None:
    asked = scenario(file)
    motion = asked.motion(np.linspace(0, asked.seconds, 400))
    assert np.linalg.norm(motion[:, :3, 3], axis=1).max() < 60.0
    moves = np.ptp(motion[:, :3, 3], axis=0).max() + np.ptp(motion[:, :3, :3], axis=0).max() * 50
    assert (moves > 0.1) == (file.stem != "still")
