"""The table of wrong edits fits the tree; what judges them tells a mutant that is killed from one that lives."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import pytest

from tests.hazard_table import missing
from tests.mutants import MUTANTS, ROOT, Mutant, Verdict, applies, edited, judge_all

TREE = {
    "arm.py": "LIMIT = 3\n\n\ndef may(jump):\n    return jump <= LIMIT\n",
    "tests/test_arm.py": "from arm import may\n\n\ndef test_more_is_refused():\n    assert may(3) and not may(4)\n",
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for file, text in TREE.items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text)
    return tmp_path


def mutant(old: str, new: str, test: str = "test_arm.py") -> Mutant:
    return Mutant(f"{old} becomes {new}", "arm.py", old, new, (test,))


@pytest.mark.parametrize("one", MUTANTS, ids=lambda one: one.name)
def test_each_edit_applies_to_one_place_and_changes_what_is_done(one: Mutant) -> None:
    assert applies(one)
    before = (ROOT / one.file).read_text(encoding="utf-8")
    assert done(before) != done(before.replace(one.old, one.new))


@cache
def done(text: str) -> str:
    """What a file does, whatever its comments and blank lines."""
    return ast.dump(ast.parse(text))


def test_each_names_tests_that_are_there_and_no_two_are_one() -> None:
    names = [f"tests/{test}" for one in MUTANTS for test in one.tests]
    assert missing(name for name in names if "::" in name) == []
    assert all((ROOT / name.split("::")[0]).is_file() for name in names)
    assert len({one.name for one in MUTANTS}) == len({(one.file, one.old) for one in MUTANTS}) == len(MUTANTS) >= 20


def test_an_edit_is_undone_to_the_last_bit(tree: Path) -> None:
    file = tree / "arm.py"
    stamp = file.stat().st_mtime_ns
    with edited(mutant("<=", "<"), tree):
        assert "jump < LIMIT" in file.read_text()
    assert file.read_text() == TREE["arm.py"] and file.stat().st_mtime_ns == stamp


@pytest.mark.slow  # a harness that judges wrongly shows in `make mutants`
def test_each_mutant_gets_its_verdict_and_the_tree_is_left_alone(tree: Path) -> None:
    verdicts = {
        mutant("<=", "<"): Verdict.KILLED,
        mutant("return jump <= LIMIT", "return LIMIT >= jump"): Verdict.SURVIVED,
        mutant("jump < LIMIT", ""): Verdict.STALE,
        mutant("jump", "hop"): Verdict.STALE,  # stands twice
        mutant("def may", "def def"): Verdict.NO_VERDICT,  # no test can begin
    }
    said: list[str] = []
    outcomes = judge_all(list(verdicts), tree, said.append)
    assert [each.verdict for each in outcomes] == list(verdicts.values())
    assert all(any(one.name in line for line in said) for one in verdicts)
    files = {path.relative_to(tree).as_posix(): path.read_text() for path in tree.rglob("*") if path.is_file()}
    assert files == TREE


def test_tests_that_fail_without_an_edit_judge_nothing(tree: Path) -> None:
    (tree / "tests/test_arm.py").write_text("def test_it():\n    assert False\n")
    with pytest.raises(RuntimeError, match="must pass without an edit"):
        judge_all([mutant("<=", "<")], tree)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_it_leaves_nothing_behind(tmp_path: Path, number: signal.Signals) -> None:
    """The command itself, while the tests run in its copy."""
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "tests.mutants", "adjoint"]
    process = subprocess.Popen(command, cwd=ROOT, env=environment, text=True, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None and "without an edit" in process.stdout.readline()
        until = time.monotonic() + 60
        while not list(tmp_path.glob("mutants-*/0/estimation")) and time.monotonic() < until:
            time.sleep(0.05)
        time.sleep(0.5)
        process.send_signal(number)
        assert process.wait(60) == 130 and "interrupted" in process.stdout.read()
    finally:
        process.kill()
        process.wait()
    assert list(tmp_path.glob("mutants-*")) == []
