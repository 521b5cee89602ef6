"""What a flood of the page came to, counted in one process and read in another."""

from __future__ import annotations

from multiprocessing.sharedctypes import RawArray
from typing import Any


class FloodCount:
    """How much was said and what came of it, where both processes see it."""

    def __init__(self) -> None:
        self._memory: Any = RawArray("Q", 3)

    def add(self, messages: int = 0, closed: int = 0, refused: int = 0) -> None:
        """Count messages that were sent, windows that were closed for it, and windows that were not let in."""
        for i, more in enumerate((messages, closed, refused)):
            self._memory[i] += more

    @property
    def messages(self) -> int:
        """That were sent."""
        return int(self._memory[0])

    @property
    def closed(self) -> int:
        """Windows that were closed because of what they said."""
        return int(self._memory[1])

    @property
    def refused(self) -> int:
        """Windows that were not let in."""
        return int(self._memory[2])

    def __str__(self) -> str:
        messages, closed, refused = self._memory
        return f"{messages} messages sent, {closed} windows closed for it, {refused} not let in"
