"""The folder or file a command writes to: new or empty, unless the user insists."""

from __future__ import annotations

from pathlib import Path

from estimation.errors import InputError


def prepare_out(out: Path, force: bool) -> None:
    """Make the folder `out`; raises InputError where it is a file, or holds something and `force` is not set."""
    if out.exists() and not out.is_dir():
        raise InputError(out, "--out", "a file", "a folder, new or empty")
    check_new(out, force)
    out.mkdir(parents=True, exist_ok=True)


def check_new(out: Path, force: bool) -> None:
    """InputError where `out` is a file, or a folder that holds something, and `force` is not set."""
    if out.is_dir() and any(out.iterdir()) and not force:
        raise InputError(out, "--out", "a folder that is not empty", "a new or empty one, or --force")
    if out.exists() and not out.is_dir() and not force:
        raise InputError(out, "--out", "a file that exists", "a new one, or --force")
