"""Whether this machine has what a live run wants: processor, memory, disk, shared memory, priority, punctuality."""

from __future__ import annotations

import platform
import shutil
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

from hardware.bench.machine import this_machine
from hardware.cache_folder import REMEDY, cache_trouble
from hardware.evenness import evenness
from hardware.lateness import Lateness
from hardware.operator.view import Check, Verdict
from hardware.process.clock import Clock

ROOT = Path("/")
CORES = 2  # one for tracking, one for motion, recorder and page
MEMORY = 4.0  # GB: a live run takes under 2, planning a large wound half a one
FREE = 1.0, 10.0  # GB: below, nothing can be recorded; below, not for long (a minute of three cameras takes 0.1 to 1)
SHARED = 0.1  # GB: pictures of three 1280x720 cameras go round between two processes, four sets deep
FLAGS = ("avx2", "fma")  # what compiled loops and networks are fast with
PERIOD, TICKS = 0.02, 50  # s; a second of the ticks that motion is sent by
PUNCTUAL = 2.0  # ms: a tenth of a tick
PIECES = 6000  # of work: two seconds or three, as what disturbs a machine comes every other second
EVEN = 0.005  # share of the time: once a minute for a third of a second
LIMITS = "as root: echo 'USER - rtprio 20' > /etc/security/limits.d/stillbed.conf, with your name; then log in anew"


def machine_checks(folder: Path, clock: Clock, root: Path = ROOT) -> list[Check]:
    """All of this. folder: where sessions would be recorded. root: of the file system."""
    return [
        python_check(),
        processor_check(root),
        memory_check(root),
        disk_check(folder),
        shared_check(root),
        priority_check(),
        punctuality_check(clock),
        evenness_check(clock),
        loopback_check(),
    ]


def python_check(found: tuple[int, ...] = sys.version_info[:3]) -> Check:
    """Python, by its version."""
    told = f"{'.'.join(map(str, found))} on {platform.system()} {platform.machine()}"
    if found < (3, 11):
        return Check("python", Verdict.FAIL, told, "install Python 3.11 or newer: make PYTHON=python3.12")
    if sys.platform != "linux":
        return Check("python", Verdict.WARN, told, "live runs are made for Linux; recordings and planning work here")
    return Check("python", Verdict.PASS, told)


def processor_check(root: Path = ROOT) -> Check:
    """Cores that this process may use, and the instructions that compiled loops are fast with."""
    machine = this_machine()
    told = f"{machine.cpu}, {machine.cores} cores"
    flags = _lines(root / "proc/cpuinfo", "flags")
    lacking = [name for name in FLAGS if flags and name not in flags[0].split()]
    if lacking:
        return Check("processor", Verdict.WARN, f"{told}, without {' and '.join(lacking)}", "poses will take longer")
    if machine.cores < CORES:
        remedy = "track recordings here, print on a machine with two cores"
        return Check("processor", Verdict.WARN, told, remedy)
    return Check("processor", Verdict.PASS, told)


def memory_check(root: Path = ROOT) -> Check:
    """Memory that programs may still take."""
    found = _lines(root / "proc/meminfo", "MemAvailable")
    if not found:
        return Check("memory", Verdict.WARN, "this system does not tell", f"have {MEMORY:g} GB free")
    free = int(found[0].split()[0]) / 1e6
    if free < MEMORY:
        return Check("memory", Verdict.WARN, f"{free:.1f} GB free", f"close programs until {MEMORY:g} GB are")
    return Check("memory", Verdict.PASS, f"{free:.1f} GB free")


def disk_check(folder: Path) -> Check:
    """Room for recordings."""
    free, told = _room(folder), f"free in {folder.resolve()}"
    verdict = Verdict.FAIL if free < FREE[0] else Verdict.WARN if free < FREE[1] else Verdict.PASS
    remedy = "" if verdict is Verdict.PASS else f"record where there are {FREE[1]:g} GB, or make room"
    return Check("disk", verdict, f"{free:.1f} GB {told}", remedy)


def cache_check(cache: Path) -> Check:
    """Whether pictures of a scenario can be kept, which `stillbed live --simulated` renders before it shows them."""
    if trouble := cache_trouble(cache):
        return Check("cache", Verdict.WARN, f"{cache} cannot be written: {trouble}", f"for simulated runs, {REMEDY}")
    return Check("cache", Verdict.PASS, f"kept in {cache}")


def shared_check(root: Path = ROOT) -> Check:
    """Room for the pictures that go from one process to another."""
    folder = root / "dev/shm"
    if not folder.is_dir():
        folder = Path(tempfile.gettempdir())
    free = _room(folder)
    if free < SHARED:
        remedy = "in a container: --shm-size 1g; elsewhere: mount -o remount,size=1g /dev/shm"
        return Check("shared memory", Verdict.FAIL, f"{1000 * free:.0f} MB free", remedy)
    return Check("shared memory", Verdict.PASS, f"{free:.1f} GB free")


def priority_check() -> Check:
    """The priority that the motion would be granted: asked for in another process, so that this one keeps its own."""
    ask = "from hardware.priority import ask_for_real_time; print(ask_for_real_time())"
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, timeout=20, check=False)
    told = done.stdout.strip() or "nothing was granted"
    if "nothing" in told:
        return Check("priority", Verdict.WARN, told, LIMITS)
    return Check("priority", Verdict.PASS, told)


def punctuality_check(clock: Clock, ticks: int = TICKS) -> Check:
    """How late this machine wakes a process that asked for a tick."""
    late = Lateness()
    begun = clock.now()
    for k in range(1, ticks + 1):
        clock.wait_until(begun + k * PERIOD)
        late.add(clock.now() - (begun + k * PERIOD))
    half, worst = (1000 * late.percentile(share) for share in (50, 98))
    told = f"{ticks} ticks of {1000 * PERIOD:g} ms: {half:.1f} ms late, {worst:.1f} at the worst"
    if worst > PUNCTUAL:
        return Check("clock", Verdict.WARN, told, "stop other work on this machine; let it not save power")
    return Check("clock", Verdict.PASS, told)


def evenness_check(clock: Clock, pieces: int = PIECES) -> Check:
    """Whether the same work takes the same time."""
    found = evenness(clock, pieces)
    if found.slow > EVEN:
        remedy = "stop other work; where nothing else runs, it is the machine: print with one that shares nothing"
        return Check("evenness", Verdict.WARN, str(found), remedy)
    return Check("evenness", Verdict.PASS, str(found))


def loopback_check(host: str = "127.0.0.1") -> Check:
    """Whether the operator's page could be served to this machine's own browser."""
    try:
        with socket.create_server((host, 0)):
            return Check("operator's page", Verdict.PASS, f"{host} takes connections")
    except OSError as error:
        return Check("operator's page", Verdict.FAIL, f"{host}: {error}", "let programs listen on the loopback address")


def _room(folder: Path) -> float:
    return shutil.disk_usage(folder).free / 1e9


def _lines(file: Path, key: str) -> list[str]:
    """What stands behind `key:` in a file of the kernel's."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        return []
    return [line.split(":", 1)[1].strip() for line in lines if line.split(":")[0].strip() == key]
