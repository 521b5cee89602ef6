"""The bench of forecasts: its methods beside motions of which the answer is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.trajectory import Trajectory
from hardware.bench.prediction import AHEAD, AROUND, SIMULATED, Chest, errors_of, figures, recorded, simulated
from hardware.tum import write_tum

SECONDS, WARM = 14.0, 8.0


def gliding(speed: float) -> Chest:
    stamps = np.arange(0, SECONDS, 0.1)
    coordinates = np.zeros((len(stamps), 6))
    coordinates[:, 4] = speed * stamps
    return Chest("gliding", Trajectory(stamps, se3.exp(coordinates), True), AROUND)


def test_hold_is_off_by_the_way_and_constant_velocity_by_nothing_on_a_steady_glide() -> None:
    errors = errors_of(gliding(5.0), WARM)
    assert errors.hold == pytest.approx(5.0 * np.array(AHEAD), rel=1e-9)
    assert np.abs(errors.steady).max() < 1e-9
    assert (errors.ours < 0.02 * errors.hold).all()


def test_breathing_of_the_simulator_is_foretold_better_than_it_is_held() -> None:
    errors = errors_of(simulated("breathing_deep", SECONDS), WARM)
    assert (errors.ours[1:] < 0.8 * errors.hold[1:]).all()
    rows = {figure.what: figure for figure in figures([errors], SIMULATED)}
    assert rows["200 ms: error by hold's"].target is None
    assert rows["200 ms: error by hold's"].value == pytest.approx(errors.ours[1] / errors.hold[1])


def test_a_recording_too_short_to_be_judged_is_refused(tmp_path: Path) -> None:
    chest = gliding(1.0)
    write_tum(tmp_path / "short.tum", chest.seen)
    assert len(recorded(tmp_path / "short.tum", WARM).seen) == len(chest.seen)
    with pytest.raises(InputError, match=r"short\.tum: duration"):
        recorded(tmp_path / "short.tum", 60.0)
