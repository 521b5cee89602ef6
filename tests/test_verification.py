"""The verification of poses: a surface's own aliases compete, and the skin's grain must follow the tracks."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.lens import Lenses
from perception.mapping.aliases import (
    Aliases,
    SurfaceGrid,
    TangentPlane,
    find_aliases,
    self_correlation,
    surface_picture,
)
from perception.mapping.masks import TrackingMasks
from perception.mapping.matcher import Matcher
from perception.mapping.patches import Pyramid, cut_templates
from perception.mapping.verification import MAX_TISSUE_SPEED, Verification, _grain_left
from tests.slow_cases import slowly

SIDE_MM, TEXEL_MM = 160.0, 0.2
TEXELS = int(SIDE_MM / TEXEL_MM)
FRAME_S = 1 / 30


@cache
def rig() -> Rig:
    """Three cameras, a foot and more above a plane z = 0."""
    matrix = np.array([[800.0, 0, 320], [0, 800.0, 240], [0, 0, 1]])
    eyes = np.array([[-130.0, 0, 330], [130.0, 20, 330], [0, 150.0, 330]])
    return Rig(tuple(Camera(f"c{i}", (640, 480), matrix, np.zeros(5), looking(eye), 0.0) for i, eye in enumerate(eyes)))


def looking(eye: Array) -> Array:
    """base_from_camera (4, 4) of a camera at `eye` (3,) that looks at the origin."""
    ahead = -eye / np.linalg.norm(eye)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    return se3.make(np.stack([right, np.cross(ahead, right), ahead], -1), eye)


def places() -> tuple[Array, Array]:
    """x and y, mm, of the texture's cells."""
    middle = (np.arange(TEXELS) - TEXELS / 2 + 0.5) * TEXEL_MM
    x, y = np.meshgrid(middle, middle)
    return x, y


def skin(seed: int, strength: float = 1.0) -> Array:
    draw, out = np.random.default_rng(seed), np.full((TEXELS, TEXELS), 130.0)
    for size, depth in ((20.0, 8.0), (8.0, 8.0), (3.0, 9.0), (1.2, 8.0)):
        cells = draw.normal(size=(int(SIDE_MM / size),) * 2)
        out += strength * depth * cv2.resize(cells, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC)
    return out


def board(square: float) -> Array:
    x, y = places()
    return np.where((np.floor(x / square) + np.floor(y / square)) % 2 == 0, 180.0, 80.0)


def marked(texture: Array) -> Array:
    x, y = places()
    for u, v in ((-20.0, 11.0), (17.0, 23.0), (8.0, -26.0)):
        texture = np.where((x - u) ** 2 + (y - v) ** 2 < 9.0, 40.0, texture)
    return texture


def pictures(texture: Array, pose: Array, seed: int = 0) -> dict[int, Pyramid]:
    """What the cameras see of a plane with this texture at a pose (4, 4)."""
    draw, out = np.random.default_rng(seed), dict[int, Pyramid]()
    for c, camera in enumerate(rig().cameras):
        image = seen(camera, texture, pose)
        out[c] = Pyramid(np.clip(image + draw.normal(0, 2.0, image.shape), 0, 255).astype(np.uint8))
    return out


def seen(camera: Camera, texture: Array, pose: Array) -> Array:
    there = se3.inverse(camera.base_from_camera) @ pose
    flat = camera.matrix @ np.stack([there[:3, 0], there[:3, 1], there[:3, 3]], 1)
    start = -SIDE_MM / 2 + TEXEL_MM / 2
    scale = np.array([[TEXEL_MM, 0, start], [0, TEXEL_MM, start], [0, 0, 1]])
    image = cv2.warpPerspective(texture.astype(np.float32), flat @ scale, camera.size, borderValue=(110,))
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7), float)


@cache
def flat_map(reach: float = 45.0) -> SurfaceMap:
    points = np.c_[np.random.default_rng(5).uniform(-reach, reach, (240, 2)), np.zeros(240)]
    return SurfaceMap(points, np.tile([0.0, 0.0, 1.0], (240, 1)), np.zeros((720, 720)))


def shifted(x: float, y: float) -> Array:
    return se3.make(np.eye(3), np.array([x, y, 0.0]))


def poses(pose: Array) -> dict[int, Array]:
    return dict.fromkeys(range(3), pose)


def learned(texture: Array) -> Verification:
    lenses = Lenses(rig())
    verification = Verification(lenses, TrackingMasks(lenses))
    verification.begin(0.0, pictures(texture, np.eye(4)), poses(np.eye(4)), flat_map())
    return verification


def aliases(texture: Array) -> Aliases:
    grid = SurfaceGrid(TangentPlane(flat_map()))
    picture, inside = surface_picture(Lenses(rig()), 0, pictures(texture, np.eye(4))[0], np.eye(4), grid)
    return find_aliases(picture, inside, grid)


# -- the aliases


@settings(max_examples=20)
@given(st.integers(0, 10**6))
def test_the_correlation_is_that_of_what_is_seen_in_both(seed: int) -> None:
    draw = np.random.default_rng(seed)
    inside = draw.random((9, 7)) < 0.9
    picture = np.where(inside, draw.normal(size=inside.shape), 0.0)
    found, overlap = self_correlation(picture, inside)
    for v, u in ((0, 0), (2, 1), (-3, 2), (1, -2)):
        rows, columns = slice(max(0, v), 9 + min(0, v)), slice(max(0, u), 7 + min(0, u))
        back = slice(max(0, -v), 9 - max(0, v)), slice(max(0, -u), 7 - max(0, u))
        both = inside[rows, columns] & inside[back]
        expected = np.corrcoef(picture[rows, columns][both], picture[back][both])[0, 1]
        assert found[8 + v, 6 + u] == pytest.approx(expected, abs=1e-6)
        assert overlap[8 + v, 6 + u] == pytest.approx(both.sum() / inside.sum(), abs=1e-9)


@pytest.mark.parametrize("square", [8.0, 12.0, 20.0])
def test_a_board_repeats_by_its_squares(square: float) -> None:
    shifts = aliases(board(square)).motions[:8, :3, 3]
    assert np.linalg.norm(shifts[:4], axis=1) == pytest.approx(np.full(4, np.sqrt(2) * square), abs=0.35)
    off = np.abs(shifts[:, :2] / square - np.round(shifts[:, :2] / square)) * square
    assert off.max() < 0.5  # mm: each is a whole number of squares


@pytest.mark.parametrize("seed", [0, 1, *slowly(2, 3, 4, 5)])
@pytest.mark.parametrize("strength", [0.4, 1.0])
def test_skin_repeats_nowhere(seed: int, strength: float) -> None:
    assert not len(aliases(skin(seed, strength)))


@pytest.mark.parametrize("square", [8.0, 12.0])
def test_a_board_looks_like_itself_turned_by_quarters(square: float) -> None:
    """Each motion puts every square on one of its own colour."""
    found, texture = aliases(board(square)), lambda at: np.floor(at / square).sum(1) % 2
    turned = found.motions[np.abs(found.motions[:, 0, 0] - 1) > 0.5]
    quarters = np.round(np.degrees(np.arctan2(turned[:, 1, 0], turned[:, 0, 0])) / 90) % 4
    assert set(quarters) == {1, 2, 3} and np.abs(turned[:, 2, :2]).max() < 1e-9
    places = (np.stack(np.meshgrid(np.arange(-4, 4), np.arange(-4, 4)), -1).reshape(-1, 2) + 0.5) * square
    for motion in turned:
        assert (texture(places) == texture((places @ motion[:2, :2].T) + motion[:2, 3])).all()


def test_a_board_that_was_turned_while_it_was_hidden_is_doubted() -> None:
    looks = pictures(board(12.0), np.eye(4), 1)

    def turned(gap: float) -> int:
        alive = learned(board(12.0))(gap, looks, poses(np.eye(4))).motions
        return int((np.abs(alive[:, 0, 0] - 1) > 0.5).sum())

    assert turned(2.0) > turned(1.0) >= 2 and not turned(0.5)


def test_a_faint_pattern_over_skin_repeats_too() -> None:
    found = aliases(skin(4, 0.8) + 0.3 * (board(10.0) - 130.0))
    assert found.sizes.min() == pytest.approx(np.sqrt(200.0), abs=0.4)


def test_the_operator_is_told_of_a_surface_that_repeats_and_has_no_marks() -> None:
    plain, own, none = learned(skin(1)), learned(marked(board(12.0))), learned(board(12.0))
    assert plain.message == "" and "repeats every 16.9 mm; its own marks tell" in own.message
    assert "repeats every 16.9 mm" in none.message and "hardly a mark" in none.message
    for verification in (own, none):
        verification.confirm(1.1, poses(np.eye(4)))
    assert not own.message and none.message


# -- the verdict on a pose


@pytest.mark.parametrize("jump", [(12.0, 12.0), *slowly((24.0, 0.0), (-12.0, 36.0))])
def test_marks_of_its_own_tell_a_board_that_jumped(jump: tuple[float, float]) -> None:
    x, y = jump
    texture = marked(board(12.0))
    verdict = learned(texture)(FRAME_S, pictures(texture, shifted(x, y), 1), poses(np.eye(4)))
    assert verdict.rivals and verdict.motions[0, :3, 3] == pytest.approx([x, y, 0.0], abs=0.5)
    right = learned(texture)(FRAME_S, pictures(texture, shifted(x, y), 1), poses(shifted(x, y)))
    assert right.likeness > verdict.likeness + 0.02 and not len(right.motions)


def test_where_the_marks_are_hidden_nothing_is_sure() -> None:
    texture, verification = marked(board(12.0)), learned(marked(board(12.0)))
    looks = pictures(board(12.0), np.eye(4), 1)  # as if each mark were covered by its surroundings
    reach = 12.0 * np.sqrt(2) / MAX_TISSUE_SPEED
    assert not len(learned(board(12.0))(0.9 * reach, looks, poses(np.eye(4))).motions)  # too far for the tissue
    sizes = learned(board(12.0))(1.1 * reach, looks, poses(np.eye(4))).sizes
    assert sizes.min() == pytest.approx(12.0 * np.sqrt(2), abs=0.4)
    assert not len(verification(0.001, pictures(texture, np.eye(4), 2), poses(np.eye(4))).motions)


def test_a_sure_pose_rules_out_what_is_too_far_from_it() -> None:
    verification, looks = learned(board(12.0)), pictures(board(12.0), np.eye(4), 1)
    assert len(verification(1.0, looks, poses(np.eye(4))).motions)
    verification.confirm(1.0, poses(np.eye(4)))
    assert not len(verification(1.0 + FRAME_S, looks, poses(np.eye(4))).motions)


def test_ordinary_skin_is_sure_without_a_look() -> None:
    verification = learned(skin(1))
    assert not len(verification(9.0, {}, poses(shifted(50.0, 0.0))).motions)


# -- grain


@cache
def matcher() -> Matcher:
    """Of landmarks cut from the first camera's picture of a skin."""
    lenses, surface_map = Lenses(rig()), flat_map()
    templates = cut_templates(
        lenses, pictures(skin(1), np.eye(4))[0], 0, np.eye(4), surface_map.points, surface_map.normals
    )
    return Matcher(lenses, surface_map, templates)


def missed(texture: Array, light: Array | float = 1.0) -> tuple[int, int]:
    """How many landmarks the first camera finds in a picture of a skin under a light, and how many it misses."""
    looks = {0: pictures(texture * light, np.eye(4), 1)[0]}
    seen = matcher().align(0.0, looks, {0: np.eye(4)})
    return len(seen), len(seen.missed.track)


def test_a_shadow_hides_no_landmark_but_another_skin_does() -> None:
    x, _ = places()
    soft = 1 - 0.7 / (1 + np.exp(-5 * np.sin(x / 3.0)))  # edges some millimetres wide, everywhere
    plain, shadowed, other = missed(skin(1)), missed(skin(1), soft), missed(skin(7))
    assert plain[1] == 0 and plain[0] > 200
    assert shadowed[0] < 0.6 * plain[0] and shadowed[1] < 0.1 * plain[0]  # not found, and yet not missed
    assert other[1] > 0.9 * plain[0]


def usual_of(grain: Array, noise: float, gain: float = 1.0) -> Array:
    """(N, 3) of patches whose grain is (N,) long, with noise of that length, under a light."""
    energy = grain**2 + noise**2
    return np.stack([gain * grain, gain**2 * energy, gain * np.full_like(grain, 20.0)], -1)


@given(st.floats(0.3, 3.0), st.floats(0.1, 1.0), st.floats(0.0, 20.0))
def test_the_grain_that_is_left_is_free_of_the_light_on_it(gain: float, share: float, noise: float) -> None:
    grain = np.random.default_rng(1).uniform(10.0, 40.0, 30)
    usual = usual_of(grain, noise)
    repeats = usual[:, 0] ** 2 / usual[:, 1]
    dimmed = _grain_left(usual, usual_of(grain, noise, gain), repeats)
    assert dimmed == pytest.approx((1.0, 0.0), abs=1e-9)
    blurred = usual.copy()
    blurred[:, 0], blurred[:, 1] = share * grain, (share * grain) ** 2 + noise**2
    assert _grain_left(usual, blurred, repeats) == pytest.approx((share, 0.0), abs=1e-9)
    replaced = usual.copy()
    replaced[:, 0] = share * grain  # as much of it as ever, but of another surface
    assert _grain_left(usual, replaced, repeats) == pytest.approx((share, 1 - share**2), abs=1e-9)


def test_landmarks_on_one_line_are_no_surface_that_could_repeat() -> None:
    line = SurfaceMap(np.c_[np.arange(240.0) / 6, np.zeros((240, 2))], flat_map().normals, np.zeros((720, 720)))
    lenses = Lenses(rig())
    verification = Verification(lenses, TrackingMasks(lenses))
    verification.begin(0.0, pictures(board(12.0), np.eye(4)), poses(np.eye(4)), line)
    assert not len(verification.aliases)
