"""TUM files: laws of the round trip, and every wrong line named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.trajectory import Trajectory
from hardware.tum import read_rows, read_tum, write_rows, write_tum

finite = st.floats(-1e7, 1e7)


@given(
    steps=st.lists(st.floats(1e-6, 1e5), min_size=1, max_size=8),
    start=st.floats(-1e6, 1e6),
    xi=st.lists(st.floats(-3, 3), min_size=6, max_size=6),
)
def test_a_trajectory_comes_back(
    tmp_path_factory: pytest.TempPathFactory, steps: list[float], start: float, xi: list[float]
) -> None:
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    stamps = start + np.cumsum(steps)
    poses = se3.exp(np.outer(np.linspace(-1, 1, len(stamps)), xi)) @ se3.make(np.eye(3), [1e3, -2e3, 0.1])
    write_tum(path, Trajectory(stamps, poses, True))
    back = read_tum(path, True)
    assert back.stamps.tobytes() == stamps.tobytes()
    assert back.base_from_surface[:, :3, 3].tobytes() == poses[:, :3, 3].tobytes()
    assert np.abs(back.base_from_surface - poses).max() < 1e-14
    assert back.exact


def test_rows_written_again_are_the_same_bytes(tmp_path: Path) -> None:
    rows = np.array([[0.1 + 0.2, 1 / 3, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8], [0.4, 1e-17, 2e9, 3.0, 0.5, 0.5, -0.5, 0.5]])
    write_rows(tmp_path / "a.tum", rows)
    write_rows(tmp_path / "b.tum", read_rows(tmp_path / "a.tum"))
    assert (tmp_path / "a.tum").read_bytes() == (tmp_path / "b.tum").read_bytes()
    assert read_rows(tmp_path / "a.tum").tobytes() == rows.tobytes()


GOOD = "0.0 1 2 3 0 0 0 1"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "poses"),
        ("# only words\n\n", "poses"),
        (f"{GOOD}\n1.0 1 2 3 0 0 nan 1\n", "line 2"),
        (f"{GOOD}\n1.0 inf 2 3 0 0 0 1\n", "line 2"),
        (f"{GOOD}\n0.0 1 2 3 0 0 0 1\n", "line 2: stamp"),
        (f"# words\n{GOOD}\n-0.5 1 2 3 0 0 0 1\n", "line 3: stamp"),
        ("0.0 1 2 3 0 0 0 0\n", "line 1: length of qx qy qz qw"),
        ("0.0 1 2 3 0 0 0 1.02\n", "line 1: length of qx qy qz qw"),
        ("0.0 1 2 3 0 0 1\n", "line 1"),
        ("0.0 1 2 3 0 0 0 one\n", "line 1"),
    ],
)
def test_a_wrong_line_is_named(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "t.tum"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_tum(path, False)
    assert (caught.value.where, caught.value.what) == (str(path), what)


def test_a_missing_or_binary_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "b.tum").write_bytes(b"\xff\xfe\x00\x80")
    for name in ("b.tum", "none.tum"):
        with pytest.raises(InputError, match=name):
            read_tum(tmp_path / name, False)
