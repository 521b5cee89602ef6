"""Bodies of processes whose parent is killed."""

from __future__ import annotations

import os
import time
from multiprocessing import parent_process
from multiprocessing.connection import wait
from pathlib import Path

from hardware.process.system import outlive_parent


class SlowToLoad:
    """An argument that takes half a second to be received, as one does that brings large libraries."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def __reduce__(self) -> tuple[object, ...]:
        return loaded, (str(self.folder),)

    def say(self, word: str) -> None:
        (self.folder / f"{word}.{os.getpid()}").touch()


def loaded(folder: str) -> SlowToLoad:
    made = SlowToLoad(folder)
    made.say("loading")
    time.sleep(2.0)
    return made


def work(told: SlowToLoad) -> None:
    """One long call that holds the interpreter."""
    told.say("works")
    sum(range(10**11))


def end_in_order(told: SlowToLoad) -> None:
    outlive_parent()
    told.say("works")
    parent = parent_process()
    assert parent is not None
    wait([parent.sentinel])
    told.say("ended")
