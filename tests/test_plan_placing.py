"""A plan that lies where the wound is seen is said to; one that lies beside it is off by as much as it is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.plan.placing import FAR, Placing, Sight, _sight
from perception.lens import Lenses

AROUND = np.linspace(0, 2 * np.pi, 200, endpoint=False)
OUTLINE = np.column_stack([20 * np.cos(AROUND), 14 * np.sin(AROUND) + 2 * np.cos(2 * AROUND), 0 * AROUND])


def seen(camera: int, outline: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """The mask of an outline (N, 3), surface frame, as a camera images it."""
    rig = arc_rig()
    inner = se3.transform_points(se3.inverse(rig.cameras[camera].base_from_camera) @ REST, outline)
    ideal = inner[:, :2] / inner[:, 2:] * rig.cameras[camera].matrix[[0, 1], [0, 1]] + rig.cameras[camera].matrix[:2, 2]
    pixels, _ = Lenses(rig).image(camera, ideal, inner[:, 2])
    mask = np.zeros(rig.cameras[camera].size[::-1], np.uint8)
    return cv2.fillPoly(mask, [np.rint(pixels).astype(np.int32)], 1).astype(bool)


@pytest.mark.parametrize("camera", range(3))
def test_a_plan_on_the_wound_is_near_its_middle(camera: int) -> None:
    found = _sight(arc_rig().cameras[camera], seen(camera, OUTLINE), REST, OUTLINE)
    assert found.off < 0.5 and found.share > 0.9


@given(st.floats(4, 15), st.floats(0, 2 * np.pi))
@settings(max_examples=10, deadline=None)
def test_a_plan_beside_the_wound_is_off_by_as_much(away: float, angle: float) -> None:
    moved = OUTLINE + away * np.array([np.cos(angle), np.sin(angle), 0.0])
    offs = [_sight(arc_rig().cameras[c], seen(c, OUTLINE), REST, moved).off for c in range(3)]
    assert 0.85 * away < max(offs) < 1.15 * away + 0.5
    lines = Placing(np.eye(4), "TRACKING", (Sight("top", max(offs), 1.0),)).lines()
    assert (f"more than {FAR:g} mm" in lines[1]) == (max(offs) > FAR)


def test_a_camera_that_shows_no_wound_says_so() -> None:
    nothing = np.zeros(arc_rig().cameras[0].size[::-1], bool)
    found = _sight(arc_rig().cameras[0], nothing, REST, OUTLINE)
    assert "no wound" in Placing(np.eye(4), "TRACKING", (found,)).lines()[1]
