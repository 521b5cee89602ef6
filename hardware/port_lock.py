"""A lock on a port's name: two programs can never write to one arm, and a crash leaves nothing that must be cleaned up.

The file is where terminal programs look for theirs (LCK..NAME with the owner's process number in its first line, in the
folder for locks), so minicom and others respect it. What decides between two of ours is the kernel's lock on the open
file, which goes with its process, however that ends; a number left behind by a crash, or taken over by another process
since, stops nobody.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path

from estimation.errors import InputError

FOLDERS = ("/run/lock", "/var/lock")  # of the Filesystem Hierarchy Standard, new and old
OURS = "stillbed"


class PortLock:
    """Holds `url` from construction until `release`, or until the process ends. InputError where somebody has it."""

    def __init__(self, url: str, folder: Path | None = None) -> None:
        self.url = url
        path = (folder or lock_folder()) / f"LCK..{_name(url)}"
        try:
            self._file: int | None = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise InputError("arm", "port", url, f"a port whose lock {path} this user may write ({error})") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            owner = _owner(self._file)
            os.close(self._file)
            raise InputError("arm", "port", url, f"a port that is free; process {owner[0]} has it") from error
        process, whose = _owner(self._file)
        if process and whose != OURS and process != os.getpid() and _lives(process):
            os.close(self._file)
            raise InputError("arm", "port", url, f"a port that is free; process {process} has it by {path}")
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, f"{os.getpid():10d}\n{OURS}\n".encode(), 0)

    def release(self) -> None:
        """Let the port go; the file stays and says nothing, as removing it would race with the next owner."""
        if self._file is not None:
            os.ftruncate(self._file, 0)
            os.close(self._file)
        self._file = None


def lock_folder() -> Path:
    """Where locks are kept: the first usual place that can be written to."""
    usable = (Path(name) for name in FOLDERS if os.access(name, os.W_OK))
    return next(usable, Path(tempfile.gettempdir()))


def _name(url: str) -> str:
    """A file name for a port: of a device what it is called below /dev, whichever link it was reached by."""
    path = url if "://" in url else os.path.realpath(url).removeprefix("/dev/")
    return path.replace("/", "_").replace(":", "_")


def _owner(file: int) -> tuple[int, str]:
    """Process number, 0 if there is none, and the program that a lock file names."""
    words = os.pread(file, 100, 0).decode("ascii", "replace").split()
    number = int(words[0]) if words and words[0].isdigit() else 0
    return number, words[1] if len(words) > 1 else ""


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
