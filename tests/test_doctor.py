"""`stillbed doctor`: each thing that can be wrong with a machine is seen and comes with what to do."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from hardware.cameras.identity import Device
from hardware.cli import doctor as devices
from hardware.cli.main import main
from hardware.doctor import libraries, machine
from hardware.doctor.libraries import REMEDY, Trouble, failures, library_checks
from hardware.operator.view import Check, Verdict
from hardware.process.clock import SimClock

WORDS = "libGL.so.1", "signal 4", "hangs: not loaded after 2 s", "still loading after 2 s"
PASS, WARN, FAIL = Verdict.PASS, Verdict.WARN, Verdict.FAIL


def test_here_everything_needed_works_and_is_told_in_words_and_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    names = {check["name"] for check in told["libraries"]}
    assert {"gtsam", "toppra", "ruckig", "opencv-python-headless", "onnxruntime"} <= names and "pytest" not in names
    assert {check["verdict"] for check in told["libraries"]} == {"pass"}
    network = next(check for check in told["devices"] if check["name"] == "wound network")
    assert network["verdict"] == "pass"
    assert all(check["remedy"] for part in told.values() for check in part if check["verdict"] != "pass")


def test_a_folder_that_is_not_there_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--folder", str(tmp_path / "none")]) == 2
    assert "--folder" in capsys.readouterr().err


def test_each_library_that_fails_is_named_however_it_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lacks_file.py").write_text("raise ImportError('libGL.so.1: cannot open shared object file')\n")
    (tmp_path / "dies.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGILL)\n")
    (tmp_path / "hangs.py").write_text("import threading\nthreading.Event().wait()\n")
    (tmp_path / "works.py").write_text("while True:\n    pass\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    found = failures(["json", "lacks_file", "dies", "csv", "hangs", "re", "works"], patience=2)
    assert list(found) == ["lacks_file", "dies", "hangs", "works"]
    reasons = [trouble.reason for trouble in found.values()]
    assert all(word in reason for word, reason in zip(WORDS, reasons, strict=True))
    assert [trouble.slow for trouble in found.values()] == [False, False, False, True]


def test_a_library_that_is_only_slow_is_no_failure() -> None:
    busy = libraries._check("numpy", "numpy", {"numpy": Trouble("still loading after 60 s", slow=True)})
    assert busy.verdict is WARN and busy.remedy


def test_a_library_that_is_not_installed_fails_with_a_remedy() -> None:
    (check,) = library_checks(["no-such-library"])
    assert check == Check("no-such-library", FAIL, "not installed", REMEDY)


def system(root: Path, flags: str, free_kb: int) -> Path:
    (root / "proc").mkdir()
    (root / "proc/cpuinfo").write_text(f"processor : 0\nflags\t\t: {flags}\n")
    (root / "proc/meminfo").write_text(f"MemTotal: 9 kB\nMemAvailable:   {free_kb} kB\n")
    return root


def test_a_processor_without_its_instructions_and_little_memory_are_warnings(tmp_path: Path) -> None:
    root = system(tmp_path, "fpu sse2 avx2", 3_900_000)
    check = machine.processor_check(root)
    assert check.verdict is WARN and "without fma" in check.found
    assert machine.memory_check(root).verdict is WARN and "3.9 GB" in machine.memory_check(root).found
    (root / "proc/meminfo").write_text("MemAvailable: 4100000 kB\n")
    assert machine.memory_check(root).verdict is PASS
    assert machine.memory_check(root / "nothing").verdict is WARN


def test_an_old_python_fails() -> None:
    assert machine.python_check((3, 10, 4)).verdict is FAIL
    assert machine.python_check((3, 11, 0)).verdict is not FAIL


@pytest.mark.parametrize(("free", "verdict"), [(0.9, FAIL), (9.0, WARN), (11.0, PASS)])
def test_the_disk_is_judged_by_what_is_free(free: float, verdict: Verdict, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_room", lambda folder: free)
    assert machine.disk_check(Path()).verdict is verdict
    assert machine.shared_check().verdict is PASS


def test_a_cache_that_cannot_be_written_is_a_warning_and_one_that_can_is_left_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    check = machine.cache_check(tmp_path / "file" / ".cache" / "stillbed")
    assert check.verdict is WARN and "not a directory" in check.found and "XDG_CACHE_HOME" in check.remedy
    assert machine.cache_check(Path("/proc/stillbed")).verdict is WARN
    assert machine.cache_check(tmp_path / "new" / "stillbed").verdict is PASS
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_little_shared_memory_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_room", lambda folder: 0.064 if folder.name == "shm" else 99.0)
    (tmp_path / "dev/shm").mkdir(parents=True)
    check = machine.shared_check(tmp_path)
    assert check.verdict is FAIL and "64 MB" in check.found and "shm-size" in check.remedy


class Late(SimClock):
    """A clock whose sleep takes as much longer as is said."""

    def __init__(self, late: float) -> None:
        super().__init__()
        self.late = late

    def wait_until(self, instant: float) -> None:
        super().wait_until(instant + self.late)


@pytest.mark.parametrize(("late", "verdict"), [(0.0005, PASS), (0.0025, WARN)])
def test_a_machine_that_wakes_late_is_a_warning(late: float, verdict: Verdict) -> None:
    assert machine.punctuality_check(Late(late)).verdict is verdict


def test_an_address_that_nobody_may_listen_on_fails() -> None:
    assert machine.loopback_check("192.0.2.1").verdict is FAIL  # RFC 5737: never anybody's
    assert machine.loopback_check().verdict is PASS


def test_what_is_plugged_in_but_closed_to_this_user_says_which_group_to_join(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = tmp_path / "video0"
    node.touch()
    seen = (Device(node, "a webcam", "", "", ""),)
    assert devices.camera_check(seen) == Check("cameras", PASS, "a webcam")
    ports = [(str(node), "an adapter")]
    assert devices.arm_check(ports).verdict is PASS
    monkeypatch.setattr(devices.os, "access", lambda *_: False)
    for check, group in ((devices.camera_check(seen), "video"), (devices.arm_check(ports), "dialout")):
        assert check.verdict is FAIL and str(node) in check.found and group in check.remedy
    assert devices.lock_check(tmp_path).verdict is FAIL


def test_nothing_plugged_in_is_a_warning_with_what_to_do() -> None:
    for check in (devices.camera_check(()), devices.arm_check([])):
        assert check.verdict is WARN and "plug" in check.remedy


def test_a_network_that_is_damaged_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    damaged = tmp_path / "wound.onnx"
    damaged.write_bytes(b"\x00" * 100)
    damaged.with_suffix(".toml").write_text('sha256 = "00"\n')
    monkeypatch.setattr(devices, "shipped", lambda: damaged)
    check = devices.network_check()
    assert check.verdict is FAIL and "sha256" in check.found
