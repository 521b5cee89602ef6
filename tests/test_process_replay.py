"""The reference recordings: what is kept of them comes again, and a change is found, told, and taken by one command."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests import process_replay, reference_cases
from tests.pinned import ENVIRONMENT, PACKAGES, made_with, run_pinned, unlike
from tests.reference_cases import CASES, FOLDER, Arrays, kept, recorded_tracks, replayed
from tests.reference_signals import changes, differing


@pytest.fixture(scope="module")
def now() -> Arrays:
    """What comes of a recording in whatever arithmetic this machine has."""
    return replayed("outage")


def test_references_are_small() -> None:
    assert sum(file.stat().st_size for file in FOLDER.rglob("*") if file.is_file()) < 700_000


def test_another_arithmetic_changes_nothing_but_the_last_digits(now: Arrays) -> None:
    before = kept("outage")
    other = differing(before, now)
    assert process_replay.passes("outage", other, changes(before, now), ["another kind of processor"])


def test_the_recording_shows_what_it_is_there_for(now: Arrays) -> None:
    assert {"TRACKING", "DEGRADED", "COASTING"} <= set(now["pose state"].tolist())
    assert now["tick extrude"].any() and (now["tick checkpoint"] < 0).any()
    assert len(recorded_tracks("outage")) == len(now["pose stamp"])


@pytest.mark.parametrize("case", CASES)
def test_one_bit_of_what_is_kept_is_found(case: str) -> None:
    before = kept(case)
    for name in before:
        after = {key: array.copy() for key, array in before.items()}
        row = len(after[name]) // 2
        if after[name].dtype.kind == "U":
            after[name][row] = "LOST" if name == "pose state" else "?"
        else:
            after[name].view(np.uint8).reshape(len(after[name]), -1)[row, 0] ^= 1
        assert set(differing(before, after)) == {name}
        if case != "pictures":
            found = changes(before, after) if "stamp" not in name else []
            assert not process_replay.passes(case, differing(before, after), found, [])


def test_what_rounding_cannot_do_is_no_rounding() -> None:
    before = kept("outage")
    for name, by in (("pose base_from_surface", 1e-3), ("pose twist", 0.1), ("tick axes", 1e-3), ("tick feed", 0.1)):
        after = before | {name: before[name] + by}
        assert not process_replay.passes("outage", differing(before, after), changes(before, after), ["another kind"])
    fewer = {name: array[:-1] if name.startswith("tick") else array for name, array in before.items()}
    assert not process_replay.passes("outage", differing(before, fewer), changes(before, fewer), ["another kind"])
    never = before | {"tick extrude": np.zeros_like(before["tick extrude"])}
    assert not process_replay.passes("outage", differing(before, never), changes(before, never), ["another kind"])


def test_a_change_is_told_with_a_picture_and_taken_by_one_command(
    tmp_path: Path, now: Arrays, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "outage").mkdir()
    for module in (process_replay, reference_cases):
        monkeypatch.setattr(module, "FOLDER", tmp_path)
    monkeypatch.setattr(process_replay, "ROOT", tmp_path)
    monkeypatch.setattr(process_replay, "MADE_WITH", tmp_path / "made_with.json")
    monkeypatch.setattr(process_replay, "PAGE", tmp_path / "out" / "references.html")
    monkeypatch.setattr(process_replay, "replayed", lambda case: now)
    assert process_replay.main(["--case", "outage"]) == 1 and "nothing is kept of it yet" in capsys.readouterr().out
    assert process_replay.main(["--case", "outage", "--update"]) == 0
    assert process_replay.main(["--case", "outage"]) == 0 and not process_replay.PAGE.exists()
    lower = now["tick axes"].copy()
    lower[100:, 2] -= 0.25
    monkeypatch.setattr(process_replay, "replayed", lambda case: now | {"tick axes": lower})
    capsys.readouterr()
    assert process_replay.main(["--case", "outage"]) == 1
    said, page = capsys.readouterr().out, process_replay.PAGE.read_text(encoding="utf-8")
    assert "axis Z by up to 0.25 mm from 2.000 s on" in said and "make references" in said
    assert "change of axis Z, mm" in page and "change of axis X" not in page
    assert process_replay.main(["--case", "outage", "--update"]) == 0
    assert process_replay.main(["--case", "outage"]) == 0


def test_bits_are_asked_for_only_where_the_same_libraries_run(monkeypatch: pytest.MonkeyPatch) -> None:
    made = json.loads((FOLDER / "made_with.json").read_text(encoding="utf-8"))
    assert set(made) == set(made_with()) >= set(PACKAGES)
    assert unlike(made_with() | {"numpy": "1.0"})[-1].endswith("not 1.0")
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert unlike(made_with())[0] == "the processor is aarch64, not x86_64"


def test_the_environment_reaches_the_libraries() -> None:
    asked = "import numpy; from numpy._core._multiarray_umath import __cpu_features__ as f; print(f['X86_V4'])"
    asked += "; import numba; print(numba.config.CPU_NAME)"
    environment = {**os.environ, **ENVIRONMENT}
    done = subprocess.run([sys.executable, "-c", asked], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "haswell"]


@pytest.mark.slow
def test_a_constant_that_is_another_one_by_a_billionth_is_found(capfd: pytest.CaptureFixture[str]) -> None:
    if reasons := unlike(json.loads((FOLDER / "made_with.json").read_text(encoding="utf-8"))):
        pytest.skip("; ".join(reasons))
    changed = "import estimation.online.estimator as e\ne.PERSISTS *= 1 + 1e-9"
    assert run_pinned("tests.process_replay", ["--case", "outage"]) == 0
    assert run_pinned("tests.process_replay", ["--case", "outage"], changed) == 1
    assert "CHANGED" in capfd.readouterr().out
