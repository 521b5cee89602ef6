"""rig.toml: any rig comes back bit by bit, and matrices that are no rigid motion or no millimetres are refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from session_files import camera, rig

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from hardware.files.rig_file import ImageSource, read_rig, rig_from_table, table_from_rig, write_rig
from hardware.recording.messages import message_from_rig, rig_from_message

NOWHERE = ImageSource("images", "*")


def written(path: Path, cameras: list[Camera]) -> Path:
    write_rig(path, Rig(tuple(cameras)), [NOWHERE] * len(cameras))
    return path


finite = st.floats(-1e4, 1e4)


@given(
    xi=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    t=st.lists(finite, min_size=3, max_size=3),
    focal=st.floats(1e3, 1e5),
    lens=st.lists(st.floats(-1, 1), min_size=5, max_size=5),
    offset=finite,
    name=st.text(st.characters(categories=["L", "N", "P", "S", "Zs"], exclude_characters='/\\,"'), min_size=1).filter(
        lambda n: not n.startswith(".") and len(n) < 60
    ),
)
def test_a_rig_comes_back_bit_by_bit(
    tmp_path_factory: pytest.TempPathFactory,
    xi: list[float],
    t: list[float],
    focal: float,
    lens: list[float],
    offset: float,
    name: str,
) -> None:
    matrix = np.array([[focal, 0, 1 / 3], [0, focal * 1.1, 17.0], [0, 0, 1]])
    base_from_camera = se3.make(se3.exp_rotation(xi), t)
    one = Camera(name if name.isprintable() else "a", (1280, 720), matrix, np.array(lens), base_from_camera, offset)
    first = read_rig(written(tmp_path_factory.mktemp("rig") / "rig.toml", [one])).rig
    assert table_from_rig(first) == table_from_rig(Rig((one,)))
    assert table_from_rig(rig_from_message("file", message_from_rig(first))) == table_from_rig(first)


def test_four_digits_become_an_exact_rotation_and_stay_it(tmp_path: Path) -> None:
    rough = replace(camera("a", 1), base_from_camera=np.round(camera("a", 1).base_from_camera, 4))
    first = read_rig(written(tmp_path / "rig.toml", [rough])).rig
    exact = first.cameras[0].base_from_camera
    assert se3.is_transform(exact, 1e-14) and not se3.is_transform(rough.base_from_camera, 1e-6)
    assert np.abs(exact - rough.base_from_camera).max() < 2e-4
    second = read_rig(written(tmp_path / "again.toml", list(first.cameras))).rig
    assert second.cameras[0].base_from_camera.tobytes() == exact.tobytes()


def mirrored(m: Array) -> Array:
    return m @ np.diag([1.0, 1.0, -1.0, 1.0])


def scaled(m: Array) -> Array:
    return np.block([[1.002 * m[:3, :3], m[:3, 3:]], [m[3:]]])


def sheared(m: Array) -> Array:
    out = m.copy()
    out[0, 1] += 0.01
    return out


@pytest.mark.parametrize("spoil", [mirrored, scaled, sheared, np.transpose])
def test_a_matrix_that_is_no_rotation_is_refused(tmp_path: Path, spoil: Callable[[Array], Array]) -> None:
    wrong = replace(camera("a", 1), base_from_camera=spoil(camera("a", 1).base_from_camera))
    with pytest.raises(InputError, match=r"camera 'a': base_from_camera = .*allowed a rotation"):
        read_rig(written(tmp_path / "rig.toml", [camera("b", 0), wrong]))


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("place", [(0, 0), (1, 3)])
def test_a_matrix_with_a_hole_is_refused(tmp_path: Path, value: float, place: tuple[int, int]) -> None:
    table = table_from_rig(rig(2))
    table["camera"][1]["base_from_camera"][place[0]][place[1]] = value
    with pytest.raises(InputError, match=r"camera 'top': base_from_camera .* 4 x 4 finite numbers"):
        rig_from_table("here", table)


def baseline(distance: float) -> Rig:
    shifted = camera("b", 0).base_from_camera.copy()
    shifted[0, 3] += distance
    return Rig((camera("a", 0), replace(camera("b", 0), base_from_camera=shifted)))


def test_the_shortest_baseline_is_ten_millimetres(tmp_path: Path) -> None:
    assert len(rig_from_table("here", table_from_rig(baseline(10.001)))) == 2
    with pytest.raises(InputError, match="not m"):
        rig_from_table("here", table_from_rig(baseline(9.999)))


def test_a_rig_in_micrometres_is_refused() -> None:
    table = table_from_rig(rig(3))
    for entry in table["camera"]:
        for i in range(3):
            entry["base_from_camera"][i][3] *= 1e3
    with pytest.raises(InputError, match="mm"):
        rig_from_table("here", table)


def test_one_near_pair_in_a_wide_rig_and_a_single_camera_are_taken() -> None:
    near = baseline(0.0).cameras
    assert len(rig_from_table("here", table_from_rig(Rig((*near, camera("c", 5)))))) == 3
    assert len(rig_from_table("here", table_from_rig(Rig((camera("a", 0),))))) == 1


def test_a_calibration_without_images_can_be_read(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.toml", rig(2), [None, None])
    assert read_rig(tmp_path / "rig.toml").sources == (None, None)
