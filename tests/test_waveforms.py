"""Waveforms: exact derivatives, stated bounds, and a function of time alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.se3 import Array
from estimation.synthetic.draws import WIDEST, BreathingSpec, draw_breathing, draw_noise, draw_pulse, draw_walk
from estimation.synthetic.waveforms import Corners, Levels, Sine, Steps, Waveform, Zigzag

H = 1e-4  # s, half the step of a difference quotient


def every_kind(seed: int) -> dict[str, Waveform]:
    rng = np.random.default_rng(seed)
    breath = BreathingSpec(sighs_per_min=3.0, pauses_per_min=3.0)
    return {
        "sine": Sine(rng.uniform(0.05, 2), rng.uniform(-3, 3)),
        "breathing": draw_breathing(breath, rng),
        "pulse": draw_pulse(1.15, 0.05, 0.1, rng),
        "noise": draw_noise(0.2, 3.0, 1.0, rng),
        "steps": Steps(1.0, 2.0, 0.3, False),
        "stairs": Steps(1.0, 2.0, 2.0, True),
        "levels": Levels(np.array([1.0, 3.0, 5.0]), np.array([25.0, -41.0, 16.0]), 1.0, 7.0),
        "corners": Corners(np.array([1.0, 2.5]), np.array([3.0, -3.0]), 0.4),
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


@pytest.mark.parametrize("kind", ["breathing", "pulse", "noise", "walk"])
def test_the_seed_alone_decides_what_is_drawn(kind: str) -> None:
    times = np.linspace(0, 60, 601)
    assert every_kind(3)[kind](times).tobytes() == every_kind(3)[kind](times).tobytes()
    assert not np.allclose(every_kind(3)[kind](times), every_kind(4)[kind](times))


@given(seed=st.integers(0, 2**32 - 1), spread=st.floats(0, 0.2))
def test_breaths_stay_within_the_stated_depth_and_end_at_rest(seed: int, spread: float) -> None:
    spec = BreathingSpec(depth_spread=spread, sighs_per_min=2.0, pauses_per_min=2.0)
    wave = draw_breathing(spec, np.random.default_rng(seed))
    values = wave(np.linspace(0, 600, 6001))
    assert values.min() >= 0
    assert values.max() <= spec.sigh_factor * (1 + WIDEST * spread) + 1e-12
    ends = wave.starts
    assert np.allclose(wave(ends), 0, atol=1e-12)
    assert np.allclose(wave.rate(ends), 0, atol=1e-9)


def test_a_breath_is_no_sine_it_rests_longer_than_it_peaks() -> None:
    wave = draw_breathing(BreathingSpec(period_spread=0, depth_spread=0), np.random.default_rng(0))
    values = wave(np.linspace(0, 4, 4001))
    assert abs(np.argmax(values) / 4000 - 0.4) < 0.002  # inspiration is the shorter part
    assert values.max() == pytest.approx(1)
    assert np.mean(values < 0.1) > 1.5 * np.mean(values > 0.9)


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
    times = np.arange(0, 400, 0.02)
    values = wave(times)
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
    turns, stairs = Steps(1.0, 2.0, 0.3, False), Steps(1.0, 2.0, 0.3, True)
    assert np.allclose(at(turns, 0, 1, 1.15, 1.3, 3, 3.3, 5.3), [0, 0, 0.5, 1, 1, 0, 1])
    assert np.allclose(at(stairs, 0, 1, 1.15, 1.3, 3, 3.3, 5.3), [0, 0, 0.5, 1, 1, 2, 3])
    assert np.abs(turns.rate(np.linspace(0, 20, 9999))).max() == pytest.approx(1.875 / 0.3, rel=1e-3)


def test_corners_are_straight_outside_their_rounding() -> None:
    ramp = Corners(np.array([1.0, 3.0]), np.array([2.0, -2.0]), 0.4)
    assert np.allclose(at(ramp, 0.8, 1.2, 2.0, 3.2, 9.0), [0, 0.4, 2.0, 4.0, 4.0])
    assert np.allclose(ramp.rate(np.array([0.8, 1.2, 2.8, 3.2])), [0, 2, 2, 0])


def test_a_zigzag_is_bounded_and_goes_at_unit_speed_between_its_corners() -> None:
    wave = Zigzag(1.5, 0.4)
    times = np.linspace(-20, 20, 8001)
    assert np.abs(wave(times)).max() <= 1.5
    straight = np.abs(np.abs(np.mod(times, 3.0) - 1.5)) > 0.2
    assert np.allclose(np.abs(wave.rate(times))[straight], 1)
    assert np.allclose(at(wave, -1, 0, 1), [-1, 0, 1])
