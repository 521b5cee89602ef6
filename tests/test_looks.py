"""A look at what was laid: the path rests for it, the needle goes aside, gel keeps its volume, looks are recorded."""

from __future__ import annotations

from concurrent.futures import wait
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path as File

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceHeights
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.arm.profile import ArmProfile
from hardware.motion.step import MotionStep
from hardware.offline.looks import LiveLooks, look_at, look_picture, looks_section, read_looks
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
from hardware.simulator.scene.shape import body
from hardware.simulator.truth import divide_path
from perception.frames import Frame, FrameSet
from perception.lens import Lenses
from perception.mapping.surface_heights import (
    SurfaceView,
    dense_heights,
    first_heights,
)
from planning.command import Hold, Move
from planning.kinematics import nozzle_from_axes
from planning.laid_beads import (
    BeadPieces,
    Look,
    bead_heights,
    judge_beads,
    with_looks,
)
from planning.motion.guard import Guard
from planning.motion.planner import LOOKS, Planner
from planning.path import LOOK, Path, PrintPhase, PrintProgress
from tests import worlds
from tests.moving import path_through, pose_at, still
from tests.slowly import slowly
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


@pytest.mark.parametrize("asked", [150, *slowly(400)])  # on its way up, and at rest above
def test_in_a_pause_the_needle_goes_aside_when_somebody_looks_and_lays_the_rest_once(asked: int) -> None:
    path = layers()
    step = MotionStep(path, replace(ArmProfile(), limits=LIMITS, arm=CLOSE, tick=TICK))
    printed, aside, axes = [], [], CLOSE.home
    for k in range(6000):
        now = START + k * TICK
        step.paused = 140 <= k < 1400
        step.aside = asked <= k < 1200
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
    dispensers.models[0].obey(1.0, 0.5)
    instants, needed = np.array([0.1, 1.0, 2.5, 3.5]), np.full(4, 4.0)
    assert dispensers.flow(instants, needed) == pytest.approx([0.0, 4.0, 1.0, 4.0])
    file = worlds.write_scenario(tmp_path, worlds.IDEAL, {"dispenser": {"given": 1.25}})
    scenario = read_scenario(file)
    assert scenario.dispenser is not None and scenario.dispenser.given == 1.25
    for value in (0.0, -1.0, 9.0):
        file = worlds.write_scenario(tmp_path, worlds.IDEAL, {"dispenser": {"given": value}})
        with pytest.raises(InputError, match=r"dispenser\.given"):
            read_scenario(file)


@pytest.mark.parametrize(
    ("top", "key"),
    [({"look": "often"}, "look"), ({"look": 0}, "look"), ({"look": True}, "look")],
)
def test_a_look_that_makes_no_sense_is_refused(top: dict[str, object], key: str, tmp_path: File) -> None:
    with pytest.raises(InputError, match=key):
        read_scenario(worlds.write_scenario(tmp_path, worlds.IDEAL, **top))


@pytest.mark.parametrize(("key", "value"), [("aspect", 0.9), ("sag_s", 0.0), ("gloss", 1.5), ("glossy", 1.0)])
def test_a_gel_that_makes_no_sense_is_refused(key: str, value: float, tmp_path: File) -> None:
    with pytest.raises(InputError, match=f"gel.*{key}"):
        read_scenario(worlds.write_scenario(tmp_path, worlds.IDEAL, {"gel": {key: value}}))


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
    look = some_look()
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
    assert "clog" not in some_look(gap=False).text and looks_section([], path) == ""


def test_a_live_run_gathers_judges_beside_the_tracking_and_says_so_once() -> None:
    rig, rng = arc_rig(focal=2200.0, size=(400, 300)), np.random.default_rng(4)
    scene = Scene(body("chest", None, 1), Appearance(wetness=0.0), seed=1)
    scene.gel = Gel(gloss=0.05)
    path = layers(1, 3)
    bare, places, now = views(scene, rig, rng), landmarks(scene), 100.0
    for k, (a, b) in enumerate(path.surface_from_nozzle[:, :2, 3].reshape(3, 2, 2)):
        way = np.linspace(a, b, 81)
        area = np.full(80, WIDTH * HEIGHT * (k != 1))  # the middle one is clogged
        scene.ink.flow(GelPieces(way[:-1], way[1:], 0.1 * area, np.maximum(area, 0.1)), 0.0)
    scene.ink.flow(none_left(), 30.0)
    printed = views(scene, rig, rng)
    held, done = Hold(0.0, 0.1, LOOKS), list[Look]()
    begun = PrintProgress(PrintPhase.PRINTING, 1, 6, 0.0, 30.0, 0.0, "")
    aside = replace(begun, phase=PrintPhase.RETREATING, fraction=5.0, wanted=LOOK)
    with ExitStack() as stack:
        looks = LiveLooks(rig, path, stack)

        def seen(view: SurfaceView, progress: PrintProgress | None, lies: Array | None) -> None:
            nonlocal now
            now += 0.3
            frames = FrameSet(now, tuple(Frame(c, now, image) for c, image in view.images.items()))
            pose = SurfacePose(now, view.base_from_surface, 1e-6 * np.eye(6), np.zeros(6), TrackState.TRACKING)
            look = looks(progress, held, frames, pose, places, lies)
            done.extend([] if look is None else [look])

        for view in bare * 2:
            seen(view, None, None)
        for turn, progress in enumerate((begun, aside)):
            for view in (bare, printed * 4)[turn]:
                seen(view, progress, np.eye(4))
            assert looks.busy is not None
            wait([looks.busy])
        for _ in range(3):
            seen(printed[0], aside, np.eye(4))
    (look,) = done
    assert looks.count == 1 and looks.text == f"looked at: {look.text}" and look.seconds > 1
    ((begin, end),) = look.laid.clogs
    middle = look.laid.stations.begin[look.laid.stations.bead == 1]
    assert begin == pytest.approx(middle[0], abs=1.3) and end - begin > 5


def test_cameras_tell_how_much_was_laid_and_that_nothing_was() -> None:
    rig, rng = arc_rig(focal=2200.0, size=(400, 300)), np.random.default_rng(4)
    scene = Scene(body("chest", None, 1), Appearance(wetness=0.0), seed=1)
    scene.gel = Gel(gloss=0.05)  # matt; seen by 9 pixels a bead
    start = np.array([[-7.0, WIDTH * k, 0.0] for k in (-1, 0, 1)])
    numbers = np.arange(3)
    size = np.full(3, 0.64), np.full(3, WIDTH)
    pieces = BeadPieces(start, start * [-1, 1, 1], *size, numbers, numbers, numbers * 16.0)
    bare, lenses = views(scene, rig, rng), Lenses(rig)
    low, high = np.array([[-16.0, -13.0], [16.0, 13.0]])
    before = dense_heights(lenses, bare, first_heights(landmarks(scene), low, high, 0.2))
    nothing, *_ = look_at(lenses, bare, before, pieces)
    assert nothing.gap.mean() > 0.9 and len(nothing.clogs) == 1
    for a, b in zip(pieces.start[:, :2], pieces.end[:, :2], strict=True):
        way = np.linspace(a, b, 141)
        scene.ink.flow(GelPieces(way[:-1], way[1:], np.full(140, 0.064), np.full(140, 0.64)), 0.0)
    scene.ink.flow(none_left(), 30.0)
    laid, _, width = look_at(lenses, views(scene, rig, rng), before, pieces)
    assert width in (1.12, 1.25)
    volume, planned, seen = laid.total
    assert seen > 0.9 and volume == pytest.approx(planned, rel=0.12) and not laid.clogs and not laid.gap.any()
    assert np.sqrt(np.nanmean((laid.height - 0.537) ** 2)) < 0.08  # mm; a parabola of 0.64 mm^2, 0.3 as high as wide


def views(scene: Scene, rig: Rig, rng: np.random.Generator) -> list[SurfaceView]:
    """Two instants of a breath."""
    found = []
    for rise in (0.0, 1.3):
        pose = BASE_FROM_REST.copy()
        pose[2, 3] += rise
        state = WorldState(0.0, 0.004, pose, np.zeros(6))
        images = render(scene, rig.cameras, [state] * len(rig), Sensor(), rng.spawn(len(rig)))
        found.append(SurfaceView({c: cv2.cvtColor(i, cv2.COLOR_BGR2GRAY) for c, i in enumerate(images)}, pose))
    return found


def landmarks(scene: Scene) -> Array:
    """A map of some hundred landmarks."""
    return scene.shape.points(np.random.default_rng(3).uniform(-25, 25, (150, 2)))
