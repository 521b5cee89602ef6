"""When, where, with what and by whom something was made: said in every recording, report and summary."""

from __future__ import annotations

import hashlib
import platform
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from hardware.process.clock import utc_now

HASHED_AT_ONCE = 2**20  # bytes
SHOWN_DIGITS = 12  # of a hash, in a text for people


@dataclass(frozen=True, slots=True)
class Provenance:
    """What made something.

    inputs: SHA-256 of each file that went in, by its name; "" where the file cannot be read.
    """

    started: str  # UTC, ISO 8601
    version: str  # of stillbed
    commit: str  # of the code, with a + where files differ from it; "" of an installed package
    host: str
    operator: str = ""
    inputs: Mapping[str, str] = field(default_factory=dict)

    def table(self) -> dict[str, object]:
        """As part of a summary."""
        return {
            "started_utc": self.started,
            "stillbed": self.version,
            "commit": self.commit,
            "host": self.host,
            "operator": self.operator,
            "inputs_sha256": dict(self.inputs),
        }

    def texts(self) -> dict[str, str]:
        """As the metadata of a recording."""
        own = {key: value for key, value in self.table().items() if isinstance(value, str)}
        return own | {f"sha256 {name}": value for name, value in self.inputs.items()}

    def sentence(self) -> str:
        """As the last line of a report."""
        code = f"stillbed {self.version}" + (f", commit {self.commit}" if self.commit else "")
        who = f" by {self.operator}" if self.operator else ""
        files = ", ".join(f"{name} {value[:SHOWN_DIGITS] or '?'}" for name, value in self.inputs.items())
        return f"{self.started} on {self.host}{who} · {code}" + (f" · SHA-256 of {files}" if files else "")


class _Process:
    """What this process makes things of: stated once, at its start; the files are read when it is first asked for."""

    def __init__(self) -> None:
        self.state((), "")

    def state(self, files: Iterable[Path | None], operator: str) -> None:
        self._files = [file for file in files if file is not None]
        self._operator, self._began = operator, utc_now()
        self._known: Provenance | None = None

    def provenance(self) -> Provenance:
        if self._known is None:
            inputs: dict[str, str] = {}
            for file in self._files:
                inputs[file.name if file.name not in inputs else str(file)] = file_hash(file)
            started = datetime.fromtimestamp(self._began, UTC).isoformat(timespec="seconds")
            host = platform.node()
            self._known = Provenance(started, stillbed_version(), code_commit(), host, self._operator, inputs)
        return self._known


_PROCESS = _Process()


def state_inputs(files: Iterable[Path | None], operator: str = "") -> None:
    """Say of what this process makes things from now on: files, and folders by the files in them; and for whom."""
    _PROCESS.state(files, operator)


def provenance() -> Provenance:
    """What makes the things that this process makes."""
    return _PROCESS.provenance()


def file_hash(file: Path) -> str:
    """SHA-256 of a file, or of names and contents of all files in a folder, in order; "" where one is unreadable."""
    whole = hashlib.sha256()
    try:
        for part in sorted(file.rglob("*")) if file.is_dir() else [file]:
            if file.is_dir():
                whole.update(f"{part.relative_to(file).as_posix()}\0".encode())
            if part.is_file():
                with part.open("rb") as stream:
                    while data := stream.read(HASHED_AT_ONCE):
                        whole.update(data)
    except OSError:
        return ""
    return whole.hexdigest()


def stillbed_version() -> str:
    """The version of the installed package; "" where it is not installed."""
    try:
        return version("stillbed")
    except PackageNotFoundError:
        return ""


@cache
def code_commit() -> str:
    """The commit of the code that runs, with a + where files differ from it; "" where it is no clone."""
    here, said = Path(__file__), ""
    known, named = ["ls-files", "--error-unmatch", here.name], ["describe", "--always", "--dirty=+", "--abbrev=12"]
    try:
        for question in (known, named):
            command = ["git", "-C", str(here.parent), *question]
            said = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):  # no git, an installed package, or one inside somebody else's clone
        return ""
    return said
