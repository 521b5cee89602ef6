"""Whether the libraries that stillbed stands on can be loaded here: each in a process that may die of it."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import PackageNotFoundError, packages_distributions, requires, version

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
SYSTEM_REMEDY = "sudo apt-get install -y libegl1 libgl1 libx11-6 libudev1 libusb-1.0-0 libidn2-0"


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


def failures(modules: list[str], patience: float = PATIENCE) -> dict[str, str]:
    """Why modules do not load, by name. What kills or stops the process that loads it is named; the rest is tried.

    patience: s for all that one process loads.
    """
    found: dict[str, str] = {}
    left = list(modules)
    while left:
        loaded, reason = _tried(left, patience)
        left = left[loaded:]
        if left:
            found[left[0]] = reason
            left = left[1:]
    return found


def _tried(modules: list[str], patience: float) -> tuple[int, str]:
    """How many of the modules a process loaded before it ended, and why it went no further."""
    command = [sys.executable, "-c", LOADER, *modules]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            told, complaint = process.communicate(timeout=patience)
            reason = _reason(process.returncode, complaint)
        except subprocess.TimeoutExpired:
            process.kill()
            told, _ = process.communicate()
            reason = f"takes longer than {patience:g} s to load"
    return sum(line.startswith(LOADED) for line in told.splitlines()), reason


def _reason(code: int, complaint: str) -> str:
    if code < 0:
        return f"signal {-code} ends the process that loads it: this processor may lack what it was built for"
    return (complaint.strip().splitlines() or [f"exit code {code}"])[-1]


def _check(name: str, module: str, failed: dict[str, str]) -> Check:
    try:
        have = version(name)
    except PackageNotFoundError:
        return Check(name, Verdict.FAIL, "not installed", REMEDY)
    if module not in failed:
        return Check(name, Verdict.PASS, have)
    reason = failed[module]
    return Check(name, Verdict.FAIL, f"{have}: {reason}", SYSTEM_REMEDY if ".so" in reason else REMEDY)
