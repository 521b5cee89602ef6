"""docs/hazards.md from data/hazards.toml, the pinned versions, and the tests that prove each control.

python -m tests.hazard_table            writes docs/hazards.md
python -m tests.hazard_table --run      runs all named tests first; writes nothing if one fails
python -m tests.hazard_table --check    prints the tests that failed in their last run here; exit code 1 if any did
"""

from __future__ import annotations

import ast
import json
import re
import sys
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
DATA, DOCUMENT = ROOT / "data" / "hazards.toml", ROOT / "docs" / "hazards.md"
LAST_FAILED = ROOT / ".pytest_cache" / "v" / "cache" / "lastfailed"
KEYS = {"id", "hazard", "cause", "control", "tests", "figure", "command"}
OPENING = """# Hazards

A stop by software is not a safety function, and neither is any other control on this page: the software runs on an
ordinary computer that may hang, and nobody has assessed it. An arm near a patient needs an emergency stop in hardware
that disconnects its power, within reach of a person who watches. This is research software, not a medical device.

[deceptions.md](deceptions.md) shows what can mislead the tracker, how often it does, and what three cameras cannot
detect.

`make hazards` runs the tests named here and writes this page from `data/hazards.toml`. `make check` fails if one of the
tests does not exist, may be skipped, or failed in its last run on the machine, or if this page differs from that file.

| | hazard | cause | control | proved by | figure |
|---|---|---|---|---|---|
"""
PARTS = """
## Parts by others

The libraries that stillbed loads at run time, in the versions that were tested together (`constraints.txt`):

{parts}.

| part | known fault | why it does no harm here |
|---|---|---|
"""


@dataclass(frozen=True)
class Hazard:
    """One hazard. tests: pytest's names of the tests that prove its control. command: measures its figure."""

    id: str
    hazard: str
    cause: str
    control: str
    tests: tuple[str, ...]
    figure: str
    command: str


def hazards() -> list[Hazard]:
    """All of them, in the file's order; ValueError for one that lacks a word or says one too many."""
    found = []
    for table in tomllib.loads(DATA.read_text(encoding="utf-8"))["hazard"]:
        if table.keys() != KEYS:
            raise ValueError(f"{DATA.name}: {table.get('id')}: {sorted(table.keys() ^ KEYS)}")
        found.append(Hazard(**{**table, "tests": tuple(table["tests"])}))
    return found


def document() -> str:
    """The page."""
    rows = "".join(_row(each) for each in hazards())
    anomalies = tomllib.loads(DATA.read_text(encoding="utf-8"))["anomaly"]
    told = "".join(f"| {a['part']} {versions()[a['part']]} | {a['known']} | {a['matters']} |\n" for a in anomalies)
    parts = ", ".join(f"{name} {version}" for name, version in versions().items())
    return OPENING + rows + PARTS.format(parts=parts) + told


def _row(one: Hazard) -> str:
    tests = "<br>".join(f"`{name.removeprefix('tests/')}`" for name in one.tests)
    figure = f"{one.figure}: `{one.command}`" if one.command else ""
    return f"| {one.id} | {one.hazard} | {one.cause} | {one.control} | {tests} | {figure} |\n"


def versions() -> dict[str, str]:
    """The version of each library that is needed at run time, as it is pinned."""
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    pinned = dict(re.findall(r"^([\w.-]+)==(\S+)", text, re.MULTILINE))
    by_name = {name.lower().replace("_", "-"): version for name, version in pinned.items()}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = [re.split(r"[<>=\[; ]", line)[0] for line in project["dependencies"]]
    return {name: by_name[name.lower().replace("_", "-")] for name in names}


def missing(names: Iterable[str], root: Path = ROOT) -> list[str]:
    """Those of pytest's names that stand for no test, or for one that is skipped or expected to fail whatever comes."""
    return [name for name in names if not _is_test(*name.split("::"), root)]


def _is_test(file: str, function: str, root: Path) -> bool:
    if not (root / file).is_file():
        return False
    marks = _functions(root / file).get(function)
    return marks is not None and not marks & {"pytest.mark.skip", "pytest.mark.xfail"}


def only_slow(names: Sequence[str], root: Path = ROOT) -> list[str]:
    """The names, where none of their tests runs in `make test`: all are marked as slow."""
    marks = [_functions(root / file).get(function, set()) for file, function in (name.split("::") for name in names)]
    return list(names) if all("pytest.mark.slow" in each for each in marks) else []


@cache
def _functions(path: Path) -> dict[str, set[str]]:
    """The functions of a file, and what each is marked with."""
    nodes = ast.parse(path.read_text(encoding="utf-8")).body
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    return {node.name: {ast.unparse(each).split("(")[0] for each in node.decorator_list} for node in functions}


def failed(names: Iterable[str], cache: Path = LAST_FAILED) -> list[str]:
    """Those that failed when they last ran here, as pytest remembers it; of one that never ran it knows nothing."""
    remembered = json.loads(cache.read_text(encoding="utf-8")) if cache.exists() else {}
    broken = {name.split("[")[0] for name in remembered}
    return [name for name in names if name in broken]


def main(arguments: list[str]) -> int:
    """Write the page; with --run, once its tests have passed. With --check, say which of them failed last."""
    names = [name for each in hazards() for name in each.tests]
    if "--check" in arguments:
        without = [
            (each.id, [*missing(each.tests), *failed(each.tests)] or only_slow(each.tests)) for each in hazards()
        ]
        broken = [f"{hazard}: {name}" for hazard, names in without for name in names]
        print("\n".join(["hazards without a passing test:", *broken]) if broken else "every hazard has its tests")
        return int(bool(broken))
    if "--run" in arguments:
        import pytest

        if code := pytest.main(["-o", "addopts=--strict-markers --strict-config", *dict.fromkeys(names)]):
            return int(code)
    DOCUMENT.write_text(document(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
