"""Simulated cameras: when they expose, what their stamps hide, and what is lost or damaged on the way."""

from __future__ import annotations

from itertools import islice, pairwise
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.files.images import decode, encode
from hardware.simulator.cameras import CameraSettings, Fate, Shot, SimulatedCameras, camera_settings_from_table, garble

NAMES = ("top", "middle", "side")
EVIL = {
    "jitter_s": 0.004,
    "transport_jitter_s": 0.02,
    "drop": 0.1,
    "duplicate": 0.1,
    "garble": 0.1,
    "phase_s": [0, 0.004, 0.009],
    "offset_s": [0.016, -0.016, 0],
    "gain_drift": 0.2,
    "flicker": 0.1,
}
seeds = st.integers(0, 2**32 - 1)


def read(**table: Any) -> CameraSettings:
    return camera_settings_from_table("s.toml", table, NAMES)


def cameras(seed: int = 0, **table: Any) -> SimulatedCameras:
    return SimulatedCameras(read(**table), seed)


def take(made: SimulatedCameras, camera: int, count: int = 150) -> list[Shot]:
    return list(islice(made.shots(camera), count))


def test_without_faults_frames_come_in_step_after_exposure_and_transport() -> None:
    made = cameras(fps=25.0, exposure_s=0.01, transport_s=0.03)
    for camera in range(3):
        for k, shot in enumerate(take(made, camera, 50)):
            assert shot.exposed == pytest.approx(0.1 + k / 25) and shot.stamp == shot.exposed
            assert shot.arrival == pytest.approx(shot.exposed + 0.005 + 0.03)  # from the end of the exposure
            assert (shot.camera, shot.number, shot.picture, shot.gain) == (camera, k, k, 1.0)
            assert shot.fate is Fate.DELIVERED


@settings(max_examples=12)
@given(seed=seeds)
def test_the_seed_alone_decides_and_a_frame_does_not_depend_on_others(seed: int) -> None:
    made = cameras(seed, **EVIL)
    assert take(made, 1) == take(cameras(seed, **EVIL), 1)
    assert take(made, 1) != take(cameras(seed + 1, **EVIL), 1)
    fates = [shot.fate for shot in take(made, 1)]
    assert fates != [shot.fate for shot in take(made, 2)]
    less = take(cameras(seed, **{**EVIL, "off": [["middle", 2.0, 3.0]], "transport_jitter_s": 0.0}), 1)
    assert all(a is b.fate for a, b in zip(fates, less, strict=True) if not 2.0 <= made.due(1, b.number) < 3.0)
    assert [s.stamp for s in less] == [s.stamp for s in take(made, 1)]


@settings(max_examples=12)
@given(seed=seeds)
def test_stamps_and_arrivals_of_a_camera_rise_and_nothing_arrives_before_it_is_exposed(seed: int) -> None:
    made = cameras(seed, **EVIL)
    for camera in range(3):
        shots = take(made, camera)
        assert all(a.stamp < b.stamp for a, b in pairwise(shots))
        arrived = [shot for shot in shots if shot.fate is not Fate.DROPPED]
        assert all(a.arrival < b.arrival for a, b in pairwise(arrived))
        assert all(shot.arrival >= shot.exposed + shot.exposure / 2 + 0.025 - 1e-12 for shot in shots)


@settings(max_examples=12)
@given(seed=seeds)
def test_shots_end_with_the_time_and_cameras_overtake_each_other(seed: int) -> None:
    made = cameras(seed, **EVIL)
    each = [shot for camera in range(3) for shot in made.shots(camera, 3.0) if shot.fate is not Fate.DROPPED]
    assert all(shot.exposed < 3.0 for shot in each)
    order = [shot.exposed for shot in sorted(each, key=lambda shot: shot.arrival)]
    assert order != sorted(order)


@pytest.mark.parametrize(
    ("fate", "key"), [(Fate.DROPPED, "drop"), (Fate.DUPLICATED, "duplicate"), (Fate.GARBLED, "garble")]
)
def test_faults_come_as_often_as_stated(fate: Fate, key: str) -> None:
    fates = [shot.fate for camera in range(3) for shot in take(cameras(3, **{key: 0.15}), camera, 1000)]
    assert fates.count(fate) / len(fates) == pytest.approx(0.15, abs=0.02)
    assert set(fates) == {fate, Fate.DELIVERED}


@settings(max_examples=12)
@given(seed=seeds)
def test_a_duplicate_carries_an_earlier_picture_under_its_own_stamp(seed: int) -> None:
    made = cameras(seed, duplicate=0.4, fps=30.0, gain_drift=0.2)
    shots = take(made, 0, 100)
    assert shots[0].fate is not Fate.DUPLICATED
    for before, shot in pairwise(shots):
        assert shot.stamp == made.due(0, shot.number)
        if shot.fate is Fate.DUPLICATED:
            assert (shot.picture, shot.exposed, shot.gain) == (before.picture, before.exposed, before.gain)
        else:
            assert (shot.picture, shot.exposed) == (shot.number, shot.stamp)


def test_hidden_offsets_and_jitter_are_in_the_stamps_and_phases_are_told_by_them() -> None:
    skewed = cameras(1, phase_s={"side": 0.01}, offset_s={"middle": 0.016, "side": -0.016})
    shots = [take(skewed, camera, 5) for camera in range(3)]
    assert np.allclose([s[3].exposed - s[3].stamp for s in shots], [0, 0.016, -0.016])
    assert np.allclose([s[3].exposed - shots[0][3].exposed for s in shots], [0, 0, 0.01])
    error = [s.stamp - s.exposed for s in take(cameras(1, jitter_s=0.004), 0, 2000)]
    assert np.std(error) == pytest.approx(0.004, rel=0.05) and np.abs(error).max() <= 0.012 + 1e-12


def test_every_third_frame_of_sixty_a_second() -> None:
    made = read(fps=60.0, every=3)
    assert made.period == pytest.approx(1 / 20)
    exposed = [shot.exposed for shot in take(SimulatedCameras(made, 0), 0, 20)]
    assert np.allclose(np.diff(exposed), 0.05)


def test_a_lost_camera_delivers_nothing_and_comes_back() -> None:
    made = cameras(0, off=[["side", 2.0, 4.0]])
    assert all((2.0 <= s.exposed < 4.0) == (s.fate is Fate.DROPPED) for s in take(made, 2))
    assert all(s.fate is Fate.DELIVERED for s in take(made, 1))


def test_the_exposure_control_wanders_slowly_and_each_camera_by_itself() -> None:
    made = cameras(0, gain_drift=0.2, gain_period_s=5.0)
    gains = np.array([[s.gain for s in take(made, c)] for c in range(3)])
    assert np.abs(gains - 1).max() == pytest.approx(0.2, abs=0.01)
    assert np.abs(np.diff(gains)).max() < 0.2 * 2 * np.pi / 5 / 30 * 1.01
    assert np.abs(gains[0] - gains[1]).max() > 0.05


def test_an_exposure_of_whole_mains_periods_does_not_flicker() -> None:
    def spread(exposure: float) -> float:
        return float(np.ptp([s.gain for s in take(cameras(0, flicker=0.3, exposure_s=exposure, fps=29.91), 0)]))

    assert spread(0.01) < 1e-9
    assert spread(0.002) > 0.5


def skin(seed: int) -> bytes:
    noise = np.random.default_rng(seed).integers(0, 256, (240, 320, 3), np.uint8)
    return encode(cv2.GaussianBlur(noise, (0, 0), 2), 90)[1]


def test_a_garbled_picture_either_shows_a_damaged_part_or_does_not_decode() -> None:
    whole = skin(0)
    picture, ends = decode(whole, "", ""), []
    for seed in range(60):
        data = garble(whole, np.random.default_rng(seed))
        assert data != whole
        assert data[:300] == whole[:300]  # the header stays
        try:
            ends.append(float((decode(data, "", "") != picture).mean()))
        except InputError:
            ends.append(-1.0)
    refused, shares = ends.count(-1.0), [share for share in ends if share >= 0]
    assert 5 <= refused <= 30
    assert 0 < min(shares) < 0.5 < max(shares)
    assert garble(whole, np.random.default_rng(7)) == garble(whole, np.random.default_rng(7))


@given(data=st.binary(max_size=300), jpeg=st.booleans(), seed=seeds)
def test_garbling_takes_any_bytes(data: bytes, jpeg: bool, seed: int) -> None:
    data = b"\xff\xd8\xff\xda" + data if jpeg else data
    assert len(garble(data, np.random.default_rng(seed))) <= len(data)


def test_an_empty_table_is_three_good_cameras_at_30_frames_a_second() -> None:
    made = read()
    assert (made.fps, made.period, made.transport) == (30.0, 1 / 30, 0.025)
    assert made.phases == made.offsets == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("table", "key", "allowed"),
    [
        ({"fsp": 30}, "cameras.fsp", "did you mean 'fps'"),
        ({"fps": 0}, "cameras.fps", "0.1 to"),
        ({"exposure_s": 0.05}, "cameras.exposure_s", "to 0.0333"),
        ({"every": 0}, "cameras.every", ">= 1"),
        ({"jitter_s": 0.01}, "cameras.jitter_s", "to 0.00416"),
        ({"drop": 1.1}, "cameras.drop", "to 1"),
        ({"drop": 0.5, "garble": 0.6}, "cameras.drop + duplicate + garble", "at most 1"),
        ({"offset_s": [0, 0]}, "cameras.offset_s", "3 finite numbers"),
        ({"offset_s": {"sidé": 0.1}}, "cameras.offset_s.sidé", "did you mean 'side'"),
        ({"phase_s": [0, 0, -0.1]}, "cameras.phase_s", "0 to 1 s each"),
        ({"off": ["side", 1, 2]}, "cameras.off", "[[camera, from, to], ...]"),
        ({"off": [["sid", 1, 2]]}, "cameras.off[0]", "did you mean 'side'"),
        ({"off": [["side", 2, 2]]}, "cameras.off[0]", "from < to"),
        ({"off": [["side", "a", 2]]}, "cameras.off[0]", "2 finite numbers"),
    ],
)
def test_a_wrong_table_is_named(table: dict[str, Any], key: str, allowed: str) -> None:
    with pytest.raises(InputError) as caught:
        read(**table)
    assert (caught.value.where, caught.value.what) == ("s.toml", key)
    assert allowed in caught.value.allowed
