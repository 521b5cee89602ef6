"""Synthetic worlds: the truth is exact, each condition is as strong as asked and touches nothing else."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.rig import ideal_pixels
from estimation.se3 import Array
from estimation.synthetic.movements import MOVEMENTS
from estimation.synthetic.world import BASE_FROM_REST, SURFACES, World, arc_rig, observations
from estimation.synthetic.world import synthetic_world as made

ROOT = Path(__file__).parents[1]
Worlds = Callable[..., World]


def off(world: World, late: Array | None = None) -> list[tuple[Observations, Array]]:
    """Each frame set with the distance (N, 2) px of its pixels from where the true cameras see the landmarks.

    late: (C,) s, by which the cameras' instants are later than the stamps.
    """
    instants = np.zeros(len(world.rig)) if late is None else late
    found = []
    for seen in world:
        right, _ = world.pixels_at(seen.stamp + instants)
        found.append((seen, seen.pixels - right[seen.camera, seen.track]))
    return found


def residuals(world: World, late: Array | None = None) -> Array:
    return np.concatenate([away for _, away in off(world, late)])


def test_the_fixture_makes_a_world_in_one_line(synthetic_world: Worlds) -> None:
    world = synthetic_world("breathing", noise=0.25, outliers=0.05, offsets=(0, 8e-3, -5e-3), seed=3)
    assert len(world) == len(world.truth) == len(list(world)) == 120
    assert np.array_equal(world.truth.stamps, [seen.stamp for seen in world])


def test_pytest_finds_the_plugin_by_its_entry_point(tmp_path: Path) -> None:
    points = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]["pytest11"]
    (name, module), *_ = points.items()
    code = "def test_mine(synthetic_world):\n    assert len(synthetic_world('still')) > 0\n"
    (tmp_path / "test_mine.py").write_text(code)
    command = [sys.executable, "-m", "pytest", "-q", "-p", module, "-p", "no:cacheprovider", str(tmp_path)]
    alone = {"PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=alone, capture_output=True, text=True)
    assert name == module and done.returncode == 0, done.stdout


def test_the_example_in_the_document_runs_as_it_stands(synthetic_world: Worlds) -> None:
    text = (ROOT / "docs" / "synthetic.md").read_text(encoding="utf-8")
    examples = re.findall(r"```python\n(.*?)```", text, re.S)
    assert examples
    for example in examples:
        names: dict[str, Any] = {}
        exec(example, names)
        tests = [value for name, value in names.items() if name.startswith("test_")]
        for test in tests:
            test(synthetic_world)
        assert tests


def test_the_document_names_every_condition_movement_and_surface() -> None:
    text = (ROOT / "docs" / "synthetic.md").read_text(encoding="utf-8")
    fields = made("still", seconds=0.1).conditions.__slots__
    assert [name for name in [*fields, *MOVEMENTS, *SURFACES] if f"`{name}`" not in text] == []


@pytest.mark.parametrize("movement", MOVEMENTS)
def test_a_movement_is_smooth_and_its_twist_carries_it_on(movement: str) -> None:
    world = made(movement, seconds=3.0, seed=4)
    times = np.arange(0.1, 2.9, 1e-3)
    poses, twists = world.base_from_surface(times), world.twists(times)
    carried = poses[:-1] @ se3.exp(0.5e-3 * (twists[:-1] + twists[1:]))
    assert np.abs(carried - poses[1:]).max() < 2e-4
    assert np.allclose(poses[0] @ se3.inverse(poses[0]), np.eye(4))


@pytest.mark.parametrize("movement", sorted(set(MOVEMENTS) - {"still"}))
def test_a_movement_moves_and_another_seed_moves_otherwise(movement: str) -> None:
    one, other = (made(movement, seconds=8.0, seed=seed).truth.base_from_surface for seed in (1, 2))
    assert np.abs(one - one[0]).max() > 0.05 and np.abs(one - other).max() > 0.01
    assert np.linalg.norm(one[:, :3, 3] - BASE_FROM_REST[:3, 3], axis=1).max() < 40.0


def test_breathing_is_as_deep_and_as_fast_as_it_is_said_to_be() -> None:
    world = made("breathing", seconds=60.0, seed=2)
    lift = se3.transform_points(se3.inverse(BASE_FROM_REST), world.truth.base_from_surface[:, :3, 3])[:, 2]
    speed = np.linalg.norm(world.twists(world.stamps)[:, 3:], axis=1)
    assert 9.0 < np.ptp(lift) < 12.5 and 8.0 < speed.max() < 16.0


def test_a_movement_may_be_any_function_of_time() -> None:
    world = made(lambda times: se3.exp(np.asarray(times)[..., None] * [0, 0, 0, 1.0, 0, 0]), seconds=1.0)
    assert np.allclose(world.twists(world.stamps)[:, 3:], [1.0, 0, 0], atol=1e-6)


@pytest.mark.parametrize("surface", SURFACES)
def test_landmarks_lie_where_their_normals_point_out_and_only_those_that_face_a_camera_are_seen(surface: str) -> None:
    world = made("turns", seconds=2.0, surface=surface, seed=1)
    assert np.allclose(np.linalg.norm(world.landmarks.normals, axis=1), 1)
    middle = world.landmarks.points.mean(0) - [0, 0, 20.0]
    assert (((world.landmarks.points - middle) * world.landmarks.normals).sum(1) > 0).all()
    for seen in list(world)[::20]:
        pose = world.base_from_surface(np.array(seen.stamp))
        points = se3.transform_points(pose, world.landmarks.points[seen.track])
        centres = np.stack([c.base_from_camera[:3, 3] for c in world.true_rig.cameras])[seen.camera]
        normals = world.landmarks.normals[seen.track] @ pose[:3, :3].T
        assert ((centres - points) * normals).sum(1).min() > 0


def test_two_iterations_give_the_same_bits_and_another_seed_others() -> None:
    conditions: dict[str, Any] = dict(outliers=0.1, dropouts=0.2, correlated=0.3, jitter=1e-3, churn=1.0)
    world = made("sway", seconds=1.0, seed=3, **conditions)
    other = made("sway", seconds=1.0, seed=4, **conditions)
    for a, b in zip(world, world, strict=True):
        assert a.pixels.tobytes() == b.pixels.tobytes() and np.array_equal(a.track, b.track)
    assert any(len(a) != len(b) for a, b in zip(world, other, strict=True))


@given(st.sampled_from([0.0, 0.1, 0.25, 1.0]), st.integers(0, 50))
@settings(max_examples=12)
def test_noise_is_white_and_as_strong_as_claimed(noise: float, seed: int) -> None:
    world = made("breathing", seconds=1.0, noise=noise, seed=seed)
    error = residuals(world)
    assert np.sqrt((error**2).mean()) == pytest.approx(noise, rel=0.03, abs=1e-9)
    assert abs(error.mean()) < 0.05 * noise + 1e-9
    assert all((seen.sigma == max(noise, 0.02)).all() for seen in world)


def test_a_condition_leaves_all_other_draws_alone() -> None:
    plain, troubled = made(seed=5, seconds=1.0), made(seed=5, seconds=1.0, outliers=0.1, dropouts=0.3)
    assert np.array_equal(plain.landmarks.points, troubled.landmarks.points)
    assert np.array_equal(plain.truth.base_from_surface, troubled.truth.base_from_surface)
    for a, b in zip(plain, troubled, strict=True):
        noise = {(c, t): tuple(p) for c, t, p in zip(a.camera, a.track, a.pixels, strict=True)}
        same = [noise[c, t] == tuple(p) for c, t, p in zip(b.camera, b.track, b.pixels, strict=True)]
        assert 0.8 < np.mean(same) < 0.97


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_so_many_observations_are_outliers(share: float) -> None:
    wrong = np.abs(residuals(made(seconds=2.0, outliers=share))).max(1) > 1.5
    assert wrong.mean() == pytest.approx(share, rel=0.1)  # a few stand near by chance


def test_coherent_tracks_stay_where_they_were_in_the_image() -> None:
    world = made("lively", seconds=2.0, coherent=0.3, noise=0.0)
    first, _ = world.pixels_at(np.zeros(3))
    moved = [(np.abs(away).max(1) > 1e-9, seen) for seen, away in off(world)][30]
    stuck, seen = moved
    assert stuck.mean() == pytest.approx(0.3, abs=0.06)
    assert np.allclose(seen.pixels[stuck], first[seen.camera[stuck], seen.track[stuck]])


def test_dropouts_take_their_share_in_spells_of_their_length() -> None:
    world = made("still", seconds=20.0, dropouts=0.2, dropout_seconds=0.4, seed=1)
    found = np.zeros((len(world), 3, 100), bool)
    for k, seen in enumerate(world):
        found[k, seen.camera, seen.track] = True
    assert found.mean() == pytest.approx(0.8, abs=0.02)
    ends = (~found[:-1] & found[1:]).sum()
    assert (~found).sum() / ends / 30 == pytest.approx(0.4, rel=0.1)


def test_an_outage_takes_one_camera_or_all_of_them() -> None:
    world = made("still", seconds=3.0, outages=((0.5, 1.0), (1.5, 2.0, 1)))
    for seen in world:
        cameras = set(seen.camera.tolist())
        expected = set() if 0.5 <= seen.stamp < 1.0 else {0, 2} if 1.5 <= seen.stamp < 2.0 else {0, 1, 2}
        assert cameras == expected


def test_each_landmark_is_found_by_no_more_cameras_than_asked() -> None:
    for seen in made("still", seconds=0.2, views=1):
        assert np.bincount(seen.track).max() == 1 and len(seen) == 100


def test_offsets_are_of_the_instants_and_not_of_the_stamps() -> None:
    offsets = np.array([0.0, 8e-3, -5e-3])
    world = made("lively", seconds=1.0, noise=0.0, offsets=tuple(offsets))
    assert np.abs(residuals(world)).max() > 0.2
    assert np.abs(residuals(world, offsets)).max() < 1e-9


def test_jitter_moves_each_camera_anew() -> None:
    world = made("lively", seconds=2.0, noise=0.0, jitter=3e-3)
    velocity = residuals(made("lively", seconds=2.0, noise=0.0, offsets=(1e-3,) * 3))
    assert np.sqrt((residuals(world) ** 2).mean() / (velocity**2).mean()) == pytest.approx(3.0, rel=0.2)


@pytest.mark.parametrize("rms", [0.1, 0.3, 1.0])
def test_the_rig_that_is_told_misses_by_as_much_as_asked(rms: float) -> None:
    world = made("still", calibration=rms, noise=0.0, seconds=0.1)
    for camera, told in enumerate(made("still", noise=0.0, seconds=0.1).pixels_at(np.zeros(3))[0]):
        away = world.pixels_at(np.zeros(3))[0][camera] - told
        assert np.sqrt((away**2).mean()) == pytest.approx(rms, rel=0.01)
    assert [c.name for c in world.rig.cameras] == [c.name for c in world.true_rig.cameras]


def test_the_map_is_off_by_as_much_as_its_covariance_says() -> None:
    world = made("still", map_error=0.2, count=400)
    assert np.std(world.map.points - world.landmarks.points) == pytest.approx(0.2, rel=0.06)
    assert np.allclose(world.map.covariance, 0.04 * np.eye(1200))
    assert np.array_equal(made("still").map.points, made("still").landmarks.points)


def test_a_correlated_error_stays_for_its_time_and_is_not_told() -> None:
    world = made("still", seconds=20.0, noise=0.0, correlated=0.5, correlated_seconds=1.0)
    error = np.stack([away for _, away in off(world)])  # (K, N, 2): all are seen
    assert error.std() == pytest.approx(0.5, rel=0.05)
    for seconds in (1.0, 2.0):
        k = round(30 * seconds)
        assert (error[:-k] * error[k:]).mean() / 0.25 == pytest.approx(np.exp(-seconds), abs=0.06)
    assert all((seen.sigma < 0.1).all() for seen in world)


def test_churn_replaces_landmarks_and_keeps_their_number() -> None:
    world = made("still", seconds=20.0, churn=2.0, count=50)
    tracks = [set(seen.track.tolist()) for seen in world]
    assert {len(t) for t in tracks} == {50}
    assert len(set.union(*tracks)) == pytest.approx(50 * (1 + 20 / 2), rel=0.15)
    assert len(tracks[0] & tracks[30]) == pytest.approx(50 * np.exp(-0.5), abs=9)


def test_a_part_comes_into_view() -> None:
    world = made("still", seconds=3.0, reveal=(1.0, 2.0))
    reach = [world.landmarks.points[seen.track, 0].max() for seen in world]
    assert max(reach[:30]) <= 0 < reach[45] < reach[-1] == world.landmarks.points[:, 0].max()
    assert np.all(np.diff(reach) >= 0)


@pytest.mark.parametrize(
    "wrong",
    [
        dict(movement="dance"), dict(surface="sphere"), dict(noise=-0.1), dict(outliers=1.1),
        dict(dropouts=float("nan")), dict(dropouts=0.1, dropout_seconds=0.0), dict(outages=((2.0, 1.0),)),
        dict(outages=((1.0, 2.0, 3),)), dict(seconds=0.0), dict(rate=float("nan")), dict(count=0), dict(views=0),
        dict(offsets=(0.0, 1e-3)), dict(churn=float("inf")),
    ],
)  # fmt: skip
def test_wrong_input_is_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"synthetic world: .* allowed"):
        made(**wrong)


def test_another_rig_may_watch() -> None:
    world = made("still", seconds=0.1, rig=arc_rig(angles_deg=(10.0, 50.0)))
    assert set(next(iter(world)).camera.tolist()) == {0, 1}


def test_one_look_has_the_noise_the_outliers_and_the_gaps_that_are_asked_for() -> None:
    rig, points, draw = arc_rig(), SURFACES["patch"](400, np.random.default_rng(1)).points, np.random.default_rng(2)
    visible = np.ones((3, 400), bool)
    visible[1, 5:] = False
    clean = observations(rig, points, BASE_FROM_REST, 0.5, draw, sigma=0.0, visible=visible)
    seen = observations(rig, points, BASE_FROM_REST, 0.5, draw, sigma=0.3, outliers=0.1, visible=visible)
    assert seen.stamp == 0.5 and (seen.sigma == 0.3).all()
    assert np.bincount(seen.camera).tolist() == [400, 5, 400] and set(seen.track[seen.camera == 1]) == set(range(5))
    for number, camera in enumerate(rig.cameras):
        ideal, _ = ideal_pixels(camera, se3.transform_points(BASE_FROM_REST, points))
        mine = clean.camera == number
        np.testing.assert_allclose(clean.pixels[mine], ideal[clean.track[mine]], atol=1e-9)
    error = seen.pixels - clean.pixels
    wrong = np.abs(error).max(1) > 1.8
    assert wrong.mean() == pytest.approx(0.1, abs=0.03) and error[~wrong].std() == pytest.approx(0.3, rel=0.06)
