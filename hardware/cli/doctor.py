"""The checks of `stillbed doctor`: the machine, its libraries, its devices.

Each library is loaded in a separate process, which may crash. Device checks run only if the libraries load.
"""

from __future__ import annotations

import os
import platform
import shutil
import socket
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, packages_distributions, requires, version
from pathlib import Path
from typing import TYPE_CHECKING

from packaging.requirements import Requirement

from estimation.errors import StillbedError
from hardware.bench.figures import this_machine
from hardware.files.mesh_reader import SHARED_LIBRARIES
from hardware.operator.view import Check, CheckVerdict
from hardware.process.clock import Clock, Histogram, measure_evenness
from hardware.process.system import NO_PRIORITY

if TYPE_CHECKING:
    from hardware.cameras.sources import CameraDevice

FILE_SYSTEM_ROOT = Path("/")
NO_ANSWER = "no priority granted"  # of a process that ended before the request
MIN_CORES = 2  # one for tracking, one for motion, recorder and page
MIN_MEMORY_GB = 4.0  # GB: a live run takes under 2, planning a large wound half a one
# GB: minimum, and recommended (a minute of three cameras takes 0.1 to 1)
MIN_DISK_GB = (1.0, 10.0)
MIN_SHARED_GB = 0.1  # GB: pictures of three 1280x720 cameras, four sets
CPU_FLAGS = ("avx2", "fma")  # for fast compiled loops and networks
TICK_PERIOD, PROBE_TICKS = 0.02, 50  # s, and a second of ticks
MAX_LATE_MS = 2.0  # ms: a tenth of a tick
PROBE_PIECES = 6000  # pieces of work: 2 to 3 s, because disturbances occur every other second
MAX_SLOW_SHARE = 0.005  # share of the time: once a minute for a third of a second
PRIORITY_REMEDY = (
    "as root: echo 'USER - rtprio 20' > /etc/security/limits.d/stillbed.conf, with your name; then log in anew"
)
JOIN_GROUP = "sudo usermod -aG {group} $USER, then log in anew"
RUN_EXTRAS = {  # extras for a lab, and their use
    **{"franka": "a Franka arm", "foxglove": "live runs in Foxglove", "cluster": "smoothing on many machines"},
    **{"train": "training the wound network", "bench": "the comparison with Ceres"},
}
LOAD_TIMEOUT = 60.0  # s for all of them on a slow disk
LOADED_MARK = "loaded"  # printed by the process for each module
LOADER = f"""import importlib, sys
for name in sys.argv[1:]:
    importlib.import_module(name)
    print({LOADED_MARK!r}, name, flush=True)
"""
REINSTALL = "create a new environment and repeat `pip install .` with constraints.txt"
SLOW_REMEDY = "repeat with less load on this machine"
SYSTEM_REMEDY = "install the system package with this file: `apt-file search NAME` finds it"
OPEN3D_REMEDY = f"on Debian: sudo apt-get install -y {SHARED_LIBRARIES}"


def machine_checks(folder: Path, clock: Clock) -> list[Check]:
    """All checks of the machine. folder: of the recordings."""
    return [
        python_check(),
        processor_check(),
        memory_check(),
        disk_check(folder),
        shared_check(),
        priority_check(),
        punctuality_check(clock),
        evenness_check(clock),
        loopback_check(),
    ]


def _check(name: str, passed: bool, text: str, remedy: str, failure: CheckVerdict = CheckVerdict.WARN) -> Check:
    """PASS if `passed`; else the verdict `failure`, with the remedy."""
    return Check(name, CheckVerdict.PASS, text) if passed else Check(name, failure, text, remedy)


def python_check(release: tuple[int, ...] = sys.version_info[:3]) -> Check:
    """The version of Python."""
    text = f"{'.'.join(map(str, release))} on {platform.system()} {platform.machine()}"
    if release < (3, 11):
        return Check("python", CheckVerdict.FAIL, text, "install Python 3.11 or newer: make PYTHON=python3.12")
    remedy = "live runs need Linux; recordings and planning work here"
    return _check("python", sys.platform == "linux", text, remedy)


def processor_check(root: Path = FILE_SYSTEM_ROOT) -> Check:
    """Cores of this process, and CPU instructions for fast compiled loops."""
    machine = this_machine()
    text = f"{machine.cpu}, {machine.cores} cores"
    flags = _kernel_values(root / "proc/cpuinfo", "flags")
    missing = " and ".join(name for name in CPU_FLAGS if flags and name not in flags[0].split())
    if missing:
        return Check("processor", CheckVerdict.WARN, f"{text}, without {missing}", "poses take longer")
    remedy = "use this machine for recordings; print on a machine with two cores"
    return _check("processor", machine.cores >= MIN_CORES, text, remedy)


def memory_check(root: Path = FILE_SYSTEM_ROOT) -> Check:
    """Free memory."""
    values = _kernel_values(root / "proc/meminfo", "MemAvailable")
    if not values:
        return Check("memory", CheckVerdict.WARN, "unknown on this system", f"have {MIN_MEMORY_GB:g} GB free")
    free = int(values[0].split()[0]) / 1e6
    remedy = f"close programs until {MIN_MEMORY_GB:g} GB are free"
    return _check("memory", free >= MIN_MEMORY_GB, f"{free:.1f} GB free", remedy)


def disk_check(folder: Path) -> Check:
    """Free disk space for recordings."""
    free, (minimum, recommended) = _free_gb(folder), MIN_DISK_GB
    text, remedy = (
        f"{free:.1f} GB free in {folder.resolve()}",
        f"use a disk with {recommended:g} GB free, or free space",
    )
    return _check("disk", free >= recommended, text, remedy, CheckVerdict.FAIL if free < minimum else CheckVerdict.WARN)


def shared_check(root: Path = FILE_SYSTEM_ROOT) -> Check:
    """Shared memory for the pictures between processes."""
    folder = root / "dev/shm"
    free = _free_gb(folder if folder.is_dir() else Path(tempfile.gettempdir()))
    passed = free >= MIN_SHARED_GB
    text = f"{free:.1f} GB free" if passed else f"{1000 * free:.0f} MB free"
    remedy = "in a container: --shm-size 1g; elsewhere: mount -o remount,size=1g /dev/shm"
    return _check("shared memory", passed, text, remedy, CheckVerdict.FAIL)


def priority_check() -> Check:
    """The priority of the motion process, requested in a separate process."""
    code = "from hardware.process.system import ask_for_real_time; print(ask_for_real_time())"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20, check=False)
    text = process.stdout.strip() or NO_ANSWER
    return _check("priority", text not in (NO_PRIORITY, NO_ANSWER), text, PRIORITY_REMEDY)


def punctuality_check(clock: Clock) -> Check:
    """The lateness of ticks on this machine."""
    lateness = Histogram()
    start = clock.now()
    for k in range(1, PROBE_TICKS + 1):
        clock.wait_until(start + k * TICK_PERIOD)
        lateness.add(clock.now() - (start + k * TICK_PERIOD))
    median, p98 = (1000 * lateness.percentile(share) for share in (50, 98))
    text = f"{PROBE_TICKS} ticks of {1000 * TICK_PERIOD:g} ms: {median:.1f} ms late, {p98:.1f} at the worst"
    return _check("clock", p98 <= MAX_LATE_MS, text, "stop other programs; disable power saving")


def evenness_check(clock: Clock) -> Check:
    """The variation of the time for equal work."""
    result = measure_evenness(clock, PROBE_PIECES)
    remedy = "stop other programs; if nothing else runs, use a machine that is not shared"
    return _check("evenness", result.slow <= MAX_SLOW_SHARE, str(result), remedy)


def loopback_check(host: str = "127.0.0.1") -> Check:
    """Whether the operator's page can be served to a browser on this machine."""
    try:
        with socket.create_server((host, 0)):
            return Check("operator's page", CheckVerdict.PASS, f"{host} takes connections")
    except OSError as error:
        remedy = "allow programs to listen on the loopback address"
        return Check("operator's page", CheckVerdict.FAIL, f"{host}: {error}", remedy)


def _free_gb(folder: Path) -> float:
    return shutil.disk_usage(folder).free / 1e9


def _kernel_values(file: Path, key: str) -> list[str]:
    """The values of `key:` in a file of /proc; none without the file."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        return []
    return [line.split(":", 1)[1].strip() for line in lines if line.split(":")[0].strip() == key]


@dataclass(frozen=True, slots=True)
class LoadFailure:
    """The reason why a module did not load."""

    reason: str
    slow: bool = False  # it was still loading at the timeout
    shared_object: bool = False  # the dynamic loader reports a shared object


def library_checks(names: list[str] | None = None) -> list[Check]:
    """A check for each library. names: of distributions; default: all requirements except extras."""
    if names is None:
        try:
            requirements = [Requirement(line) for line in requires("stillbed") or []]
        except PackageNotFoundError:
            return [Check("stillbed", CheckVerdict.FAIL, "not installed, runs from its sources", "pip install .")]
        names = [r.name for r in requirements if r.marker is None or r.marker.evaluate({"extra": ""})]
    modules = modules_of(names)
    failures = load_failures(list(modules.values()))
    return [_library_check(name, modules.get(name, ""), failures) for name in names]


def modules_of(names: list[str]) -> dict[str, str]:
    """The import name of each installed distribution: the module with its own name, or the first one."""
    by_name: dict[str, list[str]] = {name: [] for name in names}
    for module, distributions in packages_distributions().items():
        for name in {distribution.lower() for distribution in distributions} & set(names):
            by_name[name].append(module)
    return {
        name: min(modules, key=lambda m: (m != name, m.startswith("_"))) for name, modules in by_name.items() if modules
    }


def extras_check(extras: dict[str, list[str]] | None = None) -> Check:
    """Missing extras, and how to install them. extras: distributions of each; default: stillbed's extras."""
    if extras is None:
        try:
            lines = [Requirement(line) for line in requires("stillbed") or []]
        except PackageNotFoundError:
            lines = []
        requirements = [(extra, r.name) for r in lines for extra in RUN_EXTRAS if r.marker and _is_of(r, extra)]
        extras = {extra: names for extra in RUN_EXTRAS if (names := [name for of, name in requirements if of == extra])}
    missing = [extra for extra, names in extras.items() if not all(map(_is_installed, names))]
    have = [extra for extra in extras if extra not in missing]
    text = f"installed: {', '.join(have) or 'none'}; not installed: {', '.join(missing) or 'none'}"
    remedy = "; ".join(f"{RUN_EXTRAS.get(extra, extra)}: pip install 'stillbed[{extra}]'" for extra in missing)
    return Check("extras", CheckVerdict.PASS, f"{text}; to have {remedy}" if missing else text)


def _is_of(requirement: Requirement, extra: str) -> bool:
    assert requirement.marker is not None
    return requirement.marker.evaluate({"extra": extra}) and not requirement.marker.evaluate({"extra": ""})


def _is_installed(name: str) -> bool:
    try:
        version(name)
    except PackageNotFoundError:
        return False
    return True


def load_failures(modules: list[str], patience: float = LOAD_TIMEOUT) -> dict[str, LoadFailure]:
    """Failures of modules that did not load, by name, including crashes and hangs of the loading process.

    patience: s for all modules of one process.
    """
    failures: dict[str, LoadFailure] = {}
    while modules:
        loaded, failure = _load_until_failure(modules, patience)
        if loaded < len(modules):
            failures[modules[loaded]] = failure
        modules = modules[loaded + 1 :]
    return failures


def _load_until_failure(modules: list[str], patience: float) -> tuple[int, LoadFailure]:
    """Number of modules that a process loaded, and the reason why it ended."""
    command = [sys.executable, "-c", LOADER, *modules]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            text, errors = process.communicate(timeout=patience)
            message = _failure_text(process.returncode, errors)
            failure = LoadFailure(message, shared_object=".so" in message)  # a message of the dynamic loader
        except subprocess.TimeoutExpired:
            failure = _timeout_failure(process.pid, patience)
            process.kill()
            text, _ = process.communicate()
    return sum(line.startswith(LOADED_MARK) for line in text.splitlines()), failure


def _timeout_failure(process: int, patience: float) -> LoadFailure:
    """The failure of a process that has not ended: slow if it computes or waits for the disk; else it hangs."""
    state = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    if state in ("R", "D"):
        return LoadFailure(f"still loading after {patience:g} s", slow=True)
    return LoadFailure(f"hangs: not loaded after {patience:g} s")


def _failure_text(code: int, message: str) -> str:
    if code < 0:
        return f"signal {-code} ended the loading process: the processor may lack required instructions"
    return (message.strip().splitlines() or [f"exit code {code}"])[-1]


def _library_check(name: str, module: str, failures: dict[str, LoadFailure]) -> Check:
    try:
        release = version(name)
    except PackageNotFoundError:
        return Check(name, CheckVerdict.FAIL, "not installed", REINSTALL)
    if module not in failures:
        return Check(name, CheckVerdict.PASS, release)
    failure = failures[module]
    if failure.slow:
        return Check(name, CheckVerdict.WARN, f"{release}: {failure.reason}", SLOW_REMEDY)
    by_system = OPEN3D_REMEDY if module == "open3d" else SYSTEM_REMEDY
    remedy = by_system if failure.shared_object else REINSTALL
    return Check(name, CheckVerdict.FAIL, f"{release}: {failure.reason}", remedy)


def device_checks() -> list[Check]:
    """Cameras, arm, lock, videos, network. Imports the libraries: called only if these load."""
    from hardware.arm.port import lock_folder, serial_ports
    from hardware.cameras.genicam import aravis_python
    from hardware.cameras.sources import list_devices

    ports = [arm_check(serial_ports()), lock_check(lock_folder())]
    cameras = [camera_check(list_devices()), aravis_check(aravis_python())]
    return [*cameras, *ports, video_check(), network_check()]


def camera_check(devices: tuple[CameraDevice, ...]) -> Check:
    """The connected cameras, and whether this user may open them."""
    if not devices:
        return Check("cameras", CheckVerdict.WARN, "none connected", "connect cameras; see `stillbed cameras`")
    names = ", ".join(device.name or str(device.node) for device in devices)
    return _access_check("cameras", [(str(device.node), names) for device in devices], names, "video")


def aravis_check(python: str | None) -> Check:
    """Whether industrial cameras can be read. python: with Aravis's binding; None: not found."""
    from hardware.cameras.genicam import INSTALL

    if python is None:
        return Check("industrial cameras", CheckVerdict.WARN, "not read: Aravis is not installed", INSTALL)
    return Check("industrial cameras", CheckVerdict.PASS, f"read by Aravis with {python}")


def arm_check(ports: list[tuple[str, str]]) -> Check:
    """Serial ports, as (device, name), and whether this user may open them."""
    if not ports:
        remedy = "connect the arm's adapter; without one, use `stillbed arm --virtual`"
        return Check("arm", CheckVerdict.WARN, "no serial port", remedy)
    return _access_check("arm", ports, ", ".join(f"{device} ({name})" for device, name in ports), "dialout")


def lock_check(folder: Path) -> Check:
    """The folder of port locks, which keep two programs from writing to one arm."""
    if os.access(folder, os.W_OK):
        return Check("port locks", CheckVerdict.PASS, f"kept in {folder}")
    return Check(
        "port locks", CheckVerdict.FAIL, f"{folder} is not writable", f"give this user write access to {folder}"
    )


def video_check() -> Check:
    """Whether recorded videos can be read."""
    from hardware.cameras.capture import reads_videos

    readable = reads_videos()
    text = "read by FFmpeg" if readable else "this OpenCV has no FFmpeg"
    return _check("videos", readable, text, "pip install --force-reinstall opencv-python-headless")


def network_check() -> Check:
    """Whether the wound network exists, is undamaged and runs."""
    from perception.wound.network import WoundNetwork, shipped_model

    try:
        network = WoundNetwork(shipped_model())
    except StillbedError as error:
        return Check("wound network", CheckVerdict.FAIL, str(error), "reinstall stillbed with its data")
    text = f"{network.size / 1e6:.1f} MB, hash correct; licence: {network.terms.licence}"
    return Check("wound network", CheckVerdict.PASS, text)


def _access_check(name: str, nodes: list[tuple[str, str]], text: str, group: str) -> Check:
    closed = ", ".join(node for node, _ in nodes if not os.access(node, os.R_OK | os.W_OK))
    text = f"this user may not open {closed}" if closed else text
    return _check(name, not closed, text, JOIN_GROUP.format(group=group), CheckVerdict.FAIL)
