"""Calibration from corners: derivatives, synthetic truth, honest uncertainties, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.calibration.camera_rig import Calibration, calibrate, fit_lenses, rebase
from estimation.calibration.lens_fit import fit_lens, homography
from estimation.calibration.lens_model import (
    BoardViews,
    Implausible,
    KnownLenses,
    Undetermined,
    check_lens,
    check_neighbours,
    lens_parameters,
    project_lens,
)
from estimation.calibration.rig_fit import RigState, fit_rig, free_numbers, interpolate_board, stencils
from estimation.calibration.validation import choose_model, volume_error
from estimation.rig import Rig, pixels_from_points
from estimation.se3 import Array
from tests.boards import LENSES, MODELS, SIZE, Truth, corners, places, waved

TOP = [2155.93, 2125.24, 749.77, 318.26, -1.5, -0.65, 0.05, -0.02, 13.77]  # thesis Table 4.1
SIDE = [980.82, 1002.93, 601.57, 445.87, -0.08, -1.31, -0.04, 0.03, 1.53]
BOTTOM = [5258.69, 5800.13, 703.83, 302.84, -10.81, 114.43, 0.13, 0.05, 5751.0]

tangents = st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6).map(np.array)


@pytest.fixture(scope="module")
def known() -> tuple[Calibration, Truth]:
    views, truth = waved(np.random.default_rng(3))
    return calibrate(views), truth


def errors(found: Calibration, truth: Truth) -> Array:
    """(C, 16): what has to be added to the estimate, in the estimate's own tangent space."""
    state = found.fit.state
    place = se3.log(se3.inverse(state.base_from_camera) @ truth.base_from_camera)
    offset = truth.offset - state.offset
    return np.concatenate([truth.lens - state.lens, place, offset[:, None]], 1)


def nees(error: Array, covariance: Array) -> float:
    """Per degree of freedom; the last offset follows from the others."""
    free = np.flatnonzero(np.diag(covariance) > 0)[:-1]
    e = error.ravel()[free]
    return float(e @ np.linalg.solve(covariance[np.ix_(free, free)], e)) / len(free)


@given(tangents, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_pixels_are_those_of_the_rig_and_their_derivatives_are_differences(xi: Array, x: float, y: float) -> None:
    point = np.array([x, y, 1.0]) * 700
    found, by_lens, by_point = project_lens(LENSES[0], point)
    camera = Rig((camera_of(LENSES[0]),)).cameras[0]
    assert np.allclose(found, pixels_from_points(camera, point[None])[0][0])
    assert np.allclose(lens_parameters(camera), LENSES[0])
    for k, step in enumerate([1e-3] * 4 + [1e-6] * 5):
        change = (project_lens(LENSES[0] + np.eye(9)[k] * step, point)[0] - found) / step
        assert np.allclose(change, by_lens[:, k], rtol=1e-4, atol=1e-4 * abs(by_lens).max())
    for k in range(3):
        change = (project_lens(LENSES[0], point + np.eye(3)[k] * 1e-3)[0] - found) / 1e-3
        assert np.allclose(change, by_point[:, k], atol=1e-4)


def camera_of(lens: Array):
    from estimation.calibration.lens_model import lens_matrix
    from estimation.rig import Camera

    return Camera("a", SIZE, lens_matrix(lens), np.array(lens[4:]), np.eye(4))


@given(st.lists(st.floats(-1, 1), min_size=8, max_size=8))
def test_a_homography_carries_the_points_it_was_made_of(numbers: list[float]) -> None:
    made = np.eye(3) + 0.2 * np.append(numbers, 0).reshape(3, 3) * [[1, 1, 100], [1, 1, 100], [1e-3, 1e-3, 1]]
    plane = corners()[:, :2]
    there = np.c_[plane, np.ones(12)] @ made.T
    found = homography(plane, there[:, :2] / there[:, 2:])
    again = np.c_[plane, np.ones(12)] @ found.T
    assert np.allclose(again[:, :2] / again[:, 2:], there[:, :2] / there[:, 2:], atol=1e-6)


def moving(stamps: Array) -> Array:
    """A motion with a constant twist and one that turns back."""
    way = np.stack([0.2 * stamps, 0.1 * np.sin(stamps), 0.3 * stamps, 40 * np.sin(stamps), 9 * stamps, 5 * stamps], 1)
    return se3.exp(way)


@given(st.floats(-0.06, 0.06))
@settings(max_examples=20)
def test_a_smooth_motion_is_found_between_its_poses(delay: float) -> None:
    stamps = np.arange(9) / 8
    inner = np.arange(2, 7)
    found = interpolate_board(moving(stamps), stencils(stamps), inner, np.full(5, delay)).pose
    assert np.abs(se3.log(se3.inverse(found) @ moving(stamps[inner] + delay))[:, 3:]).max() < 5e-3


def test_the_motions_derivatives_are_differences() -> None:
    stamps, delay = np.array([0.0, 0.1, 0.22, 0.3, 0.9, 1.0]), np.array([0.03, -0.02, 0.04, 0.01])
    poses, who, instant = moving(stamps), stencils(stamps), np.array([0, 1, 2, 5])
    at = interpolate_board(poses, who, instant, delay)
    ahead = interpolate_board(poses, who, instant, delay + 1e-6).pose
    assert np.allclose(se3.log(se3.inverse(at.pose) @ ahead) / 1e-6, at.by_delay, atol=1e-3)
    for s in range(len(stamps)):
        for k in range(6):
            pushed = poses.copy()
            pushed[s] = pushed[s] @ se3.exp(1e-5 * np.eye(6)[k])
            change = se3.log(se3.inverse(at.pose) @ interpolate_board(pushed, who, instant, delay).pose) / 1e-5
            for v, i in enumerate(instant):
                columns = [0] * int(i == s) + [1 + j for j in np.flatnonzero((who.neighbours[i] == s) & (s != i))]
                expected = sum((at.by_pose[v, :, 6 * c + k] for c in columns), np.zeros(6))
                assert np.allclose(change[v], expected, atol=2e-3)


def test_an_instant_without_neighbours_is_taken_to_rest() -> None:
    who = stencils(np.array([0.0, 2.0, 4.0]))
    assert not np.isfinite(who.times).any()
    poses = moving(np.array([0.0, 2.0, 4.0]))
    assert np.array_equal(interpolate_board(poses, who, np.arange(3), np.full(3, 0.05)).pose, poses)


def test_exact_corners_give_the_exact_rig() -> None:
    views, truth = waved(np.random.default_rng(1), noise=1e-6, offsets=(0.0, 0.0, 0.0))
    fits = [fit_lens(views.select(views.camera == c), MODELS[c]) for c in range(3)]
    assert np.abs(np.stack([f.lens for f in fits]) - truth.lens).max() < 1e-3


def test_offsets_are_found_to_a_millisecond_and_lenses_to_a_percent(known: tuple[Calibration, Truth]) -> None:
    found, truth = known
    error = errors(found, truth)
    assert np.abs(error[:, 15]).max() < 1e-3 and np.abs(error[:, 0] / truth.lens[:, 0]).max() < 0.01
    assert found.jitter == 0.0 and abs(found.fit.state.offset.sum()) < 1e-6


@pytest.mark.parametrize(
    ("runs", "low", "high"), [(5, 0.65, 1.4), pytest.param(50, 0.88, 1.12, marks=pytest.mark.slow)]
)
def test_what_is_stated_to_be_uncertain_is_so(runs: int, low: float, high: float) -> None:
    values = []
    for seed in range(runs):
        views, truth = waved(np.random.default_rng([seed, 5]), instants=30)
        state = RigState(truth.lens, truth.base_from_camera, np.zeros(3), np.zeros(len(views)), _boards(views, truth))
        fit = fit_rig(views, state, free_numbers(MODELS), 0.0)
        found = Calibration(Rig(()), fit, views, MODELS, (), 0.0, 0, fit.residuals)
        values.append(nees(errors(found, truth), fit.covariance))
    # the mean of 50 chi-squares of 29 degrees each, divided by 29, is 1 +- 0.037; of 5, 1 +- 0.12
    assert low < np.mean(values) < high


def _boards(views: BoardViews, truth: Truth) -> Array:
    first = [np.flatnonzero(views.instant == i)[0] for i in range(views.instant.max() + 1)]
    fits = [fit_lens(views.select(views.camera == c), MODELS[c]) for c in range(3)]
    poses = np.zeros((len(views), 4, 4))
    for c, fit in enumerate(fits):
        poses[views.camera == c] = fit.camera_from_board
    return np.asarray(truth.base_from_camera[views.camera[first]] @ poses[first])


@pytest.mark.slow
def test_pictures_that_are_late_each_for_itself_are_noticed_and_forgiven() -> None:
    views, truth = waved(np.random.default_rng(3), jitter=0.006)
    found = calibrate(views)
    assert 0.003 < found.jitter < 0.008 and found.fit.scale < 1.1
    assert nees(errors(found, truth), found.fit.covariance) < 2


@pytest.mark.slow
def test_lenses_that_bend_in_ways_too_slight_to_be_told_are_doubted() -> None:
    bent = LENSES.copy()
    bent[:, 6:] = 1.5e-3, -1.5e-3, 0.03
    views, truth = waved(np.random.default_rng(3), lenses=bent)
    found = calibrate(views)
    choices = fit_lenses(views)[1]
    assert all(0 <= choice.probability <= 1 for choice in choices)
    assert [c.rival for c in choices] == ["" if m == "k1 k2 p1 p2 k3" else "k1 k2 p1 p2 k3" for m in found.models]
    plain = fit_rig(found.views, found.fit.state, free_numbers(found.models), 0.0)
    gained = found.fit.covariance - plain.covariance
    assert np.linalg.eigvalsh(gained).min() > -1e-7
    error = errors(found, truth)
    assert nees(error, found.fit.covariance) < 2 and nees(error, plain.covariance) > 4


def test_lenses_that_are_kept_bring_their_doubt_along() -> None:
    views, truth = waved(np.random.default_rng(3))
    rng = np.random.default_rng(4)
    sigma = np.tile([6.0, 6.0, 6.0, 6.0, 0.01, 0.01, 0.0, 0.0, 0.0], (3, 1))
    given = truth.lens + sigma * rng.normal(size=(3, 9))
    doubted = calibrate(views, known=KnownLenses(given, sigma))
    assert not np.array_equal(doubted.fit.state.lens, given)
    assert (np.sqrt(np.diag(doubted.covariance_of(1)))[:6] < sigma[1, :6]).all()
    assert nees(errors(doubted, truth), doubted.fit.covariance) < 2


@pytest.mark.slow
def test_lenses_that_are_kept_as_exact_are_doubted_as_far_as_the_views_speak_against_them() -> None:
    views, truth = waved(np.random.default_rng(3))
    nothing, wrong = np.zeros((3, 9)), truth.lens + [8.0, 8.0, -12.0, 12.0, 0, 0, 0, 0, 0]
    right, off = (calibrate(views, known=KnownLenses(lens, nothing)) for lens in (truth.lens, wrong))
    assert np.array_equal(right.fit.state.lens, truth.lens) and np.array_equal(off.fit.state.lens, wrong)
    far = np.linalg.norm(errors(off, truth)[1:, 12:], axis=1)
    claimed, unsure = (np.sqrt([np.trace(f.covariance_of(c)[12:15, 12:15]) for c in (1, 2)]) for f in (right, off))
    assert (unsure > 3 * claimed).all() and (unsure > far / 3).all()


def test_stretches_that_were_held_out_are_imaged_as_well_as_the_rest(known: tuple[Calibration, Truth]) -> None:
    found, _ = known
    seen, held = (np.linalg.norm(r, axis=-1)[found.views.seen] for r in (found.fit.residuals, found.held_out))
    assert np.isfinite(held).all() and 1.0 < np.sqrt(np.mean(held**2) / np.mean(seen**2)) < 1.25


def test_blunders_are_dropped() -> None:
    views, truth = waved(np.random.default_rng(3))
    wrong = views.pixels.copy()
    rng = np.random.default_rng(0)
    rows, points = rng.integers(0, len(views), 25), rng.integers(0, 12, 25)
    wrong[rows, points] += rng.choice([-1, 1], (25, 2)) * rng.uniform(5, 60, (25, 2))
    found = calibrate(replace(views, pixels=wrong))
    assert found.dropped >= 20 and nees(errors(found, truth), found.fit.covariance) < 2


def test_the_model_is_no_richer_than_the_lens() -> None:
    views, _ = waved(np.random.default_rng(3), noise=0.05)
    choices = [choose_model(views.select(views.camera == c)) for c in range(3)]
    assert choices[0].fit.model == "k1 k2" and all("p1" not in choice.fit.model for choice in choices)
    none = next(score for score in choices[0].scores if score.model == "none")
    assert none.gain < -2 * none.gain_sigma  # a lens that bends is not taken for one that does not


@pytest.mark.parametrize("lens", [TOP, SIDE, BOTTOM])
def test_the_thesis_own_table_is_refused(lens: list[float]) -> None:
    with pytest.raises(Implausible, match=r"camera a: .* allowed"):
        check_lens("a", SIZE, np.array(lens))


def test_k3_of_5751_and_a_focal_length_five_times_its_neighbours_are_named() -> None:
    square = np.array(BOTTOM)
    square[1] = square[0]
    square[6:8] = square[4:6] = 0
    with pytest.raises(Implausible, match="k3 = 5751"):
        check_lens("bottom", SIZE, square)
    with pytest.raises(Implausible, match=r"camera bottom: fx beside top's 980.8 px = 5258.7 px, 5.4 times apart"):
        check_neighbours(("top", "side", "bottom"), (SIZE,) * 3, np.array([SIDE, SIDE, BOTTOM]))


def test_lenses_of_webcams_that_were_measured_are_not_refused() -> None:
    for lens in (
        [894.0354, 895.6201, 624.237, 361.1172, -0.33769, 0.117941, -0.001162, 0.003221, -0.003749],
        [636.5446, 633.6219, 657.4653, 378.1315, 0.199428, -0.247856, -9e-05, 0.008356, 0.156319],
    ):
        check_lens("a", SIZE, np.array(lens))


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        (lambda v: v.camera != 1, "camera side: never sees the board"),
        (lambda v: (v.camera == 2) == (v.instant % 2 == 0), "front: saw the board together with top, side in 0"),
        (
            lambda v: ((v.camera == 2) == (v.instant % 2 == 0)) | ((v.camera == 2) & (v.instant < 4)),
            "front: saw the board together with top, side in 2 frame sets, allowed 3",
        ),
        (lambda v: (v.camera != 0) | (v.instant < 6), "camera top: views of the board = 6, allowed 10"),
    ],
    ids=["never", "never together", "hardly together", "too few"],
)
def test_a_camera_that_sees_too_little_of_the_board_is_named(kept: Callable[[BoardViews], Array], words: str) -> None:
    views, _ = waved(np.random.default_rng(3))
    with pytest.raises(Undetermined, match=words):
        calibrate(views.select(kept(views)))


def test_a_board_that_is_not_the_one_described_is_told_by_how_its_corners_scatter() -> None:
    views, _ = waved(np.random.default_rng(3), noise=4.0)
    with pytest.raises(Undetermined, match=r"camera .*: corners scatter by .* px about the best lens, allowed 2 px"):
        calibrate(views)


def test_views_from_one_side_only_are_refused() -> None:
    level = np.array([se3.make(np.eye(3), [x, 10 * y, 700.0]) for x in range(-150, 150, 60) for y in range(-10, 10, 5)])
    inside = se3.transform_points(level, corners() - corners().mean(0))
    pixels = project_lens(LENSES[2], inside)[0] + np.random.default_rng(0).normal(0, 0.2, (20, 12, 2))
    of, at = (("a",), (SIZE,), corners(), np.zeros(20, int)), (np.arange(20), np.arange(20.0))
    views = BoardViews(*of, *at, pixels, np.full(20, 0.2))
    with pytest.raises((Implausible, Undetermined), match="camera a: "):
        calibrate(views)


def test_the_predicted_error_is_the_one_that_is_made(known: tuple[Calibration, Truth]) -> None:
    found, truth = known
    points = found.working_volume(3)
    predicted = found.predicted_error(points)
    made = triangulated(found, truth, points)
    ratio = np.sqrt(np.nanmean(made**2)) / predicted.typical
    assert 0.3 < ratio < 2.5


def triangulated(found: Calibration, truth: Truth, points: Array) -> Array:
    """Distances (N,), mm, between points and where the found rig puts them, after the best rigid motion."""
    pairs = zip(truth.lens, truth.base_from_camera, strict=True)
    true = [replace(camera_of(lens), base_from_camera=place) for lens, place in pairs]
    seen = [pixels_from_points(camera, points)[0] for camera in true]
    looks = list(zip(found.rig.cameras, seen, strict=True))
    there = np.array([_nearest([(camera, pixels[i]) for camera, pixels in looks], p) for i, p in enumerate(points)])
    a, b = points - points.mean(0), there - there.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = vt.T @ np.diag([1, 1, np.linalg.det(vt.T @ u.T)]) @ u.T
    return np.asarray(np.linalg.norm(b - a @ turn.T, axis=1))


def _nearest(sides: list, start: Array) -> Array:
    point = start.copy()
    for _ in range(8):
        rows, rest = [], []
        for camera, seen in sides:
            camera_from_base = se3.inverse(camera.base_from_camera)
            pixels, _, by = project_lens(lens_parameters(camera), se3.transform_points(camera_from_base, point[None]))
            rows.append(by[0] @ camera_from_base[:3, :3])
            rest.append(pixels[0] - seen)
        point = point - np.linalg.lstsq(np.concatenate(rows), np.concatenate(rest), rcond=None)[0]
    return point


def test_a_rig_without_doubt_has_no_error_and_a_point_behind_it_none_at_all(known: tuple[Calibration, Truth]) -> None:
    found, _ = known
    points = np.vstack([found.working_volume(), [[0.0, 0.0, -500.0]]])
    error = volume_error(found.rig, np.zeros((48, 48)), points)
    assert error.typical == pytest.approx(0.0, abs=1e-9) and np.isnan(error.error[-1])
    assert np.isfinite(error.pixel[:-1]).any()


def test_a_late_clock_costs_more_the_faster_the_surface_moves(known: tuple[Calibration, Truth]) -> None:
    found, _ = known
    points = found.working_volume()
    slow, fast = (found.predicted_error(points, speed).typical for speed in (0.0, 200.0))
    assert fast > slow


def test_another_base_leaves_the_cameras_where_they_are_to_each_other(known: tuple[Calibration, Truth]) -> None:
    found, _ = known
    base = se3.exp(np.array([0.3, -0.2, 1.0, 100.0, -50.0, 30.0]))
    moved = rebase(found.rig, base)
    assert np.allclose(moved.cameras[0].base_from_camera, base)
    for a, b in zip(found.rig.cameras, moved.cameras, strict=True):
        assert np.allclose(base @ a.base_from_camera, b.base_from_camera)


@pytest.mark.slow
def test_the_same_corners_give_the_same_rig() -> None:
    views, _ = waved(np.random.default_rng(9), instants=12)
    a, b = calibrate(views), calibrate(views)
    assert np.array_equal(a.fit.covariance, b.fit.covariance) and places().shape == (3, 4, 4)
