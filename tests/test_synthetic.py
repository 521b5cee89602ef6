"""Synthetic pictures: same seed same pictures; the Cramer-Rao bound; waveforms with exact derivatives."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.observations import Observations
from estimation.pose_solver import GATE, PointTracks, solve_pose
from estimation.rig import pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.follow import filtered_bound, pose_bound, pose_information
from estimation.synthetic.movements import (
    MAX_DRAW_SIGMAS,
    BreathingSpec,
    Sine,
    StepWave,
    Waveform,
    draw_breathing,
    draw_noise,
    draw_pulse,
    draw_walk,
)
from estimation.synthetic.world import BASE_FROM_REST, World, arc_rig, synthetic_world
from hardware.files.folder_tables import read_tum
from hardware.recording.session_reader import open_session
from hardware.simulator.motion_table import Levels, RoundedCorners, Zigzag
from hardware.simulator.scene.scene import rois
from perception.mapping.features import grey
from tests.rendered_sets import (
    AWAY,
    CLEAN,
    NOISY,
    SCAN_FROM_SURFACE,
    breathing,
    frame_sets,
    patch,
    pictures,
    scan_of,
    write_session,
)
from tests.slow_cases import slowly

SMALL = arc_rig(size=(640, 360), focal=700.0)
TURNED = BASE_FROM_REST @ se3.exp([0.06, -0.08, 0.3, 4.0, -3.0, 6.0])
SCENE = patch()


def test_same_seed_same_pictures_and_another_seed_others() -> None:
    def drawn(seed: int) -> list[np.ndarray]:
        rng = np.random.default_rng(seed)
        sets = frame_sets(patch(seed), SMALL, breathing, [0.0, 0.3], rng)
        return [frame.image for frames in sets for frame in frames.frames]

    one, same, other = drawn(4), drawn(4), drawn(5)
    assert all((a == b).all() for a, b in zip(one, same, strict=True))
    assert all((a != b).any() for a, b in zip(one, other, strict=True))


def test_only_the_patch_moves() -> None:
    rng = np.random.default_rng(1)
    before, after = (pictures(SCENE, SMALL.cameras, pose, rng, CLEAN) for pose in (BASE_FROM_REST, TURNED))
    for camera, a, b in zip(SMALL.cameras, before, after, strict=True):
        edges = [se3.transform_points(t, SCENE.shape.points(SCENE.shape.grid(2.0))) for t in (BASE_FROM_REST, TURNED)]
        outline = np.concatenate([pixels_from_points(camera, points)[0] for points in edges])
        changed = np.argwhere((a != b).any(-1))[:, ::-1]
        assert len(changed) > 2000
        assert (changed >= outline.min(0) - 1.5).all() and (changed <= outline.max(0) + 1.5).all()


def test_what_is_out_of_view_leaves_the_room() -> None:
    rng = np.random.default_rng(1)
    away = pictures(SCENE, SMALL.cameras, AWAY, rng, CLEAN)
    behind = pictures(SCENE, SMALL.cameras, BASE_FROM_REST @ se3.make(np.eye(3), [0.0, 0.0, 5000.0]), rng, CLEAN)
    here = pictures(SCENE, SMALL.cameras, BASE_FROM_REST, rng, CLEAN)
    for a, b, c in zip(away, behind, here, strict=True):
        assert (a == b).all() and (a != c).any()


def test_the_views_are_rich_enough_to_track() -> None:
    """Corners that stand out of the grain, in the middle of the patch."""

    def strength(image: np.ndarray) -> np.ndarray:
        return cv2.cornerMinEigenVal(grey(image)[300:440, 560:740], 3)

    grain = np.rint(128 + NOISY.noise * np.random.default_rng(2).standard_normal((720, 1280, 3))).astype(np.uint8)
    for image in pictures(SCENE, arc_rig().cameras, BASE_FROM_REST, np.random.default_rng(2)):
        found = strength(image)
        peaks = found == cv2.dilate(found, np.ones((9, 9)))
        assert (peaks & (found > 2 * strength(grain).max())).sum() > 150


@pytest.mark.parametrize("quality", [95, *slowly(None)])
def test_a_written_session_reads_back(tmp_path: Path, quality: int | None) -> None:
    truth = write_session(tmp_path, 0.1, seed=3, quality=quality, cameras=SMALL)
    session = open_session(tmp_path)
    assert [c.name for c in session.rig.cameras] == ["cam_0", "cam_1", "cam_2"]
    np.testing.assert_array_equal(session.rig.matrices, SMALL.matrices)
    assert [len(s.frames) for s in session.frame_sets()] == [3, 3, 3]
    assert session.truth is not None and session.truth.exact
    np.testing.assert_array_equal(session.truth.stamps, truth.stamps)
    np.testing.assert_allclose(session.truth.base_from_surface, truth.base_from_surface, rtol=0, atol=1e-12)
    assert [r.camera for r in session.roi] == [0, 1, 2] and session.surface is None
    drawn = frame_sets(patch(3), SMALL, breathing, truth.stamps, np.random.default_rng([3, 3]))
    pairs = zip(session.frame_sets(), drawn, strict=True)
    frames = [pair for x, y in pairs for pair in zip(x.frames, y.frames, strict=True)]
    worst = max(np.abs(grey(a.image).astype(float) - grey(b.image)).mean() for a, b in frames)
    assert worst < 2.0 if quality else worst == 0.0


def test_a_session_with_a_scan_tells_the_truth_of_the_scan(tmp_path: Path) -> None:
    write_session(tmp_path, 0.05, cameras=SMALL, scan=True)
    session = open_session(tmp_path)
    assert session.surface == tmp_path / "surface.ply" and session.truth is not None
    scan_points, _ = scan_of(SCENE)
    placed = se3.transform_points(read_tum(tmp_path / "truth.tum", True).base_from_surface[0], scan_points)
    true = se3.transform_points(breathing(0.0), SCENE.shape.points(SCENE.shape.grid(1.0)))
    np.testing.assert_allclose(placed, true, atol=1e-9)
    np.testing.assert_allclose(session.truth.base_from_surface[0] @ SCAN_FROM_SURFACE, breathing(0.0), atol=1e-9)


def test_a_region_holds_the_wound_and_lies_on_the_patch() -> None:
    for roi, camera in zip(rois(SCENE, SMALL, BASE_FROM_REST, 0.0), SMALL.cameras, strict=True):
        polygon = roi.polygon.astype(np.float32)
        assert (SMALL.cameras[roi.camera].name, roi.stamp) == (camera.name, 0.0)
        middle, _ = pixels_from_points(camera, se3.transform_points(BASE_FROM_REST, SCENE.shape.points([[0.0, 0.0]])))
        corners = SCENE.shape.points(np.array(SCENE.shape.size) / 2 * [[-1, -1], [-1, 1], [1, -1], [1, 1]])
        edge, _ = pixels_from_points(camera, se3.transform_points(BASE_FROM_REST, corners))
        assert cv2.pointPolygonTest(polygon, middle[0].tolist(), False) > 0
        assert all(cv2.pointPolygonTest(polygon, p.tolist(), False) < 0 for p in edge)


PSD = np.array([1e-3] * 3 + [30.0] * 3)


def information(world: World, seen: Observations) -> np.ndarray:
    pose = world.base_from_surface(np.array(seen.stamp))
    return pose_information(world.true_rig, pose, world.landmarks.points, seen)


def test_least_squares_reaches_the_bound_and_does_not_pass_it() -> None:
    world = synthetic_world("still", seconds=10.0, count=60, noise=0.3, seed=2)
    true = world.truth.base_from_surface[0]
    errors = []
    for seen in world:
        points = world.landmarks.points[seen.track]
        plain = solve_pose(world.rig, PointTracks.from_observations(seen, points), true, scales=(1e6 / GATE,))
        errors.append(se3.log(se3.inverse(plain.base_from_surface) @ true))
    bound = pose_bound(information(world, seen))
    nees = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(bound), errors)
    assert nees.mean() / 6 == pytest.approx(1.0, abs=0.08)  # 300 draws: one sigma is 0.033


@given(st.integers(0, 100), st.floats(0.05, 2.0))
@settings(max_examples=10)
def test_the_bound_grows_with_the_noise_and_shrinks_with_every_track(seed: int, noise: float) -> None:
    world = synthetic_world("still", seconds=0.1, count=40, noise=noise, seed=seed)
    seen = next(iter(world))
    whole = pose_bound(information(world, seen))
    half = Observations(seen.stamp, seen.camera[::2], seen.track[::2], seen.pixels[::2], seen.sigma[::2])
    louder = Observations(seen.stamp, seen.camera, seen.track, seen.pixels, 2 * seen.sigma)
    assert np.linalg.eigvalsh(pose_bound(information(world, half)) - whole).min() > 0
    np.testing.assert_allclose(pose_bound(information(world, louder)), 4 * whole)


def test_cameras_apart_hold_each_others_depth() -> None:
    """The order of magnitude of one, two and three cameras at 400 mm, f 1100 px, 100 tracks of 0.25 px."""
    world = synthetic_world("still", seconds=0.1, count=100, noise=0.25)
    seen = next(iter(world))
    sigma = []
    for cameras in ([0], [0, 1], [0, 1, 2]):
        mine = np.isin(seen.camera, cameras)
        part = Observations(seen.stamp, seen.camera[mine], seen.track[mine], seen.pixels[mine], seen.sigma[mine])
        sigma.append(np.sqrt(np.trace(pose_bound(information(world, part))[3:, 3:])))
    assert 0.1 < sigma[0] < 0.3 and 0.015 < sigma[1] < 0.05 and 0.008 < sigma[2] < 0.02


def test_frames_before_help_the_less_the_livelier_the_motion() -> None:
    world = synthetic_world("still", seconds=2.0, count=60)
    each = [information(world, seen) for seen in world]
    alone = pose_bound(each[-1])
    calm, lively = (filtered_bound(each, 1 / 30, psd) for psd in (PSD, 1e8 * PSD))
    assert len(calm) == len(world)
    np.testing.assert_allclose(calm[0], pose_bound(each[0]), rtol=1e-5)
    np.testing.assert_allclose(lively[-1], alone, rtol=1e-2)
    assert np.linalg.eigvalsh(alone - calm[-1]).min() > 0
    assert (np.diff([np.trace(c) for c in calm]) < 1e-12).all()


def test_a_motion_without_noise_is_averaged_for_good() -> None:
    """At constant velocity the newest of n poses is known to 4 / n of one alone: the end of a fitted line."""
    each = [np.diag([1e4] * 3 + [1e2] * 3)] * 200
    bound = filtered_bound(each, 1 / 30, np.zeros(6))[-1]
    np.testing.assert_allclose(bound, pose_bound(each[0]) * 4 / 200, rtol=0.02, atol=1e-12)


H = 1e-4  # s, half the step of a difference quotient


def every_kind(seed: int) -> dict[str, Waveform]:
    rng = np.random.default_rng(seed)
    breath = BreathingSpec(sighs_per_min=3.0, pauses_per_min=3.0)
    return {
        "sine": Sine(rng.uniform(0.05, 2), rng.uniform(-3, 3)),
        "breathing": draw_breathing(breath, rng),
        "pulse": draw_pulse(1.15, 0.05, 0.1, rng),
        "noise": draw_noise(0.2, 3.0, 1.0, rng),
        "steps": StepWave(1.0, 2.0, 0.3, False),
        "stairs": StepWave(1.0, 2.0, 2.0, True),
        "levels": Levels(np.array([1.0, 3.0, 5.0]), np.array([25.0, -41.0, 16.0]), 1.0, 7.0),
        "corners": RoundedCorners(np.array([1.0, 2.5]), np.array([3.0, -3.0]), 0.4),
        "zigzag": Zigzag(1.5, 0.4),
        "walk": draw_walk(rng),
    }


KINDS = sorted(every_kind(0))


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 2**32 - 1), start=st.floats(-700, 1500))
def test_the_derivative_is_that_of_the_values(kind: str, seed: int, start: float) -> None:
    wave = every_kind(seed)[kind]
    times = start + np.linspace(0, 9, 37)
    quotient = (wave(times + H) - wave(times - H)) / (2 * H)
    scale = 1 + np.abs(wave.rate(times)).max()
    # a kink of the slope's derivative between the two samples costs half a step of the second derivative there
    assert np.abs(quotient - wave.rate(times)).max() < 2e-2 * scale
    assert np.median(np.abs(quotient - wave.rate(times))) < 1e-5 * scale


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), start=st.floats(-700, 1500))
def test_values_and_slopes_are_continuous(kind: str, seed: int, start: float) -> None:
    wave = every_kind(seed)[kind]
    times = start + np.linspace(0, 5, 5001)
    for values, limit in ((wave(times), 0.3), (wave.rate(times), 3.0)):
        assert np.abs(np.diff(values)).max() < limit
    finer = start + np.linspace(0, 5, 20001)
    assert np.abs(np.diff(wave.rate(finer))).max() < 0.5 * np.abs(np.diff(wave.rate(times))).max() + 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_an_instant_alone_gives_the_same_bits_as_among_others(kind: str) -> None:
    wave = every_kind(1)[kind]
    times = np.linspace(-3, 30, 257)
    together, slopes = wave(times), wave.rate(times)
    for i in range(0, len(times), 16):
        assert wave(times[i : i + 1]).tobytes() == together[i : i + 1].tobytes()
        assert wave.rate(times[i : i + 1]).tobytes() == slopes[i : i + 1].tobytes()


@given(seed=st.integers(0, 2**32 - 1), spread=st.floats(0, 0.2))
def test_breaths_stay_within_the_stated_depth_and_end_at_rest(seed: int, spread: float) -> None:
    spec = BreathingSpec(depth_spread=spread, sighs_per_min=2.0, pauses_per_min=2.0)
    wave = draw_breathing(spec, np.random.default_rng(seed))
    values = wave(np.linspace(0, 600, 6001))
    assert values.min() >= 0 and values.max() <= spec.sigh_factor * (1 + MAX_DRAW_SIGMAS * spread) + 1e-12
    ends = wave.starts
    assert np.allclose(wave(ends), 0, atol=1e-12)
    assert np.allclose(wave.rate(ends), 0, atol=1e-9)


def test_a_breath_is_no_sine_it_rests_longer_than_it_peaks() -> None:
    wave = draw_breathing(BreathingSpec(period_spread=0, depth_spread=0), np.random.default_rng(0))
    values = wave(np.linspace(0, 4, 4001))
    assert abs(np.argmax(values) / 4000 - 0.4) < 0.002  # inspiration is the shorter part
    assert values.max() == pytest.approx(1) and np.mean(values < 0.1) > 1.5 * np.mean(values > 0.9)


def test_sighs_and_pauses_come_as_often_as_stated() -> None:
    minutes = np.mean([draw_breathing(BreathingSpec(), rng).starts[-1] for rng in seeds()]) / 60
    sighs, pauses = [], []
    for rng in seeds():
        wave = draw_breathing(BreathingSpec(depth_spread=0, sighs_per_min=1.0, pauses_per_min=0.5), rng)
        sighs.append(np.sum(wave.depths > 1.5))
        pauses.append(np.sum(np.diff(wave.starts) - wave.lengths > 4.9))
    assert np.mean(sighs) / minutes == pytest.approx(1.0, rel=0.2)
    assert np.mean(pauses) / minutes == pytest.approx(0.5, rel=0.2)


def seeds() -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in range(30)]


def test_the_spread_of_breaths_is_the_one_of_the_specification() -> None:
    wave = draw_breathing(BreathingSpec(), np.random.default_rng(5))
    assert np.std(wave.lengths) / np.mean(wave.lengths) == pytest.approx(0.10, rel=0.2)
    assert np.std(wave.depths) / np.mean(wave.depths) == pytest.approx(0.15, rel=0.2)


def test_a_pulse_has_a_notch() -> None:
    wave = draw_pulse(1.0, 0, 0, np.random.default_rng(0))
    values = wave(np.linspace(0, 1, 1001)[:-1])
    slope = np.sign(np.diff(values))
    turns = np.flatnonzero(np.diff(slope[slope != 0]))
    assert len(turns) == 3  # up to the peak, down to the notch, up to the second wave, down
    assert values.max() == pytest.approx(1, abs=1e-3)


@given(low=st.floats(0.2, 8), width=st.floats(0.5, 4), tilt=st.sampled_from([0.0, 1.0]), seed=st.integers(0, 99))
def test_noise_has_unit_rms_and_stays_in_its_band(low: float, width: float, tilt: float, seed: int) -> None:
    wave = draw_noise(low, low + width, tilt, np.random.default_rng(seed))
    values = wave(np.arange(0, 400, 0.02))
    assert np.sqrt(np.mean(values**2)) == pytest.approx(1, abs=0.05)
    power = np.abs(np.fft.rfft(values * np.hanning(len(values)))) ** 2
    frequencies = np.fft.rfftfreq(len(values), 0.02)
    outside = (frequencies < low - 0.05) | (frequencies > low + width + 0.05)
    assert power[outside].sum() < 1e-4 * power.sum()


def test_a_walk_is_as_far_as_one_after_a_minute_on_average() -> None:
    ends = [float(draw_walk(np.random.default_rng(seed))(np.array([60.0]))[0]) for seed in range(300)]
    assert np.sqrt(np.mean(np.square(ends))) == pytest.approx(1, rel=0.15)
    assert draw_walk(np.random.default_rng(0))(np.zeros(1))[0] == 0


def at(wave: Waveform, *times: float) -> Array:
    return wave(np.array(times))


def test_steps_rise_in_the_stated_time_and_no_longer() -> None:
    turns, stairs = StepWave(1.0, 2.0, 0.3, False), StepWave(1.0, 2.0, 0.3, True)
    assert np.allclose(at(turns, 0, 1, 1.15, 1.3, 3, 3.3, 5.3), [0, 0, 0.5, 1, 1, 0, 1])
    assert np.allclose(at(stairs, 0, 1, 1.15, 1.3, 3, 3.3, 5.3), [0, 0, 0.5, 1, 1, 2, 3])
    assert np.abs(turns.rate(np.linspace(0, 20, 9999))).max() == pytest.approx(1.875 / 0.3, rel=1e-3)


def test_corners_are_straight_outside_their_rounding() -> None:
    ramp = RoundedCorners(np.array([1.0, 3.0]), np.array([2.0, -2.0]), 0.4)
    assert np.allclose(at(ramp, 0.8, 1.2, 2.0, 3.2, 9.0), [0, 0.4, 2.0, 4.0, 4.0])
    assert np.allclose(ramp.rate(np.array([0.8, 1.2, 2.8, 3.2])), [0, 2, 2, 0])


def test_a_zigzag_is_bounded_and_goes_at_unit_speed_between_its_corners() -> None:
    wave = Zigzag(1.5, 0.4)
    times = np.linspace(-20, 20, 8001)
    assert np.abs(wave(times)).max() <= 1.5
    straight = np.abs(np.abs(np.mod(times, 3.0) - 1.5)) > 0.2
    assert np.allclose(np.abs(wave.rate(times))[straight], 1)
    assert np.allclose(at(wave, -1, 0, 1), [-1, 0, 1])
