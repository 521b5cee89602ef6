"""Faults by name: read as written, refused with what is allowed, and what each does to a simulated print."""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Callable
from ctypes import c_double
from multiprocessing import Pipe
from multiprocessing.sharedctypes import RawValue
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.movements import ComposedMotion
from estimation.synthetic.world import arc_rig
from hardware.files.path_file import read_path
from hardware.live.fault_injection import FaultInjector
from hardware.live.frame_source import FrameRing, RingSource
from hardware.live.ipc import PictureCache, ProcessGroup, play_session
from hardware.offline.replay import FrameFaults, tracked_sets
from hardware.process.clock import SimClock, WallClock
from hardware.process.faults import (
    FAULT_SPECS,
    MAX_FAULT_TIME,
    Fault,
    FaultKind,
    FaultPart,
    FaultRunner,
    check_faults,
    fault_from_text,
    faults_from_texts,
)
from hardware.recording.session_reader import open_session
from hardware.simulator.arm.settings import ArmSettings, ReplyMode, read_virtual_arm, write_virtual_arm
from hardware.simulator.camera_pipeline import Exposures
from hardware.simulator.cameras import CameraSettings, Fate, Shot, SimulatedCameras, TrueCameras, bump_transform
from hardware.simulator.scenario import read_scenario
from hardware.simulator.simulate import LandmarkTracker, true_surface
from hardware.simulator.truth import disturbed_motion
from hardware.simulator.world import SimulatedWorld
from perception.frames import Frame, FrameSet
from planning.command import Hold
from tests.session_files import SIZE, make_folder
from tests.simulated_worlds import SMALL, Heard, patch, write_path, write_scenario

ROOT = Path(__file__).parents[1]
WORDS = ("camera0", "arm", "stall", "2s", "at", "for", "seed", "-1", "80%", "2mm", "off", "x")
TIMES = np.linspace(0.0, 4.0, 401)


def fault(text: str) -> Fault:
    return fault_from_text("x.toml", "faults[0]", text)


@st.composite
def faults(draw: st.DrawFn) -> Fault:
    (part, kind), spec = draw(st.sampled_from(list(FAULT_SPECS.items())))
    seconds = st.floats(0, MAX_FAULT_TIME)
    amount = draw(st.floats(spec.low, spec.high).filter(bool)) if spec.unit else 0.0
    lasts = [] if spec.lasts is None else [spec.lasts]
    said = [] if kind is FaultKind.KILL else [st.floats(1e-6, MAX_FAULT_TIME)]
    duration = draw(st.one_of(*said, *map(st.just, lasts)))
    number = draw(st.integers(0, 7)) if part is FaultPart.CAMERA else 0
    return Fault(part, kind, draw(seconds), duration, amount, number, draw(st.integers(0, 10**15 - 1)))


@given(faults())
def test_the_text_of_a_fault_is_read_back_as_the_same_fault(one: Fault) -> None:
    assert fault(str(one)) == one


@given(st.text(max_size=40) | st.lists(st.sampled_from(WORDS)).map(" ".join))
def test_any_other_text_is_a_fault_or_one_clear_error(text: str) -> None:
    try:
        found = fault(text)
    except InputError as error:
        assert str(error).startswith("x.toml: faults[0] = ")
    else:
        assert fault(str(found)) == found


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("camera0 stuck at 5s for 2s", Fault(FaultPart.CAMERA, FaultKind.STUCK, 5.0, 2.0)),
        ("camera2 bump 2mm", Fault(FaultPart.CAMERA, FaultKind.BUMP, 0.0, math.inf, 2.0, 2)),
        ("camera1 flash at 1s", Fault(FaultPart.CAMERA, FaultKind.FLASH, 1.0, 0.1, 0.0, 1)),
        ("clock jump -500ms", Fault(FaultPart.CLOCK, FaultKind.JUMP, 0.0, math.inf, -0.5)),
        ("arm stall 600ms at 5s seed 3", Fault(FaultPart.ARM, FaultKind.STALL, 5.0, 0.6, seed=3)),
        ("arm stall at 5s for 600ms", Fault(FaultPart.ARM, FaultKind.STALL, 5.0, 0.6)),
        ("surface fast 80mm/s for 0.5s", Fault(FaultPart.SURFACE, FaultKind.FAST, 0.0, 0.5, 80.0)),
    ],
)
def test_a_text_names_a_fault(text: str, expected: Fault) -> None:
    assert fault(text) == expected


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("camra0 off", "did you mean 'camera0'"), ("camera0 stcuk", "did you mean 'stuck'"),
        ("camera9 off", "one of camera0"), ("camera0 bump 2s", "0.01 to 100 mm"),
        ("tracking kill for 2s", "what is killed stays so"), ("arm stall", "how long"),
        ("paper flood", "one of camera0"), ("page flud", "did you mean .flood."),
    ],
)  # fmt: skip
def test_a_text_that_names_none_is_told_what_was_meant(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        fault(text)


def test_what_a_command_cannot_let_happen_is_refused_and_says_who_can() -> None:
    with pytest.raises(InputError, match="disk full is for live"):
        check_faults([fault("disk full")], FaultRunner.SIMULATE, "command line", "--fault")
    with pytest.raises(InputError, match="camera0 to camera2"):
        check_faults([fault("camera3 off")], FaultRunner.SIMULATE, "command line", "--fault", 3)
    with pytest.raises(InputError, match="a list of texts"):
        faults_from_texts("x.toml", "faults", "camera0 off")


def test_every_fault_is_in_the_document_and_can_be_let_happen_by_somebody() -> None:
    text = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
    for (part, kind), spec in FAULT_SPECS.items():
        assert spec.runners and f"| `{part}" in text and f" {kind}" in text and spec.about in text


def shots(text: str, camera: int = 0, seconds: float = 3.0) -> list[Shot]:
    cameras = SimulatedCameras(CameraSettings((0.0,) * 3, (0.0,) * 3), 1, [fault(text)])
    return list(cameras.shots(camera, seconds))


def during(found: list[Shot], start: float = 1.0, end: float = 2.0) -> list[Shot]:
    return [shot for shot in found if start <= shot.number / 30 + 0.1 < end]


def test_each_fault_strikes_its_camera_and_its_time_alone() -> None:
    usual = shots("camera1 off at 1s for 1s")
    for text in ("off", "stuck", "slow 100ms", "garble", "bump 2mm", "black", "flash"):
        struck = shots(f"camera0 {text} at 1s for 1s")
        changed = [a.number for a, b in zip(struck, usual, strict=True) if a != b]
        late = 3 if "slow" in text else 0  # frames that wait behind those that were late
        assert changed == [shot.number for shot in during(usual, 1.0, 2.0 + late / 30)]
    assert {s.fate for s in during(shots("camera0 off at 1s for 1s"))} == {Fate.DROPPED}
    stuck = during(shots("camera0 stuck at 1s for 1s"))
    assert len({s.picture for s in stuck}) == 1 and len({s.stamp for s in stuck}) == len(stuck)
    assert {s.gain for s in during(shots("camera0 black at 1s for 1s"))} == {0.0}
    assert [s.lens for s in during(shots("camera0 swap at 1s for 1s", 1))] == [0] * 30
    assert all(s.covered for s in during(shots("surface cover at 1s for 1s", 2)))
    jumped = shots("clock jump 2s at 1s")
    assert jumped[-1].stamp - usual[-1].stamp == pytest.approx(2.0)


def test_a_bump_is_as_far_as_it_says_and_across_the_line_of_sight() -> None:
    moved = bump_transform(fault("camera0 bump 2mm seed 4"))
    assert np.linalg.norm(moved[:3, 3]) == pytest.approx(2.0) and moved[2, 3] == 0.0
    assert not np.allclose(moved, bump_transform(fault("camera0 bump 2mm seed 5")))
    rig = read_scenario(ROOT / "data" / "scenarios" / "still.toml").rig
    lenses, shot = TrueCameras(rig.cameras), shots("camera0 bump 2mm")[3]
    assert lenses(shot) is lenses(shot) and lenses(shot) is not rig.cameras[0]


def test_a_surface_that_runs_away_is_as_fast_as_said_and_comes_back() -> None:
    motion = disturbed_motion(ComposedMotion(()), [fault("surface fast 80mm/s at 1s for 0.5s")])
    poses, twist = motion(TIMES), motion.twist(TIMES)
    assert np.linalg.norm(twist[:, 3:], axis=1).max() == pytest.approx(80.0, rel=0.01)
    ahead, behind = motion(TIMES + 1e-5), motion(TIMES - 1e-5)
    assert se3.log(se3.inverse(behind) @ ahead) / 2e-5 == pytest.approx(twist, abs=1e-2)
    outside = (TIMES < 1.0) | (TIMES > 1.5)
    assert np.abs(poses[outside] - np.eye(4)).max() < 1e-9


def printed(folder: Path, *texts: str, seconds: float = 6.5) -> Heard:
    """A print that is tracked by its estimator."""
    write_path(folder / "path.csv", [[-14, -4, 0], [14, -4, 0], [14, 0, 0], [-14, 0, 0], [-14, 4, 0]])
    cameras = {"cameras": {"fps": 30.0}, "tracking": {"by": "tracks"}}
    scenario = read_scenario(write_scenario(folder, SMALL, cameras, faults=list(texts), seconds=seconds))
    sink, taken = Heard(), Exposures()
    truth = true_surface(scenario, patch())
    step = LandmarkTracker(scenario.rig, scenario.known_rig, truth, patch().shape, lambda c, s: taken[c, s], 1)
    SimulatedWorld(scenario, patch(), read_path(scenario.path), truth, step, taken, sink, SimClock()).run()
    return sink


def said(pose: SurfacePose) -> bool:
    return pose.state is not TrackState.TRACKING or bool(pose.reason)


def holds(sink: Heard, start: float, end: float) -> list[bool]:
    return [isinstance(command, Hold) for command in sink.commands if start <= command.stamp < end]


def speeds(sink: Heard, start: float, end: float) -> Array:
    log = sink.log
    rows = (log.stamps >= start) & (log.stamps < end)
    return np.linalg.norm(np.diff(log.base_from_nozzle[rows, :3, 3], axis=0), axis=1) / 0.001


def test_a_camera_that_fails_is_told_and_forgotten_when_it_is_back(tmp_path: Path) -> None:
    kinds = "off", "stuck", "swap", "bump 5mm", "black"
    sink = printed(tmp_path, *(f"camera0 {kind} at {1.5 + i}s for 0.4s" for i, kind in enumerate(kinds)))
    for i, kind in enumerate(kinds):
        struck = [pose for pose in sink.poses if 1.5 + i <= pose.stamp < 1.9 + i]
        assert next(k for k, pose in enumerate(struck) if said(pose)) <= 3, kind
        assert not any(said(pose) for pose in sink.poses if 2.2 + i <= pose.stamp < 2.5 + i), kind
    assert not any(holds(sink, 1.0, 3.5)) and not any(holds(sink, 4.1, 6.0))


def test_without_a_view_the_arm_rests_and_goes_on_afterwards(tmp_path: Path) -> None:
    faults = "surface cover", "tracking hang", "clock jump -3s", "motion hang"
    sink = printed(tmp_path, *(f"{each} at {1.5 + 1.5 * i}s for 0.7s" for i, each in enumerate(faults)), seconds=7.5)
    for i, each in enumerate(faults):
        begin, end = 1.5 + 1.5 * i, 2.2 + 1.5 * i
        assert all(holds(sink, end - 0.15, end)) and speeds(sink, end - 0.15, end).max() < 0.1, each
        assert not any(holds(sink, end + 0.3, begin + 1.5)), each
    assert not holds(sink, 6.0, 6.69)


def test_who_knows_the_truth_is_struck_by_nothing_that_pictures_show(tmp_path: Path) -> None:
    from hardware.simulator.simulate import run_simulation

    file = write_scenario(tmp_path, {"tracking": {"by": "truth"}, "scene": {"texel_mm": 1.0}}, faults=["camera0 black"])
    with pytest.raises(InputError, match="does not look"):
        run_simulation(file, tmp_path / "out")


def recorded(count: int = 60) -> list[FrameSet]:
    """Sets of three cameras at 30 Hz whose pictures say which camera they are of, and when."""
    return [
        FrameSet(10 + k / 30, tuple(Frame(c, 10 + k / 30, np.full((4, 6), 60 * c + k, np.uint8)) for c in range(3)))
        for k in range(count)
    ]


def seen(*texts: str) -> list[FrameSet]:
    rig = arc_rig(size=(6, 4))
    return list(tracked_sets(recorded(), [fault(text) for text in texts], rig, "test"))


def value(frames: FrameSet, camera: int) -> int | None:
    return next((int(frame.image[0, 0]) for frame in frames.frames if frame.camera == camera), None)


def test_frames_of_a_recording_are_struck_as_a_cameras_are() -> None:
    usual = recorded()
    off, stuck = seen("camera1 off at 1s for 0.5s"), seen("camera1 stuck at 1s")
    assert [value(frames, 1) is None for frames in off] == [30 <= k < 45 for k in range(60)]
    assert [value(frames, 1) for frames in stuck[30:]] == [value(usual[29], 1)] * 30
    swapped = seen("camera2 swap at 1s")
    assert [(value(f, 0), value(f, 2)) for f in swapped[30:]] == [(value(f, 2), value(f, 0)) for f in usual[30:]]
    assert {value(frames, 0) for frames in seen("camera0 black")} == {0}
    assert {value(frames, 0) for frames in seen("camera0 flash for 2s")} == {255}
    assert len(seen("tracking hang at 1s for 0.5s")) == 45 and len(seen("tracking kill at 1s")) == 30
    assert not seen("camera0 off", "camera1 off", "camera2 off")


def test_cables_of_cameras_that_differ_cannot_be_exchanged() -> None:
    one, two = arc_rig(size=(6, 4)).cameras[0], arc_rig(size=(8, 4)).cameras[1]
    with pytest.raises(InputError, match="of one size"):
        FrameFaults([fault("camera0 swap")], Rig((one, two)), "test")


def test_processes_are_stopped_and_go_on_when_it_is_due_and_not_before(tmp_path: Path) -> None:
    crew, begun = ProcessGroup(), RawValue(c_double, math.nan)
    crew.start("tracking", signal.pause, ())
    process = state_of(crew)
    faults = [fault("tracking hang at 1s for 1s"), fault("tracking kill at 3s")]
    injector = FaultInjector(faults, crew, tmp_path / "x", begun)
    try:
        assert not injector.update(50.0) and process() != "T"
        begun.value = 100.0
        assert not injector.update(100.9)
        assert [str(each) for each in injector.update(101.0)] == ["tracking hang at 1s for 1s"]
        assert becomes(lambda: process() == "T")
        assert not injector.update(102.0) and becomes(lambda: process() != "T")
        assert injector.update(103.0)
        crew.members["tracking"].join(20)
        assert crew.ending("tracking") == "was killed by SIGKILL"
    finally:
        crew.kill("tracking")


def state_of(crew: ProcessGroup) -> Callable[[], str]:
    """What the system says of the tracking process: R runs, S sleeps, T is stopped."""
    file = Path(f"/proc/{crew.members['tracking'].pid}/stat")
    return lambda: file.read_text().rpartition(")")[2].split()[0]


def becomes(true: Callable[[], bool]) -> bool:
    return any(true() or threading.Event().wait(0.02) for _ in range(1000))


def test_a_virtual_arm_is_read_back_from_its_file(tmp_path: Path) -> None:
    settings = ArmSettings(servo_lag=0.03, replies=ReplyMode.STREAM, seed=5)
    faults = (fault("arm stall 600ms at 1s"), fault("arm garble at 2s for 1s seed 4"))
    write_virtual_arm(tmp_path / "arm.toml", settings, faults)
    again, read = read_virtual_arm(tmp_path / "arm.toml")
    assert read == faults and again.replies is ReplyMode.STREAM and again.top_turn == pytest.approx(settings.top_turn)
    assert (again.servo_lag, again.seed) == (0.03, 5)
    assert again.low == pytest.approx(settings.low) and again.high == pytest.approx(settings.high)


def test_a_feed_shows_what_struck_cameras_deliver(tmp_path: Path) -> None:
    session = make_folder(tmp_path / "session", count=20, cameras=2, pictures=True)
    ring, (ours, theirs), begun = FrameRing([SIZE, SIZE]), Pipe(duplex=False), RawValue(c_double, math.nan)
    begun.value = WallClock().now()
    struck = fault("camera0 off"), fault("camera1 black")
    shown = threading.Thread(target=play_session, args=(open_session(session), False, struck, ring, theirs, begun))
    ring.requested.value = True
    shown.start()
    source, taken = RingSource(ring, ours), None
    while taken is None and (shown.is_alive() or ours.poll()):
        taken = source.take(0.2)
    shown.join()
    assert taken is not None and [frame.camera for frame in taken.frames.frames] == [1]
    assert taken.frames.frames[0].image.max() == 0 and not taken.encoded


def test_a_session_that_is_shown_again_and_again_is_decoded_once(tmp_path: Path) -> None:
    session = open_session(make_folder(tmp_path / "session", count=4, cameras=2, pictures=True))
    kept, once = PictureCache(session, True), PictureCache(session, False)
    for cache in (kept, once):
        cache.decode_ahead()
    for refs in session.sets:
        (encoded, first), (_, again) = kept.decoded(refs), kept.decoded(refs)
        assert all(a is b for a, b in zip(first, again, strict=True)) and set(encoded) <= {0, 1}
        fresh = once.decoded(refs)[1]
        assert [f.stamp for f in fresh] == [f.stamp for f in first] and not any(f in first for f in fresh)
        assert all((a.image == b.image).all() for a, b in zip(first, fresh, strict=True))
