"""Industrial cameras: clocks mapped, pixels read, keys refused; and Aravis's own GigE Vision servers as cameras."""

from __future__ import annotations

import json
import math
import os
import re
import signal
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.cameras import genicam
from hardware.cameras.capture import Control, Transport, image_from_pixels
from hardware.cameras.feed import CameraPlace, Feed, FrameFault
from hardware.cameras.genicam import PACKAGES, PROGRAM, controls_of, exposure_end
from hardware.cameras.live import LiveCameras
from hardware.cameras.sources import DEPTHS, PIXEL_FORMATS, CameraSource, Identity, SourceKind, read_live_rig
from hardware.cameras.stamping import CLOCK_BIN, CLOCK_BINS, DeviceClock, FrameStamper
from hardware.cli import doctor
from hardware.cli.main import main
from hardware.operator.view import CheckVerdict
from hardware.process.clock import SimClock
from hardware.recording.session_reader import open_session
from tests.camera_streams import CLOCK, ListedCapture, Shot, picture
from tests.counterparts import (
    FakeCamera,
    PacketLoss,
    instant_of,
    is_wrong,
    need_fakes,
    own_network,
    running,
    sets_until,
    watch_stamps,
)
from tests.test_camera_names import rig_file

SIZE = (320, 240)
NAMED = CameraSource(Identity(SourceKind.GENICAM, "genicam://C1"), fps=20.0)


def device_stamp(instant: float, offset: float, rate: float) -> int:
    """What a clock shows, ns, that was `offset` s ahead at 0 and runs `rate` (of 1) too fast."""
    return round(1e9 * (offset + instant * (1 + rate)))


@settings(max_examples=20)
@given(
    st.floats(-1e-4, 1e-4),
    st.floats(0, 1e6),
    st.floats(1e-4, 0.02),
    st.floats(1e-5, 5e-3),
    st.integers(0, 2**32 - 1),
)
def test_a_devices_clock_is_mapped_by_arrivals_but_for_their_least_delay(
    rate: float, offset: float, delay: float, jitter: float, seed: int
) -> None:
    clock, rng = DeviceClock(), np.random.default_rng(seed)
    wrong = []
    for k in range(2400):  # two minutes at 20 Hz
        instant = 100 + k / 20
        stamp = device_stamp(instant, offset, rate)
        clock.arrived(stamp, instant + delay + float(rng.exponential(jitter)))
        wrong.append(clock(stamp) - instant - delay)
    late = np.array(wrong[200:])
    assert late.min() > -1e-3 and late.max() < 1e-3, (late.min(), late.max())
    assert clock.drift == pytest.approx(-rate, abs=5e-6 + jitter / 100)
    assert math.isnan(clock.doubt)


def test_readings_there_and_back_leave_no_delay() -> None:
    clock, rng, offset, rate = DeviceClock(), np.random.default_rng(3), 5e4, 4e-5
    for k in range(90):
        there, back = rng.exponential(2e-4, 2) + 1e-4
        instant = 10 + k
        clock.arrived(device_stamp(instant, offset, rate), instant + 0.02)
        clock.latched(device_stamp(instant + there, offset, rate), instant, instant + there + back)
    stamp = device_stamp(99.5, offset, rate)
    assert abs(clock(stamp) - 99.5) < 2e-4 and clock.drift == pytest.approx(-rate, abs=3e-6)
    assert 1e-4 <= clock.doubt < 4e-4
    assert exposure_end(clock, stamp, 0.008, 99.6) == pytest.approx(99.508, abs=2e-4)  # a stamp is of the begin
    assert exposure_end(clock, stamp, 0.2, 99.6) == 99.6  # what has arrived has been exposed


def test_a_stamp_is_believed_only_after_ten_arrivals_and_then_is_of_the_end_of_the_exposure() -> None:
    clock, late = DeviceClock(), [0.009, 0.004, 0.01, 0.008, 0.006, 0.005, 0.007, 0.009, 0.01, 0.004]
    for k, delay in enumerate(late):
        assert math.isnan(clock(device_stamp(k / 20, 7.0, 0)))
        clock.arrived(device_stamp(k / 20, 7.0, 0), k / 20 + delay)
    assert exposure_end(clock, device_stamp(0.5, 7.0, 0), 0.008, 0.6) == pytest.approx(0.504, abs=1e-9)


def test_a_clock_that_is_set_anew_is_mapped_anew() -> None:
    clock = DeviceClock()
    assert math.isnan(clock(0)) and math.isnan(clock.drift)
    for k in range(200):
        clock.arrived(device_stamp(k / 20, 1e5, 0), k / 20 + 0.01)
    for k in range(200, 210):  # it began at 0 again
        clock.arrived(device_stamp(k / 20, -9.0, 0), k / 20 + 0.01)
    assert clock(device_stamp(10.45, -9.0, 0)) == pytest.approx(10.46, abs=1e-6)


def test_seconds_in_which_all_came_late_do_not_bend_the_line() -> None:
    clock, rate = DeviceClock(), 5e-5
    for k in range(1200):
        late = {1: 0.001, 15: 0.002, 45: 0.009, 59: 0.012}.get(k // 20, 0.0)  # more and more
        clock.arrived(device_stamp(k / 20, 3.0, rate), k / 20 + 0.002 + late)
    assert clock(device_stamp(60.0, 3.0, rate)) == pytest.approx(60.002, abs=2e-4)
    assert clock.drift == pytest.approx(-rate, abs=1e-6)


def test_an_exact_stamp_is_paired_as_it_is_and_another_by_its_beat() -> None:
    for exact in (True, False):
        stamper = FrameStamper(0.05)
        for k in range(40):
            off = 0.015 if k == 35 else 0.0
            stamped = stamper(k / 20 + off + 0.01, k / 20 + off, True, exact)
            if k == 35:
                assert stamped.stamp == k / 20 + off and (stamped.steady == stamped.stamp) is exact


def test_a_clock_forgets_what_is_old() -> None:
    """Its temperature changed: for two minutes it ran at another rate."""
    clock = DeviceClock()
    for k in range(240):
        clock.arrived(device_stamp(k, 0, 5e-5 if k < 120 else 0) + (0 if k < 120 else 6_000_000), k + 0.001)
    assert abs(clock.drift) < 1e-6 and CLOCK_BINS * CLOCK_BIN < 120


def mosaic(image: np.ndarray, order: str) -> np.ndarray:
    """The Bayer picture (H, W) of an image (H, W, 3) BGR. order: the first two pixels, such as "RG"."""
    second = {"RG": "GB", "BG": "GR", "GR": "BG", "GB": "RG"}[order]
    out = np.empty(image.shape[:2], np.uint8)
    for row, letters in enumerate((order, second)):
        for column, letter in enumerate(letters):
            out[row::2, column::2] = image[row::2, column::2, "BGR".index(letter)]
    return out


@pytest.mark.parametrize("name", PIXEL_FORMATS)
@pytest.mark.parametrize("padding", [0, 6])
def test_every_pixel_format_gives_the_picture(name: str, padding: int) -> None:
    smooth = cv2.resize(np.random.default_rng(5).integers(40, 220, (4, 5, 3)).astype(np.uint8), (64, 48))
    plain = {"M": smooth[..., 1], "R": smooth[..., ::-1], "B": smooth}
    raw = np.ascontiguousarray(mosaic(smooth, name[5:7]) if name.startswith("Bayer") else plain[name[0]])
    depth = int(re.sub(r"\D", "", name))
    assert depth == 8 or str(depth) in DEPTHS
    if depth > 8:
        raw = (raw.astype("<u2") << (depth - 8)) + 3  # the lowest bits are noise
    rows = raw.reshape(48, -1).view(np.uint8)
    data = np.hstack([rows, np.full((48, padding), 255, np.uint8)]).tobytes()
    seen = image_from_pixels(memoryview(data), (64, 48), name, padding)
    assert seen is not None and seen.dtype == np.uint8
    wanted = smooth[..., 1] if name.startswith("Mono") else smooth
    assert seen.shape == wanted.shape and np.abs(seen[2:-2, 2:-2].astype(int) - wanted[2:-2, 2:-2]).max() <= 12
    if not name.startswith("Bayer"):
        assert (seen == wanted).all()
    assert image_from_pixels(memoryview(data)[: len(data) // 2], (64, 48), name, padding) is None


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ('source = "genicam://"', "genicam://ID"),
        ('source = "genicam://A"\nformat = "MJPG"', "format = 'MJPG', allowed one of Mono8, "),
        ('source = "genicam://A"\nformat = "Mono12Packed"', "allowed one of Mono8, "),
        ('source = "genicam://A"\ntrigger = "software"', "fps = 'missing', allowed 1 to 1000"),
        ('source = "genicam://A"\ntrigger = 1', "trigger = 1"),
        ('source = "genicam://A"\ntrigger = " "', "Line1"),
        ('source = "genicam://A"\nptp = 1', "ptp = 1, allowed true or false"),
        ('source = "http://h/1"\ntrigger = "Line1"', "only for an industrial camera"),
        ('source = "http://h/1"\nptp = true', "only for an industrial camera"),
        ('source = "genicam://A"\nexposure_s = 2', "exposure_s = 2"),
        ('source = "genicam://A"\ntriger = "Line1"', "did you mean 'trigger'"),
    ],
)
def test_a_wrong_key_is_named_with_what_is_allowed(keys: str, says: str, tmp_path: Path) -> None:
    path = rig_file(tmp_path, 'source = "http://h/0"', keys)
    with pytest.raises(InputError) as caught:
        read_live_rig(path)
    assert says in str(caught.value) and str(path) in str(caught.value)


def test_cameras_of_one_trigger_have_one_rate(tmp_path: Path) -> None:
    keys = [f'source = "genicam://{name}"\ntrigger = "Software"\nfps = {fps}' for name, fps in (("A", 20), ("B", 25))]
    with pytest.raises(InputError, match=r"camera 'c1': fps = 25.0, allowed 20, as camera 'c0'"):
        read_live_rig(rig_file(tmp_path, *keys))
    told = 'format = "BayerRG8"\nexposure_s = 0.004\ngain = 2\nptp = true'
    _, sources = read_live_rig(rig_file(tmp_path, keys[0] + "\n" + told))
    where = Identity(SourceKind.GENICAM, "genicam://A")
    assert sources[0] == CameraSource(where, 0.004, 2, None, None, 20.0, "BayerRG8", "Software", True)


def test_without_aravis_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(genicam, "aravis_python", lambda: None)
    assert main(["cameras", "genicam://A"]) == 2
    error = capsys.readouterr().err
    assert f"apt-get install -y {PACKAGES}" in error and "genicam://A" in error and error.count("\n") == 1
    assert main(["cameras"]) == 0 and PACKAGES in capsys.readouterr().out
    check = doctor.aravis_check(None)
    assert check.verdict is CheckVerdict.WARN and PACKAGES in check.remedy
    assert doctor.aravis_check("/usr/bin/python3").verdict is CheckVerdict.PASS


def test_what_a_camera_did_not_take_is_named() -> None:
    own = {"format": "Mono8", "fps": 25.0, "exposure_s": 0.004, "gain": 2.0, "trigger": "Line1", "ptp": "Slave"}
    source = CameraSource(NAMED.identity, 0.004, 2.0, None, None, 25.0, "Mono8", "Line1", True)
    assert all(control.accepted for control in controls_of(source, own, ()))
    assert {c.name for c in controls_of(NAMED, own, ())} == {"format", "fps", "exposure_s", "gain"}
    wrong = {"format": "BayerRG8", "fps": 20.0, "exposure_s": 0.01, "gain": 3.0, "trigger": "Line2", "ptp": "Listening"}
    for name, value in wrong.items():
        refused = [c.name for c in controls_of(source, own | {name: value}, ()) if not c.accepted]
        assert refused == [name]
    assert [c.name for c in controls_of(source, own | {"ptp": None}, ("gain",)) if not c.accepted] == ["gain", "ptp"]
    blurred = replace(source, focus=3.0)
    assert [c.name for c in controls_of(blurred, own, ()) if not c.accepted] == ["focus_abs"]


class LossyCapture(ListedCapture):
    """A list that is a camera, some of whose frames lack packets: those without a picture, of whose begin some lack."""

    @property
    def incomplete(self) -> bool:  # type: ignore[override]
        return self._shot.image is None

    @property
    def transport(self) -> Transport:  # type: ignore[override]
        return Transport(100, 3, 1, 0, math.nan, math.nan)


def test_incomplete_frames_are_left_out_and_losses_add_up_when_a_camera_comes_back() -> None:
    clock, given = SimClock(), list[float]()
    shots = [Shot(1 + k / 20, 1 + k / 20 - 0.01, picture(k)) for k in range(20)]
    shots[7], shots[12] = Shot(1.35, 1.34, None), Shot(1.6, math.nan, None)
    lives = [shots, [Shot(s.arrival + 5, s.position + 5, s.image) for s in shots]]

    def opener(*_: object) -> ListedCapture:
        return LossyCapture(lives.pop(0), clock, True, (Control("fps", None, 20.0),))

    feed = Feed(CameraPlace(0, "cam", None), NAMED, clock, lambda a: given.append(a.frame.stamp), opener)
    for _ in range(43):
        feed.step()
    state = feed.state()
    assert state.faults == {FrameFault.INCOMPLETE: 4} and state.missed == 2  # only where nothing told of the instant
    assert len(given) == 36 and state.by == "driver" and state.reopened == 1
    assert state.transport == Transport(200, 6, 2, 0, math.nan, math.nan) or state.transport is not None
    assert state.transport is not None and (state.transport.received, state.transport.lost) == (200, 6)


def test_a_triggered_camera_has_no_phase_of_its_own() -> None:
    for trigger in (None, "Line1"):
        clock, given = SimClock(), list[float | None]()
        shots = [Shot(1 + k / 20, 1 + k / 20 - 0.01, picture(k)) for k in range(20)]
        source = CameraSource(NAMED.identity, fps=20.0, trigger=trigger)
        opener = lambda *_, shots=shots, clock=clock: LossyCapture(shots, clock, True)  # noqa: E731
        feed = Feed(CameraPlace(0, "cam", None), source, clock, lambda a, given=given: given.append(a.period), opener)
        for _ in range(20):
            feed.step()
        assert given[-1] == (pytest.approx(0.05) if trigger is None else None)


@pytest.mark.slow
def test_a_fake_camera_is_found_set_up_and_watched(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    need_fakes(several=True)
    camera = FakeCamera(0)
    with own_network(1), running(camera):
        assert main(["cameras", "--json"]) == 0
        found = [one for one in json.loads(capsys.readouterr().out) if one["address"] == camera.address]
        assert [one["identity"] for one in found] == ["genicam://" + camera.name]
        keys = 'exposure_s = 0.004\ngain = 2\nfps = 20\nformat = "BayerRG8"'
        rig = rig_file(tmp_path, f'source = "genicam://{camera.name}"\n{keys}')
        rig.write_text(rig.read_text().replace("[1280, 720]", "[320, 240]"))
        assert main(["cameras", str(rig), "--seconds", "2", "--json"]) == 0
        seen = json.loads(capsys.readouterr().out)["cameras"][0]
        assert main(["cameras", "genicam://nobody", "--seconds", "2.5"]) == 1
        assert f"no camera 'nobody' (Device 'nobody' not found); found: {camera.name}" in capsys.readouterr().out
    assert seen["size_px"] == [320, 240] and seen["frames"] > 15 and seen["stamped"] == "driver"
    controls = {one["name"]: one["got"] for one in seen["controls"]}
    assert controls == {"format": "BayerRG8", "fps": 20.0, "exposure_s": 0.004, "gain": 2.0}
    assert seen["transport"]["lost_packets"] == 0 and seen["transport"]["received_packets"] > 15 * 59


@pytest.mark.slow
def test_what_a_camera_does_not_have_is_told() -> None:
    need_fakes(several=True)
    camera = FakeCamera(0)
    wrong = {"format": "Mono12", "trigger": "Line7"}
    with own_network(1), running(camera):
        for key, value in wrong.items():
            with LiveCameras([CameraPlace(0, "cam", SIZE)], [camera.source(fps=20.0, **{key: value})], CLOCK) as live:
                sets_until(live, CLOCK.now() + 1.5)
                trouble = live.health().trouble
            assert "cam cannot be opened" in trouble and f"{key} " in trouble and value in trouble


def rig_of(count: int) -> list[CameraPlace]:
    return [CameraPlace(i, f"c{i}", SIZE) for i in range(count)]


@pytest.mark.slow
def test_three_fake_cameras_are_a_rig_one_dies_and_packets_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """At one trigger's 20 Hz: no wrong set, stamps to 1 ms, losses as the kernel counts them, and a camera back."""
    need_fakes(several=True)
    stamps, cameras, period, exposure = watch_stamps(monkeypatch), [FakeCamera(i) for i in range(3)], 0.05, 0.004
    with own_network(3), running(*cameras):
        loss = PacketLoss(997)
        sources = [camera.source(fps=1 / period, trigger="Software", exposure=exposure) for camera in cameras]
        with LiveCameras(rig_of(3), sources, CLOCK) as live:
            first = sets_until(live, CLOCK.now() + 20)
            whole, dropped = live.health().cameras, loss.dropped()
            assert dropped > 50
            lost = [camera.transport.lost for camera in whole if camera.transport is not None]
            assert dropped - 1 <= sum(lost) <= dropped  # one may be of a frame under way
            assert sum(camera.faults.get(FrameFault.INCOMPLETE, 0) for camera in whole) >= dropped - 1
            cameras[1].kill()
            second = sets_until(live, CLOCK.now() + 4)
            assert "c1 cannot be opened since" in live.health().trouble
            cameras[1].start()
            third = sets_until(live, CLOCK.now() + 10)
            assert live.health().cameras[1].reopened == 1 and live.health().trouble == ""
    sets = [*first, *second, *third]
    errors = [
        f.stamp + exposure / 2 - instant_of(stamps[f.stamp]) for one in sets for f in one.frames if f.by == "driver"
    ]
    print(f"{len(sets)} sets, {dropped} packets lost, stamps {1e3 * min(errors):.2f} to {1e3 * max(errors):.2f} ms")
    own = [[stamps[frame.stamp] for frame in one.frames if frame.by == "driver"] for one in sets]
    assert sum(is_wrong(one, period) for one in own) == 0
    assert max(map(abs, errors)) < 1e-3
    assert sum(len(one.frames) == 3 for one in first) > 0.7 * 18 / period


@pytest.mark.slow
def test_a_camera_whose_grabbing_process_is_killed_is_opened_again() -> None:
    """The camera itself lets go of who is gone after its heartbeat, some seconds."""
    need_fakes(several=True)
    camera = FakeCamera(0)
    with own_network(1), running(camera), LiveCameras(rig_of(1), [camera.source(fps=20.0)], CLOCK) as live:
        assert len(sets_until(live, CLOCK.now() + 4)) > 20
        for entry in Path("/proc").glob("[0-9]*/cmdline"):
            if PROGRAM.name in entry.read_text() and f"PPid:\t{os.getpid()}" in (entry.parent / "status").read_text():
                os.kill(int(entry.parent.name), signal.SIGKILL)
        sets_until(live, CLOCK.now() + 1)
        assert (
            "the process that grabs it has ended" in live.health().trouble or "another program" in live.health().trouble
        )
        assert len(sets_until(live, CLOCK.now() + 12)) > 20
        assert live.health().trouble == "" and live.health().cameras[0].reopened == 1


@pytest.mark.slow
def test_a_recording_of_three_fake_cameras_says_what_was_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    need_fakes(several=True)
    cameras = [FakeCamera(i) for i in range(3)]
    rig = rig_file(tmp_path, *(f'source = "genicam://{c.address}"\nfps = 20\ntrigger = "software"' for c in cameras))
    rig.write_text(rig.read_text().replace("[1280, 720]", "[320, 240]"))
    with own_network(3), running(*cameras):
        PacketLoss(601)
        assert main(["record", str(rig), "-o", str(tmp_path / "a.mcap"), "--seconds", "8", "--no-page"]) == 0
    said = capsys.readouterr()
    lost = re.findall(r"(c\d): (\d+) pictures left out, as packets were missing \((\d+)\)", said.out + said.err)
    assert lost and all(1 <= int(pictures) <= int(packets) for _, pictures, packets in lost), said
    session = open_session(tmp_path / "a.mcap")
    assert len(session) > 60 and sum(len(refs) == 3 for refs in session.sets) > 30


@pytest.mark.slow
def test_a_camera_whose_clock_is_far_off_and_runs_wrong_is_stamped_by_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten days ahead and 150 ppm too fast: 4.5 ms in the half minute."""
    need_fakes(several=True)
    stamps, camera, rate = watch_stamps(monkeypatch), FakeCamera(0, clock="+10d x1.00015"), 1.5e-4
    with own_network(1), running(camera), LiveCameras(rig_of(1), [camera.source(fps=20.0)], CLOCK) as live:
        sets = sets_until(live, CLOCK.now() + 40)
        transport = live.health().cameras[0].transport
    assert transport is not None and transport.drift == pytest.approx(-rate, abs=2e-5)
    ours = np.array([one.frames[0].stamp for one in sets if one.frames[0].by == "driver"])
    theirs = np.array([(stamps[stamp] - stamps[ours[0]]) / 1e9 for stamp in ours])
    off = ours - ours[0] - theirs / (1 + rate)
    print(f"drift {1e6 * transport.drift:.1f} ppm; stamps {1e3 * np.ptp(off[100:]):.2f} ms apart from a steady clock")
    assert len(ours) > 600 and np.ptp(off[100:]) < 1e-3
