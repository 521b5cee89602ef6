"""The files that stand beside a recording: what the run used, how far it came, where the path lies, and its report.

run.session.toml     what the run was told, with whole paths
run.progress.toml    how far the print is
run.surface.toml     where the path lies on the surface, and which recording shows that surface to a run that resumes
run.report.html, run.summary.json
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process import checks


@dataclass(frozen=True, slots=True)
class Beside:
    """Names of the files beside a recording."""

    record: Path

    @property
    def session(self) -> Path:
        """What the run was told."""
        return self._named("session.toml")

    @property
    def progress(self) -> Path:
        """How far the print is."""
        return self._named("progress.toml")

    @property
    def surface(self) -> Path:
        """Where the path lies."""
        return self._named("surface.toml")

    @property
    def executed(self) -> Path:
        """Of a virtual arm: where it was, each millisecond."""
        return self._named("executed.npz")

    @property
    def report(self) -> Path:
        """The page."""
        return self._named("report.html")

    @property
    def summary(self) -> Path:
        """Its figures."""
        return self._named("summary.json")

    def next(self) -> Beside:
        """The recording of the run that resumes this one: the next name that is free."""
        named = re.fullmatch(r"(.+)-([0-9]+)", self.record.stem)
        stem, number = (named[1], int(named[2]) + 1) if named else (self.record.stem, 2)
        while (file := self.record.with_name(f"{stem}-{number}.mcap")).exists():
            number += 1
        return Beside(file)

    def _named(self, end: str) -> Path:
        return self.record.with_name(f"{self.record.stem}.{end}")


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Where a path lies on a surface that was found. map: recording whose first sets, up to `until`, s, show it.

    surface_from_path, arm_from_base: (4, 4) mm.
    """

    map: Path
    until: float
    surface_from_path: Array
    arm_from_base: Array


def write_found(file: Path, found: Found) -> None:
    """Write beside the file and rename: there is always one that can be read, or none."""
    lines = [
        f'map = "{found.map.resolve()}"',
        f"until_s = {checks.toml_number(found.until)}",
        f"surface_from_path = {checks.toml_numbers(found.surface_from_path)}",
        f"arm_from_base = {checks.toml_numbers(found.arm_from_base)}",
    ]
    beside = file.with_name(file.name + ".new")
    beside.write_text("\n".join(lines) + "\n", encoding="utf-8")
    beside.replace(file)


def read_found(file: Path) -> Found:
    """What an earlier run found; InputError where that makes no sense."""
    table = checks.read_toml(file)
    checks.check_keys(file, "", table, ("map", "until_s", "surface_from_path", "arm_from_base"))
    poses = [checks.numbers(file, key, table[key], (4, 4)) for key in ("surface_from_path", "arm_from_base")]
    for key, pose in zip(("surface_from_path", "arm_from_base"), poses, strict=True):
        if not se3.is_transform(np.asarray(pose)):
            raise InputError(file, key, pose.tolist(), "a finite 4x4 rigid motion, mm")
    recording = Path(checks.text(file, "map", table["map"]))
    try:
        there = recording.exists()
    except OSError:  # a name that no file can have
        there = False
    if not there:
        raise InputError(file, "map", recording, "the recording that shows the surface")
    return Found(recording, checks.number(file, "until_s", table["until_s"]), poses[0], poses[1])
