"""First guess of where the cameras are: pairs that saw the board at the same instants, joined to a tree."""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.camera_calibration.lens_fit import Undetermined
from estimation.camera_calibration.views import Views
from estimation.se3 import Array

LEAST_COMMON = 3  # instants that two cameras must share
MOST_COMPARED = 60  # of the guesses of one pair: their middle one is sought among all pairs of guesses


def first_rig(views: Views, camera_from_board: Array) -> tuple[Array, Array]:
    """base_from_camera (C, 4, 4), the first camera being the base, and base_from_board (S, 4, 4).

    camera_from_board: (V, 4, 4). Undetermined names the cameras that no chain of shared views joins to the first.
    """
    count = len(views.names)
    shared = {(a, b): _common(views, a, b) for a in range(count) for b in range(count) if a != b}
    base_from_camera = {0: np.eye(4)}
    while len(base_from_camera) < count:
        links = [pair for pair in shared if pair[0] in base_from_camera and pair[1] not in base_from_camera]
        a, b = max(links, key=lambda pair: len(shared[pair]))
        if len(shared[a, b]) < LEAST_COMMON:
            _refuse(views, base_from_camera, shared)
        rows = shared[a, b][:: -(-len(shared[a, b]) // MOST_COMPARED)]
        a_from_b = _middle(camera_from_board[rows[:, 0]] @ se3.inverse(camera_from_board[rows[:, 1]]))
        base_from_camera[b] = base_from_camera[a] @ a_from_b
    placed = np.stack([base_from_camera[c] for c in range(count)])
    return placed, _boards(views, placed, camera_from_board)


def _common(views: Views, a: int, b: int) -> Array:
    """Rows (N, 2) of the views that cameras a and b had of the same instants."""
    first, second = (np.flatnonzero(views.camera == c) for c in (a, b))
    _, i, j = np.intersect1d(views.instant[first], views.instant[second], return_indices=True)
    return np.stack([first[i], second[j]], 1)


def _refuse(views: Views, placed: dict[int, Array], shared: dict[tuple[int, int], Array]) -> None:
    alone = [c for c in range(len(views.names)) if c not in placed]
    most = max(len(shared[a, b]) for a in placed for b in alone)
    raise Undetermined(
        f"camera {', '.join(views.names[c] for c in alone)}: saw the board together with "
        f"{', '.join(views.names[c] for c in placed)} in {most} frame sets, allowed {LEAST_COMMON} or more: hold the "
        "board where both see it"
    )


def _middle(found: Array) -> Array:
    """The transform (4, 4) of (N, 4, 4) that is least far from all others: late cameras and blunders pull it not."""
    apart = se3.log(se3.inverse(found)[:, None] @ found[None])
    reach = np.linalg.norm(found[:, :3, 3], axis=1).mean()
    far = np.linalg.norm(apart[..., 3:], axis=-1) + reach * np.linalg.norm(apart[..., :3], axis=-1)
    return np.asarray(found[np.median(far, axis=1).argmin()])


def _boards(views: Views, base_from_camera: Array, camera_from_board: Array) -> Array:
    """base_from_board (S, 4, 4), each by the view that shows most corners."""
    order = np.lexsort((views.seen.sum(1), views.instant))
    last = np.flatnonzero(np.diff(np.append(views.instant[order], -1)))
    best = order[last]
    return np.asarray(base_from_camera[views.camera[best]] @ camera_from_board[best])
