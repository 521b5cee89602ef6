"""Which camera measures which axis of the world: fixed at the start (thesis 4.2, 4.6, Fig. 4.13 and Appendix A)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimation.se3 import Array

ACROSS = np.cos(np.pi / 4)  # a camera measures along or about what it sees more of than it misses


def assign_axes(rotations: Mapping[int, Array]) -> dict[int, Array]:
    """What each camera's motion in its image is taken for, (6, 3) by camera number.

    rotations: base_from_camera (3, 3) of each camera that sees the surface, the top one first. A row set (6, 3) makes
    of (mm along image x, mm along image y, rad from x towards y) a turn, rad, and a move, mm, [rx ry rz tx ty tz] in
    base axes; what a rig moved is the sum over its cameras. A camera that measures nothing is left out.

    The world's axes are the cameras' own (thesis 4.2). The first camera is the top one and measures both moves in its
    image and the turn about its optical axis z. The bottom one is that which stands across it most nearly, 84 degrees
    in the thesis; its image's direction nearest to z, the image's y there, measures the move along z, and it measures
    the turn about the axis h that it looks along, taken as square to z. The side camera measures the turn about the
    third axis, cross(z, h).

    4.2, 4.6 and Appendix A assign the axes differently. The program's assignment is taken (X, Y and a turn from the
    top, Z and a turn from the bottom camera), which agrees with 4.2; 4.6 gives Y to the bottom camera, and names the
    turn about X twice. The side camera of 4.6 turns for cross(z, h) only where it looks along that more than across:
    at 36 degrees between the two others it does not see that turn at all, but four fifths of the one about z, which
    would be counted again. Then, as in the program, no camera measures it, and it is taken for none.
    """
    top, *others = rotations
    z = rotations[top][:, 2]
    shares = {top: _share(z, rotations[top][:, :2])}
    bottom = min(others, key=lambda c: abs(float(rotations[c][:, 2] @ z)), default=None)
    if bottom is None or abs(float(rotations[bottom][:, 2] @ z)) > ACROSS:
        return shares
    h = _unit(rotations[bottom][:, 2] - (rotations[bottom][:, 2] @ z) * z)
    up = _unit(rotations[bottom][:, :2].T @ z)  # (2,) in the bottom camera's image
    shares[bottom] = _share(h, np.outer(z, up))
    third = np.cross(z, h)
    seen = {c: float(rotations[c][:, 2] @ third) for c in others if c != bottom}
    side = max(seen, key=lambda c: abs(seen[c]), default=None)
    if side is not None and abs(seen[side]) >= ACROSS:
        shares[side] = _share(np.sign(seen[side]) * third, np.zeros((3, 2)))
    return shares


def _share(axis: Array, moves: Array) -> Array:
    """(6, 3) of the axis (3,) that is turned about and what the image's two axes move along (3, 2)."""
    share = np.zeros((6, 3))
    share[:3, 2], share[3:, :2] = axis, moves
    return share


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def unmeasured(shares: Mapping[int, Array]) -> str:
    """What no camera measures, in words; '' if nothing."""
    if len(shares) == 1:
        return "no camera stands across the first one: moves along its view, and two turns, are not measured"
    return "" if len(shares) == 3 else "no camera looks along the third axis: turns about it are not measured"
