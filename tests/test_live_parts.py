"""Parts of a live run: settings, messages between processes, what is shown; the course of a run is bounded."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from contextlib import suppress
from copy import deepcopy
from ctypes import c_double
from dataclasses import replace
from multiprocessing import Pipe
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError, StillbedError
from estimation.observations import no_observations
from estimation.pose import SurfacePose, TrackState, Trajectory, identity_pose
from hardware.arm.profile import ARM_FROM_BENCH, ArmProfile
from hardware.arm.protocol import frame_from_command
from hardware.cli.main import main
from hardware.files.mesh_file import write_ply
from hardware.files.path_file import ProgressWriter, read_progress, write_path, write_progress_durably
from hardware.live.checklist import PrintTask, place_path, raised_path
from hardware.live.frame_source import RING_SLOTS, FrameRing, RingSource, SourceEnded
from hardware.live.ipc import schedule, turning_sets
from hardware.live.prepared import (
    RunFiles,
    SurfacePlacement,
    placement_text,
    prepare,
    prepare_resumed,
    read_placement,
)
from hardware.live.recorder_process import ENTRY_HEAD, RecorderReceiver, RecorderSender, packed, record, unpacked
from hardware.live.records import (
    FIRST_BIN_WIDTH,
    TIMELINE_BINS,
    Entry,
    ErrorTimeline,
    EventEntry,
    PoseEntry,
    RecorderReport,
    SetEntry,
    UsedPoses,
)
from hardware.live.settings import (
    LiveSettings,
    available_cores,
    check_settings,
    override_settings,
    read_settings,
    settings_text,
)
from hardware.motion.step import LAG_STEP, BeginPrint, PrintMotion
from hardware.process.clock import SimClock, WallClock
from hardware.process.faults import faults_from_texts
from hardware.process.progress import cached
from hardware.process.system import MOST_RINGS, SPAWN, Bell, SharedLatest
from hardware.recording.loop_record import recorded_begin
from hardware.recording.session_reader import open_session, read_poses
from perception.frames import Frame, FrameSet, Image
from planning.material import Outlet, SwitchDelay
from planning.path import fingerprint
from tests.moving_surfaces import breathing, pose_at, raster
from tests.scans import body, height_field
from tests.session_files import image, rig
from tests.slow_cases import slowly

THERE = available_cores()
PROFILE = ArmProfile()
SURFACE = SurfacePose(0.0, ARM_FROM_BENCH, np.eye(6) * 1e-6, np.zeros(6), TrackState.TRACKING)


def test_a_dry_run_extrudes_nothing_and_stays_above_along_the_tool() -> None:
    path = raster()
    dry = raised_path(path, 7.0)
    assert not dry.extrude.any()
    whole, lifted = PrintTask(path, PROFILE), PrintTask(path, PROFILE, lift=7.0)
    assert whole.fingerprint == fingerprint(path) and not lifted.fingerprint
    up = np.einsum("nij,nj->ni", path.surface_from_nozzle[:, :3, :3], np.tile([0, 0, 7.0], (len(path), 1)))
    assert dry.surface_from_nozzle[:, :3, 3] == pytest.approx(path.surface_from_nozzle[:, :3, 3] + up)


def test_an_arm_that_has_no_place_is_put_where_the_surface_lies_below_its_home() -> None:
    pose = replace(SURFACE, base_from_surface=se3.make(se3.exp_rotation([0.3, 0.2, 0.1]), np.array([9.0, 8, 700])))
    assert place_path(raster(), np.eye(4), pose, PROFILE, place=False).unreachable
    assert not place_path(raster(), np.eye(4), pose, PROFILE, place=True).unreachable


def test_the_session_file_that_init_writes_is_read_back_as_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "session.toml").write_text(settings_text())
    assert read_settings(tmp_path / "session.toml") == LiveSettings()


def test_what_a_run_used_is_read_back_as_it_was(tmp_path: Path) -> None:
    used = LiveSettings(
        rig=tmp_path / "rig", path=tmp_path / 'a "b".csv', arm="virtual", record=tmp_path / "x.mcap", jpeg_quality=0,
        scan=tmp_path / "x.ply", dry_run=True, lift=3.25, unattended=True, patience=2.5, cores_motion=(1,),
    )  # fmt: skip
    (tmp_path / "session.toml").write_text(settings_text(used))
    assert read_settings(tmp_path / "session.toml") == used


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rig": None}, "cameras = .neither."), ({"path": None}, "print.path"), ({"arm": ""}, "arm.device"),
        ({"record": Path("x.bag")}, "ends in .mcap"), ({"lift": -1e-9}, "0 to 100 mm"),
        ({"lift": 100.1}, "0 to 100 mm"), ({"patience": 0.99}, "1 to 600 s"), ({"jpeg_quality": 101}, "0 to 100"),
        ({"page_port": -4}, "page.port = -4, allowed 1 to 65535, or 0"),
        ({"page_port": 65536}, "page.port = 65536, allowed 1 to 65535, or 0"),
        ({"path": Path("nowhere.csv")}, "a file that exists"),
        *(
            ({f"cores_{name}": (THERE[0], 1000)}, rf"cores.{name} = \[{THERE[0]}, 1000\], allowed .* are: {THERE[0]}")
            for name in ("tracking", "motion", "recorder")
        ),
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_are_named(change: dict[str, object], words: str, tmp_path: Path) -> None:
    for name in ("rig.toml", "path.csv"):
        (tmp_path / name).touch()
    files = {"rig": tmp_path / "rig.toml", "path": tmp_path / "path.csv", "record": tmp_path / "x.mcap"}
    good = LiveSettings(**files, arm="virtual")
    check_settings(replace(good, cores_tracking=THERE), "here")
    with pytest.raises(InputError, match=words):
        check_settings(replace(good, **change), "here")


@pytest.mark.parametrize("text", ["[arm]\nspeed = 3", "[arms]", "[print]\ndry_run = 1", '[cores]\nmotion = ["a"]'])
def test_a_key_that_nobody_reads_or_of_a_wrong_kind_is_an_error(text: str, tmp_path: Path) -> None:
    (tmp_path / "session.toml").write_text(text)
    with pytest.raises(InputError):
        read_settings(tmp_path / "session.toml")


def test_flags_override_and_what_was_not_given_does_not() -> None:
    given = override_settings(LiveSettings(lift=3.0, arm="a"), {"lift": None, "arm": "b"})
    assert given == LiveSettings(lift=3.0, arm="b")


@pytest.mark.parametrize("lift", [0.0, 20.0])
def test_a_lift_is_asked_for_in_a_dry_run_alone(lift: float) -> None:
    assert override_settings(LiveSettings(), {"lift": lift, "dry_run": True}).lift == lift
    assert override_settings(LiveSettings(dry_run=True), {"lift": lift, "dry_run": None}).lift == lift
    with pytest.raises(InputError, match=rf"--lift = {lift}, allowed with --dry-run"):
        override_settings(LiveSettings(), {"lift": lift, "dry_run": None})


def frames(count: int) -> FrameSet:
    images = [np.full((6, 8, 3), 10 * camera + count, np.uint8) for camera in range(2)]
    return FrameSet(float(count), tuple(Frame(c, float(count), image) for c, image in enumerate(images)))


def test_the_newest_of_the_frames_is_taken_whole_and_the_others_are_counted() -> None:
    ours, theirs = Pipe(duplex=False)
    ring = FrameRing([(8, 6), (8, 6)])
    source = RingSource(ring, ours)
    for count in (1, 2, 3):
        theirs.send(ring.put(frames(count), {0: ("jpeg", bytes([count] * 5))}, lambda: 13.0, 0.5))
    arrived = source.take(0.1)
    assert arrived is not None and arrived.dropped == 2 and arrived.handed == 13.0 and arrived.source == 0.5
    for got, sent in zip(arrived.frames.frames, frames(3).frames, strict=True):
        assert np.array_equal(got.image, sent.image) and got.stamp == 3.0
    assert arrived.encoded == {0: ("jpeg", b"\x03" * 5)}
    assert source.take(0.0) is None
    theirs.send("over")
    with pytest.raises(SourceEnded, match="over"):
        source.take(0.1)
    theirs.close()
    with pytest.raises(SourceEnded):
        source.take(0.1)


def test_frames_that_were_written_over_meanwhile_are_not_taken() -> None:
    ring = FrameRing([(8, 6), (8, 6)])
    word = ring.put(frames(1), {}, lambda: 0.0, 0.0)
    assert ring.take(word) is not None
    for count in range(RING_SLOTS):
        ring.put(frames(count + 2), {}, lambda: 0.0, 0.0)
    assert ring.take(word) is None


@pytest.mark.parametrize("raw", [False, True])
def test_a_recorder_that_takes_nothing_holds_up_nobody_and_what_finds_no_room_is_counted(raw: bool) -> None:
    ours, theirs = Pipe(duplex=False)
    box = RecorderSender(theirs)
    picture = SetEntry({0: 0.0}, {0: ("jpeg", bytes(4_000_000))})
    picture = unencoded(0.0, np.zeros((1250, 3200), np.uint8)) if raw else picture
    for _ in range(20):
        box.put(picture)
    assert 5 <= box.dropped <= 11
    before = box.dropped
    box.put(EventEntry(1.0, "small", 2, "x"))
    assert box.dropped == before  # pictures leave room for what is small
    found = list[Entry]()
    reader = threading.Thread(target=lambda: found.extend(_taken(RecorderReceiver(ours))))
    reader.start()
    box.close()
    reader.join(10)
    assert [type(entry) for entry in found] == [SetEntry] * (20 - before) + [EventEntry]
    box.put(picture)


def test_poses_that_died_with_the_tracking_process_are_recorded_once_the_motion_process_tells_them(
    tmp_path: Path,
) -> None:
    (first, tracking), (second, motion) = Pipe(duplex=False), Pipe(duplex=False)
    kept = LiveSettings(record=tmp_path / "run.mcap", arm="virtual", trace=False)
    recorder = SPAWN.Process(target=record, args=(kept, [first, second], SharedLatest[RecorderReport]()))
    recorder.start()
    first.close()
    second.close()
    by_tracking, by_motion = RecorderSender(tracking), RecorderSender(motion)
    poses = [replace(identity_pose(stamp, ""), state=TrackState.TRACKING) for stamp in (1.0, 1.1, 1.2)]
    by_tracking.put(rig())
    for pose in poses[:2]:
        by_tracking.put(PoseEntry(pose, no_observations(pose.stamp)))
    by_motion.put(UsedPoses(tuple(poses)))  # before the tracking process has ended
    by_motion.close()
    by_tracking.close()
    recorder.join(30)
    assert recorder.exitcode == 0
    assert [pose.stamp for pose in read_poses(tmp_path / "run.mcap")] == [1.0, 1.1, 1.2]


def _taken(inbox: RecorderReceiver) -> list[Entry]:
    taken = list[Entry]()
    while not inbox.ended:
        taken += map(deepcopy, inbox.take())  # pixels hold until the next entry
    return taken


def unencoded(stamp: float, *images: Image) -> SetEntry:
    taken = tuple(Frame(camera, stamp, image) for camera, image in enumerate(images))
    return SetEntry(dict.fromkeys(range(len(images)), stamp), {}, taken)


def test_pixels_go_through_the_pipe_as_they_lie_and_are_read_where_it_left_them() -> None:
    pictures = [image(0, 1), image(1, 1)[..., 0].copy()]
    head, *parts = packed(unencoded(1.0, *pictures))
    assert [np.shares_memory(part, picture) for part, picture in zip(parts, pictures, strict=False)] == [True, True]
    left = memoryview(bytearray(b"".join([head[ENTRY_HEAD.size :], *parts])))
    entry = unpacked(left, ENTRY_HEAD.unpack_from(head)[1])
    assert isinstance(entry, SetEntry)
    for frame, picture in zip(entry.frames, pictures, strict=True):
        assert np.shares_memory(frame.image, left) and np.array_equal(frame.image, picture)


@settings(max_examples=20)
@given(st.lists(st.lists(st.tuples(st.integers(1, 900), st.integers(1, 1200)), max_size=3), max_size=6))
def test_pictures_of_any_size_arrive_bit_by_bit_and_in_order(
    sizes: list[list[tuple[int, int]]],
) -> None:
    rng = np.random.default_rng(0)
    every = [[rng.integers(0, 256, (*size, 3), np.uint8) for size in each] for each in sizes]
    ours, theirs = Pipe(duplex=False)
    box, found = RecorderSender(theirs), list[Entry]()
    reader = threading.Thread(target=lambda: found.extend(_taken(RecorderReceiver(ours))))
    reader.start()
    for number, images in enumerate(every):
        box.put(unencoded(float(number), *images))
        box.put(EventEntry(float(number), "x" * number, 2, "test"))
    box.close()
    reader.join(10)
    assert [len(e.text) for e in found if isinstance(e, EventEntry)] == list(range(len(every)))
    taken = [[frame.image for frame in e.frames] for e in found if isinstance(e, SetEntry)]
    assert [len(images) for images in taken] == [len(images) for images in every]
    for one, other in zip(itertools.chain(*taken), itertools.chain(*every), strict=True):
        assert np.array_equal(one, other)


def test_a_sender_that_a_signal_interrupts_goes_on_where_it_was() -> None:
    handler = signal.signal(signal.SIGUSR1, lambda number, frame: None)
    ours, theirs = Pipe(duplex=False)
    box, found = RecorderSender(theirs), list[Entry]()
    try:
        box.put(unencoded(0.0, *(image(0, number) for number in range(100))))
        for _ in range(3):  # the pipe holds a fraction of it, so the sender waits
            time.sleep(0.1)
            signal.pthread_kill(box._thread.ident or 0, signal.SIGUSR1)
        reader = threading.Thread(target=lambda: found.extend(_taken(RecorderReceiver(ours))))
        reader.start()
        box.close()
        reader.join(10)
    finally:
        signal.signal(signal.SIGUSR1, handler)
    assert [len(entry.frames) for entry in found if isinstance(entry, SetEntry)] == [100]
    for entry in found:
        assert isinstance(entry, SetEntry)
        assert all(np.array_equal(frame.image, image(0, number)) for number, frame in enumerate(entry.frames))


@pytest.mark.slow
def test_raw_pixels_are_recorded_exactly_also_those_that_came_before_the_rig(tmp_path: Path) -> None:
    ours, theirs = Pipe(duplex=False)
    kept = LiveSettings(record=tmp_path / "run.mcap", arm="virtual", trace=False, jpeg_quality=0)
    recorder = SPAWN.Process(target=record, args=(kept, [ours], SharedLatest[RecorderReport]()))
    recorder.start()
    ours.close()
    box = RecorderSender(theirs)
    for number in range(400):  # 11 MB: more than the receiver's memory holds
        if number == 200:
            box.put(rig())
        box.put(unencoded(1.0 + number / 30, *(image(camera, number) for camera in range(3))))
    box.close(30)
    recorder.join(30)
    assert recorder.exitcode == 0 and box.dropped == 0
    sets = list(open_session(tmp_path / "run.mcap").frame_sets())
    assert len(sets) == 400
    for number, frames in enumerate(sets):
        assert all(np.array_equal(frame.image, image(frame.camera, number)) for frame in frames.frames)


@pytest.mark.slow
@pytest.mark.parametrize("real_time", [True, False])
def test_a_recorder_that_is_behind_goes_before_ordinary_work_until_it_is_not(tmp_path: Path, real_time: bool) -> None:
    ours, theirs = Pipe(duplex=False)
    chosen = LiveSettings(record=tmp_path / "run.mcap", arm="virtual", trace=False, real_time=real_time)
    recorder = SPAWN.Process(target=record, args=(chosen, [ours], reports := SharedLatest[RecorderReport]()))
    recorder.start()
    ours.close()
    sender, clock = RecorderSender(theirs), WallClock()
    sender.put(rig())
    for number in range(39):
        sender.put(SetEntry({0: 1.0 + number}, {0: ("png", bytes(1_000_000))}))
    policies, until = list[int](), clock.now() + 60
    while ((report := reports.get()) is None or report.written < 39e6) and clock.now() < until:
        policies.append(os.sched_getscheduler(recorder.pid))
    clock.wait_until(clock.now() + 0.5)
    policies.append(os.sched_getscheduler(recorder.pid))
    sender.close(30)
    recorder.join(30)
    assert recorder.exitcode == 0 and sender.dropped == 0
    assert (os.SCHED_FIFO in policies) == (real_time and real_time_granted()) and policies[-1] == os.SCHED_OTHER


def real_time_granted() -> bool:
    """Whether the system grants real-time priority here."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        return True
    return False


def test_a_sender_lets_go_of_the_pictures_that_a_killed_recorder_has_not_taken(tmp_path: Path) -> None:
    ours, theirs = Pipe(duplex=False)
    kept = LiveSettings(record=tmp_path / "run.mcap", arm="virtual", trace=False)
    recorder = SPAWN.Process(target=record, args=(kept, [ours], SharedLatest[RecorderReport]()))
    recorder.start()
    ours.close()
    recorder.kill()
    recorder.join(30)
    box, pictures = RecorderSender(theirs), [np.zeros((1000, 1000, 3), np.uint8) for _ in range(10)]
    held = [weakref.ref(picture) for picture in pictures]
    while pictures:
        box.put(unencoded(1.0, pictures.pop()))
    box.close()
    assert box.dropped >= 9 and [picture() for picture in held] == [None] * 10
    box.check()


@settings(max_examples=20)
@given(st.lists(st.integers(0, 5_000) | st.integers(900_000, 3_000_000), max_size=5))
def test_what_is_put_is_taken_in_order_however_large(sizes: list[int]) -> None:
    ours, theirs = Pipe(duplex=False)
    inbox, box = RecorderReceiver(ours), RecorderSender(theirs)
    found = list[Entry]()
    reader = threading.Thread(target=lambda: found.extend(_taken(inbox)))
    reader.start()
    for number, size in enumerate(sizes):
        box.put(EventEntry(float(number), "x" * size, 2, "test"))
    box.close()
    reader.join(10)
    assert [(e.stamp, len(e.text)) for e in found if isinstance(e, EventEntry)] == list(enumerate(sizes))


@given(st.lists(st.integers(0, 300), max_size=5), st.lists(st.integers(1, 200), min_size=1), st.integers(0, 2000))
def test_what_a_killed_sender_cut_short_is_left_out(sizes: list[int], pieces: list[int], cut: int) -> None:
    entries = [b"".join(packed(EventEntry(float(k), "x" * size, 2, "test"))) for k, size in enumerate(sizes)]
    data = b"".join(entries)[:cut]
    whole = int(np.searchsorted(np.cumsum([len(entry) for entry in entries]), len(data), "right"))
    ours, theirs = Pipe(duplex=False)
    inbox, found, begin = RecorderReceiver(ours), list[Entry](), 0
    for size in itertools.cycle(pieces):
        if begin >= len(data):
            break
        begin += os.write(theirs.fileno(), data[begin : begin + size])
        found += inbox.take()
    theirs.close()
    found += _taken(inbox)
    assert [len(e.text) for e in found if isinstance(e, EventEntry)] == sizes[:whole]


@given(st.integers(20, 200), st.integers(0, 2**31))
def test_a_session_shown_to_and_fro_is_smooth_where_it_turns(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(rng.uniform(0.02, 0.05, count))
    places = np.sin(2 * np.pi * stamps / stamps[-1] * 4 + rng.uniform(0, 6))
    truth = Trajectory(stamps, se3.make(np.eye(3), np.outer(places, [0, 0, 3.0])), True)
    first, last = turning_sets(truth, stamps)
    assert 0 <= first < last < count
    shown = schedule(stamps, 100.0, (first, last))
    showings = [next(shown) for _ in range(4 * count)]
    live, index = np.array([s.live for s in showings]), np.array([s.index for s in showings])
    assert (np.diff(live) > 0).all() and live[0] == 100.0
    assert set(np.abs(np.diff(index))) == {1} and index.min() == first and index.max() == last
    assert np.diff(live) == pytest.approx(np.abs(np.diff(stamps[index])))


def test_a_session_without_truth_is_shown_once() -> None:
    shown = list(schedule(np.array([3.0, 3.1, 3.3]), 50.0, None))
    assert [s.index for s in shown] == [0, 1, 2] and [s.live for s in shown] == pytest.approx([50.0, 50.1, 50.3])


def test_the_place_of_a_path_is_kept_and_read_back(tmp_path: Path) -> None:
    path = raster()
    write_progress_durably(tmp_path / "x.toml", fingerprint(path), 3.0625)
    assert read_progress(tmp_path / "x.toml", path) == 3.0625
    with pytest.raises(InputError):
        read_progress(tmp_path / "x.toml", raised_path(path, 1.0))


def test_a_place_is_kept_without_a_new_name_in_the_table_of_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interned, intern = list[str](), sys.intern
    monkeypatch.setattr(sys, "intern", lambda name: interned.append(name) or intern(name))
    file = tmp_path / "x.toml"
    interned.clear()
    for fraction in (1.0, 2.0):  # ten a second for hours
        write_progress_durably(file, "abc", fraction)
    assert not interned and "fraction = 2.0" in file.read_text(encoding="utf-8")


def test_where_the_path_lies_is_kept_to_the_last_digit(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").touch()
    pose = se3.make(se3.exp_rotation([0.1, 0.2, 0.3]), np.array([1 / 3, 2 / 3, 1e-9]))
    (tmp_path / "x.toml").write_text(
        placement_text(SurfacePlacement(tmp_path / "run.mcap", 1 / 7, pose, se3.inverse(pose)))
    )
    found = read_placement(tmp_path / "x.toml")
    assert (found.surface_from_path == pose).all() and (found.arm_from_base == se3.inverse(pose)).all()
    assert found.until == 1 / 7 and found.since == -np.inf and not found.certain and not found.verdict
    said = SurfacePlacement(tmp_path / "run.mcap", 0.5, pose, pose, 0.25, True, 'by "hand" \\ and a scan')
    (tmp_path / "z.toml").write_text(placement_text(said))
    again = read_placement(tmp_path / "z.toml")
    assert (again.since, again.certain, again.verdict) == (said.since, True, said.verdict)
    for name in ("gone.mcap", 800 * "x"):
        (tmp_path / "y.toml").write_text(placement_text(SurfacePlacement(tmp_path / name, 0.0, pose, pose)))
        with pytest.raises(InputError, match="map"):
            read_placement(tmp_path / "y.toml")
    assert RunFiles(tmp_path / "run.mcap").next().record == tmp_path / "run-2.mcap"
    assert RunFiles(tmp_path / "run-2.mcap").next().record == tmp_path / "run-3.mcap"


RIG = (
    '[[camera]]\nname = "a"\nsource = "usb:1"\nsize = [8, 6]\nmatrix = [[9, 0, 4], [0, 9, 3], [0, 0, 1]]\n'
    "distortion = [0, 0, 0, 0, 0]\nbase_from_camera = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
)


def scan_given(folder: Path, surface: str, scan: str) -> Path | None:
    """The scan of a run whose rig.toml names one, and whose settings another; each is a name, or "" for none."""
    (folder / "rig.toml").write_text((f'surface = "{surface}"\n' if surface else "") + RIG)
    write_path(folder / "path.csv", raster())
    for name, size in (("one.ply", 40.0), ("copy.ply", 40.0), ("other.ply", 50.0)):
        made = height_field(body, (size, size), 4.0)
        write_ply(folder / name, vertices=made.vertices, triangles=made.triangles)
    (folder / "broken.ply").write_text("no scan")
    given = {"scan": folder / scan} if scan else {}
    files = {"rig": folder / "rig.toml", "path": folder / "path.csv", "record": folder / "run.mcap"}
    return prepare(LiveSettings(arm="virtual", page=False, **files, **given), "here", True).scan


@pytest.mark.parametrize(
    ("surface", "scan", "used"),
    [("", "", None), ("one.ply", "copy.ply", "copy.ply")]
    + [
        pytest.param(*more, marks=pytest.mark.slow) for more in (("one.ply", "", "one.ply"), ("", "one.ply", "one.ply"))
    ],
)
def test_the_scan_of_live_cameras_is_the_one_that_is_named(
    surface: str, scan: str, used: str | None, tmp_path: Path
) -> None:
    assert scan_given(tmp_path, surface, scan) == (None if used is None else tmp_path / used)


@pytest.mark.parametrize(
    ("surface", "scan", "words"),
    [
        ("one.ply", "other.ply", r"other\.ply: scan = 'other than one\.ply of rig\.toml', allowed one scan"),
        ("", "broken.ply", r"broken\.ply"), ("broken.ply", "", r"broken\.ply"), ("", "gone.ply", "a file that exists"),
        ("gone.ply", "", "surface = 'gone.ply', allowed a file that is there"), ("path.csv", "", "allowed a file .ply"),
    ],
)  # fmt: skip
def test_two_scans_and_one_that_cannot_be_read_are_refused(surface: str, scan: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        scan_given(tmp_path, surface, scan)


def test_a_run_that_resumes_one_that_resumed_knows_what_the_first_one_found(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(RIG)
    write_path(tmp_path / "path.csv", raster())
    record, names = tmp_path / "run.mcap", ("rig.toml", "path.csv")
    rig, path = (tmp_path / name for name in names)
    first = prepare(LiveSettings(rig=rig, path=path, arm="virtual", record=record), "here", False)
    first.files.session.write_text(settings_text(first.settings))
    place = se3.make(np.eye(3), np.array([1.0, 2, 3]))
    first.files.surface.write_text(placement_text(SurfacePlacement(rig, 5.0, place, se3.inverse(place))))
    write_progress_durably(first.files.progress, fingerprint(first.task.path), 2.5)
    for _ in range(3):
        record.touch()
        again = prepare_resumed(record, {})
        assert again.notes[0].startswith("goes on at ") and f"where {record.name} stopped" in again.notes[0]
        assert again.task.start == 2.5 and again.placement is not None and again.placement.map == rig
        assert (again.task.profile.arm.arm_from_base == se3.inverse(place)).all() and not again.task.place
        record = again.files.record
        again.files.session.write_text(settings_text(again.settings))
    assert record.name == "run-4.mcap"


def test_what_is_begun_is_what_the_recording_holds() -> None:
    begin = BeginPrint(raster(), replace(PROFILE, lag=0.1 / 3), 0.0, {}, "x")
    texts, used = recorded_begin(begin)
    again, same = recorded_begin(used)
    assert used.profile.lag == begin.profile.lag
    assert (same.path.surface_from_nozzle == used.path.surface_from_nozzle).all()
    assert used.path.surface_from_nozzle == pytest.approx(begin.path.surface_from_nozzle, abs=1e-12)
    assert set(texts) == set(again)


DISPENSER = """[[dispenser]]
name = "syringe"
materials = [{materials}]
preset = "{preset}"
port = "/dev/none"
on_dead_time_s = {dead}
nozzle_offset_mm = [0, 5, 0]
kept_at_c = 20
"""


def dispensing(
    folder: Path, materials: str = "1, 2", preset: str = "arduino", dead: float = 0.08, **settings: object
) -> LiveSettings:
    """A run with live cameras and a dispenser."""
    rows = "size = [8, 6]\nmatrix = [[9, 0, 4], [0, 9, 3], [0, 0, 1]]\ndistortion = [0, 0, 0, 0, 0]\n"
    place = f"base_from_camera = {np.eye(4).tolist()}\n"
    (folder / "rig.toml").write_text(f'[[camera]]\nname = "a"\nsource = "usb:1"\n{rows}{place}')
    (folder / "d.toml").write_text(DISPENSER.format(materials=materials, preset=preset, dead=dead))
    path = raster()
    write_path(folder / "path.csv", replace(path, material=np.where(np.arange(len(path)) < 3, 1, 2)))
    files = {name: folder / f"{name}.{end}" for name, end in (("rig", "toml"), ("path", "csv"))}
    rest = {"arm": "virtual", "record": folder / "run.mcap", "dispensers": folder / "d.toml"} | settings
    return LiveSettings(**files, **rest)  # type: ignore[arg-type]


def test_a_dispenser_without_a_watchdog_is_told_to_the_operator(tmp_path: Path) -> None:
    assert prepare(dispensing(tmp_path), "here", False).notes == ()
    notes = prepare(dispensing(tmp_path, preset="usb_relay"), "here", False).notes
    assert len(notes) == 1 and notes[0].startswith("dispenser syringe has no watchdog")
    (note,) = prepare(dispensing(tmp_path, dispensers=None), "here", False).notes
    assert note == "no dispenser is given: nothing is extruded"
    adapting, path = dispensing(tmp_path, dispensers=None, look="layer", adapt=True), raster()
    extra = {name: np.full(len(path), size) for name, size in (("width_mm", 0.6), ("height_mm", 0.3))}
    write_path(tmp_path / "path.csv", replace(path, extra=extra))
    (note,) = prepare(adapting, "here", False).notes
    assert note == "no dispenser is given: nothing is extruded, and no flow is adapted"


def test_limits_far_beyond_the_usual_ones_are_told_to_the_operator(tmp_path: Path) -> None:
    (tmp_path / "arm.toml").write_text("[limits]\nfeed = 2000\n")
    (note,) = prepare(dispensing(tmp_path, profile=tmp_path / "arm.toml"), "here", False).notes
    assert note.startswith("limits far beyond a SEED S6H4D's: limits.feed = 2000, ")


def test_a_dry_run_opens_no_dispenser_and_asks_for_no_material(tmp_path: Path) -> None:
    task = prepare(dispensing(tmp_path, dry_run=True), "here", False).task
    assert task.dispensers == "" and task.outlets == {}
    assert len(set(raised_path(task.path, 5.0).material.tolist())) == 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"unattended": True}, ["print.unattended", "a dispenser for each material"]),
        ({"materials": "1"}, ["material", "2"]),
        ({"dead": 0.5}, ["d.toml", "syringe: delay on", "0 to 0.4 s"]),
        ({"adapt": True, "look": "layer"}, ["d.toml", "print.adapt", "that are metered"]),
    ],
)
def test_what_no_dispenser_can_do_is_refused_before_the_run(
    tmp_path: Path, changes: dict[str, object], words: list[str]
) -> None:
    (tmp_path / "d.toml").touch()
    with pytest.raises(InputError) as caught:
        prepare(dispensing(tmp_path, **changes), "here", False)  # type: ignore[arg-type]
    assert all(word in str(caught.value) for word in words)


def test_the_outlets_of_what_is_begun_are_in_the_recording(tmp_path: Path) -> None:
    task = prepare(dispensing(tmp_path), "here", False).task
    begin = BeginPrint(task.path, PROFILE, 0.0, {}, "x")
    texts, used = recorded_begin(begin, task.dispensers)
    assert texts["dispenser.toml"] == (tmp_path / "d.toml").read_text()
    assert used.outlets == task.outlets == dict.fromkeys("12", Outlet(SwitchDelay(0.08, 0.0), (0.0, 5.0, 0.0)))


TICK = 0.05  # s


@given(seconds=st.floats(0.1, 400.0), seed=st.integers(0, 1000))
def test_the_largest_error_and_the_time_of_holds_stay_where_they_were(seconds: float, seed: int) -> None:
    draw, course = np.random.default_rng(seed), ErrorTimeline()
    stamps = 1000.0 + np.arange(0.0, seconds, TICK)
    error = np.where(draw.random(len(stamps)) < 0.3, np.nan, draw.exponential(0.1, len(stamps)))
    held = np.where(np.isnan(error), TICK, 0.0)
    for tick in zip(stamps.tolist(), error.tolist(), held.tolist(), strict=True):
        course.add(*tick)
    known = len(course.stamps)
    assert known <= TIMELINE_BINS == len(course.error) == len(course.held)
    assert course.stamps[-1] == pytest.approx(stamps[-1] - stamps[0], abs=course.width)
    assert course.width == FIRST_BIN_WIDTH or seconds > TIMELINE_BINS / 2 * course.width
    assert course.held.sum() == pytest.approx(held.sum()) and not course.held[known:].any()
    if np.isfinite(error).any():
        largest = np.nanargmax(error)
        assert np.nanmax(course.error) == error[largest]
        where = course.stamps[np.nanargmax(course.error[:known])]
        assert where == pytest.approx(stamps[largest] - stamps[0], abs=course.width)
    else:
        assert np.isnan(course.error).all()


def test_a_lag_that_is_learned_anew_during_a_run_is_followed_in_steps() -> None:
    """The lag was taken for 80 ms at the start, is known better after a while, and is lost and found again."""
    lags = {0: 0.076, 40: 0.05, 41: 0.02, 80: float("nan"), 90: 0.0205}
    now_known = lags[0]
    begin = BeginPrint(raster(), replace(PROFILE, lag=0.076 + PROFILE.frame_time), 0.0, {}, "x")
    motion = PrintMotion(PROFILE, SimClock(), c_double(), None, lambda: now_known)
    unchanged = PrintMotion(PROFILE, SimClock(), c_double(), None, lambda: 0.076)
    motion.follow(begin)
    unchanged.follow(begin)
    known, same = [motion.arm_lag], list[bool]()
    for k in range(120):
        now, now_known = 10 + 0.02 * k, lags.get(k, now_known)
        pose = pose_at(breathing, now)
        frames = [frame_from_command(each(pose, now), PROFILE.dialect) for each in (motion, unchanged)]
        known.append(motion.arm_lag)
        same.append(frames[0] == frames[1])
    assert [k for k in range(120) if known[k + 1] != known[k]] == [40, 41] and LAG_STEP > 0.001
    assert all(same[:40]) and not all(same)


class Broken:
    """Stands for a place, or for a pipe, of which the use fails in a way that nobody thought of."""

    def __init__(self) -> None:
        self.asked = threading.Event()

    @property
    def value(self) -> float:
        self.asked.set()
        raise RuntimeError("out of its mind")

    def fileno(self) -> int:
        raise RuntimeError("out of its mind")

    def close(self) -> None:
        self.asked.set()


def test_whatever_ends_the_thread_that_keeps_the_place_is_told(tmp_path: Path) -> None:
    place = Broken()
    writer = ProgressWriter(tmp_path / "progress.toml", "x", place)
    assert place.asked.wait(5)
    writer.close()
    assert writer.failed == f"{tmp_path / 'progress.toml'}: RuntimeError: out of its mind"


def test_whatever_ends_the_thread_that_sends_to_the_recorder_is_told() -> None:
    pipe = Broken()
    sender = RecorderSender(pipe)
    sender.check()
    for _ in range(2):
        sender.put(EventEntry(0.0, "x", 2, "y"))
    assert pipe.asked.wait(5)
    sender.close()
    assert sender.failed == "RuntimeError: out of its mind" and sender.dropped == 1  # the other one was being sent
    with pytest.raises(StillbedError, match="the recording has failed: RuntimeError: out of its mind"):
        sender.check()
    sender.put(EventEntry(0.0, "x", 2, "y"))
    assert sender.dropped == 2


def test_what_a_recorder_has_not_taken_when_its_sender_is_closed_is_counted() -> None:
    ours, theirs = Pipe(duplex=False)
    receiver, sender = RecorderReceiver(ours), RecorderSender(theirs)
    for size in (1, 1, *[3_000_000] * 4):  # more than a pipe holds
        sender.put(EventEntry(0.0, "x" * size, 2, "y"))
    sender.close(0.2)
    assert sender.dropped == 4 and len(list(receiver.take())) == 2
    ours.close()


def test_a_sender_whose_recorder_has_ended_is_no_failure_of_its_own() -> None:
    ours, theirs = Pipe(duplex=False)
    sender = RecorderSender(theirs)
    ours.close()
    sender.put(EventEntry(0.0, "x", 2, "y"))
    sender.close()
    sender.check()


SCENARIO = 'title = "t"\nseconds = 2\npath = "path.csv"\n'


@pytest.mark.parametrize(
    ("changes", "faults", "words"),
    [
        ({"profile": "wrong.toml"}, [], ["wrong.toml", "lag_s"]),
        ({"path": "wrong.csv"}, [], ["wrong.csv"]),
        ({"dispensers": "wrong.toml"}, [], ["wrong.toml", "lag_s"]),
        ({"dispensers": "d.toml"}, [], ["material", "2"]),
        ({"model": "wrong.onnx"}, [], ["wrong"]),
        ({}, ["camera5 off at 1s"], ["camera0 to camera2"]),
        ({"page": False}, ["page flood at 1s"], ["--no-page"]),
        ({"arm": "/dev/none"}, ["camera0 off at 1s"], ["a virtual arm alone"]),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_before_a_scenario_is_rendered_and_takes_nothing_away(
    changes: dict[str, object], faults: list[str], words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = raster()
    write_path(tmp_path / "path.csv", replace(path, material=np.where(np.arange(len(path)) < 3, 1, 2)))
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    (tmp_path / "d.toml").write_text(DISPENSER.format(materials="1", preset="arduino", dead=0.08))
    for name, text in (("wrong.toml", "lag_s = -1\n"), ("wrong.csv", "x\n1\n"), ("wrong.onnx", "")):
        (tmp_path / name).write_text(text)
    record = tmp_path / "run.mcap"
    record.write_bytes(b"an earlier run")
    files = RunFiles(record)
    files.progress.write_text("an earlier place")
    names = {key: tmp_path / str(value) if key not in ("page", "arm") else value for key, value in changes.items()}
    given = {"simulated": tmp_path / "scenario.toml", "arm": "virtual", "record": record} | names
    with pytest.raises(StillbedError) as caught:
        asked = faults_from_texts("command line", "--fault", faults)
        prepare(LiveSettings(**given), "here", True, asked)  # type: ignore[arg-type]
    assert all(word in str(caught.value) for word in words)
    assert not (tmp_path / "cache" / "stillbed").exists() and files.progress.read_text() == "an earlier place"


def test_nothing_of_an_earlier_run_stays_beside_the_recording_of_a_new_one(tmp_path: Path) -> None:
    settings = dispensing(tmp_path)
    assert settings.record is not None
    files = RunFiles(settings.record)
    of_a_run = (files.progress, files.surface, files.executed, files.report, files.summary)
    for file in (files.record, *of_a_run):
        file.write_text("earlier")
    prepare(settings, "here", True)
    assert files.record.exists() and not any(file.exists() for file in of_a_run)


@pytest.mark.parametrize("number", slowly(signal.SIGINT, signal.SIGTERM))
def test_a_signal_while_a_scene_is_rendered_ends_it_at_once_and_leaves_nothing(tmp_path: Path, number: int) -> None:
    cache = tmp_path / "stillbed"
    (cache / "old-1.part-999999999").mkdir(parents=True)  # left by one that was killed
    scenario = Path(__file__).parents[1] / "data" / "live" / "small.toml"
    command = [sys.executable, "-m", "hardware.cli.main", "live", "--simulated", str(scenario), "--no-page"]
    run = subprocess.Popen(
        [*command, "--record", str(tmp_path / "run.mcap"), "--yes"],
        env=os.environ | {"XDG_CACHE_HOME": str(tmp_path)}, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    end = time.monotonic() + 60
    while not (halves := [half for half in cache.glob("*.part-*") if (half / "session.mcap").exists()]):
        assert run.poll() is None and time.monotonic() < end
        time.sleep(0.02)
    child = int(halves[0].name.rpartition("-")[2])
    (os.killpg if number == signal.SIGINT else os.kill)(run.pid, number)  # Ctrl-C reaches all of them
    begun = time.monotonic()
    _, said = run.communicate(timeout=20)
    assert time.monotonic() - begun < 3.0  # at most 1.1 s were seen, beside ten busy processes
    assert not list(cache.glob("*")) and not Path(f"/proc/{child}").exists()
    assert "Traceback" not in said and run.returncode == 130


def test_a_scene_is_found_again_by_what_is_in_its_files(tmp_path: Path) -> None:
    (tmp_path / "path.csv").write_text("a")
    (tmp_path / "rig.toml").write_text("b")
    file = tmp_path / "x.toml"
    file.write_text('path = "path.csv"\n[rig]\nfile = "rig.toml"\n')
    first = cached(file, tmp_path).folder
    assert cached(file, tmp_path).folder == first != cached(file, tmp_path, 2.0).folder
    (tmp_path / "rig.toml").write_text("c")
    second = cached(file, tmp_path).folder
    (tmp_path / "rig.toml").write_text("")
    (tmp_path / "path.csv").write_text("ac")  # the same letters, of another file
    assert len({first, second, cached(file, tmp_path).folder}) == 3


def test_the_cache_tells_its_size_and_is_cleared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    scene = tmp_path / "stillbed" / "small-1"
    scene.mkdir(parents=True)
    (scene / "scenario").write_text("/x/small.toml")
    (scene / "session.mcap").write_bytes(bytes(2_500_000))
    assert main(["cache"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "   2.5 MB  small-1: /x/small.toml", f"1 scene in {tmp_path / 'stillbed'}: 2.5 MB",
    ]  # fmt: skip
    assert main(["cache", "--clear"]) == 0 and not scene.exists()
    assert capsys.readouterr().out == f"1 scene removed from {tmp_path / 'stillbed'}: 2.5 MB\n"


def test_a_wait_ends_with_the_bell_and_a_ring_is_not_lost() -> None:
    bell, clock = Bell(), WallClock()
    bell.ring()  # before the wait
    begun = clock.now()
    bell.wait(20.0)
    threading.Timer(0.05, bell.ring).start()
    bell.wait(20.0)  # while it waits
    assert clock.now() - begun < 10.0
    for _ in range(MOST_RINGS + 10):  # nobody hears them: ringing does not wait either
        bell.ring()
    bell.wait(20.0)
    begun = clock.now()
    bell.wait(0.05)  # all of them were heard at once
    bell.wait(-1.0)
    assert 0.05 <= clock.now() - begun < 10.0


def test_what_steps_back_is_ordinary_and_each_process_is_a_session() -> None:
    code = (
        "import os\n"
        "from hardware.process.system import ask_for_real_time, set_up_process, step_back\n"
        "set_up_process('x')\n"
        "asked = ask_for_real_time(5)\n"
        "before = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority\n"
        "step_back(3)\n"
        "print(os.getsid(0) == os.getpid() == os.getpgid(0), asked, *before, os.sched_getscheduler(0))\n"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    real = "real" in told
    assert told[0] == "True" and told[-1] == str(os.SCHED_OTHER)
    assert told[-3:-1] == ([str(os.SCHED_FIFO), "5"] if real else [str(os.SCHED_OTHER), "0"])


def test_who_answers_goes_first_with_all_its_threads_and_what_it_starts_does_not() -> None:
    code = (
        "import os, subprocess, threading\n"
        "from hardware.process.system import answer_first\n"
        "threading.Thread(target=threading.Event().wait, daemon=True).start()\n"
        "answer_first()\n"
        "plain = lambda thread: os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK\n"
        "print(*{plain(int(thread)) for thread in os.listdir('/proc/self/task')})\n"
        "child = subprocess.Popen(['sleep', '9'])\n"
        "print(plain(child.pid))\n"
        "child.kill()\n"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert told in ([str(os.SCHED_FIFO), str(os.SCHED_OTHER)], [str(os.SCHED_OTHER)] * 2)  # whether granted or not
