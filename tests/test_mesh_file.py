"""Meshes and clouds: written files are read back; what is wrong with one is one line that names the file."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.scans.scan import Scan, ScanIndex, face_areas, face_normals, open_edges
from estimation.se3 import Array
from hardware.files import mesh_file
from hardware.files.mesh_file import read_mesh as read_mesh_apart
from hardware.files.mesh_file import read_raw_mesh as read_raw_mesh_apart
from hardware.files.mesh_file import write_ply
from hardware.files.mesh_reader import MAX_LINE_BYTES, MAX_MESH_ROWS, STL_HEADER_BYTES, MeshReader, RawMesh, _ending
from hardware.plan.order import in_mm
from tests import scans
from tests.campaigns.fuzz import GLTF_TEXT, OFF_TEXT, PCD_HEADER
from tests.rendered_sets import RADIUS, SCAN_FROM_SURFACE, patch, scan_of

BALL = scans.ball(30.0, 12)
KEPT: list[MeshReader] = []  # the process that reads all files of this module


@pytest.fixture(scope="module", autouse=True)
def kept_reader() -> Iterator[None]:
    with MeshReader() as reader:
        KEPT.append(reader)
        yield
    KEPT.clear()


def read_mesh(path: Path) -> Scan:
    return read_mesh_apart(path, KEPT[0])


def read_raw_mesh(path: Path) -> RawMesh:
    return read_raw_mesh_apart(path, KEPT[0])


def write(path: Path, scan: Scan, scale: float = 1.0) -> Path:
    """The scan as text; STL repeats each vertex for every triangle, as all STL files do."""
    vertices = scan.vertices * scale
    if path.suffix == ".ply":
        write_ply(path, vertices, scan.triangles)
    elif path.suffix == ".obj":
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        path.write_text("\n".join(lines + [f"f {a} {b} {c}" for a, b, c in (scan.triangles + 1).tolist()]) + "\n")
    else:
        rows = (np.r_[np.zeros(3), corners.ravel()].astype("<f4") for corners in vertices[scan.triangles])
        body = b"".join(row.tobytes() + b"\0\0" for row in rows)
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
    assert not len(open_edges(mesh))
    assert mesh.vertices.shape == BALL.vertices.shape and mesh.triangles.shape == BALL.triangles.shape
    tolerance = 1e-5 if suffix == ".stl" else 1e-9  # STL is single precision
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 30, atol=tolerance)
    assert np.einsum("ni,ni->n", mesh.normals, mesh.vertices / 30).min() > 0.98


def test_the_synthetic_scan_comes_back_in_its_own_frame(tmp_path: Path) -> None:
    write_ply(tmp_path / "surface.ply", *scan_of(patch(), 4.0))
    mesh = read_mesh(tmp_path / "surface.ply")
    on_patch = se3.transform_points(se3.inverse(SCAN_FROM_SURFACE), mesh.vertices)
    np.testing.assert_allclose(np.hypot(on_patch[:, 1], on_patch[:, 2] + RADIUS), RADIUS, atol=1e-9)
    assert (mesh.normals @ SCAN_FROM_SURFACE[:3, 2]).min() > 0.8 and len(open_edges(mesh)) == 2 * (20 + 15)


def test_a_hole_is_counted_not_refused(tmp_path: Path) -> None:
    holed = Scan(BALL.vertices, BALL.triangles[1:], BALL.normals)
    assert len(open_edges(read_mesh(write(tmp_path / "holed.ply", holed)))) == 3


@pytest.mark.parametrize("name", ["surface.ply", "surface.fbx", "surface"])
def test_a_file_that_is_not_there_or_of_no_known_kind(tmp_path: Path, name: str) -> None:
    text = refusal(tmp_path / name)
    assert (".ply, .stl, .obj" in text) and ("no such file" in text or not name.endswith(".ply"))


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj"])
def test_garbage_and_emptiness_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"surface{suffix}"
    for data in (b"", b"\n", np.random.default_rng(0).bytes(5000)):
        path.write_bytes(data)
        assert f"{len(data)} bytes" in refusal(path) or (data and "line 1 = " in refusal(path))


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
@pytest.mark.parametrize("value", ["nan", "inf"])
def test_a_vertex_that_is_not_finite_is_named(tmp_path: Path, suffix: str, value: str) -> None:
    path = write(tmp_path / f"surface{suffix}", scans.height_field(scans.plane, step=20.0))
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line == "end_header") + 1 if suffix == ".ply" else 0
    words = lines[first + 2].split()
    lines[first + 2] = " ".join([*words[:-1], value])
    path.write_text("\n".join(lines) + "\n")
    text = refusal(path)  # an infinite one is none to rply
    assert ("vertex 2 = " in text and value in text) or "'vertex' number 2" in text


NO_SURFACE = {
    f"triangle {len(BALL.triangles)}": replace(BALL, triangles=np.r_[BALL.triangles, [[0, 1, len(BALL.vertices)]]]),
    "without area": Scan(np.array([[0.0, 0, 0], [5, 0, 0], [10, 0, 0]]), np.array([[0, 1, 2]]), np.zeros((3, 3))),
}


@pytest.mark.parametrize("said", NO_SURFACE)
def test_what_is_no_surface_is_refused(tmp_path: Path, said: str) -> None:
    assert said in refusal(write(tmp_path / "surface.ply", NO_SURFACE[said]))


def test_a_scan_in_metres_is_called_one(tmp_path: Path) -> None:
    text = refusal(write(tmp_path / "surface.ply", BALL, 0.001))
    assert "metres" in text and "60 mm" in text


@pytest.mark.parametrize(("side", "allowed"), [(0.999, False), (1.001, True), (1999.0, True), (2001.0, False)])
def test_the_size_that_is_allowed_ends_where_it_says(tmp_path: Path, side: float, allowed: bool) -> None:
    path = write(tmp_path / "surface.ply", BALL, side / 60)
    if allowed:
        assert len(read_mesh(path).triangles)
    else:
        assert "1 to 2000 mm" in refusal(path)


def test_a_file_that_is_too_large_is_not_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "surface.stl", BALL)
    monkeypatch.setattr(mesh_file, "MAX_MESH_FILE_BYTES", path.stat().st_size - 1)
    assert "size of the file" in refusal(path)
    monkeypatch.setattr(mesh_file, "MAX_MESH_FILE_BYTES", path.stat().st_size)
    assert not len(open_edges(read_mesh(path)))


Corner = tuple[float, float, float]
NUMBER = st.floats(-1e6, 1e6, width=32)
VERTICES = st.lists(st.tuples(NUMBER, NUMBER, NUMBER), min_size=5, max_size=9)
FACES = st.lists(st.lists(st.integers(0, 4), min_size=3, max_size=6), min_size=1, max_size=6)
PLANE: list[Corner] = [(0, 0, 0), (20, 0, 1), (20, 20, 0), (0, 20, 2), (10, 30, 3.5)]
MIXED, AREA = [[0, 1, 2, 3], [3, 2, 4], [0, 1, 2, 4]], 900.0  # mm2 of all, seen from above


def ply(order: str, vertices: list[Corner], faces: list[list[int]], rich: bool = True) -> bytes:
    """A PLY file, a rich one with more in it than the mesh. order: of the bytes, "" for text."""
    name = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = f"""ply
format {name} 1.0
comment nothing
element material 2
property list uchar short shades
property uchar shine
element vertex {len(vertices)}
property uchar red
property float x
property double y
property float z
element face {len(faces)}
property float quality
property list ushort uint vertex_index
property list uchar float texcoord
end_header
""".encode()
    if not rich:
        head = b"\n".join(line for line in head.split(b"\n") if not re.search(b"material|shades|shine|texcoord", line))
        places = [(packed(order, "f4", x), packed(order, "f8", y), packed(order, "f4", z)) for x, y, z in vertices]
        rest = [packed(order, "f4", 0.5) + packed(order, "u2", len(f)) + packed(order, "u4", *f) for f in faces]
        return head + b"".join(b"\t" + b"".join(place) for place in places) + b"".join(rest)
    if not order:
        rows = ["2 -7 8 1", "0 255"] + [f"9 {x!r} {y!r} {z!r}" for x, y, z in vertices]
        rows += [f"0.5 {len(face)} {' '.join(map(str, face))} 2 0.25 0.75" for face in faces]
        return head + "\n".join(rows).encode() + b"\n"
    parts = [packed(order, "u1", 2), packed(order, "i2", -7, 8), packed(order, "u1", 1, 0, 255)]
    for x, y, z in vertices:
        parts += [packed(order, "u1", 9), packed(order, "f4", x), packed(order, "f8", y), packed(order, "f4", z)]
    for face in faces:
        parts += [packed(order, "f4", 0.5), packed(order, "u2", len(face)), packed(order, "u4", *face)]
        parts += [packed(order, "u1", 2), packed(order, "f4", 0.25, 0.75)]
    return head + b"".join(parts)


def packed(order: str, kind: str, *values: float) -> bytes:
    return np.array(values, order + kind).tobytes()


def obj(vertices: list[Corner], faces: list[list[int]]) -> bytes:
    """An OBJ file of all four ways to name a corner, some of them counted from behind."""
    lines = ["# nothing", "mtllib x.mtl", "o thing_1"]
    lines += [f"v {x!r} {y!r} {z!r} 0.5 0.5 0.5\nvt 0 1\nvn 0 0 1" for x, y, z in vertices]
    ways = ["{0}", "{0}/1", "{0}//1", "{0}/1/1"]
    for k, face in enumerate(faces):
        numbers = [one - len(vertices) if k % 2 else one + 1 for one in face]
        lines.append("f " + " ".join(ways[k % 4].format(one) for one in numbers) + " # a face")
    return "\n".join(lines).encode()


def binary_stl(vertices: list[Corner], faces: list[list[int]]) -> bytes:
    """The triangles among the faces."""
    rows = [np.r_[[0, 0, 0], np.array(vertices)[face].ravel()].astype("<f4").tobytes() + b"\0\0" for face in faces]
    return b"solid by its first word".ljust(80) + np.uint32(len(faces)).tobytes() + b"".join(rows)


def text_stl(vertices: list[Corner], faces: list[list[int]]) -> bytes:
    """The same as text, each triangle a solid."""
    found = []
    for face in faces:
        corners = "\n".join("  vertex " + " ".join(map(repr, vertices[one])) for one in face)
        found.append(f"solid a b\nFACET normal 0 0 1\nouter loop\n{corners}\nendloop\nendfacet\nendsolid a b\n")
    return "\r\n".join(found).encode()


FORMS: dict[str, Callable[[list[Corner], list[list[int]]], bytes]] = {
    "text.ply": lambda v, f: ply("", v, f),
    "little.ply": lambda v, f: ply("<", v, f),
    "big.ply": lambda v, f: ply(">", v, f),
    "windows.ply": lambda v, f: ply("", v, f).replace(b"\n", b"\r\n"),
    "x.obj": obj,
}
PLAIN = {f"plain_{n}.ply": partial(ply, o, rich=False) for n, o in (("little", "<"), ("big", ">"))}
SOUPS = {"binary.stl": binary_stl, "text.stl": text_stl}


def read(folder: Path, name: str, data: bytes) -> RawMesh:
    (folder / name).write_bytes(data)
    return read_raw_mesh(folder / name)


def refused(folder: Path, name: str, data: bytes) -> str:
    with pytest.raises(InputError) as caught:
        read(folder, name, data)
    assert caught.value.where == str(folder / name) and "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("meshes")


@settings(max_examples=8)
@given(VERTICES, FACES)
def test_a_mesh_is_read_triangle_for_triangle(folder: Path, vertices: list[Corner], faces: list[list[int]]) -> None:
    for name, form in FORMS.items():
        # one polygon that cannot be cut into triangles costs open3d the whole PLY file
        own = faces if name.endswith(".obj") else [face[:3] for face in faces]
        mesh = read(folder, name, form(vertices, own))
        np.testing.assert_array_equal(mesh.vertices, vertices)
        expected = [[face[0], face[k], face[k + 1]] for face in own for k in range(1, len(face) - 1)]
        np.testing.assert_array_equal(mesh.triangles, expected)


def test_polygons_are_cut_into_triangles(folder: Path) -> None:
    for name, form in FORMS.items():
        mesh = read(folder, name, form(PLANE, MIXED))
        corners = mesh.vertices[mesh.triangles]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        assert len(mesh.triangles) == 5 and areas.sum() == pytest.approx(AREA, rel=0.05)  # of polygons not quite flat


@settings(max_examples=8)
@given(VERTICES, FACES)
def test_a_soup_is_read_corner_for_corner(folder: Path, vertices: list[Corner], faces: list[list[int]]) -> None:
    triangles = [face[:3] for face in faces]
    for name, form in SOUPS.items():
        mesh = read(folder, name, form(vertices, triangles))
        np.testing.assert_array_equal(mesh.vertices[mesh.triangles], np.array(vertices)[triangles])


@pytest.mark.parametrize(
    ("name", "end"),  # of the last word text may lose all but a letter, and nobody can know
    [("text.ply", b"0.75\n"), ("plain_little.ply", b"?"), ("binary.stl", b"?"), ("text.stl", b"d a b\n")]
    + [pytest.param(*more, marks=pytest.mark.slow) for more in (("windows.ply", b"0.75\r\n"), ("plain_big.ply", b"?"))],
)
def test_whatever_is_cut_off_a_file_is_missed_and_so_is_more(name: str, end: bytes, tmp_path: Path) -> None:
    data = {**FORMS, **SOUPS, **PLAIN}[name](PLANE, [[0, 1, 2]])
    for length in range(len(data) - len(end) + 1):
        refused(tmp_path, name, data[:length])
    refused(tmp_path, name, data + b"1")


HEAD = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = b"element face 1\nproperty list uchar int vertex_indices\n"
ROWS = b"0 0 0\n20 0 0\n0 20 0\n3 0 1 2\n"
BIG = HEAD.replace(b"ascii", b"binary_big_endian")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (HEAD.replace(b" x", b" " + b"x" * 5000) + FACE + b"end_header\n" + ROWS, "properties of vertex"),
        (HEAD.replace(b"float x", b"9" * 5000 + b" x") + FACE + b"end_header\n" + ROWS, "line 4"),
        (HEAD.replace(b"vertex 3", b"vertex " + b"9" * 5000) + FACE + b"end_header\n" + ROWS, "line 3"),
        (HEAD.replace(b"vertex 3", b"vertex") + FACE + b"end_header\n" + ROWS, "line 3"),
        (HEAD.replace(b"vertex 3", b"vertex -1") + FACE + b"end_header\n" + ROWS, "line 3"),
        (HEAD.replace(b"vertex 3", b"vertex 999999") + FACE + b"end_header\n" + ROWS, "line 13"),
        (HEAD.replace(b"ascii", b""), "line 2"),
        (HEAD + FACE.replace(b"uchar", b"[" * 400) + b"end_header\n" + ROWS, "line 8"),
        (HEAD + FACE.replace(b"uchar", b"float") + b"end_header\n" + ROWS, "line 8"),
        (HEAD + FACE.replace(b"list uchar ", b"") + b"end_header\n" + ROWS, "properties of face"),
        (HEAD + HEAD[20:] + b"end_header\n" + ROWS, "no name twice"),
        (HEAD + b"element face 1\nend_header\n" + ROWS, "no element without any"),
        (HEAD + FACE + b"x" * (2 * MAX_LINE_BYTES), f"line 9 = '{MAX_LINE_BYTES} bytes or more'"),
        (HEAD + FACE + b"end_header\n" + ROWS.replace(b"20 0 0", b"20 0"), "line 11"),
        (HEAD + FACE + b"end_header\n" + ROWS.replace(b"20 0 0", b"20 x 0"), "'vertex' number 1"),
        (HEAD + FACE + b"end_header\n" + ROWS.replace(b"3 0 1", b"2 0 1"), "line 13"),
        (HEAD + FACE + b"end_header\n" + ROWS.replace(b"3 0 1", b"-3 0 1"), "line 13"),
        (HEAD + FACE + b"end_header\n" + ROWS.replace(b"3 0 1 2", b"2 0 1"), "line 13"),
        (HEAD + FACE + b"end_header\n" + ROWS.replace(b"3 0 1 2", b"3 0 1 " + b"9" * 5000), "Word too long"),
        (HEAD + FACE + b"end_header\n" + ROWS.replace(b"3 0 1 2", b"3 0 1 " + b"9" * 30), "'face' number 0"),
        (HEAD + FACE + b"end_header\n" + ROWS + b"1 2 3", "nothing behind"),
        (
            BIG.replace(b"vertex 3", b"vertex 1" + b"0" * 17) + b"end_header\n" + bytes(36),
            "rows of vertex = 100000000000000000",
        ),
        (BIG + FACE.replace(b"uchar", b"uint") + b"end_header\n" + bytes(36) + b"\xff" * 8, "RPly"),
        (BIG + FACE.replace(b"uchar", b"char") + b"end_header\n" + bytes(36) + b"\xff" * 8, "no triangles"),
        (
            BIG + FACE.replace(b"face 1", b"face 2") + b"end_header\n" + bytes(36) + b"\3" + bytes(12) + b"\3",
            "RPly",
        ),
    ],
)
def test_what_is_wrong_in_a_ply_file_is_said(data: bytes, said: str, tmp_path: Path) -> None:
    assert said in refused(tmp_path, "x.ply", data)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        *((f"f {one}", "f and three") for one in ("1 2", "1 2 0", "1 2 -4", "1 2 x", "1 2 1.5", "1 2 " + "9" * 30)),
        *((f"v {one}", "v and the three") for one in ("1 2", "1 2 x", "", "# 1 2 3")),
        ("curv 0 1 1 2", "v and the three"),
    ],
)
def test_what_is_wrong_in_an_obj_file_is_said(line: str, said: str, tmp_path: Path) -> None:
    data = f"v 0 0 0\nv 20 0 0\nv 0 20 0\n{line}\nf 1 2 3\n".encode()
    assert "line 4 = " in (text := refused(tmp_path, "x.obj", data)) and said in text


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("vertex 20.0 0.0 0.0\n", "", "allowed vertex and three numbers"),
        ("vertex 20.0 0.0 0.0", "vertex 20.0 0.0", "allowed vertex and three numbers"),
        ("vertex 20.0 0.0 0.0", "vertex 20.0 x 0.0", "allowed vertex and three numbers"),
        ("vertex 20.0 0.0 0.0", "vertex 20.0 0.0 0.0\nvertex 1 2 3", "allowed endloop"),
        ("outer loop\n", "", "allowed outer"),
        ("endsolid a b", "endsolit", "allowed facet"),
        ("endsolid a b\n", "endsolid\nendsolid", "allowed solid"),
        ("endsolid a b\n", "", "ends within a solid"),
    ],
)
def test_what_is_wrong_in_an_stl_file_is_said(old: str, new: str, said: str, tmp_path: Path) -> None:
    text = text_stl([(0.0, 0.0, 0.0), (20.0, 0.0, 0.0), (0.0, 20.0, 0.0)], [[0, 1, 2]]).decode()
    assert said in refused(tmp_path, "x.stl", text.replace("  vertex", "vertex").replace(old, new).encode())


def test_a_mesh_of_too_many_rows_is_refused_by_its_header_alone(tmp_path: Path) -> None:
    """The rows are not there: whoever read them would say so instead."""
    count = MAX_MESH_ROWS + 1
    for element, rows in (("vertex", "property float x"), ("face", "property list uchar int vertex_indices")):
        text = f"ply\nformat binary_little_endian 1.0\nelement {element} {count}\n{rows}\nend_header\n"
        (tmp_path / "x.ply").write_text(text)
        assert f"rows of {element} = {count}, allowed {MAX_MESH_ROWS} or fewer" in refusal(tmp_path / "x.ply")
    with (tmp_path / "x.stl").open("wb") as file:  # a hole of so many zeros takes no disk
        file.write(bytes(80) + count.to_bytes(4, "little"))
        file.truncate(STL_HEADER_BYTES + 50 * count)
    assert f"triangles = {count}" in refusal(tmp_path / "x.stl")


def test_text_of_too_many_rows_is_refused_as_soon_as_there_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hardware.files.mesh_reader.MAX_MESH_ROWS", 10)
    (tmp_path / "x.obj").write_text("v 0 0 0\n" * 11 + "this is never read\n")
    assert "vertices = 11" in refusal(tmp_path / "x.obj")
    (tmp_path / "x.obj").write_text("v 0 0 0\n" * 3 + "f 1 2 3\n" * 11 + "this is never read\n")
    assert "faces = 11" in refusal(tmp_path / "x.obj")
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    (tmp_path / "x.stl").write_text("solid x\n" + facet * 11 + "this is never read\n")
    assert "triangles = 11" in refusal(tmp_path / "x.stl")


@pytest.mark.parametrize("far", [1e7, 1e38, -1e300])
def test_a_vertex_that_is_kilometres_away_is_named(far: float) -> None:
    vertices = BALL.vertices.copy()
    vertices[5, 1] = far
    with pytest.raises(InputError, match=r"x.ply: vertex 5 = .* allowed coordinates within 1e\+06 mm"):
        in_mm(vertices, BALL.triangles, "mm", "x.ply")
    vertices[5, 1] = np.nan  # is left out, and counted
    assert in_mm(vertices, BALL.triangles, "mm", "x.ply").shape == vertices.shape


DEADLY = (
    HEAD.replace(b"vertex 3", b"vertex 4") + FACE + b"end_header\n0 0 0\n20 0 0\n20 20 0\n0 20 0\n4 0 1 2 99999999\n"
)


def test_a_file_that_ends_the_library_is_one_error_and_the_next_is_read(tmp_path: Path) -> None:
    assert "SIGSEGV" in refused(
        tmp_path, "x.ply", DEADLY
    )  # open3d 0.20 cuts the polygon before it looks at its corners
    assert len(read_mesh(write(tmp_path / "ball.ply", BALL)).triangles)


def test_a_reader_that_is_gone_is_one_error(tmp_path: Path) -> None:
    path = write(tmp_path / "ball.ply", BALL)
    with MeshReader() as reader:
        os.kill(reader._process.pid, signal.SIGKILL)
        with pytest.raises(InputError, match="the process that reads it ended with -9"):
            read_mesh_apart(path, reader)


def test_how_a_fork_ended_is_said_in_words() -> None:
    assert "within 120 s" in _ending(-signal.SIGALRM, "") == _ending(-signal.SIGXCPU, "")
    assert "SIGABRT" in _ending(-signal.SIGABRT, "x") and _ending(1, "words") == "words" and "with 1" in _ending(1, "")


def test_a_file_that_grows_while_it_is_read_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "ball.ply", BALL)

    class Slow(MeshReader):
        def __init__(self) -> None: ...

        def read(self, path: Path, cloud: bool) -> dict[str, Any]:
            found = KEPT[0].read(path, cloud)
            path.write_bytes(path.read_bytes() + b"0 0 0\n")
            return found

    with pytest.raises(InputError, match="changed while it was read"):
        read_mesh_apart(path, Slow())


@pytest.mark.parametrize(("name", "what"), [("x.ply", "faces"), ("x.gltf", "triangles"), ("x.off", "vertices")])
def test_a_part_of_a_file_is_not_taken_for_all_of_it(tmp_path: Path, name: str, what: str) -> None:
    data = {
        "x.ply": DEADLY.replace(b"4 0 1 2 99999999", b"3 0 1 2"),
        "x.gltf": GLTF_TEXT.encode(),
        "x.off": OFF_TEXT.encode(),
    }[name]
    (tmp_path / name).write_bytes(data)

    class Forgetful(MeshReader):
        def __init__(self) -> None: ...

        def read(self, path: Path, cloud: bool) -> dict[str, Any]:
            found = KEPT[0].read(path, cloud)
            return found | ({"count": 3} if what == "vertices" else {"triangles": found["triangles"][1:]})

    with pytest.raises(InputError, match=f"{what} that could be read"):
        read_raw_mesh_apart(tmp_path / name, Forgetful())


def cloud_file(path: Path, points: Array) -> Path:
    rows = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist())
    if path.suffix == ".ply":
        head = HEAD.replace(b"vertex 3", b"vertex %d" % len(points)).replace(b"float", b"double")
        path.write_bytes(head + b"end_header\n" + rows.encode())
    elif path.suffix == ".pcd":
        path.write_bytes(PCD_HEADER.format(len(points)).encode() + points.astype("<f4").tobytes())
    else:
        path.write_text("# a comment\n" + rows)
    return path


SKIN = scans.height_field(scans.body)
SCATTERED = np.random.default_rng(2).permutation(SKIN.vertices)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".xyz"])
def test_a_surface_is_laid_through_a_cloud_its_outside_up(tmp_path: Path, suffix: str) -> None:
    mesh = read_mesh(cloud_file(tmp_path / f"cloud{suffix}", SCATTERED))
    assert face_areas(mesh).sum() == pytest.approx(face_areas(SKIN).sum(), rel=0.01)
    assert (face_normals(mesh)[:, 2] > 0).all()
    away = ScanIndex(SKIN).closest(mesh.corners.mean(axis=1)).points - mesh.corners.mean(axis=1)
    assert np.linalg.norm(away, axis=1).max() < 0.1


def test_a_hole_in_a_cloud_stays_open_and_dust_is_left_out(tmp_path: Path) -> None:
    beside = np.linalg.norm(SCATTERED[:, :2], axis=1) > 6
    dust = np.array([[0.0, 0, 25], [3, 60, 10], [-70, 0, 0]])
    mesh = read_mesh(cloud_file(tmp_path / "cloud.xyz", np.concatenate([SCATTERED[beside], dust])))
    expected = face_areas(SKIN).sum() - np.pi * 6**2
    assert face_areas(mesh).sum() == pytest.approx(expected, rel=0.02) and mesh.vertices[:, 2].max() < 10


def test_a_cloud_gives_the_same_bytes_on_one_core_and_on_all(tmp_path: Path) -> None:
    path, cores = cloud_file(tmp_path / "cloud.xyz", SCATTERED), os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        alone = read_raw_mesh_apart(path)  # in a process that has one core
    finally:
        os.sched_setaffinity(0, cores)
    beside = read_raw_mesh(path)
    assert alone.vertices.tobytes() == beside.vertices.tobytes()
    assert alone.triangles.tobytes() == beside.triangles.tobytes()


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("x.xyz", b"0 0 0\n" * 100, "1 different points"),
        ("x.xyz", b"", "0 bytes"),
        ("x.xyz", b"0 0 0\n1 2\n", "line 2 = '1 2'"),
        ("x.xyz", b"0 0 0\n1 2 3x\n", "line 2 = '1 2 3x'"),
        ("x.pcd", b"FIELDS x y z\nDATA ascii\n", "no line POINTS"),
        ("x.pcd", b"POINTS 9000000\n", "points = 9000000"),
        ("x.off", OFF_TEXT.replace("4 2 0", "4 3 0").encode(), "could not read"),
        ("x.off", OFF_TEXT.replace("4 2 0", "4 1 0").encode() + b"?", "x.off"),
        ("x.off", b"OFF\n", "line 2"),
        ("x.gltf", GLTF_TEXT[:-5].encode(), "in its JSON"),
        (
            "x.gltf",
            GLTF_TEXT.replace('"count": 3, "type": "SCALAR"', '"count": 6, "type": "SCALAR"').encode(),
            "x.gltf",
        ),
        ("x.glb", b"glTF" + bytes(16), "bytes = 20, allowed 0"),
        ("x.obj", b"f 1 2 3\n", "0 points, 1 triangles"),
        ("x.obj", b"v 0 0 0\n", "1 points, 0 triangles"),
        ("x.xyz", b"0 0 0\n1 2 3\x004\n", "bytes that are 0"),
    ],
)
def test_what_is_wrong_in_another_format_is_said(name: str, data: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    if data.endswith(b"?"):  # of an OFF file what follows its faces is passed over
        assert len(read_raw_mesh(tmp_path / name).triangles) == 1
        return
    assert said in refused(tmp_path, name, data)


def test_off_and_gltf_are_read(tmp_path: Path) -> None:
    assert read(tmp_path, "x.off", OFF_TEXT.encode()).triangles.tolist() == [[0, 1, 2], [1, 3, 2]]
    mesh = read(tmp_path, "x.gltf", GLTF_TEXT.encode())
    np.testing.assert_array_equal(mesh.vertices[mesh.triangles], [[[0, 0, 0], [20, 0, 0], [0, 20, 0]]])
