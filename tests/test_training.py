"""The training itself: it learns, goes on where it was broken off, and its ONNX file answers as torch does."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is in the extra [train]")
pytest.importorskip("onnx", reason="onnx is in the extra [train]")

from estimation.errors import StillbedError
from hardware.cli.main import main
from perception.training import loop
from perception.training.dataset import Augmentation, Samples
from perception.training.export import agreement, export
from perception.training.loop import (
    Recipe,
    Schedule,
    ThesisUNet,
    Trained,
    WoundNet,
    as_function,
    build_network,
    learning_rate_at,
    parameter_count,
    pretrained_encoder,
    train,
    wound_loss,
)
from perception.wound.network import Looks, Settings, WoundNetwork
from tests.test_training_data import labelled, write
from tests.test_wound_outline import outlined, recorded

RECIPE = Recipe(Augmentation(side=64, long_side=96.0))
SCHEDULE = Schedule(rounds=2, steps=3, batch=4, seed=7)
PICTURES = [labelled(seed) for seed in range(4)]
SAMPLES = Samples(PICTURES, np.ones(4), RECIPE.augmentation, SCHEDULE.seed)


def small() -> WoundNet:
    torch.manual_seed(0)
    return WoundNet(pretrained_encoder(), (8, 12, 16, 24, 32))


def run(folder: Path, schedule: Schedule, name: str) -> Trained:
    return train(small(), SAMPLES, schedule, folder / name, lambda done, of: None, RECIPE)


def test_a_run_that_was_broken_off_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    whole = run(tmp_path, SCHEDULE, "whole.ckpt")

    class Broken(Exception):
        pass

    def breaks(done: int, of: int) -> None:
        if done == 4:
            raise Broken

    with pytest.raises(Broken):
        train(small(), SAMPLES, SCHEDULE, tmp_path / "cut.ckpt", breaks, RECIPE)
    again = run(tmp_path, SCHEDULE, "cut.ckpt")
    assert again.loss == whole.loss and again.device == "cpu"
    for name, trained in (("whole", whole), ("again", again)):
        export(trained.network, tmp_path / f"{name}.onnx", Settings())
    assert (tmp_path / "whole.onnx").read_bytes() == (tmp_path / "again.onnx").read_bytes()
    finished = run(tmp_path, SCHEDULE, "whole.ckpt")  # from a checkpoint that holds the averaged weights alone
    assert finished.loss == whole.loss
    for a, b in zip(whole.network.state_dict().values(), finished.network.state_dict().values(), strict=True):
        assert torch.equal(a, b)


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A small network that has learned a little of four pictures."""
    schedule = replace(SCHEDULE, rounds=4, steps=10, rate=1e-2, encoder_share=0.3, average=0.9)
    recipe = Recipe(Augmentation(side=64, long_side=96.0, cover=0.0))
    checkpoint = tmp_path_factory.mktemp("learned") / "x.ckpt"
    samples = Samples(PICTURES, np.ones(4), recipe.augmentation, schedule.seed)
    return train(small(), samples, schedule, checkpoint, lambda done, of: None, recipe)


def test_the_loss_falls_on_pictures_it_has_seen(learned: Trained) -> None:
    assert learned.loss[-1] < 0.8 * learned.loss[0]


def test_training_begins_with_what_was_learned_before() -> None:
    first, second = (build_network("wound", seed) for seed in (1, 2))
    assert torch.equal(first.stem[0].weight, second.stem[0].weight)
    assert not torch.equal(first.head.weight, second.head.weight)


def test_the_rate_rises_then_falls_to_nothing() -> None:
    rates = [learning_rate_at(step, Schedule(rounds=10, steps=100)) for step in range(1000)]
    top = int(np.argmax(rates))
    assert rates[top] == pytest.approx(1e-3, rel=0.05) and top < 50
    assert all(a >= b for a, b in zip(rates[top:], rates[top + 1 :], strict=False)) and rates[-1] < 1e-7


def test_a_perfect_answer_costs_nothing_and_an_empty_truth_is_no_trouble() -> None:
    wound = torch.zeros(2, 1, 32, 32)
    wound[0, 0, 8:20, 8:20] = 1
    assert wound_loss(40 * (wound - 0.5), wound).item() < 1e-3
    assert wound_loss(40 * (0.5 - wound), wound).item() > 1
    assert torch.isfinite(wound_loss(torch.zeros_like(wound), wound))


def test_the_file_sees_what_torch_sees_and_the_hash_is_its_own(learned: Trained, tmp_path: Path) -> None:
    network = learned.network
    chosen = Settings(Looks(128, window=64), edge=0.4)
    terms = {"licence": 'of "my" clinic', "source": "mine"}
    export(network, tmp_path / "x.onnx", chosen, terms)
    loaded = WoundNetwork(tmp_path / "x.onnx")
    assert agreement(network, tmp_path / "x.onnx", PICTURES, chosen.looks) > 0.9 and loaded.settings == chosen
    assert (loaded.terms.licence, loaded.terms.source) == (terms["licence"], terms["source"])
    planes = np.ascontiguousarray(PICTURES[0].picture[:128, :128].transpose(2, 0, 1)[None], np.float32) / 255
    expected = as_function(network)(planes)
    assert np.abs(loaded(planes) - expected).mean() < 0.1 * np.ptp(expected)
    assert loaded.size < 1.3 * parameter_count(network)


def test_a_network_that_cannot_be_rounded_is_refused(learned: Trained, tmp_path: Path) -> None:
    network = copy.deepcopy(learned.network)
    with torch.no_grad():  # the same in real numbers: all channels but one carry a million times as much, and count so
        for merge in network.merges:
            _, norm, _, (across, _) = merge.layers
            scale = torch.full((norm.num_features,), 1e6)
            scale[0] = 1
            norm.weight *= scale
            norm.bias *= scale
            across.weight /= scale[None, :, None, None]
    export(network, tmp_path / "x.onnx", Settings(Looks(128)))
    with pytest.raises(StillbedError, match=r"agree with torch's at a Dice of 0\.\d+, allowed 0\.9 or more"):
        agreement(network, tmp_path / "x.onnx", PICTURES, Looks(128))


def test_both_networks_keep_the_size_and_ours_is_below_six_million() -> None:
    planes = torch.zeros(1, 3, 64, 96)
    for name in ("wound", "thesis"):
        assert build_network(name, 1).eval()(planes).shape == (1, 1, 64, 96)
    assert parameter_count(build_network("wound", 1)) < 3.2e6 < parameter_count(ThesisUNet())


def test_the_command_trains_parts_by_themselves_and_puts_them_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(9):
        each = labelled(number)
        write(tmp_path / "clinic", f"{number}", each.picture[..., ::-1], each.wound.astype(np.uint8) * 255)
    out = tmp_path / "own.onnx"
    words = ["train", str(tmp_path / "clinic"), "-o", str(out), "--folds", "2", "--rounds", "1", "--rendered", "0"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop.Schedule, "__init__", _short(loop.Schedule.__init__))
        assert main([*words, "--part", "1", "--licence", "mine"]) == 0
        assert (tmp_path / "own_1.ckpt").is_file() and not out.exists()
        made = (tmp_path / "own_1.ckpt").read_bytes()
        assert main([*words, "--licence", "mine"]) == 0
        ward = tmp_path / "ward.onnx"
        run = recorded(tmp_path / "run.mcap", outlined(0))
        assert main([*words[:3], str(ward), *words[4:], "--add", str(run)]) == 0
        out.unlink()
        assert main([*words, "--add", str(run)]) == 2  # the checkpoints that lie there are of fewer pictures
        told = capsys.readouterr().err
        assert "own_0.ckpt" in told and "of other pictures or options" in told and "delete it" in told
        assert main([*words, "--licence", "mine"]) == 0
    assert (tmp_path / "own_1.ckpt").read_bytes() == made
    assert WoundNetwork(out).terms.licence == "mine"
    assert (tmp_path / "own_trained.txt").read_text().split() == [f"clinic/{number}.jpg" for number in range(9)]
    assert (tmp_path / "ward_trained.txt").read_text().splitlines()[-1] == "run.mcap/left_0.000000"
    card = out.with_suffix(".md").read_text()
    assert "9 pictures in 2 folds" in card and "on cpu" in card
    for picture in ("own_curves.png", "own_reliability.png"):
        assert cv2.imread(str(tmp_path / picture)) is not None


def _short(made: Callable[..., None]) -> Callable[..., None]:
    def init(self: loop.Schedule, **values: Any) -> None:
        made(self, **{"steps": 2, "batch": 2, **values})

    return init
