"""Commands that were started without standard streams: they do what they do, and say nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from hardware.live.console import Console
from tests.light_live import prepare_files
from tests.started import ROOT

SEEN = """
import os, sys
from hardware.cli import main as cli
cli._track = lambda a: print(sorted(os.listdir('/proc/self/fd')), file=open('seen', 'w'))
sys.exit(cli.main(['track', 'x', '-o', 'y']))
"""


def without(streams: Sequence[int], *command: str, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """A command that begins with these streams closed; what it says on the others."""
    closed = " ".join(f"{number}>&-" for number in streams)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    line = ["sh", "-c", f'exec "$0" "$@" {closed}', sys.executable, *command]
    return subprocess.run(line, cwd=folder, capture_output=True, text=True, timeout=200, env=environment)


@pytest.mark.parametrize("streams", [(0,), (1,), (2,), (0, 1), (0, 1, 2)])
def test_what_is_opened_takes_no_closed_streams_number(streams: tuple[int, ...], tmp_path: Path) -> None:
    done = without(streams, "-c", SEEN, folder=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert {"'0'", "'1'", "'2'", "'3'"} <= set((tmp_path / "seen").read_text().strip("[]\n").split(", "))


def test_a_wrong_command_line_is_exit_code_2_where_nobody_hears_it() -> None:
    done = without((0, 1, 2), "-m", "hardware.cli.main", "track", "nowhere", "-o", "nowhere")
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "")


def test_a_live_run_needs_no_standard_input(tmp_path: Path) -> None:
    prepare_files(tmp_path, lines=2, speed=10.0)
    done = without((0,), "-m", "tests.light_live", str(tmp_path), str(tmp_path / "x.mcap"), "--yes")
    assert done.returncode == 0 and "the path is printed" in done.stderr and "Traceback" not in done.stderr


def test_a_console_without_a_standard_input_waits_for_no_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    with Console() as console:
        assert console.file is None
