"""What is said of the pins: known vulnerabilities and what mends them, never "none" where nobody was asked."""

from __future__ import annotations

import json

import pytest

from tests.audit import NOBODY, NONE, SOME, main, told

GOOD = {"name": "numpy", "version": "2.4.6", "vulns": []}
BAD = {"name": "aiohttp", "version": "3.0", "vulns": [{"id": "PYSEC-1", "fix_versions": ["3.1"], "aliases": []}]}
LEFT = {"name": "gtsam", "skip_reason": "not found on PyPI"}


def answer(*dependencies: object) -> str:
    return json.dumps({"dependencies": dependencies, "fixes": []})


def test_each_known_vulnerability_is_listed_with_what_mends_it() -> None:
    code, words = told(answer(GOOD, BAD, LEFT), "")
    assert code == SOME
    assert words.splitlines() == [
        "aiohttp 3.0: PYSEC-1, mended in 3.1",
        "gtsam: not checked: not found on PyPI",
        "1 known vulnerabilities in 2 pins of constraints.txt",
    ]
    assert told(answer(GOOD), "")[0] == NONE


@pytest.mark.parametrize(
    ("said", "trouble"),
    [("", "ERROR: Connection refused"), ("{}", ""), ("[]", ""), (answer(), ""), (answer(LEFT), "")],
)
def test_where_nobody_could_be_asked_nothing_is_said_to_be_well(said: str, trouble: str) -> None:
    code, words = told(said, trouble)
    assert code == NOBODY and "nothing was checked" in words and trouble in words


def test_a_program_that_is_not_there_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main("/nowhere/pip-audit") == NOBODY
    assert "nothing was checked" in capsys.readouterr().out
