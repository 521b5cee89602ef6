"""Meshes as PLY text, which every viewer reads; reading them back is mesh_file's part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array


def write_ply(path: Path, vertices: Array, triangles: NDArray[np.int64]) -> None:
    """Write vertices (V, 3) mm and triangles (T, 3) as a PLY file, in text."""
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    head += [f"property double {axis}" for axis in "xyz"]
    head += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
    body = [" ".join(repr(float(v)) for v in p) for p in vertices] + [f"3 {a} {b} {c}" for a, b, c in triangles]
    path.write_text("\n".join(head + body) + "\n", encoding="ascii")
