"""Python loads this before all else where its folder is on the path: a clock that has run for a given uptime."""

import os
import time

_clock = time.monotonic
_later = float(os.environ.get("STILLBED_TEST_UPTIME", "nan"))


def monotonic() -> float:
    """The machine's monotonic clock, s, as if the machine had been started so much earlier."""
    return _clock() + _later


if _later == _later:  # the first process tells all others when it began
    _begun = float(os.environ.setdefault("STILLBED_TEST_BEGUN", repr(_clock())))
    _later -= _begun
    time.monotonic = monotonic
