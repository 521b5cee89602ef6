"""The files of a smoothed session."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation.batch.smoothed import Instants, Smoothed
from estimation.errors import InputError
from estimation.rig import Rig, distort, ideal_pixels
from estimation.se3 import Array, quaternion_from_rotation, transform_points
from hardware.files.pose_file import TANGENT
from hardware.files.session import Session
from hardware.process.checks import read_csv
from hardware.tum import checked_rows, row_from_words, trajectory_from_rows
from perception.frames import Image

COLUMNS = ("stamp_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
TWIST = ("wx_rad_s", "wy_rad_s", "wz_rad_s", "vx_mm_s", "vy_mm_s", "vz_mm_s")
UPPER = np.triu_indices(6)
GREY = np.array([150, 150, 150])


def write_instants(path: Path, instants: Instants) -> None:
    """smoothed.csv: pose, twist, and the upper triangles of both covariances, a line for each instant."""
    pairs = [f"{TANGENT[i]}_{TANGENT[j]}" for i, j in zip(*UPPER, strict=True)]
    head = [*COLUMNS, *TWIST, *(f"cov_{pair}" for pair in pairs), *(f"twist_cov_{pair}" for pair in pairs)]
    poses = instants.base_from_surface
    numbers = np.concatenate([poses[:, :3, 3], quaternion_from_rotation(poses[:, :3, :3]), instants.twist], axis=1)
    spreads = [c[:, UPPER[0], UPPER[1]] for c in (instants.covariance, instants.twist_covariance)]
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(head)
        for stamp, row, *parts in zip(instants.stamps, numbers, *spreads, strict=True):
            claims = (f"{v:.6g}" for part in parts for v in part)
            writer.writerow([f"{stamp:.6f}", *(f"{v:.9f}" for v in row), *claims])


def read_instants(path: Path) -> tuple[Array, Array, Array]:
    """Stamps (N,), poses (N, 4, 4), covariances (N, 6, 6) of a smoothed.csv; InputError names what is wrong."""
    rows, count = read_csv(path), len(COLUMNS)
    width = count + len(TWIST)
    lines = [(f"line {number}", words) for number, words in rows[1:] if words]
    for what, words in lines:
        if len(words) != len(rows[0][1]):
            raise InputError(path, what, f"{len(words)} columns", f"{len(rows[0][1])} columns")
    places = checked_rows(path, ((what, row_from_words(path, what, words[:count])) for what, words in lines))
    if not len(places):
        raise InputError(path, "poses", "none", "at least one line")
    covariance = np.empty((len(lines), 6, 6))
    for k, (what, words) in enumerate(lines):
        claims = row_from_words(path, f"{what}: covariance", words[width : width + len(UPPER[0])], "21 numbers")
        covariance[k][UPPER] = covariance[k].T[UPPER] = claims
    trajectory = trajectory_from_rows(places, exact=False)
    return trajectory.stamps, trajectory.base_from_surface, covariance


def write_map(path: Path, smoothed: Smoothed, session: Session) -> None:
    """map.ply: landmarks in the surface frame with normal, colour and sigma (mm, along its worst direction), as text.

    The colour is that of the first frame set's images, grey where no camera sees the landmark in them.
    """
    points, normals = smoothed.map.points, smoothed.map.normals
    count = len(points)
    blocks = smoothed.map.covariance.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count)]
    sigma = np.sqrt(np.linalg.eigvalsh(blocks)[:, -1])
    colours = _colours(smoothed, session)
    head = ["ply", "format ascii 1.0", f"element vertex {count}"]
    head += [f"property double {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    head += [*(f"property uchar {name}" for name in ("red", "green", "blue")), "property double sigma", "end_header"]
    rows = zip(np.c_[points, normals].tolist(), colours.tolist(), sigma.tolist(), strict=True)
    body = [" ".join(map(str, (*map(repr, numbers), *colour, repr(s)))) for numbers, colour, s in rows]
    path.write_text("\n".join(head + body) + "\n", encoding="ascii")


def _colours(smoothed: Smoothed, session: Session) -> NDArray[np.int64]:
    """(L, 3) red green blue, 0 to 255."""
    out = np.tile(GREY, (len(smoothed.map), 1))
    for frames in session.frame_sets():
        k = int(np.abs(smoothed.stamps - frames.stamp).argmin())
        if abs(smoothed.stamps[k] - frames.stamp) > 0.05:
            continue
        points_base = transform_points(smoothed.states.poses[k], smoothed.map.points)
        for frame in frames.frames:
            _lay(out, frame.image, smoothed.rig, frame.camera, points_base)
        break
    return out


def _lay(colours: NDArray[np.int64], image: Image, rig: Rig, camera: int, points_base: Array) -> None:
    """The colours (L, 3) of what the image, grey or BGR, shows of points (L, 3)."""
    ideal, depth = ideal_pixels(rig.cameras[camera], points_base)
    at = np.round(distort(rig.cameras[camera], ideal))
    inside = (depth > 0) & (at >= 0).all(1) & (at < image.shape[1::-1]).all(1)
    x, y = at[inside].astype(np.int64).T
    shown = image[y, x]
    colours[inside] = shown[:, None] if shown.ndim == 1 else shown[:, ::-1]
