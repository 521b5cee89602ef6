"""The training itself: it learns, goes on where it was broken off, and its ONNX file answers as torch does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is in the extra [train]")
pytest.importorskip("onnx", reason="onnx is in the extra [train]")

from estimation.errors import StillbedError
from perception.training.dataset import Augmentation, sample_pyramid
from perception.training.export import export
from perception.training.loop import (
    Curve,
    Recipe,
    Schedule,
    Source,
    ThesisUNet,
    WoundNet,
    as_function,
    build_network,
    mean_dice,
    parameter_count,
    rate_at,
    train,
    wound_loss,
)
from perception.training.metrics import chosen_settings
from perception.wound.network import Looks, Settings, WoundNetwork
from tests.test_training_data import labelled

RECIPE = Recipe(Augmentation(side=64, long_side=96.0))
SCHEDULE = Schedule(rounds=2, steps=3, batch=4, small=0.0, seed=7)
PICTURES = [labelled(seed) for seed in range(4)]
SOURCE = Source([sample_pyramid(each) for each in PICTURES], np.ones(4))


def small() -> WoundNet:
    torch.manual_seed(0)
    return WoundNet((8, 12, 16, 24, 32), (1, 1, 1, 1))


def run(folder: Path, schedule: Schedule, name: str) -> tuple[WoundNet, Curve]:
    return train(small(), SOURCE, PICTURES[:1], schedule, folder / name, lambda done, of: None, RECIPE)


def test_a_run_that_was_broken_off_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    whole, curve = run(tmp_path, SCHEDULE, "whole.ckpt")

    class Broken(Exception):
        pass

    def breaks(done: int, of: int) -> None:
        if done == 4:
            raise Broken

    with pytest.raises(Broken):
        train(small(), SOURCE, PICTURES[:1], SCHEDULE, tmp_path / "cut.ckpt", breaks, RECIPE)
    again, rest = run(tmp_path, SCHEDULE, "cut.ckpt")
    assert rest.loss == curve.loss and rest.dice == curve.dice
    for a, b in zip(whole.state_dict().values(), again.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def test_the_loss_falls_on_pictures_it_has_seen(tmp_path: Path) -> None:
    _, curve = run(tmp_path, replace(SCHEDULE, rounds=4, steps=10), "x.ckpt")
    assert curve.loss[-1] < 0.95 * curve.loss[0]


def test_the_rate_rises_then_falls_to_nothing() -> None:
    rates = [rate_at(step, Schedule(rounds=10, steps=100)) for step in range(1000)]
    top = int(np.argmax(rates))
    assert rates[top] == pytest.approx(1.5e-3, rel=0.05) and top < 40
    assert all(a >= b for a, b in zip(rates[top:], rates[top + 1 :], strict=False)) and rates[-1] < 1e-7


def test_a_perfect_answer_costs_nothing_and_an_empty_truth_is_no_trouble() -> None:
    wound = torch.zeros(2, 1, 32, 32)
    wound[0, 0, 8:20, 8:20] = 1
    assert wound_loss(40 * (wound - 0.5), wound).item() < 1e-3
    assert wound_loss(40 * (0.5 - wound), wound).item() > 1
    assert torch.isfinite(wound_loss(torch.zeros_like(wound), wound))


def test_the_file_sees_what_torch_sees_and_the_hash_is_its_own(tmp_path: Path) -> None:
    network, _ = run(tmp_path, replace(SCHEDULE, rounds=4, steps=10), "x.ckpt")
    chosen = Settings(Looks(128), edge=0.4)
    alike = export(network, tmp_path / "x.onnx", PICTURES, Looks(128), lambda written: chosen)
    loaded = WoundNetwork(tmp_path / "x.onnx")
    assert alike > 0.9 and loaded.settings == chosen
    planes = np.ascontiguousarray(PICTURES[0].picture[:128, :128].transpose(2, 0, 1)[None], np.float32) / 255
    expected = as_function(network)(planes)
    assert np.abs(loaded(planes) - expected).mean() < 0.1 * np.ptp(expected)


def test_a_network_that_cannot_be_rounded_is_refused(tmp_path: Path) -> None:
    network, _ = run(tmp_path, replace(SCHEDULE, rounds=4, steps=10), "x.ckpt")
    stem, readers = network.stem[0][1], (network.downs[0][0], network.skips[-1][0])
    with torch.no_grad():  # the same network in real numbers: one channel is a million times as large as all others
        for scaled in (stem.weight, stem.bias):
            scaled[0] *= 1e6
        for reader in readers:
            reader.weight[:, 0] /= 1e6
    with pytest.raises(StillbedError, match=r"agree with torch's at a Dice of 0\.\d+, allowed 0\.9 or more"):
        export(network, tmp_path / "x.onnx", PICTURES, Looks(128), lambda written: Settings(Looks(128)))


def test_both_networks_keep_the_size_and_ours_is_below_three_million() -> None:
    planes = torch.zeros(1, 3, 64, 96)
    for name in ("wound", "thesis"):
        assert build_network(name, 1).eval()(planes).shape == (1, 1, 64, 96)
    assert parameter_count(WoundNet()) < 3e6 < parameter_count(ThesisUNet())


def test_the_mean_dice_of_a_network_that_says_no_is_nothing() -> None:
    class No(torch.nn.Module):
        def forward(self, pictures: torch.Tensor) -> torch.Tensor:
            return -9 * torch.ones_like(pictures[:, :1])

    assert mean_dice(No(), PICTURES, Looks()) == 0


def test_settings_are_chosen_so_that_healthy_skin_is_kept_silent_about() -> None:
    def network(planes: np.ndarray) -> np.ndarray:
        return np.asarray(30 * (planes[:, :1] - planes[:, 1:2] - 0.35), np.float32)

    healthy = [labelled(seed, wounded=False).picture for seed in range(5)]
    chosen = chosen_settings(network, PICTURES, healthy, Looks())
    assert 0 < chosen.trust < 1 and chosen.slope > 0
