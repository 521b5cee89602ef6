"""Commands started as a terminal starts them."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]


def started(arguments: Sequence[str]) -> subprocess.Popen[str]:
    """`stillbed` with the given arguments; Ctrl-C reaches it, also where whoever runs the tests ignores it."""
    return subprocess.Popen(
        [sys.executable, "-m", "hardware.cli.main", *arguments],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def spoken(run: subprocess.Popen[str]) -> str:
    """The next line that a command says on standard error, but that it loads."""
    assert run.stderr is not None
    line = run.stderr.readline()
    return spoken(run) if line.endswith(": loading\n") else line
