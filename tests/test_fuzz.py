"""What comes from outside is taken or refused with one of our errors, whatever is in it."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.arm.protocol import FRAME_LENGTH, FRAME_TAILS, FrameStream, decode
from hardware.operator.broadcast import parse_message
from hardware.process.checks import read_toml
from hardware.process.faults import fault_from_text
from tests.campaigns import fuzz
from tests.campaigns import fuzz_process as fuzz_try
from tests.campaigns.fuzz import PATH_TEXT, readers
from tests.campaigns.fuzz_process import (
    Block,
    Reader,
    ReaderSum,
    Task,
    fuzz_figures,
    fuzzed,
    mutated,
    read_log,
    run_tasks,
)
from tests.crashing_readers import deadly_readers

READERS = readers()


@pytest.mark.parametrize("name", READERS)
def test_every_reader_takes_or_refuses_mutations(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    blocks = list(fuzzed(name, READERS[name], range(25), 7, tmp_path))
    assert sum(block.count for block in blocks) == 25 and not [block.wrong for block in blocks if block.wrong]


@pytest.mark.parametrize("number", [324, 549])  # a zip of a version, and of a compression, that nobody has
def test_a_file_of_corners_that_no_zip_reader_knows_holds_none(number: int, tmp_path: Path) -> None:
    (block,) = fuzzed("corners", READERS["corners"], range(number, number + 1), 1, tmp_path)
    assert not block.wrong and block.number == number


@given(st.binary(max_size=200), st.integers(0, 2**32))
def test_what_is_made_wrong_is_the_same_each_time(data: bytes, seed: int) -> None:
    assert mutated(data, np.random.default_rng(seed)) == mutated(data, np.random.default_rng(seed))


@given(st.binary(max_size=300))
def test_bytes_of_any_kind_are_no_reason_to_fall(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    assert parse_message(text) is None or b"turn" in data or b"shown" in data
    FrameStream(FRAME_LENGTH, FRAME_TAILS, decode)(data)
    with pytest.raises(InputError):
        fault_from_text("x", "fault", "x" + text)


@pytest.mark.parametrize("text", ["x = " + "9" * 5000, "x = " + "[" * 5000, "x = 1e99999", "x = '\x00'"])
def test_toml_that_is_too_much_is_refused_or_read(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.toml").write_text(text)
    try:
        read_toml(tmp_path / "x.toml")
    except InputError as error:
        assert "TOML" in error.allowed


def wrong_reader(path: Path) -> object:
    """Falls, hangs and eats, by what stands in the file."""
    data = path.read_bytes()
    if b"fall" in data:
        raise KeyError("fall")
    while b"hang" in data:
        pass
    return bytearray(8 << 30) if b"eat" in data else None


@pytest.mark.parametrize(("word", "said"), [("fall", "KeyError"), ("hang", "more than 0.05 s"), ("eat", "MemoryError")])
def test_a_reader_that_fails_is_found(word: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz_try, "MAX_SECONDS", 0.05)
    monkeypatch.setattr(fuzz_try, "mutated", lambda valid, rng: word.encode())
    reader = Reader("x.csv", lambda folder: (folder / "x.csv").write_text(PATH_TEXT) and None, wrong_reader)
    blocks = list(fuzzed("x", reader, range(2), 1, tmp_path))
    assert [(block.count, block.number, block.case) for block in blocks] == [(1, k, word.encode()) for k in range(2)]
    assert all(said in block.wrong for block in blocks)


def test_the_figures_count_what_went_wrong() -> None:
    values = {figure.what: figure.value for figure in fuzz_figures([ReaderSum(10, 4, 0.1, 1), ReaderSum(5, 5, 0.1, 0)])}
    assert values["inputs"] == 15 and values["inputs that went wrong"] == 1


def test_a_reader_that_ends_its_process_is_found_and_the_rest_goes_on() -> None:
    blocks = list(run_tasks([Task("deadly", range(3)), Task("fine", range(2500))], 1, 2, deadly_readers))
    deaths = [block for block in blocks if block.wrong]
    assert [(block.name, block.number, block.count) for block in deaths] == [("deadly", k, 1) for k in range(3)]
    assert all(block.wrong == f"the process ended with {-signal.SIGSEGV}" for block in deaths)
    assert [block.case for block in deaths] == [mutated(b"valid", np.random.default_rng([1, k])) for k in range(3)]
    assert [block.count for block in blocks if block.name == "fine"] == [1000, 1000, 500]


def test_a_run_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(fuzz, "readers", lambda: dict.fromkeys(["a", "b"]))
    asked: list[Task] = []

    def stopped(tasks: list[Task], *rest: object) -> Iterator[Block]:
        asked.extend(tasks)
        yield Block("a", 4, 2, 0.1, "fell", 3, b"case")
        yield Block("a", 2, 2, 0.1)
        raise KeyboardInterrupt

    monkeypatch.setattr(fuzz, "run_tasks", stopped)
    log = tmp_path / "x.csv"
    options = argparse.Namespace(count=20, seed=1, only=None, jobs=1, log=log, out=tmp_path)
    with pytest.raises(KeyboardInterrupt):
        fuzz.run_fuzz(options)
    assert (tmp_path / "a_3.bin").read_bytes() == b"case" and "fell; kept as" in capsys.readouterr().out
    monkeypatch.setattr(fuzz, "run_tasks", lambda tasks, *rest: iter([Block(t.name, len(t.numbers)) for t in tasks]))
    values = {figure.what: figure.value for figure in fuzz.run_fuzz(options)}
    assert asked == [Task("a", range(10)), Task("b", range(10))]
    assert values["inputs"] == 20 and values["inputs that went wrong"] == 1 and "fell" in capsys.readouterr().out
    assert sum(block.count for block in read_log(log, 1)) == 20 and not read_log(log, 2)
    log.write_text(log.read_text() + "1,a,x,0,0,0,\n")
    with pytest.raises(InputError, match="line 6"):
        fuzz.run_fuzz(options)
