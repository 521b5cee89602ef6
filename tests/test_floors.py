"""The house: imports go down only, each library is in the files that own it, and nothing lies beside the floors."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = {"estimation": 0, "perception": 1, "planning": 1, "hardware": 2}
OWNERS = {  # library: the files that may import it
    "aiohttp": ("hardware/operator/*.py", "hardware/viewing/server.py"),
    "cv2": (
        "perception/*.py",
        "hardware/bench/solve_pnp.py",  # OpenCV's own pose, to compare with
        "hardware/cameras/capture.py",  # VideoCapture: devices, streams, files
        "hardware/cameras/controls.py",  # its numbers for exposure, gain, focus, white balance
        "hardware/cameras/sheet.py",  # draws the preview
        "hardware/files/images.py",
        "hardware/simulator/*.py",
    ),
    "dask": ("hardware/smoothing/cluster.py",),
    "distributed": ("hardware/smoothing/cluster.py",),
    "gtsam": ("estimation/*.py",),
    "matplotlib": ("perception/training/*.py",),
    "mcap": (
        "hardware/mcap_index.py",
        "hardware/recording/mcap_file.py",
        "hardware/recording/recorder.py",
        "hardware/recording/session_reader.py",
        "hardware/smoothing/recording_copy.py",
    ),
    "numba": ("estimation/runtime.py",),
    "onnx": ("perception/training/*.py",),
    "onnxruntime": ("perception/*.py",),
    "orjson": ("hardware/recording/recorder.py",),
    "packaging": ("hardware/doctor/libraries.py",),
    "pycolmap": ("hardware/bench/bundle_adjustment.py",),
    "pytest": ("estimation/synthetic/plugin.py",),
    "ruckig": ("planning/*.py",),
    "serial": ("hardware/*.py",),
    "shapely": (
        "hardware/bench/wounds.py",
        "hardware/plan/layer_picture.py",
        "planning/fill/*.py",
        "planning/layers/*.py",
    ),
    "time": ("hardware/process/clock.py",),
    "toppra": ("planning/*.py",),
    "torch": ("perception/training/*.py",),
    "yaml": ("hardware/calibration/formats/*.py",),
}
ABSENT = {"time", "pytest"}  # the standard library's; and pytest loads its plugin itself
FREE = {"numpy", "scipy"}  # arrays are everywhere
ALLOWED = {*FLOORS, "tests", "data", "docs", "pyproject.toml", "constraints.txt", "README.md", "LICENSE", "Makefile"}
ALLOWED |= {"CHANGELOG.md", "CITATION.cff"}
LEFTOVERS = ("build", "dist", "demo", "out", "__pycache__", "*.egg-info")  # .gitignore names them
MOTION_NEVER = {"gtsam", "numba", "cv2", "onnxruntime"}

FILES = sorted(path.relative_to(ROOT).as_posix() for floor in FLOORS for path in (ROOT / floor).rglob("*.py"))


@cache
def imported(path: Path) -> tuple[str, ...]:
    """Full names of the modules that a file imports anywhere, inside functions too."""
    return tuple(_imported(path))


def _imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield str(node.module)


def roots(file: str) -> set[str]:
    return {name.split(".")[0] for name in imported(ROOT / file)}


@pytest.mark.parametrize("file", FILES)
def test_imports_go_down_only(file: str) -> None:
    own = file.split("/")[0]
    for name in roots(file) & set(FLOORS):
        assert name == own or FLOORS[name] < FLOORS[own], f"{file} imports {name}"


@pytest.mark.parametrize("file", FILES)
def test_each_library_is_imported_only_by_its_owners(file: str) -> None:
    for name in roots(file) & set(OWNERS):
        assert any(fnmatch(file, pattern) for pattern in OWNERS[name]), f"{file} imports {name}"


@pytest.mark.parametrize("file", FILES)
def test_every_other_import_is_numpy_scipy_or_the_standard_library(file: str) -> None:
    assert roots(file) <= {*FLOORS, *OWNERS, *FREE, *sys.stdlib_module_names}


@pytest.mark.parametrize("file", FILES)
def test_files_can_be_held_in_the_head(file: str) -> None:
    assert len((ROOT / file).read_text(encoding="utf-8").splitlines()) <= 400


def test_every_dependency_is_imported_by_someone_and_declared() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    packages = {"opencv-python-headless": "cv2", "pyserial": "serial", "pyyaml": "yaml"}
    extras = [line for extra in ("bench", "cluster", "train") for line in project["optional-dependencies"][extra]]
    declared = {line.split(">")[0] for line in project["dependencies"] + extras}
    declared = {packages.get(name, name) for name in declared}
    assert set.union(*map(roots, FILES)) & {*OWNERS, *FREE} - ABSENT <= declared


def test_the_top_level_holds_the_floors_and_little_else() -> None:
    names = {path.name for path in ROOT.iterdir() if not path.name.startswith(".")}
    names = {name for name in names if not any(fnmatch(name, pattern) for pattern in LEFTOVERS)}
    assert names <= ALLOWED


def test_docs_and_data_hold_nothing_importable() -> None:
    found = {path for folder in ("docs", "data") for path in (ROOT / folder).rglob("*.py")}
    assert found == set((ROOT / "docs/examples").glob("*.py"))  # which are programs to read and run


def test_examples_are_short_enough_to_read_at_once() -> None:
    for file in (ROOT / "docs/examples").glob("*.py"):
        assert len(file.read_text(encoding="utf-8").splitlines()) < 60, file.name


def test_the_motion_process_loads_none_of_the_heavy_libraries() -> None:
    modules = [file[:-3].replace("/", ".") for file in FILES if file.startswith("planning/")]
    code = f"import sys, hardware.motion.step, hardware.process.clock, {', '.join(modules)}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "planning.command" in loaded.stdout.split()
    assert MOTION_NEVER.isdisjoint(loaded.stdout.split())


def test_the_rules_above_can_fail(tmp_path: Path) -> None:
    bad = tmp_path / "bad.py"
    bad.write_text("def f():\n    import time\n    from hardware.cli.main import main\n")
    assert set(imported(bad)) == {"time", "hardware.cli.main"}
