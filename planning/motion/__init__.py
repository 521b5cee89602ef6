"""From checkpoints on a moving surface to one command a tick: re-timing, following, the guard."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

__all__ = ["curve", "guard", "planner", "retime"]
PLOTS = ("matplotlib", "matplotlib.pyplot")


@contextmanager
def plots_left_out() -> Iterator[None]:
    """Within it toppra is imported without pyplot, which takes 0.4 s of each process for plots that nobody asks for."""
    absent = [name for name in PLOTS if name not in sys.modules]
    sys.modules.update({name: ModuleType(name) for name in absent})
    try:
        yield
    finally:
        for name in absent:
            del sys.modules[name]
