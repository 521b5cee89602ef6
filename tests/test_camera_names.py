"""Names of cameras that stay, controls read back; frame sets of jittering cameras are whole, never wrong."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.rig import Camera, Rig
from hardware.cameras.capture import (
    Control,
    ignored_controls,
    lock_controls,
    locked_exposure,
    read_controls,
    request_picture,
)
from hardware.cameras.feed import Arrival
from hardware.cameras.live import LEADER_HYSTERESIS, FrameSetBuilder
from hardware.cameras.sources import (
    CONTROL_RANGES,
    CameraSource,
    Identity,
    SourceKind,
    device_node,
    identity_from_text,
    list_devices,
    read_live_rig,
    source_from_table,
)
from hardware.cli.live import NO_CAMERA_TEXT, list_text
from hardware.files.rig_file import read_rig, write_rig
from perception.frames import Frame
from tests.campaigns.detection import CAMERA_OFFSETS, FRAME_PERIOD, CameraJitter, pair_frames, sent_frames

BY_ID = "/dev/v4l/by-id/usb-Maker_Eye_A1-video-index0"
NAMED = Identity(SourceKind.DEVICE, BY_ID)


def plugged_in(root: Path, number: int, name: str, serial: str, by_id: bool = True) -> None:
    """A camera as Linux shows it: a node for pictures and one for metadata, links, and the USB device's serial."""
    usb = root / f"sys/devices/usb1/1-{number}"
    (usb / f"1-{number}:1.0").mkdir(parents=True)
    if serial:
        (usb / "serial").write_text(serial + "\n")
    for index in range(2):
        node = root / f"dev/video{number + index}"
        entry = root / f"sys/class/video4linux/{node.name}"
        node.parent.mkdir(exist_ok=True)
        node.touch()
        entry.mkdir(parents=True)
        (entry / "index").write_text(f"{index}\n")
        (entry / "name").write_text(name + "\n")
        (entry / "device").symlink_to(usb / f"1-{number}:1.0")
        links = {"by-path": f"pci-0-usb-0:{number}:1.0-video-index{index}"}
        if by_id:
            links["by-id"] = f"usb-{name.replace(' ', '_')}_{serial}-video-index{index}"
        for folder, link in links.items():
            (root / "dev/v4l" / folder).mkdir(parents=True, exist_ok=True)
            (root / "dev/v4l" / folder / link).symlink_to(f"../../{node.name}")


def test_cameras_are_listed_by_names_that_stay(tmp_path: Path) -> None:
    plugged_in(tmp_path, 0, "Maker Eye", "A1")
    plugged_in(tmp_path, 10, "Cheap", "", by_id=False)
    first, second = list_devices(tmp_path)
    assert (first.identity, first.serial, first.name) == (BY_ID, "A1", "Maker Eye")
    assert second.identity == "/dev/v4l/by-path/pci-0-usb-0:10:1.0-video-index0"
    text = list_text((first, second))
    assert BY_ID in text and "usb:A1" in text and second.identity in text
    assert list_text(list_devices(tmp_path / "empty")) == NO_CAMERA_TEXT


def test_a_name_leads_to_the_camera_wherever_it_is_plugged_in(tmp_path: Path) -> None:
    plugged_in(tmp_path, 4, "Maker Eye", "A1")
    for text in (BY_ID, "usb:A1", "/dev/v4l/by-path/pci-0-usb-0:4:1.0-video-index0"):
        node = device_node(identity_from_text("here", "source", text, tmp_path, tmp_path), tmp_path)
        assert node is not None and node.resolve() == (tmp_path / "dev/video4").resolve()
    assert device_node(Identity(SourceKind.DEVICE, "usb:B2"), tmp_path) is None
    plugged_in(tmp_path, 8, "Maker Twin", "A1")
    assert device_node(Identity(SourceKind.DEVICE, "usb:A1"), tmp_path) is None  # two of them: neither is meant


@pytest.mark.parametrize("index", ["0", "-1", "/dev/video0", "video0"])
def test_an_index_is_refused_with_what_to_write_instead(tmp_path: Path, index: str) -> None:
    with pytest.raises(InputError, match="stillbed cameras"):
        identity_from_text("here", "source", index, tmp_path, tmp_path)
    plugged_in(tmp_path, 0, "Maker Eye", "A1")
    with pytest.raises(InputError, match=BY_ID):
        identity_from_text("here", "source", index, tmp_path, tmp_path)


def test_urls_and_files_name_themselves_and_nothing_else_does(tmp_path: Path) -> None:
    (tmp_path / "a.avi").touch()
    assert identity_from_text("here", "source", "rtsp://10.0.0.2/x", tmp_path).kind is SourceKind.STREAM
    found = identity_from_text("here", "source", "a.avi", tmp_path)
    assert found == Identity(SourceKind.FILE, str((tmp_path / "a.avi").resolve()))
    assert identity_from_text("here", "source", "/dev/wound_left", tmp_path).kind is SourceKind.DEVICE
    for wrong in ("b.avi", "ftp://10.0.0.2/x", "usb:", "."):
        with pytest.raises(InputError, match="usb:SERIAL"):
            identity_from_text("here", "source", wrong, tmp_path)


@pytest.mark.parametrize("secret", ["p", "p@ss:w", ""])
def test_a_password_is_not_shown(secret: str) -> None:
    shown = Identity(SourceKind.STREAM, f"rtsp://me:{secret}@10.0.0.2:554/x?y=@").shown
    assert shown == "rtsp://me:***@10.0.0.2:554/x?y=@"
    for plain in ("rtsp://10.0.0.2:554/x", "http://h/a:b@c", BY_ID):
        assert Identity(SourceKind.STREAM, plain).shown == plain


def rig_file(folder: Path, *keys: str) -> Path:
    """A rig.toml of a camera each, with further keys."""
    matrix, straight = np.diag([1000.0, 1000.0, 1.0]), np.zeros(5)
    poses = [np.eye(4) + 100 * i * np.eye(4, k=3) for i in range(len(keys))]
    cameras = tuple(Camera(f"c{i}", (1280, 720), matrix, straight, pose) for i, pose in enumerate(poses))
    write_rig(folder / "rig.toml", Rig(cameras), [None] * len(keys))
    blocks = (folder / "rig.toml").read_text().split("[[camera]]\n")
    text = blocks[0] + "".join(f"[[camera]]\n{more}\n{block}" for more, block in zip(keys, blocks[1:], strict=True))
    (folder / "rig.toml").write_text(text)
    return folder / "rig.toml"


def test_a_rig_names_its_live_cameras_and_is_still_a_sessions(tmp_path: Path) -> None:
    told = 'exposure_s = 0.008\ngain = 32\nfocus_abs = 40\nwhite_balance_k = 4500\nfps = 30.0\nformat = "MJPG"'
    path = rig_file(tmp_path, f'source = "{BY_ID}"\n{told}', 'source = "http://10.0.0.2/x"')
    rig, sources = read_live_rig(path)
    assert [c.name for c in rig.cameras] == ["c0", "c1"]
    assert sources[0] == CameraSource(NAMED, 0.008, 32, 40, 4500, 30.0, "MJPG")
    assert sources[1] == CameraSource(Identity(SourceKind.STREAM, "http://10.0.0.2/x"))
    assert read_rig(path).sources == (None, None)


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ("gain = 3", "source = 'missing'"),
        ("source = 0", "'0'"),
        ('source = "http://h/1"\nexposure_ms = 8', "did you mean 'exposure_s'"),
        ('source = "http://h/1"\nformat = "MJPEG"', "four characters"),
        ('source = "http://h/0"', "a source of its own; camera 'c0' has this one"),
    ],
)
def test_what_is_wrong_with_a_live_rig_is_told(tmp_path: Path, keys: str, told: str) -> None:
    with pytest.raises(InputError, match=told):
        read_live_rig(rig_file(tmp_path, 'source = "http://h/0"', keys))


@pytest.mark.parametrize("key", list(CONTROL_RANGES))
def test_a_control_may_be_at_the_ends_of_its_range_and_not_beyond(tmp_path: Path, key: str) -> None:
    low, high = CONTROL_RANGES[key]
    for value in (low, high):
        source_from_table("here", "c", {"source": "http://h/1", key: value}, tmp_path)
    for value in (math.nextafter(low, -math.inf), math.nextafter(high, math.inf)):
        with pytest.raises(InputError, match=key):
            source_from_table("here", "c", {"source": "http://h/1", key: value}, tmp_path)


class Driver:
    """Controls as a driver has them: some are not there, gain is clamped, the automatics overrule what is set."""

    def __init__(self, most_gain: float = 255.0, focus: bool = True) -> None:
        self.most_gain = most_gain
        self.values = {
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"YUYV")),
            cv2.CAP_PROP_FPS: 30.0,
            cv2.CAP_PROP_FRAME_WIDTH: 640.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 480.0,
            cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
            cv2.CAP_PROP_EXPOSURE: 250.0,
            cv2.CAP_PROP_GAIN: 0.0,
            cv2.CAP_PROP_AUTO_WB: 1.0,
            cv2.CAP_PROP_WB_TEMPERATURE: 6500.0,
        }
        if focus:
            self.values |= {cv2.CAP_PROP_AUTOFOCUS: 1.0, cv2.CAP_PROP_FOCUS: 0.0}

    def set(self, control: int, value: float) -> bool:
        automatic = {cv2.CAP_PROP_EXPOSURE: self.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 3.0}
        if control in self.values and not automatic.get(control, False):
            self.values[control] = min(value, self.most_gain) if control == cv2.CAP_PROP_GAIN else float(round(value))
        return True  # which promises nothing

    def get(self, control: int) -> float:
        return self.values.get(control, -1.0)


ASKED = CameraSource(NAMED, exposure=0.00812, gain=32, focus=40, white_balance=4500, fps=30.0, format="MJPG")


def test_controls_are_locked_and_read_back() -> None:
    driver = Driver()
    request_picture(driver, ASKED, (1280, 720))
    lock_controls(driver, ASKED)
    controls = {control.name: control for control in read_controls(driver, ASKED)}
    assert all(control.accepted and not control.automatic for control in controls.values())
    assert controls["exposure_s"].actual == pytest.approx(0.0081) and controls["format"].actual == "MJPG"
    assert driver.values[cv2.CAP_PROP_FRAME_WIDTH] == 1280 and driver.values[cv2.CAP_PROP_FRAME_HEIGHT] == 720


def test_what_a_driver_did_not_take_is_named_with_what_it_does_instead() -> None:
    driver = Driver(most_gain=16.0, focus=False)
    lock_controls(driver, ASKED)
    refused = [str(control) for control in read_controls(driver, ASKED) if not control.accepted]
    assert refused == ["format YUYV, asked for MJPG", "gain 16, asked for 32", "focus_abs not there, asked for 40"]


def test_what_was_not_asked_for_is_left_as_it_is_and_told_to_be_automatic() -> None:
    driver, nothing = Driver(), CameraSource(NAMED)
    before = dict(driver.values)
    request_picture(driver, nothing, None)
    lock_controls(driver, nothing)
    controls = read_controls(driver, nothing)
    assert driver.values == before and all(control.accepted for control in controls)
    assert [c.name for c in controls if c.automatic] == ["exposure_s", "focus_abs", "white_balance_k"]


def test_an_exposure_is_taken_to_half_a_step_and_not_beyond() -> None:
    assert Control("exposure_s", 0.001, 0.00105).accepted and not Control("exposure_s", 0.001, 0.001051).accepted
    assert not Control("exposure_s", 0.001, 0.001, automatic=True).accepted


def test_only_an_exposure_that_is_locked_is_known() -> None:
    assert locked_exposure([Control("gain", None, 3.0), Control("exposure_s", None, 0.004)]) == 0.004
    assert locked_exposure([Control("exposure_s", None, 0.004, automatic=True)]) == 0.0
    assert locked_exposure([Control("exposure_s", 0.008, 0.004)]) == locked_exposure([]) == 0.0


def test_a_stream_takes_no_controls_and_says_so() -> None:
    stream = CameraSource(Identity(SourceKind.STREAM, "http://h/1"), gain=3)
    assert [control.accepted for control in ignored_controls(stream)] == [False]


IMAGE = np.zeros((1, 1), np.uint8)


@pytest.mark.parametrize("told", [FRAME_PERIOD, None])
def test_complete_sets_are_found_and_no_pair_is_wrong_with_offsets_drops_and_jitter(told: float | None) -> None:
    found = pair_frames(sent_frames(np.random.default_rng(8), 1000, CameraJitter()), CAMERA_OFFSETS, told)
    assert found.complete >= 0.995 and found.wrong == 0 and found.wait <= 1.5 * FRAME_PERIOD


def test_without_the_offsets_the_same_frames_are_torn_apart() -> None:
    frames = sent_frames(np.random.default_rng(8), 300, CameraJitter())
    assert pair_frames(frames, np.zeros(3)).complete < 0.5


def test_normal_jitter_of_a_seventh_of_a_period_costs_few_sets() -> None:
    found = pair_frames(sent_frames(np.random.default_rng(5), 700, CameraJitter(normal=True)), CAMERA_OFFSETS)
    assert found.complete >= 0.985 and found.wrong <= 1


def frame(camera: int, stamp: float) -> Arrival:
    return Arrival(Frame(camera, stamp, IMAGE, "driver"), stamp, FRAME_PERIOD, stamp + 0.03)


def test_offsets_can_be_told_while_running_and_leave_the_stamps_alone() -> None:
    gathering, sizes, stamps = FrameSetBuilder(2, FRAME_PERIOD), [], []
    for k in range(60):
        if k == 30:
            gathering.set_offsets([0.0, 0.02])
        for arrival in (frame(0, k * FRAME_PERIOD), frame(1, k * FRAME_PERIOD - 0.02)):
            for one in gathering.add(arrival):
                sizes.append((k, len(one.frames)))
                stamps += [f.stamp for f in one.frames if f.camera == 1]
    early = [size for k, size in sizes if k < 30]
    late = [size for k, size in sizes if k > 32]
    assert late == [2] * len(late) and early != [2] * len(early)
    assert set(stamps) <= {k * FRAME_PERIOD - 0.02 for k in range(60)}


def test_a_missing_camera_holds_no_set_up_for_longer_than_a_period_and_a_half() -> None:
    gathering, waits = FrameSetBuilder(3, FRAME_PERIOD), []
    for k in range(60):
        first = frame(0, k * FRAME_PERIOD)
        for now in np.arange(first.now, first.now + FRAME_PERIOD, 0.001):
            sets = gathering.add(first) if now == first.now else gathering.due(float(now))
            waits += [float(now) - s.stamp - 0.03 for s in sets]
    assert len(waits) >= 58 and max(waits) <= 1.5 * FRAME_PERIOD


@given(
    phases=st.lists(st.floats(0, 1), min_size=2, max_size=4), drop=st.floats(0, 0.05), seed=st.integers(0, 2**32 - 1)
)
@settings(max_examples=15)
def test_free_running_cameras_make_whole_sets_of_the_least_spread(phases: list[float], drop: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shots = [
        frame(camera, 5 + (k + phase) * FRAME_PERIOD)
        for k in range(90)
        for camera, phase in enumerate(phases)
        if rng.random() >= drop
    ]
    gathering, sets = FrameSetBuilder(len(phases), FRAME_PERIOD), []
    for shot in sorted(shots, key=lambda shot: shot.now):
        sets += gathering.add(shot)
    settled = sets[len(sets) // 2 :]
    whole = [one for one in settled if len(one.frames) == len(phases)]
    assert len(whole) >= (1 - 3 * len(phases) * max(drop, 0.02)) * len(settled) - 3
    widest = max(max(f.stamp for f in one.frames) - min(f.stamp for f in one.frames) for one in settled)
    assert widest <= (1 - 1 / len(phases) / LEADER_HYSTERESIS) * FRAME_PERIOD + 1e-6


def test_phases_that_drift_past_each_other_cost_a_set_and_no_more() -> None:
    shots = [frame(0, k * FRAME_PERIOD) for k in range(900)] + [frame(1, k * FRAME_PERIOD * 1.001) for k in range(900)]
    gathering, sizes = FrameSetBuilder(2, FRAME_PERIOD), []
    for shot in sorted(shots, key=lambda shot: shot.now):
        sizes += [len(one.frames) for one in gathering.add(shot)]
    assert sizes[10:].count(1) <= 6


def test_how_far_a_camera_is_out_of_step_is_told() -> None:
    gathering = FrameSetBuilder(2, FRAME_PERIOD)
    for k in range(80):
        for camera, phase in enumerate((0.0, 0.3)):
            gathering.add(frame(camera, 1 + (k + phase) * FRAME_PERIOD))
    assert gathering.behind == pytest.approx([-0.15 * FRAME_PERIOD, 0.15 * FRAME_PERIOD], rel=0.01)


@pytest.mark.parametrize(
    ("phases", "errors"),
    [
        ((0.0, 0.33, 0.66), (0.0, 0.0, 0.0)),
        ((0.0, 0.3, 0.6), (0.0, 0.005, -0.005)),
        ((0.0, 0.0, 0.0), tuple(CAMERA_OFFSETS)),
    ],
)
def test_what_is_learned_of_sets_shifts_them_once_at_most(phases: tuple[float, ...], errors: tuple[float, ...]) -> None:
    gathering, learned = FrameSetBuilder(3, FRAME_PERIOD), np.zeros(3)
    shots = [frame(c, 10 + (k + phase) * FRAME_PERIOD + 1e-4 * c) for k in range(900) for c, phase in enumerate(phases)]
    spread: list[np.ndarray] = []
    for shot in sorted(shots, key=lambda shot: shot.now):
        for one in gathering.add(shot):
            if len(one.frames) == 3:
                spread.append(np.array([f.stamp for f in one.frames]) - one.stamp)
                late = spread[-1] + errors  # when they really exposed, beside the mean of all
                learned += (late - late.mean() - learned) / 150
            gathering.learn(learned)
    assert len(spread) >= 880 and (np.abs(np.diff(spread, axis=0)).max(axis=1) > 0.002).sum() <= 1
