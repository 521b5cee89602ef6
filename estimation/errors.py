"""The errors that reach a user: one root, and wrong input that says where, what, got, allowed."""

from __future__ import annotations


class StillbedError(Exception):
    """Root of every error that stillbed raises on purpose; the command line prints it in one line, exit code 2."""


class InputError(StillbedError):
    """Wrong input: the file it stands in, the key, the value that was read and what is allowed."""

    def __init__(self, where: object, what: str, got: object, allowed: str) -> None:
        self.where, self.what, self.got, self.allowed = str(where), what, got, allowed
        super().__init__(f"{self.where}: {what} = {_short(got)}, allowed {allowed}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, object, str]]:
        """Pickled by its parts, so that it survives the way back from a worker process."""
        return type(self), (self.where, self.what, self.got, self.allowed)


def _short(value: object) -> str:
    text = repr(value) if isinstance(value, str) else str(value)
    text = " ".join(text.split())
    return text if len(text) <= 120 else text[:117] + "..."
