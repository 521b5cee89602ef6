"""No-go zones: a tip on their surface passes, a hair inside is refused, and no step goes through one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.files.arm_file import read_arm, write_arm
from planning.command import Code, Move, Refusal
from planning.limits import Limits
from planning.motion.guard import Guard
from planning.no_go import NoGo, box, cylinder, half_space
from tests.test_guard import ARM, TICK, WIDE, axes, move, pose

BED = half_space("bed", np.array([0.0, 0, 2]), np.array([7.0, 7, -2]))
BLOCK = box("block", np.array([2.0, -1, -1]), np.array([4.0, 1, 1]))
POST = cylinder("post", np.array([0.0, 5, -10]), np.array([0.0, 5, 10]), 2.0)
FREE = replace(WIDE, speed=np.full(6, 1e9), zones=(BED, BLOCK, POST))


def judged(target: Array, begin: Array | None = None) -> Move | Refusal:
    guard = Guard(FREE, replace(ARM, home=np.zeros(6) if begin is None else begin), TICK)
    answer = guard(move(target), pose(1.0), 1.0)
    assert isinstance(answer, Move | Refusal)
    return answer


@pytest.mark.parametrize(
    ("surface", "inwards"),
    [(axes(0, 0, -2), axes(0, 0, -1)), (axes(2), axes(1)), (axes(0, 3), axes(0, 1))],
)
def test_the_surface_of_each_kind_of_zone_is_met_and_broken_by_a_hair(surface: Array, inwards: Array) -> None:
    assert isinstance(judged(surface), Move)
    answer = judged(np.where(inwards != 0, np.nextafter(surface, 100 * inwards), surface))
    assert isinstance(answer, Refusal) and answer.code is Code.NO_GO
    assert 0 < answer.got < 1e-12 and answer.limit == 0


def test_no_step_goes_through_a_zone_or_ends_behind_it() -> None:
    through = judged(axes(6))
    assert isinstance(through, Refusal) and through.code is Code.NO_GO and "'block'" in through.reason
    assert through.got == pytest.approx(1.0)
    assert isinstance(judged(axes(6, 3), axes(0, 1.5)), Move)
    assert isinstance(judged(axes(0, 8)), Refusal)
    assert isinstance(judged(axes(4, 8), axes(4, 2)), Move)
    assert isinstance(judged(axes(2, 8), axes(2, 2)), Move)  # along the post's surface


place = st.builds(lambda *xyz: np.array(xyz), *[st.floats(-6, 6)] * 3)


@settings(max_examples=60)
@given(place, place)
def test_a_straight_way_meets_a_zone_where_one_of_its_points_is_inside(start: Array, end: Array) -> None:
    for zone in (BED, BLOCK, POST):
        if zone.depth(start) > 0:
            continue
        depths = [zone.depth(start + share * (end - start)) for share in np.linspace(0, 1, 100)]
        if max(depths) > 1e-3:
            assert zone.met(start, end) > 0
        if max(depths) < -0.2:
            assert zone.met(start, end) == 0


def test_zones_come_back_from_a_file_and_home_must_be_outside(tmp_path: Path) -> None:
    file = tmp_path / "arm.toml"
    profile = ArmProfile(limits=Limits(zones=(BED, BLOCK, POST)))
    write_arm(file, profile)
    for a, b in zip(read_arm(file).limits.zones, profile.limits.zones, strict=True):
        assert a.name == b.name and a.radius == b.radius
        assert np.allclose(a.normals, b.normals) and np.allclose(a.offsets, b.offsets) and np.allclose(a.axis, b.axis)
    with pytest.raises(InputError, match="no-go zone 'all'"):
        ArmProfile(limits=Limits(zones=(half_space("all", np.array([0.0, 0, 1]), np.array([0.0, 0, 1000])),)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("box = [[0, 0, 0], [1, 1, 1]]", "no_go.name"),
        ('name = "x"', "half_space, box, or cylinder"),
        ('name = "x"\nbox = [[0, 0, 0], [1, 1, 1]]\nradius = 3', "cylinder with radius"),
        ('name = "x"\ncylinder = [[0, 0, 0], [1, 1, 1]]', "cylinder with radius"),
        ('name = "x"\nbox = [[0, 0, 2], [1, 1, 1]]', "low corner"),
        ('name = "x"\nbox = [[0, 0, nan], [1, 1, 1]]', "no_go.box"),
        ('name = "x"\nhalf_space = [[0, 0, 0], [1, 1, 1]]', "not zero"),
        ('name = "x"\ncylinder = [[1, 1, 1], [1, 1, 1]]\nradius = 3', "two ends apart"),
        ('name = "x"\ncylinder = [[0, 0, 0], [1, 1, 1]]\nradius = 0', "radius > 0"),
        ('name = "x"\nboxx = 3', "no_go.boxx"),
    ],
)
def test_a_zone_that_makes_no_sense_is_refused_by_its_key(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "arm.toml"
    file.write_text(f"[[no_go]]\n{text}\n", encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_arm(file)
    assert words in str(caught.value)


def test_a_zone_of_wrong_shapes_is_refused() -> None:
    with pytest.raises(InputError, match="normals"):
        NoGo("x", np.zeros((2, 3)), np.zeros(3))
    with pytest.raises(InputError, match="unit normals"):
        NoGo("x", np.ones((1, 3)), np.zeros(1))
