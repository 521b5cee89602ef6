"""Meshes from OBJ files: places and faces; materials, textures and normals are not looked at."""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np

from hardware.raw_mesh import RawMesh, fans, text_rows, wrong_line

VERTEX, FACE = "v and the three numbers of a place", "f and three or more numbers of vertices, counted from 1"
IGNORED = frozenset(
    b"vt vn vp g o s mg l p usemtl mtllib usemap maplib bevel c_interp d_interp lod shadow_obj trace_obj".split()
)


def read_obj(path: Path) -> RawMesh:
    """The mesh in an OBJ file, polygons as fans of triangles. InputError names the line that is no line of one."""
    places, counts, corners = array("d"), array("q"), array("q")
    with path.open("rb") as file:
        for number, words in text_rows(file, path):
            word = words[0]
            if word not in (b"v", b"f"):
                if word in IGNORED or word.startswith(b"#"):
                    continue
                raise wrong_line(path, number, words, f"{VERTEX}, or {FACE}")
            try:
                if word == b"v":
                    x, y, z = words[1:4]
                    places.extend((float(x), float(y), float(z)))
                else:
                    face = _face(words[1:], len(places) // 3)
                    counts.append(len(face))
                    corners.extend(face)
            except (ValueError, OverflowError):
                raise wrong_line(path, number, words, VERTEX if word == b"v" else FACE) from None
    return RawMesh(
        np.array(places, np.float64).reshape(-1, 3),
        fans(np.array(counts, np.int64), np.array(corners, np.int64)),
    )


def _face(words: list[bytes], vertices: int) -> list[int]:
    """Numbers, from 0, of the corners that the words i, i/t, i//n or i/t/n name. vertices: how many have come so far.

    ValueError: they are no face.
    """
    if b"#" in words:
        words = words[: words.index(b"#")]
    found = [int(word.partition(b"/")[0]) for word in words]
    if len(found) < 3 or 0 in found or min(found) < -vertices:
        raise ValueError
    return [one - 1 if one > 0 else vertices + one for one in found]
