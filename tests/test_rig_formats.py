"""Rigs in other programs' files come back or are refused; `stillbed doctor` sees what can be wrong."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Camera, Rig
from hardware.calibration.rig_formats import FORMATS
from hardware.cameras.sources import CameraDevice
from hardware.cli import doctor
from hardware.cli.doctor import REINSTALL, LoadFailure, library_checks, load_failures
from hardware.cli.main import main
from hardware.files.mesh_reader import SHARED_LIBRARIES
from hardware.files.rig_file import read_rig, write_rig
from hardware.operator.view import Check, CheckVerdict
from hardware.process.clock import SimClock
from perception.wound import network

numbers = st.floats(-0.3, 0.3, allow_subnormal=False)


@st.composite
def rigs(draw: st.DrawFn) -> Rig:
    cameras = []
    for number in range(draw(st.integers(2, 4))):
        fx, fy = draw(st.floats(500, 2000)), draw(st.floats(500, 2000))
        matrix = np.array([[fx, 0, 630 + draw(numbers)], [0, fy, 350 + draw(numbers)], [0, 0, 1]])
        bends = np.array([draw(numbers) for _ in range(4)] + [0.0])
        turn, shift = (np.array([draw(numbers) for _ in range(3)]) for _ in range(2))
        place = se3.make(se3.exp_rotation(5 * turn), [300.0 * number, 0, 0] + 100 * shift)
        cameras.append(Camera(f"cam {number}", (1280, 720), matrix, bends, place, draw(numbers) / 10))
    return Rig(tuple(cameras))


@pytest.mark.parametrize("name", ["opencv", "ros", "kalibr", "anipose"])
@given(rig=rigs())
@settings(max_examples=15)
def test_what_is_written_comes_back(name: str, rig: Rig) -> None:
    kind = FORMATS[name]
    with TemporaryDirectory() as folder:
        out = Path(folder) / {"anipose": "rig.toml", "kalibr": "rig.yaml"}.get(name, "rig")
        kind.write(out, rig)
        back = kind.read(out)
    change = rig.cameras[0].base_from_camera if name == "kalibr" else np.eye(4)  # its base is its first camera
    for a, b in zip(rig.cameras, back.cameras, strict=True):
        assert (a.name, a.size) == (b.name, b.size)
        assert np.array_equal(a.matrix, b.matrix) and np.array_equal(a.distortion, b.distortion)
        assert a.clock_offset == b.clock_offset
        assert np.allclose(change @ b.base_from_camera, a.base_from_camera, atol=1e-8)


def one(k3: float = 0.0) -> Rig:
    bends = np.array([-0.3, 0.1, 0.001, 0.002, k3])
    matrix = np.array([[900.0, 0, 640], [0, 901, 360], [0, 0, 1]])
    return Rig((Camera("left", (1280, 720), matrix, bends, np.eye(4), 0.004),))


def test_opencv_itself_reads_what_is_written_for_it(tmp_path: Path) -> None:
    FORMATS["opencv"].write(tmp_path, one(0.02))
    stored = cv2.FileStorage(str(tmp_path / "left.yaml"), cv2.FILE_STORAGE_READ)
    assert np.array_equal(stored.getNode("camera_matrix").mat(), one().cameras[0].matrix)
    assert np.allclose(stored.getNode("distortion_coefficients").mat(), one(0.02).cameras[0].distortion)


def test_what_opencv_writes_is_read(tmp_path: Path) -> None:
    stored = cv2.FileStorage(str(tmp_path / "left.yml"), cv2.FILE_STORAGE_WRITE)
    stored.write("image_width", 1280)
    stored.write("image_height", 720)
    stored.write("camera_matrix", one().cameras[0].matrix)
    stored.write("distortion_coefficients", one(0.02).cameras[0].distortion)
    stored.release()
    back = FORMATS["opencv"].read(tmp_path).cameras[0]
    assert np.allclose(back.matrix, one().cameras[0].matrix) and back.distortion[4] == 0.02


def test_a_k3_does_not_fit_kalibr_and_is_not_dropped_in_silence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"camera left: k3 = 0.02, allowed 0"):
        FORMATS["kalibr"].write(tmp_path / "chain.yaml", one(0.02))


def test_kalibr_is_in_metres(tmp_path: Path) -> None:
    right = Camera("right", (1280, 720), one().cameras[0].matrix, np.zeros(5), se3.make(np.eye(3), [300.0, 0, 0]))
    FORMATS["kalibr"].write(tmp_path / "chain.yaml", Rig((*one().cameras, right)))
    assert "-0.3" in (tmp_path / "chain.yaml").read_text()


KALIBR_CAMERA = (
    "cam{n}: {{camera_model: pinhole, distortion_model: radtan, intrinsics: [900, 901, 640, 360], rostopic: {topic},"
    " distortion_coeffs: [{k1}, 0, 0, 0], resolution: [1280, 720],"
    " T_cn_cnm1: [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}\n"
)


@pytest.mark.parametrize(
    ("topics", "names"),
    [
        (["/left/image", "/right/image"], ["left", "right"]),
        (["/camera/infra1/image", "/camera/infra2/image"], ["cam0", "cam1"]),
        (["/left/image", "''"], ["cam0", "cam1"]),
    ],
)
@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_kalibrs_cameras_have_the_names_of_their_topics_where_these_differ(
    topics: list[str], names: list[str], order: tuple[int, int], tmp_path: Path
) -> None:
    path = tmp_path / "chain.yaml"
    path.write_text("".join(KALIBR_CAMERA.format(n=n, topic=topics[n], k1=(n + 1) / 10) for n in order))
    back = FORMATS["kalibr"].read(path).cameras
    assert [(camera.name, camera.distortion[0]) for camera in back] == list(zip(names, [0.1, 0.2], strict=True))


@pytest.mark.parametrize("name", ["opencv", "anipose"])
def test_a_fisheye_is_refused_as_its_lens_has_another_formula(name: str, tmp_path: Path) -> None:
    FORMATS[name].write(tmp_path / "rig", one())
    file = tmp_path / "rig" / "left.yaml" if name == "opencv" else tmp_path / "rig"
    text = file.read_text()
    for mark, fisheye in (("1", True), ("0", False)):
        anipose = text.replace("matrix", f"fisheye = {str(fisheye).lower()}\nmatrix", 1)
        file.write_text(anipose if name == "anipose" else f"{text}fisheye_model: {mark}\n")
        if fisheye:
            with pytest.raises(InputError, match="fisheye lens"):
                FORMATS[name].read(tmp_path / "rig")
        else:
            assert FORMATS[name].read(tmp_path / "rig").cameras[0].name == "left"


@pytest.mark.parametrize(
    ("name", "text", "named"),
    [
        ("kalibr", "cam0: {camera_model: omni}", "cam0.camera_model"),
        ("kalibr", KALIBR_CAMERA.format(n=0, topic="/a", k1=".nan"), "cam0.distortion_coeffs"),
        ("kalibr", KALIBR_CAMERA.format(n=0, topic="/a", k1=0).replace("resolution", "size"), "cam0.resolution"),
        ("kalibr", "cam0: [1", "file"),
        ("kalibr", "- 1", "file"),
        ("kalibr", "a: " + 2000 * "[", "a YAML file"),
        ("opencv", "image_width: 3", "camera_matrix"),
        ("ros", "distortion_model: equidistant", "distortion_model"),
        ("anipose", "[cam_0]\nmatrix = [[1, 2], [3, 4]]", "cam_0.rotation"),
        ("anipose", "[metadata]", "camera"),
    ],
)
def test_what_is_wrong_with_a_file_is_named(name: str, text: str, named: str, tmp_path: Path) -> None:
    path = tmp_path / ("x.toml" if name == "anipose" else "x.yaml")
    path.write_text(text)
    with pytest.raises(InputError, match=named):
        FORMATS[name].read(path)


def test_lenses_without_places_are_no_rig(tmp_path: Path) -> None:
    for name in ("a", "b"):
        FORMATS["opencv"].write(tmp_path, Rig((replace(one().cameras[0], name=name),)))
        text = (tmp_path / f"{name}.yaml").read_text()
        (tmp_path / f"{name}.yaml").write_text(text[: text.index("base_from_camera")])
    with pytest.raises(InputError, match="places of the cameras"):
        FORMATS["opencv"].read(tmp_path)


def test_the_commands_carry_a_rig_there_and_back(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.toml", one(), [None])
    rig, ros, back = str(tmp_path / "rig.toml"), str(tmp_path / "ros"), str(tmp_path / "b.toml")
    assert main(["calibrate", "export", rig, "--format", "ros", "-o", ros]) == 0
    assert main(["calibrate", "import", ros, "--format", "ros", "-o", back]) == 0
    assert np.array_equal(read_rig(tmp_path / "b.toml").rig.cameras[0].matrix, one().cameras[0].matrix)


@pytest.mark.parametrize("name", ["anipose", "ros"])
def test_an_existing_rig_is_kept_unless_told(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig, out, back = tmp_path / "rig.toml", tmp_path / "other", tmp_path / "back.toml"
    write_rig(rig, one(), [None])
    there = ["calibrate", "export", str(rig), "--format", name, "-o", str(out)]
    here = ["calibrate", "import", str(out), "--format", name, "-o", str(back)]
    for command, file in ((there, out), (here, back)):
        assert main(command) == 0
        kept = {path: path.stat().st_mtime_ns for path in (file, *file.glob("*"))}
        assert main(command) == 2
        assert "--force" in capsys.readouterr().err
        assert all(path.stat().st_mtime_ns == before for path, before in kept.items())
        assert main([*command, "--force"]) == 0


WORDS = "libGL.so.1", "signal 4", "hangs: not loaded after 2 s", "still loading after 2 s"
PASS, WARN, FAIL = CheckVerdict.PASS, CheckVerdict.WARN, CheckVerdict.FAIL


@pytest.mark.slow
def test_here_everything_needed_works_and_is_told_in_words_and_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    names = {check["name"] for check in told["libraries"]}
    assert {"gtsam", "toppra", "ruckig", "opencv-python-headless", "onnxruntime"} <= names and "pytest" not in names
    assert {check["verdict"] for check in told["libraries"]} == {"pass"}
    network = next(check for check in told["devices"] if check["name"] == "wound network")
    assert network["verdict"] == "pass"
    assert all(check["remedy"] for part in told.values() for check in part if check["verdict"] != "pass")


@pytest.mark.slow
def test_each_library_that_fails_is_named_however_it_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lacks_file.py").write_text("raise ImportError('libGL.so.1: cannot open shared object file')\n")
    (tmp_path / "dies.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGILL)\n")
    (tmp_path / "hangs.py").write_text("import threading\nthreading.Event().wait()\n")
    (tmp_path / "works.py").write_text("while True:\n    pass\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    found = load_failures(["json", "lacks_file", "dies", "csv", "hangs", "re", "works"], patience=2)
    assert list(found) == ["lacks_file", "dies", "hangs", "works"]
    reasons = [trouble.reason for trouble in found.values()]
    assert all(word in reason for word, reason in zip(WORDS, reasons, strict=True))
    assert [trouble.slow for trouble in found.values()] == [False, False, False, True]


def test_a_library_that_is_only_slow_is_no_failure() -> None:
    busy = doctor._library_check("numpy", "numpy", {"numpy": LoadFailure("still loading after 60 s", slow=True)})
    assert busy.verdict is WARN and busy.remedy


def test_a_library_that_is_not_installed_fails_with_a_remedy() -> None:
    (check,) = library_checks(["no-such-library"])
    assert check == Check("no-such-library", FAIL, "not installed", REINSTALL)


def test_the_packages_that_open3d_lacks_are_named() -> None:
    lacking = {"open3d": doctor.LoadFailure("libGL.so.1: cannot open shared object file", shared_object=True)}
    check = doctor._library_check("numpy", "open3d", lacking)
    assert check.verdict is FAIL and "apt-get install -y libegl1 libgl1" in check.remedy
    makefile = (Path(__file__).parents[1] / "Makefile").read_text()
    assert f"apt,{SHARED_LIBRARIES}," in makefile


def system(root: Path, flags: str, free_kb: int) -> Path:
    (root / "proc").mkdir()
    (root / "proc/cpuinfo").write_text(f"processor : 0\nflags\t\t: {flags}\n")
    (root / "proc/meminfo").write_text(f"MemTotal: 9 kB\nMemAvailable:   {free_kb} kB\n")
    return root


def test_a_processor_without_its_instructions_and_little_memory_are_warnings(tmp_path: Path) -> None:
    root = system(tmp_path, "fpu sse2 avx2", 3_900_000)
    check = doctor.processor_check(root)
    assert check.verdict is WARN and "without fma" in check.found
    assert doctor.memory_check(root).verdict is WARN and "3.9 GB" in doctor.memory_check(root).found
    (root / "proc/meminfo").write_text("MemAvailable: 4100000 kB\n")
    assert doctor.memory_check(root).verdict is PASS and doctor.memory_check(root / "nothing").verdict is WARN


def test_an_old_python_fails() -> None:
    assert doctor.python_check((3, 10, 4)).verdict is FAIL
    assert doctor.python_check((3, 11, 0)).verdict is not FAIL


@pytest.mark.parametrize(("free", "verdict"), [(0.9, FAIL), (9.0, WARN), (11.0, PASS)])
def test_the_disk_is_judged_by_its_space(free: float, verdict: CheckVerdict, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_free_gb", lambda folder: free)
    assert doctor.disk_check(Path()).verdict is verdict and doctor.shared_check().verdict is PASS


def test_little_shared_memory_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_free_gb", lambda folder: 0.064 if folder.name == "shm" else 99.0)
    (tmp_path / "dev/shm").mkdir(parents=True)
    check = doctor.shared_check(tmp_path)
    assert check.verdict is FAIL and "64 MB" in check.found and "shm-size" in check.remedy


class Late(SimClock):
    """A clock whose sleep takes as much longer as is said."""

    def __init__(self, late: float) -> None:
        super().__init__()
        self.late = late

    def wait_until(self, instant: float) -> None:
        super().wait_until(instant + self.late)


@pytest.mark.parametrize(("late", "verdict"), [(0.0005, PASS), (0.0025, WARN)])
def test_a_machine_that_wakes_late_is_a_warning(late: float, verdict: CheckVerdict) -> None:
    assert doctor.punctuality_check(Late(late)).verdict is verdict


def test_an_address_that_nobody_may_listen_on_fails() -> None:
    assert doctor.loopback_check("192.0.2.1").verdict is FAIL  # RFC 5737: never anybody's
    assert doctor.loopback_check().verdict is PASS


def test_a_device_closed_to_this_user_says_which_group_to_join(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    node = tmp_path / "video0"
    node.touch()
    seen = (CameraDevice(node, "a webcam", "", "", ""),)
    assert doctor.camera_check(seen) == Check("cameras", PASS, "a webcam")
    ports = [(str(node), "an adapter")]
    assert doctor.arm_check(ports).verdict is PASS
    monkeypatch.setattr(doctor.os, "access", lambda *_: False)
    for check, group in ((doctor.camera_check(seen), "video"), (doctor.arm_check(ports), "dialout")):
        assert check.verdict is FAIL and str(node) in check.found and group in check.remedy
    assert doctor.lock_check(tmp_path).verdict is FAIL


def test_nothing_plugged_in_is_a_warning_with_what_to_do() -> None:
    for check in (doctor.camera_check(()), doctor.arm_check([])):
        assert check.verdict is WARN and "connect" in check.remedy


def test_a_network_that_is_damaged_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    damaged = tmp_path / "wound.onnx"
    damaged.write_bytes(b"\x00" * 100)
    damaged.with_suffix(".toml").write_text('sha256 = "00"\n')
    monkeypatch.setattr(network, "shipped_model", lambda: damaged)
    check = doctor.network_check()
    assert check.verdict is FAIL and "sha256" in check.found


def test_extras_that_are_missing_are_named_with_how_to_install_them() -> None:
    check = doctor.extras_check({"franka": ["no-such-distribution"], "cluster": ["numpy"]})
    assert check.verdict is PASS and "installed: cluster; not installed: franka" in check.found
    assert "a Franka arm: pip install 'stillbed[franka]'" in check.found and "[cluster]" not in check.found
    assert doctor.extras_check({"cluster": ["numpy"]}).found == "installed: cluster; not installed: none"
