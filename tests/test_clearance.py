"""The tool as a body and its room: laws of the distances, of the guard, and of arm files' parts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.files.arm_file import arm_from_text, arm_text, read_arm, tool_body_of
from hardware.files.mesh_file import write_ply
from hardware.files.path_file import tissue_from_text, tissue_text
from hardware.motion.step import MotionStep
from perception.frames import SYRINGE
from planning.clearance import (
    BASE_MARGIN,
    Envelope,
    TissueGuard,
    ToolBody,
    ToolPart,
    envelope_over,
    rooms,
    tool_body,
)
from planning.command import MotionLimits, Move, Refusal, RefusalCode
from planning.kinematics import SimpleArm, axes_from_nozzle
from planning.motion.guard import Guard
from tests.moving_surfaces import breathing, path_through, pose_at

STEP = 0.5
PARTS = (
    ToolPart("head", "box", np.array([[-12.0, -9, 40], [20, 9, 90]]), np.zeros(2)),
    ToolPart("hose", "capsule", np.array([[8.0, 0, 35], [30, 5, 80]]), np.array([3.0, 3.0])),
    ToolPart("nut", "cone", np.array([[0.0, 0, 30], [0, 0, 40]]), np.array([6.0, 9.0])),
)


def hills(seed: int, height: float = 4.0) -> tuple[Array, Array]:
    """Random heights over a square of 30 mm, its nodes STEP apart, and the triangles (T, 3, 3) between them."""
    draw = np.random.default_rng(seed)
    x = np.arange(0, 30 + STEP / 2, STEP)
    u, v = np.meshgrid(x, x)
    waves = [(draw.uniform(0.1, 0.5, 2), draw.uniform(0, 6, 2), draw.uniform(0.2, 1)) for _ in range(4)]
    z = height * sum(a * np.sin(k[0] * u + p[0]) * np.sin(k[1] * v + p[1]) for k, p, a in waves) / 2
    nodes = np.stack([u, v, z], axis=-1)
    a, b, c, d = nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, 1:], nodes[1:, :-1]
    return z, np.concatenate([np.stack([a, b, c], 2), np.stack([a, c, d], 2)]).reshape(-1, 3, 3)


def distance_to(triangles: Array, point: Array) -> float:
    """Distance of a point (3,) to triangles (T, 3, 3), by every triangle, edge and corner (Ericson 2005, 5.1.5)."""
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    n = np.cross(ab, ac)
    s = np.einsum("ti,ti->t", np.cross(point - a, ac), n) / np.einsum("ti,ti->t", n, n)
    t = np.einsum("ti,ti->t", np.cross(ab, point - a), n) / np.einsum("ti,ti->t", n, n)
    inside = (s >= 0) & (t >= 0) & (s + t <= 1)
    plane = np.abs(np.einsum("ti,ti->t", point - a, n)) / np.linalg.norm(n, axis=1)
    edges = np.full(len(a), np.inf)
    for i in range(3):
        start, way = triangles[:, i], triangles[:, (i + 1) % 3] - triangles[:, i]
        share = np.clip(np.einsum("ti,ti->t", point - start, way) / np.einsum("ti,ti->t", way, way), 0, 1)
        edges = np.minimum(edges, np.linalg.norm(point - start - share[:, None] * way, axis=1))
    return float(np.where(inside, plane, edges).min())


@pytest.mark.parametrize("shape", [(7, 5, 6), (1, 5, 6), (4, 1, 2)])
def test_between_nodes_a_distance_is_linear_and_beside_them_that_of_the_edge(shape: tuple[int, int, int]) -> None:
    draw = np.random.default_rng(2)
    distance = draw.normal(size=shape).astype(np.float32)
    envelope = Envelope(se3.exp(draw.normal(size=6)), np.array([3.0, -2.0, 1.0]), STEP, distance, 0.0)
    nodes = draw.uniform(-2, 9, (500, 3))
    nodes[:100] = np.rint(nodes[:100])
    nodes_from_surface = envelope.nodes_from_surface
    points = (nodes - nodes_from_surface[:3, 3]) @ np.linalg.inv(nodes_from_surface[:3, :3]).T
    expected = map_coordinates(distance, nodes.T, np.float64, 1, "nearest", prefilter=False)
    assert np.abs(envelope.at(points) - expected).max() < 1e-12


def tissue(z: Array, reach: float = 12.0) -> Envelope:
    return envelope_over(np.eye(4), np.zeros(2), STEP, z, reach)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_a_signed_distance_agrees_with_brute_force(seed: int) -> None:
    z, triangles = hills(seed)
    draw = np.random.default_rng(seed + 1)
    points = np.column_stack([draw.uniform(8, 22, (20, 2)), draw.uniform(-5, 12, 20)])
    low = z[np.clip((points[:, 1] / STEP).astype(int), 0, 59), np.clip((points[:, 0] / STEP).astype(int), 0, 59)]
    found = tissue(z).at(points)
    brute = np.array([distance_to(triangles, point) for point in points])
    deep = points[:, 2] < low - 0.5
    known = brute < 6  # the grid tells no more of what is deeper
    assert np.abs(np.abs(found) - brute)[known].max() < STEP
    assert (found[deep & known] < STEP / 2).all() and (found[points[:, 2] > low + 2] > 0).all()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 8.0), st.floats(0.0, 0.5))
def test_a_tool_moved_away_only_gains_room(seed: int, way: float, lean: float) -> None:
    z, _ = hills(seed)
    body, envelope = tool_body(SYRINGE, PARTS), tissue(z, 20.0)
    at = se3.make(se3.exp_rotation(np.array([lean, 0.0, 0.0])), np.array([15.0, 15.0, 0.0]))
    away = se3.make(np.eye(3), np.array([0.0, 0.0, way])) @ at
    (before, after), _ = rooms(body, envelope, np.stack([at, away]), np.inf)
    assert after >= before - 1e-5


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_room_has_the_sign_that_every_ball_of_the_tool_gives(seed: int) -> None:
    """What is clear by the balls around groups is clear, and what is not is so by a ball of the named part."""
    z, _ = hills(seed, 12.0)
    body, envelope, draw = tool_body(SYRINGE, PARTS), tissue(z, 20.0), np.random.default_rng(seed)
    poses = se3.make(se3.exp_rotation(draw.normal(size=(30, 3)) * 0.4), draw.uniform([5, 5, -4], [25, 25, 9], (30, 3)))
    room, part = rooms(body, envelope, poses)
    whole, named = rooms(body, envelope, poses, np.inf)
    signed, _ = rooms(body, envelope, poses, 0.0, sign=True)
    assert ((room < 0) == (whole < 0)).all() and ((signed < 0) == (whole < 0)).all()
    assert room[whole < 0] == pytest.approx(whole[whole < 0]) and (room <= whole + 1e-9).all()
    assert (part[whole < 0] == named[whole < 0]).all()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_what_is_quickly_found_clear_has_room(seed: int) -> None:
    guard, draw = (
        TissueGuard(tool_body(SYRINGE, PARTS, 0.0, 1.0), tissue(hills(seed)[0], 20.0)),
        np.random.default_rng(seed),
    )
    poses = se3.make(
        se3.exp_rotation(draw.normal(size=(60, 3)) * 0.3), draw.uniform([-9, -9, -9], [39, 39, 40], (60, 3))
    )
    quick = np.array([guard.clear(pose) for pose in poses])
    assert (rooms(guard.body, guard.envelope, poses, np.inf)[0][quick] >= 0).all()
    assert quick.any() and not quick.all()


def points_on(body_parts: tuple[ToolPart, ...], seed: int) -> Array:
    """Random places (N, 3) on the parts' surfaces."""
    draw, found = np.random.default_rng(seed), []
    for part in body_parts:
        triangles = part.triangles()
        weights = draw.dirichlet(np.ones(3), len(triangles))
        found.append(np.einsum("tk,tki->ti", weights, triangles))
    return np.concatenate(found)


@settings(max_examples=10)
@given(st.integers(0, 1000))
def test_balls_cover_the_tool(seed: int) -> None:
    body = tool_body(SYRINGE, PARTS)
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi, 60)
    height = np.linspace(0, SYRINGE[-1, 0], 60)
    radius = np.interp(height, *SYRINGE.T)
    turned = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    surface = np.concatenate([turned[height > 13.0], points_on(PARTS, seed)])
    off = np.linalg.norm(surface[:, None] - body.balls.centres, axis=2) - body.balls.radii
    assert off.min(axis=1).max() < 1e-6
    low, high = body.first[:-1], body.first[1:]
    for k, (a, b) in enumerate(zip(low, high, strict=True)):
        own = body.order[a:b]
        far = np.linalg.norm(body.balls.centres[own] - body.groups.centres[k], axis=1) + body.balls.radii[own]
        assert (far + body.balls.keep[own]).max() <= body.groups.radii[k] + 1e-9


def test_a_round_part_is_a_cylinder_and_no_more_than_its_ball_wider() -> None:
    part = ToolPart("rod", "cylinder", np.array([[0.0, 0, 20], [0, 0, 60]]), np.array([5.0, 5.0]))
    reach = np.linalg.norm(part.triangles()[..., :2], axis=2)
    assert 5.0 <= reach.max() <= 5.2
    capsule = replace(part, kind="capsule").triangles()
    assert capsule[..., 2].min() == pytest.approx(15, abs=0.15) and capsule[..., 2].max() == pytest.approx(65, abs=0.15)


FLAT = np.zeros((161, 161))
PIT = np.where(np.hypot(*np.meshgrid(*[np.arange(161) * STEP - 40] * 2)) < 7.0, -16.0, 0.0)  # 14 mm wide, 16 mm deep
LIMITS = MotionLimits(low=np.array([-400.0, -400, -400, -1, -1, -1]), high=np.array([400.0, 400, 400, 1, 1, 1]))
TICK = 0.02


def guarded(heights: Array, base_from_nozzle: Array) -> tuple[Guard, SimpleArm]:
    """A guard whose arm stands at a pose (4, 4) over tissue whose middle is the surface frame's origin."""
    body = tool_body(SYRINGE, (), margin=0.0, touch=1.0)
    guard = TissueGuard(body, envelope_over(np.eye(4), np.array([-40.0, -40]), STEP, heights, 15.0))
    arm = SimpleArm()
    arm = replace(arm, home=axes_from_nozzle(arm, base_from_nozzle))
    return Guard(LIMITS, arm, TICK, tissue=guard), arm


def tracked(shift: float = 0.0, speed: float = 0.0) -> SurfacePose:
    still = se3.make(np.eye(3), np.array([0.0, 0.0, shift]))
    twist = np.array([0.0, 0, 0, 0, 0, speed])
    return SurfacePose(1.0, still, 1e-6 * np.eye(6), twist, TrackState.TRACKING)


def move_to(arm: SimpleArm, base_from_nozzle: Array) -> Move:
    return Move(1.0, axes_from_nozzle(arm, base_from_nozzle), 50.0, 0, False)


def upright(x: float, z: float, lean: float = 0.0) -> Array:
    return se3.make(se3.exp_rotation(np.array([0.0, lean, 0.0])), np.array([x, 0.0, z]))


def test_the_guard_keeps_the_syringe_off_the_rim_of_a_deep_wound_and_lets_it_out_again() -> None:
    """In the middle of the pit the needle reaches 14 mm down; nearer to its rim the syringe's hub would meet it."""
    guard, arm = guarded(PIT, upright(0.0, -14.0))
    assert isinstance(guard(move_to(arm, upright(1.0, -14.0)), tracked(), 1.0), Move)
    guard, arm = guarded(PIT, upright(3.5, -14.4))
    answer = guard(move_to(arm, upright(5.5, -14.4)), tracked(), 1.0)
    assert isinstance(answer, Refusal) and answer.code is RefusalCode.CLEARANCE
    assert "syringe would be" in answer.reason and answer.got > 0.4
    inside, arm = guarded(PIT, upright(5.5, -14.4))  # the tissue has come over it: deeper is refused, out is free
    assert isinstance(inside(move_to(arm, upright(5.6, -14.6)), tracked(), 1.0), Refusal)
    assert isinstance(inside(move_to(arm, upright(5.3, -13.4)), tracked(), 1.0), Move)


def test_the_guard_looks_where_the_tissue_will_be() -> None:
    """A surface that rises meets a tool that would have been clear of it at rest."""
    place = upright(0.0, -0.5)  # the needle may be 1.5 mm in the tissue
    for speed, passes in ((0.0, True), (49.0, False)):
        guard, arm = guarded(FLAT, place)
        guard.lag = 0.03
        answer = guard(move_to(arm, upright(0.5, -0.5)), tracked(speed=speed), 1.0)
        assert isinstance(answer, Move) is passes


def test_without_a_scan_the_guard_knows_of_no_tissue() -> None:
    _, arm = guarded(FLAT, upright(0, -9.0))
    assert isinstance(Guard(LIMITS, arm, TICK)(move_to(arm, upright(1.0, -9.0)), tracked(), 1.0), Move)


@pytest.mark.parametrize("state", [TrackState.COASTING, TrackState.LOST])
def test_without_a_trusted_pose_the_arm_may_come_to_rest(state: TrackState) -> None:
    guard, arm = guarded(FLAT, upright(0, -9.0))
    answer = guard(move_to(arm, upright(0.5, -9.0)), replace(tracked(), state=state), 1.0)
    assert not (isinstance(answer, Refusal) and answer.code is RefusalCode.CLEARANCE)


def test_what_a_recording_keeps_of_the_tissue_is_the_same_to_the_bit() -> None:
    tissue_of = TissueGuard(tool_body(SYRINGE, PARTS, 0.0, 1.0), tissue(hills(3)[0]))
    moved = tissue_of.moved(se3.exp(np.array([0.1, 0.2, 0.3, 4.0, 5.0, 6.0])))
    back = tissue_from_text(tissue_text(moved), "run.mcap")
    poses = se3.exp(np.random.default_rng(1).normal(size=(50, 6)) * 4)
    assert (rooms(back.body, back.envelope, poses)[0] == rooms(moved.body, moved.envelope, poses)[0]).all()
    text = tissue_text(moved)
    for bad in (text[:-9], text.replace('"', "", 3), "{}", text.replace("<f8", "<f4"), "[1, 2]"):
        with pytest.raises(InputError, match="tissue"):
            tissue_from_text(bad, "run.mcap")


def written(text: str, tmp_path: Path) -> ArmProfile:
    file = tmp_path / "arm.toml"
    file.write_text(text, encoding="utf-8")
    return read_arm(file)


PART_TEXT = """
[[tool_part]]
name = "head"
box = [[-20, -30, 60], [40, 30, 120]]
[[tool_part]]
name = "hose"
capsule = [[8, 0, 35], [30, 5, 80]]
radius = 3
[[tool_part]]
name = "nut"
cone = [[0, 0, 30], [0, 0, 40]]
radii = [6, 9]
[[tool_part]]
name = "bracket"
mesh = "bracket.ply"
"""


def test_parts_of_an_arm_file_come_back_and_are_a_body(tmp_path: Path) -> None:
    corners = np.array([[0.0, 0, 50], [40, 0, 50], [0, 40, 50], [0, 0, 90]])
    write_ply(tmp_path / "bracket.ply", corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    profile = written(PART_TEXT, tmp_path)
    again = arm_from_text(arm_text(profile), "again")
    for a, b in zip(profile.parts, again.parts, strict=True):
        assert (a.name, a.kind, a.file) == (b.name, b.kind, b.file)
        assert np.array_equal(a.ends, b.ends) and np.array_equal(a.radii, b.radii)
    body = tool_body_of(profile)
    assert body.names == ("needle", "syringe", "head", "hose", "nut", "bracket")
    assert np.isin(np.arange(6), body.part).all() and body.margin == BASE_MARGIN


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('name = "x"\nbox = [[0, 0, 1], [1, 1, 2]]\nradius = 3', "one of box, cylinder and capsule with radius"),
        ('name = "x"\ncylinder = [[0, 0, 1], [1, 1, 2]]', "one of box"),
        ('name = "x"\ncylindre = [[0, 0, 1], [1, 1, 2]]', "did you mean 'cylinder'"),
        ('name = "x"\ncylinder = [[0, 0, 1], [0, 0, 1]]\nradius = 2', "two ends apart"),
        ('name = "x"\ncylinder = [[0, 0, 0.01], [0, 0, 0.05]]\nradius = 0.01', "the unit is mm, not m"),
        ('name = "x"\nbox = [[0, 0, 1], [1, 1, 5000]]', "within 1000 mm of the tip"),
        ('name = "x"\ncone = [[0, 0, 1], [0, 0, 9]]\nradii = [2, -1]', "across or more"),
        ('name = "x"\nbox = [0, 1, 2]', "tool_part.box"),
        ("box = [[0, 0, 1], [1, 1, 2]]", "name"),
    ],
)
def test_what_is_wrong_with_a_part_is_told(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as told:
        written("[[tool_part]]\n" + text, tmp_path)
    assert words in str(told.value) and "\n" not in str(told.value) and "arm.toml" in str(told.value)


def test_a_part_below_the_tip_and_a_mesh_that_is_not_there_are_refused(tmp_path: Path) -> None:
    low = written('[[tool_part]]\nname = "x"\nbox = [[0, 0, -3], [5, 5, 2]]', tmp_path)
    with pytest.raises(InputError, match="3 mm below the tip"):
        tool_body_of(low)
    absent = written('[[tool_part]]\nname = "x"\nmesh = "none.stl"', tmp_path)
    with pytest.raises(InputError, match="no such file"):
        tool_body_of(absent)


@pytest.mark.parametrize("name", ["s6h4d", "fr3", "six_axis"])
def test_the_arms_that_come_along_have_a_tool(name: str) -> None:
    body: ToolBody = tool_body_of(read_arm(f"data/arms/{name}.toml"))
    assert body.names[:2] == ("needle", "syringe") and len(body.balls.radii) > 500


WAY = np.array([[0.0, 0, 1], [20, 0, 1], [20, 1, 1]])


@pytest.mark.slow
def test_a_motion_stands_before_a_wall_and_says_why() -> None:
    """A path that runs into tissue, on a surface that breathes: the syringe, 4.8 mm wide, stays off it."""
    x = np.arange(121) * STEP - 30
    wall = np.where(np.meshgrid(x, x)[0] > 12.0, 30.0, -1.0)
    over = envelope_over(np.eye(4), np.array([-30.0, -30]), STEP, wall, 20.0)
    motion = MotionStep(path_through(WAY, 8.0), tissue=TissueGuard(tool_body(SYRINGE, (), 0.0, 0.0), over))
    instants = 10.0 + 0.02 * np.arange(500)
    answers = [motion(pose_at(breathing, now), now) for now in instants.tolist()]
    refused = [answer for answer in answers if isinstance(answer, Refusal)]
    assert {answer.code for answer in refused} == {RefusalCode.CLEARANCE} and len(refused) > 50
    assert all("the syringe would be" in answer.reason for answer in refused)
    assert 4.0 < motion.progress.place < 12.0 - 4.8
    free = MotionStep(path_through(WAY, 8.0))
    assert any(free(pose_at(breathing, now), now) and free.progress.place > 20.0 for now in instants.tolist())
