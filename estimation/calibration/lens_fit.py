"""First guesses from planes: homographies, the focal length of all of them, and each view's pose (Zhang 2000)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.camera_calibration.views import Views
from estimation.se3 import Array

LEAST = 4  # corners that fix a homography
SUSPICIOUS = 3.0  # px off a homography: strong distortion over a board in the corner of the image leaves 2
CLEARER = 2.0  # times by which the rest lies better without a blunder


def homography(plane: Array, pixels: Array) -> Array:
    """(3, 3), of unit length, that carries (N, 2) of the plane to (N, 2) pixels, by the direct linear transform."""
    to_plane, to_pixels = _normaliser(plane), _normaliser(pixels)
    a, b = (np.c_[p, np.ones(len(p))] @ t.T for p, t in ((plane, to_plane), (pixels, to_pixels)))
    nothing = np.zeros_like(a)
    rows = np.concatenate([np.hstack([a, nothing, -b[:, :1] * a]), np.hstack([nothing, a, -b[:, 1:2] * a])])
    found = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    whole = np.linalg.inv(to_pixels) @ found @ to_plane
    return np.asarray(whole / np.linalg.norm(whole))


def _normaliser(points: Array) -> Array:
    middle = points.mean(0)
    scale = 1.4 / max(float(np.linalg.norm(points - middle, axis=1).mean()), 1e-12)
    return np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1]])


def homographies(views: Views) -> Array:
    """(V, 3, 3) from the board's plane, mm, to pixels about each image's middle; nan with fewer than four corners."""
    out = np.full((len(views), 3, 3), np.nan)
    for v, seen in enumerate(views.seen):
        if seen.sum() >= LEAST:
            middle = (np.array(views.sizes[views.camera[v]]) - 1) / 2
            out[v] = homography(views.points[seen, :2], views.pixels[v, seen] - middle)
    return out


def plane_blunders(views: Views) -> NDArray[np.bool_]:
    """(V, P) corners without which the rest of their view lies on one plane much better: found before any lens is."""
    out = np.zeros(views.seen.shape, bool)
    for v, seen in enumerate(views.seen):
        rows = np.flatnonzero(seen)
        while len(rows) >= LEAST + 2:
            away = _away(views, v, rows)
            worst = float(away.max())
            if worst < SUSPICIOUS:
                break
            rest = [float(_away(views, v, np.delete(rows, i)).max()) for i in range(len(rows))]
            if min(rest) > worst / CLEARER:
                break
            out[v, rows[int(np.argmin(rest))]] = True
            rows = np.delete(rows, int(np.argmin(rest)))
    return out


def _away(views: Views, v: int, rows: NDArray[np.int64]) -> Array:
    plane, pixels = views.points[rows, :2], views.pixels[v, rows]
    there = np.c_[plane, np.ones(len(rows))] @ homography(plane, pixels).T
    return np.asarray(np.linalg.norm(there[:, :2] / there[:, 2:] - pixels, axis=1))


def focal(found: Array) -> float:
    """The focal length, px, with square pixels about the image's middle that suits all homographies (V, 3, 3); or nan.

    Each gives h1' w h2 = 0 and h1' w h1 = h2' w h2 with w = diag(1/f^2, 1/f^2, 1): linear in 1/f^2, weighted by tilt.
    """
    return focal_of(focal_terms(found))


def focal_terms(found: Array) -> Array:
    """(3,) of homographies (V, 3, 3), what a focal length is found from; terms of several add up."""
    h = found[np.isfinite(found).all((1, 2))]
    a, b = h[:, :, 0], h[:, :, 1]
    flat = np.concatenate([(a[:, :2] * b[:, :2]).sum(1), (a[:, :2] ** 2 - b[:, :2] ** 2).sum(1)])
    deep = np.concatenate([a[:, 2] * b[:, 2], a[:, 2] ** 2 - b[:, 2] ** 2])
    scale = np.tile((a[:, :2] ** 2).sum(1), 2)
    flat, deep = flat / scale, deep / scale
    return np.array([flat @ flat, deep @ deep, flat @ deep])


def focal_of(terms: Array) -> float:
    """The focal length, px, by summed terms (3,); nan where they tell none."""
    flat, deep, both = terms
    if not both < 0:
        return float("nan")
    return float((flat / deep) ** 0.25)  # neither of the two is free of noise


def poses(found: Array, f: Array) -> Array:
    """camera_from_board (V, 4, 4) of homographies (V, 3, 3) and focal lengths (V,)."""
    columns = found / np.stack([f, f, np.ones_like(f)], -1)[:, :, None]
    size = np.linalg.norm(columns[:, :, :2], axis=1).mean(1) * np.where(columns[:, 2, 2] < 0, -1, 1)
    columns = columns / size[:, None, None]
    x, y, shift = columns[:, :, 0], columns[:, :, 1], columns[:, :, 2]
    return np.stack(
        [
            se3.orthonormalise(se3.make(np.stack([a, b, np.cross(a, b)], 1), t))
            for a, b, t in zip(x, y, shift, strict=True)
        ]
    )
