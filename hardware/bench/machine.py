"""What figures were measured on and with: machine, commit, versions."""

from __future__ import annotations

import os
import platform
import subprocess
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

LIBRARIES = ("stillbed", "numpy", "scipy", "gtsam", "opencv-python-headless", "toppra", "ruckig")


@dataclass(frozen=True, slots=True)
class Machine:
    """cores: that this process may use. commit: of the code, with a + where files differ from it, '' if unknown."""

    cpu: str
    cores: int
    system: str
    commit: str
    versions: dict[str, str]


def this_machine() -> Machine:
    """What this process runs on and with."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    versions = {"python": platform.python_version(), **{name: _version(name) for name in LIBRARIES}}
    return Machine(_cpu(), cores, platform.platform(), _commit(), versions)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        lines = []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _commit() -> str:
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty=+", "--abbrev=12"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):  # no git, or an installed package
        return ""
    return done.stdout.strip()
