"""What comes from outside is taken or refused with one of our errors, whatever is in it."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.bench import fuzz
from hardware.bench.fuzz import Fuzzed, figures, fuzzed
from hardware.bench.fuzz_readers import PATH, Reader, readers
from hardware.bench.mutate import mutated
from hardware.checks import read_toml
from hardware.faults import fault_from_text
from hardware.operator.words import parsed
from hardware.protocol import LENGTH, TAILS, FrameStream, decode

READERS = readers()


@pytest.mark.parametrize("name", READERS)
def test_every_reader_takes_or_refuses_what_is_nearly_valid(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    reader = READERS[name]
    result = fuzzed(name, reader, range(max(3, round(150 * reader.weight))), 7, tmp_path)
    assert not result.wrong


@pytest.mark.parametrize("number", [324, 549])  # a zip of a version, and of a compression, that nobody has
def test_a_file_of_corners_that_no_zip_reader_knows_holds_none(number: int, tmp_path: Path) -> None:
    assert not fuzzed("corners", READERS["corners"], range(number, number + 1), 1, tmp_path).wrong


@given(st.binary(max_size=200), st.integers(0, 2**32))
def test_what_is_made_wrong_is_the_same_each_time(data: bytes, seed: int) -> None:
    assert mutated(data, np.random.default_rng(seed)) == mutated(data, np.random.default_rng(seed))


@given(st.binary(max_size=300))
def test_bytes_of_any_kind_are_no_reason_to_fall(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    assert parsed(text) is None or b"turn" in data or b"shown" in data
    FrameStream(LENGTH, TAILS, decode)(data)
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
        time.sleep(0)
    return bytearray(8 << 30) if b"eat" in data else None


@pytest.mark.parametrize(("word", "said"), [("fall", "KeyError"), ("hang", "more than 0.2 s"), ("eat", "MemoryError")])
def test_a_reader_that_falls_hangs_or_eats_is_found(
    word: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzz, "SECONDS", 0.2)
    monkeypatch.setattr(fuzz, "mutated", lambda valid, rng: word.encode())
    reader = Reader("x.csv", lambda folder: (folder / "x.csv").write_text(PATH) and None, wrong_reader)
    result = fuzzed("x", reader, range(1), 1, tmp_path)
    assert len(result.wrong) == 1 and said in result.wrong[0] and result.cases == [word.encode()]


def test_the_figures_count_what_went_wrong() -> None:
    one, other = Fuzzed("a", 10, 4, 0.1, ["input 3: x"], [b"x"]), Fuzzed("b", 5, 5, 0.1)
    values = {figure.what: figure.value for figure in figures([one, other])}
    assert values["inputs"] == 15 and values["inputs that went wrong"] == 1
