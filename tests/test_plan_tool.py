"""Plans keep the tool clear: laws of the tilts found, what is left out is told; scans that are not fit for plans."""

from __future__ import annotations

import json
from contextlib import redirect_stdout
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.scans.scan import scan_from_triangles
from estimation.se3 import Array
from hardware.cli.main import main
from hardware.files.mesh_file import write_ply
from hardware.files.path_file import read_path
from hardware.plan.order import PlanRequest, measured_amplitude, tool_of
from perception.frames import SYRINGE
from planning.clearance import BASE_MARGIN, ToolBody, tool_body
from planning.fill.bead import Pattern
from planning.layers.checkpoints import CheckpointSettings, ToolLimits
from planning.layers.clearing import LaidTissue, Mask, path_rooms, tilts_with_room
from planning.layers.plan import Plan, PlanOrder, make_plan, unscanned_beads
from planning.layers.repair import repair_mesh
from planning.layers.slicing import Tissue
from planning.layers.wound import find_wound
from tests.wound_scans import scan_of, wound_of

STUB = np.array([[0.0, 0.5], [2.5, 0.5], [3.2, 4.0], [40.0, 4.0]])  # a needle of 2.5 mm on a wide syringe
LONG = np.array([[0.0, 0.5], [60.0, 0.5], [61.0, 4.0], [90.0, 4.0]])
LIMITS = ToolLimits(np.deg2rad(30.0), np.deg2rad(5.0))
DEEP = ("forearm", (16.0, 14.0), 7.0)


def order(tool: ToolBody | None = None) -> PlanOrder:
    tissue = Tissue("flesh", None, "1", height=1.0)
    return PlanOrder((tissue,), Pattern("contour", 1.0), way=CheckpointSettings(tool=LIMITS), tool=tool)


@cache
def deep_plan(margin: float | None = BASE_MARGIN, needle: str = "stub") -> Plan:
    tool = None if margin is None else tool_body(STUB if needle == "stub" else LONG, (), margin)
    return make_plan(wound_of(*DEEP), order(tool))


def printed_length(plan: Plan) -> float:
    step = np.linalg.norm(np.diff(plan.points.tip, axis=0), axis=1)
    return float(step[plan.points.extrude[1:]].sum())


def test_where_the_tool_has_no_room_it_is_turned_or_the_bead_is_left_out_and_told() -> None:
    plan, free = deep_plan(), deep_plan(None)
    assert plan.clearance is not None and free.clearance is None
    tool = plan.order.tool
    assert tool is not None
    laid = LaidTissue(plan.wound, plan.stack, tool)
    upright, _ = laid.rooms(free.points.tip, free.points.tilt, free.points.layer)
    assert (upright < -0.2).any()  # or this shows nothing
    room, _ = laid.rooms(plan.points.tip, plan.points.tilt, plan.points.layer)
    assert room.min() >= 0
    assert plan.clearance.turned and 0 < plan.clearance.most <= 2 * LIMITS.tilt
    left = sum(each.length for each in plan.clearance.left_out)
    assert left == pytest.approx(printed_length(free) - printed_length(plan), abs=0.02 * printed_length(free) + 2.0)
    for each in plan.clearance.left_out:
        assert each.part == "syringe" and each.short > 0 and each.line is not None
        assert any(each.line is line for line in plan.layers[each.layer].left_out)


def test_tilts_keep_both_limits_and_beads_stay_where_they_are() -> None:
    plan = deep_plan()
    points = plan.points
    assert np.linalg.norm(points.tilt, axis=1).max() <= LIMITS.tilt + 1e-9
    way = np.linalg.norm(np.diff(points.tip, axis=0), axis=1)
    turn = np.linalg.norm(np.diff(points.tilt, axis=0), axis=1)
    along = points.extrude[1:]
    # the way of the places that tilts are chosen at is a little longer than that of the points between
    assert (turn[along] <= 1.15 * LIMITS.turning * way[along] + 1e-6).all()
    known = {tuple(tip) for tip in deep_plan(None).points.tip[deep_plan(None).points.width > 0].round(9)}
    assert all(tuple(tip) in known for tip in points.tip[points.width > 0].round(9))


def test_with_a_tool_that_is_clear_the_plan_is_the_one_without() -> None:
    plan, free = deep_plan(BASE_MARGIN, "long"), deep_plan(None)
    assert plan.clearance is not None and (plan.clearance.turned, plan.clearance.left_out) == (0, ())
    assert np.array_equal(plan.path.surface_from_nozzle, free.path.surface_from_nozzle)
    assert np.array_equal(plan.path.speed, free.path.speed)


@pytest.mark.slow
def test_more_motion_leaves_out_more() -> None:
    lengths = [printed_length(deep_plan(*more)) for more in ((), (BASE_MARGIN + 2.0,))]
    assert lengths[0] > lengths[1] > 0


@pytest.mark.slow
def test_a_tool_that_is_clear_nowhere_is_one_error() -> None:
    with pytest.raises(InputError, match="none over which the tool has room"):
        deep_plan(BASE_MARGIN + 5.0)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_the_tilts_found_are_allowed_free_and_smooth(seed: int) -> None:
    """Beads along random lines, over which the tool must lean away from a direction that wanders, by random amounts."""
    draw, count = np.random.default_rng(seed), 80
    tip = np.column_stack([np.arange(count) * 0.5, np.zeros((count, 2))])
    bead = np.repeat([0, 1], count // 2)
    angle = np.cumsum(draw.normal(0, 0.05, count)) + draw.uniform(0, 6)
    least = np.clip(np.cumsum(draw.normal(0, 0.02, count)) + draw.uniform(-0.2, 0.5), -1, 0.9)

    def room(rows: Array, tilt: Array) -> Array:
        return np.asarray(tilt[:, 0] * np.cos(angle[rows]) + tilt[:, 1] * np.sin(angle[rows]) - least[rows])

    def free(rows: Array, tilt: Array, mm: float) -> Mask:
        return np.asarray(room(rows, tilt) >= mm / 100)

    start = np.zeros((count, 2))
    tilt, out = tilts_with_room(tip, start, bead, room(np.arange(count), start), free, LIMITS)
    assert (np.linalg.norm(tilt, axis=1) <= LIMITS.tilt + 1e-9).all()
    assert (room(np.arange(count), tilt)[~out] >= 0).all()
    kept = ~out[1:] & ~out[:-1] & (np.diff(bead) == 0)
    assert (np.linalg.norm(np.diff(tilt, axis=0), axis=1)[kept] <= LIMITS.turning * 0.5 + 1e-9).all()
    assert out[least > LIMITS.tilt].all()
    for number in (0, 1):
        if (least[bead == number] <= 0).all():
            assert not tilt[bead == number].any() and not out[bead == number].any()


def written(folder: Path, vertices: Array, triangles: Array, name: str = "scan.ply") -> Path:
    write_ply(folder / name, vertices, triangles)
    return folder / name


ARM = "tool_mm = [[0, 0.5], [2.5, 0.5], [3.2, 4], [40, 4]]\n" + Path("data/arms/s6h4d.toml").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_commands_say_where_the_tool_has_no_room(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "arm.toml").write_text(ARM, encoding="utf-8")
    scan = written(tmp_path, *scan_of(*DEEP))
    line = ["plan", str(scan), "--bead", "1", "--no-pictures", "--tissue", "flesh=rest:1"]
    assert main([*line, "-o", str(tmp_path / "p.csv"), "--arm", str(tmp_path / "arm.toml")]) == 0
    told = capsys.readouterr().out
    note = next(text for text in told.splitlines() if text.startswith("note: tool: "))
    assert "omitted" in note and "the syringe is too near" in note and " mm" in note
    facts = json.loads((tmp_path / "p.json").read_text(encoding="utf-8"))["tool"]
    assert facts["margin_mm"] == BASE_MARGIN and facts["left_out"] and facts["turned_checkpoints"] > 0
    assert main([*line, "-o", str(tmp_path / "q.csv")]) == 0
    assert "tool" not in capsys.readouterr().out
    assert json.loads((tmp_path / "q.json").read_text(encoding="utf-8"))["tool"] is None
    # reach marks what the plan without a tool would have it print
    answers = {}
    for name in ("p", "q"):
        main(["reach", str(tmp_path / f"{name}.csv"), "--arm", str(tmp_path / "arm.toml"), "-o", str(tmp_path / name)])
        answers[name] = capsys.readouterr().out
        reasons = [row.split(",")[2] for row in (tmp_path / name / "reach.csv").read_text().splitlines()[1:]]
        marked = reasons.count("tool meets tissue")
        assert marked > 50 if name == "q" else marked < 30  # another grid over the same scan: hundredths of a mm
    assert "too near to the tissue" in answers["q"] and "the syringe at checkpoint" in answers["q"]
    # the scan of another place, and one that lies elsewhere
    far = written(tmp_path, scan_of(*DEEP)[0] + [400.0, 0, 0], scan_of(*DEEP)[1], "far.ply")
    reach = ["reach", str(tmp_path / "q.csv"), "--arm", str(tmp_path / "arm.toml"), "--scan", str(far)]
    assert main(reach) == 2
    assert "nothing of it at the path" in capsys.readouterr().err
    other = written(tmp_path, scan_of(*DEEP)[0] + [0.0, 0, 9.0], scan_of(*DEEP)[1], "other.ply")
    assert main([*reach[:-1], str(other)]) == 1
    assert "too near to the tissue" in capsys.readouterr().out


def sine(folder: Path, amplitude: float) -> Path:
    stamps = np.arange(0, 20, 0.05)
    rows = [f"{t:.3f} 10 20 {300 + amplitude * np.sin(1.5 * t):.6f} 0 0 0 1" for t in stamps]
    file = folder / f"breath_{amplitude:g}.tum"
    file.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return file


def test_the_margin_is_by_the_motion_that_is_given_or_measured(tmp_path: Path) -> None:
    motion = str(sine(tmp_path, 6.0))
    assert measured_amplitude(motion) == pytest.approx(6.0, abs=0.1)
    request = PlanRequest(tmp_path / "p.csv", arm=Path("data/arms/s6h4d.toml"), motion=motion)
    tool = tool_of(request)
    assert tool is not None and tool.margin == pytest.approx(BASE_MARGIN + 6.0, abs=0.1)
    assert tool_of(replace(request, motion=None, arm=None)) is None
    told = replace(request, motion=None, settings=replace(request.settings, amplitude_mm=2.5))
    tool = tool_of(told)
    assert tool is not None and tool.margin == BASE_MARGIN + 2.5
    for wrong, words in (
        (replace(told, arm=None), "--amplitude-mm"),
        (replace(request, arm=None), "--motion"),
        (replace(told, motion=motion), "--motion"),
        (replace(request, motion=str(sine(tmp_path, 6e5))), "of tissue, not of a camera"),
        (replace(request, motion=str(sine(tmp_path, 0.006))), "in mm, not m"),
    ):
        with pytest.raises(InputError, match=words):
            tool_of(wrong)


def test_beads_over_what_was_not_scanned_are_told() -> None:
    vertices, triangles = scan_of()
    centre = vertices[triangles].mean(axis=1)
    wound = wound_of()
    middle = se3.transform_points(wound.surface_from_plane, np.array([[3.0, 2.0, 0.0]]))[0]
    whole = make_plan(wound, order())
    assert unscanned_beads(whole) == []
    kept = triangles[np.linalg.norm((centre - middle)[:, :2], axis=1) > 3.5]
    holed = find_wound(repair_mesh(vertices, kept, "scan")[0], 0.4, "scan", wound.rim)
    (found,) = unscanned_beads(make_plan(holed, order()))
    assert found.hole and found.length > 3 and np.linalg.norm((found.place - middle)[:2]) < 3.5
    flat = replace(wound, scanned=wound.scanned & (wound.grid.nodes[..., 0] < 5.0))
    (beyond,) = unscanned_beads(replace(whole, wound=flat))
    assert not beyond.hole and beyond.length > 10
    assert se3.transform_points(se3.inverse(wound.surface_from_plane), beyond.place[None])[0, 0] > 5.9


def test_room_along_a_path_file_is_the_plans(tmp_path: Path) -> None:
    plan = deep_plan(None)
    vertices, triangles = scan_of(*DEEP)
    body = tool_body(STUB)
    room, part = path_rooms(scan_from_triangles(vertices, triangles), plan.path, body)
    laid, _ = LaidTissue(plan.wound, plan.stack, body).rooms(plan.points.tip, plan.points.tilt, plan.points.layer)
    own = np.minimum(laid[: len(room)], 0)
    assert len(room) == len(laid) and np.abs(np.minimum(room, 0) - own).max() < 0.5
    assert set(part) <= {"", "syringe"} and (room < 0).sum() == pytest.approx((laid < 0).sum(), rel=0.3)


# -- scans that are not fit to plan on: each one error, or one honest verdict


def plan_line(folder: Path, vertices: Array, triangles: Array) -> list[str]:
    scan = written(folder, vertices, triangles)
    return ["plan", str(scan), "-o", str(folder / "p.csv"), "--bead", "1", "--no-pictures", "--pattern", "zigzag"]


def answer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], vertices: Array, triangles: Array
) -> tuple[int, str, str]:
    code = main([*plan_line(tmp_path, vertices, triangles), "--force"])
    told = capsys.readouterr()
    errors = [text for text in told.err.splitlines() if text.startswith("stillbed: ")]
    assert "Traceback" not in told.err and len(errors) == (1 if code == 2 else 0)
    return code, told.out, "".join(errors)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Array]:
    """What is said of the scan as it is, and the nozzle's poses (N, 4, 4) on its path."""
    folder = tmp_path_factory.mktemp("plain")
    with redirect_stdout(StringIO()) as said:
        assert main(plan_line(folder, *scan_of())) == 0
    return said.getvalue(), read_path(folder / "p.csv").surface_from_nozzle


@pytest.mark.slow
def test_two_shells_one_under_the_other_are_planned_as_the_upper_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], plain: tuple[str, Array]
) -> None:
    vertices, triangles = scan_of()
    one = plain[0].splitlines()[0].split(";")[0]
    under = np.concatenate([vertices, vertices - [0, 0, 1.5]]), np.concatenate([triangles, triangles + len(vertices)])
    both, out, _ = answer(tmp_path, capsys, *under)
    assert both == 0 and out.splitlines()[0].split(",")[0] == one.split(",")[0]
    assert "lie under overhangs" in out


def test_two_shells_that_face_apart_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vertices, triangles = scan_of()
    back = (triangles + len(vertices))[:, ::-1]
    both = np.concatenate([vertices, vertices - [0, 0, 8.0]]), np.concatenate([triangles, back])
    code, _, error = answer(tmp_path, capsys, *both)
    assert code == 2 and "seen from one side" in error


@pytest.mark.slow
def test_a_scan_a_quarter_turn_off_is_planned_in_its_own_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], plain: tuple[str, Array]
) -> None:
    vertices, triangles = scan_of()
    turn = se3.exp_rotation(np.array([0.0, np.pi / 2, 0.0]))
    code, out, _ = answer(tmp_path, capsys, vertices @ turn.T, triangles)
    assert code == 0
    for nozzle, up in ((plain[1], [0, 0, 1.0]), (read_path(tmp_path / "p.csv").surface_from_nozzle, [1.0, 0, 0])):
        assert nozzle[:, :3, 2].mean(axis=0) @ up > 0.9
    assert float(out.split()[1]) == pytest.approx(float(plain[0].split()[1]), rel=0.02)


def noise(count: int) -> tuple[Array, Array]:
    corners = np.random.default_rng(0).uniform(0, 100, (3 * count, 3))
    return corners, np.arange(3 * count).reshape(-1, 3)


@pytest.mark.parametrize("count", [5_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_triangles_of_noise_are_one_error(count: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, error = answer(tmp_path, capsys, *noise(count))
    assert code == 2 and error.isprintable()


@pytest.mark.slow
def test_skin_that_is_nothing_but_rough_has_no_wound(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vertices, triangles = scan_of()
    rough = np.column_stack([vertices[:, :2], np.random.default_rng(0).normal(0, 3, len(vertices))])
    code, _, error = answer(tmp_path, capsys, rough, triangles)
    assert code == 2 and error.isprintable()


@pytest.mark.slow
def test_a_syringe_over_the_examples_is_clear() -> None:
    """The default tool needs no turn over an ordinary wound: else every plan with an arm would change."""
    plan = make_plan(wound_of("chest"), order(tool_body(SYRINGE)))
    assert plan.clearance is not None and (plan.clearance.turned, plan.clearance.left_out) == (0, ())
