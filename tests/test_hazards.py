"""The table of hazards: it is what its file says, and every control has tests that are there."""

from __future__ import annotations

import json
from pathlib import Path

from hardware.bench.subjects import SUBJECTS
from tests.hazard_table import DOCUMENT, document, failed, hazards, missing


def test_the_page_is_what_the_file_says() -> None:
    assert DOCUMENT.read_text(encoding="utf-8") == document(), "make hazards writes it"


def test_every_hazard_has_a_control_and_tests_that_are_there() -> None:
    found = hazards()
    assert len({each.id for each in found}) == len(found)
    for each in found:
        assert all((each.hazard, each.cause, each.control, each.tests)), each.id
        assert not missing(each.tests), each.id


def test_every_figure_is_measured_by_a_subject_of_the_bench() -> None:
    for each in hazards():
        assert bool(each.figure) == bool(each.command), each.id
        if each.command:
            program, verb, subject = each.command.split()[:3]
            assert (program, verb) == ("stillbed", "bench") and subject in SUBJECTS, each.id


def test_a_test_that_is_not_there_or_skipped_or_failed_is_found(tmp_path: Path) -> None:
    (tmp_path / "tests").mkdir()
    skipped = "@pytest.mark.skip(reason='x')\ndef test_two() -> None: ...\n"
    (tmp_path / "tests" / "test_x.py").write_text(f"import pytest\n\n\ndef test_one() -> None: ...\n\n\n{skipped}")
    names = [f"tests/test_x.py::test_{name}" for name in ("one", "two", "no")]
    assert missing([*names, "tests/y.py::test_one"], tmp_path) == [*names[1:], "tests/y.py::test_one"]
    (tmp_path / "lastfailed").write_text(json.dumps({"tests/test_x.py::test_one[3]": True}))
    assert failed(names, tmp_path / "lastfailed") == names[:1]
    assert not failed(names, tmp_path / "none")
