"""Following a synthetic world: the truth is carried into the estimated frame at the start, and the map is honest."""

from __future__ import annotations

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.state_machine import StateSettings
from estimation.synthetic.follow import Follower, Mapping, beginning, follow
from estimation.synthetic.world import World, synthetic_world
from estimation.triangulated import triangulated
from hardware.bench.pooled import pooled
from tests.slowly import slowly


def first(world: World) -> Observations:
    return next(iter(world))


def test_a_triangulated_map_is_as_far_off_as_its_covariance_says() -> None:
    values = []
    for seed in range(12):
        world = synthetic_world("still", seconds=0.05, noise=0.3, seed=seed)
        made = triangulated(world.rig, first(world))
        true_from_map = se3.inverse(world.truth.base_from_surface[0]) @ made.base_from_surface
        points = se3.transform_points(true_from_map, made.map.points)
        off = (points - world.landmarks.points[made.tracks]) @ true_from_map[:3, :3]
        blocks = made.map.covariance.reshape(len(points), 3, len(points), 3)
        own = np.stack([blocks[i, :, i] for i in range(len(points))])
        values.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(own), off).mean() / 3)
        assert made.map.normals[:, 2].min() > 0
    assert np.mean(values) == pytest.approx(1.0, abs=0.08)


def test_landmarks_of_one_camera_and_wrong_matches_are_not_in_the_map() -> None:
    world = synthetic_world("still", seconds=0.05, outliers=0.1, views=2, seed=3)
    seen = first(world)
    alone = np.bincount(seen.track, minlength=100) < 2
    made = triangulated(world.rig, seen)
    assert not alone[made.tracks].any() and 50 < len(made.tracks) < 95
    true_from_map = se3.inverse(world.truth.base_from_surface[0]) @ made.base_from_surface
    off = se3.transform_points(true_from_map, made.map.points) - world.landmarks.points[made.tracks]
    assert np.median(np.linalg.norm(off, axis=1)) < 0.3


def test_errors_are_of_the_estimated_frame_and_nothing_is_fitted() -> None:
    world = synthetic_world("breathing", seconds=0.5, noise=0.02)
    for mapping in ("told", "seen"):
        run = follow(world, mapping)
        after_the_first = len(world) - 1 - StateSettings().first
        assert len(run.poses) == after_the_first == len(run.expected) == len(run.seconds)
        assert np.abs(run.errors[:, 3:]).max() < 0.01
        assert np.abs(run.twist_errors[3:, 3:]).max() < 4.0


def test_observations_are_numbered_by_the_map() -> None:
    world = synthetic_world("still", seconds=0.1, count=40, views=2)
    seen = first(world)
    start = beginning(world, seen, "seen")
    follower = Follower(world.rig, seen, start, refine=True)
    of_map = follower.of_map(seen)
    assert set(start.tracks[of_map.track]) == set(seen.track) & set(start.tracks)
    for camera, row, pixel in zip(of_map.camera, of_map.track, of_map.pixels, strict=True):
        where = (seen.camera == camera) & (seen.track == start.tracks[row])
        assert np.array_equal(seen.pixels[where][0], pixel)


def test_pooled_figures_are_those_of_all_poses_together() -> None:
    runs = [follow(synthetic_world("breathing", seconds=0.6, count=40, seed=seed)) for seed in range(2)]
    one, two, both = pooled(runs[:1]), pooled(runs[1:]), pooled(runs)
    assert both.error_mm**2 == pytest.approx((one.error_mm**2 + two.error_mm**2) / 2)
    assert both.bound_mm**2 == pytest.approx((one.bound_mm**2 + two.bound_mm**2) / 2)
    assert both.nees == pytest.approx((one.nees + two.nees) / 2)
    assert 0.5 < both.error_mm / both.bound_mm < 1.5 and both.measured == 1.0


@pytest.mark.parametrize("mapping", ["seen", *slowly("told")])
def test_the_bound_of_an_estimated_frame_holds_the_error_of_the_look_that_laid_it(mapping: Mapping) -> None:
    """Over many starts, since that error is one draw for a whole run."""
    worlds = [synthetic_world("still", seconds=0.3, count=40, seed=seed) for seed in range(30)]
    runs = [follow(world, mapping) for world in worlds]
    found = pooled(runs)
    assert 0.85 < found.error_mm / found.bound_mm < 1.3
    assert found.filtered_mm <= found.bound_mm and found.filtered_deg <= found.bound_deg
    assert all(np.isfinite(run.bounds).all() for run in runs)


def test_where_nothing_is_seen_nothing_is_known() -> None:
    run = follow(synthetic_world("still", seconds=0.5, outages=((0.2, 0.3),)))
    assert np.array_equal(np.isinf(run.bounds).all(axis=(1, 2)), ~run.measured)
    assert np.isfinite(run.filtered_bounds()).all()


@pytest.mark.parametrize("mapping", ["told", "seen"])
def test_a_world_too_short_to_be_judged_says_so(mapping: Mapping) -> None:
    with pytest.raises(InputError, match="length = '6 frame sets', allowed 7 or more"):
        follow(synthetic_world(seconds=6 / 30), mapping)
    judged = follow(synthetic_world(seconds=7 / 30), mapping)
    assert len(judged.poses) == 2 and judged.filtered_bounds().shape == (2, 6, 6)
