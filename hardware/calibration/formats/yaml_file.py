"""YAML in and out, OpenCV's dialect included."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from estimation.errors import InputError
from hardware.process import checks
from hardware.process.checks import Table

SHORT = re.compile(r"^[-+]?\d+[eE][-+]?\d+$")  # 1e-10, which YAML 1.1 takes for a text
ND_MATRIX = "tag:yaml.org,2002:opencv-nd-matrix"
MATRIX = "tag:yaml.org,2002:opencv-matrix"


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # yaml ships no types
    """A safe loader that knows OpenCV's matrices."""


def _matrix(loader: _Loader, node: Any) -> Any:
    return loader.construct_mapping(node, deep=True)


def _nd_matrix(loader: _Loader, node: Any) -> Any:
    """OpenCV 5 writes vectors so: sizes instead of rows and cols."""
    found = loader.construct_mapping(node, deep=True)
    sizes = [1, *found.get("sizes", [])][-2:]
    return {"rows": sizes[0], "cols": sizes[1], "data": found.get("data")} if len(sizes) == 2 else found


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", SHORT, list("-+0123456789"))
_Loader.add_constructor(MATRIX, _matrix)
_Loader.add_constructor(ND_MATRIX, _nd_matrix)


def read_yaml(path: Path) -> Table:
    """The file's table; InputError where it is none."""
    text = checks.read_bytes(path).decode("utf-8", "replace")
    if text.startswith("%YAML"):  # OpenCV writes %YAML:1.0, which no YAML reader takes
        text = text.partition("\n")[2]
    try:
        table = yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # the last: brackets in brackets
        raise InputError(path, "file", " ".join(str(error).split())[:100], "a YAML file") from None
    if not isinstance(table, dict):
        raise InputError(path, "file", type(table).__name__, "a YAML table")
    return table


def write_yaml(path: Path, table: Table, head: str = "") -> None:
    """Write a table in its own order, numbers with all their digits."""
    path.write_text(head + yaml.safe_dump(table, sort_keys=False, default_flow_style=None), encoding="utf-8")
