"""A look at what was laid: the path rests for it, the needle goes aside, gel keeps its volume, looks are recorded."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import wait
from contextlib import ExitStack
from dataclasses import fields, replace
from pathlib import Path as File
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceHeights, SurfaceMap
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.arm.profile import ArmProfile
from hardware.motion.step import MotionStep
from hardware.offline.looks import LiveLooks, SurfaceLooks, look_at, look_picture, looks_section, read_looks
from hardware.process.clock import SimClock
from hardware.process.faults import fault_from_text
from hardware.recording.messages import message_from_look
from hardware.recording.recorder import Recorder
from hardware.simulator.material import SimulatedDispensers
from hardware.simulator.scenario import read_scenario
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.fields import Gel, GelPieces, Layers, PrintedBeads
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState
from hardware.simulator.scene.shape import Wound, body
from hardware.simulator.truth import divide_path
from perception.frames import Frame, FrameSet
from perception.lens import Lenses
from perception.mapping.features import grey
from perception.mapping.first_map import FirstMap
from perception.mapping.scan_map import relief_points
from perception.mapping.surface_heights import (
    SurfaceView,
    _GroundView,
    dense_heights,
    first_heights,
    matte,
)
from planning.command import LOOKS, Hold, Move
from planning.kinematics import nozzle_from_axes
from planning.laid_beads import (
    MAX_FLOW,
    MIN_FLOW,
    BeadPieces,
    LaidBeads,
    Look,
    Stations,
    adapted_flow,
    bead_heights,
    judge_beads,
    pieces_between,
    with_looks,
)
from planning.material import AS_PLANNED, FlowShares
from planning.motion.guard import Guard
from planning.motion.planner import Planner
from planning.path import LOOK, Path, PrintPhase, PrintProgress
from tests import simulated_worlds
from tests.moving_surfaces import path_through, pose_at, still
from tests.slow_cases import slowly
from tests.test_planner import CLOSE, LIMITS

TICK, START = 0.02, 10.0  # s
WIDTH, HEIGHT = 1.6, 0.4  # mm of the planned beads


def layers(count: int = 2, beads: int = 2) -> Path:
    """Beads of 8 mm, some to a layer, as a planner gives them."""
    points = [[x, WIDTH * k, HEIGHT * n] for n in range(count) for k in range(beads) for x in ((-4, 4), (4, -4))[k % 2]]
    path = path_through(np.array(points, float), 10.0)
    amounts = {"width_mm": np.full(len(path), str(WIDTH)), "height_mm": np.full(len(path), str(HEIGHT))}
    return replace(
        path, extrude=np.arange(len(path)) % 2 == 1, layer=np.arange(len(path)) // (2 * beads), extra=amounts
    )


def test_a_look_is_asked_for_before_all_and_after_each_layer_or_some_beads() -> None:
    path = layers(2, 3)
    assert np.flatnonzero(with_looks(path).extra["look"] == 1).tolist() == [0, 5, 11]
    assert np.flatnonzero(with_looks(path, 2).extra["look"] == 1).tolist() == [0, 3, 7, 11]
    divided = divide_path(with_looks(path), 1.0)
    looks = np.flatnonzero(divided.extra["look"] == 1)
    assert np.allclose(divided.surface_from_nozzle[looks, :3, 3], path.surface_from_nozzle[[0, 5, 11], :3, 3])


def test_the_needle_goes_aside_for_each_look_and_lays_all_beads() -> None:
    path = with_looks(layers())
    planner, guard = Planner(path, LIMITS, CLOSE, TICK), Guard(LIMITS, CLOSE, TICK, path.zone)
    high, asides, printed, axes = path.zone[1], [], set(), CLOSE.home
    for k in range(6000):
        now = START + k * TICK
        pose = pose_at(still, now)
        command = planner(pose, now)
        assert guard(command, pose, now) is command
        if isinstance(command, Move):
            axes = command.axes
            printed |= {command.checkpoint} if command.extrude else set()
        elif command.reason == LOOKS and planner.progress.wanted == LOOK:
            tip = (se3.inverse(still(now)) @ nozzle_from_axes(CLOSE, axes))[:3, 3]
            asides.append((tip, planner.progress.fraction))
            planner.material_in()
        if planner.progress.phase is PrintPhase.FINISHED:
            break
    assert planner.progress.phase is PrintPhase.FINISHED and printed == {1, 3, 5, 7}
    assert [round(fraction, 3) for _, fraction in asides] == [0, 3, 7]
    for tip, _ in asides:
        assert max(tip[0] - high[0], path.zone[0][0] - tip[0]) > 24 and tip[2] > high[2] + 5


@pytest.mark.slow
@pytest.mark.parametrize("asked", [150, *slowly(400)])  # on its way up, and at rest above
def test_in_a_pause_the_needle_goes_aside_when_somebody_looks_and_lays_the_rest_once(asked: int) -> None:
    path = layers()
    step = MotionStep(path, replace(ArmProfile(), limits=LIMITS, arm=CLOSE, tick=TICK))
    printed, aside, axes = [], [], CLOSE.home
    for k in range(6000):
        now = START + k * TICK
        step.paused = 140 <= k < 800
        step.aside = asked <= k < 700
        command = step(pose_at(still, now), now)
        if isinstance(command, Move):
            axes = command.axes
            printed += [command.checkpoint] if command.extrude and command.checkpoint not in printed else []
        elif command.reason == LOOKS:
            assert step.progress.wanted == LOOK
            aside.append((se3.inverse(still(now)) @ nozzle_from_axes(CLOSE, axes))[:3, 3])
        if step.progress.phase is PrintPhase.FINISHED:
            break
    low, high = path.zone
    assert printed == [1, 3, 5, 7] and len(aside) > 100 and step.progress.wanted == ""
    assert all(max(tip[0] - high[0], low[0] - tip[0]) > 24 and tip[2] > high[2] + 5 for tip in aside)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.54), st.floats(0.0, 5.0))
def test_gel_keeps_its_volume_while_it_sags(seed: int, aspect: float, later: float) -> None:
    beads, rng = PrintedBeads(layer_of(40.0, 40.0), Gel(aspect, 1.0)), np.random.default_rng(seed)
    way = np.cumsum(rng.normal(0, 0.4, (12, 2)), axis=0)
    way *= np.minimum(1, 8 / np.abs(way).max())
    volume = rng.uniform(0, 0.3, 11)
    beads.flow(GelPieces(way[:-1], way[1:], volume, rng.uniform(0.1, 1.0, 11)), 1.0)
    assert beads.volume() == pytest.approx(volume.sum(), rel=1e-4)
    fresh = float(beads.heights((30.0, 30.0), 0.25).max())
    beads.flow(none_left(), 1.0 + later)
    assert beads.volume() == pytest.approx(volume.sum(), rel=1e-4)
    assert float(beads.heights((30.0, 30.0), 0.25).max()) <= fresh * 1.001  # it sags, it does not rise


def test_a_straight_bead_at_rest_is_the_parabola_that_its_volume_gives() -> None:
    beads, area = PrintedBeads(layer_of(40.0, 20.0), Gel(0.3, 0.1)), 0.64
    x = np.arange(-10, 10.01, 0.1)
    way = np.column_stack([x, np.zeros_like(x)])
    beads.flow(GelPieces(way[:-1], way[1:], np.full(len(x) - 1, 0.1 * area), np.full(len(x) - 1, area)), 0.0)
    beads.flow(none_left(), 5.0)
    height = beads.heights((30.0, 10.0), 0.1)
    y, across = np.linspace(-5, 5, height.shape[0]), height[:, height.shape[1] // 2]
    width = np.sqrt(1.5 * area / 0.3)
    assert across == pytest.approx(0.3 * width * np.maximum(1 - (2 * y / width) ** 2, 0), abs=0.03)
    assert not PrintedBeads(layer_of(40.0, 20.0)).heights((30.0, 10.0), 0.1).any()  # ink has no height


def layer_of(x: float, y: float, texel: float = 0.1) -> Layers:
    """A bare texture about the origin."""
    blank = np.zeros((round(y / texel / 8) * 8, round(x / texel / 8) * 8, 4), np.float32)
    return Layers(blank, blank.copy(), texel, (-x / 2, -y / 2))


def none_left() -> GelPieces:
    """Nothing leaves the needle."""
    return GelPieces(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))


def test_a_clogged_needle_holds_its_share_back_and_a_wrong_pump_gives_another_flow(tmp_path: File) -> None:
    clog = fault_from_text("test", "fault", "dispenser clog 75% at 2s for 1s")
    assert str(clog) == "dispenser clog 75% at 2s for 1s".replace("75%", "75%")
    dispensers = SimulatedDispensers(layers(), None, SimClock(), (clog,))
    dispensers.models[0].receive(b"ON 1\n", 0.5)
    instants, needed = np.array([0.1, 1.0, 2.5, 3.5]), np.full(4, 4.0)
    assert dispensers.flow(instants, needed) == pytest.approx([0.0, 4.0, 1.0, 4.0])
    file = simulated_worlds.write_scenario(tmp_path, simulated_worlds.IDEAL, {"dispenser": {"given": 1.25}})
    scenario = read_scenario(file)
    assert scenario.dispenser is not None and scenario.dispenser.flow_share == 1.25
    for value in (0.0, -1.0, 9.0):
        file = simulated_worlds.write_scenario(tmp_path, simulated_worlds.IDEAL, {"dispenser": {"given": value}})
        with pytest.raises(InputError, match=r"dispenser\.given"):
            read_scenario(file)


@pytest.mark.parametrize(
    ("top", "key"),
    [
        *[({"look": often}, "look") for often in ("often", 0, True)],
        ({"adapt": True}, "adapt"),
        ({"look": 1, "adapt": "yes"}, "adapt"),
    ],
)
def test_a_look_that_makes_no_sense_is_refused(top: dict[str, object], key: str, tmp_path: File) -> None:
    with pytest.raises(InputError, match=key):
        read_scenario(simulated_worlds.write_scenario(tmp_path, simulated_worlds.IDEAL, **top))


@pytest.mark.parametrize(("key", "value"), [("aspect", 0.9), ("sag_s", 0.0), ("gloss", 1.5), ("glossy", 1.0)])
def test_a_gel_that_makes_no_sense_is_refused(key: str, value: float, tmp_path: File) -> None:
    with pytest.raises(InputError, match=f"gel.*{key}"):
        read_scenario(simulated_worlds.write_scenario(tmp_path, simulated_worlds.IDEAL, {"gel": {key: value}}))


def some_look(gap: bool = True) -> Look:
    """A look at two beads, one of which is not there."""
    start = np.array([[-4.0, 0, 0], [4.0, WIDTH, 0]])
    pieces = BeadPieces(
        start, start * [-1, 1, 1], np.full(2, 0.64), np.full(2, WIDTH), *(np.arange(2),) * 2, np.array([0.0, 9.6])
    )
    before = SurfaceHeights(np.array([-9.0, -6.0]), 0.2, np.zeros((60, 90)), np.full((60, 90), 0.01))
    came = replace(pieces, area=pieces.area * [1, 0 if gap else 1])
    after = replace(before, heights=bead_heights(came, before.nodes))
    return Look(12.5, 0.0, 3.0, 3.5, 1.12, judge_beads(before, after, pieces))


def test_a_look_is_recorded_and_read_back_bit_for_bit(tmp_path: File) -> None:
    look = replace(some_look(), flow=FlowShares(np.array([4.1]), np.array([4.7]), np.array([1.3])))
    unseen = replace(look, laid=replace(look.laid, volume=np.full(len(look.laid.volume), np.nan)))
    with Recorder(tmp_path / "run.mcap", arc_rig()) as recorder:
        for each in (look, unseen):
            recorder.write(each)
    found = read_looks(tmp_path / "run.mcap")
    assert [message_from_look(each) for each in found] == [message_from_look(each) for each in (look, unseen)]
    assert found[0].laid.clogs == look.laid.clogs and len(look.laid.clogs) == 1
    assert np.isnan(found[1].laid.volume).all() and "not seen" in found[1].text
    assert read_looks(tmp_path) == []


def test_the_report_says_and_draws_what_was_found() -> None:
    look, path = some_look(), layers(1)
    assert "clogged from 10 to 18 mm" in look.text and "lack gel" in look.text
    page, picture = looks_section([look], path), look_picture(look, path)
    assert picture.count("<path") == len(look.laid.planned) and "10 to 18 mm" in page and picture in page
    volume, planned, _ = look.laid.total
    assert f"<td>{volume:.2f}</td><td>{planned:.2f}</td>" in page and f"<td>{look.last:.0f}</td>" in page
    assert "clog" not in some_look(gap=False).text and looks_section([], path) == ""
    adapted = replace(look, flow=FlowShares(np.array([1.2, 1.6]), np.array([1.6, 2.4]), np.array([1.3, 0.8])))
    page = looks_section([adapted], path)
    assert adapted.text.endswith("; the next layer flows at 80 % to 130 % of the planned")
    assert page.count("<svg") == 2 and page.count("% of the planned flow</title>") == 2


def layered(came: Array, sigma: float = 0.02, layer: int = 0, told: FlowShares = AS_PLANNED) -> tuple[Path, Look]:
    """Three layers of three beads of 16 mm, and a look at one, of whose pieces of 2 mm came shares (24,).

    told: what the layer was told to lay.
    """
    ends = np.array([[x, WIDTH * k, HEIGHT * n] for n in range(3) for k in range(3) for x in ((-8, 8), (8, -8))[k % 2]])
    path = path_through(ends.astype(float), 10.0)
    amounts = {"width_mm": np.full(len(path), WIDTH), "height_mm": np.full(len(path), HEIGHT)}
    path = replace(path, extrude=np.arange(len(path)) % 2 == 1, layer=np.arange(len(path)) // 6, extra=amounts)
    first, last = 6.0 * layer, 6.0 * layer + 5
    before = SurfaceHeights(np.array([-12.0, -4.0]), 0.2, np.zeros((60, 120)), np.full((60, 120), sigma))
    laid = bead_heights(pieces_between(path, first, last, told=as_flow(came, layer)), before.nodes)
    pieces = pieces_between(path, first, last, told=told)
    return path, Look(1.0, first, last, 1.0, 1.0, judge_beads(before, replace(before, heights=laid), pieces))


def as_flow(shares: Array, layer: int) -> FlowShares:
    """Shares (24,) of a layer's pieces of 2 mm, as it is told them."""
    edges = np.linspace(0.0, 1.0, 9)
    begin, end = (np.concatenate([6 * layer + 2 * k + edge for k in range(3)]) for edge in (edges[:-1], edges[1:]))
    return FlowShares(begin, end, np.maximum(shares, 1e-6))


def flow_on(told: FlowShares | None, layer: int) -> Array:
    """What a layer's pieces of 2 mm (24,) are told, of the planned."""
    assert told is not None
    pieces = as_flow(np.ones(24), layer)
    at = pieces.begin[:, None] + (pieces.end - pieces.begin)[:, None] * np.linspace(0.05, 0.95, 10)
    return np.asarray(told.at(at).mean(axis=1))


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(0.0, 3.0), min_size=24, max_size=24))
def test_whatever_lies_there_the_next_layer_flows_within_its_limits(shares: list[float]) -> None:
    path, look = layered(np.array(shares))
    told = adapted_flow(path, [look])
    assert told is not None and told.begin.min() >= 6 and told.end.max() <= 11
    assert told.share.min() >= MIN_FLOW and told.share.max() <= MAX_FLOW


GAP = np.where(np.isin(np.arange(24), (10, 11, 12)), 0.0, 1.0)  # of the middle bead


def test_a_gap_is_filled_by_the_next_layer_over_it_and_not_beside_it_and_once() -> None:
    told = adapted_flow(*wrapped(layered(GAP)))
    assert told is not None
    ways = flow_on(told, 1)
    assert ways[[10, 11, 12]] == pytest.approx(MAX_FLOW, abs=0.1)
    assert ways[[8, 15, 0, 3, 4, 7, 19, 20]] == pytest.approx(1.0, abs=0.1)
    again = adapted_flow(*wrapped(layered(ways, layer=1, told=told)), told)
    assert flow_on(again, 2) == pytest.approx(1.0)  # what was filled is no gap, and no blob,
    missing = np.where(ways > 1.2, 0.0, 1.0)
    failed = adapted_flow(*wrapped(layered(missing, layer=1, told=told)), told)
    fresh = adapted_flow(*wrapped(layered(missing, layer=1)))
    assert flow_on(failed, 2) == pytest.approx(flow_on(fresh, 2), abs=0.05)  # and what failed is not asked for twice


def wrapped(looked: tuple[Path, Look]) -> tuple[Path, list[Look]]:
    """A path, and the only look at a layer of it."""
    return looked[0], [looked[1]]


def test_no_clog_is_told_over_a_filled_gap_and_one_in_it_is() -> None:
    told = adapted_flow(*wrapped(layered(GAP)))
    assert told is not None
    assert layered(GAP)[1].laid.clogs
    filled = layered(flow_on(told, 1), layer=1, told=told)[1].laid
    assert not filled.clogs and not filled.gap.any() and not filled.blob.any()
    as_planned = layered(np.ones(24), layer=1, told=told)[1].laid  # a device that did not give what it was told
    assert len(as_planned.clogs) == 1


def test_looks_at_parts_of_a_layer_count_together_at_its_end() -> None:
    path, look = layered(GAP)
    parts = []
    for first, last in ((0.0, 3.0), (3.0, 5.0)):
        keep = (look.laid.stations.bead <= 1) == (last == 3.0)
        columns = {f.name: getattr(look.laid, f.name)[keep] for f in fields(look.laid) if f.name != "stations"}
        each = Stations(*(getattr(look.laid.stations, f.name)[keep] for f in fields(Stations)))
        parts.append(replace(look, first=first, last=last, laid=LaidBeads(each, **columns)))
    assert adapted_flow(path, parts[:1]) is None
    whole, apart = adapted_flow(path, [look]), adapted_flow(path, parts)
    assert flow_on(apart, 1) == pytest.approx(flow_on(whole, 1))


def test_the_looks_of_a_print_remember_what_each_layer_was_told() -> None:
    path, look = layered(GAP)
    looks, others = SurfaceLooks(arc_rig(), path, adapt=True), SurfaceLooks(arc_rig(), path)
    assert looks.adapted() is None
    looks.last = others.last = look
    told = looks.adapted()
    assert told is not None and looks.last.flow is told and others.adapted() is None
    _, looks.last = layered(flow_on(told, 1), layer=1, told=told)
    assert flow_on(looks.adapted(), 2) == pytest.approx(1.0)


def test_nothing_is_done_after_an_uncertain_look_in_a_layer_or_after_the_last_one_or_for_noise() -> None:
    path, look = layered(GAP)
    unsure = replace(look, laid=replace(look.laid, sigma=look.laid.planned * 0.3))
    unseen = replace(look, laid=replace(look.laid, volume=np.where(look.laid.stations.bead <= 1, np.nan, 0.5)))
    assert adapted_flow(path, [unsure]) is None and adapted_flow(path, [unseen]) is None
    assert adapted_flow(path, [replace(look, last=3.0)]) is None
    assert adapted_flow(*wrapped(layered(GAP, layer=2))) is None
    dots = path.surface_from_nozzle.copy()
    dots[5:12, :3, 3] = dots[5, :3, 3]  # the next layer has no ways
    assert adapted_flow(replace(path, surface_from_nozzle=dots), [look]) is None
    told = adapted_flow(*wrapped(layered(np.full(24, 0.93))))
    assert told is not None and (told.share == 1.0).all()
    told = adapted_flow(*wrapped(layered(np.where(GAP, 1.0, 0.8), sigma=0.04)))
    assert told is not None and (told.share == 1.0).all()  # a fifth less, not known to a tenth


@given(st.lists(st.floats(0.0, 4.0), min_size=1, max_size=6), st.floats(0.0, 5.0))
def test_a_path_told_other_flows_lays_them(shares: list[float], first: float) -> None:
    path, edges = layered(np.ones(24))[0], np.linspace(0.3, 4.7, len(shares) + 1)
    told = FlowShares(edges[:-1], edges[1:], np.array(shares))
    pieces = pieces_between(path, first, 5.0, told=told)
    volume = (np.linalg.norm(pieces.end - pieces.start, axis=1) * pieces.area).sum()
    fine = np.linspace(first, 5.0, 20001)
    middle = (fine[1:] + fine[:-1]) / 2
    beads = np.ceil(middle).astype(int) % 2 == 1
    needed = (16.0 * WIDTH * HEIGHT * np.diff(fine) * told.at(middle) * beads).sum()
    assert volume == pytest.approx(needed, rel=2e-3, abs=0.02)


@pytest.mark.slow
def test_the_dispenser_is_told_the_flow_of_the_adapted_layer_and_a_replay_the_same() -> None:
    path = with_looks(layers(2, 1))
    flows: dict[float, list[float]] = {}
    for share in (1.0, 1.4):
        step = MotionStep(path, replace(ArmProfile(), limits=LIMITS, arm=CLOSE, tick=TICK))
        flows[share] = []
        for k in range(4000):
            now = START + k * TICK
            command = step(pose_at(still, now), now)
            if isinstance(command, Move) and command.flow:
                flows[share].append(command.flow if command.checkpoint > 1 else -command.flow)
            elif isinstance(command, Hold) and command.reason == LOOKS:
                step.adapt(FlowShares(np.array([1.5]), np.array([3.0]), np.array([share])))
                step.material_in()
            if step.progress.phase is PrintPhase.FINISHED:
                break
    plain, adapted = (np.array(flows[share]) for share in (1.0, 1.4))
    assert len(plain) == len(adapted) > 20 and (plain[plain < 0] == adapted[adapted < 0]).all()
    assert adapted[adapted > 0] == pytest.approx(1.4 * plain[plain > 0])


def test_a_live_run_gathers_judges_beside_the_tracking_and_says_so_once() -> None:
    rig, rng = arc_rig(focal=2200.0, size=(400, 300)), np.random.default_rng(4)
    scene = Scene(body("chest", None, 1), Appearance(wetness=0.0), seed=1)
    scene.gel = Gel(gloss=0.05)
    path = layers(1, 3)
    bare, places = views(scene, rig, rng), landmarks(scene)
    for k, (a, b) in enumerate(path.surface_from_nozzle[:, :2, 3].reshape(3, 2, 2)):
        way = np.linspace(a, b, 81)
        area = np.full(80, WIDTH * HEIGHT * (k != 1))  # the middle one is clogged
        scene.ink.flow(GelPieces(way[:-1], way[1:], 0.1 * area, np.maximum(area, 0.1)), 0.0)
    scene.ink.flow(none_left(), 30.0)
    printed = views(scene, rig, rng)
    looks, (look,) = looked_live(rig, path, bare, printed, places)
    assert looks.count == 1 and looks.text == f"looked at: {look.text}" and look.seconds > 1
    ((begin, end),) = look.laid.clogs
    middle = look.laid.stations.begin[look.laid.stations.bead == 1]
    assert begin == pytest.approx(middle[0], abs=1.3) and end - begin > 5


@pytest.mark.slow
@pytest.mark.parametrize("size", [(320, 180), (96, 54)])
def test_cameras_of_too_few_pixels_tell_nothing_and_end_nothing(size: tuple[int, int]) -> None:
    rig = arc_rig(focal=0.86 * size[0], size=size)  # 1.7 and 5.6 mm a pixel: coarser than a bead
    scene = Scene(body("chest", None, 1), Appearance(wetness=0.0), seed=1)
    seen = views(scene, rig, np.random.default_rng(4))
    looks, done = looked_live(rig, layers(1, 2), seen, seen, landmarks(scene))
    assert looks.count == 1 and "goes on as planned" not in looks.text, looks.text
    assert all(not look.laid.clogs and np.isnan(look.laid.share).all() for look in done)


@pytest.mark.parametrize(
    ("size", "found"),
    [((320, 180), True), ((96, 54), False), pytest.param((640, 360), True, marks=pytest.mark.slow)],
)
def test_relief_is_what_pictures_resolve(size: tuple[int, int], found: bool) -> None:
    rig, scene = (
        arc_rig(focal=0.86 * size[0], size=size),
        Scene(body("chest", None, 1), Appearance(wetness=0.0), seed=1),
    )
    seen = views(scene, rig, np.random.default_rng(4))[0]
    places = scene.shape.points(np.random.default_rng(3).uniform(-10, 10, (60, 2)))
    surface = SurfaceMap(places, np.zeros_like(places), np.zeros((0, 0)))
    first = cast(FirstMap, SimpleNamespace(map=surface, base_from_surface=seen.base_from_surface))
    points = relief_points(Lenses(rig), {c: grey(image) for c, image in seen.images.items()}, first, {})
    assert points.shape[1:] == (3,) and bool(len(points)) == found
    inner = se3.transform_points(se3.inverse(seen.base_from_surface), points)
    assert np.abs(inner[:, 2] - scene.shape.heights_at(inner[:, :2])).max(initial=0) < 2.0  # mm, a pixel at 320


@pytest.mark.slow
def test_a_look_that_fails_says_so_and_the_run_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    waited_for = threading.Event()

    def failing(*_: object) -> None:
        waited_for.wait(30)  # else it may be over, and taken, before the last view is there
        raise ValueError("no such surface")

    monkeypatch.setattr("hardware.offline.looks.dense_heights", failing)
    rig, scene = arc_rig(focal=275.0, size=(320, 180)), Scene(body("chest", None, 1), Appearance(), seed=1)
    seen = views(scene, rig, np.random.default_rng(4))
    looks, done = looked_live(rig, layers(1, 2), seen, seen, landmarks(scene), waited_for)
    assert not done and looks.count == 1 and "goes on as planned (ValueError: no such surface)" in looks.text


def looked_live(
    rig: Rig,
    path: Path,
    bare: Sequence[SurfaceView],
    printed: Sequence[SurfaceView],
    places: Array,
    waited_for: threading.Event | None = None,
) -> tuple[LiveLooks, list[Look]]:
    """The looks of a live run at views of the bare surface and of what was printed; places: its landmarks.

    waited_for: is set while the job of a round of views is waited for.
    """
    waited_for = waited_for or threading.Event()
    held, done, now = Hold(0.0, 0.1, LOOKS), list[Look](), 100.0
    begun = PrintProgress(PrintPhase.PRINTING, 1, len(path), 0.0, 30.0, 0.0, "")
    aside = replace(begun, phase=PrintPhase.RETREATING, fraction=len(path) - 1.0, wanted=LOOK)
    with ExitStack() as stack:
        looks = LiveLooks(rig, path, stack)

        def seen(view: SurfaceView, progress: PrintProgress | None, lies: Array | None) -> None:
            nonlocal now
            now += 0.3
            frames = FrameSet(now, tuple(Frame(c, now, image) for c, image in view.images.items()))
            pose = SurfacePose(now, view.base_from_surface, 1e-6 * np.eye(6), np.zeros(6), TrackState.TRACKING)
            look = looks(progress, held, frames, pose, places, lies)
            done.extend([] if look is None else [look])

        for view in [*bare, *bare]:
            seen(view, None, None)
        for shown, progress in ((bare, begun), ([*printed] * 4, aside)):
            waited_for.clear()
            for view in shown:
                seen(view, progress, np.eye(4))
            assert looks.busy is not None
            waited_for.set()
            wait([looks.busy])
        for _ in range(3):
            seen(printed[0], aside, np.eye(4))
    return looks, done


@pytest.mark.parametrize(("wetness", "gloss", "wound"), [(0.0, 0.05, None), (1.0, 0.95, Wound())], ids=["matt", "wet"])
def test_cameras_tell_how_much_was_laid_and_that_nothing_was(wetness: float, gloss: float, wound: Wound | None) -> None:
    rig, rng = arc_rig(focal=2200.0, size=(400, 300)), np.random.default_rng(4)
    scene = Scene(body("chest", wound, 1), Appearance(wetness=wetness), seed=1)
    scene.gel = Gel(gloss=gloss)  # seen by 9 pixels a bead
    start = np.array([[-7.0, WIDTH * k, 0.0] for k in (-1, 0, 1)])
    numbers = np.arange(3)
    size = np.full(3, 0.64), np.full(3, WIDTH)
    pieces = BeadPieces(start, start * [-1, 1, 1], *size, numbers, numbers, numbers * 16.0)
    bare, lenses = views(scene, rig, rng), Lenses(rig)
    low, high = np.array([[-16.0, -13.0], [16.0, 13.0]])
    before = dense_heights(lenses, bare, first_heights(landmarks(scene), low, high, 0.2))
    true = scene.shape.heights_at(before.nodes.reshape(-1, 2)).reshape(before.heights.shape)
    assert abs(np.nanmean((before.heights - true)[before.sigma < 0.1])) < 0.01  # 0.03 and 0.05 by grey pictures
    nothing, *_ = look_at(lenses, bare, before, pieces)
    assert nothing.gap.mean() > 0.9 and len(nothing.clogs) == 1
    for a, b in zip(pieces.start[:, :2], pieces.end[:, :2], strict=True):
        way = np.linspace(a, b, 141)
        scene.ink.flow(GelPieces(way[:-1], way[1:], np.full(140, 0.064), np.full(140, 0.64)), 0.0)
    scene.ink.flow(none_left(), 30.0)
    laid, ground, width = look_at(lenses, views(scene, rig, rng), before, pieces)
    assert 1.05 < width < 1.25  # 1.118
    volume, planned, seen = laid.total
    assert seen > 0.9 and volume == pytest.approx(planned, rel=0.08) and not laid.clogs and not laid.gap.any()
    uneven = np.abs(laid.height - 0.537)  # mm; a parabola of 0.64 mm^2, 0.3 as high as wide
    assert np.nanmedian(uneven) < 0.07 and np.nanpercentile(uneven, 90) < 0.11  # by two instants
    for a, b in zip(pieces.start[1:, :2], pieces.end[1:, :2], strict=True):  # a layer on it, whose first bead lacks
        way = np.linspace(a, b, 141)
        scene.ink.flow(GelPieces(way[:-1], way[1:], np.full(140, 0.064), np.full(140, 0.64)), 60.0)
    scene.ink.flow(none_left(), 90.0)
    upper, *_ = look_at(lenses, views(scene, rig, rng), ground, pieces, (width,))
    ((begin, end),) = upper.clogs
    assert begin < 3 and end == pytest.approx(14.0, abs=1.3)
    assert np.nansum(upper.volume[upper.stations.bead > 0]) == pytest.approx(2 * 14 * 0.64, rel=0.15)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.4))
def test_a_lamps_white_mirror_image_leaves_a_matte_picture_as_it_is(seed: int, glint: float) -> None:
    rng = np.random.default_rng(seed)
    light = rng.uniform(0.1, 0.5, (6, 8, 3))
    plain, shining = (
        np.rint(255 * np.sqrt(each)).astype(np.uint8) for each in (light, light + glint * rng.random((6, 8, 1)))
    )
    assert np.abs(matte(shining) - matte(plain)).max() < 4  # of 255: the pictures' own rounding


def test_a_camera_does_not_see_what_a_bead_stands_before() -> None:
    y = np.arange(60) * 0.2
    surface = np.repeat(np.where((y > 6) & (y < 8), 1.5, 0.0)[:, None], 50, axis=1)
    aslant = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5)])
    blank = np.zeros((60, 50, 2), np.float32)
    seen = _GroundView(
        np.zeros((2, 2), np.uint8), blank, blank, np.ones((60, 50), bool), np.broadcast_to(aslant, (60, 50, 3))
    ).in_line_of_sight(surface, 0.2)
    hidden = y[~seen[:, 25]]
    assert hidden.min() == pytest.approx(4.7, abs=0.25) and hidden.max() == pytest.approx(6.0, abs=0.25)
    assert len(hidden) == pytest.approx(7, abs=1)


def views(scene: Scene, rig: Rig, rng: np.random.Generator) -> list[SurfaceView]:
    """Two instants of a breath."""
    found = []
    for rise in (0.0, 1.3):
        pose = BASE_FROM_REST.copy()
        pose[2, 3] += rise
        state = WorldState(0.0, 0.004, pose, np.zeros(6))
        images = render(scene, rig.cameras, [state] * len(rig), Sensor(), rng.spawn(len(rig)))
        found.append(SurfaceView(dict(enumerate(images)), pose))
    return found


def landmarks(scene: Scene) -> Array:
    """A map of some hundred landmarks."""
    return scene.shape.points(np.random.default_rng(3).uniform(-25, 25, (150, 2)))
