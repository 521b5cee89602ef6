"""What comes with stillbed is found from a clone and from an installation, under the names that the documents use."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from estimation.errors import InputError
from perception import package_data as shipped
from perception.package_data import named_path, shipped_file

ROOT = Path(__file__).parents[1]


def test_an_installation_carries_every_folder_of_data() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    carried = project["tool"]["setuptools"]["data-files"]
    assert carried == {
        f"share/stillbed/{f.name}": [f"data/{f.name}/*"] for f in (ROOT / "data").iterdir() if f.is_dir()
    }


def test_a_path_of_the_documents_leads_to_the_shipped_file_from_anywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert named_path("data/arms/s6h4d.toml").read_bytes() == (ROOT / "data/arms/s6h4d.toml").read_bytes()
    (tmp_path / "data/arms").mkdir(parents=True)
    (tmp_path / "data/arms/s6h4d.toml").write_text("mine")
    assert named_path("data/arms/s6h4d.toml").read_text() == "mine"
    for other in ("data/arms/none.toml", "arms/s6h4d.toml", "data", "/data/arms/s6h4d.toml"):
        assert named_path(other) == Path(other)


def test_an_installation_is_searched_where_there_is_no_clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shipped, "CLONE", tmp_path / "none")
    monkeypatch.setattr(shipped, "INSTALLED", ROOT / "data")
    monkeypatch.chdir(tmp_path)
    assert shipped_file("paths", "square_10mm.csv").is_file()
    assert named_path("data/paths/square_10mm.csv").is_file()
    monkeypatch.setattr(shipped, "INSTALLED", tmp_path)
    with pytest.raises(InputError, match="an installation with its data"):
        shipped_file("paths", "square_10mm.csv")
