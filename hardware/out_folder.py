"""The folder or file a command writes to: new or empty, unless the user insists; and what one that was ended left."""

from __future__ import annotations

from pathlib import Path

from estimation.errors import InputError

NAMED = 20  # files of an interrupted command that are told by name; of more, the count is


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


def kept(out: Path | None) -> str:
    """What an interrupted command left behind, in words; None where it was to write nothing."""
    if out is None:
        return "nothing was to be written"
    if out.is_dir():
        names = sorted(file.name for file in out.iterdir())
        if len(names) > NAMED:
            return f"kept in {out}: {len(names)} files"
        return f"kept in {out}: {', '.join(names)}" if names else f"nothing was written to {out}"
    if out.suffix == ".csv" and out.exists():
        return f"kept {out}, whole, and what stands beside it"
    if out.suffix == ".mcap" and out.exists():
        return f"kept {out}, readable up to its last whole chunk"
    return f"kept {out}" if out.exists() else "nothing was written"
