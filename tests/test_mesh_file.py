"""Scans are read from PLY, STL and OBJ, and whatever is wrong with one is said in one line that names the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.scan import Scan
from hardware.files import mesh_file
from hardware.files.mesh_file import read_mesh
from hardware.ply_file import write_ply
from tests import scans
from tests.synthetic import RADIUS, SCAN_FROM_SURFACE, patch, scan_of

BALL = scans.ball(30.0, 12)


def write(path: Path, scan: Scan, scale: float = 1.0) -> Path:
    """The scan as text; STL repeats each vertex for every triangle, as all STL files do."""
    vertices = scan.vertices * scale
    if path.suffix == ".ply":
        write_ply(path, vertices, scan.triangles)
    elif path.suffix == ".obj":
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        path.write_text("\n".join(lines + [f"f {a} {b} {c}" for a, b, c in (scan.triangles + 1).tolist()]) + "\n")
    else:
        body = b"".join(
            np.r_[np.zeros(3), t.ravel()].astype("<f4").tobytes() + b"\0\0" for t in vertices[scan.triangles]
        )
        path.write_bytes(bytes(80) + np.uint32(len(scan.triangles)).tobytes() + body)
    return path


def refusal(path: Path) -> str:
    """What is said about a file that is refused: one line that names it."""
    with pytest.raises(InputError) as caught:
        read_mesh(path)
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text
    return text


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj"])
def test_every_format_gives_the_same_scan(tmp_path: Path, suffix: str) -> None:
    mesh = read_mesh(write(tmp_path / f"surface{suffix}", BALL))
    assert mesh.open_edges == 0
    assert mesh.scan.vertices.shape == BALL.vertices.shape and mesh.scan.triangles.shape == BALL.triangles.shape
    tolerance = 1e-5 if suffix == ".stl" else 1e-9  # STL is single precision
    np.testing.assert_allclose(np.linalg.norm(mesh.scan.vertices, axis=1), 30, atol=tolerance)
    assert np.einsum("ni,ni->n", mesh.scan.normals, mesh.scan.vertices / 30).min() > 0.98


def test_the_synthetic_scan_comes_back_in_its_own_frame(tmp_path: Path) -> None:
    write_ply(tmp_path / "surface.ply", *scan_of(patch(), 4.0))
    mesh = read_mesh(tmp_path / "surface.ply")
    on_patch = se3.transform_points(se3.inverse(SCAN_FROM_SURFACE), mesh.scan.vertices)
    np.testing.assert_allclose(np.hypot(on_patch[:, 1], on_patch[:, 2] + RADIUS), RADIUS, atol=1e-9)
    assert (mesh.scan.normals @ SCAN_FROM_SURFACE[:3, 2]).min() > 0.8
    assert mesh.open_edges == 2 * (20 + 15)


def test_a_hole_is_counted_not_refused(tmp_path: Path) -> None:
    holed = Scan(BALL.vertices, BALL.triangles[1:], BALL.normals)
    assert read_mesh(write(tmp_path / "holed.ply", holed)).open_edges == 3


@pytest.mark.parametrize("name", ["surface.ply", "surface.glb", "surface"])
def test_a_file_that_is_not_there_or_of_no_known_kind(tmp_path: Path, name: str) -> None:
    text = refusal(tmp_path / name)
    assert (".ply, .stl, .obj" in text) and ("no such file" in text or not name.endswith(".ply"))


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj"])
def test_garbage_and_emptiness_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"surface{suffix}"
    for data in (b"", b"\n", np.random.default_rng(0).bytes(5000)):
        path.write_bytes(data)
        assert f"{len(data)} bytes" in refusal(path) or "line 1 = " in refusal(path)


@pytest.mark.parametrize("part", [0.02, 0.3, 0.6, 0.9, 0.998])
@pytest.mark.parametrize("suffix", [".ply", ".stl"])
def test_a_file_cut_short_is_refused_not_read_in_part(tmp_path: Path, suffix: str, part: float) -> None:
    path = write(tmp_path / f"surface{suffix}", BALL)
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    refusal(path)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
@pytest.mark.parametrize("value", ["nan", "inf"])
def test_a_vertex_that_is_not_finite_is_named(tmp_path: Path, suffix: str, value: str) -> None:
    path = write(tmp_path / f"surface{suffix}", scans.height_field(scans.plane, step=20.0))
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line == "end_header") + 1 if suffix == ".ply" else 0
    words = lines[first + 2].split()
    lines[first + 2] = " ".join([*words[:-1], value])
    path.write_text("\n".join(lines) + "\n")
    assert "vertex 2 = " in (text := refusal(path)) and value in text


def test_a_triangle_without_its_vertices_is_named(tmp_path: Path) -> None:
    bad = Scan(BALL.vertices, np.r_[BALL.triangles, [[0, 1, len(BALL.vertices)]]], BALL.normals)
    assert f"triangle {len(BALL.triangles)}" in refusal(write(tmp_path / "surface.ply", bad))


def test_points_without_triangles_are_refused(tmp_path: Path) -> None:
    points = Scan(BALL.vertices, BALL.triangles[:0], BALL.normals)
    assert "no triangles" in refusal(write(tmp_path / "cloud.ply", points))


def test_triangles_without_area_are_refused(tmp_path: Path) -> None:
    line = Scan(np.array([[0.0, 0, 0], [5, 0, 0], [10, 0, 0]]), np.array([[0, 1, 2]]), np.zeros((3, 3)))
    assert "without area" in refusal(write(tmp_path / "line.ply", line))


def test_a_scan_in_metres_is_called_one(tmp_path: Path) -> None:
    text = refusal(write(tmp_path / "surface.ply", BALL, 0.001))
    assert "metres" in text and "60 mm" in text


@pytest.mark.parametrize(("side", "allowed"), [(0.999, False), (1.001, True), (1999.0, True), (2001.0, False)])
def test_the_size_that_is_allowed_ends_where_it_says(tmp_path: Path, side: float, allowed: bool) -> None:
    path = write(tmp_path / "surface.ply", BALL, side / 60)
    if allowed:
        assert len(read_mesh(path).scan.triangles)
    else:
        assert "1 to 2000 mm" in refusal(path)


def test_a_file_that_is_too_large_is_not_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "surface.stl", BALL)
    monkeypatch.setattr(mesh_file, "LARGEST_FILE", path.stat().st_size - 1)
    assert "size of the file" in refusal(path)
    monkeypatch.setattr(mesh_file, "LARGEST_FILE", path.stat().st_size)
    assert read_mesh(path).open_edges == 0
