"""Whether the libraries that stillbed stands on can be loaded here: each in a process that may die of it."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, packages_distributions, requires, version
from pathlib import Path

from packaging.requirements import Requirement

from hardware.operator.view import Check, Verdict

PATIENCE = 60.0  # s for all of them on a slow disk
LOADED = "loaded"  # the word by which the process tells of each
LOADER = f"""import importlib, sys
for name in sys.argv[1:]:
    importlib.import_module(name)
    print({LOADED!r}, name, flush=True)
"""
REMEDY = "make a new environment and `pip install .` there again, with constraints.txt"
SLOW_REMEDY = "ask again while less runs on this machine"
SYSTEM_REMEDY = "install the system's package that has this file: `apt-file search` with its name tells which"


@dataclass(frozen=True, slots=True)
class Trouble:
    """Why a module did not load. slow: it was still at it when the time was up, which says nothing against it."""

    reason: str
    slow: bool = False


def library_checks(names: list[str] | None = None) -> list[Check]:
    """A check for each library. names: of distributions; all that stillbed asks for without them."""
    if names is None:
        try:
            names = required()
        except PackageNotFoundError:
            return [Check("stillbed", Verdict.FAIL, "runs from its sources, not installed", "pip install .")]
    known = modules_of(names)
    failed = failures(list(known.values()))
    return [_check(name, known.get(name, ""), failed) for name in names]


def required() -> list[str]:
    """The distributions that this machine's stillbed needs, extras apart. PackageNotFoundError: it is not installed."""
    asked = [Requirement(line) for line in requires("stillbed") or []]
    return [one.name for one in asked if one.marker is None or one.marker.evaluate({"extra": ""})]


def modules_of(names: list[str]) -> dict[str, str]:
    """The module that each installed distribution is imported by: of several the one of its own name, or the first."""
    found: dict[str, list[str]] = {name: [] for name in names}
    for module, distributions in packages_distributions().items():
        for name in {one.lower() for one in distributions} & set(names):
            found[name].append(module)
    return {
        name: min(modules, key=lambda m: (m != name, m.startswith("_"))) for name, modules in found.items() if modules
    }


def failures(modules: list[str], patience: float = PATIENCE) -> dict[str, Trouble]:
    """Why modules did not load, by name. What kills or stops the process that loads it is named; the rest is tried.

    patience: s for all that one process loads.
    """
    found: dict[str, Trouble] = {}
    left = list(modules)
    while left:
        loaded, trouble = _tried(left, patience)
        left = left[loaded:]
        if left:
            found[left[0]] = trouble
            left = left[1:]
    return found


def _tried(modules: list[str], patience: float) -> tuple[int, Trouble]:
    """How many of the modules a process loaded before it ended, and why it went no further."""
    command = [sys.executable, "-c", LOADER, *modules]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            told, complaint = process.communicate(timeout=patience)
            trouble = Trouble(_reason(process.returncode, complaint))
        except subprocess.TimeoutExpired:
            trouble = _unfinished(process.pid, patience)
            process.kill()
            told, _ = process.communicate()
    return sum(line.startswith(LOADED) for line in told.splitlines()), trouble


def _unfinished(process: int, patience: float) -> Trouble:
    """Of a process that has not ended: slow where it computes, or waits for processor or disk; else it hangs."""
    state = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    if state in ("R", "D"):
        return Trouble(f"still loading after {patience:g} s", slow=True)
    return Trouble(f"hangs: not loaded after {patience:g} s, and waits for something")


def _reason(code: int, complaint: str) -> str:
    if code < 0:
        return f"signal {-code} ends the process that loads it: this processor may lack what it was built for"
    return (complaint.strip().splitlines() or [f"exit code {code}"])[-1]


def _check(name: str, module: str, failed: dict[str, Trouble]) -> Check:
    try:
        have = version(name)
    except PackageNotFoundError:
        return Check(name, Verdict.FAIL, "not installed", REMEDY)
    if module not in failed:
        return Check(name, Verdict.PASS, have)
    trouble = failed[module]
    if trouble.slow:
        return Check(name, Verdict.WARN, f"{have}: {trouble.reason}", SLOW_REMEDY)
    return Check(name, Verdict.FAIL, f"{have}: {trouble.reason}", SYSTEM_REMEDY if ".so" in trouble.reason else REMEDY)
