"""Restored skin meets what is true and knows how sure it is; a wound is found where it is, or a person is asked."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.cli.main import main
from hardware.files.mesh_file import read_raw_mesh, write_ply
from planning.layers.grid import grid_over
from planning.layers.outline import ScanColour, WoundQuestionError
from planning.layers.repair import repair_mesh
from planning.layers.skin import bent_base, depressions, restored_skin, skin_cells
from planning.layers.wound import find_wound
from tests.campaigns.wounds import LIMBS, CarvedWound, carve, score_wound, tube
from tests.slow_cases import slowly


def ring_of(height: object, inner: float, outer: float, noise: float, seed: int = 0) -> Array:
    """Points (N, 3) of a surface z = height(x, y) around a gap."""
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-outer, outer, (6000, 2))
    far = np.hypot(*flat.T)
    flat = flat[(far > inner) & (far < outer)]
    z = height(*flat.T)  # type: ignore[operator]
    return np.column_stack([flat, z + rng.normal(0, noise, len(flat))])


@given(st.floats(30, 200), st.floats(0, np.pi), st.booleans())
@settings(max_examples=10, deadline=None)
def test_cylinders_and_balls_are_restored_though_they_turn_away(radius: float, turn: float, ball: bool) -> None:
    def height(x: Array, y: Array) -> Array:
        across = np.cos(turn) * x + np.sin(turn) * y
        square = x * x + y * y if ball else across**2
        return np.asarray(np.sqrt(radius**2 - np.minimum(square, 0.97 * radius**2)) - radius)

    outer = min(35.0, 0.85 * radius)  # up to 58 degrees from the plane
    points = ring_of(height, 12.0, outer, 0.02)
    skin = restored_skin(skin_cells(bent_base(points), points), 12.0)
    _, heights = skin.over(grid_over([-9, -9], [9, 9], 3.0))
    nodes = grid_over([-9, -9], [9, 9], 3.0).nodes.reshape(-1, 2)
    assert np.abs(heights.ravel() - height(*nodes.T)).max() < 0.1


def test_the_deviation_grows_inwards_and_is_that_of_the_errors() -> None:
    rng = np.random.default_rng(3)
    ratios = []
    for seed in range(12):
        waves, phase = rng.normal(0, 0.06, (12, 2)), rng.uniform(0, 2 * np.pi, 12)

        def height(x: Array, y: Array, waves: Array = waves, phase: Array = phase) -> Array:
            return np.asarray(0.3 * np.sin(np.column_stack([x, y]) @ waves.T + phase).sum(axis=1) - x * x / 120)

        points = ring_of(height, 12.0, 38.0, 0.05, seed)
        skin = restored_skin(skin_cells(bent_base(points), points), 12.0)
        line = np.column_stack([np.linspace(0, 11, 12), np.zeros(12)])
        sigma = skin.deviation(line)
        assert (np.diff(sigma) < 1e-9).all() and sigma[-1] < 0.5 * sigma[0]
        places, over = skin.base.places(np.array([[0.0, 0.0, height(np.zeros(1), np.zeros(1))[0]]]))
        ratios.append(float((skin.at(places) - over)[0] / skin.deviation(places)[0]))
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 2.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_roundness_of_a_body_is_no_depression(sign: float) -> None:
    grid = grid_over([-40, -40], [40, 40], 1.0)
    x, y = np.moveaxis(grid.nodes, -1, 0)
    bowl = sign * (x * x / 90 + y * y / 160) + 0.3 * x
    known = np.ones(grid.shape, bool)
    assert all(d.depth < 0.05 for side in depressions(grid, bowl, known, 3) for d in side)
    pit = bowl - 3.0 * (np.hypot(x - 6, y + 4) < 8)
    (found,), _ = depressions(grid, pit, known, 1)
    assert np.hypot(found.middle[0] - 6, found.middle[1] + 4) < 2 and found.depth > 1.5


def test_bulges_are_the_depressions_of_the_same_heights_turned_over() -> None:
    grid = grid_over([-40, -30], [40, 30], 1.0)
    x, y = np.moveaxis(grid.nodes, -1, 0)
    heights = 7 + 0.1 * x + 2.0 * (np.hypot(x - 12, y + 4) < 6) - 1.5 * (np.hypot(x + 14, y) < 8)
    known = (x < 33) | (y > 0)
    for one, other in zip(
        depressions(grid, heights, known, 4), depressions(grid, -heights, known, 4)[::-1], strict=True
    ):
        np.testing.assert_allclose(
            [[*a.middle, *a.slope, a.radius, a.depth, a.clarity] for a in one],
            [[*b.middle, *b.slope, b.radius, b.depth, b.clarity] for b in other],
            atol=1e-9,
        )
    hollow, bulge = (side[0] for side in depressions(grid, heights, known, 1))
    assert np.hypot(hollow.middle[0] + 14, hollow.middle[1]) < 2
    assert np.hypot(bulge.middle[0] - 12, bulge.middle[1] + 4) < 2


@cache
def thigh(seed: int) -> CarvedWound:
    return carve(tube(*LIMBS["thigh"]), np.random.default_rng([7, seed]))


@pytest.mark.parametrize("seed", [0, *slowly(1)])
def test_a_carved_wound_is_found_and_its_skin_restored_better_than_by_a_thin_plate(seed: int) -> None:
    wound = thigh(seed)
    score, why = score_wound(wound, None)
    assert not why and score.iou > 0.9
    assert score.skin < 0.8 * wound.plate and np.rad2deg(score.tilt) < 3 and 0.85 < score.volume < 1.1


@pytest.mark.slow
def test_three_clicks_are_as_good_as_an_outline() -> None:
    wound = thigh(0)
    scan, _ = repair_mesh(wound.vertices, wound.triangles, "scan")
    clicked = find_wound(scan, 0.5, "scan", clicks=wound.rim[[10, 90, 170]]).findings
    found = find_wound(scan, 0.5, "scan").findings
    assert clicked.area == pytest.approx(found.area, rel=0.03)
    assert clicked.volume == pytest.approx(found.volume, rel=0.03)
    assert 0 < found.volume_sigma < 0.1 * found.volume


def two_pits(depths: tuple[float, float]) -> tuple[Array, Array]:
    """A scan with two pits alike, 40 mm apart; vertices, triangles."""
    n = 141
    x, y = np.meshgrid(np.linspace(-50, 50, n), np.linspace(-40, 40, n))
    z = -(x**2) / 300
    for middle, depth in zip((-20.0, 20.0), depths, strict=True):
        z = z - depth * np.clip((9 - np.hypot(x - middle, y)) / 1.5, 0, 1)
    number = np.arange(n * n).reshape(n, n)
    a, b, c, d = (m.ravel() for m in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    return points, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


@pytest.mark.slow
def test_two_wounds_alike_are_a_question_until_a_number_or_their_colour_tells() -> None:
    scan, _ = repair_mesh(*two_pits((3.0, 2.8)), "scan")
    with pytest.raises(WoundQuestionError, match="2 places") as caught:
        find_wound(scan, 0.5, "scan")
    middles = [place.outline.mean(axis=0)[0] for place in caught.value.places]
    assert sorted(round(m / 20) for m in middles) == [-1, 1]
    for number, middle in enumerate(middles, 1):
        assert find_wound(scan, 0.5, "scan", number=number).rim.mean(axis=0)[0] == pytest.approx(middle, abs=1.0)
    red = ScanColour(scan.vertices, (scan.vertices[:, 0] > 5).astype(float))
    assert find_wound(scan, 0.5, "scan", colour=red).rim.mean(axis=0)[0] == pytest.approx(20, abs=1.0)
    with pytest.raises(InputError, match="1 to 2"):
        find_wound(scan, 0.5, "scan", number=3)


@pytest.mark.slow
def test_a_question_is_a_page_with_pictures_and_no_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "scan.ply", *two_pits((3.0, 2.8)))
    out = tmp_path / "path.csv"
    command = [
        "plan",
        str(tmp_path / "scan.ply"),
        "-o",
        str(out),
        "--bead",
        "1.5",
        "--pattern",
        "zigzag",
        "--no-pictures",
    ]
    assert main(command) == 2
    told = capsys.readouterr().err
    assert "path_question.html" in told and "--wound NUMBER" in told and not out.exists()
    page = (tmp_path / "path_question.html").read_text(encoding="utf-8")
    assert page.count("data:image/png") == 3 and "--wound 2" in page and "http" not in page.replace("www.w3.org", "")
    assert main([*command, "--clicks=-29,0,-5.8/-20,9,-4.3/-11,0,-3.4"]) == 0
    middle = np.loadtxt(out, delimiter=",", skiprows=1, usecols=(0, 1)).mean(axis=0)
    assert middle[0] == pytest.approx(-20, abs=2)
    for wrong in ("1,2,3/4,5,6", "0,0,0/1,0,0/2,0,0", "a,b,c/1,2,3/4,5,6"):
        assert main([*command, "--force", f"--clicks={wrong}"]) == 2
    assert main([*command, "--force", "--wound", "1", "--clicks=0,0,0/9,0,0/0,9,0"]) == 2
    assert "more than one" in capsys.readouterr().err


def test_the_colours_of_a_ply_file_are_read(tmp_path: Path) -> None:
    points = np.array([[0.0, 0, 0], [30, 0, 0], [0, 30, 0], [30, 30, 1]])
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n"
    rows = "".join(f"{x:g} {y:g} {z:g} {10 * i} 200 30\n" for i, (x, y, z) in enumerate(points))
    text = head + "property list uchar int vertex_indices\nend_header\n" + rows + "3 0 1 2\n3 1 3 2\n"
    (tmp_path / "red.ply").write_text(text)
    colours = read_raw_mesh(tmp_path / "red.ply").colours
    assert colours is not None and colours.tolist() == [[10 * i, 200, 30] for i in range(4)]
    write_ply(tmp_path / "grey.ply", points, np.array([[0, 1, 2], [1, 3, 2]]))
    assert read_raw_mesh(tmp_path / "grey.ply").colours is None


def test_where_the_scan_lies_does_not_matter() -> None:
    wound = thigh(1)
    pose = se3.make(se3.exp_rotation(np.array([0.4, -1.1, 2.0])), np.array([120.0, -40, 900]))
    areas = []
    for vertices in (wound.vertices, se3.transform_points(pose, wound.vertices)):
        scan, _ = repair_mesh(vertices, wound.triangles, "scan")
        areas.append(find_wound(scan, 0.5, "scan").findings.area)
    assert areas[0] == pytest.approx(areas[1], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("apart", [0.6, 2.0])
def test_a_second_shell_under_the_first_changes_nothing(apart: float) -> None:
    vertices, triangles = two_pits((3.0, 0.0))
    alone = find_wound(repair_mesh(vertices, triangles, "scan")[0], 0.5, "scan").findings
    both = (
        np.concatenate([vertices, vertices - [0.0, 0.0, apart]]),
        np.concatenate([triangles, triangles + len(vertices)]),
    )
    doubled = find_wound(repair_mesh(*both, "scan")[0], 0.5, "scan").findings
    assert doubled.area == pytest.approx(alone.area, rel=0.02)
    assert doubled.volume == pytest.approx(alone.volume, rel=0.03)
    assert any("overhang" in note for note in doubled.notes) == (apart > 1)
