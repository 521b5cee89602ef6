"""Meshes and point clouds read by open3d in a process of its own, which a damaged file may end.

open3d 0.20 dies of some damaged files, and of others it gives a part and prints why. So a process loads it once
(`python -m hardware.files.mesh_reader`), forks for each file that its input names, and answers with what the fork has
read, or with what became of it. A fork has limits of memory and time; whatever the libraries print in it is an error.
OBJ and STL files are read here, without a library.
"""

from __future__ import annotations

import io
import json
import os
import re
import resource
import signal
import subprocess
import sys
from array import array
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError, StillbedError
from estimation.runtime import UNUSED_OPEN3D_MODULES, stub_modules
from estimation.se3 import Array
from hardware.process.system import signal_at_parents_end

MAX_LINE_BYTES = 1 << 16  # bytes of a line of text: a triangle takes some fifty
MAX_MESH_ROWS = 2_000_000  # vertices, and faces: a plan of so many takes 1 GB, and a minute or two
MAX_READER_BYTES = 4 << 30  # bytes that a fork may allocate: two million triangles take 0.3 GB, a large cloud 0.6
MAX_READER_SECONDS = 120  # s of processor that it may take: a cloud of MAX_CLOUD_POINTS takes ten
MAX_READER_WAIT = 600  # s that it may take on a machine that is busy
TIME_SIGNALS = (signal.SIGALRM, signal.SIGXCPU)
LENGTH_BYTES = 8  # of the length before each answer
MODULE = "hardware.files.mesh_reader"
SHARED_LIBRARIES = "libegl1 libgl1 libx11-6 libudev1 libusb-1.0-0 libidn2-0"  # Debian's packages that open3d links to

MAX_CLOUD_POINTS = 100_000  # a surface through more takes minutes, and is no better: 0.5 mm apart on a hand's breadth
DUST_NEIGHBOURS, DUST_REACH = 4, 4.0  # a point with fewer neighbours within so many usual distances is dust
NORMAL_NEIGHBOURS = 24  # points that a normal is laid through
ORIENTATION_NEIGHBOURS = 12  # points over which neighbours' normals are made to agree
BALL_RADII = (1.5, 3.0)  # of the balls, in usual distances of points: the first closes an even cloud, the second gaps

COLOURS = re.compile("\x1b\\[[0-9;]*m")  # of words on a terminal
Arrays = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class RawMesh:
    """A mesh as its file has it."""

    vertices: Array  # (V, 3), in the file's unit
    triangles: NDArray[np.int64]  # (T, 3) numbers of vertices
    colours: NDArray[np.uint8] | None = None  # (V, 3) red, green and blue; None where the file has none


class MeshReaderError(StillbedError):
    """No mesh was read; the text says why."""


class MeshReader:
    """The process that reads; it lives until it is closed."""

    def __init__(self) -> None:
        path = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])])
        # it computes little, and threads of its own would only be copied by each fork
        environment = os.environ | {"PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, "-P", "-m", MODULE]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
        )

    def read(self, path: Path, cloud: bool) -> Arrays:
        """What a file holds: `vertices` (V, 3), `triangles` (T, 3), and `count` of the vertices in the file.

        Where it has colours also `colours` (V, 3), red, green and blue.

        cloud: points without triangles, through which a surface is laid. MeshReaderError where that was not to be.
        """
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None and answers is not None
        try:
            requests.write(json.dumps([str(path), cloud]).encode() + b"\n")
            requests.flush()
            length = int.from_bytes(answers.read(LENGTH_BYTES), "little")
            answer = answers.read(length)
        except BrokenPipeError:
            length, answer = 0, b""
        if not length or len(answer) < length:
            raise MeshReaderError(f"the process that reads it ended with {self._process.wait()}")
        with np.load(io.BytesIO(answer), allow_pickle=False) as arrays:
            result = dict(arrays)
        if "failure" in result:
            raise MeshReaderError(str(result["failure"]))
        return result

    def close(self) -> None:
        """End the process."""
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with suppress(BrokenPipeError):  # of a request that nobody took any more
                stream.close()
        self._process.kill()
        self._process.wait()

    def __enter__(self) -> MeshReader:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer each request, a line of JSON with a file and whether it is a cloud, until there are no more."""
    failure = ""
    try:
        with stub_modules(*UNUSED_OPEN3D_MODULES):
            import open3d  # noqa: F401  # once for all forks
    except (ImportError, OSError) as error:
        failure = f"open3d does not load ({error}); on Debian: sudo apt-get install -y {SHARED_LIBRARIES}"
    for line in requests:
        path, cloud = json.loads(line)
        answer = _packed(failure=failure) if failure else _forked(path, cloud)
        answers.write(len(answer).to_bytes(LENGTH_BYTES, "little") + answer)
        answers.flush()


def _packed(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _forked(path: str, cloud: bool) -> bytes:
    """What a fork has read of a file, packed, or how it ended."""
    memory, printed = os.memfd_create("answer"), os.memfd_create("printed")
    try:
        child = os.fork()
        if not child:
            _read_and_exit(path, cloud, memory, printed)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if status:
            return _packed(failure=_ending(status, _plain_words(_contents(printed))))
        return _contents(memory)
    finally:
        os.close(memory)
        os.close(printed)


def _contents(file: int) -> bytes:
    return os.pread(file, os.fstat(file).st_size, 0)


def _ending(status: int, message: str) -> str:
    """How a fork that has not read its file ended."""
    if -status in TIME_SIGNALS:
        return f"not read within {MAX_READER_SECONDS} s of processor time, or {MAX_READER_WAIT} s"
    if status < 0:
        return f"the library that reads it dies of it ({signal.Signals(-status).name})"
    return message or f"the library that reads it ends with {status}"


def _read_and_exit(path: str, cloud: bool, memory: int, printed: int) -> None:
    """The whole life of a fork."""
    status = 1
    try:
        signal_at_parents_end(signal.SIGKILL)
        os.dup2(printed, 1)
        os.dup2(printed, 2)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MAX_READER_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (MAX_READER_SECONDS, MAX_READER_SECONDS))
        signal.alarm(MAX_READER_WAIT)
        arrays = surface_through(_points_of(path)) if cloud else _mesh_of(path)
        message = _plain_words(_contents(printed))
        answer = _packed(failure=message) if message else _packed(**arrays)
        status = 0 if os.write(memory, answer) == len(answer) else 1
    except MemoryError:
        os.write(2, f"it takes more than {MAX_READER_BYTES / 1e9:.1f} GB of memory".encode())
    except BaseException as error:  # whatever the library throws; nothing may go on in a fork
        if not _contents(printed):  # which says more
            os.write(2, str(error).encode())
    finally:
        os._exit(status)


def _plain_words(data: bytes) -> str:
    """What libraries printed, in one line without colours."""
    text = COLOURS.sub("", data.decode("utf-8", "replace")).replace("[Open3D WARNING] ", "")
    return "; ".join(" ".join(line.split()) for line in text.splitlines() if line.strip())


def _mesh_of(path: str) -> Arrays:
    import open3d as o3d

    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Warning)
    if path.lower().endswith((".ply", ".off")):  # in float64; the others' reader does without quadrangles
        mesh = o3d.io.read_triangle_mesh(path)
        vertices, triangles, colours = np.asarray(mesh.vertices), np.asarray(mesh.triangles), _colours_of(mesh)
    else:
        tensors = o3d.t.io.read_triangle_mesh(path)
        vertices, triangles, colours = tensors.vertex.positions.numpy(), tensors.triangle.indices.numpy(), {}
    arrays = {"vertices": vertices.astype(np.float64), "triangles": triangles.astype(np.int64)}
    return {**arrays, "count": len(vertices), **colours}


def _colours_of(mesh: Any) -> Arrays:
    """The colours of a mesh of open3d, if it has any."""
    shares = np.clip(np.nan_to_num(np.asarray(mesh.vertex_colors)), 0.0, 1.0)
    return {"colours": np.rint(255 * shares).astype(np.uint8)} if len(shares) == len(mesh.vertices) > 0 else {}


def _points_of(path: str) -> Any:
    import open3d as o3d

    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Warning)
    return o3d.io.read_point_cloud(path, remove_nan_points=False, remove_infinite_points=False)


def surface_through(cloud: Any) -> Arrays:
    """The surface through a point cloud of open3d: dust left out, normals made to agree, balls rolled over it.

    Ball pivoting (Bernardini et al. 1999) keeps the scanner's own points and leaves holes open; a Poisson surface was
    measured to be smoother on clouds with 0.1 mm of noise, which planning averages away anyway, but closes them.
    Without normals in the file the outside is where the surface bulges to.
    """
    import open3d as o3d

    count = len(cloud.points)
    cloud = cloud.remove_non_finite_points().remove_duplicated_points()
    if len(cloud.points) > MAX_CLOUD_POINTS:
        cloud = _thinned(cloud)
    if len(cloud.points) <= NORMAL_NEIGHBOURS:
        raise MeshReaderError(f"{len(cloud.points)} different points, {NORMAL_NEIGHBOURS + 1} or more are needed")
    spacing = float(np.median(np.asarray(cloud.compute_nearest_neighbor_distance())))
    cloud, _ = cloud.remove_radius_outlier(DUST_NEIGHBOURS, DUST_REACH * spacing)
    if not cloud.has_normals():
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
        cloud.orient_normals_consistent_tangent_plane(ORIENTATION_NEIGHBOURS)
        points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
        if np.einsum("ni,ni->", normals, points - points.mean(axis=0)) < 0:
            cloud.normals = o3d.utility.Vector3dVector(-normals)
    cloud.normalize_normals()
    radii = o3d.utility.DoubleVector([spacing * radius for radius in BALL_RADII])
    mesh = o3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii)
    arrays = {"vertices": np.asarray(mesh.vertices), "triangles": np.asarray(mesh.triangles, np.int64)}
    return {**arrays, "count": count, **_colours_of(mesh)}


def _thinned(cloud: Any) -> Any:
    """A cloud averaged over cubes, as large as leave MAX_CLOUD_POINTS of it."""
    side = float(np.ptp(np.asarray(cloud.points), axis=0).max()) / MAX_CLOUD_POINTS**0.5 / 2
    while len(thinner := cloud.voxel_down_sample(side).points) > MAX_CLOUD_POINTS:
        side *= max(1.05, (len(thinner) / MAX_CLOUD_POINTS) ** 0.5)
    return cloud.voxel_down_sample(side)


def text_rows(file: BinaryIO, path: Path) -> Iterator[tuple[int, list[bytes]]]:
    """The number and the tokens of each line that is not empty."""
    for number, line in enumerate(iter(partial(file.readline, MAX_LINE_BYTES), b""), 1):
        if len(line) == MAX_LINE_BYTES and not line.endswith(b"\n"):
            raise InputError(path, f"line {number}", f"{MAX_LINE_BYTES} bytes or more", f"fewer than {MAX_LINE_BYTES}")
        tokens = line.split()
        if b"\0" in line:  # where C ends a word
            raise wrong_line(path, number, tokens, "text without bytes that are 0")
        if tokens:
            yield number, tokens


def wrong_line(path: Path, number: int, tokens: list[bytes], allowed: str) -> InputError:
    """The error about a line of a text file."""
    return InputError(path, f"line {number}", b" ".join(tokens).decode("utf-8", "replace"), allowed)


def check_rows(path: Path, what: str, count: int) -> None:
    """InputError where a mesh has more vertices or faces than can be used."""
    if count > MAX_MESH_ROWS:
        raise InputError(path, what, count, f"{MAX_MESH_ROWS} or fewer: make the mesh coarser")


STL_HEADER_BYTES = 84  # bytes: eighty of anything, and the number of triangles
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
STL_ORDER = (b"facet", b"outer", b"vertex", b"vertex", b"vertex", b"endloop", b"endfacet")  # a triangle, line by line
STL_REST = {b"facet": " or endsolid", b"vertex": " and three numbers"}  # what may follow, or stand there instead


def read_stl(path: Path) -> RawMesh:
    """The mesh in an STL file, three vertices of its own for each triangle. InputError says where it is none.

    open3d's reader (Assimp) takes fifteen times as long, and refuses text in capitals.
    """
    with path.open("rb") as file:
        size, head = path.stat().st_size, file.read(STL_HEADER_BYTES)
        count = int.from_bytes(head[80:], "little")
        if len(head) == STL_HEADER_BYTES and size == STL_HEADER_BYTES + STL_TRIANGLE.itemsize * count:
            check_rows(path, "triangles", count)
            corners = np.fromfile(file, STL_TRIANGLE)["corners"].astype(np.float64).reshape(-1, 3)
        elif head.lstrip()[:5].lower() == b"solid":
            file.seek(0)
            corners = np.array(_text_corners(file, path)).reshape(-1, 3)
        else:
            got = f"{size} bytes" + (f", {count} triangles by its header" if len(head) == STL_HEADER_BYTES else "")
            sizes = f"{STL_HEADER_BYTES} bytes and {STL_TRIANGLE.itemsize} for each triangle"
            raise InputError(path, "scan", got, f"{sizes} (is it cut short?), or text")
    return RawMesh(corners, np.arange(len(corners)).reshape(-1, 3))


def _text_corners(file: BinaryIO, path: Path) -> array[float]:
    """Nine numbers for each triangle of a text STL file, of all its solids."""
    corners, step, solid = array("d"), 0, False
    for number, tokens in text_rows(file, path):
        word, expected = tokens[0].lower(), STL_ORDER[step]
        if step == 0 and word == (b"endsolid" if solid else b"solid"):
            solid = not solid
            continue
        try:
            if not solid or word != expected:
                raise ValueError
            if word == b"vertex":
                x, y, z = tokens[1:]
                corners.extend((float(x), float(y), float(z)))
                check_rows(path, "triangles", len(corners) // 9)
        except ValueError:
            allowed = expected.decode() + STL_REST.get(expected, "") if solid else "solid"
            raise wrong_line(path, number, tokens, allowed) from None
        step = (step + 1) % len(STL_ORDER)
    if solid:
        raise InputError(path, "scan", "ends within a solid", "endsolid as its last line (is it cut short?)")
    return corners


OBJ_VERTEX, OBJ_FACE = "v and the three numbers of a place", "f and three or more numbers of vertices, counted from 1"
IGNORED_OBJ_WORDS = frozenset(
    b"vt vn vp g o s mg l p usemtl mtllib usemap maplib bevel c_interp d_interp lod shadow_obj trace_obj".split()
)


def read_obj(path: Path) -> RawMesh:
    """The mesh in an OBJ file, polygons as fans of triangles. InputError names the line that is no line of one.

    open3d's reader (Assimp) leaves out a line that it does not understand, a vertex behind a blank for one, and counts
    the vertices behind it one less: another surface, without a word. So this format is read here.
    """
    places, triangles, faces = array("d"), array("q"), 0
    with path.open("rb") as file:
        for number, tokens in text_rows(file, path):
            word = tokens[0]
            if word not in (b"v", b"f"):
                if word in IGNORED_OBJ_WORDS or word.startswith(b"#"):
                    continue
                raise wrong_line(path, number, tokens, f"{OBJ_VERTEX}, or {OBJ_FACE}")
            try:
                if word == b"v":
                    x, y, z = tokens[1:4]
                    places.extend((float(x), float(y), float(z)))
                    check_rows(path, "vertices", len(places) // 3)
                else:
                    first, *others = _corners(tokens[1:], len(places) // 3)
                    for one, other in pairwise(others):
                        triangles.extend((first, one, other))
                    faces += 1
                    check_rows(path, "faces", faces)
            except (ValueError, OverflowError):
                raise wrong_line(path, number, tokens, OBJ_VERTEX if word == b"v" else OBJ_FACE) from None
    return RawMesh(np.array(places).reshape(-1, 3), np.array(triangles, np.int64).reshape(-1, 3))


def _corners(tokens: list[bytes], vertices: int) -> list[int]:
    """Numbers, from 0, of the corners that the tokens i, i/t, i//n or i/t/n name. vertices: how many have come so far.

    ValueError: they are no face.
    """
    if b"#" in tokens:
        tokens = tokens[: tokens.index(b"#")]
    corners = [int(word.partition(b"/")[0]) for word in tokens]
    if len(corners) < 3 or 0 in corners or min(corners) < -vertices:
        raise ValueError
    return [one - 1 if one > 0 else vertices + one for one in corners]


PLAIN_READERS = {".stl": read_stl, ".obj": read_obj}


if __name__ == "__main__":
    serve(sys.stdin.buffer, sys.stdout.buffer)
