"""Rigs in other programs' files: what is written comes back, and what cannot be told is named."""

from __future__ import annotations

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
from hardware.calibration.formats import formats
from hardware.calibration.formats.yaml_file import read_yaml
from hardware.cli.main import main
from hardware.files.rig_file import read_rig, write_rig

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
@settings(max_examples=15, deadline=None)
def test_what_is_written_comes_back(name: str, rig: Rig) -> None:
    kind = formats()[name]
    with TemporaryDirectory() as folder:
        out = Path(folder) / ("rig" if kind.folder else "rig.toml" if name == "anipose" else "rig.yaml")
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
    formats()["opencv"].write(tmp_path, one(0.02))
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
    back = formats()["opencv"].read(tmp_path).cameras[0]
    assert np.allclose(back.matrix, one().cameras[0].matrix) and back.distortion[4] == 0.02


def test_a_k3_does_not_fit_kalibr_and_is_not_dropped_in_silence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"camera left: k3 = 0.02, allowed 0"):
        formats()["kalibr"].write(tmp_path / "chain.yaml", one(0.02))


def test_kalibr_is_in_metres(tmp_path: Path) -> None:
    right = Camera("right", (1280, 720), one().cameras[0].matrix, np.zeros(5), se3.make(np.eye(3), [300.0, 0, 0]))
    formats()["kalibr"].write(tmp_path / "chain.yaml", Rig((*one().cameras, right)))
    assert "-0.3" in (tmp_path / "chain.yaml").read_text()


@pytest.mark.parametrize(
    ("name", "text", "named"),
    [
        ("kalibr", "cam0: {camera_model: omni}", "cam0.camera_model"),
        ("kalibr", "cam0: [1", "file"),
        ("kalibr", "- 1", "file"),
        ("opencv", "image_width: 3", "camera_matrix"),
        ("ros", "distortion_model: equidistant", "distortion_model"),
        ("anipose", "[cam_0]\nmatrix = [[1, 2], [3, 4]]", "rotation"),
        ("anipose", "[metadata]", "camera"),
    ],
)
def test_what_is_wrong_with_a_file_is_named(name: str, text: str, named: str, tmp_path: Path) -> None:
    path = tmp_path / ("x.toml" if name == "anipose" else "x.yaml")
    path.write_text(text)
    with pytest.raises(InputError, match=named):
        formats()[name].read(path)


def test_lenses_without_places_are_no_rig(tmp_path: Path) -> None:
    for name in ("a", "b"):
        formats()["opencv"].write(tmp_path, Rig((Camera(name, *one_lens()),)))
        text = (tmp_path / f"{name}.yaml").read_text()
        (tmp_path / f"{name}.yaml").write_text(text[: text.index("base_from_camera")])
    with pytest.raises(InputError, match="places of the cameras"):
        formats()["opencv"].read(tmp_path)


def one_lens() -> tuple[tuple[int, int], np.ndarray, np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    camera = one().cameras[0]
    return camera.size, camera.matrix, camera.distortion, camera.base_from_camera


def test_the_commands_carry_a_rig_there_and_back(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.toml", one(), [None])
    assert (
        main(["calibrate", "export", str(tmp_path / "rig.toml"), "--format", "ros", "-o", str(tmp_path / "ros")]) == 0
    )
    assert main(["calibrate", "import", str(tmp_path / "ros"), "--format", "ros", "-o", str(tmp_path / "b.toml")]) == 0
    assert np.array_equal(read_rig(tmp_path / "b.toml").rig.cameras[0].matrix, one().cameras[0].matrix)


@pytest.mark.parametrize("name", ["anipose", "ros"])
def test_a_rig_that_stands_there_is_kept_unless_told(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_brackets_in_brackets_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text("a: " + 2000 * "[", encoding="utf-8")
    with pytest.raises(InputError, match="a YAML file"):
        read_yaml(tmp_path / "x.yaml")
